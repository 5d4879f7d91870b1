//! The status of a stream: whether its pose should be trusted, and why.

use super::health::{FRAMES_TO_RECOVER, TrackingHealth};
use super::map::MapMatch;
use super::pose_with_covariance::PLACE_DEVIATION_M;
use super::rig::MatchedView;
use super::sight::Sight;
use super::state::State;
use super::tracker::Tracker;
use super::{ANCHORS_TO_AGREE, PoseWithCovariance, Status};

/// Frames without a match after which a known place is in doubt.
const FRAMES_UNTIL_DOUBT: u32 = 10;

impl Tracker {
    /// The status after a frame, and the reason in words. `reported_pose` is where the frame was
    /// taken, if that is believed; `gravity_error_rad` is by how much measured gravity contradicts it,
    /// radians.
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
                "nothing is corrected: only a pose that is set tells the place".to_owned()
            };
            return (Status::Relocalizing, reason);
        };

        // A position that is known to no better than the size of the room says nothing, unless the
        // room was mapped on the spot.
        let deviation = reported_pose.position_deviation_m();
        let extent = state.room.map_or(0.0, |room| self.maps[room].extent_m());
        if deviation > extent.max(PLACE_DEVIATION_M) {
            let reason = format!(
                "the position is known to {deviation:.1} m, the room is {extent:.1} m wide"
            );
            return (Status::Lost, reason);
        }

        let blind = reason_of_blindness(leading.sight, state.unchanged_frames);
        if let Some(reason) = blind {
            return (Status::Degraded, reason);
        }

        if agreeing > 0 {
            let reason = format!(
                "{agreeing} of {ANCHORS_TO_AGREE} anchors speak for another place than the one that is believed"
            );
            return (Status::Degraded, reason);
        }

        // What is called TRACKING may be relied on to half a metre and 15 degrees.
        if !reported_pose.tells_a_place() {
            let turn = reported_pose.rotation_deviation_rad().to_degrees();
            let reason = format!(
                "the pose is known to {:.2} m and {:.0}° only, 2.5 standard deviations",
                2.5 * deviation,
                2.5 * turn
            );
            return (Status::Degraded, reason);
        }

        if let Some(angle) = gravity_error_rad {
            let reason = format!(
                "gravity is measured {:.0}° from where the views place it: the robot speeds up or brakes, or gravity_in_map or the sensor's axes are not what was said",
                angle.to_degrees()
            );
            return (Status::Degraded, reason);
        }

        match state.frames_off_map {
            0..FRAMES_UNTIL_DOUBT => (
                Status::Tracking,
                "recent frames look like mapped places".to_owned(),
            ),
            frames => (
                Status::Degraded,
                format!("no mapped place for {frames} frames"),
            ),
        }
    }
}

/// Why a view shows nothing, if it does not.
fn reason_of_blindness(sight: Sight, unchanged_frames: u32) -> Option<String> {
    match sight {
        Sight::Clear => None,
        Sight::Nothing => {
            Some("the image shows nothing: it is blank, or all bright or dark".to_owned())
        }
        Sight::Unchanged => Some(format!(
            "{} frames in a row are the same image: the camera is frozen, or a simulation without noise stands still",
            unchanged_frames + 1
        )),
    }
}

fn reason_of_loss(certain_matches: u32, matched: &MapMatch) -> String {
    if matched.out_of_distribution > 1.0 {
        return "the frames do not look like the room".to_owned();
    }

    match certain_matches {
        0 => "the view jumped, or nothing is sure of the room yet".to_owned(),
        count => {
            format!("{count} of {FRAMES_TO_RECOVER} frames in a row look like the room again")
        }
    }
}
