//! A team on its map at one moment: agents with trails and numbers, and POIs with their couplings.
//!
//! [`Legend`] is below the map. [`layout()`] draws a config before training.

use glam::DVec2;

use super::curves::round_step;
use super::scene::{Anchor, BLACK, COLORS, Color, Fill, GREY, LIGHT, Pen, Scene, WHITE, colors, text_width};
use flotilla::config::{Config, When, drawn_every};
use flotilla::world::World;

mod layout;
mod legend;

pub use layout::layout;
pub(crate) use legend::Legend;

/// Colours of leaders and their followers on white. Green is reserved for observed POIs and grey for agents without a
/// group.
///
/// Each colour was chosen to be as far as possible from all others for normal and red- or green-blind vision. All have
/// a contrast of at least 3 to 1 to white.
pub const GROUPS: [Color; 16] = colors([
    0x0072b2, 0xd55e00, 0x993388, 0x665511, 0x9977ff, 0x552266, 0x0000bb, 0xff11dd, 0x883355, 0xbb77aa, 0x5544bb,
    0xcc2244, 0x880088, 0xff1166, 0x6600ff, 0x004400,
]);
/// Colours of leaders and their followers on a dark background.
pub const GROUPS_DARK: [Color; 16] = colors([
    0x4aa8e0, 0xf0883e, 0xe39cc4, 0xeedd00, 0x3366ff, 0xdd2244, 0xbb33bb, 0x99ddff, 0x008866, 0x99eeaa, 0xaa6699,
    0x8888ff, 0xffbb66, 0xff55cc, 0xff4400, 0x22ccff,
]);
/// Returns a note if not all followers are drawn.
pub(crate) fn sample_note(world: &World) -> Option<String> {
    let every = drawn_every(world.leaders(), world.agents());
    (every > 1).then(|| format!("1 of {every} followers drawn"))
}

/// Dashes distinguish groups once all colours are used. Beyond that, only the leaders' numbers do.
const DASHES: [&[f64]; 3] = [&[], &[0.9, 0.5], &[0.3, 0.35]];

/// Dashes of the circle around a POI that cannot be observed now.
const CLOSED: &[f64] = &[0.3, 1.2];

/// More agents have smaller marks.
const MANY: usize = 60;

/// Usual font size of labels, in millimetres.
const LABEL: f64 = 2.4;
/// Minimum font size of labels, in millimetres.
const MIN_LABEL: f64 = 1.9;
const PALE: Color = [250, 250, 250];
/// Colour of secondary text.
pub(crate) const FAINT: Color = [95, 95, 95];

/// The form of an agent's mark, by which classes of agents differ.
#[derive(Clone, Copy, Default)]
pub struct Form {
    /// Whether the agents move freely, so that their marks do not point ahead.
    is_free: bool,
    /// The class's number among those of its kind. Those that learn have filled marks, and others hollow ones.
    number: usize,
}

impl Form {
    /// Returns the form of a class's marks. `kind` tells of a class whether its agents move freely and whether they learn.
    pub(crate) fn of(class: usize, kind: impl Fn(usize) -> [bool; 2]) -> Form {
        let number = (0..class).filter(|&other| kind(other) == kind(class)).count();
        Form { is_free: kind(class)[0], number }
    }

    /// Returns the form of an agent's mark.
    pub fn of_agent(world: &World, agent: usize) -> Form {
        let class = world.classes.iter().position(|class| class.agents().contains(&agent)).unwrap_or_default();
        Form::of(class, |class| {
            let class = &world.classes[class];
            [class.constants.shape.free != 0, class.agents().start < world.leaders()]
        })
    }

