//! Messages of the protocol as JSON, by protobuf's own mapping: fields under their names in the
//! protos, numbers that are absent left out.

use anyhow::Context;
use prost::Message;
use prost_reflect::{DescriptorPool, DynamicMessage, SerializeOptions};
use seese3_client::proto::FILE_DESCRIPTOR_SET;
use serde_json::Value;

/// A message as JSON; `name` is that of its type in the protos.
pub fn wire_json(name: &str, message: &impl Message) -> anyhow::Result<Value> {
    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET)?;
    let descriptor = pool
        .get_message_by_name(&format!("seese3.v1.{name}"))
        .with_context(|| format!("the protocol has no message {name}"))?;
    let message = DynamicMessage::decode(descriptor, message.encode_to_vec().as_slice())?;

    // Fields that are zero or empty stay, so that a reader finds the same keys in every answer.
    // Absent ones are left out, and 64-bit numbers are numbers.
    let options = SerializeOptions::new()
        .use_proto_field_name(true)
        .skip_default_fields(false)
        .stringify_64_bit_integers(false);
    Ok(message.serialize_with_options(serde_json::value::Serializer, &options)?)
}
