//! The store: what was published comes back, what was damaged is refused, what was interrupted is
//! not seen.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix6, Vector6};
use seese3_core::adapter::{CorrectorKind, Loss, Mixing, PairPlan, Preset, TrainConfig};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::{Split, StrideRange};
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};
use seese3_store::{Error, GarbagePolicy, Publishers, Store};
use seese3_testing::recording::{adapter, room, set};

pub async fn stored() -> (tempfile::TempDir, Store) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    (folder, store)
}

/// The files under a folder whose path contains a word.
pub fn files(folder: &Path, word: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.to_string_lossy().contains(word) {
                found.push(path);
            }
        }
    }

    found.sort();
    found
}

/// Oracle: what was published.
#[tokio::test]
async fn a_room_comes_back_as_it_was() {
    let (_folder, store) = stored().await;
    let room = room("a");
    let features = [set("f", 1.0), set("g", 2.0)];
    let published = store.publish_room(&room, &features).await.unwrap();

    assert_eq!((published.revision, published.is_new), (1, true));

    let back = store.load_room("a", None).await.unwrap();
    assert_eq!(back.room.timestamps_ns(), room.timestamps_ns());
    assert_eq!(back.room.frame_names(), room.frame_names());
    assert_eq!(back.room.frame_numbers(), room.frame_numbers());

    assert_eq!(back.room.images(), room.images());
    assert_eq!(back.room.timeline(), room.timeline());
    assert_eq!(back.room.provenance(), room.provenance());

    for (found, expected) in back.room.poses().iter().zip(room.poses()) {
        assert!(
            (found.to_homogeneous() - expected.to_homogeneous())
                .abs()
                .max()
                < 1e-15
        );
    }

    for (found, expected) in back.features.iter().zip(&features) {
        assert_eq!(
            (found.source(), found.rows()),
            (expected.source(), expected.rows())
        );
    }
}

/// Oracle: what was published, bit by bit: charts and their gate, an ensemble, correctors, the
/// errors' covariance, the record of a plan of our own.
#[tokio::test]
async fn every_kind_of_adapter_comes_back_as_it_was() {
    let (_folder, store) = stored().await;
    let room = room("a");
    let features = set("f", 1.0);
    for (name, charts, mixing, correctors) in [
        ("gated", 2, Mixing::Gate, vec![CorrectorKind::Linear]),
        ("ensemble", 3, Mixing::Even, vec![]),
        ("corrected", 1, Mixing::Gate, CorrectorKind::ALL.to_vec()),
    ] {
        let mut plan = TrainingPlan::of(Preset::Steady, Split::Time, 20, 4);
        let standardize = mixing == Mixing::Even;

        plan.config = TrainConfig {
            epochs: 3,
            charts,
            mixing,
            standardize,
            loss: Loss::Cosine,
            ..plan.config
        };

        plan.pairs = PairPlan::Range(StrideRange {
            low: 5,
            high: 9,
            count: 100,
        });

        plan.correctors = correctors;

        let (adapter, mut record) = train_adapter(
            &[RoomData {
                room: &room,
                revision: 1,
                features: &features,
            }],
            &plan,
            &mut |_| (),
        )
        .unwrap();

        let covariance = Matrix6::from_diagonal(&Vector6::new(1.0, 2.0, 3.0, 0.1, 0.2, 0.3));
        let adapter = adapter.with_error_covariance(covariance).unwrap();
        record.calibrated_on = vec![(RoomId::new("b").unwrap(), 3)];
        // An undefined score, as under `Split::Whole`, does not make the content new.
        record.test.direction = f64::NAN;
        for is_new in [true, false] {
            let published = store
                .publish_adapter(name, &adapter, &record, features.rows())
                .await
                .unwrap();
            assert_eq!(published.is_new, is_new, "{name}");
        }

        let back = store.load_adapter(name, None).await.unwrap();
        assert_eq!(back.adapter.network(), adapter.network(), "{name}");
        assert_eq!(back.adapter.network().mixing(), mixing, "{name}");
        assert!(back.adapter.correctors().eq(adapter.correctors()), "{name}");

        assert_eq!(back.adapter.error_covariance(), Some(covariance), "{name}");
        assert_eq!(back.record.config, record.config, "{name}");

        assert_eq!(
            (back.record.pairs, back.record.calibrated_on),
            (record.pairs, record.calibrated_on),
            "{name}"
        );
    }
}