    /// Returns the corners of the mark's outline, each ahead and to the left of its middle, in sizes of the mark. Three
    /// classes of each kind have outlines of their own.
    pub fn outline(self) -> Vec<[f64; 2]> {
        let regular = |corners: usize, turn: f64| {
            let corner = |corner: usize| {
                let (sin, cos) = libm::sincos((corner as f64 + turn) / corners as f64 * std::f64::consts::TAU);
                [0.9 * cos, 0.9 * sin]
            };
            (0..corners).map(corner).collect()
        };
        match (self.is_free, self.number % 3) {
            (false, 0) => vec![[1.0, 0.0], [-0.75, 0.7], [-0.4, 0.0], [-0.75, -0.7]],
            (false, 1) => vec![[1.0, 0.0], [-0.75, 0.6], [-0.75, -0.6]],
            (false, _) => vec![[1.0, 0.0], [0.2, 0.65], [-0.85, 0.4], [-0.85, -0.4], [0.2, -0.65]],
            (true, 0) => regular(24, 0.0),
            (true, 1) => regular(4, 0.5),
            (true, _) => regular(4, 0.0),
        }
    }
}

/// An agent to draw.
pub struct Marker {
    /// Position in map units.
    pub place: DVec2,
    /// Heading, a vector of any length except 0. Marks of agents that move freely ignore it.
    pub heading: DVec2,
    pub form: Form,
    /// The leader in whose group the agent is.
    pub group: Option<usize>,
    /// Whether the agent is an observer.
    pub counts: bool,
    /// Earlier positions, in map units, up to the current one.
    pub trail: Vec<DVec2>,
}

/// A POI to draw.
pub struct Poi {
    /// Position in map units.
    pub place: DVec2,
    /// Observation radius in map units.
    pub radius: f64,
    /// Text next to the POI.
    pub label: String,
    /// Size of its mark: 1 if all POIs have the same value, otherwise more for more valuable ones.
    pub size: f64,
    /// Observers present divided by the coupling. None before an episode.
    pub share: Option<f64>,
    /// Whether the POI has been observed.
    pub observed: bool,
    /// Whether enough observers would observe the POI now: its window is open, and all POIs that it comes after are
    /// observed.
    pub open: bool,
}

impl Poi {
    /// Returns a POI of a world at a step. `near` is the number of its observers, None before an episode. `observed` are
    /// the POIs that were observed before.
    pub fn new(world: &World, poi: usize, place: DVec2, near: Option<u32>, step: usize, observed: &[bool]) -> Poi {
        let needed = world.coupling[poi];
        let count = near.map_or(needed.to_string(), |near| format!("{near}/{needed}"));
        Poi {
            place,
            radius: f64::from(world.radii2[poi]).sqrt(),
            label: poi_label(world, poi, count),
            size: size_of(world, poi),
            share: near.map(|near| f64::from(near) / f64::from(needed)),
            observed: observed[poi],
            open: is_open(world, poi, step, observed),
        }
    }
}

/// Reports whether POIs have different values.
pub(crate) fn values_differ(world: &World) -> bool {
    world.values.windows(2).any(|pair| pair[0] != pair[1])
}

/// Returns what follows a number of observed POIs if it is weighted, see [`Config::weighted_by`].
pub fn weighted(by: Option<&str>) -> String {
    by.map_or(String::new(), |by| format!(", weighted by {by}"))
}

/// Returns the part of a POI's label that has its value, empty if all have the same value.
fn value_label(world: &World, poi: usize) -> String {
    if values_differ(world) { format!(", value {}", world.values[poi]) } else { String::new() }
}

/// Returns the size of a POI's mark, see [`Poi::size`].
fn size_of(world: &World, poi: usize) -> f64 {
    let largest = world.values.iter().copied().fold(0.0, f32::max);
    if values_differ(world) { 0.7 + 0.8 * f64::from(world.values[poi] / largest).sqrt() } else { 1.0 }
}

/// Returns the steps at which a POI can be observed, if these are not all.
fn window_of(world: &World, poi: usize) -> Option<[u32; 2]> {
    match world.paths.as_ref().map(|rule| rule.scores[poi].1) {
        Some(When::End) => Some([world.steps() as u32; 2]),
        _ => world.rule.window(poi),
    }
}

/// Reports whether POIs differ in when they can be observed, or come after others.
pub(crate) fn is_timed(world: &World) -> bool {
    world.rule.is_timed() || (0..world.pois.len()).any(|poi| window_of(world, poi) != window_of(world, 0))
}

