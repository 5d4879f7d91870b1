//! CatalogService: lists the server's rooms and adapters, in pages, and changes them.
//!
//! | file | what |
//! | --- | --- |
//! | `changes` | common steps of all changes: one at a time, reload of the store, stored responses |
//! | `recent` | stored responses to recent changes, for idempotent retries |
//! | `room_upload` | uploads a room, in batches of frames |
//! | `adapter_upload` | uploads an adapter |
//! | `downloads` | downloads rooms and adapters |
//! | `frames` | lists the frames of a room, for clients that plan or draw |
//! | `refits` | fits an adapter to a room on the server |
//! | `defaults` | sets and clears defaults, and removes revisions |
//! | `info` | the version, the abilities and the limits of the server |

mod adapter_upload;
mod changes;
mod defaults;
mod downloads;
mod frames;
mod info;
mod recent;
mod refits;
mod room_upload;

pub use changes::Changes;

use std::collections::BTreeMap;
use std::ops::Bound;

use tonic::{Request, Response, Status, Streaming};

use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use super::auth::RoomScope;
use super::caller::Requester;
use super::convert;
use super::memory::respond;
use super::snapshot::{ServedRoom, Snapshot};
use super::workers::Lane;
use super::{Error, Handlers, principal};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::catalog_service_server::CatalogService;
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::Twist;
use seese3_core::recording_extent::RecordingExtent;
use seese3_robot::fitting::ExpectedError;
use seese3_store::{RoomSummary, StoredAdapter};

/// Default and maximum number of entries per page.
const PAGE: usize = 100;
const LARGEST_PAGE: usize = 1_000;

#[tonic::async_trait]
impl CatalogService for Handlers {
    async fn list_rooms(
        &self,
        request: Request<pb::ListRoomsRequest>,
    ) -> Result<Response<pb::ListRoomsResponse>, Status> {
        let snapshot = self.snapshot(&request)?;
        let pb::ListRoomsRequest {
            page_size,
            page_token,
        } = request.into_inner();
        let (page, next_page_token) = page(snapshot.rooms(), page_size, &page_token)?;
        let rooms = page
            .into_iter()
            .map(|served| room(&snapshot, served))
            .collect();

        respond(pb::ListRoomsResponse {
            rooms,
            next_page_token,
        })
    }

    async fn get_room(
        &self,
        request: Request<pb::GetRoomRequest>,
    ) -> Result<Response<pb::Room>, Status> {
        if request.get_ref().room_revision.is_none() {
            // Answered at once, without waiting for a worker.
            let snapshot = self.snapshot(&request)?;
            let room = room(&snapshot, snapshot.room(&request.into_inner().room)?);
            return Ok(Response::new(room));
        }

        let work = |snapshot: &Snapshot, request: pb::GetRoomRequest, _: &Cancellation| {
            Ok(room(snapshot, snapshot.room(&request.room)?))
        };
        self.unary(request, |_, _| Lane::Short, work).await
    }

    async fn get_server_info(
        &self,
        request: Request<pb::GetServerInfoRequest>,
    ) -> Result<Response<pb::ServerInfo>, Status> {
        Ok(Response::new(self.info(&request)?))
    }

    async fn list_frames(
        &self,
        request: Request<pb::ListFramesRequest>,
    ) -> Result<Response<pb::ListFramesResponse>, Status> {
        self.listed_frames(request).await
    }

    async fn list_adapters(
        &self,
        request: Request<pb::ListAdaptersRequest>,
    ) -> Result<Response<pb::ListAdaptersResponse>, Status> {
        let scope = principal(&request).map(|caller| caller.rooms().clone());
        let snapshot = self.snapshot(&request)?;
        let pb::ListAdaptersRequest {
            page_size,
            page_token,
        } = request.into_inner();
        let (page, next_page_token) = page(snapshot.adapters(), page_size, &page_token)?;
        let adapters = page
            .into_iter()
            .map(|stored| adapter(stored, scope.as_ref()))
            .collect();

        respond(pb::ListAdaptersResponse {
            adapters,
            next_page_token,
        })
    }

    async fn get_adapter(
        &self,
        request: Request<pb::GetAdapterRequest>,
    ) -> Result<Response<pb::Adapter>, Status> {
        let scope = principal(&request).map(|caller| caller.rooms().clone());
        if request.get_ref().adapter_revision.is_none() {
            // Answered at once, without waiting for a worker.
            let snapshot = self.snapshot(&request)?;
            let stored = snapshot.adapter(&request.into_inner().adapter)?;
            return Ok(Response::new(adapter(stored, scope.as_ref())));
        }

        let work = move |snapshot: &Snapshot, request: pb::GetAdapterRequest, _: &Cancellation| {
            Ok(adapter(snapshot.adapter(&request.adapter)?, scope.as_ref()))
        };
        self.unary(request, |_, _| Lane::Short, work).await
    }

    type DownloadRoomStream = downloads::Messages<pb::DownloadRoomResponse>;

