//! Compiles the protos without a system protoc, and keeps their descriptors for reflection.

use std::path::PathBuf;

const PROTOS: [&str; 6] = [
    "seese3/v1/catalog.proto",
    "seese3/v1/evaluation.proto",
    "seese3/v1/geometry.proto",
    "seese3/v1/localization.proto",
    "seese3/v1/navigation.proto",
    "seese3/v1/odometry.proto",
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed=proto");
    let mut compiler = protox::Compiler::new(["proto"])?;
    compiler
        .include_imports(true)
        .include_source_info(true)
        .open_files(PROTOS)?;

    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(
        out.join("seese3_descriptor.bin"),
        compiler.encode_file_descriptor_set(),
    )?;

    tonic_prost_build::configure().compile_fds(compiler.file_descriptor_set())?;
    Ok(())
}
