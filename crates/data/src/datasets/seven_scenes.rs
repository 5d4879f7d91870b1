//! 7-Scenes: `SCENE/seq-XX/frame-XXXXXX.{color.*,pose.txt}`, poses camera-to-world, meters.
//!
//! - The published poses are those of the depth sensor. They are used as poses of the color camera,
//!   as by most users of the data set, unless a calibration is given.
//! - All sequences of a scene form one room, but no pair of frames spans two sequences.
//!   `TrainSplit.txt` and `TestSplit.txt` list the sequence `seq-0N` as `sequenceN`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::collect::{About, Collected};
use super::text::read_matrix;
use super::{DropReason, Error, Reader, Recording, entries, read_text};
use seese3_core::Cause;
use seese3_core::geometry::{Pose, pose_from_matrix};

/// What to read of a scene.
#[derive(Debug, Clone, Default)]
pub struct SevenScenes {
    /// A single sequence, for instance `seq-01`; all of them if `None`.
    pub sequence: Option<String>,
    /// A text file with the 4×4 matrix `rgb_from_depth`, meters. If it is given, the poses become
    /// those of the color camera.
    pub rgb_from_depth: Option<PathBuf>,
}

/// Reads all sequences of a scene, or only one: the chosen one, or `folder` itself if it contains
/// frames.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`. The message names the file or folder.
pub fn read_seven_scenes(
    folder: &Path,
    choice: &SevenScenes,
    reader: &mut Reader<'_>,
) -> Result<Recording, Error> {
    let depth_from_rgb = choice
        .rgb_from_depth
        .as_deref()
        .map(calibration)
        .transpose()?;

    let (root, sequences) = sequences_of(folder, choice.sequence.as_deref())?;

    // The data set's split assigns whole sequences, so it has no meaning for a single one.
    let held_out = if sequences.len() > 1 {
        dataset_split(&root, &sequences)?
    } else {
        None
    };

    let several = sequences.len() > 1;
    let mut frames = Vec::new();
    for (number, sequence) in (0..).zip(&sequences) {
        let files = entries(&root.join(sequence))?;
        let stem = |name: &String| {
            Some(name.split('.').next()?.to_owned()).filter(|stem| stem.starts_with("frame-"))
        };

        // A frame may have only an image or only a pose. All stems are collected, so that
        // incomplete frames are reported as dropped.
        let stems: BTreeSet<String> = files.iter().filter_map(stem).collect();

        let images: BTreeMap<&str, &String> = files
            .iter()
            .filter_map(|name| Some((image_stem(name)?, name)))
            .collect();

        for stem in stems {
            let image = images
                .get(stem.as_str())
                .map(|name| format!("{sequence}/{name}"));

            let about = About {
                name: format!("{sequence}/{stem}"),
                number: stem.trim_start_matches("frame-").parse().ok(),
                image,
                sequence: several.then_some(number),
                held_out: held_out
                    .as_ref()
                    .map(|held_out| held_out.contains(sequence)),
                ..About::default()
            };

            frames.push(about);
        }
    }

    all_or_none_numbered(&mut frames);
    let count = frames.len();
    let mut collected = Collected::default();
    for (done, about) in frames.into_iter().enumerate() {
        (reader.progress)(done, count);
        let file = root.join(format!("{}.pose.txt", about.name));
        match read_matrix(&file)? {
            Err(DropReason::MissingPoseFile) => collected.drop_without(
                format!("{}.pose.txt", about.name),
                about.name,
                DropReason::MissingPoseFile,
            ),
            Err(reason) => collected.drop(about.name, reason),
            Ok(_) if about.image.is_none() => collected.drop_without(
                format!("{}.color.png or .color.jpg", about.name),
                about.name,
                DropReason::MissingImage,
            ),
            Ok(world_from_depth) => collected.take(about, &world_from_depth, &file)?,
        }
    }

    let mut recording = collected.finish(&root, reader)?;

    // The calibration is a fixed transform between the two sensors: world_from_rgb =
    // world_from_depth · depth_from_rgb.
    if let Some(depth_from_rgb) = depth_from_rgb {
        recording
            .frames
            .poses
            .iter_mut()
            .for_each(|world_from_depth| *world_from_depth *= depth_from_rgb);
    }

    Ok(recording)
}

/// Clears all frame numbers if one frame has none, because they form a column.
fn all_or_none_numbered(frames: &mut [About]) {
    if frames.iter().any(|about| about.number.is_none()) {
        frames.iter_mut().for_each(|about| about.number = None);
    }
}

