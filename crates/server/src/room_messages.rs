//! The messages of a stored room, for an upload or a download. The protocol does not carry a
//! dataset's frame numbers, held-out marks, image paths or the path of the keypoints' model.

use std::ops::Range;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::convert::{camera_to_wire, source_to_wire};
use seese3_client::proto::v1 as pb;
use seese3_core::features::Features;
use seese3_core::geometry::Pose;
use seese3_store::{KeypointsHeader, RoomKeypoints, StoredRoom};

/// Target size of a message, bytes, well below the limits of servers and clients. A message holds
/// at least one frame.
pub const MESSAGE_BYTES: usize = 1 << 20;

/// Why a stored room cannot be sent.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Unsendable {
    #[error("the room has no features; compute them with `seese3 encode`")]
    NoFeatures,
    #[error(
        "the room's keypoints belong to features '{name}', which it does not have; encode it again"
    )]
    KeypointFeatures { name: String },
    #[error("the room's keypoints were made with another camera; encode it again")]
    KeypointCamera,
    #[error("the room's keypoints cannot be written: {0}")]
    Keypoints(#[from] seese3_store::Error),
}

/// The first message of an upload of the room's content.
///
/// # Errors
/// [`Unsendable`] if the room has no features, or its keypoints do not belong to it.
pub fn room_upload(stored: &StoredRoom) -> Result<pb::RoomUpload, Unsendable> {
    if stored.features.is_empty() {
        return Err(Unsendable::NoFeatures);
    }

    let provenance = stored.room.provenance();
    let sources = stored.features.iter().map(Features::source);
    let keypoints = stored.keypoints.as_ref();
    let keypoints = keypoints.map(|keypoints| keypoints_upload(stored, keypoints));
    Ok(pb::RoomUpload {
        room: stored.room.id().to_string(),
        feature_sources: sources.map(source_to_wire).collect(),
        format: provenance.format.clone(),
        license: provenance.license.clone(),
        camera: provenance.camera.as_ref().map(camera_to_wire),
        keypoints: keypoints.transpose()?,
        ..pb::RoomUpload::default()
    })
}

/// The description of a room's keypoints.
fn keypoints_upload(
    stored: &StoredRoom,
    keypoints: &RoomKeypoints,
) -> Result<pb::KeypointsUpload, Unsendable> {
    let KeypointsHeader {
        source,
        camera,
        unit_m,
        epipolar_px,
        noise,
    } = keypoints.header();

    // The upload states one camera for the room and its keypoints, and the features by their name.
    let name = source.feature.name.clone();
    let features = stored.features(&name);
    if features.map(Features::source) != Some(&source.feature) {
        return Err(Unsendable::KeypointFeatures { name });
    }
    if stored.room.provenance().camera != Some(camera) {
        return Err(Unsendable::KeypointCamera);
    }

    Ok(pb::KeypointsUpload {
        feature_set: name,
        positions: source.positions,
        reliability: source.reliability,
        descriptors: source.descriptors,
        unit_m,
        epipolar_px,
        design_effect: noise.design_effect,
        gap_scale: noise.gap_scale,
        pose_noise: noise.pose_noise,
        relative_error: noise.relative_error,
    })
}

/// A message after the first one.
#[derive(Debug, Clone, PartialEq)]
pub enum RoomPart {
    /// Frames, in the order of the recording.
    Frames(pb::FrameBatch),
    /// The next part of the file of keypoints.
    Keypoints(Vec<u8>),
    /// The last message.
    End(pb::UploadEnd),
}

/// The messages after the first one, made one by one.
pub struct RoomParts {
    stored: Arc<StoredRoom>,
    /// Number of frames in a message.
    batch: usize,
    /// Number of frames sent so far.
    sent: usize,
    /// The file of keypoints; empty if there are none.
    keypoints: Vec<u8>,
    /// Number of its bytes sent so far.
    sent_keypoints: usize,
    digest: Sha256,
    is_ended: bool,
}

impl RoomParts {
    /// The messages of a room, with its keypoints if it has any.
    ///
    /// # Errors
    /// [`Unsendable::Keypoints`].
    pub fn new(stored: Arc<StoredRoom>) -> Result<Self, Unsendable> {
        let columns: usize = stored.features.iter().map(|set| set.rows().ncols()).sum();
        let keypoints = stored.keypoints.as_ref().map(RoomKeypoints::to_bytes);
        Ok(Self {
            batch: (MESSAGE_BYTES / (128 + 4 * columns)).max(1),
            sent: 0,
            keypoints: keypoints.transpose()?.unwrap_or_default(),
            sent_keypoints: 0,
            digest: Sha256::new(),
            is_ended: false,
            stored,
        })
    }
}

impl Iterator for RoomParts {
    type Item = RoomPart;

    fn next(&mut self) -> Option<RoomPart> {
        let frame_count = self.stored.room.frame_count();
        if self.sent < frame_count {
            let rows = self.sent..(self.sent + self.batch).min(frame_count);
            self.sent = rows.end;
            let batch = batch(&self.stored, rows);
            self.digest.update(&batch.poses);
            for rows in &batch.features {
                self.digest.update(rows);
            }
            return Some(RoomPart::Frames(batch));
        }

        let rest = &self.keypoints[self.sent_keypoints..];
        if !rest.is_empty() {
            let part = rest[..rest.len().min(MESSAGE_BYTES)].to_vec();
            self.sent_keypoints += part.len();
            self.digest.update(&part);
            return Some(RoomPart::Keypoints(part));
        }

        if self.is_ended {
            return None;
        }
        self.is_ended = true;
        Some(RoomPart::End(pb::UploadEnd {
            frame_count: frame_count as u32,
            sha256: self.digest.clone().finalize().to_vec(),
        }))
    }
}

fn batch(stored: &StoredRoom, rows: Range<usize>) -> pb::FrameBatch {
    /// The given rows of a column; empty if the room has no such column.
    fn part<T: Clone>(column: &[T], rows: &Range<usize>) -> Vec<T> {
        column.get(rows.clone()).unwrap_or_default().to_vec()
    }

    let pose_bytes = |pose: &Pose| {
        // nalgebra matrices are column-major; the transpose gives the row-major order of NumPy.
        let matrix = pose.to_homogeneous().transpose();
        let numbers = matrix.iter().flat_map(|number| number.to_le_bytes());
        numbers.collect::<Vec<u8>>()
    };
    let feature_bytes = |set: &Features| {
        let part = set.rows().slice_move(ndarray::s![rows.clone(), ..]);
        part.iter()
            .flat_map(|number| number.to_le_bytes())
            .collect()
    };

    let frames = stored.room.frames();
    pb::FrameBatch {
        poses: frames.poses[rows.clone()]
            .iter()
            .flat_map(pose_bytes)
            .collect(),
        features: stored.features.iter().map(feature_bytes).collect(),
        images: Vec::new(),
        timestamps_ns: part(&frames.timestamps_ns, &rows),
        frame_names: part(&frames.names, &rows),
        segments: part(&frames.sequences, &rows),
    }
}
