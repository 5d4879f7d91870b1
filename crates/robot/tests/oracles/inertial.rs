//! Inertial samples, and what the filter makes of them.

use nalgebra::{SVector, Unit, UnitQuaternion, Vector3, Vector6};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use seese3_core::geometry::{Pose, PoseError, Twist, exp, log};
use seese3_core::statistics::{mean, normal_deviates};
use seese3_robot::inertial::{
    GRAVITY_M_S2, InertialBuffer, InertialMotion, InertialMount, InertialNoise, InertialSample,
};
use seese3_robot::pose_filter::{
    Belief, FilterParameters, FilterRoom, LocatedPose, MeasuredInertia, PoseFilter, Source,
    ViewObservation,
};
use seese3_robot::tracking::{
    Drift, MeasuredPose, MotionPrior, PoseWithCovariance, Sensor, Status,
};
use seese3_robot::visual_odometry::VisualMotion;

const SAMPLE_S: f64 = 2.5e-3;
const PERIOD_S: f64 = 0.033;

/// A camera that turns at a constant rate and accelerates along a constant direction of the world.
struct Flight {
    rate: Vector3<f64>,
    start: UnitQuaternion<f64>,
    velocity: Vector3<f64>,
    acceleration: Vector3<f64>,
}

impl Flight {
    fn new() -> Self {
        Self {
            rate: Vector3::new(0.3, -0.8, 0.5),
            start: UnitQuaternion::from_scaled_axis(Vector3::new(0.4, 0.2, -0.3)),
            velocity: Vector3::new(0.5, 0.1, -0.2),
            acceleration: Vector3::new(-0.3, 0.2, 0.1),
        }
    }

    fn pose(&self, at: f64) -> Pose {
        let position = self.velocity * at + self.acceleration * (0.5 * at * at);
        let rotation = self.start * UnitQuaternion::from_scaled_axis(self.rate * at);
        Pose::from_parts(position.into(), rotation)
    }

    fn sample(&self, at: f64) -> InertialSample {
        let up = Vector3::z() * GRAVITY_M_S2;
        InertialSample {
            time_ns: (at * 1e9).round() as i64,
            angular_rate: self.rate,
            specific_force: self.pose(at).rotation.inverse() * (self.acceleration + up),
        }
    }

    /// Samples from 0 to some seconds, changed by `change`.
    fn samples(&self, seconds: f64, mut change: impl FnMut(&mut InertialSample)) -> InertialBuffer {
        let mut buffer = InertialBuffer::default();
        for number in 0..=(seconds / SAMPLE_S).ceil() as usize {
            let mut sample = self.sample(number as f64 * SAMPLE_S);
            change(&mut sample);
            buffer.push(sample);
        }
        buffer
    }
}

fn between(buffer: &InertialBuffer, from_s: f64, to_s: f64) -> Option<InertialMotion> {
    let [from_ns, to_ns] = [from_s, to_s].map(|seconds| (seconds * 1e9).round() as i64);
    buffer.between(from_ns, to_ns, InertialNoise::TYPICAL)
}

/// Oracle: the closed form of the flight, at times between the samples.
#[test]
fn samples_of_a_known_flight_give_its_motion() {
    let flight = Flight::new();
    let buffer = flight.samples(1.0, |_| ());
    for (from, to) in [(0.0, 0.5), (0.1234, 0.7), (0.301, 0.302)] {
        let motion = between(&buffer, from, to).unwrap();
        let seconds = to - from;
        let [first, second] = [from, to].map(|at| flight.pose(at));
        let off = motion.rotation.inverse() * first.rotation.inverse() * second.rotation;
        assert!(off.angle() < 1e-7, "{off}");

        let to_first = first.rotation.inverse();
        let start = to_first * (flight.velocity + flight.acceleration * from);
        let gravity = to_first * -Vector3::z() * GRAVITY_M_S2;
        let moved = start * seconds + gravity * (0.5 * seconds * seconds) + motion.position;
        let expected = first.inv_mul(&second).translation.vector;
        assert!(
            (moved - expected).norm() < 1e-4 * seconds,
            "{moved} {expected}"
        );

        let end = start + gravity * seconds + motion.velocity;
        let expected = to_first * (flight.velocity + flight.acceleration * to);
        assert!((end - expected).norm() < 1e-4, "{end} {expected}");
        assert!((motion.last_rate - flight.rate).norm() < 1e-9);
    }
}

