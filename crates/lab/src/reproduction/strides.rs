//! Section: M4 by stride, within a room.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::adapter::Preset;
use seese3_core::eval::Baselines;
use seese3_core::splits::Split;
use seese3_core::statistics::{bootstrap_mean, mean, mean_of_known, paired_difference};
use seese3_core::training::RoomData;

use super::claims::{Case, Claim, encoders_and_control};
use super::{Error, FeatureSet, Found, Reproduction};
use crate::experiments::cross_room::clipped_r2;
use crate::experiments::probe::{ProbeProtocol, probe_adapters};
use crate::report::{
    Figure, Section, Series, Table, room_difference_text, room_mean_text, spread_text,
};

/// JSON record of M4 at one stride.
#[derive(Debug, Serialize)]
pub struct StrideRecord {
    features: String,
    stride: u32,
    /// R² over the test pairs of all five folds together.
    r2_by_room_and_seed: Vec<Vec<f64>>,
    /// R² of the mean training motion, by room.
    constant_r2_by_room: Vec<f64>,
    /// R² in the last fold only (the paper's split), by room: mean over seeds.
    last_fifth_r2_by_room: Vec<f64>,
    /// The same for the mean training motion.
    last_fifth_constant_r2_by_room: Vec<f64>,
}

/// The scores with one feature set: by stride, then by room.
struct SetScores<'a> {
    set: &'a FeatureSet<'a>,
    by_stride: Vec<Vec<RoomScores>>,
}

/// Builds the section with M4 by stride.
pub fn section(given: &Reproduction<'_>) -> Result<Found<Vec<StrideRecord>>, Error> {
    // Train and test new adapters at every stride.
    let of_set = |set| {
        let strides = given.options.strides.iter();
        let by_stride = strides.map(|&stride| m4(given, set, stride));
        Ok(SetScores {
            set,
            by_stride: by_stride.collect::<Result<_, Error>>()?,
        })
    };
    let scored: Vec<SetScores<'_>> = given
        .sets
        .iter()
        .map(of_set)
        .collect::<Result<_, Error>>()?;

    let mut section = Section::new("M4: the adapter by stride, within a room");
    section.table(table(given, &scored, |scores| {
        format!(
            "{} ({:.2})",
            spread_text(&scores.overall, 2),
            scores.constant
        )
    }));
    section.text(format!(
        "Test R² over the pairs of all five folds of each recording together, each fold by adapters trained on the other \
         four: mean ± sd over {} seeds, and in brackets that of the mean training motion. {}",
        given.options.seeds,
        given.training_words()
    ));

    section.text("Means over the in-room rooms, with 95 % intervals, as max(R², −1):");
    section.table(means_table(given, &scored));

    section.text("The last of these folds by itself, which is the paper's split:");
    section.table(table(given, &scored, |scores| {
        let [ours, constant] = scores.last_fifth;
        format!("{ours:.2} ({constant:.2})")
    }));
    section.text(
        "Its R² divides by the variance of the last fifth alone. Where the constant in brackets is far below 0, that \
         fifth's motions are unlike the others, and R² is not informative.",
    );

    section.picture(
        "strides.svg",
        curves(given, &scored).svg()?,
        "M4 by stride, within a room",
    );

    Ok(Found {
        section,
        record: scored.iter().flat_map(|set| records(given, set)).collect(),
        claims: claims_of(given, &scored),
    })
}

/// The claims on the trained encoders and on the control, the last feature set.
fn claims_of(given: &Reproduction<'_>, scored: &[SetScores<'_>]) -> Vec<Claim> {
    let (trained, control) = encoders_and_control(scored);
    let cases = |scores: &SetScores<'_>, sign: f64| -> Vec<Case> {
        let strides = given.options.strides.iter().zip(&scores.by_stride);
        let case = |(stride, rooms): (&u32, &Vec<RoomScores>)| {
            let clipped = rooms.iter().map(|room| sign * clipped_r2(room.mean()));
            let case = format!("{}, stride {stride}", scores.set.features);
            Case::of_rooms(case, &clipped.collect::<Vec<f64>>())
        };
        strides.map(case).collect()
    };

    vec![
        Claim::new(
            "an adapter estimates motions of held-out frames within a room (M4: R² > 0)",
            "max(R², −1) of the mean over seeds",
            trained.iter().flat_map(|set| cases(set, 1.0)).collect(),
        ),
        Claim::new(
            "raw pixels have a negative R² even with the adapter",
            "−max(R², −1) of the control's mean over seeds",
            control.iter().flat_map(|set| cases(set, -1.0)).collect(),
        ),
    ]
}

