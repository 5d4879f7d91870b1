//! Changes of stored rooms: parts of them, other world frames, and joined rooms.

use std::sync::Arc;

use super::extension::{OtherFeatures, extended};
use super::room_publishing::RoomContents;
use super::{Error, RoomKeypoints, StoredRoom};
use seese3_core::features::Features;
use seese3_core::room::{FrameId, Frames, Provenance, Room, RoomId};
use seese3_core::trajectory::Similarity;

/// A changed room that is not published yet.
#[derive(Debug, Clone)]
pub struct EditedRoom {
    room: Room,
    features: Vec<Features>,
    keypoints: Option<RoomKeypoints>,
}

impl EditedRoom {
    /// A stored room under another name.
    ///
    /// # Errors
    /// [`Error::CannotEdit`] if the room is not valid.
    pub fn of(stored: &StoredRoom, name: &RoomId) -> Result<Self, Error> {
        let frames = stored.room.frames().clone();
        Ok(Self {
            room: renamed(&stored.room, name, frames, stored.room.provenance().clone())?,
            features: stored.features.clone(),
            keypoints: stored.keypoints.clone(),
        })
    }

    /// The frames in some rows, in order. A gap begins a new sequence.
    ///
    /// # Errors
    /// [`Error::CannotEdit`] without any frame.
    pub fn cropped(&self, rows: &[usize]) -> Result<Self, Error> {
        let (room, name) = (&self.room, self.room.id());
        let mut frames = room.frames().select(rows);
        frames.sequences = sequences(room, rows);
        Ok(Self {
            room: renamed(room, name, frames, room.provenance().clone())?,
            features: self.features.iter().map(|set| set.select(rows)).collect(),
            keypoints: self.keypoints.as_ref().map(|keypoints| {
                let mut map = (*keypoints.map).clone();
                map.frames = rows.iter().map(|&row| map.frames[row].clone()).collect();
                RoomKeypoints {
                    source: keypoints.source.clone(),
                    map: Arc::new(map),
                }
            }),
        })
    }

    /// The room in another world frame. A scale also changes the depths of keypoints.
    ///
    /// # Errors
    /// [`Error::CannotEdit`] if poses would not be finite.
    pub fn transformed(&self, new_from_old: &Similarity) -> Result<Self, Error> {
        let (room, name) = (&self.room, self.room.id());
        let mut frames = room.frames().clone();
        for pose in &mut frames.poses {
            *pose = new_from_old.pose(pose);
        }
        let scale = new_from_old.scale;
        Ok(Self {
            room: renamed(room, name, frames, room.provenance().clone())?,
            features: self.features.clone(),
            keypoints: self.keypoints.as_ref().map(|keypoints| {
                let mut map = (*keypoints.map).clone();
                map.unit_m *= scale;
                for frame in &mut map.frames {
                    for inverse_depth in &mut frame.inverse_depths {
                        *inverse_depth = (f64::from(*inverse_depth) / scale) as f32;
                    }
                }
                RoomKeypoints {
                    source: keypoints.source.clone(),
                    map: Arc::new(map),
                }
            }),
        })
    }

    /// The frames of this room, then those of another one in the same world frame, as sequences of
    /// their own. The result has no image paths.
    ///
    /// # Errors
    /// [`Error::CannotAdd`] if cameras, features or keypoints do not fit together.
    pub fn merged(&self, other: &Self) -> Result<Self, Error> {
        let base = StoredRoom {
            room: self.room.clone(),
            revision: 0,
            created: String::new(),
            features: self.features.clone(),
            keypoints: self.keypoints.clone(),
            tracking: None,
        };
        // Only feature sets that both rooms have.
        let has = |set: &&Features| {
            let is_like = |own: &Features| own.source().is_like(set.source());
            self.features.iter().any(is_like)
        };
        let features: Vec<Features> = other.features.iter().filter(has).cloned().collect();
        // Keypoints belong to the features of their encoder.
        let is_kept = |keypoints: &&RoomKeypoints| {
            let of_features = &keypoints.source.feature;
            features.iter().any(|set| set.source().is_like(of_features))
        };
        let joined = extended(
            &base,
            RoomContents {
                room: &other.room,
                features: &features,
                keypoints: other.keypoints.as_ref().filter(is_kept),
            },
            OtherFeatures::LeftBehind,
        )?;
        let (room, features, keypoints) = joined.into_parts();
        Ok(Self {
            room,
            features,
            keypoints,
        })
    }

    /// The room.
    pub fn room(&self) -> &Room {
        &self.room
    }

    /// What is published.
    pub fn contents(&self) -> RoomContents<'_> {
        RoomContents {
            room: &self.room,
            features: &self.features,
            keypoints: self.keypoints.as_ref(),
        }
    }
}

/// Sequence numbers of some rows of a room, which change wherever a row is left out or the room
/// begins another sequence.
fn sequences(room: &Room, rows: &[usize]) -> Vec<u32> {
    let mut number = 0;
    let mut sequences = Vec::with_capacity(rows.len());
    for (place, &row) in rows.iter().enumerate() {
        if let Some(&before) = place.checked_sub(1).and_then(|place| rows.get(place)) {
            let [before, now] = [before, row].map(|row| FrameId(row as u32));
            let follows = before.0 + 1 == now.0 && room.timeline().joins(before, now);
            number += u32::from(!follows);
        }
        sequences.push(number);
    }
    sequences
}

fn renamed(
    room: &Room,
    name: &RoomId,
    frames: Frames,
    provenance: Provenance,
) -> Result<Room, Error> {
    Room::new(name.clone(), frames, provenance).map_err(|problem| Error::CannotEdit {
        room: room.id().to_string(),
        problem: problem.into(),
    })
}
