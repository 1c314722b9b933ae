//! `flotilla sweep`: trains a grid of runs, on one machine or many.

use std::collections::HashSet;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::recovery::{self, Loss, Signals};
use super::{Error, Overrides, RunOptions, backend, between, output, print, print_json, say, warnings, whole};
use crate::config::{self, ConfigError, Problem};
use crate::escape::PathExt;
use crate::file;
use crate::memory;
use crate::record::RecordError;
use crate::record::digests::{self, UNVERIFIED, Verification};
use crate::record::disk::Disk;
use crate::record::folder::{self, CONFIG, RUN, Run, SWEEP, Start};
use crate::record::ownership;
use crate::report::progress::Meter;
use crate::run::{Ended, Options, RunError};
use crate::shell;
use crate::sweep::pictures;
use crate::sweep::results::{self, Missing, Outcome};
use crate::sweep::run::{self, SweepProgress};
use crate::sweep::shard::{self, MAX_SHARDS, Shard};
use crate::sweep::slurm::Job;
use crate::sweep::{Point, Sweep};

const SCALE_OUT: &str = "Many processes (docs/how-to/clusters.md)";
const RESULTS: &str = "Results";

#[derive(clap::Args)]
pub struct Args {
    /// Sweep file: a config with a section [grid] of lists of values, or [vary] of keys to change one at a time; - is
    /// standard input
    sweep: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
    #[command(flatten)]
    run: RunOptions,
    /// Output directory, the same for all shards [default: runs/NAME of the sweep]
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Resume the points in the directory, and start the missing ones
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Write over this sweep's points in the folder
    #[arg(long)]
    force: bool,
    /// Leave out points that cannot run, as a coupling above the number of agents
    #[arg(long)]
    skip_impossible: bool,
    /// Print the points, what each costs and which shard takes it, and run none
    #[arg(long)]
    list: bool,
    /// Memory for the points that train side by side, in GiB [default: half of what is free]
    #[arg(long, value_name = "GIB", value_parser = positive)]
    memory: Option<f64>,
    /// No progress on standard error
    #[arg(long, short)]
    quiet: bool,
    /// Print the results as one JSON object (docs/reference/json.md)
    #[arg(long, conflicts_with_all = ["list", "slurm"])]
    json: bool,
    #[command(flatten)]
    loss: Loss,

    /// Run shard I of N, dealt out by cost; else what a Slurm array or a Kubernetes indexed job says
    #[arg(long, value_name = "I/N", allow_hyphen_values = true, help_heading = SCALE_OUT)]
    shard: Option<Shard>,
    /// Put the results of all shards together and say which points are missing
    #[arg(long, conflicts_with_all = ["shard", "resume", "force", "list", "slurm"], help_heading = SCALE_OUT)]
    collect: bool,
    /// Write the batch script of a Slurm job array to standard output, or to =FILE
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true, conflicts_with_all = ["shard", "force", "list"], help_heading = SCALE_OUT)]
    slurm: Option<Option<PathBuf>>,
    /// Tasks of the job array, or shards that --list deals out
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = shard_count, help_heading = SCALE_OUT)]
    shards: usize,
    /// Time limit of a task of the job array
    #[arg(long, value_name = "HH:MM:SS", default_value = "01:00:00", value_parser = time_limit, help_heading = SCALE_OUT)]
    time: String,
    /// GPUs of a task of the job array [default: 1, or 0 with --backend cpu]
    #[arg(long, value_name = "N", value_parser = whole, help_heading = SCALE_OUT)]
    gpus: Option<usize>,
    /// One more option of the batch script: --sbatch=--partition=long; may be given more than once
    #[arg(long, value_name = "OPTION", allow_hyphen_values = true, value_parser = an_option, help_heading = SCALE_OUT)]
    sbatch: Vec<String>,

    /// A row of results.csv every N generations, and one for the last
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = between(1..=u32::MAX), help_heading = RESULTS)]
    every: u32,
    /// G for which the first generation is reported, 0 to 1
    #[arg(long, value_name = "G", default_value_t = 0.75, value_parser = share, help_heading = RESULTS)]
    reach: f64,
    /// Read points' files that differ from their digests in run.json, too, and mark what comes out
    #[arg(long, requires = "collect", help_heading = RESULTS)]
    unverified: bool,
    /// The two axes of the pictures, across and down [default: the first two of the grid]
    #[arg(long, value_name = "AXIS,AXIS", value_delimiter = ',', num_args = 1..=2, help_heading = RESULTS)]
    axes: Vec<String>,
}

