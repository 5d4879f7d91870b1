//! The computations of the paper SeeSE3: latent navigation with Poincaré adapters. Part of
//! [seese3](https://docs.rs/seese3).
//!
//! An encoder turns an image into a feature z. A small trained network φ, the *Poincaré adapter*,
//! turns features into latents in which camera motion is linear: ΔP ≈ W(φ(z₂) − φ(z₁)), with ΔP =
//! log(P₁⁻¹P₂) ∈ se(3). The inverse predicts the latent after a motion, ĝ = φ(z) + W⁺ΔP; the stored
//! frame nearest to ĝ is the predicted view.
//!
//! ```
//! use std::sync::Arc;
//!
//! use seese3_core::adapter::{Adapter, Preset};
//! use seese3_core::features::{FeatureSource, Features};
//! use seese3_core::geometry::Pose;
//! use seese3_core::navigation::{IndexKind, Navigator};
//! use seese3_core::room::{Frames, Provenance, Room, RoomId};
//! use seese3_core::splits::Split;
//! use seese3_core::training::{RoomData, TrainingPlan, train_adapter};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // A made-up recording: poses, and features that depend on them.
//! let poses: Vec<Pose> = (0..200)
//!     .map(|t| {
//!         let sway = |axis: f64| (f64::from(t) / (9.0 + axis)).sin();
//!         let position = nalgebra::Vector3::new(sway(0.0), 0.2 * sway(1.0), sway(2.0));
//!         Pose::new(position, nalgebra::Vector3::new(0.1 * sway(3.0), 0.4 * sway(4.0), 0.1 * sway(5.0)))
//!     })
//!     .collect();
//! let rows = ndarray::Array2::from_shape_fn((200, 12), |(row, column)| {
//!     let p = &poses[row];
//!     let numbers = [p.translation.vector, p.rotation.scaled_axis()];
//!     (numbers[column % 2][column % 3] * (1.0 + column as f64)) as f32
//! });
//! let features = Features::new(FeatureSource::imported("made-up", 12), rows)?;
//! let frames = Frames { poses, ..Frames::default() };
//! let room = Room::new(RoomId::new("hall")?, frames, Provenance::default())?;
//!
//! // Train an adapter on pairs of frames five apart.
//! let data = RoomData { room: &room, revision: 1, features: &features };
//! let plan = TrainingPlan::of(Preset::PaperBase, Split::Time, 5, 0);
//! let (adapter, record) = train_adapter(&[data], &plan, &mut |_| ())?;
//! assert!(record.pair_count > 0);
//!
//! // Predict the motion between two frames, and find the frames most similar to one.
//! let navigator = Navigator::new(Arc::new(room), &features, Arc::new(adapter), IndexKind::Exact)?;
//! let latents = navigator.latents();
//! let motion = navigator.adapter().motion(latents.row(10), latents.row(15));
//! assert!(motion.is_finite());
//! assert_eq!(navigator.nearest(latents.row(10), 3)[0].neighbor.frame.row(), 10);
//! # Ok(()) }
//! ```
//!
//! # Conventions
//!
//! A [`geometry::Pose`] is `world_from_camera`, meters. A [`geometry::Twist`] is ordered (v, ω), in
//! the body frame of the camera at the start of the motion; |ω| ≤ π. Camera axes are x right, y
//! down, z forward. Weights are f32 as trained; inference is in f64. A-nn refers to the ambiguities
//! in `docs/paper.md`.
//!
//! # The map
//!
//! Modules from the lowest layer up. Each uses only those listed before it; a test enforces it.
//!
//! | module | what |
//! | --- | --- |
//! | [`cancel`] | a cancellation flag for long computations |
//! | [`geometry`] | SE(3): poses, twists, errors between poses |
//! | [`matrices`] | conversion between ndarray and nalgebra |
//! | [`room`] | a recording: frames with poses, times and image names |
//! | [`image`] | 8-bit RGB images |
//! | [`features`] | one row of encoder output per frame, with its source |
//! | [`keypoints`] | positions, scores and descriptors of the keypoints of an image |
//! | [`index`] | nearest-neighbor search: exact scan, HNSW |
//! | [`ridge`] | ridge regression in closed form |
//! | [`splits`] | train/test splits of frame pairs; hold-outs of mapped frames |
//! | [`statistics`] | means, quantiles, rates, the bootstrap over rooms, coverage of covariances |
//! | [`motion_scores`] | R² of predicted motions |
//! | [`trajectory`] | trajectory evaluation: association, alignment, APE, RPE |
//! | [`epipolar`] | epipolar errors of matches under known poses; the camera fitted to them |
//! | [`adapter`] | features to latents, latents to motions and back; networks and their training |
//! | [`training`] | trains and scores an adapter on rooms |
//! | [`navigation`] | retrieves the frames that a camera would see after a motion |
//! | [`localization`] | retrieves the frames most similar to a view |
//! | [`eval`] | Hit@ε on held-out motions, and data-leak checks |
//!
//! The crate does not use files, the network, the clock or the environment. Randomness is seeded.

pub mod cancel;
pub mod geometry;
pub mod matrices;
pub mod room;
pub mod image;
pub mod features;
pub mod keypoints;
pub mod index;
pub mod ridge;
pub mod splits;
pub mod statistics;
pub mod recording_extent;
pub mod motion_scores;
pub mod trajectory;
pub mod epipolar;
pub mod adapter;
pub mod training;
pub mod navigation;
pub mod localization;
pub mod eval;

/// Vectors and matrices of poses and twists.
pub use nalgebra;
/// Arrays of features and latents.
pub use ndarray;

/// The cause of an error: another error, or a sentence.
///
/// A message contains the text of its cause, so that one line is enough in a log or a gRPC status;
/// [`std::error::Error::source`] gives programs the cause itself.
pub type Cause = Box<dyn std::error::Error + Send + Sync>;
