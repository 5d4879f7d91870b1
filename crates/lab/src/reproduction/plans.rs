//! The adapters of the cross-room sections: training plans, numbers of rooms, and results in the
//! held-out rooms.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde_json::json;

use seese3_core::adapter::{Mixing, Preset, Reading};
use seese3_core::eval::Protocol;
use seese3_core::navigation::{NavigatorKind, Refit, RetrievalMetric, StepKind};
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan};

use super::adapters::{Adapters, ReproducedAdapter};
use super::{Error, FeatureSet, Reproduction};
use crate::experiments::cross_room::{
    CrossRoomPlan, CrossRoomProgress, CrossRoomRun, RoomOutcome, Skipped, nested_choice,
    test_trained, train_and_calibrate,
};

/// Number of adapters in an ensemble.
pub const MEMBERS: usize = 4;

/// An upper bound on the length of plan names, for checking names before training.
pub const LONGEST_NAME: &str = "paper-range-calibrated-of-100000";

/// The kinds of adapters in the cross-room sections, in the order of their table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum PlanKind {
    /// The paper's preset.
    PaperRange,
    /// The paper's preset with some of the rooms as calibration rooms.
    PaperRangeCalibrated,
    /// [`MEMBERS`] adapters of the paper's preset, with calibration rooms.
    EnsembleCalibrated,
    /// Preset steady.
    Steady,
    /// Preset steady with calibration rooms.
    SteadyCalibrated,
}

impl PlanKind {
    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::PaperRange => "paper-range",
            Self::PaperRangeCalibrated => "paper-range, calibrated",
            Self::EnsembleCalibrated => "ensemble of paper-range, calibrated",
            Self::Steady => "steady",
            Self::SteadyCalibrated => "steady, calibrated",
        }
    }

    /// The first part of the adapter's name; the number of rooms follows.
    fn short_name(self) -> &'static str {
        match self {
            Self::PaperRange => "paper-range",
            Self::PaperRangeCalibrated => "paper-range-calibrated",
            Self::EnsembleCalibrated => "ensemble-calibrated",
            Self::Steady => "steady",
            Self::SteadyCalibrated => "steady-calibrated",
        }
    }

    fn preset(self) -> Preset {
        match self {
            Self::PaperRange | Self::PaperRangeCalibrated | Self::EnsembleCalibrated => {
                Preset::PaperRange
            }
            Self::Steady | Self::SteadyCalibrated => Preset::Steady,
        }
    }

    fn members(self) -> usize {
        match self {
            Self::EnsembleCalibrated => MEMBERS,
            _ => 1,
        }
    }

    /// Whether some of its rooms are calibration rooms.
    pub fn is_calibrated(self) -> bool {
        match self {
            Self::PaperRangeCalibrated | Self::EnsembleCalibrated | Self::SteadyCalibrated => true,
            Self::PaperRange | Self::Steady => false,
        }
    }
}

/// One adapter to train and to evaluate in the held-out rooms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AdapterPlan {
    /// The kind of adapter.
    pub kind: PlanKind,
    /// Number of rooms, including calibration rooms.
    pub rooms: usize,
    /// Seed of the choice of the rooms and of the training.
    pub seed: u64,
}

impl AdapterPlan {
    /// The adapter's name, for use with [`super::published_name`].
    pub fn adapter_name(&self) -> String {
        format!("{}-of-{}", self.kind.short_name(), self.rooms)
    }
}

/// A plan and the results of its adapter in the held-out rooms.
struct PlanResult {
    plan: AdapterPlan,
    run: CrossRoomRun,
}

/// Several trainings of one kind of adapter on all rooms.
pub struct KindResults {
    /// The kind.
    pub kind: PlanKind,
    /// One run per seed, from 0.
    pub runs: Vec<CrossRoomRun>,
}

/// Several trainings of the paper's preset on one number of rooms.
pub struct SizeResults {
    /// The number of rooms.
    pub rooms: usize,
    /// One run per seed, from 0.
    pub runs: Vec<CrossRoomRun>,
}

