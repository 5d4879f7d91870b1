//! Poses, beliefs and covariances as numbers, and back to the bit.

use nalgebra::{Quaternion, SMatrix, Translation3, UnitQuaternion, Vector6};

use super::super::super::Error;
use seese3_core::geometry::{Pose, Twist};
use seese3_core::tracking::{Belief, Driven, MovingBelief};

/// The 28 numbers of a belief: those of its pose and of its covariance.
pub(super) fn belief_to_numbers(belief: &Belief) -> Vec<f64> {
    let mut numbers = pose_to_numbers(&belief.pose);
    numbers.extend(upper_triangle::<6>().map(|at| belief.covariance[at]));
    numbers
}

/// The 91 numbers of a moving belief: those of its pose, six of its velocity, and those of its
/// covariance.
pub(super) fn moving_to_numbers(belief: &MovingBelief) -> Vec<f64> {
    let mut numbers = pose_to_numbers(&belief.pose);
    numbers.extend(&belief.velocity.to_vector());
    numbers.extend(upper_triangle::<12>().map(|at| belief.covariance[at]));
    numbers
}

/// Translation and quaternion (x, y, z, w).
pub(super) fn pose_to_numbers(pose: &Pose) -> Vec<f64> {
    let t = pose.translation.vector;
    let q = pose.rotation.coords;
    vec![t.x, t.y, t.z, q.x, q.y, q.z, q.w]
}

/// The nine numbers of what was driven; none of nothing.
pub(super) fn driven_to_numbers(driven: Option<&Driven>) -> Vec<f64> {
    driven.map_or_else(Vec::new, |driven| {
        let mut numbers = pose_to_numbers(&driven.pose);
        numbers.extend([driven.way_m, driven.turns_rad]);
        numbers
    })
}

/// What was driven by such numbers; nothing if there are none.
pub(super) fn driven_of_numbers(numbers: &[f64]) -> Result<Option<Driven>, Error> {
    if numbers.is_empty() {
        return Ok(None);
    }

    let (pose, rest) = pose_of_numbers(numbers)?;
    let &[way_m, turns_rad] = rest else {
        return Err(Error::Internal);
    };
    Ok(Some(Driven {
        pose,
        way_m,
        turns_rad,
    }))
}

/// The places of the upper triangle of a symmetric matrix, row by row.
pub(super) fn upper_triangle<const N: usize>() -> impl Iterator<Item = (usize, usize)> {
    (0..N).flat_map(|row| (row..N).map(move |column| (row, column)))
}

/// The belief of such numbers; none if there are no numbers.
pub(super) fn belief_of_numbers(numbers: &[f64]) -> Result<Option<Belief>, Error> {
    if numbers.is_empty() {
        return Ok(None);
    }

    let (pose, upper) = pose_of_numbers(numbers)?;
    Ok(Some(Belief {
        pose,
        covariance: symmetric(upper)?,
    }))
}

/// The moving belief of such numbers.
pub(super) fn moving_of_numbers(numbers: &[f64]) -> Result<MovingBelief, Error> {
    let (pose, rest) = pose_of_numbers(numbers)?;
    let (velocity, upper) = rest.split_at_checked(6).ok_or(Error::Internal)?;
    Ok(MovingBelief {
        pose,
        velocity: Twist::from_vector(&Vector6::from_column_slice(velocity)),
        covariance: symmetric(upper)?,
    })
}

/// The pose of seven numbers, and those after them.
pub(super) fn pose_of_numbers(numbers: &[f64]) -> Result<(Pose, &[f64]), Error> {
    let &[x, y, z, i, j, k, w, ref rest @ ..] = numbers else {
        return Err(Error::Internal);
    };

    // The quaternion is not normalised again: that could change its last bit, and answers after a
    // resume must equal those without one.
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
    let pose = Pose::from_parts(Translation3::new(x, y, z), rotation);
    Ok((pose, rest))
}

/// The symmetric matrix with this upper triangle.
pub(super) fn symmetric<const N: usize>(upper: &[f64]) -> Result<SMatrix<f64, N, N>, Error> {
    if upper.len() != N * (N + 1) / 2 {
        return Err(Error::Internal);
    }

    let mut matrix = SMatrix::zeros();
    for ((row, column), value) in upper_triangle::<N>().zip(upper) {
        matrix[(row, column)] = *value;
        matrix[(column, row)] = *value;
    }
    Ok(matrix)
}

pub(super) fn required(numbers: &[f64]) -> Result<Belief, Error> {
    belief_of_numbers(numbers)?.ok_or(Error::Internal)
}

/// The numbers of a belief; none of an unknown one.
pub(super) fn numbers(belief: &Option<Belief>) -> Vec<f64> {
    belief.as_ref().map_or_else(Vec::new, belief_to_numbers)
}
