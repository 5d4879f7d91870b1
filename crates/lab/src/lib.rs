//! The laboratory of [seese3](https://docs.rs/seese3): experiments for researchers, not used by the
//! service.
//!
//! ```
//! use ndarray::Array2;
//! use seese3_core::geometry::Pose;
//! use seese3_lab::probes::{MutualKnn, mutual_knn};
//!
//! // Probe M1. Features that are the positions on a circle have the same neighbors as the poses.
//! let angle = |frame: usize| frame as f64 / 50.0;
//! let poses: Vec<Pose> = (0..300)
//!     .map(|frame| {
//!         let (sin, cos) = angle(frame).sin_cos();
//!         Pose::new(nalgebra::Vector3::new(cos, sin, 0.0), nalgebra::Vector3::zeros())
//!     })
//!     .collect();
//! let features = Array2::from_shape_fn((300, 2), |(frame, axis)| {
//!     let (sin, cos) = angle(frame).sin_cos();
//!     [cos, sin][axis] as f32
//! });
//! let score = mutual_knn(features.view(), &poses, &MutualKnn::default()).unwrap();
//! assert!(score > 0.9, "{score}");
//! ```
//!
//! The modules are listed from the lowest layer up. Each uses only those listed before it; a test
//! enforces this.
//!
//! | module | what |
//! | --- | --- |
//! | `json` | shapes of core results in JSON records |
//! | [`formulations`] | the paper's alternatives A to D to the adapter |
//! | [`probes`] | probes M1 to M3 of the SE(3) information in features; M4 trains an adapter |
//! | [`theory`] | numeric checks of the paper's theorems |
//! | [`experiments`] | experiments over rooms, with their result types |
//! | [`benchmark`] | frozen rooms and pairs, submissions and their scores, metrics of features |
//! | [`report`] | tables, JSON, pictures and documents of the results |
//! | [`reproduction`] | the paper's tables and figures on given rooms, as one report |
//!
//! This crate reads and writes no files; the program does.

mod json;
pub mod formulations;
pub mod probes;
pub mod theory;
pub mod experiments;
pub mod benchmark;
pub mod report;
pub mod reproduction;
