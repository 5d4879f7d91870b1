//! Room uploads, in batches of frames and parts of the keypoints.

use std::sync::Arc;
use std::time::Duration;

use nalgebra::Matrix4;
use ndarray::Array2;
use prost::Message;
use sha2::{Digest, Sha256};
use tonic::Streaming;

use super::super::caller::{CallerId, Requester};
use super::super::shares::Share;
use super::super::snapshot::Snapshot;
use super::super::workers::Lane;
use super::super::{Error, Handlers, convert};
use super::changes::{
    Changes, check_length, check_right, identity, on_blocking_thread, resource, revision_to_wire,
};
use super::keypoints_upload::ReceivedKeypoints;
use seese3_client::proto::v1 as pb;
use seese3_core::features::{FeatureSource, Features, MAX_COLUMNS, UNSPECIFIED};
use seese3_core::geometry;
use seese3_core::room::{Frames, MAX_FRAME_NAME, Provenance, Room, RoomId, is_plain_name};
use seese3_data::pose_check::check_room;
use seese3_store::{
    Kind, OtherFeatures, Published, ResourceName, RoomContents, RoomKeypoints, Store, UploadPolicy,
};

/// Idle timeout of an upload.
const SILENCE: Duration = Duration::from_secs(30);
/// A pose on the wire: 16 numbers of 8 bytes.
const POSE_BYTES: usize = 128;
/// Size of the keypoints of a stored frame in memory, bytes: 300 of 48.
const KEYPOINT_BYTES: usize = 14_400;

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

/// An upload in progress.
struct Received {
    name: ResourceName,
    sources: Vec<FeatureSource>,
    /// The adapter whose encoder computes the features from images.
    encode_for: Option<String>,
    frames: Frames,
    /// The feature values of each source, row by row.
    rows: Vec<Vec<f32>>,
    /// The keypoints, if the upload has any.
    keypoints: Option<ReceivedKeypoints>,
    worst_rotation_deviation: f64,
    digest: Sha256,
    /// Hash of the columns that the caller's checksum does not cover.
    other_columns: Sha256,
    memory: Vec<Share>,
    /// The caller that is charged for memory and worker time.
    caller: CallerId,
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
        let mut received = begun(&upload, &caller, &snapshot)?;
        let mode = upload_mode(upload.mode).map_err(|error| error.within("room"))?;
        if mode == Mode::Extend {
            let memory = changes.extension_memory(&caller.id, &received.name.name);
            received.memory.push(memory.await?);
        }

        let (mut received, end) = self
            .receive_frames(received, &snapshot, &mut messages)
            .await?;
        expect_end(&mut messages).await?;

        let mut content = upload.encode_to_vec();
        content.extend(received.other_columns.clone().finalize());
        content.extend(&end.sha256);
        let identity = identity(&caller, &upload.request_id, "UploadRoom", &content);

        let name = received.name.name.clone();
        let memory = std::mem::take(&mut received.memory);
        let (described, of_room) = (upload.clone(), name.clone());
        let uploaded = on_blocking_thread(async move {
            let uploaded = finished(received, &described, &end)?;
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
                uploaded.check(&store, mode, others).await
            };
            changes.validated(&caller.id, check).await?;
            return Ok(pb::UploadRoomResponse::default());
        }