/// Oracle: the definition: without a sample before the first frame, or with a gap of more than 0.1
/// s, the motion is not measured.
#[test]
fn missing_samples_are_not_replaced() {
    let flight = Flight::new();
    let buffer = flight.samples(1.0, |_| ());
    assert!(between(&buffer, -0.01, 0.5).is_none());
    assert!(between(&buffer, 0.5, 1.09).is_some());
    assert!(between(&buffer, 0.5, 1.11).is_none());
    assert!(between(&InertialBuffer::default(), 0.0, 0.1).is_none());

    let mut sparse = InertialBuffer::default();
    for at in [0.0, 0.05, 0.2, 0.25] {
        sparse.push(flight.sample(at));
    }
    assert!(between(&sparse, 0.0, 0.05).is_some());
    assert!(between(&sparse, 0.04, 0.06).is_none());
    assert!(between(&sparse, 0.2, 0.25).is_some());
}

/// Oracle: central differences of the integration of biased samples.
#[test]
fn the_derivatives_by_biases_are_those_of_the_integration() {
    let flight = Flight::new();
    let integrated = |column: usize, by: f64| {
        let buffer = flight.samples(0.4, |sample| {
            // A bias is part of what the sensor measures: without it, the motion is another one.
            let part = if column < 3 {
                &mut sample.angular_rate
            } else {
                &mut sample.specific_force
            };
            part[column % 3] -= by;
        });
        between(&buffer, 0.0, 0.4).unwrap()
    };
    let plain = integrated(0, 0.0);
    let h = 1e-4;
    for column in 0..6 {
        let [more, less] = [h, -h].map(|by| integrated(column, by));
        let rotation = |motion: &InertialMotion| {
            let off = plain.rotation.inverse() * motion.rotation;
            off.scaled_axis()
        };
        let differences = [
            more.position - less.position,
            rotation(&more) - rotation(&less),
            more.velocity - less.velocity,
        ];
        for (row, difference) in differences.into_iter().enumerate() {
            let expected = difference / (2.0 * h);
            let found: Vector3<f64> = plain.by_bias.fixed_view::<3, 1>(3 * row, column).into();
            assert!(
                (found - expected).norm() < 5e-3,
                "{row} {column}: {found} {expected}"
            );
        }
    }
}

/// Oracle: simulation. The mean squared Mahalanobis length of the errors is the number of
/// dimensions.
#[test]
fn the_covariance_is_that_of_noisy_samples() {
    let flight = Flight::new();
    let truth = between(&flight.samples(0.3, |_| ()), 0.0, 0.3).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let deviations = InertialNoise::TYPICAL
        .density
        .map(|density| density / SAMPLE_S.sqrt());
    let lengths: Vec<f64> = (0..400)
        .map(|_| {
            let noisy = flight.samples(0.3, |sample| {
                let mut drawn = |deviation: f64| {
                    Vector3::from_iterator(normal_deviates(&mut rng, 3)) * deviation
                };
                sample.angular_rate += drawn(deviations[0]);
                sample.specific_force += drawn(deviations[1]);
            });
            let found = between(&noisy, 0.0, 0.3).unwrap();
            let mut error = SVector::<f64, 9>::zeros();
            for (row, part) in [
                truth.position - found.position,
                (found.rotation.inverse() * truth.rotation).scaled_axis(),
                truth.velocity - found.velocity,
            ]
            .iter()
            .enumerate()
            {
                error.fixed_rows_mut::<3>(3 * row).copy_from(part);
            }
            let information = found.covariance.try_inverse().unwrap();
            error.dot(&(information * error))
        })
        .collect();
    // The standard deviation of the mean is √(2 · 9 / 400) = 0.2; interpolation averages the noise
    // of neighboring samples, which makes the covariance a little too large.
    let mean = mean(&lengths);
    assert!((8.0..9.7).contains(&mean), "{mean}");
}

