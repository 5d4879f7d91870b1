//! Path statistics and warnings from the poses of a recording alone, without images.

use nalgebra::Vector3;

use seese3_core::geometry::Pose;
use seese3_core::room::{FrameId, Room};
use seese3_core::statistics::{median, quantile};

/// A step is a jump if it exceeds this multiple of the 95th percentile of all steps.
const JUMP: f64 = 10.0;
/// Minimum number of steps for the detection of jumps.
const FEWEST_STEPS: usize = 40;
/// Maximum plausible median speed of a camera, m/s. Above it, the unit of length is wrong.
const FASTEST_M_S: f64 = 50.0;
/// Maximum plausible median step of a recording without timestamps, meters.
const LONGEST_STEP_M: f64 = 10.0;

/// Statistics of a camera's path.
#[derive(Debug, Clone, PartialEq)]
pub struct PathFacts {
    /// The size of the box around all camera positions, along the world's axes, meters.
    pub extent_m: [f64; 3],
    /// The length of the path, meters, without the gaps between sequences.
    pub length_m: f64,
    /// The median distance between consecutive frames, meters.
    pub median_step_m: f64,
    /// The largest of these distances, and the later of its two frames.
    pub largest_step_m: (f64, FrameId),
    /// The median rotation between consecutive frames, radians.
    pub median_step_rad: f64,
    /// The largest of these rotations, and the later of its two frames.
    pub largest_step_rad: (f64, FrameId),
    /// Frames per second, from the median interval between consecutive frames; `None` without
    /// timestamps, or if that interval is not positive.
    pub rate_hz: Option<f64>,
    /// Suspicious properties of the poses.
    pub warnings: Vec<PathWarning>,
}

/// A suspicious property of a recording's poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PathWarning {
    /// All poses are the same.
    NeverMoves,
    /// All positions are the same, and the camera turns.
    OnlyTurns,
    /// Poses are exactly the identity, in any axis convention, after poses that are not.
    Identities {
        /// The number of such poses.
        count: usize,
        /// The frame of the first.
        first: FrameId,
    },
    /// The camera jumps.
    Jumps {
        /// The number of jumps.
        count: usize,
        /// The frame after the first jump.
        first: FrameId,
    },
    /// Steps are so long that the translations are likely not in meters.
    OtherUnit {
        /// The median step, meters.
        median_step_m: f64,
    },
    /// Times do not increase from frame to frame.
    TimesFall {
        /// The first frame that is not later than the one before it.
        first: FrameId,
    },
}

/// A step between consecutive frames of one sequence.
struct Step {
    to: FrameId,
    meters: f64,
    radians: f64,
    seconds: Option<f64>,
}

impl PathFacts {
    /// The statistics of a room's poses. `None` if no two frames are consecutive.
    pub fn of(room: &Room) -> Option<Self> {
        let steps = steps(room);
        let meters: Vec<f64> = steps.iter().map(|step| step.meters).collect();
        let radians: Vec<f64> = steps.iter().map(|step| step.radians).collect();
        let seconds: Vec<f64> = steps.iter().filter_map(|step| step.seconds).collect();

        let longest = |value: fn(&Step) -> f64| {
            let longest = steps.iter().max_by(|a, b| value(a).total_cmp(&value(b)));
            longest.map(|step| (value(step), step.to))
        };
        let positions = || room.poses().iter().map(|pose| pose.translation.vector);
        let low = positions().reduce(|low, place| low.inf(&place))?;
        let high = positions().reduce(|high, place| high.sup(&place))?;
        let rate_hz = (!seconds.is_empty()).then(|| median(&seconds).recip());

        Some(Self {
            extent_m: Vector3::from(high - low).into(),
            length_m: meters.iter().sum(),
            median_step_m: median(&meters),
            largest_step_m: longest(|step| step.meters)?,
            median_step_rad: median(&radians),
            largest_step_rad: longest(|step| step.radians)?,
            rate_hz: rate_hz.filter(|rate| rate.is_finite() && *rate > 0.0),
            warnings: warnings(room, &steps),
        })
    }
}

