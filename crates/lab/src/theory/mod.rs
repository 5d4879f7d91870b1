//! Numeric checks of the paper's theorems (Sec. A.7): measured values and their bounds.
//!
//! - *Constructed* feature maps are exactly known smooth functions of the pose. *Drawn* maps are
//!   colors of a rendered studio image, averaged over patches. Drawn maps are only nearly smooth:
//!   pixels have 8 bits and edges alias.
//! - Lengths of twists add meters and radians one to one (A-34: length scale 1 m/rad).
//! - A check only measures; nothing is fitted to the bound.

mod bracket;
mod decodability;
mod dimension;
mod feature_map;
mod flow;

pub use bracket::{C_LIE, bracket};
pub use feature_map::{ConstructedMap, DrawnMap, FeatureMap};
pub use flow::{Pinhole, flow_jacobian};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::probes;

/// The bound on a measured value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// At most this value.
    AtMost(f64),
    /// At least this value.
    AtLeast(f64),
    /// Equal to the first value within the second, a tolerance.
    Equals(f64, f64),
    /// Between two values, inclusive.
    Between(f64, f64),
    /// No bound: the value is only reported.
    Free,
}

impl Bound {
    /// Whether a measured value satisfies the bound; NaN satisfies only [`Bound::Free`].
    pub fn holds(self, measured: f64) -> bool {
        match self {
            Self::AtMost(most) => measured <= most,
            Self::AtLeast(least) => measured >= least,
            Self::Equals(value, tolerance) => (measured - value).abs() <= tolerance,
            Self::Between(low, high) => (low..=high).contains(&measured),
            Self::Free => true,
        }
    }
}

/// One measured quantity of one theorem.
#[derive(Debug, Clone, PartialEq)]
pub struct Check {
    /// The theorem, numbered as in the compiled paper.
    pub theorem: &'static str,
    /// Description of the measured quantity.
    pub what: &'static str,
    /// The measured value.
    pub measured: f64,
    /// Its bound.
    pub bound: Bound,
}

impl Check {
    /// Whether the measured value satisfies the bound.
    pub fn holds(&self) -> bool {
        self.bound.holds(self.measured)
    }
}

/// Sample sizes and seed of the checks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Seed of all random samples.
    pub seed: u64,
    /// Number of poses for estimating an intrinsic dimension.
    pub poses: usize,
    /// Number of pose pairs, directions and starting points in the other checks.
    pub samples: usize,
}

impl Default for Effort {
    fn default() -> Self {
        Self {
            seed: 0,
            poses: 1_024,
            samples: 200,
        }
    }
}

/// Runs every check; `progress` is called with the name of each part when it starts.
///
/// # Errors
/// [`probes::Error`] when there are too few poses for an intrinsic dimension.
pub fn checks(
    effort: Effort,
    progress: &mut dyn FnMut(&'static str),
) -> Result<Vec<Check>, probes::Error> {
    let mut random = ChaCha8Rng::seed_from_u64(effort.seed);
    let mut found = Vec::new();
    progress("intrinsic dimension");
    found.extend(dimension::checks(effort, &mut random)?);

    progress("decodability");
    found.extend(decodability::checks(effort, &mut random));
    progress("bracket");
    found.extend(bracket::checks(effort, &mut random));

    progress("flow");
    found.extend(flow::checks(effort, &mut random));

    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the theorems. The test uses fewer samples than the command.
    #[test]
    fn every_bound_is_kept() {
        let effort = Effort {
            poses: 400,
            samples: 24,
            ..Effort::default()
        };
        let found = checks(effort, &mut |_| ()).unwrap();
        let broken: Vec<&Check> = found.iter().filter(|check| !check.holds()).collect();

        assert!(broken.is_empty() && found.len() > 20, "{broken:?}");
    }

    #[test]
    fn bounds_can_be_broken() {
        assert!(!Bound::AtMost(1.0).holds(1.1) && Bound::AtMost(1.0).holds(1.0));
        assert!(!Bound::AtLeast(1.0).holds(0.9) && !Bound::AtLeast(1.0).holds(f64::NAN));
        assert!(!Bound::Equals(2.0, 0.1).holds(2.2) && !Bound::Between(1.0, 2.0).holds(f64::NAN));
        assert!(!Bound::AtMost(1.0).holds(f64::NAN) && Bound::Free.holds(0.0));
    }
}
