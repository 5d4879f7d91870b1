//! An adapter that was fitted to a room, over the wire: it serves that room alone, and says where a
//! view is, how sure that is, and what told it.

use std::sync::Arc;

use seese3_client::convert;
use seese3_client::proto::v1 as pb;
use seese3_core::adapter::Preset;
use seese3_core::geometry::PoseError;
use seese3_core::room::FrameId;
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};
use seese3_robot::fitting::{FitRun, fit};
use seese3_server::Config;
use seese3_store::{BaseAdapter, RoomFit, Store};
use tonic::Code;

use crate::harness::{TestServer, feature, frame, latent_of, refused, start_on, until};
use seese3_testing::world::{calibrated, served};

/// The places hall and attic, an adapter of both, and one that goes on from it in the hall.
async fn server() -> TestServer {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    for name in ["hall", "attic"] {
        let (room, features) = served(name);
        store.publish_room(&room, &[features]).await.unwrap();
    }

    let (adapter, record) = calibrated();
    let (room, features) = served("hall");
    store
        .publish_adapter("base", &adapter, &record, features.rows())
        .await
        .unwrap();

    let data = RoomData {
        room: &room,
        revision: 1,
        features: &features,
    };
    let mapped: Vec<FrameId> = (0..room.frame_count() as u32).map(FrameId).collect();
    let fitted = fit(
        &data,
        &mapped,
        Some(&Arc::new(adapter)),
        0,
        FitRun::UNWATCHED,
    )
    .unwrap();
    let room_fit = RoomFit {
        room: room.id().clone(),
        room_revision: 1,
        base: Some(BaseAdapter {
            name: "base".to_owned(),
            revision: 1,
        }),
        rules: fitted.rules.clone(),
    };
    store
        .publish_fitted("hall.fitted", &fitted, &room_fit, features.rows())
        .await
        .unwrap();

    // What is read back is what was published.
    let stored = store.load_adapter("hall.fitted", None).await.unwrap();
    assert_eq!(stored.room_fit, Some(room_fit));

    start_on(folder, store, Config::default()).await
}

fn localize(room: &str, view: Option<pb::View>) -> pb::LocalizeRequest {
    pb::LocalizeRequest {
        rooms: vec![room.to_owned()],
        adapter: "hall.fitted".to_owned(),
        view,
        ..pb::LocalizeRequest::default()
    }
}

/// Oracle: the recorded pose of the frame whose feature is sent, and the promises of the protocol.
#[tokio::test]
async fn a_view_is_located_in_the_room_of_its_adapter() {
    let server = server().await;
    let (room, features) = served("hall");

    for row in [7, 100, 233] {
        let view = feature(features.rows().row(row).to_vec());
        let answer = server
            .client
            .localize(localize("hall", view))
            .await
            .unwrap();
        assert_eq!(answer.method(), pb::LocalizationMethod::FittedAdapter);
        let located = answer.pose.unwrap();
        let fitted = answer.fitted.unwrap();

        let pose = convert::pose(&located.pose.unwrap()).unwrap();
        let error = PoseError::between(&pose, &room.poses()[row]);
        assert!(
            error.translation_m < 0.01 && error.rotation_rad < 0.01,
            "{error:?}"
        );
        assert_eq!(located.covariance.len(), 36);
        assert_eq!(fitted.frame_id as usize, row);
        let estimator = fitted.translation_estimator();
        assert_ne!(estimator, pb::RelativeEstimator::Unspecified);
        assert!((0.0..=1.0).contains(&fitted.rotation_gain));
        assert_eq!(answer.room.unwrap().name, "hall");
        assert!(answer.novelty.unwrap() <= 1.0 && answer.reason.is_empty());
    }

    // A stored frame has a pose of its own.
    let answer = server
        .client
        .localize(localize("hall", frame(3)))
        .await
        .unwrap();
    assert_eq!(answer.method(), pb::LocalizationMethod::Recorded);
    let pose = convert::pose(&answer.pose.unwrap().pose.unwrap()).unwrap();
    let error = PoseError::between(&pose, &room.poses()[3]);
    assert!(
        error.translation_m < 1e-9 && error.rotation_rad < 1e-7,
        "{error:?}"
    );
}

