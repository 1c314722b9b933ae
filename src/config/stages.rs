//! `[[stages]]`: keys that change from some generation on.
//!
//! Each stage changes keys of the file's own config, and not of the stage before. Keys of the populations and of the
//! run as a whole are the same in all stages.

use std::collections::BTreeMap;

use serde::Serialize;
use toml::Spanned;
use toml::de::DeValue;

use super::{AGENTS, AgentClass, Config, MAX_GENERATIONS, Override, POIS, Problem};
use crate::reader::{Document, Number, Reader, Value, includes, key_path};

/// The list of stages in a config.
pub const STAGES: &str = "stages";
/// Maximum number of stages in a config.
pub const MAX_STAGES: usize = 256;
/// The key with the length of a run.
pub const GENERATIONS: &str = "learning.generations";
/// Keys that stages cannot change. A name that ends with a dot is a whole section.
const FIXED: [&str; 21] = [
    AGENTS,
    POIS,
    "policy.",
    "checkpoint.",
    "learning.paradigm",
    "learning.sharing",
    "learning.groups",
    "learning.population",
    "learning.hall_of_fame",
    "learning.elites",
    "learning.team_elites",
    "learning.team_g_elites",
    "learning.parents",
    "learning.method",
    "learning.search_sigma",
    GENERATIONS,
    "learning.trials",
    "learning.initial",
    "learning.initial_scale",
    "learning.test_episodes",
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
    /// Returns the first generation of the last stage that is played, or 0 without stages.
    pub fn last_from(&self) -> usize {
        self.stages.iter().rfind(|stage| self.plays(stage)).map_or(0, |stage| stage.from)
    }

    /// Reports whether a stage begins before the run ends.
    pub(super) fn plays(&self, stage: &Stage) -> bool {
        stage.from <= self.learning.generations
    }
}

/// A stage before its values are checked.
#[derive(Default)]
pub(super) struct UnresolvedStage<'a> {
    /// The name in problems: `stages[0]`.
    name: String,
    /// The line of the stage, and of its `from`; none if it is from outside the file.
    line: Option<usize>,
    from_line: Option<usize>,
    /// The first generation.
    from: Option<Value<'a>>,
    /// The dotted keys that it sets, each with its line, in the order of the keys.
    set: Vec<(String, Option<usize>, Value<'a>)>,
}

impl<'a> UnresolvedStage<'a> {
    /// Returns a stage that a program has set.
    pub fn of((index, stage): (usize, &Stage)) -> Self {
        let set = stage.set.iter().map(|(key, value)| (key.clone(), None, value.clone().into())).collect();
        UnresolvedStage { name: name_of(index), from: Some(Value::of(&stage.from)), set, ..UnresolvedStage::default() }
    }

    /// Adds what the document sets under a key. `above` is the key that it is a part of, with its dot, or empty: keys may be
    /// nested, so that `set = { world.coupling = 1 }` is `set = { "world.coupling" = 1 }`. The value of a dotted key in
    /// quotes may be a whole table.
    fn add(
        &mut self,
        above: &str,
        key: &str,
        line: Option<usize>,
        value: &'a Spanned<DeValue<'a>>,
        document: &'a Document<'_>,
    ) {
        let name = format!("{above}{key}");
        match value.get_ref() {
            DeValue::Table(leaves) if !key.contains('.') => leaves
                .iter()
                .for_each(|(leaf, value)| self.add(&format!("{name}."), leaf.get_ref(), line, value, document)),
            _ => self.set.push((name, line, document.value(value))),
        }
    }
}

/// Returns the parts of a dotted key. A class or a group of POIs has its name there, and not its index.
pub(super) fn path_of<'a>(key: &'a str, own: &'a Config) -> Vec<&'a str> {
    let mut path: Vec<&str> = key_path(key).collect();
    let names: Vec<&str> = match path[0] {
        AGENTS => own.agents.iter().map(|class| &*class.name).collect(),
        POIS => own.pois.iter().map(|group| &*group.name).collect(),
        _ => return path,
    };
    if let Some(part) = path.get_mut(1).filter(|part| !names.contains(part)) {
        *part = part.parse::<usize>().ok().and_then(|index| names.get(index)).unwrap_or(part);
    }
    path
}

