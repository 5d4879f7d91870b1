//! A Track session: configuration, rooms, tracker state, and the answers to messages.

use std::sync::Arc;
use std::time::Duration;

use super::super::Error;
use super::super::convert;
use super::super::embedding::{EmbeddedView, ImageKeypoints, StoredFrames, ViewEmbedder};
use super::super::relocalization::maps;
use super::super::snapshot::{ServedNavigator, Snapshot};
use super::Overtaken;
use super::configuration::{StreamFrames, back_pressure, rooms, settings};
use super::keypoints::{StreamCamera, StreamMatch, StreamRooms};
use super::sealed::Sealed;
use super::sensors::Sensors;
use super::token::TokenKey;
use super::wire;
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::Pose;
use seese3_core::keypoints::KeypointSource;
use seese3_robot::tracking::{
    Observation, OtherView, PoseWithCovariance, Refusal, State, Status, Tracker, Update,
};

const FIELD: &str = "config";

/// A configured stream and its tracker state. The server keeps it only while the stream is open; a
/// resume token in the answers carries it.
pub struct Session {
    /// Snapshot without rooms, for the image encoders. A stream may last for days and must not keep
    /// replaced rooms in memory.
    encoders: Snapshot,
    served: Vec<Arc<ServedNavigator>>,
    tracker: Tracker,
    config: pb::TrackConfig,
    frames: StreamFrames,
    sensors: Sensors,
    camera: StreamCamera,
    /// The last map pose while TRACKING, `world_from_camera`.
    last_pose: Option<Pose>,
    state: State,
    key: TokenKey,
}

impl Session {
    /// Opens a stream from its configuration, or resumes the stream of the configuration's token.
    ///
    /// # Errors
    /// [`Error`] on the field, if the configuration or the token is not valid, or this server's
    /// rooms or adapter differ from those of the token.
    pub fn open(
        snapshot: &Arc<Snapshot>,
        config: pb::TrackConfig,
        key: &TokenKey,
    ) -> Result<Self, Error> {
        if config.resume_token.is_empty() {
            return Self::configured(snapshot, config, key).map_err(|error| error.within(FIELD));
        }

        let field = format!("{FIELD}.resume_token");

        // The token contains the stream's configuration; any other field could only contradict it.
        let alone = pb::TrackConfig {
            resume_token: config.resume_token.clone(),
            ..pb::TrackConfig::default()
        };

        if config != alone {
            return Err(Error::invalid(
                field,
                "contains the configuration: every other field must be empty",
            ));
        }

        // The seal is verified before decoding, so a decoding error is internal.
        let sealed = Sealed::from_bytes(key.open(&field, &config.resume_token)?)?;
        let config = sealed.config()?;

        let mut session = Self::configured(snapshot, config, key).map_err(|error| match error {
            Error::NotFound { name, .. } => {
                Error::Precondition(format!("{field}: '{name}' is not served here"))
            }
            other => other,
        })?;

        // The state's latents and poses are valid only with the same adapter and rooms.
        session.state = sealed.opened_in(&session.served).ok_or_else(|| {
            let problem = "this server has another room or adapter than the token; start anew";
            Error::Precondition(format!("{field}: {problem}"))
        })?;

        if !session.fits() {
            return Err(Error::Precondition(format!(
                "{field}: was sealed by a server of another version; start anew"
            )));
        }

        Ok(session)
    }

    /// Whether the state's latents have this adapter's width and its room indices are valid. The
    /// content digests should guarantee this; an invalid state would panic in the tracker.
    fn fits(&self) -> bool {
        let adapter = &self.served[0].adapter.adapter;
        let rooms = self.served.len();

        let State {
            room,
            last,
            keyframe,
            place,
            recent,
            candidate,
            other_cameras,
            recent_matches: _,
            seen_ns: _,
            gravity_ns: _,
            initial_pose: _,
            health: _,
            frames_off_map: _,
            unchanged_frames: _,
            corrected_ns: _,
            measured: _,
        } = &self.state;

        let latents = [
            last.as_ref().map(|last| &last.latent),
            keyframe.as_ref().map(|keyframe| &keyframe.latent),
            place.as_ref().and_then(|place| place.latent.as_ref()),
            candidate
                .as_ref()
                .and_then(|candidate| candidate.latent.as_ref()),
        ];

        let named = [*room, candidate.as_ref().map(|candidate| candidate.room)];
        latents
            .into_iter()
            .flatten()
            .all(|latent| adapter.check_latent(latent).is_ok())
            && recent
                .iter()
                .chain(other_cameras.iter().map(|other| &other.last))
                .all(|row| row.len() == adapter.coordinate_count())
            && named.into_iter().flatten().all(|room| room < rooms)
    }

