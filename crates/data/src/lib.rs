//! Import and export of recordings, and a check of poses against images. Part of
//! [seese3](https://docs.rs/seese3).
//!
//! ```
//! use seese3_core::room::{Provenance, Room, RoomId};
//! use seese3_data::datasets::{Reader, Unusable, read_tum};
//! use seese3_data::pose_check::check_room;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir()?;
//! # let folder = folder.path();
//! # std::fs::write(folder.join("groundtruth.txt"), "1.0 0 0 0 0 0 0 1\n2.0 0.1 0 0 0 0 0 1\n")?;
//! # std::fs::write(folder.join("rgb.txt"), "1.0 rgb/1.png\n2.0 rgb/2.png\n")?;
//! # std::fs::create_dir(folder.join("rgb"))?;
//! # std::fs::write(folder.join("rgb/1.png"), "")?;
//! # std::fs::write(folder.join("rgb/2.png"), "")?;
//! // A recording of the TUM RGB-D benchmark, as a room.
//! let mut reader = Reader {
//!     unusable: Unusable::Drop,
//!     progress: &mut |_, _| (),
//! };
//! let recording = read_tum(folder, &mut reader)?;
//! let room = Room::new(RoomId::new("desk")?, recording.frames, Provenance::default())?;
//! assert_eq!(room.frame_count(), 2);
//!
//! // The camera moves from 0 to 0.1 m, and nothing is wrong with its path.
//! let report = check_room(&room, None);
//! assert!(!report.is_wrong(), "{:?}", report.warnings);
//! # Ok(()) }
//! ```
//!
//! # The map
//!
//! The modules are listed from the lowest layer up: each uses only those listed before it, and a
//! test enforces it.
//!
//! | module | what |
//! | --- | --- |
//! | [`image_motion`] | estimates how an image moved between two views |
//! | `point_matches` | matches points between two images with known poses |
//! | [`pose_check`] | checks whether poses match a recording's images |
//! | [`datasets`] | reads recordings from disk |
//! | [`export`] | writes trajectories and streams for other programs: TUM, KITTI, MCAP |

pub mod export;
pub mod image_motion;
mod point_matches;
pub mod pose_check;
pub mod datasets;