/// Returns the name of a stage in problems.
fn name_of(index: usize) -> String {
    format!("{STAGES}[{index}]")
}

/// Returns the stages of a document, and the problems of their form. Problems have no lines if the document comes from
/// `outside` the file.
pub(super) fn unresolved<'a>(document: &'a Document<'_>, outside: bool) -> (Vec<UnresolvedStage<'a>>, Vec<Problem>) {
    let line = |offset: usize| (!outside).then(|| document.lines().line(offset));
    let mut problems = Vec::new();
    let mut report = |offset, key: String, message: String| problems.push(Problem { line: line(offset), key, message });
    let Some(list) = document.table().get(STAGES) else { return (vec![], vec![]) };
    let Some(tables) = list.get_ref().as_array().filter(|tables| tables.len() <= MAX_STAGES) else {
        let message = format!("allowed a list of up to {MAX_STAGES} tables [[{STAGES}]], each with `from` and `set`");
        report(list.span().start, STAGES.into(), message);
        return (vec![], problems);
    };
    let mut unresolved = Vec::new();
    for (index, table) in tables.iter().enumerate() {
        let (name, start) = (name_of(index), table.span().start);
        let mut stage = UnresolvedStage { name: name.clone(), line: line(start), ..UnresolvedStage::default() };
        let Some(keys) = table.get_ref().as_table() else {
            report(start, name, "allowed a table with `from` and `set`".into());
            continue;
        };
        for (key, value) in keys {
            let (place, offset) = (format!("{name}.{}", key.get_ref()), key.span().start);
            match (key.get_ref().as_ref(), value.get_ref()) {
                ("from", _) => {
                    stage.from_line = line(offset);
                    stage.from = Some(document.value(value));
                }
                ("set", DeValue::Table(set)) => {
                    for (key, value) in set {
                        stage.add("", key.get_ref(), line(key.span().start), value, document);
                    }
                    stage.set.sort_by(|(key, ..), (other, ..)| key.cmp(other));
                }
                ("set", _) => report(offset, place, "allowed a table of dotted keys in quotes".into()),
                _ => report(offset, place, "unknown key; a stage has from, set".into()),
            }
        }
        unresolved.push(stage);
    }
    (unresolved, problems)
}