/// One row per feature set and room, with a cell per stride.
fn table(
    given: &Reproduction<'_>,
    scored: &[SetScores<'_>],
    cell: fn(&RoomScores) -> String,
) -> Table {
    let strides = given.options.strides.iter();
    let titles: String = strides
        .map(|stride| format!(" | stride {stride}"))
        .collect();
    let mut table = Table::new(&format!("features | room{titles}"));

    for SetScores { set, by_stride } in scored {
        for (place, data) in set.in_room.iter().enumerate() {
            let cells = by_stride.iter().map(|rooms| cell(&rooms[place]));
            let room = std::iter::once(data.room.id().to_string());
            table.row(&set.features, room.chain(cells));
        }
    }

    table
}

/// The mean over rooms at each stride, beside the mean training motion.
fn means_table(given: &Reproduction<'_>, scored: &[SetScores<'_>]) -> Table {
    let mut table =
        Table::new("features | stride | adapter [95 %] | mean training motion | difference [95 %]");
    for SetScores { set, by_stride } in scored {
        for (stride, rooms) in given.options.strides.iter().zip(by_stride) {
            let each = |of: fn(&RoomScores) -> f64| -> Vec<f64> {
                rooms.iter().map(|room| clipped_r2(of(room))).collect()
            };
            let (ours, constant) = (each(RoomScores::mean), each(|room| room.constant));
            let cells = [
                stride.to_string(),
                room_mean_text(&bootstrap_mean(&ours, 0)),
                format!("{:.3}", mean_of_known(&constant)),
                room_difference_text(&paired_difference(&ours, &constant, 0)),
            ];
            table.row(&set.features, cells);
        }
    }
    table
}

fn curves(given: &Reproduction<'_>, scored: &[SetScores<'_>]) -> Figure {
    // R² has no lower bound: without clipping, one room could dominate the curve.
    let point = |(&stride, rooms): (&u32, &Vec<RoomScores>)| {
        let clipped = rooms.iter().map(|scores| clipped_r2(scores.mean()));
        [f64::from(stride), mean(&clipped.collect::<Vec<f64>>())]
    };
    let line = |SetScores { set, by_stride }: &SetScores<'_>| {
        let points = given.options.strides.iter().zip(by_stride).map(point);
        Series::line(&set.features, points.collect())
    };

    Figure::new(
        "Test R² by stride, five folds (rooms below −1 count as −1)",
        "stride, frames",
        "mean over rooms of max(R², −1)",
        scored.iter().map(line).collect(),
    )
}

fn records(given: &Reproduction<'_>, scored: &SetScores<'_>) -> Vec<StrideRecord> {
    let record = |(&stride, rooms): (&u32, &Vec<RoomScores>)| StrideRecord {
        features: scored.set.features.clone(),
        stride,
        r2_by_room_and_seed: rooms.iter().map(|scores| scores.overall.clone()).collect(),
        constant_r2_by_room: rooms.iter().map(|scores| scores.constant).collect(),
        last_fifth_r2_by_room: rooms.iter().map(|scores| scores.last_fifth[0]).collect(),
        last_fifth_constant_r2_by_room: rooms.iter().map(|scores| scores.last_fifth[1]).collect(),
    };

    let strides = given.options.strides.iter();
    strides.zip(&scored.by_stride).map(record).collect()
}

/// The scores of a room's adapters at one stride.
struct RoomScores {
    /// Overall test R², one value per seed.
    overall: Vec<f64>,
    /// R² of the mean training motion.
    constant: f64,
    /// R² in the last fold only: the adapters' mean over seeds, then the constant's.
    last_fifth: [f64; 2],
}

impl RoomScores {
    fn mean(&self) -> f64 {
        mean_of_known(&self.overall)
    }
}

fn m4(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
    stride: u32,
) -> Result<Vec<RoomScores>, Error> {
    // The probe overrides the plan's split and seed.
    let protocol = ProbeProtocol {
        m1: None,
        m2: None,
        m3: Vec::new(),
        m4: vec![given.plan(Preset::Base, Split::Time, stride, 0, None)],
        splits: Split::FOLDS.to_vec(),
        seeds: given.options.seeds,
    };

    let of = |room: &RoomData<'_>| {
        let at_strides = probe_adapters(std::slice::from_ref(room), &protocol)?;
        let no_folds = || Error::Input(format!("room '{}' has no folds", room.room.id()));
        let at = at_strides.first().ok_or_else(no_folds)?;
        let last = at.splits.last().ok_or_else(no_folds)?;

        let constant =
            |baselines: &Option<Baselines>| baselines.map_or(f64::NAN, |all| all.constant_r2);
        Ok(RoomScores {
            overall: at.runs.iter().map(|run| run.overall).collect(),
            constant: constant(&at.baselines),
            last_fifth: [last.r2, constant(&last.baselines)],
        })
    };

    set.in_room.par_iter().map(of).collect()
}
