//! What is learned from: features, poses, and pairs of them.

use ndarray::{Array2, ArrayBase, ArrayView2, Axis, Data, Ix2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{At, Error, Real, STILL, TargetScale};
use crate::geometry::{Pose, Twist, body_twist};
use crate::scores::median;

/// The least deviation that a column is divided by, as a share of the columns' median.
const LEAST_SPREAD: f64 = 1e-3;

/// What is learned from: features of any number of rooms one below the other, and pairs of their
/// rows.
#[derive(Debug, Clone)]
pub struct Samples<T> {
    features: Array2<T>,
    poses: Vec<Pose>,
    pairs: Vec<[usize; 2]>,
    twists: Vec<Twist>,
    targets: Array2<T>,
    scale: TargetScale,
}

/// Some pairs, and the distinct frames at their ends.
pub(crate) struct Batch<T> {
    /// Of the distinct frames, shape (m, d).
    pub features: Array2<T>,
    /// Rows of `features`, source first, by pair.
    slots: Vec<[usize; 2]>,
    /// Z-scored twists, shape (n, 6).
    pub targets: Array2<T>,
}

impl<T: Real> Samples<T> {
    /// `features` (n, d); the `poses` of its rows, `world_from_camera`; `pairs` of its rows, source
    /// first, both ends in one world.
    ///
    /// # Errors
    /// [`Error::NoPairs`] when there is none, or one names a row that is not there;
    /// [`Error::NoMotion`].
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

    /// As [`Samples::new`], with μ = 0 and σ the root mean square.
    ///
    /// # Errors
    /// As [`Samples::new`].
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

        let normalised: Vec<_> = twists
            .iter()
            .map(|&twist| scale.normalised(twist))
            .collect();
        let targets = Array2::from_shape_fn((twists.len(), 6), |(row, column)| {
            T::of(normalised[row][column])
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

    /// Mean and deviation of the twists.
    pub fn scale(&self) -> &TargetScale {
        &self.scale
    }

    /// How many pairs there are.
    pub fn pair_count(&self) -> usize {
        self.pairs.len()
    }

    /// Columns of a feature.
    pub fn feature_dim(&self) -> usize {
        self.features.ncols()
    }

    /// The true motions of the pairs, each in its source's body frame.
    pub fn twists(&self) -> &[Twist] {
        &self.twists
    }

    /// The rows of a pair, source first.
    pub(crate) fn pair(&self, pair: usize) -> [usize; 2] {
        self.pairs[pair]
    }

    /// `world_from_camera` by row.
    pub(crate) fn pose(&self, row: usize) -> &Pose {
        &self.poses[row]
    }

    /// The pairs that `batch` names.
    pub(crate) fn batch(&self, batch: &[usize], at: At<'_>) -> Batch<T> {
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
        if at.config.noise > 0.0 {
            let mut random = ChaCha8Rng::seed_from_u64(at.config.seed);
            random.set_stream(at.step);
            let noise = normal(&mut random, features.len());
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
    /// The same samples with features z-scored by the mean and the population deviation, each (1,
    /// d), of the rows that occur in pairs; a column that hardly varies there is divided by a
    /// thousandth of the median deviation instead.
    pub(super) fn standardised(&self) -> (Self, [Array2<f32>; 2]) {
        let mut used = vec![false; self.features.nrows()];
        self.pairs
            .iter()
            .flatten()
            .for_each(|&row| used[row] = true);

        let rows: Vec<usize> = (0..used.len()).filter(|&row| used[row]).collect();
        let known = self.features.select(Axis(0), &rows).mapv(f64::from);
        let count = rows.len().max(1) as f64;
        let mean = known.sum_axis(Axis(0)) / count;
        let variance = (&known - &mean).mapv(|x| x * x).sum_axis(Axis(0)) / count;

        // A column that hardly varies here is rounding; blown up, it would drown the others in a
        // room where it varies.
        let spreads: Vec<f64> = variance.iter().map(|x| x.sqrt()).collect();
        let least = (LEAST_SPREAD * median(&spreads)).max(f64::MIN_POSITIVE);
        let deviation = variance.mapv(|x| x.sqrt().max(least));
        let row = |values: ndarray::Array1<f64>| values.mapv(|x| x as f32).insert_axis(Axis(0));
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
    /// Rows of `features` by pair, source first.
    pub fn slots(&self) -> impl Iterator<Item = [usize; 2]> + '_ {
        self.slots.iter().copied()
    }

    /// Rows of the pairs' sources, of one row a distinct frame.
    pub fn sources<S: Data<Elem = T>>(&self, rows: &ArrayBase<S, Ix2>) -> Array2<T> {
        self.end(rows, 0)
    }

    /// Target minus source, pair by pair, of one row a distinct frame.
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

    /// The gradient by the rows of [`Batch::differences`], of the gradient by the differences.
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

    /// The gradient by the rows of [`Batch::sources`], of the gradient by what it gave.
    pub fn scattered_to_sources(&self, d_sources: &Array2<T>) -> Array2<T> {
        let mut d_rows = Array2::zeros((self.features.nrows(), d_sources.ncols()));
        for (slots, d) in self.slots.iter().zip(d_sources.outer_iter()) {
            let mut source = d_rows.row_mut(slots[0]);
            source += &d;
        }

        d_rows
    }
}

/// Numbers of the normal distribution, by Box and Muller.
fn normal(random: &mut ChaCha8Rng, count: usize) -> impl Iterator<Item = f64> + '_ {
    let pair = |random: &mut ChaCha8Rng| {
        let a: f32 = random.random();
        let b: f32 = random.random();
        let radius = (-2.0 * (1.0 - a).ln()).sqrt();
        let (sine, cosine) = (std::f32::consts::TAU * b).sin_cos();

        [f64::from(radius * cosine), f64::from(radius * sine)]
    };

    (0..count.div_ceil(2))
        .flat_map(move |_| pair(random))
        .take(count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adapter::TrainConfig;
    use crate::geometry::exp;

    /// Oracle: the definition of a normal deviate: mean 0 and the deviation asked for, other
    /// numbers at every step, the same at the same step of the same seed.
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
