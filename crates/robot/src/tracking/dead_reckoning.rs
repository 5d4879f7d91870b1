//! Dead reckoning: the motion that the views say the camera made since the last keyframe, and where
//! it leads.
//!
//! Motions are read without the mean training motion μ: a camera that stands still must not drift.

use nalgebra::Matrix6;
use ndarray::{ArrayView1, s};

use super::health::Continuity;
use super::pose_velocity::ReadMotion;
use super::state::{Keyframe, Observation, State};
use super::tracker::Tracker;
use super::{MotionPrior, PoseVelocity, PoseWithCovariance};
use seese3_core::adapter::MotionErrors;
use seese3_core::geometry::{Pose, Twist, adjoint, body_twist, exp};

/// The deviation of a stream's own origin, metres and radians: it is zero by definition, but a
/// covariance has to be positive definite.
const ORIGIN_DEVIATION: f64 = 1e-6;

/// Motions are read only where calibration found that at least this share of a reading is to be
/// believed: with less, how cameras move tells more, and a reading that shrinks every motion would
/// stop the camera.
const LEAST_GAIN: f64 = 0.5;

/// Longer pauses than this say no more of where a camera may be, seconds: a day.
const LONGEST_CARRY_S: f64 = 86_400.0;

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
    pub time_ns: i64,
}

/// How a belief comes to a frame.
struct Carried {
    /// The room that the stream is in, if that is known.
    room: Option<usize>,
    from_ns: i64,
    to_ns: i64,
    /// The motion in between, if it is read.
    read: Option<ReadMotion>,
}

