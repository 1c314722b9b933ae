//! The generation loop: all trials of all arms advance together, one batch a generation.

use std::cell::RefCell;
use std::collections::TryReserveError;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::time::{Duration, Instant};

use fearless_simd::Level;
use glam::Vec2;
use rayon::prelude::*;

use crate::backend::{Backend, BackendError, Breeding, Episode, Group, Held, Weights};
use crate::config::{Config, Learning};
use crate::credit::Credit;
use crate::evolve::{self, Key, Purpose};
pub use crate::record::checkpoint::Snapshot;
pub use crate::record::metrics::Row;
use crate::world::World;

/// Trains any number of arms (one experiment each) side by side.
pub struct Trainer {
    arms: Vec<Arm>,
    generation: usize,
    level: Level,
    times: Times,
}

/// Where the time of generations went.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Times {
    /// Forming teams and drawing starts.
    pub prepare: Duration,
    /// Rollouts with their scores.
    pub play: Duration,
    /// Fitness, rows and champions.
    pub conclude: Duration,
    /// Selection and mutation.
    pub breed: Duration,
}

/// One experiment and its trials.
struct Arm {
    config: Config,
    world: World,
    trials: Vec<Trial>,
    /// The generation of the populations that are about to play: behind the trainer's after they were lost with the
    /// device that held them, two past the last when all is done.
    age: usize,
    /// The generation of the weights on the host: an earlier one while a backend holds the populations.
    host_age: usize,
    /// The populations, one a trial, while a backend holds them.
    held: Vec<Box<dyn Held>>,
    /// Whether the populations were offered to a backend.
    offered: bool,
}

