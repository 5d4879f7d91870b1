//! Navigate and EstimateMotion by the relational reader of an adapter.

use std::sync::Arc;

use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::navigation::{
    FitOn, IndexKind, Limits, Method, Mode, Navigator, Query, RequestedMotion, Source, SourceAt,
};
use seese3_core::room::FrameId;
use seese3_core::splits::Split;
use seese3_server::Config;
use seese3_store::Store;
use seese3_testing::near;
use seese3_testing::panorama::{Panorama, adapter};

use crate::harness::{TestServer, by_twist, displaced, feature, frame, latent_of, start_on};

/// A server of the room `hall` with the calibrated adapter `eyes` and, of the fine features alone,
/// the adapter `plain` without a reader.
async fn served() -> (TestServer, Panorama, Navigator) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let seen = Panorama::new("hall", 7, 60);
    store
        .publish_room(&seen.room, &seen.features)
        .await
        .unwrap();

    let (eyes, record) = adapter(true);
    let published = store.publish_adapter("eyes", &eyes, &record, seen.joined.rows());
    published.await.unwrap();
    let plain = seese3_core::training::RoomData {
        features: &seen.features[1],
        ..seen.data()
    };
    let plan = seese3_core::training::TrainingPlan::of(
        seese3_core::adapter::Preset::PaperBase,
        Split::Time,
        5,
        0,
    );
    let (plain, record) =
        seese3_core::training::train_adapter(&[plain], &plan, &mut |_| ()).unwrap();
    let published = store.publish_adapter("plain", &plain, &record, seen.features[1].rows());
    published.await.unwrap();

    let server = start_on(folder, store, Config::default()).await;
    let room = Arc::new(seen.room.clone());
    let navigator = Navigator::new(room, &seen.joined, Arc::new(eyes), IndexKind::Exact).unwrap();
    (server, seen, navigator)
}

fn request(adapter: &str, source: Option<pb::View>) -> pb::NavigateRequest {
    pb::NavigateRequest {
        room: "hall".to_owned(),
        adapter: adapter.to_owned(),
        source,
        motion: displaced(pb::requested_motion::Motion::TargetFrameId(30)),
        top_k: Some(4),
        steps: Some(2),
        navigator: "relational".to_owned(),
        ..pb::NavigateRequest::default()
    }
}

/// Oracle: the library's answer for the same room and adapter.
#[tokio::test]
async fn navigate_answers_as_the_library_does() {
    let (server, _, navigator) = served().await;
    let query = Query {
        source: SourceAt {
            source: Source::Frame(FrameId(22)),
            pose: None,
        },
        motion: RequestedMotion::TargetFrame(FrameId(30)),
        steps: 2,
        mode: Mode::OpenLoop,
        method: Method::Relational,
        fit_on: FitOn {
            split: Split::Time,
            stride: 5,
        },
        top_k: 4,
        exclude_source: None,
    };
    let expected = navigator
        .answer(&query, Limits::default(), &Cancellation::default())
        .unwrap();

    let found = server
        .client
        .navigate(request("eyes", frame(22)))
        .await
        .unwrap();
    assert_eq!(found.navigator, "relational");
    assert_eq!(found.steps.len(), 2);
    for (found, expected) in found.steps.iter().zip(&expected.steps) {
        assert!(found.latent.is_none());
        assert_eq!(found.frames.len(), expected.frames.len());
        for (found, expected) in found.frames.iter().zip(&expected.frames) {
            assert_eq!(found.frame_id, expected.neighbor.frame.0);
            // The stored poses are rounded.
            assert!((found.distance - expected.neighbor.distance).abs() < 1e-9);
        }
    }

    let of_adapter = server.client.adapter("eyes").await.unwrap();
    assert!(of_adapter.navigators.contains(&"relational".to_owned()));
    let of_plain = server.client.adapter("plain").await.unwrap();
    assert!(!of_plain.navigators.contains(&"relational".to_owned()));

    // Errors name what to change.
    let latent = latent_of("eyes", navigator.latents().row(3).to_vec());
    let by_latent = pb::NavigateRequest {
        motion: by_twist([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]),
        ..request("eyes", latent)
    };
    let refused = server.client.navigate(by_latent).await;
    assert!(refused.unwrap_err().to_string().contains("relational"));
    let refused = server.client.navigate(request("plain", frame(22))).await;
    let problem = refused.unwrap_err().to_string();
    assert!(problem.contains("no relational reader"), "{problem}");
}

/// Oracle: the library's reading of the same cells; a feature of a frame gives what the frame
/// gives.
#[tokio::test]
async fn motions_are_those_of_the_library() {
    let (server, seen, navigator) = served().await;
    let reader = navigator.adapter().relational().unwrap();
    let cells = navigator.cells().unwrap();
    let expected = reader.motions(cells, 20, &cells.select(&[27]))[0];

    let ask = |adapter: &str, first, second| pb::EstimateMotionRequest {
        room: "hall".to_owned(),
        adapter: adapter.to_owned(),
        first,
        second,
        estimator: pb::MotionEstimator::Relational.into(),
        ..pb::EstimateMotionRequest::default()
    };
    let row = |row: usize| feature(seen.joined.rows().row(row).to_vec());
    for (first, second) in [
        (frame(20), frame(27)),
        (row(20), row(27)),
        (frame(20), row(27)),
    ] {
        let are_frames = second == frame(27);
        let request = ask("eyes", first, second);
        let found = server.client.estimate_motion(request).await.unwrap();
        assert_eq!(found.estimator(), pb::MotionEstimator::Relational);
        assert_eq!(found.true_motion.is_some(), are_frames);

        let motion = found.motion.unwrap();
        let angular = motion.twist.unwrap().angular.unwrap();
        near("ω_y", angular.y, expected.twist.angular.y, 1e-6);
        assert_eq!(motion.covariance.len(), 36);
        for (place, value) in motion.covariance.iter().enumerate() {
            let expected = expected.covariance[(place / 6, place % 6)];
            near(
                "covariance",
                *value,
                expected,
                1e-5 * expected.abs().max(1.0),
            );
        }
    }

    let latent = latent_of("eyes", navigator.latents().row(3).to_vec());
    for (request, field) in [
        (ask("eyes", latent, frame(2)), "first.latent"),
        (ask("plain", frame(1), frame(2)), "estimator"),
        (
            pb::EstimateMotionRequest {
                estimator: pb::MotionEstimator::TwoView.into(),
                ..ask("eyes", frame(1), frame(2))
            },
            "estimator",
        ),
    ] {
        let refused = server.client.estimate_motion(request).await;
        let problem = refused.unwrap_err().to_string();
        assert!(problem.contains(field), "{field}: {problem}");
    }
}
