//! Divides the connections of a server with credentials among its callers.
//!
//! A connection is owned by the caller of its first admitted call, as long as that caller's
//! credentials are valid. At the limit, the oldest unowned connection is closed to admit a new one.
//!
//! Callers own at most 7/8 of the places, rounded down. If that is reached when an unowned
//! connection makes its first admitted call, the largest owner loses its newest connection,
//! provided it has at least two more than this caller.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt::Debug;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

use super::Closing;

/// Minimum interval between two searches for owners whose credentials are no longer valid.
const SEARCH: Duration = Duration::from_secs(1);

/// A caller that owns connections.
pub trait Owner: Debug + Send + Sync {
    /// Its name. Connections are counted by name.
    fn name(&self) -> Arc<str>;

    /// Whether its credentials are still valid.
    fn is_valid(&self) -> bool;
}

/// Ownership of a server's connections. They are numbered in the order of their arrival.
#[derive(Debug)]
pub struct Owners {
    /// Maximum number of owned connections.
    most: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    unowned: BTreeMap<u64, Arc<Closing>>,
    owned: BTreeMap<u64, Owned>,
    /// The connections of each owner.
    by_name: HashMap<Arc<str>, BTreeSet<u64>>,
    /// When invalid owners were last searched for.
    searched: Option<Instant>,
}

#[derive(Debug)]
struct Owned {
    owner: Arc<dyn Owner>,
    closing: Arc<Closing>,
}

impl Owners {
    /// For a server with `places` connections. A single place can be owned.
    pub fn new(places: usize) -> Arc<Self> {
        Arc::new(Self {
            most: (places - places.div_ceil(8)).max(1),
            state: Mutex::default(),
        })
    }

    /// Adds an unowned connection.
    pub fn add(self: &Arc<Self>, id: u64, closing: Arc<Closing>) -> Entry {
        self.with(|state| state.unowned.insert(id, closing));
        Entry {
            all: self.clone(),
            id,
        }
    }

    /// Closes the oldest unowned connection. Returns false if there is none.
    pub fn close_oldest(&self) -> bool {
        let oldest = self.with(|state| {
            state.drop_invalid();
            state.unowned.pop_first()
        });
        oldest.map(|(_, closing)| closing.close()).is_some()
    }