/// Checks stages, and returns each with its resolved config. The config's other keys make the valid config `own`.
///
/// `problems` are those of the form of the stages.
///
/// # Errors
/// Fails if a stage is invalid. The error lists all problems by line.
pub(super) fn resolve(
    (unresolved, mut problems): (Vec<UnresolvedStage<'_>>, Vec<Problem>),
    own: &Config,
) -> Result<Vec<(Stage, Config)>, Vec<Problem>> {
    if unresolved.len() > MAX_STAGES {
        let message = format!("found {}, allowed up to {MAX_STAGES}", unresolved.len());
        return Err(vec![Problem { line: None, key: STAGES.into(), message }]);
    }
    let mut stages: Vec<(Stage, Config)> = Vec::new();
    for stage in unresolved {
        let min = stages.last().map_or(0, |(before, _)| before.from + 1);
        let from = stage.first_generation(min, &mut problems);
        let config = stage.config(own, &mut problems);
        let set = stage.set.iter().filter_map(|(key, _, value)| Some((key.clone(), value.to_toml()?))).collect();
        stages.push((Stage { from, set }, config));
    }
    problems.sort_by_key(|problem| problem.line);
    if problems.is_empty() { Ok(stages) } else { Err(problems) }
}

impl UnresolvedStage<'_> {
    /// Returns the first generation, or the smallest allowed one if it is wrong.
    fn first_generation(&self, min: usize, problems: &mut Vec<Problem>) -> usize {
        let Some(from) = &self.from else {
            let message = "missing `from`, the first of its generations".into();
            problems.push(Problem { line: self.line, key: self.name.clone(), message });
            return min;
        };
        let message = match usize::read(from).flatten() {
            Some(from) if (min..=MAX_GENERATIONS).contains(&from) => return from,
            found => {
                let found = found.map_or_else(|| from.found(), |found| found.to_string());
                let after = if min > 0 { ", after the stage before" } else { "" };
                format!("found {found}, allowed a whole number, {min} to {MAX_GENERATIONS}{after}")
            }
        };
        problems.push(Problem { line: self.from_line, key: format!("{}.from", self.name), message });
        min
    }

    /// Returns the config of the stage. If a key is invalid, this is `own`. Problems without a line of their own get
    /// that of the stage.
    fn config(&self, own: &Config, problems: &mut Vec<Problem>) -> Config {
        let name = &self.name;
        let names: Vec<String> = self.set.iter().map(|(key, ..)| format!("{name}.set.{key}")).collect();
        let mut paths: Vec<_> = self.set.iter().map(|(key, ..)| path_of(key, own)).zip(&self.set).collect();
        paths.sort_by(|(path, _), (other, _)| path.cmp(other));
        for ((path, (key, ..)), (other, (twice, line, _))) in paths.iter().zip(paths.iter().skip(1)) {
            if other.starts_with(path) {
                let message = format!("{key} sets this, too: remove one of the two");
                problems.push(Problem { line: *line, key: format!("{name}.set.{twice}"), message });
            }
        }
        // A stage changes the values of `own`, so defaults that depend on other keys stay as they are there.
        let mut reader = Reader::of_values(own.values());
        for ((key, line, value), name) in self.set.iter().zip(&names) {
            if FIXED.iter().any(|fixed| includes(fixed, key)) {
                problems.push(Problem {
                    line: *line,
                    key: name.clone(),
                    message: "this key cannot change between stages".into(),
                });
            } else {
                reader.set_within(key, value.clone(), name, &[AGENTS, POIS]);
            }
        }
        let line = |key: &str| {
            let within =
                |(set, ..): &&(String, Option<usize>, Value<'_>)| key.starts_with(&format!("{name}.set.{set}"));
            self.set.iter().rfind(within).map_or(self.line, |(_, line, _)| *line)
        };
        let config = match reader.read(Config::ask) {
            Ok((config, _)) => config,
            Err(found) => {
                problems.extend(found.into_iter().map(|Problem { key, message, .. }| Problem {
                    line: line(&key),
                    key: if key.starts_with(STAGES) { key } else { format!("{name}: {key}") },
                    message,
                }));
                own.clone()
            }
        };
        let counts = |config: &Config| [config.learners(), config.world.leaders.len()];
        let classes = |config: &Config| {
            let learning = config.agents.iter().filter(|class| class.learns());
            let layers = |class: &AgentClass| [class.size(), class.inputs(), config.outputs(class)];
            learning.map(|class| (class.name.clone(), layers(class))).collect::<Vec<_>>()
        };
        if own.agents.is_empty() && counts(&config) != counts(own) {
            let leaders = self.set.iter().any(|(key, ..)| key == "world.leaders");
            let key = format!("{name}.set.world.{}", if leaders { "leaders" } else { "followers" });
            let [found, expected] = [&config, own].map(Config::learners);
            let message = format!("{found} leaders learn in this stage, {expected} in all others");
            problems.push(Problem { line: line(&key), key, message });
        } else if classes(&config) != classes(own) {
            let message =
                "the classes that learn have other sizes, inputs or outputs in this stage than in all others".into();
            problems.push(Problem { line: self.line, key: name.clone(), message });
        } else if config.population_of_each() != own.population_of_each() {
            let message = "other leaders are nearest in this stage, and so share a policy; list learning.groups".into();
            problems.push(Problem { line: self.line, key: name.clone(), message });
        }
        config
    }
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
    of_flags(problems, &names.join(", "))
}

/// Returns the problems that flags cause.
pub(super) fn of_flags(problems: Vec<Problem>, flags: &str) -> Vec<Problem> {
    let of_flags = |Problem { line, key, message }: Problem| {
        let line = line.map_or(String::new(), |line| format!(" (line {line})"));
        Problem { line: None, key: flags.into(), message: format!("{key}: {message}{line}") }
    };
    problems.into_iter().map(of_flags).collect()
}
