//! LocalizationService.Relocalize.

use std::sync::Arc;

use super::convert;
use super::localization::rooms_under;
use super::snapshot::{ServedNavigator, Snapshot};
use super::status::view_error;
use super::{Error, Handlers};
use crate::cancel::Cancellation;
use crate::navigation::{Hit, Source};
use crate::odometry::{self, Map, RoomMatch, View, relocalize};
use crate::proto::v1 as pb;

/// Rooms in an answer that does not say how many.
const ROOMS: u32 = 3;
/// The most views of one request.
const MAX_VIEWS: usize = 256;

impl Handlers {
    /// Answers on a blocking thread.
    pub(super) async fn relocalized(
        &self,
        request: tonic::Request<pb::RelocalizeRequest>,
    ) -> Result<pb::RelocalizeResponse, Error> {
        let snapshot = self.snapshot()?;
        let most = self.config.limits.hits;
        let budget = self.workers.budget(request.metadata());
        let request = request.into_inner();

        self.workers
            .run(budget, move |cancel| {
                answer(&snapshot, request, most, cancel)
            })
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
        room_count,
        hit_count,
    } = request;

    let within = |field: &str, given: Option<u32>, plain: u32| match given.unwrap_or(plain) {
        count if (1..=most).contains(&count) => Ok(count as usize),
        count => Err(Error::invalid(
            field,
            format!("must be 1 to {most}, got {count}"),
        )),
    };

    let shown = within("room_count", room_count, ROOMS)?;
    let hits = within("hit_count", hit_count, 1)?;

    if views.is_empty() || views.len() > MAX_VIEWS {
        return Err(Error::invalid(
            "views",
            format!("must be 1 to {MAX_VIEWS}, got {}", views.len()),
        ));
    }

    let served = rooms_to_track_in(snapshot, &rooms, &adapter)?;
    let maps = maps(&served)?;
    let stored = &served[0].adapter;
    let mut latents = Vec::with_capacity(views.len());

    for (position, view) in views.into_iter().enumerate() {
        cancel.check()?;
        let field = format!("views[{position}]");

        let view = match convert::source(&field, Some(view), stored, snapshot)? {
            Source::Feature(feature) => View::Feature(feature),
            Source::Latent(latent) => View::Latent(latent),
            Source::Frame(_) => {
                return Err(Error::invalid(
                    format!("{field}.frame_id"),
                    "is a frame of a room, not what a camera sees",
                ));
            }
        };

        latents.push(
            view.latent(&stored.adapter)
                .map_err(|error| view_error(&error).within(&field))?,
        );
    }

    let found = relocalize(&maps, &latents, hits, cancel).map_err(|error| match error {
        odometry::Error::Cancelled => Error::Cancelled,
        _ => Error::Internal,
    })?;

    Ok(pb::RelocalizeResponse {
        adapter: Some(convert::adapter_revision(&served[0])),
        rooms: found
            .rooms
            .iter()
            .take(shown)
            .map(|room| room_to_wire(room, &served))
            .collect(),
        room_count: served.len() as u32,
        margin: found.margin.is_finite().then_some(found.margin),
        ambiguous: found.ambiguous,
        reason: found.reason,
    })
}

/// Rooms under one adapter, whose errors were measured if none is named.
///
/// # Errors
/// As [`rooms_under`].
pub fn rooms_to_track_in(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    if !adapter.is_empty() {
        return rooms_under(snapshot, rooms, adapter);
    }

    let mut fitting: Option<Vec<&str>> = None;
    for served in snapshot
        .rooms()
        .iter()
        .filter(|(name, _)| rooms.is_empty() || rooms.contains(name))
        .map(|(_, room)| room)
    {
        let here: Vec<&str> = served
            .navigators
            .iter()
            .filter(|n| n.map.is_some())
            .map(|n| n.adapter.name.as_str())
            .collect();

        match (&mut fitting, rooms.is_empty()) {
            (Some(fitting), false) => fitting.retain(|name| here.contains(name)),
            (Some(fitting), true) => fitting.extend(here),
            (none, _) => *none = Some(here),
        }
    }

    let mut fitting = fitting.unwrap_or_default();

    // The newest is the default in one room; several rooms have no newest that is the same.
    if rooms.len() == 1 {
        fitting.truncate(1);
    }

    fitting.sort_unstable();
    fitting.dedup();

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

/// The rooms as maps.
///
/// # Errors
/// [`Error::Precondition`], which says what is missing.
pub fn maps(served: &[Arc<ServedNavigator>]) -> Result<Vec<Arc<Map>>, Error> {
    let map = |served: &Arc<ServedNavigator>| {
        let name = &served.adapter.name;
        let room = served.navigator.room().id();

        served.map.clone().ok_or_else(|| {
            Error::Precondition(match served.adapter.adapter.calibration() {
                None => format!(
                    "adapter '{name}' neither tracks nor relocalises: its errors were not measured in two or more rooms that \
                     it did not learn from; train it with --calibrate-on"
                ),
                Some(_) => format!("room '{room}' is too small to be told from others: no frame is apart from the rest"),
            })
        })
    };

    served.iter().map(map).collect()
}

fn room_to_wire(found: &RoomMatch, served: &[Arc<ServedNavigator>]) -> pb::RoomMatch {
    let served = &served[found.map];
    let room = served.navigator.room();

    let hit = |neighbour: &crate::index::Neighbour| {
        let hit = Hit {
            neighbour: *neighbour,
            pose: room.poses()[neighbour.frame.row()],
        };
        convert::hit_to_wire(&hit, room)
    };

    let anchor = &found.last.anchor;
    pb::RoomMatch {
        room: Some(convert::room_revision(served)),
        distance: found.distance,
        out_of_distribution: found.out_of_distribution,
        pose: Some(convert::pose_to_wire(&anchor.pose, room.id().as_str())),
        covariance: convert::matrix_to_wire(&anchor.ros_covariance()),
        hits: found.last.nearest.iter().map(hit).collect(),
    }
}
