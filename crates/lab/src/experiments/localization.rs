//! Evaluates localization of single views in a partly mapped room, beside retrieval baselines.

use std::sync::Arc;

use serde::Serialize;

use seese3_core::adapter::{Adapter, EpochProgress};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{Pose, PoseError, exp, log};
use seese3_core::room::FrameId;
use seese3_core::splits::is_in_left_out_block;
use seese3_core::statistics::{Coverage, RecordedMedian, coverage, median_of_recording, quantile};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{
    FitRun, Fitted, Localizer, MotionHypotheses, MotionReader, ReadingRules, fit,
};

use super::{Error, EstimateError};

/// Which frames are mapped, and which are queried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LocalizationProtocol {
    /// Stride of the mapped frames; at least 1.
    pub map_every: usize,
    /// Whether every fifth of twenty blocks is left unmapped. Then only views of these blocks are
    /// queried.
    pub withhold_blocks: bool,
    /// The seed of the fitted adapter.
    pub seed: u64,
}

impl LocalizationProtocol {
    /// The mapped frames of a recording, in order.
    pub fn mapped(&self, frame_count: usize) -> Vec<FrameId> {
        self.frames(frame_count, |row| self.is_mapped(row, frame_count))
    }

    /// The query frames, in order; none of them is mapped.
    pub fn asked(&self, frame_count: usize) -> Vec<FrameId> {
        self.frames(frame_count, |row| {
            let is_withheld = is_in_left_out_block(row, frame_count);
            !self.is_mapped(row, frame_count) && (is_withheld || !self.withhold_blocks)
        })
    }

    fn is_mapped(&self, row: usize, frame_count: usize) -> bool {
        let is_withheld = self.withhold_blocks && is_in_left_out_block(row, frame_count);
        row.is_multiple_of(self.map_every) && !is_withheld
    }

    fn frames(&self, frame_count: usize, keep: impl Fn(usize) -> bool) -> Vec<FrameId> {
        (0..frame_count)
            .filter(|&row| keep(row))
            .map(|row| FrameId(row as u32))
            .collect()
    }
}

/// Median, with its confidence interval, and 90 % quantile of errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorQuantiles {
    /// The median, with its interval over blocks of the recording.
    #[serde(flatten)]
    pub median: RecordedMedian,
    /// The 90 % quantile.
    pub p90: f64,
}

impl ErrorQuantiles {
    /// The quantiles of errors in recording order; NaN without errors.
    pub fn of(errors: &[f64]) -> Self {
        Self {
            median: median_of_recording(errors, 0),
            p90: quantile(errors, 0.9).unwrap_or(f64::NAN),
        }
    }
}

/// Errors of estimated poses or motions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LocalizationErrors {
    /// Translation errors, meters.
    pub translation_m: ErrorQuantiles,
    /// Rotation errors, degrees.
    pub rotation_deg: ErrorQuantiles,
}

impl LocalizationErrors {
    /// The quantiles of errors in recording order.
    pub fn of(errors: &[PoseError]) -> Self {
        let column = |of: fn(&PoseError) -> f64| errors.iter().map(of).collect::<Vec<f64>>();

        Self {
            translation_m: ErrorQuantiles::of(&column(|error| error.translation_m)),
            rotation_deg: ErrorQuantiles::of(&column(|error| error.rotation_rad.to_degrees())),
        }
    }
}

/// The results in one room.
#[derive(Debug, Clone, Serialize)]
pub struct Localization {
    /// Number of query views.
    #[serde(rename = "n")]
    pub asked: usize,
    /// Number of mapped frames.
    pub mapped: usize,
    /// The poses that the product returns. With a fitted adapter, they follow the measured rules.
    /// Else they are the given adapter's full estimate relative to the nearest frame.
    pub ours: LocalizationErrors,
    /// The pose of the mapped frame with the nearest feature.
    pub nearest_frame: LocalizationErrors,
    /// The pose of the mapped frame with the nearest true pose, by meters plus radians: about the
    /// best that retrieval alone can reach.
    pub nearest_pose: LocalizationErrors,
    /// The given adapter's full estimate relative to the nearest frame.
    pub zero_shot: Option<LocalizationErrors>,
    /// The fitted adapter's full estimate, without the rules.
    pub fitted: Option<LocalizationErrors>,
    /// Scores of the rules, if an adapter was fitted.
    pub rules: Option<RuleScores>,
    /// The errors of every view, by method.
    #[serde(skip)]
    pub views: Vec<EstimateError>,
}

