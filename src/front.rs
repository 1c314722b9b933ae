//! What programs need, in a few lines: train with a callback, play and trace given policies, step teams by hand, read
//! runs.
//!
//! Everything here checks what it is given, and hands back plain arrays; their shapes are written
//! `[teams][leaders][8]`, the last index moving fastest. Beneath are [`crate::trainer`], [`crate::evaluate`],
//! [`crate::stepping`] and [`crate::record`]. Runs that keep their files as they train, to be gone on with after
//! anything, are [`crate::run`]'s.

use std::borrow::Cow;
use std::ops::ControlFlow;
#[cfg(feature = "report")]
use std::path::Path;

use crate::backend::cpu::Cpu;
#[cfg(feature = "gpu")]
use crate::backend::gpu::{
    self,
    device::{DeviceError, Wanted},
    episode::{GpuBackend, ResidencyPolicy},
};
use crate::backend::{Backend, BackendError, Group, Machine, OpenBackend, RecordRequest};
use crate::config::{Config, ConfigError, Fitness, MAX_POPULATION};
use crate::evaluate::{self, Evaluation, MAX_EPISODES, Starts};
use crate::evolve::{self, MAX_WEIGHT};
use crate::memory::{self, Peaks, TooLittle};
use crate::parallel::current_num_threads;
#[cfg(feature = "record")]
use crate::record::{RecordError, hex, metrics};
#[cfg(feature = "report")]
use crate::record::{
    digests::{Digests, Verification},
    folder::POLICIES,
    policies,
};
#[cfg(feature = "report")]
use crate::report::runs;
use crate::stepping::{StepError, Stepper};
use crate::trainer::{Row, Trainer};
use crate::world::{INPUTS, OUTPUTS, World};

