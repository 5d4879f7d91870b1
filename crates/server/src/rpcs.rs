//! All RPCs of the server, from the compiled protocol descriptors.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use prost::Message;
use prost_types::{FileDescriptorProto, FileDescriptorSet};
use seese3_client::proto::FILE_DESCRIPTOR_SET;

/// The RPCs by path, `/PACKAGE.SERVICE/METHOD`.
static RPCS: LazyLock<BTreeMap<String, Rpc>> = LazyLock::new(rpcs);

/// The messages of an RPC.
#[derive(Debug, Clone)]
pub struct Rpc {
    /// Full name of the request message.
    pub request: String,
    /// Whether the request is a stream.
    pub has_streamed_request: bool,
}

/// The RPC of a path; `None` if the server has none.
pub fn rpc(path: &str) -> Option<&'static Rpc> {
    RPCS.get(path)
}

/// The path, if it is one of an RPC.
pub fn known_path(path: &str) -> Option<&'static str> {
    RPCS.get_key_value(path).map(|(path, _)| path.as_str())
}

/// The descriptors of all services: seese3's own, health and reflection.
pub fn descriptors() -> impl Iterator<Item = FileDescriptorProto> {
    // They are compiled in; one that could not be read would have no RPC.
    let sets = [
        FILE_DESCRIPTOR_SET,
        tonic_health::pb::FILE_DESCRIPTOR_SET,
        tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET,
        tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET,
    ];
    let decoded = sets.map(|set| FileDescriptorSet::decode(set).unwrap_or_default());
    decoded.into_iter().flat_map(|set| set.file)
}

fn rpcs() -> BTreeMap<String, Rpc> {
    let mut rpcs = BTreeMap::new();
    for file in descriptors() {
        for service in &file.service {
            for method in &service.method {
                let path = format!("/{}.{}/{}", file.package(), service.name(), method.name());
                let rpc = Rpc {
                    request: method.input_type().trim_start_matches('.').to_owned(),
                    has_streamed_request: method.client_streaming(),
                };
                rpcs.insert(path, rpc);
            }
        }
    }

    rpcs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the protos, by hand.
    #[test]
    fn streams_are_known_by_their_paths() {
        for (path, expected) in [
            ("/seese3.v1.OdometryService/Track", true),
            ("/seese3.v1.CatalogService/UploadRoom", true),
            ("/seese3.v1.NavigationService/Navigate", false),
            ("/seese3.v1.EvaluationService/Evaluate", false),
            (
                "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
                true,
            ),
            ("/grpc.health.v1.Health/Check", false),
        ] {
            assert_eq!(rpc(path).unwrap().has_streamed_request, expected, "{path}");
        }
        assert!(rpc("/grpc.health.v1.Health/NOPE").is_none());
    }
}
