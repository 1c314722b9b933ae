//! The functions that most programs need: train with a callback, play and trace given policies, step teams by given
//! actions, and read runs.
//!
//! All functions check their arguments and return flat arrays. The documentation gives their shapes, for example
//! `[teams][leaders][8]`; the last index changes fastest. The functions build on [`crate::trainer`],
//! [`crate::evaluate`], [`crate::stepping`] and [`crate::record`]. Training that saves its files as it goes, and can be
//! resumed, is in [`crate::run`].

use std::borrow::Cow;
use std::ops::{ControlFlow, Range};
#[cfg(feature = "record")]
use std::path::Path;

use crate::backend::cpu::{Cpu, Noise, StepArrays};
#[cfg(feature = "gpu")]
use crate::backend::gpu::{
    self,
    device::{DeviceError, Wanted},
    episode::{GpuBackend, ResidencyPolicy},
};
use crate::backend::{Backend, BackendError, Group, GroupScores, Machine, OpenBackend};
use crate::config::{Config, ConfigError, Fitness, MAX_POPULATION, Sharing, ValidConfig};
use crate::evaluate::{self, Evaluation, MAX_EPISODES, Starts};
use crate::evolve::{self, Key, MAX_WEIGHT, Purpose};
use crate::memory::{self, Peaks, TooLittle};
use crate::parallel::current_num_threads;
#[cfg(feature = "record")]
use crate::record::{
    RecordError,
    digests::{Digests, Verification},
    finished,
    folder::POLICIES,
    hex, metrics, policies, runs,
};
use crate::stepping::{StepError, Stepper};
use crate::trainer::{self, Ending, Row, Snapshot, Trainer};
use crate::world::{INPUTS, OUTPUTS, World};

mod coevolution;

pub use coevolution::{Coevolution, Progress};

