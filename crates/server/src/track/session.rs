//! A Track session: configuration, rooms, filter state, and the answers to messages.

use std::sync::Arc;
use std::time::Duration;

use super::super::Error;
use super::super::convert;
use super::super::cost::brief_or_short;
use super::super::embedding::{EmbeddedView, ImageKeypoints, StoredFrames, ViewEmbedder};
use super::super::relocalization::maps;
use super::super::snapshot::Snapshot;
use super::super::stated_revisions::StatesRevisions;
use super::super::workers::Lane;
use super::Overtaken;
use super::configuration::{StreamFrames, back_pressure, is_fused, parameters, rooms};
use super::depth::DepthImage;
use super::engine::Engine;
use super::inertial::{Inertial, check_exposure};
use super::keypoints::{StreamRooms, stream_camera};
use super::rooms::{TrackedRoom, rooms_with_keypoints};
use super::sealed::Sealed;
use super::sensors::Sensors;
use super::token::TokenKey;
use super::wire;
use pb::TrackRefusalReason as Reason;
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::Pose;
use seese3_core::keypoints::{KeypointSource, Keypoints};
use seese3_robot::front_end::{FrontEnd, ImageReading, OtherCamera, StreamView};
use seese3_robot::localization::NotLocated;
use seese3_robot::pose_filter::{FilterParameters, ViewObservation};
use seese3_robot::tracking::{MeasuredPose, PoseWithCovariance, Refusal, Status, Update};
use seese3_robot::visual_odometry::OdometryParameters;

const FIELD: &str = "config";

/// A configured stream and its filter's state. The server keeps it only while the stream is open; a
/// resume token in the answers carries it.
pub struct Session {
    /// Snapshot without rooms, for the image encoders. A stream may last for days and must not keep
    /// replaced rooms in memory.
    encoders: Snapshot,
    rooms: Vec<TrackedRoom>,
    engine: Engine,
    config: pb::TrackConfig,
    frames: StreamFrames,
    sensors: Sensors,
    inertial: Option<Inertial>,
    front_end: FrontEnd,
    /// The map pose of the last view, `world_from_camera`, if the view was located while TRACKING.
    last_pose: Option<Pose>,
    /// Whether the last status was LOST.
    is_lost: bool,
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
            return Self::configured(snapshot, config, key, false)
                .map_err(|error| error.within(FIELD));
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

        let mut session = Self::configured(snapshot, config, key, sealed.is_of_keypoints())
            .map_err(|error| match error {
                Error::NotFound { missing, .. } => {
                    let problem = format!("{field}: '{}' is not served here", missing.name);
                    Error::Precondition(problem)
                }
                other => other,
            })?;

        // The state's poses are valid only in the same rooms, and its room only under the same
        // adapter.
        let state = sealed.opened_in(&session.rooms).ok_or_else(|| {
            let problem = "this server has another room or adapter than the token; start anew";
            Error::Precondition(format!("{field}: {problem}"))
        })?;

