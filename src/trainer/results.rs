//! The results of a generation: plays it, scores it, and turns scores into rows and fitness.

use std::cmp::Reverse;
use std::ops::Range;

use glam::Vec2;

use super::Row;
use super::experiment::{ExperimentState, TrialState};
use super::residency::Residency;
use super::schedule::{TeamSchedule, min_populations_per_task};
use super::stages::{Stage, observed};
use crate::backend::{Backend, BackendError, Group, GroupScores, Weights};
use crate::config::{Fitness, Learning, Leniency};
use crate::parallel::*;

/// Teams per rayon task when their G is added up.
const TEAMS_TOGETHER: usize = 1 << 16;

/// Plays the teams of every trial of some experiments as one batch. Returns their scores, for [`keep`]. An experiment
/// that is over plays its champions only.
pub(super) fn play<'a>(
    backend: &mut dyn Backend,
    experiments: &'a [(usize, &'a mut ExperimentState)],
) -> Result<Vec<GroupScores>, BackendError> {
    let mut groups = Vec::new();
    for (_, experiment) in experiments {
        let (stage, range) = (experiment.stage(), experiment.playing());
        let (teams, leaders) = (experiment.teams(), stage.world.leaders());
        let previous = experiment.stages.ending_before(experiment.generation);
        for (index, schedule) in experiment.schedules.iter().enumerate() {
            let weights = experiment.weights(index);
            let mut add = |stage: &'a Stage, starts, range: Range<usize>| {
                let teams = &schedule.teams[range.start * leaders..range.end * leaders];
                groups.extend(episodes(stage, starts, weights, teams, &stage.fitnesses));
            };
            // Champions play in the stage that they come from.
            let end = if previous.is_some() { teams } else { range.end };
            add(stage, &schedule.starts, range.start..end);
            if let Some(previous) = previous {
                add(previous, &schedule.previous_stage_starts, teams..teams + 1);
            }
        }
    }
    backend.play(&groups)
}

/// Returns the group of each episode of some teams.
fn episodes<'a>(
    stage: &'a Stage,
    starts: &'a [Vec<Vec2>],
    weights: Weights<'a>,
    teams: &'a [u32],
    fitnesses: &'a [Fitness],
) -> impl Iterator<Item = Group<'a>> {
    let (world, policies) = (&stage.world, stage.config.learning.slots());
    let populations = &world.populations;
    starts.iter().map(move |starts| Group { world, starts, weights, policies, populations, teams, fitnesses })
}

/// Plays the episodes that test the best team of each trial, if the config has any. The scores of the generation are
/// kept already.
///
/// # Errors
/// The backend failed.
pub(super) fn test(
    backend: &mut dyn Backend,
    experiments: &mut [(usize, &mut ExperimentState)],
) -> Result<(), BackendError> {
    let mut groups = Vec::new();
    for (_, experiment) in experiments.iter().filter(|(_, experiment)| !experiment.only_champions_left()) {
        let stage = experiment.stage();
        let (teams, leaders) = (stage.config.learning.team_count(), stage.world.leaders());
        for (index, (trial, schedule)) in experiment.trials.iter().zip(&experiment.schedules).enumerate() {
            if !schedule.test_starts.is_empty() {
                let sums = (0..teams).map(|team| observed(&trial.scores, team));
                let best = sums.enumerate().max_by_key(|&(team, sum)| (sum, Reverse(team))).map_or(0, |(team, _)| team);
                let best = &schedule.teams[best * leaders..(best + 1) * leaders];
                groups.extend(episodes(stage, &schedule.test_starts, experiment.weights(index), best, &[]));
            }
        }
    }
    if groups.is_empty() {
        return Ok(());
    }
    let mut scores = backend.play(&groups)?.into_iter();
    for (_, experiment) in experiments.iter_mut().filter(|(_, experiment)| !experiment.only_champions_left()) {
        for (trial, schedule) in experiment.trials.iter_mut().zip(&experiment.schedules) {
            trial.test_scores = scores.by_ref().take(schedule.test_starts.len()).collect();
        }
    }
    Ok(())
}

