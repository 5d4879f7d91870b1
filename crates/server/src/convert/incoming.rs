//! Converts and validates incoming requests. Errors name the invalid field.

use super::super::Error;
use super::super::snapshot::Snapshot;
use super::{CAMERA, MAP, world_frame};
use seese3_client::convert::{self, ConvertError};
use seese3_client::proto::v1 as pb;
use seese3_core::eval::{PredictedPair, Prediction, check_thresholds, default_thresholds};
use seese3_core::features::UNSPECIFIED;
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera, Pose, Twist};
use seese3_core::navigation::NavigatorKind;
use seese3_core::navigation::{
    FitOn, MAX_TRANSLATION_M, Method, Mode, Query, Reading, RequestedMotion, RetrievalMetric,
    Source, SourceAt, StepKind,
};
use seese3_core::room::FrameId;
use seese3_core::splits::{Pair, Split};
use seese3_store::StoredAdapter;

/// Maximum length of free-text fields, characters.
const LONGEST_WORDS: usize = 1_000;
/// The largest number of navigators in one evaluation.
const MAX_NAVIGATORS: usize = 100;

/// Checks the length of a free-text field.
///
/// # Errors
/// [`Error::Invalid`] if it has more than [`LONGEST_WORDS`] characters.
pub fn check_length(field: &str, words: &str) -> Result<(), Error> {
    if words.chars().count() > LONGEST_WORDS {
        let problem = format!("is longer than {LONGEST_WORDS} characters");
        return Err(Error::invalid(field, problem));
    }

    Ok(())
}

pub fn twist(twist: pb::Twist) -> Result<Twist, Error> {
    let convert::Twist { linear, angular } = convert::twist(&twist)?;
    Ok(Twist { linear, angular })
}

impl From<ConvertError> for Error {
    fn from(error: ConvertError) -> Self {
        Self::invalid(error.field, error.problem)
    }
}

