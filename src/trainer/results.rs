//! The results of a generation: plays it, scores it, and turns scores into rows and fitness.

use std::cell::RefCell;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use glam::Vec2;

use super::Row;
use super::experiment::{Experiment, TrialState};
use super::schedule::{MIN_POLICIES_PER_TASK, TeamSchedule, min_populations_per_task};
use super::stages::Stage;
use crate::backend::{Backend, BackendError, Episode, Group, RecordRequest, Weights};
use crate::config::Sharing;
use crate::credit::Credit;
use crate::parallel::*;

/// Plays the teams of every trial of some experiments as one batch, and keeps their scores. An experiment that is over
/// plays its champions only.
pub(super) fn play<'a>(
    backend: &mut dyn Backend,
    experiments: &'a [(usize, &'a mut Experiment)],
) -> Result<(), BackendError> {
    thread_local! { static CREDIT: RefCell<(Credit, Vec<f32>)> = RefCell::default(); }
    let (mut groups, mut places) = (Vec::new(), Vec::new());
    for (_, experiment) in experiments {
        let (stage, range) = (experiment.stage(), experiment.playing());
        let (population, leaders) = (stage.config.learning.population, stage.world.leaders());
        let previous = experiment.stages.ending_before(experiment.residency.generation());
        let on_device = experiment.residency.on_device();
        for (index, (trial, schedule)) in experiment.trials.iter().zip(&experiment.schedules).enumerate() {
            let weights = on_device.get(index).map_or(trial.weights[..].into(), |held| Weights::OnDevice(&**held));
            let mut add = |stage: &'a Stage, starts: &'a [Vec<Vec2>], range: Range<usize>| {
                let (world, fitness) = (&stage.world, stage.config.learning.fitness);
                let (teams, need) =
                    (&schedule.teams[range.start * leaders..range.end * leaders], RecordRequest::Score(fitness));
                for (episode, starts) in starts.iter().enumerate() {
                    groups.push(Group { world, starts, weights, policies: population + 1, teams, need });
                    places.push((world, fitness, trial, episode * (population + 1) + range.start));
                }
            };
            // Champions play in the stage that they come from.
            let end = if previous.is_some() { population } else { range.end };
            add(stage, &schedule.starts, range.start..end);
            if let Some(previous) = previous {
                add(previous, &schedule.previous_stage_starts, population..population + 1);
            }
        }
    }
    backend.rollout(&groups, &|episode: Episode<'_>| {
        let (world, fitness, trial, first) = places[episode.group];
        let (team, leaders) = (first + episode.team, world.leaders());
        CREDIT.with_borrow_mut(|(credit, scores)| {
            scores.resize(leaders, 0.0);
            let observed = credit.score(&episode, world, fitness, scores);
            trial.observed[team].store(observed, Relaxed);
            for (to, score) in trial.scores[team * leaders..].iter().zip(&*scores) {
                to.store(score.to_bits(), Relaxed);
            }
        });
    })
}

impl Experiment {
    /// The teams that play, by index. The last is the champion's: the first generation has no champion before it, and
    /// after the last generation champions play alone.
    fn playing(&self) -> Range<usize> {
        let population = self.stage().config.learning.population;
        let first = if self.is_over() { population } else { 0 };
        first..population + usize::from(self.residency.generation() > 0)
    }

    /// Turns a generation's scores into fitness, and returns the rows that its champions complete. `index` is the
    /// experiment's in its trainer.
    pub fn collect_results(&mut self, index: usize) -> Vec<Row> {
        let generation = self.residency.generation();
        let Experiment { stages, trials, schedules, .. } = self;
        let Stage { config, world, .. } = stages.of(generation);
        let population = config.learning.population;
        let pois_before = stages.ending_before(generation).map_or(world.pois.len(), |stage| stage.world.pois.len());
        let mut rows = Vec::with_capacity(trials.len());
        for (trial, schedule) in trials.iter_mut().zip(schedules) {
            let [best_g, mean_g] = trial.team_g(schedule, world.pois.len(), population);
            let champion_g = trial.champion_g(schedule, pois_before, population);
            rows.extend(trial.pending.map(|row| Row { champion_g, ..row }));
            trial.pending = Some(Row { arm: index, trial: trial.index, generation, best_g, mean_g, champion_g: 0.0 });
            match config.learning.sharing {
                Sharing::None => trial.assign_fitness(schedule, world.leaders(), population),
                Sharing::All => trial.assign_shared_fitness(schedule, world.leaders(), population),
            }
        }
        rows
    }

