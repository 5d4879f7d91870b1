//! Encodes images that callers send instead of features, within size limits, with the encoder that
//! made the adapter's features.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use super::decoding::DecodingMemory;
use super::metrics::Metrics;
use super::{Error, RunError};
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_core::keypoints::KeypointSource;
use seese3_encoder::{Bounds, EncodedFrame, Encoder, Runtime, decode, decoding_cost};
use seese3_store::StoredAdapter;

/// Configuration of the image encoders.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageEncoders {
    /// The encoders of the adapters' features: `builtin`, `pixels`, or paths of ONNX files.
    pub models: Vec<String>,
    /// The runtime that executes ONNX models.
    pub runtime: Runtime,
    /// The largest size of one image, encoded and decoded.
    pub bounds: Bounds,
    /// The largest number of pixels of all images of one request.
    pub request_pixels: u64,
}

impl ImageEncoders {
    /// Default of `request_pixels`: 256 images of 1280 × 720 pixels, or 16 of 16 million.
    pub const REQUEST_PIXELS: u64 = 1 << 28;

    /// The largest number of pixels of one image.
    pub fn pixels(&self) -> u64 {
        self.bounds.pixels
    }
}

/// Encodes images for one adapter.
pub struct ImageEncoder {
    encoder: Encoder,
    bounds: Bounds,
    request_pixels: u64,
    decoding: Arc<DecodingMemory>,
    metrics: Option<Metrics>,
}

impl ImageEncoder {
    /// Encodes with `encoder` within the limits of `encoders`. Images are decoded within
    /// `decoding`.
    pub fn new(encoder: Encoder, encoders: &ImageEncoders, decoding: Arc<DecodingMemory>) -> Self {
        Self {
            encoder,
            bounds: encoders.bounds,
            request_pixels: encoders.request_pixels,
            decoding,
            metrics: None,
        }
    }

    /// Checks the number of pixels of a request's images before any is decoded.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `field` if it is over the limit of a request.
    pub fn check_pixels<'a>(
        &self,
        field: &str,
        images: impl Iterator<Item = &'a [u8]>,
    ) -> Result<(), Error> {
        // An image without a valid header is refused when its turn comes.
        let costs = images.filter_map(decoding_cost);
        let pixels = costs.fold(0, |sum: u64, cost| sum.saturating_add(cost.pixels));
        if pixels <= self.request_pixels {
            return Ok(());
        }

        let problem = format!(
            "have {pixels} pixels together, over the limit of {} for one request; send fewer or smaller images",
            self.request_pixels
        );
        Err(Error::invalid(field, problem))
    }

    /// The limits on an image.
    pub fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Records the encoding time of each image in `metrics`.
    pub fn counted_in(self, metrics: Metrics) -> Self {
        Self {
            metrics: Some(metrics),
            ..self
        }
    }

    /// The feature of one JPEG or PNG image. `field` is the name of the image's field in the
    /// request, for error messages.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `field` if the image cannot be decoded or its feature is not finite;
    /// [`Error::Internal`] if the encoder fails.
    pub fn feature(&self, field: &str, image: &[u8]) -> Result<Vec<f32>, Error> {
        let image = self.decoded(field, image)?;
        self.feature_of(field, image)
    }

    /// The pixels of one JPEG or PNG image.
    ///
    /// # Errors
    /// As [`ImageEncoder::feature`].
    pub fn decoded(&self, field: &str, image: &[u8]) -> Result<RgbImage, Error> {
        let cost = decoding_cost(image).map_or(0, |cost| cost.bytes);
        let _memory = self.decoding.wait(cost);
        decode("image", image, self.bounds).map_err(|error| request_error(field, error))
    }

    /// The feature of decoded pixels.
    ///
    /// # Errors
    /// As [`ImageEncoder::feature`].
    pub fn feature_of(&self, field: &str, image: RgbImage) -> Result<Vec<f32>, Error> {
        Ok(self.frame_of(field, image)?.feature)
    }

    /// The feature of decoded pixels and, with an encoder of keypoints, their keypoints.
    ///
    /// # Errors
    /// As [`ImageEncoder::feature`].
    pub fn frame_of(&self, field: &str, image: RgbImage) -> Result<EncodedFrame, Error> {
        let began = Instant::now();
        let frames = self
            .encoder
            .prepare(image)
            .and_then(|image| self.encoder.encode_frames(&[vec![&image]]));

        if let Some(metrics) = &self.metrics {
            metrics.image_encoded(began.elapsed());
        }
        let mut frames = frames.map_err(|error| request_error(field, error))?;
        frames.pop().ok_or(Error::Internal)
    }

    /// Whether the features of this encoder are those of `source`.
    pub fn makes(&self, source: &FeatureSource) -> bool {
        // A feature has the columns of all layers, one after the other.
        let made = FeatureSource::joined(&self.encoder.sources(""));
        made.is_ok_and(|made| made.is_like(source))
    }
}