        let change = async move {
            // Uploaded data counts toward the limit until it is stored.
            let _memory = memory;
            Ok(uploaded.publish(&store, mode, others).await?)
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
        changes.once(identity, change, answer).await
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
                    let kept =
                        changes.upload_memory(&received.caller, received.kept_bytes(&batch))?;
                    received.memory.push(kept);
                    received = self
                        .take_batch(received, snapshot, batch)
                        .await
                        .map_err(|error| error.within("frames"))?;
                    drop(arrived);
                }
                Some(Wire::Keypoints(part)) => {
                    let Some(keypoints) = &mut received.keypoints else {
                        let problem = "were not stated: room.keypoints is absent";
                        return Err(Error::invalid("keypoints", problem));
                    };

                    let bytes = ReceivedKeypoints::bytes_to_reserve(&part);
                    let memory = changes.upload_memory(&received.caller, bytes)?;
                    received.memory.push(memory);
                    received.digest.update(&part);
                    keypoints.take(&part);
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
        received: Received,
        snapshot: &Arc<Snapshot>,
        batch: pb::FrameBatch,
    ) -> Result<Received, Error> {
        // Hashing and decoding would hold up the requests of others.
        let taken = on_blocking_thread(async move { received.take(batch) });
        let (mut received, images) = taken.await??;

        if let Some(adapter) = received.encode_for.clone() {
            let rows = self
                .encoded(&received.caller, snapshot, adapter, images)
                .await?;
            received.rows[0].extend(rows);
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

/// Checks the first message of an upload.
fn begun(
    upload: &pb::RoomUpload,
    caller: &Requester,
    snapshot: &Snapshot,
) -> Result<Received, Error> {
    let within = |error: Error| error.within("room");
    let name = resource(Kind::Room, &upload.room, None).map_err(within)?;
    check_right(caller, &name)?;

    for (field, words) in [("format", &upload.format), ("license", &upload.license)] {
        check_length(field, words).map_err(within)?;
    }

    check_extension(upload).map_err(within)?;

    let (sources, encode_for) = match (upload.features.as_slice(), upload.encode_for.as_str()) {
        ([], "") => {
            let problem = "is required, or encode_for with images";
            return Err(within(Error::invalid("features", problem)));
        }
        (given, "") => {
            let sources = given.iter().map(source).collect::<Result<_, _>>();
            (sources.map_err(within)?, None)
        }
        ([], adapter) => {
            let stored = snapshot
                .adapter(adapter)
                .map_err(|error| within(error.named("encode_for")))?;
            snapshot.image_encoder(stored)?;
            (
                vec![stored.adapter.source().clone()],
                Some(adapter.to_owned()),
            )
        }
        _ => {
            let problem = "must be left out: the upload has features";
            return Err(within(Error::invalid("encode_for", problem)));
        }
    };

    Ok(Received {
        name,
        rows: vec![Vec::new(); sources.len()],
        keypoints: ReceivedKeypoints::begun(upload, &sources).map_err(within)?,
        sources,
        encode_for,
        frames: Frames::default(),
        worst_rotation_deviation: 0.0,
        digest: Sha256::new(),
        other_columns: Sha256::new(),
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

fn source(given: &pb::FeatureSource) -> Result<FeatureSource, Error> {
    // Destructured with no `..`, so that a new field breaks the build here.
    let pb::FeatureSource {
        name,
        encoder,
        layer,
        pooling,
        preprocess,
        dim,
        layer_index_base,
        final_norm,
    } = given.clone();
    let dim = dim as usize;

    if !is_plain_name(&name) {
        let problem =
            format!("{name:?} is not valid: use 1 to 100 letters, digits, '.', '-' or '_'");
        return Err(Error::invalid("features.name", problem));
    }
    if !(1..=MAX_COLUMNS).contains(&dim) {
        let problem = format!("must be 1 to {MAX_COLUMNS}, got {dim}");
        return Err(Error::invalid("features.dim", problem));
    }

    let or_unspecified = |field: &str, given: String| -> Result<String, Error> {
        check_length(field, &given).map_err(|error| error.within("features"))?;
        Ok(match given.as_str() {
            "" => UNSPECIFIED.to_owned(),
            _ => given,
        })
    };

    Ok(FeatureSource {
        name,
        encoder: or_unspecified("encoder", encoder)?,
        layer: or_unspecified("layer", layer)?,
        base: convert::layer_index_base(layer_index_base)?,
        norm: convert::final_norm(final_norm)?,
        pooling: or_unspecified("pooling", pooling)?,
        preprocess: or_unspecified("preprocess", preprocess)?,
        dim,
    })
}

impl Received {
    /// Memory kept for a batch, bytes; images are replaced by their features.
    fn kept_bytes(&self, batch: &pb::FrameBatch) -> usize {
        let images: usize = batch.images.iter().map(Vec::len).sum();
        let encoded = match self.encode_for {
            Some(_) => batch.images.len() * 4 * self.sources[0].dim,
            None => 0,
        };
        batch.encoded_len().saturating_sub(images) + encoded
    }

    /// Adds a batch of frames. Returns the images, which are still to be encoded.
    fn take(mut self, batch: pb::FrameBatch) -> Result<(Self, Vec<Vec<u8>>), Error> {
        // Destructured with no `..`, so that a new field breaks the build here.
        let pb::FrameBatch {
            poses,
            features,
            images,
            timestamps_ns,
            frame_names,
            segments,
        } = batch;

        let n = poses.len() / POSE_BYTES;
        if poses.is_empty() || poses.len() % POSE_BYTES != 0 {
            let problem = format!(
                "has {} bytes; n frames have n times {POSE_BYTES}, as 4 by 4 numbers of 64 bits",
                poses.len()
            );
            return Err(Error::invalid("poses", problem));
        }

        self.digest.update(&poses);
        features.iter().for_each(|rows| self.digest.update(rows));
        images.iter().for_each(|image| self.digest.update(image));

        let before = self.frames.poses.len();
        for (position, matrix) in poses.chunks_exact(POSE_BYTES).enumerate() {
            let numbers = matrix.as_chunks::<8>().0.iter();
            let matrix =
                Matrix4::from_row_iterator(numbers.map(|bytes| f64::from_le_bytes(*bytes)));
            let (pose, deviation) = geometry::pose_from_matrix(&matrix).map_err(|problem| {
                let frame = before + position;
                Error::invalid("poses", format!("the pose of frame {frame}: {problem}"))
            })?;
            self.worst_rotation_deviation = self.worst_rotation_deviation.max(deviation);
            self.frames.poses.push(pose);
        }

        self.take_features(&features, n)?;
        match &self.encode_for {
            Some(_) => check_count("images", images.len(), n)?,
            None if images.is_empty() => {}
            None => {
                let problem = "must be empty: the upload has no encode_for";
                return Err(Error::invalid("images", problem));
            }
        }

        self.take_columns(before, n, timestamps_ns, frame_names, segments)?;
        Ok((self, images))
    }

    /// Adds the features of `n` frames.
    fn take_features(&mut self, features: &[Vec<u8>], n: usize) -> Result<(), Error> {
        if self.encode_for.is_some() {
            return match features {
                [] => Ok(()),
                _ => Err(Error::invalid(
                    "features",
                    "must be empty: the upload has encode_for",
                )),
            };
        }

        check_count("features", features.len(), self.sources.len())?;
        for ((given, source), rows) in features.iter().zip(&self.sources).zip(&mut self.rows) {
            let expected = n * source.dim * 4;
            if given.len() != expected {
                let problem = format!(
                    "of '{}' have {} bytes; {n} frames of {} numbers of 32 bits have {expected}",
                    source.name,
                    given.len(),
                    source.dim
                );
                return Err(Error::invalid("features", problem));
            }

            let numbers = given.as_chunks::<4>().0.iter();
            rows.extend(numbers.map(|bytes| f32::from_le_bytes(*bytes)));
        }

        Ok(())
    }

    /// Adds the optional columns. `before` is the number of frames received earlier.
    fn take_columns(
        &mut self,
        before: usize,
        n: usize,
        timestamps_ns: Vec<i64>,
        frame_names: Vec<String>,
        segments: Vec<u32>,
    ) -> Result<(), Error> {
        for (field, given, known) in [
            (
                "timestamps_ns",
                timestamps_ns.len(),
                self.frames.timestamps_ns.len(),
            ),
            ("frame_names", frame_names.len(), self.frames.names.len()),
            ("segments", segments.len(), self.frames.sequences.len()),
        ] {
            // A column has entries for all frames or for none.
            let is_for_all = given == n && known == before;
            let is_for_none = given == 0 && known == 0;
            if !is_for_all && !is_for_none {
                let problem =
                    format!("has {given} entries for {n} frames; all batches need them, or none");
                return Err(Error::invalid(field, problem));
            }
        }

        for timestamp in &timestamps_ns {
            self.other_columns.update(timestamp.to_le_bytes());
        }
        if let Some(name) = frame_names.iter().find(|name| name.len() > MAX_FRAME_NAME) {
            let problem = format!(
                "has a name of {} bytes; the limit is {MAX_FRAME_NAME}",
                name.len()
            );
            return Err(Error::invalid("frame_names", problem));
        }
        for name in &frame_names {
            self.other_columns.update((name.len() as u64).to_le_bytes());
            self.other_columns.update(name);
        }
        for segment in &segments {
            self.other_columns.update(segment.to_le_bytes());
        }

        self.frames.timestamps_ns.extend(timestamps_ns);
        self.frames.names.extend(frame_names);
        self.frames.sequences.extend(segments);
        Ok(())
    }
}

fn check_count(field: &str, given: usize, expected: usize) -> Result<(), Error> {
    if given == expected {
        return Ok(());
    }
    Err(Error::invalid(
        field,
        format!("has {given} entries, expected {expected}"),
    ))
}

/// A complete upload.
struct UploadedRoom {
    room: Room,
    features: Vec<Features>,
    keypoints: Option<RoomKeypoints>,
}

impl UploadedRoom {
    fn contents(&self) -> RoomContents<'_> {
        RoomContents {
            room: &self.room,
            features: &self.features,
            keypoints: self.keypoints.as_ref(),
        }
    }

    /// Checks that the room can be published, without writing.
    async fn check(&self, store: &Store, mode: Mode, others: OtherFeatures) -> Result<(), Error> {
        match mode {
            Mode::Create => store.check_upload(&self.room, UploadPolicy::Create).await?,
            Mode::Replace => {
                store
                    .check_upload(&self.room, UploadPolicy::Replace)
                    .await?;
            }
            Mode::Extend => {
                store.extended_room(self.contents(), others).await?;
            }
        }
        Ok(())
    }

    async fn publish(
        &self,
        store: &Store,
        mode: Mode,
        others: OtherFeatures,
    ) -> Result<Published, seese3_store::Error> {
        let contents = self.contents();
        match mode {
            Mode::Create => store.upload_contents(contents, UploadPolicy::Create).await,
            Mode::Replace => store.upload_contents(contents, UploadPolicy::Replace).await,
            Mode::Extend => store.extend_room(contents, others).await,
        }
    }
}

/// Builds a room from a complete upload, after checking frame count and checksum.
fn finished(
    received: Received,
    upload: &pb::RoomUpload,
    end: &pb::UploadEnd,
) -> Result<UploadedRoom, Error> {
    let frame_count = received.frames.poses.len();
    if frame_count != end.frame_count as usize {
        let problem = format!("is {}, but {frame_count} frames arrived", end.frame_count);
        return Err(Error::invalid("end.frame_count", problem));
    }
    if received.digest.finalize().as_slice() != end.sha256 {
        let problem = "does not match the received bytes: poses, features and images of each \
                       batch, in this order, and the parts of the keypoints";
        return Err(Error::invalid("end.sha256", problem));
    }

    let provenance = Provenance {
        format: upload.format.clone(),
        licence: upload.license.clone(),
        images_root: String::new(),
        worst_rotation_deviation: received.worst_rotation_deviation,
        camera: upload
            .camera
            .as_ref()
            .map(convert::camera)
            .transpose()
            .map_err(|error| error.within("room"))?,
    };
    let unfit = |error: seese3_core::room::Error| Error::invalid("frames", error);
    let id = RoomId::new(&received.name.name).map_err(unfit)?;
    let room = Room::new(id, received.frames, provenance).map_err(unfit)?;

    let features = received.sources.into_iter().zip(received.rows);
    let features: Vec<Features> = features
        .map(|(source, numbers)| {
            let rows = Array2::from_shape_vec((frame_count, source.dim), numbers);
            let rows = rows.map_err(|error| Error::invalid("frames.features", error))?;
            Features::new(source, rows).map_err(|error| Error::invalid("frames.features", error))
        })
        .collect::<Result<_, Error>>()?;

    seese3_store::check_features(&room, &features)?;
    let keypoints = received.keypoints;
    let keypoints = keypoints.map(|keypoints| keypoints.finished(frame_count));
    Ok(UploadedRoom {
        room,
        features,
        keypoints: keypoints.transpose()?,
    })
}
