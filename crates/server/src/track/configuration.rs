//! Validates the configuration of a Track stream.

use std::sync::Arc;

use nalgebra::Matrix6;

use super::super::Error;
use super::super::convert::{self, ImageCamera};
use super::super::relocalization::rooms_to_track_in;
use super::super::snapshot::{ServedNavigator, ServedRooms, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::{CameraIntrinsics, Pose, adjoint};
use seese3_robot::pose_filter::FilterParameters;
use seese3_robot::tracking::{Drift, MeasuredPose, PoseWithCovariance};

/// Default standard deviation of a given pose, by axis: 0.1 m and 0.1 rad.
const KNOWN: f64 = 0.1;
/// Valid standard deviations of a given pose, meters or radians.
const DEVIATIONS: std::ops::RangeInclusive<f64> = 1e-6..=1e3;
/// Largest asymmetry and negative eigenvalue of a covariance, relative to its largest entry.
const ASYMMETRY: f64 = 1e-6;
/// Default names of the map, odometry, camera and base frames.
const FRAME_NAMES: [&str; 4] = [convert::MAP, "odom", "camera", "base_link"];
/// Maximum length of a frame name, bytes.
pub const LONGEST_NAME: usize = 100;
/// Default drift of another sensor's odometry: meters per meter, radians per radian and per meter.
const DRIFT_SHARE: f64 = 0.05;
/// Valid drift shares.
const DRIFT_SHARES: std::ops::RangeInclusive<f64> = 1e-4..=10.0;

/// The rooms of a configuration, all under one adapter; at least one. If cameras are given, rooms
/// mapped with a different field of view are removed; rooms with an unknown camera stay.
///
/// # Errors
/// [`Error::Invalid`] if both `room` and `rooms` are given, a camera is not valid, or no room
/// matches the cameras; otherwise as [`rooms_to_track_in`].
pub fn rooms(
    snapshot: &Snapshot,
    config: &pb::TrackConfig,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    let mut served = named_rooms(snapshot, config)?.to_vec();
    let camera = config.camera.as_ref();
    let camera = camera.map(|camera| convert::image_camera("camera", camera));
    if let Some(ImageCamera::Stated(camera)) = camera.transpose()? {
        served = with_matching_camera("camera", &camera, served)?;
    }
    for (number, other) in config.other_cameras.iter().enumerate() {
        if let Some(intrinsics) = &other.intrinsics {
            let field = format!("other_cameras[{number}].intrinsics");
            let camera = convert::camera(intrinsics).map_err(|error| error.named(&field))?;
            served = with_matching_camera(&field, &camera, served)?;
        }
    }

    Ok(served)
}

fn named_rooms(snapshot: &Snapshot, config: &pb::TrackConfig) -> Result<ServedRooms, Error> {
    // A single room becomes a list of one; errors on `rooms[0]` are renamed to the field `room`.
    match (config.room.as_str(), config.rooms.as_slice()) {
        ("", rooms) => rooms_to_track_in(snapshot, rooms, &config.adapter),
        (room, []) => {
            rooms_to_track_in(snapshot, &[room.to_owned()], &config.adapter).map_err(|error| {
                match error {
                    Error::NotFound { ref field, .. } | Error::Invalid { ref field, .. }
                        if field.starts_with("rooms") =>
                    {
                        error.named("room")
                    }
                    other => other,
                }
            })
        }
        _ => Err(Error::invalid(
            "rooms",
            "are candidates for an unknown room; give room or rooms, not both",
        )),
    }
}

/// Whether the map corrects the pose.
pub fn is_fused(fusion: i32) -> Result<bool, Error> {
    match pb::Fusion::try_from(fusion) {
        Ok(pb::Fusion::Unspecified | pb::Fusion::Anchors) => Ok(true),
        Ok(pb::Fusion::None) => Ok(false),
        Err(_) => Err(Error::invalid(
            "fusion",
            format!("{fusion} is no value of Fusion"),
        )),
    }
}

/// The parameters of a stream's filter.
///
/// # Errors
/// [`Error::Invalid`] on a field that is not valid.
pub fn parameters(
    config: &pb::TrackConfig,
    fitted: FilterParameters,
) -> Result<FilterParameters, Error> {
    let pb::KeyframePolicy {
        motion_norm,
        sequence_interval,
    } = config.keyframes.unwrap_or_default();
    if motion_norm.is_some_and(|given| !(given.is_finite() && given > 0.0)) {
        return Err(Error::invalid(
            "keyframes.motion_norm",
            "must be finite and above 0",
        ));
    }
    if sequence_interval == Some(0) {
        return Err(Error::invalid(
            "keyframes.sequence_interval",
            "must be at least 1",
        ));
    }

    Ok(FilterParameters {
        keyframe_frames: sequence_interval.unwrap_or(fitted.keyframe_frames),
        keyframe_displacement: motion_norm.unwrap_or(fitted.keyframe_displacement),
        fuse: is_fused(config.fusion)?,
        trust_wheels: config.trust_odometry,
        ..fitted
    })
}

/// The rooms mapped with the same field of view as this camera, or with an unknown camera.
///
/// # Errors
/// [`Error::Invalid`] on `field` if no room is left.
fn with_matching_camera(
    field: &str,
    camera: &CameraIntrinsics,
    served: Vec<Arc<ServedNavigator>>,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    let mut other = None;
    let mut alike = Vec::new();

    for served in served {
        let room = served.navigator.room();
        let of_room = room.provenance().camera.as_ref();
        match of_room.and_then(|of_room| of_room.difference(camera)) {
            None => alike.push(served),
            Some(difference) => other = Some((room.id().to_string(), difference)),
        }
    }

    match other {
        Some((room, difference)) if alike.is_empty() => Err(Error::invalid(
            field,
            format!(
                "{difference} ('{room}'): crop or pad the images to that, or map with this camera"
            ),
        )),
        _ => Ok(alike),
    }
}

pub fn back_pressure(given: i32) -> Result<(), Error> {
    match pb::BackPressure::try_from(given) {
        Ok(_) => Ok(()),
        Err(_) => Err(Error::invalid(
            "back_pressure",
            format!("{given} is no value of BackPressure"),
        )),
    }
}

/// The coordinate frames of a stream.
#[derive(Debug, Clone)]
pub struct StreamFrames {
    /// The frame names, all different.
    pub names: pb::FrameNames,
    /// The camera's pose on the robot, if given.
    pub base_from_camera: Option<Pose>,
}

/// The body that a client's pose refers to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Body {
    Camera,
    Base,
}

