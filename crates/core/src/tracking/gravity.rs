//! Which way is down: what an accelerometer tells of a camera's tilt.
//!
//! A view says little of a camera's tilt: one that is rolled by ten degrees is most like the mapped
//! views of a level camera at the same place. Gravity tells the tilt and nothing else: neither the
//! heading nor the position.

use nalgebra::{Cholesky, Matrix3, Matrix6, SMatrix, SVector, Unit, Vector3};

use super::{Belief, MovingBelief};
use crate::geometry::{Pose, Twist, adjoint, exp};

/// 99 % of χ² with two degrees of freedom, those of a tilt.
const GATE: f64 = 9.21;
/// Errors of measured directions last for about so long, seconds: those of a robot that speeds up
/// or brakes. Those of the mounting last longer still, but are small.
const MEMORY_S: f64 = 2.0;
/// The variances of a view are multiplied by this at most.
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

/// How a pose is tilted against measured gravity.
struct Tilt {
    /// The rotation that would take the pose's own direction of gravity to the measured one, in the
    /// camera's body frame, radians.
    turn: Vector3<f64>,
    /// What of an error of rotation is one of tilt: all but that about the vertical.
    projection: Matrix3<f64>,
}

impl MeasuredGravity {
    fn tilt(&self, pose: &Pose) -> Tilt {
        let expected = pose.rotation.inverse() * self.in_world.into_inner();
        let measured = self.in_camera.into_inner();

        // A camera that is turned by ω sees a direction h at h − ω × h: the turn is about measured ×
        // expected. One upside down may have been turned about any axis across.
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
    /// The squared Mahalanobis length of the turn; infinite if the covariances are not positive
    /// definite.
    fn surprise(&self, of_rotation: &Matrix3<f64>, measured_variance: f64) -> f64 {
        let sum = self.projection * of_rotation * self.projection.transpose()
            + Matrix3::identity() * measured_variance;
        Cholesky::new(sum).map_or(f64::INFINITY, |sum| self.turn.dot(&sum.solve(&self.turn)))
    }

    /// The step of an error whose rotation is at 3, 4 and 5, and its covariance after the tilt was
    /// measured; none if the covariances are not positive definite. Only the tilt is corrected: that
    /// it goes along with heading and position holds for views that are taken for one another, and
    /// not for a camera that is mounted askew.
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

impl Belief {
    /// The pose of a view, corrected by the gravity that was measured beside it. A view that gravity
    /// contradicts was taken from another tilt than the mapped views that it looks like: it is
    /// turned as gravity says, and its position and heading are doubted by as much as the
    /// contradiction exceeds 99 % of what both covariances allow.
    #[must_use]
    pub(super) fn levelled(&self, gravity: &MeasuredGravity) -> Self {
        let tilt = gravity.tilt(&self.pose);
        let variance = gravity.deviation_rad.powi(2);
        let of_rotation = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let doubt = tilt.surprise(&of_rotation, variance) / GATE;

        if doubt <= 1.0 {
            return match tilt.update(&self.covariance, variance) {
                Some((step, covariance)) => Self {
                    pose: self.pose * exp(&Twist::from_vector(&step)),
                    covariance,
                },
                None => *self,
            };
        }

        let turn = Pose::rotation(tilt.turn);
        let back = adjoint(&turn.inverse());
        let carried = back * self.covariance * back.transpose();

        // What is left of the rotation's error is that about the vertical.
        let down = gravity.in_camera.into_inner();
        let vertical = down * down.transpose();
        let mut kept = Matrix6::identity();
        kept.fixed_view_mut::<3, 3>(3, 3).copy_from(&vertical);
        let mut covariance = kept * carried * kept.transpose() * doubt.min(MOST_DOUBT);
        let mut of_rotation = covariance.fixed_view_mut::<3, 3>(3, 3);
        of_rotation += (Matrix3::identity() - vertical) * variance;

        Self {
            pose: self.pose * turn,
            covariance: (covariance + covariance.transpose()) * 0.5,
        }
    }
}

impl MovingBelief {
    /// The belief when gravity was measured, some seconds after it was measured before. Measurements
    /// in a row have like errors, so that each counts for little; one that contradicts the belief
    /// counts for less: a robot that brakes measures another direction.
    #[must_use]
    pub(super) fn levelled(&self, gravity: &MeasuredGravity, seconds: f64) -> Self {
        let tilt = gravity.tilt(&self.pose);
        let correlation = (-seconds / MEMORY_S).exp();
        let alike = (1.0 + correlation) / (1.0 - correlation);
        let variance = gravity.deviation_rad.powi(2) * alike;

        let of_rotation = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let doubt = (tilt.surprise(&of_rotation, variance) / GATE)
            .max(1.0)
            .powi(2);
        let Some((change, covariance)) = tilt.update(&self.covariance, variance * doubt) else {
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
    use crate::geometry::{Pose, log};
    use crate::tracking::MotionPrior;

    const DOWN: Vector3<f64> = Vector3::new(0.0, 1.0, 0.0);

    /// What a camera at this pose measures exactly, in a world whose y axis points down.
    fn gravity_at(pose: &Pose, deviation_rad: f64) -> MeasuredGravity {
        let down = Unit::new_unchecked(DOWN);
        MeasuredGravity {
            in_world: down,
            in_camera: pose.rotation.inverse() * down,
            deviation_rad,
        }
    }

    fn turned(axis: Vector3<f64>, angle_rad: f64) -> Pose {
        Pose::new(Vector3::new(1.0, 2.0, 3.0), axis * angle_rad)
    }

    /// Oracle: by hand. A camera that is believed to stand level is rolled by 10 degrees about its
    /// optical axis: gravity, which is much surer, turns it so, about no other axis. Neither its
    /// position nor its heading are known better afterwards.
    #[test]
    fn gravity_tells_the_tilt_and_nothing_else() {
        let level = turned(DOWN, 0.7);
        let roll = 10_f64.to_radians();
        let truth = level * exp(&Twist::from_vector(&Vector6::new(0., 0., 0., 0., 0., roll)));

        let believed = Belief::known(level, 0.1, 0.2);
        let found = believed.levelled(&gravity_at(&truth, 1e-6));
        let error = log(&found.pose.inv_mul(&truth)).to_vector();
        assert!(error.norm() < 1e-6, "{error}");

        let position = found.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        assert!((position - Matrix3::identity() * 0.01).amax() < 1e-12);
        // The vertical of the rolled camera.
        let down = truth.rotation.inverse() * DOWN;
        let of_rotation = found.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let about = |axis: Vector3<f64>| (axis.transpose() * of_rotation * axis)[0];
        assert!(about(Vector3::z()) < 1e-9);

        // Also where errors of roll went along with those of position and heading.
        let mut covariance = believed.covariance;
        for other in [0, 4] {
            covariance[(5, other)] = 0.9 * (covariance[(5, 5)] * covariance[(other, other)]).sqrt();
            covariance[(other, 5)] = covariance[(5, other)];
        }
        let found = Belief {
            covariance,
            ..believed
        };
        let found = found.levelled(&gravity_at(&truth, 1e-3));
        let error = log(&found.pose.inv_mul(&truth)).to_vector();
        assert!(error.norm() < 1e-4, "{error}");
        assert!(
            (about(down) - 0.04).abs() < 0.04 * roll.powi(2),
            "{}",
            about(down)
        );
    }

    /// Oracle: by hand. A view that is sure to stand level to .005 rad and a gravity of .02 rad that
    /// says .2 rad differ by .2² / (.005² + .02²) = 94 squared deviations, 10.2 times the gate: the
    /// view is turned, and the other variances are multiplied by that.
    #[test]
    fn a_view_that_gravity_contradicts_is_turned_and_doubted() {
        let view = Belief::known(turned(DOWN, -0.4), 0.005, 0.005);
        let truth = view.pose * exp(&Twist::from_vector(&Vector6::new(0., 0., 0., 0.2, 0., 0.)));
        let found = view.levelled(&gravity_at(&truth, 0.02));

        let error = log(&found.pose.inv_mul(&truth)).to_vector();
        assert!(error.norm() < 1e-9, "{error}");
        let doubt = 0.2_f64.powi(2) / (0.005_f64.powi(2) + 0.02_f64.powi(2)) / GATE;
        let expected = 0.005_f64.powi(2) * doubt;
        let down = truth.rotation.inverse() * DOWN;
        let of_rotation = found.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let about = |axis: Vector3<f64>| (axis.transpose() * of_rotation * axis)[0];
        assert!((found.covariance[(0, 0)] / expected - 1.0).abs() < 1e-9);
        assert!((about(down) / expected - 1.0).abs() < 1e-9);
        assert!((about(Vector3::x()) - 0.02_f64.powi(2)).abs() < 1e-12);

        // Without a contradiction nothing is doubted.
        let same = view.levelled(&gravity_at(&view.pose, 0.02));
        assert!((same.covariance[(0, 0)] - 0.005_f64.powi(2)).abs() < 1e-15);
    }

    /// Oracle: the definition: where a camera is upside down it was turned by half, about an axis
    /// across.
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

    /// Oracle: the rules, by hand: at once, with a pause much longer than errors last, a measured
    /// direction counts by Kalman's gain; a tenth of a second later it counts for much less.
    #[test]
    fn directions_in_a_row_count_as_few() {
        let prior = MotionPrior::assumed();
        let level = turned(DOWN, 0.0);
        let truth = level * exp(&Twist::from_vector(&Vector6::new(0., 0., 0., 0., 0., 0.02)));
        let believed = MovingBelief::at(Belief::known(level, 0.1, 0.02), &prior);
        let gravity = gravity_at(&truth, 0.02);

        let roll = |seconds: f64| {
            let found = believed.levelled(&gravity, seconds);
            log(&level.inv_mul(&found.pose)).to_vector()[5]
        };
        assert!((roll(1e3) - 0.01).abs() < 1e-6, "{}", roll(1e3));
        let correlation = (-0.1_f64 / MEMORY_S).exp();
        let alike = (1.0 + correlation) / (1.0 - correlation);
        assert!(
            (roll(0.1) - 0.02 / (1.0 + alike)).abs() < 1e-6,
            "{}",
            roll(0.1)
        );
    }
}
