//! Several rooms on the command line: names and patterns.

use anyhow::bail;

use crate::features::Features;
use crate::store::{Store, StoredRoom};
use crate::training::Lesson;

/// The rooms that names and patterns mean, in the order given, each once; a pattern's rooms by
/// name.
pub async fn room_names(store: &Store, given: &[String]) -> anyhow::Result<Vec<String>> {
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

        if meant.is_empty() {
            bail!("no room of the store is called like '{pattern}'");
        }

        for name in meant {
            if !names.contains(&name) {
                names.push(name);
            }
        }
    }

    Ok(names)
}

/// Loads rooms with one of their features, the same of each; the first room's only one, if none is
/// named.
pub async fn load_rooms(
    store: &Store,
    given: &[String],
    features: Option<&str>,
) -> anyhow::Result<Vec<(StoredRoom, Features)>> {
    let mut rooms: Vec<(StoredRoom, Features)> = Vec::new();
    for name in room_names(store, given).await? {
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

/// A loaded room as training takes it.
pub fn lesson((stored, features): &(StoredRoom, Features)) -> Lesson<'_> {
    Lesson {
        room: &stored.room,
        revision: stored.revision,
        features,
    }
}

/// Rooms in words.
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

/// Whether a name is what a pattern says; * stands for any characters.
fn matches(pattern: &str, name: &str) -> bool {
    match pattern.split_once('*') {
        None => pattern == name,
        Some((before, after)) => name.strip_prefix(before).is_some_and(|rest| {
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
