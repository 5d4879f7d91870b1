//! Training data: features, poses and pairs of frames.

use ndarray::{Array1, Array2, ArrayBase, ArrayView2, Axis, Data, Ix2};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{At, Error, Real, STILL, TargetScale};
use crate::geometry::{Pose, Twist, body_twist};
use crate::statistics::{median, normal_deviates};

/// Lower bound on a column's standard deviation in z-scoring, as a fraction of the median over
/// columns.
const LEAST_SPREAD: f64 = 1e-3;

/// Training data: the stacked features of one or more rooms, and pairs of rows.
#[derive(Debug, Clone)]
pub struct Samples<T> {
    features: Array2<T>,
    poses: Vec<Pose>,
    pairs: Vec<[usize; 2]>,
    twists: Vec<Twist>,
    targets: Array2<T>,
    scale: TargetScale,
}

/// A batch of pairs, and the distinct frames in it.
pub struct Batch<T> {
    /// Features of the distinct frames, shape (m, d).
    pub features: Array2<T>,
    /// Rows of each pair's frames in `features`, source first.
    slots: Vec<[usize; 2]>,
    /// Z-scored twists of the pairs, shape (n, 6).
    pub targets: Array2<T>,
}

impl<T: Real> Samples<T> {
    /// Training data from `features` (n, d), one pose per row (`world_from_camera`), and `pairs` of
    /// rows, source first. Both poses of a pair must be in the same world frame.
    ///
    /// # Errors
    /// [`Error::NoPairs`] when there is no pair or a pair has a row that does not exist;
    /// [`Error::NoMotion`] when all pairs have the same motion.
    pub fn new(
        features: ArrayView2<'_, f32>,
        poses: Vec<Pose>,
        pairs: Vec<[usize; 2]>,
    ) -> Result<Self, Error> {
        let known = features.nrows().min(poses.len());
        if pairs.is_empty() || pairs.iter().flatten().any(|&row| row >= known) {
            return Err(Error::NoPairs);
        }

        let twists: Vec<Twist> = pairs
            .iter()
            .map(|&[from, to]| body_twist(&poses[from], &poses[to]))
            .collect();
        let scale = TargetScale::of(&twists);

        let features = features.mapv(|x| T::of(f64::from(x)));
        Self::scaled(features, poses, pairs, twists, scale)
    }

    /// The same samples with targets scaled by μ = 0 and σ = root mean square.
    ///
    /// # Errors
    /// [`Error::NoMotion`] when no pair has motion.
    pub fn through_zero(self) -> Result<Self, Error> {
        let scale = TargetScale::about_zero(&self.twists);

        let Self {
            features,
            poses,
            pairs,
            twists,
            ..
        } = self;

        Self::scaled(features, poses, pairs, twists, scale)
    }

    /// The same samples with the target scale of an existing network, for further training.
    ///
    /// # Errors
    /// [`Error::NoMotion`] when the motion of every pair equals the scale's mean.
    pub fn with_scale(self, scale: TargetScale) -> Result<Self, Error> {
        let Self {
            features,
            poses,
            pairs,
            twists,
            ..
        } = self;

        Self::scaled(features, poses, pairs, twists, scale)
    }

    fn scaled(
        features: Array2<T>,
        poses: Vec<Pose>,
        pairs: Vec<[usize; 2]>,
        twists: Vec<Twist>,
        scale: TargetScale,
    ) -> Result<Self, Error> {
        if twists
            .iter()
            .all(|twist| (twist.to_vector() - scale.mean).amax() < STILL)
        {
            return Err(Error::NoMotion);
        }

        let normalized: Vec<_> = twists
            .iter()
            .map(|&twist| scale.normalized(twist))
            .collect();
        let targets = Array2::from_shape_fn((twists.len(), 6), |(row, column)| {
            T::of(normalized[row][column])
        });

        Ok(Self {
            features,
            poses,
            pairs,
            twists,
            targets,
            scale,
        })
    }

