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
    #[arg(
        long = "keypoint-encoder",
        value_name = "FILE",
        conflicts_with = "adapter"
    )]
    pub model: Option<PathBuf>,
    /// Folder of the images; by default that of the import. Without an adapter, rooms of `seese3
    /// studio` are drawn again
    #[arg(long, value_name = "DIR")]
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
        let encoder = self.encoder(stored, keypoints)?;
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

    /// The keypoints of a room, and those of all its frames with their features.
    ///
    /// # Errors
    /// As [`KeypointViews::encode`], or if the room has no keypoints.
    pub fn encode_matchable<'a>(
        &self,
        stored: &'a StoredRoom,
    ) -> anyhow::Result<(&'a RoomKeypoints, Encoded)> {
        let Some(keypoints) = &stored.keypoints else {
            bail!(
                "room '{}' has no keypoints: encode it with `seese3 encode --recipe xfeat-keypoints`, or leave \
                 out --keypoints and give --adapter",
                stored.room.id()
            );
        };
        Ok((keypoints, self.encode(stored, keypoints)?))
    }

    /// The encoder of a room's keypoints.
    ///
    /// # Errors
    /// A description if the model is not that of the room.
    pub fn encoder(
        &self,
        stored: &StoredRoom,
        keypoints: &RoomKeypoints,
    ) -> anyhow::Result<Encoder> {
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
        Ok(encoder)
    }

    /// Refuses --images for a command that reads none.
    ///
    /// # Errors
    /// A description if --images is given.
    pub fn refuse_images(&self) -> anyhow::Result<()> {
        if self.images.is_some() {
            bail!("--images is for matched keypoints: leave out --adapter and --fit, or --images");
        }
        Ok(())
    }
}
