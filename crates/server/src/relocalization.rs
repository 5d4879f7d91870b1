//! LocalizationService.Relocalize: finds a camera's room and its pose there without a prior. Also
//! selects the rooms and maps for Track.

use std::sync::Arc;

use tonic::{Request, Response, Status};

use super::convert;
use super::embedding::{EmbeddedView, StoredFrames, ViewEmbedder};
use super::localization::{located_by, rooms_under};
use super::snapshot::{ServedNavigator, ServedRoom, Snapshot};
use super::workers::Lane;
use super::{Error, Handlers};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::navigation::RetrievedFrame;
use seese3_robot::tracking::{self, Map, MapQuery, RoomMatch, relocalize};
use seese3_store::StoredAdapter;

/// Default number of rooms in an answer.
const ROOMS: u32 = 3;
/// The largest number of views in one request.
const MAX_VIEWS: usize = 256;

impl Handlers {
    /// Answers a Relocalize request on a worker thread.
    pub(super) async fn relocalized(
        &self,
        request: Request<pb::RelocalizeRequest>,
    ) -> Result<Response<pb::RelocalizeResponse>, Status> {
        let most = self.config.limits.top_k;
        self.unary(
            request,
            |request| Lane::of(&request.views),
            move |snapshot, request, cancel| answer(snapshot, request, most, cancel),
        )
        .await
    }
}

fn answer(
    snapshot: &Snapshot,
    request: pb::RelocalizeRequest,
    most: u32,
    cancel: &Cancellation,
) -> Result<pb::RelocalizeResponse, Error> {
    let pb::RelocalizeRequest {
        rooms,
        adapter,
        views,
        max_rooms,
        top_k,
    } = request;

    let within = |field: &str, given: Option<u32>, plain: u32| match given.unwrap_or(plain) {
        count if (1..=most).contains(&count) => Ok(count as usize),
        count => Err(Error::invalid(
            field,
            format!("must be 1 to {most}, got {count}"),
        )),
    };

    // All rooms are compared; `shown` only limits the number of rooms in the answer.
    let shown = within("max_rooms", max_rooms, ROOMS)?;
    let top_k = within("top_k", top_k, 1)?;

    if views.is_empty() || views.len() > MAX_VIEWS {
        return Err(Error::invalid(
            "views",
            format!("must be 1 to {MAX_VIEWS}, got {}", views.len()),
        ));
    }

    let served = rooms_to_track_in(snapshot, &rooms, &adapter)?;
    let maps = maps(&served)?;
    let stored = &served[0].adapter;
    let views = embedded(views, stored, snapshot, cancel)?;
    let queries: Vec<MapQuery<'_>> = views
        .iter()
        .map(|view| MapQuery {
            latent: view.latent.view(),
            feature: view.feature.as_deref(),
        })
        .collect();
    let found = relocalize(&maps, &queries, top_k, cancel).map_err(|error| match error {
        tracking::Error::Cancelled => Error::Cancelled,
        _ => Error::Internal,
    })?;

    let newest = views.last().and_then(|view| view.feature.as_deref());
    let shown = found.rooms.iter().take(shown);
    let rooms = shown.map(|room| room_to_wire(room, &served, newest));

    Ok(pb::RelocalizeResponse {
        adapter: Some(convert::adapter_revision(&served[0])),
        rooms: rooms.collect::<Result<_, _>>()?,
        room_count: served.len() as u32,
        margin: found.margin.is_finite().then_some(found.margin),
        ambiguous: found.ambiguous,
        reason: found.reason,
    })
}

/// Embeds the views of a request. Checks for cancellation before each view, because encoding an
/// image takes time.
fn embedded(
    views: Vec<pb::View>,
    stored: &StoredAdapter,
    snapshot: &Snapshot,
    cancel: &Cancellation,
) -> Result<Vec<EmbeddedView>, Error> {
    let embedder = ViewEmbedder {
        adapter: stored,
        snapshot,
        frames: StoredFrames::Refused,
    };

    let mut embedded = Vec::with_capacity(views.len());
    for (position, view) in views.into_iter().enumerate() {
        cancel.check()?;
        embedded.push(embedder.embed(&format!("views[{position}]"), Some(view))?);
    }

    Ok(embedded)
}

/// The rooms to track or relocalize in, all under one adapter; at least one. If no adapter is
/// named, only adapters that can track in these rooms are considered: the first for a single room,
/// else the only one. A search of all rooms skips those that are too small to track in.
///
/// # Errors
/// [`Error::Invalid`] on `adapter` if several can track; else as [`rooms_under`].
pub fn rooms_to_track_in(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    let mut served = rooms_by_adapter(snapshot, rooms, adapter)?;
    if rooms.is_empty() && served.iter().any(|served| served.map.is_some()) {
        served.retain(|served| served.map.is_some());
    }

    Ok(served)
}

