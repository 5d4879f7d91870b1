//! `seese3 motion`: the camera motion between two views.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Args;

use super::{
    Server, ViewCamera, diagonal, error_text, feature_view, frame_view, image_view, motion_text,
    revision, wire_json,
};
use crate::camera::CAMERA_FORM;
use crate::output::{JsonOutput, say};
use seese3_client::proto::v1 as pb;

#[derive(Debug, Args)]
pub struct Motion {
    #[command(flatten)]
    server: Server,
    /// Name of the adapter. If omitted: with a room, as for `navigate`; otherwise the only one that
    /// serves all rooms; adapters fitted to one room do not count
    #[arg(long, default_value = "", hide_default_value = true)]
    adapter: String,
    /// Name of the room that the frames belong to
    #[arg(long, default_value = "", hide_default_value = true)]
    room: String,
    /// First frame: a row of the room, counted from 0
    #[arg(long, requires = "to", conflicts_with_all = ["images", "feature_file"])]
    from: Option<u32>,
    /// Second frame: a row of the room, counted from 0
    #[arg(long, requires = "from")]
    to: Option<u32>,
    /// Two JPEG or PNG files, A,B; the server must have been started with --encoder
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "A,B",
        conflicts_with = "feature_file"
    )]
    images: Option<Vec<PathBuf>>,
    /// Camera of --images, as --camera of `seese3 import`, or "mapping" for the camera that mapped
    /// the room. With it, a server with the encoder of a room's keypoints matches the keypoints of
    /// the images, unless --adapter is given
    #[arg(long, value_name = CAMERA_FORM, requires = "images")]
    camera: Option<ViewCamera>,
    /// A NumPy file of features, shape (n, d); --rows chooses two
    #[arg(long, value_name = "FILE", requires = "rows")]
    feature_file: Option<PathBuf>,
    /// Two rows of the --feature-file, A,B, counted from 0
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "A,B",
        requires = "feature_file"
    )]
    rows: Option<Vec<usize>>,
    /// Estimate the motion with the adapter's relational reader, which compares the cells of both
    /// feature maps and needs no camera
    #[arg(long, conflicts_with = "camera")]
    relational: bool,
    #[command(flatten)]
    json: JsonOutput,
}

impl Motion {
    /// The two views of the request.
    fn views(&self) -> anyhow::Result<(pb::View, pb::View)> {
        // Both views come from one kind of input: frames of a room, rows of a feature file, or
        // image files.
        match (
            self.from.zip(self.to),
            &self.feature_file,
            self.rows.as_deref(),
        ) {
            (Some((from, to)), _, _) => Ok((frame_view(from), frame_view(to))),
            (None, Some(file), Some(&[a, b])) => {
                Ok((feature_view(file, a)?, feature_view(file, b)?))
            }
            _ => match self.images.as_deref() {
                Some([a, b]) => Ok((image_view(a)?, image_view(b)?)),
                Some(files) => bail!("--images has {} files; give two, A,B", files.len()),
                None => {
                    bail!(
                        "--from A --to B, --feature-file FILE --rows A,B or --images A,B is required"
                    )
                }
            },
        }
    }

    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;

        let (first, second) = self.views()?;
        let camera = self.camera.map(ViewCamera::to_wire);

        let request = pb::EstimateMotionRequest {
            adapter: self.adapter,
            room: self.room,
            first: Some(first),
            second: Some(second),
            camera,
            estimator: match self.relational {
                true => pb::MotionEstimator::Relational.into(),
                false => pb::MotionEstimator::Unspecified.into(),
            },
            ..pb::EstimateMotionRequest::default()
        };

        let answer = self
            .server
            .connect()
            .await?
            .estimate_motion(request)
            .await?;
        let motion = answer.motion.as_ref();
        let motion = motion.context("the server sent no motion")?;
        let twist = motion.twist.as_ref();
        let twist = twist.context("the server sent no motion")?;

        match answer.estimator() {
            pb::MotionEstimator::TwoView => say("estimated by matched keypoints"),
            pb::MotionEstimator::None => {
                say("the images have too little in common: no motion was estimated");
            }
            pb::MotionEstimator::Relational => say(format_args!(
                "relational reader of adapter {}",
                revision(answer.adapter.as_ref())
            )),
            pb::MotionEstimator::Adapter | pb::MotionEstimator::Unspecified => say(format_args!(
                "adapter {}",
                revision(answer.adapter.as_ref())
            )),
        }

        say(format_args!(
            "motion {} in the body frame of the first camera",
            motion_text(twist)
        ));

        // Standard deviation per axis: the root of the mean of three variances.
        if let Some(variances) = diagonal(&motion.covariance) {
            let deviation = |part: &[f64]| (part.iter().sum::<f64>() / 3.0).sqrt();
            say(format_args!(
                "standard deviation {:.3} m, {:.1}° (mean of the axes)",
                deviation(&variances[..3]),
                deviation(&variances[3..]).to_degrees()
            ));
        }

        // The true motion is known only if both views are frames of the room, which have recorded
        // poses.
        if let (Some(truth), Some(error)) = (&answer.true_motion, &answer.error) {
            say(format_args!(
                "truth  {}{}",
                motion_text(truth),
                error_text(error)
            ));
        }

        self.json
            .write(&wire_json("EstimateMotionResponse", &answer)?)
    }
}
