//! Layouts for new experiments: groups of a leader and its followers, and POIs ahead of them.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::fmt::Write;

use glam::DVec2;

use flotilla::config::{Config, ConfigError, MAX_LEARNERS, MAX_POIS};
use flotilla::reach;
use flotilla_app::report::map::counted;

/// The arrangement of groups and POIs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pattern {
    /// Groups around the centre look outwards; POIs are around them.
    Ring,
    /// Groups side by side; POIs in a row ahead of them.
    Row,
    /// Groups side by side; POIs in several rows ahead of them.
    Grid,
}

/// The patterns by name.
pub(super) const SHAPES: [(&str, Pattern); 3] =
    [("ring", Pattern::Ring), ("row", Pattern::Row), ("grid", Pattern::Grid)];

/// Distance from a leader to the POI ahead of it, and between groups side by side, in units.
const APART: f64 = 10.0;
/// Distance from a leader back to its first followers, in units. They see it within the default attraction radius of 5.
const BEHIND: f64 = 3.0;
/// Margin around all agents and POIs, in units: a POI's observation radius and some room.
const EDGE: f64 = 8.0;

/// A requested layout.
#[derive(Clone, Copy, Debug)]
pub(super) struct StartLayout {
    pub shape: Pattern,
    pub groups: usize,
    pub followers: usize,
    pub pois: usize,
    pub coupling: usize,
}

impl StartLayout {
    /// Returns an error message if a number is not allowed.
    pub fn problem(&self) -> Option<String> {
        let agents = self.groups.saturating_mul(self.followers.saturating_add(1));
        match agents {
            _ if self.groups == 0 => Some("--groups 0: allowed at least 1".into()),
            _ if self.pois == 0 || self.pois > MAX_POIS => {
                Some(format!("--pois {}: allowed 1 to {MAX_POIS}", self.pois))
            }
            _ if agents > MAX_LEARNERS => Some(format!(
                "--groups {} --followers {}: these are {agents} agents, allowed 1 to {MAX_LEARNERS}",
                self.groups, self.followers
            )),
            _ if self.coupling == 0 || self.coupling > agents => {
                Some(format!("--coupling {}: allowed 1 to {agents}, the number of agents", self.coupling))
            }
            _ => None,
        }
    }

    /// Returns the text of the config file: a comment that describes the layout, and the layout's keys.
    pub fn text(&self) -> Result<String, ConfigError> {
        let short = Config::parse(&self.with_steps(1), "layout")?;
        // An episode is long enough to reach the farthest POI with time to spare.
        let nearest = |poi: &[f64; 2]| {
            let away = |leader: &[f64; 2]| DVec2::from(*poi).distance((*leader).into());
            short.world.leaders.iter().map(away).fold(f64::INFINITY, f64::min)
        };
        let farthest = short.world.pois.iter().map(nearest).fold(0.0, f64::max);
        let most = flotilla::config::MAX_STEPS;
        let travel = reach::travel(&short, &short.classes().agents[0], most);
        let enough = travel.iter().position(|&travel| travel >= 1.5 * farthest + BEHIND).unwrap_or(most);
        let text = self.with_steps(enough.next_multiple_of(5).clamp(25, most));
        Config::parse(&text, "layout").map(|_| text)
    }

    /// Returns the position and heading of each group's leader at the start.
    fn groups(&self) -> Vec<(DVec2, f64)> {
        let group = |index: usize| match self.shape {
            Pattern::Ring => {
                let heading = TAU * index as f64 / self.groups as f64;
                (DVec2::from_angle(heading) * self.radius(), heading)
            }
            Pattern::Row | Pattern::Grid => (DVec2::new(APART * index as f64, 0.0), FRAC_PI_2),
        };
        (0..self.groups).map(group).collect()
    }

    /// Returns the radius of the leaders' ring. It is large enough that neighbouring groups do not attract each other.
    fn radius(&self) -> f64 {
        let around = 8.0 * self.groups as f64 / TAU + BEHIND;
        if self.groups == 1 { 0.0 } else { around.max(6.0) }
    }

