//! Recordings on disk to rooms and back, and a check of poses against images. Part of
//! [seese3](https://docs.rs/seese3).
//!
//! # The map
//!
//! The modules are listed from the lowest layer up: each uses only those listed before it, and a test
//! enforces it.
//!
//! | module | what |
//! | --- | --- |
//! | [`image_motion`] | how an image moved between two views |
//! | [`pose_check`] | whether poses can be those of a recording's images |
//! | [`datasets`] | recordings on disk to rooms |
//! | [`export`] | paths and streams for other programs: TUM, KITTI, MCAP |

pub mod export;
pub mod image_motion;
pub mod pose_check;
pub mod datasets;
