//! The keypoints of a room as they arrive in messages.

use super::{Error, convert};
use seese3_client::proto::v1 as pb;
use seese3_core::features::FeatureSource;
use seese3_core::keypoints::KeypointSource;
use seese3_robot::matched_views::MapNoise;
use seese3_store::{KeypointsHeader, RoomKeypoints};

/// Memory that keypoints need until they are stored, in bytes per byte of their file: the file, its
/// tensors and the keypoints of each frame.
const MEMORY_FACTOR: usize = 4;

/// The keypoints of an upload in progress.
#[derive(Debug)]
pub struct ReceivedKeypoints {
    header: KeypointsHeader,
    file: Vec<u8>,
}

impl ReceivedKeypoints {
    /// Checks what the first message of an upload states about its keypoints; `None` if it states
    /// nothing. `sources` are those of the uploaded features.
    ///
    /// # Errors
    /// [`Error::Invalid`] with a field of the first message.
    pub fn begin(
        upload: &pb::RoomUpload,
        sources: &[FeatureSource],
    ) -> Result<Option<Self>, Error> {
        let Some(stated) = &upload.keypoints else {
            return Ok(None);
        };

        let camera = upload.camera.as_ref().ok_or_else(|| {
            let problem = "is required: the upload has keypoints, which need it";
            Error::invalid("camera", problem)
        })?;
        let camera = convert::camera(camera)?;
        let header = KeypointsHeader {
            source: source(stated, sources).map_err(|error| error.within("keypoints"))?,
            camera,
            unit_m: stated.unit_m,
            epipolar_px: stated.epipolar_px,
            noise: MapNoise {
                design_effect: stated.design_effect,
                gap_scale: stated.gap_scale,
                pose_noise: stated.pose_noise,
                relative_error: stated.relative_error,
            },
        };
        header
            .check()
            .map_err(|error| Error::invalid(format!("keypoints.{}", error.field), error))?;

        Ok(Some(Self {
            header,
            file: Vec::new(),
        }))
    }

    /// Memory to reserve for the next part of the file, bytes.
    pub fn bytes_to_reserve(part: &[u8]) -> usize {
        MEMORY_FACTOR * part.len()
    }

    /// Adds the next part of the file.
    pub fn take(&mut self, part: &[u8]) {
        self.file.extend(part);
    }

    /// The keypoints of a room of `frame_count` frames, from a complete upload.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the file is not one of such keypoints.
    pub fn finished(self, frame_count: usize) -> Result<RoomKeypoints, Error> {
        if self.file.is_empty() {
            let problem =
                "are missing: the upload states keypoints, but sends no part of their file";
            return Err(Error::invalid("keypoints", problem));
        }

        let keypoints = RoomKeypoints::from_bytes(self.header, &self.file, frame_count);
        keypoints.map_err(|error| match error {
            seese3_store::Error::Damaged { problem, .. } => Error::invalid("keypoints", problem),
            other => other.into(),
        })
    }
}

/// The source of uploaded keypoints. The path of the model is that of another machine, so it is not
/// uploaded.
fn source(
    stated: &pb::KeypointsUpload,
    sources: &[FeatureSource],
) -> Result<KeypointSource, Error> {
    let feature = sources
        .iter()
        .find(|source| source.name == stated.feature_set);
    let feature = feature.ok_or_else(|| {
        let names: Vec<&str> = sources.iter().map(|source| source.name.as_str()).collect();
        let problem = format!(
            "'{}' is none of the feature sets of the upload: {}",
            stated.feature_set,
            names.join(", ")
        );
        Error::invalid("feature_set", problem)
    })?;

    let output = |field: &str, name: &String| {
        if name.is_empty() {
            return Err(Error::invalid(field, "is required"));
        }
        convert::check_length(field, name)?;
        Ok(name.clone())
    };
    Ok(KeypointSource {
        feature: feature.clone(),
        positions: output("positions", &stated.positions)?,
        reliability: output("reliability", &stated.reliability)?,
        descriptors: output("descriptors", &stated.descriptors)?,
        model_file: String::new(),
    })
}
