//! Section: navigation within a room, including learned correctors.

use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;

use seese3_core::adapter::{CorrectorKind, Preset};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, Report, Row, evaluate};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::splits::Split;
use seese3_core::statistics::{RoomMean, bootstrap_mean, mean, mean_of_known};
use seese3_core::training::{RoomData, train_adapter};

use super::adapters::{Adapters, ReproducedAdapter};
use super::claims::{Case, Claim, encoders_and_control};
use super::cross::AFFINE;
use super::{Error, Found, Reproduction, paper};
use crate::report::{Figure, Section, Series, Table, fixed, room_mean_text};

/// Number of training epochs for the navigation table, on all pairs at one stride.
const NAVIGATION_EPOCHS: usize = 200;

/// A navigator with one feature set, averaged over the rooms: a row of a table and of the record.
#[derive(Debug, Serialize)]
pub struct NavigationRecord {
    features: String,
    navigator: String,
    mse: f64,
    r2: f64,
    top1: f64,
    /// One hit rate per threshold ε.
    hits: Vec<f64>,
    /// That of the first threshold, with its interval over rooms.
    first_hit: RoomMean,
    /// The adapters' names in the store, one per room.
    adapters: Vec<String>,
    /// Numbers of pairs, one per room.
    n: Vec<usize>,
}

/// Builds the section with the navigation table.
pub fn section(
    given: &Reproduction<'_>,
    adapters: &mut Adapters,
) -> Result<Found<Vec<NavigationRecord>>, Error> {
    let mut section = Section::new("Latent navigation within a room");
    let mut record = Vec::new();
    let mut over_correctors = Vec::new();
    for (position, set) in given.sets.iter().enumerate() {
        let rooms = set.in_room.par_iter().map(|room| navigated(given, room));
        let found: Vec<(Report, ReproducedAdapter)> = rooms.collect::<Result<_, Error>>()?;
        let (reports, learned): (Vec<Report>, Vec<ReproducedAdapter>) = found.into_iter().unzip();
        let navigated = Navigated {
            features: &set.features,
            adapters: learned.iter().map(|learned| learned.name.clone()).collect(),
            reports,
        };

        // The adapters are published at the end of the run, under the names in every record row.
        adapters.0.extend(learned);

        // All rooms share one protocol, so a row index identifies the same navigator in every room.
        let thresholds = &navigated.reports[0].protocol.thresholds;
        let rows: Vec<NavigationRecord> = (0..navigated.reports[0].rows.len())
            .map(|place| navigated.averaged(place))
            .collect();

        section.text(format!("Features {}:", set.features));
        section.table(table(thresholds, &rows));
        section.picture(
            format!("hits-{position}.svg"),
            curves(&set.features, thresholds, &rows).svg()?,
            format!("Hit@ε within a room, features {}", set.features),
        );

        if position < encoders_and_control(&given.sets).0.len() {
            over_correctors.extend(navigated.over_correctors());
        }
        record.extend(rows);
    }

    section.text(format!(
        "Means over the in-room rooms: stride {}, last fifth of each recording, candidates are its \
         frames, source included, one seed; intervals are over rooms; adapters and correctors of {} epochs on all pairs at the \
         stride. 'in-sample' is fitted on the scored pairs: a leak, and the likely protocol of the paper's refit.",
        given.options.stride,
        given.options.epochs.unwrap_or(NAVIGATION_EPOCHS)
    ));

    let claim = Claim::new(
        "affine inverse Poincaré hits more often than every learned corrector (Hit@0.1)",
        "Hit@0.1 of inverse Poincaré minus that of the corrector",
        over_correctors,
    );
    Ok(Found {
        section,
        record,
        claims: vec![claim],
    })
}

