//! A reader of TOML texts, key by key. Each request for a key states its allowed values, and one pass finds all
//! problems of the text with their lines.
//!
//! The requests also define the table of keys, see [`keys`]. The keys themselves are defined elsewhere.
//!
//! A module reads a key with a [`KeyRequest`], which states its [`Allowed`] values.

use std::collections::{BTreeMap, HashSet};
use std::ops::RangeInclusive;

use toml::Spanned;
use toml::de::{DeTable, DeValue, Error};

mod allowed;
mod request;

pub(crate) use allowed::Allowed;
pub use allowed::{Number, between};
pub(crate) use request::{KeyRequest, NumberOrPercentage, OneOrList};

/// Maximum number of problems listed per text.
pub(crate) const MAX_LISTED: usize = 50;
/// Maximum number of unknown keys for which similar keys are searched. A text with more is not a config.
const MAX_HINTS: usize = 256;

/// The description of one key: a row of `docs/reference/config.md` and a comment of every commented config.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Definition {
    /// Dotted: `world.dt`.
    pub name: &'static str,
    /// The unit, or an empty text.
    pub unit: &'static str,
    /// The kind of its value: `number`, `word`, `list of positions [x, y]`.
    pub kind: String,
    /// The allowed values. A bound that depends on another key is that key's name.
    pub range: String,
    /// The default as TOML, or none if the key is required.
    pub default: Option<String>,
    /// The meaning, without a full stop.
    pub meaning: &'static str,
    /// The section and the equation of the paper, or an empty text.
    pub paper: &'static str,
}

/// A key that is set from outside the config file.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Override {
    /// The dotted key: `learning.population`.
    pub key: String,
    /// The value as TOML.
    pub text: String,
    /// The name in errors: `--population`.
    pub name: String,
}

impl Override {
    /// Sets `key` to `value`, with `name` as its name in errors.
    pub fn new(key: impl Into<String>, value: impl Into<toml::Value>, name: impl Into<String>) -> Override {
        Override { key: key.into(), text: value.into().to_string(), name: name.into() }
    }

    /// Sets `key` to the value of a TOML text. Errors call it `name`.
    pub fn of_text(key: impl Into<String>, text: impl Into<String>, name: impl Into<String>) -> Override {
        Override { key: key.into(), text: text.into(), name: name.into() }
    }
}

/// One problem of a config.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// The line in the file, from 1, or none for an [`Override`].
    pub line: Option<usize>,
    /// The dotted key with its index in a list, `world.leaders[3][1]`, or the override's name. Empty for a syntax
    /// error.
    pub key: String,
    /// The value found and the values allowed.
    pub message: String,
}

/// The problems of a text by line, then those of [`Override`]s.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problems {
    /// The first [`MAX_LISTED`] problems.
    pub listed: Vec<Problem>,
    /// The number of further problems.
    pub unlisted: usize,
}

/// Sections of a text that its reader does not read.
#[derive(Clone, Copy, Debug, Default)]
pub struct OtherSections<'a> {
    /// Sections that are ignored.
    pub ignored: &'a [&'a str],
    /// Sections that make the text something else. They are reported alone.
    pub refused: &'a [&'a str],
    /// The message about such a text.
    pub message: &'a str,
}

/// A parsed text. A sweep reads all its points from one document, because parsing takes longer than reading.
#[derive(Clone)]
pub struct Document<'a> {
    text: &'a str,
    table: DeTable<'a>,
    errors: Vec<Error>,
    lines: LineNumbers,
}

impl<'a> Document<'a> {
    /// Parses a text. [`read`] reports its syntax errors.
    pub fn parse(text: &'a str) -> Document<'a> {
        work::add(text.len());
        let (table, errors) = DeTable::parse_recoverable(text);
        Document { text, table: table.into_inner(), errors, lines: LineNumbers::of(text) }
    }

    /// Returns the same document without some of its sections.
    pub fn without(mut self, sections: &[&str]) -> Document<'a> {
        sections.iter().for_each(|section| drop(self.table.remove(*section)));
        self
    }

    /// Returns the text that was parsed.
    pub fn text(&self) -> &'a str {
        self.text
    }

    /// Returns the top-level table.
    pub fn table(&self) -> &DeTable<'a> {
        &self.table
    }

    /// Returns the line numbers of the text.
    pub fn lines(&self) -> &LineNumbers {
        &self.lines
    }
}

