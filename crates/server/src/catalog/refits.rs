//! Fits an adapter to a room on the server.

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use prost::Message;
use tokio::sync::mpsc;
use tonic::Status;

use super::super::auth::RoomScope;
use super::super::caller::Requester;
use super::super::snapshot::Snapshot;
use super::super::workers::{CallContext, Lane};
use super::super::{Error, Handlers};
use super::changes::{check_right, identity, named_whole, revision_to_wire};
use super::recent::Identity;
use seese3_client::proto::v1 as pb;
use seese3_core::adapter::EpochProgress;
use seese3_core::cancel::Cancellation;
use seese3_robot::fitting::{FITTING_EPOCHS, FitRun};
use seese3_store::fit_stored_room::{Refit, Request};
use seese3_store::{Kind, Published};

/// Sender of a fit's events.
pub type Events = mpsc::Sender<Result<pb::RefitRoomResponse, Status>>;

/// Maximum seed: 32 bits, portable to other programs.
const LARGEST_SEED: u64 = u32::MAX as u64;

/// A validated fit request.
pub struct Admitted {
    request: Request,
    identity: Identity,
    validate_only: bool,
}

impl Handlers {
    /// Validates a request without reading the store.
    ///
    /// # Errors
    /// [`Error::Invalid`], naming the field; [`Error::OutOfScope`] if the caller may not change the
    /// room.
    pub(super) fn admit_refit(
        &self,
        caller: &Requester,
        snapshot: &Snapshot,
        request: pb::RefitRoomRequest,
    ) -> Result<Admitted, Error> {
        let content = request.encode_to_vec();
        let identity = identity(caller, &request.request_id, "RefitRoom", &content);

        // Destructured with no `..`, so that a new field breaks the build here.
        let pb::RefitRoomRequest {
            name,
            base_adapter,
            features,
            fitted_adapter,
            seed,
            request_id: _,
            validate_only,
        } = request;

        self.changes()?;
        let room = named_whole("name", &name, Kind::Room)?;
        check_right(caller, &room)?;
        if seed > LARGEST_SEED {
            let problem = format!("must be at most {LARGEST_SEED}, got {seed}");
            return Err(Error::invalid("seed", problem));
        }

        let adapter = |field: &str, given: &str| -> Result<Option<String>, Error> {
            match given {
                "" => Ok(None),
                given => Ok(Some(named_whole(field, given, Kind::Adapter)?.name)),
            }
        };
        let fitted_adapter = adapter("fitted_adapter", &fitted_adapter)?;
        let base = adapter("base_adapter", &base_adapter)?;
        if let Some(base) = &base {
            // A hidden adapter is answered like a missing one.
            let seen = snapshot.adapter(base);
            seen.map_err(|error| error.named("base_adapter"))?;
        }

        let is_of_room = |name: &String| is_in_namespace(name, &room.name);
        let sees_all = caller.scope().is_none_or(RoomScope::is_all);
        if !sees_all && !fitted_adapter.as_ref().is_none_or(is_of_room) {
            let problem = format!(
                "must be '{}.NAME' or '{}.NAME.NAME' for a caller without access to all rooms",
                room.name, room.name
            );
            return Err(Error::invalid("fitted_adapter", problem));
        }

        let request = Request {
            base,
            name: fitted_adapter,
            features: (!features.is_empty()).then_some(features),
            room: room.name,
            seed,
        };

        Ok(Admitted {
            request,
            identity,
            validate_only,
        })
    }

    /// Fits, publishes and sends the result. Stops the fit if the caller disconnects before it is
    /// published.
    pub(super) async fn run_refit(self, admitted: Admitted, context: CallContext, events: Events) {
        let result = tokio::select! {
            result = self.refit(admitted, context, &events) => result,
            () = events.closed() => {
                tracing::info!("the fit was cancelled");
                return;
            }
        };
        if let Err(error) = &result {
            tracing::warn!(%error, "the fit failed");
        }

        let event = result.map(pb::refit_room_response::Event::Result);
        let last = event
            .map(|event| pb::RefitRoomResponse { event: Some(event) })
            .map_err(Status::from);
        // This fails only if the caller has disconnected.
        let _ = events.send(last).await;
    }

    async fn refit(
        &self,
        admitted: Admitted,
        context: CallContext,
        events: &Events,
    ) -> Result<pb::RefitResult, Error> {
        let Admitted {
            request,
            identity,
            validate_only,
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
        let heard = events.clone();
        let store = changes.store.clone();
        let runtime = tokio::runtime::Handle::current();
        let fit = move |cancel: &Cancellation| {
            // The room is read when the fit's turn has come, so that queued fits hold no memory.
            let refit = runtime.block_on(Refit::prepare(&store, request))?;
            if validate_only {
                return Ok((refit, None));
            }
            let fitted = refit.fit(FitRun {
                progress: &sends_progress(heard),
                cancel,
            })?;
            Ok((refit, Some(fitted)))
        };
        let (refit, fitted) = self.workers.run(Lane::Fit, context, fit).await?;
        let Some(fitted) = fitted else {
            return Ok(pb::RefitResult::default());
        };

        let store = changes.store.clone();
        let name = refit.name().to_owned();
        let change = async move {
            let _place = place;
            Ok(refit.publish(&store, &fitted).await?)
        };
        let handlers = self.clone();
        let answer = move |published: Published| {
            let revision = revision_to_wire(&name, &published);
            pb::RefitResult {
                served: handlers.serves_in(&room, &revision),
                created: published.is_new,
                revision: Some(revision),
            }
        };
        changes.once(identity, change, answer).await
    }
}

/// Whether an adapter's name belongs to a room: the room's name and one or two parts. The name that
/// a fit chooses itself has two. With more, a room `lab` could take a name of the room `lab.b`.
fn is_in_namespace(adapter: &str, room: &str) -> bool {
    let rest = adapter.strip_prefix(room);
    let rest = rest.and_then(|rest| rest.strip_prefix('.'));
    rest.is_some_and(|rest| rest.split('.').count() <= 2)
}

/// Sends each epoch's progress. A slow caller misses events; waiting for it would block the fit.
fn sends_progress(events: Events) -> impl Fn(EpochProgress) + Sync {
    let done = AtomicU32::new(0);
    move |_| {
        let progress = pb::RefitProgress {
            done: done.fetch_add(1, Ordering::Relaxed) + 1,
            total: FITTING_EPOCHS as u32,
        };
        let event = Some(pb::refit_room_response::Event::Progress(progress));
        let _ = events.try_send(Ok(pb::RefitRoomResponse { event }));
    }
}
