//! Motion prior: the velocity statistics of the camera that mapped the room.
//!
//! The velocity is an Ornstein–Uhlenbeck process, a random walk with mean reversion to zero. Over a
//! short time the expected velocity is constant; over a long time it decays to zero. All times are
//! in seconds, not in frames.

use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3};

use super::clock::seconds_between;
use seese3_core::geometry::{Twist, body_twist};
use seese3_core::room::{FrameId, Room};
use seese3_core::statistics::quantile;

/// Covariance of a pose and a velocity.
pub(crate) type Matrix12 = SMatrix<f64, 12, 12>;

/// Approximate lag of the velocity autocorrelation, seconds.
const LAG_S: f64 = 0.2;
/// Longest interval of mapped frames from which a velocity is computed, seconds.
const LONGEST_STEP_S: f64 = 0.5;
/// Minimum number of velocities for a prior of the room; otherwise the default is used.
const FEWEST_VELOCITIES: usize = 20;
/// Range of the velocity's correlation time, seconds.
const DURATION_RANGE_S: (f64, f64) = (0.05, 5.0);
/// Largest multiple of the 90 % quantile of speeds that is a speed: a recording may jump.
const FASTEST: f64 = 5.0;
/// Variance added to each velocity component, (m/s)² and (rad/s)²: 1 cm/s and about 0.6°/s.
const LEAST_VARIANCE: f64 = 1e-4;
/// Default prior: 0.5 m/s and 0.5 rad/s along every axis, with a correlation time of 0.5 s.
const ASSUMED_VARIANCE: f64 = 0.25;
const ASSUMED_DURATION_S: f64 = 0.5;

/// Statistics of a camera's velocity in its body frame, on (v, ω).
#[derive(Debug, Clone, PartialEq)]
pub struct MotionPrior {
    linear: Part,
    angular: Part,
}

/// Statistics of the linear or the angular velocity.
#[derive(Debug, Clone, PartialEq)]
struct Part {
    /// Second moment, m²/s² or rad²/s².
    variance: Matrix3<f64>,
    /// Correlation time (decay to 1/e), seconds.
    duration_s: f64,
}

/// Transition of the process over a time, per component.
struct Decay {
    /// Expected final velocity divided by the initial velocity.
    left: f64,
    /// Expected displacement divided by the initial velocity, seconds.
    reach_s: f64,
    /// Variance of the displacement, its covariance with the final velocity, and the variance of
    /// the final velocity, for a known initial velocity and a stationary variance of 1.
    way: f64,
    way_velocity: f64,
    velocity: f64,
}

/// Predicted motion over a time.
pub(crate) struct Drift {
    /// Expected motion.
    pub motion: Twist,
    /// Expected final velocity.
    pub velocity: Twist,
    /// Derivatives of motion and final velocity with respect to the initial velocity, as factors of
    /// the identity for (v, ω).
    pub reach_s: [f64; 2],
    pub left: [f64; 2],
    /// Covariance of (motion, final velocity) for a known initial velocity.
    pub noise: Matrix12,
}

impl MotionPrior {
    /// Estimates the prior from the mapped frames of a room, given in order.
    pub fn of_path(room: &Room, mapped: &[FrameId]) -> Self {
        let mut steps: Vec<Option<(f64, Twist)>> = mapped
            .windows(2)
            .map(|pair| velocity(room, pair[0], pair[1]))
            .collect();
        drop_jumps(&mut steps);
        let known: Vec<&(f64, Twist)> = steps.iter().flatten().collect();
        if known.len() < FEWEST_VELOCITIES {
            return Self::assumed();
        }

        let period = known.iter().map(|(seconds, _)| seconds).sum::<f64>() / known.len() as f64;
        let lag = ((LAG_S / period).round() as usize).max(1);
        let part = |of: fn(&Twist) -> Vector3<f64>| Part {
            variance: second_moment(known.iter().map(|(_, twist)| of(twist))),
            duration_s: duration(&steps, lag, lag as f64 * period, of),
        };

        Self {
            linear: part(|twist| twist.linear),
            angular: part(|twist| twist.angular),
        }
    }

    /// Default prior.
    pub fn assumed() -> Self {
        let part = Part {
            variance: Matrix3::identity() * ASSUMED_VARIANCE,
            duration_s: ASSUMED_DURATION_S,
        };
        Self {
            linear: part.clone(),
            angular: part,
        }
    }

