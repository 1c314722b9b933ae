//! A TOML text read key by key: whoever asks for a key says what it allows, and everything that is wrong with the text
//! is found in one pass and reported by line.
//!
//! What is asked for is also a table of keys, see [`keys`]. Which keys there are is no matter of this module.

use std::collections::BTreeMap;
use std::fmt::{self, Display};
use std::ops::RangeInclusive;

use serde::Serialize;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::declare::Choice;

/// Most problems listed of one text.
const MAX_LISTED: usize = 50;

/// What is to be known of one key: a line of the table behind `docs/reference/config.md` and every commented config.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Definition {
    /// Dotted: `world.dt`.
    pub name: &'static str,
    /// Empty where it has none.
    pub unit: &'static str,
    /// What kind of value it takes: `number`, `word`, `list of positions [x, y]`.
    pub kind: String,
    /// The values it takes; bounds that other keys set go by these keys' names.
    pub range: String,
    /// As TOML; none where the key has to be given.
    pub default: Option<String>,
    /// Without a full stop.
    pub meaning: &'static str,
    /// Section and equation of the paper; empty where it says nothing of this.
    pub paper: &'static str,
}

/// A key set from outside the config file.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    /// The dotted key: `learning.population`.
    pub key: String,
    /// What it is set to, as TOML.
    pub text: String,
    /// What errors call it: `--population`.
    pub name: String,
}

impl Override {
    /// Sets `key` to `value`; errors call it `name`.
    pub fn new(key: impl Into<String>, value: impl Into<toml::Value>, name: impl Into<String>) -> Override {
        Override { key: key.into(), text: value.into().to_string(), name: name.into() }
    }
}

/// One thing wrong with a config.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// The line in the file, from 1; none for an [`Override`].
    pub line: Option<usize>,
    /// The dotted key with any place in its list, `world.leaders[3][1]`, or the override's name; empty for broken TOML.
    pub key: String,
    /// What was found and what is allowed.
    pub message: String,
}

/// All that is wrong with a text, by line; what came from outside it (see [`Override`]) last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problems {
    /// As many as anyone reads.
    pub listed: Vec<Problem>,
    /// How many more there are.
    pub unlisted: usize,
}

/// Sections of a text that are not for whoever reads it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Others<'a> {
    /// These are passed over.
    pub foreign: &'a [&'a str],
    /// With any of these the text is something else, as the message says; of that nothing else is worth saying.
    pub refused: &'a [&'a str],
    /// What is said of such a text.
    pub message: &'a str,
}

/// Reads a text, with some keys set from elsewhere: `ask` asks for every key that there is.
///
/// # Errors
/// Everything that is wrong with the text and the overrides.
pub fn read<T>(
    text: &str,
    others: Others<'_>,
    overrides: &[Override],
    ask: impl FnOnce(&mut Reader<'_>) -> T,
) -> Result<T, Problems> {
    let (document, errors) = DeTable::parse_recoverable(text);
    let mut reader = Reader::default();
    for error in first_slips(text, &errors) {
        let span = error.span().unwrap_or(0..0);
        let at = text.get(span.clone()).filter(|at| !at.trim().is_empty());
        let at = at.map_or(String::new(), |at| format!(" (at `{}`)", shorten(at)));
        let message = error.message().trim().replace('\n', ", ") + &at;
        reader.report(Place::Offset(span.start), "", message);
    }
    if reader.problems.is_empty() {
        let mut refused = document.get_ref().keys().filter(|key| others.refused.contains(&key.get_ref().as_ref()));
        if let Some(section) = refused.next() {
            reader.report(Place::Offset(section.span().start), section.get_ref(), others.message.into());
        }
    }
    if reader.problems.is_empty() {
        reader.fill(document.into_inner(), text, others.foreign, overrides);
        let read = ask(&mut reader);
        reader.report_unknown();
        if reader.problems.is_empty() {
            return Ok(read);
        }
    }
    Err(reader.into_problems(text))
}

/// What an empty text comes to, and every key that `ask` asks for, in that order.
pub fn keys<T>(ask: impl FnOnce(&mut Reader<'_>) -> T) -> (T, Vec<Definition>) {
    let mut reader = Reader { table: Some(vec![]), ..Reader::default() };
    let read = ask(&mut reader);
    (read, reader.table.unwrap_or_default())
}

/// The syntax errors that no earlier one explains: a slip can break the rest of its line, a list left open the rest of
/// the file.
fn first_slips<'e>(text: &str, errors: &'e [toml::de::Error]) -> impl Iterator<Item = &'e toml::de::Error> {
    let left_open = errors.iter().any(|error| error.message().contains("unclosed array"));
    let in_list = |error: &toml::de::Error| left_open && error.message().contains("array");
    let end = errors.iter().position(in_list).map_or(errors.len(), |first| first + 1);
    let mut last = None;
    errors[..end].iter().filter(move |error| {
        let start = error.span().map_or(0, |span| span.start);
        let new_line = last.is_none_or(|last| text.get(last..start).is_some_and(|since| since.contains('\n')));
        last = if new_line { Some(start) } else { last };
        new_line
    })
}

