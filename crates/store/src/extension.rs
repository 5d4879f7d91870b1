//! Adds frames to a stored room, for instance a robot's own frames of unmapped places.

use std::ops::Range;
use std::sync::Arc;

use ndarray::{Axis, concatenate};

use super::room_keypoints::RoomKeypoints;
use super::room_publishing::{PublishPolicy, RoomContents};
use super::{
    ATTEMPTS, Error, Kind, Published, RoomSummary, Store, StoredRoom, check_features, revision_path,
};
use crate::folder_of;
use seese3_core::Cause;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::Pose;
use seese3_core::keypoints::KeypointSource;
use seese3_core::room::{Frames, Provenance, Room};
use seese3_robot::matched_views::MappedKeypoints;

/// Handling of feature sets for which no rows are added.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OtherFeatures {
    /// Added rows are required for every feature set.
    Required,
    /// The new revision omits the other feature sets. Earlier revisions keep them.
    LeftBehind,
}

/// The part of added frames that does not fit a room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AddedPart {
    /// The frames: poses, timestamps, names or segments.
    Frames,
    /// The feature sets.
    Features,
    /// The camera.
    Camera,
    /// The keypoints.
    Keypoints,
}

/// An extended room that is not published yet.
#[derive(Debug)]
pub struct ExtendedRoom {
    room: Room,
    features: Vec<Features>,
    keypoints: Option<RoomKeypoints>,
    /// The revision that was extended.
    base: u64,
    /// Whether the room already had the frames.
    is_there: bool,
}

impl Store {
    /// Summary of the newest revision of a room, even if another one is the default.
    ///
    /// # Errors
    /// As [`Store::room_summary`].
    pub async fn newest_room_summary(&self, name: &str) -> Result<RoomSummary, Error> {
        let revisions = self.revisions(&folder_of(Kind::Room, name)).await?;
        self.room_summary(name, revisions.present.last().copied())
            .await
    }

    /// Appends the frames of `addition`, with their features and keypoints, to the newest revision
    /// of the room of the same name. Publishes nothing.
    ///
    /// The added frames are separate sequences. The result has no image paths, because the added
    /// frames have none. Known frames keep their keypoints.
    ///
    /// # Errors
    /// [`Error::Unknown`] if there is no such room, [`Error::CannotAdd`] if the frames are not
    /// compatible with its own or it already has a part of them, otherwise as [`check_features`]
    /// and [`Store::load_room`].
    pub async fn extended_room(
        &self,
        addition: RoomContents<'_>,
        others: OtherFeatures,
    ) -> Result<ExtendedRoom, Error> {
        check_features(addition.room, addition.features)?;
        let name = addition.room.id().as_str();
        let folder = folder_of(Kind::Room, name);
        let newest = self.revisions(&folder).await?.present.last().copied();
        let base = self.load_room(name, newest).await?;

        extended(&base, addition, others)
    }

    /// Extends the newest revision of a room, as [`Store::extended_room`], and publishes the
    /// result. If the room already has all of the frames, one after the other, nothing is
    /// published.
    ///
    /// # Errors
    /// As [`Store::extended_room`] and [`Store::publish_room`].
    pub async fn extend_room(
        &self,
        addition: RoomContents<'_>,
        others: OtherFeatures,
    ) -> Result<Published, Error> {
        for _ in 0..ATTEMPTS {
            let ExtendedRoom {
                room,
                features,
                keypoints,
                base,
                is_there,
            } = self.extended_room(addition, others).await?;

            if is_there {
                let folder = folder_of(Kind::Room, room.id().as_str());
                return Ok(Published {
                    revision: base,
                    is_new: false,
                    manifest: revision_path(&folder, base).to_string(),
                });
            }

            // If another publisher was faster, retry: append the frames to its revision.
            let contents = RoomContents {
                room: &room,
                features: &features,
                keypoints: keypoints.as_ref(),
            };
            match self
                .publish_over(contents, PublishPolicy::Revision(base))
                .await
            {
                Err(Error::OtherFrames { .. }) => {}
                published => return published,
            }
        }

        Err(Error::Contended {
            name: addition.room.id().to_string(),
        })
    }
}

