//! How well a tracker follows: paths, covariances, and whether it knows when it is lost.

use std::sync::Arc;

use super::Error;
use crate::adapter::{Adapter, ELLIPSOIDS};
use crate::geometry::{Pose, body_twist, log};
use crate::navigation::{IndexKind, Navigator};
use crate::odometry::{Belief, Map, Observation, Settings, State, Status, Tracker, Update};
use crate::room::FrameId;
use crate::training::{Lesson, imbalance};
use crate::trajectory::Trajectory;

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
            Self::Interleaved => row.is_multiple_of(2),
            Self::Blocks => row.is_multiple_of(2) && !Self::is_gap(*row, frame_count),
            Self::Time => *row < frame_count * 4 / 5,
        };
        (0..frame_count)
            .filter(keep)
            .map(|row| FrameId(row as u32))
            .collect()
    }

    /// The frames that are followed, none of them mapped.
    pub fn followed(self, frame_count: usize) -> Vec<FrameId> {
        let keep = |row: &usize| match self {
            Self::Interleaved | Self::Blocks => row % 2 == 1,
            Self::Time => *row >= frame_count * 4 / 5,
        };
        (0..frame_count)
            .filter(keep)
            .map(|row| FrameId(row as u32))
            .collect()
    }

    /// Whether the frames beside a followed one are mapped.
    pub fn is_mapped_beside(self, frame: FrameId, frame_count: usize) -> bool {
        match self {
            Self::Interleaved => true,
            Self::Blocks => !Self::is_gap(frame.row(), frame_count),
            Self::Time => false,
        }
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
    /// The frames' numbers, in which those that were left out are missing.
    pub numbers: Vec<u64>,
    /// What was said, frame by frame.
    pub updates: Vec<Update>,
}

/// Some frames of a recording.
#[derive(Debug, Clone, Copy)]
pub struct Stretch<'a> {
    /// Row by frame, of the tracker's adapter.
    pub latents: ndarray::ArrayView2<'a, f64>,
    /// `world_from_camera`, row by frame.
    pub poses: &'a [Pose],
    /// In order.
    pub frames: &'a [FrameId],
}

/// What is known at the beginning of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Begin {
    /// Where the camera is, to a millimetre.
    Known,
    /// Nothing.
    Unknown,
}

