//! The status of a stream, with its reason.

use super::gravity::Tilted;
use super::{FilterCandidate, FilterState, PoseFilter, ViewObservation};
use crate::tracking::{PLACE_DEVIATION_M, PoseWithCovariance, Status};

impl PoseFilter {
    /// The status after a frame, with its reason.
    pub(super) fn status(
        &self,
        state: &FilterState,
        frame: &ViewObservation,
        tilted: Option<Tilted>,
    ) -> (Status, String) {
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

        let doubt = self.doubt(state, frame, &place);
        match doubt.or_else(|| tilted.map(|tilted| contradiction(&tilted))) {
            Some(reason) => (Status::Degraded, reason),
            None => {
                let reason = if !self.parameters.fuse {
                    "the client has set the pose, and it is still certain"
                } else if state.unchanged_frames == 0 && frame.unlocated.is_empty() {
                    "this view is located in the map"
                } else if frame.visual.is_some() {
                    "visual odometry carries the pose since the last located view"
                } else {
                    "the image is the same as before, or the client has set the pose"
                };
                (Status::Tracking, reason.to_owned())
            }
        }
    }

    /// The status without a map pose.
    fn unplaced(&self, state: &FilterState, frame: &ViewObservation) -> (Status, String) {
        if !self.parameters.fuse {
            let reason = "corrections are disabled: the stream needs a pose set by the client";
            return (Status::Lost, reason.to_owned());
        }
        match &state.candidate {
            Some(candidate) => (Status::Relocalizing, agreement(candidate, "on a place")),
            None => (Status::Lost, why_unlocated(state, frame)),
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
        // While the stream's own camera is frozen, only another camera locates it.
        let is_seen = frame.located.iter().any(|located| located.camera.is_some());
        if state.unchanged_frames >= parameters.max_unchanged_frames && !is_seen {
            return Some(format!(
                "{} consecutive images are identical: the camera is frozen, or a noise-free simulation stands still",
                state.unchanged_frames + 1
            ));
        }
        let is_blind = frame.fingerprint.is_none() && frame.located.is_empty();
        if is_blind && parameters.fuse {
            return Some(why_unlocated(state, frame));
        }
        // Without the wheels, or the inertial sensor, images carry the pose.
        if state.contradicted.images && !parameters.trust_wheels {
            let reason = if state.contradicted.wheels {
                "wheel odometry and the images contradict each other: wheels slip, or the camera is frozen. They \
                 are used again when they agree while moving"
            } else {
                "the images contradict the other sensors of motion: the camera is frozen, or shows \
                 something that moves"
            };
            return Some(reason.to_owned());
        }
        if let Some(candidate) = &state.candidate {
            let place = "on a place other than the current map pose";
            return Some(agreement(candidate, place));
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

        (!state.is_carried).then(|| {
            let since_s = |earlier: i64| frame.time_ns.abs_diff(earlier) as f64 * 1e-9;
            let unlocated_s = state.located_ns.map_or(0.0, since_s);
            let why = if parameters.fuse {
                why_unlocated(state, frame)
            } else {
                "corrections are disabled".to_owned()
            };
            format!("no view has been located for {unlocated_s:.2} s: {why}")
        })
    }
}

/// How many views support a candidate; `place` is for example "on a place".
fn agreement(candidate: &FilterCandidate, place: &str) -> String {
    let FilterCandidate {
        agreeing,
        needed,
        contradicts_last,
        ..
    } = candidate;
    let dispute = if *contradicts_last {
        "; the last two contradict each other: timestamps or motion sensors may be wrong"
    } else {
        ""
    };
    format!("{agreeing} of {needed} located views agree {place}{dispute}")
}

fn contradiction(tilted: &Tilted) -> String {
    format!(
        "measured gravity differs by {:.0}° from the estimated pose: the robot accelerates, or gravity_in_map or the \
         sensor's axes are wrong",
        tilted.angle_rad.to_degrees()
    )
}

fn why_unlocated(state: &FilterState, frame: &ViewObservation) -> String {
    if !frame.unlocated.is_empty() {
        frame.unlocated.clone()
    } else if state.unchanged_frames > 0 {
        "the view is identical to the one before".to_owned()
    } else {
        "the view contradicts the pose".to_owned()
    }
}
