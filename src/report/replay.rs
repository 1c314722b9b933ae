//! Replays exactly the episode that a team of a generation was scored on.
//!
//! Training is a fast, pure function of config and seed, so no generation has to be stored. A replay retrains the trial
//! up to the generation, from a checkpoint if possible. It then plays the generation's teams again and traces one
//! team's episode. G of the best team or champion is compared with the run's `metrics.csv`.

use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use glam::{DVec2, Vec2};
use serde_json::json;

use super::map::{self, FAINT, Legend, Marker, Poi, Team, Viewport};
use super::runs::{self, ReadError};
use super::scene::{Anchor, BLACK, Color, Scene};
use crate::backend::{Backend, BackendError, Group, Trace};
use crate::config::{Config, Observers};
use crate::credit::{self, Credit, Scores, Strided};
use crate::escape::PathExt;
use crate::evolve;
use crate::record::checkpoint;
use crate::record::digests::{UNVERIFIED, Verification};
use crate::record::folder::{CHECKPOINTS, POLICIES, RUN, Run};
use crate::trainer::{Snapshot, Trainer};
use crate::world::{INPUTS, OUTPUTS, World};

/// Maximum number of bytes of motion in a page, before base64 adds a third. Longer motion is thinned out.
const MOTION_BYTES: usize = 1_300_000;
/// Maximum number of bytes of motion that is stored as the exact f32 values.
const EXACT_BYTES: usize = 600_000;

/// Maximum number of bytes of the senses of an episode, and of what is observed without its leaders.
const DETAIL_BYTES: usize = 1_000_000;

/// The reason why an episode cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The run cannot be read.
    #[error(transparent)]
    Run(#[from] ReadError),
    /// The generations cannot be played.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The run has no such trial.
    #[error("{folder} has no trial {trial}: its config has {}", numbered(*trials, "trial"))]
    NoTrial {
        /// The run directory.
        folder: String,
        /// The requested trial, from 0.
        trial: usize,
        /// The number of trials.
        trials: usize,
    },
    /// The run has not reached the generation.
    #[error(
        "{folder}: metrics.csv has no generation {generation} of trial {trial}{}",
        newest.map_or(String::new(), |newest| format!("; the newest is {newest}: choose one up to that"))
    )]
    NoGeneration {
        /// The run directory.
        folder: String,
        /// The requested trial, from 0.
        trial: usize,
        /// The requested generation, from 0.
        generation: usize,
        /// The trial's newest generation, if any.
        newest: Option<usize>,
    },
    /// A generation has no such team.
    #[error("no team {team}: a generation has {teams} teams, {}; choose one of them, best or champion", places(*teams))]
    NoTeam {
        /// The requested team, from 0.
        team: usize,
        /// The number of teams.
        teams: usize,
    },
    /// The policies that the run started from are missing.
    #[error(
        "{folder} started from given policies, and no checkpoint that holds them or what came of them is left: it cannot be \
         played again up to generation {generation}"
    )]
    NoStart {
        /// The run directory.
        folder: String,
        /// The requested generation, from 0.
        generation: usize,
    },
    /// Retraining gives another result than the run's metrics.
    #[error(
        "{folder}: trained again, the {who} of trial {trial}, generation {generation} has G = {found}, but metrics.csv \
         says {expected}: it was made with another config or another version of this program; repeat the run, then \
         replay it"
    )]
    Differs {
        /// The run directory.
        folder: String,
        /// Whose G differs: "best team" or "champion".
        who: &'static str,
        /// The trial, from 0.
        trial: usize,
        /// The generation, from 0.
        generation: usize,
        /// G of the replay.
        found: f64,
        /// G in the run's metrics.
        expected: f64,
    },
    /// The caller's `watch` stopped the replay.
    #[error("stopped")]
    Stopped,
}

/// Formats a count and its indices as "3 trials, 0 to 2" or "1 trial, 0".
pub(crate) fn numbered(count: usize, what: &str) -> String {
    format!("{}, {}", map::count(count, what), places(count))
}

/// Formats the indices of a count as "0 to 2" or "0".
fn places(count: usize) -> String {
    if count > 1 { format!("0 to {}", count - 1) } else { "0".into() }
}

/// The team of a generation to replay.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Which {
    /// The team with the largest G; the first one if several are equal.
    #[default]
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
    /// The leader to whose group each agent belongs for Df, or [`credit::NOBODY`]. `[agents]`.
    pub owner: Vec<u32>,
    /// The leaders of each follower at each step, as [`credit::lead`] writes them. Empty unless the run's fitness is
    /// Dt.
    pub led: Vec<u32>,
    /// The step at which each POI was first observed, `[pois]`.
    pub observed: Vec<Option<usize>>,
    /// Whether the comparison of the run's files with their digests was skipped.
    pub unverified: bool,
}

