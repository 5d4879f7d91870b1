//! What the store promises, in a bucket.

use std::collections::BTreeSet;
use std::process::{Command, Stdio};
use std::time::Duration;

use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use rand::{RngExt, SeedableRng};
use seese3_store::{Choice, Error, GarbagePolicy, ObjectCache, Publishers, ResourceName, Store};
use seese3_testing::recording::{room, set};
use seese3_testing::world;

use crate::seaweed::Seaweed;

const ALL_GARBAGE: GarbagePolicy = GarbagePolicy {
    older_than: Duration::ZERO,
    publishers: Publishers::None,
};

fn times() -> usize {
    let given = std::env::var("SEESE3_TIMES").ok();
    given.map_or(20, |times| times.parse().expect("SEESE3_TIMES is a number"))
}

async fn sets(store: &Store, revision: Option<u64>) -> BTreeSet<String> {
    let stored = store.load_room("a", revision).await.unwrap();
    let names = stored.features.iter().map(|set| set.source().name.clone());
    names.collect()
}

/// Oracle: the contract of the store, which `tests/store` checks on a disk.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs SeaweedFS: SEESE3_WEED"]
async fn a_bucket_keeps_what_a_folder_keeps() {
    let seaweed = Seaweed::start().await;
    let store = seaweed.store("first");
    store.check_writable().await.unwrap();
    for (number, name) in ["f", "g", "h"].into_iter().enumerate() {
        let published = store
            .publish_room(&room("a"), &[set(name, 1.0)])
            .await
            .unwrap();
        assert_eq!(published.revision, number as u64 + 1);
    }
    let again = store
        .publish_room(&room("a"), &[set("h", 1.0)])
        .await
        .unwrap();
    assert!(!again.is_new);
    assert_eq!(
        sets(&store, Some(2)).await,
        ["f", "g"].map(str::to_owned).into()
    );

    let choice = Choice::Revision("rooms/a/revisions/2".parse().unwrap());
    store.choose(&choice).await.unwrap();
    let removed: ResourceName = "rooms/a/revisions/1".parse().unwrap();
    store.remove(&removed).await.unwrap();
    assert!(matches!(
        store.load_room("a", Some(1)).await,
        Err(Error::UnknownRevision { .. })
    ));
    assert!(
        store
            .remove(&"rooms/a/revisions/2".parse().unwrap())
            .await
            .is_err(),
        "it is the default"
    );
    store.take_back_choice().await.unwrap();

    store.collect_garbage(ALL_GARBAGE).await.unwrap();
    assert_eq!(store.verify(&|_| ()).await.unwrap(), []);
    assert_eq!(sets(&store, None).await.len(), 3);

    // Another folder of the bucket is another store.
    assert!(seaweed.store("second").rooms().await.unwrap().is_empty());
}

/// Oracle: the contract: of two publishers at once, neither loses its work, and the default is that
/// of one of them.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs SeaweedFS: SEESE3_WEED"]
async fn two_publishers_lose_nothing() {
    let seaweed = Seaweed::start().await;
    let stores = ["race", "race"].map(|prefix| seaweed.store(prefix));
    let mut expected = BTreeSet::new();
    for round in 0..times() {
        let publish = |which: usize| {
            let store = stores[which].clone();
            let name = format!("{}-{round}", ["one", "other"][which]);
            async move {
                let published = store
                    .publish_room(&room("a"), &[set(&name, 1.0)])
                    .await
                    .unwrap();
                let choice = format!("rooms/a/revisions/{}", published.revision)
                    .parse()
                    .unwrap();
                store.choose(&Choice::Revision(choice)).await.unwrap();
                (name, published.revision)
            }
        };
        let both = tokio::join!(tokio::spawn(publish(0)), tokio::spawn(publish(1)));
        let both = [both.0.unwrap(), both.1.unwrap()];
        let revisions = both.each_ref().map(|(_, revision)| *revision);
        assert_ne!(revisions[0], revisions[1], "round {round}");
        expected.extend(both.map(|(name, _)| name));

        let newest = revisions.iter().max().copied();
        assert_eq!(sets(&stores[0], newest).await, expected, "round {round}");
        let defaults = stores[0].defaults().await.unwrap();
        let chosen = defaults.revision(seese3_store::Kind::Room, "a");
        assert!(revisions.map(Some).contains(&chosen), "round {round}");
    }
    assert_eq!(stores[0].verify(&|_| ()).await.unwrap(), []);
}

