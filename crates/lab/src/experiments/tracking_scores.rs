//! Scores of a tracker: pose and velocity errors beside those of simple baselines on the same
//! frames, and the calibration of its covariances and statuses.

use serde::Serialize;

use seese3_core::geometry::{Pose, PoseError, body_twist};
use seese3_core::nalgebra::Vector3;
use seese3_core::statistics::{mean, root_mean_square};
use seese3_robot::tracking::{PoseWithCovariance, Status};

use super::replay::Replay;

use crate::json;

/// Translation error above which a pose counts as wrong, meters.
const WRONG_BEYOND_M: f64 = 0.2;
/// Rotation error above which a pose counts as wrong, degrees.
const WRONG_BEYOND_DEG: f64 = 10.0;

/// The scores of one replay, or of several rooms together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackingScores {
    /// Absolute position errors over the frames with a map pose, meters.
    #[serde(rename = "ape_m")]
    pub ape: AnswerErrors,
    /// Absolute rotation errors over the same frames, radians.
    #[serde(rename = "ape_rad")]
    pub turn: AnswerErrors,
    /// Squared Mahalanobis lengths of the map pose errors in TRACKING frames.
    #[serde(rename = "coverage", serialize_with = "json::coverages")]
    pub tracking_surprises: Vec<f64>,
    /// The same for `odom_from_camera` in all frames, aligned to the true first pose.
    #[serde(rename = "coverage_odom", serialize_with = "json::coverages")]
    pub odom_surprises: Vec<f64>,
    /// Wrong poses in TRACKING frames.
    pub tracking_wrong: WrongPoses,
    /// Velocity errors, beside those of the zero-velocity baseline.
    pub velocity: VelocityErrors,
    /// Drift of `odom_from_camera`.
    #[serde(flatten)]
    pub drift: Drift,
}

/// Drift of a path: the mean error over all its parts of 0.5, 1, 2 and 4 m, per meter of the true
/// path, as KITTI measures it. NaN for shorter paths.
///
/// Source: A. Geiger et al., "Are we ready for autonomous driving?", CVPR 2012.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Drift {
    /// Of the position, percent.
    #[serde(rename = "drift_percent")]
    pub percent: f64,
    /// Of the rotation, degrees per meter.
    #[serde(rename = "drift_deg_per_m")]
    pub deg_per_m: f64,
}

/// Lengths of the parts over which drift is measured, meters.
const DRIFT_LENGTHS_M: [f64; 4] = [0.5, 1.0, 2.0, 4.0];

impl Drift {
    /// Drift of the odometry of a replay; parts do not cross from one stream to the next.
    fn of(replay: &Replay) -> Self {
        let truth = &replay.truth.poses;
        let odom: Vec<Pose> = replay
            .updates
            .iter()
            .map(|update| update.odom.pose)
            .collect();
        let ends = replay.beginnings.iter().skip(1).copied();
        let ends = ends.chain([truth.len()]);
        let streams = replay.beginnings.iter().zip(ends);
        Self::of_paths(streams.map(|(&begin, end)| (&truth[begin..end], &odom[begin..end])))
    }

    /// Drift of some paths, each with its true poses.
    pub(super) fn of_paths<'a>(paths: impl Iterator<Item = (&'a [Pose], &'a [Pose])>) -> Self {
        let step = |pair: &[Pose]| PoseError::between(&pair[0], &pair[1]).translation_m;
        let (mut percent, mut deg_per_m) = (Vec::new(), Vec::new());
        for (truth, estimated) in paths {
            let mut way_m = vec![0.0];
            for pair in truth.windows(2) {
                way_m.push(way_m[way_m.len() - 1] + step(pair));
            }
            for start in 0..truth.len() {
                for length_m in DRIFT_LENGTHS_M {
                    let is_reached = |row: &usize| way_m[*row] - way_m[start] >= length_m;
                    let Some(row) = (start..truth.len()).find(is_reached) else {
                        continue;
                    };
                    let error = PoseError::between(
                        &estimated[start].inv_mul(&estimated[row]),
                        &truth[start].inv_mul(&truth[row]),
                    );
                    let length_m = way_m[row] - way_m[start];
                    percent.push(100.0 * error.translation_m / length_m);
                    deg_per_m.push(error.rotation_rad.to_degrees() / length_m);
                }
            }
        }
        Self {
            percent: mean(&percent),
            deg_per_m: mean(&deg_per_m),
        }
    }

    /// Means over rooms; rooms with shorter paths are skipped.
    pub(super) fn mean<'a>(rooms: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let known = rooms.filter(|drift| drift.percent.is_finite());
        Self {
            percent: mean(&known.clone().map(|drift| drift.percent).collect::<Vec<_>>()),
            deg_per_m: mean(&known.map(|drift| drift.deg_per_m).collect::<Vec<_>>()),
        }
    }
}

