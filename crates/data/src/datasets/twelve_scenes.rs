//! 12-Scenes: `HOUSE/ROOM/{info.txt,split.txt,data/frame-XXXXXX.{color.jpg,pose.txt}}`,
//! camera-to-world, meters.
//!
//! - The pose file of a frame without tracking contains the text INF.
//! - `split.txt` has one line per sequence, `sequenceK [frames=N] …`; the first sequence is held
//!   out for testing.

use std::collections::BTreeMap;
use std::path::Path;

use super::collect::{About, Collected};
use super::text::{read_matrix, wrong};
use super::{DropReason, Error, Reader, Recording, entries, read_text};

/// Reads the folder of one room.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`. The message names the file or folder.
pub fn read_twelve_scenes(folder: &Path, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    let lengths = sequence_lengths(&folder.join("split.txt"))?;
    let names = entries(&folder.join("data"))?;

    // The files are grouped by frame number: slot 0 is the image, slot 1 the pose. Other files are
    // ignored.
    let mut frames: BTreeMap<u32, [Option<&String>; 2]> = BTreeMap::new();
    for name in &names {
        let Some((stem, kind)) = name
            .strip_prefix("frame-")
            .and_then(|rest| rest.split_once('.'))
        else {
            continue;
        };

        let (Ok(number), Some(kind)) = (
            stem.parse(),
            ["color.jpg", "pose.txt"].iter().position(|k| *k == kind),
        ) else {
            continue;
        };
        frames.entry(number).or_default()[kind] = Some(name);
    }

    let mut collected = Collected::default();
    let count = frames.len();
    for (position, (number, [image, pose])) in frames.into_iter().enumerate() {
        (reader.progress)(position, count);

        // The position counts all frames, including those that are dropped below, as `split.txt`
        // does.
        let sequence = sequence_of(&lengths, position);

        let about = About {
            name: format!("data/frame-{number:06}"),
            image: image.map(|name| format!("data/{name}")),
            number: Some(i64::from(number)),
            sequence: Some(sequence),
            held_out: Some(sequence == 0),
            ..About::default()
        };

        let (Some(pose), Some(_)) = (pose, image) else {
            let (ending, reason) = if image.is_none() {
                ("color.jpg", DropReason::MissingImage)
            } else {
                ("pose.txt", DropReason::MissingPoseFile)
            };
            let looked_for = format!("{}.{ending}", about.name);
            collected.drop_without(looked_for, about.name, reason);

            continue;
        };

        let file = folder.join("data").join(pose);
        match read_matrix(&file)? {
            Err(reason) => collected.drop(about.name, reason),
            Ok(matrix) => collected.take(about, &matrix, &file)?,
        }
    }

    collected.finish(folder, reader)
}

/// The sequence of a frame by its position among all frames. Frames beyond the listed lengths
/// belong to the last sequence.
fn sequence_of(lengths: &[usize], position: usize) -> u32 {
    let mut end = 0;
    for (sequence, length) in (0..).zip(lengths) {
        end += length;
        if position < end {
            return sequence;
        }
    }

    lengths.len().saturating_sub(1) as u32
}

/// The number of frames in each sequence.
fn sequence_lengths(file: &Path) -> Result<Vec<usize>, Error> {
    let text = read_text(file)?;
    let mut lengths = Vec::new();
    for (line, text) in (1..)
        .zip(text.lines())
        .filter(|(_, text)| !text.trim().is_empty())
    {
        let frames = text
            .split_whitespace()
            .find_map(|word| word.strip_prefix("[frames=")?.strip_suffix(']'));
        let length = frames.and_then(|frames| frames.parse::<u32>().ok());
        lengths.push(length.ok_or_else(|| wrong(file, line, "has no [frames=N]".into()))? as usize);
    }

    if lengths.is_empty() {
        return Err(Error::Malformed {
            file: file.to_owned(),
            problem: "lists no sequence".into(),
        });
    }

    Ok(lengths)
}
