//! Recordings of rooms in which cameras are tracked.

use rayon::prelude::*;

use seese3_core::features::Features;
use seese3_core::room::Room;
use seese3_lab::experiments::tracked_room::{KeypointRecording, TrackedRoom, TrackingProtocol};
use seese3_robot::pose_filter::FilterParameters;

use super::super::rooms::{data, load_rooms, room_names};
use super::keypoint_views::KeypointViews;
use super::say_leaks;
use seese3_core::geometry::CameraIntrinsics;
use seese3_encoder::Encoded;
use seese3_store::{Store, StoredAdapter, StoredRoom};

/// Recordings of rooms, with what locates their views.
pub enum Recordings {
    /// An adapter, by features.
    Adapter {
        adapter: Box<StoredAdapter>,
        rooms: Vec<(StoredRoom, Features)>,
    },
    /// Keypoints.
    Keypoints(Vec<KeypointRoom>),
}

/// A room with the keypoints of all its frames.
pub struct KeypointRoom {
    room: Room,
    camera: CameraIntrinsics,
    encoded: Encoded,
    tracking: Option<FilterParameters>,
}

impl Recordings {
    /// Loads rooms; without an adapter, their images are encoded again.
    pub async fn load(
        store: &Store,
        names: &[String],
        adapter: Option<&str>,
        views: &KeypointViews,
    ) -> anyhow::Result<Self> {
        if let Some(adapter) = adapter {
            views.refuse_images()?;
            let adapter = store.load_adapter(adapter, None).await?;
            let source = adapter.adapter.source().name.clone();
            let rooms = load_rooms(store, names, Some(&source)).await?;
            say_leaks(&rooms, &adapter.record);
            let adapter = Box::new(adapter);
            return Ok(Self::Adapter { adapter, rooms });
        }

        let mut rooms = Vec::new();
        for name in room_names(store, names).await? {
            let stored = store.load_room(&name, None).await?;
            let (keypoints, encoded) = views.encode_matchable(&stored)?;
            rooms.push(KeypointRoom {
                camera: keypoints.map.camera,
                tracking: stored.tracking,
                room: stored.room,
                encoded,
            });
        }
        Ok(Self::Keypoints(rooms))
    }

    /// Maps a part of each room. `protocol` is given the room's own parameters of filters.
    pub fn tracked(
        &self,
        protocol: &(dyn Fn(Option<FilterParameters>) -> TrackingProtocol + Sync),
    ) -> anyhow::Result<Vec<TrackedRoom<'_>>> {
        let tracked: Result<_, _> = match self {
            Self::Adapter { adapter, rooms } => rooms
                .par_iter()
                .map(|room| {
                    let protocol = protocol(room.0.tracking);
                    TrackedRoom::by_adapter(&data(room), &adapter.adapter, &protocol)
                })
                .collect(),
            Self::Keypoints(rooms) => rooms
                .par_iter()
                .map(|room| {
                    let recording = KeypointRecording {
                        room: &room.room,
                        features: room.encoded.rows.view(),
                        keypoints: &room.encoded.keypoints,
                        camera: room.camera,
                    };
                    TrackedRoom::by_keypoints(&recording, &protocol(room.tracking))
                })
                .collect(),
        };
        Ok(tracked?)
    }

    /// A description of what locates the views.
    pub fn words(&self) -> String {
        match self {
            Self::Adapter { adapter, .. } => {
                format!("adapter '{}' revision {}", adapter.name, adapter.revision)
            }
            Self::Keypoints(_) => "matched keypoints, no adapter".to_owned(),
        }
    }
}
