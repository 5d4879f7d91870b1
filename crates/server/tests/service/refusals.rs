//! Bad visitors: each gets the right code and the field to change, and the server goes on.

use seese3_client::Error;
use seese3_client::proto::v1 as pb;
use seese3_server::Config;
use tonic::Code;

use crate::harness::{
    by_twist, feature, feature_row, frame, latent, latent as latent_view, question, start,
    to_frame, twist,
};

#[track_caller]
fn refused<T: std::fmt::Debug>(what: &str, answer: Result<T, Error>, code: Code, field: &str) {
    let error = answer.expect_err(what);
    assert_eq!(error.code(), Some(code), "{what}: {error}");
    assert_eq!(error.field().unwrap_or_default(), field, "{what}: {error}");
    assert!(!error.to_string().contains('\n'), "{what}: one line");
}

fn target_pose(pose: pb::Pose) -> Option<pb::Displacement> {
    Some(pb::Displacement {
        displacement: Some(pb::displacement::Displacement::TargetPose(pose)),
    })
}

fn level(x: f64) -> pb::Pose {
    pb::Pose {
        position: Some(pb::Vector3 { x, y: 0.0, z: 0.0 }),
        orientation: Some(pb::Quaternion {
            w: 1.0,
            x: 0.0,
            y: 0.0,
            z: 0.0,
        }),
        ..pb::Pose::default()
    }
}

