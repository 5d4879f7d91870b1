//! Section: held-out rooms. Zero-shot navigation compared with Identity, and scaling with the
//! number of training rooms.

use serde::Serialize;

use seese3_core::statistics::{bootstrap_mean, mean, paired_difference};

use super::claims::{Claim, is_above_zero, is_most};
use super::notes::published_name;
use super::plans::{PlanResult, SetResults};
use super::{Error, Found, Reproduction, paper};
use crate::experiments::cross_room::{CrossRoomRun, MotionSummary, wins};
use crate::report::{
    CrossRoomJson, Figure, Section, Series, Table, count_text, cross_room_json, room_mean_text,
};

/// The paper's navigator.
pub const AFFINE: &str = "inverse-poincare-affine";
/// The refit on z-scored motions. The ridge's α would over-shrink raw meters and radians.
const REFIT: &str = "ridge-refit-z-scored-in-sample";
/// The service's navigator.
pub const HOMOGENEOUS: &str = "inverse-poincare-homogeneous";

/// JSON record of the results with one feature set.
#[derive(Debug, Serialize)]
pub struct ZeroShotRecord {
    features: String,
    /// The adapters' names in the store, by increasing number of training rooms.
    adapters: Vec<String>,
    paper_range_by_size: CrossRoomJson,
}

