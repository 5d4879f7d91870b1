//! The status of a stream, with its reason.

use super::{FilterState, PoseFilter, ViewObservation};
use crate::tracking::{PLACE_DEVIATION_M, Status};

impl PoseFilter {
    /// The status after a frame, with its reason.
    pub(super) fn status(&self, state: &FilterState, frame: &ViewObservation) -> (Status, String) {
        let parameters = &self.parameters;
        let place = state.belief.filter(|_| state.is_placed);
        let place = place.map(|belief| belief.place());

        let Some(place) = place else {
            return match &state.candidate {
                Some(candidate) => (
                    Status::Relocalizing,
                    format!(
                        "{} of {} located views agree on a place",
                        candidate.agreeing, parameters.views_to_agree
                    ),
                ),
                None if parameters.fuse => (Status::Lost, not_located(frame)),
                None => (
                    Status::Relocalizing,
                    "corrections are disabled: the stream needs a pose set by the client"
                        .to_owned(),
                ),
            };
        };

        // A position that is less certain than the room is large is useless.
        let deviation = place.position_deviation_m();
        let extent = state.room.map_or(0.0, |room| self.rooms[room].extent_m);
        if deviation > extent.max(PLACE_DEVIATION_M) {
            return (
                Status::Lost,
                format!(
                    "the position uncertainty is {deviation:.1} m, the room is {extent:.1} m wide"
                ),
            );
        }

        if state.unchanged_frames >= parameters.max_unchanged_frames {
            return (
                Status::Degraded,
                format!(
                    "{} consecutive images are identical: the camera is frozen, or a noise-free simulation stands still",
                    state.unchanged_frames + 1
                ),
            );
        }
        if let Some(candidate) = &state.candidate {
            return (
                Status::Degraded,
                format!(
                    "{} of {} located views agree on a place other than the current map pose",
                    candidate.agreeing, parameters.views_to_agree
                ),
            );
        }
        if !place.tells_a_place() {
            return (
                Status::Degraded,
                format!(
                    "the pose uncertainty is {:.2} m and {:.0}° (2.5 standard deviations)",
                    2.5 * deviation,
                    2.5 * place.rotation_deviation_rad().to_degrees()
                ),
            );
        }

        let unlocated_s = state
            .located_ns
            .map_or(0.0, |located| frame.time_ns.abs_diff(located) as f64 * 1e-9);
        if unlocated_s > parameters.max_unlocated_s {
            return (
                Status::Degraded,
                format!(
                    "no view has been located for {unlocated_s:.1} s: {}",
                    not_located(frame)
                ),
            );
        }
        (
            Status::Tracking,
            "recent views are located by their keypoints".to_owned(),
        )
    }
}

fn not_located(frame: &ViewObservation) -> String {
    if frame.unlocated.is_empty() {
        "the view is identical to the one before, or contradicts the pose".to_owned()
    } else {
        frame.unlocated.clone()
    }
}
