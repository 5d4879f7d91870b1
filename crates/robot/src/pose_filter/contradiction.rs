//! Sensors whose motions contradict each other.

use nalgebra::{Matrix3, Rotation3, Vector6};

use super::{FilterParameters, FilterState, MeasuredInertia, Motions, WheelMotion};
use crate::tracking::Sensor;
use crate::visual_odometry::VisualMotion;
use seese3_core::geometry::log;

/// Motion sensors that are contradicted by other sensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Contradicted {
    /// Wheel odometry.
    pub wheels: bool,
    /// Visual odometry.
    pub images: bool,
    /// Gyroscope and accelerometer.
    pub inertia: bool,
}

/// Sums of the differences of two sensors each, and of motions. Resume tokens do not save them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Disagreements {
    /// Differences over each of `disagreement_times_s`. While images and wheels move and agree, the
    /// shorter time is enough: the longer sum is then cleared.
    shorter: Differences,
    longer: Differences,
    /// Motions over the shorter time, or since a contradiction began.
    wheels: UncertainTwist,
    images: UncertainTwist,
    /// Time since the last motion of wheels, seconds; `None` without any.
    since_wheels_s: Option<f64>,
}

/// Sums of the differences of two sensors each.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Differences {
    wheels_images: UncertainTwist,
    inertia_images: UncertainTwist,
    inertia_wheels: UncertainTwist,
}

/// A twist with its errors, or a sum of twists.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct UncertainTwist {
    /// Meters and radians.
    twist: Vector6<f64>,
    /// Variances by independent noise; 0 for components that are not measured.
    variances: Vector6<f64>,
    /// Standard deviations of systematic errors, which add up over the steps.
    lasting: Vector6<f64>,
    /// Variances of the pose errors at the two ends, which do not add up.
    ends: Vector6<f64>,
}

impl UncertainTwist {
    /// The difference of the twists of two sensors with independent errors.
    fn minus(&self, other: &Self) -> Self {
        // Only components that both measure: a gyroscope measures no translation.
        let is_common = |axis: usize| self.variances[axis].min(other.variances[axis]) > 0.0;
        let common = |value: Vector6<f64>| {
            Vector6::from_fn(|axis, _| if is_common(axis) { value[axis] } else { 0.0 })
        };

        // Systematic errors of wheels and images scale with the true motion, here the smaller
        // measured one. If one sensor rests, they are zero. Rotations also drift per meter.
        let whole = |sensor: &Self| sensor.twist.norm();
        let meters = |sensor: &Self| sensor.twist.fixed_rows::<3>(0).norm();
        let share = |of: &Self, norm: fn(&Self) -> f64| {
            norm(self).min(norm(other)) / norm(of).max(f64::MIN_POSITIVE)
        };
        let systematic = |of: &Self| {
            if is_common(0) {
                let shares = each(share(of, meters), share(of, whole));
                of.lasting.component_mul(&shares)
            } else {
                of.lasting
            }
        };

        Self {
            twist: common(self.twist - other.twist),
            variances: common(self.variances + other.variances),
            lasting: common(systematic(self).zip_map(&systematic(other), f64::hypot)),
            ends: common(self.ends + other.ends),
        }
    }

    /// Expresses the sum in the body frame after a motion.
    fn turn(&mut self, motion: &Vector6<f64>) {
        let after_from_before = Rotation3::new(-motion.fixed_rows::<3>(3));
        for part in [0, 3] {
            let turned = after_from_before * self.twist.fixed_rows::<3>(part);
            self.twist.fixed_rows_mut::<3>(part).copy_from(&turned);
        }
    }

    /// Adds the twist of one step. `decay` multiplies the sum so far. With `None`, during a
    /// contradiction, the sum does not decay and gets no more noise, so that rest does not end it.
    ///
    /// Returns the squared length of the sum in standard deviations. If the sum of the true twists
    /// is zero, it is χ² with one degree of freedom per measured component.
    fn add(&mut self, decay: Option<f64>, step: Option<UncertainTwist>) -> f64 {
        let factor = decay.unwrap_or(1.0);
        self.twist *= factor;
        // Without a new twist the noise stays: a silent sensor is forgotten, but not at once.
        if let Some(step) = step {
            self.twist += step.twist;
            self.ends = step.ends;
            if decay.is_some() {
                self.variances = self.variances * factor * factor + step.variances;
                self.lasting = self.lasting * factor + step.lasting;
            }
        }

        let measured = (0..6).filter(|&axis| self.variances[axis] > 0.0);
        measured
            .map(|axis| {
                let variance = self.variances[axis] + self.lasting[axis].powi(2) + self.ends[axis];
                self.twist[axis].powi(2) / variance
            })
            .sum()
    }
}