/// The error of a function in this module. A failed call changes nothing.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Failure {
    /// All problems of a config.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The machine has less memory than the training needs.
    #[error(transparent)]
    TooLittle(#[from] TooLittle),
    /// The system cannot allocate the memory.
    #[error("not enough memory for {what}, {bytes} bytes")]
    Memory {
        /// The purpose of the memory.
        what: &'static str,
        /// Number of bytes requested.
        bytes: u128,
    },
    /// Episodes could not be played.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The number of teams is not allowed.
    #[error("{0} teams; there may be 1 to {MAX_POPULATION}")]
    Teams(usize),
    /// The number of weights does not match the teams.
    #[error(
        "{found} weights for {teams} teams; [leaders][teams][parameters] are [{leaders}][{teams}][{parameters}], or \
         [1][{teams}][{parameters}] if leaders share a policy"
    )]
    Weights {
        /// Number of weights given.
        found: usize,
        /// Number of leaders per team.
        leaders: usize,
        /// Number of teams requested.
        teams: usize,
        /// Number of weights per policy.
        parameters: usize,
    },
    /// The number of trials with given policies does not match the config.
    #[error(
        "{found} trials have policies, but the config has {trials} trials; pass one array for all trials, or one per trial"
    )]
    Trials {
        /// Number of trials given.
        found: usize,
        /// Number of trials of the config.
        trials: usize,
    },
    /// A weight is too large or not a number.
    #[error(
        "weight {parameter} of the policy of leader {leader} in team {team} is {value}, allowed are -{MAX_WEIGHT} to {MAX_WEIGHT}"
    )]
    Weight {
        /// Index of the leader in its team.
        leader: usize,
        /// Index of the team, from 0.
        team: usize,
        /// Index of the weight in the policy.
        parameter: usize,
        /// The value given.
        value: f32,
    },
    /// The starts cannot be drawn.
    #[error(
        "{episodes} episodes from starts moved by up to {jitter}; allowed are 1 to {MAX_EPISODES} episodes and a jitter of 0 or more"
    )]
    Starts {
        /// Number of episodes per team.
        episodes: u32,
        /// The jitter in units.
        jitter: f64,
    },
    /// [`Starts`] has no such episode.
    #[error("episode {episode} of {episodes} (they count from 0)")]
    NoEpisode {
        /// The requested episode, from 0.
        episode: usize,
        /// Number of episodes.
        episodes: usize,
    },
    /// The fitness that was told does not fit, or is not finite.
    #[error("fitness: {0}")]
    Fitness(String),
    /// A saved state does not fit the config.
    #[error("the state is of another config, or damaged")]
    State,
    /// All generations were played.
    #[error("all generations were played")]
    Done,
    /// The teams could not be created.
    #[error(transparent)]
    Step(#[from] StepError),
    /// A run's directory could not be read.
    #[cfg(feature = "record")]
    #[error(transparent)]
    Run(#[from] runs::ReadError),
    /// A run's files could not be read or written.
    #[cfg(feature = "record")]
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// The processor that plays episodes.
#[cfg(feature = "gpu")]
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Processor {
    /// A usable GPU if there is one, else the CPU. Software renderers are ignored.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU. Software renderers are ignored.
    Gpu,
    /// An adapter, selected by its index in `gpu::device::adapters` or by part of its name. It may be a software
    /// renderer.
    Adapter(String),
}

/// The result of the search for a GPU.
#[cfg(feature = "gpu")]
#[non_exhaustive]
pub struct Found {
    /// The opened GPU, if one is used.
    pub gpu: Option<GpuBackend>,
    /// The reason why an existing GPU is not used.
    pub passed_over: Option<DeviceError>,
}

/// Opens the GPU that the processor asks for, if any. `holding` selects the populations that the GPU keeps between
/// generations; without it, the backend's default applies.
///
/// With [`Processor::Auto`], a missing or unusable GPU is an error only if `holding` is [`ResidencyPolicy::Always`].
///
/// # Errors
/// The requested GPU does not exist or cannot be used.
#[cfg(feature = "gpu")]
pub fn find_gpu(processor: &Processor, holding: Option<ResidencyPolicy>) -> Result<Found, DeviceError> {
    let choice = match processor {
        Processor::Cpu => return Ok(Found { gpu: None, passed_over: None }),
        Processor::Auto | Processor::Gpu => Wanted::Real,
        Processor::Adapter(name) => Wanted::Named(name.clone()),
    };
    let optional = *processor == Processor::Auto && holding != Some(ResidencyPolicy::Always);
    match gpu::open(choice).and_then(GpuBackend::new) {
        Ok(gpu) => {
            let gpu = match holding {
                Some(holding) => gpu.holding(holding),
                None => gpu,
            };
            Ok(Found { gpu: Some(gpu), passed_over: None })
        }
        Err(DeviceError::NoAdapter | DeviceError::NoRealAdapter { .. }) if optional => {
            Ok(Found { gpu: None, passed_over: None })
        }
        Err(error) if optional => Ok(Found { gpu: None, passed_over: Some(error) }),
        Err(error) => Err(error),
    }
}

/// Opens the backend for a processor. Also returns why an existing GPU is not used, if so.
///
/// # Errors
/// The requested GPU does not exist or cannot be used.
#[cfg(feature = "gpu")]
pub fn open(processor: &Processor) -> Result<(OpenBackend, Option<DeviceError>), DeviceError> {
    let Found { gpu, passed_over } = find_gpu(processor, None)?;
    Ok((gpu.map_or_else(cpu, on_gpu), passed_over))
}

/// Returns the CPU backend, which is always available.
pub fn cpu() -> OpenBackend {
    (Box::new(Cpu::default()), Machine::of_cpu())
}

/// Returns an opened GPU as a backend, with its description.
#[cfg(feature = "gpu")]
pub fn on_gpu(backend: GpuBackend) -> OpenBackend {
    let machine = Machine::of_gpu(&backend);
    (Box::new(backend), machine)
}

/// One generation of all trials, reported after its teams and champions have played.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub struct Generation<'a> {
    /// Index of the generation. Generation 0 plays the initial policies.
    pub generation: usize,
    /// Index of the last generation.
    pub last: usize,
    /// The results, one row per trial.
    pub rows: &'a [Row],
    /// The best policy of each population, `[trials][populations][parameters]`, if [`train_with_champions`] trains.
    pub champions: Option<&'a [f32]>,
}

/// The results of a training.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Trained {
    /// The config that was trained. If the training was stopped early, it has fewer generations.
    pub config: Config,
    /// G of each generation's best team, in 0..1: `[trials][generations + 1]`, generation 0 first.
    pub best_g: Vec<f64>,
    /// Mean G of each generation's teams: `[trials][generations + 1]`.
    pub mean_g: Vec<f64>,
    /// G of the champion, the team of every population's best policy: `[trials][generations + 1]`.
    pub champion_g: Vec<f64>,
    /// The last generation's policies, best first in each population: `[trials]` of `[leaders][policies][parameters]`.
    pub policies: Vec<Vec<f32>>,
    /// State that a longer run continues from. `None` if the run was read from a directory without its last checkpoint.
    pub ending: Option<Ending>,
}

