//! Downloads of rooms and adapters.

use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

use super::super::memory::MemoryLease;
use super::super::received_room::POSE_BYTES;
use super::super::room_messages::{MESSAGE_BYTES, RoomPart, RoomParts, room_upload};
use super::super::workers::Lane;
use super::super::{Error, Handlers};
use super::changes::{on_blocking_thread, resource};
use super::room_upload::KEYPOINT_BYTES;
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_store::{Kind, RoomSummary};

/// The messages of a download.
pub type Messages<M> = ReceiverStream<Result<M, Status>>;

/// Reserves memory for the current request until its last message is sent.
///
/// # Errors
/// [`Error::Full`] if there is none.
fn hold(bytes: usize) -> Result<Option<MemoryLease>, Error> {
    let lease = MemoryLease::current();
    if let Some(lease) = &lease {
        lease.hold(bytes)?;
    }
    Ok(lease)
}

/// Size of a room in memory, bytes: its columns, and their copy in messages.
fn size_of(room: &RoomSummary) -> usize {
    let columns: usize = room.features.iter().map(|source| source.dim).sum();
    let keypoints = room.keypoints.as_ref().map_or(0, |_| 2 * KEYPOINT_BYTES);
    room.frame_count * (POSE_BYTES + 4 * columns + keypoints) + 2 * MESSAGE_BYTES
}

impl Handlers {
    /// Answers a DownloadRoom request.
    pub(super) async fn downloaded_room(
        &self,
        request: Request<pb::DownloadRoomRequest>,
    ) -> Result<Response<Messages<pb::DownloadRoomResponse>>, Status> {
        use pb::download_room_response::Message as Wire;

        let snapshot = self.snapshot(&request)?;
        let context = self.workers.context(&request);
        let pb::DownloadRoomRequest {
            room,
            room_revision,
        } = request.into_inner();

        // A hidden room is answered like a missing one.
        let current = snapshot.room(&room)?.summary.revision;
        let revision = room_revision.unwrap_or(current);
        resource(Kind::Room, &room, Some(revision))?;
        let summary = self.store.room_summary(&room, Some(revision)).await;
        let lease = hold(size_of(&summary.map_err(Error::from)?))?;

        let (store, runtime) = (self.store.clone(), Handle::current());
        let name = room.clone();
        let load = move |_: &Cancellation| {
            let stored = Arc::new(runtime.block_on(store.load_room(&name, Some(revision)))?);
            let unsendable = |problem| Error::Precondition(format!("room '{name}': {problem}"));
            let upload = room_upload(&stored).map_err(unsendable)?;
            let parts = RoomParts::new(stored).map_err(unsendable)?;
            Ok((upload, parts))
        };
        let (upload, mut parts) = self.workers.run(Lane::Long, context, load).await?;

        let (messages, received) = mpsc::channel(1);
        tokio::spawn(async move {
            let _lease = lease;
            let mut message = Some(Wire::Room(pb::RoomDownload {
                revision: Some(pb::Revision {
                    name: room,
                    revision,
                }),
                upload: Some(upload),
            }));
            while message.is_some() {
                let sent = messages.send(Ok(pb::DownloadRoomResponse { message }));
                if sent.await.is_err() {
                    return;
                }

                // Copying and hashing a batch would hold up other requests.
                let next = on_blocking_thread(async move {
                    let part = parts.next();
                    (parts, part)
                });
                let Ok((rest, part)) = next.await else {
                    return;
                };
                parts = rest;
                message = part.map(|part| match part {
                    RoomPart::Frames(batch) => Wire::Frames(batch),
                    RoomPart::Keypoints(part) => Wire::Keypoints(part),
                    RoomPart::End(end) => Wire::End(end),
                });
            }
        });
        Ok(Response::new(ReceiverStream::new(received)))
    }

    /// Answers a DownloadAdapter request.
    pub(super) async fn downloaded_adapter(
        &self,
        request: Request<pb::DownloadAdapterRequest>,
    ) -> Result<Response<Messages<pb::DownloadAdapterResponse>>, Status> {
        use pb::download_adapter_response::Message as Wire;

        let snapshot = self.snapshot(&request)?;
        let pb::DownloadAdapterRequest {
            adapter,
            adapter_revision,
        } = request.into_inner();

        // A hidden adapter is answered like a missing one.
        let current = snapshot.adapter(&adapter)?.revision;
        let revision = adapter_revision.unwrap_or(current);
        resource(Kind::Adapter, &adapter, Some(revision))?;
        let files = self.store.adapter_files(&adapter, Some(revision)).await;
        let (manifest, weights) = files.map_err(Error::from)?;
        let lease = hold(2 * (manifest.len() + weights.len()))?;

        let (messages, received) = mpsc::channel(1);
        tokio::spawn(async move {
            let _lease = lease;
            let revision = Some(pb::Revision {
                name: adapter,
                revision,
            });
            let first = Wire::Adapter(pb::AdapterDownload { revision, manifest });
            let parts = weights.chunks(MESSAGE_BYTES);
            let parts = parts.map(|part| Wire::Weights(part.to_vec()));
            for message in std::iter::once(first).chain(parts) {
                let message = Some(message);
                let sent = messages.send(Ok(pb::DownloadAdapterResponse { message }));
                if sent.await.is_err() {
                    return;
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(received)))
    }
}