/// The twists of one step as the sensors measure it.
struct Measured {
    wheels: Option<UncertainTwist>,
    images: Option<UncertainTwist>,
    inertia: Option<UncertainTwist>,
}

impl Differences {
    /// Adds a step. Returns the sensors that the sums contradict.
    fn add(
        &mut self,
        decay: Option<f64>,
        step: &Measured,
        parameters: &FilterParameters,
    ) -> Contradicted {
        let turned = step.inertia.or(step.wheels).or(step.images);
        let disagree = |sum: &mut UncertainTwist, a: Option<UncertainTwist>, b| {
            if let Some(turned) = &turned {
                sum.turn(&turned.twist);
            }
            let difference = a.zip(b).map(|(a, b)| a.minus(&b));
            sum.add(decay, difference) > parameters.outlier_gate
        };
        Contradicted::of_pairs(
            disagree(&mut self.wheels_images, step.wheels, step.images),
            disagree(&mut self.inertia_images, step.inertia, step.images),
            disagree(&mut self.inertia_wheels, step.inertia, step.wheels),
            parameters.trust_wheels,
        )
    }
}

impl Disagreements {
    /// Adds a step, and updates the contradicted sensors.
    ///
    /// A contradiction ends when the shorter sums agree and the sensors have moved since it began.
    /// Rest does not end it: a frozen picture and paused wheels agree.
    fn add(
        &mut self,
        contradicted: &mut Contradicted,
        seconds: f64,
        step: &Measured,
        parameters: &FilterParameters,
    ) {
        let [decay, slow_decay] = parameters
            .disagreement_times_s
            .map(|time_s| (-seconds / time_s).exp());
        let is_new = !contradicted.any();

        let short = self.shorter.add(Some(decay), step, parameters);
        let while_agreeing = Some(slow_decay).filter(|_| is_new);
        let long = self.longer.add(while_agreeing, step, parameters);

        let decay = if is_new { decay } else { 1.0 };
        let moves = |sum: &mut UncertainTwist, twist: Option<UncertainTwist>| {
            // A systematic error scales a motion, but does not make one.
            let lasting = Vector6::zeros();
            let twist = twist.map(|twist| UncertainTwist { lasting, ..twist });
            sum.add(Some(decay), twist) > parameters.outlier_gate
        };
        let wheels = moves(&mut self.wheels, step.wheels);
        let images = moves(&mut self.images, step.images);

        let found = if short.any() { short } else { long };
        if is_new && found.any() {
            if short.any() {
                self.longer = self.shorter;
            }
            self.wheels = UncertainTwist::default();
            self.images = UncertainTwist::default();
            *contradicted = found;
            return;
        }

        // Wheels that were silent for the longer time are forgotten.
        let silent_s = self.since_wheels_s.map(|silent_s| silent_s + seconds);
        self.since_wheels_s = step.wheels.map(|_| 0.0).or(silent_s);
        let [_, longer_s] = parameters.disagreement_times_s;
        let wheels = wheels
            || self
                .since_wheels_s
                .is_none_or(|silent_s| silent_s > longer_s);
        let has_moved = match contradicted {
            Contradicted { images: true, .. } => images && wheels,
            Contradicted { wheels: true, .. } => wheels,
            Contradicted { inertia: true, .. } => images || wheels,
            _ => images && wheels,
        };

        if has_moved && !short.any() {
            self.longer = Differences::default();
            *contradicted = Contradicted::default();
        } else if !is_new && long.any() {
            *contradicted = long;
        }
    }
}

impl Contradicted {
    /// Judges from which pairs of sensors disagree. The gyroscope decides between wheels and
    /// images. If these two agree and both contradict it, the gyroscope is contradicted. Trusted
    /// wheels are never contradicted.
    fn of_pairs(
        wheels_images: bool,
        inertia_images: bool,
        inertia_wheels: bool,
        trust_wheels: bool,
    ) -> Self {
        if inertia_images && inertia_wheels && !wheels_images {
            return Self {
                inertia: true,
                ..Self::default()
            };
        }
        let is_undecided = wheels_images && !inertia_images && !inertia_wheels;
        Self {
            wheels: (inertia_wheels || is_undecided) && !trust_wheels,
            images: inertia_images || is_undecided || (wheels_images && trust_wheels),
            inertia: inertia_wheels && trust_wheels,
        }
    }