/// Oracle: a list of bad input, field by field: what each field may be stands in the protos.
#[tokio::test]
async fn navigate_names_the_field() {
    use Code::{InvalidArgument, NotFound};

    let server = start(Config::default()).await;

    let nan_row = {
        let mut row = feature_row(3);
        row[7] = f32::NAN;
        row
    };

    let named = Some(pb::View {
        view: Some(pb::view::View::Feature(pb::Feature {
            values: feature_row(3),
            source_name: "clip".to_owned(),
        })),
    });

    let no_angular = pb::Twist {
        angular: None,
        ..twist([0.0; 6])
    };
    let half = Some(pb::Displacement {
        displacement: Some(pb::displacement::Displacement::Twist(no_angular)),
    });

    let no_twists = Some(pb::Displacement {
        displacement: Some(pb::displacement::Displacement::Twists(pb::TwistList {
            twists: vec![],
        })),
    });

    let other_world = pb::Pose {
        parent_frame: "odom".to_owned(),
        ..level(0.0)
    };

    let no_rotation = pb::Pose {
        orientation: Some(pb::Quaternion {
            w: 2.0,
            x: 0.0,
            y: 0.0,
            z: 0.0,
        }),
        ..level(0.0)
    };

    let q = question;
    let cases = [
        (
            "no room",
            pb::NavigateRequest {
                room: String::new(),
                ..q()
            },
            InvalidArgument,
            "room",
        ),
        (
            "unknown room",
            pb::NavigateRequest {
                room: "x".into(),
                ..q()
            },
            NotFound,
            "room",
        ),
        (
            "unknown adapter",
            pb::NavigateRequest {
                adapter: "x".into(),
                ..q()
            },
            NotFound,
            "adapter",
        ),
        (
            "no source",
            pb::NavigateRequest {
                source: None,
                ..q()
            },
            InvalidArgument,
            "source",
        ),
        (
            "unknown frame",
            pb::NavigateRequest {
                source: frame(600),
                ..q()
            },
            NotFound,
            "source.frame_id",
        ),
        (
            "unknown target",
            pb::NavigateRequest {
                displacement: to_frame(9999),
                ..q()
            },
            NotFound,
            "displacement.target_frame_id",
        ),
        (
            "NaN feature",
            pb::NavigateRequest {
                source: feature(nan_row),
                displacement: by_twist([0.0; 6]),
                ..q()
            },
            InvalidArgument,
            "source.feature.values",
        ),
        (
            "narrow feature",
            pb::NavigateRequest {
                source: feature(vec![1.0; 47]),
                displacement: by_twist([0.0; 6]),
                ..q()
            },
            InvalidArgument,
            "source.feature.values",
        ),
        (
            "empty feature",
            pb::NavigateRequest {
                source: feature(vec![]),
                displacement: by_twist([0.0; 6]),
                ..q()
            },
            InvalidArgument,
            "source.feature.values",
        ),
        (
            "other encoder",
            pb::NavigateRequest {
                source: named,
                displacement: by_twist([0.0; 6]),
                ..q()
            },
            InvalidArgument,
            "source.feature.source_name",
        ),
        (
            "infinite latent",
            pb::NavigateRequest {
                source: latent(vec![f64::INFINITY; 20]),
                displacement: by_twist([0.0; 6]),
                ..q()
            },
            InvalidArgument,
            "source.latent.values",
        ),
        (
            "wide latent",
            pb::NavigateRequest {
                source: latent(vec![0.0; 21]),
                displacement: by_twist([0.0; 6]),
                ..q()
            },
            InvalidArgument,
            "source.latent.values",
        ),
        (
            "no displacement",
            pb::NavigateRequest {
                displacement: None,
                ..q()
            },
            InvalidArgument,
            "displacement",
        ),
        (
            "half a twist",
            pb::NavigateRequest {
                displacement: half,
                ..q()
            },
            InvalidArgument,
            "displacement.twist.angular",
        ),
        (
            "NaN twist",
            pb::NavigateRequest {
                displacement: by_twist([f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0]),
                ..q()
            },
            InvalidArgument,
            "displacement.twist.linear",
        ),
        (
            "beyond π",
            pb::NavigateRequest {
                displacement: by_twist([0.0, 0.0, 0.0, 0.0, 3.2, 0.0]),
                ..q()
            },
            InvalidArgument,
            "displacement",
        ),
        (
            "far away",
            pb::NavigateRequest {
                displacement: by_twist([1e300, 0.0, 0.0, 0.0, 0.0, 0.0]),
                ..q()
            },
            InvalidArgument,
            "displacement",
        ),
        (
            "no twists",
            pb::NavigateRequest {
                displacement: no_twists,
                ..q()
            },
            InvalidArgument,
            "displacement",
        ),
        (
            "another world",
            pb::NavigateRequest {
                displacement: target_pose(other_world),
                ..q()
            },
            InvalidArgument,
            "displacement.target_pose.parent_frame",
        ),
        (
            "no rotation",
            pb::NavigateRequest {
                displacement: target_pose(no_rotation),
                ..q()
            },
            InvalidArgument,
            "displacement.target_pose.orientation",
        ),
        (
            "0 steps",
            pb::NavigateRequest {
                steps: Some(0),
                ..q()
            },
            InvalidArgument,
            "steps",
        ),
        (
            "10⁶ steps",
            pb::NavigateRequest {
                steps: Some(1_000_000),
                ..q()
            },
            InvalidArgument,
            "steps",
        ),
        (
            "2³² − 1 steps",
            pb::NavigateRequest {
                steps: Some(u32::MAX),
                ..q()
            },
            InvalidArgument,
            "steps",
        ),
        (
            "0 hits",
            pb::NavigateRequest {
                top_k: Some(0),
                ..q()
            },
            InvalidArgument,
            "top_k",
        ),
        (
            "10⁹ hits",
            pb::NavigateRequest {
                top_k: Some(1_000_000_000),
                ..q()
            },
            InvalidArgument,
            "top_k",
        ),
        (
            "10⁶ frames in one answer",
            pb::NavigateRequest {
                steps: Some(1_000),
                top_k: Some(1_000),
                ..q()
            },
            InvalidArgument,
            "top_k",
        ),
        (
            "ε of 0",
            pb::NavigateRequest {
                thresholds: vec![0.1, 0.0],
                ..q()
            },
            InvalidArgument,
            "thresholds",
        ),
        (
            "ε NaN",
            pb::NavigateRequest {
                thresholds: vec![f64::NAN],
                ..q()
            },
            InvalidArgument,
            "thresholds",
        ),
        (
            "unknown mode",
            pb::NavigateRequest { mode: 77, ..q() },
            InvalidArgument,
            "mode",
        ),
        (
            "unknown reading",
            pb::NavigateRequest { reading: -1, ..q() },
            InvalidArgument,
            "reading",
        ),
        (
            "a frame with a pose",
            pb::NavigateRequest {
                source_pose: Some(level(0.0)),
                ..q()
            },
            InvalidArgument,
            "source_pose",
        ),
        (
            "a target without a pose",
            pb::NavigateRequest {
                source: feature(feature_row(3)),
                ..q()
            },
            InvalidArgument,
            "source_pose",
        ),
        (
            "all excluded",
            pb::NavigateRequest {
                exclude_source: true,
                exclude_radius: u32::MAX,
                ..q()
            },
            InvalidArgument,
            "exclude_radius",
        ),
    ];

    for (what, request, code, field) in cases {
        refused(what, server.client.navigate(request).await, code, field);
    }

    assert!(
        server.client.navigate(question()).await.is_ok(),
        "the server goes on"
    );
}