fn positive(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value| *value > 0.0 && *value < 1e9).ok_or_else(|| "allowed a number above 0".into())
}

pub(super) fn share(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value| (0.0..=1.0).contains(value)).ok_or_else(|| "allowed a number in 0..1".into())
}

fn shard_count(text: &str) -> Result<usize, String> {
    let count = text.parse().ok().filter(|count| (1..=MAX_SHARDS).contains(count));
    count.ok_or_else(|| format!("allowed 1 to {MAX_SHARDS}"))
}

/// Parses a Slurm time limit: minutes, M:S, H:M:S, days-hours and so on.
fn time_limit(text: &str) -> Result<String, String> {
    let number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let (days, clock) = text.split_once('-').unwrap_or(("0", text));
    if number(days) && clock.split(':').all(number) && clock.split(':').count() <= 3 {
        Ok(text.into())
    } else {
        Err("allowed a Slurm time limit: 01:30:00, or 2-12 for 2 days and 12 hours".into())
    }
}

fn an_option(text: &str) -> Result<String, String> {
    match text.starts_with('-') {
        true => Ok(text.into()),
        false => Err("allowed an option of sbatch: --partition=long".into()),
    }
}

impl Args {
    fn shard(&self) -> Result<Option<Shard>, Error> {
        match self.shard {
            Some(shard) => Ok(Some(shard)),
            None => Shard::from_env(|name| std::env::var(name).ok()).map_err(Error::Usage),
        }
    }

    fn out(&self, sweep: &Sweep) -> PathBuf {
        self.out.clone().unwrap_or_else(|| Path::new("runs").join(&sweep.name))
    }

    /// Returns the arguments that run this sweep again, without those that differ between processes.
    fn words(&self, sweep: &Path, out: &Path) -> Vec<OsString> {
        let mut words = vec!["sweep".into(), shell::argument(sweep), "--out".into(), shell::argument(out)];
        words.extend(recovery::words_of(&self.overrides.list()));
        words.extend(recovery::words_of_machine(&self.run, self.loss));
        words.extend(self.memory.into_iter().flat_map(|gib| ["--memory".into(), gib.to_string().into()]));
        if self.skip_impossible {
            words.push("--skip-impossible".into());
        }
        words
    }

    /// Returns a command line of this sweep with more flags.
    fn command(&self, out: &Path, more: &[&str]) -> String {
        let words = self.words(&self.sweep, out);
        let more = more.iter().map(OsString::from);
        shell::command([OsString::from("flotilla")].into_iter().chain(words).chain(more))
    }

    /// Returns the axes that pictures have across and down.
    fn picture_axes(&self, sweep: &Sweep) -> Result<Vec<usize>, Error> {
        let find = |name: &String| {
            let keys = || sweep.axes.iter().map(|axis| &*axis.key).collect::<Vec<_>>().join(", ");
            let unknown = || Error::Usage(format!("--axes: {name} is no axis of the grid; it has {}", keys()));
            sweep.axis(name).ok_or_else(unknown)
        };
        if !self.axes.is_empty() && sweep.axes.iter().any(|axis| axis.varied) {
            return Err(Error::Usage("--axes: a sweep with [vary] has one picture, of all its keys".into()));
        }
        let axes: Vec<usize> = self.axes.iter().map(find).collect::<Result<_, _>>()?;
        match axes[..] {
            [a, b] if a == b => Err(Error::Usage(format!("--axes: {} twice", sweep.axes[a].key))),
            _ => Ok(axes),
        }
    }
}

