//! The stages of a curriculum, resolved once.

use crate::config::{StageConfig, ValidConfig};
use crate::world::World;

/// One stage: what plays from `first_generation` on.
pub(super) struct Stage {
    first_generation: usize,
    pub config: StageConfig,
    pub world: World,
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
        let stage = |(first_generation, config): &(usize, StageConfig)| Stage {
            first_generation: *first_generation,
            world: World::new(config),
            config: config.clone(),
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