/// Oracle: what a recording said once is not lost because the same poses are published again with
/// less.
#[tokio::test]
async fn publishing_the_same_poses_with_less_loses_nothing() {
    let (_folder, store) = stored().await;
    let whole = room("a");
    store.publish_room(&whole, &[set("f", 1.0)]).await.unwrap();

    let poses = Frames {
        poses: whole.poses().to_vec(),
        ..Frames::default()
    };
    let bare = Room::new(RoomId::new("a").unwrap(), poses, Provenance::default()).unwrap();
    store.publish_room(&bare, &[set("g", 2.0)]).await.unwrap();

    let back = store.load_room("a", None).await.unwrap();
    assert_eq!(back.room.timestamps_ns(), whole.timestamps_ns());

    assert_eq!(
        (back.room.images(), back.room.frame_names()),
        (whole.images(), whole.frame_names())
    );

    assert_eq!(
        (back.room.frame_numbers(), back.room.timeline()),
        (whole.frame_numbers(), whole.timeline())
    );

    assert_eq!(back.room.provenance().license, "CC0");

    assert_eq!(
        back.room.provenance().images_root,
        whole.provenance().images_root
    );

    assert_eq!(back.features.len(), 2);

    let moved = Frames {
        poses: whole.poses()[1..].to_vec(),
        ..Frames::default()
    };
    let moved = Room::new(RoomId::new("a").unwrap(), moved, Provenance::default()).unwrap();
    store.publish_room(&moved, &[]).await.unwrap();

    let back = store.load_room("a", None).await.unwrap();
    assert!(
        back.room.images().is_empty() && back.features.is_empty(),
        "other frames are another room"
    );
}

/// Oracle: the promise itself: the same content makes no revision; more features join, as long as
/// the frames stay.
#[tokio::test]
async fn publishing_twice_changes_nothing_and_features_are_added() {
    let (_folder, store) = stored().await;
    let room = room("a");
    store.publish_room(&room, &[set("f", 1.0)]).await.unwrap();
    let again = store.publish_room(&room, &[set("f", 1.0)]).await.unwrap();

    assert_eq!((again.revision, again.is_new), (1, false));

    let more = store.publish_room(&room, &[set("g", 1.0)]).await.unwrap();
    assert_eq!((more.revision, more.is_new), (2, true));

    let names = |stored: &seese3_store::StoredRoom| {
        stored
            .features
            .iter()
            .map(|features| features.source().name.clone())
            .collect::<Vec<_>>()
    };

    assert_eq!(
        names(&store.load_room("a", None).await.unwrap()),
        ["f", "g"]
    );

    assert_eq!(
        names(&store.load_room("a", Some(1)).await.unwrap()),
        ["f"],
        "an old revision stays as it was"
    );

    assert!(matches!(
        store.load_room("a", Some(3)).await,
        Err(Error::UnknownRevision {
            revision: 3,
            newest: 2,
            ..
        })
    ));
}

/// Oracle: the adapter that was published answers with the same numbers, bit by bit.
#[tokio::test]
async fn an_adapter_comes_back_as_it_was() {
    let (_folder, store) = stored().await;
    let room = room("a");
    let features = set("f", 1.0);
    let (adapter, record) = adapter(&room, &features);
    store
        .publish_adapter("x", &adapter, &record, features.rows())
        .await
        .unwrap();

    let back = store.load_adapter("x", None).await.unwrap();
    assert_eq!(
        back.adapter.embed(features.rows()).unwrap(),
        adapter.embed(features.rows()).unwrap()
    );

    assert_eq!(
        (back.adapter.scale(), back.adapter.source()),
        (adapter.scale(), adapter.source())
    );

    assert_eq!(back.record, record);
}

/// Oracle: a list of damages: truncated, altered, or missing files are each named; nothing is
/// answered from them.
#[tokio::test]
async fn damage_is_found_and_its_file_named() {
    let room = room("a");
    let features = set("f", 1.0);
    let (trained, record) = adapter(&room, &features);

    let flip = |bytes: &mut Vec<u8>| {
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
    };

    let cut = |bytes: &mut Vec<u8>| bytes.truncate(bytes.len() - 1);
    for word in [
        "frames-",
        "frame-names-",
        "features-",
        "rooms/a/revisions",
        "weights-",
        "adapters/x/revisions",
    ] {
        for harm in [&flip as &dyn Fn(&mut Vec<u8>), &cut, &|bytes: &mut Vec<
            u8,
        >| {
            bytes.clear()
        }] {
            let (folder, store) = stored().await;
            store
                .publish_room(&room, std::slice::from_ref(&features))
                .await
                .unwrap();

            store
                .publish_adapter("x", &trained, &record, features.rows())
                .await
                .unwrap();

            let path = &files(folder.path(), word)[0];
            let mut bytes = std::fs::read(path).unwrap();
            harm(&mut bytes);
            std::fs::write(path, bytes).unwrap();

            let error = if word.contains("adapters") || word.contains("weights") {
                store.load_adapter("x", None).await.unwrap_err()
            } else {
                store.load_room("a", None).await.unwrap_err()
            };

            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            assert!(matches!(error, Error::Damaged { .. }), "{word}: {error}");
            assert!(error.to_string().contains(&name), "{error} names {name}");
        }
    }
}

