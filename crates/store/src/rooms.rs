//! Loading rooms.

use object_store::path::Path;

use super::format::RoomBody;
use super::manifest::{self, ObjectRef};
use super::room_files::{read_features, read_frames, read_names};
use super::room_keypoints::{RoomKeypoints, read_keypoints};
use super::{Defaults, Error, Kind, Store, folder_of, revision_path};
use seese3_core::Cause;
use seese3_core::adapter::TrainingRecord;
use seese3_core::eval::TrainedOn;
use seese3_core::features::{FeatureSource, Features, JOINED};
use seese3_core::keypoints::KeypointSource;
use seese3_core::recording_extent::RecordingExtent;
use seese3_core::room::{Provenance, Room, RoomId};
use seese3_robot::pose_filter::FilterParameters;

/// A room loaded from the store, with its features.
#[derive(Debug, Clone)]
pub struct StoredRoom {
    /// The room.
    pub room: Room,
    /// Revision number, from 1.
    pub revision: u64,
    /// Time of publication, RFC 3339.
    pub created: String,
    /// All feature sets of the room, or only the requested ones.
    pub features: Vec<Features>,
    /// The keypoints of the room, if it has any.
    pub keypoints: Option<RoomKeypoints>,
    /// Parameters of filters that track cameras in the room, if they were fitted to it.
    pub tracking: Option<FilterParameters>,
}

impl StoredRoom {
    /// The feature set of this name, if loaded.
    pub fn features(&self, name: &str) -> Option<&Features> {
        self.features
            .iter()
            .find(|features| features.source().name == name)
    }
}

/// A summary of a room, read from its manifest alone.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomSummary {
    /// The room's name.
    pub room: String,
    /// The requested revision, or the current one.
    pub revision: u64,
    /// Time of publication, RFC 3339.
    pub created: String,
    /// The number of frames.
    pub frame_count: usize,
    /// The source of each feature set.
    pub features: Vec<FeatureSource>,
    /// The source of the keypoints, if the room has any.
    pub keypoints: Option<KeypointSource>,
    /// What the recording covers; `None` in revisions of earlier programs.
    pub extent: Option<RecordingExtent>,
    /// Origin of the recording.
    pub provenance: Provenance,
}

impl Store {
    /// Loads a room with all its features: the given revision, or the current one.
    ///
    /// # Errors
    /// [`Error::Unknown`] or [`Error::UnknownRevision`] if the room or revision does not exist,
    /// [`Error::Damaged`] if a file is truncated or altered, [`Error::Schema`] if a newer program
    /// wrote it, [`Error::Absent`] or [`Error::Io`] if a file is missing or cannot be read.
    pub async fn load_room(&self, name: &str, revision: Option<u64>) -> Result<StoredRoom, Error> {
        self.load(name, revision, None).await
    }

