//! Replays exactly the episode that a team of a generation was scored on.
//!
//! Training is a fast, pure function of config and seed, so no generation has to be stored. A replay retrains the trial
//! up to the generation, from a checkpoint if possible. It then plays the generation's teams again and traces one
//! team's episode. G of the best team or champion is compared with the run's `metrics.csv`.
//!
//! [`page()`] makes a page of the episodes, [`still`] a picture and [`gif()`] a film.

use std::path::Path;

use glam::Vec2;

use super::map;
use super::runs::{self, ReadError};
use crate::record::checkpoint;
use crate::record::digests::Verification;
use crate::record::folder::{CHECKPOINTS, METRICS, POLICIES, RUN, Run};
use crate::record::metrics;
use flotilla::backend::{Backend, BackendError, Group, Trace};
use flotilla::config::{Config, StageConfig, When};
use flotilla::credit::{self, Credit, Scores, Strided};
use flotilla::escape::PathExt;
use flotilla::evolve;
use flotilla::trainer::{Row, Snapshot, Trainer};
use flotilla::world::World;

mod film;
mod page;

pub use film::{FPS, Frames};
pub use film::{Film, animate, gif, still};
pub use page::{data, detailed, page, parts};

/// The reason why an episode cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The run cannot be read.
    #[error(transparent)]
    Run(#[from] ReadError),
    /// The generations cannot be played.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The run has no such trial, generation or team. The second text is the remedy, if there is one.
    #[error("{0}")]
    NoSuch(String, Option<&'static str>),
    /// The generation cannot be trained again.
    #[error("{0}")]
    Refused(String),
    /// Retraining gives another result than the run's metrics.
    #[error("{0}")]
    Differs(String),
    /// The caller's `watch` stopped the replay.
    #[error("stopped")]
    Stopped,
}

/// Returns the error for a trial of `played` generations that has not reached the given one.
fn no_generation(folder: &Path, trial: usize, generation: usize, played: usize) -> ReplayError {
    let newest = played.checked_sub(1);
    let advice = newest.map_or(String::new(), |newest| format!("; the newest is {newest}: choose one up to that"));
    let message = format!("{}: metrics.csv has no generation {generation} of trial {trial}{advice}", folder.escaped());
    ReplayError::NoSuch(message, newest.map(|_| "or finish the run with --resume"))
}

/// Formats a count and its indices as "3 trials, 0 to 2" or "1 trial, 0".
pub(crate) fn numbered(count: usize, what: &str) -> String {
    format!("{}, {}", map::counted(count, what), places(count))
}

/// Formats the indices of a count as "0 to 2" or "0".
fn places(count: usize) -> String {
    if count > 1 { format!("0 to {}", count - 1) } else { "0".into() }
}

/// The team of a generation to replay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which {
    /// The team with the largest G; the first one if several are equal.
    Best,
    /// The team of the best policy of each population after the generation is scored.
    Champion,
    /// The team with this index in its generation.
    Number(usize),
}

impl std::str::FromStr for Which {
    type Err = String;

    fn from_str(text: &str) -> Result<Which, String> {
        match text {
            "best" => Ok(Which::Best),
            "champion" => Ok(Which::Champion),
            number => {
                number.parse().map(Which::Number).map_err(|_| "allowed best, champion or a whole number, from 0".into())
            }
        }
    }
}

