//! Noticing that the store has changed, and serving what it has now.
//!
//! A new snapshot is loaded beside the one that is being served and then takes its place in one
//! step. Requests and streams in flight keep the snapshot that they began with.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Notify, mpsc, oneshot, watch};

use super::Phase;
use super::metrics::{Metrics, ReloadOutcome};
use super::snapshot::{Loader, Refused, Snapshot};

/// When a server looks for changes of its store.
#[derive(Debug, Clone)]
pub struct Reload {
    /// The time between two looks; none to look only when asked to.
    pub every: Option<Duration>,
    /// Notified to look now, and to try again what was refused.
    pub asked: Arc<Notify>,
}

impl Default for Reload {
    fn default() -> Self {
        Self {
            every: Some(Duration::from_secs(5)),
            asked: Arc::default(),
        }
    }
}

/// Asks for a look at the store, and waits for it: for those who changed the store themselves.
#[derive(Debug, Clone)]
pub(super) struct Looks(mpsc::UnboundedSender<oneshot::Sender<()>>);

/// Where looks are asked for.
pub(super) type LookRequests = mpsc::UnboundedReceiver<oneshot::Sender<()>>;

impl Looks {
    pub fn new() -> (Self, LookRequests) {
        let (asks, asked) = mpsc::unbounded_channel();
        (Self(asks), asked)
    }

    /// Completes after a look that began after this call, or when the server serves no more.
    pub async fn look(&self) {
        let (done, looked) = oneshot::channel();
        if self.0.send(done).is_ok() {
            // An error means that the server is stopping.
            let _ = looked.await;
        }
    }
}

/// Keeps the served snapshot up to date for as long as the server serves; never completes.
pub(super) async fn keep_current(
    loader: Loader,
    reload: Reload,
    mut asked: LookRequests,
    is_writable: bool,
    phase: &watch::Sender<Phase>,
    metrics: &Metrics,
) {
    // Trouble that lasts is logged once.
    let mut trouble = String::new();

    loop {
        // They are told when they are dropped, at the end of this look.
        let mut waiting: Vec<oneshot::Sender<()>> = Vec::new();
        let refused = next_look(&reload, &mut asked, &mut waiting).await;
        let Phase::Serving(before) = phase.borrow().clone() else {
            continue;
        };

        let now = match loader.load(before.clone(), refused).await {
            // Whoever changes the store through this server may remove the last room, of which a trace
            // is left.
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
                trouble.clear();
                // Also where nothing changed: a room may have turned out to be damaged meanwhile.
                metrics.serving(now.counts());
                if now.is_like(&before) {
                    metrics.reloaded(ReloadOutcome::Unchanged);
                    continue;
                }

                log_changes(&before, &now);
                metrics.reloaded(ReloadOutcome::Changed);
                phase.send_replace(Phase::Serving(Arc::new(now)));
            }
            // A store that cannot be reached, or is gone, takes nothing from what is served.
            Err(problem) => {
                metrics.reloaded(ReloadOutcome::Failed);
                if problem != trouble {
                    tracing::error!(
                        problem,
                        "the store could not be read again; serving goes on"
                    );
                    trouble = problem;
                }
            }
        }
    }
}

/// Waits until it is time for the next look, or until one is asked for. Collects who waits for it.
async fn next_look(
    reload: &Reload,
    asked: &mut LookRequests,
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
        () = reload.asked.notified() => Refused::TryAgain,
        Some(done) = asked.recv() => {
            waiting.push(done);
            Refused::LeaveOut
        }
    };

    // Whoever asked up to now is content with this look.
    while let Ok(done) = asked.try_recv() {
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