    fn configured(
        snapshot: &Arc<Snapshot>,
        config: pb::TrackConfig,
        key: &TokenKey,
    ) -> Result<Self, Error> {
        // Validate everything before the stream starts.
        let served = rooms(snapshot, &config)?;
        let adapter = &served[0].adapter;
        let maps = maps(&served)?;
        let settings = settings(&config, &adapter.adapter)?;

        let frames = StreamFrames::of(&config)?;
        let sensors = Sensors::of(&config, &frames)?;
        let camera = StreamCamera::of(&config)?;
        back_pressure(config.back_pressure)?;

        // The pose is in a room's world frame, so it needs `room`.
        let begins = match config.initial_pose.clone() {
            None => None,
            Some(_) if config.room.is_empty() => {
                return Err(Error::invalid("initial_pose", "needs the room it is in"));
            }
            Some(given) => Some(
                frames
                    .known_pose(given, &config.room)
                    .map_err(|error| error.within("initial_pose"))?,
            ),
        };

        // Dead reckoning never localizes the camera, so it needs an initial pose.
        if !settings.fuse && begins.is_none() {
            return Err(Error::invalid(
                "fusion",
                "FUSION_NONE needs room and initial_pose; give both, or use FUSION_ANCHORS",
            ));
        }

        let tracker =
            Tracker::new(maps, settings).map_err(|error| Error::Precondition(error.to_string()))?;
        let state = tracker.start(begins);
        Ok(Self {
            encoders: snapshot.without_rooms(),
            served,
            tracker,
            config,
            frames,
            sensors,
            camera,
            last_pose: None,
            state,
            key: key.clone(),
        })
    }

    /// Whether only the newest of the waiting frames is answered.
    pub fn newest_wins(&self) -> bool {
        self.config.back_pressure == pb::BackPressure::Newest as i32
    }

    /// The first answer of a stream: adapter, room, frame names and keyframe policy in effect.
    pub fn started(&self) -> pb::TrackResponse {
        let adapter = &self.served[0].adapter;
        let settings = self.tracker.settings();

        let started = pb::TrackStarted {
            adapter: Some(convert::adapter_revision(&self.served[0])),
            room: self
                .state
                .room
                .map(|room| convert::room_revision(&self.served[room])),
            frames: Some(self.frames.names.clone()),
            keyframes: Some(pb::KeyframePolicy {
                displacement: Some(settings.keyframe_displacement),
                frames: Some(settings.keyframe_frames),
            }),
            calibration_rooms: adapter.record.calibrated_on.len() as u32,
        };

        self.answer(pb::track_response::Answer::Started(started))
    }

    /// Answers a frame with a tracker update, or with a refusal if the frame is not valid. `waited`
    /// is the time since the frame's arrival.
    ///
    /// # Errors
    /// [`Error`] for a server error, which ends the stream.
    pub fn take(
        &mut self,
        frame: pb::TrackFrame,
        waited: Duration,
    ) -> Result<pb::TrackResponse, Error> {
        let begun = std::time::Instant::now();

        let pb::TrackFrame {
            timestamp_ns,
            sequence,
            with_token,
            ..
        } = frame;

        let answer = match self.observe(frame) {
            Ok(update) => {
                let best_camera = update
                    .best_camera
                    .map_or_else(String::new, |number| self.sensors.camera_name(number));
                let update = wire::update(&update, &self.frames, &self.served);

                // Measured from the frame's arrival, including the wait for a thread.
                let elapsed_ns =
                    u64::try_from((waited + begun.elapsed()).as_nanos()).unwrap_or(u64::MAX);

                pb::track_response::Answer::Update(pb::TrackUpdate {
                    timestamp_ns,
                    sequence,
                    elapsed_ns,
                    best_camera,
                    ..update
                })
            }
            Err(Refused::Frame(reason, message)) => {
                pb::track_response::Answer::Refusal(pb::TrackRefusal {
                    timestamp_ns,
                    sequence,
                    reason: reason as i32,
                    message,
                    frames: 1,
                })
            }
            Err(Refused::Server(error)) => return Err(error),
        };

        Ok(if with_token || self.is_token_due(sequence) {
            self.answer(answer)
        } else {
            without_token(answer)
        })
    }