pub fn run(mut args: Args) -> Result<(), Error> {
    let sweep = Sweep::load(&args.sweep, &args.overrides.list(), args.skip_impossible)?;
    let out = args.out(&sweep);
    if config::is_standard_input(&args.sweep) {
        // Later commands cannot read standard input again, so they use the copy in the folder.
        args.sweep = out.join(SWEEP);
    }
    let axes = args.picture_axes(&sweep)?;
    if let Some(file) = &args.slurm {
        return write_script(&args, &sweep, &out, file.as_deref());
    }
    if args.list {
        return list(&sweep, args.shards);
    }
    if args.collect {
        if !there(&out.join(SWEEP))? {
            let command = args.command(&out, &["--shard", "1/N"]);
            return Err(Error::Usage(format!("{} holds no sweep; run its shards first: {command}", out.escaped())));
        }
        same_sweep(&sweep, &out)?;
        return collect(&args, &sweep, &out, &axes);
    }
    let shard = args.shard()?;
    same_sweep(&sweep, &out)?;
    train(&args, &sweep, &out, shard.unwrap_or(Shard::WHOLE))?;
    match shard.filter(|shard| shard.count > 1) {
        None => collect(&args, &sweep, &out, &axes),
        Some(shard) => {
            let command = args.command(&out, &["--collect"]);
            match args.json {
                true => print_json(&json!({
                    "folder": out.escaped().to_string(),
                    "sweep": sweep.name,
                    "shard": shard.to_string(),
                    "collect": command,
                })),
                false => print(&format!("When all shards are done: {command}\n")),
            }
        }
    }
}

/// Returns whether a file exists, or an error if the system does not allow checking that.
fn there(path: &Path) -> Result<bool, RecordError> {
    file::exists(path).map_err(|error| RecordError::Read { path: path.into(), error })
}

/// Refuses a folder with other content than this sweep.
pub(super) fn same_sweep(sweep: &Sweep, out: &Path) -> Result<(), Error> {
    let path = out.join(SWEEP);
    if out.is_file() {
        return Err(RecordError::NoFolder { path: out.into() }.into());
    }
    let refuse = |message: String| {
        let problems = vec![Problem { line: None, key: String::new(), message }];
        Err(ConfigError::Invalid { name: path.escaped().to_string(), problems, unlisted: 0 }.into())
    };
    if !there(&path)? {
        let holds = match there(&out.join(CONFIG))? {
            true => Some("a run"),
            false => folder::collection(out),
        };
        if let Some(what) = holds {
            return refuse(format!("{} holds {what}, not a sweep; choose another --out", out.escaped()));
        }
        return match pictures::names()
            .chain([folder::RESULTS, folder::POINTS].map(String::from))
            .find(|name| out.join(name).exists())
        {
            Some(theirs) => refuse(format!(
                "{} holds {theirs}, but no {SWEEP}, which would say that it is a sweep's; choose another --out",
                out.escaped()
            )),
            None => Ok(()),
        };
    }
    let there = config::read_file(&path)?;
    // A person may have written the file, so the same sweep may be formatted differently.
    let normal = |text: &str| Some(Sweep::read(text, SWEEP, &[], sweep.skipped > 0).ok()?.text);
    if there == sweep.text || normal(&there).as_ref() == Some(&sweep.text) {
        return Ok(());
    }
    let missing = |from: &str, other: &str, where_: &str| {
        let known: HashSet<&str> = other.lines().collect();
        let lines: Vec<_> = from.lines().filter(|line| !known.contains(line)).collect();
        let more = if lines.len() > 8 { "\n  …" } else { "" };
        let lines: Vec<_> = lines.iter().take(8).map(|line| format!("\n  {where_}: {line}")).collect();
        lines.concat() + more
    };
    refuse(format!(
        "{} holds another sweep; what differs:{}{}\nchoose another --out",
        out.escaped(),
        missing(&there, &sweep.text, "there"),
        missing(&sweep.text, &there, "here"),
    ))
}

/// Marks the folder as this sweep's. Shards that start at the same moment write the same content.
pub(super) fn claim(disk: &Disk, sweep: &Sweep, out: &Path) -> Result<(), Error> {
    let failed = |path: &Path| {
        let path = path.to_path_buf();
        move |error| RecordError::Write { path, error }
    };
    let path = out.join(SWEEP);
    disk.create_folder(out).map_err(failed(out))?;
    let disk = disk.within(out).map_err(failed(out))?;
    if disk.kind(&path).map_err(failed(&path))?.is_none() {
        let text = |output: &mut dyn io::Write| output.write_all(sweep.text.as_bytes());
        disk.replace_shared(&path, text, || Ok(())).map_err(failed(&path))?;
    }
    same_sweep(sweep, out)
}

