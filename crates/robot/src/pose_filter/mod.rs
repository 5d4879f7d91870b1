//! A filter on a camera's pose in a map: located poses correct what the motions predict.
//!
//! Start reading at [`PoseFilter::observe`]. A [`crate::front_end`] makes its observations:
//!
//! | source | observation | error |
//! | --- | --- | --- |
//! | view matched by keypoints, or most similar mapped frames | pose in the room | covariance of the pose; a share of it is correlated over motion |
//! | visual odometry, wheels | motion since the last frame | scale and drift are part of the state; the rest is independent |
//! | gravity | tilt | correlated over time |
//! | client | initial pose | as stated |
//!
//! - A filter holds no data of a stream; they are in its [`FilterState`].
//! - A located pose or a tilt beyond its gate counts less. A located pose that contradicts the belief
//!   is not used. Several in a row that agree replace it.
//! - Measured motions replace the motion prior, which smooths the velocity.
//! - `odom_from_camera` composes the motions without the located poses. It is continuous and drifts.

mod belief;
mod gravity;
mod state;
mod saved;
mod status;

pub use belief::Belief;
pub use gravity::MeasuredGravity;
pub use saved::SavedState;
pub use state::{
    Disagreement, FilterCandidate, FilterState, KeyframeMark, LastView, LocatedPose, OdometryMark,
    Source, ViewObservation,
};

use crate::tracking::{Drift, MotionPrior, PoseWithCovariance, Refusal, Status, Update, extent_m};
use crate::visual_odometry::VisualMotion;
use belief::{Observation, Step, twist_covariance};
use gravity::Tilted;
use nalgebra::{Matrix6, Vector6};
use seese3_core::geometry::{Pose, Twist, log};
use seese3_core::room::{FrameId, Room};

/// Parameters of a filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FilterParameters {
    /// Poses of views that are matched by keypoints.
    pub matched: LocatedParameters,
    /// Poses by the most similar mapped frames.
    pub retrieved: LocatedParameters,
    /// Distance, meters, and angle, radians, over which the correlated part of the errors of located
    /// poses decays by a factor e. It is the error of the map in view: a camera at rest does not
    /// average it out.
    pub correlation_range: [f64; 2],
    /// Factor on the process noise of the motion prior: a person turns and stops more abruptly than
    /// a Gaussian process.
    pub process_noise_factor: f64,
    /// Squared Mahalanobis length of an innovation above which a located pose counts less: its
    /// covariance is multiplied by the square of length / gate.
    pub gate: f64,
    /// Squared Mahalanobis length of an innovation above which a located pose is not used.
    pub outlier_gate: f64,
    /// Maximum time between two poses that agree, seconds. After a longer gap, an uncertain belief
    /// needs `views_to_agree` poses again.
    pub max_candidate_s: f64,
    /// Time without a located view and without visual odometry after which a stream is DEGRADED,
    /// seconds.
    pub max_unlocated_s: f64,
    /// Squared Mahalanobis length of a tilt above which gravity counts less.
    pub gravity_gate: f64,
    /// Correlation time of the direction of measured gravity, seconds. Its errors come mostly from
    /// accelerations.
    pub gravity_correlation_s: f64,
    /// Largest standard deviations of the position along any direction, meters, and of the rotation
    /// about any axis, radians, while TRACKING.
    pub max_deviation: [f64; 2],
    /// Independent noise of wheel odometry.
    pub wheel_noise: MotionNoise,
    /// Independent noise of visual odometry.
    pub visual_noise: MotionNoise,
    /// Factor on the stated covariance of visual odometry, which takes its matches as independent.
    pub visual_design_effect: f64,
    /// Correlation time of the error of the scale of visual odometry, seconds.
    pub visual_scale_time_s: f64,
    /// Time over which the differences of wheel and visual odometry are summed, and for which a stream
    /// is DEGRADED after they contradicted each other, seconds.
    pub disagreement_time_s: f64,
    /// Largest speed of a measured motion, meters and radians per second. A faster one is a restart of
    /// the sensor.
    pub max_speed: [f64; 2],
    /// Number of consecutive identical images after which a stream is DEGRADED.
    pub max_unchanged_frames: u32,
    /// Interval of keyframes, in frames; at least 1.
    pub keyframe_frames: u32,
    /// Motion since the keyframe that triggers a new one, ‖(v, ω)‖, meters and radians mixed.
    pub keyframe_displacement: f64,
    /// Whether located poses are used.
    pub fuse: bool,
}

