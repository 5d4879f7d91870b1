//! A room that is served. What its manifest says is always at hand; frames, latents and indexes are
//! loaded when they are asked for, and may be dropped and loaded again.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::super::Error;
use super::cache::{Key, RoomCache};
use super::content::Content;
use super::{Refusal, refused_error};
use crate::store::{RoomSummary, StoredAdapter};
use seese3_core::eval::TrainedOn;
use seese3_core::features::FeatureSource;
use seese3_core::fitting::RoomReader;
use seese3_core::navigation::Navigator;
use seese3_core::room::RoomId;
use seese3_core::tracking::Map;

/// A revision of a room that is served.
pub struct ServedRoom {
    /// The room's name.
    pub id: RoomId,
    /// What its manifest says.
    pub summary: RoomSummary,
    /// The adapters that fit the room, in order of preference.
    pub(super) candidates: Vec<Candidate>,
    /// What the last loading has shown; none before the first.
    shown: Mutex<Option<Shown>>,
    cache: Arc<RoomCache>,
    pub(super) key: Key,
}

/// An adapter that fits a room by its features.
#[derive(Clone)]
pub struct Candidate {
    /// The revision that is to serve the room.
    pub adapter: Arc<StoredAdapter>,
    /// The revision before, which goes on where the new one cannot serve the room.
    pub earlier: Option<Arc<StoredAdapter>>,
}

/// What loading a room shows of it.
enum Shown {
    Loaded {
        adapters: Vec<Arc<StoredAdapter>>,
        refused: BTreeMap<String, Refusal>,
    },
    Refused(Refusal),
}

/// What answers in a room are computed from.
pub struct LoadedRoom {
    /// One for each adapter that serves the room, in order of preference.
    pub navigators: Vec<Arc<ServedNavigator>>,
    /// Adapters that fit by their features and still cannot serve the room, by name.
    pub refused: BTreeMap<String, Refusal>,
}

/// A room under one adapter that fits it.
pub struct ServedNavigator {
    /// Retrieves frames and plans motions in the latents of this adapter.
    pub navigator: Arc<Navigator>,
    /// The map for tracking and relocalisation; none if the adapter is not calibrated or the room
    /// is too small.
    pub map: Option<Arc<Map>>,
    /// The adapter as it is stored, with its training record.
    pub adapter: Arc<StoredAdapter>,
    /// The identity of the adapter and the room's frames.
    pub content: Content,
    /// The room's revision.
    pub room_revision: u64,
    /// What the adapter has seen of this room.
    pub trained_on: TrainedOn,
    /// Locates single views, where the adapter was fitted to these very frames.
    pub reader: Option<Arc<RoomReader>>,
    /// The reader of an adapter that comes before this one, from which the map takes its anchors.
    pub(super) tracking_reader: Option<Arc<RoomReader>>,
}

impl ServedRoom {
    pub(super) fn new(
        id: RoomId,
        summary: RoomSummary,
        candidates: Vec<Candidate>,
        cache: Arc<RoomCache>,
    ) -> Self {
        Self {
            id,
            summary,
            candidates,
            shown: Mutex::new(None),
            key: cache.new_key(),
            cache,
        }
    }

    /// The adapters that serve the room, in order of preference. Before the room was loaded for the
    /// first time: those that should.
    pub fn adapters(&self) -> Vec<Arc<StoredAdapter>> {
        match &*self.shown() {
            Some(Shown::Loaded { adapters, .. }) => adapters.clone(),
            Some(Shown::Refused(_)) | None => self
                .candidates
                .iter()
                .map(|candidate| candidate.adapter.clone())
                .collect(),
        }
    }

    /// Whether an adapter of this name serves the room, as far as is known.
    pub fn is_served_by(&self, adapter: &str) -> bool {
        self.adapters().iter().any(|served| served.name == adapter)
    }

    /// Why the room cannot be loaded, if that was tried.
    pub fn refusal(&self) -> Option<Refusal> {
        match &*self.shown() {
            Some(Shown::Refused(refusal)) => Some(refusal.clone()),
            _ => None,
        }
    }

