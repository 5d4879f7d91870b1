//! Computes answers on a bounded number of blocking threads, within the caller's deadline. Brief work is done
//! on the thread that received the request: to wake another one takes longer.
//!
//! - Each [`Lane`] has its own threads and queue: short requests, images, long requests,
//!   evaluations and fits. Within a lane, callers share the time of the threads.
//! - A job that runs longer than a time slice is paused where it checks for cancellation, while
//!   other jobs of its lane wait.
//!
//! | file | what |
//! | --- | --- |
//! | `fair_queue` | chooses the next job |
//! | `pool` | the threads of a lane |

mod fair_queue;
mod pool;

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::Duration;

use tokio::runtime::{Handle, RuntimeFlavor};
use tokio::sync::watch;
use tonic::Request;
use tonic::metadata::MetadataMap;

use super::caller::CallerId;
use super::metrics::Metrics;
use super::shares::Exhausted;
use super::status::Full;
use super::{Config, Error};
use fair_queue::Urgency;
pub use pool::off_the_lane;
use pool::{Pool, Turn, pause_if_others_wait};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;

/// Kind of work, which selects the threads and the queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// Work of about a tenth of a millisecond that does not wait. It is done in place if a thread of the lane
    /// for short work is free, and is short work otherwise.
    Brief,
    /// Work of at most milliseconds, for instance in a robot's control loop.
    Short,
    /// Requests with one image or two, and frames of streams with images.
    Images,
    /// Batches, lists of images, and other requests with a large estimated cost.
    Long,
    /// Evaluations: minutes of work.
    Evaluation,
    /// Fits, one at a time: a fit uses all processors.
    Fit,
}

impl Lane {
    /// [`Lane::Images`] if any of these views is an image, else [`Lane::Short`].
    pub fn of<'a>(views: impl IntoIterator<Item = &'a pb::View>) -> Self {
        match image_count(views) {
            0 => Self::Short,
            _ => Self::Images,
        }
    }

    /// The limit of this lane.
    fn full(self) -> Full {
        match self {
            Self::Brief | Self::Short => Full::ShortRequests,
            Self::Images => Full::Images,
            Self::Long => Full::LongRequests,
            Self::Evaluation => Full::Evaluations,
            Self::Fit => Full::Fits,
        }
    }
}

/// The number of images among views.
pub fn image_count<'a>(views: impl IntoIterator<Item = &'a pb::View>) -> usize {
    images_of(views).count()
}

/// The images among views.
pub fn images_of<'a>(
    views: impl IntoIterator<Item = &'a pb::View>,
) -> impl Iterator<Item = &'a [u8]> {
    views.into_iter().filter_map(|view| match &view.view {
        Some(pb::view::View::Image(image)) => Some(image.as_slice()),
        _ => None,
    })
}

/// The caller of a computation and its time budget.
#[derive(Debug, Clone)]
pub struct CallContext {
    /// The caller that is charged for the worker time.
    pub caller: CallerId,
    /// The time budget of the call, including time in the queue.
    pub budget: Duration,
}

/// Runs computations on blocking threads, separate from the async threads.
#[derive(Clone)]
pub struct Workers {
    short: Pool,
    images: Pool,
    long: Pool,
    evaluation: Pool,
    fit: Pool,
    longest: Duration,
    halted: watch::Sender<bool>,
    metrics: Metrics,
}

/// Cancels the work when dropped, that is, when nothing waits for the result any more.
pub struct CancelOnDrop(pub Arc<Cancellation>);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

impl Workers {
    pub fn new(config: &Config) -> Self {
        let threads = config.threads.max(1);
        let pool = |threads| Pool::new(threads, config.queue);
        // Long work gets half as many threads.
        let half = threads.div_ceil(2);
        Self {
            short: pool(threads),
            images: pool(threads),
            long: pool(half),
            evaluation: pool(half),
            fit: pool(1),
            longest: config.longest,
            halted: watch::Sender::new(false),
            metrics: config.metrics.clone(),
        }
    }