        session.engine.resume(&state);
        Ok(session)
    }

    fn configured(
        snapshot: &Arc<Snapshot>,
        config: pb::TrackConfig,
        key: &TokenKey,
        was_of_keypoints: bool,
    ) -> Result<Self, Error> {
        // Validate everything before the stream starts.
        let snapshot = &snapshot.with_revisions(&config.stated_revisions()?)?;
        let frames = StreamFrames::of(&config)?;
        let sensors = Sensors::of(&config, &frames)?;
        let inertial = Inertial::of(&config, &frames, sensors.gravity_in_map())?;
        let camera = stream_camera(&config)?;
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
        if !is_fused(config.fusion)? && begins.is_none() {
            return Err(Error::invalid(
                "fusion",
                "FUSION_NONE needs room and initial_pose; give both, or use FUSION_ANCHORS",
            ));
        }

        // Invalid settings are refused before any room is loaded.
        parameters(&config, FilterParameters::default())?;
        let (rooms, maps) = match rooms_with_keypoints(snapshot, &config, was_of_keypoints)? {
            Some(_) if !config.other_cameras.is_empty() => {
                let problem = "needs an adapter that can track in these rooms; leave it out";
                return Err(Error::invalid("other_cameras", problem));
            }
            Some(rooms) => (rooms, None),
            None => {
                let served = rooms(snapshot, &config)?;
                let maps = maps(&served)?.into_iter().cloned().collect();
                let rooms = served.into_iter().map(TrackedRoom::under).collect();
                (rooms, Some(maps))
            }
        };
        // A stream that has to find its room takes the default parameters.
        let fitted = match &rooms[..] {
            [only] => only.tracking.unwrap_or_default(),
            _ => FilterParameters::default(),
        };
        let parameters = parameters(&config, fitted)?;
        let engine = Engine::new(&rooms, maps, parameters, begins.as_ref())?;

        let encoders = snapshot.without_rooms();
        let has_keypoints = keypoint_source(&rooms, &encoders).is_some();
        let odometry = has_keypoints.then(OdometryParameters::default);
        Ok(Self {
            encoders,
            rooms,
            engine,
            config,
            frames,
            sensors,
            inertial,
            front_end: FrontEnd::new(camera, odometry),
            last_pose: None,
            is_lost: false,
            key: key.clone(),
        })
    }

    /// The stream's room; `None` while it is unknown.
    fn room(&self) -> Option<&TrackedRoom> {
        Some(&self.rooms[self.engine.room()?])
    }

    /// The lane of a frame without images.
    pub fn lane(&self) -> Lane {
        let rooms = match self.room_to_match() {
            Some(room) => &self.rooms[room..=room],
            None => &self.rooms,
        };
        brief_or_short(rooms.iter().map(TrackedRoom::products).sum())
    }

    /// Whether only the newest of the waiting frames is answered.
    pub fn newest_wins(&self) -> bool {
        self.config.back_pressure == pb::BackPressure::Newest as i32
    }

    /// The first answer of a stream: adapter, room, frame names and keyframe policy in effect.
    pub fn started(&self) -> pb::TrackResponse {
        let parameters = self.engine.filter.parameters();
        let motion_norm = parameters.keyframe_displacement;
        let keyframes = pb::KeyframePolicy {
            motion_norm: motion_norm.is_finite().then_some(motion_norm),
            sequence_interval: Some(parameters.keyframe_frames),
        };

        let served = self.rooms[0].served.as_ref();
        let calibrated_on = served.map_or(0, |served| served.adapter.record.calibrated_on.len());
        let started = pb::TrackStarted {
            adapter: served.map(|served| convert::adapter_revision(served)),
            room: self.room().map(|room| room.revision.clone()),
            frame_names: Some(self.frames.names.clone()),
            keyframes: Some(keyframes),
            calibration_rooms: calibrated_on as u32,
            has_visual_odometry: self.front_end.has_odometry(),
        };

        self.answer(pb::track_response::Answer::Started(started))
    }

    /// Answers a frame with an update, or with a refusal if the frame is not valid. `waited`
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
            sequence_number,
            with_token,
            ..
        } = frame;

        let answer = match self.observe(frame) {
            Ok(update) => {
                let camera = update
                    .best_match
                    .and_then(|best| best.camera)
                    .map_or_else(String::new, |number| self.sensors.camera_name(number));
                let mut update = wire::update(&update, &self.frames, &self.rooms);
                if let Some(found) = &mut update.r#match {
                    found.camera_name = camera;
                }

                // Measured from the frame's arrival, including the wait for a thread.
                let elapsed_ns =
                    u64::try_from((waited + begun.elapsed()).as_nanos()).unwrap_or(u64::MAX);

                pb::track_response::Answer::Update(pb::TrackUpdate {
                    timestamp_ns,
                    sequence_number,
                    timing: Some(pb::TrackTiming { elapsed_ns }),
                    ..update
                })
            }
            Err(Refused::Frame(reason, message)) => {
                pb::track_response::Answer::Refusal(pb::TrackRefusal {
                    timestamp_ns,
                    sequence_number,
                    reason: reason as i32,
                    message,
                    frame_count: 1,
                })
            }
            Err(Refused::Server(error)) => return Err(error),
        };

        Ok(if with_token || self.is_token_due(sequence_number) {
            self.answer(answer)
        } else {
            without_token(answer)
        })
    }

    /// Whether `token_every` adds a token to the answer for this sequence number.
    fn is_token_due(&self, sequence_number: u64) -> bool {
        match self.config.token_every {
            None => true,
            Some(0) => false,
            Some(every) => sequence_number.is_multiple_of(u64::from(every)),
        }
    }

    /// One refusal for all frames that a newer frame superseded.
    pub fn superseded(&self, frames: Overtaken) -> pb::TrackResponse {
        let Overtaken {
            timestamp_ns,
            sequence_number,
            frames,
        } = frames;

        let answer = pb::track_response::Answer::Refusal(pb::TrackRefusal {
            timestamp_ns,
            sequence_number,
            reason: pb::TrackRefusalReason::Superseded as i32,
            message: "a newer frame arrived before this one was processed".to_owned(),
            frame_count: frames,
        });

        if self.is_token_due(sequence_number) {
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
                self.engine.set_pose(&place);
                self.last_pose = Some(place.pose);
                self.is_lost = false;
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

        // The pose is in one room's world frame, so the room must be known. A stream that is LOST
        // among several rooms has none.
        let is_known = !self.is_lost || self.rooms.len() == 1;
        let room = self.room().filter(|_| is_known).ok_or_else(|| {
            Error::Precondition(format!(
                "{field}: the room is not known yet; name it in the configuration"
            ))
        })?;
        let name = room.room.id().to_string();

        self.frames
            .known_pose(given, &name)
            .map_err(|error| error.within(field))
    }

    /// Restarts tracking with the same configuration, but without its initial pose: the camera has
    /// moved since.
    pub fn reset(&mut self) -> pb::TrackResponse {
        self.engine.reset();
        self.front_end.reset();
        if let Some(inertial) = &mut self.inertial {
            inertial.reset();
        }
        self.last_pose = None;
        self.is_lost = false;
        self.answer(pb::track_response::Answer::Acknowledged(
            pb::TrackAcknowledged {},
        ))
    }

    /// The room in which views are compared; `None` for all rooms. A stream that is LOST may have
    /// been carried to another room.
    fn room_to_match(&self) -> Option<usize> {
        self.engine.room().filter(|_| !self.is_lost)
    }

    /// Reads the keypoints of the stream's own image, with the depth image of its frame. `motion`
    /// is that since the last frame, if a sensor measures it.
    fn read(
        &mut self,
        image: &ImageKeypoints,
        depth: Option<&DepthImage>,
        time_ns: i64,
        motion: Option<Pose>,
    ) -> Result<ImageReading, Error> {
        let Some(source) = keypoint_source(&self.rooms, &self.encoders).cloned() else {
            return Ok(ImageReading::default());
        };
        let depths = depth.map(|depth| depth.of_keypoints(image));
        let depths = depths.transpose();
        let depths = depths.map_err(|error| error.within("frame.depth"))?;
        let room = self.room_to_match();
        let rooms = StreamRooms {
            rooms: &self.rooms,
            source: &source,
            room,
            predicted: self.last_pose,
            motion,
        };
        rooms.read(
            &mut self.front_end,
            image,
            &depths.unwrap_or_default(),
            time_ns,
        )
    }

    /// The depth image of a frame; `None` too if the stream has no visual odometry.
    fn depth(&self, frame: &pb::TrackFrame) -> Result<Option<DepthImage>, Error> {
        let Some(given) = &frame.depth else {
            return Ok(None);
        };
        let view = frame.view.as_ref().and_then(|view| view.view.as_ref());
        if !matches!(view, Some(pb::view::View::Image(_))) {
            return Err(Error::invalid("frame.depth", "needs an image in `view`"));
        }

        let source = keypoint_source(&self.rooms, &self.encoders);
        let encoder = source.and_then(|source| self.encoders.keypoint_encoder(source));
        let depth = encoder.map(|encoder| DepthImage::of(given, encoder.bounds()));
        depth
            .transpose()
            .map_err(|error| error.within("frame.depth"))
    }

    /// An embedder of images, features and latents for the stream's adapter, which also detects
    /// keypoints if `detects` and a room has some that this server can detect.
    fn embedder(&self, detects: bool) -> Result<ViewEmbedder<'_>, Error> {
        let source = keypoint_source(&self.rooms, &self.encoders).filter(|_| detects);
        Ok(ViewEmbedder {
            adapter: self.rooms[0].adapter().ok_or(Error::Internal)?,
            snapshot: &self.encoders,
            frames: StoredFrames::Refused,
            detector: source.and_then(|source| self.encoders.keypoint_encoder(source)),
        })
    }

    /// Adds the inertial samples of a frame; returns the middle of its exposure, if the stream has
    /// an inertial sensor.
    fn add_inertial(&mut self, frame: &pb::TrackFrame) -> Result<Option<i64>, Error> {
        match &mut self.inertial {
            Some(inertial) => {
                let middle_ns = inertial.middle_ns(frame)?;
                inertial.add(&frame.inertial_samples)?;
                Ok(Some(middle_ns))
            }
            None if frame.inertial_samples.is_empty() => {
                check_exposure(frame)?;
                Ok(None)
            }
            None => Err(Error::invalid(
                "inertial_samples",
                "need inertial_sensor in the configuration",
            )),
        }
    }

    /// Encodes the views of a frame's other cameras.
    fn encoded_other_views(
        &self,
        views: Vec<pb::OtherView>,
    ) -> Result<Vec<(OtherCamera, EmbeddedView)>, Error> {
        let mut seen: Vec<(OtherCamera, EmbeddedView)> = Vec::with_capacity(views.len());
        let Engine { filter, state, .. } = &self.engine;
        let velocity = filter.velocity(state);
        for (number, given) in views.into_iter().enumerate() {
            let field = format!("frame.other_views[{number}]");
            let camera = self
                .sensors
                .other_camera(&given.camera_name, velocity)
                .map_err(|error| error.within(&field))?;
            if seen.iter().any(|(other, _)| other.number == camera.number) {
                return Err(Error::invalid(
                    format!("{field}.camera_name"),
                    "is the same camera twice",
                ));
            }

            let embedder = self.embedder(false)?;
            let view = embedder.embed(&format!("{field}.view"), given.view)?;
            seen.push((camera, view));
        }

        Ok(seen)
    }

    fn observe(&mut self, frame: pb::TrackFrame) -> Result<Update, Refused> {
        // Inertial samples hold whatever becomes of their frame.
        let middle_ns = self.add_inertial(&frame);
        // A refused frame must not change what later views are compared with.
        let Engine { filter, state, .. } = &self.engine;
        filter.check(state, frame.timestamp_ns, frame.sequence_number)?;

        let measured = self.measured(frame.odometry.clone())?;
        let gravity = frame
            .gravity
            .as_ref()
            .map(|given| self.sensors.gravity(given))
            .transpose()
            .map_err(|error| refused(Reason::Gravity)(error.within("frame.gravity")))?;
        let middle_ns =
            middle_ns.map_err(|error| refused(Reason::Inertial)(error.within("frame")))?;
        let inertia = self.inertial.as_ref().zip(middle_ns);
        let inertia = inertia.and_then(|(inertial, at_ns)| inertial.motion_to(at_ns));
        let sensed = ViewObservation {
            measured,
            gravity,
            inertia,
            ..ViewObservation::empty(frame.timestamp_ns, frame.sequence_number)
        };
        let Engine { filter, state, .. } = &self.engine;
        let motion = filter.sensed_motion(state, &sensed);
        let (observed, contradicted) = match self.engine.retrieval {
            Some(_) => self.retrieved(frame, motion),
            None => self
                .detected(frame, motion)
                .map(|observed| (observed, None)),
        }
        .map_err(refused(Reason::View))?;

        let observation = ViewObservation {
            measured: sensed.measured,
            gravity: sensed.gravity,
            inertia: sensed.inertia,
            ..observed
        };

        let Engine { filter, state, .. } = &mut self.engine;
        let before = state.odom.pose;
        let update = filter.observe(state, &observation)?;
        self.front_end.assume(&before.inv_mul(&state.odom.pose));
        if let Some((inertial, at_ns)) = self.inertial.as_mut().zip(middle_ns) {
            inertial.accept(at_ns);
        }
        let tracked = update
            .map_pose
            .filter(|_| update.status == Status::Tracking && update.match_used);
        self.last_pose = tracked.map(|tracked| tracked.pose);
        self.is_lost = update.status == Status::Lost;
        Ok(match contradicted {
            Some(why) => Update {
                reason: format!("{}; keypoints are not used: {why}", update.reason),
                ..update
            },
            None => update,
        })
    }

    /// The observation of a frame by the most similar mapped frames, and by the keypoints of an
    /// image. Also returns the camera that the keypoints contradict.
    fn retrieved(
        &mut self,
        frame: pb::TrackFrame,
        motion: Option<Pose>,
    ) -> Result<(ViewObservation, Option<NotLocated>), Error> {
        let depth = self.depth(&frame)?;
        let own = self.embedder(true)?.embed("frame.view", frame.view)?;
        let others = self.encoded_other_views(frame.other_views)?;
        let image = match &own.keypoints {
            Some(image) if !own.is_blank => {
                self.read(image, depth.as_ref(), frame.timestamp_ns, motion)?
            }
            _ => {
                self.front_end.skip(frame.timestamp_ns);
                ImageReading::default()
            }
        };

        let cameras = std::iter::once((None, &own))
            .chain(others.iter().map(|(camera, view)| (Some(*camera), view)));
        let views: Vec<StreamView<'_>> = cameras
            .map(|(other, view)| StreamView {
                other,
                latent: view.latent.view(),
                feature: view.feature.as_deref(),
                is_blank: view.is_blank,
            })
            .collect();

        let room = self.room_to_match();
        let retrieval = self.engine.retrieval.as_mut().ok_or(Error::Internal)?;
        let found = retrieval.front_end.read(&views, &retrieval.maps, room);
        let contradicted = image.why_not.filter(NotLocated::is_of_camera);
        let observed = found.observation(&image, frame.timestamp_ns, frame.sequence_number);
        Ok((observed, contradicted))
    }

    /// The observation of a frame by the keypoints of its image alone.
    fn detected(
        &mut self,
        frame: pb::TrackFrame,
        motion: Option<Pose>,
    ) -> Result<ViewObservation, Error> {
        if !frame.other_views.is_empty() {
            let problem = "needs an adapter that can track in this room; leave it out";
            return Err(Error::invalid("frame.other_views", problem));
        }
        let depth = self.depth(&frame)?;
        let image = self.keypoints_of(frame.view)?;
        let read = self.read(&image, depth.as_ref(), frame.timestamp_ns, motion)?;
        let fingerprint = image.fingerprint();
        Ok(read.observation(frame.timestamp_ns, frame.sequence_number, fingerprint))
    }

    /// The camera pose of another sensor's odometry.
    fn measured(
        &self,
        odometry: Option<pb::MeasuredOdometry>,
    ) -> Result<Option<MeasuredPose>, Refused> {
        odometry
            .map(|given| self.frames.measured(given))
            .transpose()
            .map_err(|error| refused(Reason::Odometry)(error.within("frame.odometry")))
    }

    /// The keypoints of an image, for a stream without an adapter.
    fn keypoints_of(&self, view: Option<pb::View>) -> Result<ImageKeypoints, Error> {
        let Some(pb::view::View::Image(image)) = view.and_then(|view| view.view) else {
            return Err(Error::invalid(
                "frame.view",
                "must be an image: the stream has no adapter for features and latents",
            ));
        };
        let encoder = keypoint_source(&self.rooms, &self.encoders)
            .and_then(|source| self.encoders.keypoint_encoder(source))
            .ok_or(Error::Internal)?;
        let pixels = encoder.decoded("frame.view.image", &image)?;
        let size = [pixels.width, pixels.height];
        let keypoints = if pixels.is_blank() {
            Keypoints::default()
        } else {
            let frame = encoder.frame_of("frame.view.image", pixels)?;
            frame.keypoints.unwrap_or_default()
        };
        Ok(ImageKeypoints { keypoints, size })
    }

    fn answer(&self, answer: pb::track_response::Answer) -> pb::TrackResponse {
        // The token carries pose, velocity and times, so that the stream can resume after a restart
        // or on another server.
        let sealed = Sealed::new(&self.config, self.engine.state.saved(), &self.rooms);
        pb::TrackResponse {
            answer: Some(answer),
            resume_token: self.key.seal(&sealed.to_bytes()),
        }
    }
}

