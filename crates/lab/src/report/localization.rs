//! Localization of single views, for `seese3 evaluate localization`, and motion between two views,
//! for `seese3 evaluate motion`.

use serde::Serialize;

use seese3_core::statistics::RecordedMedian;

use super::table::Table;
use crate::experiments::localization::{Localization, LocalizationErrors};
use crate::experiments::motion::{MotionEvaluation, TwoViewErrors};

/// One line per localization method: medians with intervals, and 90 % quantiles of the errors.
pub fn localization_table(found: &Localization) -> Table {
    errors_table(
        "located by",
        &[
            ("ours", Some(found.ours)),
            ("nearest frame", Some(found.nearest_frame)),
            (
                "nearest pose (by metres plus radians)",
                Some(found.nearest_pose),
            ),
            ("the adapter's full estimate", found.zero_shot),
            ("the fitted adapter's full estimate", found.fitted),
        ],
    )
}

/// One line per motion estimator: medians with intervals, and 90 % quantiles of the errors. The
/// coverage of the two-view estimator follows.
pub fn motion_table(found: &MotionEvaluation) -> String {
    let two_view = found.two_view.as_ref();
    let table = errors_table(
        "motion by",
        &[
            ("the adapter", found.ours),
            ("the adapter without its mean motion", found.without_mean),
            ("its mean motion alone", found.constant),
            ("the two-view reader", two_view.map(|found| found.ours)),
            ("no motion", Some(found.no_motion)),
        ],
    );

    let Some(TwoViewErrors {
        answered, coverage, ..
    }) = two_view
    else {
        return table.to_string();
    };

    let mut text = format!(
        "{table}\nthe two-view reader estimated {:.1} % of the motions",
        100.0 * answered
    );
    if *answered > 0.0 {
        text += &format!(
            "; {:.2} and {:.2} of these lie within its 68 and 95 % ellipsoids",
            coverage.within_68, coverage.within_95
        );
    }
    text
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
    /// Stride of the mapped frames.
    pub map_every: usize,
    /// Whether blocks of the recording were left unmapped.
    pub map_blocks: bool,
    /// The seed of the fitted adapter.
    pub seed: u64,
}

/// The JSON record of `seese3 evaluate localization`.
#[derive(Debug, Serialize)]
pub struct LocalizationJson<'a> {
    /// The results.
    #[serde(flatten)]
    pub found: &'a Localization,
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
