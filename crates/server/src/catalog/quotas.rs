//! Checks the quotas of rooms and callers before a change.

use super::super::Error;
use super::super::auth::RoomScope;
use super::super::caller::Requester;
use super::super::quota::Quota;
use super::changes::Changes;
use seese3_store::{Kind, ResourceName, Store, Usage};

/// The quotas of a change.
pub struct Quotas {
    store: Store,
    /// Of each room, with the adapters fitted to it.
    room: Quota,
    /// Of all rooms that the caller may access.
    caller: Quota,
    scope: Option<RoomScope>,
}

impl Changes {
    /// The quotas of a caller's change.
    pub fn quotas(&self, caller: &Requester) -> Quotas {
        Quotas {
            store: self.store.clone(),
            room: self.quota,
            caller: caller.quota(),
            scope: caller.scope().cloned(),
        }
    }
}

impl Quotas {
    /// Checks that the room and the caller are below their quotas.
    ///
    /// # Errors
    /// [`Error::Quota`] if one of them is not; the errors of listing the store.
    pub async fn check(&self, room: &str) -> Result<(), Error> {
        if !self.room.is_none() {
            let used = self.used_by(|name| name == room).await?;
            self.room
                .check(used, &ResourceName::room(room).to_string())?;
        }
        self.check_caller().await
    }

    /// Checks that the caller is below its quota.
    ///
    /// # Errors
    /// As [`Quotas::check`].
    pub async fn check_caller(&self) -> Result<(), Error> {
        if self.caller.is_none() {
            return Ok(());
        }
        let scope = self.scope.as_ref();
        let used = self.used_by(|room| scope.is_none_or(|scope| scope.contains(room)));
        self.caller.check(used.await?, "the caller")
    }

    /// What the rooms that `counts` selects take, with the adapters named after them.
    async fn used_by(&self, counts: impl Fn(&str) -> bool) -> Result<Usage, Error> {
        let rooms = self.store.names_with_files(Kind::Room).await?;
        let adapters = self.store.names_with_files(Kind::Adapter).await?;
        let is_counted = |adapter: &String| owner(adapter, &rooms).is_some_and(&counts);
        let adapters = adapters.iter().filter(|adapter| is_counted(adapter));
        let counted = rooms.iter().filter(|room| counts(room));

        let mut used = Usage::default();
        let adapters = adapters.map(ResourceName::adapter);
        for resource in counted.map(ResourceName::room).chain(adapters) {
            let one = self.store.usage(&resource).await?;
            used.revisions += one.revisions;
            used.bytes += one.bytes;
        }
        Ok(used)
    }
}

/// The room that an adapter is named after: the longest name of a room with which the adapter's
/// name begins, before a dot.
pub fn owner<'a>(adapter: &str, rooms: impl IntoIterator<Item = &'a String>) -> Option<&'a str> {
    let is_before = |room: &&String| {
        let rest = adapter.strip_prefix(room.as_str());
        rest.is_some_and(|rest| rest.starts_with('.'))
    };
    let owners = rooms.into_iter().filter(is_before);
    owners.map(String::as_str).max_by_key(|room| room.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn an_adapter_belongs_to_the_room_with_the_longest_name() {
        let rooms = ["lab", "lab.b", "la"].map(str::to_owned);
        let owner = |adapter| owner(adapter, &rooms);
        assert_eq!(owner("lab.builtin.fitted"), Some("lab"));
        assert_eq!(owner("lab.b.mine"), Some("lab.b"));
        assert_eq!(owner("lab.bc"), Some("lab"));
        assert_eq!(owner("labs.x"), None);
        assert_eq!(owner("lab"), None);
    }
}