/// Oracle: golden vectors exist to catch a program that computes something else: here, other
/// weights under a valid checksum.
#[tokio::test]
async fn an_adapter_that_computes_something_else_is_refused() {
    let (folder, store) = stored().await;
    let room = room("a");
    let features = set("f", 1.0);
    let (trained, record) = adapter(&room, &features);
    store
        .publish_adapter("x", &trained, &record, features.rows())
        .await
        .unwrap();

    let weights = files(folder.path(), "weights-").remove(0);
    let bytes = std::fs::read(&weights).unwrap();
    let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let text = String::from_utf8_lossy(&bytes[8..8 + header]).into_owned();
    let tensors: serde_json::Value = serde_json::from_str(&text).unwrap();
    let start = 8 + header + tensors["W.weight"]["data_offsets"][0].as_u64().unwrap() as usize;

    let mut altered = bytes;
    altered[start..start + 4].copy_from_slice(&3.5f32.to_le_bytes());

    let checksum = |bytes: &[u8]| {
        use sha2::Digest;

        sha2::Sha256::digest(bytes)
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect::<String>()
    };

    std::fs::write(&weights, &altered).unwrap();
    let manifest = files(folder.path(), "adapters/x/revisions").remove(0);
    let envelope: serde_json::Value =
        serde_json::from_slice(&std::fs::read(&manifest).unwrap()).unwrap();
    let mut body = envelope["body"].clone();
    body["weights"]["sha256"] = checksum(&altered).into();

    let body = body.to_string();
    std::fs::write(
        &manifest,
        format!(
            "{{\"sha256\": \"{}\", \"body\": {body}}}",
            checksum(body.as_bytes())
        ),
    )
    .unwrap();

    let error = store.load_adapter("x", None).await.unwrap_err().to_string();
    assert!(error.contains("golden twists"), "{error}");
}

/// Oracle: the promise itself: whichever write of a publish is the last that happens, the old
/// version is whole, and the new one is there only when all of it is.
#[tokio::test]
async fn a_publish_that_dies_at_any_write_leaves_the_old_version() {
    let room = room("a");
    let old = [set("f", 1.0)];
    let new = [set("f", 3.0), set("g", 1.0)];
    for survives in 0..=4 {
        let (folder, store) = stored().await;
        store.publish_room(&room, &old).await.unwrap();
        let disk = object_store::local::LocalFileSystem::new_with_prefix(folder.path()).unwrap();
        let dying = Store::with_objects(
            std::sync::Arc::new(crate::dying::Dying::new(disk, survives)),
            "dying",
        );

        let published = dying.publish_room(&room, &new).await;

        // Two sets of features, the frames and their names are written before the manifest.
        assert!(published.is_err(), "write {survives} of 5 failed");

        let back = store.load_room("a", None).await.unwrap();
        assert_eq!(
            (back.revision, back.features.len()),
            (1, 1),
            "after {survives} writes"
        );

        assert_eq!(back.features[0].rows(), old[0].rows());

        let again = store.publish_room(&room, &new).await.unwrap();
        assert_eq!(
            (again.revision, again.is_new),
            (2, true),
            "and publishing again repairs"
        );
    }

    // Tensors without any manifest: the room is not there at all.
    let (folder, store) = stored().await;
    let objects = folder.path().join("rooms/b/objects");
    std::fs::create_dir_all(&objects).unwrap();
    std::fs::write(objects.join("frames-0.safetensors"), b"half").unwrap();

    assert!(matches!(
        store.load_room("b", None).await,
        Err(Error::Unknown { .. })
    ));

    assert!(store.rooms().await.unwrap().is_empty());
}

/// Oracle: a manifest says what it is: one that was moved or copied is not what its place says.
#[tokio::test]
async fn a_manifest_in_another_place_is_refused() {
    let (folder, store) = stored().await;
    store
        .publish_room(&room("a"), &[set("f", 1.0)])
        .await
        .unwrap();

    let revisions = folder.path().join("rooms/a/revisions");
    std::fs::copy(revisions.join("000001.json"), revisions.join("000003.json")).unwrap();
    let error = store.load_room("a", None).await.unwrap_err().to_string();

    assert!(
        error.contains("000003.json") && error.contains("moved or copied"),
        "{error}"
    );

    std::fs::remove_file(revisions.join("000003.json")).unwrap();
    std::fs::rename(folder.path().join("rooms/a"), folder.path().join("rooms/b")).unwrap();

    assert!(matches!(
        store.load_room("b", None).await,
        Err(Error::Damaged { .. })
    ));
}