/// A camera pose in the world frame of a room, `world_from_camera`.
///
/// # Errors
/// [`Error::Invalid`] if a part is missing or not finite, the quaternion is not of unit norm, the
/// position is too far from the origin, or the pose names other frames.
pub fn pose(pose: pb::Pose, room: &str) -> Result<Pose, Error> {
    let pb::Pose {
        parent_frame,
        child_frame,
        position,
        orientation,
    } = pose;

    // Empty names mean the room's world and the camera, as does the default name of the map frame
    // in Track. The server knows no other frames.
    let world = world_frame(room);
    if ![String::new(), MAP.to_owned(), world.clone()].contains(&parent_frame) {
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

    let pose = convert::pose(&pb::Pose {
        position,
        orientation,
        ..pb::Pose::default()
    })?;
    if pose.translation.vector.norm() > MAX_TRANSLATION_M {
        return Err(Error::invalid(
            "position",
            format!("is over {MAX_TRANSLATION_M:e} m from the origin"),
        ));
    }

    Ok(pose)
}

/// Camera intrinsics; the principal point defaults to the image center.
///
/// # Errors
/// [`Error::Invalid`] on `camera`, or on its field of the distortion, if the intrinsics are not
/// valid.
pub fn camera(camera: &pb::CameraIntrinsics) -> Result<CameraIntrinsics, Error> {
    let &pb::CameraIntrinsics {
        width,
        height,
        fx,
        fy,
        cx,
        cy,
        distortion_model,
        distortion: ref coefficients,
    } = camera;
    let fy = if fy == 0.0 { fx } else { fy };
    let center = [cx.unwrap_or(width / 2.0), cy.unwrap_or(height / 2.0)];

    CameraIntrinsics::new(PixelCamera {
        width,
        height,
        focal: [fx, fy].into(),
        center: Some(center.into()),
        distortion: distortion(distortion_model, coefficients)
            .map_err(|error| error.within("camera"))?,
    })
    .map_err(|problem| Error::invalid("camera", problem))
}

/// The camera of a request's images.
#[derive(Debug, Clone, Copy)]
pub enum ImageCamera {
    /// A camera with these intrinsics.
    Stated(CameraIntrinsics),
    /// The camera that mapped the room.
    Mapping,
}

/// The camera of a request's images.
///
/// # Errors
/// [`Error::Invalid`] on a part of `field` if the camera is not valid, or none is given.
pub fn image_camera(field: &str, given: &pb::ViewCamera) -> Result<ImageCamera, Error> {
    use pb::view_camera::Camera;

    match &given.camera {
        Some(Camera::Intrinsics(intrinsics)) => match camera(intrinsics) {
            Ok(camera) => Ok(ImageCamera::Stated(camera)),
            // The field begins with `camera`, as in other requests.
            Err(Error::Invalid {
                field: part,
                problem,
            }) => {
                let part = part.strip_prefix("camera").unwrap_or_default();
                Err(Error::invalid(format!("{field}.intrinsics{part}"), problem))
            }
            Err(other) => Err(other),
        },
        Some(Camera::MappingCamera(pb::MappingCamera {})) => Ok(ImageCamera::Mapping),
        None => Err(Error::invalid(
            field,
            "has no value: state the intrinsics, or mapping_camera",
        )),
    }
}

/// The lens distortion of a model and its coefficients.
fn distortion(model: i32, coefficients: &[f64]) -> Result<Distortion, Error> {
    let count = coefficients.len();
    match pb::DistortionModel::try_from(model) {
        Ok(pb::DistortionModel::Unspecified) if count == 0 => Ok(Distortion::None),
        Ok(pb::DistortionModel::Unspecified) => Err(Error::invalid(
            "distortion_model",
            "is required with distortion coefficients",
        )),
        Ok(pb::DistortionModel::BrownConrady) => {
            let mut padded = [0.0; 5];
            let given = padded.get_mut(..count).ok_or_else(|| {
                Error::invalid(
                    "distortion",
                    format!(
                        "has {count} coefficients; Brown–Conrady takes at most 5: k1, k2, p1, p2, k3"
                    ),
                )
            })?;
            given.copy_from_slice(coefficients);
            Ok(Distortion::brown_conrady(padded))
        }
        Ok(pb::DistortionModel::KannalaBrandt) => coefficients
            .try_into()
            .map(Distortion::KannalaBrandt)
            .map_err(|_| {
                Error::invalid(
                    "distortion",
                    format!("has {count} coefficients; Kannala–Brandt takes 4: k1, k2, k3, k4"),
                )
            }),
        Err(_) => Err(Error::invalid(
            "distortion_model",
            format!("{model} is not known to this server"),
        )),
    }
}

/// A view as the source of a query to `adapter`. Encodes images. `field` is the view's field in the
/// request, for errors.
///
/// # Errors
/// [`Error::Invalid`] if the view is missing, or is a feature of another source or an image that
/// cannot be decoded; [`Error::Precondition`] if the server has no encoder for images.
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
            feature_set,
        })) => {
            let own = &adapter.adapter.source().name;

            // Features of different sources are not comparable, even if their width is the same. If
            // the caller states the source, check it.
            if !feature_set.is_empty() && feature_set != *own {
                let problem =
                    format!("'{feature_set}' is not '{own}', which the adapter was trained on");
                return Err(Error::invalid(
                    format!("{field}.feature.feature_set"),
                    problem,
                ));
            }

            Ok(Source::Feature(values))
        }
        Some(pb::view::View::Latent(given)) => {
            let values = latent(given, adapter);
            values
                .map(Source::Latent)
                .map_err(|error| error.within(&format!("{field}.latent")))
        }
        Some(pb::view::View::Image(image)) => Ok(Source::Feature(
            snapshot
                .image_encoder(adapter)?
                .feature(&format!("{field}.image"), &image)?,
        )),
        None => Err(Error::invalid(
            field,
            "is required: a frame_id, a feature, a latent or an image",
        )),
    }
}