impl Trained {
    fn new(config: Config, rows: &[Row], policies: Vec<Vec<f32>>, ending: Option<Ending>) -> Trained {
        let columns = config.learning.generations + 1;
        let mut trained = Trained {
            best_g: vec![0.0; config.learning.trials * columns],
            mean_g: vec![0.0; config.learning.trials * columns],
            champion_g: vec![0.0; config.learning.trials * columns],
            config,
            policies,
            ending,
        };
        for row in rows {
            let at = row.trial * columns + row.generation;
            (trained.best_g[at], trained.mean_g[at], trained.champion_g[at]) = (row.best_g, row.mean_g, row.champion_g);
        }
        trained
    }

    /// Returns the results of a trainer's only experiment, which is done.
    fn of(trainer: &mut Trainer, config: Config, rows: &[Row]) -> Result<Trained, Failure> {
        let bytes = config.policy_bytes().into();
        let (policies, end) = trainer.ends(&[0]).remove(0);
        let policies = policies.into_iter().map(<[f32]>::to_vec).collect();
        let memory = |_| Failure::Memory { what: "the last generation", bytes };
        let Snapshot { weights, fitness, .. } = end.copy().map_err(memory)?;
        Ok(Trained::new(config, rows, policies, Some(Ending { weights, fitness })))
    }

    /// Reads the results of a finished run from its directory.
    ///
    /// # Errors
    /// The directory has no finished run, or its files are damaged or were changed after the run.
    #[cfg(feature = "record")]
    pub fn read(folder: &Path, verification: Verification) -> Result<Trained, Failure> {
        let config = runs::config(folder, verification)?;
        let (mut rows, mut turns) = (Vec::new(), vec![0; config.learning.trials]);
        let mut in_turn = true;
        runs::metrics(folder, &config, verification, |row| {
            in_turn &= turns[row.trial] == row.generation;
            turns[row.trial] += 1;
            rows.push(*row);
        })?;
        if !in_turn {
            let path = folder.join(crate::record::folder::METRICS);
            let reason = "it must have one row per trial and generation, in order".into();
            return Err(RecordError::Damaged { path, reason }.into());
        }
        let (found, expected) = (rows.len(), config.learning.trials * (config.learning.generations + 1));
        if found != expected {
            let reason = format!("its {} has {found} rows of {expected}", crate::record::folder::METRICS);
            return Err(runs::ReadError::Unfinished { folder: folder.into(), reason }.into());
        }
        let path = folder.join(POLICIES);
        let policies = policies::read_all(&path, &config)?;
        let digests = Digests::read(folder, verification)?;
        let ending = finished::read_ending(folder, &config);
        let trained = Trained::new(config, &rows, policies, ending);
        // The config and the metrics match their digests, so the policies must differ.
        match digests.run {
            Some(digest) if digest != trained.digest() => Err(RecordError::Differs { path }.into()),
            _ => Ok(trained),
        }
    }

    /// Returns the digest of the metrics and all policies, equal to the one that `run.json` records for the same
    /// results.
    #[cfg(feature = "record")]
    pub fn digest(&self) -> String {
        let trials = self.config.learning.trials;
        let rows = (0..=self.config.learning.generations).flat_map(|generation| {
            (0..trials).map(move |trial| {
                let at = trial * (self.config.learning.generations + 1) + generation;
                let (best_g, mean_g, champion_g) = (self.best_g[at], self.mean_g[at], self.champion_g[at]);
                Row { experiment: 0, trial, generation, best_g, mean_g, champion_g }
            })
        });
        hex(&metrics::digest(rows, &self.policies))
    }
}

