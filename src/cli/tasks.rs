//! `flotilla tasks`: trains the tasks of a suite, and checks which of them need learning and large populations.
//!
//! A task is admitted if no baseline reaches [`EASY`], if populations of [`SMALL`] policies solve it under no fitness,
//! and if something solves it: a champion here, or a scripted team in a file beside the config.

use std::path::{Path, PathBuf};

use super::recovery::{self, Loss, Signals};
use super::{Error, RunOptions, backend, between, print, say};
use crate::backend::Backend;
use crate::baseline::{Baselines, Outcome};
use crate::choice::Work;
use crate::config::{self, Config, Fitness, Override};
use crate::evaluate::Starts;
use crate::memory::Peaks;
use crate::ops::{Context, Event};
use crate::record::digests::Verification;
use crate::record::disk::Disk;
use crate::record::folder::{POLICIES, Start};
use crate::record::ownership;
use crate::report::progress::Board;
use crate::report::runs;
use crate::report::table::markdown;
use crate::run::{Ended, Progress, RunError, Session};
use crate::statistics;
use crate::sweep::questions::champions;

/// G that no baseline of a task may reach.
const EASY: f64 = 0.7;
/// Number of policies in the small populations, and their number of generations.
const SMALL: (i64, i64) = (50, 100);
/// Number of repetitions of the baselines.
const SEEDS: usize = 10;
/// Number of held-out episodes per champion, if starts or POIs move.
const EPISODES: u32 = 200;
/// G above which a champion solves a task. If starts or POIs move, no team observes all POIs in all episodes.
const SOLVED: f64 = 0.9;
/// The fitnesses of both kinds of populations.
const FITNESSES: [Fitness; 4] = [Fitness::G, Fitness::D, Fitness::Df, Fitness::Dpp];

#[derive(clap::Args)]
pub struct Args {
    /// Config files (TOML), one per task
    #[arg(value_name = "CONFIG", required = true)]
    configs: Vec<PathBuf>,
    /// Folder for the runs
    #[arg(long, short, value_name = "DIR", default_value = "tasks")]
    out: PathBuf,
    /// Independent repetitions of every training
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = between(2..=4096u32))]
    trials: u32,
    /// Policies per population of the large populations, of which 10 % are elites; 0 trains none
    #[arg(long, value_name = "N", default_value_t = 5000, value_parser = between(0..=1_048_576u32))]
    population: u32,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 777)]
    seed: u32,
    /// Resume the runs in the directory, and start the missing ones
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Overwrite the runs in the directory
    #[arg(long)]
    force: bool,
    /// Print no progress
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    loss: Loss,
    #[command(flatten)]
    run: RunOptions,
}

/// Results of one training, over trials.
struct Trained {
    fitness: Fitness,
    champion: Vec<f64>,
    best: Vec<f64>,
}

impl Trained {
    fn solved(&self) -> usize {
        self.champion.iter().filter(|&&g| g >= SOLVED).count()
    }
}

