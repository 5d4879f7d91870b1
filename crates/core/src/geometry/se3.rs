//! The exponential, the logarithm and the adjoint of SE(3).
//!
//! The order of the six numbers of a twist, (v, ω), is defined only in this file.

use nalgebra::{Isometry3, Matrix3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};

use super::{PI_MARGIN_RAD, Pose};

/// Angle, radians, below which coefficients with a removable singularity are evaluated by Taylor
/// series.
const SERIES_ANGLE_RAD: f64 = 0.2;

/// An element of se(3): a camera motion, in the body frame of the camera it starts from.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Twist {
    /// v, meters.
    pub linear: Vector3<f64>,
    /// ω, rotation axis times angle, radians.
    pub angular: Vector3<f64>,
}

impl Twist {
    /// The six numbers as (v, ω).
    pub fn to_vector(self) -> Vector6<f64> {
        let v = self.linear;
        let w = self.angular;
        Vector6::new(v.x, v.y, v.z, w.x, w.y, w.z)
    }

    /// The twist from six numbers, ordered (v, ω).
    pub fn from_vector(xi: &Vector6<f64>) -> Self {
        Self {
            linear: xi.fixed_rows::<3>(0).into(),
            angular: xi.fixed_rows::<3>(3).into(),
        }
    }

    /// ‖(v, ω)‖₂, meters and radians mixed as in the paper's Hit@ε.
    pub fn norm(self) -> f64 {
        self.to_vector().norm()
    }

    /// This motion repeated `count` times: exp(ξ)ⁿ = exp(nξ).
    pub fn times(self, count: usize) -> Self {
        Self {
            linear: self.linear * count as f64,
            angular: self.angular * count as f64,
        }
    }

    /// One of `parts` equal parts of this motion: exp(ξ/n)ⁿ = exp(ξ).
    pub fn divided(self, parts: u32) -> Self {
        let share = f64::from(parts).recip();
        Self {
            linear: self.linear * share,
            angular: self.angular * share,
        }
    }

    /// A fraction of this motion: exp(sξ).
    pub fn scaled(self, share: f64) -> Self {
        Self {
            linear: self.linear * share,
            angular: self.angular * share,
        }
    }

    /// The inverse motion: exp(−ξ) = exp(ξ)⁻¹.
    pub fn reversed(self) -> Self {
        Self {
            linear: -self.linear,
            angular: -self.angular,
        }
    }

    /// Whether all six numbers are finite.
    pub fn is_finite(self) -> bool {
        self.to_vector().iter().all(|x| x.is_finite())
    }

    /// Whether this twist is the unique logarithm of its motion: |ω| < π, with the margin
    /// [`PI_MARGIN_RAD`].
    pub fn is_unique_logarithm(self) -> bool {
        self.angular.norm() < std::f64::consts::PI - PI_MARGIN_RAD
    }
}

/// The exponential map exp: se(3) → SE(3). The twist may have any length.
///
/// Source: SeeSE3, Eq. 1, inverted; t = V(ω) v with V = I + b ω̂ + c ω̂².
pub fn exp(twist: &Twist) -> Pose {
    let angle = twist.angular.norm();

    // b = (1 − cos θ)/θ² and c = (θ − sin θ)/θ³ of V. Both suffer cancellation near θ = 0, where
    // the series are used.
    let (b, c) = if angle < SERIES_ANGLE_RAD {
        let x = angle * angle;
        (
            series(
                x,
                &[
                    1.0 / 2.0,
                    -1.0 / 24.0,
                    1.0 / 720.0,
                    -1.0 / 40_320.0,
                    1.0 / 3_628_800.0,
                ],
            ),
            series(
                x,
                &[
                    1.0 / 6.0,
                    -1.0 / 120.0,
                    1.0 / 5_040.0,
                    -1.0 / 362_880.0,
                    1.0 / 39_916_800.0,
                ],
            ),
        )
    } else {
        (
            (1.0 - angle.cos()) / (angle * angle),
            (angle - angle.sin()) / (angle * angle * angle),
        )
    };

    let hat = twist.angular.cross_matrix();
    let v_matrix = Matrix3::identity() + hat * b + hat * hat * c;

    Isometry3::from_parts(
        Translation3::from(v_matrix * twist.linear),
        UnitQuaternion::from_scaled_axis(twist.angular),
    )
}