/// Trains all trials of a config and calls `watch` after every generation.
///
/// If `watch` returns [`ControlFlow::Break`], one more generation plays and the training ends. The results are then bit
/// for bit those of a config with that many generations.
///
/// # Errors
/// The config is invalid, its memory does not fit this machine, or the backend fails.
pub fn train(
    config: &Config,
    backend: &mut dyn Backend,
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_from(config, backend, 0, &[], watch)
}

/// Trains as [`train`] does, but starts from given policies instead of random ones.
///
/// `first` has one array `[leaders][policies][parameters]` per trial, or one for all trials. If leaders share a policy,
/// the shape is `[1][policies][parameters]`. A larger population fills its remaining slots with random policies. A
/// smaller one takes the first policies.
///
/// # Errors
/// As for [`train`], or the policies do not fit the config.
pub fn train_from(
    config: &Config,
    backend: &mut dyn Backend,
    policies: usize,
    first: &[Vec<f32>],
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_by(config, backend, (policies, first), false, watch)
}

/// Trains as [`train`] does, and gives `watch` the champions of every generation. A device that holds populations returns
/// them after every generation.
///
/// # Errors
/// As for [`train`].
pub fn train_with_champions(
    config: &Config,
    backend: &mut dyn Backend,
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_by(config, backend, (0, &[]), true, watch)
}

fn train_by(
    config: &Config,
    backend: &mut dyn Backend,
    (policies, first): (usize, &[Vec<f32>]),
    with_champions: bool,
    mut watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    let valid = config.validate()?;
    let mut config = Config::clone(&valid);
    let (mut trainer, mut rows, mut stopped) = (trainer_of(valid)?, Vec::new(), false);
    start_from(&mut trainer, &config, policies, first)?;
    while !trainer.is_done() {
        // Champions play together with the next generation, which completes the rows of theirs.
        let best = with_champions.then(|| champions(&mut trainer, &config)).transpose()?;
        let played = trainer.advance(backend)?;
        if let Some(&Row { generation, .. }) = played.first().filter(|_| !stopped) {
            let last = config.learning.generations;
            let champions = best.as_deref();
            stopped = watch(Generation { generation, last, rows: &played, champions }).is_break();
            if stopped {
                config.learning.generations = trainer.end(0);
                config.stages.retain(|stage| stage.from <= config.learning.generations);
            }
        }
        rows.extend(played);
    }
    Trained::of(&mut trainer, config, &rows)
}

/// Returns the champions of the previous generation, `[trials][populations][parameters]`.
fn champions(trainer: &mut Trainer, config: &Config) -> Result<Vec<f32>, BackendError> {
    let (parameters, population) = (config.parameters(), config.learning.population);
    let champion = population * parameters..(population + 1) * parameters;
    let mut best = Vec::new();
    for trial in 0..config.learning.trials {
        for policies in trainer.weights(0, trial)?.chunks_exact(config.learning.slots() * parameters) {
            best.extend_from_slice(&policies[champion.clone()]);
        }
    }
    Ok(best)
}

/// Checks that a training fits this machine's memory, and returns its trainer.
fn trainer_of(config: ValidConfig) -> Result<Trainer, Failure> {
    let plan = Peaks::of([&*config], current_num_threads());
    // Nothing is saved during training, but the results stay in memory: every row twice, and the policies.
    let rows = config.learning.trials as u64 * (config.learning.generations as u64 + 1);
    // The last slots stay too, if they are needed to extend the run.
    let slots = if config.learning.extends_from_policies() { 0 } else { trainer::snapshot_bytes(&config) };
    let kept = rows * (size_of::<Row>() + 3 * size_of::<f64>()) as u64 + config.policy_bytes() + slots;
    let needed = (plan.host.min(plan.gpu_host) - plan.checkpoint).saturating_add(kept);
    memory::check(needed, 0)?;
    Ok(Trainer::new([config]))
}