/// Reports whether a POI can be observed at a step, if these POIs were observed before.
fn is_open(world: &World, poi: usize, step: usize, before: &[bool]) -> bool {
    let step = step as u32;
    world.rule.is_open(poi, step, before)
        && window_of(world, poi).is_none_or(|[first, last]| (first..=last).contains(&step))
}

/// Returns when a POI can be observed, empty if at any step.
fn time_label(world: &World, poi: usize) -> String {
    let window = window_of(world, poi).map(|[first, last]| match first == last {
        true => format!("step {first}"),
        false => format!("steps {first} to {last}"),
    });
    let after: Vec<_> = world.rule.after(poi).iter().map(usize::to_string).collect();
    let after = (!after.is_empty()).then(|| format!("after {}", after.join(" ")));
    window.into_iter().chain(after).collect::<Vec<_>>().join(", ")
}

/// Returns a POI's label: `needs`, its value if values differ, and if POIs are timed also the POI's number and when it can be
/// observed.
fn poi_label(world: &World, poi: usize, needs: String) -> String {
    let needs = needs + &value_label(world, poi);
    match (is_timed(world), time_label(world, poi)) {
        (false, _) => needs,
        (true, time) if time.is_empty() => format!("{poi}: {needs}"),
        (true, time) => format!("{poi}: {needs}, {time}"),
    }
}

/// Returns an observed POI's label: the step at which it was observed, and its value if values differ.
pub(crate) fn observed_label(world: &World, poi: usize, step: usize) -> String {
    let number = if is_timed(world) { format!("{poi}: ") } else { String::new() };
    format!("{number}at step {step}{}", value_label(world, poi))
}

/// A team at one moment, to draw.
pub struct Team {
    pub leaders: usize,
    /// The agents, leaders first.
    pub agents: Vec<Marker>,
    /// All POIs of the world.
    pub pois: Vec<Poi>,
}

/// The area of a picture in which a part of the map is drawn.
#[derive(Clone, Copy)]
pub struct Viewport {
    left: f64,
    above: f64,
    /// Millimetres per map unit.
    scale: f64,
    /// Lower left corner of the part, in map units. `to` is the upper right one.
    from: DVec2,
    to: DVec2,
    map: DVec2,
}

impl Viewport {
    /// Fits a part of a config's map, given by its corners, into a square of `side` millimetres.
    pub fn new(config: &Config, [from, to]: [DVec2; 2], side: f64) -> Viewport {
        let scale = side / (to - from).max_element();
        Viewport { left: 0.0, above: 0.0, scale, from, to, map: config.world.map.into() }
    }

    /// Returns the same view with another upper left corner, in millimetres.
    pub(crate) fn moved_to(self, [left, above]: [f64; 2]) -> Viewport {
        Viewport { left, above, ..self }
    }

    /// Returns width and height in millimetres.
    pub fn size(&self) -> [f64; 2] {
        ((self.to - self.from) * self.scale).to_array()
    }

    fn area(&self) -> [f64; 4] {
        let [width, height] = self.size();
        [self.left, self.above, width, height]
    }

    /// Returns the area's corners in millimetres: `[left, above, right, below]`.
    fn whole(&self) -> [f64; 4] {
        let [left, above, width, height] = self.area();
        [left, above, left + width, above + height]
    }

    fn at(&self, place: DVec2) -> [f64; 2] {
        let [x, y] = ((place - self.from) * self.scale).to_array();
        [self.left + x, self.above + self.size()[1] - y]
    }

