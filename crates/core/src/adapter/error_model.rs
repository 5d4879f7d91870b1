//! An adapter's error model: how large its errors are in rooms that it did not learn from. It is
//! measured once, by [`crate::calibration`], and kept with the adapter; without one nothing is
//! tracked.
//!
//! Start reading at [`ErrorStatistics`], which lists everything that is measured.

use nalgebra::{Cholesky, Matrix6};
use ndarray::{Array2, ArrayView1};

use super::{Error, Whitener};

/// Rows to each side of a frame that are near it because the camera had no time to move away, and
/// not because it came back.
pub const TEMPORAL_NEIGHBOURS: u32 = 10;
/// How many of the last frames a jump of the view is told by.
pub const JUMP_WINDOW: usize = 5;

/// Covariances of errors, tabulated by one number that predicts how large they are: the distance of
/// a match, or the frames that a motion takes.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorTable {
    strata: Vec<Stratum>,
}

/// Errors where the predicting number is about `at`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stratum {
    /// The predicting number, above 0.
    pub at: f64,
    /// The share of a reading to be believed, from 0 to 1: the slope of the regression of truth on
    /// reading.
    pub gain: f64,
    /// The covariance of errors on (v, ω), metres and radians; positive definite.
    pub covariance: Matrix6<f64>,
}

impl Stratum {
    fn is_sound(&self) -> bool {
        let asymmetry = (self.covariance - self.covariance.transpose()).amax();
        let is_symmetric = asymmetry <= 1e-9 * self.covariance.amax();

        self.at.is_finite()
            && self.at > 0.0
            && self.gain.is_finite()
            && is_symmetric
            && Cholesky::new(self.covariance).is_some()
    }
}

impl ErrorTable {
    /// A table of strata, from the smallest predicting number to the largest.
    ///
    /// # Errors
    /// [`Error::ErrorModel`] when there is no stratum, one is not sound, or they do not rise.
    pub fn new(strata: Vec<Stratum>) -> Result<Self, Error> {
        let is_rising = strata.windows(2).all(|pair| pair[0].at < pair[1].at);
        if strata.is_empty() || !is_rising || !strata.iter().all(Stratum::is_sound) {
            return Err(Error::ErrorModel {
                what: "an error table",
            });
        }

        Ok(Self { strata })
    }

    /// The strata, from the smallest predicting number to the largest.
    pub fn strata(&self) -> &[Stratum] {
        &self.strata
    }

    /// The errors where the predicting number is `at`: interpolated by its logarithm between two
    /// strata, and the outermost stratum's outside of them.
    pub fn at(&self, at: f64) -> Stratum {
        let first = self.strata[0];
        let last = self.strata[self.strata.len() - 1];

        // A number that is not one is answered with the largest errors, the safe answer.
        if at.is_nan() || at >= last.at {
            return last;
        }
        if at <= first.at {
            return first;
        }

        let above = self.strata.partition_point(|stratum| stratum.at <= at);
        let low = self.strata[above - 1];
        let high = self.strata[above];
        let share = (at / low.at).ln() / (high.at / low.at).ln();

        Stratum {
            at,
            gain: low.gain + share * (high.gain - low.gain),
            // A weighted mean of two positive definite matrices is positive definite.
            covariance: low.covariance * (1.0 - share) + high.covariance * share,
        }
    }
}

/// Covariances of read motions, Σ = (u + u₀) S(n).
///
/// They grow with the squared length u of the latents' difference (fitted exponents are 1 within a
/// few hundredths), and with the number n of frames that the motion takes, since over few frames u
/// is mostly noise.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionErrors {
    /// S by the number of frames, 1 or more; on (v, ω), metres and radians.
    pub shapes: ErrorTable,
    /// u₀, above 0, in the unit of u: what is added so that a camera that stands still has errors
    /// too.
    pub floor: f64,
}

impl MotionErrors {
    /// The covariance of a motion over `frames` frames, read from latents whose difference has the
    /// squared length `squared_length` (u).
    pub fn at(&self, squared_length: f64, frames: u64) -> Matrix6<f64> {
        let shape = self.shapes.at(frames.max(1) as f64).covariance;
        shape * (squared_length + self.floor)
    }

    /// The share of a motion over `frames` frames to be believed as it was read.
    pub fn gain(&self, frames: u64) -> f64 {
        self.shapes.at(frames.max(1) as f64).gain
    }

    /// The covariance of a motion over as many frames as were measured at most.
    fn over_longest(&self, squared_length: f64) -> Matrix6<f64> {
        self.shapes.at(f64::INFINITY).covariance * (squared_length + self.floor)
    }
}

