//! What a robot measures besides its own camera's views: which way is down, and what other cameras
//! see.

use nalgebra::{UnitQuaternion, Vector3};
use seese3_client::convert;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::track_request::Message;
use seese3_client::proto::v1::track_response::Answer;
use seese3_core::geometry::{Pose, PoseError};

use crate::harness::{TestServer, feature};
use crate::tracking::{answers, begin, config, is_nearly, resume, seen, start_followed};
use seese3_testing::world::served;

const DOWN: Vector3<f64> = Vector3::new(0.0, 1.0, 0.0);

fn wire(vector: Vector3<f64>) -> pb::Vector3 {
    pb::Vector3 {
        x: vector.x,
        y: vector.y,
        z: vector.z,
    }
}

/// The frame of a row, changed.
fn changed(row: usize, change: impl Fn(&mut pb::TrackFrame)) -> pb::TrackRequest {
    let mut request = seen(row);
    if let Some(Message::Frame(frame)) = &mut request.message {
        change(frame);
    }
    request
}

fn row_of(name: &str, row: usize) -> Option<pb::View> {
    feature(served(name).1.rows().row(row).to_vec())
}

async fn updates(
    server: &TestServer,
    config: pb::TrackConfig,
    frames: impl Iterator<Item = pb::TrackRequest>,
) -> Vec<pb::TrackUpdate> {
    let requests = [begin(config)].into_iter().chain(frames).collect();
    let heard = answers(server, requests).await.unwrap();
    let update = |answer: &pb::TrackResponse| match &answer.answer {
        Some(Answer::Update(update)) => update.clone(),
        other => panic!("no update: {other:?}"),
    };
    heard[1..].iter().map(update).collect()
}

fn pose(given: Option<&pb::Pose>) -> Pose {
    convert::pose(given.unwrap()).unwrap()
}

/// Oracle: the definitions. Gravity as the level camera of the hall measures it, in its own axes or
/// in those of the base, contradicts nothing. What a camera measures that is rolled by ten degrees,
/// or one whose axes are not what was said, contradicts what is surely seen, and that is said.
#[tokio::test]
async fn gravity_that_contradicts_the_views_is_said() {
    let server = start_followed(Default::default()).await;
    let (room, _) = served("hall");
    let level = UnitQuaternion::identity();
    let rolled = UnitQuaternion::from_scaled_axis(Vector3::z() * 10_f64.to_radians());
    let mounting = Pose::new(Vector3::new(0.1, 0.0, 0.3), Vector3::new(0.2, -1.1, 0.4));

    let in_map = pb::TrackConfig {
        gravity_in_map: Some(wire(DOWN * 9.81)),
        ..config()
    };
    let on_base = pb::TrackConfig {
        base_from_camera: Some(convert::pose_to_wire(&mounting, "base_link", "camera")),
        ..in_map.clone()
    };
    let cases = [
        (&in_map, level, "", false),
        (&on_base, level, "camera", false),
        (&on_base, mounting.rotation, "", false),
        (&in_map, rolled.inverse(), "", true),
        // The camera's axes, said to be the base's.
        (&on_base, level, "", true),
    ];
    for (config, on, name, contradicts) in cases {
        let frames = (0..60).map(|row| {
            changed(row, |frame| {
                let down = room.poses()[row].rotation.inverse() * DOWN;
                frame.gravity = Some(pb::MeasuredGravity {
                    direction: Some(wire(on * down)),
                    coordinate_frame: name.to_owned(),
                    deviation_rad: None,
                });
            })
        });
        let found = updates(&server, config.clone(), frames).await;
        let last = &found[59];
        let expected = match contradicts {
            true => pb::TrackStatus::Degraded,
            false => pb::TrackStatus::Tracking,
        };
        assert_eq!(last.status(), expected, "{name}: {}", last.reason);
        assert_eq!(last.reason.contains("gravity"), contradicts);

        // What is surely seen is believed.
        let off = PoseError::between(&pose(last.map_from_camera()), &room.poses()[59]);
        assert!(off.rotation_rad < 0.05, "{name}: {off:?}");
    }
}

