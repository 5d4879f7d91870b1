//! Wire types to domain types and back. Everything that enters is checked here, and named by its field.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::Error;
use super::snapshot::{ServedNavigator, Snapshot};
use crate::eval::{NavigatorKind, Prediction, RetrievalScores, Row, check_thresholds, default_thresholds};
use crate::features::FeatureSource;
use crate::geometry::{Pose, Twist};
use crate::navigation::{
    AnswerStep, Displacement, Hit, MAX_TRANSLATION_M, Mode, Query, Reading, Source, SourceAt, StepError,
};
use crate::pairs::{Pair, Split};
use crate::proto::v1 as pb;
use crate::room::{FrameId, Room};
use crate::scores::{MotionScores, Rate};
use crate::store::StoredAdapter;

/// How far from 1 a quaternion's norm may be.
const QUATERNION_TOLERANCE: f64 = 1e-3;
/// The child frame of every pose.
const CAMERA: &str = "camera";

/// The world frame of a room.
pub fn world_frame(room: &str) -> String {
    format!("rooms/{room}")
}

fn vector(field: &str, vector: Option<pb::Vector3>) -> Result<Vector3<f64>, Error> {
    let pb::Vector3 { x, y, z } = vector.ok_or_else(|| Error::invalid(field, "is required"))?;
    if [x, y, z].iter().all(|value| value.is_finite()) {
        Ok(Vector3::new(x, y, z))
    } else {
        Err(Error::invalid(field, format!("({x}, {y}, {z}) must be finite")))
    }
}

pub fn twist(twist: pb::Twist) -> Result<Twist, Error> {
    let pb::Twist { linear, angular } = twist;
    Ok(Twist { linear: vector("linear", linear)?, angular: vector("angular", angular)? })
}

/// A pose in the world of a room.
///
/// # Errors
/// [`Error::Invalid`] when a part is missing, is not finite, is no rotation, or names other frames.
pub fn pose(pose: pb::Pose, room: &str) -> Result<Pose, Error> {
    let pb::Pose { parent_frame, child_frame, position, orientation } = pose;
    let world = world_frame(room);
    if !parent_frame.is_empty() && parent_frame != world {
        return Err(Error::invalid("parent_frame", format!("'{parent_frame}' is not the room's world, '{world}'")));
    }
    if !child_frame.is_empty() && child_frame != CAMERA {
        return Err(Error::invalid("child_frame", format!("'{child_frame}' is not '{CAMERA}'")));
    }
    let pb::Quaternion { w, x, y, z } = orientation.ok_or_else(|| Error::invalid("orientation", "is required"))?;
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    if norm.is_nan() || (norm - 1.0).abs() > QUATERNION_TOLERANCE {
        return Err(Error::invalid("orientation", format!("has norm {norm}, a rotation has 1")));
    }
    let position = vector("position", position)?;
    if position.norm() > MAX_TRANSLATION_M {
        return Err(Error::invalid("position", format!("is over {MAX_TRANSLATION_M:e} m from the origin")));
    }
    Ok(Pose::from_parts(position.into(), UnitQuaternion::from_quaternion(quaternion)))
}

/// What a camera saw, or a frame, for an adapter; `field` is the view's name in its request.
pub fn source(
    field: &str,
    view: Option<pb::View>,
    adapter: &StoredAdapter,
    snapshot: &Snapshot,
) -> Result<Source, Error> {
    match view.and_then(|view| view.view) {
        Some(pb::view::View::FrameId(frame)) => Ok(Source::Frame(FrameId(frame))),
        Some(pb::view::View::Feature(pb::Feature { values, source_name })) => {
            let own = &adapter.adapter.source().name;
            if !source_name.is_empty() && source_name != *own {
                let problem = format!("'{source_name}' is not '{own}', which the adapter was trained on");
                return Err(Error::invalid(format!("{field}.feature.source_name"), problem));
            }
            Ok(Source::Feature(values))
        }
        Some(pb::view::View::Latent(pb::Latent { values })) => Ok(Source::Latent(values)),
        Some(pb::view::View::Image(image)) => {
            Ok(Source::Feature(snapshot.eye(adapter)?.feature(&format!("{field}.image"), &image)?))
        }
        None => Err(Error::invalid(field, "is required: a frame_id, a feature, a latent or an image")),
    }
}

