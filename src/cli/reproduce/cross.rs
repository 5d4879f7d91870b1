//! Rooms that were never seen: zero-shot against Identity, scaling, and what beats the paper's
//! navigator and recipe.

use std::sync::Arc;

use rayon::prelude::*;
use serde_json::{Value, json};

use super::super::rooms::lesson;
use super::claims::{Claim, Verdict};
use super::in_room::plotted;
use super::notes::{Learned, Notes, published_name};
use super::{Found, Loaded, Set, Setting};
use crate::adapter::{Mixing, Preset, Reading, TrainConfig};
use crate::eval::{NavigatorKind, Protocol};
use crate::generalisation::{
    CLIPPED_R2, MotionSummary, RoomMean, difference, nested_choice, outcomes, over_rooms, wins,
};
use crate::navigation::{Metric, Refit, StepKind};
use crate::pairs::Split;
use crate::report::{
    CrossRoomRun, Curves, Section, Series, cross_room_json, paper, room_difference_text,
    room_mean_json, room_mean_text,
};
use crate::training::{Lesson, Recipe, error_covariance, learn};

const AFFINE: &str = "inverse-poincare-affine";
const HOMOGENEOUS: &str = "inverse-poincare-homogeneous";
const CALIBRATED: &str = "inverse-poincare-homogeneous+calibrated";
/// The plan of preset steady on all rooms.
const STEADY: &str = "steady";
/// Members of an ensemble.
const MEMBERS: usize = 4;

/// The longest that a plan calls its adapter.
pub const LONGEST_NAME: &str = "ensemble-aside-of-100000";

/// One adapter in the held-out rooms.
#[derive(Clone)]
struct Plan {
    name: &'static str,
    /// What its adapter is called, before the number of rooms.
    short: &'static str,
    preset: Preset,
    size: usize,
    aside: usize,
    members: usize,
}

/// What a plan reached.
struct Reached {
    plan: Plan,
    run: CrossRoomRun,
}

impl Plan {
    /// What its adapter is called.
    fn adapter(&self) -> String {
        format!("{}-of-{}", self.short, self.size)
    }
}

pub fn sections(setting: &Setting, notes: &mut Notes) -> anyhow::Result<Vec<(String, Found)>> {
    let mut reached = Vec::new();
    for set in &setting.sets {
        let found: Vec<(Reached, Learned)> = plans(setting, set)
            .into_par_iter()
            .map(|plan| reach(setting, set, plan))
            .collect::<anyhow::Result<_>>()?;
        let (found, learned): (Vec<Reached>, Vec<Learned>) = found.into_iter().unzip();
        notes.adapters.extend(learned);

        reached.push((set.features.as_str(), found));
    }

    Ok(vec![
        (
            "cross_room".to_owned(),
            cross_room(setting, &reached, &mut notes.claims)?,
        ),
        ("better".to_owned(), better(&reached, &mut notes.claims)),
    ])
}

fn plans(setting: &Setting, set: &Set) -> Vec<Plan> {
    let all = set.train.len();
    let aside = setting.options.aside;

    let plan = |name, short, preset, size, aside, members| Plan {
        name,
        short,
        preset,
        size,
        aside,
        members,
    };

    let mut sizes = setting.options.sizes.clone();
    sizes.push(all);
    sizes.sort_unstable();
    sizes.dedup();

    // The largest first, so that they do not run alone at the end.
    let mut plans: Vec<Plan> = sizes
        .into_iter()
        .rev()
        .map(|size| plan("paper-range", "paper-range", Preset::PaperRange, size, 0, 1))
        .collect();

    plans.insert(
        1,
        plan(
            "paper-range, errors measured aside",
            "paper-range-aside",
            Preset::PaperRange,
            all,
            aside,
            1,
        ),
    );

    plans.insert(
        2,
        plan(
            "ensemble of paper-range, errors measured aside",
            "ensemble-aside",
            Preset::PaperRange,
            all,
            aside,
            MEMBERS,
        ),
    );

    plans.push(plan(STEADY, STEADY, Preset::Steady, all, 0, 1));

    plans.push(plan(
        "steady, errors measured aside",
        "steady-aside",
        Preset::Steady,
        all,
        aside,
        1,
    ));

    plans
}