fn steps(room: &Room) -> Vec<Step> {
    let poses = room.poses();
    let times = room.timestamps_ns();
    let ids = (1..room.frame_count() as u32).map(|row| (FrameId(row - 1), FrameId(row)));

    let joined = ids.filter(|(from, to)| room.timeline().joins(*from, *to));
    let step = |(from, to): (FrameId, FrameId)| {
        let [a, b] = [&poses[from.row()], &poses[to.row()]];
        let elapsed = times.get(to.row()).zip(times.get(from.row()));
        Step {
            to,
            meters: (b.translation.vector - a.translation.vector).norm(),
            radians: a.rotation.angle_to(&b.rotation),
            seconds: elapsed.map(|(later, earlier)| (*later as f64 - *earlier as f64) * 1e-9),
        }
    };
    joined.map(step).collect()
}

/// Whether a pose is the identity in any axis convention. Recorders write it when tracking is lost.
pub fn is_identity(pose: &Pose) -> bool {
    let rotation = pose.rotation.to_rotation_matrix();
    let is_along_axis = |number: &f64| number.abs() < 1e-9 || (number.abs() - 1.0).abs() < 1e-9;

    pose.translation.vector == Vector3::zeros() && rotation.matrix().iter().all(is_along_axis)
}

fn warnings(room: &Room, steps: &[Step]) -> Vec<PathWarning> {
    let poses = room.poses();
    if poses.len() > 1 && poses.iter().all(|pose| pose == &poses[0]) {
        return vec![PathWarning::NeverMoves];
    }

    let mut warnings = Vec::new();
    if steps.iter().all(|step| step.meters == 0.0) && !steps.is_empty() {
        warnings.push(PathWarning::OnlyTurns);
    }

    let moved = poses
        .iter()
        .position(|pose| !is_identity(pose))
        .unwrap_or(0);
    let identities = (moved..poses.len()).filter(|&row| is_identity(&poses[row]));
    let identities: Vec<usize> = identities.collect();
    if let Some(&first) = identities.first() {
        warnings.push(PathWarning::Identities {
            count: identities.len(),
            first: FrameId(first as u32),
        });
    }

    let meters: Vec<f64> = steps.iter().map(|step| step.meters).collect();
    let radians: Vec<f64> = steps.iter().map(|step| step.radians).collect();
    let long = |values: &[f64]| quantile(values, 0.95).unwrap_or(f64::INFINITY);
    let [long_m, long_rad] = [long(&meters), long(&radians)];
    let is_jump = |step: &&Step| {
        let is_far = long_m > 0.0 && step.meters > JUMP * long_m;
        is_far || (long_rad > 0.0 && step.radians > JUMP * long_rad)
    };
    let jumps: Vec<&Step> = steps.iter().filter(is_jump).collect();
    if let Some(first) = jumps.first().filter(|_| steps.len() >= FEWEST_STEPS) {
        warnings.push(PathWarning::Jumps {
            count: jumps.len(),
            first: first.to,
        });
    }

    let speeds: Vec<f64> = steps
        .iter()
        .filter_map(|step| Some(step.meters / step.seconds?))
        .collect();
    let median_step_m = median(&meters);
    let is_too_fast = match speeds.is_empty() {
        true => median_step_m > LONGEST_STEP_M,
        false => median(&speeds) > FASTEST_M_S,
    };
    if is_too_fast {
        warnings.push(PathWarning::OtherUnit { median_step_m });
    }

    let falls = |step: &&Step| step.seconds.is_some_and(|seconds| seconds <= 0.0);
    if let Some(step) = steps.iter().find(falls) {
        warnings.push(PathWarning::TimesFall { first: step.to });
    }
    warnings
}
