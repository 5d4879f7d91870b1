//! EvaluationService: Hit@ε of the server's navigators or of a client's predictions.

use std::pin::Pin;
use std::sync::Arc;

use tokio::sync::mpsc;
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::{Request, Response, Status};
use tracing::Instrument;

use super::convert;
use super::snapshot::{ServedNavigator, WantedPairs};
use super::workers::{CallContext, Lane};
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::evaluation_service_server::EvaluationService;
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{
    Leak, PredictionScope, Protocol, TrainedOn, evaluate, is_calibrated_in, score_predictions,
};

type Events = mpsc::Sender<Result<pb::EvaluateResponse, Status>>;

#[tonic::async_trait]
impl EvaluationService for Handlers {
    type EvaluateStream = Pin<Box<dyn Stream<Item = Result<pb::EvaluateResponse, Status>> + Send>>;

    async fn evaluate(
        &self,
        request: Request<pb::EvaluateRequest>,
    ) -> Result<Response<Self::EvaluateStream>, Status> {
        let snapshot = self.snapshot(&request)?;
        let context = self.workers.context(&request);
        let most_steps = self.config.limits.steps;
        let request = request.into_inner();
        let (served, protocol) = self
            .workers
            .run(Lane::Short, context.clone(), move |_| {
                protocol(&snapshot, request, most_steps)
            })
            .await?;

        // The evaluation runs in its own task; the caller gets the event stream at once.
        let (events, stream) = mpsc::channel(16);
        let run = self
            .clone()
            .run_evaluation(served, protocol, context, events);
        tokio::spawn(run.instrument(tracing::Span::current()));

        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }

    async fn score_predictions(
        &self,
        request: Request<pb::ScorePredictionsRequest>,
    ) -> Result<Response<pb::ScorePredictionsResponse>, Status> {
        let most = self.config.predictions;
        self.unary(
            request,
            |_, _| Lane::Long,
            move |snapshot, request, cancel| score(snapshot, request, most, cancel),
        )
        .await
    }
}

impl Handlers {
    /// Sends progress events, then the report or the error. Stops if the caller closes the stream.
    async fn run_evaluation(
        self,
        served: Arc<ServedNavigator>,
        protocol: Protocol,
        context: CallContext,
        events: Events,
    ) {
        let caller = events.clone();
        let total = protocol.navigators.len() as u32;

        let work = move |cancel: &Cancellation| {
            let report = evaluate(&served.navigator, &protocol, cancel, &mut |done, kind| {
                let progress = pb::EvaluationProgress {
                    done: done as u32,
                    total,
                    navigator: kind.name(),
                };
                let event = pb::evaluate_response::Event::Progress(progress);

                // A slow reader misses progress events: waiting would block a worker thread.
                let _ = events.try_send(Ok(pb::EvaluateResponse { event: Some(event) }));
            })?;

            Ok(report_to_wire(&served, &report))
        };

        // If the caller closes the stream, `run` is dropped, which cancels the computation.
        let finished = tokio::select! {
            finished = self.workers.run(Lane::Evaluation, context, work) => finished,
            () = caller.closed() => return,
        };

        if let Err(error) = &finished {
            tracing::warn!(grpc_status = i32::from(error.code()), %error, "the evaluation ended without a report");
        }

        let last = finished
            .map(|report| pb::EvaluateResponse {
                event: Some(pb::evaluate_response::Event::Report(report)),
            })
            .map_err(Status::from);

        // `send` fails if the caller closed the stream.
        let _ = caller.send(last).await;
    }
}