    /// Loads the current revision of a room with one feature set: the named one, or the only one if
    /// `features` is `None`. Several names, separated by `+` or `,`, are joined column by column in
    /// this order. The features are returned separately; the returned room's list is empty.
    ///
    /// # Errors
    /// As [`Store::load_room`]; also [`Error::UnknownFeatures`] if the room has no features of this
    /// name, and [`Error::WhichFeatures`] if no name is given and the room does not have exactly
    /// one feature set.
    pub async fn load_room_with(
        &self,
        name: &str,
        features: Option<&str>,
    ) -> Result<(StoredRoom, Features), Error> {
        let (folder, revision) = self.resolve(Kind::Room, name, None).await?;
        let body = self.room_body(&folder, revision).await?;
        let known: Vec<String> = body
            .features
            .iter()
            .map(|entry| entry.source.name.to_owned())
            .collect();

        let unknown = |wanted: &str| Error::UnknownFeatures {
            room: name.to_owned(),
            name: wanted.to_owned(),
            known: known.clone(),
        };

        // Without a name, the choice must be unambiguous.
        let wanted: Vec<&str> = match (features, known.as_slice()) {
            (Some(wanted), _) => wanted.split([JOINED, ',']).collect(),
            (None, [only]) => vec![only.as_str()],
            (None, _) => {
                return Err(Error::WhichFeatures {
                    room: name.to_owned(),
                    known: known.clone(),
                });
            }
        };
        if let Some(missing) = wanted.iter().find(|name| !known.iter().any(|k| k == *name)) {
            return Err(unknown(missing));
        }

        // Load the revision whose features were listed above; a newer one may exist by now.
        let mut stored = self.load(name, Some(revision), Some(&wanted)).await?;
        let sets = std::mem::take(&mut stored.features);
        let mut parts = Vec::with_capacity(wanted.len());
        for name in wanted {
            let set = sets.iter().find(|set| set.source().name == name);
            parts.push(set.ok_or_else(|| unknown(name))?);
        }

        match parts.as_slice() {
            [only] => Ok((stored, (*only).clone())),
            parts => {
                let features = Features::joined(parts).map_err(|problem| Error::Join {
                    room: name.to_owned(),
                    problem,
                })?;
                Ok((stored, features))
            }
        }
    }

    /// Whether an adapter was trained on a revision of a room. Frames are compared, not revision
    /// numbers, because a repeated import often creates a new revision with the same frames.
    ///
    /// # Errors
    /// As [`Store::same_frames`].
    pub async fn trained_on(
        &self,
        record: &TrainingRecord,
        room: &RoomId,
        revision: u64,
    ) -> Result<TrainedOn, Error> {
        let Some((name, trained)) = record.rooms.iter().find(|(name, _)| name == room) else {
            return Ok(TrainedOn::Nothing);
        };

        if self.same_frames(name.as_str(), *trained, revision).await? {
            Ok(TrainedOn::TheseFrames)
        } else {
            Ok(TrainedOn::OtherFrames)
        }
    }

    /// Whether two revisions of a room have the same frames. False if one of them does not exist
    /// any more.
    ///
    /// # Errors
    /// [`Error::Damaged`] if a manifest is truncated or altered, [`Error::Schema`] if a newer
    /// program wrote it, [`Error::Io`] if the store cannot be read.
    pub async fn same_frames(&self, name: &str, one: u64, other: u64) -> Result<bool, Error> {
        if one == other {
            return Ok(true);
        }

        let folder = folder_of(Kind::Room, name);
        let revisions = self.revisions(&folder).await?.present;
        if ![one, other]
            .iter()
            .all(|revision| revisions.contains(revision))
        {
            return Ok(false);
        }

        // The references contain checksums, so the frames need not be read.
        let one = self.room_body(&folder, one).await?;
        let other = self.room_body(&folder, other).await?;

        Ok(one.frames == other.frames)
    }

    /// The names of all rooms, sorted, each with its current revision under `defaults`. Reads no
    /// manifest.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed.
    pub async fn current_rooms(&self, defaults: &Defaults) -> Result<Vec<(String, u64)>, Error> {
        self.current(Kind::Room, defaults).await
    }

    /// Summaries of the current revisions of all rooms, sorted by name.
    ///
    /// # Errors
    /// [`Error::Damaged`] if a manifest is truncated or altered, [`Error::Schema`] if a newer
    /// program wrote it, [`Error::Io`] if the store cannot be read.
    pub async fn rooms(&self) -> Result<Vec<RoomSummary>, Error> {
        let mut summaries = Vec::new();
        for room in self.names(Kind::Room).await? {
            summaries.push(self.room_summary(&room, None).await?);
        }

        Ok(summaries)
    }

