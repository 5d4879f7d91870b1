//! Section: M4 by stride, within a room.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::adapter::Preset;
use seese3_core::eval::LEAST_CONSTANT_R2;
use seese3_core::splits::Split;
use seese3_core::statistics::{mean, mean_of_known};
use seese3_core::training::RoomData;

use super::claims::{Claim, Verdict, count_words};
use super::render::{plotted, spread};
use super::{Error, FeatureSet, Found, Reproduction};
use crate::experiments::cross_room::CLIPPED_R2;
use crate::experiments::probe::{ProbeProtocol, probe_adapters};
use crate::report::{Curves, Section, Series};

/// JSON record of M4 at one stride.
#[derive(Debug, Serialize)]
pub struct StrideRecord {
    features: String,
    stride: u32,
    /// R² over the test pairs of all five folds together.
    r2_by_room_and_seed: Vec<Vec<f64>>,
    /// R² of the constant baseline (the mean training motion), by room.
    constant_r2_by_room: Vec<f64>,
    /// R² in the last fold only (the paper's split), by room: mean over seeds, then the constant's.
    last_fifth_r2_by_room: Vec<f64>,
    last_fifth_constant_r2_by_room: Vec<f64>,
}

/// Builds the section with M4 by stride.
#[expect(
    clippy::too_many_lines,
    reason = "a section of the report: its loop, its table and its claim"
)]
pub fn section(
    given: &Reproduction<'_>,
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<StrideRecord>>, Error> {
    let mut section = Section::new("M4: the adapter by stride, within a room");
    let strides = &given.options.strides;
    let mut head = ["features", "room"].map(str::to_owned).to_vec();
    head.extend(strides.iter().map(|stride| format!("stride {stride}")));
    let mut rows = vec![head.clone()];
    let mut last_rows = vec![head];

    let mut series = Vec::new();
    let mut record = Vec::new();
    // One case per room, feature set and stride.
    let mut positive: Vec<Option<bool>> = Vec::new();
    for set in &given.sets {
        let mut points = Vec::new();

        // One row per room; every stride adds a cell to each of them.
        let mut by_room: Vec<Vec<String>> = set
            .in_room
            .iter()
            .map(|data| vec![set.features.clone(), data.room.id().to_string()])
            .collect();
        let mut last_by_room = by_room.clone();

        // Train and test new adapters at every stride.
        for &stride in strides {
            let scored = m4(given, set, stride)?;
            for (row, scores) in by_room.iter_mut().zip(&scored) {
                row.push(format!(
                    "{} ({:.2})",
                    spread(&scores.overall),
                    scores.constant
                ));
            }
            for (row, scores) in last_by_room.iter_mut().zip(&scored) {
                let [ours, constant] = scores.last_fifth;
                row.push(format!("{ours:.2} ({constant:.2})"));
            }

            // R² has no lower bound: without clipping, one room could dominate the curve.
            let clipped: Vec<f64> = scored
                .iter()
                .map(|scores| scores.mean().max(CLIPPED_R2))
                .collect();
            points.push([f64::from(stride), mean(&clipped)]);

            // Test the claim on the mean over seeds; skip cases with a too low constant baseline.
            positive.extend(scored.iter().map(RoomScores::is_positive));
            record.push(StrideRecord {
                features: set.features.clone(),
                stride,
                constant_r2_by_room: scored.iter().map(|scores| scores.constant).collect(),
                last_fifth_r2_by_room: scored.iter().map(|scores| scores.last_fifth[0]).collect(),
                last_fifth_constant_r2_by_room: scored
                    .iter()
                    .map(|scores| scores.last_fifth[1])
                    .collect(),
                r2_by_room_and_seed: scored.into_iter().map(|scores| scores.overall).collect(),
            });
        }

        rows.extend(by_room);
        last_rows.extend(last_by_room);

        series.push(Series {
            name: set.features.clone(),
            points,
            joined: true,
        });
    }

    section.table(rows);

    section.text(format!(
        "Test R² over the pairs of all five folds of each recording together, each fold read by adapters that the other \
         four trained: mean ± sd over {} seeds, and in brackets that of always answering the mean training motion. {}",
        given.options.seeds,
        given.training_words()
    ));

    section.text("The last of these folds by itself, which is the paper's split:");
    section.table(last_rows);
    section.text(
        "Its R² divides by the variance of the last fifth alone. Where the constant in brackets is far below 0, that \
         fifth's motions are unlike the others, and the number says little of an adapter.",
    );

    let curves = Curves {
        title: "Test R² by stride, five folds (rooms below −1 count as −1)".to_owned(),
        x: "stride, frames".to_owned(),
        y: "mean over rooms of max(R², −1)".to_owned(),
        series,
        diagonal: false,
    };

    section.picture(
        "strides.svg",
        plotted(&curves)?,
        "M4 by stride, within a room",
    );

    claims.push(Claim {
        claim: "an adapter reads the motion of frames never seen, within a room (M4: R² > 0)",
        verdict: Verdict::of_telling(&positive),
        found: format!(
            "mean R² is above 0: {}",
            count_words(&positive, "rooms, features and strides")
        ),
    });

    Ok(Found { section, record })
}

/// The scores of a room's adapters at one stride.
struct RoomScores {
    /// Overall test R², one value per seed.
    overall: Vec<f64>,
    /// R² of the constant baseline, the mean training motion.
    constant: f64,
    /// R² in the last fold only: the adapters' mean over seeds, then the constant's.
    last_fifth: [f64; 2],
}

impl RoomScores {
    fn mean(&self) -> f64 {
        mean_of_known(&self.overall)
    }

    /// Whether the mean is above zero; `None` if the constant is below [`LEAST_CONSTANT_R2`], so
    /// that R² is not informative.
    fn is_positive(&self) -> Option<bool> {
        (self.constant >= LEAST_CONSTANT_R2).then(|| self.mean() > 0.0)
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
        let (Some(at), Some(last)) = (at_strides.first(), at_strides[0].by_split.last()) else {
            return Err(Error::Input("a room without folds".to_owned()));
        };

        let baselines = at.baselines.as_ref();
        let constant = baselines.map_or(f64::NAN, |all| all.together.constant_r2);
        let last_constant = baselines
            .and_then(|all| all.by_split.last())
            .map_or(f64::NAN, |fold| fold.constant_r2);

        Ok(RoomScores {
            overall: at.runs.iter().map(|run| run.overall).collect(),
            constant,
            last_fifth: [last.1, last_constant],
        })
    };

    set.in_room.par_iter().map(of).collect()
}
