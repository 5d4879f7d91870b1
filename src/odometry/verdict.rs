//! Whether a stream is to be believed, and why.

use super::chain::{Chain, REGAINED};
use super::state::State;
use super::tracker::{AGREEING, Tracker};
use super::{Belief, Sighting, Status};

/// Frames without a mapped place after which the place is in doubt.
const UNSEEN: u32 = 10;

impl Tracker {
    /// The status after a frame; `place` is what is believed of where it was taken.
    pub(super) fn status(
        &self,
        state: &State,
        place: Option<&Belief>,
        sighting: &Sighting,
    ) -> (Status, String) {
        if let Chain::Lost { count } = state.chain {
            let why = match (sighting.out_of_distribution > 1.0, count) {
                (true, _) => "the frames do not look like the room".to_owned(),
                (false, 0) => "the view jumped, or nothing is sure of the room yet".to_owned(),
                (false, count) => {
                    format!("{count} of {REGAINED} frames in a row look like the room again")
                }
            };

            return (Status::Lost, why);
        }

        let agreed = state
            .candidate
            .as_ref()
            .map_or(0, |candidate| candidate.agreed);

        let Some(place) = place else {
            let why = match self.settings.fuse {
                true => format!("{agreed} of {AGREEING} anchors agree on a place"),
                false => "nothing is corrected: only a pose that is set tells the place".to_owned(),
            };
            return (Status::Relocalizing, why);
        };

        let deviation = place.position_deviation_m();
        let extent = state.room.map_or(0.0, |room| self.maps[room].extent_m());
        if deviation > extent {
            return (
                Status::Lost,
                format!(
                    "the position is known to {deviation:.1} m, the room is {extent:.1} m wide"
                ),
            );
        }

        if agreed > 0 {
            let why = format!(
                "{agreed} of {AGREEING} anchors speak for another place than the one that is believed"
            );
            return (Status::Degraded, why);
        }

        match state.unseen {
            0..UNSEEN => (
                Status::Tracking,
                "recent frames look like mapped places".to_owned(),
            ),
            unseen => (
                Status::Degraded,
                format!("no mapped place for {unseen} frames"),
            ),
        }
    }
}
