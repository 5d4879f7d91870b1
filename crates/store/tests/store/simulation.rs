//! Publishers, extenders, removers, garbage collections and readers of one store that fails at
//! random, in simulated time. Each run is repeatable from its seed.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::Pose;
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_store::{
    Clock, Error, GarbagePolicy, Kind, OtherFeatures, Publishers, ResourceName, RoomContents, Store,
};
use tokio::time::Instant;

use crate::faults::Faulty;

/// Number of faults of the short form; `SEESE3_SIMULATED_FAULTS` sets another.
const FAULTS: usize = 20_000;
/// Changes of each actor of a run.
const CHANGES: usize = 6;
/// Different contents of a room. The same content is published again and again.
const CONTENTS: u32 = 3;

/// What a run has been promised.
#[derive(Debug, Clone, Default)]
struct Promises {
    /// Content of each acknowledged revision of a room.
    published: BTreeMap<(String, u64), u32>,
    /// Revisions whose removal was tried; whether they exist is unknown.
    maybe_removed: BTreeSet<(String, u64)>,
    /// Acknowledged additions to the room that is extended.
    added: BTreeSet<u32>,
}

/// A room whose poses and features tell its content.
fn content(name: &str, content: u32) -> (Room, Features) {
    let poses = (0..3).map(|frame| Pose::translation(f64::from(content), f64::from(frame), 0.0));
    let frames = Frames {
        poses: poses.collect(),
        ..Frames::default()
    };
    let room = Room::new(RoomId::new(name).unwrap(), frames, Provenance::default()).unwrap();
    let rows = Array2::from_shape_fn((3, 2), |(row, column)| {
        content as f32 + (row * 2 + column) as f32 / 10.0
    });
    (
        room,
        Features::new(FeatureSource::imported("f", 0), rows).unwrap(),
    )
}

fn contents_of(room: &Room) -> BTreeSet<u32> {
    let poses = room.poses().iter();
    poses.map(|pose| pose.translation.vector.x as u32).collect()
}

/// One run: the actors, their randomness and what they were promised.
#[derive(Clone)]
struct Run {
    store: Store,
    faulty: Faulty,
    promises: Arc<Mutex<Promises>>,
}

impl Run {
    fn new(seed: u64) -> Self {
        let faulty = Faulty::new(seed);
        let start = Instant::now();
        let store = Store::with_objects(Arc::new(faulty.clone()), "faulty");
        Self {
            store: store.with_clock(Clock::new(move || start.elapsed())),
            faulty,
            promises: Arc::default(),
        }
    }

    async fn publish(self, mut random: ChaCha8Rng) {
        for _ in 0..CHANGES {
            pause(&mut random).await;
            let name = ["a", "b"][random.random_range(0..2)];
            let number = random.random_range(0..CONTENTS);
            let (room, features) = content(name, number);

            // A publisher that is killed is one whose future is dropped.
            let life = Duration::from_secs(random.random_range(1..7_200));
            let publishing = self
                .store
                .publish_room(&room, std::slice::from_ref(&features));
            if let Ok(Ok(published)) = tokio::time::timeout(life, publishing).await {
                let revision = (name.to_owned(), published.revision);
                let mut promises = self.promises.lock().unwrap();
                promises.published.insert(revision, number);
            }
        }
    }

    async fn extend(self, mut random: ChaCha8Rng, first: u32) {
        for number in first..first + CHANGES as u32 {
            pause(&mut random).await;
            let (room, features) = content("extended", number);
            let addition = RoomContents {
                room: &room,
                features: std::slice::from_ref(&features),
                keypoints: None,
            };
            let life = Duration::from_secs(random.random_range(1..7_200));
            let extending = self.store.extend_room(addition, OtherFeatures::Required);
            if let Ok(Ok(_)) = tokio::time::timeout(life, extending).await {
                self.promises.lock().unwrap().added.insert(number);
            }
        }
    }

    async fn remove(self, mut random: ChaCha8Rng) {
        for _ in 0..CHANGES {
            pause(&mut random).await;
            let name = ["a", "b"][random.random_range(0..2)];
            let revision = random.random_range(1..8);
            let is_whole = random.random_bool(0.3);
            let resource = ResourceName {
                kind: Kind::Room,
                name: name.to_owned(),
                revision: (!is_whole).then_some(revision),
            };

            let _ = self.store.remove(&resource).await;

            // Revisions that are published later have other numbers.
            let tried = match is_whole {
                false => revision..=revision,
                true => 1..=self.highest(name).await,
            };
            let tried = tried.map(|revision| (name.to_owned(), revision));
            self.promises.lock().unwrap().maybe_removed.extend(tried);
        }
    }

    /// The highest revision of a room so far, removed or not.
    async fn highest(&self, name: &str) -> u64 {
        let folder = format!("rooms/{name}/revisions/");
        let paths = self.faulty.paths().await;
        let files = paths.iter().filter_map(|path| path.strip_prefix(&folder));
        let numbers = files.filter_map(|file| file.split_once('.')?.0.parse().ok());
        numbers.max().unwrap_or(0)
    }

