//! Section: navigators and presets compared with the paper's, in held-out rooms.

use serde::Serialize;

use seese3_core::statistics::{RoomMean, bootstrap_mean, paired_difference};

use super::Found;
use super::claims::{Claim, Verdict, count_words, is_above_zero};
use super::cross::{AFFINE, HOMOGENEOUS, rate_text};
use super::notes::published_name;
use super::plans::{MEMBERS, PlanKind, PlanResult, SetResults};
use crate::experiments::cross_room::{CLIPPED_R2, CrossRoomRun, MotionSummary};
use crate::report::{RoomMeanJson, Section, room_difference_text, room_mean_text};

const CALIBRATED: &str = "inverse-poincare-homogeneous+calibrated";

/// Builds the section that compares other navigators and presets with the paper's.
pub fn section(results: &[SetResults], claims: &mut Vec<Claim>) -> Found<Vec<BetterRecord>> {
    let mut section = Section::new("Better than the paper's navigator and recipe?");

    let head = [
        "features",
        "adapter",
        "navigator",
        "Hit@0.1 [95 %]",
        "over affine [95 %]",
        "over homogeneous [95 %]",
        "R² > 0",
        "clipped R² over paper-range [95 %]",
    ];

    let mut rows = vec![head.map(str::to_owned).to_vec()];
    let mut record = Vec::new();
    let mut navigator_wins = Vec::new();
    let mut recipe_wins = Vec::new();

    for set in results {
        let baseline = &set.baseline().run;

        // Compare only plans that use all rooms. Plans with calibration rooms train on fewer.
        for result in &set.on_all_rooms {
            let compared = compared(&set.features, result, baseline);
            rows.push(compared.row);
            record.push(compared.record);

            // Two rows decide the claims: the calibrated navigator and preset steady.
            match result.plan.kind {
                PlanKind::PaperRangeCalibrated => {
                    let over = [&compared.over_affine, &compared.over_homogeneous];
                    navigator_wins.push(all_of(over.map(is_above_zero)));
                }
                PlanKind::Steady => recipe_wins.push(is_above_zero(&compared.clipped_r2)),
                _ => {}
            }
        }
    }

    section.table(rows);

    section.text(format!(
        "Every row had the same rooms: those with errors measured aside learn from fewer of them. All are compared, room \
         by room, with paper-range on all rooms and the paper's retrieval; an ensemble's {MEMBERS} members share one \
         adapter's epochs. No pose of a held-out room is used but to score."
    ));

    claims.push(Claim {
        claim: "ours: the calibrated navigator hits more often than inverse Poincaré in rooms never seen",
        verdict: Verdict::of_intervals(&navigator_wins),
        found: format!(
            "both differences' intervals are above zero: {}",
            count_words(&navigator_wins, "feature sets")
        ),
    });

    claims.push(Claim {
        claim: "ours: preset steady reads motion better than paper-range in rooms never seen",
        verdict: Verdict::of_intervals(&recipe_wins),
        found: format!(
            "the interval of the difference of clipped R² is above zero: {}",
            count_words(&recipe_wins, "feature sets")
        ),
    });

    Found { section, record }
}

/// Whether both hold: false if one is false, else `None` if one is unknown.
fn all_of(both: [Option<bool>; 2]) -> Option<bool> {
    match both {
        [Some(true), Some(true)] => Some(true),
        [Some(false), _] | [_, Some(false)] => Some(false),
        _ => None,
    }
}

/// JSON record of a table row.
#[derive(Debug, Serialize)]
pub struct BetterRecord {
    features: String,
    plan: &'static str,
    /// The adapter's name in the store.
    adapter: String,
    navigator: &'static str,
    learned_rooms: usize,
    calibration_rooms: usize,
    hit: RoomMeanJson,
    over_affine: RoomMeanJson,
    over_homogeneous: RoomMeanJson,
    clipped_r2_over_paper_range: RoomMeanJson,
}

/// A plan compared with the baseline: its table row, its record, and three differences paired by
/// room.
struct Compared {
    row: Vec<String>,
    record: BetterRecord,
    /// Hit rate minus that of the baseline's affine reading.
    over_affine: RoomMean,
    /// Hit rate minus that of the baseline's homogeneous reading.
    over_homogeneous: RoomMean,
    /// Clipped R² minus that of the baseline.
    clipped_r2: RoomMean,
}

fn compared(features: &str, result: &PlanResult, baseline: &CrossRoomRun) -> Compared {
    let PlanResult { plan, run } = result;

    // An adapter with calibration rooms is shown with the calibrated navigator.
    let navigator = if run.calibration_rooms.is_empty() {
        HOMOGENEOUS
    } else {
        CALIBRATED
    };

    // Both runs have the same rooms in the same order.
    let ours = run.hit_rates(navigator);
    let hit = bootstrap_mean(&ours, 0);
    let over_affine = paired_difference(&ours, &baseline.hit_rates(AFFINE), 0);
    let over_homogeneous = paired_difference(&ours, &baseline.hit_rates(HOMOGENEOUS), 0);
    let clipped_r2 = paired_difference(&clipped(run), &clipped(baseline), 0);

    let positive =
        MotionSummary::of(&run.r2(), 0).map_or_else(String::new, |s| rate_text(&s.positive));
    let row = vec![
        features.to_owned(),
        plan.kind.name().to_owned(),
        navigator.to_owned(),
        room_mean_text(&hit),
        room_difference_text(&over_affine),
        room_difference_text(&over_homogeneous),
        positive,
        room_difference_text(&clipped_r2),
    ];

    let record = BetterRecord {
        features: features.to_owned(),
        plan: plan.kind.name(),
        adapter: published_name(&plan.adapter_name(), features),
        navigator,
        learned_rooms: run.training_rooms.len(),
        calibration_rooms: run.calibration_rooms.len(),
        hit: (&hit).into(),
        over_affine: (&over_affine).into(),
        over_homogeneous: (&over_homogeneous).into(),
        clipped_r2_over_paper_range: (&clipped_r2).into(),
    };

    Compared {
        row,
        record,
        over_affine,
        over_homogeneous,
        clipped_r2,
    }
}

/// Overall R² per room, clipped from below: R² has no lower bound, so one room could dominate the
/// mean.
fn clipped(run: &CrossRoomRun) -> Vec<f64> {
    run.r2().iter().map(|r2| r2.max(CLIPPED_R2)).collect()
}
