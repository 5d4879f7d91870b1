//! Publishing rooms.

use object_store::path::Path;

use super::format::{FeaturesEntry, RoomBody};
use super::manifest::{self, ObjectRef, SCHEMA};
use super::publication::{Publication, UploadPolicy};
use super::room_files::{features_file, frames_file, names_file, read_frames};
use super::room_keypoints::{KeypointsEntry, RoomKeypoints};
use super::{ATTEMPTS, Error, Kind, Published, Store, folder_of, revision_path};
use seese3_core::features::Features;
use seese3_core::geometry::Pose;
use seese3_core::recording_extent::RecordingExtent;
use seese3_core::room::{Frames, Room, is_plain_name};
use seese3_robot::pose_filter::FilterParameters;

/// References to a room's objects, for its manifest.
struct RoomObjects {
    frames: ObjectRef,
    frame_names: Option<ObjectRef>,
    images: Option<ObjectRef>,
    features: Vec<FeaturesEntry>,
    keypoints: Option<KeypointsEntry>,
}

/// What is published as one revision of a room.
#[derive(Debug, Clone, Copy)]
pub struct RoomContents<'a> {
    /// The frames.
    pub room: &'a Room,
    /// Feature sets, one row per frame.
    pub features: &'a [Features],
    /// Keypoints of the frames.
    pub keypoints: Option<&'a RoomKeypoints>,
}

impl<'a> RoomContents<'a> {
    /// A room with features, without keypoints.
    pub fn of(room: &'a Room, features: &'a [Features]) -> Self {
        Self {
            room,
            features,
            keypoints: None,
        }
    }
}

/// Condition on the newest revision for publishing the next one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PublishPolicy {
    AnyFrames,
    SameFrames,
    /// The newest revision has this number.
    Revision(u64),
    /// The condition of an upload.
    Upload(UploadPolicy),
}

/// The body of a new revision's manifest.
fn room_body(room: &Room, objects: &RoomObjects, revision: u64) -> RoomBody {
    RoomBody {
        schema: SCHEMA,
        room: room.id().to_string(),
        revision,
        created: chrono::Utc::now().to_rfc3339(),
        frame_count: room.frame_count(),
        frames: objects.frames.clone(),
        frame_names: objects.frame_names.clone(),
        images: objects.images.clone(),
        features: objects.features.clone(),
        keypoints: objects.keypoints.clone(),
        tracking: None,
        extent: Some(RecordingExtent::of(room)),
        provenance: room.provenance().clone(),
    }
}

/// The newest revision, if it equals `body` except for the revision number, the date and the
/// extent, which follows from the frames.
fn unchanged(folder: &Path, body: &RoomBody, newest: Option<RoomBody>) -> Option<Published> {
    let newest = newest?;
    let same = RoomBody {
        revision: newest.revision,
        created: newest.created.clone(),
        extent: newest.extent,
        ..body.clone()
    };

    (same == newest).then(|| Published {
        revision: newest.revision,
        is_new: false,
        manifest: revision_path(folder, newest.revision).to_string(),
    })
}

/// The feature sets of the newest revision that this publication does not replace.
fn features_to_keep(newest: &RoomBody, published: &[FeaturesEntry]) -> Vec<FeaturesEntry> {
    let is_published = |entry: &&FeaturesEntry| {
        published
            .iter()
            .any(|other| other.source.name == entry.source.name)
    };

    newest
        .features
        .iter()
        .filter(|entry| !is_published(entry))
        .cloned()
        .collect()
}

/// The keypoints of the newest revision, unless they contradict the next one: the room has another
/// camera, or features of another encoder replace those of the same encoder pass.
fn keypoints_to_keep(newest: &RoomBody, next: &RoomBody) -> Option<KeypointsEntry> {
    let known = newest.keypoints.clone()?;
    let feature = &known.header.source.feature;
    let is_replaced = next
        .features
        .iter()
        .any(|entry| entry.source.name == feature.name && entry.source != *feature);
    let is_same_camera = next.provenance.camera == Some(known.header.camera);
    (is_same_camera && !is_replaced).then_some(known)
}