/// A bad image is the caller's error, on `field`. Any other error is internal and only logged.
fn request_error(field: &str, error: seese3_encoder::Error) -> Error {
    match error {
        seese3_encoder::Error::BadImage { problem, .. } => Error::invalid(field, problem),
        error @ seese3_encoder::Error::NotFinite { .. } => Error::invalid(field, error),
        error => {
            tracing::error!(%error, "encoding an image failed");
            Error::Internal
        }
    }
}

/// Checks that every model can be read, so that a wrong path fails at startup.
///
/// # Errors
/// [`RunError::Model`] if a model cannot be read.
pub fn check_models(models: &[String]) -> Result<(), RunError> {
    for model in models {
        seese3_encoder::identity(model).map_err(|problem| RunError::Model {
            model: model.clone(),
            problem,
        })?;
    }

    Ok(())
}

/// Warns about models that make neither an adapter's features nor a room's keypoints: probably a
/// configuration mistake.
pub fn warn_of_unneeded<'a>(
    models: &[String],
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
    keypoints: impl Iterator<Item = &'a KeypointSource> + Clone,
) {
    for model in models {
        // `check_models` has reported unreadable models.
        let Ok(id) = seese3_encoder::identity(model) else {
            continue;
        };

        let is_needed = adapters
            .values()
            .any(|adapter| adapter.adapter.source().encoder == id)
            || keypoints.clone().any(|source| source.feature.encoder == id);
        if !is_needed {
            tracing::warn!(
                model,
                id,
                "no adapter and no room's keypoints use this encoder"
            );
        }
    }
}

/// The encoder of an adapter's features. `None`, with a log line, if it is not configured or takes
/// clips instead of single images.
///
/// # Errors
/// [`seese3_encoder::Error`] if it cannot be built or its features have another width.
pub fn open_for(
    adapter: &str,
    source: &FeatureSource,
    encoders: &ImageEncoders,
    decoding: Arc<DecodingMemory>,
) -> Result<Option<ImageEncoder>, seese3_encoder::Error> {
    let made_by = Encoder::of_source(source, &encoders.models, &encoders.runtime)?;
    let Some(encoder) = made_by else {
        tracing::warn!(
            adapter,
            encoder = source.encoder,
            "no --encoder matches the adapter's features; it accepts no images"
        );
        return Ok(None);
    };

    if encoder.window() > 1 {
        tracing::warn!(
            adapter,
            "the adapter's features are made from clips; it accepts no single images"
        );
        return Ok(None);
    }

    // The encoder must give the adapter's input width; joined features have several layers.
    if encoder.dims().iter().sum::<usize>() != source.dim {
        return Err(seese3_encoder::Error::Option {
            what: "encoder",
            given: encoder.id().to_owned(),
            problem: format!(
                "gives {:?} columns, but the adapter needs {}",
                encoder.dims(),
                source.dim
            )
            .into(),
        });
    }

    tracing::info!(
        adapter,
        encoder = encoder.id(),
        runtime = encoder.runtime(),
        "image encoder ready"
    );
    Ok(Some(ImageEncoder::new(encoder, encoders, decoding)))
}
