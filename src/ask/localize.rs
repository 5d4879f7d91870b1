//! `seese3 localize`: the camera pose of a view, and the mapped frames most similar to it.

use anyhow::Context;
use clap::Args;

use super::{
    FeatureRow, Server, ViewCamera, error_text, estimate_text, fitted_text, frame_text,
    matches_text, revision, rooms_text, wire_json,
};
use crate::camera::CAMERA_FORM;
use crate::output::{JsonOutput, say};
use seese3_client::proto::v1 as pb;

#[derive(Debug, Args)]
pub struct Localize {
    #[command(flatten)]
    server: Server,
    /// A room to search; may be given several times. If omitted, all rooms that the adapter serves
    /// and, for images, all rooms with keypoints
    #[arg(long = "room")]
    rooms: Vec<String>,
    /// Name of the adapter. If omitted: with one room, as for `navigate`; otherwise the only one
    /// that serves all the rooms; adapters fitted to one room do not count
    #[arg(long, default_value = "", hide_default_value = true)]
    adapter: String,
    /// Use this stored frame as the view: a row of the room, counted from 0; exactly one room must
    /// be searched
    #[arg(long, conflicts_with_all = ["feature_file", "image"])]
    frame: Option<u32>,
    #[command(flatten)]
    feature: FeatureRow,
    /// Camera of --image, as --camera of `seese3 import`, or "mapping" for the camera that mapped
    /// the room. Required if the room has keypoints
    #[arg(long, value_name = CAMERA_FORM, requires = "image")]
    camera: Option<ViewCamera>,
    /// Number of frames returned, over all rooms, best first
    #[arg(long, default_value_t = 5)]
    top_k: u32,
    #[command(flatten)]
    json: JsonOutput,
}

impl Localize {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let view = self.feature.or_frame(
            self.frame,
            "--feature-file FILE --row ROW, --image FILE or --frame FRAME is required",
        )?;

        let request = pb::LocalizeRequest {
            rooms: self.rooms,
            adapter: self.adapter,
            view: Some(view),
            top_k: Some(self.top_k),
            camera: self.camera.map(ViewCamera::to_wire),
            ..pb::LocalizeRequest::default()
        };

        let answer = self.server.connect().await?.localize(request).await?;
        if let Some(pose) = &answer.pose {
            say(estimate_text(pose, answer.method()));
        }
        if !answer.reason.is_empty() {
            say(&answer.reason);
        }
        if let Some(matches) = &answer.matches {
            say(matches_text(matches));
        }
        if let Some(fitted) = &answer.fitted {
            say(fitted_text(fitted));
        }

        let novelty = match answer.novelty {
            Some(novelty) => format!("novelty {novelty:.2}, in the map up to 1"),
            None => "novelty unknown".to_owned(),
        };
        let adapter = match &answer.adapter {
            Some(adapter) => format!("adapter {}", revision(Some(adapter))),
            None => "no adapter".to_owned(),
        };
        say(format_args!(
            "room {}, {novelty}; {adapter}, {} searched",
            revision(answer.room.as_ref()),
            rooms_text(answer.room_count)
        ));

        // Only a view that is a frame of the room has a recorded pose, and hence an error.
        for similar in &answer.frames {
            let frame = similar
                .frame
                .as_ref()
                .context("the server's answer has an entry of frames without a frame")?;
            say(format_args!(
                "{}{}",
                frame_text(frame),
                similar.error.as_ref().map_or(String::new(), error_text)
            ));
        }

        self.json.write(&wire_json("LocalizeResponse", &answer)?)
    }
}
