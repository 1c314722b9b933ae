//! `flotilla sweep`: a grid of runs, on one machine or many.

use std::fmt::Write as _;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use super::train::Signals;
use super::{Error, Overrides, RunOptions, backend, output, print, say};
use crate::config::{self, ConfigError, Problem};
use crate::file;
use crate::memory;
use crate::record::RecordError;
use crate::record::disk;
use crate::record::folder::{CONFIG, SWEEP, Start};
use crate::report::progress::Meter;
use crate::sweep::pictures;
use crate::sweep::results::{self, Missing, Outcome};
use crate::sweep::run::{self, Ended, Progress};
use crate::sweep::shard::{self, MAX_SHARDS, Shard};
use crate::sweep::slurm::Job;
use crate::sweep::{Point, Sweep};

const SCALE_OUT: &str = "Many processes (docs/sweeps.md)";
const RESULTS: &str = "Results";

#[derive(clap::Args)]
pub struct Args {
    /// Sweep file: a config with a section [grid] of lists of values; - is standard input
    sweep: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
    #[command(flatten)]
    run: RunOptions,
    /// Folder for what comes out, the same for all shards [default: runs/NAME of the sweep]
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Go on with the points in the folder, and start those that are not there
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

    /// Run shard I of N, dealt out by cost; else what a Slurm array or a Kubernetes indexed job says
    #[arg(long, value_name = "I/N", help_heading = SCALE_OUT)]
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
    #[arg(long, value_name = "N", help_heading = SCALE_OUT)]
    gpus: Option<usize>,
    /// One more option of the batch script: --sbatch=--partition=long; may be given more than once
    #[arg(long, value_name = "OPTION", allow_hyphen_values = true, value_parser = an_option, help_heading = SCALE_OUT)]
    sbatch: Vec<String>,

    /// A row of results.csv every N generations, and one for the last
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..), help_heading = RESULTS)]
    every: u32,
    /// G whose first generation is told, in 0..1
    #[arg(long, value_name = "G", default_value_t = 0.75, value_parser = share, help_heading = RESULTS)]
    reach: f64,
    /// The two axes of the pictures, across and down [default: the first two of the grid]
    #[arg(long, value_name = "AXIS,AXIS", value_delimiter = ',', num_args = 1..=2, help_heading = RESULTS)]
    axes: Vec<String>,
}

fn positive(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value| *value > 0.0 && *value < 1e9).ok_or_else(|| "allowed a number above 0".into())
}

fn share(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value| (0.0..=1.0).contains(value)).ok_or_else(|| "allowed a number in 0..1".into())
}

fn shard_count(text: &str) -> Result<usize, String> {
    let count = text.parse().ok().filter(|count| (1..=MAX_SHARDS).contains(count));
    count.ok_or_else(|| format!("allowed 1 to {MAX_SHARDS}"))
}

/// Slurm's ways to write a time: minutes, M:S, H:M:S, days-hours and so on.
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

    /// The grid's axes that pictures have across and down.
    fn picture_axes(&self, sweep: &Sweep) -> Result<Vec<usize>, Error> {
        let find = |name: &String| {
            let found = sweep.axes.iter().position(|axis| axis.key == *name || axis.leaf() == name);
            found.ok_or_else(|| {
                let keys: Vec<_> = sweep.axes.iter().map(|axis| &*axis.key).collect();
                Error::Usage(format!("--axes: {name} is no axis of the grid; it has {}", keys.join(", ")))
            })
        };
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
        // Whoever goes on with it finds it where it is kept.
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
            let (out, file) = (out.display(), args.sweep.display());
            return Err(Error::Usage(format!(
                "{out} holds no sweep; run its shards first: flotilla sweep {file} --out {out} --shard 1/N"
            )));
        }
        same_sweep(&sweep, &out)?;
        return collect(&args, &sweep, &out, &axes);
    }
    let shard = args.shard()?;
    same_sweep(&sweep, &out)?;
    train(&args, &sweep, &out, shard.unwrap_or(Shard::WHOLE))?;
    match shard.filter(|shard| shard.count > 1) {
        None => collect(&args, &sweep, &out, &axes),
        Some(_) => print(&format!(
            "When all shards are done: flotilla sweep {} --out {} --collect\n",
            args.sweep.display(),
            out.display()
        )),
    }
}

/// Whether a file is there; an error where that cannot be seen.
fn there(path: &Path) -> Result<bool, RecordError> {
    file::exists(path).map_err(|error| RecordError::Read { path: path.into(), error })
}

