//! The rooms of a Track stream.

use std::sync::Arc;

use super::super::Error;
use super::super::convert;
use super::super::cost::products;
use super::super::localization::asked_rooms;
use super::super::relocalization::can_track;
use super::super::snapshot::{
    ServedKeypoints, ServedNavigator, ServedRoom, Snapshot, frames_content,
};
use seese3_client::proto::v1 as pb;
use seese3_core::navigation::RetrievedFrame;
use seese3_core::room::Room;
use seese3_robot::pose_filter::FilterParameters;
use seese3_robot::tracking::Map;
use seese3_store::StoredAdapter;

/// A room in which a stream tracks its camera.
#[derive(Clone)]
pub struct TrackedRoom {
    /// The room's revision.
    pub revision: pb::Revision,
    pub room: Arc<Room>,
    /// The keypoints of the room, if it has any.
    pub keypoints: Option<ServedKeypoints>,
    /// The room under the stream's adapter; `None` for a stream without an adapter.
    pub served: Option<Arc<ServedNavigator>>,
    /// Parameters of filters that were fitted to the room.
    pub tracking: Option<FilterParameters>,
    /// SHA-256 of all frames, see [`frames_content`].
    content: [u8; 32],
}

impl TrackedRoom {
    /// A room under an adapter.
    pub fn under(served: Arc<ServedNavigator>) -> Self {
        Self {
            revision: convert::room_revision(&served),
            room: served.navigator.room().clone(),
            keypoints: served.keypoints.clone(),
            tracking: served.tracking,
            content: served.content.frames,
            served: Some(served),
        }
    }

    /// A room without an adapter. Blocks while the room is loaded.
    ///
    /// # Errors
    /// As [`ServedRoom::load`].
    fn of(served: &ServedRoom) -> Result<Self, Error> {
        let loaded = served.load()?;
        Ok(Self {
            revision: super::super::convert::served_revision(served),
            room: loaded.room.clone(),
            keypoints: loaded.keypoints.clone(),
            tracking: loaded.tracking,
            content: frames_content(&loaded.room, None, loaded.room.frame_count()),
            served: None,
        })
    }

    /// Products of coordinates when a view without an image is compared with the room.
    pub fn products(&self) -> f64 {
        let Some(served) = &self.served else {
            return 0.0;
        };
        let adapter = &served.adapter.adapter;
        let by_reader = served.room_reader().map_or(0, |_| adapter.source().dim);
        let coordinates = adapter.latent_dim() + Map::COMPONENTS + by_reader;
        products(coordinates, self.room.frame_count())
    }

    /// The adapter of the stream.
    pub fn adapter(&self) -> Option<&Arc<StoredAdapter>> {
        self.served.as_ref().map(|served| &served.adapter)
    }

    /// SHA-256 of the adapter; empty without one.
    pub fn adapter_content(&self) -> &[u8] {
        let served = self.served.as_ref();
        served.map_or(&[], |served| &served.content.adapter)
    }

    /// SHA-256 of the first `frame_count` frames, see [`frames_content`]; `None` if the room has
    /// fewer.
    pub fn frames_content(&self, frame_count: usize) -> Option<[u8; 32]> {
        if frame_count > self.room.frame_count() {
            return None;
        }

        if frame_count == self.room.frame_count() {
            return Some(self.content);
        }
        let served = self.served.as_ref();
        let latents = served.map(|served| served.navigator.latents());
        Some(frames_content(&self.room, latents, frame_count))
    }

    /// A stored frame as a wire message.
    pub fn retrieved(&self, neighbor: seese3_core::index::Neighbor) -> pb::RetrievedFrame {
        let retrieved = RetrievedFrame {
            neighbor,
            pose: self.room.poses()[neighbor.frame.row()],
        };
        convert::retrieved_to_wire(&retrieved, &self.room)
    }
}

/// The rooms of a stream that tracks by keypoints alone. `None` if an adapter is to be used:
///
/// - The configuration names one.
/// - An adapter can track in these rooms, unless the stream `was_of_keypoints` before it resumed.
/// - None of the rooms has keypoints that this server can detect, or a named one has none.
///
/// # Errors
/// [`Error::NotFound`] or [`Error::Invalid`] on the rooms; [`Error::Precondition`] if a named room
/// cannot be loaded.
pub fn rooms_with_keypoints(
    snapshot: &Snapshot,
    config: &pb::TrackConfig,
    was_of_keypoints: bool,
) -> Result<Option<Vec<TrackedRoom>>, Error> {
    let named = match config.room.as_str() {
        "" => config.rooms.clone(),
        room => vec![room.to_owned()],
    };
    let is_both = !config.room.is_empty() && !config.rooms.is_empty();
    let is_by_adapter = !was_of_keypoints && can_track(snapshot, &named);
    if is_both || !config.adapter.is_empty() || is_by_adapter {
        return Ok(None);
    }

    let asked = asked_rooms(snapshot, &named);
    let asked = asked.map_err(|error| match error {
        Error::NotFound { .. } if !config.room.is_empty() => error.named("room"),
        other => other,
    })?;
    let is_usable = |room: &&&Arc<ServedRoom>| {
        let source = room.summary.keypoints.as_ref();
        source.is_some_and(|source| snapshot.keypoint_encoder(source).is_some())
    };
    let usable: Vec<&Arc<ServedRoom>> = asked.iter().filter(is_usable).copied().collect();
    if usable.is_empty() || (!named.is_empty() && usable.len() < asked.len()) {
        return Ok(None);
    }

    let mut rooms = Vec::new();
    for room in usable {
        match TrackedRoom::of(room) {
            Ok(room) => rooms.push(room),
            // A search of all rooms skips those that cannot be loaded.
            Err(Error::Precondition(_)) if named.is_empty() => {}
            Err(error) => return Err(error),
        }
    }
    Ok((!rooms.is_empty()).then_some(rooms))
}
