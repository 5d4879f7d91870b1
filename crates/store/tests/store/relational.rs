//! Joined features, and adapters with a relational reader.

use seese3_core::features::Features;
use seese3_store::{Error, Store};
use seese3_testing::panorama::{Panorama, adapter};

/// Oracle: the features that were published, joined by hand; the readings of the adapter that was
/// published, bit by bit.
#[tokio::test]
async fn an_adapter_with_a_relational_reader_is_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let seen = Panorama::new("hall", 7, 40);
    let published = store.publish_room(&seen.room, &seen.features);
    published.await.unwrap();

    let swapped = Features::joined(&[&seen.features[1], &seen.features[0]]).unwrap();
    for (names, expected) in [
        ("coarse,fine", &seen.joined),
        ("coarse+fine", &seen.joined),
        ("fine,coarse", &swapped),
    ] {
        let (_, found) = store.load_room_with("hall", Some(names)).await.unwrap();
        assert_eq!(found.source(), expected.source(), "{names}");
        assert_eq!(found.rows(), expected.rows(), "{names}");
    }
    let missing = store.load_room_with("hall", Some("coarse,medium")).await;
    let problem = missing.unwrap_err();
    assert!(
        matches!(&problem, Error::UnknownFeatures { name, .. } if name == "medium"),
        "{problem}"
    );

    for is_calibrated in [false, true] {
        let (adapter, record) = adapter(is_calibrated);
        let published = store.publish_adapter("eyes", &adapter, &record, seen.joined.rows());
        assert_eq!(
            published.await.unwrap().revision,
            1 + u64::from(is_calibrated)
        );

        let loaded = store.load_adapter("eyes", None).await.unwrap();
        assert_eq!(loaded.record.relational, record.relational);
        assert_eq!(loaded.adapter.source(), seen.joined.source());

        let [before, after] = [&adapter, &*loaded.adapter].map(|adapter| {
            let reader = adapter.relational().unwrap();
            let cells = reader.cells(seen.joined.rows()).unwrap();
            (reader.error_scale(), reader.motions(&cells, 3, &cells))
        });
        assert_eq!(before, after);
        assert_eq!(after.0.is_some(), is_calibrated);
    }
}
