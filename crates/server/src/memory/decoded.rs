//! Upper bound of a message's decoded size, computed from its bytes and the protocol descriptors
//! without decoding it. Two bytes on the wire can become hundreds: an empty message in a list is a
//! tag and a zero on the wire, and a whole struct in memory.

use std::collections::HashMap;
use std::sync::LazyLock;

use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorSet};
use seese3_client::proto::FILE_DESCRIPTOR_SET;

/// Growth factor of a list: capacity up to twice its length, and the old buffer during
/// reallocation.
const GROWTH: usize = 3;
/// Size of a string, list or bytes header: pointer, length and capacity, bytes.
const LIST: usize = 24;
/// Size of an optional number, bytes.
const NUMBER: usize = 16;
/// Size of an optional message's discriminant, bytes.
const MARK: usize = 8;

/// Protocol messages by full name.
static MESSAGES: LazyLock<HashMap<String, Shape>> = LazyLock::new(shapes);
/// Request types by RPC path.
static REQUESTS: LazyLock<HashMap<String, Request>> = LazyLock::new(requests);
/// Path suffix of server reflection, which has no descriptors here.
const REFLECTION: &str = "/ServerReflectionInfo";

/// Path of health checks, which have no descriptors here.
const HEALTH_CHECK: &str = "/grpc.health.v1.Health/Check";

/// The request type of an RPC.
#[derive(Debug)]
struct Request {
    /// Full name of the request message.
    message: String,
    /// Whether the request is a stream.
    is_stream: bool,
    /// Whether the response is a stream.
    is_answered_by_stream: bool,
}

/// Memory layout of a message.
#[derive(Debug, Default)]
struct Shape {
    /// Size of the struct including its singular messages, bytes.
    size: usize,
    fields: HashMap<u64, Field>,
}

#[derive(Debug, Clone)]
struct Field {
    is_list: bool,
    /// Content of a length-delimited field.
    content: Content,
}

#[derive(Debug, Clone)]
enum Content {
    /// Text or bytes.
    Bytes,
    /// Numbers, possibly packed; `growth` is the maximum number of decoded bytes per byte on the
    /// wire.
    Numbers { growth: usize },
    /// A message, by full name.
    Message(String),
}

/// Upper bound of a message's decoded size for an RPC, bytes. For an unknown RPC it is the size of
/// the message.
pub fn decoded_size(path: &str, message: &[u8]) -> usize {
    match REQUESTS.get(path) {
        Some(Request { message: name, .. }) => {
            let own = MESSAGES.get(name).map_or(0, |shape| shape.size);
            own.saturating_add(content_size(name, message))
        }
        None => message.len(),
    }
}

/// Whether the request of an RPC is a stream.
pub fn is_stream(path: &str) -> bool {
    match REQUESTS.get(path) {
        Some(request) => request.is_stream,
        None => path.ends_with(REFLECTION),
    }
}

/// Whether the response of an RPC is one message.
pub fn has_unary_response(path: &str) -> bool {
    match REQUESTS.get(path) {
        Some(request) => !request.is_answered_by_stream,
        None => path == HEALTH_CHECK,
    }
}

/// Heap memory of a message: lists, strings, bytes and the messages in lists.
fn content_size(name: &str, mut bytes: &[u8]) -> usize {
    let Some(shape) = MESSAGES.get(name) else {
        return bytes.len();
    };
    let mut size = 0_usize;

    // Where this loop ends early, the decoder rejects the message.
    while let Some((tag, value)) = next_field(&mut bytes) {
        let known = shape.fields.get(&tag);
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

        size = size.saturating_add(match &field.content {
            Content::Bytes if field.is_list => (value.len() + LIST) * GROWTH,
            Content::Bytes => value.len(),
            Content::Numbers { growth } => value.len().saturating_mul(growth * GROWTH),
            Content::Message(name) => {
                let inner = content_size(name, value);
                let own = MESSAGES.get(name).map_or(0, |shape| shape.size);
                match field.is_list {
                    true => inner.saturating_add(own * GROWTH),
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

fn descriptors() -> FileDescriptorSet {
    // Generated by the build. If they were invalid, every message would count with its encoded
    // size.
    FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap_or_default()
}

fn requests() -> HashMap<String, Request> {
    let mut requests = HashMap::new();
    for file in descriptors().file {
        for service in &file.service {
            for method in &service.method {
                let path = format!("/{}.{}/{}", file.package(), service.name(), method.name());
                let input = method.input_type().trim_start_matches('.');
                let request = Request {
                    message: input.to_owned(),
                    is_stream: method.client_streaming(),
                    is_answered_by_stream: method.server_streaming(),
                };
                requests.insert(path, request);
            }
        }
    }

    requests
}

fn shapes() -> HashMap<String, Shape> {
    let mut messages: HashMap<String, DescriptorProto> = HashMap::new();
    for file in descriptors().file {
        for message in &file.message_type {
            let name = format!("{}.{}", file.package(), message.name());
            messages.insert(name, message.clone());
        }
    }

    let shape = |(name, message): (&String, &DescriptorProto)| {
        let fields = message.field.iter().map(|field| {
            let number = u64::try_from(field.number()).unwrap_or_default();
            (number, field_shape(field))
        });
        let shape = Shape {
            size: struct_size(message, &messages, 0),
            fields: fields.collect(),
        };
        (name.clone(), shape)
    };
    messages.iter().map(shape).collect()
}

fn field_shape(field: &FieldDescriptorProto) -> Field {
    let content = match field.r#type() {
        Type::Message | Type::Group => {
            Content::Message(field.type_name().trim_start_matches('.').to_owned())
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
            ("CreateRoomRequest", size_of::<pb::CreateRoomRequest>()),
        ] {
            let computed = MESSAGES[&format!("seese3.v1.{name}")].size;
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
        assert!(decoded_size(BATCH, &message) >= 1_000 * size_of::<pb::NavigateRequest>());

        // 1,000 packed floats: 4 bytes each on the wire, times the list growth.
        let feature = pb::Feature {
            values: vec![1.0; 1_000],
            source_name: String::new(),
        };
        let request = pb::NavigateRequest {
            source: Some(pb::View {
                view: Some(pb::view::View::Feature(feature)),
            }),
            ..pb::NavigateRequest::default()
        };
        let size = decoded_size(NAVIGATE, &request.encode_to_vec());
        assert!((4_000..20_000).contains(&size), "{size}");
    }

    /// Oracle: the protos, by hand.
    #[test]
    fn streams_are_known_by_their_paths() {
        let service = |name: &str| format!("/seese3.v1.{name}");
        for (path, expected) in [
            (service("OdometryService/Track"), true),
            (service("CatalogService/CreateRoom"), true),
            (service("CatalogService/PublishAdapter"), true),
            (service("OdometryService/EstimateMotion"), false),
            (service("EvaluationService/Evaluate"), false),
            (NAVIGATE.to_owned(), false),
            (
                "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo".to_owned(),
                true,
            ),
            ("/grpc.health.v1.Health/Check".to_owned(), false),
        ] {
            assert_eq!(is_stream(&path), expected, "{path}");
        }

        assert!(has_unary_response(NAVIGATE) && has_unary_response(HEALTH_CHECK));
        assert!(!has_unary_response(&service("EvaluationService/Evaluate")));
        assert!(!has_unary_response("/grpc.health.v1.Health/Watch"));
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
            assert!(decoded_size(BATCH, bytes) < 100_000);
        }
        assert_eq!(decoded_size("/other/Service", &[1, 2, 3]), 3);
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
        assert_eq!(decoded_size(BATCH, &hidden), usize::MAX);
    }
}
