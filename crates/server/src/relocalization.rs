//! LocalizationService.Relocalize: finds a camera's room and its pose there without a prior. Also
//! selects the rooms and maps for Track.

use std::cmp::Reverse;
use std::sync::Arc;

use tonic::{Request, Response, Status};

use super::convert;
use super::embedding::{EmbeddedView, StoredFrames, ViewEmbedder};
use super::image_view::{ImageView, RoomTried, ViewFields, contradicted};
use super::localization::{self, LocatedPose, asked_rooms, localizer, rooms_under};
use super::snapshot::{ServedNavigator, ServedRoom, Snapshot};
use super::workers::Lane;
use super::{Error, Handlers};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::navigation::RetrievedFrame;
use seese3_core::room::RoomId;
use seese3_robot::localization::{LocatedView, NotLocated, PoseEstimate, RoomLocalizer};
use seese3_robot::tracking::{
    self, Map, MapQuery, ROOM_RATIO, Relocalization, RoomMatch, relocalize,
};
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
        camera,
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

    // The keypoints of the newest view need no adapter.
    let asked = asked_rooms(snapshot, &rooms)?;
    let newest_field = format!("views[{}]", views.len() - 1);
    let fields = ViewFields {
        view: &newest_field,
        camera: "camera",
    };
    let image = ImageView::of(snapshot, fields, views.last(), camera.as_ref(), &asked)?;
    let tried = match &image {
        Some(image) => image.matched(&asked, cancel)?,
        None => Vec::new(),
    };

    let by_latent = match rooms_with_maps(snapshot, &rooms, &adapter) {
        Err(_) if adapter.is_empty() && image.is_some() => None,
        served => Some(ByLatent::of(served?, views, top_k, snapshot, cancel)?),
    };
    ranked(tried, by_latent.as_ref(), shown)
}

/// Rooms under one adapter, each with its map.
struct RoomsWithMaps {
    served: Vec<Arc<ServedNavigator>>,
    maps: Vec<Arc<Map>>,
}

fn rooms_with_maps(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<RoomsWithMaps, Error> {
    let served = rooms_to_track_in(snapshot, rooms, adapter)?;
    let maps = maps(&served)?;
    Ok(RoomsWithMaps { served, maps })
}

/// The rooms compared by the latents of the views.
struct ByLatent {
    served: Vec<Arc<ServedNavigator>>,
    found: Relocalization,
    newest: EmbeddedView,
}

impl ByLatent {
    fn of(
        RoomsWithMaps { served, maps }: RoomsWithMaps,
        views: Vec<pb::View>,
        top_k: usize,
        snapshot: &Snapshot,
        cancel: &Cancellation,
    ) -> Result<Self, Error> {
        let mut views = embedded(views, &served[0].adapter, snapshot, cancel)?;
        let queries: Vec<MapQuery<'_>> = views.iter().map(query_of).collect();
        let found = relocalize(&maps, &queries, top_k, cancel).map_err(|error| match error {
            tracking::Error::Cancelled => Error::Cancelled,
            _ => Error::Internal,
        })?;

        let newest = views.pop().ok_or(Error::Internal)?;
        Ok(Self {
            served,
            found,
            newest,
        })
    }
}

fn query_of(view: &EmbeddedView) -> MapQuery<'_> {
    MapQuery {
        latent: view.latent.view(),
        feature: view.feature.as_deref(),
    }
}

/// Ranks the rooms: first those in which the keypoints of the newest view give a pose, by their
/// inliers, then the others by the distance of latents.
fn ranked(
    tried: Vec<RoomTried>,
    by_latent: Option<&ByLatent>,
    shown: usize,
) -> Result<pb::RelocalizeResponse, Error> {
    let was_tried: Vec<RoomId> = tried.iter().map(|tried| tried.room.id.clone()).collect();
    let mut located: Vec<(Arc<ServedRoom>, LocatedView)> = Vec::new();
    let mut unmatched = Vec::new();
    for RoomTried { room, found } in tried {
        match found {
            Ok(view) => located.push((room, view)),
            Err(why) => unmatched.push((room, why)),
        }
    }
    located.sort_by_key(|(_, view)| Reverse(view.inliers));
    if located.is_empty() {
        let contradicted = |(_, why): &(_, _)| contradicted("camera", Some(why));
        if let Some(error) = unmatched.iter().find_map(contradicted) {
            return Err(error);
        }
    }

    let mut rooms: Vec<pb::RoomMatch> = located.iter().map(located_to_wire).collect();
    if let Some(ByLatent {
        served,
        found,
        newest,
    }) = by_latent
    {
        for room in &found.rooms {
            let id = served[room.map].navigator.room().id();
            let why = unmatched.iter().find(|(tried, _)| tried.id == *id);
            let wire = room_to_wire(room, &served[room.map], newest, why.map(|(_, why)| *why))?;
            match rooms.iter_mut().find(|known| known.room == wire.room) {
                Some(known) => {
                    known.distance = wire.distance;
                    known.distance_ratio = wire.distance_ratio;
                    known.frames = wire.frames;
                }
                None => rooms.push(wire),
            }
        }
    }
    unmatched.sort_by(|(_, a), (_, b)| a.novelty().total_cmp(&b.novelty()));
    for (room, why) in &unmatched {
        let name = room.id.as_str();
        let is_known =
            |known: &pb::RoomMatch| known.room.as_ref().is_some_and(|known| known.name == name);
        if !rooms.iter().any(is_known) {
            let nowhere = RoomLocalizer::default().locate_by_similarity(None, Some(*why));
            let nowhere = LocatedPose::of(nowhere, name);
            rooms.push(match_to_wire(localization::room_to_wire(room), nowhere));
        }
    }

    let verdict = verdict(&located, by_latent, &was_tried);
    let room_count = rooms.len() as u32;
    rooms.truncate(shown);
    Ok(pb::RelocalizeResponse {
        adapter: by_latent.map(|found| convert::adapter_revision(&found.served[0])),
        rooms,
        room_count,
        margin: verdict.margin,
        ambiguous: !verdict.reason.is_empty(),
        reason: verdict.reason,
    })
}

