//! The front end of a stream: what its views tell a [`crate::pose_filter`].
//!
//! A [`FrontEnd`] reads the keypoints of images; a [`RetrievalFrontEnd`] retrieves the most similar
//! mapped frames of latents and features.
//!
//! 1. The camera is stated, that of the map, or estimated from the first views.
//! 2. A view is located in the stream's room or, while that is unknown, in all rooms.
//! 3. Visual odometry measures the motion since the last view. A located view gives it the depths
//!    of its keypoints; for other views a sensor may.

mod camera;
mod retrieval;

pub use camera::StreamCamera;
pub use retrieval::{OtherCamera, RetrievalFrontEnd, RetrievalReading, StreamView};

use crate::localization::{KeypointRoom, LocatedView, NotLocated};
use crate::matched_views::ViewKeypoints;
use crate::pose_filter::{LocatedPose, Source, ViewObservation};
use crate::tracking::{BestMatch, PoseWithCovariance};
use crate::visual_odometry::{
    KnownDepth, OdometryParameters, OdometryView, VisualMotion, VisualOdometry,
};
use camera::CameraVotes;
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::index::Neighbor;
use seese3_core::keypoints::Keypoints;
use seese3_core::room::FrameId;

/// The front end of one stream. It is kept in memory while the stream is open.
#[derive(Debug, Clone)]
pub struct FrontEnd {
    camera: StreamCamera,
    votes: CameraVotes,
    odometry: Option<VisualOdometry>,
    last: Option<LastImage>,
}

#[derive(Debug, Clone, Copy)]
struct LastImage {
    time_ns: i64,
    fingerprint: Option<u64>,
}

/// An image of a stream.
#[derive(Debug, Clone, Copy)]
pub struct StreamImage<'a> {
    /// Timestamp, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Its keypoints.
    pub keypoints: &'a Keypoints,
    /// Height, in image widths.
    pub height: f64,
    /// Hash of the keypoints: equal for identical images. `None` without keypoints.
    pub fingerprint: Option<u64>,
    /// The pose of the camera that the view is looked for near, `world_from_camera`.
    pub predicted: Option<Pose>,
    /// The motion since the last frame, if another sensor measures it.
    pub predicted_motion: Option<Pose>,
    /// Depths of keypoints that a sensor measures. The map has those of a located view.
    pub depths: &'a [KnownDepth],
}

/// A room that an image is matched with.
#[derive(Debug, Clone, Copy)]
pub struct RoomCandidate<'a> {
    /// Index of the room in the filter.
    pub index: usize,
    /// Its keypoints.
    pub room: &'a KeypointRoom,
    /// Its mapped frames, row by row of the keypoints; `None` if row and frame are the same number.
    pub frames: Option<&'a [FrameId]>,
}

/// The pose of an image by its keypoints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchedPose {
    /// Index of the room in the filter.
    pub room: usize,
    /// `world_from_camera`.
    pub pose: PoseWithCovariance,
    /// How unlike the view is to the map, relative to the limit; at most 1.
    pub novelty: f64,
    /// The mapped frame with the most matched keypoints.
    pub best_frame: FrameId,
}

impl MatchedPose {
    /// The mapped frame with the most matched keypoints; the distance is `novelty`.
    pub fn best_match(&self) -> BestMatch {
        BestMatch {
            room: self.room,
            frame: Neighbor {
                frame: self.best_frame,
                distance: self.novelty,
            },
            camera: None,
        }
    }

    /// The observation of a filter.
    pub fn located(&self) -> LocatedPose {
        LocatedPose {
            room: self.room,
            pose: self.pose,
            source: Source::Matched,
            is_of_room: true,
            camera: None,
        }
    }
}

/// What an image tells.
#[derive(Debug, Clone, Default)]
pub struct ImageReading {
    /// The pose; `None` if no room locates the view.
    pub matched: Option<MatchedPose>,
    /// Why no room locates the view: the camera that the matches contradict, else the reason of the
    /// most similar room. `None` for an image that is identical to the last one.
    pub why_not: Option<NotLocated>,
    /// The motion since the last frame; `None` if the images do not agree.
    pub motion: Option<VisualMotion>,
}

