//! A grid of runs: what a sweep file says, and how its points are shared out, run and put together again.
//!
//! A sweep file is a config with a section `[grid]`, whose keys are dotted config keys with lists of values, or the
//! special axes of [`layout`]. Every combination of values is a [`Point`]: one config, trained as a run of its own in
//! `points/NNNN`, whose results do not depend on which other points trained beside it. A section `[vary]` has keys that
//! are changed one at a time: for every combination of `[grid]` there is a point with the file's own values, and one
//! for each value of each key of `[vary]`.
//!
//! | module | holds |
//! |---|---|
//! | [`layout`] | the paper's geometry for any number of groups and followers |
//! | [`shard`] | which points a process of many takes: by cost, the same on every machine |
//! | [`run`] | trains a shard's points side by side |
//! | [`results`] | `results.csv` and `points.csv`, put together from the points' folders |
//! | [`pictures`] | heat maps and curves of them |
//! | [`arms`] | points by the values of one axis, to be compared |
//! | [`slurm`] | the batch script of a job array |
//! | [`questions`] | the questions that the paper leaves open, as sweeps |

use std::collections::BTreeMap;
use std::path::Path;

use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use crate::config::{self, Config, ConfigError, GRID, Override, Problem, VARY, read_file};
use crate::escape;

pub mod arms;
pub mod layout;
pub mod pictures;
pub mod questions;
pub mod results;
pub mod run;
pub mod shard;
pub mod slurm;

/// The key of `[grid]` that is no axis.
const SKIP: &str = "skip_impossible";
/// Most points in a sweep.
pub const MAX_POINTS: usize = 1 << 16;
/// Most problems listed of one sweep.
const MAX_LISTED: usize = 50;

/// A sweep, every point of which can run.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// What its file is called, without folder and extension.
    pub name: String,
    /// Those of the grid, then those varied, each in the order of the file; the first changes slowest from point to
    /// point.
    pub axes: Vec<Axis>,
    /// Every combination that is not left out, in order.
    pub points: Vec<Point>,
    /// Combinations left out because they cannot run.
    pub skipped: usize,
    /// The sweep file that says this, flags included: the same for the same sweep.
    pub text: String,
}

/// A key of `[grid]` or `[vary]` and the values it takes.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// A dotted config key, or one of [`layout::AXES`].
    pub key: String,
    /// Of a varied key the first is the file's own.
    pub values: Vec<Value>,
    /// Changed one at a time: of a point's varied keys, at most one has another than its first value.
    pub varied: bool,
}

impl Axis {
    /// What errors call it.
    fn name(&self) -> String {
        format!("{}.{}", if self.varied { VARY } else { GRID }, quoted(&self.key))
    }

    /// What errors call a value, by its place in the file's list.
    fn name_of(&self, value: usize) -> String {
        format!("{}[{}]", self.name(), value - usize::from(self.varied))
    }

    /// A value for people and tables: words without quotes, all else as TOML.
    pub fn label(&self, value: usize) -> String {
        match &self.values[value] {
            Value::String(word) => word.clone(),
            other => other.to_string(),
        }
    }

    /// The key without its section.
    pub fn leaf(&self) -> &str {
        self.key.rsplit('.').next().unwrap_or_default()
    }
}

/// One combination of values.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Its place among all combinations, those left out included.
    pub index: usize,
    /// The index of its value on each axis.
    pub values: Vec<usize>,
    /// What it runs.
    pub config: Config,
}

impl Sweep {
    /// Reads a sweep file; `flags` set config keys of all points, `skip` leaves impossible points out.
    ///
    /// # Errors
    /// A file that cannot be read, or everything that is wrong with it and with any of its points.
    pub fn load(path: &Path, flags: &[Override], skip: bool) -> Result<Sweep, ConfigError> {
        let mut sweep = Sweep::read(&read_file(path)?, &config::name(path), flags, skip)?;
        if config::is_standard_input(path) {
            sweep.name = "sweep".into();
        }
        Ok(sweep)
    }