/// The numbers of a latent of this adapter.
///
/// # Errors
/// [`Error::Invalid`] on `adapter` if the latent is one of another adapter or revision.
fn latent(given: pb::Latent, adapter: &StoredAdapter) -> Result<Vec<f64>, Error> {
    let pb::Latent {
        values,
        adapter: of,
    } = given;
    let Some(pb::Revision { name, revision }) = of else {
        return Ok(values);
    };

    if (name.as_str(), revision) != (adapter.name.as_str(), adapter.revision) {
        let problem = format!(
            "is '{name}' revision {revision}; the request is answered with adapter '{}' revision {}: encode the \
             view again, or name that adapter and revision",
            adapter.name, adapter.revision
        );
        return Err(Error::invalid("adapter", problem));
    }
    Ok(values)
}

/// The name of a request's adapter: the stated one, else that of its first latent, else empty.
///
/// # Errors
/// [`Error::Invalid`] if neither is stated and a view is a latent: the default adapter may be
/// another one than that of the latent.
pub fn stated_adapter<'a>(
    adapter: &'a str,
    views: impl IntoIterator<Item = &'a pb::View>,
) -> Result<&'a str, Error> {
    let latents = views.into_iter().filter_map(|view| match &view.view {
        Some(pb::view::View::Latent(latent)) => Some(latent),
        _ => None,
    });
    adapter_of_latents(adapter, latents)
}

/// As [`stated_adapter`], of latents.
///
/// # Errors
/// As [`stated_adapter`].
pub fn adapter_of_latents<'a>(
    adapter: &'a str,
    latents: impl IntoIterator<Item = &'a pb::Latent>,
) -> Result<&'a str, Error> {
    let first = latents.into_iter().next();
    match (adapter, first.map(|latent| &latent.adapter)) {
        ("", Some(Some(of))) => Ok(&of.name),
        ("", Some(None)) => Err(Error::invalid(
            "adapter",
            "is required with a latent that does not name its adapter",
        )),
        (stated, _) => Ok(stated),
    }
}

fn requested_motion(
    given: Option<pb::RequestedMotion>,
    room: &str,
) -> Result<RequestedMotion, Error> {
    use pb::requested_motion::Motion as Wire;

    let required = || Error::invalid("motion", "is required: a twist, a target or twists");
    match given.and_then(|given| given.motion).ok_or_else(required)? {
        Wire::Twist(given) => {
            let given = twist(given).map_err(|error| error.within("motion.twist"))?;
            Ok(RequestedMotion::Twists(vec![given]))
        }
        Wire::TargetFrameId(frame) => Ok(RequestedMotion::TargetFrame(FrameId(frame))),
        Wire::TargetPose(target) => {
            let target = pose(target, room).map_err(|error| error.within("motion.target_pose"))?;
            Ok(RequestedMotion::TargetPose(target))
        }
        Wire::Twists(pb::TwistList { twists }) => {
            let numbered = twists.into_iter().enumerate();

            let each = |(position, given)| {
                twist(given).map_err(|error| error.within(&format!("motion.twists[{position}]")))
            };

            Ok(RequestedMotion::Twists(
                numbered.map(each).collect::<Result<_, _>>()?,
            ))
        }
    }
}

/// A navigation query.
///
/// # Errors
/// [`Error::Invalid`] on the invalid field; for an image also as [`source`].
pub fn query(
    request: pb::NavigateRequest,
    adapter: &StoredAdapter,
    snapshot: &Snapshot,
) -> Result<Query, Error> {
    // Destructured without `..`, so that a new field fails to compile here.
    let pb::NavigateRequest {
        room,
        room_revision: _,
        adapter: _,
        adapter_revision: _,
        source: view,
        source_pose,
        motion,
        steps,
        step_mode,
        inverse_variant,
        top_k,
        exclude_source,
        exclude_radius,
        navigator,
    } = request;

    let motion = requested_motion(motion, &room)?;
    let method = method_of(&navigator, inverse_variant)?;

    let mode = mode_of(step_mode)?;
    let exclude_source = exclusion(exclude_source, exclude_radius)?;
    let source_pose = source_pose
        .map(|given| pose(given, &room).map_err(|error| error.within("source_pose")))
        .transpose()?;

    // Encoding an image is costly, so check every other field first.
    let source = source("source", view, adapter, snapshot)?;
    if source_pose.is_some() && matches!(source, Source::Frame(_)) {
        return Err(Error::invalid(
            "source_pose",
            "must be left out for a frame: its pose is recorded in the room",
        ));
    }

    Ok(Query {
        source: SourceAt {
            source,
            pose: source_pose,
        },
        motion,
        steps: steps.unwrap_or(1),
        mode,
        method,
        fit_on: fit_on(adapter),
        top_k: top_k.unwrap_or(1),
        exclude_source,
    })
}

