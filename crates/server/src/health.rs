//! The standard health service, `grpc.health.v1`: Check and Watch, for the server, each service and
//! each room.
//!
//! Names: `""` for the whole server, the full names of the services, and `rooms/NAME`. Watch of an
//! unknown name answers SERVICE_UNKNOWN and stays open, as the specification demands.

use std::pin::Pin;

use tokio::sync::{mpsc, watch};
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::server::NamedService;
use tonic::{Request, Response, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_server::{Health, HealthServer};
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

use super::{Handlers, Phase};
use seese3_client::proto::v1::catalog_service_server::CatalogServiceServer;
use seese3_client::proto::v1::evaluation_service_server::EvaluationServiceServer;
use seese3_client::proto::v1::localization_service_server::LocalizationServiceServer;
use seese3_client::proto::v1::navigation_service_server::NavigationServiceServer;
use seese3_client::proto::v1::odometry_service_server::OdometryServiceServer;

/// The RPCs that need no credentials.
pub const HEALTH_CHECK: &str = "/grpc.health.v1.Health/Check";
pub const HEALTH_WATCH: &str = "/grpc.health.v1.Health/Watch";

const SERVICES: [&str; 6] = [
    "",
    <NavigationServiceServer<Handlers> as NamedService>::NAME,
    <LocalizationServiceServer<Handlers> as NamedService>::NAME,
    <OdometryServiceServer<Handlers> as NamedService>::NAME,
    <CatalogServiceServer<Handlers> as NamedService>::NAME,
    <EvaluationServiceServer<Handlers> as NamedService>::NAME,
];

/// The health service: the server's phase, and whether rooms have a status. Health asks for no
/// credentials, so rooms are hidden where other calls need them.
pub struct HealthOf(watch::Receiver<Phase>, RoomHealth);

/// Whether health checks of rooms are answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoomHealth {
    Shown,
    Hidden,
}

/// Maximum size of a health request, bytes: the name of a service or room.
pub const HEALTH_BYTES: usize = 1 << 10;

/// The health service for the phase in this channel.
pub fn service(phase: watch::Receiver<Phase>, rooms: RoomHealth) -> HealthServer<HealthOf> {
    HealthServer::new(HealthOf(phase, rooms)).max_decoding_message_size(HEALTH_BYTES)
}

/// The status of the service or room `name`; `None` if the name is unknown. Rooms are unknown until
/// the store is loaded. A room that is in the store but cannot be served is NOT_SERVING.
fn status(phase: &Phase, rooms: RoomHealth, name: &str) -> Option<ServingStatus> {
    if SERVICES.contains(&name) {
        return Some(match phase {
            Phase::Serving(_) => ServingStatus::Serving,
            Phase::Loading | Phase::Draining(_) | Phase::Stopping => ServingStatus::NotServing,
        });
    }

    if rooms == RoomHealth::Hidden {
        return None;
    }
    let room = name.strip_prefix("rooms/")?;
    let (Phase::Serving(snapshot) | Phase::Draining(snapshot)) = phase else {
        return None;
    };
    let is_served = snapshot.answers_in(room);
    let is_known =
        snapshot.rooms().contains_key(room) || snapshot.refused().rooms.contains_key(room);

    match phase {
        Phase::Serving(_) if is_served => Some(ServingStatus::Serving),
        _ if is_known => Some(ServingStatus::NotServing),
        _ => None,
    }
}

#[tonic::async_trait]
impl Health for HealthOf {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<HealthCheckResponse, Status>> + Send>>;

    async fn check(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<HealthCheckResponse>, Status> {
        let name = request.into_inner().service;
        match status(&self.0.borrow(), self.1, &name) {
            Some(status) => Ok(Response::new(HealthCheckResponse {
                status: status.into(),
            })),
            None => Err(Status::not_found(format!("service '{name}' is not known"))),
        }
    }

    async fn watch(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let name = request.into_inner().service;
        let mut phase = self.0.clone();
        let rooms = self.1;
        let (changes, stream) = mpsc::channel(4);

        tokio::spawn(async move {
            let mut last = None;
            loop {
                // Drop the read guard before the awaits below: it blocks `run` from changing the
                // phase.
                let (now, stopping) = {
                    let phase = phase.borrow_and_update();
                    let stopping = matches!(*phase, Phase::Draining(_) | Phase::Stopping);

                    (
                        status(&phase, rooms, &name).unwrap_or(ServingStatus::ServiceUnknown),
                        stopping,
                    )
                };

                // The first status is always sent, later ones only if the status changed.
                if last.replace(now) != Some(now)
                    && changes
                        .send(Ok(HealthCheckResponse { status: now.into() }))
                        .await
                        .is_err()
                {
                    return;
                }

                // A stopping server waits for open calls, so this stream must end.
                if stopping {
                    return;
                }

                tokio::select! {
                    changed = phase.changed() => if changed.is_err() { return },
                    () = changes.closed() => return,
                }
            }
        });

        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the specification of grpc.health.v1: before the store is loaded and after the
    /// shutdown signal every existing service is NOT_SERVING, and a room is unknown before it is
    /// loaded.
    #[test]
    fn nothing_serves_before_it_is_loaded() {
        for phase in [Phase::Loading, Phase::Stopping] {
            for name in SERVICES {
                assert_eq!(
                    status(&phase, RoomHealth::Shown, name),
                    Some(ServingStatus::NotServing),
                    "{name:?}"
                );
            }

            assert_eq!(status(&phase, RoomHealth::Shown, "rooms/kitchen"), None);
        }
    }
}
