//! Natural sort order of names: `frame_2` before `frame_10`.

/// A part of a name: a run of digits or of other characters. Numbers sort before words.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Part {
    /// Compared by value: leading zeros do not count.
    Number(u128),
    Word(String),
}

/// Sorts by name, comparing numbers by value and other characters as text. Ties, such as `f2` and
/// `f002`, are sorted as text.
pub(super) fn sort_naturally<T>(items: &mut [T], name: impl Fn(&T) -> &str) {
    items.sort_by_cached_key(|item| (parts(name(item)), name(item).to_owned()));
}

fn parts(name: &str) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut rest = name;
    while let Some(first) = rest.chars().next() {
        let is_digit = first.is_ascii_digit();
        let end = rest
            .find(|c: char| c.is_ascii_digit() != is_digit)
            .unwrap_or(rest.len());
        let (part, after) = rest.split_at(end);

        // A number that does not fit into 128 bits is compared as a word.
        let number = is_digit.then(|| part.parse().ok()).flatten();
        parts.push(number.map_or_else(|| Part::Word(part.to_owned()), Part::Number));
        rest = after;
    }

    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand, as people count.
    #[test]
    fn two_comes_before_ten() {
        let mut names = [
            "f10.png", "f2.png", "f1b.png", "b/2", "a/10", "f002.png", "f1.png", "",
        ];
        sort_naturally(&mut names, |name| name);
        assert_eq!(
            names,
            [
                "", "a/10", "b/2", "f1.png", "f1b.png", "f002.png", "f2.png", "f10.png"
            ]
        );
    }
}
