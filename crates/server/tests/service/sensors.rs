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
/// in those of the base, contradicts nothing. What a camera measures that is rolled by ten degrees, or
/// one whose axes are not what was said, contradicts what is surely seen, and that is said.
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
                    frame: name.to_owned(),
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
        let off = PoseError::between(&pose(last.map_from_camera.as_ref()), &room.poses()[59]);
        assert!(off.rotation_rad < 0.05, "{name}: {off:?}");
    }
}

fn second_camera(mounting: &Pose) -> pb::RigCamera {
    pb::RigCamera {
        name: "second".to_owned(),
        pose: Some(convert::pose_to_wire(mounting, "camera", "second")),
        camera: None,
    }
}

/// A robot whose own camera always shows the same of another place, and whose second one sees the
/// hall.
fn covered(row: usize) -> pb::TrackRequest {
    changed(row, |frame| {
        frame.view = row_of("attic", 0);
        frame.other_views = vec![pb::OtherView {
            camera: "second".to_owned(),
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
    assert_eq!(last.best_camera, "second");
    let truth = room.poses()[79] * mounting.inverse();
    let off = PoseError::between(&pose(last.map_from_camera.as_ref()), &truth);
    assert!(off.translation_m < 0.1, "{off:?}");

    // Alone, its own camera finds nothing.
    let alone = (0..80).map(|row| changed(row, |frame| frame.view = row_of("attic", 0)));
    let alone = updates(&server, rig, alone).await;
    assert_ne!(alone[79].status(), pb::TrackStatus::Tracking);
    assert_eq!(alone[79].best_camera, "");
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
                camera: "second".to_owned(),
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
        let off = PoseError::between(&pose(update.map_from_camera.as_ref()), &room.poses()[row]);
        assert!(off.translation_m < 0.1, "{row}: {off:?}");
    }
    assert_eq!(found[80].best_camera, "second");
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
    // The own views are off the map's a little, so that the second camera's, which is one of the map's,
    // leads, until it shows the same again.
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
                camera: "second".to_owned(),
                view: row_of("hall", 5),
            }];
        })
    });

    let found = updates(&server, rig, frozen).await;
    let leads = |update: &&pb::TrackUpdate| update.best_camera == "second";
    assert!(leads(&&found[0]));
    assert!(!found[1..].iter().any(|update| leads(&update)));
    let last = &found[79];
    assert_eq!(last.status(), pb::TrackStatus::Tracking, "{}", last.reason);
    let off = PoseError::between(&pose(last.map_from_camera.as_ref()), &room.poses()[79]);
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
                    camera: "second".to_owned(),
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
                camera: (*name).to_owned(),
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
                frame: "base_link".to_owned(),
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
            "other_views[0].camera: must be one of: second",
        ),
        (
            others(&["second", "second"], row_of("hall", 1)),
            Reason::View,
            "other_views[1].camera",
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

/// Oracle: the contract: a configuration that names no possible rig is refused by its field.
#[tokio::test]
async fn rigs_that_are_none_are_refused() {
    let server = start_followed(Default::default()).await;
    let named = |name: &str| pb::RigCamera {
        name: name.to_owned(),
        pose: Some(convert::pose_to_wire(&Pose::identity(), "", "")),
        camera: None,
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
                camera: Some(pb::CameraIntrinsics::default()),
                ..named("a")
            }],
            "config.other_cameras[0].camera",
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
