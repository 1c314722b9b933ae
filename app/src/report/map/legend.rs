//! The legend below a map.

use std::ops::Range;

use glam::DVec2;

use super::{CLOSED, FAINT, LABEL, Marker, Team, Viewport, mark};
use crate::report::curves::round_step;
use crate::report::scene::{Anchor, BLACK, COLORS, Fill, GREY, Pen, Scene, text_width};
use flotilla::config::{AgentClass, Config, drawn_agents};

/// The symbol of an entry, drawn from a place on the baseline.
enum Symbol {
    None,
    /// An agent, the size of its mark, and whether it leads.
    Agent(Marker, f64, bool),
    /// A POI's circle.
    Poi(Option<Fill>, Pen),
    /// A scale of a length in millimetres.
    Scale(f64),
}

impl Symbol {
    /// Returns the width in millimetres, with the gap before the text.
    fn width(&self) -> f64 {
        match self {
            Symbol::None => 0.0,
            Symbol::Agent(Marker { counts: false, .. }, ..) => 3.4,
            Symbol::Agent(..) | Symbol::Poi(..) => 3.0,
            Symbol::Scale(length) => length + 1.0,
        }
    }

    fn draw(&self, scene: &mut Scene, [x, y]: [f64; 2]) {
        match *self {
            Symbol::None => {}
            Symbol::Agent(ref agent, size, leads) => {
                mark(scene, [x + if agent.counts { 1.2 } else { 1.4 }, y - 0.8], agent, size, leads);
            }
            Symbol::Poi(fill, ref pen) => scene.circle([x + 1.2, y - 0.8], 1.2, fill, Some(pen.clone())),
            Symbol::Scale(length) => {
                for line in [
                    [[x, y - 1.5], [x, y - 0.1]],
                    [[x, y - 0.8], [x + length, y - 0.8]],
                    [[x + length, y - 1.5], [x + length, y - 0.1]],
                ] {
                    scene.line(line.to_vec(), Pen::new(BLACK, 0.3));
                }
            }
        }
    }
}

/// Returns the agents of each class, its name, and its name in the colour of a leader. Classes that learn come first.
fn roles(config: &Config, leaders: usize, agents: usize) -> Vec<(Range<usize>, [String; 2])> {
    if config.agents.is_empty() {
        let leader = if leaders > 1 { "leader, by number" } else { "leader" };
        let all = [(0..leaders, [leader; 2]), (leaders..agents, ["follower", "its follower"])];
        return all.map(|(agents, names)| (agents, names.map(String::from))).to_vec();
    }
    let mut first = 0;
    let role = |class: &AgentClass| {
        let agents = first..first + class.size();
        first = agents.end;
        let numbers = match agents.len() {
            1 => agents.start.to_string(),
            _ => format!("{} to {}", agents.start, agents.end - 1),
        };
        let name = &class.name;
        let names = match class.learns() {
            true if leaders > 1 => [format!("{name} {numbers}"), format!("{name} {numbers}")],
            true => [name.clone(), name.clone()],
            false => [name.clone(), format!("{name}, in its leader's colour")],
        };
        (agents, names)
    };
    config.agents.iter().map(role).collect()
}

/// The legend below a map: symbols with their texts.
#[derive(Default)]
pub(crate) struct Legend {
    entries: Vec<(Symbol, String)>,
}

/// A symbol, its text and their position.
type Placed<'a> = (&'a Symbol, String, [f64; 2]);

impl Legend {
    const ROW: f64 = 4.2;

