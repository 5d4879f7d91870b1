//! Upper bound of a message's decoded size, computed from its bytes and the protocol descriptors
//! without decoding it. Two bytes on the wire can become hundreds: an empty message in a list is a
//! tag and a zero on the wire, and a whole struct in memory.

use std::collections::HashMap;
use std::sync::LazyLock;

use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto};

use super::super::rpcs::{descriptors, rpc};

/// Length of the gRPC message prefix: compression flag and message length.
pub const PREFIX: usize = 5;

/// Growth factor of a list: capacity up to twice its length, and the old buffer during
/// reallocation.
const GROWTH: usize = 3;
/// Size of a string, list or bytes header: pointer, length and capacity, bytes.
const LIST: usize = 24;
/// Size of an optional number, bytes.
const NUMBER: usize = 16;
/// Size of an optional message's discriminant, bytes.
const MARK: usize = 8;

/// The protocol's messages.
static MESSAGES: LazyLock<Messages> = LazyLock::new(Messages::new);

/// Memory layouts of messages.
#[derive(Debug, Default)]
struct Messages {
    shapes: Vec<Shape>,
    /// Positions in `shapes` by full name.
    positions: HashMap<String, usize>,
}

/// Memory layout of a message.
#[derive(Debug, Default)]
struct Shape {
    /// Size of the struct including its singular messages, bytes.
    size: usize,
    /// Fields by number.
    fields: Vec<Option<Field>>,
}

#[derive(Debug, Clone, Copy)]
struct Field {
    is_list: bool,
    /// Content of a length-delimited field.
    content: Content,
}

#[derive(Debug, Clone, Copy)]
enum Content {
    /// Text or bytes.
    Bytes,
    /// Numbers, possibly packed; `growth` is the maximum number of decoded bytes per byte on the
    /// wire.
    Numbers { growth: usize },
    /// A message, by its position.
    Message(usize),
}

/// Upper bound of a message's decoded size for an RPC, bytes. For an unknown RPC it is the size of
/// the message. Counting ends above `limit`, so a larger result is only known to be above it.
pub fn decoded_size(path: &str, message: &[u8], limit: usize) -> usize {
    let request = rpc(path).and_then(|rpc| MESSAGES.positions.get(&rpc.request));
    let Some(&request) = request else {
        return message.len();
    };

    let own = MESSAGES.shapes[request].size;
    own.saturating_add(content_size(request, message, limit))
}

/// Heap memory of a message: lists, strings, bytes and the messages in lists.
fn content_size(message: usize, mut bytes: &[u8], limit: usize) -> usize {
    let shape = &MESSAGES.shapes[message];
    let mut size = 0_usize;

    // Where this loop ends early, the decoder rejects the message, or the limit does.
    while size <= limit
        && let Some((tag, value)) = next_field(&mut bytes)
    {
        let known = usize::try_from(tag).ok();
        let known = known.and_then(|tag| *shape.fields.get(tag)?);
        let (field, value) = match (known, value) {
            // The protocol has no groups. The decoder skips them and reads the fields behind, so
            // assume the maximum.
            (_, Value::Group) => return usize::MAX,
            (None, _) => continue,
            (Some(field), Value::Number) => {
                if field.is_list {
                    size = size.saturating_add(NUMBER * GROWTH);
                }
                continue;
            }
            (Some(field), Value::Bytes(value)) => (field, value),
        };

        size = size.saturating_add(match field.content {
            Content::Bytes if field.is_list => (value.len() + LIST) * GROWTH,
            Content::Bytes => value.len(),
            Content::Numbers { growth } => value.len().saturating_mul(growth * GROWTH),
            Content::Message(part) => {
                let inner = content_size(part, value, limit - size);
                match field.is_list {
                    true => inner.saturating_add(MESSAGES.shapes[part].size * GROWTH),
                    false => inner,
                }
            }
        });
    }

    size
}

enum Value<'a> {
    Number,
    /// Deprecated encoding of messages, without a length.
    Group,
    Bytes(&'a [u8]),
}

/// The next field's number and value. `None` at the end or if the bytes are malformed.
fn next_field<'a>(bytes: &mut &'a [u8]) -> Option<(u64, Value<'a>)> {
    let key = varint(bytes)?;
    let skip = |bytes: &mut &'a [u8], count: usize| -> Option<&'a [u8]> {
        let (value, rest) = bytes.split_at_checked(count)?;
        *bytes = rest;
        Some(value)
    };

    let value = match key & 7 {
        0 => {
            varint(bytes)?;
            Value::Number
        }
        1 => {
            skip(bytes, 8)?;
            Value::Number
        }
        2 => {
            let length = usize::try_from(varint(bytes)?).ok()?;
            Value::Bytes(skip(bytes, length)?)
        }
        3 | 4 => Value::Group,
        5 => {
            skip(bytes, 4)?;
            Value::Number
        }
        _ => return None,
    };
    Some((key >> 3, value))
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    prost::encoding::decode_varint(bytes).ok()
}

impl Messages {
    fn new() -> Self {
        let mut messages: HashMap<String, DescriptorProto> = HashMap::new();
        for file in descriptors() {
            for message in &file.message_type {
                let name = format!("{}.{}", file.package(), message.name());
                messages.insert(name, message.clone());
            }
        }

        let names = messages.keys().cloned();
        let positions: HashMap<String, usize> = names.zip(0..).collect();
        let mut shapes: Vec<Shape> = Vec::new();
        shapes.resize_with(positions.len(), Shape::default);
        for (name, &position) in &positions {
            let message = &messages[name];
            let shape = &mut shapes[position];
            shape.size = struct_size(message, &messages, 0);
            for field in &message.field {
                let number = usize::try_from(field.number()).unwrap_or_default();
                if shape.fields.len() <= number {
                    shape.fields.resize(number + 1, None);
                }
                shape.fields[number] = Some(field_shape(field, &positions));
            }
        }

        Self { shapes, positions }
    }
}

