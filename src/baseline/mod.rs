//! Baselines without coevolution: the best constant action, and the best of as many teams as evolution evaluates of
//! each kind: random constant actions, random networks of each population, and random networks that all leaders share.
//! Two more climb from random teams, see `climb.rs`: open-loop teams, which sense nothing, and whole teams of networks.
//!
//! A backend plays baselines like any team. A constant action is a policy whose only weights are biases of its last
//! layer. Open-loop teams play on the CPU.
//!
//! Random teams have purposes of their own for random numbers, so training results do not change. Generation `g` of
//! trial `t` plays from the same starts as in training.

mod climb;

pub use climb::SEGMENTS;

use climb::{Climber, Genome, ROUND, by_population, segment_action};
use fearless_simd::Level;
use glam::Vec2;

use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError, Group, GroupScores};
use crate::config::{Actions, Config, Learning, ValidConfig};
use crate::evaluate::Starts;
use crate::evolve::{self, Key, MIN_WEIGHT, Purpose, TRAINING_EPISODES};
use crate::model::policy::BEHAVIOURS;
use crate::parallel::*;
use crate::world::World;

/// Number of constant speeds: 1/20, 2/20, … and all of the largest speed.
pub const SPEEDS: usize = 20;
/// Number of random teams of each kind that play the selection episodes if starts or POIs move.
const FINALISTS: usize = 20;
/// Number of teams drawn together, which limits the memory for their weights.
const DRAWN_TOGETHER: usize = 4096;
/// A bias large enough for tanh to be exactly 1 or -1.
const SATURATING: f32 = 20.0;

/// G of one config's baselines, in 0..1, `[trials][generations + 1]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Baseline {
    /// The best constant (see [`constants`]) in each generation.
    pub constant: Vec<Vec<f64>>,
    /// The best random constant action so far, with as many drawn in each generation as training plays teams.
    pub actions: Vec<Vec<f64>>,
    /// The best random network so far, with as many drawn in each generation as training plays teams.
    pub random: Vec<Vec<f64>>,
    /// The best random network that all leaders share, so far, with as many drawn.
    pub shared: Vec<Vec<f64>>,
    /// The best open-loop team, of [`SEGMENTS`] actions per leader, that hill climbing found so far, with as many played.
    pub open_loop: Vec<Vec<f64>>,
    /// The best team of networks that hill climbing found so far, with as many played.
    pub hill_climbing: Vec<Vec<f64>>,
}

/// G of one trial's baselines. Each is chosen by the episodes that training plays. If starts or POIs move, selection
/// uses additional episodes, and G is from held-out starts.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// G of each constant.
    pub constants: Vec<f64>,
    /// The index of the constant that was chosen.
    pub best_constant: usize,
    /// G of the random constant action that was chosen.
    pub action: f64,
    /// G of the random network that was chosen.
    pub network: f64,
    /// G of the shared random network that was chosen.
    pub shared: f64,
    /// G of the open-loop team that hill climbing found.
    pub open_loop: f64,
    /// G of the team of networks that hill climbing found.
    pub hill_climbing: f64,
}

impl Outcome {
    /// Returns G of every baseline, in the order of [`NAMES`].
    pub fn all(&self) -> [f64; NAMES.len()] {
        let constant = self.constants[self.best_constant];
        [constant, self.action, self.network, self.shared, self.open_loop, self.hill_climbing]
    }
}

/// The baselines' names.
pub const NAMES: [&str; 6] =
    ["constant action", "random actions", "random networks", "shared networks", "open-loop actions", "hill climbing"];

/// Returns the outputs of each constant action of policies that choose no agent: straight ahead at each of [`SPEEDS`]
/// speeds, or each behaviour. All leaders of a team have the same.
pub fn constants(actions: Actions) -> Vec<Vec<f64>> {
    match actions {
        Actions::Direct => (1..=SPEEDS).map(|speed| vec![0.0, 2.0 * speed as f64 / SPEEDS as f64 - 1.0]).collect(),
        Actions::Behaviours => each_choice(BEHAVIOURS),
    }
}

