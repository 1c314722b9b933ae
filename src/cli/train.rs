//! `flotilla train`: trains the teams of a config, and saves the run.

use std::ffi::OsString;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::recovery::{self, Checkpoints, Loss, Signals, quoted};
use super::{ConfigArgs, Error, Processor, RunOptions, backend, print, print_json, said, say, warnings};
use crate::choice::Work;
use crate::config::Config;
use crate::escape::PathExt;
use crate::file;
use crate::host::Instant;
use crate::memory::Peaks;
use crate::ops::{Context, Event, RUNS};
use crate::record::RecordError;
use crate::record::archive;
use crate::record::digests::Verification;
use crate::record::disk::Disk;
use crate::record::folder::{self, METRICS, POLICIES, Start};
use crate::record::ownership::{self, CURVES};
use crate::record::policies;
use crate::report::curves::Band;
use crate::report::progress::Board;
use crate::report::replay::History;
use crate::report::runs;
use crate::report::scene::Scene;
use crate::report::tensorboard::Events;
use crate::run::{Ended, Progress, Results, RunError, Session};
use crate::shell;
use crate::trainer::Row;

/// The folder of event files for TensorBoard, in a run's folder.
const TENSORBOARD: &str = "tensorboard";

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    #[command(flatten)]
    run: RunOptions,
    /// Output directory [default: runs/NAME after the config's file, or the next free runs/NAME-2, …]
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Resume the run in the directory, or start it if there is none (without --out: the latest of this config's name)
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Start from the policies in a safetensors file instead of random ones. Trial i takes the tensor `weights.i`, or
    /// all take `weights`: f32 [leaders, policies, parameters]. Missing policies are random
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// Overwrite the run in the directory (without --out: runs/NAME)
    #[arg(long)]
    force: bool,
    /// Print no progress and no summary; --json still prints its object
    #[arg(long, short)]
    quiet: bool,
    /// Print the results as one JSON object (docs/reference/json.md)
    #[arg(long)]
    json: bool,
    /// Also write event files for TensorBoard to OUT/tensorboard; with --resume, earlier generations too
    #[arg(long)]
    tensorboard: bool,
    #[command(flatten)]
    checkpoints: Checkpoints,
    #[command(flatten)]
    loss: Loss,
}

impl Args {
    /// Returns the command that resumes the run.
    fn command_to_resume(&self, folder: &Path) -> String {
        let words: [OsString; 3] = ["flotilla".into(), "train".into(), shell::argument(&folder.join(folder::CONFIG))];
        let out = ["--out".into(), shell::argument(folder), "--resume".into()];
        let events = self.tensorboard.then(|| "--tensorboard".into());
        let machine = recovery::words_of_machine(&self.run, self.loss);
        shell::command(words.into_iter().chain(out).chain(events).chain(machine))
    }

    /// Returns the run's folder, and what to do with a run in it.
    fn folder(&self) -> Result<(PathBuf, Start), Error> {
        let start = match (self.resume, self.force) {
            (true, _) => Start::Resume,
            (_, true) => Start::Force,
            _ => Start::Fresh,
        };
        let stem = self.config.name();
        let runs = Path::new(RUNS);
        Ok(match (&self.out, start) {
            (Some(out), _) => (out.clone(), start),
            (None, Start::Resume) => (folder::latest(runs, &stem), start),
            (None, Start::Force) => (runs.join(&stem), start),
            (None, Start::Fresh) => (folder::next_free(runs, &stem)?, start),
        })
    }
}

/// Refuses a run in a zip file, because its folder would be removed at the end. The message says how to unpack and resume it.
fn refuse_zip(path: &Path) -> Result<(), Error> {
    let Some(top) = archive::top(path) else { return Ok(()) };
    let inner = if top.is_empty() { file::stem(path, "run") } else { top.clone() };
    let mut unpack = vec!["unzip".into(), shell::argument(path)];
    if top.is_empty() {
        unpack.extend(["-d".into(), inner.clone().into()]);
    }
    let [config, folder] = [Path::new(&inner).join(folder::CONFIG), inner.into()].map(|path| shell::argument(&path));
    let resume = ["flotilla".into(), "train".into(), config, "--out".into(), folder, "--resume".into()];
    Err(Error::Usage(said(
        format!("{} is a run in a zip file, and a run resumes in a folder", path.escaped()),
        format!("unpack it, and resume it there:\n  {}\n  {}", shell::command(unpack), shell::command(resume)),
    )))
}

