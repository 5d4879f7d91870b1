//! P3P: the camera poses that see three known points in three known directions.
//!
//! Source: M. Persson and K. Nordberg, "Lambda Twist: An Accurate Fast Robust Perspective Three
//! Point (P3P) Solver", ECCV 2018. The distances λ to the points satisfy two quadratic forms; a
//! combination of the two that factors into planes gives up to four solutions.

use nalgebra::{
    Isometry3, Matrix3, Rotation3, SymmetricEigen, Translation3, UnitQuaternion, Vector3,
};

/// Newton steps that polish the distances.
const POLISHING_STEPS: usize = 3;

/// Poses `camera_from_world` that see the world points in the given unit directions; at most four.
pub(super) fn p3p(
    directions: &[Vector3<f64>; 3],
    points: &[Vector3<f64>; 3],
) -> Vec<Isometry3<f64>> {
    let pairs = [(0, 1), (0, 2), (1, 2)];
    let squared = pairs.map(|(i, j)| (points[i] - points[j]).norm_squared());
    let cosines = pairs.map(|(i, j)| directions[i].dot(&directions[j]));

    // Points in one place give no pose.
    let longest = squared.iter().copied().fold(0.0, f64::max);
    if !squared.iter().all(|&length| length > 1e-12 * longest) {
        return Vec::new();
    }

    // λᵀ forms[k] λ = squared[k].
    let forms: Vec<Matrix3<f64>> = pairs
        .iter()
        .zip(cosines)
        .map(|(&(i, j), cosine)| {
            let mut form = Matrix3::zeros();
            form[(i, i)] = 1.0;
            form[(j, j)] = 1.0;
            form[(i, j)] = -cosine;
            form[(j, i)] = -cosine;
            form
        })
        .collect();

    // Two forms that are zero at the solution, and a combination of them that has rank two.
    let first = (forms[0] * squared[2] - forms[2] * squared[0]) / longest;
    let second = (forms[1] * squared[2] - forms[2] * squared[1]) / longest;
    let Some(factor) = singular_factor(&first, &second) else {
        return Vec::new();
    };

    let mut poses = Vec::with_capacity(4);
    for normal in planes(&(first + second * factor)) {
        for direction in zeros_in_plane(&first, &second, normal) {
            let length = (direction.transpose() * forms[2] * direction)[0];
            if length <= 0.0 {
                continue;
            }

            let scale = (squared[2] / length).sqrt() * direction.sum().signum();
            let distances = polished(direction * scale, &forms, &squared);
            if distances.iter().all(|&distance| distance > 0.0) {
                poses.extend(pose(directions, points, distances));
            }
        }
    }

    poses
}

/// A real γ for which first + γ · second is singular.
fn singular_factor(first: &Matrix3<f64>, second: &Matrix3<f64>) -> Option<f64> {
    let column = |matrix: &Matrix3<f64>, k: usize| matrix.column(k).into_owned();
    let triple = |a: Vector3<f64>, b: Vector3<f64>, c: Vector3<f64>| a.dot(&b.cross(&c));
    let [a, b] = [first, second].map(|matrix| [0, 1, 2].map(|k| column(matrix, k)));

    // det(first + γ second), by powers of γ.
    let coefficients = [
        triple(a[0], a[1], a[2]),
        triple(b[0], a[1], a[2]) + triple(a[0], b[1], a[2]) + triple(a[0], a[1], b[2]),
        triple(a[0], b[1], b[2]) + triple(b[0], a[1], b[2]) + triple(b[0], b[1], a[2]),
        triple(b[0], b[1], b[2]),
    ];
    real_root(coefficients)
}

/// A real root of c0 + c1 x + c2 x² + c3 x³; `None` if the polynomial has none or is constant.
fn real_root(c: [f64; 4]) -> Option<f64> {
    let largest = c.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    if largest == 0.0 || !largest.is_finite() {
        return None;
    }

    if c[3].abs() < 1e-14 * largest {
        // Quadratic or linear.
        if c[2].abs() < 1e-14 * largest {
            return (c[1].abs() > 1e-14 * largest).then(|| -c[0] / c[1]);
        }
        let discriminant = c[1] * c[1] - 4.0 * c[2] * c[0];
        return (discriminant >= 0.0).then(|| (-c[1] + discriminant.sqrt()) / (2.0 * c[2]));
    }

    // Depressed cubic t³ + p t + q with x = t − b/3.
    let [b, linear, constant] = [c[2] / c[3], c[1] / c[3], c[0] / c[3]];
    let p = linear - b * b / 3.0;
    let q = 2.0 * b * b * b / 27.0 - b * linear / 3.0 + constant;
    let discriminant = q * q / 4.0 + p * p * p / 27.0;

    let t = if discriminant >= 0.0 {
        let root = discriminant.sqrt();
        (-q / 2.0 + root).cbrt() + (-q / 2.0 - root).cbrt()
    } else {
        // Of the three real roots, the one farthest from the others is best conditioned.
        let radius = 2.0 * (-p / 3.0).sqrt();
        let angle = (3.0 * q / (p * radius)).clamp(-1.0, 1.0).acos() / 3.0;
        let third = std::f64::consts::TAU / 3.0;
        let roots = [0.0, 1.0, 2.0].map(|k| radius * (angle - third * k).cos());
        let gap = |root: f64| (3.0 * root * root + p).abs();
        roots
            .into_iter()
            .max_by(|x, y| gap(*x).total_cmp(&gap(*y)))?
    };

    // Newton steps remove the cancellation of the closed form.
    let mut x = t - b / 3.0;
    for _ in 0..3 {
        let value = constant + x * (linear + x * (b + x));
        let slope = linear + x * (2.0 * b + 3.0 * x);
        if slope.abs() > 0.0 {
            x -= value / slope;
        }
    }

    x.is_finite().then_some(x)
}

