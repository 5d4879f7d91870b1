//! Compiles the protos without a system protoc, and keeps their descriptors for reflection.

use std::path::PathBuf;

/// The folder of the protos: a link to the top of the repository, so that the package has them too.
const FOLDER: &str = "proto";

const PROTOS: [&str; 6] = [
    "seese3/v1/catalog.proto",
    "seese3/v1/evaluation.proto",
    "seese3/v1/geometry.proto",
    "seese3/v1/localization.proto",
    "seese3/v1/navigation.proto",
    "seese3/v1/odometry.proto",
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    for file in PROTOS {
        println!("cargo::rerun-if-changed={FOLDER}/{file}");
    }

    let mut compiler = protox::Compiler::new([FOLDER])?;
    compiler
        .include_imports(true)
        .include_source_info(true)
        .open_files(PROTOS)?;

    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    let descriptors = compiler.encode_file_descriptor_set();
    std::fs::write(out.join("seese3_descriptor.bin"), descriptors)?;

    // A robot's program links no server.
    let is_server = std::env::var_os("CARGO_FEATURE_SERVER").is_some();
    tonic_prost_build::configure()
        .build_server(is_server)
        .extern_path(".google.rpc", "::tonic_types::pb")
        .compile_fds(compiler.file_descriptor_set())?;

    Ok(())
}