/// Gives each trial its scores, in the order in which [`play`] plays.
pub(super) fn keep(scores: Vec<GroupScores>, experiments: &mut [(usize, &mut ExperimentState)]) {
    let mut scores = scores.into_iter();
    for (_, ExperimentState { trials, schedules, .. }) in experiments {
        for (trial, schedule) in trials.iter_mut().zip(schedules) {
            trial.scores = scores.by_ref().take(schedule.starts.len()).collect();
            trial.previous_stage_scores = scores.by_ref().take(schedule.previous_stage_starts.len()).collect();
        }
    }
}

impl ExperimentState {
    /// Returns the weights of a trial, on the device that holds them or else on the host.
    fn weights(&self, trial: usize) -> Weights<'_> {
        let held = self.residency.on_device().get(trial);
        held.map_or(self.trials[trial].weights[..].into(), |held| Weights::OnDevice(&**held))
    }

    /// Returns the range of teams to play. The last is the champions' team: it does not play in the first generation,
    /// and plays alone after the last one.
    fn playing(&self) -> Range<usize> {
        let teams = self.teams();
        let first = if self.only_champions_left() { teams } else { 0 };
        first..teams + usize::from(self.generation > 0)
    }

    /// Turns a generation's scores into fitness, and returns the rows that its champions complete. `index` is the
    /// experiment's in its trainer. `given_scores` replaces the scores, `[trials][teams][leaders]`.
    pub fn collect_results(&mut self, index: usize, given_scores: Option<&[f32]>) -> Vec<Row> {
        let (generation, size) = (self.generation, self.teams() * self.stage().world.leaders());
        let ExperimentState { stages, trials, schedules, .. } = self;
        let stage = stages.of(generation);
        let Stage { config, world, .. } = stage;
        let (teams, hall) = (config.learning.team_count(), config.hall_teams(generation) > 0);
        let total_before = stages.ending_before(generation).map_or(world.total_worth, |stage| stage.world.total_worth);
        let mut rows = Vec::with_capacity(trials.len());
        for (number, (trial, schedule)) in trials.iter_mut().zip(schedules).enumerate() {
            // Teams with past champions are not among the k·m teams whose best and mean count.
            let [best_g, mean_g] = team_g(&trial.scores, world.total_worth, teams);
            rows.extend(trial.pending.map(|row| Row { champion_g: trial.champion_g(total_before), ..row }));
            let test_g = (!trial.test_scores.is_empty()).then(|| last_g(&trial.test_scores, world.total_worth));
            trial.pending = Some(Row {
                experiment: index,
                trial: trial.index,
                generation,
                best_g,
                mean_g,
                champion_g: 0.0,
                test_g,
            });
            let score = |team: usize, leader: usize| match given_scores {
                Some(given_scores) => given_scores[number * size + team * world.leaders() + leader],
                None => stage.mean_score(&trial.scores, (team, leader)),
            };
            let (fitness, ranks) = trial.fitness.split_at_mut(config.populations() * config.learning.population);
            assign_fitness(score, schedule, &world.populations, hall, &config.learning, fitness);
            rank_teams(&trial.scores, schedule, &world.populations, config.learning.population, ranks);
            trial.forget_scores();
        }
        rows
    }

    /// Returns the last generation's rows, which its champions have just completed. The experiment is done then.
    pub fn collect_last_rows(&mut self) -> Vec<Row> {
        let total = self.stage().world.total_worth;
        let row = |trial: &mut TrialState| {
            let row = trial.pending.map(|row| Row { champion_g: trial.champion_g(total), ..row });
            trial.forget_scores();
            row
        };
        let rows = self.trials.iter_mut().filter_map(row).collect();
        // The weights were fetched before.
        self.residency = Residency::Host;
        self.generation += 1;
        rows
    }
}

impl TrialState {
    /// Returns G of the champion's team, the last of those that played. `total` is what all POIs are worth.
    fn champion_g(&self, total: u32) -> f64 {
        last_g(if self.previous_stage_scores.is_empty() { &self.scores } else { &self.previous_stage_scores }, total)
    }

    /// Frees the memory of scores that were used.
    fn forget_scores(&mut self) {
        (self.scores, self.previous_stage_scores, self.test_scores) = (vec![], vec![], vec![]);
    }
}

