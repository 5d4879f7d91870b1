//! Limits on the revisions and bytes in the store.

use super::Error;
use seese3_store::Usage;

/// The most that may be stored; `None` for no limit. A change that begins below the limit is made,
/// so that the bytes may exceed it by one upload.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Quota {
    /// Number of revisions.
    pub revisions: Option<u64>,
    /// Size of all files, bytes.
    pub bytes: Option<u64>,
}

impl Quota {
    /// Whether there is no limit.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Checks that `used` is below the limits. `whose` begins the error message.
    ///
    /// # Errors
    /// [`Error::Quota`] if a limit is reached.
    pub fn check(&self, used: Usage, whose: &str) -> Result<(), Error> {
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the contract: a change is made below the limit, and refused at it.
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