fn displacement(displacement: Option<pb::Displacement>, room: &str) -> Result<Displacement, Error> {
    use pb::displacement::Displacement as Wire;
    let wire = displacement.and_then(|displacement| displacement.displacement);
    match wire.ok_or_else(|| Error::invalid("displacement", "is required: a twist, a target or twists"))? {
        Wire::Twist(given) => {
            let given = twist(given).map_err(|error| error.within("displacement.twist"))?;
            Ok(Displacement::Twists(vec![given]))
        }
        Wire::TargetFrameId(frame) => Ok(Displacement::TargetFrame(FrameId(frame))),
        Wire::TargetPose(target) => {
            let target = pose(target, room).map_err(|error| error.within("displacement.target_pose"))?;
            Ok(Displacement::TargetPose(target))
        }
        Wire::Twists(pb::TwistList { twists }) => {
            let numbered = twists.into_iter().enumerate();
            let each = |(position, given)| {
                twist(given).map_err(|error| error.within(&format!("displacement.twists[{position}]")))
            };
            Ok(Displacement::Twists(numbered.map(each).collect::<Result<_, _>>()?))
        }
    }
}

/// A question and the thresholds it is to be judged by.
pub fn query(
    request: pb::NavigateRequest,
    adapter: &StoredAdapter,
    snapshot: &Snapshot,
) -> Result<(Query, Vec<f64>), Error> {
    // Destructured with no `..`, so that a new field breaks the build here.
    let pb::NavigateRequest {
        room,
        adapter: _,
        source: view,
        source_pose,
        displacement: wanted,
        steps,
        mode,
        reading,
        hit_count,
        exclude_source,
        exclude_radius,
        thresholds: given_thresholds,
    } = request;
    let displacement = displacement(wanted, &room)?;
    let thresholds = thresholds(given_thresholds)?;
    // Last, since an image is costly.
    let source = source("source", view, adapter, snapshot)?;
    if source_pose.is_some() && matches!(source, Source::Frame(_)) {
        return Err(Error::invalid("source_pose", "is not to be given with a frame, whose pose the room knows"));
    }
    let known = source_pose.map(|given| pose(given, &room).map_err(|error| error.within("source_pose"))).transpose()?;
    let query = Query {
        source: SourceAt { source, pose: known },
        displacement,
        steps: steps.unwrap_or(1),
        mode: mode_of(mode)?,
        reading: reading_of(reading)?,
        hit_count: hit_count.unwrap_or(1),
        exclude_source: exclusion(exclude_source, exclude_radius)?,
    };
    Ok((query, thresholds))
}

fn mode_of(mode: i32) -> Result<Mode, Error> {
    match pb::Mode::try_from(mode) {
        Ok(pb::Mode::Unspecified | pb::Mode::OpenLoop) => Ok(Mode::OpenLoop),
        Ok(pb::Mode::Snap) => Ok(Mode::Snap),
        Ok(pb::Mode::ClosedLoop) => Ok(Mode::ClosedLoop),
        Err(_) => Err(Error::invalid("mode", format!("{mode} is not known to this server"))),
    }
}

fn reading_of(reading: i32) -> Result<Reading, Error> {
    match pb::Reading::try_from(reading) {
        Ok(pb::Reading::Unspecified | pb::Reading::Homogeneous) => Ok(Reading::Homogeneous),
        Ok(pb::Reading::Affine) => Ok(Reading::Affine),
        Ok(pb::Reading::Literal) => Ok(Reading::Literal),
        Err(_) => Err(Error::invalid("reading", format!("{reading} is not known to this server"))),
    }
}

