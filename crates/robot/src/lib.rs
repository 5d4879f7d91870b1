//! Robot functions beyond the paper: tracking, planning, calibration, adapters fitted to one room,
//! and motion between two views. Part of [seese3](https://docs.rs/seese3).
//!
//! # Modules
//!
//! Listed from the lowest layer up: each module uses only those listed before it; a test enforces
//! this.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`tracking`] | tracks a camera frame by frame, with covariances |
//! | [`planning`] | plans a route from a view to a goal, over a room's frames |
//! | [`calibration`] | measures an adapter's errors in rooms that it was not trained on |
//! | [`fitting`] | fits an adapter to one mapped room and localizes single views in it |
//! | [`two_view`] | estimates the motion between two views from matched image cells |
//!
//! Conventions are those of [`seese3_core`]. This crate does not access files, the network, the
//! clock or the environment. Random numbers come from explicit seeds.

pub mod tracking;
pub mod two_view;
pub mod calibration;
pub mod planning;
pub mod fitting;