/// Why there is no snapshot.
#[derive(Debug, thiserror::Error)]
pub enum SnapshotError {
    #[error(transparent)]
    Memory(#[from] TryReserveError),
    /// The populations cannot be brought to the host.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// One trial's populations and the room its generations are worked out in.
///
/// A population has one slot more than policies: the last holds the champion of the generation before, which plays
/// along as one more team.
struct Trial {
    index: usize,
    /// `[leaders][policies + 1][parameters]`, this generation's and the next.
    weights: Vec<f32>,
    children: Vec<f32>,
    /// Policies of each team, `[leaders][policies]`, and as the backend wants them, `[policies + 1][leaders]`.
    orders: Vec<u32>,
    teams: Vec<u32>,
    /// Start positions, `[episodes][agents]`.
    starts: Vec<Vec<Vec2>>,
    /// POIs observed, `[episodes][policies + 1]`, and f32 scores as bits, `[episodes][policies + 1][leaders]`.
    observed: Vec<AtomicU32>,
    scores: Vec<AtomicU32>,
    /// Mean score of every policy, `[leaders][policies]`.
    fitness: Vec<f32>,
    /// The plan of the next generation, see [`evolve::draw_parents`], `[leaders][policies + 1]`.
    parents: Vec<u32>,
    /// The last generation's row, whose champion has yet to play.
    pending: Option<Row>,
}

impl Trainer {
    /// Fresh populations for every trial of every (valid) config.
    pub fn new(configs: Vec<Config>) -> Trainer {
        let level = Level::new();
        let arm = |config: Config| {
            let trials = 0..config.learning.trials;
            Arm::new(config, trials, level)
        };
        Trainer { arms: configs.into_iter().map(arm).collect(), generation: 0, level, times: Times::default() }
    }

    /// Fresh populations for one trial of a (valid) config; it comes to the rows that it comes to among the others.
    pub fn of_trial(config: Config, trial: usize) -> Trainer {
        let level = Level::new();
        Trainer { arms: vec![Arm::new(config, trial..trial + 1, level)], generation: 0, level, times: Times::default() }
    }

    /// The generation that plays next.
    pub fn generation(&self) -> usize {
        self.generation
    }

    /// Where the time of generations went since this was last asked.
    pub fn take_times(&mut self) -> Times {
        std::mem::take(&mut self.times)
    }

    /// Whether every arm has played its last generation, and the champions of that.
    pub fn is_done(&self) -> bool {
        self.arms.iter().all(Arm::is_done)
    }

    /// Plays one generation of every arm that has one left, scores, selects and mutates.
    ///
    /// Returns the rows that became complete, by arm, trial and generation: a generation's champion plays along with
    /// the next one, and alone after the last.
    ///
    /// A backend that wants to may hold the populations. Those that are lost with it are made again, by playing on from
    /// where they were last on the host.
    ///
    /// # Errors
    /// When the backend fails; the trainer then still stands before this generation.
    pub fn advance(&mut self, backend: &mut dyn Backend) -> Result<Vec<Row>, BackendError> {
        // Once inside the thread pool, for a small generation is over sooner than a thread is woken.
        rayon::scope(|_| match self.catch_up(backend) {
            // A device may have room for the populations or for the episodes, but not for both.
            Err(_) if self.bring_home() => self.catch_up(backend),
            played => played,
        })
    }

    /// Plays every arm from where its populations are to the end of this generation; gives the rows of that alone, since
    /// all before were given when those generations first played.
    fn catch_up(&mut self, backend: &mut dyn Backend) -> Result<Vec<Row>, BackendError> {
        let behind = |arms: &[Arm]| arms.iter().filter(|arm| !arm.is_done()).map(|arm| arm.age).min();
        while let Some(age) = behind(&self.arms).filter(|&age| age < self.generation) {
            self.play_generation(age, backend)?;
        }
        let rows = self.play_generation(self.generation, backend)?;
        self.generation += 1;
        Ok(rows)
    }

    /// Takes all populations back from the backend that failed; false where there were none or they are lost.
    fn bring_home(&mut self) -> bool {
        let held = |arm: &&mut Arm| !arm.held.is_empty();
        let home: Vec<bool> = self.arms.iter_mut().filter(held).map(|arm| arm.release().is_ok()).collect();
        !home.is_empty() && home.iter().all(|&home| home)
    }

    fn play_generation(&mut self, generation: usize, backend: &mut dyn Backend) -> Result<Vec<Row>, BackendError> {
        let level = self.level;
        let playing = self.arms.iter_mut().enumerate().filter(|(_, arm)| arm.age == generation && !arm.is_done());
        let mut playing: Vec<(usize, &mut Arm)> = playing.collect();

        let start = Instant::now();
        playing.iter_mut().try_for_each(|(_, arm)| arm.offer(backend))?;
        playing.par_iter_mut().for_each(|(_, arm)| arm.prepare(generation, level));
        let prepared = Instant::now();
        play(backend, &playing, |arm| {
            let population = arm.config.learning.population;
            let first = if generation > arm.last() { population } else { 0 };
            // The first generation has no champion before it.
            first..population + usize::from(generation > 0)
        })?;
        let mut over = playing.iter_mut().filter(|(_, arm)| generation > arm.last());
        over.try_for_each(|(_, arm)| arm.fetch())?;
        let played = Instant::now();
        let conclude = |(index, arm): &mut (usize, &mut Arm)| match generation > arm.last() {
            true => arm.finish(),
            false => arm.conclude(*index, generation),
        };
        let mut rows = playing.par_iter_mut().flat_map_iter(conclude).collect::<Vec<_>>();
        let concluded = Instant::now();
        playing.retain(|(_, arm)| generation <= arm.last());
        playing.par_iter_mut().for_each(|(_, arm)| arm.breed(generation, level));
        rows.sort_by_key(|row| (row.arm, row.trial, row.generation));
        self.times.prepare += prepared - start;
        self.times.play += played - prepared;
        self.times.conclude += concluded - played;
        self.times.breed += concluded.elapsed();
        Ok(rows)
    }

    /// The policies of the last generation of an arm that has played it, best first in each population, one
    /// `[leaders][policies][parameters]` a trial.
    pub fn policies(&self, arm: usize) -> Vec<Vec<f32>> {
        let arm = &self.arms[arm];
        let sort = |trial: &Trial| {
            let mut policies = vec![0.0; arm.world.leaders() * arm.config.learning.population * arm.world.parameters()];
            arm.sort(&trial.weights, &trial.fitness, &mut policies);
            policies
        };
        arm.trials.iter().map(sort).collect()
    }

    /// [`Trainer::policies`], in the room of the next generation.
    pub fn best_policies(&mut self, arm: usize) -> Vec<&[f32]> {
        let arm = &mut self.arms[arm];
        let count = arm.world.leaders() * arm.config.learning.population * arm.world.parameters();
        for index in 0..arm.trials.len() {
            let mut policies = std::mem::take(&mut arm.trials[index].children);
            arm.sort(&arm.trials[index].weights, &arm.trials[index].fitness, &mut policies[..count]);
            arm.trials[index].children = policies;
        }
        arm.trials.iter().map(|trial| &trial.children[..count]).collect()
    }

    /// The populations of a trial about to play, `[leaders][policies + 1][parameters]`; a population's last slot is
    /// the champion's of the generation before.
    ///
    /// # Errors
    /// The backend that holds them does not give them back.
    pub fn weights(&mut self, arm: usize, trial: usize) -> Result<&[f32], BackendError> {
        let arm = &mut self.arms[arm];
        arm.stand_at(self.generation)?;
        Ok(&arm.trials[trial].weights)
    }

    /// The world that an arm trains in.
    pub fn world(&self, arm: usize) -> &World {
        &self.arms[arm].world
    }

    /// What [`Trainer::restore`] needs, where it lies.
    ///
    /// # Errors
    /// The backend that holds the populations does not give them back.
    pub fn view(&mut self) -> Result<Snapshot<&[f32]>, BackendError> {
        self.arms.iter_mut().try_for_each(|arm| arm.stand_at(self.generation))?;
        let each = |numbers: fn(&Trial) -> &[f32]| {
            self.arms.iter().map(|arm| arm.trials.iter().map(numbers).collect()).collect()
        };
        Ok(Snapshot {
            generation: self.generation,
            weights: each(|trial| &trial.weights),
            fitness: each(|trial| &trial.fitness),
            pending: self.arms.iter().map(|arm| arm.trials.iter().map(|trial| trial.pending).collect()).collect(),
        })
    }

    /// What [`Trainer::restore`] needs, in memory of its own.
    ///
    /// # Errors
    /// There is not so much memory, or the backend that holds the populations does not give them back.
    pub fn snapshot(&mut self) -> Result<Snapshot, SnapshotError> {
        let copy = |numbers: &[f32]| {
            let mut copy = Vec::new();
            copy.try_reserve_exact(numbers.len())?;
            copy.extend_from_slice(numbers);
            Ok(copy)
        };
        let each = |arms: Vec<Vec<&[f32]>>| -> Result<Vec<Vec<_>>, TryReserveError> {
            arms.into_iter().map(|trials| trials.into_iter().map(copy).collect()).collect()
        };
        let Snapshot { generation, weights, fitness, pending } = self.view()?;
        Ok(Snapshot { generation, weights: each(weights)?, fitness: each(fitness)?, pending })
    }

    /// Goes on from a snapshot of a trainer of the same configs; false where its sizes do not fit them.
    #[must_use]
    pub fn restore(&mut self, snapshot: Snapshot) -> bool {
        let Snapshot { generation, weights, fitness, pending } = snapshot;
        let counts = [weights.len(), fitness.len(), pending.len()];
        let fits = |trial: &Trial, weights: &Vec<f32>, fitness: &Vec<f32>| {
            trial.weights.len() == weights.len() && trial.fitness.len() == fitness.len()
        };
        let fits = counts == [self.arms.len(); 3]
            && self.arms.iter().zip(&weights).zip(&fitness).zip(&pending).all(
                |(((arm, weights), fitness), pending)| {
                    let counts = [weights.len(), fitness.len(), pending.len()];
                    counts == [arm.trials.len(); 3]
                        && arm.trials.iter().zip(weights).zip(fitness).all(|((trial, w), f)| fits(trial, w, f))
                },
            );
        if fits {
            self.generation = generation;
            for arm in &mut self.arms {
                arm.held.clear();
                arm.age = generation.min(arm.last() + 2);
                arm.host_age = arm.age;
                arm.offered = false;
            }
            let trials = self.arms.iter_mut().flat_map(|arm| &mut arm.trials);
            let saved =
                weights.into_iter().flatten().zip(fitness.into_iter().flatten()).zip(pending.into_iter().flatten());
            for (trial, ((weights, fitness), pending)) in trials.zip(saved) {
                (trial.weights, trial.fitness, trial.pending) = (weights, fitness, pending);
            }
        }
        fits
    }
}

/// Plays a range of the teams of every trial, given the population, all as one batch; keeps what they scored.
fn play(
    backend: &mut dyn Backend,
    arms: &[(usize, &mut Arm)],
    range: impl Fn(&Arm) -> Range<usize>,
) -> Result<(), BackendError> {
    thread_local! { static CREDIT: RefCell<(Credit, Vec<f32>)> = RefCell::default(); }
    let mut groups = Vec::new();
    let mut places = Vec::new();
    for (_, arm) in arms {
        let (population, leaders) = (arm.config.learning.population, arm.world.leaders());
        let range = range(arm);
        for (index, trial) in arm.trials.iter().enumerate() {
            let weights = arm.held.get(index).map_or(trial.weights[..].into(), |held| Weights::Held(&**held));
            let teams = &trial.teams[range.start * leaders..range.end * leaders];
            for (episode, starts) in trial.starts.iter().enumerate() {
                groups.push(Group { world: &arm.world, starts, weights, policies: population + 1, teams });
                places.push((&**arm, trial, episode * (population + 1) + range.start));
            }
        }
    }
    backend.rollout(&groups, &|episode: Episode<'_>| {
        let (arm, trial, first) = places[episode.group];
        let (team, leaders) = (first + episode.team, arm.world.leaders());
        CREDIT.with_borrow_mut(|(credit, scores)| {
            scores.resize(leaders, 0.0);
            let observed = credit.score(&episode, &arm.world, arm.config.learning.fitness, scores);
            trial.observed[team].store(observed, Relaxed);
            for (to, score) in trial.scores[team * leaders..].iter().zip(&*scores) {
                to.store(score.to_bits(), Relaxed);
            }
        });
    })
}

impl Arm {
    fn new(config: Config, trials: Range<usize>, level: Level) -> Arm {
        let world = World::new(&config);
        let trials = trials.into_par_iter().map(|index| Trial::new(&config, &world, index, level));
        Arm { trials: trials.collect(), world, config, age: 0, host_age: 0, held: vec![], offered: false }
    }

