//! What enters: requests to questions. Every field is checked here, and named in what is wrong with
//! it.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::super::Error;
use super::super::snapshot::Snapshot;
use super::{CAMERA, world_frame};
use crate::eval::{NavigatorKind, Prediction, check_thresholds, default_thresholds};
use crate::geometry::{Pose, Twist};
use crate::navigation::{
    Displacement, FitOn, MAX_TRANSLATION_M, Metric, Mode, Query, Reading, Source, SourceAt,
    StepKind,
};
use crate::pairs::{Pair, Split};
use crate::proto::v1 as pb;
use crate::room::FrameId;
use crate::store::StoredAdapter;

/// How far from 1 a quaternion's norm may be.
const QUATERNION_TOLERANCE: f64 = 1e-3;
/// The most rows of one evaluation.
const MAX_NAVIGATORS: usize = 100;

fn vector(field: &str, vector: Option<pb::Vector3>) -> Result<Vector3<f64>, Error> {
    let pb::Vector3 { x, y, z } = vector.ok_or_else(|| Error::invalid(field, "is required"))?;
    if [x, y, z].iter().all(|value| value.is_finite()) {
        Ok(Vector3::new(x, y, z))
    } else {
        Err(Error::invalid(
            field,
            format!("({x}, {y}, {z}) must be finite"),
        ))
    }
}

pub fn twist(twist: pb::Twist) -> Result<Twist, Error> {
    let pb::Twist { linear, angular } = twist;
    Ok(Twist {
        linear: vector("linear", linear)?,
        angular: vector("angular", angular)?,
    })
}

/// A pose in the world of a room.
///
/// # Errors
/// [`Error::Invalid`] when a part is missing, is not finite, is no rotation, or names other frames.
pub fn pose(pose: pb::Pose, room: &str) -> Result<Pose, Error> {
    let pb::Pose {
        parent_frame,
        child_frame,
        position,
        orientation,
    } = pose;

    let world = world_frame(room);
    if !parent_frame.is_empty() && parent_frame != world {
        return Err(Error::invalid(
            "parent_frame",
            format!("'{parent_frame}' is not the room's world, '{world}'"),
        ));
    }

    if !child_frame.is_empty() && child_frame != CAMERA {
        return Err(Error::invalid(
            "child_frame",
            format!("'{child_frame}' is not '{CAMERA}'"),
        ));
    }

    let pb::Quaternion { w, x, y, z } =
        orientation.ok_or_else(|| Error::invalid("orientation", "is required"))?;
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();

    if norm.is_nan() || (norm - 1.0).abs() > QUATERNION_TOLERANCE {
        return Err(Error::invalid(
            "orientation",
            format!("has norm {norm}, a rotation has 1"),
        ));
    }

    let position = vector("position", position)?;
    if position.norm() > MAX_TRANSLATION_M {
        return Err(Error::invalid(
            "position",
            format!("is over {MAX_TRANSLATION_M:e} m from the origin"),
        ));
    }

    Ok(Pose::from_parts(
        position.into(),
        UnitQuaternion::from_quaternion(quaternion),
    ))
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
        Some(pb::view::View::Feature(pb::Feature {
            values,
            source_name,
        })) => {
            let own = &adapter.adapter.source().name;
            if !source_name.is_empty() && source_name != *own {
                let problem =
                    format!("'{source_name}' is not '{own}', which the adapter was trained on");
                return Err(Error::invalid(
                    format!("{field}.feature.source_name"),
                    problem,
                ));
            }

            Ok(Source::Feature(values))
        }
        Some(pb::view::View::Latent(pb::Latent { values })) => Ok(Source::Latent(values)),
        Some(pb::view::View::Image(image)) => Ok(Source::Feature(
            snapshot
                .eye(adapter)?
                .feature(&format!("{field}.image"), &image)?,
        )),
        None => Err(Error::invalid(
            field,
            "is required: a frame_id, a feature, a latent or an image",
        )),
    }
}

