//! Corrections of the camera's tilt by measured gravity.
//!
//! Views constrain the tilt poorly: a view rolled by 10° is most similar to mapped views of a level
//! camera at the same place. Gravity constrains the tilt, but neither the heading nor the position.

use nalgebra::{Cholesky, Matrix3, SMatrix, SVector, Unit, Vector3};

use super::{Observation, PoseVelocity, PoseWithCovariance, State};
use seese3_core::geometry::{Pose, Twist, exp};

/// Gate of a tilt: 99 % quantile of χ² with two degrees of freedom.
const GATE: f64 = 9.21;
/// Correlation time of direction errors, seconds. They come mostly from accelerations of the robot.
const MEMORY_S: f64 = 2.0;
/// Upper bound of the ratio of surprise to gate.
const MOST_DOUBT: f64 = 1e6;

/// The direction of gravity, as an accelerometer measures it in the camera's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredGravity {
    /// In the room's world frame.
    pub in_world: Unit<Vector3<f64>>,
    /// In the camera's frame.
    pub in_camera: Unit<Vector3<f64>>,
    /// The standard deviation of the measured direction about each axis, radians, above 0.
    pub deviation_rad: f64,
}

/// A measured direction with its variance inflated for time correlation.
#[derive(Debug, Clone, Copy)]
pub(super) struct CountedGravity {
    measured: MeasuredGravity,
    /// Variance of the measurement error, radians².
    variance: f64,
    /// Variance inflated for correlation with earlier measurements, radians².
    counted_variance: f64,
}

/// Tilt error of a pose relative to measured gravity.
struct Tilt {
    /// Rotation of the camera that aligns expected with measured gravity, in the camera's body
    /// frame, radians.
    turn: Vector3<f64>,
    /// Projects a rotation error in the camera's body frame onto the plane across the vertical.
    projection: Matrix3<f64>,
}

impl MeasuredGravity {
    /// Inflates the variance by the time since the last measurement, and stores this frame's time.
    pub(super) fn after(self, state: &mut State, frame: &Observation) -> CountedGravity {
        let seconds = state.gravity_ns.map_or(f64::INFINITY, |before| {
            frame.time_ns.abs_diff(before) as f64 * 1e-9
        });
        state.gravity_ns = Some(frame.time_ns);
        self.counted_after(seconds)
    }

    /// Inflates the variance for a measurement that follows another after some seconds. With the
    /// correlation ρ between successive measurements, the factor is (1 + ρ)/(1 − ρ).
    fn counted_after(self, seconds: f64) -> CountedGravity {
        let correlation = (-seconds / MEMORY_S).exp();
        let variance = self.deviation_rad.powi(2);
        CountedGravity {
            measured: self,
            variance,
            counted_variance: variance * (1.0 + correlation) / (1.0 - correlation),
        }
    }

    fn tilt(&self, pose: &Pose) -> Tilt {
        let expected = pose.rotation.inverse() * self.in_world.into_inner();
        let measured = self.in_camera.into_inner();

        // A camera rotated by ω measures a direction h as h − ω × h, so the axis is measured ×
        // expected. If the two are opposite, use any perpendicular axis.
        let across = measured.cross(&expected);
        let angle = across.norm().atan2(measured.dot(&expected));
        let axis = across.try_normalize(1e-9).unwrap_or_else(|| {
            let least = expected.iamin();
            expected.cross(&Vector3::ith(least, 1.0)).normalize()
        });

        Tilt {
            turn: axis * angle,
            projection: Matrix3::identity() - expected * expected.transpose(),
        }
    }
}

impl Tilt {
    /// Squared Mahalanobis length of the tilt; infinite if the sum of the covariances is not
    /// positive definite.
    fn surprise(&self, of_rotation: &Matrix3<f64>, measured_variance: f64) -> f64 {
        let sum = self.projection * of_rotation * self.projection.transpose()
            + Matrix3::identity() * measured_variance;
        Cholesky::new(sum).map_or(f64::INFINITY, |sum| self.turn.dot(&sum.solve(&self.turn)))
    }

    /// Kalman update of an error state with rotation in rows 3 to 5. Returns the step and the
    /// covariance after it, in the body frame before the step. `None` if a covariance is not
    /// positive definite.
    ///
    /// Only the tilt changes. Its correlation with heading and position comes from mismatched views
    /// and does not hold for a camera with a tilted mount.
    fn update<const N: usize>(
        &self,
        covariance: &SMatrix<f64, N, N>,
        measured_variance: f64,
    ) -> Option<(SVector<f64, N>, SMatrix<f64, N, N>)> {
        let noise = Matrix3::identity() * measured_variance;
        let mut of_error = SMatrix::<f64, 3, N>::zeros();
        of_error
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&self.projection);

