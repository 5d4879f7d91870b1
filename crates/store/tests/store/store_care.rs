//! Looking after a store: what is chosen, removed, collected and verified.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use object_store::local::LocalFileSystem;
use seese3_core::adapter::Adapter;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::room::{FrameId, Room, RoomId};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{FitRun, fit};
use seese3_robot::tracking::{FeatureTables, MapTables};
use seese3_store::fit_stored_room::{Error as FitError, Refit, Request};
use seese3_store::{
    Choice, Defaults, Derived, Error, GarbagePolicy, Publishers, Quota, Quotas, ResourceName,
    RoomFit, Scope, Store,
};

use crate::dying::Dying;
use crate::store::{files, stored};
use seese3_testing::recording::{adapter, room, set};
use seese3_testing::world;

use crate::current_rooms;

/// Garbage of this age, while nothing publishes to the store.
fn aged(older_than: Duration) -> GarbagePolicy {
    GarbagePolicy {
        older_than,
        publishers: Publishers::None,
    }
}

fn named(text: &str) -> ResourceName {
    text.parse().unwrap()
}

/// A store with three revisions of room `a`, each with one set of features more.
async fn three_revisions() -> (tempfile::TempDir, Store) {
    let (folder, store) = stored().await;
    let sets = [set("f", 1.0), set("g", 2.0), set("h", 3.0)];
    for (position, set) in sets.iter().enumerate() {
        let published = store
            .publish_room(&room("a"), std::slice::from_ref(set))
            .await
            .unwrap();
        assert_eq!(published.revision, position as u64 + 1);
    }

    (folder, store)
}

async fn feature_names(store: &Store, revision: Option<u64>) -> Vec<String> {
    let stored = store.load_room("a", revision).await.unwrap();
    let names = stored.features.iter().map(|set| set.source().name.clone());
    names.collect()
}

/// Oracle: the definition of a default, by hand.
#[tokio::test]
async fn a_name_means_what_was_chosen() {
    let (_folder, store) = three_revisions().await;
    assert_eq!(feature_names(&store, None).await, ["f", "g", "h"]);
    assert_eq!(current_rooms(&store).await, [("a".to_owned(), 3)]);

    store
        .choose(&Choice::Revision(named("rooms/a/revisions/2")))
        .await
        .unwrap();
    assert_eq!(feature_names(&store, None).await, ["f", "g"]);
    assert_eq!(current_rooms(&store).await, [("a".to_owned(), 2)]);

    // What is published next has the next number, and the choice holds.
    let published = store
        .publish_room(&room("a"), &[set("i", 4.0)])
        .await
        .unwrap();
    assert_eq!(published.revision, 4);
    assert_eq!(feature_names(&store, None).await, ["f", "g"]);

    store
        .choose(&Choice::Revision(named("rooms/a/revisions/4")))
        .await
        .unwrap();
    assert_eq!(feature_names(&store, None).await, ["f", "g", "h", "i"]);
    store.take_back_choice().await.unwrap();
    assert_eq!(feature_names(&store, None).await, ["f", "g"]);

    store
        .choose(&Choice::Nothing(named("rooms/a")))
        .await
        .unwrap();
    assert_eq!(feature_names(&store, None).await, ["f", "g", "h", "i"]);

    // Taken back step by step, as far back as anything was chosen.
    for expected in [&["f", "g"][..], &["f", "g", "h", "i"]] {
        store.take_back_choice().await.unwrap();
        assert_eq!(feature_names(&store, None).await, expected);
    }
    assert!(matches!(
        store.take_back_choice().await,
        Err(Error::NothingToTakeBack)
    ));

    // What is gone cannot be meant again.
    store
        .choose(&Choice::Revision(named("rooms/a/revisions/1")))
        .await
        .unwrap();
    store
        .choose(&Choice::Nothing(named("rooms/a")))
        .await
        .unwrap();
    store.remove(&named("rooms/a/revisions/1")).await.unwrap();
    store.take_back_choice().await.unwrap();
    assert_eq!(feature_names(&store, None).await, ["f", "g", "h", "i"]);

    let unknown = Choice::Revision(named("rooms/a/revisions/9"));
    assert!(matches!(
        store.choose(&unknown).await,
        Err(Error::UnknownRevision { revision: 9, .. })
    ));
}

