//! A grid of runs: what a sweep file says, and how its points are shared out, run and put together again.
//!
//! A sweep file is a config with one section more, `[grid]`, whose keys are dotted config keys with lists of values,
//! or the special axes of [`layout`]. Every combination of values is a [`Point`]: one config, trained as a run of its
//! own in `points/NNNN`, whose results do not depend on which other points trained beside it.
//!
//! | module | holds |
//! |---|---|
//! | [`layout`] | the paper's geometry for any number of groups and followers |
//! | [`shard`] | which points a process of many takes: by cost, the same on every machine |
//! | [`run`] | trains a shard's points side by side |
//! | [`results`] | `results.csv` and `points.csv`, put together from the points' folders |
//! | [`pictures`] | heat maps and curves of them |
//! | [`slurm`] | the batch script of a job array |

use std::collections::BTreeMap;
use std::path::Path;

use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use crate::config::{self, Config, ConfigError, GRID, Override, Problem, read_file};
use crate::escape;

pub mod layout;
pub mod pictures;
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
    /// In the order of the file; the first changes slowest from point to point.
    pub axes: Vec<Axis>,
    pub points: Vec<Point>,
    /// Combinations left out because they cannot run.
    pub skipped: usize,
    /// The sweep file that says this, flags included: the same for the same sweep.
    pub text: String,
}

/// A key of `[grid]` and the values it takes.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// A dotted config key, or one of [`layout::AXES`].
    pub key: String,
    pub values: Vec<Value>,
}

impl Axis {
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
            Config::read(text, name, &[GRID], &[])?;
            return Err(invalid(name, vec![problem(None, "", "it is not TOML")]));
        };
        let grid = Grid::read(text, document.into_inner(), base.remove(GRID)).map_err(|list| invalid(name, list))?;
        let skip = skip || grid.skip;
        let mut problems: Vec<Problem> = flags
            .iter()
            .filter(|flag| grid.axes.iter().any(|(axis, _)| axis.key == flag.key))
            .map(|flag| problem(None, &flag.name, format!("the grid has {} already; leave one of them out", flag.key)))
            .collect();
        problems.extend(layout::conflicts(&grid, &base));
        let total = grid.axes.iter().try_fold(1, |total: usize, (axis, _)| total.checked_mul(axis.values.len()));
        let Some(total) = total.filter(|&total| total <= MAX_POINTS) else {
            let counts: Vec<_> = grid.axes.iter().map(|(axis, _)| axis.values.len().to_string()).collect();
            let message = format!("found {} points, allowed 1 to {MAX_POINTS}", counts.join(" × "));
            return Err(invalid(name, vec![problem(Some(grid.line), GRID, message)]));
        };
        if !problems.is_empty() {
            return Err(invalid(name, problems));
        }

        let layout = layout::Layout::of(&grid, &base);
        let tried: Vec<_> = (0..total)
            .map(|index| {
                let values = grid.values(index);
                let overrides = [flags, &grid.overrides(&values), &layout.overrides(&grid, &values)].concat();
                let config = Config::read(text, name, &[GRID], &overrides);
                Tried { index, values, config }
            })
            .collect();
        let problems = grid.blame(&tried, skip);
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
    let pairs: Vec<_> =
        axes.zip(values).map(|(axis, &value)| format!("{} = {}", axis.key, axis.label(value))).collect();
    escape::line(&pairs.join(", ")).into()
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

/// `[grid]` as written: every axis with its line.
struct Grid {
    line: usize,
    axes: Vec<(Axis, usize)>,
    skip: bool,
}