    /// Summary of a room: of the given revision, or of the current one.
    ///
    /// # Errors
    /// As [`Store::load_room`]. The manifest's objects are not checked.
    pub async fn room_summary(
        &self,
        name: &str,
        revision: Option<u64>,
    ) -> Result<RoomSummary, Error> {
        let (folder, revision) = self.resolve(Kind::Room, name, revision).await?;
        let body = self.room_body(&folder, revision).await?;
        let sources = body.features.into_iter().map(|entry| entry.source);

        Ok(RoomSummary {
            room: body.room,
            revision,
            created: body.created,
            frame_count: body.frame_count,
            features: sources.collect(),
            keypoints: body.keypoints.map(|entry| entry.header.source),
            extent: body.extent,
            provenance: body.provenance,
        })
    }

    pub(super) async fn load(
        &self,
        name: &str,
        revision: Option<u64>,
        only: Option<&[&str]>,
    ) -> Result<StoredRoom, Error> {
        let (folder, revision) = self.resolve(Kind::Room, name, revision).await?;
        let body = self.room_body(&folder, revision).await?;
        let (file, bytes) = self.read_object(&folder, &body.frames).await?;
        let mut frames = read_frames(&file, &bytes)?;
        frames.names = self.read_names(&folder, body.frame_names.as_ref()).await?;

        frames.images = self.read_names(&folder, body.images.as_ref()).await?;
        let manifest = self.shown(&revision_path(&folder, revision));
        let damaged = |problem: Cause| Error::Damaged {
            file: manifest.clone(),
            problem,
        };
        let id = RoomId::new(&body.room).map_err(|error| damaged(error.into()))?;

        // The checksums prove that the files are intact; `Room::new` checks that they form a valid
        // room, for instance that all columns have the same length.
        let room = Room::new(id, frames, body.provenance).map_err(|error| damaged(error.into()))?;
        let mut features = Vec::new();

        // `only` selects feature sets by name; without it, all are loaded.
        for entry in body
            .features
            .into_iter()
            .filter(|entry| only.is_none_or(|names| names.contains(&entry.source.name.as_str())))
        {
            let (file, bytes) = self.read_object(&folder, &entry.object).await?;
            let rows = read_features(&file, &bytes)?;
            let set = Features::new(entry.source, rows).map_err(|error| Error::Damaged {
                file: file.clone(),
                problem: error.into(),
            })?;

            // Each object is intact by itself; they must also match each other.
            if set.rows().nrows() != room.frame_count() {
                let problem = format!(
                    "has {} rows, the room {} frames",
                    set.rows().nrows(),
                    room.frame_count()
                );
                return Err(Error::Damaged {
                    file,
                    problem: problem.into(),
                });
            }

            features.push(set);
        }

        if let Some(tracking) = &body.tracking {
            tracking.check().map_err(|error| Error::Damaged {
                file: self.shown(&revision_path(&folder, revision)),
                problem: format!("tracking.{error}").into(),
            })?;
        }

        let keypoints = match body.keypoints {
            Some(entry) => {
                let (file, bytes) = self.read_object(&folder, &entry.object).await?;
                let frame_count = room.frame_count();
                Some(read_keypoints(&file, &bytes, entry.header, frame_count)?)
            }
            None => None,
        };

        Ok(StoredRoom {
            room,
            revision,
            created: body.created,
            features,
            keypoints,
            tracking: body.tracking,
        })
    }

    async fn read_names(
        &self,
        folder: &Path,
        object: Option<&ObjectRef>,
    ) -> Result<Vec<String>, Error> {
        let Some(object) = object else {
            return Ok(Vec::new());
        };
        let (file, bytes) = self.read_object(folder, object).await?;

        read_names(&file, &bytes)
    }

    pub(super) async fn room_body(&self, folder: &Path, revision: u64) -> Result<RoomBody, Error> {
        let path = revision_path(folder, revision);
        let file = self.shown(&path);
        let body: RoomBody = manifest::decode(&file, &self.read(&path).await?)?;
        manifest::check_place(&file, folder, (&body.room, body.revision), revision)?;

        Ok(body)
    }
}
