//! Single views located in a partly mapped room: an adapter's answers beside the simplest ones.

use std::sync::Arc;

use seese3_core::adapter::{Adapter, EpochProgress};
use seese3_core::geometry::{Pose, PoseError, exp, log};
use seese3_core::room::FrameId;
use seese3_core::splits::is_in_left_out_block;
use seese3_core::statistics::{Coverage, RecordedMedian, coverage, median_of_recording, quantile};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{Fitted, Localizer, MotionHypotheses, MotionReader, ReadingRules, fit};

use super::Error;

/// Which frames are mapped, and who is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LocalizationProtocol {
    /// Every so many frames one is mapped; at least 1.
    pub map_every: usize,
    /// Whether every fifth of twenty blocks is not mapped at all; then views of these blocks alone
    /// are asked for.
    pub withhold_blocks: bool,
    /// The seed of the fitted adapter.
    pub seed: u64,
}

impl LocalizationProtocol {
    /// The mapped frames of a recording, in order.
    pub fn mapped(&self, frame_count: usize) -> Vec<FrameId> {
        self.frames(frame_count, |row| self.is_mapped(row, frame_count))
    }

    /// The frames whose views are asked for, in order; none of them is mapped.
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

/// Median, with its interval, and 90 % quantile of errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorQuantiles {
    /// Half of the errors are at most this; its interval is that of twenty parts of the recording.
    pub median: RecordedMedian,
    /// Nine tenths of the errors are at most this.
    pub p90: f64,
}

impl ErrorQuantiles {
    /// The quantiles of these errors, in the order of the recording; NaN without any.
    pub fn of(errors: &[f64]) -> Self {
        Self {
            median: median_of_recording(errors, 0),
            p90: quantile(errors, 0.9).unwrap_or(f64::NAN),
        }
    }
}

/// How far located poses are from the true ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalizationErrors {
    /// Distances, metres.
    pub translation_m: ErrorQuantiles,
    /// Angles, degrees.
    pub rotation_deg: ErrorQuantiles,
}

impl LocalizationErrors {
    fn of(errors: &[PoseError]) -> Self {
        let metres: Vec<f64> = errors.iter().map(|error| error.translation_m).collect();
        let degrees: Vec<f64> = errors
            .iter()
            .map(|error| error.rotation_rad.to_degrees())
            .collect();

        Self {
            translation_m: ErrorQuantiles::of(&metres),
            rotation_deg: ErrorQuantiles::of(&degrees),
        }
    }
}

/// The results in one room.
#[derive(Debug, Clone)]
pub struct Localization {
    /// How many views were located.
    pub asked: usize,
    /// How many frames were mapped.
    pub mapped: usize,
    /// What the product answers: by the measured rules where an adapter was fitted, else the given
    /// adapter's reading from the nearest frame.
    pub ours: LocalizationErrors,
    /// The pose of the mapped frame whose feature is nearest.
    pub nearest_frame: LocalizationErrors,
    /// The pose of the mapped frame that is truly nearest, by metres plus radians: about what
    /// retrieval alone can reach.
    pub nearest_pose: LocalizationErrors,
    /// The given adapter's whole reading from the nearest frame.
    pub zero_shot: Option<LocalizationErrors>,
    /// The fitted adapter's whole reading, without the rules.
    pub fitted: Option<LocalizationErrors>,
    /// What holds of the answers by the rules, where an adapter was fitted.
    pub rules: Option<RuleScores>,
}

/// How the rules of a fitted adapter were used, and whether their covariances hold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RuleScores {
    /// The share of views whose translation was the nearest frame's own.
    pub translation_unread: f64,
    /// The share of views whose rotation was the nearest frame's own.
    pub rotation_unread: f64,
    /// The shares of errors within the 68 % and 95 % ellipsoids.
    pub coverage: Coverage,
}

