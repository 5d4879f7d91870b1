//! LocalizationService.Relocalize: finds a camera's room and its pose there without a prior. Also
//! selects the rooms and maps for Track.

use std::collections::BTreeSet;
use std::sync::Arc;

use tonic::{Request, Response, Status};

use super::convert;
use super::embedding::{EmbeddedView, StoredFrames, ViewEmbedder};
use super::image_view::{ImageView, RoomMatches, Searched, ViewFields};
use super::localization::{
    LocatedPose, asked_rooms, found_rooms, localizer, room_count, rooms_or_only,
};
use super::snapshot::{
    FoundRooms, Search, SearchedRooms, ServedNavigator, ServedRoom, ServedRooms, Snapshot,
};
use super::workers::{image_count, images_of};
use super::{Error, Handlers};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::index::JointIndex;
use seese3_core::navigation::RetrievedFrame;
use seese3_core::room::RoomId;
use seese3_robot::localization::{LocatedView, NotLocated, PoseEstimate};
use seese3_robot::tracking::{
    self, Map, MapQuery, ROOM_RATIO, Relocalization, RoomMatch, joint_map_index, relocalize,
    relocalize_jointly,
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
            |costs, request| costs.locate(&request.rooms, &request.views),
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
        room_revisions: _,
        adapter,
        adapter_revision: _,
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
    let shown = within("max_rooms", max_rooms, ROOMS.min(most))?;
    let top_k = within("top_k", top_k, 1)?;

    if views.is_empty() || views.len() > MAX_VIEWS {
        return Err(Error::invalid(
            "views",
            format!("must be 1 to {MAX_VIEWS}, got {}", views.len()),
        ));
    }

    let adapter = convert::stated_adapter(&adapter, &views)?.to_owned();

    // The keypoints of the newest view need no adapter.
    let asked = asked_rooms(snapshot, &rooms)?;
    let newest_field = format!("views[{}]", views.len() - 1);
    let fields = ViewFields {
        view: &newest_field,
        camera: "camera",
    };
    let image = ImageView::of(snapshot, fields, views.last(), camera.as_ref(), &asked)?;
    let matches = match &image {
        Some(image) => image.matched(&asked, Searched::of(&rooms), cancel)?,
        None => RoomMatches::default(),
    };

    // Then compare latents. Without them, keypoints still answer. The distances of rooms that
    // keypoints locate are shown regardless of their rank.
    let wanted = matches.rooms().next().is_none().then_some(shown);
    let compared = rooms_to_track_in(snapshot, &rooms, &adapter)
        .and_then(|served| ByLatent::of(served, views, snapshot, wanted, cancel));
    let by_latent = match compared {
        Err(Error::Precondition(_) | Error::Invalid { .. })
            if adapter.is_empty() && matches.rooms().next().is_some() =>
        {
            None
        }
        compared => Some(compared?),
    };
    ranked(
        &matches,
        by_latent.as_ref(),
        Shown {
            rooms: shown,
            frames: top_k,
        },
    )
}

/// The rooms compared by the latents of the views.
struct ByLatent {
    served: ServedRooms,
    found: Relocalization,
    newest: EmbeddedView,
}

