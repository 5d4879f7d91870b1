//! Section: navigators and presets compared with the paper's, in held-out rooms.

use serde::Serialize;

use seese3_core::statistics::{RoomMean, bootstrap_mean, mean_of_known, paired_difference};

use super::Found;
use super::claims::{Case, Claim, without_control};
use super::cross::{AFFINE, HOMOGENEOUS};
use super::notes::published_name;
use super::plans::{MEMBERS, PlanKind, PlanResult, SetResults};
use crate::experiments::cross_room::{CrossRoomRun, MotionSummary, clipped_r2, or_worst};
use crate::report::Column::{self, Text};
use crate::report::{Section, Table, count_text, room_difference_text, room_mean_text};

const CALIBRATED: &str = "inverse-poincare-homogeneous+calibrated";

/// A plan compared with the paper's preset on all rooms: a row of the table and of the record.
/// Differences are paired by room.
#[derive(Debug, Serialize)]
pub struct BetterRecord {
    features: String,
    #[serde(serialize_with = "plan_name")]
    plan: PlanKind,
    /// The adapter's name in the store.
    adapter: String,
    navigator: &'static str,
    learned_rooms: usize,
    calibration_rooms: usize,
    hit: RoomMean,
    /// Hit rate minus that of the baseline's affine reading.
    over_affine: RoomMean,
    /// Hit rate minus that of the baseline's homogeneous reading.
    over_homogeneous: RoomMean,
    /// Clipped R² minus that of the baseline.
    clipped_r2_over_paper_range: RoomMean,
    #[serde(skip)]
    r2: Option<MotionSummary>,
}

fn plan_name<S: serde::Serializer>(plan: &PlanKind, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(plan.name())
}

/// Builds the section that compares other navigators and presets with the paper's.
pub fn section(results: &[SetResults], claims: &mut Vec<Claim>) -> Found<Vec<BetterRecord>> {
    // Compare only plans that use all rooms. Plans with calibration rooms train on fewer.
    let of_set = |set: &SetResults| {
        let baseline = &set.baseline().run;
        let plans = set.on_all_rooms.iter();
        plans
            .map(|result| compared(&set.features, result, baseline))
            .collect::<Vec<_>>()
    };
    let record: Vec<BetterRecord> = results.iter().flat_map(of_set).collect();

    let columns: [Column<BetterRecord>; 8] = [
        Text("features", |row| row.features.clone()),
        Text("adapter", |row| row.plan.name().to_owned()),
        Text("navigator", |row| row.navigator.to_owned()),
        Text("Hit@0.1 [95 %]", |row| room_mean_text(&row.hit)),
        Text("over affine [95 %]", |row| {
            room_difference_text(&row.over_affine)
        }),
        Text("over homogeneous [95 %]", |row| {
            room_difference_text(&row.over_homogeneous)
        }),
        Text("R² > 0", |row| {
            row.r2
                .map_or_else(String::new, |r2| count_text(&r2.positive, 2))
        }),
        Text("clipped R² over paper-range [95 %]", |row| {
            room_difference_text(&row.clipped_r2_over_paper_range)
        }),
    ];

    let mut section = Section::new("Better than the paper's navigator and recipe?");
    section.table(Table::of(&record, &columns));

    section.text(format!(
        "Every row had the same rooms: those with errors measured aside learn from fewer of them. All are compared, room \
         by room, with paper-range on all rooms and the paper's retrieval; an ensemble's {MEMBERS} members share one \
         adapter's epochs. No pose of a held-out room is used but to score."
    ));

    section.text(
        "The best of these rows by Hit@0.1 in every second held-out room, scored in the rooms between, which did not choose it:",
    );
    section.table(chosen_table(results));
    claims.extend(claims_of(without_control(results)));

    Found { section, record }
}

/// The best row of a feature set, chosen and scored in different rooms.
struct Chosen<'a> {
    plan: PlanKind,
    navigator: &'static str,
    /// Hit rates in the rooms that did not choose it.
    hits: Vec<f64>,
    set: &'a SetResults,
}

/// The rooms at odd places; those at even places choose.
fn scoring_rooms(values: &[f64]) -> Vec<f64> {
    values.iter().copied().skip(1).step_by(2).collect()
}

fn chosen(set: &SetResults) -> Option<Chosen<'_>> {
    let choosing = |result: &PlanResult| {
        let hits = result.run.hit_rates(navigator_of(&result.run));
        let even: Vec<f64> = hits.into_iter().step_by(2).collect();
        or_worst(mean_of_known(&even))
    };
    let best = set
        .on_all_rooms
        .iter()
        .max_by(|a, b| choosing(a).total_cmp(&choosing(b)))?;
    let navigator = navigator_of(&best.run);
    Some(Chosen {
        plan: best.plan.kind,
        navigator,
        hits: scoring_rooms(&best.run.hit_rates(navigator)),
        set,
    })
}

