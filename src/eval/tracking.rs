//! How well a tracker follows: paths, covariances, and whether it knows when it is lost.

use std::sync::Arc;

use super::Error;
use crate::adapter::Adapter;
use crate::geometry::{Pose, body_twist, log};
use crate::navigation::{IndexKind, Navigator};
use crate::odometry::{Belief, Map, Observation, Settings, State, Status, Tracker, Update};
use crate::room::FrameId;
use crate::training::{Lesson, imbalance};
use crate::trajectory::Trajectory;

/// χ² with six degrees of freedom: 68 % and 95 % are below.
pub const ELLIPSOIDS: [f64; 2] = [7.012, 12.592];
/// Parts of a recording's way, of which every fifth is held out of a map.
const PARTS: usize = 20;
/// Factors of places that are tried: from the least on, each a tenth above the one before.
const LEAST_PLACE_FACTOR: f64 = 0.1;
const PLACE_FACTOR_STEP: f64 = 1.1;
const PLACE_FACTORS: i32 = 40;

/// Which frames of a recording are mapped, and which are followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Course {
    /// Mapped: every second frame. Followed: the others, from first to last.
    Interleaved,
    /// As interleaved, and every fifth of twenty parts of the way is not mapped at all.
    Blocks,
    /// Mapped: the first four fifths. Followed: the last.
    Time,
}

impl Course {
    /// Every course.
    pub const ALL: [Self; 3] = [Self::Interleaved, Self::Blocks, Self::Time];

    /// The word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Interleaved => "interleaved",
            Self::Blocks => "blocks",
            Self::Time => "time",
        }
    }

    /// The frames that are mapped, of so many.
    pub fn mapped(self, frame_count: usize) -> Vec<FrameId> {
        let keep = |row: &usize| match self {
            Self::Interleaved => row % 2 == 0,
            Self::Blocks => row % 2 == 0 && !Self::is_gap(*row, frame_count),
            Self::Time => *row < frame_count * 4 / 5,
        };
        (0..frame_count).filter(keep).map(|row| FrameId(row as u32)).collect()
    }

    /// The frames that are followed, none of them mapped.
    pub fn followed(self, frame_count: usize) -> Vec<FrameId> {
        let keep = |row: &usize| match self {
            Self::Interleaved | Self::Blocks => row % 2 == 1,
            Self::Time => *row >= frame_count * 4 / 5,
        };
        (0..frame_count).filter(keep).map(|row| FrameId(row as u32)).collect()
    }

    fn is_gap(row: usize, frame_count: usize) -> bool {
        (row / frame_count.div_ceil(PARTS).max(1)) % 5 == 2
    }
}

/// A stream that was followed.
#[derive(Debug, Clone)]
pub struct Followed {
    /// The true path.
    pub truth: Trajectory,
    /// The frames' numbers: their rows, so that frames which were left out are missing.
    pub numbers: Vec<u64>,
    /// What was said, frame by frame.
    pub updates: Vec<Update>,
}

/// Follows frames of a recording: `latents` by row, `poses` `world_from_camera`, nanoseconds between rows. With a place to
/// begin at, that is known to a millimetre; without one it has to be found.
pub fn follow(
    tracker: &Tracker,
    latents: ndarray::ArrayView2<'_, f64>,
    poses: &[Pose],
    frames: &[FrameId],
    period_ns: i64,
    begins_known: bool,
) -> Followed {
    let start = frames.first().map(|first| Belief::known(poses[first.row()], 1e-3, 1e-3));
    let mut state: State = tracker.start(start.filter(|_| begins_known));
    let (mut truth, mut numbers, mut updates) = (Trajectory::default(), Vec::new(), Vec::with_capacity(frames.len()));
    for frame in frames {
        let time_ns = i64::from(frame.0) * period_ns;
        let latent = latents.row(frame.row()).to_owned();
        // Latents of the tracker's own adapter, in order: none is refused.
        let observation = Observation { time_ns, sequence: u64::from(frame.0), latent };
        if let Ok(update) = tracker.observe(&mut state, &observation) {
            truth.times_ns.push(time_ns);
            truth.poses.push(poses[frame.row()]);
            numbers.push(u64::from(frame.0));
            updates.push(update);
        }
    }
    Followed { truth, numbers, updates }
}

impl Followed {
    /// `map_from_camera` of the frames where a place was known, with the places of those frames.
    pub fn map_path(&self) -> (Trajectory, Vec<usize>) {
        let known = self.updates.iter().enumerate().filter_map(|(at, update)| Some((at, update.place?.pose)));
        let (places, poses): (Vec<usize>, Vec<Pose>) = known.unzip();
        let times_ns = places.iter().map(|&at| self.truth.times_ns[at]).collect();
        (Trajectory { times_ns, poses }, places)
    }

    /// `odom_from_camera`, laid on the true first pose.
    pub fn odom_path(&self) -> Trajectory {
        let first = self.truth.poses.first().copied().unwrap_or_default();
        let poses = self.updates.iter().map(|update| first * update.odom.pose).collect();
        Trajectory { times_ns: self.truth.times_ns.clone(), poses }
    }