fn field_shape(field: &FieldDescriptorProto, positions: &HashMap<String, usize>) -> Field {
    let content = match field.r#type() {
        Type::Message | Type::Group => {
            let name = field.type_name().trim_start_matches('.');
            // A message of another package, such as a timestamp, has no lists.
            let position = positions.get(name).copied();
            position.map_or(Content::Bytes, Content::Message)
        }
        Type::String | Type::Bytes => Content::Bytes,
        // One byte on the wire, eight in memory.
        Type::Int64 | Type::Uint64 | Type::Sint64 => Content::Numbers { growth: 8 },
        Type::Int32 | Type::Uint32 | Type::Sint32 | Type::Enum => Content::Numbers { growth: 4 },
        _ => Content::Numbers { growth: 1 },
    };

    Field {
        is_list: field.label() == Label::Repeated,
        content,
    }
}

/// Size of a message's struct, bytes. Messages contain each other inline, never recursively.
fn struct_size(
    message: &DescriptorProto,
    messages: &HashMap<String, DescriptorProto>,
    depth: usize,
) -> usize {
    const DEEPEST: usize = 32;

    let size = |field: &FieldDescriptorProto| match field.r#type() {
        _ if field.label() == Label::Repeated => LIST,
        Type::String | Type::Bytes => LIST,
        Type::Message if depth < DEEPEST => {
            let inner = messages.get(field.type_name().trim_start_matches('.'));
            MARK + inner.map_or(LIST, |inner| struct_size(inner, messages, depth + 1))
        }
        _ => NUMBER,
    };
    message.field.iter().map(size).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message;
    use seese3_client::proto::v1 as pb;

    const NAVIGATE: &str = "/seese3.v1.NavigationService/Navigate";
    const BATCH: &str = "/seese3.v1.NavigationService/BatchNavigate";

    /// Oracle: the struct sizes in this build, which must not exceed the computed ones.
    #[test]
    fn structs_are_no_larger_than_computed() {
        for (name, size) in [
            ("NavigateRequest", size_of::<pb::NavigateRequest>()),
            ("View", size_of::<pb::View>()),
            ("Twist", size_of::<pb::Twist>()),
            ("Prediction", size_of::<pb::Prediction>()),
            ("EvaluateRequest", size_of::<pb::EvaluateRequest>()),
            ("TrackRequest", size_of::<pb::TrackRequest>()),
            ("UploadRoomRequest", size_of::<pb::UploadRoomRequest>()),
        ] {
            let position = MESSAGES.positions[&format!("seese3.v1.{name}")];
            let computed = MESSAGES.shapes[position].size;
            assert!(
                (size..=4 * size).contains(&computed),
                "{name}: {computed} for {size}"
            );
        }
    }

    /// Oracle: by hand: the list of an empty batch of N requests has N structs.
    #[test]
    fn what_grows_when_it_is_decoded_counts_as_grown() {
        let batch = pb::BatchNavigateRequest {
            requests: vec![pb::NavigateRequest::default(); 1_000],
        };
        let message = batch.encode_to_vec();
        assert_eq!(message.len(), 2_000);
        assert!(
            decoded_size(BATCH, &message, usize::MAX) >= 1_000 * size_of::<pb::NavigateRequest>()
        );

        // 1,000 packed floats: 4 bytes each on the wire, times the list growth.
        let feature = pb::Feature {
            values: vec![1.0; 1_000],
            feature_set: String::new(),
        };
        let request = pb::NavigateRequest {
            source: Some(pb::View {
                view: Some(pb::view::View::Feature(feature)),
            }),
            ..pb::NavigateRequest::default()
        };
        let size = decoded_size(NAVIGATE, &request.encode_to_vec(), usize::MAX);
        assert!((4_000..20_000).contains(&size), "{size}");
    }

    /// Oracle: the contract: counting ends soon above the limit, here after one part of many.
    #[test]
    fn counting_ends_at_the_limit() {
        let batch = pb::BatchNavigateRequest {
            requests: vec![pb::NavigateRequest::default(); 1_000],
        };
        let size = decoded_size(BATCH, &batch.encode_to_vec(), 1);
        let part = 4 * GROWTH * size_of::<pb::NavigateRequest>();
        assert!((2..=2 * part).contains(&size), "{size}");
    }

    /// Oracle: the contract: no input stops the computation.
    #[test]
    fn bytes_that_are_no_message_are_passed_over() {
        let twist = pb::Twist::default().encode_to_vec();
        for bytes in [
            &[0xff; 40][..],
            &[0x0a, 0xff, 0xff, 0xff, 0xff, 0x0f],
            &[],
            &twist,
        ] {
            assert!(decoded_size(BATCH, bytes, usize::MAX) < 100_000);
        }
        assert_eq!(decoded_size("/other/Service", &[1, 2, 3], usize::MAX), 3);
    }

    /// Oracle: the decoder: it skips a group of an unknown field and reads the fields behind it.
    #[test]
    fn nothing_hides_behind_a_group() {
        let batch = pb::BatchNavigateRequest {
            requests: vec![pb::NavigateRequest::default(); 1_000],
        };
        // Start and end of a group of field 99.
        let hidden = [&[0x9b, 0x06, 0x9c, 0x06], &batch.encode_to_vec()[..]].concat();
        let decoded = pb::BatchNavigateRequest::decode(hidden.as_slice()).unwrap();
        assert_eq!(decoded.requests.len(), 1_000);
        assert_eq!(decoded_size(BATCH, &hidden, usize::MAX), usize::MAX);
    }
}
