//! An adapter loaded from the store.

use std::sync::Arc;

use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::room::RoomId;
use seese3_robot::fitting::ReadingRules;

/// An adapter that was loaded from the store and reproduced its golden outputs.
#[derive(Debug, Clone)]
pub struct StoredAdapter {
    /// The adapter's name.
    pub name: String,
    /// Revision number, from 1.
    pub revision: u64,
    /// Time of publication, RFC 3339.
    pub created: String,
    /// The adapter, shared by all rooms. A tracker accepts maps of several rooms only if they use
    /// the same `Arc`, compared by pointer.
    pub adapter: Arc<Adapter>,
    /// Training record.
    pub record: TrainingRecord,
    /// The room it was fitted to, with the rules for using it there; `None` for an adapter for any
    /// room.
    pub room_fit: Option<RoomFit>,
    /// Whether it belongs to an experiment: used only when requested by name, or where no other
    /// adapter fits.
    pub is_experiment: bool,
}

/// The fit of an adapter to a single room.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomFit {
    /// The room.
    pub room: RoomId,
    /// The revision of the room whose frames it was fitted to.
    pub room_revision: u64,
    /// The pre-trained base adapter, which predicts motions alongside the fitted one, if any.
    pub base: Option<BaseAdapter>,
    /// Selection of the motion predictor, by the distance of a view from the map.
    pub rules: ReadingRules,
}

/// Reference to a published revision of the base adapter; published revisions never change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BaseAdapter {
    /// Its name.
    pub name: String,
    /// Its revision.
    pub revision: u64,
}
