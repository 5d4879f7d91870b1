//! The tables within a room: probes M1 to M3, M4 by stride, alternatives A to D, navigation.

use std::sync::Arc;

use rayon::prelude::*;
use serde_json::{Value, json};

use seese3_core::adapter::{CorrectorKind, Preset};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, Report, evaluate};
use seese3_core::motion_scores::MotionScores;
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::splits::Split;
use seese3_core::statistics::{deviation, mean, mean_of_known};
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};

use super::claims::{Claim, Verdict};
use super::notes::{Notes, ReproducedAdapter};
use super::{Error, FeatureSet, Found, Reproduction, paper};
use crate::experiments::Within;
use crate::experiments::cross_room::CLIPPED_R2;
use crate::experiments::formulations::{FormulationScores, Pooling, compare};
use crate::probes::{Duplicates, MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe};
use crate::report::{Curves, Section, Series, curves_svg, formulations_json};

/// How many frames M1 compares: a recording of 400 frames then still allows a stride of 4.
const M1_FRAMES: usize = 100;
/// Epochs of the alternatives A to D: 200 epochs of 30,000 pairs, as in the paper, take hours.
const ALTERNATIVE_EPOCHS: usize = 20;
/// Epochs of the adapters of the navigation table, which train on all pairs at one stride.
const NAVIGATION_EPOCHS: usize = 200;

struct Probed {
    room: String,
    short: f64,
    long: f64,
    twonn: f64,
    mle: f64,
    ridge: f64,
}

