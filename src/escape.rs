//! Escaping of names and values for one line of text: nothing in them may end the line or control a terminal.
//!
//! Pictures and pages escape for themselves, tables by the `csv` crate.

use std::borrow::Cow;
use std::path::Path;

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

/// Paths as text in which different paths look different.
pub trait PathExt {
    /// Returns the path as text, with every byte that is not UTF-8 as `\xff`.
    fn escaped(&self) -> String;
}

impl PathExt for Path {
    fn escaped(&self) -> String {
        let chunks = self.as_os_str().as_encoded_bytes().utf8_chunks();
        chunks.map(|chunk| format!("{}{}", chunk.valid(), chunk.invalid().escape_ascii())).collect()
    }
}

/// Returns a text as a cell of a CSV file. Spreadsheets run a text that starts with `=`, `+`, `-` or `@` as a formula,
/// so an apostrophe precedes it. Numbers stay numbers.
pub fn csv_cell(text: &str) -> Cow<'_, str> {
    match text.starts_with(['=', '+', '-', '@', '\t', '\r']) && text.parse::<f64>().is_err() {
        true => format!("'{text}").into(),
        false => text.into(),
    }
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

    #[test]
    fn a_cell_is_a_number_or_a_text_and_never_a_formula() {
        for text in ["-0.5", "+1e3", "-inf", "NaN", "0.5", "G", "a=b", "", "world.coupling 3"] {
            assert_eq!(csv_cell(text), text);
        }
        for text in ["=1+1", "+cmd", "-y", "@sum", "-0.5-", "\t=1", "-"] {
            assert_eq!(csv_cell(text), format!("'{text}"));
        }
    }

    #[cfg(unix)]
    #[test]
    fn different_paths_look_different() {
        use std::ffi::OsStr;
        use std::os::unix::ffi::OsStrExt;
        let text = |bytes: &[u8]| Path::new(OsStr::from_bytes(bytes)).escaped();
        assert_eq!(text(b"a\xff/\xfeb"), r"a\xff/\xfeb");
        assert_eq!(text("Zürich".as_bytes()), "Zürich");
    }
}
