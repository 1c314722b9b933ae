//! The results of a training, and of each of its generations.

use super::Failure;
use crate::config::Config;
use crate::trainer::{Ending, Row, Snapshot, Trainer, digest};

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
    /// The best policy of each population, `[trials][populations][parameters]`, if [`train_with_champions`](super::train_with_champions) trains.
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
    /// Mean G of each generation's best team over the test episodes: `[trials][generations + 1]`, or empty without any.
    pub test_g: Vec<f64>,
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
            test_g: vec![0.0; if config.learning.test_episodes > 0 { config.learning.trials * columns } else { 0 }],
            config,
            policies,
            ending,
        };
        for row in rows {
            let at = row.trial * columns + row.generation;
            (trained.best_g[at], trained.mean_g[at], trained.champion_g[at]) = (row.best_g, row.mean_g, row.champion_g);
            if let (Some(to), Some(test_g)) = (trained.test_g.get_mut(at), row.test_g) {
                *to = test_g;
            }
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
                let test_g = self.test_g.get(at).copied();
                Row { experiment: 0, trial, generation, best_g, mean_g, champion_g, test_g }
            })
        });
        digest::hex(&digest::digest(rows, &self.policies))
    }
}
