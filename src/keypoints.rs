//! Mapping of keypoints, shared by the commands that encode rooms.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, bail};

use super::progress::bar;
use seese3_core::features::FeatureSource;
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::image::RgbImage;
use seese3_core::keypoints::{KeypointSource, Keypoints};
use seese3_encoder::{Encoder, KeypointOutputs};
use seese3_robot::matched_views::{KeypointMap, Mapping, MappingParameters};
use seese3_store::RoomKeypoints;

/// Largest relative difference between the aspect ratios of an image and of its camera.
const MAX_ASPECT_DIFFERENCE: f64 = 0.01;

/// Triangulates the keypoints of mapped frames and measures the noise of the map, on the threads of
/// the calling rayon pool.
pub fn map_keypoints(
    poses: &[Pose],
    keypoints: &[Keypoints],
    camera: CameraIntrinsics,
) -> anyhow::Result<KeypointMap> {
    let mapping = Mapping::new(poses, keypoints, camera, MappingParameters::default())?;
    let progress = bar(mapping.frame_count() as u64, "triangulating keypoints");
    let mut map = mapping.map(&|| progress.inc(1));

    progress.set_message("measuring the noise of the map");
    map.measure_noise(&mapping);
    progress.finish_and_clear();
    Ok(map)
}

/// The keypoints of a room with their source; `feature` are the features of the same encoder pass.
pub fn room_keypoints(
    map: KeypointMap,
    feature: FeatureSource,
    outputs: &KeypointOutputs,
    model: &str,
) -> anyhow::Result<RoomKeypoints> {
    let file = Path::new(model);
    let file = file
        .canonicalize()
        .with_context(|| file.display().to_string())?;
    Ok(RoomKeypoints {
        source: keypoint_source(feature, outputs, &file.to_string_lossy()),
        map: Arc::new(map),
    })
}

/// The source of keypoints that an encoder detects.
fn keypoint_source(
    feature: FeatureSource,
    outputs: &KeypointOutputs,
    model_file: &str,
) -> KeypointSource {
    KeypointSource {
        feature,
        positions: outputs.positions.clone(),
        reliability: outputs.reliability.clone(),
        descriptors: outputs.descriptors.clone(),
        model_file: model_file.to_owned(),
    }
}

/// Refuses an image that the camera cannot have taken.
pub fn check_aspect(
    image: RgbImage,
    name: &str,
    camera: Option<&CameraIntrinsics>,
) -> Result<RgbImage, seese3_encoder::Error> {
    let height = image.height as f64 / image.width as f64;
    match camera.map(CameraIntrinsics::height) {
        Some(expected) if (height / expected - 1.0).abs() > MAX_ASPECT_DIFFERENCE => {
            Err(seese3_encoder::Error::BadImage {
                image: name.to_owned(),
                problem: format!(
                    "is {} by {} pixels, but the camera of the room takes images {expected:.4} times as high \
                     as wide; give the camera of these images, uncropped",
                    image.width, image.height
                )
                .into(),
            })
        }
        _ => Ok(image),
    }
}

/// The keypoint outputs of an encoder, and the camera that mapping needs; `None` if the encoder
/// detects no keypoints.
pub fn mapping_inputs<'a>(
    encoder: &'a Encoder,
    camera: Option<CameraIntrinsics>,
    room: &str,
) -> anyhow::Result<Option<(&'a KeypointOutputs, CameraIntrinsics)>> {
    let Some(outputs) = encoder.keypoint_outputs() else {
        return Ok(None);
    };

    match camera {
        Some(camera) => Ok(Some((outputs, camera))),
        None => bail!(
            "room '{room}' has no camera, which matched views need: import it again with --camera \
             WIDTHxHEIGHT,FOCAL, or encode it with a recipe without keypoints"
        ),
    }
}
