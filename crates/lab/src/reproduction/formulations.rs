//! The adapter beside the alternatives A to D, within a room.

use serde::Serialize;

use seese3_core::adapter::Preset;
use seese3_core::motion_scores::MotionScores;
use seese3_core::splits::Split;
use seese3_core::statistics::mean_of_known;

use super::claims::{Claim, Verdict, count_words};
use super::render::spread;
use super::{Error, FeatureSet, Found, Reproduction, paper};
use seese3_core::training::RoomData;

use crate::experiments::formulations::{Comparison, RoomPooling, compare};
use crate::report::{FormulationsJson, Section, formulations_json};

/// How many of the rooms that are learned alone the formulations are compared in, as in the paper.
const SCENES: usize = 3;

/// The formulations with one feature set in `record.json`.
#[derive(Debug, Serialize)]
pub struct FormulationRecord {
    features: String,
    /// How long every formulation was trained, in words.
    training: String,
    scores: FormulationsJson,
}

/// The section that compares the adapter with the alternatives A to D.
pub fn section(
    given: &Reproduction<'_>,
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<FormulationRecord>>, Error> {
    let mut section = Section::new("Alternatives A to D");

    let mut record = Vec::new();
    let mut best: Vec<Option<bool>> = Vec::new();
    for (training, set) in runs(given) {
        let compared = compared(given, set, training)?;
        section.text(format!(
            "Features {}, {}:",
            set.features,
            training.words(given)
        ));
        section.table(table_rows(&compared));

        // The adapter comes first in `Formulation::ALL`; the claim holds if it beats all others.
        let overall: Vec<f64> = compared
            .formulations
            .iter()
            .map(|s| mean_of_known(&s.runs.iter().map(|run| run.overall).collect::<Vec<_>>()))
            .collect();
        // Where no formulation beats the constant, the order among them says nothing.
        let can_tell = overall.iter().any(|&r2| r2 > compared.constant_r2.max(0.0));
        let is_first = overall[1..].iter().all(|&other| overall[0] > other);
        best.push(can_tell.then_some(is_first));

        record.push(FormulationRecord {
            features: set.features.clone(),
            training: training.words(given),
            scores: formulations_json(&compared),
        });
    }

    section.text(format!(
        "Means over {}, stride {}: R² over the pairs of all five folds of each recording together, mean ± sd over seeds.",
        scenes(&given.sets[0])
            .iter()
            .map(|data| data.room.id().as_str())
            .collect::<Vec<_>>()
            .join(", "),
        given.options.stride
    ));

    claims.push(Claim {
        claim: "the adapter's W(φ(z₂) − φ(z₁)) reads motion better than the alternatives A to D",
        verdict: Verdict::of_telling(&best),
        found: format!(
            "highest overall R²: {}",
            count_words(&best, "feature sets and trainings")
        ),
    });

    Ok(Found { section, record })
}

/// One row per formulation, then the constant's and the paper's.
fn table_rows(compared: &Comparison) -> Vec<Vec<String>> {
    let head = [
        "formulation",
        "overall",
        "translation",
        "rotation",
        "direction",
        "magnitude",
    ];

    let mut rows = vec![head.map(str::to_owned).to_vec()];
    for score in &compared.formulations {
        // Every score is one value per seed, already averaged over the rooms.
        let column = |of: fn(&MotionScores) -> f64| score.runs.iter().map(of).collect::<Vec<_>>();

        let parts = [
            column(|s| s.translation),
            column(|s| s.rotation),
            column(|s| s.direction),
            column(|s| s.magnitude),
        ];

        let mut row = vec![score.name.to_owned(), spread(&column(|s| s.overall))];
        row.extend(
            parts
                .iter()
                .map(|part| format!("{:.2}", mean_of_known(part))),
        );

        rows.push(row);
    }
    rows.push(vec![
        "mean training motion".to_owned(),
        format!("{:.2}", compared.constant_r2),
    ]);

    // The paper's numbers stand under ours as context: its encoders and rooms differ.
    for (name, numbers) in paper::ALTERNATIVES {
        rows.push(
            [format!("paper: {name}")]
                .into_iter()
                .chain(numbers.map(|x| format!("{x:.2}")))
                .collect(),
        );
    }

    rows
}

/// How long the formulations are trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Training {
    /// Preset base, with every seed.
    Base,
    /// The paper's 200 epochs of 30,000 pairs, which take 30 times as many steps: one seed.
    Paper,
}

impl Training {
    fn preset(self) -> Preset {
        match self {
            Self::Base => Preset::Base,
            Self::Paper => Preset::PaperRange,
        }
    }

    fn seeds(self, given: &Reproduction<'_>) -> u64 {
        match self {
            Self::Base => given.options.formulation_seeds,
            Self::Paper => 1,
        }
    }

    fn words(self, given: &Reproduction<'_>) -> String {
        let cut = given
            .options
            .epochs
            .map_or_else(String::new, |epochs| format!(" cut to {epochs} epochs"));
        format!(
            "preset {}{cut}, {} seeds",
            self.preset().name(),
            self.seeds(given)
        )
    }
}

/// Every feature set with the shorter training, and the first one with the paper's as well.
fn runs<'a>(given: &'a Reproduction<'a>) -> Vec<(Training, &'a FeatureSet<'a>)> {
    let mut runs: Vec<(Training, &FeatureSet<'_>)> =
        given.sets.iter().map(|set| (Training::Base, set)).collect();
    runs.insert(1, (Training::Paper, &given.sets[0]));
    runs
}

fn scenes<'a>(set: &'a FeatureSet<'a>) -> &'a [RoomData<'a>] {
    &set.in_room[..set.in_room.len().min(SCENES)]
}

fn compared(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
    training: Training,
) -> Result<Comparison, Error> {
    let stride = given.options.stride;

    // The folds replace the plan's split.
    let plan = given.plan(training.preset(), Split::Time, stride, 0, None);
    compare(
        scenes(set),
        &plan,
        &Split::FOLDS,
        training.seeds(given),
        RoomPooling::RoomByRoom,
        &|| (),
    )
}
