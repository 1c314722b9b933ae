//! The driver of a training. Its caller may score the policies (ask and tell).

use super::{Failure, Generation, Trained};
use crate::backend::{Backend, BackendError};
use crate::config::{Config, ValidConfig};
use crate::evolve;
use crate::memory::{self, Peaks};
use crate::parallel::current_num_threads;
use crate::trainer::{Candidates, Row, Snapshot, Trainer};
use crate::world::World;

/// Training by ask and tell: the caller scores each leader of each team.
///
/// ```
/// use flotilla::{Config, front::{self, Coevolution}};
///
/// let mut config = Config::parse(include_str!("../../configs/generally_forward.toml"), "generally_forward.toml")?;
/// (config.learning.trials, config.learning.generations) = (2, 3);
/// let (mut backend, _) = front::cpu();
/// let mut coevolution = Coevolution::new(&config)?;
/// while !coevolution.is_done() {
///     let (g, fitness) = coevolution.play(&mut *backend)?;
///     // What each leader was worth, [trials][teams][leaders]. Here it is the config's fitness.
///     println!("the best team observes {}", g.iter().fold(0.0_f64, |best, g| best.max(*g)));
///     coevolution.tell(&mut *backend, Some(&fitness))?;
/// }
/// assert_eq!(coevolution.finish()?.digest(), front::train(&config, &mut *backend, |_| std::ops::ControlFlow::Continue(()))?.digest());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Coevolution {
    config: Config,
    trainer: Trainer,
    rows: Vec<Row>,
    /// Whether the present generation was played.
    played: bool,
    own_fitness: bool,
}

/// The state of a [`Coevolution`] between two generations.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// The populations about to play.
    pub snapshot: Snapshot,
    /// All complete rows.
    pub rows: Vec<Row>,
    /// See [`Coevolution::own_fitness`].
    pub own_fitness: bool,
}

impl Coevolution {
    /// Creates random populations for every trial. They stay on the host.
    ///
    /// # Errors
    /// The config is invalid, or its memory does not fit this machine.
    pub fn new(config: &Config) -> Result<Coevolution, Failure> {
        let mut coevolution = Coevolution::on_any_processor(config)?;
        coevolution.trainer.keep_on_host();
        Ok(coevolution)
    }

    /// Creates a training like [`Coevolution::new`], whose populations a backend may hold. [`Coevolution::ask`] cannot
    /// return them then.
    pub(super) fn on_any_processor(config: &Config) -> Result<Coevolution, Failure> {
        let valid = config.validate()?;
        let config = Config::clone(&valid);
        Ok(Coevolution { config, trainer: new_trainer(valid)?, rows: Vec::new(), played: false, own_fitness: false })
    }

    /// Replaces the random populations by given ones, see [`super::train_from`].
    ///
    /// # Errors
    /// The policies do not fit the config, or a generation was played.
    pub fn start_from(&mut self, policies: usize, first: &[Vec<f32>]) -> Result<(), Failure> {
        if self.generation() > 0 || self.played {
            return Err(Failure::State);
        }
        let (leaders, parameters) = (self.config.populations(), self.config.parameters());
        let trials = self.config.learning.trials;
        if first.len() > 1 && first.len() != trials {
            return Err(Failure::Trials { found: first.len(), trials });
        }
        let checked = |weights: &Vec<f32>| {
            let mut weights = weights.clone();
            if weights.is_empty() || Some(weights.len()) != (leaders * parameters).checked_mul(policies) {
                return Err(Failure::Weights { found: weights.len(), leaders, teams: policies, parameters });
            }
            if let Some(place) = evolve::flush_and_validate(&mut weights) {
                let (policy, parameter, value) = (place / parameters, place % parameters, weights[place]);
                return Err(Failure::Weight { leader: policy / policies, team: policy % policies, parameter, value });
            }
            Ok(weights)
        };
        let first = first.iter().map(checked).collect::<Result<Vec<_>, _>>()?;
        for (trial, weights) in (0..trials).zip(first.iter().cycle()) {
            if !self.trainer.start_from(0, trial, policies, weights) {
                unreachable!("the weights are as many as the config takes");
            }
        }
        Ok(())
    }

