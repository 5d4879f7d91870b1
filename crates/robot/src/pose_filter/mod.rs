//! A filter on a camera's pose in a map: located poses correct what the motions predict.
//!
//! Start reading at [`PoseFilter::observe`]. A [`crate::front_end`] makes its observations:
//!
//! | source | observation | error |
//! | --- | --- | --- |
//! | view matched by keypoints, or most similar mapped frames | pose in the room | covariance of the pose; a share of it is correlated over motion |
//! | visual odometry, wheels | motion since the last frame | scale and drift are part of the state; the rest is independent |
//! | gyroscope, accelerometer | motion and velocity, instead of the motion prior | biases are part of the state; the rest is independent |
//! | gravity | tilt | correlated over time |
//! | client | initial pose | as stated |
//!
//! - A filter holds no data of a stream; they are in its [`FilterState`].
//! - A located pose or a tilt beyond its gate counts less. A located pose that contradicts the
//!   belief is not used. Several in a row that agree replace it.
//! - Measured motions replace the motion prior, which smooths the velocity.
//! - `odom_from_camera` composes the motions without located poses. It is continuous and drifts.

mod belief;
mod contradiction;
mod gravity;
mod inertia;
mod parameters;
mod state;
mod saved;
mod status;

pub use belief::Belief;
pub use contradiction::{Contradicted, Disagreements};
pub use gravity::MeasuredGravity;
pub use inertia::MeasuredInertia;
pub use parameters::{FilterParameters, MotionNoise, ParameterError};
pub use saved::SavedState;
pub use state::{
    FilterCandidate, FilterState, KeyframeMark, LastView, LocatedPose, OdometryMark, Source,
    ViewObservation,
};

use crate::tracking::{
    Drift, MeasuredPose, MotionPrior, PoseWithCovariance, Refusal, Status, Update, extent_m,
};
use crate::visual_odometry::VisualMotion;
use belief::{Observation, Step};
use gravity::Tilted;
use nalgebra::Matrix6;
use seese3_core::geometry::{Pose, Twist, log, twist_covariance};
use seese3_core::room::{FrameId, Room};

/// Least variance of the independent noise of wheel odometry, squared meters and radians.
const LEAST_VARIANCE: f64 = 1e-10;

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

/// The motion since the last frame by wheel odometry.
#[derive(Clone, Copy)]
struct WheelMotion {
    /// `last_from_this`.
    motion: Pose,
    drift: Drift,
    /// Covariance of its independent noise, on (v, ω).
    noise: Matrix6<f64>,
}

impl WheelMotion {
    fn of(
        measured: &MeasuredPose,
        motion: Pose,
        seconds: f64,
        parameters: &FilterParameters,
    ) -> Self {
        let noise = measured.velocity_covariance.map_or_else(
            || parameters.wheel_noise.over(&log(&motion)),
            |covariance| covariance * seconds.powi(2) + Matrix6::identity() * LEAST_VARIANCE,
        );
        Self {
            motion,
            drift: measured.drift,
            noise,
        }
    }
}

