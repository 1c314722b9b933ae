//! `[[stages]]`: keys that change from some generation on.
//!
//! Each stage changes keys of the file's own config, and not of the stage before. Keys of the populations and of the
//! run as a whole are the same in all stages.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use serde::Serialize;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::{Config, MAX_GENERATIONS, Override, Problem};
use crate::reader::{Document, LineNumbers, Number};

/// The list of stages in a config.
pub const STAGES: &str = "stages";
/// Maximum number of stages in a config.
pub const MAX_STAGES: usize = 256;
/// The key with the length of a run.
pub const GENERATIONS: &str = "learning.generations";
/// Keys that stages cannot change. A name that ends with a dot is a whole section.
const FIXED: [&str; 14] = [
    "policy.",
    "checkpoint.",
    "learning.paradigm",
    "learning.sharing",
    "learning.groups",
    "learning.population",
    "learning.hall_of_fame",
    "learning.elites",
    "learning.parents",
    "learning.method",
    "learning.search_sigma",
    GENERATIONS,
    "learning.trials",
    "learning.seed",
];

/// A stage, as written in the config.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stage {
    /// The first generation of the stage.
    pub from: usize,
    /// Dotted keys, with the values that they are set to.
    pub set: BTreeMap<String, toml::Value>,
}

impl Config {
    /// Returns the first generation of the last stage, or 0 without stages.
    pub fn last_from(&self) -> usize {
        self.stages.last().map_or(0, |stage| stage.from)
    }
}

/// The keys that a stage sets, dotted, each as written.
type Written<'a> = BTreeMap<String, WrittenValue<'a>>;

/// The line and the text of a value.
struct WrittenValue<'a> {
    line: Option<usize>,
    text: &'a str,
}

/// The problems of a document's stages.
struct Problems<'a> {
    /// The document's lines, or `None` if the document comes from outside the file.
    lines: Option<&'a LineNumbers>,
    listed: Vec<Problem>,
}

impl Problems<'_> {
    /// Returns the line of an offset in the document.
    fn line(&self, offset: usize) -> Option<usize> {
        self.lines.map(|lines| lines.line(offset))
    }

    fn report(&mut self, line: Option<usize>, key: String, message: String) {
        self.listed.push(Problem { line, key, message });
    }

    fn report_at(&mut self, offset: usize, key: String, message: String) {
        self.report(self.line(offset), key, message);
    }
}

/// Reads the stages of a document, each with its resolved config. The document's other keys make the valid config `own`.
///
/// Problems have lines unless the document comes from outside the file. `shortened` means that the run's length was set
/// from outside, in which case stages may begin after its end.
///
/// # Errors
/// Fails if a stage is invalid. The error lists all problems by line.
pub(super) fn read(
    document: &Document<'_>,
    outside: bool,
    own: &Config,
    shortened: bool,
) -> Result<Vec<(Stage, Config)>, Vec<Problem>> {
    let Some(list) = document.table().get(STAGES) else { return Ok(vec![]) };
    let mut problems = Problems { lines: (!outside).then(|| document.lines()), listed: vec![] };
    let Some(tables) = list.get_ref().as_array().filter(|tables| tables.len() <= MAX_STAGES) else {
        let message = format!("allowed a list of up to {MAX_STAGES} tables [[{STAGES}]], each with `from` and `set`");
        problems.report_at(list.span().start, STAGES.into(), message);
        return Err(problems.listed);
    };
    // A stage changes the values of `own`, so defaults that depend on other keys stay as they are there.
    let own_text = own.to_toml();
    let own_document = Document::parse(&own_text);
    let mut stages: Vec<(Stage, Config)> = Vec::new();
    for (index, table) in tables.iter().enumerate() {
        let (name, start) = (format!("{STAGES}[{index}]"), table.span().start);
        let Some(keys) = table.get_ref().as_table() else {
            problems.report_at(start, name, "allowed a table with `from` and `set`".into());
            continue;
        };
        let least = stages.last().map_or(0, |(before, _)| before.from + 1);
        let most = if shortened { MAX_GENERATIONS } else { own.learning.generations };
        let (from, written) = read_table(keys, &name, document.text(), least..=most, &mut problems);
        if from.is_none() {
            problems.report_at(start, name.clone(), "missing `from`, the first of its generations".into());
        }
        let line = problems.line(start);
        let config = resolve(&written, &name, line, own, &own_document, &mut problems);
        let value = |text: &str| {
            let table: Option<toml::Table> = format!("value = {text}").parse().ok();
            table.and_then(|mut table| table.remove("value"))
        };
        let set = written.iter().filter_map(|(key, written)| Some((key.clone(), value(written.text)?))).collect();
        stages.push((Stage { from: from.unwrap_or(0), set }, config));
    }
    if problems.listed.is_empty() { Ok(stages) } else { Err(problems.listed) }
}

