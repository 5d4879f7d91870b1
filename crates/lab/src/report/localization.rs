//! Localization of single views, for `seese3 evaluate localization`, and motion between two views,
//! for `seese3 evaluate motion`.

use serde::Serialize;

use seese3_core::statistics::{Coverage, RecordedMedian};

use super::table::Table;
use crate::experiments::localization::{Localization, LocalizationErrors};
use crate::experiments::matched_localization::{
    Answered, MatchedLocalization, MatchedPart, PairedErrors, PeerComparison,
};
use crate::experiments::motion::{MotionEvaluation, TwoViewErrors};

/// One line per localization method: medians with intervals, and 90 % quantiles of the errors.
pub fn localization_table(found: &Localization) -> Table {
    errors_table(
        "located by",
        &[
            ("ours", Some(found.ours)),
            ("nearest frame", Some(found.nearest_frame)),
            (
                "nearest pose (by meters plus radians)",
                Some(found.nearest_pose),
            ),
            ("the adapter's full estimate", found.zero_shot),
            ("the fitted adapter's full estimate", found.fitted),
        ],
    )
}

/// One line per method and part of the views: share answered, medians with intervals, 90 %
/// quantiles, wrong answers and coverage.
pub fn matched_localization_table(found: &MatchedLocalization) -> (Table, String) {
    let mut table = Table::new(
        "views | located by | answered | median m | 90 % m | median ° | 90 % ° | wrong | 68 % | 95 %",
    );
    for (name, part) in parts(found) {
        let scores = |ours: &Answered| {
            let cover = ours.coverage.map_or([f64::NAN; 2], |coverage| {
                [coverage.within_68, coverage.within_95]
            });
            let [answered, wrong] = [ours.answered, ours.wrong].map(|share| format!("{share:.3}"));
            let [c68, c95] = cover.map(|share| format!("{share:.2}"));
            [answered, wrong, c68, c95]
        };

        let label = format!("{name} ({})", part.n);
        let mut row = |method: &str, errors: &LocalizationErrors, scores: [String; 4]| {
            let [answered, wrong, c68, c95] = scores;
            let cells = [
                method.to_owned(),
                answered,
                interval(&errors.translation_m.median, 4),
                format!("{:.4}", errors.translation_m.p90),
                interval(&errors.rotation_deg.median, 2),
                format!("{:.2}", errors.rotation_deg.p90),
                wrong,
                c68,
                c95,
            ];
            table.row(&label, cells);
        };
        let of_all = || ["1.000", "", "", ""].map(str::to_owned);
        for (method, answers) in [
            ("matched views", &part.ours),
            ("the same near a prediction", &part.near_prediction),
        ] {
            row(method, &answers.errors, scores(answers));
        }
        row("nearest frame", &part.nearest_frame, of_all());
        row("blend of three", &part.blend, of_all());
    }

    let peer = peer_table(found);
    let notes = format!(
        "{peer}wrong: answers over 0.2 m or 10 degrees off; near the map: a mapped view within 0.25 m and 15 degrees; \
         near a prediction: the true pose off by up to 0.03 m and 2 degrees along each axis; \
         RMSE of the answers {:.4} m; {:.1} ms to match a view",
        found.all.ours.rmse_m, found.match_ms
    );
    (table, notes)
}

/// The parts of the views that are not empty, with their names.
fn parts(found: &MatchedLocalization) -> impl Iterator<Item = (&'static str, &MatchedPart)> {
    let parts = [
        ("all", Some(&found.all)),
        ("near the map", found.near.as_ref()),
        ("far from the map", found.far.as_ref()),
    ];
    parts
        .into_iter()
        .filter_map(|(name, part)| Some((name, part?)))
}

/// Matched views and the peer on the views that the peer was asked for; empty without a peer.
fn peer_table(found: &MatchedLocalization) -> String {
    let Some(all) = &found.all.peer else {
        return String::new();
    };

    let mut table = Table::new(
        "views of the peer | located by | answered | median m | 90 % m | median ° | 90 % ° | wrong",
    );
    for (name, part) in parts(found) {
        let Some(PeerComparison {
            n,
            peer,
            ours,
            both,
        }) = &part.peer
        else {
            continue;
        };

        let label = format!("{name} ({n})");
        for (method, answers) in [("matched views", ours), ("peer", peer)] {
            let Answered {
                answered,
                errors,
                wrong,
                ..
            } = answers;
            let shares = [answered, wrong].map(|share| format!("{share:.3}"));
            table.row(&label, peer_cells(method, errors, shares));
        }
        if let Some(both) = both {
            let label = format!("{name}, both answer ({})", both.n);
            for (method, errors) in [("matched views", &both.ours), ("peer", &both.peer)] {
                table.row(&label, peer_cells(method, errors, Default::default()));
            }
        }
    }

    let paired = all.both.as_ref().map(|both| {
        let PairedErrors {
            n,
            difference_m,
            ours_nearer,
            ..
        } = both;
        format!(
            "error of matched views minus error of the peer, {n} views: median {} m; matched views are nearer in {:.0} %\n",
            interval(difference_m, 4),
            100.0 * ours_nearer
        )
    });
    format!("\n{table}\n{}", paired.unwrap_or_default())
}