/// Line numbers by offset. Looking one up takes logarithmic time, so that a text with many problems takes linear time.
#[derive(Clone, Debug)]
pub struct LineNumbers {
    /// The offset of every line break.
    breaks: Vec<usize>,
}

impl LineNumbers {
    /// Finds the lines of a text.
    pub fn of(text: &str) -> LineNumbers {
        LineNumbers { breaks: text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n').map(|(at, _)| at).collect() }
    }

    /// Returns the line of an offset, from 1.
    pub fn line(&self, offset: usize) -> usize {
        self.breaks.partition_point(|&at| at < offset) + 1
    }
}

/// Reads a text, with some keys set by overrides: `ask` requests every key. Also returns a note about each omitted
/// key whose default other keys do not allow.
///
/// # Errors
/// All problems of the text and the overrides.
pub(crate) fn read<T>(
    document: &Document<'_>,
    others: OtherSections<'_>,
    overrides: &[Override],
    ask: impl FnOnce(&mut Reader<'_>) -> T,
) -> Result<(T, Vec<String>), Problems> {
    let Document { text, table, errors, lines } = document;
    let mut reader = Reader::default();
    let other = if errors.is_empty() { None } else { other_language(text) };
    if let Some((start, language)) = other {
        let message = format!(
            "found {language}, allowed TOML: `key = value` below a [section]; `flotilla init` writes an example"
        );
        reader.report(Place::Offset(start), "", message);
    }
    for error in first_errors(errors, lines).filter(|_| other.is_none()) {
        let span = error.span().unwrap_or(0..0);
        let at = text.get(span.clone()).filter(|at| !at.trim().is_empty());
        // A missing comma is the usual mistake in a list of positions. The parser takes it for a word without quotes.
        let numbers = |at: &str| at.contains(' ') && at.split(' ').all(|word| word.parse::<f64>().is_ok());
        let message = match at {
            Some(at) if numbers(at) => format!("found `{}`, allowed numbers with a comma between them", shorten(at)),
            Some(at) => format!("{} (at `{}`)", error.message().trim().replace('\n', ", "), shorten(at)),
            None => error.message().trim().replace('\n', ", "),
        };
        reader.report(Place::Offset(span.start), "", message);
    }
    if reader.problems.is_empty() {
        let mut refused = table.keys().filter(|key| others.refused.contains(&key.get_ref().as_ref()));
        if let Some(section) = refused.next() {
            reader.report(Place::Offset(section.span().start), section.get_ref(), others.message.into());
        }
    }
    if reader.problems.is_empty() {
        reader.fill(table.clone(), text, others.ignored, overrides);
        let read = ask(&mut reader);
        reader.report_unknown();
        if reader.problems.is_empty() {
            return Ok((read, reader.notes));
        }
    }
    Err(reader.into_problems(lines))
}

/// Returns the result for an empty text, and the keys that `ask` requests, in order.
pub fn keys<T>(ask: impl FnOnce(&mut Reader<'_>) -> T) -> (T, Vec<Definition>) {
    let mut reader = Reader { table: Some(vec![]), ..Reader::default() };
    let read = ask(&mut reader);
    (read, reader.table.unwrap_or_default())
}

/// Returns the language of a text that is not TOML, with the offset of the first line that is not a comment.
fn other_language(text: &str) -> Option<(usize, &'static str)> {
    let mut start = 0;
    let lines = text.split_inclusive('\n').map(|line| {
        let at = start;
        start += line.len();
        (at, line.trim())
    });
    let (start, first) = lines.into_iter().find(|(_, line)| !line.is_empty() && !line.starts_with('#'))?;
    let is_name = |name: &str| name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"_-.".contains(&byte));
    let yaml = first == "---" || first.split_once(':').is_some_and(|(name, _)| !name.is_empty() && is_name(name));
    match first {
        _ if first.starts_with('{') => Some((start, "JSON")),
        _ if yaml => Some((start, "YAML")),
        _ => None,
    }
}

/// Returns the syntax errors that are not consequences of an earlier one: an error can invalidate the rest of its line,
/// and an unclosed list the rest of the file.
fn first_errors<'e>(errors: &'e [Error], lines: &'e LineNumbers) -> impl Iterator<Item = &'e Error> {
    let unclosed = errors.iter().any(|error| error.message().contains("unclosed array"));
    let in_list = |error: &Error| unclosed && error.message().contains("array");
    let end = errors.iter().position(in_list).map_or(errors.len(), |first| first + 1);
    let mut last = 0;
    errors[..end].iter().filter(move |error| {
        let line = lines.line(error.span().map_or(0, |span| span.start));
        let is_new = line > last;
        last = last.max(line);
        is_new
    })
}

/// The place of a value. The order of the variants is the order of problems.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    /// The offset in the file, in bytes.
    Offset(usize),
    /// An override.
    Outside,
}

/// A value with its name and place for errors.
struct Entry<'a> {
    value: Spanned<DeValue<'a>>,
    /// The text that contains the value's span.
    text: &'a str,
    outside: bool,
    /// The key with its index in a list, or the override's name.
    name: String,
}

