//! `seese3 navigate`: the frames that a camera motion leads to.

use anyhow::bail;
use clap::Args;

use super::{FeatureRow, Server, error_text, frame_text, motion_text, revision, wire_json};
use crate::named::one_of;
use crate::output::{JsonOutput, say};
use seese3_client::proto::v1 as pb;
use seese3_core::adapter::Reading;
use seese3_core::navigation::{Mode, NavigatorKind};

#[derive(Debug, Args)]
pub struct Navigate {
    #[command(flatten)]
    server: Server,
    /// Name of the room to navigate in
    #[arg(long)]
    room: String,
    /// Name of the adapter. If omitted: the room's default (`seese3 store default`), else one
    /// fitted to the room, else one trained in it, else the newest that serves it
    #[arg(long, default_value = "", hide_default_value = true)]
    adapter: String,
    /// Start at this frame of the room (its row, counted from 0)
    #[arg(long, conflicts_with_all = ["feature_file", "image"])]
    from: Option<u32>,
    #[command(flatten)]
    feature: FeatureRow,
    /// Target frame of the room: the motion is computed from the recorded poses
    #[arg(
        long,
        value_name = "FRAME",
        requires = "from",
        conflicts_with = "twist"
    )]
    to: Option<u32>,
    /// The motion as vx,vy,vz,wx,wy,wz (se(3) twist), meters and radians, in the body frame of the
    /// start camera (x right, y down, z forward): the whole motion, which --steps divides
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true)]
    twist: Option<Vec<f64>>,
    /// Number of equal steps that the motion is divided into
    #[arg(long, default_value_t = 1)]
    steps: u32,
    /// How the steps are chained
    #[arg(long, value_parser = one_of::<Mode>(), default_value = "open-loop")]
    mode: Mode,
    /// How the mean μ and deviation σ of the training motions enter the inverse of W; homogeneous
    /// if neither this nor --navigator is given
    #[arg(long = "inverse", value_name = "VARIANT", value_parser = one_of::<Reading>(), conflicts_with = "navigator")]
    reading: Option<Reading>,
    /// Navigator by name, instead of inverse Poincaré: corrector-mlp-3, ridge-refit, relational,
    /// inverse-poincare-affine+motion, …; if empty, inverse Poincaré in the given --inverse
    #[arg(long, default_value = "", hide_default_value = true)]
    navigator: String,
    /// Number of nearest frames returned for each step
    #[arg(long, default_value_t = 1)]
    top_k: u32,
    /// Never retrieve the frame that a step starts from
    #[arg(long)]
    exclude_source: bool,
    #[command(flatten)]
    json: JsonOutput,
}

impl Navigate {
    pub async fn run(self) -> anyhow::Result<()> {
        use pb::requested_motion::Motion;

        self.json.begin()?;

        // A navigation starts from exactly one view. Clap rejects two; reject none here.
        let source = self.feature.or_frame(
            self.from,
            "--from FRAME, --feature-file FILE --row ROW or --image FILE is required",
        )?;

        let motion = match (self.to, &self.twist) {
            (Some(frame), _) => Motion::TargetFrameId(frame),
            (None, Some(numbers)) => Motion::Twist(twist(numbers)?),
            (None, None) => bail!("--to FRAME or --twist vx,vy,vz,wx,wy,wz is required"),
        };

        let mode = match self.mode {
            Mode::OpenLoop => pb::StepMode::OpenLoop,
            Mode::Snap => pb::StepMode::Snap,
            Mode::ClosedLoop => pb::StepMode::ClosedLoop,
        };

        // An unspecified variant leaves the choice to the server: homogeneous, unless --navigator
        // already names one.
        let variant = match self.reading {
            None => pb::InverseVariant::Unspecified,
            Some(Reading::Affine) => pb::InverseVariant::Affine,
            Some(Reading::Homogeneous) => pb::InverseVariant::Homogeneous,
            Some(Reading::Literal) => pb::InverseVariant::Literal,
        };

        let request = pb::NavigateRequest {
            room: self.room,
            adapter: self.adapter,
            source: Some(source),
            motion: Some(pb::RequestedMotion {
                motion: Some(motion),
            }),
            steps: Some(self.steps),
            step_mode: mode.into(),
            inverse_variant: variant.into(),
            navigator: self.navigator,
            top_k: Some(self.top_k),
            exclude_source: self.exclude_source,
            ..pb::NavigateRequest::default()
        };

        let answer = self.server.connect().await?.navigate(request).await?;
        say_navigation(&answer);
        self.json.write(&wire_json("NavigateResponse", &answer)?)
    }
}

fn twist(numbers: &[f64]) -> anyhow::Result<pb::Twist> {
    let &[vx, vy, vz, wx, wy, wz] = numbers else {
        bail!(
            "--twist needs six numbers, vx,vy,vz,wx,wy,wz, got {}",
            numbers.len()
        );
    };

    let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
    Ok(pb::Twist {
        linear: vector(vx, vy, vz),
        angular: vector(wx, wy, wz),
    })
}

/// Prints a navigation: the revisions used, the whole motion, and each step's nearest frames. Also
/// used by `seese3 demo`.
pub fn say_navigation(answer: &pb::NavigateResponse) {
    let room = revision(answer.room.as_ref());
    let adapter = revision(answer.adapter.as_ref());
    say(format_args!(
        "room {room}, adapter {adapter}, {}",
        answer.navigator
    ));

    if let Some(motion) = &answer.motion {
        say(format_args!("motion {}", motion_text(motion)));
    }

    if answer.navigator == NavigatorKind::Relational.name() {
        say("distances are negative log-densities of the motion, nats up to a constant");
    }

    for step in &answer.steps {
        // The best frame carries the step's number and its pose error; the others are listed
        // below it.
        for (rank, frame) in step.frames.iter().enumerate() {
            let label = if rank == 0 {
                format!("step {}", step.step)
            } else {
                String::new()
            };

            let error = step
                .error
                .as_ref()
                .filter(|_| rank == 0)
                .map_or(String::new(), error_text);
            say(format_args!("{label:8}{}{error}", frame_text(frame)));
        }
    }
}
