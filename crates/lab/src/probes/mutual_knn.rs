//! M1: overlap between the nearest neighbors by feature and by pose. It measures whether frames
//! with similar features have similar poses.

use ndarray::{Array2, ArrayView2, Axis};
use rayon::prelude::*;
use serde::Serialize;

use super::Error;
use super::nearest_rows::{TooFewCandidates, nearest_rows};
use seese3_core::geometry::{Pose, body_twist};

/// The options of M1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct MutualKnn {
    /// Number of sampled frames: 0, s, 2s, … of the room.
    pub frames: usize,
    /// The stride s, in frames of the room.
    pub stride: usize,
    /// Number of neighbors of each frame.
    pub k: usize,
    /// Temporal distance within which frames do not count as neighbors. A frame is never its own
    /// neighbor.
    pub exclusion: usize,
    /// The unit of `exclusion`.
    #[serde(rename = "exclusion_counts")]
    pub counted: Counted,
    /// Whether a frame at exactly the distance `exclusion` is excluded too.
    #[serde(rename = "exclusion_is")]
    pub limit: Limit,
    /// The distance between poses.
    #[serde(rename = "pose")]
    pub pose_distance: PoseDistance,
}

/// The distance between poses of M1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum PoseDistance {
    /// Euclidean over nine numbers in world coordinates: the position in meters and the first two
    /// columns of the rotation matrix, as in the paper.
    NineNumbers,
    /// ‖log(P₁⁻¹ P₂)‖: the norm of the twist from one pose to the other, meters and radians mixed.
    Twist,
}

/// The unit of a temporal distance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum Counted {
    /// Sampled frames.
    #[serde(rename = "sampled frames")]
    Sampled,
    /// Frames of the room.
    #[serde(rename = "room frames")]
    Native,
}

/// Whether a range includes its limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Limit {
    /// The limit is included.
    Inclusive,
    /// The limit is not included.
    Exclusive,
}

impl MutualKnn {
    /// The paper's options, with at most 256 frames at the smallest stride that spans a recording.
    pub fn spanning(frame_count: usize) -> Self {
        let paper = Self::default();
        let stride = frame_count.div_ceil(paper.frames).max(1);
        Self {
            frames: frame_count.div_ceil(stride),
            stride,
            ..paper
        }
    }

    /// Whether two sampled frames may be neighbors.
    fn apart(&self, frame: usize, other: usize) -> bool {
        let distance = match self.counted {
            Counted::Sampled => frame.abs_diff(other),
            Counted::Native => frame.abs_diff(other).saturating_mul(self.stride),
        };
        let near = match self.limit {
            Limit::Inclusive => distance <= self.exclusion,
            Limit::Exclusive => distance < self.exclusion,
        };

        frame != other && !near
    }

    fn too_few_candidates(&self, frame: usize) -> Error {
        Error::TooFewCandidates {
            frame,
            k: self.k,
            exclusion: self.exclusion,
        }
    }
}

impl Default for MutualKnn {
    /// The paper's options: 256 frames, k = 10, exclusion of 10 frames before and after.
    fn default() -> Self {
        Self {
            frames: 256,
            stride: 1,
            k: 10,
            exclusion: 10,
            counted: Counted::Sampled,
            limit: Limit::Inclusive,
            pose_distance: PoseDistance::NineNumbers,
        }
    }
}

/// The mutual k-NN score, 0 to 1: the mean fraction of a frame's k nearest frames by feature
/// (cosine) that are also among its k nearest by pose.
///
/// `rows` are features (n, d), `poses` are `world_from_camera`, meters.
///
/// # Errors
/// [`Error::TooSmall`] for an option that is 0; [`Error::TooFewFrames`] when the room is too short;
/// [`Error::TooFewCandidates`] when the exclusion leaves a frame fewer than k candidates;
/// [`Error::NoDirection`] when a feature is zero.
///
/// Source: SeeSE3, M1.
pub fn mutual_knn(
    rows: ArrayView2<'_, f32>,
    poses: &[Pose],
    options: &MutualKnn,
) -> Result<f64, Error> {
    let by_feature = feature_neighbors(rows, options)?;
    let by_pose = pose_neighbors(poses, options)?;
    let shared =
        |(a, b): (&Vec<usize>, &Vec<usize>)| a.iter().filter(|frame| b.contains(frame)).count();
    let shared: usize = by_feature.iter().zip(&by_pose).map(shared).sum();

    Ok(shared as f64 / (options.frames * options.k) as f64)
}

/// The k nearest neighbors of each sampled frame by the cosine of their features, nearest first;
/// ties go to the smaller frame number.
///
/// # Errors
/// As [`mutual_knn`].
pub fn feature_neighbors(
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

    // ‖x − y‖² = 2 − 2 x·y for units: the order of the distances is that of the cosines.
    nearest(units.view(), options)
}

