//! MCAP files with poses, transforms and images, for Foxglove, Rerun and other viewers. Messages
//! are Protobuf in Foxglove's schemas, taken from Foxglove's own library.

use std::collections::BTreeMap;
use std::io::Cursor;

use foxglove::Encode;
use foxglove::messages::{
    CompressedImage, FrameTransform, Odometry, PoseInFrame, Quaternion, Timestamp, Vector3,
};
use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};

use seese3_core::geometry::{Pose, Twist};

/// An MCAP recording under construction, in memory.
pub struct McapRecording {
    writer: Writer<Cursor<Vec<u8>>>,
    channels: BTreeMap<String, u16>,
    sequence: u32,
}

/// A tracker's estimate of a camera's pose and velocity.
#[derive(Debug, Clone)]
pub struct RecordedOdometry<'a> {
    /// The frame of the pose, for instance `map`.
    pub frame: &'a str,
    /// The frame of the camera.
    pub child_frame: &'a str,
    /// `frame_from_camera`.
    pub pose: Pose,
    /// The covariance of the pose, 6×6, row-major, in ROS order; empty if it is not known.
    pub covariance: &'a [f64],
    /// The velocity in the camera's frame, m/s and rad/s, if it is known.
    pub velocity: Option<Twist>,
}

impl McapRecording {
    /// Creates a recording without messages.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot begin the file.
    pub fn new() -> Result<Self, McapError> {
        // Not compressed, so that every viewer can open it; images are already compressed.
        let options = WriteOptions::new().compression(None).library("seese3");
        let writer = options.create(Cursor::new(Vec::new()))?;

        Ok(Self {
            writer,
            channels: BTreeMap::new(),
            sequence: 0,
        })
    }

    /// Adds the pose `frame_from_camera` as a foxglove.PoseInFrame message on `topic`.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot write the message.
    pub fn pose(
        &mut self,
        topic: &str,
        time_ns: i64,
        frame: &str,
        pose: &Pose,
    ) -> Result<(), McapError> {
        let message = PoseInFrame {
            timestamp: Some(timestamp(time_ns)),
            frame_id: frame.to_owned(),
            pose: Some(foxglove_pose(pose)),
        };
        self.message(topic, time_ns, &message)
    }

    /// Adds a pose with its covariance and a velocity as a foxglove.Odometry message on `topic`.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot write the message.
    pub fn odometry(
        &mut self,
        topic: &str,
        time_ns: i64,
        odometry: &RecordedOdometry<'_>,
    ) -> Result<(), McapError> {
        let vector = |v: nalgebra::Vector3<f64>| Vector3 {
            x: v.x,
            y: v.y,
            z: v.z,
        };
        let message = Odometry {
            timestamp: Some(timestamp(time_ns)),
            frame_id: odometry.frame.to_owned(),
            body_frame_id: odometry.child_frame.to_owned(),
            pose: Some(foxglove_pose(&odometry.pose)),
            linear_velocity: odometry.velocity.map(|twist| vector(twist.linear)),
            angular_velocity: odometry.velocity.map(|twist| vector(twist.angular)),
            pose_covariance: odometry.covariance.to_vec(),
            ..Odometry::default()
        };
        self.message(topic, time_ns, &message)
    }

    /// Adds the pose `parent_from_child` as a foxglove.FrameTransform message on `/tf`.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot write the message.
    pub fn transform(
        &mut self,
        time_ns: i64,
        parent: &str,
        child: &str,
        pose: &Pose,
    ) -> Result<(), McapError> {
        let message = FrameTransform {
            timestamp: Some(timestamp(time_ns)),
            parent_frame_id: parent.to_owned(),
            child_frame_id: child.to_owned(),
            translation: Some(translation(pose)),
            rotation: Some(rotation(pose)),
        };
        self.message("/tf", time_ns, &message)
    }

    /// Adds the bytes of a JPEG or PNG file as a foxglove.CompressedImage message on
    /// `/camera/image`.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot write the message.
    pub fn image(&mut self, time_ns: i64, frame: &str, file: &[u8]) -> Result<(), McapError> {
        // The eight-byte signature of a PNG file begins with these four; every other file is
        // taken for JPEG.
        let format = if file.starts_with(&[0x89, b'P', b'N', b'G']) {
            "png"
        } else {
            "jpeg"
        };
        let message = CompressedImage {
            timestamp: Some(timestamp(time_ns)),
            frame_id: frame.to_owned(),
            data: bytes::Bytes::copy_from_slice(file),
            format: format.to_owned(),
        };
        self.message("/camera/image", time_ns, &message)
    }

