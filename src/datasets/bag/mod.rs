//! Bags of ROS 2, and recordings of Foxglove.
//!
//! A bag has images on one topic and says on others where something was: the camera, or a robot's base
//! that carries it. The poses at the times of the images lie between those before and after. Images
//! are written to a folder as files, since rooms refer to files.
//!
//! A bag is read twice, message by message, whatever its size: first the poses, then the images.
//!
//! | file | what |
//! | --- | --- |
//! | `files` | the files of a bag, and the messages of all of them |
//! | `mcap_file`, `sqlite_file` | the messages of one file |
//! | `messages` | what a message says |
//! | `poses` | where the camera was at the time of an image |

mod files;
mod mcap_file;
mod messages;
mod poses;
mod sqlite_file;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::collect::{About, Collected};
use super::{DropReason, Error, Reader, Recording};
use files::{Topic, each_message};
use messages::{ImageFile, Kind, Located, Picture};
use poses::Poses;
use seese3_core::geometry::Pose;

/// What of a bag is read. What is left out is chosen if there is only one.
#[derive(Debug, Clone, Default)]
pub struct Bag {
    /// The topic of the images.
    pub image_topic: Option<String>,
    /// The topic of the poses; without it, and with `world`, the transforms of /tf are used.
    pub pose_topic: Option<String>,
    /// The frame of /tf in which the camera's poses are wanted.
    pub world: Option<String>,
    /// The camera on what the poses are of; identity if the poses are those of the camera. Without
    /// it, /tf is asked.
    pub base_from_camera: Option<Pose>,
    /// The folder for the images, made if it does not exist.
    pub images: PathBuf,
}

/// Reads a bag: a folder as ROS 2 writes it, or one of its files.
///
/// # Errors
/// [`Error`] if a file cannot be read or is damaged, a topic is not in it or has messages of another
/// kind, several could be meant, no image has a pose, or an image cannot be written.
pub fn read_bag(path: &Path, bag: &Bag, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    let malformed = |problem: String| Error::Malformed {
        file: path.to_owned(),
        problem,
    };

    let Contents {
        topics,
        mut poses,
        mut images,
    } = contents(path)?;

    let image_topic = chosen_topic(&topics, bag.image_topic.as_deref(), Kind::is_image, "image")
        .map_err(&malformed)?;
    let (count, camera_frame) = images.remove(&image_topic).unwrap_or_default();
    let pose_topic = match (&bag.pose_topic, &bag.world) {
        (None, Some(_)) => None,
        (given, _) => Some(
            chosen_topic(&topics, given.as_deref(), Kind::is_pose, "pose").map_err(&malformed)?,
        ),
    };

    poses.sort();
    let camera = poses
        .path(
            pose_topic.as_deref(),
            bag.world.as_deref(),
            &camera_frame,
            bag.base_from_camera,
        )
        .map_err(&malformed)?;

    let io = |cause| Error::Io {
        file: bag.images.clone(),
        cause,
    };
    std::fs::create_dir_all(&bag.images).map_err(io)?;

    let mut collected = Collected::default();
    let mut done = 0;
    each_message(path, |message| {
        if message.topic != image_topic {
            return Ok(());
        }
        (reader.progress)(done, count);
        done += 1;

        let Located::Image(image) = messages::decode(message)? else {
            return Ok(());
        };
        let name = format!("{done:06}");
        let Some(world_from_camera) = camera.at(image.time_ns) else {
            collected.drop(name, DropReason::NoPoseWithinTolerance);
            return Ok(());
        };

        let name = written(&bag.images, &name, &image.picture)?;
        let about = About {
            name: name.clone(),
            image: Some(name),
            timestamp_ns: Some(image.time_ns),
            ..About::default()
        };
        collected.keep(about, world_from_camera);
        Ok(())
    })?;

    collected.finish(&bag.images, reader)
}

/// What the first pass finds.
struct Contents {
    topics: BTreeMap<String, Topic>,
    poses: Poses,
    /// By topic, the number of images and the frame of the camera.
    images: BTreeMap<String, (usize, String)>,
}

fn contents(path: &Path) -> Result<Contents, Error> {
    let mut poses = Poses::default();
    let mut images = BTreeMap::new();

    let topics = each_message(path, |message| {
        match messages::decode(message)? {
            Located::Poses(found) => poses.add(message.topic, found),
            Located::Image(image) => {
                let topic = message.topic.to_owned();
                let counted = images.entry(topic).or_insert((0, image.frame));
                counted.0 += 1;
            }
        }
        Ok(())
    })?;

    Ok(Contents {
        topics,
        poses,
        images,
    })
}

/// The topic that is named, or the only one of its kind.
fn chosen_topic(
    topics: &BTreeMap<String, Topic>,
    named: Option<&str>,
    is_of_kind: impl Fn(&Kind) -> bool,
    what: &str,
) -> Result<String, String> {
    let of_kind = topics
        .values()
        .filter(|topic| topic.kind.as_ref().is_some_and(&is_of_kind));
    let names: Vec<&str> = of_kind.map(|topic| topic.name.as_str()).collect();

    match (named, names.as_slice()) {
        (Some(named), _) if names.contains(&named) => Ok(named.to_owned()),
        (Some(named), []) => Err(format!(
            "has no topic of {what}s, and so not {named}; {}",
            all_of(topics)
        )),
        (Some(named), _) => Err(format!(
            "has no {what} topic {named}; it has {}",
            names.join(", ")
        )),
        (None, [only]) => Ok((*only).to_owned()),
        (None, []) => Err(format!(
            "has no topic of {what}s that is understood: ROS 2's sensor_msgs, geometry_msgs, nav_msgs and tf2_msgs, and \
             Foxglove's in Protobuf are; {}",
            all_of(topics)
        )),
        (None, _) => Err(format!(
            "has several {what} topics; give --{what}-topic, one of {}",
            names.join(", ")
        )),
    }
}

/// All topics with what they carry, for a message that says what is there instead of what was asked.
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

/// Writes an image to a file of the folder, and returns the file's name.
fn written(folder: &Path, stem: &str, picture: &Picture) -> Result<String, String> {
    let ImageFile { extension, bytes } = picture.file()?;
    let name = format!("{stem}.{extension}");
    let path = folder.join(&name);
    std::fs::write(&path, bytes)
        .map_err(|error| format!("{} cannot be written: {error}", path.display()))?;
    Ok(name)
}
