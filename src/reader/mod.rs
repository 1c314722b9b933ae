//! A reader of configs, from TOML texts or from programs, key by key. Each request for a key states its allowed values,
//! and one pass finds all problems, with their lines if the config was written.
//!
//! The requests also define the table of keys, see [`keys`]. The keys themselves are defined elsewhere.
//!
//! A module reads a key with a [`KeyRequest`], which states its [`Allowed`] values.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Display;
use std::ops::RangeInclusive;

use toml::Spanned;
use toml::de::{DeTable, DeValue, Error};

mod allowed;
mod request;
mod value;

pub(crate) use allowed::{Allowed, Number, between, sized};
pub(crate) use request::KeyRequest;
pub use request::{CountOrPercentage, OneOrEach};
pub(crate) use value::Value;
use value::{Kind, shorten};

/// Maximum number of problems listed per text.
pub(crate) const MAX_LISTED: usize = 50;
/// Maximum number of unknown keys for which similar keys are searched. A text with more is not a config.
const MAX_HINTS: usize = 256;

/// Maximum number of names and indices in a key after the name of its list.
const MAX_PARTS: usize = 8;

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

/// A parsed text. A sweep reads all its points from one document, because parsing takes longer than reading.
#[derive(Clone)]
pub struct Document<'a> {
    text: &'a str,
    table: DeTable<'a>,
    /// The syntax errors in the text, by offset.
    errors: Vec<Error>,
    lines: LineNumbers,
}

impl<'a> Document<'a> {
    /// Parses a text. [`Config::read_noted`](crate::Config::read_noted) reports its syntax errors.
    pub fn parse(text: &'a str) -> Document<'a> {
        work::add(text.len());
        let (table, mut errors) = DeTable::parse_recoverable(text);
        errors.sort_by_key(start_of);
        Document { text, table: table.into_inner(), errors, lines: LineNumbers::of(text) }
    }

    /// Returns the same document without some of its sections.
    pub fn without(mut self, sections: &[&str]) -> Document<'a> {
        sections.iter().for_each(|section| drop(self.table.remove(*section)));
        self
    }

