//! KITTI odometry: a pose file with 12 numbers per line, the first three rows of
//! `world_from_camera`, meters. Images are in a folder, sorted by the numbers in their names.
//!
//! The world frame is the camera of the first frame. The optional times are seconds, one per line.

use std::path::{Path, PathBuf};

use nalgebra::Matrix4;

use super::collect::{About, Collected};
use super::folder::image_files;
use super::text::number;
use super::{Error, Reader, Recording, read_text};

/// The files of one sequence.
#[derive(Debug, Clone, Default)]
pub struct Kitti {
    /// The folder of the images; `None` for a room without images.
    pub images: Option<PathBuf>,
    /// The file of times, seconds; `None` if they are not known.
    pub times: Option<PathBuf>,
}

/// Reads a pose file with its optional images and times.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if the number of images or times differs
/// from the number of poses, or if no usable frame is left. The message names the file and the
/// line.
pub fn read_kitti(
    poses: &Path,
    beside: &Kitti,
    reader: &mut Reader<'_>,
) -> Result<Recording, Error> {
    let matrices = read_matrices(poses)?;
    let times = beside.times.as_deref().map(read_times).transpose()?;
    let images = beside.images.as_deref().map(image_files).transpose()?;

    let as_many = |file: &Path, what: &str, count: usize| {
        if count == matrices.len() {
            return Ok(());
        }
        Err(Error::Malformed {
            file: file.to_owned(),
            problem: format!(
                "has {count} {what}, {} has {} poses; each pose needs one",
                poses.display(),
                matrices.len()
            )
            .into(),
        })
    };
    if let Some((file, times)) = beside.times.as_deref().zip(times.as_ref()) {
        as_many(file, "times", times.len())?;
    }
    if let Some((folder, images)) = beside.images.as_deref().zip(images.as_ref()) {
        as_many(folder, "images", images.len())?;
    }

    let mut collected = Collected::default();
    for (row, matrix) in matrices.iter().enumerate() {
        (reader.progress)(row, matrices.len());
        let image = images.as_ref().map(|images| images[row].clone());
        let about = About {
            name: image.clone().unwrap_or_else(|| format!("{row:06}")),
            image,
            timestamp_ns: times.as_ref().map(|times| times[row]),
            ..About::default()
        };
        collected.take(about, matrix, poses)?;
    }

    collected.finish(beside.images.as_deref().unwrap_or(Path::new("")), reader)
}

fn read_matrices(file: &Path) -> Result<Vec<Matrix4<f64>>, Error> {
    let text = read_text(file)?;
    let mut matrices = Vec::new();
    for (line, row) in (1..).zip(text.lines()) {
        let numbers: Result<Vec<f64>, Error> = row
            .split_whitespace()
            .map(|word| number(file, line, word))
            .collect();
        let mut numbers = numbers?;
        if numbers.is_empty() {
            continue;
        }

        if numbers.len() != 12 {
            return Err(Error::Line {
                file: file.to_owned(),
                line,
                problem: format!("has {} numbers, expected 12", numbers.len()).into(),
            });
        }
        numbers.extend([0.0, 0.0, 0.0, 1.0]);
        matrices.push(Matrix4::from_row_slice(&numbers));
    }

    Ok(matrices)
}

/// Times, nanoseconds, from seconds in decimal or scientific notation.
fn read_times(file: &Path) -> Result<Vec<i64>, Error> {
    let text = read_text(file)?;
    let words = (1..)
        .zip(text.lines())
        .filter(|(_, row)| !row.trim().is_empty());

    let time = |(line, row): (usize, &str)| {
        let seconds = number(file, line, row.trim())?;
        if seconds.abs() < 9.2e9 {
            return Ok((seconds * 1e9).round() as i64);
        }
        Err(Error::Line {
            file: file.to_owned(),
            line,
            problem: format!("'{}' is not a time in seconds", row.trim()).into(),
        })
    };
    words.map(time).collect()
}
