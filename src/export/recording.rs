//! Poses, transforms and images as an MCAP file that Foxglove and other viewers open. Messages are
//! JSON in Foxglove's schemas.

use std::collections::BTreeMap;
use std::io::Cursor;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};
use serde_json::{Value, json};

use seese3_core::geometry::Pose;

/// An MCAP recording that is being written, in memory.
pub struct McapRecording {
    writer: Writer<Cursor<Vec<u8>>>,
    schemas: BTreeMap<&'static str, u16>,
    channels: BTreeMap<String, u16>,
    sequence: u32,
}

impl McapRecording {
    /// A recording without messages.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot begin the file.
    pub fn new() -> Result<Self, McapError> {
        let options = WriteOptions::new().compression(None).library("seese3");
        let writer = options.create(Cursor::new(Vec::new()))?;

        Ok(Self {
            writer,
            schemas: BTreeMap::new(),
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
        let message = json!({ "timestamp": time(time_ns), "frame_id": frame,
            "pose": { "position": vector(pose), "orientation": quaternion(pose) } });
        self.message("foxglove.PoseInFrame", topic, time_ns, &message)
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
        let message = json!({ "timestamp": time(time_ns), "parent_frame_id": parent, "child_frame_id": child,
            "translation": vector(pose), "rotation": quaternion(pose) });
        self.message("foxglove.FrameTransform", "/tf", time_ns, &message)
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
        let message = json!({ "timestamp": time(time_ns), "frame_id": frame, "format": format, "data": STANDARD.encode(file) });

        self.message(
            "foxglove.CompressedImage",
            "/camera/image",
            time_ns,
            &message,
        )
    }

    /// Completes the recording and returns the bytes of the file.
    ///
    /// # Errors
    /// [`McapError`] if the MCAP library cannot complete the file.
    pub fn finish(mut self) -> Result<Vec<u8>, McapError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner().into_inner())
    }

    fn message(
        &mut self,
        schema: &'static str,
        topic: &str,
        time_ns: i64,
        message: &Value,
    ) -> Result<(), McapError> {
        let channel_id = self.channel(schema, topic)?;
        self.sequence += 1;

        // MCAP times are unsigned nanoseconds since the epoch: earlier times are clamped to it.
        let log_time = u64::try_from(time_ns).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence: self.sequence,
            log_time,
            publish_time: log_time,
        };

        self.writer
            .write_to_known_channel(&header, message.to_string().as_bytes())
    }

    fn channel(&mut self, schema: &'static str, topic: &str) -> Result<u16, McapError> {
        // A channel, and the schema behind it, is registered with the first message on its topic.
        if let Some(&id) = self.channels.get(topic) {
            return Ok(id);
        }

        let schema_id = match self.schemas.get(schema) {
            Some(&id) => id,
            None => self.writer.add_schema(
                schema,
                "jsonschema",
                schema_of(schema).to_string().as_bytes(),
            )?,
        };

        self.schemas.insert(schema, schema_id);
        let id = self
            .writer
            .add_channel(schema_id, topic, "json", &BTreeMap::new())?;
        self.channels.insert(topic.to_owned(), id);

        Ok(id)
    }
}

fn time(time_ns: i64) -> Value {
    json!({ "sec": time_ns.div_euclid(1_000_000_000), "nsec": time_ns.rem_euclid(1_000_000_000) })
}

fn vector(pose: &Pose) -> Value {
    let t = pose.translation.vector;
    json!({ "x": t.x, "y": t.y, "z": t.z })
}

fn quaternion(pose: &Pose) -> Value {
    let q = pose.rotation.coords;
    json!({ "x": q.x, "y": q.y, "z": q.z, "w": q.w })
}

/// The JSON schema of a Foxglove message, reduced to the fields that are written here.
fn schema_of(name: &str) -> Value {
    let number = json!({ "type": "number" });
    let text = json!({ "type": "string" });
    let object = |fields: Value| json!({ "type": "object", "properties": fields });
    let time = object(json!({ "sec": { "type": "integer" }, "nsec": { "type": "integer" } }));

    let vector = object(json!({ "x": number, "y": number, "z": number }));
    let quaternion = object(json!({ "x": number, "y": number, "z": number, "w": number }));

    let mut schema = match name {
        "foxglove.PoseInFrame" => object(json!({ "timestamp": time, "frame_id": text,
            "pose": object(json!({ "position": vector, "orientation": quaternion })) })),
        "foxglove.FrameTransform" => object(
            json!({ "timestamp": time, "parent_frame_id": text, "child_frame_id": text,
            "translation": vector, "rotation": quaternion }),
        ),
        _ => object(json!({ "timestamp": time, "frame_id": text, "format": text,
            "data": { "type": "string", "contentEncoding": "base64" } })),
    };

    schema["title"] = name.into();
    schema
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the library's own reader, and Foxglove's field names by hand.
    #[test]
    fn what_is_recorded_is_read_again() {
        let mut recording = McapRecording::new().unwrap();
        let pose = Pose::translation(1.0, 2.0, 3.0);
        recording
            .pose("/pose", 1_500_000_000, "map", &pose)
            .unwrap();

        recording
            .transform(1_500_000_000, "map", "odom", &pose)
            .unwrap();

        recording
            .pose("/pose", 2_000_000_000, "map", &pose)
            .unwrap();

        recording
            .image(2_000_000_000, "camera", &[0x89, b'P', b'N', b'G'])
            .unwrap();

        let file = recording.finish().unwrap();
        let messages: Vec<_> = mcap::MessageStream::new(&file)
            .unwrap()
            .map(Result::unwrap)
            .collect();

        assert_eq!(messages.len(), 4);

        let names: Vec<&str> = messages
            .iter()
            .map(|message| message.channel.schema.as_ref().unwrap().name.as_str())
            .collect();

        assert_eq!(
            names
                .iter()
                .filter(|&&name| name == "foxglove.PoseInFrame")
                .count(),
            2
        );

        let first: Value = serde_json::from_slice(&messages[0].data).unwrap();
        assert_eq!(first["timestamp"], json!({ "sec": 1, "nsec": 500_000_000 }));

        assert_eq!(
            (&first["frame_id"], &first["pose"]["position"]["z"]),
            (&json!("map"), &json!(3.0))
        );

        assert_eq!(messages[0].log_time, 1_500_000_000);

        let last: Value = serde_json::from_slice(&messages[3].data).unwrap();
        assert_eq!(
            (&last["format"], &last["data"]),
            (&json!("png"), &json!("iVBORw=="))
        );
    }
}