    fn pois(&self) -> Vec<DVec2> {
        let pois = self.pois;
        let width = APART * (self.groups - 1) as f64;
        // The middle of one of `count` equal shares of a width.
        let spread = |index: usize, count: usize, width: f64| (index as f64 + 0.5) / count as f64 * width;
        let at = |index: usize| match self.shape {
            Pattern::Ring => DVec2::from_angle(TAU * index as f64 / pois as f64) * (self.radius() + APART),
            Pattern::Row => DVec2::new(spread(index, pois, width + APART) - APART / 2.0, APART),
            Pattern::Grid => {
                let columns = (pois as f64).sqrt().ceil() as usize;
                let row = index / columns;
                let in_row = columns.min(pois - row * columns);
                let wide = (width + APART).max(APART * columns as f64);
                let x = spread(index % columns, in_row, wide) - (wide - width) / 2.0;
                DVec2::new(x, APART * (row + 1) as f64)
            }
        };
        (0..pois).map(at).collect()
    }

    /// Returns where followers start relative to a leader that faces along the x axis: in rows behind it.
    fn behind(&self) -> Vec<DVec2> {
        let columns = self.followers.min(3).max(self.followers.div_ceil(3)).max(1);
        let across = |column: usize, of: usize| match of {
            1 => 0.0,
            _ => 4.0 * column as f64 / (of - 1) as f64 - 2.0,
        };
        let one = |index: usize| {
            let row = index / columns;
            DVec2::new(-BEHIND - 0.6 * row as f64, across(index % columns, columns.min(self.followers - row * columns)))
        };
        (0..self.followers).map(one).collect()
    }

    fn with_steps(&self, steps: usize) -> String {
        let groups = self.groups();
        let followers = groups.iter().flat_map(|&(place, heading)| {
            let turn = DVec2::from_angle(heading);
            self.behind().into_iter().map(move |behind| place + turn.rotate(behind))
        });
        let (leaders, followers): (Vec<DVec2>, Vec<DVec2>) =
            (groups.iter().map(|(place, _)| *place).collect(), followers.collect());
        let pois = self.pois();
        let all = || leaders.iter().chain(&followers).chain(&pois);
        let corner = all().copied().reduce(DVec2::min).unwrap_or_default() - EDGE;
        let map = (all().copied().reduce(DVec2::max).unwrap_or_default() + EDGE - corner).ceil();
        let places = |places: &[DVec2]| {
            let one = |place: &DVec2| {
                let [x, y] = (*place - corner).to_array().map(|at| (at * 100.0).round() / 100.0);
                format!("[{x:?}, {y:?}]")
            };
            format!("[{}]", places.iter().map(one).collect::<Vec<_>>().join(", "))
        };
        let headings: Vec<_> =
            groups.iter().map(|(_, heading)| format!("{:?}", (heading * 1e6).round() / 1e6)).collect();
        let needed = self.coupling;
        let mut text = self.header(needed);
        let _ = write!(
            text,
            "\n[world]\nmap = [{:?}, {:?}]\nleaders = {}\nfollowers = {}\npois = {}\ncoupling = {needed}\nsteps = {steps}\n",
            map.x,
            map.y,
            places(&leaders),
            places(&followers),
            places(&pois),
        );
        if self.shape == Pattern::Ring {
            let _ = writeln!(text, "heading = [{}]", headings.join(", "));
        }
        text
    }

    fn header(&self, needed: usize) -> String {
        let StartLayout { groups, followers, pois, .. } = *self;
        let (name, looks) = match self.shape {
            Pattern::Ring => ("Ring", "start around the centre of the map and face outwards"),
            Pattern::Row => ("Row", "start side by side and face up"),
            Pattern::Grid => ("Grid", "start side by side and face up"),
        };
        let place = match self.shape {
            Pattern::Ring => "on a ring around them",
            Pattern::Row => "in a row ahead of them",
            Pattern::Grid => "in rows ahead of them",
        };
        format!(
            "# {name}: {}, each a leader with {}.\n#\n# The groups {looks}. The {} {} {place}.\n# A POI is \
             observed when {} {} within its radius in the same step.\n",
            counted(groups, "group"),
            counted(followers, "follower"),
            counted(pois, "POI"),
            if pois == 1 { "is" } else { "are" },
            counted(needed, "agent"),
            if needed == 1 { "is" } else { "are" },
        )
    }
}
