//! Text from a server, for terminals.

/// The text as one line without control characters, which could change what a terminal shows: ASCII
/// and Unicode controls, line breaks, and the marks that reverse the direction of text.
pub fn one_line(text: &str) -> String {
    let is_shown = |c: char| {
        let is_mark = matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
        !c.is_control() && !is_mark
    };
    text.chars()
        .map(|c| if is_shown(c) { c } else { ' ' })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: an escape sequence, a line break and a mark of direction become spaces.
    #[test]
    fn control_characters_become_spaces() {
        assert_eq!(
            one_line("a\u{1b}[31mb\nerror: c\u{202e}d"),
            "a [31mb error: c d"
        );
        assert_eq!(one_line("häß 部屋"), "häß 部屋");
    }
}
