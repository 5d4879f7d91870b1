//! Absolute and relative pose errors (APE and RPE) of one estimated path.

use std::collections::BTreeSet;

use seese3_core::trajectory::{
    Alignment, Error, Matches, Relation, RpePairs, Statistics, Trajectory, ape, rpe,
};
use strum::VariantArray;

/// Settings of the relative pose error.
#[derive(Debug, Clone, Copy)]
pub struct PathProtocol {
    /// Δ, the length of a relative motion in poses.
    pub delta: usize,
    /// Which of the pose pairs Δ apart are compared.
    pub pairs: RpePairs,
}

/// Errors of one estimated path.
#[derive(Debug, Clone)]
pub struct PathComparison {
    /// Number of associated pose pairs.
    pub matched: usize,
    /// Number of reference poses without a matching estimate.
    pub unmatched_reference: usize,
    /// Number of estimated poses without a matching reference.
    pub unmatched_estimate: usize,
    /// Absolute errors by alignment, one entry per [`Relation`]. An alignment
    /// that is undefined for the path holds the reason instead.
    pub absolute: Vec<(Alignment, Result<[Statistics; 3], Error>)>,
    /// Relative errors, one entry per [`Relation`], or why they are undefined.
    pub relative: Result<[Statistics; 3], Error>,
    /// The settings of the relative error.
    pub protocol: PathProtocol,
}

impl PathComparison {
    /// The errors of the associated poses, with each alignment.
    ///
    /// # Errors
    /// [`Error`] if `matches` has different numbers of poses of the two paths. If an error is
    /// undefined for another reason, the result holds that reason.
    pub fn of(
        reference: &Trajectory,
        estimate: &Trajectory,
        matches: &Matches,
        protocol: PathProtocol,
    ) -> Result<Self, Error> {
        let of_reference = reference.select(&matches.reference);
        let of_estimate = estimate.select(&matches.estimate);
        let mut absolute = Vec::new();

        // An alignment may be undefined, as for positions on a line; the others are still
        // reported.
        for &alignment in Alignment::VARIANTS {
            let errors = match alignment.apply(&of_reference, &of_estimate) {
                Ok(aligned) => {
                    let mut by_relation = [Statistics::of(&[]); 3];
                    for (statistics, &relation) in by_relation.iter_mut().zip(Relation::VARIANTS) {
                        *statistics = Statistics::of(&ape(&of_reference, &aligned, relation)?);
                    }

                    Ok(by_relation)
                }
                Err(error) => Err(error),
            };

            absolute.push((alignment, errors));
        }

        // Relative errors do not depend on the choice of the world frame and need no alignment.
        let relative = Relation::VARIANTS
            .iter()
            .map(|&relation| {
                rpe(
                    &of_reference,
                    &of_estimate,
                    relation,
                    protocol.delta,
                    protocol.pairs,
                )
            })
            .map(|errors| errors.map(|errors| Statistics::of(&errors)))
            .collect::<Result<Vec<_>, Error>>()
            .map(|found| [found[0], found[1], found[2]]);

        // A pose may be matched more than once: several estimates can be nearest to one
        // reference.
        let distinct = |places: &[usize]| places.iter().collect::<BTreeSet<_>>().len();

        Ok(Self {
            matched: matches.reference.len(),
            unmatched_reference: reference.len() - distinct(&matches.reference),
            unmatched_estimate: estimate.len() - distinct(&matches.estimate),
            absolute,
            relative,
            protocol,
        })
    }
}