/// A publisher for `a_killed_publisher_leaves_a_whole_store`, which runs it as a process of its
/// own.
#[tokio::test]
#[ignore = "is part of another test"]
async fn publishes_until_it_is_killed() {
    let Ok(settings) = std::env::var("SEESE3_PUBLISH_TO") else {
        return;
    };
    let (url, variables): (String, Vec<(String, String)>) =
        serde_json::from_str(&settings).unwrap();
    let store = Store::open_with(&url, &variables).unwrap();
    for number in 0.. {
        let name = format!("f-{}-{number}", std::process::id());
        store
            .publish_room(&room("a"), &[set(&name, 1.0)])
            .await
            .unwrap();
        if number == 0 {
            // On a line of its own.
            println!("\nready");
        }
    }
}

/// Oracle: the contract: after a kill at any time there is an old or a new revision, and the store
/// is clean after garbage collection.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs SeaweedFS: SEESE3_WEED"]
async fn a_killed_publisher_leaves_a_whole_store() {
    let seaweed = Seaweed::start().await;
    let store = seaweed.store("killed");
    store
        .publish_room(&room("a"), &[set("f", 1.0)])
        .await
        .unwrap();
    let settings = serde_json::to_string(&seaweed.settings("killed")).unwrap();
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(40);
    let mut revision = 1;

    for round in 0..times() {
        let mut publisher = Command::new(std::env::current_exe().unwrap())
            .args([
                "--exact",
                "in_a_bucket::publishes_until_it_is_killed",
                "--ignored",
                "--nocapture",
            ])
            .env("SEESE3_PUBLISH_TO", &settings)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines =
            std::io::BufRead::lines(std::io::BufReader::new(publisher.stdout.take().unwrap()));
        assert!(lines.map_while(Result::ok).any(|line| line == "ready"));
        tokio::time::sleep(Duration::from_millis(random.random_range(0..200))).await;
        publisher.kill().unwrap();
        publisher.wait().unwrap();

        let stored = store.load_room("a", None).await.unwrap();
        assert_eq!(
            stored.features.len() as u64,
            stored.revision,
            "round {round}"
        );
        assert!(stored.revision > revision, "round {round}");
        revision = stored.revision;
        store.collect_garbage(ALL_GARBAGE).await.unwrap();
        assert_eq!(store.verify(&|_| ()).await.unwrap(), [], "round {round}");
    }
}

/// Oracle: the bytes in the bucket: what was read once is read again without the server's objects,
/// unless the cached file was altered.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs SeaweedFS: SEESE3_WEED"]
async fn objects_are_read_from_the_cache() {
    let seaweed = Seaweed::start().await;
    let folder = tempfile::tempdir().unwrap();
    let cached = || ObjectCache::open(folder.path(), 1 << 30).unwrap();
    let store = seaweed.store("cached").with_cache(cached());
    let (served, features) = world::served("hall");
    store
        .publish_room(&served, std::slice::from_ref(&features))
        .await
        .unwrap();
    let first = store.load_room("hall", None).await.unwrap();

    let objects = seaweed.objects();
    let listed = objects
        .list_with_delimiter(Some(&Path::from("cached/rooms/hall/objects")))
        .await
        .unwrap();
    assert!(!listed.objects.is_empty());
    for object in &listed.objects {
        objects.delete(&object.location).await.unwrap();
    }
    let again = seaweed
        .store("cached")
        .with_cache(cached())
        .load_room("hall", None)
        .await
        .unwrap();
    assert_eq!(again.features[0].rows(), first.features[0].rows());

    for file in std::fs::read_dir(folder.path()).unwrap() {
        std::fs::write(file.unwrap().path(), "altered").unwrap();
    }
    let missing = store.load_room("hall", None).await;
    assert!(matches!(missing, Err(Error::Absent { .. })), "{missing:?}");
}

/// Oracle: the contract: the store that stops and comes back is read and written again by the same
/// process.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs SeaweedFS: SEESE3_WEED"]
async fn a_store_that_comes_back_is_used_again() {
    let mut seaweed = Seaweed::start().await;
    let store = seaweed.store("outage");
    store
        .publish_room(&room("a"), &[set("f", 1.0)])
        .await
        .unwrap();
    seaweed.kill();
    let reader = store.clone();
    let reading = tokio::spawn(async move { reader.load_room("a", None).await });
    tokio::time::sleep(Duration::from_secs(2)).await;
    seaweed.restart().await;

    // It was repeated until the server was back.
    assert_eq!(reading.await.unwrap().unwrap().revision, 1);
    let published = store
        .publish_room(&room("a"), &[set("g", 1.0)])
        .await
        .unwrap();
    assert_eq!(published.revision, 2);
}
