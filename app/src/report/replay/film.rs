//! Pictures and films of episodes.

use glam::{DVec2, Vec2};

use super::Replayed;
use crate::record::digests::UNVERIFIED;
use crate::report::map::{self, FAINT, Form, Legend, Marker, Poi, Team, Viewport, sample_note};
use crate::report::scene::{Anchor, BLACK, Scene};
use flotilla::config::{Config, drawn_agents};

impl Replayed {
    /// Returns the team at `place` steps from the start, with its trails.
    fn team(&self, place: f64) -> Team {
        // Limits the points of all trails together, for long episodes of many agents.
        const POINTS: usize = 40_000;
        let (step, part) = (place as usize, place.fract());
        let world = &self.world;
        let drawn = drawn_agents(world.leaders(), world.agents());
        let shown = self.shown((POINTS / drawn.len().max(1)).clamp(30, 400));
        let has_trail = |agent: usize| agent < world.leaders() || drawn.len() == world.agents();
        let at = |step: usize, agent: usize| Vec2::from(self.position(step, agent)).as_dvec2();
        let toward = |step: usize, agent: usize| Vec2::from(self.heading(step, agent)).as_dvec2();
        let agent = |agent: usize| {
            let next = (step + 1).min(world.steps());
            let trail = shown.iter().filter(|&&shown| shown <= step && has_trail(agent));
            let mut trail: Vec<_> = trail.map(|&step| at(step, agent)).collect();
            let place = at(step, agent).lerp(at(next, agent), part);
            trail.push(place);
            let group = self.group(step, agent);
            let counts = world.rule.counts(agent);
            let heading = toward(step, agent).lerp(toward(next, agent), part);
            Marker { place, heading, form: Form::of_agent(world, agent), group, counts, trail }
        };
        // The POIs that were observed before this step decide which POIs are open.
        let before: Vec<bool> = self.observed.iter().map(|at| at.is_some_and(|at| at < step.max(1))).collect();
        let poi = |(poi, place): (usize, &Vec2)| {
            let open = Poi::new(world, poi, place.as_dvec2(), Some(self.near(step, poi)), step.max(1), &before);
            match self.observed[poi].filter(|&observed| observed <= step) {
                None => open,
                // An observed POI needs no agents any more.
                Some(at) => {
                    Poi { label: map::observed_label(world, poi, at), share: Some(1.0), observed: true, ..open }
                }
            }
        };
        Team {
            leaders: world.leaders(),
            agents: drawn.iter().copied().map(agent).collect(),
            pois: world.pois.iter().enumerate().map(poi).collect(),
        }
    }

    /// Describes the state after a step in a sentence.
    fn say(&self, step: usize) -> String {
        const MAX_LISTED_TIMES: usize = 12;
        let (world, pois) = (&self.world, self.world.pois.len());
        let times = self.observed.iter().enumerate().filter_map(|(poi, observed)| Some((poi, (*observed)?)));
        let times: Vec<_> = times.filter(|&(_, observed)| observed <= step).collect();
        let list: Vec<_> =
            times.iter().take(MAX_LISTED_TIMES).map(|(poi, step)| format!("POI {poi} at step {step}")).collect();
        let more = if times.len() > MAX_LISTED_TIMES { " and more" } else { "" };
        format!(
            "{} of {}, step {step} of {}: {} of {pois} POIs observed{}{}{more}, by a team of {} and {}.",
            self.name(),
            self.place(),
            world.steps(),
            times.len(),
            if list.is_empty() { "" } else { ": " },
            list.join(", "),
            map::counted(world.leaders(), "leader"),
            map::counted(world.followers(), "follower"),
        )
    }
}

/// Episodes side by side, to be drawn at any moment.
struct Screen<'a> {
    played: &'a [Replayed],
    view: Viewport,
    width: f64,
    legend: Legend,
    /// Whether G is more than a count of POIs.
    weighted: bool,
}

