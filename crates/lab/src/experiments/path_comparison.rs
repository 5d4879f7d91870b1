//! Absolute and relative pose errors (APE and RPE) of one estimated path.

use std::collections::BTreeSet;

use seese3_core::trajectory::{
    Alignment, Error, Matches, Relation, RpePairs, Statistics, Trajectory, ape, rpe,
};

/// Settings of the relative pose error.
#[derive(Debug, Clone, Copy)]
pub struct PathProtocol {
    /// Δ, the number of poses from the start of a relative motion to its end.
    pub delta: usize,
    /// Which pairs of poses that are Δ apart are compared.
    pub pairs: RpePairs,
}

/// Errors of one estimated path.
#[derive(Debug, Clone)]
pub struct PathComparison {
    /// Number of pose pairs that were compared.
    pub matched: usize,
    /// Poses of the reference that have no matching estimate.
    pub unmatched_reference: usize,
    /// Poses of the estimate that have no matching reference.
    pub unmatched_estimate: usize,
    /// Absolute errors by alignment, one entry per relation of [`Relation::ALL`]. An alignment that
    /// the path does not determine holds the reason instead.
    pub absolute: Vec<(Alignment, Result<[Statistics; 3], Error>)>,
    /// Relative errors, one entry per relation of [`Relation::ALL`], or why there are none.
    pub relative: Result<[Statistics; 3], Error>,
    /// The settings of the relative error.
    pub protocol: PathProtocol,
}

impl PathComparison {
    /// The errors of the associated poses, with each alignment.
    ///
    /// # Errors
    /// [`Error`] if `matches` does not hold as many poses of the one path as of the other. An error
    /// that is undefined for another reason is kept in the result.
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
        for alignment in Alignment::ALL {
            let errors = match alignment.apply(&of_reference, &of_estimate) {
                Ok(aligned) => {
                    let mut by_relation = [Statistics::of(&[]); 3];
                    for (statistics, relation) in by_relation.iter_mut().zip(Relation::ALL) {
                        *statistics = Statistics::of(&ape(&of_reference, &aligned, relation)?);
                    }

                    Ok(by_relation)
                }
                Err(error) => Err(error),
            };

            absolute.push((alignment, errors));
        }

        // Relative errors do not depend on the choice of the world frame and need no alignment.
        let relative = Relation::ALL
            .map(|relation| {
                rpe(
                    &of_reference,
                    &of_estimate,
                    relation,
                    protocol.delta,
                    protocol.pairs,
                )
            })
            .into_iter()
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