    /// Returns the legend of the symbols that occur on the maps of these teams of a config. `counts` explains the labels of
    /// POIs that are not observed, if they have any.
    pub fn new(config: &Config, view: &Viewport, teams: &[Team], counts: &str) -> Legend {
        let mut entries = Vec::new();
        let mut add = |symbol: Symbol, text: &str| entries.push((symbol, text.to_string()));
        let Some(team) = teams.first() else { return Legend::default() };
        let mut pois = teams.iter().flat_map(|team| &team.pois);
        let symbol = |agent: &Marker, group, counts, size, leads| {
            let (heading, trail) = (DVec2::Y, vec![]);
            Symbol::Agent(Marker { heading, group, counts, trail, ..*agent }, size, leads)
        };
        let all = config.agent_count();
        let drawn = drawn_agents(team.leaders, all);
        for (agents, [name, in_color]) in roles(config, team.leaders, all) {
            let of_class = drawn.iter().zip(&team.agents).filter(|(agent, _)| agents.contains(agent));
            let of_class: Vec<&Marker> = of_class.map(|(_, agent)| agent).collect();
            let leads = agents.start < team.leaders;
            // Followers in colours have that of the first leader here.
            let group =
                of_class.iter().any(|agent| agent.group.is_some()).then_some(if leads { agents.start } else { 0 });
            let size = if leads { 1.6 } else { 1.4 };
            if let Some(first) = of_class.first() {
                add(symbol(first, group, true, size, leads), if group.is_some() { &in_color } else { &name });
            }
        }
        if pois.clone().any(|poi| poi.observed) {
            let fill = Fill { color: COLORS[2], opacity: 0.22 };
            add(Symbol::Poi(Some(fill), Pen::new(COLORS[2], 0.25)), "observed POI, with its step");
        }
        if let Some(agent) = team.agents.iter().position(|agent| !agent.counts) {
            add(symbol(&team.agents[agent], None, false, 1.5, agent < team.leaders), "does not observe");
        }
        let unobserved = |dash| Symbol::Poi(None, Pen { dash, ..Pen::new(GREY, 0.25) });
        if pois.clone().any(|poi| !poi.observed && !poi.open) {
            add(unobserved(CLOSED), "POI that cannot be observed now");
        }
        if pois.clone().any(|poi| !poi.observed && poi.open) {
            add(unobserved(&[0.7, 0.5]), "POI");
        }
        // An observed POI's label has no number of agents.
        if !counts.is_empty() && pois.any(|poi| !poi.observed) {
            let has_room = view.poi_labels(team).is_some();
            add(Symbol::None, if has_room { counts } else { "ring: share of the agents needed that is near" });
        }
        let units = round_step(8.0 / view.scale);
        add(Symbol::Scale(units * view.scale), &format!("{units} map units"));
        Legend { entries }
    }

    /// Adds a remark without a symbol.
    pub fn note(&mut self, text: impl Into<String>) {
        self.entries.push((Symbol::None, text.into()));
    }

    /// Returns the entries in rows of a given width, each with its position, and the height of all rows, in millimetres.
    /// An entry that is longer than a row is broken between words.
    fn places(&self, width: f64) -> (Vec<Placed<'_>>, f64) {
        let (mut x, mut y) = (0.0, 0.0);
        let mut places = Vec::new();
        for (symbol, text) in &self.entries {
            let length = |text: &str| symbol.width() + text_width(text, LABEL);
            if x > 0.0 && x + length(text) > width {
                (x, y) = (0.0, y + Self::ROW);
            }
            let mut row = String::new();
            for word in text.split_inclusive(' ') {
                if !row.is_empty() && length(&(row.clone() + word)) > width {
                    places.push((symbol, std::mem::take(&mut row), [x, y]));
                    y += Self::ROW;
                }
                row += word;
            }
            let end = length(&row) + 3.5;
            places.push((symbol, row, [x, y]));
            x += end;
        }
        (places, y + Self::ROW)
    }

    /// Returns the height of the legend below a map of this width, in millimetres.
    pub fn height(&self, width: f64) -> f64 {
        self.places(width).1
    }

    /// Draws the legend from a place on the first row's baseline.
    pub fn draw(&self, scene: &mut Scene, [left, first]: [f64; 2], width: f64) {
        for (symbol, text, [x, y]) in self.places(width).0 {
            symbol.draw(scene, [left + x, first + y]);
            let color = if symbol.width() > 0.0 { BLACK } else { FAINT };
            scene.text([left + x + symbol.width(), first + y], text, LABEL, Anchor::Start, color);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_longer_than_a_row_is_broken() {
        let mut legend = Legend::default();
        legend.note("a short one");
        legend.note("2 × as fast as it was; motion between steps is drawn straight");
        let (places, height) = legend.places(40.0);
        assert!(places.len() >= 3 && height >= 3.0 * Legend::ROW, "{} rows", places.len());
        for (_, text, [x, y]) in places {
            assert!(x + text_width(text.trim_end(), LABEL) <= 40.0 && y < height, "{text:?} at {x}, {y}");
        }
    }
}