    /// Stationary covariance of the velocity, on (v, ω).
    pub fn velocity_covariance(&self) -> Matrix6<f64> {
        let mut covariance = Matrix6::zeros();
        for (part, at) in [(&self.linear, 0), (&self.angular, 3)] {
            covariance
                .fixed_view_mut::<3, 3>(at, at)
                .copy_from(&part.variance);
        }
        covariance
    }

    /// Predicts the motion of a camera with an initial velocity over a time, seconds.
    pub(crate) fn over(&self, velocity: &Twist, seconds: f64) -> Drift {
        let parts = [&self.linear, &self.angular];
        let decays = parts.map(|part| Decay::over(seconds, part.duration_s));

        let mut noise = Matrix12::zeros();
        for (at, (part, decay)) in parts.into_iter().zip(&decays).enumerate() {
            let (way, speed) = (3 * at, 6 + 3 * at);
            for (row, column, factor) in [
                (way, way, decay.way),
                (way, speed, decay.way_velocity),
                (speed, way, decay.way_velocity),
                (speed, speed, decay.velocity),
            ] {
                noise
                    .fixed_view_mut::<3, 3>(row, column)
                    .copy_from(&(part.variance * factor));
            }
        }

        let [linear, angular] = &decays;
        Drift {
            motion: Twist {
                linear: velocity.linear * linear.reach_s,
                angular: velocity.angular * angular.reach_s,
            },
            velocity: Twist {
                linear: velocity.linear * linear.left,
                angular: velocity.angular * angular.left,
            },
            reach_s: [linear.reach_s, angular.reach_s],
            left: [linear.left, angular.left],
            noise,
        }
    }
}

impl Decay {
    /// Source: the Ornstein–Uhlenbeck process integrated once; Gillespie, Phys. Rev. E 54, 2084
    /// (1996), equations 2.9 and 2.10, with D replaced by the stationary variance.
    fn over(seconds: f64, duration_s: f64) -> Self {
        let ratio = seconds / duration_s;
        let left = (-ratio).exp();
        let square = duration_s * duration_s;

        // For short times the closed form of the displacement variance loses precision by
        // cancellation; use its series.
        let way = if ratio < 5e-3 {
            ratio.powi(3) * (2.0 / 3.0 - ratio / 2.0 + 7.0 / 30.0 * ratio * ratio)
        } else {
            2.0 * ratio - 3.0 + 4.0 * left - left * left
        };
        Self {
            left,
            reach_s: duration_s * (1.0 - left),
            way: square * way,
            way_velocity: duration_s * (1.0 - left).powi(2),
            velocity: 1.0 - left * left,
        }
    }
}

/// Time and velocity between two mapped frames, if they are successive in one sequence.
fn velocity(room: &Room, from: FrameId, to: FrameId) -> Option<(f64, Twist)> {
    let seconds = seconds_between(room, from, to);
    let follows = room.timeline().joins(from, to) && seconds > 0.0 && seconds <= LONGEST_STEP_S;

    let motion = follows.then(|| body_twist(&room.poses()[from.row()], &room.poses()[to.row()]))?;
    let is_known = motion.is_unique_logarithm();
    is_known.then(|| (seconds, motion.scaled(seconds.recip())))
}

/// Drops velocities that are no motion of a camera.
fn drop_jumps(steps: &mut [Option<(f64, Twist)>]) {
    let speeds = steps.iter().flatten().map(|(_, velocity)| velocity.norm());
    let fast = quantile(&speeds.collect::<Vec<f64>>(), 0.9).unwrap_or(0.0);
    let is_motion = |(_, velocity): &(f64, Twist)| fast <= 0.0 || velocity.norm() <= FASTEST * fast;
    for step in steps {
        *step = step.filter(is_motion);
    }
}

fn second_moment(velocities: impl Iterator<Item = Vector3<f64>>) -> Matrix3<f64> {
    let mut sum = Matrix3::zeros();
    let mut count = 0.0;
    for velocity in velocities {
        sum += velocity * velocity.transpose();
        count += 1.0;
    }
    sum / count + Matrix3::identity() * LEAST_VARIANCE
}