pub fn run(args: Args) -> Result<(), Error> {
    [&args.config.file.path].into_iter().chain(&args.out).try_for_each(|path| refuse_zip(path))?;
    let (config, notes_on_config) = args.config.load(args.checkpoints.list())?;
    let (mut player, runs_on) = backend::open_for(&args.run, Work::of([&config]))?;
    Peaks::of([&config], rayon::current_num_threads()).check(player.1.backend == "gpu").map_err(RunError::from)?;
    warnings::unreachable(&config);
    let init = args.init.as_deref().map(|path| policies::read_init(path, &config)).transpose()?;
    let (folder, start) = args.folder()?;
    if let Some(what) = folder::collection(&folder) {
        return Err(Error::Refused(said(
            format!("{} holds {what}, not a run", folder.escaped()),
            "choose another --out",
        )));
    }
    if let Some(path) =
        args.init.as_deref().filter(|path| file::resolved(path) == file::resolved(&folder.join(POLICIES)))
    {
        return Err(Error::Usage(said(
            format!("--init {}: this run would be written over it", path.escaped()),
            "choose another --out",
        )));
    }
    let disk = Disk::default();
    if folder.is_dir() {
        let disk = ownership::enter(&disk, &folder, args.out.is_some())?;
        // A foreign picture must not prevent a run from being resumed.
        if start != Start::Resume {
            ownership::check(&disk, [folder.join(CURVES)])?;
        }
    }
    let signals = Signals::listen()?;
    let opened = Session::open_from(vec![(config.clone(), folder.clone(), init)], start, &disk);
    let (mut session, notes) = opened.map_err(|error| match error {
        RunError::Record(RecordError::Exists { .. }) if args.tensorboard => Error::Refused(said(
            format!("{error}\nfor event files of the run that is there:"),
            format!("  {}", args.command_to_resume(&folder)),
        )),
        // This avoids the advice to use `--resume`. Until the run's origin is recorded, a resumed run would start from
        // random policies.
        RunError::Record(error) if args.init.is_some() => error.into(),
        error => error.into(),
    })?;
    for (_, note) in notes {
        say(note);
    }
    let path = folder.join(TENSORBOARD);
    let events_failed =
        |error| say(format_args!("{}: cannot be written: {error}; there are no event files", path.escaped()));
    let disk = session.disk(0).clone();
    let events =
        || Events::create(&disk, &path, config.learning.trials, &folder.join(METRICS)).map_err(events_failed).ok();
    let mut events = args.tensorboard.then(events).flatten();
    if start == Start::Force && !args.tensorboard {
        // The event files belong to the run that was overwritten.
        Events::clear(&disk, &path).unwrap_or_else(events_failed);
    }
    let told =
        Told { config: &config, notes: &notes_on_config, name: args.config.name(), folder: &folder, runs_on: &runs_on };
    if session.is_done() {
        // A session that ended after the run but before its picture left an older picture, or none.
        let digest = session.results(0).map_or("", |results| &results.digest);
        if !fs::read_to_string(folder.join(CURVES)).is_ok_and(|svg| Scene::shows(&svg, digest)) {
            draw(&disk, &folder);
        }
        return told.print(&session, None, args.quiet, args.json);
    }
    if !args.quiet {
        say(format_args!("training on {runs_on}, into {}", folder.escaped()));
    }

    let (since, from, last) = (Instant::now(), session.generations()[0], config.learning.generations);
    let mut shown = Board::new(vec![(String::new(), config.pois())], from, last, args.quiet);
    let command = recovery::typed();
    let context = Context {
        tell: &|event| {
            if let Event::Warning(text) = event {
                say(text);
            }
        },
        stop: &signals.stop,
        save: &signals.save,
        command: &command,
        falls_back: args.loss.falls_back(),
    };
    let mut watch = |progress: &Progress<'_>| {
        shown.show(progress.generations[0], progress.rows);
        if let Some(Err(error)) = events.as_mut().map(|events| events.add(progress.rows)) {
            events_failed(error);
            events = None;
        }
    };
    let ended = context.train(&mut watch, |options| session.train(&mut player, options));
    shown.clear();
    if let Some(Err(error)) = events.as_mut().map(Events::flush) {
        events_failed(error);
    }
    let next = session.generations()[0];
    match ended? {
        Ended::Done => {
            draw(&disk, &folder);
            let trained = Training { generations: next.min(last + 1) - from.min(last + 1), since };
            told.print(&session, Some(trained), args.quiet, args.json)
        }
        Ended::Stopped => Err(Error::Stopped(said(
            format!("before generation {next} of {last}, with everything saved"),
            format!("continue with\n  {}", args.command_to_resume(&folder)),
        ))),
    }
}

