//! Adding frames to a room: a robot's own, for instance, of places that the map does not show yet.

use ndarray::{Axis, concatenate};

use super::rooms::Over;
use super::{ATTEMPTS, Error, Kind, Published, Store, StoredRoom, check_features, revision_path};
use crate::store::folder_of;
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
    /// Whether the frames were the room's last ones already.
    is_there: bool,
}

impl Store {
    /// The newest revision of a room with frames behind its own: the room `addition`, which has the
    /// same name, with `features`. Nothing is published.
    ///
    /// The added frames are sequences of their own. The result has no paths of images, since only
    /// the first frames had any.
    ///
    /// # Errors
    /// [`Error::Unknown`] if there is no such room, [`Error::CannotAdd`] if the frames do not fit to
    /// its own, otherwise as [`Store::load_room`].
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

    /// Adds frames to the newest revision of a room, as [`Store::extended_room`] says, and publishes
    /// the result. Frames that are the room's last ones already are not added again.
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
                .publish_over(&room, &features, Over::Revision(base))
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
    let refused = |problem: String| Error::CannotAdd {
        room: base.room.id().to_string(),
        problem,
    };

    let features = joined_features(base, features, others).map_err(refused)?;
    if ends_with(base, addition, &features) {
        return Ok(ExtendedRoom {
            room: base.room.clone(),
            features: base.features.clone(),
            base: base.revision,
            is_there: true,
        });
    }
    let frames = joined_frames(base.room.frames(), addition.frames()).map_err(refused)?;

    let known = base.room.provenance();
    let added = addition.provenance();
    if added.camera.is_some() && known.camera.is_some() && added.camera != known.camera {
        return Err(refused(
            "they were taken by another camera than the room's; leave the camera out, or make a \
             room of their own"
                .to_owned(),
        ));
    }
    let provenance = Provenance {
        images_root: String::new(),
        camera: known.camera.or(added.camera),
        worst_rotation_deviation: known
            .worst_rotation_deviation
            .max(added.worst_rotation_deviation),
        ..known.clone()
    };

    let room = Room::new(base.room.id().clone(), frames, provenance)
        .map_err(|error| refused(error.to_string()))?;
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
    let known = || -> String {
        let names = base.features.iter().map(|set| set.source().name.as_str());
        names.collect::<Vec<&str>>().join(", ")
    };

    for set in added {
        let is_known = |known: &Features| known.source().is_like(set.source());
        if !base.features.iter().any(is_known) {
            return Err(format!(
                "features '{}' are made otherwise than the room's: {}",
                set.source().name,
                known()
            ));
        }
    }

    let mut joined = Vec::with_capacity(base.features.len());
    for known in &base.features {
        let name = &known.source().name;
        let Some(rows) = added
            .iter()
            .find(|set| known.source().is_like(set.source()))
        else {
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

/// Whether the added frames are the last ones of the base already: the same poses and features.
/// `joined` are the features of both.
fn ends_with(base: &StoredRoom, addition: &Room, joined: &[Features]) -> bool {
    let added = addition.frame_count();
    let Some(before) = base.room.frame_count().checked_sub(added) else {
        return false;
    };

    // Stored rotations are projected when they are read, so that equal ones agree up to rounding.
    let same = |(a, b): (&Pose, &Pose)| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12;
    let same_poses = base.room.poses()[before..]
        .iter()
        .zip(addition.poses())
        .all(same);

    let same_rows = |set: &Features| {
        let rows = set.rows();
        let end = rows.nrows() - added;
        rows.slice(ndarray::s![before..end, ..]) == rows.slice(ndarray::s![end.., ..])
    };
    same_poses && joined.len() == base.features.len() && joined.iter().all(same_rows)
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
    if let (Some(last), Some(first)) = (
        known.timestamps_ns.iter().max(),
        added.timestamps_ns.first(),
    ) && first <= last
    {
        return Err(format!(
            "the first was taken at {first} ns, before the room's last at {last} ns: use the same clock"
        ));
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