    /// The last generation.
    fn last(&self) -> usize {
        self.config.learning.generations
    }

    /// Whether its last champions have played.
    fn is_done(&self) -> bool {
        self.age > self.last() + 1
    }

    /// Offers the populations to a backend, once: it takes those of all trials or none.
    fn offer(&mut self, backend: &mut dyn Backend) -> Result<(), BackendError> {
        if std::mem::replace(&mut self.offered, true) {
            return Ok(());
        }
        let sizes = [self.world.leaders(), self.config.learning.population + 1, self.world.parameters()];
        let held: Option<Vec<_>> =
            self.trials.iter().map(|trial| backend.hold(&trial.weights, sizes).transpose()).collect::<Option<_>>();
        self.held = held.map_or(Ok(vec![]), |held| held.into_iter().collect())?;
        Ok(())
    }

    /// Brings the host's weights up to date, all of them or none.
    fn fetch(&mut self) -> Result<(), BackendError> {
        if self.host_age == self.age {
            return Ok(());
        }
        for (held, trial) in self.held.iter().zip(&mut self.trials) {
            held.fetch(&mut trial.children)?;
        }
        for Trial { weights, children, .. } in &mut self.trials {
            std::mem::swap(weights, children);
        }
        self.host_age = self.age;
        Ok(())
    }

