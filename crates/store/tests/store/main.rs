//! The store: publishing, removal, verification, and processes that die in the middle.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

mod dying;
mod extension;
mod faults;
mod relational;
mod room_keypoints;
mod simulation;
mod store;
mod store_care;

/// The rooms of a store, each with the revision that its name means.
async fn current_rooms(store: &seese3_store::Store) -> Vec<(String, u64)> {
    let defaults = store.defaults().await.unwrap();
    store.current_rooms(&defaults).await.unwrap()
}
