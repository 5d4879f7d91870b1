//! The configuration of a Track stream, checked field by field.

use std::sync::Arc;

use super::super::Error;
use super::super::convert;
use super::super::relocalization::rooms_to_track_in;
use super::super::snapshot::{ServedNavigator, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::Pose;
use seese3_robot::tracking::{Drift, MeasuredPose, PoseWithCovariance, TrackerSettings};

/// The standard deviation by axis of a pose whose sender states none: 0.1 m and 0.1 rad.
const KNOWN: f64 = 0.1;
/// The standard deviations that a sender may state, metres or radians.
const DEVIATIONS: std::ops::RangeInclusive<f64> = 1e-6..=1e3;
/// The names of the map, odometry, camera and base frames if the stream does not choose its own.
const FRAME_NAMES: [&str; 4] = ["map", "odom", "camera", "base_link"];
/// The longest name of a frame.
pub const LONGEST_NAME: usize = 100;
/// How fast the odometry of another sensor drifts if its sender does not say, and what it may say:
/// metres per metre, radians per radian.
const DRIFT_SHARE: f64 = 0.05;
const DRIFT_SHARES: std::ops::RangeInclusive<f64> = 1e-4..=10.0;

/// The rooms of a configuration, all under one adapter; at least one. With a camera, those that
/// were mapped with one like it, or with one that is not known.
///
/// # Errors
/// [`Error::Invalid`] if both `room` and `rooms` are given, or the camera is not valid or unlike
/// that of every room; otherwise as [`rooms_to_track_in`].
pub fn rooms(
    snapshot: &Snapshot,
    config: &pb::TrackConfig,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    let mut served = named_rooms(snapshot, config)?;
    if let Some(camera) = &config.camera {
        served = seen_alike(camera, served)?;
    }
    for (number, other) in config.other_cameras.iter().enumerate() {
        if let Some(camera) = &other.camera {
            served = seen_alike(camera, served)
                .map_err(|error| error.within(&format!("other_cameras[{number}]")))?;
        }
    }

    Ok(served)
}

fn named_rooms(
    snapshot: &Snapshot,
    config: &pb::TrackConfig,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    // A single room is passed on as a list of one, so that errors about `rooms[0]` are renamed to
    // the field that the caller filled.
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

pub fn settings(
    config: &pb::TrackConfig,
    adapter: &seese3_core::adapter::Adapter,
) -> Result<TrackerSettings, Error> {
    let plain = TrackerSettings::of(adapter);

    let pb::KeyframePolicy {
        displacement,
        frames,
    } = config.keyframes.unwrap_or_default();

    if displacement.is_some_and(|given| !(given.is_finite() && given > 0.0)) {
        return Err(Error::invalid(
            "keyframes.displacement",
            "must be finite and above 0",
        ));
    }
    if frames == Some(0) {
        return Err(Error::invalid("keyframes.frames", "must be at least 1"));
    }

    let fuse = match pb::Fusion::try_from(config.fusion) {
        Ok(pb::Fusion::Unspecified | pb::Fusion::Anchors) => true,
        Ok(pb::Fusion::None) => false,
        Err(_) => {
            return Err(Error::invalid(
                "fusion",
                format!("{} is no value of Fusion", config.fusion),
            ));
        }
    };

    Ok(TrackerSettings {
        keyframe_frames: frames.unwrap_or(plain.keyframe_frames),
        keyframe_displacement: displacement.unwrap_or(plain.keyframe_displacement),
        fuse,
    })
}

/// The rooms that were mapped with a camera like this one, as far as theirs are known.
///
/// # Errors
/// [`Error::Invalid`] if the camera is not valid, or no room is left.
fn seen_alike(
    camera: &pb::Pinhole,
    served: Vec<Arc<ServedNavigator>>,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    let camera = convert::pinhole(camera)?;
    let mut other = None;
    let mut alike = Vec::new();

    for served in served {
        let room = served.navigator.room();
        let of_room = room.provenance().camera.as_ref();
        match of_room.and_then(|of_room| of_room.difference(&camera)) {
            None => alike.push(served),
            Some(difference) => other = Some((room.id().to_string(), difference)),
        }
    }

    match other {
        Some((room, difference)) if alike.is_empty() => Err(Error::invalid(
            "camera",
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
    /// Their names, all different.
    pub names: pb::FrameNames,
    /// The camera's pose on the robot, if it is known.
    pub base_from_camera: Option<Pose>,
}

/// What a pose that a client sends is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Body {
    Camera,
    Base,
}

impl StreamFrames {
    /// The frames that a configuration names. Names that are left empty take the defaults; the name
    /// of a base only matters where the base is known.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a name that is too long or twice the same, and for a bad pose.
    pub fn of(config: &pb::TrackConfig) -> Result<Self, Error> {
        let given = config.base_from_camera.clone();
        let names = frame_names(config.frames.clone().unwrap_or_default(), given.is_some())?;
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

    /// A pose on the map that is given from outside, of the camera or the base, as the camera's.
    /// Its frames may have the stream's own names or those of the service, `rooms/NAME` and
    /// `camera`.
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
            translation_deviation_m,
            rotation_deviation_rad,
        } = given;
        let mut pose = pose.ok_or_else(|| Error::invalid("pose", "is required"))?;

        // `convert::pose` takes an empty name for the room's world or the camera, so the stream's
        // own names are cleared.
        clear_name(&mut pose.parent_frame, &self.names.map);
        let body = self.body(&mut pose, Body::Camera);
        let pose = convert::pose(pose, room).map_err(|error| error.within("pose"))?;

        let deviation =
            |field: &str, given: Option<f64>| within(field, given.unwrap_or(KNOWN), DEVIATIONS);
        let translation = deviation("translation_deviation_m", translation_deviation_m)?;
        let rotation = deviation("rotation_deviation_rad", rotation_deviation_rad)?;

        Ok(self.of_camera(PoseWithCovariance::known(pose, translation, rotation), body))
    }

    /// The odometry of another sensor, as the camera's.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the pose is missing or not valid, or a share is out of range.
    pub fn measured(&self, given: pb::MeasuredOdometry) -> Result<MeasuredPose, Error> {
        let pb::MeasuredOdometry {
            pose,
            translation_share,
            rotation_share,
        } = given;
        let mut pose = pose.ok_or_else(|| Error::invalid("pose", "is required"))?;

        // The sensor's own frame may have any name.
        pose.parent_frame.clear();
        let body = self.body(&mut pose, Body::Base);
        let pose = unnamed(pose).map_err(|error| error.within("pose"))?;
        let share = |field: &str, given: Option<f64>| {
            within(field, given.unwrap_or(DRIFT_SHARE), DRIFT_SHARES)
        };

        Ok(MeasuredPose {
            pose: match (body, self.base_from_camera) {
                (Body::Base, Some(base_from_camera)) => pose * base_from_camera,
                _ => pose,
            },
            drift: Drift {
                translation_share: share("translation_share", translation_share)?,
                rotation_share: share("rotation_share", rotation_share)?,
            },
        })
    }

    /// Whose pose a pose is, by the name of its child, which is cleared if it is one of the
    /// stream's.
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

    /// A belief of a body's pose as one of the camera's.
    fn of_camera(&self, belief: PoseWithCovariance, body: Body) -> PoseWithCovariance {
        match (body, self.base_from_camera) {
            (Body::Base, Some(base_from_camera)) => belief.of_attached(&base_from_camera),
            _ => belief,
        }
    }
}

/// A pose between two of the stream's frames, whose names were cleared: what is left is none of
/// them.
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

    // Empty names take the defaults. The others are repeated in answers, so they must be short
    // and free of control characters.
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
            return Err(Error::invalid(format!("frames.{field}"), problem));
        }
    }

    // In a transform tree every frame needs a name of its own.
    let used = if has_base { &names[..] } else { &names[..3] };
    let mut different: Vec<&String> = used.iter().collect();
    different.sort();
    different.dedup();
    if different.len() != used.len() {
        return Err(Error::invalid(
            "frames",
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