/// The metrics of one trial.
pub struct History {
    /// G of the best team and of the champion, `[generations]`; none for a missing row.
    rows: Vec<Option<[f64; 2]>>,
}

impl History {
    /// Reads one trial's G by generation.
    ///
    /// # Errors
    /// The metrics cannot be read.
    pub fn read(
        folder: &Path,
        config: &Config,
        trial: usize,
        verification: Verification,
    ) -> Result<History, ReadError> {
        let all = History::all(folder, config, verification)?;
        Ok(all.into_iter().nth(trial).unwrap_or(History { rows: vec![] }))
    }

    /// Reads every trial's G by generation, `[trials]`.
    ///
    /// # Errors
    /// The metrics cannot be read.
    pub fn all(folder: &Path, config: &Config, verification: Verification) -> Result<Vec<History>, ReadError> {
        let mut all: Vec<History> = (0..config.learning.trials).map(|_| History { rows: vec![] }).collect();
        runs::metrics(folder, config, verification, |row| {
            let rows = &mut all[row.trial].rows;
            if rows.len() <= row.generation {
                rows.resize(row.generation + 1, None);
            }
            rows[row.generation] = Some([row.best_g, row.champion_g]);
        })?;
        Ok(all)
    }

    /// Returns the newest generation that has a row.
    pub fn newest(&self) -> Option<usize> {
        self.rows.iter().rposition(Option::is_some)
    }

    /// Returns the largest G of a best team or champion in any generation; 0 without rows.
    pub fn most(&self) -> f64 {
        self.rows.iter().flatten().flatten().copied().fold(0.0, f64::max)
    }

    /// Returns a generation's G of the champion if `which` requests it, otherwise of the best team. None without a row.
    pub fn get(&self, generation: usize, which: Which) -> Option<f64> {
        let [best, champion] = self.rows.get(generation).copied().flatten()?;
        Some(if which == Which::Champion { champion } else { best })
    }
}