/// Parameters of located poses from one kind of source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocatedParameters {
    /// Share of the variance of a pose that is correlated from view to view, 0 to 1.
    pub correlated_share: f64,
    /// Number of consecutive poses that must agree to start the tracking, or to replace a pose that
    /// they contradict.
    pub views_to_agree: u32,
}

impl Default for FilterParameters {
    fn default() -> Self {
        Self {
            matched: LocatedParameters {
                correlated_share: 0.7,
                views_to_agree: 2,
            },
            retrieved: LocatedParameters {
                correlated_share: 0.7,
                views_to_agree: 10,
            },
            correlation_range: [0.15, 0.15],
            process_noise_factor: 4.0,
            // The 99 % quantile of χ² with six degrees of freedom, and four times that.
            gate: 16.81,
            outlier_gate: 67.24,
            max_candidate_s: 5.0,
            max_unlocated_s: 0.1,
            // The 99 % quantile of χ² with two degrees of freedom.
            gravity_gate: 9.21,
            gravity_correlation_s: 2.0,
            // Errors of 0.2 m and 10° are 2.6 standard deviations: rarer than 1 in 100.
            max_deviation: [0.077, 0.067],
            wheel_noise: MotionNoise::WHEELS,
            visual_noise: MotionNoise::IMAGES,
            visual_design_effect: 10.0,
            visual_scale_time_s: 10.0,
            disagreement_time_s: 1.0,
            max_speed: [10.0, 15.0],
            max_unchanged_frames: 5,
            keyframe_frames: 30,
            keyframe_displacement: f64::INFINITY,
            fuse: true,
        }
    }
}

/// Independent noise of measured motions: standard deviations per axis. Variances grow in proportion
/// to the distance and the angle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionNoise {
    /// At rest, meters and radians.
    pub at_rest: [f64; 2],
    /// Over a distance of 1 m, meters and radians.
    pub over_meter: [f64; 2],
    /// Of the rotation, over an angle of 1 rad, radians.
    pub over_radian: f64,
}

impl MotionNoise {
    /// Noise of wheel odometry, besides its drift.
    pub const WHEELS: Self = Self {
        at_rest: [5e-4, 5e-4],
        over_meter: [1e-2, 5e-3],
        over_radian: 0.0,
    };

    /// Noise of visual odometry, besides the error of its scale.
    pub const IMAGES: Self = Self {
        at_rest: [1e-3, 1e-3],
        over_meter: [5e-2, 2e-2],
        over_radian: 5e-2,
    };

    /// Covariance over a motion, ordered (v, ω).
    pub fn over(&self, motion: &Twist) -> Matrix6<f64> {
        let distance_m = motion.linear.norm();
        let angle_rad = motion.angular.norm();
        let [rest_m, rest_rad] = self.at_rest.map(|deviation| deviation.powi(2));
        let [meter_m, meter_rad] = self.over_meter.map(|deviation| deviation.powi(2));

        let v = rest_m + meter_m * distance_m;
        let w = rest_rad + meter_rad * distance_m + self.over_radian.powi(2) * angle_rad;
        Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w))
    }
}

/// A mapped room, as far as a filter needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct FilterRoom {
    /// Velocity statistics of the camera that mapped the room.
    pub motion_prior: MotionPrior,
    /// Diagonal of the bounding box of the mapped camera positions, meters.
    pub extent_m: f64,
}

