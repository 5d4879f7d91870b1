//! The tables within a room: probes, strides, alternatives, navigation.

use std::sync::Arc;

use anyhow::Context;
use rayon::prelude::*;
use serde_json::{Value, json};

use super::super::rooms::lesson;
use super::claims::{Claim, Verdict};
use super::notes::{Learned, Notes};
use super::{Found, Loaded, Set, Setting};
use crate::adapter::{CorrectorKind, Preset, TrainConfig};
use crate::cancel::Cancellation;
use crate::eval::{Protocol, Report, evaluate};
use crate::formulations::{self, Formulation};
use crate::generalisation::CLIPPED_R2;
use crate::metrics::{Duplicates, MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe};
use crate::navigation::{IndexKind, Navigator};
use crate::pairs::Split;
use crate::report::{
    Curves, FormulationScores, Section, Series, curves_svg, formulations_json, paper,
};
use crate::scores::{MotionScores, deviation, mean, mean_of_known};
use crate::training::{Recipe, learn};

/// Frames that M1 compares: few enough to spread over a room of 400.
const M1_FRAMES: usize = 100;
/// Epochs of the alternatives: the paper's 200 on 30,000 pairs would take them hours.
const ALTERNATIVE_EPOCHS: usize = 20;
/// Epochs of the navigation table's adapters, all pairs at one stride.
const NAVIGATION_EPOCHS: usize = 200;

struct Probed {
    room: String,
    short: f64,
    long: f64,
    twonn: f64,
    mle: f64,
    ridge: f64,
}

/// M1 at a short and a long stride, M2, M3.
pub fn probes(setting: &Setting, claims: &mut Vec<Claim>) -> anyhow::Result<Found> {
    let mut section = Section::new("Probes: M1, M2, M3");
    let head = [
        "features", "room", "M1 short", "M1 long", "TwoNN", "MLE", "M3 R²",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];

    let mut series = Vec::new();
    let mut record = Vec::new();
    for set in &setting.sets {
        let probed: Vec<Probed> = set
            .in_room
            .par_iter()
            .map(|room| probed(room, setting))
            .collect::<anyhow::Result<_>>()?;

        for Probed {
            room,
            short,
            long,
            twonn,
            mle,
            ridge,
        } in &probed
        {
            let numbers = [short, long, twonn, mle, ridge].map(|x| format!("{x:.3}"));
            rows.push(
                [set.features.clone(), room.clone()]
                    .into_iter()
                    .chain(numbers)
                    .collect(),
            );

            record.push(
                json!({ "features": set.features, "room": room, "m1_short": short, "m1_long": long,
                "twonn": twonn, "mle": mle, "m3": ridge }),
            );
        }

        let points = probed.iter().map(|p| [p.short, p.long]).collect();
        series.push(Series {
            name: set.features.clone(),
            points,
            joined: false,
        });
    }

    for (encoder, numbers) in paper::DIMENSIONS {
        let empty = [String::new(), String::new()];
        let numbers = numbers.map(|x| format!("{x:.2}"));
        let name = [format!("paper: {encoder}"), String::new()];
        rows.push(name.into_iter().chain(empty).chain(numbers).collect());
    }

    section.table(rows);

    section.text(format!(
        "M1: {M1_FRAMES} frames, k 10, 10 of them to each side left out; short is stride 1, long spreads them over the \
         whole recording. M2: no gap, as in the paper. M3: stride {}, time split.",
        setting.options.stride
    ));

    let curves = Curves {
        title: "Mutual k-NN, short against long stride".to_owned(),
        x: "short stride".to_owned(),
        y: "long stride".to_owned(),
        series,
        diagonal: true,
    };

    section.picture(
        "m1.svg",
        plotted(&curves)?,
        "M1 at a short and a long stride, a point a room; the line is y = x",
    );

    // The last features are the weight-free control.
    let long = |of: &Series| of.points.iter().map(|point| point[1]).collect::<Vec<f64>>();
    let (control, trained) = curves.series.split_last().context("no features")?;

    let above: Vec<bool> = trained
        .iter()
        .flat_map(|series| {
            long(series)
                .into_iter()
                .zip(long(control))
                .map(|(ours, theirs)| ours > theirs)
        })
        .collect();

    claims.push(Claim {
        claim: "topology: a trained encoder's neighbours at a long stride are neighbours by pose, more than raw pixels' (M1)",
        verdict: Verdict::of(&above),
        found: format!(
            "M1 at the long stride is above that of {} in {} of {} rooms and features",
            control.name,
            above.iter().filter(|&&held| held).count(),
            above.len()
        ),
    });

    Ok((section, Value::Array(record)))
}

