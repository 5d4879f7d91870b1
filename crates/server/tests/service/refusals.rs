//! Bad visitors: each gets the right code and the field to change, and the server goes on.

use pb::prediction::Prediction as Scored;
use pb::requested_motion::Motion;
use seese3_client::Error;
use seese3_client::proto::v1 as pb;
use seese3_server::Config;
use tonic::Code::{self, InvalidArgument, NotFound};

use crate::harness::{
    TestServer, by_twist, by_twists, displaced, feature, feature_row, frame, latent, of_intrinsics,
    question, refused, start, to_frame, to_pose, twist,
};

/// What is bad about a request, how a good one becomes so, and the field that the answer names.
type Case<R> = (&'static str, fn(&mut R), &'static str);

/// A good request and the call that asks it.
struct Asked<R, A>(R, A);

impl<R: Clone, T: std::fmt::Debug, A: AsyncFn(R) -> Result<T, Error>> Asked<R, A> {
    async fn refuses(&self, code: Code, cases: &[Case<R>]) {
        for &(what, spoil, field) in cases {
            let mut request = self.0.clone();
            spoil(&mut request);
            refused(what, self.1(request).await, code, field);
        }
    }
}

fn turned(w: f64) -> Option<pb::Quaternion> {
    Some(pb::Quaternion {
        w,
        x: 0.0,
        y: 0.0,
        z: 0.0,
    })
}

fn level() -> pb::Pose {
    pb::Pose {
        position: Some(pb::Vector3 {
            x: 0.0,
            y: 0.0,
            z: 0.0,
        }),
        orientation: turned(1.0),
        ..pb::Pose::default()
    }
}

fn named(feature_set: &str) -> Option<pb::View> {
    let feature = pb::Feature {
        values: feature_row(3),
        feature_set: feature_set.to_owned(),
    };
    Some(pb::View {
        view: Some(pb::view::View::Feature(feature)),
    })
}

/// Oracle: a list of bad input, field by field: what each field may be stands in the protos.
#[tokio::test]
async fn navigate_names_the_field() {
    // A request by a view, of which the frame is not known.
    fn by_view(request: &mut pb::NavigateRequest, source: Option<pb::View>) {
        request.source = source;
        request.motion = by_twist([0.0; 6]);
    }

    let invalid: [Case<pb::NavigateRequest>; 27] = [
        ("no room", |r| r.room.clear(), "room"),
        ("no source", |r| r.source = None, "source"),
        (
            "NaN feature",
            |r| {
                let mut row = feature_row(3);
                row[7] = f32::NAN;
                by_view(r, feature(row));
            },
            "source.feature.values",
        ),
        (
            "narrow feature",
            |r| by_view(r, feature(vec![1.0; 47])),
            "source.feature.values",
        ),
        (
            "empty feature",
            |r| by_view(r, feature(vec![])),
            "source.feature.values",
        ),
        (
            "other encoder",
            |r| by_view(r, named("clip")),
            "source.feature.feature_set",
        ),
        (
            "infinite latent",
            |r| by_view(r, latent(vec![f64::INFINITY; 20])),
            "source.latent.values",
        ),
        (
            "wide latent",
            |r| by_view(r, latent(vec![0.0; 21])),
            "source.latent.values",
        ),
        ("no motion", |r| r.motion = None, "motion"),
        (
            "half a twist",
            |r| {
                let half = pb::Twist {
                    angular: None,
                    ..twist([0.0; 6])
                };
                r.motion = displaced(Motion::Twist(half));
            },
            "motion.twist.angular",
        ),
        (
            "NaN twist",
            |r| r.motion = by_twist([f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0]),
            "motion.twist.linear",
        ),
        (
            "beyond π",
            |r| r.motion = by_twist([0.0, 0.0, 0.0, 0.0, 3.2, 0.0]),
            "motion",
        ),
        (
            "far away",
            |r| r.motion = by_twist([1e300, 0.0, 0.0, 0.0, 0.0, 0.0]),
            "motion",
        ),
        ("no twists", |r| r.motion = by_twists(vec![]), "motion"),
        (
            "another world",
            |r| {
                r.motion = to_pose(pb::Pose {
                    parent_frame: "odom".into(),
                    ..level()
                })
            },
            "motion.target_pose.parent_frame",
        ),
        (
            "no rotation",
            |r| {
                r.motion = to_pose(pb::Pose {
                    orientation: turned(2.0),
                    ..level()
                })
            },
            "motion.target_pose.orientation",
        ),
        ("0 steps", |r| r.steps = Some(0), "steps"),
        ("10⁶ steps", |r| r.steps = Some(1_000_000), "steps"),
        ("2³² − 1 steps", |r| r.steps = Some(u32::MAX), "steps"),
        ("0 hits", |r| r.top_k = Some(0), "top_k"),
        ("10⁹ hits", |r| r.top_k = Some(1_000_000_000), "top_k"),
        (
            "10⁶ frames in one answer",
            |r| (r.steps, r.top_k) = (Some(1_000), Some(1_000)),
            "top_k",
        ),
        ("unknown mode", |r| r.step_mode = 77, "step_mode"),
        (
            "unknown variant",
            |r| r.inverse_variant = -1,
            "inverse_variant",
        ),
        (
            "a frame with a pose",
            |r| r.source_pose = Some(level()),
            "source_pose",
        ),
        (
            "a target without a pose",
            |r| r.source = feature(feature_row(3)),
            "source_pose",
        ),
        (
            "all excluded",
            |r| (r.exclude_source, r.exclude_radius) = (true, u32::MAX),
            "exclude_radius",
        ),
    ];
    let unknown: [Case<pb::NavigateRequest>; 4] = [
        ("unknown room", |r| r.room = "x".into(), "room"),
        ("unknown adapter", |r| r.adapter = "x".into(), "adapter"),
        (
            "unknown frame",
            |r| r.source = frame(600),
            "source.frame_id",
        ),
        (
            "unknown target",
            |r| r.motion = to_frame(9999),
            "motion.target_frame_id",
        ),
    ];

    let server = start(Config::default()).await;
    let ask = async |request| server.client.navigate(request).await;
    let asked = Asked(question(), ask);
    asked.refuses(InvalidArgument, &invalid).await;
    asked.refuses(NotFound, &unknown).await;

    let next = server.client.navigate(question()).await;
    assert!(next.is_ok(), "the server goes on");
}

