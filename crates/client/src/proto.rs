//! Generated wire types of `proto/seese3/v1`, and their descriptors.

/// Package `seese3.v1`.
#[allow(missing_docs, clippy::all, clippy::pedantic, reason = "generated; the documentation is in the protos")]
#[rustfmt::skip]
pub mod v1 {
    tonic::include_proto!("seese3.v1");
}

/// The encoded descriptors of all proto files, for the reflection service.
pub const FILE_DESCRIPTOR_SET: &[u8] =
    include_bytes!(concat!(env!("OUT_DIR"), "/seese3_descriptor.bin"));