/// The logarithm log: SE(3) → se(3), with |ω| ≤ π.
///
/// At |ω| = π the sign of ω is arbitrary; see [`Twist::is_unique_logarithm`].
///
/// Source: SeeSE3, Eq. 1; v = V(ω)⁻¹ t with V⁻¹ = I − ω̂/2 + c ω̂².
pub fn log(motion: &Pose) -> Twist {
    let angular = rotation_vector(&motion.rotation);
    let angle = angular.norm();

    let c = if angle < SERIES_ANGLE_RAD {
        let coefficients = [
            1.0 / 12.0,
            1.0 / 720.0,
            1.0 / 30_240.0,
            1.0 / 1_209_600.0,
            1.0 / 47_900_160.0,
        ];

        series(angle * angle, &coefficients)
    } else {
        // (1 − (θ/2) cot(θ/2)) / θ². The cotangent is written as cos/sin because tan(θ/2) has a
        // pole at θ = π.
        let half = 0.5 * angle;
        (1.0 - half * half.cos() / half.sin()) / (angle * angle)
    };

    let hat = angular.cross_matrix();
    let v_inverse = Matrix3::identity() - hat * 0.5 + hat * hat * c;

    Twist {
        linear: v_inverse * motion.translation.vector,
        angular,
    }
}

/// Motion from the first camera to the second, in the body frame of the first, log(P₁⁻¹ P₂).
///
/// Source: SeeSE3, Eq. 1.
pub fn body_twist(world_from_first: &Pose, world_from_second: &Pose) -> Twist {
    log(&world_from_first.inv_mul(world_from_second))
}

/// The 6×6 matrix Ad of `b_from_a` with Ad ξ_a = ξ_b: \[\[R, t̂R\], \[0, R\]\] on (v, ω).
pub fn adjoint(b_from_a: &Pose) -> Matrix6<f64> {
    let rotation = b_from_a.rotation.to_rotation_matrix().into_inner();
    let mut ad = Matrix6::zeros();
    ad.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    ad.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);

    let coupling = b_from_a.translation.vector.cross_matrix() * rotation;
    ad.fixed_view_mut::<3, 3>(0, 3).copy_from(&coupling);

    ad
}

/// The covariance of the six numbers of a twist, (v, ω). `covariance` is that of δ in
/// true motion = exp(twist) · exp(δ).
///
/// log(exp(ξ) exp(δ)) = ξ + J_r⁻¹(ξ) δ to first order, so it is J_r⁻¹ Σ J_r⁻ᵀ.
pub fn twist_covariance(twist: &Twist, covariance: &Matrix6<f64>) -> Matrix6<f64> {
    let inverse = left_jacobian_inverse(&twist.reversed());
    let covariance = inverse * covariance * inverse.transpose();
    (covariance + covariance.transpose()) * 0.5
}

/// The inverse left Jacobian of SE(3) at a twist, on (v, ω): log(exp(δ) exp(ξ)) = ξ + J_l⁻¹(ξ) δ to
/// first order in δ.
///
/// The inverse right Jacobian, J_r⁻¹(ξ) with log(exp(ξ) exp(δ)) = ξ + J_r⁻¹(ξ) δ, is J_l⁻¹(−ξ). The
/// twist must have |ω| < π.
///
/// Source: T. Barfoot, State Estimation for Robotics, the closed form of Q.
pub fn left_jacobian_inverse(twist: &Twist) -> Matrix6<f64> {
    let rho = twist.linear.cross_matrix();
    let phi = twist.angular.cross_matrix();
    let angle = twist.angular.norm();
    let x = angle * angle;

    // The three coefficients of Barfoot's Q and the φ̂² coefficient of J⁻¹, the inverse left
    // Jacobian of SO(3). Near θ = 0 all four are evaluated by series.
    let (first, second, third, inverse) = if angle < SERIES_ANGLE_RAD {
        (
            series(
                x,
                &[1.0 / 6.0, -1.0 / 120.0, 1.0 / 5_040.0, -1.0 / 362_880.0],
            ),
            series(
                x,
                &[1.0 / 24.0, -1.0 / 720.0, 1.0 / 40_320.0, -1.0 / 3_628_800.0],
            ),
            series(
                x,
                &[
                    1.0 / 120.0,
                    -1.0 / 2_520.0,
                    1.0 / 120_960.0,
                    -1.0 / 9_979_200.0,
                ],
            ),
            series(
                x,
                &[
                    1.0 / 12.0,
                    1.0 / 720.0,
                    1.0 / 30_240.0,
                    1.0 / 1_209_600.0,
                    1.0 / 47_900_160.0,
                ],
            ),
        )
    } else {
        let (sine, cosine) = angle.sin_cos();
        let half = 0.5 * angle;

        (
            (angle - sine) / (x * angle),
            (x + 2.0 * cosine - 2.0) / (2.0 * x * x),
            (2.0 * angle - 3.0 * sine + angle * cosine) / (2.0 * x * x * angle),
            (1.0 - half * half.cos() / half.sin()) / x,
        )
    };

    // Q for the twist (ρ, φ); here `rho` and `phi` are the matrices ρ̂ and φ̂, `both` is φ̂ρ̂ and
    // `turned` is ρ̂φ̂.
    let both = phi * rho;
    let turned = rho * phi;
    let q = rho * 0.5
        + (both + turned + phi * turned) * first
        + (phi * both + turned * phi - phi * turned * 3.0) * second
        + (phi * turned * phi + phi * phi * turned) * third;

    // On (v, ω) the result is the block matrix [[J⁻¹, −J⁻¹ Q J⁻¹], [0, J⁻¹]].
    let rotation = Matrix3::identity() - phi * 0.5 + phi * phi * inverse;
    let mut jacobian = Matrix6::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);

    jacobian
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(-rotation * q * rotation));

    jacobian
}