fn reach(setting: &Setting, set: &Set, plan: Plan) -> anyhow::Result<(Reached, Learned)> {
    let chosen: Vec<&Loaded> = nested_choice(plan.size, set.train.len(), 0)
        .into_iter()
        .map(|room| &set.train[room])
        .collect();
    let (learned, aside) = chosen.split_at(chosen.len() - plan.aside);
    let learned: Vec<Lesson<'_>> = learned.iter().map(|room| lesson(room)).collect();

    let aside: Vec<Lesson<'_>> = aside.iter().map(|room| lesson(room)).collect();
    let plain = setting.recipe(plan.preset, Split::Whole, setting.options.stride, 0, None);
    let config = TrainConfig {
        charts: plan.members,
        mixing: Mixing::Even,
        ..plain.config.clone()
    };

    let recipe = Recipe { config, ..plain };
    let (mut adapter, mut record) = learn(&learned, &recipe, &mut |_| ())?;
    let step = |reading| StepKind::InversePoincare(reading);

    let refit = |in_sample| {
        StepKind::Refit(Refit {
            z_scored: false,
            intercept: false,
            in_sample,
        })
    };

    let full = |step| NavigatorKind::Step(step, Metric::Full);
    let mut navigators = vec![
        NavigatorKind::Identity,
        full(step(Reading::Affine)),
        full(step(Reading::Homogeneous)),
        full(refit(true)),
        NavigatorKind::Step(step(Reading::Affine), Metric::RowSpace),
        NavigatorKind::Step(step(Reading::Affine), Metric::Whitened),
    ];

    if !aside.is_empty() {
        let covariance = error_covariance(&adapter, &record, &aside)?;
        adapter = adapter.with_error_covariance(covariance)?;

        record.calibrated_on = aside
            .iter()
            .map(|lesson| (lesson.room.id().clone(), lesson.revision))
            .collect();

        navigators.push(NavigatorKind::Step(
            step(Reading::Homogeneous),
            Metric::Calibrated,
        ));
    }

    let published = Learned::new(&plan.adapter(), &set.train[0], adapter.clone(), record);

    let protocol = Protocol {
        split: Split::Whole,
        thresholds: vec![0.1],
        navigators,
        ..Protocol::paper(setting.options.stride)
    };

    let tests: Vec<Lesson<'_>> = set.test.iter().map(lesson).collect();
    let mut evaluated = Vec::new();
    let mut skipped = Vec::new();
    for outcome in outcomes(&Arc::new(adapter), &tests, &protocol, &|| ()) {
        match outcome {
            Ok(outcome) => evaluated.push(outcome),
            Err((room, why)) => skipped.push((room.to_string(), why.to_string())),
        }
    }

    let run = CrossRoomRun {
        learned: names(&learned),
        aside: names(&aside),
        seed: 0,
        outcomes: evaluated,
        skipped,
    };

    Ok((Reached { plan, run }, published))
}

/// The adapter of preset steady that learned from all rooms, without errors measured aside.
pub fn steady(set: &Set) -> String {
    format!("{STEADY}-of-{}", set.train.len())
}