/// Oracle: the flight of a sensor that is mounted elsewhere on the same body.
#[test]
fn a_mounted_sensor_measures_the_motion_of_the_camera() {
    let camera = Flight::new();
    let camera_from_sensor = Pose::from_parts(
        Vector3::new(0.2, -0.1, 0.3).into(),
        UnitQuaternion::from_scaled_axis(Vector3::new(0.5, -1.0, 0.2)),
    );
    let mount = InertialMount {
        sensor_from_camera: camera_from_sensor.inverse(),
    };
    let at_sensor = |at: f64| {
        // The acceleration of the sensor's position, by central differences.
        let position = |at: f64| (camera.pose(at) * camera_from_sensor).translation.vector;
        let h = 1e-3;
        let acceleration = (position(at + h) - position(at) * 2.0 + position(at - h)) / (h * h);
        let rotation = (camera.pose(at) * camera_from_sensor).rotation;
        let up = Vector3::z() * GRAVITY_M_S2;
        InertialSample {
            time_ns: (at * 1e9) as i64,
            angular_rate: camera_from_sensor.rotation.inverse() * camera.rate,
            specific_force: rotation.inverse() * (acceleration + up),
        }
    };
    let found = mount.at_camera(&at_sensor(0.2), Some(&at_sensor(0.19)));
    let expected = camera.sample(0.2);
    assert!((found.angular_rate - expected.angular_rate).norm() < 1e-9);
    let off = found.specific_force - expected.specific_force;
    assert!(off.norm() < 1e-4, "{off}");
}

fn filter(trust_wheels: bool) -> PoseFilter {
    let room = FilterRoom {
        motion_prior: MotionPrior::assumed(),
        extent_m: 3.0,
    };
    let parameters = FilterParameters {
        trust_wheels,
        ..FilterParameters::default()
    };
    PoseFilter::new(vec![room], parameters).unwrap()
}

fn frame(number: u64, pose: Option<Pose>) -> ViewObservation {
    let located = pose.map(|pose| LocatedPose {
        room: 0,
        pose: PoseWithCovariance::known(pose, 0.003, 0.003),
        source: Source::Matched,
        is_of_room: true,
        camera: None,
    });
    ViewObservation {
        novelty: 0.5,
        located: located.into_iter().collect(),
        fingerprint: Some(number),
        ..ViewObservation::empty((number as f64 * PERIOD_S * 1e9).round() as i64, number)
    }
}

/// Oracle: the flight. For 2 s after 3 s of located views there is no image. The inertial sensor
/// has biases, which it learns from the located views.
#[test]
fn an_inertial_sensor_carries_the_pose_in_the_dark() {
    let flight = Flight::new();
    let biases = [
        Vector3::new(0.008, -0.005, 0.01),
        Vector3::new(0.1, -0.15, 0.05),
    ];
    let buffer = flight.samples(6.0, |sample| {
        sample.angular_rate += biases[0];
        sample.specific_force += biases[1];
    });
    let filter = filter(false);
    let error_m = |has_sensor: bool, has_gravity: bool| {
        let mut state = filter.start(None);
        let mut last = None;
        for number in 1..=150 {
            let at = |number: u64| number as f64 * PERIOD_S;
            let motion = between(&buffer, at(number - 1), at(number));
            let down = Unit::new_unchecked(-Vector3::z());
            let inertia = motion.filter(|_| has_sensor).map(|motion| MeasuredInertia {
                motion,
                down_in_parent: has_gravity.then_some(down),
            });
            let seen = (number <= 90).then(|| flight.pose(at(number)));
            let observed = ViewObservation {
                inertia,
                ..frame(number, seen)
            };
            last = Some(filter.observe(&mut state, &observed).unwrap());
        }
        let learned = state.belief.unwrap().inertial_biases();
        let pose = last.unwrap().map_pose.unwrap();
        let truth = flight.pose(150.0 * PERIOD_S);
        let error = PoseError::between(&pose.pose, &truth);
        (error, pose.squared_error(&truth).unwrap(), learned)
    };

    let (with_both, surprise, learned) = error_m(true, true);
    let (gyroscope, _, _) = error_m(true, false);
    let (without, _, _) = error_m(false, false);
    assert!(with_both.translation_m < 0.06, "{with_both:?}");
    assert!(with_both.rotation_rad < 0.01, "{with_both:?}");
    // The 99 % quantile of χ² with six degrees of freedom.
    assert!(surprise < 16.8, "{surprise}");
    assert!(gyroscope.rotation_rad < 0.02, "{gyroscope:?}");
    assert!(without.translation_m > 0.3, "{without:?}");
    assert!(without.rotation_rad > 0.2, "{without:?}");
    let expected = InertialNoise::TYPICAL.bias;
    for axis in 0..3 {
        let of_rate = learned[axis] * expected[0];
        assert!((of_rate - biases[0][axis]).abs() < 1e-3, "{learned}");
    }
}

