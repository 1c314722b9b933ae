//! The state of one experiment of a trainer and its trials.

use std::ops::Range;

use fearless_simd::Level;

use super::residency::Residency;
use super::schedule::TeamSchedule;
use super::stages::{Stage, Stages};
use super::{Row, Snapshot};
use crate::backend::GroupScores;
use crate::config::{Learning, Teams, ValidConfig};
use crate::evolve::{self, Key, Purpose};
use crate::host;
use crate::parallel::*;

/// One experiment and its trials.
pub(super) struct ExperimentState {
    pub stages: Stages,
    pub trials: Vec<TrialState>,
    /// The schedules of the generation that plays, one per trial.
    pub schedules: Vec<TeamSchedule>,
    /// The schedules of the next generation, drawn while a backend that holds the populations plays. Otherwise empty.
    pub next_schedules: Vec<TeamSchedule>,
    /// The generation that the populations play next: two past the last when all is done.
    pub generation: usize,
    /// Where the populations are.
    pub residency: Residency,
}

/// One trial's populations, and scratch memory for its generations.
///
/// A population has more slots than policies, see [`Learning::slots`]. The slot after the policies holds the previous
/// champion, or the mean of an evolution strategy. It plays in an additional team.
pub(super) struct TrialState {
    /// The trial's number within its config.
    pub index: usize,
    /// This generation, `[populations][slots][parameters]`.
    pub weights: Vec<f32>,
    /// Memory for the next generation, of the same size.
    pub children: Vec<f32>,
    /// The scores of the generation that played, `[episodes]`. The last team is the champion's, if it played there.
    pub scores: Vec<GroupScores>,
    /// The scores of the champion's team if it played in the previous stage, `[episodes]`; else empty.
    pub previous_stage_scores: Vec<GroupScores>,
    /// The scores of the episodes that tested the generation's best team, `[episodes]`.
    pub test_scores: Vec<GroupScores>,
    /// The mean score of every policy, `[populations][policies]`. If teams are kept, minus the rank of every policy's team
    /// follows, see [`Config::fitness_len`](crate::config::Config::fitness_len).
    pub fitness: Vec<f32>,
    /// The plan of the next generation, see [`evolve::draw_parents`], `[populations][slots]`.
    pub parents: Vec<u32>,
    /// The row of the previous generation, whose champion has yet to play.
    pub pending: Option<Row>,
}

impl ExperimentState {
    pub fn new(config: &ValidConfig, trials: Range<usize>, level: Level) -> ExperimentState {
        let stages = Stages::new(config);
        let schedules = std::iter::repeat_with(TeamSchedule::default).take(trials.len()).collect();
        let trials = trials.into_par_iter().map(|index| TrialState::new(&stages, index, level)).collect();
        let residency = Residency::Undecided;
        ExperimentState { stages, trials, schedules, next_schedules: vec![], generation: 0, residency }
    }

    /// The stage that the populations are about to play in.
    pub fn stage(&self) -> &Stage {
        self.stages.of(self.generation)
    }

    /// The last generation of the run.
    pub fn last(&self) -> usize {
        self.stages.last_generation
    }

    /// Reports whether the champions of the last generation have played.
    pub fn is_done(&self) -> bool {
        self.generation > self.last() + 1
    }

    /// Reports whether the populations are past the last generation, and only champions play.
    pub fn only_champions_left(&self) -> bool {
        self.generation > self.last()
    }

    /// Teams of a trial in the generation of the populations, without the champion's.
    pub fn teams(&self) -> usize {
        let config = &self.stage().config;
        config.learning.team_count() + config.hall_teams(self.generation)
    }

    /// Numbers in the policies of one trial, without the champions' slots.
    pub fn policy_len(&self) -> usize {
        let Stage { config, world, .. } = self.stage();
        config.populations() * config.learning.population * world.parameters()
    }

    /// Makes the schedules those of the populations' generation.
    pub fn prepare(&mut self, level: Level) {
        let generation = self.generation;
        if self.next_schedules.first().is_some_and(|next| next.is_of(generation, &self.stages)) {
            std::mem::swap(&mut self.schedules, &mut self.next_schedules);
        }
        let ExperimentState { stages, schedules, trials, .. } = self;
        let pairs = schedules.par_iter_mut().zip(trials);
        pairs.for_each(|(schedule, trial)| trial.draw(level, stages, generation, schedule));
    }