    /// Returns the top-level table.
    pub fn table(&self) -> &DeTable<'a> {
        &self.table
    }

    /// Returns a value of the table.
    pub(crate) fn value<'d>(&'d self, value: &Spanned<DeValue<'d>>) -> Value<'d> {
        Value::of_text(value.clone(), self.text)
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

/// Returns the result for an empty text, and the keys that `ask` requests, in order.
pub(crate) fn keys<T>(ask: impl FnOnce(&mut Reader<'_>) -> T) -> (T, Keys) {
    let mut reader = Reader { keys: Some(Keys::default()), ..Reader::default() };
    let read = ask(&mut reader);
    (read, reader.keys.unwrap_or_default())
}

/// The keys that a config can have.
#[derive(Default)]
pub(crate) struct Keys {
    /// The keys of sections.
    pub sections: Vec<Definition>,
    /// The keys of tables in lists and in other tables, by the dotted name of the list or table.
    pub tables: Vec<(&'static str, Vec<Definition>)>,
    /// The index of the table that is being read, if any.
    open: Option<usize>,
}

impl Keys {
    fn push(&mut self, key: Definition) {
        self.open.map_or(&mut self.sections, |table| &mut self.tables[table].1).push(key);
    }
}

/// The place of a value. The order of the variants is the order of problems.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    /// The offset in the file, in bytes.
    Offset(usize),
    /// An override, or a config that was not written.
    Outside,
}

/// A value with its name for errors.
struct Entry<'a> {
    value: Value<'a>,
    /// Whether it is an override.
    outside: bool,
    /// The key with its index in a list, or the override's name.
    name: String,
}

impl<'a> Entry<'a> {
    /// Returns the entry of a value in a list or table. Its name is its place there, or the override that set it.
    fn within(outside: bool, value: Value<'a>, place: impl FnOnce() -> String) -> Entry<'a> {
        let name = value.set_by.map_or_else(place, Into::into);
        Entry { outside: outside || value.set_by.is_some(), value, name }
    }

    fn place(&self) -> Place {
        self.value.written.filter(|_| !self.outside).map_or(Place::Outside, |(offset, _)| Place::Offset(offset))
    }
}

/// A table in a list or in another table, while its keys are requested.
#[derive(Clone)]
struct Scope {
    /// The name in errors: `agents[1].senses[0]`.
    name: String,
    place: Place,
}

/// The values of a config that were not requested yet, and the problems of those that were.
#[derive(Default)]
pub(crate) struct Reader<'a> {
    /// The lines of the text, if the config was written.
    lines: Option<&'a LineNumbers>,
    /// The values by dotted key. Values outside any section have a key without a dot.
    entries: BTreeMap<String, Entry<'a>>,
    /// The start of each section.
    sections: BTreeMap<String, usize>,
    /// The requested keys, with the place and name of those in the text.
    known: BTreeMap<&'static str, Option<(Place, String)>>,
    /// The place, name and message of each problem.
    problems: Vec<(Place, String, String)>,
    /// Notes about keys that were left out.
    notes: Vec<String>,
    /// The definitions of the requested keys, if [`keys`] collects them.
    keys: Option<Keys>,
    /// The table whose keys are requested, if they are not keys of a section.
    scope: Option<Scope>,
    /// Keys, or whole sections if they end with a dot, each with the list that replaces it in this config.
    replaced: Vec<(&'static str, &'static str)>,
    /// The number of unknown keys for which similar ones were searched.
    hints: usize,
}

/// Declares a section of a config with the description of its keys. Each entry defines a field, its documentation, and
/// a function of the same name that requests the key from a [`Reader`].
///
/// An entry consists of the meaning without a full stop, the field, the unit, and the section of the paper. Unit and
/// section may be empty.
macro_rules! section {
    ($(#[$($about:tt)*])* $name:ident = $section:literal {
        $($(#[doc = $words:literal])+ $field:ident: $type:ty = $unit:tt, $paper:tt,)+
    }) => {
        $(#[$($about)*])*
        #[derive(Clone, Debug, PartialEq, serde::Serialize)]
        pub struct $name {
            $(
                $(#[doc = $words])+
                #[doc = concat!("\n\n`", $section, ".", stringify!($field), "`", section!(@source $unit, $paper), ".")]
                pub $field: $type,
            )+
        }

        impl $name {
            /// The keys without their section, in order.
            #[allow(dead_code, reason = "only the keys of some sections are also those of tables")]
            pub(crate) const KEYS: &[&str] = &[$(stringify!($field)),+];
            $(section! { @key $section, $field { $($words),+ } $unit, $paper })+

            /// Returns the value of each dotted key.
            pub(crate) fn values(&self) -> Vec<(&'static str, $crate::reader::Value<'static>)> {
                vec![$((concat!($section, ".", stringify!($field)), $crate::reader::Value::of(&self.$field))),+]
            }
        }
    };
    (@key $section:tt, $field:ident $(as $key:literal)? { $($words:tt)+ } $unit:tt, $paper:tt) => {
        pub(crate) fn $field<'r, 'a>(r: &'r mut $crate::reader::Reader<'a>) -> $crate::reader::KeyRequest<'r, 'a> {
            let meaning = const { concat!($($words)+).trim_ascii() };
            r.key(concat!($section, ".", $crate::reader::section!(@leaf $field $($key)?)), $unit, meaning, $paper)
        }
    };
    (@leaf $field:ident) => { stringify!($field) };
    (@leaf $field:ident $key:literal) => { $key };
    (@source "", "") => { "" };
    (@source $unit:tt, "") => { concat!(", in ", $unit) };
    (@source "", $paper:tt) => { concat!("; Section ", $paper) };
    (@source $unit:tt, $paper:tt) => { concat!(", in ", $unit, "; Section ", $paper) };
}
pub(crate) use section;

/// Declares a table in a list or in another table, as [`section!`] declares a section. Its keys are requested within
/// [`KeyRequest::tables`] and the like. A field may have another name than its key, `field as "key"`.
macro_rules! table {
    ($(#[$($about:tt)*])* $name:ident = $table:literal {
        $(
            $(#[doc = $words:literal])+
            $(#[serde($($serde:tt)+)])?
            $field:ident $(as $key:literal)?: $type:ty = $unit:tt,
        )+
    }) => {
        $(#[$($about)*])*
        #[derive(Clone, Debug, PartialEq, serde::Serialize)]
        pub struct $name {
            $(
                $(#[doc = $words])+
                #[doc = concat!("\n\n`", $table, ".", $crate::reader::section!(@leaf $field $($key)?), "`", $crate::reader::section!(@source $unit, ""), ".")]
                $(#[serde($($serde)+)])?
                $(#[serde(rename = $key)])?
                pub $field: $type,
            )+
        }

        impl $name {
            /// The keys, in order.
            pub(crate) const KEYS: &[&str] = &[$($crate::reader::section!(@leaf $field $($key)?)),+];
            $($crate::reader::section! { @key $table, $field $(as $key)? { $($words),+ } $unit, "" })+
        }
    };
}
pub(crate) use table;

impl<'a> Reader<'a> {
    /// Reads a text without its `ignored` sections. A section in `refused` makes the text something else, which `message`
    /// describes.
    ///
    /// # Errors
    /// The text is not TOML, or has a refused section, which is reported alone.
    pub fn of_text(
        document: &'a Document<'a>,
        ignored: &[&str],
        refused: &[&str],
        message: &str,
    ) -> Result<Reader<'a>, Vec<Problem>> {
        let Document { text, table, errors, lines } = document;
        let mut reader = Reader { lines: Some(lines), ..Reader::default() };
        // Other errors follow from these: one can invalidate the rest of its line, and an unclosed list the rest of the
        // file.
        let unclosed = errors.iter().any(|error| error.message().contains("unclosed array"));
        let in_list = |error: &Error| unclosed && error.message().contains("array");
        let end = errors.iter().position(in_list).map_or(errors.len(), |at| at + 1);
        let other = if errors.is_empty() { None } else { other_language(text) };
        if let Some((start, language)) = other {
            let message = format!(
                "found {language}, allowed TOML: `key = value` below a [section]; `flotilla init` writes an example"
            );
            reader.report(Place::Offset(start), "", message);
        } else {
            for errors in errors[..end].chunk_by(|a, b| lines.line(start_of(a)) == lines.line(start_of(b))) {
                reader.report(Place::Offset(start_of(&errors[0])), "", syntax_problem(&errors[0], text));
            }
        }
        let mut refused = table.keys().filter(|key| refused.contains(&key.get_ref().as_ref()));
        if let (true, Some(section)) = (errors.is_empty(), refused.next()) {
            reader.report(Place::Offset(section.span().start), section.get_ref(), message.into());
        }
        if !reader.problems.is_empty() {
            return Err(reader.into_problems());
        }
        for (section, value) in table.iter().filter(|(section, _)| !ignored.contains(&section.get_ref().as_ref())) {
            let (name, start) = (section.get_ref().to_string(), section.span().start);
            if let DeValue::Table(table) = value.get_ref() {
                for (key, value) in table {
                    reader.insert(format!("{name}.{}", key.get_ref()), Value::of_text(value.clone(), text));
                }
                reader.sections.insert(name, start);
            } else {
                let entry = Entry { value: Value::of_text(value.clone(), text), outside: false, name };
                reader.entries.insert(stray_key(&entry.name), entry);
            }
        }
        Ok(reader)
    }

    /// Reads values by dotted key.
    pub fn of_values(values: impl IntoIterator<Item = (&'static str, Value<'a>)>) -> Reader<'a> {
        let mut reader = Reader::default();
        values.into_iter().for_each(|(key, value)| reader.insert(key.into(), value));
        reader
    }

    fn insert(&mut self, name: String, value: Value<'a>) {
        self.entries.insert(name.clone(), Entry { value, outside: false, name });
    }

    /// Sets a key. Errors call it `name`.
    pub fn set(&mut self, key: &str, value: Value<'a>, name: String) {
        self.entries.insert(key.into(), Entry { value, outside: true, name });
    }

    /// Sets some keys. A key of a table in one of `lists` contains the name or the index of the table:
    /// `agents.uav.senses[2].range`.
    pub fn set_all(&mut self, overrides: &'a [Override], lists: &[&str]) {
        for Override { key, text, name } in overrides {
            let (value, errors) = DeValue::parse_recoverable(text);
            if let Some(error) = errors.first() {
                self.report(Place::Outside, name, format!("found {}: {}", shorten(text), error.message().trim()));
            }
            self.set_within(key, Value::of_text(value, text), name, lists);
        }
    }

    /// Sets a key, as [`Reader::set_all`] does.
    pub fn set_within(&mut self, key: &str, value: Value<'a>, name: &'a str, lists: &[&str]) {
        let path: Vec<&str> = key_path(key).collect();
        match &path[..] {
            [list, path @ ..] if !path.is_empty() && lists.contains(list) => {
                let set = match self.entries.get_mut(*list) {
                    // Otherwise a long key would nest tables until the stack overflows.
                    _ if path.len() > MAX_PARTS => {
                        Err(format!("found {} parts after `{list}`, allowed up to {MAX_PARTS}", path.len()))
                    }
                    Some(entry) => entry.value.set(path, Value { set_by: Some(name), ..value }),
                    None => Err(format!("found a config without [[{list}]]; `flotilla check --expand` writes them")),
                };
                set.unwrap_or_else(|message| self.report(Place::Outside, name, message));
            }
            _ => self.set(key, value, name.into()),
        }
    }

    /// Requests every key with `ask`. Also returns a note about each omitted key whose default other keys do not allow.
    ///
    /// # Errors
    /// All problems of the values.
    pub fn read<T>(mut self, ask: impl FnOnce(&mut Reader<'_>) -> T) -> Result<(T, Vec<String>), Vec<Problem>> {
        let read = ask(&mut self);
        self.report_unknown();
        if self.problems.is_empty() { Ok((read, self.notes)) } else { Err(self.into_problems()) }
    }

    fn take(&mut self, key: &'static str) -> Option<Entry<'a>> {
        let entry = self.entries.remove(key);
        self.known.insert(key, entry.as_ref().map(|entry| (entry.place(), entry.name.clone())));
        let entry = entry?;
        match self.replaced.iter().find(|(replaced, _)| self.scope.is_none() && includes(replaced, key)) {
            Some((_, list)) => {
                let message = match entry.outside {
                    true => {
                        format!("a config with [[{list}]] has no such key; set keys of its tables: {list}.NAME.KEY")
                    }
                    false => format!(
                        "found in a config with [[{list}]], which replaces this key: remove one of the two; without \
                         [[{list}]], `flotilla check --expand` writes it from the other keys"
                    ),
                };
                self.report(entry.place(), &entry.name, message);
                None
            }
            None => Some(entry),
        }
    }

    /// Makes each key an error, or of each section whose name ends with a dot, because the config has a list in its
    /// place. Does nothing if it has no such list. Returns whether it has.
    pub(crate) fn replace(&mut self, list: &'static str, keys: &[&'static str]) -> bool {
        let has = self.sections.contains_key(list) || self.entries.contains_key(list);
        if has {
            self.replaced.extend(keys.iter().map(|key| (*key, list)));
        }
        has
    }

    /// Returns the items of a list of the config without requesting it, or none if it is no list.
    pub(crate) fn peek(&self, list: &str) -> &[Value<'a>] {
        self.entries.get(list).and_then(|entry| entry.value.list()).unwrap_or_default()
    }

    /// Reads a list of tables of the config, `[[list]]`, if it has one. `read` gets the index of each table.
    pub(crate) fn tables<T>(
        &mut self,
        list: &'static str,
        counts: RangeInclusive<usize>,
        read: impl FnMut(&mut Reader<'a>, usize) -> T,
    ) -> Vec<T> {
        let entry = self.entries.remove(list);
        self.known.insert(list, entry.as_ref().map(|entry| (entry.place(), entry.name.clone())));
        if let Some(start) = self.sections.remove(list) {
            self.entries.retain(|key, _| section_of(key) != list);
            self.report(Place::Offset(start), list, format!("found a section, allowed tables [[{list}]]"));
        }
        self.tables_of(list, entry, counts, &format!("tables [[{list}]]"), read)
    }

    fn tables_of<T>(
        &mut self,
        list: &'static str,
        entry: Option<Entry<'a>>,
        counts: RangeInclusive<usize>,
        what: &str,
        mut read: impl FnMut(&mut Reader<'a>, usize) -> T,
    ) -> Vec<T> {
        if self.keys.is_some() {
            self.within([list; 2], None, |r| read(r, 0));
        }
        let items = entry.and_then(|entry| self.items(entry, counts, what)).unwrap_or_default();
        let tables = items.into_iter().enumerate();
        tables.filter_map(|(index, item)| self.within([list; 2], Some(item), |r| read(r, index))).collect()
    }

    /// Requests the keys of a table with `read`, as keys of the section `table`. Without an entry, requests them to
    /// collect their definitions. `key` is the name of the table in these.
    fn within<T>(
        &mut self,
        [key, table]: [&'static str; 2],
        entry: Option<Entry<'a>>,
        read: impl FnOnce(&mut Reader<'a>) -> T,
    ) -> Option<T> {
        let place = entry.as_ref().map_or(Place::Outside, Entry::place);
        let (name, outside) = entry.as_ref().map_or((table.into(), false), |entry| (entry.name.clone(), entry.outside));
        let items = match entry.map(|entry| entry.value) {
            None => vec![],
            Some(Value { kind: Kind::Table(items), .. }) => items,
            Some(value) => {
                self.report(place, &name, format!("found {}, allowed a table", value.found()));
                return None;
            }
        };
        let named = |(key, value): (String, Value<'a>)| {
            (format!("{table}.{key}"), Entry::within(outside, value, || format!("{name}.{key}")))
        };
        let entries = std::mem::replace(&mut self.entries, items.into_iter().map(named).collect());
        let known = std::mem::take(&mut self.known);
        let scope = self.scope.replace(Scope { name, place });
        let open = self.keys.as_mut().map(|keys| {
            keys.tables.push((key, vec![]));
            keys.open.replace(keys.tables.len() - 1)
        });
        let read = read(self);
        if let (Some(keys), Some(open)) = (&mut self.keys, open) {
            keys.open = open;
        }
        let known = std::mem::replace(&mut self.known, known);
        for (key, entry) in std::mem::replace(&mut self.entries, entries) {
            let known: Vec<&str> = known.keys().copied().collect();
            let hint = self.hint(&key, &known, true);
            self.report(entry.place(), &shorten(&entry.name), format!("unknown key{hint}"));
        }
        self.scope = scope;
        Some(read)
    }

    /// Returns the name of a key in errors, with the index of its table in a list.
    fn name_of(&self, key: &str) -> String {
        let leaf = key.rsplit('.').next().unwrap_or_default();
        self.scope.as_ref().map_or_else(|| key.into(), |scope| format!("{}.{leaf}", scope.name))
    }

    /// Reports whether a requested key is in the config.
    pub(crate) fn has(&self, key: &str) -> bool {
        self.known.get(key).is_some_and(Option::is_some)
    }

    /// Returns the hint for an unknown key, unless there were many before. In a table of a list, names are given without
    /// their section.
    fn hint(&mut self, name: &str, known: &[&str], in_table: bool) -> String {
        self.hints += 1;
        if self.hints > MAX_HINTS { String::new() } else { hint(name, known, in_table) }
    }

    /// Reports a problem with the table whose keys are requested.
    pub(crate) fn report_table(&mut self, message: String) {
        if let Some(Scope { name, place }) = &self.scope {
            let (name, place) = (name.clone(), *place);
            self.report(place, &name, message);
        }
    }

    /// Returns the number of problems found so far.
    pub(crate) fn error_count(&self) -> usize {
        self.problems.len()
    }

    /// Requests a key.
    pub(crate) fn key<'r>(
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
            let key = self.name_of(key);
            self.notes.push(format!(
                "{key} is not set: {nearest} is used, because the default, {default}, is not in the range allowed here, \
                 {allowed}"
            ));
        }
        nearest
    }

    fn check<T: Number>(&mut self, entry: &Entry<'_>, allowed: Allowed<T>) -> T {
        let allows = match T::read(&entry.value) {
            Some(Some(value)) if allowed.holds(value) => return value,
            Some(Some(value)) if allowed.is_too_small(value) => allowed.in_detail(),
            Some(_) => allowed.to_string(),
            None => format!("{}, {allowed}", T::KIND),
        };
        self.report_found(entry, allows);
        allowed.high
    }

    /// Returns the items of a list. Reports another kind of value or another length.
    fn items(&mut self, entry: Entry<'a>, lengths: RangeInclusive<usize>, what: &str) -> Option<Vec<Entry<'a>>> {
        match entry {
            Entry { value: Value { kind: Kind::List(items), .. }, outside, name } if lengths.contains(&items.len()) => {
                let named = |(index, value)| Entry::within(outside, value, || format!("{name}[{index}]"));
                Some(items.into_iter().enumerate().map(named).collect())
            }
            _ => {
                let lengths = match (lengths.start(), lengths.end()) {
                    (least, &usize::MAX) => format!("{least} or more"),
                    (&least, &most) => between(least, most).to_string(),
                };
                self.report_found(&entry, format_args!("a list of {lengths} {what}"));
                None
            }
        }
    }

    fn tuple<const N: usize>(&mut self, entry: Entry<'a>, allowed: [Allowed<f64>; N]) -> [f64; N] {
        let most = allowed.map(|side| side.high);
        let Some(items) = self.items(entry, N..=N, "numbers") else { return most };
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

    /// Reports a value that is not among the `allowed` ones.
    fn report_found(&mut self, entry: &Entry<'_>, allowed: impl Display) {
        self.report(entry.place(), &entry.name, format!("found {}, allowed {allowed}", entry.value.found()));
    }

    /// Reports a problem with a requested key; if the key is missing, at the start of its section.
    pub(crate) fn report_key(&mut self, key: &'static str, message: String) {
        let start = || Place::Offset(self.sections.get(section_of(key)).copied().unwrap_or(0));
        let start = || self.scope.as_ref().map_or_else(start, |scope| scope.place);
        let known = self.known.get(key).cloned().flatten();
        let (place, name) = known.unwrap_or_else(|| (start(), self.name_of(key)));
        self.report(place, &name, message);
    }

    /// Reports every key and section that was never requested.
    fn report_unknown(&mut self) {
        let known: Vec<&str> = self.known.keys().copied().collect();
        let mut sections: Vec<&str> = known.iter().map(|key| section_of(key)).collect();
        sections.dedup();
        let mut unknown = HashSet::new();
        for (name, start) in std::mem::take(&mut self.sections) {
            if !sections.contains(&name.as_str()) {
                let message = format!("unknown section{}", self.hint(&name, &sections, false));
                self.report(Place::Offset(start), &shorten(&name), message);
                unknown.insert(name);
            }
        }
        for (key, entry) in std::mem::take(&mut self.entries) {
            if !entry.outside && sections.contains(&&*key) {
                self.report_found(&entry, format!("a section [{key}]"));
            } else if entry.outside || !unknown.contains(section_of(&key)) {
                let hint = self.hint(key.trim_matches('"'), &known, false);
                self.report(entry.place(), &shorten(&entry.name), format!("unknown key{hint}"));
            }
        }
    }

    /// Returns the problems of a text by line, then those of [`Override`]s.
    fn into_problems(mut self) -> Vec<Problem> {
        self.problems.sort_by_key(|problem| problem.0);
        let problems = self.problems.into_iter().map(|(place, key, message)| {
            let line = match place {
                Place::Offset(offset) => self.lines.map(|lines| lines.line(offset)),
                Place::Outside => None,
            };
            Problem { line, key, message }
        });
        problems.collect()
    }
}

/// Returns the offset of a syntax error.
fn start_of(error: &Error) -> usize {
    error.span().map_or(0, |span| span.start)
}

/// Returns the language of a text that looks like YAML or JSON, with the offset of its first line but for comments.
/// Configs of other programs in the field are YAML.
fn other_language(text: &str) -> Option<(usize, &'static str)> {
    let lines = text.lines().map(|line| (line.as_ptr() as usize - text.as_ptr() as usize, line.trim()));
    let (start, first) = lines.into_iter().find(|(_, line)| !line.is_empty() && !line.starts_with('#'))?;
    let is_name = |name: &str| name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"_-.".contains(&byte));
    match first.split_once(':') {
        _ if first.starts_with('{') => Some((start, "JSON")),
        Some((name, _)) if !name.is_empty() && is_name(name) => Some((start, "YAML")),
        _ => (first == "---").then_some((start, "YAML")),
    }
}

/// Returns the message of a syntax error in one line.
fn syntax_problem(error: &Error, text: &str) -> String {
    let message = error.message().trim().replace('\n', ", ");
    let at = text.get(error.span().unwrap_or(0..0)).filter(|at| !at.trim().is_empty());
    // A missing comma is the usual mistake in a list of positions. The parser takes it for a word without quotes.
    let is_numbers = |at: &str| at.contains(' ') && at.split(' ').all(|word| word.parse::<f64>().is_ok());
    match at {
        Some(list @ ("agents" | "pois" | "stages")) if message == "duplicate key" => {
            format!("found a further section [{list}], allowed tables [[{list}]]")
        }
        Some(at) if is_numbers(at) => format!("found `{}`, allowed numbers with a comma between them", shorten(at)),
        Some(at) if message.starts_with("string values must be quoted") => {
            let number = at.split(' ').next().is_some_and(|word| word.parse::<f64>().is_ok());
            let allowed =
                if number { "a number without a unit".into() } else { format!("\"{}\", in quotes", shorten(at)) };
            format!("found `{}`, allowed {allowed}", shorten(at))
        }
        Some(at) => format!("{message} (at `{}`)", shorten(at)),
        None => message,
    }
}

/// Splits a key at its dots and around its indices: `agents.uav.senses[2].range`.
pub fn key_path(key: &str) -> impl Iterator<Item = &str> {
    key.split(['.', '[']).map(|part| part.trim_end_matches(']'))
}

/// Returns the key of a value outside any section. A name with dots stays in quotes, because it is not a key of a section.
fn stray_key(name: &str) -> String {
    if name.contains('.') { format!("\"{name}\"") } else { name.into() }
}

/// Returns the section of a dotted key.
pub(crate) fn section_of(key: &str) -> &str {
    key.split_once('.').map_or(key, |(section, _)| section)
}

/// Reports whether a key is `name`, or in the section `name` if that ends with a dot.
pub(crate) fn includes(name: &str, key: &str) -> bool {
    key == name || name.ends_with('.') && key.starts_with(name)
}

/// Returns `, did you mean …?` with the known name most similar to an unknown one, or the names of its section or table.
fn hint(name: &str, known: &[&str], in_table: bool) -> String {
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
        let shown = |key: &str| if in_table { last(key) } else { key.into() };
        let names: Vec<String> = equal.map(|key| format!("`{}`", shown(key))).collect();
        return format!(", did you mean {}?", names.join(" or "));
    }
    let siblings: Vec<String> = known.iter().filter(|key| same_section(key)).map(|key| last(key)).collect();
    match siblings.is_empty() {
        true => String::new(),
        false if in_table => format!(", allowed {}", siblings.join(", ")),
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
