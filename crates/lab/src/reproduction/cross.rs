//! Section: held-out rooms. Zero-shot navigation compared with Identity, and scaling with the
//! number of training rooms.

use serde::Serialize;

use seese3_core::navigation::NavigatorKind;
use seese3_core::statistics::{bootstrap_mean, mean_of_known, paired_difference};

use super::adapters::published_name;
use super::claims::{Case, Claim, encoders_and_control};
use super::plans::{AdapterPlan, PlanKind, SetResults, SizeResults};
use super::{Error, Found, Reproduction, paper};
use crate::experiments::cross_room::{CrossRoomRun, MotionSummary, RoomOutcome, wins};
use crate::report::{
    CrossRoomJson, Figure, Section, Series, Table, count_text, cross_room_json,
    room_difference_text, room_mean_text, spread_text,
};

/// The paper's navigator.
pub const AFFINE: &str = "inverse-poincare-affine";
/// The refit on z-scored motions. The ridge's α would over-shrink raw meters and radians.
const REFIT: &str = "ridge-refit-z-scored-in-sample";
/// The same, fitted on other frames than those that are scored.
const REFIT_OF_FIRST_VISIT: &str = "ridge-refit-z-scored";
/// The service's navigator.
pub const HOMOGENEOUS: &str = "inverse-poincare-homogeneous";

/// JSON record of the results with one feature set.
#[derive(Debug, Serialize)]
pub struct ZeroShotRecord {
    features: String,
    /// The adapters' names in the store, by increasing number of training rooms.
    adapters: Vec<String>,
    /// Runs by increasing number of rooms, then by seed.
    paper_range_by_size: CrossRoomJson,
    /// The adapter of all rooms, seed 0, in later visits of the held-out rooms.
    second_visits: CrossRoomJson,
}

/// Builds the section on zero-shot navigation and on scaling.
pub fn section(
    given: &Reproduction<'_>,
    results: &[SetResults],
) -> Result<Found<Vec<ZeroShotRecord>>, Error> {
    let mut section =
        Section::new("Held-out rooms: zero-shot, and by the number of training rooms");
    section.table(table(results));

    for set in results {
        for skipped in &set.skipped {
            let (features, room, why) = (&set.features, &skipped.room, &skipped.why);
            section.text(format!("Skipped with {features}: room {room}: {why}."));
        }
    }

    section.text(format!(
        "Preset paper-range on all training rooms, seed 0; every pair of a held-out room at stride {}, all its frames are \
         candidates, the source included. Intervals of counts are Wilson's, those of means are bootstrapped over rooms. \
         In-sample refits overfit, most in short recordings. The next table scores refits out of sample, in later visits:",
        given.options.stride
    ));
    section.table(second_visits_table(results));
    section.text(
        "Held-out rooms with several visits: pairs and candidates are of the later ones, the refit is fitted on the first.",
    );

    section.table(scaling_table(results));
    section.text(format!(
        "Preset paper-range by the number of training rooms, {} trainings each with another choice of rooms and another \
         seed: mean over held-out rooms and trainings ± standard deviation over trainings.",
        given.options.trainings
    ));
    add_curves(&mut section, results)?;

    Ok(Found {
        section,
        record: results.iter().map(record).collect(),
        claims: claims_of(encoders_and_control(results).0),
    })
}

fn record(set: &SetResults) -> ZeroShotRecord {
    let runs = set
        .by_size
        .iter()
        .flat_map(|size| size.runs.iter().cloned());
    let runs: Vec<CrossRoomRun> = runs.collect();
    let name = |size: &SizeResults| {
        let plan = AdapterPlan {
            kind: PlanKind::PaperRange,
            rooms: size.rooms,
            seed: 0,
        };
        published_name(&plan.adapter_name(), &set.features)
    };

    ZeroShotRecord {
        features: set.features.clone(),
        adapters: set.by_size.iter().map(name).collect(),
        paper_range_by_size: cross_room_json(&runs, AFFINE),
        second_visits: cross_room_json(std::slice::from_ref(&set.second_visits), AFFINE),
    }
}

/// A measure of one held-out room by which transfer is judged.
struct Measure {
    name: &'static str,
    of: fn(&RoomOutcome) -> f64,
}

/// Ours, then the two of the paper's scaling figure.
const MEASURES: [Measure; 3] = [
    Measure {
        name: "Hit@0.1",
        of: |outcome| outcome.hit_rate(AFFINE).map_or(f64::NAN, |rate| rate.rate),
    },
    Measure {
        name: "share of rooms with R² > 0",
        of: |outcome| match outcome.motion.overall {
            r2 if r2.is_nan() => r2,
            r2 => f64::from(u8::from(r2 > 0.0)),
        },
    },
    Measure {
        name: "mean max(R², 0)",
        of: |outcome| outcome.motion.overall.clamp(0.0, f64::INFINITY),
    },
];

