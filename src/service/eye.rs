//! Images that callers send instead of features: decoded within bounds and encoded as the adapter's
//! features were.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::{Error, RunError};
use crate::encoder::{self, Bounds, Encoder, Runtime, decode};
use crate::features::FeatureSource;
use crate::store::StoredAdapter;

/// What a server may encode images with.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageEncoders {
    /// `builtin`, `pixels`, or ONNX files: those that the adapters' features were made by.
    pub models: Vec<String>,
    /// How models are run.
    pub runtime: Runtime,
    /// Of one image.
    pub bounds: Bounds,
}

/// Encodes images for one adapter.
pub struct Eye {
    encoder: Encoder,
    bounds: Bounds,
}

impl Eye {
    /// The feature of an image, JPEG or PNG; `field` is its name in the request.
    pub fn feature(&self, field: &str, image: &[u8]) -> Result<Vec<f32>, Error> {
        let encoded = decode("image", image, self.bounds)
            .and_then(|image| self.encoder.prepare(image))
            .and_then(|image| self.encoder.encode(&[vec![&image]]));
        match encoded {
            Ok(rows) => Ok(rows.row(0).to_vec()),
            Err(encoder::Error::BadImage { problem, .. }) => Err(Error::invalid(field, problem)),
            Err(error @ encoder::Error::NotFinite { .. }) => Err(Error::invalid(field, error)),
            Err(error) => {
                tracing::error!(%error, "an image could not be encoded");
                Err(Error::Internal)
            }
        }
    }
}

/// The eye of every adapter whose encoder is at hand.
pub fn open(
    encoders: Option<&ImageEncoders>,
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
) -> Result<BTreeMap<String, Arc<Eye>>, RunError> {
    let mut eyes = BTreeMap::new();
    let Some(ImageEncoders {
        models,
        runtime,
        bounds,
    }) = encoders
    else {
        return Ok(eyes);
    };

    for model in models {
        let id = encoder::identity(model).map_err(|problem| RunError::Model {
            model: model.clone(),
            problem,
        })?;

        if adapters
            .values()
            .all(|adapter| adapter.adapter.source().encoder != id)
        {
            tracing::warn!(model, id, "no adapter's features were made by this encoder");
        }
    }

    // Adapters of one source share an encoder.
    let mut opened: Vec<(&FeatureSource, Arc<Eye>)> = Vec::new();
    for (name, adapter) in adapters {
        let source = adapter.adapter.source();
        if let Some((_, eye)) = opened.iter().find(|(other, _)| other.is_like(source)) {
            eyes.insert(name.clone(), eye.clone());
            continue;
        }

        let encoder =
            Encoder::of_source(source, models, runtime).map_err(|problem| RunError::Encoder {
                adapter: name.clone(),
                problem,
            })?;

        match encoder {
            Some(encoder) if encoder.window() > 1 => {
                tracing::warn!(
                    adapter = name,
                    "its features are of clips; single images cannot be sent for it"
                );
            }
            Some(encoder) if encoder.dims() == [source.dim] => {
                tracing::info!(
                    adapter = name,
                    encoder = encoder.id(),
                    runtime = encoder.runtime(),
                    "takes images"
                );

                let eye = Arc::new(Eye {
                    encoder,
                    bounds: *bounds,
                });
                opened.push((source, eye.clone()));

                eyes.insert(name.clone(), eye);
            }
            Some(encoder) => {
                let problem = encoder::Error::Option {
                    what: "encoder",
                    given: encoder.id().to_owned(),
                    problem: format!(
                        "gives {:?} columns, the adapter takes {}",
                        encoder.dims(),
                        source.dim
                    ),
                };

                return Err(RunError::Encoder {
                    adapter: name.clone(),
                    problem,
                });
            }
            None => {
                tracing::warn!(
                    adapter = name,
                    encoder = source.encoder,
                    "no --encoder is its own; no images for it"
                )
            }
        }
    }

    Ok(eyes)
}