impl ByLatent {
    /// Compares the views with all rooms, and ranks them; only the best `wanted` rooms if it is
    /// given.
    fn of(
        served: ServedRooms,
        views: Vec<pb::View>,
        snapshot: &Snapshot,
        wanted: Option<usize>,
        cancel: &Cancellation,
    ) -> Result<Self, Error> {
        let maps = maps(&served)?;
        let mut views = embedded(views, &served[0].adapter, snapshot, cancel)?;
        let queries: Vec<MapQuery<'_>> = views.iter().map(query_of).collect();
        let joint = wanted.zip(<[MapQuery<'_>; 1]>::try_from(&queries[..]).ok());
        let joint = joint.and_then(|known| Some((known, served.joint(known.0, joint_of)?)));
        let found = match joint {
            Some(((wanted, [view]), joint)) => relocalize_jointly(&maps, joint, view, wanted),
            None => relocalize(&maps, &queries, cancel),
        };
        let found = found.map_err(|error| match error {
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

impl ByLatent {
    /// The rooms with their navigators, the most similar first.
    fn rooms(&self) -> impl Iterator<Item = (&RoomMatch, &ServedNavigator)> {
        let rooms = self.found.rooms.iter();
        rooms.map(|room| (room, self.served[room.map].as_ref()))
    }
}

/// The index of the rooms' maps; `None` if it cannot be made.
fn joint_of(served: &[Arc<ServedNavigator>]) -> Option<JointIndex> {
    joint_map_index(&maps(served).ok()?).ok()?
}

fn query_of(view: &EmbeddedView) -> MapQuery<'_> {
    MapQuery {
        latent: view.latent.view(),
        feature: view.feature.as_deref(),
    }
}

/// How much an answer shows.
#[derive(Clone, Copy)]
struct Shown {
    rooms: usize,
    /// Frames of a room.
    frames: usize,
}

/// Ranks the rooms: first those in which the keypoints of the newest view give a pose, by their
/// inliers, then the others by the distance of latents.
fn ranked(
    matches: &RoomMatches,
    by_latent: Option<&ByLatent>,
    shown: Shown,
) -> Result<pb::RelocalizeResponse, Error> {
    let mut rooms: Vec<pb::RoomMatch> = matches.located.iter().map(located_to_wire).collect();
    let located: BTreeSet<&RoomId> = matches.located.iter().map(|(room, _)| &room.id).collect();
    let mut only_matched: BTreeSet<&RoomId> =
        matches.unmatched.iter().map(|(room, _)| &room.id).collect();

    for (room, served) in by_latent.iter().flat_map(|compared| compared.rooms()) {
        let id = served.navigator.room().id();
        let is_located = located.contains(id);
        only_matched.remove(id);
        if !is_located && rooms.len() >= shown.rooms {
            continue;
        }

        let why = matches.why_not_in(id);
        let newest = by_latent.map(|compared| &compared.newest);
        let newest = newest.ok_or(Error::Internal)?;
        let wire = room_to_wire(room, served, newest, shown.frames, why)?;
        match rooms.iter_mut().find(|known| known.room == wire.room) {
            Some(known) => {
                known.distance = wire.distance;
                known.distance_ratio = wire.distance_ratio;
                known.frames = wire.frames;
            }
            None => rooms.push(wire),
        }
    }

    for (room, why) in &matches.unmatched {
        if only_matched.contains(&room.id) {
            let nowhere = PoseEstimate::choose(Some(Err(*why)), || None);
            rooms.push(match_to_wire(
                convert::served_revision(room),
                LocatedPose::of(nowhere, room.id.as_str()),
            ));
        }
    }

    let verdict = verdict(matches, by_latent);
    rooms.truncate(shown.rooms);
    Ok(pb::RelocalizeResponse {
        adapter: by_latent.map(|found| convert::adapter_revision(&found.served[0])),
        rooms,
        room_count: room_count(by_latent.map(|found| &found.served), matches) as u32,
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
fn verdict(matches: &RoomMatches, by_latent: Option<&ByLatent>) -> Verdict {
    if let Some((_, best)) = matches.located.first() {
        let second = matches.located.get(1);
        let margin = second.map(|(_, second)| best.inliers as f64 / second.inliers as f64);
        let is_clear = margin.is_none_or(|margin| 1.0 / margin <= ROOM_RATIO);

        let reason = if !is_clear {
            "nearly as many keypoints agree with the second room"
        } else if !best.pose.tells_a_place() {
            "the pose is not known to within 0.5 m and 15 degrees"
        } else {
            ""
        };
        return Verdict {
            margin,
            reason: reason.to_owned(),
        };
    }

    let Some(compared) = by_latent else {
        return Verdict {
            margin: None,
            reason: "too few keypoints agree with any room".to_owned(),
        };
    };

    let best = compared.rooms().next();
    let was_tried = best.is_some_and(|(_, best)| {
        let best = best.navigator.room().id();
        matches.rooms().any(|room| room == best)
    });
    let found = &compared.found;
    let reason = if was_tried && found.reason.is_empty() {
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

    if image_count(&views) > 0 {
        let encoder = snapshot.image_encoder(stored)?;
        encoder.check_pixels("views", images_of(&views))?;
    }

    let mut embedded = Vec::with_capacity(views.len());
    for (position, view) in views.into_iter().enumerate() {
        cancel.check()?;
        embedded.push(embedder.embed(&format!("views[{position}]"), Some(view))?);
    }

    Ok(embedded)
}

/// The rooms to track or relocalize in, all under one adapter; at least one. If no adapter is
/// named, only adapters that can track in these rooms are considered: the first for a single room,
/// else the default of several. A search of all rooms skips those that are too small to track in.
///
/// # Errors
/// [`Error::Precondition`] if no adapter can track, [`Error::Invalid`] on `adapter` if several can;
/// else as [`rooms_under`].
pub fn rooms_to_track_in(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<ServedRooms, Error> {
    if rooms.is_empty() {
        let find = || found_rooms_to_track_in(snapshot, rooms, adapter);
        return snapshot.searches().rooms(Search::Track, adapter, find);
    }
    let found = found_rooms_to_track_in(snapshot, rooms, adapter)?;
    Ok(Arc::new(SearchedRooms::new(found.rooms)))
}

/// Uncached [`rooms_to_track_in`].
fn found_rooms_to_track_in(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<FoundRooms, Error> {
    let adapter = match adapter {
        "" => {
            asked_rooms(snapshot, rooms)?;
            tracking_adapter(snapshot, rooms)?.ok_or_else(|| {
                Error::Precondition(
                    "no adapter tracks or relocalizes in these rooms: none is calibrated in two or \
                     more rooms outside its training set; train one with --calibrate-on, or add \
                     keypoints to the rooms (`seese3 encode --recipe xfeat-keypoints`) and send images"
                        .to_owned(),
                )
            })?
        }
        name => name.to_owned(),
    };

    let mut found = found_rooms(snapshot, rooms, &adapter)?;
    if rooms.is_empty() && found.rooms.iter().any(|served| served.map.is_some()) {
        found.rooms.retain(|served| served.map.is_some());
    }

    Ok(found)
}

/// Whether some adapter can track in these rooms; in any room if none is named.
pub fn can_track(snapshot: &Snapshot, rooms: &[String]) -> bool {
    !matches!(tracking_adapter(snapshot, rooms), Ok(None))
}

/// The default adapter among those that can track in these rooms: the calibrated ones. `None` if
/// there is none.
///
/// # Errors
/// [`Error::Invalid`] on `adapter` if there are several.
fn tracking_adapter(snapshot: &Snapshot, rooms: &[String]) -> Result<Option<String>, Error> {
    let tracks = |adapter: &StoredAdapter| adapter.adapter.error_model().is_some();

    let rooms = &rooms_or_only(snapshot, rooms)[..];
    if let [room] = rooms {
        let adapters = snapshot.adapters_of(snapshot.room(room)?);
        let first = adapters.iter().find(|adapter| tracks(adapter));
        return Ok(first.map(|adapter| adapter.name.clone()));
    }

    match snapshot.default_across(rooms, tracks) {
        Ok(adapter) => Ok(Some(adapter.name.clone())),
        Err(Error::Precondition(_)) => Ok(None),
        Err(error) => Err(error),
    }
}

/// The maps of these rooms, for tracking and relocalization.
///
/// # Errors
/// [`Error::Precondition`] if a room has no map: the adapter is not calibrated, or the room is too
/// small. The message states which.
pub fn maps(served: &[Arc<ServedNavigator>]) -> Result<Vec<&Arc<Map>>, Error> {
    let map = |served| {
        let ServedNavigator {
            map,
            adapter,
            navigator,
            ..
        }: &ServedNavigator = served;
        map.as_ref().ok_or_else(|| {
            let name = &adapter.name;
            let room = navigator.room().id();
            Error::Precondition(match adapter.adapter.error_model() {
                None if adapter.room_fit.is_some() => format!(
                    "adapter '{name}' is fitted to room '{room}' and neither tracks nor relocalizes by itself: name none, \
                     or the calibrated adapter from which it was fitted; the fitted one locates its views"
                ),
                None => format!(
                    "adapter '{name}' neither tracks nor relocalizes: it is not calibrated in two or more rooms outside \
                     its training set; train it with --calibrate-on"
                ),
                Some(_) => format!("room '{room}' has too few distinct frames to track in"),
            })
        })
    };

    served.iter().map(AsRef::as_ref).map(map).collect()
}

/// A room in which keypoints give a pose, as a wire message.
fn located_to_wire((room, view): &(Arc<ServedRoom>, LocatedView)) -> pb::RoomMatch {
    let estimate = PoseEstimate::choose(Some(Ok(view.clone())), || None);
    let located = LocatedPose::of(estimate, room.id.as_str());
    match_to_wire(convert::served_revision(room), located)
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
    frames: usize,
    unmatched: Option<NotLocated>,
) -> Result<pb::RoomMatch, Error> {
    let room = served.navigator.room();
    let query = query_of(newest);
    let estimate = PoseEstimate::choose(unmatched.map(Err), || {
        Some(localizer(served).estimate(query))
    });
    let mut located = LocatedPose::of(estimate, room.id().as_str());
    located.add_fitted(served, query.feature)?;

    let matched = served.map.as_ref().map(|map| map.match_view(query, frames));
    // Distances are in standard deviations of frame noise, unlike those of Localize.
    let retrieved = |neighbor: &seese3_core::index::Neighbor| {
        let retrieved = RetrievedFrame {
            neighbor: *neighbor,
            pose: room.poses()[neighbor.frame.row()],
        };
        convert::retrieved_to_wire(&retrieved, room)
    };
    Ok(pb::RoomMatch {
        distance: Some(found.distance),
        distance_ratio: Some(found.out_of_distribution),
        frames: matched
            .iter()
            .flat_map(|found| &found.nearest)
            .map(retrieved)
            .collect(),
        ..match_to_wire(convert::room_revision(served), located)
    })
}