    pub fn draw(&self, scene: &mut Scene, team: &Team) {
        scene.rectangle(self.area(), Some(PALE.into()), Some(Pen::new(LIGHT, 0.2)));
        let labels = self.poi_labels(team);
        let ring = labels.is_none().then(|| self.ring(team));
        // Walls and POIs may extend beyond the visible part of the map; agents do not.
        scene.clipped(self.area(), |scene| {
            let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
            let walls = corners.map(|corner| self.at(self.map * DVec2::from(corner)));
            scene.polygon(walls.to_vec(), None, Some(Pen::new(BLACK, 0.5)));
            team.pois.iter().for_each(|poi| self.poi(scene, poi, ring));
        });
        for agent in &team.agents {
            let trail = agent.trail.iter().map(|&place| self.at(place)).collect();
            scene.line(trail, Pen { opacity: 0.5, ..group_pen(agent.group, 0.3) });
        }
        for (index, agent) in team.agents.iter().enumerate().rev() {
            let leads = index < team.leaders;
            let size = if leads { self.leader_size(team) } else { self.agent_size(team) };
            mark(scene, self.at(agent.place), agent, size, leads);
        }
        let mut taken = Vec::new();
        for (poi, ([x, y], size)) in team.pois.iter().zip(labels.into_iter().flatten()) {
            plate(scene, &mut taken, [x, y], &poi.label, size);
            scene.text([x, y], &*poi.label, size, Anchor::Middle, BLACK);
        }
        self.numbers(scene, team, taken);
    }

    fn agent_size(&self, team: &Team) -> f64 {
        (self.scale * 1.1).clamp(0.6, 2.2) * if team.agents.len() > MANY { 0.6 } else { 1.0 }
    }

    /// Returns the size of leaders' marks, which stand out from many followers.
    fn leader_size(&self, team: &Team) -> f64 {
        let smallest: f64 = if team.agents.len() > MANY && team.leaders <= MANY { 1.0 } else { 0.0 };
        smallest.max(self.agent_size(team) * 1.35)
    }

    fn poi(&self, scene: &mut Scene, poi: &Poi, ring: Option<f64>) {
        let [x, y] = self.at(poi.place);
        let color = if poi.observed { COLORS[2] } else { GREY };
        let opacity = if poi.observed { 0.22 } else { 0.06 };
        let radius = poi.radius * self.scale;
        let dash: &[f64] = match radius {
            _ if poi.observed => &[],
            _ if !poi.open => CLOSED,
            small if small < 2.5 => &[0.5, 0.4],
            _ => &[1.0, 0.8],
        };
        let fill = Fill { color, opacity };
        scene.circle([x, y], radius, Some(fill), Some(Pen { dash, ..Pen::new(color, 0.25) }));
        let (Some(ring), Some(share)) = (ring, poi.share) else {
            let arm = ring.unwrap_or(0.8).min(0.8) * poi.size;
            for sign in [1.0, -1.0] {
                scene.line(vec![[x - arm, y - sign * arm], [x + arm, y + sign * arm]], Pen::new(color, 0.35));
            }
            return;
        };
        scene.circle([x, y], ring, Some(WHITE.into()), Some(Pen::new(LIGHT, 0.35 * ring)));
        if share > 0.0 {
            let full = (share.min(1.0) * 32.0).ceil();
            let turn = |step: f64| libm::sincos(std::f64::consts::TAU * share.min(1.0) * step / full);
            let arc =
                (0..=full as usize).map(|step| turn(step as f64)).map(|(sin, cos)| [x + ring * sin, y - ring * cos]);
            scene.line(arc.collect(), Pen::new(color, 0.35 * ring));
        }
    }

    /// Returns the radius of the rings that replace POI labels when these have no room, in millimetres.
    fn ring(&self, team: &Team) -> f64 {
        let apart = |index: usize, poi: &Poi| {
            team.pois[..index].iter().map(|other| other.place.distance(poi.place)).fold(f64::INFINITY, f64::min)
        };
        let nearest = team.pois.iter().enumerate().map(|(index, poi)| apart(index, poi)).fold(f64::INFINITY, f64::min);
        (nearest * self.scale * 0.4).clamp(0.5, 1.3)
    }

