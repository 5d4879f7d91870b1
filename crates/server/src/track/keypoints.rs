//! Matches the images of a stream with the keypoints of its rooms.

use std::sync::Arc;

use super::super::embedding::ImageKeypoints;
use super::super::image_view::check_aspect;
use super::super::snapshot::ServedNavigator;
use super::super::{Error, convert};
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::keypoints::Keypoints;
use seese3_robot::localization::camera_of_views;
use seese3_robot::matched_views::ViewKeypoints;
use seese3_robot::tracking::MatchedPose;

/// Number of views from which an unknown focal length is estimated.
const VIEWS_OF_UNKNOWN_CAMERA: usize = 5;
/// Maximum number of views that are tried for an unknown focal length. After it, a later view may
/// still succeed alone, every so many views.
const TRY_EVERY: u32 = 5;

/// The camera of a stream.
pub enum StreamCamera {
    /// Stated by the client, or estimated from the first views.
    Known(CameraIntrinsics),
    /// The camera that mapped the room.
    Mapping,
    /// To be estimated from these views, the newest last; and the number of views so far.
    Unknown(Vec<Keypoints>, u32),
}

impl StreamCamera {
    /// The camera of a configuration.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `camera` or `mapping_camera`.
    pub fn of(config: &pb::TrackConfig) -> Result<Self, Error> {
        match (&config.camera, config.mapping_camera) {
            (Some(_), true) => Err(Error::invalid(
                "mapping_camera",
                "and camera are two cameras; give one of them",
            )),
            (Some(camera), false) => Ok(Self::Known(convert::camera(camera)?)),
            (None, true) => Ok(Self::Mapping),
            (None, false) => Ok(Self::Unknown(Vec::new(), 0)),
        }
    }

    /// Matches an image with the keypoints of the stream's room or, while that is unknown, of all
    /// rooms. `None` if no room locates it.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `field` if the image has not the aspect ratio of its camera.
    pub fn matched(
        &mut self,
        field: &str,
        image: ImageKeypoints,
        served: &[Arc<ServedNavigator>],
        room: Option<usize>,
    ) -> Result<Option<MatchedPose>, Error> {
        let ImageKeypoints {
            keypoints,
            size: [width, height],
        } = image;
        let candidates = served.iter().enumerate();
        let candidates: Vec<(usize, &Arc<ServedNavigator>)> = candidates
            .filter(|(place, _)| room.is_none_or(|room| room == *place))
            .collect();

        if let Self::Unknown(views, seen) = self {
            *seen += 1;
            views.push(keypoints.clone());
            if views.len() > VIEWS_OF_UNKNOWN_CAMERA {
                views.remove(0);
            }

            // Six focal lengths are tried with each view, which takes some 100 ms a view.
            if views.len() < VIEWS_OF_UNKNOWN_CAMERA || !seen.is_multiple_of(TRY_EVERY) {
                return Ok(None);
            }
            let aspect = height as f64 / width as f64;
            let found = candidates.iter().find_map(|(_, served)| {
                let keypoints = served.keypoints.as_ref()?;
                camera_of_views(&keypoints.room, views, aspect)
            });
            let Some(camera) = found else {
                return Ok(None);
            };
            tracing::info!(
                focal_px = camera.focal().x * width as f64,
                width,
                "focal length of a stream's camera estimated"
            );
            *self = Self::Known(camera);
        }

        let mut best: Option<(usize, MatchedPose)> = None;
        for (place, served) in candidates {
            let Some(mapped) = &served.keypoints else {
                continue;
            };
            let camera = match self {
                Self::Known(camera) => *camera,
                Self::Mapping | Self::Unknown(..) => mapped.room.map().camera,
            };
            check_aspect(width, height, &camera)
                .map_err(|problem| Error::invalid(field, problem))?;

            let view = ViewKeypoints {
                keypoints: &keypoints,
                camera: &camera,
            };
            let Ok(found) = mapped.room.locate(view) else {
                continue;
            };
            if best.as_ref().is_none_or(|(most, _)| found.inliers > *most) {
                let pose = MatchedPose {
                    room: place,
                    pose: found.pose,
                    novelty: found.novelty,
                };
                best = Some((found.inliers, pose));
            }
        }

        Ok(best.map(|(_, pose)| pose))
    }
}
