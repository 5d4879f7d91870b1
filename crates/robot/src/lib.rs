//! Robot functions beyond the paper: tracking, planning, calibration, adapters fitted to one room,
//! and motion between two views. Part of [seese3](https://docs.rs/seese3).
//!
//! ```
//! use std::sync::Arc;
//!
//! use seese3_core::adapter::Adapter;
//! use seese3_core::features::Features;
//! use seese3_core::navigation::{IndexKind, Navigator};
//! use seese3_core::room::{FrameId, Room};
//! use seese3_robot::front_end::{ImageReading, RetrievalFrontEnd, StreamView};
//! use seese3_robot::pose_filter::{FilterParameters, FilterRoom, PoseFilter};
//! use seese3_robot::tracking::{Map, Update};
//!
//! /// Tracks a camera in a mapped room by the latents of its views, with a calibrated adapter.
//! fn track(
//!     adapter: Adapter,
//!     room: Room,
//!     features: &Features,
//!     views: &[Vec<f32>],
//! ) -> Result<Vec<Update>, Box<dyn std::error::Error>> {
//!     let adapter = Arc::new(adapter);
//!     let mapped: Vec<FrameId> = (0..room.frame_count() as u32).map(FrameId).collect();
//!     let rooms = vec![FilterRoom::of(&room, &mapped)];
//!     let navigator = Navigator::new(Arc::new(room), features, adapter.clone(), IndexKind::Exact)?;
//!     let maps = [Arc::new(Map::new(Arc::new(navigator), &mapped)?)];
//!
//!     let filter = PoseFilter::new(rooms, FilterParameters::default()).ok_or("no room")?;
//!     let mut state = filter.start(None);
//!     let mut front_end = RetrievalFrontEnd::default();
//!     let mut updates = Vec::new();
//!     for (number, feature) in (1..).zip(views) {
//!         let latent = adapter.embed_one(feature)?;
//!         let view = StreamView {
//!             other: None,
//!             latent: latent.view(),
//!             feature: Some(feature),
//!             is_blank: false,
//!         };
//!         let reading = front_end.read(&[view], &maps, state.room);
//!         let time_ns = number as i64 * 33_000_000;
//!         let observed = reading.observation(&ImageReading::default(), time_ns, number);
//!         updates.push(filter.observe(&mut state, &observed)?);
//!     }
//!     Ok(updates)
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
//! | [`tracking`] | poses with covariances, and the retrieval of a view's most similar mapped frames |
//! | [`pose_filter`] | the filter that tracks a camera, from located views, motions and gravity |
//! | [`localization`] | estimates where a view is in a mapped room, by the best method that answers |
//! | [`front_end`] | makes the observations of the filter from the views of a stream |
//! | [`planning`] | plans a route from a view to a goal, over a room's frames |
//! | [`calibration`] | measures an adapter's errors in rooms that it was not trained on |
//! | [`fitting`] | fits an adapter to one mapped room and localizes single views in it |
//!
//! Conventions are those of [`seese3_core`]. This crate does not access files, the network, the
//! clock or the environment. Random numbers come from explicit seeds.

pub mod matched_views;
pub mod inertial;
pub mod two_view;
pub mod visual_odometry;
pub mod tracking;
pub mod pose_filter;
pub mod localization;
pub mod front_end;
pub mod calibration;
pub mod planning;
pub mod fitting;
