//! One Track stream: its configuration, its rooms, the state of its tracker, and the answers to its
//! messages.

use std::sync::Arc;
use std::time::Duration;

use ndarray::Array1;

use super::super::Error;
use super::super::convert;
use super::super::relocalization::maps;
use super::super::snapshot::{ServedNavigator, Snapshot};
use super::super::status::view_error;
use super::Overtaken;
use super::configuration::{StreamFrames, back_pressure, rooms, settings};
use super::sealed::Sealed;
use super::sensors::Sensors;
use super::token::TokenKey;
use super::wire;
use seese3_client::proto::v1 as pb;
use seese3_core::navigation::Source;
use seese3_robot::tracking::{
    Observation, OtherView, PoseWithCovariance, Refusal, State, Tracker, Update, View,
};

const FIELD: &str = "config";

/// A configured stream and the state of its tracker. The server keeps it only while the stream is
/// open; every answer carries it as a resume token.
pub struct Session {
    /// What encodes images. The rooms of the snapshot are not held: a stream may last for days, and
    /// would keep every room in memory that was replaced since.
    encoders: Snapshot,
    served: Vec<Arc<ServedNavigator>>,
    tracker: Tracker,
    config: pb::TrackConfig,
    frames: StreamFrames,
    sensors: Sensors,
    state: State,
    key: TokenKey,
}