/// Oracle: the contract: two sensors outvote the third, which is named; a gyroscope is believed
/// against one other; trusted wheels are never left out.
#[test]
fn the_sensor_that_contradicts_the_others_is_named() {
    let twist = Twist {
        linear: Vector3::new(0.0, 0.0, 0.3),
        angular: Vector3::new(0.0, 0.3, 0.0),
    };
    let still = Twist::default();
    let path = |twist: &Twist, number: u64| exp(&twist.scaled(number as f64 * PERIOD_S));
    let inertia = |twist: &Twist| {
        let mut buffer = InertialBuffer::default();
        for number in 0..=20 {
            buffer.push(InertialSample {
                time_ns: number * 2_500_000,
                angular_rate: twist.angular,
                specific_force: Vector3::z() * GRAVITY_M_S2,
            });
        }
        MeasuredInertia {
            motion: between(&buffer, 0.0, PERIOD_S).unwrap(),
            down_in_parent: None,
        }
    };

    // Wheels, images and gyroscope move or stand still; the located views show the motion.
    let (go, no) = (Some(&twist), Some(&still));
    let cases: [(_, _, _, bool, &[Sensor], Status); 8] = [
        (go, go, go, false, &[], Status::Tracking),
        (no, go, go, false, &[Sensor::Wheels], Status::Tracking),
        (go, no, go, false, &[Sensor::Images], Status::Degraded),
        (go, go, no, false, &[Sensor::Inertia], Status::Tracking),
        (None, no, go, false, &[Sensor::Images], Status::Degraded),
        (
            go,
            no,
            None,
            false,
            &[Sensor::Wheels, Sensor::Images],
            Status::Degraded,
        ),
        (go, no, None, true, &[Sensor::Images], Status::Tracking),
        (
            go,
            no,
            no,
            true,
            &[Sensor::Images, Sensor::Inertia],
            Status::Tracking,
        ),
    ];
    for (case, (wheels, images, gyroscope, trust, expected, status)) in
        cases.into_iter().enumerate()
    {
        let filter = filter(trust);
        let mut state = filter.start(None);
        let mut last = None;
        for number in 1..=60 {
            let observed = ViewObservation {
                measured: wheels.map(|twist| MeasuredPose {
                    pose: path(twist, number),
                    drift: Drift {
                        translation_share: 0.03,
                        rotation_share: 0.03,
                    },
                    velocity_covariance: None,
                }),
                visual: images.filter(|_| number > 1).map(|twist| VisualMotion {
                    motion: path(twist, 1),
                    pose_covariance: nalgebra::Matrix6::identity() * 1e-8,
                    scale_deviation: 0.05,
                    inliers: 200,
                }),
                inertia: gyroscope.filter(|_| number > 1).map(inertia),
                ..frame(number, Some(path(&twist, number)))
            };
            last = Some(filter.observe(&mut state, &observed).unwrap());
        }
        let update = last.unwrap();
        assert_eq!(update.contradicted, expected, "case {case}");
        assert_eq!(update.status, status, "case {case}: {}", update.reason);
        let pose = update.map_pose.unwrap().pose;
        let error = PoseError::between(&pose, &path(&twist, 60));
        assert!(error.translation_m < 0.02, "case {case}: {error:?}");
    }
}

