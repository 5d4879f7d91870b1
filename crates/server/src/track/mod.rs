//! OdometryService.Track: receives a stream of frames and answers each in order.
//!
//! Two tasks serve a stream. `read` receives messages and, with `BACK_PRESSURE_NEWEST`, drops
//! waiting frames that a newer frame supersedes. `answer_all` passes each message to the
//! [`Session`] on a worker thread.

mod configuration;
mod depth;
mod engine;
mod inertial;
mod keypoints;
mod rooms;
mod sealed;
mod sensors;
mod session;
mod token;
mod wire;

pub use token::TokenKey;

use std::pin::Pin;
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Status, Streaming};
use tracing::Instrument;

use super::auth::{Keyring, Principal};
use super::caller::CallerId;
use super::memory::StreamMemory;
use super::shares::{Exhausted, Share};

use super::status::Full;
use super::workers::{CallContext, Lane};
use super::{Error, Handlers, Phase, principal};
use inertial::MOST_SAMPLES;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::track_request::Message;
use seese3_client::proto::v1::track_response::Answer;
use session::Session;

/// Stream of answers.
pub type Answers = Pin<Box<dyn Stream<Item = Result<pb::TrackResponse, Status>> + Send>>;

/// Capacity of the answer channel. When a slow reader leaves it full, no frames are processed.
const UNREAD: usize = 32;

/// A message, its arrival time, and the frames that it superseded.
struct Incoming {
    since: Instant,
    message: Result<Message, Status>,
    /// Memory of the message, held until it is answered.
    memory: Option<Share>,
    overtaken: Option<Overtaken>,
}

/// Frames dropped because a newer one arrived before they were processed: their number, and the
/// timestamp and sequence of the last one.
#[derive(Debug, Clone, Copy)]
pub struct Overtaken {
    pub timestamp_ns: i64,
    pub sequence_number: u64,
    pub frames: u32,
}

impl Handlers {
    /// A place among the open streams.
    fn stream_place(&self, caller: &CallerId) -> Result<Share, Error> {
        let place = self.streams.take(caller.clone(), 1);
        place.map_err(|limit| {
            self.workers.full(match limit {
                Exhausted::Budget => Full::Streams,
                Exhausted::Share => Full::CallersStreams,
            })
        })
    }

    /// Opens a stream and answers its messages until the caller ends it, an error occurs, or the
    /// server stops.
    ///
    /// # Errors
    /// [`Error::Loading`] if the server is not serving, [`Error::Deadline`] if the configuration
    /// does not arrive in time, [`Error::Invalid`] if the first message is not a configuration,
    /// [`Error::Full`] if too many streams are open, or as [`Session::open`].
    pub(super) async fn follow(
        &self,
        request: Request<Streaming<pb::TrackRequest>>,
    ) -> Result<Answers, Status> {
        let snapshot = self.snapshot(&request)?;
        let caller = principal(&request).cloned();
        let context = CallContext {
            budget: self.config.longest,
            ..self.workers.context(&request)
        };
        let memory = request.extensions().get().cloned().unwrap_or_default();
        let mut requests = request.into_inner();

        // A stream has no deadline, but its configuration must arrive in time: streams without one
        // must not stay open forever.
        let mut phase = self.phase.clone();
        let first = tokio::select! {
            first = tokio::time::timeout(self.config.longest, requests.message()) => first,
            () = shutdown_requested(&mut phase) => return Err(Error::Loading.into()),
        };

        let config = match first.map_err(|_| Error::Deadline)?? {
            Some(pb::TrackRequest {
                message: Some(Message::Config(config)),
            }) => config,
            _ => {
                return Err(
                    Error::invalid("config", "must be the first message of a stream").into(),
                );
            }
        };

        // The stream holds this permit while it is open. It bounds the number of streams, whose
        // frames are never refused for a full queue.
        let place = self.stream_place(&context.caller)?;

        let callers_place = match &caller {
            None => None,
            Some(caller) => Some(
                caller
                    .stream_place()
                    .ok_or_else(|| self.workers.full(Full::CallersStreams))?,
            ),
        };

        let key = self.config.token_key.clone();
        let session = self
            .workers
            .run(Lane::Short, context.clone(), move |_| {
                Session::open(&snapshot, config, &key)
            })
            .await?;

        // One message waits in this channel and `read` holds another one. Later messages stay
        // unread, so that flow control makes the sender wait.
        let (sender, frames) = mpsc::channel(1);
        let (answers, stream) = mpsc::channel(UNREAD);
        let newest_wins = session.newest_wins();
        tokio::spawn(read(Messages { requests, memory }, sender, newest_wins));
        let handlers = self.clone();

        let run = async move {
            let mut phase = handlers.phase.clone();
            tokio::select! {
                () = handlers.answer_all(context.caller, session, frames, &answers) => {}
                () = revoked(handlers.config.keyring.as_ref(), caller.as_ref()) => {
                    let revoked = Error::Unauthenticated {
                        problem: "the caller's rights have changed, or its token has expired; open \
                                  the stream again",
                    };
                    let _ = answers.try_send(Err(revoked.into()));
                }
                () = shutdown_requested(&mut phase) => {
                    // The caller can resume on another server with its last token. Do not wait for
                    // a slow reader to take this error.
                    let _ = answers.try_send(Err(Error::Loading.into()));
                }
            }

            drop((place, callers_place));
        };

        tokio::spawn(run.instrument(tracing::Span::current()));
        Ok(Box::pin(ReceiverStream::new(stream)))
    }

