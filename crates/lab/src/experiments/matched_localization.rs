//! Evaluates matched views: maps a part of a room's frames with their keypoints, and locates the
//! views of the others. Beside it, in the same run, the baselines of retrieval.

use std::collections::BTreeMap;

use nalgebra::{Quaternion, UnitQuaternion, Vector3, Vector4};
use ndarray::{Array2, ArrayView1, ArrayView2};
use rayon::prelude::*;
use serde::Serialize;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use seese3_core::geometry::{CameraIntrinsics, Pose, PoseError, Twist, exp, log};
use seese3_core::keypoints::Keypoints;
use seese3_core::room::FrameId;
use seese3_core::statistics::{
    Coverage, RecordedMedian, coverage, median_of_recording, root_mean_square,
};
use seese3_robot::localization::{KeypointRoom, LocatedView, NotLocated};
use seese3_robot::matched_views::{Mapping, MappingParameters, ViewKeypoints};

use super::localization::LocalizationErrors;
use super::{Error, EstimateError};

/// A view is near the map if a mapped view is within these meters and radians of it.
const NEAR_M: f64 = 0.25;
const NEAR_RAD: f64 = 0.261_8;
/// An answered pose is wrong beyond these meters or radians.
const WRONG_M: f64 = 0.2;
const WRONG_RAD: f64 = 0.174_5;
/// Largest error of a predicted pose along each axis, meters, and about it, radians.
const PREDICTION_M: f64 = 0.03;
const PREDICTION_RAD: f64 = 0.034_9;
/// Seed of the errors of predicted poses.
const PREDICTION_SEED: u64 = 1;
/// Number of blended frames.
const BLENDED: usize = 3;

/// The views of a recording. All slices have one entry per frame.
#[derive(Debug, Clone, Copy)]
pub struct PosedRecording<'a> {
    /// `world_from_camera`.
    pub poses: &'a [Pose],
    /// Keypoints.
    pub keypoints: &'a [Keypoints],
    /// The camera.
    pub camera: CameraIntrinsics,
}

/// The localization of the views of one part of a hold-out.
#[derive(Debug, Clone, Serialize)]
pub struct MatchedPart {
    /// Number of views.
    pub n: usize,
    /// Matched views.
    pub ours: Answered,
    /// Matched views that are looked for near a predicted pose, as while tracking: the true pose
    /// with a drawn error of at most 0.03 m and 2° along each axis.
    pub near_prediction: Answered,
    /// Matched views where they answer, elsewhere the most similar frame.
    pub ours_or_nearest: LocalizationErrors,
    /// The pose of the mapped frame with the most similar feature.
    pub nearest_frame: LocalizationErrors,
    /// Weighted mean of the three most similar frames.
    pub blend: LocalizationErrors,
    /// Comparison with a peer; absent if it was asked for none of these views.
    pub peer: Option<PeerComparison>,
}

/// Matched views and a peer, on the views that the peer was asked for.
#[derive(Debug, Clone, Serialize)]
pub struct PeerComparison {
    /// Number of views.
    pub n: usize,
    /// The answers of the peer.
    #[serde(flatten)]
    pub peer: Answered,
    /// Matched views.
    pub ours: Answered,
    /// Comparison on the views that both answer; absent without any.
    pub both: Option<PairedErrors>,
}

/// Errors of matched views and of a peer on the same views.
#[derive(Debug, Clone, Serialize)]
pub struct PairedErrors {
    /// Number of views.
    pub n: usize,
    /// Matched views.
    pub ours: LocalizationErrors,
    /// The peer.
    pub peer: LocalizationErrors,
    /// Our translation error minus the peer's, meters: the median over the views.
    pub difference_m: RecordedMedian,
    /// Share of the views with the smaller translation error by matched views.
    pub ours_nearer: f64,
}

/// Errors of the answered views.
#[derive(Debug, Clone, Serialize)]
pub struct Answered {
    /// Share of the views that are answered.
    pub answered: f64,
    /// Errors of the answered views.
    #[serde(flatten)]
    pub errors: LocalizationErrors,
    /// Root mean square of their translation errors, meters.
    pub rmse_m: f64,
    /// Share of the answers that are more than 0.2 m or 10° off.
    pub wrong: f64,
    /// Shares of the errors within the 68 % and 95 % ellipsoids; absent for a peer, which states no
    /// covariance.
    #[serde(flatten)]
    pub coverage: Option<Coverage>,
}

