//! `seese3 localize`: the camera pose of a view, and the mapped frames most similar to it.

use anyhow::Context;
use clap::Args;

use super::{
    FeatureRow, Server, ViewCamera, error_text, estimate_text, fitted_text, frame_text,
    matches_text, revision, wire_json,
};
use crate::camera::CAMERA_FORM;
use crate::output::{JsonOutput, say};
use seese3_client::proto::v1 as pb;

#[derive(Debug, Args)]
pub struct Localize {
    #[command(flatten)]
    server: Server,
    /// A room to search; all rooms that the adapter fits if omitted; may be given several times
    #[arg(long = "room")]
    rooms: Vec<String>,
    /// Name of the adapter; may be omitted when only one fits all the rooms
    #[arg(long, default_value = "")]
    adapter: String,
    /// Use this frame as the view: a row of the room, counted from 0; needs exactly one --room
    #[arg(long, conflicts_with_all = ["feature", "image"])]
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
            "--feature FILE --row ROW, --image FILE or --frame FRAME is required",
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
            "room {}, {novelty}; {adapter}, {} rooms searched",
            revision(answer.room.as_ref()),
            answer.room_count
        ));

        // Only a view that is a frame of the room has a recorded pose, and hence an error.
        for place in &answer.places {
            let frame = place
                .frame
                .as_ref()
                .context("the server's answer has a place without a frame")?;
            say(format_args!(
                "{}{}",
                frame_text(frame),
                place.error.as_ref().map_or(String::new(), error_text)
            ));
        }

        self.json.write(&wire_json("LocalizeResponse", &answer)?)
    }
}
