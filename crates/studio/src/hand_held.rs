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
    /// Center of the standpoints, meters.
    pub middle: Vector3<f64>,
    /// Maximum offset of a standpoint from the center along each axis, meters.
    pub reach: Vector3<f64>,
    /// Center of the views, as yaw and pitch, radians.
    pub view: [f64; 2],
    /// Maximum offset of a view from the center, as yaw and pitch, radians.
    pub view_reach: [f64; 2],
    /// Standard deviation of the roll, radians.
    pub roll: f64,
    /// Mean translation speed of a stroke, meters per second.
    pub speed: f64,
    /// Mean rotation speed of a stroke, radians per second.
    pub turning: f64,
    /// The longest rest between two strokes, seconds.
    pub rest: f64,
    /// The shortest nominal duration of a stroke, seconds.
    pub shortest: f64,
    /// Width of the moving average that joins strokes, seconds; 0 to stop at every goal.
    pub flow: f64,
    /// Whether the nearer of two random goals is chosen, as by a person who looks around.
    pub stays_near: bool,
}

impl Habit {
    /// The same room filmed in slow sweeps that flow into each other, as for a 3D scan.
    pub fn sweeping(self) -> Self {
        Self {
            speed: SWEEP_SPEED * self.speed,
            turning: SWEEP_TURNING * self.turning,
            rest: 0.0,
            shortest: 1.2,
            flow: 1.0,
            stays_near: false,
            ..self
        }
    }
}

/// Speed and rotation speed of sweeps, in those of strokes.
const SWEEP_SPEED: f64 = 1.2;
const SWEEP_TURNING: f64 = 0.8;

/// The standpoints and views in a room, shared by all visits.
#[derive(Debug, Clone)]
pub(super) struct Goals {
    habit: Habit,
    standpoints: Vec<SVector<f64, 3>>,
    views: Vec<SVector<f64, 2>>,
}

/// Standard deviations of the offset when a standpoint, meters, or a view, radians, is revisited.
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

    /// The standpoints and views, filmed in another way.
    pub fn filmed(&self, habit: impl FnOnce(Habit) -> Habit) -> Self {
        Self {
            habit: habit(self.habit.clone()),
            ..self.clone()
        }
    }

    /// The path of one visit.
    pub fn path(&self, frame_count: usize, random: &mut ChaCha8Rng) -> HandPath {
        let habit = &self.habit;
        let low = habit.middle - habit.reach;
        let high = habit.middle + habit.reach;

        let positions = strokes(
            frame_count,
            habit.speed,
            habit.pauses(),
            random,
            |now, random| {
                let goal = self.next(&self.standpoints, now, MISS[0], random);
                goal.zip_zip_map(&low, &high, |at, low, high| at.clamp(low, high))
            },
        );
        let views = strokes(
            frame_count,
            habit.turning,
            habit.pauses(),
            random,
            |now, random| self.next(&self.views, now, MISS[1], random),
        );
        let rolls = strokes(frame_count, 0.1, habit.pauses(), random, |_, random| {
            habit.roll * deviation::<1>(random)
        });

        HandPath {
            positions,
            views,
            rolls,
        }
    }
}

impl Goals {
    /// The next goal, plus noise of standard deviation `miss`.
    fn next<const N: usize>(
        &self,
        goals: &[SVector<f64, N>],
        now: Option<SVector<f64, N>>,
        miss: f64,
        random: &mut ChaCha8Rng,
    ) -> SVector<f64, N> {
        let near = now.filter(|_| self.habit.stays_near);
        near_one(goals, near, miss, random)
    }
}

/// A path of the hand without its tremor, one entry per frame.
#[derive(Debug, Clone)]
pub(super) struct HandPath {
    /// Meters.
    positions: Vec<SVector<f64, 3>>,
    /// Yaw and pitch, radians.
    views: Vec<SVector<f64, 2>>,
    /// Radians.
    rolls: Vec<SVector<f64, 1>>,
}

impl HandPath {
    /// Whether the path has no frames.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// The poses with the tremor of the hand, `world_from_camera`, meters.
    pub fn poses(&self, random: &mut ChaCha8Rng) -> Vec<Pose> {
        // Position in meters, then yaw, pitch and roll in radians.
        let tremor: [Tremor; 6] =
            std::array::from_fn(|axis| Tremor::new(if axis < 3 { 0.005 } else { 0.006 }, random));

        (0..self.positions.len())
            .map(|frame| {
                let shaken = |axis: usize| tremor[axis].at(frame);
                let at = self.positions[frame] + Vector3::from_fn(|axis, _| shaken(axis));
                let view = self.views[frame];
                let [yaw, pitch] = [view[0] + shaken(3), view[1] + shaken(4)];

                posed(at, looking(yaw, pitch, self.rolls[frame][0] + shaken(5)))
            })
            .collect()
    }