impl<'a> Screen<'a> {
    const SIDE: f64 = 80.0;
    const EDGE: f64 = 2.5;
    const HEAD: f64 = 14.0;
    /// Room for the axes on the left of each map. The next one is the room below it.
    const LEFT: f64 = 8.0;
    const BELOW: f64 = 7.4;

    /// Lays out the pictures. The legend has what they show after these steps, and `note`.
    fn new(config: &Config, played: &'a [Replayed], steps: &[usize], note: Option<String>) -> Screen<'a> {
        let view = Viewport::new(config, busy(config, played), Self::SIDE);
        let width = view.size()[0].max(60.0);
        let teams = steps.iter().flat_map(|&step| played.iter().map(move |played| played.team(step as f64)));
        let teams: Vec<Team> = teams.collect();
        let all_count = |Replayed { world, .. }: &Replayed| {
            (0..world.pois.len()).all(|poi| (0..world.agents()).all(|agent| world.rule.counts_at(poi, agent)))
        };
        let who = if played.iter().all(all_count) { "agents" } else { "observers" };
        let timed = played.iter().any(|played| map::is_timed(&played.world));
        let needed = played.first().and_then(|played| played.world.coupling.first()).map_or(1, |&needed| needed);
        let near = needed.saturating_sub(1);
        let who = if near == 1 { &who[..who.len() - 1] } else { who };
        let label = if timed { format!("0: {near}/{needed}: POI 0,") } else { format!("{near}/{needed}:") };
        let mut legend = Legend::new(config, &view, &teams, &format!("{label} {near} {who} near of {needed} needed"));
        let unverified = played.iter().any(|played| played.unverified).then(|| UNVERIFIED.to_string());
        let sample = played.iter().find_map(|played| sample_note(&played.world));
        note.into_iter().chain(unverified).chain(sample).for_each(|note| legend.note(note));
        Screen { played, view, width, legend, weighted: config.weighted_by().is_some() }
    }

    /// Draws the picture `place` steps from the start. Motion between steps is interpolated linearly.
    fn scene(&self, place: f64) -> Scene {
        let step = place as usize;
        let columns = self.played.len().max(1) as f64;
        let whole = Self::EDGE + columns * (Self::LEFT + self.width + Self::EDGE);
        let room = whole - 2.0 * Self::EDGE;
        let below = Self::HEAD + self.view.size()[1] + Self::BELOW;
        let mut scene = Scene::new(whole, below + 1.0 + self.legend.height(room));
        let mut described = Vec::new();
        for (column, played) in self.played.iter().enumerate() {
            let left = Self::EDGE + Self::LEFT + column as f64 * (Self::LEFT + self.width + Self::EDGE);
            let pois = played.world.pois.len();
            let by_now = played.observed.iter().flatten().filter(|&&observed| observed <= step).count();
            let steps = played.world.steps();
            scene.bold([left, 4.0], played.name(), 3.2, Anchor::Start, BLACK);
            let first = match played.episodes {
                1 => String::new(),
                episodes => format!(", first of {episodes} episodes"),
            };
            scene.text([left, 7.6], played.place() + &first, 2.6, Anchor::Start, FAINT);
            let g = match self.weighted && step == steps {
                true => format!("   G = {:.2}", played.scores.g),
                false => String::new(),
            };
            let state = format!("step {step} of {steps}   POIs observed: {by_now} of {pois}{g}");
            scene.text([left, 11.2], state, 2.6, Anchor::Start, FAINT);
            let view = self.view.moved_to([left, Self::HEAD]);
            view.draw(&mut scene, &played.team(place));
            view.rule(&mut scene);
            described.push(played.say(step));
        }
        self.legend.draw(&mut scene, [Self::EDGE, below + 3.8], room);
        let names: Vec<_> =
            self.played.iter().map(|played| format!("{} of {}", played.name(), played.place())).collect();
        scene.title = names.join("; ");
        scene.description = described.join(" ");
        scene
    }
}

/// Draws episodes side by side after a step, with the trails up to it.
pub fn still(config: &Config, played: &[Replayed], step: usize) -> Scene {
    Screen::new(config, played, &[step], None).scene(step as f64)
}

/// Returns the corners of the part of the map that holds all POIs and agents of all episodes.
///
/// The shorter side is at least half the longer one, as far as the map allows.
fn busy(config: &Config, played: &[Replayed]) -> [DVec2; 2] {
    let (map, drawn) = (DVec2::from(config.world.map), config.drawn());
    let around = |at: DVec2, margin: f64| [at - margin, at + margin];
    let pois: Vec<DVec2> = match config.pois_move() {
        true => played.iter().flat_map(|played| &played.world.pois).map(|poi| poi.as_dvec2()).collect(),
        false => drawn.pois.iter().map(|&poi| poi.into()).collect(),
    };
    let pois = pois.into_iter().map(|poi| around(poi, drawn.observation_radius + 1.0));
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

/// Default number of frames per second.
pub const FPS: u32 = 20;
/// Maximum length of a film. Longer episodes play faster.
const MAX_FILM_SECONDS: f64 = 15.0;

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
        let last = played.first().map_or(0, |first| first.world.steps());
        let steps = last as f64;
        let seconds = steps * config.world.dt;
        let times = [1.0, 2.0, 4.0, 5.0, 8.0, 10.0, 16.0, 20.0, 32.0, 50.0];
        let faster = times
            .into_iter()
            .find(|times| seconds / times <= MAX_FILM_SECONDS)
            .unwrap_or((seconds / MAX_FILM_SECONDS).ceil());
        let each = faster / (f64::from(motion.fps) * config.world.dt);
        let places = (0..).map(|frame| f64::from(frame) * each).take_while(|&place| place < steps - 1e-6);
        let places: Vec<f64> = places.chain([steps]).collect();
        let mut note = if faster > 1.0 { format!("{faster} × as fast as it was") } else { String::new() };
        if each < 1.0 {
            note += if note.is_empty() { "" } else { "; " };
            note += "motion between steps is drawn straight";
        }
        let stage = Screen::new(config, played, &[last, 0], Some(note).filter(|note| !note.is_empty()));
        let Scene { width, height, .. } = stage.scene(0.0);
        let per_mm = motion.width.map_or((960.0 / width).min(720.0 / height), |pixels| f64::from(pixels) / width);
        Frames { stage, places, per_mm }
    }