/// Measured motions since the last frame.
#[derive(Default)]
struct Motions<'a> {
    wheels: Option<WheelMotion>,
    visual: Option<&'a VisualMotion>,
    inertia: Option<MeasuredInertia>,
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

    /// The filter with other parameters.
    #[must_use]
    pub fn with_parameters(&self, parameters: FilterParameters) -> Self {
        Self {
            parameters,
            ..self.clone()
        }
    }

    /// The rooms.
    pub fn rooms(&self) -> &[FilterRoom] {
        &self.rooms
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
        state.is_carried = true;
    }

    /// Checks that a frame with this timestamp and number is newer than the last one.
    ///
    /// # Errors
    /// [`Refusal`] if it is not.
    pub fn check(&self, state: &FilterState, time_ns: i64, sequence: u64) -> Result<(), Refusal> {
        state.seconds_to(time_ns, sequence).map(|_| ())
    }

    /// The motion since the last frame without its views: that of wheel odometry, else the rotation
    /// of the gyroscope at the velocity of the stream. `None` without either.
    pub fn sensed_motion(&self, state: &FilterState, frame: &ViewObservation) -> Option<Pose> {
        let contradicted = state.contradicted;
        let seconds = state.seconds_to(frame.time_ns, frame.sequence).ok()?;
        let wheels = state
            .wheel_motion_to(frame)
            .filter(|motion| self.parameters.is_possible(motion, seconds));
        let by_gyroscope = frame.inertia.as_ref().zip(state.belief);
        let by_gyroscope = by_gyroscope.map(|(inertia, belief)| Pose {
            rotation: inertia.motion.rotation,
            translation: (belief.velocity.linear * inertia.motion.seconds).into(),
        });
        wheels
            .filter(|_| !contradicted.wheels)
            .or(by_gyroscope.filter(|_| !contradicted.inertia))
    }

    /// Velocity at the last frame in the camera's body frame, m/s and rad/s, with its covariance.
    /// Before the first frame it is zero, with the covariance of the motion prior.
    pub fn velocity(&self, state: &FilterState) -> (Twist, Matrix6<f64>) {
        let prior = &self.rooms[state.room.unwrap_or(0)].motion_prior;
        state.belief.map_or_else(
            || (Twist::default(), prior.velocity_covariance()),
            |belief| (belief.velocity, belief.velocity_covariance()),
        )
    }

    /// The measured motions since the last frame; none for the first one.
    fn motions<'a>(
        &self,
        state: &FilterState,
        frame: &'a ViewObservation,
        seconds: f64,
    ) -> Motions<'a> {
        let Some(last) = state.last else {
            return Motions::default();
        };
        let wheels = frame.measured.zip(state.wheel_motion_to(frame));
        Motions {
            wheels: wheels.map(|(measured, motion)| {
                WheelMotion::of(&measured, motion, seconds, &self.parameters)
            }),
            visual: frame.visual.as_ref(),
            inertia: frame.inertia.clone(),
            since: Some(last.sequence),
        }
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
        let motions = self.motions(state, frame, seconds);
        state.advance(frame);
        state.expire_candidate(frame, self.parameters.max_candidate_s);

        // 1. Predict, by the motion prior of the room, or of the first room while it is unknown,
        // and by the measured motions.
        let prior = &self.rooms[state.room.unwrap_or(0)].motion_prior;
        let belief = state.belief.unwrap_or_else(|| Belief::at_origin(prior));
        let motions = motions.consistent(state, seconds, &self.parameters);
        let step = self.predicted(&belief, state.is_placed, prior, seconds, &motions);
        if let Some(wheels) = &motions.wheels {
            state.wheel_motion = state.wheel_motion.and(log(&wheels.motion));
        }
        // After a frame without a motion, the camera may be anywhere. The first image, or an
        // identical one, has no motion to measure.
        let has_no_motion = is_first || state.unchanged_frames > 0;
        // Wheels alone carry a pose that is not to be corrected, or if they are trusted.
        let is_driven =
            motions.wheels.is_some() && (!self.parameters.fuse || self.parameters.trust_wheels);
        state.is_carried &= motions.visual.is_some() || is_driven || has_no_motion;

        // The odometry composes the measured motions: poses in the map do not move it.
        let motion = step.motion();
        state.odom = state.odom.composed(&motion);

        // 2. Correct by the located views.
        let (mut step, located) = self.judged(state, &belief, step, frame, seconds, &motions);
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
        let motion = log(&keyframe.since.pose);
        Ok(Update {
            motion,
            motion_covariance: twist_covariance(&motion, &keyframe.since.covariance),
            keyframe_sequence: keyframe.sequence,
            is_keyframe: state
                .keyframe
                .is_some_and(|now| now.sequence == frame.sequence),
            odom: state.odom_with_drift(),
            map_pose: (state.is_placed && !is_somewhere).then(|| belief.place()),
            velocity: (!is_first).then_some(belief.velocity),
            velocity_covariance: belief.velocity_covariance(),
            status,
            reason,
            contradicted: state.contradicted_sensors(tilted),
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

    /// The located poses of a frame, with their innovations for a step. If keypoints locate the
    /// leading view, and it is an outlier only by visual odometry, returns the step without that.
    fn judged<'a>(
        &self,
        state: &FilterState,
        belief: &Belief,
        step: Step,
        frame: &'a ViewObservation,
        seconds: f64,
        motions: &Motions<'_>,
    ) -> (Step, Vec<Located<'a>>) {
        let located = self.located(state, &step, frame);
        let is_certain = located.first().is_some_and(|leading| {
            leading.located.source == Source::Matched && leading.located.is_of_room
        });
        let is_outlier = is_certain
            && motions.visual.is_some()
            && leading_innovation(&located) > self.parameters.outlier_gate
            && state.is_located_within(self.parameters.max_candidate_s);
        if !is_outlier {
            return (step, located);
        }

        let prior = &self.rooms[state.room.unwrap_or(0)].motion_prior;
        let others = motions.without_images();
        let by_others = self.predicted(belief, state.is_placed, prior, seconds, &others);
        let located_by_others = self.located(state, &by_others, frame);
        if leading_innovation(&located_by_others) <= self.parameters.gate {
            (by_others, located_by_others)
        } else {
            (step, located)
        }
    }

    /// The located poses of a frame that hold something new, judged by a step.
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

    /// Corrects the step by the located poses of a frame. Only the first may support a candidate.
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

    /// The observation of one of `count` poses that together count as one: they share the
    /// correlated part of the error.
    fn observed(&self, step: &Step, located: &LocatedPose, count: f64) -> Observation<6> {
        let share = self.parameters.correlated_share;
        let observed = step.located(&located.pose, share);
        Observation {
            noise: observed.noise * count,
            ..observed
        }
    }

    /// Predicts a belief some seconds later: by the measured motions or, without any, by the motion
    /// prior. The prior smooths the velocity, unless an accelerometer measures how it changes.
    /// `is_in_map`: whether the belief is in a room. Only there the direction of gravity is known.
    fn predicted(
        &self,
        belief: &Belief,
        is_in_map: bool,
        prior: &MotionPrior,
        seconds: f64,
        motions: &Motions<'_>,
    ) -> Step {
        let inertia = motions.inertia.clone().map(|inertia| MeasuredInertia {
            down_in_parent: inertia.down_in_parent.filter(|_| is_in_map),
            ..inertia
        });
        let inertia = inertia.as_ref();
        let mut by_prior = belief.step(prior, seconds, inertia, &self.parameters);
        if motions.wheels.is_none() && motions.visual.is_none() {
            return by_prior;
        }

        self.add_motions(&mut by_prior, seconds, motions);
        if inertia.is_some_and(|inertia| inertia.down_in_parent.is_some()) {
            return by_prior;
        }
        let mut step = belief.measured_step(prior, seconds, inertia, &self.parameters);
        self.add_motions(&mut step, seconds, motions);
        step.take_velocity(&by_prior);
        step
    }

    fn add_motions(&self, step: &mut Step, seconds: f64, motions: &Motions<'_>) {
        if let Some(wheels) = &motions.wheels {
            let observed = step.by_wheels(&wheels.motion, &wheels.drift, &wheels.noise);
            step.update(&observed, 1.0);
        }
        if let Some(visual) = motions.visual {
            let observed = step.by_images(visual, seconds, &self.parameters);
            step.update(&observed, 1.0);
        }
    }

    /// Corrects the step by the leading located pose.
    ///
    /// Without a belief, or if the pose contradicts it, the pose supports a candidate. The same
    /// applies if no view was located recently and the belief is uncertain, because almost any pose
    /// passes the gate then.
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

        let is_certain = state.is_located_within(parameters.max_candidate_s)
            || step.end().place().tells_a_place();
        if is_certain && self.apply(step, leading) {
            if located.is_of_room {
                state.mark_located(frame.time_ns);
            }
            return Correction::Applied;
        }
        if !located.is_of_room {
            return Correction::Unused;
        }

        let [of_matched, of_retrieved] = parameters.views_to_agree;
        let needed = match located.source {
            Source::Matched => of_matched,
            Source::Retrieved => of_retrieved,
        };
        let supported =
            earlier.and_then(|candidate| self.supported(&candidate, frame, motions, located));
        let is_of_same_room = earlier.is_some_and(|earlier| earlier.room == located.room);
        let contradicts_last = is_of_same_room && supported.is_none();
        let (belief, agreeing) = supported.unwrap_or_else(|| {
            let prior = &self.rooms[located.room].motion_prior;
            let share = parameters.correlated_share;
            (Belief::at(&located.pose, prior, share), 1)
        });
        let is_driven = parameters.trust_wheels && state.is_placed && motions.wheels.is_some();
        if agreeing >= needed && !is_driven {
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
            contradicts_last,
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
        let mut step = self.predicted(&candidate.belief, true, prior, seconds, motions);
        let observed = self.observed(&step, located, 1.0);
        let agrees = step.squared_innovation(&observed) <= parameters.gate;
        agrees.then(|| {
            step.update(&observed, 1.0);
            (step.end(), candidate.agreeing + 1)
        })
    }
}

/// Squared innovation of the leading located pose; 0 without one.
fn leading_innovation(located: &[Located<'_>]) -> f64 {
    let leading = located.first();
    leading.map_or(0.0, |found| found.squared_innovation.unwrap_or(0.0))
}