    /// Reads a sweep from its text; `name` stands for the file in errors.
    ///
    /// # Errors
    /// Everything that is wrong with the text and with any of its points.
    pub fn read(text: &str, name: &str, flags: &[Override], skip: bool) -> Result<Sweep, ConfigError> {
        let (Ok(document), Ok(mut base)) = (DeTable::parse(text), text.parse::<Table>()) else {
            Config::read(text, name, &[GRID, VARY], &[])?;
            return Err(invalid(name, vec![problem(None, "", "it is not TOML")]));
        };
        let sections = [GRID, VARY].map(|section| base.remove(section));
        let mut grid = Grid::read(text, document.into_inner(), sections).map_err(|list| invalid(name, list))?;
        let skip = skip || grid.skip;
        let mut problems: Vec<Problem> = flags
            .iter()
            .filter_map(|flag| Some((flag, grid.axes.iter().find(|(axis, _)| axis.key == flag.key)?)))
            .map(|(flag, (axis, _))| {
                let section = if axis.varied { "[vary]" } else { "the grid" };
                problem(None, &flag.name, format!("{section} has {} already; leave one of them out", flag.key))
            })
            .collect();
        problems.extend(layout::conflicts(&grid, &base));
        let mut counts: Vec<_> = grid.of_grid().map(|axis| axis.values.len()).collect();
        counts.extend(Some(grid.variations()).filter(|&variations| variations > 1));
        let total = counts.iter().try_fold(1, |total: usize, &count| total.checked_mul(count));
        let Some(total) = total.filter(|&total| total <= MAX_POINTS) else {
            let counts: Vec<_> = counts.iter().map(usize::to_string).collect();
            let message = format!("found {} points, allowed 1 to {MAX_POINTS}", counts.join(" × "));
            return Err(invalid(name, vec![problem(Some(grid.line), GRID, message)]));
        };
        if !problems.is_empty() {
            return Err(invalid(name, problems));
        }

        let layout = layout::Arrangement::of(&grid, &base);
        let tried: Vec<_> = (0..total)
            .map(|index| {
                let values = grid.values(index);
                let overrides = [flags, &grid.overrides(&values), &layout.overrides(&grid, &values)].concat();
                let config = Config::read(text, name, &[GRID, VARY], &overrides);
                Tried { index, values, config }
            })
            .collect();
        let mut problems = grid.problems(&tried, skip);
        problems.extend(grid.take_own_values(&tried));
        if !problems.is_empty() {
            return Err(invalid(name, problems));
        }
        let text = grid.normal(base, flags, skip);
        let axes = grid.axes.into_iter().map(|(axis, _)| axis).collect();
        let point = |Tried { index, values, config }| config.ok().map(|config| Point { index, values, config });
        let points: Vec<_> = tried.into_iter().filter_map(point).collect();
        let name = Path::new(name).file_stem().map_or("sweep".into(), |stem| stem.to_string_lossy().into_owned());
        Ok(Sweep { name, axes, skipped: total - points.len(), points, text })
    }

    /// A point for people: `world.coupling = 3, learning.fitness = Df`.
    pub fn describe(&self, point: &Point) -> String {
        describe(self.axes.iter(), &point.values)
    }
}

/// A combination of values and what became of it.
struct Tried {
    index: usize,
    values: Vec<usize>,
    config: Result<Config, ConfigError>,
}

fn describe<'a>(axes: impl Iterator<Item = &'a Axis>, values: &[usize]) -> String {
    let told = axes.zip(values).filter(|(axis, value)| !axis.varied || **value > 0);
    let pairs: Vec<_> = told.map(|(axis, &value)| format!("{} = {}", axis.key, axis.label(value))).collect();
    if pairs.is_empty() { "as in the file".into() } else { escape::line(&pairs.join(", ")).into() }
}

fn problem(line: Option<usize>, key: &str, message: impl Into<String>) -> Problem {
    Problem { line, key: escape::line(key).into(), message: escape::line(&message.into()).into() }
}