/// Returns outputs that choose each of `count` things.
fn each_choice(count: usize) -> Vec<Vec<f64>> {
    let chosen = |choice| (0..count).map(|other| if other == choice { 1.0 } else { -1.0 }).collect();
    (0..count).map(chosen).collect()
}

/// Writes a policy with constant outputs, each in -1..1, for all inputs. The last layer has as many.
pub fn constant_policy(outputs: &[f64], policy: &mut [f32]) {
    let biases = policy.len() - outputs.len();
    policy.fill(0.0);
    for (bias, &output) in policy[biases..].iter_mut().zip(outputs) {
        let exact = libm::atanh(output.clamp(-1.0, 1.0)) as f32;
        *bias = if exact.abs() < MIN_WEIGHT { 0.0 } else { exact.clamp(-SATURATING, SATURATING) };
    }
}

/// Writes a random constant action. Every output is uniform in -1..1.
fn random_action(key: Key, outputs: usize, policy: &mut [f32]) {
    let uniform = |output| f64::from(key.draw(output)[0]) / (1u64 << 31) as f64 - 1.0;
    constant_policy(&(0..outputs as u32).map(uniform).collect::<Vec<_>>(), policy);
}

/// Returns the number of outputs of a config's policies.
fn outputs(config: &Config) -> usize {
    config.widths().pop().expect("a policy has outputs")
}

/// Returns the outputs of each constant of a config, `[constants][populations][outputs]`. Policies that choose agents have
/// a constant per agent, and one for nobody. Those with fewer constants than others play theirs again.
fn constants_of(config: &Config, world: &World) -> Vec<Vec<Vec<f64>>> {
    let direct = constants(config.policy.actions);
    let mut choices = vec![0; config.populations()];
    for (&population, own) in world.populations.iter().zip(world.choices()) {
        choices[population as usize] = own;
    }
    let of = |&agents: &usize| if agents == 0 { direct.clone() } else { each_choice(agents + 1) };
    let of_each: Vec<_> = choices.iter().map(of).collect();
    let count = of_each.iter().map(Vec::len).max().unwrap_or(0);
    let constant = |index: usize| {
        let own = |of: &Vec<Vec<f64>>| {
            let mut constant = of[index % of.len()].clone();
            constant.resize(outputs(config), 0.0);
            constant
        };
        of_each.iter().map(own).collect()
    };
    (0..count).map(constant).collect()
}

/// Plays the baselines of several configs side by side, generation by generation. Each plays in the world of the
/// config's own keys, without stages.
pub struct Baselines {
    settings: Vec<Setting>,
    generation: usize,
}

/// A team in which every leader has the policy with the same index.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Team {
    /// A constant, by its index.
    Constant(usize),
    /// A random team, by its kind, generation and slot.
    Random(Purpose, usize, usize),
    /// The team of networks that hill climbing found.
    Climbed,
}

/// The kinds of random teams, in the order in which they play: constant actions, networks, and networks that all leaders
/// share.
const RANDOM: [Purpose; 3] = [Purpose::ConstantActions, Purpose::Baseline, Purpose::SharedBaseline];

/// One config and its trials.
struct Setting {
    config: Config,
    world: World,
    /// See [`constants_of`].
    constants: Vec<Vec<Vec<f64>>>,
    trials: Vec<Trial>,
    found: Baseline,
}

/// One trial's teams of the current generation, and the results of its earlier generations.
struct Trial {
    index: usize,
    /// The policies of constant and random teams, `[populations][teams][parameters]`.
    weights: Vec<f32>,
    /// The policies of the teams that climb, in the same shape.
    climbing: Vec<f32>,
    /// `[episodes][agents]`, with POIs if they move.
    starts: Vec<Vec<Vec2>>,
    /// Summed worth of the POIs observed in all episodes of the current generation: by the constants that play, then by each kind of
    /// [`RANDOM`] teams.
    observed: Vec<u64>,
    /// The same of each constant when it last played.
    last_constants: Vec<u64>,
    /// The same of each constant in all generations.
    constants: Vec<u64>,
    /// The random teams of each kind that observed most, best first.
    finalists: [Vec<(u64, Team)>; RANDOM.len()],
    /// `None` if only random teams are wanted.
    climbers: Option<Climbers>,
}