/// Number of poses with an error above 0.2 m or 10°; in JSON, their fraction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[serde(into = "f64")]
pub struct WrongPoses {
    /// Number of poses.
    pub poses: usize,
    /// Number of wrong poses among them.
    pub wrong: usize,
}

impl From<WrongPoses> for f64 {
    fn from(counted: WrongPoses) -> Self {
        counted.wrong as Self / counted.poses as Self
    }
}

/// Root-mean-square errors of the tracker and of its baselines, over the same frames.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AnswerErrors {
    /// The map pose.
    pub fused: f64,
    /// Dead reckoning, aligned to the true first pose.
    pub odom: f64,
    /// The pose of the mapped frame with the most similar raw feature, by the cosine.
    pub nearest_frame: f64,
    /// The true first pose of the stream, for every frame.
    pub standing_still: f64,
}

/// Root-mean-square velocity errors over frames, meters per second.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct VelocityErrors {
    /// Error of the reported velocity.
    pub error_m_s: f64,
    /// Error of the zero-velocity baseline, which is the true speed.
    pub zero_m_s: f64,
}

/// Fractions of frames by reported status.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StatusShares {
    /// TRACKING.
    pub tracking: f64,
    /// DEGRADED.
    pub degraded: f64,
    /// LOST.
    pub lost: f64,
    /// RELOCALIZING.
    pub relocalizing: f64,
}

impl StatusShares {
    /// The shares by a function of the status.
    pub fn of(share: impl Fn(Status) -> f64) -> Self {
        Self {
            tracking: share(Status::Tracking),
            degraded: share(Status::Degraded),
            lost: share(Status::Lost),
            relocalizing: share(Status::Relocalizing),
        }
    }
}

/// Number of frames of other rooms, and of those reported LOST.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct LostFrames {
    /// Number of replayed frames.
    pub frames: usize,
    /// Number of frames reported LOST.
    pub lost: usize,
}

impl TrackingScores {
    /// The scores of several rooms together: errors are means over rooms, the rest is over all
    /// frames.
    pub fn together<'a>(rooms: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let all = |of: fn(&Self) -> &Vec<f64>| rooms.clone().flat_map(of).copied().collect();
        let wrong = rooms.clone().map(|room| room.tracking_wrong);