/// Builds the section on zero-shot navigation and on scaling.
pub fn section(
    given: &Reproduction<'_>,
    results: &[SetResults],
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<ZeroShotRecord>>, Error> {
    let mut section =
        Section::new("Rooms never seen: zero-shot, and by how many rooms were learned from");
    section.table(table(results));

    // Report skipped rooms only for the run of the table: paper-range on all rooms.
    for set in results {
        let features = &set.features;
        for skipped in &set.baseline().run.skipped {
            let (room, why) = (&skipped.room, &skipped.why);
            section.text(format!("Skipped with {features}: room {room}: {why}."));
        }
    }

    section.text(format!(
        "Preset paper-range on all rooms that are learned together, one seed; every pair of a held-out room at stride \
         {}, all its frames are candidates, the source included. Intervals of counts are Wilson's; of means, those of \
         drawing the rooms again. The refit is fitted on the very pairs it is scored on.",
        given.options.stride
    ));

    add_curves(&mut section, results)?;
    claims.extend(claims_of(results));

    let record = results.iter().map(record).collect();
    Ok(Found { section, record })
}

fn record(set: &SetResults) -> ZeroShotRecord {
    let name = |result: &PlanResult| published_name(&result.plan.adapter_name(), &set.features);
    let runs: Vec<CrossRoomRun> = set
        .by_size
        .iter()
        .map(|result| result.run.clone())
        .collect();

    ZeroShotRecord {
        features: set.features.clone(),
        adapters: set.by_size.iter().map(name).collect(),
        paper_range_by_size: cross_room_json(&runs, AFFINE),
    }
}

/// Verdicts by the confidence intervals, not only by the fraction of rooms or the mean.
fn claims_of(results: &[SetResults]) -> [Claim; 4] {
    let over = |ours: &CrossRoomRun, name: &str, theirs: &CrossRoomRun| {
        let difference = paired_difference(&ours.hit_rates(name), &theirs.hit_rates(AFFINE), 0);
        is_above_zero(&difference)
    };

    let mut zero_shot = Vec::new();
    let mut refitted = Vec::new();
    let mut grows = Vec::new();
    let mut keeps_growing = Vec::new();
    for set in results {
        let whole = &set.baseline().run;
        zero_shot.push(wins(&whole.outcomes, AFFINE).as_ref().and_then(is_most));
        refitted.push(over(whole, REFIT, whole));

        if let [fewest, .., all] = set.by_size.as_slice() {
            grows.push(over(&all.run, AFFINE, &fewest.run));

            // On a plateau, the second half of the rooms would add nothing.
            let is_half = |result: &&PlanResult| 2 * result.plan.rooms <= all.plan.rooms;
            let half = set.by_size.iter().rfind(is_half);
            keeps_growing.extend(half.map(|half| over(&all.run, AFFINE, &half.run)));
        }
    }

    [
        Claim::over_feature_sets(
            "zero-shot navigation beats Identity in most rooms never seen (Hit@0.1)",
            "Wilson's interval of the share of rooms is above one half",
            &zero_shot,
        ),
        Claim::over_feature_sets(
            "refitting the linear step in the room itself does better than zero-shot",
            "the interval of the difference in Hit@0.1 of the z-scored refit, in sample, is above zero",
            &refitted,
        ),
        Claim::over_feature_sets(
            "more training rooms transfer better",
            "the interval of the difference in Hit@0.1 of all rooms over the fewest is above zero",
            &grows,
        ),
        Claim::over_feature_sets(
            "and without a plateau",
            "the interval of the difference in Hit@0.1 of all rooms over half of them is above zero",
            &keeps_growing,
        ),
    ]
}

/// A curve by increasing numbers of training rooms.
struct ScalingCurve {
    file: &'static str,
    title: &'static str,
    y: &'static str,
    caption: &'static str,
    /// The value of a run; NaN if no room has an R².
    of: fn(&CrossRoomRun) -> f64,
}

const SCALING_CURVES: [ScalingCurve; 3] = [
    ScalingCurve {
        file: "scaling-hits.svg",
        title: "Zero-shot Hit@0.1",
        y: "mean over held-out rooms",
        caption: "Zero-shot Hit@0.1 of inverse Poincaré",
        of: |run| mean(&run.hit_rates(AFFINE)),
    },
    ScalingCurve {
        file: "scaling-r2.svg",
        title: "Rooms with R² > 0",
        y: "share of held-out rooms",
        caption: "Held-out rooms with R² above 0",
        of: |run| MotionSummary::of(&run.r2(), 0).map_or(f64::NAN, |r2| r2.positive.rate),
    },
    ScalingCurve {
        file: "scaling-mean.svg",
        title: "R², negative ones as 0",
        y: "mean of max(R², 0)",
        caption: "Mean over held-out rooms of max(R², 0)",
        of: |run| MotionSummary::of(&run.r2(), 0).map_or(f64::NAN, |r2| r2.clipped_at_zero.mean),
    },
];

fn add_curves(section: &mut Section, results: &[SetResults]) -> Result<(), Error> {
    for curve in &SCALING_CURVES {
        let line = |set: &SetResults| {
            let sizes = set.by_size.iter();
            let points = sizes.map(|result| [result.plan.rooms as f64, (curve.of)(&result.run)]);
            Series::line(&set.features, points.collect())
        };
        let lines = results.iter().map(line).collect();
        let figure = Figure::new(curve.title, "rooms learned from", curve.y, lines);

        let caption = format!("{} by how many rooms were learned from", curve.caption);
        section.picture(curve.file, figure.svg()?, caption);
    }

    Ok(())
}

/// One row per feature set and navigator, for the adapter of all rooms; the paper's rows follow.
fn table(results: &[SetResults]) -> Table {
    let mut table = Table::new(
        "features | navigator | beats Identity in | Hit@0.1 [95 %] | R² > 0 | \
         mean max(R², −1) [95 %] | mean max(R², 0) [95 %]",
    );

    for set in results {
        let run = &set.baseline().run;
        for name in [
            AFFINE,
            HOMOGENEOUS,
            "inverse-poincare-affine+row-space",
            "inverse-poincare-affine+whitened",
            REFIT,
            "ridge-refit-in-sample",
        ] {
            // R² depends only on the adapter, so only the first row shows it.
            let summary = MotionSummary::of(&run.r2(), 0).filter(|_| name == AFFINE);
            let r2 = summary.map_or([const { String::new() }; 3], |r2| {
                [
                    count_text(&r2.positive, 2),
                    room_mean_text(&r2.clipped),
                    room_mean_text(&r2.clipped_at_zero),
                ]
            });

            let beats = wins(&run.outcomes, name).map(|rate| count_text(&rate, 2));
            let hit = room_mean_text(&bootstrap_mean(&run.hit_rates(name), 0));
            let cells = [name.to_owned(), beats.unwrap_or_default(), hit];
            table.row(&set.features, cells.into_iter().chain(r2));
        }
    }

    // The paper has no hit rates and no R² for its rows: four cells stay empty.
    for (encoder, zero, refit) in paper::CROSS_ROOM {
        for (what, count) in [("zero-shot", zero), ("ridge-refit", refit)] {
            let cells = [what, count, "", "", "", ""].map(str::to_owned);
            table.row(format!("paper: {encoder}"), cells);
        }
    }

    table
}
