//! Theorem 1: features of a static scene lie on a manifold of dimension at most six, exactly six if
//! the map is an embedding.

use ndarray::Array2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::feature_map::pose_near;
use super::{Bound, Check, ConstructedMap, DrawnMap, Effort, FeatureMap};
use crate::probes::{self, IntrinsicDimension, intrinsic_dimension};
use seese3_core::geometry::{Pose, Twist, exp};

/// Width of the constructed features.
const DIM: usize = 48;
/// Radius of the region of poses, meters and radians.
const RADIUS: f64 = 0.6;
/// Radius of the region of poses for drawn maps.
const DRAWN_RADIUS: f64 = 0.15;
/// Tolerance of the dimension estimates: their error on known manifolds of this size (checked on
/// Gaussians of rank 6).
const TOLERANCE: f64 = 1.0;

pub(super) fn checks(effort: Effort, random: &mut ChaCha8Rng) -> Result<Vec<Check>, probes::Error> {
    let near = |random: &mut ChaCha8Rng| -> Vec<Pose> {
        (0..effort.poses)
            .map(|_| pose_near(&Pose::identity(), RADIUS, random))
            .collect()
    };

    // The first map depends on position and rotation. The second depends only on x and y, so its
    // features lie on a surface.
    let embedding = ConstructedMap::new(DIM, 12, random);
    let flat = ConstructedMap::new(DIM, 2, random);
    let poses = near(random);
    let whole = dimension(&embedding, &poses)?;

    let collapsed = dimension(&flat, &poses)?;

    // Sample poses at random along the path. Evenly spaced poses have two neighbors at equal
    // distances, and a ratio of 1 carries no information for TwoNN.
    let ahead = Twist {
        linear: [1.0, 0.2, 0.0].into(),
        angular: [0.0, 0.4, 0.1].into(),
    };
    let mut along = || Twist::from_vector(&(ahead.to_vector() * random.random_range(0.0..4.0)));
    let line: Vec<Pose> = (0..effort.poses).map(|_| exp(&along())).collect();
    let path = dimension(&embedding, &line)?;

    // A rendered image need not be an embedding of the pose, so it has only an upper bound.
    let (room, center) = DrawnMap::new(effort.seed, 0);
    let seen: Vec<Pose> = (0..effort.poses / 2)
        .map(|_| pose_near(&center, DRAWN_RADIUS, random))
        .collect();
    let drawn = dimension(&room, &seen)?;

    let check = |what: &'static str, measured: f64, bound: Bound| Check {
        theorem: "1",
        what,
        measured,
        bound,
    };

    let six = Bound::Between(6.0 - TOLERANCE, 6.0 + TOLERANCE);
    Ok(vec![
        check("TwoNN of a constructed embedding", whole.two_nn.linear, six),
        check(
            "MLE of a constructed embedding",
            whole.mle_biased.harmonic,
            six,
        ),
        check(
            "TwoNN of a map of x and y alone",
            collapsed.two_nn.linear,
            Bound::Between(1.5, 2.5),
        ),
        check(
            "TwoNN of poses along one path: a recording is a curve",
            path.two_nn.linear,
            Bound::Between(0.8, 1.2),
        ),
        check(
            "TwoNN of a drawn room's patch colors",
            drawn.two_nn.linear,
            Bound::AtMost(6.0 + TOLERANCE),
        ),
        check(
            "MLE of a drawn room's patch colors",
            drawn.mle_biased.harmonic,
            Bound::AtMost(6.0 + TOLERANCE),
        ),
    ])
}

fn dimension(map: &dyn FeatureMap, poses: &[Pose]) -> Result<IntrinsicDimension, probes::Error> {
    let rows: Vec<Vec<f32>> = poses
        .par_iter()
        .map(|pose| map.feature(pose).iter().map(|&x| x as f32).collect())
        .collect();
    let columns = rows.first().map_or(0, Vec::len);
    let features = Array2::from_shape_fn((rows.len(), columns), |(row, column)| rows[row][column]);

    intrinsic_dimension(features.view(), 0)
}
