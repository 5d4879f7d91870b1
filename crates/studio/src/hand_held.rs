//! Paths of a hand-held camera in a room.
//!
//! The camera moves between a few standpoints and a few viewing directions. Each move is one
//! minimum-jerk stroke, like an arm's, followed by a rest. Position, view and roll change
//! independently. The camera therefore revisits earlier poses in all six dimensions, each time
//! with a small offset and on a different path.

use nalgebra::{SVector, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::FRAMES_PER_SECOND;
use super::camera_path::{looking, posed};
use seese3_core::geometry::Pose;
use seese3_core::statistics::normal_deviates;

/// Distribution of standpoints and views, and speeds.
#[derive(Debug, Clone)]
pub(super) struct Habit {
    /// Center of the standpoints, metres.
    pub middle: Vector3<f64>,
    /// Maximum offset of a standpoint from the center along each axis, metres.
    pub reach: Vector3<f64>,
    /// Center of the views, as yaw and pitch, radians.
    pub view: [f64; 2],
    /// Maximum offset of a view from the center, as yaw and pitch, radians.
    pub view_reach: [f64; 2],
    /// Standard deviation of the roll, radians.
    pub roll: f64,
    /// Mean translation speed of a stroke, metres per second.
    pub speed: f64,
    /// Mean rotation speed of a stroke, radians per second.
    pub turning: f64,
    /// The longest rest between two strokes, seconds.
    pub rest: f64,
}

/// The standpoints and views in a room, shared by all visits.
#[derive(Debug, Clone)]
pub(super) struct Goals {
    habit: Habit,
    standpoints: Vec<SVector<f64, 3>>,
    views: Vec<SVector<f64, 2>>,
}

/// Standard deviations of the offset when a standpoint, metres, or a view, radians, is revisited.
const MISS: [f64; 2] = [0.06, 0.06];

impl Goals {
    /// Draws five to nine standpoints and six to twelve views.
    pub fn new(habit: Habit, random: &mut ChaCha8Rng) -> Self {
        let standpoints = (0..random.random_range(5..10))
            .map(|_| {
                let part = Vector3::from_fn(|_, _| random.random_range(-1.0..1.0));
                habit.middle + habit.reach.component_mul(&part)
            })
            .collect();

        let views = (0..random.random_range(6..13))
            .map(|_| {
                SVector::from_fn(|axis, _| {
                    habit.view[axis] + habit.view_reach[axis] * random.random_range(-1.0..1.0)
                })
            })
            .collect();

        Self {
            habit,
            standpoints,
            views,
        }
    }

    /// `frame_count` poses of one visit, `world_from_camera`, metres.
    pub fn visit(&self, frame_count: usize, random: &mut ChaCha8Rng) -> Vec<Pose> {
        let habit = &self.habit;
        let low = habit.middle - habit.reach;
        let high = habit.middle + habit.reach;

        let positions = strokes(
            frame_count,
            habit.speed,
            habit.rest,
            random,
            |now, random| {
                let goal = near_one(&self.standpoints, now, MISS[0], random);
                goal.zip_zip_map(&low, &high, |at, low, high| at.clamp(low, high))
            },
        );
        let views = strokes(
            frame_count,
            habit.turning,
            habit.rest,
            random,
            |now, random| near_one(&self.views, now, MISS[1], random),
        );
        let rolls = strokes(frame_count, 0.1, habit.rest, random, |_, random| {
            habit.roll * deviation::<1>(random)
        });

        // Tremor of the hand: position in metres, then yaw, pitch and roll in radians.
        let tremor: [Tremor; 6] =
            std::array::from_fn(|axis| Tremor::new(if axis < 3 { 0.005 } else { 0.006 }, random));

        (0..frame_count)
            .map(|frame| {
                let shaken = |axis: usize| tremor[axis].at(frame);
                let at = positions[frame] + Vector3::from_fn(|axis, _| shaken(axis));
                let [yaw, pitch] = [views[frame][0] + shaken(3), views[frame][1] + shaken(4)];

                posed(at, looking(yaw, pitch, rolls[frame][0] + shaken(5)))
            })
            .collect()
    }
}

/// The nearer of two random goals, plus noise of standard deviation `miss`. Nearby goals are more
/// likely, as for a person.
fn near_one<const N: usize>(
    goals: &[SVector<f64, N>],
    now: Option<SVector<f64, N>>,
    miss: f64,
    random: &mut ChaCha8Rng,
) -> SVector<f64, N> {
    let mut draw = || goals[random.random_range(0..goals.len())];
    let [one, other] = [draw(), draw()];
    let apart = |goal: &SVector<f64, N>| now.map_or(0.0, |now| (goal - now).norm());
    let nearer = if apart(&one) <= apart(&other) {
        one
    } else {
        other
    };

    nearer + miss * deviation(random)
}

fn deviation<const N: usize>(random: &mut ChaCha8Rng) -> SVector<f64, N> {
    SVector::from_iterator(normal_deviates(random, N))
}

/// `frame_count` values that move from goal to goal in strokes of mean speed `speed`, per second,
/// with a rest of up to `rest` seconds at each goal.
///
/// A stroke has minimum jerk: after the fraction τ of its time, it has covered 10 τ³ − 15 τ⁴ + 6 τ⁵
/// of its length (Flash and Hogan 1985). The nominal duration is at least 0.5 s, varied by −20 % to
/// +25 %.
fn strokes<const N: usize>(
    frame_count: usize,
    speed: f64,
    rest: f64,
    random: &mut ChaCha8Rng,
    mut goal: impl FnMut(Option<SVector<f64, N>>, &mut ChaCha8Rng) -> SVector<f64, N>,
) -> Vec<SVector<f64, N>> {
    let mut from = goal(None, random);
    let mut values = Vec::with_capacity(frame_count);

    while values.len() < frame_count {
        let to = goal(Some(from), random);
        let seconds = ((to - from).norm() / speed).max(0.5) * random.random_range(0.8..1.25);
        let frames = (seconds * FRAMES_PER_SECOND).ceil();
        values.extend((0..frames as usize).map(|frame| {
            let share = frame as f64 / frames;
            let done = share.powi(3) * (10.0 - 15.0 * share + 6.0 * share * share);
            from + (to - from) * done
        }));

        let rest = (random.random_range(0.0..1.0) * rest * FRAMES_PER_SECOND) as usize;
        values.extend(std::iter::repeat_n(to, rest));
        from = to;
    }

    values.truncate(frame_count);
    values
}

/// Hand tremor along one axis: three oscillations of about 0.7, 2 and 6 Hz.
struct Tremor {
    /// Amplitude, angular frequency (radians per frame) and phase of each oscillation.
    waves: [[f64; 3]; 3],
}

impl Tremor {
    fn new(amplitude: f64, random: &mut ChaCha8Rng) -> Self {
        let waves = [(0.7, 1.0), (2.0, 0.4), (6.0, 0.12)].map(|(hertz, share)| {
            let hertz = hertz * random.random_range(0.7..1.4);
            let turn = std::f64::consts::TAU * hertz / FRAMES_PER_SECOND;
            let phase = random.random_range(0.0..std::f64::consts::TAU);
            [amplitude * share, turn, phase]
        });

        Self { waves }
    }

    fn at(&self, frame: usize) -> f64 {
        self.waves
            .iter()
            .map(|[amplitude, turn, phase]| amplitude * (turn * frame as f64 + phase).sin())
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    /// Oracle: the definition of a stroke. It begins and ends at rest at its goals and does not
    /// overshoot. Its peak speed is 1.875 times its mean speed.
    #[test]
    fn a_stroke_goes_from_goal_to_goal_and_rests_there() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut goals = [0.0, 1.0].into_iter().cycle();
        let values = strokes(300, 0.5, 0.0, &mut random, |_, _| {
            SVector::<f64, 1>::new(goals.next().unwrap())
        });

        let steps: Vec<f64> = values
            .windows(2)
            .map(|pair| (pair[1] - pair[0])[0])
            .collect();
        let fastest = steps
            .iter()
            .fold(0.0, |most: f64, step| most.max(step.abs()));

        // A stroke of length 1 at speed 0.5 takes 2 s nominally, at least 0.8 times that.
        assert!(fastest < 1.01 * 1.875 * 0.5 / 0.8 / FRAMES_PER_SECOND);
        assert!(values.iter().all(|value| (0.0..=1.0).contains(&value[0])));
        assert!(steps[0].abs() < 1e-3 && values.iter().any(|value| value[0] > 0.999));
    }
}
