//! The rooms that are in memory, bounded in bytes. What was asked for the longest time ago goes first.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use moka::policy::EvictionPolicy;
use moka::sync::Cache;
use tokio::runtime::Handle;

use super::Refusal;
use super::room_loading::{RoomLoader, contained};
use super::served::{LoadedRoom, ServedRoom};

/// Which [`ServedRoom`] an entry belongs to.
pub type Key = u64;

/// The cache weighs in units of this many bytes, since its weights have 32 bits.
const UNIT: usize = 1 << 10;

/// Loaded rooms. One that is in use elsewhere lives on after it was dropped here.
pub struct RoomCache {
    rooms: Cache<Key, Arc<LoadedRoom>>,
    loader: RoomLoader,
    runtime: Handle,
    keys: AtomicU64,
}

impl RoomCache {
    /// An empty cache of at most `bytes`; of any size if none is given. Called within a runtime, on
    /// which the store is read.
    pub fn new(loader: RoomLoader, bytes: Option<usize>) -> Self {
        let weight = |_: &Key, room: &Arc<LoadedRoom>| {
            u32::try_from(room.memory_bytes().div_ceil(UNIT)).unwrap_or(u32::MAX)
        };
        let mut builder = Cache::builder()
            .weigher(weight)
            .eviction_policy(EvictionPolicy::lru());
        if let Some(bytes) = bytes {
            builder = builder.max_capacity((bytes / UNIT) as u64);
        }

        Self {
            rooms: builder.build(),
            loader,
            runtime: Handle::current(),
            keys: AtomicU64::new(0),
        }
    }

    pub(super) fn new_key(&self) -> Key {
        self.keys.fetch_add(1, Ordering::Relaxed)
    }

    /// A room if it is in memory.
    pub(super) fn get(&self, key: Key) -> Option<Arc<LoadedRoom>> {
        self.rooms.get(&key)
    }

    /// A room, loaded first if it is not in memory. Whoever asks for it meanwhile waits for the same
    /// loading. Blocks.
    pub(super) fn get_or_load(&self, room: &ServedRoom) -> Result<Arc<LoadedRoom>, Refusal> {
        let load = || {
            let known = room.refusal();
            let loaded = self.runtime.block_on(self.loaded(room, Some(room)));
            if let Err(refusal) = &loaded
                && known.as_ref() != Some(refusal)
            {
                refusal.log("room", room.id.as_str());
            }
            loaded
        };

        let loaded = self.rooms.try_get_with(room.key, load);
        loaded.map_err(|refusal| Refusal::clone(&refusal))
    }

    /// Loads a room ahead of the first request for it. `before` is the same revision as it was served
    /// before: what did not change is taken over from it.
    ///
    /// # Errors
    /// Why the room cannot be loaded.
    pub(super) async fn preload(
        &self,
        room: &ServedRoom,
        before: Option<&ServedRoom>,
    ) -> Result<(), Refusal> {
        let loaded = self.loaded(room, before).await?;
        self.rooms.insert(room.key, loaded);
        Ok(())
    }

    pub(super) fn forget(&self, key: Key) {
        self.rooms.invalidate(&key);
    }

    /// How many rooms are in memory, and about how many bytes they hold.
    pub fn size(&self) -> (u64, u64) {
        self.rooms.run_pending_tasks();
        let units = self.rooms.weighted_size();
        (self.rooms.entry_count(), units * UNIT as u64)
    }

    async fn loaded(
        &self,
        room: &ServedRoom,
        before: Option<&ServedRoom>,
    ) -> Result<Arc<LoadedRoom>, Refusal> {
        let loaded = contained(self.loader.load(room, before)).await;
        let loaded = loaded.map_err(|problem| Refusal::new(room.summary.revision, &problem));

        room.remember(loaded.as_ref());
        loaded.map(Arc::new)
    }
}