/// Returns the trials with the largest and the smallest G of a generation. Ties go to the lower index.
///
/// G is the champion's if `which` requests it, otherwise the best team's. Without a generation, the newest that all
/// trials have is used.
///
/// # Errors
/// The run cannot be read or lacks the generation.
pub fn extreme_trials(
    folder: &Path,
    config: &Config,
    generation: Option<usize>,
    which: Which,
    verification: Verification,
) -> Result<[usize; 2], ReplayError> {
    let all = History::all(folder, config, verification)?;
    let newest = all.iter().map(History::newest).min().flatten();
    let generation = generation.or(newest).unwrap_or(0);
    let g = all.iter().map(|history| history.get(generation, which)).collect::<Option<Vec<f64>>>();
    let Some(g) = g else {
        let trial = all.iter().position(|history| history.get(generation, which).is_none()).unwrap_or(0);
        let folder = folder.escaped().to_string();
        return Err(ReplayError::NoGeneration { folder, trial, generation, newest: all[trial].newest() });
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
    let name = || folder.escaped().to_string();
    let config = runs::config(folder, verification)?;
    let trials = config.learning.trials;
    if trial >= trials {
        return Err(ReplayError::NoTrial { folder: name(), trial, trials });
    }
    let teams = generations.iter().map(|&generation| config.at(generation).learning.teams()).min().unwrap_or(0);
    if let Which::Number(team) = which
        && team >= teams
    {
        return Err(ReplayError::NoTeam { team, teams });
    }
    let rows = History::read(folder, &config, trial, verification)?;
    let newest = rows.newest();
    for &generation in generations {
        if rows.get(generation, which).is_none() {
            return Err(ReplayError::NoGeneration { folder: name(), trial, generation, newest });
        }
    }
    let mut order: Vec<usize> = (0..generations.len()).collect();
    order.sort_by_key(|&index| generations[index]);
    let mut played: Vec<Option<Replayed>> = generations.iter().map(|_| None).collect();
    let mut trainer = Trainer::of_trial(&config.validate().map_err(BackendError::from)?, trial);
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
            return Err(ReplayError::NoStart { folder: name(), generation });
        }
        while trainer.generation(0) < wanted {
            if !watch(trainer.generation(0)) {
                return Err(ReplayError::Stopped);
            }
            trainer.advance(backend)?;
        }
        let (found, g) = match which {
            Which::Champion => {
                let found = champion(&config.at(generation), &mut trainer, trial, backend)?;
                let g = found.team_g;
                (found, g)
            }
            _ => team(&config.at(generation), &mut trainer, trial, which, backend)?,
        };
        let expected = rows.get(generation, which).unwrap_or(f64::NAN);
        if g != expected {
            let who = if which == Which::Champion { "champion" } else { "best team" };
            return Err(ReplayError::Differs { folder: name(), who, trial, generation, found: g, expected });
        }
        played[index] = Some(Replayed { unverified: verification.is_skipped(), ..found });
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
        if !found.is_of(config) || found.snapshot.generation != generation {
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

/// Plays the current generation of a trainer with a single trial, and traces its best team.
///
/// # Errors
/// The backend fails.
pub fn best(
    config: &Config,
    trainer: &mut Trainer,
    trial: usize,
    backend: &mut dyn Backend,
) -> Result<Replayed, BackendError> {
    Ok(team(config, trainer, trial, Which::Best, backend)?.0)
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
    let learning = &config.learning;
    let (generation, world) = (trainer.generation(0), trainer.world(0).clone());
    let teams = evolve::teams_of(learning, trial, generation, world.leaders());
    let cast = Episodes::new(config, &world, trial, generation, trainer.weights(0, 0)?, &teams);
    let g = cast.play(backend)?;
    let first_best = (0..g.len()).reduce(|a, b| if g[b] > g[a] { b } else { a }).unwrap_or(0);
    let team = if let Which::Number(team) = which { team } else { first_best };
    let played = cast.trace(team, backend)?;
    Ok((Replayed { trial, generation, which, team, team_g: g[team], ..played }, g[first_best]))
}

/// Plays and traces the champion of the generation that a trainer with a single trial has just finished. `config` is
/// the config of that generation.
fn champion(
    config: &Config,
    trainer: &mut Trainer,
    trial: usize,
    backend: &mut dyn Backend,
) -> Result<Replayed, BackendError> {
    // A champion plays with the starts of the next generation, but in the world of its own generation.
    let (next, world) = (trainer.generation(0), World::new(config));
    let population = config.learning.population;
    let teams = vec![population as u32; world.leaders()];
    let cast = Episodes::new(config, &world, trial, next, trainer.weights(0, 0)?, &teams);
    let team_g = cast.play(backend)?[0];
    let played = cast.trace(0, backend)?;
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
            evolve::places(&config.learning, trial, generation, episode, world, &mut starts);
            starts
        };
        let starts = (0..config.learning.episodes_per_team).map(starts).collect();
        Episodes { config, world, weights, teams, starts }
    }

    /// Returns the group of some of the teams in one episode, with sightings if the fitness needs them.
    fn group<'b>(&'b self, episode: usize, teams: &'b [u32]) -> Group<'b> {
        let learning = &self.config.learning;
        Group {
            world: self.world,
            starts: &self.starts[episode],
            weights: self.weights.into(),
            policies: learning.slots(),
            sharing: learning.sharing,
            teams,
            fitnesses: std::slice::from_ref(&learning.fitness),
        }
    }

    /// Returns the mean G of every team over all episodes, `[teams]`.
    fn play(&self, backend: &mut dyn Backend) -> Result<Vec<f64>, BackendError> {
        let groups: Vec<_> =
            (0..self.starts.len()).map(|episode| Group { fitnesses: &[], ..self.group(episode, self.teams) }).collect();
        let mut observed = vec![0; self.teams.len() / self.world.leaders()];
        for scores in backend.play(&groups)? {
            observed.iter_mut().zip(scores.observed).for_each(|(sum, observed)| *sum += observed);
        }
        let whole = (self.world.pois.len() * groups.len()) as f64;
        Ok(observed.into_iter().map(|observed| f64::from(observed) / whole).collect())
    }

    /// Plays a team's first episode again and traces it.
    fn trace(&self, team: usize, backend: &mut dyn Backend) -> Result<Replayed, BackendError> {
        let leaders = self.world.leaders();
        let played = one(&self.group(0, &self.teams[team * leaders..(team + 1) * leaders]), backend)?;
        Ok(Replayed { episodes: self.starts.len(), ..played })
    }
}

/// Plays and traces a group of a single team. `led` is filled only if Dt is among the group's fitnesses.
///
/// # Errors
/// The backend fails.
pub fn one(group: &Group<'_>, backend: &mut dyn Backend) -> Result<Replayed, BackendError> {
    let (world, trace) = (group.world, backend.trace(group)?);
    let episode = trace.episode(world, 0);
    let scores = Credit::default().all(&episode, world);
    let mut owner = Vec::new();
    credit::assign(&episode.seen, world, &mut owner);
    let mut led = Vec::new();
    credit::lead(&episode.sights, world, &mut led);
    let observed = credit::observed_at(episode.sets, world);
    let team_g = f64::from(scores.observed) / world.pois.len() as f64;
    // POIs are drawn where this episode had them.
    let pois = group.moved_pois().unwrap_or(&world.pois).to_vec();
    let world = World { pois, ..world.clone() };
    let (trial, generation, which, team, episodes, unverified) = (0, 0, Which::Champion, 0, 1, false);
    Ok(Replayed {
        trial,
        generation,
        which,
        team,
        team_g,
        episodes,
        scores,
        owner,
        led,
        observed,
        trace,
        world,
        unverified,
    })
}

