//! What a robot uses beyond the paper: tracking, planning, calibration, adapters fitted to one room,
//! and motion between two views. Part of [seese3](https://docs.rs/seese3).
//!
//! # The map
//!
//! The modules are listed from the lowest layer up: each uses only those listed before it, and a test
//! enforces it.
//!
//! | module | what |
//! | --- | --- |
//! | [`tracking`] | a camera followed frame by frame, with covariances |
//! | [`planning`] | a way from a view to a goal, over a room's frames |
//! | [`calibration`] | how large an adapter's errors are in rooms that it did not learn from |
//! | [`fitting`] | an adapter fitted to one mapped room, and single views located in it |
//! | [`two_view`] | the motion between two views from matched image cells |
//!
//! Conventions are those of [`seese3_core`]. Nothing here reads files, the network, the clock or the
//! environment; randomness enters as a seed.

pub mod tracking;
pub mod two_view;
pub mod calibration;
pub mod planning;
pub mod fitting;
