//! The generation loop: all trials of all experiments advance together, in one batch per generation.
//!
//! A generation is: draw the team schedules, play them, collect the results, plan the next generation, breed it.
//!
//! | file | contents |
//! |---|---|
//! | `experiment` | the state of one experiment and its trials |
//! | `stages` | the stages of a curriculum |
//! | `schedule` | who plays with whom in a generation, and from where |
//! | `residency` | where populations are: on the host or on a device |
//! | `populations` | moving populations between the two, and breeding them |
//! | `results` | playing a generation, and its rows and fitness |
//! | `ask_tell` | the teams of a generation and their scores, for callers that score policies |
//!
//! [`Trainer::advance`] is the only loop body of every training. It has two halves: [`Trainer::play`] and
//! [`Trainer::breed`]. Between them, a caller may replace the scores.

use std::collections::TryReserveError;
use std::time::Duration;

use fearless_simd::Level;

use crate::backend::{Backend, BackendError};
use crate::config::ValidConfig;
use crate::host::Instant;
use crate::parallel::*;
use crate::world::World;

mod ask_tell;
pub mod digest;
mod experiment;
mod populations;
mod residency;
mod results;
mod schedule;
mod stages;

pub use ask_tell::Candidates;

use experiment::ExperimentState;
use residency::Residency;
use schedule::TeamSchedule;
use stages::Stage;

/// Trains any number of experiments side by side. Each is at a generation of its own.
pub struct Trainer {
    experiments: Vec<ExperimentState>,
    level: Level,
    times: GenerationTimes,
    /// Whether no backend may hold the populations.
    on_host: bool,
}

/// The results of one generation of one trial. Every G is in 0..1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// The experiment's index in its trainer; 0 in a run by itself.
    pub experiment: usize,
    /// The trial, from 0.
    pub trial: usize,
    /// The generation, from 0, the random start.
    pub generation: usize,
    /// G of the best team.
    pub best_g: f64,
    /// Mean G over the teams.
    pub mean_g: f64,
    /// G of the team of every population's best policy.
    pub champion_g: f64,
    /// Mean G of the best team over the config's test episodes, if there are any.
    pub test_g: Option<f64>,
}

/// The state that an experiment resumes from: the populations about to play, and each trial's unfinished row.
///
/// `N` is `Vec<f32>`, or a slice of a trainer's memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot<N = Vec<f32>> {
    /// The generation that plays next.
    pub generation: usize,
    /// The run's last generation, after which policies stay as they are.
    pub last: usize,
    /// A trial's weights, `[populations][slots][parameters]`, see
    /// [`Config::populations`](crate::config::Config::populations) and
    /// [`Learning::slots`](crate::config::Learning::slots).
    pub weights: Vec<N>,
    /// A trial's scores of the previous generation, see [`Config::fitness_len`](crate::config::Config::fitness_len).
    pub fitness: Vec<N>,
    /// A trial's row of the previous generation.
    pub pending: Vec<Option<Row>>,
}

/// State from which a finished experiment is extended, in addition to its rows and policies.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ending {
    /// A trial's weights after the last generation, as in [`Snapshot`]. Empty if the policies and their fitness are
    /// enough, see [`Learning::extends_from_policies`](crate::config::Learning::extends_from_policies).
    pub weights: Vec<Vec<f32>>,
    /// A trial's scores of the last generation, see [`Config::fitness_len`](crate::config::Config::fitness_len).
    pub fitness: Vec<Vec<f32>>,
}

impl Snapshot<&[f32]> {
    /// Copies the weights and scores.
    ///
    /// # Errors
    /// There is too little memory.
    pub fn copy(self) -> Result<Snapshot, TryReserveError> {
        let copy = |numbers: &[f32]| {
            let mut copy = Vec::new();
            copy.try_reserve_exact(numbers.len())?;
            copy.extend_from_slice(numbers);
            Ok(copy)
        };
        let each = |trials: Vec<&[f32]>| -> Result<Vec<_>, TryReserveError> { trials.into_iter().map(copy).collect() };
        let Snapshot { generation, last, weights, fitness, pending } = self;
        Ok(Snapshot { generation, last, weights: each(weights)?, fitness: each(fitness)?, pending })
    }
}