impl FilterRoom {
    /// A room with its mapped frames, in order.
    pub fn of(room: &Room, mapped: &[FrameId]) -> Self {
        Self {
            motion_prior: MotionPrior::of_path(room, mapped),
            extent_m: extent_m(room, mapped),
        }
    }
}

/// Tracks cameras in one or more rooms.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseFilter {
    rooms: Vec<FilterRoom>,
    parameters: FilterParameters,
}

/// Measured motions since the last frame.
#[derive(Default)]
struct Motions<'a> {
    /// By wheel odometry, `last_from_this`, with its drift.
    wheels: Option<(Pose, Drift)>,
    visual: Option<&'a VisualMotion>,
    /// Sequence number of the last frame.
    since: Option<u64>,
}

/// A located pose that holds something new.
struct Located<'a> {
    located: &'a LocatedPose,
    /// Number of such poses of the same frame, which together count as one.
    count: f64,
    /// Squared innovation, if there is a belief in its room.
    squared_innovation: Option<f64>,
}

/// What a located pose did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Correction {
    /// It was not used: there is none, or it supports a candidate.
    Unused,
    /// It corrected the step.
    Applied,
    /// It and earlier ones agree on another belief, which is now that of the state.
    Replaced,
}

impl PoseFilter {
    /// A filter for streams in these rooms; `None` without a room.
    pub fn new(rooms: Vec<FilterRoom>, parameters: FilterParameters) -> Option<Self> {
        let is_usable = !rooms.is_empty();
        is_usable.then_some(Self { rooms, parameters })
    }

    /// The parameters.
    pub fn parameters(&self) -> &FilterParameters {
        &self.parameters
    }

    /// The state of a new stream. `initial` is a known pose, `world_from_camera`, in the only room.
    pub fn start(&self, initial: Option<&PoseWithCovariance>) -> FilterState {
        let mut state = FilterState::in_room((self.rooms.len() == 1).then_some(0));
        if let Some(pose) = initial {
            self.set_pose(&mut state, pose);
        }
        state
    }

    /// Sets the pose of the camera at the last frame, `world_from_camera`, in the stream's room.
    /// Nothing changes if the room is not known.
    pub fn set_pose(&self, state: &mut FilterState, pose: &PoseWithCovariance) {
        let Some(room) = state.room else {
            return;
        };
        let belief = Belief::at(pose, &self.rooms[room].motion_prior, 0.0);
        state.belief = Some(belief.with_sensors_of(state.belief.as_ref()));
        state.is_placed = true;
        state.candidate = None;
        state.located_ns = state.last.map(|last| last.time_ns);
        state.sight_ns = state.located_ns;
        state.is_carried = true;
    }

    /// Checks that a frame with this timestamp and number is newer than the last one.
    ///
    /// # Errors
    /// [`Refusal`] if it is not.
    pub fn check(&self, state: &FilterState, time_ns: i64, sequence: u64) -> Result<(), Refusal> {
        state.seconds_to(time_ns, sequence).map(|_| ())
    }