/// Puts given policies into the populations of a new trainer.
fn start_from(trainer: &mut Trainer, config: &Config, policies: usize, first: &[Vec<f32>]) -> Result<(), Failure> {
    let (leaders, parameters, trials) = (config.populations(), config.parameters(), config.learning.trials);
    if first.len() > 1 && first.len() != trials {
        return Err(Failure::Trials { found: first.len(), trials });
    }
    for (trial, weights) in (0..trials).zip(first.iter().cycle()) {
        let mut weights = weights.clone();
        if weights.is_empty() || Some(weights.len()) != (leaders * parameters).checked_mul(policies) {
            return Err(Failure::Weights { found: weights.len(), leaders, teams: policies, parameters });
        }
        if let Some(place) = evolve::admit(&mut weights) {
            let (policy, parameter, value) = (place / parameters, place % parameters, weights[place]);
            return Err(Failure::Weight { leader: policy / policies, team: policy % policies, parameter, value });
        }
        if !trainer.start_from(0, trial, policies, &weights) {
            unreachable!("the weights are as many as the config takes");
        }
    }
    Ok(())
}

/// The scores of teams, averaged over episodes.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Played {
    /// Number of POIs observed, `[teams]`.
    pub observed: Vec<f64>,
    /// G, the share of POIs observed, in 0..1, `[teams]`.
    pub g: Vec<f32>,
    /// D, `[teams][leaders]`.
    pub d: Vec<f32>,
    /// Df, `[teams][leaders]`.
    pub df: Vec<f32>,
    /// D++, `[teams][leaders]`.
    pub dpp: Vec<f32>,
    /// Dt, `[teams][leaders]`. Empty unless Dt is the config's fitness, because Dt needs a record of who was seen at
    /// every step.
    pub dt: Vec<f32>,
}

/// Plays teams of given policies, `[leaders][teams][parameters]`. Team `t` consists of every leader's policy `t`. If
/// the leaders of a team share one policy, `[1][teams][parameters]` is enough.
///
/// A policy's parameters are its layers in order. Each layer has its weights row-major, `W[in, out]`, then its biases
/// `b[out]`.
///
/// # Errors
/// The config, the number of teams, the weights or the starts are invalid, memory is insufficient, or the backend fails.
pub fn play(
    config: &Config,
    backend: &mut dyn Backend,
    teams: usize,
    weights: &[f32],
    starts: &Starts,
) -> Result<Played, Failure> {
    let each = &mut |_: evaluate::Batch<'_>| ControlFlow::Continue(());
    Ok(Played::from(&play_until(config, backend, teams, weights, starts, each)?))
}

/// Plays teams as [`play`] does, and calls `each` several times per second, see [`evaluate::evaluate_until`].
///
/// # Errors
/// As for [`play`].
pub fn play_until(
    config: &Config,
    backend: &mut dyn Backend,
    teams: usize,
    weights: &[f32],
    starts: &Starts,
    each: &mut dyn FnMut(evaluate::Batch<'_>) -> ControlFlow<()>,
) -> Result<Evaluation, Failure> {
    let checked = CheckedTeams::new(config, teams, weights, starts)?;
    let group = Group { fitnesses: scores_of(config), ..checked.group(&checked.world.starts) };
    Ok(evaluate::evaluate_until(backend, &group, starts, &mut |_| (), each)?)
}

/// Returns the fitnesses that teams of a config are scored by: Dt only if it is the config's fitness.
fn scores_of(config: &Config) -> &'static [Fitness] {
    evaluate::scores_beside(config.learning.fitness)
}

impl From<&Evaluation> for Played {
    fn from(evaluation: &Evaluation) -> Played {
        let (teams, leaders) = (evaluation.observed.len(), evaluation.leaders);
        let places = || (0..teams * leaders).map(|place| (place / leaders, place % leaders));
        let scores: Vec<[f32; 4]> = places().map(|(team, leader)| evaluation.scores(team, leader)).collect();
        Played {
            observed: evaluation.observed.iter().map(evaluate::Tally::mean).collect(),
            g: scores.iter().step_by(leaders).map(|&[g, ..]| g).collect(),
            d: scores.iter().map(|&[_, d, ..]| d).collect(),
            df: scores.iter().map(|&[_, _, df, _]| df).collect(),
            dpp: scores.iter().map(|&[.., dpp]| dpp).collect(),
            dt: places().filter_map(|(team, leader)| evaluation.dt(team, leader)).collect(),
        }
    }
}

