//! OdometryService.Encode: views to latents. A robot can then send some twenty numbers per frame
//! instead of an image.

use tonic::{Request, Response, Status};

use super::convert;
use super::cost::lane;
use super::embedding::RequestAdapter;
use super::workers::{image_count, images_of};
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;

/// The largest number of views in one request.
const MAX_VIEWS: usize = 256;

impl Handlers {
    /// Answers an Encode request on a worker thread.
    pub(super) async fn encoded_views(
        &self,
        request: Request<pb::EncodeRequest>,
    ) -> Result<Response<pb::EncodeResponse>, Status> {
        self.unary(
            request,
            |_, request| lane(image_count(&request.views), 0.0),
            answer,
        )
        .await
    }
}

fn answer(
    snapshot: &Snapshot,
    request: pb::EncodeRequest,
    cancel: &Cancellation,
) -> Result<pb::EncodeResponse, Error> {
    let pb::EncodeRequest {
        adapter,
        adapter_revision: _,
        room,
        room_revision: _,
        views,
        with_features,
    } = request;

    if views.is_empty() || views.len() > MAX_VIEWS {
        return Err(Error::invalid(
            "views",
            format!("must be 1 to {MAX_VIEWS}, got {}", views.len()),
        ));
    }

    let adapter = convert::stated_adapter(&adapter, &views)?.to_owned();
    let chosen = RequestAdapter::of(snapshot, &room, &adapter)?;
    let revision = convert::stored_revision(&chosen.stored);
    let embedder = chosen.embedder(snapshot);
    if image_count(&views) > 0 {
        let encoder = snapshot.image_encoder(&chosen.stored)?;
        encoder.check_pixels("views", images_of(&views))?;
    }
    let mut encoded = Vec::with_capacity(views.len());
    for (position, view) in views.into_iter().enumerate() {
        cancel.check()?;
        let embedded = embedder.embed(&format!("views[{position}]"), Some(view))?;

        encoded.push(pb::EncodedView {
            latent: Some(pb::Latent {
                values: embedded.latent.to_vec(),
                adapter: Some(revision.clone()),
            }),
            feature: embedded
                .feature
                .filter(|_| with_features)
                .map(|values| pb::Feature {
                    values,
                    feature_set: chosen.stored.adapter.source().name.clone(),
                }),
        });
    }

    Ok(pb::EncodeResponse {
        adapter: Some(revision),
        views: encoded,
    })
}
