//! Matches the images of a stream with the keypoints of its rooms.

use super::super::Error;
use super::super::convert::{self, ImageCamera};
use super::super::embedding::ImageKeypoints;
use super::super::image_view::check_aspect;
use super::rooms::TrackedRoom;
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::Pose;
use seese3_core::keypoints::KeypointSource;
use seese3_robot::front_end::{FrontEnd, ImageReading, RoomCandidate, StreamCamera, StreamImage};
use seese3_robot::visual_odometry::KnownDepth;

/// What the images of a stream are matched with.
pub struct StreamRooms<'a> {
    pub rooms: &'a [TrackedRoom],
    /// The source of the image's keypoints.
    pub source: &'a KeypointSource,
    /// The stream's room, an index of `rooms`; `None` while it is unknown.
    pub room: Option<usize>,
    /// The pose of the camera at the last frame in that room, `world_from_camera`.
    pub predicted: Option<Pose>,
    /// The motion since the last frame, if a sensor measures it.
    pub motion: Option<Pose>,
}

impl StreamRooms<'_> {
    /// The rooms to match.
    fn candidates(&self) -> Vec<RoomCandidate<'_>> {
        let rooms = self.rooms.iter().enumerate();
        let candidates = rooms.filter_map(|(index, room)| {
            let keypoints = room.keypoints.as_ref()?;
            let is_asked = self.room.is_none_or(|room| room == index);
            let is_matched = is_asked && keypoints.source.is_like(self.source);
            is_matched.then_some(RoomCandidate {
                index,
                room: keypoints.room.as_ref(),
                frames: None,
            })
        });
        candidates.collect()
    }

    /// Reads an image of the stream, with known depths of its keypoints.
    ///
    /// # Errors
    /// [`Error::Invalid`] on the image if it has not the aspect ratio of its camera.
    pub fn read(
        &self,
        front_end: &mut FrontEnd,
        image: &ImageKeypoints,
        depths: &[KnownDepth],
        time_ns: i64,
    ) -> Result<ImageReading, Error> {
        let [width, height] = image.size;
        let mut candidates = self.candidates();
        let invalid = |problem| Error::invalid("frame.view.image", problem);
        match front_end.camera() {
            StreamCamera::Stated(camera) => check_aspect(width, height, camera).map_err(invalid)?,
            StreamCamera::Unknown(_) => {}
            StreamCamera::Mapping => {
                if let [only] = candidates[..] {
                    check_aspect(width, height, &only.room.map().camera).map_err(invalid)?;
                }
                // Rooms may have been mapped with other cameras.
                let has_aspect = |candidate: &RoomCandidate<'_>| {
                    check_aspect(width, height, &candidate.room.map().camera).is_ok()
                };
                candidates.retain(has_aspect);
            }
        }

        let moved = |pose: Pose| self.motion.map_or(pose, |motion| pose * motion);
        let predicted = self.predicted.map(moved);
        let image = StreamImage {
            time_ns,
            keypoints: &image.keypoints,
            height: height as f64 / width as f64,
            fingerprint: image.fingerprint(),
            predicted: predicted.filter(|_| self.room.is_some()),
            predicted_motion: self.motion,
            depths,
        };
        Ok(front_end.read(&image, &candidates))
    }
}

/// The camera of a configuration.
///
/// # Errors
/// [`Error::Invalid`] on `camera`.
pub fn stream_camera(config: &pb::TrackConfig) -> Result<StreamCamera, Error> {
    let Some(camera) = &config.camera else {
        return Ok(StreamCamera::unknown());
    };
    Ok(match convert::image_camera("camera", camera)? {
        ImageCamera::Stated(camera) => StreamCamera::Stated(camera),
        ImageCamera::Mapping => StreamCamera::Mapping,
    })
}
