//! Reads ROS 2 bags and Foxglove recordings.
//!
//! One topic of a bag has the images; others have poses of the camera, or of the robot's base that
//! carries it. Poses are interpolated to the times of the images. Images are written to a folder,
//! since rooms refer to image files.
//!
//! A bag is read twice, message by message: first the poses, then the images. Only the poses stay
//! in memory.
//!
//! | file | what |
//! | --- | --- |
//! | `files` | finds the files of a bag and reads their messages in order |
//! | `mcap_file`, `sqlite_file` | read the messages of one file |
//! | `message` | supported message types |
//! | `messages` | decodes messages |
//! | `poses` | interpolates the camera's pose to the time of an image |
//! | `written_images` | writes images, and removes them if the import fails |

mod files;
mod mcap_file;
mod message;
mod messages;
mod poses;
mod sqlite_file;
mod written_images;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::collect::{About, Collected};
use super::{DropReason, Error, Reader, Recording};
use files::each_message;
use message::{Kind, Message, Topic};
use messages::{Image, ImageFile};
use poses::Poses;
use seese3_core::Cause;
use seese3_core::geometry::Pose;
pub use written_images::WrittenImages;

/// The topics and frames to read from a bag. A topic that is `None` is chosen automatically if the
/// bag has only one of its kind.
#[derive(Debug, Clone, Default)]
pub struct Bag {
    /// The topic of the images.
    pub image_topic: Option<String>,
    /// The topic of the poses; the frame that they are stated in becomes the room's world. If it is
    /// `None` and `world` is set, the transforms of /tf are used.
    pub pose_topic: Option<String>,
    /// The frame of /tf that becomes the room's world.
    pub world: Option<String>,
    /// The camera's pose in the frame that the topic tracks, such as base_link. If `None`, it is
    /// looked up in /tf; poses without a tracked frame are taken as the camera's own.
    pub base_from_camera: Option<Pose>,
    /// The folder for the images, created if missing. Each image topic gets a subfolder.
    pub images: PathBuf,
}

/// Reads a bag: a folder written by ROS 2, or one of its files. The images are deleted when the
/// returned [`WrittenImages`] is dropped, unless [`WrittenImages::keep`] is called.
///
/// # Errors
/// [`Error`] if
/// - a file cannot be read or is damaged,
/// - a topic is missing, has messages of another kind, or is ambiguous,
/// - no image has a pose,
/// - an image cannot be written or would replace a different file,
/// - a frame is unusable and `reader.unusable` is `Refuse`.
pub fn read_bag(
    path: &Path,
    bag: &Bag,
    reader: &mut Reader<'_>,
) -> Result<(Recording, WrittenImages), Error> {
    let malformed = |problem: String| malformed(path, problem.into());
    let Contents {
        topics,
        mut poses,
        malformed_poses,
        mut images,
    } = contents(path)?;
    poses.sort();

    let image_topic = chosen_topic(&topics, bag.image_topic.as_deref(), &IMAGES);
    let image_topic = image_topic.map_err(&malformed)?;
    let (count, camera_frame) = images.remove(&image_topic).unwrap_or_default();
    let pose_topic = match (&bag.pose_topic, &bag.world) {
        (None, Some(_)) => None,
        (given, _) => {
            let chosen = chosen_topic(&topics, given.as_deref(), &POSES);
            Some(chosen.map_err(&malformed)?)
        }
    };
    let is_of_pose_topic = |message: &MalformedPose| Some(&message.topic) == pose_topic.as_ref();

    let camera = poses.path(
        pose_topic.as_deref(),
        bag.world.as_deref(),
        &camera_frame,
        bag.base_from_camera,
    );
    let camera = camera.map_err(|problem| {
        // Poses may be missing because all messages are malformed: report the first problem as
        // well.
        let first = malformed_poses
            .iter()
            .find(|message| is_of_pose_topic(message));
        malformed(match first {
            Some(first) => format!("{problem}; the first: {}", first.problem),
            None => problem,
        })
    })?;

    let mut collected = Collected::default();
    for message in malformed_poses {
        if message.is_transform || is_of_pose_topic(&message) {
            let name = format!("message {} of {}", message.number, message.topic);
            collected.drop_for(name, DropReason::MalformedMessage, message.problem);
        }
    }

    let mut written = WrittenImages::in_folder(bag.images.join(folder_of(&image_topic)))?;
    let mut frames = Vec::new();
    let mut done = 0;
    each_message(path, |message| {
        if message.topic != image_topic {
            return Ok(());
        }
        (reader.progress)(done, count);
        done += 1;
        let number = format!("{done:06}");

        let (time_ns, file) = match image_file(message) {
            Ok(Some(found)) => found,
            Ok(None) => return Ok(()),
            Err(problem) => {
                collected.drop_for(number, DropReason::MalformedMessage, problem);
                return Ok(());
            }
        };
        let Some(world_from_camera) = camera.at(time_ns) else {
            collected.drop(number, DropReason::NoPoseWithinTolerance);
            return Ok(());
        };

        let name = format!("{number}.{}", file.extension);
        written.write(&name, &file.bytes)?;
        frames.push((time_ns, name, world_from_camera));
        Ok(())
    })?;

    let recording = in_order(collected, frames, written.folder(), reader);
    Ok((recording.map_err(|error| of_bag(error, path))?, written))
}

/// The capture time of an image message, nanoseconds, and its image as a file; `None` for messages
/// of another kind.
fn image_file(message: &Message<'_>) -> Result<Option<(i64, ImageFile)>, String> {
    let Some(Image { time_ns, picture }) = messages::image_of(message)? else {
        return Ok(None);
    };
    Ok(Some((time_ns, picture.file()?)))
}

