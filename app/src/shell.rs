//! Command lines that a shell reads back as the same words.

use std::ffi::{OsStr, OsString};
use std::path::Path;

/// Quotes a word for a shell. Bytes that are not UTF-8 need `$'…'`, which bash, zsh and ksh read.
pub fn quoted(word: impl AsRef<OsStr>) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+%@".contains(c);
    match word.as_ref().to_str() {
        Some(word) if word.chars().all(plain) && !word.is_empty() => word.into(),
        Some(word) => format!("'{}'", word.replace('\'', r"'\''")),
        None => {
            let bytes = word.as_ref().as_encoded_bytes();
            let text: String = bytes
                .iter()
                .map(|&byte| match byte {
                    b'\'' | b'\\' => format!("\\{}", char::from(byte)),
                    b' '..=b'~' => char::from(byte).into(),
                    _ => format!("\\x{byte:02x}"),
                })
                .collect();
            format!("$'{text}'")
        }
    }
}

/// Joins words to a command line.
pub fn command(words: impl IntoIterator<Item = impl AsRef<OsStr>>) -> String {
    let words: Vec<String> = words.into_iter().map(quoted).collect();
    words.join(" ")
}

/// Returns a path as an argument. A name that starts with a hyphen would be read as a flag, so `./` precedes it.
pub fn argument(path: &Path) -> OsString {
    match path.as_os_str().as_encoded_bytes().first() {
        Some(b'-') => Path::new(".").join(path).into_os_string(),
        _ => path.as_os_str().into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_starts_with_a_hyphen_is_no_flag() {
        for (path, expected) in [("-y", "./-y"), ("--out", "./--out"), ("a-y", "a-y"), ("./-y", "./-y"), ("", "")] {
            assert_eq!(argument(Path::new(path)), expected);
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_shell_reads_any_word_back() {
        use std::os::unix::ffi::OsStrExt;
        for word in [&b"it's"[..], b"", b"a b", b"$HOME\\", b"\xff'\\a\n\xc3\xa91", b"\xff1"] {
            let word = OsStr::from_bytes(word);
            let script = format!("printf %s {}", quoted(word));
            let output = std::process::Command::new("bash").args(["-c", &script]).output().unwrap();
            assert_eq!(OsStr::from_bytes(&output.stdout), word);
        }
    }
}