    fn pool(&self, lane: Lane) -> &Pool {
        match lane {
            Lane::Brief | Lane::Short => &self.short,
            Lane::Images => &self.images,
            Lane::Long => &self.long,
            Lane::Evaluation => &self.evaluation,
            Lane::Fit => &self.fit,
        }
    }

    /// The error for the reached limit `what`; also counts the refusal.
    pub fn full(&self, what: Full) -> Error {
        self.metrics.shed(what);
        Error::Full { what }
    }

    /// Abandons all running and queued work. The callers get [`Error::Loading`] (UNAVAILABLE).
    pub fn halt(&self) {
        self.halted.send_replace(true);
    }

    /// Time budget of a request: the caller's deadline, at most the server's limit.
    pub fn budget(&self, metadata: &MetadataMap) -> Duration {
        caller_deadline(metadata).map_or(self.longest, |deadline| deadline.min(self.longest))
    }

    /// The context of a request's computation.
    pub fn context<T>(&self, request: &Request<T>) -> CallContext {
        CallContext {
            caller: CallerId::of(request.extensions()),
            budget: self.budget(request.metadata()),
        }
    }

    /// Runs `work` on a blocking thread. If the budget is spent or the caller goes away, `work` is
    /// cancelled through its [`Cancellation`]. Its thread becomes free when `work` returns.
    ///
    /// # Errors
    /// [`Error::Full`] if the lane's queue or the caller's share of it is full,
    /// [`Error::Deadline`] if the budget is spent, [`Error::Loading`] if the stopping server
    /// abandoned the work, [`Error::Internal`] if it panicked, or the error of `work`.
    pub async fn run<T: Send + 'static>(
        &self,
        lane: Lane,
        context: CallContext,
        work: impl FnOnce(&Cancellation) -> Result<T, Error> + Send + 'static,
    ) -> Result<T, Error> {
        if let Some(turn) = self.turn_in_place(lane, &context.caller) {
            return self.in_place(turn, || work(&Cancellation::default()))?;
        }

        // If the caller goes away, this future is dropped and the guard cancels the running work.
        let cancel = Arc::new(Cancellation::with_checkpoint(pause_if_others_wait));
        let guard = CancelOnDrop(cancel.clone());
        let computed = self.on_thread(lane, context.caller, Urgency::Request, move || {
            work(&cancel)
        });

        // The budget includes the time in the queue.
        let result = tokio::time::timeout(context.budget, computed).await;
        drop(guard);
        result.unwrap_or(Err(Error::Deadline))?
    }

    /// Runs the work of a frame of a stream on a blocking thread. It waits for a thread without
    /// limit, is never refused, and is not cancelled.
    ///
    /// # Errors
    /// [`Error::Loading`] if the stopping server abandoned the work, [`Error::Internal`] if it
    /// panicked.
    pub async fn run_frame<T: Send + 'static>(
        &self,
        lane: Lane,
        caller: CallerId,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Error> {
        if let Some(turn) = self.turn_in_place(lane, &caller) {
            return self.in_place(turn, work);
        }

        // Dropping the future only discards the result.
        self.on_thread(lane, caller, Urgency::Frame, work).await
    }

    /// The right to do brief work in place.
    fn turn_in_place(&self, lane: Lane, caller: &CallerId) -> Option<Turn> {
        // Another runtime has one thread, which must never wait.
        let is_allowed = Handle::current().runtime_flavor() == RuntimeFlavor::MultiThread;
        (lane == Lane::Brief && is_allowed)
            .then(|| self.pool(lane).turn_now(caller))
            .flatten()
    }

    fn in_place<T>(&self, turn: Turn, work: impl FnOnce() -> T) -> Result<T, Error> {
        if *self.halted.borrow() {
            return Err(Error::Loading);
        }

        // Unwind safe: what the work has changed is dropped with it.
        let work = AssertUnwindSafe(|| turn.run_in_place(work));
        std::panic::catch_unwind(work).map_err(|_| {
            tracing::error!("a request panicked");
            Error::Internal
        })
    }

    /// Runs `work` on a blocking thread of the lane as soon as it is the caller's turn.
    async fn on_thread<T: Send + 'static>(
        &self,
        lane: Lane,
        caller: CallerId,
        urgency: Urgency,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Error> {
        let mut halted = self.halted.subscribe();
        let computed = async {
            let turn = self.pool(lane).turn(&caller, urgency).await;
            let turn = turn.map_err(|limit| {
                self.full(match limit {
                    Exhausted::Budget => lane.full(),
                    Exhausted::Share => Full::CallersQueue,
                })
            })?;

            // The turn lasts until the computation ends, even if this future is dropped.
            let span = tracing::Span::current();
            let task = tokio::task::spawn_blocking(move || turn.run(|| span.in_scope(work)));

            task.await.map_err(|error| {
                tracing::error!(%error, "a request panicked");
                Error::Internal
            })
        };

        tokio::select! {
            result = computed => result,
            _ = halted.wait_for(|halted| *halted) => Err(Error::Loading),
        }
    }
}

