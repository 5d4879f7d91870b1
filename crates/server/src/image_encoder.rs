//! Images that callers send instead of features. They are decoded within size limits and encoded by
//! the same encoder that made the adapter's features.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use super::metrics::Metrics;
use super::{Error, RunError};
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_encoder::{Bounds, Encoder, Runtime, decode};
use seese3_store::StoredAdapter;

/// The encoders that a server may use for images.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageEncoders {
    /// `builtin`, `pixels`, or paths of ONNX files: the encoders that made the adapters' features.
    pub models: Vec<String>,
    /// XFeat's ONNX file, whose feature maps tell the motion between two images; none if the server
    /// does not read it.
    pub two_view: Option<PathBuf>,
    /// The runtime that executes ONNX models.
    pub runtime: Runtime,
    /// The largest size of one image, encoded and decoded.
    pub bounds: Bounds,
}

/// Encodes images for one adapter.
pub struct ImageEncoder {
    encoder: Encoder,
    bounds: Bounds,
    metrics: Option<Metrics>,
}

impl ImageEncoder {
    /// Encodes images of at most the size of `bounds` by `encoder`.
    pub fn new(encoder: Encoder, bounds: Bounds) -> Self {
        Self {
            encoder,
            bounds,
            metrics: None,
        }
    }

    /// The same, with the time of each image counted.
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
        decode("image", image, self.bounds).map_err(|error| told(field, error))
    }

    /// The feature of decoded pixels.
    ///
    /// # Errors
    /// As [`ImageEncoder::feature`].
    pub fn feature_of(&self, field: &str, image: RgbImage) -> Result<Vec<f32>, Error> {
        let began = Instant::now();
        let rows = self
            .encoder
            .prepare(image)
            .and_then(|image| self.encoder.encode(&[vec![&image]]));

        if let Some(metrics) = &self.metrics {
            metrics.image_encoded(began.elapsed());
        }
        rows.map(|rows| rows.row(0).to_vec())
            .map_err(|error| told(field, error))
    }
}

/// A bad image is the caller's error and names the field. Anything else is a failure of this server,
/// which only its log explains.
fn told(field: &str, error: seese3_encoder::Error) -> Error {
    match error {
        seese3_encoder::Error::BadImage { problem, .. } => Error::invalid(field, problem),
        error @ seese3_encoder::Error::NotFinite { .. } => Error::invalid(field, error),
        error => {
            tracing::error!(%error, "an image could not be encoded");
            Error::Internal
        }
    }
}

/// Reads every model before any adapter is looked at, so that a wrong path ends the server at once.
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

/// Warns of models that no adapter needs: probably a mistake of the operator.
pub fn warn_of_unneeded(models: &[String], adapters: &BTreeMap<String, Arc<StoredAdapter>>) {
    for model in models {
        // Every model was read before, by `check_models`.
        let Ok(id) = seese3_encoder::identity(model) else {
            continue;
        };

        let is_needed = adapters
            .values()
            .any(|adapter| adapter.adapter.source().encoder == id);
        if !is_needed {
            tracing::warn!(model, id, "no adapter's features were made by this encoder");
        }
    }
}

/// The encoder that made an adapter's features; none if it is not at hand or takes clips, which the
/// log says.
///
/// # Errors
/// [`seese3_encoder::Error`] if it cannot be built or gives features of another width.
pub fn open_for(
    adapter: &str,
    source: &FeatureSource,
    encoders: &ImageEncoders,
) -> Result<Option<ImageEncoder>, seese3_encoder::Error> {
    let made_by = Encoder::of_source(source, &encoders.models, &encoders.runtime)?;
    let Some(encoder) = made_by else {
        tracing::warn!(
            adapter,
            encoder = source.encoder,
            "no --encoder made the adapter's features; images cannot be sent for it"
        );
        return Ok(None);
    };

    if encoder.window() > 1 {
        tracing::warn!(
            adapter,
            "the adapter's features are made from clips; it takes no single images"
        );
        return Ok(None);
    }

    // One layer, as wide as the adapter's input.
    if encoder.dims() != [source.dim] {
        return Err(seese3_encoder::Error::Option {
            what: "encoder",
            given: encoder.id().to_owned(),
            problem: format!(
                "gives {:?} columns, the adapter takes {}",
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
        "takes images"
    );
    Ok(Some(ImageEncoder::new(encoder, encoders.bounds)))
}
