//! Converts updates to wire messages.

use super::super::convert;
use super::configuration::StreamFrames;
use super::rooms::TrackedRoom;
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::{Pose, Twist, adjoint};
use seese3_robot::tracking::{PoseWithCovariance, Sensor, Status, Update};

/// Converts an update. The session fills in `timestamp_ns`, `sequence_number`, `timing` and the
/// camera of the match.
pub fn update(update: &Update, frames: &StreamFrames, rooms: &[TrackedRoom]) -> pb::TrackUpdate {
    // As in REP-105, map_from_odom = map_from_camera · camera_from_odom is the drift correction. It
    // jumps when the pose is corrected, while odom stays continuous.
    let names = &frames.names;
    let odom = odom_of_stream(&update.odom, frames);
    let map_from_odom = update
        .map_pose
        .map(|place| place.pose * odom.pose.inverse());
    let known = update.room.map(|room| &rooms[room]);
    let hypothesis = update.candidate.as_ref();

    pb::TrackUpdate {
        timestamp_ns: 0,
        sequence_number: 0,
        status: status(update.status) as i32,
        reason: update.reason.clone(),
        contradicted: update
            .contradicted
            .iter()
            .map(|&of| sensor(of) as i32)
            .collect(),
        room: known.map(|room| room.revision.clone()),
        camera: Some(camera(update, &odom, frames)),
        base: base(update, &odom, frames),
        map_from_odom: map_from_odom.map(|found| pose(&found, &names.map, &names.odom)),
        keyframe: Some(pb::KeyframeMotion {
            motion: Some(convert::motion_to_wire(
                &update.motion,
                Some(&update.motion_covariance),
            )),
            sequence_number: update.keyframe_sequence,
            is_new: update.is_keyframe,
        }),
        r#match: Some(match_to_wire(update, rooms)),
        hypothesis: hypothesis.map(|hypothesis| pb::PoseHypothesis {
            room: Some(rooms[hypothesis.room].revision.clone()),
            map_from_camera: Some(pose(&hypothesis.map_pose.pose, &names.map, &names.camera)),
            sequence_number: hypothesis.sequence,
            agreed: hypothesis.agreeing,
            needed: hypothesis.needed,
        }),
        timing: None,
    }
}

/// The poses and the velocity of the camera.
fn camera(update: &Update, odom: &PoseWithCovariance, frames: &StreamFrames) -> pb::TrackedBody {
    let names = &frames.names;
    pb::TrackedBody {
        odom_pose: Some(with_covariance(odom, &names.odom, &names.camera)),
        map_pose: update
            .map_pose
            .map(|place| with_covariance(&place, &names.map, &names.camera)),
        velocity: update
            .velocity
            .map(|velocity| convert::motion_to_wire(&velocity, Some(&update.velocity_covariance))),
    }
}

/// The poses and the velocity of the robot's base, if the camera's pose on it is known.
fn base(
    update: &Update,
    odom: &PoseWithCovariance,
    frames: &StreamFrames,
) -> Option<pb::TrackedBody> {
    let names = &frames.names;
    let base_from_camera = frames.base_from_camera?;
    let camera_from_base = base_from_camera.inverse();

    Some(pb::TrackedBody {
        odom_pose: Some(with_covariance(
            &odom.of_attached(&camera_from_base),
            &names.odom,
            &names.base,
        )),
        map_pose: update.map_pose.map(|place| {
            with_covariance(
                &place.of_attached(&camera_from_base),
                &names.map,
                &names.base,
            )
        }),
        velocity: update.velocity.map(|velocity| {
            let base_from_camera = adjoint(&base_from_camera);
            let velocity = base_from_camera * velocity.to_vector();
            let covariance =
                base_from_camera * update.velocity_covariance * base_from_camera.transpose();
            convert::motion_to_wire(&Twist::from_vector(&velocity), Some(&covariance))
        }),
    })
}

/// The comparison of the views with the room. The nearest frame is only reported if the room is
/// known; otherwise it would be misleading.
fn match_to_wire(update: &Update, rooms: &[TrackedRoom]) -> pb::TrackMatch {
    let best = update.best_match.filter(|_| update.room.is_some());
    let novelty = Some(update.out_of_distribution);
    pb::TrackMatch {
        novelty: novelty.filter(|novelty| novelty.is_finite()),
        frame: best.map(|best| rooms[best.room].retrieved(best.frame)),
        used: update.match_used,
        mahalanobis_squared: update.surprise,
        camera_name: String::new(),
    }
}

fn with_covariance(of: &PoseWithCovariance, parent: &str, child: &str) -> pb::PoseWithCovariance {
    pb::PoseWithCovariance {
        pose: Some(pose(&of.pose, parent, child)),
        covariance: convert::matrix_to_wire(&of.ros_covariance()),
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
