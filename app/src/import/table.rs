//! Tables of keys, and the config that they make.

use std::fmt::{Display, Write};

use super::yaml::At;
use flotilla::config::Problem;
use flotilla::escape;

/// The translation of a key.
pub(super) enum To {
    /// The same value under another name.
    Key(&'static str),
    /// The same, and the key is required.
    Need(&'static str),
    /// A list under another name. Earlier versions of the programs have a number.
    List(&'static str),
    /// One of some words under another name, each with ours, and the word if the key is missing.
    Word(&'static str, &'static str, &'static [(&'static str, &'static str)]),
    /// With this value, the same happens here without a key. There is no equivalent of other values, for a reason.
    Only(&'static str, &'static str),
    /// No equivalent, for a reason.
    Nothing(&'static str),
    /// Rust code reads it, or these keys below it, with spaces between them.
    Code(&'static str),
}

/// A key of the authors' program, as a dotted path, and what becomes of it and all keys below it.
pub(super) type Row = (&'static str, To);

/// A line of a config. One without `text` is a comment about a key without an exact equivalent.
pub(super) struct Line {
    pub text: String,
    /// The line of the YAML file, 0 if none.
    pub line: usize,
    /// The key in the YAML file.
    pub path: String,
    pub comment: String,
}

/// A section of a config.
pub(super) struct Section {
    /// The heading with brackets.
    pub head: &'static str,
    pub lines: Vec<Line>,
}

impl Section {
    pub fn new(head: &'static str) -> Section {
        Section { head, lines: vec![] }
    }

    fn add(&mut self, text: String, at: Option<&At<'_>>, comment: String) {
        let (line, path) = at.map_or((0, String::new()), |at| (at.line(), at.path.clone()));
        self.lines.push(Line { text, line, path, comment });
    }

    /// Adds a key that the YAML file does not have.
    pub fn set(&mut self, key: &str, value: impl Display, comment: &str) {
        self.add(format!("{key} = {value}"), None, comment.into());
    }

    /// Adds a key with a value that follows from another key.
    pub fn derive(&mut self, key: &str, value: impl Display, from: &At<'_>, comment: &str) {
        self.add(format!("{key} = {value}"), Some(from), comment.into());
    }

    /// Adds a key with the value of another. If two keys of the YAML file have one name here, the first counts.
    pub fn put(&mut self, key: &str, value: impl Display, at: &At<'_>) {
        let start = format!("{key} = ");
        match self.lines.iter().find(|line| line.text.starts_with(&start)).map(|line| line.path.clone()) {
            Some(first) => self.skip(at, &format!("{first} has the same meaning, and counts")),
            None => self.add(format!("{start}{value}"), Some(at), at.path.clone()),
        }
    }

    /// Adds comments about a key without an exact equivalent, and about all keys below it.
    pub fn skip(&mut self, at: &At<'_>, why: &str) {
        for at in at.leaves() {
            self.add(String::new(), Some(&at), format!("no exact equivalent: {} = {}: {why}", at.path, at.shown()));
        }
    }

    /// Adds the keys of a table.
    pub fn fill(&mut self, from: &At<'_>, rows: &[Row]) -> Result<(), Problem> {
        for (path, to) in rows {
            let found = from.get(path);
            match to {
                To::Need(key) => self.put(key, from.need(path)?.value()?, &from.need(path)?),
                To::Word(key, default, words) => match &found {
                    Some(at) => self.put(key, quoted(from.word(path, default, words)?), at),
                    None => self.set(key, quoted(from.word(path, default, words)?), "by default"),
                },
                To::Key(key) => {
                    if let Some(at) = found {
                        self.put(key, at.value()?, &at);
                    }
                }
                To::List(key) => match &found {
                    Some(at) if at.items().is_err() => self.put(key, format!("[{}]", at.value()?), at),
                    Some(at) => self.put(key, at.value()?, at),
                    None => {}
                },
                To::Only(value, why) => {
                    // Two spellings of a number are the same value.
                    let plain = |text: &str| text.parse::<f64>().map_or(text.to_string(), |number| number.to_string());
                    found
                        .iter()
                        .filter(|at| plain(at.shown().trim_matches(['"', ','])) != plain(value))
                        .for_each(|at| self.skip(at, why));
                }
                To::Nothing(why) => found.iter().for_each(|at| self.skip(at, why)),
                To::Code(_) => {}
            }
        }
        Ok(())
    }

    /// Adds comments about the keys that no table has.
    pub fn skip_unknown(&mut self, from: &At<'_>, tables: &[&[Row]]) {
        for leaf in from.leaves().into_iter().filter(|leaf| !leaf.is_null()) {
            let path = leaf.path[from.path.len()..].trim_start_matches('.');
            let ends = |rest: &str| rest.is_empty() || rest.starts_with(['.', '[']);
            let is_known = |(row, to): &Row| match (path.strip_prefix(row).filter(|rest| ends(rest)), to) {
                (Some(rest), To::Code(keys)) if !keys.is_empty() => {
                    let rest = rest.trim_start_matches('.');
                    rest.is_empty() || keys.split_whitespace().any(|key| rest.strip_prefix(key).is_some_and(ends))
                }
                (found, _) => found.is_some(),
            };
            if !tables.iter().flat_map(|rows| rows.iter()).any(is_known) {
                self.skip(&leaf, "unknown");
            }
        }
    }
}

/// Returns a word as TOML.
pub(super) fn quoted(word: &str) -> toml::Value {
    word.into()
}

/// Returns the config as text, and for each of its lines the line of the YAML file, or 0, and its key.
pub(super) fn write(heading: &str, sections: &[Section]) -> (String, Vec<(usize, String)>) {
    let mut text = heading.to_string();
    let mut origins = vec![(0, String::new()); text.lines().count()];
    for Section { head, lines } in sections.iter().filter(|section| !section.lines.is_empty()) {
        let _ = writeln!(text, "\n{head}");
        origins.resize(origins.len() + 2, (0, String::new()));
        for Line { text: key, line, path, comment } in lines {
            let place = if *line == 0 { String::new() } else { format!(" (line {line})") };
            let comment = format!("{comment}{place}");
            // TOML allows no control characters in comments.
            let comment = escape::line(&comment);
            let added = match (key.is_empty(), key.contains('\n')) {
                (false, false) if comment.is_empty() => format!("{key}\n"),
                (true, _) => format!("# {comment}\n"),
                (_, true) => format!("# {comment}\n{key}\n"),
                (_, false) => format!("{key:<32} # {comment}\n"),
            };
            origins.resize(origins.len() + added.lines().count(), (*line, path.clone()));
            text += &added;
        }
    }
    (text, origins)
}