/// The values a number may have.
#[derive(Clone, Copy, Debug)]
pub struct Allowed<T> {
    low: T,
    high: T,
    zero: bool,
    unlimited: bool,
    /// Where the bounds come from.
    because: &'static str,
}

/// The numbers from `low` to `high`, both included.
pub fn between<T>(low: T, high: T) -> Allowed<T> {
    Allowed { low, high, zero: false, unlimited: false, because: "" }
}

impl<T: Number> Allowed<T> {
    /// Also 0, where the least other value is greater.
    pub fn or_zero(self) -> Self {
        Allowed { zero: true, ..self }
    }

    /// Also infinity.
    pub fn or_unlimited(self) -> Self {
        Allowed { unlimited: true, ..self }
    }

    /// The bounds are those of other keys, by these names.
    pub fn because(self, because: &'static str) -> Self {
        Allowed { because, ..self }
    }

    fn holds(&self, value: T) -> bool {
        (self.low..=self.high).contains(&value)
            || self.zero && value == T::ZERO
            || self.unlimited && value.is_infinite()
    }

    /// Whether it is above 0, but below the least number that is allowed besides 0.
    fn is_too_small(&self, value: T) -> bool {
        self.zero && T::ZERO < value && value < self.low
    }

    /// The default, or the bound next to it where other keys leave no room for it.
    fn nearest(&self, default: T) -> T {
        match default {
            _ if self.holds(default) => default,
            _ if default < self.low => self.low,
            _ => self.high,
        }
    }
}

impl<T: Number> Allowed<T> {
    /// What is allowed in any config: a bound that other keys set goes by their names.
    fn in_general(&self) -> String {
        match self.because {
            "" => self.in_detail(),
            both if both.contains(" to ") => both.into(),
            most => format!("{}{} to {most}", if self.zero { "0 or " } else { "" }, self.low),
        }
    }

    /// The range with its gap between 0 and the least other number, if it has one.
    fn in_detail(&self) -> String {
        match (self.zero, self.low < self.high) {
            (true, true) => format!("0 or {}", Allowed { zero: false, ..*self }),
            _ => self.to_string(),
        }
    }
}

/// The plain range: the gap above 0 is only worth a word to who wrote a number within it.

impl<T: Number> Display for Allowed<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Allowed { low, high, .. } = self;
        match (self.zero, low.partial_cmp(high)) {
            (true, Some(std::cmp::Ordering::Less)) => write!(f, "0 to {high}")?,
            (true, _) => write!(f, "0")?,
            (false, Some(std::cmp::Ordering::Less)) => write!(f, "{low} to {high}")?,
            (false, _) => write!(f, "{high}")?,
        }
        if self.unlimited {
            write!(f, " or inf (unlimited)")?;
        }
        if !self.because.is_empty() {
            write!(f, " ({})", self.because)?;
        }
        Ok(())
    }
}

/// A type that keys have numbers of.
pub trait Number: Copy + PartialOrd + Display + Serialize {
    /// 0.
    const ZERO: Self;
    /// With its article: "a number".
    const KIND: &'static str;

