//! LRU cache of loaded rooms, bounded in bytes.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use moka::policy::EvictionPolicy;
use moka::sync::Cache;
use tokio::runtime::Handle;

use super::super::slow_files::logged_if_slow;
use super::Refusal;
use super::loaded::LoadedRoom;
use super::room_loading::{RoomLoader, RoomToLoad, contained};

/// Identifies a served room in the cache.
pub type Key = u64;

/// Unit of cache weights, bytes; needed because weights have 32 bits.
const UNIT: usize = 1 << 10;

/// Loaded rooms. An evicted room stays in memory while it is in use.
pub struct RoomCache {
    rooms: Cache<Key, Arc<LoadedRoom>>,
    loader: RoomLoader,
    runtime: Handle,
    keys: AtomicU64,
}

impl RoomCache {
    /// Creates an empty cache of at most `bytes`, or unbounded if `None`. Must be called within the
    /// runtime that reads the store.
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

    /// The room, if it is in memory.
    pub(super) fn get(&self, key: Key) -> Option<Arc<LoadedRoom>> {
        self.rooms.get(&key)
    }

    /// The room, loaded by `load` if it is not in memory. Concurrent callers share one load.
    /// Blocks.
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

    /// Loads a room. A panic is returned as a refusal.
    pub(super) async fn load(&self, room: RoomToLoad<'_>) -> Result<LoadedRoom, Refusal> {
        let revision = room.revision;
        let what = format!("room '{}'", room.id);
        let loaded = logged_if_slow(&what, contained(self.loader.load(room))).await;
        loaded.map_err(|problem| Refusal::new(revision, &problem))
    }

    /// Runs a load to completion. Blocks.
    pub(super) fn block_on<T>(&self, work: impl Future<Output = T>) -> T {
        self.runtime.block_on(work)
    }

    pub(super) fn forget(&self, key: Key) {
        self.rooms.invalidate(&key);
    }

    /// Number of rooms in memory, and their approximate size in bytes.
    pub fn size(&self) -> (u64, u64) {
        self.rooms.run_pending_tasks();
        let units = self.rooms.weighted_size();
        (self.rooms.entry_count(), units * UNIT as u64)
    }
}