impl ImageReading {
    /// The observation of a frame with this image, without wheel odometry.
    pub fn observation(
        self,
        time_ns: i64,
        sequence: u64,
        fingerprint: Option<u64>,
    ) -> ViewObservation {
        let novelty = match (&self.matched, self.why_not) {
            (Some(matched), _) => matched.novelty,
            (None, why) => why.and_then(|why| why.novelty()).unwrap_or(f64::INFINITY),
        };
        let why_not = self.why_not.filter(|_| self.matched.is_none());
        let unlocated = why_not.map_or_else(String::new, |why| why.to_string());
        ViewObservation {
            located: self.matched.iter().map(MatchedPose::located).collect(),
            best_match: self.matched.as_ref().map(MatchedPose::best_match),
            novelty,
            unlocated,
            fingerprint,
            visual: self.motion,
            ..ViewObservation::empty(time_ns, sequence)
        }
    }
}

/// A view that was looked for in some rooms.
#[derive(Debug, Clone, Default)]
struct FoundView {
    /// Place among the candidates, and the pose.
    located: Option<(usize, LocatedView)>,
    why_not: Option<NotLocated>,
}

impl FrontEnd {
    /// The front end of a new stream. Without parameters there is no visual odometry.
    pub fn new(camera: StreamCamera, odometry: Option<OdometryParameters>) -> Self {
        Self {
            camera,
            votes: CameraVotes::default(),
            odometry: odometry.map(VisualOdometry::new),
            last: None,
        }
    }

    /// Forgets everything about the stream but a stated camera.
    pub fn reset(&mut self) {
        let mut camera = self.camera.clone();
        camera.restart();
        let odometry = self.odometry.as_ref();
        let parameters = odometry.map(|odometry| *odometry.parameters());
        *self = Self::new(camera, parameters);
    }

    /// The camera of the stream.
    pub fn camera(&self) -> &StreamCamera {
        &self.camera
    }

    /// Whether it measures the motion between images.
    pub fn has_odometry(&self) -> bool {
        self.odometry.is_some()
    }

    /// Adds a frame without an image, or with a blank one.
    pub fn skip(&mut self, time_ns: i64) {
        let seconds = self.seconds_to(time_ns);
        if let Some(last) = &mut self.last {
            *last = LastImage {
                time_ns,
                fingerprint: None,
            };
        }
        if let Some(odometry) = &mut self.odometry {
            odometry.skip(seconds);
        }
    }

    /// Sets the motion to the last frame to the filter's estimate if visual odometry found none. A
    /// later image corrects it.
    pub fn assume(&mut self, motion: &Pose) {
        if let Some(odometry) = &mut self.odometry {
            odometry.assume(motion);
        }
    }

    /// Seconds from the last frame to this one; 0 for the first.
    fn seconds_to(&self, time_ns: i64) -> f64 {
        self.last
            .map_or(0.0, |last| time_ns.abs_diff(last.time_ns) as f64 * 1e-9)
    }

