//! Trains the tasks of a suite, and checks that no baseline and no small population solves them.
//!
//! A task is admitted if no baseline solves it from any seed with [`BUDGET`] times the teams of a small population, if
//! populations of [`SMALL`] policies solve it under no fitness, and if something solves it: a champion here, or a
//! scripted team from a file next to the config.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::paper::check_fixed;
use crate::questions::run::stopped;
use crate::questions::{champions, play};
use flotilla::backend::{Backend, OpenBackend};
use flotilla::baseline::NAMES;
use flotilla::config::{Config, ConfigError, Fitness, Learning, Override, Problem, ValidConfig};
use flotilla::evaluate::Starts;
use flotilla::trainer::Row;
use flotilla::world::World;
use flotilla_app::choice::Work;
use flotilla_app::ops::{BackendSource, ConfigText, Context, Error, Event, baseline, check_memory, with_remedy};
use flotilla_app::record::RecordError;
use flotilla_app::record::digests::Verification;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{POLICIES, Start};
use flotilla_app::record::ownership;
use flotilla_app::report::runs;
use flotilla_app::run::{Progress, Session, SessionEnd};
use flotilla_app::script::Script;

/// Default folder.
pub const OUT: &str = "tasks";
/// Teams that each baseline plays, as multiples of those of a small population.
pub const BUDGET: usize = 10;
/// Number of policies in the small populations, and their number of generations.
pub const SMALL: (i64, i64) = (50, 100);
/// Number of repetitions of the baselines.
const SEEDS: usize = 10;
/// Number of held-out episodes per champion, if starts or POIs move.
const EPISODES: u32 = 200;
/// G above which a team solves a task. If starts or POIs move, no team observes all POIs in all episodes.
pub const SOLVED: f64 = 0.9;
/// The keys that all trainings fix. The last one is fixed for large populations only.
const FIXED: [&str; 6] = [
    "learning.fitness",
    "learning.trials",
    "learning.seed",
    "learning.generations",
    "learning.population",
    "learning.elites",
];
/// The fitnesses of both kinds of populations.
pub const FITNESSES: [Fitness; 4] = [Fitness::G, Fitness::D, Fitness::Df, Fitness::Dpp];

/// Request to check tasks.
#[derive(Clone, Debug)]
pub struct Request {
    /// The tasks.
    pub tasks: Vec<Task>,
    /// The folder for the runs.
    pub out: PathBuf,
    /// Whether the user chose the folder.
    pub named: bool,
    /// Treatment of runs that are in the folder.
    pub start: Start,
    /// Independent repetitions of every training.
    pub trials: u32,
    /// Policies per population of the large populations, of which 10 % are elites. 0 trains none.
    pub population: u32,
    /// Random seed.
    pub seed: u32,
}

/// A task.
#[derive(Clone, Debug)]
pub struct Task {
    /// The name.
    pub name: String,
    /// The config.
    pub config: ConfigText,
    /// A scripted team.
    pub script: Option<Script>,
}

/// Results of a suite.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Policies per large population.
    pub population: u32,
    /// The tasks.
    pub tasks: Vec<Found>,
}

impl Outcome {
    /// Returns an error that names the tasks that are not admitted, if there are any.
    pub fn refused(&self) -> Option<Error> {
        let reason = |task: &Found| Some(format!("{}: {}", task.name, task.refused.as_ref()?));
        let reasons: Vec<String> = self.tasks.iter().filter_map(reason).collect();
        (!reasons.is_empty()).then(|| Error::Refused(format!("not admitted:\n  {}", reasons.join("\n  ")).into()))
    }
}

/// Results of a task.
#[derive(Clone, Debug, Serialize)]
pub struct Found {
    /// The name.
    pub name: String,
    /// Number of POIs.
    pub pois: usize,
    /// G of each baseline of [`NAMES`], per seed.
    pub baselines: [Vec<f64>; NAMES.len()],
    /// The trainings.
    pub trained: Vec<Trained>,
    /// G of the scripted team, if there is one: from the config's start, or over held-out episodes if starts or POIs
    /// move.
    pub scripted_g: Option<f64>,
    /// Whether the scripted team solves the task: with fixed starts it has to observe every POI.
    pub scripted: bool,
    /// Why the task is not admitted.
    pub refused: Option<String>,
}

/// Results of one training.
#[derive(Clone, Debug, Serialize)]
pub struct Trained {
    /// Policies per population.
    pub population: usize,
    /// The fitness.
    pub fitness: Fitness,
    /// G of each trial's champion.
    pub champion_g: Vec<f64>,
    /// G of each trial's best team.
    pub best_g: Vec<f64>,
}

impl Trained {
    /// Returns the number of trials whose champion solves the task.
    pub fn solved(&self) -> usize {
        self.champion_g.iter().filter(|&&g| g >= SOLVED).count()
    }
}