/// The searches by hill climbing of one trial.
#[derive(Clone)]
struct Climbers {
    segments: Climber,
    networks: Climber,
}

impl Baselines {
    /// Prepares the baselines of all trials of some configs, in the config's own keys. Fitness, selection and mutation
    /// play no part.
    pub fn new(configs: &[ValidConfig]) -> Baselines {
        let all = |config: &ValidConfig| Setting::new(config, 0..config.learning.trials);
        Baselines { settings: configs.iter().map(all).collect(), generation: 0 }
    }

    /// Prepares the baselines of all trials of a config as [`Baselines::new`] does, but with as few random teams as
    /// possible, because only the constant actions matter.
    pub fn of_constants(config: &ValidConfig) -> Baselines {
        let mut baselines = Baselines::new(std::slice::from_ref(config)).without_climbers();
        baselines.settings[0].config.learning.population = 2;
        baselines
    }

    /// Leaves out the baselines that climb. Their results are empty or 0.
    pub fn without_climbers(mut self) -> Baselines {
        self.settings.iter_mut().flat_map(|setting| &mut setting.trials).for_each(|trial| trial.climbers = None);
        self
    }

    /// Prepares the baselines of one trial. The trial may be beyond the config's number of trials.
    pub fn of_trial(config: &ValidConfig, trial: usize) -> Baselines {
        Baselines { settings: vec![Setting::new(config, trial..trial + 1)], generation: 0 }
    }

    /// Returns the next generation to play.
    pub fn generation(&self) -> usize {
        self.generation
    }

    /// Returns whether every config's last generation has been played.
    pub fn is_done(&self) -> bool {
        self.settings.iter().all(|setting| setting.config.learning.generations < self.generation)
    }

    /// Plays one generation of every config that has one left.
    ///
    /// # Errors
    /// The backend fails. The generation can then be played again.
    pub fn advance(&mut self, backend: &mut dyn Backend) -> Result<(), BackendError> {
        let generation = self.generation;
        let mut playing: Vec<_> =
            self.settings.iter_mut().filter(|setting| generation <= setting.config.learning.generations).collect();
        playing.iter_mut().for_each(|setting| setting.start(generation));
        let most = playing.iter().map(|setting| setting.teams(generation)).max().unwrap_or(0);
        for first in (0..most).step_by(DRAWN_TOGETHER) {
            playing.iter_mut().for_each(|setting| setting.draw(generation, first));
            let mut rounds = Vec::new();
            for setting in &playing {
                let teams = setting.teams(generation).min(first + DRAWN_TOGETHER).saturating_sub(first);
                let trials = setting.trials.iter().filter(|_| teams > 0);
                rounds.extend(trials.map(|trial| setting.round(trial, &trial.weights, teams)));
            }
            let mut observed = play(&rounds, |groups| backend.play(groups))?.into_iter();
            for setting in &mut playing {
                let playing = setting.teams(generation) > first;
                setting.trials.iter_mut().filter(|_| playing).zip(&mut observed).for_each(|(trial, observed)| {
                    trial.observed.extend(observed);
                });
            }
        }
        let climbing = playing.iter().map(|setting| setting.config.learning.team_count()).max().unwrap_or(0);
        let trials = playing.iter_mut().flat_map(|setting| &mut setting.trials);
        let before: Vec<_> = trials.map(|trial| trial.climbers.clone()).collect();
        let mut rounds = (0..climbing).step_by(ROUND);
        if let Err(error) = rounds.try_for_each(|first| climb(&mut playing, generation, first, backend)) {
            let trials = playing.iter_mut().flat_map(|setting| &mut setting.trials);
            trials.zip(before).for_each(|(trial, before)| trial.climbers = before);
            return Err(error);
        }
        playing.iter_mut().for_each(|setting| setting.collect_results(generation));
        self.generation += 1;
        Ok(())
    }

