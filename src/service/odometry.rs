//! OdometryService.

use tonic::{Request, Response, Status};

use super::convert;
use super::status::view_error;
use super::{Error, Handlers, Snapshot};
use crate::navigation::Source;
use crate::odometry::{View, motion};
use crate::proto::v1 as pb;
use crate::proto::v1::odometry_service_server::OdometryService;

#[tonic::async_trait]
impl OdometryService for Handlers {
    async fn estimate_motion(
        &self,
        request: Request<pb::EstimateMotionRequest>,
    ) -> Result<Response<pb::EstimateMotionResponse>, Status> {
        let snapshot = self.snapshot()?;
        let budget = self.workers.budget(request.metadata());
        let request = request.into_inner();
        let answer = self.workers.run(budget, move |_| answer(&snapshot, request)).await?;
        Ok(Response::new(answer))
    }
}

fn answer(snapshot: &Snapshot, request: pb::EstimateMotionRequest) -> Result<pb::EstimateMotionResponse, Error> {
    let pb::EstimateMotionRequest { adapter, room, first, second } = request;
    let served = if room.is_empty() { None } else { Some(snapshot.navigator(&room, &adapter)?) };
    let stored = match (served, adapter.as_str()) {
        (Some(served), _) => &served.adapter,
        (None, "") => match snapshot.adapters().len() {
            1 => snapshot.adapters().values().next().ok_or(Error::Internal)?,
            count => {
                let problem = format!("is required when no room is named: the server has {count} adapters");
                return Err(Error::invalid("adapter", problem));
            }
        },
        (None, name) => snapshot.adapter(name)?,
    };
    let view = |field: &str, given| -> Result<View, Error> {
        let view = match convert::source(given, stored.adapter.source()).map_err(|error| error.within(field))? {
            Source::Feature(feature) => View::Feature(feature),
            Source::Latent(latent) => View::Latent(latent),
            Source::Frame(frame) => {
                let served =
                    served.ok_or_else(|| Error::invalid("room", format!("is required: {field} is a frame")))?;
                let unknown = |_| Error::NotFound { field: format!("{field}.frame_id"), name: frame.to_string() };
                served.navigator.room().pose(frame).map_err(unknown)?;
                View::Latent(served.navigator.latents().row(frame.row()).to_vec())
            }
        };
        // Checked one by one, so that the error names the view it is about.
        view.latent(&stored.adapter).map_err(|error| view_error(&error).within(field))?;
        Ok(view)
    };
    let (first, second) = (view("first", first)?, view("second", second)?);
    let twist = motion(&stored.adapter, &first, &second).map_err(|_| Error::Internal)?;
    Ok(pb::EstimateMotionResponse {
        adapter: Some(pb::Revision { name: stored.name.clone(), revision: stored.revision }),
        motion: Some(convert::twist_to_wire(&twist)),
    })
}
