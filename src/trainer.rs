//! The generation loop: all trials of all arms advance together, one batch a generation, each arm at its own age.

use std::cell::RefCell;
use std::collections::TryReserveError;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::time::Duration;

use fearless_simd::Level;
use glam::Vec2;

use crate::backend::{Backend, BackendError, Episode, Group, Held, Need, Weights};
use crate::config::{Config, Learning, Sharing};
use crate::credit::Credit;
use crate::evolve::{self, Breeding, Key, Purpose, Selection};
use crate::host::Instant;
use crate::parallel::*;
use crate::world::World;

/// Trains any number of arms (one experiment each) side by side.
pub struct Trainer {
    arms: Vec<Arm>,
    level: Level,
    times: Times,
    setback: Option<BackendError>,
}

/// What one generation of one trial came to; every G is in 0..1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Whose it is, by place among the trainer's; 0 of a run alone.
    pub arm: usize,
    /// From 0.
    pub trial: usize,
    /// From 0, the random start.
    pub generation: usize,
    /// The best team of the generation.
    pub best_g: f64,
    /// The mean over the generation's teams.
    pub mean_g: f64,
    /// The team of every population's best policy.
    pub champion_g: f64,
}

/// What an arm needs to go on from where it was: the populations about to play, and each trial's unfinished row.
///
/// Its numbers are its own, or (`N` a slice) a trainer's.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot<N = Vec<f32>> {
    /// The generation that plays next.
    pub generation: usize,
    /// The run's last generation, after which policies stay as they are.
    pub last: usize,
    /// A trial's weights, `[populations][policies + 1][parameters]`, see [`Config::populations`].
    pub weights: Vec<N>,
    /// A trial's scores of the generation before, `[populations][policies]`.
    pub fitness: Vec<N>,
    /// A trial's row of the generation before.
    pub pending: Vec<Option<Row>>,
}

/// Where the time of generations went.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Times {
    /// Forming teams and drawing starts, where that was not done while others played.
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
    /// Those of the stage that plays.
    config: Config,
    world: World,
    /// All stages, each with its first generation, and which of them plays.
    stages: Vec<(usize, Config, World)>,
    stage: usize,
    /// The stage whose champions play beside the first generation of this one.
    leaving: Option<usize>,
    trials: Vec<Lineage>,
    /// Who plays this generation, one a trial, and the next: drawn meanwhile where a backend holds the populations.
    lineups: Vec<Lineup>,
    next: Vec<Lineup>,
    /// The generation that plays next, two past the last when all is done.
    generation: usize,
    /// The generation of the populations that are about to play: an earlier one after they were lost with the device
    /// that held them.
    age: usize,
    /// The generation of the weights on the host: an earlier one while a backend holds the populations.
    host_age: usize,
    /// The populations, one a trial, while a backend holds them.
    held: Vec<Box<dyn Held>>,
    /// Whether the populations were offered to a backend.
    offered: bool,
}

/// What an arm came to: the policies of each trial, and the rest of the snapshot.
pub type End<'a> = (Vec<&'a [f32]>, Snapshot<&'a [f32]>);

/// Why there is no snapshot.
#[derive(Debug, thiserror::Error)]
pub enum SnapshotError {
    /// The system gives no memory for it.
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
struct Lineage {
    index: usize,
    /// `[populations][policies + 1][parameters]`, this generation's and the next.
    weights: Vec<f32>,
    children: Vec<f32>,
    /// POIs observed, `[episodes][policies + 1]`, and f32 scores as bits, `[episodes][policies + 1][leaders]`.
    observed: Vec<AtomicU32>,
    scores: Vec<AtomicU32>,
    /// Mean score of every policy, `[populations][policies]`.
    fitness: Vec<f32>,
    /// The plan of the next generation, see [`evolve::draw_parents`], `[populations][policies + 1]`.
    parents: Vec<u32>,
    /// The last generation's row, whose champion has yet to play.
    pending: Option<Row>,
}

/// Who plays with whom in one generation of a trial, and from where; drawn by counters alone, whatever came out before.
struct Lineup {
    /// The generation and its stage, which is another where a run ends before it begins; none before the first is drawn.
    of: Option<[usize; 2]>,
    /// Policies of each team, `[populations][policies]`, and as the backend wants them, `[policies + 1][leaders]`.
    orders: Vec<u32>,
    teams: Vec<u32>,
    /// Start positions, and where POIs are if they move, `[episodes][agents + pois]`.
    starts: Vec<Vec<Vec2>>,
    /// Likewise of the champions of the stage before, where one ends.
    farewell: Vec<Vec<Vec2>>,
}

impl Trainer {
    /// Fresh populations for every trial of every (valid) config.
    pub fn new(configs: Vec<Config>) -> Trainer {
        let level = Level::new();
        let arm = |config: Config| {
            let trials = 0..config.learning.trials;
            Arm::new(config, trials, level)
        };
        Trainer { arms: configs.into_iter().map(arm).collect(), level, times: Times::default(), setback: None }
    }

