//! Frame-by-frame tracking: dead reckoning from keyframes, corrected by matching mapped frames.
//!
//! Start reading at [`Tracker::observe`]. It passes a frame to `step`, the algorithm in six steps.
//! Step 3 is in `dead_reckoning.rs`, step 4 in `anchoring.rs`.
//!
//! - A tracker is stateless: all data of a stream are in its [`State`]. The same state and frame
//!   give a bit-identical result.
//! - A robot may have several cameras; `rig.rs` matches their simultaneous views.
//! - `odom_from_camera` is continuous: motions are composed and never corrected. `map_from_camera`
//!   is corrected and may jump.
//! - There are two map poses. The *believed* pose is the filter state, with the filter's
//!   covariance; anchors are compared with it. The *reported* pose is sent to clients, with a
//!   calibrated covariance. While both exist, they differ only in covariance. When health is lost,
//!   only the reported pose remains.

use nalgebra::Matrix6;

use super::dead_reckoning::{MotionReading, Poses, Prediction};
use super::gravity::CountedGravity;
use super::health::{Continuity, FrameEvidence, TrackingHealth};
use super::rig::MatchedView;
use super::sight::{Sight, UNCHANGED_DISTANCE, distance};
use super::state::{Keyframe, LastFrame, Observation, Place, Refusal, State, Update};
use super::tracker::Tracker;
use super::{PoseVelocity, PoseWithCovariance};
use seese3_core::adapter::JUMP_WINDOW;

/// Longest pause after which a jump can still be detected, in frame periods of the calibration
/// rooms: 0.5 s at 30 Hz.
const LONGEST_GAP: u64 = 15;

impl Tracker {
    /// State of a stream before its first frame. With several maps, the room is still to be found.
    /// `initial_pose` is `world_from_camera` of the first frame, if known.
    pub fn start(&self, initial_pose: Option<PoseWithCovariance>) -> State {
        let health = if initial_pose.is_some() {
            TrackingHealth::confirmed()
        } else {
            TrackingHealth::NotStarted
        };

        State {
            room: (self.maps.len() == 1).then_some(0),
            health,
            initial_pose,
            ..State::default()
        }
    }

    /// Sets the map pose of a stream, `world_from_camera`; `odom` stays continuous.
    pub fn set_pose(&self, state: &mut State, pose: PoseWithCovariance) {
        state.health = TrackingHealth::confirmed();
        state.candidate = None;
        state.frames_off_map = 0;

        match &state.last {
            // The pose applies to the last frame, which becomes the keyframe.
            Some(last) => {
                state.keyframe = Some(Keyframe {
                    time_ns: last.time_ns,
                    sequence: last.sequence,
                    latent: last.latent.clone(),
                    odom: PoseVelocity::at(last.odom, self.prior(state.room)),
                    reported_pose: Some(pose),
                });
                state.place = Some(Place {
                    time_ns: last.time_ns,
                    latent: Some(last.latent.clone()),
                    belief: PoseVelocity::at(pose, self.prior(state.room)),
                    lasting: Matrix6::zeros(),
                });
                state.measured = state.measured.begun(last.time_ns);
            }
            None => state.initial_pose = Some(pose),
        }
    }

    /// Processes one frame. The state changes only if the frame is accepted.
    ///
    /// # Errors
    /// [`Refusal`] if the frame is late or a duplicate, or a latent does not fit the adapter.
    pub fn observe(&self, state: &mut State, frame: &Observation) -> Result<Update, Refusal> {
        if let Some(last) = &state.last {
            if frame.sequence <= last.sequence {
                return Err(Refusal::Duplicate {
                    sequence: frame.sequence,
                    last: last.sequence,
                });
            }

            if frame.time_ns <= last.time_ns {
                return Err(Refusal::Late {
                    time_ns: frame.time_ns,
                    last_ns: last.time_ns,
                });
            }
        }

        let others = frame.other_views.iter().map(|other| &other.latent);
        for latent in others.chain([&frame.latent]) {
            self.adapter()
                .check_latent(latent.as_slice().unwrap_or_default())?;
        }

        Ok(self.step(state, frame))
    }

