//! New revisions are served without a restart, and what is damaged is refused by itself.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_core::features::Features;
use seese3_server::{Config, Reload};
use seese3_store::{Choice, Store};
use tokio::sync::Notify;
use tonic::Code;

use crate::harness::{
    PATIENCE, TestServer, code_of, features_of, filled_store, frame, metric, publish_oracle,
    question, room_of, start_on, to_frame, until,
};

/// A server that looks for changes when it is asked to.
async fn start_watched() -> (TestServer, Store, Arc<Notify>) {
    let (folder, store) = filled_store().await;
    let asked = Arc::new(Notify::new());
    let config = Config {
        reload: Reload {
            every: None,
            requested: asked.clone(),
        },
        ..Config::default()
    };
    let server = start_on(folder, store.clone(), config).await;

    (server, store, asked)
}

async fn revision_of(client: &Client, room: &str) -> Option<u64> {
    let rooms = client.rooms().await.unwrap();
    let served = rooms.into_iter().find(|served| served.name == room);
    served.map(|served| served.revision)
}

async fn publish_reversed(store: &Store) {
    let room = room_of("synthetic", "synthetic");
    let features = [reversed_features()];
    store.publish_room(&room, &features).await.unwrap();
}

async fn publish_new(store: &Store) {
    let room = room_of("new", "synthetic_b");
    let features = [features_of("synthetic_b")];
    store.publish_room(&room, &features).await.unwrap();
}

/// The features of the synthetic room, its frames the other way round.
fn reversed_features() -> Features {
    let given = features_of("synthetic");
    let rows = given.rows().slice(ndarray::s![..;-1, ..]).to_owned();
    Features::new(given.source().clone(), rows).unwrap()
}

/// An object of a room or adapter whose name begins with `stem`, the newest of several.
fn object(folder: &Path, of: &str, stem: &str) -> PathBuf {
    let objects = std::fs::read_dir(folder.join(of).join("objects")).unwrap();
    let is_wanted = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_str().unwrap();
        name.starts_with(stem)
    };

    objects
        .map(|entry| entry.unwrap().path())
        .filter(is_wanted)
        .max_by_key(|path| path.metadata().unwrap().modified().unwrap())
        .unwrap()
}

/// Oracle: the store itself: what was published, replaced or removed is what is served next.
#[tokio::test]
async fn what_is_published_is_served_without_a_restart() {
    let (server, store, asked) = start_watched().await;
    let client = &server.client;
    assert_eq!(revision_of(client, "synthetic").await, Some(1));

    publish_reversed(&store).await;
    publish_new(&store).await;
    std::fs::remove_dir_all(server.folder.path().join("rooms/synthetic_b")).unwrap();
    asked.notify_one();

    let new = async || revision_of(client, "new").await;
    until("the new room", new, |revision| *revision == Some(1)).await;

    assert_eq!(revision_of(client, "synthetic").await, Some(2));
    assert_eq!(revision_of(client, "synthetic_b").await, None);

    let answer = client.navigate(question()).await.unwrap();
    assert_eq!(answer.room.unwrap().revision, 2);

    // A new adapter is newer than the one before, and so the room's default.
    publish_oracle(&store, "newer").await;
    asked.notify_one();

    let default = async || {
        let answer = client.navigate(question()).await.unwrap();
        answer.adapter.unwrap().name
    };
    until("the new default", default, |name| name == "newer").await;
}