/// Draws the run's curves. A failure is only reported, because everything that was learned is already saved.
fn draw(disk: &Disk, folder: &Path) {
    let path = folder.join(CURVES);
    let drawn = runs::figure(&[folder.to_path_buf()], None, Band::Interval, Verification::Required)
        .map(|figure| figure.scene().svg());
    let written = drawn.map_err(|error| error.to_string()).and_then(|svg| {
        let written = ownership::publish(disk, &path, |output| output.write_all(svg.as_bytes()));
        written.map_err(|error| error.to_string())
    });
    if let Err(error) = written {
        say(format_args!("{}: not drawn: {error}", path.escaped()));
    }
}

/// The generations that this process trained, and when it started.
struct Training {
    generations: usize,
    since: Instant,
}

/// The facts that a run's report is made from.
struct Told<'a> {
    config: &'a Config,
    notes: &'a [String],
    name: String,
    folder: &'a Path,
    runs_on: &'a str,
}

impl Told<'_> {
    /// Prints the results of a run. `trained` is `None` if the run was finished before.
    fn print(&self, session: &Session, trained: Option<Training>, quiet: bool, json: bool) -> Result<(), Error> {
        let results = session.results(0).expect("the run is done");
        let done_already = trained.is_none();
        let ever = |all: Vec<History>| all.iter().any(|history| history.most() > 0.0);
        if !History::all(self.folder, self.config, Verification::Required).is_ok_and(ever) {
            say(format_args!(
                "warning: no team observed any POI in any generation, so there was nothing to learn from; try more \
                 world.steps, a smaller world.coupling, POIs nearer to the starts, or a larger learning.population; \
                 `flotilla replay {}` shows what teams do",
                quoted(self.folder)
            ));
        }
        let (generations, seconds) =
            trained.map_or((0, 0.0), |trained| (trained.generations, trained.since.elapsed().as_secs_f64()));
        if json {
            return print_json(&self.json(session.run(0), results, generations, seconds));
        }
        if quiet {
            return Ok(());
        }
        let learning = &self.config.learning;
        let trained = match done_already {
            true => "This run was done already".into(),
            false => format!(
                "Trained {} of {} teams, {}, in {} ({:.1} generations/s) on {}",
                counted(learning.trials, "trial"),
                learning.teams(),
                counted(learning.generations, "generation"),
                time(seconds),
                generations as f64 / seconds.max(1e-9),
                self.runs_on
            ),
        };
        print(&report(self.config, self.folder, results, &trained))
    }

    fn json(&self, run: &folder::Run, results: &Results, trained: usize, seconds: f64) -> serde_json::Value {
        let learning = &self.config.learning;
        let course = |rows: &[Row]| {
            let [best, mean, champion] = SCORES.map(|(_, share)| {
                let Extremes { mean, lowest, highest } = Extremes::of(rows.iter().map(share));
                json!({ "mean": mean, "lowest": lowest, "highest": highest })
            });
            json!({ "best_g": best, "mean_g": mean, "champion_g": champion })
        };
        let file = |name: &str| self.folder.join(name).escaped().to_string();
        let mut object = json!({
            "folder": self.folder.escaped().to_string(),
            "config": self.name,
            "digest": results.digest,
            "seed": learning.seed,
            "trials": learning.trials,
            "population": learning.population,
            "generations": learning.generations,
            "pois": self.config.pois(),
            "trained_generations": trained,
            "seconds": seconds,
            "notes": self.notes,
            "first": course(&results.story.first),
            "last": course(&results.story.last),
            "files": {
                "config": file(folder::CONFIG),
                "run": file(folder::RUN),
                "metrics": file(METRICS),
                "policies": file(POLICIES),
                "curves": file(CURVES),
            },
        });
        Processor::of_run(run).add_to(&mut object);
        object
    }
}

/// A score of a row, as G in 0..1.
type Score = fn(&Row) -> f64;
/// All scores, with their names.
const SCORES: [(&str, Score); 3] =
    [("best team", |row| row.best_g), ("mean team", |row| row.mean_g), ("champion", |row| row.champion_g)];

