//! EvaluationService: Hit@ε of the server's navigators or of a client's predictions.

use std::collections::HashSet;
use std::pin::Pin;
use std::sync::Arc;

use tokio::sync::mpsc;
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::{Request, Response, Status};
use tracing::Instrument;

use super::convert;
use super::memory::hold_for_answer;
use super::snapshot::{ServedNavigator, WantedPairs};
use super::stated_revisions::StatesRevisions;
use super::workers::{CallContext, Lane};
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::evaluation_service_server::EvaluationService;
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{
    Leak, PredictionScope, Protocol, TrainedOn, evaluate, is_calibrated_in, score_predictions,
};
use seese3_core::navigation::SHORTLIST;
use seese3_core::splits::{Pair, Split};

type Events = mpsc::Sender<Result<pb::EvaluateResponse, Status>>;

#[tonic::async_trait]
impl EvaluationService for Handlers {
    type EvaluateStream = Pin<Box<dyn Stream<Item = Result<pb::EvaluateResponse, Status>> + Send>>;

    async fn evaluate(
        &self,
        request: Request<pb::EvaluateRequest>,
    ) -> Result<Response<Self::EvaluateStream>, Status> {
        let snapshot = self.snapshot(&request)?;
        let stated = request.get_ref().stated_revisions()?;
        let context = self.workers.context(&request);
        let most_steps = self.config.limits.steps;
        let request = request.into_inner();
        let (served, protocol) = self
            .workers
            .run(Lane::Short, context.clone(), move |_| {
                let snapshot = snapshot.with_revisions(&stated)?;
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

    async fn list_pairs(
        &self,
        request: Request<pb::ListPairsRequest>,
    ) -> Result<Response<pb::ListPairsResponse>, Status> {
        self.unary(
            request,
            |costs, request| costs.list_pairs(&request.room),
            move |snapshot, request, _| list_pairs(snapshot, request),
        )
        .await
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

            Ok(report_to_wire(&served, report))
        };

        // If the caller closes the stream, `run` is dropped, which cancels the computation.
        let finished = tokio::select! {
            finished = self.workers.run(Lane::Evaluation, context, work) => finished,
            () = caller.closed() => return,
        };

        if let Err(error) = &finished {
            let grpc_status = i32::from(error.code());
            if matches!(error, Error::Internal) {
                tracing::warn!(grpc_status, %error, "the evaluation ended without a report");
            } else {
                tracing::info!(grpc_status, %error, "the evaluation ended without a report");
            }
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
        room_revision: _,
        adapter,
        adapter_revision: _,
        stride,
        split,
        navigators,
        exclude_source,
        exclude_radius,
        thresholds,
        seed,
        steps,
        step_mode,
    } = request;

    // The defaults are the adapter's split and stride: its test pairs were held out in training.
    let split = convert::split(split)?;
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
        mode: convert::mode_of(step_mode)?,
        shortlist: SHORTLIST,
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
    report: seese3_core::eval::Report,
) -> pb::EvaluationReport {
    let record = &served.adapter.record;
    let calibrated_here = is_calibrated_in(record, served.navigator.room().id());
    let leak = Leak::of(record, served.trained_on, report.protocol.split);
    let report = report.marked(leak, calibrated_here);
    let in_room = served.trained_on != TrainedOn::Nothing;

    pb::EvaluationReport {
        room: Some(convert::room_revision(served)),
        adapter: Some(convert::adapter_revision(served)),
        split: convert::split_to_wire(report.protocol.split).into(),
        stride: report.protocol.stride,
        pair_count: report.n as u32,
        candidate_count: report.candidate_count as u32,
        exclude_source: report.protocol.exclude_source.is_some(),
        exclude_radius: report.protocol.exclude_source.unwrap_or_default(),
        seed: report.protocol.seed,
        steps: report.protocol.steps,
        step_mode: convert::mode_to_wire(report.protocol.mode).into(),
        in_room,
        leaks: leak.is_some(),
        calibrated_here,
        navigators: report.rows.iter().map(convert::row_to_wire).collect(),
    }
}

fn list_pairs(
    snapshot: &Snapshot,
    request: pb::ListPairsRequest,
) -> Result<pb::ListPairsResponse, Error> {
    /// Upper bound of the encoded size of a frame's row with its tag, bytes.
    const ROW_BYTES: usize = 7;

    let pb::ListPairsRequest {
        room,
        room_revision: _,
        split,
        stride,
        adapter,
        adapter_revision: _,
    } = request;

    let split = convert::split(split)?;
    let (split, stride) = match split.zip(stride) {
        Some(stated) => stated,
        None => {
            let pairs = WantedPairs { split, stride };
            let served = snapshot.evaluated(&room, &adapter, pairs)?;
            let record = &served.adapter.record;
            (
                split.unwrap_or(record.split),
                stride.unwrap_or(record.stride),
            )
        }
    };

    let served = snapshot.room(&room)?;
    let loaded = served.load()?;
    let timeline = loaded.room.timeline();
    // Each frame is at most twice in the test pairs, twice in the training pairs and once a
    // candidate.
    hold_for_answer(5 * ROW_BYTES * loaded.room.frame_count())?;
    let test = split.test_pairs(timeline, stride);
    let test = test.map_err(|error| Error::invalid("stride", error))?;
    let training = split.train_pairs(timeline, stride);
    // A split without training pairs can still be tested.
    let training = training.unwrap_or_default();

    let pairs_to_wire = |pairs: &[Pair]| {
        let pairs = pairs.iter().map(|pair| pb::FramePair {
            source_frame_id: pair.source.0,
            target_frame_id: pair.target.0,
        });
        pairs.collect()
    };
    let candidates = split.candidates(timeline);
    Ok(pb::ListPairsResponse {
        room: Some(convert::served_revision(served)),
        split: convert::split_to_wire(split).into(),
        stride,
        test_pairs: pairs_to_wire(&test),
        training_pairs: pairs_to_wire(&training),
        candidate_frame_ids: candidates.iter().map(|frame| frame.0).collect(),
    })
}

fn latent_of(given: &pb::Prediction) -> Option<&pb::Latent> {
    match &given.prediction {
        Some(pb::prediction::Prediction::Latent(latent)) => Some(latent),
        _ => None,
    }
}

fn score(
    snapshot: &Snapshot,
    request: pb::ScorePredictionsRequest,
    most: usize,
    cancel: &Cancellation,
) -> Result<pb::ScorePredictionsResponse, Error> {
    let pb::ScorePredictionsRequest {
        room,
        room_revision: _,
        adapter,
        adapter_revision: _,
        predictions,
        split,
        exclude_source,
        exclude_radius,
        thresholds,
    } = request;

    let split = convert::split(split)?;
    let pairs = WantedPairs {
        split,
        stride: None,
    };
    let adapter = convert::adapter_of_latents(&adapter, predictions.iter().filter_map(latent_of))?;
    let has_latents = predictions.iter().any(|given| latent_of(given).is_some());
    let served = match snapshot.evaluated(&room, adapter, pairs) {
        // No latent of an adapter is compared.
        Err(Error::Invalid { .. }) if !has_latents => snapshot.navigator(&room, adapter)?,
        served => served?,
    };

    if predictions.len() > most {
        let problem = format!(
            "needs 1 to {most} in one request, got {}",
            predictions.len()
        );
        return Err(Error::invalid("predictions", problem));
    }

    let mut pairs = HashSet::new();
    for (position, given) in predictions.iter().enumerate() {
        if !pairs.insert((given.source_frame_id, given.target_frame_id)) {
            let problem = format!(
                "is of the pair ({}, {}), which is predicted twice",
                given.source_frame_id, given.target_frame_id
            );
            return Err(Error::invalid(format!("predictions[{position}]"), problem));
        }
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
        .map(|(position, given)| convert::prediction(position, given, &served.adapter))
        .collect::<Result<Vec<_>, _>>()?;
    let mut row = score_predictions(&served.navigator, &predictions, &scope, cancel)?;
    // Without a split, any pair may be one of the training.
    let split = scope.split.unwrap_or(Split::Whole);
    let leak = Leak::of(&served.adapter.record, served.trained_on, split);
    row.leaks = has_latents && leak.is_some();

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
        leaks: row.leaks,
    })
}