/// The source of the keypoints of images: the first of a room that this server can detect.
fn keypoint_source<'a>(
    rooms: &'a [TrackedRoom],
    encoders: &Snapshot,
) -> Option<&'a KeypointSource> {
    let mut sources = rooms
        .iter()
        .filter_map(|room| Some(&room.keypoints.as_ref()?.source));
    sources.find(|source| encoders.keypoint_encoder(source).is_some())
}

fn without_token(answer: pb::track_response::Answer) -> pb::TrackResponse {
    pb::TrackResponse {
        answer: Some(answer),
        resume_token: Vec::new(),
    }
}

/// A frame that is refused for `reason`, unless the server is at fault.
fn refused(reason: Reason) -> impl Fn(Error) -> Refused {
    move |error: Error| match error {
        Error::Invalid { .. } | Error::Precondition(_) => Refused::Frame(reason, error.to_string()),
        // Any other error is the server's and ends the stream.
        other => Refused::Server(other),
    }
}

/// Reason for a frame without an update.
enum Refused {
    /// The frame is refused; the stream goes on.
    Frame(pb::TrackRefusalReason, String),
    /// The server is at fault; the stream ends.
    Server(Error),
}

/// The filter refuses late and duplicate frames. A refused frame does not change the state.
impl From<Refusal> for Refused {
    fn from(refusal: Refusal) -> Self {
        let reason = match &refusal {
            Refusal::Late { .. } => Reason::Late,
            Refusal::Duplicate { .. } => Reason::Duplicate,
        };
        Self::Frame(reason, refusal.to_string())
    }
}
