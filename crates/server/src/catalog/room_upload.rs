//! Room uploads, in batches of frames and parts of the keypoints.

use std::sync::Arc;
use std::time::Duration;

use prost::Message;
use tonic::Streaming;

use super::super::caller::{CallerId, Requester};
use super::super::received_room::{CompleteRoom, POSE_BYTES, ReceivedRoom};
use super::super::shares::Share;
use super::super::snapshot::Snapshot;
use super::super::workers::Lane;
use super::super::{Error, Handlers};
use super::changes::{
    Changes, check_right, identity, on_blocking_thread, resource, revision_to_wire,
};
use seese3_client::proto::v1 as pb;
use seese3_data::pose_check::check_room;
use seese3_store::{Kind, OtherFeatures, Published, ResourceName, Store, UploadPolicy};

/// An error of an upload, with the path of its field in UploadRoomRequest.
fn of_upload(error: Error) -> Error {
    error.of_upload("room", &["frames", "keypoints", "end"])
}

/// Idle timeout of an upload.
const SILENCE: Duration = Duration::from_secs(30);
/// Size of the keypoints of a stored frame in memory, bytes: 300 of 48.
pub const KEYPOINT_BYTES: usize = 14_400;

/// Receives the next message of an upload.
///
/// # Errors
/// [`Error::Invalid`] if the stream has ended, [`Error::Deadline`] after the idle timeout,
/// [`Error::Transport`] if the caller disconnected or the message cannot be decoded.
pub async fn next<M>(messages: &mut Streaming<M>, field: &str) -> Result<M, Error> {
    let message = tokio::time::timeout(SILENCE, messages.message()).await;
    match message.map_err(|_| Error::Deadline)? {
        Ok(Some(message)) => Ok(message),
        Ok(None) => Err(Error::invalid(
            field,
            "is missing: the upload ended before it",
        )),
        // The caller disconnected, or the message cannot be decoded.
        Err(status) => Err(Error::Transport {
            code: status.code(),
            problem: status.message().to_owned(),
        }),
    }
}

/// Checks that the stream has ended.
///
/// # Errors
/// [`Error::Invalid`] if another message follows, otherwise as [`next`].
pub async fn expect_end<M>(messages: &mut Streaming<M>) -> Result<(), Error> {
    match next(messages, "message").await {
        // `next` reports the end of the stream as `Invalid`.
        Err(Error::Invalid { .. }) => Ok(()),
        Ok(_) => Err(Error::invalid("message", "follows the last message")),
        Err(error) => Err(error),
    }
}

/// What an upload may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    Create,
    Replace,
    Extend,
}

/// The mode of an upload.
///
/// # Errors
/// [`Error::Invalid`] if there is no such mode.
pub fn upload_mode(mode: i32) -> Result<Mode, Error> {
    match pb::UploadMode::try_from(mode) {
        Ok(pb::UploadMode::Unspecified | pb::UploadMode::Create) => Ok(Mode::Create),
        Ok(pb::UploadMode::Replace) => Ok(Mode::Replace),
        Ok(pb::UploadMode::Extend) => Ok(Mode::Extend),
        Err(_) => Err(Error::invalid("mode", format!("has no value {mode}"))),
    }
}

impl Changes {
    /// Reserves memory for extending a room: the existing room and the added frames are joined in
    /// memory.
    async fn extension_memory(&self, caller: &CallerId, room: &str) -> Result<Share, Error> {
        let known = self.store.newest_room_summary(room).await?;
        let columns: usize = known.features.iter().map(|source| source.dim).sum();
        let keypoints = known.keypoints.map_or(0, |_| KEYPOINT_BYTES);
        let bytes = known.frame_count * (POSE_BYTES + 4 * columns + keypoints);
        self.upload_memory(caller, 2 * bytes)
    }
}