/// Trains and checks all tasks, one after the other.
///
/// # Errors
/// A config is invalid, the folder cannot be used, or training fails or is stopped. A task that is not admitted is an
/// outcome.
pub fn run(request: &Request, backends: &mut dyn BackendSource, context: Context<'_>) -> Result<Outcome, Error> {
    if i64::from(request.population) == SMALL.0 {
        let message = format!("--population {}: the small populations have this size", SMALL.0);
        return Err(Error::Usage(with_remedy(message, "choose another, or 0 for none")));
    }
    // Each task with G of its scripted team and its configs, that of the small populations first.
    let mut tasks: Vec<(&Task, Option<f64>, Vec<Config>)> = Vec::new();
    for task in &request.tasks {
        let name = &task.name;
        if tasks.iter().any(|(other, ..)| other.name == *name) {
            return Err(Error::Usage(format!("two configs have the name {name}; rename one").into()));
        }
        let fixed = &FIXED[..FIXED.len() - usize::from(request.population == 0)];
        check_fixed(&task.config.set, fixed, "the trainings of all tasks")?;
        let set =
            |key: &str, value: toml::Value| Override::new(format!("learning.{key}"), value, format!("learning.{key}"));
        let common = [("trials", request.trials.into()), ("seed", request.seed.into()), ("generations", SMALL.1)];
        let common = common.map(|(key, value): (&str, i64)| set(key, value.into()));
        let read = |more: &[Override]| {
            let set = [&task.config.set[..], &common, more].concat();
            ConfigText { set, ..task.config.clone() }.read()
        };
        let mut configs = vec![read(&[set("population", SMALL.0.into())])?];
        if request.population > 0 {
            configs.push(read(&[set("population", request.population.into()), set("elites", "10%".into())])?);
        }
        if !configs[0].stages.is_empty() {
            let message = "a task is one world for baselines, scripted teams and training: leave the stages out".into();
            let problems = vec![Problem { line: None, key: "stages".into(), message }];
            return Err(ConfigError::Invalid { name: name.clone(), problems, unlisted: 0 }.into());
        }
        let scripted_g = task.script.as_ref().map(|script| play_script(script, name, &configs[0])).transpose()?;
        tasks.push((task, scripted_g, configs));
    }
    let mut work = Work::default();
    for config in tasks.iter().flat_map(|(.., configs)| configs) {
        // One training after the other.
        FITNESSES.iter().for_each(|_| work += Work::of([config]));
    }
    let (backend, on) = backends.open(work)?;
    let disk = ownership::create_output_folder(&Disk::default(), &request.out, request.named)?;
    let mut found = Vec::new();
    for (task, scripted_g, configs) in tasks {
        let name = &task.name;
        context.message(format_args!("{name}: playing baselines and training on {on}"));
        let small = &configs[0];
        let mut searched = small.clone();
        searched.learning.population *= BUDGET;
        let baselines = play_baselines(&searched.validate()?, &mut *backend.0, context.quiet())?;
        let mut trained = Vec::new();
        // One training at a time, because large populations take much memory.
        for config in &configs {
            for fitness in FITNESSES {
                let mut config = config.clone();
                config.learning.fitness = fitness;
                let parent = request.out.join(name);
                disk.create_folder(&parent).map_err(RecordError::write(&parent))?;
                let folder = parent.join(format!("{}-{fitness}", config.learning.population));
                train(&config, name, &folder, request.start, &disk, backend, context)?;
                trained.push(measure(&config, &disk, &folder, &mut *backend.0)?);
            }
        }
        let pois = small.poi_count();
        let scripted = scripted_g.is_some_and(|g| g >= if moves(small) { SOLVED } else { 1.0 });
        let refused = reason(&baselines, &trained, scripted_g, scripted);
        found.push(Found { name: name.clone(), pois, baselines, trained, scripted_g, scripted, refused });
    }
    Ok(Outcome { population: request.population, tasks: found })
}

/// Returns G of each baseline of [`NAMES`], per seed. If it is stopped, earlier trainings are saved.
pub(crate) fn play_baselines(
    config: &ValidConfig,
    backend: &mut dyn Backend,
    context: Context<'_>,
) -> Result<[Vec<f64>; NAMES.len()], Error> {
    let played = baseline::play(config, SEEDS, EPISODES, backend, context).map_err(|error| match error {
        Error::Stopped(_) => stopped(),
        error => error,
    })?;
    Ok(std::array::from_fn(|index| played.iter().map(|outcome| outcome.all()[index]).collect()))
}