struct Verdict {
    margin: Option<f64>,
    /// Why the best room is ambiguous; empty if it is not.
    reason: String,
}

/// Whether the best room is clear. Latents alone are not enough for a room whose keypoints do not
/// locate the newest view.
fn verdict(
    located: &[(Arc<ServedRoom>, LocatedView)],
    by_latent: Option<&ByLatent>,
    was_tried: &[RoomId],
) -> Verdict {
    let inliers = |place: usize| located.get(place).map(|(_, view)| view.inliers as f64);
    if let Some(best) = inliers(0) {
        let margin = inliers(1).map(|second| best / second);
        let is_clear = margin.is_none_or(|margin| 1.0 / margin <= ROOM_RATIO);
        let reason = if is_clear {
            String::new()
        } else {
            "nearly as many keypoints agree with the second room".to_owned()
        };
        return Verdict { margin, reason };
    }

    let Some(ByLatent { served, found, .. }) = by_latent else {
        return Verdict {
            margin: None,
            reason: "too few keypoints agree with any room".to_owned(),
        };
    };
    let best = found.rooms.first();
    let best = best.map(|room| served[room.map].navigator.room().id());
    let reason = if best.is_some_and(|best| was_tried.contains(best)) && found.reason.is_empty() {
        "too few keypoints agree with the most similar room".to_owned()
    } else {
        found.reason.clone()
    };
    Verdict {
        margin: found.margin.is_finite().then_some(found.margin),
        reason,
    }
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
        detector: None,
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

/// A room in which keypoints give a pose, as a wire message.
fn located_to_wire((room, view): &(Arc<ServedRoom>, LocatedView)) -> pb::RoomMatch {
    let estimate = PoseEstimate::matched(view.clone());
    let located = LocatedPose::of(Ok(estimate), room.id.as_str());
    match_to_wire(localization::room_to_wire(room), located)
}

fn match_to_wire(room: pb::Revision, located: LocatedPose) -> pb::RoomMatch {
    let LocatedPose {
        pose,
        novelty,
        method,
        reason: _,
        matches,
        fitted,
    } = located;
    pb::RoomMatch {
        room: Some(room),
        pose,
        novelty,
        method: method.into(),
        matches,
        fitted,
        ..Default::default()
    }
}

/// A room compared by latents, as a wire message.
fn room_to_wire(
    found: &RoomMatch,
    served: &ServedNavigator,
    newest: &EmbeddedView,
    unmatched: Option<NotLocated>,
) -> Result<pb::RoomMatch, Error> {
    let room = served.navigator.room();
    let query = query_of(newest);
    let estimate = localizer(served).locate_by_similarity(Some(query), unmatched);
    let mut located = LocatedPose::of(estimate, room.id().as_str());
    located.add_fitted(served, query.feature)?;

    // Distances are in standard deviations of frame noise, unlike those of Localize.
    let retrieved = |neighbour: &seese3_core::index::Neighbour| {
        let retrieved = RetrievedFrame {
            neighbour: *neighbour,
            pose: room.poses()[neighbour.frame.row()],
        };
        convert::retrieved_to_wire(&retrieved, room)
    };
    Ok(pb::RoomMatch {
        distance: Some(found.distance),
        distance_ratio: Some(found.out_of_distribution),
        frames: found.last.nearest.iter().map(retrieved).collect(),
        ..match_to_wire(convert::room_revision(served), located)
    })
}