impl Handlers {
    /// Receives a room, checks it and, unless `validate_only`, publishes it or extends the stored
    /// room.
    pub(super) async fn receive_room(
        &self,
        caller: Requester,
        snapshot: Arc<Snapshot>,
        mut messages: Streaming<pb::UploadRoomRequest>,
    ) -> Result<pb::UploadRoomResponse, Error> {
        use pb::upload_room_request::Message as Wire;

        let changes = self.changes()?.clone();
        let first = next(&mut messages, "room").await?.message;
        let Some(Wire::Room(upload)) = first else {
            return Err(Error::invalid("room", "is required in the first message"));
        };
        let within = |error: Error| error.within("room");
        let mut received = begun(&upload, &caller, &snapshot).map_err(within)?;
        let mode = upload_mode(upload.mode).map_err(within)?;
        if mode == Mode::Extend {
            let memory = changes.extension_memory(&caller.id, &received.name.name);
            received.memory.push(memory.await.map_err(of_upload)?);
        }

        let (mut received, end) = self
            .receive_frames(received, &snapshot, &mut messages)
            .await?;
        expect_end(&mut messages).await?;

        let mut content = upload.encode_to_vec();
        content.extend(received.room.other_columns());
        content.extend(&end.sha256);
        let identity = identity(&caller, &upload.request_id, "UploadRoom", &content);

        let name = received.name.name.clone();
        let memory = std::mem::take(&mut received.memory);
        let of_room = name.clone();
        let uploaded = on_blocking_thread(async move {
            let uploaded = received.room.finish(&end)?;
            for warning in check_room(&uploaded.room, None).warnings {
                tracing::warn!(room = of_room, %warning, "the poses of an uploaded room look wrong");
            }
            Ok::<_, Error>(uploaded)
        });
        let uploaded = uploaded.await??;
        let others = if upload.drop_other_features {
            OtherFeatures::LeftBehind
        } else {
            OtherFeatures::Required
        };

        let store = changes.store_for(&caller);
        let room = name.clone();
        if upload.validate_only {
            let check = async move {
                store.check_quotas(Some(&room)).await?;
                check(&uploaded, &store, mode, others).await
            };
            changes
                .validated(&caller.id, check)
                .await
                .map_err(of_upload)?;
            return Ok(pb::UploadRoomResponse::default());
        }

        let change = async move {
            // Uploaded data counts toward the limit until it is stored.
            let _memory = memory;
            Ok(publish(&uploaded, &store, mode, others).await?)
        };
        let handlers = self.clone();
        let answer = move |published: Published| {
            let revision = revision_to_wire(&name, &published);
            pb::UploadRoomResponse {
                served: handlers.serves(Kind::Room, &revision),
                created: published.is_new,
                revision: Some(revision),
            }
        };
        let published = changes.once(identity, change, answer).await;
        published.map_err(of_upload)
    }

    /// Receives the frames of an upload, up to its end message.
    async fn receive_frames(
        &self,
        mut received: Received,
        snapshot: &Arc<Snapshot>,
        messages: &mut Streaming<pb::UploadRoomRequest>,
    ) -> Result<(Received, pb::UploadEnd), Error> {
        use pb::upload_room_request::Message as Wire;

        let changes = self.changes()?;
        loop {
            match next(messages, "end").await?.message {
                Some(Wire::Frames(batch)) => {
                    let arrived = changes.upload_memory(&received.caller, batch.encoded_len())?;
                    let kept = changes
                        .upload_memory(&received.caller, received.room.kept_bytes(&batch))?;
                    received.memory.push(kept);
                    received = self
                        .take_batch(received, snapshot, batch)
                        .await
                        .map_err(|error| error.within("frames"))?;
                    drop(arrived);
                }
                Some(Wire::Keypoints(part)) => {
                    let bytes = received.room.keypoint_bytes_to_reserve(&part)?;
                    let memory = changes.upload_memory(&received.caller, bytes)?;
                    received.memory.push(memory);
                    received.room.take_keypoints(&part)?;
                }
                Some(Wire::End(end)) => return Ok((received, end)),
                Some(Wire::Room(_)) => {
                    return Err(Error::invalid("room", "may only be sent once"));
                }
                None => {
                    let problem =
                        "one of room, frames, keypoints and end is required in every message";
                    return Err(Error::invalid("message", problem));
                }
            }
        }
    }

