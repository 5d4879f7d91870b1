//! Frames that are added to a room.

use seese3_core::features::{FeatureSource, Features};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_store::{Error, OtherFeatures, RoomContents, Store};

use crate::store::stored;
use seese3_testing::recording::{room, set};

/// The frames of `room("a")` from one row to before another, with their poses, times and names.
fn part(rows: std::ops::Range<usize>) -> Room {
    let whole = room("a");
    let chosen: Vec<usize> = rows.collect();
    let frames = Frames {
        numbers: Vec::new(),
        images: Vec::new(),
        sequences: Vec::new(),
        held_out: Vec::new(),
        ..whole.frames().select(&chosen)
    };
    Room::new(RoomId::new("a").unwrap(), frames, Provenance::default()).unwrap()
}

fn rows(name: &str, scale: f32, rows: std::ops::Range<usize>) -> Features {
    set(name, scale).select(&rows.collect::<Vec<usize>>())
}

/// A store with the first 260 frames of `room("a")` and two sets of features.
async fn begun() -> (tempfile::TempDir, Store) {
    let (folder, store) = stored().await;
    let whole = room("a");
    let first: Vec<usize> = (0..260).collect();
    let known = Room::new(
        whole.id().clone(),
        whole.frames().select(&first),
        whole.provenance().clone(),
    )
    .unwrap();
    let features = [rows("f", 1.0, 0..260), rows("g", 2.0, 0..260)];
    store.publish_room(&known, &features).await.unwrap();

    (folder, store)
}

/// Oracle: the recording that was divided: first frames and added ones together are the whole.
#[tokio::test]
async fn added_frames_follow_the_rooms_own() {
    let (_folder, store) = begun().await;
    let features = [rows("g", 2.0, 260..300), rows("f", 1.0, 260..300)];
    let addition = part(260..300);
    let extend = || {
        store.extend_room(
            RoomContents::of(&addition, &features),
            OtherFeatures::Required,
        )
    };

    let published = extend().await.unwrap();
    assert_eq!((published.revision, published.is_new), (2, true));

    let whole = room("a");
    let back = store.load_room("a", Some(2)).await.unwrap();
    assert_eq!(back.room.frame_count(), 300);
    assert_eq!(back.room.timestamps_ns(), whole.timestamps_ns());
    assert_eq!(back.room.frame_names(), whole.frame_names());
    for (back, whole) in back.room.poses().iter().zip(whole.poses()) {
        assert!((back.to_homogeneous() - whole.to_homogeneous()).amax() < 1e-12);
    }
    for name in ["f", "g"] {
        let scale = if name == "f" { 1.0 } else { 2.0 };
        assert_eq!(
            back.features(name).unwrap().rows(),
            set(name, scale).rows(),
            "{name}"
        );
    }

    // The first frames have the sequences 0 to 5, ten of them in the last one; what is added begins
    // the sequence 6. Numbers go on from 3 · 259.
    let frames = back.room.frames();
    assert_eq!(frames.sequences[259..261], [5, 6]);
    assert_eq!(frames.numbers[259..262], [777, 778, 779]);
    assert_eq!(frames.held_out[259..261], [true, false]);
    assert!(frames.images.is_empty());
    assert_eq!(back.room.provenance().license, "CC0");
    assert_eq!(
        back.room.provenance().camera,
        whole.provenance().camera,
        "the room's camera stays"
    );

    // Sent again, they are there already; so are others that the room has had all along.
    let again = extend().await.unwrap();
    assert_eq!((again.revision, again.is_new), (2, false));
    let features = [rows("f", 1.0, 100..140), rows("g", 2.0, 100..140)];
    let others = OtherFeatures::Required;
    let addition = part(100..140);
    let old = store
        .extend_room(RoomContents::of(&addition, &features), others)
        .await;
    let old = old.unwrap();
    assert_eq!((old.revision, old.is_new), (2, false));

    // The same frames at another time are others.
    let known = addition.frames().clone();
    let later = |t: &i64| t + 1_000_000_000_000;
    let frames = Frames {
        timestamps_ns: known.timestamps_ns.iter().map(later).collect(),
        ..known
    };
    let again = Room::new(addition.id().clone(), frames, Provenance::default()).unwrap();
    let extended = store
        .extend_room(RoomContents::of(&again, &features), others)
        .await
        .unwrap();
    assert_eq!((extended.revision, extended.is_new), (3, true));
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
}

