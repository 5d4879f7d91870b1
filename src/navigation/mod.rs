//! From a frame and a motion to the frames that follow: inverse Poincaré navigation in any number
//! of steps.
//!
//! - A step in latent space is ĝ = g + W⁺ΔP in one of three readings ([`Reading`], A-16), or what
//!   another [`Stepper`] says; the frame nearest to ĝ is looked for under a [`Metric`].
//! - Open loop takes all steps from the source; snap goes on from each retrieved frame; closed loop
//!   does so too and plans the rest of the way anew.

mod multi_step;
mod navigator;
mod pursuit;
mod query;
mod search;
mod stepper;

pub use crate::adapter::Reading;
pub use multi_step::{Leg, Mode, Plan, Space, Start, Step, walk};
pub use navigator::{Answer, AnswerStep, Hit, Navigator, StepError};
pub use pursuit::{Feedback, Outcome, Pursuit, pursue};
pub use query::{Displacement, FitOn, Limits, Query, Source, SourceAt};
pub use search::{IndexKind, Metric, Search};
pub use stepper::{Ground, Refit, StepKind, Stepper};

use crate::{adapter, cancel, features, geometry, pairs, ridge, room};

/// Hit thresholds of the paper, on ‖ΔP_target − ΔP_retrieved‖₂, metres and radians mixed.
pub const HIT_THRESHOLDS: [f64; 4] = [0.1, 0.2, 0.3, 0.5];

/// The longest translation of one motion, metres.
pub const MAX_TRANSLATION_M: f64 = 1e6;

/// Why a question has no answer.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Error {
    #[error("source: {0}")]
    SourceFrame(room::Error),
    #[error("target: {0}")]
    TargetFrame(room::Error),
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    #[error(transparent)]
    Features(#[from] features::Error),
    #[error("no linear map from motions to steps can be fitted in this room: {0}")]
    Refit(#[from] ridge::Error),
    #[error("no linear map from motions to steps can be fitted in this room: {0}")]
    Pairs(#[from] pairs::Error),
    #[error(transparent)]
    Cancelled(#[from] cancel::Cancelled),
    #[error(
        "room '{room}' has {frame_count} frames, its features have {rows} rows; every frame needs one"
    )]
    FeatureRows {
        room: room::RoomId,
        frame_count: usize,
        rows: usize,
    },
    #[error("steps must be 1 to {most} in all, got {actual}")]
    Steps { actual: u64, most: u32 },
    #[error("hit_count must be 1 to {most}, got {actual}")]
    HitCount { actual: u32, most: u32 },
    #[error("steps times hit_count is {actual}, over the limit of {most} frames in one answer")]
    HitsInAll { actual: u64, most: u64 },
    #[error("displacement has no twist; give at least one")]
    NoTwist,
    #[error(
        "displacement {position} has a number that is not finite or a translation over {MAX_TRANSLATION_M:e} m"
    )]
    TwistNotFinite { position: usize },
    #[error(
        "displacement {position} turns by {angle_rad:.6} rad; a motion must turn by less than π ({:.6}), \
         or its logarithm is not unique: cut it in parts",
        std::f64::consts::PI
    )]
    TwistBeyondPi { position: usize, angle_rad: f64 },
    #[error(
        "{what} needs a source whose pose is known: use a frame of the room, or give source_pose"
    )]
    PoseNeeded { what: &'static str },
    #[error("no frame is left to retrieve: the room has {frame_count}, all are excluded")]
    NoCandidates { frame_count: usize },
}

/// Refuses a motion that cannot be planned.
fn check_twist(twist: geometry::Twist, position: usize) -> Result<(), Error> {
    if !twist.is_finite() || twist.linear.norm() > MAX_TRANSLATION_M {
        return Err(Error::TwistNotFinite { position });
    }

    if !twist.is_unique_logarithm() {
        return Err(Error::TwistBeyondPi {
            position,
            angle_rad: twist.angular.norm(),
        });
    }

    Ok(())
}
