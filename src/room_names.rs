//! Options that name several rooms: names and patterns.

use anyhow::bail;

use seese3_store::Store;

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