fn probed((stored, features): &Loaded, setting: &Setting) -> anyhow::Result<Probed> {
    let room = &stored.room;
    let rows = features.rows();

    let what = || {
        format!(
            "room '{}', features '{}'",
            room.id(),
            features.source().name
        )
    };

    let long = (room.frame_count().saturating_sub(1) / (M1_FRAMES - 1)).max(1);

    let at = |stride: usize| {
        let options = MutualKnn {
            frames: M1_FRAMES,
            stride,
            ..MutualKnn::default()
        };
        mutual_knn(rows, room.poses(), &options).with_context(what)
    };

    let dimension = intrinsic_dimension(rows, 0, Duplicates::DropRows).with_context(what)?;
    let ridge = ridge_probe(rows, room, Split::Time, setting.options.stride).with_context(what)?;

    Ok(Probed {
        room: room.id().to_string(),
        short: at(1)?,
        long: at(long)?,
        twonn: dimension.two_nn.linear,
        mle: dimension.mle_biased.harmonic,
        ridge: ridge.overall,
    })
}

/// M4 by stride.
pub fn strides(setting: &Setting, claims: &mut Vec<Claim>) -> anyhow::Result<Found> {
    let mut section = Section::new("M4: the adapter by stride, within a room");
    let strides = &setting.options.strides;
    let mut rows = vec![["features", "room"].map(str::to_owned).to_vec()];
    rows[0].extend(strides.iter().map(|stride| format!("stride {stride}")));

    let mut series = Vec::new();
    let mut record = Vec::new();
    let mut positive = Vec::new();
    for set in &setting.sets {
        let mut points = Vec::new();

        let mut by_room: Vec<Vec<String>> = set
            .in_room
            .iter()
            .map(|(stored, _)| vec![set.features.clone(), stored.room.id().to_string()])
            .collect();

        for &stride in strides {
            let overall = m4(setting, set, stride)?;
            for (row, seeds) in by_room.iter_mut().zip(&overall) {
                row.push(spread(seeds));
            }

            let clipped: Vec<f64> = overall
                .iter()
                .map(|seeds| mean_of_known(seeds).max(CLIPPED_R2))
                .collect();
            points.push([f64::from(stride), mean(&clipped)]);

            positive.extend(overall.iter().map(|seeds| mean_of_known(seeds) > 0.0));
            record.push(json!({ "features": set.features, "stride": stride, "r2_by_room_and_seed": overall }));
        }

        rows.extend(by_room);

        series.push(Series {
            name: set.features.clone(),
            points,
            joined: true,
        });
    }

    section.table(rows);

    section.text(format!(
        "Test R² of preset paper-base (10 epochs) on the last fifth of each recording, mean ± sd over {} seeds.",
        setting.options.seeds
    ));

    let curves = Curves {
        title: "Test R² by stride".to_owned(),
        x: "stride, frames".to_owned(),
        y: "mean over rooms of max(R², −1)".to_owned(),
        series,
        diagonal: false,
    };

    section.picture(
        "strides.svg",
        plotted(&curves)?,
        "M4 by stride, within a room",
    );

    claims.push(Claim {
        claim: "an adapter reads the motion of frames never seen, within a room (M4: R² > 0)",
        verdict: Verdict::of(&positive),
        found: format!(
            "mean R² is above 0 in {} of {} rooms, features and strides",
            positive.iter().filter(|&&held| held).count(),
            positive.len()
        ),
    });

    Ok((section, Value::Array(record)))
}

/// Overall test R² by room and seed.
fn m4(setting: &Setting, set: &Set, stride: u32) -> anyhow::Result<Vec<Vec<f64>>> {
    let of = |room: &Loaded| {
        let seeds = 0..setting.options.seeds;
        seeds
            .map(|seed| {
                let recipe = setting.recipe(Preset::PaperBase, Split::Time, stride, seed, None);
                Ok(learn(&[lesson(room)], &recipe, &mut |_| ())?.1.test.overall)
            })
            .collect::<anyhow::Result<Vec<f64>>>()
    };

    set.in_room.par_iter().map(of).collect()
}