    /// Whether `token_every` adds a token to the answer for this sequence number.
    fn is_token_due(&self, sequence: u64) -> bool {
        match self.config.token_every {
            None => true,
            Some(0) => false,
            Some(every) => sequence.is_multiple_of(u64::from(every)),
        }
    }

    /// One refusal for all frames that a newer frame superseded.
    pub fn superseded(&self, frames: Overtaken) -> pb::TrackResponse {
        let Overtaken {
            timestamp_ns,
            sequence,
            frames,
        } = frames;

        let answer = pb::track_response::Answer::Refusal(pb::TrackRefusal {
            timestamp_ns,
            sequence,
            reason: pb::TrackRefusalReason::Superseded as i32,
            message: "a newer frame arrived before this one was processed".to_owned(),
            frames,
        });

        if self.is_token_due(sequence) {
            self.answer(answer)
        } else {
            without_token(answer)
        }
    }

    /// Sets the camera's pose on the map, or answers with a refusal if the given pose is not valid.
    pub fn put(&mut self, given: pb::SetInitialPose) -> pb::TrackResponse {
        // An invalid pose is refused; the stream and its state continue unchanged.
        let answer = match self.place_of(given) {
            Ok(place) => {
                self.tracker.set_pose(&mut self.state, place);
                pb::track_response::Answer::Acknowledged(pb::TrackAcknowledged {})
            }
            Err(error) => pb::track_response::Answer::Refusal(pb::TrackRefusal {
                reason: pb::TrackRefusalReason::Pose as i32,
                message: error.to_string(),
                ..pb::TrackRefusal::default()
            }),
        };

        self.answer(answer)
    }

    fn place_of(&self, given: pb::SetInitialPose) -> Result<PoseWithCovariance, Error> {
        let field = "set_initial_pose.initial_pose";
        let given = given
            .initial_pose
            .ok_or_else(|| Error::invalid(field, "is required"))?;

        // The pose is in one room's world frame, so the room must be known.
        let room = self.state.room.ok_or_else(|| {
            Error::Precondition(format!(
                "{field}: the room is not known yet; name it in the configuration"
            ))
        })?;
        let name = self.served[room].navigator.room().id().to_string();

        self.frames
            .known_pose(given, &name)
            .map_err(|error| error.within(field))
    }

    /// Restarts tracking with the same configuration, but without its initial pose: the camera has
    /// moved since.
    pub fn reset(&mut self) -> pb::TrackResponse {
        self.state = self.tracker.start(None);
        self.camera.restart();
        self.last_pose = None;
        self.answer(pb::track_response::Answer::Acknowledged(
            pb::TrackAcknowledged {},
        ))
    }

    /// Encodes the view in `field`. Only an image can be detected as blank.
    fn encoded_view(&self, field: &str, view: Option<pb::View>) -> Result<EmbeddedView, Error> {
        let embedder = ViewEmbedder {
            adapter: &self.served[0].adapter,
            snapshot: &self.encoders,
            frames: StoredFrames::Refused,
            detector: None,
        };
        embedder.embed(field, view)
    }

    /// The source of the keypoints of images: the first of a room that this server can detect.
    fn keypoint_source(&self) -> Option<&KeypointSource> {
        let served = self.served.iter();
        let mut sources = served.filter_map(|served| Some(&served.keypoints.as_ref()?.source));
        sources.find(|source| self.encoders.keypoint_encoder(source).is_some())
    }

    /// Matches the keypoints of the stream's own image with its rooms.
    fn matched(&mut self, image: &ImageKeypoints) -> Result<StreamMatch, Error> {
        let Some(source) = self.keypoint_source().cloned() else {
            return Ok(StreamMatch::default());
        };
        let rooms = StreamRooms {
            served: &self.served,
            source: &source,
            room: self.state.room,
            predicted: self.last_pose,
        };
        self.camera.matched("frame.view.image", image, &rooms)
    }

    /// Encodes the view of the stream's own camera, with the keypoints of an image if a room has
    /// some and this server can detect them.
    fn encoded_own_view(&self, view: Option<pb::View>) -> Result<EmbeddedView, Error> {
        let source = self.keypoint_source();
        let embedder = ViewEmbedder {
            adapter: &self.served[0].adapter,
            snapshot: &self.encoders,
            frames: StoredFrames::Refused,
            detector: source.and_then(|source| self.encoders.keypoint_encoder(source)),
        };
        embedder.embed("frame.view", view)
    }