/// Correlation time, seconds, from the correlation of velocities `lag` steps or `seconds` apart.
fn duration(
    steps: &[Option<(f64, Twist)>],
    lag: usize,
    seconds: f64,
    of: fn(&Twist) -> Vector3<f64>,
) -> f64 {
    let mut product = 0.0;
    let mut square = 0.0;
    for (now, later) in steps.iter().zip(steps.iter().skip(lag)) {
        if let (Some((_, now)), Some((_, later))) = (now, later) {
            product += of(now).dot(&of(later));
            square += 0.5 * (of(now).norm_squared() + of(later).norm_squared());
        }
    }

    let (least, most) = DURATION_RANGE_S;
    let correlation = product / square;
    if correlation.is_nan() || correlation <= 0.0 {
        return least;
    }
    if correlation >= 1.0 {
        return most;
    }
    (-seconds / correlation.ln()).clamp(least, most)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use seese3_core::geometry::{Pose, exp};
    use seese3_core::room::{Frames, Provenance, RoomId};
    use seese3_core::statistics::normal_deviates;

    /// Oracle: the definition of a Markov process: two successive transitions equal one over the
    /// total time.
    #[test]
    fn two_times_are_one_longer_time() {
        let duration_s = 0.7;
        for (first, second) in [(0.1, 0.3), (2.0, 0.05), (1e-4, 2e-4)] {
            let [a, b, both] =
                [first, second, first + second].map(|time| Decay::over(time, duration_s));

            // The second transition starts with the final velocity of the first.
            let way = a.way
                + 2.0 * b.reach_s * a.way_velocity
                + b.reach_s * b.reach_s * a.velocity
                + b.way;
            let way_velocity = b.left * (a.way_velocity + b.reach_s * a.velocity) + b.way_velocity;
            let velocity = b.left * b.left * a.velocity + b.velocity;

            for (found, expected) in [
                (way, both.way),
                (way_velocity, both.way_velocity),
                (velocity, both.velocity),
                (a.reach_s + a.left * b.reach_s, both.reach_s),
                (a.left * b.left, both.left),
            ] {
                assert!(
                    (found - expected).abs() < 1e-6 * expected,
                    "{found} {expected}"
                );
            }
        }
    }

    /// Oracle: a simulated path with known statistics, sampled at 15 Hz: 0.4 m/s per axis with 0.8
    /// s correlation time, and 0.3 rad/s with 0.3 s.
    #[test]
    fn a_path_tells_how_its_camera_moves() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let period = 1.0 / 15.0;
        let mut velocity = Twist::default();
        let mut pose = Pose::identity();
        let mut poses = Vec::new();

        // Simulate with 100 steps per sample, so that discretization errors are negligible.
        let step = period / 100.0;
        for number in 0..400_000 {
            if number % 100 == 0 {
                poses.push(pose);
            }
            let mut drawn = |deviation: f64, duration: f64, now: Vector3<f64>| {
                let left = (-step / duration).exp();
                let noise = deviation * (1.0 - left * left).sqrt();
                now * left + Vector3::from_iterator(normal_deviates(&mut random, 3)) * noise
            };
            velocity.linear = drawn(0.4, 0.8, velocity.linear);
            velocity.angular = drawn(0.3, 0.3, velocity.angular);
            pose *= exp(&velocity.scaled(step));
        }

        let times = (0..poses.len() as i64).map(|row| row * (period * 1e9) as i64);
        let frames = Frames {
            timestamps_ns: times.collect(),
            poses,
            ..Frames::default()
        };
        let room = Room::new(RoomId::new("a").unwrap(), frames, Provenance::default()).unwrap();
        let mapped: Vec<FrameId> = (0..room.frame_count() as u32).map(FrameId).collect();
        let prior = MotionPrior::of_path(&room, &mapped);

        for (part, deviation, duration) in [(&prior.linear, 0.4, 0.8), (&prior.angular, 0.3, 0.3)] {
            let found = (part.variance.trace() / 3.0).sqrt();
            assert!(
                (found / deviation - 1.0).abs() < 0.1,
                "{found} m/s, not {deviation}"
            );
            let found = part.duration_s;
            assert!(
                (found / duration - 1.0).abs() < 0.2,
                "{found} s, not {duration}"
            );
        }

        let few = MotionPrior::of_path(&room, &mapped[..10]);
        assert_eq!(few, MotionPrior::assumed());
    }

    /// Oracle: the definition: a constant velocity has the maximum correlation time.
    #[test]
    fn a_constant_velocity_lasts() {
        let twist = Twist {
            linear: Vector3::x() * 0.25,
            angular: Vector3::zeros(),
        };
        let steps = vec![Some((0.5, twist)); 40];
        assert_eq!(duration(&steps, 4, 0.2, |twist| twist.linear), 5.0);
    }
}
