//! Adding frames to a room: a robot's own, for instance, of places that the map does not show yet.

use ndarray::{Axis, concatenate, s};

use super::rooms::PublishPolicy;
use super::{
    ATTEMPTS, Error, Kind, Published, RoomSummary, Store, StoredRoom, check_features, revision_path,
};
use crate::folder_of;
use seese3_core::Cause;
use seese3_core::features::Features;
use seese3_core::geometry::Pose;
use seese3_core::room::{Frames, Provenance, Room};

/// What becomes of a room's features for which no rows are added.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OtherFeatures {
    /// Rows of every set are required.
    Required,
    /// The new revision does not have the other sets. Earlier revisions keep them.
    LeftBehind,
}

/// A room with frames added, before it is published.
#[derive(Debug)]
pub struct ExtendedRoom {
    room: Room,
    features: Vec<Features>,
    /// The revision that the frames were added to.
    base: u64,
    /// Whether the room had the frames already.
    is_there: bool,
}

impl Store {
    /// A summary of the newest revision of a room, whichever its name alone means.
    ///
    /// # Errors
    /// As [`Store::room_summary`].
    pub async fn newest_room_summary(&self, name: &str) -> Result<RoomSummary, Error> {
        let revisions = self.revisions(&folder_of(Kind::Room, name)).await?;
        self.room_summary(name, revisions.present.last().copied())
            .await
    }

    /// The newest revision of a room with frames behind its own: the room `addition`, which has the
    /// same name, with `features`. Nothing is published.
    ///
    /// The added frames are sequences of their own. The result has no paths of images, since only
    /// the first frames had any.
    ///
    /// # Errors
    /// [`Error::Unknown`] if there is no such room, [`Error::CannotAdd`] if the frames do not fit
    /// to its own, otherwise as [`Store::load_room`].
    pub async fn extended_room(
        &self,
        addition: &Room,
        features: &[Features],
        others: OtherFeatures,
    ) -> Result<ExtendedRoom, Error> {
        check_features(addition, features)?;
        let name = addition.id().as_str();
        let folder = folder_of(Kind::Room, name);
        let newest = self.revisions(&folder).await?.present.last().copied();
        let base = self.load_room(name, newest).await?;

        extended(&base, addition, features, others)
    }

    /// Adds frames to the newest revision of a room, as [`Store::extended_room`] says, and
    /// publishes the result. Frames that the room has already, one after the other, are not added
    /// again.
    ///
    /// # Errors
    /// As [`Store::extended_room`] and [`Store::publish_room`].
    pub async fn extend_room(
        &self,
        addition: &Room,
        features: &[Features],
        others: OtherFeatures,
    ) -> Result<Published, Error> {
        for _ in 0..ATTEMPTS {
            let ExtendedRoom {
                room,
                features,
                base,
                is_there,
            } = self.extended_room(addition, features, others).await?;

            if is_there {
                let folder = folder_of(Kind::Room, room.id().as_str());
                return Ok(Published {
                    revision: base,
                    is_new: false,
                    manifest: revision_path(&folder, base).to_string(),
                });
            }

            // Somebody else may have published meanwhile: then the frames belong behind theirs.
            match self
                .publish_over(&room, &features, PublishPolicy::Revision(base))
                .await
            {
                Err(Error::OtherFrames { .. }) => {}
                published => return published,
            }
        }

        Err(Error::Contended {
            name: addition.id().to_string(),
        })
    }
}

/// The frames of `addition` behind those of `base`.
fn extended(
    base: &StoredRoom,
    addition: &Room,
    features: &[Features],
    others: OtherFeatures,
) -> Result<ExtendedRoom, Error> {
    let refused = |problem: Cause| Error::CannotAdd {
        room: base.room.id().to_string(),
        problem,
    };

    let features =
        joined_features(base, features, others).map_err(|problem| refused(problem.into()))?;
    if has_frames(base, addition, &features) {
        return Ok(ExtendedRoom {
            room: base.room.clone(),
            features: base.features.clone(),
            base: base.revision,
            is_there: true,
        });
    }
    let frames = joined_frames(base.room.frames(), addition.frames())
        .map_err(|problem| refused(problem.into()))?;

    let known = base.room.provenance();
    let added = addition.provenance();
    let problem = match (&added.camera, &known.camera) {
        (Some(added), Some(known)) => known.difference(added),
        _ => None,
    };
    if let Some(problem) = problem {
        return Err(refused(
            format!("their camera {problem}; make a room of their own").into(),
        ));
    }

    let provenance = Provenance {
        images_root: String::new(),
        worst_rotation_deviation: known
            .worst_rotation_deviation
            .max(added.worst_rotation_deviation),
        ..known.clone()
    };

    let room = Room::new(base.room.id().clone(), frames, provenance)
        .map_err(|error| refused(error.into()))?;
    Ok(ExtendedRoom {
        room,
        features,
        base: base.revision,
        is_there: false,
    })
}