    /// Returns each POI label's position and font size, or none if labels would overlap. Labels avoid agents if they can.
    fn poi_labels(&self, team: &Team) -> Option<Vec<([f64; 2], f64)>> {
        let arm = self.leader_size(team);
        let agents: Vec<_> = team.agents.iter().map(|agent| around(self.at(agent.place), arm)).collect();
        [LABEL, MIN_LABEL].into_iter().find_map(|size| {
            let crosses: Vec<_> = team.pois.iter().map(|poi| around(self.at(poi.place), 0.8)).collect();
            let mut taken: Vec<[f64; 4]> = Vec::new();
            let whole = self.whole();
            let place = |poi: &Poi| {
                let [x, y] = self.at(poi.place);
                let half = text_width(&poi.label, size) / 2.0;
                // Labels of large circles are at the top, because agents gather in the middle.
                let top = y - poi.radius * self.scale + size + 0.8;
                let bottom = y + poi.radius * self.scale - 0.8;
                let places = [
                    [x, if top < y - 2.5 { top } else { y - 1.6 }],
                    [x, y - 1.6],
                    [x, y + 1.5 + size],
                    [x + 1.6 + half, y + 0.35 * size],
                    [x - 1.6 - half, y + 0.35 * size],
                    [x, if bottom > y + 2.5 + size { bottom } else { y + 1.5 + size }],
                ];
                // Labels at an edge of the map are moved inside.
                let [from, to] = [whole[0] + half + 0.3, whole[2] - half - 0.3];
                let places = places.map(|[x, y]| [x.min(to).max(from), y]);
                let free = |place: &[f64; 2]| {
                    let area = label_area(*place, &poi.label, size);
                    within(area, whole) && !taken.iter().chain(&crosses).any(|other| overlap(area, *other))
                };
                let apart = |place: &&[f64; 2]| {
                    let area = label_area(**place, &poi.label, size);
                    free(place) && !agents.iter().any(|other| overlap(area, *other))
                };
                let found = *places.iter().find(apart).or_else(|| places.iter().find(|place| free(place)))?;
                taken.push(label_area(found, &poi.label, size));
                Some((found, size))
            };
            team.pois.iter().map(place).collect()
        })
    }

    /// Draws the leaders' numbers beside their arrows, if there is room.
    fn numbers(&self, scene: &mut Scene, team: &Team, mut taken: Vec<[f64; 4]>) {
        // More numbers than this never fit, and trying takes time.
        const MAX_NUMBERS: usize = 256;
        let mark = self.leader_size(team);
        let leaders = &team.agents[..team.leaders.min(MAX_NUMBERS)];
        let marks: Vec<_> = team.agents.iter().map(|agent| around(self.at(agent.place), mark * 0.6)).collect();
        let size = if team.leaders > 20 { MIN_LABEL } else { LABEL };
        for (number, leader) in leaders.iter().enumerate() {
            let [x, y] = self.at(leader.place);
            let text = number.to_string();
            let aside = mark + text_width(&text, size) / 2.0;
            let low = y + 0.36 * size;
            let diagonal = [[aside, 1.2], [-aside, 1.2], [aside, -1.2], [-aside, -1.2]];
            let straight = [[0.0, mark + 0.6 * size], [0.0, -mark - 0.6 * size], [aside, 0.0], [-aside, 0.0]];
            let places = [diagonal, straight].concat().into_iter().map(|[right, down]| [x + right, low + down]);
            let places: Vec<_> = places.collect();
            let whole = self.whole();
            let inside = |place: &&[f64; 2]| within(label_area(**place, &text, size), whole);
            // Followers may be covered if there is no other place.
            let free = |place: &[f64; 2], agents: usize| {
                let area = label_area(*place, &text, size);
                let mut marks = marks[..agents].iter().enumerate();
                within(area, whole)
                    && !taken.iter().any(|other| overlap(area, *other))
                    && !marks.any(|(at, other)| at != number && overlap(area, *other))
            };
            let found = [marks.len(), leaders.len()]
                .into_iter()
                .find_map(|agents| places.iter().find(|place| free(place, agents)));
            let place = match found {
                Some(place) => *place,
                None if team.leaders <= 12 => *places.iter().find(inside).unwrap_or(&places[0]),
                None => continue,
            };
            plate(scene, &mut taken, place, &text, size);
            scene.bold(place, &*text, size, Anchor::Middle, group_color(leader.group));
        }
    }