impl ExtendedRoom {
    /// The room, its features and its keypoints.
    pub(super) fn into_parts(self) -> (Room, Vec<Features>, Option<RoomKeypoints>) {
        (self.room, self.features, self.keypoints)
    }
}

/// Appends the frames of `addition` to those of `base`.
pub(super) fn extended(
    base: &StoredRoom,
    addition: RoomContents<'_>,
    others: OtherFeatures,
) -> Result<ExtendedRoom, Error> {
    let RoomContents {
        room: addition,
        features: added_features,
        keypoints: added_keypoints,
    } = addition;
    let refused = |part: AddedPart, problem: Cause| Error::CannotAdd {
        room: base.room.id().to_string(),
        part,
        problem,
    };
    let of_keypoints = |problem: String| refused(AddedPart::Keypoints, problem.into());

    let features = joined_features(base, added_features, others)
        .map_err(|problem| refused(AddedPart::Features, problem.into()))?;
    let is_known = |row, added| same_frame(base, row, addition, added, &features);
    if features.len() == base.features.len()
        && let Some(rows) = known_rows(base, addition, is_known)
    {
        let is_there = added_keypoints
            .is_none_or(|added| has_keypoints(base.keypoints.as_ref(), rows.clone(), added));
        let keypoints = if is_there {
            base.keypoints.clone()
        } else {
            joined_keypoints(base, rows, added_keypoints).map_err(of_keypoints)?
        };
        return Ok(ExtendedRoom {
            room: base.room.clone(),
            features: base.features.clone(),
            keypoints,
            base: base.revision,
            is_there,
        });
    }
    if let Some(repeated) = first_repeated(base, addition, is_known) {
        let problem = format!(
            "the room already has some of the added frames, the first of them row {repeated} of the addition: \
             send only the others"
        );
        return Err(refused(AddedPart::Frames, problem.into()));
    }
    let frames = joined_frames(base.room.frames(), addition.frames())
        .map_err(|problem| refused(AddedPart::Frames, problem.into()))?;

    let provenance = joined_provenance(base.room.provenance(), addition.provenance())
        .map_err(|problem| refused(AddedPart::Camera, problem.into()))?;
    let room = Room::new(base.room.id().clone(), frames, provenance)
        .map_err(|error| refused(AddedPart::Frames, error.into()))?;
    let known = base.room.frame_count();
    let rows = known..known + addition.frame_count();
    let keypoints = joined_keypoints(base, rows, added_keypoints).map_err(of_keypoints)?;
    let is_of_features = |keypoints: &RoomKeypoints| {
        let name = &keypoints.source.feature.name;
        features.iter().any(|set| set.source().name == *name)
    };
    let keypoints = keypoints.filter(is_of_features);
    Ok(ExtendedRoom {
        room,
        features,
        keypoints,
        base: base.revision,
        is_there: false,
    })
}

/// The origin of the room with the added frames.
fn joined_provenance(known: &Provenance, added: &Provenance) -> Result<Provenance, String> {
    let problem = match (&added.camera, &known.camera) {
        (Some(added), Some(known)) => known.difference(added),
        _ => None,
    };
    if let Some(problem) = problem {
        return Err(format!("their camera {problem}; make a room of their own"));
    }

    Ok(Provenance {
        images_root: String::new(),
        worst_rotation_deviation: known
            .worst_rotation_deviation
            .max(added.worst_rotation_deviation),
        ..known.clone()
    })
}