impl Store {
    /// Publishes a room with features as a new revision.
    ///
    /// If the newest revision has the same poses, whatever this call omits (other feature sets,
    /// timestamps, images and so on) is carried over. Publishing the same content again creates no
    /// revision.
    ///
    /// # Errors
    /// [`Error::FeatureRows`], [`Error::DuplicateFeatures`] or [`Error::Name`] if the features do
    /// not fit the room, see [`check_features`]; [`Error::Contended`] if other publishers took
    /// every revision number tried; [`Error::Io`] if the store cannot be written; as
    /// [`Store::load_room`] if the newest revision cannot be read.
    pub async fn publish_room(
        &self,
        room: &Room,
        features: &[Features],
    ) -> Result<Published, Error> {
        self.publish_over(RoomContents::of(room, features), PublishPolicy::AnyFrames)
            .await
    }

    /// Publishes a room with features and keypoints, like [`Store::publish_room`].
    ///
    /// # Errors
    /// [`Error::KeypointFrames`] if the keypoints are not of as many frames as the room has,
    /// otherwise as [`Store::publish_room`].
    pub async fn publish_contents(&self, contents: RoomContents<'_>) -> Result<Published, Error> {
        self.publish_over(contents, PublishPolicy::AnyFrames).await
    }

    /// Publishes an uploaded room, like [`Store::publish_contents`], under the condition `policy`.
    ///
    /// # Errors
    /// [`Error::Exists`] or [`Error::Unknown`] if the room does not satisfy `policy`; otherwise as
    /// [`Store::publish_contents`].
    pub async fn upload_contents(
        &self,
        contents: RoomContents<'_>,
        policy: UploadPolicy,
    ) -> Result<Published, Error> {
        check_features(contents.room, contents.features)?;
        // A refused upload writes nothing.
        self.check_upload(contents.room, policy).await?;
        self.publish_over(contents, PublishPolicy::Upload(policy))
            .await
    }

    /// Checks the condition of an upload, without writing. The same frames count as the same
    /// content.
    ///
    /// # Errors
    /// As [`Store::upload_contents`].
    pub async fn check_upload(&self, room: &Room, policy: UploadPolicy) -> Result<(), Error> {
        let name = room.id().as_str();
        let folder = folder_of(Kind::Room, name);
        let newest = self.revisions(&folder).await?.present.last().copied();
        if let (UploadPolicy::Create, Some(revision)) = (policy, newest) {
            let body = self.room_body(&folder, revision).await?;
            if self.has_poses(&folder, &body, room).await? {
                return Ok(());
            }
        }
        self.check_policy(Kind::Room, name, newest, policy).await
    }

    /// Publishes a room like [`Store::publish_room`], but not over a newest revision with different
    /// frames. Of several concurrent publishers of different recordings under one name, one
    /// succeeds.
    ///
    /// # Errors
    /// [`Error::OtherFrames`] if the newest revision has other frames, otherwise as
    /// [`Store::publish_room`].
    pub async fn publish_same_frames(
        &self,
        room: &Room,
        features: &[Features],
    ) -> Result<Published, Error> {
        let contents = RoomContents::of(room, features);
        self.publish_over(contents, PublishPolicy::SameFrames).await
    }

    /// Publishes a room with features and keypoints, like [`Store::publish_same_frames`].
    ///
    /// # Errors
    /// As [`Store::publish_contents`] and [`Store::publish_same_frames`].
    pub async fn publish_contents_of_same_frames(
        &self,
        contents: RoomContents<'_>,
    ) -> Result<Published, Error> {
        self.publish_over(contents, PublishPolicy::SameFrames).await
    }