/// Refuses a folder that holds something else.
fn same_sweep(sweep: &Sweep, out: &Path) -> Result<(), Error> {
    let path = out.join(SWEEP);
    let refuse = |message: String| {
        let problems = vec![Problem { line: None, key: String::new(), message }];
        Err(ConfigError::Invalid { name: path.display().to_string(), problems, unlisted: 0 }.into())
    };
    if !there(&path)? {
        return match there(&out.join(CONFIG))? {
            true => refuse(format!("{} holds a run, not a sweep; choose another --out", out.display())),
            false => Ok(()),
        };
    }
    let there = config::read_file(&path)?;
    if there == sweep.text {
        return Ok(());
    }
    let missing = |from: &str, other: &str, where_: &str| {
        let lines: Vec<_> = from.lines().filter(|line| !other.lines().any(|other| other == *line)).collect();
        let more = if lines.len() > 8 { "\n  …" } else { "" };
        let lines: Vec<_> = lines.iter().take(8).map(|line| format!("\n  {where_}: {line}")).collect();
        lines.concat() + more
    };
    refuse(format!(
        "{} holds another sweep; what differs:{}{}\nchoose another --out, or remove that folder",
        out.display(),
        missing(&there, &sweep.text, "there"),
        missing(&sweep.text, &there, "here"),
    ))
}

/// Marks the folder as this sweep's. Shards that start at the same moment all write the same.
fn claim(sweep: &Sweep, out: &Path) -> Result<(), Error> {
    let path = out.join(SWEEP);
    let write = || -> io::Result<()> {
        std::fs::create_dir_all(out)?;
        if !path.exists() {
            let mut builder = tempfile::Builder::new();
            // As any other file: others may collect.
            #[cfg(unix)]
            builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
            let mut file = builder.tempfile_in(out)?;
            file.write_all(sweep.text.as_bytes())?;
            file.as_file().sync_all()?;
            file.persist(&path).map_err(|error| error.error)?;
        }
        Ok(())
    };
    write().map_err(|error| RecordError::Write { path: path.clone(), error: disk::without_path(error) })?;
    same_sweep(sweep, out)
}

fn train(args: &Args, sweep: &Sweep, out: &Path, shard: Shard) -> Result<(), Error> {
    let points = shard.take(&sweep.points);
    let (mut backend, machine) = backend::open(&args.run)?;
    let memory = args.memory.map_or_else(free_memory, |gib| (gib * f64::from(1 << 30)) as usize);
    if !args.quiet {
        let skipped =
            if sweep.skipped > 0 { format!(", {} impossible ones left out", sweep.skipped) } else { String::new() };
        let batches = run::batches(&points, memory).len();
        let batches = if batches > 1 { format!(" in {batches} batches") } else { String::new() };
        let (all, taken) = (sweep.points.len(), points.len());
        let part =
            if shard.count > 1 { format!("shard {shard}: {taken} of {all} points") } else { format!("{all} points") };
        say(format_args!("{part}{skipped}{batches}, on {}, into {}", backend.describe(), out.display()));
    }
    claim(sweep, out)?;
    let signals = Signals::listen()?;
    let start = match (args.resume, args.force) {
        (true, _) => Start::Resume,
        (_, true) => Start::Force,
        _ => Start::Fresh,
    };
    let mut ticker = Ticker::new(args.quiet);
    let ended = {
        let mut options = run::Options {
            start,
            memory,
            machine,
            stop: &signals.stop,
            save: &signals.save,
            watch: &mut |progress| ticker.tick(progress),
            note: &mut |point, note| {
                // What every resumed point says is no news.
                if note.contains("set aside") || note.contains("anew") {
                    say(format_args!("{}: {note}", sweep.describe(point)));
                }
            },
        };
        run::run(&points, out, &mut *backend, &mut options)
    };
    ticker.clear();
    match ended? {
        Ended::Done => Ok(()),
        Ended::Stopped => {
            let part = if shard.count > 1 { format!(" --shard {shard}") } else { String::new() };
            let (file, out) = (args.sweep.display(), out.display());
            let resume = format!("flotilla sweep {file} --out {out}{part} --resume");
            Err(Error::Stopped(format!(
                "stopped, with everything saved; go on with the same flags and --resume:\n  {resume}"
            )))
        }
    }
}

/// Half of the memory that is free now, or 2 GiB where the system does not tell.
fn free_memory() -> usize {
    memory::available().map_or(2 << 30, |bytes| (bytes / 2) as usize)
}