    /// Fresh populations for one trial of a (valid) config; it comes to the rows that it comes to among the others.
    pub fn of_trial(config: Config, trial: usize) -> Trainer {
        let level = Level::new();
        let arms = vec![Arm::new(config, trial..trial + 1, level)];
        Trainer { arms, level, times: Times::default(), setback: None }
    }

    /// The generation that an arm plays next, two past its last when it is done.
    pub fn generation(&self, arm: usize) -> usize {
        self.arms[arm].generation
    }

    /// Makes the generation that an arm plays next its last, or leaves it at an earlier one; gives the last. What comes
    /// out is what a config of so many generations comes to.
    pub fn end(&mut self, arm: usize) -> usize {
        let Arm { config, generation, .. } = &mut self.arms[arm];
        config.learning.generations = config.learning.generations.min(*generation);
        config.learning.generations
    }

    /// The error of a backend that held populations and that was made up for since this was last asked: the populations
    /// are on the host from then on.
    pub fn take_setback(&mut self) -> Option<BackendError> {
        self.setback.take()
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
        scope(|_| match self.catch_up(backend) {
            // A device may have room for the populations or for the episodes, but not for both.
            Err(error) if self.bring_home() => {
                let rows = self.catch_up(backend)?;
                self.setback = Some(error);
                Ok(rows)
            }
            played => played,
        })
    }

    /// Plays every generation that is left; gives all rows, as [`Trainer::advance`] does.
    ///
    /// # Errors
    /// When the backend fails; the trainer then stands before that generation, and the rows before it are lost.
    pub fn finish(&mut self, backend: &mut dyn Backend) -> Result<Vec<Row>, BackendError> {
        let mut rows = Vec::new();
        while !self.is_done() {
            rows.extend(self.advance(backend)?);
        }
        Ok(rows)
    }

    /// Plays every arm from where its populations are to the end of its next generation; gives the rows of that alone,
    /// since all before were given when those generations first played.
    fn catch_up(&mut self, backend: &mut dyn Backend) -> Result<Vec<Row>, BackendError> {
        while self.arms.iter().any(Arm::is_behind) {
            self.play_generation(Arm::is_behind, backend)?;
        }
        let rows = self.play_generation(|arm| !arm.is_done(), backend)?;
        self.arms.iter_mut().filter(|arm| !arm.is_done()).for_each(|arm| arm.generation += 1);
        Ok(rows)
    }

    /// Takes all populations back from the backend that failed; false where there were none or they are lost.
    fn bring_home(&mut self) -> bool {
        let held = |arm: &&mut Arm| !arm.held.is_empty();
        let home: Vec<bool> = self.arms.iter_mut().filter(held).map(|arm| arm.release().is_ok()).collect();
        !home.is_empty() && home.iter().all(|&home| home)
    }