    /// μ and σ of the z-scored twists.
    pub fn scale(&self) -> &TargetScale {
        &self.scale
    }

    /// Number of pairs.
    pub fn pair_count(&self) -> usize {
        self.pairs.len()
    }

    /// Columns of a feature.
    pub fn feature_dim(&self) -> usize {
        self.features.ncols()
    }

    /// True motions of the pairs, in the body frame of the source.
    pub fn twists(&self) -> &[Twist] {
        &self.twists
    }

    /// The rows of a pair, source first.
    pub fn pair(&self, pair: usize) -> [usize; 2] {
        self.pairs[pair]
    }

    /// The pose of a row, `world_from_camera`.
    pub fn pose(&self, row: usize) -> &Pose {
        &self.poses[row]
    }

    /// The pairs with the indices `batch`, with feature noise if configured.
    pub fn batch(&self, batch: &[usize], at: At<'_>) -> Batch<T> {
        // One row per distinct frame, so that φ runs once per frame.
        let mut places = vec![usize::MAX; self.features.nrows()];
        let mut frames = Vec::new();

        let mut place = |row: usize| {
            if places[row] == usize::MAX {
                places[row] = frames.len();
                frames.push(row);
            }

            places[row]
        };

        let slots = batch
            .iter()
            .map(|&pair| self.pairs[pair].map(&mut place))
            .collect();

        let mut features = self.features.select(Axis(0), &frames);

        // Each step has its own random stream: the noise depends only on the seed and the step.
        if at.config.noise > 0.0 {
            let mut random = ChaCha8Rng::seed_from_u64(at.config.seed);
            random.set_stream(at.step);
            let noise = normal_deviates(&mut random, features.len());
            features
                .iter_mut()
                .zip(noise)
                .for_each(|(x, noise)| *x += T::of(at.config.noise * noise));
        }

        Batch {
            features,
            slots,
            targets: self.targets.select(Axis(0), batch),
        }
    }
}

impl Samples<f32> {
    /// The same samples with z-scored features, and the mean and population standard deviation
    /// used, each (1, d). The statistics are those of the rows that occur in pairs, with the lower
    /// bound of [`column_scale`].
    pub(super) fn standardized(&self) -> (Self, [Array2<f32>; 2]) {
        // Frames in no training pair, such as test frames, are excluded from the statistics.
        let mut used = vec![false; self.features.nrows()];
        self.pairs
            .iter()
            .flatten()
            .for_each(|&row| used[row] = true);

        let rows: Vec<usize> = (0..used.len()).filter(|&row| used[row]).collect();
        let known = self.features.select(Axis(0), &rows).mapv(f64::from);
        let (mean, deviation) = column_scale(known.view());
        let row = |values: Array1<f64>| values.mapv(|x| x as f32).insert_axis(Axis(0));
        let mean = row(mean);

        let deviation = row(deviation);
        let features = (&self.features - &mean) / &deviation;

        (
            Self {
                features,
                ..self.clone()
            },
            [mean, deviation],
        )
    }

    /// The features, shape (n, d).
    pub fn features(&self) -> ArrayView2<'_, f32> {
        self.features.view()
    }
}