impl Session {
    /// Opens a stream from its configuration, or resumes the one whose token the configuration
    /// holds.
    ///
    /// # Errors
    /// [`Error`], naming the field: the configuration or the token is not valid, or this server has
    /// other rooms or another adapter than the one that sealed the token.
    pub fn open(
        snapshot: &Arc<Snapshot>,
        config: pb::TrackConfig,
        key: &TokenKey,
    ) -> Result<Self, Error> {
        if config.resume_token.is_empty() {
            return Self::configured(snapshot, config, key).map_err(|error| error.within(FIELD));
        }

        let field = format!("{FIELD}.resume_token");

        // A token contains the configuration of its stream, so any other field could only
        // contradict it.
        let alone = pb::TrackConfig {
            resume_token: config.resume_token.clone(),
            ..pb::TrackConfig::default()
        };

        if config != alone {
            return Err(Error::invalid(
                field,
                "brings its own configuration: every other field must be empty",
            ));
        }

        // The seal is genuine from here on, so a token that does not decode is an error of this
        // server.
        let sealed = Sealed::from_bytes(key.open(&field, &config.resume_token)?)?;
        let config = sealed.config()?;

        let mut session = Self::configured(snapshot, config, key).map_err(|error| match error {
            Error::NotFound { name, .. } => {
                Error::Precondition(format!("{field}: '{name}' is not served here"))
            }
            other => other,
        })?;

        // The state is made of latents and poses, which mean nothing under another adapter or in
        // another room.
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

    /// Whether the state's latents have the width of this adapter and its room indices exist here.
    /// The rooms' content should guarantee it; without this check a state that does not fit would
    /// be a panic in the tracker.
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
        // Everything is checked before the stream starts: rooms and adapter, maps, settings,
        // frame names, and the initial pose.
        let served = rooms(snapshot, &config)?;
        let adapter = &served[0].adapter;
        let maps = maps(&served)?;
        let settings = settings(&config, &adapter.adapter)?;

        let frames = StreamFrames::of(&config)?;
        let sensors = Sensors::of(&config, &frames)?;
        back_pressure(config.back_pressure)?;

        // A pose only has a meaning in the world of a room, so the room must be known as well.
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

        // Without anchors nothing ever finds the camera on the map, so dead reckoning needs a
        // pose to begin from.
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
            state,
            key: key.clone(),
        })
    }

    /// Whether only the newest of the waiting frames is answered.
    pub fn newest_wins(&self) -> bool {
        self.config.back_pressure == pb::BackPressure::Newest as i32
    }

    /// The first answer of a stream: which adapter, room, frame names and keyframe policy are in
    /// effect.
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

    /// Answers one frame with an update of the tracker, or with a refusal if the frame itself is at
    /// fault. `waited` is the time since the frame's arrival.
    ///
    /// # Errors
    /// [`Error`] if the server is at fault; the stream then ends.
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

                // Counted from the frame's arrival, so that the wait for a thread is included.
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

    /// Whether the answer to a frame of this number brings a token that it did not ask for.
    fn is_token_due(&self, sequence: u64) -> bool {
        match self.config.token_every {
            None => true,
            Some(0) => false,
            Some(every) => sequence.is_multiple_of(u64::from(every)),
        }
    }

    /// One refusal for all the frames that a newer one overtook.
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
            message: "a newer frame came before this one's turn".to_owned(),
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
        // A bad pose ends neither the stream nor the tracking: the caller gets a refusal and the
        // state stays as it was.
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

        // A pose is relative to the world of one room. As long as several rooms are possible it
        // has no meaning.
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

    /// Starts tracking anew with the same configuration. The configured initial pose is not used
    /// again, because the camera has moved since.
    pub fn reset(&mut self) -> pb::TrackResponse {
        self.state = self.tracker.start(None);
        self.answer(pb::track_response::Answer::Acknowledged(
            pb::TrackAcknowledged {},
        ))
    }

    /// What a view in this field shows, and whether its image is blank, which nobody can tell of a
    /// feature.
    fn seen(&self, field: &str, view: Option<pb::View>) -> Result<SeenView, Error> {
        let adapter = &self.served[0].adapter;
        let (view, is_blank) = match view {
            Some(pb::View {
                view: Some(pb::view::View::Image(image)),
            }) => {
                let field = format!("{field}.image");
                let encoder = self.encoders.image_encoder(adapter)?;
                let pixels = encoder.decoded(&field, &image)?;
                let is_blank = pixels.is_blank();
                (View::Feature(encoder.feature_of(&field, pixels)?), is_blank)
            }
            view => match convert::source(field, view, adapter, &self.encoders)? {
                Source::Feature(feature) => (View::Feature(feature), false),
                Source::Latent(latent) => (View::Latent(latent), false),
                Source::Frame(_) => {
                    return Err(Error::invalid(
                        format!("{field}.frame_id"),
                        "is a stored frame; give a feature, a latent or an image of the camera",
                    ));
                }
            },
        };

        let latent = view
            .latent(&adapter.adapter)
            .map_err(|error| view_error(&error).within(field))?;
        let feature = match view {
            View::Feature(feature) => Some(feature),
            View::Latent(_) => None,
        };
        Ok(SeenView {
            latent,
            feature,
            is_blank,
        })
    }

    /// What the other cameras of a frame see.
    fn seen_beside(&self, views: Vec<pb::OtherView>) -> Result<Vec<OtherView>, Error> {
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

            let SeenView {
                latent,
                feature,
                is_blank,
            } = self.seen(&format!("{field}.view"), given.view)?;
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
                // What is not the frame's fault is the server's, and ends the stream.
                other => Refused::Server(other),
            }
        };

        let SeenView {
            latent,
            feature,
            is_blank,
        } = self
            .seen("frame.view", view)
            .map_err(refused(Reason::View))?;
        let other_views = self
            .seen_beside(other_views)
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
            is_blank,
            measured,
            gravity,
            other_views,
        };

        // Late and duplicate frames are refused too. A refused frame leaves the state as it was.
        self.tracker
            .observe(&mut self.state, &observation)
            .map_err(|refusal| {
                let reason = match &refusal {
                    Refusal::Late { .. } => Reason::Late,
                    Refusal::Duplicate { .. } => Reason::Duplicate,
                    Refusal::View(_) => Reason::View,
                };
                Refused::Frame(reason, refusal.to_string())
            })
    }

    fn answer(&self, answer: pb::track_response::Answer) -> pb::TrackResponse {
        // The token carries the whole state, so that the stream can go on from it after a restart
        // or on another server.
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

/// What a camera sees.
struct SeenView {
    latent: Array1<f64>,
    feature: Option<Vec<f32>>,
    is_blank: bool,
}

/// Why a frame gets no update.
enum Refused {
    /// The frame is refused; the stream goes on.
    Frame(pb::TrackRefusalReason, String),
    /// The server is at fault; the stream ends.
    Server(Error),
}