    /// Returns the config.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the generation that is about to play.
    pub fn generation(&self) -> usize {
        self.trainer.generation(0)
    }

    /// Reports whether all generations were played.
    pub fn is_done(&self) -> bool {
        self.trainer.is_done()
    }

    /// Reports whether any fitness so far differs from the config's. The run must say so, because its config does not
    /// reproduce it.
    pub fn own_fitness(&self) -> bool {
        self.own_fitness
    }

    /// Returns the rows that are complete: all generations before the last one told.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Returns the generation's policies, teams and starts, one entry per trial, and its world.
    ///
    /// # Errors
    /// All generations were played.
    pub fn ask(&mut self) -> Result<Vec<Candidates<'_>>, Failure> {
        if self.is_done() { Err(Failure::Done) } else { Ok(self.trainer.candidates()) }
    }

    /// Returns the world of the generation, and its teams per trial, without the champions'.
    pub fn world(&self) -> (&World, usize) {
        self.trainer.world_and_teams()
    }

    /// Plays the generation. Returns G, `[trials][teams]`, and the config's fitness of each leader,
    /// `[trials][teams][leaders]`, as means over episodes.
    ///
    /// # Errors
    /// The backend failed, or all generations were played.
    pub fn play(&mut self, backend: &mut dyn Backend) -> Result<(Vec<f64>, Vec<f32>), Failure> {
        if self.is_done() {
            return Err(Failure::Done);
        }
        self.play_once(backend)?;
        Ok(self.trainer.scores())
    }

    fn play_once(&mut self, backend: &mut dyn Backend) -> Result<(), Failure> {
        if !self.played {
            self.trainer.play(backend)?;
            self.played = true;
        }
        Ok(())
    }

    /// Breeds the next generation from what each leader of each team was worth, `[trials][teams][leaders]`, or `None`
    /// for the config's fitness. Plays the generation unless [`Coevolution::play`] did, because its rows need G. After
    /// the last generation its champions play, too.
    ///
    /// Returns the rows that became complete.
    ///
    /// # Errors
    /// The fitness has the wrong length or is not finite, the backend failed, or all generations were played. Nothing
    /// has changed then, with one exception: if the last champions cannot be played, their generation was told. Repeat
    /// the call with `None` to play them.
    pub fn tell(&mut self, backend: &mut dyn Backend, fitness: Option<&[f32]>) -> Result<Generation<'_>, Failure> {
        if self.is_done() {
            return Err(Failure::Done);
        }
        let (world, teams) = self.world();
        let expected = self.config.learning.trials * teams * world.leaders();
        if let Some(told) = fitness {
            if told.len() != expected {
                let text = format!("{} numbers, but [trials][teams][leaders] are {expected}", told.len());
                return Err(Failure::Fitness(text));
            }
            if let Some(place) = told.iter().position(|value| !value.is_finite()) {
                return Err(Failure::Fitness(format!("number {place} is {}, allowed are finite ones", told[place])));
            }
        }
        let first = self.rows.len();
        self.advance(backend, fitness)?;
        if self.generation() > self.config.learning.generations && !self.is_done() {
            self.advance(backend, None)?;
        }
        let rows = &self.rows[first..];
        let generation = rows.last().map_or(0, |row| row.generation);
        Ok(Generation { generation, last: self.config.learning.generations, rows, champions: None })
    }

    /// Plays a generation, unless it was played, and breeds the next one. Returns the rows that became complete.
    pub(super) fn advance(&mut self, backend: &mut dyn Backend, fitness: Option<&[f32]>) -> Result<&[Row], Failure> {
        self.play_once(backend)?;
        if let Some(told) = fitness.filter(|_| !self.own_fitness) {
            let bits = |scores: &[f32]| scores.iter().map(|score| score.to_bits()).collect::<Vec<_>>();
            self.own_fitness = bits(told) != bits(&self.trainer.scores().1);
        }
        let first = self.rows.len();
        self.rows.extend(self.trainer.breed(fitness));
        self.played = false;
        Ok(&self.rows[first..])
    }

    /// Makes the next generation the last, unless an earlier one is.
    pub(super) fn end(&mut self) {
        self.config.learning.generations = self.trainer.end(0);
    }

    /// Returns the champions of the generation that was told last, `[trials][populations][parameters]`.
    ///
    /// # Errors
    /// No generation was told.
    pub fn best(&mut self) -> Result<Vec<f32>, Failure> {
        if self.generation() == 0 {
            return Err(Failure::State);
        }
        Ok(self.previous_champions()?)
    }

    /// Returns the champions of the previous generation, `[trials][populations][parameters]`.
    pub(super) fn previous_champions(&mut self) -> Result<Vec<f32>, BackendError> {
        let (parameters, population) = (self.config.parameters(), self.config.learning.population);
        let champion = population * parameters..(population + 1) * parameters;
        let mut best = Vec::new();
        for trial in 0..self.config.learning.trials {
            let weights = self.trainer.weights(0, trial)?;
            for policies in weights.chunks_exact(self.config.learning.slots() * parameters) {
                best.extend_from_slice(&policies[champion.clone()]);
            }
        }
        Ok(best)
    }

    /// Returns the state, for [`Coevolution::restore`].
    ///
    /// # Errors
    /// There is too little memory.
    pub fn state(&mut self) -> Result<Progress, Failure> {
        let bytes = self.config.policy_bytes().into();
        let snapshot =
            self.trainer.snapshot(0).map_err(|_| Failure::Memory { what: "a copy of all policies", bytes })?;
        Ok(Progress { snapshot, rows: self.rows.clone(), own_fitness: self.own_fitness })
    }

    /// Continues from a state of the same config.
    ///
    /// # Errors
    /// The state does not fit the config. Nothing has changed then.
    pub fn restore(&mut self, state: Progress) -> Result<(), Failure> {
        let trials = self.config.learning.trials;
        let whole = |numbers: &[f32]| numbers.iter().all(|number| number.is_finite());
        let Snapshot { generation, last, weights, fitness, pending } = &state.snapshot;
        let in_turn = state
            .rows
            .iter()
            .enumerate()
            .all(|(place, row)| (row.generation, row.trial) == (place / trials, place % trials));
        let complete = generation.saturating_sub(1) * trials;
        let fits = *last == self.config.learning.generations
            && *generation <= last + 2
            && in_turn
            && state.rows.len() == complete
            && weights.iter().flatten().all(|&weight| evolve::is_weight(weight))
            && fitness.iter().all(|fitness| whole(fitness))
            && pending.iter().all(|row| row.is_some() == (*generation > 0));
        if !fits || !self.trainer.restore(0, state.snapshot) {
            return Err(Failure::State);
        }
        (self.rows, self.played, self.own_fitness) = (state.rows, false, state.own_fitness);
        Ok(())
    }

    /// Returns the results.
    ///
    /// # Errors
    /// Generations are left.
    pub fn finish(&mut self) -> Result<Trained, Failure> {
        if !self.is_done() {
            return Err(Failure::State);
        }
        Trained::of(&mut self.trainer, self.config.clone(), &self.rows)
    }
}

/// Checks that a training fits this machine's memory, and returns its trainer.
fn new_trainer(config: ValidConfig) -> Result<Trainer, Failure> {
    let plan = Peaks::of([&config], current_num_threads());
    // Nothing is saved during training, but the results stay in memory: every row twice, and the policies.
    let rows = config.learning.trials as u64 * (config.learning.generations as u64 + 1);
    // The last slots stay too, if they are needed to extend the run.
    let slots = if config.learning.extends_from_policies() { 0 } else { memory::snapshot_bytes(&config) };
    let kept = rows * (size_of::<Row>() + 3 * size_of::<f64>()) as u64 + config.policy_bytes() + slots;
    let needed = (plan.host.min(plan.gpu_host) - plan.checkpoint).saturating_add(kept);
    memory::check(needed, 0)?;
    Ok(Trainer::new([config]))
}
