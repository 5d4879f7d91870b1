//! Rooms in the store.

use object_store::path::Path;

use super::format::{FeaturesEntry, RoomBody};
use super::manifest::{self, ObjectRef, SCHEMA};
use super::tensors::{TensorReader, TensorWriter};
use super::{ATTEMPTS, Error, Kind, Published, Store, revision_path};
use crate::features::{FeatureSource, Features};
use crate::geometry::{Pose, nearest_rotation};
use crate::room::{Frames, Room, RoomId, is_plain_name};

/// A room as it was stored.
#[derive(Debug, Clone)]
pub struct StoredRoom {
    /// The room.
    pub room: Room,
    /// Counted from 1.
    pub revision: u64,
    /// When it was published, RFC 3339.
    pub created: String,
    /// All its features, or those that were asked for.
    pub features: Vec<Features>,
}

/// What a manifest says of a room.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomSummary {
    /// Its name.
    pub room: String,
    /// The newest revision.
    pub revision: u64,
    /// Its frames.
    pub frame_count: usize,
    /// What its features were made by.
    pub features: Vec<FeatureSource>,
}

impl Store {
    /// Publishes a room with features. What the newest revision has besides, features of other
    /// names, timestamps, images and the like, stays with the room as long as its poses are the
    /// same; publishing the same again makes no revision.
    ///
    /// # Errors
    /// [`Error::FeatureRows`], [`Error::DuplicateFeatures`], [`Error::Name`], or as the store
    /// fails.
    pub async fn publish_room(
        &self,
        room: &Room,
        features: &[Features],
    ) -> Result<Published, Error> {
        check_features(room, features)?;
        let folder = Path::from(Kind::Room.folder()).join(room.id().as_str());
        let (room, known) = &self.with_what_is_known(&folder, room).await?;

        let frames = match known {
            Some(frames) => frames.clone(),
            None => {
                self.write_object(&folder, "frames", "safetensors", frames_file(room)?)
                    .await?
            }
        };

        let frame_names = match room.frame_names() {
            [] => None,
            names => Some(
                self.write_object(&folder, "frame-names", "json", names_file(names)?)
                    .await?,
            ),
        };

        let images = match room.images() {
            [] => None,
            images => Some(
                self.write_object(&folder, "images", "json", names_file(images)?)
                    .await?,
            ),
        };

        let mut entries = Vec::with_capacity(features.len());
        for set in features {
            let stem = format!("features-{}", set.source().name);
            let object = self
                .write_object(&folder, &stem, "safetensors", features_file(set)?)
                .await?;
            entries.push(FeaturesEntry {
                source: set.source().into(),
                object,
            });
        }

        for _ in 0..ATTEMPTS {
            let newest = match self.revisions(&folder).await?.last() {
                Some(&revision) => Some(self.room_body(&folder, revision).await?),
                None => None,
            };

            let mut body = RoomBody {
                schema: SCHEMA,
                room: room.id().to_string(),
                revision: newest.as_ref().map_or(1, |body| body.revision + 1),
                created: chrono::Utc::now().to_rfc3339(),
                frame_count: room.frame_count(),
                frames: frames.clone(),
                frame_names: frame_names.clone(),
                images: images.clone(),
                features: entries.clone(),
                provenance: room.provenance().into(),
            };

            if let Some(newest) = &newest
                && (newest.frames == body.frames || self.has_poses(&folder, newest, room).await?)
            {
                let given = |entry: &FeaturesEntry| {
                    entries
                        .iter()
                        .any(|e| e.source.name() == entry.source.name())
                };

                body.features.extend(
                    newest
                        .features
                        .iter()
                        .filter(|entry| !given(entry))
                        .cloned(),
                );
            }

            body.features
                .sort_by(|a, b| a.source.name().cmp(b.source.name()));

            if let Some(newest) = newest {
                let same = RoomBody {
                    revision: newest.revision,
                    created: newest.created.clone(),
                    ..body.clone()
                };

                if same == newest {
                    let manifest = revision_path(&folder, newest.revision).to_string();
                    return Ok(Published {
                        revision: newest.revision,
                        is_new: false,
                        manifest,
                    });
                }
            }

            let manifest = revision_path(&folder, body.revision).to_string();
            if self
                .write_manifest(&folder, body.revision, manifest::encode(&manifest, &body)?)
                .await?
            {
                return Ok(Published {
                    revision: body.revision,
                    is_new: true,
                    manifest,
                });
            }
        }

        Err(Error::Contended {
            name: room.id().to_string(),
        })
    }

