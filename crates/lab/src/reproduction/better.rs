//! Section: navigators and presets compared with the paper's, in held-out rooms.

use serde::Serialize;

use seese3_core::statistics::{RoomMean, bootstrap_mean, paired_difference};

use super::Found;
use super::claims::{Claim, holds_for_each, is_above_zero};
use super::cross::{AFFINE, HOMOGENEOUS};
use super::notes::published_name;
use super::plans::{MEMBERS, PlanKind, PlanResult, SetResults};
use crate::experiments::cross_room::{CLIPPED_R2, CrossRoomRun, MotionSummary};
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

    // Two plans decide the claims: the calibrated navigator and preset steady.
    let of_plan = |plan: PlanKind| record.iter().filter(move |row| row.plan == plan);
    let navigator_wins: Vec<Option<bool>> = of_plan(PlanKind::PaperRangeCalibrated)
        .map(|row| holds_for_each(&[&row.over_affine, &row.over_homogeneous].map(is_above_zero)))
        .collect();
    let recipe_wins: Vec<Option<bool>> = of_plan(PlanKind::Steady)
        .map(|row| is_above_zero(&row.clipped_r2_over_paper_range))
        .collect();

    claims.push(Claim::over_feature_sets(
        "ours: the calibrated navigator hits more often than inverse Poincaré in rooms never seen",
        "both differences' intervals are above zero",
        &navigator_wins,
    ));
    claims.push(Claim::over_feature_sets(
        "ours: preset steady reads motion better than paper-range in rooms never seen",
        "the interval of the difference of clipped R² is above zero",
        &recipe_wins,
    ));

    Found { section, record }
}

fn compared(features: &str, result: &PlanResult, baseline: &CrossRoomRun) -> BetterRecord {
    let PlanResult { plan, run } = result;

    // An adapter with calibration rooms is shown with the calibrated navigator.
    let navigator = if run.calibration_rooms.is_empty() {
        HOMOGENEOUS
    } else {
        CALIBRATED
    };

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
    run.r2().iter().map(|r2| r2.max(CLIPPED_R2)).collect()
}