/// Oracle: as above, for the other calls.
#[tokio::test]
async fn the_other_calls_name_the_field() {
    use Code::{InvalidArgument, NotFound};

    let server = start(Config {
        batch: 2,
        predictions: 3,
        ..Config::default()
    })
    .await;
    let c = &server.client;

    let l = pb::LocalizeRequest::default;

    let rooms = |names: &[&str]| {
        names
            .iter()
            .map(|name| (*name).to_owned())
            .collect::<Vec<_>>()
    };

    refused("no view", c.localize(l()).await, InvalidArgument, "view");

    refused(
        "a frame of many rooms",
        c.localize(pb::LocalizeRequest {
            view: frame(1),
            ..l()
        })
        .await,
        InvalidArgument,
        "view.frame_id",
    );

    refused(
        "a room twice",
        c.localize(pb::LocalizeRequest {
            rooms: rooms(&["synthetic", "synthetic"]),
            adapter: "oracle".into(),
            view: feature(feature_row(1)),
            ..l()
        })
        .await,
        InvalidArgument,
        "rooms",
    );

    refused(
        "unknown room",
        c.localize(pb::LocalizeRequest {
            rooms: rooms(&["x"]),
            view: frame(1),
            ..l()
        })
        .await,
        NotFound,
        "rooms[0]",
    );

    refused(
        "0 hits",
        c.localize(pb::LocalizeRequest {
            top_k: Some(0),
            ..l()
        })
        .await,
        InvalidArgument,
        "top_k",
    );

    refused(
        "narrow feature",
        c.localize(pb::LocalizeRequest {
            view: feature(vec![1.0]),
            ..l()
        })
        .await,
        InvalidArgument,
        "view.feature.values",
    );

    let m = pb::EstimateMotionRequest::default;
    refused(
        "no first",
        c.estimate_motion(m()).await,
        InvalidArgument,
        "first",
    );

    refused(
        "frames without a room",
        c.estimate_motion(pb::EstimateMotionRequest {
            first: frame(1),
            ..m()
        })
        .await,
        InvalidArgument,
        "room",
    );

    // A focal length in image widths is refused, whoever would read the motion.
    refused(
        "focal length in widths",
        c.estimate_motion(pb::EstimateMotionRequest {
            first: feature(feature_row(1)),
            second: feature(feature_row(2)),
            camera: Some(pb::Pinhole {
                width: 640.0,
                height: 480.0,
                focal: 0.914,
                ..pb::Pinhole::default()
            }),
            ..m()
        })
        .await,
        InvalidArgument,
        "camera",
    );

    refused(
        "narrow second",
        c.estimate_motion(pb::EstimateMotionRequest {
            first: feature(feature_row(1)),
            second: feature(vec![0.0]),
            ..m()
        })
        .await,
        InvalidArgument,
        "second.feature.values",
    );

    refused(
        "unknown frame",
        c.estimate_motion(pb::EstimateMotionRequest {
            room: "synthetic".into(),
            first: frame(1),
            second: frame(600),
            ..m()
        })
        .await,
        NotFound,
        "second.frame_id",
    );

    let e = || pb::EvaluateRequest {
        room: "synthetic".into(),
        ..pb::EvaluateRequest::default()
    };

    refused(
        "0 stride",
        c.evaluate(
            pb::EvaluateRequest {
                stride: Some(0),
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "stride",
    );

    refused(
        "a stride longer than the room",
        c.evaluate(
            pb::EvaluateRequest {
                stride: Some(u32::MAX),
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "stride",
    );

    refused(
        "unknown split",
        c.evaluate(
            pb::EvaluateRequest {
                split: "random".into(),
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "split",
    );

    refused(
        "unknown navigator",
        c.evaluate(
            pb::EvaluateRequest {
                navigators: rooms(&["magic"]),
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "navigators",
    );

    refused(
        "ε below 0",
        c.evaluate(
            pb::EvaluateRequest {
                thresholds: vec![-0.1],
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "thresholds",
    );

    refused(
        "257 thresholds",
        c.evaluate(
            pb::EvaluateRequest {
                thresholds: vec![0.1; 257],
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "thresholds",
    );

    let s = |predictions| pb::ScorePredictionsRequest {
        room: "synthetic".into(),
        split: "time".into(),
        predictions,
        ..Default::default()
    };

    let p = |frame, prediction| pb::Prediction {
        source_frame_id: 500,
        target_frame_id: frame,
        prediction,
        ..Default::default()
    };

    let retrieved = |frame| Some(pb::prediction::Prediction::RetrievedFrameId(frame));

    let latent = |width| {
        Some(pb::prediction::Prediction::Latent(pb::Latent {
            values: vec![0.0; width],
        }))
    };

    refused(
        "none",
        c.score_predictions(s(vec![])).await,
        InvalidArgument,
        "predictions",
    );

    refused(
        "too many",
        c.score_predictions(s(vec![p(540, retrieved(541)); 4]))
            .await,
        InvalidArgument,
        "predictions",
    );

    refused(
        "an empty one",
        c.score_predictions(s(vec![p(540, retrieved(541)), p(540, None)]))
            .await,
        InvalidArgument,
        "predictions[1]",
    );

    refused(
        "unknown target",
        c.score_predictions(s(vec![p(600, retrieved(541))])).await,
        InvalidArgument,
        "predictions[0]",
    );

    refused(
        "no candidate",
        c.score_predictions(s(vec![p(540, retrieved(3))])).await,
        InvalidArgument,
        "predictions[0]",
    );

    refused(
        "narrow latent",
        c.score_predictions(s(vec![p(540, latent(19))])).await,
        InvalidArgument,
        "predictions[0]",
    );

    refused(
        "a mixture",
        c.score_predictions(s(vec![p(540, latent(20)), p(540, retrieved(541))]))
            .await,
        InvalidArgument,
        "predictions",
    );

    refused(
        "empty batch",
        c.batch_navigate(vec![]).await,
        InvalidArgument,
        "requests",
    );

    refused(
        "large batch",
        c.batch_navigate(vec![question(); 3]).await,
        InvalidArgument,
        "requests",
    );

    let wide = pb::NavigateRequest {
        steps: Some(10),
        top_k: Some(501),
        ..question()
    };

    refused(
        "a batch of many frames",
        c.batch_navigate(vec![wide; 2]).await,
        InvalidArgument,
        "requests",
    );

    let twists = vec![twist([0.0; 6]); 1_000];
    let list = pb::displacement::Displacement::Twists(pb::TwistList { twists });
    let list = Some(pb::Displacement {
        displacement: Some(list),
    });
    let long = pb::NavigateRequest {
        displacement: list,
        top_k: Some(6),
        ..question()
    };

    refused(
        "a batch of long lists",
        c.batch_navigate(vec![long; 2]).await,
        InvalidArgument,
        "requests",
    );

    let far = vec![0.0; 19].into_iter().chain([1e300]).collect();
    refused(
        "far latent",
        c.localize(pb::LocalizeRequest {
            view: latent_view(far),
            ..l()
        })
        .await,
        InvalidArgument,
        "view.latent.values",
    );

    let long_name = "x".repeat(100_000);
    refused("long name", c.room(&long_name).await, NotFound, "room");

    refused(
        "a navigator twice",
        c.evaluate(
            pb::EvaluateRequest {
                navigators: rooms(&["random", "random"]),
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "navigators",
    );

    refused(
        "a radius without exclusion",
        c.evaluate(
            pb::EvaluateRequest {
                exclude_radius: 3,
                ..e()
            },
            |_| (),
        )
        .await,
        InvalidArgument,
        "exclude_radius",
    );

    let excluded = |predictions| pb::ScorePredictionsRequest {
        exclude_source: true,
        ..s(predictions)
    };

    refused(
        "the source itself",
        c.score_predictions(excluded(vec![p(540, retrieved(500))]))
            .await,
        InvalidArgument,
        "predictions[0]",
    );

    let trained = pb::Prediction {
        source_frame_id: 1,
        target_frame_id: 41,
        prediction: retrieved(541),
        ..Default::default()
    };

    refused(
        "no test pair",
        c.score_predictions(s(vec![trained])).await,
        InvalidArgument,
        "predictions[0]",
    );

    refused("unknown adapter", c.adapter("x").await, NotFound, "adapter");
    refused("unknown room", c.room("x").await, NotFound, "room");
}

/// Oracle: the bound itself: a message over it is refused by its size, one under it is read.
#[tokio::test]
async fn a_message_over_the_bound_is_refused() {
    let server = start(Config {
        message_bytes: 4_096,
        ..Config::default()
    })
    .await;

    let large = pb::NavigateRequest {
        source: feature(vec![0.5; 2_000]),
        ..question()
    };
    let error = server.client.navigate(large).await.unwrap_err();

    assert_eq!(error.code(), Some(Code::OutOfRange), "{error}");
    assert!(server.client.navigate(question()).await.is_ok());
}
