//! Snapshots with revisions that are not the current ones, for requests that state them.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};

use super::super::Error;
use super::super::stated_revisions::StatedRevisions;
use super::super::status::Full;
use super::super::workers::off_the_lane;
use super::Snapshot;
use super::cache::RoomCache;
use super::loaded::Candidate;
use super::served::ServedRoom;
use seese3_core::room::RoomId;
use seese3_store::adapter_choice::serving_room;
use seese3_store::{Store, StoredAdapter};

/// Maximum number of rooms, and of adapters, that are kept for later requests.
const MOST_KEPT: usize = 8;

/// Loads revisions that requests state, and keeps the last ones.
pub struct PinnedRevisions {
    store: Store,
    cache: Arc<RoomCache>,
    rooms: Mutex<VecDeque<Arc<ServedRoom>>>,
    adapters: Mutex<VecDeque<Arc<StoredAdapter>>>,
}

impl PinnedRevisions {
    pub(super) fn new(store: Store, cache: Arc<RoomCache>) -> Self {
        Self {
            store,
            cache,
            rooms: Mutex::default(),
            adapters: Mutex::default(),
        }
    }

    /// Reads the store. Other requests are answered meanwhile.
    fn read<T>(
        &self,
        field: &str,
        reading: impl Future<Output = Result<T, seese3_store::Error>>,
    ) -> Result<T, Error> {
        let read = off_the_lane(|| self.cache.block_on(reading));
        let what = Full::DiskReads;
        let read = read.map_err(|_| Error::Full { what })?;
        read.map_err(|error| unreadable(field, &error))
    }

    /// An adapter in this revision. Reads the store: call only on threads that may block.
    fn adapter(&self, name: &str, revision: u64) -> Result<Arc<StoredAdapter>, Error> {
        let is_it = |kept: &Arc<StoredAdapter>| kept.name == name && kept.revision == revision;
        if let Some(kept) = locked(&self.adapters).iter().find(|kept| is_it(kept)) {
            return Ok(kept.clone());
        }

        let loaded = self.read(
            "adapter_revision",
            self.store.load_adapter(name, Some(revision)),
        )?;
        let loaded = Arc::new(loaded);
        keep(&self.adapters, loaded.clone());
        Ok(loaded)
    }

    /// A room in this revision, with the adapters that serve it; it is loaded on its first use.
    /// Reads the store: call only on threads that may block.
    fn room(
        &self,
        field: &str,
        name: &str,
        revision: u64,
        adapters: &BTreeMap<String, Arc<StoredAdapter>>,
    ) -> Result<Arc<ServedRoom>, Error> {
        let identities = |serving: &[Arc<StoredAdapter>]| -> Vec<(String, u64)> {
            serving
                .iter()
                .map(|adapter| (adapter.name.clone(), adapter.revision))
                .collect()
        };
        let is_it = |kept: &Arc<ServedRoom>| {
            let summary = &kept.summary;
            if kept.id.as_str() != name || summary.revision != revision {
                return false;
            }
            let serving = serving_room(adapters.values(), &kept.id, &summary.features);
            let candidates = kept.candidates.iter();
            let kept: Vec<_> = candidates.map(|kept| kept.adapter.clone()).collect();
            identities(&serving) == identities(&kept)
        };
        if let Some(kept) = locked(&self.rooms).iter().find(|kept| is_it(kept)) {
            return Ok(kept.clone());
        }

        let summary = self.read(field, self.store.room_summary(name, Some(revision)))?;
        let id = RoomId::new(name).map_err(|_| Error::Internal)?;
        let serving = serving_room(adapters.values(), &id, &summary.features);
        let candidates = serving.into_iter().map(|adapter| Candidate {
            adapter,
            earlier: None,
        });
        let room = ServedRoom::new(id, summary, candidates.collect(), self.cache.clone());
        let room = Arc::new(room);
        keep(&self.rooms, room.clone());
        Ok(room)
    }
}

