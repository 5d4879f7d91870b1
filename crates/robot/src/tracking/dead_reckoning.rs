//! Dead reckoning: predicts the poses of a frame from the motion since the keyframe and the place.
//!
//! Motions are predicted without the mean training motion μ: a camera at rest must not drift.

use nalgebra::Matrix6;
use ndarray::{ArrayView1, s};

use super::health::Continuity;
use super::pose_velocity::ReadMotion;
use super::state::{Keyframe, Observation, State};
use super::tracker::Tracker;
use super::{MotionPrior, PoseVelocity, PoseWithCovariance};
use seese3_core::adapter::MotionErrors;
use seese3_core::geometry::{Pose, Twist, adjoint, body_twist, exp};

/// Standard deviation of a stream's origin, meters and radians. The origin is exact by definition,
/// but a covariance must be positive definite.
const ORIGIN_DEVIATION: f64 = 1e-6;

/// Minimum calibrated gain for which predicted motions are used. Below it the motion prior is the
/// better estimate, and the shrinkage would stop the camera.
const LEAST_GAIN: f64 = 0.5;

/// Upper bound of the time in the motion prior, seconds: one day.
const LONGEST_CARRY_S: f64 = 86_400.0;

/// Observability of the motion before a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MotionReading {
    /// The views are continuous.
    Complete,
    /// There is a gap, but the view after it matches the map, where latents are reliable.
    Partial,
    /// No usable views: a jump, a gap that ends away from the map, or a blank or frozen image.
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

/// An earlier frame, the start of a predicted motion.
#[derive(Clone, Copy)]
pub(super) struct EarlierView<'a> {
    pub latent: &'a [f64],
    pub time_ns: i64,
}

/// Input of a prediction from an earlier frame.
struct Carried {
    /// Room of the stream, if known.
    room: Option<usize>,
    from_ns: i64,
    to_ns: i64,
    /// Motion between the frames, if it is usable.
    read: Option<ReadMotion>,
}

/// The poses of a stream at one frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Poses {
    /// `odom_from_camera` and the velocity, from dead reckoning alone.
    pub odom: PoseVelocity,
    /// Filter state: `map_from_camera` and the velocity.
    pub map_pose: Option<PoseVelocity>,
    /// Covariance of the time-correlated error of the last anchor.
    pub lasting: Matrix6<f64>,
    /// Reported `map_from_camera`.
    pub reported_pose: Option<PoseWithCovariance>,
}

/// Motion since the keyframe with the covariance of its error, and the predicted poses.
pub(super) struct Prediction {
    pub motion: Twist,
    pub covariance: Matrix6<f64>,
    pub poses: Poses,
}

impl Tracker {
    /// Predicts the motion from the keyframe to this frame, and the poses at this frame.
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

        // An unobserved motion cannot be predicted from the views. Assume that the camera has not
        // moved since the last frame, with the errors of an arbitrary motion.
        if reading == MotionReading::Unseen {
            let last_odom = state
                .last
                .as_ref()
                .map_or(keyframe.odom.pose, |last| last.odom.pose);
            motion = body_twist(&keyframe.odom.pose, &last_odom);
        }

        // Odometry of another sensor replaces the predicted motion.
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

        // The adjoint transforms the error covariance to the new body frame.
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

    /// Predicts `odom` at this frame: from measured odometry if available, else from the motion
    /// since the keyframe if its gain suffices; else `odom` is unchanged.
    ///
    /// The predicted motion uses a single gain. A gain that depends on the time since the keyframe
    /// would make `odom` lag behind and jump.
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
            // Frames without odometry left `odom` unchanged, and this step spans the gap.
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
            // Once odometry was measured, `odom` contains its steps. A motion predicted from the
            // keyframe would be inconsistent with them.
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

    /// The prediction of the first frame, the origin of `odom`.
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

    /// Predicts the filter state of an earlier frame at a later one, with the motion prior and, if
    /// present, the predicted motion.
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

    /// Predicts the filter state of an earlier frame at this one from measured odometry, without
    /// the motion prior. The velocity is that of the last step.
    fn driven(
        &self,
        belief: &PoseVelocity,
        measured: &ReadMotion,
        state: &State,
        frame: &Observation,
    ) -> PoseVelocity {
        let place = belief.place().moved(measured.motion, &measured.covariance);
        let moving = PoseVelocity::at(place, self.prior(state.room));

        // The step starts at the last frame with odometry, which may not be the last frame.
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

    /// The motion from an earlier view to this frame, predicted by the adapter.
    fn read_motion(
        &self,
        room: Option<usize>,
        from: EarlierView<'_>,
        frame: &Observation,
    ) -> ReadMotion {
        let (motion, covariance) = self.motion_between(room, from, frame);
        ReadMotion { motion, covariance }
    }

    /// Time between two frames in frame periods of the calibration rooms, the unit of the errors.
    pub(super) fn frames_between(&self, from_ns: i64, to_ns: i64) -> u64 {
        self.error_model
            .frames_in(from_ns.abs_diff(to_ns) as f64 * 1e-9)
    }

    /// The motion errors of a room, or the calibrated ones if the room is unknown.
    fn motion_errors(&self, room: Option<usize>) -> &MotionErrors {
        room.map_or(&self.error_model.statistics().motion_errors, |room| {
            self.maps[room].motion_errors()
        })
    }

    /// The motion prior of a room; that of the first map if the room is unknown.
    pub(super) fn prior(&self, room: Option<usize>) -> &MotionPrior {
        self.maps[room.unwrap_or(0)].motion_prior()
    }

    /// The reported pose of a believed one. Its covariance is the filter's, times the map-pose
    /// factor, plus the time-correlated error.
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

    /// Predicts the motion from an earlier view to this frame, with the covariance of its error.
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

        // A half turn between two compared frames is implausible: discard the prediction.
        let covariance = covariance + self.error_model.unread_errors();
        (Twist::default(), covariance)
    }
}
