//! Inverse Poincaré navigation: for a source (a frame, a feature or a latent) and a requested
//! camera motion, retrieve the frames that the camera would see, in one step or several.
//!
//! - A step in latent space is ĝ = g + W⁺ΔP in one of three readings ([`Reading`], A-16), or the
//!   step of another [`Stepper`]. The stored frames nearest to ĝ under a [`RetrievalMetric`] are
//!   retrieved.
//! - Steps are chained in one of three modes. Open loop adds all steps in latent space. Snap
//!   continues from the latent of the nearest frame that each step retrieved. Closed loop also
//!   recomputes the remaining motion from that frame's pose.
//! - Start reading at [`Navigator::answer`]; [`walk`] is the loop inside it.

mod kind;
mod multi_step;
mod navigator;
mod pursuit;
mod query;
mod relational;
mod search;
mod stepper;

pub use crate::adapter::Reading;
pub use kind::NavigatorKind;
pub use multi_step::{Leg, Mode, Plan, Space, Start, Step, walk};
pub use navigator::{Answer, AnswerStep, Navigator, RetrievedFrame, StepError};
pub use pursuit::{Feedback, Outcome, Pursuit, pursue};
pub use query::{FitOn, Limits, Method, Query, RequestedMotion, Source, SourceAt};
pub use relational::{RelationalSpace, RelationalView, RelationalWalk, SHORTLIST, relational_walk};
pub use search::{IndexKind, RetrievalMetric, Search};
pub use stepper::{Refit, RefitData, StepKind, Stepper};

use crate::{adapter, cancel, features, geometry, ridge, room, splits};

/// Thresholds ε of the paper's Hit@ε, compared with ‖ΔP_target − ΔP_retrieved‖₂, meters and radians
/// mixed.
pub const HIT_THRESHOLDS: [f64; 4] = [0.1, 0.2, 0.3, 0.5];

/// Maximum translation of one motion, meters.
pub const MAX_TRANSLATION_M: f64 = 1e6;

/// Why a query cannot be answered.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
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
    Pairs(#[from] splits::Error),
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
    #[error("top_k must be 1 to {most}, got {actual}")]
    TopK { actual: u32, most: u32 },
    #[error("steps times top_k is {actual}, over the limit of {most} frames in one answer")]
    FramesInAnswer { actual: u64, most: u64 },
    #[error("motion has no twist; give at least one")]
    NoTwist,
    #[error(
        "motion {position} has a number that is not finite or a translation over {MAX_TRANSLATION_M:e} m"
    )]
    TwistNotFinite { position: usize },
    #[error(
        "motion {position} turns by {angle_rad:.6} rad; it must turn by less than π ({:.6}), \
         or its logarithm is not unique: divide it into parts",
        std::f64::consts::PI
    )]
    TwistBeyondPi { position: usize, angle_rad: f64 },
    #[error(
        "{what} needs a source with a known pose: use a frame of the room, or give source_pose"
    )]
    PoseNeeded { what: &'static str },
    #[error(
        "the navigator 'relational' compares images, which a latent no longer has; use a frame, a \
         feature or an image as the source"
    )]
    ViewNeeded,
    #[error("no frame is left to retrieve: all {frame_count} frames are excluded")]
    NoCandidates { frame_count: usize },
}

/// Checks that a motion is finite, its translation is at most [`MAX_TRANSLATION_M`] and its
/// rotation is below π.
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
