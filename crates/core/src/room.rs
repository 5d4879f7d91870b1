//! A room: the frames of a recording, with camera poses.
//!
//! - Frames are in capture order; a [`FrameId`] is the row of a frame in all arrays of its room.
//! - Poses are `world_from_camera`, meters. Timestamps are nanoseconds.

use std::fmt;

use crate::geometry::{CameraIntrinsics, Pose};

/// Why a room, its name or a reference to one of its frames is refused.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(
        "name {name:?} must be 1 to 100 letters, digits, '.', '-' or '_', and begin with a letter or digit"
    )]
    Name { name: String },
    #[error("room '{room}' has no frames")]
    Empty { room: RoomId },
    #[error(
        "room '{room}', frame {frame}: the pose is not finite or over {MAX_DISTANCE_M:e} m from the origin; \
         drop the frame or repair its pose"
    )]
    PoseNotFinite { room: RoomId, frame: usize },
    #[error("room '{room}' has {frame_count} poses but {actual} {what}; every frame needs one")]
    Count {
        room: RoomId,
        frame_count: usize,
        actual: usize,
        what: &'static str,
    },
    #[error("room '{room}' has {frame_count} frames, over the limit of {MAX_FRAMES}")]
    TooManyFrames { room: RoomId, frame_count: usize },
    #[error(
        "room '{room}', frame {frame}: image '{image}' must be a path inside the recording's folder, without '..'"
    )]
    ImagePath {
        room: RoomId,
        frame: usize,
        image: String,
    },
    #[error(
        "room '{room}', frame {frame}: the {what} has {length} bytes, over the limit of {limit}"
    )]
    TextTooLong {
        room: RoomId,
        frame: usize,
        what: &'static str,
        length: usize,
        limit: usize,
    },
    #[error("room '{room}' has no frame {frame}; it has frames 0 to {}", frame_count - 1)]
    UnknownFrame {
        room: RoomId,
        frame: FrameId,
        frame_count: usize,
    },
}

/// Maximum distance of a camera from the origin of its world frame, meters.
pub const MAX_DISTANCE_M: f64 = 1e6;

/// Maximum number of frames in a room.
pub const MAX_FRAMES: usize = 10_000_000;

/// Maximum length of a frame's name, bytes. Answers repeat it for each retrieved frame.
pub const MAX_FRAME_NAME: usize = 1_000;

/// Maximum length of the path of an image, bytes; the limit of Linux.
pub const MAX_IMAGE_PATH: usize = 4_096;

/// The name of a room, which is also the name of its folder in the store.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(try_from = "String", into = "String")
)]
pub struct RoomId(String);

impl RoomId {
    /// Validates a name.
    ///
    /// # Errors
    /// [`Error::Name`] if it is not a valid folder name on every system.
    pub fn new(name: &str) -> Result<Self, Error> {
        if is_plain_name(name) {
            Ok(Self(name.to_owned()))
        } else {
            Err(Error::Name {
                name: name.to_owned(),
            })
        }
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for RoomId {
    type Error = Error;

    fn try_from(name: String) -> Result<Self, Error> {
        Self::new(&name)
    }
}

impl From<RoomId> for String {
    fn from(room: RoomId) -> Self {
        room.0
    }
}

impl fmt::Display for RoomId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Whether `name` can be a folder or file name on every system: at most 100 ASCII letters, digits,
/// `.`, `-` and `_`, of which the first is a letter or digit.
pub fn is_plain_name(name: &str) -> bool {
    name.len() <= 100
        && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_'))
}

/// The row of a frame in the arrays of its room.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FrameId(pub u32);

impl FrameId {
    /// The row as an array index.
    pub fn row(self) -> usize {
        self.0 as usize
    }
}

impl fmt::Display for FrameId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// Origin of a room.
#[derive(Debug, Clone, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Provenance {
    /// Source format, for instance `7scenes`.
    pub format: String,
    /// License of the data, if stated.
    #[cfg_attr(feature = "serde", serde(alias = "licence"))]
    pub license: String,
    /// Base folder of the image paths; empty if the room has no images.
    pub images_root: String,
    /// Largest entry of |RRᵀ − I| over all rotations, before the projection onto SO(3).
    pub worst_rotation_deviation: f64,
    /// The camera that took the images, if known.
    #[cfg_attr(
        feature = "serde",
        serde(default, skip_serializing_if = "Option::is_none")
    )]
    pub camera: Option<CameraIntrinsics>,
}

