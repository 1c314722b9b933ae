//! Playing, tracing and stepping of given policies.

use std::borrow::Cow;
use std::ops::{ControlFlow, Range};

use super::Failure;
use crate::backend::cpu::{Cpu, Noise, StepArrays};
use crate::backend::{Backend, Group, GroupScores};
use crate::config::{Config, Fitness, MAX_POPULATION};
use crate::evaluate::{self, Evaluation, MAX_EPISODES, Starts};
use crate::evolve::{self, Key, Purpose};
use crate::memory;
use crate::stepping::{Recording, Stepper};
use crate::world::{OUTPUTS, World};

/// The scores of teams, averaged over episodes.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Played {
    /// Number of POIs observed, weighted by their values: G times the number of POIs, `[teams]`.
    pub observed: Vec<f64>,
    /// G, what the observed POIs are worth as a share of all, in 0..1, `[teams]`.
    pub g: Vec<f32>,
    /// D, `[teams][leaders]`.
    pub d: Vec<f32>,
    /// Df, `[teams][leaders]`.
    pub df: Vec<f32>,
    /// D++, `[teams][leaders]`.
    pub dpp: Vec<f32>,
    /// Dt, `[teams][leaders]`. Empty unless Dt is the fitness of any class, because Dt needs a record of who was seen at
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
/// The config, the number of teams, the weights or the starts are invalid, memory is insufficient, or the backend
/// fails.
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

/// Plays teams as [`play`] does, and calls `each` several times per second, see [`evaluate::evaluate`].
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
    let group = Group { fitnesses: evaluate::scores_beside(config), ..checked.group(&checked.world.starts) };
    Ok(evaluate::evaluate(backend, &group, starts, each)?)
}

impl From<&Evaluation> for Played {
    fn from(evaluation: &Evaluation) -> Played {
        let (teams, leaders) = (evaluation.observed.len(), evaluation.leaders);
        let places = || (0..teams * leaders).map(|place| (place / leaders, place % leaders));
        let scores: Vec<[f32; 4]> = places().map(|(team, leader)| evaluation.scores(team, leader)).collect();
        Played {
            observed: (0..teams).map(|team| evaluation.mean_observed(team)).collect(),
            g: scores.iter().step_by(leaders).map(|&[g, ..]| g).collect(),
            d: scores.iter().map(|&[_, d, ..]| d).collect(),
            df: scores.iter().map(|&[_, _, df, _]| df).collect(),
            dpp: scores.iter().map(|&[.., dpp]| dpp).collect(),
            dt: places().filter_map(|(team, leader)| evaluation.dt(team, leader)).collect(),
        }
    }
}

/// Calls `look` with the first episode of one team of given policies. See [`play`] for the arguments.
///
/// # Errors
/// The config, the weights or the starts are invalid.
pub fn with_team<R>(
    config: &Config,
    weights: &[f32],
    starts: &Starts,
    look: impl FnOnce(&Group<'_>) -> R,
) -> Result<R, Failure> {
    let checked = CheckedTeams::new(config, 1, weights, starts)?;
    let starts = starts.of(0, &checked.world);
    Ok(look(&Group { fitnesses: evaluate::scores_beside(config), ..checked.group(&starts) }))
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
    if episodes.is_empty() {
        return Err(Failure::NoEpisode { episode: episodes.end, episodes: starts.episodes() });
    }
    let checked = CheckedTeams::new(config, teams, weights, starts)?;
    checked.record(starts, episodes, evaluate::scores_beside(config), noise, arrays)
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
    pub agents_at_poi: Vec<u32>,
}

/// Plays one episode of given policies on the CPU and records every step. See [`play`] for the arguments.
///
/// # Errors
/// The config, the weights or the starts are invalid, or the memory is insufficient.
pub fn trace(
    config: &Config,
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
    let (states, inputs) = (teams * (world.steps() + 1) * world.agents(), teams * world.steps() * world.leaders());
    let words = states * 5 + inputs * (world.inputs() + OUTPUTS) + teams * world.set_words();
    let bytes = words as u128 * 4;
    if !memory::can_allocate(bytes) {
        return Err(Failure::Memory { what: "all steps of all teams", bytes });
    }
    let mut traced = Traced {
        positions: vec![0.0; states * 2],
        headings: vec![0.0; states * 2],
        speeds: vec![0.0; states],
        inputs: vec![0.0; inputs * world.inputs()],
        outputs: vec![0.0; inputs * OUTPUTS],
        agents_at_poi: vec![0; teams * world.set_words()],
    };
    let Traced { positions, headings, speeds, inputs, outputs, agents_at_poi } = &mut traced;
    let arrays = StepArrays { positions, headings, speeds, inputs, outputs, agents_at_poi, ..StepArrays::default() };
    checked.record(starts, episode..episode + 1, &[], None, arrays)?;
    Ok(traced)
}

/// Creates teams that are stepped by given actions, all at the world's start. With `recording`, the teams can be
/// scored, including Dt if that is the fitness of any class.
///
/// # Errors
/// The config is invalid, the number of teams is not allowed, or memory is insufficient.
pub fn stepper(config: &Config, teams: usize, recording: bool) -> Result<Stepper, Failure> {
    let world = World::new(&config.validate()?);
    let recording = match recording {
        false => Recording::None,
        true if config.fitnesses().contains(&Fitness::Dt) => Recording::SetsAndSights,
        true => Recording::Sets,
    };
    Ok(Stepper::new(world, teams, recording)?)
}

/// Teams of given policies after all checks.
struct CheckedTeams<'a> {
    world: World,
    weights: Cow<'a, [f32]>,
    policies: usize,
    populations: Vec<u32>,
    teams: Vec<u32>,
}

