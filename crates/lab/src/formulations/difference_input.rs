//! D: φ applied to the difference of two features; the adapter takes the difference of two latents.

use nalgebra::Vector6;
use ndarray::{Array2, ArrayView2};

use seese3_core::adapter::building_blocks::Seeded;
use seese3_core::adapter::{
    At, Network, Objective, Real, Samples, Siamese, TENSOR_NAMES, TargetScale, Widths,
};
use seese3_core::geometry::Twist;

/// φ and W, used as W φ(z₂ − z₁).
#[derive(Debug, Clone, PartialEq)]
pub struct DifferenceInput<T>(Siamese<T>);

impl<T: Real> DifferenceInput<T> {
    pub(crate) fn random(widths: Widths, random: &mut Seeded) -> Self {
        Self(Siamese::random(widths, random))
    }

    /// PyTorch's initial weights for a seed.
    pub fn initial(widths: Widths, seed: u64) -> Self {
        Self::random(widths, &mut Seeded::new(seed))
    }

    /// The motions between the features of sources and targets, each (n, d). `scale` inverts the
    /// z-scoring of the training targets.
    pub fn motions(&self, features: [ArrayView2<'_, f32>; 2], scale: &TargetScale) -> Vec<Twist> {
        let [from, to] = features.map(|rows| rows.mapv(|x| T::of(f64::from(x))));
        let normalized = self.0.embed(to - from).dot(&self.0.motion_matrix().t());

        normalized
            .outer_iter()
            .map(|row| scale.twist(&Vector6::from_fn(|c, _| row[c].f64())))
            .collect()
    }
}

impl<T: Real> Network<T> for DifferenceInput<T> {
    fn names(&self) -> Vec<String> {
        TENSOR_NAMES.map(str::to_owned).to_vec()
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        self.0.parameters()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.0.parameters_mut()
    }
}

impl<T: Real> Objective<T> for DifferenceInput<T> {
    type Data = Samples<T>;

    fn count(samples: &Samples<T>) -> usize {
        samples.pair_count()
    }

    fn gradient(&self, samples: &Samples<T>, batch: &[usize], at: At<'_>) -> (f64, Self) {
        let rows = samples.batch(batch, at);
        let differences = rows.differences(&rows.features);
        let forward = self.0.phi.forward(&differences);
        let predicted = forward.latents.dot(&self.0.motion.t());
        let (loss, d_predicted) = at.config.loss.value(predicted.view(), rows.targets.view());

        let mut gradient = self.zeros_like();
        gradient.0.motion += &d_predicted.t().dot(&forward.latents);

        // Latents are not subtracted here: the last bias of φ does not cancel and has a gradient.
        self.0.phi.backward_whole(
            &differences,
            &forward,
            &d_predicted.dot(&self.0.motion),
            &mut gradient.0.phi,
        );

        (loss, gradient)
    }
}