    /// Plays the generation that is at hand of some arms.
    fn play_generation(
        &mut self,
        plays: impl Fn(&Arm) -> bool,
        backend: &mut dyn Backend,
    ) -> Result<Vec<Row>, BackendError> {
        let level = self.level;
        let playing = self.arms.iter_mut().enumerate().filter(|(_, arm)| plays(arm));
        let mut playing: Vec<(usize, &mut Arm)> = playing.collect();

        let start = Instant::now();
        playing.iter_mut().try_for_each(|(_, arm)| arm.offer(backend))?;
        playing.par_iter_mut().for_each(|(_, arm)| arm.prepare(level));
        let prepared = Instant::now();
        let mut next: Vec<Vec<Lineup>> = playing.iter_mut().map(|(_, arm)| std::mem::take(&mut arm.next)).collect();
        let (played, ()) = join(
            || {
                play(backend, &playing, |arm| {
                    let population = arm.config.learning.population;
                    let first = if arm.is_over() { population } else { 0 };
                    // The first generation has no champion before it.
                    first..population + usize::from(arm.age > 0)
                })
            },
            || {
                let held = next.iter_mut().zip(&playing).filter(|(_, (_, arm))| !arm.held.is_empty());
                held.for_each(|(next, (_, arm))| arm.draw_next(level, next));
            },
        );
        playing.iter_mut().zip(next).for_each(|((_, arm), next)| arm.next = next);
        played?;
        let mut over = playing.iter_mut().filter(|(_, arm)| arm.is_over());
        over.try_for_each(|(_, arm)| arm.fetch())?;
        let played = Instant::now();
        let conclude = |(index, arm): &mut (usize, &mut Arm)| match arm.is_over() {
            true => arm.finish(),
            false => arm.conclude(*index),
        };
        let mut rows = playing.par_iter_mut().flat_map_iter(conclude).collect::<Vec<_>>();
        let concluded = Instant::now();
        playing.retain(|(_, arm)| !arm.is_over());
        let setbacks: Vec<_> = playing.par_iter_mut().filter_map(|(_, arm)| arm.breed(level).err()).collect();
        self.setback = setbacks.into_iter().next().or(self.setback.take());
        rows.sort_by_key(|row| (row.arm, row.trial, row.generation));
        self.times.prepare += prepared - start;
        self.times.play += played - prepared;
        self.times.conclude += concluded - played;
        self.times.breed += concluded.elapsed();
        Ok(rows)
    }

    /// The policies of the last generation of an arm that has played it, best first in each population, one
    /// `[populations][policies][parameters]` a trial.
    pub fn policies(&self, arm: usize) -> Vec<Vec<f32>> {
        let arm = &self.arms[arm];
        let sort = |trial: &Lineage| {
            let mut policies = vec![0.0; arm.policies()];
            arm.sort(&trial.weights, &trial.fitness, &mut policies);
            policies
        };
        arm.trials.iter().map(sort).collect()
    }

    /// What came out of arms that are done: [`Trainer::policies`], in the room of the next generation, and the snapshot
    /// after the last generation, whose weights are left out since they are the same in another order.
    pub fn ends(&mut self, arms: &[usize]) -> Vec<End<'_>> {
        for &arm in arms {
            let arm = &mut self.arms[arm];
            for index in 0..arm.trials.len() {
                let mut policies = std::mem::take(&mut arm.trials[index].children);
                arm.sort(&arm.trials[index].weights, &arm.trials[index].fitness, &mut policies[..arm.policies()]);
                arm.trials[index].children = policies;
            }
        }
        let end = |&arm: &usize| {
            let arm = &self.arms[arm];
            let sorted = arm.trials.iter().map(|trial| &trial.children[..arm.policies()]).collect();
            (sorted, Snapshot { generation: arm.last() + 1, weights: vec![], ..arm.snapshot() })
        };
        arms.iter().map(end).collect()
    }

    /// The populations of a trial about to play, `[populations][policies + 1][parameters]`; a population's last slot is
    /// the champion's of the generation before.
    ///
    /// # Errors
    /// The backend that holds them does not give them back.
    pub fn weights(&mut self, arm: usize, trial: usize) -> Result<&[f32], BackendError> {
        let arm = &mut self.arms[arm];
        arm.stand()?;
        Ok(&arm.trials[trial].weights)
    }

    /// The world that an arm's next generation plays in.
    pub fn world(&self, arm: usize) -> &World {
        let arm = &self.arms[arm];
        &arm.stages[arm.stage_of(arm.generation.min(arm.last()))].2
    }

    /// What [`Trainer::restore`] needs of an arm, where it lies.
    ///
    /// # Errors
    /// The backend that holds the populations does not give them back.
    pub fn view(&mut self, arm: usize) -> Result<Snapshot<&[f32]>, BackendError> {
        let arm = &mut self.arms[arm];
        arm.stand()?;
        Ok(arm.snapshot())
    }

    /// What [`Trainer::restore`] needs of an arm, in memory of its own.
    ///
    /// # Errors
    /// There is not so much memory, or the backend that holds the populations does not give them back.
    pub fn snapshot(&mut self, arm: usize) -> Result<Snapshot, SnapshotError> {
        let copy = |numbers: &[f32]| {
            let mut copy = Vec::new();
            copy.try_reserve_exact(numbers.len())?;
            copy.extend_from_slice(numbers);
            Ok(copy)
        };
        let each = |trials: Vec<&[f32]>| -> Result<Vec<_>, TryReserveError> { trials.into_iter().map(copy).collect() };
        let Snapshot { generation, last, weights, fitness, pending } = self.view(arm)?;
        Ok(Snapshot { generation, last, weights: each(weights)?, fitness: each(fitness)?, pending })
    }

