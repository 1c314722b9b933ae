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

use super::runs::{self, RunError};
use super::scene::{Anchor, BLACK, COLORS, Color, Fill, GREY, LIGHT, Pen, Scene, WHITE};
use crate::backend::{Backend, BackendError, Episode, Group, Strided, Trace};
use crate::config::Config;
use crate::credit::{self, Credit, Scores};
use crate::evolve::{self, Key, Purpose};
use crate::record::checkpoint::{self, Snapshot};
use crate::record::folder::{CHECKPOINTS, POLICIES};
use crate::trainer::Trainer;
use crate::world::World;

/// Most bytes of motion in a page, before they are written as text (4/3 of it). What is longer is thinned out.
const MOTION_BYTES: usize = 1_300_000;
/// Most bytes of motion that is kept as the f32 that were computed.
const EXACT_BYTES: usize = 600_000;

/// Why an episode could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error("{folder} has no trial {trial}: its config has {trials}, 0 to {}", trials - 1)]
    NoTrial { folder: String, trial: usize, trials: usize },
    #[error(
        "{folder}: metrics.csv has no generation {generation} of trial {trial}{}",
        newest.map_or(String::new(), |newest| format!("; the newest is {newest}: choose one up to that, or finish the run with --resume"))
    )]
    NoGeneration { folder: String, trial: usize, generation: usize, newest: Option<usize> },
    #[error(
        "{folder}: trained again, the best team of trial {trial}, generation {generation} has G = {found}, but metrics.csv \
         says {expected}: it was made with another config or another version of this program; repeat the run, then \
         replay it"
    )]
    Differs { folder: String, trial: usize, generation: usize, found: f64, expected: f64 },
    #[error("stopped")]
    Stopped,
}

/// One team's episode, with what it was worth.
pub struct Played {
    pub trial: usize,
    pub generation: usize,
    /// Index of the team among those of its generation.
    pub team: usize,
    /// The team's G over all its episodes, as in `metrics.csv`.
    pub best_g: f64,
    /// Episodes that the team's G is the mean of; this is the first.
    pub episodes: usize,
    pub world: World,
    /// Of this team alone.
    pub trace: Trace,
    pub scores: Scores,
    /// The leader in whose group each agent is for Df, or [`credit::NOBODY`].
    pub owner: Vec<u32>,
    /// The step at which each POI was observed first.
    pub observed: Vec<Option<usize>>,
}

/// The metrics of one trial.
pub struct Rows {
    pub best_g: Vec<Option<f64>>,
}

impl Rows {
    /// Reads a trial's best G by generation.
    ///
    /// # Errors
    /// The metrics cannot be read.
    pub fn read(folder: &Path, config: &Config, trial: usize) -> Result<Rows, RunError> {
        let mut best_g = Vec::new();
        runs::metrics(folder, config, |row| {
            if row.trial == trial {
                if best_g.len() <= row.generation {
                    best_g.resize(row.generation + 1, None);
                }
                best_g[row.generation] = Some(row.best_g);
            }
        })?;
        Ok(Rows { best_g })
    }

