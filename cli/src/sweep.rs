//! `flotilla sweep`: trains a grid of runs, on one machine or many.

use std::ffi::OsString;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::{Error, ExistingResults, Overrides, RunOptions, between, console, print, print_json, recovery, say, whole};
use flotilla::config;
use flotilla::escape::PathExt;
use flotilla_app::ops::sweep::{SweepRequest, claim};
use flotilla_app::ops::{self, output};
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{RUNS, SWEEP};
use flotilla_app::record::ownership;
use flotilla_app::report::curves::Band;
use flotilla_app::report::runs::TeamKind;
use flotilla_app::shell;
use flotilla_app::sweep::Sweep;
use flotilla_app::sweep::results::ResultOptions;
use flotilla_app::sweep::shard::{self, MAX_SHARDS, Shard};

mod slurm;

const SCALE_OUT: &str = "Many processes (docs/how-to/clusters.md)";
const RESULTS: &str = "Results";

#[derive(clap::Args)]
pub struct Args {
    /// Sweep file: a config with a section [grid] or [vary] (docs/how-to/sweeps.md); - is standard input
    sweep: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
    #[command(flatten)]
    run: RunOptions,
    /// Output directory, the same for all shards [default: runs/NAME of the sweep]
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    existing: ExistingResults,
    /// Leave out impossible points, for example a coupling above the number of agents
    #[arg(long)]
    skip_impossible: bool,
    /// Print the points with their costs and shards, and train none
    #[arg(long, group = "planned")]
    list: bool,
    /// Memory for the points that train together, in GiB [default: half of the free memory]
    #[arg(long, value_name = "GIB", value_parser = positive)]
    memory: Option<f64>,
    /// Print no progress
    #[arg(long, short)]
    quiet: bool,
    /// Print the results as one JSON object (docs/reference/json.md)
    #[arg(long, conflicts_with_all = ["list", "slurm"])]
    json: bool,

    /// Train shard I of N [default: the task of a Slurm array or Kubernetes indexed job, otherwise everything]
    #[arg(long, value_name = "I/N", allow_hyphen_values = true, help_heading = SCALE_OUT)]
    shard: Option<Shard>,
    /// Join the results of all shards, and list missing points
    #[arg(long, conflicts_with_all = ["shard", "resume", "force", "list", "slurm"], help_heading = SCALE_OUT)]
    collect: bool,
    /// Write the batch script of a Slurm job array to standard output, or to =FILE
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true, conflicts_with_all = ["shard", "force", "list"], group = "planned", help_heading = SCALE_OUT)]
    slurm: Option<Option<PathBuf>>,
    /// Number of tasks of the job array, or of shards that --list shows
    #[arg(long, value_name = "N", default_value_t = 1, requires = "planned", value_parser = shard_count, help_heading = SCALE_OUT)]
    shards: usize,
    /// Time limit of a task of the job array
    #[arg(long, value_name = "HH:MM:SS", default_value = "01:00:00", requires = "slurm", value_parser = time_limit, help_heading = SCALE_OUT)]
    time: String,
    /// GPUs per task of the job array [default: 1, or 0 with --backend cpu]
    #[arg(long, value_name = "N", requires = "slurm", value_parser = whole, help_heading = SCALE_OUT)]
    gpus: Option<usize>,
    /// Another option of the batch script, for example --sbatch=--partition=long; can be repeated
    #[arg(long, value_name = "OPTION", requires = "slurm", allow_hyphen_values = true, value_parser = an_option, help_heading = SCALE_OUT)]
    sbatch: Vec<String>,

    /// Write a row of results.csv every N generations, and for the last
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = between(1..=u32::MAX), help_heading = RESULTS)]
    every: u32,
    /// Report the first generation that reaches this G, in 0..1
    #[arg(long, value_name = "G", default_value_t = 0.75, value_parser = share, help_heading = RESULTS)]
    reach: f64,
    /// Also read files that differ from their digests in run.json, and mark the results as unverified
    #[arg(long, requires = "collect", help_heading = RESULTS)]
    unverified: bool,
    /// Team whose G is shown: the champion, the best of a generation, the mean over all teams, or the best in
    /// its test episodes
    #[arg(long, value_name = "champion|best|mean|test", default_value = "champion", help_heading = RESULTS)]
    measure: TeamKind,
    /// Range that pictures show around a mean: its 95 % interval, its standard error, or none
    #[arg(long, value_name = "interval|error|none", default_value = "interval", help_heading = RESULTS)]
    band: Band,
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
            None => Shard::from_env(|name| std::env::var(name).ok()).map_err(|error| Error::Usage(error.into())),
        }
    }

    fn out(&self, sweep: &Sweep) -> PathBuf {
        self.out.clone().unwrap_or_else(|| Path::new(RUNS).join(&sweep.name))
    }

    /// Returns the arguments that run this sweep again, without those that differ between processes.
    fn words(&self, sweep: &Path, out: &Path) -> Vec<OsString> {
        let mut words = vec!["sweep".into(), shell::argument(sweep), "--out".into(), shell::argument(out)];
        words.extend(recovery::words_of(&self.overrides.list()));
        words.extend(recovery::words_of_machine(&self.run));
        words.extend(self.memory.into_iter().flat_map(|gib| ["--memory".into(), gib.to_string().into()]));
        if self.skip_impossible {
            words.push("--skip-impossible".into());
        }
        let results = [
            ("--every", self.every.to_string(), "1"),
            ("--reach", self.reach.to_string(), "0.75"),
            ("--axes", self.axes.join(","), ""),
            ("--measure", self.measure.to_string(), "champion"),
            ("--band", self.band.to_string(), "interval"),
        ];
        let changed = results.into_iter().filter(|(_, value, default)| value != default);
        words.extend(changed.flat_map(|(flag, value, _)| [OsString::from(flag), value.into()]));
        words
    }

    fn request(&self, sweep: &Sweep, out: &Path, shard: Option<Shard>) -> SweepRequest {
        SweepRequest {
            text: sweep.text.clone(),
            name: sweep.name.clone(),
            set: vec![],
            skip_impossible: self.skip_impossible,
            out: out.into(),
            named: self.out.is_some(),
            start: self.existing.start(),
            shard: shard.map(|shard| (shard.index, shard.count)),
            memory: self.memory.map(|gib| (gib * f64::from(1 << 30)) as usize),
            results: ResultOptions {
                every: self.every as usize,
                reach: self.reach,
                unverified: self.unverified,
                axes: self.axes.clone(),
                measure: self.measure,
                band: self.band,
            },
        }
    }

    /// Returns the command that resumes this sweep.
    fn command_to_resume(&self, out: &Path, shard: Option<Shard>) -> String {
        let shard = shard.map(|shard| shard.to_string());
        let mut more: Vec<&str> = shard.iter().flat_map(|shard| ["--shard", shard]).collect();
        more.push("--resume");
        self.command(out, &more)
    }

    /// Returns a command line of this sweep with more flags.
    fn command(&self, out: &Path, more: &[&str]) -> String {
        let words = self.words(&self.sweep, out);
        let more = more.iter().map(OsString::from);
        shell::command([OsString::from("flotilla")].into_iter().chain(words).chain(more))
    }
}