/// Axis times angle, radians, |ω| ≤ π. Accurate at every angle: atan2 has no cancellation.
fn rotation_vector(rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
    let w = rotation.w;
    let v = rotation.imag();

    // q and −q are the same rotation; the one with w ≥ 0 gives the angle in [0, π].
    let (w, v) = if w < 0.0 { (-w, -v) } else { (w, v) };
    let sine = v.norm();

    if sine == 0.0 {
        return v * 2.0;
    }

    v * (2.0 * sine.atan2(w) / sine)
}

/// Horner's rule for Σ coefficient_i xⁱ.
fn series(x: f64, coefficients: &[f64]) -> f64 {
    coefficients
        .iter()
        .rev()
        .fold(0.0, |sum, coefficient| sum * x + coefficient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix4;
    use proptest::prelude::*;

    fn twists(angle_limit: f64) -> impl Strategy<Value = Twist> {
        (
            prop::array::uniform3(-2.0..2.0f64),
            prop::array::uniform3(-1.0..1.0f64),
            0.0..angle_limit,
        )
            .prop_filter_map("axis of no length", |(linear, axis, angle)| {
                let axis = Vector3::from(axis).try_normalize(1e-3)?;
                Some(Twist {
                    linear: linear.into(),
                    angular: axis * angle,
                })
            })
    }

    /// ξ̂ as the 4×4 matrix of the definition.
    fn hat(twist: &Twist) -> Matrix4<f64> {
        let mut matrix = Matrix4::zeros();
        matrix
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&twist.angular.cross_matrix());

        matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&twist.linear);
        matrix
    }

    proptest! {
        /// Oracle: the general matrix exponential.
        #[test]
        fn exp_is_the_matrix_exponential(xi in twists(6.0)) {
            prop_assert!((exp(&xi).to_homogeneous() - hat(&xi).exp()).norm() < 1e-9);
        }

        /// Oracle: the definition of a logarithm.
        #[test]
        fn log_undoes_exp_below_pi(xi in twists(std::f64::consts::PI - 1e-3)) {
            prop_assert!((log(&exp(&xi)).to_vector() - xi.to_vector()).norm() < 1e-9);
        }

        /// Oracle: the adjoint's defining identity, exp(Ad_T ξ) = T exp(ξ) T⁻¹.
        #[test]
        fn adjoint_moves_a_twist_to_the_other_frame(xi in twists(3.0), frame in twists(3.0)) {
            let t = exp(&frame);
            let moved = Twist::from_vector(&(adjoint(&t) * xi.to_vector()));
            let expected = t * exp(&xi) * t.inverse();
            prop_assert!((exp(&moved).to_homogeneous() - expected.to_homogeneous()).norm() < 1e-9);
        }

        /// Oracle: A-23, a body twist cut in n parts and composed n times is the whole motion.
        #[test]
        fn equal_parts_compose_to_the_whole(xi in twists(3.0), parts in 1u32..9) {
            let part = exp(&xi.divided(parts));
            let composed = (0..parts).fold(Pose::identity(), |pose, _| pose * part);
            prop_assert!((composed.to_homogeneous() - exp(&xi).to_homogeneous()).norm() < 1e-9);
        }
    }

    /// Oracle: by hand. A half turn about z with t = (0, 2, 0) has v = V⁻¹t = (π, 0, 0): the camera
    /// moves along a half circle of radius 1 and length π.
    #[test]
    fn a_half_turn_has_the_half_circle_as_its_logarithm() {
        let motion = Isometry3::from_parts(
            Translation3::new(0.0, 2.0, 0.0),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI),
        );
        let twist = log(&motion);

        assert!((twist.linear - Vector3::new(std::f64::consts::PI, 0.0, 0.0)).norm() < 1e-12);
        assert!(!twist.is_unique_logarithm());
    }
}
