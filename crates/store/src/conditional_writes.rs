//! Verifies that the server of a bucket supports conditional writes.
//!
//! A manifest is written with `If-None-Match: *`, which fails if its revision number exists. So two
//! publishers take different numbers. A server that ignores the header would overwrite the first
//! manifest. If-Match is not used: a change of the defaults is a new numbered file too.

use object_store::path::Path;
use object_store::{ObjectStoreExt, PutMode, PutOptions, PutPayload};

use super::{Error, Store};

impl Store {
    /// Verifies once that the server supports If-None-Match, with a temporary object. Always
    /// succeeds for a store that was opened as a folder.
    ///
    /// # Errors
    /// [`Error::NotConditional`] if the server ignores or rejects the header, [`Error::Io`] if the
    /// bucket cannot be written.
    pub async fn check_conditional_writes(&self) -> Result<(), Error> {
        match &self.is_conditional {
            Some(known) => known
                .get_or_try_init(|| self.try_condition())
                .await
                .map(drop),
            None => Ok(()),
        }
    }

    async fn try_condition(&self) -> Result<(), Error> {
        let since = std::time::UNIX_EPOCH.elapsed().unwrap_or_default();
        let probe = format!("probe-{}-{}", std::process::id(), since.as_nanos());
        let probe = Path::from(probe);
        let io = |error| self.io(&probe, error);

        let first = self.objects.put(&probe, PutPayload::from_static(b"first"));
        first.await.map_err(io)?;
        let options = PutOptions::from(PutMode::Create);
        let second = PutPayload::from_static(b"second");
        let second = self.objects.put_opts(&probe, second, options).await;
        if let Err(error) = self.objects.delete(&probe).await {
            tracing::warn!(%error, %probe, "cannot remove a temporary object");
        }
        match second {
            Err(
                object_store::Error::AlreadyExists { .. }
                | object_store::Error::Precondition { .. },
            ) => Ok(()),
            Ok(_) | Err(object_store::Error::NotImplemented { .. }) => Err(Error::NotConditional {
                location: self.location().to_owned(),
            }),
            Err(error) => Err(io(error)),
        }
    }
}