    /// Adds a batch of frames.
    async fn take_batch(
        &self,
        mut received: Received,
        snapshot: &Arc<Snapshot>,
        batch: pb::FrameBatch,
    ) -> Result<Received, Error> {
        // Hashing and decoding would hold up the requests of others.
        let room = received.room;
        let taken = on_blocking_thread(async move { room.take(batch) });
        let (room, images) = taken.await??;
        received.room = room;

        if let Some(adapter) = received.encode_for.clone() {
            let rows = self
                .encoded(&received.caller, snapshot, adapter, images)
                .await?;
            received.room.take_encoded(rows);
        }
        Ok(received)
    }

    /// Computes the features of images, one after another, as long work.
    async fn encoded(
        &self,
        caller: &CallerId,
        snapshot: &Arc<Snapshot>,
        adapter: String,
        images: Vec<Vec<u8>>,
    ) -> Result<Vec<f32>, Error> {
        let mut rows = Vec::new();
        for image in images {
            let snapshot = snapshot.clone();
            let adapter = adapter.clone();
            let encode = move || {
                let adapter = snapshot.adapter(&adapter)?;
                snapshot.image_encoder(adapter)?.feature("images", &image)
            };
            let encoded = self.workers.run_frame(Lane::Long, caller.clone(), encode);
            rows.extend(encoded.await??);
        }

        Ok(rows)
    }
}

/// An upload in progress.
struct Received {
    name: ResourceName,
    room: ReceivedRoom,
    /// The adapter whose encoder computes the features from images.
    encode_for: Option<String>,
    memory: Vec<Share>,
    /// The caller that is charged for memory and worker time.
    caller: CallerId,
}

/// Checks the first message of an upload.
fn begun(
    upload: &pb::RoomUpload,
    caller: &Requester,
    snapshot: &Snapshot,
) -> Result<Received, Error> {
    let name = resource(Kind::Room, &upload.room, None)?;
    check_right(caller, &name)?;
    check_extension(upload)?;

    let (room, encode_for) = match (
        upload.feature_sources.as_slice(),
        upload.encode_for.as_str(),
    ) {
        (_, "") => (ReceivedRoom::begin(upload)?, None),
        ([], adapter) => {
            let stored = snapshot
                .adapter(adapter)
                .map_err(|error| error.named("encode_for"))?;
            snapshot.image_encoder(stored)?;
            let source = stored.adapter.source().clone();
            let room = ReceivedRoom::begin_with_images(upload, source)?;
            (room, Some(adapter.to_owned()))
        }
        _ => {
            let problem = "must be left out: the upload has feature_sources";
            return Err(Error::invalid("encode_for", problem));
        }
    };

    Ok(Received {
        name,
        room,
        encode_for,
        memory: Vec::new(),
        caller: caller.id.clone(),
    })
}

/// Checks the fields that depend on the mode.
fn check_extension(upload: &pb::RoomUpload) -> Result<(), Error> {
    if upload_mode(upload.mode)? != Mode::Extend {
        return match upload.drop_other_features {
            true => Err(Error::invalid(
                "drop_other_features",
                "needs UPLOAD_MODE_EXTEND",
            )),
            false => Ok(()),
        };
    }

    for (field, words) in [("format", &upload.format), ("license", &upload.license)] {
        if !words.is_empty() {
            let problem = "must be left out: a room that is extended keeps its own";
            return Err(Error::invalid(field, problem));
        }
    }
    Ok(())
}

/// Checks that a room can be published, without writing.
async fn check(
    uploaded: &CompleteRoom,
    store: &Store,
    mode: Mode,
    others: OtherFeatures,
) -> Result<(), Error> {
    match mode {
        Mode::Create => {
            store
                .check_upload(&uploaded.room, UploadPolicy::Create)
                .await?;
        }
        Mode::Replace => {
            store
                .check_upload(&uploaded.room, UploadPolicy::Replace)
                .await?;
        }
        Mode::Extend => {
            store.extended_room(uploaded.contents(), others).await?;
        }
    }
    Ok(())
}

/// Publishes a room.
async fn publish(
    uploaded: &CompleteRoom,
    store: &Store,
    mode: Mode,
    others: OtherFeatures,
) -> Result<Published, seese3_store::Error> {
    let contents = uploaded.contents();
    match mode {
        Mode::Create => store.upload_contents(contents, UploadPolicy::Create).await,
        Mode::Replace => store.upload_contents(contents, UploadPolicy::Replace).await,
        Mode::Extend => store.extend_room(contents, others).await,
    }
}
