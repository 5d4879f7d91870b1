//! Noticing that the store has changed, and serving what it has now.
//!
//! A new snapshot is loaded beside the one that is being served and then takes its place in one
//! step. Requests and streams in flight keep the snapshot that they began with.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Notify, watch};

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

/// Keeps the served snapshot up to date for as long as the server serves; never completes.
pub(super) async fn keep_current(
    loader: Loader,
    reload: Reload,
    phase: &watch::Sender<Phase>,
    metrics: &Metrics,
) {
    // Trouble that lasts is logged once.
    let mut trouble = String::new();

    loop {
        let refused = next_look(&reload).await;
        let Phase::Serving(before) = phase.borrow().clone() else {
            continue;
        };

        let now = match loader.load(before.clone(), refused).await {
            Ok(now) if now.rooms().is_empty() => Err("the store has no room any more".to_owned()),
            Ok(now) => Ok(now),
            Err(error) => Err(error.to_string()),
        };
        match now {
            Ok(now) => {
                trouble.clear();
                if now.is_like(&before) {
                    metrics.reloaded(ReloadOutcome::Unchanged);
                    continue;
                }

                log_changes(&before, &now);
                metrics.serving(&now);
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

/// Waits until it is time for the next look, or until one is asked for.
async fn next_look(reload: &Reload) -> Refused {
    let pause = async {
        match reload.every {
            Some(every) => tokio::time::sleep(every).await,
            None => std::future::pending().await,
        }
    };

    tokio::select! {
        () = pause => Refused::LeaveOut,
        () = reload.asked.notified() => Refused::TryAgain,
    }
}

/// Logs what a reload changed. What is refused has been logged when it was tried.
fn log_changes(before: &Snapshot, now: &Snapshot) {
    for (name, room) in now.rooms() {
        let known = before.rooms().get(name);
        if !known.is_some_and(|known| Arc::ptr_eq(known, room)) {
            tracing::info!(room = name, revision = room.revision, "room loaded");
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
