//! The configuration of a Track stream, checked field by field.

use std::sync::Arc;

use super::super::Error;
use super::super::convert;
use super::super::relocalization::rooms_to_track_in;
use super::super::snapshot::{ServedNavigator, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_core::tracking::{Belief, TrackerSettings};

/// The standard deviation by axis of a pose whose sender states none: 0.1 m and 0.1 rad.
const KNOWN: f64 = 0.1;
/// The standard deviations that a sender may state, metres or radians.
const DEVIATIONS: std::ops::RangeInclusive<f64> = 1e-6..=1e3;
/// The names of the map, odometry and camera frames if the stream does not choose its own.
const FRAME_NAMES: [&str; 3] = ["map", "odom", "camera"];
/// The longest name of a frame.
const LONGEST_NAME: usize = 100;

/// The rooms of a configuration, all under one adapter; at least one.
///
/// # Errors
/// [`Error::Invalid`] if both `room` and `rooms` are given, or as [`rooms_to_track_in`].
pub fn rooms(
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

pub fn back_pressure(given: i32) -> Result<(), Error> {
    match pb::BackPressure::try_from(given) {
        Ok(_) => Ok(()),
        Err(_) => Err(Error::invalid(
            "back_pressure",
            format!("{given} is no value of BackPressure"),
        )),
    }
}

pub fn frame_names(given: pb::FrameNames) -> Result<pb::FrameNames, Error> {
    let pb::FrameNames { map, odom, camera } = given;
    let mut names = [map, odom, camera];

    // Empty names take the defaults. The others are repeated in answers, so they must be short
    // and free of control characters.
    for (name, (plain, field)) in names
        .iter_mut()
        .zip(FRAME_NAMES.into_iter().zip(["map", "odom", "camera"]))
    {
        if name.is_empty() {
            *name = plain.to_owned();
        }
        if name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
            let problem = format!("is over {LONGEST_NAME} bytes long or has a control character");
            return Err(Error::invalid(format!("frames.{field}"), problem));
        }
    }

    // In a transform tree every frame needs a name of its own.
    if names[0] == names[1] || names[1] == names[2] || names[0] == names[2] {
        return Err(Error::invalid("frames", "must be three different names"));
    }

    let [map, odom, camera] = names;
    Ok(pb::FrameNames { map, odom, camera })
}

/// A pose on the map that is given from outside, with its uncertainty. Its frames may have the
/// stream's own names or those of the service, `rooms/NAME` and `camera`.
///
/// # Errors
/// [`Error::Invalid`] if the pose is missing or not valid, or a standard deviation is out of range.
pub fn known_pose(
    given: pb::InitialPose,
    room: &str,
    names: &pb::FrameNames,
) -> Result<Belief, Error> {
    let pb::InitialPose {
        pose,
        translation_deviation_m,
        rotation_deviation_rad,
    } = given;
    let mut pose = pose.ok_or_else(|| Error::invalid("pose", "is required"))?;

    // `convert::pose` takes an empty name for the room's world or the camera, so the stream's own
    // names are cleared.
    for (frame, name) in [
        (&mut pose.parent_frame, &names.map),
        (&mut pose.child_frame, &names.camera),
    ] {
        if frame == name {
            frame.clear();
        }
    }

    let pose = convert::pose(pose, room).map_err(|error| error.within("pose"))?;

    let deviation = |field: &str, given: Option<f64>| match given {
        None => Ok(KNOWN),
        Some(given) if DEVIATIONS.contains(&given) => Ok(given),
        _ => Err(Error::invalid(
            field,
            format!("must be {:e} to {:e}", DEVIATIONS.start(), DEVIATIONS.end()),
        )),
    };

    let translation = deviation("translation_deviation_m", translation_deviation_m)?;
    let rotation = deviation("rotation_deviation_rad", rotation_deviation_rad)?;

    Ok(Belief::known(pose, translation, rotation))
}