    fn step(&self, state: &mut State, frame: &Observation) -> Update {
        // 1. Matching: the continuity of the view, and the best match of all cameras with a map.
        let continuity = self.record_view(state, frame);
        let sight = Sight::of(frame.is_blank, state.unchanged_frames);
        let seen = self.look(state, frame);
        let matches_room = seen.leading.matches_room();

        // 2. Health. A jump of the stream's own view is ignored while another camera certainly
        //    shows the room: the lens may have been covered for a moment.
        state.health = state.health.after(FrameEvidence {
            matches_room,
            matches_certainly: matches_room && seen.leading.matched.is_certain,
            is_proven: matches_room && seen.leading.is_proven,
            continuity: match continuity {
                Continuity::Jump if seen.is_seen_by_other => Continuity::Continuous,
                continuity => continuity,
            },
        });
        let off_map = state.frames_off_map.saturating_add(1);
        state.frames_off_map = if matches_room { 0 } else { off_map };

        // 3. Dead reckoning: predict every pose from the motion since the keyframe.
        let reading = match sight {
            Sight::Clear => MotionReading::of(continuity, seen.own_matches_room),
            Sight::Nothing | Sight::Unchanged => MotionReading::Unseen,
        };
        let prediction = self.predict(state, frame, reading);
        let mut poses = prediction.poses;
        if state.health.is_lost() {
            self.stop_believing(state, &mut poses);
        }

        let gravity = frame.gravity.map(|measured| measured.after(state, frame));
        if let (Some(believed), Some(gravity)) = (&mut poses.map_pose, &gravity) {
            *believed = believed.levelled(gravity);
        }

        // 4. Correction: try the matching mapped frames as an anchor.
        let correction = self.correct_by_views(state, &mut poses, frame, &seen, gravity.as_ref());
        if let Some(believed) = &poses.map_pose {
            poses.reported_pose = Some(self.reported(believed, &poses.lasting));
        }

        // 5. Update the state for the next frame.
        let keyframe_sequence = state
            .keyframe
            .as_ref()
            .map_or(frame.sequence, |keyframe| keyframe.sequence);
        let believed = poses.map_pose.as_ref().unwrap_or(&poses.odom);
        let velocity = state.last.as_ref().map(|_| believed.velocity);

        // Motions cannot be estimated from a blank image.
        let shows = sight != Sight::Nothing || state.keyframe.is_none();
        let is_keyframe = shows && self.is_keyframe_due(state, frame.time_ns, &prediction);
        let is_corrected = state.corrected_ns == Some(frame.time_ns);
        let is_place = is_corrected || (shows && self.is_place_old(state, frame.time_ns));
        remember(state, frame, &poses, is_keyframe, is_place);
        state.measured = state.measured.after(frame, is_keyframe, is_place);

        // 6. Output. The status depends on the reported pose, but only while there is a believed
        //    pose.
        let judged_pose = poses.map_pose.and(poses.reported_pose);

        let best = &seen.leading;
        let gravity_error_rad =
            gravity.and_then(|gravity| gravity_error_rad(&gravity, best, &poses));
        let (status, reason) = self.status(state, judged_pose.as_ref(), best, gravity_error_rad);

        Update {
            motion: prediction.motion,
            motion_covariance: prediction.covariance,
            keyframe_sequence,
            is_keyframe,
            odom: poses.odom.place(),
            map_pose: poses.reported_pose,
            velocity,
            status,
            reason,
            out_of_distribution: best.matched.out_of_distribution,
            room: state.room,
            best_match: Some((best.room, best.matched.nearest[0])),
            best_camera: best.other.map(|other| other.camera),
            match_used: correction.is_applied,
            surprise: correction.surprise,
            candidate: state.candidate.clone(),
            anchors_needed: best.anchors_needed(),
        }
    }