/// Noise on the actions of leaders: its seed, and the standard deviation of each leader's turn and speed, `[leaders]`.
#[derive(Clone, Copy, Debug)]
pub struct ActionNoise<'a> {
    /// Random seed.
    pub seed: u64,
    /// `[leaders]`, each from 0 on.
    pub deviations: &'a [[f32; OUTPUTS]],
}

/// Plays some episodes of given policies on the CPU, writes the steps of all teams, and returns the scores of each
/// episode, by the fitnesses of [`evaluate::scores_beside`]. In the arrays, the teams of an episode follow those of the
/// one before. See [`play`] for the other arguments.
///
/// Without noise, the states and scores are those of [`trace`] and [`play`].
///
/// # Errors
/// The config, the weights or the starts are invalid, an array has the wrong length, or there is no such episode.
pub fn record(
    config: &Config,
    teams: usize,
    weights: &[f32],
    starts: &Starts,
    episodes: Range<usize>,
    noise: Option<ActionNoise<'_>>,
    arrays: StepArrays<'_>,
) -> Result<Vec<GroupScores>, Failure> {
    let checked = CheckedTeams::new(config, teams, weights, starts)?;
    if episodes.end > starts.episodes() || episodes.is_empty() {
        return Err(Failure::NoEpisode { episode: episodes.end, episodes: starts.episodes() });
    }
    let drawn: Vec<Vec<glam::Vec2>> = episodes.clone().map(|episode| starts.of(episode, &checked.world)).collect();
    let fitnesses = scores_of(config);
    let groups: Vec<Group<'_>> = drawn.iter().map(|starts| Group { fitnesses, ..checked.group(starts) }).collect();
    let noise = noise.map(|ActionNoise { seed, deviations }| Noise {
        key: Key::new(seed, 0, Purpose::Exploration),
        deviations,
        first: (episodes.start * teams) as u32,
    });
    Ok(Cpu::default().record(&groups, noise, arrays)?)
}

/// The states, inputs, outputs and observations of every step of one episode.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Traced {
    /// Positions in units, `[teams][steps + 1][agents][2]`. Step 0 is the start. Leaders come first.
    pub positions: Vec<f32>,
    /// Headings as unit vectors, `[teams][steps + 1][agents][2]`.
    pub headings: Vec<f32>,
    /// Speeds in units per second, `[teams][steps + 1][agents]`.
    pub speeds: Vec<f32>,
    /// The leaders' inputs, `[teams][steps][leaders][8]`. Index 0 is sensed at the start.
    pub inputs: Vec<f32>,
    /// The outputs of the leaders' policies for these inputs, `[teams][steps][leaders][2]`. They lead to the next
    /// step's state.
    pub outputs: Vec<f32>,
    /// The agents within the observation radius of each POI after each step, `[teams][steps][pois][words]`. Each agent
    /// is one bit.
    pub near: Vec<u32>,
}

/// Plays one episode of given policies and records every step. See [`play`] for the arguments.
///
/// # Errors
/// The config, the weights or the starts are invalid, the memory is insufficient, or the backend fails.
pub fn trace(
    config: &Config,
    backend: &mut dyn Backend,
    teams: usize,
    weights: &[f32],
    starts: &Starts,
    episode: usize,
) -> Result<Traced, Failure> {
    let checked = CheckedTeams::new(config, teams, weights, starts)?;
    if episode >= starts.episodes() {
        return Err(Failure::NoEpisode { episode, episodes: starts.episodes() });
    }
    let world = &checked.world;
    let (agents, leaders, steps) = (world.agents(), world.leaders(), world.steps());
    let words_per_team = (steps + 1) * agents * 5 + steps * leaders * (INPUTS + OUTPUTS) + world.set_words();
    let bytes = words_per_team as u128 * 4 * teams as u128;
    let fits = usize::try_from(bytes).is_ok_and(|bytes| Vec::<u8>::new().try_reserve_exact(bytes).is_ok());
    if !fits {
        return Err(Failure::Memory { what: "all steps of all teams", bytes });
    }
    let states = teams * (steps + 1) * agents;
    let mut traced = Traced {
        positions: Vec::with_capacity(states * 2),
        headings: Vec::with_capacity(states * 2),
        speeds: Vec::with_capacity(states),
        inputs: Vec::with_capacity(teams * steps * leaders * INPUTS),
        outputs: Vec::with_capacity(teams * steps * leaders * OUTPUTS),
        near: Vec::with_capacity(teams * world.set_words()),
    };
    let starts = starts.of(episode, world);
    for (_, part) in evaluate::parts(&checked.group(&starts)) {
        let trace = backend.trace(&part)?;
        for (team, step) in (0..trace.teams).flat_map(|team| (0..=steps).map(move |step| (team, step))) {
            for moment in (0..agents).map(|agent| trace.moment(step, team, agent)) {
                traced.positions.extend(moment.position);
                traced.headings.extend(moment.heading);
                traced.speeds.push(moment.speed);
            }
            // A trace stores inputs and outputs with the state that they lead to.
            for moment in (0..leaders).filter(|_| step > 0).map(|leader| trace.moment(step, team, leader)) {
                traced.inputs.extend(moment.inputs);
                traced.outputs.extend(moment.outputs);
            }
        }
        traced.near.extend(trace.sets);
    }
    Ok(traced)
}