    /// The number that was written, `None` inside where the type cannot hold it, or `None` for another kind of value.
    fn read(value: &DeValue<'_>) -> Option<Option<Self>>;

    /// Whether it is infinity.
    fn is_infinite(self) -> bool {
        false
    }
}

impl Number for f64 {
    const ZERO: f64 = 0.0;
    const KIND: &'static str = "a number";

    fn read(value: &DeValue<'_>) -> Option<Option<f64>> {
        match value {
            DeValue::Integer(_) => Some(i64::read(value)?.map(|integer| integer as f64)),
            DeValue::Float(float) => {
                let value: Option<f64> = float.as_str().parse().ok();
                let written = |value: &f64| value.is_finite() || float.as_str().contains("inf");
                // Adding 0 turns -0 into 0.
                Some(value.filter(written).map(|value| value + 0.0))
            }
            _ => None,
        }
    }

    fn is_infinite(self) -> bool {
        self == f64::INFINITY
    }
}

macro_rules! whole_number {
    ($($type:ty)*) => {$(
        impl Number for $type {
            const ZERO: $type = 0;
            const KIND: &'static str = "a whole number";

            fn read(value: &DeValue<'_>) -> Option<Option<$type>> {
                value.as_integer().map(|integer| <$type>::from_str_radix(integer.as_str(), integer.radix()).ok())
            }
        }
    )*};
}
whole_number!(i64 u64 usize);

/// Where a value was written, in the order in which problems are told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    /// This many bytes into the file.
    Offset(usize),
    Outside,
}

/// A value and what errors say of it.
struct Entry<'a> {
    value: Spanned<DeValue<'a>>,
    /// The text that the value's span counts in.
    text: &'a str,
    outside: bool,
    /// What the user calls it: the key, with any place in its list, or the override's name.
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

/// A text from the file, fit for one line of an error.
fn shorten(text: &str) -> String {
    let line = text.lines().next().unwrap_or_default();
    let end = line.char_indices().nth(40).map_or(line.len(), |(end, _)| end);
    let more = if end < text.len() { "…" } else { "" };
    line[..end].chars().map(|c| if c.is_control() { ' ' } else { c }).chain(more.chars()).collect()
}

/// The values of a file that were not asked for yet, and what is wrong with those that were.
#[derive(Default)]
pub struct Reader<'a> {
    /// By dotted key.
    entries: BTreeMap<String, Entry<'a>>,
    /// Values outside any section.
    strays: Vec<Entry<'a>>,
    /// Where each section starts.
    sections: BTreeMap<String, usize>,
    /// The keys asked for, with the place and name of those that were there.
    known: BTreeMap<&'static str, Option<(Place, String)>>,
    /// Place, name and message of each.
    problems: Vec<(Place, String, String)>,
    /// All there is to know of the keys asked for, where somebody wants to.
    table: Option<Vec<Definition>>,
}

/// Declares a section of a config, and of its keys all that is to be known but what they allow: each entry makes a
/// field, its documentation, and a function by the field's name that asks a [`Reader`] for the key.
///
/// An entry is what the key means, without a full stop; the field; and the key's unit and its place in the paper, empty
/// where it has none. A field whose key another part asks for has neither, and words of its own.
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

/// A requested key, before its allowed values and its default are given.
pub struct KeyRequest<'r, 'a> {
    reader: &'r mut Reader<'a>,
    name: &'static str,
    unit: &'static str,
    meaning: &'static str,
    paper: &'static str,
}