pub fn run(mut args: Args) -> Result<(), Error> {
    let sweep = Sweep::load(&args.sweep, &args.overrides.list(), args.skip_impossible)?;
    let out = args.out(&sweep);
    if config::is_standard_input(&args.sweep) {
        // Later commands cannot read standard input again, so they use the copy in the folder.
        args.sweep = out.join(SWEEP);
    }
    let axes = ops::sweep::picture_axes(&sweep, &args.axes)?;
    ops::sweep::check_measure(&sweep, args.measure)?;
    if let Some(file) = &args.slurm {
        return write_script(&args, &sweep, &out, file.as_deref());
    }
    if args.list {
        return list(&sweep, args.shards);
    }
    let shard = if args.collect { None } else { args.shard()?.filter(|shard| shard.count > 1) };
    let request = args.request(&sweep, &out, shard);
    if !args.collect {
        let trained = console::run(&args.run, args.quiet, |backends, context| {
            ops::sweep::train(&request, &sweep, backends, context)
        });
        trained
            .map_err(|error| error.or_advise(|| format!("continue with\n  {}", args.command_to_resume(&out, shard))))?;
    }
    if let Some(shard) = shard {
        let command = args.command(&out, &["--collect"]);
        return match args.json {
            true => print_json(&json!({
                "folder": out.escaped(),
                "sweep": sweep.name,
                "shard": shard.to_string(),
                "collect": command,
            })),
            false => print(&format!("When all shards are done: {command}\n")),
        };
    }
    let found = console::run_without_backend(args.quiet, |_| ops::sweep::collect(&request, &sweep, &axes)).map_err(
        |error| error.or_advise(|| format!("run its shards first: {}", args.command(&out, &["--shard", "1/N"]))),
    )?;
    match args.json {
        true => print_json(&found)?,
        false => print(&found.text)?,
    }
    let resume = |error: Error| error.or_advise(|| format!("run them with: {}", args.command(&out, &["--resume"])));
    found.missing().map_or(Ok(()), |error| Err(resume(error)))
}

fn list(sweep: &Sweep, shards: usize) -> Result<(), Error> {
    let total: u128 = sweep.points.iter().map(shard::cost).sum();
    let of = shard::assign_to_shards(&sweep.points, shards);
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
        "{} points, {} left out; {}",
        sweep.points.len(),
        sweep.skipped,
        match shards {
            1 => "one shard trains them all".into(),
            _ => format!("each of {shards} shards trains {:.2} to {:.2} % of the work", part(least), part(most)),
        }
    );
    print(&text)
}

fn write_script(args: &Args, sweep: &Sweep, out: &Path, file: Option<&Path>) -> Result<(), Error> {
    output::check(&[("--slurm", file)], &[&args.sweep])?;
    match (args.shards, sweep.points.len()) {
        (1, 2..) => say("note: the job array has one task, which trains all points; --shards N makes it N tasks"),
        (shards, points) if shards > points => say(format_args!(
            "note: {} of the {shards} tasks get nothing to train, because the sweep has {points} points; --shards \
             {points} is enough",
            shards - points
        )),
        _ => {}
    }
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.into());
    let out = absolute(out);
    let mut command = vec![super::program().into_os_string()];
    command.extend(args.words(&absolute(&args.sweep), &out));
    let script = slurm::script(&sweep.name, &command, &out, args).map_err(|error| Error::Usage(error.into()))?;
    // Slurm writes the tasks' logs to this folder, but does not create it.
    ownership::create_output_folder(&Disk::default(), &out, args.out.is_some())?;
    claim(&Disk::default(), sweep, &out)?;
    match file {
        None => print(&script),
        Some(path) => {
            output::write(path, script.as_bytes())?;
            say(format_args!("submit it with: sbatch {}", path.escaped()));
            Ok(())
        }
    }
}