/// One team's episode and its scores.
pub struct Replayed {
    /// The trial.
    pub trial: usize,
    /// The generation.
    pub generation: usize,
    /// The team as it was requested.
    pub which: Which,
    /// Index of the team in its generation. The champion is none of these teams and has their number instead.
    pub team: usize,
    /// The team's mean G over all its episodes. For the best team and the champion it equals the value in
    /// `metrics.csv`.
    pub team_g: f64,
    /// Number of episodes that `team_g` averages. This is the first of them.
    pub episodes: usize,
    /// The world of the generation, with the POIs where this episode had them.
    pub world: World,
    /// The trace of this team alone.
    pub trace: Trace,
    /// The scores of this episode.
    pub scores: Scores,
    /// The leader to whose group each agent belongs for Df, or [`credit::UNASSIGNED`]. `[agents]`.
    pub owner: Vec<u32>,
    /// The leaders of each follower at each step, as [`credit::find_leading`] writes them. Empty unless the run's
    /// fitness is Dt.
    pub led: Vec<u32>,
    /// The agents near each POI at the start, `[pois][words]`. Empty unless the start counts as a step.
    pub start: Vec<u32>,
    /// The step at which each POI was first observed, `[pois]`: 0 is the start.
    pub observed: Vec<Option<usize>>,
    /// Whether the comparison of the run's files with their digests was skipped.
    pub unverified: bool,
    /// Whether another fitness than the config's selected the team, see [`Run::own_fitness`].
    pub own_fitness: bool,
    /// Whether the policies were given and belong to no run. The trial and the generation then mean nothing.
    pub given: bool,
}

/// Returns G of the champion in a generation of a trial if `which` requests it, otherwise of the best team. None without
/// a row. `trial` are its rows, `[generations]`.
fn g_of(trial: &[Row], generation: usize, which: Which) -> Option<f64> {
    let row = trial.get(generation)?;
    Some(if which == Which::Champion { row.champion_g } else { row.best_g })
}

/// Returns the trials with the largest and the smallest G of a generation. Ties go to the lower index.
///
/// G is the champion's if `which` requests it, otherwise the best team's. Without a generation, the newest that all
/// trials have is used.
pub(crate) fn extreme_trials(
    folder: &Path,
    config: &Config,
    generation: Option<usize>,
    which: Which,
    verification: Verification,
) -> Result<[usize; 2], ReplayError> {
    let all = runs::trials(folder, config, verification)?;
    let newest = all.iter().map(|trial| trial.len().saturating_sub(1)).min();
    let generation = generation.or(newest).unwrap_or(0);
    let g = all.iter().map(|trial| g_of(trial, generation, which)).collect::<Option<Vec<f64>>>();
    let Some(g) = g else {
        let trial = all.iter().position(|trial| trial.len() <= generation).unwrap_or(0);
        return Err(no_generation(folder, trial, generation, all[trial].len()));
    };
    let first = |better: fn(f64, f64) -> bool| (0..g.len()).reduce(|a, b| if better(g[b], g[a]) { b } else { a });
    Ok([first(|b, a| b > a), first(|b, a| b < a)].map(|trial| trial.unwrap_or(0)))
}