    /// A later visit that follows this path for the most part: at other speeds, in stretches
    /// forward and backward, beside it and with other views. Positions stay between the corners
    /// `bounds`, meters. This path must not be empty.
    pub fn followed(
        &self,
        frame_count: usize,
        bounds: [Vector3<f64>; 2],
        way: &Return,
        random: &mut ChaCha8Rng,
    ) -> Self {
        let places = places_on(self.positions.len(), frame_count, way, random);
        let beside = strokes(
            frame_count,
            way.beside_speed,
            way.pauses,
            random,
            |_, random| {
                let [low, high] = if random.random_bool(ASIDE) {
                    [NEAR_M, FAR_M]
                } else {
                    [0.0, NEAR_M]
                };
                let (sine, cosine) = random.random_range(0.0..std::f64::consts::TAU).sin_cos();
                SVector::from([cosine, sine]) * random.random_range(low..high)
            },
        );
        let turned = strokes(
            frame_count,
            way.turn_speed,
            way.pauses,
            random,
            |_, random| {
                let usual: SVector<f64, 2> = TURN_RAD * deviation(random);
                let side = random.random_range(ELSEWHERE_RAD[0]..ELSEWHERE_RAD[1]);
                match random.random_range(0.0..1.0) {
                    share if share < ASIDE / 2.0 => usual + SVector::from([side, 0.0]),
                    share if share < ASIDE => usual - SVector::from([side, 0.0]),
                    _ => usual,
                }
            },
        );

        let [low, high] = bounds;
        let position = |frame: usize| {
            let offset = Vector3::new(beside[frame][0], beside[frame][1], 0.0);
            let at = between(&self.positions, places[frame]) + offset;
            at.zip_zip_map(&low, &high, |at, low, high| at.clamp(low, high))
        };
        Self {
            positions: (0..frame_count).map(position).collect(),
            views: (0..frame_count)
                .map(|frame| between(&self.views, places[frame]) + turned[frame])
                .collect(),
            rolls: places
                .iter()
                .map(|&place| between(&self.rolls, place))
                .collect(),
        }
    }
}

/// Largest offset from a followed path, meters, and the largest one where the path is left.
const NEAR_M: f64 = 0.3;
const FAR_M: f64 = 0.8;
/// Standard deviation of the difference of views along a followed path, radians.
const TURN_RAD: f64 = 0.1;
/// Range of the difference in yaw where a person looks elsewhere, radians.
const ELSEWHERE_RAD: [f64; 2] = [0.4, 1.2];
/// Share of the offsets, and of the views, that leave the followed path.
const ASIDE: f64 = 0.2;

/// How a person follows an earlier path.
#[derive(Debug, Clone)]
pub(super) struct Return {
    /// Mean speed at which the offset changes, meters per second.
    beside_speed: f64,
    /// Mean speed at which the difference of the views changes, radians per second.
    turn_speed: f64,
    /// Of the changes of offset and views.
    pauses: Pauses,
    /// Length of a stretch in one direction.
    stretch: Stretch,
    /// Share of the stretches that are walked backward.
    backward: f64,
    /// Range of the speed along a followed path, in speeds of the first visit.
    pace: [f64; 2],
}

impl Return {
    /// Like a person who looks around.
    pub const RESTLESS: Self = Self {
        beside_speed: 0.15,
        turn_speed: 0.3,
        pauses: Pauses::stops(1.0),
        stretch: Stretch::Frames([60, 180]),
        backward: 0.3,
        pace: [0.5, 1.2],
    };

    /// Like a person who scans the room again.
    pub const SWEEPING: Self = Self {
        beside_speed: 0.08,
        turn_speed: 0.12,
        pauses: Pauses {
            rest: 0.0,
            shortest: 2.0,
            flow: 1.2,
        },
        stretch: Stretch::Share([0.3, 0.9]),
        backward: 0.3,
        pace: [0.7, 1.4],
    };
}

/// Range of the length of a stretch.
#[derive(Debug, Clone, Copy)]
enum Stretch {
    /// In frames.
    Frames([usize; 2]),
    /// In lengths of the followed path.
    Share([f64; 2]),
}

/// How strokes follow each other, seconds; as in [`Habit`].
#[derive(Debug, Clone, Copy)]
struct Pauses {
    rest: f64,
    shortest: f64,
    flow: f64,
}

