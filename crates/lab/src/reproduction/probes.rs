//! Section: probes M1 to M3 of the single-adapter rooms and of the held-out rooms.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::splits::Split;
use seese3_core::statistics::{RoomMean, mean_of_known, paired_difference};
use seese3_core::training::RoomData;

use super::claims::{Claim, Verdict, is_above_zero};
use super::{Error, Found, Reproduction, paper};
use crate::experiments::Within;
use crate::experiments::folds::FoldedMotions;
use crate::probes::{MutualKnn, PoseDistance, intrinsic_dimension, mutual_knn, ridge_probe};
use crate::report::{Axes, Figure, Section, Series, Table, fixed, room_difference_text};

/// Maximum number of frames that M1 compares, as in the paper.
const M1_FRAMES: usize = 256;

/// The probes of one room: a row of the record.
#[derive(Debug, Serialize)]
pub struct ProbeRecord {
    features: String,
    room: String,
    m1_short: f64,
    m1_long: f64,
    /// M1 at the long stride by the norm of twists.
    m1_long_twist: f64,
    twonn: f64,
    mle: f64,
    /// R² over the pairs of all five folds together, like `constant`.
    m3: f64,
    constant: f64,
}

impl ProbeRecord {
    /// The numbers in table column order.
    fn numbers(&self) -> [f64; 7] {
        [
            self.m1_short,
            self.m1_long,
            self.m1_long_twist,
            self.twonn,
            self.mle,
            self.m3,
            self.constant,
        ]
    }
}

/// Builds the section with M1 at a short and a long stride, M2 and M3.
pub fn section(
    given: &Reproduction<'_>,
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<ProbeRecord>>, Error> {
    // Probes use no other rooms, so the held-out rooms are probed too. They train no adapter, so a
    // room has one value per probe and no spread over seeds.
    let mut by_set: Vec<Vec<ProbeRecord>> = Vec::new();
    for set in &given.sets {
        let rooms: Vec<&RoomData<'_>> = set.in_room.iter().chain(&set.test).collect();
        let probed = rooms
            .into_par_iter()
            .map(|room| probed(room, &set.features, given));
        by_set.push(probed.collect::<Result<_, Error>>()?);
    }

    let mut section = Section::new("Probes: M1, M2, M3");
    section.table(table(given, &by_set));
    section.text(format!(
        "M1: {M1_FRAMES} frames, k 10, 10 of them to each side left out; short is stride 1, long spreads them over the \
         whole recording. M2: no gap, as in the paper. M3 and always answering the mean training motion: stride {}, the \
         pairs of all five folds together.",
        given.options.stride
    ));

    // One point per room: M1 at the short stride against M1 at the long one.
    let series = given.sets.iter().zip(&by_set).map(|(set, probed)| {
        let points = probed.iter().map(|room| [room.m1_short, room.m1_long]);
        Series::dots(&set.features, points.collect())
    });
    let curves = Figure {
        axes: Axes::Diagonal,
        ..Figure::new(
            "Mutual k-NN, short against long stride",
            "short stride",
            "long stride",
            series.collect(),
        )
    };
    section.picture(
        "m1.svg",
        curves.svg()?,
        "M1 at a short and a long stride, a point a room; the line is y = x",
    );

    claims.push(claim(given, &by_set)?);
    let record = by_set.into_iter().flatten().collect();
    Ok(Found { section, record })
}

/// One row per single-adapter room, and one for the held-out rooms together; the paper's rows
/// follow.
fn table(given: &Reproduction<'_>, by_set: &[Vec<ProbeRecord>]) -> Table {
    let mut table = Table::new(
        "features | room | M1 short | M1 long | M1 long, by twist | TwoNN | MLE | M3 R² | constant",
    );

    for (set, probed) in given.sets.iter().zip(by_set) {
        let mut add = |room: String, numbers: [f64; 7]| {
            table.row(
                &set.features,
                std::iter::once(room).chain(fixed(numbers, 3)),
            );
        };

        let (alone, held_out) = probed.split_at(set.in_room.len());
        for room in alone {
            add(room.room.clone(), room.numbers());
        }
        let mean = std::array::from_fn(|column| {
            let values: Vec<f64> = held_out.iter().map(|room| room.numbers()[column]).collect();
            mean_of_known(&values)
        });
        add(format!("mean of {} held out", held_out.len()), mean);
    }

    // The paper's rows have only M2 and M3.
    for (encoder, numbers) in paper::DIMENSIONS {
        let [twonn, mle, m3] = fixed(numbers, 2);
        let empty = String::new;
        table.row(
            format!("paper: {encoder}"),
            [empty(), empty(), empty(), empty(), twonn, mle, m3, empty()],
        );
    }

    table
}

/// The difference of M1 at the long stride between each trained encoder and the control, paired by
/// room. By convention the last feature set is the control, which needs no trained encoder.
fn claim(given: &Reproduction<'_>, by_set: &[Vec<ProbeRecord>]) -> Result<Claim, Error> {
    let long = |set: &Vec<ProbeRecord>| set.iter().map(|room| room.m1_long).collect::<Vec<f64>>();
    let (Some(name), Some((control, trained))) = (given.sets.last(), by_set.split_last()) else {
        return Err(Error::Input(
            "at least one feature set is required".to_owned(),
        ));
    };

    let over_control: Vec<RoomMean> = trained
        .iter()
        .map(|set| paired_difference(&long(set), &long(control), 0))
        .collect();
    let above: Vec<Option<bool>> = over_control.iter().map(is_above_zero).collect();
    let differences: Vec<String> = over_control.iter().map(room_difference_text).collect();
    let differences = match differences.as_slice() {
        [] => "there is no other feature set".to_owned(),
        all => all.join("; "),
    };

    Ok(Claim {
        claim: "topology: a trained encoder's neighbors at a long stride are neighbors by pose, more than raw pixels' (M1)".to_owned(),
        verdict: Verdict::of_intervals(&above),
        found: format!(
            "M1 at the long stride over that of {}, room by room: {differences}",
            name.features
        ),
    })
}

fn probed(
    data: &RoomData<'_>,
    features: &str,
    given: &Reproduction<'_>,
) -> Result<ProbeRecord, Error> {
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

    let at = |stride: usize, pose_distance: PoseDistance| {
        let options = MutualKnn {
            frames,
            stride,
            pose_distance,
            ..MutualKnn::default()
        };
        mutual_knn(rows, room.poses(), &options).within(what)
    };

    // M2 without a temporal gap, as in the paper; `sweep layers` uses a gap by default.
    let dimension = intrinsic_dimension(rows, 0).within(what)?;
    let ridge = FoldedMotions::of(&Split::FOLDS, |split| {
        Ok(vec![ridge_probe(rows, room, split, given.options.stride)?])
    })
    .within(what)?;

    Ok(ProbeRecord {
        features: features.to_owned(),
        room: room.id().to_string(),
        m1_short: at(1, PoseDistance::NineNumbers)?,
        m1_long: at(long, PoseDistance::NineNumbers)?,
        m1_long_twist: at(long, PoseDistance::Twist)?,
        twonn: dimension.two_nn.linear,
        mle: dimension.mle_biased.harmonic,
        m3: ridge.scores().overall,
        constant: ridge.constant_r2(),
    })
}