    /// The squared Mahalanobis lengths of the errors of places.
    pub fn place_surprises(&self) -> Vec<f64> {
        self.updates.iter().zip(&self.truth.poses).filter_map(place_surprise).collect()
    }

    /// The squared Mahalanobis lengths of the errors of read motions, with the lengths of the motions read.
    pub fn motion_surprises(&self) -> Vec<(f64, f64)> {
        let of = |(update, truth): (&Update, &Pose)| {
            let keyframe = &self.truth.poses[self.numbers.binary_search(&update.keyframe_sequence).ok()?];
            let error = body_twist(keyframe, truth).to_vector() - update.motion.to_vector();
            let moved = update.motion.norm() > 0.0;
            moved.then_some(())?;
            Some((update.motion.norm(), squared_length(&error, &update.motion_covariance)?))
        };
        self.updates.iter().zip(&self.truth.poses).filter_map(of).collect()
    }

    /// The share of frames with a status.
    pub fn share(&self, status: Status) -> f64 {
        let count = self.updates.iter().filter(|update| update.status == status).count();
        count as f64 / self.updates.len() as f64
    }

    /// Frames until the place was known and right to half a metre and 15 degrees; none if that never was.
    pub fn frames_to_relocalise(&self) -> Option<usize> {
        let right = |(update, truth): (&Update, &Pose)| {
            let error = update.place.map(|place| crate::geometry::PoseError::between(&place.pose, truth));
            update.status == Status::Tracking
                && error.is_some_and(|error| error.translation_m <= 0.5 && error.rotation_rad <= 15_f64.to_radians())
        };
        self.updates.iter().zip(&self.truth.poses).position(right).map(|at| at + 1)
    }
}

fn place_surprise((update, truth): (&Update, &Pose)) -> Option<f64> {
    let place = update.place?;
    squared_length(&log(&place.pose.inv_mul(truth)).to_vector(), &place.covariance)
}

/// eᵀ Σ⁻¹ e.
fn squared_length(error: &nalgebra::Vector6<f64>, covariance: &nalgebra::Matrix6<f64>) -> Option<f64> {
    Some(error.dot(&covariance.cholesky()?.solve(error)))
}

/// What the covariances of corrected places have to be multiplied with so that those of all places are what their errors
/// are, followed in rooms that the adapter's errors were measured in. None where no place was found.
///
/// # Errors
/// [`Error`] of making the maps.
pub fn place_factor(adapter: &Arc<Adapter>, lessons: &[Lesson<'_>]) -> Result<Option<f64>, Error> {
    let mut trackers = Vec::with_capacity(lessons.len());
    for lesson in lessons {
        let room = Arc::new(lesson.room.clone());
        let navigator = Navigator::new(room, lesson.features, adapter.clone(), IndexKind::Exact)?;
        let map = Map::new(Arc::new(navigator), &Course::Blocks.mapped(lesson.room.frame_count()))?;
        trackers.push(Tracker::new(vec![Arc::new(map)], Settings::of(adapter))?);
    }
    let mut best: Option<(f64, f64)> = None;
    for step in 0..PLACE_FACTORS {
        let factor = LEAST_PLACE_FACTOR * PLACE_FACTOR_STEP.powi(step);
        let mut surprises = Vec::new();
        trackers = trackers.into_iter().map(|tracker| tracker.with_place_factor(factor)).collect();
        for (tracker, lesson) in trackers.iter().zip(lessons) {
            let frames = Course::Blocks.followed(lesson.room.frame_count());
            let latents = tracker.maps()[0].navigator().latents();
            surprises.extend(follow(tracker, latents, lesson.room.poses(), &frames, 1, true).place_surprises());
        }
        if let Some(off) = imbalance(&mut surprises)
            && best.is_none_or(|(_, least)| off < least)
        {
            best = Some((factor, off));
        }
    }
    Ok(best.map(|(factor, _)| factor))
}

/// The shares of squared lengths within [`ELLIPSOIDS`].
pub fn coverage(surprises: &[f64]) -> [f64; 2] {
    ELLIPSOIDS.map(|limit| surprises.iter().filter(|&&x| x <= limit).count() as f64 / surprises.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition: no frame is both mapped and followed.
    #[test]
    fn what_is_followed_is_not_mapped() {
        for course in Course::ALL {
            let (mapped, followed) = (course.mapped(400), course.followed(400));
            assert!(followed.iter().all(|frame| !mapped.contains(frame)), "{}", course.name());
            assert!(mapped.len() >= 160 && followed.len() >= 80, "{}", course.name());
        }
        assert!(
            !Course::Blocks.mapped(400).contains(&FrameId(40)) && Course::Blocks.mapped(400).contains(&FrameId(38))
        );
    }

    /// Oracle: the table of χ² with six degrees of freedom.
    #[test]
    fn coverage_counts_what_is_within() {
        assert_eq!(coverage(&[1.0, 7.0, 7.1, 12.5, 20.0]), [0.4, 0.8]);
    }
}