    /// Loads a room, its newest revision if none is named, with all its features.
    ///
    /// # Errors
    /// [`Error::Unknown`], [`Error::UnknownRevision`], [`Error::Damaged`], or as the store fails.
    pub async fn load_room(&self, name: &str, revision: Option<u64>) -> Result<StoredRoom, Error> {
        self.load(name, revision, None).await
    }

    /// Loads a room with one of its features; the only one, if no name is given.
    ///
    /// # Errors
    /// As [`Store::load_room`], and [`Error::UnknownFeatures`].
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
            .map(|entry| entry.source.name().to_owned())
            .collect();

        let unknown = |wanted: &str| Error::UnknownFeatures {
            room: name.to_owned(),
            name: wanted.to_owned(),
            known: known.clone(),
        };

        let wanted = match (features, known.as_slice()) {
            (Some(wanted), _) if known.iter().any(|name| name == wanted) => wanted.to_owned(),
            (Some(wanted), _) => return Err(unknown(wanted)),
            (None, [only]) => only.clone(),
            (None, _) => {
                return Err(Error::WhichFeatures {
                    room: name.to_owned(),
                    known: known.clone(),
                });
            }
        };

        let mut stored = self.load(name, Some(revision), Some(&wanted)).await?;
        let features = stored.features.pop().ok_or_else(|| unknown(&wanted))?;