fn invalid(name: &str, mut problems: Vec<Problem>) -> ConfigError {
    problems.sort_by_key(|problem| problem.line.unwrap_or(usize::MAX));
    let unlisted = problems.len().saturating_sub(MAX_LISTED);
    problems.truncate(MAX_LISTED);
    ConfigError::Invalid { name: name.into(), problems, unlisted }
}

/// `[grid]` and `[vary]` as written: every axis with its line.
struct Grid {
    line: usize,
    /// Those of the grid first.
    axes: Vec<(Axis, usize)>,
    skip: bool,
}

impl Grid {
    /// Of a varied axis the first value is yet to be found (see [`Grid::take_own_values`]).
    fn read(text: &str, document: DeTable<'_>, values: [Option<Value>; 2]) -> Result<Grid, Vec<Problem>> {
        let line = |at: usize| text.bytes().take(at).filter(|&byte| byte == b'\n').count() + 1;
        let mut grid = Grid { line: 0, axes: vec![], skip: false };
        let mut problems = Vec::new();
        let mut spans: BTreeMap<_, _> = document
            .into_iter()
            .filter(|(key, _)| [GRID, VARY].contains(&key.get_ref().as_ref()))
            .map(|(key, value)| (key.get_ref().to_string(), (key.span().start, value)))
            .collect();
        for (name, values) in [GRID, VARY].into_iter().zip(values) {
            let Some((start, section)) = spans.remove(name) else { continue };
            let line_of_section = line(start);
            grid.line = if grid.line == 0 { line_of_section } else { grid.line };
            let (DeValue::Table(section), Some(Value::Table(values))) = (section.into_inner(), values) else {
                problems.push(problem(Some(line_of_section), name, format!("allowed a section [{name}]")));
                continue;
            };
            // The spans know the order in the file, the plain values are easier to pass on.
            let mut starts = BTreeMap::new();
            flatten_spans(section, "", &mut starts);
            let mut flat = BTreeMap::new();
            flatten(values, "", &mut flat);
            let mut keys: Vec<_> =
                flat.into_iter().map(|(key, value)| (starts.get(&key).copied(), key, value)).collect();
            keys.sort_by_key(|(start, ..)| *start);
            let (before, errors) = (grid.axes.len(), problems.len());
            for (start, key, value) in keys {
                grid.read_key(name == VARY, start.map_or(line_of_section, line), key, value, &mut problems);
            }
            if name == VARY && grid.axes.len() == before && problems.len() == errors {
                let message = "it has no key; give a list of values for at least one: \"motion.max_speed\" = [2, 5]";
                problems.push(problem(Some(line_of_section), VARY, message));
            }
        }
        if grid.line == 0 {
            let message = "missing, a sweep has a section [grid] with a list of values for each key: \
                           \"world.coupling\" = [1, 2, 3]; to train one config, use `flotilla train`";
            return Err(vec![problem(None, GRID, message)]);
        }
        if grid.axes.is_empty() && problems.is_empty() {
            let message = "it has no axis; give a list of values for at least one key: \"world.coupling\" = [1, 2, 3]";
            problems.push(problem(Some(grid.line), GRID, message));
        }
        if problems.is_empty() { Ok(grid) } else { Err(problems) }
    }

    fn read_key(&mut self, varied: bool, line: usize, key: String, value: Value, problems: &mut Vec<Problem>) {
        let mut axis = Axis { key, values: vec![], varied };
        let (key, name) = (&*axis.key, axis.name());
        let mut report = |message: String| problems.push(problem(Some(line), &name, message));
        match value {
            Value::Boolean(skip) if key == SKIP && !varied => self.skip = skip,
            other if key == SKIP && !varied => report(format!("found {other}, allowed true or false")),
            _ if varied && layout::AXES.contains(&key) => {
                report("it lays out whole teams, of which the file has none of its own; allowed in [grid]".into());
            }
            _ if varied && self.axes.iter().any(|(other, _)| other.key == key) => {
                report("it stands in [grid] too; leave one of them out".into());
            }
            Value::Array(values) if values.is_empty() => {
                report("found no values, allowed a list of at least one; or leave the key out".into());
            }
            Value::Array(values) => {
                for (at, value) in values.iter().enumerate() {
                    if let Some(first) = values[..at].iter().position(|other| other == value) {
                        report(format!("found {value} twice, at [{first}] and at [{at}]"));
                    }
                }
                if layout::AXES.contains(&key) {
                    layout::problems(key, &values).for_each(report);
                }
                axis.values.extend(varied.then(|| Value::from("")));
                axis.values.extend(values);
                self.axes.push((axis, line));
            }
            other => report(format!("found {other}, allowed a list of values: [{other}]")),
        }
    }

