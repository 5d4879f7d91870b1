//! Computes answers on a bounded number of blocking threads, within the caller's deadline.
//!
//! Short requests, images and long work have separate lanes, each with its own threads and queue. A
//! long evaluation or a slow encoder therefore does not delay short requests. The operating system
//! schedules the threads of all lanes.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Semaphore, watch};
use tonic::metadata::MetadataMap;

use super::metrics::Metrics;
use super::status::Full;
use super::{Config, Error};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;

/// Kind of work, which selects the threads and the queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// Work of at most milliseconds, for instance in a robot's control loop.
    Short,
    /// Requests with images to decode and encode.
    Images,
    /// Batches, evaluations and fits.
    Long,
}

impl Lane {
    /// [`Lane::Images`] if any of these views is an image, else [`Lane::Short`].
    pub fn of<'a>(views: impl IntoIterator<Item = &'a pb::View>) -> Self {
        let is_image = |view: &pb::View| matches!(view.view, Some(pb::view::View::Image(_)));

        if views.into_iter().any(is_image) {
            Self::Images
        } else {
            Self::Short
        }
    }

    /// The limit of this lane.
    fn full(self) -> Full {
        match self {
            Self::Short => Full::ShortRequests,
            Self::Images => Full::Images,
            Self::Long => Full::LongRequests,
        }
    }
}

/// The threads and the queue of a lane.
#[derive(Clone)]
struct Pool {
    threads: Arc<Semaphore>,
    admitted: Arc<Semaphore>,
}

impl Pool {
    fn new(threads: usize, queue: usize) -> Self {
        Self {
            threads: Arc::new(Semaphore::new(threads)),
            // A request holds this permit while it waits and runs. `try_acquire` fails once threads
            // and queue are full.
            admitted: Arc::new(Semaphore::new(threads + queue)),
        }
    }
}

/// Runs computations on blocking threads, separate from the async threads.
#[derive(Clone)]
pub struct Workers {
    short: Pool,
    images: Pool,
    long: Pool,
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
        Self {
            short: pool(threads),
            images: pool(threads),
            // Long work gets half as many threads.
            long: pool(threads.div_ceil(2)),
            longest: config.longest,
            halted: watch::Sender::new(false),
            metrics: config.metrics.clone(),
        }
    }

    fn pool(&self, lane: Lane) -> &Pool {
        match lane {
            Lane::Short => &self.short,
            Lane::Images => &self.images,
            Lane::Long => &self.long,
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

    /// Runs `work` on a blocking thread. If the budget is spent or the caller goes away, `work` is
    /// cancelled through its [`Cancellation`]. Its thread becomes free when `work` returns.
    ///
    /// # Errors
    /// [`Error::Full`] if the lane's queue is full, [`Error::Deadline`] if the budget is spent,
    /// [`Error::Loading`] if the stopping server abandoned the work, [`Error::Internal`] if it
    /// panicked, or the error of `work`.
    pub async fn run<T: Send + 'static>(
        &self,
        lane: Lane,
        budget: Duration,
        work: impl FnOnce(&Cancellation) -> Result<T, Error> + Send + 'static,
    ) -> Result<T, Error> {
        let admitted = self.pool(lane).admitted.clone().try_acquire_owned();
        let admitted = admitted.map_err(|_| self.full(lane.full()))?;

        // If the caller goes away, this future is dropped and the guard cancels the running work.
        let cancel = Arc::new(Cancellation::default());
        let guard = CancelOnDrop(cancel.clone());

        // The permit moves into the blocking task: it outlives this future if that is dropped.
        let computed = self.on_thread(lane, move || {
            let _admitted = admitted;
            work(&cancel)
        });

        // The budget includes the time in the queue.
        let result = tokio::time::timeout(budget, computed).await;
        drop(guard);
        result.unwrap_or(Err(Error::Deadline))?
    }

    /// Runs work on a blocking thread that was admitted elsewhere: a frame of a stream, an image of
    /// an upload, a fit. It waits for a thread without limit, is never refused, and is not
    /// cancelled.
    ///
    /// # Errors
    /// [`Error::Loading`] if the stopping server abandoned the work, [`Error::Internal`] if it
    /// panicked.
    pub async fn run_unbounded<T: Send + 'static>(
        &self,
        lane: Lane,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Error> {
        // Dropping the future only discards the result.
        self.on_thread(lane, work).await
    }

    /// Runs `work` on a blocking thread of the lane as soon as one is free.
    async fn on_thread<T: Send + 'static>(
        &self,
        lane: Lane,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Error> {
        let mut halted = self.halted.subscribe();
        let threads = self.pool(lane).threads.clone();

        let computed = async {
            let thread = threads.acquire_owned().await;
            let thread = thread.map_err(|_| Error::Internal)?;

            // The permit is held until the computation ends, even if this future is dropped.
            let span = tracing::Span::current();
            let task = tokio::task::spawn_blocking(move || {
                let _thread = thread;
                span.in_scope(work)
            });

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

    const LONG: Duration = Duration::from_secs(30);

    /// Oracle: the contract: a panic fails one request, and the next one succeeds.
    #[tokio::test]
    async fn a_panic_costs_one_request() {
        let workers = workers(1, 0);
        assert_eq!(
            workers
                .run::<()>(Lane::Short, LONG, |_| panic!("on purpose"))
                .await,
            Err(Error::Internal)
        );

        assert_eq!(workers.run(Lane::Short, LONG, |_| Ok(7)).await, Ok(7));
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
        let running = tokio::spawn(async move { workers.run(Lane::Short, budget, work).await });
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
            busy.run(Lane::Short, LONG, move |_| {
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
        assert_eq!(workers.run(Lane::Short, LONG, |_| Ok(2)).await, Err(full));

        // The other lanes are free.
        assert_eq!(workers.run(Lane::Long, LONG, |_| Ok(3)).await, Ok(3));
        assert_eq!(workers.run(Lane::Images, LONG, |_| Ok(4)).await, Ok(4));

        release.send(()).unwrap();
        assert_eq!(first.await.unwrap(), Ok(1));
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