    /// Takes the populations back from the backend, or what the host has of them.
    fn release(&mut self) -> Result<(), BackendError> {
        let fetched = self.fetch();
        self.let_go();
        fetched
    }

    /// Leaves what the host has as all there is.
    fn let_go(&mut self) {
        self.held.clear();
        self.age = self.host_age;
    }

    /// Sees to it that the host's weights are those of the trainer's generation.
    fn stand_at(&mut self, generation: usize) -> Result<(), BackendError> {
        if !self.is_done() && self.age < generation {
            return Err(BackendError::Gone);
        }
        let fetched = self.fetch();
        if fetched.is_err() {
            self.let_go();
        }
        fetched
    }

    /// Forms the teams of a generation and draws its starts.
    fn prepare(&mut self, generation: usize, level: Level) {
        let Arm { config, world, trials, .. } = self;
        let Learning { seed, population, start_jitter, .. } = config.learning;
        let leaders = world.leaders();
        trials.par_iter_mut().for_each(|trial| {
            let key = Key::new(seed, trial.index, Purpose::Teams);
            let orders = trial.orders.par_chunks_exact_mut(population).with_min_len(few(population)).enumerate();
            orders.for_each(|(leader, order)| evolve::shuffle(level, key, generation, leader, order));
            let orders = &trial.orders;
            let teams = trial.teams[..population * leaders].par_chunks_exact_mut(leaders).with_min_len(CHUNK);
            teams.enumerate().for_each(|(team, policies)| {
                for (policy, order) in policies.iter_mut().zip(orders.chunks_exact(population)) {
                    *policy = order[team];
                }
            });
            let key = Key::new(seed, trial.index, Purpose::Starts);
            for (episode, starts) in trial.starts.iter_mut().enumerate() {
                evolve::jitter_starts(key, generation, episode, world, start_jitter, starts);
            }
        });
    }

