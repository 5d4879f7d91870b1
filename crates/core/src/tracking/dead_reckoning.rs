//! Dead reckoning: the motion that the views say the camera made since the last keyframe, and where
//! it leads.
//!
//! Motions are read without the mean training motion μ: a camera that stands still must not drift.

use nalgebra::Matrix6;
use ndarray::{ArrayView1, s};

use super::Belief;
use super::health::Continuity;
use super::state::{Observation, State};
use super::tracker::Tracker;
use crate::geometry::{Pose, Twist, body_twist};

/// The deviation of a stream's own origin, metres and radians: it is zero by definition, but a
/// covariance has to be positive definite.
const ORIGIN_DEVIATION: f64 = 1e-6;

/// How much of the motion before a frame was seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MotionReading {
    /// All of it.
    Complete,
    /// Frames of it are missing, but the view after them matches the map, where latents are known
    /// to be read well.
    Partial,
    /// Nothing that can be relied on: the view jumped, or a gap led away from the map.
    Unseen,
}

impl MotionReading {
    pub(super) fn of(continuity: Continuity, matches_room: bool) -> Self {
        match continuity {
            Continuity::Continuous => Self::Complete,
            Continuity::Gap if matches_room => Self::Partial,
            Continuity::Gap | Continuity::Jump => Self::Unseen,
        }
    }
}

/// An earlier frame that a motion is read from.
#[derive(Clone, Copy)]
pub(super) struct EarlierView<'a> {
    pub latent: &'a [f64],
    pub sequence: u64,
}

/// The poses of a stream at one frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Poses {
    /// `odom_from_camera`.
    pub odom: Belief,
    /// `map_from_camera` as the filter believes it.
    pub map_pose: Option<Belief>,
    /// `map_from_camera` as it is reported.
    pub reported_pose: Option<Belief>,
}

/// A motion since the keyframe, the covariance of its error, and where it leads.
pub(super) struct Prediction {
    pub motion: Twist,
    pub covariance: Matrix6<f64>,
    pub poses: Poses,
}

impl Tracker {
    /// The motion from the keyframe to this frame, and the poses that it leads to.
    pub(super) fn predict(
        &self,
        state: &State,
        frame: &Observation,
        reading: MotionReading,
    ) -> Prediction {
        let Some(keyframe) = &state.keyframe else {
            // The first frame is the origin of `odom`.
            let odom = Belief::known(Pose::identity(), ORIGIN_DEVIATION, ORIGIN_DEVIATION);
            return Prediction {
                motion: Twist::default(),
                covariance: odom.covariance,
                poses: Poses {
                    odom,
                    map_pose: state.initial_pose,
                    reported_pose: state.initial_pose,
                },
            };
        };

        let from = EarlierView {
            latent: &keyframe.latent,
            sequence: keyframe.sequence,
        };
        let (mut motion, mut covariance) = self.motion_between(state.room, from, frame);

        if reading != MotionReading::Complete || state.health.is_lost() {
            covariance += self.error_model.unread_errors();
        }

        // A motion that was not seen cannot be read from the views at its ends: the camera is taken
        // to be where it was at the last frame, with the errors of any motion.
        if reading == MotionReading::Unseen {
            let last_odom = state
                .last
                .as_ref()
                .map_or(keyframe.odom.pose, |last| last.odom.pose);
            motion = body_twist(&keyframe.odom.pose, &last_odom);
        }

        let carried = |belief: &Belief| belief.moved(motion, &covariance);
        Prediction {
            motion,
            covariance,
            poses: Poses {
                odom: carried(&keyframe.odom),
                map_pose: keyframe.map_pose.as_ref().map(carried),
                reported_pose: keyframe.reported_pose.as_ref().map(carried),
            },
        }
    }

    /// The motion from an earlier view to this frame, and the covariance of its error.
    pub(super) fn motion_between(
        &self,
        room: Option<usize>,
        from: EarlierView<'_>,
        to: &Observation,
    ) -> (Twist, Matrix6<f64>) {
        let latent = ArrayView1::from(from.latent);
        let coordinates = s![..self.adapter().coordinate_count()];
        let difference = &to.latent.slice(coordinates) - &latent.slice(coordinates);

        // In a known room the errors are those that its own frames showed.
        let errors = room.map_or(&self.error_model.statistics().motion_errors, |room| {
            self.maps[room].motion_errors()
        });
        let squared_length = self.error_model.spread_length(difference.view());
        let frames = to.sequence.saturating_sub(from.sequence);
        let covariance = errors.at(squared_length, frames);

        let motion = self.adapter().motion_without_mean(latent, to.latent.view());
        if motion.is_unique_logarithm() {
            return (motion, covariance);
        }

        // No camera turns by half between two frames that are compared: nothing was read.
        let covariance = covariance + self.error_model.unread_errors();
        (Twist::default(), covariance)
    }
}