/// The results of all plans with one feature set.
pub struct SetResults {
    /// The name of the features.
    pub features: String,
    /// Results on all rooms, the paper's preset first.
    pub on_all_rooms: Vec<KindResults>,
    /// Results of the paper's preset, by increasing number of rooms.
    pub by_size: Vec<SizeResults>,
    /// Held-out rooms that some adapter could not be evaluated in. No run has results of them.
    pub skipped: Vec<Skipped>,
    /// Results of the paper's preset on all rooms, in the second visits of the held-out rooms that
    /// have several; refits there are fitted on the first visit.
    pub second_visits: CrossRoomRun,
}

impl SetResults {
    /// The baseline of all comparisons: the paper's preset on all rooms, by seed.
    pub fn baseline(&self) -> &[CrossRoomRun] {
        &self.on_all_rooms[0].runs
    }

    /// The paper's preset on all rooms, seed 0.
    pub fn first_baseline(&self) -> &CrossRoomRun {
        &self.baseline()[0]
    }
}

/// The name of the adapter of preset steady on all rooms, without calibration rooms.
pub fn steady_adapter(set: &FeatureSet<'_>) -> String {
    let plan = AdapterPlan {
        kind: PlanKind::Steady,
        rooms: set.train.len(),
        seed: 0,
    };
    plan.adapter_name()
}

/// Trains the adapters of every plan and feature set, and evaluates them in the held-out rooms.
pub fn evaluate(
    given: &Reproduction<'_>,
    adapters: &mut Adapters,
) -> Result<Vec<SetResults>, Error> {
    given
        .sets
        .iter()
        .map(|set| evaluate_set(given, set, adapters))
        .collect()
}

fn evaluate_set(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
    adapters: &mut Adapters,
) -> Result<SetResults, Error> {
    let mut results: Vec<(PlanResult, ReproducedAdapter)> = plans(given, set)
        .into_par_iter()
        .map(|plan| result_of(given, set, plan))
        .collect::<Result<_, Error>>()?;
    let skipped = skip_in_all(results.iter_mut().map(|(result, _)| &mut result.run));

    let is_baseline = |plan: &AdapterPlan| {
        plan.kind == PlanKind::PaperRange && plan.rooms == set.train.len() && plan.seed == 0
    };
    let baseline = results.iter().find(|(result, _)| is_baseline(&result.plan));
    let Some((_, baseline)) = baseline else {
        return Err(Error::Input("there is no room to train on".to_owned()));
    };
    let second_visits = in_second_visits(given, set, baseline)?;

    let mut by_size: BTreeMap<usize, Vec<CrossRoomRun>> = BTreeMap::new();
    let mut by_kind: BTreeMap<PlanKind, Vec<CrossRoomRun>> = BTreeMap::new();
    for (PlanResult { plan, run }, adapter) in results {
        // The other seeds show the spread of a training; their adapters are not published.
        if plan.seed == 0 {
            adapters.0.push(adapter);
        }
        if plan.rooms == set.train.len() {
            by_kind.entry(plan.kind).or_default().push(run.clone());
        }
        if plan.kind == PlanKind::PaperRange {
            by_size.entry(plan.rooms).or_default().push(run);
        }
    }

    let by_seed = |mut runs: Vec<CrossRoomRun>| {
        runs.sort_by_key(|run| run.seed);
        runs
    };
    Ok(SetResults {
        features: set.features.clone(),
        on_all_rooms: by_kind
            .into_iter()
            .map(|(kind, runs)| KindResults {
                kind,
                runs: by_seed(runs),
            })
            .collect(),
        by_size: by_size
            .into_iter()
            .map(|(rooms, runs)| SizeResults {
                rooms,
                runs: by_seed(runs),
            })
            .collect(),
        skipped,
        second_visits,
    })
}