    /// Completes the recording and returns the bytes of the file.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot complete the file.
    pub fn finish(mut self) -> Result<Vec<u8>, McapError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner().into_inner())
    }

    fn message<M: Encode>(
        &mut self,
        topic: &str,
        time_ns: i64,
        message: &M,
    ) -> Result<(), McapError> {
        let channel_id = self.channel::<M>(topic)?;
        self.sequence += 1;

        // MCAP times are unsigned nanoseconds since the epoch: earlier times are clamped to it.
        let log_time = u64::try_from(time_ns).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence: self.sequence,
            log_time,
            publish_time: log_time,
        };

        let mut encoded = Vec::new();
        message
            .encode(&mut encoded)
            .map_err(|error| McapError::Io(std::io::Error::other(error.to_string())))?;
        self.writer.write_to_known_channel(&header, &encoded)
    }

    fn channel<M: Encode>(&mut self, topic: &str) -> Result<u16, McapError> {
        // A channel, and the schema behind it, is registered with the first message on its topic.
        if let Some(&id) = self.channels.get(topic) {
            return Ok(id);
        }

        let schema_id = match M::get_schema() {
            Some(schema) => self
                .writer
                .add_schema(&schema.name, &schema.encoding, &schema.data)?,
            None => 0,
        };
        let id = self.writer.add_channel(
            schema_id,
            topic,
            &M::get_message_encoding(),
            &BTreeMap::new(),
        )?;
        self.channels.insert(topic.to_owned(), id);

        Ok(id)
    }
}

/// A message's timestamp. Times before the epoch are clamped to the epoch.
fn timestamp(time_ns: i64) -> Timestamp {
    let time_ns = time_ns.max(0);
    let seconds = u32::try_from(time_ns / 1_000_000_000).unwrap_or(u32::MAX);
    // The remainder is below 10⁹, so it fits into 32 bits.
    Timestamp::new(seconds, (time_ns % 1_000_000_000) as u32)
}

fn foxglove_pose(pose: &Pose) -> foxglove::messages::Pose {
    foxglove::messages::Pose {
        position: Some(translation(pose)),
        orientation: Some(rotation(pose)),
    }
}

fn translation(pose: &Pose) -> Vector3 {
    let t = pose.translation.vector;
    Vector3 {
        x: t.x,
        y: t.y,
        z: t.z,
    }
}

fn rotation(pose: &Pose) -> Quaternion {
    let q = pose.rotation.coords;
    Quaternion {
        x: q.x,
        y: q.y,
        z: q.z,
        w: q.w,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost_reflect::{DescriptorPool, DynamicMessage};

    /// Oracle: the MCAP library's own reader, and a Protobuf reader that uses only the schemas in
    /// the file.
    #[test]
    fn what_is_recorded_is_read_again() {
        let mut recording = McapRecording::new().unwrap();
        let pose = Pose::translation(1.0, 2.0, 3.0);
        let time = 1_500_000_000;
        recording.pose("/pose", time, "map", &pose).unwrap();
        recording.transform(time, "map", "odom", &pose).unwrap();
        let odometry = RecordedOdometry {
            frame: "map",
            child_frame: "camera",
            pose,
            covariance: &[0.25; 36],
            velocity: None,
        };
        recording.odometry("/odometry", time, &odometry).unwrap();
        recording
            .image(2_000_000_000, "camera", &[0x89, b'P', b'N', b'G'])
            .unwrap();

        let file = recording.finish().unwrap();
        let messages: Vec<_> = mcap::MessageStream::new(&file)
            .unwrap()
            .map(Result::unwrap)
            .collect();
        let read: Vec<serde_json::Value> = messages
            .iter()
            .map(|message| {
                let schema = message.channel.schema.as_ref().unwrap();
                assert_eq!(schema.encoding, "protobuf");
                let pool = DescriptorPool::decode(schema.data.as_ref()).unwrap();
                let descriptor = pool.get_message_by_name(&schema.name).unwrap();
                let message = DynamicMessage::decode(descriptor, message.data.as_ref()).unwrap();
                serde_json::to_value(&message).unwrap()
            })
            .collect();

        assert_eq!(read[0]["timestamp"], "1970-01-01T00:00:01.500Z");
        assert_eq!(read[0]["pose"]["position"]["z"], 3.0);
        assert_eq!(read[1]["childFrameId"], "odom");
        assert_eq!(read[2]["poseCovariance"][35], 0.25);
        assert_eq!(read[2]["bodyFrameId"], "camera");
        assert_eq!(read[3]["data"], "iVBORw==");
        assert_eq!(messages[3].log_time, 2_000_000_000);
    }
}