/// How often the rules fell back to the nearest frame, and the coverage of their covariances.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RuleScores {
    /// Fraction of views that use the nearest frame's translation unchanged.
    pub translation_unread: f64,
    /// Fraction of views that use the nearest frame's rotation unchanged.
    pub rotation_unread: f64,
    /// Fractions of errors within the 68 % and 95 % ellipsoids.
    #[serde(flatten)]
    pub coverage: Coverage,
}

/// Maps a part of a room and locates the views of the rest. With `fit_adapter`, an adapter is
/// fitted to the mapped frames only, so that no query view leaks into training. `progress` is
/// called during that training.
///
/// # Errors
/// - [`Error::Input`] without an adapter and without `fit_adapter`, or when no query view is left.
/// - [`Error::Fitting`] when the room is too small or the features do not match the adapter.
pub fn evaluate(
    data: &RoomData<'_>,
    adapter: Option<&Arc<Adapter>>,
    fit_adapter: bool,
    protocol: &LocalizationProtocol,
    progress: &(dyn Fn(EpochProgress) + Sync),
) -> Result<Localization, Error> {
    if adapter.is_none() && !fit_adapter {
        return Err(Error::Input(
            "no adapter to evaluate: pass --adapter or --fit".to_owned(),
        ));
    }

    let mapped = protocol.mapped(data.room.frame_count());
    let asked = protocol.asked(data.room.frame_count());
    if asked.is_empty() {
        return Err(Error::Input(
            "every frame is mapped, so no view is left to locate; raise --map-every".to_owned(),
        ));
    }

    let fitted = fit_adapter
        .then(|| {
            let cancel = Cancellation::default();
            let run = FitRun {
                progress,
                cancel: &cancel,
            };
            fit(data, &mapped, adapter, protocol.seed, run)
        })
        .transpose()?;
    let network = fitted.as_ref().map(|fitted| fitted.adapter.clone());
    let localizer = Localizer::new(data, &mapped, adapter.cloned(), network)?;

    let views: Vec<View<'_>> = asked
        .iter()
        .map(|frame| View::of(data, &localizer, *frame))
        .collect::<Result<_, Error>>()?;
    let mut kept = Vec::new();
    let mut keep = |method: &'static str, errors: Vec<PoseError>, squared_lengths: &[f64]| {
        let scores = LocalizationErrors::of(&errors);
        let rows = asked.iter().zip(errors).enumerate();
        kept.extend(rows.map(|(place, (&target, error))| EstimateError {
            method,
            source: None,
            target,
            error: Some(error),
            squared_length: squared_lengths.get(place).copied().unwrap_or(f64::NAN),
        }));
        scores
    };
    let by = |reader: MotionReader| errors_by(&views, &localizer, reader);

    let zero_shot = adapter.map(|_| keep("zero_shot", by(MotionReader::ZeroShot), &[]));
    let with_rules = fitted.as_ref().map(|Fitted { rules, .. }| {
        let found = by_rules(&views, &localizer, rules);
        let errors = keep("ours", found.errors, &found.squared_lengths);
        (errors, found.scores)
    });
    let nearest_frame = keep("nearest_frame", by(MotionReader::NearestFrame), &[]);
    let nearest_pose = keep(
        "nearest_pose",
        nearest_poses(&views, &mapped, data.room.poses()),
        &[],
    );
    let fitted = fitted.map(|_| keep("fitted", by(MotionReader::Fitted), &[]));

    Ok(Localization {
        asked: views.len(),
        mapped: mapped.len(),
        ours: match (&with_rules, zero_shot) {
            (Some((errors, _)), _) => *errors,
            (None, Some(zero_shot)) => zero_shot,
            (None, None) => nearest_frame,
        },
        nearest_frame,
        nearest_pose,
        zero_shot,
        fitted,
        rules: with_rules.map(|(_, scores)| scores),
        views: kept,
    })
}

