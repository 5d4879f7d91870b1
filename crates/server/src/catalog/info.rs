//! The version, the abilities and the limits of the server.

use tonic::Request;

use super::super::auth::Verb;
use super::super::image_encoder::ImageEncoders;
use super::super::{Error, Handlers, Snapshot, principal};
use seese3_client::proto::v1 as pb;

impl Handlers {
    /// What the server offers to the caller of a request.
    ///
    /// # Errors
    /// [`Error::Loading`] if the server is not serving.
    pub(super) fn info<T>(&self, request: &Request<T>) -> Result<pb::ServerInfo, Error> {
        let snapshot = self.snapshot(request)?;
        let may_write = principal(request).is_none_or(|caller| caller.may(Verb::Write));
        let limits = self.config.limits;
        let encoders = self.config.encoders.as_ref();

        Ok(pb::ServerInfo {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            encoders: encoders_to_wire(&snapshot),
            writable: self.changes.is_some() && may_write,
            encodes_images: snapshot.any_image_encoder().is_some(),
            matches_keypoints: snapshot.keypoint_encoder_for(None).is_some(),
            shows_thumbnails: self.config.thumbnails,
            limits: Some(pb::ServerLimits {
                top_k: limits.top_k,
                steps: limits.steps,
                batch: self.config.batch as u32,
                predictions: self.config.predictions as u32,
                message_bytes: self.config.message_bytes as u64,
                duration_s: self.config.longest.as_secs_f64(),
                image_pixels: encoders.map_or(0, ImageEncoders::pixels),
                request_pixels: encoders.map_or(0, |encoders| encoders.request_pixels),
                answer_frames: limits.frames_in_answer.try_into().unwrap_or(u32::MAX),
                upload_bytes: self.config.upload_bytes as u64,
                streams: self.config.streams as u32,
            }),
        })
    }
}

/// The encoders of a snapshot, each with the adapters whose features it makes, sorted by identity.
fn encoders_to_wire(snapshot: &Snapshot) -> Vec<pb::ServerEncoder> {
    let mut encoders: Vec<pb::ServerEncoder> = Vec::new();
    let mut entry = |identity: &str| -> usize {
        let known = encoders.iter().position(|known| known.encoder == identity);
        known.unwrap_or_else(|| {
            encoders.push(pb::ServerEncoder {
                encoder: identity.to_owned(),
                ..Default::default()
            });
            encoders.len() - 1
        })
    };

    let of_adapters = snapshot.encoded_adapters();
    let adapters: Vec<(usize, &str)> = of_adapters
        .map(|adapter| {
            (
                entry(&adapter.adapter.source().encoder),
                adapter.name.as_str(),
            )
        })
        .collect();
    let detectors: Vec<usize> = snapshot
        .keypoint_sources()
        .map(|source| entry(&source.feature.encoder))
        .collect();

    for (position, name) in adapters {
        encoders[position].adapters.push(name.to_owned());
    }
    for position in detectors {
        encoders[position].detects_keypoints = true;
    }
    encoders.sort_by(|a, b| a.encoder.cmp(&b.encoder));
    encoders
}
