//! M1: do frames that look alike stand alike?

use ndarray::{ArrayView2, Axis};
use rayon::prelude::*;

use super::Error;
use crate::geometry::Pose;

/// What decides M1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MutualKnn {
    /// Frames that are compared: 0, s, 2s, …
    pub frames: usize,
    /// s, in frames of the room.
    pub stride: usize,
    /// Neighbours of each.
    pub k: usize,
    /// Frames at most this far away among those compared are no neighbours; a frame itself never is.
    pub exclusion: usize,
}

impl Default for MutualKnn {
    /// The paper's: 256 frames, k = 10, 10 frames to each side left out.
    fn default() -> Self {
        Self { frames: 256, stride: 1, k: 10, exclusion: 10 }
    }
}

/// The mean share of a frame's k nearest by feature (cosine) that are among its k nearest by pose, 0 to 1.
///
/// `rows` are features (n, d), `poses` are `world_from_camera`, metres.
///
/// # Errors
/// [`Error::TooFewFrames`], [`Error::TooFewCandidates`], [`Error::NoDirection`].
///
/// Source: SeeSE3, M1.
pub fn mutual_knn(rows: ArrayView2<'_, f32>, poses: &[Pose], options: &MutualKnn) -> Result<f64, Error> {
    let (by_feature, by_pose) = (feature_neighbours(rows, options)?, pose_neighbours(poses, options)?);
    let shared = |(a, b): (&Vec<usize>, &Vec<usize>)| a.iter().filter(|frame| b.contains(frame)).count();
    let shared: usize = by_feature.iter().zip(&by_pose).map(shared).sum();
    Ok(shared as f64 / (options.frames * options.k) as f64)
}

/// The k nearest of each compared frame by the cosine of their features, nearest first, ties to the smaller number.
///
/// # Errors
/// As [`mutual_knn`].
pub fn feature_neighbours(rows: ArrayView2<'_, f32>, options: &MutualKnn) -> Result<Vec<Vec<usize>>, Error> {
    let sampled = sampled(rows.nrows(), options)?;
    let mut units = rows.select(Axis(0), &sampled).mapv(f64::from);
    for (mut row, &frame) in units.outer_iter_mut().zip(&sampled) {
        let norm = row.iter().map(|x| x * x).sum::<f64>().sqrt();
        if norm == 0.0 {
            return Err(Error::NoDirection { row: frame });
        }
        row /= norm;
    }
    // Summed in one order for every pair, so that identical rows are exactly as far from any other.
    let distance = |a: usize, b: usize| 1.0 - units.row(a).iter().zip(units.row(b)).map(|(x, y)| x * y).sum::<f64>();
    neighbours(options, distance)
}

/// The k nearest of each compared frame by (t, R[:, 0], R[:, 1]), metres and no unit, nearest first.
///
/// # Errors
/// As [`mutual_knn`].
pub fn pose_neighbours(poses: &[Pose], options: &MutualKnn) -> Result<Vec<Vec<usize>>, Error> {
    let nine = |frame: usize| -> [f64; 9] {
        let (t, r) = (poses[frame].translation.vector, poses[frame].rotation.to_rotation_matrix());
        let r = r.matrix();
        std::array::from_fn(|i| if i < 3 { t[i] } else { r[(i % 3, i / 3 - 1)] })
    };
    let points: Vec<[f64; 9]> = sampled(poses.len(), options)?.into_iter().map(nine).collect();
    let distance =
        |a: usize, b: usize| points[a].iter().zip(&points[b]).map(|(x, y)| (x - y) * (x - y)).sum::<f64>().sqrt();
    neighbours(options, distance)
}

fn sampled(have: usize, options: &MutualKnn) -> Result<Vec<usize>, Error> {
    let &MutualKnn { frames, stride, k, .. } = options;
    for (what, given) in [("frames", frames), ("stride", stride), ("k", k)] {
        if given == 0 {
            return Err(Error::TooSmall { what, least: 1, given });
        }
    }
    let needed = (frames - 1).saturating_mul(stride).saturating_add(1);
    if needed > have {
        return Err(Error::TooFewFrames { frames, stride, needed, have });
    }
    Ok((0..frames).map(|frame| frame * stride).collect())
}

fn neighbours(options: &MutualKnn, distance: impl Fn(usize, usize) -> f64 + Sync) -> Result<Vec<Vec<usize>>, Error> {
    let &MutualKnn { frames, k, exclusion, .. } = options;
    let of = |frame: usize| {
        let apart = |other: &usize| *other != frame && other.abs_diff(frame) > exclusion;
        let mut others: Vec<(f64, usize)> =
            (0..frames).filter(apart).map(|other| (distance(frame, other), other)).collect();
        if others.len() < k {
            return Err(Error::TooFewCandidates { frame, k, exclusion });
        }
        others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        Ok(others.into_iter().take(k).map(|(_, other)| other).collect())
    };
    (0..frames).into_par_iter().map(of).collect()
}
