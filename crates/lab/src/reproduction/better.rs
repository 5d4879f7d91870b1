//! Section: navigators and presets compared with the paper's, in held-out rooms.

use serde::Serialize;

use seese3_core::statistics::{RoomMean, mean_of_known};

use super::Found;
use super::adapters::published_name;
use super::claims::{Case, Claim, differences, encoders_and_control, mean_over_trainings};
use super::cross::{AFFINE, HOMOGENEOUS};
use super::plans::{AdapterPlan, KindResults, MEMBERS, PlanKind, SetResults};
use crate::experiments::cross_room::{CrossRoomRun, RoomOutcome, clipped_r2, or_worst};
use crate::report::Column::{self, Text};
use crate::report::{Section, Table, room_difference_text, room_mean_text};

const CALIBRATED: &str = "inverse-poincare-homogeneous+calibrated";

/// A kind of adapter compared with the paper's preset on all rooms: a row of the table and of the
/// record. Differences are paired by training and room; the intervals have the spread of both.
#[derive(Debug, Serialize)]
pub struct BetterRecord {
    features: String,
    #[serde(serialize_with = "plan_name")]
    plan: PlanKind,
    /// The name in the store of the adapter with seed 0.
    adapter: String,
    navigator: &'static str,
    learned_rooms: usize,
    calibration_rooms: usize,
    trainings: usize,
    hit: RoomMean,
    /// Hit rate minus that of the baseline's affine reading.
    over_affine: RoomMean,
    /// Hit rate minus that of the baseline's homogeneous reading.
    over_homogeneous: RoomMean,
    /// max(R², −1).
    clipped_r2: RoomMean,
    /// The same minus that of the baseline.
    clipped_r2_over_paper_range: RoomMean,
    /// Share of trainings and rooms with R² above 0.
    positive_r2: f64,
}

fn plan_name<S: serde::Serializer>(plan: &PlanKind, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(plan.name())
}

/// Builds the section that compares other navigators and presets with the paper's.
pub fn section(results: &[SetResults]) -> Found<Vec<BetterRecord>> {
    // Compare only plans that use all rooms. Plans with calibration rooms train on fewer.
    let of_set = |set: &SetResults| {
        let kinds = set.on_all_rooms.iter();
        kinds
            .map(|results| compared(set, results))
            .collect::<Vec<_>>()
    };
    let record: Vec<BetterRecord> = results.iter().flat_map(of_set).collect();

    let columns: [Column<BetterRecord>; 10] = [
        Text("features", |row| row.features.clone()),
        Text("adapter", |row| row.plan.name().to_owned()),
        Text("navigator", |row| row.navigator.to_owned()),
        Text("trainings", |row| row.trainings.to_string()),
        Text("Hit@0.1 [95 %]", |row| room_mean_text(&row.hit)),
        Text("over affine [95 %]", |row| {
            room_difference_text(&row.over_affine)
        }),
        Text("over homogeneous [95 %]", |row| {
            room_difference_text(&row.over_homogeneous)
        }),
        Text("R² > 0", |row| format!("{:.0} %", 100.0 * row.positive_r2)),
        Text("max(R², −1) [95 %]", |row| {
            room_mean_text(&row.clipped_r2)
        }),
        Text("over paper-range [95 %]", |row| {
            room_difference_text(&row.clipped_r2_over_paper_range)
        }),
    ];

    let constants = results.iter().map(|set| {
        let outcomes = &set.baseline()[0].outcomes;
        let constant = |room: &RoomOutcome| clipped_r2(room.baselines.constant_r2);
        let mean = mean_of_known(&outcomes.iter().map(constant).collect::<Vec<f64>>());
        format!("{mean:.3} ({})", set.features)
    });
    let constants: Vec<String> = constants.collect();

    let mut section = Section::new("Better than the paper's navigator and recipe?");
    section.table(Table::of(&record, &columns));

    section.text(format!(
        "Every plan has the same training rooms; calibrated plans use some of them for calibration. Rows are compared with \
         paper-range, paired by training and room; intervals have the spread of both. An ensemble's {MEMBERS} members share \
         one adapter's epochs. Poses of held-out rooms are used for scoring only. max(R², −1) of the mean training motion: {}.",
        constants.join("; ")
    ));

    section.text(
        "The best of our rows (all but paper-range) by Hit@0.1 in the held-out rooms at even places, scored in the others:",
    );
    section.table(chosen_table(results));

    Found {
        section,
        record,
        claims: claims_of(encoders_and_control(results).0).into(),
    }
}