    /// Returns the last generation's rows, which its champions have just completed. The experiment is done then.
    pub fn collect_last_rows(&mut self) -> Vec<Row> {
        let Stage { config, world, .. } = self.stage();
        let (pois, population) = (world.pois.len(), config.learning.population);
        let row = |(trial, schedule): (&TrialState, &TeamSchedule)| {
            let champion_g = trial.champion_g(schedule, pois, population);
            trial.pending.map(|row| Row { champion_g, ..row })
        };
        let rows = self.trials.iter().zip(&self.schedules).filter_map(row).collect();
        // The weights were fetched before.
        self.residency.lose();
        self.residency.bred();
        rows
    }
}

impl TrialState {
    /// Returns G of the best team, and the mean over teams.
    fn team_g(&self, schedule: &TeamSchedule, pois: usize, population: usize) -> [f64; 2] {
        let episodes = schedule.starts.len();
        let observed = |team: usize| self.observed(team, episodes, population);
        let whole = (pois * episodes) as f64;
        let best = (0..population).map(observed).max().unwrap_or(0);
        let total: u64 = (0..population).map(observed).sum();
        [best as f64 / whole, total as f64 / (whole * population as f64)]
    }

    /// Returns G of the champion's team, which may have played in the previous stage.
    fn champion_g(&self, schedule: &TeamSchedule, pois: usize, population: usize) -> f64 {
        let TeamSchedule { starts, previous_stage_starts, .. } = schedule;
        let episodes = if previous_stage_starts.is_empty() { starts.len() } else { previous_stage_starts.len() };
        self.observed(population, episodes, population) as f64 / (pois * episodes) as f64
    }

    /// Returns how many POIs a team observed in all episodes.
    fn observed(&self, team: usize, episodes: usize, population: usize) -> u64 {
        (0..episodes).map(|episode| u64::from(self.observed[episode * (population + 1) + team].load(Relaxed))).sum()
    }

    /// Assigns each policy its leader's score in its team, averaged over episodes.
    fn assign_fitness(&mut self, schedule: &TeamSchedule, leaders: usize, population: usize) {
        let TeamSchedule { orders, starts, .. } = schedule;
        let TrialState { scores, fitness, .. } = self;
        let episodes = starts.len();
        let populations = fitness.par_chunks_exact_mut(population).zip(orders.par_chunks_exact(population));
        populations.with_min_len(min_populations_per_task(population)).enumerate().for_each(
            |(leader, (fitness, order))| {
                for (team, &policy) in order.iter().enumerate() {
                    fitness[policy as usize] = mean_score(scores, episodes, population + 1, team, leaders, leader);
                }
            },
        );
    }

    /// Assigns each policy of a shared population the mean of its leaders' scores, summed in the leaders' order.
    fn assign_shared_fitness(&mut self, schedule: &TeamSchedule, leaders: usize, population: usize) {
        let (episodes, scores) = (schedule.starts.len(), &self.scores);
        let min_len = MIN_POLICIES_PER_TASK.div_ceil(leaders);
        self.fitness.par_iter_mut().with_min_len(min_len).enumerate().for_each(|(team, fitness)| {
            let score = |leader| f64::from(mean_score(scores, episodes, population + 1, team, leaders, leader));
            *fitness = ((0..leaders).map(score).sum::<f64>() / leaders as f64) as f32;
        });
    }
}

/// Returns the score of one leader of a team, averaged over episodes. `scores` are `[episodes][teams][leaders]`.
#[inline(always)]
fn mean_score(scores: &[AtomicU32], episodes: usize, teams: usize, team: usize, leaders: usize, leader: usize) -> f32 {
    let score =
        |episode: usize| f64::from(f32::from_bits(scores[(episode * teams + team) * leaders + leader].load(Relaxed)));
    let total: f64 = (0..episodes).map(score).sum();
    (total / episodes as f64) as f32
}
