//! Decodes the supported messages of bags: ROS 2 in CDR, Foxglove in Protobuf.

use std::io::Cursor;

use byteorder::{BigEndian, LittleEndian};
use foxglove::Decode;
use image::{ColorType, ExtendedColorType, ImageEncoder};
use nalgebra::Quaternion;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::message::{Kind, Message, ZSTD};
use seese3_core::geometry::{Pose, pose_from_quaternion};

/// An image and its capture time.
#[derive(Debug)]
pub struct Image {
    pub time_ns: i64,
    pub picture: Picture,
}

/// The pose of one frame in another at one time, `parent_from_child`.
#[derive(Debug, Clone)]
pub struct StampedPose {
    pub time_ns: i64,
    pub parent: String,
    /// The frame whose pose this is; empty if the message does not name it.
    pub child: String,
    pub pose: Pose,
}

/// The content of an image message.
#[derive(Debug)]
pub enum Picture {
    /// An image file, with the format that the message states.
    Compressed { format: String, bytes: Vec<u8> },
    /// Rows of pixels.
    Raw(RosImage),
}

/// An image as a file.
pub struct ImageFile {
    pub extension: &'static str,
    pub bytes: Vec<u8>,
}

impl Picture {
    /// Converts the image to a JPEG or PNG file. The error describes the problem.
    pub fn file(&self) -> Result<ImageFile, String> {
        match self {
            Self::Compressed { bytes, format } => {
                let extension = match bytes.as_slice() {
                    [0xFF, 0xD8, ..] => "jpg",
                    [0x89, b'P', b'N', b'G', ..] => "png",
                    _ => return Err(format!("its images ('{format}') are neither JPEG nor PNG")),
                };
                Ok(ImageFile {
                    extension,
                    bytes: bytes.clone(),
                })
            }
            Self::Raw(image) => image.png(),
        }
    }
}

/// Decodes the poses in a message; an image has none. A zero stamp is replaced by the time of
/// recording. The error describes the problem.
pub fn poses_of(message: &Message<'_>) -> Result<Vec<StampedPose>, String> {
    decode_poses(message.kind, uncompressed(message)?, message.log_time_ns)
}

/// The camera frame of an image message; empty if the message names none.
pub fn camera_frame_of(message: &Message<'_>) -> Result<String, String> {
    let data = uncompressed(message)?;
    match message.kind {
        // The header comes first, so the pixels need not be decoded.
        Kind::RosCompressedImage | Kind::RosImage => Ok(cdr::<RosHeader>(data)?.frame_id),
        Kind::FoxgloveCompressedImage => {
            let image: foxglove::messages::CompressedImage = protobuf(data)?;
            Ok(image.frame_id)
        }
        _ => Ok(String::new()),
    }
}

/// The bytes of a message. Zstd-compressed messages are an error; CDR begins with a zero byte, so
/// it cannot be mistaken for zstd.
fn uncompressed<'a>(message: &Message<'a>) -> Result<&'a [u8], String> {
    if message.data.starts_with(ZSTD) {
        return Err(
            "messages are compressed one by one; `ros2 bag convert` the bag without compression_mode"
                .to_owned(),
        );
    }
    Ok(message.data)
}

/// Decodes an image message; `None` if the message is of another kind.
pub fn image_of(message: &Message<'_>) -> Result<Option<Image>, String> {
    let data = uncompressed(message)?;
    let image = |time_ns: i64, picture: Picture| {
        Some(Image {
            time_ns: stamp_or(time_ns, message.log_time_ns),
            picture,
        })
    };

    Ok(match message.kind {
        Kind::RosCompressedImage => {
            let message: RosCompressedImage = cdr(data)?;
            let picture = Picture::Compressed {
                format: message.format,
                bytes: message.data,
            };
            image(message.header.time_ns(), picture)
        }
        Kind::RosImage => {
            let message: RosImage = cdr(data)?;
            image(message.header.time_ns(), Picture::Raw(message))
        }
        Kind::FoxgloveCompressedImage => {
            let message: foxglove::messages::CompressedImage = protobuf(data)?;
            let picture = Picture::Compressed {
                format: message.format,
                bytes: message.data.to_vec(),
            };
            image(foxglove_time(message.timestamp), picture)
        }
        _ => None,
    })
}

/// The stamp of a message, or its time of recording if the stamp is zero.
fn stamp_or(stamp_ns: i64, log_time_ns: i64) -> i64 {
    if stamp_ns == 0 { log_time_ns } else { stamp_ns }
}