        Self {
            ape: AnswerErrors::mean(rooms.clone().map(|room| &room.ape)),
            turn: AnswerErrors::mean(rooms.clone().map(|room| &room.turn)),
            tracking_surprises: all(|room| &room.tracking_surprises),
            odom_surprises: all(|room| &room.odom_surprises),
            tracking_wrong: wrong.fold(WrongPoses::default(), |sum, room| WrongPoses {
                poses: sum.poses + room.poses,
                wrong: sum.wrong + room.wrong,
            }),
            velocity: VelocityErrors::mean(rooms.clone().map(|room| &room.velocity)),
            drift: Drift::mean(rooms.map(|room| &room.drift)),
        }
    }

    /// The scores of a replay. `nearest_frame` returns the pose of the mapped frame with the raw
    /// feature most similar to that of a row.
    pub fn of(replay: &Replay, nearest_frame: impl Fn(usize) -> Pose) -> Self {
        Self::of_rows(replay, |_| true, nearest_frame)
    }

    /// The scores of the rows of a replay that `keep` accepts.
    pub fn of_rows(
        replay: &Replay,
        keep: impl Fn(usize) -> bool,
        nearest_frame: impl Fn(usize) -> Pose,
    ) -> Self {
        let odom = replay.odom_path().poses;

        let mut errors: [Vec<PoseError>; 4] = Default::default();
        let mut tracking_surprises = Vec::new();
        let mut odom_surprises = Vec::new();
        let mut tracking_wrong = WrongPoses::default();

        let answers = replay.updates.iter().zip(&replay.truth.poses).zip(&odom);
        for (row, ((update, truth), odom)) in answers.enumerate() {
            if !keep(row) {
                continue;
            }
            let odom_belief = PoseWithCovariance {
                pose: *odom,
                covariance: update.odom.covariance,
            };
            odom_surprises.extend(odom_belief.squared_error(truth));

            let Some(map_pose) = &update.map_pose else {
                continue;
            };
            let first = replay.first_pose(row);
            let given = [map_pose.pose, *odom, nearest_frame(row), first];
            for (errors, pose) in errors.iter_mut().zip(given) {
                errors.push(PoseError::between(&pose, truth));
            }

            if update.status == Status::Tracking {
                tracking_wrong.poses += 1;
                tracking_wrong.wrong += usize::from(is_wrong(&map_pose.pose, truth));
                tracking_surprises.extend(map_pose.squared_error(truth));
            }
        }

        let answers = |of: fn(&PoseError) -> f64| {
            let [fused, odom, nearest_frame, standing_still] = errors
                .each_ref()
                .map(|errors| root_mean_square(&errors.iter().map(of).collect::<Vec<_>>()));
            AnswerErrors {
                fused,
                odom,
                nearest_frame,
                standing_still,
            }
        };
        Self {
            ape: answers(|error| error.translation_m),
            turn: answers(|error| error.rotation_rad),
            tracking_surprises,
            odom_surprises,
            tracking_wrong,
            velocity: VelocityErrors::of_replay(replay, &keep),
            drift: Drift::of(replay),
        }
    }
}

impl AnswerErrors {
    /// Means over rooms; rooms without a map pose are skipped.
    pub fn mean<'a>(rooms: impl Iterator<Item = &'a Self>) -> Self {
        let known: Vec<&Self> = rooms.filter(|errors| errors.fused.is_finite()).collect();
        let of =
            |of: fn(&Self) -> f64| mean(&known.iter().map(|errors| of(errors)).collect::<Vec<_>>());

        Self {
            fused: of(|errors| errors.fused),
            odom: of(|errors| errors.odom),
            nearest_frame: of(|errors| errors.nearest_frame),
            standing_still: of(|errors| errors.standing_still),
        }
    }
}

impl VelocityErrors {
    /// Errors of reported velocities, each with the true one, m/s; NaN without any.
    pub fn of(velocities: &[(Vector3<f64>, Vector3<f64>)]) -> Self {
        let rms = |of: fn(&(Vector3<f64>, Vector3<f64>)) -> f64| {
            root_mean_square(&velocities.iter().map(of).collect::<Vec<_>>())
        };
        Self {
            error_m_s: rms(|(reported, truth)| (reported - truth).norm()),
            zero_m_s: rms(|(_, truth)| truth.norm()),
        }
    }

    /// Errors of the linear velocities in the rows that `keep` accepts.
    fn of_replay(replay: &Replay, keep: &dyn Fn(usize) -> bool) -> Self {
        let times = replay.truth.times_ns.windows(2);
        let poses = replay.truth.poses.windows(2).zip(times);
        let steps = (1..).zip(replay.updates.iter().skip(1).zip(poses));
        let velocities = steps.filter_map(|(row, (update, (poses, times)))| {
            let reported = update.velocity.filter(|_| keep(row))?;
            let seconds = (times[1] - times[0]) as f64 * 1e-9;
            let truth = body_twist(&poses[0], &poses[1]).linear / seconds;
            Some((reported.linear, truth))
        });
        Self::of(&velocities.collect::<Vec<_>>())
    }

    /// Means over rooms.
    pub fn mean<'a>(rooms: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let error: Vec<f64> = rooms.clone().map(|errors| errors.error_m_s).collect();
        let zero: Vec<f64> = rooms.map(|errors| errors.zero_m_s).collect();

        Self {
            error_m_s: mean(&error),
            zero_m_s: mean(&zero),
        }
    }
}

/// Whether a pose is wrong: off by more than 0.2 m or 10°.
pub fn is_wrong(pose: &Pose, truth: &Pose) -> bool {
    let error = PoseError::between(pose, truth);
    error.translation_m > WRONG_BEYOND_M || error.rotation_rad > WRONG_BEYOND_DEG.to_radians()
}