/// Counts the observers in a set.
fn near(world: &World, sets: &Strided<'_>, set: usize) -> u32 {
    let words = world.constants.words as usize;
    world.rule.count((set * words..(set + 1) * words).map(|word| sets.get(word)))
}

/// An episode without some agents: the same motion, and what the others observe.
pub struct Counterfactual<'a> {
    world: &'a World,
    /// The remaining agents at each POI after each step, `[steps][pois][words]`.
    sets: Vec<u32>,
    /// The step at which each POI would be observed, `[pois]`.
    pub observed: Vec<Option<usize>>,
}

impl Counterfactual<'_> {
    /// Returns the observation steps and the observers near each POI, base64 of u16 `[shown][pois]`.
    fn json(&self, shown: &[usize]) -> serde_json::Value {
        let (sets, pois) = (Strided { words: &self.sets, stride: 1, offset: 0 }, self.world.pois.len());
        let count = |step: usize, poi| step.checked_sub(1).map_or(0, |step| near(self.world, &sets, step * pois + poi));
        let counts = shown.iter().flat_map(|&step| (0..pois).map(move |poi| count(step, poi) as u16));
        let near: Vec<u8> = counts.flat_map(u16::to_le_bytes).collect();
        json!({ "observed": self.observed, "near": BASE64_STANDARD.encode(near) })
    }
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
        format!("trial {}, generation {}", self.trial, self.generation)
    }

    /// Counts the observers within the observation radius of a POI after a step. At the start the count is 0.
    pub fn near(&self, step: usize, poi: usize) -> u32 {
        let sets = Strided { words: &self.trace.sets, stride: 1, offset: 0 };
        step.checked_sub(1).map_or(0, |step| near(&self.world, &sets, step * self.world.pois.len() + poi))
    }

    /// Removes a leader from the record, and with `group` also the followers that it led. All others move as they did.
    pub fn without(&self, leader: usize, group: bool) -> Counterfactual<'_> {
        let Replayed { world, trace, owner, led, .. } = self;
        let (pois, words, leaders) = (world.pois.len(), world.constants.words as usize, world.leaders());
        let follows = |step: usize, agent: usize| match agent.checked_sub(leaders) {
            None => false,
            Some(follower) if !led.is_empty() => credit::leads(led, world, step, follower, leader),
            Some(_) => owner[agent] as usize == leader,
        };
        let mut sets = trace.sets.clone();
        for (at, set) in sets.chunks_exact_mut(words).enumerate() {
            let removed = (0..world.agents()).filter(|&agent| agent == leader || group && follows(at / pois, agent));
            removed.for_each(|agent| set[agent / 32] &= !(1 << (agent % 32)));
        }
        let observed = credit::observed_at(Strided { words: &sets, stride: 1, offset: 0 }, world);
        Counterfactual { world, sets, observed }
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
                .find(|&leader| credit::leads(&self.led, &self.world, step.saturating_sub(1), follower, leader)),
            None => (self.owner[agent] != credit::NOBODY).then_some(self.owner[agent] as usize),
        }
    }

    /// Returns the team at `place` steps from the start, with its trails.
    fn team(&self, place: f64) -> Team {
        // Limits the points of all trails together, for long episodes of many agents.
        const POINTS: usize = 40_000;
        let (step, part) = (place as usize, place.fract());
        let world = &self.world;
        let shown = self.shown((POINTS / world.agents().max(1)).clamp(30, 400));
        let at = |step: usize, agent: usize| Vec2::from(self.position(step, agent)).as_dvec2();
        let toward = |step: usize, agent: usize| Vec2::from(self.heading(step, agent)).as_dvec2();
        let agent = |agent: usize| {
            let next = (step + 1).min(world.steps());
            let mut trail: Vec<_> = shown.iter().filter(|&&shown| shown <= step).map(|&step| at(step, agent)).collect();
            let place = at(step, agent).lerp(at(next, agent), part);
            trail.push(place);
            let group = self.group(step, agent);
            let counts = world.rule.counts(agent);
            Marker { place, heading: toward(step, agent).lerp(toward(next, agent), part), group, counts, trail }
        };
        // The POIs that were observed before this step decide which POIs are open.
        let before: Vec<bool> = self.observed.iter().map(|at| at.is_some_and(|at| at < step.max(1))).collect();
        let poi = |(poi, place): (usize, &Vec2)| {
            let (near, needed) = (self.near(step, poi), world.coupling[poi]);
            let observed = self.observed[poi].filter(|&observed| observed <= step);
            Poi {
                place: place.as_dvec2(),
                // An observed POI needs no agents any more.
                label: match observed {
                    Some(observed) => map::observed_label(&world.rule, poi, observed),
                    None => map::poi_label(&world.rule, poi, format!("{near}/{needed}")),
                },
                share: Some(if observed.is_some() { 1.0 } else { f64::from(near) / f64::from(needed) }),
                observed: observed.is_some(),
                open: world.rule.is_open(poi, step.max(1) as u32, &before),
            }
        };
        Team {
            leaders: world.leaders(),
            agents: (0..world.agents()).map(agent).collect(),
            pois: world.pois.iter().enumerate().map(poi).collect(),
        }
    }

    /// Describes the state after a step in a sentence.
    fn say(&self, step: usize) -> String {
        const MOST: usize = 12;
        let (world, pois) = (&self.world, self.world.pois.len());
        let times = self.observed.iter().enumerate().filter_map(|(poi, observed)| Some((poi, (*observed)?)));
        let times: Vec<_> = times.filter(|&(_, observed)| observed <= step).collect();
        let list: Vec<_> = times.iter().take(MOST).map(|(poi, step)| format!("POI {poi} at step {step}")).collect();
        let more = if times.len() > MOST { " and more" } else { "" };
        format!(
            "{} of {}, step {step} of {}: {} of {pois} POIs observed{}{}{more}, by a team of {} and {}.",
            self.name(),
            self.place(),
            world.steps(),
            times.len(),
            if list.is_empty() { "" } else { ": " },
            list.join(", "),
            map::count(world.leaders(), "leader"),
            map::count(world.followers(), "follower"),
        )
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

/// Returns a page that plays episodes of one run side by side. `name` is the run's name.
pub fn page(name: &str, config: &Config, played: &[Replayed]) -> String {
    // Inside a script element, only "<" could end it early.
    let data = data(name, config, played).to_string().replace('<', "\\u003c");
    include_str!("replay.html").replacen("\"STAGE\"", STAGE, 1).replacen("\"DATA\"", &data, 1)
}

/// The script that draws episodes. Every page that shows them includes it.
pub const STAGE: &str = include_str!("stage.js");

/// Returns [`data`], and per episode D++, the senses and actions of leaders, and what the team observes without them.
///
/// Per episode that adds `dpp`, `[leaders]`; `senses`, base64 of f32 `[shown][leaders][8 inputs, 2 outputs]`; and
/// `without`, `[leaders]`. Its entries `alone` and `group` (with the followers that the leader led) have `observed` and
/// `near` like the episode. Very long episodes have neither of the last two.
pub fn detailed(name: &str, config: &Config, played: &[Replayed]) -> serde_json::Value {
    let mut data = data(name, config, played);
    for (played, episode) in played.iter().zip(data["episodes"].as_array_mut().into_iter().flatten()) {
        let shown: Vec<usize> =
            episode["shown"].as_array().into_iter().flatten().flat_map(|step| Some(step.as_u64()? as usize)).collect();
        let (leaders, pois) = (played.world.leaders(), played.world.pois.len());
        episode["dpp"] = json!(played.scores.dpp);
        if shown.len() * leaders * (INPUTS + OUTPUTS) * size_of::<f32>() <= DETAIL_BYTES {
            let moments = shown.iter().flat_map(|&step| (0..leaders).map(move |leader| (step, leader)));
            let senses = moments.flat_map(|(step, leader)| {
                let moment = played.trace.moment(step, 0, leader);
                moment.inputs.iter().chain(&moment.outputs).flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>()
            });
            episode["senses"] = BASE64_STANDARD.encode(senses.collect::<Vec<u8>>()).into();
        }
        if shown.len() * leaders * pois * 2 * size_of::<u16>() <= DETAIL_BYTES {
            let without = (0..leaders).map(|leader| {
                let [alone, group] = [false, true].map(|group| played.without(leader, group).json(&shown));
                json!({ "alone": alone, "group": group })
            });
            episode["without"] = without.collect();
        }
    }
    data
}

/// Returns the data that a page needs to play episodes of one run.
pub fn data(name: &str, config: &Config, played: &[Replayed]) -> serde_json::Value {
    let count = played.len().max(1);
    let size = |per_agent: usize, played: &Replayed| {
        let world = &played.world;
        world.agents() * per_agent + world.pois.len() * 2 + played.led.len() / world.steps() * 4
    };
    let exact = played.iter().map(|p| (p.world.steps() + 1) * size(16, p)).sum::<usize>() <= EXACT_BYTES;
    let episodes: Vec<_> = played
        .iter()
        .map(|played| {
            let room = if exact { usize::MAX } else { MOTION_BYTES / count / size(5, played) };
            episode(played, &played.shown(room), exact)
        })
        .collect();
    let world = &config.world;
    // Moving POIs are listed where the first episode had them.
    let pois = match played.first().filter(|_| config.learning.poi_jitter > 0.0) {
        Some(first) => first.world.pois.iter().map(|poi| poi.as_dvec2().to_array()).collect(),
        None => world.pois.clone(),
    };
    let unverified = if played.iter().any(|played| played.unverified) { " (unverified)" } else { "" };
    json!({
        "run": format!("{name}{unverified}"),
        "paradigm": config.learning.paradigm,
        "fitness": config.learning.fitness,
        "map": world.map,
        "pois": pois,
        "observation_radius": world.observation_radius,
        "observers": world.observers,
        "windows": world.windows,
        "after": world.after,
        "attraction_radius": config.follow.attraction_radius,
        "dt": world.dt,
        "steps": world.steps,
        "exact": exact,
        "colors": colors(),
        "episodes": episodes,
    })
}

/// Returns the colours of leaders and their followers for light and dark backgrounds.
pub fn colors() -> serde_json::Value {
    json!({ "light": hex(&map::GROUPS), "dark": hex(&map::GROUPS_DARK) })
}

fn hex(colors: &[Color]) -> Vec<String> {
    colors.iter().map(|[r, g, b]| format!("#{r:02x}{g:02x}{b:02x}")).collect()
}

/// Returns one episode as the page reads it. Motion is base64 of little-endian numbers, `[shown][agents]`.
fn episode(played: &Replayed, shown: &[usize], exact: bool) -> serde_json::Value {
    let Replayed { world, scores, .. } = played;
    let map = world.map().to_array();
    let (mut positions, mut headings, mut near, mut led) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for &step in shown {
        // These are the groups of the step that ended here, as in `Replayed::group`.
        let words = played.led.len() / world.steps();
        let of_step = &played.led[step.saturating_sub(1) * words..][..words];
        led.extend(of_step.iter().flat_map(|word| word.to_le_bytes()));
        for agent in 0..world.agents() {
            let (place, heading) = (played.position(step, agent), played.heading(step, agent));
            if exact {
                positions.extend(place.iter().flat_map(|at| at.to_le_bytes()));
                headings.extend(heading.iter().flat_map(|at| at.to_le_bytes()));
            } else {
                let share = |axis: usize| (f64::from(place[axis]) / f64::from(map[axis]) * 65535.0).round() as u16;
                positions.extend([share(0), share(1)].iter().flat_map(|share| share.to_le_bytes()));
                let turn = libm::atan2(f64::from(heading[1]), f64::from(heading[0])) / std::f64::consts::TAU;
                headings.push((turn.rem_euclid(1.0) * 256.0).round() as u32 as u8);
            }
        }
        near.extend((0..world.pois.len()).flat_map(|poi| (played.near(step, poi) as u16).to_le_bytes()));
    }
    let owner: Vec<i64> =
        played.owner.iter().map(|&owner| if owner == credit::NOBODY { -1 } else { i64::from(owner) }).collect();
    json!({
        "trial": played.trial,
        "generation": played.generation,
        "name": played.name(),
        "team": played.team,
        "best_g": played.team_g,
        "means_of": played.episodes,
        "g": scores.g,
        "d": scores.d,
        "df": scores.df,
        "dt": scores.dt,
        "leaders": world.leaders(),
        "agents": world.agents(),
        "coupling": world.coupling,
        "owner": owner,
        "observed": played.observed,
        "shown": shown,
        "positions": BASE64_STANDARD.encode(positions),
        "headings": BASE64_STANDARD.encode(headings),
        "near": BASE64_STANDARD.encode(near),
        "led": BASE64_STANDARD.encode(led),
    })
}

/// Episodes side by side, to be drawn at any moment.
struct Screen<'a> {
    played: &'a [Replayed],
    view: Viewport,
    width: f64,
    legend: Legend,
}