/// Replays one team of each given generation of a trial, and returns the episodes in the given order.
///
/// `watch` is called with each generation before it is trained. If it returns false, the replay stops.
///
/// # Errors
/// The run cannot be read, lacks the generation or team, or its metrics differ from the replay.
pub fn replay(
    folder: &Path,
    trial: usize,
    generations: &[usize],
    which: Which,
    verification: Verification,
    backend: &mut dyn Backend,
    watch: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Replayed>, ReplayError> {
    let name = folder.escaped();
    let config = runs::config(folder, verification)?.validate().map_err(BackendError::from)?;
    let trials = config.learning.trials;
    if trial >= trials {
        let text = format!("{name} has no trial {trial}: its config has {}", numbered(trials, "trial"));
        return Err(ReplayError::NoSuch(text, None));
    }
    let teams = generations.iter().map(|&generation| config.at(generation).learning.team_count()).min().unwrap_or(0);
    if let Which::Number(team) = which
        && team >= teams
    {
        let places = places(teams);
        let text =
            format!("no team {team}: a generation has {teams} teams, {places}; choose one of them, best or champion");
        return Err(ReplayError::NoSuch(text, None));
    }
    let rows = runs::trials(folder, &config, verification)?.swap_remove(trial);
    if let Some(&generation) = generations.iter().find(|&&generation| generation >= rows.len()) {
        return Err(no_generation(folder, trial, generation, rows.len()));
    }
    let mut order: Vec<usize> = (0..generations.len()).collect();
    order.sort_by_key(|&index| generations[index]);
    let mut played: Vec<Option<Replayed>> = generations.iter().map(|_| None).collect();
    let mut trainer = Trainer::of_trial(&config, trial);
    let own_fitness = Run::has_own_fitness(folder);
    for index in order {
        let generation = generations[index];
        // The champion is in its slot only after its generation is over.
        let wanted = generation + usize::from(which == Which::Champion);
        // A run that started from given policies has them in checkpoint 0, so a fresh trainer's search includes it.
        let next = trainer.generation(0);
        if let Some(snapshot) = nearest(folder, &config, trial, next + usize::from(next > 0)..=wanted) {
            // A checkpoint of other sizes belongs to another config. It is ignored, and training continues without it.
            let _ = trainer.restore(0, snapshot);
        } else if next == 0 && Run::read(&folder.join(RUN)).is_ok_and(|run| run.init.is_some()) {
            return Err(ReplayError::Refused(format!(
                "{name} started from given policies, but no checkpoint is left to start from: it cannot be replayed up \
                 to generation {generation}"
            )));
        }
        while trainer.generation(0) < wanted {
            // Only the program that trained the run knows its fitness.
            if own_fitness {
                return Err(ReplayError::Refused(format!(
                    "{name} was trained with a fitness that is not the config's, so generation {generation} cannot be \
                     trained again; only the best team of generation 0 and the champion of the last generation can be \
                     replayed"
                )));
            }
            if !watch(trainer.generation(0)) {
                return Err(ReplayError::Stopped);
            }
            trainer.advance(backend)?;
        }
        let (found, g) = match which {
            Which::Champion => {
                let stage = config.at(generation);
                let found = champion(stage, stage, &mut trainer, trial, backend)?;
                let g = found.team_g;
                (found, g)
            }
            _ => team(config.at(generation), &mut trainer, trial, which, backend)?,
        };
        let expected = g_of(&rows, generation, which).unwrap_or(f64::NAN);
        if g != expected {
            let who = if which == Which::Champion { "champion" } else { "best team" };
            return Err(ReplayError::Differs(format!(
                "{name}: trained again, the {who} of trial {trial}, generation {generation} has G = {g}, but \
                 metrics.csv has {expected}: it was made with another config or another version of this program; \
                 repeat the run, then replay it"
            )));
        }
        played[index] = Some(Replayed { unverified: verification.is_skipped(), own_fitness, ..found });
    }
    Ok(played.into_iter().flatten().collect())
}

/// Returns one trial's part of the newest usable checkpoint within a range of generations.
fn nearest(
    folder: &Path,
    config: &Config,
    trial: usize,
    generations: std::ops::RangeInclusive<usize>,
) -> Option<Snapshot> {
    let checkpoints = folder.join(CHECKPOINTS);
    let found = checkpoint::list(&checkpoints).ok()?.into_iter().rev().filter(|found| generations.contains(found));
    found.into_iter().find_map(|generation| {
        let path = checkpoint::path(&checkpoints, generation);
        let found = checkpoint::read(&path, &folder.join(POLICIES), config).ok()??;
        // Somebody may have copied a checkpoint of another run here.
        let other_start = Run::read(&folder.join(RUN)).is_ok_and(|run| run.init != found.init);
        let is_of_run =
            found.is_of(config) && !other_start && metrics::has_extent(&folder.join(METRICS), &found.metrics);
        if !is_of_run || found.snapshot.generation != generation {
            return None;
        }
        let Snapshot { last, mut weights, mut fitness, mut pending, .. } = found.snapshot;
        Some(Snapshot {
            generation,
            last,
            weights: vec![weights.swap_remove(trial)],
            fitness: vec![fitness.swap_remove(trial)],
            pending: vec![pending.swap_remove(trial)],
        })
    })
}

/// Plays the current generation of a trainer with a single trial, and traces one team. Also returns the largest G of
/// all teams.
fn team(
    config: &Config,
    trainer: &mut Trainer,
    trial: usize,
    which: Which,
    backend: &mut dyn Backend,
) -> Result<(Replayed, f64), BackendError> {
    let (generation, world) = (trainer.generation(0), trainer.world(0).clone());
    let teams = trainer.teams(0, 0).to_vec();
    let episodes = Episodes::new(config, &world, trial, generation, trainer.weights(0, 0)?, &teams);
    let g = episodes.play(backend)?;
    let first_best = (0..g.len()).reduce(|a, b| if g[b] > g[a] { b } else { a }).unwrap_or(0);
    let team = if let Which::Number(team) = which { team } else { first_best };
    let played = episodes.trace(team, backend)?;
    Ok((Replayed { trial, generation, which, team, team_g: g[team], ..played }, g[first_best]))
}

/// Plays and traces the champion of the generation that a trainer with a single trial has just finished. `config` is
/// the config of that generation, and `credits` the same with the credits to record.
pub fn champion(
    config: &StageConfig,
    credits: &Config,
    trainer: &mut Trainer,
    trial: usize,
    backend: &mut dyn Backend,
) -> Result<Replayed, BackendError> {
    // A champion plays with the starts of the next generation, but in the world of its own generation.
    let (next, world) = (trainer.generation(0), World::new(config));
    let population = config.learning.population;
    let teams = vec![population as u32; world.leaders()];
    let episodes = Episodes::new(credits, &world, trial, next, trainer.weights(0, 0)?, &teams);
    let team_g = episodes.play(backend)?[0];
    let played = episodes.trace(0, backend)?;
    Ok(Replayed { trial, generation: next - 1, which: Which::Champion, team: population, team_g, ..played })
}

/// The teams of one generation, and the episodes that they play.
struct Episodes<'a> {
    config: &'a Config,
    world: &'a World,
    weights: &'a [f32],
    teams: &'a [u32],
    /// The start positions of each episode, `[episodes]`.
    starts: Vec<Vec<Vec2>>,
}