/// Why a function here could not do what it was asked. Nothing was changed then.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// Everything that is wrong with a config.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The machine has less memory than a training takes.
    #[error(transparent)]
    TooLittle(#[from] TooLittle),
    /// The system gives no memory for this.
    #[error("there is no memory for {what}, {bytes} bytes")]
    Memory {
        /// What it is for.
        what: &'static str,
        /// How much was asked for.
        bytes: u128,
    },
    /// Episodes could not be played.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// No team, or more than there may be.
    #[error("{0} teams; there may be 1 to {MAX_POPULATION}")]
    Teams(usize),
    /// Too few or too many weights for the teams.
    #[error(
        "{found} weights for {teams} teams; [leaders][teams][parameters] are [{leaders}][{teams}][{parameters}], or \
         [1][{teams}][{parameters}] where leaders share a policy"
    )]
    Weights {
        /// How many were given.
        found: usize,
        /// Of a team.
        leaders: usize,
        /// How many were asked for.
        teams: usize,
        /// Weights of a policy.
        parameters: usize,
    },
    /// Policies of fewer or more trials than are trained.
    #[error("policies of {found} trials, where {trials} are trained; give each its own, or all the same")]
    Trials {
        /// How many were given.
        found: usize,
        /// Of the config.
        trials: usize,
    },
    /// A weight that no policy may have.
    #[error(
        "weight {parameter} of the policy of leader {leader} in team {team} is {value}, allowed is a size up to {MAX_WEIGHT}"
    )]
    Weight {
        /// Its place in the team.
        leader: usize,
        /// From 0.
        team: usize,
        /// Its place in the policy.
        parameter: usize,
        /// What was given.
        value: f32,
    },
    /// Starts that cannot be drawn.
    #[error(
        "{episodes} episodes from starts moved by up to {jitter}; there may be 1 to {MAX_EPISODES}, and a jitter from 0 on"
    )]
    Starts {
        /// Of each team.
        episodes: u32,
        /// In units.
        jitter: f64,
    },
    /// An episode that [`Starts`] do not have.
    #[error("episode {episode} of {episodes} (they count from 0)")]
    NoEpisode {
        /// The one asked for, from 0.
        episode: usize,
        /// How many they have.
        episodes: usize,
    },
    /// Teams could not be made.
    #[error(transparent)]
    Step(#[from] StepError),
    /// A run's folder could not be read.
    #[cfg(feature = "report")]
    #[error(transparent)]
    Run(#[from] runs::ReadError),
    /// A run's files could not be read or written.
    #[cfg(feature = "record")]
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// What episodes are to be played on.
#[cfg(feature = "gpu")]
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Processor {
    /// A GPU where there is one that can, else the CPU.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU that is no software renderer.
    Gpu,
    /// The adapter of this number in `gpu::device::adapters`, or whose name contains this; also a software renderer.
    Adapter(String),
}

/// What was found to play on besides the CPU.
#[cfg(feature = "gpu")]
pub struct Found {
    /// The GPU, opened.
    pub gpu: Option<GpuBackend>,
    /// Why a GPU that is there was passed over.
    pub passed_over: Option<DeviceError>,
}

/// Looks for a GPU; none is an error only where one is asked for, or where it alone may hold the populations
/// ([`Processor::Cpu`] never has one). It holds those that it had better, where nothing else is asked for.
///
/// # Errors
/// There is none that can be used.
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

/// Opens what episodes are to be played on; also gives why a GPU that is there was passed over.
///
/// # Errors
/// There is no such GPU, or none that can be used.
#[cfg(feature = "gpu")]
pub fn open(processor: &Processor) -> Result<(OpenBackend, Option<DeviceError>), DeviceError> {
    let Found { gpu, passed_over } = find_gpu(processor, None)?;
    Ok((gpu.map_or_else(cpu, on_gpu), passed_over))
}

/// The backend that is always there.
pub fn cpu() -> OpenBackend {
    (Box::new(Cpu::default()), Machine::of_cpu())
}

/// A GPU, and what it is.
#[cfg(feature = "gpu")]
pub fn on_gpu(backend: GpuBackend) -> OpenBackend {
    let machine = Machine::of_gpu(&backend);
    (Box::new(backend), machine)
}

/// A generation of all trials that has been played, its champions too.
#[derive(Clone, Copy, Debug)]
pub struct Generation<'a> {
    /// Which one, from 0, the random start.
    pub generation: usize,
    /// The last that there will be.
    pub last: usize,
    /// What it came to, by trial.
    pub rows: &'a [Row],
}

/// What a training came to.
#[derive(Clone, Debug, PartialEq)]
pub struct Trained {
    /// What was trained; where the training was stopped, of fewer generations.
    pub config: Config,
    /// G of each generation's best team, in 0..1: `[trials][generations + 1]`, the random start first.
    pub best_g: Vec<f64>,
    /// The mean of a generation's teams, likewise.
    pub mean_g: Vec<f64>,
    /// The team of every population's best policy, likewise.
    pub champion_g: Vec<f64>,
    /// The last generation's policies, best first in each population: `[trials]` of `[leaders][policies][parameters]`.
    pub policies: Vec<Vec<f32>>,
}

impl Trained {
    fn new(config: Config, rows: &[Row], policies: Vec<Vec<f32>>) -> Trained {
        let columns = config.learning.generations + 1;
        let mut trained = Trained {
            best_g: vec![0.0; config.learning.trials * columns],
            mean_g: vec![0.0; config.learning.trials * columns],
            champion_g: vec![0.0; config.learning.trials * columns],
            config,
            policies,
        };
        for row in rows {
            let at = row.trial * columns + row.generation;
            (trained.best_g[at], trained.mean_g[at], trained.champion_g[at]) = (row.best_g, row.mean_g, row.champion_g);
        }
        trained
    }

    /// Reads what a run came to from its folder.
    ///
    /// # Errors
    /// The folder holds no run, or one that is not finished, or its files are damaged or not as the run left them.
    #[cfg(feature = "report")]
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
            let reason = "its rows are not one a trial and generation, in their order".into();
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
        let trained = Trained::new(config, &rows, policies);
        // Config and metrics are as the run left them, so policies are what differs.
        match digests.run {
            Some(digest) if digest != trained.digest() => Err(RecordError::Differs { path }.into()),
            _ => Ok(trained),
        }
    }

    /// The digest that `run.json` has of a run that came to the same: of the metrics and all policies.
    #[cfg(feature = "record")]
    pub fn digest(&self) -> String {
        let trials = self.config.learning.trials;
        let rows = (0..=self.config.learning.generations).flat_map(|generation| {
            (0..trials).map(move |trial| {
                let at = trial * (self.config.learning.generations + 1) + generation;
                let (best_g, mean_g, champion_g) = (self.best_g[at], self.mean_g[at], self.champion_g[at]);
                Row { arm: 0, trial, generation, best_g, mean_g, champion_g }
            })
        });
        hex(&metrics::digest(rows, &self.policies))
    }
}