/// The keypoints of the room with those of the added frames, which are in `rows` of the joined
/// room. Frames without keypoints are among them if only the room or only the addition has
/// keypoints; `None` if neither has.
fn joined_keypoints(
    base: &StoredRoom,
    rows: Range<usize>,
    added: Option<&RoomKeypoints>,
) -> Result<Option<RoomKeypoints>, String> {
    let frame_count = base.room.frame_count().max(rows.end);
    let added = added
        .map(|added| with_features_of(base, added))
        .transpose()?;

    let (mut joined, added_frames) = match (base.keypoints.clone(), added) {
        (None, None) => return Ok(None),
        (Some(known), None) => (known, Vec::new()),
        (None, Some(mut added)) => {
            let frames = std::mem::take(&mut Arc::make_mut(&mut added.map).frames);
            (added, frames)
        }
        (Some(mut known), Some(added)) => {
            let without_file = |source: &KeypointSource| KeypointSource {
                model_file: String::new(),
                ..source.clone()
            };
            if without_file(&known.source) != without_file(&added.source) {
                return Err(
                    "their keypoints were detected by another encoder, or from other outputs, than those of the \
                     room; encode them in the same way, or leave the keypoints out"
                        .to_owned(),
                );
            }

            let map = Arc::make_mut(&mut known.map);
            let count = map.frames.len();
            map.append(&added.map).map_err(|error| error.to_string())?;
            let frames = map.frames.split_off(count);
            (known, frames)
        }
    };

    // Known frames keep their keypoints.
    let frames = &mut Arc::make_mut(&mut joined.map).frames;
    frames.resize(frame_count, MappedKeypoints::default());
    for (row, frame) in rows.zip(added_frames) {
        if frames[row].is_empty() {
            frames[row] = frame;
        }
    }

    Ok(Some(joined))
}

/// Whether the frames in `rows` have keypoints wherever the added ones have.
fn has_keypoints(known: Option<&RoomKeypoints>, rows: Range<usize>, added: &RoomKeypoints) -> bool {
    let mut pairs = rows.zip(&added.map.frames);
    pairs.all(|(row, frame)| {
        frame.is_empty() || known.is_some_and(|known| !known.map.frames[row].is_empty())
    })
}

/// Added keypoints that belong to a feature set of the room.
fn with_features_of(base: &StoredRoom, added: &RoomKeypoints) -> Result<RoomKeypoints, String> {
    let problem = match base.room.provenance().camera {
        None => {
            "their keypoints need a camera, which the room does not have; leave the keypoints out"
        }
        Some(camera) if camera != added.map.camera => {
            "their keypoints were made with another camera than that of the room; encode them with the camera of \
             the room, or leave the keypoints out"
        }
        Some(_) => "",
    };
    if !problem.is_empty() {
        return Err(problem.to_owned());
    }

    let place = place_among(&base.features, &added.source.feature)?;
    let source = KeypointSource {
        feature: base.features[place].source().clone(),
        ..added.source.clone()
    };
    Ok(RoomKeypoints {
        source,
        map: added.map.clone(),
    })
}

/// The room's feature sets, each with the added rows appended.
fn joined_features(
    base: &StoredRoom,
    added: &[Features],
    others: OtherFeatures,
) -> Result<Vec<Features>, String> {
    let mut rows_of: Vec<Option<&Features>> = vec![None; base.features.len()];
    for set in added {
        let place = place_among(&base.features, set.source())?;
        if rows_of[place].replace(set).is_some() {
            let name = &base.features[place].source().name;
            return Err(format!(
                "rows of the room's features '{name}' were sent twice"
            ));
        }
    }

    let mut joined = Vec::with_capacity(base.features.len());
    for (known, rows) in base.features.iter().zip(rows_of) {
        let name = &known.source().name;
        let Some(rows) = rows else {
            if others == OtherFeatures::LeftBehind {
                continue;
            }
            return Err(format!(
                "the room also has features '{name}': send their rows too, or drop them with \
                 drop_other_features"
            ));
        };

        let rows = concatenate(Axis(0), &[known.rows(), rows.rows()])
            .map_err(|error| format!("features '{name}': {error}"))?;
        let joined_set = Features::new(known.source().clone(), rows);
        joined.push(joined_set.map_err(|error| error.to_string())?);
    }

    Ok(joined)
}

/// Index of the room's feature set that matches an added one: among sets with the same source
/// settings, the one of the same name, or the only one.
fn place_among(known: &[Features], added: &FeatureSource) -> Result<usize, String> {
    let alike: Vec<usize> = (0..known.len())
        .filter(|&place| known[place].source().is_like(added))
        .collect();
    let name = &added.name;
    let of_same_name = alike
        .iter()
        .find(|&&place| known[place].source().name == *name);

    match (of_same_name, alike.as_slice()) {
        (Some(&place), _) => Ok(place),
        (None, [only]) => Ok(*only),
        (None, found) => {
            let names = |places: &mut dyn Iterator<Item = usize>| {
                let names = places.map(|place| known[place].source().name.as_str());
                names.collect::<Vec<&str>>().join(", ")
            };
            Err(if found.is_empty() {
                format!(
                    "features '{name}' were computed differently from the room's: {}",
                    names(&mut (0..known.len()))
                )
            } else {
                format!(
                    "features '{name}' match several of the room's, send them by name: {}",
                    names(&mut found.iter().copied())
                )
            })
        }
    }
}