/// Oracle: the definition of a scale error: it is the same at every step. Images whose scale is
/// known to a third and that are three times too long do not contradict wheels; images whose scale
/// is known to 3 % do.
#[test]
fn a_wrong_scale_of_unknown_depths_is_no_contradiction() {
    let filter = filter(false);
    let step = |length: f64| Pose::translation(0.0, 0.0, 0.01 * length);
    for (scale_deviation, expected) in [(0.33, false), (0.03, true)] {
        let mut state = filter.start(None);
        let mut wheels = Pose::identity();
        let mut is_contradicted = false;
        for number in 1..=60 {
            let observed = ViewObservation {
                measured: Some(MeasuredPose {
                    pose: wheels,
                    drift: Drift {
                        translation_share: 0.03,
                        rotation_share: 0.03,
                    },
                    velocity_covariance: None,
                }),
                visual: (number > 1).then(|| VisualMotion {
                    motion: step(3.0),
                    pose_covariance: nalgebra::Matrix6::identity() * 1e-8,
                    scale_deviation,
                    inliers: 200,
                }),
                ..frame(number, None)
            };
            let update = filter.observe(&mut state, &observed).unwrap();
            is_contradicted |= !update.contradicted.is_empty();
            wheels *= step(1.0);
        }
        assert_eq!(is_contradicted, expected, "{scale_deviation}");
    }
}

