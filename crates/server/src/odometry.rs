//! OdometryService: EstimateMotion, which estimates the motion between two views. Track is in
//! `track`, Encode in `encoding`.

use ndarray::{Array1, ArrayView1, Axis};
use tonic::{Request, Response, Status};

use super::convert::{self, ImageCamera};
use super::embedding::RequestAdapter;
use super::snapshot::ServedNavigator;
use super::status::view_error;
use super::two_views;
use super::workers::Lane;
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::odometry_service_server::OdometryService;
use seese3_core::adapter::Cells;
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{Twist, body_twist, exp};
use seese3_core::navigation::StepError;
use seese3_core::room::FrameId;

#[tonic::async_trait]
impl OdometryService for Handlers {
    type TrackStream = super::track::Answers;

    async fn track(
        &self,
        request: Request<tonic::Streaming<pb::TrackRequest>>,
    ) -> Result<Response<Self::TrackStream>, Status> {
        Ok(Response::new(self.follow(request).await?))
    }

    async fn estimate_motion(
        &self,
        request: Request<pb::EstimateMotionRequest>,
    ) -> Result<Response<pb::EstimateMotionResponse>, Status> {
        self.unary(
            request,
            |_, request| Lane::of(request.first.iter().chain(&request.second)),
            answer,
        )
        .await
    }

    async fn encode(
        &self,
        request: Request<pb::EncodeRequest>,
    ) -> Result<Response<pb::EncodeResponse>, Status> {
        self.encoded_views(request).await
    }
}

fn answer(
    snapshot: &Snapshot,
    request: pb::EstimateMotionRequest,
    cancel: &Cancellation,
) -> Result<pb::EstimateMotionResponse, Error> {
    match pb::MotionEstimator::try_from(request.estimator) {
        Ok(pb::MotionEstimator::Relational) => return by_reader(snapshot, request, cancel),
        Ok(pb::MotionEstimator::Unspecified) => {}
        _ => {
            let problem = "must be absent or MOTION_ESTIMATOR_RELATIONAL";
            return Err(Error::invalid("estimator", problem));
        }
    }

    if let Some(answer) = by_two_views(snapshot, &request, cancel)? {
        return Ok(answer);
    }

    // Two images and no adapter: the caller may have forgotten the camera. Extend the error
    // message.
    let lacks_camera = snapshot.keypoint_encoder_for(None).is_some()
        && request.adapter.is_empty()
        && image(request.first.as_ref()).is_some()
        && image(request.second.as_ref()).is_some();
    by_adapter(snapshot, request, cancel).map_err(|error| match error {
        Error::Precondition(problem) if lacks_camera => Error::Precondition(format!(
            "{problem}; or give `camera`, or a room whose camera is known: this server then matches the keypoints of \
             the images, without an adapter"
        )),
        other => other,
    })
}

/// Estimates the motion with an adapter, from two latents.
fn by_adapter(
    snapshot: &Snapshot,
    request: pb::EstimateMotionRequest,
    cancel: &Cancellation,
) -> Result<pb::EstimateMotionResponse, Error> {
    let pb::EstimateMotionRequest {
        adapter,
        adapter_revision: _,
        room,
        room_revision: _,
        first,
        second,
        camera: _,
        estimator: _,
    } = request;

    let views = first.iter().chain(&second);
    let adapter = convert::stated_adapter(&adapter, views)?.to_owned();
    let chosen = RequestAdapter::of(snapshot, &room, &adapter)?;
    let embedder = chosen.embedder(snapshot);
    let stored = chosen.stored.clone();

    let frames = stored_frames(first.as_ref(), second.as_ref());
    let latent = |field: &str, given| -> Result<Array1<f64>, Error> {
        cancel.check()?;
        Ok(embedder.embed(field, given)?.latent)
    };

    let first = latent("first", first)?;
    let second = latent("second", second)?;
    let twist = stored.adapter.motion(first.view(), second.view());

    Ok(pb::EstimateMotionResponse {
        adapter: Some(convert::stored_revision(&stored)),
        motion: Some(convert::motion_to_wire(&twist, None)),
        estimator: pb::MotionEstimator::Adapter.into(),
        ..compared(chosen.served.as_deref(), frames, &twist)
    })
}