/// A server with low bounds.
async fn start_bounded() -> TestServer {
    start(Config {
        batch: 2,
        predictions: 3,
        ..Config::default()
    })
    .await
}

/// Oracle: as above.
#[tokio::test]
async fn localize_names_the_field() {
    let invalid: [Case<pb::LocalizeRequest>; 6] = [
        ("no view", |_| (), "view"),
        (
            "a frame of many rooms",
            |r| r.view = frame(1),
            "view.frame_id",
        ),
        (
            "a room twice",
            |r| {
                r.rooms = vec!["synthetic".into(); 2];
                r.adapter = "oracle".into();
                r.view = feature(feature_row(1));
            },
            "rooms",
        ),
        ("0 hits", |r| r.top_k = Some(0), "top_k"),
        (
            "narrow feature",
            |r| r.view = feature(vec![1.0]),
            "view.feature.values",
        ),
        (
            "far latent",
            |r| r.view = latent([vec![0.0; 19], vec![1e300]].concat()),
            "view.latent.values",
        ),
    ];
    let unknown: [Case<pb::LocalizeRequest>; 1] = [(
        "unknown room",
        |r| (r.rooms, r.view) = (vec!["x".into()], frame(1)),
        "rooms[0]",
    )];

    let server = start_bounded().await;
    let ask = async |request| server.client.localize(request).await;
    let asked = Asked(pb::LocalizeRequest::default(), ask);
    asked.refuses(InvalidArgument, &invalid).await;
    asked.refuses(NotFound, &unknown).await;
}

/// Oracle: as above.
#[tokio::test]
async fn estimate_motion_names_the_field() {
    let invalid: [Case<pb::EstimateMotionRequest>; 5] = [
        ("no first", |_| (), "first"),
        ("frames without a room", |r| r.first = frame(1), "room"),
        (
            // It is refused, whoever would read the motion.
            "focal length in widths",
            |r| {
                r.first = feature(feature_row(1));
                r.second = feature(feature_row(2));
                r.camera = of_intrinsics(pb::CameraIntrinsics {
                    width: 640.0,
                    height: 480.0,
                    fx: 0.914,
                    ..pb::CameraIntrinsics::default()
                });
            },
            "camera.intrinsics",
        ),
        (
            "coefficients without a model",
            |r| {
                r.first = feature(feature_row(1));
                r.second = feature(feature_row(2));
                r.camera = of_intrinsics(pb::CameraIntrinsics {
                    width: 640.0,
                    height: 480.0,
                    fx: 525.0,
                    distortion: vec![0.1],
                    ..pb::CameraIntrinsics::default()
                });
            },
            "camera.intrinsics.distortion_model",
        ),
        (
            "narrow second",
            |r| (r.first, r.second) = (feature(feature_row(1)), feature(vec![0.0])),
            "second.feature.values",
        ),
    ];
    let unknown: [Case<pb::EstimateMotionRequest>; 1] = [(
        "unknown frame",
        |r| {
            r.room = "synthetic".into();
            (r.first, r.second) = (frame(1), frame(600));
        },
        "second.frame_id",
    )];

    let server = start_bounded().await;
    let ask = async |request| server.client.estimate_motion(request).await;
    let asked = Asked(pb::EstimateMotionRequest::default(), ask);
    asked.refuses(InvalidArgument, &invalid).await;
    asked.refuses(NotFound, &unknown).await;
}