    /// The newest generation that has a row.
    pub fn newest(&self) -> Option<usize> {
        self.best_g.iter().rposition(Option::is_some)
    }

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
) -> Result<Vec<Played>, ReplayError> {
    let name = || folder.display().to_string();
    let config = runs::config(folder)?;
    let trials = config.learning.trials;
    if trial >= trials {
        return Err(ReplayError::NoTrial { folder: name(), trial, trials });
    }
    let rows = Rows::read(folder, &config, trial)?;
    let newest = rows.newest();
    for &generation in generations {
        if rows.get(generation).is_none() {
            return Err(ReplayError::NoGeneration { folder: name(), trial, generation, newest });
        }
    }
    let mut order: Vec<usize> = (0..generations.len()).collect();
    order.sort_by_key(|&index| generations[index]);
    let mut played: Vec<Option<Played>> = generations.iter().map(|_| None).collect();
    let mut trainer = Trainer::of_trial(config.clone(), trial);
    for index in order {
        let generation = generations[index];
        if let Some(snapshot) = nearest(folder, &config, trial, trainer.generation(0) + 1..=generation) {
            // A checkpoint of other sizes is of another config: training on from the start does without.
            let _ = trainer.restore(0, snapshot);
        }
        while trainer.generation(0) < generation {
            if !watch(trainer.generation(0)) {
                return Err(ReplayError::Stopped);
            }
            trainer.advance(backend)?;
        }
        let found = play_best(&config, &mut trainer, trial, backend)?;
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

/// Plays the teams of the generation before which a trial's trainer stands, and traces the best.
fn play_best(
    config: &Config,
    trainer: &mut Trainer,
    trial: usize,
    backend: &mut dyn Backend,
) -> Result<Played, ReplayError> {
    use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
    let learning = &config.learning;
    let (generation, world) = (trainer.generation(0), trainer.world(0).clone());
    let (leaders, population) = (world.leaders(), learning.population);
    let weights = trainer.weights(0, 0)?.into();

    let mut teams = vec![0; population * leaders];
    evolve::form_teams(Key::new(learning.seed, trial, Purpose::Teams), generation, leaders, &mut teams);
    let key = Key::new(learning.seed, trial, Purpose::Starts);
    let starts: Vec<Vec<Vec2>> = (0..learning.episodes_per_team)
        .map(|episode| {
            let mut starts = Vec::new();
            evolve::jitter_starts(key, generation, episode, &world, learning.start_jitter, &mut starts);
            starts
        })
        .collect();
    let group = |starts, teams| Group { world: &world, starts, weights, policies: population + 1, teams };
    let groups: Vec<Group<'_>> = starts.iter().map(|starts| group(starts, &teams)).collect();
    let observed: Vec<AtomicU32> = std::iter::repeat_with(AtomicU32::default).take(population).collect();
    backend.rollout(&groups, &|episode: Episode<'_>| {
        let seen = first_observed(&world, &episode.sets).iter().flatten().count();
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

    let trace = backend.trace(&group(&starts[0], &teams[team * leaders..(team + 1) * leaders]))?;
    let whole = |words| Strided { words, stride: 1, offset: 0 };
    let episode = Episode { group: 0, team: 0, sets: whole(&trace.sets), seen: whole(&trace.seen) };
    let scores = Credit::default().all(&episode, &world);
    let mut owner = Vec::new();
    credit::assign(&episode.seen, &world, &mut owner);
    let observed = first_observed(&world, &episode.sets);
    Ok(Played { trial, generation, team, best_g, episodes: starts.len(), scores, owner, observed, trace, world })
}

/// The step (from 1) at which each POI first had as many agents near as it needs.
fn first_observed(world: &World, sets: &Strided<'_>) -> Vec<Option<usize>> {
    let pois = world.pois.len();
    let first = |poi| (0..world.steps()).find(|&step| near(world, sets, step * pois + poi) >= world.coupling[poi]);
    (0..pois).map(|poi| first(poi).map(|step| step + 1)).collect()
}

/// Agents in one set.
fn near(world: &World, sets: &Strided<'_>, set: usize) -> u32 {
    let words = world.constants.words as usize;
    (set * words..(set + 1) * words).map(|word| sets.get(word).count_ones()).sum()
}

impl Played {
    /// Agents near a POI after a step, 0 at the start.
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

    /// Steps that a page or a moving picture shows, if it has room for so many.
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
pub fn page(name: &str, config: &Config, played: &[Played]) -> String {
    let count = played.len().max(1);
    let size = |per_agent: usize, world: &World| world.agents() * per_agent + world.pois.len() * 2;
    let exact = played.iter().map(|p| (p.world.steps() + 1) * size(16, &p.world)).sum::<usize>() <= EXACT_BYTES;
    let episodes: Vec<_> = played
        .iter()
        .map(|played| {
            let room = if exact { usize::MAX } else { MOTION_BYTES / count / size(5, &played.world) };
            episode(played, &played.shown(room), exact)
        })
        .collect();
    let world = &config.world;
    let data = json!({
        "run": name,
        "paradigm": config.learning.paradigm,
        "fitness": config.learning.fitness,
        "map": world.map,
        "pois": world.pois,
        "observation_radius": world.observation_radius,
        "attraction_radius": config.follow.attraction_radius,
        "dt": world.dt,
        "steps": world.steps,
        "exact": exact,
        "episodes": episodes,
    });
    // Inside a script element, only "<" could end it early.
    let data = data.to_string().replace('<', "\\u003c");
    include_str!("replay.html").replacen("\"DATA\"", &data, 1)
}

/// One episode as the page reads it: motion as base64 of little-endian numbers, `[shown][agents]`.
fn episode(played: &Played, shown: &[usize], exact: bool) -> serde_json::Value {
    let Played { world, scores, .. } = played;
    let map = [world.constants.map_x, world.constants.map_y];
    let (mut positions, mut headings, mut near) = (Vec::new(), Vec::new(), Vec::new());
    for &step in shown {
        for agent in 0..world.agents() {
            let (place, heading) = (played.position(step, agent), played.heading(step, agent));
            if exact {
                positions.extend(place.iter().flat_map(|at| at.to_le_bytes()));
                headings.extend(heading.iter().flat_map(|at| at.to_le_bytes()));
            } else {
                let share = |axis: usize| (f64::from(place[axis]) / f64::from(map[axis]) * 65535.0).round() as u16;
                positions.extend([share(0), share(1)].iter().flat_map(|share| share.to_le_bytes()));
                let turn = f64::from(heading[1]).atan2(f64::from(heading[0])) / std::f64::consts::TAU;
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
        "leaders": world.leaders(),
        "agents": world.agents(),
        "coupling": world.coupling,
        "owner": owner,
        "observed": played.observed,
        "shown": shown,
        "positions": BASE64_STANDARD.encode(positions),
        "headings": BASE64_STANDARD.encode(headings),
        "near": BASE64_STANDARD.encode(near),
    })
}

/// Episodes side by side after a step, each with its trails up to there.
pub fn still(config: &Config, played: &[Played], step: usize) -> Scene {
    const SIDE: f64 = 80.0;
    const EDGE: f64 = 2.5;
    const HEAD: f64 = 9.0;
    let [from, to] = busy(config, played);
    let span = to - from;
    let scale = SIDE / span.max_element();
    let (width, height) = (span.x * scale, span.y * scale);
    let columns = played.len().max(1) as f64;
    let mut scene = Scene::new(EDGE + columns * (width.max(50.0) + EDGE), HEAD + height + 8.0);
    for (column, played) in played.iter().enumerate() {
        let left = EDGE + column as f64 * (width.max(50.0) + EDGE);
        let pois = played.world.pois.len();
        let by_now = played.observed.iter().flatten().filter(|&&observed| observed <= step).count();
        scene.bold([left, 4.0], format!("Generation {}", played.generation), 3.2, Anchor::Start, BLACK);
        let said = format!("step {step} of {}   POIs observed: {by_now} of {pois}", played.world.steps());
        scene.text([left, 7.6], said, 2.6, Anchor::Start, GREY);
        let view = View { left, above: HEAD, scale, height, from };
        scene.rectangle([left, HEAD, width, height], Some([250, 250, 250].into()), Some(Pen::new(LIGHT, 0.2)));
        scene.clipped([left, HEAD, width, height], |scene| {
            view.draw(scene, config, played, step);
            view.counts(scene, config, played, step);
        });
    }
    legend(&mut scene, [EDGE, HEAD + height + 4.6], played.iter().any(|played| played.world.followers() > 0));
    scene
}

/// The part of the map, from corner to corner, where anything happens in any of the episodes, at least half as high as
/// wide or the other way round.
fn busy(config: &Config, played: &[Played]) -> [DVec2; 2] {
    let map = DVec2::from(config.world.map);
    let around = |at: DVec2, margin: f64| [at - margin, at + margin];
    let pois = config.world.pois.iter().map(|&poi| around(poi.into(), config.world.observation_radius + 1.0));
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

/// Where a part of the map is drawn.
struct View {
    left: f64,
    above: f64,
    scale: f64,
    height: f64,
    /// The part's lower left corner.
    from: DVec2,
}

impl View {
    fn at(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.left + (x - self.from.x) * self.scale, self.above + self.height - (y - self.from.y) * self.scale]
    }

    fn draw(&self, scene: &mut Scene, config: &Config, played: &Played, step: usize) {
        let world = &played.world;
        let [x, y] = config.world.map;
        let walls = [[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]].map(|corner| self.at(corner));
        scene.polygon(walls.to_vec(), None, Some(Pen::new(BLACK, 0.5)));
        let size = (self.scale * 1.1).clamp(0.6, 2.2) * if world.agents() > 60 { 0.6 } else { 1.0 };
        for (poi, &place) in config.world.pois.iter().enumerate() {
            let place = self.at(place);
            let observed = played.observed[poi].is_some_and(|observed| observed <= step);
            let radius = config.world.observation_radius * self.scale;
            let color = if observed { COLORS[2] } else { GREY };
            let opacity = if observed { 0.22 } else { 0.06 };
            let dash: &[f64] = if observed { &[] } else { &[1.0, 0.8] };
            scene.circle(place, radius, Some(Fill { color, opacity }), Some(Pen { dash, ..Pen::new(color, 0.25) }));
            let arm = 0.8;
            for sign in [1.0, -1.0] {
                let cross = vec![[place[0] - arm, place[1] - sign * arm], [place[0] + arm, place[1] + sign * arm]];
                scene.line(cross, Pen::new(color, 0.35));
            }
        }
        let shown = played.shown(400);
        for agent in 0..world.agents() {
            let steps = shown.iter().copied().filter(|&shown| shown <= step);
            let mut trail: Vec<_> = steps.map(|step| self.at(played.position(step, agent).map(f64::from))).collect();
            trail.push(self.at(played.position(step, agent).map(f64::from)));
            scene.line(trail, Pen { opacity: 0.4, ..Pen::new(self.color(played, agent), 0.3) });
        }
        for agent in (0..world.agents()).rev() {
            let place = self.at(played.position(step, agent).map(f64::from));
            let [x, y] = played.heading(step, agent).map(f64::from);
            let leads = agent < world.leaders();
            let size = if leads { size * 1.35 } else { size };
            let corner = |ahead: f64, aside: f64| {
                [place[0] + size * (x * ahead - y * aside), place[1] - size * (y * ahead + x * aside)]
            };
            let corners = vec![corner(1.0, 0.0), corner(-0.75, 0.7), corner(-0.4, 0.0), corner(-0.75, -0.7)];
            let color = self.color(played, agent);
            match leads {
                true => scene.polygon(corners, Some(color.into()), Some(Pen::new(BLACK, 0.2))),
                false => scene.polygon(corners, Some(WHITE.into()), Some(Pen::new(color, 0.35))),
            }
        }
    }

    /// How many agents of those needed are near each POI, above whatever else is there.
    fn counts(&self, scene: &mut Scene, config: &Config, played: &Played, step: usize) {
        for (poi, &place) in config.world.pois.iter().enumerate() {
            let [x, y] = self.at(place);
            let count = format!("{}/{}", played.near(step, poi), played.world.coupling[poi]);
            scene.text([x, y - 1.6], count, 2.4, Anchor::Middle, BLACK);
        }
    }

    /// A leader's own colour, its followers' too.
    fn color(&self, played: &Played, agent: usize) -> Color {
        match played.owner[agent] {
            credit::NOBODY => GREY,
            leader => GROUPS[leader as usize % GROUPS.len()],
        }
    }
}

/// Colours of groups; green is the observed POIs'.
const GROUPS: [Color; 5] = [COLORS[0], COLORS[1], COLORS[3], COLORS[4], COLORS[5]];

fn legend(scene: &mut Scene, [x, y]: [f64; 2], followers: bool) {
    let triangle = |x: f64| vec![[x, y - 2.0], [x + 1.0, y + 0.4], [x, y - 0.2], [x - 1.0, y + 0.4]];
    scene.polygon(triangle(x + 1.0), Some(GROUPS[0].into()), Some(Pen::new(BLACK, 0.2)));
    scene.text([x + 3.0, y], "leader", 2.4, Anchor::Start, BLACK);
    let mut next = x + 14.0;
    if followers {
        scene.polygon(triangle(next), Some(WHITE.into()), Some(Pen::new(GROUPS[0], 0.35)));
        scene.text([next + 2.0, y], "its follower", 2.4, Anchor::Start, BLACK);
        next += 20.0;
    }
    scene.circle([next, y - 0.8], 1.2, Some(Fill { color: COLORS[2], opacity: 0.22 }), Some(Pen::new(COLORS[2], 0.25)));
    scene.text([next + 2.2, y], "observed POI", 2.4, Anchor::Start, BLACK);
}

/// Episodes side by side as a GIF that repeats.
///
/// # Errors
/// The encoder refused, which it does for want of memory alone.
pub fn gif(config: &Config, played: &[Played]) -> std::io::Result<Vec<u8>> {
    const FRAMES: usize = 100;
    const PER_MM: f64 = 5.0;
    let Some(first) = played.first() else { return Ok(vec![]) };
    let shown = first.shown(FRAMES);
    let picture = |step: usize| still(config, played, step).pixels(PER_MM);
    // The last picture has all the colours there are.
    let last = picture(first.world.steps());
    let colors = color_quant::NeuQuant::new(10, 255, last.data());
    let mut known = std::collections::HashMap::new();
    let (width, height) = (last.width() as u16, last.height() as u16);
    let mut file = Vec::new();
    {
        let failed = |error: gif::EncodingError| std::io::Error::other(error.to_string());
        let mut encoder = gif::Encoder::new(&mut file, width, height, &colors.color_map_rgb()).map_err(failed)?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
        let mut before: Vec<u8> = Vec::new();
        for (index, &step) in shown.iter().enumerate() {
            let pixmap = picture(step);
            let pixels: Vec<u8> = pixmap
                .data()
                .chunks_exact(4)
                .map(|pixel| {
                    let pixel = [pixel[0], pixel[1], pixel[2], pixel[3]];
                    *known.entry(pixel).or_insert_with(|| colors.index_of(&pixel) as u8)
                })
                .collect();
            // What stays as it was is transparent, which packs well; index 255 is no colour.
            let changed = |(index, &pixel): (usize, &u8)| if before.get(index) == Some(&pixel) { 255 } else { pixel };
            let buffer: Vec<u8> = pixels.iter().enumerate().map(changed).collect();
            let next = shown.get(index + 1).map_or(0, |&next| next - step);
            let seconds = if next == 0 { 2.0 } else { next as f64 * config.world.dt };
            let frame = gif::Frame {
                width,
                height,
                buffer: buffer.into(),
                transparent: Some(255),
                // Long episodes play faster than they were.
                delay: ((seconds * 100.0).round() as u16).clamp(4, if next == 0 { 200 } else { 20 }),
                ..gif::Frame::default()
            };
            encoder.write_frame(&frame).map_err(failed)?;
            before = pixels;
        }
    }
    Ok(file)
}