    async fn answer_all(
        &self,
        caller: CallerId,
        mut session: Session,
        mut frames: mpsc::Receiver<Incoming>,
        answers: &mpsc::Sender<Result<pb::TrackResponse, Status>>,
    ) {
        // The first answer confirms the configuration.
        if answers.send(Ok(session.started())).await.is_err() {
            return;
        }

        while let Some(Incoming {
            since,
            message,
            memory,
            overtaken,
        }) = frames.recv().await
        {
            // One refusal counts all superseded frames, so that every frame is accounted for.
            if let Some(frames) = overtaken
                && answers.send(Ok(session.superseded(frames))).await.is_err()
            {
                return;
            }

            // A refused frame is a normal answer. An error ends the stream and is its last item.
            let answer = match message {
                Ok(message) => match self.handled(&caller, session, message, since).await {
                    Ok((back, answer)) => {
                        session = back;
                        if let Some(outcome) = answer.as_ref().ok().and_then(outcome) {
                            self.config.metrics.frame_answered(outcome, since.elapsed());
                        }
                        answer.map_err(Status::from)
                    }
                    Err(error) => {
                        let _ = answers.send(Err(error.into())).await;
                        return;
                    }
                },
                Err(status) => Err(status),
            };

            drop(memory);
            let ends = answer.is_err();
            if answers.send(answer).await.is_err() || ends {
                return;
            }
        }
    }

    /// Handles one message on a worker thread. The session moves to that thread and is returned
    /// with the answer.
    ///
    /// # Errors
    /// The outer error means that the session is lost, because the work panicked or the server is
    /// stopping. The inner error is the answer to the message.
    async fn handled(
        &self,
        caller: &CallerId,
        mut session: Session,
        message: Message,
        since: Instant,
    ) -> Result<(Session, Result<pb::TrackResponse, Error>), Error> {
        let lane = match &message {
            Message::Frame(frame) => {
                let others = frame
                    .other_views
                    .iter()
                    .filter_map(|other| other.view.as_ref());
                match Lane::of(frame.view.iter().chain(others)) {
                    Lane::Short => session.lane(),
                    lane => lane,
                }
            }
            _ => Lane::Short,
        };
        self.workers
            .run_frame(lane, caller.clone(), move || {
                let answer = match message {
                    Message::Frame(frame) => session.take(frame, since.elapsed()),
                    Message::SetInitialPose(given) => Ok(session.put(given)),
                    Message::Reset(_) => Ok(session.reset()),
                    Message::Config(_) => Err(Error::invalid(
                        "config",
                        "may only be the first message of a stream",
                    )),
                };

                (session, answer)
            })
            .await
    }
}

/// Metrics label of an answer: the tracking status or the refusal reason; `None` for answers
/// without either.
fn outcome(answer: &pb::TrackResponse) -> Option<&'static str> {
    match answer.answer.as_ref()? {
        Answer::Update(update) => Some(update.status().as_str_name()),
        Answer::Refusal(refusal) => Some(refusal.reason().as_str_name()),
        Answer::Started(_) | Answer::Acknowledged(_) => None,
    }
}

