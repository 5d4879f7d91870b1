//! Adapter uploads.

use prost::Message;
use tonic::Streaming;

use super::super::caller::Requester;
use super::super::{Error, Handlers};
use super::changes::{check_right, identity, resource, revision_to_wire};
use super::room_upload::{Mode, expect_end, next, upload_mode};
use seese3_client::proto::v1 as pb;
use seese3_store::{Kind, Published, UploadPolicy};

impl Handlers {
    /// Receives an adapter and publishes it.
    pub(super) async fn receive_adapter(
        &self,
        caller: Requester,
        mut messages: Streaming<pb::UploadAdapterRequest>,
    ) -> Result<pb::UploadAdapterResponse, Error> {
        use pb::upload_adapter_request::Message as Wire;

        let changes = self.changes()?.clone();
        let first = next(&mut messages, "adapter").await?.message;
        let Some(Wire::Adapter(upload)) = first else {
            return Err(Error::invalid(
                "adapter",
                "is required in the first message",
            ));
        };

        let within = |error: Error| error.within("adapter");
        let name = resource(Kind::Adapter, &upload.adapter, None).map_err(within)?;
        check_right(&caller, &name)?;
        let policy = match upload_mode(upload.mode).map_err(within)? {
            Mode::Create => UploadPolicy::Create,
            Mode::Replace => UploadPolicy::Replace,
            Mode::Extend => {
                let problem =
                    "extends only rooms; replace the adapter, or upload it under another name";
                return Err(within(Error::invalid("mode", problem)));
            }
        };

        // The manifest states the size of the weights, so no more memory is reserved or accepted.
        let size = seese3_store::stated_weights_size(&upload.manifest).map_err(unfit)?;
        let size = usize::try_from(size).unwrap_or(usize::MAX);
        let memory = changes.upload_memory(&caller.id, size)?;
        let weights = weights(&mut messages, size).await?;

        // Loading verifies that the weights reproduce their golden outputs on this machine.
        let manifest = upload.manifest.clone();
        let checked = tokio::task::spawn_blocking(move || {
            seese3_store::check_adapter_files(&manifest, &weights).map(|_| weights)
        });
        let weights = checked.await.map_err(|_| Error::Internal)?.map_err(unfit)?;
        let store = changes.store_for(&caller);
        if upload.validate_only {
            let check = async move {
                store.check_quotas(None).await?;
                store.check_adapter_upload(&name.name, policy).await?;
                Ok(())
            };
            let checked = changes.validated(&caller.id, check).await;
            checked.map_err(|error| error.of_upload("adapter", &["weights"]))?;
            return Ok(pb::UploadAdapterResponse::default());
        }

        let content = upload.encode_to_vec();
        let identity = identity(&caller, &upload.request_id, "UploadAdapter", &content);
        let published_as = name.name.clone();
        let change = async move {
            // Uploaded data counts toward the limit until it is stored.
            let _memory = memory;
            store
                .upload_adapter_files(&name.name, &upload.manifest, weights, policy)
                .await
                .map_err(unfit)
        };
        let handlers = self.clone();
        let answer = move |published: Published| {
            let revision = revision_to_wire(&published_as, &published);
            pb::UploadAdapterResponse {
                served: handlers.serves(Kind::Adapter, &revision),
                created: published.is_new,
                revision: Some(revision),
            }
        };
        let published = changes.once(identity, change, answer).await;
        published.map_err(|error| error.of_upload("adapter", &["weights"]))
    }
}

/// Receives the weights, `size` bytes according to the manifest.
async fn weights(
    messages: &mut Streaming<pb::UploadAdapterRequest>,
    size: usize,
) -> Result<Vec<u8>, Error> {
    use pb::upload_adapter_request::Message as Wire;

    let mut weights = Vec::new();
    while weights.len() < size {
        match next(messages, "weights").await?.message {
            Some(Wire::Weights(part)) if part.len() <= size - weights.len() => {
                weights.extend(part);
            }
            Some(Wire::Weights(_)) => {
                let problem = format!("are longer than the {size} bytes that the manifest states");
                return Err(Error::invalid("weights", problem));
            }
            _ => {
                return Err(Error::invalid(
                    "weights",
                    "are required after the first message",
                ));
            }
        }
    }

    expect_end(messages).await?;
    Ok(weights)
}

/// A defect of the uploaded files is the caller's error.
fn unfit(error: seese3_store::Error) -> Error {
    match error {
        seese3_store::Error::Damaged { .. } | seese3_store::Error::Schema { .. } => {
            Error::invalid("adapter.manifest", error)
        }
        other => other.into(),
    }
}
