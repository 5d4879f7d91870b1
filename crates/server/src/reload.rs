//! Reloads the store when it has changed.
//!
//! A new snapshot is loaded while the old one is served, and replaces it atomically. Requests and
//! streams in flight keep the snapshot that they started with.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Notify, mpsc, oneshot, watch};

use super::Phase;
use super::metrics::{Metrics, ReloadOutcome};
use super::slow_files::logged_if_slow;
use super::snapshot::{Loader, Refused, Snapshot};

/// When a server checks its store for changes.
#[derive(Debug, Clone)]
pub struct Reload {
    /// Interval between two checks; `None` to check only when `requested` is notified.
    pub every: Option<Duration>,
    /// Notify it to check now, and to retry what was refused.
    pub requested: Arc<Notify>,
}

impl Default for Reload {
    fn default() -> Self {
        Self {
            every: Some(Duration::from_secs(5)),
            requested: Arc::default(),
        }
    }
}

/// Triggers a reload and waits for it, after a write by this server.
#[derive(Debug, Clone)]
pub(super) struct ReloadHandle(mpsc::UnboundedSender<oneshot::Sender<()>>);

/// Receiver of the requests of all [`ReloadHandle`]s.
pub(super) type ReloadRequests = mpsc::UnboundedReceiver<oneshot::Sender<()>>;

impl ReloadHandle {
    pub fn new() -> (Self, ReloadRequests) {
        let (sender, receiver) = mpsc::unbounded_channel();
        (Self(sender), receiver)
    }

    /// Completes after the next attempt to reload, also a failed one, or when the server stops.
    pub async fn now(&self) {
        let (done, checked) = oneshot::channel();
        if self.0.send(done).is_ok() {
            // An error means that the server is stopping.
            let _ = checked.await;
        }
    }
}

/// Keeps the served snapshot up to date for as long as the server serves; never completes.
pub(super) async fn keep_current(
    loader: Loader,
    reload: Reload,
    mut requests: ReloadRequests,
    is_writable: bool,
    phase: &watch::Sender<Phase>,
    metrics: &Metrics,
) {
    // An error that persists is logged once.
    let mut logged_problem = String::new();

    loop {
        // Dropped at the end of this iteration, which completes the callers' `now`.
        let mut waiting: Vec<oneshot::Sender<()>> = Vec::new();
        let refused = next_check(&reload, &mut requests, &mut waiting).await;
        let Phase::Serving(before) = phase.borrow().clone() else {
            continue;
        };

        let now = match logged_if_slow("the store", loader.load(before.clone(), refused)).await {
            // A caller may remove the last room through this server; the store then remembers it.
            Ok(now)
                if now.rooms().is_empty() && !(is_writable && loader.remembers_rooms().await) =>
            {
                Err("the store has no room any more".to_owned())
            }
            Ok(now) => Ok(now),
            Err(error) => Err(error.to_string()),
        };
        match now {
            Ok(now) => {
                logged_problem.clear();
                // Also if nothing changed: a room may have been found damaged in the meantime.
                metrics.serving(now.counts());
                if now.is_like(&before) {
                    metrics.reloaded(ReloadOutcome::Unchanged);
                    continue;
                }

                log_changes(&before, &now);
                metrics.reloaded(ReloadOutcome::Changed);
                phase.send_replace(Phase::Serving(Arc::new(now)));
            }
            // If the store cannot be reached, the old snapshot is still served.
            Err(problem) => {
                metrics.reloaded(ReloadOutcome::Failed);
                if problem != logged_problem {
                    tracing::error!(
                        problem,
                        "the store could not be read again; serving goes on"
                    );
                    logged_problem = problem;
                }
            }
        }
    }
}

/// Waits for the next interval or for a request. Collects the callers that wait for this check.
async fn next_check(
    reload: &Reload,
    requests: &mut ReloadRequests,
    waiting: &mut Vec<oneshot::Sender<()>>,
) -> Refused {
    let pause = async {
        match reload.every {
            Some(every) => tokio::time::sleep(every).await,
            None => std::future::pending().await,
        }
    };

    let refused = tokio::select! {
        () = pause => Refused::LeaveOut,
        () = reload.requested.notified() => Refused::TryAgain,
        Some(done) = requests.recv() => {
            waiting.push(done);
            Refused::LeaveOut
        }
    };

    // One check answers all requests received so far.
    while let Ok(done) = requests.try_recv() {
        waiting.push(done);
    }
    refused
}

/// Logs what a reload changed. What is refused has been logged when it was tried.
fn log_changes(before: &Snapshot, now: &Snapshot) {
    for (name, room) in now.rooms() {
        let known = before.rooms().get(name);
        if !known.is_some_and(|known| Arc::ptr_eq(known, room)) {
            tracing::info!(room = name, revision = room.summary.revision, "room served");
        }
    }
    for (name, adapter) in now.adapters() {
        let known = before.adapters().get(name);
        if !known.is_some_and(|known| Arc::ptr_eq(known, adapter)) {
            tracing::info!(
                adapter = name,
                revision = adapter.revision,
                "adapter loaded"
            );
        }
    }

    for name in before.rooms().keys() {
        if !now.rooms().contains_key(name) {
            tracing::info!(room = name, "room removed");
        }
    }
    for name in before.adapters().keys() {
        if !now.adapters().contains_key(name) {
            tracing::info!(adapter = name, "adapter removed");
        }
    }
}