    fn of_grid(&self) -> impl DoubleEndedIterator<Item = &Axis> {
        self.axes.iter().map(|(axis, _)| axis).filter(|axis| !axis.varied)
    }

    /// Points of each combination of the grid: the file's own values, and each varied one.
    fn variations(&self) -> usize {
        let varied = self.axes.iter().filter(|(axis, _)| axis.varied);
        1 + varied.map(|(axis, _)| axis.values.len() - 1).sum::<usize>()
    }

    /// Finds the first value of every varied axis: what the points that do not change it have. A value that is no other
    /// than that is a problem.
    fn take_own_values(&mut self, tried: &[Tried]) -> Vec<Problem> {
        let mut problems = Vec::new();
        for combination in tried.chunks(self.variations()) {
            let Ok(own) = &combination[0].config else { continue };
            for Tried { values, config, .. } in combination[1..].iter().filter(|tried| tried.config.as_ref() == Ok(own))
            {
                let changed = self.axes.iter().zip(values).find(|((axis, _), value)| axis.varied && **value > 0);
                let Some(((axis, line), &value)) = changed.filter(|_| config.is_ok()) else { continue };
                let found = axis.label(value);
                let message = format!("found {found}, which is the file's own value: that runs anyway; leave it out");
                problems.push(problem(Some(*line), &axis.name_of(value), message));
            }
        }
        problems.dedup();
        let variations = self.variations();
        let own = |key: &str| {
            let configs = tried.chunks(variations).filter_map(|of| of[0].config.as_ref().ok());
            let mut values = configs.filter_map(|config| value_of(config, key));
            let first = values.next().unwrap_or_else(|| Value::from(""));
            // A default may depend on what the grid changes.
            if values.all(|value| value == first) { first } else { Value::from("the file's") }
        };
        for (axis, _) in self.axes.iter_mut().filter(|(axis, _)| axis.varied) {
            axis.values[0] = own(&axis.key);
        }
        problems
    }

    /// The value on each axis of a point: a combination of the grid's, the last changing fastest, and of each the
    /// variations.
    fn values(&self, index: usize) -> Vec<usize> {
        let (mut combination, mut variation) = (index / self.variations(), index % self.variations());
        let mut values = vec![0; self.axes.len()];
        for (value, (axis, _)) in values.iter_mut().zip(&self.axes).rev().filter(|(_, (axis, _))| !axis.varied) {
            *value = combination % axis.values.len();
            combination /= axis.values.len();
        }
        for (value, (axis, _)) in values.iter_mut().zip(&self.axes).filter(|(_, (axis, _))| axis.varied) {
            let others = axis.values.len() - 1;
            *value = if variation <= others { variation } else { 0 };
            variation = variation.saturating_sub(others);
        }
        values
    }

    fn overrides(&self, values: &[usize]) -> Vec<Override> {
        let axes = self.axes.iter().map(|(axis, _)| axis).zip(values.iter().copied());
        let set = axes.filter(|(axis, value)| {
            let own = axis.varied && *value == 0;
            !own && !layout::AXES.contains(&&*axis.key)
        });
        set.map(|(axis, value)| Override::new(&axis.key, axis.values[value].clone(), axis.name_of(value))).collect()
    }