/// Oracle: the contract: a contradiction is one of the last second. Wheels that slipped, fell
/// silent for a minute and then agree are used at once.
#[test]
fn a_contradiction_is_forgotten_while_a_sensor_is_silent() {
    let filter = filter(false);
    let mut state = filter.start(None);
    let mut wheels = Pose::identity();
    for number in 1..=2_000 {
        let is_slipping = number <= 60;
        let is_silent = (61..1_950).contains(&number);
        let length = if is_slipping { 0.03 } else { 0.01 };
        wheels *= Pose::translation(0.0, 0.0, length);
        let observed = ViewObservation {
            measured: (!is_silent).then_some(MeasuredPose {
                pose: wheels,
                drift: Drift {
                    translation_share: 0.03,
                    rotation_share: 0.03,
                },
                velocity_covariance: None,
            }),
            visual: (number > 1).then(|| VisualMotion {
                motion: Pose::translation(0.0, 0.0, 0.01),
                pose_covariance: nalgebra::Matrix6::identity() * 1e-8,
                scale_deviation: 0.03,
                inliers: 200,
            }),
            ..frame(number, None)
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        let is_contradicted = !update.contradicted.is_empty();
        assert!(number != 60 || is_contradicted);
        assert!(number < 1_950 || !is_contradicted, "{number}");
    }
}

/// Oracle: central differences of the predicted pose and velocity, by the initial pose, the
/// velocity and the biases.
#[test]
fn the_predicted_covariance_is_that_of_the_differences() {
    let flight = Flight::new();
    let motion = between(&flight.samples(0.4, |_| ()), 0.0, 0.4).unwrap();
    let inertia = MeasuredInertia {
        motion,
        down_in_parent: Some(Unit::new_unchecked(-Vector3::z())),
    };
    let (prior, parameters) = (MotionPrior::assumed(), FilterParameters::default());
    let place = PoseWithCovariance::known(flight.pose(0.0), 1e-3, 1e-3);
    let mut start = Belief::at(&place, &prior, 0.0);
    start.velocity.linear = flight.pose(0.0).rotation.inverse() * flight.velocity;
    start.covariance.fill(0.0);
    let end_of = |belief: &Belief| belief.step(&prior, 0.4, Some(&inertia), &parameters).end();
    let of_noise = end_of(&start).covariance;

    // Rows of the state: pose 0, velocity 6, biases 24.
    for axis in (0..9).chain(24..30) {
        let moved = |by: f64| {
            let mut moved = start;
            let mut step = Vector6::zeros();
            match axis {
                0..6 => {
                    step[axis] = by;
                    moved.pose *= exp(&Twist::from_vector(&step));
                }
                6..9 => moved.velocity.linear[axis - 6] += by,
                _ => moved.motion_errors[axis - 18] += by,
            }
            end_of(&moved)
        };
        let h = 1e-4;
        let [more, less] = [h, -h].map(moved);
        let of_pose = log(&less.pose.inv_mul(&more.pose)).to_vector() / (2.0 * h);
        let change = more.velocity.to_vector() - less.velocity.to_vector();
        let mut derivative = SVector::<f64, 12>::zeros();
        derivative.fixed_rows_mut::<6>(0).copy_from(&of_pose);
        let of_velocity = change / (2.0 * h);
        derivative.fixed_rows_mut::<6>(6).copy_from(&of_velocity);

        let mut uncertain = start;
        uncertain.covariance[(axis, axis)] = 1.0;
        let found = end_of(&uncertain).covariance - of_noise;
        let found = found.fixed_view::<12, 12>(0, 0).into_owned();
        let expected = derivative * derivative.transpose();
        let off = (found - expected).norm();
        assert!(off < 1e-2 * expected.norm(), "{axis}: {off}");
    }
}

/// Oracle: the contract of trusted wheels. Views that agree on a place 1 m away replace the pose
/// that plain wheels carry, and only are a candidate beside trusted ones.
#[test]
fn views_do_not_replace_a_pose_that_trusted_wheels_carry() {
    let there = Pose::translation(1.0, 0.0, 0.0);
    for is_trusted in [false, true] {
        let filter = filter(is_trusted);
        let mut state = filter.start(None);
        let mut last = None;

        for number in 1..=60 {
            let seen = if number <= 40 {
                Pose::identity()
            } else {
                there
            };
            let observed = ViewObservation {
                measured: Some(MeasuredPose {
                    pose: Pose::identity(),
                    drift: Drift {
                        translation_share: 0.03,
                        rotation_share: 0.03,
                    },
                    velocity_covariance: None,
                }),
                ..frame(number, Some(seen))
            };
            last = Some(filter.observe(&mut state, &observed).unwrap());
        }

        let update = last.unwrap();
        let expected = if is_trusted { Pose::identity() } else { there };
        let error = PoseError::between(&update.map_pose.unwrap().pose, &expected);
        assert!(error.translation_m < 0.02, "{is_trusted}: {error:?}");
        assert_eq!(update.candidate.is_some(), is_trusted);
        assert_eq!(update.contradicted.contains(&Sensor::Views), is_trusted);
    }
}

/// Oracle: the definition: over a time t, a velocity with the covariance Σ moves the camera with
/// the covariance Σ t². The drift is negligible.
#[test]
fn a_covariance_of_velocities_is_that_of_the_motion() {
    let filter = filter(false);
    let deviations = [0.3, 0.2, 0.1, 0.03, 0.02, 0.01];
    let velocity = nalgebra::Matrix6::from_diagonal(&Vector6::from(deviations).map(|x| x * x));
    let mut state = filter.start(None);
    let mut last = None;
    for number in 1..=2 {
        let observed = ViewObservation {
            measured: Some(MeasuredPose {
                pose: Pose::identity(),
                drift: Drift {
                    translation_share: 1e-4,
                    rotation_share: 1e-4,
                },
                velocity_covariance: Some(velocity),
            }),
            ..frame(number, None)
        };
        last = Some(filter.observe(&mut state, &observed).unwrap());
    }

    let covariance = last.unwrap().motion_covariance;
    for (axis, deviation) in deviations.into_iter().enumerate() {
        let expected = deviation * PERIOD_S;
        let found = covariance[(axis, axis)].sqrt();
        assert!(
            (found / expected - 1.0).abs() < 0.05,
            "{axis}: {found} {expected}"
        );
    }
}