/// Oracle: the contract itself. Removed numbers are not given again, what is chosen stays, and the
/// space is free only after the collection.
#[tokio::test]
async fn what_is_removed_is_gone_and_its_number_too() {
    let (folder, store) = three_revisions().await;
    store
        .choose(&Choice::Revision(named("rooms/a/revisions/1")))
        .await
        .unwrap();
    assert!(matches!(
        store.remove(&named("rooms/a/revisions/1")).await,
        Err(Error::InUse { .. })
    ));

    let removed = store.remove(&named("rooms/a/revisions/3")).await.unwrap();
    assert_eq!(removed.revisions, [3]);
    assert!(matches!(
        store.load_room("a", Some(3)).await,
        Err(Error::UnknownRevision { newest: 2, .. })
    ));

    // No age is too long to be asked for.
    let for_ever = store.collect_garbage(aged(Duration::MAX)).await.unwrap();
    assert!(for_ever.files.is_empty());
    let ages = store
        .collect_garbage(aged(Duration::from_secs(1 << 42)))
        .await
        .unwrap();
    assert!(ages.files.is_empty());

    // A publisher may have begun from what was removed just now, so its objects stay for an hour.
    let hour = Duration::from_secs(3_600);
    assert!(
        store
            .find_garbage(aged(hour))
            .await
            .unwrap()
            .files
            .is_empty()
    );
    assert_eq!(files(folder.path(), "features-h").len(), 1);

    // Not even if the objects themselves were written long ago.
    for file in files(folder.path(), "objects/") {
        let long_ago = std::time::SystemTime::now() - 100 * hour;
        let file = std::fs::File::options().write(true).open(file).unwrap();
        file.set_modified(long_ago).unwrap();
    }
    assert!(
        store
            .find_garbage(aged(hour))
            .await
            .unwrap()
            .files
            .is_empty()
    );

    let garbage = store.collect_garbage(aged(Duration::ZERO)).await.unwrap();
    assert_eq!(garbage.files.len(), 1, "{garbage:?}");
    assert!(files(folder.path(), "features-h").is_empty());
    assert_eq!(feature_names(&store, Some(2)).await, ["f", "g"]);
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());

    let published = store
        .publish_room(&room("a"), &[set("k", 5.0)])
        .await
        .unwrap();
    assert_eq!(published.revision, 4);

    // The whole room, with what was chosen for it.
    let removed = store.remove(&named("rooms/a")).await.unwrap();
    assert_eq!(removed.revisions, [1, 2, 4]);
    assert!(current_rooms(&store).await.is_empty());
    store.collect_garbage(aged(Duration::ZERO)).await.unwrap();
    assert!(files(folder.path(), "safetensors").is_empty());

    let published = store
        .publish_room(&room("a"), &[set("f", 1.0)])
        .await
        .unwrap();
    assert_eq!(published.revision, 5);
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
}

/// Oracle: the objects that the manifests on disk name, read by hand from their JSON.
#[tokio::test]
async fn live_objects_are_never_garbage() {
    // The publication of a second revision is killed at each of its writes.
    for survives in 0..12 {
        let (folder, store) = stored().await;
        store
            .publish_room(&room("a"), &[set("f", 1.0)])
            .await
            .unwrap();

        let files_of = LocalFileSystem::new_with_prefix(folder.path()).unwrap();
        let dying = Store::with_objects(Arc::new(Dying::new(files_of, survives)), "dying");
        let ended = dying
            .publish_room(&room("a"), &[set("g", 2.0), set("h", 3.0)])
            .await;

        // What a write leaves that is killed before its file has a name.
        let unfinished = folder.path().join("rooms/a/objects/frames.safetensors#1");
        std::fs::write(&unfinished, b"half").unwrap();

        let objects = |word: &str| {
            let found = files(folder.path(), "objects/").into_iter();
            let name =
                |path: std::path::PathBuf| path.file_name().unwrap().to_str().unwrap().to_owned();
            found
                .map(name)
                .filter(|name| name.contains(word))
                .collect::<BTreeSet<String>>()
        };
        let named: BTreeSet<String> = files(folder.path(), "revisions/")
            .iter()
            .flat_map(|manifest| object_names(manifest))
            .collect();

        let garbage = store.collect_garbage(aged(Duration::ZERO)).await.unwrap();
        assert_eq!(objects(""), named, "killed after {survives} writes");
        assert!(
            garbage.files.iter().any(|file| file.path.ends_with("#1")),
            "{garbage:?}"
        );
        assert!(store.verify(&|_| ()).await.unwrap().is_empty());

        let revision = store.load_room("a", None).await.unwrap().revision;
        assert_eq!(revision, if ended.is_ok() { 2 } else { 1 });
    }
}

