//! Trains a grid of runs, and collects their results.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{BackendSource, Context, Error, Event, check_memory};
use crate::choice::Work;
use crate::record::RecordError;
use crate::record::digests::{UNVERIFIED, Verification};
use crate::record::disk::{Disk, Place};
use crate::record::folder::{self, CONFIG, RUN, Run, SWEEP, Start};
use crate::record::ownership;
use crate::record::runs::{self, ReadError};
use crate::report::comparison;
use crate::report::runs::TeamKind;
use crate::run::{Progress, RunError, Session, SessionEnd};
use crate::shell;
use crate::sweep::pictures;
use crate::sweep::results::{self, Missing, PointResults, ResultOptions};
use crate::sweep::run::{self, SweepProgress};
use crate::sweep::shard::Shard;
use crate::sweep::{Point, Sweep};
use flotilla::backend::OpenBackend;
use flotilla::config::{self, Config, ConfigError, Override, Problem, ValidConfig};
use flotilla::escape::PathExt;
use flotilla::memory;
use flotilla::reach::{self, Unreachable};
use flotilla::statistics;

/// Maximum number of points that are listed instead of a run.
const MAX_LISTED_POINTS: usize = 40;

/// A request to train or collect a sweep.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SweepRequest {
    /// The text of the sweep file.
    pub text: String,
    /// The file's name in errors.
    pub name: String,
    /// Config keys to set in all points.
    #[serde(default)]
    pub set: Vec<Override>,
    /// Whether impossible points are left out.
    #[serde(default)]
    pub skip_impossible: bool,
    /// The folder.
    pub out: PathBuf,
    /// Whether the user chose the folder.
    pub named: bool,
    /// Treatment of points that are in the folder.
    pub start: Start,
    /// The part to train, as index from 1 and count. Everything by default.
    #[serde(default)]
    pub shard: Option<(usize, usize)>,
    /// Memory in bytes for points that train side by side. Half of what is free by default.
    #[serde(default)]
    pub memory: Option<usize>,
    /// How results are collected.
    #[serde(default)]
    pub results: ResultOptions,
}

impl SweepRequest {
    pub fn read(&self) -> Result<Sweep, Error> {
        Ok(Sweep::read(&self.text, &self.name, &self.set, self.skip_impossible)?)
    }
}

#[derive(Clone, Debug, Serialize)]
pub struct PointOutcome {
    /// The number among all combinations.
    pub point: usize,
    pub folder: String,
    /// The values by axis.
    pub values: BTreeMap<String, Value>,
    /// Why there are no results.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub missing: Option<String>,
    #[serde(flatten)]
    pub found: Option<PointScores>,
    /// The values for people.
    #[serde(skip)]
    pub described: String,
}

/// Results of a finished point.
#[derive(Clone, Debug, Serialize)]
pub struct PointScores {
    pub digest: Option<String>,
    /// G of the champion in the last generation, mean over trials.
    pub champion_g: f64,
    /// The 95 % interval of `champion_g`. None for one trial.
    pub champion_g_interval_95: Option<[f64; 2]>,
    /// G of the best team in the last generation, mean over trials.
    pub best_g: f64,
    /// G of the tested best team in the last generation, mean over trials, if the config has test episodes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test_g: Option<f64>,
    /// The number of trials that reached the G.
    pub reached: usize,
    /// The median generation that reached it.
    pub median: Option<f64>,
}

/// The files that were written.
#[derive(Clone, Debug, Serialize)]
pub struct Files {
    /// The sweep as it was run.
    pub sweep: String,
    /// Every point, trial and generation.
    pub results: String,
    /// Every point.
    pub points: String,
    pub pictures: Vec<String>,
}

#[derive(Clone, Debug, Serialize)]
pub struct SweepOutcome {
    pub folder: String,
    /// The sweep's name.
    pub sweep: String,
    /// The G whose first generation is reported.
    pub reach: f64,
    /// The team whose G is to reach it, and is in pictures.
    pub measure: TeamKind,
    /// Whether files were read that differ from their digests.
    pub unverified: bool,
    pub points: Vec<PointOutcome>,
    pub files: Files,
    /// The results for people.
    #[serde(skip)]
    pub text: String,
}

