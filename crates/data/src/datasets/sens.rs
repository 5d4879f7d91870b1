//! ScanNet's `.sens`: one file with color and depth images and camera-to-world poses, meters,
//! little-endian.
//!
//! ```text
//! u32 version = 4, u64 length, name,
//! 4 × (4×4 f32): intrinsics and extrinsics of color and depth,
//! i32 color compression (1 png, 2 jpeg), i32 depth compression,
//! 4 × u32 sizes, f32 depth shift, u64 number of frames;
//! each frame: 4×4 f32 pose, u64 color time, u64 depth time, u64 color bytes, u64 depth bytes,
//! the bytes of both images
//! ```
//!
//! Images are not extracted: the image of a frame is `FILE@OFFSET+LENGTH`, in bytes. Times are
//! assumed to be microseconds, and are kept only if they increase from frame to frame. Every size
//! in the file is checked against the remaining bytes before it is used.

use seese3_core::Cause;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use nalgebra::Matrix4;

use super::collect::{About, Collected};
use super::scannet::is_suspect;
use super::{DropReason, Error, Reader, Recording};

const VERSION: u32 = 4;
const MATRIX_BYTES: u64 = 64;
/// The size of a frame's header: the pose, two times and two sizes.
const FRAME_HEADER_BYTES: u64 = MATRIX_BYTES + 32;
const LONGEST_NAME: u64 = 4_096;

/// Reads the frames of a `.sens` file.
///
/// # Errors
/// [`Error::Malformed`] if the file is not a `.sens` file of version 4, or ends before its last
/// frame: a truncated file is refused, not read in part. [`Error::Io`] if it cannot be read.
/// [`Error::NoFrames`] or [`Error::Strict`] if frames cannot be used.
pub fn read_sens(path: &Path, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    let mut file = Sens::open(path)?;
    let frame_count = file.header()?;

    let file_name = path
        .file_name()
        .map(|name| name.to_string_lossy().into_owned())
        .unwrap_or_default();

    let mut collected = Collected::default();
    for number in 0..frame_count {
        (reader.progress)(number as usize, frame_count as usize);
        let frame = file.frame(number)?;
        let name = number.to_string();
        let image = Some(format!("{file_name}@{}+{}", frame.offset, frame.bytes));

        // A time beyond the range of nanoseconds saturates. Two saturated times do not increase, so
        // the check below then discards all times.
        let timestamp_ns = Some(
            i64::try_from(frame.time_us)
                .unwrap_or(i64::MAX)
                .saturating_mul(1_000),
        );

        let about = About {
            name,
            image,
            number: i64::try_from(number).ok(),
            timestamp_ns,
            ..About::default()
        };

        if is_suspect(&frame.pose, number == 0) {
            collected.drop(about.name, DropReason::SuspectIdentityPose);
        } else {
            collected.take(about, &frame.pose, path)?;
        }
    }

    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let mut recording = collected.finish(folder, reader)?;

    // Times that do not increase are not usable timestamps; the recording then has none.
    if !recording.frames.timestamps_ns.is_sorted_by(|a, b| a < b) {
        recording.frames.timestamps_ns.clear();
    }

    Ok(recording)
}

struct Frame {
    pose: Matrix4<f64>,
    time_us: u64,
    /// The offset of the color image in the file, bytes.
    offset: u64,
    bytes: u64,
}

struct Sens<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    at: u64,
    size: u64,
}

impl<'a> Sens<'a> {
    fn open(path: &'a Path) -> Result<Self, Error> {
        let io = |cause| Error::Io {
            file: path.to_owned(),
            cause,
        };
        let file = seese3_files::open(path).map_err(io)?;
        let size = file.metadata().map_err(io)?.len();

        Ok(Self {
            path,
            reader: BufReader::new(file),
            at: 0,
            size,
        })
    }

    /// Reads the header and returns the number of frames that follow it.
    fn header(&mut self) -> Result<u64, Error> {
        let version = u32::from_le_bytes(self.array("its version")?);
        if version != VERSION {
            return Err(self.malformed(
                format!("is version {version} of the format, expected {VERSION}").into(),
            ));
        }

        let name = self.number("its name's length")?;
        if name > LONGEST_NAME {
            return Err(self.malformed(
                format!("has a sensor name of {name} bytes; is it a .sens file?").into(),
            ));
        }

        self.skip(name, "its name")?;
        self.skip(4 * MATRIX_BYTES, "its calibration")?;
        let color = i32::from_le_bytes(self.array("its color compression")?);
        if !matches!(color, 1 | 2) {
            let problem =
                format!("stores color in format {color}; only PNG (1) and JPEG (2) are read");
            return Err(self.malformed(problem.into()));
        }

        // The depth compression, the four image sizes and the depth shift are not needed.
        self.skip(4 + 4 * 4 + 4, "its sizes")?;
        let frames = self.number("its number of frames")?;

        // Even a frame without images needs its header, so a number that cannot fit is refused
        // before any frame is read.
        if frames > (self.size - self.at) / FRAME_HEADER_BYTES {
            let problem = format!(
                "is truncated: its header states {frames} frames, which do not fit into {} bytes",
                self.size
            );
            return Err(self.malformed(problem.into()));
        }

        Ok(frames)
    }

    fn frame(&mut self, number: u64) -> Result<Frame, Error> {
        let what = format!("frame {number}");
        let mut numbers = [0.0; 16];
        for value in &mut numbers {
            *value = f64::from(f32::from_le_bytes(self.array(&what)?));
        }

        let time_us = self.number(&what)?;

        // The time of the depth image is not used.
        self.number(&what)?;
        let bytes = self.number(&what)?;
        let depth = self.number(&what)?;

        // The images are skipped. Only the position of the color image is kept.
        let offset = self.at;
        self.skip(bytes, &what)?;
        self.skip(depth, &what)?;

        Ok(Frame {
            pose: Matrix4::from_row_slice(&numbers),
            time_us,
            offset,
            bytes,
        })
    }

    fn number(&mut self, what: &str) -> Result<u64, Error> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N], Error> {
        self.check(N as u64, what)?;
        let mut bytes = [0; N];

        self.reader
            .read_exact(&mut bytes)
            .map_err(|cause| Error::Io {
                file: self.path.to_owned(),
                cause,
            })?;

        self.at += N as u64;
        Ok(bytes)
    }

    fn skip(&mut self, bytes: u64, what: &str) -> Result<(), Error> {
        self.check(bytes, what)?;
        self.at += bytes;

        // `seek_relative` keeps the read buffer where it can, but takes an i64.
        let moved = match i64::try_from(bytes) {
            Ok(bytes) => self.reader.seek_relative(bytes),
            Err(_) => self.reader.seek(SeekFrom::Start(self.at)).map(|_| ()),
        };

        moved.map_err(|cause| Error::Io {
            file: self.path.to_owned(),
            cause,
        })
    }

    fn check(&self, bytes: u64, what: &str) -> Result<(), Error> {
        if bytes <= self.size - self.at {
            return Ok(());
        }

        Err(self.malformed(
            format!(
                "is truncated in {what}, at byte {} of {}; copy it again",
                self.at, self.size
            )
            .into(),
        ))
    }

    fn malformed(&self, problem: Cause) -> Error {
        Error::Malformed {
            file: self.path.to_owned(),
            problem,
        }
    }
}