/// Trains all trials of a config. `watch` is told of every generation, and stops the training by
/// [`ControlFlow::Break`]: then one more generation is played, and what comes out is to the bit what a config of so few
/// generations comes to.
///
/// # Errors
/// The config is wrong or too large for the memory there is, or the backend fails.
pub fn train(
    config: &Config,
    backend: &mut dyn Backend,
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_from(config, backend, 0, &[], watch)
}

/// [`train`], from given policies in place of random ones: one `[leaders][policies][parameters]` for each trial, or one for
/// all; where leaders share a policy, `[1][policies][parameters]`. Populations that take more are filled up at random, and
/// those that take fewer take the first.
///
/// # Errors
/// See [`train`]; or the policies do not fit the config.
pub fn train_from(
    config: &Config,
    backend: &mut dyn Backend,
    policies: usize,
    first: &[Vec<f32>],
    mut watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    let valid = config.validate()?;
    let mut config = Config::clone(&valid);
    let plan = Peaks::of([&config], current_num_threads());
    // Nothing is saved on the way, but what comes out is kept: the rows twice, and the policies.
    let rows = config.learning.trials as u64 * (config.learning.generations as u64 + 1);
    let kept = rows * (size_of::<Row>() + 3 * size_of::<f64>()) as u64 + config.policy_bytes();
    let needed = (plan.host.min(plan.gpu_host) - plan.checkpoint).saturating_add(kept);
    memory::check(needed, 0)?;
    let (mut trainer, mut rows, mut stopped) = (Trainer::new([valid]), Vec::new(), false);
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
    while !trainer.is_done() {
        let played = trainer.advance(backend)?;
        if let Some(&Row { generation, .. }) = played.first().filter(|_| !stopped) {
            let last = config.learning.generations;
            stopped = watch(Generation { generation, last, rows: &played }).is_break();
            if stopped {
                config.learning.generations = trainer.end(0);
                config.stages.retain(|stage| stage.from <= config.learning.generations);
            }
        }
        rows.extend(played);
    }
    let policies = trainer.policies(0);
    Ok(Trained::new(config, &rows, policies))
}

/// What teams scored: of several episodes, means.
#[derive(Clone, Debug, PartialEq)]
pub struct Played {
    /// POIs observed, `[teams]`.
    pub observed: Vec<f64>,
    /// Share of the POIs observed, in 0..1, `[teams]`.
    pub g: Vec<f32>,
    /// D, `[teams][leaders]`.
    pub d: Vec<f32>,
    /// Df, likewise.
    pub df: Vec<f32>,
    /// D++, likewise.
    pub dpp: Vec<f32>,
    /// Dt, likewise, where it is the config's fitness, else empty: it takes a record of who was seen at every step.
    pub dt: Vec<f32>,
}

/// Plays teams of given policies, `[leaders][teams][parameters]`: team `t` is made of every leader's policy `t`. Where
/// all leaders of a team share one, `[1][teams][parameters]` will do. A policy's parameters stand layer by layer, in
/// each input by input with the bias last, in each unit by unit.
///
/// # Errors
/// The config, the weights or the starts are wrong, or the backend fails.
pub fn play(
    config: &Config,
    backend: &mut dyn Backend,
    teams: usize,
    weights: &[f32],
    starts: &Starts,
) -> Result<Played, Failure> {
    let cast = Cast::new(config, teams, weights, starts)?;
    let need = if config.learning.fitness == Fitness::Dt { RecordRequest::Sights } else { RecordRequest::Scores };
    let group = Group { need, ..cast.group(&cast.world.starts) };
    let evaluation = evaluate::evaluate(backend, &group, starts, &|_| ())?;
    let Evaluation { leaders, .. } = evaluation;
    let scores: Vec<[f32; 4]> =
        (0..teams * leaders).map(|place| evaluation.scores(place / leaders, place % leaders)).collect();
    Ok(Played {
        observed: evaluation.observed.iter().map(evaluate::Tally::mean).collect(),
        g: scores.iter().step_by(leaders).map(|&[g, ..]| g).collect(),
        d: scores.iter().map(|&[_, d, ..]| d).collect(),
        df: scores.iter().map(|&[_, _, df, _]| df).collect(),
        dpp: scores.iter().map(|&[.., dpp]| dpp).collect(),
        dt: (0..teams * leaders).filter_map(|place| evaluation.dt(place / leaders, place % leaders)).collect(),
    })
}