/// The section of M1 at a short and a long stride, M2 and M3.
#[expect(
    clippy::too_many_lines,
    reason = "a section of the report: its loop, its table and its claim"
)]
pub fn probes(given: &Reproduction<'_>, claims: &mut Vec<Claim>) -> Result<Found, Error> {
    let mut section = Section::new("Probes: M1, M2, M3");
    let head = [
        "features", "room", "M1 short", "M1 long", "TwoNN", "MLE", "M3 R²",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];

    let mut series = Vec::new();
    let mut record = Vec::new();
    for set in &given.sets {
        let probed: Vec<Probed> = set
            .in_room
            .par_iter()
            .map(|room| probed(room, given))
            .collect::<Result<_, Error>>()?;

        // Probes train no adapter, so a room has one number and no spread over seeds.
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

        // One point per room: M1 at the short stride against M1 at the long one.
        let points = probed.iter().map(|p| [p.short, p.long]).collect();
        series.push(Series {
            name: set.features.clone(),
            points,
            joined: false,
        });
    }

    // The paper's rows have M2 and M3 alone: the cells of the room and of M1 stay empty.
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
        given.options.stride
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

    // By convention the last feature set given is the control, which needs no trained encoder.
    let long = |of: &Series| of.points.iter().map(|point| point[1]).collect::<Vec<f64>>();
    let (control, trained) = curves
        .series
        .split_last()
        .ok_or_else(|| Error::Input("at least one feature set is needed".to_owned()))?;

    // Room by room: does the trained encoder's M1 at the long stride exceed the control's?
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

fn probed(data: &RoomData<'_>, given: &Reproduction<'_>) -> Result<Probed, Error> {
    let room = data.room;
    let rows = data.features.rows();

    let what = || {
        format!(
            "room '{}', features '{}'",
            room.id(),
            data.features.source().name
        )
    };

    // The long stride spreads the compared frames over the whole recording.
    let long = (room.frame_count().saturating_sub(1) / (M1_FRAMES - 1)).max(1);

    let at = |stride: usize| {
        let options = MutualKnn {
            frames: M1_FRAMES,
            stride,
            ..MutualKnn::default()
        };
        mutual_knn(rows, room.poses(), &options).within(what)
    };

    // M2 without a temporal gap, as in the paper; `sweep layers` leaves a gap by default.
    let dimension = intrinsic_dimension(rows, 0, Duplicates::DropRows).within(what)?;
    let ridge = ridge_probe(rows, room, Split::Time, given.options.stride).within(what)?;

    Ok(Probed {
        room: room.id().to_string(),
        short: at(1)?,
        long: at(long)?,
        twonn: dimension.two_nn.linear,
        mle: dimension.mle_biased.harmonic,
        ridge: ridge.overall,
    })
}

/// The section of M4 by stride.
pub fn strides(given: &Reproduction<'_>, claims: &mut Vec<Claim>) -> Result<Found, Error> {
    let mut section = Section::new("M4: the adapter by stride, within a room");
    let strides = &given.options.strides;
    let mut rows = vec![["features", "room"].map(str::to_owned).to_vec()];
    rows[0].extend(strides.iter().map(|stride| format!("stride {stride}")));

    let mut series = Vec::new();
    let mut record = Vec::new();
    let mut positive = Vec::new();
    for set in &given.sets {
        let mut points = Vec::new();

        // One row per room; every stride adds a cell to each of them.
        let mut by_room: Vec<Vec<String>> = set
            .in_room
            .iter()
            .map(|data| vec![set.features.clone(), data.room.id().to_string()])
            .collect();

        // For every stride new adapters are trained on pairs at that stride and tested at it.
        for &stride in strides {
            let overall = m4(given, set, stride)?;
            for (row, seeds) in by_room.iter_mut().zip(&overall) {
                row.push(spread(seeds));
            }

            // R² has no lower bound: without clipping, a single room could decide the curve.
            let clipped: Vec<f64> = overall
                .iter()
                .map(|seeds| mean_of_known(seeds).max(CLIPPED_R2))
                .collect();
            points.push([f64::from(stride), mean(&clipped)]);

            // The claim is tested for each room, feature set and stride by its mean over seeds.
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
        given.options.seeds
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

/// Overall test R² of adapters at one stride: one list per room, one value per seed.
fn m4(given: &Reproduction<'_>, set: &FeatureSet<'_>, stride: u32) -> Result<Vec<Vec<f64>>, Error> {
    let of = |room: &RoomData<'_>| {
        let seeds = 0..given.options.seeds;
        seeds
            .map(|seed| {
                let plan = given.plan(Preset::PaperBase, Split::Time, stride, seed, None);
                Ok(train_adapter(&[*room], &plan, &mut |_| ())?.1.test.overall)
            })
            .collect::<Result<Vec<f64>, Error>>()
    };

    set.in_room.par_iter().map(of).collect()
}

/// The section that compares the adapter with the alternatives A to D.
pub fn formulations(given: &Reproduction<'_>, claims: &mut Vec<Claim>) -> Result<Found, Error> {
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
        best.push(overall[1..].iter().all(|&other| overall[0] > other));

        record.push(json!({ "features": set.features, "scores": formulations_json(&scores) }));
    }

    section.text(format!(
        "Means over the rooms that are learned alone, stride {}, time split, preset paper-range cut to \
         {ALTERNATIVE_EPOCHS} epochs, mean ± sd over {} seeds.",
        given.options.stride, given.options.seeds
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
        Pooling::RoomByRoom,
        &|| (),
    )
}

/// The section of the navigation table, learned correctors included.
#[expect(
    clippy::too_many_lines,
    reason = "a section of the report: its loop, its table and its claim"
)]
pub fn navigation(given: &Reproduction<'_>, notes: &mut Notes) -> Result<Found, Error> {
    let mut section = Section::new("Latent navigation within a room");
    let mut record = Vec::new();
    let mut dominates = Vec::new();
    for (position, set) in given.sets.iter().enumerate() {
        let navigated: Vec<(Report, ReproducedAdapter)> = set
            .in_room
            .par_iter()
            .map(|room| navigated(given, room))
            .collect::<Result<_, Error>>()?;
        let (reports, learned): (Vec<Report>, Vec<ReproducedAdapter>) =
            navigated.into_iter().unzip();
        let adapters: Vec<String> = learned.iter().map(|learned| learned.name.clone()).collect();

        // They are published at the end of the run, under the names that the record gives in every
        // row.
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

        // All rooms are evaluated under one protocol, so a row's number names the same navigator.
        for place in 0..reports[0].rows.len() {
            let name = reports[0].rows[place].name.clone();
            let numbers = averaged(&reports, place);

            rows.push(
                [name.clone()]
                    .into_iter()
                    .chain(numbers.iter().map(|x| format!("{x:.3}")))
                    .collect(),
            );

            // The first three numbers are MSE, R² and Top-1; one hit rate per threshold follows.
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

        // The paper's rows have the same columns: MSE, R², Top-1 and its four thresholds.
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

        // The claim is about the first threshold of the paper's protocol, ε = 0.1.
        let hit = |name: &str| {
            series
                .iter()
                .find(|s| s.name == name)
                .map_or(f64::NAN, |s| s.points[0][1])
        };
        let inverse = hit("inverse-poincare-affine");

        // The claim holds if inverse Poincaré hits at least as often as each of the correctors.
        dominates.push(
            CorrectorKind::ALL
                .iter()
                .all(|kind| inverse >= hit(&format!("corrector-{}", kind.name()))),
        );

        // The picture shows a selection of the rows, to stay readable.
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
        given.options.stride
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

fn navigated(
    given: &Reproduction<'_>,
    room: &RoomData<'_>,
) -> Result<(Report, ReproducedAdapter), Error> {
    let stride = given.options.stride;
    let mut plan = given.plan(
        Preset::PaperBase,
        Split::Time,
        stride,
        0,
        Some(NAVIGATION_EPOCHS),
    );

    // Correctors are trained on the same pairs as the adapter, after it.
    plan.correctors = CorrectorKind::ALL.to_vec();
    let (adapter, record) = train_adapter(&[*room], &plan, &mut |_| ())?;
    let learned = ReproducedAdapter::new(room.room.id().as_str(), room, adapter.clone(), record);

    // The index is exact: scores must not depend on an approximation.
    let navigator = Navigator::new(
        Arc::new(room.room.clone()),
        room.features,
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

/// MSE, R², Top-1 and hit rates of the row numbered `place`, each the mean over rooms.
fn averaged(reports: &[Report], place: usize) -> Vec<f64> {
    let of_room = |report: &Report| {
        let row = &report.rows[place];

        // A row without latents has no MSE and no R²; NaN is left out of the mean over rooms.
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

impl Reproduction<'_> {
    /// A preset at a stride. Its epochs are the command's `--epochs`, else `epochs`, else the
    /// preset's own.
    pub(super) fn plan(
        &self,
        preset: Preset,
        split: Split,
        stride: u32,
        seed: u64,
        epochs: Option<usize>,
    ) -> TrainingPlan {
        let mut plan = TrainingPlan::of(preset, split, stride, seed);
        if let Some(epochs) = self.options.epochs.or(epochs) {
            plan.config.epochs = epochs;
        }

        plan
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

pub fn plotted(curves: &Curves) -> Result<Vec<u8>, Error> {
    let svg = curves_svg(curves).map_err(|problem| Error::Rendering(problem.into()))?;
    Ok(svg.into_bytes())
}