    /// Puts given policies, `[populations][policies][parameters]`, in the first slots of a trial's populations, in
    /// their order: as many as there is room for. The others stay as they were drawn. False where the arm has played
    /// already, or sizes do not fit.
    #[must_use]
    pub fn start_from(&mut self, arm: usize, trial: usize, policies: usize, weights: &[f32]) -> bool {
        let arm = &mut self.arms[arm];
        let (populations, parameters) = (arm.config.populations(), arm.world.parameters());
        let population = arm.config.learning.population;
        let Some(trial) = arm.trials.get_mut(trial) else { return false };
        if arm.generation > 0 || arm.offered || policies == 0 || weights.len() != populations * policies * parameters {
            return false;
        }
        let taken = policies.min(population) * parameters;
        let slots = trial.weights.chunks_exact_mut((population + 1) * parameters);
        for (slots, policies) in slots.zip(weights.chunks_exact(policies * parameters)) {
            slots[..taken].copy_from_slice(&policies[..taken]);
        }
        true
    }

    /// Goes on with an arm from a snapshot of an arm of the same config, but for its number of generations, which may
    /// have been smaller; false where the sizes do not fit.
    #[must_use]
    pub fn restore(&mut self, arm: usize, snapshot: Snapshot) -> bool {
        let (index, level, arm) = (arm, self.level, &mut self.arms[arm]);
        let Snapshot { generation, last, weights, fitness, pending } = snapshot;
        let counts = [weights.len(), fitness.len(), pending.len()];
        let fits = |((trial, weights), fitness): ((&Lineage, &Vec<f32>), &Vec<f32>)| {
            trial.weights.len() == weights.len() && trial.fitness.len() == fitness.len()
        };
        if counts != [arm.trials.len(); 3] || !arm.trials.iter().zip(&weights).zip(&fitness).all(fits) {
            return false;
        }
        arm.held.clear();
        arm.offered = false;
        for (trial, ((weights, fitness), pending)) in
            arm.trials.iter_mut().zip(weights.into_iter().zip(fitness).zip(pending))
        {
            (trial.weights, trial.fitness) = (weights, fitness);
            trial.pending = pending.map(|row| Row { arm: index, ..row });
        }
        arm.generation = generation.min(arm.last() + 2);
        (arm.age, arm.host_age) = (arm.generation, arm.generation);
        if generation == last + 1 && last < arm.last() {
            // There the policies stayed, here they have a next generation.
            (arm.age, arm.host_age) = (last, last);
            arm.enter();
            // Nobody holds them, so nobody can fail.
            let _ = arm.breed(level);
        }
        true
    }
}

/// Words that an episode of a trial takes in a batch, whoever plays it.
const EPISODE: u64 = 40;

/// Bytes that the trials of a (valid) config take, whoever plays their episodes: in the stage that takes most.
pub fn bytes(config: &Config) -> u64 {
    most_of_stages(config, bytes_of_stage) + farewell_bytes(config)
}

fn most_of_stages(config: &Config, bytes: fn(&Config) -> u64) -> u64 {
    config.staged().iter().map(|(_, config)| bytes(config)).max().unwrap_or(0)
}

fn bytes_of_stage(config: &Config) -> u64 {
    let ([trials, populations, policies, parameters], leaders) = (sizes(config), config.learners() as u64);
    let (slots, episodes) = (policies + 1, config.learning.episodes_per_team as u64);
    let weights = 2 * populations * slots * parameters;
    let fitness_and_parents = populations * (policies + slots);
    let observed_and_scores = episodes * slots * (1 + leaders);
    4 * trials * (weights + fitness_and_parents + observed_and_scores + episodes * EPISODE) + lineup_bytes(config)
}

/// Bytes of the next generation's line-ups, drawn beside those that play where a backend holds the populations.
pub fn next_bytes(config: &Config) -> u64 {
    most_of_stages(config, lineup_bytes) + farewell_bytes(config)
}

/// Bytes of where a stage's last champions start, beside where the next stage's teams do.
fn farewell_bytes(config: &Config) -> u64 {
    if config.stages.is_empty() { 0 } else { most_of_stages(config, start_bytes) }
}

fn lineup_bytes(config: &Config) -> u64 {
    let ([trials, populations, policies, _], leaders) = (sizes(config), config.learners() as u64);
    4 * trials * (populations * policies + leaders * (policies + 1)) + start_bytes(config)
}