    async fn collect(self, mut random: ChaCha8Rng) {
        for _ in 0..2 * CHANGES {
            pause(&mut random).await;
            let life = Duration::from_secs(random.random_range(1..7_200));
            let collecting = self.store.collect_garbage(GarbagePolicy::default());
            let _ = tokio::time::timeout(life, collecting).await;
        }
    }

    /// Loads all current revisions, as a server that reloads its store.
    async fn reload(self, mut random: ChaCha8Rng) {
        for _ in 0..2 * CHANGES {
            pause(&mut random).await;
            let Ok(defaults) = self.store.defaults().await else {
                continue;
            };
            for (name, revision) in self
                .store
                .current_rooms(&defaults)
                .await
                .unwrap_or_default()
            {
                if let Ok(loaded) = self.store.load_room(&name, Some(revision)).await {
                    assert!(!contents_of(&loaded.room).is_empty());
                }
            }
        }
    }
}

async fn pause(random: &mut ChaCha8Rng) {
    tokio::time::sleep(Duration::from_secs(random.random_range(0..5_400))).await;
}

/// Runs all actors to their end and checks the promises. Returns the number of faults.
async fn simulate(seed: u64) -> usize {
    let run = Run::new(seed);
    let random = |actor: u64| ChaCha8Rng::seed_from_u64(seed * 1_000 + actor);

    let (base, features) = content("extended", 900);
    while run
        .store
        .publish_room(&base, std::slice::from_ref(&features))
        .await
        .is_err()
    {}

    let mut actors = tokio::task::JoinSet::new();
    for actor in 0..3 {
        actors.spawn(run.clone().publish(random(actor)));
    }
    actors.spawn(run.clone().extend(random(3), 100));
    actors.spawn(run.clone().extend(random(4), 200));
    actors.spawn(run.clone().remove(random(5)));
    actors.spawn(run.clone().collect(random(6)));
    actors.spawn(run.clone().collect(random(7)));
    actors.spawn(run.clone().reload(random(8)));
    actors.join_all().await;

    run.faulty.repair();
    kept(&run, seed).await;
    collected(&run, seed).await;
    kept(&run, seed).await;
    run.faulty.count()
}

/// Checks that the store keeps what it has acknowledged.
async fn kept(run: &Run, seed: u64) {
    let store = run.store.clone();
    let Promises {
        published,
        maybe_removed,
        added,
    } = run.promises.lock().unwrap().clone();

    for (revision, number) in published {
        let (name, revision_number) = &revision;
        match store.load_room(name, Some(*revision_number)).await {
            Ok(loaded) => {
                let (room, features) = content(name, number);
                assert_eq!(
                    loaded.room.poses(),
                    room.poses(),
                    "seed {seed}: {revision:?}"
                );
                assert_eq!(loaded.features[0].rows(), features.rows(), "seed {seed}");
            }
            Err(Error::Unknown { .. } | Error::UnknownRevision { .. })
                if maybe_removed.contains(&revision) => {}
            Err(error) => panic!("seed {seed}: lost {revision:?}: {error}"),
        }
    }

    let extended = store.load_room("extended", None).await.unwrap();
    let contents = contents_of(&extended.room);
    assert!(
        contents.is_superset(&added),
        "seed {seed}: {added:?} of {contents:?}"
    );
    let findings = store.verify(&|_| ()).await.unwrap();
    assert!(findings.is_empty(), "seed {seed}: {findings:?}");
}

/// Checks that days later nothing is left but what manifests name.
async fn collected(run: &Run, seed: u64) {
    let day = Duration::from_secs(90_000);
    for _ in 0..2 {
        tokio::time::sleep(day).await;
        run.store
            .collect_garbage(GarbagePolicy::default())
            .await
            .unwrap();
    }
    // Halves of files are kept while anything might publish them.
    let alone = GarbagePolicy {
        publishers: Publishers::None,
        ..GarbagePolicy::default()
    };
    run.store.collect_garbage(alone).await.unwrap();
    let left = run.store.find_garbage(alone).await.unwrap();
    assert!(left.files.is_empty(), "seed {seed}: {left:?}");
    let paths = run.faulty.paths().await;
    let of_collection = |path: &&String| path.contains("quarantine") || path.contains("clock");
    let odd: Vec<_> = paths.iter().filter(of_collection).collect();
    assert!(odd.is_empty(), "seed {seed}: {odd:?}");
}

/// Oracle: the promise: what was acknowledged and not removed is there, and readable, whatever
/// fails meanwhile; a day later nothing else takes space.
#[test]
fn what_is_acknowledged_survives_faults() {
    let wanted = std::env::var("SEESE3_SIMULATED_FAULTS");
    let wanted = wanted.map_or(FAULTS, |faults| faults.parse().unwrap());
    let first: u64 = std::env::var("SEESE3_SEED").map_or(1, |seed| seed.parse().unwrap());

    let mut faults = 0;
    let mut seed = first;
    while faults < wanted {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .start_paused(true)
            .build()
            .unwrap();
        faults += runtime.block_on(simulate(seed));
        seed += 1;
    }
    println!(
        "{faults} faults in {} runs, seeds {first} to {}",
        seed - first,
        seed - 1
    );
}
