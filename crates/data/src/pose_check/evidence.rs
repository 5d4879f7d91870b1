//! Tests whether one interpretation of poses explains image motion better than another throughout
//! a recording.
//!
//! Swapping an axis along which the camera hardly moves changes the fit little. But a real
//! difference has the same sign in every part of the recording; a random one does not.

use seese3_core::statistics::median;

/// Number of consecutive blocks of a recording. Neighboring pairs have correlated errors, so blocks
/// are compared instead of pairs.
const PARTS: usize = 10;
/// Minimum mean gain of the blocks, in standard errors.
const STANDARD_ERRORS: f64 = 3.0;
/// Accuracy of an alignment, image widths and radians together: lower bound of the loss scale.
const EXACT: f64 = 0.002;

/// Residuals of the same pairs under two interpretations of the poses, in the order of the
/// recording, image widths and radians together.
pub(super) struct Residuals {
    pub stated: Vec<f64>,
    pub other: Vec<f64>,
}

impl Residuals {
    /// Whether the other interpretation fits significantly better across the blocks of the
    /// recording.
    pub fn is_other_better_throughout(&self) -> bool {
        let Self { stated, other } = self;
        if other.len() < 2 * PARTS {
            return false;
        }

        // The logarithm limits the influence of single pairs with a failed alignment.
        let scale = median(other).max(EXACT);
        let loss = |off: f64| (off / scale).powi(2).ln_1p();
        let gains: Vec<f64> = stated
            .iter()
            .zip(other)
            .map(|(stated, other)| loss(*stated) - loss(*other))
            .collect();

        let parts = (0..PARTS).map(|part| {
            let bound = |part: usize| part * gains.len() / PARTS;
            let gains = &gains[bound(part)..bound(part + 1)];
            gains.iter().sum::<f64>() / gains.len() as f64
        });
        let parts: Vec<f64> = parts.collect();
        let mean = parts.iter().sum::<f64>() / PARTS as f64;
        let squares = parts.iter().map(|part| (part - mean).powi(2)).sum::<f64>();
        let standard_error = (squares / ((PARTS - 1) * PARTS) as f64).sqrt();

        mean > STANDARD_ERRORS * standard_error
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. The median of `other` is the scale, so that its typical loss is ln 2.
    #[test]
    fn a_small_gain_counts_if_every_part_has_it() {
        let wavy = |row: usize| 0.01 + 0.001 * ((row * 7 % 10) as f64 - 4.5);
        let other: Vec<f64> = (0..100).map(wavy).collect();
        let worse_everywhere: Vec<f64> = other.iter().map(|off| off * 1.05).collect();
        let is_better = |other: &[f64], stated: &[f64]| {
            let residuals = Residuals {
                stated: stated.to_vec(),
                other: other.to_vec(),
            };
            residuals.is_other_better_throughout()
        };
        assert!(is_better(&other, &worse_everywhere));
        assert!(!is_better(&worse_everywhere, &other));
        assert!(!is_better(&other, &other));

        // The total gain is larger, but it comes from one block alone.
        let mut in_one_part = other.clone();
        in_one_part[40..50].iter_mut().for_each(|off| *off *= 3.0);
        assert!(!is_better(&other, &in_one_part));

        // Nineteen pairs are too few for ten parts.
        assert!(!is_better(&other[..19], &worse_everywhere[..19]));
    }
}
