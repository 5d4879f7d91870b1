//! Localization of single views, for `seese3 evaluate localization`, and motion between two views,
//! for `seese3 evaluate motion`.

use serde::Serialize;

use seese3_core::statistics::RecordedMedian;

use super::table::aligned;
use crate::experiments::localization::{ErrorQuantiles, Localization, LocalizationErrors};
use crate::experiments::motion::{AdapterErrors, MotionErrors, MotionEvaluation, TwoViewErrors};

/// One line per localization method: medians with intervals, and 90 % quantiles of the errors.
pub fn localization_table(found: &Localization) -> String {
    let mut lines = vec![head("located by")];
    let mut add = |name: &str, errors: &LocalizationErrors| {
        lines.push(line(name, &errors.translation_m, &errors.rotation_deg));
    };

    add("ours", &found.ours);
    add("nearest frame", &found.nearest_frame);
    add("nearest pose (by metres plus radians)", &found.nearest_pose);
    if let Some(zero_shot) = &found.zero_shot {
        add("the adapter's full estimate", zero_shot);
    }
    if let Some(fitted) = &found.fitted {
        add("the fitted adapter's full estimate", fitted);
    }

    aligned(&lines)
}

/// One line per motion estimator: medians with intervals, and 90 % quantiles of the errors.
pub fn motion_table(found: &MotionEvaluation) -> String {
    let mut lines = vec![head("motion by")];
    let mut add = |name: &str, errors: &MotionErrors| {
        lines.push(line(name, &errors.translation_m, &errors.rotation_deg));
    };

    if let Some(adapter) = &found.adapter {
        add("the adapter", &adapter.ours);
        add("the adapter without its mean motion", &adapter.without_mean);
        add("its mean motion alone", &adapter.constant);
    }
    if let Some(two_view) = &found.two_view {
        add("the two-view reader", &two_view.ours);
    }
    add("no motion", &found.no_motion);

    let mut table = aligned(&lines);
    if let Some(TwoViewErrors {
        answered, coverage, ..
    }) = &found.two_view
    {
        table += &format!(
            "the two-view reader estimated {:.1} % of the motions",
            100.0 * answered
        );
        if *answered > 0.0 {
            table += &format!(
                "; {:.2} and {:.2} of these lie within its 68 and 95 % ellipsoids",
                coverage.within_68, coverage.within_95
            );
        }
        table.push('\n');
    }

    table
}

fn head(first: &str) -> Vec<String> {
    [first, "median m", "90 % m", "median °", "90 % °"]
        .map(str::to_owned)
        .to_vec()
}

fn line(name: &str, metres: &ErrorQuantiles, degrees: &ErrorQuantiles) -> Vec<String> {
    vec![
        name.to_owned(),
        interval(&metres.median, 4),
        format!("{:.3}", metres.p90),
        interval(&degrees.median, 2),
        format!("{:.1}", degrees.p90),
    ]
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
pub struct LocalizationJson {
    n: usize,
    mapped: usize,
    ours: ErrorsJson,
    nearest_frame: ErrorsJson,
    nearest_pose: ErrorsJson,
    zero_shot: Option<ErrorsJson>,
    fitted: Option<ErrorsJson>,
    rules: Option<RulesJson>,
    protocol: LocalizationContext,
}

/// The JSON record of `seese3 evaluate motion`.
#[derive(Debug, Serialize)]
pub struct MotionEvaluationJson {
    n: usize,
    /// The adapter's errors, followed by those without its mean and of its mean alone.
    ours: Option<ErrorsJson>,
    without_mean: Option<ErrorsJson>,
    constant: Option<ErrorsJson>,
    two_view: Option<TwoViewJson>,
    no_motion: ErrorsJson,
    room: String,
    adapter: Option<String>,
    stride: u32,
    /// Whether the adapter was trained in this room.
    in_room: Option<bool>,
}

#[derive(Debug, Serialize)]
struct TwoViewJson {
    #[serde(flatten)]
    errors: ErrorsJson,
    /// Fraction of motions with an estimate.
    answered: f64,
    coverage_68: f64,
    coverage_95: f64,
}

#[derive(Debug, Serialize)]
struct ErrorsJson {
    translation_m: QuantilesJson,
    rotation_deg: QuantilesJson,
}

#[derive(Debug, Serialize)]
struct QuantilesJson {
    median: f64,
    /// Bounds of the median's 95 % interval.
    low: f64,
    high: f64,
    p90: f64,
}

#[derive(Debug, Serialize)]
struct RulesJson {
    /// Fractions of views that use the nearest frame's translation and rotation unchanged.
    translation_unread: f64,
    rotation_unread: f64,
    /// Fractions of errors within the 68 % and 95 % ellipsoids.
    coverage_68: f64,
    coverage_95: f64,
}

impl From<&LocalizationErrors> for ErrorsJson {
    fn from(errors: &LocalizationErrors) -> Self {
        Self {
            translation_m: (&errors.translation_m).into(),
            rotation_deg: (&errors.rotation_deg).into(),
        }
    }
}

impl From<&MotionErrors> for ErrorsJson {
    fn from(errors: &MotionErrors) -> Self {
        Self {
            translation_m: (&errors.translation_m).into(),
            rotation_deg: (&errors.rotation_deg).into(),
        }
    }
}

impl From<&ErrorQuantiles> for QuantilesJson {
    fn from(quantiles: &ErrorQuantiles) -> Self {
        Self {
            median: quantiles.median.median,
            low: quantiles.median.low,
            high: quantiles.median.high,
            p90: quantiles.p90,
        }
    }
}

/// Builds the JSON record of a localization.
pub fn localization_json(found: &Localization, protocol: LocalizationContext) -> LocalizationJson {
    LocalizationJson {
        n: found.asked,
        mapped: found.mapped,
        ours: (&found.ours).into(),
        nearest_frame: (&found.nearest_frame).into(),
        nearest_pose: (&found.nearest_pose).into(),
        zero_shot: found.zero_shot.as_ref().map(ErrorsJson::from),
        fitted: found.fitted.as_ref().map(ErrorsJson::from),
        rules: found.rules.map(|rules| RulesJson {
            translation_unread: rules.translation_unread,
            rotation_unread: rules.rotation_unread,
            coverage_68: rules.coverage.within_68,
            coverage_95: rules.coverage.within_95,
        }),
        protocol,
    }
}

/// Builds the JSON record of motion errors. `adapter` is the adapter's name and whether it was
/// trained in this room.
pub fn motion_evaluation_json(
    found: &MotionEvaluation,
    room: &str,
    adapter: Option<(&str, bool)>,
    stride: u32,
) -> MotionEvaluationJson {
    let of_adapter = |errors: fn(&AdapterErrors) -> &MotionErrors| {
        found
            .adapter
            .as_ref()
            .map(|found| ErrorsJson::from(errors(found)))
    };

    MotionEvaluationJson {
        n: found.n,
        ours: of_adapter(|adapter| &adapter.ours),
        without_mean: of_adapter(|adapter| &adapter.without_mean),
        constant: of_adapter(|adapter| &adapter.constant),
        two_view: found.two_view.as_ref().map(|two_view| TwoViewJson {
            errors: (&two_view.ours).into(),
            answered: two_view.answered,
            coverage_68: two_view.coverage.within_68,
            coverage_95: two_view.coverage.within_95,
        }),
        no_motion: (&found.no_motion).into(),
        room: room.to_owned(),
        adapter: adapter.map(|(name, _)| name.to_owned()),
        stride,
        in_room: adapter.map(|(_, in_room)| in_room),
    }
}
