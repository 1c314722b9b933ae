//! The section `[world]`: its data and keys.

use std::f64::consts::FRAC_PI_2;

use super::classes::{ClassSummary, GroupSummary};
use super::{Control, Coupling, Observers, Paradigm};
use crate::model::rule::{after, windows};
use crate::model::start::Heading;
use crate::model::{LEAST, LONGEST};
use crate::reader::{Allowed, Reader, between, section};

/// Maximum number of agents in a team.
pub const MAX_AGENTS: usize = 1 << 20;
/// Maximum number of agents in a team that learn, and of agents that `[world]` lists.
pub const MAX_LEARNERS: usize = 1024;
/// Maximum number of POIs in a world.
pub const MAX_POIS: usize = 256;
/// Maximum number of steps in an episode.
pub const MAX_STEPS: usize = 10_000;
/// Maximum bytes of the record of one team's episode.
pub(super) const MAX_RECORD_BYTES: u64 = 1 << 30;

section! {
    /// `[world]`: where everything starts, how long an episode is, and who observes a POI. Positions are `[x, y]` in
    /// map units, time is in seconds, angles in radians.
    WorldConfig = "world" {
        /// width and height; positions stay within 0 to these
        map: [f64; 2] = "units", "3.1",
        /// start positions of the leaders, which are agents 0 to L − 1
        leaders: Vec<[f64; 2]> = "units", "4.1, Fig. 3",
        /// start positions of the followers, agents L to N − 1; in the all-leaders paradigm, of more leaders
        followers: Vec<[f64; 2]> = "units", "4.1, Fig. 3",
        /// positions of the P points of interest, which do not move while teams play
        pois: Vec<[f64; 2]> = "units", "3.1, Fig. 3",
        /// C: number of agents that a POI needs at the same step to be observed; one number for all POIs, or one per
        /// POI
        coupling: Coupling = "agents", "3.2, Eq. 2",
        /// σ₀: distance up to which an agent observes a POI
        observation_radius: f64 = "units", "3.2, Eq. 3",
        /// agents that count at a POI; the coupling is at most their number
        observers: Observers = "", "5",
        /// the first and the last step of each POI at which it can be observed; a window of all
        /// steps has the start, too, if world.start_counts is true
        windows: Vec<[usize; 2]> = "steps", "5",
        /// for each POI, the POIs (indices into world.pois, from 0) that must have been observed at an earlier step
        /// before it can be
        after: Vec<Vec<usize>> = "POIs", "5",
        /// T: length of an episode
        steps: usize = "steps", "3.2, Eq. 2",
        /// whether the start counts as a step, step 0, at which agents observe and influence others
        start_counts: bool = "", "3.2, Eq. 2",
        /// duration of a step
        dt: f64 = "s", "",
        /// headings at the start, from the x axis towards the y axis (π/2 faces the POIs of the paper's layouts): one
        /// number for all agents, one per leader (a follower takes that of the leader nearest to it), or one per agent
        heading: Heading = "rad", "3.1, Fig. 3",
        /// speed of every agent at the start
        speed: f64 = "units/s", "3.1",
    }
}

