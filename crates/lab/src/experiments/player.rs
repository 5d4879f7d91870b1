//! Plays a stream through a front end and the filter.

use std::sync::Arc;

use ndarray::ArrayView1;

use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::Keypoints;
use seese3_core::room::FrameId;
use seese3_robot::front_end::{
    FrontEnd, ImageReading, RetrievalFrontEnd, RoomCandidate, StreamImage, StreamView,
};
use seese3_robot::localization::KeypointRoom;
use seese3_robot::pose_filter::{FilterState, MeasuredGravity, PoseFilter, ViewObservation};
use seese3_robot::tracking::{Map, MeasuredPose, Status, Update};

/// A view of a stream.
#[derive(Clone, Copy)]
pub(super) struct PlayedView<'a> {
    pub time_ns: i64,
    pub sequence: u64,
    pub input: ViewInput<'a>,
    pub gravity: Option<MeasuredGravity>,
    /// `world_from_camera`.
    pub truth: Pose,
}

/// What a stream sends of a view.
#[derive(Clone, Copy)]
pub(super) enum ViewInput<'a> {
    /// Its keypoints; none for a blank image.
    Keypoints {
        keypoints: &'a Keypoints,
        /// `None` if the service has to estimate it.
        camera: Option<CameraIntrinsics>,
        /// Equal for identical images.
        fingerprint: u64,
    },
    /// Its feature, with the latent of the adapter.
    Feature {
        latent: ArrayView1<'a, f64>,
        feature: ArrayView1<'a, f32>,
        is_blank: bool,
    },
}

/// Whether the views of a stream are compared with the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sight {
    Mapped,
    Unmapped,
}

/// Plays a stream, view by view.
#[derive(Clone)]
pub(super) struct Player<'a> {
    pub filter: &'a PoseFilter,
    pub state: FilterState,
    pub reader: Reader<'a>,
    /// The pose of the last view, if it was located.
    pub predicted: Option<Pose>,
}

/// The front end of a stream, with the map.
#[derive(Clone)]
pub(super) enum Reader<'a> {
    Keypoints {
        map: &'a KeypointRoom,
        mapped: &'a [FrameId],
        /// Of the images, image widths.
        height: f64,
        front_end: Box<FrontEnd>,
    },
    Retrieval {
        map: &'a Arc<Map>,
        front_end: RetrievalFrontEnd,
    },
}

impl Player<'_> {
    /// Adds a view; `None` if the filter refuses it.
    pub fn step(
        &mut self,
        view: &PlayedView<'_>,
        sight: Sight,
        measured: Option<MeasuredPose>,
    ) -> Option<Update> {
        let observation = ViewObservation {
            measured,
            gravity: view.gravity,
            ..self.reader.observation(view, sight, self.predicted)
        };

        let update = self.filter.observe(&mut self.state, &observation).ok()?;
        let is_located = update.status == Status::Tracking && update.match_used;
        let tracked = update.map_pose.filter(|_| is_located);
        self.predicted = tracked.map(|tracked| tracked.pose);
        Some(update)
    }
}

impl Reader<'_> {
    fn observation(
        &mut self,
        view: &PlayedView<'_>,
        sight: Sight,
        predicted: Option<Pose>,
    ) -> ViewObservation {
        match (self, view.input) {
            (
                Self::Keypoints {
                    map,
                    mapped,
                    height,
                    front_end,
                },
                ViewInput::Keypoints {
                    keypoints,
                    fingerprint,
                    ..
                },
            ) => {
                let fingerprint = (!keypoints.is_empty()).then_some(fingerprint);
                let candidate = RoomCandidate {
                    index: 0,
                    room: map,
                    frames: Some(mapped),
                };
                let image = StreamImage {
                    time_ns: view.time_ns,
                    keypoints,
                    height: *height,
                    fingerprint,
                    predicted,
                    predicted_motion: None,
                };
                let candidates = match sight {
                    Sight::Mapped => vec![candidate],
                    Sight::Unmapped => Vec::new(),
                };
                let read = front_end.read(&image, &candidates);
                read.observation(view.time_ns, view.sequence, fingerprint)
            }
            (
                Self::Retrieval { map, front_end },
                ViewInput::Feature {
                    latent,
                    feature,
                    is_blank,
                },
            ) => {
                let feature = feature.to_vec();
                let view_of_stream = StreamView {
                    other: None,
                    latent,
                    feature: Some(&feature),
                    is_blank,
                };
                let maps = match sight {
                    Sight::Mapped => std::slice::from_ref(*map),
                    Sight::Unmapped => &[],
                };
                let read = front_end.read(&[view_of_stream], maps, None);
                read.observation(&ImageReading::default(), view.time_ns, view.sequence)
            }
            // Not reachable: views and readers are of one room.
            (Self::Keypoints { .. }, ViewInput::Feature { .. })
            | (Self::Retrieval { .. }, ViewInput::Keypoints { .. }) => {
                ViewObservation::empty(view.time_ns, view.sequence)
            }
        }
    }
}
