//! Limits on what callers may have in a store.

use std::fmt;
use std::sync::Arc;

use super::{Error, Kind, ResourceName, Store, Usage};

/// Storage limits; `None` is unlimited. They are compared with what is stored before a publication,
/// so one revision may exceed the byte limit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Quota {
    /// Number of revisions.
    pub revisions: Option<u64>,
    /// Size of all files, bytes.
    pub bytes: Option<u64>,
}

/// The quotas of a caller's publications. They apply to new revisions: publishing the content of
/// the newest revision again succeeds at the limit.
#[derive(Clone, Default)]
pub struct Quotas {
    /// Of each room, with the adapters that are named `ROOM.NAME` and fitted to it.
    pub room: Quota,
    /// Of all rooms that the caller may access, with such adapters; of the whole store if the
    /// caller may access all rooms.
    pub caller: Quota,
    /// Whether the caller may access a room, by its name; `None` if it may access all.
    pub scope: Option<Scope>,
}

/// Tells from a room's name whether a caller may access it.
pub type Scope = Arc<dyn Fn(&str) -> bool + Send + Sync>;

impl fmt::Debug for Quotas {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut form = formatter.debug_struct("Quotas");
        form.field("room", &self.room).field("caller", &self.caller);
        form.finish_non_exhaustive()
    }
}

impl Quota {
    fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Checks that `used` is below the limits. `whose` begins the error message.
    fn check(&self, used: Usage, whose: &str) -> Result<(), Error> {
        let limits = [
            (self.revisions, used.revisions, "revisions"),
            (self.bytes, used.bytes, "bytes, garbage included"),
        ];
        for (limit, used, unit) in limits {
            if let Some(limit) = limit.filter(|limit| used >= *limit) {
                return Err(Error::Quota {
                    used: format!("{whose} has {used} of {limit} {unit}"),
                });
            }
        }
        Ok(())
    }
}

impl Store {
    /// The same store, whose publications are checked against `quotas`.
    pub fn with_quotas(&self, quotas: Quotas) -> Self {
        Self {
            quotas: Arc::new(quotas),
            ..self.clone()
        }
    }

    /// Checks that one more revision of a room, or of an adapter fitted to it, is within the
    /// quotas. For an adapter that belongs to no room, `room` is `None`.
    ///
    /// # Errors
    /// [`Error::Quota`] if a limit is reached, [`Error::Io`] if the store cannot be listed.
    pub async fn check_quotas(&self, room: Option<&str>) -> Result<(), Error> {
        let Quotas {
            room: of_room,
            caller,
            scope,
        } = &*self.quotas;

        if let Some(room) = room.filter(|_| !of_room.is_none()) {
            let used = self.used_by(&|name| name == room).await?;
            let room = ResourceName::room(room);
            of_room.check(used, &format!("{room} with its fitted adapters"))?;
        }
        if !caller.is_none() {
            let used = match scope {
                Some(scope) => self.used_by(&**scope).await?,
                None => self.used_by_all().await?,
            };
            caller.check(used, "the caller")?;
        }
        Ok(())
    }

    /// What the rooms that `counts` selects take, with the adapters that belong to them.
    async fn used_by(&self, counts: &(dyn Fn(&str) -> bool + Sync)) -> Result<Usage, Error> {
        let mut used = Usage::default();
        for room in self.names_with_files(Kind::Room).await? {
            if counts(&room) {
                used += self.usage(&ResourceName::room(room)).await?;
            }
        }
        for adapter in self.names_with_files(Kind::Adapter).await? {
            // Most adapters are excluded by their name alone.
            let mut dots = adapter.match_indices('.');
            let is_candidate = dots.any(|(dot, _)| counts(&adapter[..dot]));
            if is_candidate && self.belongs_to(&adapter, counts).await? {
                used += self.usage(&ResourceName::adapter(adapter)).await?;
            }
        }
        Ok(used)
    }

    async fn used_by_all(&self) -> Result<Usage, Error> {
        let rooms = self.names_with_files(Kind::Room).await?;
        let adapters = self.names_with_files(Kind::Adapter).await?;
        let adapters = adapters.iter().map(ResourceName::adapter);

        let mut used = Usage::default();
        for resource in rooms.iter().map(ResourceName::room).chain(adapters) {
            used += self.usage(&resource).await?;
        }
        Ok(used)
    }

    /// Whether an adapter, or what is left of a removed one, belongs to one of the rooms that
    /// `counts` selects. A damaged one belongs to none: otherwise a room could be charged for
    /// another's.
    async fn belongs_to(
        &self,
        adapter: &str,
        counts: &(dyn Fn(&str) -> bool + Sync),
    ) -> Result<bool, Error> {
        match self.last_adapter(adapter).await {
            Ok(body) => Ok(body.is_some_and(|body| body.owner().is_some_and(counts))),
            Err(Error::Damaged { .. } | Error::Schema { .. }) => Ok(false),
            Err(error) => Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the contract: a revision is published below the limit, and refused at it.
    #[test]
    fn a_quota_is_reached_at_its_limit() {
        let quota = Quota {
            revisions: Some(3),
            bytes: Some(1_000),
        };
        let used = |revisions, bytes| Usage { revisions, bytes };

        assert!(quota.check(used(2, 999), "rooms/a").is_ok());
        assert!(
            Quota::default()
                .check(used(u64::MAX, u64::MAX), "rooms/a")
                .is_ok()
        );
        let refused = |used| quota.check(used, "rooms/a").unwrap_err().to_string();
        assert!(refused(used(3, 0)).starts_with("rooms/a has 3 of 3 revisions;"));
        assert!(
            refused(used(0, 1_001))
                .starts_with("rooms/a has 1001 of 1000 bytes, garbage included;")
        );
    }
}
