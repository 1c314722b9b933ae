//! Names and values on their way into a line of text: nothing in them may end the line or steer a terminal.
//!
//! Pictures escape in [`crate::report::scene`], pages in [`crate::report::replay`], tables by the `csv` crate.

use std::borrow::Cow;

/// Whether a character would leave its line, move a terminal's cursor or turn its text around.
pub fn steers(c: char) -> bool {
    c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// A text for one line: what steers is written as `\n`, `\u{1b}`.
pub fn line(text: &str) -> Cow<'_, str> {
    escaped(text, steers)
}

/// [`line()`] of a text of several lines, which may have tabs.
pub fn lines(text: &str) -> Cow<'_, str> {
    escaped(text, |c| steers(c) && !matches!(c, '\n' | '\t'))
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
    fn only_what_steers_is_escaped() {
        assert_eq!(line("Zürich — 4/4 'POIs' \\"), "Zürich — 4/4 'POIs' \\");
        assert_eq!(line("a\nb\t\u{1b}[31mred\u{9b}1m\r\u{202e}"), r"a\nb\t\u{1b}[31mred\u{9b}1m\r\u{202e}");
        assert_eq!(lines("a\nb\tc\u{7}"), "a\nb\tc\\u{7}");
    }
}
