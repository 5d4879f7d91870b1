//! A served room. Its manifest summary is always in memory; frames, latents and indexes are loaded
//! on demand, and may be evicted and reloaded.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::super::Error;
use super::super::status::Full;
use super::super::workers::off_the_lane;
use super::cache::{Key, RoomCache};
use super::loaded::{Candidate, LoadedRoom};
use super::room_loading::RoomToLoad;
use super::{Refusal, refused_error};
use seese3_core::room::RoomId;
use seese3_store::{RoomSummary, StoredAdapter};

/// A served revision of a room.
pub struct ServedRoom {
    /// The room's name.
    pub id: RoomId,
    /// Summary of the manifest.
    pub summary: RoomSummary,
    /// The adapters compatible with the room, in order of preference.
    pub(super) candidates: Vec<Candidate>,
    /// Result of the last load; `None` before the first.
    load_state: Mutex<Option<LoadState>>,
    cache: Arc<RoomCache>,
    pub(super) key: Key,
}

/// Result of loading a room.
enum LoadState {
    Loaded {
        adapters: Vec<Arc<StoredAdapter>>,
        refused: BTreeMap<String, Refusal>,
    },
    Refused(Refusal),
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
            load_state: Mutex::new(None),
            key: cache.new_key(),
            cache,
        }
    }

    /// The adapters that serve the room, in order of preference. Before the first load: the
    /// candidates.
    pub fn adapters(&self) -> Vec<Arc<StoredAdapter>> {
        match &*self.load_state() {
            Some(LoadState::Loaded { adapters, .. }) => adapters.clone(),
            Some(LoadState::Refused(_)) | None => self
                .candidates
                .iter()
                .map(|candidate| candidate.adapter.clone())
                .collect(),
        }
    }

    /// The number of latent coordinates of the adapter that has most of them.
    pub fn widest_latent(&self) -> usize {
        let adapters = self.candidates.iter().map(|candidate| &candidate.adapter);
        let widths = adapters.map(|stored| stored.adapter.latent_dim());
        widths.max().unwrap_or(0)
    }

    /// Whether an adapter of this name serves the room; before the first load, whether it is a
    /// candidate.
    pub fn is_served_by(&self, adapter: &str) -> bool {
        self.adapters().iter().any(|served| served.name == adapter)
    }

    /// Why the last load failed, if it did.
    pub fn refusal(&self) -> Option<Refusal> {
        match &*self.load_state() {
            Some(LoadState::Refused(refusal)) => Some(refusal.clone()),
            _ => None,
        }
    }

    /// The adapters that have matching features but cannot serve the room, with the reason; by
    /// name.
    pub fn refused_adapters(&self) -> BTreeMap<String, Refusal> {
        match &*self.load_state() {
            Some(LoadState::Loaded { refused, .. }) => refused.clone(),
            _ => BTreeMap::new(),
        }
    }

    /// The loaded room. Reads the store if the room is not in memory: call only on threads that may
    /// block.
    ///
    /// # Errors
    /// [`Error::Precondition`] if the room cannot be loaded; the log says why. [`Error::Full`] if
    /// too many requests wait for the disk.
    pub fn load(&self) -> Result<Arc<LoadedRoom>, Error> {
        // Damaged files are not read again; unreadable ones are retried.
        let refused = self.refusal().filter(|refusal| !refusal.may_pass);
        let loaded = match refused {
            Some(refusal) => Err(refusal),
            None => match self.cache.get(self.key) {
                Some(room) => Ok(room),
                // Other rooms are answered meanwhile: the store may not answer.
                None => {
                    let loaded = off_the_lane(|| self.get_or_load());
                    let what = Full::DiskReads;
                    loaded.map_err(|_| Error::Full { what })?
                }
            },
        };

        loaded.map_err(|refusal| refused_error("room", self.id.as_str(), &refusal))
    }

    fn get_or_load(&self) -> Result<Arc<LoadedRoom>, Refusal> {
        self.cache.get_or_load(self.key, || {
            let known = self.refusal();
            let loaded = self.cache.block_on(self.loaded(Some(self)));
            if let Err(refusal) = &loaded
                && known.as_ref() != Some(refusal)
            {
                refusal.log("room", self.id.as_str());
            }
            loaded
        })
    }

    /// Loads the room before its first request. `before` is the same revision in the previous
    /// snapshot; its unchanged parts are reused.
    ///
    /// # Errors
    /// The reason why the room cannot be loaded.
    pub(super) async fn preload(&self, before: Option<&ServedRoom>) -> Result<(), Refusal> {
        let loaded = self.loaded(before).await?;
        self.cache.insert(self.key, loaded);
        Ok(())
    }

    async fn loaded(&self, before: Option<&ServedRoom>) -> Result<Arc<LoadedRoom>, Refusal> {
        let loaded_before = before.and_then(ServedRoom::in_memory);
        let loaded = self.cache.load(RoomToLoad {
            id: &self.id,
            revision: self.summary.revision,
            candidates: &self.candidates,
            refused_before: before.map_or_else(BTreeMap::new, ServedRoom::refused_adapters),
            loaded_before: loaded_before.as_deref(),
        });
        let loaded = loaded.await;

        self.remember(loaded.as_ref());
        loaded.map(Arc::new)
    }

    /// Whether the room is in memory now.
    pub fn is_in_memory(&self) -> bool {
        self.in_memory().is_some()
    }

    /// The loaded room, if it is in memory.
    pub(super) fn in_memory(&self) -> Option<Arc<LoadedRoom>> {
        self.cache.get(self.key)
    }

    /// Stores the result of a load.
    pub(super) fn remember(&self, loaded: Result<&LoadedRoom, &Refusal>) {
        let now = match loaded {
            Ok(loaded) => LoadState::Loaded {
                adapters: loaded
                    .navigators
                    .iter()
                    .map(|served| served.adapter.clone())
                    .collect(),
                refused: loaded.refused.clone(),
            },
            Err(refusal) => LoadState::Refused(refusal.clone()),
        };
        *self.load_state() = Some(now);
    }

    fn load_state(&self) -> std::sync::MutexGuard<'_, Option<LoadState>> {
        self.load_state
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ServedRoom {
    fn drop(&mut self) {
        self.cache.forget(self.key);
    }
}