fn displacement(displacement: Option<pb::Displacement>, room: &str) -> Result<Displacement, Error> {
    use pb::displacement::Displacement as Wire;

    let wire = displacement.and_then(|displacement| displacement.displacement);
    match wire
        .ok_or_else(|| Error::invalid("displacement", "is required: a twist, a target or twists"))?
    {
        Wire::Twist(given) => {
            let given = twist(given).map_err(|error| error.within("displacement.twist"))?;
            Ok(Displacement::Twists(vec![given]))
        }
        Wire::TargetFrameId(frame) => Ok(Displacement::TargetFrame(FrameId(frame))),
        Wire::TargetPose(target) => {
            let target =
                pose(target, room).map_err(|error| error.within("displacement.target_pose"))?;
            Ok(Displacement::TargetPose(target))
        }
        Wire::Twists(pb::TwistList { twists }) => {
            let numbered = twists.into_iter().enumerate();

            let each = |(position, given)| {
                twist(given)
                    .map_err(|error| error.within(&format!("displacement.twists[{position}]")))
            };

            Ok(Displacement::Twists(
                numbered.map(each).collect::<Result<_, _>>()?,
            ))
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
        navigator,
    } = request;

    let displacement = displacement(wanted, &room)?;
    let thresholds = thresholds(given_thresholds)?;
    let (step, metric) = step_of(&navigator, reading)?;

    // Last, since an image is costly.
    let source = source("source", view, adapter, snapshot)?;
    if source_pose.is_some() && matches!(source, Source::Frame(_)) {
        return Err(Error::invalid(
            "source_pose",
            "is not to be given with a frame, whose pose the room knows",
        ));
    }

    let known = source_pose
        .map(|given| pose(given, &room).map_err(|error| error.within("source_pose")))
        .transpose()?;

    let query = Query {
        source: SourceAt {
            source,
            pose: known,
        },
        displacement,
        steps: steps.unwrap_or(1),
        mode: mode_of(mode)?,
        step,
        metric,
        fit_on: fit_on(adapter),
        hit_count: hit_count.unwrap_or(1),
        exclude_source: exclusion(exclude_source, exclude_radius)?,
    };

    Ok((query, thresholds))
}

/// How to step, and under which metric, by name, or inverse Poincaré in a reading.
fn step_of(name: &str, reading: i32) -> Result<(StepKind, Metric), Error> {
    let given = reading_of(reading)?;
    if name.is_empty() {
        return Ok((StepKind::InversePoincare(given), Metric::Full));
    }

    if reading != pb::Reading::Unspecified as i32 {
        return Err(Error::invalid(
            "reading",
            "is not to be given with a navigator, whose name says it",
        ));
    }

    match navigator_named("navigator", name)? {
        NavigatorKind::Step(step, metric) => Ok((step, metric)),
        _ => Err(Error::invalid(
            "navigator",
            format!("'{name}' is a row of Evaluate; it makes no latent step"),
        )),
    }
}

/// Pairs of a room that a refit is fitted on: under the adapter's own split and stride, or the time
/// split where the adapter set nothing apart.
fn fit_on(adapter: &StoredAdapter) -> FitOn {
    let split = match adapter.record.split {
        Split::Whole => Split::Time,
        split => split,
    };
    FitOn {
        split,
        stride: adapter.record.stride,
    }
}

fn navigator_named(field: &str, name: &str) -> Result<NavigatorKind, Error> {
    NavigatorKind::from_name(name).ok_or_else(|| {
        let problem =
            "is no navigator; adapters list theirs, and +row-space, +whitened, +motion or +calibrated may be added";
        Error::invalid(field, format!("'{name}' {problem}"))
    })
}

pub fn mode_of(mode: i32) -> Result<Mode, Error> {
    match pb::Mode::try_from(mode) {
        Ok(pb::Mode::Unspecified | pb::Mode::OpenLoop) => Ok(Mode::OpenLoop),
        Ok(pb::Mode::Snap) => Ok(Mode::Snap),
        Ok(pb::Mode::ClosedLoop) => Ok(Mode::ClosedLoop),
        Err(_) => Err(Error::invalid(
            "mode",
            format!("{mode} is not known to this server"),
        )),
    }
}

fn reading_of(reading: i32) -> Result<Reading, Error> {
    match pb::Reading::try_from(reading) {
        Ok(pb::Reading::Unspecified | pb::Reading::Homogeneous) => Ok(Reading::Homogeneous),
        Ok(pb::Reading::Affine) => Ok(Reading::Affine),
        Ok(pb::Reading::Literal) => Ok(Reading::Literal),
        Err(_) => Err(Error::invalid(
            "reading",
            format!("{reading} is not known to this server"),
        )),
    }
}

/// How many rows to each side of the source are excluded, none if it is not.
pub fn exclusion(exclude_source: bool, exclude_radius: u32) -> Result<Option<u32>, Error> {
    match (exclude_source, exclude_radius) {
        (true, radius) => Ok(Some(radius)),
        (false, 0) => Ok(None),
        (false, _) => Err(Error::invalid(
            "exclude_radius",
            "means nothing without exclude_source",
        )),
    }
}

/// Thresholds as given, or the paper's.
pub fn thresholds(given: Vec<f64>) -> Result<Vec<f64>, Error> {
    let thresholds = if given.is_empty() {
        default_thresholds()
    } else {
        given
    };
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
            Err(Error::invalid(
                "split",
                format!("'{name}' is none of {known}"),
            ))
        }
    }
}

/// Rows of the table by name; none means the adapter's own table.
pub fn navigators(names: &[String]) -> Result<Vec<NavigatorKind>, Error> {
    let twice = |(position, name): (usize, &String)| names[..position].contains(name);

    if names.len() > MAX_NAVIGATORS {
        return Err(Error::invalid(
            "navigators",
            format!("names more than {MAX_NAVIGATORS}"),
        ));
    }

    if names.iter().enumerate().any(twice) {
        return Err(Error::invalid("navigators", "names a navigator twice"));
    }

    names
        .iter()
        .map(|name| navigator_named("navigators", name))
        .collect()
}

pub fn prediction(position: usize, given: pb::Prediction) -> Result<(Pair, Prediction), Error> {
    let pb::Prediction {
        source_frame_id,
        target_frame_id,
        prediction,
    } = given;
    let pair = Pair {
        source: FrameId(source_frame_id),
        target: FrameId(target_frame_id),
    };

    match prediction {
        Some(pb::prediction::Prediction::Latent(pb::Latent { values })) => {
            Ok((pair, Prediction::Latent(values)))
        }
        Some(pb::prediction::Prediction::RetrievedFrameId(frame)) => {
            Ok((pair, Prediction::Frame(FrameId(frame))))
        }
        None => Err(Error::invalid(
            format!("predictions[{position}]"),
            "needs a latent or a retrieved_frame_id",
        )),
    }
}