/// Returns G of a task's scripted team.
fn play_script(script: &Script, name: &str, config: &Config) -> Result<f64, Error> {
    let invalid = |error: String| Error::Usage(format!("{name}: scripted team: {error}").into());
    script.check(config).map_err(invalid)?;
    let valid = config.validate()?;
    let starts = if moves(config) { held_out(config) } else { Starts::Own };
    let (world, mut observed) = (World::new(&valid), 0);
    for episode in 0..starts.episodes() {
        let played = script.play_from(valid.as_ref(), &starts, episode).map_err(|error| invalid(error.to_string()))?;
        observed +=
            played.iter().zip(&world.worth).filter(|(step, _)| step.is_some()).map(|(_, worth)| worth).sum::<u32>();
    }
    Ok(f64::from(observed) / (f64::from(world.total_worth) * starts.episodes() as f64))
}

/// Reports whether starts or POIs move.
fn moves(config: &Config) -> bool {
    config.starts_move() || config.pois_move()
}

/// Returns the starts of held-out episodes.
fn held_out(config: &Config) -> Starts {
    let Learning { start_jitter: jitter, poi_jitter, .. } = config.learning;
    Starts::Drawn { episodes: EPISODES, seed: 0, jitter, poi_jitter }
}

/// Trains one run of a task, unless it is finished.
pub(crate) fn train(
    config: &Config,
    task: &str,
    folder: &Path,
    start: Start,
    disk: &Disk,
    backend: &mut OpenBackend,
    context: Context<'_>,
) -> Result<(), Error> {
    check_memory([&config.validate()?], backend)?;
    let (mut session, _) = Session::open(vec![(config.clone(), folder.into())], start, disk)?;
    if session.is_done() {
        return Ok(());
    }
    let learning = &config.learning;
    let title = format!("{task}, {} policies, {}", learning.population, learning.fitness);
    let names = vec![(title, Some(config.poi_count()))];
    (context.report)(Event::Begin(names, session.generations()[0], learning.generations));
    let mut watch = |now: &Progress<'_>| context.rows(now.generations[0], now.rows);
    let ended = context.train(&mut watch, |options| session.train(backend, options));
    context.pause();
    match ended? {
        SessionEnd::Finished => Ok(()),
        SessionEnd::Stopped => Err(stopped()),
    }
}

/// Reads a finished run. If starts or POIs move, its champions play held-out episodes.
fn measure(config: &Config, disk: &Disk, folder: &Path, backend: &mut dyn Backend) -> Result<Trained, Error> {
    let [mut champion_g, best_g] = last_g(config, disk, folder, |row| row.best_g)?;
    if moves(config) {
        champion_g = play_champions(config, disk, folder, &held_out(config), backend)?;
    }
    Ok(Trained { population: config.learning.population, fitness: config.learning.fitness, champion_g, best_g })
}

/// Returns G of every trial's champion in the last generation of a finished run, and another G of the same row.
pub(crate) fn last_g(
    config: &Config,
    disk: &Disk,
    folder: &Path,
    other: fn(&Row) -> f64,
) -> Result<[Vec<f64>; 2], Error> {
    let mut found = [vec![0.0; config.learning.trials], vec![0.0; config.learning.trials]];
    runs::metrics(disk.at(folder), config, Verification::Required, |row| {
        if row.generation == config.learning.generations {
            (found[0][row.trial], found[1][row.trial]) = (row.champion_g, other(row));
        }
    })?;
    Ok(found)
}

/// Returns G of every trial's champion in a finished run, over all starts.
pub(crate) fn play_champions(
    config: &Config,
    disk: &Disk,
    folder: &Path,
    starts: &Starts,
    backend: &mut dyn Backend,
) -> Result<Vec<f64>, Error> {
    play(config, &champions(disk.at(&folder.join(POLICIES)), config)?, starts, backend)
}

/// Returns why a task is not admitted.
fn reason(baselines: &[Vec<f64>], trained: &[Trained], scripted_g: Option<f64>, scripted: bool) -> Option<String> {
    for (name, seeds) in NAMES.iter().zip(baselines) {
        let g = seeds.iter().copied().fold(0.0, f64::max);
        if g >= SOLVED {
            return Some(format!("the baseline {name} reaches G {g:.2}; allowed below {SOLVED}"));
        }
    }
    let small = |found: &&Trained| found.population == SMALL.0 as usize;
    if let Some(found) = trained.iter().filter(small).find(|found| 2 * found.solved() > found.champion_g.len()) {
        return Some(format!("{} policies solve it with fitness {}", SMALL.0, found.fitness));
    }
    match scripted_g {
        Some(_) if scripted => None,
        Some(g) => {
            Some(format!("the scripted team has G {g:.3}; it has to have 1, or {SOLVED} if starts or POIs move"))
        }
        None if trained.iter().any(|found| found.solved() > 0) => None,
        None => Some("no champion solves it, and there is no scripted team beside the config".into()),
    }
}

/// Returns the mean of some values.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}
