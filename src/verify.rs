//! Verification that a backend agrees with the CPU bit for bit.
//!
//! Verification compares random worlds stage by stage, then the scores of all of them as one batch, and by each
//! fitness. It also compares breeding on the device and short training runs.

use std::ops::Range;

use glam::Vec2;

use crate::backend::compare::{compare_breeding, compare_traces, first_difference};
use crate::backend::{Backend, BackendError, Group};
use crate::config::{Config, Fitness, Learning, StageConfig, ValidConfig};
use crate::evaluate::{SCORES, SCORES_AND_DT};
use crate::evolve::{self, TRAINING_EPISODES};
use crate::sample;
use crate::trainer::Trainer;
use crate::world::World;

/// The input of a comparison.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The worlds, each with its name in reports.
    pub worlds: Vec<(String, Config)>,
    /// Random teams per world.
    pub teams: usize,
    /// The seed of the teams.
    pub seed: u64,
    /// Generations of the short training run of the first few worlds.
    pub generations: usize,
}

/// Number of worlds that train for a few generations, side by side.
const TRAINED: usize = 8;

impl Plan {
    /// Returns a plan with random worlds of every kind, including degenerate ones.
    pub fn random(seeds: Range<u64>, teams: usize) -> Plan {
        let first = seeds.start;
        let world = |seed| {
            let mut config = sample::any_world(seed);
            sample::learn_otherwise(seed, &mut config);
            (format!("random world {seed}"), config)
        };
        Plan { worlds: seeds.map(world).collect(), teams, seed: first, generations: 3 }
    }
}

/// The amount that was compared, and the first difference, if any.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Agreement {
    /// Worlds played on both backends.
    pub worlds: usize,
    /// Agent-steps played in these worlds.
    pub agent_steps: u64,
    /// A description of the first difference.
    pub mismatch: Option<String>,
}

/// The teams of one world. Leader l of team t plays policy t + l, so that every team mixes policies.
struct Teams {
    world: World,
    policies: usize,
    weights: Vec<f32>,
    choice: Vec<u32>,
    /// Start positions, see [`Group::starts`].
    places: Vec<Vec2>,
    /// Every other world is also scored by Dt, which needs a record of sightings and so kernels of its own.
    fitnesses: &'static [Fitness],
}

/// The fitnesses that worlds are scored by, in turns.
pub const KINDS: [&[Fitness]; 6] =
    [SCORES, &[Fitness::G], &[Fitness::D], &[Fitness::Df], &[Fitness::Dpp], &[Fitness::Dt]];

impl Teams {
    fn new(config: &StageConfig, teams: usize, seed: u64, sights: bool) -> Teams {
        let world = World::new(config);
        let policies = teams.min(64);
        let leaders = world.leaders();
        let policy = |place: usize| ((place / leaders + place % leaders) % policies) as u32;
        let choice = (0..teams * leaders).map(policy).collect();
        let mut weights = sample::weights(&world, policies, seed);
        // With a shared population teams still mix policies, which tests more.
        weights.truncate(config.populations() * policies * world.parameters());
        let (learning, mut places) = (Learning { seed, ..config.learning.clone() }, vec![]);
        evolve::episode_positions(&learning, 0, 0, (TRAINING_EPISODES, 0), &world, &mut places);
        let fitnesses = if sights { SCORES_AND_DT } else { SCORES };
        Teams { policies, weights, choice, places, fitnesses, world }
    }

    fn group(&self) -> Group<'_> {
        let &Teams { ref world, policies, ref weights, ref choice, ref places, fitnesses } = self;
        Group { starts: places, fitnesses, ..Group::new(world, &weights[..], policies, choice) }
    }
}

