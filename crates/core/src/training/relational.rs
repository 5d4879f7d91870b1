//! Training of a relational reader on rooms.

use ndarray::ArrayView2;

use super::{Error, RoomData, check_rooms};
use crate::adapter::{
    CellLayout, Cells, EpochProgress, PairSampler, RelationalConfig, RelationalReader,
    RelationalSamples, RoomFrames, train_relational,
};
use crate::cancel::Cancellation;
use crate::geometry::Twist;
use crate::splits::{self, Pair, Split};

/// Trains a relational reader on the training frames of all rooms.
///
/// # Errors
/// [`Error::Setting`] or [`Error::Rate`] for a setting out of range, [`Error::Adapter`] when the
/// features are not pooled to grids or the training diverges, [`Error::RoomPairs`] when a room has
/// no training pair, otherwise as [`check_rooms`].
pub fn train_reader(
    rooms: &[RoomData<'_>],
    split: Split,
    config: &RelationalConfig,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<RelationalReader, Error> {
    check_config(config)?;
    check_rooms(rooms)?;
    let source = rooms[0].features.source();
    let layout = CellLayout::of(source)?;

    // The frames of all rooms are stacked; pairs refer to rows of the stack.
    let mut frames = Vec::with_capacity(rooms.len());
    let mut first_row = 0;
    for data in rooms {
        let runs = split.training_runs(data.room.timeline());
        if !runs.iter().any(|run| run.len() > 1) {
            let frame_count = data.room.frame_count();
            return Err(Error::RoomPairs {
                room: data.room.id().clone(),
                problem: splits::Error::NoPairs {
                    frame_count,
                    stride: 1,
                    split,
                    side: "training",
                },
            });
        }

        frames.push(RoomFrames {
            first_row,
            poses: data.room.poses().to_vec(),
            runs,
        });
        first_row += data.room.frame_count();
    }

    let rows: Vec<ArrayView2<'_, f32>> = rooms.iter().map(|data| data.features.rows()).collect();
    let cells = Cells::stacked(&layout, &rows)?;
    let pairs = PairSampler::new(frames, config.longest_stride, config.far_share);
    let pairs = pairs.ok_or(Error::NoRoom)?;
    let samples = RelationalSamples::new(&layout, cells, pairs);

    let members = train_relational(&samples, config, &Cancellation::default(), progress)?;
    Ok(RelationalReader::new(source, members)?)
}

fn check_config(config: &RelationalConfig) -> Result<(), Error> {
    for (what, given, least, most) in [
        (
            "members of a reader",
            config.members,
            1,
            crate::adapter::MAX_MEMBERS,
        ),
        ("epochs of a reader", config.epochs, 1, super::MAX_EPOCHS),
        ("the batch of a reader", config.batch, 1, super::MAX_BATCH),
        (
            "hidden columns of a reader",
            config.hidden,
            1,
            super::MAX_LATENT_DIM,
        ),
        (
            "the longest stride of a reader",
            config.longest_stride,
            1,
            100_000,
        ),
    ] {
        if !(least..=most).contains(&given) {
            return Err(Error::Setting {
                what,
                least,
                most,
                given,
            });
        }
    }

    for (what, given, most, bound) in [
        ("the share of far pairs", config.far_share, 1.0, "0 to 1"),
        ("the noise of a reader", config.noise, 10.0, "0 to 10"),
        (
            "the decay of a reader's average",
            config.average,
            0.999_999,
            "at least 0 and under 1",
        ),
    ] {
        if !(0.0..=most).contains(&given) {
            return Err(Error::Rate { what, bound, given });
        }
    }

    if !(config.learning_rate.is_finite() && config.learning_rate > 0.0) {
        return Err(Error::Rate {
            what: "the learning rate of a reader",
            bound: "positive",
            given: config.learning_rate,
        });
    }

    Ok(())
}

/// Motions of pairs as a relational reader predicts them, from the features of their two frames.
///
/// # Errors
/// [`crate::adapter::Error::FeatureDim`] for features of another width.
pub fn relational_predictions(
    reader: &RelationalReader,
    rows: ArrayView2<'_, f32>,
    pairs: &[Pair],
) -> Result<Vec<Twist>, crate::adapter::Error> {
    let cells = reader.cells(rows)?;
    let of = |pair: &Pair| {
        let target = cells.select(&[pair.target.row()]);
        reader.motions(&cells, pair.source.row(), &target)[0].twist
    };

    Ok(pairs.iter().map(of).collect())
}
