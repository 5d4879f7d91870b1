//! Converts updates to wire messages.

use super::super::convert;
use super::configuration::StreamFrames;
use super::rooms::TrackedRoom;
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::{Pose, Twist, adjoint};
use seese3_robot::tracking::{PoseWithCovariance, Sensor, Status, Update};

/// Converts an update. The session fills in `timestamp_ns`, `sequence`, `elapsed_ns` and
/// `best_camera`.
pub fn update(update: &Update, frames: &StreamFrames, rooms: &[TrackedRoom]) -> pb::TrackUpdate {
    // As in REP-105, map_from_odom = map_from_camera · camera_from_odom is the drift correction. It
    // jumps when the pose is corrected, while odom stays continuous.
    let names = &frames.names;
    let odom = odom_of_stream(&update.odom, frames);
    let odom_from_camera = odom.pose;
    let map_from_odom = update
        .map_pose
        .map(|place| place.pose * odom_from_camera.inverse());

    // Report the nearest frame only if the room is known; otherwise it would be misleading.
    let known = update.room.map(|room| &rooms[room]);
    let best_match = update.best_match.filter(|_| known.is_some());

    let camera_from_base = frames.base_from_camera.map(|pose| pose.inverse());
    let base_in_map = update
        .map_pose
        .as_ref()
        .zip(camera_from_base.as_ref())
        .map(|(camera, camera_from_base)| camera.of_attached(camera_from_base));
    let base_velocity = update.velocity.zip(frames.base_from_camera);

    pb::TrackUpdate {
        timestamp_ns: 0,
        sequence: 0,
        motion: Some(convert::twist_to_wire(&update.motion)),
        motion_covariance: convert::matrix_to_wire(&update.motion_covariance),
        keyframe_sequence: update.keyframe_sequence,
        is_keyframe: update.is_keyframe,
        odom_from_camera: Some(pose(&odom_from_camera, &names.odom, &names.camera)),
        odom_from_camera_covariance: convert::matrix_to_wire(&odom.ros_covariance()),
        map_from_odom: map_from_odom.map(|found| pose(&found, &names.map, &names.odom)),
        map_from_camera: update
            .map_pose
            .map(|place| pose(&place.pose, &names.map, &names.camera)),
        map_from_camera_covariance: update.map_pose.map_or_else(Vec::new, |place| {
            convert::matrix_to_wire(&place.ros_covariance())
        }),
        body_velocity: update.velocity.as_ref().map(convert::twist_to_wire),
        status: status(update.status) as i32,
        reason: update.reason.clone(),
        out_of_distribution: update.out_of_distribution,
        room: known.map(|room| room.revision.clone()),
        best_match: best_match.map(|best| rooms[best.room].retrieved(best.frame)),
        match_used: update.match_used,
        match_surprise: update.surprise,
        elapsed_ns: 0,
        candidate: update
            .candidate
            .as_ref()
            .map(|candidate| pb::PlaceCandidate {
                room: Some(rooms[candidate.room].revision.clone()),
                map_from_camera: Some(pose(&candidate.map_pose.pose, &names.map, &names.camera)),
                sequence: candidate.sequence,
                agreed: candidate.agreeing,
                needed: candidate.needed,
            }),
        odom_from_base: camera_from_base.map(|camera_from_base| {
            let odom_from_base = odom_from_camera * camera_from_base;
            pose(&odom_from_base, &names.odom, &names.base)
        }),
        map_from_base: base_in_map.map(|base| pose(&base.pose, &names.map, &names.base)),
        map_from_base_covariance: base_in_map.map_or_else(Vec::new, |base| {
            convert::matrix_to_wire(&base.ros_covariance())
        }),
        base_velocity: base_velocity.map(|(velocity, base_from_camera)| {
            let velocity = adjoint(&base_from_camera) * velocity.to_vector();
            convert::twist_to_wire(&Twist::from_vector(&velocity))
        }),
        best_camera: String::new(),
        contradicted: update
            .contradicted
            .iter()
            .map(|&of| sensor(of) as i32)
            .collect(),
    }
}

/// The odometry pose in the stream's odometry frame. The filter's odometry starts at the camera;
/// if the base is known, the stream's odometry starts at the base.
fn odom_of_stream(odom: &PoseWithCovariance, frames: &StreamFrames) -> PoseWithCovariance {
    match frames.base_from_camera {
        Some(base_from_camera) => PoseWithCovariance {
            pose: base_from_camera * odom.pose,
            ..*odom
        },
        None => *odom,
    }
}

fn status(status: Status) -> pb::TrackStatus {
    match status {
        Status::Tracking => pb::TrackStatus::Tracking,
        Status::Degraded => pb::TrackStatus::Degraded,
        Status::Lost => pb::TrackStatus::Lost,
        Status::Relocalizing => pb::TrackStatus::Relocalizing,
    }
}

fn sensor(sensor: Sensor) -> pb::TrackSensor {
    match sensor {
        Sensor::Wheels => pb::TrackSensor::Odometry,
        Sensor::Images => pb::TrackSensor::Images,
        Sensor::Inertia => pb::TrackSensor::Inertial,
        Sensor::Gravity => pb::TrackSensor::Gravity,
        Sensor::Views => pb::TrackSensor::Views,
    }
}

fn pose(pose: &Pose, parent: &str, child: &str) -> pb::Pose {
    let named = convert::pose_to_wire(pose, "");
    pb::Pose {
        parent_frame: parent.to_owned(),
        child_frame: child.to_owned(),
        ..named
    }
}