/// Builds the recording from frames (capture time, image name, `world_from_camera`). Frames are
/// sorted by capture time, because messages may be recorded in another order.
fn in_order(
    mut collected: Collected,
    mut frames: Vec<(i64, String, Pose)>,
    folder: &Path,
    reader: &Reader<'_>,
) -> Result<Recording, Error> {
    frames.sort_by_key(|(time_ns, ..)| *time_ns);
    for (time_ns, name, world_from_camera) in frames {
        let about = About {
            name: name.clone(),
            image: Some(name),
            timestamp_ns: Some(time_ns),
            ..About::default()
        };
        collected.keep(about, world_from_camera);
    }

    collected.finish(folder, reader)
}

fn malformed(path: &Path, problem: Cause) -> Error {
    Error::Malformed {
        file: path.to_owned(),
        problem,
    }
}

/// Replaces the image folder by the bag's path in errors about unusable frames.
fn of_bag(error: Error, path: &Path) -> Error {
    match error {
        Error::NoFrames { dropped, .. } => Error::NoFrames {
            folder: path.to_owned(),
            dropped,
        },
        Error::Strict { dropped, .. } => Error::Strict {
            folder: path.to_owned(),
            dropped,
        },
        other => other,
    }
}

/// The result of the first pass.
struct Contents {
    topics: BTreeMap<String, Topic>,
    poses: Poses,
    malformed_poses: Vec<MalformedPose>,
    /// The number of images and the camera's frame, by topic.
    images: BTreeMap<String, (usize, String)>,
}

/// A pose or transform message that cannot be decoded.
struct MalformedPose {
    topic: String,
    is_transform: bool,
    /// Its number among the messages of its topic, from 1.
    number: usize,
    problem: String,
}

fn contents(path: &Path) -> Result<Contents, Error> {
    let mut poses = Poses::default();
    let mut malformed_poses = Vec::new();
    let mut images: BTreeMap<String, (usize, String)> = BTreeMap::new();
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();

    let topics = each_message(path, |message| {
        let topic = message.topic.to_owned();
        if message.kind.is_image() {
            let (count, frame) = images.entry(topic).or_default();
            *count += 1;
            // An image that cannot be decoded is reported in the second pass.
            if frame.is_empty() {
                *frame = messages::camera_frame_of(message).unwrap_or_default();
            }
            return Ok(());
        }

        let number = counts.entry(topic.clone()).or_default();
        *number += 1;
        match messages::poses_of(message) {
            Ok(found) if message.kind.is_transforms() => poses.add_transforms(&topic, found),
            Ok(found) => poses.add_poses(&topic, found),
            Err(problem) => malformed_poses.push(MalformedPose {
                is_transform: message.kind.is_transforms(),
                number: *number,
                topic,
                problem,
            }),
        }
        Ok(())
    })?;

    Ok(Contents {
        topics,
        poses,
        malformed_poses,
        images,
    })
}

/// The folder name of a topic: /camera/image becomes camera-image.
fn folder_of(topic: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let words = topic
        .split(|c| !is_plain(c))
        .filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("-")
}

/// The role of a topic: images or poses.
struct Wanted {
    /// The role's name in messages and in the option `--ROLE-topic`.
    what: &'static str,
    is_of_kind: fn(&Kind) -> bool,
    /// The hint for a bag without such a topic.
    else_do: &'static str,
}

const IMAGES: Wanted = Wanted {
    what: "image",
    is_of_kind: Kind::is_image,
    else_do: "supported types are ROS 2's sensor_msgs/msg/Image and CompressedImage, and Foxglove's \
              CompressedImage",
};

const POSES: Wanted = Wanted {
    what: "pose",
    is_of_kind: Kind::is_pose,
    else_do: "supported types are ROS 2's PoseStamped, PoseWithCovarianceStamped and Odometry, and \
              Foxglove's PoseInFrame and Odometry; give --world-frame FRAME to take the camera's poses \
              from /tf",
};

/// The named topic, or the only one of its kind.
fn chosen_topic(
    topics: &BTreeMap<String, Topic>,
    named: Option<&str>,
    wanted: &Wanted,
) -> Result<String, String> {
    let Wanted {
        what,
        is_of_kind,
        else_do,
    } = wanted;
    let of_kind = topics
        .values()
        .filter(|topic| topic.kind.as_ref().is_some_and(is_of_kind));
    let names: Vec<&str> = of_kind.map(|topic| topic.name.as_str()).collect();

    match (named, names.as_slice()) {
        (Some(named), _) if names.contains(&named) => Ok(named.to_owned()),
        (Some(named), []) => Err(format!(
            "has no {what} topic {named}, nor any other {what} topic; {}",
            all_of(topics)
        )),
        (Some(named), _) => Err(format!(
            "has no {what} topic {named}; it has {}",
            names.join(", ")
        )),
        (None, [only]) => Ok((*only).to_owned()),
        (None, []) => Err(format!(
            "has no {what} topic: {else_do}; {}",
            all_of(topics)
        )),
        (None, _) => Err(format!(
            "has several {what} topics; give --{what}-topic, one of {}",
            names.join(", ")
        )),
    }
}

/// All topics with their message types, for error messages.
fn all_of(topics: &BTreeMap<String, Topic>) -> String {
    let words = topics
        .values()
        .map(|topic| format!("{} ({})", topic.name, topic.schema));
    let words: Vec<String> = words.collect();
    match words.as_slice() {
        [] => "it has no topics".to_owned(),
        words => format!("its topics are {}", words.join(", ")),
    }
}