/// The names of the objects in a manifest.
fn object_names(manifest: &Path) -> Vec<String> {
    fn collect(value: &serde_json::Value, names: &mut Vec<String>) {
        if let Some(name) = value.get("file").and_then(serde_json::Value::as_str) {
            names.push(name.to_owned());
        }
        match value {
            serde_json::Value::Array(entries) => {
                entries.iter().for_each(|entry| collect(entry, names));
            }
            serde_json::Value::Object(entries) => {
                entries.values().for_each(|entry| collect(entry, names));
            }
            _ => {}
        }
    }

    let mut names = Vec::new();
    collect(&seese3_testing::json(manifest), &mut names);
    names
}

/// Oracle: the contract itself: the newest revision is there until the last of them goes. A
/// revision is removed by its `.gone` file, the sixth write of three removals; its manifest is
/// deleted after that.
#[tokio::test]
async fn a_removal_that_dies_leaves_the_newest() {
    for survives in 0..7 {
        let (folder, store) = three_revisions().await;
        store
            .choose(&Choice::Revision(named("rooms/a/revisions/1")))
            .await
            .unwrap();
        let files_of = LocalFileSystem::new_with_prefix(folder.path()).unwrap();
        let dying = Store::with_objects(Arc::new(Dying::new(files_of, survives)), "dying");
        assert!(dying.remove(&named("rooms/a")).await.is_err());

        if survives == 6 {
            assert!(current_rooms(&store).await.is_empty());
            assert!(store.verify(&|_| ()).await.unwrap().is_empty());
            store.collect_garbage(aged(Duration::ZERO)).await.unwrap();
            assert!(
                files(folder.path(), ".json")
                    .iter()
                    .all(|file| !file.ends_with("000003.json"))
            );
            continue;
        }

        // The choice is taken back first; it would hide what is still there.
        let expected: &[&str] = match survives {
            0 => &["f"],
            _ => &["f", "g", "h"],
        };
        assert_eq!(feature_names(&store, None).await, expected);
        assert!(store.verify(&|_| ()).await.unwrap().is_empty());

        // The second try finishes what the first began.
        store.remove(&named("rooms/a")).await.unwrap();
        assert!(current_rooms(&store).await.is_empty());
    }
}

/// Oracle: the promise: what is removed makes room on a full disk, and its numbers are not given
/// again.
#[tokio::test]
async fn a_full_disk_can_be_emptied() {
    let (folder, store) = three_revisions().await;
    let files_of = LocalFileSystem::new_with_prefix(folder.path()).unwrap();
    let full = Store::with_objects(Arc::new(Dying::full(files_of)), "full");
    assert!(full.publish_room(&room("b"), &[]).await.is_err());

    full.remove(&named("rooms/a")).await.unwrap();
    assert!(current_rooms(&full).await.is_empty());
    full.collect_garbage(aged(Duration::ZERO)).await.unwrap();
    assert!(files(folder.path(), "objects/").is_empty());

    let again = store.publish_room(&room("a"), &[set("f", 1.0)]).await;
    assert_eq!(again.unwrap().revision, 4);
}