impl WorldConfig {
    /// Reads the section. `start_speed` limits the agents' start speed. `observers` is the number of agents that observe
    /// if `[[agents]]` replaces leaders and followers, and `has_pois` means that `[[pois]]` replaces POIs. Also returns
    /// the range of positions on each axis.
    pub(super) fn read(
        r: &mut Reader<'_>,
        start_speed: Allowed<f64>,
        paradigm: Paradigm,
        observers_in_full: Option<usize>,
        has_pois: bool,
    ) -> (WorldConfig, [Allowed<f64>; 2]) {
        let none = |replaced: bool| replaced.then(Vec::new);
        let has_agents = observers_in_full.is_some();
        let map = WorldConfig::map(r).pair(between(1.0, LONGEST), [50.0, 50.0]);
        let sides = map.map(|side| between(LEAST, side).or_zero().because("the map"));
        let leaders = WorldConfig::leaders(r).positions(1..=MAX_LEARNERS, sides, none(has_agents));
        let followers = WorldConfig::followers(r).positions(0..=MAX_LEARNERS - 1, sides, Some(vec![]));
        let pois = WorldConfig::pois(r).positions(1..=MAX_POIS, sides, none(has_pois));
        let agents = leaders.as_ref().zip(followers.as_ref()).map_or(MAX_LEARNERS, |(l, f)| l.len() + f.len());
        if agents > MAX_LEARNERS {
            let message = format!("found {agents} agents with the leaders, allowed 1 to {MAX_LEARNERS}");
            r.report_key("world.followers", message);
        }
        let observers = WorldConfig::observers(r).choice(Observers::All);
        let counted = match (leaders.as_ref(), followers.as_ref(), paradigm) {
            _ if has_pois => MAX_LEARNERS,
            _ if has_agents => observers_in_full.filter(|&count| count > 0).unwrap_or(MAX_AGENTS),
            (Some(leaders), Some(followers), Paradigm::LeaderFollower) => {
                observers.among(leaders.len(), followers.len()).len()
            }
            (Some(_), Some(_), Paradigm::AllLeaders) => observers.among(agents, 0).len(),
            _ => MAX_LEARNERS,
        };
        if counted == 0 {
            let why = if paradigm == Paradigm::AllLeaders { "all agents lead" } else { "there are no followers" };
            r.report_key("world.observers", format!("found \"{observers}\", but {why}, so nobody would observe"));
        }
        let places = pois.as_ref().filter(|_| !has_pois).map(Vec::len);
        let steps = WorldConfig::steps(r).number(between(1, MAX_STEPS), 25);
        let counts =
            leaders.as_ref().zip(followers.as_ref()).map(|(leaders, followers)| [leaders.len(), followers.len()]);
        let heading = heading(r, counts);
        let world = WorldConfig {
            map,
            coupling: WorldConfig::coupling(r).one_or_each(
                between(1, counted.max(1)).because(observers.counted()),
                places.map_or(0..=usize::MAX, |pois| pois..=pois),
                3,
            ),
            observers,
            windows: windows(WorldConfig::windows(r), ("world.pois", places), steps),
            after: after(WorldConfig::after(r), places),
            leaders: leaders.unwrap_or_default(),
            followers: followers.unwrap_or_default(),
            pois: pois.unwrap_or_default(),
            observation_radius: WorldConfig::observation_radius(r).number(between(0.01, LONGEST), 5.0),
            steps,
            start_counts: WorldConfig::start_counts(r).flag(false),
            dt: WorldConfig::dt(r).number(between(1e-4, 10.0), 0.2),
            heading,
            speed: WorldConfig::speed(r).number(start_speed, 0.0),
        };
        (world, sides)
    }

    /// Returns the classes that other tables can refer to.
    pub(super) fn class_summaries(&self, paradigm: Paradigm) -> Vec<ClassSummary> {
        let class = |name: &str, control: Control, agents: usize| ClassSummary {
            name: name.into(),
            has_rule: control == Control::Follow,
            control: Some(control),
            agents,
            observes: true,
        };
        let (leaders, followers) = (self.leaders.len(), self.followers.len());
        match paradigm {
            Paradigm::LeaderFollower if followers > 0 => {
                vec![class("leader", Control::Policy, leaders), class("follower", Control::Follow, followers)]
            }
            _ => vec![class("leader", Control::Policy, leaders + followers)],
        }
    }

    /// Returns the groups of POIs that other tables can refer to.
    pub(super) fn group_summaries(&self) -> Vec<GroupSummary> {
        let group = |name: String, pois: usize| GroupSummary { name, pois, value: 1.0 };
        match self.after.iter().all(Vec::is_empty) {
            true => vec![group("poi".into(), self.pois.len())],
            false => (0..self.pois.len()).map(|poi| group(format!("poi{poi}"), 1)).collect(),
        }
    }

    /// Returns each agent's heading at the start in radians, leaders first.
    pub fn headings(&self) -> Vec<f64> {
        self.heading.of_agents(&self.leaders, &self.followers)
    }
}

/// Reads the start headings. `counts` are the numbers of leaders and followers, `None` if they are unknown.
fn heading(r: &mut Reader<'_>, counts: Option<[usize; 2]>) -> Heading {
    let errors_before = r.error_count();
    let heading = WorldConfig::heading(r).one_or_each(between(-1e3, 1e3), 0..=usize::MAX, FRAC_PI_2);
    if let (Heading::Each(headings), Some([leaders, followers])) = (&heading, counts)
        && r.error_count() == errors_before
        && ![leaders, leaders + followers].contains(&headings.len())
    {
        let per_agent = match followers {
            0 => String::new(),
            _ => format!(" or {} (one per agent)", leaders + followers),
        };
        let found = headings.len();
        let message =
            format!("found a list of {found}, allowed one number or a list of {leaders} (one per leader){per_agent}");
        r.report_key("world.heading", message);
    }
    heading
}
