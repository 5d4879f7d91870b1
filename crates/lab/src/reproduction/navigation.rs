//! Section: navigation within a room, including learned correctors.

use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::adapter::{CorrectorKind, Preset};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, Report, evaluate};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::splits::Split;
use seese3_core::statistics::{mean_of_known, paired_difference};
use seese3_core::training::{RoomData, train_adapter};

use super::claims::{Claim, Verdict, count_words, holds_for_each, is_above_zero};
use super::notes::{Notes, ReproducedAdapter};
use super::render::plotted;
use super::{Error, Found, Reproduction, paper};
use crate::report::{Curves, Section, Series};

/// Number of training epochs for the navigation table, on all pairs at one stride.
const NAVIGATION_EPOCHS: usize = 200;

/// JSON record of a navigator with one feature set: means over the rooms.
#[derive(Debug, Serialize)]
pub struct NavigationRecord {
    features: String,
    navigator: String,
    mse: f64,
    r2: f64,
    top1: f64,
    /// One hit rate per threshold ε.
    hits: Vec<f64>,
    /// The adapters' names in the store, one per room.
    adapters: Vec<String>,
    /// Numbers of pairs, one per room.
    n: Vec<usize>,
}

/// Builds the section with the navigation table.
#[expect(
    clippy::too_many_lines,
    reason = "a section of the report: its loop, its table and its claim"
)]
pub fn section(
    given: &Reproduction<'_>,
    notes: &mut Notes,
) -> Result<Found<Vec<NavigationRecord>>, Error> {
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

        // The adapters are published at the end of the run, under the names in every record row.
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

        // All rooms share one protocol, so a row index identifies the same navigator in every room.
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

            record.push(NavigationRecord {
                features: set.features.clone(),
                navigator: name,
                mse: numbers[0],
                r2: numbers[1],
                top1: numbers[2],
                hits: numbers[3..].to_vec(),
                adapters: adapters.clone(),
                n: reports.iter().map(|report| report.n).collect(),
            });
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

        dominates.push(hits_more_than_correctors(&reports));

        // The picture shows only a selection of the rows.
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
         frames, source included, one seed; adapters and correctors of {} epochs on all pairs at the \
         stride. 'in-sample' is fitted on the scored pairs: a leak, and the likely protocol of the paper's refit.",
        given.options.stride,
        given.options.epochs.unwrap_or(NAVIGATION_EPOCHS)
    ));

    notes.claims.push(Claim {
        claim: "inverse Poincaré hits more often than every learned corrector (Hit@0.1)",
        verdict: Verdict::of_intervals(&dominates),
        found: format!(
            "the interval of the difference in Hit@0.1 over rooms is above zero for each corrector: {}",
            count_words(&dominates, "feature sets")
        ),
    });

    Ok(Found { section, record })
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

    // Correctors are trained after the adapter, on the same pairs.
    plan.correctors = CorrectorKind::ALL.to_vec();
    let (adapter, record) = train_adapter(&[*room], &plan, &mut |_| ())?;
    let learned = ReproducedAdapter::new(room.room.id().as_str(), room, adapter.clone(), record);

    // Use an exact index: scores must not depend on an approximation.
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

/// Whether inverse Poincaré has a higher hit rate than each corrector at ε = 0.1, the first
/// threshold of the paper's protocol. `None` if the intervals over the rooms are inconclusive.
fn hits_more_than_correctors(reports: &[Report]) -> Option<bool> {
    let hit_rates = |name: &str| -> Vec<f64> {
        let rows = reports.iter().flat_map(|report| &report.rows);
        rows.filter(|row| row.name == name)
            .map(|row| row.retrieval.hits[0].1.rate)
            .collect()
    };

    let inverse = hit_rates("inverse-poincare-affine");
    let is_above = CorrectorKind::ALL.map(|kind| {
        let corrector = hit_rates(&format!("corrector-{}", kind.name()));
        is_above_zero(&paired_difference(&inverse, &corrector, 0))
    });

    holds_for_each(&is_above)
}

/// MSE, R², Top-1 and hit rates of row `place`, averaged over rooms.
fn averaged(reports: &[Report], place: usize) -> Vec<f64> {
    let of_room = |report: &Report| {
        let row = &report.rows[place];

        // A row without latents has no MSE and no R²; the mean over rooms skips NaN.
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
