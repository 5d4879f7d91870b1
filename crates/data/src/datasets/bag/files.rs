//! Finds the files of a bag and reads their messages in the order written.
//!
//! A ROS 2 bag is a folder with one file or several consecutive ones, `NAME_0.mcap`,
//! `NAME_1.mcap`. Before Iron the default was SQLite databases, `.db3`. The format is detected from
//! a file's first bytes, not from its name.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::message::{Message, Topic, ZSTD};
use super::{mcap_file, sqlite_file};
use crate::datasets::Error;
use crate::datasets::natural::sort_naturally;

/// The first bytes of an MCAP file.
const MCAP: &[u8] = b"\x89MCAP0\r\n";
/// The first bytes of an SQLite database.
const SQLITE: &[u8] = b"SQLite format 3\0";
/// File name endings of a bag's data. Other files in its folder, such as `metadata.yaml`, are
/// ignored.
const ENDINGS: [&str; 3] = [".mcap", ".db3", ".zstd"];

/// Calls `take` with every message of a supported type, and returns all topics by name. An error of
/// `take` is reported for the file that contains the message.
///
/// # Errors
/// [`Error`] if the bag cannot be read, its format is not supported, or `take` fails.
pub fn each_message(
    bag: &Path,
    mut take: impl FnMut(&Message<'_>) -> Result<(), String>,
) -> Result<BTreeMap<String, Topic>, Error> {
    let mut topics = BTreeMap::new();
    for file in files_of(bag)? {
        let of_file = match form_of(&file)? {
            Form::Mcap => mcap_file::each_message(&file, &mut take)?,
            Form::Sqlite => sqlite_file::each_message(&file, &mut take)?,
        };
        topics.extend(of_file.into_iter().map(|topic| (topic.name.clone(), topic)));
    }

    Ok(topics)
}

/// The files of a bag in the order in which they were written.
fn files_of(bag: &Path) -> Result<Vec<PathBuf>, Error> {
    if !bag.is_dir() {
        return Ok(vec![bag.to_owned()]);
    }

    let io = |cause| Error::Io {
        file: bag.to_owned(),
        cause,
    };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(bag).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        let name = name.to_string_lossy().into_owned();
        if ENDINGS.iter().any(|ending| name.ends_with(ending)) {
            names.push(name);
        }
    }
    if names.is_empty() {
        return Err(Error::Malformed {
            file: bag.to_owned(),
            problem: "has no .mcap and no .db3 files: it is not a ROS 2 bag".into(),
        });
    }
    let has = |ending: &str| names.iter().any(|name| name.ends_with(ending));
    if has(".mcap") && has(".db3") {
        return Err(Error::Malformed {
            file: bag.to_owned(),
            problem: "has .mcap and .db3 files, which may be the same recording twice: give one of the files"
                .into(),
        });
    }

    sort_naturally(&mut names, |name| name);
    Ok(names.iter().map(|name| bag.join(name)).collect())
}

enum Form {
    Mcap,
    Sqlite,
}

fn form_of(file: &Path) -> Result<Form, Error> {
    let io = |cause| Error::Io {
        file: file.to_owned(),
        cause,
    };
    // Opening a named pipe would block until a writer opens it.
    if !std::fs::metadata(file).map_err(io)?.is_file() {
        return Err(Error::Malformed {
            file: file.to_owned(),
            problem: "is not a regular file".into(),
        });
    }
    let mut first = Vec::new();
    let opened = seese3_files::open(file).map_err(io)?;
    opened.take(16).read_to_end(&mut first).map_err(io)?;

    let problem = match first.as_slice() {
        bytes if bytes.starts_with(MCAP) => return Ok(Form::Mcap),
        bytes if bytes.starts_with(SQLITE) => return Ok(Form::Sqlite),
        bytes if bytes.starts_with(ZSTD) => {
            "is compressed as a whole: unpack it with `zstd -d`, or `ros2 bag convert` the bag"
        }
        bytes if bytes.starts_with(b"#ROSBAG") => {
            "is a ROS 1 bag: convert it to ROS 2 with `rosbags-convert`"
        }
        _ => "is neither an MCAP file nor a .db3 file of ROS 2",
    };
    Err(Error::Malformed {
        file: file.to_owned(),
        problem: problem.into(),
    })
}