/// The method of the navigator `name`; if empty, inverse Poincaré in the given variant.
fn method_of(name: &str, variant: i32) -> Result<Method, Error> {
    let given = variant_of(variant)?;
    if name.is_empty() {
        let step = StepKind::InversePoincare(given);
        return Ok(Method::Latent(step, RetrievalMetric::Full));
    }

    // A navigator name determines the variant; a separate one could only contradict it.
    if variant != pb::InverseVariant::Unspecified as i32 {
        return Err(Error::invalid(
            "inverse_variant",
            "must be left out with a navigator, which has its own",
        ));
    }

    match navigator_named("navigator", name)? {
        NavigatorKind::Step(step, metric) => Ok(Method::Latent(step, metric)),
        NavigatorKind::Relational => Ok(Method::Relational),
        _ => Err(Error::invalid(
            "navigator",
            format!("'{name}' is a baseline of Evaluate; it makes no latent step"),
        )),
    }
}

/// The pairs of a room on which a ridge refit is fitted: those of the adapter's split and
/// stride. For an adapter trained on the `whole` split, which holds out no frames, the time split
/// is used.
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
            "is not a navigator; Adapter.navigators lists the names, and +row-space, +whitened, +motion or +calibrated \
             may be appended";
        Error::invalid(field, format!("'{name}' {problem}"))
    })
}

pub fn mode_of(mode: i32) -> Result<Mode, Error> {
    match pb::StepMode::try_from(mode) {
        Ok(pb::StepMode::Unspecified | pb::StepMode::OpenLoop) => Ok(Mode::OpenLoop),
        Ok(pb::StepMode::Snap) => Ok(Mode::Snap),
        Ok(pb::StepMode::ClosedLoop) => Ok(Mode::ClosedLoop),
        Err(_) => Err(Error::invalid(
            "step_mode",
            format!("{mode} is not known to this server"),
        )),
    }
}

fn variant_of(variant: i32) -> Result<Reading, Error> {
    match pb::InverseVariant::try_from(variant) {
        Ok(pb::InverseVariant::Unspecified | pb::InverseVariant::Homogeneous) => {
            Ok(Reading::Homogeneous)
        }
        Ok(pb::InverseVariant::Affine) => Ok(Reading::Affine),
        Ok(pb::InverseVariant::Literal) => Ok(Reading::Literal),
        Err(_) => Err(Error::invalid(
            "inverse_variant",
            format!("{variant} is not known to this server"),
        )),
    }
}

/// Exclusion radius: the number of rows on each side of the source frame that may not be retrieved,
/// besides the frame itself. `None` if the source may be retrieved.
pub fn exclusion(exclude_source: bool, exclude_radius: u32) -> Result<Option<u32>, Error> {
    match (exclude_source, exclude_radius) {
        (true, radius) => Ok(Some(radius)),
        (false, 0) => Ok(None),
        (false, _) => Err(Error::invalid("exclude_radius", "needs exclude_source")),
    }
}

/// The given thresholds ε; the paper's if empty.
pub fn thresholds(given: Vec<f64>) -> Result<Vec<f64>, Error> {
    let thresholds = if given.is_empty() {
        default_thresholds()
    } else {
        given
    };
    check_thresholds(&thresholds)?;

    Ok(thresholds)
}