fn decode_poses(kind: Kind, data: &[u8], log_time: i64) -> Result<Vec<StampedPose>, String> {
    let stamped = |time_ns: i64, parent: String, child: String, pose: Pose| StampedPose {
        time_ns: stamp_or(time_ns, log_time),
        parent,
        child,
        pose,
    };
    let of_header = |header: RosHeader, child: String, pose: &RosPose| {
        let time = header.time_ns();
        Ok::<_, String>(vec![stamped(time, header.frame_id, child, pose.pose()?)])
    };

    match kind {
        Kind::RosPose => {
            let message: RosPoseStamped = cdr(data)?;
            of_header(message.header, String::new(), &message.pose)
        }
        Kind::RosPoseWithCovariance => {
            // The covariance after the pose is not decoded.
            let message: RosPoseStamped = cdr(data)?;
            of_header(message.header, String::new(), &message.pose)
        }
        Kind::RosOdometry => {
            let message: RosOdometry = cdr(data)?;
            of_header(message.header, message.child_frame_id, &message.pose)
        }
        Kind::RosTransforms => {
            let message: RosTransforms = cdr(data)?;
            let read = |one: RosTransformStamped| {
                let pose = RosPose {
                    position: one.translation,
                    orientation: one.rotation,
                };
                let time = one.header.time_ns();
                Ok(stamped(
                    time,
                    one.header.frame_id,
                    one.child_frame_id,
                    pose.pose()?,
                ))
            };
            message.transforms.into_iter().map(read).collect()
        }
        Kind::FoxglovePose => {
            let message: foxglove::messages::PoseInFrame = protobuf(data)?;
            let pose = foxglove_pose(message.pose)?;
            let time = foxglove_time(message.timestamp);
            Ok(vec![stamped(time, message.frame_id, String::new(), pose)])
        }
        Kind::FoxgloveOdometry => {
            let message: foxglove::messages::Odometry = protobuf(data)?;
            let pose = foxglove_pose(message.pose)?;
            let time = foxglove_time(message.timestamp);
            Ok(vec![stamped(
                time,
                message.frame_id,
                message.body_frame_id,
                pose,
            )])
        }
        Kind::FoxgloveTransform => {
            let message: foxglove::messages::FrameTransform = protobuf(data)?;
            Ok(vec![foxglove_transform(message, log_time)?])
        }
        Kind::FoxgloveTransforms => {
            let message: foxglove::messages::FrameTransforms = protobuf(data)?;
            let read = |one| foxglove_transform(one, log_time);
            message.transforms.into_iter().map(read).collect()
        }
        Kind::RosCompressedImage | Kind::RosImage | Kind::FoxgloveCompressedImage => Ok(Vec::new()),
    }
}

/// Decodes a ROS 2 message. The second of its first four bytes gives the byte order.
fn cdr<T: DeserializeOwned>(data: &[u8]) -> Result<T, String> {
    let wrong =
        |error: cdr_encoding::Error| format!("the message is truncated or malformed: {error}");
    match data {
        [_, order, _, _, rest @ ..] if order % 2 == 1 => {
            cdr_encoding::from_bytes::<T, LittleEndian>(rest)
                .map(|(message, _)| message)
                .map_err(wrong)
        }
        [_, _, _, _, rest @ ..] => cdr_encoding::from_bytes::<T, BigEndian>(rest)
            .map(|(message, _)| message)
            .map_err(wrong),
        _ => Err("the message is truncated".to_owned()),
    }
}

fn protobuf<T: Decode>(data: &[u8]) -> Result<T, String> {
    T::decode(data).map_err(|error| format!("the message is truncated or malformed: {error}"))
}

/// Nanoseconds since the epoch; 0 if there is no time.
fn foxglove_time(time: Option<foxglove::messages::Timestamp>) -> i64 {
    time.map_or(0, |time| {
        i64::try_from(time.total_nanos()).unwrap_or(i64::MAX)
    })
}

fn foxglove_pose(pose: Option<foxglove::messages::Pose>) -> Result<Pose, String> {
    let pose = pose.unwrap_or_default();
    foxglove_parts(pose.position, pose.orientation)
}

fn foxglove_transform(
    message: foxglove::messages::FrameTransform,
    log_time: i64,
) -> Result<StampedPose, String> {
    let time_ns = foxglove_time(message.timestamp);
    Ok(StampedPose {
        time_ns: stamp_or(time_ns, log_time),
        pose: foxglove_parts(message.translation, message.rotation)?,
        parent: message.parent_frame_id,
        child: message.child_frame_id,
    })
}

