//! OdometryService.Track: frames in, answers out, in order.

mod sealed;
mod session;
mod token;
mod wire;

pub use token::TokenKey;

use std::pin::Pin;
use std::time::Instant;

use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::{Status, Streaming};
use tracing::Instrument;

use super::{Error, Handlers, Phase};
use crate::proto::v1 as pb;
use crate::proto::v1::track_request::Message;
use session::Session;

/// The answers of a stream.
pub type Answers = Pin<Box<dyn Stream<Item = Result<pb::TrackResponse, Status>> + Send>>;

/// Answers that may wait for a listener; behind them frames wait.
const UNREAD: usize = 32;

/// A message, when it came, and the frames that it overtook.
struct Came {
    since: Instant,
    message: Result<Message, Status>,
    overtaken: Option<Overtaken>,
}

/// Frames that a newer one overtook: the last of them, and how many they are.
#[derive(Debug, Clone, Copy)]
pub struct Overtaken {
    pub timestamp_ns: i64,
    pub sequence: u64,
    pub frames: u32,
}

impl Handlers {
    /// Answers a stream's messages until it ends, goes wrong, or the server is told to stop.
    pub(super) async fn follow(
        &self,
        mut requests: Streaming<pb::TrackRequest>,
    ) -> Result<Answers, Status> {
        let snapshot = self.snapshot()?;
        let first = tokio::time::timeout(self.config.longest, requests.message()).await;

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

        let place = self
            .streams
            .clone()
            .try_acquire_owned()
            .map_err(|_| Error::Busy)?;

        let key = self.config.token_key.clone();
        let session = self
            .workers
            .run(self.config.longest, move |_| {
                Session::open(&snapshot, config, &key)
            })
            .await?;

        // One waits here, one is read ahead; what is behind them waits with the sender.
        let (sender, frames) = mpsc::channel(1);
        let (answers, stream) = mpsc::channel(UNREAD);
        tokio::spawn(read(requests, sender, session.newest_wins()));
        let handlers = self.clone();

        let run = async move {
            let mut phase = handlers.phase.clone();
            tokio::select! {
                () = handlers.answer_all(session, frames, &answers) => {}
                () = told_to_stop(&mut phase) => {
                    // The token of the last answer goes on elsewhere. A listener that does not read
                    // is not waited for.
                    let _ = answers.try_send(Err(Error::Loading.into()));
                }
            }

            drop(place);
        };

        tokio::spawn(run.instrument(tracing::Span::current()));
        Ok(Box::pin(ReceiverStream::new(stream)))
    }

    async fn answer_all(
        &self,
        mut session: Session,
        mut frames: mpsc::Receiver<Came>,
        answers: &mpsc::Sender<Result<pb::TrackResponse, Status>>,
    ) {
        if answers.send(Ok(session.started())).await.is_err() {
            return;
        }

        while let Some(Came {
            since,
            message,
            overtaken,
        }) = frames.recv().await
        {
            if let Some(frames) = overtaken
                && answers.send(Ok(session.superseded(frames))).await.is_err()
            {
                return;
            }

            let answer = match message {
                Ok(message) => match self.handled(session, message, since).await {
                    Ok((back, answer)) => {
                        session = back;
                        answer.map_err(Status::from)
                    }
                    Err(error) => {
                        let _ = answers.send(Err(error.into())).await;
                        return;
                    }
                },
                Err(status) => Err(status),
            };

            let ends = answer.is_err();
            if answers.send(answer).await.is_err() || ends {
                return;
            }
        }
    }

    /// Handles a message on a blocking thread, which gives the session back.
    async fn handled(
        &self,
        mut session: Session,
        message: Message,
        since: Instant,
    ) -> Result<(Session, Result<pb::TrackResponse, Error>), Error> {
        self.workers
            .run_admitted(move || {
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

/// Completes once the server does not serve any more.
async fn told_to_stop(phase: &mut watch::Receiver<Phase>) {
    // An error means the server is gone. The guard that is returned must not live on.
    let _ = phase
        .wait_for(|phase| !matches!(phase, Phase::Serving(_)))
        .await
        .map(drop);
}

/// Reads messages as they come, one ahead; where the newest frame wins, further, as long as each
/// overtakes the one before. Ends with the stream, or when nobody asks for its messages any more.
async fn read(
    mut requests: Streaming<pb::TrackRequest>,
    sender: mpsc::Sender<Came>,
    newest_wins: bool,
) {
    let mut waiting: Option<Came> = None;
    loop {
        let may_read = waiting.is_none() || newest_wins;
        tokio::select! {
            biased;
            () = sender.closed() => return,
            permit = sender.reserve(), if waiting.is_some() => {
                let (Ok(permit), Some(came)) = (permit, waiting.take()) else { return };
                let ends = came.message.is_err();
                permit.send(came);
                if ends {
                    return;
                }
            }
            next = requests.next(), if may_read => {
                let Some(next) = next else {
                    if let Some(came) = waiting.take() {
                        // An error means that nobody asks any more.
                        let _ = sender.send(came).await;
                    }
                    return;
                };
                let mut came = Came { since: Instant::now(), message: message_of(next), overtaken: None };
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

/// Has a later frame take the place of one that waits; gives that one back when the other is none.
fn overtake(before: Came, came: &mut Came) -> Option<Came> {
    let (Ok(Message::Frame(old)), Ok(Message::Frame(new))) = (&before.message, &came.message)
    else {
        return Some(before);
    };

    if new.timestamp_ns <= old.timestamp_ns || new.sequence <= old.sequence {
        return Some(before);
    }

    let frames = before
        .overtaken
        .map_or(0, |overtaken| overtaken.frames)
        .saturating_add(1);
    came.overtaken = Some(Overtaken {
        timestamp_ns: old.timestamp_ns,
        sequence: old.sequence,
        frames,
    });

    None
}