/// The time that generations took, by phase.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GenerationTimes {
    /// Drawing team schedules, unless that was done while others played.
    pub prepare: Duration,
    /// Rollouts and scores.
    pub play: Duration,
    /// Rows and fitness.
    pub collect: Duration,
    /// Selection and mutation.
    pub breed: Duration,
}

/// The outcome of an experiment: the sorted policies of each trial, and the snapshot after the last generation.
///
/// The snapshot has no weights if the sorted policies and their fitness are enough to continue from.
pub type End<'a> = (Vec<&'a [f32]>, Snapshot<&'a [f32]>);

/// Why there is no snapshot.
#[derive(Debug, thiserror::Error)]
pub enum SnapshotError {
    /// The system has too little memory for it.
    #[error(transparent)]
    Memory(#[from] TryReserveError),
    /// The populations cannot be copied to the host.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// Methods panic if an experiment or a trial does not exist.
impl Trainer {
    /// Creates random populations for every trial of every config.
    pub fn new(configs: impl IntoIterator<Item = ValidConfig>) -> Trainer {
        let level = Level::new();
        let experiment = |config: ValidConfig| ExperimentState::new(&config, 0..config.learning.trials, level);
        let experiments = configs.into_iter().map(experiment).collect();
        Trainer { experiments, level, times: GenerationTimes::default(), on_host: false }
    }

    /// Creates random populations for one trial of a config. Its rows are the same as among the other trials.
    pub fn of_trial(config: &ValidConfig, trial: usize) -> Trainer {
        let level = Level::new();
        let experiments = vec![ExperimentState::new(config, trial..trial + 1, level)];
        Trainer { experiments, level, times: GenerationTimes::default(), on_host: false }
    }

    /// Returns the generation that an experiment plays next: two past its last when it is done.
    pub fn generation(&self, experiment: usize) -> usize {
        self.experiments[experiment].generation
    }

    /// Makes the generation that an experiment plays next its last, unless an earlier one is. Returns the last.
    ///
    /// The results are those of a config with that number of generations.
    pub fn end(&mut self, experiment: usize) -> usize {
        let ExperimentState { stages, generation, .. } = &mut self.experiments[experiment];
        stages.last_generation = stages.last_generation.min(*generation);
        stages.last_generation
    }

    /// Returns and resets the times of generations.
    pub fn take_times(&mut self) -> GenerationTimes {
        std::mem::take(&mut self.times)
    }

    /// Reports whether every experiment has played its last generation, and that generation's champions.
    pub fn is_done(&self) -> bool {
        self.experiments.iter().all(ExperimentState::is_done)
    }

    /// Keeps all populations on the host from now on, so that they can be read at any time.
    pub(crate) fn keep_on_host(&mut self) {
        self.on_host = true;
    }

    /// Plays, scores and breeds one generation of every experiment that has one left. Returns the rows that became
    /// complete, see [`Trainer::breed`].
    ///
    /// # Errors
    /// The backend failed. The trainer is then still before this generation, and another backend can play it, unless
    /// the one that failed holds the populations. Then a new trainer continues from a [`Trainer::snapshot`].
    pub fn advance(&mut self, backend: &mut dyn Backend) -> Result<Vec<Row>, BackendError> {
        // Enters the thread pool once, because waking a thread takes longer than a small generation.
        scope(|_| {
            self.play(backend)?;
            Ok(self.breed(None))
        })
    }

    /// Plays every generation that is left, and returns all rows.
    ///
    /// # Errors
    /// The backend failed. The trainer is then before that generation, and the rows before it are lost.
    pub fn finish(&mut self, backend: &mut dyn Backend) -> Result<Vec<Row>, BackendError> {
        let mut rows = Vec::new();
        while !self.is_done() {
            rows.extend(self.advance(backend)?);
        }
        Ok(rows)
    }

    /// Plays the teams of one generation of every experiment that has one left, and keeps their scores.
    ///
    /// # Errors
    /// See [`Trainer::advance`].
    pub(crate) fn play(&mut self, backend: &mut dyn Backend) -> Result<(), BackendError> {
        scope(|_| {
            let (level, start) = (self.level, Instant::now());
            if !self.on_host {
                unfinished(&mut self.experiments).try_for_each(|(_, experiment)| experiment.offer(backend))?;
            }
            let mut playing: Vec<_> = unfinished(&mut self.experiments).collect();
            playing.par_iter_mut().for_each(|(_, experiment)| experiment.prepare(level));
            let prepared = Instant::now();
            play_and_draw_next(&mut playing, level, backend)?;
            results::test(backend, &mut playing)?;
            let mut over = playing.iter_mut().filter(|(_, experiment)| experiment.only_champions_left());
            over.try_for_each(|(_, experiment)| experiment.fetch())?;
            self.times.prepare += prepared - start;
            self.times.play += prepared.elapsed();
            Ok(())
        })
    }

    /// Breeds the next generation of every experiment that [`Trainer::play`] played. `fitness` is what each leader of
    /// each team of the first experiment was worth, `[trials][teams][leaders]`; `None` takes the config's fitness.
    ///
    /// Returns the rows that became complete, by experiment, trial and generation. A generation's champions play with
    /// the next generation. The last champions play alone.
    pub(crate) fn breed(&mut self, fitness: Option<&[f32]>) -> Vec<Row> {
        scope(|_| {
            let (level, start) = (self.level, Instant::now());
            let mut playing: Vec<_> = unfinished(&mut self.experiments).collect();
            let collect =
                |(index, experiment): &mut (usize, &mut ExperimentState)| match experiment.only_champions_left() {
                    true => experiment.collect_last_rows(),
                    false => experiment.collect_results(*index, fitness.filter(|_| *index == 0)),
                };
            let mut rows = playing.par_iter_mut().flat_map_iter(collect).collect::<Vec<_>>();
            let collected = Instant::now();
            playing.retain(|(_, experiment)| !experiment.only_champions_left());
            playing.par_iter_mut().for_each(|(_, experiment)| experiment.breed(level));
            rows.sort_by_key(|row| (row.experiment, row.trial, row.generation));
            self.times.collect += collected - start;
            self.times.breed += collected.elapsed();
            rows
        })
    }

    /// Returns the policies of an experiment's last generation, which it has played: best first in each population, one
    /// `[populations][policies][parameters]` per trial.
    pub fn policies(&self, experiment: usize) -> Vec<Vec<f32>> {
        let experiment = &self.experiments[experiment];
        let sort = |trial: &experiment::TrialState| {
            let mut policies = vec![0.0; experiment.policy_len()];
            experiment.sort(trial, &mut policies);
            policies
        };
        experiment.trials.iter().map(sort).collect()
    }

    /// Returns the outcomes of experiments that are done: [`Trainer::policies`], in the next generation's memory, and
    /// the snapshot after the last generation. Its weights are empty if they are only the policies in another order.
    pub fn ends(&mut self, experiments: &[usize]) -> Vec<End<'_>> {
        for &experiment in experiments {
            let experiment = &mut self.experiments[experiment];
            let len = experiment.policy_len();
            for index in 0..experiment.trials.len() {
                let mut policies = std::mem::take(&mut experiment.trials[index].children);
                let trial = &experiment.trials[index];
                experiment.sort(trial, &mut policies[..len]);
                experiment.trials[index].children = policies;
            }
        }
        let end = |&experiment: &usize| {
            let experiment = &self.experiments[experiment];
            let len = experiment.policy_len();
            let sorted = experiment.trials.iter().map(|trial| &trial.children[..len]).collect();
            let mut snapshot = Snapshot { generation: experiment.last() + 1, ..experiment.snapshot() };
            if experiment.stage().config.learning.extends_from_policies() {
                snapshot.weights.clear();
            }
            (sorted, snapshot)
        };
        experiments.iter().map(end).collect()
    }

    /// Returns the populations of a trial that are about to play, `[populations][slots][parameters]`, see
    /// [`Learning::slots`](crate::config::Learning::slots).
    ///
    /// # Errors
    /// The backend that holds them failed to return them.
    pub fn weights(&mut self, experiment: usize, trial: usize) -> Result<&[f32], BackendError> {
        let experiment = &mut self.experiments[experiment];
        experiment.fetch()?;
        Ok(&experiment.trials[trial].weights)
    }

    /// Returns the policy of each leader in the teams of contemporaries that a trial plays next, `[teams][leaders]`.
    pub fn teams(&mut self, experiment: usize, trial: usize) -> &[u32] {
        let experiment = &mut self.experiments[experiment];
        experiment.prepare(self.level);
        let Stage { config, world, .. } = experiment.stage();
        &experiment.schedules[trial].teams[..config.learning.team_count() * world.leaders()]
    }

    /// Returns the world that an experiment's next generation plays in.
    pub fn world(&self, experiment: usize) -> &World {
        &self.experiments[experiment].stage().world
    }

    /// Returns what [`Trainer::restore`] needs of an experiment, without copying it.
    ///
    /// # Errors
    /// The backend that holds the populations failed to return them.
    pub fn view(&mut self, experiment: usize) -> Result<Snapshot<&[f32]>, BackendError> {
        let experiment = &mut self.experiments[experiment];
        experiment.fetch()?;
        Ok(experiment.snapshot())
    }

    /// Returns a copy of what [`Trainer::restore`] needs of an experiment.
    ///
    /// # Errors
    /// There is too little memory, or the backend that holds the populations failed to return them.
    pub fn snapshot(&mut self, experiment: usize) -> Result<Snapshot, SnapshotError> {
        Ok(self.view(experiment)?.copy()?)
    }

    /// Copies given policies, `[populations][policies][parameters]`, into the first slots of a trial's populations, in
    /// order, until the slots are full. The other slots keep their random policies.
    ///
    /// Returns false, and changes nothing, if the experiment has played or the sizes do not match.
    #[must_use]
    pub fn start_from(&mut self, experiment: usize, trial: usize, policies: usize, weights: &[f32]) -> bool {
        let experiment = &mut self.experiments[experiment];
        let stage = experiment.stage();
        let (populations, parameters) = (stage.config.populations(), stage.world.parameters());
        let (population, slots) = (stage.config.learning.population, stage.config.learning.slots());
        let fresh = experiment.generation == 0 && matches!(experiment.residency, Residency::Undecided);
        let Some(trial) = experiment.trials.get_mut(trial) else { return false };
        if !fresh || policies == 0 || weights.len() != populations * policies * parameters {
            return false;
        }
        let taken = policies.min(population) * parameters;
        let slots = trial.weights.chunks_exact_mut(slots * parameters);
        for (slots, policies) in slots.zip(weights.chunks_exact(policies * parameters)) {
            slots[..taken].copy_from_slice(&policies[..taken]);
        }
        true
    }

    /// Resumes an experiment from a snapshot of the same config. The snapshot's config may have had fewer generations.
    ///
    /// Returns false, and changes nothing, if the sizes do not match.
    #[must_use]
    pub fn restore(&mut self, experiment: usize, snapshot: Snapshot) -> bool {
        self.experiments[experiment].restore(experiment, snapshot, self.level)
    }
}

/// Returns the experiments that have a generation left, with their indices.
fn unfinished(experiments: &mut [ExperimentState]) -> impl Iterator<Item = (usize, &mut ExperimentState)> {
    experiments.iter_mut().enumerate().filter(|(_, experiment)| !experiment.is_done())
}

/// Plays the teams of some experiments. Meanwhile, draws the next schedules of those whose populations are on a device.
fn play_and_draw_next(
    playing: &mut [(usize, &mut ExperimentState)],
    level: Level,
    backend: &mut dyn Backend,
) -> Result<(), BackendError> {
    let take = |(_, experiment): &mut (usize, &mut ExperimentState)| std::mem::take(&mut experiment.next_schedules);
    let mut next: Vec<Vec<TeamSchedule>> = playing.iter_mut().map(take).collect();
    let (played, ()) = join(
        || results::play(backend, playing),
        || {
            for (next, (_, experiment)) in next.iter_mut().zip(&*playing) {
                if !experiment.residency.on_device().is_empty() {
                    experiment.prepare_next(level, next);
                }
            }
        },
    );
    playing.iter_mut().zip(next).for_each(|((_, experiment), next)| experiment.next_schedules = next);
    results::keep(played?, playing);
    Ok(())
}