/// The localization of a room's held-out views.
#[derive(Debug, Clone, Serialize)]
pub struct MatchedLocalization {
    /// Number of mapped frames.
    pub mapped: usize,
    /// All views.
    #[serde(flatten)]
    pub all: MatchedPart,
    /// Views with a mapped view within 0.25 m and 15°; absent without any.
    pub near: Option<MatchedPart>,
    /// The other views; absent without any.
    pub far: Option<MatchedPart>,
    /// Median time to match a view and estimate its pose, milliseconds on one core; without the
    /// encoder.
    pub match_ms: f64,
    /// The errors of every view, by method.
    #[serde(skip)]
    pub views: Vec<EstimateError>,
}

/// Which frames are mapped and which are asked for.
#[derive(Debug, Clone, Copy)]
pub struct MappedAndAsked<'a> {
    /// Mapped frames.
    pub mapped: &'a [FrameId],
    /// Query frames; none of them is mapped.
    pub asked: &'a [FrameId],
    /// Answers of a peer to some of the query frames; empty without a peer.
    pub peer: &'a [PeerAnswer],
}

/// A peer's answer to a query frame.
#[derive(Debug, Clone, Copy)]
pub struct PeerAnswer {
    /// The query frame.
    pub frame: FrameId,
    /// `world_from_camera`, meters; `None` if the peer refused the view.
    pub pose: Option<Pose>,
}

/// A located or refused view.
struct View {
    frame: FrameId,
    truth: Pose,
    located: Result<Located, NotLocated>,
    near_prediction: Result<Located, NotLocated>,
    nearest: Pose,
    blend: Pose,
    is_near: bool,
    seconds: f64,
}

struct Located {
    pose: Pose,
    /// Squared Mahalanobis length of the error.
    squared_length: f64,
}

/// Maps the mapped frames of a recording and locates the asked ones, on the threads of the calling
/// rayon pool. The baselines retrieve frames by `features`, shape (n, d). `clock` gives seconds;
/// `done` is called after each view.
///
/// # Errors
/// [`Error::Input`] if no frame is mapped or asked for, if no mapped frame has a keypoint, or if a
/// peer answers a frame that is not asked for.
pub fn evaluate(
    recording: PosedRecording<'_>,
    features: ArrayView2<'_, f32>,
    frames: MappedAndAsked<'_>,
    clock: &(dyn Fn() -> f64 + Sync),
    done: &(dyn Fn() + Sync),
) -> Result<MatchedLocalization, Error> {
    let MappedAndAsked {
        mapped,
        asked,
        peer,
    } = frames;
    if mapped.is_empty() || asked.is_empty() {
        return Err(Error::Input(format!(
            "{} frames are mapped and {} asked for; both must be above 0",
            mapped.len(),
            asked.len()
        )));
    }
    if let Some(answer) = peer.iter().find(|answer| !asked.contains(&answer.frame)) {
        return Err(Error::Input(format!(
            "the peer answers frame {}, which is not asked for",
            answer.frame.row()
        )));
    }

    let room = mapped_room(recording, mapped)?;
    let baselines = Baselines::new(recording.poses, features, mapped);
    let views: Vec<View> = asked
        .par_iter()
        .map(|frame| {
            let view = located(recording, &room, &baselines, *frame, clock);
            done();
            view
        })
        .collect();

    let answers: BTreeMap<FrameId, Option<Pose>> = peer
        .iter()
        .map(|answer| (answer.frame, answer.pose))
        .collect();
    let part = |keep: &dyn Fn(&View) -> bool| {
        let kept: Vec<&View> = views.iter().filter(|view| keep(view)).collect();
        (!kept.is_empty()).then(|| part_of(&kept, &answers))
    };
    let seconds: Vec<f64> = views.iter().map(|view| view.seconds).collect();
    let whole: Vec<&View> = views.iter().collect();
    Ok(MatchedLocalization {
        mapped: mapped.len(),
        all: part_of(&whole, &answers),
        near: part(&|view| view.is_near),
        far: part(&|view| !view.is_near),
        match_ms: 1e3 * seese3_core::statistics::median(&seconds),
        views: views
            .iter()
            .flat_map(|view| view.errors(&answers))
            .collect(),
    })
}

/// The room of the mapped frames alone, as `seese3 encode` would map it.
pub(super) fn mapped_room(
    recording: PosedRecording<'_>,
    mapped: &[FrameId],
) -> Result<KeypointRoom, Error> {
    let rows: Vec<usize> = mapped.iter().map(|frame| frame.row()).collect();
    let poses: Vec<Pose> = rows.iter().map(|&row| recording.poses[row]).collect();
    let keypoints: Vec<Keypoints> = rows
        .iter()
        .map(|&row| recording.keypoints[row].clone())
        .collect();

    let mapping = Mapping::new(
        &poses,
        &keypoints,
        recording.camera,
        MappingParameters::default(),
    );
    let mapping = mapping.map_err(|error| Error::Input(error.to_string()))?;
    let mut map = mapping.map(&|| ());
    map.measure_noise(&mapping);
    Ok(KeypointRoom::new(poses, map.into()))
}