/// Returns G of the last team of some episodes. `total` is what all POIs are worth.
fn last_g(episodes: &[GroupScores], total: u32) -> f64 {
    let observed = |episode: &GroupScores| u64::from(episode.observed.last().copied().unwrap_or(0));
    episodes.iter().map(observed).sum::<u64>() as f64 / (f64::from(total) * episodes.len() as f64)
}

/// Writes minus the rank of each policy's team by G, `[populations][policies]`, unless `ranks` is empty. Ties go to the
/// lower index, so that teams that were kept stay.
fn rank_teams(episodes: &[GroupScores], schedule: &TeamSchedule, populations: &[u32], teams: usize, ranks: &mut [f32]) {
    if ranks.is_empty() {
        return;
    }
    let sums: Vec<u64> = (0..teams).map(|team| observed(episodes, team)).collect();
    let mut order: Vec<usize> = (0..teams).collect();
    order.sort_by_key(|&team| Reverse(sums[team]));
    for (rank, team) in order.into_iter().enumerate() {
        let policies = &schedule.teams[team * populations.len()..][..populations.len()];
        for (&policy, &population) in policies.iter().zip(populations) {
            ranks[population as usize * teams + policy as usize] = 0.0 - rank as f32;
        }
    }
}

/// Returns G of the best team, and the mean over teams. `episodes` are the scores of each episode, and `worth` is what all
/// POIs are worth.
fn team_g(episodes: &[GroupScores], worth: u32, teams: usize) -> [f64; 2] {
    let fold = |all: (u64, u64), (best, total)| (all.0.max(best), all.1 + total);
    let chunk = |first: usize| {
        let teams = first..teams.min(first + TEAMS_TOGETHER);
        teams.map(|team| observed(episodes, team)).map(|g| (g, g)).fold((0, 0), fold)
    };
    let chunks: Vec<_> =
        (0..teams.div_ceil(TEAMS_TOGETHER)).into_par_iter().map(|index| chunk(index * TEAMS_TOGETHER)).collect();
    let (best, total) = chunks.into_iter().fold((0, 0), fold);
    let whole = f64::from(worth) * episodes.len() as f64;
    [best as f64 / whole, total as f64 / (whole * teams as f64)]
}

/// Assigns each policy the mean score of its leaders in its team, or the mean or the largest over several teams.
/// `populations` are the leaders', and `hall` means that the last of a policy's teams has past champions. `score` takes
/// a team and a leader, `fitness` is `[populations][policies]`.
///
/// Means add in 64 bits, in the order of the leaders and of the teams. The fitness is rounded to 32 bits once.
fn assign_fitness(
    score: impl Fn(usize, usize) -> f32 + Sync,
    schedule: &TeamSchedule,
    populations: &[u32],
    hall: bool,
    learning: &Learning,
    fitness: &mut [f32],
) {
    let Learning { population, partners, leniency, .. } = *learning;
    let (leaders, played) = (populations.len(), partners + usize::from(hall));
    let of_each = fitness.par_chunks_exact_mut(population).with_min_len(min_populations_per_task(population));
    of_each.enumerate().for_each(|(index, fitness)| {
        let members: Vec<usize> = (0..leaders).filter(|&leader| populations[leader] as usize == index).collect();
        let in_team = |team: usize| {
            let total: f64 = members.iter().map(|&leader| f64::from(score(team, leader))).sum();
            (schedule.teams[team * leaders + members[0]] as usize, total / members.len() as f64)
        };
        let contemporary = partners * population;
        let with_past = contemporary + index * population;
        let with_past = with_past..with_past + if hall { population } else { 0 };
        let scores = (0..contemporary).chain(with_past).map(in_team);
        match leniency {
            _ if played == 1 => scores.for_each(|(policy, score)| fitness[policy] = score as f32),
            Leniency::Max => {
                fitness.fill(f32::NEG_INFINITY);
                // Not `f32::max`, which may return either of two zeros.
                scores.for_each(|(policy, score)| {
                    if score as f32 > fitness[policy] {
                        fitness[policy] = score as f32;
                    }
                });
            }
            Leniency::Mean => {
                let mut totals = vec![0.0; population];
                scores.for_each(|(policy, score)| totals[policy] += score);
                fitness.iter_mut().zip(totals).for_each(|(mean, total)| *mean = (total / played as f64) as f32);
            }
        }
    });
}
