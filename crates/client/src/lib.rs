//! A client of [seese3](https://docs.rs/seese3), latent navigation over gRPC, for use in a robot's
//! program.
//!
//! ```no_run
//! use std::time::Duration;
//!
//! use seese3_client::{Client, convert, proto::v1 as pb};
//!
//! # async fn ask() -> Result<(), Box<dyn std::error::Error>> {
//! let client = Client::connect("127.0.0.1:50051", Duration::from_secs(5)).await?;
//!
//! // How did the camera move between two stored frames?
//! let view = |frame| {
//!     Some(pb::View {
//!         view: Some(pb::view::View::FrameId(frame)),
//!     })
//! };
//! let answer = client
//!     .estimate_motion(pb::EstimateMotionRequest {
//!         room: "kitchen".into(),
//!         first: view(100),
//!         second: view(110),
//!         ..Default::default()
//!     })
//!     .await?;
//!
//! let motion = answer.motion.and_then(|motion| motion.twist).ok_or("no motion")?;
//! let motion = convert::twist(&motion)?;
//! println!("{:.2} m, {:.1}°", motion.linear.norm(), motion.angular.norm().to_degrees());
//! # Ok(()) }
//! ```
//!
//! | module | what |
//! | --- | --- |
//! | [`Client`] | a connection, with one method per RPC |
//! | [`proto::v1`] | wire types, generated from `proto/seese3/v1`, which documents every field |
//! | [`Newest`] | newest-frame mode for a camera that is faster than the server |
//! | [`convert`] | conversion of poses and motions to nalgebra types |
//!
//! Conventions: meters, radians, seconds; camera axes x right, y down, z forward; poses are
//! `parent_from_child`; twists are (v, ω) in the body frame of the camera at the start of the
//! motion.
//!
//! The feature `server` adds the server side of the protocol; clients do not need it.

/// The examples of the repository's README, which are compiled with the tests.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;

pub mod proto;
mod checked_status;
mod one_line;
pub mod convert;
mod client;
mod calls;
mod newest;

pub use client::{Client, ClientTls, ConnectOptions, Error};
/// The types used by [`convert`].
pub use nalgebra;
pub use newest::Newest;
pub use one_line::one_line;
/// The types of streams and statuses.
pub use tonic;