        Ok((stored, features))
    }

    /// Whether two revisions of a room have the same frames; false when one of them is not there
    /// any more.
    ///
    /// # Errors
    /// [`Error::Damaged`], or as the store fails.
    pub async fn same_frames(&self, name: &str, one: u64, other: u64) -> Result<bool, Error> {
        if one == other {
            return Ok(true);
        }

        let folder = Path::from(Kind::Room.folder()).join(name);
        let revisions = self.revisions(&folder).await?;
        if ![one, other]
            .iter()
            .all(|revision| revisions.contains(revision))
        {
            return Ok(false);
        }

        let one = self.room_body(&folder, one).await?;
        let other = self.room_body(&folder, other).await?;

        Ok(one.frames == other.frames)
    }

    /// What the newest manifest of every room says, by name.
    ///
    /// # Errors
    /// [`Error::Damaged`], or as the store fails.
    pub async fn rooms(&self) -> Result<Vec<RoomSummary>, Error> {
        let mut summaries = Vec::new();
        for room in self.names(Kind::Room).await? {
            let (folder, revision) = self.resolve(Kind::Room, &room, None).await?;
            let body = self.room_body(&folder, revision).await?;
            let features = body
                .features
                .into_iter()
                .map(|entry| entry.source.into())
                .collect();

            summaries.push(RoomSummary {
                room,
                revision,
                frame_count: body.frame_count,
                features,
            });
        }

        Ok(summaries)
    }

    /// A room with what the newest revision knows of the same frames and it does not say itself;
    /// and that revision's object of frames, where it says all of it: poses that are the same but
    /// for rounding are not written again.
    async fn with_what_is_known(
        &self,
        folder: &Path,
        room: &Room,
    ) -> Result<(Room, Option<ObjectRef>), Error> {
        let Some(&newest) = self.revisions(folder).await?.last() else {
            return Ok((room.clone(), None));
        };
        let body = self.room_body(folder, newest).await?;

        if !self.has_poses(folder, &body, room).await? {
            return Ok((room.clone(), None));
        }

        let known = self
            .load(room.id().as_str(), Some(newest), Some(""))
            .await?
            .room;

        fn either<T: Clone>(given: &[T], known: &[T]) -> Vec<T> {
            if given.is_empty() {
                known.to_vec()
            } else {
                given.to_vec()
            }
        }

        let given = room.frames();
        let before = known.frames();

        let frames = Frames {
            poses: given.poses.clone(),
            timestamps_ns: either(&given.timestamps_ns, &before.timestamps_ns),
            names: either(&given.names, &before.names),
            numbers: either(&given.numbers, &before.numbers),
            images: either(&given.images, &before.images),
            sequences: either(&given.sequences, &before.sequences),
            held_out: either(&given.held_out, &before.held_out),
        };

        let columns = |frames: &Frames| {
            let Frames {
                timestamps_ns,
                numbers,
                sequences,
                held_out,
                ..
            } = frames.clone();

            (timestamps_ns, numbers, sequences, held_out)
        };

        let object = (columns(&frames) == columns(before)).then_some(body.frames);
        let mut provenance = room.provenance().clone();
        if provenance.licence.is_empty() {
            provenance.licence.clone_from(&known.provenance().licence);
        }

        if given.images.is_empty() {
            provenance
                .images_root
                .clone_from(&known.provenance().images_root);
        }

        let damaged = |error: crate::room::Error| Error::Damaged {
            file: self.shown(folder),
            problem: error.to_string(),
        };

        Ok((
            Room::new(room.id().clone(), frames, provenance).map_err(damaged)?,
            object,
        ))
    }

    /// Whether a stored revision has a room's poses, whatever else it says of the frames.
    async fn has_poses(&self, folder: &Path, body: &RoomBody, room: &Room) -> Result<bool, Error> {
        let (file, bytes) = self.read_object(folder, &body.frames).await?;
        let stored = read_frames(&file, &bytes)?.poses;
        let same =
            |(a, b): (&Pose, &Pose)| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12;

        Ok(stored.len() == room.frame_count() && stored.iter().zip(room.poses()).all(same))
    }

    async fn load(
        &self,
        name: &str,
        revision: Option<u64>,
        only: Option<&str>,
    ) -> Result<StoredRoom, Error> {
        let (folder, revision) = self.resolve(Kind::Room, name, revision).await?;
        let body = self.room_body(&folder, revision).await?;
        let (file, bytes) = self.read_object(&folder, &body.frames).await?;
        let mut frames = read_frames(&file, &bytes)?;
        frames.names = self.read_names(&folder, body.frame_names.as_ref()).await?;

        frames.images = self.read_names(&folder, body.images.as_ref()).await?;
        let manifest = self.shown(&revision_path(&folder, revision));
        let damaged = |problem: String| Error::Damaged {
            file: manifest.clone(),
            problem,
        };
        let id = RoomId::new(&body.room).map_err(|error| damaged(error.to_string()))?;

        let room = Room::new(id, frames, body.provenance.into())
            .map_err(|error| damaged(error.to_string()))?;
        let mut features = Vec::new();
        for entry in body
            .features
            .into_iter()
            .filter(|entry| only.is_none_or(|name| name == entry.source.name()))
        {
            let (file, bytes) = self.read_object(&folder, &entry.object).await?;
            let rows = TensorReader::new(&file, &bytes)?.f32("features")?;
            let set = Features::new(entry.source.into(), rows).map_err(|error| Error::Damaged {
                file: file.clone(),
                problem: error.to_string(),
            })?;

            if set.rows().nrows() != room.frame_count() {
                let problem = format!(
                    "has {} rows, the room {} frames",
                    set.rows().nrows(),
                    room.frame_count()
                );
                return Err(Error::Damaged { file, problem });
            }

            features.push(set);
        }

        Ok(StoredRoom {
            room,
            revision,
            created: body.created,
            features,
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

        serde_json::from_slice(&bytes).map_err(|error| Error::Damaged {
            file,
            problem: error.to_string(),
        })
    }

    async fn room_body(&self, folder: &Path, revision: u64) -> Result<RoomBody, Error> {
        let path = revision_path(folder, revision);
        let file = self.shown(&path);
        let body: RoomBody = manifest::decode(&file, &self.read(&path).await?)?;
        manifest::check_place(&file, folder, (&body.room, body.revision), revision)?;

        Ok(body)
    }
}

/// Refuses features that could not be published with a room, before anything is written.
///
/// # Errors
/// [`Error::Name`], [`Error::DuplicateFeatures`] or [`Error::FeatureRows`].
pub fn check_features(room: &Room, features: &[Features]) -> Result<(), Error> {
    for (position, set) in features.iter().enumerate() {
        let name = set.source().name.clone();
        let rows = set.rows().nrows();

        if !is_plain_name(&name) {
            return Err(Error::Name {
                what: "features",
                name,
            });
        }

        if features[..position]
            .iter()
            .any(|other| other.source().name == name)
        {
            return Err(Error::DuplicateFeatures { name });
        }

        if rows != room.frame_count() {
            let frame_count = room.frame_count();
            let room = room.id().to_string();

            return Err(Error::FeatureRows {
                name,
                rows,
                room,
                frame_count,
            });
        }
    }

    Ok(())
}

fn frames_file(room: &Room) -> Result<Vec<u8>, Error> {
    let n = room.frame_count();
    let mut tensors = TensorWriter::default();

    let rows = room
        .poses()
        .iter()
        .flat_map(|pose| pose.to_homogeneous().transpose().as_slice().to_vec());
    tensors.f64("world_from_camera", &[n, 4, 4], rows);

    if !room.timestamps_ns().is_empty() {
        tensors.i64("timestamps_ns", &[n], room.timestamps_ns().iter().copied());
    }

    let frames = room.frames();
    for (name, values) in [
        ("numbers", frames.numbers.clone()),
        (
            "sequences",
            frames
                .sequences
                .iter()
                .map(|&sequence| i64::from(sequence))
                .collect(),
        ),
        (
            "held_out",
            frames
                .held_out
                .iter()
                .map(|&held_out| i64::from(held_out))
                .collect(),
        ),
    ] {
        if !values.is_empty() {
            tensors.i64(name, &[n], values.into_iter());
        }
    }

    tensors.finish("frames")
}

fn names_file(names: &[String]) -> Result<Vec<u8>, Error> {
    serde_json::to_vec(names).map_err(|error| Error::Damaged {
        file: "frame-names".to_owned(),
        problem: error.to_string(),
    })
}

fn features_file(features: &Features) -> Result<Vec<u8>, Error> {
    let rows = features.rows();
    let mut tensors = TensorWriter::default();
    tensors.f32(
        "features",
        &[rows.nrows(), rows.ncols()],
        rows.iter().copied(),
    );

    tensors.finish("features")
}

fn read_frames(file: &str, bytes: &[u8]) -> Result<Frames, Error> {
    let tensors = TensorReader::new(file, bytes)?;

    let damaged = |problem: String| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let matrices = tensors.f64("world_from_camera")?;
    if matrices.ncols() != 16 {
        return Err(damaged("'world_from_camera' is not (n, 4, 4)".to_owned()));
    }

    let pose = |(row, matrix): (usize, ndarray::ArrayView1<'_, f64>)| {
        let m = nalgebra::Matrix4::from_row_iterator(matrix.iter().copied());
        let rotation = nearest_rotation(&m.fixed_view::<3, 3>(0, 0).into_owned());
        let rotation = rotation
            .ok_or_else(|| damaged(format!("frame {row} has no rotation")))?
            .rotation;
        let quaternion = nalgebra::UnitQuaternion::from_rotation_matrix(&rotation);

        Ok(Pose::from_parts(
            m.fixed_view::<3, 1>(0, 3).into_owned().into(),
            quaternion,
        ))
    };

    let poses = matrices
        .outer_iter()
        .enumerate()
        .map(pose)
        .collect::<Result<_, Error>>()?;

    let column = |name: &str| -> Result<Vec<i64>, Error> {
        Ok(if tensors.has(name) {
            tensors.i64(name)?.iter().copied().collect()
        } else {
            Vec::new()
        })
    };

    let sequence = |value: i64| {
        u32::try_from(value).map_err(|_| damaged(format!("{value} numbers no sequence")))
    };

    Ok(Frames {
        poses,
        timestamps_ns: column("timestamps_ns")?,
        numbers: column("numbers")?,
        sequences: column("sequences")?
            .into_iter()
            .map(sequence)
            .collect::<Result<_, _>>()?,
        held_out: column("held_out")?
            .into_iter()
            .map(|mark| mark != 0)
            .collect(),
        names: Vec::new(),
        images: Vec::new(),
    })
}

impl StoredRoom {
    /// The features of this name.
    pub fn features(&self, name: &str) -> Option<&Features> {
        self.features
            .iter()
            .find(|features| features.source().name == name)
    }
}