fn start_bytes(config: &Config) -> u64 {
    let agents = (config.world.leaders.len() + config.world.followers.len()) as u64;
    let moved = if config.learning.poi_jitter > 0.0 { config.world.pois.len() as u64 } else { 0 };
    4 * config.learning.trials as u64 * config.learning.episodes_per_team as u64 * 2 * (agents + moved)
}

/// Bytes of the numbers of a [`Snapshot`] of a (valid) config's arm.
pub fn snapshot_bytes(config: &Config) -> u64 {
    let [trials, populations, policies, parameters] = sizes(config);
    4 * trials * populations * ((policies + 1) * parameters + policies)
}

/// `[trials, populations, policies, parameters]`
fn sizes(config: &Config) -> [u64; 4] {
    let learning = &config.learning;
    [learning.trials, config.populations(), learning.population, config.parameters()].map(|count| count as u64)
}

/// Plays a range of the teams of every trial, given the population, all as one batch; keeps what they scored.
fn play<'a>(
    backend: &mut dyn Backend,
    arms: &'a [(usize, &'a mut Arm)],
    range: impl Fn(&Arm) -> Range<usize>,
) -> Result<(), BackendError> {
    thread_local! { static CREDIT: RefCell<(Credit, Vec<f32>)> = RefCell::default(); }
    let mut groups = Vec::new();
    let mut places = Vec::new();
    for (_, arm) in arms {
        let (population, leaders) = (arm.config.learning.population, arm.world.leaders());
        let range = range(arm);
        for (index, (trial, lineup)) in arm.trials.iter().zip(&arm.lineups).enumerate() {
            let weights = arm.held.get(index).map_or(trial.weights[..].into(), |held| Weights::Held(&**held));
            let mut cast = |world, fitness, starts: &'a [Vec<Vec2>], range: Range<usize>| {
                let (teams, need) = (&lineup.teams[range.start * leaders..range.end * leaders], Need::Score(fitness));
                for (episode, starts) in starts.iter().enumerate() {
                    groups.push(Group { world, starts, weights, policies: population + 1, teams, need });
                    places.push((world, fitness, trial, episode * (population + 1) + range.start));
                }
            };
            // Champions play in their own stage.
            let end = if arm.leaving.is_some() { population } else { range.end };
            cast(&arm.world, arm.config.learning.fitness, &lineup.starts, range.start..end);
            if let Some((_, config, world)) = arm.leaving.map(|stage| &arm.stages[stage]) {
                cast(world, config.learning.fitness, &lineup.farewell, population..population + 1);
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

impl Arm {
    fn new(config: Config, trials: Range<usize>, level: Level) -> Arm {
        let stages = config.staged().into_iter().map(|(from, config)| {
            let world = World::new(&config);
            (from, config, world)
        });
        let stages: Vec<_> = stages.collect();
        let most = stages.iter().map(|(_, config, _)| config.learning.episodes_per_team).max().unwrap_or(1);
        let (_, config, world) = stages[0].clone();
        let lineup = || Lineup::new(config.learning.population, config.populations(), world.leaders());
        let lineups = std::iter::repeat_with(lineup).take(trials.len()).collect();
        let trials = trials.into_par_iter().map(|index| Lineage::new(&config, &world, most, index, level));
        Arm {
            trials: trials.collect(),
            lineups,
            next: vec![],
            world,
            config,
            stages,
            stage: 0,
            leaving: None,
            generation: 0,
            age: 0,
            host_age: 0,
            held: vec![],
            offered: false,
        }
    }

    /// The stage of a generation.
    fn stage_of(&self, generation: usize) -> usize {
        self.stages.iter().rposition(|stage| stage.0 <= generation).unwrap_or(0)
    }

    /// The stage that a generation plays in, and the one that ends with the generation before it.
    fn stages_of(&self, generation: usize) -> (usize, Option<usize>) {
        let stage = self.stage_of(generation.min(self.last()));
        let before = if generation == 0 { stage } else { self.stage_of(generation - 1) };
        (stage, (before != stage).then_some(before))
    }

    /// Takes on the stage of the populations that are about to play.
    fn enter(&mut self) {
        let last = self.last();
        let (stage, leaving) = self.stages_of(self.age);
        if stage != self.stage {
            let (_, config, world) = self.stages[stage].clone();
            (self.config, self.world, self.stage) = (config, world, stage);
            // A run may end sooner than it was to.
            self.config.learning.generations = last;
        }
        self.leaving = leaving;
    }

    /// The last generation.
    fn last(&self) -> usize {
        self.config.learning.generations
    }

    /// Whether its last champions have played.
    fn is_done(&self) -> bool {
        self.generation > self.last() + 1
    }

    /// Whether its populations are of a generation that was played already.
    fn is_behind(&self) -> bool {
        self.age < self.generation && !self.is_done()
    }

    /// Whether its populations are past the last generation, and only champions play.
    fn is_over(&self) -> bool {
        self.age > self.last()
    }

    /// Numbers in the policies of one trial.
    fn policies(&self) -> usize {
        self.config.populations() * self.config.learning.population * self.world.parameters()
    }

    /// What it is as far as the host knows.
    fn snapshot(&self) -> Snapshot<&[f32]> {
        Snapshot {
            generation: self.generation,
            last: self.last(),
            weights: self.trials.iter().map(|trial| &trial.weights[..]).collect(),
            fitness: self.trials.iter().map(|trial| &trial.fitness[..]).collect(),
            pending: self.trials.iter().map(|trial| trial.pending).collect(),
        }
    }

    /// Offers the populations to a backend, once: it takes those of all trials or none.
    fn offer(&mut self, backend: &mut dyn Backend) -> Result<(), BackendError> {
        if std::mem::replace(&mut self.offered, true) {
            return Ok(());
        }
        let sizes = [self.config.populations(), self.config.learning.population + 1, self.world.parameters()];
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
        for Lineage { weights, children, .. } in &mut self.trials {
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

    /// Sees to it that the host's weights are those of the generation that plays next.
    fn stand(&mut self) -> Result<(), BackendError> {
        if self.is_behind() {
            return Err(BackendError::Gone);
        }
        let fetched = self.fetch();
        if fetched.is_err() {
            self.let_go();
        }
        fetched
    }

    /// Takes on the stage and the line-ups of the generation that is about to play.
    fn prepare(&mut self, level: Level) {
        self.enter();
        if self.next.first().is_some_and(|next| next.of == Some([self.age, self.stage])) {
            std::mem::swap(&mut self.lineups, &mut self.next);
        }
        let mut lineups = std::mem::take(&mut self.lineups);
        self.draw(level, self.age, &mut lineups);
        self.lineups = lineups;
    }

    /// Draws the next generation's line-ups beside those of the one that plays.
    fn draw_next(&self, level: Level, next: &mut Vec<Lineup>) {
        if self.is_over() {
            return;
        }
        let [population, leaders] = [self.config.learning.population, self.world.leaders()];
        next.resize_with(self.trials.len(), || Lineup::new(population, self.config.populations(), leaders));
        self.draw(level, self.age + 1, next);
    }

    /// Draws the trials' line-ups of a generation, unless they are that already.
    fn draw(&self, level: Level, generation: usize, lineups: &mut [Lineup]) {
        let (stage, leaving) = self.stages_of(generation);
        let (_, config, world) = &self.stages[stage];
        let of = Some([generation, stage]);
        lineups.par_iter_mut().zip(&self.trials).filter(|(lineup, _)| lineup.of != of).for_each(|(lineup, trial)| {
            lineup.of = of;
            lineup.form(level, &config.learning, trial.index, generation);
            let places = |config: &Config, world: &World, episodes: &mut Vec<Vec<Vec2>>| {
                episodes.resize(config.learning.episodes_per_team, vec![]);
                for (episode, starts) in episodes.iter_mut().enumerate() {
                    evolve::places(&config.learning, trial.index, generation, episode, world, starts);
                }
            };
            places(config, world, &mut lineup.starts);
            match leaving.map(|stage| &self.stages[stage]) {
                Some((_, config, world)) => places(config, world, &mut lineup.farewell),
                None => lineup.farewell.clear(),
            }
        });
    }

    /// Turns what was observed into fitness and rows.
    fn conclude(&mut self, arm: usize) -> Vec<Row> {
        let Arm { config, world, stages, leaving, trials, lineups, age: generation, .. } = self;
        let generation = *generation;
        let population = config.learning.population;
        let pois_before = leaving.map_or(world.pois.len(), |stage| stages[stage].2.pois.len());
        let mut rows = Vec::with_capacity(trials.len());
        for (trial, lineup) in trials.iter_mut().zip(lineups) {
            let [best_g, mean_g] = trial.summary(lineup, world.pois.len(), population);
            let champion_g = trial.champion(lineup, pois_before, population);
            rows.extend(trial.pending.map(|row| Row { champion_g, ..row }));
            trial.pending = Some(Row { arm, trial: trial.index, generation, best_g, mean_g, champion_g: 0.0 });
            match config.learning.sharing {
                Sharing::None => trial.rate(lineup, world.leaders(), population),
                Sharing::All => trial.rate_shared(lineup, world.leaders(), population),
            }
        }
        rows
    }

    /// Completes the last generation's rows, whose champions have just played.
    fn finish(&mut self) -> Vec<Row> {
        let (pois, population) = (self.world.pois.len(), self.config.learning.population);
        let row = |(trial, lineup): (&Lineage, &Lineup)| {
            let champion_g = trial.champion(lineup, pois, population);
            trial.pending.map(|row| Row { champion_g, ..row })
        };
        let rows = self.trials.iter().zip(&self.lineups).filter_map(row).collect();
        self.held.clear();
        self.age += 1;
        self.host_age = self.age;
        rows
    }

    /// Makes the next generation: plans which policy each slot comes from and whether it mutates, and carries that out.
    /// After the last, policies stay, and the champion plays.
    ///
    /// # Errors
    /// The backend that holds the populations failed. This generation is told by now: the next makes up for the loss,
    /// or fails.
    fn breed(&mut self, level: Level) -> Result<(), BackendError> {
        thread_local! { static SCRATCH: RefCell<Vec<u32>> = const { RefCell::new(Vec::new()) }; }
        let generation = self.age;
        let last = generation == self.last();
        let Arm { config, world, trials, held, .. } = self;
        let Learning { seed, population, .. } = config.learning;
        let selection = Selection::of(&config.learning);
        let draw_parents = |key: Key, leader: usize, fitness: &[f32], parents: &mut [u32]| match last {
            true => evolve::keep_parents(fitness, parents),
            false => evolve::draw_parents(level, key, generation, leader, selection, fitness, parents),
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
                self.let_go();
            }
            return bred;
        }
        self.host_age = self.age;
        let parameters = world.parameters();
        let stride = (population + 1) * parameters;
        trials.par_iter_mut().for_each(|trial| {
            let tournaments = Key::new(seed, trial.index, Purpose::Tournament);
            let key = Key::new(seed, trial.index, Purpose::Mutation);
            let Lineage { weights, children, parents, fitness, .. } = trial;
            let plans = fitness.par_chunks_exact(population).zip(parents.par_chunks_exact_mut(population + 1));
            let populations = weights.par_chunks_exact(stride).zip(children.par_chunks_exact_mut(stride));
            plans.zip(populations).enumerate().for_each(|(leader, ((fitness, parents), (policies, children)))| {
                draw_parents(tournaments, leader, fitness, parents);
                let broods = parents.par_chunks(BROOD).zip(children.par_chunks_mut(BROOD * parameters));
                // Small shares, so that no thread is left with a long one at the end.
                broods.with_max_len(4).enumerate().for_each(|(index, (parents, children))| {
                    let first = index * BROOD;
                    let brood = evolve::Offspring { key, generation, population: leader, first, parents, policies };
                    SCRATCH.with_borrow_mut(|scratch| {
                        evolve::breed(level, &config.learning, brood, children, scratch);
                    });
                });
            });
            std::mem::swap(weights, &mut trial.children);
        });
        Ok(())
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

impl Lineup {
    /// Nobody's yet.
    fn new(population: usize, populations: usize, leaders: usize) -> Lineup {
        Lineup {
            of: None,
            orders: vec![0; populations * population],
            // The champion's team, the last, is made of every population's last slot.
            teams: evolve::one_policy_a_team(population + 1, leaders),
            starts: vec![],
            farewell: vec![],
        }
    }

    /// Forms the teams.
    fn form(&mut self, level: Level, learning: &Learning, trial: usize, generation: usize) {
        // Where all leaders share a policy, its team is the one that it has from the start.
        if learning.sharing == Sharing::All {
            return;
        }
        let population = learning.population;
        let key = Key::new(learning.seed, trial, Purpose::Teams);
        let orders = self.orders.par_chunks_exact_mut(population).with_min_len(few(population)).enumerate();
        orders.for_each(|(leader, order)| evolve::shuffle(level, key, generation, leader, order));
        let (orders, leaders) = (&self.orders, self.orders.len() / population);
        let teams = self.teams[..population * leaders].par_chunks_exact_mut(leaders).with_min_len(CHUNK);
        teams.enumerate().for_each(|(team, policies)| {
            for (policy, order) in policies.iter_mut().zip(orders.chunks_exact(population)) {
                *policy = order[team];
            }
        });
    }
}

impl Lineage {
    /// With room for so many episodes a team.
    fn new(config: &Config, world: &World, episodes: usize, index: usize, level: Level) -> Lineage {
        let Learning { seed, population, .. } = config.learning;
        let (leaders, populations, parameters) = (world.leaders(), config.populations(), world.parameters());
        let key = Key::new(seed, index, Purpose::Weights);
        let mut weights = vec![0.0; populations * (population + 1) * parameters];
        weights.par_chunks_exact_mut((population + 1) * parameters).enumerate().for_each(|(leader, policies)| {
            policies[..population * parameters]
                .par_chunks_exact_mut(parameters)
                .with_min_len(64)
                .enumerate()
                .for_each(|(slot, policy)| evolve::random_policy(level, key.at(0, leader, slot), policy));
        });
        let slots = episodes * (population + 1);
        Lineage {
            index,
            children: vec![0.0; weights.len()],
            weights,
            observed: std::iter::repeat_with(AtomicU32::default).take(slots).collect(),
            scores: std::iter::repeat_with(AtomicU32::default).take(slots * leaders).collect(),
            fitness: vec![0.0; populations * population],
            parents: vec![0; populations * (population + 1)],
            pending: None,
        }
    }

    /// G of the best team and of the mean team.
    fn summary(&self, lineup: &Lineup, pois: usize, population: usize) -> [f64; 2] {
        let episodes = lineup.starts.len();
        let observed = |team: usize| self.observed(team, episodes, population);
        let whole = (pois * episodes) as f64;
        let best = (0..population).map(observed).max().unwrap_or(0);
        let total: u64 = (0..population).map(observed).sum();
        [best as f64 / whole, total as f64 / (whole * population as f64)]
    }

    /// G of the champion's team, which may have played in the stage before.
    fn champion(&self, lineup: &Lineup, pois: usize, population: usize) -> f64 {
        let episodes = if lineup.farewell.is_empty() { &lineup.starts } else { &lineup.farewell }.len();
        self.observed(population, episodes, population) as f64 / (pois * episodes) as f64
    }

    /// POIs that a team observed in all episodes.
    fn observed(&self, team: usize, episodes: usize, population: usize) -> u64 {
        (0..episodes).map(|episode| u64::from(self.observed[episode * (population + 1) + team].load(Relaxed))).sum()
    }

    /// Hands each team's scores, averaged over its episodes, back to its policies.
    fn rate(&mut self, lineup: &Lineup, leaders: usize, population: usize) {
        let Lineup { orders, starts, .. } = lineup;
        let Lineage { scores, fitness, .. } = self;
        let episodes = starts.len();
        let populations = fitness.par_chunks_exact_mut(population).zip(orders.par_chunks_exact(population));
        populations.with_min_len(few(population)).enumerate().for_each(|(leader, (fitness, order))| {
            for (team, &policy) in order.iter().enumerate() {
                fitness[policy as usize] = mean_score(scores, episodes, population + 1, team, leaders, leader);
            }
        });
    }

    /// [`Lineage::rate`] where every leader of a team plays the same policy: its mean over them, in their order.
    fn rate_shared(&mut self, lineup: &Lineup, leaders: usize, population: usize) {
        let (episodes, scores) = (lineup.starts.len(), &self.scores);
        self.fitness.par_iter_mut().with_min_len(few(leaders)).enumerate().for_each(|(team, fitness)| {
            let score = |leader| f64::from(mean_score(scores, episodes, population + 1, team, leaders, leader));
            *fitness = ((0..leaders).map(score).sum::<f64>() / leaders as f64) as f32;
        });
    }
}

/// The score of one leader of a team, averaged over episodes; `scores` are `[episodes][teams][leaders]`.
#[inline(always)]
fn mean_score(scores: &[AtomicU32], episodes: usize, teams: usize, team: usize, leaders: usize, leader: usize) -> f32 {
    let score =
        |episode: usize| f64::from(f32::from_bits(scores[(episode * teams + team) * leaders + leader].load(Relaxed)));
    let total: f64 = (0..episodes).map(score).sum();
    (total / episodes as f64) as f32
}

/// Slots that one thread fills at a time.
const BROOD: usize = 64;
/// Policies of whom a thread does something short, at least: it has to be worth waking another.
const CHUNK: usize = 2048;

/// Populations that make a [`CHUNK`].
fn few(population: usize) -> usize {
    CHUNK.div_ceil(population)
}
