//! Matches the images of a stream with the keypoints of its rooms.

use super::super::embedding::ImageKeypoints;
use super::super::image_view::check_aspect;
use super::super::{Error, convert};
use super::rooms::TrackedRoom;
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::KeypointSource;
use seese3_core::room::FrameId;
use seese3_robot::localization::{FocalSearch, KeypointRoom, LocatedView, NotLocated};
use seese3_robot::matched_views::ViewKeypoints;
use seese3_robot::tracking::MatchedPose;

/// The camera of a stream.
pub enum StreamCamera {
    /// Stated by the client.
    Stated(CameraIntrinsics),
    /// The camera that mapped the room.
    Mapping,
    /// Estimated from the stream's views.
    Unknown(FocalSearch),
}

/// What the images of a stream are matched with.
pub struct StreamRooms<'a> {
    pub rooms: &'a [TrackedRoom],
    /// The source of the image's keypoints.
    pub source: &'a KeypointSource,
    /// The stream's room, an index of `rooms`; `None` while it is unknown.
    pub room: Option<usize>,
    /// The last pose of the camera in that room, `world_from_camera`.
    pub predicted: Option<Pose>,
}

/// The match of one image.
#[derive(Default)]
pub struct StreamMatch {
    /// The pose; `None` if no room locates the view.
    pub pose: Option<MatchedPose>,
    /// Why no room locates the view: the camera that the matches contradict, else the reason of the
    /// most similar room. `None` while the camera is unknown.
    pub why_not: Option<NotLocated>,
}

/// Number of contradicted views from which a stated camera is not believed.
const MIN_CONTRADICTED: u32 = 3;

/// How many views of a stream agree with its stated camera.
#[derive(Default)]
pub struct CameraVotes {
    located: u32,
    contradicted: u32,
    /// The last contradiction.
    last: Option<NotLocated>,
}

impl CameraVotes {
    /// Counts a match, and withdraws its pose if most views contradict the camera: views far from the
    /// map do not determine their focal length, and would be located at a wrong place.
    pub fn judged(&mut self, found: StreamMatch) -> StreamMatch {
        self.located += u32::from(found.pose.is_some());
        if let Some(why) = found.why_not.filter(NotLocated::is_of_camera) {
            self.contradicted += 1;
            self.last = Some(why);
        }

        let is_wrong = self.contradicted >= MIN_CONTRADICTED && self.contradicted > self.located;
        if is_wrong && found.pose.is_some() {
            return StreamMatch {
                pose: None,
                why_not: self.last,
            };
        }
        found
    }
}

impl StreamRooms<'_> {
    /// The rooms to match, with their indices.
    fn candidates(&self) -> impl Iterator<Item = (usize, &KeypointRoom)> {
        let rooms = self.rooms.iter().enumerate();
        rooms.filter_map(|(place, room)| {
            let keypoints = room.keypoints.as_ref()?;
            let is_asked = self.room.is_none_or(|room| room == place);
            let is_matched = is_asked && keypoints.source.is_like(self.source);
            is_matched.then_some((place, keypoints.room.as_ref()))
        })
    }
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
                "is set together with camera; set only one of them",
            )),
            (Some(camera), false) => Ok(Self::Stated(convert::camera(camera)?)),
            (None, true) => Ok(Self::Mapping),
            (None, false) => Ok(Self::Unknown(FocalSearch::default())),
        }
    }

    /// Whether the camera is estimated, not stated.
    pub fn is_estimated(&self) -> bool {
        matches!(self, Self::Unknown(_))
    }

    /// Forgets an estimated camera.
    pub fn restart(&mut self) {
        if let Self::Unknown(search) = self {
            *search = FocalSearch::default();
        }
    }

    /// Matches an image with the keypoints of the stream's room or, while that is unknown, of all
    /// rooms.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `field` if the image has not the aspect ratio of its camera.
    pub fn matched(
        &mut self,
        field: &str,
        image: &ImageKeypoints,
        rooms: &StreamRooms<'_>,
    ) -> Result<StreamMatch, Error> {
        let [width, height] = image.size;
        let estimated = match self {
            Self::Stated(_) | Self::Mapping => None,
            Self::Unknown(search) => {
                let height = height as f64 / width as f64;
                let candidates = rooms.candidates().map(|(_, room)| room);
                let camera = search.camera(&image.keypoints, height, candidates);
                let Some(camera) = camera else {
                    return Ok(StreamMatch::default());
                };
                Some(camera)
            }
        };

        let is_only = rooms.candidates().count() == 1;
        let mut best: Option<(usize, LocatedView)> = None;
        let mut reasons = Vec::new();
        for (place, room) in rooms.candidates() {
            let camera = match self {
                Self::Stated(camera) => *camera,
                Self::Mapping => room.map().camera,
                Self::Unknown(_) => estimated.unwrap_or(room.map().camera),
            };
            match check_aspect(width, height, &camera) {
                Ok(()) => {}
                // Rooms may have been mapped with other cameras.
                Err(_) if matches!(self, Self::Mapping) && !is_only => continue,
                Err(problem) => return Err(Error::invalid(field, problem)),
            }

            let view = ViewKeypoints {
                keypoints: &image.keypoints,
                camera: &camera,
            };
            let predicted = rooms.predicted.as_ref().filter(|_| rooms.room.is_some());
            match room.locate_from(view, predicted) {
                Ok(found) => {
                    let most = best.as_ref().map_or(0, |(_, best)| best.inliers);
                    if found.inliers > most {
                        best = Some((place, found));
                    }
                }
                Err(why) => reasons.push(why),
            }
        }

        if let (Self::Unknown(search), Some(camera)) = (&mut *self, estimated) {
            best = best.map(|(place, found)| (place, search.with_focal_of(&camera, found)));
        }

        let novelty = |why: &NotLocated| match why {
            NotLocated::CameraContradicted { .. } => 0.0,
            other => other.novelty().unwrap_or(f64::INFINITY),
        };
        reasons.sort_by(|a, b| novelty(a).total_cmp(&novelty(b)));
        let why_not = reasons.first().filter(|_| best.is_none()).copied();
        if let Self::Unknown(search) = self
            && why_not.is_some_and(|why| why.is_of_camera())
        {
            search.contradict();
        }
        Ok(StreamMatch {
            why_not,
            pose: best.map(|(room, found)| MatchedPose {
                room,
                pose: found.pose,
                novelty: found.novelty,
                best_frame: FrameId(found.matched.best_frame() as u32),
            }),
        })
    }
}
