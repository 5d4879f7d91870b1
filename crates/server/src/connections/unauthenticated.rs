//! The open connections that have made no authenticated call yet.
//!
//! At the connection limit, the oldest of them is closed for a new connection. Callers without
//! credentials can therefore not keep others out by holding connections.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::Closing;

/// The connections by number, and hence by age.
#[derive(Debug, Default)]
pub struct Unauthenticated(Mutex<BTreeMap<u64, Arc<Closing>>>);

impl Unauthenticated {
    /// Adds a connection.
    pub fn add(self: &Arc<Self>, id: u64, closing: Arc<Closing>) -> Entry {
        self.with(|known| known.insert(id, closing));
        Entry {
            all: self.clone(),
            id,
        }
    }

    /// Closes the oldest. Returns false if there is none.
    pub fn close_oldest(&self) -> bool {
        let oldest = self.with(BTreeMap::pop_first);
        oldest.map(|(_, closing)| closing.close()).is_some()
    }

    fn with<T>(&self, work: impl FnOnce(&mut BTreeMap<u64, Arc<Closing>>) -> T) -> T {
        work(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// The entry of a connection, removed when dropped.
#[derive(Debug)]
pub struct Entry {
    all: Arc<Unauthenticated>,
    id: u64,
}

impl Entry {
    /// Removes the connection from those that may be closed for others.
    pub fn remove(&self) {
        self.all.with(|known| known.remove(&self.id));
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        self.remove();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the contract, by hand: the oldest is closed first; those that were authenticated or
    /// have ended are not among them.
    #[test]
    fn the_oldest_is_closed_first() {
        let all = Arc::<Unauthenticated>::default();
        let closing: Vec<Arc<Closing>> = (0..4).map(|_| Arc::default()).collect();
        let entries: Vec<Entry> = (0..4)
            .map(|id| all.add(id, closing[id as usize].clone()))
            .collect();
        entries[0].remove();
        let mut entries = entries;
        drop(entries.remove(2));

        let closed = || closing.iter().map(|one| one.is_asked()).collect::<Vec<_>>();
        assert!(all.close_oldest());
        assert_eq!(closed(), [false, true, false, false]);
        assert!(all.close_oldest());
        assert_eq!(closed(), [false, true, false, true]);
        assert!(!all.close_oldest());
    }
}
