//! MCAP files: bags of ROS 2, and recordings of Foxglove.
//!
//! A bag has images on one topic and says on others where something was: the camera, or a robot's base
//! that carries it. The poses at the times of the images lie between those before and after. Images
//! are written to a folder as files, since rooms refer to files.
//!
//! The file is read twice, in pieces, whatever its size: first the poses, then the images.

mod messages;
mod poses;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use mcap::records::{Channel, Record, SchemaHeader};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader};

use super::collect::{About, Collected};
use super::{DropReason, Error, Reader, Recording};
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

/// A topic that is of use here.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Topic {
    name: String,
    kind: Kind,
}

/// Reads a bag.
///
/// # Errors
/// [`Error`] if the file cannot be read or is damaged, a topic is not in it or has messages of another
/// kind, several could be meant, no image has a pose, or an image cannot be written.
pub fn read_bag(file: &Path, bag: &Bag, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    let malformed = |problem: String| Error::Malformed {
        file: file.to_owned(),
        problem,
    };

    let Contents {
        topics,
        mut poses,
        mut images,
    } = contents(file)?;

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
    let path = poses
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
    each_message(file, |topic, log_time, data| {
        if topic.name != image_topic {
            return Ok(());
        }
        (reader.progress)(done, count);
        done += 1;

        let decoded = messages::decode(&topic.kind, data, log_time)
            .map_err(|problem| of_topic(&topic.name, &problem))?;
        let Located::Image(image) = decoded else {
            return Ok(());
        };
        let name = format!("{done:06}");
        let Some(world_from_camera) = path.at(image.time_ns) else {
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
    topics: Vec<Topic>,
    poses: Poses,
    /// By topic, the number of images and the frame of the camera.
    images: BTreeMap<String, (usize, String)>,
}

fn contents(file: &Path) -> Result<Contents, Error> {
    let mut poses = Poses::default();
    let mut images = BTreeMap::new();

    let topics = each_message(file, |topic, log_time, data| {
        let decoded = messages::decode(&topic.kind, data, log_time)
            .map_err(|problem| of_topic(&topic.name, &problem))?;
        match decoded {
            Located::Poses(found) => poses.add(&topic.name, found),
            Located::Image(image) => {
                let counted = images.entry(topic.name.clone()).or_insert((0, image.frame));
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

fn of_topic(topic: &str, problem: &str) -> String {
    format!("topic {topic}: {problem}")
}

/// Calls `take` with every message of a known kind, the time at which it was recorded, and its topic;
/// returns the topics. What `take` refuses is an error of the file.
fn each_message(
    file: &Path,
    mut take: impl FnMut(&Topic, i64, &[u8]) -> Result<(), String>,
) -> Result<Vec<Topic>, Error> {
    let io = |cause| Error::Io {
        file: file.to_owned(),
        cause,
    };
    let malformed = |problem: String| Error::Malformed {
        file: file.to_owned(),
        problem,
    };
    let damaged = |error: mcap::McapError| malformed(format!("is no whole MCAP file: {error}"));

    let mut source = File::open(file).map_err(io)?;
    let mut reader = LinearReader::new();
    let mut schemas = BTreeMap::new();
    let mut topics: BTreeMap<u16, Topic> = BTreeMap::new();

    while let Some(event) = reader.next_event() {
        match event.map_err(damaged)? {
            LinearReadEvent::ReadRequest(wanted) => {
                let read = source.read(reader.insert(wanted)).map_err(io)?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { data, opcode } => {
                match mcap::parse_record(opcode, data).map_err(damaged)? {
                    Record::Schema { header, .. } => {
                        schemas.insert(header.id, header);
                    }
                    Record::Channel(channel) => {
                        let id = channel.id;
                        if let Some(topic) = topic_of(channel, &schemas) {
                            topics.insert(id, topic);
                        }
                    }
                    Record::Message { header, data } => {
                        if let Some(topic) = topics.get(&header.channel_id) {
                            let log_time = i64::try_from(header.log_time).unwrap_or(i64::MAX);
                            take(topic, log_time, &data).map_err(malformed)?;
                        }
                    }
                    _ => {}
                }
            }
        }
    }

    Ok(topics.into_values().collect())
}

/// A channel whose messages are of a known kind.
fn topic_of(channel: Channel, schemas: &BTreeMap<u16, SchemaHeader>) -> Option<Topic> {
    let schema = schemas.get(&channel.schema_id)?;
    let kind = Kind::of(&schema.name, &channel.message_encoding)?;
    Some(Topic {
        name: channel.topic,
        kind,
    })
}

/// The topic that is named, or the only one of its kind.
fn chosen_topic(
    topics: &[Topic],
    named: Option<&str>,
    is_of_kind: impl Fn(&Kind) -> bool,
    what: &str,
) -> Result<String, String> {
    let mut names: Vec<&str> = topics
        .iter()
        .filter(|topic| is_of_kind(&topic.kind))
        .map(|topic| topic.name.as_str())
        .collect();
    names.sort_unstable();
    names.dedup();

    match (named, names.as_slice()) {
        (Some(named), _) if names.contains(&named) => Ok(named.to_owned()),
        (Some(named), []) => Err(format!("has no topic of {what}s, and so not {named}")),
        (Some(named), _) => Err(format!(
            "has no {what} topic {named}; it has {}",
            names.join(", ")
        )),
        (None, [only]) => Ok((*only).to_owned()),
        (None, []) => Err(format!(
            "has no topic of {what}s that is understood: ROS 2's sensor_msgs, geometry_msgs, nav_msgs and tf2_msgs, and \
             Foxglove's in Protobuf are"
        )),
        (None, _) => Err(format!(
            "has several {what} topics; give --{what}-topic, one of {}",
            names.join(", ")
        )),
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
