//! M3: ridge regression from feature differences to motions.

use ndarray::{Array2, ArrayView2, Axis};

use super::Error;
use seese3_core::adapter::TargetScale;
use seese3_core::geometry::{Twist, body_twist};
use seese3_core::motion_scores::ReadMotions;
use seese3_core::ridge::{Intercept, Ridge};
use seese3_core::room::Room;
use seese3_core::splits::{Pair, Split};

/// Predicts the motions of the test pairs by ridge regression (α = 1, with intercept) on feature
/// differences.
///
/// `rows` are the room's features (n, d), one row per frame. Differences are computed in f64.
///
/// # Errors
/// [`Error::Pairs`] if the room is too short for the stride.
///
/// Source: SeeSE3, M3.
pub fn ridge_probe(
    rows: ArrayView2<'_, f32>,
    room: &Room,
    split: Split,
    stride: u32,
) -> Result<ReadMotions, Error> {
    let train = split.train_pairs(room.timeline(), stride)?;
    let test = split.test_pairs(room.timeline(), stride)?;
    let (train_x, train_y) = samples(rows, room, &train);
    let targets = Array2::from_shape_fn((train_y.len(), 6), |(row, c)| train_y[row].to_vector()[c]);
    let fit = Ridge::fit(train_x.view(), targets.view(), 1.0, Intercept::Fitted)?;

    let (test_x, truth) = samples(rows, room, &test);
    let read: Vec<Twist> = test_x
        .outer_iter()
        .map(|x| {
            let y = fit.predict(x);
            Twist::from_vector(&nalgebra::Vector6::from_fn(|c, _| y[c]))
        })
        .collect();

    let mean = TargetScale::of(&train_y).mean;
    Ok(ReadMotions::new(truth, read, &mean))
}

fn samples(rows: ArrayView2<'_, f32>, room: &Room, pairs: &[Pair]) -> (Array2<f64>, Vec<Twist>) {
    let ends = |end: fn(&Pair) -> usize| {
        rows.select(Axis(0), &pairs.iter().map(end).collect::<Vec<_>>())
            .mapv(f64::from)
    };

    let motion = |pair: &Pair| {
        body_twist(
            &room.poses()[pair.source.row()],
            &room.poses()[pair.target.row()],
        )
    };

    (
        ends(|pair| pair.target.row()) - ends(|pair| pair.source.row()),
        pairs.iter().map(motion).collect(),
    )
}
