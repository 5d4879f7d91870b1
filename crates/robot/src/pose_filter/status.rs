//! The status of a stream, with its reason.

use super::{FilterState, PoseFilter, ViewObservation};
use crate::tracking::{PLACE_DEVIATION_M, PoseWithCovariance, Status};

impl PoseFilter {
    /// The status after a frame, with its reason.
    pub(super) fn status(&self, state: &FilterState, frame: &ViewObservation) -> (Status, String) {
        let place = state.belief.filter(|_| state.is_placed);
        let Some(place) = place.map(|belief| belief.place()) else {
            return self.unplaced(state, frame);
        };

        // A position that is less certain than the room is large is useless.
        let deviation = place.position_deviation_m();
        let extent = state.room.map_or(0.0, |room| self.rooms[room].extent_m);
        if deviation > extent.max(PLACE_DEVIATION_M) {
            let reason = format!(
                "the position uncertainty is {deviation:.1} m, the room is {extent:.1} m wide"
            );
            return (Status::Lost, reason);
        }

        match self.doubt(state, frame, &place) {
            Some(reason) => (Status::Degraded, reason),
            None => {
                let reason = if !self.parameters.fuse {
                    "the client has set the pose, and it is still certain"
                } else if frame.unlocated.is_empty() {
                    "recent views are located by their keypoints"
                } else if frame.visual.is_some() {
                    "visual odometry carries the pose since the last located view"
                } else {
                    "a view was located, or the client has set the pose, a moment ago"
                };
                (Status::Tracking, reason.to_owned())
            }
        }
    }

    /// The status without a map pose.
    fn unplaced(&self, state: &FilterState, frame: &ViewObservation) -> (Status, String) {
        if !self.parameters.fuse {
            let reason = "corrections are disabled: the stream needs a pose set by the client";
            return (Status::Relocalizing, reason.to_owned());
        }
        match &state.candidate {
            Some(candidate) => {
                let reason = format!("{} on a place", self.agreement(candidate.agreeing));
                (Status::Relocalizing, reason)
            }
            None => (Status::Lost, why_unlocated(frame)),
        }
    }

    /// Why a map pose is not to be trusted like one that is TRACKING; `None` if it is.
    fn doubt(
        &self,
        state: &FilterState,
        frame: &ViewObservation,
        place: &PoseWithCovariance,
    ) -> Option<String> {
        let parameters = &self.parameters;
        if state.unchanged_frames >= parameters.max_unchanged_frames {
            return Some(format!(
                "{} consecutive images are identical: the camera is frozen, or a noise-free simulation stands still",
                state.unchanged_frames + 1
            ));
        }
        let since_s = |earlier: i64| frame.time_ns.abs_diff(earlier) as f64 * 1e-9;
        let contradicted_s = state.contradicted_ns.map(since_s);
        if contradicted_s.is_some_and(|seconds| seconds < parameters.disagreement_time_s) {
            return Some(
                "wheel odometry and the images contradict each other: wheels slip, or the camera is \
                 frozen"
                    .to_owned(),
            );
        }
        if let Some(candidate) = &state.candidate {
            let agreement = self.agreement(candidate.agreeing);
            return Some(format!(
                "{agreement} on a place other than the current map pose"
            ));
        }
        let [most_m, most_rad] = parameters.max_deviation;
        let deviations = [place.position_deviation_m(), place.rotation_deviation_rad()];
        if deviations[0] > most_m || deviations[1] > most_rad {
            return Some(format!(
                "the standard deviations of the pose are {:.2} m and {:.1}°; at most {most_m:.2} m and {:.1}° \
                 are trusted",
                deviations[0],
                deviations[1].to_degrees(),
                most_rad.to_degrees()
            ));
        }

        let unlocated_s = state.sight_ns.map_or(0.0, since_s);
        (unlocated_s > parameters.max_unlocated_s).then(|| {
            let why = if parameters.fuse {
                why_unlocated(frame)
            } else {
                "corrections are disabled".to_owned()
            };
            format!("no view has been located for {unlocated_s:.1} s: {why}")
        })
    }

    fn agreement(&self, agreeing: u32) -> String {
        format!(
            "{agreeing} of {} located views agree",
            self.parameters.views_to_agree
        )
    }
}

fn why_unlocated(frame: &ViewObservation) -> String {
    if frame.unlocated.is_empty() {
        "the view is identical to the one before, or contradicts the pose".to_owned()
    } else {
        frame.unlocated.clone()
    }
}
