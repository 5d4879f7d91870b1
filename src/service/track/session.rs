//! One stream: its configuration, its rooms, and what it says of a frame.

use std::sync::Arc;
use std::time::Duration;

use prost::Message;
use sha2::{Digest, Sha256};

use super::super::Error;
use super::super::convert;
use super::super::relocalization::{maps, rooms_to_track_in};
use super::super::snapshot::{ServedNavigator, Snapshot};
use super::super::status::view_error;
use super::Overtaken;
use super::sealed::{Sealed, SealedState};
use super::token::TokenKey;
use super::wire;
use crate::navigation::Source;
use crate::odometry::{Belief, Observation, Refusal, Settings, State, Tracker, View};
use crate::proto::v1 as pb;

/// How surely a pose is known whose sender does not say, metres and radians.
const KNOWN: f64 = 0.1;
/// The surest and the least sure that a pose may be called.
const DEVIATIONS: std::ops::RangeInclusive<f64> = 1e-6..=1e3;
/// What a stream's frames are called if it does not say.
const FRAME_NAMES: [&str; 3] = ["map", "odom", "camera"];
/// The longest name of a frame.
const LONGEST_NAME: usize = 100;
const FIELD: &str = "config";

/// A configured stream.
pub struct Session {
    snapshot: Arc<Snapshot>,
    served: Vec<Arc<ServedNavigator>>,
    tracker: Tracker,
    config: pb::TrackConfig,
    names: pb::FrameNames,
    state: State,
    key: TokenKey,
    digest: Vec<u8>,
}

impl Session {
    /// A stream as it is configured, or as a token says.
    ///
    /// # Errors
    /// [`Error`], naming the field.
    pub fn open(
        snapshot: &Arc<Snapshot>,
        config: pb::TrackConfig,
        key: &TokenKey,
    ) -> Result<Self, Error> {
        if config.resume_token.is_empty() {
            return Self::configured(snapshot, config, key).map_err(|error| error.within(FIELD));
        }

        let field = format!("{FIELD}.resume_token");

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

        let sealed =
            Sealed::decode(key.open(&field, &config.resume_token)?).map_err(|_| Error::Internal)?;
        let (config, state) = sealed.config.zip(sealed.state).ok_or(Error::Internal)?;

        let mut session = Self::configured(snapshot, config, key).map_err(|error| match error {
            Error::NotFound { name, .. } => {
                Error::Precondition(format!("{field}: '{name}' is not served here"))
            }
            other => other,
        })?;

        if session.digest != sealed.served {
            let problem =
                "the adapter or the rooms are others here than where the token is from; start anew";
            return Err(Error::Precondition(format!("{field}: {problem}")));
        }

        session.state = state.state()?;

        if !session.fits() {
            return Err(Error::Precondition(format!(
                "{field}: was sealed by a server of another version; start anew"
            )));
        }

        Ok(session)
    }

    /// Whether the state is one of these rooms and this adapter. The hash says so; a state that is
    /// not would be a panic.
    fn fits(&self) -> bool {
        let adapter = &self.served[0].adapter.adapter;
        let rooms = self.served.len();

        let State {
            room,
            last,
            keyframe,
            recent,
            candidate,
            ..
        } = &self.state;

        let latents = [
            last.as_ref().map(|last| &last.latent),
            keyframe.as_ref().map(|keyframe| &keyframe.latent),
            candidate.as_ref().map(|candidate| &candidate.latent),
        ];

        let named = [*room, candidate.as_ref().map(|candidate| candidate.room)];
        latents
            .into_iter()
            .flatten()
            .all(|latent| adapter.check_latent(latent).is_ok())
            && recent
                .iter()
                .all(|row| row.len() == adapter.coordinate_count())
            && named.into_iter().flatten().all(|room| room < rooms)
    }

    fn configured(
        snapshot: &Arc<Snapshot>,
        config: pb::TrackConfig,
        key: &TokenKey,
    ) -> Result<Self, Error> {
        let served = rooms(snapshot, &config)?;
        let adapter = &served[0].adapter;
        let maps = maps(&served)?;
        let settings = settings(&config, &adapter.adapter)?;

        let names = frame_names(config.frames.clone().unwrap_or_default())?;
        back_pressure(config.back_pressure)?;

        let begins = match config.initial_pose.clone() {
            None => None,
            Some(_) if config.room.is_empty() => {
                return Err(Error::invalid("initial_pose", "needs the room it is in"));
            }
            Some(given) => Some(
                known_pose(given, &config.room, &names)
                    .map_err(|error| error.within("initial_pose"))?,
            ),
        };

        if !settings.fuse && begins.is_none() {
            return Err(Error::invalid(
                "fusion",
                "of nothing finds no place: give room and initial_pose, or let places correct",
            ));
        }

        let tracker =
            Tracker::new(maps, settings).map_err(|error| Error::Precondition(error.to_string()))?;
        let state = tracker.start(begins);
        let digest = digest(&served);

        let snapshot = snapshot.clone();
        Ok(Self {
            snapshot,
            served,
            tracker,
            config,
            names,
            state,
            key: key.clone(),
            digest,
        })
    }