/// Reads one stage's table, which is called `name` in problems: its first generation and the keys that it sets. If the
/// generation is not in `allowed`, returns the least that is.
fn read_table<'a>(
    keys: &DeTable<'_>,
    name: &str,
    text: &'a str,
    allowed: RangeInclusive<usize>,
    problems: &mut Problems<'_>,
) -> (Option<usize>, Written<'a>) {
    let (mut from, mut written) = (None, Written::new());
    for (key, value) in keys {
        let (place, offset) = (format!("{name}.{}", key.get_ref()), key.span().start);
        match (key.get_ref().as_ref(), value.get_ref()) {
            ("from", number) => {
                let (least, most) = allowed.clone().into_inner();
                match <usize as Number>::read(number).flatten() {
                    Some(number) if allowed.contains(&number) => from = Some(number),
                    _ if allowed.is_empty() => {
                        let message = format!("the stage before begins in the last generation, {most} ({GENERATIONS})");
                        problems.report_at(offset, place, message);
                        from = Some(least);
                    }
                    found => {
                        let found = found.map_or("something else".into(), |found| found.to_string());
                        let after = if least > 0 { ", after the stage before" } else { "" };
                        let message =
                            format!("found {found}, allowed a whole number, {least} to {most} ({GENERATIONS}){after}");
                        problems.report_at(offset, place, message);
                        from = Some(least);
                    }
                }
            }
            ("set", DeValue::Table(set)) => written = read_set(set, text, problems),
            ("set", _) => problems.report_at(offset, place, "allowed a table of dotted keys in quotes".into()),
            _ => problems.report_at(offset, place, "unknown key; a stage has from, set".into()),
        }
    }
    (from, written)
}

/// Reads the keys that a stage sets.
fn read_set<'a>(set: &DeTable<'_>, text: &'a str, problems: &Problems<'_>) -> Written<'a> {
    let mut written = Written::new();
    for (key, value) in set {
        let line = problems.line(key.span().start);
        let mut add = |key: String, value: &Spanned<DeValue<'_>>| {
            written.insert(key, WrittenValue { line, text: text.get(value.span()).unwrap_or_default() });
        };
        match value.get_ref() {
            // `set = { world.coupling = 1 }` is the same key without quotes.
            DeValue::Table(leaves) => {
                leaves.iter().for_each(|(leaf, value)| add(format!("{}.{}", key.get_ref(), leaf.get_ref()), value));
            }
            _ => add(key.get_ref().to_string(), value),
        }
    }
    written
}

/// Returns the config of a stage. If a key is invalid, this is `own`. Problems without a line of their own get `line`,
/// that of the stage.
fn resolve(
    written: &Written<'_>,
    name: &str,
    line: Option<usize>,
    own: &Config,
    own_document: &Document<'_>,
    problems: &mut Problems<'_>,
) -> Config {
    let mut overrides = Vec::new();
    for (key, value) in written {
        let name = format!("{name}.set.{key}");
        if FIXED.iter().any(|fixed| key == fixed || fixed.ends_with('.') && key.starts_with(fixed)) {
            problems.report(value.line, name, "this key cannot change between stages".into());
        } else {
            overrides.push(Override { key: key.clone(), text: value.text.to_string(), name });
        }
    }
    let line = |key: &str| {
        let within = |(written, _): &(&String, &WrittenValue)| key.starts_with(&format!("{name}.set.{written}"));
        written.iter().find(within).map_or(line, |(_, value)| value.line)
    };
    let config = match Config::without_stages(own_document, &[], &overrides) {
        Ok((config, _)) => config,
        Err(found) => {
            for Problem { key, message, .. } in found.listed {
                let line = line(&key);
                let key = if key.starts_with(STAGES) { key } else { format!("{name}: {key}") };
                problems.report(line, key, message);
            }
            own.clone()
        }
    };
    let counts = |config: &Config| [config.learners(), config.world.leaders.len()];
    if counts(&config) != counts(own) {
        let key = if written.contains_key("world.leaders") { "world.leaders" } else { "world.followers" };
        let [found, expected] = [&config, own].map(Config::learners);
        let key = format!("{name}.set.{key}");
        let message = format!("{found} leaders learn in this stage, {expected} in all others");
        problems.report(line(&key), key, message);
    }
    config
}

/// Attributes the problems of stages to the flags that cause them, if the file is valid without flags. A flag causes
/// them if it alone makes the config invalid. If there is no such flag, all flags cause them together.
pub(super) fn attribute(
    problems: Vec<Problem>,
    flags: &[Override],
    is_valid: impl Fn(&[Override]) -> bool,
) -> Vec<Problem> {
    if flags.is_empty() || !is_valid(&[]) {
        return problems;
    }
    let mut causes: Vec<&Override> = flags.iter().filter(|&flag| !is_valid(std::slice::from_ref(flag))).collect();
    if causes.is_empty() {
        causes = flags.iter().collect();
    }
    let names: Vec<&str> = causes.iter().map(|flag| &*flag.name).collect();
    let name = names.join(", ");
    let of_flags = |Problem { line, key, message }: Problem| {
        let line = line.map_or(String::new(), |line| format!(" (line {line})"));
        Problem { line: None, key: name.clone(), message: format!("{key}: {message}{line}") }
    };
    problems.into_iter().map(of_flags).collect()
}