fn claims_of(results: &[SetResults]) -> Vec<Claim> {
    let per_set = |case: &dyn Fn(&SetResults) -> Case| results.iter().map(case).collect();
    let refit = |run: &CrossRoomRun, features: &str, refit: &str| {
        Case::of_difference(features, &run.hit_rates(refit), &run.hit_rates(AFFINE))
    };

    vec![
        Claim::new(
            "zero-shot navigation beats Identity in most held-out rooms (Hit@0.1)",
            "½ in a room with more hits than Identity, −½ in the others",
            per_set(&|set| {
                let run = set.first_baseline();
                let pairs = run.hit_rates(AFFINE).into_iter();
                let pairs = pairs.zip(run.hit_rates(&NavigatorKind::Identity.name()));
                let won = pairs.map(|(ours, identity)| if ours > identity { 0.5 } else { -0.5 });
                Case::of_rooms(&set.features, &won.collect::<Vec<f64>>())
            }),
        ),
        Claim::new(
            "a refit of the linear step on the scored pairs of the room hits more often than zero-shot",
            "Hit@0.1 of the z-scored refit in sample minus zero-shot",
            per_set(&|set| refit(set.first_baseline(), &set.features, REFIT)),
        ),
        Claim::new(
            "a refit on the first visit hits more often than zero-shot in later visits",
            "Hit@0.1 in later visits of the z-scored refit of the first visit minus zero-shot",
            per_set(&|set| refit(&set.second_visits, &set.features, REFIT_OF_FIRST_VISIT)),
        ),
        Claim::new(
            "more training rooms transfer better",
            "with all rooms minus with the fewest",
            growth(results, |sizes| sizes.first()),
        ),
        Claim::new(
            "transfer still improves from half of the training rooms to all",
            "with all rooms minus with the largest size of at most half of them",
            growth(results, |sizes| {
                // On a plateau, the second half of the rooms would add nothing. The fewest rooms are
                // the claim before.
                let all = sizes.last()?.rooms;
                let mut later = sizes.iter().skip(1);
                later.rfind(|size| 2 * size.rooms <= all)
            }),
        ),
    ]
}

/// For each feature set and measure, the difference of all rooms over the size that `fewer`
/// chooses, by training and room. Trainings are paired by seed: with one seed, fewer rooms are a
/// part of more rooms.
fn growth(results: &[SetResults], fewer: fn(&[SizeResults]) -> Option<&SizeResults>) -> Vec<Case> {
    let mut cases = Vec::new();
    for set in results {
        let (Some(all), Some(fewer)) = (set.by_size.last(), fewer(&set.by_size)) else {
            continue;
        };
        if fewer.rooms == all.rooms {
            continue;
        }
        for measure in &MEASURES {
            let runs = all.runs.iter().zip(&fewer.runs);
            let by_training: Vec<Vec<f64>> = runs
                .map(|(all, fewer)| {
                    let rooms = all.outcomes.iter().zip(&fewer.outcomes);
                    rooms
                        .map(|(all, fewer)| (measure.of)(all) - (measure.of)(fewer))
                        .collect()
                })
                .collect();
            let case = format!(
                "{}, {}, {} over {} rooms",
                set.features, measure.name, all.rooms, fewer.rooms
            );
            cases.push(Case::of_trainings(case, &by_training));
        }
    }
    cases
}

/// The mean of a measure over the held-out rooms, for each training.
fn means_by_training(size: &SizeResults, measure: &Measure) -> Vec<f64> {
    let of_run = |run: &CrossRoomRun| {
        let rooms: Vec<f64> = run.outcomes.iter().map(measure.of).collect();
        mean_of_known(&rooms)
    };
    size.runs.iter().map(of_run).collect()
}

fn scaling_table(results: &[SetResults]) -> Table {
    let names = MEASURES.map(|measure| measure.name).join(" | ");
    let mut table = Table::new(&format!("features | training rooms | trainings | {names}"));
    for set in results {
        for size in &set.by_size {
            let counts = [size.rooms.to_string(), size.runs.len().to_string()];
            let measures = MEASURES
                .iter()
                .map(|measure| spread_text(&means_by_training(size, measure), 3));
            table.row(&set.features, counts.into_iter().chain(measures));
        }
    }
    table
}

fn second_visits_table(results: &[SetResults]) -> Table {
    let mut table = Table::new(
        "features | navigator | rooms | Hit@0.1 in later visits [95 %] | over zero-shot [95 %]",
    );
    for set in results {
        let run = &set.second_visits;
        let zero_shot = run.hit_rates(AFFINE);
        if zero_shot.is_empty() {
            continue;
        }
        for name in ["identity", AFFINE, REFIT_OF_FIRST_VISIT] {
            let hits = run.hit_rates(name);
            let over = paired_difference(&hits, &zero_shot, 0);
            let cells = [
                name.to_owned(),
                hits.len().to_string(),
                room_mean_text(&bootstrap_mean(&hits, 0)),
                room_difference_text(&over),
            ];
            table.row(&set.features, cells);
        }
    }
    table
}

/// Files and captions of the scaling curves, one per measure.
const CURVES: [(&str, &str); 3] = [
    ("scaling-hits.svg", "Zero-shot Hit@0.1 of inverse Poincaré"),
    ("scaling-r2.svg", "Share of held-out rooms with R² above 0"),
    ("scaling-mean.svg", "Mean over held-out rooms of max(R², 0)"),
];

fn add_curves(section: &mut Section, results: &[SetResults]) -> Result<(), Error> {
    for ((file, caption), measure) in CURVES.iter().zip(&MEASURES) {
        let line = |set: &SetResults| {
            let sizes = set.by_size.iter();
            let points = sizes.map(|size| {
                let value = mean_of_known(&means_by_training(size, measure));
                [size.rooms as f64, value]
            });
            Series::line(&set.features, points.collect())
        };
        let lines = results.iter().map(line).collect();
        let figure = Figure::new(*caption, "training rooms", measure.name, lines);
        let caption = format!("{caption} by the number of training rooms");
        section.picture(*file, figure.svg()?, caption);
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
        let run = set.first_baseline();
        for name in [
            "identity",
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

            let beats = wins(&run.outcomes, name).filter(|_| name != "identity");
            let beats = beats.map(|rate| count_text(&rate, 2));
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