    async fn download_room(
        &self,
        request: Request<pb::DownloadRoomRequest>,
    ) -> Result<Response<Self::DownloadRoomStream>, Status> {
        self.downloaded_room(request).await
    }

    type DownloadAdapterStream = downloads::Messages<pb::DownloadAdapterResponse>;

    async fn download_adapter(
        &self,
        request: Request<pb::DownloadAdapterRequest>,
    ) -> Result<Response<Self::DownloadAdapterStream>, Status> {
        self.downloaded_adapter(request).await
    }

    async fn upload_room(
        &self,
        request: Request<Streaming<pb::UploadRoomRequest>>,
    ) -> Result<Response<pb::UploadRoomResponse>, Status> {
        let snapshot = self.snapshot(&request)?;
        let caller = Requester::of(&request);
        let budget = self.workers.budget(request.metadata());

        let received = self.receive_room(caller, snapshot, request.into_inner());
        let answer = tokio::time::timeout(budget, received).await;
        Ok(Response::new(answer.map_err(|_| Error::Deadline)??))
    }

    async fn upload_adapter(
        &self,
        request: Request<Streaming<pb::UploadAdapterRequest>>,
    ) -> Result<Response<pb::UploadAdapterResponse>, Status> {
        let caller = Requester::of(&request);
        let budget = self.workers.budget(request.metadata());

        let received = self.receive_adapter(caller, request.into_inner());
        let answer = tokio::time::timeout(budget, received).await;
        Ok(Response::new(answer.map_err(|_| Error::Deadline)??))
    }

    type FitAdapterStream = ReceiverStream<Result<pb::FitAdapterResponse, Status>>;

    async fn fit_adapter(
        &self,
        request: Request<pb::FitAdapterRequest>,
    ) -> Result<Response<Self::FitAdapterStream>, Status> {
        let caller = Requester::of(&request);
        let context = self.workers.context(&request);
        let admitted = self.admit_refit(&caller, request.into_inner()).await?;

        let (events, heard) = mpsc::channel(16);
        tokio::spawn(self.clone().run_refit(admitted, context, events));
        Ok(Response::new(ReceiverStream::new(heard)))
    }

    async fn list_defaults(
        &self,
        request: Request<pb::ListDefaultsRequest>,
    ) -> Result<Response<pb::ListDefaultsResponse>, Status> {
        let answer = self.listed_defaults(&Requester::of(&request)).await?;
        respond(answer)
    }

    async fn set_default(
        &self,
        request: Request<pb::SetDefaultRequest>,
    ) -> Result<Response<pb::SetDefaultResponse>, Status> {
        let caller = Requester::of(&request);
        let answer = self.set(caller, request.into_inner()).await?;
        Ok(Response::new(answer))
    }

    async fn clear_default(
        &self,
        request: Request<pb::ClearDefaultRequest>,
    ) -> Result<Response<pb::ClearDefaultResponse>, Status> {
        let caller = Requester::of(&request);
        let answer = self.clear(caller, request.into_inner()).await?;
        Ok(Response::new(answer))
    }

    async fn delete_room(
        &self,
        request: Request<pb::DeleteRoomRequest>,
    ) -> Result<Response<pb::DeleteRoomResponse>, Status> {
        let caller = Requester::of(&request);
        let answer = self.delete_room_named(caller, request.into_inner()).await?;
        Ok(Response::new(answer))
    }

    async fn delete_adapter(
        &self,
        request: Request<pb::DeleteAdapterRequest>,
    ) -> Result<Response<pb::DeleteAdapterResponse>, Status> {
        let caller = Requester::of(&request);
        let answer = self
            .delete_adapter_named(caller, request.into_inner())
            .await?;
        Ok(Response::new(answer))
    }
}

/// Page length for a requested size; 0 selects the default.
fn page_length(size: i32) -> Result<usize, Error> {
    match usize::try_from(size) {
        Ok(0) => Ok(PAGE),
        Ok(size) => Ok(size.min(LARGEST_PAGE)),
        Err(_) => Err(Error::invalid(
            "page_size",
            format!("must not be negative, got {size}"),
        )),
    }
}

/// One page of the entries, sorted by name, and the token of the next page: the last name of this
/// page, or empty on the last page.
fn page<'a, T>(
    all: &'a BTreeMap<String, T>,
    size: i32,
    token: &str,
) -> Result<(Vec<&'a T>, String), Error> {
    let size = page_length(size)?;

    // The token is the last name on the previous page. It stays valid when entries are added or
    // removed, and the server stores no paging state.
    let after = if token.is_empty() {
        Bound::Unbounded
    } else if seese3_core::room::is_plain_name(token) {
        Bound::Excluded(token)
    } else {
        return Err(Error::invalid(
            "page_token",
            "is not a token of this service; start with the first page",
        ));
    };

    // Read one more entry to find out whether another page follows.
    let mut rest = all.range::<str, _>((after, Bound::Unbounded));
    let page: Vec<(&String, &T)> = rest.by_ref().take(size).collect();
    let next = match (rest.next(), page.last()) {
        (Some(_), Some((name, _))) => (*name).clone(),
        _ => String::new(),
    };

    Ok((page.into_iter().map(|(_, entry)| entry).collect(), next))
}