/// The split of a request; `None` if it is unspecified.
///
/// # Errors
/// [`Error::Invalid`] if there is no such split.
pub fn split(given: i32) -> Result<Option<Split>, Error> {
    Ok(Some(match pb::Split::try_from(given) {
        Ok(pb::Split::Unspecified) => return Ok(None),
        Ok(pb::Split::Time) => Split::Time,
        Ok(pb::Split::Fold1) => Split::Fold1,
        Ok(pb::Split::Fold2) => Split::Fold2,
        Ok(pb::Split::Fold3) => Split::Fold3,
        Ok(pb::Split::Fold4) => Split::Fold4,
        Ok(pb::Split::Fold5) => Split::Fold5,
        Ok(pb::Split::Blocks) => Split::Blocks,
        Ok(pb::Split::Pairs) => Split::Pairs,
        Ok(pb::Split::Dataset) => Split::Dataset,
        Ok(pb::Split::Whole) => Split::Whole,
        Err(_) => {
            return Err(Error::invalid(
                "split",
                format!("{given} is not known to this server"),
            ));
        }
    }))
}

/// Where the numbering of layers starts, as a feature source states it.
///
/// # Errors
/// [`Error::Invalid`] if there is no such value.
pub fn layer_index_base(given: i32) -> Result<String, Error> {
    let base = match pb::LayerIndexBase::try_from(given) {
        Ok(pb::LayerIndexBase::Unspecified) => UNSPECIFIED,
        Ok(pb::LayerIndexBase::Zero) => "0",
        Ok(pb::LayerIndexBase::One) => "1",
        Ok(pb::LayerIndexBase::Name) => "name",
        Err(_) => {
            let problem = format!("{given} is not known to this server");
            return Err(Error::invalid("feature_sources.layer_index_base", problem));
        }
    };
    Ok(base.to_owned())
}

/// Whether a final normalization was applied, as a feature source states it.
///
/// # Errors
/// [`Error::Invalid`] if there is no such value.
pub fn final_norm(given: i32) -> Result<String, Error> {
    let norm = match pb::FinalNorm::try_from(given) {
        Ok(pb::FinalNorm::Unspecified) => UNSPECIFIED,
        Ok(pb::FinalNorm::None) => "none",
        Ok(pb::FinalNorm::Applied) => "final",
        Err(_) => {
            let problem = format!("{given} is not known to this server");
            return Err(Error::invalid("feature_sources.final_norm", problem));
        }
    };
    Ok(norm.to_owned())
}

/// The named navigators of an evaluation. An empty list selects the default navigators.
pub fn navigators(names: &[String]) -> Result<Vec<NavigatorKind>, Error> {
    let twice = |(position, name): &(usize, &String)| names[..*position].contains(name);

    if names.len() > MAX_NAVIGATORS {
        return Err(Error::invalid(
            "navigators",
            format!("names more than {MAX_NAVIGATORS}"),
        ));
    }

    if let Some((_, name)) = names.iter().enumerate().find(twice) {
        return Err(Error::invalid(
            "navigators",
            format!("names '{name}' twice"),
        ));
    }

    names
        .iter()
        .map(|name| navigator_named("navigators", name))
        .collect()
}

pub fn prediction(
    position: usize,
    given: pb::Prediction,
    adapter: &StoredAdapter,
) -> Result<PredictedPair, Error> {
    let pb::Prediction {
        source_frame_id,
        target_frame_id,
        prediction,
        last_step_frame_id,
    } = given;

    let prediction = match prediction {
        Some(pb::prediction::Prediction::Latent(given)) => {
            let values = latent(given, adapter);
            let within = |error: Error| error.within(&format!("predictions[{position}].latent"));
            Prediction::Latent(values.map_err(within)?)
        }
        Some(pb::prediction::Prediction::RetrievedFrameId(frame)) => {
            Prediction::Frame(FrameId(frame))
        }
        None => {
            return Err(Error::invalid(
                format!("predictions[{position}]"),
                "needs a latent or a retrieved_frame_id",
            ));
        }
    };

    Ok(PredictedPair {
        pair: Pair {
            source: FrameId(source_frame_id),
            target: FrameId(target_frame_id),
        },
        prediction,
        last_step_from: last_step_frame_id.map(FrameId),
    })
}
