//! Sensors whose motions contradict each other.

use nalgebra::{Matrix3, Vector6};

use super::belief::visual_noise;
use super::{FilterParameters, FilterState, MeasuredInertia, Motions, WheelMotion};
use crate::tracking::Sensor;
use crate::visual_odometry::VisualMotion;
use seese3_core::geometry::log;

/// The sensors of motions that contradict others.
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

/// Sums of the differences of two sensors each.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Disagreements {
    wheels_images: Disagreement,
    inertia_images: Disagreement,
    inertia_wheels: Disagreement,
}

/// Sum of the differences of two sensors; older ones count less.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Disagreement {
    /// Sum of the twists, meters and radians.
    sum: Vector6<f64>,
    /// Variances of the sum by independent noise, if both are right; 0 where they are not compared.
    variances: Vector6<f64>,
    /// Standard deviations of the sum by lasting errors, which add up.
    lasting: Vector6<f64>,
}

impl Disagreement {
    /// Keeps a share of the sum.
    fn fade(&mut self, kept: f64) {
        self.sum *= kept;
        self.variances *= kept * kept;
        self.lasting *= kept;
    }

    /// Adds the difference of one step. Returns the squared length of the sum in standard deviations:
    /// χ² with as many degrees of freedom as axes are compared, if both sensors are right.
    fn add(&mut self, difference: &TwistNoise) -> f64 {
        self.sum += difference.twist;
        self.variances += difference.variances;
        self.lasting += difference.lasting;
        let axes = (0..6).filter(|&axis| self.variances[axis] > 0.0);
        axes.map(|axis| {
            let variance = self.variances[axis] + self.lasting[axis].powi(2);
            self.sum[axis].powi(2) / variance
        })
        .sum()
    }
}

impl Contradicted {
    /// Judges from which pairs of sensors disagree. A gyroscope is seldom wrong: it decides between two
    /// others, unless both of them contradict it and agree.
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
            images: inertia_images || is_undecided,
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
    /// The motions without those of sensors that contradict others, which the state remembers. Wheels
    /// that move faster than any robot, as after a restart, are left out too.
    pub(super) fn consistent(
        self,
        state: &mut FilterState,
        seconds: f64,
        time_ns: i64,
        parameters: &FilterParameters,
    ) -> Self {
        let motions = Self {
            wheels: self
                .wheels
                .filter(|wheels| parameters.is_possible(&wheels.motion, seconds)),
            ..self
        };

        let kept = (-seconds / parameters.disagreement_time_s).exp();
        let wheels = motions.wheels.as_ref().map(of_wheels);
        let images = motions
            .visual
            .map(|visual| of_images(visual, seconds, parameters));
        let biases = state.belief.map(|belief| belief.inertial_biases());
        let inertia = motions
            .inertia
            .as_ref()
            .map(|inertia| of_inertia(inertia, &biases.unwrap_or_default()));

        let disagree = |sum: &mut Disagreement, a: Option<TwistNoise>, b: Option<TwistNoise>| {
            sum.fade(kept);
            let Some((a, b)) = a.zip(b) else { return false };
            // A gyroscope measures no translation.
            let is_compared = |axis: usize| a.variances[axis].min(b.variances[axis]) > 0.0;
            let of = |value: Vector6<f64>| {
                Vector6::from_fn(|axis, _| if is_compared(axis) { value[axis] } else { 0.0 })
            };
            let difference = TwistNoise {
                twist: of(a.twist - b.twist),
                variances: of(a.variances + b.variances),
                // Those of two sensors are independent.
                lasting: of(a.lasting.zip_map(&b.lasting, f64::hypot)),
            };
            sum.add(&difference) > parameters.outlier_gate
        };
        let sums = &mut state.disagreements;
        let contradicted = Contradicted::of_pairs(
            disagree(&mut sums.wheels_images, wheels, images),
            disagree(&mut sums.inertia_images, inertia, images),
            disagree(&mut sums.inertia_wheels, inertia, wheels),
            parameters.trust_wheels,
        );

        if contradicted.any() {
            state.contradicted = contradicted;
            state.contradicted_ns = Some(time_ns);
        }
        motions.without(contradicted)
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

/// A twist with its errors.
#[derive(Clone, Copy)]
struct TwistNoise {
    twist: Vector6<f64>,
    /// Variances of its components by independent noise; 0 for components that are not measured.
    variances: Vector6<f64>,
    /// Standard deviations by lasting errors.
    lasting: Vector6<f64>,
}

fn of_wheels(wheels: &WheelMotion) -> TwistNoise {
    let WheelMotion {
        motion,
        drift,
        noise,
    } = wheels;
    let twist = log(motion);
    let lasting_m = drift.translation_share * twist.linear.norm();
    let lasting_rad = drift.rotation_share * (twist.angular.norm() + twist.linear.norm());
    TwistNoise {
        twist: twist.to_vector(),
        variances: noise.diagonal(),
        lasting: each(lasting_m, lasting_rad),
    }
}

fn of_images(visual: &VisualMotion, seconds: f64, parameters: &FilterParameters) -> TwistNoise {
    let twist = log(&visual.motion);
    let noise = visual_noise(visual, seconds, parameters).diagonal();
    let lasting_m = visual.scale_deviation * twist.linear.norm();
    TwistNoise {
        twist: twist.to_vector(),
        variances: noise,
        lasting: each(lasting_m, 0.0),
    }
}

fn of_inertia(inertia: &MeasuredInertia, biases: &Vector6<f64>) -> TwistNoise {
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
    TwistNoise {
        twist,
        variances,
        lasting: each(0.0, deviation * motion.seconds),
    }
}

fn each(linear: f64, angular: f64) -> Vector6<f64> {
    Vector6::new(linear, linear, linear, angular, angular, angular)
}