    /// Returns G of the generations played so far, for each config.
    pub fn so_far(&self) -> impl Iterator<Item = &Baseline> {
        self.settings.iter().map(|setting| &setting.found)
    }

    /// Returns G per generation, for each config.
    pub fn found(self) -> Vec<Baseline> {
        self.settings.into_iter().map(|setting| setting.found).collect()
    }

    /// Chooses the team of each baseline after the last generation, `[configs][trials]`.
    ///
    /// If starts or POIs move, the constants and the best random teams play `episodes` more episodes, with starts drawn
    /// as in training. These choose the best of each kind. The chosen teams then play from as many held-out starts, the
    /// same as in `flotilla rollout`.
    ///
    /// # Errors
    /// The backend fails.
    pub fn outcomes(&self, backend: &mut dyn Backend, episodes: u32) -> Result<Vec<Vec<Outcome>>, BackendError> {
        let mut outcomes = Vec::new();
        for setting in &self.settings {
            let trials = setting.trials.iter().map(|trial| setting.outcome(trial, backend, episodes));
            outcomes.push(trials.collect::<Result<_, _>>()?);
        }
        Ok(outcomes)
    }
}

/// Plays a round of every climber of some settings: the teams of a generation from slot `first` on.
fn climb(
    playing: &mut [&mut Setting],
    generation: usize,
    first: usize,
    backend: &mut dyn Backend,
) -> Result<(), BackendError> {
    let (mut open_loop, mut rounds) = (Vec::new(), Vec::new());
    playing.par_iter_mut().for_each(|setting| setting.draw_round(generation, first));
    for setting in &*playing {
        let teams = setting.round_size(first);
        let climbing = setting.trials.iter().filter_map(|trial| Some((trial, trial.climbers.as_ref()?)));
        for (trial, climbers) in climbing.filter(|_| teams > 0) {
            rounds.push(setting.round(trial, &trial.climbing, teams));
            open_loop.push(&climbers.segments.teams[..]);
        }
    }
    let observed = play_segments(&rounds, &open_loop)?;
    let networks = play(&rounds, |groups| backend.play(groups))?;
    let climbers = playing.iter_mut().filter(|setting| setting.round_size(first) > 0);
    let climbers = climbers.flat_map(|setting| &mut setting.trials).filter_map(|trial| trial.climbers.as_mut());
    for (climbers, (networks, segments)) in climbers.zip(networks.iter().zip(&observed)) {
        climbers.networks.select(networks);
        climbers.segments.select(segments);
    }
    Ok(())
}

/// Teams to play from some starts.
#[derive(Clone, Copy)]
struct Round<'a> {
    world: &'a World,
    teams: usize,
    /// `[populations][teams][parameters]`
    weights: &'a [f32],
    starts: &'a [Vec<Vec2>],
}

