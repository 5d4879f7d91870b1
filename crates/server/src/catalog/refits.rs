//! Fits an adapter to a room on the server.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use prost::Message;
use tokio::sync::mpsc;
use tonic::Status;

use super::super::auth::Principal;
use super::super::status::Full;
use super::super::workers::Lane;
use super::super::{Error, Handlers};
use super::changes::{check_right, identity, named_whole, revision_to_wire};
use super::recent::Identity;
use seese3_client::proto::v1 as pb;
use seese3_robot::fitting::FITTING_EPOCHS;
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
        caller: Option<&Arc<Principal>>,
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
        let is_of_room = |name: &String| name.starts_with(&format!("{}.", room.name));
        let sees_all = caller.is_none_or(|caller| caller.rooms().is_all());
        if !sees_all && !fitted_adapter.as_ref().is_none_or(is_of_room) {
            let problem = format!(
                "must begin with '{}.' for a caller without access to all rooms",
                room.name
            );
            return Err(Error::invalid("fitted_adapter", problem));
        }

        let request = Request {
            base: adapter("base_adapter", &base_adapter)?,
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

    /// Fits, publishes and sends the result. Continues if the caller disconnects.
    pub(super) async fn run_refit(self, admitted: Admitted, events: Events) {
        let result = self.refit(admitted, &events).await;
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

    async fn refit(&self, admitted: Admitted, events: &Events) -> Result<pb::RefitResult, Error> {
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
        let place = changes.fit_place();
        let place = place.ok_or_else(|| self.workers.full(Full::Fits))?;

        let room = request.room.clone();
        let refit = Refit::prepare(&changes.store, request).await?;
        if validate_only {
            return Ok(pb::RefitResult::default());
        }

        let heard = events.clone();
        let done = AtomicU32::new(0);
        let fit = move || {
            let fitted = refit.fit(&|_| {
                let progress = pb::RefitProgress {
                    done: done.fetch_add(1, Ordering::Relaxed) + 1,
                    total: FITTING_EPOCHS as u32,
                };
                let event = Some(pb::refit_room_response::Event::Progress(progress));
                // A slow caller misses progress events; waiting for it would block the fit.
                let _ = heard.try_send(Ok(pb::RefitRoomResponse { event }));
            });
            fitted.map(|fitted| (refit, fitted))
        };
        let (refit, fitted) = self.workers.run_unbounded(Lane::Long, fit).await??;
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