/// Enters a sweep's folder. Refuses it if a file to be written there was not made by flotilla.
fn enter(args: &Args, out: &Path) -> Result<Disk, Error> {
    let disk = ownership::enter(&Disk::default(), out, args.out.is_some())?;
    let products = pictures::names().chain([folder::RESULTS, folder::POINTS].map(String::from));
    ownership::check(&disk, products.map(|name| out.join(name)))?;
    Ok(disk)
}

fn train(args: &Args, sweep: &Sweep, out: &Path, shard: Shard) -> Result<(), Error> {
    let points = shard.take(&sweep.points);
    let mut player = backend::open(&args.run)?;
    for point in &points {
        let plan = memory::Peaks::of([&point.config], rayon::current_num_threads());
        plan.check(player.1.backend == "gpu").map_err(RunError::from)?;
    }
    warnings::unreachable_in(sweep, &points);
    claim(&Disk::default(), sweep, out)?;
    let disk = enter(args, out)?;
    let memory = args.memory.map_or_else(free_memory, |gib| (gib * f64::from(1 << 30)) as usize);
    if !args.quiet {
        let skipped =
            if sweep.skipped > 0 { format!(", {} impossible ones left out", sweep.skipped) } else { String::new() };
        let batches = run::batches(&points, memory).len();
        let batches = if batches > 1 { format!(" in {batches} batches") } else { String::new() };
        let (all, taken) = (sweep.points.len(), points.len());
        let part =
            if shard.count > 1 { format!("shard {shard}: {taken} of {all} points") } else { format!("{all} points") };
        say(format_args!("{part}{skipped}{batches}, on {}, into {}", player.0.describe(), out.escaped()));
    }
    let signals = Signals::listen()?;
    let start = match (args.resume, args.force) {
        (true, _) => Start::Resume,
        (_, true) => Start::Force,
        _ => Start::Fresh,
    };
    let mut ticker = Ticker::new(args.quiet);
    let mut options = run::SweepOptions {
        start,
        disk: &disk,
        memory,
        runs: Options {
            command: &recovery::typed(),
            stop: &signals.stop,
            save: &signals.save,
            instead: &mut |error| args.loss.instead(error),
            setback: &mut recovery::setback,
            watch: &mut |_| {},
        },
        watch: &mut |progress| ticker.tick(progress),
        note: &mut |point, note| {
            // Every resumed point has a note. Only damage is reported.
            if note.is_damage() {
                say(format_args!("{}: {note}", sweep.describe(point)));
            }
        },
    };
    let ended = run::run(&points, out, &mut player, &mut options);
    ticker.clear();
    match ended? {
        Ended::Done => Ok(()),
        Ended::Stopped => {
            let shard = (shard.count > 1).then(|| shard.to_string());
            let mut more: Vec<&str> = shard.iter().flat_map(|shard| ["--shard", shard]).collect();
            let (every, reach, axes) = (args.every.to_string(), args.reach.to_string(), args.axes.join(","));
            if shard.is_none() {
                for (flag, value, default) in
                    [("--every", &every, "1"), ("--reach", &reach, "0.75"), ("--axes", &axes, "")]
                {
                    if value != default {
                        more.extend([flag, value]);
                    }
                }
            }
            more.push("--resume");
            let command = args.command(out, &more);
            Err(Error::Stopped(format!("everything is saved; go on with\n  {command}")))
        }
    }
}

/// Returns half of the memory that is free now in bytes, or 2 GiB if the system does not report it.
pub(super) fn free_memory() -> usize {
    memory::available().map_or(2 << 30, |bytes| (bytes / 2) as usize)
}

