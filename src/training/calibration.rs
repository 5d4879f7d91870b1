//! What a tracker has to know of an adapter's errors, measured in rooms that it did not learn from.
//!
//! Errors are heavy-tailed and differ from room to room: shapes are those of Student's t, and one
//! factor then balances the shares within the 68 % and the 95 % ellipsoids.

use nalgebra::{Matrix6, Vector6};
use ndarray::{Array2, ArrayView2, Axis, s};

use super::{Error, Lesson, check_lessons, check_unseen};
use crate::adapter::{
    self, Adapter, BESIDE, Calibration, ELLIPSOIDS, ErrorTable, Measured, Metric, MotionErrors,
    PairPlan, RECENT, Stratum, TrainingRecord,
};
use crate::geometry::{Pose, body_twist, exp};
use crate::index::{ExactIndex, Exclusion, Index};
use crate::pairs::{Pair, Split};
use crate::room::FrameId;
use crate::scores::median;

/// The shares wanted within [`ELLIPSOIDS`], and how far off counts as one.
const WANTED: [(f64, f64); 2] = [(0.68, 0.08), (0.945, 0.035)];
/// Degrees of freedom of the t that shapes are fitted by.
const TAILS: f64 = 4.0;
/// u₀ of [`MotionErrors`]: what u is for frames that follow one another.
const FLOOR: f64 = 0.05;
/// Frames to each side of a query that are left out of the map, one round each: matches of every
/// distance.
const LEFT_OUT: [u32; 10] = [0, 1, 2, 4, 6, 8, 10, 15, 20, 30];
/// Strata of anchors.
const STRATA: usize = 8;
/// Factors that are tried: from a hundredth on, each one and a half percent above the one before,
/// to a hundred.
const LEAST_FACTOR: f64 = 0.01;
const FACTOR_STEP: f64 = 1.015;
const FACTORS: i32 = 620;
/// Every so many frames of another room are looked for in a room.
const FOREIGN_EVERY: usize = 4;
/// Parts of a room's way, of which every fifth is looked for in the others.
const PARTS: usize = 20;
/// A room's limit lies between the distances of these shares of its own frames and of others'.
const OWN_AND_OTHERS: [f64; 2] = [0.97, 0.02];
/// The share of other rooms' frames below the sure limit.
const OTHERS_SURE: f64 = 0.0003;

/// A room through the adapter.
struct Seen<'a> {
    poses: &'a [Pose],
    /// Row by frame, (n, c).
    coordinates: Array2<f64>,
    latents: Array2<f64>,
}

