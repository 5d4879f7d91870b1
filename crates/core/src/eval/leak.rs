//! Data leakage: whether an adapter may have been trained on its test pairs. Commands, the service
//! and reports all use this check.

use super::navigators::Report;
use crate::adapter::TrainingRecord;
use crate::navigation::{NavigatorKind, RetrievalMetric};
use crate::room::RoomId;
use crate::splits::Split;

/// Overlap of an adapter's training data with a room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainedOn {
    /// None: the room is not in the training set.
    Nothing,
    /// The training set contains the room with the same frames.
    TheseFrames,
    /// The training set contains the room with other frames: an earlier import under the same name.
    OtherFrames,
}

/// Why a score is not a held-out score.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Leak {
    /// The adapter was trained with another split, or with one that holds out no frames.
    Split,
    /// The adapter was trained on other frames of the room, so its split does not apply to these.
    OtherFrames,
}

impl Leak {
    /// The leak of a test with `split` in a room with the overlap `trained_on`; `None` if the test
    /// pairs are held out.
    pub fn of(record: &TrainingRecord, trained_on: TrainedOn, split: Split) -> Option<Self> {
        // `whole` trains on every pair; `pairs` holds out pairs, but trains on all frames.
        let keeps_frames_apart = !matches!(record.split, Split::Whole | Split::Pairs);

        match trained_on {
            TrainedOn::Nothing => None,
            TrainedOn::OtherFrames => Some(Self::OtherFrames),
            TrainedOn::TheseFrames if record.split == split && keeps_frames_apart => None,
            TrainedOn::TheseFrames => Some(Self::Split),
        }
    }
}

/// Whether the adapter was calibrated in a room: calibrated navigators and trackers then depend on
/// its poses.
pub fn is_calibrated_in(record: &TrainingRecord, room: &RoomId) -> bool {
    record.calibrated_on.iter().any(|(name, _)| name == room)
}

/// Whether the adapter was trained or calibrated in a room.
pub fn has_seen(record: &TrainingRecord, room: &RoomId) -> bool {
    record.rooms.iter().any(|(name, _)| name == room) || is_calibrated_in(record, room)
}

impl Report {
    /// This report with its leaking rows marked. With a `leak`, the rows of all navigators that use
    /// the adapter leak; the baselines do not use it. If the adapter was calibrated in the room,
    /// the rows of calibrated navigators leak.
    #[must_use]
    pub fn marked(mut self, leak: Option<Leak>, is_calibrated_here: bool) -> Self {
        for row in &mut self.rows {
            row.leaks = match NavigatorKind::from_name(&row.name) {
                Some(NavigatorKind::Identity | NavigatorKind::Random | NavigatorKind::Oracle) => {
                    false
                }
                Some(NavigatorKind::Step(_, RetrievalMetric::Calibrated)) => {
                    leak.is_some() || is_calibrated_here
                }
                Some(NavigatorKind::Step(..) | NavigatorKind::Relational) | None => leak.is_some(),
            };
        }
        self
    }
}
