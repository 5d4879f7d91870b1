//! Section: effect of adapter settings within a room: loss, latent width and learning rate.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::adapter::{Loss, Preset};
use seese3_core::motion_scores::MotionScores;
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan};

use super::claims::{Case, Claim, clipped_means};
use super::{Error, FeatureSet, Found, Reproduction};
use crate::experiments::folds::FoldedMotions;
use crate::formulations::read_by_adapter;
use crate::report::Column::{self, Text};
use crate::report::{Section, Table, spread_text};

/// Latent widths of the grid.
const GEO_DIMS: [usize; 4] = [6, 20, 80, 320];
/// Learning rates of the grid.
const LEARNING_RATES: [f64; 4] = [3e-4, 1e-3, 3e-3, 1e-2];

/// JSON record of the tables.
#[derive(Debug, Serialize)]
pub struct SettingsRecord {
    features: String,
    losses: Vec<LossRecord>,
    grid: Vec<GridRecord>,
}

/// The scores with one loss, one value per seed.
#[derive(Debug, Serialize)]
struct LossRecord {
    loss: &'static str,
    /// Mean over rooms.
    translation: Vec<f64>,
    /// Mean over rooms.
    rotation: Vec<f64>,
    rotation_by_seed_and_room: Vec<Vec<f64>>,
}

/// One grid point, with one seed.
#[derive(Debug, Serialize)]
struct GridRecord {
    geo_dim: usize,
    learning_rate: f64,
    r2: f64,
}

/// Builds the section with the paper's table "joint against rotation only" and its sweep, for the
/// first feature set.
pub fn section(given: &Reproduction<'_>) -> Result<Found<SettingsRecord>, Error> {
    let mut section = Section::new("Settings of the adapter, within a room");
    let set = &given.sets[0];

    let losses = losses(given, set)?;
    let columns: [Column<LossRecord>; 3] = [
        Text("loss", |found| found.loss.to_owned()),
        Text("translation", |found| spread_text(&found.translation, 2)),
        Text("rotation", |found| spread_text(&found.rotation, 2)),
    ];
    section.text(format!(
        "Features {}: the loss on all six components, and on the rotation alone, which leaves the translation untrained:",
        set.features
    ));
    section.table(Table::of(&losses, &columns));
    let claims = vec![claim(set, &losses)];

    let grid = grid(given, set)?;
    let rates = LEARNING_RATES
        .map(|rate| format!("rate {rate}"))
        .join(" | ");
    let mut table = Table::new(&format!("geo_dim | {rates}"));
    for of_dim in grid.chunks(LEARNING_RATES.len()) {
        let scores = of_dim.iter().map(|point| format!("{:.2}", point.r2));
        table.row(of_dim[0].geo_dim.to_string(), scores);
    }
    section.text(
        "Overall R² by columns of the latent and learning rate, one seed; NaN where the training failed:",
    );
    section.table(table);

    section.text(format!(
        "Means over the in-room rooms, stride {}, split {}. {}",
        given.options.stride,
        Split::Blocks,
        given.training_words()
    ));

    Ok(Found {
        section,
        record: SettingsRecord {
            features: set.features.clone(),
            losses,
            grid,
        },
        claims,
    })
}

fn losses(given: &Reproduction<'_>, set: &FeatureSet<'_>) -> Result<Vec<LossRecord>, Error> {
    let of = |loss: Loss| {
        let by_seed: Vec<Vec<MotionScores>> = (0..given.options.seeds)
            .map(|seed| {
                let mut plan = base_plan(given, seed);
                plan.config.loss = loss;
                scores(set, &plan)
            })
            .collect::<Result<_, Error>>()?;
        let means: Vec<MotionScores> = by_seed
            .iter()
            .map(|rooms| MotionScores::mean(rooms))
            .collect();

        Ok(LossRecord {
            loss: loss.name(),
            translation: means.iter().map(|scores| scores.translation).collect(),
            rotation: means.iter().map(|scores| scores.rotation).collect(),
            rotation_by_seed_and_room: by_seed
                .iter()
                .map(|rooms| rooms.iter().map(|room| room.rotation).collect())
                .collect(),
        })
    };

    [Loss::MeanSquaredError, Loss::Rotation]
        .into_iter()
        .map(of)
        .collect()
}

/// The losses differ only in the translation; each is averaged over the seeds, room by room.
fn claim(set: &FeatureSet<'_>, losses: &[LossRecord]) -> Claim {
    let by_room = |loss: Loss| -> Vec<f64> {
        let found = losses.iter().find(|found| found.loss == loss.name());
        clipped_means(found.map_or(&[][..], |found| &found.rotation_by_seed_and_room))
    };

    let joint = by_room(Loss::MeanSquaredError);
    Claim::new(
        "training on translation and rotation together estimates rotation better than training on rotation alone",
        "max(R², −1) of rotation, of the mean over seeds, joint minus alone",
        vec![Case::of_difference(
            &set.features,
            &joint,
            &by_room(Loss::Rotation),
        )],
    )
}

/// All grid points; the learning rate varies fastest.
fn grid(given: &Reproduction<'_>, set: &FeatureSet<'_>) -> Result<Vec<GridRecord>, Error> {
    let mut points = Vec::new();
    for geo_dim in GEO_DIMS {
        for learning_rate in LEARNING_RATES {
            let mut plan = base_plan(given, 0);
            plan.config.latent = geo_dim;
            plan.config.learning_rate = learning_rate;

            points.push(GridRecord {
                geo_dim,
                learning_rate,
                // If training diverges, the score is NaN and the sweep continues.
                r2: scores(set, &plan).map_or(f64::NAN, |rooms| MotionScores::mean(&rooms).overall),
            });
        }
    }

    Ok(points)
}

/// The base plan of all runs.
fn base_plan(given: &Reproduction<'_>, seed: u64) -> TrainingPlan {
    given.plan(
        Preset::Base,
        Split::Blocks,
        given.options.stride,
        seed,
        None,
    )
}

/// The scores of each in-room room.
fn scores(set: &FeatureSet<'_>, plan: &TrainingPlan) -> Result<Vec<MotionScores>, Error> {
    let of_room = |room: &RoomData<'_>| {
        let read = FoldedMotions::of(&[Split::Blocks], |split| {
            let plan = TrainingPlan {
                split,
                ..plan.clone()
            };
            Ok(read_by_adapter(&[*room], &plan, &mut |_| ())?.0)
        })?;
        Ok(read.scores())
    };
    set.in_room.par_iter().map(of_room).collect()
}