fn rooms_by_adapter(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    if !adapter.is_empty() {
        return rooms_under(snapshot, rooms, adapter);
    }

    let fitting = match rooms {
        [] => adapters_that_track_anywhere(snapshot),
        [room] => default_that_tracks(snapshot, room),
        several => adapters_that_track_in_all(snapshot, several),
    };

    // If no adapter can track here, `rooms_under` still selects one; `maps` then reports why it
    // cannot track.
    match fitting.as_slice() {
        [] => rooms_under(snapshot, rooms, ""),
        [only] => rooms_under(snapshot, rooms, only),
        several => {
            let problem = format!(
                "is required: {} adapters can track in these rooms ({})",
                several.len(),
                several.join(", ")
            );
            Err(Error::invalid("adapter", problem))
        }
    }
}

/// Names of the room's calibrated adapters, the default first. They can track in the room if it is
/// large enough.
fn adapters_that_track(snapshot: &Snapshot, room: &ServedRoom) -> Vec<String> {
    let adapters = snapshot.adapters_of(room);
    let tracks = |adapter: &&Arc<StoredAdapter>| adapter.adapter.error_model().is_some();

    adapters
        .iter()
        .filter(tracks)
        .map(|adapter| adapter.name.clone())
        .collect()
}

/// If no room is named: the adapters that can track in at least one room, sorted by name.
fn adapters_that_track_anywhere(snapshot: &Snapshot) -> Vec<String> {
    let mut names: Vec<String> = snapshot
        .rooms()
        .values()
        .flat_map(|room| adapters_that_track(snapshot, room))
        .collect();
    names.sort_unstable();
    names.dedup();
    names
}

/// The room's first adapter that can track, if any.
fn default_that_tracks(snapshot: &Snapshot, room: &str) -> Vec<String> {
    let mut names = snapshot
        .rooms()
        .get(room)
        .map_or_else(Vec::new, |room| adapters_that_track(snapshot, room));
    names.truncate(1);
    names
}

/// The adapters that can track in all these rooms. Rooms have no common order of preference, so the
/// names are sorted.
fn adapters_that_track_in_all(snapshot: &Snapshot, rooms: &[String]) -> Vec<String> {
    let mut named = rooms.iter().filter_map(|room| snapshot.rooms().get(room));
    let mut names = named
        .next()
        .map_or_else(Vec::new, |room| adapters_that_track(snapshot, room));
    for room in named {
        let here = adapters_that_track(snapshot, room);
        names.retain(|name| here.contains(name));
    }

    names.sort_unstable();
    names.dedup();
    names
}

/// The maps of these rooms, for tracking and relocalization.
///
/// # Errors
/// [`Error::Precondition`] if a room has no map: the adapter is not calibrated, or the room is too
/// small. The message states which.
pub fn maps(served: &[Arc<ServedNavigator>]) -> Result<Vec<Arc<Map>>, Error> {
    let map = |served: &Arc<ServedNavigator>| {
        let name = &served.adapter.name;
        let room = served.navigator.room().id();

        served.map.clone().ok_or_else(|| {
            Error::Precondition(match served.adapter.adapter.error_model() {
                None => format!(
                    "adapter '{name}' neither tracks nor relocalises: it is not calibrated in two or more rooms outside \
                     its training set; train it with --calibrate-on"
                ),
                Some(_) => format!("room '{room}' has too few distinct frames to track in"),
            })
        })
    };

    served.iter().map(map).collect()
}

/// A room match as a wire message; `newest` is the raw feature of the newest view, if it has one.
fn room_to_wire(
    found: &RoomMatch,
    served: &[Arc<ServedNavigator>],
    newest: Option<&[f32]>,
) -> Result<pb::RoomMatch, Error> {
    let served = &served[found.map];
    let room = served.navigator.room();

    // An adapter fitted to the room locates views better than the adapter that compares rooms.
    let located = match (served.room_reader(), newest) {
        (Some(reader), Some(feature)) => Some(located_by(reader, feature, room.id())?),
        _ => None,
    };

    // Distances are in standard deviations of frame noise, unlike those of Localize.
    let retrieved = |neighbour: &seese3_core::index::Neighbour| {
        let retrieved = RetrievedFrame {
            neighbour: *neighbour,
            pose: room.poses()[neighbour.frame.row()],
        };
        convert::retrieved_to_wire(&retrieved, room)
    };

    // Use the fitted adapter's pose if the views are in distribution. Otherwise use the anchor pose
    // of the newest view.
    let believed = located
        .as_ref()
        .filter(|_| found.out_of_distribution <= 1.0);
    let (pose, covariance) = match believed {
        Some(located) => (located.pose.clone(), located.covariance.clone()),
        None => {
            let anchor = &found.last.anchor.belief;
            let pose = convert::pose_to_wire(&anchor.pose, room.id().as_str());
            (
                Some(pose),
                convert::matrix_to_wire(&anchor.ros_covariance()),
            )
        }
    };

    Ok(pb::RoomMatch {
        room: Some(convert::room_revision(served)),
        distance: found.distance,
        out_of_distribution: found.out_of_distribution,
        pose,
        covariance,
        frames: found.last.nearest.iter().map(retrieved).collect(),
        located,
    })
}