impl StreamFrames {
    /// The frames of a configuration. Empty names take the defaults. The base name matters only
    /// with `base_from_camera`.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a name that is too long or used twice, and for an invalid pose.
    pub fn of(config: &pb::TrackConfig) -> Result<Self, Error> {
        let given = config.base_from_camera.clone();
        let names = frame_names(
            config.frame_names.clone().unwrap_or_default(),
            given.is_some(),
        )?;
        let base_from_camera = given
            .map(|mut pose| {
                clear_name(&mut pose.parent_frame, &names.base);
                clear_name(&mut pose.child_frame, &names.camera);
                unnamed(pose).map_err(|error| error.within("base_from_camera"))
            })
            .transpose()?;

        Ok(Self {
            names,
            base_from_camera,
        })
    }

    /// The camera's map pose from an initial pose of the camera or the base. Frames may have the
    /// stream's names or the service's names, `rooms/NAME` and `camera`.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the pose is missing or not valid, or a standard deviation is out of
    /// range.
    pub fn known_pose(
        &self,
        given: pb::InitialPose,
        room: &str,
    ) -> Result<PoseWithCovariance, Error> {
        let pb::InitialPose {
            pose,
            position_deviation_m,
            rotation_deviation_rad,
        } = given;
        let mut pose = pose.ok_or_else(|| Error::invalid("pose", "is required"))?;

        // Clear the stream's frame names: `convert::pose` accepts empty names for the room's world
        // and the camera.
        clear_name(&mut pose.parent_frame, &self.names.map);
        let body = self.body(&mut pose, Body::Camera);
        let pose = convert::pose(pose, room).map_err(|error| error.within("pose"))?;

        let deviation =
            |field: &str, given: Option<f64>| within(field, given.unwrap_or(KNOWN), DEVIATIONS);
        let translation = deviation("position_deviation_m", position_deviation_m)?;
        let rotation = deviation("rotation_deviation_rad", rotation_deviation_rad)?;

        Ok(self.of_camera(PoseWithCovariance::known(pose, translation, rotation), body))
    }

    /// The camera's odometry pose from another sensor's odometry.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the pose is missing or not valid, or a share is out of range.
    pub fn measured(&self, given: pb::MeasuredOdometry) -> Result<MeasuredPose, Error> {
        let pb::MeasuredOdometry {
            pose,
            translation_share,
            rotation_share,
            velocity_covariance,
        } = given;
        let mut pose = pose.ok_or_else(|| Error::invalid("pose", "is required"))?;

        // The sensor's own frame may have any name.
        pose.parent_frame.clear();
        let body = self.body(&mut pose, Body::Base);
        let pose = unnamed(pose).map_err(|error| error.within("pose"))?;
        let share = |field: &str, given: Option<f64>| {
            within(field, given.unwrap_or(DRIFT_SHARE), DRIFT_SHARES)
        };

        let of_base = self.base_from_camera.filter(|_| body == Body::Base);
        let of_body = velocity_noise(&velocity_covariance)?;
        let to_camera = of_base.map_or_else(Matrix6::identity, |base_from_camera| {
            adjoint(&base_from_camera.inverse())
        });
        Ok(MeasuredPose {
            pose: of_base.map_or(pose, |base_from_camera| pose * base_from_camera),
            velocity_covariance: of_body
                .map(|covariance| to_camera * covariance * to_camera.transpose()),
            drift: Drift {
                translation_share: share("translation_share", translation_share)?,
                rotation_share: share("rotation_share", rotation_share)?,
            },
        })
    }