/// Normals of the two planes on which a quadratic form of rank two is zero; none if it is definite
/// on its range.
fn planes(form: &Matrix3<f64>) -> Vec<Vector3<f64>> {
    let eigen = SymmetricEigen::new(*form);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));

    let [largest, _, smallest] = order.map(|k| eigen.eigenvalues[k]);
    if !(largest > 0.0 && smallest < 0.0) {
        return Vec::new();
    }

    let axis = |place: usize| eigen.eigenvectors.column(order[place]).into_owned();
    let ratio = (-smallest / largest).sqrt();
    vec![axis(0) - axis(2) * ratio, axis(0) + axis(2) * ratio]
}

/// Directions in a plane through the origin on which both forms are zero; at most two.
fn zeros_in_plane(
    first: &Matrix3<f64>,
    second: &Matrix3<f64>,
    normal: Vector3<f64>,
) -> Vec<Vector3<f64>> {
    let u = normal.cross(&Vector3::ith(normal.iamin(), 1.0)).normalize();
    let v = normal.cross(&u).normalize();

    // A x² + B xy + C y² on the plane, for the form that is larger there.
    let on_plane = |form: &Matrix3<f64>| {
        let [fu, fv] = [form * u, form * v];
        [u.dot(&fu), 2.0 * u.dot(&fv), v.dot(&fv)]
    };
    let size = |c: &[f64; 3]| c.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    let forms = [on_plane(first), on_plane(second)];
    let [a, b, c] = if size(&forms[0]) > size(&forms[1]) {
        forms[0]
    } else {
        forms[1]
    };

    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return Vec::new();
    }

    let root = discriminant.sqrt();
    if a.abs() > c.abs() {
        [(-b + root) / (2.0 * a), (-b - root) / (2.0 * a)]
            .map(|ratio| u * ratio + v)
            .to_vec()
    } else if c != 0.0 {
        [(-b + root) / (2.0 * c), (-b - root) / (2.0 * c)]
            .map(|ratio| u + v * ratio)
            .to_vec()
    } else {
        Vec::new()
    }
}

/// Newton's method on the three distance equations.
fn polished(
    mut distances: Vector3<f64>,
    forms: &[Matrix3<f64>],
    squared: &[f64; 3],
) -> Vector3<f64> {
    for _ in 0..POLISHING_STEPS {
        let mut jacobian = Matrix3::zeros();
        let mut residual = Vector3::zeros();
        for (row, (form, wanted)) in forms.iter().zip(squared).enumerate() {
            let slope = form * distances;
            residual[row] = distances.dot(&slope) - wanted;
            jacobian.set_row(row, &(slope * 2.0).transpose());
        }

        match jacobian.try_inverse() {
            Some(inverse) => distances -= inverse * residual,
            None => break,
        }
    }

    distances
}

/// The pose `camera_from_world` from the three points in both frames.
fn pose(
    directions: &[Vector3<f64>; 3],
    points: &[Vector3<f64>; 3],
    distances: Vector3<f64>,
) -> Option<Isometry3<f64>> {
    let seen = [0, 1, 2].map(|k| directions[k] * distances[k]);
    let frame = |[a, b, c]: &[Vector3<f64>; 3]| {
        let [ab, ac] = [b - a, c - a];
        Matrix3::from_columns(&[ab, ac, ab.cross(&ac)])
    };

    let rotation = frame(&seen) * frame(points).try_inverse()?;
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = seen[0] - rotation * points[0];
    let pose = Isometry3::from_parts(Translation3::from(translation), rotation);

    pose.to_homogeneous()
        .iter()
        .all(|x| x.is_finite())
        .then_some(pose)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn vectors(most: f64) -> impl Strategy<Value = Vector3<f64>> {
        [-most..most, -most..most, -most..most].prop_map(Vector3::from)
    }

    proptest! {
        /// Oracle: the pose that the directions were computed from is among the solutions, and
        /// every solution sees the points in these directions.
        #[test]
        fn the_true_pose_is_found(
            turn in vectors(3.0), shift in vectors(5.0),
            plane in prop::array::uniform3([-0.6..0.6, -0.5..0.5]),
            depths in prop::array::uniform3(0.3..8.0),
        ) {
            let world_from_camera = Isometry3::new(shift, turn);
            let seen: [Vector3<f64>; 3] = [0, 1, 2].map(|k| Vector3::new(plane[k][0], plane[k][1], 1.0) * depths[k]);
            let directions = seen.map(|point| point.normalize());

            // Nearly collinear triangles are badly conditioned for any solver.
            let area = (seen[1] - seen[0]).cross(&(seen[2] - seen[0])).norm();
            prop_assume!(area > 0.05);
            prop_assume!((directions[1] - directions[0]).cross(&(directions[2] - directions[0])).norm() > 1e-2);

            let points = seen.map(|point| (world_from_camera * nalgebra::Point3::from(point)).coords);
            let poses = p3p(&directions, &points);
            prop_assert!(poses.len() <= 4);

            let truth = world_from_camera.inverse();
            let error = |pose: &Isometry3<f64>| {
                let off = pose.inverse() * truth;
                off.translation.vector.norm() + off.rotation.angle()
            };
            let best = poses.iter().map(error).fold(f64::INFINITY, f64::min);
            prop_assert!(best < 1e-5, "{} poses, best {best:e}", poses.len());

            for pose in &poses {
                for (direction, point) in directions.iter().zip(&points) {
                    let seen = pose * nalgebra::Point3::from(*point);
                    prop_assert!((seen.coords.normalize() - direction).norm() < 1e-6);
                }
            }
        }
    }
}
