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
    /// Frames this near are no neighbours; a frame itself never is.
    pub exclusion: usize,
    /// What `exclusion` counts.
    pub counted: Counted,
    /// Whether a frame that is just `exclusion` away is left out too.
    pub bound: Bound,
}

/// What a temporal distance is counted in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Counted {
    /// The frames that are compared.
    Sampled,
    /// The frames of the room.
    Native,
}

/// Whether a limit belongs to what it limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bound {
    /// It does.
    Inclusive,
    /// It does not.
    Exclusive,
}

impl MutualKnn {
    /// Whether two of the compared frames may be neighbours.
    fn apart(&self, frame: usize, other: usize) -> bool {
        let distance = match self.counted {
            Counted::Sampled => frame.abs_diff(other),
            Counted::Native => frame.abs_diff(other).saturating_mul(self.stride),
        };
        let near = match self.bound {
            Bound::Inclusive => distance <= self.exclusion,
            Bound::Exclusive => distance < self.exclusion,
        };

        frame != other && !near
    }
}

impl Default for MutualKnn {
    /// The paper's: 256 frames, k = 10, 10 frames to each side left out.
    fn default() -> Self {
        Self {
            frames: 256,
            stride: 1,
            k: 10,
            exclusion: 10,
            counted: Counted::Sampled,
            bound: Bound::Inclusive,
        }
    }
}

/// The mean share of a frame's k nearest by feature (cosine) that are among its k nearest by pose,
/// 0 to 1.
///
/// `rows` are features (n, d), `poses` are `world_from_camera`, metres.
///
/// # Errors
/// [`Error::TooFewFrames`], [`Error::TooFewCandidates`], [`Error::NoDirection`].
///
/// Source: SeeSE3, M1.
pub fn mutual_knn(
    rows: ArrayView2<'_, f32>,
    poses: &[Pose],
    options: &MutualKnn,
) -> Result<f64, Error> {
    let by_feature = feature_neighbours(rows, options)?;
    let by_pose = pose_neighbours(poses, options)?;
    let shared =
        |(a, b): (&Vec<usize>, &Vec<usize>)| a.iter().filter(|frame| b.contains(frame)).count();
    let shared: usize = by_feature.iter().zip(&by_pose).map(shared).sum();

    Ok(shared as f64 / (options.frames * options.k) as f64)
}

/// The k nearest of each compared frame by the cosine of their features, nearest first, ties to the
/// smaller number.
///
/// # Errors
/// As [`mutual_knn`].
pub fn feature_neighbours(
    rows: ArrayView2<'_, f32>,
    options: &MutualKnn,
) -> Result<Vec<Vec<usize>>, Error> {
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
    let distance = |a: usize, b: usize| {
        1.0 - units
            .row(a)
            .iter()
            .zip(units.row(b))
            .map(|(x, y)| x * y)
            .sum::<f64>()
    };

    neighbours(options, distance)
}

/// The k nearest of each compared frame by (t, R[:, 0], R[:, 1]), metres and no unit, nearest
/// first.
///
/// # Errors
/// As [`mutual_knn`].
pub fn pose_neighbours(poses: &[Pose], options: &MutualKnn) -> Result<Vec<Vec<usize>>, Error> {
    let nine = |frame: usize| -> [f64; 9] {
        let t = poses[frame].translation.vector;
        let r = poses[frame].rotation.to_rotation_matrix();
        let r = r.matrix();
        std::array::from_fn(|i| if i < 3 { t[i] } else { r[(i % 3, i / 3 - 1)] })
    };
    let points: Vec<[f64; 9]> = sampled(poses.len(), options)?
        .into_iter()
        .map(nine)
        .collect();

    let distance = |a: usize, b: usize| {
        points[a]
            .iter()
            .zip(&points[b])
            .map(|(x, y)| (x - y) * (x - y))
            .sum::<f64>()
            .sqrt()
    };

    neighbours(options, distance)
}

fn sampled(have: usize, options: &MutualKnn) -> Result<Vec<usize>, Error> {
    let &MutualKnn {
        frames, stride, k, ..
    } = options;
    for (what, given) in [("frames", frames), ("stride", stride), ("k", k)] {
        if given == 0 {
            return Err(Error::TooSmall {
                what,
                least: 1,
                given,
            });
        }
    }

    let needed = (frames - 1).saturating_mul(stride).saturating_add(1);
    if needed > have {
        return Err(Error::TooFewFrames {
            frames,
            stride,
            needed,
            have,
        });
    }

    Ok((0..frames).map(|frame| frame * stride).collect())
}

fn neighbours(
    options: &MutualKnn,
    distance: impl Fn(usize, usize) -> f64 + Sync,
) -> Result<Vec<Vec<usize>>, Error> {
    let &MutualKnn {
        frames,
        k,
        exclusion,
        ..
    } = options;

    let of = |frame: usize| {
        let apart = |other: &usize| options.apart(frame, *other);
        let mut others: Vec<(f64, usize)> = (0..frames)
            .filter(apart)
            .map(|other| (distance(frame, other), other))
            .collect();

        if others.len() < k {
            return Err(Error::TooFewCandidates {
                frame,
                k,
                exclusion,
            });
        }

        others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        Ok(others.into_iter().take(k).map(|(_, other)| other).collect())
    };

    (0..frames).into_par_iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand, of a frame and the one three samples on, six frames of the room.
    #[test]
    fn distances_are_counted_as_asked() {
        let apart = |counted, bound, exclusion| {
            MutualKnn {
                stride: 2,
                exclusion,
                counted,
                bound,
                ..MutualKnn::default()
            }
            .apart(4, 7)
        };

        assert!(
            apart(Counted::Sampled, Bound::Inclusive, 2)
                && !apart(Counted::Sampled, Bound::Inclusive, 3)
        );

        assert!(
            apart(Counted::Sampled, Bound::Exclusive, 3)
                && !apart(Counted::Sampled, Bound::Exclusive, 4)
        );

        assert!(
            apart(Counted::Native, Bound::Inclusive, 5)
                && !apart(Counted::Native, Bound::Inclusive, 6)
        );

        assert!(
            apart(Counted::Native, Bound::Exclusive, 6)
                && !apart(Counted::Native, Bound::Exclusive, 7)
        );

        assert!(
            !MutualKnn {
                exclusion: 0,
                bound: Bound::Exclusive,
                ..MutualKnn::default()
            }
            .apart(3, 3)
        );
    }
}