/// The frame stem of a color image's file name; `None` for any other file. Extensions are compared
/// case-insensitively.
fn image_stem(name: &str) -> Option<&str> {
    let (stem, extension) = name.rsplit_once('.')?;
    let is_image = ["png", "jpg"]
        .iter()
        .any(|wanted| wanted.eq_ignore_ascii_case(extension));
    if is_image {
        stem.strip_suffix(".color")
    } else {
        None
    }
}

/// The scene's folder and the names of the sequences to read from it.
fn sequences_of(folder: &Path, wanted: Option<&str>) -> Result<(PathBuf, Vec<String>), Error> {
    let malformed = |problem: Cause| Error::Malformed {
        file: folder.to_owned(),
        problem,
    };

    let names = entries(folder)?;
    let sequences: Vec<String> = names
        .iter()
        .filter(|name| name.starts_with("seq-"))
        .cloned()
        .collect();

    if let Some(wanted) = wanted {
        if !sequences.iter().any(|name| name == wanted) {
            return Err(malformed(
                format!(
                    "has no sequence '{wanted}'; it has {}",
                    sequences.join(", ")
                )
                .into(),
            ));
        }

        return Ok((folder.to_owned(), vec![wanted.to_owned()]));
    }

    // `folder` is a single sequence. Its parent becomes the root, so that names and image paths are
    // the same as when the whole scene is read.
    if names.iter().any(|name| name.starts_with("frame-")) {
        // A path such as `.` has neither a parent nor a name until it is resolved.
        let folder = folder.canonicalize().map_err(|cause| Error::Io {
            file: folder.to_owned(),
            cause,
        })?;
        let name = folder
            .file_name()
            .map(|name| name.to_string_lossy().into_owned());

        return match (folder.parent(), name) {
            (Some(scene), Some(name)) => Ok((scene.to_owned(), vec![name])),
            _ => Err(malformed("is the root folder".into())),
        };
    }

    if sequences.is_empty() {
        return Err(malformed(
            "holds neither frame-*.pose.txt nor a folder seq-XX".into(),
        ));
    }

    Ok((folder.to_owned(), sequences))
}

/// The sequences that the scene's own split holds out for testing; `None` if it has no split files.
fn dataset_split(scene: &Path, sequences: &[String]) -> Result<Option<BTreeSet<String>>, Error> {
    let files = ["TrainSplit.txt", "TestSplit.txt"].map(|name| scene.join(name));
    if files.iter().all(|file| !file.is_file()) {
        return Ok(None);
    }

    // Every sequence must be on exactly one side of the split.
    let [train, test] = [split_file(&files[0])?, split_file(&files[1])?];
    if let Some(both) = train.intersection(&test).next() {
        return Err(Error::Malformed {
            file: files[1].clone(),
            problem: format!("lists {both}, as TrainSplit.txt does").into(),
        });
    }

    if let Some(unlisted) = sequences
        .iter()
        .find(|name| !train.contains(*name) && !test.contains(*name))
    {
        let problem = format!(
            "does not list {unlisted}, nor does TrainSplit.txt; add it, or move the sequence away"
        );
        return Err(Error::Malformed {
            file: files[1].clone(),
            problem: problem.into(),
        });
    }

    Ok(Some(test))
}

fn split_file(file: &Path) -> Result<BTreeSet<String>, Error> {
    let text = read_text(file)?;
    let lines = (1..)
        .zip(text.lines())
        .filter(|(_, line)| !line.trim().is_empty());

    let name = |(line, text): (usize, &str)| {
        let number = text
            .trim()
            .strip_prefix("sequence")
            .and_then(|number| number.parse::<u32>().ok());

        let problem = format!("'{}' is not of the form sequenceN", text.trim());
        number
            .map(|number| format!("seq-{number:02}"))
            .ok_or_else(|| Error::Line {
                file: file.to_owned(),
                line,
                problem: problem.into(),
            })
    };

    lines.map(name).collect()
}

/// `depth_from_rgb`: the inverse of the rigid transform `rgb_from_depth` in a file.
fn calibration(file: &Path) -> Result<Pose, Error> {
    let malformed = |problem: Cause| Error::Malformed {
        file: file.to_owned(),
        problem,
    };
    let matrix = read_matrix(file)?.map_err(|reason| malformed(reason.into()))?;

    let (rgb_from_depth, _) = pose_from_matrix(&matrix).map_err(|_| {
        malformed("is not a rigid transform; expected rgb_from_depth, 4×4, meters".into())
    })?;
    Ok(rgb_from_depth.inverse())
}