/// Oracle: the promise that nothing is lost: what does not fit is refused with what to change, and
/// the room stays as it was.
#[tokio::test]
async fn frames_that_do_not_fit_are_refused() {
    let (_folder, store) = begun().await;
    let both = || vec![rows("f", 1.0, 260..300), rows("g", 2.0, 260..300)];
    let one = || vec![rows("f", 1.0, 260..300)];
    let without_times = {
        let frames = Frames {
            timestamps_ns: Vec::new(),
            ..part(260..300).frames().clone()
        };
        Room::new(RoomId::new("a").unwrap(), frames, Provenance::default()).unwrap()
    };
    let elsewhere = {
        let frames = part(260..300).frames().clone();
        Room::new(RoomId::new("b").unwrap(), frames, Provenance::default()).unwrap()
    };

    let stranger = vec![rows("f", 1.0, 260..300), rows("h", 2.0, 260..300)];
    for (addition, features, word) in [
        (part(260..300), one(), "drop_other_features"),
        (part(260..300), stranger, "'h'"),
        (without_times, both(), "timestamps"),
        (elsewhere, both(), "'b'"),
    ] {
        let refused = store
            .extend_room(
                RoomContents::of(&addition, &features),
                OtherFeatures::Required,
            )
            .await
            .unwrap_err();
        assert!(refused.to_string().contains(word), "{refused}");
        assert!(
            matches!(refused, Error::CannotAdd { .. } | Error::Unknown { .. }),
            "{refused:?}"
        );
    }
    let newest = store.load_room("a", None).await.unwrap();
    assert_eq!((newest.revision, newest.features.len()), (1, 2));

    // On purpose, a set may be left behind.
    let published = store
        .extend_room(
            RoomContents::of(&part(260..300), &one()),
            OtherFeatures::LeftBehind,
        )
        .await
        .unwrap();
    let newest = store.load_room("a", None).await.unwrap();
    assert_eq!((published.revision, newest.features.len()), (2, 1));
}

/// Oracle: the names: two sets that are made alike get each its own rows, and an unnamed third one
/// is refused.
#[tokio::test]
async fn features_that_are_made_alike_are_told_by_their_names() {
    let (_folder, store) = stored().await;
    let of = |name: &str, scale: f32, rows: std::ops::Range<usize>| {
        let set = set(name, scale).select(&rows.collect::<Vec<usize>>());
        let source = FeatureSource {
            encoder: "one@1".to_owned(),
            ..set.source().clone()
        };
        Features::new(source, set.rows().to_owned()).unwrap()
    };
    let known = [of("f", 1.0, 0..260), of("g", 2.0, 0..260)];
    store.publish_room(&part(0..260), &known).await.unwrap();

    let both = [of("g", 2.0, 260..300), of("f", 1.0, 260..300)];
    let extend = |features: Vec<Features>| {
        let store = store.clone();
        async move {
            let others = OtherFeatures::Required;
            store
                .extend_room(RoomContents::of(&part(260..300), &features), others)
                .await
        }
    };
    for (features, word) in [
        (vec![of("f", 1.0, 260..300)], "drop_other_features"),
        (vec![of("h", 1.0, 260..300), both[0].clone()], "by name"),
    ] {
        let refused = extend(features).await.unwrap_err().to_string();
        assert!(refused.contains(word), "{refused}");
    }

    extend(both.to_vec()).await.unwrap();
    let back = store.load_room("a", None).await.unwrap();
    for (name, scale) in [("f", 1.0), ("g", 2.0)] {
        let expected = set(name, scale);
        assert_eq!(back.features(name).unwrap().rows(), expected.rows());
    }
}

/// Oracle: the promise: nobody's frames are lost when several add theirs at once.
#[tokio::test]
async fn frames_that_are_added_at_the_same_time_are_all_there() {
    let (_folder, store) = begun().await;
    let without_times = |rows: std::ops::Range<usize>| {
        let frames = Frames {
            poses: part(rows).poses().to_vec(),
            ..Frames::default()
        };
        Room::new(RoomId::new("c").unwrap(), frames, Provenance::default()).unwrap()
    };
    let known = [rows("f", 1.0, 0..100)];
    store
        .publish_room(&without_times(0..100), &known)
        .await
        .unwrap();

    let added = (0..4).map(|place| {
        let (store, first) = (store.clone(), 100 + 10 * place);
        let addition = without_times(first..first + 10);
        let features = [rows("f", 1.0, first..first + 10)];
        tokio::spawn(async move {
            store
                .extend_room(
                    RoomContents::of(&addition, &features),
                    OtherFeatures::Required,
                )
                .await
        })
    });
    for added in added.collect::<Vec<_>>() {
        added.await.unwrap().unwrap();
    }

    let back = store.load_room("c", None).await.unwrap();
    assert_eq!((back.revision, back.room.frame_count()), (5, 140));
    let mut sequences = back.room.frames().sequences.clone();
    sequences.dedup();
    assert_eq!(sequences, [0, 1, 2, 3, 4]);
}

/// Oracle: the contract: an upload that repeats a part of the room is refused, whichever part, and
/// names the first repeated row; nothing is stored twice.
#[tokio::test]
async fn an_overlap_is_refused() {
    let (_folder, store) = begun().await;
    for (range, repeated) in [(250..270, "row 0"), (255..262, "row 0")] {
        let features = [rows("f", 1.0, range.clone()), rows("g", 2.0, range.clone())];
        let addition = part(range);
        let contents = RoomContents::of(&addition, &features);
        let answer = store.extend_room(contents, OtherFeatures::Required).await;
        let Err(Error::CannotAdd { problem, .. }) = answer else {
            panic!("{answer:?}");
        };
        assert!(problem.to_string().contains(repeated), "{problem}");
    }

    // Other features at the same poses and times are other frames.
    let features = [rows("f", 3.0, 250..270), rows("g", 2.0, 250..270)];
    let addition = part(250..270);
    let contents = RoomContents::of(&addition, &features);
    store
        .extend_room(contents, OtherFeatures::Required)
        .await
        .unwrap();
    assert_eq!(
        store.load_room("a", None).await.unwrap().room.frame_count(),
        280
    );
}