    /// Adds the view to the recent views and returns its continuity with them. A blank view is not
    /// recorded and counts as continuous.
    fn record_view(&self, state: &mut State, frame: &Observation) -> Continuity {
        if frame.is_blank {
            return Continuity::Continuous;
        }

        let whitened = self.whitened(frame.latent.view());
        let nearest = state
            .recent
            .iter()
            .map(|other| distance(other, &whitened))
            .fold(f64::INFINITY, f64::min);

        let is_unchanged = state
            .recent
            .last()
            .is_some_and(|last| distance(last, &whitened) <= UNCHANGED_DISTANCE);
        state.unchanged_frames = if is_unchanged {
            state.unchanged_frames.saturating_add(1)
        } else {
            0
        };

        // The distance between views of a moving camera grows about with the cube root of the time
        // between them.
        let periods = state
            .last
            .as_ref()
            .map_or(1, |last| self.frames_between(last.time_ns, frame.time_ns));
        let jump = self.error_model.statistics().jump_distance;
        let limit = jump * (periods as f64).cbrt();

        // A covered or frozen camera may have moved unnoticed, as during a gap in the stream.
        let unseen = state
            .seen_ns
            .map_or(1, |seen_ns| self.frames_between(seen_ns, frame.time_ns));
        if !is_unchanged {
            state.seen_ns = Some(frame.time_ns);
        }

        let missing = frames_since_last(state, frame) > JUMP_WINDOW as u64;
        let is_unseen = unseen > LONGEST_GAP && nearest > jump;
        let continuity = if missing || periods > LONGEST_GAP || is_unseen {
            Continuity::Gap
        } else if !state.recent.is_empty() && nearest > limit {
            Continuity::Jump
        } else {
            Continuity::Continuous
        };

        // A gap takes precedence: a jump may be hidden even if the view is near. After a gap or a
        // jump, the earlier views are no longer comparable.
        if continuity != Continuity::Continuous {
            state.recent.clear();
        } else if state.recent.len() == JUMP_WINDOW {
            state.recent.remove(0);
        }
        state.recent.push(whitened);

        continuity
    }

    /// Drops the believed map pose of a lost stream. In a single room the last pose is still
    /// reported, with growing covariance, until enough anchors agree on a new one. With several
    /// rooms the room is also unknown again.
    fn stop_believing(&self, state: &mut State, poses: &mut Poses) {
        poses.map_pose = None;
        state.candidate = None;

        if self.maps.len() > 1 {
            poses.reported_pose = None;
            state.room = None;
        }
    }

    /// Whether there is no place, or its age has reached the keyframe interval.
    fn is_place_old(&self, state: &State, time_ns: i64) -> bool {
        let place = state.place.as_ref();
        place.is_none_or(|place| self.is_old(place.time_ns, time_ns))
    }

    fn is_keyframe_due(&self, state: &State, time_ns: i64, prediction: &Prediction) -> bool {
        let keyframe = state.keyframe.as_ref();
        let is_old = keyframe.is_none_or(|keyframe| self.is_old(keyframe.time_ns, time_ns));

        is_old
            || state.health.is_lost()
            || prediction.motion.norm() >= self.settings.keyframe_displacement
    }

    fn is_old(&self, from_ns: i64, to_ns: i64) -> bool {
        self.frames_between(from_ns, to_ns) >= u64::from(self.settings.keyframe_frames)
    }
}

/// Stores the frame, and the keyframe and the place if they are due.
fn remember(
    state: &mut State,
    frame: &Observation,
    poses: &Poses,
    is_keyframe: bool,
    is_place: bool,
) {
    let latent = frame.latent.to_vec();

    if is_keyframe {
        state.keyframe = Some(Keyframe {
            time_ns: frame.time_ns,
            sequence: frame.sequence,
            latent: latent.clone(),
            odom: poses.odom,
            reported_pose: poses.reported_pose,
        });
        state.initial_pose = None;
    }

    match &poses.map_pose {
        Some(belief) if is_place => {
            let sight = Sight::of(frame.is_blank, state.unchanged_frames);
            state.place = Some(Place {
                time_ns: frame.time_ns,
                latent: (sight == Sight::Clear).then(|| latent.clone()),
                belief: *belief,
                lasting: poses.lasting,
            });
        }
        Some(_) => {}
        None => state.place = None,
    }

    state.last = Some(LastFrame {
        time_ns: frame.time_ns,
        sequence: frame.sequence,
        latent,
        odom: poses.odom.place(),
    });
}

/// Angle between measured gravity and that of the leading match, or else of the reported pose,
/// radians; `None` if both are within the gate.
fn gravity_error_rad(
    gravity: &CountedGravity,
    view: &MatchedView<'_>,
    poses: &Poses,
) -> Option<f64> {
    let placed = view.matches_room().then(|| view.placed());
    let by_view = placed.and_then(|placed| gravity.contradicts(&placed));
    by_view.or_else(|| gravity.contradicts(poses.reported_pose.as_ref()?))
}

/// Number of frames since the last accepted one, including this one and dropped frames.
fn frames_since_last(state: &State, frame: &Observation) -> u64 {
    state
        .last
        .as_ref()
        .map_or(1, |last| frame.sequence - last.sequence)
}
