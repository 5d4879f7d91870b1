//! Fits an adapter to a room on the server.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use prost::Message;
use tokio::sync::mpsc;
use tonic::Status;

use super::super::caller::Requester;
use super::super::workers::{CallContext, Lane};
use super::super::{Error, Handlers};
use super::changes::{check_right, identity, resource, revision_to_wire};
use super::recent::Identity;
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_robot::fitting::{FITTING_EPOCHS, FitRun};
use seese3_store::fit_stored_room::{Refit, Request};
use seese3_store::{Kind, Published, Store};

/// Sender of a fit's events.
pub type Events = mpsc::Sender<Result<pb::FitAdapterResponse, Status>>;

/// Maximum seed: 32 bits, portable to other programs.
const LARGEST_SEED: u64 = u32::MAX as u64;

/// A validated fit request.
pub struct Admitted {
    request: Request,
    identity: Identity,
    validate_only: bool,
    /// The store with the caller's quotas.
    store: Store,
}

impl Handlers {
    /// Validates a request. Reads the store only if the request names a base adapter.
    ///
    /// # Errors
    /// [`Error::Invalid`], naming the field; [`Error::OutOfScope`] if the caller may not change the
    /// room.
    pub(super) async fn admit_refit(
        &self,
        caller: &Requester,
        request: pb::FitAdapterRequest,
    ) -> Result<Admitted, Error> {
        let content = request.encode_to_vec();
        let identity = identity(caller, &request.request_id, "FitAdapter", &content);

        // Destructured with no `..`, so that a new field breaks the build here.
        let pb::FitAdapterRequest {
            room,
            base_adapter,
            feature_set,
            fitted_adapter,
            seed,
            request_id: _,
            validate_only,
        } = request;

        self.changes()?;
        let room = resource(Kind::Room, &room, None)?;
        check_right(caller, &room)?;
        if seed > LARGEST_SEED {
            let problem = format!("must be at most {LARGEST_SEED}, got {seed}");
            return Err(Error::invalid("seed", problem));
        }

        let adapter = |field: &str, given: &str| -> Result<Option<String>, Error> {
            match given {
                "" => Ok(None),
                given => {
                    let adapter = resource(Kind::Adapter, given, None);
                    Ok(Some(adapter.map_err(|error| error.named(field))?.name))
                }
            }
        };
        let fitted_adapter = adapter("fitted_adapter", &fitted_adapter)?;
        let base = adapter("base_adapter", &base_adapter)?;
        if let Some(base) = &base {
            // A hidden adapter is answered like a missing one.
            let snapshot = self.reloaded(caller).await?;
            let seen = snapshot.adapter(base);
            seen.map_err(|error| error.named("base_adapter"))?;
        }

        let request = Request {
            base,
            name: fitted_adapter,
            own_names_only: caller.scope().is_some_and(|scope| !scope.is_all()),
            features: (!feature_set.is_empty()).then_some(feature_set),
            room: room.name,
            seed,
        };

        Ok(Admitted {
            request,
            identity,
            validate_only,
            store: self.changes()?.store_for(caller),
        })
    }

    /// Fits, publishes and sends the result. Stops the fit if the caller disconnects before it is
    /// published.
    pub(super) async fn run_refit(self, admitted: Admitted, context: CallContext, events: Events) {
        let progress = Arc::new(FitProgress {
            done: AtomicU32::new(0),
            events: events.clone(),
        });
        let result = tokio::select! {
            result = self.refit(admitted, context, progress.clone()) => result,
            () = progress.repeated() => return,
            () = events.closed() => {
                tracing::info!("the fit was cancelled");
                return;
            }
        };
        if let Err(error) = &result {
            tracing::warn!(%error, "the fit failed");
        }

        let event = result.map(pb::fit_adapter_response::Event::Result);
        let last = event
            .map(|event| pb::FitAdapterResponse { event: Some(event) })
            .map_err(Status::from);
        // This fails only if the caller has disconnected.
        let _ = events.send(last).await;
    }

    async fn refit(
        &self,
        admitted: Admitted,
        context: CallContext,
        progress: Arc<FitProgress>,
    ) -> Result<pb::FitResult, Error> {
        let Admitted {
            request,
            identity,
            validate_only,
            store,
        } = admitted;
        let changes = self.changes()?.clone();
        if let Some(answer) = changes.answered(&identity).await? {
            return Ok(answer);
        }

        // Held until the adapter is published: a retry meanwhile is rejected instead of starting a
        // second fit.
        let place = changes.fit_place(&context.caller)?;

        // A fit is bounded by its epochs and cancelled when the caller disconnects, not by the time
        // limit of requests.
        let context = CallContext {
            budget: Duration::MAX,
            ..context
        };
        let room = request.room.clone();
        let read = store.clone();
        let runtime = tokio::runtime::Handle::current();
        let fit = move |cancel: &Cancellation| {
            // Before the work, so that it is not lost.
            runtime.block_on(read.check_quotas(Some(&request.room)))?;
            // The room is read when the fit's turn has come, so that queued fits hold no memory.
            let refit = runtime.block_on(Refit::prepare(&read, request))?;
            if validate_only {
                return Ok((refit, None));
            }
            let fitted = refit.fit(FitRun {
                progress: &|_| progress.step(),
                cancel,
            })?;
            Ok((refit, Some(fitted)))
        };
        let (mut refit, fitted) = self.workers.run(Lane::Fit, context, fit).await?;
        let Some(fitted) = fitted else {
            return Ok(pb::FitResult::default());
        };

        let change = async move {
            let _place = place;
            let published = refit.publish(&store, &fitted).await?;
            Ok((refit.name().to_owned(), published))
        };
        let handlers = self.clone();
        let answer = move |(name, published): (String, Published)| {
            let revision = revision_to_wire(&name, &published);
            pb::FitResult {
                served: handlers.serves_in(&room, &revision),
                created: published.is_new,
                revision: Some(revision),
            }
        };
        changes.once(identity, change, answer).await
    }
}

/// Sends a fit's progress. A slow caller misses events; waiting for it would block the fit.
struct FitProgress {
    /// Number of finished epochs.
    done: AtomicU32,
    events: Events,
}

impl FitProgress {
    /// Counts and sends an epoch.
    fn step(&self) {
        self.done.fetch_add(1, Ordering::Relaxed);
        self.send();
    }

    /// Sends the progress every second, also while the fit waits for its turn, so that the caller
    /// can tell a waiting fit from a broken connection. Never completes.
    async fn repeated(&self) {
        loop {
            tokio::time::sleep(Duration::from_secs(1)).await;
            self.send();
        }
    }

    fn send(&self) {
        let progress = pb::FitProgress {
            done: self.done.load(Ordering::Relaxed),
            total: FITTING_EPOCHS as u32,
        };
        let event = Some(pb::fit_adapter_response::Event::Progress(progress));
        let _ = self.events.try_send(Ok(pb::FitAdapterResponse { event }));
    }
}
