//! Replays: the very episode that a generation's best team was scored on.
//!
//! Training is a pure function of config and seed, and fast. So nothing of a generation needs to be kept: its trial is
//! trained again up to it (from a checkpoint where one is on the way), its teams play again, and the best one's episode
//! is traced. Its G is held against the run's `metrics.csv`.

use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use glam::{DVec2, Vec2};
use serde_json::json;

use super::map::{self, FAINT, Legend, Marker, Poi, Team, Viewport};
use super::runs::{self, ReadError};
use super::scene::{Anchor, BLACK, Color, Scene};
use crate::backend::{Backend, BackendError, Episode, Group, Need, Seen, Strided, Trace};
use crate::config::{Config, Fitness, Observers};
use crate::credit::{self, Credit, Scores};
use crate::evolve;
use crate::record::checkpoint;
use crate::record::folder::{CHECKPOINTS, POLICIES, RUN, Run};
use crate::trainer::{Snapshot, Trainer};
use crate::world::World;

/// Most bytes of motion in a page, before they are written as text (4/3 of it). What is longer is thinned out.
const MOTION_BYTES: usize = 1_300_000;
/// Most bytes of motion that is kept as the f32 that were computed.
const EXACT_BYTES: usize = 600_000;

/// Why an episode could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The run cannot be read.
    #[error(transparent)]
    Run(#[from] ReadError),
    /// Its generations could not be played.
    #[error(transparent)]
    Backend(#[from] BackendError),
    /// The run has fewer trials.
    #[error("{folder} has no trial {trial}: its config has {trials}, 0 to {}", trials - 1)]
    NoTrial {
        /// The run's.
        folder: String,
        /// The one asked for, from 0.
        trial: usize,
        /// How many it has.
        trials: usize,
    },
    /// The run has not come to the generation.
    #[error(
        "{folder}: metrics.csv has no generation {generation} of trial {trial}{}",
        newest.map_or(String::new(), |newest| format!("; the newest is {newest}: choose one up to that"))
    )]
    NoGeneration {
        /// The run's.
        folder: String,
        /// The one asked for, from 0.
        trial: usize,
        /// The one asked for, from 0.
        generation: usize,
        /// The newest that it has.
        newest: Option<usize>,
    },
    /// What it started from is not there.
    #[error(
        "{folder} started from given policies, and no checkpoint that holds them or what came of them is left: it cannot be \
         played again up to generation {generation}"
    )]
    NoStart {
        /// The run's.
        folder: String,
        /// The one asked for, from 0.
        generation: usize,
    },
    /// Trained again, it comes to something else.
    #[error(
        "{folder}: trained again, the best team of trial {trial}, generation {generation} has G = {found}, but metrics.csv \
         says {expected}: it was made with another config or another version of this program; repeat the run, then \
         replay it"
    )]
    Differs {
        /// The run's.
        folder: String,
        /// The one asked for, from 0.
        trial: usize,
        /// The one asked for, from 0.
        generation: usize,
        /// G now.
        found: f64,
        /// G as the run has it.
        expected: f64,
    },
    /// Whoever watched said stop.
    #[error("stopped")]
    Stopped,
}

/// One team's episode, with what it was worth.
pub struct Replayed {
    /// Which trial it is of.
    pub trial: usize,
    /// Which generation it is of.
    pub generation: usize,
    /// Index of the team among those of its generation.
    pub team: usize,
    /// The team's G over all its episodes, as in `metrics.csv`.
    pub best_g: f64,
    /// Episodes that the team's G is the mean of; this is the first.
    pub episodes: usize,
    /// The one that this generation played in.
    pub world: World,
    /// Of this team alone.
    pub trace: Trace,
    /// What the episode was worth.
    pub scores: Scores,
    /// The leader in whose group each agent is for Df, or [`credit::NOBODY`].
    pub owner: Vec<u32>,
    /// Where the run's fitness is Dt: whom each follower is led by at each step, as [`credit::lead`] finds it.
    pub led: Vec<u32>,
    /// The step at which each POI was observed first.
    pub observed: Vec<Option<usize>>,
}

/// The metrics of one trial.
pub struct History {
    /// By generation; none where there is no row.
    pub best_g: Vec<Option<f64>>,
}

