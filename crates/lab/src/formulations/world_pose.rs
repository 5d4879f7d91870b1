//! A and B: ψ maps each feature to a pose; a motion is ψ(z₂) ψ(z₁)⁻¹, in the world frame.

use ndarray::{Array2, ArrayView1};

use super::pose_head::{HeadPose, POSE_NUMBERS, pose_loss, squared_log};
use super::{Ends, body_motion};
use seese3_core::adapter::building_blocks::Seeded;
use seese3_core::adapter::{At, Network, Objective, Phi, Real, Samples, Widths};
use seese3_core::geometry::{Pose, Twist, adjoint};

/// ψ: d → 64 → 9, with the architecture of φ.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldPose<T> {
    psi: Phi<T>,
}

impl<T: Real> WorldPose<T> {
    pub(crate) fn random(widths: Widths, random: &mut Seeded) -> Self {
        Self {
            psi: Phi::random(
                Widths {
                    latent: POSE_NUMBERS,
                    ..widths
                },
                random,
            ),
        }
    }

    /// PyTorch's initial weights for a seed.
    pub fn initial(widths: Widths, seed: u64) -> Self {
        Self::random(widths, &mut Seeded::new(seed))
    }

    /// The motions between the ends, each in the body frame of its source.
    pub fn motion(&self, ends: Ends<'_>) -> Vec<Twist> {
        let poses = |end: usize| {
            let rows = self
                .psi
                .forward(&ends.features[end].mapv(|x| T::of(f64::from(x))))
                .latents;
            rows.outer_iter()
                .map(|row| HeadPose::of(row).pose)
                .collect::<Vec<_>>()
        };

        let from = poses(0);
        let to = poses(1);

        // ψ predicts motions in the world frame. Convert them with the true source poses to the
        // body frame, in which all formulations are scored.
        let motion = |((from, to), source): ((&Pose, &Pose), &Pose)| {
            body_motion(&(to * from.inverse()), source)
        };

        from.iter().zip(&to).zip(ends.sources).map(motion).collect()
    }

    fn named(&self) -> Vec<String> {
        Phi::<T>::NAMES.map(|name| format!("psi.{name}")).to_vec()
    }

    /// The mean loss of a batch and its gradient with respect to ψ's parameters. `losses` returns
    /// the loss of one pair and its gradients with respect to the two predicted poses.
    fn through_psi(
        &self,
        samples: &Samples<T>,
        batch: &[usize],
        at: At<'_>,
        losses: impl Fn(usize, [&HeadPose; 2]) -> (f64, [nalgebra::Vector6<f64>; 2]),
    ) -> (f64, Self) {
        // ψ runs once per distinct frame of the batch. A frame sums the gradients of its pairs.
        let rows = samples.batch(batch, at);
        let forward = self.psi.forward(&rows.features);
        let heads: Vec<HeadPose> = forward
            .latents
            .outer_iter()
            .map(|row: ArrayView1<'_, T>| HeadPose::of(row))
            .collect();

        let mut d_rows = Array2::<T>::zeros(forward.latents.dim());
        let mut loss = 0.0;
        let share = (batch.len() as f64).recip();
        for (&pair, slots) in batch.iter().zip(rows.slots()) {
            let (value, gradients) = losses(pair, slots.map(|slot| &heads[slot]));
            loss += value * share;

            for (slot, gradient) in slots.into_iter().zip(gradients) {
                let numbers = heads[slot].backward(&(gradient * share));
                d_rows
                    .row_mut(slot)
                    .iter_mut()
                    .zip(numbers)
                    .for_each(|(into, d)| *into += T::of(d));
            }
        }

        let mut gradient = Self {
            psi: self.psi.zeros(),
        };

        // A pose is one output of ψ, not a difference of two, so the last bias has a gradient.
        self.psi
            .backward_whole(&rows.features, &forward, &d_rows, &mut gradient.psi);

        (loss, gradient)
    }
}

/// A: trained on log(M⁻¹ M_true), M_true = P₂ P₁⁻¹.
#[derive(Debug, Clone, PartialEq)]
pub struct UnanchoredMotion<T>(pub WorldPose<T>);

/// B: trained on log(ψ(z)⁻¹ P) at both ends.
#[derive(Debug, Clone, PartialEq)]
pub struct AbsolutePose<T>(pub WorldPose<T>);

impl<T: Real> Objective<T> for UnanchoredMotion<T> {
    type Data = Samples<T>;

    fn count(samples: &Samples<T>) -> usize {
        samples.pair_count()
    }

    fn gradient(&self, samples: &Samples<T>, batch: &[usize], at: At<'_>) -> (f64, Self) {
        let losses = |pair: usize, [from, to]: [&HeadPose; 2]| {
            let [source, target] = samples.pair(pair).map(|row| samples.pose(row));

            // E = T₁ T₂⁻¹ P₂ P₁⁻¹. A perturbation δ on the right of T₁ is Ad(T₁) δ on the left of
            // E; on the right of T₂ it is −Ad(T₁) δ.
            let error = from.pose * to.pose.inverse() * target * source.inverse();
            let (loss, gradient) = squared_log(&error);
            let moved = adjoint(&from.pose).transpose() * gradient;

            (loss, [moved, -moved])
        };

        let (loss, gradient) = self.0.through_psi(samples, batch, at, losses);
        (loss, Self(gradient))
    }
}

impl<T: Real> Objective<T> for AbsolutePose<T> {
    type Data = Samples<T>;

    fn count(samples: &Samples<T>) -> usize {
        samples.pair_count()
    }

    fn gradient(&self, samples: &Samples<T>, batch: &[usize], at: At<'_>) -> (f64, Self) {
        let losses = |pair: usize, heads: [&HeadPose; 2]| {
            let [source, target] = samples.pair(pair).map(|row| samples.pose(row));
            let (at_source, d_source) = pose_loss(&heads[0].pose, source);
            let (at_target, d_target) = pose_loss(&heads[1].pose, target);
            (at_source + at_target, [d_source, d_target])
        };
        let (loss, gradient) = self.0.through_psi(samples, batch, at, losses);

        (loss, Self(gradient))
    }
}

impl<T: Real> Network<T> for UnanchoredMotion<T> {
    fn names(&self) -> Vec<String> {
        self.0.named()
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        self.0.psi.parameters()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.0.psi.parameters_mut()
    }
}

impl<T: Real> Network<T> for AbsolutePose<T> {
    fn names(&self) -> Vec<String> {
        self.0.named()
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        self.0.psi.parameters()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.0.psi.parameters_mut()
    }
}