/// Collects the results that exist, draws them, and fails if some are missing.
fn collect(args: &Args, sweep: &Sweep, out: &Path, axes: &[usize]) -> Result<(), Error> {
    enter(args, out)?;
    let verification = Verification::unless(args.unverified);
    let options = results::Detail { every: args.every as usize, reach: args.reach, verification };
    let folders: Vec<PathBuf> = sweep.points.iter().map(|point| results::point_folder(out, point)).collect();
    digests::without(folders.iter().map(|folder| &**folder)).into_iter().for_each(say);
    let outcomes = results::write(sweep, out, &options)?;
    let (names, note) = pictures::draw(sweep, &outcomes, &options, axes, out)?;
    match args.json {
        true => print_json(&as_json(sweep, &outcomes, &options, out, &names))?,
        false => {
            let mut text = summary(sweep, &outcomes, &options);
            let _ = write!(
                text,
                "\nFiles in {}:\n  points/      the runs themselves\n  results.csv  every point and trial, {}\n  points.csv   what each point came to\n",
                out.escaped(),
                if options.every == 1 {
                    "generation by generation".into()
                } else {
                    format!("every {} generations", options.every)
                },
            );
            if names.is_empty() {
            } else if sweep.axes.iter().any(|axis| axis.varied) {
                text += "  final (.svg, .png, .pdf)   G at the end, by each value of each varied key\n";
            } else {
                text += "  final, reach, curves (.svg, .png, .pdf)   G at the end, generations to reach one, and learning curves\n";
            }
            text.extend(note.map(|note| note + "\n"));
            text += &if args.unverified { format!("{UNVERIFIED}\n") } else { String::new() };
            print(&text)?;
        }
    }
    let missing: Vec<(&Point, &Missing)> = sweep
        .points
        .iter()
        .zip(&outcomes)
        .filter_map(|(point, outcome)| Some((point, outcome.as_ref().err()?)))
        .collect();
    if missing.is_empty() {
        return Ok(());
    }
    let lines: Vec<_> = missing
        .iter()
        .take(20)
        .map(|(point, why)| format!("\n  point {:04} ({}): {why}", point.index, sweep.describe(point)))
        .collect();
    let more = if missing.len() > lines.len() { "\n  …" } else { "" };
    Err(Error::Missing(format!(
        "{} of {} points are missing from the results:{}{more}\nrun them with: {}",
        missing.len(),
        sweep.points.len(),
        lines.concat(),
        args.command(out, &["--resume"]),
    )))
}

/// Returns the results for programs.
fn as_json(
    sweep: &Sweep,
    outcomes: &[Result<Outcome, Missing>],
    options: &results::Detail,
    out: &Path,
    pictures: &[String],
) -> serde_json::Value {
    let path = |name: &str| out.join(name).escaped().to_string();
    let point = |(point, outcome): (&Point, &Result<Outcome, Missing>)| {
        let values =
            sweep.axes.iter().zip(&point.values).map(|(axis, &value)| (axis.key.clone(), json!(axis.values[value])));
        let folder = results::point_folder(out, point);
        let mut told = json!({
            "point": point.index,
            "folder": folder.escaped().to_string(),
            "values": serde_json::Map::from_iter(values),
        });
        match outcome {
            Err(missing) => told["missing"] = json!(missing.to_string()),
            Ok(outcome) => {
                told["digest"] = json!(Run::read(&folder.join(RUN)).ok().and_then(|run| run.digest));
                told["best_g"] = json!(outcome.best().mean());
                told["best_g_error"] = json!(outcome.best().error());
                told["champion_g"] = json!(outcome.champion().mean());
                told["reached"] = json!(outcome.reached.iter().flatten().count());
                told["median"] = json!(outcome.median_reached());
            }
        }
        told
    };
    json!({
        "folder": out.escaped().to_string(),
        "sweep": sweep.name,
        "reach": options.reach,
        "unverified": options.verification.is_skipped(),
        "points": sweep.points.iter().zip(outcomes).map(point).collect::<Vec<_>>(),
        "files": {
            "sweep": path(SWEEP),
            "results": path("results.csv"),
            "points": path("points.csv"),
            "pictures": pictures.iter().map(|name| path(name)).collect::<Vec<_>>(),
        },
    })
}

