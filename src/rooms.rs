//! Loads the rooms that options name.

pub use super::room_names::room_names;
use seese3_core::features::Features;
use seese3_core::training::RoomData;
use seese3_store::{Store, StoredRoom};

/// Loads rooms with one feature set: the named one, else the only one of the first room.
pub async fn load_rooms(
    store: &Store,
    given: &[String],
    features: Option<&str>,
) -> anyhow::Result<Vec<(StoredRoom, Features)>> {
    let mut rooms: Vec<(StoredRoom, Features)> = Vec::new();
    for name in room_names(store, given).await? {
        // The other rooms are loaded with the feature set name of the first.
        let wanted = features.or_else(|| {
            rooms
                .first()
                .map(|(_, features)| features.source().name.as_str())
        });
        let loaded = store.load_room_with(&name, wanted).await?;
        rooms.push(loaded);
    }

    Ok(rooms)
}

/// A loaded room in the form that training takes.
pub fn data((stored, features): &(StoredRoom, Features)) -> RoomData<'_> {
    RoomData {
        room: &stored.room,
        revision: stored.revision,
        features,
    }
}

/// A short description of rooms for a line of output.
pub fn room_words(rooms: &[(StoredRoom, Features)]) -> String {
    let first = &rooms[0].0;
    match rooms {
        [_] => format!("room '{}' revision {}", first.room.id(), first.revision),
        _ => format!(
            "{} rooms, '{}' to '{}'",
            rooms.len(),
            first.room.id(),
            rooms[rooms.len() - 1].0.room.id()
        ),
    }
}
