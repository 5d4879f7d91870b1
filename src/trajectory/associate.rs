//! Which poses of two paths were at the same time.

use super::{Error, Trajectory};

/// Poses that belong together.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Matches {
    /// Places in the reference.
    pub reference: Vec<usize>,
    /// Places in the estimate, as many.
    pub estimate: Vec<usize>,
}

/// Pairs each pose of the shorter path with the nearest in time of the longer, at most
/// `max_difference_ns` away; the earlier of two as near. Of two equally long, the reference is the
/// longer.
///
/// # Errors
/// [`Error::NothingMatches`].
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