/// The frames of a room as columns, one entry per frame. [`Room::new`] validates them.
#[derive(Debug, Clone, Default)]
pub struct Frames {
    /// `world_from_camera`, meters, in order of capture.
    pub poses: Vec<Pose>,
    /// Nanoseconds on the recorder's clock, one per frame, or empty if unknown.
    pub timestamps_ns: Vec<i64>,
    /// The recording's own frame names, one per frame, or empty if it has none.
    pub names: Vec<String>,
    /// The recording's own frame numbers, one per frame, or empty if it has none. Dropped frames
    /// leave gaps.
    pub numbers: Vec<i64>,
    /// The path of each frame's image, relative to [`Provenance::images_root`], or empty if there
    /// are no images. `FILE@OFFSET+LENGTH` means a part of a file; both numbers are in bytes.
    pub images: Vec<String>,
    /// The number of the uninterrupted sequence that each frame belongs to, or empty if all frames
    /// are in one sequence.
    pub sequences: Vec<u32>,
    /// Whether the recording's own train/test split keeps each frame for testing, or empty if it
    /// defines no split.
    pub held_out: Vec<bool>,
}

impl Frames {
    /// The first column that is neither empty nor as long as the poses, and its length.
    pub fn unequal(&self) -> Option<(&'static str, usize)> {
        let columns = [
            ("timestamps", self.timestamps_ns.len()),
            ("frame names", self.names.len()),
            ("frame numbers", self.numbers.len()),
            ("images", self.images.len()),
            ("sequence marks", self.sequences.len()),
            ("split marks", self.held_out.len()),
        ];

        columns
            .into_iter()
            .find(|(_, length)| *length != 0 && *length != self.poses.len())
    }

    /// The given rows of every column, in the given order. Every row must exist.
    #[must_use]
    pub fn select(&self, rows: &[usize]) -> Self {
        fn pick<T: Clone>(values: &[T], rows: &[usize]) -> Vec<T> {
            // An empty column means that the recording does not have this information.
            if values.is_empty() {
                Vec::new()
            } else {
                rows.iter().map(|&row| values[row].clone()).collect()
            }
        }

        Self {
            poses: pick(&self.poses, rows),
            timestamps_ns: pick(&self.timestamps_ns, rows),
            names: pick(&self.names, rows),
            numbers: pick(&self.numbers, rows),
            images: pick(&self.images, rows),
            sequences: pick(&self.sequences, rows),
            held_out: pick(&self.held_out, rows),
        }
    }
}

/// The sequence structure of a room's frames, as needed for a train/test split.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Timeline {
    /// The number of frames.
    pub frame_count: usize,
    /// The number of the uninterrupted sequence that each frame belongs to, or empty if all frames
    /// are in one sequence.
    pub sequences: Vec<u32>,
    /// Whether the recording's own train/test split keeps each frame for testing, or empty if it
    /// defines no split.
    pub held_out: Vec<bool>,
}

impl Timeline {
    /// A timeline of one uninterrupted sequence, without a train/test split.
    pub fn unbroken(frame_count: usize) -> Self {
        Self {
            frame_count,
            ..Self::default()
        }
    }

    /// Whether two frames belong to the same uninterrupted sequence.
    pub fn joins(&self, a: FrameId, b: FrameId) -> bool {
        self.sequences.is_empty() || self.sequences[a.row()] == self.sequences[b.row()]
    }
}