/// Compares a backend with the reference. Stops at the first difference.
///
/// # Errors
/// A backend fails.
pub fn compare(
    plan: &Plan,
    reference: &mut dyn Backend,
    backend: &mut dyn Backend,
    mut progress: impl FnMut(&Agreement),
) -> Result<Agreement, BackendError> {
    let mut outcome = Agreement::default();
    let mut all = Vec::with_capacity(plan.worlds.len());
    for (name, config) in &plan.worlds {
        // Only the first stage plays here. Training below plays all of them.
        let teams = Teams::new(config.validate()?.at(0), plan.teams, plan.seed, outcome.worlds % 2 == 0);
        if let Some(mismatch) = compare_traces(&teams.group(), reference, backend)? {
            outcome.mismatch = Some(format!("{name}: {mismatch}"));
            return Ok(outcome);
        }
        outcome.worlds += 1;
        outcome.agent_steps += (plan.teams * teams.world.agents() * teams.world.steps()) as u64;
        progress(&outcome);
        all.push(teams);
    }
    let groups: Vec<Group<'_>> = all.iter().map(Teams::group).collect();
    if let Some((group, difference)) = compare_scores(&groups, reference, backend)? {
        outcome.mismatch = Some(format!("{}: all worlds as one batch, {difference}", plan.worlds[group].0));
        return Ok(outcome);
    }
    // With few worlds, each is played several times, so that every kind of scores is requested.
    let turns = KINDS.len().div_ceil(groups.len().max(1));
    for turn in 0..turns {
        if let Some((group, difference)) = compare_kinds(&groups, turn, reference, backend)? {
            outcome.mismatch = Some(format!("{}: stage credit, {difference}", plan.worlds[group].0));
            return Ok(outcome);
        }
    }
    outcome.agent_steps *= 2 + turns as u64;
    progress(&outcome);
    for ((name, config), teams) in plan.worlds.iter().zip(&all) {
        let Teams { world, policies, weights, .. } = teams;
        let sizes = [weights.len() / policies / world.parameters(), *policies, world.parameters()];
        if let Some(mismatch) = compare_breeding(weights, sizes, &config.learning, backend)? {
            outcome.mismatch = Some(format!("{name}: {mismatch}"));
            return Ok(outcome);
        }
    }
    outcome.mismatch = compare_training(plan, reference, backend)?;
    Ok(outcome)
}

/// Plays groups as one batch. Returns the first group whose scores differ, and how.
fn compare_scores(
    groups: &[Group<'_>],
    reference: &mut dyn Backend,
    backend: &mut dyn Backend,
) -> Result<Option<(usize, String)>, BackendError> {
    let (expected, found) = (reference.play(groups)?, backend.play(groups)?);
    Ok(first_difference(groups, &expected, &found))
}

/// Plays all groups, each scored by one of [`KINDS`], which changes with each turn. Returns the first group that differs, and
/// how.
fn compare_kinds(
    groups: &[Group<'_>],
    turn: usize,
    reference: &mut dyn Backend,
    backend: &mut dyn Backend,
) -> Result<Option<(usize, String)>, BackendError> {
    let kind = |index: usize| KINDS[(turn * groups.len() + index) % KINDS.len()];
    let groups = groups.iter().enumerate().map(|(index, group)| Group { fitnesses: kind(index), ..*group });
    compare_scores(&groups.collect::<Vec<_>>(), reference, backend)
}

/// Trains the first few worlds for a few generations side by side.
fn compare_training(
    plan: &Plan,
    reference: &mut dyn Backend,
    backend: &mut dyn Backend,
) -> Result<Option<String>, BackendError> {
    let configs = (plan.worlds.iter().take(TRAINED))
        .map(|(_, config)| {
            let mut config = config.clone();
            config.learning.generations = plan.generations;
            config.learning.trials = config.learning.trials.min(2);
            Ok(config.validate()?)
        })
        .collect::<Result<Vec<ValidConfig>, BackendError>>()?;
    let train = |backend: &mut dyn Backend| {
        let mut trainer = Trainer::new(configs.clone());
        let rows = trainer.finish(backend)?;
        let weights: Vec<Vec<u32>> = (0..configs.len())
            .map(|arm| trainer.policies(arm).concat().iter().map(|weight| weight.to_bits()).collect())
            .collect();
        Ok::<_, BackendError>((rows, weights))
    };
    let ((rows, weights), (found_rows, found_weights)) = (train(reference)?, train(backend)?);
    let name = |arm: usize| plan.worlds[arm].0.as_str();
    if let Some((a, b)) = rows.iter().zip(&found_rows).find(|(a, b)| a != b) {
        return Ok(Some(format!("{}: training differs: {a:?}, found {b:?}", name(a.experiment))));
    }
    let differs = (0..configs.len()).find(|&arm| weights[arm] != found_weights[arm]);
    Ok(differs.map(|arm| format!("{}: the trained weights differ", name(arm))))
}
