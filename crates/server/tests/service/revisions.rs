//! Requests that state revisions: a published evaluation can be repeated after its room and its
//! adapter have changed.

use seese3_client::proto::v1 as pb;
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_server::Config;
use tonic::Code;

use crate::harness::{
    features_of, filled_store, frame, oracle_adapter, publish_oracle, question, record, refused,
    room_of, start_on, until,
};
use seese3_core::features::Features;

/// The first frames of the room `synthetic`.
pub fn shorter(frame_count: usize) -> (Room, Features) {
    let whole = room_of("synthetic", "synthetic");
    let frames = Frames {
        poses: whole.poses()[..frame_count].to_vec(),
        ..Frames::default()
    };
    let room = Room::new(
        RoomId::new("synthetic").unwrap(),
        frames,
        Provenance::default(),
    );
    let features = features_of("synthetic");
    let rows = features
        .rows()
        .slice_move(ndarray::s![..frame_count, ..])
        .to_owned();
    let features = Features::new(features.source().clone(), rows);
    (room.unwrap(), features.unwrap())
}

/// Oracle: the answers of the same server before the change.
#[tokio::test]
async fn a_stated_revision_is_answered_as_before() {
    let (folder, store) = filled_store().await;
    let server = start_on(folder, store.clone(), Config::default()).await;
    let client = &server.client;

    let evaluate = |revision: Option<u64>| pb::EvaluateRequest {
        room: "synthetic".to_owned(),
        room_revision: revision,
        adapter: "oracle".to_owned(),
        adapter_revision: revision,
        split: pb::Split::Time.into(),
        ..pb::EvaluateRequest::default()
    };
    let navigate = |revision: Option<u64>| pb::NavigateRequest {
        room_revision: revision,
        adapter: "oracle".to_owned(),
        adapter_revision: revision,
        ..question()
    };
    let localize = |revision: Option<u64>| pb::LocalizeRequest {
        rooms: vec!["synthetic".to_owned()],
        room_revisions: revision
            .map(|revision| ("synthetic".to_owned(), revision))
            .into_iter()
            .collect(),
        view: frame(70),
        top_k: Some(3),
        ..pb::LocalizeRequest::default()
    };
    let evaluated = client.evaluate(evaluate(None), |_| ()).await.unwrap();
    let navigated = client.navigate(navigate(None)).await.unwrap();
    let localized = client.localize(localize(None)).await.unwrap();

    // A second revision of both: fewer frames, and another record of the adapter.
    let (room, features) = shorter(300);
    store.publish_room(&room, &[features]).await.unwrap();
    let mut changed = record();
    changed.config.seed += 1;
    let features = features_of("synthetic");
    let adapter = oracle_adapter();
    let published = store.publish_adapter("oracle", &adapter, &changed, features.rows());
    assert_eq!(published.await.unwrap().revision, 2);
    publish_oracle(&store, "other").await;
    let _ = until(
        "the new revisions are served",
        async || {
            (
                client.room("synthetic").await,
                client.adapter("oracle").await,
            )
        },
        |(room, adapter)| {
            let is_second = |revision: u64| revision == 2;
            room.as_ref().is_ok_and(|room| is_second(room.revision))
                && adapter
                    .as_ref()
                    .is_ok_and(|adapter| is_second(adapter.revision))
        },
    )
    .await;

    let now = client.evaluate(evaluate(None), |_| ()).await.unwrap();
    assert_ne!(now.pair_count, evaluated.pair_count);
    assert_eq!(
        client.evaluate(evaluate(Some(1)), |_| ()).await.unwrap(),
        evaluated
    );
    assert_eq!(client.navigate(navigate(Some(1))).await.unwrap(), navigated);
    let error = client.navigate(navigate(None)).await.unwrap_err();
    assert_eq!(error.field().as_deref(), Some("source.frame_id"));
    let pinned = client.localize(localize(Some(1))).await.unwrap();
    assert_eq!(
        (pinned.frames, pinned.room),
        (localized.frames, localized.room)
    );

    let batch = vec![navigate(Some(1)); 2];
    let answers = client.batch_navigate(batch).await.unwrap();
    let expected = pb::batch_navigate_result::Result::Response(navigated);
    assert!(
        answers
            .iter()
            .all(|answer| answer.result.as_ref() == Some(&expected))
    );
    let mixed = vec![navigate(Some(1)), navigate(None)];
    let answer = client.batch_navigate(mixed).await;
    refused("a mixed batch", answer, Code::InvalidArgument, "requests");

    // What is stated without its name, or is not there, is refused.
    let unnamed = pb::NavigateRequest {
        adapter: String::new(),
        ..navigate(Some(1))
    };
    let answer = client.navigate(unnamed).await;
    refused(
        "no adapter",
        answer,
        Code::InvalidArgument,
        "adapter_revision",
    );
    let answer = client.navigate(navigate(Some(9))).await;
    refused("revision 9", answer, Code::NotFound, "adapter_revision");
    let of_another = pb::LocalizeRequest {
        rooms: vec!["synthetic_b".to_owned()],
        ..localize(Some(1))
    };
    let answer = client.localize(of_another).await;
    refused(
        "another room",
        answer,
        Code::InvalidArgument,
        "room_revisions",
    );
}