/// Maps a part of a room and locates the views of the other part. With `fit_adapter` an adapter is
/// fitted to the mapped frames alone, so that nothing leaks. `progress` hears of its training.
///
/// # Errors
/// [`Error::Input`] when neither an adapter is given nor one is to be fitted, or no view is left to
/// ask for; [`Error::Fitting`] when the room is too small or the features are not the adapter's.
pub fn evaluate(
    data: &RoomData<'_>,
    adapter: Option<&Arc<Adapter>>,
    fit_adapter: bool,
    protocol: &LocalizationProtocol,
    progress: &(dyn Fn(EpochProgress) + Sync),
) -> Result<Localization, Error> {
    if adapter.is_none() && !fit_adapter {
        return Err(Error::Input(
            "nothing is to be evaluated: give --adapter, or --fit".to_owned(),
        ));
    }

    let mapped = protocol.mapped(data.room.frame_count());
    let asked = protocol.asked(data.room.frame_count());
    if asked.is_empty() {
        return Err(Error::Input(
            "every frame is mapped, so that no view is left to locate; raise --map-every"
                .to_owned(),
        ));
    }

    let fitted = fit_adapter
        .then(|| fit(data, &mapped, adapter, protocol.seed, progress))
        .transpose()?;
    let network = fitted.as_ref().map(|fitted| fitted.adapter.clone());
    let localizer = Localizer::new(data, &mapped, adapter.cloned(), network)?;

    let views: Vec<View<'_>> = asked
        .iter()
        .map(|frame| View::of(data, &localizer, *frame))
        .collect::<Result<_, Error>>()?;
    let by = |reader: MotionReader| errors_by(&views, &localizer, reader);

    let zero_shot = adapter.map(|_| by(MotionReader::ZeroShot));
    let with_rules = fitted
        .as_ref()
        .map(|Fitted { rules, .. }| by_rules(&views, &localizer, rules));
    let nearest_frame = by(MotionReader::NearestFrame);

    Ok(Localization {
        asked: views.len(),
        mapped: mapped.len(),
        ours: match (&with_rules, zero_shot) {
            (Some((errors, _)), _) => *errors,
            (None, Some(zero_shot)) => zero_shot,
            (None, None) => nearest_frame,
        },
        nearest_frame,
        nearest_pose: nearest_poses(&views, &mapped, data.room.poses()),
        zero_shot,
        fitted: fitted.as_ref().map(|_| by(MotionReader::Fitted)),
        rules: with_rules.map(|(_, scores)| scores),
    })
}

/// A view that is asked for: what the readers say of it, and where its camera truly was.
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

fn errors_by(
    views: &[View<'_>],
    localizer: &Localizer,
    reader: MotionReader,
) -> LocalizationErrors {
    let errors: Vec<PoseError> = views
        .iter()
        .map(|view| {
            let motion = view.readings.by(reader).unwrap_or_default();
            let pose = localizer.pose(view.readings.nearest.frame) * exp(&motion);
            PoseError::between(view.truth, &pose)
        })
        .collect();

    LocalizationErrors::of(&errors)
}

fn by_rules(
    views: &[View<'_>],
    localizer: &Localizer,
    rules: &ReadingRules,
) -> (LocalizationErrors, RuleScores) {
    let mut errors = Vec::with_capacity(views.len());
    let mut squared_lengths = Vec::with_capacity(views.len());
    let mut translations_unread = 0;
    let mut rotations_unread = 0;

    for view in views {
        let located = localizer.located(&view.readings, rules);
        errors.push(PoseError::between(view.truth, &located.pose.pose));

        let error = log(&located.pose.pose.inv_mul(view.truth)).to_vector();
        let cholesky = located.pose.covariance.cholesky();
        squared_lengths.extend(cholesky.map(|cholesky| error.dot(&cholesky.solve(&error))));

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
    (LocalizationErrors::of(&errors), scores)
}

/// The errors of the mapped frames that are truly nearest, metres and radians alike.
fn nearest_poses(views: &[View<'_>], mapped: &[FrameId], poses: &[Pose]) -> LocalizationErrors {
    let nearest = |view: &View<'_>| {
        mapped
            .iter()
            .map(|frame| PoseError::between(view.truth, &poses[frame.row()]))
            .min_by(|a, b| {
                let apart = |error: &PoseError| error.translation_m + error.rotation_rad;
                apart(a).total_cmp(&apart(b))
            })
    };

    let errors: Vec<PoseError> = views.iter().filter_map(nearest).collect();
    LocalizationErrors::of(&errors)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Blocks of 1,000 frames have 50; the third of every five is withheld.
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