/// Measures an adapter's errors in two or more rooms that it did not learn from.
///
/// # Errors
/// [`Error`], when a room was learned from, there are too few, or they are too short.
pub fn calibrate(
    adapter: &Adapter,
    record: &TrainingRecord,
    lessons: &[Lesson<'_>],
) -> Result<Calibration, Error> {
    check_lessons(lessons)?;

    if lessons.len() < 2 {
        return Err(Error::FewRooms {
            least: 2,
            given: lessons.len(),
        });
    }

    let mut rooms = Vec::with_capacity(lessons.len());
    for lesson in lessons {
        check_unseen(lesson, record.rooms.iter().map(|(room, _)| room))?;
        adapter.check_source(lesson.features.source())?;
        let latents = adapter.embed(lesson.features.rows())?;
        let coordinates = latents
            .slice(s![.., ..adapter.coordinate_count()])
            .to_owned();
        rooms.push(Seen {
            poses: lesson.room.poses(),
            coordinates,
            latents,
        });
    }

    let pairs = |stride: u32| -> Vec<(usize, Pair)> {
        let of = |(room, lesson): (usize, &Lesson<'_>)| {
            let pairs = Split::Whole
                .train_pairs(lesson.room.timeline(), stride)
                .unwrap_or_default();
            pairs
                .into_iter()
                .map(move |pair| (room, pair))
                .collect::<Vec<_>>()
        };

        lessons.iter().enumerate().flat_map(of).collect()
    };

    let flicker = second_moment(&rooms, &pairs(1))? * 0.5;
    let all: Vec<(usize, Pair)> = strides(&record.pairs).into_iter().flat_map(pairs).collect();
    let spread = second_moment(&rooms, &all)?;

    let white: Vec<Array2<f64>> = {
        let metric = Metric::new(flicker.view())?;
        rooms
            .iter()
            .map(|room| metric.whitened(room.coordinates.view()))
            .collect()
    };

    let mut shapes = Vec::new();
    for stride in strides(&record.pairs) {
        let residuals = residuals(
            adapter,
            &rooms,
            &pairs(stride),
            &Metric::new(spread.view())?,
        );
        let covariance = balanced(&residuals).ok_or(NOT_SOUND)?;

        shapes.push(Stratum {
            at: f64::from(stride),
            gain: 1.0,
            covariance,
        });
    }

    let motion = MotionErrors {
        shapes: ErrorTable::new(shapes)?,
        floor: FLOOR,
    };

    let anchor = anchor_errors(adapter, &rooms, &white)?;
    let [foreign, sure] = limits(&white)?;
    let jump = jump(&white)?;

    Ok(Calibration::new(Measured {
        flicker,
        spread,
        motion,
        anchor,
        foreign,
        sure,
        jump,
        place: 1.0,
    })?)
}

/// 1, 2, 3, 5, 8, ... up to the longest stride that was trained on, and that one.
fn strides(plan: &PairPlan) -> Vec<u32> {
    let longest = match plan {
        PairPlan::Stride(stride) => *stride,
        PairPlan::Range(range) => range.high,
    };

    let mut strides = vec![1, 2];
    while let [.., a, b] = strides[..]
        && a + b < longest
    {
        strides.push(a + b);
    }

    strides.retain(|&stride| stride < longest);
    strides.push(longest);

    strides
}

/// Mean of d dᵀ over the differences of latents of pairs.
fn second_moment(rooms: &[Seen<'_>], pairs: &[(usize, Pair)]) -> Result<Array2<f64>, Error> {
    let size = rooms[0].coordinates.ncols();
    if pairs.len() <= size {
        return Err(Error::Adapter(adapter::Error::NoPairs));
    }

    let mut differences = Array2::zeros((pairs.len(), size));
    for ((room, pair), mut row) in pairs.iter().zip(differences.axis_iter_mut(Axis(0))) {
        let coordinates = &rooms[*room].coordinates;
        row.assign(&(&coordinates.row(pair.target.row()) - &coordinates.row(pair.source.row())));
    }

    let moment = differences.t().dot(&differences) / pairs.len() as f64;
    Ok((&moment + &moment.t()) * 0.5)
}

/// Errors of the motions read over pairs, divided by the root of u + u₀.
fn residuals(
    adapter: &Adapter,
    rooms: &[Seen<'_>],
    pairs: &[(usize, Pair)],
    spread: &Metric,
) -> Vec<Vector6<f64>> {
    let residual = |(room, pair): &(usize, Pair)| {
        let Seen {
            poses,
            coordinates,
            latents,
        } = &rooms[*room];

        let from = pair.source.row();
        let to = pair.target.row();
        let read = adapter
            .displacement(latents.row(from), latents.row(to))
            .to_vector();

        let u = spread.squared_length((&coordinates.row(to) - &coordinates.row(from)).view());
        (body_twist(&poses[from], &poses[to]).to_vector() - read) / (u + FLOOR).sqrt()
    };

    pairs.iter().map(residual).collect()
}

const NOT_SOUND: Error = Error::Adapter(adapter::Error::Calibration {
    what: "the covariance of errors",
});

/// Errors of a pose retrieved at every distance, in as many strata with as many queries each.
fn anchor_errors(
    adapter: &Adapter,
    rooms: &[Seen<'_>],
    white: &[Array2<f64>],
) -> Result<ErrorTable, Error> {
    /// A retrieved pose: its distance, the motion read from it to the query, and the true one.
    struct Found {
        distance: f64,
        read: Vector6<f64>,
        truth: Vector6<f64>,
    }

    let mut found = Vec::new();
    for (Seen { poses, latents, .. }, white) in rooms.iter().zip(white) {
        let index = index_of(white.view());
        for radius in LEFT_OUT {
            for row in 0..white.nrows() {
                let exclusion = Exclusion {
                    centre: FrameId(row as u32),
                    radius,
                };

                let Some(best) = index
                    .nearest(&white.row(row).to_vec(), 1, Some(exclusion))
                    .first()
                    .copied()
                else {
                    continue;
                };

                let at = best.frame.row();
                let read = adapter
                    .displacement(latents.row(at), latents.row(row))
                    .to_vector();

                let truth = body_twist(&poses[at], &poses[row]).to_vector();
                found.push(Found {
                    distance: best.distance,
                    read,
                    truth,
                });
            }
        }
    }

    found.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let scale = adapter.scale().deviation;
    let mut strata: Vec<Stratum> = Vec::new();
    for part in found.chunks(found.len().div_ceil(STRATA).max(1)) {
        let at = median(&part.iter().map(|found| found.distance).collect::<Vec<_>>());

        // Twists of one unit, so that no component drowns another.
        let product = |of: fn(&Found) -> [Vector6<f64>; 2]| {
            part.iter()
                .map(|found| of(found).map(|x| x.component_div(&scale)))
                .map(|[a, b]| a.dot(&b))
                .sum::<f64>()
        };
        let slope =
            product(|found| [found.truth, found.read]) / product(|found| [found.read, found.read]);

        let gain = if slope.is_finite() {
            slope.clamp(0.0, 1.0)
        } else {
            0.0
        };

        let residual = |found: &Found| {
            let moved = exp(&crate::geometry::Twist::from_vector(&(found.read * gain)));
            body_twist(
                &moved,
                &exp(&crate::geometry::Twist::from_vector(&found.truth)),
            )
            .to_vector()
        };

        let residuals: Vec<Vector6<f64>> = part.iter().map(residual).collect();

        // Repeated images are at no distance at all: they go with the next stratum.
        if at > strata.last().map_or(0.0, |last| last.at) && residuals.len() > 6 {
            strata.push(Stratum {
                at,
                gain,
                covariance: balanced(&residuals).ok_or(NOT_SOUND)?,
            });
        }
    }

    Ok(ErrorTable::new(strata)?)
}

fn index_of(white: ArrayView2<'_, f64>) -> ExactIndex {
    let frames: Vec<FrameId> = (0..white.nrows() as u32).map(FrameId).collect();
    ExactIndex::new(white, &frames)
}

/// The shape of errors by a t, times the factor that balances the shares within both ellipsoids.
/// None when the errors do not span six dimensions.
fn balanced(residuals: &[Vector6<f64>]) -> Option<Matrix6<f64>> {
    let count = residuals.len() as f64;
    let moment = |weight: &dyn Fn(&Vector6<f64>) -> f64| {
        residuals.iter().fold(Matrix6::zeros(), |sum, r| {
            sum + r * r.transpose() * weight(r)
        }) / count
    };
    let mut shape = moment(&|_| 1.0);

    for _ in 0..30 {
        let inverse = shape.cholesky()?.inverse();
        shape = moment(&|r| (TAILS + 6.0) / (TAILS + r.dot(&(inverse * r))));
    }

    let inverse = shape.cholesky()?.inverse();
    let mut lengths: Vec<f64> = residuals.iter().map(|r| r.dot(&(inverse * r))).collect();

    Some((shape + shape.transpose()) * (0.5 * balancing_factor(&mut lengths)?))
}

/// What a covariance has to be multiplied with so that both shares of errors within its ellipsoids
/// are nearest to their wishes; `lengths` are the errors' squared Mahalanobis lengths, which are
/// put in order. None without any.
pub fn balancing_factor(lengths: &mut [f64]) -> Option<f64> {
    lengths.sort_by(f64::total_cmp);
    let factors = (0..FACTORS).map(|step| LEAST_FACTOR * FACTOR_STEP.powi(step));

    factors
        .min_by(|a, b| off(lengths, *a).total_cmp(&off(lengths, *b)))
        .filter(|_| !lengths.is_empty())
}

/// How far the shares of errors within both ellipsoids are from their wishes: the larger of the
/// two, 1 where it is a tolerance off. None without any.
pub fn imbalance(lengths: &mut [f64]) -> Option<f64> {
    lengths.sort_by(f64::total_cmp);
    (!lengths.is_empty()).then(|| off(lengths, 1.0))
}

/// The same of ordered lengths, if covariances were multiplied with a factor.
fn off(lengths: &[f64], factor: f64) -> f64 {
    let share = |limit: f64| {
        lengths.partition_point(|&length| length <= limit) as f64 / lengths.len() as f64
    };
    let of = |(ellipsoid, (wanted, unit)): (&f64, &(f64, f64))| {
        (share(ellipsoid * factor) - wanted).abs() / unit
    };

    ELLIPSOIDS.iter().zip(&WANTED).map(of).fold(0.0, f64::max)
}

/// The distance from a room over the room's own that parts its frames from other rooms', and the
/// one that hardly a frame of another room is below. A room's own frames are those of parts of its
/// way that the map lacks.
fn limits(white: &[Array2<f64>]) -> Result<[f64; 2], Error> {
    let mut own = Vec::new();
    let mut others = Vec::new();
    for (place, room) in white.iter().enumerate() {
        let part = room.nrows().div_ceil(PARTS).max(1);
        let is_mapped = |row: &usize| (row / part) % 5 != 2;
        let mapped: Vec<FrameId> = (0..room.nrows())
            .filter(is_mapped)
            .map(|row| FrameId(row as u32))
            .collect();
        let index = ExactIndex::new(room.view(), &mapped);

        let apart = mapped.iter().filter_map(|&centre| {
            let exclusion = Exclusion {
                centre,
                radius: BESIDE,
            };

            Some(
                index
                    .nearest(&room.row(centre.row()).to_vec(), 1, Some(exclusion))
                    .first()?
                    .distance,
            )
        });

        let typical = median(&apart.collect::<Vec<_>>());
        let score = |row: ndarray::ArrayView1<'_, f64>| {
            Some(index.nearest(&row.to_vec(), 1, None).first()?.distance / typical)
        };
        own.extend(
            (0..room.nrows())
                .filter(|row| !is_mapped(row))
                .filter_map(|row| score(room.row(row))),
        );

        for other in white
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != place)
            .map(|(_, rows)| rows)
        {
            others.extend(other.outer_iter().step_by(FOREIGN_EVERY).filter_map(score));
        }
    }

    let limits =
        quantile(&mut own, OWN_AND_OTHERS[0]).zip(quantile(&mut others, OWN_AND_OTHERS[1]));
    let ((of_own, of_others), sure) = limits
        .zip(quantile(&mut others, OTHERS_SURE))
        .ok_or(Error::Adapter(adapter::Error::NoPairs))?;

    Ok([(of_own * of_others).sqrt(), sure])
}

/// Between how far a frame is from the nearest of those before it, and how far one of another room
/// would be.
fn jump(white: &[Array2<f64>]) -> Result<f64, Error> {
    let nearest = |row: ndarray::ArrayView1<'_, f64>, room: &Array2<f64>, before: usize| {
        let distance = |other: usize| (&row - &room.row(other)).mapv(|x| x * x).sum().sqrt();
        (before.saturating_sub(RECENT)..before)
            .map(distance)
            .fold(f64::INFINITY, f64::min)
    };

    let mut own = Vec::new();
    let mut others = Vec::new();
    for (place, room) in white.iter().enumerate() {
        own.extend((RECENT..room.nrows()).map(|row| nearest(room.row(row), room, row)));

        for other in white
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != place)
            .map(|(_, rows)| rows)
        {
            for before in [room.nrows() / 2, room.nrows()] {
                others.extend(
                    [0, other.nrows() / 2].map(|row| nearest(other.row(row), room, before)),
                );
            }
        }
    }

    let longest = quantile(&mut own, 0.999);
    let shortest = quantile(&mut others, 0.01);
    let (longest, shortest) = longest
        .zip(shortest)
        .ok_or(Error::Adapter(adapter::Error::NoPairs))?;

    Ok((longest * shortest).sqrt())
}

fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values
        .get((values.len().saturating_sub(1) as f64 * share).round() as usize)
        .copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition of a covariance: of normal errors it is their own, and both shares
    /// are near their wishes.
    #[test]
    fn the_shape_of_normal_errors_is_theirs() {
        use rand::{RngExt, SeedableRng};

        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        let mut normal = || (0..12).map(|_| random.random_range(0.0..1.0)).sum::<f64>() - 6.0;
        let deviations = Vector6::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03);
        let drawn: Vec<Vector6<f64>> = (0..20_000)
            .map(|_| Vector6::from_fn(|_, _| normal()).component_mul(&deviations))
            .collect();
        let found = balanced(&drawn).unwrap();

        for (axis, deviation) in deviations.iter().enumerate() {
            let ratio = found[(axis, axis)].sqrt() / deviation;
            assert!((0.95..1.05).contains(&ratio), "axis {axis}: {ratio}");
        }

        let mut lengths = vec![4.0 * 7.0, 4.0 * 7.0, 4.0 * 12.0];
        assert!(
            (3.9..4.4).contains(&balancing_factor(&mut lengths).unwrap()),
            "two of three within the inner one"
        );

        assert!(balancing_factor(&mut []).is_none());

        let flat: Vec<Vector6<f64>> = drawn
            .iter()
            .map(|r| Vector6::new(r[0], r[1], 0.0, r[3], r[4], r[5]))
            .collect();

        assert!(
            balanced(&flat).is_none(),
            "errors that never leave a plane have no covariance"
        );
    }

    /// Oracle: by hand.
    #[test]
    fn strides_grow_to_the_longest() {
        assert_eq!(strides(&PairPlan::Stride(1)), [1]);
        assert_eq!(strides(&PairPlan::Stride(2)), [1, 2]);

        assert_eq!(
            strides(&PairPlan::Stride(40)),
            [1, 2, 3, 5, 8, 13, 21, 34, 40]
        );
    }
}