pub fn run(args: Args) -> Result<(), Error> {
    let mut tasks = Vec::new();
    for path in &args.configs {
        let name = path.file_stem().map_or_else(|| "task".into(), |stem| stem.to_string_lossy().into_owned());
        if tasks.iter().any(|(other, _, _)| *other == name) {
            return Err(Error::Usage(format!("two configs have the name {name}; rename one").into()));
        }
        let text = config::read_file(path)?;
        let read = |sets: &[Override]| Config::read(&text, &config::name(path), &[], sets);
        let set = |key: &str, value: i64| Override::new(format!("learning.{key}"), value, format!("learning.{key}"));
        let common = [set("trials", args.trials.into()), set("seed", args.seed.into()), set("generations", SMALL.1)];
        let small = read(&[&common[..], &[set("population", SMALL.0)]].concat())?;
        let share = Override::new("learning.elites", "10%", "learning.elites");
        let large = match args.population {
            0 => None,
            policies => Some(read(&[&common[..], &[set("population", policies.into()), share]].concat())?),
        };
        tasks.push((name, path.clone(), [Some(small), large]));
    }
    let mut work = Work::default();
    for config in tasks.iter().flat_map(|(.., configs)| configs.iter().flatten()) {
        // One training after the other.
        FITNESSES.iter().for_each(|_| work += Work::of([config]));
    }
    let (mut player, on) = backend::open_for(&args.run, work)?;
    let start = match (args.resume, args.force) {
        (true, _) => Start::Resume,
        (_, true) => Start::Force,
        _ => Start::Fresh,
    };
    let disk = Disk::default();
    disk.create_folder(&args.out)
        .map_err(|error| crate::record::RecordError::Write { path: args.out.clone(), error })?;
    let disk = ownership::enter(&disk, &args.out, args.out != Path::new("tasks"))?;
    let signals = Signals::listen()?;
    let mut rows = vec![head(&args)];
    let mut refused = Vec::new();
    for (name, path, configs) in &tasks {
        if !args.quiet {
            say(format_args!("{name}: playing baselines and training on {on}"));
        }
        let small = configs[0].as_ref().expect("small populations are always trained");
        let baselines = baselines(small, &mut *player.0)?;
        let mut all: Vec<(Config, Fitness, PathBuf)> = Vec::new();
        for config in configs.iter().flatten() {
            for fitness in FITNESSES {
                let mut config = config.clone();
                config.learning.fitness = fitness;
                let folder = args.out.join(name).join(format!("{}-{fitness}", config.learning.population));
                all.push((config, fitness, folder));
            }
        }
        let mut trained = [vec![], vec![]];
        // One training at a time, because large populations take much memory.
        for (config, fitness, folder) in &all {
            Peaks::of([config], rayon::current_num_threads())
                .check(player.1.backend == "gpu")
                .map_err(RunError::from)?;
            let parent = folder.parent().unwrap_or(&args.out);
            disk.create_folder(parent)
                .map_err(|error| crate::record::RecordError::Write { path: parent.into(), error })?;
            let (mut session, _) = Session::open(vec![(config.clone(), folder.clone())], start, &disk)?;
            if !session.is_done() {
                let title = format!("{name}, {} policies, {fitness}", config.learning.population);
                let from = session.generations()[0];
                let names = vec![(title, Some(config.world.pois.len()))];
                let mut shown = Board::new(names, from, config.learning.generations, args.quiet);
                let context = Context {
                    tell: &|event| {
                        if let Event::Warning(text) = event {
                            say(text);
                        }
                    },
                    stop: &signals.stop,
                    save: &signals.save,
                    command: &recovery::typed(),
                    falls_back: args.loss.falls_back(),
                };
                let mut watch = |now: &Progress<'_>| shown.show(now.generations[0], now.rows);
                let ended = context.train(&mut watch, |options| session.train(&mut player, options));
                shown.clear();
                if ended? == Ended::Stopped {
                    return Err(Error::Stopped(
                        "with everything saved; run the same command with --resume to continue".into(),
                    ));
                }
            }
            let of = usize::from(config.learning.population != SMALL.0 as usize);
            trained[of].push(measure(config, *fitness, folder, &mut *player.0)?);
        }
        let scripted = path.with_extension("csv").is_file();
        let reason = reason(&baselines, &trained, scripted);
        rows.push(row(name, small, &baselines, &trained, scripted, reason.is_none()));
        refused.extend(reason.map(|reason| format!("{name}: {reason}")));
    }
    print(&format!("{}\n", markdown(&rows)))?;
    match refused.is_empty() {
        true => Ok(()),
        false => Err(Error::Refused(format!("not admitted:\n  {}", refused.join("\n  ")).into())),
    }
}

