//! NavigationService: Navigate and BatchNavigate. PlanRoute is in `plan_route`.

use tonic::{Request, Response, Status};

use super::convert;
use super::cost::{check_batch, check_batch_pixels, frame_bytes, step_bytes, step_count};
use super::memory::hold_for_answer;
use super::snapshot::ServedNavigator;
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::navigation_service_server::NavigationService;
use seese3_core::cancel::Cancellation;
use seese3_core::navigation::Limits;

#[tonic::async_trait]
impl NavigationService for Handlers {
    async fn navigate(
        &self,
        request: Request<pb::NavigateRequest>,
    ) -> Result<Response<pb::NavigateResponse>, Status> {
        let limits = self.config.limits;
        let response = self
            .unary(
                request,
                |costs, request| costs.navigate(request),
                move |snapshot, request, cancel| navigate(snapshot, request, limits, cancel),
            )
            .await?;

        let steps = response.get_ref().steps.iter();
        for frame in steps.filter_map(|step| step.frames.first()) {
            self.config.metrics.retrieved(frame.distance);
        }

        Ok(response)
    }

    async fn plan_route(
        &self,
        request: Request<pb::PlanRouteRequest>,
    ) -> Result<Response<pb::Route>, Status> {
        self.planned_route(request).await
    }

    async fn batch_navigate(
        &self,
        request: Request<pb::BatchNavigateRequest>,
    ) -> Result<Response<pb::BatchNavigateResponse>, Status> {
        let limits = self.config.limits;
        let most = self.config.batch;
        self.unary(
            request,
            |costs, batch| costs.batch_navigate(&batch.requests),
            move |snapshot, request, cancel| {
                check_batch(request.requests.iter().map(frames_requested), most, limits)?;
                let sources = request.requests.iter();
                let sources = sources.filter_map(|request| request.source.as_ref());
                check_batch_pixels(snapshot, sources)?;
                answer_batch(snapshot, request, limits, cancel)
            },
        )
        .await
    }
}

/// Upper bound of the encoded size of an answer, bytes. A request over the limits is refused, so
/// they bound it too.
fn answer_bytes(served: &ServedNavigator, request: &pb::NavigateRequest, limits: Limits) -> usize {
    let steps = step_count(request).min(u64::from(limits.steps)) as usize;
    let frames = frames_requested(request).min(limits.frames_in_answer) as usize;
    let room = served.navigator.room();

    let latent_dim = served.adapter.adapter.latent_dim();
    let of_frames = frames.saturating_mul(frame_bytes(room));
    of_frames.saturating_add(steps.saturating_mul(step_bytes(latent_dim, &served.adapter.name)))
}

fn answer_batch(
    snapshot: &Snapshot,
    batch: pb::BatchNavigateRequest,
    limits: Limits,
    cancel: &Cancellation,
) -> Result<pb::BatchNavigateResponse, Error> {
    let mut results = Vec::with_capacity(batch.requests.len());
    for request in batch.requests {
        cancel.check()?;

        let result = match navigate(snapshot, request, limits, cancel) {
            Ok(response) => pb::batch_navigate_result::Result::Response(response),
            // Cancellation ends the batch; any other error fails only its own request.
            Err(Error::Cancelled) => return Err(Error::Cancelled),
            Err(error) => pb::batch_navigate_result::Result::Error(error.into()),
        };
        results.push(pb::BatchNavigateResult {
            result: Some(result),
        });
    }

    Ok(pb::BatchNavigateResponse { results })
}

/// Number of frames that a request asks for: motions × steps × top_k. Used only for the batch
/// limit; each request is validated when it is answered.
fn frames_requested(request: &pb::NavigateRequest) -> u64 {
    step_count(request).saturating_mul(u64::from(request.top_k.unwrap_or(1)))
}

fn navigate(
    snapshot: &Snapshot,
    request: pb::NavigateRequest,
    limits: Limits,
    cancel: &Cancellation,
) -> Result<pb::NavigateResponse, Error> {
    let adapter = convert::stated_adapter(&request.adapter, &request.source)?;
    let served = snapshot.navigator(&request.room, adapter)?;
    hold_for_answer(answer_bytes(&served, &request, limits))?;
    let query = convert::query(request, &served.adapter, snapshot)?;
    let answer = served.navigator.answer(&query, limits, cancel)?;

    // The answer states the step mode, variant and navigator in effect, including defaults. An
    // index without an audit is the exact scan.
    let room = served.navigator.room();
    let adapter = convert::adapter_revision(&served);

    Ok(pb::NavigateResponse {
        room: Some(convert::room_revision(&served)),
        steps: (1..)
            .zip(&answer.steps)
            .map(|(number, step)| convert::step_to_wire(number, step, room, &adapter))
            .collect(),
        adapter: Some(adapter.clone()),
        step_mode: convert::mode_to_wire(query.mode).into(),
        inverse_variant: convert::variant_to_wire(query.method).into(),
        navigator: convert::navigator_to_wire(&query),
        motion: answer.motion.map(|twist| convert::twist_to_wire(&twist)),
        exact: served.navigator.audit().is_none(),
        index: served.navigator.index_kind().name().to_owned(),
    })
}