/// Oracle: the promise itself: publishers never share a revision, and what each brought is there at
/// the end.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn publishers_at_the_same_time_get_revisions_of_their_own() {
    let (_folder, store) = stored().await;
    let publish = |number: usize| {
        let store = store.clone();
        tokio::spawn(async move {
            let features = [set(&format!("f{number}"), 1.0)];
            store
                .publish_room(&room("a"), &features)
                .await
                .unwrap()
                .revision
        })
    };

    let mut revisions = Vec::new();
    for task in (0..6).map(publish).collect::<Vec<_>>() {
        revisions.push(task.await.unwrap());
    }

    revisions.sort_unstable();
    assert_eq!(revisions, [1, 2, 3, 4, 5, 6]);
    assert_eq!(store.load_room("a", None).await.unwrap().features.len(), 6);
}

/// Oracle: a list of bad input: unknown names, names that are paths, rows that do not fit, places
/// that are not there.
#[tokio::test]
async fn bad_visitors_are_told_what_to_change() {
    let (_folder, store) = stored().await;
    let room = room("a");
    store.publish_room(&room, &[set("f", 1.0)]).await.unwrap();

    for name in ["nope", "../a", "a/b", ""] {
        let error = store.load_room(name, None).await.unwrap_err().to_string();
        assert!(error.contains("it has a"), "{error}");
    }

    let short = Features::new(
        FeatureSource::imported("s", 0),
        ndarray::Array2::ones((5, 3)),
    )
    .unwrap();

    assert!(matches!(
        store.publish_room(&room, &[short]).await,
        Err(Error::FeatureRows { rows: 5, .. })
    ));

    assert!(matches!(
        store.publish_room(&room, &[set("a/b", 1.0)]).await,
        Err(Error::Name { .. })
    ));

    let twice = [set("f", 1.0), set("f", 2.0)];
    assert!(matches!(
        store.publish_room(&room, &twice).await,
        Err(Error::DuplicateFeatures { .. })
    ));

    assert!(matches!(
        store.load_room_with("a", Some("g")).await,
        Err(Error::UnknownFeatures { .. })
    ));

    assert!(matches!(
        Store::open("/no/such/folder"),
        Err(Error::Missing { .. })
    ));

    assert!(matches!(
        Store::open("nonsense://bucket/prefix"),
        Err(Error::Open { .. })
    ));
}

/// Oracle: the contract of the feature `cloud`: a bucket is opened without a request, or the error
/// names the feature.
#[test]
fn a_bucket_is_opened_or_the_error_names_the_feature() {
    let opened = Store::open("s3://bucket/prefix");
    if cfg!(feature = "cloud") {
        assert_eq!(opened.unwrap().location(), "s3://bucket/prefix");
    } else {
        let error = opened.unwrap_err().to_string();
        assert!(error.contains("--features cloud"), "{error}");
    }
}

/// Oracle: the contract: a server that ignores If-None-Match gets no revision, and is named.
#[tokio::test]
async fn a_bucket_that_ignores_conditions_is_refused() {
    let ignoring = crate::dying::Dying::unconditional(object_store::memory::InMemory::new());
    let objects: std::sync::Arc<dyn object_store::ObjectStore> = std::sync::Arc::new(ignoring);
    let store = Store::with_objects(objects.clone(), "s3://ignoring").with_write_check();
    for _ in 0..2 {
        let refused = store.publish_room(&room("a"), &[set("f", 1.0)]).await;
        assert!(
            matches!(refused, Err(Error::NotConditional { .. })),
            "{refused:?}"
        );
    }
    assert!(
        store
            .check_writable()
            .await
            .unwrap_err()
            .to_string()
            .contains("If-None-Match")
    );
    assert!(store.rooms().await.unwrap().is_empty());

    // Nothing is left of what it was tried with.
    let everything = GarbagePolicy {
        older_than: std::time::Duration::ZERO,
        publishers: Publishers::None,
    };
    let plain = Store::with_objects(objects, "s3://ignoring");
    let left = plain.find_garbage(everything).await.unwrap().files;
    assert!(
        left.iter().all(|file| !file.path.contains("probe")),
        "{left:?}"
    );

    let honoring = std::sync::Arc::new(object_store::memory::InMemory::new());
    let store = Store::with_objects(honoring, "memory").with_write_check();
    let published = store
        .publish_room(&room("a"), &[set("f", 1.0)])
        .await
        .unwrap();
    assert_eq!(published.revision, 1);
}