/// Returns the results for people: the best and the worst points.
fn summary(sweep: &Sweep, outcomes: &[Result<Outcome, Missing>], options: &results::Detail) -> String {
    const LISTED: usize = 12;
    let done = sweep.points.iter().zip(outcomes).filter_map(|(point, outcome)| Some((point, outcome.as_ref().ok()?)));
    let mut done: Vec<_> = done.map(|(point, outcome)| (outcome.best(), point, outcome)).collect();
    done.sort_by(|(a, ..), (b, ..)| b.mean().total_cmp(&a.mean()));
    let mut text = format!(
        "{} of {} points are done. G of the best team in the last generation, mean over trials ± standard error,\n\
         and the median generation that reached G = {}:\n",
        done.len(),
        sweep.points.len(),
        options.reach
    );
    for (at, (best, point, outcome)) in done.iter().enumerate() {
        if done.len() > LISTED && at == LISTED / 2 {
            let _ = writeln!(text, "  … ({} more)", done.len() - LISTED);
        }
        if done.len() <= LISTED || at < LISTED / 2 || at >= done.len() - LISTED / 2 {
            let reached = outcome.median_reached().map_or("never".into(), |median| median.to_string());
            let (mean, error) = (best.mean(), best.error());
            let _ = writeln!(text, "  {mean:.3} ± {error:.3}  {reached:>6}  {}", sweep.describe(point));
        }
    }
    text
}

fn list(sweep: &Sweep, shards: usize) -> Result<(), Error> {
    let total: u128 = sweep.points.iter().map(shard::cost).sum();
    let of = shard::deal(&sweep.points, shards);
    let mut loads = vec![0; shards];
    sweep.points.iter().zip(&of).for_each(|(point, shard)| loads[shard - 1] += shard::cost(point));
    let part = |cost: u128| cost as f64 * 100.0 / total.max(1) as f64;
    let mut text = String::from("point  cost %  shard  \n");
    for (point, shard) in sweep.points.iter().zip(of) {
        let _ = writeln!(
            text,
            "{:04}   {:>6.2}  {shard:>5}  {}",
            point.index,
            part(shard::cost(point)),
            sweep.describe(point)
        );
    }
    let (least, most) = (loads.iter().min().copied().unwrap_or(0), loads.iter().max().copied().unwrap_or(0));
    let _ = writeln!(
        text,
        "{} points, {} left out; shards cost {:.2} to {:.2} % each",
        sweep.points.len(),
        sweep.skipped,
        part(least),
        part(most)
    );
    print(&text)
}

fn write_script(args: &Args, sweep: &Sweep, out: &Path, file: Option<&Path>) -> Result<(), Error> {
    output::check(&[("--slurm", file)], &[&args.sweep])?;
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.into());
    let out = absolute(out);
    let cpu = args.run.backend == super::BackendChoice::Cpu;
    let command =
        [super::program().into_os_string()].into_iter().chain(args.words(&absolute(&args.sweep), &out)).collect();
    let job = Job {
        name: &sweep.name,
        command,
        out: &out,
        shards: args.shards,
        time: &args.time,
        gpus: args.gpus.unwrap_or(usize::from(!cpu)),
        cpus: args.run.threads.map_or(2, usize::from),
        options: &args.sbatch,
    };
    let script = job.script().map_err(Error::Usage)?;
    // Slurm writes the tasks' logs to this folder, but does not create it.
    claim(&Disk::default(), sweep, &out)?;
    match file {
        None => print(&script),
        Some(path) => {
            output::write(path, |output| output.write_all(script.as_bytes()))?;
            say(format_args!("submit it with: sbatch {}", path.escaped()));
            Ok(())
        }
    }
}

/// Shows the progress of the points.
struct Ticker(Meter);

impl Ticker {
    fn new(quiet: bool) -> Ticker {
        Ticker(Meter::new(quiet))
    }

    fn tick(&mut self, progress: &SweepProgress) {
        let SweepProgress { done, points, batch, generation, last, played, total } = *progress;
        self.0.show(played as f64 / total.max(1) as f64, || {
            format!("{done}/{points} points done, {batch} side by side at generation {}/{last}", generation.min(last))
        });
    }

    fn clear(&self) {
        self.0.clear();
    }
}