/// Oracle: the promise: a damaged room or adapter is refused by itself, with a reason for the
/// caller and in health; the revision before goes on; and what is repaired is served.
#[tokio::test]
async fn what_is_damaged_is_refused_by_itself() {
    let (server, store, asked) = start_watched().await;
    let client = &server.client;
    let folder = server.folder.path();

    // A second revision of one room, a new room and a new adapter, all of them damaged.
    publish_reversed(&store).await;
    std::fs::write(object(folder, "rooms/synthetic", "features"), b"short").unwrap();
    publish_new(&store).await;
    let frames = object(folder, "rooms/new", "frames");
    let intact = std::fs::read(&frames).unwrap();
    std::fs::write(&frames, b"short").unwrap();
    publish_oracle(&store, "broken").await;
    std::fs::write(object(folder, "adapters/broken", ""), b"short").unwrap();
    asked.notify_one();

    let in_new = pb::NavigateRequest {
        room: "new".to_owned(),
        source: frame(10),
        motion: to_frame(20),
        ..question()
    };
    let refused = async || code_of(client.navigate(in_new.clone()).await);
    let is_refused = |code: &Code| *code == Code::FailedPrecondition;
    until("the new room is refused", refused, is_refused).await;

    let by_broken = pb::NavigateRequest {
        adapter: "broken".to_owned(),
        ..question()
    };
    let code = code_of(client.navigate(by_broken).await);
    assert_eq!(code, Code::FailedPrecondition);

    // Everything else is served, the first revision of the damaged room included.
    let answer = client.navigate(question()).await.unwrap();
    assert_eq!(answer.room.unwrap().revision, 1);
    assert_eq!(answer.adapter.unwrap().name, "oracle");
    assert!(client.serves("").await.unwrap());
    assert!(client.serves("rooms/synthetic").await.unwrap());
    assert!(!client.serves("rooms/new").await.unwrap());

    std::fs::write(&frames, intact).unwrap();
    asked.notify_one();

    let served = async || client.navigate(in_new.clone()).await.is_ok();
    until("the repaired room", served, |served| *served).await;
}

/// Oracle: the promise, as at the reload: a server that starts on a store with damage serves the
/// rest; and one that finds its store gone goes on with what it has.
#[tokio::test]
async fn a_server_starts_beside_damage_and_outlives_its_store() {
    let (folder, store) = filled_store().await;
    std::fs::write(object(folder.path(), "rooms/synthetic_b", "frames"), b"x").unwrap();
    let config = |writable| Config {
        writable,
        reload: Reload {
            every: Some(Duration::from_millis(20)),
            ..Reload::default()
        },
        ..Config::default()
    };
    let read_only = config(false);
    let server = start_on(folder, store, read_only.clone()).await;

    assert!(server.client.navigate(question()).await.is_ok());
    assert!(!server.client.serves("rooms/synthetic_b").await.unwrap());

    let writable = config(true);
    let (other_folder, other_store) = filled_store().await;
    let other = start_on(other_folder, other_store, writable.clone()).await;

    for server in [&server, &other] {
        std::fs::remove_dir_all(server.folder.path().join("rooms")).unwrap();
        std::fs::remove_dir_all(server.folder.path().join("adapters")).unwrap();
    }
    for (server, config) in [(&server, read_only), (&other, writable)] {
        let name = r#"seese3_reloads_total{outcome="failed"}"#;
        let failed = async || metric(&config.metrics, name).unwrap();
        until("a reload fails", failed, |failed| *failed >= 1.0).await;
        assert!(server.client.navigate(question()).await.is_ok());
    }
}

/// Oracle: the promise: where the newest choices of defaults are damaged, the ones before them
/// hold, at a reload and at the start, and everything else goes on.
#[tokio::test]
async fn damaged_choices_leave_those_before_them() {
    let (server, store, asked) = start_watched().await;
    publish_oracle(&store, "trial").await;
    for adapter in ["oracle", "trial"] {
        let choice = Choice::Adapter {
            room: "synthetic".to_owned(),
            adapter: adapter.to_owned(),
        };
        store.choose(&choice).await.unwrap();
    }
    let choices = server.folder.path().join("defaults/000002.json");
    std::fs::write(choices, b"short").unwrap();

    publish_new(&store).await;
    asked.notify_one();
    let revision = async || revision_of(&server.client, "new").await;
    until("the new room", revision, |found| *found == Some(1)).await;

    let answering = async |server: &TestServer| {
        let answer = server.client.navigate(question()).await.unwrap();
        answer.adapter.unwrap().name
    };
    assert_eq!(answering(&server).await, "oracle");

    let TestServer { folder, .. } = server;
    let server = start_on(folder, store, Config::default()).await;
    assert_eq!(answering(&server).await, "oracle");
}

