//! Training with a callback, and its results.

use std::ops::ControlFlow;

use super::Failure;
use crate::backend::{Backend, BackendError};
use crate::config::{Config, ValidConfig};
use crate::evolve;
use crate::memory::{self, Peaks};
use crate::parallel::current_num_threads;
use crate::trainer::{self, Ending, Row, Snapshot, Trainer, digest};

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
    /// State that a longer run continues from. `None` if the run was read from a folder without its last checkpoint.
    pub ending: Option<Ending>,
}

impl Trained {
    /// Creates the results from all rows, the policies of every trial, and the state to continue from.
    pub fn new(config: Config, rows: &[Row], policies: Vec<Vec<f32>>, ending: Option<Ending>) -> Trained {
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
    pub(super) fn of(trainer: &mut Trainer, config: Config, rows: &[Row]) -> Result<Trained, Failure> {
        let bytes = config.policy_bytes().into();
        let (policies, end) = trainer.ends(&[0]).remove(0);
        let policies = policies.into_iter().map(<[f32]>::to_vec).collect();
        let memory = |_| Failure::Memory { what: "the last generation", bytes };
        let Snapshot { weights, fitness, .. } = end.copy().map_err(memory)?;
        Ok(Trained::new(config, rows, policies, Some(Ending { weights, fitness })))
    }

    /// Returns the digest of the metrics and all policies, equal to the one that `run.json` records for the same
    /// results.
    pub fn digest(&self) -> String {
        let trials = self.config.learning.trials;
        let rows = (0..=self.config.learning.generations).flat_map(|generation| {
            (0..trials).map(move |trial| {
                let at = trial * (self.config.learning.generations + 1) + generation;
                let (best_g, mean_g, champion_g) = (self.best_g[at], self.mean_g[at], self.champion_g[at]);
                Row { experiment: 0, trial, generation, best_g, mean_g, champion_g }
            })
        });
        digest::hex(&digest::digest(rows, &self.policies))
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
    train_any(config, backend, (policies, first), false, watch)
}

/// Trains as [`train`] does, and gives `watch` the champions of every generation. A device that holds populations
/// returns them after every generation.
///
/// # Errors
/// As for [`train`].
pub fn train_with_champions(
    config: &Config,
    backend: &mut dyn Backend,
    watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    train_any(config, backend, (0, &[]), true, watch)
}

fn train_any(
    config: &Config,
    backend: &mut dyn Backend,
    (policies, first): (usize, &[Vec<f32>]),
    with_champions: bool,
    mut watch: impl FnMut(Generation<'_>) -> ControlFlow<()>,
) -> Result<Trained, Failure> {
    let valid = config.validate()?;
    let mut config = Config::clone(&valid);
    let (mut trainer, mut rows, mut stopped) = (new_trainer(valid)?, Vec::new(), false);
    start_from(&mut trainer, &config, policies, first)?;
    while !trainer.is_done() {
        // Champions play together with the next generation, which completes the rows of theirs.
        let best = with_champions.then(|| previous_champions(&mut trainer, &config)).transpose()?;
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
pub(super) fn previous_champions(trainer: &mut Trainer, config: &Config) -> Result<Vec<f32>, BackendError> {
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
pub(super) fn new_trainer(config: ValidConfig) -> Result<Trainer, Failure> {
    let plan = Peaks::of([&config], current_num_threads());
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
pub(super) fn start_from(
    trainer: &mut Trainer,
    config: &Config,
    policies: usize,
    first: &[Vec<f32>],
) -> Result<(), Failure> {
    let (leaders, parameters, trials) = (config.populations(), config.parameters(), config.learning.trials);
    if first.len() > 1 && first.len() != trials {
        return Err(Failure::Trials { found: first.len(), trials });
    }
    for (trial, weights) in (0..trials).zip(first.iter().cycle()) {
        let mut weights = weights.clone();
        if weights.is_empty() || Some(weights.len()) != (leaders * parameters).checked_mul(policies) {
            return Err(Failure::Weights { found: weights.len(), leaders, teams: policies, parameters });
        }
        if let Some(place) = evolve::flush_and_validate(&mut weights) {
            let (policy, parameter, value) = (place / parameters, place % parameters, weights[place]);
            return Err(Failure::Weight { leader: policy / policies, team: policy % policies, parameter, value });
        }
        if !trainer.start_from(0, trial, policies, &weights) {
            unreachable!("the weights are as many as the config takes");
        }
    }
    Ok(())
}