/// Oracle: as above.
#[tokio::test]
async fn evaluate_names_the_field() {
    let invalid: [Case<pb::EvaluateRequest>; 8] = [
        ("0 stride", |r| r.stride = Some(0), "stride"),
        (
            "a stride longer than the room",
            |r| r.stride = Some(u32::MAX),
            "stride",
        ),
        ("unknown split", |r| r.split = 77, "split"),
        (
            "unknown navigator",
            |r| r.navigators = vec!["magic".into()],
            "navigators",
        ),
        ("ε below 0", |r| r.thresholds = vec![-0.1], "thresholds"),
        (
            "257 thresholds",
            |r| r.thresholds = vec![0.1; 257],
            "thresholds",
        ),
        (
            "a navigator twice",
            |r| r.navigators = vec!["random".into(); 2],
            "navigators",
        ),
        (
            "a radius without exclusion",
            |r| r.exclude_radius = 3,
            "exclude_radius",
        ),
    ];

    let server = start_bounded().await;
    let good = pb::EvaluateRequest {
        room: "synthetic".into(),
        ..Default::default()
    };
    let ask = async |request| server.client.evaluate(request, |_| ()).await;
    let asked = Asked(good, ask);
    asked.refuses(InvalidArgument, &invalid).await;
}

/// Oracle: as above.
#[tokio::test]
async fn score_predictions_names_the_field() {
    fn from_to(source: u32, target: u32, scored: Option<Scored>) -> pb::Prediction {
        pb::Prediction {
            source_frame_id: source,
            target_frame_id: target,
            prediction: scored,
            ..Default::default()
        }
    }
    fn retrieved(target: u32, frame: u32) -> pb::Prediction {
        from_to(500, target, Some(Scored::RetrievedFrameId(frame)))
    }
    fn latent(width: usize) -> pb::Prediction {
        let values = vec![0.0; width];
        let latent = pb::Latent {
            values,
            adapter: None,
        };
        from_to(500, 540, Some(Scored::Latent(latent)))
    }

    let invalid: [Case<pb::ScorePredictionsRequest>; 10] = [
        ("none", |_| (), "predictions"),
        (
            "too many",
            |r| r.predictions = (0..4).map(|step| retrieved(540 + step, 541)).collect(),
            "predictions",
        ),
        (
            "a pair twice",
            |r| r.predictions = vec![retrieved(540, 541); 2],
            "predictions[1]",
        ),
        (
            "an empty one",
            |r| r.predictions = vec![retrieved(540, 541), from_to(500, 541, None)],
            "predictions[1]",
        ),
        (
            "unknown target",
            |r| r.predictions = vec![retrieved(600, 541)],
            "predictions[0]",
        ),
        (
            "no candidate",
            |r| r.predictions = vec![retrieved(540, 3)],
            "predictions[0]",
        ),
        (
            "narrow latent",
            |r| r.predictions = vec![latent(19)],
            "predictions[0]",
        ),
        (
            "a mixture",
            |r| r.predictions = vec![latent(20), retrieved(541, 541)],
            "predictions",
        ),
        (
            "the source itself",
            |r| (r.exclude_source, r.predictions) = (true, vec![retrieved(540, 500)]),
            "predictions[0]",
        ),
        (
            "no test pair",
            |r| r.predictions = vec![from_to(1, 41, Some(Scored::RetrievedFrameId(541)))],
            "predictions[0]",
        ),
    ];

    let server = start_bounded().await;
    let good = pb::ScorePredictionsRequest {
        room: "synthetic".into(),
        adapter: "oracle".into(),
        split: pb::Split::Time.into(),
        ..Default::default()
    };
    let ask = async |request| server.client.score_predictions(request).await;
    let asked = Asked(good, ask);
    asked.refuses(InvalidArgument, &invalid).await;
}

/// Oracle: as above.
#[tokio::test]
async fn batches_and_the_catalog_name_the_field() {
    let invalid: [Case<Vec<pb::NavigateRequest>>; 4] = [
        ("empty batch", Vec::clear, "requests"),
        ("large batch", |batch| batch.push(question()), "requests"),
        (
            "a batch of many frames",
            |batch| {
                batch
                    .iter_mut()
                    .for_each(|r| (r.steps, r.top_k) = (Some(10), Some(501)))
            },
            "requests",
        ),
        (
            "a batch of long lists",
            |batch| {
                let list = by_twists(vec![twist([0.0; 6]); 1_000]);
                batch
                    .iter_mut()
                    .for_each(|r| (r.motion, r.top_k) = (list.clone(), Some(6)));
            },
            "requests",
        ),
    ];

    let server = start_bounded().await;
    let client = &server.client;
    let ask = async |batch| client.batch_navigate(batch).await;
    let asked = Asked(vec![question(); 2], ask);
    asked.refuses(InvalidArgument, &invalid).await;

    let long_name = "x".repeat(100_000);
    let answer = client.room(&long_name).await;
    let message = answer.as_ref().unwrap_err().to_string();
    assert!(message.len() < 300, "{} bytes", message.len());
    refused("long name", answer, NotFound, "room");
    refused(
        "unknown adapter",
        client.adapter("x").await,
        NotFound,
        "adapter",
    );
    refused("unknown room", client.room("x").await, NotFound, "room");
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