/// Whether frame `row` of the base and frame `added` of the addition have the same pose, time and
/// features. `joined` has the rows of both.
fn same_frame(
    base: &StoredRoom,
    row: usize,
    addition: &Room,
    added: usize,
    joined: &[Features],
) -> bool {
    // Reading projects stored rotations, so equal ones agree only up to rounding.
    let same_pose = |a: &Pose, b: &Pose| {
        (a.translation.vector - b.translation.vector).amax() < 1e-12
            && (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12
    };
    let same_rows = |set: &Features| {
        let rows = set.rows();
        rows.row(row) == rows.row(base.room.frame_count() + added)
    };

    base.room.timestamps_ns().get(row) == addition.timestamps_ns().get(added)
        && same_pose(&base.room.poses()[row], &addition.poses()[added])
        && joined.iter().all(same_rows)
}

/// Where the base already has all added frames, one after the other.
fn known_rows(
    base: &StoredRoom,
    addition: &Room,
    is_known: impl Fn(usize, usize) -> bool,
) -> Option<Range<usize>> {
    let added = addition.frame_count();
    let last = base.room.frame_count().checked_sub(added)?;
    let first = (0..=last).find(|first| (0..added).all(|row| is_known(first + row, row)))?;
    Some(first..first + added)
}

/// The first added row that the base already has.
fn first_repeated(
    base: &StoredRoom,
    addition: &Room,
    is_known: impl Fn(usize, usize) -> bool,
) -> Option<usize> {
    let known = base.room.frame_count();
    (0..addition.frame_count()).find(|&added| (0..known).any(|row| is_known(row, added)))
}

/// Every column of the known frames, with that of the added frames appended.
fn joined_frames(known: &Frames, added: &Frames) -> Result<Frames, String> {
    let before = known.poses.len();
    let count = added.poses.len();

    let has_times = !known.timestamps_ns.is_empty();
    if has_times == added.timestamps_ns.is_empty() {
        let problem = if has_times {
            "the room's frames have timestamps: send timestamps for the added frames too"
        } else {
            "the room's frames have no timestamps: send the added frames without timestamps"
        };
        return Err(problem.to_owned());
    }

    // Frames without a name get an empty one.
    let names = if known.names.is_empty() && added.names.is_empty() {
        Vec::new()
    } else {
        let or_empty = |names: &[String], count: usize| {
            let mut names = names.to_vec();
            names.resize(count, String::new());
            names
        };
        let mut names = or_empty(&known.names, before);
        names.extend(or_empty(&added.names, count));
        names
    };

    // The added frames start a new sequence, since the camera was elsewhere in between.
    let last_sequence = known.sequences.iter().max().unwrap_or(&0);
    let mut sequences = known.sequences.clone();
    sequences.resize(before, 0);
    for row in 0..count {
        let own = added.sequences.get(row).unwrap_or(&0);
        let later = last_sequence
            .checked_add(1)
            .and_then(|next| next.checked_add(*own));
        sequences.push(later.ok_or("its sequence numbers are exhausted")?);
    }

    let mut poses = known.poses.clone();
    poses.extend(&added.poses);
    let mut timestamps_ns = known.timestamps_ns.clone();
    timestamps_ns.extend(&added.timestamps_ns);

    let mut numbers = known.numbers.clone();
    if let Some(last) = known.numbers.iter().max() {
        numbers.extend((1..=count as i64).map(|step| last.saturating_add(step)));
    }
    let mut held_out = known.held_out.clone();
    if !held_out.is_empty() {
        held_out.resize(before + count, false);
    }

    Ok(Frames {
        poses,
        timestamps_ns,
        names,
        numbers,
        images: Vec::new(),
        sequences,
        held_out,
    })
}
