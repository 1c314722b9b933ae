//! Requests for keys, one method per kind of value.

use std::ops::RangeInclusive;

use serde::{Serialize, Serializer};

use super::{Allowed, Definition, Entry, MAX_HINTS, Number, Reader, Value, between};
use crate::config_enum::Choice;

/// Maximum number of names that an error lists.
const MAX_NAMED: usize = 16;
/// Maximum number of names in a list if those that there are are unknown.
const MAX_NAMES: usize = 1024;

/// A requested key, before its allowed values and its default are given.
pub(crate) struct KeyRequest<'r, 'a> {
    pub(super) reader: &'r mut Reader<'a>,
    pub(super) name: &'static str,
    pub(super) unit: &'static str,
    pub(super) meaning: &'static str,
    pub(super) paper: &'static str,
}

impl<'a> KeyRequest<'_, 'a> {
    /// Takes the value from the config. `about` returns kind, range and default for [`keys`].
    fn take(&mut self, about: impl FnOnce() -> (String, String, Option<String>)) -> Option<Entry<'a>> {
        if let Some(keys) = &mut self.reader.keys {
            let KeyRequest { name, unit, meaning, paper, .. } = *self;
            let (kind, range, default) = about();
            keys.push(Definition { name, unit, kind, range, default, meaning, paper });
        }
        self.reader.take(self.name)
    }

    /// Returns a number, or the default without the key.
    pub fn number<T: Number>(mut self, allowed: Allowed<T>, default: T) -> T {
        let entry = self.take(|| (kind::<T>().into(), allowed.in_general(), Some(written(&default))));
        self.reader.number(self.name, entry, allowed, default)
    }

    /// Returns a number, or `None` if the required key is missing.
    pub fn required_number<T: Number>(mut self, allowed: Allowed<T>) -> Option<T> {
        let Some(entry) = self.take(|| (kind::<T>().into(), allowed.in_general(), None)) else {
            self.reader.report_key(self.name, format!("missing, allowed {allowed}"));
            return None;
        };
        Some(self.reader.check(&entry, allowed))
    }

    /// Returns a number, or `None` without the key. `default` describes what that means.
    pub fn optional_number<T: Number>(mut self, allowed: Allowed<T>, default: &str) -> Option<T> {
        let entry = self.take(|| (kind::<T>().into(), allowed.in_general(), Some(default.into())))?;
        Some(self.reader.check(&entry, allowed))
    }

    /// Returns `true` or `false`, or the default without the key.
    pub fn flag(mut self, default: bool) -> bool {
        const FLAGS: &str = "true or false";
        let about = || ("true or false".into(), FLAGS.into(), Some(default.to_string()));
        let Some(entry) = self.take(about) else { return default };
        entry.value.flag().unwrap_or_else(|| {
            self.reader.report_found(&entry, FLAGS);
            default
        })
    }

    /// Returns a required name, or an empty one if it is wrong. `check` returns what is wrong with it.
    pub fn name(mut self, range: &str, check: impl FnOnce(&str) -> Option<String>) -> String {
        let Some(entry) = self.take(|| ("word".into(), range.into(), None)) else {
            self.reader.report_key(self.name, format!("missing, allowed {range}"));
            return String::new();
        };
        let message = match entry.value.word() {
            Some(word) => match check(word) {
                Some(message) => message,
                None => return word.into(),
            },
            None => format!("found {}, allowed {range}", entry.value.found()),
        };
        self.reader.report(entry.place(), &entry.name, message);
        String::new()
    }

    /// Returns what `parse` makes of a word, or `None` without the key or if the word is wrong. `default` describes what
    /// that means, `range` the words, and `parse` returns those that are allowed instead.
    pub fn optional_word<T>(
        mut self,
        range: &str,
        default: &str,
        parse: impl FnOnce(&str) -> Result<T, String>,
    ) -> Option<T> {
        let entry = self.take(|| ("word".into(), range.into(), Some(default.into())))?;
        let allowed = match entry.value.word().map(parse) {
            Some(Ok(parsed)) => return Some(parsed),
            Some(Err(allowed)) => allowed,
            None => range.into(),
        };
        self.reader.report_found(&entry, allowed);
        None
    }

    /// Returns a number, or `None` if the value is this word, or the default without the key.
    pub fn number_or<T: Number>(mut self, allowed: Allowed<T>, word: &str, default: T) -> Option<T> {
        let (kind, range) = (kind::<T>(), format!("{}, or {word:?}", allowed.in_general()));
        let entry = self.take(|| (format!("{kind}, or a word"), range, Some(written(&default))));
        self.number_unless(word, entry, allowed, default)
    }

    /// Reads a number, or `None` if the value is this word.
    fn number_unless<T: Number>(self, word: &str, entry: Option<Entry>, allowed: Allowed<T>, default: T) -> Option<T> {
        match entry {
            Some(entry) if entry.value.word() == Some(word) => None,
            Some(entry) if T::read(&entry.value).is_none() => {
                self.reader.report_found(&entry, format_args!("{}, {allowed}, or {word:?}", T::KIND));
                Some(allowed.nearest(default))
            }
            entry => Some(self.reader.number(self.name, entry, allowed, default)),
        }
    }

    /// Returns a list of names, written as such or as one name. By default it is empty, but `is_required` makes that a
    /// problem. `allowed` are the names that there are, unless they are unknown, and `range` describes them for any
    /// config. `check` returns what is wrong with one of these names.
    pub fn names(
        mut self,
        range: &str,
        is_required: bool,
        allowed: Option<&[&str]>,
        check: impl Fn(&str) -> Option<String>,
    ) -> Vec<String> {
        let words = || match allowed {
            Some([]) => "none, because there are no others".into(),
            Some(allowed) => {
                let listed = allowed.iter().take(MAX_NAMED).map(|name| format!("{name:?}"));
                let more = (allowed.len() > MAX_NAMED).then(|| format!("{} more", allowed.len() - MAX_NAMED));
                listed.chain(more).collect::<Vec<_>>().join(" or ")
            }
            None => range.into(),
        };
        let default = (!is_required).then(|| "[]".into());
        let Some(entry) = self.take(|| ("name, or a list of names".into(), range.into(), default)) else {
            if is_required {
                self.reader.report_key(self.name, format!("missing, allowed {} or a list of names", words()));
            }
            return vec![];
        };
        let items = match entry.value.list() {
            Some(_) => {
                let least = usize::from(is_required);
                self.reader
                    .items(entry, least..=allowed.map_or(MAX_NAMES, <[_]>::len).max(1), "names")
                    .unwrap_or_default()
            }
            None => vec![entry],
        };
        let mut names: Vec<String> = Vec::new();
        for item in items {
            let (found, word) = (item.value.found(), item.value.word());
            let message = match word {
                Some(word) if names.iter().any(|name| name == word) => Some(format!("found {found} again")),
                Some(word) if allowed.is_none_or(|allowed| allowed.contains(&word)) => check(word),
                word => {
                    self.reader.hints += 1;
                    let hint = match allowed {
                        Some(allowed) if self.reader.hints <= MAX_HINTS => similar(word, allowed.iter().copied()),
                        _ => String::new(),
                    };
                    Some(format!("found {found}, allowed {}{hint}", words()))
                }
            };
            match (message, word) {
                (None, Some(word)) => names.push(word.into()),
                (message, _) => self.reader.report(item.place(), &item.name, message.unwrap_or_default()),
            }
        }
        names
    }

    /// Returns the tables of a list, by default an empty one. `read` gets the index of each table.
    pub fn tables<T>(
        mut self,
        counts: RangeInclusive<usize>,
        what: &str,
        read: impl FnMut(&mut Reader<'a>, usize) -> T,
    ) -> Vec<T> {
        let range = || format!("{} of them", between(*counts.start(), *counts.end()));
        let entry = self.take(|| (format!("list of {what}"), range(), Some("[]".into())));
        self.reader.tables_of(self.name, entry, counts, what, read)
    }

    /// Returns a table, or what `read` makes of an empty one without the key. `table` is the section of its keys.
    pub fn table<T>(
        mut self,
        table: &'static str,
        range: &str,
        default: &str,
        read: impl FnOnce(&mut Reader<'a>) -> T,
    ) -> Option<T> {
        let entry = self.take(|| ("table".into(), range.into(), Some(default.into())));
        let entry = entry.unwrap_or_else(|| {
            let value = Value::empty_table();
            Entry { value, outside: false, name: self.reader.name_of(self.name) }
        });
        self.reader.within([self.name, table], Some(entry), read)
    }

    /// Returns what `read` makes of a table, or `None` without the key. `table` is the section of its keys.
    pub fn optional_table<T>(
        mut self,
        table: &'static str,
        range: &str,
        read: impl FnOnce(&mut Reader<'a>) -> T,
    ) -> Option<T> {
        let entry = self.take(|| ("table".into(), range.into(), Some("none".into())));
        if entry.is_none() && self.reader.keys.is_none() {
            return None;
        }
        let is_there = entry.is_some();
        self.reader.within([self.name, table], entry, read).filter(|_| is_there)
    }

    /// Returns a count, or a percentage of the number that bounds it, written as a word such as `"10%"`.
    pub fn count_or_percentage(mut self, allowed: Allowed<usize>, default: usize) -> CountOrPercentage {
        const PERCENTAGES: &str = "above \"0%\", up to \"100%\"";
        let kind = || format!("{}, or a percentage such as \"10%\"", kind::<usize>());
        let range = || format!("{}, or {PERCENTAGES}", allowed.in_general());
        let entry = self.take(|| (kind(), range(), Some(written(&default))));
        match entry {
            Some(entry) if entry.value.word().is_some() => {
                let percentage = entry.value.word().and_then(|word| word.strip_suffix('%')?.parse().ok());
                match percentage.filter(|&percentage: &f64| 0.0 < percentage && percentage <= 100.0) {
                    Some(percentage) => return CountOrPercentage::Percentage(percentage),
                    None => self.reader.report_found(&entry, format_args!("{allowed}, or {PERCENTAGES}")),
                }
            }
            Some(entry) if usize::read(&entry.value).is_none() => {
                // A share is the usual mistake.
                let share = f64::read(&entry.value).flatten().filter(|share| (1e-6..=1.0).contains(share));
                let (percentage, kind) = ((share.unwrap_or(0.1) * 1e6).round() / 1e4, usize::KIND);
                let allowed = format_args!("{kind}, {allowed}, or a percentage such as \"{percentage}%\"");
                self.reader.report_found(&entry, allowed);
            }
            entry => return CountOrPercentage::Count(self.reader.number(self.name, entry, allowed, default)),
        }
        CountOrPercentage::Count(allowed.nearest(default))
    }

    /// Returns the value of a word, or the default without the key or if the word is wrong.
    pub fn choice<T: Choice>(self, default: T) -> T {
        self.optional_choice(&written(&default)).unwrap_or(default)
    }

    /// Returns the value of a word, or `None` without the key or if the word is wrong. `default` describes what that
    /// means.
    pub fn optional_choice<T: Choice>(mut self, default: &str) -> Option<T> {
        let words = || T::names().map(|word| format!("{word:?}")).collect::<Vec<_>>().join(" or ");
        let entry = self.take(|| ("word".into(), words(), Some(default.into())))?;
        let word = entry.value.word();
        let found = T::ALL.iter().find(|choice| Some(choice.0) == word);
        if found.is_none() {
            self.reader.report_found(&entry, words() + &similar(word, T::names()));
        }
        found.map(|choice| choice.1)
    }

    /// Returns two numbers, or the default without the key.
    pub fn pair(mut self, allowed: Allowed<f64>, default: [f64; 2]) -> [f64; 2] {
        let about = || ("two numbers".into(), format!("each {}", allowed.in_general()), Some(written(&default)));
        let Some(entry) = self.take(about) else { return default };
        self.reader.tuple(entry, [allowed; 2])
    }

    /// Returns some numbers, or `None` without the key. `what` names them.
    pub fn optional_tuple<const N: usize>(mut self, what: &str, allowed: [Allowed<f64>; N]) -> Option<[f64; N]> {
        let ranges = || allowed.map(|side| side.in_general()).join(", ");
        let entry = self.take(|| (format!("list of {what}"), ranges(), Some("none".into())))?;
        Some(self.reader.tuple(entry, allowed))
    }

    /// Returns positions within these sides, or `None` if the required key is missing or not such a list.
    pub fn positions(
        mut self,
        counts: RangeInclusive<usize>,
        sides: [Allowed<f64>; 2],
        default: Option<Vec<[f64; 2]>>,
    ) -> Option<Vec<[f64; 2]>> {
        const WHAT: &str = "positions [x, y]";
        let (fewest, most) = (*counts.start(), *counts.end());
        let range = || format!("{} of them, on {}", between(fewest, most), sides[0].because);
        let Some(entry) = self.take(|| (format!("list of {WHAT}"), range(), default.as_ref().map(written))) else {
            if default.is_none() {
                let message = format!("missing, allowed a list of {} {WHAT}", between(fewest, most));
                self.reader.report_key(self.name, message);
            }
            return default;
        };
        let items = self.reader.items(entry, counts, WHAT)?;
        Some(items.into_iter().map(|item| self.reader.tuple(item, sides)).collect())
    }

    /// Returns a list of numbers, or the default without the key.
    pub fn numbers<T: Number>(mut self, counts: RangeInclusive<usize>, allowed: Allowed<T>, default: Vec<T>) -> Vec<T> {
        let range = || format!("{} of them, each {}", between(*counts.start(), *counts.end()), allowed.in_general());
        let about = || (format!("list of {}s", kind::<T>()), range(), Some(written(&default)));
        match self.take(about) {
            Some(entry) => self.reader.numbers(entry, counts, allowed),
            None => default,
        }
    }

    /// Returns a list of lists of numbers, by default an empty one. Otherwise it has as many lists as the key `of` has
    /// items, or any number if that is unknown. `check` returns further problems, each with the index of its list.
    pub fn lists<T: Number>(
        mut self,
        what: &str,
        (of, count): (&str, Option<usize>),
        lengths: RangeInclusive<usize>,
        allowed: Allowed<T>,
        check: impl FnOnce(&[Vec<T>]) -> Vec<(usize, String)>,
    ) -> Vec<Vec<T>> {
        let range = || format!("none, or as many as {of}, of numbers each {}", allowed.in_general());
        let Some(entry) = self.take(|| (format!("list of {what}"), range(), Some("[]".into()))) else { return vec![] };
        if entry.value.list().is_some_and(|items| items.is_empty()) {
            return vec![];
        }
        let reader = self.reader;
        let errors = reader.error_count();
        let counts = count.map_or(1..=usize::MAX, |count| count..=count);
        let items = reader.items(entry, counts, &format!("{what}, or none")).unwrap_or_default();
        let places: Vec<_> = items.iter().map(|item| (item.place(), item.name.clone())).collect();
        let lists: Vec<_> = items.into_iter().map(|item| reader.numbers(item, lengths.clone(), allowed)).collect();
        if reader.error_count() == errors {
            for (list, message) in check(&lists) {
                let (place, name) = &places[list];
                reader.report(*place, name, message);
            }
        }
        if reader.error_count() == errors { lists } else { vec![] }
    }

    /// Returns one number or a list of numbers. The default is one number.
    pub fn one_or_each<T: Number>(
        mut self,
        allowed: Allowed<T>,
        counts: RangeInclusive<usize>,
        default: T,
    ) -> OneOrEach<T> {
        let kind = || format!("{}, or a list of them", kind::<T>());
        match self.take(|| (kind(), allowed.in_general(), Some(written(&default)))) {
            Some(entry) if entry.value.list().is_some() => OneOrEach::Each(self.reader.numbers(entry, counts, allowed)),
            entry => OneOrEach::Same(self.reader.number(self.name, entry, allowed, default)),
        }
    }

    /// Returns one number or a list of numbers, or `None` if the value is this word. The default is one number.
    pub fn one_or_each_or<T: Number>(
        mut self,
        allowed: Allowed<T>,
        counts: RangeInclusive<usize>,
        word: &str,
        default: T,
    ) -> Option<OneOrEach<T>> {
        let kind = || format!("{}, a list of them, or a word", kind::<T>());
        let range = || format!("{}, or {word:?}", allowed.in_general());
        match self.take(|| (kind(), range(), Some(written(&default)))) {
            Some(entry) if entry.value.list().is_some() => {
                Some(OneOrEach::Each(self.reader.numbers(entry, counts, allowed)))
            }
            entry => self.number_unless(word, entry, allowed, default).map(OneOrEach::Same),
        }
    }
}

/// The value of a key that takes a count, or a percentage of the number that bounds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CountOrPercentage {
    /// A count.
    Count(usize),
    /// A percentage, above 0 and up to 100.
    Percentage(f64),
}

impl From<usize> for CountOrPercentage {
    fn from(count: usize) -> CountOrPercentage {
        CountOrPercentage::Count(count)
    }
}

impl Serialize for CountOrPercentage {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            CountOrPercentage::Count(count) => count.serialize(serializer),
            CountOrPercentage::Percentage(percentage) => serializer.collect_str(&format_args!("{percentage}%")),
        }
    }
}

