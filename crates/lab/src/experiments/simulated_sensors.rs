//! Simulated wheels, inertial sensors and depths of a camera on a known path.

use nalgebra::{SVector, Unit, UnitQuaternion, Vector2, Vector3, Vector4, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::player::{PlayedView, Sensed, ViewInput};
use seese3_core::geometry::{CameraIntrinsics, Pose, Twist, body_twist, exp};
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::normal_deviates;
use seese3_robot::inertial::{GRAVITY_M_S2, InertialBuffer, InertialNoise, InertialSample};
use seese3_robot::matched_views::{MappedKeypoints, Mapping, MappingParameters};
use seese3_robot::pose_filter::MeasuredInertia;
use seese3_robot::tracking::{Drift, MeasuredPose};
use seese3_robot::visual_odometry::KnownDepth;

/// Simulated wheels: relative error of lengths, rotation per meter, and noise of each step along
/// each axis, meters.
const WHEEL_LENGTH_ERROR: f64 = 0.02;
const WHEEL_TURN_RAD: f64 = 0.017_453;
const WHEEL_NOISE_M: f64 = 5e-4;
/// The drift that they state.
const WHEEL_DRIFT: Drift = Drift {
    translation_share: 0.03,
    rotation_share: 0.03,
};

/// Simulated inertial sensor: time between samples, seconds; white noise of gyroscope and
/// accelerometer, rad/s/√Hz and m/s²/√Hz; standard deviations of their biases, rad/s and m/s². It
/// states [`InertialNoise::TYPICAL`].
const SAMPLE_S: f64 = 5e-3;
const DENSITIES: [f64; 2] = [2e-4, 3e-3];
const BIASES: [f64; 2] = [5e-3, 5e-2];
/// Simulated depth camera: standard deviation of a depth of 1 m, meters, growing with the square of
/// the depth; and the largest relative deviation of a triangulated depth that stands for a true
/// one.
const DEPTH_DEVIATION: f64 = 0.005;
const MAX_TRIANGULATION_DEVIATION: f64 = 0.1;
/// Half of the time over which the angular rate is computed, seconds.
const RATE_S: f64 = 5e-4;

/// What wheels say at each view: a wrong length, a rotation per meter about the image's vertical
/// axis, and noise.
pub(super) fn wheels(views: &[PlayedView<'_>], seed: u64) -> Vec<Sensed> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut sign = || if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let length = 1.0 + sign() * WHEEL_LENGTH_ERROR;
    let turn_rad = sign() * WHEEL_TURN_RAD;

    let mut pose = Pose::identity();
    let mut poses = vec![pose];
    for pair in views.windows(2) {
        let motion = body_twist(&pair[0].truth, &pair[1].truth);
        let noise = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0) * 3_f64.sqrt());
        let turn = Vector3::y() * (turn_rad * motion.linear.norm());
        pose *= exp(&Twist {
            linear: motion.linear * length + noise * WHEEL_NOISE_M,
            angular: motion.angular + turn,
        });
        poses.push(pose);
    }

    let sensed = |pose: Pose| Sensed {
        measured: Some(MeasuredPose {
            pose,
            drift: WHEEL_DRIFT,
            velocity_covariance: None,
        }),
        ..Sensed::default()
    };
    poses.into_iter().map(sensed).collect()
}