    /// The body of a pose, by its child frame; `unnamed` if that is empty and the base is known.
    /// Clears the child name if it is one of the stream's.
    fn body(&self, pose: &mut pb::Pose, unnamed: Body) -> Body {
        if self.base_from_camera.is_none() {
            clear_name(&mut pose.child_frame, &self.names.camera);
            return Body::Camera;
        }

        if pose.child_frame.is_empty() {
            return unnamed;
        }
        if pose.child_frame == self.names.base {
            pose.child_frame.clear();
            return Body::Base;
        }

        clear_name(&mut pose.child_frame, &self.names.camera);
        Body::Camera
    }

    /// Converts a pose of `body` to a pose of the camera.
    fn of_camera(&self, belief: PoseWithCovariance, body: Body) -> PoseWithCovariance {
        match (body, self.base_from_camera) {
            (Body::Base, Some(base_from_camera)) => belief.of_attached(&base_from_camera),
            _ => belief,
        }
    }
}

/// Converts a pose from which the stream's frame names were cleared. Any remaining name is unknown
/// and refused.
pub fn unnamed(pose: pb::Pose) -> Result<Pose, Error> {
    for (field, name) in [
        ("parent_frame", &pose.parent_frame),
        ("child_frame", &pose.child_frame),
    ] {
        if !name.is_empty() {
            return Err(Error::invalid(
                field,
                format!("'{name}' is not the name of that frame in this stream"),
            ));
        }
    }

    convert::pose(pose, "")
}

/// A covariance of velocities, row by row; `None` if it is empty.
///
/// # Errors
/// [`Error::Invalid`] for another number of values, and for a matrix that is not symmetric and
/// positive semidefinite, or zero.
fn velocity_noise(given: &[f64]) -> Result<Option<Matrix6<f64>>, Error> {
    let invalid = |problem: String| Error::invalid("velocity_covariance", problem);
    if given.is_empty() {
        return Ok(None);
    }
    if given.len() != 36 {
        return Err(invalid(format!(
            "must have 36 numbers, not {}",
            given.len()
        )));
    }

    let covariance = Matrix6::from_row_slice(given);
    let largest = covariance.amax();
    let is_finite = given.iter().all(|value| value.is_finite());
    let is_symmetric = (covariance - covariance.transpose()).amax() <= ASYMMETRY * largest;
    let least = if is_finite {
        covariance.symmetric_eigenvalues().min()
    } else {
        f64::NAN
    };
    let is_positive = covariance.diagonal().min() >= 0.0 && least >= -ASYMMETRY * largest;
    if !(is_finite && largest > 0.0 && is_symmetric && is_positive) {
        let problem = "must be finite, symmetric, positive semidefinite and not zero";
        return Err(invalid(problem.to_owned()));
    }

    // Rounding may have made an eigenvalue negative.
    let symmetric = (covariance + covariance.transpose()) * 0.5;
    Ok(Some(symmetric + Matrix6::identity() * (-least).max(0.0)))
}

pub fn clear_name(name: &mut String, own: &str) {
    if name == own {
        name.clear();
    }
}

pub fn within(field: &str, value: f64, range: std::ops::RangeInclusive<f64>) -> Result<f64, Error> {
    if range.contains(&value) {
        return Ok(value);
    }

    let problem = format!("must be {:e} to {:e}", range.start(), range.end());
    Err(Error::invalid(field, problem))
}

fn frame_names(given: pb::FrameNames, has_base: bool) -> Result<pb::FrameNames, Error> {
    let pb::FrameNames {
        map,
        odom,
        camera,
        base,
    } = given;
    let mut names = [map, odom, camera, base];

    // Empty names take the defaults. Answers repeat the names, so they must be short and free of
    // control characters.
    for (name, (plain, field)) in names.iter_mut().zip(
        FRAME_NAMES
            .into_iter()
            .zip(["map", "odom", "camera", "base"]),
    ) {
        if name.is_empty() {
            *name = plain.to_owned();
        }
        if name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
            let problem = format!("is over {LONGEST_NAME} bytes long or has a control character");
            return Err(Error::invalid(format!("frame_names.{field}"), problem));
        }
    }

    // Every frame of a transform tree needs a unique name.
    let used = if has_base { &names[..] } else { &names[..3] };
    let mut different: Vec<&String> = used.iter().collect();
    different.sort();
    different.dedup();
    if different.len() != used.len() {
        return Err(Error::invalid(
            "frame_names",
            format!("must be {} different names", used.len()),
        ));
    }

    let [map, odom, camera, base] = names;
    Ok(pb::FrameNames {
        map,
        odom,
        camera,
        base,
    })
}