    /// Why an adapter that fits by its features does not serve the room, by name.
    pub fn refused_adapters(&self) -> BTreeMap<String, Refusal> {
        match &*self.shown() {
            Some(Shown::Loaded { refused, .. }) => refused.clone(),
            _ => BTreeMap::new(),
        }
    }

    /// Everything that answers are computed from. Reads the store if the room is not in memory:
    /// only for threads that may block.
    ///
    /// # Errors
    /// [`Error::Precondition`] if the room cannot be loaded. The log says why.
    pub fn load(&self) -> Result<Arc<LoadedRoom>, Error> {
        // Damaged files do not heal. A file that could not be read is tried again.
        let refused = self.refusal().filter(|refusal| !refusal.may_pass);
        let loaded = match refused {
            Some(refusal) => Err(refusal),
            None => self.cache.get_or_load(self),
        };

        loaded.map_err(|refusal| refused_error("room", self.id.as_str(), &refusal))
    }

    /// What is in memory, if anything is.
    pub(super) fn in_memory(&self) -> Option<Arc<LoadedRoom>> {
        self.cache.get(self.key)
    }

    /// Remembers what loading has shown.
    pub(super) fn remember(&self, loaded: Result<&LoadedRoom, &Refusal>) {
        let now = match loaded {
            Ok(loaded) => Shown::Loaded {
                adapters: loaded
                    .navigators
                    .iter()
                    .map(|served| served.adapter.clone())
                    .collect(),
                refused: loaded.refused.clone(),
            },
            Err(refusal) => Shown::Refused(refusal.clone()),
        };
        *self.shown() = Some(now);
    }

    fn shown(&self) -> std::sync::MutexGuard<'_, Option<Shown>> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ServedRoom {
    fn drop(&mut self) {
        self.cache.forget(self.key);
    }
}

impl LoadedRoom {
    /// The room under an adapter of this name.
    pub fn under_any(&self, adapter: &str) -> Option<&Arc<ServedNavigator>> {
        self.navigators
            .iter()
            .find(|served| served.adapter.name == adapter)
    }

    /// The room under this revision of an adapter, if trackers there take their anchors from
    /// `tracking_reader`.
    pub(super) fn under(
        &self,
        adapter: &StoredAdapter,
        tracking_reader: Option<&Arc<RoomReader>>,
    ) -> Option<&Arc<ServedNavigator>> {
        let is_same_reader =
            |served: &ServedNavigator| match (&served.tracking_reader, tracking_reader) {
                (Some(before), Some(now)) => Arc::ptr_eq(before, now),
                (None, None) => true,
                _ => false,
            };

        self.navigators
            .iter()
            .find(|served| served.is_of(adapter) && is_same_reader(served))
    }

    /// About how much memory it holds, bytes.
    pub(super) fn memory_bytes(&self) -> usize {
        let room = self.navigators.first();
        let room = room.map_or(0, |served| served.navigator.room().memory_bytes());
        let navigators = self.navigators.iter();

        room + navigators
            .map(|served| served.memory_bytes())
            .sum::<usize>()
    }
}

impl ServedNavigator {
    /// The reader of the adapter that was fitted to this room, if there is one for features of this
    /// adapter's source; that of the newest of several.
    pub fn room_reader(&self) -> Option<&RoomReader> {
        let newest = self.tracking_reader.as_ref().or(self.reader.as_ref());
        newest.map(Arc::as_ref)
    }

    fn is_of(&self, adapter: &StoredAdapter) -> bool {
        self.adapter.name == adapter.name && self.adapter.revision == adapter.revision
    }

    fn memory_bytes(&self) -> usize {
        let map = self.map.as_ref().map_or(0, |map| map.memory_bytes());
        let reader = self.reader.as_ref();
        let reader = reader.map_or(0, |reader| reader.localizer.memory_bytes());

        self.navigator.memory_bytes() + map + reader
    }
}

/// The reader of the first adapter for features of this source that has one.
pub(super) fn reader_of<'a>(
    navigators: &'a [Arc<ServedNavigator>],
    source: &FeatureSource,
) -> Option<&'a Arc<RoomReader>> {
    navigators
        .iter()
        .filter(|served| served.adapter.adapter.source().is_like(source))
        .find_map(|served| served.reader.as_ref())
}
