//! Sweeps: many runs from one file, shared between processes.
//!
//! A sweep file is a config with a section `[grid]`. Its keys are dotted config keys with lists of values, or the
//! special axes of [`layout`]. Every combination of values is a [`Point`]: one config, trained as a run in
//! `points/NNNN`. Its results do not depend on the points that train at the same time.
//!
//! The keys of a section `[vary]` change one at a time. Every combination of `[grid]` has a point with the file's
//! values, and one for each value of each key of `[vary]`.
//!
//! | module | contents |
//! |---|---|
//! | [`layout`] | the paper's geometry for any number of groups and followers |
//! | [`shard`] | the assignment of points to processes by cost |
//! | [`run`] | batches of points that fit in memory, and their progress |
//! | [`results`] | the tables `results.csv` and `points.csv` |
//! | [`pictures`] | heat maps and curves |
//! | [`arms`] | points grouped by the values of one axis, for comparison |

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::Path;

use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

use crate::import;
use flotilla::config::{self, Config, ConfigError, GRID, Override, Problem, VARY, ValidConfig};
use flotilla::escape;
use flotilla::file;
use flotilla::reader::Document;

pub mod arms;
pub mod layout;
pub mod pictures;
pub mod results;
pub mod run;
pub mod shard;

/// The key of `[grid]` that is not an axis.
const SKIP: &str = "skip_impossible";
/// Maximum number of points of a sweep.
pub(crate) const MAX_POINTS: usize = 1 << 16;
/// Maximum number of problems listed per sweep.
const MAX_LISTED: usize = 50;

/// A sweep whose points are all valid.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// The name of the file, without folder and extension.
    pub name: String,
    /// The axes of the grid, then the varied ones, in the order of the file. The first changes slowest from point to
    /// point.
    pub axes: Vec<Axis>,
    /// The combinations that are not skipped, in order.
    pub points: Vec<Point>,
    /// The number of combinations that are skipped because they are invalid.
    pub skipped: usize,
    /// The sweep file in normal form, flags included. Equal sweeps have equal texts.
    pub text: String,
}

/// A key of `[grid]` or `[vary]` with its values.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// A dotted config key, or one of [`layout::AXES`].
    pub key: String,
    /// The values. The first of a varied key is the file's.
    pub values: Vec<Value>,
    /// Whether the key is varied. At most one varied key of a point differs from its first value.
    pub varied: bool,
    /// Where the part of the key begins that names the axis, see [`Axis::leaf`].
    leaf: usize,
}

impl Axis {
    /// Returns the name in errors.
    fn name(&self) -> String {
        format!("{}.{}", if self.varied { VARY } else { GRID }, quoted(&self.key))
    }

    /// Returns the name of a value in errors, with its index in the file's list.
    fn name_of(&self, value: usize) -> String {
        format!("{}[{}]", self.name(), value - usize::from(self.varied))
    }

    /// Returns a value for people and tables: words without quotes, other values as TOML.
    pub fn label(&self, value: usize) -> String {
        match &self.values[value] {
            Value::String(word) => word.clone(),
            other => other.to_string(),
        }
    }

    /// Returns the end of the key, as much of it as no other axis has: `max_speed`, or `rover.motion.max_speed`.
    pub fn leaf(&self) -> &str {
        &self.key[self.leaf..]
    }

    /// Finds [`Axis::leaf`] among the keys of all axes.
    fn shorten(&mut self, keys: &[String]) {
        let is_own = |&start: &usize| {
            let leaf = &self.key[start..];
            let others = keys.iter().filter(|key| **key != self.key);
            !others.filter_map(|key| key.strip_suffix(leaf)).any(|before| before.is_empty() || before.ends_with('.'))
        };
        self.leaf = self.key.match_indices('.').rev().map(|(dot, _)| dot + 1).find(is_own).unwrap_or(0);
    }
}