/// Oracle: the promise of PlanRoute: nothing is planned for a view that tells no place. An adapter
/// that was fitted to a room and calibrated nowhere knows that too.
#[tokio::test]
async fn a_fitted_adapter_starts_no_way_from_elsewhere() {
    use pb::plan_route_request::Goal;

    let server = server().await;
    let ask = async |values: Vec<f32>| {
        let asked = pb::PlanRouteRequest {
            room: "hall".to_owned(),
            source: feature(values),
            goal: Some(Goal::GoalFrameId(120)),
            ..Default::default()
        };
        server.client.plan_route(asked).await.unwrap()
    };

    let own = ask(served("hall").1.rows().row(40).to_vec()).await;
    assert_eq!(own.adapter.as_ref().unwrap().name, "hall.fitted");
    assert_eq!(own.outcome(), pb::RouteOutcome::Found, "{}", own.message);
    assert!(
        own.arrival_probability
            .is_some_and(|probability| probability > 0.5)
    );

    let width = served("hall").1.rows().ncols();
    for elsewhere in [
        served("attic").1.rows().row(40).to_vec(),
        vec![0.0; width],
        served("hall").1.rows().row(40).mapv(|x| 10.0 * x).to_vec(),
    ] {
        let answer = ask(elsewhere).await;
        assert_eq!(
            answer.outcome(),
            pb::RouteOutcome::StartUnknown,
            "{}",
            answer.message
        );
    }
}

/// Oracle: the promise that a fitted adapter serves its own room alone, where it is the default.
#[tokio::test]
async fn a_fitted_adapter_serves_no_other_room() {
    let server = server().await;
    let view = feature(served("attic").1.rows().row(0).to_vec());
    let refused = server
        .client
        .localize(localize("attic", view.clone()))
        .await;
    assert_eq!(refused.unwrap_err().code(), Some(Code::FailedPrecondition));

    let by_default = |room: &str| pb::LocalizeRequest {
        adapter: String::new(),
        ..localize(room, view.clone())
    };
    let attic = server.client.localize(by_default("attic")).await.unwrap();
    assert_eq!(attic.adapter.unwrap().name, "base");
    assert_ne!(
        pb::LocalizationMethod::try_from(attic.method),
        Ok(pb::LocalizationMethod::FittedAdapter)
    );

    let hall = server.client.localize(by_default("hall")).await.unwrap();
    assert_eq!(hall.adapter.unwrap().name, "hall.fitted");
}

/// Oracle: the promise of the protocol: the room that an adapter was fitted to answers with the
/// pose that it locates, the other room with that of its nearest frame; a latent has no feature to
/// locate.
#[tokio::test]
async fn a_fitted_room_is_relocalized_by_its_own_adapter() {
    let server = server().await;
    let (room, features) = served("hall");
    let ask = |view: Option<pb::View>| pb::RelocalizeRequest {
        views: vec![view.unwrap()],
        ..pb::RelocalizeRequest::default()
    };

    // Noise keeps the view apart from the frame that it resembles.
    let view: Vec<f32> = features.rows().row(100).iter().map(|x| x + 0.01).collect();
    let found = server.client.relocalize(ask(feature(view.clone()))).await;
    let found = found.unwrap();

    let [hall, attic] = found.rooms.as_slice() else {
        panic!("{found:?}")
    };
    assert_eq!(hall.room.as_ref().unwrap().name, "hall");
    assert!(attic.fitted.is_none());
    assert_eq!(hall.method(), pb::LocalizationMethod::FittedAdapter);
    let alone = server
        .client
        .localize(localize("hall", feature(view)))
        .await;
    let alone = alone.unwrap();
    assert_eq!((&alone.pose, &alone.fitted), (&hall.pose, &hall.fitted));

    let pose = hall.pose.as_ref().unwrap().pose.as_ref().unwrap();
    let pose = convert::pose(pose).unwrap();
    let error = PoseError::between(&pose, &room.poses()[100]);
    assert!(error.translation_m < 0.05, "{error:?}");

    let row = features.rows().row(100).to_vec();
    let view = latent_of("base", calibrated().0.embed_one(&row).unwrap().to_vec());
    let found = server.client.relocalize(ask(view)).await.unwrap();
    assert!(found.rooms.iter().all(|room| room.fitted.is_none()));
}

