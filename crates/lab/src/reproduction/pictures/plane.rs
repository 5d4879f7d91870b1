//! The principal plane of a recording's positions, seen from above.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use seese3_core::geometry::Pose;

/// A plane through the mean position of a path.
pub struct Plane {
    middle: Vector3<f64>,
    axes: [Vector3<f64>; 2],
}

impl Plane {
    /// The principal plane of a path with at least one pose, seen from above: from the side of the
    /// cameras' mean up direction.
    pub fn of(poses: &[Pose]) -> Self {
        let count = poses.len() as f64;
        let position = |pose: &Pose| pose.translation.vector;
        let middle = poses.iter().map(position).sum::<Vector3<f64>>() / count;

        let spread: Matrix3<f64> = poses
            .iter()
            .map(|pose| position(pose) - middle)
            .map(|apart| apart * apart.transpose())
            .sum();
        let eigen = SymmetricEigen::new(spread);
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let axis = |which: usize| eigen.eigenvectors.column(order[which]).into_owned();

        // A camera's y axis points down in the image.
        let up: Vector3<f64> = poses.iter().map(|pose| pose.rotation * -Vector3::y()).sum();
        let first = axis(0);
        let second = axis(1) * first.cross(&axis(1)).dot(&up).signum();

        Self {
            middle,
            axes: [first, second],
        }
    }

    /// A camera's position in the plane, meters, and its heading, radians from the first axis.
    pub fn place(&self, pose: &Pose) -> [f64; 3] {
        let on = |vector: Vector3<f64>| self.axes.map(|axis| axis.dot(&vector));
        let [x, y] = on(pose.translation.vector - self.middle);
        let [right, ahead] = on(pose.rotation * Vector3::z());

        [x, y, ahead.atan2(right)]
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    /// Oracle: by hand. Level cameras over a floor in x and z, with up along −y as in OpenCV. Seen
    /// from above, the forward direction is 90° to the left of the right direction.
    #[test]
    fn a_level_path_is_seen_from_above() {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::FRAC_PI_2);
        let poses: Vec<Pose> = [[0.0, 0.0], [4.0, 0.0], [4.0, 1.0]]
            .map(|[x, z]| Pose::from_parts(Translation3::new(x, 1.0, z), turn))
            .to_vec();
        let plane = Plane::of(&poses);
        let [a, b, c] = [0, 1, 2].map(|at: usize| plane.place(&poses[at]));

        // The camera looks from the first pose to the second; the third lies to its left.
        let ahead = [b[0] - a[0], b[1] - a[1]];
        assert!((ahead[0].hypot(ahead[1]) - 4.0).abs() < 1e-9);
        assert!((ahead[1].atan2(ahead[0]) - a[2]).abs() < 1e-9);
        let left = ahead[0] * (c[1] - b[1]) - ahead[1] * (c[0] - b[0]);
        assert!((left - 4.0).abs() < 1e-9, "{left}");
    }
}
