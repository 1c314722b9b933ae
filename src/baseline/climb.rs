//! Hill climbing of whole teams: a (1 + 16) evolution strategy, which has one searcher instead of one per leader.
//!
//! A team is one list of numbers. Each round mutates it 16 times, and the best mutant replaces it if it observes at
//! least as many POIs. The first round draws random teams.

use fearless_simd::Level;

use crate::config::{Learning, Mutation};
use crate::evolve::{self, Key, Purpose};
use crate::model::class::ClassConstants;
use crate::world::{OUTPUTS, World};

/// Number of segments of an open-loop team's episode, of equal length. In each, every leader makes one turn, as fast as
/// it can, and drives straight from there, at one speed.
pub const SEGMENTS: usize = 4;
/// Number of teams per round.
pub(super) const ROUND: usize = 16;
/// The probability that a number mutates, and the standard deviation, by turns. No single pair suits every task.
const MUTATIONS: [(f64, f64); 4] = [(0.1, 1.0), (0.3, 0.3), (1.0, 0.1), (1.0, 0.03)];

/// The numbers that a team consists of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Genome {
    /// The weights of a policy per population, `[populations][parameters]`.
    Networks {
        /// Number of populations.
        populations: usize,
        /// Weights per policy.
        parameters: usize,
    },
    /// Turns and speeds that do not depend on what leaders sense, `[leaders][segments][2]`.
    Segments {
        /// Number of leaders.
        leaders: usize,
    },
}

impl Genome {
    /// Returns the number of parts that mutate separately, their size, and the purpose of their random numbers.
    fn shape(self) -> (usize, usize, Purpose) {
        match self {
            Genome::Networks { populations, parameters } => (populations, parameters, Purpose::Climber),
            Genome::Segments { leaders } => (leaders, SEGMENTS * OUTPUTS, Purpose::OpenLoop),
        }
    }

    /// Writes a random part.
    fn draw(self, key: Key, learning: &Learning, part: &mut [f32]) {
        match self {
            Genome::Networks { .. } => evolve::initial_policy(Level::new(), key, learning, part),
            Genome::Segments { .. } => {
                let uniform = |counter| (f64::from(key.draw(counter)[0]) / (1u64 << 31) as f64 - 1.0) as f32;
                part.iter_mut().zip(0..).for_each(|(number, counter)| *number = uniform(counter));
            }
        }
    }
}

/// The search of one trial.
#[derive(Clone, Debug)]
pub(super) struct Climber {
    genome: Genome,
    /// The best team so far. Empty before the first round.
    pub(super) parent: Vec<f32>,
    /// Summed worth of the POIs that it observes in the episodes of its last generation.
    pub(super) observed: u64,
    /// The teams of this round, `[teams][numbers]`.
    pub(super) teams: Vec<f32>,
}

impl Climber {
    pub(super) fn new(genome: Genome) -> Climber {
        Climber { genome, parent: vec![], observed: 0, teams: vec![] }
    }

    /// Writes the teams of a round: `count` of a generation, from its slot `first` on. With `again`, the parent is the
    /// first of them, because other episodes begin.
    pub(super) fn draw(
        &mut self,
        learning: &Learning,
        trial: usize,
        generation: usize,
        (first, count): (usize, usize),
        again: bool,
    ) {
        let (parts, size, purpose) = self.genome.shape();
        let key = Key::new(learning.seed, trial, purpose);
        self.teams.clear();
        self.teams.resize(count * parts * size, 0.0);
        let mutations = MUTATIONS.map(|(mutation_probability, mutation_sigma)| {
            let mutation = Mutation::Additive;
            Learning { mutation, mutation_probability, mutation_sigma, groups: vec![], ..learning.clone() }
        });
        let mut scratch = vec![];
        for (slot, team) in (first..).zip(self.teams.chunks_exact_mut(parts * size)) {
            for (index, part) in team.chunks_exact_mut(size).enumerate() {
                let key = key.at(generation, index, slot);
                if self.parent.is_empty() {
                    self.genome.draw(key, learning, part);
                    continue;
                }
                part.copy_from_slice(&self.parent[index * size..(index + 1) * size]);
                if !(again && slot == first) {
                    evolve::mutate(Level::new(), key, &mutations[slot % MUTATIONS.len()], part, &mut scratch);
                }
                if let Genome::Segments { .. } = self.genome {
                    part.iter_mut().for_each(|number| *number = number.clamp(-1.0, 1.0));
                }
            }
        }
        if again {
            self.observed = 0;
        }
    }

    /// Returns the teams of this round.
    fn teams(&self) -> impl Iterator<Item = &[f32]> {
        let (parts, size, _) = self.genome.shape();
        self.teams.chunks_exact(parts * size)
    }

    /// Keeps the best of a round's teams, which observed these POIs. Ties go to the last, so that teams drift.
    pub(super) fn select(&mut self, observed: &[u64]) {
        let best = self.teams().zip(observed).max_by_key(|&(_, &observed)| observed);
        if let Some((team, &observed)) = best.filter(|&(_, &found)| self.parent.is_empty() || found >= self.observed) {
            (self.parent, self.observed) = (team.to_vec(), observed);
        }
    }

    /// Writes the policies of the best team, `[populations][parameters]`, for one population.
    pub(super) fn write_policy(&self, population: usize, policy: &mut [f32]) {
        policy.copy_from_slice(&self.parent[population * policy.len()..][..policy.len()]);
    }
}

/// Writes the policies of a climber's teams as [`Group::weights`](crate::backend::Group::weights) has them,
/// `[populations][teams][parameters]`.
pub(super) fn by_population(climber: &Climber, parameters: usize, weights: &mut Vec<f32>) {
    let (populations, ..) = climber.genome.shape();
    weights.clear();
    for population in 0..populations {
        let first = population * parameters;
        weights.extend(climber.teams().flat_map(|team| &team[first..first + parameters]));
    }
}

/// Returns the action of a leader of an open-loop team, `[leaders][segments][2]`, at a step.
pub(super) fn segment_action(world: &World, team: &[f32], leader: usize, step: usize) -> [f32; OUTPUTS] {
    let steps = world.steps();
    let segment = step * SEGMENTS / steps;
    let [turn, speed] = [0, 1].map(|output| team[(leader * SEGMENTS + segment) * OUTPUTS + output]);
    let ClassConstants { motion, shape, .. } = world.class_of(leader).constants;
    if shape.choices() > 0 {
        return [turn, speed];
    }
    // What is left of the segment's turn, as a fraction of a half turn.
    let turned = motion.max_turn / std::f32::consts::PI * (step - (segment * steps).div_ceil(SEGMENTS)) as f32;
    [turn.signum() * (turn.abs() - turned).max(0.0), speed]
}
