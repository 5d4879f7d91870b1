//! Association of two trajectories by time.

use super::{Error, Trajectory};

/// Matched poses: entries i of both lists are a match.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Matches {
    /// Indices into the reference.
    pub reference: Vec<usize>,
    /// Indices into the estimate, as many as `reference` has.
    pub estimate: Vec<usize>,
}

/// Matches each pose of the shorter trajectory with the nearest pose in time of the longer one, if
/// at most `max_difference_ns` away. Ties go to the earlier pose. At equal lengths, the reference
/// counts as the longer.
///
/// # Errors
/// [`Error::NothingMatches`] when there is no match.
///
/// Source: evo's `associate_trajectories`.
pub fn associate(
    reference: &Trajectory,
    estimate: &Trajectory,
    max_difference_ns: u64,
) -> Result<Matches, Error> {
    let estimate_is_longer = estimate.len() > reference.len();
    let (short, long) = if estimate_is_longer {
        (reference, estimate)
    } else {
        (estimate, reference)
    };

    let mut of_short = Vec::new();
    let mut of_long = Vec::new();
    for (place, &time) in short.times_ns.iter().enumerate() {
        // The nearest time is either the last one before `time` or the first one at or after it.
        let after = long.times_ns.partition_point(|&other| other < time);
        let around = after.saturating_sub(1)..(after + 1).min(long.len());
        let Some(nearest) = around.min_by_key(|&other| long.times_ns[other].abs_diff(time)) else {
            continue;
        };

        if long.times_ns[nearest].abs_diff(time) <= max_difference_ns {
            of_short.push(place);
            of_long.push(nearest);
        }
    }

    if of_short.is_empty() {
        return Err(Error::NothingMatches { max_difference_ns });
    }

    // Convert from shorter and longer to reference and estimate.
    let (reference, estimate) = if estimate_is_longer {
        (of_short, of_long)
    } else {
        (of_long, of_short)
    };

    Ok(Matches {
        reference,
        estimate,
    })
}