impl History {
    /// Reads a trial's best G by generation.
    ///
    /// # Errors
    /// The metrics cannot be read.
    pub fn read(folder: &Path, config: &Config, trial: usize) -> Result<History, ReadError> {
        let mut best_g = Vec::new();
        runs::metrics(folder, config, |row| {
            if row.trial == trial {
                if best_g.len() <= row.generation {
                    best_g.resize(row.generation + 1, None);
                }
                best_g[row.generation] = Some(row.best_g);
            }
        })?;
        Ok(History { best_g })
    }

    /// The newest generation that has a row.
    pub fn newest(&self) -> Option<usize> {
        self.best_g.iter().rposition(Option::is_some)
    }

    /// The value of a generation, if it is one of those.
    pub fn get(&self, generation: usize) -> Option<f64> {
        self.best_g.get(generation).copied().flatten()
    }
}

/// Plays the best teams of some generations of a trial of a run again, in their order.
///
/// `watch` is told the generation about to be trained; false from it stops.
///
/// # Errors
/// The run cannot be read, has no such generation, or did not come to what it comes to here.
pub fn replay(
    folder: &Path,
    trial: usize,
    generations: &[usize],
    backend: &mut dyn Backend,
    watch: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Replayed>, ReplayError> {
    let name = || folder.display().to_string();
    let config = runs::config(folder)?;
    let trials = config.learning.trials;
    if trial >= trials {
        return Err(ReplayError::NoTrial { folder: name(), trial, trials });
    }
    let rows = History::read(folder, &config, trial)?;
    let newest = rows.newest();
    for &generation in generations {
        if rows.get(generation).is_none() {
            return Err(ReplayError::NoGeneration { folder: name(), trial, generation, newest });
        }
    }
    let mut order: Vec<usize> = (0..generations.len()).collect();
    order.sort_by_key(|&index| generations[index]);
    let mut played: Vec<Option<Replayed>> = generations.iter().map(|_| None).collect();
    let mut trainer = Trainer::of_trial(config.clone(), trial);
    for index in order {
        let generation = generations[index];
        // A run that started from given policies has those of generation 0.
        let next = trainer.generation(0);
        if let Some(snapshot) = nearest(folder, &config, trial, next + usize::from(next > 0)..=generation) {
            // A checkpoint of other sizes is of another config: training on from the start does without.
            let _ = trainer.restore(0, snapshot);
        } else if next == 0 && Run::read(&folder.join(RUN)).is_ok_and(|run| run.init.is_some()) {
            return Err(ReplayError::NoStart { folder: name(), generation });
        }
        while trainer.generation(0) < generation {
            if !watch(trainer.generation(0)) {
                return Err(ReplayError::Stopped);
            }
            trainer.advance(backend)?;
        }
        let found = best(&config.at(generation), &mut trainer, trial, backend)?;
        let expected = rows.get(generation).unwrap_or(f64::NAN);
        if found.best_g != expected {
            let found = found.best_g;
            return Err(ReplayError::Differs { folder: name(), trial, generation, found, expected });
        }
        played[index] = Some(found);
    }
    Ok(played.into_iter().flatten().collect())
}

/// One trial's share of the newest checkpoint of some generations, if it can be used.
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

/// Plays the teams of the generation before which a trial's trainer (of that trial alone) stands, and traces the best.
///
/// # Errors
/// The backend fails.
pub fn best(
    config: &Config,
    trainer: &mut Trainer,
    trial: usize,
    backend: &mut dyn Backend,
) -> Result<Replayed, BackendError> {
    use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
    let learning = &config.learning;
    let (generation, world) = (trainer.generation(0), trainer.world(0).clone());
    let (leaders, population) = (world.leaders(), learning.population);
    let weights = trainer.weights(0, 0)?.into();

    let teams = evolve::teams_of(learning, trial, generation, leaders);
    let starts: Vec<Vec<Vec2>> = (0..learning.episodes_per_team)
        .map(|episode| {
            let mut starts = Vec::new();
            evolve::places(learning, trial, generation, episode, &world, &mut starts);
            starts
        })
        .collect();
    let need = Need::Record;
    let group = |starts, teams| Group { world: &world, starts, weights, policies: population + 1, teams, need };
    let groups: Vec<Group<'_>> = starts.iter().map(|starts| group(starts, &teams)).collect();
    let observed: Vec<AtomicU32> = std::iter::repeat_with(AtomicU32::default).take(population).collect();
    backend.rollout(&groups, &|episode: Episode<'_>| {
        let seen = credit::observed_at(episode.sets, &world).iter().flatten().count();
        observed[episode.team].fetch_add(seen as u32, Relaxed);
    })?;
    let (mut team, mut most) = (0, 0);
    for (index, observed) in observed.iter().enumerate() {
        let observed = observed.load(Relaxed);
        if observed > most {
            (team, most) = (index, observed);
        }
    }
    let best_g = f64::from(most) / (world.pois.len() * starts.len()) as f64;
    let need = if learning.fitness == Fitness::Dt { Need::Sights } else { need };
    let shown = Group { need, ..group(&starts[0], &teams[team * leaders..(team + 1) * leaders]) };
    let played = one(&shown, backend)?;
    Ok(Replayed { trial, generation, team, best_g, episodes: starts.len(), ..played })
}