fn second_camera(mounting: &Pose) -> pb::RigCamera {
    pb::RigCamera {
        name: "second".to_owned(),
        pose: Some(convert::pose_to_wire(mounting, "camera", "second")),
        intrinsics: None,
        time_offset_ns: 0,
    }
}

/// A robot whose own camera always shows the same of another place, and whose second one sees the
/// hall.
fn covered(row: usize) -> pb::TrackRequest {
    changed(row, |frame| {
        frame.view = row_of("attic", 0);
        frame.other_views = vec![pb::OtherView {
            camera_name: "second".to_owned(),
            view: row_of("hall", row),
        }];
    })
}

/// Oracle: composition: the second camera is where the hall's was, and the robot's own camera where
/// the mounting says.
#[tokio::test]
async fn a_second_camera_finds_a_robot_whose_own_is_covered() {
    let server = start_followed(Default::default()).await;
    let (room, _) = served("hall");
    let mounting = Pose::new(Vector3::new(-0.3, 0.1, -0.2), Vector3::new(0.1, 2.5, 0.0));
    let rig = pb::TrackConfig {
        other_cameras: vec![second_camera(&mounting)],
        ..config()
    };

    let found = updates(&server, rig.clone(), (0..80).map(covered)).await;
    let last = &found[79];
    assert_eq!(last.status(), pb::TrackStatus::Tracking, "{}", last.reason);
    assert_eq!(last.r#match.as_ref().unwrap().camera_name, "second");
    let truth = room.poses()[79] * mounting.inverse();
    let off = PoseError::between(&pose(last.map_from_camera()), &truth);
    assert!(off.translation_m < 0.1, "{off:?}");

    // Alone, its own camera finds nothing.
    let alone = (0..80).map(|row| changed(row, |frame| frame.view = row_of("attic", 0)));
    let alone = updates(&server, rig, alone).await;
    assert_ne!(alone[79].status(), pb::TrackStatus::Tracking);
    assert_eq!(alone[79].r#match.as_ref().unwrap().camera_name, "");
}

/// Oracle: the stream that is never covered. A hand before the lens of a robot whose other camera
/// certainly sees the room makes it LOST neither when it comes nor when it goes.
#[tokio::test]
async fn a_hand_before_one_of_two_lenses_loses_nothing() {
    let server = start_followed(Default::default()).await;
    let (room, _) = served("hall");
    let rig = pb::TrackConfig {
        other_cameras: vec![second_camera(&Pose::identity())],
        ..config()
    };
    let frames = (0..140).map(|row| {
        changed(row, |frame| {
            frame.other_views = vec![pb::OtherView {
                camera_name: "second".to_owned(),
                view: row_of("hall", row),
            }];
            if (60..100).contains(&row) {
                frame.view = row_of("attic", row);
            }
        })
    });

    let found = updates(&server, rig, frames).await;
    for (row, update) in found.iter().enumerate().skip(40) {
        assert_eq!(
            update.status(),
            pb::TrackStatus::Tracking,
            "{row}: {}",
            update.reason
        );
        let off = PoseError::between(&pose(update.map_from_camera()), &room.poses()[row]);
        assert!(off.translation_m < 0.1, "{row}: {off:?}");
    }
    assert_eq!(found[80].r#match.as_ref().unwrap().camera_name, "second");
}

/// Oracle: a frozen second camera tells nothing: it leads no more, and the stream's own camera is
/// answered as if there were no other.
#[tokio::test]
async fn a_frozen_second_camera_is_not_believed() {
    let server = start_followed(Default::default()).await;
    let (room, _) = served("hall");
    let rig = pb::TrackConfig {
        other_cameras: vec![second_camera(&Pose::identity())],
        ..config()
    };
    // The own views are off the map's a little, so that the second camera's, which is one of the
    // map's, leads, until it shows the same again.
    let own = |row: usize| {
        let view = served("hall")
            .1
            .rows()
            .row(row)
            .mapv(|value| value + 0.01 * (1 + row % 7) as f32);
        feature(view.to_vec())
    };
    let frozen = (0..80).map(|row| {
        changed(row, |frame| {
            frame.view = own(row);
            frame.other_views = vec![pb::OtherView {
                camera_name: "second".to_owned(),
                view: row_of("hall", 5),
            }];
        })
    });

    let found = updates(&server, rig, frozen).await;
    let leads =
        |update: &&pb::TrackUpdate| update.r#match.as_ref().unwrap().camera_name == "second";
    assert!(leads(&&found[0]));
    assert!(!found[1..].iter().any(|update| leads(&update)));
    let last = &found[79];
    assert_eq!(last.status(), pb::TrackStatus::Tracking, "{}", last.reason);
    let off = PoseError::between(&pose(last.map_from_camera()), &room.poses()[79]);
    assert!(off.translation_m < 0.1, "{off:?}");
}

/// Oracle: the stream that was never cut.
#[tokio::test]
async fn a_stream_with_a_rig_and_gravity_resumes() {
    let server = start_followed(Default::default()).await;
    let rig = pb::TrackConfig {
        other_cameras: vec![second_camera(&Pose::identity())],
        gravity_in_map: Some(wire(DOWN)),
        ..config()
    };
    // The second camera freezes at the tenth frame, so that what is remembered of it matters.
    let frames = |rows: std::ops::Range<usize>| {
        rows.map(|row| {
            changed(row, |frame| {
                frame.gravity = Some(pb::MeasuredGravity {
                    direction: Some(wire(DOWN)),
                    ..Default::default()
                });
                frame.other_views = vec![pb::OtherView {
                    camera_name: "second".to_owned(),
                    view: row_of("hall", row.min(10)),
                }];
            })
        })
    };

    let whole = [begin(rig.clone())].into_iter().chain(frames(0..40));
    let whole = answers(&server, whole.collect()).await.unwrap();
    for cut in [1, 13, 30] {
        let resumed = resume(whole[cut].resume_token.clone());
        let rest = [begin(resumed)].into_iter().chain(frames(cut..40));
        let rest = answers(&server, rest.collect()).await.unwrap();
        is_nearly(&rest[1..], &whole[cut + 1..]);
    }
}

/// Oracle: the contract: a bad frame is refused with its reason and the field, and leaves no trace.
#[tokio::test]
async fn measurements_that_are_none_are_refused() {
    use pb::TrackRefusalReason as Reason;

    let server = start_followed(Default::default()).await;
    let rig = pb::TrackConfig {
        other_cameras: vec![second_camera(&Pose::identity())],
        gravity_in_map: Some(wire(DOWN)),
        ..config()
    };
    let gravity =
        |given: pb::MeasuredGravity| changed(1, move |frame| frame.gravity = Some(given.clone()));
    let down = pb::MeasuredGravity {
        direction: Some(wire(DOWN)),
        ..Default::default()
    };
    let directed = |x: f64| pb::MeasuredGravity {
        direction: Some(wire(DOWN * x)),
        ..Default::default()
    };
    let others = |names: &'static [&'static str], view: Option<pb::View>| {
        changed(1, move |frame| {
            let other = |name: &&str| pb::OtherView {
                camera_name: (*name).to_owned(),
                view: view.clone(),
            };
            frame.other_views = names.iter().map(other).collect();
        })
    };

    let cases = [
        (
            gravity(Default::default()),
            Reason::Gravity,
            "gravity.direction",
        ),
        (gravity(directed(0.0)), Reason::Gravity, "gravity.direction"),
        (
            gravity(pb::MeasuredGravity {
                direction: Some(wire(Vector3::new(f64::NAN, 0.0, -1.0))),
                ..Default::default()
            }),
            Reason::Gravity,
            "gravity.direction",
        ),
        (
            gravity(directed(f64::NAN)),
            Reason::Gravity,
            "gravity.direction",
        ),
        (
            gravity(pb::MeasuredGravity {
                coordinate_frame: "base_link".to_owned(),
                ..down.clone()
            }),
            Reason::Gravity,
            "the base is not known",
        ),
        (
            gravity(pb::MeasuredGravity {
                deviation_rad: Some(0.0),
                ..down.clone()
            }),
            Reason::Gravity,
            "gravity.deviation_rad",
        ),
        (
            others(&["third"], row_of("hall", 1)),
            Reason::View,
            "other_views[0].camera_name: must be one of: second",
        ),
        (
            others(&["second", "second"], row_of("hall", 1)),
            Reason::View,
            "other_views[1].camera_name",
        ),
        (
            others(&["second"], feature(vec![0.0; 47])),
            Reason::View,
            "other_views[0].view",
        ),
        (
            others(&["second"], None),
            Reason::View,
            "other_views[0].view",
        ),
        (
            changed(1, |frame| frame.exposure_ns = 2_000_000_000),
            Reason::Inertial,
            "frame.exposure_ns: must be at most",
        ),
        (
            changed(1, |frame| frame.depth = Some(pb::DepthImage::default())),
            Reason::View,
            "frame.depth: needs an image",
        ),
    ];
    let plain = vec![begin(rig.clone()), seen(0), seen(2)];
    let plain = answers(&server, plain).await.unwrap();
    for (bad, reason, says) in cases {
        let heard = vec![begin(rig.clone()), seen(0), bad, seen(2)];
        let heard = answers(&server, heard).await.unwrap();
        match &heard[2].answer {
            Some(Answer::Refusal(refusal)) => {
                assert_eq!(refusal.reason(), reason, "{says}");
                assert!(
                    refusal.message.contains(says),
                    "{}: {says}",
                    refusal.message
                );
            }
            other => panic!("{says}: {other:?}"),
        }
        assert_eq!(heard[3], plain[2], "{says}");
    }

    // Gravity cannot be compared with what is not known.
    let unknown = vec![begin(config()), gravity(down)];
    let heard = answers(&server, unknown).await.unwrap();
    match &heard[1].answer {
        Some(Answer::Refusal(refusal)) => assert!(refusal.message.contains("gravity_in_map")),
        other => panic!("{other:?}"),
    }
}

/// What a sensor in these axes measures between a row and the one before, five samples at constant
/// rates. The timestamps are 20 ms early.
fn gyroscope(
    row: usize,
    base_from_camera: &Pose,
    base_from_sensor: &Pose,
) -> Vec<pb::InertialSample> {
    let (room, _) = served("hall");
    let Some(before) = row.checked_sub(1) else {
        return Vec::new();
    };
    let sensor_from_camera = base_from_sensor.inv_mul(base_from_camera);
    let turn = room.poses()[before].inv_mul(&room.poses()[row]).rotation;
    let rate = sensor_from_camera.rotation * (turn.scaled_axis() / 0.033);
    (0..5)
        .map(|part| pb::InertialSample {
            timestamp_ns: before as i64 * 33_000_000 + part * 6_600_000 - 20_000_000,
            angular_velocity: Some(wire(rate)),
            linear_acceleration: Some(wire(Vector3::y() * -9.8)),
        })
        .collect()
}

/// Oracle: the turns of the camera, measured by a sensor that is mounted in other axes on the base
/// and whose clock is 20 ms slow. The views of the second half show nothing known.
#[tokio::test]
async fn a_gyroscope_turns_the_pose_where_nothing_is_seen() {
    let server = start_followed(Default::default()).await;
    let (room, _) = served("hall");
    let base_from_camera = Pose::new(Vector3::new(0.1, 0.0, 0.3), Vector3::new(0.2, -1.1, 0.4));
    let base_from_sensor = Pose::new(Vector3::new(0.0, 0.2, 0.1), Vector3::new(-0.7, 0.3, 1.9));
    let with_sensor = pb::TrackConfig {
        base_from_camera: Some(convert::pose_to_wire(
            &base_from_camera,
            "base_link",
            "camera",
        )),
        inertial_sensor: Some(pb::InertialSensor {
            pose: Some(convert::pose_to_wire(&base_from_sensor, "base_link", "imu")),
            time_offset_ns: 20_000_000,
            ..pb::InertialSensor::default()
        }),
        ..config()
    };

    let mut errors = Vec::new();
    for has_samples in [true, false] {
        let frames = (0..60).map(|row| {
            changed(row, |frame| {
                if row >= 30 {
                    frame.view = row_of("attic", 0);
                }
                if has_samples {
                    frame.inertial_samples = gyroscope(row, &base_from_camera, &base_from_sensor);
                }
            })
        });
        let found = updates(&server, with_sensor.clone(), frames).await;
        let last = pose(found[59].map_from_camera());
        errors.push(PoseError::between(&last, &room.poses()[59]).rotation_rad);
    }
    assert!(
        errors[0] < 0.05 && errors[1] > 3.0 * errors[0],
        "{errors:?}"
    );
}

/// Oracle: the contract: samples and exposures that are none are refused with the field.
#[tokio::test]
async fn inertial_samples_that_are_none_are_refused() {
    let server = start_followed(Default::default()).await;
    let rig = pb::TrackConfig {
        inertial_sensor: Some(pb::InertialSensor::default()),
        ..config()
    };
    let sample = |timestamp_ns: i64, rate: f64| pb::InertialSample {
        timestamp_ns,
        angular_velocity: Some(wire(Vector3::new(rate, 0.0, 0.0))),
        linear_acceleration: Some(wire(Vector3::y() * -9.8)),
    };
    let without = pb::InertialSample {
        linear_acceleration: None,
        ..sample(5, 0.0)
    };
    let cases = [
        (
            vec![sample(5, f64::NAN)],
            "inertial_samples[0].angular_velocity",
        ),
        (
            vec![sample(5, 101.0)],
            "inertial_samples[0].angular_velocity",
        ),
        (vec![without], "inertial_samples[0].linear_acceleration"),
        (
            vec![sample(5, 0.0), sample(5, 0.0)],
            "inertial_samples[1].timestamp_ns",
        ),
        (
            (0..2_001).map(|time| sample(time, 0.0)).collect(),
            "inertial_samples: must be at most 2000",
        ),
    ];
    let refusal = |answer: &pb::TrackResponse| match &answer.answer {
        Some(Answer::Refusal(refusal)) => refusal.clone(),
        other => panic!("{other:?}"),
    };
    for (samples, says) in cases {
        let bad = changed(1, |frame| frame.inertial_samples.clone_from(&samples));
        let heard = answers(&server, vec![begin(rig.clone()), seen(0), bad, seen(2)]).await;
        let heard = heard.unwrap();
        let refused = refusal(&heard[2]);
        assert_eq!(refused.reason(), pb::TrackRefusalReason::Inertial);
        assert!(
            refused.message.contains(says),
            "{}: {says}",
            refused.message
        );
        assert!(matches!(&heard[3].answer, Some(Answer::Update(_))));
    }

    let unknown = changed(0, |frame| frame.inertial_samples = vec![sample(5, 0.0)]);
    let long = changed(0, |frame| frame.exposure_ns = 1_000_000_001);
    for (config, bad, says) in [
        (
            config(),
            unknown,
            "need inertial_sensor in the configuration",
        ),
        (rig, long, "frame.exposure_ns"),
    ] {
        let heard = answers(&server, vec![begin(config), bad]).await.unwrap();
        let refused = refusal(&heard[1]);
        assert!(
            refused.message.contains(says),
            "{}: {says}",
            refused.message
        );
    }

    // A noise of zero would make the covariance singular.
    let silent = pb::TrackConfig {
        inertial_sensor: Some(pb::InertialSensor {
            gyroscope_noise: Some(0.0),
            ..pb::InertialSensor::default()
        }),
        ..config()
    };
    let error = answers(&server, vec![begin(silent)]).await.unwrap_err();
    let says = "config.inertial_sensor.gyroscope_noise";
    assert!(error.message().contains(says), "{}", error.message());
}

/// Oracle: the contract: a covariance of velocities has 36 numbers, is symmetric and positive
/// semidefinite, and not zero.
#[tokio::test]
async fn a_covariance_of_velocities_is_checked() {
    let server = start_followed(Default::default()).await;
    let with_covariance = |covariance: Vec<f64>| {
        changed(0, move |frame| {
            frame.odometry = Some(pb::MeasuredOdometry {
                pose: Some(convert::pose_to_wire(&Pose::identity(), "odom", "")),
                velocity_covariance: covariance.clone(),
                ..pb::MeasuredOdometry::default()
            });
        })
    };
    let diagonal = |values: [f64; 6]| {
        nalgebra::Matrix6::from_diagonal(&values.into())
            .as_slice()
            .to_vec()
    };
    let mut skew = diagonal([1.0; 6]);
    skew[1] = 0.5;
    let cases = [
        (diagonal([1e-4; 6]), None),
        // Planar wheels know nothing of three axes.
        (diagonal([1e-4, 1e-4, 1e6, 1e6, 1e6, 1e-4]), None),
        (vec![1.0; 35], Some("must have 36 numbers, not 35")),
        (diagonal([0.0; 6]), Some("not zero")),
        (
            diagonal([1.0, -1.0, 1.0, 1.0, 1.0, 1.0]),
            Some("positive semidefinite"),
        ),
        (skew, Some("symmetric")),
        (diagonal([f64::NAN; 6]), Some("finite")),
    ];
    for (covariance, problem) in cases {
        let requests = vec![begin(config()), with_covariance(covariance)];
        let heard = answers(&server, requests).await.unwrap();
        match (&heard[1].answer, problem) {
            (Some(Answer::Update(_)), None) => {}
            (Some(Answer::Refusal(refusal)), Some(says)) => {
                let field = "frame.odometry.velocity_covariance";
                let message = &refusal.message;
                assert!(
                    message.contains(field) && message.contains(says),
                    "{message}"
                );
            }
            (answer, problem) => panic!("{problem:?}: {answer:?}"),
        }
    }
}

/// Oracle: the contract: a configuration that names no possible rig is refused by its field.
#[tokio::test]
async fn rigs_that_are_none_are_refused() {
    let server = start_followed(Default::default()).await;
    let named = |name: &str| pb::RigCamera {
        name: name.to_owned(),
        pose: Some(convert::pose_to_wire(&Pose::identity(), "", "")),
        intrinsics: None,
        time_offset_ns: 0,
    };
    let cases = [
        (vec![named("")], "config.other_cameras[0].name"),
        (vec![named("camera")], "config.other_cameras[0].name"),
        (vec![named("odom")], "config.other_cameras[0].name"),
        (vec![named("a"), named("a")], "config.other_cameras[1].name"),
        (vec![named("a\n")], "config.other_cameras[0].name"),
        (
            vec![pb::RigCamera {
                pose: None,
                ..named("a")
            }],
            "config.other_cameras[0].pose",
        ),
        (
            vec![pb::RigCamera {
                intrinsics: Some(pb::CameraIntrinsics::default()),
                ..named("a")
            }],
            "config.other_cameras[0].intrinsics",
        ),
        (
            (0..9).map(|number| named(&format!("c{number}"))).collect(),
            "config.other_cameras",
        ),
    ];
    for (other_cameras, field) in cases {
        let config = pb::TrackConfig {
            other_cameras,
            ..config()
        };
        let refused = answers(&server, vec![begin(config)]).await.unwrap_err();
        assert!(refused.message().contains(field), "{refused}: {field}");
    }

    for (room, gravity) in [
        ("hall", Vector3::zeros()),
        ("hall", Vector3::new(f64::NAN, 0.0, -1.0)),
        // In whose world?
        ("", DOWN),
    ] {
        let config = pb::TrackConfig {
            room: room.to_owned(),
            gravity_in_map: Some(wire(gravity)),
            ..config()
        };
        let refused = answers(&server, vec![begin(config)]).await.unwrap_err();
        assert!(
            refused.message().contains("config.gravity_in_map"),
            "{refused}"
        );
    }
}