/// Oracle: the rules of docs/defaults.md. The server has rooms hall and attic, an adapter of both
/// and one that is fitted to the hall.
#[tokio::test]
async fn a_fitted_adapter_does_not_count_where_no_room_is_named() {
    let server = server().await;
    let client = &server.client;
    let (_, features) = served("attic");
    let view = || feature(features.rows().row(20).to_vec());

    let located = pb::LocalizeRequest {
        view: view(),
        ..Default::default()
    };
    let relocalized = pb::RelocalizeRequest {
        views: view().into_iter().collect(),
        ..Default::default()
    };
    let motion = pb::EstimateMotionRequest {
        first: view(),
        second: view(),
        ..Default::default()
    };
    let encoded = pb::EncodeRequest {
        views: view().into_iter().collect(),
        ..Default::default()
    };
    let used = [
        client.localize(located).await.unwrap().adapter,
        client.relocalize(relocalized).await.unwrap().adapter,
        client.estimate_motion(motion).await.unwrap().adapter,
        client.encode(encoded).await.unwrap().adapter,
    ];
    for adapter in used {
        assert_eq!(adapter.unwrap().name, "base");
    }

    let in_the_hall = pb::LocalizeRequest {
        rooms: vec!["hall".to_owned()],
        view: view(),
        ..Default::default()
    };
    let used = client.localize(in_the_hall).await.unwrap().adapter;
    assert_eq!(used.unwrap().name, "hall.fitted");
}

/// Oracle: the training records. Both adapters were trained on every frame of the hall, a third one
/// on the first four fifths.
#[tokio::test]
async fn an_evaluation_takes_an_adapter_that_has_not_seen_the_test_frames() {
    let server = server().await;
    let client = &server.client;
    let request = || pb::EvaluateRequest {
        room: "hall".to_owned(),
        navigators: vec!["identity".to_owned()],
        ..Default::default()
    };
    let leaking = client.evaluate(request(), |_| ()).await;
    refused("all leak", leaking, Code::InvalidArgument, "adapter");

    let store = Store::open(server.folder.path().to_str().unwrap()).unwrap();
    let (room, features) = served("hall");
    let data = RoomData {
        room: &room,
        revision: 1,
        features: &features,
    };
    let mut plan = TrainingPlan::of(Preset::PaperBase, Split::Time, 10, 0);
    plan.config.epochs = 1;
    let (adapter, record) = train_adapter(&[data], &plan, &mut |_| ()).unwrap();
    let published = store.publish_adapter("held-out", &adapter, &record, features.rows());
    published.await.unwrap();

    let report = until(
        "the new adapter is served",
        async || client.evaluate(request(), |_| ()).await,
        Result::is_ok,
    )
    .await
    .unwrap();
    assert_eq!(report.adapter.as_ref().unwrap().name, "held-out");
    assert_eq!((report.split(), report.stride), (pb::Split::Time, 10));
    assert!(!report.leaks && report.in_room);

    // The same adapter has seen test frames of another split.
    let of_another_split = pb::EvaluateRequest {
        split: pb::Split::Blocks.into(),
        ..request()
    };
    let leaking = client.evaluate(of_another_split, |_| ()).await;
    refused("all leak", leaking, Code::InvalidArgument, "adapter");

    // A named adapter is evaluated, and the report says that it leaks.
    let named = pb::EvaluateRequest {
        adapter: "hall.fitted".to_owned(),
        ..request()
    };
    assert!(client.evaluate(named, |_| ()).await.unwrap().leaks);
}
