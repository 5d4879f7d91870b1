//! seese3: latent navigation as a service over gRPC.
//!
//! This package is the program `seese3` and the parts it is made of. A robot's program links
//! [`seese3_client`] alone; whoever wants the computations without a server links [`seese3_core`].
//!
//! The modules are listed from the lowest layer up: each uses only those listed before it, and a test
//! enforces it.
//!
//! | module | what |
//! | --- | --- |
//! | [`datasets`] | recordings on disk to rooms |
//! | [`encoder`] | images to features |
//! | [`store`] | versioned, checksummed rooms and adapters |
//! | [`refit`] | fitting an adapter to a stored room |
//! | [`export`] | paths and streams for other programs: TUM, KITTI, MCAP |
//! | [`service`] | the gRPC service |
//! | [`cli`] | the commands |
//!
//! Where to start reading: a request in [`service`], a command in [`cli`], the tracking of a camera
//! in [`seese3_core::tracking`]. `ARCHITECTURE.md` has the whole map and the invariants.

pub mod datasets;
pub mod encoder;
pub mod store;
pub mod refit;
pub mod export;
pub mod service;
pub mod cli;

pub use seese3_client;
pub use seese3_core;

/// The README's example, compiled with the tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