/// Oracle: by hand. Where the file of the newest choices is damaged, those before it stand, nobody
/// chooses on top of it, and it can be taken back.
#[tokio::test]
async fn damaged_choices_can_be_taken_back() {
    let (folder, store) = three_revisions().await;
    for revision in [1, 2] {
        let resource = named(&format!("rooms/a/revisions/{revision}"));
        store.choose(&Choice::Revision(resource)).await.unwrap();
    }
    let newest = folder.path().join("defaults/000002.json");
    let intact = std::fs::read(&newest).unwrap();
    std::fs::write(&newest, &intact[..intact.len() / 2]).unwrap();

    let standing = store.standing_defaults().await.unwrap();
    let current = store.current_rooms(&standing.defaults).await.unwrap();
    assert_eq!(current, [("a".to_owned(), 1)]);
    let refused = standing.refused.unwrap().to_string();
    assert!(refused.contains("defaults/000002.json"), "{refused}");

    let third = Choice::Revision(named("rooms/a/revisions/3"));
    assert!(matches!(
        store.choose(&third).await,
        Err(Error::Damaged { .. })
    ));

    store.take_back_choice().await.unwrap();
    assert_eq!(current_rooms(&store).await, [("a".to_owned(), 1)]);
    assert!(store.standing_defaults().await.unwrap().refused.is_none());

    // Without any file that can be read, nothing is chosen.
    for file in files(folder.path(), "defaults/") {
        std::fs::write(file, "{").unwrap();
    }
    let standing = store.standing_defaults().await.unwrap();
    let current = store.current_rooms(&standing.defaults).await.unwrap();
    assert_eq!(current, [("a".to_owned(), 3)]);
    assert!(standing.refused.is_some());

    assert_eq!(store.take_back_choice().await.unwrap(), Defaults::default());
    assert!(store.standing_defaults().await.unwrap().refused.is_none());

    // A number that leaves no room for a next one was not given by us.
    let alien = folder.path().join(format!("defaults/{}.json", u64::MAX));
    std::fs::write(alien, "{").unwrap();
    store.choose(&third).await.unwrap();
    assert_eq!(current_rooms(&store).await, [("a".to_owned(), 3)]);

    std::fs::remove_dir_all(folder.path().join("defaults")).unwrap();
    std::fs::write(folder.path().join("defaults"), "").unwrap();
    assert!(store.standing_defaults().await.unwrap().refused.is_some());
    assert!(!store.verify(&|_| ()).await.unwrap().is_empty());
}

/// Oracle: the damage that the test does. Each file is found by its name.
#[tokio::test]
async fn verification_finds_damage_and_broken_references() {
    let (folder, store) = three_revisions().await;
    let (room, set) = (room("a"), set("f", 1.0));
    let (adapter, record) = adapter(&room, &set);
    store
        .publish_adapter("base", &adapter, &record, set.rows())
        .await
        .unwrap();
    store
        .choose(&Choice::Adapter {
            room: "a".to_owned(),
            adapter: "base".to_owned(),
        })
        .await
        .unwrap();
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
    assert!(matches!(
        store.remove(&named("adapters/base")).await,
        Err(Error::InUse { .. })
    ));

    for (word, resource) in [
        ("features-g", "rooms/a/revisions/2"),
        ("weights-", "adapters/base/revisions/1"),
        ("revisions/000001.json", "revisions/1"),
        ("defaults/000001.json", "defaults"),
    ] {
        let altered = files(folder.path(), word);
        assert!(!altered.is_empty(), "no file {word}");
        for file in altered {
            let intact = std::fs::read(&file).unwrap();
            let mut altered = intact.clone();
            let middle = altered.len() / 2;
            altered[middle] ^= 1;
            std::fs::write(&file, &altered).unwrap();

            let findings = store.verify(&|_| ()).await.unwrap();
            assert!(
                findings
                    .iter()
                    .any(|finding| finding.resource.contains(resource)
                        && finding
                            .problem
                            .contains(file.file_name().unwrap().to_str().unwrap())),
                "{}: {findings:?}",
                file.display()
            );
            std::fs::write(&file, &intact).unwrap();
        }
    }
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
}