/// Everything that calibration measures of an adapter's errors, in rooms that it did not learn
/// from.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorStatistics {
    /// The time from one frame to the next in the rooms that this was measured in, seconds: the mean of
    /// their medians. What is said of a number of frames holds for so many times this time.
    pub frame_period_s: f64,
    /// Frame noise: half the second moment of the differences of latents from one frame to the
    /// next, shape (c, c). It holds the camera's own motion over one frame as well as noise.
    pub frame_noise: Array2<f64>,
    /// Motion spread: the second moment of the differences of latents over motions of one frame up
    /// to the longest stride that the adapter was trained on, shape (c, c).
    pub motion_spread: Array2<f64>,
    /// Errors of read motions; u is measured in `motion_spread`.
    pub motion_errors: MotionErrors,
    /// Errors of a pose read from a matching frame, by the match's distance in `frame_noise`.
    pub anchor_errors: ErrorTable,
    /// A match whose distance is more than this many times the room's typical distance shows
    /// another place.
    pub out_of_distribution_ratio: f64,
    /// A match whose distance is at most this many times the room's typical distance certainly
    /// shows this room: hardly any frame of another room comes so near.
    pub certain_match_ratio: f64,
    /// A view further than this, in `frame_noise`, from each of the last [`JUMP_WINDOW`] frames has
    /// jumped; where more time has passed than `frame_period_s`, than this times the cube root of how
    /// many times that is.
    pub jump_distance: f64,
    /// The reported covariance of a corrected map pose is that of its anchor times this factor.
    pub map_pose_factor: f64,
}

/// An adapter's error model, checked and ready to be asked.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorModel {
    statistics: ErrorStatistics,
    frame_noise: Whitener,
    motion_spread: Whitener,
}

impl ErrorModel {
    /// Checks what was measured.
    ///
    /// # Errors
    /// [`Error::ErrorModel`], which names what is not sound.
    pub fn new(statistics: ErrorStatistics) -> Result<Self, Error> {
        let frame_noise = Whitener::new(statistics.frame_noise.view())?;
        let motion_spread = Whitener::new(statistics.motion_spread.view())?;
        if frame_noise.size() != motion_spread.size() {
            return Err(Error::ErrorModel {
                what: "the size of a covariance of latents",
            });
        }

        let positive = [
            ("the time between frames", statistics.frame_period_s),
            ("the floor of motions", statistics.motion_errors.floor),
            ("the factor of map poses", statistics.map_pose_factor),
            (
                "the out-of-distribution limit",
                statistics.out_of_distribution_ratio,
            ),
            (
                "the limit of certain matches",
                statistics.certain_match_ratio,
            ),
            ("the distance of a jump", statistics.jump_distance),
        ];
        for (what, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::ErrorModel { what });
            }
        }

        Ok(Self {
            statistics,
            frame_noise,
            motion_spread,
        })
    }

    /// What was measured.
    pub fn statistics(&self) -> &ErrorStatistics {
        &self.statistics
    }

    /// The whitener of frame noise: distances of matches are taken in it.
    pub fn frame_noise(&self) -> &Whitener {
        &self.frame_noise
    }

    /// The covariance of a motion over `frames` frames, read from a difference of latents, shape
    /// (c,).
    pub fn motion_errors(&self, difference: ArrayView1<'_, f64>, frames: u64) -> Matrix6<f64> {
        self.statistics
            .motion_errors
            .at(self.motion_spread.squared_length(difference), frames)
    }

    /// The squared length u of a difference of latents, shape (c,), in the motion spread.
    pub fn spread_length(&self, difference: ArrayView1<'_, f64>) -> f64 {
        self.motion_spread.squared_length(difference)
    }

    /// How many frames of the rooms that this was measured in a time takes, seconds; at least 1.
    pub fn frames_in(&self, seconds: f64) -> u64 {
        (seconds / self.statistics.frame_period_s).round().max(1.0) as u64
    }

    /// The most frames that the errors of motions were measured over.
    pub fn longest_frames(&self) -> f64 {
        let strata = self.statistics.motion_errors.shapes.strata();
        strata[strata.len() - 1].at
    }

    /// The covariance of a motion of which nothing is known but that the adapter was trained for
    /// such motions.
    pub fn unread_errors(&self) -> Matrix6<f64> {
        // The mean squared length of a difference under its own second moment is the number of its
        // columns.
        self.statistics
            .motion_errors
            .over_longest(self.motion_spread.size() as f64)
    }

    /// Errors of a pose read from a match at a distance in frame noise.
    pub fn anchor_errors(&self, distance: f64) -> Stratum {
        self.statistics.anchor_errors.at(distance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stratum(at: f64, variance: f64) -> Stratum {
        Stratum {
            at,
            gain: at,
            covariance: Matrix6::from_diagonal_element(variance),
        }
    }

    /// Oracle: by hand: half way between 1 and 100 by the logarithm is 10.
    #[test]
    fn errors_between_strata_are_between_theirs() {
        let table = ErrorTable::new(vec![stratum(1.0, 2.0), stratum(100.0, 4.0)]).unwrap();
        for (at, expected) in [
            (0.0, 2.0),
            (1.0, 2.0),
            (10.0, 3.0),
            (100.0, 4.0),
            (1e9, 4.0),
            (f64::NAN, 4.0),
        ] {
            assert!(
                (table.at(at).covariance[(2, 2)] - expected).abs() < 1e-12,
                "{at}"
            );
        }

        for wrong in [
            vec![],
            vec![stratum(2.0, 1.0), stratum(1.0, 1.0)],
            vec![stratum(1.0, 0.0)],
        ] {
            assert!(ErrorTable::new(wrong).is_err());
        }
    }
}