/// The room's sets of features, each with the added rows behind its own.
fn joined_features(
    base: &StoredRoom,
    added: &[Features],
    others: OtherFeatures,
) -> Result<Vec<Features>, String> {
    let mut rows_of: Vec<Option<&Features>> = vec![None; base.features.len()];
    for set in added {
        let place = place_among(&base.features, set)?;
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
                "the room also has features '{name}': send rows of them too, or leave them behind on \
                 purpose with drop_other_features"
            ));
        };

        let rows = concatenate(Axis(0), &[known.rows(), rows.rows()])
            .map_err(|error| format!("features '{name}': {error}"))?;
        let joined_set = Features::new(known.source().clone(), rows);
        joined.push(joined_set.map_err(|error| error.to_string())?);
    }

    Ok(joined)
}

/// Which of the room's sets is made as an added one: that of the same name or, if none is, the only
/// one that is made so.
fn place_among(known: &[Features], added: &Features) -> Result<usize, String> {
    let alike: Vec<usize> = (0..known.len())
        .filter(|&place| known[place].source().is_like(added.source()))
        .collect();
    let name = &added.source().name;
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
                    "features '{name}' differ in how they were made from the room's: {}",
                    names(&mut (0..known.len()))
                )
            } else {
                format!(
                    "features '{name}' may be several of the room's, send them by name: {}",
                    names(&mut found.iter().copied())
                )
            })
        }
    }
}

/// Whether the base already has the added frames, one after the other: the same poses, times and
/// features. `joined` are the features of both.
fn has_frames(base: &StoredRoom, addition: &Room, joined: &[Features]) -> bool {
    let known = base.room.frame_count();
    let added = addition.frame_count();
    if joined.len() != base.features.len() || added > known {
        return false;
    }

    // Stored rotations are projected when they are read, so that equal ones agree up to rounding.
    let same = |a: &Pose, b: &Pose| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12;
    let begins_at = |first: usize| {
        let times = base.room.timestamps_ns().get(first..first + added);
        if times.unwrap_or_default() != addition.timestamps_ns() {
            return false;
        }

        let poses = &base.room.poses()[first..first + added];
        let same_rows = |set: &Features| {
            let rows = set.rows();
            rows.slice(s![first..first + added, ..]) == rows.slice(s![known.., ..])
        };
        let mut pairs = poses.iter().zip(addition.poses());
        pairs.all(|(a, b)| same(a, b)) && joined.iter().all(same_rows)
    };

    (0..=known - added).any(begins_at)
}

/// Every column of the known frames with that of the added ones behind it.
fn joined_frames(known: &Frames, added: &Frames) -> Result<Frames, String> {
    let before = known.poses.len();
    let count = added.poses.len();

    let has_times = !known.timestamps_ns.is_empty();
    if has_times == added.timestamps_ns.is_empty() {
        let problem = if has_times {
            "the room's frames have timestamps: send them for the added ones too"
        } else {
            "the room's frames have no timestamps: leave them out of the added ones"
        };
        return Err(problem.to_owned());
    }

    // A frame without a name has an empty one.
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

    // The added frames begin a sequence: the camera was elsewhere in between.
    let last_sequence = known.sequences.iter().max().unwrap_or(&0);
    let mut sequences = known.sequences.clone();
    sequences.resize(before, 0);
    for row in 0..count {
        let own = added.sequences.get(row).unwrap_or(&0);
        let later = last_sequence
            .checked_add(1)
            .and_then(|next| next.checked_add(*own));
        sequences.push(later.ok_or("its numbers of sequences are used up")?);
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