impl<'a> Episodes<'a> {
    fn new(
        config: &'a Config,
        world: &'a World,
        trial: usize,
        generation: usize,
        weights: &'a [f32],
        teams: &'a [u32],
    ) -> Episodes<'a> {
        let starts = |episode| {
            let mut starts = Vec::new();
            let episode = (evolve::TRAINING_EPISODES, episode);
            evolve::episode_positions(&config.learning, trial, generation, episode, world, &mut starts);
            starts
        };
        let starts = (0..config.learning.episodes_per_team).map(starts).collect();
        Episodes { config, world, weights, teams, starts }
    }

    /// Returns the group of some of the teams in one episode, with sightings if the fitness needs them.
    fn group<'b>(&'b self, episode: usize, teams: &'b [u32]) -> Group<'b> {
        Group {
            starts: &self.starts[episode],
            fitnesses: flotilla::evaluate::scores_beside(self.config),
            ..Group::new(self.world, self.weights, self.config.learning.slots(), teams)
        }
    }

    /// Returns the mean G of every team over all episodes, `[teams]`.
    fn play(&self, backend: &mut dyn Backend) -> Result<Vec<f64>, BackendError> {
        let groups: Vec<_> =
            (0..self.starts.len()).map(|episode| Group { fitnesses: &[], ..self.group(episode, self.teams) }).collect();
        let mut observed = vec![0u64; self.teams.len() / self.world.leaders()];
        for scores in backend.play(&groups)? {
            observed.iter_mut().zip(scores.observed).for_each(|(sum, observed)| *sum += u64::from(observed));
        }
        let whole = f64::from(self.world.total_worth) * groups.len() as f64;
        Ok(observed.into_iter().map(|observed| observed as f64 / whole).collect())
    }

    /// Plays a team's first episode again and traces it.
    fn trace(&self, team: usize, backend: &mut dyn Backend) -> Result<Replayed, BackendError> {
        let leaders = self.world.leaders();
        let played = one(&self.group(0, &self.teams[team * leaders..(team + 1) * leaders]), backend)?;
        Ok(Replayed { episodes: self.starts.len(), ..played })
    }
}