/// Plays the baselines of one task, with as many random teams as small populations evaluate.
fn baselines(config: &Config, backend: &mut dyn Backend) -> Result<[Vec<f64>; 3], Error> {
    let mut outcomes: Vec<Outcome> = Vec::new();
    for seed in 0..SEEDS {
        let mut baselines = Baselines::of_trial(config.clone(), seed);
        while !baselines.is_done() {
            baselines.advance(backend)?;
        }
        outcomes.extend(baselines.outcomes(backend, EPISODES)?.concat());
    }
    let g = |of: fn(&Outcome) -> f64| outcomes.iter().map(of).collect();
    Ok([g(|found| found.constants[found.best_constant]), g(|found| found.action), g(|found| found.network)])
}

/// Reads a finished run. If starts or POIs move, its champions play held-out episodes.
fn measure(config: &Config, fitness: Fitness, folder: &Path, backend: &mut dyn Backend) -> Result<Trained, Error> {
    let learning = &config.learning;
    let mut trained = Trained { fitness, champion: vec![0.0; learning.trials], best: vec![0.0; learning.trials] };
    runs::metrics(folder, config, Verification::Required, |row| {
        if row.generation == learning.generations {
            (trained.champion[row.trial], trained.best[row.trial]) = (row.champion_g, row.best_g);
        }
    })?;
    if learning.start_jitter > 0.0 || learning.poi_jitter > 0.0 {
        let weights = champions(&folder.join(POLICIES), config)?;
        let starts = Starts::Drawn {
            episodes: EPISODES,
            seed: 0,
            jitter: learning.start_jitter,
            poi_jitter: learning.poi_jitter,
        };
        let played = crate::front::play(config, backend, learning.trials, &weights, &starts)
            .map_err(|error| Error::Refused(error.to_string().into()))?;
        trained.champion = played.observed.iter().map(|observed| observed / config.world.pois.len() as f64).collect();
    }
    Ok(trained)
}

/// Returns why a task is not admitted.
fn reason(baselines: &[Vec<f64>; 3], trained: &[Vec<Trained>; 2], scripted: bool) -> Option<String> {
    let names = ["the best constant speed", "random constant actions", "random networks"];
    for (name, g) in names.iter().zip(baselines) {
        let g = mean(g);
        if g >= EASY {
            return Some(format!("G of {name} is {g:.2}; allowed below {EASY}"));
        }
    }
    let [small, large] = trained;
    if let Some(found) = small.iter().find(|found| 2 * found.solved() > found.champion.len()) {
        return Some(format!("{} policies solve it with fitness {}", SMALL.0, found.fitness));
    }
    if !scripted && large.iter().chain(small).all(|found| found.solved() == 0) {
        return Some("no champion solves it, and no scripted team stands beside the config".into());
    }
    None
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn head(args: &Args) -> Vec<String> {
    let teams = SMALL.0 * (SMALL.1 + 1);
    let mut head = vec![
        "task".to_string(),
        "best constant speed".into(),
        format!("best of {teams} constant actions"),
        format!("best of {teams} networks"),
    ];
    for population in [SMALL.0, args.population.into()].into_iter().filter(|&policies| policies > 0) {
        head.extend(FITNESSES.map(|fitness| format!("{population} policies, {fitness}")));
    }
    head.extend(["scripted team".into(), "admitted".into()]);
    head
}

fn row(
    name: &str,
    config: &Config,
    baselines: &[Vec<f64>; 3],
    trained: &[Vec<Trained>; 2],
    scripted: bool,
    admitted: bool,
) -> Vec<String> {
    let step = 1.0 / config.world.pois.len() as f64;
    let mut row = vec![name.to_string()];
    row.extend(baselines.iter().map(|g| format!("{:.2}", mean(g))));
    row.extend(trained.iter().flatten().map(|found| {
        let champion = statistics::mean(&found.champion, step).map(|mean| mean.within(0.0, 1.0));
        let champion = champion.map_or(String::new(), |g| format!("{:.2} [{:.2}, {:.2}]", g.value, g.low, g.high));
        format!("{champion} ({:.2}; {} of {})", mean(&found.best), found.solved(), found.champion.len())
    }));
    let word = |yes: bool| if yes { "yes" } else { "no" }.to_string();
    row.extend([word(scripted), word(admitted)]);
    row
}