/// Oracle: the reference itself: a fitted adapter names the adapter that it began from.
#[tokio::test]
async fn what_a_fitted_adapter_needs_stays() {
    let (_folder, store) = stored().await;
    let (hall, features) = world::served("hall");
    store
        .publish_room(&hall, std::slice::from_ref(&features))
        .await
        .unwrap();
    let (base, record) = world::calibrated();
    store
        .publish_adapter("base", &base, &record, features.rows())
        .await
        .unwrap();

    let data = RoomData {
        room: &hall,
        revision: 1,
        features: &features,
    };
    let mapped: Vec<FrameId> = (0..hall.frame_count() as u32).map(FrameId).collect();
    let fitted = fit(&data, &mapped, None, 0, FitRun::UNWATCHED).unwrap();
    let room_fit = RoomFit {
        room: hall.id().clone(),
        room_revision: 1,
        base: Some(seese3_store::BaseAdapter {
            name: "base".to_owned(),
            revision: 1,
        }),
        rules: fitted.rules.clone(),
    };
    publish_fitted(&store, &fitted, &room_fit, &features).await;

    let refused = store.remove(&named("adapters/base")).await;
    assert!(
        matches!(&refused, Err(Error::InUse { reason, .. }) if reason.contains("adapters/fitted/revisions/1")),
        "{refused:?}"
    );

    store.remove(&named("adapters/fitted")).await.unwrap();
    store.remove(&named("adapters/base")).await.unwrap();
}

async fn publish_fitted(
    store: &Store,
    fitted: &seese3_robot::fitting::Fitted,
    room_fit: &RoomFit,
    features: &Features,
) {
    store
        .publish_fitted("fitted", fitted, room_fit, features.rows())
        .await
        .unwrap();
}

/// Room `hall` as `name`, with its features as `features`.
fn hall_as(name: &str, features: &str) -> (Room, Features) {
    let (hall, rows) = world::served("hall");
    let room = Room::new(
        RoomId::new(name).unwrap(),
        hall.frames().clone(),
        hall.provenance().clone(),
    );
    let source = FeatureSource {
        name: features.to_owned(),
        ..rows.source().clone()
    };
    (
        room.unwrap(),
        Features::new(source, rows.rows().to_owned()).unwrap(),
    )
}

fn fit_of(room: &str, name: Option<&str>) -> Request {
    Request {
        room: room.to_owned(),
        base: None,
        features: None,
        name: name.map(str::to_owned),
        own_names_only: true,
        seed: 0,
    }
}

