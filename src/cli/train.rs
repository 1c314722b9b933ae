//! `flotilla train`: a run from its config to its policies.

use std::fmt::Write;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use clap::ValueEnum;

use super::{ConfigArgs, Error, RunOptions, backend, print, say};
use crate::config::{Config, Override};
use crate::memory::Plan;
use crate::record::checkpoint::Schedule;
use crate::record::disk::Disk;
use crate::record::folder::{self, METRICS, POLICIES, Start};
use crate::record::metrics::Row;
use crate::report::progress::Progress;
use crate::report::runs;
use crate::report::tensorboard::Events;
use crate::run::{Opened, Options, Outcome, Results, RunError, Session};

/// Where runs without `--out` go.
const RUNS: &str = "runs";
/// The run's learning curves, in its folder.
const CURVES: &str = "curves.svg";
/// Event files for TensorBoard, in a run's folder.
const TENSORBOARD: &str = "tensorboard";

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    #[command(flatten)]
    run: RunOptions,
    /// Folder for what comes out [default: runs/NAME of the config, or the next free runs/NAME-2, …]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Go on with the run in the folder (without --out the latest of this config's name), or start it if there is none
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Write over the run in the folder
    #[arg(long)]
    force: bool,
    /// No progress on standard error
    #[arg(long)]
    quiet: bool,
    /// Also write event files for TensorBoard, in OUT/tensorboard
    #[arg(long)]
    tensorboard: bool,
    /// Save what --resume needs after so many generations; 0 is never
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    checkpoint_generations: Option<i64>,
    /// Save what --resume needs after so many seconds; 0 is never
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    checkpoint_seconds: Option<f64>,
    /// What to do when the device fails in mid-run
    #[arg(long, value_enum, value_name = "WHAT", default_value_t = OnLoss::Stop)]
    on_device_loss: OnLoss,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum OnLoss {
    /// Save and fail, to be resumed
    Stop,
    /// Go on with the CPU, to the same results
    Cpu,
}

impl Args {
    fn load(&self) -> Result<Config, Error> {
        let generations = self.checkpoint_generations.map(toml::Value::from);
        let seconds = self.checkpoint_seconds.map(toml::Value::from);
        let set = |(name, value): (&str, Option<toml::Value>)| {
            Some(Override::new(format!("checkpoint.{name}"), value?, format!("--checkpoint-{name}")))
        };
        self.config
            .load_with([("generations", generations), ("seconds", seconds)].into_iter().filter_map(set).collect())
    }

    /// The run's folder, and what to do with a run in it.
    fn folder(&self) -> Result<(PathBuf, Start), Error> {
        let start = match (self.resume, self.force) {
            (true, _) => Start::Resume,
            (_, true) => Start::Force,
            _ => Start::Fresh,
        };
        let stem = self.config.config.file_stem().unwrap_or_default().to_string_lossy();
        let runs = Path::new(RUNS);
        Ok(match (&self.out, start) {
            (Some(out), _) => (out.clone(), start),
            (None, Start::Resume) => (folder::latest(runs, &stem), start),
            (None, Start::Force) => (runs.join(&*stem), start),
            (None, Start::Fresh) => (folder::next_free(runs, &stem)?, start),
        })
    }
}

pub fn run(args: Args) -> Result<(), Error> {
    let config = args.load()?;
    let (backend, machine) = backend::open(&args.run)?;
    Plan::of([&config], rayon::current_num_threads()).check(machine.backend == "gpu").map_err(RunError::from)?;
    let runs_on = backend.describe();
    let (folder, start) = args.folder()?;
    if !args.quiet {
        say(format_args!("training on {runs_on}, into {}", folder.display()));
    }
    let signals = Signals::listen()?;
    let (opened, notes) = Session::open(config.clone(), &folder, start, Disk::default())?;
    for note in notes {
        say(note);
    }
    let report = |results: &Results, trained: &str| report(&config, &folder, results, trained);
    let mut session = match opened {
        Opened::Ready(session) => session,
        Opened::Done(results) => return print(&report(&results, "This run was done already")),
    };

    let (since, from, last) = (Instant::now(), session.generation(), config.learning.generations);
    let mut shown = Progress::new(vec![(String::new(), config.world.pois.len())], from, last, args.quiet);
    let path = folder.join(TENSORBOARD);
    let events_failed = |error| {
        say(format_args!("{}: cannot be written: {error}; training goes on without event files", path.display()));
    };
    let mut events = match args.tensorboard.then(|| Events::create(&path, config.learning.trials, from == 0)) {
        Some(events) => events.map_err(events_failed).ok(),
        None => None,
    };
    let mut instead = |error: &_| {
        (args.on_device_loss == OnLoss::Cpu).then(|| {
            let (backend, machine) = backend::cpu();
            say(format_args!("{error}\ngoing on with {}, to the same results", backend.describe()));
            (backend, machine)
        })
    };
    let options = Options {
        schedule: Schedule { generations: config.checkpoint.generations, seconds: config.checkpoint.seconds },
        stop: &signals.stop,
        save: &signals.save,
        instead: &mut instead,
        watch: &mut |progress| {
            shown.show(progress.generation, progress.rows);
            if let Some(Err(error)) = events.as_mut().map(|events| events.add(progress.rows)) {
                events_failed(error);
                events = None;
            }
        },
    };
    let outcome = session.train((backend, machine), options);
    shown.clear();
    if let Some(Err(error)) = events.as_mut().map(Events::flush) {
        events_failed(error);
    }
    match outcome? {
        Outcome::Done(results) => {
            let seconds = since.elapsed().as_secs_f64();
            let rate = (session.generation().min(last + 1) - from.min(last + 1)) as f64 / seconds.max(1e-9);
            draw(&folder);
            let learning = &config.learning;
            let trained = format!(
                "Trained {} trials of {} teams, {} generations, in {seconds:.1} s ({rate:.1} generations/s) on {runs_on}",
                learning.trials, learning.population, learning.generations
            );
            print(&report(&results, &trained))
        }
        Outcome::Stopped { generation } => Err(Error::Stopped(format!(
            "before generation {generation} of {}, with everything saved; go on with\n  {}",
            config.learning.generations,
            command_to_resume(&folder)
        ))),
    }
}

