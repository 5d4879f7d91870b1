//! What a tracker says, as it is sent.

use std::sync::Arc;

use super::super::convert;
use super::super::snapshot::ServedNavigator;
use crate::geometry::Pose;
use crate::navigation::Hit;
use crate::odometry::{AGREEING, Status, Update};
use crate::proto::v1 as pb;

/// An update without the frame's own numbers and its time.
pub fn update(
    update: &Update,
    names: &pb::FrameNames,
    served: &[Arc<ServedNavigator>],
) -> pb::TrackUpdate {
    let odom_from_camera = update.odom.pose;
    let map_from_odom = update
        .place
        .map(|place| place.pose * odom_from_camera.inverse());

    let (room, neighbour) = update.best;
    let navigator = &served[room].navigator;
    let hit = Hit {
        neighbour,
        pose: navigator.room().poses()[neighbour.frame.row()],
    };

    let known = update.room.map(|room| &served[room]);
    pb::TrackUpdate {
        timestamp_ns: 0,
        sequence: 0,
        motion: Some(convert::twist_to_wire(&update.motion)),
        motion_covariance: convert::matrix_to_wire(&update.motion_covariance),
        keyframe_sequence: update.keyframe_sequence,
        is_keyframe: update.is_keyframe,
        odom_from_camera: Some(pose(&odom_from_camera, &names.odom, &names.camera)),
        odom_from_camera_covariance: convert::matrix_to_wire(&update.odom.ros_covariance()),
        map_from_odom: map_from_odom.map(|found| pose(&found, &names.map, &names.odom)),
        map_from_camera: update
            .place
            .map(|place| pose(&place.pose, &names.map, &names.camera)),
        map_from_camera_covariance: update.place.map_or_else(Vec::new, |place| {
            convert::matrix_to_wire(&place.ros_covariance())
        }),
        body_velocity: update.velocity.as_ref().map(convert::twist_to_wire),
        status: status(update.status) as i32,
        reason: update.reason.clone(),
        out_of_distribution: update.out_of_distribution,
        room: known.map(|served| convert::room_revision(served)),
        best_match: known.map(|_| convert::hit_to_wire(&hit, navigator.room())),
        match_used: update.used,
        match_surprise: update.surprise,
        elapsed_ns: 0,
        candidate: update
            .candidate
            .as_ref()
            .map(|candidate| pb::PlaceCandidate {
                room: Some(convert::room_revision(&served[candidate.room])),
                map_from_camera: Some(pose(&candidate.place.pose, &names.map, &names.camera)),
                sequence: candidate.sequence,
                agreed: candidate.agreed,
                needed: AGREEING,
            }),
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

fn pose(pose: &Pose, parent: &str, child: &str) -> pb::Pose {
    let named = convert::pose_to_wire(pose, "");
    pb::Pose {
        parent_frame: parent.to_owned(),
        child_frame: child.to_owned(),
        ..named
    }
}