/// The length of the longest text, bytes.
///
/// # Errors
/// [`Error::TextTooLong`] for the first text over `limit`.
fn checked_lengths(
    room: &RoomId,
    what: &'static str,
    texts: &[String],
    limit: usize,
) -> Result<usize, Error> {
    if let Some(frame) = texts.iter().position(|text| text.len() > limit) {
        return Err(Error::TextTooLong {
            room: room.clone(),
            frame,
            what,
            length: texts[frame].len(),
            limit,
        });
    }
    Ok(texts.iter().map(String::len).max().unwrap_or(0))
}

/// A room with validated frames. Immutable.
#[derive(Debug, Clone)]
pub struct Room {
    id: RoomId,
    frames: Frames,
    timeline: Timeline,
    provenance: Provenance,
    longest_frame_name: usize,
}

impl Room {
    /// Validates the frames.
    ///
    /// # Errors
    /// Checked in this order: [`Error::Empty`] if there are no poses, [`Error::TooManyFrames`] over
    /// [`MAX_FRAMES`], [`Error::Count`] if a column is not as long as the poses,
    /// [`Error::PoseNotFinite`] if a pose is not finite or over [`MAX_DISTANCE_M`] from the origin,
    /// [`Error::ImagePath`] if the path of an image could leave its folder, [`Error::TextTooLong`]
    /// if a name is over [`MAX_FRAME_NAME`] or a path over [`MAX_IMAGE_PATH`].
    pub fn new(id: RoomId, frames: Frames, provenance: Provenance) -> Result<Self, Error> {
        let frame_count = frames.poses.len();
        if frame_count == 0 {
            return Err(Error::Empty { room: id });
        }

        if frame_count > MAX_FRAMES {
            return Err(Error::TooManyFrames {
                room: id,
                frame_count,
            });
        }

        if let Some((what, actual)) = frames.unequal() {
            return Err(Error::Count {
                room: id,
                frame_count,
                actual,
                what,
            });
        }

        // Comparisons with NaN are false, so `near` also refuses a translation with NaN.
        let near = |pose: &Pose| pose.translation.vector.norm() <= MAX_DISTANCE_M;
        let finite =
            |pose: &Pose| near(pose) && pose.to_homogeneous().iter().all(|x| x.is_finite());
        if let Some(frame) = frames.poses.iter().position(|pose| !finite(pose)) {
            return Err(Error::PoseNotFinite { room: id, frame });
        }

        // These paths are opened later, so none may leave the recording's folder.
        if let Some(frame) = frames.images.iter().position(|image| !stays_below(image)) {
            return Err(Error::ImagePath {
                room: id,
                frame,
                image: frames.images[frame].clone(),
            });
        }

        let longest_frame_name = checked_lengths(&id, "name", &frames.names, MAX_FRAME_NAME)?;
        checked_lengths(&id, "path of the image", &frames.images, MAX_IMAGE_PATH)?;

        // The timeline is a copy of two columns, so that splits do not need the poses and image
        // paths.
        let sequences = frames.sequences.clone();
        let held_out = frames.held_out.clone();
        let timeline = Timeline {
            frame_count,
            sequences,
            held_out,
        };

        Ok(Self {
            id,
            frames,
            timeline,
            provenance,
            longest_frame_name,
        })
    }

    /// The room's name.
    pub fn id(&self) -> &RoomId {
        &self.id
    }

