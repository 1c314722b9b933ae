//! Escaping of names and values for one line of text: nothing in them may end the line or control a terminal.
//!
//! Pictures escape in [`crate::report::scene`], pages in [`crate::report::replay`], tables by the `csv` crate.

use std::borrow::Cow;

/// Returns whether a character can end the line, control a terminal or reverse the text direction.
pub fn is_control(c: char) -> bool {
    c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Escapes a text for one line: control characters are written as `\n`, `\u{1b}`.
pub fn line(text: &str) -> Cow<'_, str> {
    escaped(text, is_control)
}

/// Escapes like [`line()`], but keeps line breaks and tabs.
pub fn lines(text: &str) -> Cow<'_, str> {
    escaped(text, |c| is_control(c) && !matches!(c, '\n' | '\t'))
}

fn escaped(text: &str, bad: impl Fn(char) -> bool + Copy) -> Cow<'_, str> {
    if !text.contains(bad) {
        return text.into();
    }
    let escape = |c: char| if bad(c) { c.escape_default().to_string() } else { c.to_string() };
    text.chars().map(escape).collect::<String>().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_control_characters_are_escaped() {
        assert_eq!(line("Zürich — 4/4 'POIs' \\"), "Zürich — 4/4 'POIs' \\");
        assert_eq!(line("a\nb\t\u{1b}[31mred\u{9b}1m\r\u{202e}"), r"a\nb\t\u{1b}[31mred\u{9b}1m\r\u{202e}");
        assert_eq!(lines("a\nb\tc\u{7}"), "a\nb\tc\\u{7}");
    }
}