fn room(snapshot: &Snapshot, served: &ServedRoom) -> pb::Room {
    let RoomSummary {
        room,
        revision,
        created,
        frame_count,
        features,
        keypoints,
        provenance,
        extent,
    } = &served.summary;
    let adapters = snapshot.adapters_of(served);
    let fit = adapters.iter().find_map(|adapter| {
        let fit = adapter.room_fit.as_ref()?;
        (fit.room == served.id).then_some(fit)
    });
    let expected_errors = fit.map_or_else(Vec::new, |fit| fit.rules.expected_errors());

    pb::Room {
        name: room.clone(),
        revision: *revision,
        frame_count: *frame_count as u32,
        adapters: adapters
            .iter()
            .map(|adapter| adapter.name.clone())
            .collect(),
        feature_sources: features.iter().map(convert::source_to_wire).collect(),
        format: provenance.format.clone(),
        license: provenance.license.clone(),
        worst_rotation_error: provenance.worst_rotation_deviation,
        create_time: convert::time_to_wire(created),
        camera: provenance.camera.as_ref().map(convert::camera_to_wire),
        extent: extent.as_ref().map(extent_to_wire),
        duration_s: extent.and_then(|extent| extent.duration_s),
        frame_rate_hz: extent.and_then(|extent| extent.frame_rate_hz),
        has_keypoints: keypoints.is_some(),
        expected_errors: expected_errors.iter().map(expected_to_wire).collect(),
    }
}

fn extent_to_wire(extent: &RecordingExtent) -> pb::Extent {
    pb::Extent {
        min: Some(convert::vector_to_wire(&extent.min.into())),
        max: Some(convert::vector_to_wire(&extent.max.into())),
    }
}

fn expected_to_wire(expected: &ExpectedError) -> pb::ExpectedError {
    pb::ExpectedError {
        feature_distance: expected.feature_distance,
        translation_m: expected.translation_m,
        rotation_rad: expected.rotation_rad,
    }
}

/// Rooms with their revisions, limited to the caller's scope.
fn revisions(
    rooms: &[(seese3_core::room::RoomId, u64)],
    scope: Option<&RoomScope>,
) -> Vec<pb::Revision> {
    rooms
        .iter()
        .filter(|(room, _)| scope.is_none_or(|scope| scope.contains(room.as_str())))
        .map(|(room, revision)| pb::Revision {
            name: room.to_string(),
            revision: *revision,
        })
        .collect()
}

fn adapter(stored: &StoredAdapter, scope: Option<&RoomScope>) -> pb::Adapter {
    let adapter = &stored.adapter;
    let record = &stored.record;
    let scale = adapter.scale();

    pb::Adapter {
        name: stored.name.clone(),
        revision: stored.revision,
        feature_source: Some(convert::source_to_wire(adapter.source())),
        latent_dim: adapter.latent_dim() as u32,
        training_rooms: revisions(&record.rooms, scope),
        preset: record.preset.clone(),
        split: convert::split_to_wire(record.split).into(),
        stride: record.stride,
        seed: record.config.seed,
        test: Some(convert::scores_to_wire(&record.test)),
        train: Some(convert::scores_to_wire(&record.train)),
        train_mean_r2: Some(record.train_mean_r2).filter(|r2| r2.is_finite()),
        target_mean: Some(convert::twist_to_wire(&Twist::from_vector(&scale.mean))),
        target_deviation: Some(convert::twist_to_wire(&Twist::from_vector(
            &scale.deviation,
        ))),
        singular_values: adapter.inverse().singular_values().to_vec(),
        create_time: convert::time_to_wire(&stored.created),
        charts: adapter.network().chart_count() as u32,
        loss: convert::loss_to_wire(record.config.loss).into(),
        navigators: convert::navigator_names(adapter),
        mixing: convert::mixing_to_wire(adapter.network().mixing()).into(),
        calibration_rooms: revisions(&record.calibrated_on, scope),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: paging through returns every entry once, in order, for any page size.
    #[test]
    fn pages_cover_everything_once() {
        let all: BTreeMap<String, usize> = (0..25).map(|i| (format!("{i:03}"), i)).collect();
        for size in [1, 7, 24, 25, 26] {
            let mut seen = Vec::new();
            let mut token = String::new();
            loop {
                let (entries, next) = page(&all, size, &token).unwrap();
                assert!(entries.len() <= size as usize);

                seen.extend(entries.into_iter().copied());
                if next.is_empty() {
                    break;
                }

                token = next;
            }

            assert_eq!(seen, (0..25).collect::<Vec<_>>(), "pages of {size}");
        }

        assert!(page(&all, -1, "").is_err());
        assert!(page(&all, 1, "no such").is_err());
    }
}
