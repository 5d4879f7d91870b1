//! Protocol messages as JSON, with protobuf's own mapping: field names as in the protos, absent
//! fields omitted.

use anyhow::Context;
use prost::Message;
use prost_reflect::{DescriptorPool, DynamicMessage, SerializeOptions};
use seese3_client::proto::FILE_DESCRIPTOR_SET;
use serde_json::Value;

/// A message as JSON; `name` is the name of its type in the protos.
pub fn wire_json(name: &str, message: &impl Message) -> anyhow::Result<Value> {
    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET)?;
    let descriptor = pool
        .get_message_by_name(&format!("seese3.v1.{name}"))
        .with_context(|| format!("the protocol has no message {name}"))?;
    let message = DynamicMessage::decode(descriptor, message.encode_to_vec().as_slice())?;

    // Zero and empty fields are kept, so that every answer has the same keys. Absent fields are
    // omitted, and 64-bit numbers are written as numbers.
    let options = SerializeOptions::new()
        .use_proto_field_name(true)
        .skip_default_fields(false)
        .stringify_64_bit_integers(false);
    Ok(message.serialize_with_options(serde_json::value::Serializer, &options)?)
}