/// Estimates the motion with the relational reader of an adapter, from two feature maps.
fn by_reader(
    snapshot: &Snapshot,
    request: pb::EstimateMotionRequest,
    cancel: &Cancellation,
) -> Result<pb::EstimateMotionResponse, Error> {
    let pb::EstimateMotionRequest {
        adapter,
        room,
        first,
        second,
        ..
    } = request;

    let chosen = RequestAdapter::of(snapshot, &room, &adapter)?;
    let embedder = chosen.embedder(snapshot);
    let stored = chosen.stored.clone();
    let reader = stored.adapter.relational().ok_or_else(|| {
        let problem = format!(
            "adapter '{}' has no relational reader (train --reader relational)",
            stored.name
        );
        Error::invalid("estimator", problem)
    })?;

    let frames = stored_frames(first.as_ref(), second.as_ref());
    let cells = |field: &str, view: Option<pb::View>| -> Result<Cells, Error> {
        cancel.check()?;
        if let Some(pb::view::View::Latent(_)) = view.as_ref().and_then(|view| view.view.as_ref()) {
            let problem = "has no cells to compare; give a frame, a feature or an image";
            return Err(Error::invalid(format!("{field}.latent"), problem));
        }

        let frame = stored_frame(view.as_ref());
        let embedded = embedder.embed(field, view)?;
        let of_room = chosen
            .served
            .as_ref()
            .and_then(|served| served.navigator.cells());
        match (embedded.feature, frame.zip(of_room)) {
            (Some(feature), _) => {
                let row = ArrayView1::from(feature.as_slice()).insert_axis(Axis(0));
                let cells = reader.cells(row);
                cells.map_err(|error| view_error(&error).within(field))
            }
            (None, Some((frame, of_room))) => Ok(of_room.select(&[frame.row()])),
            (None, None) => Err(Error::Internal),
        }
    };

    let first = cells("first", first)?;
    let second = cells("second", second)?;
    let reading = reader.motions(&first, 0, &second)[0];
    let covariance = reader.error_scale().map(|_| &reading.covariance);

    Ok(pb::EstimateMotionResponse {
        adapter: Some(convert::stored_revision(&stored)),
        motion: Some(convert::motion_to_wire(&reading.twist, covariance)),
        estimator: pb::MotionEstimator::Relational.into(),
        ..compared(chosen.served.as_deref(), frames, &reading.twist)
    })
}

/// The frames, if both views are stored frames.
fn stored_frames(
    first: Option<&pb::View>,
    second: Option<&pb::View>,
) -> Option<(FrameId, FrameId)> {
    stored_frame(first).zip(stored_frame(second))
}

fn stored_frame(view: Option<&pb::View>) -> Option<FrameId> {
    match view?.view.as_ref()? {
        pb::view::View::FrameId(frame) => Some(FrameId(*frame)),
        _ => None,
    }
}

/// A response with the recorded motion between two stored frames and the error of an estimate,
/// and nothing else.
fn compared(
    served: Option<&ServedNavigator>,
    frames: Option<(FrameId, FrameId)>,
    estimate: &Twist,
) -> pb::EstimateMotionResponse {
    // The caller has checked that both frames exist.
    let truth = served.zip(frames).and_then(|(served, (first, second))| {
        let poses = served.navigator.room().poses();
        Some((poses.get(first.row())?, poses.get(second.row())?))
    });

    pb::EstimateMotionResponse {
        true_motion: truth
            .map(|(first, second)| convert::twist_to_wire(&body_twist(first, second))),
        // The estimate as a pose: world_from_second = world_from_first · exp(motion).
        error: truth.map(|(first, second)| {
            convert::error_to_wire(&StepError::of(first, &(first * exp(estimate)), second))
        }),
        ..pb::EstimateMotionResponse::default()
    }
}

/// Estimates the motion from matched keypoints. `None` if the request names an adapter, this server
/// has no encoder of keypoints, a view is not an image, or the camera is unknown.
fn by_two_views(
    snapshot: &Snapshot,
    request: &pb::EstimateMotionRequest,
    cancel: &Cancellation,
) -> Result<Option<pb::EstimateMotionResponse>, Error> {
    // Check a given camera for both estimators.
    let stated = request.camera.as_ref();
    let stated = stated.map(|camera| convert::image_camera("camera", camera));
    let stated = stated.transpose()?;
    if matches!(stated, Some(ImageCamera::Mapping)) && request.room.is_empty() {
        let problem = "needs room, which states whose mapping camera it is";
        return Err(Error::invalid("camera.mapping_camera", problem));
    }

    let served = match request.room.as_str() {
        "" => None,
        name => Some(snapshot.room(name)?),
    };
    let (Some(encoder), Some(first), Some(second), "") = (
        snapshot.keypoint_encoder_for(served.map(AsRef::as_ref)),
        image(request.first.as_ref()),
        image(request.second.as_ref()),
        request.adapter.as_str(),
    ) else {
        return Ok(None);
    };

    let of_room = served.and_then(|served| served.summary.provenance.camera);
    let stated = match stated {
        Some(ImageCamera::Stated(camera)) => Some(camera),
        Some(ImageCamera::Mapping) if of_room.is_none() => {
            let problem = "is not known: the room states no camera; state the intrinsics";
            return Err(Error::invalid("camera.mapping_camera", problem));
        }
        Some(ImageCamera::Mapping) | None => None,
    };
    let Some(camera) = stated.or(of_room) else {
        if request.room.is_empty() && snapshot.adapters().is_empty() {
            return Err(Error::invalid(
                "camera",
                "is required for two images: this server has no adapter",
            ));
        }

        return Ok(None);
    };

    let estimate = two_views::estimate(encoder, [first, second], &camera, cancel)?;
    let estimator = if estimate.is_estimated {
        pb::MotionEstimator::TwoView
    } else {
        pb::MotionEstimator::None
    };

    Ok(Some(pb::EstimateMotionResponse {
        adapter: None,
        motion: Some(convert::motion_to_wire(
            &estimate.twist(),
            Some(&estimate.twist_covariance()),
        )),
        true_motion: None,
        error: None,
        estimator: estimator.into(),
    }))
}

fn image(view: Option<&pb::View>) -> Option<&[u8]> {
    match view?.view.as_ref()? {
        pb::view::View::Image(image) => Some(image),
        _ => None,
    }
}