/// The poses of a stream at one frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Poses {
    /// `odom_from_camera` and the velocity as readings alone tell it.
    pub odom: PoseVelocity,
    /// `map_from_camera` and the velocity as the filter believes them.
    pub map_pose: Option<PoseVelocity>,
    /// The covariance of the lasting error of the anchor that corrected the map pose last.
    pub lasting: Matrix6<f64>,
    /// `map_from_camera` as it is reported.
    pub reported_pose: Option<PoseWithCovariance>,
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
            return self.origin(state);
        };

        let from = EarlierView {
            latent: &keyframe.latent,
            time_ns: keyframe.time_ns,
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

        // What another sensor measured needs no view.
        if let Some(measured) = state
            .measured
            .motion_since_keyframe(frame.measured.as_ref())
        {
            motion = measured.motion;
            covariance = measured.covariance;
        }

        let odom = self.carried_odom(state, keyframe, frame, reading);
        let errors = self.motion_errors(state.room);
        let map_pose = state.place.as_ref().map(|place| {
            let from = place.latent.as_ref().map(|latent| EarlierView {
                latent,
                time_ns: place.time_ns,
            });
            let frames = self.frames_between(place.time_ns, frame.time_ns);
            let is_worth_it = errors.gain(frames) >= LEAST_GAIN;
            let is_read = is_worth_it && reading == MotionReading::Complete;

            if let Some(measured) = state.measured.motion_since_place(frame.measured.as_ref()) {
                return self.driven(&place.belief, &measured, state, frame);
            }
            let way = Carried {
                room: state.room,
                from_ns: place.time_ns,
                to_ns: frame.time_ns,
                read: from
                    .filter(|_| is_read)
                    .map(|from| self.read_motion(state.room, from, frame)),
            };
            self.carried(&place.belief, way)
        });

        // An error is carried to the new body frame by the adjoint of the motion since then.
        let lasting = state.place.as_ref().zip(map_pose.as_ref());
        let lasting = lasting.map_or_else(Matrix6::zeros, |(place, now)| {
            let back = adjoint(&now.pose.inv_mul(&place.belief.pose));
            back * place.lasting * back.transpose()
        });

        Prediction {
            motion,
            covariance,
            poses: Poses {
                odom,
                lasting,
                reported_pose: match &map_pose {
                    Some(believed) => Some(self.reported(believed, &lasting)),
                    None => keyframe
                        .reported_pose
                        .map(|belief| belief.moved(motion, &covariance)),
                },
                map_pose,
            },
        }
    }

    /// `odom` at this frame: the sum of what was measured, if it was. Else, where readings are worth it,
    /// it is read at every frame and with one gain: with a gain that grows with the time since the
    /// keyframe it would lag behind and jump. Else it stays.
    fn carried_odom(
        &self,
        state: &State,
        keyframe: &Keyframe,
        frame: &Observation,
        reading: MotionReading,
    ) -> PoseVelocity {
        let from = EarlierView {
            latent: &keyframe.latent,
            time_ns: keyframe.time_ns,
        };
        let errors = self.motion_errors(state.room);
        let gain = errors.gain(self.error_model.longest_frames() as u64);
        let is_read = reading == MotionReading::Complete && gain >= LEAST_GAIN;
        if let Some(measured) = state
            .measured
            .motion_since_keyframe(frame.measured.as_ref())
        {
            let odom = self.driven(&keyframe.odom, &measured, state, frame);
            // A frame before that brought no pose has left odom where the views took it.
            let step = state.measured.step(frame.measured.as_ref());
            let last = state
                .last
                .as_ref()
                .map_or(keyframe.odom.pose, |last| last.odom.pose);
            return PoseVelocity {
                pose: last * exp(&step.unwrap_or_default()),
                ..odom
            };
        }

        let way = Carried {
            room: state.room,
            from_ns: keyframe.time_ns,
            to_ns: frame.time_ns,
            read: is_read.then(|| self.read_motion(state.room, from, frame)),
        };
        let mut odom = self.carried(&keyframe.odom, way);
        let read = self
            .adapter()
            .motion_without_mean(ArrayView1::from(from.latent), frame.latent.view());
        odom.pose = match &state.last {
            // Beside measured motions, read ones would be counted from another frame.
            _ if is_read && read.is_unique_logarithm() && state.measured.last.is_none() => {
                keyframe.odom.pose * exp(&read.scaled(gain))
            }
            Some(last) => last.odom.pose,
            None => keyframe.odom.pose,
        };

        if reading != MotionReading::Complete {
            let mut of_pose = odom.covariance.fixed_view_mut::<6, 6>(0, 0);
            of_pose += self.error_model.unread_errors();
        }
        odom
    }

    /// The first frame, which is the origin of `odom`.
    fn origin(&self, state: &State) -> Prediction {
        let origin =
            PoseWithCovariance::known(Pose::identity(), ORIGIN_DEVIATION, ORIGIN_DEVIATION);
        let at = |pose: PoseWithCovariance| PoseVelocity::at(pose, self.prior(state.room));

        Prediction {
            motion: Twist::default(),
            covariance: origin.covariance,
            poses: Poses {
                odom: at(origin),
                map_pose: state.initial_pose.map(at),
                lasting: Matrix6::zeros(),
                reported_pose: state.initial_pose,
            },
        }
    }

    /// A belief of an earlier view at a frame: by how cameras move, and by the motion in between where
    /// one is known.
    fn carried(&self, belief: &PoseVelocity, way: Carried) -> PoseVelocity {
        let Carried {
            room,
            from_ns,
            to_ns,
            read,
        } = way;

        let seconds = (to_ns.abs_diff(from_ns) as f64 * 1e-9).min(LONGEST_CARRY_S);
        belief.moved(self.prior(room), seconds, read.as_ref())
    }

    /// A belief of an earlier frame at this one, by a measured motion alone: how cameras move on average
    /// says nothing beside it. The velocity is that of the last step.
    fn driven(
        &self,
        belief: &PoseVelocity,
        measured: &ReadMotion,
        state: &State,
        frame: &Observation,
    ) -> PoseVelocity {
        let place = belief.place().moved(measured.motion, &measured.covariance);
        let moving = PoseVelocity::at(place, self.prior(state.room));

        // The step is from the last frame that brought a pose, which may not be the last one.
        let step = state.measured.step(frame.measured.as_ref());
        let last_ns = state
            .measured
            .last
            .map_or(frame.time_ns, |last| last.time_ns);
        let seconds = frame.time_ns.abs_diff(last_ns) as f64 * 1e-9;
        match step {
            Some(step) if seconds > 0.0 => PoseVelocity {
                velocity: step.scaled(seconds.recip()),
                ..moving
            },
            _ => moving,
        }
    }

    /// The motion from an earlier view to this frame, as the adapter reads it.
    fn read_motion(
        &self,
        room: Option<usize>,
        from: EarlierView<'_>,
        frame: &Observation,
    ) -> ReadMotion {
        let (motion, covariance) = self.motion_between(room, from, frame);
        ReadMotion { motion, covariance }
    }

    /// How many frames of the calibration rooms a time takes: errors were measured over these.
    pub(super) fn frames_between(&self, from_ns: i64, to_ns: i64) -> u64 {
        self.error_model
            .frames_in(from_ns.abs_diff(to_ns) as f64 * 1e-9)
    }

    /// The errors of motions: in a known room those that its own frames showed.
    fn motion_errors(&self, room: Option<usize>) -> &MotionErrors {
        room.map_or(&self.error_model.statistics().motion_errors, |room| {
            self.maps[room].motion_errors()
        })
    }

    /// How the camera of a room moves; where no room is known, that of the first.
    pub(super) fn prior(&self, room: Option<usize>) -> &MotionPrior {
        self.maps[room.unwrap_or(0)].motion_prior()
    }

    /// A believed map pose as it is reported: with the covariance that such poses were measured to
    /// have.
    pub(super) fn reported(
        &self,
        believed: &PoseVelocity,
        lasting: &Matrix6<f64>,
    ) -> PoseWithCovariance {
        let place = believed.place();
        PoseWithCovariance {
            covariance: place.covariance * self.map_pose_factor + lasting,
            ..place
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

        let errors = self.motion_errors(room);
        let squared_length = self.error_model.spread_length(difference.view());
        let frames = self.frames_between(from.time_ns, to.time_ns);
        let covariance = errors.at(squared_length, frames);

        let read = self.adapter().motion_without_mean(latent, to.latent.view());
        let motion = read.scaled(errors.gain(frames));
        if motion.is_unique_logarithm() {
            return (motion, covariance);
        }

        // No camera turns by half between two frames that are compared: nothing was read.
        let covariance = covariance + self.error_model.unread_errors();
        (Twist::default(), covariance)
    }
}
