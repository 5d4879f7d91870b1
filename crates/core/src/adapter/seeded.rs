//! Random numbers identical to PyTorch's on the CPU, so that a seed gives the same training run as
//! in PyTorch.
//!
//! The generator is MT19937, seeded as by `torch.manual_seed(seed)`. A float uses the low 24 bits
//! of a draw; `torch.randperm` uses one draw per position. The tests compare initial weights with
//! PyTorch's bit by bit.

use rand_mt::Mt;

/// A random generator, equal to PyTorch's CPU generator.
pub struct Seeded(Mt);

impl Seeded {
    /// The generator after `torch.manual_seed(seed)`; uses the low 32 bits of the seed.
    pub fn new(seed: u64) -> Self {
        Self(Mt::new(seed as u32))
    }

    /// One number of `uniform_(-bound, bound)` on a float tensor.
    pub fn symmetric(&mut self, bound: f64) -> f32 {
        let low = -bound as f32;
        let high = bound as f32;
        self.unit().mul_add(high - low, low)
    }

    /// `torch.randn(count)` on a float tensor, for a count that is a multiple of 16. The last bits
    /// may differ, because PyTorch uses its own vectorized sine and logarithm.
    pub fn normal(&mut self, count: usize) -> Vec<f32> {
        let mut values: Vec<f32> = (0..count).map(|_| self.unit()).collect();

        // Box–Muller transform in PyTorch's layout: in each block of 16, the first eight draws are
        // radii, the last eight angles.
        for block in values.chunks_exact_mut(16) {
            for place in 0..8 {
                let radius = (-2.0 * (1.0 - block[place]).ln()).sqrt();
                let (sine, cosine) = (std::f32::consts::TAU * block[place + 8]).sin_cos();
                block[place] = radius * cosine;
                block[place + 8] = radius * sine;
            }
        }

        values
    }

    fn unit(&mut self) -> f32 {
        (self.0.next_u32() & 0x00ff_ffff) as f32 * 2f32.powi(-24)
    }

    /// `torch.randperm(count)`.
    pub fn permutation(&mut self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..count).collect();
        for place in 0..count.saturating_sub(1) {
            let ahead = self.0.next_u32() as usize % (count - place);
            order.swap(place, place + ahead);
        }

        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: `torch.manual_seed(3); torch.randperm(10)`, then five of `torch.randperm(1000)`,
    /// PyTorch 2.15.
    #[test]
    fn permutations_are_pytorchs() {
        let mut random = Seeded::new(3);
        assert_eq!(random.permutation(10), [6, 0, 3, 7, 8, 5, 1, 9, 2, 4]);
        assert_eq!(random.permutation(1000)[..5], [739, 917, 459, 849, 525]);
    }
}