        let of_tilt = of_error * covariance * of_error.transpose();
        let sum = Cholesky::new(of_tilt + noise)?;
        let mut gain = SMatrix::<f64, N, 3>::zeros();
        gain.fixed_view_mut::<3, 3>(3, 0)
            .copy_from(&(of_tilt * sum.inverse()));

        // Joseph's form, which holds for any gain: (I − K H) P (I − K H)ᵀ + K R Kᵀ.
        let rest = SMatrix::<f64, N, N>::identity() - gain * of_error;
        let joseph = rest * covariance * rest.transpose() + gain * noise * gain.transpose();
        let symmetric = (joseph + joseph.transpose()) * 0.5;

        Some((gain * self.turn, symmetric))
    }
}

impl CountedGravity {
    /// Tilt of a pose with this rotation covariance, and the factor on the measurement variance.
    /// The factor grows with the surprise above the gate: the robot may accelerate, or the sensor's
    /// extrinsics may be wrong.
    fn against(&self, pose: &Pose, of_rotation: &Matrix3<f64>) -> (Tilt, f64) {
        let tilt = self.measured.tilt(pose);
        let excess = tilt.surprise(of_rotation, self.variance) / GATE;
        (tilt, excess.clamp(1.0, MOST_DOUBT).powi(2))
    }

    /// Angle between measured gravity and that of a pose, radians, if it is outside the gate.
    pub(super) fn contradicts(&self, pose: &PoseWithCovariance) -> Option<f64> {
        let tilt = self.measured.tilt(&pose.pose);
        let of_rotation = pose.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let is_surprise = tilt.surprise(&of_rotation, self.variance) > GATE;
        is_surprise.then(|| tilt.turn.norm())
    }
}

impl PoseWithCovariance {
    /// Corrects the tilt of a view's pose by the gravity of the same frame, without inflation for
    /// time correlation.
    #[must_use]
    pub(super) fn levelled(&self, gravity: &CountedGravity) -> Self {
        let of_rotation = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let (tilt, factor) = gravity.against(&self.pose, &of_rotation);
        match tilt.update(&self.covariance, gravity.variance * factor) {
            Some((step, covariance)) => {
                let step = exp(&Twist::from_vector(&step));
                Self {
                    covariance,
                    ..*self
                }
                .of_attached(&step)
            }
            None => *self,
        }
    }
}

