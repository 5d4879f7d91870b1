//! What one caller can learn about the others, and take from them.

use std::sync::Arc;

use seese3_client::proto::v1 as pb;
use seese3_client::{Client, Error};
use seese3_server::{Config, Keyring, Quota};
use seese3_store::Store;
use seese3_testing::world;
use tonic::Code;

use crate::changes::{Upload, writable};
use crate::harness::{TestServer, refused, start_on, until};
use crate::security::{client_with, principal};

/// The rooms lab, lab.b and kitchen; an adapter for all of them, and one fitted to the kitchen. The
/// callers `lab` and `operator` may write to the lab and to everything.
pub async fn server(config: Config, extra: &str) -> TestServer {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let (adapter, record) = world::calibrated();
    for name in ["lab", "lab.b", "kitchen"] {
        let (room, features) = world::served(name);
        store.publish_room(&room, &[features]).await.unwrap();
    }
    let (_, features) = world::served("lab");
    let published = store.publish_adapter("base", &adapter, &record, features.rows());
    published.await.unwrap();

    let file = folder.path().join("auth.toml");
    let verbs = "\"write\", \"catalog\"";
    let callers = [
        principal("lab", verbs, "\"lab\", \"lab-*\""),
        extra.to_owned(),
        principal("operator", verbs, "\"*\""),
    ];
    std::fs::write(&file, callers.concat()).unwrap();
    let config = Config {
        keyring: Some(Arc::new(Keyring::open(file).unwrap())),
        writable: true,
        ..config
    };
    start_on(folder, store, config).await
}

fn refit(room: &str) -> pb::FitAdapterRequest {
    pb::FitAdapterRequest {
        room: room.to_owned(),
        ..pb::FitAdapterRequest::default()
    }
}

async fn set_adapter(client: &Client, room: &str, adapter: &str) -> Result<(), Error> {
    let request = pb::SetDefaultRequest {
        default: Some(pb::CatalogDefault {
            default: Some(pb::catalog_default::Default::RoomAdapter(pb::RoomAdapter {
                room: room.to_owned(),
                adapter: adapter.to_owned(),
            })),
        }),
        ..pb::SetDefaultRequest::default()
    };
    client.set_default(request).await.map(drop)
}

/// Oracle: the contract: a caller cannot tell a hidden adapter from a missing one, cannot choose an
/// adapter that does not serve its room, and cannot take a name of another room.
#[tokio::test]
async fn hidden_adapters_are_answered_like_missing_ones() {
    let server = server(Config::default(), "").await;
    let operator = client_with(&server, Some("operator")).await;
    let lab = client_with(&server, Some("lab")).await;
    let fitted = operator
        .fit_adapter(refit("kitchen"), |_| ())
        .await
        .unwrap();
    let hidden = fitted.revision.unwrap().name;
    assert_eq!(hidden, "kitchen.made-up.fitted");

    let missing = "kitchem.made-up.fitted";
    let chosen = async |adapter: &str| {
        let error = set_adapter(&lab, "lab", adapter).await.unwrap_err();
        (error.code(), error.to_string().replace(adapter, "NAME"))
    };
    assert_eq!(chosen(&hidden).await, chosen(missing).await);
    let fitted_from = async |adapter: &str| {
        let request = pb::FitAdapterRequest {
            base_adapter: adapter.to_owned(),
            ..refit("lab")
        };
        let error = lab.fit_adapter(request, |_| ()).await.unwrap_err();
        (error.code(), error.to_string().replace(adapter, "NAME"))
    };
    assert_eq!(fitted_from(&hidden).await, fitted_from(missing).await);

    let unfit = set_adapter(&operator, "lab", &hidden).await;
    let field = "default.room_adapter.adapter";
    refused("of another room", unfit, Code::InvalidArgument, field);
    set_adapter(&lab, "lab", "base").await.unwrap();

    for (name, is_free) in [
        ("lab.mine", true),
        ("lab.b.mine", false),
        ("lab.b.mine.fitted", false),
        ("kitchen.mine", false),
    ] {
        let request = pb::FitAdapterRequest {
            fitted_adapter: name.to_owned(),
            ..refit("lab")
        };
        let answer = lab.fit_adapter(request, |_| ()).await;
        if is_free {
            assert_eq!(answer.unwrap().revision.unwrap().name, name);
        } else {
            refused(name, answer, Code::InvalidArgument, "fitted_adapter");
        }
    }
}