    /// Whether only the newest frame that waits is to be answered.
    pub fn newest_wins(&self) -> bool {
        self.config.back_pressure == pb::BackPressure::Newest as i32
    }

    /// The first answer.
    pub fn started(&self) -> pb::TrackResponse {
        let adapter = &self.served[0].adapter;
        let settings = self.tracker.settings();

        let started = pb::TrackStarted {
            adapter: Some(convert::adapter_revision(&self.served[0])),
            room: self
                .state
                .room
                .map(|room| convert::room_revision(&self.served[room])),
            frames: Some(self.names.clone()),
            keyframes: Some(pb::KeyframePolicy {
                displacement: settings.keyframe_displacement,
                frames: settings.keyframe_frames,
            }),
            calibration_rooms: adapter.record.calibrated_on.len() as u32,
        };

        self.answer(pb::track_response::Answer::Started(started))
    }

    /// Takes a frame.
    ///
    /// # Errors
    /// What is not the frame's fault.
    pub fn take(
        &mut self,
        frame: pb::TrackFrame,
        waited: Duration,
    ) -> Result<pb::TrackResponse, Error> {
        let begun = std::time::Instant::now();

        let pb::TrackFrame {
            timestamp_ns,
            sequence,
            view,
        } = frame;

        let answer = match self.observe(timestamp_ns, sequence, view) {
            Ok(update) => {
                let update = wire::update(&update, &self.names, &self.served);
                let elapsed_ns =
                    u64::try_from((waited + begun.elapsed()).as_nanos()).unwrap_or(u64::MAX);

                pb::track_response::Answer::Update(pb::TrackUpdate {
                    timestamp_ns,
                    sequence,
                    elapsed_ns,
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

        Ok(self.answer(answer))
    }

    /// Frames that a newer one overtook: one answer for all of them.
    pub fn superseded(&self, frames: Overtaken) -> pb::TrackResponse {
        let Overtaken {
            timestamp_ns,
            sequence,
            frames,
        } = frames;

        self.answer(pb::track_response::Answer::Refusal(pb::TrackRefusal {
            timestamp_ns,
            sequence,
            reason: pb::TrackRefusalReason::Superseded as i32,
            message: "a newer frame came before this one's turn".to_owned(),
            frames,
        }))
    }

    /// Puts the camera somewhere, or refuses to.
    pub fn put(&mut self, given: pb::SetInitialPose) -> pb::TrackResponse {
        let answer = match self.place_of(given) {
            Ok(place) => {
                self.tracker.put(&mut self.state, place);
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

    fn place_of(&self, given: pb::SetInitialPose) -> Result<Belief, Error> {
        let field = "set_initial_pose.initial_pose";
        let given = given
            .initial_pose
            .ok_or_else(|| Error::invalid(field, "is required"))?;

        let room = self.state.room.ok_or_else(|| {
            Error::Precondition(format!(
                "{field}: the room is not known yet; name it in the configuration"
            ))
        })?;
        let name = self.served[room].navigator.room().id().to_string();

        known_pose(given, &name, &self.names).map_err(|error| error.within(field))
    }

    /// Forgets everything but the configuration; where the camera began is not where it is.
    pub fn reset(&mut self) -> pb::TrackResponse {
        self.state = self.tracker.start(None);
        self.answer(pb::track_response::Answer::Acknowledged(
            pb::TrackAcknowledged {},
        ))
    }

    fn observe(
        &mut self,
        time_ns: i64,
        sequence: u64,
        view: Option<pb::View>,
    ) -> Result<crate::odometry::Update, Refused> {
        use pb::TrackRefusalReason as Reason;

        let view_refused = |error: Error| match error {
            Error::Invalid { .. } | Error::Precondition(_) => {
                Refused::Frame(Reason::View, error.to_string())
            }
            other => Refused::Server(other),
        };

        let adapter = &self.served[0].adapter;
        let view = match convert::source("frame.view", view, adapter, &self.snapshot)
            .map_err(view_refused)?
        {
            Source::Feature(feature) => View::Feature(feature),
            Source::Latent(latent) => View::Latent(latent),
            Source::Frame(_) => {
                let error = Error::invalid(
                    "frame.view.frame_id",
                    "is a frame of a room, not what a camera sees",
                );
                return Err(view_refused(error));
            }
        };

        let latent = view
            .latent(&adapter.adapter)
            .map_err(|error| view_refused(view_error(&error).within("frame.view")))?;
        let observation = Observation {
            time_ns,
            sequence,
            latent,
        };

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
        let sealed = Sealed {
            config: Some(self.config.clone()),
            served: self.digest.clone(),
            state: Some(SealedState::from(&self.state)),
        };
        pb::TrackResponse {
            answer: Some(answer),
            resume_token: self.key.seal(&sealed.encode_to_vec()),
        }
    }
}

/// Why a frame has no update.
enum Refused {
    /// The frame is refused; the stream goes on.
    Frame(pb::TrackRefusalReason, String),
    /// The stream ends.
    Server(Error),
}

/// The rooms of a configuration, under one adapter; at least one.
fn rooms(
    snapshot: &Snapshot,
    config: &pb::TrackConfig,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    match (config.room.as_str(), config.rooms.as_slice()) {
        ("", rooms) => rooms_to_track_in(snapshot, rooms, &config.adapter),
        (room, []) => {
            rooms_to_track_in(snapshot, &[room.to_owned()], &config.adapter).map_err(|error| {
                match error {
                    Error::NotFound { ref field, .. } | Error::Invalid { ref field, .. }
                        if field.starts_with("rooms") =>
                    {
                        error.named("room")
                    }
                    other => other,
                }
            })
        }
        _ => Err(Error::invalid(
            "rooms",
            "are for a room that is not known; leave them or room empty",
        )),
    }
}

fn settings(
    config: &pb::TrackConfig,
    adapter: &crate::adapter::Adapter,
) -> Result<Settings, Error> {
    let plain = Settings::of(adapter);

    let pb::KeyframePolicy {
        displacement,
        frames,
    } = config.keyframes.unwrap_or_default();

    if !(displacement.is_finite() && displacement >= 0.0) {
        return Err(Error::invalid(
            "keyframes.displacement",
            "must be finite and not negative",
        ));
    }

    let fuse = match pb::Fusion::try_from(config.fusion) {
        Ok(pb::Fusion::Unspecified | pb::Fusion::Anchors) => true,
        Ok(pb::Fusion::None) => false,
        Err(_) => {
            return Err(Error::invalid(
                "fusion",
                format!("{} is no value of Fusion", config.fusion),
            ));
        }
    };

    Ok(Settings {
        keyframe_frames: if frames == 0 {
            plain.keyframe_frames
        } else {
            frames
        },
        keyframe_displacement: if displacement == 0.0 {
            plain.keyframe_displacement
        } else {
            displacement
        },
        fuse,
    })
}

fn back_pressure(given: i32) -> Result<(), Error> {
    match pb::BackPressure::try_from(given) {
        Ok(_) => Ok(()),
        Err(_) => Err(Error::invalid(
            "back_pressure",
            format!("{given} is no value of BackPressure"),
        )),
    }
}

fn frame_names(given: pb::FrameNames) -> Result<pb::FrameNames, Error> {
    let pb::FrameNames { map, odom, camera } = given;
    let mut names = [map, odom, camera];
    for (name, (plain, field)) in names
        .iter_mut()
        .zip(FRAME_NAMES.into_iter().zip(["map", "odom", "camera"]))
    {
        if name.is_empty() {
            *name = plain.to_owned();
        }
        if name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
            let problem = format!("is over {LONGEST_NAME} bytes long or has a control character");
            return Err(Error::invalid(format!("frames.{field}"), problem));
        }
    }

    if names[0] == names[1] || names[1] == names[2] || names[0] == names[2] {
        return Err(Error::invalid("frames", "must be three different names"));
    }

    let [map, odom, camera] = names;
    Ok(pb::FrameNames { map, odom, camera })
}

/// A pose in the room's world, which a stream also calls by its own name.
fn known_pose(given: pb::InitialPose, room: &str, names: &pb::FrameNames) -> Result<Belief, Error> {
    let pb::InitialPose {
        pose,
        translation_deviation_m,
        rotation_deviation_rad,
    } = given;
    let mut pose = pose.ok_or_else(|| Error::invalid("pose", "is required"))?;

    for (frame, name) in [
        (&mut pose.parent_frame, &names.map),
        (&mut pose.child_frame, &names.camera),
    ] {
        if frame == name {
            frame.clear();
        }
    }

    let pose = convert::pose(pose, room).map_err(|error| error.within("pose"))?;

    let deviation = |field: &str, given: f64| match given {
        0.0 => Ok(KNOWN),
        given if DEVIATIONS.contains(&given) => Ok(given),
        _ => Err(Error::invalid(
            field,
            format!("must be {:e} to {:e}", DEVIATIONS.start(), DEVIATIONS.end()),
        )),
    };

    let translation = deviation("translation_deviation_m", translation_deviation_m)?;
    let rotation = deviation("rotation_deviation_rad", rotation_deviation_rad)?;

    Ok(Belief::known(pose, translation, rotation))
}

/// What the answers depend on: the rooms under the adapter, by name, revision and content.
fn digest(served: &[Arc<ServedNavigator>]) -> Vec<u8> {
    let mut digest = Sha256::new();
    for served in served {
        let room = served.navigator.room().id();
        let adapter = &served.adapter;
        digest.update(format!(
            "{room}@{} {}@{}\n",
            served.room_revision, adapter.name, adapter.revision
        ));

        digest.update(served.content);
    }

    digest.finalize().to_vec()
}