    /// Publishes the newest revision of a room with other parameters of filters, or without any:
    /// that is the next revision, unless they are the same.
    ///
    /// # Errors
    /// [`Error::TrackingParameters`] for parameters that no filter can have, [`Error::Unknown`]
    /// without the room, [`Error::Contended`] if others keep publishing it.
    pub async fn publish_tracking(
        &self,
        name: &str,
        tracking: Option<FilterParameters>,
    ) -> Result<Published, Error> {
        let tracking = tracking.map(FilterParameters::without_settings);
        if let Some(Err(problem)) = tracking.map(|tracking| tracking.check()) {
            return Err(Error::TrackingParameters {
                room: name.to_owned(),
                problem,
            });
        }

        for _ in 0..ATTEMPTS {
            let publication = Publication::begin(self, Some(name)).await?;
            let (folder, revision) = self.resolve(Kind::Room, name, None).await?;
            let newest = self.room_body(&folder, revision).await?;
            let numbers = self.revisions(&folder).await?;
            // A revision that was published meanwhile would be lost.
            if numbers.present.last() != Some(&revision) {
                continue;
            }
            let body = RoomBody {
                revision: numbers.highest + 1,
                created: chrono::Utc::now().to_rfc3339(),
                tracking,
                ..newest.clone()
            };
            if let Some(unchanged) = unchanged(&folder, &body, Some(newest)) {
                return Ok(unchanged);
            }

            let manifest = revision_path(&folder, body.revision).to_string();
            let bytes = manifest::encode(&manifest, &body)?;
            if self
                .write_manifest(&publication, &folder, body.revision, bytes)
                .await?
            {
                // The objects are those of the base revision, which may have been removed.
                if self.lacks(&folder, body.objects()).await? {
                    self.retire(&folder, body.revision).await?;
                    continue;
                }
                return Ok(Published {
                    revision: body.revision,
                    is_new: true,
                    manifest,
                });
            }
        }
        Err(Error::Contended {
            name: name.to_owned(),
        })
    }

