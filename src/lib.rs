//! Latent navigation: Poincaré adapters turn image features into camera motion, and camera motion
//! into the next frame.
//!
//! The modules stand bottom to top; each uses only those above its line. `tests/layering.rs`
//! enforces it.

// Core: pure computation. No files, no network, no clock, no async.
pub mod cancel; // a flag that says nobody waits any more
pub mod geometry; // SE(3): poses, twists, errors between poses
pub mod room; // what was seen, and from where
pub mod image; // 8-bit RGB pictures
pub mod features; // one row of encoder output per frame
pub mod studio; // procedural rooms, ray-cast: images with exact poses
pub mod index; // nearest neighbours: exact, HNSW
pub mod ridge; // closed-form ridge regression
pub mod pairs; // which pairs of frames are learned from, and which are tested
pub mod scores; // R² of motions, hit rates and their intervals
pub mod trajectory; // paths against the true ones: association, alignment, APE, RPE
pub mod adapter; // features to latents, latents to twists and back
pub mod training; // from rooms to an adapter and its scores
pub mod formulations; // the alternatives A to D, to compare with
pub mod navigation; // from a frame and a motion to the frames that follow
pub mod localization; // from a feature to a pose, in one room or in all
pub mod odometry; // from two features to the motion between them
pub mod metrics; // M1 to M3: how much of SE(3) the features hold; M4 is training
pub mod eval; // Hit@ε on held-out motions
pub mod generalisation; // in rooms that were never seen
pub mod theory; // the paper's theorems as numeric checks

// Rim: one module per outside format.
pub mod datasets; // recordings on disk to rooms
pub mod encoder; // images to features
pub mod store; // versioned rooms and adapters, in a folder or a bucket
pub mod report; // tables, JSON, pictures
pub mod proto; // the generated wire types
pub mod service; // gRPC
pub mod client; // the other side of it
pub mod cli; // the commands

/// The README's example, compiled with the tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