/// Plays and traces a group of a single team. `led` is filled only if Dt is among the group's fitnesses.
pub fn one(group: &Group<'_>, backend: &mut dyn Backend) -> Result<Replayed, BackendError> {
    let (world, trace) = (group.world, backend.trace(group)?);
    let episode = trace.episode(world, 0);
    let scores = Credit::default().all(&episode, world);
    let mut owner = Vec::new();
    credit::assign(&episode.seen, world, &mut owner);
    let mut led = Vec::new();
    credit::find_leading(&episode.sights, world, &mut led);
    let position = |agent| Vec2::from(trace.moment(0, 0, agent).position);
    let start = near_at_start(world, group.moved_pois().unwrap_or(&world.pois), position);
    let observed = observed_at(world, &start, &trace.sets);
    let team_g = f64::from(scores.observed) / f64::from(world.total_worth);
    // POIs are drawn where this episode had them.
    let world = world.clone().with_pois(group.moved_pois().unwrap_or(&world.pois));
    Ok(Replayed {
        trial: 0,
        generation: 0,
        which: Which::Champion,
        team: 0,
        team_g,
        episodes: 1,
        scores,
        owner,
        led,
        start,
        observed,
        trace,
        world,
        unverified: false,
        own_fitness: false,
        given: false,
    })
}

/// Returns the agents near each POI at the start, `[pois][words]`. Where the start does not count there are none, and if it
/// counts nowhere the result is empty. `position` returns where an agent starts.
pub fn near_at_start(world: &World, pois: &[Vec2], position: impl Fn(usize) -> Vec2) -> Vec<u32> {
    if !world.paths.as_ref().is_some_and(|rule| rule.start_counts) {
        return vec![];
    }
    let words = world.constants.words as usize;
    let mut start = vec![0; pois.len() * words];
    for (poi, set) in start.chunks_exact_mut(words).enumerate() {
        let is_open = world.rule.window(poi).is_none_or(|window| window == [1, world.constants.steps]);
        let is_near = |agent: usize| (position(agent) - pois[poi]).length_squared() <= world.radii2[poi];
        (0..world.agents())
            .filter(|&agent| is_open && is_near(agent))
            .for_each(|agent| set[agent / 32] |= 1 << (agent % 32));
    }
    start
}

/// Counts the observers near a POI after a step, from the agents near each POI at the start, see [`near_at_start`], and
/// after each step.
fn near(world: &World, start: &[u32], sets: &[u32], step: usize, poi: usize) -> u32 {
    let words = world.constants.words as usize;
    let (sets, set) = match step.checked_sub(1) {
        Some(step) => (sets, step * world.pois.len() + poi),
        None if start.is_empty() => return 0,
        None => (start, poi),
    };
    world.rule.count(poi, sets[set * words..(set + 1) * words].iter().copied())
}

/// Returns the step at which each POI is observed, `[pois]`, see [`as_scored`].
fn observed_at(world: &World, start: &[u32], sets: &[u32]) -> Vec<Option<usize>> {
    let first = credit::observed_at(Strided { words: sets, stride: 1, offset: 0 }, world);
    as_scored(world, first, |step, poi| near(world, start, sets, step, poi))
}

/// Returns the step at which each POI is observed, `[pois]`. `observed` has the first step with enough observers. If only the
/// last step counts, that is replaced by the last step or `None`; if the start counts and has enough, by 0. `near` returns
/// the number of observers near a POI at step 0 or at the last.
pub fn as_scored(
    world: &World,
    mut observed: Vec<Option<usize>>,
    near: impl Fn(usize, usize) -> u32,
) -> Vec<Option<usize>> {
    let (pois, steps) = (world.pois.len(), world.steps());
    let is_enough = |step, poi: usize| near(step, poi) >= world.coupling[poi];
    let scores = world.paths.iter().flat_map(|rule| &rule.scores);
    for (poi, &(_, when)) in scores.enumerate() {
        if when == When::End {
            let is_open = world.rule.is_open(poi, steps as u32, &vec![true; pois]);
            observed[poi] = (is_open && is_enough(steps, poi)).then_some(steps);
        } else if is_enough(0, poi) {
            observed[poi] = Some(0);
        }
    }
    observed
}

