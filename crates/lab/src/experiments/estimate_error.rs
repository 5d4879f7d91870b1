//! The error of one estimate, for files from which others can resample.

use seese3_core::geometry::PoseError;
use seese3_core::room::FrameId;

/// The error of one estimated pose or motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimateError {
    /// The method, by its key in the JSON record.
    pub method: &'static str,
    /// The frame that a motion starts from; `None` for the pose of a single view.
    pub source: Option<FrameId>,
    /// The frame that a motion ends at, or the located view.
    pub target: FrameId,
    /// The error; `None` if the method gave no answer.
    pub error: Option<PoseError>,
    /// Squared Mahalanobis length of the error, of six degrees of freedom; NaN without a covariance.
    pub squared_length: f64,
}
