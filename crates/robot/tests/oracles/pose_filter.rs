//! The filter of located poses.

use nalgebra::{Matrix6, Unit, Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use seese3_core::geometry::{Pose, PoseError, Twist, body_twist, exp, log};
use seese3_robot::pose_filter::{
    Belief, FilterParameters, FilterRoom, FilterState, LocatedPose, MeasuredGravity, MotionNoise,
    PoseFilter, Source, ViewObservation,
};
use seese3_robot::tracking::{
    Drift, MeasuredPose, MotionPrior, PoseWithCovariance, Refusal, Status, Update,
};
use seese3_robot::visual_odometry::VisualMotion;

const PERIOD_NS: i64 = 33_333_333;

fn parameters(correlation_range: f64) -> FilterParameters {
    FilterParameters {
        correlation_range,
        ..FilterParameters::default()
    }
}

fn filter() -> PoseFilter {
    filter_with(true)
}

/// A filter in one room; `fuse` says whether located views correct the pose.
fn filter_with(fuse: bool) -> PoseFilter {
    let room = FilterRoom {
        motion_prior: MotionPrior::assumed(),
        extent_m: 3.0,
    };
    let parameters = FilterParameters {
        fuse,
        ..FilterParameters::default()
    };
    PoseFilter::new(vec![room], parameters).unwrap()
}

fn located(pose: Pose, deviation: f64) -> PoseWithCovariance {
    PoseWithCovariance::known(pose, deviation, deviation)
}

fn by_keypoints(pose: Pose, deviation: f64) -> LocatedPose {
    LocatedPose {
        room: 0,
        pose: located(pose, deviation),
        source: Source::Matched,
        is_of_room: true,
        camera: None,
    }
}

fn view(number: u64, pose: Option<Pose>) -> ViewObservation {
    ViewObservation {
        located: pose
            .into_iter()
            .map(|pose| by_keypoints(pose, 0.005))
            .collect(),
        novelty: if pose.is_some() { 0.5 } else { 2.0 },
        unlocated: if pose.is_some() {
            String::new()
        } else {
            "too few keypoints".to_owned()
        },
        fingerprint: Some(number),
        ..ViewObservation::empty(number as i64 * PERIOD_NS, number)
    }
}

/// A path at 0.3 m/s that also turns.
fn path(number: u64) -> Pose {
    let twist = Twist {
        linear: Vector3::new(0.3, 0.0, 0.1),
        angular: Vector3::new(0.0, 0.2, 0.0),
    };
    exp(&twist.scaled(number as f64 * PERIOD_NS as f64 * 1e-9))
}

fn error_m(update: &Update, pose: &Pose) -> f64 {
    PoseError::between(&update.map_pose.unwrap().pose, pose).translation_m
}

/// Oracle: the definition of a correlated error. Two poses of a camera at rest, located with the
/// same error, tell its place no better than one; with independent errors, the variance halves.
#[test]
fn correlated_errors_are_not_averaged_out() {
    let prior = MotionPrior::assumed();
    let pose = located(Pose::identity(), 0.01);
    let variance_after_two = |share: f64| {
        let parameters = parameters(1e9);
        let mut step = Belief::at(&pose, &prior, share).step(&prior, 0.0, None, &parameters);
        step.update(&step.located(&pose, share), 1.0);
        step.end().place().covariance[(0, 0)]
    };

    assert!((variance_after_two(0.0) / 0.5e-4 - 1.0).abs() < 1e-9);
    assert!((variance_after_two(1.0 - 1e-9) / 1e-4 - 1.0).abs() < 1e-6);
    // A half that lasts and a half that is averaged.
    assert!((variance_after_two(0.5) / 0.75e-4 - 1.0).abs() < 1e-9);
}

/// Oracle: the definition of the correlation range. Over this distance, the correlated error decays
/// by a factor e; at rest it stays.
#[test]
fn correlated_errors_decay_over_the_distance() {
    let prior = MotionPrior::assumed();
    let parameters = parameters(0.2);
    let left = |speed: f64| {
        let mut belief = Belief::at(&located(Pose::identity(), 0.01), &prior, 0.7);
        belief.correlated_error = Vector6::repeat(1.0);
        belief.velocity.linear.x = speed;
        belief
            .step(&prior, 0.001, None, &parameters)
            .end()
            .correlated_error[0]
    };
    assert!((left(0.0) - 1.0).abs() < 1e-12);
    assert!(
        (left(200.0) - (-1.0_f64).exp()).abs() < 0.01,
        "{}",
        left(200.0)
    );
}

/// Oracle: the same definition. A correlated error is that of both ends of a motion, so it cancels.
#[test]
fn correlated_errors_cancel_in_a_motion() {
    let prior = MotionPrior::assumed();
    let share = 1.0 - 1e-9;
    let parameters = parameters(1e9);
    let error = exp(&Twist {
        linear: Vector3::new(0.02, 0.0, 0.0),
        angular: Vector3::zeros(),
    });
    let (start, end) = (Pose::identity(), Pose::translation(0.0, 0.0, 0.05));

    let belief = Belief::at(&located(start * error, 0.02), &prior, share);
    let mut step = belief.step(&prior, 0.1, None, &parameters);
    step.update(&step.located(&located(end * error, 0.02), share), 1.0);
    let motion = step.motion();
    assert!(PoseError::between(&motion.pose, &end).translation_m < 1e-5);
    assert!(motion.covariance.diagonal().max() < 1e-8);
    assert!(step.end().place().covariance[(0, 0)] > 0.9 * 4e-4);
}

/// Oracle: by hand. A camera that is uncertain along its x axis alone turns by 90° about z: x is
/// then its −y axis. A pose that is located there moves it along that axis alone.
#[test]
fn errors_turn_with_the_camera() {
    let prior = MotionPrior::assumed();
    let parameters = parameters(1.0);
    let mut place = located(Pose::identity(), 1e-4);
    place.covariance[(0, 0)] = 1e-2;
    let turn = Pose::rotation(Vector3::z() * std::f64::consts::FRAC_PI_2);

    let composed = place.composed(&located(turn, 1e-4));
    assert!((composed.covariance[(1, 1)] - 1e-2).abs() < 1e-5);
    assert!(composed.covariance[(0, 0)] < 1e-5);

    let drift = Drift {
        translation_share: 1e-4,
        rotation_share: 1e-4,
    };
    let mut step = Belief::at(&place, &prior, 0.0).step(&prior, 0.1, None, &parameters);
    step.update(
        &step.by_wheels(&turn, &drift, &MotionNoise::WHEELS.over(&log(&turn))),
        1.0,
    );
    let end = step.end().place();
    assert!((end.covariance[(1, 1)] - 1e-2).abs() < 1e-4, "{end:?}");
    assert!(end.covariance[(0, 0)] < 1e-4);

    // Located 2 cm along both of its axes, with the variance that y has: y moves by half of it.
    let seen = located(turn * Pose::translation(0.02, 0.02, 0.0), 0.1);
    step.update(&step.located(&seen, 0.0), 1.0);
    let moved = turn.inverse() * step.end().pose.translation.vector;
    assert!((moved.y - 0.01).abs() < 1e-3, "{moved}");
    assert!(moved.x.abs() < 1e-3, "{moved}");
}

/// Oracle: wheels whose translations are 4 % and whose rotations are 5 % too large, at drifts of 5
/// %, on a way that turns left and right. While views are located, the filter learns both errors;
/// then the wheels alone carry the pose.
#[test]
fn wheels_carry_the_pose_and_their_errors_are_learned() {
    let filter = filter();
    let drift = Drift {
        translation_share: 0.05,
        rotation_share: 0.05,
    };
    let ways = |count: u64, scale: [f64; 2]| {
        let mut pose = Pose::identity();
        let mut poses = vec![pose];
        for number in 0..count {
            // Left for 50 frames, then right.
            let sign = if number / 50 % 2 == 0 { 1.0 } else { -1.0 };
            pose *= exp(&Twist {
                linear: Vector3::new(0.0, 0.0, 0.01 * scale[0]),
                angular: Vector3::new(0.0, 0.02 * sign * scale[1], 0.0),
            });
            poses.push(pose);
        }
        poses
    };
    let truth = ways(600, [1.0, 1.0]);
    let wheels = ways(600, [1.04, 1.05]);
    let start = Pose::translation(7.0, 1.0, 0.0);
    let wheel_frame = |number: u64, is_located: bool| {
        let row = number as usize;
        let measured = MeasuredPose {
            pose: start * wheels[row],
            velocity_covariance: None,
            drift,
        };
        ViewObservation {
            measured: Some(measured),
            ..view(number, is_located.then(|| truth[row]))
        }
    };

    // Never located: the odometry is that of the wheels, within its covariance.
    let mut state = filter.start(None);
    let mut last = None;
    for number in 0..=201 {
        last = Some(
            filter
                .observe(&mut state, &wheel_frame(number, false))
                .unwrap(),
        );
    }
    let update = last.take().unwrap();
    let error = PoseError::between(&update.odom.pose, &wheels[201]).translation_m;
    assert!(error < 0.02, "{error}");
    assert!(update.odom.squared_error(&truth[201]).unwrap() < 12.6);

    // Located for 3 m, then not for 3 m.
    let mut state = filter.start(None);
    for number in 0..300 {
        filter
            .observe(&mut state, &wheel_frame(number, true))
            .unwrap();
    }
    let learned = state.belief.unwrap().motion_errors;
    assert!((learned[0] - 0.8).abs() < 0.3, "{learned}");
    assert!((learned[1] - 1.0).abs() < 0.4, "{learned}");
    for number in 300..=600 {
        last = Some(
            filter
                .observe(&mut state, &wheel_frame(number, false))
                .unwrap(),
        );
    }
    let update = last.unwrap();
    let pose = update.map_pose.unwrap();
    let error = error_m(&update, &truth[600]);
    let raw = PoseError::between(
        &(truth[300] * wheels[300].inverse() * wheels[600]),
        &truth[600],
    );
    assert!(error < 0.5 * raw.translation_m, "{error} {raw:?}");
    assert!(pose.squared_error(&truth[600]).unwrap() < 12.6);
}

/// The motion to a frame by visual odometry, exact.
fn visual(number: u64) -> VisualMotion {
    VisualMotion {
        motion: path(number - 1).inv_mul(&path(number)),
        pose_covariance: Matrix6::identity() * 1e-6,
        scale_deviation: 0.03,
        inliers: 200,
    }
}

/// Oracle: the true path. Visual odometry carries the pose where no view is located, and the stream
/// stays TRACKING. Without it, or after a frame without a motion, the stream is soon DEGRADED.
#[test]
fn visual_odometry_carries_the_pose() {
    let filter = filter();
    for (with_images, lost) in [(true, None), (true, Some(40)), (false, None)] {
        let mut state = filter.start(None);
        let mut last = None;
        for number in 1..=59 {
            let is_located = number <= 30;
            let is_moved = with_images && number > 1 && lost != Some(number);
            let observed = ViewObservation {
                visual: is_moved.then(|| visual(number)),
                ..view(number, is_located.then(|| path(number)))
            };
            let update = filter.observe(&mut state, &observed).unwrap();
            if number == 58 && with_images && lost.is_none() {
                assert_eq!(update.status, Status::Tracking, "{}", update.reason);
            }
            last = Some(update);
        }

        let update = last.unwrap();
        if with_images && lost.is_none() {
            assert!(error_m(&update, &path(59)) < 0.02);
            let odom = path(1).inv_mul(&path(59));
            assert!(PoseError::between(&update.odom.pose, &odom).translation_m < 0.03);
            assert!(update.odom.squared_error(&odom).unwrap() < 12.6);
        } else {
            assert_eq!(update.status, Status::Degraded, "{}", update.reason);
        }
    }
}

/// Oracle: the definition of TRACKING by the largest standard deviations. A carried pose loses it
/// in the frame in which its own covariance exceeds them, not at a fixed time.
#[test]
fn a_carried_pose_is_tracking_while_it_is_certain() {
    let filter = filter();
    let [most_m, most_rad] = filter.parameters().max_deviation;
    let mut state = filter.start(None);
    let mut seen = [false; 2];
    for number in 1..=900 {
        let observed = ViewObservation {
            visual: (number > 1).then(|| visual(number)),
            ..view(number, (number <= 30).then(|| path(number)))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        if number <= 30 {
            continue;
        }

        let pose = update.map_pose.unwrap();
        let is_certain =
            pose.position_deviation_m() <= most_m && pose.rotation_deviation_rad() <= most_rad;
        assert_eq!(
            update.status == Status::Tracking,
            is_certain,
            "{number}: {}",
            update.reason
        );
        seen[usize::from(is_certain)] = true;
    }
    assert_eq!(seen, [true, true]);
}

/// Oracle: the contract. A pose that the client sets before the first frame counts as located
/// there. Without fusion, visual odometry carries it.
#[test]
fn visual_odometry_carries_a_set_pose_without_fusion() {
    let filter = filter_with(false);
    let mut state = filter.start(Some(&located(path(1), 1e-3)));
    for number in 1..=30 {
        let observed = ViewObservation {
            visual: (number > 1).then(|| visual(number)),
            ..view(number, None)
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        assert_eq!(update.status, Status::Tracking, "{}", update.reason);
    }
}

/// Oracle: the contract. A frozen picture with noise shows no motion, in the map and between
/// images; the wheels know better, so the stream does not stay TRACKING. Wheels that agree change
/// nothing.
#[test]
fn wheels_reveal_frozen_images() {
    let filter = filter();
    let drift = Drift {
        translation_share: 0.03,
        rotation_share: 0.03,
    };
    for is_frozen in [false, true] {
        let mut state = filter.start(None);
        let mut tracking_wrong = 0;
        for number in 1..=120 {
            let seen = if is_frozen { number.min(60) } else { number };
            let moved = VisualMotion {
                motion: path(seen.max(2) - 1).inv_mul(&path(seen.max(2))),
                ..visual(2)
            };
            let still = VisualMotion {
                motion: Pose::identity(),
                ..visual(2)
            };
            let observed = ViewObservation {
                visual: Some(if seen == number { moved } else { still }),
                measured: Some(MeasuredPose {
                    pose: path(number),
                    velocity_covariance: None,
                    drift,
                }),
                ..view(number, Some(path(seen)))
            };
            let update = filter.observe(&mut state, &observed).unwrap();
            let is_tracking = update.status == Status::Tracking;
            assert!(is_frozen || number < 3 || is_tracking, "{}", update.reason);
            if is_tracking && number > 2 {
                tracking_wrong += usize::from(error_m(&update, &path(number)) > 0.2);
            }
        }
        assert_eq!(tracking_wrong, 0);
    }
}

/// Oracle: the contract. Wheels at 2 to 32 cm/s drive a camera whose picture is frozen from the
/// start, and pause for a minute: no pose over 0.2 m off is TRACKING, also if the drift of the
/// wheels is stated as 30 %. When the picture changes again and both move alike, the stream is
/// TRACKING within 3 s.
#[test]
fn a_frozen_picture_is_not_trusted_while_wheels_are_slow_or_pause() {
    const MOVED: u64 = 900;
    const PAUSED: u64 = MOVED + 1_800;
    const END: u64 = PAUSED + 90;
    let filter = filter();
    let along = |steps: f64| {
        let twist = log(&path(1)).scaled(steps);
        exp(&twist)
    };
    for (speed, share) in [(0.05, 0.03), (0.2, 0.03), (1.0, 0.03), (1.0, 0.3)] {
        let drift = Drift {
            translation_share: share,
            rotation_share: share,
        };
        let truth = |number: u64| {
            let driven = number.min(MOVED) as f64 * speed;
            along(driven + number.saturating_sub(PAUSED) as f64)
        };
        let mut state = filter.start(None);
        let mut last = None;
        for number in 1..=END {
            let seen = if number > PAUSED { number } else { 1 };
            let is_motion_seen = number > PAUSED + 1;
            let motion = if is_motion_seen {
                truth(number - 1).inv_mul(&truth(number))
            } else {
                Pose::identity()
            };
            let observed = ViewObservation {
                visual: (number > 1 && number != PAUSED + 1).then(|| VisualMotion {
                    motion,
                    ..visual(2)
                }),
                measured: Some(MeasuredPose {
                    pose: truth(number),
                    velocity_covariance: None,
                    drift,
                }),
                ..view(number, Some(truth(seen)))
            };
            let update = filter.observe(&mut state, &observed).unwrap();
            if update.status == Status::Tracking {
                assert!(
                    error_m(&update, &truth(number)) < 0.2,
                    "{speed} {share} {number}"
                );
            }
            last = Some(update);
        }
        let last = last.unwrap();
        assert_eq!(last.status, Status::Tracking, "{}", last.reason);
        assert!(last.contradicted.is_empty());
    }
}

/// Oracle: the contract. Wheels that stand still while the images move, with pauses, stay
/// contradicted until both have moved alike: also if their odometry is missing in one frame of a
/// pause, and after the stream was resumed.
#[test]
fn wheels_that_stand_still_stay_contradicted() {
    const STUCK: u64 = 600;
    let filter = filter();
    let drift = Drift {
        translation_share: 0.15,
        rotation_share: 0.15,
    };
    // The robot drives for 2 s and pauses for 2 s.
    let driven = |number: u64| {
        let pauses = number / 120;
        let in_cycle = (number % 120).min(60);
        path(1 + 60 * pauses + in_cycle)
    };

    let mut state = filter.start(None);
    for number in 1..=STUCK + 120 {
        let is_stuck = number <= STUCK;
        let observed = ViewObservation {
            visual: (number > 1).then(|| VisualMotion {
                motion: driven(number - 1).inv_mul(&driven(number)),
                ..visual(2)
            }),
            measured: (number != 200).then_some(MeasuredPose {
                pose: driven(number.max(STUCK)),
                velocity_covariance: None,
                drift,
            }),
            ..view(number, Some(driven(number)))
        };
        if number == 400 {
            state = filter.resumed(&state.saved());
        }
        let update = filter.observe(&mut state, &observed).unwrap();
        let is_contradicted = !update.contradicted.is_empty();
        assert!(number < 60 || !is_stuck || is_contradicted, "{number}");
        assert!(number < STUCK + 90 || !is_contradicted, "{number}");
    }
}

/// Oracle: the contract. The picture freezes while the camera moves, and the wheels stop 0.6 to 1 s
/// later: the motion before does not end the contradiction. Odometry that is missing in one frame
/// does not end it either.
#[test]
fn a_picture_that_freezes_before_a_stop_is_not_trusted() {
    const FROZEN: u64 = 60;
    let filter = filter();
    let along = |number: u64| exp(&log(&path(1)).scaled(2.0 * number as f64));
    for stop in [FROZEN + 18, FROZEN + 24, FROZEN + 30] {
        for missing in [None, Some(stop + 5)] {
            let mut state = filter.start(None);
            for number in 1..=600 {
                let truth = along(number.min(stop));
                let seen = number.min(FROZEN);
                let motion = along(seen.min(number - 1)).inv_mul(&along(seen));
                let observed = ViewObservation {
                    visual: (number > 1).then(|| VisualMotion {
                        motion,
                        ..visual(2)
                    }),
                    measured: (missing != Some(number)).then_some(MeasuredPose {
                        pose: truth,
                        velocity_covariance: None,
                        drift: Drift {
                            translation_share: 0.03,
                            rotation_share: 0.03,
                        },
                    }),
                    ..view(number, Some(along(seen)))
                };
                let update = filter.observe(&mut state, &observed).unwrap();
                if update.status == Status::Tracking {
                    assert!(error_m(&update, &truth) < 0.2, "{stop} {number}");
                }
            }
        }
    }
}

/// Oracle: the contract. Wheels drive 0.3 m beside a frozen picture with noise, and pause for a
/// minute: the noise is not taken for motion, so no pose is TRACKING.
#[test]
fn noise_of_a_frozen_picture_is_not_motion() {
    let filter = filter();
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut state = filter.start(None);
    for number in 1..=2_000 {
        let driven = f64::from(u32::try_from(number.clamp(60, 90)).unwrap() - 60) * 0.01;
        let noise = Twist {
            linear: Vector3::from_fn(|_, _| random.random_range(-1.7e-3..1.7e-3)),
            angular: Vector3::from_fn(|_, _| random.random_range(-1.7e-3..1.7e-3)),
        };
        let observed = ViewObservation {
            visual: (number > 1).then(|| VisualMotion {
                motion: exp(&noise),
                ..visual(2)
            }),
            measured: Some(MeasuredPose {
                pose: Pose::translation(0.0, 0.0, driven),
                velocity_covariance: None,
                drift: Drift {
                    translation_share: 0.03,
                    rotation_share: 0.03,
                },
            }),
            ..view(number, Some(Pose::identity()))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        let is_tracking = update.status == Status::Tracking;
        assert!(number < 100 || !is_tracking, "{number}");
    }
}

/// Oracle: by hand. Beside a frozen picture, the robot drives 0.5 m, turns by 180°, drives 0.5 m
/// back in its own frame and turns back: it is 1 m away, though its twists sum to zero.
#[test]
fn a_sum_of_differences_turns_with_the_robot() {
    let drive = |length_m: f64| Pose::translation(0.0, 0.0, length_m / 30.0);
    let turn = |angle_rad: f64| {
        exp(&Twist {
            angular: Vector3::new(0.0, angle_rad / 30.0, 0.0),
            ..Twist::default()
        })
    };
    let half = std::f64::consts::PI;
    let filter = filter();
    let mut state = filter.start(None);
    let mut truth = Pose::identity();
    for number in 1..=900 {
        truth *= match number {
            61..=90 => drive(0.5),
            91..=120 => turn(half),
            121..=150 => drive(-0.5),
            151..=180 => turn(-half),
            _ => Pose::identity(),
        };
        let observed = ViewObservation {
            visual: (number > 1).then(|| VisualMotion {
                motion: Pose::identity(),
                ..visual(2)
            }),
            measured: Some(MeasuredPose {
                pose: truth,
                velocity_covariance: None,
                drift: Drift {
                    translation_share: 0.03,
                    rotation_share: 0.03,
                },
            }),
            ..view(number, Some(Pose::identity()))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        let is_tracking = update.status == Status::Tracking;
        assert!(number < 100 || !is_tracking, "{number}");
    }
    assert!((truth.translation.vector.norm() - 1.0).abs() < 1e-9);
}

/// Oracle: the definition of a covariance. Wheels with negated translations contradict the images.
/// When the images end, the wheels do not carry the pose.
#[test]
fn contradicted_wheels_do_not_carry_a_blackout() {
    let filter = filter();
    let mut state = filter.start(None);
    let mut last = None;
    for number in 1..=90 {
        let is_dark = number > 60;
        let mut wheels = path(number);
        wheels.translation.vector.neg_mut();
        let observed = ViewObservation {
            visual: (number > 1 && !is_dark).then(|| visual(number)),
            measured: Some(MeasuredPose {
                pose: wheels,
                velocity_covariance: None,
                drift: Drift {
                    translation_share: 0.03,
                    rotation_share: 0.03,
                },
            }),
            fingerprint: (!is_dark).then_some(number),
            ..view(number, (!is_dark).then(|| path(number)))
        };
        last = Some(filter.observe(&mut state, &observed).unwrap());
    }

    let update = last.unwrap();
    assert_eq!(update.status, Status::Degraded, "{}", update.reason);
    // The 99 % quantile of χ² with six degrees of freedom.
    let place = update.map_pose.unwrap();
    assert!(place.squared_error(&path(90)).unwrap() < 16.8);
}

/// Oracle: the contract: wheels that begin a new odometry frame, 100 m away, do not move the pose.
#[test]
fn restarted_wheels_do_not_move_the_pose() {
    let filter = filter();
    let drift = Drift {
        translation_share: 0.03,
        rotation_share: 0.03,
    };
    let mut state = filter.start(None);
    for number in 1..=60 {
        let frame = if number > 40 { 100.0 } else { 0.0 };
        let observed = ViewObservation {
            measured: Some(MeasuredPose {
                pose: Pose::translation(frame, 0.0, 0.0) * path(number),
                velocity_covariance: None,
                drift,
            }),
            ..view(number, (number <= 30).then(|| path(number)))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        if number > 2 {
            assert!(error_m(&update, &path(number)) < 0.03, "{number}");
        }
    }
}

/// Oracle: the contract. An image that repeats shows no motion, which is no loss of the images:
/// visual odometry goes on to carry the pose.
#[test]
fn a_repeated_image_does_not_end_the_carried_pose() {
    let filter = filter();
    let mut state = filter.start(None);
    for number in 1..=50 {
        let is_repeated = number == 35;
        let observed = ViewObservation {
            visual: (number > 1 && !is_repeated).then(|| visual(number)),
            fingerprint: Some(if is_repeated { 34 } else { number }),
            ..view(number, (number <= 30).then(|| path(number)))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        let is_tracking = update.status == Status::Tracking;
        assert!(number < 3 || is_tracking, "{number}: {}", update.reason);
    }
}

/// Oracle: the contract of a resumed stream: the map pose is the same to the bit, the covariances
/// are equal up to single precision, the status goes on, and the odometry begins anew.
#[test]
fn a_resumed_stream_goes_on_at_the_same_pose() {
    let filter = filter();
    let mut state = filter.start(None);
    for number in 1..=30 {
        let observed = ViewObservation {
            visual: (number > 1).then(|| visual(number)),
            ..view(number, Some(path(number)))
        };
        filter.observe(&mut state, &observed).unwrap();
    }

    let mut resumed = filter.resumed(&state.saved());
    let [before, after] = [&state, &resumed].map(|state| state.belief.unwrap());
    assert_eq!(before.pose, after.pose);
    assert_eq!(before.velocity, after.velocity);
    let [a, b] = [before, after].map(|belief| belief.place().covariance);
    assert!((a - b).norm() < 1e-4 * a.norm());
    assert!(b.cholesky().is_some());

    let late = filter.observe(&mut resumed, &view(30, Some(path(30))));
    assert!(matches!(late, Err(Refusal::Duplicate { .. })));
    let update = filter
        .observe(&mut resumed, &view(31, Some(path(31))))
        .unwrap();
    assert_eq!(update.status, Status::Tracking, "{}", update.reason);
    assert!(error_m(&update, &path(31)) < 0.01);
    assert!(update.odom.pose.translation.vector.norm() < 0.02);
}

/// Oracle: the contract of an odometry frame (REP 105): poses in the map, here of a camera that the
/// map believes carried away by 1 m, do not move the odometry.
#[test]
fn the_map_does_not_move_the_odometry() {
    let filter = filter();
    let mut state = filter.start(None);
    let carried = Pose::translation(1.0, 0.0, 0.0);
    let mut before: Option<Pose> = None;
    for number in 1..=60 {
        let place = if number <= 30 {
            path(number)
        } else {
            carried * path(number)
        };
        let observed = ViewObservation {
            visual: (number > 1).then(|| visual(number)),
            ..view(number, Some(place))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        if let Some(before) = before.replace(update.odom.pose) {
            let step = before.inv_mul(&update.odom.pose);
            let error = PoseError::between(&step, &visual(number).motion);
            assert!(error.translation_m < 2e-3, "{number}: {error:?}");
        }
    }
    let update = state.belief.unwrap();
    assert!(PoseError::between(&update.pose, &(carried * path(60))).translation_m < 0.02);
}

/// Oracle: the contract: two located views that agree start the tracking, at the true pose, with
/// the true velocity and a continuous odometry.
#[test]
fn two_located_views_start_the_tracking() {
    let filter = filter();
    let mut state = filter.start(None);
    let observe =
        |state: &mut FilterState, number, pose| filter.observe(state, &view(number, pose)).unwrap();

    assert_eq!(observe(&mut state, 0, None).status, Status::Lost);
    let first = observe(&mut state, 1, Some(path(1)));
    assert_eq!(first.status, Status::Relocalizing);
    assert!(first.map_pose.is_none() && first.candidate.is_some());

    let mut odom = first.odom.pose;
    for number in 2..90 {
        let update = observe(&mut state, number, Some(path(number)));
        assert_eq!(update.status, Status::Tracking, "{}", update.reason);
        assert!(error_m(&update, &path(number)) < 0.01);
        let step = PoseError::between(&odom, &update.odom.pose).translation_m;
        assert!(step < 0.03, "{step}");
        odom = update.odom.pose;
    }
    let update = observe(&mut state, 90, Some(path(90)));
    let velocity = update.velocity.unwrap();
    let truth = body_twist(&path(89), &path(90)).scaled(1e9 / PERIOD_NS as f64);
    assert!(
        (velocity.linear - truth.linear).norm() < 0.03,
        "{velocity:?}"
    );

    // Unlocated views: the pose goes on, and the status says so at once.
    for number in 91..=110 {
        let update = observe(&mut state, number, None);
        assert_eq!(update.status, Status::Degraded);
        assert!(update.map_pose.is_some());
    }
}

/// Oracle: the contract: one pose elsewhere is an outlier; two that agree are a camera that was
/// carried away.
#[test]
fn one_outlier_is_ignored_and_two_that_agree_are_believed() {
    let filter = filter();
    let mut state = filter.start(None);
    for number in 0..10 {
        filter
            .observe(&mut state, &view(number, Some(path(number))))
            .unwrap();
    }

    let elsewhere = Pose::translation(1.5, 0.0, 0.0);
    let outlier = filter
        .observe(&mut state, &view(10, Some(elsewhere)))
        .unwrap();
    assert_eq!(outlier.status, Status::Degraded);
    assert!(!outlier.match_used && error_m(&outlier, &path(10)) < 0.03);
    let back = filter
        .observe(&mut state, &view(11, Some(path(11))))
        .unwrap();
    assert!(back.status == Status::Tracking && back.match_used);

    // A candidate that nothing supports is dropped.
    let outlier = filter
        .observe(&mut state, &view(12, Some(elsewhere)))
        .unwrap();
    assert!(outlier.candidate.is_some());
    let later = filter.observe(&mut state, &view(170, None)).unwrap();
    assert!(later.candidate.is_none());

    let mut state = filter.start(None);
    for number in 0..12 {
        filter
            .observe(&mut state, &view(number, Some(path(number))))
            .unwrap();
    }
    filter
        .observe(&mut state, &view(12, Some(elsewhere)))
        .unwrap();
    let carried = filter
        .observe(&mut state, &view(13, Some(elsewhere)))
        .unwrap();
    assert_eq!(carried.status, Status::Tracking);
    assert!(error_m(&carried, &elsewhere) < 0.01);
}

/// Oracle: the contract: at two images per second, one motion of visual odometry is 0.4 m off. The
/// located view contradicts it, but not the motion prior: the view is used at once.
#[test]
fn a_located_view_prevails_over_wrong_visual_odometry() {
    let filter = filter();
    let mut state = filter.start(None);
    for number in 1..=20 {
        let (last, this) = (path(15 * (number - 1)), path(15 * number));
        let wrong_m = if number == 15 { 0.4 } else { 0.0 };
        let observed = ViewObservation {
            time_ns: number as i64 * 15 * PERIOD_NS,
            visual: (number > 1).then(|| VisualMotion {
                motion: last.inv_mul(&this) * Pose::translation(wrong_m, 0.0, 0.0),
                ..visual(2)
            }),
            ..view(number, Some(this))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        if number > 2 {
            assert!(error_m(&update, &this) < 0.02, "{number}");
            assert_eq!(update.status, Status::Tracking, "{}", update.reason);
        }
    }
}

/// Oracle: the contract: timestamps in milliseconds that are read as nanoseconds make every motion
/// a contradiction. The reason says what to look at.
#[test]
fn timestamps_in_a_wrong_unit_are_suspected() {
    let filter = filter();
    let mut state = filter.start(None);
    for number in 1..=30 {
        let observed = ViewObservation {
            time_ns: number as i64 * 33,
            ..view(number, Some(path(number * 3)))
        };
        let update = filter.observe(&mut state, &observed).unwrap();
        assert_eq!(update.status, Status::Relocalizing);
        assert_eq!(
            update.reason.contains("timestamps"),
            number > 1,
            "{}",
            update.reason
        );
    }
}

/// Oracle: the contract: an image that repeats holds nothing new; six in a row are a frozen camera.
/// A frame that is not newer is refused and changes nothing.
#[test]
fn frozen_images_and_late_frames_are_noticed() {
    let filter = filter();
    let mut state = filter.start(None);
    for number in 0..5 {
        filter
            .observe(&mut state, &view(number, Some(path(number))))
            .unwrap();
    }

    let frozen = |number| ViewObservation {
        fingerprint: Some(4),
        ..view(number, Some(path(4)))
    };
    let statuses: Vec<Status> = (5..12)
        .map(|number| filter.observe(&mut state, &frozen(number)).unwrap().status)
        .collect();
    assert_eq!(statuses[3], Status::Tracking);
    assert_eq!(statuses[4], Status::Degraded);

    let before = state.clone();
    let late = ViewObservation {
        time_ns: 3 * PERIOD_NS,
        ..view(20, None)
    };
    let late = filter.observe(&mut state, &late);
    assert!(matches!(late, Err(Refusal::Late { .. })));
    let duplicate = ViewObservation {
        sequence: 3,
        ..view(20, None)
    };
    let duplicate = filter.observe(&mut state, &duplicate);
    assert!(matches!(duplicate, Err(Refusal::Duplicate { .. })));
    assert_eq!(state, before);
}

/// Oracle: the contract: cameras down to one image in five seconds are tracked.
#[test]
fn slow_cameras_are_tracked() {
    let filter = filter();
    let mut state = filter.start(None);
    let slow = |number: u64| ViewObservation {
        time_ns: number as i64 * 4_000_000_000,
        ..view(number, Some(path(number)))
    };
    filter.observe(&mut state, &slow(0)).unwrap();
    for number in 1..10 {
        let update = filter.observe(&mut state, &slow(number)).unwrap();
        assert_eq!(update.status, Status::Tracking, "{}", update.reason);
        assert!(error_m(&update, &path(number)) < 0.02);
    }
}

/// Oracle: the contract: a pose that the client sets is believed until views contradict it.
#[test]
fn a_given_pose_starts_the_tracking() {
    let filter = filter();
    let mut state = filter.start(Some(&located(path(0), 0.05)));
    let update = filter.observe(&mut state, &view(0, None)).unwrap();
    assert_eq!(update.status, Status::Tracking);
    assert!(error_m(&update, &path(0)) < 1e-9);

    let update = filter.observe(&mut state, &view(1, Some(path(1)))).unwrap();
    assert!(update.match_used && error_m(&update, &path(1)) < 0.01);
}

const DOWN: Vector3<f64> = Vector3::new(0.0, 1.0, 0.0);

/// A frame with noise-free gravity, measured by a camera at this pose; the world's y axis points
/// down.
fn with_gravity(number: u64, pose: &Pose, deviation_rad: f64) -> ViewObservation {
    let down = Unit::new_unchecked(DOWN);
    ViewObservation {
        gravity: Some(MeasuredGravity {
            in_world: down,
            in_camera: pose.rotation.inverse() * down,
            deviation_rad,
        }),
        ..view(number, None)
    }
}

fn turned(axis: Vector3<f64>, angle_rad: f64) -> Pose {
    Pose::new(Vector3::new(1.0, 2.0, 3.0), axis * angle_rad)
}

/// A stream that starts at a level pose with these deviations, meters and radians, at frame 1.
fn level_stream(filter: &PoseFilter, [m, rad]: [f64; 2]) -> (FilterState, Pose) {
    let level = turned(DOWN, 0.7);
    let state = filter.start(Some(&PoseWithCovariance::known(level, m, rad)));
    (state, level)
}

/// Oracle: by hand. The estimate is level; the camera is rolled by 10° about its optical axis. A
/// precise measurement of gravity corrects the roll and nothing else: the variances of heading and
/// position stay.
#[test]
fn gravity_tells_the_tilt_and_nothing_else() {
    let filter = filter();
    let (mut state, level) = level_stream(&filter, [0.1, 0.2]);
    let roll = Twist {
        linear: Vector3::zeros(),
        angular: Vector3::z() * 10_f64.to_radians(),
    };
    let truth = level * exp(&roll);
    let update = filter
        .observe(&mut state, &with_gravity(1, &truth, 1e-3))
        .unwrap();

    let found = update.map_pose.unwrap();
    let error = body_twist(&found.pose, &truth).to_vector();
    assert!(error.norm() < 1e-4, "{error}");
    let deviation = |at: usize, axis: Vector3<f64>| {
        let block = found.covariance.fixed_view::<3, 3>(at, at).into_owned();
        (axis.transpose() * block * axis)[0].sqrt()
    };
    let down = truth.rotation.inverse() * DOWN;
    assert!(deviation(3, Vector3::z()) < 2e-3);
    // To first order in the correction.
    assert!((deviation(3, down) / 0.2 - 1.0).abs() < 0.02);
    assert!((deviation(0, Vector3::x()) - 0.1).abs() < 1e-3);
}

/// Oracle: by hand. A level pose has a deviation of 0.005 rad; gravity, with 0.02 rad, is 0.2 rad
/// off: the squared innovation is 0.2² / (0.005² + 0.02²) = 94.118, or 10.219 times the gate of
/// 9.21. The variance of gravity grows by 10.219² = 104.43, so it turns the pose by 0.2 · 25e-6 /
/// 0.041797 = 0.0001196 rad. That is a contradiction; 0.02 rad is none.
#[test]
fn gravity_that_a_certain_pose_contradicts_counts_little() {
    let filter = filter();
    let turn = |angle_rad: f64| {
        let (mut state, level) = level_stream(&filter, [0.005, 0.005]);
        let pitch = Twist {
            linear: Vector3::zeros(),
            angular: Vector3::x() * angle_rad,
        };
        let frame = with_gravity(1, &(level * exp(&pitch)), 0.02);
        let update = filter.observe(&mut state, &frame).unwrap();
        let turn = body_twist(&level, &update.map_pose.unwrap().pose);
        (turn.angular.x, update.reason)
    };

    let (turned_rad, reason) = turn(0.2);
    assert!((turned_rad - 1.196e-4).abs() < 1e-6, "{turned_rad}");
    assert!(reason.contains("gravity"), "{reason}");
    assert!(!turn(0.02).1.contains("gravity"));
}

/// Oracle: by hand. A first direction with the variance of the pose corrects half of the error. One
/// that follows after 1/30 s, with the correlation ρ = e^(−1/60), has (1 + ρ)/(1 − ρ) = 120 times
/// the variance: two correct little more than one.
#[test]
fn directions_in_a_row_count_as_few() {
    let filter = filter();
    let (mut state, level) = level_stream(&filter, [0.001, 0.02]);
    let roll = Twist {
        linear: Vector3::zeros(),
        angular: Vector3::z() * 0.02,
    };
    let truth = level * exp(&roll);
    let mut corrected = |number| {
        let frame = with_gravity(number, &truth, 0.02);
        let update = filter.observe(&mut state, &frame).unwrap();
        body_twist(&level, &update.map_pose.unwrap().pose).angular.z
    };
    let first = corrected(1);
    assert!((first - 0.01).abs() < 1e-4, "{first}");
    let second = corrected(2);
    assert!(second - first < 5e-4, "{second}");
}

/// Oracle: the definition: an upside-down camera is half a turn off, about a horizontal axis.
#[test]
fn an_upside_down_camera_contradicts_gravity() {
    let filter = filter();
    let (mut state, level) = level_stream(&filter, [0.01, 0.01]);
    let over = level * Pose::rotation(Vector3::z() * std::f64::consts::PI);
    let update = filter
        .observe(&mut state, &with_gravity(1, &over, 0.01))
        .unwrap();
    assert!(update.reason.contains("180°"), "{}", update.reason);
}

/// Oracle: by hand. Two views of one frame count as one: with the covariance of the pose, the two
/// together have the information of a single view. A view of another camera corrects a stream whose
/// own camera is frozen.
#[test]
fn views_of_one_frame_count_as_one() {
    let filter = filter();
    let deviation = |count: usize| {
        let mut state = filter.start(Some(&located(Pose::identity(), 0.1)));
        let one = by_keypoints(Pose::identity(), 0.01);
        let frame = ViewObservation {
            located: vec![one; count],
            ..view(1, None)
        };
        let update = filter.observe(&mut state, &frame).unwrap();
        update.map_pose.unwrap().position_deviation_m()
    };
    assert!((deviation(2) / deviation(1) - 1.0).abs() < 0.01);

    let mut state = filter.start(Some(&located(Pose::identity(), 0.01)));
    for number in 1..20 {
        let other = LocatedPose {
            camera: Some(0),
            ..by_keypoints(Pose::identity(), 0.01)
        };
        let frame = ViewObservation {
            located: vec![other],
            fingerprint: Some(7),
            unlocated: String::new(),
            ..view(number, None)
        };
        let update = filter.observe(&mut state, &frame).unwrap();
        assert_eq!(update.status, Status::Tracking, "{}", update.reason);
        assert!(update.match_used);
    }
}

/// Oracle: the contract of a stream that is not corrected: gravity does not turn its pose.
#[test]
fn gravity_does_not_correct_a_stream_without_fusion() {
    let filter = filter_with(false);
    let (mut state, level) = level_stream(&filter, [0.1, 0.2]);
    let rolled = level * Pose::rotation(Vector3::z() * 0.1);
    let update = filter
        .observe(&mut state, &with_gravity(1, &rolled, 1e-3))
        .unwrap();
    assert_eq!(update.map_pose.unwrap().pose, level);
}