    /// Draws the next generation's schedules, unless they depend on the results of the generation that plays. Its
    /// schedules stay.
    pub fn prepare_next(&self, level: Level, next: &mut Vec<TeamSchedule>) {
        let generation = self.generation + 1;
        if self.only_champions_left() || self.stages.of(generation).config.learning.teams != Teams::Random {
            return;
        }
        next.resize_with(self.trials.len(), TeamSchedule::default);
        let pairs = next.par_iter_mut().zip(&self.trials);
        pairs.for_each(|(schedule, trial)| trial.draw(level, &self.stages, generation, schedule));
    }

    /// Returns the experiment's state as far as the host has it.
    pub fn snapshot(&self) -> Snapshot<&[f32]> {
        Snapshot {
            generation: self.generation,
            last: self.last(),
            weights: self.trials.iter().map(|trial| &trial.weights[..]).collect(),
            fitness: self.trials.iter().map(|trial| &trial.fitness[..]).collect(),
            pending: self.trials.iter().map(|trial| trial.pending).collect(),
        }
    }

    /// Takes on a snapshot; returns false, and changes nothing, if its sizes do not match. `index` is the experiment's
    /// in its trainer.
    pub fn restore(&mut self, index: usize, snapshot: Snapshot, level: Level) -> bool {
        let Snapshot { generation, last, weights, fitness, pending } = snapshot;
        let counts = [weights.len(), fitness.len(), pending.len()];
        let fits = |((trial, weights), fitness): ((&TrialState, &Vec<f32>), &Vec<f32>)| {
            trial.weights.len() == weights.len() && trial.fitness.len() == fitness.len()
        };
        if counts != [self.trials.len(); 3] || !self.trials.iter().zip(&weights).zip(&fitness).all(fits) {
            return false;
        }
        for (trial, ((weights, fitness), pending)) in
            self.trials.iter_mut().zip(weights.into_iter().zip(fitness).zip(pending))
        {
            (trial.weights, trial.fitness) = (weights, fitness);
            trial.pending = pending.map(|row| Row { experiment: index, ..row });
        }
        // Schedules may depend on the results and the plan of the generation before.
        self.schedules.fill_with(TeamSchedule::default);
        self.next_schedules.clear();
        self.residency = Residency::Undecided;
        if let Some(before) = generation.checked_sub(1).filter(|&before| before < self.last()) {
            self.generation = before;
            self.plan(level);
        }
        self.generation = generation.min(self.last() + 2);
        if generation > last && last < self.last() {
            // The shorter run kept its last policies. This run breeds a next generation from them. The shorter run's
            // last champions may have played already; they play again, in the next generation.
            self.generation = last;
            self.breed_beyond_the_last(level);
        }
        true
    }
}

impl TrialState {
    /// Draws the schedule of a generation, which is planned if its teams depend on the plan.
    fn draw(&self, level: Level, stages: &Stages, generation: usize, schedule: &mut TeamSchedule) {
        let config = &stages.of(generation).config;
        let (slots, policies) = (config.learning.slots(), config.learning.population);
        let fitness = |population: usize, slot: usize| {
            let parent = self.parents[population * slots + slot] & !evolve::UNCHANGED;
            if generation == 0 { 0.0 } else { self.fitness[population * policies + parent as usize] }
        };
        schedule.draw(level, stages, [self.index, generation], fitness);
    }

    /// Returns a trial with random policies.
    fn new(stages: &Stages, index: usize, level: Level) -> TrialState {
        let Stage { config, world, .. } = stages.of(0);
        let Learning { seed, population, .. } = config.learning;
        let (populations, parameters) = (config.populations(), world.parameters());
        let stride = config.learning.slots() * parameters;
        let key = Key::new(seed, index, Purpose::Weights);
        let mut weights = host::zeros(populations * stride);
        weights.par_chunks_exact_mut(stride).enumerate().for_each(|(leader, policies)| {
            policies[..population * parameters].par_chunks_exact_mut(parameters).with_min_len(64).enumerate().for_each(
                |(slot, policy)| {
                    evolve::initial_policy(level, key.at(0, leader, slot), &config.learning, policy);
                },
            );
        });
        TrialState {
            index,
            children: host::zeros(weights.len()),
            weights,
            scores: vec![],
            previous_stage_scores: vec![],
            test_scores: vec![],
            fitness: vec![0.0; config.fitness_len()],
            parents: vec![0; populations * config.learning.slots()],
            pending: None,
        }
    }
}
