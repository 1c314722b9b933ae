//! Team schedules: who plays with whom in one generation, and from where.
//!
//! Unless teams are formed by fitness, a schedule depends on counters only, so that the next one can be drawn while the
//! present one plays.

use fearless_simd::Level;
use glam::Vec2;

use super::stages::{Stage, Stages};
use crate::config::population_count;
use crate::evolve::{self, TEST_EPISODES, TRAINING_EPISODES};
use crate::parallel::*;

/// Minimum number of policies per rayon task for cheap work. Fewer are finished before another thread wakes up.
const MIN_POLICIES_PER_TASK: usize = 2048;

/// Returns the number of populations that have [`MIN_POLICIES_PER_TASK`] policies together.
pub(super) fn min_populations_per_task(population: usize) -> usize {
    MIN_POLICIES_PER_TASK.div_ceil(population)
}

/// Who plays with whom in one generation of one trial, and from where. By default it is yet to be drawn.
#[derive(Default)]
pub(super) struct TeamSchedule {
    /// The generation and the index of its stage. `None` before the first draw. Ending a run early can change the
    /// stage.
    drawn_for: Option<(usize, usize)>,
    /// Scratch memory: each population's policies in the order of their teams, `[rounds][populations][policies]`.
    orders: Vec<u32>,
    /// The policy of each leader, `[teams + 1][leaders]`, round by round, followed by the teams with past champions, if
    /// any, `[populations][policies]`. The last team is the champion's.
    pub teams: Vec<u32>,
    /// Start positions, followed by POI positions if POIs move, `[episodes][agents + pois]`.
    pub starts: Vec<Vec<Vec2>>,
    /// The same for the champions of the previous stage. Empty unless a stage ends just before this generation.
    pub previous_stage_starts: Vec<Vec<Vec2>>,
    /// The same for the episodes that test the best team.
    pub test_starts: Vec<Vec<Vec2>>,
}

impl TeamSchedule {
    /// Reports whether this is the schedule of a generation.
    pub fn is_of(&self, generation: usize, stages: &Stages) -> bool {
        self.drawn_for == Some((generation, stages.index_of(generation)))
    }

    /// Draws the schedule of a trial's generation, unless it is that already. `fitness` returns the score in the generation
    /// before of a population's policy in a slot, or of its parent.
    pub fn draw(
        &mut self,
        level: Level,
        stages: &Stages,
        [trial, generation]: [usize; 2],
        fitness: impl Fn(usize, usize) -> f32 + Sync,
    ) {
        if self.is_of(generation, stages) {
            return;
        }
        self.drawn_for = Some((generation, stages.index_of(generation)));
        let stage = stages.of(generation);
        // The fitness is a share of the values of the generation before, whose stage may have had other POIs.
        let before = stages.of(generation.saturating_sub(1));
        let value: f64 = before.world.values.iter().map(|&value| f64::from(value)).sum();
        self.form_teams(level, stage, [trial, generation], |of, slot| value * f64::from(fitness(of, slot)));
        let draw_starts = |stage: &Stage, purposes, episodes: usize, all: &mut Vec<Vec<Vec2>>| {
            let (learning, world) = (&stage.config.learning, &stage.world);
            all.resize(episodes, vec![]);
            for (episode, starts) in all.iter_mut().enumerate() {
                evolve::episode_positions(learning, trial, generation, (purposes, episode), world, starts);
            }
        };
        let count = |stage: &Stage| stage.config.learning.episodes_per_team;
        draw_starts(stage, TRAINING_EPISODES, count(stage), &mut self.starts);
        draw_starts(stage, TEST_EPISODES, stage.config.learning.test_episodes, &mut self.test_starts);
        match stages.ending_before(generation) {
            Some(stage) => draw_starts(stage, TRAINING_EPISODES, count(stage), &mut self.previous_stage_starts),
            None => self.previous_stage_starts.clear(),
        }
    }

    /// Writes `teams`. `fitness` returns a policy's score in the generation before, in values of POIs.
    fn form_teams(
        &mut self,
        level: Level,
        Stage { config, world, .. }: &Stage,
        [trial, generation]: [usize; 2],
        fitness: impl Fn(usize, usize) -> f64 + Sync,
    ) {
        let (learning, populations) = (&config.learning, &world.populations);
        let (leaders, count) = (populations.len(), population_count(populations));
        let population = learning.population;
        let (of_round, orders_of_round) = (population * leaders, population * count);
        self.orders.resize(learning.partners * orders_of_round, 0);
        self.teams.resize(learning.partners * of_round, 0);
        let orders = self.orders.par_chunks_exact_mut(population);
        orders.with_min_len(min_populations_per_task(population)).enumerate().for_each(|(index, order)| match count {
            // Every order of a single population makes the same teams.
            1 => order.iter_mut().zip(0..).for_each(|(policy, team)| *policy = team),
            _ => {
                let [round, of] = [index / count, index % count];
                evolve::order_policies(
                    level,
                    learning,
                    trial,
                    generation,
                    [round, of],
                    |slot| fitness(of, slot),
                    order,
                );
            }
        });
        for (teams, orders) in self.teams.chunks_exact_mut(of_round).zip(self.orders.chunks_exact(orders_of_round)) {
            let teams = teams.par_chunks_exact_mut(leaders).with_min_len(MIN_POLICIES_PER_TASK);
            teams.enumerate().for_each(|(team, policies)| {
                for (policy, &of) in policies.iter_mut().zip(populations) {
                    *policy = orders[of as usize * population + team];
                }
            });
        }
        if let Some(slot) = evolve::past_champions(learning, trial, generation) {
            let first = self.teams.len();
            self.teams.resize(first + count * of_round, slot as u32);
            let teams = self.teams[first..].par_chunks_exact_mut(of_round);
            teams.with_min_len(min_populations_per_task(population)).enumerate().for_each(|(index, teams)| {
                for (team, policy) in teams.chunks_exact_mut(leaders).zip(0..) {
                    let members = team.iter_mut().zip(populations).filter(|&(_, &of)| of as usize == index);
                    members.for_each(|(to, _)| *to = policy);
                }
            });
        }
        // The champions are in the slot after the policies.
        self.teams.extend(std::iter::repeat_n(population as u32, leaders));
    }
}
