//! The second moment of an adapter's errors in rooms that it did not learn from.

use nalgebra::Matrix6;

use super::{Error, Lesson, check_lessons, check_unseen};
use crate::adapter::{self, Adapter, PairPlan, TrainingRecord};
use crate::geometry::body_twist;
use crate::pairs::{self, Pair, Split};

/// The second moment of an adapter's errors, Σ = mean r rᵀ with r = ΔP − σ⊙W(g₂ − g₁), on (v, ω),
/// over all pairs of rooms that it did not learn from, at the strides it was trained on: the one,
/// or of a range every fifth from the lowest on and the highest.
///
/// # Errors
/// [`Error`], when a room was learned from, or has no pair.
pub fn error_covariance(
    adapter: &Adapter,
    record: &TrainingRecord,
    lessons: &[Lesson<'_>],
) -> Result<Matrix6<f64>, Error> {
    check_lessons(lessons)?;

    let strides: Vec<u32> = match &record.pairs {
        PairPlan::Stride(stride) => vec![*stride],
        PairPlan::Range(range) => {
            let mut strides: Vec<u32> = (range.low..=range.high).step_by(5).collect();
            strides.extend((strides.last() != Some(&range.high)).then_some(range.high));
            strides
        }
    };

    let mut sum = Matrix6::zeros();
    let mut count = 0usize;
    for lesson in lessons {
        check_unseen(lesson, record.rooms.iter().map(|(room, _)| room))?;
        adapter.check_source(lesson.features.source())?;
        let latents = adapter.embed(lesson.features.rows())?;
        let mean = adapter.scale().mean;

        let pairs: Vec<Pair> = strides
            .iter()
            .filter_map(|&s| Split::Whole.train_pairs(lesson.room.timeline(), s).ok())
            .flatten()
            .collect();

        if pairs.is_empty() {
            let frame_count = lesson.room.frame_count();
            let stride = strides[0];
            let split = Split::Whole;

            let problem = pairs::Error::NoPairs {
                frame_count,
                stride,
                split,
                side: "calibration",
            };

            return Err(Error::RoomPairs {
                room: lesson.room.id().clone(),
                problem,
            });
        }

        for pair in pairs {
            let [from, to] = [pair.source.row(), pair.target.row()];
            let seen = adapter
                .motion(latents.row(from), latents.row(to))
                .to_vector()
                - mean;

            let truth =
                body_twist(&lesson.room.poses()[from], &lesson.room.poses()[to]).to_vector();
            let residual = truth - seen;
            sum += residual * residual.transpose();

            count += 1;
        }
    }

    if count < 6 {
        return Err(Error::Adapter(adapter::Error::NoPairs));
    }

    Ok(sum / count as f64)
}
