//! Nine numbers to a pose, and the derivative of a pose loss by them.
//!
//! The numbers are t, a₁, a₂; R = (b₁, b₂, b₁ × b₂) with b₁, b₂ from a₁, a₂ by Gram and Schmidt:
//! the 6D rotation of Zhou et al. (2019). Losses are squared lengths of logarithms; their gradient
//! by a pose T is the q of T exp(δ), dL = q·δ.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3, Vector6};
use ndarray::ArrayView1;

use crate::adapter::Real;
use crate::geometry::{Pose, Twist, left_jacobian_inverse, log};

/// Numbers of a pose.
pub const POSE_NUMBERS: usize = 9;
/// Shorter vectors have no direction; they are taken for this long, as PyTorch's `normalize` does.
const SHORTEST: f64 = 1e-12;

/// A pose and what its derivative needs.
pub struct HeadPose {
    first: Vector3<f64>,
    second: Vector3<f64>,
    basis: [Vector3<f64>; 3],
    /// What is left of a₂ beside b₁, before it is made a unit.
    beside: Vector3<f64>,
    /// The pose.
    pub pose: Pose,
}

impl HeadPose {
    /// Reads nine numbers.
    pub fn of<T: Real>(row: ArrayView1<'_, T>) -> Self {
        let three = |first: usize| Vector3::from_fn(|i, _| row[first + i].f64());
        let translation = three(0);
        let first = three(3);
        let second = three(6);

        let b1 = first / first.norm().max(SHORTEST);
        let beside = second - b1 * b1.dot(&second);
        let b2 = beside / beside.norm().max(SHORTEST);
        let basis = [b1, b2, b1.cross(&b2)];
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&basis));
        let pose = Pose::from_parts(
            translation.into(),
            UnitQuaternion::from_rotation_matrix(&rotation),
        );

        Self {
            first,
            second,
            basis,
            beside,
            pose,
        }
    }

    /// The gradient by the nine numbers, of the gradient q by the pose.
    pub fn backward(&self, q: &Vector6<f64>) -> [f64; POSE_NUMBERS] {
        let [b1, b2, _] = self.basis;
        let rotation = Matrix3::from_columns(&self.basis);
        let d_translation = rotation * q.fixed_rows::<3>(0);

        // ⟨G, R ω̂⟩ = q_ω·ω for G = R q̂_ω / 2.
        let g = rotation * Vector3::from(q.fixed_rows::<3>(3)).cross_matrix() * 0.5;
        let column = |i: usize| Vector3::from(g.column(i));
        let mut d_b1 = column(0) + b2.cross(&column(2));
        let d_b2 = column(1) + column(2).cross(&b1);
        let d_beside = (d_b2 - b2 * b2.dot(&d_b2)) / self.beside.norm().max(SHORTEST);
        let d_second = d_beside - b1 * b1.dot(&d_beside);

        d_b1 -= self.second * b1.dot(&d_beside) + d_beside * b1.dot(&self.second);
        let d_first = (d_b1 - b1 * b1.dot(&d_b1)) / self.first.norm().max(SHORTEST);

        std::array::from_fn(|i| match i {
            0..3 => d_translation[i],
            3..6 => d_first[i - 3],
            _ => d_second[i - 6],
        })
    }
}

/// ‖log(T⁻¹ target)‖², and its gradient by T.
pub fn pose_loss(pose: &Pose, target: &Pose) -> (f64, Vector6<f64>) {
    // T exp(δ): the logarithm moves by −J_l⁻¹ δ.
    let (loss, d) = squared_log(&pose.inv_mul(target));
    (loss, -d)
}

/// ‖log E‖², and its gradient g by a motion on the left, exp(δ) E: dL = g·δ.
pub fn squared_log(error: &Pose) -> (f64, Vector6<f64>) {
    let twist: Twist = log(error);
    let xi = twist.to_vector();

    (
        xi.norm_squared(),
        left_jacobian_inverse(&twist).transpose() * xi * 2.0,
    )
}