impl<'a> Reader<'a> {
    fn fill(&mut self, document: DeTable<'a>, text: &'a str, foreign: &[&str], overrides: &'a [Override]) {
        for (section, value) in document {
            let start = section.span().start;
            let section = section.into_inner().into_owned();
            if foreign.contains(&section.as_str()) {
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
    pub fn error_count(&self) -> usize {
        self.problems.len()
    }

    /// Asks for a key.
    pub fn key<'r>(
        &'r mut self,
        name: &'static str,
        unit: &'static str,
        meaning: &'static str,
        paper: &'static str,
    ) -> KeyRequest<'r, 'a> {
        KeyRequest { reader: self, name, unit, meaning, paper }
    }

    /// A number, or its default where there is none.
    fn number<T: Number>(&mut self, entry: Option<Entry<'_>>, allowed: Allowed<T>, default: T) -> T {
        entry.map_or_else(|| allowed.nearest(default), |entry| self.check(&entry, allowed))
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

    /// The items of a list, or none of a list of another length or of another thing.
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
    pub fn report_key(&mut self, key: &'static str, message: String) {
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
        for entry in std::mem::take(&mut self.strays) {
            let name = &entry.name;
            let message = if sections.contains(&name.as_str()) {
                format!("found {}, allowed a section [{name}]", entry.found())
            } else {
                format!("unknown key{}", hint(name, &known))
            };
            self.report(entry.place(), &shorten(name), message);
        }
        for (name, start) in std::mem::take(&mut self.sections) {
            if !sections.contains(&name.as_str()) {
                let message = format!("unknown section{}", hint(&name, &sections));
                self.report(Place::Offset(start), &shorten(&name), message);
                self.entries.retain(|key, entry| entry.outside || section_of(key) != name);
            }
        }
        for (key, entry) in std::mem::take(&mut self.entries) {
            self.report(entry.place(), &shorten(&entry.name), format!("unknown key{}", hint(&key, &known)));
        }
    }

    fn into_problems(mut self, text: &str) -> Problems {
        self.problems.sort_by_key(|problem| problem.0);
        let unlisted = self.problems.len().saturating_sub(MAX_LISTED);
        let listed = self.problems.into_iter().take(MAX_LISTED).map(|(place, key, message)| {
            let line = match place {
                Place::Offset(offset) => Some(text.bytes().take(offset).filter(|&byte| byte == b'\n').count() + 1),
                Place::Outside => None,
            };
            Problem { line, key, message }
        });
        Problems { listed: listed.collect(), unlisted }
    }
}

impl<'a> KeyRequest<'_, 'a> {
    /// What was written in the config. Where somebody wants to know of the key, its kind, range and default are noted.
    fn take(&mut self, about: impl FnOnce() -> (String, String, Option<String>)) -> Option<Entry<'a>> {
        if let Some(table) = &mut self.reader.table {
            let KeyRequest { name, unit, meaning, paper, .. } = *self;
            let (kind, range, default) = about();
            table.push(Definition { name, unit, kind, range, default, meaning, paper });
        }
        self.reader.take(self.name)
    }

    /// A number, or its default where the key was left out.
    pub fn number<T: Number>(mut self, allowed: Allowed<T>, default: T) -> T {
        let entry = self.take(|| (kind::<T>().into(), allowed.in_general(), Some(written(&default))));
        self.reader.number(entry, allowed, default)
    }

    /// A number, or a percentage of the number that bounds it, written as a word such as `"10%"`.
    pub fn number_or_percentage<T: Number>(mut self, allowed: Allowed<T>, default: T) -> NumberOrPercentage<T> {
        const PERCENTAGES: &str = "above \"0%\", up to \"100%\"";
        let kind = || format!("{}, or a percentage such as \"10%\"", kind::<T>());
        let range = || format!("{}, or {PERCENTAGES}", allowed.in_general());
        let entry = self.take(|| (kind(), range(), Some(written(&default))));
        let Some((entry, word)) = entry.as_ref().and_then(|entry| Some((entry, entry.value.get_ref().as_str()?)))
        else {
            return NumberOrPercentage::Number(self.reader.number(entry, allowed, default));
        };
        let percentage = word.strip_suffix('%').and_then(|number| number.parse().ok());
        match percentage.filter(|&percentage: &f64| 0.0 < percentage && percentage <= 100.0) {
            Some(percentage) => NumberOrPercentage::Percentage(percentage),
            None => {
                let message = format!("found {}, allowed {allowed}, or {PERCENTAGES}", entry.found());
                self.reader.report(entry.place(), &entry.name, message);
                NumberOrPercentage::Number(allowed.nearest(default))
            }
        }
    }

    /// What one of the words stands for, or its default where the key was left out.
    pub fn choice<T: Choice>(mut self, default: T) -> T {
        let words = || T::names().map(|word| format!("{word:?}")).collect::<Vec<_>>().join(" or ");
        let Some(entry) = self.take(|| ("word".into(), words(), Some(written(&default)))) else { return default };
        let word = entry.value.get_ref().as_str();
        T::ALL.iter().find(|choice| Some(choice.0) == word).map_or_else(
            || {
                let message = format!("found {}, allowed {}", entry.found(), words());
                self.reader.report(entry.place(), &entry.name, message);
                default
            },
            |choice| choice.1,
        )
    }

    /// Two numbers, or their default where the key was left out.
    pub fn pair(mut self, allowed: Allowed<f64>, default: [f64; 2]) -> [f64; 2] {
        let about = || ("two numbers".into(), format!("each {}", allowed.in_general()), Some(written(&default)));
        let Some(entry) = self.take(about) else { return default };
        self.reader.two(entry, [allowed; 2])
    }

    /// Positions within these sides; `None` where they have to be given and were not, or were no such list.
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
        Some(items.into_iter().map(|item| self.reader.two(item, sides)).collect())
    }

