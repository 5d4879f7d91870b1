//! A room as it arrives in messages: the frames, features and keypoints of an upload or a download.

use nalgebra::Matrix4;
use ndarray::Array2;
use prost::Message as _;
use sha2::{Digest, Sha256};

use super::received_keypoints::ReceivedKeypoints;
use super::{Error, convert};
use seese3_client::proto::v1 as pb;
use seese3_core::features::{FeatureSource, Features, MAX_COLUMNS, UNSPECIFIED};
use seese3_core::geometry;
use seese3_core::room::{Frames, MAX_FRAME_NAME, Provenance, Room, RoomId, is_plain_name};
use seese3_store::{RoomContents, RoomKeypoints};

/// A pose on the wire: 16 numbers of 8 bytes.
pub const POSE_BYTES: usize = 128;

/// A room of which not all messages have arrived.
#[derive(Debug)]
pub struct ReceivedRoom {
    upload: pb::RoomUpload,
    sources: Vec<FeatureSource>,
    /// Whether images arrive instead of features.
    has_images: bool,
    frames: Frames,
    /// The feature values of each source, row by row.
    rows: Vec<Vec<f32>>,
    /// The keypoints, if the first message states any.
    keypoints: Option<ReceivedKeypoints>,
    worst_rotation_deviation: f64,
    digest: Sha256,
    /// Hash of the columns that the sender's checksum does not cover.
    other_columns: Sha256,
}

impl ReceivedRoom {
    /// Checks the first message of an upload of features.
    ///
    /// # Errors
    /// [`Error::Invalid`] with a field of the message.
    pub fn begin(upload: &pb::RoomUpload) -> Result<Self, Error> {
        if upload.feature_sources.is_empty() {
            let problem = "is required, or encode_for with images";
            return Err(Error::invalid("feature_sources", problem));
        }
        let sources = upload.feature_sources.iter().map(source);
        Self::of(upload, sources.collect::<Result<_, _>>()?, false)
    }

    /// Checks the first message of an upload of images, which the server converts to features of
    /// this source.
    ///
    /// # Errors
    /// [`Error::Invalid`] with a field of the message.
    pub fn begin_with_images(
        upload: &pb::RoomUpload,
        source: FeatureSource,
    ) -> Result<Self, Error> {
        Self::of(upload, vec![source], true)
    }

    fn of(
        upload: &pb::RoomUpload,
        sources: Vec<FeatureSource>,
        has_images: bool,
    ) -> Result<Self, Error> {
        for (field, words) in [("format", &upload.format), ("license", &upload.license)] {
            convert::check_length(field, words)?;
        }

        Ok(Self {
            upload: upload.clone(),
            rows: vec![Vec::new(); sources.len()],
            keypoints: ReceivedKeypoints::begin(upload, &sources)?,
            sources,
            has_images,
            frames: Frames::default(),
            worst_rotation_deviation: 0.0,
            digest: Sha256::new(),
            other_columns: Sha256::new(),
        })
    }

    /// Hash of the columns that the sender's checksum does not cover: timestamps, names, segments.
    pub fn other_columns(&self) -> Vec<u8> {
        self.other_columns.clone().finalize().to_vec()
    }

    /// Adds the features of the images of the last batch, row by row.
    pub fn take_encoded(&mut self, rows: Vec<f32>) {
        self.rows[0].extend(rows);
    }

    /// Memory to reserve for the next part of the keypoints, bytes.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the first message states no keypoints.
    pub fn keypoint_bytes_to_reserve(&self, part: &[u8]) -> Result<usize, Error> {
        match self.keypoints {
            Some(_) => Ok(ReceivedKeypoints::bytes_to_reserve(part)),
            None => {
                let problem = "were not stated: room.keypoints is absent";
                Err(Error::invalid("keypoints", problem))
            }
        }
    }

    /// Adds the next part of the keypoints.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the first message states no keypoints.
    pub fn take_keypoints(&mut self, part: &[u8]) -> Result<(), Error> {
        self.keypoint_bytes_to_reserve(part)?;
        self.digest.update(part);
        if let Some(keypoints) = &mut self.keypoints {
            keypoints.take(part);
        }
        Ok(())
    }

    /// Memory kept for a batch, bytes; images are replaced by their features.
    pub fn kept_bytes(&self, batch: &pb::FrameBatch) -> usize {
        let images: usize = batch.images.iter().map(Vec::len).sum();
        let encoded = if self.has_images {
            batch.images.len() * 4 * self.sources[0].dim
        } else {
            0
        };
        batch.encoded_len().saturating_sub(images) + encoded
    }

    /// Adds a batch of frames. Returns the images, whose features are still to be added.
    ///
    /// # Errors
    /// [`Error::Invalid`] with a field of the batch.
    pub fn take(mut self, batch: pb::FrameBatch) -> Result<(Self, Vec<Vec<u8>>), Error> {
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
        if self.has_images {
            check_count("images", images.len(), n)?;
        } else if !images.is_empty() {
            let problem = "must be empty: the upload has no encode_for";
            return Err(Error::invalid("images", problem));
        }

        self.take_columns(before, n, timestamps_ns, frame_names, segments)?;
        Ok((self, images))
    }

    /// Builds the room from all of its messages, after checking frame count and checksum.
    ///
    /// # Errors
    /// [`Error::Invalid`] with a field of the last message, or of a part that is not valid.
    pub fn finish(self, end: &pb::UploadEnd) -> Result<CompleteRoom, Error> {
        finished(self, end)
    }

    /// Adds the features of `n` frames.
    fn take_features(&mut self, features: &[Vec<u8>], n: usize) -> Result<(), Error> {
        if self.has_images {
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

/// A room whose messages have all arrived.
#[derive(Debug)]
pub struct CompleteRoom {
    /// The frames.
    pub room: Room,
    /// The feature sets.
    pub features: Vec<Features>,
    /// The keypoints, if there are any.
    pub keypoints: Option<RoomKeypoints>,
}

impl CompleteRoom {
    /// What is published.
    pub fn contents(&self) -> RoomContents<'_> {
        RoomContents {
            room: &self.room,
            features: &self.features,
            keypoints: self.keypoints.as_ref(),
        }
    }
}

/// Builds the room from all of its messages, after checking frame count and checksum.
fn finished(received: ReceivedRoom, end: &pb::UploadEnd) -> Result<CompleteRoom, Error> {
    let upload = &received.upload;
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
        license: upload.license.clone(),
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
    let id = RoomId::new(&upload.room).map_err(unfit)?;
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
    Ok(CompleteRoom {
        room,
        features,
        keypoints: keypoints.transpose()?,
    })
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
        parts,
    } = given.clone();
    let dim = dim as usize;

    if !parts.is_empty() {
        let problem = "upload the parts of joined features as feature sets of their own";
        return Err(Error::invalid("feature_sources.parts", problem));
    }

    if !is_plain_name(&name) {
        let problem =
            format!("{name:?} is not valid: use 1 to 100 letters, digits, '.', '-' or '_'");
        return Err(Error::invalid("feature_sources.name", problem));
    }
    if !(1..=MAX_COLUMNS).contains(&dim) {
        let problem = format!("must be 1 to {MAX_COLUMNS}, got {dim}");
        return Err(Error::invalid("feature_sources.dim", problem));
    }

    let or_unspecified = |field: &str, given: String| -> Result<String, Error> {
        convert::check_length(field, &given).map_err(|error| error.within("feature_sources"))?;
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
        parts: Vec::new(),
    })
}
