//! Encoders: images to features.

mod builtin;

pub use builtin::{BUILTIN_DIM, builtin_source, encode_builtin};
