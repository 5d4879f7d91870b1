//! Theorems 3 and 5a, b: error of a motion recovered by a linear readout of features, near one pose
//! and over a region.

use nalgebra::DMatrix;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::feature_map::{pose_near, twist_of_length};
use super::{Bound, Check, ConstructedMap, DrawnMap, Effort, FeatureMap};
use seese3_core::geometry::{Pose, Twist, body_twist, exp};
use seese3_core::statistics::median;

/// Width of the constructed features.
const DIM: usize = 48;
/// Radius of the region, meters and radians.
const RADIUS: f64 = 0.3;
/// Number of poses sampled along a geodesic, including both ends.
const STATIONS: usize = 33;
/// Allowed relative error of a difference quotient.
const SLACK: f64 = 1e-6;

pub(super) fn checks(effort: Effort, random: &mut ChaCha8Rng) -> Vec<Check> {
    let map = ConstructedMap::new(DIM, 12, random);

    let center = exp(&Twist {
        linear: [0.3, -0.2, 0.5].into(),
        angular: [0.4, 0.1, -0.3].into(),
    });

    let (room, pose) = DrawnMap::new(effort.seed, 0);

    let check = |theorem, what, measured, bound| Check {
        theorem,
        what,
        measured,
        bound,
    };

    // Theorem 3: the local readout's error is quadratic in the motion (order 2): halving the motion
    // divides the error by four. Drawn maps are not smooth enough for the full order.
    let order = order(&map, &center, 1e-2, effort.samples, random);
    let drawn = order_of_drawn(&room, &pose, effort.samples / 4, random);
    let global = global(&map, &center, effort.samples, random);

    vec![
        check(
            "3",
            "order of the local readout's error, constructed map",
            order,
            Bound::Equals(2.0, 0.05),
        ),
        check(
            "3",
            "order of the local readout's error, drawn room",
            drawn,
            Bound::AtLeast(1.2),
        ),
        check(
            "5a",
            "largest ‖ε‖ / (sup ‖WJ − I‖ ‖ξ‖) along geodesics",
            global.readout,
            Bound::AtMost(1.0 + SLACK),
        ),
        check(
            "5b",
            "largest ‖WJ(g) − I‖ / (distance · sup ‖W∇J‖)",
            global.variation,
            Bound::AtMost(1.0 + SLACK),
        ),
        check(
            "5a",
            "sup ‖WJ − I‖ over the region, radius 0.3",
            global.spread,
            Bound::Free,
        ),
    ]
}

/// The readout W at a pose: a left inverse of the Jacobian, shape (6, d).
fn readout(map: &dyn FeatureMap, pose: &Pose) -> DMatrix<f64> {
    let jacobian = map.jacobian(pose);

    // With full column rank, as the theorem assumes, the pseudo-inverse is a left inverse.
    jacobian
        .pseudo_inverse(1e-9)
        .unwrap_or_else(|_| DMatrix::zeros(6, 0))
}

/// The order of the readout's error: log₂ of the ratio of the errors for a motion of this length
/// and for half of it. The result is the median over random directions.
fn order(
    map: &dyn FeatureMap,
    pose: &Pose,
    length: f64,
    samples: usize,
    random: &mut ChaCha8Rng,
) -> f64 {
    let w = readout(map, pose);
    let here = map.feature(pose);
    let directions: Vec<Twist> = (0..samples.max(1))
        .map(|_| twist_of_length(length, random))
        .collect();

    let error = |twist: Twist| {
        let read = &w * (map.feature(&(pose * exp(&twist))) - &here);
        (read - twist.to_vector()).norm()
    };
    let orders: Vec<f64> = directions
        .par_iter()
        .map(|&twist| (error(twist) / error(twist.divided(2))).log2())
        .collect();

    median(&orders)
}

fn order_of_drawn(map: &DrawnMap, pose: &Pose, samples: usize, random: &mut ChaCha8Rng) -> f64 {
    order(map, pose, 0.2, samples, random)
}

struct Global {
    readout: f64,
    variation: f64,
    spread: f64,
}

/// The largest ratios over pairs of poses in the region. Suprema are taken along geodesics.
fn global(map: &ConstructedMap, center: &Pose, samples: usize, random: &mut ChaCha8Rng) -> Global {
    // W is the readout at the center, where WJ = I; the theorems bound its error elsewhere.
    let w = readout(map, center);
    let pairs: Vec<[Pose; 2]> = (0..samples)
        .map(|_| [0, 1].map(|_| pose_near(center, RADIUS, random)))
        .collect();

    let off = |pose: &Pose| spectral(&(&w * map.jacobian(pose) - DMatrix::identity(6, 6)));
    let ratios: Vec<[f64; 3]> = pairs
        .par_iter()
        .map(|[from, to]| {
            // 5a: ‖ε‖ ≤ sup ‖WJ − I‖ ‖ξ‖, the supremum along the geodesic between the two poses.
            let xi = body_twist(from, to);
            let error = &w * (map.feature(to) - map.feature(from)) - xi.to_vector();
            let sup = stations(from, xi)
                .map(|pose| off(&pose))
                .fold(0.0, f64::max);

            // 5b: ‖WJ(g) − I‖ ≤ distance · sup ‖W∇J‖, the supremum along the geodesic from the
            // center to g.
            let away = body_twist(center, from);
            let steepest = stations(center, away)
                .map(|pose| slope(map, &w, &pose, away))
                .fold(0.0, f64::max);

            [
                error.norm() / (sup * xi.norm()),
                off(from) / (away.norm() * steepest),
                sup,
            ]
        })
        .collect();

    let largest = |of: usize| ratios.iter().map(|ratio| ratio[of]).fold(0.0, f64::max);
    Global {
        readout: largest(0),
        variation: largest(1),
        spread: largest(2),
    }
}

fn stations(from: &Pose, xi: Twist) -> impl Iterator<Item = Pose> + use<> {
    let from = *from;
    (0..STATIONS).map(move |station| from * exp(&xi.times(station).divided(STATIONS as u32 - 1)))
}

/// ‖W ∂J‖ along `direction` scaled to unit length, by central differences.
fn slope(map: &dyn FeatureMap, w: &DMatrix<f64>, pose: &Pose, direction: Twist) -> f64 {
    const H: f64 = 1e-3;

    let unit = Twist::from_vector(&(direction.to_vector() * (H / direction.norm())));
    let ahead = map.jacobian(&(pose * exp(&unit)));
    let behind = map.jacobian(&(pose * exp(&Twist::from_vector(&-unit.to_vector()))));

    spectral(&(w * (ahead - behind) / (2.0 * H)))
}

/// The largest singular value.
fn spectral(matrix: &DMatrix<f64>) -> f64 {
    matrix.singular_values().max()
}