    /// Turns what was observed into fitness and rows.
    fn conclude(&mut self, arm: usize, generation: usize) -> Vec<Row> {
        let Arm { config, world, trials, .. } = self;
        let population = config.learning.population;
        let mut rows = Vec::with_capacity(trials.len());
        for trial in trials {
            let [best_g, mean_g, champion_g] = trial.summary(world.pois.len(), population);
            rows.extend(trial.pending.map(|row| Row { champion_g, ..row }));
            trial.pending = Some(Row { arm, trial: trial.index, generation, best_g, mean_g, champion_g: 0.0 });
            trial.rate(world.leaders(), population);
        }
        rows
    }

    /// Completes the last generation's rows, whose champions have just played.
    fn finish(&mut self) -> Vec<Row> {
        let (pois, population) = (self.world.pois.len(), self.config.learning.population);
        let row = |trial: &mut Trial| {
            let [_, _, champion_g] = trial.summary(pois, population);
            trial.pending.take().map(|row| Row { champion_g, ..row })
        };
        let rows = self.trials.iter_mut().filter_map(row).collect();
        self.held.clear();
        self.age += 1;
        self.host_age = self.age;
        rows
    }

    /// Makes the next generation: plans which policy each slot comes from and whether it mutates, and carries that out.
    /// After the last, policies stay, and the champion plays.
    fn breed(&mut self, generation: usize, level: Level) {
        thread_local! { static SCRATCH: RefCell<Vec<u32>> = const { RefCell::new(Vec::new()) }; }
        let last = generation == self.last();
        let Arm { config, world, trials, held, .. } = self;
        let Learning { seed, population, elites, .. } = config.learning;
        let draw_parents = |key: Key, leader: usize, fitness: &[f32], parents: &mut [u32]| match last {
            true => evolve::keep_parents(fitness, parents),
            false => evolve::draw_parents(level, key, generation, leader, elites, fitness, parents),
        };
        self.age += 1;
        if !held.is_empty() {
            trials.par_iter_mut().for_each(|trial| {
                let key = Key::new(seed, trial.index, Purpose::Tournament);
                let plans = trial.parents.par_chunks_exact_mut(population + 1);
                plans.zip(trial.fitness.par_chunks_exact(population)).enumerate().for_each(
                    |(leader, (parents, fitness))| {
                        draw_parents(key, leader, fitness, parents);
                    },
                );
            });
            let mut pairs = held.iter_mut().zip(trials);
            let bred = pairs.try_for_each(|(held, trial)| {
                let key = Key::new(seed, trial.index, Purpose::Mutation);
                held.breed(&Breeding { parents: &trial.parents, key, generation, learning: &config.learning })
            });
            if bred.is_err() {
                // This generation is told by now: the next makes up for the loss, or fails.
                self.let_go();
            }
            return;
        }
        self.host_age = self.age;
        let parameters = world.parameters();
        let stride = (population + 1) * parameters;
        trials.par_iter_mut().for_each(|trial| {
            let tournaments = Key::new(seed, trial.index, Purpose::Tournament);
            let key = Key::new(seed, trial.index, Purpose::Mutation);
            let Trial { weights, children, parents, fitness, .. } = trial;
            let plans = fitness.par_chunks_exact(population).zip(parents.par_chunks_exact_mut(population + 1));
            let populations = weights.par_chunks_exact(stride).zip(children.par_chunks_exact_mut(stride));
            plans.zip(populations).enumerate().for_each(|(leader, ((fitness, parents), (policies, children)))| {
                draw_parents(tournaments, leader, fitness, parents);
                let broods = parents.par_chunks(BROOD).zip(children.par_chunks_mut(BROOD * parameters));
                // Small shares, so that no thread is left with a long one at the end.
                broods.with_max_len(4).enumerate().for_each(|(index, (parents, children))| {
                    let first = index * BROOD;
                    let brood = evolve::Brood { key, generation, population: leader, first, parents, policies };
                    SCRATCH.with_borrow_mut(|scratch| {
                        evolve::breed(level, &config.learning, brood, children, scratch);
                    });
                });
            });
            std::mem::swap(weights, &mut trial.children);
        });
    }