/// How many rows to each side of the source are excluded, none if it is not.
pub fn exclusion(exclude_source: bool, exclude_radius: u32) -> Result<Option<u32>, Error> {
    match (exclude_source, exclude_radius) {
        (true, radius) => Ok(Some(radius)),
        (false, 0) => Ok(None),
        (false, _) => Err(Error::invalid("exclude_radius", "means nothing without exclude_source")),
    }
}

/// Thresholds as given, or the paper's.
pub fn thresholds(given: Vec<f64>) -> Result<Vec<f64>, Error> {
    let thresholds = if given.is_empty() { default_thresholds() } else { given };
    check_thresholds(&thresholds)?;
    Ok(thresholds)
}

/// The split of a name, none if the name is empty.
pub fn split(name: &str) -> Result<Option<Split>, Error> {
    match Split::from_name(name) {
        Some(split) => Ok(Some(split)),
        None if name.is_empty() => Ok(None),
        None => {
            let known = Split::ALL.map(Split::name).join(", ");
            Err(Error::invalid("split", format!("'{name}' is none of {known}")))
        }
    }
}

/// Rows of the table by name, all if there is none.
pub fn navigators(names: &[String]) -> Result<Vec<NavigatorKind>, Error> {
    if names.is_empty() {
        return Ok(NavigatorKind::ALL.to_vec());
    }
    let twice = |(position, name): (usize, &String)| names[..position].contains(name);
    if names.len() > NavigatorKind::ALL.len() || names.iter().enumerate().any(twice) {
        return Err(Error::invalid("navigators", "names a navigator twice"));
    }
    let kind = |name: &String| {
        NavigatorKind::from_name(name).ok_or_else(|| {
            let known: Vec<&str> = NavigatorKind::ALL.iter().map(|kind| kind.name()).collect();
            Error::invalid("navigators", format!("'{name}' is not one of {}", known.join(", ")))
        })
    };
    names.iter().map(kind).collect()
}

pub fn prediction(position: usize, given: pb::Prediction) -> Result<(Pair, Prediction), Error> {
    let pb::Prediction { source_frame_id, target_frame_id, prediction } = given;
    let pair = Pair { source: FrameId(source_frame_id), target: FrameId(target_frame_id) };
    match prediction {
        Some(pb::prediction::Prediction::Latent(pb::Latent { values })) => Ok((pair, Prediction::Latent(values))),
        Some(pb::prediction::Prediction::RetrievedFrameId(frame)) => Ok((pair, Prediction::Frame(FrameId(frame)))),
        None => Err(Error::invalid(format!("predictions[{position}]"), "needs a latent or a retrieved_frame_id")),
    }
}

pub fn vector_to_wire(vector: &Vector3<f64>) -> pb::Vector3 {
    pb::Vector3 { x: vector.x, y: vector.y, z: vector.z }
}

pub fn twist_to_wire(twist: &Twist) -> pb::Twist {
    pb::Twist { linear: Some(vector_to_wire(&twist.linear)), angular: Some(vector_to_wire(&twist.angular)) }
}

pub fn pose_to_wire(pose: &Pose, room: &str) -> pb::Pose {
    let q = pose.rotation.quaternion();
    pb::Pose {
        parent_frame: world_frame(room),
        child_frame: CAMERA.to_owned(),
        position: Some(vector_to_wire(&pose.translation.vector)),
        orientation: Some(pb::Quaternion { w: q.w, x: q.i, y: q.j, z: q.k }),
    }
}

pub fn hit_to_wire(hit: &Hit, room: &Room) -> pb::Hit {
    let frame = hit.neighbour.frame;
    pb::Hit {
        frame_id: frame.0,
        distance: hit.neighbour.distance,
        pose: Some(pose_to_wire(&hit.pose, room.id().as_str())),
        frame_name: room.frame_names().get(frame.row()).cloned().unwrap_or_default(),
        timestamp_ns: room.timestamps_ns().get(frame.row()).copied(),
    }
}

