//! What researchers run: each experiment computes its results and owns their types.
//!
//! - [`seeds`]: one training plan with several seeds; [`folds`]: under several splits.
//! - [`probe`] and [`layers`]: M1 to M4 of features in rooms, and over the layers of an encoder.
//! - [`formulations`]: the adapter beside the paper's alternatives.
//! - [`adapter_sweep`]: a grid of adapters, one row per run.
//! - [`cross_room`]: an adapter in rooms that it never saw.
//! - [`localization`]: single views in a partly mapped room.
//! - [`motion`]: the motion between two views, beside the simplest answers.
//! - [`odometry`]: a tracker along held-out frames.
//! - [`planning`]: ways to a goal, beside simple planners.
//! - [`robustness`]: a tracker under disturbances of its images.
//! - [`path_comparison`]: an estimated path against a reference.
//!
//! An experiment takes rooms that are loaded ([`seese3_core::training::RoomData`]) and reads and
//! writes no file. [`crate::report`] renders the results.

pub mod adapter_sweep;
pub mod cross_room;
pub mod folds;
pub mod formulations;
pub mod layers;
pub mod localization;
pub mod motion;
pub mod odometry;
pub mod path_comparison;
mod mapped_room;
pub mod planning;
pub mod probe;
pub mod robustness;
pub mod seeds;
mod simple_planners;
pub mod tracking_scores;

use seese3_core::{adapter, eval, navigation, splits, training, trajectory};
use seese3_robot::{calibration, fitting, tracking, two_view};

use crate::probes;

/// Why an experiment has no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No adapter could be trained.
    #[error(transparent)]
    Training(#[from] training::Error),
    /// An adapter refused its input.
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    /// An adapter's errors could not be measured.
    #[error(transparent)]
    Calibration(#[from] calibration::Error),
    /// An adapter could not be fitted to a room, or a view not located in it.
    #[error(transparent)]
    Fitting(#[from] fitting::Error),
    /// A room could not be navigated in.
    #[error(transparent)]
    Navigation(#[from] navigation::Error),
    /// Navigators could not be evaluated.
    #[error(transparent)]
    Evaluation(#[from] eval::Error),
    /// A camera could not be tracked.
    #[error(transparent)]
    Tracking(#[from] tracking::Error),
    /// Two paths could not be compared.
    #[error(transparent)]
    Trajectory(#[from] trajectory::Error),
    /// Features could not be probed.
    #[error(transparent)]
    Probe(#[from] probes::Error),
    /// The motion between two views could not be read.
    #[error(transparent)]
    TwoView(#[from] two_view::Error),
    /// A room gives no pairs.
    #[error(transparent)]
    Splits(#[from] splits::Error),
    /// A result could not be rendered.
    #[error("a result cannot be rendered")]
    Rendering(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// Seeds have 32 bits, as PyTorch's have.
    #[error("--seed and --seeds reach over 2³²")]
    Seed,
    /// What failed, and why.
    #[error("{what}")]
    In {
        /// The room, or the part of the experiment.
        what: String,
        /// Why it failed.
        #[source]
        problem: Box<Error>,
    },
    /// What the experiment needs and did not get, in words.
    #[error("{0}")]
    Input(String),
}

/// Says in an error what failed.
pub(crate) trait Within<T> {
    /// Names the room or the part that failed, if it failed.
    fn within(self, what: impl Fn() -> String) -> Result<T, Error>;
}

impl<T, E: Into<Error>> Within<T> for Result<T, E> {
    fn within(self, what: impl Fn() -> String) -> Result<T, Error> {
        self.map_err(|problem| Error::In {
            what: what(),
            problem: Box::new(problem.into()),
        })
    }
}