/// What a gyroscope and an accelerometer at the camera say at each view. Down is −z of the room.
pub(super) fn inertial(views: &[PlayedView<'_>], seed: u64) -> Vec<Sensed> {
    let down = Unit::new_unchecked(-Vector3::z());
    let mut buffer = InertialBuffer::default();
    for sample in samples(views, &down, seed) {
        buffer.push(sample);
    }

    let motion = |pair: &[PlayedView<'_>]| {
        buffer.between(pair[0].time_ns, pair[1].time_ns, InertialNoise::TYPICAL)
    };
    let motions = std::iter::once(None).chain(views.windows(2).map(motion));
    let sensed = motions.map(|motion| Sensed {
        inertia: motion.map(|motion| MeasuredInertia {
            motion,
            down_in_parent: Some(down),
        }),
        ..Sensed::default()
    });
    sensed.collect()
}

/// What a depth camera says at each view: depths of keypoints that are triangulated with the true
/// poses, with noise. Empty if the views have no keypoints or are too few.
pub(super) fn depths(
    views: &[PlayedView<'_>],
    camera: &CameraIntrinsics,
    seed: u64,
) -> Vec<Sensed> {
    let keypoints = views.iter().filter_map(|view| match view.input {
        ViewInput::Keypoints { keypoints, .. } => Some(keypoints.clone()),
        ViewInput::Feature { .. } => None,
    });
    let keypoints: Vec<Keypoints> = keypoints.collect();
    let poses: Vec<Pose> = views.iter().map(|view| view.truth).collect();
    if keypoints.len() < poses.len() {
        return Vec::new();
    }
    let Ok(mapping) = Mapping::new(&poses, &keypoints, *camera, MappingParameters::default())
    else {
        return Vec::new();
    };

    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut sensed = |keypoints: &Keypoints, mapped: &MappedKeypoints| {
        let noise: Vec<f64> = normal_deviates(&mut rng, mapped.len()).collect();
        let known = (0..mapped.len()).filter_map(|place| {
            let is_same = |point: &Vector2<f32>| *point == mapped.points[place];
            let keypoint = keypoints.points().iter().position(is_same)?;
            let depth_m = f64::from(mapped.inverse_depths[place]).recip();
            let by_sensor = DEPTH_DEVIATION * depth_m;
            let by_triangulation = f64::from(mapped.deviations[place]);
            let is_accurate = by_triangulation < MAX_TRIANGULATION_DEVIATION;
            is_accurate.then_some(KnownDepth {
                keypoint,
                depth_m: depth_m * (1.0 + by_sensor * noise[place]).max(0.1),
                deviation: by_sensor.hypot(by_triangulation),
            })
        });
        Sensed {
            depths: known.collect(),
            ..Sensed::default()
        }
    };
    let map = mapping.map(&|| ());
    let frames = keypoints.iter().zip(&map.frames);
    frames
        .map(|(keypoints, mapped)| sensed(keypoints, mapped))
        .collect()
}

/// Whether every view of some streams has simulated depths.
pub(super) fn has_depths(streams: &[&[PlayedView<'_>]], depths: &[Vec<Sensed>]) -> bool {
    let mut both = streams.iter().zip(depths);
    both.all(|(views, depths)| views.len() == depths.len())
}

fn samples(views: &[PlayedView<'_>], down: &Unit<Vector3<f64>>, seed: u64) -> Vec<InertialSample> {
    let [first, .., last] = views else {
        return Vec::new();
    };
    let path = Path::of(views);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut noise = |[gyroscope, accelerometer]: [f64; 2]| {
        let drawn = Vector6::from_iterator(normal_deviates(&mut rng, 6));
        let part = |row: usize| -> Vector3<f64> { drawn.fixed_rows::<3>(row).into() };
        [part(0) * gyroscope, part(3) * accelerometer]
    };

    let biases = noise(BIASES);
    let deviations = DENSITIES.map(|density| density / SAMPLE_S.sqrt());
    let seconds = (last.time_ns - first.time_ns) as f64 * 1e-9;
    let count = (seconds / SAMPLE_S).ceil() as usize + 1;
    (0..count)
        .map(|number| {
            let at = number as f64 * SAMPLE_S;
            let [rate, force] = path.sample(at, down);
            let [rate_noise, force_noise] = noise(deviations);
            InertialSample {
                time_ns: first.time_ns + (at * 1e9).round() as i64,
                angular_rate: rate + biases[0] + rate_noise,
                specific_force: force + biases[1] + force_noise,
            }
        })
        .collect()
}

/// A smooth path through the true poses: natural cubic splines of the positions and of the
/// quaternions, which are scaled to unit length.
struct Path {
    /// Seconds since the first view.
    times: Vec<f64>,
    values: Vec<SVector<f64, 7>>,
    /// Second derivatives.
    curvatures: Vec<SVector<f64, 7>>,
}

impl Path {
    fn of(views: &[PlayedView<'_>]) -> Self {
        let seconds = |view: &PlayedView<'_>| (view.time_ns - views[0].time_ns) as f64 * 1e-9;
        let times: Vec<f64> = views.iter().map(seconds).collect();
        let mut values: Vec<SVector<f64, 7>> = Vec::with_capacity(views.len());
        for view in views {
            let mut rotation = view.truth.rotation.coords;
            let last: Option<Vector4<f64>> = values
                .last()
                .map(|last| last.fixed_rows::<4>(3).into_owned());
            if last.is_some_and(|last| last.dot(&rotation) < 0.0) {
                rotation = -rotation;
            }
            let mut value = SVector::<f64, 7>::zeros();
            let position = &view.truth.translation.vector;
            value.fixed_rows_mut::<3>(0).copy_from(position);
            value.fixed_rows_mut::<4>(3).copy_from(&rotation);
            values.push(value);
        }
        Self {
            curvatures: curvatures(&times, &values),
            times,
            values,
        }
    }

    /// The interval of a time, its length, and the time's distances from its ends as shares of it.
    fn place(&self, at: f64) -> (usize, f64, [f64; 2]) {
        let later = self.times.partition_point(|time| *time <= at);
        let interval = later.clamp(1, self.times.len().max(2) - 1) - 1;
        let length = self.times[interval + 1] - self.times[interval];
        let share = (at - self.times[interval]) / length;
        (interval, length, [1.0 - share, share])
    }

    fn pose(&self, at: f64) -> Pose {
        let (from, length, [a, b]) = self.place(at);
        let cubic = |share: f64| (share.powi(3) - share) * length * length / 6.0;
        let value = self.values[from] * a
            + self.values[from + 1] * b
            + self.curvatures[from] * cubic(a)
            + self.curvatures[from + 1] * cubic(b);
        let position: Vector3<f64> = value.fixed_rows::<3>(0).into();
        let rotation: Vector4<f64> = value.fixed_rows::<4>(3).into();
        Pose::from_parts(
            position.into(),
            UnitQuaternion::from_quaternion(rotation.into()),
        )
    }

    /// Angular rate and specific force, in the axes of the camera.
    fn sample(&self, at: f64, down: &Unit<Vector3<f64>>) -> [Vector3<f64>; 2] {
        let (from, _, [a, b]) = self.place(at);
        let curvature = self.curvatures[from] * a + self.curvatures[from + 1] * b;
        let acceleration: Vector3<f64> = curvature.fixed_rows::<3>(0).into();
        let force = acceleration - down.into_inner() * GRAVITY_M_S2;

        let rotation = |at: f64| self.pose(at).rotation;
        let turn = rotation(at - RATE_S).inverse() * rotation(at + RATE_S);
        let rate = turn.scaled_axis() / (2.0 * RATE_S);
        [rate, rotation(at).inverse() * force]
    }
}

/// Second derivatives of the natural cubic spline at its knots: they are 0 at both ends.
fn curvatures(times: &[f64], values: &[SVector<f64, 7>]) -> Vec<SVector<f64, 7>> {
    let count = times.len();
    let mut curvatures = vec![SVector::zeros(); count];
    if count < 3 {
        return curvatures;
    }

    // Elimination in the tridiagonal system h₋ m₋ + 2 (h₋ + h) m + h m₊ = 6 (slope − slope₋).
    let length = |at: usize| times[at + 1] - times[at];
    let slope = |at: usize| (values[at + 1] - values[at]) / length(at);
    let mut ratios = vec![0.0; count];
    for at in 1..count - 1 {
        let pivot = 2.0 * (length(at - 1) + length(at)) - length(at - 1) * ratios[at - 1];
        ratios[at] = length(at) / pivot;
        let right = (slope(at) - slope(at - 1)) * 6.0 - curvatures[at - 1] * length(at - 1);
        curvatures[at] = right / pivot;
    }
    for at in (1..count - 1).rev() {
        let later = curvatures[at + 1];
        curvatures[at] -= later * ratios[at];
    }
    curvatures
}
