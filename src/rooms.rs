//! Options that name several rooms: names and patterns.

use anyhow::bail;

use seese3_core::features::Features;
use seese3_core::training::RoomData;
use seese3_store::{Store, StoredRoom};

/// The rooms that the given names and patterns select, each once, in the order given. The rooms of
/// one pattern are sorted by name.
pub async fn room_names(store: &Store, given: &[String]) -> anyhow::Result<Vec<String>> {
    // The store is listed only if there is a pattern to match.
    let known: Vec<String> = match given.iter().any(|name| name.contains('*')) {
        true => store
            .rooms()
            .await?
            .into_iter()
            .map(|room| room.room)
            .collect(),
        false => Vec::new(),
    };

    let mut names: Vec<String> = Vec::new();
    for pattern in given {
        let meant: Vec<String> = match pattern.contains('*') {
            true => known
                .iter()
                .filter(|name| matches(pattern, name))
                .cloned()
                .collect(),
            false => vec![pattern.clone()],
        };

        // A pattern without a match is more likely a typo than an empty set.
        if meant.is_empty() {
            bail!("no room in the store matches '{pattern}'");
        }

        for name in meant {
            if !names.contains(&name) {
                names.push(name);
            }
        }
    }

    Ok(names)
}

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

/// Whether a name matches a pattern. `*` matches any characters, including none.
fn matches(pattern: &str, name: &str) -> bool {
    match pattern.split_once('*') {
        None => pattern == name,
        Some((before, after)) => name.strip_prefix(before).is_some_and(|rest| {
            // Try every length of the star's text; the rest of the name has to match the rest of
            // the pattern.
            rest.char_indices()
                .map(|(at, _)| at)
                .chain([rest.len()])
                .any(|at| matches(after, &rest[at..]))
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::matches;

    /// Oracle: by hand, as a shell matches.
    #[test]
    fn patterns_match_as_in_a_shell() {
        for (pattern, name, expected) in [
            ("a*", "abc", true),
            ("*c", "abc", true),
            ("a*b*c", "axxbyyc", true),
            ("a*b*c", "axxcyyb", false),
            ("*", "", true),
            ("abc", "abcd", false),
            ("ä*", "äö", true),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }
}
