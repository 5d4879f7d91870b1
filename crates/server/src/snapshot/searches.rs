//! Room lists of requests that name no room, cached per snapshot, with one index of all their
//! latents.
//!
//! Finding the rooms takes some microseconds each, longer than comparing a view with a small room.
//! With a memory limit nothing is cached, because that would keep the rooms in memory.

use std::collections::BTreeMap;
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use super::super::Error;
use super::ServedNavigator;
use seese3_core::index::JointIndex;

/// Number of rooms from which a joint index is made.
const JOINT_ROOMS: usize = 32;

/// Rooms under one adapter; at least one.
pub type ServedRooms = Arc<SearchedRooms>;

/// The rooms of a search. Dereferences to them.
pub struct SearchedRooms {
    rooms: Vec<Arc<ServedNavigator>>,
    /// Whether all rooms have exact indexes.
    is_exact: bool,
    joint: JointSearch,
}

/// One index of all rooms, made in the background after the first search.
#[derive(Default)]
struct JointSearch {
    is_cached: bool,
    has_begun: AtomicBool,
    index: OnceLock<Option<JointIndex>>,
}

impl SearchedRooms {
    /// Uncached rooms, without a joint index.
    pub fn new(rooms: Vec<Arc<ServedNavigator>>) -> Self {
        Self {
            is_exact: rooms.iter().all(|room| room.navigator.audit().is_none()),
            rooms,
            joint: JointSearch::default(),
        }
    }

    pub fn is_exact(&self) -> bool {
        self.is_exact
    }

    /// The index of all rooms, for a search of the nearest `count` of them. `None` where it would
    /// save nothing, and while `make` makes it, on a thread of its own.
    pub fn joint(
        self: &Arc<Self>,
        count: usize,
        make: impl FnOnce(&[Arc<ServedNavigator>]) -> Option<JointIndex> + Send + 'static,
    ) -> Option<&JointIndex> {
        let is_worth_it = self.rooms.len() >= JOINT_ROOMS.max(count.saturating_mul(4));
        if !(self.joint.is_cached && self.is_exact && is_worth_it) {
            return None;
        }
        if let Some(index) = self.joint.index.get() {
            return index.as_ref();
        }
        if !self.joint.has_begun.swap(true, Ordering::Relaxed) {
            let rooms = self.clone();
            std::thread::spawn(move || {
                let made = make(&rooms);
                rooms.joint.index.get_or_init(|| made);
            });
        }
        None
    }
}

impl Deref for SearchedRooms {
    type Target = [Arc<ServedNavigator>];

    fn deref(&self) -> &Self::Target {
        &self.rooms
    }
}

/// Purpose of a search.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Search {
    /// Retrieves frames.
    Retrieve,
    /// Tracks or relocalizes.
    Track,
}

/// The rooms of a search.
pub struct FoundRooms {
    pub rooms: Vec<Arc<ServedNavigator>>,
    /// Whether the next search would find the same rooms. A room that cannot be read may be
    /// readable then.
    pub is_final: bool,
}

/// The rooms of searches, by what they do and the adapter that they name; empty if they name none.
#[derive(Default)]
pub struct Searches {
    is_kept: bool,
    found: Mutex<BTreeMap<(Search, String), ServedRooms>>,
    comparisons: OnceLock<f64>,
}

impl Searches {
    /// Caches the rooms if `is_kept`.
    pub fn new(is_kept: bool) -> Self {
        Self {
            is_kept,
            ..Self::default()
        }
    }

    /// The rooms of a search, by `find` unless they are known.
    ///
    /// # Errors
    /// Those of `find`.
    pub fn rooms(
        &self,
        search: Search,
        adapter: &str,
        find: impl FnOnce() -> Result<FoundRooms, Error>,
    ) -> Result<ServedRooms, Error> {
        if !self.is_kept {
            return Ok(Arc::new(SearchedRooms::new(find()?.rooms)));
        }

        let key = (search, adapter.to_owned());
        if let Some(known) = self.found().get(&key) {
            return Ok(known.clone());
        }
        // Without the lock: rooms may be read from the store. There are at most two entries for
        // each adapter and two for no adapter, because `find` fails for an unknown name.
        let FoundRooms { rooms, is_final } = find()?;
        let mut rooms = SearchedRooms::new(rooms);
        if !is_final {
            return Ok(Arc::new(rooms));
        }
        rooms.joint.is_cached = true;

        // The adapter that is chosen where none is named has one index, too.
        let named = rooms
            .first()
            .map(|room| (search, room.adapter.name.clone()));
        let mut found = self.found();
        let rooms = named
            .as_ref()
            .and_then(|named| found.get(named).cloned())
            .unwrap_or(Arc::new(rooms));
        found.extend(named.map(|named| (named, rooms.clone())));
        Ok(found.entry(key).or_insert(rooms).clone())
    }

    /// Comparisons of a view with the frames of all rooms, by `count` unless they are known.
    pub fn comparisons(&self, count: impl FnOnce() -> f64) -> f64 {
        *self.comparisons.get_or_init(count)
    }

    fn found(&self) -> MutexGuard<'_, BTreeMap<(Search, String), ServedRooms>> {
        self.found.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(is_final: bool) -> Result<FoundRooms, Error> {
        let rooms = Vec::new();
        Ok(FoundRooms { rooms, is_final })
    }

    /// Oracle: the contract: rooms are found once for each adapter and use, if the next search
    /// would find the same.
    #[test]
    fn final_searches_are_kept() {
        let searches = Searches::new(true);
        let mut times = 0;
        for (search, adapter, is_final) in [
            (Search::Retrieve, "", false),
            (Search::Retrieve, "", true),
            (Search::Retrieve, "", true),
            (Search::Track, "", true),
            (Search::Retrieve, "fitted", true),
            (Search::Retrieve, "fitted", true),
        ] {
            let find = || {
                times += 1;
                found(is_final)
            };
            searches.rooms(search, adapter, find).unwrap();
        }
        assert_eq!(times, 4);

        let fails = searches.rooms(Search::Track, "none", || Err(Error::Internal));
        assert!(fails.is_err());
        assert!(
            searches
                .rooms(Search::Track, "none", || found(true))
                .is_ok()
        );
    }

    /// Oracle: the contract: an uncached room is in memory only as long as it is in use.
    #[test]
    fn rooms_can_be_left_uncached() {
        let searches = Searches::new(false);
        let rooms = searches
            .rooms(Search::Retrieve, "", || found(true))
            .unwrap();
        assert_eq!(Arc::strong_count(&rooms), 1);
        assert!(rooms.joint(1, |_| panic!("no index is made")).is_none());
    }
}