    /// Approximate memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        let Frames {
            poses,
            timestamps_ns,
            names,
            numbers,
            images,
            sequences,
            held_out,
        } = &self.frames;
        let texts = names.iter().chain(images);
        let texts: usize = texts
            .map(|text| size_of::<String>() + text.capacity())
            .sum();

        // The timeline has a copy of the last two columns.
        size_of_val(poses.as_slice())
            + size_of_val(timestamps_ns.as_slice())
            + size_of_val(numbers.as_slice())
            + 2 * size_of_val(sequences.as_slice())
            + 2 * size_of_val(held_out.as_slice())
            + texts
    }

    /// The number of frames, at least one.
    pub fn frame_count(&self) -> usize {
        self.frames.poses.len()
    }

    /// The poses of all frames, `world_from_camera`, meters.
    pub fn poses(&self) -> &[Pose] {
        &self.frames.poses
    }

    /// The timestamps of all frames, nanoseconds; empty if unknown.
    pub fn timestamps_ns(&self) -> &[i64] {
        &self.frames.timestamps_ns
    }

    /// The recording's own frame names; empty if it has none.
    pub fn frame_names(&self) -> &[String] {
        &self.frames.names
    }

    /// Length of the longest frame name, bytes.
    pub fn longest_frame_name(&self) -> usize {
        self.longest_frame_name
    }

    /// The recording's own frame numbers; empty if it has none.
    pub fn frame_numbers(&self) -> &[i64] {
        &self.frames.numbers
    }

    /// The path of each frame's image, relative to [`Provenance::images_root`]; empty if there are
    /// no images.
    pub fn images(&self) -> &[String] {
        &self.frames.images
    }

    /// The order of the frames, and the recording's own train/test split.
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// All columns of the frames.
    pub fn frames(&self) -> &Frames {
        &self.frames
    }

    /// Where the room came from.
    pub fn provenance(&self) -> &Provenance {
        &self.provenance
    }

    /// The pose of a frame, `world_from_camera`, meters.
    ///
    /// # Errors
    /// [`Error::UnknownFrame`] if the room has no such frame.
    pub fn pose(&self, frame: FrameId) -> Result<&Pose, Error> {
        self.frames
            .poses
            .get(frame.row())
            .ok_or_else(|| Error::UnknownFrame {
                room: self.id.clone(),
                frame,
                frame_count: self.frame_count(),
            })
    }
}

/// Whether a relative path stays inside its base folder.
fn stays_below(path: &str) -> bool {
    !path.is_empty()
        && !path.contains(['\\', ':', '\0'])
        && path.split('/').all(|part| !matches!(part, "" | "." | ".."))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn room(frames: Frames) -> Result<Room, Error> {
        Room::new(RoomId::new("r").unwrap(), frames, Provenance::default())
    }

    /// Oracle: the definition of a frame id, a row.
    #[test]
    fn a_frame_past_the_end_is_unknown() {
        let room = room(Frames {
            poses: vec![Pose::identity(); 2],
            ..Frames::default()
        })
        .unwrap();

        assert!(room.pose(FrameId(1)).is_ok());

        let message = room.pose(FrameId(2)).unwrap_err().to_string();
        assert_eq!(message, "room 'r' has no frame 2; it has frames 0 to 1");
    }

    /// Oracle: the definition of a room: frames, finite poses, columns of equal length, image paths
    /// inside its folder. Each case violates one of these.
    #[test]
    fn bad_frames_are_refused() {
        assert!(matches!(room(Frames::default()), Err(Error::Empty { .. })));

        let nan = Pose::translation(f64::NAN, 0.0, 0.0);
        assert!(matches!(
            room(Frames {
                poses: vec![Pose::identity(), nan],
                ..Frames::default()
            }),
            Err(Error::PoseNotFinite { frame: 1, .. })
        ));

        let frames = Frames {
            poses: vec![Pose::identity()],
            timestamps_ns: vec![1, 2],
            ..Frames::default()
        };

        assert!(matches!(room(frames), Err(Error::Count { actual: 2, .. })));

        for image in [
            "../secret.png",
            "/etc/passwd",
            "a/../../b.png",
            "",
            "c:/x.png",
            "a//b.png",
        ] {
            let frames = Frames {
                poses: vec![Pose::identity()],
                images: vec![image.to_owned()],
                ..Frames::default()
            };

            assert!(
                matches!(room(frames), Err(Error::ImagePath { .. })),
                "{image:?}"
            );
        }
    }

    /// Oracle: typical names of path traversals and hidden files.
    #[test]
    fn names_that_could_escape_their_folder_are_refused() {
        for name in [
            "",
            "..",
            ".hidden",
            "a/b",
            "a\\b",
            "a b",
            "ä",
            &"x".repeat(101),
        ] {
            assert!(RoomId::new(name).is_err(), "{name:?}");
        }

        assert!(RoomId::new("scene0000_00").is_ok());
    }
}
