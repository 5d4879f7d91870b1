//! Hit@ε on held-out pairs, for navigators and baselines.

mod baselines;
mod leak;
mod navigators;
mod predictions;
mod retrieval;

pub use baselines::{Baselines, LEAST_CONSTANT_R2, TestPairs};
pub use leak::{Leak, TrainedOn, has_seen, is_calibrated_in};
pub use navigators::{Protocol, Report, Row, evaluate};
pub use predictions::{PredictedPair, Prediction, PredictionScope, score_predictions};
pub use retrieval::{LatentScores, PoseRecall, RetrievalScores, RetrievedPair};

use crate::{adapter, cancel, navigation, room, splits};

/// Why an evaluation failed.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(transparent)]
    Pairs(#[from] splits::Error),
    #[error(transparent)]
    Room(#[from] room::Error),
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    #[error(transparent)]
    Navigation(#[from] navigation::Error),
    #[error(transparent)]
    Cancelled(#[from] cancel::Cancelled),
    #[error("threshold {value:e} must be greater than 0 and at most {MAX_THRESHOLD:e}")]
    Threshold { value: f64 },
    #[error("{count} thresholds were given; give 1 to {most}")]
    ThresholdCount { count: usize, most: usize },
    #[error(
        "'{navigator}' is fitted on training pairs, and the split '{split}' leaves none in this room; \
         use the in-sample variant or another split"
    )]
    NothingToFitOn {
        navigator: String,
        split: splits::Split,
    },
    #[error("no candidate frame is left for source frame {source_frame}")]
    NoCandidates { source_frame: room::FrameId },
    #[error("no predictions were given")]
    NoPredictions,
    #[error("prediction {position}: {problem}")]
    Prediction {
        position: usize,
        problem: Box<Error>,
    },
    #[error("the retrieved frame {frame} is not a candidate under the split '{split}'")]
    NotACandidate {
        frame: room::FrameId,
        split: splits::Split,
    },
    #[error(
        "the retrieved frame {frame} is excluded: it is too close to the source, or to the frame that the last step started from"
    )]
    Excluded { frame: room::FrameId },
    #[error("({source_frame}, {target_frame}) is not a test pair under the split '{split}'")]
    NotATestPair {
        source_frame: room::FrameId,
        target_frame: room::FrameId,
        split: splits::Split,
    },
    #[error("predictions must be all latents or all retrieved frames, not a mixture")]
    MixedPredictions,
}

/// Maximum ε of Hit@ε.
pub const MAX_THRESHOLD: f64 = 1e6;

/// Maximum number of thresholds in one report.
pub const MAX_THRESHOLDS: usize = 256;

/// Validates the thresholds ε of Hit@ε.
///
/// # Errors
/// [`Error::ThresholdCount`] for no threshold or more than [`MAX_THRESHOLDS`]; [`Error::Threshold`]
/// for one that is NaN, not above 0, or above [`MAX_THRESHOLD`].
pub fn check_thresholds(thresholds: &[f64]) -> Result<(), Error> {
    if thresholds.is_empty() || thresholds.len() > MAX_THRESHOLDS {
        return Err(Error::ThresholdCount {
            count: thresholds.len(),
            most: MAX_THRESHOLDS,
        });
    }

    match thresholds
        .iter()
        .find(|value| !(**value > 0.0 && **value <= MAX_THRESHOLD))
    {
        Some(&value) => Err(Error::Threshold { value }),
        None => Ok(()),
    }
}

/// The paper's thresholds.
pub fn default_thresholds() -> Vec<f64> {
    navigation::HIT_THRESHOLDS.to_vec()
}
