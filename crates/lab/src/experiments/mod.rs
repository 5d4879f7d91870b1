//! Experiments of researchers. Each module computes its results and defines their types.
//!
//! - [`seeds`]: one training plan with several seeds; [`folds`]: with several splits.
//! - [`probe`] and [`layers`]: scores M1 to M4 of features in rooms, and per encoder layer.
//! - [`formulations`]: the adapter compared with the paper's alternatives.
//! - [`adapter_sweep`]: a grid of adapters, one row per run.
//! - [`cross_room`]: an adapter in held-out rooms.
//! - [`localization`]: single views in a partly mapped room.
//! - [`matched_localization`]: single views in a partly mapped room, by their keypoints.
//! - [`motion`]: motion between two views, compared with simple baselines.
//! - [`odometry`]: a tracker on held-out frames.
//! - [`odometry_scenarios`]: parts without a map, kidnaps and wheels.
//! - [`planning`]: paths to a goal, compared with simple planners.
//! - [`robustness`]: a tracker under disturbances of its images.
//! - [`room_card`]: statistics of recordings.
//! - [`path_comparison`]: an estimated path compared with a reference.
//!
//! An experiment takes loaded rooms ([`seese3_core::training::RoomData`]); it reads and writes no
//! files. [`crate::report`] renders the results.

pub mod adapter_sweep;
pub mod cross_room;
mod estimate_error;
pub mod folds;
pub mod formulations;
pub mod layers;
pub mod localization;
pub mod matched_localization;
pub mod motion;
pub mod odometry;
pub mod odometry_scenarios;
pub mod path_comparison;
pub mod mapless;
mod mapped_room;
pub mod planning;
mod player;
pub mod probe;
pub mod replay;
mod simulated_sensors;
pub mod robustness;
pub mod room_card;
pub mod seeds;
mod simple_planners;
pub mod tracked_room;
pub mod tracking_fit;
pub mod tracking_intervals;
pub mod tracking_scores;

pub use estimate_error::EstimateError;

use seese3_core::room::Room;
use seese3_core::splits::HoldOut;
use seese3_core::{adapter, eval, navigation, splits, training, trajectory};
use seese3_robot::{calibration, fitting, tracking};

use crate::probes;

/// Refuses a hold-out that leaves no frame of the room to ask for.
///
/// # Errors
/// [`Error::Input`] if it does.
pub fn check_hold_out(room: &Room, hold_out: HoldOut) -> Result<(), Error> {
    if hold_out.tracked(room.timeline()).is_empty() {
        return Err(Error::Input(format!(
            "room '{}' is one sequence of {} frames, of which hold-out '{}' leaves none to track; \
             'visit' needs a room of two sequences",
            room.id(),
            room.frame_count(),
            hold_out.name()
        )));
    }
    Ok(())
}

/// Why an experiment failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No adapter could be trained.
    #[error(transparent)]
    Training(#[from] training::Error),
    /// An adapter rejected its input.
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    /// An adapter could not be calibrated.
    #[error(transparent)]
    Calibration(#[from] calibration::Error),
    /// An adapter could not be fitted to a room, or a view could not be located in it.
    #[error(transparent)]
    Fitting(#[from] fitting::Error),
    /// Navigation in a room failed.
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
    /// A room has no training or no test pairs under a split.
    #[error(transparent)]
    Splits(#[from] splits::Error),
    /// A result could not be rendered.
    #[error("a result cannot be rendered")]
    Rendering(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// What an interrupted run has left cannot be read or written.
    #[error("{0}")]
    Journal(String),
    /// A seed does not fit in 32 bits, the seed size of PyTorch.
    #[error("--seed plus --seeds must be at most 2³²")]
    Seed,
    /// One room or one part of an experiment failed.
    #[error("{what}")]
    In {
        /// The room, or the part of the experiment.
        what: String,
        /// Why it failed.
        #[source]
        problem: Box<Error>,
    },
    /// The input of the experiment is invalid; the text says why.
    #[error("{0}")]
    Input(String),
}

/// Adds context to errors.
pub(crate) trait Within<T> {
    /// Wraps an error with the room or the part of the experiment that failed.
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

#[cfg(test)]
mod tests {
    use seese3_core::geometry::Pose;
    use seese3_core::room::{Frames, Provenance, RoomId};

    use super::*;

    /// Oracle: the definition: another visit needs a second sequence.
    #[test]
    fn a_hold_out_without_frames_to_track_is_refused_by_name() {
        let room = |sequences: Vec<u32>| {
            let frames = Frames {
                poses: vec![Pose::default(); 20],
                sequences,
                ..Frames::default()
            };
            Room::new(RoomId::new("hall").unwrap(), frames, Provenance::default()).unwrap()
        };

        let one = room(Vec::new());
        let error = check_hold_out(&one, HoldOut::Visit).unwrap_err();
        assert!(error.to_string().contains("'hall'"), "{error}");
        assert!(check_hold_out(&one, HoldOut::Time).is_ok());

        let two = room((0..20).map(|row| row / 10).collect());
        assert!(check_hold_out(&two, HoldOut::Visit).is_ok());
    }
}
