//! What a state is made of, as messages.

use prost::Message;

use super::super::super::Error;
use super::numbers::{
    belief_of_numbers, belief_to_numbers, driven_of_numbers, driven_to_numbers, moving_of_numbers,
    moving_to_numbers, numbers, pose_of_numbers, pose_to_numbers, required, symmetric,
    upper_triangle,
};
use seese3_core::tracking::{
    Candidate, Keyframe, LastFrame, LastMeasured, MeasuredSince, OtherCamera, Place, RecentMatches,
};

/// What other sensors measured; absent if none ever did.
#[derive(Clone, PartialEq, Message)]
pub(super) struct SealedMeasured {
    /// Of the last frame that brought a pose.
    #[prost(int64, tag = "4")]
    time_ns: i64,
    #[prost(double, repeated, tag = "1")]
    last: Vec<f64>,
    #[prost(double, repeated, tag = "2")]
    keyframe: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    place: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct SealedLast {
    #[prost(int64, tag = "1")]
    time_ns: i64,
    #[prost(uint64, tag = "2")]
    sequence: u64,
    #[prost(double, repeated, tag = "3")]
    odom: Vec<f64>,
    #[prost(double, repeated, tag = "4")]
    latent: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct SealedKeyframe {
    #[prost(uint64, tag = "1")]
    sequence: u64,
    #[prost(double, repeated, tag = "2")]
    latent: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    odom: Vec<f64>,
    #[prost(double, repeated, tag = "4")]
    reported_pose: Vec<f64>,
    #[prost(int64, tag = "5")]
    time_ns: i64,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct SealedPlace {
    #[prost(int64, tag = "1")]
    time_ns: i64,
    /// Empty if there is none.
    #[prost(double, repeated, tag = "2")]
    latent: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    belief: Vec<f64>,
    /// The upper triangle of the covariance of its lasting error.
    #[prost(double, repeated, tag = "4")]
    lasting: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct SealedCandidate {
    #[prost(uint64, tag = "1")]
    room: u64,
    #[prost(double, repeated, tag = "2")]
    map_pose: Vec<f64>,
    #[prost(uint32, tag = "3")]
    agreeing_anchors: u32,
    #[prost(uint64, tag = "4")]
    sequence: u64,
    #[prost(double, repeated, tag = "5")]
    latent: Vec<f64>,
    #[prost(int64, tag = "6")]
    time_ns: i64,
}

impl SealedLast {
    pub(super) fn opened(self) -> Result<LastFrame, Error> {
        let Self {
            time_ns,
            sequence,
            odom,
            latent,
        } = self;

        Ok(LastFrame {
            time_ns,
            sequence,
            latent,
            odom: required(&odom)?,
        })
    }
}

impl SealedKeyframe {
    pub(super) fn opened(self) -> Result<Keyframe, Error> {
        let Self {
            sequence,
            latent,
            odom,
            reported_pose,
            time_ns,
        } = self;

        Ok(Keyframe {
            time_ns,
            sequence,
            latent,
            odom: moving_of_numbers(&odom)?,
            reported_pose: belief_of_numbers(&reported_pose)?,
        })
    }
}

impl SealedPlace {
    pub(super) fn opened(self) -> Result<Place, Error> {
        let Self {
            time_ns,
            latent,
            belief,
            lasting,
        } = self;

        Ok(Place {
            time_ns,
            latent: (!latent.is_empty()).then_some(latent),
            belief: moving_of_numbers(&belief)?,
            lasting: symmetric(&lasting)?,
        })
    }
}

impl SealedCandidate {
    pub(super) fn opened(self) -> Result<Candidate, Error> {
        let Self {
            room,
            map_pose,
            agreeing_anchors,
            sequence,
            latent,
            time_ns,
        } = self;

        Ok(Candidate {
            room: usize::try_from(room).map_err(|_| Error::Internal)?,
            time_ns,
            sequence,
            latent: (!latent.is_empty()).then_some(latent),
            map_pose: required(&map_pose)?,
            agreeing_anchors,
        })
    }
}

impl From<&LastFrame> for SealedLast {
    fn from(last: &LastFrame) -> Self {
        let LastFrame {
            time_ns,
            sequence,
            latent,
            odom,
        } = last;

        Self {
            time_ns: *time_ns,
            sequence: *sequence,
            odom: belief_to_numbers(odom),
            latent: latent.clone(),
        }
    }
}

impl From<&Keyframe> for SealedKeyframe {
    fn from(keyframe: &Keyframe) -> Self {
        let Keyframe {
            time_ns,
            sequence,
            latent,
            odom,
            reported_pose,
        } = keyframe;

        Self {
            sequence: *sequence,
            latent: latent.clone(),
            odom: moving_to_numbers(odom),
            reported_pose: numbers(reported_pose),
            time_ns: *time_ns,
        }
    }
}

impl From<&Place> for SealedPlace {
    fn from(place: &Place) -> Self {
        let Place {
            time_ns,
            latent,
            belief,
            lasting,
        } = place;

        Self {
            time_ns: *time_ns,
            latent: latent.clone().unwrap_or_default(),
            belief: moving_to_numbers(belief),
            lasting: upper_triangle::<6>().map(|at| lasting[at]).collect(),
        }
    }
}

impl From<&Candidate> for SealedCandidate {
    fn from(candidate: &Candidate) -> Self {
        let Candidate {
            room,
            time_ns,
            sequence,
            latent,
            map_pose,
            agreeing_anchors,
        } = candidate;

        Self {
            room: *room as u64,
            map_pose: belief_to_numbers(map_pose),
            agreeing_anchors: *agreeing_anchors,
            sequence: *sequence,
            latent: latent.clone().unwrap_or_default(),
            time_ns: *time_ns,
        }
    }
}

impl SealedMeasured {
    pub(super) fn of(measured: &MeasuredSince) -> Option<Self> {
        let MeasuredSince {
            last,
            keyframe,
            place,
        } = measured;

        (*measured != MeasuredSince::default()).then(|| Self {
            time_ns: last.map_or(0, |last| last.time_ns),
            last: last.map_or_else(Vec::new, |last| pose_to_numbers(&last.pose)),
            keyframe: driven_to_numbers(keyframe.as_ref()),
            place: driven_to_numbers(place.as_ref()),
        })
    }

    pub(super) fn opened(self) -> Result<MeasuredSince, Error> {
        let Self {
            time_ns,
            last,
            keyframe,
            place,
        } = self;

        Ok(MeasuredSince {
            last: if last.is_empty() {
                None
            } else {
                Some(LastMeasured {
                    time_ns,
                    pose: pose_of_numbers(&last)?.0,
                })
            },
            keyframe: driven_of_numbers(&keyframe)?,
            place: driven_of_numbers(&place)?,
        })
    }
}

/// Another camera of the robot.
#[derive(Clone, PartialEq, Message)]
pub(super) struct SealedCamera {
    #[prost(uint32, tag = "1")]
    camera: u32,
    #[prost(double, repeated, tag = "2")]
    last: Vec<f64>,
    #[prost(uint32, tag = "3")]
    unchanged_frames: u32,
}

impl SealedCamera {
    pub(super) fn opened(self) -> OtherCamera {
        let Self {
            camera,
            last,
            unchanged_frames,
        } = self;

        OtherCamera {
            camera,
            last,
            unchanged_frames,
        }
    }
}

impl From<&OtherCamera> for SealedCamera {
    fn from(other: &OtherCamera) -> Self {
        let OtherCamera {
            camera,
            last,
            unchanged_frames,
        } = other;

        Self {
            camera: *camera,
            last: last.clone(),
            unchanged_frames: *unchanged_frames,
        }
    }
}

/// How sure matches lately were.
#[derive(Clone, PartialEq, Message)]
pub(super) struct SealedMatches {
    #[prost(int64, tag = "1")]
    time_ns: i64,
    #[prost(double, tag = "2")]
    log_deviation: f64,
}

impl SealedMatches {
    pub(super) fn opened(self) -> RecentMatches {
        let Self {
            time_ns,
            log_deviation,
        } = self;

        RecentMatches {
            time_ns,
            log_deviation,
        }
    }
}

impl From<&RecentMatches> for SealedMatches {
    fn from(recent: &RecentMatches) -> Self {
        let RecentMatches {
            time_ns,
            log_deviation,
        } = *recent;

        Self {
            time_ns,
            log_deviation,
        }
    }
}