impl Entry<'_> {
    fn place(&self) -> Place {
        if self.outside { Place::Outside } else { Place::Offset(self.value.span().start) }
    }

    fn found(&self) -> String {
        match self.value.get_ref() {
            DeValue::Array(items) => format!("a list of {}", items.len()),
            DeValue::Table(_) => "a table".into(),
            _ => shorten(self.text.get(self.value.span()).unwrap_or_default()),
        }
    }
}

/// Shortens a text from the file to a part of one line.
fn shorten(text: &str) -> String {
    let line = text.lines().next().unwrap_or_default();
    let end = line.char_indices().nth(40).map_or(line.len(), |(end, _)| end);
    let more = if end < text.len() { "…" } else { "" };
    line[..end].chars().map(|c| if c.is_control() { ' ' } else { c }).chain(more.chars()).collect()
}

/// The values of a file that were not requested yet, and the problems of those that were.
#[derive(Default)]
pub struct Reader<'a> {
    /// The values by dotted key.
    entries: BTreeMap<String, Entry<'a>>,
    /// The values outside any section.
    strays: Vec<Entry<'a>>,
    /// The start of each section.
    sections: BTreeMap<String, usize>,
    /// The requested keys, with the place and name of those in the text.
    known: BTreeMap<&'static str, Option<(Place, String)>>,
    /// The place, name and message of each problem.
    problems: Vec<(Place, String, String)>,
    /// Notes about keys that were left out.
    notes: Vec<String>,
    /// The definitions of the requested keys, if [`keys`] collects them.
    table: Option<Vec<Definition>>,
}