/// Oracle: the contract: a caller deletes the adapters fitted to its rooms, and no others.
#[tokio::test]
async fn a_caller_deletes_its_own_adapters() {
    let server = server(Config::default(), "").await;
    let operator = client_with(&server, Some("operator")).await;
    let lab = client_with(&server, Some("lab")).await;
    operator
        .fit_adapter(refit("kitchen"), |_| ())
        .await
        .unwrap();
    lab.fit_adapter(refit("lab"), |_| ()).await.unwrap();

    let delete = async |adapter: &str| {
        let request = pb::DeleteAdapterRequest {
            adapter: adapter.to_owned(),
            ..pb::DeleteAdapterRequest::default()
        };
        lab.delete_adapter(request).await
    };
    for adapter in ["kitchen.made-up.fitted", "base", "lab.missing"] {
        let error = delete(adapter).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::PermissionDenied), "{adapter}");
    }
    assert_eq!(delete("lab.made-up.fitted").await.unwrap(), [1]);
}

/// Oracle: the contract: one fit of a caller at a time, and none once its caller has left.
#[tokio::test]
async fn a_fit_ends_with_its_caller() {
    let server = server(Config::default(), "").await;
    let lab = client_with(&server, Some("lab")).await;

    let (began, mut begins) = tokio::sync::mpsc::unbounded_channel();
    let client = lab.clone();
    let fit = tokio::spawn(async move {
        client
            .fit_adapter(refit("lab"), |step| _ = began.send(step))
            .await
    });
    begins.recv().await.unwrap();
    let second = lab.fit_adapter(refit("lab"), |_| ()).await;
    assert_eq!(second.unwrap_err().code(), Some(Code::ResourceExhausted));

    fit.abort();
    let again = async || lab.fit_adapter(refit("lab"), |_| ()).await;
    let fitted = until("the place is free", again, |answer| match answer {
        Ok(_) => true,
        Err(error) => {
            assert_eq!(error.code(), Some(Code::ResourceExhausted), "{error}");
            false
        }
    });
    assert_eq!(fitted.await.unwrap().revision.unwrap().revision, 1);
}

/// Oracle: the quotas by hand: two revisions of a room, three of a caller's rooms together.
#[tokio::test]
async fn quotas_bound_rooms_and_callers() {
    let small = principal("small", "\"write\", \"catalog\"", "\"lab\", \"lab-*\"");
    let config = Config {
        room_quota: Quota {
            revisions: Some(2),
            bytes: None,
        },
        ..writable()
    };
    let server = server(config, &(small + "stored_revisions = 4\n")).await;
    let (small, operator) = (
        client_with(&server, Some("small")).await,
        client_with(&server, Some("operator")).await,
    );
    let upload = async |client: &Client, room: &str, frames: usize| {
        let (whole, features) = world::served("lab");
        let mut upload = Upload::of(room, &whole, &features);
        upload.batches.truncate(frames / 100);
        let is_known = operator.room(room).await.is_ok();
        upload.spec.mode = match is_known {
            true => pb::UploadMode::Replace.into(),
            false => pb::UploadMode::Create.into(),
        };
        upload
            .send(client)
            .await
            .map(|answer| answer.revision.unwrap().revision)
    };
    let reached = |answer: Result<u64, Error>| {
        let error = answer.unwrap_err();
        assert_eq!(error.code(), Some(Code::FailedPrecondition), "{error}");
        assert!(error.to_string().contains("revisions; delete"), "{error}");
    };

    // `lab` has one revision already.
    assert_eq!(upload(&small, "lab", 100).await.unwrap(), 2);
    reached(upload(&operator, "lab", 200).await);
    assert_eq!(upload(&small, "lab-1", 100).await.unwrap(), 1);
    assert_eq!(upload(&small, "lab-2", 100).await.unwrap(), 1);
    reached(upload(&small, "lab-3", 100).await);
    assert_eq!(upload(&operator, "lab-3", 100).await.unwrap(), 1);

    for room in ["lab-2", "lab-3"] {
        let request = pb::DeleteRoomRequest {
            room: room.to_owned(),
            ..pb::DeleteRoomRequest::default()
        };
        small.delete_room(request).await.unwrap();
    }
    assert_eq!(upload(&small, "lab-4", 100).await.unwrap(), 1);
}
