//! Stored responses to recent changes, so that a retry does not repeat the change.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use tokio::time::Instant;

use super::super::Error;
use super::super::caller::CallerId;

/// Retention time of a response.
const KEPT_FOR: Duration = Duration::from_secs(3_600);
/// Maximum number of stored responses. Above it, the caller with the most responses loses its
/// oldest, so that heavy callers cannot evict those of others.
const KEPT: usize = 1_000;
/// Maximum size of a stored response, bytes.
const LARGEST_ANSWER: usize = 16 << 10;
/// Maximum length of a request id, characters.
const LONGEST_ID: usize = 100;

/// Identity of a change, for idempotent retries.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The caller's name; empty without authentication.
    pub caller: String,
    /// The caller that is charged for the change.
    pub charged: CallerId,
    /// The caller's idempotency key; empty if it will not retry.
    pub request_id: String,
    /// SHA-256 of the request.
    pub content: [u8; 32],
}

struct Remembered {
    identity: Identity,
    answer: Vec<u8>,
    at: Instant,
}

/// The stored responses, oldest first.
#[derive(Default)]
pub struct Recent(VecDeque<Remembered>);

impl Recent {
    /// The stored response to the same change, if it was made in the last hour.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the request id is too long, or was used for a different change.
    pub fn answer(&mut self, identity: &Identity) -> Result<Option<&[u8]>, Error> {
        if identity.request_id.chars().count() > LONGEST_ID {
            let problem = format!("is longer than {LONGEST_ID} characters");
            return Err(Error::invalid("request_id", problem));
        }

        while self
            .0
            .front()
            .is_some_and(|oldest| oldest.at.elapsed() > KEPT_FOR)
        {
            self.0.pop_front();
        }
        if identity.request_id.is_empty() {
            return Ok(None);
        }

        let is_same_id = |known: &&Remembered| {
            (&known.identity.caller, &known.identity.request_id)
                == (&identity.caller, &identity.request_id)
        };
        match self.0.iter().find(is_same_id) {
            Some(known) if known.identity.content == identity.content => Ok(Some(&known.answer)),
            Some(_) => Err(Error::invalid(
                "request_id",
                "was used for another change in the last hour; use a new id for each change",
            )),
            None => Ok(None),
        }
    }

    /// Stores the response to a change, unless it is large.
    pub fn remember(&mut self, identity: Identity, answer: Vec<u8>) {
        if identity.request_id.is_empty() {
            return;
        }
        // The answer to SetDefault lists all defaults, and may be large.
        if answer.len() > LARGEST_ANSWER {
            return;
        }
        if self.0.len() == KEPT {
            self.forget_one();
        }
        self.0.push_back(Remembered {
            identity,
            answer,
            at: Instant::now(),
        });
    }

    /// Drops the oldest response of the caller with the most.
    fn forget_one(&mut self) {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for known in &self.0 {
            *counts.entry(&known.identity.caller).or_default() += 1;
        }

        let most = counts.into_iter().max_by_key(|(_, count)| *count);
        let place = most.and_then(|(caller, _)| {
            let is_theirs = |known: &Remembered| known.identity.caller == caller;
            self.0.iter().position(is_theirs)
        });
        if let Some(place) = place {
            self.0.remove(place);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity(caller: &str, request_id: &str, content: u8) -> Identity {
        Identity {
            caller: caller.to_owned(),
            charged: CallerId::Unknown,
            request_id: request_id.to_owned(),
            content: [content; 32],
        }
    }

    /// Oracle: the contract: the same caller, id and content get the first response; different
    /// content is rejected; other callers and changes without an id are new.
    #[test]
    fn a_change_that_is_sent_again_has_been_answered() {
        let mut recent = Recent::default();
        recent.remember(identity("a", "1", 7), vec![42]);
        recent.remember(identity("a", "", 7), vec![43]);

        assert_eq!(recent.answer(&identity("a", "1", 7)), Ok(Some(&[42][..])));
        assert!(recent.answer(&identity("a", "1", 8)).is_err());
        assert_eq!(recent.answer(&identity("b", "1", 8)), Ok(None));
        assert_eq!(recent.answer(&identity("a", "", 7)), Ok(None));
        assert!(recent.answer(&identity("a", &"x".repeat(101), 7)).is_err());
    }

    /// Oracle: the contract: a response is stored for one hour; afterwards the id is free again.
    #[tokio::test(start_paused = true)]
    async fn a_response_is_dropped_after_an_hour() {
        let mut recent = Recent::default();
        recent.remember(identity("a", "1", 7), vec![42]);

        tokio::time::advance(Duration::from_secs(3_600)).await;
        assert_eq!(recent.answer(&identity("a", "1", 7)), Ok(Some(&[42][..])));
        tokio::time::advance(Duration::from_millis(1)).await;
        assert_eq!(recent.answer(&identity("a", "1", 8)), Ok(None));
        assert!(recent.0.is_empty());
    }

    /// Oracle: the bound: only the caller with the most changes loses responses, its oldest first.
    #[test]
    fn memory_is_bounded() {
        let mut recent = Recent::default();
        recent.remember(identity("b", "0", 0), Vec::new());
        for number in 0..=KEPT {
            recent.remember(identity("a", &number.to_string(), 0), Vec::new());
        }

        assert_eq!(recent.0.len(), KEPT);
        assert_eq!(recent.answer(&identity("a", "0", 0)), Ok(None));
        assert_eq!(recent.answer(&identity("a", "1", 0)), Ok(None));
        assert!(recent.answer(&identity("a", "2", 0)).unwrap().is_some());
        assert!(recent.answer(&identity("b", "0", 0)).unwrap().is_some());
    }
}
