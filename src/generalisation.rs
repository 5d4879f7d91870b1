//! How an adapter does in rooms that it never saw, and whether one way is better than another
//! there.
//!
//! Rooms, not pairs, are what is drawn again for an interval: pairs of one room are alike.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::eval::{self, NavigatorKind, Protocol, Row, evaluate};
use crate::navigation::{self, IndexKind, Navigator};
use crate::room::RoomId;
use crate::scores::{MotionScores, Rate, mean};
use crate::training::{Lesson, motions, predictions};

/// Rooms drawn again for an interval.
const RESAMPLES: usize = 10_000;
/// R² below this counts as this in a clipped mean: it has no lower bound, and one room would be all
/// of it.
pub const CLIPPED_R2: f64 = -1.0;

/// Why a room has no outcome.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Error {
    #[error(transparent)]
    Navigation(#[from] navigation::Error),
    #[error(transparent)]
    Evaluation(#[from] eval::Error),
}

/// What an adapter reached in a room.
#[derive(Debug, Clone)]
pub struct RoomOutcome {
    /// The room.
    pub room: RoomId,
    /// R² of the motions between the ends of its test pairs.
    pub motion: MotionScores,
    /// One row a navigator.
    pub rows: Vec<Row>,
    /// Frames among which answers were looked for.
    pub candidate_count: usize,
}

impl RoomOutcome {
    /// A navigator's Hit@ε at the first threshold of the protocol.
    pub fn hit_rate(&self, navigator: &str) -> Option<Rate> {
        let row = self.rows.iter().find(|row| row.name == navigator)?;
        row.retrieval.hits.first().map(|(_, rate)| *rate)
    }
}

/// An adapter in each of several rooms, in their order; a room that cannot be evaluated says why
/// (A-25).
pub fn outcomes(
    adapter: &Arc<Adapter>,
    lessons: &[Lesson<'_>],
    protocol: &Protocol,
    done: &(dyn Fn() + Sync),
) -> Vec<Result<RoomOutcome, (RoomId, Error)>> {
    let of = |lesson: &Lesson<'_>| {
        let outcome =
            outcome(adapter, lesson, protocol).map_err(|error| (lesson.room.id().clone(), error));
        done();
        outcome
    };
    lessons.par_iter().map(of).collect()
}

fn outcome(
    adapter: &Arc<Adapter>,
    lesson: &Lesson<'_>,
    protocol: &Protocol,
) -> Result<RoomOutcome, Error> {
    let room = Arc::new(lesson.room.clone());
    let navigator = Navigator::new(
        room.clone(),
        lesson.features,
        adapter.clone(),
        IndexKind::Exact,
    )?;

    let report = evaluate(
        &navigator,
        protocol,
        &Cancellation::default(),
        &mut |_, _| (),
    )?;

    let pairs = protocol
        .split
        .test_pairs(room.timeline(), protocol.stride)
        .map_err(eval::Error::from)?;
    let predicted =
        predictions(adapter, lesson.features.rows(), &pairs).map_err(eval::Error::from)?;

    Ok(RoomOutcome {
        room: room.id().clone(),
        motion: MotionScores::of(&motions(room.poses(), &pairs), &predicted),
        rows: report.rows,
        candidate_count: report.candidate_count,
    })
}

/// In how many rooms a navigator's hit rate is strictly above Identity's.
pub fn wins(outcomes: &[RoomOutcome], navigator: &str) -> Option<Rate> {
    let identity = NavigatorKind::Identity.name();
    let pairs: Vec<(f64, f64)> = outcomes
        .iter()
        .filter_map(|outcome| {
            Some((
                outcome.hit_rate(navigator)?.rate,
                outcome.hit_rate(&identity)?.rate,
            ))
        })
        .collect();

    let won = pairs
        .iter()
        .filter(|(ours, identity)| ours > identity)
        .count();

    (!pairs.is_empty()).then(|| Rate::of(won, pairs.len()))
}

/// A mean over rooms with the 95 % interval of drawing the rooms again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoomMean {
    /// The mean.
    pub mean: f64,
    /// The 2.5 % point.
    pub low: f64,
    /// The 97.5 % point.
    pub high: f64,
    /// Rooms.
    pub rooms: usize,
}

/// The mean of one value a room, with a percentile bootstrap over rooms; NaN of none.
pub fn over_rooms(values: &[f64], seed: u64) -> RoomMean {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let drawn = (0..values.len()).map(|_| values[random.random_range(0..values.len())]);
            drawn.sum::<f64>() / values.len() as f64
        })
        .collect();

    means.sort_by(f64::total_cmp);
    let point = |share: f64| means[((RESAMPLES - 1) as f64 * share).round() as usize];

    RoomMean {
        mean: mean(values),
        low: point(0.025),
        high: point(0.975),
        rooms: values.len(),
    }
}

