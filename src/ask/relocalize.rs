//! `seese3 relocalize`: the room and the pose of a camera, from several of its views.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;

use super::{
    Server, ViewCamera, estimate_text, feature_view, image_view, matches_text, revision,
    rooms_text, wire_json,
};
use crate::camera::CAMERA_FORM;
use crate::output::{JsonOutput, say};
use seese3_client::proto::v1 as pb;

#[derive(Debug, Args)]
pub struct Relocalize {
    #[command(flatten)]
    server: Server,
    /// A room to search; may be given several times. If omitted, all rooms that the adapter serves
    /// and, for images, all rooms with keypoints
    #[arg(long = "room")]
    rooms: Vec<String>,
    /// Name of the adapter. If omitted: in one room, its default among the adapters that can track;
    /// in several rooms, the only one that can. Images of rooms with keypoints need none
    #[arg(long, default_value = "", hide_default_value = true)]
    adapter: String,
    /// JPEG or PNG files, A,B,…: views of one camera that hardly moves between them, the newest
    /// last; the server must have been started with --encoder
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "A,B,…",
        conflicts_with = "feature_file"
    )]
    images: Vec<PathBuf>,
    /// Camera of --images, as --camera of `seese3 import`, or "mapping" for the camera that mapped
    /// the room. Required if a room has keypoints
    #[arg(long, value_name = CAMERA_FORM, requires = "images")]
    camera: Option<ViewCamera>,
    /// A NumPy file of features, shape (n, d); --rows chooses some
    #[arg(long, value_name = "FILE", requires = "rows")]
    feature_file: Option<PathBuf>,
    /// Rows of the --feature-file, A,B,…, counted from 0, the newest last
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "A,B,…",
        requires = "feature_file"
    )]
    rows: Vec<usize>,
    /// Maximum number of rooms returned; all are compared
    #[arg(long, default_value_t = 3)]
    max_rooms: u32,
    #[command(flatten)]
    json: JsonOutput,
}

impl Relocalize {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let views = match &self.feature_file {
            Some(file) => {
                let rows = self.rows.iter();
                rows.map(|row| feature_view(file, *row))
                    .collect::<anyhow::Result<_>>()?
            }
            None if self.images.is_empty() => {
                bail!("--images A,B,… or --feature-file FILE --rows A,B,… is required")
            }
            None => {
                let images = self.images.iter();
                images
                    .map(|image| image_view(image))
                    .collect::<anyhow::Result<_>>()?
            }
        };

        let request = pb::RelocalizeRequest {
            rooms: self.rooms,
            adapter: self.adapter,
            views,
            max_rooms: Some(self.max_rooms),
            camera: self.camera.map(ViewCamera::to_wire),
            ..pb::RelocalizeRequest::default()
        };
        let answer = self.server.connect().await?.relocalize(request).await?;

        say(format_args!(
            "{} searched: {}",
            rooms_text(answer.room_count),
            match answer.ambiguous {
                true => format!("ambiguous, {}", answer.reason),
                false => "unambiguous".to_owned(),
            }
        ));
        for found in &answer.rooms {
            let mut text = format!("room {}: ", revision(found.room.as_ref()));
            match &found.pose {
                Some(pose) => text += &estimate_text(pose, found.method()),
                None => text += "the view is not in it",
            }
            if let Some(matches) = &found.matches {
                text += &format!("; {}", matches_text(matches));
            }
            if let Some(ratio) = found.distance_ratio {
                text += &format!("; distance {ratio:.2} of its limit");
            }
            say(text);
        }

        self.json.write(&wire_json("RelocalizeResponse", &answer)?)
    }
}