/// Removes the rooms that one run skipped from all runs, so that runs can be paired room by room.
/// Returns these rooms, each once.
fn skip_in_all<'a>(runs: impl Iterator<Item = &'a mut CrossRoomRun>) -> Vec<Skipped> {
    let runs: Vec<&mut CrossRoomRun> = runs.collect();
    let mut skipped: Vec<Skipped> = Vec::new();
    for room in runs.iter().flat_map(|run| &run.skipped) {
        if skipped.iter().all(|other| other.room != room.room) {
            skipped.push(room.clone());
        }
    }

    for run in runs {
        let is_kept = |outcome: &RoomOutcome| {
            let room = outcome.room.as_str();
            skipped.iter().all(|other| other.room.as_str() != room)
        };
        run.outcomes.retain(is_kept);
    }
    skipped
}

/// All plans, longest training first, so that no long training runs alone at the end.
fn plans(given: &Reproduction<'_>, set: &FeatureSet<'_>) -> Vec<AdapterPlan> {
    let all = set.train.len();
    let trainings = |kind, rooms| {
        let seeds = 0..given.options.trainings;
        seeds.map(move |seed| AdapterPlan { kind, rooms, seed })
    };
    let mut plans = Vec::new();
    plans.extend(trainings(PlanKind::PaperRangeCalibrated, all));
    plans.extend(trainings(PlanKind::EnsembleCalibrated, all));

    // The scaling curve of the paper's preset. All rooms are its last point, listed or not.
    let mut sizes = given.options.sizes.clone();
    sizes.push(all);
    sizes.sort_unstable();
    sizes.dedup();
    for rooms in sizes.into_iter().rev() {
        plans.extend(trainings(PlanKind::PaperRange, rooms));
    }

    // Preset steady needs only a fraction of the steps.
    plans.extend(trainings(PlanKind::Steady, all));
    plans.extend(trainings(PlanKind::SteadyCalibrated, all));
    plans
}

fn result_of(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
    plan: AdapterPlan,
) -> Result<(PlanResult, ReproducedAdapter), Error> {
    let rooms: Vec<RoomData<'_>> = nested_choice(plan.rooms, set.train.len(), plan.seed)
        .into_iter()
        .map(|room| set.train[room])
        .collect();
    let calibration_rooms = if plan.kind.is_calibrated() {
        given.options.calibration_rooms
    } else {
        0
    };

    // Test on the whole held-out rooms: every pair at the stride, every frame as a candidate.
    let protocol = Protocol {
        split: Split::Whole,
        thresholds: vec![0.1],
        navigators: navigators(&plan),
        ..Protocol::paper(given.options.stride)
    };

    let training = training_plan(given, plan);
    let training = CrossRoomPlan {
        training: &training,
        relational: None,
        calibration_rooms,
        protocol: &protocol,
    };

    let options = json!({
        "training": format!("{:?}", training.training),
        "calibration_rooms": calibration_rooms,
    });
    let inputs = given.inputs(options, &[&rooms]);
    let adapter = given.trained(&plan.adapter_name(), &inputs, &set.train[0], || {
        train_and_calibrate(&rooms, &training, &SILENT)
    })?;
    let trained = (adapter.adapter.clone(), adapter.record.clone());
    let run = test_trained(trained, &rooms, &set.test, &training, &SILENT)?.run;
    Ok((PlanResult { plan, run }, adapter))
}

const SILENT: CrossRoomProgress<'static> = CrossRoomProgress {
    epoch: &|| (),
    room: &|| (),
};