/// The mean, lowest and highest value over trials.
struct Extremes {
    mean: f64,
    lowest: f64,
    highest: f64,
}

impl Extremes {
    fn of(shares: impl Iterator<Item = f64>) -> Extremes {
        let (mut count, mut spread) = (0.0, Extremes { mean: 0.0, lowest: f64::INFINITY, highest: 0.0 });
        for share in shares {
            count += 1.0;
            spread.mean += share;
            spread.lowest = spread.lowest.min(share);
            spread.highest = spread.highest.max(share);
        }
        Extremes { mean: spread.mean / count, ..spread }
    }
}

/// Returns a count with its noun: "1 trial", "2 trials".
fn counted(count: usize, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// Returns a time in seconds, or in milliseconds if it is short.
fn time(seconds: f64) -> String {
    match seconds * 1000.0 {
        short if short < 9.95 => format!("{short:.1} ms"),
        short if short < 99.5 => format!("{short:.0} ms"),
        _ => format!("{seconds:.1} s"),
    }
}

/// Returns the report of a run for people.
fn report(config: &Config, folder: &Path, results: &Results, trained: &str) -> String {
    let Results { story, digest } = results;
    // `None` if stages have different numbers of POIs.
    let counted = config.pois();
    let what = counted.map_or("Share of POIs observed".into(), |pois| format!("POIs observed, of {pois}"));
    let pois = counted.unwrap_or(1);
    let mut text = format!("{trained}.\n\n{what}: mean over trials (lowest to highest trial)\n");
    let last = format!("generation {}", config.learning.generations);
    let mut table = vec![["", SCORES[0].0, SCORES[1].0, SCORES[2].0].map(String::from)];
    let rows = [("start", &story.first), (&*last, &story.last)];
    // A run without generations after the start has one row.
    let shown = if config.learning.generations == 0 { 1 } else { rows.len() };
    for (name, rows) in rows.into_iter().take(shown) {
        let [best, mean, champion] = SCORES.map(|(_, share)| {
            let Extremes { mean, lowest, highest } = Extremes::of(rows.iter().map(|row| share(row) * pois as f64));
            format!("{mean:.2} ({lowest:.2} to {highest:.2})")
        });
        table.push([name.into(), best, mean, champion]);
    }
    // Columns fit their contents, because 100 POIs need more room than 4.
    let width = |column: usize| table.iter().map(|row| row[column].len()).max().unwrap_or(0);
    for [name, best, mean, champion] in &table {
        let line =
            format!("  {name:<a$}  {best:<b$}   {mean:<c$}   {champion}", a = width(0), b = width(1), c = width(2));
        let _ = writeln!(text, "{}", line.trim_end());
    }
    let replayed = quoted(folder);
    let film = quoted(&folder.join("champion.gif"));
    let best = story.last.iter().reduce(|a, b| if b.champion_g > a.champion_g { b } else { a });
    let (best, observed) = best.map_or((0, 0.0), |row| (row.trial, row.champion_g * pois as f64));
    let what = counted.map_or("share of POIs".into(), |pois| format!("of {pois} POIs"));
    let _ = match observed > 0.0 {
        true => write!(text, "\nThe best champion is that of trial {best}: {observed:.2} {what}.\n"),
        false => write!(text, "\nNo champion observed any POI. The film below shows what that of trial {best} does.\n"),
    };
    let _ = write!(
        text,
        "
Files in {}:
  {METRICS:<22}every trial, generation by generation
  {POLICIES:<22}what was learned, best policy first
  {CURVES:<22}its learning curves, to look at
  {:<22}the config, every default written out
  {:<22}what it ran on; digest {digest}

Next:
  flotilla replay {replayed}
  flotilla replay {replayed} --trial {best} --team champion --out {film}
  flotilla rollout {replayed} --scores scores.csv
",
        folder.escaped(),
        folder::CONFIG,
        folder::RUN,
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_and_times_are_as_people_write_them() {
        assert_eq!([0, 1, 2].map(|count| counted(count, "trial")), ["0 trials", "1 trial", "2 trials"]);
        let times = [0.0004, 0.0123, 0.0994, 0.0996, 12.34].map(time);
        assert_eq!(times, ["0.4 ms", "12 ms", "99 ms", "0.1 s", "12.3 s"]);
    }
}