    /// Publishes a room like [`Store::publish_room`], under the condition `over`.
    ///
    /// # Errors
    /// [`Error::OtherFrames`] if the newest revision does not satisfy `over`, otherwise as
    /// [`Store::publish_room`].
    pub(super) async fn publish_over(
        &self,
        contents: RoomContents<'_>,
        over: PublishPolicy,
    ) -> Result<Published, Error> {
        let RoomContents {
            room,
            features,
            keypoints,
        } = contents;
        check_features(room, features)?;
        check_keypoints(room, keypoints)?;
        let folder = folder_of(Kind::Room, room.id().as_str());
        let publication = Publication::begin(self, Some(room.id().as_str())).await?;

        // A repeated import, for instance without images, must not lose stored data: missing
        // columns are filled in from the newest revision.
        let (room, known) = &self.with_what_is_known(&folder, room).await?;
        let contents = RoomContents { room, ..contents };

        // All objects are written before the manifest that references them. After an interruption
        // they are unreferenced.
        let objects = self
            .write_objects(&publication, &folder, contents, known.as_ref())
            .await?;

        // Optimistic concurrency: build the manifest on the newest revision and try to create the
        // next one. If another publisher was faster, retry from its revision.
        for _ in 0..ATTEMPTS {
            let numbers = self.revisions(&folder).await?;
            let newest = match numbers.present.last() {
                Some(&revision) => Some(self.room_body(&folder, revision).await?),
                None => None,
            };

            let mut body = room_body(room, &objects, numbers.highest + 1);

            // Row i of the features belongs to frame i, so earlier features remain valid while the
            // poses are the same.
            let newest_revision = newest.as_ref().map(|newest| newest.revision);
            if matches!(over, PublishPolicy::Revision(base) if Some(base) != newest_revision) {
                return Err(Error::OtherFrames {
                    room: room.id().to_string(),
                    revision: numbers.highest,
                });
            }

            if let Some(newest) = &newest {
                self.keep_from(&folder, newest, room, over, &mut body)
                    .await?;
            }

            // A fixed order makes equal content compare equal.
            body.features
                .sort_by(|a, b| a.source.name.cmp(&b.source.name));

            if let Some(unchanged) = unchanged(&folder, &body, newest) {
                self.check_stored(&publication, &folder, &body, &unchanged)
                    .await?;
                return Ok(unchanged);
            }
            if let PublishPolicy::Upload(policy) = over {
                let name = room.id().as_str();
                self.check_policy(Kind::Room, name, newest_revision, policy)
                    .await?;
            }

            let manifest = revision_path(&folder, body.revision).to_string();
            let bytes = manifest::encode(&manifest, &body)?;
            if self
                .write_manifest(&publication, &folder, body.revision, bytes)
                .await?
            {
                if !self
                    .confirm(&publication, &body, contents, known.as_ref())
                    .await?
                {
                    continue;
                }
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

    /// Checks a publication whose content is stored already. At a quota, a missing object was not
    /// written again.
    async fn check_stored(
        &self,
        publication: &Publication,
        folder: &Path,
        body: &RoomBody,
        unchanged: &Published,
    ) -> Result<(), Error> {
        if self.lacks(folder, body.objects()).await? {
            publication.check(&unchanged.manifest)?;
        }
        Ok(())
    }

    /// Adds to a new manifest what the newest revision has and the publication lacks: parameters of
    /// filters and, if the frames are the same, features and keypoints.
    ///
    /// # Errors
    /// [`Error::OtherFrames`] if the frames differ although `over` demands the same.
    async fn keep_from(
        &self,
        folder: &Path,
        newest: &RoomBody,
        room: &Room,
        over: PublishPolicy,
        body: &mut RoomBody,
    ) -> Result<(), Error> {
        body.tracking = newest.tracking;
        if newest.frames == body.frames || self.has_poses(folder, newest, room).await? {
            body.features
                .extend(features_to_keep(newest, &body.features));
            let kept = keypoints_to_keep(newest, body);
            body.keypoints = body.keypoints.take().or(kept);
        } else if over == PublishPolicy::SameFrames {
            return Err(Error::OtherFrames {
                room: room.id().to_string(),
                revision: newest.revision,
            });
        }
        Ok(())
    }

    /// Ensures that a new revision's objects exist; from now on its manifest protects them from
    /// garbage collection. Objects collected before are written again. Carried-over features cannot
    /// be: then the manifest is removed, and the result is false.
    async fn confirm(
        &self,
        publication: &Publication,
        body: &RoomBody,
        contents: RoomContents<'_>,
        known_frames: Option<&ObjectRef>,
    ) -> Result<bool, Error> {
        let folder = &folder_of(Kind::Room, &body.room);
        if !self.lacks(folder, body.objects()).await? {
            return Ok(true);
        }
        self.write_objects(publication, folder, contents, known_frames)
            .await?;
        if !self.lacks(folder, body.objects()).await? {
            return Ok(true);
        }

        self.retire(folder, body.revision).await?;
        Ok(false)
    }

    /// Writes the objects of a room. `known_frames` is the frames object of the newest revision, if
    /// it can be reused.
    async fn write_objects(
        &self,
        publication: &Publication,
        folder: &Path,
        contents: RoomContents<'_>,
        known_frames: Option<&ObjectRef>,
    ) -> Result<RoomObjects, Error> {
        let RoomContents {
            room,
            features,
            keypoints,
        } = contents;
        let write = async |stem: &str, extension, bytes| {
            self.write_object(publication, folder, stem, extension, bytes)
                .await
        };
        let write_names = async |stem, names: &[String]| match names {
            [] => Ok(None),
            names => write(stem, "json", names_file(names)?).await.map(Some),
        };

        let frames = match known_frames {
            Some(frames) => frames.clone(),
            None => write("frames", "safetensors", frames_file(room)?).await?,
        };
        let frame_names = write_names("frame-names", room.frame_names()).await?;
        let images = write_names("images", room.images()).await?;

        // Each feature set is a separate object, so that later revisions can reference it without
        // copying.
        let mut entries = Vec::with_capacity(features.len());
        for set in features {
            let stem = format!("features-{}", set.source().name);
            let object = write(&stem, "safetensors", features_file(set)?).await?;
            entries.push(FeaturesEntry {
                source: set.source().clone(),
                object,
            });
        }

        let keypoints = match keypoints {
            Some(keypoints) => {
                let bytes = keypoints.to_bytes()?;
                Some(KeypointsEntry {
                    header: keypoints.header(),
                    object: write("keypoints", "safetensors", bytes).await?,
                })
            }
            None => None,
        };

        Ok(RoomObjects {
            frames,
            frame_names,
            images,
            features: entries,
            keypoints,
        })
    }

    /// Fills in a room's empty columns from the newest revision, if that has the same poses. Also
    /// returns that revision's frames object if it already has every column of the result; then
    /// poses that differ only by rounding are not rewritten.
    async fn with_what_is_known(
        &self,
        folder: &Path,
        room: &Room,
    ) -> Result<(Room, Option<ObjectRef>), Error> {
        let Some(&newest) = self.revisions(folder).await?.present.last() else {
            return Ok((room.clone(), None));
        };
        let body = self.room_body(folder, newest).await?;

        // Different poses mean a different recording under the same name: carry over nothing.
        if !self.has_poses(folder, &body, room).await? {
            return Ok((room.clone(), None));
        }

        // An empty list loads the room without features.
        let known = self
            .load(room.id().as_str(), Some(newest), Some(&[]))
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

        // A given column takes precedence over the stored one.
        let frames = Frames {
            poses: given.poses.clone(),
            timestamps_ns: either(&given.timestamps_ns, &before.timestamps_ns),
            names: either(&given.names, &before.names),
            numbers: either(&given.numbers, &before.numbers),
            images: either(&given.images, &before.images),
            sequences: either(&given.sequences, &before.sequences),
            held_out: either(&given.held_out, &before.held_out),
        };

        // Besides the poses, the frames object has only these columns. Names and images are
        // separate objects.
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

        // The poses agree up to rounding. If the other columns are equal too, keep the stored
        // object, so that comparing revisions by checksum still finds equal frames.
        let object = (columns(&frames) == columns(before)).then_some(body.frames);
        let mut provenance = room.provenance().clone();
        // It is of the matrices that were given, not of the poses, which are the same.
        provenance.worst_rotation_deviation = known.provenance().worst_rotation_deviation;
        if provenance.license.is_empty() {
            provenance.license.clone_from(&known.provenance().license);
        }

        provenance.camera = provenance.camera.or(known.provenance().camera);

        // Image paths are relative to the images root, so both must come from the same revision.
        if given.images.is_empty() {
            provenance
                .images_root
                .clone_from(&known.provenance().images_root);
        }

        let damaged = |error: seese3_core::room::Error| Error::Damaged {
            file: self.shown(folder),
            problem: error.into(),
        };

        Ok((
            Room::new(room.id().clone(), frames, provenance).map_err(damaged)?,
            object,
        ))
    }

    /// Whether a stored revision has the same poses as `room`, up to rounding. Other columns are
    /// not compared.
    async fn has_poses(&self, folder: &Path, body: &RoomBody, room: &Room) -> Result<bool, Error> {
        let (file, bytes) = self.read_object(folder, &body.frames).await?;
        let stored = read_frames(&file, &bytes)?.poses;

        // Reading projects a stored rotation and converts it to a quaternion, so equal poses agree
        // only up to rounding.
        let same =
            |(a, b): (&Pose, &Pose)| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12;

        Ok(stored.len() == room.frame_count() && stored.iter().zip(room.poses()).all(same))
    }
}

/// Checks that keypoints can be published with a room.
fn check_keypoints(room: &Room, keypoints: Option<&RoomKeypoints>) -> Result<(), Error> {
    let frame_count = room.frame_count();
    match keypoints.map(|keypoints| keypoints.map.frames.len()) {
        Some(frames) if frames != frame_count => Err(Error::KeypointFrames {
            room: room.id().to_string(),
            frames,
            frame_count,
        }),
        _ => Ok(()),
    }
}

/// Checks that features can be published with a room. Reads and writes nothing.
///
/// # Errors
/// [`Error::Name`] if a name is not valid in a file name, [`Error::DuplicateFeatures`] if two sets
/// have the same name, [`Error::FeatureRows`] if a set does not have one row per frame.
pub fn check_features(room: &Room, features: &[Features]) -> Result<(), Error> {
    for (position, set) in features.iter().enumerate() {
        let name = set.source().name.clone();
        let rows = set.rows().nrows();

        // The name becomes part of a file name in the store.
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