impl Grid {
    fn read(text: &str, document: DeTable<'_>, values: Option<Value>) -> Result<Grid, Vec<Problem>> {
        let line = |at: usize| text.bytes().take(at).filter(|&byte| byte == b'\n').count() + 1;
        let Some((start, section)) =
            document.into_iter().find_map(|(key, value)| (key.get_ref() == GRID).then(|| (key.span().start, value)))
        else {
            let message = "missing, a sweep has a section [grid] with a list of values for each key: \
                           \"world.coupling\" = [1, 2, 3]; to train one config, use `flotilla train`";
            return Err(vec![problem(None, GRID, message)]);
        };
        let line_of_grid = line(start);
        let (DeValue::Table(section), Some(Value::Table(values))) = (section.into_inner(), values) else {
            return Err(vec![problem(Some(line_of_grid), GRID, "allowed a section [grid]")]);
        };
        // The spans know the order in the file, the plain values are easier to pass on.
        let mut starts = BTreeMap::new();
        flatten_spans(section, "", &mut starts);
        let mut flat = BTreeMap::new();
        flatten(values, "", &mut flat);
        let mut keys: Vec<_> = flat.into_iter().map(|(key, value)| (starts.get(&key).copied(), key, value)).collect();
        keys.sort_by_key(|(start, ..)| *start);

        let mut grid = Grid { line: line_of_grid, axes: vec![], skip: false };
        let mut problems = Vec::new();
        for (start, key, value) in keys {
            let line = start.map_or(line_of_grid, line);
            let mut blame = |message: String| problems.push(problem(Some(line), &axis_name(&key), message));
            match value {
                Value::Boolean(skip) if key == SKIP => grid.skip = skip,
                other if key == SKIP => blame(format!("found {other}, allowed true or false")),
                Value::Array(values) if values.is_empty() => {
                    blame("found no values, allowed a list of at least one; or leave the key out".into());
                }
                Value::Array(values) => {
                    for (at, value) in values.iter().enumerate() {
                        if let Some(first) = values[..at].iter().position(|other| other == value) {
                            blame(format!("found {value} twice, at [{first}] and at [{at}]"));
                        }
                    }
                    if layout::AXES.contains(&&*key) {
                        layout::blame(&key, &values).for_each(blame);
                    }
                    grid.axes.push((Axis { key, values }, line));
                }
                other => blame(format!("found {other}, allowed a list of values: [{other}]")),
            }
        }
        if grid.axes.is_empty() && problems.is_empty() {
            problems.push(problem(
                Some(line_of_grid),
                GRID,
                "it has no axis; give a list of values for at least one key: \"world.coupling\" = [1, 2, 3]",
            ));
        }
        if problems.is_empty() { Ok(grid) } else { Err(problems) }
    }

    /// The value on each axis of a combination.
    fn values(&self, mut index: usize) -> Vec<usize> {
        let mut values = vec![0; self.axes.len()];
        for (value, (axis, _)) in values.iter_mut().zip(&self.axes).rev() {
            *value = index % axis.values.len();
            index /= axis.values.len();
        }
        values
    }

    fn overrides(&self, values: &[usize]) -> Vec<Override> {
        let axes = self.axes.iter().zip(values).filter(|((axis, _), _)| !layout::AXES.contains(&&*axis.key));
        axes.map(|((Axis { key, values }, _), &value)| {
            Override::new(key, values[value].clone(), format!("{}[{value}]", axis_name(key)))
        })
        .collect()
    }

    /// All that keeps points from running, each problem once. With `skip`, points may fail, but not every point of
    /// any one value: what never works is a slip.
    fn blame(&self, tried: &[Tried], skip: bool) -> Vec<Problem> {
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
            let axis = self.axes.iter().find(|(axis, _)| key.starts_with(&axis_name(&axis.key)));
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
        let mut text = format!("{}\n[{GRID}]\n", toml::to_string(&base).unwrap_or_default()).trim_start().to_string();
        for (Axis { key, values }, _) in &self.axes {
            text += &format!("{} = {}\n", quoted(key), Value::Array(values.clone()));
        }
        if skip {
            text += &format!("{SKIP} = true\n");
        }
        text
    }
}

fn quoted(key: &str) -> String {
    if key.contains('.') { format!("{key:?}") } else { key.into() }
}

/// What errors call an axis.
fn axis_name(key: &str) -> String {
    format!("{GRID}.{}", quoted(key))
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