/// Oracle: the contract: room `lab` with features `b.f` and room `lab.b` with features `f` have the
/// same default name, `lab.b.f.fitted`; the second gets `lab.b.f-fitted`, and keeps it. The quota
/// of a room counts its own adapter alone, and a deleted adapter until it is collected.
#[tokio::test]
async fn a_room_takes_no_name_and_no_quota_of_another() {
    let (_folder, store) = stored().await;
    for (name, features) in [("lab", "b.f"), ("lab.b", "f")] {
        let (room, features) = hall_as(name, features);
        store.publish_room(&room, &[features]).await.unwrap();
    }
    let fitted = async |room: &str| {
        let mut refit = Refit::prepare(&store, fit_of(room, None)).await.unwrap();
        let fitted = refit.fit(FitRun::UNWATCHED).unwrap();
        refit.publish(&store, &fitted).await.unwrap();
        refit.name().to_owned()
    };
    assert_eq!(fitted("lab").await, "lab.b.f.fitted");
    assert_eq!(fitted("lab.b").await, "lab.b.f-fitted");
    assert_eq!(fitted("lab.b").await, "lab.b.f-fitted");

    for (name, is_free) in [
        ("lab.mine", true),
        ("lab.b.f.fitted", true),
        ("lab.b", true),
        ("lab.", false),
        ("lab.b.mine", false),
        ("lab.b.f-fitted", false),
        ("labmine", false),
        ("mine", false),
    ] {
        let answer = Refit::prepare(&store, fit_of("lab", Some(name))).await;
        match answer {
            Ok(_) => assert!(is_free, "{name}"),
            Err(FitError::OtherRooms { .. }) => assert!(!is_free, "{name}"),
            Err(error) => panic!("{name}: {error}"),
        }
    }

    let reached = async |room: &str, caller: u64, scope: Option<Scope>| {
        let quotas = Quotas {
            room: of_revisions(2),
            caller: of_revisions(caller),
            scope,
        };
        match store.with_quotas(quotas).check_quotas(Some(room)).await {
            Ok(()) => String::new(),
            Err(error) => error.to_string(),
        }
    };
    // Fitting twice with one seed gives one revision.
    for room in ["lab", "lab.b"] {
        let expected = format!("rooms/{room} with its fitted adapters has 2 of 2 revisions");
        assert!(reached(room, 100, None).await.starts_with(&expected));
    }
    let lab: Scope = Arc::new(|room: &str| room == "lab");
    assert!(
        reached("other", 2, Some(lab.clone()))
            .await
            .starts_with("the caller has 2 of 2")
    );
    assert_eq!(reached("other", 3, Some(lab)).await, "");
    assert!(
        reached("other", 4, None)
            .await
            .starts_with("the caller has 4 of 4")
    );

    store
        .remove(&named("adapters/lab.b.f.fitted"))
        .await
        .unwrap();
    assert_eq!(fitted("lab.b").await, "lab.b.f-fitted", "it has that one");
    let of_room = store.usage(&named("rooms/lab")).await.unwrap();
    let charged = async |room: &str, bytes: u64| {
        let limited = store.with_quotas(Quotas {
            room: Quota {
                revisions: None,
                bytes: Some(bytes),
            },
            ..Quotas::default()
        });
        limited.check_quotas(Some(room)).await.is_err()
    };
    assert!(charged("lab", of_room.bytes + 1).await);

    // The garbage of another room is not charged.
    let of_lab = store
        .usage(&named("adapters/lab.b.f.fitted"))
        .await
        .unwrap();
    let of_lab = of_lab.bytes + of_room.bytes;
    assert!(!charged("lab", of_lab + 1).await);
    store
        .remove(&named("adapters/lab.b.f-fitted"))
        .await
        .unwrap();
    assert!(charged("lab", of_lab).await);
    assert!(!charged("lab", of_lab + 1).await);
}

fn of_revisions(most: u64) -> Quota {
    Quota {
        revisions: Some(most),
        bytes: None,
    }
}

/// Oracle: the contract: at the limit new content is refused before anything is written, and a
/// repeat of what is stored succeeds.
#[tokio::test]
async fn at_a_quota_nothing_is_written_and_a_repeat_succeeds() {
    let (folder, store) = stored().await;
    let first = [set("f", 1.0)];
    store.publish_room(&room("a"), &first).await.unwrap();
    let inputs = set("f", 1.0);
    let (shallow, record) = adapter(&room("a"), &inputs);
    store
        .publish_adapter("any", &shallow, &record, inputs.rows())
        .await
        .unwrap();
    let before = files(folder.path(), "");

    let limited = store.with_quotas(Quotas {
        caller: of_revisions(2),
        ..Quotas::default()
    });
    let repeated = limited.publish_room(&room("a"), &first).await.unwrap();
    assert_eq!((repeated.revision, repeated.is_new), (1, false));
    let again = limited.publish_adapter("any", &shallow, &record, inputs.rows());
    assert!(!again.await.unwrap().is_new);

    let other = [set("f", 2.0)];
    for answer in [
        limited.publish_room(&room("a"), &other).await,
        limited.publish_room(&room("b"), &other).await,
        limited
            .publish_adapter("other", &shallow, &record, inputs.rows())
            .await,
    ] {
        assert!(matches!(answer, Err(Error::Quota { .. })), "{answer:?}");
    }
    assert_eq!(files(folder.path(), ""), before);
    assert!(store.publish_room(&room("b"), &other).await.unwrap().is_new);

    // A repeat that would have to write a missing object does not claim success.
    for object in files(folder.path(), "rooms/a/objects/features-f") {
        std::fs::remove_file(object).unwrap();
    }
    let repeated = limited.publish_room(&room("a"), &first).await;
    assert!(matches!(repeated, Err(Error::Quota { .. })), "{repeated:?}");
    store.publish_room(&room("a"), &first).await.unwrap();
    store.load_room("a", None).await.unwrap();
}