fn protocol(
    snapshot: &Snapshot,
    request: pb::EvaluateRequest,
    most_steps: u32,
) -> Result<(Arc<ServedNavigator>, Protocol), Error> {
    let pb::EvaluateRequest {
        room,
        adapter,
        stride,
        split,
        navigators,
        exclude_source,
        exclude_radius,
        thresholds,
        seed,
        steps,
        mode,
    } = request;

    // The defaults are the adapter's split and stride: its test pairs were held out in training.
    let split = convert::split(&split)?;
    let served = snapshot.evaluated(&room, &adapter, WantedPairs { split, stride })?;
    let record = &served.adapter.record;
    let split = split.unwrap_or(record.split);
    let stride = stride.unwrap_or(record.stride);

    let navigators = convert::navigators(&navigators)?;
    let protocol = Protocol {
        split,
        stride,
        exclude_source: convert::exclusion(exclude_source, exclude_radius)?,
        thresholds: convert::thresholds(thresholds)?,
        seed,
        steps: steps.unwrap_or(1),
        mode: convert::mode_of(mode)?,
        navigators,
    };

    if protocol.steps == 0 || protocol.steps > most_steps {
        return Err(Error::invalid(
            "steps",
            format!("must be 1 to {most_steps}, got {}", protocol.steps),
        ));
    }

    // Resolve the navigators before the stream begins: an invalid request is refused at once, and
    // progress events can state the total.
    let navigators = protocol.rows(&served.navigator)?;
    Ok((
        served,
        Protocol {
            navigators,
            ..protocol
        },
    ))
}

fn report_to_wire(
    served: &ServedNavigator,
    report: &seese3_core::eval::Report,
) -> pb::EvaluationReport {
    let record = &served.adapter.record;
    let in_room = served.trained_on != TrainedOn::Nothing;

    pb::EvaluationReport {
        room: Some(convert::room_revision(served)),
        adapter: Some(convert::adapter_revision(served)),
        split: report.protocol.split.name().to_owned(),
        stride: report.protocol.stride,
        n: report.n as u32,
        candidate_count: report.candidate_count as u32,
        source_excluded: report.protocol.exclude_source.is_some(),
        steps: report.protocol.steps,
        mode: convert::mode_to_wire(report.protocol.mode).into(),
        in_room,
        leaks: Leak::of(record, served.trained_on, report.protocol.split).is_some(),
        calibrated_here: is_calibrated_in(record, served.navigator.room().id()),
        navigators: report.rows.iter().map(convert::row_to_wire).collect(),
    }
}

fn is_latent(prediction: &pb::Prediction) -> bool {
    matches!(
        prediction.prediction,
        Some(pb::prediction::Prediction::Latent(_))
    )
}

fn score(
    snapshot: &Snapshot,
    request: pb::ScorePredictionsRequest,
    most: usize,
    cancel: &Cancellation,
) -> Result<pb::ScorePredictionsResponse, Error> {
    let pb::ScorePredictionsRequest {
        room,
        adapter,
        predictions,
        split,
        exclude_source,
        exclude_radius,
        thresholds,
    } = request;

    let split = convert::split(&split)?;
    let pairs = WantedPairs {
        split,
        stride: None,
    };
    let served = match snapshot.evaluated(&room, &adapter, pairs) {
        // No latent of an adapter is compared.
        Err(Error::Invalid { .. }) if !predictions.iter().any(is_latent) => {
            snapshot.navigator(&room, &adapter)?
        }
        served => served?,
    };

    if predictions.len() > most {
        let problem = format!(
            "needs 1 to {most} in one request, got {}",
            predictions.len()
        );
        return Err(Error::invalid("predictions", problem));
    }

    let scope = PredictionScope {
        split,
        exclude_source: convert::exclusion(exclude_source, exclude_radius)?,
        thresholds: convert::thresholds(thresholds)?,
    };

    // A conversion error names the position of the prediction. `score_predictions` refuses an empty
    // list.
    let predictions = predictions
        .into_iter()
        .enumerate()
        .map(|(position, given)| convert::prediction(position, given))
        .collect::<Result<Vec<_>, _>>()?;
    let row = score_predictions(&served.navigator, &predictions, &scope, cancel)?;

    // Without a split, every frame of the room is a candidate.
    let frame_count = served.navigator.room().frame_count();
    let candidate_count = scope.split.map_or(frame_count, |split| {
        split.candidates(served.navigator.room().timeline()).len()
    });

    Ok(pb::ScorePredictionsResponse {
        room: Some(convert::room_revision(&served)),
        adapter: Some(convert::adapter_revision(&served)),
        scores: Some(convert::row_to_wire(&row)),
        candidate_count: candidate_count as u32,
    })
}