/// Everything that teams did in one episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Traced {
    /// Where everyone was, from the start on: `[teams][steps + 1][agents][2]`, leaders first.
    pub positions: Vec<f32>,
    /// Unit vectors, likewise.
    pub headings: Vec<f32>,
    /// Units a second, `[teams][steps + 1][agents]`.
    pub speeds: Vec<f32>,
    /// What leaders sensed there, `[teams][steps][leaders][8]`.
    pub inputs: Vec<f32>,
    /// What their policies answered to these, `[teams][steps][leaders][2]`: that leads to the next step's states.
    pub outputs: Vec<f32>,
    /// The agents near each POI after each step, a bit an agent: `[teams][steps][pois][words]`.
    pub near: Vec<u32>,
}

/// Plays one episode of given policies, see [`play`], and keeps everything.
///
/// # Errors
/// The config, the weights or the starts are wrong, there is no memory for so much, or the backend fails.
pub fn trace(
    config: &Config,
    backend: &mut dyn Backend,
    teams: usize,
    weights: &[f32],
    starts: &Starts,
    episode: usize,
) -> Result<Traced, Failure> {
    let cast = Cast::new(config, teams, weights, starts)?;
    if episode >= starts.episodes() {
        return Err(Failure::NoEpisode { episode, episodes: starts.episodes() });
    }
    let world = &cast.world;
    let (agents, leaders, steps) = (world.agents(), world.leaders(), world.steps());
    let a_team = (steps + 1) * agents * 5 + steps * leaders * (INPUTS + OUTPUTS) + world.set_words();
    let bytes = a_team as u128 * 4 * teams as u128;
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
    for (_, part) in evaluate::parts(&cast.group(&starts)) {
        let trace = backend.trace(&part)?;
        for (team, step) in (0..trace.teams).flat_map(|team| (0..=steps).map(move |step| (team, step))) {
            for moment in (0..agents).map(|agent| trace.moment(step, team, agent)) {
                traced.positions.extend(moment.position);
                traced.headings.extend(moment.heading);
                traced.speeds.push(moment.speed);
            }
            // A trace has what led to a state beside it.
            for moment in (0..leaders).filter(|_| step > 0).map(|leader| trace.moment(step, team, leader)) {
                traced.inputs.extend(moment.inputs);
                traced.outputs.extend(moment.outputs);
            }
        }
        traced.near.extend(trace.sets);
    }
    Ok(traced)
}

/// Teams to be stepped by given actions, all at the world's start; with a record, they can be scored, by Dt where that
/// is the config's fitness.
///
/// # Errors
/// The config is wrong, or there may not be so many teams.
pub fn stepper(config: &Config, teams: usize, recording: bool) -> Result<Stepper, Failure> {
    let world = World::new(&*config.validate()?);
    Ok(match (recording, config.learning.fitness) {
        (false, _) => Stepper::new(world, teams)?,
        (true, Fitness::Dt) => Stepper::recording(world, teams)?.with_sights()?,
        (true, _) => Stepper::recording(world, teams)?,
    })
}

/// Teams of given policies, fit to be played.
struct Cast<'a> {
    world: World,
    weights: Cow<'a, [f32]>,
    policies: usize,
    teams: Vec<u32>,
}

impl<'a> Cast<'a> {
    fn new(config: &Config, teams: usize, weights: &'a [f32], starts: &Starts) -> Result<Cast<'a>, Failure> {
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
        // Every leader has a place in a team, and several scores.
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
        let order = evaluate::one_policy_a_team(teams, leaders);
        Ok(Cast { world, weights, policies: teams, teams: order })
    }

    fn group<'b>(&'b self, starts: &'b [glam::Vec2]) -> Group<'b> {
        let Cast { world, weights, policies, teams } = self;
        Group { world, starts, weights: weights[..].into(), policies: *policies, teams, need: RecordRequest::Scores }
    }
}