    /// Reads an image. An image that is identical to the last one tells nothing new.
    pub fn read(&mut self, image: &StreamImage<'_>, rooms: &[RoomCandidate<'_>]) -> ImageReading {
        let is_repeated = self.last.is_some_and(|last| {
            last.fingerprint.is_some() && last.fingerprint == image.fingerprint
        });
        let seconds = self.seconds_to(image.time_ns);
        self.last = Some(LastImage {
            time_ns: image.time_ns,
            fingerprint: image.fingerprint,
        });
        if is_repeated {
            if let Some(odometry) = &mut self.odometry {
                odometry.repeat(seconds);
            }
            return ImageReading::default();
        }

        let estimated = match &mut self.camera {
            StreamCamera::Stated(_) | StreamCamera::Mapping => None,
            StreamCamera::Unknown(search) => {
                let candidates = rooms.iter().map(|candidate| candidate.room);
                search.camera(image.keypoints, image.height, candidates)
            }
        };
        let is_unknown = matches!(self.camera, StreamCamera::Unknown(_));
        if is_unknown && estimated.is_none() {
            if let Some(odometry) = &mut self.odometry {
                odometry.skip(seconds);
            }
            return ImageReading {
                why_not: Some(NotLocated::UnknownCamera),
                ..ImageReading::default()
            };
        }

        let found = self.located(image, rooms, estimated);
        let motion = self.moved(image, rooms, &found, (estimated, seconds));
        let matched = found.located.map(|(place, located)| {
            let row = located.matched.best_frame();
            let candidate = &rooms[place];
            MatchedPose {
                room: candidate.index,
                pose: located.pose,
                novelty: located.novelty,
                best_frame: candidate
                    .frames
                    .map_or(FrameId(row as u32), |frames| frames[row]),
            }
        });
        ImageReading {
            matched,
            why_not: found.why_not,
            motion,
        }
    }

    /// Looks for a view in some rooms.
    fn located(
        &mut self,
        image: &StreamImage<'_>,
        rooms: &[RoomCandidate<'_>],
        estimated: Option<CameraIntrinsics>,
    ) -> FoundView {
        let mut best: Option<(usize, LocatedView)> = None;
        let mut reasons = Vec::new();
        for (place, candidate) in rooms.iter().enumerate() {
            let Some(camera) = self.camera.in_room(candidate.room, estimated) else {
                continue;
            };
            let view = ViewKeypoints {
                keypoints: image.keypoints,
                camera: &camera,
            };
            match candidate.room.locate_from(view, image.predicted.as_ref()) {
                Ok(found) => {
                    let most = best.as_ref().map_or(0, |(_, best)| best.inliers);
                    if found.inliers > most {
                        best = Some((place, found));
                    }
                }
                Err(why) => reasons.push(why),
            }
        }

        let novelty = |why: &NotLocated| match why {
            NotLocated::CameraContradicted { .. } => 0.0,
            other => other.novelty().unwrap_or(f64::INFINITY),
        };
        reasons.sort_by(|a, b| novelty(a).total_cmp(&novelty(b)));
        let found = FoundView {
            why_not: reasons.first().filter(|_| best.is_none()).copied(),
            located: best,
        };

        match &mut self.camera {
            StreamCamera::Stated(_) | StreamCamera::Mapping => self.votes.judged(found),
            StreamCamera::Unknown(search) => {
                if found.why_not.is_some_and(|why| why.is_of_camera()) {
                    search.contradict();
                }
                let with_focal = |(place, view): (usize, LocatedView)| match estimated {
                    Some(camera) => (place, search.with_focal_of(&camera, view)),
                    None => (place, view),
                };
                FoundView {
                    located: found.located.map(with_focal),
                    ..found
                }
            }
        }
    }

    /// The motion since the last image.
    fn moved(
        &mut self,
        image: &StreamImage<'_>,
        rooms: &[RoomCandidate<'_>],
        found: &FoundView,
        (estimated, seconds): (Option<CameraIntrinsics>, f64),
    ) -> Option<VisualMotion> {
        let located = found.located.as_ref();
        let candidate = rooms.get(located.map_or(0, |(place, _)| *place));
        let odometry = self.odometry.as_mut()?;
        let camera = match (&self.camera, candidate) {
            (camera, Some(candidate)) => camera.in_room(candidate.room, estimated),
            (StreamCamera::Stated(camera), None) => Some(*camera),
            (_, None) => estimated,
        };
        let Some(camera) = camera else {
            odometry.skip(seconds);
            return None;
        };

        // The map is right about the room where a view is located; a depth camera may be wrong.
        let depths = located.map_or_else(
            || image.depths.to_vec(),
            |(place, view)| rooms[*place].room.known_depths(view),
        );
        odometry.observe(&OdometryView {
            view: ViewKeypoints {
                keypoints: image.keypoints,
                camera: &camera,
            },
            seconds,
            predicted_motion: image.predicted_motion,
            depths: &depths,
        })
    }
}
