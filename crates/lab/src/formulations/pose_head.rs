//! Conversion of nine network outputs to a pose, and gradients of pose losses with respect to these
//! outputs.
//!
//! The numbers are t, a₁, a₂. The rotation is R = (b₁, b₂, b₁ × b₂), with b₁, b₂ from a₁, a₂ by
//! Gram–Schmidt: the 6D rotation of Zhou et al. (2019). Losses are squared norms of logarithms.
//! Their gradient with respect to a pose T is the vector q with dL = q·δ when T moves to T exp(δ).

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3, Vector6};
use ndarray::ArrayView1;

use seese3_core::adapter::Real;
use seese3_core::geometry::{Pose, Twist, left_jacobian_inverse, log};

/// Number of network outputs per pose.
pub const POSE_NUMBERS: usize = 9;
/// Lower limit of the divisor when vectors are normalized, as in PyTorch's `normalize`.
const SHORTEST: f64 = 1e-12;

/// A pose, with the intermediate values for its gradient.
pub struct HeadPose {
    first: Vector3<f64>,
    second: Vector3<f64>,
    basis: [Vector3<f64>; 3],
    /// The component of a₂ orthogonal to b₁, not normalized.
    beside: Vector3<f64>,
    /// The pose.
    pub pose: Pose,
}

impl HeadPose {
    /// The pose of nine network outputs.
    pub fn of<T: Real>(row: ArrayView1<'_, T>) -> Self {
        let three = |first: usize| Vector3::from_fn(|i, _| row[first + i].f64());
        let translation = three(0);
        let first = three(3);
        let second = three(6);

        // Gram–Schmidt: b₁ is a₁ normalized; b₂ is the normalized component of a₂ orthogonal to b₁.
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

    /// Propagates the gradient q with respect to the pose to the nine network outputs.
    pub fn backward(&self, q: &Vector6<f64>) -> [f64; POSE_NUMBERS] {
        let [b1, b2, _] = self.basis;
        let rotation = Matrix3::from_columns(&self.basis);
        let d_translation = rotation * q.fixed_rows::<3>(0);

        // G = R q̂_ω / 2 is a gradient with respect to the matrix R: ⟨G, R ω̂⟩ = q_ω·ω for every ω.
        let g = rotation * Vector3::from(q.fixed_rows::<3>(3)).cross_matrix() * 0.5;
        let column = |i: usize| Vector3::from(g.column(i));

        // The third column is b₁ × b₂; its gradient flows to both factors.
        let mut d_b1 = column(0) + b2.cross(&column(2));
        let d_b2 = column(1) + column(2).cross(&b1);

        // Gram–Schmidt in reverse order. The gradient of a normalization keeps only the component
        // orthogonal to the unit vector, divided by the length.
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

/// ‖log(T⁻¹ target)‖², and its gradient with respect to T.
pub fn pose_loss(pose: &Pose, target: &Pose) -> (f64, Vector6<f64>) {
    // Moving T to T exp(δ) puts exp(−δ) on the left of T⁻¹ target, hence the minus sign.
    let (loss, d) = squared_log(&pose.inv_mul(target));
    (loss, -d)
}

/// ‖log E‖², and its gradient g with respect to a perturbation on the left, exp(δ) E: dL = g·δ.
pub fn squared_log(error: &Pose) -> (f64, Vector6<f64>) {
    let twist: Twist = log(error);
    let xi = twist.to_vector();

    (
        xi.norm_squared(),
        left_jacobian_inverse(&twist).transpose() * xi * 2.0,
    )
}
