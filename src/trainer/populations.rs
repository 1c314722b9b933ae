//! The populations of an experiment: moving them between host and device, and breeding them.

use std::cell::RefCell;

use fearless_simd::Level;

use super::experiment::{ExperimentState, TrialState};
use super::residency::Residency;
use super::stages::Stage;
use crate::backend::{Backend, BackendError};
use crate::config::{Learning, Method};
use crate::evolve::{self, Breeding, Key, Purpose, Samples, Selection, Strategy};
use crate::parallel::*;

/// Slots that one thread fills at a time.
const SLOTS_PER_TASK: usize = 64;

impl ExperimentState {
    /// Asks a backend once to hold the populations. It takes those of all trials or none.
    ///
    /// # Errors
    /// The backend failed, or a backend has lost the populations.
    pub fn offer(&mut self, backend: &mut dyn Backend) -> Result<(), BackendError> {
        self.residency.check()?;
        if !matches!(self.residency, Residency::Undecided) {
            return Ok(());
        }
        self.residency = Residency::Host;
        let Stage { config, world, .. } = self.stage();
        // Devices mutate, but do not sample.
        if config.learning.method != Method::Tournament {
            return Ok(());
        }
        let sizes = [config.populations(), config.learning.slots(), world.parameters()];
        let held: Option<Vec<_>> =
            self.trials.iter().map(|trial| backend.hold(&trial.weights, sizes).transpose()).collect();
        if let Some(held) = held {
            let populations = held.into_iter().collect::<Result<_, _>>()?;
            self.residency = Residency::Device { populations, host_is_current: true };
        }
        Ok(())
    }

    /// Copies the populations of all trials to the host, unless the host's are current. An error copies none.
    pub fn fetch(&mut self) -> Result<(), BackendError> {
        self.residency.check()?;
        let Residency::Device { populations, host_is_current } = &mut self.residency else { return Ok(()) };
        if *host_is_current {
            return Ok(());
        }
        for (held, trial) in populations.iter().zip(&mut self.trials) {
            held.fetch(&mut trial.children)?;
        }
        for TrialState { weights, children, .. } in &mut self.trials {
            std::mem::swap(weights, children);
        }
        *host_is_current = true;
        Ok(())
    }

    /// Breeds the next generation, on the host or on the device that holds the populations. After the last generation,
    /// no policy changes. Tournaments then copy the champion to its slot, and evolution strategies move the mean, which is
    /// in that slot.
    ///
    /// The results of this generation are already known. So if the backend that holds the populations fails, the next
    /// use of the populations returns its error.
    pub fn breed(&mut self, level: Level) {
        if self.residency.on_device().is_empty() {
            return self.breed_on_host(level);
        }
        if let Err(error) = self.breed_on_device(level) {
            self.residency = Residency::Lost(Some(error));
        }
        self.generation += 1;
    }

    /// Plans the next generation, and lets the device breed it.
    fn breed_on_device(&mut self, level: Level) -> Result<(), BackendError> {
        self.plan(level);
        let ExperimentState { stages, trials, residency, generation, .. } = self;
        let Residency::Device { populations, host_is_current } = residency else { return Ok(()) };
        *host_is_current = false;
        let (generation, learning) = (*generation, &stages.of(*generation).config.learning);
        populations.iter_mut().zip(trials).try_for_each(|(held, trial)| {
            let key = Key::new(learning.seed, trial.index, Purpose::Mutation);
            held.breed(&Breeding { parents: &trial.parents, key, generation, learning })
        })
    }

    /// Plans the next generation of all populations. After the last generation, every policy is kept.
    pub fn plan(&mut self, level: Level) {
        let (generation, last) = (self.generation, self.last());
        let ExperimentState { stages, trials, .. } = self;
        let config = &stages.of(generation).config;
        let (learning, scores) = (&config.learning, config.populations() * config.learning.population);
        trials.par_iter_mut().for_each(|trial| {
            let key = Key::new(learning.seed, trial.index, Purpose::Tournament);
            let (fitness, ranks) = trial.fitness.split_at(scores);
            let plans = trial.parents.par_chunks_exact_mut(learning.slots());
            let plans = plans.zip(fitness.par_chunks_exact(learning.population)).enumerate();
            let selection = Selection::of(learning);
            plans.for_each(|(population, (parents, fitness))| match generation == last {
                true => evolve::keep_parents(key, generation, population, selection, fitness, parents),
                false => {
                    evolve::draw_parents(level, key, generation, population, selection, fitness, parents);
                    if let Some(ranks) = ranks.chunks_exact(learning.population).nth(population) {
                        evolve::keep_teams(selection, ranks, parents);
                    }
                }
            });
        });
    }

    /// Breeds populations that the host holds. This cannot fail.
    pub fn breed_on_host(&mut self, level: Level) {
        match self.strategy(level) {
            None => self.select(level),
            Some(strategy) => {
                self.update_search(level, &strategy);
                if self.generation < self.last() {
                    self.sample(level, &strategy);
                }
            }
        }
        self.generation += 1;
    }