impl SweepOutcome {
    /// Returns an error that names the points without results, if there are any.
    pub fn missing(&self) -> Option<Error> {
        let missing = |point: &PointOutcome| {
            let why = point.missing.as_ref()?;
            Some(format!("\n  point {:04} ({}): {why}", point.point, point.described))
        };
        let lines: Vec<_> = self.points.iter().filter_map(missing).collect();
        let more = if lines.len() > 20 { "\n  …" } else { "" };
        (!lines.is_empty()).then(|| {
            Error::Missing(
                format!(
                    "{} of {} points are missing from the results:{}{more}",
                    lines.len(),
                    self.points.len(),
                    lines[..lines.len().min(20)].concat(),
                )
                .into(),
            )
        })
    }
}

/// Trains all points, and collects their results.
pub fn run(
    request: &SweepRequest,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<SweepOutcome, Error> {
    let sweep = request.read()?;
    let axes = picture_axes(&sweep, &request.results.axes)?;
    check_measure(&sweep, request.results.measure)?;
    let disk = train(request, &sweep, backends, context)?;
    write_results(request, &sweep, &axes, &disk, disk.at(&request.out))
}

/// Fails if a point's results will not have the measured team.
pub fn check_measure(sweep: &Sweep, measure: TeamKind) -> Result<(), Error> {
    match sweep.points.iter().find_map(|point| Some((point, measure.missing(&point.config)?))) {
        Some((point, why)) => Err(Error::Usage(format!("--measure {measure}: point {:04}: {why}", point.index).into())),
        None => Ok(()),
    }
}

/// Returns the axes that pictures have across and down.
pub fn picture_axes(sweep: &Sweep, names: &[String]) -> Result<Vec<usize>, Error> {
    let find = |name: &String| {
        sweep.axis(name).ok_or_else(|| {
            Error::Usage(format!("--axes: {name} names no single axis of the grid; it has {}", sweep.keys()).into())
        })
    };
    if !names.is_empty() && sweep.axes.iter().any(|axis| axis.varied) {
        return Err(Error::Usage("--axes: a sweep with [vary] has one picture, of all its keys".into()));
    }
    let axes: Vec<usize> = names.iter().map(find).collect::<Result<_, _>>()?;
    match axes[..] {
        [a, b] if a == b => Err(Error::Usage(format!("--axes: {} twice", sweep.axes[a].key).into())),
        _ => Ok(axes),
    }
}

/// Refuses a folder with other content than this sweep.
pub fn same_sweep(sweep: &Sweep, out: &Path) -> Result<(), Error> {
    let path = out.join(SWEEP);
    if out.is_file() {
        return Err(RecordError::no_folder(out).into());
    }
    let refuse = |message: String| {
        let problems = vec![Problem { line: None, key: String::new(), message }];
        Err(ConfigError::Invalid { name: path.escaped(), problems, unlisted: 0 }.into())
    };
    if !runs::exists(&path)? {
        let holds = match runs::exists(&out.join(CONFIG))? {
            true => Some("a run"),
            false => folder::collection(out),
        };
        let products = || pictures::names().chain([folder::RESULTS, folder::POINTS].map(String::from));
        let problem = match holds {
            Some(what) => format!("holds {what}, not a sweep"),
            None => match products().find(|name| out.join(name).exists()) {
                Some(theirs) => format!("holds {theirs} but no {SWEEP}, so it is not the folder of a sweep"),
                None => return Ok(()),
            },
        };
        // Another shard may have marked the folder meanwhile.
        if !runs::exists(&path)? {
            return refuse(format!("{} {problem}; choose another --out", out.escaped()));
        }
    }
    let existing = config::read_file(&path)?;
    // A person may have written the file, so the same sweep may be formatted differently. `skip_impossible` only
    // decides whether impossible points are an error, so it makes no other sweep.
    let normal = |text: &str| Sweep::read(text, SWEEP, &[], true).map(|sweep| sweep.text);
    if existing == sweep.text {
        return Ok(());
    }
    match normal(&existing) {
        Ok(there) if normal(&sweep.text).is_ok_and(|here| here == there) => return Ok(()),
        Ok(_) => {}
        Err(error) => {
            return refuse(format!("{} is damaged; restore it, or choose another --out\n{error}", path.escaped()));
        }
    }
    let missing = |from: &str, other: &str, where_: &str| {
        let known: HashSet<&str> = other.lines().collect();
        let lines: Vec<_> = from.lines().filter(|line| !known.contains(line)).collect();
        let more = if lines.len() > 8 { "\n  …" } else { "" };
        let lines: Vec<_> = lines.iter().take(8).map(|line| format!("\n  {where_}: {line}")).collect();
        lines.concat() + more
    };
    refuse(format!(
        "{} holds another sweep; what differs:{}{}\ncontinue that one with `{}`, or choose another --out",
        out.escaped(),
        missing(&existing, &sweep.text, "there"),
        missing(&sweep.text, &existing, "here"),
        command_to_resume(out),
    ))
}

/// Returns the command that resumes the sweep in a folder with its own file.
pub(super) fn command_to_resume(out: &Path) -> String {
    let [file, out] = [&out.join(SWEEP), out].map(shell::argument);
    shell::command(["flotilla".into(), "sweep".into(), file, "--out".into(), out, "--resume".into()])
}

/// Marks the folder as this sweep's. Shards that start at the same moment write the same content.
pub fn claim(disk: &Disk, sweep: &Sweep, out: &Path) -> Result<(), Error> {
    let path = out.join(SWEEP);
    disk.create_folder(out).map_err(RecordError::write(out))?;
    let disk = disk.within(out).map_err(RecordError::write(out))?;
    if disk.kind(&path).map_err(RecordError::write(&path))?.is_none() {
        let text = |output: &mut dyn io::Write| output.write_all(sweep.text.as_bytes());
        disk.replace_shared(&path, text).map_err(RecordError::write(&path))?;
    }
    same_sweep(sweep, out)
}

/// Checks the numbers of a request. The command line checks its own flags, other callers may not.
fn check(results: &ResultOptions) -> Result<(), Error> {
    match results.every {
        0 => Err(Error::Usage("--every 0: allowed 1 or more".into())),
        _ => Ok(()),
    }
}

/// Opens a sweep's folder for writing. Refuses it if a file to be written there was not made by flotilla.
fn open_folder(out: &Path, named: bool) -> Result<Disk, Error> {
    let disk = ownership::open_output_folder(&Disk::default(), out, named)?;
    let products = pictures::names().chain([folder::RESULTS, folder::POINTS].map(String::from));
    ownership::check(&disk, products.map(|name| out.join(name)))?;
    Ok(disk)
}

/// Trains the points of a request's shard. Returns the disk in the sweep's folder.
pub fn train(
    request: &SweepRequest,
    sweep: &Sweep,
    backends: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<Disk, Error> {
    let out = &*request.out;
    check(&request.results)?;
    let shard = request.shard.map_or(Ok(Shard::WHOLE), |(index, count)| Shard::new(index, count));
    let shard = shard.map_err(|error| Error::Usage(error.into()))?;
    same_sweep(sweep, out)?;
    let points = shard.take(&sweep.points);
    let (backend, machine) = backends.open(Work::of(points.iter().map(|point| &*point.config)))?;
    check_memory(points.iter().map(|point| &point.config), backend)?;
    tell_each(sweep, &points, |point| point.notes.clone(), |line| context.note(format_args!("note: {line}")));
    let unreachable = |point: &Point| unreachable(&point.config);
    tell_each(sweep, &points, unreachable, |line| context.warn(format_args!("warning: {line}")));
    // Before anything is written: the folder may be of another user.
    ownership::create_output_folder(&Disk::default(), out, request.named)?;
    claim(&Disk::default(), sweep, out)?;
    let disk = open_folder(out, request.named)?;
    let memory = request.memory.unwrap_or_else(free_memory);
    let skipped =
        if sweep.skipped > 0 { format!(", {} impossible ones left out", sweep.skipped) } else { String::new() };
    let batches = run::batches(&points, memory).len();
    let batches = if batches > 1 { format!(" in {batches} batches") } else { String::new() };
    let (all, taken) = (sweep.points.len(), points.len());
    let part =
        if shard.count > 1 { format!("shard {shard}: {taken} of {all} points") } else { format!("{all} points") };
    context.message(format_args!("{part}{skipped}{batches}, on {machine}, into {}", out.escaped()));
    let share = |progress: &SweepProgress| {
        let SweepProgress { done, points, batch, generation, last, played, total } = *progress;
        let text =
            format!("{done}/{points} points done, {batch} side by side at generation {}/{last}", generation.min(last));
        (context.report)(Event::Fraction(played as f64 / total.max(1) as f64, text));
    };
    match train_points(context, sweep, &points, out, request.start, &disk, memory, backend, &share)? {
        SessionEnd::Finished => {
            let folder = out.join("points");
            // A shard may have no points.
            if disk.kind(&folder).map_err(RecordError::write(&folder))?.is_some() {
                disk.sync_folder(&folder).map_err(RecordError::write(&folder))?;
            }
            Ok(disk)
        }
        SessionEnd::Stopped => Err(Error::Stopped("everything is saved".into())),
    }
}

/// Trains points of a sweep, each in its folder in `out`, or resumes them. Calls `share` after every generation.
///
/// # Errors
/// A folder cannot be used or written, memory is insufficient, or the backend fails. Earlier progress is saved.
#[expect(clippy::too_many_arguments, reason = "the two callers have no more of them in common")]
pub fn train_points(
    context: Context<'_>,
    sweep: &Sweep,
    points: &[&Point],
    out: &Path,
    start: Start,
    disk: &Disk,
    memory: usize,
    backend: &mut OpenBackend,
    share: &dyn Fn(&SweepProgress),
) -> Result<SessionEnd, Error> {
    let total = points.iter().map(|point| run::team_steps(&point.config)).sum();
    let mut progress = SweepProgress { points: points.len(), total, ..SweepProgress::default() };
    // All folders are checked first, so that no batch trains before a later one is refused.
    let folders: Vec<PathBuf> = points.iter().map(|point| results::point_folder(out, point)).collect();
    let configs = points.iter().map(|point| &*point.config);
    folder::check(disk, folders.iter().map(|path| &**path).zip(configs), start).map_err(RunError::from)?;
    let mut ended = SessionEnd::Finished;
    for batch in run::batches(points, memory) {
        if context.is_stopped() {
            ended = SessionEnd::Stopped;
            break;
        }
        let runs = batch.iter().map(|point| (Config::clone(&point.config), results::point_folder(out, point)));
        let (mut session, notes) = Session::open(runs.collect(), start, disk)?;
        // Every resumed point has a note. Only damage is reported.
        for (run, note) in notes.iter().filter(|(_, note)| note.is_damage) {
            context.warn(format_args!("{}: {note}", sweep.describe(batch[*run])));
        }
        // Steps of earlier sessions do not count.
        let resumed: u128 =
            batch.iter().zip(session.generations()).map(|(point, &next)| run::played(point, next)).sum();
        progress.total -= resumed;
        let (done, before) = (progress.done, progress.played);
        let mut tell = |generations: &[usize]| {
            let all = || batch.iter().zip(generations);
            let going = || all().filter(|(point, next)| **next <= run::last(point) + 1);
            progress.batch = going().count();
            progress.done = done + batch.len() - progress.batch;
            progress.generation = going().map(|(_, &next)| next).min().unwrap_or(progress.last + 1);
            progress.last = batch.iter().map(|point| run::last(point)).max().unwrap_or(0);
            progress.played = before + all().map(|(point, &next)| run::played(point, next)).sum::<u128>() - resumed;
            share(&progress);
        };
        tell(session.generations());
        let mut watch = |now: &Progress<'_>| tell(now.generations);
        if !session.is_done() {
            ended = context.train(&mut watch, |options| session.train(backend, options))?;
        }
        if ended == SessionEnd::Stopped {
            break;
        }
    }
    context.pause();
    Ok(ended)
}

/// Maximum number of POIs that are named one by one.
const MAX_NAMED_POIS: usize = 6;

/// Tells the lines about the points of a sweep, each line once.
fn tell_each(sweep: &Sweep, points: &[&Point], lines: impl Fn(&Point) -> Vec<String>, tell: impl Fn(String)) {
    let mut found: BTreeMap<String, (usize, String)> = BTreeMap::new();
    for point in points {
        for line in lines(point) {
            found.entry(line).or_insert_with(|| (0, sweep.describe(point))).0 += 1;
        }
    }
    for (line, (count, first)) in found.iter().take(2 * MAX_NAMED_POIS) {
        tell(format!("{line}; at {count} of {} points, the first {first}", points.len()));
    }
    if let more @ 1.. = found.len().saturating_sub(2 * MAX_NAMED_POIS) {
        tell(format!("… and {more} more; `flotilla check` lists those of one config"));
    }
}

/// Returns a line for each POI of a config that no team can observe, and advice.
pub(crate) fn unreachable(config: &ValidConfig) -> Vec<String> {
    let staged = config.stages();
    let mut lines = Vec::new();
    for (index, (_, config)) in staged.iter().enumerate() {
        let place = if staged.len() > 1 { format!("stage {index}: ") } else { String::new() };
        let found = reach::unreachable(config);
        let mut reasons: Vec<(&Unreachable, Vec<usize>)> = vec![];
        for unreachable in &found {
            match reasons.iter_mut().find(|(first, _)| first.same_reason(unreachable)) {
                Some((_, others)) => others.push(unreachable.poi),
                None => reasons.push((unreachable, vec![])),
            }
        }
        lines.extend(
            reasons
                .iter()
                .take(MAX_NAMED_POIS)
                .map(|(first, others)| format!("{place}{first}{}", further_pois(others))),
        );
        if let more @ 1.. = reasons.iter().skip(MAX_NAMED_POIS).map(|(_, others)| 1 + others.len()).sum::<usize>() {
            lines.push(format!("{place}{more} more POIs cannot be observed"));
        }
        if let Some(steps) = reach::fewest_steps(config, &found) {
            lines.push(format!(
                "{place}to reach these POIs, set world.steps to at least {steps}, raise the `max_speed` of agents, or let \
                 them start nearer"
            ));
        }
    }
    lines
}

/// Names more POIs to which a warning applies: "; the same holds for POIs 1, 2 and 3".
fn further_pois(pois: &[usize]) -> String {
    match pois {
        [] => String::new(),
        [poi] => format!("; the same holds for POI {poi}"),
        [pois @ .., last] => {
            let pois: Vec<String> = pois.iter().map(ToString::to_string).collect();
            format!("; the same holds for POIs {} and {last}", pois.join(", "))
        }
    }
}

/// Returns half of the memory that is free now in bytes, or 2 GiB if the system does not report it.
pub fn free_memory() -> usize {
    memory::available().map_or(2 << 30, |bytes| (bytes / 2) as usize)
}

/// Collects the results that exist, and draws them.
pub fn collect(request: &SweepRequest, sweep: &Sweep, axes: &[usize]) -> Result<SweepOutcome, Error> {
    let out = &*request.out;
    if !runs::exists(&out.join(SWEEP))? {
        return Err(Error::Usage(format!("{} holds no sweep", out.escaped()).into()));
    }
    same_sweep(sweep, out)?;
    check(&request.results)?;
    let disk = open_folder(out, request.named)?;
    // Points may be links to runs elsewhere.
    write_results(request, sweep, axes, &disk, out.into())
}

/// Writes the results of the points in `place`, which is the sweep's folder, and the pictures.
fn write_results(
    request: &SweepRequest,
    sweep: &Sweep,
    axes: &[usize],
    disk: &Disk,
    place: Place<'_>,
) -> Result<SweepOutcome, Error> {
    let out = place.path();
    let options = &request.results;
    let &ResultOptions { every, reach, measure, unverified, .. } = options;
    let folders: Vec<PathBuf> = sweep.points.iter().map(|point| results::point_folder(out, point)).collect();
    let outcomes = results::write(sweep, place, options, disk)?;
    let (pictures, note) = pictures::draw(sweep, &outcomes, options, axes, out, disk)?;
    disk.sync_folder(out).map_err(RecordError::write(out))?;
    let mut text = summary(sweep, &outcomes, options);
    let rows = if every == 1 { "generation by generation".into() } else { format!("every {every} generations") };
    let _ = write!(
        text,
        "\nFiles in {}:\n  points/      the runs themselves\n  results.csv  every point and trial, {rows}\n  points.csv   the result of each point\n",
        out.escaped(),
    );
    if pictures.is_empty() {
    } else if sweep.axes.iter().any(|axis| axis.varied) {
        text += "  final (.svg, .png, .pdf)   G at the end, by each value of each varied key\n";
    } else {
        text +=
            "  final, reach, curves (.svg, .png, .pdf)   G at the end, generations to reach one, and learning curves\n";
    }
    text.extend(note.map(|note| note + "\n"));
    text += &if unverified { format!("{UNVERIFIED}\n") } else { String::new() };
    let path = |name: &str| out.join(name).escaped();
    let point = |((point, outcome), folder): ((&Point, &Result<PointResults, Missing>), &PathBuf)| PointOutcome {
        point: point.index,
        folder: folder.escaped(),
        values: (sweep.axes.iter().zip(&point.values))
            .map(|(axis, &value)| (axis.key.clone(), serde_json::json!(axis.values[value])))
            .collect(),
        missing: outcome.as_ref().err().map(ToString::to_string),
        found: outcome.as_ref().ok().map(|outcome| PointScores {
            digest: Run::read(place.at(&folder.join(RUN))).ok().and_then(|run| run.digest),
            champion_g: outcome.champion.mean(),
            champion_g_interval_95: statistics::bounded(&outcome.champion, [0.0, 1.0])
                .map(|mean| [mean.low, mean.high]),
            best_g: outcome.best.mean(),
            test_g: outcome.test.map(|test| test.mean()),
            reached: outcome.reached.iter().flatten().count(),
            median: outcome.median_reached(),
        }),
        described: sweep.describe(point),
    };
    Ok(SweepOutcome {
        folder: out.escaped(),
        sweep: sweep.name.clone(),
        reach,
        measure,
        unverified,
        points: sweep.points.iter().zip(&outcomes).zip(&folders).map(point).collect(),
        files: Files {
            sweep: path(SWEEP),
            results: path(folder::RESULTS),
            points: path(folder::POINTS),
            pictures: pictures.iter().map(|name| path(name)).collect(),
        },
        text,
    })
}

/// Returns the results for people: the best and the worst points.
fn summary(sweep: &Sweep, outcomes: &[Result<PointResults, Missing>], options: &ResultOptions) -> String {
    const LISTED: usize = 12;
    let done = sweep.points.iter().zip(outcomes).filter_map(|(point, outcome)| Some((point, outcome.as_ref().ok()?)));
    let mut done: Vec<_> = done.map(|(point, outcome)| (outcome.measured(), point, outcome)).collect();
    done.sort_by(|(a, ..), (b, ..)| b.mean().total_cmp(&a.mean()));
    let mut text = format!(
        "{} of {} points are done. {} in the last generation, mean over trials with its 95 % interval,\n\
         and the median generation that reached G = {}:\n",
        done.len(),
        sweep.points.len(),
        options.measure.label(),
        options.reach
    );
    for (at, (measured, point, outcome)) in done.iter().enumerate() {
        if done.len() > LISTED && at == LISTED / 2 {
            let _ = writeln!(text, "  … ({} more)", done.len() - LISTED);
        }
        if done.len() <= LISTED || at < LISTED / 2 || at >= done.len() - LISTED / 2 {
            let reached = outcome.median_reached().map_or("not reached".into(), |median| median.to_string());
            let mean = match statistics::bounded(measured, [0.0, 1.0]) {
                Some(mean) => comparison::estimate(mean, 3, false),
                None => format!("{:.3}", measured.mean()),
            };
            let _ = writeln!(text, "  {mean}  {reached:>11}  {}", sweep.describe(point));
        }
    }
    text
}

/// Reads a run's config. If the folder is a sweep's, the error lists its points with their values.
pub(super) fn config_of_run(folder: &Path, verification: Verification) -> Result<Config, Error> {
    runs::config(folder, verification).map_err(|error| match error {
        ReadError::Collection { what: "a sweep", .. } => match Sweep::load(&folder.join(SWEEP), &[], false) {
            Ok(sweep) => Error::Refused(list_points(&sweep, folder).into()),
            Err(error) => error.into(),
        },
        error => error.into(),
    })
}

fn list_points(sweep: &Sweep, folder: &Path) -> String {
    let mut text = format!("{} holds a sweep; name one of its points:", folder.escaped());
    for point in sweep.points.iter().take(MAX_LISTED_POINTS) {
        let _ = write!(text, "\n  {}  {}", results::point_folder(folder, point).escaped(), sweep.describe(point));
    }
    if let more @ 1.. = sweep.points.len().saturating_sub(MAX_LISTED_POINTS) {
        let _ = write!(text, "\n  … and {more} more");
    }
    text
}