/// One combination of values.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// The index among all combinations, including skipped ones.
    pub index: usize,
    /// The index of its value on each axis.
    pub values: Vec<usize>,
    pub config: ValidConfig,
    /// Notes for the author of the config.
    pub notes: Vec<String>,
}

impl Sweep {
    /// Reads a sweep file. `flags` set config keys of all points, and `skip` skips invalid points.
    pub fn load(path: &Path, flags: &[Override], skip: bool) -> Result<Sweep, ConfigError> {
        let mut sweep = Sweep::read(&import::read_file(path)?, &config::name(path), flags, skip)?;
        if config::is_standard_input(path) {
            sweep.name = "sweep".into();
        }
        Ok(sweep)
    }

    /// Reads a sweep from its text. `name` is the file in errors.
    pub fn read(text: &str, name: &str, flags: &[Override], skip: bool) -> Result<Sweep, ConfigError> {
        let document = Document::parse(text);
        let Ok(mut base) = text.parse::<Table>() else {
            Config::read_noted(&document, name, &[GRID, VARY], &[])?;
            return Err(invalid(name, vec![problem(None, "", "it is not TOML")]));
        };
        let sections = [GRID, VARY].map(|section| base.remove(section));
        for Override { key, text, .. } in flags {
            let value = format!("value = {text}").parse::<Table>().ok().and_then(|mut table| table.remove("value"));
            if let (Some(value), Some(place)) = (value, place(&mut base, key)) {
                *place = value;
            }
        }
        let mut grid = Grid::read(&document, sections).map_err(|list| invalid(name, list))?;
        // Every point reads the rest of the document, so its cost must not depend on the length of the lists.
        let document = document.without(&[GRID, VARY]);
        let skip = skip || grid.skip;
        let paths: Vec<_> = grid.axes.iter().map(|(axis, _)| path_of(&base, &axis.key)).collect();
        let overlaps = |a: &[String], b: &[String]| a.iter().zip(b).all(|(a, b)| a == b);
        let mut problems = Vec::new();
        for flag in flags {
            let path = path_of(&base, &flag.key);
            let axes = grid.axes.iter().zip(&paths).filter(|(_, axis)| overlaps(axis, &path));
            problems.extend(axes.map(|((axis, _), _)| {
                let section = if axis.varied { "[vary]" } else { "the grid" };
                problem(None, &flag.name, format!("{section} has {} already; leave one of them out", axis.key))
            }));
        }
        for (index, (axis, line)) in grid.axes.iter().enumerate() {
            let before = grid.axes.iter().zip(&paths[..index]).find(|(_, path)| overlaps(path, &paths[index]));
            problems.extend(before.map(|((before, _), _)| {
                let (before, name) = (before.name(), axis.name());
                let what = if before == name { "given twice".into() } else { format!("{before} sets the same") };
                problem(Some(*line), &name, format!("{what}; leave one of them out"))
            }));
        }
        problems.extend(layout::conflicts(&grid, &base));
        problems.extend(
            layout::AXES
                .into_iter()
                .filter(|key| base.contains_key(*key))
                .map(|key| problem(None, key, format!("this key belongs in the section [grid]: {key} = [2, 4]"))),
        );
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

        let layout = layout::Arrangement::of(&grid);
        let tried: Vec<_> = (0..total)
            .map(|index| {
                let values = grid.values(index);
                let overrides = [flags, &grid.overrides(&values), &layout.overrides(&grid, &base, &values)].concat();
                let config = Config::read_noted(&document, name, &[GRID, VARY], &overrides);
                let (config, notes) =
                    config.map_or_else(|error| (Err(error), vec![]), |(read, notes)| (Ok(read), notes));
                Tried { index, values, config, notes }
            })
            .collect();
        let mut problems = grid.problems(&tried, skip);
        problems.extend(grid.take_own_values(&tried));
        if !problems.is_empty() {
            return Err(invalid(name, problems));
        }
        let text = grid.normal(&base, skip);
        let axes = grid.axes.into_iter().map(|(axis, _)| axis).collect();
        let point = |Tried { index, values, config, notes }| Some(Point { index, values, config: config.ok()?, notes });
        let points: Vec<_> = tried.into_iter().filter_map(point).collect();
        let name = file::stem(Path::new(name), "sweep");
        Ok(Sweep { name, axes, skipped: total - points.len(), points, text })
    }

