//! The rooms that are in memory, bounded in bytes. What was asked for the longest time ago goes first.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use moka::policy::EvictionPolicy;
use moka::sync::Cache;
use tokio::runtime::Handle;

use super::Refusal;
use super::loaded::LoadedRoom;
use super::room_loading::{RoomLoader, RoomToLoad, contained};

/// Identifies a served room in the cache.
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

    /// A room, loaded by `load` if it is not in memory. Whoever asks for it meanwhile waits for the
    /// same loading. Blocks.
    pub(super) fn get_or_load(
        &self,
        key: Key,
        load: impl FnOnce() -> Result<Arc<LoadedRoom>, Refusal>,
    ) -> Result<Arc<LoadedRoom>, Refusal> {
        let loaded = self.rooms.try_get_with(key, load);
        loaded.map_err(|refusal| Refusal::clone(&refusal))
    }

    /// Puts a room into memory.
    pub(super) fn insert(&self, key: Key, room: Arc<LoadedRoom>) {
        self.rooms.insert(key, room);
    }

    /// Loads a room; a panic there is its refusal.
    pub(super) async fn load(&self, room: RoomToLoad<'_>) -> Result<LoadedRoom, Refusal> {
        let revision = room.revision;
        let loaded = contained(self.loader.load(room)).await;
        loaded.map_err(|problem| Refusal::new(revision, &problem))
    }

    /// Runs to the end what loads a room. Blocks.
    pub(super) fn block_on<T>(&self, work: impl Future<Output = T>) -> T {
        self.runtime.block_on(work)
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
}