/// Plays one team, a group of its own, and traces it; who leads at each step is told where the group needs sights.
///
/// # Errors
/// The backend fails.
pub fn one(group: &Group<'_>, backend: &mut dyn Backend) -> Result<Replayed, BackendError> {
    let (world, trace) = (group.world, backend.trace(group)?);
    let whole = |words| Strided { words, stride: 1, offset: 0 };
    let (sets, seen, sights) = (whole(&trace.sets), Seen::Counts(whole(&trace.seen)), whole(&trace.sights));
    let episode = Episode { group: 0, team: 0, sets, seen, sights };
    let scores = Credit::default().all(&episode, world);
    let mut owner = Vec::new();
    credit::assign(&episode.seen, world, &mut owner);
    let mut led = Vec::new();
    credit::lead(&episode.sights, world, &mut led);
    let observed = credit::observed_at(episode.sets, world);
    let best_g = f64::from(scores.observed) / world.pois.len() as f64;
    // POIs are drawn where they were.
    let pois = group.moved_pois().unwrap_or(&world.pois).to_vec();
    let world = World { pois, ..world.clone() };
    Ok(Replayed { trial: 0, generation: 0, team: 0, best_g, episodes: 1, scores, owner, led, observed, trace, world })
}

/// Observers in one set.
fn near(world: &World, sets: &Strided<'_>, set: usize) -> u32 {
    let words = world.constants.words as usize;
    world.rule.count((set * words..(set + 1) * words).map(|word| sets.get(word)))
}

impl Replayed {
    /// Observers near a POI after a step, 0 at the start.
    pub fn near(&self, step: usize, poi: usize) -> u32 {
        let sets = Strided { words: &self.trace.sets, stride: 1, offset: 0 };
        step.checked_sub(1).map_or(0, |step| near(&self.world, &sets, step * self.world.pois.len() + poi))
    }

    fn position(&self, step: usize, agent: usize) -> [f32; 2] {
        self.trace.moment(step, 0, agent).position
    }

    fn heading(&self, step: usize, agent: usize) -> [f32; 2] {
        self.trace.moment(step, 0, agent).heading
    }

    /// The leader in whose group an agent is after a step: for Dt the first of those that lead it then, else for Df.
    fn group(&self, step: usize, agent: usize) -> Option<usize> {
        let leaders = self.world.leaders();
        match agent.checked_sub(leaders).filter(|_| !self.led.is_empty()) {
            // The start is like the first step, which nobody has moved before.
            Some(follower) => (0..leaders)
                .find(|&leader| credit::leads(&self.led, &self.world, step.saturating_sub(1), follower, leader)),
            None => (self.owner[agent] != credit::NOBODY).then_some(self.owner[agent] as usize),
        }
    }

    /// The team `place` steps from the start, with its trails up to there.
    fn team(&self, place: f64) -> Team {
        // Long trails of many agents are drawn by fewer points.
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
        // What a step finds observed.
        let before: Vec<bool> = self.observed.iter().map(|at| at.is_some_and(|at| at < step.max(1))).collect();
        let poi = |(poi, place): (usize, &Vec2)| {
            let (near, needed) = (self.near(step, poi), world.coupling[poi]);
            Poi {
                place: place.as_dvec2(),
                label: map::poi_label(&world.rule, poi, format!("{near}/{needed}")),
                share: Some(f64::from(near) / f64::from(needed)),
                observed: self.observed[poi].is_some_and(|observed| observed <= step),
                open: world.rule.is_open(poi, step.max(1) as u32, &before),
            }
        };
        Team {
            leaders: world.leaders(),
            agents: (0..world.agents()).map(agent).collect(),
            pois: world.pois.iter().enumerate().map(poi).collect(),
        }
    }

