//! M4 by stride, within a room.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::adapter::Preset;
use seese3_core::splits::Split;
use seese3_core::statistics::{mean, mean_of_known};
use seese3_core::training::{RoomData, train_adapter};

use super::claims::{Claim, Verdict};
use super::render::{plotted, spread};
use super::{Error, FeatureSet, Found, Reproduction};
use crate::experiments::cross_room::CLIPPED_R2;
use crate::report::{Curves, Section, Series};

/// M4 at a stride in `record.json`.
#[derive(Debug, Serialize)]
pub struct StrideRecord {
    features: String,
    stride: u32,
    r2_by_room_and_seed: Vec<Vec<f64>>,
}

/// The section of M4 by stride.
pub fn section(
    given: &Reproduction<'_>,
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<StrideRecord>>, Error> {
    let mut section = Section::new("M4: the adapter by stride, within a room");
    let strides = &given.options.strides;
    let mut rows = vec![["features", "room"].map(str::to_owned).to_vec()];
    rows[0].extend(strides.iter().map(|stride| format!("stride {stride}")));

    let mut series = Vec::new();
    let mut record = Vec::new();
    let mut positive = Vec::new();
    for set in &given.sets {
        let mut points = Vec::new();

        // One row per room; every stride adds a cell to each of them.
        let mut by_room: Vec<Vec<String>> = set
            .in_room
            .iter()
            .map(|data| vec![set.features.clone(), data.room.id().to_string()])
            .collect();

        // For every stride new adapters are trained on pairs at that stride and tested at it.
        for &stride in strides {
            let overall = m4(given, set, stride)?;
            for (row, seeds) in by_room.iter_mut().zip(&overall) {
                row.push(spread(seeds));
            }

            // R² has no lower bound: without clipping, a single room could decide the curve.
            let clipped: Vec<f64> = overall
                .iter()
                .map(|seeds| mean_of_known(seeds).max(CLIPPED_R2))
                .collect();
            points.push([f64::from(stride), mean(&clipped)]);

            // The claim is tested for each room, feature set and stride by its mean over seeds.
            positive.extend(overall.iter().map(|seeds| mean_of_known(seeds) > 0.0));
            record.push(StrideRecord {
                features: set.features.clone(),
                stride,
                r2_by_room_and_seed: overall,
            });
        }

        rows.extend(by_room);

        series.push(Series {
            name: set.features.clone(),
            points,
            joined: true,
        });
    }

    section.table(rows);

    section.text(format!(
        "Test R² of preset paper-base (10 epochs) on the last fifth of each recording, mean ± sd over {} seeds.",
        given.options.seeds
    ));

    let curves = Curves {
        title: "Test R² by stride".to_owned(),
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
        verdict: Verdict::of(&positive),
        found: format!(
            "mean R² is above 0 in {} of {} rooms, features and strides",
            positive.iter().filter(|&&held| held).count(),
            positive.len()
        ),
    });

    Ok(Found { section, record })
}

/// Overall test R² of adapters at one stride: one list per room, one value per seed.
fn m4(given: &Reproduction<'_>, set: &FeatureSet<'_>, stride: u32) -> Result<Vec<Vec<f64>>, Error> {
    let of = |room: &RoomData<'_>| {
        let seeds = 0..given.options.seeds;
        seeds
            .map(|seed| {
                let plan = given.plan(Preset::PaperBase, Split::Time, stride, seed, None);
                Ok(train_adapter(&[*room], &plan, &mut |_| ())?.1.test.overall)
            })
            .collect::<Result<Vec<f64>, Error>>()
    };

    set.in_room.par_iter().map(of).collect()
}