/// Draws the run's curves. All that was learned is saved by now, so a picture that fails is no failure of the run.
fn draw(folder: &Path) {
    let path = folder.join(CURVES);
    let drawn = runs::figure(&[folder.to_path_buf()]).map(|figure| figure.scene().svg());
    let written = drawn.map_err(|error| error.to_string()).and_then(|svg| {
        let written = Disk::default().replace(&path, |output| output.write_all(svg.as_bytes()));
        written.map_err(|error| error.to_string())
    });
    if let Err(error) = written {
        say(format_args!("{}: not drawn: {error}", path.display()));
    }
}

/// What to type to go on.
fn command_to_resume(folder: &Path) -> String {
    let folder = folder.display();
    format!("flotilla train {folder}/{} --out {folder} --resume", folder::CONFIG)
}

/// Signals that ask for something.
pub(super) struct Signals {
    pub(super) stop: Arc<AtomicBool>,
    pub(super) save: Arc<AtomicBool>,
}

impl Signals {
    /// From here on SIGINT and SIGTERM set `stop`, and end the process at once where it is set already; SIGUSR1 sets
    /// `save`.
    pub(super) fn listen() -> Result<Signals, Error> {
        use signal_hook::consts::{SIGINT, SIGTERM};
        use signal_hook::flag;
        let signals = Signals { stop: Arc::default(), save: Arc::default() };
        let listen = || -> io::Result<()> {
            for signal in [SIGINT, SIGTERM] {
                flag::register_conditional_shutdown(signal, 128 + signal, signals.stop.clone())?;
                flag::register(signal, signals.stop.clone())?;
            }
            #[cfg(unix)]
            flag::register(signal_hook::consts::SIGUSR1, signals.save.clone())?;
            Ok(())
        };
        listen().map_err(Error::Signals)?;
        Ok(signals)
    }
}

/// One of a row's scores.
type Score = fn(&Row) -> f64;

/// What a person wants to know at the end.
fn report(config: &Config, folder: &Path, results: &Results, trained: &str) -> String {
    let Results { story, digest } = results;
    let pois = config.world.pois.len();
    let mut text = format!("{trained}.\n\nPOIs observed, of {pois}: mean over trials (lowest to highest trial)\n");
    let scores: [(&str, Score); 3] =
        [("best team", |row| row.best_g), ("mean team", |row| row.mean_g), ("champion", |row| row.champion_g)];
    let last = format!("generation {}", config.learning.generations);
    let mut table = vec![["", scores[0].0, scores[1].0, scores[2].0].map(String::from)];
    for (name, rows) in [("start", &story.first), (&*last, &story.last)] {
        let spread = |share: Score| {
            let mut all: Vec<f64> = rows.iter().map(|row| share(row) * pois as f64).collect();
            all.sort_by(f64::total_cmp);
            let mean = all.iter().sum::<f64>() / all.len() as f64;
            format!("{mean:.2} ({:.2} to {:.2})", all[0], all[all.len() - 1])
        };
        let [best, mean, champion] = scores.map(|(_, share)| spread(share));
        table.push([name.into(), best, mean, champion]);
    }
    // As wide as what stands in them: 100 POIs take more room than 4.
    let width = |column: usize| table.iter().map(|row| row[column].len()).max().unwrap_or(0);
    for [name, best, mean, champion] in &table {
        let line =
            format!("  {name:<a$}  {best:<b$}   {mean:<c$}   {champion}", a = width(0), b = width(1), c = width(2));
        let _ = writeln!(text, "{}", line.trim_end());
    }
    let folder = folder.display();
    let _ = write!(
        text,
        "
Files in {folder}:
  {METRICS:<22}every trial, generation by generation
  {POLICIES:<22}what was learned, best policy first
  {CURVES:<22}its learning curves, to look at
  {:<22}the config, every default written out
  {:<22}what it ran on; digest {digest}

Next:
  flotilla replay {folder}
  flotilla rollout {folder}/{} --policies {folder}/{POLICIES} --scores scores.csv
",
        folder::CONFIG,
        folder::RUN,
        folder::CONFIG,
    );
    text
}