/// The adapter beside A to D.
pub fn formulations(setting: &Setting, claims: &mut Vec<Claim>) -> anyhow::Result<Found> {
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
    let mut best = Vec::new();
    for set in &setting.sets {
        let scores = formulation_scores(setting, set)?;
        let mut rows = vec![head.map(str::to_owned).to_vec()];
        for score in &scores {
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

        let overall: Vec<f64> = scores
            .iter()
            .map(|s| mean_of_known(&s.runs.iter().map(|run| run.overall).collect::<Vec<_>>()))
            .collect();
        best.push(overall[1..].iter().all(|&other| overall[0] > other));

        record.push(json!({ "features": set.features, "scores": formulations_json(&scores) }));
    }

    section.text(format!(
        "Means over the rooms that are learned alone, stride {}, time split, preset paper-range cut to \
         {ALTERNATIVE_EPOCHS} epochs, mean ± sd over {} seeds.",
        setting.options.stride, setting.options.seeds
    ));

    claims.push(Claim {
        claim: "the adapter's W(φ(z₂) − φ(z₁)) reads motion better than the alternatives A to D",
        verdict: Verdict::of(&best),
        found: format!(
            "highest overall R² for {} of {} features",
            best.iter().filter(|&&b| b).count(),
            best.len()
        ),
    });

    Ok((section, Value::Array(record)))
}

fn formulation_scores(setting: &Setting, set: &Set) -> anyhow::Result<Vec<FormulationScores>> {
    let tasks: Vec<(Formulation, u64)> = Formulation::ALL
        .into_iter()
        .flat_map(|which| (0..setting.options.seeds).map(move |seed| (which, seed)))
        .collect();

    let run = |&(which, seed): &(Formulation, u64)| {
        let mut of_rooms = Vec::new();
        for room in &set.in_room {
            let recipe = setting.recipe(
                Preset::PaperRange,
                Split::Time,
                setting.options.stride,
                seed,
                Some(ALTERNATIVE_EPOCHS),
            );

            of_rooms.extend(formulations::learn(
                which,
                &[lesson(room)],
                &recipe,
                &mut |_| (),
            )?);
        }

        Ok((which, MotionScores::mean(&of_rooms)))
    };

    let runs: Vec<(Formulation, MotionScores)> =
        tasks.par_iter().map(run).collect::<anyhow::Result<_>>()?;

    let of = |which: Formulation| FormulationScores {
        name: which.name(),
        runs: runs
            .iter()
            .filter(|(other, _)| *other == which)
            .map(|(_, scores)| *scores)
            .collect(),
    };

    Ok(Formulation::ALL.map(of).to_vec())
}

/// The navigation table, correctors and all.
pub fn navigation(setting: &Setting, notes: &mut Notes) -> anyhow::Result<Found> {
    let mut section = Section::new("Latent navigation within a room");
    let mut record = Vec::new();
    let mut dominates = Vec::new();
    for (position, set) in setting.sets.iter().enumerate() {
        let navigated: Vec<(Report, Learned)> = set
            .in_room
            .par_iter()
            .map(|room| navigated(setting, room))
            .collect::<anyhow::Result<_>>()?;
        let (reports, learned): (Vec<Report>, Vec<Learned>) = navigated.into_iter().unzip();
        let adapters: Vec<String> = learned.iter().map(|learned| learned.name.clone()).collect();

        notes.adapters.extend(learned);
        let mut head = ["navigator", "MSE", "R²", "Top-1"]
            .map(str::to_owned)
            .to_vec();

        head.extend(
            reports[0]
                .protocol
                .thresholds
                .iter()
                .map(|epsilon| format!("Hit@{epsilon}")),
        );

        let mut rows = vec![head];
        let mut series = Vec::new();
        for place in 0..reports[0].rows.len() {
            let name = reports[0].rows[place].name.clone();
            let numbers = averaged(&reports, place);

            rows.push(
                [name.clone()]
                    .into_iter()
                    .chain(numbers.iter().map(|x| format!("{x:.3}")))
                    .collect(),
            );

            let hits = reports[0]
                .protocol
                .thresholds
                .iter()
                .zip(&numbers[3..])
                .map(|(&e, &hit)| [e, hit])
                .collect();

            series.push(Series {
                name: name.clone(),
                points: hits,
                joined: true,
            });

            record.push(json!({ "features": set.features, "navigator": name, "mse": numbers[0], "r2": numbers[1],
                "top1": numbers[2], "hits": numbers[3..], "adapters": adapters, "n": reports.iter().map(|r| r.n).collect::<Vec<_>>() }));
        }

        for (name, numbers) in paper::NAVIGATION {
            rows.push(
                [format!("paper: {name}")]
                    .into_iter()
                    .chain(numbers.map(|x| format!("{x:.3}")))
                    .collect(),
            );
        }

        section.text(format!("Features {}:", set.features));
        section.table(rows);

        let hit = |name: &str| {
            series
                .iter()
                .find(|s| s.name == name)
                .map_or(f64::NAN, |s| s.points[0][1])
        };
        let inverse = hit("inverse-poincare-affine");

        dominates.push(
            CorrectorKind::ALL
                .iter()
                .all(|kind| inverse >= hit(&format!("corrector-{}", kind.name()))),
        );

        let shown = |s: &Series| {
            ["identity", "oracle", "inverse-poincare-affine"].contains(&s.name.as_str())
                || s.name.starts_with("corrector")
                || s.name.ends_with("+motion")
        };

        let curves = Curves {
            title: format!("Hit@ε, {}", set.features),
            x: "ε".to_owned(),
            y: "share of pairs".to_owned(),
            series: series.into_iter().filter(shown).collect(),
            diagonal: false,
        };

        let caption = format!("Hit@ε within a room, features {}", set.features);
        section.picture(format!("hits-{position}.svg"), plotted(&curves)?, caption);
    }

    section.text(format!(
        "Means over the rooms that are learned alone: stride {}, last fifth of each recording, candidates are its \
         frames, source included, one seed; adapters and correctors of {NAVIGATION_EPOCHS} epochs on all pairs at the \
         stride. 'in-sample' is fitted on the scored pairs: a leak, and the likely protocol of the paper's refit.",
        setting.options.stride
    ));

    notes.claims.push(Claim {
        claim: "inverse Poincaré hits more often than every learned corrector (Hit@0.1)",
        verdict: Verdict::of(&dominates),
        found: format!(
            "so for {} of {} features",
            dominates.iter().filter(|&&d| d).count(),
            dominates.len()
        ),
    });

    Ok((section, Value::Array(record)))
}

fn navigated(setting: &Setting, room: &Loaded) -> anyhow::Result<(Report, Learned)> {
    let stride = setting.options.stride;
    let mut recipe = setting.recipe(
        Preset::PaperBase,
        Split::Time,
        stride,
        0,
        Some(NAVIGATION_EPOCHS),
    );

    recipe.correctors = CorrectorKind::ALL.to_vec();
    let (adapter, record) = learn(&[lesson(room)], &recipe, &mut |_| ())?;
    let learned = Learned::new(room.0.room.id().as_str(), room, adapter.clone(), record);

    let navigator = Navigator::new(
        Arc::new(room.0.room.clone()),
        &room.1,
        Arc::new(adapter),
        IndexKind::Exact,
    )?;

    let report = evaluate(
        &navigator,
        &Protocol::paper(stride),
        &Cancellation::default(),
        &mut |_, _| (),
    )?;

    Ok((report, learned))
}

/// MSE, R², Top-1 and hits of one row, means over rooms.
fn averaged(reports: &[Report], place: usize) -> Vec<f64> {
    let of_room = |report: &Report| {
        let row = &report.rows[place];
        let latent = row
            .latent
            .map_or([f64::NAN; 2], |latent| [latent.mse, latent.r2]);

        let hits = row.retrieval.hits.iter().map(|(_, rate)| rate.rate);
        latent
            .into_iter()
            .chain([row.retrieval.top1.rate])
            .chain(hits)
            .collect::<Vec<f64>>()
    };

    let all: Vec<Vec<f64>> = reports.iter().map(of_room).collect();
    (0..all[0].len())
        .map(|column| mean_of_known(&all.iter().map(|row| row[column]).collect::<Vec<_>>()))
        .collect()
}

impl Setting {
    /// A preset, cut to `epochs`, or to what the command was given.
    pub(super) fn recipe(
        &self,
        preset: Preset,
        split: Split,
        stride: u32,
        seed: u64,
        epochs: Option<usize>,
    ) -> Recipe {
        let plain = Recipe::of(preset, split, stride, seed);
        let epochs = self
            .options
            .epochs
            .or(epochs)
            .unwrap_or(plain.config.epochs);

        Recipe {
            config: TrainConfig {
                epochs,
                ..plain.config.clone()
            },
            ..plain
        }
    }
}

fn spread(values: &[f64]) -> String {
    let middle = mean_of_known(values);
    if values.len() > 1 {
        format!("{middle:.2} ± {:.2}", deviation(values))
    } else {
        format!("{middle:.2}")
    }
}

pub(super) fn plotted(curves: &Curves) -> anyhow::Result<Vec<u8>> {
    Ok(curves_svg(curves).map_err(anyhow::Error::msg)?.into_bytes())
}
