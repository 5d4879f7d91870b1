//! `seese3 localize`: the mapped frames most similar to a view, and the camera pose.

use anyhow::Context;
use clap::Args;

use super::{
    FeatureRow, Server, deviations_text, error_text, frame_text, pose_text, revision, wire_json,
};
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
            ..pb::LocalizeRequest::default()
        };

        let answer = self.server.connect().await?.localize(request).await?;
        say(format_args!(
            "adapter {}, {} rooms",
            revision(answer.adapter.as_ref()),
            answer.room_count
        ));

        if let Some(believed) = &answer.believed {
            say(believed_text(believed));
        }
        if let Some(located) = &answer.located {
            say(located_text(located));
        }

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

/// The estimated camera pose, and whether the view resembles the room.
fn believed_text(believed: &pb::BelievedPose) -> String {
    let pose = pose_text(believed.pose.as_ref());
    let sure = deviations_text(&believed.covariance);

    match believed.out_of_distribution {
        None => format!(
            "camera at {pose}{sure}; the view's distance from the room is unknown: the adapter is not calibrated"
        ),
        Some(far) if far > 1.0 => format!(
            "the view is out of distribution, at {far:.2} of the room's limit (above 1): the camera pose is \
             unknown"
        ),
        Some(far) => {
            format!("camera at {pose}{sure}; the view's distance is {far:.2} of the room's limit")
        }
    }
}

/// The pose from the adapter fitted to the room, with the sources of its translation and rotation.
fn located_text(located: &pb::LocatedPose) -> String {
    format!(
        "the adapter fitted to the room: camera at {}{}\n\
         from frame {}, distance {:.3}: translation {} × {:.1}, rotation {} × {:.1}",
        pose_text(located.pose.as_ref()),
        deviations_text(&located.covariance),
        located.frame_id,
        located.distance,
        located.translation_reader,
        located.translation_gain,
        located.rotation_reader,
        located.rotation_gain
    )
}