    /// Breeds the first additional generation of an extended run, whose champions are known.
    pub fn breed_beyond_the_last(&mut self, level: Level) {
        match self.strategy(level) {
            None => self.select(level),
            Some(strategy) => self.sample(level, &strategy),
        }
        self.generation += 1;
    }

    /// Returns the evolution strategy of the present stage. `None` means tournaments.
    fn strategy(&self, level: Level) -> Option<Strategy> {
        let Stage { config, world, .. } = self.stage();
        Strategy::of(level, &config.learning, world.parameters())
    }

    /// Moves the means of all populations.
    fn update_search(&mut self, level: Level, strategy: &Strategy) {
        let generation = self.generation;
        let (population, stride) = (self.stage().config.learning.population, self.stride());
        self.trials.par_iter_mut().for_each(|TrialState { weights, fitness, .. }| {
            let populations = weights.par_chunks_exact_mut(stride).zip(fitness.par_chunks_exact(population));
            populations.for_each(|(weights, fitness)| strategy.update(level, generation, fitness, weights));
        });
    }

    /// Samples the next generation around the means.
    fn sample(&mut self, level: Level, strategy: &Strategy) {
        thread_local! { static NOISE: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) }; }
        let (generation, stride) = (self.generation, self.stride());
        let Stage { config, world, .. } = self.stage();
        let (&Learning { seed, population: policies, .. }, parameters) = (&config.learning, world.parameters());
        self.trials.par_iter_mut().for_each(|trial| {
            let key = Key::new(seed, trial.index, Purpose::Search);
            let TrialState { weights, children, .. } = trial;
            let populations = weights.par_chunks_exact(stride).zip(children.par_chunks_exact_mut(stride));
            populations.enumerate().for_each(|(population, (weights, children))| {
                let search = &weights[policies * parameters..];
                let (mean, sigmas) = search.split_at(parameters);
                let (children, kept) = children.split_at_mut(policies * parameters);
                kept.copy_from_slice(search);
                let tasks = children.par_chunks_mut(SLOTS_PER_TASK * parameters).with_max_len(4);
                tasks.enumerate().for_each(|(index, children)| {
                    let first = index * SLOTS_PER_TASK;
                    let samples = Samples { key, generation, population, policies, first, mean, sigmas };
                    NOISE.with_borrow_mut(|noise| strategy.sample(level, samples, children, noise));
                });
            });
            std::mem::swap(weights, &mut trial.children);
        });
    }

    /// Numbers in a population.
    fn stride(&self) -> usize {
        let Stage { config, world, .. } = self.stage();
        config.learning.slots() * world.parameters()
    }

    /// Selects parents and mutates them.
    fn select(&mut self, level: Level) {
        thread_local! { static SCRATCH: RefCell<Vec<u32>> = const { RefCell::new(Vec::new()) }; }
        self.plan(level);
        let (generation, stride) = (self.generation, self.stride());
        let ExperimentState { stages, trials, .. } = self;
        let Stage { config, world, .. } = stages.of(generation);
        let (learning, parameters) = (&config.learning, world.parameters());
        trials.par_iter_mut().for_each(|trial| {
            let key = Key::new(learning.seed, trial.index, Purpose::Mutation);
            let TrialState { weights, children, parents, .. } = trial;
            let populations = weights.par_chunks_exact(stride).zip(children.par_chunks_exact_mut(stride));
            let populations = populations.zip(parents.par_chunks_exact(learning.slots())).enumerate();
            populations.for_each(|(leader, ((policies, children), parents))| {
                let tasks = children.par_chunks_mut(SLOTS_PER_TASK * parameters);
                // Small tasks end at about the same time on all threads.
                tasks.with_max_len(4).enumerate().for_each(|(index, children)| {
                    let first = index * SLOTS_PER_TASK;
                    let offspring = evolve::Offspring { key, generation, population: leader, first, parents, policies };
                    SCRATCH.with_borrow_mut(|scratch| evolve::breed(level, learning, offspring, children, scratch));
                });
            });
            std::mem::swap(weights, &mut trial.children);
        });
    }

    /// Copies policies of the last generation, without the champions' slots, best first in each population. With an
    /// evolution strategy the mean comes first, in place of the worst policy.
    pub fn sort(&self, trial: &TrialState, policies: &mut [f32]) {
        let Stage { config, world, .. } = self.stage();
        let (learning, parameters) = (&config.learning, world.parameters());
        let mean = (learning.method != Method::Tournament).then_some(learning.population);
        let key = Key::new(learning.seed, trial.index, Purpose::Tournament);
        let populations = trial.weights.par_chunks_exact(self.stride());
        let populations = populations.zip(trial.fitness.par_chunks_exact(learning.population));
        let sorted = policies.par_chunks_exact_mut(learning.population * parameters);
        populations.zip(sorted).enumerate().for_each(|(population, ((weights, fitness), sorted))| {
            let best = evolve::ranking(key, self.last(), population, Selection::of(learning), fitness);
            for (policy, index) in sorted.chunks_exact_mut(parameters).zip(mean.into_iter().chain(best)) {
                policy.copy_from_slice(&weights[index * parameters..(index + 1) * parameters]);
            }
        });
    }
}