impl<T: Real> Batch<T> {
    /// Rows of each pair's frames in `features`, source first.
    pub fn slots(&self) -> impl Iterator<Item = [usize; 2]> + '_ {
        self.slots.iter().copied()
    }

    /// The source row of each pair; `rows` has one row per distinct frame.
    pub fn sources<S: Data<Elem = T>>(&self, rows: &ArrayBase<S, Ix2>) -> Array2<T> {
        self.end(rows, 0)
    }

    /// Target row minus source row of each pair; `rows` has one row per distinct frame.
    pub fn differences(&self, rows: &Array2<T>) -> Array2<T> {
        self.end(rows, 1) - self.end(rows, 0)
    }

    fn end<S: Data<Elem = T>>(&self, rows: &ArrayBase<S, Ix2>, end: usize) -> Array2<T> {
        rows.select(
            Axis(0),
            &self
                .slots
                .iter()
                .map(|slots| slots[end])
                .collect::<Vec<_>>(),
        )
    }

    /// Backward pass of [`Batch::differences`]: the gradient with respect to `rows`, from the
    /// gradient with respect to the differences. It is summed over all pairs of a frame.
    pub fn scattered(&self, d_differences: &Array2<T>) -> Array2<T> {
        let mut d_rows = Array2::zeros((self.features.nrows(), d_differences.ncols()));
        for (slots, d) in self.slots.iter().zip(d_differences.outer_iter()) {
            let mut target = d_rows.row_mut(slots[1]);
            target += &d;
            let mut source = d_rows.row_mut(slots[0]);
            source -= &d;
        }

        d_rows
    }

    /// Backward pass of [`Batch::sources`]: the gradient with respect to `rows`, from the gradient
    /// with respect to the result.
    pub fn scattered_to_sources(&self, d_sources: &Array2<T>) -> Array2<T> {
        let mut d_rows = Array2::zeros((self.features.nrows(), d_sources.ncols()));
        for (slots, d) in self.slots.iter().zip(d_sources.outer_iter()) {
            let mut source = d_rows.row_mut(slots[0]);
            source += &d;
        }

        d_rows
    }
}

/// Mean and standard deviation of each column of `rows` (n, d) for z-scoring, each (d,).
///
/// The deviation is at least a thousandth of the median over columns. Otherwise a column that is
/// constant in these rows would dominate in a room where it varies.
pub fn column_scale(rows: ArrayView2<'_, f64>) -> (Array1<f64>, Array1<f64>) {
    let count = rows.nrows().max(1) as f64;
    let mean = rows.sum_axis(Axis(0)) / count;
    let variance = (&rows - &mean).mapv(|x| x * x).sum_axis(Axis(0)) / count;

    let spreads: Vec<f64> = variance.iter().map(|x| x.sqrt()).collect();
    let middle = match median(&spreads) {
        // Most columns are constant: use the median of the others, or 1 if all are constant.
        0.0 => {
            let known: Vec<f64> = spreads.iter().copied().filter(|&x| x > 0.0).collect();
            if known.is_empty() {
                1.0
            } else {
                median(&known)
            }
        }
        middle => middle,
    };

    let deviation = variance.mapv(|x| x.sqrt().max(LEAST_SPREAD * middle));
    (mean, deviation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adapter::TrainConfig;
    use crate::geometry::exp;

    /// Oracle: the definition of normal noise: mean 0 and the configured deviation; different at
    /// every step, reproducible for the same seed and step.
    #[test]
    fn noise_has_the_deviation_asked_for() {
        let features = Array2::<f32>::zeros((3, 20_000));

        let ahead = exp(&Twist {
            linear: nalgebra::Vector3::z(),
            angular: nalgebra::Vector3::x() * 0.1,
        });

        let pairs = vec![[0, 1], [1, 2]];
        let samples = Samples::<f64>::new(
            features.view(),
            vec![Pose::identity(), ahead, ahead * ahead * ahead],
            pairs,
        )
        .unwrap();

        let config = |noise| TrainConfig {
            noise,
            ..crate::adapter::Preset::PaperBase.config(3)
        };

        let batch = |noise: f64, step| {
            samples
                .batch(
                    &[0],
                    At {
                        config: &config(noise),
                        step,
                    },
                )
                .features
        };

        assert!(batch(0.0, 1).iter().all(|&x| x == 0.0));

        let noisy = batch(0.2, 1);
        let count = noisy.len() as f64;
        let mean = noisy.sum() / count;
        let second = noisy.mapv(|x| x * x).sum() / count;

        assert!(
            mean.abs() < 0.005 && (second.sqrt() - 0.2).abs() < 0.004,
            "{mean} {second}"
        );

        assert_eq!(noisy, batch(0.2, 1));
        assert_ne!(noisy, batch(0.2, 2));
    }
}