impl Chosen<'_> {
    /// The baseline's hit rates in the scoring rooms.
    fn baseline(&self, navigator: &str) -> Vec<f64> {
        scoring_rooms(&self.set.baseline().run.hit_rates(navigator))
    }
}

fn chosen_table(results: &[SetResults]) -> Table {
    let mut table = Table::new(
        "features | chosen adapter | navigator | rooms | Hit@0.1 [95 %] | Identity | over homogeneous of paper-range [95 %]",
    );
    for chosen in results.iter().filter_map(chosen) {
        let over = paired_difference(&chosen.hits, &chosen.baseline(HOMOGENEOUS), 0);
        let identity = mean_of_known(&chosen.baseline("identity"));
        let cells = [
            chosen.plan.name().to_owned(),
            chosen.navigator.to_owned(),
            chosen.hits.len().to_string(),
            room_mean_text(&bootstrap_mean(&chosen.hits, 0)),
            format!("{identity:.3}"),
            room_difference_text(&over),
        ];
        table.row(&chosen.set.features, cells);
    }
    table
}

fn claims_of(results: &[SetResults]) -> [Claim; 3] {
    let of_plan = |set: &SetResults, kind: PlanKind, case: &dyn Fn(&CrossRoomRun) -> Case| {
        let result = set
            .on_all_rooms
            .iter()
            .find(|result| result.plan.kind == kind);
        result.map(|result| case(&result.run))
    };
    let calibrated = results.iter().filter_map(|set| {
        of_plan(set, PlanKind::PaperRangeCalibrated, &|run| {
            let baseline = set.baseline().run.hit_rates(HOMOGENEOUS);
            Case::of_difference(&set.features, &run.hit_rates(CALIBRATED), &baseline)
        })
    });
    let steady = results.iter().filter_map(|set| {
        of_plan(set, PlanKind::Steady, &|run| {
            Case::of_difference(&set.features, &clipped(run), &clipped(&set.baseline().run))
        })
    });
    let best = results.iter().filter_map(chosen).map(|chosen| {
        let case = format!("{}: {}", chosen.set.features, chosen.plan.name());
        Case::of_difference(case, &chosen.hits, &chosen.baseline(HOMOGENEOUS))
    });

    [
        Claim::new(
            "ours: the calibrated navigator hits more often than inverse Poincaré in rooms never seen",
            "Hit@0.1 of the calibrated navigator minus that of the homogeneous one, adapters of one seed",
            calibrated.collect(),
        ),
        Claim::new(
            "ours: preset steady reads motion better than paper-range in rooms never seen",
            "max(R², −1) of steady minus that of paper-range, adapters of one seed",
            steady.collect(),
        ),
        Claim::new(
            "ours: the best of our rows, chosen in other rooms, hits more often than inverse Poincaré",
            "Hit@0.1 of the chosen row minus that of the homogeneous navigator of paper-range",
            best.collect(),
        ),
    ]
}

/// An adapter with calibration rooms is shown with the calibrated navigator.
fn navigator_of(run: &CrossRoomRun) -> &'static str {
    if run.calibration_rooms.is_empty() {
        HOMOGENEOUS
    } else {
        CALIBRATED
    }
}

fn compared(features: &str, result: &PlanResult, baseline: &CrossRoomRun) -> BetterRecord {
    let PlanResult { plan, run } = result;

    let navigator = navigator_of(run);

    // Both runs have the same rooms in the same order.
    let ours = run.hit_rates(navigator);
    let over = |name: &str| paired_difference(&ours, &baseline.hit_rates(name), 0);

    BetterRecord {
        features: features.to_owned(),
        plan: plan.kind,
        adapter: published_name(&plan.adapter_name(), features),
        navigator,
        learned_rooms: run.training_rooms.len(),
        calibration_rooms: run.calibration_rooms.len(),
        hit: bootstrap_mean(&ours, 0),
        over_affine: over(AFFINE),
        over_homogeneous: over(HOMOGENEOUS),
        clipped_r2_over_paper_range: paired_difference(&clipped(run), &clipped(baseline), 0),
        r2: MotionSummary::of(&run.r2(), 0),
    }
}

/// Overall R² per room, clipped from below: R² has no lower bound, so one room could dominate the
/// mean.
fn clipped(run: &CrossRoomRun) -> Vec<f64> {
    run.r2().into_iter().map(clipped_r2).collect()
}
