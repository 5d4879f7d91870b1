//! Robot functions beyond the paper: tracking, planning, calibration, adapters fitted to one room,
//! and motion between two views. Part of [seese3](https://docs.rs/seese3).
//!
//! ```
//! use std::sync::Arc;
//!
//! use seese3_core::adapter::{Adapter, TrainingRecord};
//! use seese3_core::features::Features;
//! use seese3_core::navigation::{IndexKind, Navigator};
//! use seese3_core::room::{FrameId, Room};
//! use seese3_core::training::RoomData;
//! use seese3_robot::calibration::calibrate;
//! use seese3_robot::tracking::{Map, Tracker, TrackerSettings};
//!
//! /// A tracker in a mapped room, from a trained adapter and rooms that it was not trained on.
//! fn tracker(
//!     adapter: Adapter,
//!     record: TrainingRecord,
//!     calibration_rooms: &[RoomData<'_>],
//!     room: Room,
//!     features: &Features,
//! ) -> Result<Tracker, Box<dyn std::error::Error>> {
//!     let calibrated = calibrate(adapter, record, calibration_rooms)?;
//!     let adapter = Arc::new(calibrated.adapter);
//!
//!     let mapped: Vec<FrameId> = (0..room.frame_count() as u32).map(FrameId).collect();
//!     let navigator = Navigator::new(Arc::new(room), features, adapter.clone(), IndexKind::Exact)?;
//!     let map = Map::new(Arc::new(navigator), &mapped)?;
//!     Ok(Tracker::new(vec![Arc::new(map)], TrackerSettings::of(&adapter))?)
//! }
//! ```
//!
//! # Modules
//!
//! Listed from the lowest layer up: each module uses only those listed before it; a test enforces
//! this.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`matched_views`] | estimates a view's pose from keypoints matched with mapped keypoints |
//! | [`two_view`] | estimates the motion between two views without a map, by matched keypoints |
//! | [`visual_odometry`] | estimates a camera's motion from its images, without a map |
//! | [`tracking`] | tracks a camera frame by frame, with covariances |
//! | [`pose_filter`] | tracks a camera by located views, without an adapter |
//! | [`localization`] | estimates where a view is in a mapped room, by the best method that answers |
//! | [`front_end`] | locates the images of a stream and measures the motion between them |
//! | [`planning`] | plans a route from a view to a goal, over a room's frames |
//! | [`calibration`] | measures an adapter's errors in rooms that it was not trained on |
//! | [`fitting`] | fits an adapter to one mapped room and localizes single views in it |
//!
//! Conventions are those of [`seese3_core`]. This crate does not access files, the network, the
//! clock or the environment. Random numbers come from explicit seeds.

pub mod matched_views;
pub mod two_view;
pub mod visual_odometry;
pub mod tracking;
pub mod pose_filter;
pub mod localization;
pub mod front_end;
pub mod calibration;
pub mod planning;
pub mod fitting;