fn names(lessons: &[Lesson<'_>]) -> Vec<String> {
    lessons
        .iter()
        .map(|lesson| lesson.room.id().to_string())
        .collect()
}

/// Zero-shot against Identity, and the scaling curves.
fn cross_room(
    setting: &Setting,
    reached: &[(&str, Vec<Reached>)],
    claims: &mut Vec<Claim>,
) -> anyhow::Result<Found> {
    let mut section =
        Section::new("Rooms never seen: zero-shot, and by how many rooms were learned from");

    let head = [
        "features",
        "navigator",
        "beats Identity in",
        "Hit@0.1 [95 %]",
        "R² > 0",
        "mean max(R², −1) [95 %]",
    ];

    let mut rows = vec![head.map(str::to_owned).to_vec()];
    let mut hits = Vec::new();
    let mut fractions = Vec::new();
    let mut record = Vec::new();

    let mut zero_shot = Vec::new();
    let mut refitted = Vec::new();
    let mut grows = Vec::new();
    for (features, found) in reached {
        let whole = &found[0].run;
        rows.extend(zero_shot_rows(features, whole));
        zero_shot.push(wins(&whole.outcomes, AFFINE).is_some_and(|rate| rate.low > 0.5));
        refitted.push(mean_of(whole, "ridge-refit-in-sample") > mean_of(whole, AFFINE));

        let mut curve: Vec<&Reached> = found
            .iter()
            .filter(|reached| reached.plan.name == "paper-range")
            .collect();
        curve.sort_by_key(|reached| reached.plan.size);

        let points = |of: &dyn Fn(&CrossRoomRun) -> f64| {
            curve
                .iter()
                .map(|reached| [reached.plan.size as f64, of(&reached.run)])
                .collect::<Vec<_>>()
        };
        let hit = points(&|run| mean_of(run, AFFINE));

        let fraction =
            points(&|run| MotionSummary::of(&run.r2(), 0).map_or(f64::NAN, |s| s.positive.rate));
        grows.push(hit.last().map(|p| p[1]) > hit.first().map(|p| p[1]));

        hits.push(Series {
            name: (*features).to_owned(),
            points: hit,
            joined: true,
        });

        fractions.push(Series {
            name: (*features).to_owned(),
            points: fraction,
            joined: true,
        });

        let adapters: Vec<String> = curve
            .iter()
            .map(|r| published_name(&r.plan.adapter(), features))
            .collect();

        let runs: Vec<CrossRoomRun> = curve.iter().map(|reached| reached.run.clone()).collect();
        record.push(json!({ "features": features, "adapters": adapters, "paper_range_by_size": cross_room_json(&runs, AFFINE) }));
    }

    rows.extend(paper_rows());
    section.table(rows);

    for (features, found) in reached {
        for (room, why) in &found[0].run.skipped {
            section.text(format!("Skipped with {features}: room {room}: {why}."));
        }
    }

    section.text(format!(
        "Preset paper-range on all rooms that are learned together, one seed; every pair of a held-out room at stride \
         {}, all its frames are candidates, the source included. Intervals of counts are Wilson's; of means, those of \
         drawing the rooms again. The refit is fitted on the very pairs it is scored on.",
        setting.options.stride
    ));

    add_curves(&mut section, hits, fractions)?;

    let count = |held: &[bool]| {
        format!(
            "so for {} of {} features",
            held.iter().filter(|&&h| h).count(),
            held.len()
        )
    };

    claims.push(Claim {
        claim: "zero-shot navigation beats Identity in most rooms never seen (Hit@0.1)",
        verdict: Verdict::of(&zero_shot),
        found: format!(
            "Wilson's interval of the share of rooms is above one half: {}",
            count(&zero_shot)
        ),
    });

    claims.push(Claim {
        claim: "refitting the linear step in the room itself does better than zero-shot",
        verdict: Verdict::of(&refitted),
        found: format!("mean Hit@0.1 is higher, in sample: {}", count(&refitted)),
    });

    claims.push(Claim {
        claim: "more training rooms transfer better, without a plateau",
        verdict: Verdict::of(&grows),
        found: format!(
            "Hit@0.1 with all rooms is above that with the fewest: {}",
            count(&grows)
        ),
    });

    Ok((section, Value::Array(record)))
}

/// The scaling curves, of hits and of the share of rooms with R² > 0.
fn add_curves(
    section: &mut Section,
    hits: Vec<Series>,
    fractions: Vec<Series>,
) -> anyhow::Result<()> {
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

    Ok(())
}

/// Navigators of one adapter in the held-out rooms.
fn zero_shot_rows(features: &str, run: &CrossRoomRun) -> Vec<Vec<String>> {
    let summary = MotionSummary::of(&run.r2(), 0);

    let names = [
        AFFINE,
        HOMOGENEOUS,
        "inverse-poincare-affine+row-space",
        "inverse-poincare-affine+whitened",
        "ridge-refit-in-sample",
    ];

    let row = |name: &str| {
        let [positive, clipped] = match (name, &summary) {
            (AFFINE, Some(s)) => [rate_text(&s.positive), room_mean_text(&s.clipped)],
            _ => [String::new(), String::new()],
        };

        let beats = wins(&run.outcomes, name)
            .as_ref()
            .map_or_else(String::new, rate_text);

        let hit = room_mean_text(&over_rooms(&run.hit_rates(name), 0));
        vec![
            features.to_owned(),
            name.to_owned(),
            beats,
            hit,
            positive,
            clipped,
        ]
    };

    names.map(row).to_vec()
}

/// The paper's counts.
fn paper_rows() -> Vec<Vec<String>> {
    let mut rows = Vec::new();
    for (encoder, zero, refit) in paper::CROSS_ROOM {
        for (what, count) in [("zero-shot", zero), ("ridge-refit", refit)] {
            let cells = [
                format!("paper: {encoder}"),
                what.to_owned(),
                count.to_owned(),
            ];

            rows.push(
                cells
                    .into_iter()
                    .chain([const { String::new() }; 3])
                    .collect(),
            );
        }
    }

    rows
}

/// What stands beside the paper's navigator and recipe.
fn better(reached: &[(&str, Vec<Reached>)], claims: &mut Vec<Claim>) -> Found {
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

    for (features, found) in reached {
        let baseline = &found[0].run;
        for Reached { plan, run } in found.iter().filter(|r| r.plan.size == found[0].plan.size) {
            let (row, value, [affine, homogeneous, r2]) = compared(features, plan, run, baseline);
            rows.push(row);
            record.push(value);

            if plan.name == "paper-range, errors measured aside" {
                navigator_wins.push(affine.low > 0.0 && homogeneous.low > 0.0);
            }
            if plan.name == STEADY {
                recipe_wins.push(r2.low > 0.0);
            }
        }
    }

    section.table(rows);

    section.text(format!(
        "Every row had the same rooms: those with errors measured aside learn from fewer of them. All are compared, room \
         by room, with paper-range on all rooms and the paper's retrieval; an ensemble's {MEMBERS} members share one \
         adapter's epochs. No pose of a held-out room is used but to score."
    ));

    let count = |held: &[bool]| {
        format!(
            "for {} of {} features",
            held.iter().filter(|&&h| h).count(),
            held.len()
        )
    };

    claims.push(Claim {
        claim: "ours: the calibrated navigator hits more often than inverse Poincaré in rooms never seen",
        verdict: Verdict::of(&navigator_wins),
        found: format!("both differences' intervals are above zero {}", count(&navigator_wins)),
    });

    claims.push(Claim {
        claim: "ours: preset steady reads motion better than paper-range in rooms never seen",
        verdict: Verdict::of(&recipe_wins),
        found: format!(
            "the interval of the difference of clipped R² is above zero {}",
            count(&recipe_wins)
        ),
    });

    (section, Value::Array(record))
}

/// A row of the table, its record, and the differences from the baseline: hits over its affine and
/// its homogeneous reading, clipped R².
fn compared(
    features: &str,
    plan: &Plan,
    run: &CrossRoomRun,
    baseline: &CrossRoomRun,
) -> (Vec<String>, Value, [RoomMean; 3]) {
    let name = if plan.aside > 0 {
        CALIBRATED
    } else {
        HOMOGENEOUS
    };
    let ours = run.hit_rates(name);
    let over = |theirs: &str| difference(&ours, &baseline.hit_rates(theirs), 0);

    let clipped = |run: &CrossRoomRun| {
        run.r2()
            .iter()
            .map(|r2| r2.max(CLIPPED_R2))
            .collect::<Vec<_>>()
    };
    let r2 = difference(&clipped(run), &clipped(baseline), 0);

    let positive =
        MotionSummary::of(&run.r2(), 0).map_or_else(String::new, |s| rate_text(&s.positive));
    let hit = over_rooms(&ours, 0);
    let affine = over(AFFINE);

    let homogeneous = over(HOMOGENEOUS);
    let row = vec![
        features.to_owned(),
        plan.name.to_owned(),
        name.to_owned(),
        room_mean_text(&hit),
        room_difference_text(&affine),
        room_difference_text(&homogeneous),
        positive,
        room_difference_text(&r2),
    ];

    let value = json!({
        "features": features,
        "plan": plan.name,
        "adapter": published_name(&plan.adapter(), features),
        "navigator": name,
        "learned_rooms": run.learned.len(),
        "calibration_rooms": run.aside.len(),
        "hit": room_mean_json(&hit),
        "over_affine": room_mean_json(&affine),
        "over_homogeneous": room_mean_json(&homogeneous),
        "clipped_r2_over_paper_range": room_mean_json(&r2),
    });

    (row, value, [affine, homogeneous, r2])
}

fn mean_of(run: &CrossRoomRun, navigator: &str) -> f64 {
    crate::scores::mean(&run.hit_rates(navigator))
}

fn rate_text(rate: &crate::scores::Rate) -> String {
    format!(
        "{}/{} ({:.0} %, {:.2}–{:.2})",
        rate.successes(),
        rate.n,
        100.0 * rate.rate,
        rate.low,
        rate.high
    )
}
