//! The localization status of a stream, with its reason.

use super::health::{FRAMES_TO_RECOVER, TrackingHealth};
use super::map::MapMatch;
use super::pose_with_covariance::PLACE_DEVIATION_M;
use super::rig::MatchedView;
use super::sight::Sight;
use super::state::State;
use super::tracker::Tracker;
use super::{ANCHORS_TO_AGREE, PoseWithCovariance, Status};

/// Number of frames without a match after which a stream is DEGRADED.
const FRAMES_UNTIL_DOUBT: u32 = 10;

impl Tracker {
    /// The status after a frame, with its reason as text. `reported_pose` is the frame's map pose
    /// while the filter has one. `gravity_error_rad` is the angle between measured and expected
    /// gravity, if it is outside the gate.
    pub(super) fn status(
        &self,
        state: &State,
        reported_pose: Option<&PoseWithCovariance>,
        leading: &MatchedView<'_>,
        gravity_error_rad: Option<f64>,
    ) -> (Status, String) {
        if let TrackingHealth::Lost { certain_matches } = state.health {
            return (
                Status::Lost,
                reason_of_loss(certain_matches, &leading.matched),
            );
        }

        let agreeing = state
            .candidate
            .as_ref()
            .map_or(0, |candidate| candidate.agreeing_anchors);

        let Some(reported_pose) = reported_pose else {
            let reason = if self.settings.fuse {
                format!("{agreeing} of {ANCHORS_TO_AGREE} anchors agree on a place")
            } else {
                "corrections are disabled: the stream needs a pose set by the client".to_owned()
            };
            return (Status::Relocalizing, reason);
        };

        // A position uncertainty above the extent of the room is useless. The lower bound covers
        // rooms mapped without translation.
        let deviation = reported_pose.position_deviation_m();
        let extent = state.room.map_or(0.0, |room| self.maps[room].extent_m());
        if deviation > extent.max(PLACE_DEVIATION_M) {
            let reason = format!(
                "the position uncertainty is {deviation:.1} m, the room is {extent:.1} m wide"
            );
            return (Status::Lost, reason);
        }

        let blind = reason_of_blindness(leading.sight, state.unchanged_frames);
        if let Some(reason) = blind {
            return (Status::Degraded, reason);
        }

        if agreeing > 0 {
            let reason = format!(
                "{agreeing} of {ANCHORS_TO_AGREE} anchors agree on a place other than the current map pose"
            );
            return (Status::Degraded, reason);
        }

        // TRACKING requires an uncertainty of at most 0.5 m and 15°, at 2.5 standard deviations.
        if !reported_pose.tells_a_place() {
            let turn = reported_pose.rotation_deviation_rad().to_degrees();
            let reason = format!(
                "the pose uncertainty is {:.2} m and {:.0}° (2.5 standard deviations)",
                2.5 * deviation,
                2.5 * turn
            );
            return (Status::Degraded, reason);
        }

        if let Some(angle) = gravity_error_rad {
            let reason = format!(
                "measured gravity differs by {:.0}° from the estimated pose: the robot accelerates, or gravity_in_map or the sensor's axes are wrong",
                angle.to_degrees()
            );
            return (Status::Degraded, reason);
        }

        match state.frames_off_map {
            0..FRAMES_UNTIL_DOUBT => (Status::Tracking, "recent frames match the map".to_owned()),
            frames => (
                Status::Degraded,
                format!("no frame has matched the map for {frames} frames"),
            ),
        }
    }
}

/// The reason why a view cannot be used; `None` if it can.
fn reason_of_blindness(sight: Sight, unchanged_frames: u32) -> Option<String> {
    match sight {
        Sight::Clear => None,
        Sight::Nothing => Some("the image is blank: it has nearly uniform brightness".to_owned()),
        Sight::Unchanged => Some(format!(
            "{} consecutive frames are identical: the camera is frozen, or a noise-free simulation stands still",
            unchanged_frames + 1
        )),
    }
}

fn reason_of_loss(certain_matches: u32, matched: &MapMatch) -> String {
    if matched.out_of_distribution > 1.0 {
        return "the frames do not match the room".to_owned();
    }

    match certain_matches {
        0 => "the view jumped, or no frame matches the room with certainty yet".to_owned(),
        count => {
            format!("{count} of {FRAMES_TO_RECOVER} consecutive frames match the room again")
        }
    }
}