/// The value of a key that takes one number for all, or a list with a number for each.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum OneOrEach<T> {
    /// The same number for all.
    Same(T),
    /// One number for each.
    Each(Vec<T>),
}

impl<T: Copy> OneOrEach<T> {
    /// Returns the number of each of `count` items.
    pub fn of_each(&self, count: usize) -> Vec<T> {
        match self {
            OneOrEach::Same(number) => vec![*number; count],
            OneOrEach::Each(numbers) => numbers.clone(),
        }
    }
}

/// Returns a hint at the name that is most similar to a word, if any is.
fn similar<'n>(word: Option<&str>, names: impl Iterator<Item = &'n str>) -> String {
    let typed = word.unwrap_or_default().to_lowercase();
    let distance = |name: &&str| strsim::damerau_levenshtein(&name.to_lowercase(), &typed);
    let nearest = names.min_by_key(distance).filter(|name| distance(name) <= typed.len() / 3);
    nearest.map_or(String::new(), |name| format!("; did you mean {name:?}?"))
}

/// Returns the name of a type without its article.
fn kind<T: Number>() -> &'static str {
    T::KIND.trim_start_matches("a ")
}

/// Writes a value as TOML.
fn written<T: Serialize>(value: &T) -> String {
    toml::Value::try_from(value).expect("numbers, words and lists of them are TOML").to_string()
}
