//! C: a head maps the difference of two latents to a pose. It is trained on the motion in the body
//! frame.

use ndarray::{Array2, ArrayView2};

use super::pose_head::{HeadPose, POSE_NUMBERS, pose_loss};
use seese3_core::adapter::building_blocks::{Dense, Seeded};
use seese3_core::adapter::{At, Network, Objective, Phi, Real, Samples, Widths};
use seese3_core::geometry::{Twist, exp, log};

/// Width of the head's hidden layer.
const HEAD_HIDDEN: usize = 64;

/// φ: d → 64 → 20, and the head 20 → 64 → 9.
#[derive(Debug, Clone, PartialEq)]
pub struct GeodesicHead<T> {
    phi: Phi<T>,
    head: Dense<T>,
}

impl<T: Real> GeodesicHead<T> {
    pub(crate) fn random(widths: Widths, random: &mut Seeded) -> Self {
        let phi = Phi::random(widths, random);
        Self {
            phi,
            head: Dense::random(&[widths.latent, HEAD_HIDDEN, POSE_NUMBERS], random),
        }
    }

    /// PyTorch's initial weights for a seed.
    pub fn initial(widths: Widths, seed: u64) -> Self {
        Self::random(widths, &mut Seeded::new(seed))
    }

    /// The motions between features (n, d), each in the body frame of its source.
    pub fn motions(&self, features: [ArrayView2<'_, f32>; 2]) -> Vec<Twist> {
        let latents = features.map(|rows| {
            self.phi
                .forward(&rows.mapv(|x| T::of(f64::from(x))))
                .latents
        });
        let [from, to] = latents;
        let poses = self.head.forward(to - from).output;

        poses
            .outer_iter()
            .map(|row| log(&HeadPose::of(row).pose))
            .collect()
    }
}

impl<T: Real> Network<T> for GeodesicHead<T> {
    fn names(&self) -> Vec<String> {
        Phi::<T>::NAMES
            .map(|name| format!("phi.{name}"))
            .into_iter()
            .chain(self.head.names("head"))
            .collect()
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        self.phi
            .parameters()
            .into_iter()
            .chain(self.head.parameters())
            .collect()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.phi
            .parameters_mut()
            .into_iter()
            .chain(self.head.parameters_mut())
            .collect()
    }
}

impl<T: Real> Objective<T> for GeodesicHead<T> {
    type Data = Samples<T>;

    fn count(samples: &Samples<T>) -> usize {
        samples.pair_count()
    }

    fn gradient(&self, samples: &Samples<T>, batch: &[usize], at: At<'_>) -> (f64, Self) {
        let rows = samples.batch(batch, at);
        let forward = self.phi.forward(&rows.features);
        let head = self.head.forward(rows.differences(&forward.latents));
        let mut d_numbers = Array2::zeros(head.output.dim());

        // The loss is the batch mean of ‖log(M⁻¹ M_true)‖², with M the pose predicted by the head.
        // Its gradient is propagated to the nine numbers of each M.
        let mut loss = 0.0;
        let share = (batch.len() as f64).recip();
        for ((&pair, row), mut into) in batch
            .iter()
            .zip(head.output.outer_iter())
            .zip(d_numbers.outer_iter_mut())
        {
            let pose = HeadPose::of(row);
            let (value, gradient) = pose_loss(&pose.pose, &exp(&samples.twists()[pair]));
            loss += value * share;
            into.iter_mut()
                .zip(pose.backward(&(gradient * share)))
                .for_each(|(into, d)| *into = T::of(d));
        }

        let mut gradient = self.zeros_like();
        let d_differences = self.head.backward(&head, &d_numbers, &mut gradient.head);

        // The latents are subtracted, so the last bias of φ cancels and has no gradient.
        self.phi.backward(
            &rows.features,
            &forward,
            &rows.scattered(&d_differences),
            &mut gradient.phi,
        );

        (loss, gradient)
    }
}