/// Oracle: the promise: a revision that was published has its objects, whoever collects garbage
/// meanwhile. The objects that are published again were left by a removal long ago.
#[tokio::test]
async fn garbage_that_is_published_again_is_not_collected() {
    let (folder, store) = stored().await;
    let (room, features) = (room("a"), [set("f", 1.0)]);
    let long_ago = std::time::SystemTime::now() - Duration::from_secs(10 * 3_600);

    for round in 0..10 {
        let published = store.publish_room(&room, &features).await.unwrap();
        assert!(published.is_new);
        store.remove(&named("rooms/a")).await.unwrap();
        for file in files(folder.path(), "rooms/a") {
            let file = std::fs::File::options().write(true).open(file).unwrap();
            file.set_modified(long_ago).unwrap();
        }

        let collecting = {
            let store = store.clone();
            let pause = Duration::from_micros(300 * round);
            tokio::spawn(async move {
                // Only spreads the moments at which the collection begins.
                tokio::time::sleep(pause).await;
                store.collect_garbage(GarbagePolicy::default()).await
            })
        };
        store.publish_room(&room, &features).await.unwrap();
        collecting.await.unwrap().unwrap();

        let findings = store.verify(&|_| ()).await.unwrap();
        assert!(findings.is_empty(), "round {round}: {findings:?}");
        store.remove(&named("rooms/a")).await.unwrap();
    }
}

/// Oracle: the promise: of two recordings under one name one is published, unless the other is to
/// replace it; the same frames with other features are no other recording.
#[tokio::test]
async fn other_frames_are_not_published_by_accident() {
    let (_folder, store) = stored().await;
    let first = room("a");
    let mut frames = first.frames().clone();
    frames.poses.reverse();
    let other = Room::new(first.id().clone(), frames, first.provenance().clone()).unwrap();

    let publish = async |room: &Room, scale: f32| {
        let features = [set("f", scale)];
        store.publish_same_frames(room, &features).await
    };
    assert_eq!(publish(&first, 1.0).await.unwrap().revision, 1);
    assert_eq!(publish(&first, 2.0).await.unwrap().revision, 2);
    let refused = publish(&other, 1.0).await;
    assert!(
        matches!(refused, Err(Error::OtherFrames { revision: 2, .. })),
        "{refused:?}"
    );

    let replaced = store.publish_room(&other, &[set("f", 1.0)]).await.unwrap();
    assert_eq!(replaced.revision, 3);
}

/// Oracle: the contract: an upload that is refused writes nothing.
#[tokio::test]
async fn a_refused_upload_leaves_no_objects() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let room = seese3_testing::recording::room("a");
    let contents = seese3_store::RoomContents::of(&room, &[]);
    let policy = seese3_store::UploadPolicy::Replace;
    let refused = store.upload_contents(contents, policy).await;
    assert!(refused.is_err(), "{refused:?}");
    assert!(!folder.path().join("rooms").exists());
}

/// Oracle: the contract: the same poses and features are the same content, however exact the
/// matrices were that the poses were read from.
#[tokio::test]
async fn rounded_matrices_are_no_other_content() {
    use seese3_core::room::{Provenance, Room};

    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let room = seese3_testing::recording::room("a");
    store.publish_room(&room, &[]).await.unwrap();
    let origin = Provenance {
        worst_rotation_deviation: 1e-7,
        ..room.provenance().clone()
    };
    let rounded = Room::new(room.id().clone(), room.frames().clone(), origin).unwrap();
    let contents = seese3_store::RoomContents::of(&rounded, &[]);
    let policy = seese3_store::UploadPolicy::Create;
    let published = store.upload_contents(contents, policy).await.unwrap();
    assert!(!published.is_new);
}