    /// Returns the picture at a place, and its pixels per millimetre.
    pub fn scene(&self, place: f64) -> (Scene, f64) {
        (self.stage.scene(place), self.per_mm)
    }
}

/// Returns frames as a GIF that repeats, or `None` if `watch` returned false. It gets the number of each picture before
/// that is drawn.
pub fn gif(
    frames: &Frames<'_>,
    motion: Film,
    mut watch: impl FnMut(usize) -> bool,
) -> std::io::Result<Option<Vec<u8>>> {
    let places = &frames.places;
    let Some(&end) = places.last() else { return Ok(Some(vec![])) };
    let picture = |place: f64| {
        let (scene, per_mm) = frames.scene(place);
        scene.pixels(per_mm)
    };
    let last = picture(end);
    // Delays are whole hundredths of a second. Rounding the cumulative time keeps the total duration right.
    let due = |index: usize| (index as u32 * 100).div_ceil(motion.fps);
    let delay = |index| if index + 1 == places.len() { 200 } else { due(index + 1) - due(index) };
    let size = [last.width() as u16, last.height() as u16];
    let mut drawn = 0;
    let pictures = places.iter().enumerate().take_while(|(index, _)| watch(*index)).map(|(index, &place)| {
        drawn += 1;
        (picture(place).data().to_vec(), delay(index) as u16)
    });
    let film = animate(size, last.data(), pictures)?;
    Ok((drawn == places.len()).then_some(film))
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