    /// Copies policies, without the champions' slots, best first in each population.
    fn sort(&self, weights: &[f32], fitness: &[f32], policies: &mut [f32]) {
        let (population, parameters) = (self.config.learning.population, self.world.parameters());
        let populations = weights.par_chunks_exact((population + 1) * parameters);
        let sorted = policies.par_chunks_exact_mut(population * parameters);
        populations.zip(fitness.par_chunks_exact(population)).zip(sorted).for_each(|((weights, fitness), sorted)| {
            let best = evolve::best(fitness, population);
            for (policy, index) in sorted.chunks_exact_mut(parameters).zip(best) {
                policy.copy_from_slice(&weights[index * parameters..(index + 1) * parameters]);
            }
        });
    }
}

impl Trial {
    fn new(config: &Config, world: &World, index: usize, level: Level) -> Trial {
        let Learning { seed, population, episodes_per_team, .. } = config.learning;
        let (leaders, parameters) = (world.leaders(), world.parameters());
        let key = Key::new(seed, index, Purpose::Weights);
        let mut weights = vec![0.0; leaders * (population + 1) * parameters];
        weights.par_chunks_exact_mut((population + 1) * parameters).enumerate().for_each(|(leader, policies)| {
            policies[..population * parameters]
                .par_chunks_exact_mut(parameters)
                .with_min_len(64)
                .enumerate()
                .for_each(|(slot, policy)| evolve::random_policy(level, key.at(0, leader, slot), policy));
        });
        let slots = episodes_per_team * (population + 1);
        Trial {
            index,
            children: vec![0.0; weights.len()],
            weights,
            orders: vec![0; leaders * population],
            // The champion's team, the last, is made of every population's last slot.
            teams: vec![population as u32; (population + 1) * leaders],
            starts: vec![Vec::new(); episodes_per_team],
            observed: std::iter::repeat_with(AtomicU32::default).take(slots).collect(),
            scores: std::iter::repeat_with(AtomicU32::default).take(slots * leaders).collect(),
            fitness: vec![0.0; leaders * population],
            parents: vec![0; leaders * (population + 1)],
            pending: None,
        }
    }

    /// G of the best team, of the mean team and of the champion's team.
    fn summary(&self, pois: usize, population: usize) -> [f64; 3] {
        let episodes = self.starts.len();
        let observed = |team: usize| -> u64 {
            (0..episodes).map(|episode| u64::from(self.observed[episode * (population + 1) + team].load(Relaxed))).sum()
        };
        let whole = (pois * episodes) as f64;
        let best = (0..population).map(observed).max().unwrap_or(0);
        let total: u64 = (0..population).map(observed).sum();
        [best as f64 / whole, total as f64 / (whole * population as f64), observed(population) as f64 / whole]
    }

    /// Hands each team's scores, averaged over its episodes, back to its policies.
    fn rate(&mut self, leaders: usize, population: usize) {
        let episodes = self.starts.len();
        let Trial { orders, scores, fitness, .. } = self;
        let populations = fitness.par_chunks_exact_mut(population).zip(orders.par_chunks_exact(population));
        populations.with_min_len(few(population)).enumerate().for_each(|(leader, (fitness, order))| {
            for (team, &policy) in order.iter().enumerate() {
                let score = |episode: usize| {
                    let at = (episode * (population + 1) + team) * leaders + leader;
                    f64::from(f32::from_bits(scores[at].load(Relaxed)))
                };
                let total: f64 = (0..episodes).map(score).sum();
                fitness[policy as usize] = (total / episodes as f64) as f32;
            }
        });
    }
}

/// Slots that one thread fills at a time.
const BROOD: usize = 64;
/// Policies of whom a thread does something short, at least: it has to be worth waking another.
const CHUNK: usize = 2048;

/// Populations that make a [`CHUNK`].
fn few(population: usize) -> usize {
    CHUNK.div_ceil(population)
}
