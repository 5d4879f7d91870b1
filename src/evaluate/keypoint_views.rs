//! Encodes the views of a room with keypoints again: the room stores only those of mapped frames.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;

use super::super::encoder::RuntimeOptions;
use super::super::progress::bar;
use super::room_images::{RoomImages, keypoint_model};
use seese3_core::cancel::Cancellation;
use seese3_encoder::{Encoded, Encoder, OnBadImage, Task, encode_room};
use seese3_store::{RoomKeypoints, StoredRoom};

/// Frames per run of the model.
const BATCH: usize = 8;

/// Options of commands that match the keypoints of views.
#[derive(Debug, Args)]
pub struct KeypointViews {
    /// ONNX file of the encoder with keypoints; by default the file that the room was encoded with
    #[arg(long, value_name = "FILE", conflicts_with = "adapter")]
    pub model: Option<PathBuf>,
    /// Folder of the images; by default that of the import. Rooms of `seese3 studio` are drawn again
    #[arg(long, value_name = "DIR", conflicts_with = "adapter")]
    pub images: Option<PathBuf>,
    #[command(flatten)]
    pub runtime: RuntimeOptions,
}

impl KeypointViews {
    /// Features and keypoints of all frames of a room, from its images.
    ///
    /// # Errors
    /// A description if the model is not that of the room, or an image cannot be read.
    pub fn encode(
        &self,
        stored: &StoredRoom,
        keypoints: &RoomKeypoints,
    ) -> anyhow::Result<Encoded> {
        let source = &keypoints.source;
        let model = keypoint_model(self.model.as_deref(), &source.model_file)?;
        let models = [model.to_string_lossy().into_owned()];
        let encoder = Encoder::of_keypoints(source, &models, &self.runtime.runtime())?;
        let Some(encoder) = encoder else {
            bail!(
                "room '{}' was encoded by '{}', but {} is another model",
                stored.room.id(),
                source.feature.encoder,
                model.display()
            );
        };

        let size = encoder.render_size();
        let images = RoomImages::of(&stored.room, self.images.as_deref(), size)?;
        let progress = bar(stored.room.frame_count() as u64, "encoding");
        let told = |done: usize| progress.set_position(done as u64);
        let task = Task {
            timeline: stored.room.timeline(),
            image: &|row| images.image(row),
            batch: BATCH,
            on_bad: OnBadImage::Stop,
            cancel: &Cancellation::default(),
        };

        let encoded = self
            .runtime
            .pool()?
            .install(|| encode_room(&task, &encoder, None, &told))?;
        progress.finish_and_clear();
        Ok(encoded)
    }
}
