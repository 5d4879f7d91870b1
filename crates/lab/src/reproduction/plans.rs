//! The adapters of the cross-room sections: training plans, numbers of rooms, and results in the
//! held-out rooms.

use rayon::prelude::*;

use seese3_core::adapter::{Mixing, Preset, Reading};
use seese3_core::eval::Protocol;
use seese3_core::navigation::{NavigatorKind, Refit, RetrievalMetric, StepKind};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan};

use super::notes::{Notes, ReproducedAdapter};
use super::{Error, FeatureSet, Reproduction};
use crate::experiments::cross_room::{
    CrossRoomPlan, CrossRoomProgress, CrossRoomRun, nested_choice, test_trained,
    train_and_calibrate,
};

/// Number of adapters in an ensemble.
pub const MEMBERS: usize = 4;

/// An upper bound on the length of plan names, for checking names before training.
pub const LONGEST_NAME: &str = "paper-range-aside-of-100000";

/// The kinds of adapters in the cross-room sections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
            Self::PaperRangeCalibrated => "paper-range, errors measured aside",
            Self::EnsembleCalibrated => "ensemble of paper-range, errors measured aside",
            Self::Steady => "steady",
            Self::SteadyCalibrated => "steady, errors measured aside",
        }
    }

    /// The first part of the adapter's name; the number of rooms follows.
    fn short_name(self) -> &'static str {
        match self {
            Self::PaperRange => "paper-range",
            Self::PaperRangeCalibrated => "paper-range-aside",
            Self::EnsembleCalibrated => "ensemble-aside",
            Self::Steady => "steady",
            Self::SteadyCalibrated => "steady-aside",
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
#[derive(Debug, Clone, Copy)]
pub struct AdapterPlan {
    /// The kind of adapter.
    pub kind: PlanKind,
    /// Number of rooms, including calibration rooms.
    pub rooms: usize,
}

impl AdapterPlan {
    /// The adapter's name, for use with [`super::published_name`].
    pub fn adapter_name(&self) -> String {
        format!("{}-of-{}", self.kind.short_name(), self.rooms)
    }
}

/// A plan and the results of its adapter in the held-out rooms.
pub struct PlanResult {
    /// The plan.
    pub plan: AdapterPlan,
    /// The results.
    pub run: CrossRoomRun,
}

/// The results of all plans with one feature set.
pub struct SetResults {
    /// The name of the features.
    pub features: String,
    /// Results of the plans on all rooms, the paper's preset first.
    pub on_all_rooms: Vec<PlanResult>,
    /// Results of the paper's preset, by increasing number of rooms.
    pub by_size: Vec<PlanResult>,
}

impl SetResults {
    /// The baseline of all comparisons: the paper's preset on all rooms.
    pub fn baseline(&self) -> &PlanResult {
        &self.on_all_rooms[0]
    }
}

/// The name of the adapter of preset steady on all rooms, without calibration rooms.
pub fn steady_adapter(set: &FeatureSet<'_>) -> String {
    let plan = AdapterPlan {
        kind: PlanKind::Steady,
        rooms: set.train.len(),
    };
    plan.adapter_name()
}

/// Trains the adapters of every plan and feature set, and evaluates them in the held-out rooms.
pub fn evaluate(given: &Reproduction<'_>, notes: &mut Notes) -> Result<Vec<SetResults>, Error> {
    let mut all = Vec::with_capacity(given.sets.len());
    for set in &given.sets {
        let rooms = set.train.len();
        let results: Vec<(PlanResult, ReproducedAdapter)> = plans(given, set)
            .into_par_iter()
            .map(|plan| result_of(given, set, plan))
            .collect::<Result<_, Error>>()?;
        let (results, adapters): (Vec<PlanResult>, Vec<ReproducedAdapter>) =
            results.into_iter().unzip();
        notes.adapters.extend(adapters);

        let mut by_size: Vec<PlanResult> = Vec::new();
        let mut on_all_rooms = Vec::new();
        for result in results {
            if result.plan.kind == PlanKind::PaperRange {
                by_size.push(PlanResult {
                    plan: result.plan,
                    run: result.run.clone(),
                });
            }
            if result.plan.rooms == rooms {
                on_all_rooms.push(result);
            }
        }

        // The paper's preset comes first; the others keep the order of the plans.
        on_all_rooms.sort_by_key(|result| result.plan.kind != PlanKind::PaperRange);
        by_size.sort_by_key(|result| result.plan.rooms);
        all.push(SetResults {
            features: set.features.clone(),
            on_all_rooms,
            by_size,
        });
    }

    Ok(all)
}

/// All plans, longest training first, so that no long training runs alone at the end.
fn plans(given: &Reproduction<'_>, set: &FeatureSet<'_>) -> Vec<AdapterPlan> {
    let all = set.train.len();
    let on_all_rooms = [
        PlanKind::PaperRange,
        PlanKind::PaperRangeCalibrated,
        PlanKind::EnsembleCalibrated,
    ];
    let mut plans: Vec<AdapterPlan> = on_all_rooms
        .map(|kind| AdapterPlan { kind, rooms: all })
        .to_vec();

    // The scaling curve of the paper's preset. Its last point, all rooms, is already in the list.
    let mut sizes = given.options.sizes.clone();
    sizes.retain(|&size| size != all);
    sizes.sort_unstable();
    sizes.dedup();
    plans.extend(sizes.into_iter().rev().map(|rooms| AdapterPlan {
        kind: PlanKind::PaperRange,
        rooms,
    }));

    // Preset steady needs only a fraction of the steps.
    let steady = [PlanKind::Steady, PlanKind::SteadyCalibrated];
    plans.extend(steady.map(|kind| AdapterPlan { kind, rooms: all }));

    plans
}

fn result_of(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
    plan: AdapterPlan,
) -> Result<(PlanResult, ReproducedAdapter), Error> {
    let rooms: Vec<RoomData<'_>> = nested_choice(plan.rooms, set.train.len(), 0)
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
        navigators: navigators(calibration_rooms > 0),
        ..Protocol::paper(given.options.stride)
    };

    let training = training_plan(given, plan.kind);
    let training = CrossRoomPlan {
        training: &training,
        relational: None,
        calibration_rooms,
        protocol: &protocol,
    };
    let progress = CrossRoomProgress {
        epoch: &|| (),
        room: &|| (),
    };

    let adapter = given.trained(&plan.adapter_name(), &set.train[0], || {
        train_and_calibrate(&rooms, &training, &progress)
    })?;
    let trained = (adapter.adapter.clone(), adapter.record.clone());
    let run = test_trained(trained, &rooms, &set.test, &training, &progress)?.run;
    Ok((PlanResult { plan, run }, adapter))
}

fn training_plan(given: &Reproduction<'_>, kind: PlanKind) -> TrainingPlan {
    let stride = given.options.stride;
    let mut plan = given.plan(kind.preset(), Split::Whole, stride, 0, None);

    // Members of an ensemble share one adapter's epochs; a single adapter is an ensemble of one.
    plan.config.charts = kind.members();
    plan.config.mixing = Mixing::Even;
    plan
}

/// The navigators of the cross-room tables. Calibrated retrieval needs the error covariance from
/// calibration rooms.
fn navigators(is_calibrated: bool) -> Vec<NavigatorKind> {
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
        NavigatorKind::Step(refit(true), RetrievalMetric::Full),
        NavigatorKind::Step(refit(false), RetrievalMetric::Full),
        NavigatorKind::Step(affine, RetrievalMetric::RowSpace),
        NavigatorKind::Step(affine, RetrievalMetric::Whitened),
    ];
    if is_calibrated {
        let calibrated = NavigatorKind::Step(homogeneous, RetrievalMetric::Calibrated);
        navigators.push(calibrated);
    }

    navigators
}
