//! An adapter as it is read from the store.

use std::sync::Arc;

use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::room::RoomId;
use seese3_robot::fitting::ReadingRules;

/// An adapter that was loaded from the store and reproduced its golden outputs.
#[derive(Debug, Clone)]
pub struct StoredAdapter {
    /// Its name.
    pub name: String,
    /// Counted from 1.
    pub revision: u64,
    /// When it was published, RFC 3339.
    pub created: String,
    /// The adapter. All rooms share it: a tracker takes maps of several rooms only if their adapter
    /// is the same `Arc`, compared by pointer.
    pub adapter: Arc<Adapter>,
    /// How it was trained.
    pub record: TrainingRecord,
    /// The room that it was fitted to, and how far it may be believed there; none for an adapter
    /// that is meant for any room.
    pub room_fit: Option<RoomFit>,
    /// Whether it belongs to an experiment: it answers where it is named, or where no other does.
    pub is_experiment: bool,
}

/// What makes an adapter one of a single room.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomFit {
    /// The room.
    pub room: RoomId,
    /// The revision of the room whose frames it was fitted to.
    pub room_revision: u64,
    /// The adapter of other rooms that reads motions beside it, if there is one.
    pub base: Option<BaseAdapter>,
    /// Which reader is believed, by the distance of a view from the map.
    pub rules: ReadingRules,
}

/// A published revision of an adapter, which never changes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BaseAdapter {
    /// Its name.
    pub name: String,
    /// Its revision.
    pub revision: u64,
}