    /// Lists the keys of all axes, for errors.
    pub(crate) fn keys(&self) -> String {
        self.axes.iter().map(|axis| &*axis.key).collect::<Vec<_>>().join(", ")
    }

    /// Describes a point: `world.coupling = 3, learning.fitness = Df`.
    pub fn describe(&self, point: &Point) -> String {
        describe(self.axes.iter(), &point.values)
    }
}

/// A combination of values with its config, or with the problems of that config.
struct Tried {
    index: usize,
    values: Vec<usize>,
    config: Result<ValidConfig, ConfigError>,
    notes: Vec<String>,
}

fn describe<'a>(axes: impl Iterator<Item = &'a Axis>, values: &[usize]) -> String {
    let shown = axes.zip(values).filter(|(axis, value)| !axis.varied || **value > 0);
    let pairs: Vec<_> = shown.map(|(axis, &value)| format!("{} = {}", axis.key, axis.label(value))).collect();
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

/// The sections `[grid]` and `[vary]`: every axis with its line.
struct Grid {
    line: usize,
    /// The axes of the grid, then the varied ones.
    axes: Vec<(Axis, usize)>,
    skip: bool,
}

impl Grid {
    /// Reads the axes. The first value of a varied axis is not known yet, see [`Grid::take_own_values`].
    fn read(document: &Document<'_>, values: [Option<Value>; 2]) -> Result<Grid, Vec<Problem>> {
        let line = |at: usize| document.lines().line(at);
        let mut grid = Grid { line: 0, axes: vec![], skip: false };
        let mut problems = Vec::new();
        let mut spans: BTreeMap<_, _> = document
            .table()
            .iter()
            .filter(|(key, _)| [GRID, VARY].contains(&key.get_ref().as_ref()))
            .map(|(key, value)| (key.get_ref().to_string(), (key.span().start, value)))
            .collect();
        for (name, values) in [GRID, VARY].into_iter().zip(values) {
            let Some((start, section)) = spans.remove(name) else { continue };
            let line_of_section = line(start);
            grid.line = if grid.line == 0 { line_of_section } else { grid.line };
            let (DeValue::Table(section), Some(Value::Table(values))) = (section.get_ref(), values) else {
                problems.push(problem(Some(line_of_section), name, format!("allowed a section [{name}]")));
                continue;
            };
            // Spans give the order in the file. Plain values are simpler to use.
            let mut starts = BTreeMap::new();
            flatten_spans(section, "", &mut starts);
            let mut flat = Vec::new();
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
        let keys: Vec<String> = grid.axes.iter().map(|(axis, _)| axis.key.clone()).collect();
        grid.axes.iter_mut().for_each(|(axis, _)| axis.shorten(&keys));
        if problems.is_empty() { Ok(grid) } else { Err(problems) }
    }

    fn read_key(&mut self, varied: bool, line: usize, key: String, value: Value, problems: &mut Vec<Problem>) {
        let mut axis = Axis { key, values: vec![], varied, leaf: 0 };
        let (key, name) = (&*axis.key, axis.name());
        let mut report = |message: String| problems.push(problem(Some(line), &name, message));
        match value {
            Value::Boolean(skip) if key == SKIP && !varied => self.skip = skip,
            other if key == SKIP && !varied => report(format!("found {other}, allowed true or false")),
            _ if varied && layout::AXES.contains(&key) => {
                report("not allowed in [vary], because it replaces the whole layout; move it to [grid]".into());
            }
            Value::Array(values) if values.is_empty() => {
                report("found no values, allowed a list of at least one; or leave the key out".into());
            }
            Value::Array(values) => {
                let mut first_at = HashMap::with_capacity(values.len());
                for (at, value) in values.iter().enumerate() {
                    match first_at.entry(canonical(value)) {
                        Entry::Vacant(new) => drop(new.insert(at)),
                        Entry::Occupied(first) => {
                            report(format!("found {value} twice, at [{}] and at [{at}]", first.get()));
                        }
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

    /// Returns the number of points per combination of the grid: one with the file's values, and one per varied value.
    fn variations(&self) -> usize {
        let varied = self.axes.iter().filter(|(axis, _)| axis.varied);
        1 + varied.map(|(axis, _)| axis.values.len() - 1).sum::<usize>()
    }

    /// Sets the first value of every varied axis: the value of the points that do not change it. A listed value that is
    /// the same is a problem.
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
        let mut reported = HashSet::new();
        problems.retain(|Problem { line, key, message }| reported.insert((*line, key.clone(), message.clone())));
        let variations = self.variations();
        let own = |key: &str| {
            let configs = tried.chunks(variations).filter_map(|of| of[0].config.as_ref().ok());
            let mut values = configs.filter_map(|config| value_of(config, key));
            let first = values.next();
            // A default may depend on the keys of the grid.
            first.filter(|first| values.all(|value| value == *first)).unwrap_or_else(|| Value::from("the file's"))
        };
        for (axis, _) in self.axes.iter_mut().filter(|(axis, _)| axis.varied) {
            axis.values[0] = own(&axis.key);
        }
        problems
    }

    /// Returns the index of a point's value on each axis. The variations of a combination are consecutive. Among
    /// combinations, the last axis of the grid changes fastest.
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

    /// Returns the problems of the points, each once. With `skip`, points may be invalid, but not all points with the
    /// same value, because such a value is a mistake.
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

    /// Writes the sweep file in normal form.
    fn normal(&self, base: &Table, skip: bool) -> String {
        let mut text = toml::to_string(base).unwrap_or_default();
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

fn value_of(config: &Config, key: &str) -> Option<Value> {
    let mut table = Table::try_from(config).ok()?;
    let value = place(&mut table, key)?.clone();
    (value != Value::Table(Table::new())).then_some(value)
}

/// Returns the parts of a key's path in a config, with an item of a list by its index.
fn path_of(base: &Table, key: &str) -> Vec<String> {
    let mut parts = config::key_path(key).peekable();
    let mut value = parts.peek().and_then(|first| base.get(*first));
    let mut path: Vec<String> = parts.next().map(String::from).into_iter().collect();
    for part in parts {
        let index = value.and_then(Value::as_array).and_then(|items| index_of(items, part));
        value = match index {
            Some(index) => value.and_then(|list| list.get(index)),
            None => value.and_then(|table| table.get(part)),
        };
        path.push(index.map_or(part.into(), |index| index.to_string()));
    }
    path
}

/// Returns the index of the item of a list with this name or index.
fn index_of(items: &[Value], part: &str) -> Option<usize> {
    let is_named = |item: &Value| item.get("name").and_then(Value::as_str) == Some(part);
    items.iter().position(is_named).or_else(|| part.parse().ok())
}

/// Returns the place of a key's value in a config. A missing value becomes an empty table. Returns `None` if a list of the
/// config has no such item.
fn place<'t>(table: &'t mut Table, key: &str) -> Option<&'t mut Value> {
    let mut path = config::key_path(key);
    let mut value = table.entry(path.next()?).or_insert_with(|| Value::Table(Table::new()));
    for part in path {
        value = match value {
            Value::Array(items) => {
                let index = index_of(items, part)?;
                items.get_mut(index)?
            }
            Value::Table(table) => table.entry(part).or_insert_with(|| Value::Table(Table::new())),
            _ => return None,
        };
    }
    Some(value)
}

/// Returns a text that is the same for equal values only.
fn canonical(value: &Value) -> String {
    match value {
        // 1 and 1.0 are equal, and so are 0.0 and -0.0.
        Value::Float(number) if number.fract() == 0.0 && number.abs() < 1e15 => (*number as i64).to_string(),
        Value::Array(values) => format!("[{}]", values.iter().map(canonical).collect::<Vec<_>>().join(",")),
        other => other.to_string(),
    }
}

fn quoted(key: &str) -> String {
    if key.contains('.') { format!("{key:?}") } else { key.into() }
}

/// Joins nested keys with dots: `world.coupling = […]` without quotes is a table in a table. A key that the file has in
/// both notations is there twice.
fn flatten(table: Table, prefix: &str, flat: &mut Vec<(String, Value)>) {
    for (key, value) in table {
        let key = format!("{prefix}{key}");
        match value {
            Value::Table(table) => flatten(table, &format!("{key}."), flat),
            value => flat.push((key, value)),
        }
    }
}

/// Finds where each key of [`flatten`] starts, the later place if it is there twice.
fn flatten_spans(table: &DeTable<'_>, prefix: &str, starts: &mut BTreeMap<String, usize>) {
    for (key, value) in table {
        let start = key.span().start;
        let key = format!("{prefix}{}", key.get_ref());
        match value.get_ref() {
            DeValue::Table(table) => flatten_spans(table, &format!("{key}."), starts),
            _ => drop(starts.entry(key).and_modify(|later| *later = start.max(*later)).or_insert(start)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flotilla::reader::work;

    #[test]
    fn the_text_of_a_sweep_is_parsed_once_however_many_points_it_has() {
        let parsed = |points: usize| {
            let seeds: Vec<_> = (0..points).map(|seed| seed.to_string()).collect();
            let world = "[world]\nleaders = [[10, 5]]\npois = [[10, 15]]\n";
            let text = format!("{world}[grid]\n\"learning.seed\" = [{}]\n", seeds.join(", "));
            work::take();
            let sweep = Sweep::read(&text, "seeds.toml", &[], false).unwrap();
            assert_eq!(sweep.points.len(), points);
            assert_eq!(sweep.points[points - 1].config.learning.seed, points as u64 - 1);
            (work::take(), text.len())
        };
        for points in [10, 1000] {
            let (bytes, length) = parsed(points);
            assert!(bytes <= 2 * length, "{points} points of {length} bytes: {bytes} bytes parsed");
        }
    }

    #[test]
    fn axes_are_named_by_as_much_of_their_keys_as_tells_them_apart() {
        let leaves = |keys: [&str; 3]| {
            let keys = keys.map(String::from);
            keys.clone().map(|key| {
                let mut axis = Axis { key, values: vec![], varied: false, leaf: 0 };
                axis.shorten(&keys);
                axis.leaf().to_string()
            })
        };
        let speeds = ["agents.rover.motion.max_speed", "agents.uav.motion.max_speed", "motion.max_speed"];
        assert_eq!(leaves(["world.steps", "world.dt", "learning.seed"]), ["steps", "dt", "seed"]);
        assert_eq!(leaves(speeds), ["rover.motion.max_speed", "uav.motion.max_speed", "motion.max_speed"]);
        assert_eq!(leaves(["pois.a.value", "pois.b.value", "seed"]), ["a.value", "b.value", "seed"]);
    }

    #[test]
    fn equal_values_are_found_whatever_their_notation() {
        let twice = |values: &str| {
            let text =
                format!("[world]\nleaders = [[10, 5]]\npois = [[10, 15]]\n[grid]\n\"motion.min_speed\" = {values}");
            Sweep::read(&text, "x.toml", &[], false).unwrap_err().to_string()
        };
        assert!(twice("[0.5, 1.0, 0.50]").contains("found 0.5 twice, at [0] and at [2]"));
        assert!(twice("[0.0, -0.0]").contains("twice, at [0] and at [1]"));
        assert!(twice("[1, 1.0]").contains("twice, at [0] and at [1]"));
    }
}
