//! Tests every parser of untrusted input with mutated files: `cargo test -p seese3-fuzz`.
//! `tests/mutations.rs` has the targets.