/// Oracle: the contract: what is kept comes back as it was or not at all, and is garbage once the
/// room is gone.
#[tokio::test]
async fn what_is_derived_is_kept_while_its_room_is() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let (hall, features) = world::served("hall");
    let sets = std::slice::from_ref(&features);
    store.publish_room(&hall, sets).await.unwrap();
    let (adapter, record) = world::calibrated();
    store
        .publish_adapter("eyes", &adapter, &record, features.rows())
        .await
        .unwrap();
    let adapter = store.load_adapter("eyes", None).await.unwrap();
    let key = store.derived_key("hall", 1, &adapter).await.unwrap();
    let key = key.expect("the room has the features");
    assert_eq!(store.load_derived(&key).await, None);

    // Equal numbers of another kind: with every part, and with none but the latents.
    let numbers = |rows, columns| {
        ndarray::Array2::from_shape_fn((rows, columns), |(i, j)| (i * 7 + j) as f64 / 3.0)
    };
    let errors = || {
        numbers(1, MapTables::ERRORS)
            .into_iter()
            .collect::<Vec<_>>()
    };
    let with = |map| Derived {
        latents: numbers(5, 2),
        map,
    };
    let by_feature = FeatureTables {
        mean: numbers(1, 4).into_iter().collect(),
        components: numbers(3, 4),
        coordinates: numbers(5, 3),
        errors: [errors(), errors()],
    };
    for map in [
        None,
        Some(MapTables {
            typical_distance: 0.5,
            errors: None,
            by_feature: None,
        }),
        Some(MapTables {
            typical_distance: 0.5,
            errors: Some(errors()),
            by_feature: Some(by_feature),
        }),
    ] {
        let derived = with(map);
        store.keep_derived(&key, &derived).await.unwrap();
        assert_eq!(store.load_derived(&key).await, Some(derived));
    }

    // Each altered or missing byte is noticed.
    let [file] = files(folder.path(), "derived/")
        .try_into()
        .expect("one file");
    let whole = std::fs::read(&file).unwrap();
    for at in [0, 40, whole.len() - 1] {
        let mut altered = whole.clone();
        altered[at] ^= 1;
        std::fs::write(&file, altered).unwrap();
        assert_eq!(store.load_derived(&key).await, None, "byte {at}");
        std::fs::write(&file, &whole[..at]).unwrap();
        assert_eq!(store.load_derived(&key).await, None, "cut at {at}");
    }
    std::fs::write(&file, &whole).unwrap();

    // Another revision of the frames or features is another key.
    let other = features.select(&(0..100).collect::<Vec<_>>());
    let cut = hall.frames().select(&(0..100).collect::<Vec<_>>());
    let cut = Room::new(hall.id().clone(), cut, hall.provenance().clone()).unwrap();
    store.publish_room(&cut, &[other]).await.unwrap();
    assert_ne!(
        store.derived_key("hall", 2, &adapter).await.unwrap(),
        Some(key.clone())
    );

    // The features that the adapter takes are those of its encoder, under any name.
    let encoded = |name: &str, encoder: &str| {
        let mut source = FeatureSource::imported(name, features.source().dim);
        source.encoder = encoder.to_owned();
        Features::new(source, features.rows().to_owned()).unwrap()
    };
    let room_of = |name: &str| {
        let frames = hall.frames().clone();
        Room::new(
            RoomId::new(name).unwrap(),
            frames,
            hall.provenance().clone(),
        )
        .unwrap()
    };
    let sets = [encoded("made-up", "b"), encoded("other", "a")];
    store
        .publish_room(&room_of("renamed"), &sets)
        .await
        .unwrap();
    let (seen, other) = (encoded("made-up", "a"), encoded("made-up", "c"));
    let key_of = async |name: &str, set: &Features| {
        let network = adapter.adapter.network().clone();
        let scale = adapter.adapter.scale().clone();
        let given = Adapter::new(set.source().clone(), network, scale).unwrap();
        let published = store.publish_adapter(name, &given, &record, features.rows());
        published.await.unwrap();
        let stored = store.load_adapter(name, None).await.unwrap();
        store.derived_key("renamed", 1, &stored).await.unwrap()
    };
    assert!(key_of("seen", &seen).await.is_some());
    assert!(key_of("other", &other).await.is_none());

    store.collect_garbage(aged(Duration::ZERO)).await.unwrap();
    assert!(store.load_derived(&key).await.is_some());
    store.remove(&named("rooms/hall").at(1)).await.unwrap();
    let garbage = store.collect_garbage(aged(Duration::ZERO)).await.unwrap();
    assert!(!file.exists(), "{garbage:?}");
}
