//! Section: the adapter compared with the alternatives A to D, within a room.

use serde::Serialize;
use serde_json::json;

use seese3_core::adapter::Preset;
use seese3_core::splits::Split;
use seese3_core::statistics::bootstrap_mean;

use super::claims::{Case, Claim, clipped_means, encoders_and_control};
use super::{Error, FeatureSet, Found, Reproduction, paper};
use crate::experiments::formulations::{
    Comparison, FormulationPlan, FormulationScores, RoomPooling, compare, run_formulation,
};
use crate::report::{Section, Table, add_formulations, fixed, room_mean_text};

/// Minimum number of rooms and of seeds for a test. The rooms must not be selected by a score.
const FEWEST_ROOMS: usize = 12;
const FEWEST_SEEDS: usize = 5;
/// Epochs of the paper's training.
const PAPER_EPOCHS: usize = 200;
/// Every fifth block is tested, so that training and test motions have similar distributions.
const SPLIT: Split = Split::Blocks;

/// JSON record of the formulations with one feature set.
#[derive(Debug, Serialize)]
pub struct FormulationRecord {
    features: String,
    /// The training of every formulation, in words.
    training: String,
    scores: Comparison,
}

/// Builds the section that compares the adapter with the alternatives A to D.
pub fn section(given: &Reproduction<'_>) -> Result<Found<Vec<FormulationRecord>>, Error> {
    let mut section = Section::new("Alternatives A to D");

    let mut record = Vec::new();
    let mut cases = Vec::new();
    for (training, set) in runs(given) {
        let compared = compared(given, set, training)?;
        let words = training.words(given);
        section.text(format!("Features {}, {words}:", set.features));
        section.table(table(&compared));

        // The paper trains for 200 epochs; the order changes with the length of the training.
        if training == Training::Paper {
            let epochs = training.epochs(given).unwrap_or(PAPER_EPOCHS);
            let cases_of_set = over_alternatives(&set.features, &compared).into_iter();
            cases.extend(cases_of_set.map(|case| {
                if epochs < PAPER_EPOCHS {
                    return case.without_test(format!(
                        "{epochs} epochs, fewer than the paper's {PAPER_EPOCHS}"
                    ));
                }
                case
            }));
        }

        record.push(FormulationRecord {
            features: set.features.clone(),
            training: words,
            scores: compared,
        });
    }

    section.text(format!(
        "Means over the {} in-room rooms, stride {}, split {SPLIT}: mean ± sd over seeds of the mean over \
         rooms; the last column is over rooms, of the mean over seeds. The claim is tested on the paper's training, over rooms, with at least {FEWEST_ROOMS} rooms and \
         {FEWEST_SEEDS} seeds; R² of a room counts as max(R², −1).",
        given.sets[0].in_room.len(),
        given.options.stride
    ));

    if cases.is_empty() {
        cases.push(Case::untested(
            &given.sets[0].features,
            None,
            "the paper's training was not run",
        ));
    }
    let claim = Claim::new(
        "the adapter's W(φ(z₂) − φ(z₁)) estimates motion better than the alternatives A to D",
        "max(R², −1) of the mean over seeds, the adapter's minus that of the alternative",
        cases,
    );
    Ok(Found {
        section,
        record,
        claims: vec![claim],
    })
}

/// The adapter's R² minus that of each alternative, by room.
fn over_alternatives(features: &str, compared: &Comparison) -> Vec<Case> {
    let by_room = |scores: &FormulationScores| clipped_means(&scores.r2_by_seed_and_room);

    // The adapter comes first in `Formulation::VARIANTS`.
    let Some((adapter, alternatives)) = compared.formulations.split_first() else {
        return Vec::new();
    };
    let seeds = adapter.r2_by_seed_and_room.len();
    let rooms = adapter.r2_by_seed_and_room.first().map_or(0, Vec::len);
    let case = |alternative: &FormulationScores| {
        let case = format!("{features}, over {}", alternative.name);
        let case = Case::of_difference(case, &by_room(adapter), &by_room(alternative));
        if rooms < FEWEST_ROOMS || seeds < FEWEST_SEEDS {
            return case.without_test(format!(
                "{rooms} rooms and {seeds} seeds, fewer than {FEWEST_ROOMS} and {FEWEST_SEEDS}"
            ));
        }
        case
    };
    alternatives.iter().map(case).collect()
}

