//! The legend below a map.

use glam::DVec2;

use super::{CLOSED, FAINT, LABEL, Team, Viewport, arrow, strike};
use crate::report::curves::round_step;
use crate::report::scene::{Anchor, BLACK, COLORS, Fill, GREY, Pen, Scene, text_width};
use flotilla::config::Config;

/// The symbol of an entry, drawn from a place on the baseline.
enum Symbol {
    None,
    /// An agent of a size, its heading, its group, whether it leads, and whether it observes.
    Agent(f64, Option<DVec2>, Option<usize>, bool, bool),
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
            Symbol::Agent(_, _, _, _, false) => 3.4,
            Symbol::Agent(..) | Symbol::Poi(..) => 3.0,
            Symbol::Scale(length) => length + 1.0,
        }
    }

    fn draw(&self, scene: &mut Scene, [x, y]: [f64; 2]) {
        match *self {
            Symbol::None => {}
            Symbol::Agent(size, heading, group, leads, observes) => {
                let place = [x + if observes { 1.2 } else { 1.4 }, y - 0.8];
                arrow(scene, place, heading, size, group, leads);
                if !observes {
                    strike(scene, place, heading, size);
                }
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

/// Returns the names of leaders, by the group of the first, of followers in the colour of their leader, and of other
/// followers. With `[[agents]]` these are names of classes.
fn roles(config: &Config, leaders: usize) -> (Vec<(usize, String)>, [String; 2]) {
    if config.agents.is_empty() {
        let leader = if leaders > 1 { "leader, by number" } else { "leader" };
        return (vec![(0, leader.into())], ["its follower", "follower"].map(String::from));
    }
    let (learning, others): (Vec<_>, Vec<_>) = config.agents.iter().partition(|class| class.learns());
    let mut first = 0;
    let numbered = learning.iter().map(|class| {
        let last = first + class.size() - 1;
        let numbers = if first == last { first.to_string() } else { format!("{first} to {last}") };
        let of_first = std::mem::replace(&mut first, last + 1);
        (of_first, if leaders > 1 { format!("{} {numbers}", class.name) } else { class.name.clone() })
    });
    let leader = numbered.collect();
    let follower = others.iter().map(|class| class.name.as_str()).collect::<Vec<_>>().join(" or ");
    (leader, [format!("{follower}, in its leader's colour"), follower])
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

    /// Returns the legend of the symbols that occur on the maps of these teams of a config.
    pub fn new(config: &Config, view: &Viewport, teams: &[Team], counts: &str) -> Legend {
        let mut entries = Vec::new();
        let mut add = |symbol: Symbol, text: &str| entries.push((symbol, text.to_string()));
        let Some(team) = teams.first() else { return Legend::default() };
        let mut pois = teams.iter().flat_map(|team| &team.pois);
        let (leading, [its_follower, follower]) = roles(config, team.leaders);
        let heading = |agent: usize| team.agents[agent].heading.map(|_| DVec2::Y);
        for (first, leader) in leading {
            add(Symbol::Agent(1.6, heading(first), Some(first), true, true), &leader);
        }
        let followers = &team.agents[team.leaders..];
        if followers.iter().any(|agent| agent.group.is_some()) {
            add(Symbol::Agent(1.4, heading(team.leaders), Some(0), false, true), &its_follower);
        } else if !followers.is_empty() {
            add(Symbol::Agent(1.4, heading(team.leaders), None, false, true), &follower);
        }
        if pois.clone().any(|poi| poi.observed) {
            let fill = Fill { color: COLORS[2], opacity: 0.22 };
            add(Symbol::Poi(Some(fill), Pen::new(COLORS[2], 0.25)), "observed POI, with its step");
        }
        if let Some(agent) = team.agents.iter().position(|agent| !agent.counts) {
            add(Symbol::Agent(1.5, heading(agent), None, agent < team.leaders, false), "does not observe");
        }
        let unobserved = |dash| Symbol::Poi(None, Pen { dash, ..Pen::new(GREY, 0.25) });
        if pois.clone().any(|poi| !poi.observed && !poi.open) {
            add(unobserved(CLOSED), "POI that cannot be observed now");
        }
        if pois.any(|poi| !poi.observed && poi.open) {
            add(unobserved(&[0.7, 0.5]), "POI");
        }
        if !counts.is_empty() {
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
