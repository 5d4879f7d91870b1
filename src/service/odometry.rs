//! OdometryService.

use tonic::{Request, Response, Status};

use super::convert;
use super::status::view_error;
use super::{Error, Handlers, Snapshot};
use crate::cancel::Cancellation;
use crate::geometry::{body_twist, exp};
use crate::navigation::{Source, StepError};
use crate::odometry::{View, motion};
use crate::proto::v1 as pb;
use crate::proto::v1::odometry_service_server::OdometryService;
use crate::room::FrameId;

#[tonic::async_trait]
impl OdometryService for Handlers {
    type TrackStream = super::track::Answers;

    async fn track(
        &self,
        request: Request<tonic::Streaming<pb::TrackRequest>>,
    ) -> Result<Response<Self::TrackStream>, Status> {
        Ok(Response::new(self.follow(request.into_inner()).await?))
    }

    async fn estimate_motion(
        &self,
        request: Request<pb::EstimateMotionRequest>,
    ) -> Result<Response<pb::EstimateMotionResponse>, Status> {
        let snapshot = self.snapshot()?;
        let budget = self.workers.budget(request.metadata());
        let request = request.into_inner();
        let answer = self
            .workers
            .run(budget, move |cancel| answer(&snapshot, request, cancel))
            .await?;

        Ok(Response::new(answer))
    }
}

fn answer(
    snapshot: &Snapshot,
    request: pb::EstimateMotionRequest,
    cancel: &Cancellation,
) -> Result<pb::EstimateMotionResponse, Error> {
    let pb::EstimateMotionRequest {
        adapter,
        room,
        first,
        second,
        thresholds,
    } = request;

    let thresholds = convert::thresholds(thresholds)?;

    let served = if room.is_empty() {
        None
    } else {
        Some(snapshot.navigator(&room, &adapter)?)
    };

    let stored = match (served, adapter.as_str()) {
        (Some(served), _) => &served.adapter,
        (None, "") => match snapshot.adapters().len() {
            1 => snapshot.adapters().values().next().ok_or(Error::Internal)?,
            count => {
                let problem =
                    format!("is required when no room is named: the server has {count} adapters");
                return Err(Error::invalid("adapter", problem));
            }
        },
        (None, name) => snapshot.adapter(name)?,
    };

    let frame_of =
        |given: &Option<pb::View>| match given.as_ref().and_then(|view| view.view.as_ref()) {
            Some(pb::view::View::FrameId(frame)) => Some(FrameId(*frame)),
            _ => None,
        };
    let frames = frame_of(&first).zip(frame_of(&second));

    let view = |field: &str, given| -> Result<View, Error> {
        cancel.check()?;

        let view = match convert::source(field, given, stored, snapshot)? {
            Source::Feature(feature) => View::Feature(feature),
            Source::Latent(latent) => View::Latent(latent),
            Source::Frame(frame) => {
                let served = served.ok_or_else(|| {
                    Error::invalid("room", format!("is required: {field} is a frame"))
                })?;

                let unknown = |_| Error::NotFound {
                    field: format!("{field}.frame_id"),
                    name: frame.to_string(),
                };
                served.navigator.room().pose(frame).map_err(unknown)?;

                View::Latent(served.navigator.latents().row(frame.row()).to_vec())
            }
        };

        // Checked one by one, so that the error names the view it is about.
        view.latent(&stored.adapter)
            .map_err(|error| view_error(&error).within(field))?;

        Ok(view)
    };

    let first = view("first", first)?;
    let second = view("second", second)?;
    let twist = motion(&stored.adapter, &first, &second).map_err(|_| Error::Internal)?;

    // Both frames have been looked up by now, so that their room and poses are there.
    let truth = served.zip(frames).and_then(|(served, (first, second))| {
        let poses = served.navigator.room().poses();
        Some((poses.get(first.row())?, poses.get(second.row())?))
    });

    Ok(pb::EstimateMotionResponse {
        true_motion: truth
            .map(|(first, second)| convert::twist_to_wire(&body_twist(first, second))),
        error: truth.map(|(first, second)| {
            convert::error_to_wire(
                &StepError::of(first, &(first * exp(&twist)), second),
                &thresholds,
            )
        }),
        adapter: Some(pb::Revision {
            name: stored.name.clone(),
            revision: stored.revision,
        }),
        motion: Some(convert::twist_to_wire(&twist)),
    })
}