    /// Encodes the views of a frame's other cameras.
    fn encoded_other_views(&self, views: Vec<pb::OtherView>) -> Result<Vec<OtherView>, Error> {
        let mut seen: Vec<OtherView> = Vec::with_capacity(views.len());
        for (number, given) in views.into_iter().enumerate() {
            let field = format!("frame.other_views[{number}]");
            let camera = self
                .sensors
                .other_camera(&given.camera)
                .map_err(|error| error.within(&field))?;
            if seen.iter().any(|other| other.camera == camera.number) {
                return Err(Error::invalid(
                    format!("{field}.camera"),
                    "is the same camera twice",
                ));
            }

            let EmbeddedView {
                latent,
                feature,
                is_blank,
                keypoints: _,
            } = self.encoded_view(&format!("{field}.view"), given.view)?;
            seen.push(OtherView {
                camera: camera.number,
                camera_from_other: camera.camera_from_other,
                latent,
                feature,
                is_blank,
            });
        }

        Ok(seen)
    }

    fn observe(&mut self, frame: pb::TrackFrame) -> Result<Update, Refused> {
        use pb::TrackRefusalReason as Reason;

        let pb::TrackFrame {
            timestamp_ns,
            sequence,
            view,
            with_token: _,
            odometry,
            gravity,
            other_views,
        } = frame;

        let refused = |reason: Reason| {
            move |error: Error| match error {
                Error::Invalid { .. } | Error::Precondition(_) => {
                    Refused::Frame(reason, error.to_string())
                }
                // Any other error is the server's and ends the stream.
                other => Refused::Server(other),
            }
        };

        let EmbeddedView {
            latent,
            feature,
            is_blank,
            keypoints,
        } = self.encoded_own_view(view).map_err(refused(Reason::View))?;
        let StreamMatch { pose, contradicted } = match keypoints {
            Some(image) if !is_blank => self.matched(&image).map_err(refused(Reason::View))?,
            _ => StreamMatch::default(),
        };
        let other_views = self
            .encoded_other_views(other_views)
            .map_err(refused(Reason::View))?;
        let measured = odometry
            .map(|given| self.frames.measured(given))
            .transpose()
            .map_err(|error| refused(Reason::Odometry)(error.within("frame.odometry")))?;
        let gravity = gravity
            .map(|given| self.sensors.gravity(&given))
            .transpose()
            .map_err(|error| refused(Reason::Gravity)(error.within("frame.gravity")))?;

        let observation = Observation {
            time_ns: timestamp_ns,
            sequence,
            latent,
            feature,
            matched: pose,
            is_blank,
            measured,
            gravity,
            other_views,
        };

        // The tracker refuses late and duplicate frames. A refused frame does not change the state.
        let update = self.tracker.observe(&mut self.state, &observation);
        let mut update = update.map_err(|refusal| {
            let reason = match &refusal {
                Refusal::Late { .. } => Reason::Late,
                Refusal::Duplicate { .. } => Reason::Duplicate,
                Refusal::View(_) => Reason::View,
            };
            Refused::Frame(reason, refusal.to_string())
        })?;

        let tracked = update
            .map_pose
            .filter(|_| update.status == Status::Tracking);
        self.last_pose = tracked.map(|tracked| tracked.pose);
        if let Some(why) = contradicted {
            update.reason = format!("{}; keypoints are not used: {why}", update.reason);
        }
        Ok(update)
    }

    fn answer(&self, answer: pb::track_response::Answer) -> pb::TrackResponse {
        // The token carries the whole state, so that the stream can resume after a restart or on
        // another server.
        let sealed = Sealed::new(&self.config, &self.state, &self.served);
        pb::TrackResponse {
            answer: Some(answer),
            resume_token: self.key.seal(&sealed.to_bytes()),
        }
    }
}

fn without_token(answer: pb::track_response::Answer) -> pb::TrackResponse {
    pb::TrackResponse {
        answer: Some(answer),
        resume_token: Vec::new(),
    }
}

/// Reason for a frame without an update.
enum Refused {
    /// The frame is refused; the stream goes on.
    Frame(pb::TrackRefusalReason, String),
    /// The server is at fault; the stream ends.
    Server(Error),
}