/// Declares a section of a config with the description of its keys. Each entry defines a field, its documentation, and
/// a function of the same name that requests the key from a [`Reader`].
///
/// An entry consists of the meaning without a full stop, the field, the unit, and the section of the paper. Unit and
/// section may be empty. A field without either has no function, because another module requests its key.
macro_rules! section {
    ($(#[$($about:tt)*])* $name:ident = $section:literal {
        $($(#[doc = $words:literal])+ $field:ident: $type:ty $(= $unit:tt, $paper:tt)?,)+
    }) => {
        $(#[$($about)*])*
        #[derive(Clone, Debug, PartialEq, serde::Serialize)]
        pub struct $name {
            $(
                $(#[doc = $words])+
                $(#[doc = concat!("\n\n`", $section, ".", stringify!($field), "`", section!(@source $unit, $paper), ".")])?
                pub $field: $type,
            )+
        }

        impl $name {
            $(section! { @key $section, $field { $($words),+ } $($unit, $paper)? })+
        }
    };
    (@key $section:tt, $field:ident { $($words:tt)+ }) => {};
    (@key $section:tt, $field:ident { $($words:tt)+ } $unit:tt, $paper:tt) => {
        fn $field<'r, 'a>(r: &'r mut $crate::reader::Reader<'a>) -> $crate::reader::KeyRequest<'r, 'a> {
            let meaning = const { concat!($($words)+).trim_ascii() };
            r.key(concat!($section, ".", stringify!($field)), $unit, meaning, $paper)
        }
    };
    (@source "", "") => { "" };
    (@source $unit:tt, "") => { concat!(", in ", $unit) };
    (@source "", $paper:tt) => { concat!("; Section ", $paper) };
    (@source $unit:tt, $paper:tt) => { concat!(", in ", $unit, "; Section ", $paper) };
}
pub(crate) use section;

impl<'a> Reader<'a> {
    fn fill(&mut self, document: DeTable<'a>, text: &'a str, ignored: &[&str], overrides: &'a [Override]) {
        for (section, value) in document {
            let start = section.span().start;
            let section = section.into_inner().into_owned();
            if ignored.contains(&section.as_str()) {
                continue;
            }
            let span = value.span();
            match value.into_inner() {
                DeValue::Table(table) => {
                    for (key, value) in table {
                        let name = format!("{section}.{}", key.into_inner());
                        self.entries.insert(name.clone(), Entry { value, text, outside: false, name });
                    }
                    self.sections.insert(section, start);
                }
                other => {
                    let value = Spanned::new(span, other);
                    self.strays.push(Entry { value, text, outside: false, name: section });
                }
            }
        }
        for Override { key, text, name } in overrides {
            let (value, errors) = DeValue::parse_recoverable(text);
            for error in errors {
                self.report(Place::Outside, name, format!("found {}: {}", shorten(text), error.message().trim()));
            }
            self.entries.insert(key.clone(), Entry { value, text, outside: true, name: name.clone() });
        }
    }

    fn take(&mut self, key: &'static str) -> Option<Entry<'a>> {
        let entry = self.entries.remove(key);
        self.known.insert(key, entry.as_ref().map(|entry| (entry.place(), entry.name.clone())));
        entry
    }

    /// Returns the number of problems found so far.
    pub(crate) fn error_count(&self) -> usize {
        self.problems.len()
    }

    /// Requests a key.
    pub fn key<'r>(
        &'r mut self,
        name: &'static str,
        unit: &'static str,
        meaning: &'static str,
        paper: &'static str,
    ) -> KeyRequest<'r, 'a> {
        KeyRequest { reader: self, name, unit, meaning, paper }
    }

    /// Returns a number, or its default without an entry.
    fn number<T: Number>(&mut self, key: &str, entry: Option<Entry<'_>>, allowed: Allowed<T>, default: T) -> T {
        if let Some(entry) = entry {
            return self.check(&entry, allowed);
        }
        let nearest = allowed.nearest(default);
        if nearest != default {
            self.notes.push(format!(
                "{key} is not set: {nearest} is used, because the default, {default}, is not in the range allowed here, \
                 {allowed}"
            ));
        }
        nearest
    }

    fn check<T: Number>(&mut self, entry: &Entry<'_>, allowed: Allowed<T>) -> T {
        let allows = match T::read(entry.value.get_ref()) {
            Some(Some(value)) if allowed.holds(value) => return value,
            Some(Some(value)) if allowed.is_too_small(value) => allowed.in_detail(),
            Some(_) => allowed.to_string(),
            None => format!("{}, {allowed}", T::KIND),
        };
        self.report(entry.place(), &entry.name, format!("found {}, allowed {allows}", entry.found()));
        allowed.high
    }

    /// Returns the items of a list. Reports another kind of value or another length.
    fn items(&mut self, entry: Entry<'a>, lengths: RangeInclusive<usize>, what: &str) -> Option<Vec<Entry<'a>>> {
        let found = entry.found();
        let (place, Entry { value, text, outside, name }) = (entry.place(), entry);
        match value.into_inner() {
            DeValue::Array(items) if lengths.contains(&items.len()) => {
                let named = |(index, value)| Entry { value, text, outside, name: format!("{name}[{index}]") };
                Some(items.into_iter().enumerate().map(named).collect())
            }
            _ => {
                let lengths = between(*lengths.start(), *lengths.end());
                self.report(place, &name, format!("found {found}, allowed a list of {lengths} {what}"));
                None
            }
        }
    }

    fn two(&mut self, entry: Entry<'a>, allowed: [Allowed<f64>; 2]) -> [f64; 2] {
        let most = allowed.map(|side| side.high);
        let Some(items) = self.items(entry, 2..=2, "numbers") else { return most };
        let mut values = most;
        for ((value, item), side) in values.iter_mut().zip(&items).zip(allowed) {
            *value = self.check(item, side);
        }
        values
    }

    fn numbers<T: Number>(&mut self, entry: Entry<'a>, counts: RangeInclusive<usize>, allowed: Allowed<T>) -> Vec<T> {
        let items = self.items(entry, counts, &format!("numbers, each {allowed}")).unwrap_or_default();
        items.iter().map(|item| self.check(item, allowed)).collect()
    }

    fn report(&mut self, place: Place, name: &str, message: String) {
        self.problems.push((place, name.to_string(), message));
    }

    /// Reports a problem with a requested key; if the key is missing, at the start of its section.
    pub(crate) fn report_key(&mut self, key: &'static str, message: String) {
        let section = || self.sections.get(section_of(key)).copied().unwrap_or(0);
        let known = self.known.get(key).cloned().flatten();
        let (place, name) = known.unwrap_or_else(|| (Place::Offset(section()), key.to_string()));
        self.report(place, &name, message);
    }

    /// Reports every key and section that was never requested.
    fn report_unknown(&mut self) {
        let known: Vec<&str> = self.known.keys().copied().collect();
        let mut sections: Vec<&str> = known.iter().map(|key| section_of(key)).collect();
        sections.dedup();
        let (mut hints, mut unknown) = (0, HashSet::new());
        let mut hint_for = |name: &str, known: &[&str]| {
            hints += 1;
            if hints > MAX_HINTS { String::new() } else { hint(name, known) }
        };
        for entry in std::mem::take(&mut self.strays) {
            let name = &entry.name;
            let message = if sections.contains(&name.as_str()) {
                format!("found {}, allowed a section [{name}]", entry.found())
            } else {
                format!("unknown key{}", hint_for(name, &known))
            };
            self.report(entry.place(), &shorten(name), message);
        }
        for (name, start) in std::mem::take(&mut self.sections) {
            if !sections.contains(&name.as_str()) {
                let message = format!("unknown section{}", hint_for(&name, &sections));
                self.report(Place::Offset(start), &shorten(&name), message);
                unknown.insert(name);
            }
        }
        for (key, entry) in std::mem::take(&mut self.entries) {
            if entry.outside || !unknown.contains(section_of(&key)) {
                self.report(entry.place(), &shorten(&entry.name), format!("unknown key{}", hint_for(&key, &known)));
            }
        }
    }

    fn into_problems(mut self, lines: &LineNumbers) -> Problems {
        self.problems.sort_by_key(|problem| problem.0);
        let unlisted = self.problems.len().saturating_sub(MAX_LISTED);
        let listed = self.problems.into_iter().take(MAX_LISTED).map(|(place, key, message)| {
            let line = match place {
                Place::Offset(offset) => Some(lines.line(offset)),
                Place::Outside => None,
            };
            Problem { line, key, message }
        });
        Problems { listed: listed.collect(), unlisted }
    }
}

/// Returns the section of a dotted key.
fn section_of(key: &str) -> &str {
    key.split_once('.').map_or(key, |(section, _)| section)
}

/// Returns `, did you mean …?` with the known name most similar to an unknown one, or the names of its section.
fn hint(name: &str, known: &[&str]) -> String {
    const LONGEST_NAME: usize = 64;
    let last = |key: &'_ str| key.rsplit('.').next().unwrap_or_default().to_lowercase();
    let leaf = last(name);
    let same_section = |key: &str| section_of(key) == section_of(name);
    let distance = |key: &str| (strsim::damerau_levenshtein(&last(key), &leaf), !same_section(key));
    let nearest = known.iter().filter(|_| name.len() <= LONGEST_NAME).min_by_key(|key| distance(key));
    if let Some(key) = nearest.filter(|key| distance(key).0 <= leaf.len() / 3) {
        // The same name may be in several sections.
        let equal =
            known.iter().filter(|other| **other == *key || distance(key).0 == 0 && distance(other) == distance(key));
        let names: Vec<String> = equal.map(|key| format!("`{key}`")).collect();
        return format!(", did you mean {}?", names.join(" or "));
    }
    let siblings: Vec<String> = known.iter().filter(|key| same_section(key)).map(|key| last(key)).collect();
    match siblings.is_empty() {
        true => String::new(),
        false => format!("; [{}] has {}", section_of(name), siblings.join(", ")),
    }
}

/// Counts the bytes given to the TOML parser, so that tests can bound the work independently of time.
#[doc(hidden)]
pub mod work {
    use std::cell::Cell;

    thread_local! {
        static PARSED: Cell<usize> = const { Cell::new(0) };
    }

    pub(super) fn add(bytes: usize) {
        PARSED.set(PARSED.get() + bytes);
    }

    /// Returns the bytes parsed by this thread since the last call. Only tests need it.
    pub fn take() -> usize {
        PARSED.take()
    }
}