    fn with<T>(&self, work: impl FnOnce(&mut State) -> T) -> T {
        work(&mut self.state.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl State {
    /// Makes the caller of an admitted call the owner of its connection, unless that has a valid
    /// one. Returns false if the caller may own no further connection.
    fn assign(&mut self, id: u64, owner: Arc<dyn Owner>, most: usize) -> bool {
        if let Some(owned) = self.owned.get_mut(&id) {
            let is_same = owned.owner.name() == owner.name();
            if is_same {
                // The credentials may be newer.
                owned.owner = owner;
                return true;
            }
            if owned.owner.is_valid() {
                return true;
            }
            self.disown(id);
        }
        // A connection that is being closed has no entry.
        let Some(closing) = self.unowned.get(&id).cloned() else {
            return true;
        };

        if self.owned.len() >= most {
            self.drop_invalid();
        }
        if self.owned.len() >= most {
            let Some(newest) = self.newest_of_largest(&owner.name()) else {
                return false;
            };
            if let Some(closed) = self.remove(newest) {
                tracing::info!(
                    caller = &*closed.owner.name(),
                    "connection closed for another caller at the limit"
                );
                closed.closing.close();
            }
        }
        self.unowned.remove(&id);
        self.by_name.entry(owner.name()).or_default().insert(id);
        self.owned.insert(id, Owned { owner, closing });
        true
    }

    /// The newest connection of the largest owner, if that has at least two more than `name`.
    fn newest_of_largest(&self, name: &str) -> Option<u64> {
        let own = self.by_name.get(name).map_or(0, BTreeSet::len);
        let largest = self.by_name.values().max_by_key(|ids| ids.len())?;
        if largest.len() < own + 2 {
            return None;
        }
        largest.last().copied()
    }

    /// Removes an owned connection.
    fn remove(&mut self, id: u64) -> Option<Owned> {
        let owned = self.owned.remove(&id)?;
        let name = owned.owner.name();
        if let Some(ids) = self.by_name.get_mut(&name) {
            ids.remove(&id);
            if ids.is_empty() {
                self.by_name.remove(&name);
            }
        }
        Some(owned)
    }

    fn disown(&mut self, id: u64) {
        if let Some(owned) = self.remove(id) {
            self.unowned.insert(id, owned.closing);
        }
    }

    /// Takes the connections of owners whose credentials are no longer valid.
    fn drop_invalid(&mut self) {
        if self.searched.is_some_and(|last| last.elapsed() < SEARCH) {
            return;
        }
        self.searched = Some(Instant::now());

        let owned = self.owned.iter();
        let invalid = owned.filter(|(_, owned)| !owned.owner.is_valid());
        let invalid: Vec<u64> = invalid.map(|(&id, _)| id).collect();
        invalid.into_iter().for_each(|id| self.disown(id));
    }
}

/// The entry of a connection, removed when dropped.
#[derive(Debug)]
pub struct Entry {
    all: Arc<Owners>,
    id: u64,
}

impl Entry {
    /// Makes the caller of an admitted call the owner, unless the connection has a valid one.
    /// Returns false if the caller may own no further connection.
    pub fn assign(&self, owner: Arc<dyn Owner>) -> bool {
        let most = self.all.most;
        self.all.with(|state| state.assign(self.id, owner, most))
    }

    /// Removes the entry before it is dropped.
    pub fn remove(&self) {
        self.all.with(|state| {
            state.unowned.remove(&self.id);
            state.remove(self.id);
        });
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        self.remove();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;

    #[derive(Debug)]
    struct Named(&'static str, AtomicBool);

    impl Owner for Named {
        fn name(&self) -> Arc<str> {
            self.0.into()
        }

        fn is_valid(&self) -> bool {
            self.1.load(Ordering::Relaxed)
        }
    }

    /// Connections numbered from 0.
    struct Connections {
        closing: Vec<Arc<Closing>>,
        entries: Vec<Entry>,
        all: Arc<Owners>,
    }

    impl Connections {
        fn of(places: usize, count: u64) -> Self {
            let all = Owners::new(places);
            let closing: Vec<Arc<Closing>> = (0..count).map(|_| Arc::default()).collect();
            let add = |(id, one): (u64, &Arc<Closing>)| all.add(id, one.clone());
            Self {
                entries: (0..count).zip(&closing).map(add).collect(),
                closing,
                all,
            }
        }

        fn closed(&self) -> Vec<usize> {
            let numbered = self.closing.iter().enumerate();
            let closed = numbered.filter(|(_, one)| one.is_asked());
            closed.map(|(number, _)| number).collect()
        }
    }

    fn caller(name: &'static str) -> Arc<Named> {
        Arc::new(Named(name, AtomicBool::new(true)))
    }

    /// Oracle: the contract, by hand: the oldest is closed first; those that are owned or have
    /// ended are not among them.
    #[test]
    fn the_oldest_is_closed_first() {
        let mut connections = Connections::of(8, 4);
        assert!(connections.entries[0].assign(caller("a")));
        drop(connections.entries.remove(2));

        assert!(connections.all.close_oldest());
        assert_eq!(connections.closed(), [1]);
        assert!(connections.all.close_oldest());
        assert_eq!(connections.closed(), [1, 3]);
        assert!(!connections.all.close_oldest());
    }

    /// Oracle: the contract, by hand: of eight places callers have seven; a caller with all seven
    /// yields its newest to others until it has one more than they.
    #[test]
    fn callers_divide_the_connections() {
        let connections = Connections::of(8, 12);
        let give = |number: usize, name| connections.entries[number].assign(caller(name));
        assert!((0..7).all(|number| give(number, "greedy")));
        assert!(!give(7, "greedy"));
        assert!(give(3, "greedy"), "it has this one already");
        assert_eq!(connections.closed(), [0; 0]);

        assert!(give(8, "robot"));
        assert!(give(9, "robot"));
        assert!(give(10, "robot"));
        assert!(!give(11, "robot"), "four and three are a fair division");
        assert_eq!(connections.closed(), [4, 5, 6]);
    }

    /// Oracle: the contract: a gateway's connection is of its first caller while that is valid;
    /// then of the next one to call.
    #[test]
    fn a_gateway_has_one_owner() {
        let connections = Connections::of(8, 2);
        let (first, second) = (caller("first"), caller("second"));
        let gateway = &connections.entries[0];
        let owner = || {
            connections.all.with(|state| {
                let owned = state.owned.get(&0);
                owned.map(|owned| owned.owner.name().to_string())
            })
        };
        assert_eq!(owner(), None);
        for caller in [first.clone(), second.clone(), first.clone()] {
            assert!(gateway.assign(caller));
            assert_eq!(owner().as_deref(), Some("first"));
        }

        first.1.store(false, Ordering::Relaxed);
        assert!(gateway.assign(second));
        assert_eq!(owner().as_deref(), Some("second"));
        assert!(connections.all.close_oldest());
        assert_eq!(connections.closed(), [1]);
    }

    /// Oracle: the contract: what a removed caller holds is free for others.
    #[test]
    fn invalid_callers_lose_their_connections() {
        let connections = Connections::of(8, 8);
        let (gone, robot) = (caller("gone"), caller("robot"));
        assert!(connections.entries[0].assign(robot.clone()));
        for entry in &connections.entries[1..7] {
            assert!(entry.assign(gone.clone()));
        }
        gone.1.store(false, Ordering::Relaxed);

        assert!(connections.entries[7].assign(robot));
        assert_eq!(connections.closed(), [0; 0]);
        for _ in 0..6 {
            assert!(connections.all.close_oldest());
        }
        assert_eq!(connections.closed(), [1, 2, 3, 4, 5, 6]);
        assert!(!connections.all.close_oldest());
    }
}
