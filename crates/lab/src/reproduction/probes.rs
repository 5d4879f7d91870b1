//! Section: probes M1 to M3 of the single-adapter rooms and of the held-out rooms.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::splits::Split;
use seese3_core::statistics::{RoomMean, mean_of_known, paired_difference};
use seese3_core::training::RoomData;

use super::claims::{Claim, Verdict, is_above_zero};
use super::render::plotted;
use super::{Error, Found, Reproduction, paper};
use crate::experiments::Within;
use crate::experiments::folds::FoldedMotions;
use crate::probes::{Duplicates, MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe};
use crate::report::{Curves, Section, Series, room_difference_text};

/// Maximum number of frames that M1 compares, as in the paper.
const M1_FRAMES: usize = 256;

/// JSON record of the probes of one room.
#[derive(Debug, Serialize)]
pub struct ProbeRecord {
    features: String,
    room: String,
    m1_short: f64,
    m1_long: f64,
    twonn: f64,
    mle: f64,
    /// R² over the pairs of all five folds together, like `constant`.
    m3: f64,
    constant: f64,
}

struct Probed {
    room: String,
    short: f64,
    long: f64,
    twonn: f64,
    mle: f64,
    ridge: f64,
    constant: f64,
}

/// Builds the section with M1 at a short and a long stride, M2 and M3.
#[expect(
    clippy::too_many_lines,
    reason = "a section of the report: its loop, its table and its claim"
)]
pub fn section(
    given: &Reproduction<'_>,
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<ProbeRecord>>, Error> {
    let mut section = Section::new("Probes: M1, M2, M3");
    let head = [
        "features", "room", "M1 short", "M1 long", "TwoNN", "MLE", "M3 R²", "constant",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];

    let mut series = Vec::new();
    let mut record = Vec::new();
    for set in &given.sets {
        // Probes use no other rooms, so the held-out rooms are probed too.
        let rooms: Vec<&RoomData<'_>> = set.in_room.iter().chain(&set.test).collect();
        let probed: Vec<Probed> = rooms
            .into_par_iter()
            .map(|room| probed(room, given))
            .collect::<Result<_, Error>>()?;

        // Probes train no adapter, so a room has one value per probe and no spread over seeds.
        for Probed {
            room,
            short,
            long,
            twonn,
            mle,
            ridge,
            constant,
        } in &probed
        {
            record.push(ProbeRecord {
                features: set.features.clone(),
                room: room.clone(),
                m1_short: *short,
                m1_long: *long,
                twonn: *twonn,
                mle: *mle,
                m3: *ridge,
                constant: *constant,
            });
        }

        for alone in &probed[..set.in_room.len()] {
            rows.push(row(&set.features, &alone.room, &alone.numbers()));
        }
        let held_out = &probed[set.in_room.len()..];
        rows.push(row(
            &set.features,
            &format!("mean of {} held out", held_out.len()),
            &mean_numbers(held_out),
        ));

        // One point per room: M1 at the short stride against M1 at the long one.
        let points = probed.iter().map(|p| [p.short, p.long]).collect();
        series.push(Series {
            name: set.features.clone(),
            points,
            joined: false,
        });
    }

    // The paper's rows have only M2 and M3: the cells of the room and of M1 stay empty.
    for (encoder, numbers) in paper::DIMENSIONS {
        let empty = [String::new(), String::new()];
        let numbers = numbers.map(|x| format!("{x:.2}"));
        let name = [format!("paper: {encoder}"), String::new()];
        let no_constant = [String::new()];
        rows.push(
            name.into_iter()
                .chain(empty)
                .chain(numbers)
                .chain(no_constant)
                .collect(),
        );
    }

    section.table(rows);

    section.text(format!(
        "M1: {M1_FRAMES} frames, k 10, 10 of them to each side left out; short is stride 1, long spreads them over the \
         whole recording. M2: no gap, as in the paper. M3 and always answering the mean training motion: stride {}, the \
         pairs of all five folds together.",
        given.options.stride
    ));

    let curves = Curves {
        title: "Mutual k-NN, short against long stride".to_owned(),
        x: "short stride".to_owned(),
        y: "long stride".to_owned(),
        series,
        diagonal: true,
    };

    section.picture(
        "m1.svg",
        plotted(&curves)?,
        "M1 at a short and a long stride, a point a room; the line is y = x",
    );

    // By convention the last feature set is the control, which needs no trained encoder.
    let long = |of: &Series| of.points.iter().map(|point| point[1]).collect::<Vec<f64>>();
    let (control, trained) = curves
        .series
        .split_last()
        .ok_or_else(|| Error::Input("at least one feature set is required".to_owned()))?;

    // Difference of M1 at the long stride between the trained encoder and the control, paired by
    // room.
    let over_control: Vec<RoomMean> = trained
        .iter()
        .map(|series| paired_difference(&long(series), &long(control), 0))
        .collect();
    let above: Vec<Option<bool>> = over_control.iter().map(is_above_zero).collect();
    let differences: Vec<String> = over_control.iter().map(room_difference_text).collect();
    let differences = match differences.as_slice() {
        [] => "there is no other feature set".to_owned(),
        all => all.join("; "),
    };

    claims.push(Claim {
        claim: "topology: a trained encoder's neighbours at a long stride are neighbours by pose, more than raw pixels' (M1)",
        verdict: Verdict::of_intervals(&above),
        found: format!(
            "M1 at the long stride over that of {}, room by room: {}",
            control.name,
            differences
        ),
    });

    Ok(Found { section, record })
}

impl Probed {
    /// The numbers in table column order.
    fn numbers(&self) -> [f64; 6] {
        [
            self.short,
            self.long,
            self.twonn,
            self.mle,
            self.ridge,
            self.constant,
        ]
    }
}

/// Mean of each column over the rooms.
fn mean_numbers(rooms: &[Probed]) -> [f64; 6] {
    std::array::from_fn(|column| {
        let values: Vec<f64> = rooms.iter().map(|room| room.numbers()[column]).collect();
        mean_of_known(&values)
    })
}

fn row(features: &str, room: &str, numbers: &[f64]) -> Vec<String> {
    let numbers = numbers.iter().map(|number| format!("{number:.3}"));
    [features.to_owned(), room.to_owned()]
        .into_iter()
        .chain(numbers)
        .collect()
}

fn probed(data: &RoomData<'_>, given: &Reproduction<'_>) -> Result<Probed, Error> {
    let room = data.room;
    let rows = data.features.rows();

    let what = || {
        format!(
            "room '{}', features '{}'",
            room.id(),
            data.features.source().name
        )
    };

    // The long stride spreads the sampled frames over the whole recording.
    let frames = M1_FRAMES.min(room.frame_count());
    let long = (room.frame_count().saturating_sub(1) / frames.saturating_sub(1).max(1)).max(1);

    let at = |stride: usize| {
        let options = MutualKnn {
            frames,
            stride,
            ..MutualKnn::default()
        };
        mutual_knn(rows, room.poses(), &options).within(what)
    };

    // M2 without a temporal gap, as in the paper; `sweep layers` uses a gap by default.
    let dimension = intrinsic_dimension(rows, 0, Duplicates::DropRows).within(what)?;
    let ridge = FoldedMotions::of(&Split::FOLDS, |split| {
        Ok(vec![ridge_probe(rows, room, split, given.options.stride)?])
    })
    .within(what)?;

    Ok(Probed {
        room: room.id().to_string(),
        short: at(1)?,
        long: at(long)?,
        twonn: dimension.two_nn.linear,
        mle: dimension.mle_biased.harmonic,
        ridge: ridge.scores().overall,
        constant: ridge.constant_r2(),
    })
}