/// Creates teams that are stepped by given actions, all at the world's start. With `recording`, the teams can be
/// scored, including Dt if that is the config's fitness.
///
/// # Errors
/// The config is invalid, the number of teams is not allowed, or memory is insufficient.
pub fn stepper(config: &Config, teams: usize, recording: bool) -> Result<Stepper, Failure> {
    let world = World::new(&*config.validate()?);
    Ok(match (recording, config.learning.fitness) {
        (false, _) => Stepper::new(world, teams)?,
        (true, Fitness::Dt) => Stepper::recording(world, teams)?.with_sights()?,
        (true, _) => Stepper::recording(world, teams)?,
    })
}

/// Teams of given policies after all checks.
struct CheckedTeams<'a> {
    world: World,
    weights: Cow<'a, [f32]>,
    policies: usize,
    sharing: Sharing,
    teams: Vec<u32>,
}

impl<'a> CheckedTeams<'a> {
    fn new(config: &Config, teams: usize, weights: &'a [f32], starts: &Starts) -> Result<CheckedTeams<'a>, Failure> {
        let world = World::new(&*config.validate()?);
        if !(1..=MAX_POPULATION).contains(&teams) {
            return Err(Failure::Teams(teams));
        }
        if let &Starts::Drawn { episodes, jitter, poi_jitter, .. } = starts {
            let wrong = [jitter, poi_jitter].into_iter().find(|jitter| !jitter.is_finite() || *jitter < 0.0);
            if wrong.is_some() || !(1..=MAX_EPISODES).contains(&episodes) {
                return Err(Failure::Starts { episodes, jitter: wrong.unwrap_or(jitter) });
            }
        }
        let (leaders, parameters) = (world.leaders(), world.parameters());
        let shared = weights.len() / teams == parameters;
        if !weights.len().is_multiple_of(teams) || !(shared || weights.len() / teams == leaders * parameters) {
            return Err(Failure::Weights { found: weights.len(), leaders, teams, parameters });
        }
        // Each leader of a team needs an entry of `teams` and several scores.
        let bytes = teams as u128 * leaders as u128 * 28;
        if !usize::try_from(bytes).is_ok_and(|bytes| Vec::<u8>::new().try_reserve_exact(bytes).is_ok()) {
            return Err(Failure::Memory { what: "all teams", bytes });
        }
        let mut weights = Cow::Borrowed(weights);
        if !weights.iter().all(|&weight| evolve::is_weight(weight))
            && let Some(place) = evolve::admit(weights.to_mut())
        {
            let (policy, parameter, value) = (place / parameters, place % parameters, weights[place]);
            return Err(Failure::Weight { leader: policy / teams, team: policy % teams, parameter, value });
        }
        let order = evaluate::aligned_teams(teams, leaders);
        let sharing = if shared { Sharing::Shared } else { Sharing::PerLeader };
        Ok(CheckedTeams { world, weights, policies: teams, sharing, teams: order })
    }

    fn group<'b>(&'b self, starts: &'b [glam::Vec2]) -> Group<'b> {
        let &CheckedTeams { ref world, ref weights, policies, sharing, ref teams } = self;
        Group { world, starts, weights: weights[..].into(), policies, sharing, teams, fitnesses: &[] }
    }
}