impl<'a> Screen<'a> {
    const SIDE: f64 = 80.0;
    const EDGE: f64 = 2.5;
    const HEAD: f64 = 14.0;
    /// Room for the axes on the left of each map. The next one is the room below it.
    const LEFT: f64 = 8.0;
    const BELOW: f64 = 7.4;

    /// Lays out the pictures. `note` is added to the legend.
    fn new(config: &Config, played: &'a [Replayed], note: Option<String>) -> Screen<'a> {
        let view = Viewport::new(config, busy(config, played), Self::SIDE);
        let width = view.size()[0].max(60.0);
        let teams: Vec<Team> = played.iter().map(|played| played.team(played.world.steps() as f64)).collect();
        let who = if config.world.observers == Observers::All { "agents" } else { "observers" };
        let timed = played.iter().any(|played| played.world.rule.is_timed());
        let needed = played.first().and_then(|played| played.world.coupling.first()).map_or(1, |&needed| needed);
        let near = needed.saturating_sub(1).max(1);
        let who = if near == 1 { &who[..who.len() - 1] } else { who };
        let label = if timed { format!("0: {near}/{needed}: POI 0,") } else { format!("{near}/{needed}:") };
        let mut legend = view.legend(&teams, &format!("{label} {near} {who} near of {needed} needed"));
        let unverified = played.iter().any(|played| played.unverified).then(|| UNVERIFIED.to_string());
        note.into_iter().chain(unverified).for_each(|note| legend.note(note));
        Screen { played, view, width, legend }
    }

    /// Draws the picture `place` steps from the start. Motion between steps is interpolated linearly.
    fn scene(&self, place: f64) -> Scene {
        let step = place as usize;
        let columns = self.played.len().max(1) as f64;
        let whole = Self::EDGE + columns * (Self::LEFT + self.width + Self::EDGE);
        let room = whole - 2.0 * Self::EDGE;
        let below = Self::HEAD + self.view.size()[1] + Self::BELOW;
        let mut scene = Scene::new(whole, below + 1.0 + self.legend.height(room));
        let mut said = Vec::new();
        for (column, played) in self.played.iter().enumerate() {
            let left = Self::EDGE + Self::LEFT + column as f64 * (Self::LEFT + self.width + Self::EDGE);
            let pois = played.world.pois.len();
            let by_now = played.observed.iter().flatten().filter(|&&observed| observed <= step).count();
            let steps = played.world.steps();
            scene.bold([left, 4.0], played.name(), 3.2, Anchor::Start, BLACK);
            scene.text([left, 7.6], played.place(), 2.6, Anchor::Start, FAINT);
            let state = format!("step {step} of {steps}   POIs observed: {by_now} of {pois}");
            scene.text([left, 11.2], state, 2.6, Anchor::Start, FAINT);
            let view = self.view.moved_to([left, Self::HEAD]);
            view.draw(&mut scene, &played.team(place));
            view.rule(&mut scene);
            said.push(played.say(step));
        }
        self.legend.draw(&mut scene, [Self::EDGE, below + 3.8], room);
        let names: Vec<_> =
            self.played.iter().map(|played| format!("{} of {}", played.name(), played.place())).collect();
        scene.title = names.join("; ");
        scene.description = said.join(" ");
        scene
    }
}

/// Draws episodes side by side after a step, with the trails up to it.
pub fn still(config: &Config, played: &[Replayed], step: usize) -> Scene {
    Screen::new(config, played, None).scene(step as f64)
}

/// Returns the corners of the part of the map that holds all POIs and agents of all episodes.
///
/// The shorter side is at least half the longer one, as far as the map allows.
fn busy(config: &Config, played: &[Replayed]) -> [DVec2; 2] {
    let map = DVec2::from(config.world.map);
    let around = |at: DVec2, margin: f64| [at - margin, at + margin];
    let pois: Vec<DVec2> = match config.learning.poi_jitter > 0.0 {
        true => played.iter().flat_map(|played| &played.world.pois).map(|poi| poi.as_dvec2()).collect(),
        false => config.world.pois.iter().map(|&poi| poi.into()).collect(),
    };
    let pois = pois.into_iter().map(|poi| around(poi, config.world.observation_radius + 1.0));
    let agents = played.iter().flat_map(|played| &played.trace.moments);
    let agents = agents.map(|moment| around(Vec2::from(moment.position).as_dvec2(), 2.0));
    let [mut from, mut to] = pois
        .chain(agents)
        .fold([DVec2::INFINITY, DVec2::NEG_INFINITY], |[from, to], [low, high]| [from.min(low), to.max(high)]);
    for axis in 0..2 {
        let more = ((to[1 - axis] - from[1 - axis]) / 2.0 - (to[axis] - from[axis])).max(0.0) / 2.0;
        let (low, high) = (from[axis] - more, to[axis] + more);
        let shift = if low < 0.0 { -low } else { (map[axis] - high).min(0.0) };
        (from[axis], to[axis]) = ((low + shift).max(0.0), (high + shift).min(map[axis]));
    }
    [from, to]
}

/// Options of a film.
#[derive(Clone, Copy, Debug)]
pub struct Film {
    /// Width in pixels. By default the picture fits into 960 by 720 pixels.
    pub width: Option<u32>,
    /// Frames per second.
    pub fps: u32,
}

/// Default number of frames per second. The next one is the longest film in seconds; longer episodes play faster.
pub const FPS: u32 = 20;
const LONGEST: f64 = 15.0;

/// The frames of a film.
pub struct Frames<'a> {
    stage: Screen<'a>,
    /// The time of each frame, in steps from the start.
    pub places: Vec<f64>,
    per_mm: f64,
}