/// How much more often one navigator hits than another, room by room: both in the same rooms, in
/// the same order.
pub fn difference(ours: &[f64], theirs: &[f64], seed: u64) -> RoomMean {
    let differences: Vec<f64> = ours.iter().zip(theirs).map(|(a, b)| a - b).collect();
    over_rooms(&differences, seed)
}

/// R² over rooms: what the paper's scaling curves show (sec. 2.7).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionSummary {
    /// Rooms whose overall R² is above 0.
    pub positive: Rate,
    /// Rooms whose overall R² is above 0.3.
    pub above_0_3: Rate,
    /// The largest overall R².
    pub best: f64,
    /// Mean of max(R², −1).
    pub clipped: RoomMean,
}

impl MotionSummary {
    /// Of one overall R² a room; none without a room that has one.
    pub fn of(r2: &[f64], seed: u64) -> Option<Self> {
        let known: Vec<f64> = r2.iter().copied().filter(|r2| !r2.is_nan()).collect();
        let above =
            |least: f64| Rate::of(known.iter().filter(|&&r2| r2 > least).count(), known.len());
        let clipped: Vec<f64> = known.iter().map(|r2| r2.max(CLIPPED_R2)).collect();

        (!known.is_empty()).then(|| Self {
            positive: above(0.0),
            above_0_3: above(0.3),
            best: known.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            clipped: over_rooms(&clipped, seed),
        })
    }
}

/// The first rooms of a seeded order: the rooms of a smaller number are among those of a larger
/// one.
pub fn nested_choice(count: usize, of: usize, seed: u64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..of).collect();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for place in 0..of.saturating_sub(1) {
        let other = random.random_range(place..of);
        order.swap(place, other);
    }

    order.truncate(count);
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the normal approximation, mean ± 1.96 standard errors, which is near for a hundred
    /// even values.
    #[test]
    fn the_bootstrap_interval_is_near_the_normal_one() {
        let values: Vec<f64> = (0..100).map(|i| f64::from(i) / 99.0).collect();
        let found = over_rooms(&values, 1);
        let error = 1.96 * crate::scores::deviation(&values) / 10.0;

        assert!((found.mean - 0.5).abs() < 1e-12 && found.rooms == 100);

        assert!(
            (found.low - (0.5 - error)).abs() < 0.005 && (found.high - (0.5 + error)).abs() < 0.005,
            "{found:?}"
        );
    }

    /// Oracle: by hand. A difference that is the same in every room has no spread, however the
    /// rooms differ.
    #[test]
    fn differences_are_paired_by_room() {
        let found = difference(&[0.9, 0.5, 0.1], &[0.8, 0.4, 0.0], 1);
        assert!(
            (found.mean - 0.1).abs() < 1e-12 && (found.high - found.low).abs() < 1e-12,
            "{found:?}"
        );
    }

    /// Oracle: by hand: of three rooms one is won, one lost, one tied, and a tie is no win.
    #[test]
    fn a_win_is_strictly_more_hits_than_identity() {
        let retrieval = |hits: usize| crate::eval::RetrievalScores {
            top1: Rate::of(0, 10),
            hits: vec![(0.1, Rate::of(hits, 10))],
            twist_error_mean: 0.0,
            twist_error_median: 0.0,
            translation_m_median: 0.0,
            rotation_rad_median: 0.0,
            pose_recalls: Vec::new(),
        };

        let row = |name: &str, hits| Row {
            name: name.to_owned(),
            n: 10,
            latent: None,
            retrieval: retrieval(hits),
        };

        let outcome = |ours, identity| RoomOutcome {
            room: RoomId::new("r").unwrap(),
            motion: MotionScores::of(&[], &[]),
            rows: vec![row("identity", identity), row("ours", ours)],
            candidate_count: 10,
        };
        let won = wins(&[outcome(5, 4), outcome(3, 4), outcome(4, 4)], "ours").unwrap();

        assert_eq!((won.successes(), won.n), (1, 3));
        assert!(wins(&[outcome(5, 4)], "theirs").is_none());
    }

    /// Oracle: by hand.
    #[test]
    fn r2_of_rooms_is_clipped_and_counted() {
        let summary = MotionSummary::of(&[0.5, 0.1, -7.0, f64::NAN], 0).unwrap();
        assert_eq!((summary.positive.rate, summary.positive.n), (2.0 / 3.0, 3));
        assert_eq!((summary.above_0_3.rate, summary.best), (1.0 / 3.0, 0.5));
        assert!((summary.clipped.mean + 0.4 / 3.0).abs() < 1e-12);

        assert!(MotionSummary::of(&[f64::NAN], 0).is_none());
    }

    /// Oracle: the definition: no room twice, and the smaller choice within the larger one.
    #[test]
    fn smaller_choices_are_within_larger_ones() {
        let small = nested_choice(5, 100, 3);
        let large = nested_choice(50, 100, 3);
        assert_eq!(small, large[..5]);

        let distinct: std::collections::HashSet<_> = large.iter().collect();
        assert_eq!(distinct.len(), 50);
        assert_ne!(large, nested_choice(50, 100, 4));
    }
}
