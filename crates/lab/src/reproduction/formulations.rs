//! The adapter beside the alternatives A to D, within a room.

use serde::Serialize;

use seese3_core::adapter::Preset;
use seese3_core::motion_scores::MotionScores;
use seese3_core::splits::Split;
use seese3_core::statistics::mean_of_known;

use super::claims::{Claim, Verdict, count_words};
use super::render::spread;
use super::{Error, FeatureSet, Found, Reproduction, paper};
use crate::experiments::formulations::{FormulationScores, RoomPooling, compare};
use crate::report::{FormulationsJson, Section, formulations_json};

/// Epochs of the alternatives A to D: 200 epochs of 30,000 pairs, as in the paper, take hours.
const ALTERNATIVE_EPOCHS: usize = 20;

/// The formulations with one feature set in `record.json`.
#[derive(Debug, Serialize)]
pub struct FormulationRecord {
    features: String,
    scores: FormulationsJson,
}

/// The section that compares the adapter with the alternatives A to D.
pub fn section(
    given: &Reproduction<'_>,
    claims: &mut Vec<Claim>,
) -> Result<Found<Vec<FormulationRecord>>, Error> {
    let mut section = Section::new("Alternatives A to D");

    let head = [
        "formulation",
        "overall",
        "translation",
        "rotation",
        "direction",
        "magnitude",
    ];

    let mut record = Vec::new();
    let mut best: Vec<Option<bool>> = Vec::new();
    for set in &given.sets {
        let scores = formulation_scores(given, set)?;
        let mut rows = vec![head.map(str::to_owned).to_vec()];
        for score in &scores {
            // Every score is one value per seed, already averaged over the rooms.
            let column =
                |of: fn(&MotionScores) -> f64| score.runs.iter().map(of).collect::<Vec<_>>();

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

        // The paper's numbers stand under ours as context: its encoders and rooms differ.
        for (name, numbers) in paper::ALTERNATIVES {
            rows.push(
                [format!("paper: {name}")]
                    .into_iter()
                    .chain(numbers.map(|x| format!("{x:.2}")))
                    .collect(),
            );
        }

        section.text(format!("Features {}:", set.features));
        section.table(rows);

        // The adapter comes first in `Formulation::ALL`; the claim holds if it beats all others.
        let overall: Vec<f64> = scores
            .iter()
            .map(|s| mean_of_known(&s.runs.iter().map(|run| run.overall).collect::<Vec<_>>()))
            .collect();
        // Where every formulation is below 0, the order among them says nothing.
        let can_tell = overall.iter().any(|&r2| r2 > 0.0);
        let is_first = overall[1..].iter().all(|&other| overall[0] > other);
        best.push(can_tell.then_some(is_first));

        record.push(FormulationRecord {
            features: set.features.clone(),
            scores: formulations_json(&scores),
        });
    }

    section.text(format!(
        "Means over the rooms that are learned alone, stride {}, time split, preset paper-range cut to \
         {ALTERNATIVE_EPOCHS} epochs, mean ± sd over {} seeds.",
        given.options.stride, given.options.seeds
    ));

    claims.push(Claim {
        claim: "the adapter's W(φ(z₂) − φ(z₁)) reads motion better than the alternatives A to D",
        verdict: Verdict::of_telling(&best),
        found: format!("highest overall R²: {}", count_words(&best, "feature sets")),
    });

    Ok(Found { section, record })
}

fn formulation_scores(
    given: &Reproduction<'_>,
    set: &FeatureSet<'_>,
) -> Result<Vec<FormulationScores>, Error> {
    // The preset's epochs are cut: every formulation trains once per room and seed.
    let plan = given.plan(
        Preset::PaperRange,
        Split::Time,
        given.options.stride,
        0,
        Some(ALTERNATIVE_EPOCHS),
    );

    compare(
        &set.in_room,
        &plan,
        given.options.seeds,
        RoomPooling::RoomByRoom,
        &|| (),
    )
}