/// A query view: its motion hypotheses and its true pose.
struct View<'a> {
    readings: MotionHypotheses,
    truth: &'a Pose,
}

impl<'a> View<'a> {
    fn of(data: &RoomData<'a>, localizer: &Localizer, frame: FrameId) -> Result<Self, Error> {
        let feature = data.features.rows().row(frame.row()).to_vec();
        Ok(Self {
            readings: localizer.read(&feature)?,
            truth: &data.room.poses()[frame.row()],
        })
    }
}

fn errors_by(views: &[View<'_>], localizer: &Localizer, reader: MotionReader) -> Vec<PoseError> {
    views
        .iter()
        .map(|view| {
            let motion = view.readings.by(reader).unwrap_or_default();
            let pose = localizer.pose(view.readings.nearest.frame) * exp(&motion);
            PoseError::between(view.truth, &pose)
        })
        .collect()
}

/// The answers by the rules.
struct RuledErrors {
    /// One per view.
    errors: Vec<PoseError>,
    /// Squared Mahalanobis lengths of the errors; NaN for a singular covariance.
    squared_lengths: Vec<f64>,
    scores: RuleScores,
}

fn by_rules(views: &[View<'_>], localizer: &Localizer, rules: &ReadingRules) -> RuledErrors {
    let mut errors = Vec::with_capacity(views.len());
    let mut squared_lengths = Vec::with_capacity(views.len());
    let mut translations_unread = 0;
    let mut rotations_unread = 0;

    for view in views {
        let located = localizer.located(&view.readings, rules);
        errors.push(PoseError::between(view.truth, &located.pose.pose));

        let error = log(&located.pose.pose.inv_mul(view.truth)).to_vector();
        let cholesky = located.pose.covariance.cholesky();
        squared_lengths
            .push(cholesky.map_or(f64::NAN, |cholesky| error.dot(&cholesky.solve(&error))));

        let is_unread = |reader| usize::from(reader == MotionReader::NearestFrame);
        translations_unread += is_unread(located.translation.reader);
        rotations_unread += is_unread(located.rotation.reader);
    }

    let share = |count: usize| count as f64 / views.len() as f64;
    let scores = RuleScores {
        translation_unread: share(translations_unread),
        rotation_unread: share(rotations_unread),
        coverage: coverage(&squared_lengths),
    };
    RuledErrors {
        errors,
        squared_lengths,
        scores,
    }
}

/// Errors of the mapped frames with the nearest true poses, by meters plus radians.
fn nearest_poses(views: &[View<'_>], mapped: &[FrameId], poses: &[Pose]) -> Vec<PoseError> {
    let nearest = |view: &View<'_>| {
        mapped
            .iter()
            .map(|frame| PoseError::between(view.truth, &poses[frame.row()]))
            .min_by(|a, b| {
                let apart = |error: &PoseError| error.translation_m + error.rotation_rad;
                apart(a).total_cmp(&apart(b))
            })
    };

    views.iter().filter_map(nearest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. A block of 1,000 frames has 50 frames; the third of every five blocks is
    /// withheld.
    #[test]
    fn what_is_asked_for_is_not_mapped() {
        let every_tenth = LocalizationProtocol {
            map_every: 10,
            withhold_blocks: false,
            seed: 0,
        };
        assert_eq!(every_tenth.mapped(1_000).len(), 100);
        assert_eq!(every_tenth.asked(1_000).len(), 900);

        let blocks = LocalizationProtocol {
            withhold_blocks: true,
            ..every_tenth
        };
        assert_eq!(blocks.mapped(1_000).len(), 80);
        assert_eq!(blocks.asked(1_000).len(), 200);
        assert_eq!(blocks.asked(1_000)[0], FrameId(100));
    }
}