/// The k nearest neighbors of each sampled frame by pose, nearest first.
///
/// # Errors
/// As [`mutual_knn`].
pub fn pose_neighbors(poses: &[Pose], options: &MutualKnn) -> Result<Vec<Vec<usize>>, Error> {
    // The first two columns of R determine the third, so nine numbers describe a pose.
    let nine = |frame: usize| -> [f64; 9] {
        let t = poses[frame].translation.vector;
        let r = poses[frame].rotation.to_rotation_matrix();
        let r = r.matrix();
        std::array::from_fn(|i| if i < 3 { t[i] } else { r[(i % 3, i / 3 - 1)] })
    };
    let sampled = sampled(poses.len(), options)?;
    if options.pose_distance == PoseDistance::Twist {
        let twist = |a: usize, b: usize| body_twist(&poses[sampled[a]], &poses[sampled[b]]);
        return nearest_by(options, |a, b| twist(a, b).to_vector().norm());
    }

    let points: Vec<[f64; 9]> = sampled.into_iter().map(nine).collect();
    nearest(Array2::from(points).view(), options)
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

/// The k nearest rows of each row.
fn nearest(rows: ArrayView2<'_, f64>, options: &MutualKnn) -> Result<Vec<Vec<usize>>, Error> {
    // The frames that are not apart from a frame are around it.
    let apart_from = |frame: usize, reach: usize| options.apart(frame, frame + reach);
    let reach = (0..options.frames)
        .take_while(|&reach| !apart_from(0, reach))
        .count();
    let near = |frame: usize| {
        let first = (frame + 1).saturating_sub(reach);
        first..(frame + reach).min(options.frames)
    };
    let found = nearest_rows(rows, options.k, near);
    let found = found.map_err(|TooFewCandidates { row }| options.too_few_candidates(row))?;
    let frames_of = |found: Vec<(f64, usize)>| found.into_iter().map(|(_, frame)| frame).collect();
    Ok(found.into_iter().map(frames_of).collect())
}

/// The k nearest frames of each frame by a distance of pairs.
fn nearest_by(
    options: &MutualKnn,
    distance: impl Fn(usize, usize) -> f64 + Sync,
) -> Result<Vec<Vec<usize>>, Error> {
    let of = |frame: usize| {
        let apart = |other: &usize| options.apart(frame, *other);
        let mut others: Vec<(f64, usize)> = (0..options.frames)
            .filter(apart)
            .map(|other| (distance(frame, other), other))
            .collect();

        if others.len() < options.k {
            return Err(options.too_few_candidates(frame));
        }

        // Ties go to the smaller frame number, so that the result is deterministic.
        others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let nearest = others.into_iter().take(options.k);
        Ok(nearest.map(|(_, other)| other).collect())
    };

    (0..options.frames).into_par_iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Camera 1 is 1 m from camera 0, camera 2 is turned by 0.9 rad: the norm of the
    /// twist is 1 and 0.9, and the nine numbers differ by 1 and by 2 sin(0.45) √2 = 1.23.
    #[test]
    fn the_nearest_pose_depends_on_the_distance() {
        let poses = [
            Pose::identity(),
            Pose::translation(1.0, 0.0, 0.0),
            Pose::rotation(nalgebra::Vector3::new(0.0, 0.0, 0.9)),
        ];
        let nearest = |pose_distance| {
            let options = MutualKnn {
                frames: 3,
                k: 1,
                exclusion: 0,
                pose_distance,
                ..MutualKnn::default()
            };
            pose_neighbors(&poses, &options).unwrap()[0][0]
        };
        assert_eq!(nearest(PoseDistance::NineNumbers), 1);
        assert_eq!(nearest(PoseDistance::Twist), 2);
    }

    /// Oracle: by hand, for two frames that are three samples, or six room frames, apart.
    #[test]
    fn distances_are_counted_as_asked() {
        let apart = |counted, limit, exclusion| {
            MutualKnn {
                stride: 2,
                exclusion,
                counted,
                limit,
                ..MutualKnn::default()
            }
            .apart(4, 7)
        };

        assert!(
            apart(Counted::Sampled, Limit::Inclusive, 2)
                && !apart(Counted::Sampled, Limit::Inclusive, 3)
        );

        assert!(
            apart(Counted::Sampled, Limit::Exclusive, 3)
                && !apart(Counted::Sampled, Limit::Exclusive, 4)
        );

        assert!(
            apart(Counted::Native, Limit::Inclusive, 5)
                && !apart(Counted::Native, Limit::Inclusive, 6)
        );

        assert!(
            apart(Counted::Native, Limit::Exclusive, 6)
                && !apart(Counted::Native, Limit::Exclusive, 7)
        );

        assert!(
            !MutualKnn {
                exclusion: 0,
                limit: Limit::Exclusive,
                ..MutualKnn::default()
            }
            .apart(3, 3)
        );
    }

    /// Oracle: by hand: the last frame compared is less than a stride from the end.
    #[test]
    fn the_long_stride_spans_the_recording() {
        for (frame_count, stride, frames) in [
            (100, 1, 100),
            (256, 1, 256),
            (257, 2, 129),
            (400, 2, 200),
            (1_000, 4, 250),
        ] {
            let options = MutualKnn::spanning(frame_count);
            assert_eq!((options.stride, options.frames), (stride, frames));
        }
    }
}