    /// All that keeps points from running, each problem once. With `skip`, points may fail, but not every point of
    /// any one value: what never works is a slip.
    fn problems(&self, tried: &[Tried], skip: bool) -> Vec<Problem> {
        let mut works: Vec<Vec<bool>> = self.axes.iter().map(|(axis, _)| vec![false; axis.values.len()]).collect();
        for tried in tried.iter().filter(|tried| tried.config.is_ok()) {
            works.iter_mut().zip(&tried.values).for_each(|(works, &value)| works[value] = true);
        }
        let hopeless = works.iter().flatten().any(|works| !works);
        let is_hopeless = |tried: &Tried| works.iter().zip(&tried.values).any(|(works, &value)| !works[value]);
        let mut found: BTreeMap<_, (usize, &[usize])> = BTreeMap::new();
        for Tried { values, config, .. } in tried.iter().filter(|tried| !skip || is_hopeless(tried)) {
            if let Err(ConfigError::Invalid { problems, .. }) = config {
                for Problem { line, key, message } in problems {
                    found.entry((*line, key, message)).or_insert((0, values)).0 += 1;
                }
            }
        }
        let line_of = |key: &str| {
            let axis = self.axes.iter().find(|(axis, _)| key.starts_with(&axis.name()));
            axis.map(|(_, line)| *line)
        };
        let mut problems = Vec::new();
        for ((line, key, message), (count, first)) in found {
            let mut message = message.clone();
            if count < tried.len() {
                let first = describe(self.axes.iter().map(|(axis, _)| axis), first);
                message += &format!("; at {count} of {} points, the first {first}", tried.len());
                if !hopeless {
                    message += " (--skip-impossible leaves such points out)";
                }
            }
            problems.push(Problem { line: line.or_else(|| line_of(key)), key: key.clone(), message });
        }
        problems
    }

    /// The sweep file in its normal form.
    fn normal(&self, mut base: Table, flags: &[Override], skip: bool) -> String {
        for Override { key, text, .. } in flags {
            let (section, leaf) = key.split_once('.').unwrap_or((key, ""));
            let value = format!("value = {text}").parse::<Table>().ok().and_then(|mut table| table.remove("value"));
            let section = base.entry(section).or_insert_with(|| Value::Table(Table::new()));
            if let (Some(section), Some(value)) = (section.as_table_mut(), value) {
                section.insert(leaf.into(), value);
            }
        }
        let mut text = toml::to_string(&base).unwrap_or_default();
        for (section, varied) in [(GRID, false), (VARY, true)] {
            let axes: Vec<&Axis> =
                self.axes.iter().map(|(axis, _)| axis).filter(|axis| axis.varied == varied).collect();
            let skip = skip && !varied;
            if axes.is_empty() && !skip {
                continue;
            }
            text += &format!("\n[{section}]\n");
            for Axis { key, values, .. } in axes {
                let values = values[usize::from(varied)..].to_vec();
                text += &format!("{} = {}\n", quoted(key), Value::Array(values));
            }
            if skip {
                text += &format!("{SKIP} = true\n");
            }
        }
        text.trim_start().to_string()
    }
}

/// What a config says of a dotted key.
fn value_of(config: &Config, key: &str) -> Option<Value> {
    let (section, leaf) = key.split_once('.')?;
    config.to_toml().parse::<Table>().ok()?.get(section)?.get(leaf).cloned()
}

fn quoted(key: &str) -> String {
    if key.contains('.') { format!("{key:?}") } else { key.into() }
}

/// `world.coupling = […]` without quotes is a table in a table; both ways mean the same key.
fn flatten(table: Table, prefix: &str, flat: &mut BTreeMap<String, Value>) {
    for (key, value) in table {
        let key = format!("{prefix}{key}");
        match value {
            Value::Table(table) => flatten(table, &format!("{key}."), flat),
            value => drop(flat.insert(key, value)),
        }
    }
}

fn flatten_spans(table: DeTable<'_>, prefix: &str, starts: &mut BTreeMap<String, usize>) {
    for (key, value) in table {
        let start = key.span().start;
        let key = format!("{prefix}{}", key.get_ref());
        match Spanned::into_inner(value) {
            DeValue::Table(table) => flatten_spans(table, &format!("{key}."), starts),
            _ => drop(starts.insert(key, start)),
        }
    }
}