impl Snapshot {
    /// This snapshot with the revisions that a request states. If it states that of the adapter, no
    /// other adapter that is fitted to a room locates the views of the request. Reads the store:
    /// call only on threads that may block.
    ///
    /// # Errors
    /// [`Error::NotFound`] if this snapshot has no such room or adapter, or the store no such
    /// revision; [`Error::Precondition`] if the revision cannot be read.
    pub fn with_revisions(self: &Arc<Self>, stated: &StatedRevisions) -> Result<Arc<Self>, Error> {
        let rooms: Vec<String> = match (stated.rooms.as_slice(), &stated.adapter) {
            // The adapter may serve any room.
            ([], Some(_)) => self.rooms.keys().cloned().collect(),
            ([], None) => stated.room_revisions.keys().cloned().collect(),
            (named, _) => named.to_vec(),
        };
        if self.has_adapter(stated) && rooms.iter().all(|name| self.serves_as_stated(name, stated))
        {
            return Ok(self.clone());
        }

        let pinned = self.pinned.as_ref().ok_or(Error::Internal)?;
        let mut snapshot = self.copied();
        if let Some((name, revision)) = &stated.adapter {
            let current = self.adapter(name)?;
            let adapter = pinned.adapter(name, *revision)?;
            // It may be fitted to a room that the caller may not see.
            let fit = adapter.room_fit.as_ref();
            if fit.is_some_and(|fit| !self.rooms.contains_key(fit.room.as_str())) {
                return Err(Error::no_revision("adapter_revision", name, *revision));
            }
            let is_encoded_alike = current.adapter.source().is_like(adapter.adapter.source());
            if !is_encoded_alike {
                snapshot.image_encoders.remove(name);
            }
            snapshot.adapters.insert(name.clone(), adapter);
        }

        let stated_adapter = stated.adapter.as_ref().map(|(name, _)| name);
        let mut serving = snapshot.adapters.clone();
        serving.retain(|name, adapter| {
            let is_stated = stated_adapter.is_none_or(|stated| stated == name);
            is_stated || adapter.room_fit.is_none()
        });
        for name in rooms {
            if self.serves_as_stated(&name, stated) {
                continue;
            }
            let current = self.room(&name)?;
            let revision = stated.room_revisions.get(&name).copied();
            let revision = revision.unwrap_or(current.summary.revision);
            let room = pinned.room(stated.room_field, &name, revision, &serving)?;
            snapshot.rooms.insert(name, room);
        }

        Ok(Arc::new(snapshot))
    }

    /// Whether the adapter's current revision is the stated one, if one is stated.
    fn has_adapter(&self, stated: &StatedRevisions) -> bool {
        stated.adapter.iter().all(|(name, revision)| {
            let adapter = self.adapters.get(name);
            adapter.is_some_and(|adapter| adapter.revision == *revision)
        })
    }

    /// Whether a room is served in the stated revision and by the stated adapter, and no other
    /// adapter is fitted to it. Unknown rooms are left to the request, which names their field.
    fn serves_as_stated(&self, name: &str, stated: &StatedRevisions) -> bool {
        let Some(room) = self.rooms.get(name) else {
            return !stated.room_revisions.contains_key(name);
        };
        let revision = stated.room_revisions.get(name);
        let is_stated = revision.is_none_or(|revision| *revision == room.summary.revision);
        let is_read_by_another = |candidate: &Candidate| {
            let stated = stated.adapter.iter();
            let mut stated = stated.map(|(name, _)| *name == candidate.adapter.name);
            candidate.adapter.room_fit.is_some() && stated.any(|is_it| !is_it)
        };
        is_stated && self.has_adapter(stated) && !room.candidates.iter().any(is_read_by_another)
    }
}

/// Why a stated revision cannot be used.
fn unreadable(field: &str, error: &seese3_store::Error) -> Error {
    use seese3_store::Error as E;

    match error {
        E::UnknownRevision { name, revision, .. } => Error::no_revision(field, name, *revision),
        E::Unknown { name, .. } => Error::not_found(field, name, []),
        error => {
            tracing::error!(%error, "a stated revision cannot be read");
            Error::Precondition(
                "the stated revision cannot be read; see the server's log".to_owned(),
            )
        }
    }
}

fn locked<T>(kept: &Mutex<VecDeque<T>>) -> std::sync::MutexGuard<'_, VecDeque<T>> {
    kept.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps an entry, and drops the oldest one if there are too many.
fn keep<T>(kept: &Mutex<VecDeque<T>>, entry: T) {
    let mut kept = locked(kept);
    kept.push_back(entry);
    if kept.len() > MOST_KEPT {
        kept.pop_front();
    }
}