impl PoseVelocity {
    /// Corrects the tilt of the filter state by gravity, with inflation for time correlation.
    #[must_use]
    pub(super) fn levelled(&self, gravity: &CountedGravity) -> Self {
        let of_rotation = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let (tilt, factor) = gravity.against(&self.pose, &of_rotation);
        let variance = gravity.counted_variance * factor;
        let Some((change, covariance)) = tilt.update(&self.covariance, variance) else {
            return *self;
        };

        let step = change.fixed_rows::<6>(0).into_owned();
        Self {
            pose: self.pose * exp(&Twist::from_vector(&step)),
            covariance,
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::tracking::MotionPrior;
    use seese3_core::geometry::{Pose, log};

    const DOWN: Vector3<f64> = Vector3::new(0.0, 1.0, 0.0);

    /// Noise-free gravity measured by a camera at this pose; the world's y axis points down.
    fn gravity_at(pose: &Pose, deviation_rad: f64) -> MeasuredGravity {
        let down = Unit::new_unchecked(DOWN);
        MeasuredGravity {
            in_world: down,
            in_camera: pose.rotation.inverse() * down,
            deviation_rad,
        }
    }

    /// The same as the first measurement of a stream.
    fn first_at(pose: &Pose, deviation_rad: f64) -> CountedGravity {
        gravity_at(pose, deviation_rad).counted_after(f64::INFINITY)
    }

    fn turned(axis: Vector3<f64>, angle_rad: f64) -> Pose {
        Pose::new(Vector3::new(1.0, 2.0, 3.0), axis * angle_rad)
    }

    /// Oracle: by hand. The estimate is level; the camera is rolled by 10° about its optical axis.
    /// A precise gravity measurement corrects the roll and no other axis. Afterwards the tilt is
    /// known; the uncertainty of position and heading is unchanged.
    #[test]
    fn gravity_tells_the_tilt_and_nothing_else() {
        let level = turned(DOWN, 0.7);
        let roll = Twist::from_vector(&Vector6::new(0., 0., 0., 0., 0., 10_f64.to_radians()));
        let truth = level * exp(&roll);
        let (right, down) = (Vector3::x(), truth.rotation.inverse() * DOWN);

        let independent = PoseWithCovariance::known(level, 0.1, 0.2);
        // A second case correlates the roll error with those of position and heading.
        let mut together = independent;
        for other in [0, 4] {
            let covariance = &mut together.covariance;
            covariance[(5, other)] = 0.6 * (covariance[(5, 5)] * covariance[(other, other)]).sqrt();
            covariance[(other, 5)] = covariance[(5, other)];
        }

        for believed in [independent, together] {
            assert!(believed.covariance.cholesky().is_some());
            let found = believed.levelled(&first_at(&truth, 1e-6));
            let error = log(&found.pose.inv_mul(&truth)).to_vector();
            assert!(error.norm() < 1e-6, "{error}");

            let part = |at: usize, axis: Vector3<f64>| {
                let block = found.covariance.fixed_view::<3, 3>(at, at).into_owned();
                (axis.transpose() * block * axis)[0]
            };
            let across = right.cross(&down).normalize();
            for axis in [across, across.cross(&down)] {
                assert!(part(3, axis) < 1e-9, "{}", part(3, axis));
            }
            assert!((part(3, down) - 0.04).abs() < 1e-6, "{}", part(3, down));
            for axis in [right, down, across] {
                assert!((part(0, axis) - 0.01).abs() < 1e-9, "{}", part(0, axis));
            }
        }
    }

    /// Oracle: by hand. A level view has a deviation of 0.005 rad; gravity, with 0.02 rad, is 0.2
    /// rad off. The surprise is 0.2² / (0.005² + 0.02²) = 94.118, or 10.219 times the gate of 9.21.
    /// The variance of gravity grows by 10.219² = 104.43 to 0.04177. It turns the view by 0.2 ·
    /// 25e-6 / 0.041797 = 0.0001196 rad. An angle of 0.2 rad is outside the gate, 0.02 rad is
    /// inside.
    #[test]
    fn gravity_that_a_sure_view_contradicts_is_doubted() {
        let view = PoseWithCovariance::known(turned(DOWN, -0.4), 0.005, 0.005);
        let pitched = |angle: f64| {
            let truth = view.pose
                * exp(&Twist::from_vector(&Vector6::new(
                    0., 0., 0., angle, 0., 0.,
                )));
            first_at(&truth, 0.02)
        };

        let found = view.levelled(&pitched(0.2));
        let turn = log(&view.pose.inv_mul(&found.pose)).to_vector();
        assert!((turn[3] - 1.196e-4).abs() < 1e-6, "{turn}");
        assert!((pitched(0.2).contradicts(&view).unwrap() - 0.2).abs() < 1e-9);
        assert!(pitched(0.02).contradicts(&view).is_none());
    }

    /// Oracle: the definition: an upside-down camera has a tilt of π about a horizontal axis.
    #[test]
    fn upside_down_is_a_turn_by_half() {
        let pose = turned(DOWN, 0.3);
        let down = gravity_at(&pose, 0.01);
        let up = MeasuredGravity {
            in_camera: -down.in_camera,
            ..down
        };
        let tilt = up.tilt(&pose);
        assert!((tilt.turn.norm() - std::f64::consts::PI).abs() < 1e-9);
        assert!(tilt.turn.dot(&down.in_camera).abs() < 1e-9);
    }

    /// Oracle: by hand. A first direction with the variance of the estimate corrects half of the
    /// error. One that follows after 0.1 s, with correlation e^(−1/20) = 0.951, has about 40 times
    /// the variance and corrects 1/41.01 of the error.
    #[test]
    fn directions_in_a_row_count_as_few() {
        let prior = MotionPrior::assumed();
        let level = turned(DOWN, 0.0);
        let truth = level * exp(&Twist::from_vector(&Vector6::new(0., 0., 0., 0., 0., 0.02)));
        let believed = PoseVelocity::at(PoseWithCovariance::known(level, 0.1, 0.02), &prior);

        for (seconds, expected) in [(f64::INFINITY, 0.01), (0.1, 0.02 / 41.01)] {
            let gravity = gravity_at(&truth, 0.02).counted_after(seconds);
            let found = believed.levelled(&gravity);
            let roll = log(&level.inv_mul(&found.pose)).to_vector()[5];
            assert!(
                (roll / expected - 1.0).abs() < 1e-3,
                "{roll}, not {expected}"
            );
        }
    }
}