/// One row per navigator, then the paper's rows, which have the same columns.
fn table(thresholds: &[f64], rows: &[NavigationRecord]) -> Table {
    let interval = [" [95 %]"].into_iter().chain(std::iter::repeat(""));
    let hits = thresholds.iter().zip(interval);
    let titles = hits.map(|(epsilon, interval)| format!(" | Hit@{epsilon}{interval}"));
    let mut table = Table::new(&format!(
        "navigator | MSE | R² | Top-1{}",
        titles.collect::<String>()
    ));

    for row in rows {
        let hits = row.hits[1..].iter().map(|hit| format!("{hit:.3}"));
        let cells = fixed([row.mse, row.r2, row.top1], 3)
            .into_iter()
            .chain([room_mean_text(&row.first_hit)])
            .chain(hits);
        table.row(&row.navigator, cells);
    }
    for (name, numbers) in paper::NAVIGATION {
        table.row(format!("paper: {name}"), fixed(numbers, 3));
    }

    table
}

/// Hit@ε of a selection of the navigators.
fn curves(features: &str, thresholds: &[f64], rows: &[NavigationRecord]) -> Figure {
    let is_shown = |row: &&NavigationRecord| {
        ["identity", "oracle", AFFINE].contains(&row.navigator.as_str())
            || row.navigator.starts_with("corrector")
            || row.navigator.ends_with("+motion")
    };
    let curve = |row: &NavigationRecord| {
        let points = thresholds.iter().zip(&row.hits);
        Series::line(
            &row.navigator,
            points.map(|(&epsilon, &hit)| [epsilon, hit]).collect(),
        )
    };

    let series = rows.iter().filter(is_shown).map(curve).collect();
    Figure::new(format!("Hit@ε, {features}"), "ε", "share of pairs", series)
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
    let inputs = given.inputs(json!({ "training": format!("{plan:?}") }), &[&[*room]]);
    let learned = given.trained(room.room.id().as_str(), &inputs, room, || {
        Ok(train_adapter(&[*room], &plan, &mut |_| ())?)
    })?;

    // Use an exact index: scores must not depend on an approximation.
    let navigator = Navigator::new(
        Arc::new(room.room.clone()),
        room.features,
        Arc::new(learned.adapter.clone()),
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

/// The reports of one feature set, one per room.
struct Navigated<'a> {
    features: &'a str,
    /// The adapters' names in the store.
    adapters: Vec<String>,
    reports: Vec<Report>,
}

impl Navigated<'_> {
    /// Inverse Poincaré against each corrector, at ε = 0.1, the first threshold of the paper's
    /// protocol.
    fn over_correctors(&self) -> [Case; 4] {
        let hit_rates = |name: &str| -> Vec<f64> {
            let rows = self.reports.iter().flat_map(|report| &report.rows);
            rows.filter(|row| row.name == name)
                .map(|row| row.retrieval.hits[0].1.rate)
                .collect()
        };

        let inverse = hit_rates(AFFINE);
        CorrectorKind::ALL.map(|kind| {
            let corrector = hit_rates(&format!("corrector-{}", kind.name()));
            let case = format!("{}, over {}", self.features, kind.name());
            Case::of_difference(case, &inverse, &corrector)
        })
    }

    /// The scores of row `place`, averaged over rooms.
    fn averaged(&self, place: usize) -> NavigationRecord {
        let first = &self.reports[0];
        let over_rooms = |of: &dyn Fn(&Row) -> f64| {
            let rows = self.reports.iter().map(|report| of(&report.rows[place]));
            mean_of_known(&rows.collect::<Vec<f64>>())
        };
        let hits = |epsilon: usize| -> Vec<f64> {
            let rows = self.reports.iter().map(|report| &report.rows[place]);
            rows.map(|row| row.retrieval.hits[epsilon].1.rate).collect()
        };

        // A row without latents has no MSE and no R²; the mean over rooms skips NaN.
        NavigationRecord {
            features: self.features.to_owned(),
            navigator: first.rows[place].name.clone(),
            mse: over_rooms(&|row| row.latent.map_or(f64::NAN, |latent| latent.mse)),
            r2: over_rooms(&|row| row.latent.map_or(f64::NAN, |latent| latent.r2)),
            top1: over_rooms(&|row| row.retrieval.top1.rate),
            hits: (0..first.protocol.thresholds.len())
                .map(|epsilon| mean(&hits(epsilon)))
                .collect(),
            first_hit: bootstrap_mean(&hits(0), 0),
            adapters: self.adapters.clone(),
            n: self.reports.iter().map(|report| report.n).collect(),
        }
    }
}
