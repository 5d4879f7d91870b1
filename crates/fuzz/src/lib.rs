//! Mutated files for every parser of outside bytes: `cargo test -p seese3-fuzz`. `tests/mutations.rs` has the targets.