/// Evaluates an adapter in the held-out rooms with several sequences: refits are fitted on the
/// first sequence; pairs and candidates are of the others. Rooms with one sequence are skipped.
fn in_second_visits(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
    adapter: &ReproducedAdapter,
) -> Result<CrossRoomRun, Error> {
    let views: Vec<Room> = set
        .test
        .iter()
        .map(|data| first_visit_learned(data.room))
        .collect::<Result<_, _>>()?;
    let held_out: Vec<RoomData<'_>> = set
        .test
        .iter()
        .zip(&views)
        .filter(|(_, view)| view.timeline().held_out.contains(&true))
        .map(|(data, room)| RoomData { room, ..*data })
        .collect();

    let affine = StepKind::InversePoincare(Reading::Affine);
    let refit = StepKind::Refit(Refit {
        z_scored: true,
        intercept: false,
        in_sample: false,
    });
    let protocol = Protocol {
        split: Split::Dataset,
        thresholds: vec![0.1],
        navigators: vec![
            NavigatorKind::Identity,
            NavigatorKind::Step(affine, RetrievalMetric::Full),
            NavigatorKind::Step(refit, RetrievalMetric::Full),
        ],
        ..Protocol::paper(given.options.stride)
    };
    let plan = AdapterPlan {
        kind: PlanKind::PaperRange,
        rooms: set.train.len(),
        seed: 0,
    };
    let plan = CrossRoomPlan {
        training: &training_plan(given, plan),
        relational: None,
        calibration_rooms: 0,
        protocol: &protocol,
    };
    let trained = (adapter.adapter.clone(), adapter.record.clone());
    Ok(test_trained(trained, &set.train, &held_out, &plan, &SILENT)?.run)
}

/// The room with all sequences but the first held out.
fn first_visit_learned(room: &Room) -> Result<Room, Error> {
    let mut frames = room.frames().clone();
    let first = FrameId(0);
    frames.held_out = (0..room.frame_count() as u32)
        .map(|row| !room.timeline().joins(first, FrameId(row)))
        .collect();
    Room::new(room.id().clone(), frames, room.provenance().clone())
        .map_err(|problem| Error::Input(problem.to_string()))
}

fn training_plan(given: &Reproduction<'_>, of: AdapterPlan) -> TrainingPlan {
    let stride = given.options.stride;
    let mut plan = given.plan(of.kind.preset(), Split::Whole, stride, of.seed, None);

    // Members of an ensemble share one adapter's epochs; a single adapter is an ensemble of one.
    plan.config.charts = of.kind.members();
    plan.config.mixing = Mixing::Even;
    plan
}

/// The navigators of the cross-room tables. Calibrated retrieval needs the error covariance from
/// calibration rooms. Refits and the other metrics are evaluated for seed 0 only.
fn navigators(plan: &AdapterPlan) -> Vec<NavigatorKind> {
    let affine = StepKind::InversePoincare(Reading::Affine);
    let homogeneous = StepKind::InversePoincare(Reading::Homogeneous);
    let refit = |z_scored: bool| {
        StepKind::Refit(Refit {
            z_scored,
            intercept: false,
            in_sample: true,
        })
    };

    let mut navigators = vec![
        NavigatorKind::Identity,
        NavigatorKind::Step(affine, RetrievalMetric::Full),
        NavigatorKind::Step(homogeneous, RetrievalMetric::Full),
    ];
    if plan.seed == 0 {
        navigators.extend([
            NavigatorKind::Step(refit(true), RetrievalMetric::Full),
            NavigatorKind::Step(refit(false), RetrievalMetric::Full),
            NavigatorKind::Step(affine, RetrievalMetric::RowSpace),
            NavigatorKind::Step(affine, RetrievalMetric::Whitened),
        ]);
    }
    if plan.kind.is_calibrated() {
        let calibrated = NavigatorKind::Step(homogeneous, RetrievalMetric::Calibrated);
        navigators.push(calibrated);
    }

    navigators
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_testing::recording;

    /// Oracle: the test recording has six sequences of 50 frames: the first is learned from.
    #[test]
    fn refits_learn_the_first_visit_alone() {
        let room = recording::room("a");
        let view = first_visit_learned(&room).unwrap();
        let expected: Vec<bool> = (0..300).map(|row| row >= 50).collect();
        assert_eq!(view.timeline().held_out, expected);
    }
}