    /// Adds a frame to the stream.
    ///
    /// # Errors
    /// [`Refusal`] if the frame is not newer than the last one. The state is then unchanged.
    pub fn observe(
        &self,
        state: &mut FilterState,
        frame: &ViewObservation,
    ) -> Result<Update, Refusal> {
        let seconds = state.seconds_to(frame.time_ns, frame.sequence)?;
        let is_first = state.last.is_none();
        let last_sequence = state.last.map(|last| last.sequence);
        let wheel_motion = frame.measured.zip(state.wheel_motion_to(frame));
        state.advance(frame);
        state.expire_candidate(frame, self.parameters.max_candidate_s);

        // 1. Predict, by the motion prior of the room, or of the first room while it is unknown, and by
        // the measured motions.
        let prior = &self.rooms[state.room.unwrap_or(0)].motion_prior;
        let belief = state.belief.unwrap_or_else(|| Belief::at_origin(prior));
        let motions = Motions {
            wheels: wheel_motion.map(|(measured, motion)| (motion, measured.drift)),
            visual: frame.visual.as_ref().filter(|_| !is_first),
            since: last_sequence,
        };
        let motions = self.consistent(state, motions, seconds, frame.time_ns);
        let mut step = self.predicted(&belief, prior, seconds, &motions);
        if let Some((motion, _)) = motions.wheels {
            state.wheel_motion = state.wheel_motion.and(log(&motion));
        }
        // After a frame without a motion, the camera may be anywhere. The first image, or an identical
        // one, has no motion to measure.
        let has_no_motion = is_first || state.unchanged_frames > 0;
        // Wheels alone carry a pose that is not to be corrected.
        let is_driven = motions.wheels.is_some() && !self.parameters.fuse;
        state.is_carried &= motions.visual.is_some() || is_driven || has_no_motion;
        if state.is_carried {
            state.sight_ns = Some(frame.time_ns);
        }

        // The odometry composes the measured motions: poses in the map do not move it.
        let motion = step.motion();
        state.odom = state.odom.composed(&motion);

        // 2. Correct by the located views.
        let located = self.located(state, &step, frame);
        let correction = self.correct_by_views(state, &mut step, frame, &motions, &located);

        // 3. Correct the tilt, and make the belief after the step.
        let tilted = match &frame.gravity {
            Some(gravity)
                if self.parameters.fuse
                    && state.is_placed
                    && correction != Correction::Replaced =>
            {
                self.level(state, &mut step, frame, gravity)
            }
            _ => None,
        };

        state.mark_measured(frame);
        let keyframe = state.keyframe_with(frame, &motion, &self.parameters);
        let replaced = state.belief.filter(|_| correction == Correction::Replaced);
        let belief = replaced.unwrap_or_else(|| step.end());
        state.belief = Some(belief);

        // 4. Report.
        let (status, reason) = self.status(state, frame, tilted);
        // A camera that is lost among several rooms has to be found again.
        let is_somewhere = status == Status::Lost && self.rooms.len() > 1;
        Ok(Update {
            motion: log(&keyframe.since.pose),
            motion_covariance: twist_covariance(&keyframe.since),
            keyframe_sequence: keyframe.sequence,
            is_keyframe: state
                .keyframe
                .is_some_and(|now| now.sequence == frame.sequence),
            odom: state.odom_with_drift(),
            map_pose: (state.is_placed && !is_somewhere).then(|| belief.place()),
            velocity: (!is_first).then_some(belief.velocity),
            status,
            reason,
            out_of_distribution: frame.novelty,
            room: state.room.filter(|_| !is_somewhere),
            best_match: frame.best_match,
            match_used: correction != Correction::Unused,
            surprise: located
                .first()
                .and_then(|leading| leading.squared_innovation),
            candidate: state.candidate.as_ref().map(FilterCandidate::reported),
        })
    }