/// The best row of a feature set, chosen and scored in different rooms.
struct Chosen<'a> {
    kind: PlanKind,
    navigator: &'static str,
    /// Hit rates by training in the rooms that did not choose it.
    hits: Vec<Vec<f64>>,
    set: &'a SetResults,
}

/// The rooms at odd places; those at even places choose.
fn scoring_rooms(by_training: &[Vec<f64>]) -> Vec<Vec<f64>> {
    every_second(by_training, 1)
}

fn every_second(by_training: &[Vec<f64>], first: usize) -> Vec<Vec<f64>> {
    let rooms = |values: &Vec<f64>| values.iter().copied().skip(first).step_by(2).collect();
    by_training.iter().map(rooms).collect()
}

fn chosen(set: &SetResults) -> Option<Chosen<'_>> {
    // The rooms at even places choose.
    let choosing = |results: &KindResults| {
        let hits = hit_rates(&results.runs, navigator_of(results));
        or_worst(mean_of_known(&every_second(&hits, 0).concat()))
    };

    // The baseline is no row of ours.
    let ours = set.on_all_rooms.iter();
    let best = ours
        .filter(|results| results.kind != PlanKind::PaperRange)
        .max_by(|a, b| choosing(a).total_cmp(&choosing(b)))?;

    let navigator = navigator_of(best);
    Some(Chosen {
        kind: best.kind,
        navigator,
        hits: scoring_rooms(&hit_rates(&best.runs, navigator)),
        set,
    })
}

impl Chosen<'_> {
    /// The baseline's hit rates in the scoring rooms.
    fn baseline(&self, navigator: &str) -> Vec<Vec<f64>> {
        scoring_rooms(&hit_rates(self.set.baseline(), navigator))
    }
}

fn chosen_table(results: &[SetResults]) -> Table {
    let mut table = Table::new(
        "features | chosen adapter | navigator | rooms | Hit@0.1 [95 %] | Identity | over homogeneous of paper-range [95 %]",
    );
    for chosen in results.iter().filter_map(chosen) {
        let over = differences(&chosen.hits, &chosen.baseline(HOMOGENEOUS));
        let identity = mean_of_known(&chosen.baseline("identity").concat());
        let cells = [
            chosen.kind.name().to_owned(),
            chosen.navigator.to_owned(),
            chosen.hits.first().map_or(0, Vec::len).to_string(),
            room_mean_text(&mean_over_trainings(&chosen.hits)),
            format!("{identity:.3}"),
            room_difference_text(&mean_over_trainings(&over)),
        ];
        table.row(&chosen.set.features, cells);
    }
    table
}

