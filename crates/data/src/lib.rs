//! Import and export of recordings, and a check of poses against images. Part of
//! [seese3](https://docs.rs/seese3).
//!
//! # The map
//!
//! The modules are listed from the lowest layer up: each uses only those listed before it, and a test
//! enforces it.
//!
//! | module | what |
//! | --- | --- |
//! | [`image_motion`] | estimates how an image moved between two views |
//! | [`pose_check`] | checks whether poses match a recording's images |
//! | [`datasets`] | reads recordings from disk |
//! | [`export`] | writes trajectories and streams for other programs: TUM, KITTI, MCAP |

pub mod export;
pub mod image_motion;
pub mod pose_check;
pub mod datasets;
