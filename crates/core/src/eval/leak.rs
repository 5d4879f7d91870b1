//! Whether a score leaks: whether an adapter may have trained on the very pairs that it is tested
//! on. This is the one place that decides it; commands, the service and reports ask here.

use crate::adapter::TrainingRecord;
use crate::room::RoomId;
use crate::splits::Split;

/// What an adapter has seen of a room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainedOn {
    /// Nothing: the room is new to it.
    Nothing,
    /// The frames that it is tested on were among those it could be trained on.
    TheseFrames,
    /// The room, but other frames of it: an earlier import under the same name.
    OtherFrames,
}

/// Why a score must not be taken for one on held-out pairs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Leak {
    /// The adapter was trained under another split, or under one that keeps no frames apart.
    Split,
    /// The adapter was trained on other frames of the room, so its split says nothing of these.
    OtherFrames,
}

impl Leak {
    /// The leak of testing under `split` in a room of which the adapter has seen `trained_on`; none
    /// if the test pairs are held out.
    pub fn of(record: &TrainingRecord, trained_on: TrainedOn, split: Split) -> Option<Self> {
        // Under `whole` every pair is trained on; under `pairs` the pairs differ, but their frames
        // were all seen.
        let keeps_frames_apart = !matches!(record.split, Split::Whole | Split::Pairs);

        match trained_on {
            TrainedOn::Nothing => None,
            TrainedOn::OtherFrames => Some(Self::OtherFrames),
            TrainedOn::TheseFrames if record.split == split && keeps_frames_apart => None,
            TrainedOn::TheseFrames => Some(Self::Split),
        }
    }
}

/// Whether the adapter's errors were measured in a room, so that calibrated navigators and trackers
/// have seen its poses.
pub fn is_calibrated_in(record: &TrainingRecord, room: &RoomId) -> bool {
    record.calibrated_on.iter().any(|(name, _)| name == room)
}

/// Whether the adapter was trained or calibrated in a room.
pub fn has_seen(record: &TrainingRecord, room: &RoomId) -> bool {
    record.rooms.iter().any(|(name, _)| name == room) || is_calibrated_in(record, room)
}