/// Plays open-loop teams, `[rounds][teams][numbers]`, in place of those of some rounds. Returns what [`play`] does.
fn play_segments(rounds: &[Round<'_>], open_loop: &[&[f32]]) -> Result<Vec<Vec<u64>>, BackendError> {
    let of_rounds = rounds.iter().zip(open_loop);
    let of_group: Vec<_> = of_rounds.flat_map(|of| std::iter::repeat_n(of, of.0.starts.len())).collect();
    let actions = |(group, team): (usize, usize), leader, step| {
        let (Round { world, teams, .. }, numbers) = of_group[group];
        segment_action(world, &numbers[numbers.len() / teams * team..], leader, step)
    };
    play(rounds, |groups| Cpu::default().play_with(groups, Some(&actions)))
}

/// Plays all teams from all their starts as one batch. Returns the summed worth of the POIs that each team of each round
/// observes over all starts, `[rounds][teams]`.
fn play(
    rounds: &[Round<'_>],
    backend: impl FnOnce(&[Group<'_>]) -> Result<Vec<GroupScores>, BackendError>,
) -> Result<Vec<Vec<u64>>, BackendError> {
    let teams = |round: &Round<'_>| evolve::aligned_teams(round.teams, round.world.leaders());
    let teams: Vec<Vec<u32>> = rounds.iter().map(teams).collect();
    let mut groups = Vec::new();
    for (round, teams) in rounds.iter().zip(&teams) {
        let group = Group::new(round.world, round.weights, round.teams, teams);
        groups.extend(round.starts.iter().map(|starts| Group { starts, ..group }));
    }
    let mut scores = backend(&groups)?.into_iter();
    let of_round = |round: &Round<'_>| {
        let mut observed = vec![0; round.teams];
        for scores in scores.by_ref().take(round.starts.len()) {
            observed.iter_mut().zip(scores.observed).for_each(|(sum, observed)| *sum += u64::from(observed));
        }
        observed
    };
    Ok(rounds.iter().map(of_round).collect())
}

impl Setting {
    fn new(config: &ValidConfig, trials: std::ops::Range<usize>) -> Setting {
        let (world, config) = (World::new(config), Config::clone(config));
        let constants = constants_of(&config, &world);
        let Learning { episodes_per_team, generations, .. } = config.learning;
        let none = || vec![Vec::with_capacity(generations + 1); trials.len()];
        let found = Baseline {
            constant: none(),
            actions: none(),
            random: none(),
            shared: none(),
            open_loop: none(),
            hill_climbing: none(),
        };
        let (populations, parameters) = (config.populations(), world.parameters());
        let climbers = || Climbers {
            segments: Climber::new(Genome::Segments { leaders: world.leaders() }),
            networks: Climber::new(Genome::Networks { populations, parameters }),
        };
        let trial = |index| Trial {
            index,
            weights: vec![],
            climbing: vec![],
            starts: vec![vec![]; episodes_per_team],
            observed: Vec::with_capacity(constants.len() + RANDOM.len() * config.learning.team_count()),
            last_constants: vec![],
            constants: vec![0; constants.len()],
            finalists: Default::default(),
            climbers: Some(climbers()),
        };
        Setting { trials: trials.map(trial).collect(), found, constants, config, world }
    }

    /// Reports whether starts or POIs move.
    fn moves(&self) -> bool {
        self.config.starts_move() || self.config.pois_move()
    }

    /// Returns the number of constants that play in a generation. If nothing moves, they play only once, because every
    /// generation would give the same result.
    fn played_constants(&self, generation: usize) -> usize {
        if generation == 0 || self.moves() { self.constants.len() } else { 0 }
    }

    /// Returns the number of teams of a trial that play in a generation.
    fn teams(&self, generation: usize) -> usize {
        self.played_constants(generation) + RANDOM.len() * self.config.learning.team_count()
    }

    /// Returns the number of teams of a climber's round that begins at slot `first` of a generation.
    fn round_size(&self, first: usize) -> usize {
        self.config.learning.team_count().saturating_sub(first).min(ROUND)
    }

    /// Draws the teams of each climber's round.
    fn draw_round(&mut self, generation: usize, first: usize) {
        // Other starts make other results, so the best team plays again.
        let (count, again) = (self.round_size(first), generation > 0 && first == 0 && self.moves());
        self.trials.par_iter_mut().filter(|_| count > 0).for_each(|Trial { index, climbers, climbing, .. }| {
            if let Some(Climbers { segments, networks }) = climbers {
                for climber in [segments, &mut *networks] {
                    climber.draw(&self.config.learning, *index, generation, (first, count), again);
                }
                by_population(networks, self.world.parameters(), climbing);
            }
        });
    }

    /// Returns a round of a trial's teams.
    fn round<'a>(&'a self, trial: &'a Trial, weights: &'a [f32], teams: usize) -> Round<'a> {
        Round { world: &self.world, teams, weights, starts: &trial.starts }
    }

    /// Returns the team at a place among a generation's teams.
    fn team(&self, generation: usize, place: usize) -> Team {
        let (constants, teams) = (self.played_constants(generation), self.config.learning.team_count());
        match place.checked_sub(constants) {
            None => Team::Constant(place),
            Some(slot) => Team::Random(RANDOM[slot / teams], generation, slot % teams),
        }
    }

    /// Writes a team's policy for one population.
    fn write_policy(&self, level: Level, trial: &Trial, team: Team, population: usize, policy: &mut [f32]) {
        match team {
            Team::Constant(index) => constant_policy(&self.constants[index][population], policy),
            Team::Random(kind, generation, slot) => {
                let population = if kind == Purpose::SharedBaseline { 0 } else { population };
                let key = Key::new(self.config.learning.seed, trial.index, kind).at(generation, population, slot);
                match kind {
                    Purpose::ConstantActions => random_action(key, outputs(&self.config), policy),
                    _ => evolve::initial_policy(level, key, &self.config.learning, policy),
                }
            }
            Team::Climbed => {
                trial.climbers.iter().for_each(|climbers| climbers.networks.write_policy(population, policy));
            }
        }
    }

    /// Writes teams' policies, `[populations][teams][parameters]`.
    fn write_policies(&self, trial: &Trial, teams: &[Team], weights: &mut Vec<f32>) {
        let (level, parameters) = (Level::new(), self.world.parameters());
        weights.resize(self.config.populations() * teams.len() * parameters, 0.0);
        weights.par_chunks_exact_mut(parameters).enumerate().for_each(|(place, policy)| {
            self.write_policy(level, trial, teams[place % teams.len()], place / teams.len(), policy);
        });
    }

    /// Draws the starts of a generation.
    fn start(&mut self, generation: usize) {
        for Trial { index, starts, observed, .. } in &mut self.trials {
            for (episode, starts) in starts.iter_mut().enumerate() {
                let episode = (TRAINING_EPISODES, episode);
                evolve::episode_positions(&self.config.learning, *index, generation, episode, &self.world, starts);
            }
            observed.clear();
        }
    }

    /// Draws up to [`DRAWN_TOGETHER`] of a generation's teams.
    fn draw(&mut self, generation: usize, first: usize) {
        let last = self.teams(generation).min(first + DRAWN_TOGETHER);
        let teams: Vec<Team> = (first..last).map(|place| self.team(generation, place)).collect();
        if teams.is_empty() {
            return;
        }
        for index in 0..self.trials.len() {
            let mut weights = std::mem::take(&mut self.trials[index].weights);
            self.write_policies(&self.trials[index], &teams, &mut weights);
            self.trials[index].weights = weights;
        }
    }

    /// Adds the results of a generation.
    fn collect_results(&mut self, generation: usize) {
        let episodes_per_team = self.config.learning.episodes_per_team;
        let whole = (self.world.total_worth as usize * episodes_per_team) as f64;
        let played = self.played_constants(generation);
        for (place, trial) in self.trials.iter_mut().enumerate() {
            let (constants, random) = trial.observed.split_at(played);
            if played > 0 {
                trial.last_constants = constants.to_vec();
            }
            let constants = &trial.last_constants;
            trial.constants.iter_mut().zip(constants).for_each(|(sum, &observed)| *sum += observed);
            let most = constants.iter().copied().max().unwrap_or(0);
            self.found.constant[place].push(most as f64 / whole);
            let Baseline { actions, random: networks, shared, open_loop, hill_climbing, .. } = &mut self.found;
            if let Some(climbers) = &trial.climbers {
                open_loop[place].push(climbers.segments.observed as f64 / whole);
                hill_climbing[place].push(climbers.networks.observed as f64 / whole);
            }
            let kinds =
                random.chunks_exact(self.config.learning.team_count()).zip([actions, networks, shared]).zip(RANDOM);
            for (((observed, best), kind), finalists) in kinds.zip(&mut trial.finalists) {
                let best = &mut best[place];
                for (slot, &observed) in observed.iter().enumerate() {
                    // Ties go to the team that was drawn first.
                    let rank = finalists.partition_point(|(other, _)| *other >= observed);
                    if rank < FINALISTS {
                        finalists.insert(rank, (observed, Team::Random(kind, generation, slot)));
                        finalists.truncate(FINALISTS);
                    }
                }
                best.push(finalists[0].0 as f64 / whole);
            }
        }
    }

    fn outcome(&self, trial: &Trial, backend: &mut dyn Backend, episodes: u32) -> Result<Outcome, BackendError> {
        let Learning { generations, episodes_per_team, start_jitter, poi_jitter, .. } = self.config.learning;
        let all: Vec<Team> = (0..self.constants.len()).map(Team::Constant).collect();
        if !self.moves() {
            let whole = (self.world.total_worth as usize * episodes_per_team) as f64;
            let [action, network, shared] = [0, 1, 2].map(|kind| trial.finalists[kind][0].0 as f64 / whole);
            let climbed = |of: fn(&Climbers) -> &Climber| {
                trial.climbers.as_ref().map_or(0.0, |climbers| of(climbers).observed as f64 / whole)
            };
            let open_loop = climbed(|climbers| &climbers.segments);
            let hill_climbing = climbed(|climbers| &climbers.networks);
            let generations = (generations + 1) as f64;
            let constants = trial.constants.iter().map(|&sum| sum as f64 / (whole * generations)).collect();
            let best_constant = first_largest(&trial.constants);
            return Ok(Outcome { best_constant, constants, action, network, shared, open_loop, hill_climbing });
        }
        let mut starts = vec![vec![]; episodes as usize];
        for (episode, starts) in starts.iter_mut().enumerate() {
            // No training plays this generation's starts.
            evolve::episode_positions(
                &self.config.learning,
                trial.index,
                generations + 2,
                (TRAINING_EPISODES, episode),
                &self.world,
                starts,
            );
        }
        let (world, mut weights) = (&self.world, Vec::new());
        let mut played = |teams: &[Team], starts: &[Vec<Vec2>]| {
            self.write_policies(trial, teams, &mut weights);
            let round = Round { world, teams: teams.len(), weights: &weights, starts };
            Ok::<_, BackendError>(play(&[round], |groups| backend.play(groups))?.concat())
        };
        let best_constant = first_largest(&played(&all, &starts)?);
        let mut chosen = all.clone();
        for finalists in &trial.finalists {
            let teams: Vec<Team> = finalists.iter().map(|&(_, team)| team).collect();
            chosen.push(teams[first_largest(&played(&teams, &starts)?)]);
        }
        chosen.extend(trial.climbers.iter().map(|_| Team::Climbed));

        let held_out = Starts::Drawn { episodes, seed: 0, jitter: start_jitter, poi_jitter };
        let starts: Vec<Vec<Vec2>> = (0..episodes as usize).map(|episode| held_out.of(episode, &self.world)).collect();
        let whole = (self.world.total_worth as usize * starts.len()) as f64;
        let mut g: Vec<f64> = played(&chosen, &starts)?.into_iter().map(|count| count as f64 / whole).collect();
        let open_loop = match &trial.climbers {
            Some(climbers) => {
                let weights = &vec![0.0; self.config.populations() * world.parameters()];
                let round = Round { world, teams: 1, weights, starts: &starts };
                play_segments(&[round], &[&climbers.segments.parent])?[0][0] as f64 / whole
            }
            None => 0.0,
        };
        let others = g.split_off(all.len());
        let hill_climbing = others.get(RANDOM.len()).copied().unwrap_or(0.0);
        let (constants, [action, network, shared]) = (g, [others[0], others[1], others[2]]);
        Ok(Outcome { best_constant, constants, action, network, shared, open_loop, hill_climbing })
    }
}

/// Returns the index of the largest value. Ties go to the first.
fn first_largest<T: Ord>(values: &[T]) -> usize {
    (1..values.len()).fold(0, |best, index| if values[index] > values[best] { index } else { best })
}