impl Pauses {
    /// Strokes that stop at every goal.
    const fn stops(rest: f64) -> Self {
        Self {
            rest,
            shortest: 0.5,
            flow: 0.0,
        }
    }
}

impl Habit {
    fn pauses(&self) -> Pauses {
        Pauses {
            rest: self.rest,
            shortest: self.shortest,
            flow: self.flow,
        }
    }
}

/// A change of speed takes twice this number of frames.
const SMOOTHED: usize = 8;

/// `frame_count` places on a path of `length` frames, in frames: stretches forward and backward,
/// each at a constant speed.
fn places_on(length: usize, frame_count: usize, way: &Return, random: &mut ChaCha8Rng) -> Vec<f64> {
    let last = length.saturating_sub(1) as f64;
    let mut at = last * random.random_range(0.0..0.3);
    let mut places = Vec::with_capacity(frame_count);

    while places.len() < frame_count {
        let drawn = match way.stretch {
            Stretch::Frames([low, high]) => random.random_range(low..high) as f64,
            Stretch::Share([low, high]) => last * random.random_range(low..high),
        };
        let pace = random.random_range(way.pace[0]..way.pace[1]);
        let frames = match way.stretch {
            Stretch::Frames(_) => drawn as usize,
            Stretch::Share(_) => (drawn / pace) as usize + 1,
        };
        let step = if random.random_bool(way.backward) {
            -pace
        } else {
            pace
        };

        // Turn round where the path would end.
        let is_inside = (0.0..=last).contains(&(at + step * frames as f64));
        let step = if is_inside { step } else { -step };
        for _ in 0..frames {
            places.push(at);
            at = (at + step).clamp(0.0, last);
        }
    }
    places.truncate(frame_count);

    // A mean of neighbors rounds off the changes of speed, and stays on the path.
    let places: Vec<SVector<f64, 1>> = places.into_iter().map(SVector::<f64, 1>::new).collect();
    let rounded = averaged(&places, SMOOTHED);
    rounded.into_iter().map(|place| place[0]).collect()
}

/// The mean of each value and up to `reach` neighbors on each side.
fn averaged<const N: usize>(values: &[SVector<f64, N>], reach: usize) -> Vec<SVector<f64, N>> {
    (0..values.len())
        .map(|frame| {
            let end = (frame + reach + 1).min(values.len());
            let near = &values[frame.saturating_sub(reach)..end];
            near.iter().sum::<SVector<f64, N>>() / near.len() as f64
        })
        .collect()
}

/// The value at a place between two frames.
fn between<const N: usize>(values: &[SVector<f64, N>], place: f64) -> SVector<f64, N> {
    let before = place.floor() as usize;
    let after = (before + 1).min(values.len() - 1);
    values[before].lerp(&values[after], place.fract())
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
/// with a rest at each goal.
///
/// A stroke has minimum jerk: after the fraction τ of its time, it has covered 10 τ³ − 15 τ⁴ + 6 τ⁵
/// of its length (Flash and Hogan 1985). The nominal duration is varied by −20 % to +25 %. A moving
/// average, applied twice, joins strokes that flow into each other.
fn strokes<const N: usize>(
    frame_count: usize,
    speed: f64,
    pauses: Pauses,
    random: &mut ChaCha8Rng,
    mut goal: impl FnMut(Option<SVector<f64, N>>, &mut ChaCha8Rng) -> SVector<f64, N>,
) -> Vec<SVector<f64, N>> {
    let mut from = goal(None, random);
    let mut values = Vec::with_capacity(frame_count);

    while values.len() < frame_count {
        let to = goal(Some(from), random);
        let seconds =
            ((to - from).norm() / speed).max(pauses.shortest) * random.random_range(0.8..1.25);
        let frames = (seconds * FRAMES_PER_SECOND).ceil();
        values.extend((0..frames as usize).map(|frame| {
            let share = frame as f64 / frames;
            let done = share.powi(3) * (10.0 - 15.0 * share + 6.0 * share * share);
            from + (to - from) * done
        }));

        let rest = random.random_range(0.0..1.0) * pauses.rest;
        let rest = (rest * FRAMES_PER_SECOND) as usize;
        values.extend(std::iter::repeat_n(to, rest));
        from = to;
    }

    values.truncate(frame_count);
    let reach = (0.5 * pauses.flow * FRAMES_PER_SECOND) as usize;
    averaged(&averaged(&values, reach), reach)
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
        let values = strokes(300, 0.5, Pauses::stops(0.0), &mut random, |_, _| {
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