pub fn step_to_wire(number: usize, step: &AnswerStep, room: &Room, thresholds: &[f64]) -> pb::NavigationStep {
    pb::NavigationStep {
        step: number as u32,
        hits: step.hits.iter().map(|hit| hit_to_wire(hit, room)).collect(),
        requested_pose: step.requested_pose.map(|pose| pose_to_wire(&pose, room.id().as_str())),
        error: step.error.map(|error| error_to_wire(&error, thresholds)),
        latent: Some(pb::Latent { values: step.latent.to_vec() }),
    }
}

pub fn error_to_wire(error: &StepError, thresholds: &[f64]) -> pb::PoseError {
    pb::PoseError {
        translation_m: error.pose.translation_m,
        rotation_rad: error.pose.rotation_rad,
        twist_norm: error.twist,
        hits: thresholds
            .iter()
            .map(|&threshold| pb::ThresholdHit { threshold, hit: error.twist < threshold })
            .collect(),
    }
}

pub fn mode_to_wire(mode: Mode) -> pb::Mode {
    match mode {
        Mode::OpenLoop => pb::Mode::OpenLoop,
        Mode::Snap => pb::Mode::Snap,
        Mode::ClosedLoop => pb::Mode::ClosedLoop,
    }
}

pub fn reading_to_wire(reading: Reading) -> pb::Reading {
    match reading {
        Reading::Affine => pb::Reading::Affine,
        Reading::Homogeneous => pb::Reading::Homogeneous,
        Reading::Literal => pb::Reading::Literal,
    }
}

pub fn room_revision(navigator: &ServedNavigator) -> pb::Revision {
    pb::Revision { name: navigator.navigator.room().id().to_string(), revision: navigator.room_revision }
}

pub fn adapter_revision(navigator: &ServedNavigator) -> pb::Revision {
    pb::Revision { name: navigator.adapter.name.clone(), revision: navigator.adapter.revision }
}

pub fn source_to_wire(source: &FeatureSource) -> pb::FeatureSource {
    let FeatureSource { name, encoder, layer, base, norm, pooling, preprocess, dim } = source.clone();
    pb::FeatureSource { name, encoder, layer, pooling, preprocess, dim: dim as u32, base, norm }
}

pub fn scores_to_wire(scores: &MotionScores) -> pb::MotionScores {
    let known = |value: f64| value.is_finite().then_some(value);
    pb::MotionScores {
        n: scores.n as u32,
        overall: known(scores.overall),
        translation: known(scores.translation),
        rotation: known(scores.rotation),
        direction: known(scores.direction),
        magnitude: known(scores.magnitude),
    }
}

pub fn row_to_wire(row: &Row) -> pb::NavigatorScores {
    let RetrievalScores { top1, hits, translation_m_median, rotation_rad_median, pose_recalls, .. } = &row.retrieval;
    pb::NavigatorScores {
        name: row.name.clone(),
        n: row.n as u32,
        mse: row.latent.map(|latent| latent.mse),
        r2: row.latent.map(|latent| latent.r2).filter(|r2| r2.is_finite()),
        top1: Some(rate_to_wire(top1)),
        hits: hits
            .iter()
            .map(|(threshold, rate)| pb::HitRate { threshold: *threshold, rate: Some(rate_to_wire(rate)) })
            .collect(),
        translation_m_median: *translation_m_median,
        rotation_rad_median: *rotation_rad_median,
        recalls: pose_recalls
            .iter()
            .map(|recall| pb::PoseRecall {
                translation_m: recall.translation_m,
                rotation_deg: recall.rotation_deg,
                rate: Some(rate_to_wire(&recall.rate)),
            })
            .collect(),
    }
}

fn rate_to_wire(rate: &Rate) -> pb::Rate {
    pb::Rate { rate: rate.rate, low: rate.low, high: rate.high }
}