fn foxglove_parts(
    translation: Option<foxglove::messages::Vector3>,
    rotation: Option<foxglove::messages::Quaternion>,
) -> Result<Pose, String> {
    let t = translation.unwrap_or_default();
    let q = rotation.unwrap_or_default();
    RosPose {
        position: RosVector {
            x: t.x,
            y: t.y,
            z: t.z,
        },
        orientation: RosQuaternion {
            x: q.x,
            y: q.y,
            z: q.z,
            w: q.w,
        },
    }
    .pose()
}

#[derive(Debug, Deserialize)]
pub struct RosHeader {
    sec: i32,
    nanosec: u32,
    frame_id: String,
}

impl RosHeader {
    fn time_ns(&self) -> i64 {
        i64::from(self.sec) * 1_000_000_000 + i64::from(self.nanosec)
    }
}

#[derive(Debug, Deserialize)]
struct RosCompressedImage {
    header: RosHeader,
    format: String,
    data: Vec<u8>,
}

#[derive(Debug, Deserialize)]
pub struct RosImage {
    header: RosHeader,
    height: u32,
    width: u32,
    encoding: String,
    #[allow(dead_code, reason = "only for 16-bit images, which are unsupported")]
    is_bigendian: u8,
    /// Bytes per row, including padding.
    step: u32,
    data: Vec<u8>,
}

impl RosImage {
    /// The image as a PNG file.
    fn png(&self) -> Result<ImageFile, String> {
        let (bytes_per_pixel, is_blue_first) = match self.encoding.as_str() {
            "rgb8" | "8UC3" => (3, false),
            "bgr8" => (3, true),
            "rgba8" => (4, false),
            "bgra8" => (4, true),
            "mono8" | "8UC1" => (1, false),
            other => {
                return Err(format!(
                    "its images are encoded as '{other}'; supported are rgb8, bgr8, rgba8, bgra8, mono8, 8UC1 and 8UC3"
                ));
            }
        };

        let row = self.width as usize * bytes_per_pixel;
        let step = self.step as usize;
        if row == 0
            || self.height == 0
            || step < row
            || self.data.len() / step < self.height as usize
        {
            return Err(format!(
                "an image of {}x{} pixels has rows of {step} bytes and {} bytes in all",
                self.width,
                self.height,
                self.data.len()
            ));
        }

        let rows = self.data.chunks_exact(step).take(self.height as usize);
        let mut pixels: Vec<u8> = rows.flat_map(|bytes| &bytes[..row]).copied().collect();
        if is_blue_first {
            for pixel in pixels.chunks_exact_mut(bytes_per_pixel) {
                pixel.swap(0, 2);
            }
        }

        let color = match bytes_per_pixel {
            1 => ColorType::L8,
            3 => ColorType::Rgb8,
            _ => ColorType::Rgba8,
        };
        let mut bytes = Vec::new();
        image::codecs::png::PngEncoder::new(Cursor::new(&mut bytes))
            .write_image(
                &pixels,
                self.width,
                self.height,
                ExtendedColorType::from(color),
            )
            .map_err(|error| format!("an image cannot be written as PNG: {error}"))?;
        Ok(ImageFile {
            extension: "png",
            bytes,
        })
    }
}

#[derive(Debug, Clone, Copy, Deserialize)]
struct RosVector {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Debug, Clone, Copy, Deserialize)]
struct RosQuaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

#[derive(Debug, Deserialize)]
struct RosPose {
    position: RosVector,
    orientation: RosQuaternion,
}

impl RosPose {
    fn pose(&self) -> Result<Pose, String> {
        let RosVector { x, y, z } = self.position;
        let q = self.orientation;
        pose_from_quaternion([x, y, z], Quaternion::new(q.w, q.x, q.y, q.z))
            .map_err(|error| error.to_string())
    }
}

#[derive(Debug, Deserialize)]
struct RosPoseStamped {
    header: RosHeader,
    pose: RosPose,
}

/// The first fields of nav_msgs/msg/Odometry.
#[derive(Debug, Deserialize)]
struct RosOdometry {
    header: RosHeader,
    child_frame_id: String,
    pose: RosPose,
}

#[derive(Debug, Deserialize)]
struct RosTransformStamped {
    header: RosHeader,
    child_frame_id: String,
    translation: RosVector,
    rotation: RosQuaternion,
}

#[derive(Debug, Deserialize)]
struct RosTransforms {
    transforms: Vec<RosTransformStamped>,
}