/// Follows stretches one after the other, as if no frame lay in between, so many nanoseconds from
/// row to row.
pub fn follow(
    tracker: &Tracker,
    stretches: &[Stretch<'_>],
    period_ns: i64,
    begin: Begin,
) -> Followed {
    let first = stretches
        .first()
        .and_then(|stretch| Some(stretch.poses[stretch.frames.first()?.row()]));
    let start = first.map(|pose| Belief::known(pose, 1e-3, 1e-3));
    let mut state: State = tracker.start(start.filter(|_| begin == Begin::Known));

    let mut truth = Trajectory::default();
    let mut numbers = Vec::new();
    let mut updates = Vec::new();
    let mut number: u64 = 0;

    for Stretch {
        latents,
        poses,
        frames,
    } in stretches
    {
        for (place, frame) in frames.iter().enumerate() {
            // As many numbers on as rows; one on from stretch to stretch.
            number += place
                .checked_sub(1)
                .map_or(1, |before| u64::from(frame.0 - frames[before].0));

            let time_ns = number as i64 * period_ns;
            let observation = Observation {
                time_ns,
                sequence: number,
                latent: latents.row(frame.row()).to_owned(),
            };

            // Latents of the tracker's own adapter, in order: none is refused.
            if let Ok(update) = tracker.observe(&mut state, &observation) {
                truth.times_ns.push(time_ns);
                truth.poses.push(poses[frame.row()]);
                numbers.push(number);
                updates.push(update);
            }
        }
    }

    Followed {
        truth,
        numbers,
        updates,
    }
}

impl Followed {
    /// `map_from_camera` of the frames where a place was known, with the places of those frames.
    pub fn map_path(&self) -> (Trajectory, Vec<usize>) {
        let known = self
            .updates
            .iter()
            .enumerate()
            .filter_map(|(at, update)| Some((at, update.place?.pose)));
        let (places, poses): (Vec<usize>, Vec<Pose>) = known.unzip();
        let times_ns = places.iter().map(|&at| self.truth.times_ns[at]).collect();

        (Trajectory { times_ns, poses }, places)
    }

    /// `odom_from_camera`, laid on the true first pose.
    pub fn odom_path(&self) -> Trajectory {
        let first = self.truth.poses.first().copied().unwrap_or_default();
        let poses = self
            .updates
            .iter()
            .map(|update| first * update.odom.pose)
            .collect();

        Trajectory {
            times_ns: self.truth.times_ns.clone(),
            poses,
        }
    }

    /// The squared Mahalanobis lengths of the errors of places.
    pub fn place_surprises(&self) -> Vec<f64> {
        self.updates
            .iter()
            .zip(&self.truth.poses)
            .filter_map(place_surprise)
            .collect()
    }

    /// The same, of frames whose neighbours on the way are mapped or not.
    pub fn place_surprises_where(
        &self,
        is_mapped: impl Fn(usize) -> bool,
        wanted: bool,
    ) -> Vec<f64> {
        let frames = self.updates.iter().zip(&self.truth.poses).enumerate();
        frames
            .filter(|(at, _)| is_mapped(*at) == wanted)
            .filter_map(|(_, frame)| place_surprise(frame))
            .collect()
    }

    /// The squared Mahalanobis lengths of the errors of read motions, with the lengths of the
    /// motions read.
    pub fn motion_surprises(&self) -> Vec<(f64, f64)> {
        let of = |(update, truth): (&Update, &Pose)| {
            let keyframe =
                &self.truth.poses[self.numbers.binary_search(&update.keyframe_sequence).ok()?];
            let error = body_twist(keyframe, truth).to_vector() - update.motion.to_vector();
            let moved = update.motion.norm() > 0.0;
            moved.then_some(())?;

            Some((
                update.motion.norm(),
                squared_length(&error, &update.motion_covariance)?,
            ))
        };

        self.updates
            .iter()
            .zip(&self.truth.poses)
            .filter_map(of)
            .collect()
    }

    /// The share of frames with a status.
    pub fn share(&self, status: Status) -> f64 {
        let count = self
            .updates
            .iter()
            .filter(|update| update.status == status)
            .count();
        count as f64 / self.updates.len() as f64
    }

    /// Frames until the place was known and right to half a metre and 15 degrees; none if that
    /// never was.
    pub fn frames_to_relocalise(&self) -> Option<usize> {
        let right = |(update, truth): (&Update, &Pose)| {
            let error = update
                .place
                .map(|place| crate::geometry::PoseError::between(&place.pose, truth));
            update.status == Status::Tracking
                && error.is_some_and(|error| {
                    error.translation_m <= 0.5 && error.rotation_rad <= 15_f64.to_radians()
                })
        };

        self.updates
            .iter()
            .zip(&self.truth.poses)
            .position(right)
            .map(|at| at + 1)
    }
}

fn place_surprise((update, truth): (&Update, &Pose)) -> Option<f64> {
    let place = update.place?;
    squared_length(
        &log(&place.pose.inv_mul(truth)).to_vector(),
        &place.covariance,
    )
}

/// eᵀ Σ⁻¹ e.
fn squared_length(
    error: &nalgebra::Vector6<f64>,
    covariance: &nalgebra::Matrix6<f64>,
) -> Option<f64> {
    Some(error.dot(&covariance.cholesky()?.solve(error)))
}

/// What the covariances of corrected places have to be multiplied with so that those of all places
/// are what their errors are, followed in rooms that the adapter's errors were measured in. None
/// where no place was found.
///
/// # Errors
/// [`Error`] of making the maps.
pub fn place_factor(adapter: &Arc<Adapter>, lessons: &[Lesson<'_>]) -> Result<Option<f64>, Error> {
    let mut trackers = Vec::with_capacity(lessons.len());
    for lesson in lessons {
        let room = Arc::new(lesson.room.clone());
        let navigator = Navigator::new(room, lesson.features, adapter.clone(), IndexKind::Exact)?;
        let map = Map::new(
            Arc::new(navigator),
            &Course::Blocks.mapped(lesson.room.frame_count()),
        )?;
        trackers.push(Tracker::new(vec![Arc::new(map)], Settings::of(adapter))?);
    }

    let mut best: Option<(f64, f64)> = None;
    for step in 0..PLACE_FACTORS {
        let factor = LEAST_PLACE_FACTOR * PLACE_FACTOR_STEP.powi(step);
        let mut surprises = Vec::new();

        trackers = trackers
            .into_iter()
            .map(|tracker| tracker.with_place_factor(factor))
            .collect();

        for (tracker, lesson) in trackers.iter().zip(lessons) {
            let frames = Course::Blocks.followed(lesson.room.frame_count());
            let latents = tracker.maps()[0].navigator().latents();
            let stretch = Stretch {
                latents,
                poses: lesson.room.poses(),
                frames: &frames,
            };

            surprises.extend(follow(tracker, &[stretch], 1, Begin::Known).place_surprises());
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
    ELLIPSOIDS.map(|limit| {
        surprises.iter().filter(|&&x| x <= limit).count() as f64 / surprises.len() as f64
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition: no frame is both mapped and followed.
    #[test]
    fn what_is_followed_is_not_mapped() {
        for course in Course::ALL {
            let mapped = course.mapped(400);
            let followed = course.followed(400);
            assert!(
                followed.iter().all(|frame| !mapped.contains(frame)),
                "{}",
                course.name()
            );

            assert!(
                mapped.len() >= 160 && followed.len() >= 80,
                "{}",
                course.name()
            );
        }

        assert!(
            !Course::Blocks.mapped(400).contains(&FrameId(40))
                && Course::Blocks.mapped(400).contains(&FrameId(38))
        );
    }

    /// Oracle: the table of χ² with six degrees of freedom.
    #[test]
    fn coverage_counts_what_is_within() {
        assert_eq!(coverage(&[1.0, 7.0, 7.1, 12.5, 20.0]), [0.4, 0.8]);
    }
}