    /// A list of numbers, or its default where the key was left out.
    pub fn numbers<T: Number>(mut self, counts: RangeInclusive<usize>, allowed: Allowed<T>, default: Vec<T>) -> Vec<T> {
        let range = || format!("{} of them, each {}", between(*counts.start(), *counts.end()), allowed.in_general());
        let about = || (format!("list of {}s", kind::<T>()), range(), Some(written(&default)));
        match self.take(about) {
            Some(entry) => self.reader.numbers(entry, counts, allowed),
            None => default,
        }
    }

    /// A list of as many lists of numbers as `of`, another key, has items (any number where that is not known), or of
    /// none, which is the default. `check` returns the problems of lists whose numbers are allowed, each with the index
    /// of its list.
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
        if entry.value.get_ref().as_array().is_some_and(|items| items.is_empty()) {
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

    /// One number, or a list of so many; the default is one.
    pub fn one_or_list<T: Number>(
        mut self,
        allowed: Allowed<T>,
        counts: RangeInclusive<usize>,
        default: T,
    ) -> OneOrList<T> {
        let kind = || format!("{}, or a list of them", kind::<T>());
        match self.take(|| (kind(), allowed.in_general(), Some(written(&default)))) {
            Some(entry) if entry.value.get_ref().is_array() => {
                OneOrList::List(self.reader.numbers(entry, counts, allowed))
            }
            entry => OneOrList::One(self.reader.number(entry, allowed, default)),
        }
    }
}

/// The value of a key that takes a number or a percentage.
pub enum NumberOrPercentage<T> {
    /// A number.
    Number(T),
    /// A percentage, above 0 and up to 100.
    Percentage(f64),
}

/// What a key holds that takes both.
pub enum OneOrList<T> {
    /// One value for all.
    One(T),
    /// A value for each.
    List(Vec<T>),
}

/// A kind of number without its article.
fn kind<T: Number>() -> &'static str {
    T::KIND.trim_start_matches("a ")
}

/// A value as TOML has it.
fn written<T: Serialize>(value: &T) -> String {
    toml::Value::try_from(value).expect("numbers, words and lists of them are TOML").to_string()
}

/// The section of a dotted key.
fn section_of(key: &str) -> &str {
    key.split_once('.').map_or(key, |(section, _)| section)
}

/// `, did you mean …?` with the known name nearest to an unknown one, or else what its section knows.
fn hint(name: &str, known: &[&str]) -> String {
    const LONGEST_NAME: usize = 64;
    let last = |key: &'_ str| key.rsplit('.').next().unwrap_or_default().to_lowercase();
    let leaf = last(name);
    let same_section = |key: &str| section_of(key) == section_of(name);
    let distance = |key: &str| (strsim::damerau_levenshtein(&last(key), &leaf), !same_section(key));
    let nearest = known.iter().filter(|_| name.len() <= LONGEST_NAME).min_by_key(|key| distance(key));
    if let Some(key) = nearest.filter(|key| distance(key).0 <= leaf.len() / 3) {
        return format!(", did you mean `{key}`?");
    }
    let siblings: Vec<String> = known.iter().filter(|key| same_section(key)).map(|key| last(key)).collect();
    match siblings.is_empty() {
        true => String::new(),
        false => format!("; [{}] has {}", section_of(name), siblings.join(", ")),
    }
}
