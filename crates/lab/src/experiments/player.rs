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
use seese3_robot::pose_filter::{
    FilterState, MeasuredGravity, MeasuredInertia, PoseFilter, ViewObservation,
};
use seese3_robot::tracking::{Map, MeasuredPose, Status, Update};
use seese3_robot::visual_odometry::KnownDepth;

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

/// What the sensors of a robot say at a view.
#[derive(Debug, Clone, Default)]
pub(super) struct Sensed {
    pub measured: Option<MeasuredPose>,
    pub inertia: Option<MeasuredInertia>,
    /// Of keypoints.
    pub depths: Vec<KnownDepth>,
}

/// Whether the views of a stream are compared with the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sight {
    Mapped,
    Unmapped,
    /// There is no image.
    Dark,
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

/// A view as a front end sees it.
struct SeenView<'a, 'v> {
    view: &'a PlayedView<'v>,
    sight: Sight,
    /// The pose of the last view, if it was located.
    predicted: Option<Pose>,
    /// The motion since the last view, if a sensor measures it.
    motion: Option<Pose>,
    depths: &'a [KnownDepth],
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
    pub fn step(&mut self, view: &PlayedView<'_>, sight: Sight, sensed: &Sensed) -> Option<Update> {
        let observation = self.observation(view, sight, sensed);
        self.observe(&observation)
    }

    /// What the filter is told of a view.
    pub fn observation(
        &mut self,
        view: &PlayedView<'_>,
        sight: Sight,
        sensed: &Sensed,
    ) -> ViewObservation {
        let by_sensors = ViewObservation {
            measured: sensed.measured,
            inertia: sensed.inertia.clone(),
            gravity: view.gravity,
            ..ViewObservation::empty(view.time_ns, view.sequence)
        };
        let motion = self.filter.sensed_motion(&self.state, &by_sensors);
        let seen = SeenView {
            view,
            sight,
            predicted: self.predicted,
            motion,
            depths: &sensed.depths,
        };
        ViewObservation {
            measured: by_sensors.measured,
            inertia: by_sensors.inertia,
            gravity: by_sensors.gravity,
            ..self.reader.observation(&seen)
        }
    }

    /// Tells the filter; `None` if it refuses the frame.
    pub fn observe(&mut self, observation: &ViewObservation) -> Option<Update> {
        let before = self.state.odom.pose;
        let update = self.filter.observe(&mut self.state, observation).ok()?;
        if let Reader::Keypoints { front_end, .. } = &mut self.reader {
            front_end.assume(&before.inv_mul(&self.state.odom.pose));
        }
        let is_located = update.status == Status::Tracking && update.match_used;
        let tracked = update.map_pose.filter(|_| is_located);
        self.predicted = tracked.map(|tracked| tracked.pose);
        Some(update)
    }
}

impl<'a> SeenView<'a, '_> {
    /// The image with these keypoints; `height` is in image widths.
    fn image(
        &self,
        keypoints: &'a Keypoints,
        height: f64,
        fingerprint: Option<u64>,
    ) -> StreamImage<'a> {
        let moved = |pose: Pose| self.motion.map_or(pose, |motion| pose * motion);
        StreamImage {
            time_ns: self.view.time_ns,
            keypoints,
            height,
            fingerprint,
            predicted: self.predicted.map(moved),
            predicted_motion: self.motion,
            depths: self.depths,
        }
    }
}

impl Reader<'_> {
    fn observation(&mut self, seen: &SeenView<'_, '_>) -> ViewObservation {
        let SeenView { view, sight, .. } = *seen;
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
                if sight == Sight::Dark {
                    front_end.skip(view.time_ns);
                    return ViewObservation::empty(view.time_ns, view.sequence);
                }
                let fingerprint = (!keypoints.is_empty()).then_some(fingerprint);
                let candidate = RoomCandidate {
                    index: 0,
                    room: map,
                    frames: Some(mapped),
                };
                let image = seen.image(keypoints, *height, fingerprint);
                let candidates = match sight {
                    Sight::Mapped => vec![candidate],
                    Sight::Unmapped | Sight::Dark => Vec::new(),
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
                    is_blank: is_blank || sight == Sight::Dark,
                };
                let maps = match sight {
                    Sight::Mapped => std::slice::from_ref(*map),
                    Sight::Unmapped | Sight::Dark => &[],
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