/// The caller's deadline from the header `grpc-timeout`, minus 10 % but at most 10 ms:
/// DEADLINE_EXCEEDED must arrive before the caller's transport times out. `None` if the header is
/// absent or malformed.
fn caller_deadline(metadata: &MetadataMap) -> Option<Duration> {
    // The format is up to eight digits and a unit letter: `250m` is 250 ms.
    let text = metadata.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    let count: u64 = digits.parse().ok().filter(|_| digits.len() <= 8)?;

    let given = match unit {
        "H" => Duration::from_secs(count * 3_600),
        "M" => Duration::from_secs(count * 60),
        "S" => Duration::from_secs(count),
        "m" => Duration::from_millis(count),
        "u" => Duration::from_micros(count),
        "n" => Duration::from_nanos(count),
        _ => return None,
    };

    Some(given - (given / 10).min(Duration::from_millis(10)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn workers(threads: usize, queue: usize) -> Workers {
        Workers::new(&Config {
            threads,
            queue,
            ..Config::default()
        })
    }

    fn context(caller: u64, budget: Duration) -> CallContext {
        CallContext {
            caller: CallerId::Connection(caller),
            budget,
        }
    }

    fn long() -> CallContext {
        context(1, Duration::from_secs(30))
    }

    /// Oracle: the contract: a panic fails one request, and the next one succeeds.
    #[tokio::test]
    async fn a_panic_costs_one_request() {
        let workers = workers(1, 0);
        assert_eq!(
            workers
                .run::<()>(Lane::Short, long(), |_| panic!("on purpose"))
                .await,
            Err(Error::Internal)
        );

        assert_eq!(workers.run(Lane::Short, long(), |_| Ok(7)).await, Ok(7));
    }

    /// Oracle: the contract: brief work runs on the thread of the runtime that asks for it, a panic
    /// costs one request, and work that has to wait may wait.
    #[tokio::test(flavor = "multi_thread", worker_threads = 1)]
    async fn brief_work_is_done_in_place() {
        let asked = tokio::spawn(async {
            let workers = workers(1, 0);
            let thread = || std::thread::current().id();
            let found = workers.run(Lane::Brief, long(), move |_| Ok(thread()));
            assert_eq!(found.await, Ok(thread()));

            let panicked = workers.run::<()>(Lane::Brief, long(), |_| panic!("on purpose"));
            assert_eq!(panicked.await, Err(Error::Internal));

            let wait = || tokio::runtime::Handle::current().block_on(async { 7 });
            let waited = workers.run(Lane::Brief, long(), move |_| {
                let twice = off_the_lane(wait).and_then(|_| off_the_lane(wait));
                twice.map_err(|_| Error::Internal)
            });
            assert_eq!(waited.await, Ok(7));
        });
        asked.await.unwrap();
    }

    /// Oracle: the contract: while the only thread of the lane works, brief work is short work,
    /// which waits in the queue, or is refused without one.
    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn brief_work_takes_turns_with_short_work() {
        for (queue, expected) in [(1, Ok(2)), (0, Err(Full::ShortRequests))] {
            let workers = workers(1, queue);
            let (release, wait) = std::sync::mpsc::channel::<()>();
            let (begun, begins) = tokio::sync::oneshot::channel();
            let busy = workers.clone();
            let first = tokio::spawn(async move {
                busy.run(Lane::Short, long(), move |_| {
                    let _ = begun.send(());
                    let _ = wait.recv();
                    Ok(1)
                })
                .await
            });
            begins.await.unwrap();

            let mut second = Box::pin(workers.run(Lane::Brief, long(), |_| Ok(2)));
            let at_once = futures_util::poll!(&mut second);
            assert_eq!(at_once.is_pending(), queue > 0);
            release.send(()).unwrap();
            assert_eq!(first.await.unwrap(), Ok(1));
            if queue > 0 {
                assert_eq!(second.await, Ok(2));
            } else {
                let refused = expected.map_err(|what| Error::Full { what });
                assert_eq!(at_once, std::task::Poll::Ready(refused));
            }
        }
    }

    /// Oracle: the contract. The work loops until it is cancelled and then reports that.
    #[tokio::test(start_paused = true)]
    async fn a_deadline_stops_the_work() {
        let workers = workers(1, 1);
        let (begun, begins) = tokio::sync::oneshot::channel();
        let (stopped, has_stopped) = tokio::sync::oneshot::channel();

        let work = move |cancel: &Cancellation| {
            let _ = begun.send(());
            while cancel.check().is_ok() {
                std::thread::sleep(Duration::from_millis(1));
            }

            let _ = stopped.send(());
            Ok(())
        };

        let budget = Duration::from_millis(20);
        let running =
            tokio::spawn(async move { workers.run(Lane::Short, context(1, budget), work).await });
        begins.await.unwrap();

        // The clock stands still until it is advanced, because the work runs.
        tokio::time::advance(budget - Duration::from_millis(2)).await;
        assert!(!running.is_finished(), "not before the deadline");
        tokio::time::advance(Duration::from_millis(3)).await;
        assert_eq!(running.await.unwrap(), Err(Error::Deadline));
        has_stopped.await.unwrap();
    }

    /// Oracle: the definition of a bounded queue. With one thread and no queue, the lane refuses a
    /// second request; the other lanes have their own threads.
    #[tokio::test]
    async fn a_full_queue_refuses() {
        let workers = workers(1, 0);
        let (release, wait) = std::sync::mpsc::channel::<()>();
        let busy = workers.clone();
        let (begun, begins) = tokio::sync::oneshot::channel();

        let first = tokio::spawn(async move {
            busy.run(Lane::Short, long(), move |_| {
                let _ = begun.send(());
                let _ = wait.recv();
                Ok(1)
            })
            .await
        });

        begins.await.unwrap();
        let full = Error::Full {
            what: Full::ShortRequests,
        };
        assert_eq!(workers.run(Lane::Short, long(), |_| Ok(2)).await, Err(full));

        // The other lanes are free.
        assert_eq!(workers.run(Lane::Long, long(), |_| Ok(3)).await, Ok(3));
        assert_eq!(workers.run(Lane::Images, long(), |_| Ok(4)).await, Ok(4));

        release.send(()).unwrap();
        assert_eq!(first.await.unwrap(), Ok(1));
    }

    /// Oracle: the contract: a job that checks for cancellation passes its only thread on to the
    /// job of another caller, and then goes on.
    #[tokio::test]
    async fn a_long_job_is_paused_while_others_wait() {
        let workers = workers(1, 8);
        let (begun, begins) = tokio::sync::oneshot::channel();
        let (release, wait) = std::sync::mpsc::channel::<()>();
        let busy = workers.clone();
        let first = tokio::spawn(async move {
            busy.run(Lane::Long, long(), move |cancel| {
                let _ = begun.send(());
                while wait.try_recv().is_err() {
                    cancel.check()?;
                }
                Ok(1)
            })
            .await
        });

        begins.await.unwrap();
        let other = context(2, Duration::from_secs(30));
        assert_eq!(workers.run(Lane::Long, other, |_| Ok(2)).await, Ok(2));
        assert!(!first.is_finished());
        release.send(()).unwrap();
        assert_eq!(first.await.unwrap(), Ok(1));
    }

    /// Oracle: the contract, and the rule of the shares by hand: jobs that wait for the disk hold
    /// no thread of the lane; of 64 places one caller gets 32; each goes on when the disk answers.
    #[tokio::test]
    async fn jobs_that_wait_for_the_disk_hold_no_thread() {
        let workers = workers(1, 8);
        let (answers, answer) = tokio::sync::watch::channel(false);
        let (waits, mut waiting_now) = tokio::sync::mpsc::unbounded_channel();
        let hung = |caller| {
            let (workers, mut answer) = (workers.clone(), answer.clone());
            let waits = waits.clone();
            tokio::spawn(async move {
                let context = context(caller, Duration::from_secs(30));
                let runtime = tokio::runtime::Handle::current();
                let work = move |_: &Cancellation| {
                    let waited = off_the_lane(|| {
                        let _ = waits.send(());
                        runtime.block_on(answer.wait_for(|is| *is)).is_ok()
                    });
                    waited.map_err(|_| Error::Internal)
                };
                workers.run(Lane::Short, context, work).await
            })
        };

        let mut waiting = Vec::new();
        for _ in 0..32 {
            waiting.push(hung(1));
            waiting_now.recv().await.unwrap();
            let other = context(2, Duration::from_secs(30));
            assert_eq!(workers.run(Lane::Short, other, |_| Ok(2)).await, Ok(2));
        }
        assert_eq!(hung(1).await.unwrap(), Err(Error::Internal));

        answers.send(true).unwrap();
        for job in waiting {
            assert_eq!(job.await.unwrap(), Ok(true));
        }
        let last = context(1, Duration::from_secs(30));
        assert_eq!(workers.run(Lane::Short, last, |_| Ok(3)).await, Ok(3));
    }

    /// Oracle: by hand from the rule of the shares: of four places one caller gets two, another
    /// one. A job that is no longer wanted frees its place.
    #[tokio::test]
    async fn callers_share_the_queue() {
        let workers = workers(1, 4);
        let (release, wait) = std::sync::mpsc::channel::<()>();
        let (begun, begins) = tokio::sync::oneshot::channel();
        let busy = workers.clone();
        let running = tokio::spawn(async move {
            busy.run(Lane::Short, long(), move |_| {
                let _ = begun.send(());
                let _ = wait.recv();
                Ok(())
            })
            .await
        });
        begins.await.unwrap();

        let mut queued: Vec<_> = (0..2)
            .map(|_| Box::pin(workers.run(Lane::Short, long(), |_| Ok(()))))
            .collect();
        for job in &mut queued {
            assert!(futures_util::poll!(job).is_pending());
        }
        let full = Err(Error::Full {
            what: Full::CallersQueue,
        });
        assert_eq!(workers.run(Lane::Short, long(), |_| Ok(())).await, full);

        let other = || context(2, Duration::from_secs(30));
        let mut others = Box::pin(workers.run(Lane::Short, other(), |_| Ok(())));
        assert!(futures_util::poll!(&mut others).is_pending());
        assert_eq!(workers.run(Lane::Short, other(), |_| Ok(())).await, full);

        drop(queued.pop());
        let mut again = Box::pin(workers.run(Lane::Short, long(), |_| Ok(())));
        assert!(futures_util::poll!(&mut again).is_pending());

        release.send(()).unwrap();
        let first = queued.remove(0);
        let ended = futures_util::future::join3(first, others, again).await;
        assert_eq!(ended, (Ok(()), Ok(()), Ok(())));
        assert_eq!(running.await.unwrap(), Ok(()));
    }

    /// Oracle: the gRPC specification of `grpc-timeout`: up to eight digits and a unit.
    #[test]
    fn timeouts_are_read_as_grpc_writes_them() {
        let read = |text: &str| {
            let mut metadata = MetadataMap::new();
            metadata.insert("grpc-timeout", text.parse().unwrap());
            caller_deadline(&metadata)
        };

        assert_eq!(read("2S"), Some(Duration::from_millis(1_990)));
        assert_eq!(read("50m"), Some(Duration::from_millis(45)));
        assert_eq!(read("1H"), Some(Duration::from_millis(3_599_990)));

        for nonsense in ["", "S", "5", "123456789S", "-1S", "5x"] {
            assert_eq!(read(nonsense), None, "{nonsense}");
        }
    }
}