fn located(
    recording: PosedRecording<'_>,
    room: &KeypointRoom,
    baselines: &Baselines<'_>,
    frame: FrameId,
    clock: &(dyn Fn() -> f64 + Sync),
) -> View {
    let row = frame.row();
    let truth = recording.poses[row];
    let view = ViewKeypoints {
        keypoints: &recording.keypoints[row],
        camera: &recording.camera,
    };
    let begun = clock();
    let located = room.locate(view);
    let seconds = clock() - begun;

    let is_near = baselines.poses.iter().any(|pose| {
        let error = PoseError::between(&truth, pose);
        error.translation_m <= NEAR_M && error.rotation_rad <= NEAR_RAD
    });
    let judged = |found: LocatedView| {
        let error = log(&found.pose.pose.inv_mul(&truth)).to_vector();
        let solved = found
            .pose
            .covariance
            .cholesky()
            .map(|cholesky| error.dot(&cholesky.solve(&error)));
        Located {
            pose: found.pose.pose,
            squared_length: solved.unwrap_or(f64::INFINITY),
        }
    };

    let (nearest, blend) = baselines.poses_of(row);
    View {
        frame,
        truth,
        located: located.map(judged),
        near_prediction: room.locate_near(view, &predicted(&truth, row)).map(judged),
        nearest,
        blend,
        is_near,
        seconds,
    }
}

/// A pose with the error of a prediction.
fn predicted(truth: &Pose, row: usize) -> Pose {
    let mut rng = ChaCha8Rng::seed_from_u64(PREDICTION_SEED);
    rng.set_stream(row as u64);
    let mut draw = |most: f64| Vector3::from_fn(|_, _| rng.random_range(-most..=most));
    let (linear, angular) = (draw(PREDICTION_M), draw(PREDICTION_RAD));
    truth * exp(&Twist { linear, angular })
}

/// Poses of the mapped frames with the most similar features.
pub(super) struct Baselines<'a> {
    /// `world_from_camera` of the mapped frames.
    poses: Vec<Pose>,
    /// Features of all frames, scaled to unit length.
    features: Array2<f32>,
    mapped: &'a [FrameId],
}

impl<'a> Baselines<'a> {
    pub(super) fn new(
        poses: &[Pose],
        features: ArrayView2<'_, f32>,
        mapped: &'a [FrameId],
    ) -> Self {
        let mut features = features.to_owned();
        for mut row in features.rows_mut() {
            let length = row.dot(&row).sqrt().max(1e-12);
            row /= length;
        }

        Self {
            poses: mapped.iter().map(|frame| poses[frame.row()]).collect(),
            features,
            mapped,
        }
    }

    /// The pose of the most similar mapped frame, and the mean of the three most similar ones,
    /// weighted by the inverse fourth power of the distance between unit features.
    pub(super) fn poses_of(&self, row: usize) -> (Pose, Pose) {
        self.poses_for(self.features.row(row))
    }

    /// The same for a view with this feature, of any length.
    pub(super) fn poses_for(&self, feature: ArrayView1<'_, f32>) -> (Pose, Pose) {
        let length = feature.dot(&feature).sqrt().max(1e-12);
        let view = feature.mapv(|value| value / length);
        let mut similar: Vec<(f64, &Pose)> = self
            .mapped
            .iter()
            .zip(&self.poses)
            .map(|(frame, pose)| (f64::from(self.features.row(frame.row()).dot(&view)), pose))
            .collect();
        similar.sort_by(|a, b| b.0.total_cmp(&a.0));
        similar.truncate(BLENDED);

        let weights: Vec<f64> = similar
            .iter()
            .map(|(cosine, _)| (2.0 - 2.0 * cosine).max(1e-8).powi(-2))
            .collect();
        let sum: f64 = weights.iter().sum();

        let nearest = *similar[0].1;
        let mut position = Vector3::zeros();
        let mut rotation = Vector4::zeros();
        for ((_, pose), weight) in similar.iter().zip(&weights) {
            position += pose.translation.vector * (weight / sum);
            // Quaternions of one hemisphere, so that they add up.
            let coordinates = pose.rotation.into_inner().coords;
            let sign = coordinates
                .dot(&nearest.rotation.into_inner().coords)
                .signum();
            rotation += coordinates * (weight * sign);
        }

        let rotation = UnitQuaternion::from_quaternion(Quaternion::from(rotation));
        (nearest, Pose::from_parts(position.into(), rotation))
    }
}