impl<'a> Frames<'a> {
    /// Plans the frames of these episodes.
    pub fn new(config: &Config, played: &'a [Replayed], motion: Film) -> Frames<'a> {
        let steps = played.first().map_or(0, |first| first.world.steps()) as f64;
        let seconds = steps * config.world.dt;
        let times = [1.0, 2.0, 4.0, 5.0, 8.0, 10.0, 16.0, 20.0, 32.0, 50.0];
        let faster = times.into_iter().find(|times| seconds / times <= LONGEST).unwrap_or((seconds / LONGEST).ceil());
        let each = faster / (f64::from(motion.fps) * config.world.dt);
        let places = (0..).map(|frame| f64::from(frame) * each).take_while(|&place| place < steps - 1e-6);
        let places: Vec<f64> = places.chain([steps]).collect();
        let mut note = if faster > 1.0 { format!("{faster} × as fast as it was") } else { String::new() };
        if each < 1.0 {
            note += if note.is_empty() { "" } else { "; " };
            note += "motion between steps is drawn straight";
        }
        let stage = Screen::new(config, played, Some(note).filter(|note| !note.is_empty()));
        let Scene { width, height, .. } = stage.scene(0.0);
        let per_mm = motion.width.map_or((960.0 / width).min(720.0 / height), |pixels| f64::from(pixels) / width);
        Frames { stage, places, per_mm }
    }

    /// Returns the picture at a place, and its pixels per millimetre.
    pub fn scene(&self, place: f64) -> (Scene, f64) {
        (self.stage.scene(place), self.per_mm)
    }
}

/// Returns the episodes side by side as a GIF that repeats.
///
/// # Errors
/// The encoder fails, which happens only if memory runs out.
pub fn gif(config: &Config, played: &[Replayed], motion: Film) -> std::io::Result<Vec<u8>> {
    let frames = Frames::new(config, played, motion);
    let places = &frames.places;
    let Some(&end) = places.last() else { return Ok(vec![]) };
    let picture = |place: f64| {
        let (scene, per_mm) = frames.scene(place);
        scene.pixels(per_mm)
    };
    let last = picture(end);
    // Delays are whole hundredths of a second. Rounding the cumulative time keeps the total duration right.
    let due = |index: usize| (index as u32 * 100).div_ceil(motion.fps);
    let delay = |index| if index + 1 == places.len() { 200 } else { due(index + 1) - due(index) };
    let size = [last.width() as u16, last.height() as u16];
    let pictures =
        places.iter().enumerate().map(|(index, &place)| (picture(place).data().to_vec(), delay(index) as u16));
    animate(size, last.data(), pictures)
}

/// Returns pictures of one size, in pixels, as a GIF that repeats. Each is RGBA `[height][width][4]`, with its delay in
/// hundredths of a second. The palette is computed from `last`, which should contain all colours.
///
/// # Errors
/// A picture has another size, or memory runs out.
pub fn animate(
    [width, height]: [u16; 2],
    last: &[u8],
    pictures: impl Iterator<Item = (Vec<u8>, u16)>,
) -> std::io::Result<Vec<u8>> {
    let colors = color_quant::NeuQuant::new(10, 255, last);
    let mut known = std::collections::HashMap::new();
    let mut file = Vec::new();
    {
        let failed = |error: gif::EncodingError| std::io::Error::other(error.to_string());
        let mut encoder = gif::Encoder::new(&mut file, width, height, &colors.color_map_rgb()).map_err(failed)?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
        let mut before: Vec<u8> = Vec::new();
        for (picture, delay) in pictures {
            if picture.len() != usize::from(width) * usize::from(height) * 4 {
                return Err(std::io::Error::other("a picture has another size"));
            }
            // Unchanged pixels are transparent, which compresses well. Index 255 is reserved for them.
            let color = |(at, pixel): (usize, &[u8])| {
                if before.get(4 * at..4 * at + 4) == Some(pixel) {
                    return 255;
                }
                let pixel = [pixel[0], pixel[1], pixel[2], pixel[3]];
                *known.entry(pixel).or_insert_with(|| colors.index_of(&pixel) as u8)
            };
            let buffer: Vec<u8> = picture.chunks_exact(4).enumerate().map(color).collect();
            let frame = gif::Frame {
                width,
                height,
                buffer: buffer.into(),
                transparent: Some(255),
                delay,
                ..gif::Frame::default()
            };
            encoder.write_frame(&frame).map_err(failed)?;
            before = picture;
        }
    }
    Ok(file)
}