fn peer_cells(method: &str, errors: &LocalizationErrors, shares: [String; 2]) -> [String; 7] {
    let [answered, wrong] = shares;
    [
        method.to_owned(),
        answered,
        interval(&errors.translation_m.median, 4),
        format!("{:.4}", errors.translation_m.p90),
        interval(&errors.rotation_deg.median, 2),
        format!("{:.2}", errors.rotation_deg.p90),
        wrong,
    ]
}

/// One line per motion estimator: medians with intervals, and 90 % quantiles of the errors. The
/// coverage of the two-view estimator follows.
pub fn motion_table(found: &MotionEvaluation) -> (Table, String) {
    let two_view = found.two_view.as_ref();
    let table = errors_table(
        "motion by",
        &[
            ("the adapter", found.ours),
            ("the adapter without its mean motion", found.without_mean),
            ("its mean motion alone", found.constant),
            (
                "its relational reader",
                found.relational.as_ref().map(|found| found.ours),
            ),
            (
                "the matched keypoints of both views",
                two_view.map(|found| found.ours),
            ),
            ("no motion", Some(found.no_motion)),
        ],
    );

    let mut notes = Vec::new();
    let ellipsoids = |coverage: &Coverage| {
        format!(
            "{:.2} and {:.2} of these lie within its 68 and 95 % ellipsoids",
            coverage.within_68, coverage.within_95
        )
    };
    match found.relational.as_ref().map(|found| &found.coverage) {
        Some(Some(coverage)) => notes.push(format!(
            "the relational reader gave all motions; {}",
            ellipsoids(coverage)
        )),
        Some(None) => notes.push(
            "the relational reader gives no covariance: it was not calibrated (train --calibrate-on)"
                .to_owned(),
        ),
        None => {}
    }
    if let Some(TwoViewErrors {
        answered, coverage, ..
    }) = two_view
    {
        let answers = format!(
            "matched keypoints gave {:.1} % of the motions",
            100.0 * answered
        );
        notes.push(match *answered > 0.0 {
            true => format!("{answers}; {}", ellipsoids(coverage)),
            false => answers,
        });
    }
    (table, notes.join("\n"))
}

fn errors_table(first: &str, rows: &[(&str, Option<LocalizationErrors>)]) -> Table {
    let mut table = Table::new(&format!("{first} | median m | 90 % m | median ° | 90 % °"));
    for (name, errors) in rows {
        let Some(errors) = errors else { continue };
        let cells = [
            interval(&errors.translation_m.median, 4),
            format!("{:.3}", errors.translation_m.p90),
            interval(&errors.rotation_deg.median, 2),
            format!("{:.1}", errors.rotation_deg.p90),
        ];
        table.row(*name, cells);
    }

    table
}

/// Formats a median and its interval with the given number of decimals.
fn interval(median: &RecordedMedian, decimals: usize) -> String {
    format!(
        "{:.decimals$} [{:.decimals$}, {:.decimals$}]",
        median.median, median.low, median.high
    )
}

/// What was evaluated.
#[derive(Debug, Clone, Serialize)]
pub struct LocalizationContext {
    /// The room.
    pub room: String,
    /// The name of the features.
    pub features: String,
    /// The name of the adapter trained on other rooms, if one was given.
    pub adapter: Option<String>,
    /// The hold-out that chose the mapped frames, if one did.
    pub hold_out: Option<&'static str>,
    /// Stride of the mapped frames, without a hold-out.
    pub map_every: usize,
    /// Whether blocks of the recording were left unmapped.
    pub map_blocks: bool,
    /// The seed of the fitted adapter.
    pub seed: u64,
}

/// The JSON record of `seese3 evaluate localization`.
#[derive(Debug, Serialize)]
pub struct LocalizationJson<'a, T> {
    /// The results.
    #[serde(flatten)]
    pub found: &'a T,
    /// What was evaluated.
    pub protocol: LocalizationContext,
}

/// The JSON record of `seese3 evaluate motion`.
#[derive(Debug, Serialize)]
pub struct MotionEvaluationJson<'a> {
    /// The results.
    #[serde(flatten)]
    pub found: &'a MotionEvaluation,
    /// The room.
    pub room: &'a str,
    /// The name of the adapter, if one was given.
    pub adapter: Option<&'a str>,
    /// Frames from the first view to the second.
    pub stride: u32,
    /// Whether the adapter was trained in this room.
    pub in_room: Option<bool>,
}