/// An episode without some agents: the same motion, and what the others observe.
pub struct Counterfactual<'a> {
    world: &'a World,
    /// The remaining agents of [`Replayed::start`].
    start: Vec<u32>,
    /// The remaining agents at each POI after each step, `[steps][pois][words]`.
    sets: Vec<u32>,
    /// The step at which each POI would be observed, `[pois]`.
    pub observed: Vec<Option<usize>>,
}

impl Replayed {
    /// Names the team at the start of a sentence: "Best team (number 3)".
    pub fn name(&self) -> String {
        match self.which {
            Which::Best => format!("Best team (number {})", self.team),
            Which::Champion => "Champion".into(),
            Which::Number(team) => format!("Team number {team}"),
        }
    }

    /// Names the trial and generation: "trial 0, generation 7".
    pub fn place(&self) -> String {
        match self.given {
            true => "given policies".into(),
            false => format!("trial {}, generation {}", self.trial, self.generation),
        }
    }

    /// Counts the observers within the observation radius of a POI after a step. At the start the count is 0 unless the
    /// start counts as a step.
    pub fn near(&self, step: usize, poi: usize) -> u32 {
        near(&self.world, &self.start, &self.trace.sets, step, poi)
    }

    /// Removes a leader from the record, and with `group` also the followers that it led. All others move as they did.
    pub fn without(&self, leader: usize, group: bool) -> Counterfactual<'_> {
        let Replayed { world, trace, owner, led, .. } = self;
        let (pois, words, leaders) = (world.pois.len(), world.constants.words as usize, world.leaders());
        let follows = |step: usize, agent: usize| match agent.checked_sub(leaders) {
            None => false,
            Some(follower) if !led.is_empty() => credit::is_led_by(led, world, step, follower, leader),
            Some(_) => owner[agent] as usize == leader,
        };
        let remaining = |sets: &[u32]| {
            let mut sets = sets.to_vec();
            for (at, set) in sets.chunks_exact_mut(words).enumerate() {
                let removed =
                    (0..world.agents()).filter(|&agent| agent == leader || group && follows(at / pois, agent));
                removed.for_each(|agent| set[agent / 32] &= !(1 << (agent % 32)));
            }
            sets
        };
        let [start, sets] = [&self.start, &trace.sets].map(|sets| remaining(sets));
        let observed = observed_at(world, &start, &sets);
        Counterfactual { world, start, sets, observed }
    }

    fn position(&self, step: usize, agent: usize) -> [f32; 2] {
        self.trace.moment(step, 0, agent).position
    }

    fn heading(&self, step: usize, agent: usize) -> [f32; 2] {
        self.trace.moment(step, 0, agent).heading
    }

    /// Returns the leader to whose group an agent belongs after a step. For Dt it is the first leader at that step,
    /// otherwise the group is that of Df.
    fn group(&self, step: usize, agent: usize) -> Option<usize> {
        let leaders = self.world.leaders();
        match agent.checked_sub(leaders).filter(|_| !self.led.is_empty()) {
            // The start shows the groups of the first step, whose sights precede any motion.
            Some(follower) => (0..leaders)
                .find(|&leader| credit::is_led_by(&self.led, &self.world, step.saturating_sub(1), follower, leader)),
            None => (self.owner[agent] != credit::UNASSIGNED).then_some(self.owner[agent] as usize),
        }
    }

    /// Returns evenly spaced steps to show, at most `most` but at least 2. The last step is always included.
    fn shown(&self, most: usize) -> Vec<usize> {
        let steps = self.world.steps();
        let every = steps.div_ceil(most.max(2) - 1).max(1);
        let mut shown: Vec<usize> = (0..=steps).step_by(every).collect();
        if shown.last() != Some(&steps) {
            shown.push(steps);
        }
        shown
    }
}
