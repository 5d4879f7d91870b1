//! Section: held-out rooms. Zero-shot navigation compared with Identity, and scaling with the
//! number of training rooms.

use serde::Serialize;

use seese3_core::statistics::{Rate, bootstrap_mean, mean, paired_difference};

use super::claims::{Claim, Verdict, count_words, is_above_zero, is_most};
use super::notes::published_name;
use super::plans::{PlanResult, SetResults};
use super::render::plotted;
use super::{Error, Found, Reproduction, paper};
use crate::experiments::cross_room::{CrossRoomRun, MotionSummary, wins};
use crate::report::{CrossRoomJson, Curves, Section, Series, cross_room_json, room_mean_text};

/// The paper's navigator.
pub const AFFINE: &str = "inverse-poincare-affine";
/// The refit on z-scored motions. The ridge's α would over-shrink raw metres and radians.
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
#[expect(
    clippy::too_many_lines,
    reason = "a section of the report: its loop, its table and its claim"
)]
pub fn section(
    given: &Reproduction<'_>,
    results: &[SetResults],
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<ZeroShotRecord>>, Error> {
    let mut section =
        Section::new("Rooms never seen: zero-shot, and by how many rooms were learned from");

    let head = [
        "features",
        "navigator",
        "beats Identity in",
        "Hit@0.1 [95 %]",
        "R² > 0",
        "mean max(R², −1) [95 %]",
        "mean max(R², 0) [95 %]",
    ];

    let mut rows = vec![head.map(str::to_owned).to_vec()];
    let mut hits = Vec::new();
    let mut fractions = Vec::new();
    let mut means = Vec::new();
    let mut record = Vec::new();

    let mut zero_shot = Vec::new();
    let mut refitted = Vec::new();
    let mut grows = Vec::new();
    let mut keeps_growing = Vec::new();
    for set in results {
        let features = set.features.as_str();
        let whole = &set.baseline().run;
        rows.extend(zero_shot_rows(features, whole));

        // Verdicts use the confidence intervals, not only the fraction of rooms or the mean.
        zero_shot.push(wins(&whole.outcomes, AFFINE).as_ref().and_then(is_most));
        let over = |ours: &CrossRoomRun, name: &str, theirs: &CrossRoomRun| {
            paired_difference(&ours.hit_rates(name), &theirs.hit_rates(AFFINE), 0)
        };
        refitted.push(is_above_zero(&over(whole, REFIT, whole)));

        // The scaling curve: one preset, with increasing numbers of training rooms.
        let points = |of: &dyn Fn(&CrossRoomRun) -> f64| {
            set.by_size
                .iter()
                .map(|result| [result.plan.rooms as f64, of(&result.run)])
                .collect::<Vec<_>>()
        };
        let hit = points(&|run| mean_hit(run, AFFINE));

        // NaN if no room has an R² at this size.
        let fraction =
            points(&|run| MotionSummary::of(&run.r2(), 0).map_or(f64::NAN, |s| s.positive.rate));

        let mean_at_zero = points(&|run| {
            MotionSummary::of(&run.r2(), 0).map_or(f64::NAN, |s| s.clipped_at_zero.mean)
        });

        if let [fewest, .., all] = set.by_size.as_slice() {
            grows.push(is_above_zero(&over(&all.run, AFFINE, &fewest.run)));

            // On a plateau, the second half of the rooms would add nothing.
            let is_half = |result: &&PlanResult| 2 * result.plan.rooms <= all.plan.rooms;
            if let Some(half) = set.by_size.iter().rfind(is_half) {
                keeps_growing.push(is_above_zero(&over(&all.run, AFFINE, &half.run)));
            }
        }

        hits.push(Series {
            name: features.to_owned(),
            points: hit,
            joined: true,
        });

        fractions.push(Series {
            name: features.to_owned(),
            points: fraction,
            joined: true,
        });

        means.push(Series {
            name: features.to_owned(),
            points: mean_at_zero,
            joined: true,
        });

        let adapters: Vec<String> = set
            .by_size
            .iter()
            .map(|result| published_name(&result.plan.adapter_name(), features))
            .collect();

        let runs: Vec<CrossRoomRun> = set
            .by_size
            .iter()
            .map(|result| result.run.clone())
            .collect();
        record.push(ZeroShotRecord {
            features: features.to_owned(),
            adapters,
            paper_range_by_size: cross_room_json(&runs, AFFINE),
        });
    }

    rows.extend(paper_rows());
    section.table(rows);

    // Report skipped rooms only for the run of the table: paper-range on all rooms.
    for set in results {
        let features = &set.features;
        for (room, why) in &set.baseline().run.skipped {
            section.text(format!("Skipped with {features}: room {room}: {why}."));
        }
    }

    section.text(format!(
        "Preset paper-range on all rooms that are learned together, one seed; every pair of a held-out room at stride \
         {}, all its frames are candidates, the source included. Intervals of counts are Wilson's; of means, those of \
         drawing the rooms again. The refit is fitted on the very pairs it is scored on.",
        given.options.stride
    ));

    add_curves(&mut section, hits, fractions, means)?;

    claims.push(Claim {
        claim: "zero-shot navigation beats Identity in most rooms never seen (Hit@0.1)",
        verdict: Verdict::of_intervals(&zero_shot),
        found: format!(
            "Wilson's interval of the share of rooms is above one half: {}",
            count_words(&zero_shot, "feature sets")
        ),
    });

    claims.push(Claim {
        claim: "refitting the linear step in the room itself does better than zero-shot",
        verdict: Verdict::of_intervals(&refitted),
        found: format!(
            "the interval of the difference in Hit@0.1 of the z-scored refit, in sample, is above zero: {}",
            count_words(&refitted, "feature sets")
        ),
    });

    claims.push(Claim {
        claim: "more training rooms transfer better",
        verdict: Verdict::of_intervals(&grows),
        found: format!(
            "the interval of the difference in Hit@0.1 of all rooms over the fewest is above zero: {}",
            count_words(&grows, "feature sets")
        ),
    });

    claims.push(Claim {
        claim: "and without a plateau",
        verdict: Verdict::of_intervals(&keeps_growing),
        found: format!(
            "the interval of the difference in Hit@0.1 of all rooms over half of them is above zero: {}",
            count_words(&keeps_growing, "feature sets")
        ),
    });

    Ok(Found { section, record })
}

/// Adds three scaling curves: hit rates, the fraction of rooms with R² above 0, and the paper's
/// clipped mean.
fn add_curves(
    section: &mut Section,
    hits: Vec<Series>,
    fractions: Vec<Series>,
    means: Vec<Series>,
) -> Result<(), Error> {
    let plot = |title: &str, y: &str, series: Vec<Series>| {
        let title = title.to_owned();
        let x = "rooms learned from".to_owned();
        let y = y.to_owned();

        plotted(&Curves {
            title,
            x,
            y,
            series,
            diagonal: false,
        })
    };

    let caption = "Zero-shot Hit@0.1 of inverse Poincaré by how many rooms were learned from";
    section.picture(
        "scaling-hits.svg",
        plot("Zero-shot Hit@0.1", "mean over held-out rooms", hits)?,
        caption,
    );

    let caption = "Held-out rooms with R² above 0 by how many rooms were learned from";
    section.picture(
        "scaling-r2.svg",
        plot("Rooms with R² > 0", "share of held-out rooms", fractions)?,
        caption,
    );

    let caption = "Mean over held-out rooms of max(R², 0) by how many rooms were learned from";
    section.picture(
        "scaling-mean.svg",
        plot("R², negative ones as 0", "mean of max(R², 0)", means)?,
        caption,
    );

    Ok(())
}

/// One row per navigator: scores of one adapter in the held-out rooms.
fn zero_shot_rows(features: &str, run: &CrossRoomRun) -> Vec<Vec<String>> {
    let summary = MotionSummary::of(&run.r2(), 0);

    let names = [
        AFFINE,
        HOMOGENEOUS,
        "inverse-poincare-affine+row-space",
        "inverse-poincare-affine+whitened",
        REFIT,
        "ridge-refit-in-sample",
    ];

    let row = |name: &str| {
        // R² depends only on the adapter, so only the first row shows it.
        let [positive, clipped, clipped_at_zero] = match (name, &summary) {
            (AFFINE, Some(s)) => [
                rate_text(&s.positive),
                room_mean_text(&s.clipped),
                room_mean_text(&s.clipped_at_zero),
            ],
            _ => [const { String::new() }; 3],
        };

        let beats = wins(&run.outcomes, name)
            .as_ref()
            .map_or_else(String::new, rate_text);

        let hit = room_mean_text(&bootstrap_mean(&run.hit_rates(name), 0));
        vec![
            features.to_owned(),
            name.to_owned(),
            beats,
            hit,
            positive,
            clipped,
            clipped_at_zero,
        ]
    };

    names.map(row).to_vec()
}

/// The paper's counts of rooms in which a navigator beats Identity, as table rows.
fn paper_rows() -> Vec<Vec<String>> {
    let mut rows = Vec::new();
    for (encoder, zero, refit) in paper::CROSS_ROOM {
        for (what, count) in [("zero-shot", zero), ("ridge-refit", refit)] {
            let cells = [
                format!("paper: {encoder}"),
                what.to_owned(),
                count.to_owned(),
            ];

            // The paper has no hit rates and no R² for these rows: four cells stay empty.
            rows.push(
                cells
                    .into_iter()
                    .chain([const { String::new() }; 4])
                    .collect(),
            );
        }
    }

    rows
}

fn mean_hit(run: &CrossRoomRun, navigator: &str) -> f64 {
    mean(&run.hit_rates(navigator))
}

/// Formats a count of rooms with its percentage and Wilson's interval.
pub fn rate_text(rate: &Rate) -> String {
    format!(
        "{}/{} ({:.0} %, {:.2}–{:.2})",
        rate.successes(),
        rate.n,
        100.0 * rate.rate,
        rate.low,
        rate.high
    )
}