impl<'a> CheckedTeams<'a> {
    fn new(config: &Config, teams: usize, weights: &'a [f32], starts: &Starts) -> Result<CheckedTeams<'a>, Failure> {
        let world = World::new(&config.validate()?);
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
        let populations = weights.len() / teams / parameters;
        let of_each = config.populations_for(populations);
        let Some(of_each) = of_each.filter(|_| weights.len() == populations * teams * parameters) else {
            return Err(Failure::Weights { found: weights.len(), leaders, teams, parameters });
        };
        // Each leader of a team needs an entry of `teams` and several scores.
        let bytes = teams as u128 * leaders as u128 * 28;
        if !memory::can_allocate(bytes) {
            return Err(Failure::Memory { what: "all teams", bytes });
        }
        let mut weights = Cow::Borrowed(weights);
        if !weights.iter().all(|&weight| evolve::is_weight(weight))
            && let Some(place) = evolve::flush_and_validate(weights.to_mut())
        {
            let (policy, parameter, value) = (place / parameters, place % parameters, weights[place]);
            return Err(Failure::Weight { leader: policy / teams, team: policy % teams, parameter, value });
        }
        let order = evaluate::aligned_teams(teams, leaders);
        Ok(CheckedTeams { world, weights, policies: teams, populations: of_each, teams: order })
    }

    /// Plays some episodes and writes their steps, see [`record`].
    fn record(
        &self,
        starts: &Starts,
        episodes: Range<usize>,
        fitnesses: &[Fitness],
        noise: Option<ActionNoise<'_>>,
        arrays: StepArrays<'_>,
    ) -> Result<Vec<GroupScores>, Failure> {
        if episodes.end > starts.episodes() {
            return Err(Failure::NoEpisode { episode: episodes.end, episodes: starts.episodes() });
        }
        let drawn: Vec<Vec<glam::Vec2>> = episodes.clone().map(|episode| starts.of(episode, &self.world)).collect();
        let groups: Vec<Group<'_>> = drawn.iter().map(|starts| Group { fitnesses, ..self.group(starts) }).collect();
        let noise = noise.map(|ActionNoise { seed, deviations }| Noise {
            key: Key::new(seed, 0, Purpose::Exploration),
            deviations,
            first: (episodes.start * self.policies) as u32,
        });
        Ok(Cpu::default().record(&groups, noise, arrays)?)
    }

    fn group<'b>(&'b self, starts: &'b [glam::Vec2]) -> Group<'b> {
        let &CheckedTeams { ref world, ref weights, policies, ref populations, ref teams } = self;
        Group { starts, populations, ..Group::new(world, &weights[..], policies, teams) }
    }
}