    /// Draws scales in map units at the left and lower edges.
    pub fn rule(&self, scene: &mut Scene) {
        let [left, above, width, height] = self.area();
        let below = above + height;
        let span = self.to - self.from;
        let step = round_step(span.max_element() / 6.0);
        for axis in 0..2 {
            let first = (self.from[axis] / step).ceil() as usize;
            for tick in (first..).map(|tick| tick as f64 * step).take_while(|&tick| tick <= self.to[axis] + 1e-9) {
                let mut place = self.from;
                place[axis] = tick;
                let [x, y] = self.at(place);
                if axis == 0 {
                    scene.line(vec![[x, below], [x, below + 0.9]], Pen::new(BLACK, 0.2));
                    scene.text([x, below + 3.4], tick.to_string(), LABEL, Anchor::Middle, BLACK);
                } else {
                    scene.line(vec![[left - 0.9, y], [left, y]], Pen::new(BLACK, 0.2));
                    scene.text([left - 1.4, y + 0.85], tick.to_string(), LABEL, Anchor::End, BLACK);
                }
            }
        }
        scene.text([left + width / 2.0, below + 6.6], "x, map units", LABEL, Anchor::Middle, BLACK);
        scene.upright([left - 7.2, above + height / 2.0], "y, map units", LABEL, BLACK);
    }
}

/// Formats a count as "1 leader" or "2 leaders".
pub fn counted(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

/// Draws an agent's mark: filled for a leader, hollow for a follower, with a stroke across it if it does not observe.
fn mark(scene: &mut Scene, [px, py]: [f64; 2], agent: &Marker, size: f64, leads: bool) {
    let (fill, pen) = match leads {
        // A thin outline leaves enough colour in small marks.
        true => (group_color(agent.group), Pen::new(BLACK, (size * 0.1).min(0.2))),
        false => (WHITE, group_pen(agent.group, 0.35)),
    };
    let heading = if agent.form.is_free { DVec2::Y } else { agent.heading };
    let [x, y] = heading.normalize_or(DVec2::Y).to_array();
    let at = |[ahead, left]: [f64; 2]| [px + size * (x * ahead - y * left), py - size * (y * ahead + x * left)];
    scene.polygon(agent.form.outline().into_iter().map(at).collect(), Some(fill.into()), Some(pen));
    if !agent.counts {
        for (color, width) in [(WHITE, 0.32), (BLACK, 0.16)] {
            scene.line(vec![at([0.0, 1.1]), at([0.0, -1.1])], Pen::new(color, size * width));
        }
    }
}

/// Returns the colour of a leader and its followers, or grey without a group.
fn group_color(group: Option<usize>) -> Color {
    group.map_or(GREY, |group| GROUPS[group % GROUPS.len()])
}

fn group_pen(group: Option<usize>, width: f64) -> Pen {
    let dash = group.map_or(DASHES[0], |group| DASHES[group / GROUPS.len() % DASHES.len()]);
    Pen { dash, ..Pen::new(group_color(group), width) }
}

/// Returns the area of a label centred on a place of its baseline: `[left, above, right, below]`.
fn label_area([x, y]: [f64; 2], text: &str, size: f64) -> [f64; 4] {
    let half = text_width(text, size) / 2.0 + 0.2;
    [x - half, y - 0.8 * size, x + half, y + 0.12 * size]
}

/// Makes the background of a label pale for legibility, and marks its area as taken.
fn plate(scene: &mut Scene, taken: &mut Vec<[f64; 4]>, place: [f64; 2], text: &str, size: f64) {
    let area = label_area(place, text, size);
    let [left, above, right, below] = area;
    let fill = Fill { color: WHITE, opacity: 0.75 };
    scene.rectangle([left, above, right - left, below - above], Some(fill), None);
    taken.push(area);
}

fn around([x, y]: [f64; 2], margin: f64) -> [f64; 4] {
    [x - margin, y - margin, x + margin, y + margin]
}

fn overlap(a: [f64; 4], b: [f64; 4]) -> bool {
    a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]
}

fn within(inner: [f64; 4], outer: [f64; 4]) -> bool {
    inner[0] >= outer[0] && inner[1] >= outer[1] && inner[2] <= outer[2] && inner[3] <= outer[3]
}