/// Puts together what is there, draws it, and fails where something is missing.
fn collect(args: &Args, sweep: &Sweep, out: &Path, axes: &[usize]) -> Result<(), Error> {
    let options = results::Options { every: args.every as usize, reach: args.reach };
    let outcomes = results::write(sweep, out, &options)?;
    let mut text = summary(sweep, &outcomes, &options);
    let _ = write!(
        text,
        "\nFiles in {}:\n  points/      the runs themselves\n  results.csv  every point and trial, {}\n  points.csv   what each point came to\n",
        out.display(),
        if options.every == 1 {
            "generation by generation".into()
        } else {
            format!("every {} generations", options.every)
        },
    );
    let (names, note) = pictures::draw(sweep, &outcomes, &options, axes, out)?;
    if !names.is_empty() {
        text += "  final, reach, curves (.svg, .png)   G at the end, generations to reach one, and learning curves\n";
    }
    text.extend(note.map(|note| note + "\n"));
    print(&text)?;
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
        "{} of {} points are missing from the results:{}{more}\nrun them with: flotilla sweep {} --out {} --resume",
        missing.len(),
        sweep.points.len(),
        lines.concat(),
        args.sweep.display(),
        out.display(),
    )))
}

/// What a person wants to know at the end: the best and the worst points.
fn summary(sweep: &Sweep, outcomes: &[Result<Outcome, Missing>], options: &results::Options) -> String {
    const LISTED: usize = 12;
    let done = sweep.points.iter().zip(outcomes).filter_map(|(point, outcome)| Some((point, outcome.as_ref().ok()?)));
    let mut done: Vec<_> =
        done.map(|(point, outcome)| (results::mean_and_error(&outcome.best), point, outcome)).collect();
    done.sort_by(|(a, ..), (b, ..)| b.0.total_cmp(&a.0));
    let mut text = format!(
        "{} of {} points are done. G of the best team in the last generation, mean over trials ± standard error,\n\
         and the median generation that reached G = {}:\n",
        done.len(),
        sweep.points.len(),
        options.reach
    );
    for (at, ((mean, error), point, outcome)) in done.iter().enumerate() {
        if done.len() > LISTED && at == LISTED / 2 {
            let _ = writeln!(text, "  … ({} more)", done.len() - LISTED);
        }
        if done.len() <= LISTED || at < LISTED / 2 || at >= done.len() - LISTED / 2 {
            let reached = outcome.median_reached().map_or("never".into(), |median| median.to_string());
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
    let program = std::env::current_exe().unwrap_or_else(|_| "flotilla".into());
    let out = absolute(out);
    let words = |path: &Path| path.display().to_string();
    let mut command = vec![words(&program), "sweep".into(), words(&absolute(&args.sweep)), "--out".into(), words(&out)];
    for set in args.overrides.list() {
        let value = set.text.trim_matches(['"', '\'']).to_string();
        command.extend([set.name, value]);
    }
    let cpu = args.run.backend == super::BackendChoice::Cpu;
    if args.run.backend != super::BackendChoice::Auto {
        command.extend(["--backend".into(), if cpu { "cpu".into() } else { "gpu".into() }]);
    }
    for (flag, value) in [
        ("--adapter", args.run.adapter.clone()),
        ("--threads", args.run.threads.map(|threads| threads.to_string())),
        ("--memory", args.memory.map(|gib| gib.to_string())),
    ] {
        command.extend(value.into_iter().flat_map(|value| [flag.to_string(), value]));
    }
    if args.skip_impossible {
        command.push("--skip-impossible".into());
    }
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
    // The tasks' logs go there, and Slurm creates no folder.
    claim(sweep, &out)?;
    match file {
        None => print(&script),
        Some(path) => {
            output::write(path, |output| output.write_all(script.as_bytes()))?;
            say(format_args!("submit it with: sbatch {}", path.display()));
            Ok(())
        }
    }
}

/// Shows how the points come on.
struct Ticker(Meter);

impl Ticker {
    fn new(quiet: bool) -> Ticker {
        Ticker(Meter::new(quiet))
    }

    fn tick(&mut self, progress: &Progress) {
        let Progress { done, points, batch, generation, last, played, total } = *progress;
        self.0.show(played as f64 / total.max(1) as f64, || {
            format!("{done}/{points} points done, {batch} side by side at generation {}/{last}", generation.min(last))
        });
    }

    fn clear(&self) {
        self.0.clear();
    }
}
