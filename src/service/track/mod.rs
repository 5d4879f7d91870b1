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

/// Frames that may wait in the server; behind them the sender waits.
const WAITING: usize = 32;
/// Answers that may wait for a listener; behind them frames wait.
const UNREAD: usize = 32;

/// A message and when it came.
type Came = (Instant, Result<Message, Status>);

impl Handlers {
    /// Answers a stream's messages until it ends, goes wrong, or the server is told to stop.
    pub(super) async fn follow(&self, mut requests: Streaming<pb::TrackRequest>) -> Result<Answers, Error> {
        let place = self.streams.clone().try_acquire_owned().map_err(|_| Error::Busy)?;
        let snapshot = self.snapshot()?;
        let config = match requests.message().await {
            Ok(Some(pb::TrackRequest { message: Some(Message::Config(config)) })) => config,
            Ok(_) => return Err(Error::invalid("config", "must be the first message of a stream")),
            Err(_) => return Err(Error::Cancelled),
        };
        let key = self.config.token_key.clone();
        let session = self.workers.run(self.config.longest, move |_| Session::open(&snapshot, config, &key)).await?;
        let (sender, frames) = mpsc::channel(WAITING);
        let (answers, stream) = mpsc::channel(UNREAD);
        tokio::spawn(read(requests, sender));
        let handlers = self.clone();
        let run = async move {
            handlers.answer_all(session, frames, answers).await;
            drop(place);
        };
        tokio::spawn(run.instrument(tracing::Span::current()));
        Ok(Box::pin(ReceiverStream::new(stream)))
    }

    async fn answer_all(
        &self,
        mut session: Session,
        mut frames: mpsc::Receiver<Came>,
        answers: mpsc::Sender<Result<pb::TrackResponse, Status>>,
    ) {
        let mut phase = self.phase.clone();
        if answers.send(Ok(session.started())).await.is_err() {
            return;
        }
        loop {
            let came = tokio::select! {
                came = frames.recv() => came,
                () = told_to_stop(&mut phase) => {
                    // The token of the last answer goes on elsewhere.
                    let _ = answers.send(Err(Error::Loading.into())).await;
                    return;
                }
            };
            let Some(first) = came else { return };
            let mut batch = vec![first];
            if session.newest_wins() {
                while let Ok(more) = frames.try_recv() {
                    batch.push(more);
                }
            }
            let overtaken: Vec<bool> =
                (0..batch.len()).map(|at| is_frame(&batch[at]) && batch.get(at + 1).is_some_and(is_frame)).collect();
            for ((since, message), overtaken) in batch.into_iter().zip(overtaken) {
                let answer = match message {
                    Ok(Message::Frame(frame)) if overtaken => Ok(session.superseded(&frame)),
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
                    Message::SetInitialPose(given) => session.put(given),
                    Message::Reset(_) => Ok(session.reset()),
                    Message::Config(_) => Err(Error::invalid("config", "may only be the first message of a stream")),
                };
                (session, answer)
            })
            .await
    }
}

/// Completes once the server does not serve any more.
async fn told_to_stop(phase: &mut watch::Receiver<Phase>) {
    // An error means the server is gone. The guard that is returned must not live on.
    let _ = phase.wait_for(|phase| !matches!(phase, Phase::Serving(_))).await.map(drop);
}

fn is_frame((_, message): &Came) -> bool {
    matches!(message, Ok(Message::Frame(_)))
}

/// Reads messages as they come; what is not read yet stays with the sender.
async fn read(mut requests: Streaming<pb::TrackRequest>, sender: mpsc::Sender<Came>) {
    while let Some(next) = requests.next().await {
        let message = match next {
            Ok(pb::TrackRequest { message: Some(message) }) => Ok(message),
            Ok(pb::TrackRequest { message: None }) => {
                Err(Error::invalid("message", "is required: a frame, set_initial_pose or reset").into())
            }
            Err(status) => Err(status),
        };
        let ends = message.is_err();
        if sender.send((Instant::now(), message)).await.is_err() || ends {
            return;
        }
    }
}
