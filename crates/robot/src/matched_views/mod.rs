//! Matched views: the pose of a view from keypoints matched with mapped keypoints of known depth.
//!
//! - Mapping triangulates the keypoints of each mapped frame from neighboring mapped frames, with
//!   their known poses ([`Mapping`]).
//! - A view is matched with a few retrieved frames. P3P in LO-RANSAC and a robust refinement give
//!   its pose ([`KeypointMap::match_view`]). The number of unique inliers shows whether the view is
//!   in the map.

mod absolute_pose;
mod focal_fit;
mod descriptors;
mod keypoint_map;
mod retrieval;
mod matching;
mod noise;
mod p3p;
mod parameters;
mod triangulation;

pub(crate) use absolute_pose::{Correspondence, Search, find_pose};
pub use absolute_pose::{MapNoise, PoseInformation};
pub(crate) use descriptors::matched_keypoints;
pub use descriptors::{COMPRESSED, DescriptorBasis, MAX_WIDTH};
pub use focal_fit::FocalFit;
pub use keypoint_map::{KeypointMap, MappedKeypoints, Mapping, epipolar_pairs};
pub use matching::{Candidates, InlierMatch, MatchedView, ViewKeypoints};
pub use noise::{Trial, fitted_noise, squared_length, trials};
pub use parameters::{MappingParameters, MatchingParameters};
pub use retrieval::PlaceIndex;
pub(crate) use triangulation::{pixel_focal, plane_points};

/// Why a keypoint map cannot be computed.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("no frame has a keypoint; check that the images are sharp and not blank")]
    NoDescriptors,
    #[error(
        "the descriptors have {added} numbers, those of the map {known}: another model made them"
    )]
    OtherDescriptors { known: usize, added: usize },
}