    /// Whether any sensor is contradicted.
    pub fn any(self) -> bool {
        self != Self::default()
    }

    /// The sensors.
    pub fn sensors(self) -> impl Iterator<Item = Sensor> {
        let all = [
            (self.wheels, Sensor::Wheels),
            (self.images, Sensor::Images),
            (self.inertia, Sensor::Inertia),
        ];
        all.into_iter()
            .filter_map(|(is_contradicted, sensor)| is_contradicted.then_some(sensor))
    }
}

impl<'a> Motions<'a> {
    /// Updates the contradicted sensors of the state, and returns the motions of the others. Wheels
    /// that move faster than any robot, as after a restart, are left out too.
    pub(super) fn consistent(
        self,
        state: &mut FilterState,
        seconds: f64,
        parameters: &FilterParameters,
    ) -> Self {
        let motions = Self {
            wheels: self
                .wheels
                .filter(|wheels| parameters.is_possible(&wheels.motion, seconds)),
            ..self
        };

        let belief = state.belief;
        let biases = belief.map_or_else(Vector6::zeros, |belief| belief.inertial_biases());
        let (images, inertia) = (motions.visual, motions.inertia.as_ref());
        let step = Measured {
            wheels: motions.wheels.as_ref().map(of_wheels),
            images: images.map(|visual| of_images(visual, parameters)),
            inertia: inertia.map(|inertia| of_inertia(inertia, &biases)),
        };
        state
            .disagreements
            .add(&mut state.contradicted, seconds, &step, parameters);
        motions.without(state.contradicted)
    }

    /// The motions without visual odometry.
    pub(super) fn without_images(&self) -> Self {
        Self {
            visual: None,
            inertia: self.inertia.clone(),
            ..*self
        }
    }

    fn without(self, contradicted: Contradicted) -> Self {
        Self {
            wheels: self.wheels.filter(|_| !contradicted.wheels),
            visual: self.visual.filter(|_| !contradicted.images),
            inertia: self.inertia.filter(|_| !contradicted.inertia),
            since: self.since,
        }
    }
}

fn of_wheels(wheels: &WheelMotion) -> UncertainTwist {
    let WheelMotion {
        motion,
        drift,
        noise,
    } = wheels;
    let twist = log(motion);
    let lasting_m = drift.translation_share * twist.linear.norm();
    let lasting_rad = drift.rotation_share * (twist.angular.norm() + twist.linear.norm());
    UncertainTwist {
        twist: twist.to_vector(),
        variances: noise.diagonal(),
        lasting: each(lasting_m, lasting_rad),
        ends: Vector6::zeros(),
    }
}

fn of_images(visual: &VisualMotion, parameters: &FilterParameters) -> UncertainTwist {
    let twist = log(&visual.motion);
    // Errors of the local map are systematic, too, in the proportions of its noise.
    let relative = &parameters.visual_noise;
    let distance_m = twist.linear.norm();
    let lasting_m = relative.over_motion.hypot(visual.scale_deviation) * distance_m;
    let of_angle = relative.over_motion * twist.angular.norm();
    let lasting_rad = of_angle.hypot(relative.rotation_over_meter * distance_m);
    UncertainTwist {
        twist: twist.to_vector(),
        variances: relative.over(&twist).diagonal(),
        lasting: each(lasting_m, lasting_rad),
        ends: visual.pose_covariance.diagonal() * (2.0 * parameters.visual_design_effect),
    }
}

fn of_inertia(inertia: &MeasuredInertia, biases: &Vector6<f64>) -> UncertainTwist {
    let motion = &inertia.motion;
    let deviation = motion.noise.bias[0];
    let of_biases = motion.by_bias.fixed_view::<3, 3>(3, 0) * biases.fixed_rows::<3>(0);
    let rotation = motion.rotation.scaled_axis() + of_biases * deviation;
    let covariance: Matrix3<f64> = motion.covariance.fixed_view::<3, 3>(3, 3).into();

    let mut twist = Vector6::zeros();
    twist.fixed_rows_mut::<3>(3).copy_from(&rotation);
    let mut variances = Vector6::zeros();
    variances
        .fixed_rows_mut::<3>(3)
        .copy_from(&covariance.diagonal());
    UncertainTwist {
        twist,
        variances,
        lasting: each(0.0, deviation * motion.seconds),
        ends: Vector6::zeros(),
    }
}

fn each(linear: f64, angular: f64) -> Vector6<f64> {
    Vector6::new(linear, linear, linear, angular, angular, angular)
}