    /// The located poses of a frame that hold something new.
    fn located<'a>(
        &self,
        state: &FilterState,
        step: &Step,
        frame: &'a ViewObservation,
    ) -> Vec<Located<'a>> {
        let is_new = |located: &&LocatedPose| {
            self.parameters.fuse && (state.unchanged_frames == 0 || located.camera.is_some())
        };

        let new: Vec<&LocatedPose> = frame.located.iter().filter(is_new).collect();
        let count = new.len() as f64;
        let judged = |located: &'a LocatedPose| {
            let is_here = state.is_placed && state.room == Some(located.room);
            let squared_innovation =
                is_here.then(|| step.squared_innovation(&self.observed(step, located, count)));
            Located {
                located,
                count,
                squared_innovation,
            }
        };
        new.into_iter().map(judged).collect()
    }

    /// Corrects the step by the located poses of a frame. Only the first one may support a candidate.
    fn correct_by_views(
        &self,
        state: &mut FilterState,
        step: &mut Step,
        frame: &ViewObservation,
        motions: &Motions<'_>,
        located: &[Located<'_>],
    ) -> Correction {
        let Some((leading, others)) = located.split_first() else {
            return Correction::Unused;
        };
        let correction = self.correct(state, step, frame, motions, leading);
        if correction == Correction::Applied {
            for other in others {
                self.apply(step, other);
            }
        }
        correction
    }

    /// Corrects the tilt of a step; returns a contradiction.
    fn level(
        &self,
        state: &mut FilterState,
        step: &mut Step,
        frame: &ViewObservation,
        gravity: &MeasuredGravity,
    ) -> Option<Tilted> {
        let seconds = state.gravity_ns.map_or(f64::INFINITY, |earlier| {
            frame.time_ns.abs_diff(earlier) as f64 * 1e-9
        });
        state.gravity_ns = Some(frame.time_ns);
        gravity.correct(step, seconds, &self.parameters)
    }

    fn parameters_of(&self, source: Source) -> LocatedParameters {
        match source {
            Source::Matched => self.parameters.matched,
            Source::Retrieved => self.parameters.retrieved,
        }
    }

    /// Corrects the step by a pose that does not contradict it; returns whether it did.
    fn apply(&self, step: &mut Step, found: &Located<'_>) -> bool {
        let squared_innovation = found.squared_innovation.unwrap_or(f64::INFINITY);
        let is_consistent = squared_innovation <= self.parameters.outlier_gate;
        if is_consistent {
            // Errors have heavier tails than a Gaussian.
            let factor = (squared_innovation / self.parameters.gate).max(1.0).powi(2);
            let observed = self.observed(step, found.located, found.count);
            step.update(&observed, factor);
        }
        is_consistent
    }

    /// The observation of one of `count` poses that together count as one: they share the correlated
    /// part of the error.
    fn observed(&self, step: &Step, located: &LocatedPose, count: f64) -> Observation<6> {
        let share = self.parameters_of(located.source).correlated_share;
        let observed = step.located(&located.pose, share);
        Observation {
            noise: observed.noise * count,
            ..observed
        }
    }

    /// The motions, without both if wheel and visual odometry contradict each other: wheels slip, or
    /// the images are frozen. A motion that is far from the prior, as after a restart of the wheels, is
    /// left out too.
    fn consistent<'a>(
        &self,
        state: &mut FilterState,
        motions: Motions<'a>,
        seconds: f64,
        time_ns: i64,
    ) -> Motions<'a> {
        let parameters = &self.parameters;
        let is_usual = |motion: &Pose| {
            let Twist { linear, angular } = log(motion);
            linear.norm() <= parameters.max_speed[0] * seconds
                && angular.norm() <= parameters.max_speed[1] * seconds
        };
        let wheels = motions.wheels.filter(|(motion, _)| is_usual(motion));
        let Some(((motion, drift), visual)) = wheels.zip(motions.visual) else {
            return Motions { wheels, ..motions };
        };

        let (driven, seen) = (log(&motion), log(&visual.motion));
        let noise = parameters.wheel_noise.over(&driven) + parameters.visual_noise.over(&seen);
        let scale = drift.translation_share.hypot(visual.scale_deviation);
        let lasting_m = scale * driven.linear.norm().max(seen.linear.norm());
        let lasting_rad = drift.rotation_share * (driven.angular.norm() + driven.linear.norm());
        let lasting = [
            lasting_m,
            lasting_m,
            lasting_m,
            lasting_rad,
            lasting_rad,
            lasting_rad,
        ];
        let variances = noise.diagonal() + Vector6::from(lasting).map(|value| value * value);
        let difference = driven.to_vector() - seen.to_vector();
        let kept = (-seconds / parameters.disagreement_time_s).exp();
        state.disagreement.add(kept, &difference, &variances);

        let is_contradiction = state.disagreement.squared() > parameters.outlier_gate;
        if is_contradiction {
            state.contradicted_ns = Some(time_ns);
            return Motions {
                since: motions.since,
                ..Motions::default()
            };
        }
        Motions { wheels, ..motions }
    }

    /// Predicts a belief some seconds later: by the measured motions or, without any, by the motion
    /// prior. The prior always smooths the velocity.
    fn predicted(
        &self,
        belief: &Belief,
        prior: &MotionPrior,
        seconds: f64,
        motions: &Motions<'_>,
    ) -> Step {
        let mut by_prior = belief.step(prior, seconds, &self.parameters);
        if motions.wheels.is_none() && motions.visual.is_none() {
            return by_prior;
        }

        self.add_motions(&mut by_prior, motions);
        let mut step = belief.measured_step(prior, seconds, &self.parameters);
        self.add_motions(&mut step, motions);
        step.take_velocity(&by_prior);
        step
    }

    fn add_motions(&self, step: &mut Step, motions: &Motions<'_>) {
        if let Some((motion, drift)) = &motions.wheels {
            let observed = step.by_wheels(motion, drift, &self.parameters.wheel_noise);
            step.update(&observed, 1.0);
        }
        if let Some(visual) = motions.visual {
            let observed = step.by_images(visual, &self.parameters);
            step.update(&observed, 1.0);
        }
    }

    /// Corrects the step by the leading located pose.
    ///
    /// Without a belief, or if the pose contradicts it, the pose supports a candidate. The same applies
    /// if no view was located recently and the belief is uncertain, because almost any pose passes the
    /// gate then.
    fn correct(
        &self,
        state: &mut FilterState,
        step: &mut Step,
        frame: &ViewObservation,
        motions: &Motions<'_>,
        leading: &Located<'_>,
    ) -> Correction {
        let parameters = &self.parameters;
        let located = leading.located;
        let earlier = if located.is_of_room {
            state.candidate.take()
        } else {
            None
        };

        let seconds = |since: i64| frame.time_ns.abs_diff(since) as f64 * 1e-9;
        let is_recent = state
            .located_ns
            .is_some_and(|located| seconds(located) <= parameters.max_candidate_s);
        let is_certain = is_recent || step.end().place().tells_a_place();
        if is_certain && self.apply(step, leading) {
            if located.is_of_room {
                state.mark_located(frame.time_ns);
            }
            return Correction::Applied;
        }
        if !located.is_of_room {
            return Correction::Unused;
        }

        let LocatedParameters {
            correlated_share,
            views_to_agree: needed,
        } = self.parameters_of(located.source);
        let (belief, agreeing) = earlier
            .and_then(|candidate| self.supported(&candidate, frame, motions, located))
            .unwrap_or_else(|| {
                let prior = &self.rooms[located.room].motion_prior;
                (Belief::at(&located.pose, prior, correlated_share), 1)
            });
        if agreeing >= needed {
            state.belief = Some(belief.with_sensors_of(state.belief.as_ref()));
            state.room = Some(located.room);
            state.is_placed = true;
            state.mark_located(frame.time_ns);
            return Correction::Replaced;
        }

        state.candidate = Some(FilterCandidate {
            room: located.room,
            time_ns: frame.time_ns,
            sequence: frame.sequence,
            belief,
            agreeing,
            needed,
        });
        Correction::Unused
    }

    /// The belief of a candidate that a later pose agrees with, and how many do.
    fn supported(
        &self,
        candidate: &FilterCandidate,
        frame: &ViewObservation,
        motions: &Motions<'_>,
        located: &LocatedPose,
    ) -> Option<(Belief, u32)> {
        let parameters = &self.parameters;
        let seconds = frame.time_ns.abs_diff(candidate.time_ns) as f64 * 1e-9;
        if candidate.room != located.room || seconds > parameters.max_candidate_s {
            return None;
        }

        let prior = &self.rooms[candidate.room].motion_prior;
        // The motions are those since the last frame.
        let is_last = motions.since == Some(candidate.sequence);
        let none = Motions::default();
        let motions = if is_last { motions } else { &none };
        let mut step = self.predicted(&candidate.belief, prior, seconds, motions);
        let observed = self.observed(&step, located, 1.0);
        let agrees = step.squared_innovation(&observed) <= parameters.gate;
        agrees.then(|| {
            step.update(&observed, 1.0);
            (step.end(), candidate.agreeing + 1)
        })
    }
}
