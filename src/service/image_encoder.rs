//! Images that callers send instead of features. They are decoded within size limits and encoded by
//! the same encoder that made the adapter's features.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use super::{Error, RunError};
use crate::encoder::{self, Bounds, Encoder, Runtime, decode};
use crate::store::StoredAdapter;
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;

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
}

impl ImageEncoder {
    /// Encodes images of at most the size of `bounds` by `encoder`.
    pub fn new(encoder: Encoder, bounds: Bounds) -> Self {
        Self { encoder, bounds }
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
        self.encoder
            .prepare(image)
            .and_then(|image| self.encoder.encode(&[vec![&image]]))
            .map(|rows| rows.row(0).to_vec())
            .map_err(|error| told(field, error))
    }
}

/// A bad image is the caller's error and names the field. Anything else is a failure of this server,
/// which only its log explains.
fn told(field: &str, error: encoder::Error) -> Error {
    match error {
        encoder::Error::BadImage { problem, .. } => Error::invalid(field, problem),
        error @ encoder::Error::NotFinite { .. } => Error::invalid(field, error),
        error => {
            tracing::error!(%error, "an image could not be encoded");
            Error::Internal
        }
    }
}

/// One image encoder for every adapter whose own encoder is among `encoders`. Adapters without one
/// are left out, with a warning in the log.
///
/// # Errors
/// [`RunError::Model`] if a model cannot be read, [`RunError::Encoder`] if an adapter's encoder
/// cannot be built or gives features of another width.
pub fn open(
    encoders: Option<&ImageEncoders>,
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
) -> Result<BTreeMap<String, Arc<ImageEncoder>>, RunError> {
    let mut image_encoders = BTreeMap::new();
    let Some(ImageEncoders {
        models,
        runtime,
        bounds,
        ..
    }) = encoders
    else {
        return Ok(image_encoders);
    };

    check_models(models, adapters)?;

    // Adapters that were trained on features of the same source share one encoder, because loading
    // a model is expensive.
    let mut opened: Vec<(&FeatureSource, Arc<ImageEncoder>)> = Vec::new();
    for (name, adapter) in adapters {
        let source = adapter.adapter.source();
        if let Some((_, image_encoder)) = opened.iter().find(|(other, _)| other.is_like(source)) {
            image_encoders.insert(name.clone(), image_encoder.clone());
            continue;
        }

        if let Some(encoder) = open_for(name, source, models, runtime)? {
            let image_encoder = Arc::new(ImageEncoder::new(encoder, *bounds));
            opened.push((source, image_encoder.clone()));
            image_encoders.insert(name.clone(), image_encoder);
        }
    }

    Ok(image_encoders)
}

/// Reads every model before any adapter is looked at, so that a wrong path ends the server at once.
/// A model that no adapter needs is probably a mistake of the operator.
fn check_models(
    models: &[String],
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
) -> Result<(), RunError> {
    for model in models {
        let id = encoder::identity(model).map_err(|problem| RunError::Model {
            model: model.clone(),
            problem,
        })?;

        let is_needed = adapters
            .values()
            .any(|adapter| adapter.adapter.source().encoder == id);
        if !is_needed {
            tracing::warn!(model, id, "no adapter's features were made by this encoder");
        }
    }

    Ok(())
}

/// The encoder that made an adapter's features; none if it is not at hand or takes clips, which the
/// log says.
fn open_for(
    adapter: &str,
    source: &FeatureSource,
    models: &[String],
    runtime: &Runtime,
) -> Result<Option<Encoder>, RunError> {
    let failed = |problem| RunError::Encoder {
        adapter: adapter.to_owned(),
        problem,
    };

    let Some(encoder) = Encoder::of_source(source, models, runtime).map_err(failed)? else {
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
        return Err(failed(encoder::Error::Option {
            what: "encoder",
            given: encoder.id().to_owned(),
            problem: format!(
                "gives {:?} columns, the adapter takes {}",
                encoder.dims(),
                source.dim
            ),
        }));
    }

    tracing::info!(
        adapter,
        encoder = encoder.id(),
        runtime = encoder.runtime(),
        "takes images"
    );
    Ok(Some(encoder))
}