/// One row per formulation, then the row of the constant and the paper's rows.
fn table(compared: &Comparison) -> Table {
    let mut table = Table::new(
        "formulation | overall | translation | rotation | direction | magnitude | max(R², −1) [95 %]",
    );
    add_formulations(&mut table, compared, 2, |score| {
        let by_room = clipped_means(&score.r2_by_seed_and_room);
        Some(room_mean_text(&bootstrap_mean(&by_room, 0)))
    });

    // The paper's numbers follow ours as context: its encoders and rooms differ.
    for (name, numbers) in paper::ALTERNATIVES {
        table.row(format!("paper: {name}"), fixed(numbers, 2));
    }

    table
}

/// Training schedules of the formulations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Training {
    /// Preset base.
    Base,
    /// The paper's preset for `formulation_epochs` epochs.
    Paper,
}

impl Training {
    fn preset(self) -> Preset {
        match self {
            Self::Base => Preset::Base,
            Self::Paper => Preset::PaperRange,
        }
    }

    /// The number of epochs where it is not the preset's own.
    fn epochs(self, given: &Reproduction<'_>) -> Option<usize> {
        let long = (self == Self::Paper).then_some(given.options.formulation_epochs);
        given.options.epochs.or(long)
    }

    fn words(self, given: &Reproduction<'_>) -> String {
        let cut = self
            .epochs(given)
            .map_or_else(String::new, |epochs| format!(", {epochs} epochs"));
        format!(
            "preset {}{cut}, {} seeds",
            self.preset().name(),
            given.options.formulation_seeds
        )
    }
}

/// The short training with every feature set but the control, whose adapters estimate no motion
/// (see the section on strides), and the long one with the first set, if it is wanted.
fn runs<'a>(given: &'a Reproduction<'a>) -> Vec<(Training, &'a FeatureSet<'a>)> {
    let (sets, _) = encoders_and_control(&given.sets);

    let is_long_training_wanted = given.options.formulation_epochs > 0;
    let long = is_long_training_wanted.then_some((Training::Paper, &given.sets[0]));
    let short = sets.iter().map(|set| (Training::Base, set));
    long.into_iter().chain(short).collect()
}

fn compared(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
    training: Training,
) -> Result<Comparison, Error> {
    let plan = given.plan(
        training.preset(),
        SPLIT,
        given.options.stride,
        0,
        training.epochs(given),
    );
    let name = format!("{}-{}", training.preset().name(), set.features);
    let plan = FormulationPlan {
        training: &plan,
        splits: &[SPLIT],
        room_pooling: RoomPooling::RoomByRoom,
    };

    // Every formulation and seed is kept by itself: together they take hours.
    compare(given.options.formulation_seeds, &|which, seed| {
        let options = json!({ "training": format!("{:?}", plan.training.with_seed(seed)) });
        let inputs = given.inputs(options, &[&set.in_room]);
        let which_name: &str = which.into();
        let part = format!("formulation-{name}-{which_name}-{seed}");
        given.kept(&part, inputs, || {
            run_formulation(which, seed, &set.in_room, &plan)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::formulations::FormulationRun;
    use crate::formulations::Formulation;
    use seese3_core::motion_scores::MotionScores;
    use strum::VariantArray;

    /// Every formulation has an R² of 0.3 in every room, the adapter 0.5.
    fn comparison(rooms: usize, seeds: usize) -> Comparison {
        let scores = |&which: &Formulation| {
            let overall = if which == Formulation::VARIANTS[0] {
                0.5
            } else {
                0.3
            };
            let room = MotionScores {
                overall,
                ..MotionScores::mean(&[])
            };
            let run = FormulationRun {
                rooms: vec![room; rooms],
                constant_r2: 0.0,
            };
            FormulationScores::new(which, &vec![run; seeds])
        };
        Comparison {
            formulations: Formulation::VARIANTS.iter().map(scores).collect(),
            constant_r2: 0.0,
        }
    }

    /// Oracle: the rule of 12 rooms and 5 seeds.
    #[test]
    fn few_rooms_or_seeds_do_not_say_which_is_best() {
        for (rooms, seeds, is_tested) in [(12, 5, true), (11, 5, false), (12, 4, false)] {
            let cases = over_alternatives("f", &comparison(rooms, seeds));
            assert_eq!(cases.len(), 4);
            for case in cases {
                assert!((case.mean.unwrap().mean - 0.2).abs() < 1e-12);
                assert_eq!(case.p.is_some(), is_tested, "{case:?}");
                assert_eq!(case.reason.is_none(), is_tested, "{case:?}");
            }
        }
    }
}
