//! The stages of a curriculum, resolved once.

use crate::backend::GroupScores;
use crate::config::{Fitness, StageConfig, ValidConfig};
use crate::world::World;

/// One stage: what plays from `first_generation` on.
pub(super) struct Stage {
    first_generation: usize,
    pub config: StageConfig,
    pub world: World,
    /// The fitnesses of its learners, each once, and the index of each learner's, `[leaders]`.
    pub fitnesses: Vec<Fitness>,
    pub fitness_of_each: Vec<usize>,
}

/// All stages of an experiment, in order. Populations, learners and policies are the same in all of them.
pub(super) struct Stages {
    /// Never empty.
    stages: Vec<Stage>,
    /// The last generation of the run, which may end before its last stage begins.
    pub last_generation: usize,
}

impl Stages {
    pub fn new(config: &ValidConfig) -> Stages {
        let stage = |(first_generation, config): &(usize, StageConfig)| {
            let (of_each, fitnesses) = (config.fitness_of_each(), config.fitnesses());
            let index = |own: Fitness| fitnesses.iter().position(|&fitness| fitness == own).unwrap_or(0);
            Stage {
                first_generation: *first_generation,
                world: World::new(config),
                config: config.clone(),
                fitness_of_each: of_each.into_iter().map(index).collect(),
                fitnesses,
            }
        };
        let stages = config.stages().iter().map(stage).collect();
        Stages { stages, last_generation: config.learning.generations }
    }

    /// Returns the stage that a generation plays in. The champions of the last generation play in its stage.
    pub fn of(&self, generation: usize) -> &Stage {
        &self.stages[self.index(generation.min(self.last_generation))]
    }

    /// Returns the stage that ends just before a generation, if one does: its last champions play beside that
    /// generation.
    pub fn ending_before(&self, generation: usize) -> Option<&Stage> {
        let (before, now) = (self.index(generation.checked_sub(1)?), self.index(generation.min(self.last_generation)));
        (before != now).then(|| &self.stages[before])
    }

    /// Identifies the stage that a generation plays in.
    pub fn index_of(&self, generation: usize) -> usize {
        self.index(generation.min(self.last_generation))
    }

    fn index(&self, generation: usize) -> usize {
        self.stages.iter().rposition(|stage| stage.first_generation <= generation).unwrap_or(0)
    }
}

impl Stage {
    /// Returns the score of a leader of a team, averaged over the episodes of this stage.
    #[inline(always)]
    pub fn mean_score(&self, episodes: &[GroupScores], (team, leader): (usize, usize)) -> f32 {
        let place = (team * self.fitnesses.len() + self.fitness_of_each[leader]) * self.world.leaders() + leader;
        let total: f64 = episodes.iter().map(|episode| f64::from(episode.scores[place])).sum();
        let mean = (total / episodes.len() as f64) as f32;
        if !self.config.credit.add_g || self.fitnesses[self.fitness_of_each[leader]] == Fitness::G {
            return mean;
        }
        let all = f64::from(self.world.total_worth) * episodes.len() as f64;
        mean + (observed(episodes, team) as f64 / all) as f32
    }
}

/// Returns what the POIs that a team observed in some episodes are worth.
pub(super) fn observed(episodes: &[GroupScores], team: usize) -> u64 {
    episodes.iter().map(|episode| u64::from(episode.observed[team])).sum()
}