fn part_of(views: &[&View], peer: &BTreeMap<FrameId, Option<Pose>>) -> MatchedPart {
    let errors_of = |pose: &dyn Fn(&View) -> Pose| {
        let errors: Vec<PoseError> = views.iter().map(|view| view.error(&pose(view))).collect();
        LocalizationErrors::of(&errors)
    };

    MatchedPart {
        n: views.len(),
        ours: ours(views, &|view| &view.located),
        near_prediction: ours(views, &|view| &view.near_prediction),
        ours_or_nearest: errors_of(&|view| match &view.located {
            Ok(located) => located.pose,
            Err(_) => view.nearest,
        }),
        nearest_frame: errors_of(&|view| view.nearest),
        blend: errors_of(&|view| view.blend),
        peer: comparison(views, peer),
    }
}

/// The answers of matched views.
fn ours(views: &[&View], of: &dyn Fn(&View) -> &Result<Located, NotLocated>) -> Answered {
    let located = || {
        views
            .iter()
            .filter_map(|view| Some((view, of(view).as_ref().ok()?)))
    };
    let squared_lengths: Vec<f64> = located().map(|(_, found)| found.squared_length).collect();
    let errors: Vec<PoseError> = located()
        .map(|(view, found)| view.error(&found.pose))
        .collect();
    Answered {
        coverage: Some(coverage(&squared_lengths)),
        ..Answered::of(&errors, views.len())
    }
}

/// Matched views and the peer, on the views that the peer was asked for.
fn comparison(views: &[&View], peer: &BTreeMap<FrameId, Option<Pose>>) -> Option<PeerComparison> {
    let mut asked = Vec::new();
    let mut errors = Vec::new();
    let mut both = Vec::new();
    for view in views {
        let Some(answer) = peer.get(&view.frame) else {
            continue;
        };
        asked.push(*view);

        let error = answer.map(|pose| view.error(&pose));
        errors.extend(error);
        both.extend(view.our_error().zip(error));
    }

    (!asked.is_empty()).then(|| PeerComparison {
        n: asked.len(),
        peer: Answered::of(&errors, asked.len()),
        ours: ours(&asked, &|view| &view.located),
        both: PairedErrors::of(&both),
    })
}

impl View {
    /// The errors of every method on this view; of the peer, if it was asked for it.
    fn errors(&self, peer: &BTreeMap<FrameId, Option<Pose>>) -> Vec<EstimateError> {
        let of = |method, pose: Option<Pose>, squared_length| EstimateError {
            method,
            source: None,
            target: self.frame,
            error: pose.map(|pose| self.error(&pose)),
            squared_length,
        };
        let located = |method, found: &Result<Located, NotLocated>| match found {
            Ok(found) => of(method, Some(found.pose), found.squared_length),
            Err(_) => of(method, None, f64::NAN),
        };

        let mut errors = vec![
            located("ours", &self.located),
            located("near_prediction", &self.near_prediction),
            of("nearest_frame", Some(self.nearest), f64::NAN),
            of("blend", Some(self.blend), f64::NAN),
        ];
        if let Some(answer) = peer.get(&self.frame) {
            errors.push(of("peer", *answer, f64::NAN));
        }
        errors
    }

    fn error(&self, pose: &Pose) -> PoseError {
        PoseError::between(&self.truth, pose)
    }

    /// The error of matched views, if they answer.
    fn our_error(&self) -> Option<PoseError> {
        let located = self.located.as_ref().ok()?;
        Some(self.error(&located.pose))
    }
}

impl Answered {
    /// Scores of the answers to `asked` views, in recording order, without a coverage.
    fn of(errors: &[PoseError], asked: usize) -> Self {
        let lengths: Vec<f64> = errors.iter().map(|error| error.translation_m).collect();
        let wrong = errors
            .iter()
            .filter(|error| error.translation_m > WRONG_M || error.rotation_rad > WRONG_RAD)
            .count();

        Self {
            answered: errors.len() as f64 / asked as f64,
            errors: LocalizationErrors::of(errors),
            rmse_m: root_mean_square(&lengths),
            wrong: wrong as f64 / errors.len().max(1) as f64,
            coverage: None,
        }
    }
}

impl PairedErrors {
    /// Compares our errors with the peer's, in recording order; `None` without any.
    fn of(pairs: &[(PoseError, PoseError)]) -> Option<Self> {
        if pairs.is_empty() {
            return None;
        }

        let (ours, peer): (Vec<PoseError>, Vec<PoseError>) = pairs.iter().copied().unzip();
        let differences: Vec<f64> = pairs
            .iter()
            .map(|(ours, peer)| ours.translation_m - peer.translation_m)
            .collect();
        let nearer = differences.iter().filter(|&&meters| meters < 0.0).count();

        Some(Self {
            n: pairs.len(),
            ours: LocalizationErrors::of(&ours),
            peer: LocalizationErrors::of(&peer),
            difference_m: median_of_recording(&differences, 0),
            ours_nearer: nearer as f64 / pairs.len() as f64,
        })
    }
}
