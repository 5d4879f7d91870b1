//! Plays a stream of keypoints through the front end and the filter.

use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::Keypoints;
use seese3_core::room::FrameId;
use seese3_robot::front_end::{FrontEnd, RoomCandidate, StreamImage};
use seese3_robot::localization::KeypointRoom;
use seese3_robot::pose_filter::{FilterState, PoseFilter, ViewObservation};
use seese3_robot::tracking::{MeasuredPose, Status, Update};

/// A view of a stream.
#[derive(Clone, Copy)]
pub(super) struct PlayedView<'a> {
    pub time_ns: i64,
    pub sequence: u64,
    pub keypoints: &'a Keypoints,
    /// `None` if the service has to estimate it.
    pub camera: Option<CameraIntrinsics>,
    /// Equal for identical images.
    pub fingerprint: u64,
    /// `world_from_camera`.
    pub truth: Pose,
}

/// Whether the views of a stream are matched with the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sight {
    Mapped,
    Unmapped,
}

/// Plays a stream, view by view.
#[derive(Clone)]
pub(super) struct Player<'a> {
    pub filter: &'a PoseFilter,
    pub map: &'a KeypointRoom,
    pub mapped: &'a [FrameId],
    /// Of the images, image widths.
    pub height: f64,
    pub state: FilterState,
    pub front_end: FrontEnd,
    /// The pose of the last view, if it was located.
    pub predicted: Option<Pose>,
}

impl Player<'_> {
    /// Adds a view; `None` if the filter refuses it.
    pub fn step(
        &mut self,
        view: &PlayedView<'_>,
        sight: Sight,
        measured: Option<MeasuredPose>,
    ) -> Option<Update> {
        let fingerprint = (!view.keypoints.is_empty()).then_some(view.fingerprint);
        let candidate = RoomCandidate {
            index: 0,
            room: self.map,
            frames: Some(self.mapped),
        };
        let image = StreamImage {
            time_ns: view.time_ns,
            keypoints: view.keypoints,
            height: self.height,
            fingerprint,
            predicted: self.predicted,
            predicted_motion: None,
        };
        let candidates = match sight {
            Sight::Mapped => vec![candidate],
            Sight::Unmapped => Vec::new(),
        };
        let read = self.front_end.read(&image, &candidates);
        let observation = ViewObservation {
            measured,
            ..read.observation(view.time_ns, view.sequence, fingerprint)
        };

        let update = self.filter.observe(&mut self.state, &observation).ok()?;
        let is_located = update.status == Status::Tracking && update.match_used;
        let tracked = update.map_pose.filter(|_| is_located);
        self.predicted = tracked.map(|tracked| tracked.pose);
        Some(update)
    }
}