/// Completes when the caller's rights have changed since the stream was opened.
async fn revoked(keyring: Option<&Arc<Keyring>>, caller: Option<&Arc<Principal>>) {
    match (keyring, caller) {
        (Some(keyring), Some(caller)) => keyring.revoked(caller).await,
        _ => std::future::pending().await,
    }
}

/// Completes when the server is no longer serving.
async fn shutdown_requested(phase: &mut watch::Receiver<Phase>) {
    // `wait_for` fails if the server has ended. Drop its guard at once: it blocks `run` from
    // changing the phase.
    let _ = phase
        .wait_for(|phase| !matches!(phase, Phase::Serving(_)))
        .await
        .map(drop);
}

/// Reads messages as they arrive and passes them to `sender`, holding at most one. With
/// `newest_wins` it continues to read while a message waits, and a newer frame replaces a waiting
/// frame. Ends at the end of the stream, at its first error, or when the receiver is closed.
async fn read(mut messages: Messages, sender: mpsc::Sender<Incoming>, newest_wins: bool) {
    let mut waiting: Option<Incoming> = None;
    loop {
        let may_read = waiting.is_none() || newest_wins;
        tokio::select! {
            // Polled in this order: pass on a waiting message before reading the next one, so that
            // no frame is dropped needlessly.
            biased;
            () = sender.closed() => return,
            permit = sender.reserve(), if waiting.is_some() => {
                let (Ok(permit), Some(came)) = (permit, waiting.take()) else { return };
                let ends = came.message.is_err();
                permit.send(came);

                // Stop reading after an error: a transport error or an empty message.
                if ends {
                    return;
                }
            }
            next = messages.next(), if may_read => {
                let Some((next, memory)) = next else {
                    if let Some(came) = waiting.take() {
                        // `send` fails if the receiver is closed.
                        let _ = sender.send(came).await;
                    }
                    return;
                };
                let mut came = Incoming {
                    since: Instant::now(),
                    message: message_of(next),
                    memory,
                    overtaken: None,
                };
                if let Some(before) = waiting.take()
                    && let Some(before) = overtake(before, &mut came)
                    && sender.send(before).await.is_err()
                {
                    return;
                }
                waiting = Some(came);
            }
        }
    }
}

/// The messages of a stream with their memory.
struct Messages {
    requests: Streaming<pb::TrackRequest>,
    memory: StreamMemory,
}

impl Messages {
    /// The next message, and the memory to hold as long as it.
    async fn next(&mut self) -> Option<(Result<pb::TrackRequest, Status>, Option<Share>)> {
        let next = self.requests.next().await?;
        Some((next, self.memory.take()))
    }
}

fn message_of(next: Result<pb::TrackRequest, Status>) -> Result<Message, Status> {
    match next? {
        pb::TrackRequest {
            message: Some(message),
        } => Ok(message),
        pb::TrackRequest { message: None } => {
            Err(Error::invalid("message", "is required: a frame, set_initial_pose or reset").into())
        }
    }
}

/// Replaces the waiting frame `before` by the newer frame `came`, which then counts it as
/// superseded, and takes its inertial samples. Returns `before` if it needs its own answer: if
/// either message is not a frame, or `came` is not later in both time and sequence.
fn overtake(mut before: Incoming, came: &mut Incoming) -> Option<Incoming> {
    let (Ok(Message::Frame(old)), Ok(Message::Frame(new))) =
        (&mut before.message, &mut came.message)
    else {
        return Some(before);
    };

    // Late and duplicate frames must not replace a valid one; the tracker refuses each of them.
    if new.timestamp_ns <= old.timestamp_ns || new.sequence_number <= old.sequence_number {
        return Some(before);
    }

    let mut samples = std::mem::take(&mut old.inertial_samples);
    let first_ns = new.inertial_samples.first().map(|first| first.timestamp_ns);
    samples.retain(|sample| first_ns.is_none_or(|first_ns| sample.timestamp_ns < first_ns));
    samples.append(&mut new.inertial_samples);
    samples.drain(..samples.len().saturating_sub(MOST_SAMPLES));
    new.inertial_samples = samples;

    let frames = before
        .overtaken
        .map_or(0, |overtaken| overtaken.frames)
        .saturating_add(1);
    came.overtaken = Some(Overtaken {
        timestamp_ns: old.timestamp_ns,
        sequence_number: old.sequence_number,
        frames,
    });

    None
}