    /// What is to be seen of it after a step, in words.
    fn say(&self, step: usize) -> String {
        const MOST: usize = 12;
        let (world, pois) = (&self.world, self.world.pois.len());
        let times = self.observed.iter().enumerate().filter_map(|(poi, observed)| Some((poi, (*observed)?)));
        let times: Vec<_> = times.filter(|&(_, observed)| observed <= step).collect();
        let list: Vec<_> = times.iter().take(MOST).map(|(poi, step)| format!("POI {poi} at step {step}")).collect();
        let more = if times.len() > MOST { " and more" } else { "" };
        format!(
            "Generation {}, step {step} of {}: {} of {pois} POIs observed{}{}{more}, by a team of {} and {}.",
            self.generation,
            world.steps(),
            times.len(),
            if list.is_empty() { "" } else { ": " },
            list.join(", "),
            map::count(world.leaders(), "leader"),
            map::count(world.followers(), "follower"),
        )
    }

    /// Steps that a page or a trail shows, if it has room for so many.
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

/// A page that plays episodes of one run, side by side; `name` is the run's.
pub fn page(name: &str, config: &Config, played: &[Replayed]) -> String {
    // Inside a script element, only "<" could end it early.
    let data = data(name, config, played).to_string().replace('<', "\\u003c");
    include_str!("replay.html").replacen("\"STAGE\"", STAGE, 1).replacen("\"DATA\"", &data, 1)
}

/// The script that draws episodes, on this page and wherever else they are shown.
pub const STAGE: &str = include_str!("stage.js");

/// What a page needs to play episodes of one run, side by side.
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
    // Where they move, they are where the first episode has them.
    let pois = match played.first().filter(|_| config.learning.poi_jitter > 0.0) {
        Some(first) => first.world.pois.iter().map(|poi| poi.as_dvec2().to_array()).collect(),
        None => world.pois.clone(),
    };
    json!({
        "run": name,
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

/// The colours of leaders and their followers, on a light and on a dark ground.
pub fn colors() -> serde_json::Value {
    json!({ "light": hex(&map::GROUPS), "dark": hex(&map::GROUPS_DARK) })
}

fn hex(colors: &[Color]) -> Vec<String> {
    colors.iter().map(|[r, g, b]| format!("#{r:02x}{g:02x}{b:02x}")).collect()
}

/// One episode as the page reads it: motion as base64 of little-endian numbers, `[shown][agents]`.
fn episode(played: &Replayed, shown: &[usize], exact: bool) -> serde_json::Value {
    let Replayed { world, scores, .. } = played;
    let map = world.map().to_array();
    let (mut positions, mut headings, mut near, mut led) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for &step in shown {
        // Of the step that led here, as `Replayed::group` has it.
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
        "team": played.team,
        "best_g": played.best_g,
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

/// Episodes side by side, to be drawn at any of their moments.
struct Screen<'a> {
    played: &'a [Replayed],
    view: Viewport,
    width: f64,
    legend: Legend,
}

impl<'a> Screen<'a> {
    const SIDE: f64 = 80.0;
    const EDGE: f64 = 2.5;
    const HEAD: f64 = 9.0;

    /// `note` stands below the pictures, among what their signs mean.
    fn new(config: &Config, played: &'a [Replayed], note: Option<String>) -> Screen<'a> {
        let view = Viewport::new(config, busy(config, played), Self::SIDE);
        let width = view.size()[0].max(60.0);
        let teams: Vec<Team> = played.iter().map(|played| played.team(played.world.steps() as f64)).collect();
        let who = if config.world.observers == Observers::All { "agents" } else { "observers" };
        let timed = played.iter().any(|played| played.world.rule.is_timed());
        let label = if timed { "0: 2/3: POI 0," } else { "2/3:" };
        let mut legend = view.legend(&teams, &format!("{label} 2 {who} near of 3 needed"));
        note.into_iter().for_each(|note| legend.note(note));
        Screen { played, view, width, legend }
    }

    /// The picture `place` steps from the start; between steps, motion is drawn straight.
    fn scene(&self, place: f64) -> Scene {
        let step = place as usize;
        let columns = self.played.len().max(1) as f64;
        let whole = Self::EDGE + columns * (self.width + Self::EDGE);
        let room = whole - 2.0 * Self::EDGE;
        let below = Self::HEAD + self.view.size()[1];
        let mut scene = Scene::new(whole, below + 1.0 + self.legend.height(room));
        let mut said = Vec::new();
        for (column, played) in self.played.iter().enumerate() {
            let left = Self::EDGE + column as f64 * (self.width + Self::EDGE);
            let pois = played.world.pois.len();
            let by_now = played.observed.iter().flatten().filter(|&&observed| observed <= step).count();
            let steps = played.world.steps();
            scene.bold([left, 4.0], format!("Generation {}", played.generation), 3.2, Anchor::Start, BLACK);
            let state = format!("step {step} of {steps}   POIs observed: {by_now} of {pois}");
            scene.text([left, 7.6], state, 2.6, Anchor::Start, FAINT);
            self.view.moved_to([left, Self::HEAD]).draw(&mut scene, &played.team(place));
            said.push(played.say(step));
        }
        self.legend.draw(&mut scene, [Self::EDGE, below + 3.8], room);
        scene.title = match self.played {
            [one] => format!("The best team of generation {}", one.generation),
            all => {
                let generations: Vec<_> = all.iter().map(|played| played.generation.to_string()).collect();
                format!("The best teams of generations {}, side by side", generations.join(" and "))
            }
        };
        scene.description = said.join(" ");
        scene
    }
}

/// Episodes side by side after a step, each with its trails up to there.
pub fn still(config: &Config, played: &[Replayed], step: usize) -> Scene {
    Screen::new(config, played, None).scene(step as f64)
}

/// The part of the map, from corner to corner, where anything happens in any of the episodes, at least half as high as
/// wide or the other way round.
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

/// How a moving picture is made: pixels across, and pictures a second.
#[derive(Clone, Copy, Debug)]
pub struct Film {
    /// As many as fit into 960 by 720 pixels where it is not given.
    pub width: Option<u32>,
    /// Pictures a second.
    pub fps: u32,
}

/// Pictures a second, and the longest that a moving picture lasts, in seconds; longer episodes play faster.
pub const FPS: u32 = 20;
const LONGEST: f64 = 15.0;

/// The pictures of a moving picture, one after the other.
pub struct Frames<'a> {
    stage: Screen<'a>,
    /// Steps from the start, of each picture.
    pub places: Vec<f64>,
    per_mm: f64,
}

impl<'a> Frames<'a> {
    /// Frames of these episodes, as fast as `motion` says.
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

    /// One of the pictures, with its pixels a millimetre.
    pub fn scene(&self, place: f64) -> (Scene, f64) {
        (self.stage.scene(place), self.per_mm)
    }
}

/// Episodes side by side as a GIF that repeats.
///
/// # Errors
/// The encoder refused, which it does for want of memory alone.
pub fn gif(config: &Config, played: &[Replayed], motion: Film) -> std::io::Result<Vec<u8>> {
    let frames = Frames::new(config, played, motion);
    let picture = |place: f64| {
        let (scene, per_mm) = frames.scene(place);
        scene.pixels(per_mm)
    };
    let places = &frames.places;
    let Some(&end) = places.last() else { return Ok(vec![]) };
    // The last picture has all the colours there are.
    let last = picture(end);
    let colors = color_quant::NeuQuant::new(10, 255, last.data());
    let mut known = std::collections::HashMap::new();
    let (width, height) = (last.width() as u16, last.height() as u16);
    let mut file = Vec::new();
    {
        let failed = |error: gif::EncodingError| std::io::Error::other(error.to_string());
        let mut encoder = gif::Encoder::new(&mut file, width, height, &colors.color_map_rgb()).map_err(failed)?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
        let mut before: Vec<u8> = Vec::new();
        for (index, &place) in places.iter().enumerate() {
            let pixmap = picture(place);
            // What stays as it was is transparent, which packs well; index 255 is no colour.
            let color = |(at, pixel): (usize, &[u8])| {
                if before.get(4 * at..4 * at + 4) == Some(pixel) {
                    return 255;
                }
                let pixel = [pixel[0], pixel[1], pixel[2], pixel[3]];
                *known.entry(pixel).or_insert_with(|| colors.index_of(&pixel) as u8)
            };
            let buffer: Vec<u8> = pixmap.data().chunks_exact(4).enumerate().map(color).collect();
            // Hundredths of a second, so that the pictures together take as long as they should.
            let due = |index: usize| (index as u32 * 100).div_ceil(motion.fps);
            let delay = if index + 1 == places.len() { 200 } else { due(index + 1) - due(index) };
            let frame = gif::Frame {
                width,
                height,
                buffer: buffer.into(),
                transparent: Some(255),
                delay: delay as u16,
                ..gif::Frame::default()
            };
            encoder.write_frame(&frame).map_err(failed)?;
            before = pixmap.data().to_vec();
        }
    }
    Ok(file)
}