fn claims_of(results: &[SetResults]) -> [Claim; 3] {
    let of_kind = |kind: PlanKind, case: &dyn Fn(&SetResults, &KindResults) -> Case| -> Vec<Case> {
        let case = |set: &SetResults| {
            let mut kinds = set.on_all_rooms.iter();
            let results = kinds.find(|results| results.kind == kind)?;
            Some(case(set, results))
        };
        results.iter().filter_map(case).collect()
    };

    let calibrated = of_kind(PlanKind::PaperRangeCalibrated, &|set, results| {
        let baseline = hit_rates(set.baseline(), HOMOGENEOUS);
        Case::of_paired_trainings(
            &set.features,
            &hit_rates(&results.runs, CALIBRATED),
            &baseline,
        )
    });

    let steady = of_kind(PlanKind::Steady, &|set, results| {
        Case::of_paired_trainings(
            &set.features,
            &clipped(&results.runs),
            &clipped(set.baseline()),
        )
    });

    let best = results.iter().filter_map(chosen).map(|chosen| {
        let case = format!("{}: {}", chosen.set.features, chosen.kind.name());
        Case::of_paired_trainings(case, &chosen.hits, &chosen.baseline(HOMOGENEOUS))
    });

    [
        Claim::new(
            "ours: the calibrated navigator hits more often than homogeneous inverse Poincaré in held-out rooms",
            "Hit@0.1 of the calibrated navigator minus that of the homogeneous one",
            calibrated,
        ),
        Claim::new(
            "ours: preset steady estimates motion better than paper-range in held-out rooms",
            "max(R², −1) of steady minus that of paper-range",
            steady,
        ),
        Claim::new(
            "ours: the best of our rows, chosen in other rooms, hits more often than homogeneous inverse Poincaré",
            "Hit@0.1 of the chosen row minus that of the homogeneous navigator of paper-range",
            best.collect(),
        ),
    ]
}

/// An adapter with calibration rooms is shown with the calibrated navigator.
fn navigator_of(results: &KindResults) -> &'static str {
    if results.kind.is_calibrated() {
        CALIBRATED
    } else {
        HOMOGENEOUS
    }
}

fn compared(set: &SetResults, results: &KindResults) -> BetterRecord {
    let KindResults { kind, runs } = results;
    let navigator = navigator_of(results);

    // All runs have the same rooms in the same order.
    let ours = hit_rates(runs, navigator);
    let over = |name: &str| {
        let theirs = hit_rates(set.baseline(), name);
        mean_over_trainings(&differences(&ours, &theirs))
    };

    let r2 = clipped(runs);
    let over_baseline = differences(&r2, &clipped(set.baseline()));
    let is_positive: Vec<f64> = r2
        .concat()
        .into_iter()
        .filter(|r2| !r2.is_nan())
        .map(|r2| f64::from(u8::from(r2 > 0.0)))
        .collect();

    // All trainings have as many rooms for training and for calibration.
    let first = &runs[0];
    let plan = AdapterPlan {
        kind: *kind,
        rooms: first.training_rooms.len() + first.calibration_rooms.len(),
        seed: 0,
    };

    BetterRecord {
        features: set.features.clone(),
        plan: *kind,
        adapter: published_name(&plan.adapter_name(), &set.features),
        navigator,
        learned_rooms: first.training_rooms.len(),
        calibration_rooms: first.calibration_rooms.len(),
        trainings: runs.len(),
        hit: mean_over_trainings(&ours),
        over_affine: over(AFFINE),
        over_homogeneous: over(HOMOGENEOUS),
        clipped_r2: mean_over_trainings(&r2),
        clipped_r2_over_paper_range: mean_over_trainings(&over_baseline),
        positive_r2: mean_of_known(&is_positive),
    }
}

/// Hit rates of a navigator, by training and room.
fn hit_rates(runs: &[CrossRoomRun], navigator: &str) -> Vec<Vec<f64>> {
    runs.iter().map(|run| run.hit_rates(navigator)).collect()
}

/// Overall R² by training and room, clipped from below: R² has no lower bound, so one room could
/// dominate the mean.
fn clipped(runs: &[CrossRoomRun]) -> Vec<Vec<f64>> {
    let of_run = |run: &CrossRoomRun| run.r2().into_iter().map(clipped_r2).collect();
    runs.iter().map(of_run).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: the rooms that choose are not those that score.
    #[test]
    fn rooms_choose_or_score() {
        let by_training = [vec![1.0, 2.0, 3.0, 4.0, 5.0], vec![6.0, 7.0, 8.0, 9.0, 0.0]];
        assert_eq!(scoring_rooms(&by_training), [[2.0, 4.0], [7.0, 9.0]]);
        assert_eq!(
            every_second(&by_training, 0),
            [[1.0, 3.0, 5.0], [6.0, 8.0, 0.0]]
        );
    }
}