/// Publishes revisions that differ in their features, while `askers` ask without a pause.
///
/// Every answer has to be that of the revision it names: of the features as they are, or of the
/// features the other way round.
async fn answers_are_whole_over(reloads: u64, askers: usize) {
    let (server, store, asked) = start_watched().await;
    let room = room_of("synthetic", "synthetic");
    let [forward, backward] = [features_of("synthetic"), reversed_features()];

    // What each revision answers is asked while nothing changes.
    let without_revision = |mut answer: pb::NavigateResponse| {
        let revision = answer.room.take().unwrap().revision;
        (revision, answer)
    };
    let publish = async |features: &Features| {
        let set = std::slice::from_ref(features);
        store.publish_room(&room, set).await.unwrap().revision
    };
    let served = async |revision: u64| {
        asked.notify_one();
        let now = async || revision_of(&server.client, "synthetic").await;
        until("the published revision", now, |found| {
            *found == Some(revision)
        })
        .await;
    };

    let (_, of_odd) = without_revision(server.client.navigate(question()).await.unwrap());
    let second = publish(&backward).await;
    served(second).await;
    let (_, of_even) = without_revision(server.client.navigate(question()).await.unwrap());
    assert_ne!(of_odd.steps, of_even.steps, "the test can tell them apart");

    let stop = Arc::new(AtomicBool::new(false));
    let swapping = Arc::new(AtomicBool::new(false));
    // How many askers were answered while nothing was swapped, and while rooms were.
    let answered = Arc::new([AtomicUsize::new(0), AtomicUsize::new(0)]);
    let all_are_answered = async |phase: usize| {
        let count = async || answered[phase].load(Ordering::Relaxed);
        until("everyone is answered", count, |count| *count == askers).await;
    };
    let asking: Vec<_> = (0..askers)
        .map(|_| {
            let (stop, swapping) = (stop.clone(), swapping.clone());
            let answered = answered.clone();
            let address = server.address.clone();
            let expected = [of_even.clone(), of_odd.clone()];
            tokio::spawn(async move {
                let client = Client::connect(&address, PATIENCE).await.unwrap();
                let mut took = [Vec::new(), Vec::new()];
                while !stop.load(Ordering::Relaxed) {
                    let begun = Instant::now();
                    let answer = client.navigate(question()).await.unwrap();
                    let phase = usize::from(swapping.load(Ordering::Relaxed));
                    took[phase].push(begun.elapsed());
                    if took[phase].len() == 1 {
                        answered[phase].fetch_add(1, Ordering::Relaxed);
                    }
                    let (revision, answer) = without_revision(answer);
                    assert_eq!(answer, expected[(revision % 2) as usize], "{revision}");
                }
                took
            })
        })
        .collect();

    // The control: the same questions while nothing is swapped. The pause is for the percentiles.
    tokio::time::sleep(Duration::from_millis(50 * reloads)).await;
    all_are_answered(0).await;
    swapping.store(true, Ordering::Relaxed);
    for reload in 0..reloads {
        if reload + 1 == reloads {
            all_are_answered(1).await;
        }
        let features = if reload % 2 == 0 { &forward } else { &backward };
        let revision = publish(features).await;
        served(revision).await;
    }

    stop.store(true, Ordering::Relaxed);
    let mut all = [Vec::new(), Vec::new()];
    for asker in asking {
        for (all, took) in all.iter_mut().zip(asker.await.unwrap()) {
            all.extend(took);
        }
    }
    let [quiet, swapping] = all.each_mut().map(|took| percentiles(took));
    println!("quiet: {quiet}");
    println!("while rooms are swapped: {swapping}");
}

fn percentiles(took: &mut [Duration]) -> String {
    took.sort();
    let at = |share: f64| took[((took.len() - 1) as f64 * share) as usize];
    let (count, half, most) = (took.len(), at(0.5), at(0.99));
    format!("{count} answers, p50 {half:?}, p99 {most:?}")
}

/// Oracle: the answers of either revision while nothing changes. SEESE3_RELOADS says how many
/// swaps, 20 if it is not set; `just soak` asks for a thousand.
#[tokio::test]
async fn no_answer_fails_or_mixes_revisions_while_rooms_are_swapped() {
    let given = std::env::var("SEESE3_RELOADS").ok();
    let reloads = given.map_or(20, |count| {
        count.parse().expect("SEESE3_RELOADS is a number")
    });
    answers_are_whole_over(reloads, 4).await;
}
