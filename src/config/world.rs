//! The section `[world]`: its data and keys.

use super::{Coupling, Observers, Paradigm};
use crate::model::couple::observation_radius;
use crate::model::rule::{after, windows};
use crate::model::start::Heading;
use crate::model::{LEAST, LONGEST};
use crate::reader::{Allowed, Reader, between, section};

/// Maximum number of agents (leaders and followers) in a team.
pub const MAX_AGENTS: usize = 1024;
/// Maximum number of POIs in a world.
pub const MAX_POIS: usize = 256;
/// Maximum number of steps in an episode.
pub const MAX_STEPS: usize = 10_000;
/// Checks that a team's record is smaller than 1 GiB in every config.
const _: () = {
    // Sightings take the most memory if half of the agents are followers.
    let (sets, sights) = (MAX_POIS * MAX_AGENTS.div_ceil(32), MAX_AGENTS / 2 * (MAX_AGENTS / 2).div_ceil(32));
    assert!(MAX_STEPS * (sets + sights) * size_of::<u32>() < 1 << 30);
};

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
        /// Agents needed at each POI (C).
        coupling: Coupling,
        /// Observation radius σ₀, in units.
        observation_radius: f64,
        /// The agents whose presence at a POI counts.
        observers: Observers,
        /// The first and the last step, from 1, at which each POI can be observed. Empty if POIs are always open.
        windows: Vec<[usize; 2]>,
        /// For each POI, those that must be observed before it. Empty if the order is free.
        after: Vec<Vec<usize>>,
        /// T: length of an episode
        steps: usize = "steps", "3.2, Eq. 2",
        /// duration of a step
        dt: f64 = "s", "",
        /// Agents' headings at the start, in radians from the x axis towards the y axis.
        heading: Heading,
        /// speed of every agent at the start
        speed: f64 = "units/s", "3.1",
    }
}

impl WorldConfig {
    /// Reads the section. `start_speed` limits the agents' start speed.
    pub(super) fn read(r: &mut Reader<'_>, start_speed: Allowed<f64>, paradigm: Paradigm) -> WorldConfig {
        let map = WorldConfig::map(r).pair(between(1.0, LONGEST), [50.0, 50.0]);
        let sides = map.map(|side| between(LEAST, side).or_zero().because("the map"));
        let leaders = WorldConfig::leaders(r).positions(1..=MAX_AGENTS, sides, None);
        let followers = WorldConfig::followers(r).positions(0..=MAX_AGENTS - 1, sides, Some(vec![]));
        let pois = WorldConfig::pois(r).positions(1..=MAX_POIS, sides, None);
        let agents = leaders.as_ref().zip(followers.as_ref()).map_or(MAX_AGENTS, |(l, f)| l.len() + f.len());
        if agents > MAX_AGENTS {
            let message = format!("found {agents} agents with the leaders, allowed 1 to {MAX_AGENTS}");
            r.report_key("world.followers", message);
        }
        let observers = Observers::read(r);
        let counted = match (leaders.as_ref(), followers.as_ref(), paradigm) {
            (Some(leaders), Some(followers), Paradigm::LeaderFollower) => {
                observers.among(leaders.len(), followers.len()).len()
            }
            (Some(_), Some(_), Paradigm::AllLeaders) => observers.among(agents, 0).len(),
            _ => MAX_AGENTS,
        };
        if counted == 0 {
            let why = if paradigm == Paradigm::AllLeaders { "all agents lead" } else { "there are no followers" };
            r.report_key("world.observers", format!("found \"{observers}\", but {why}, so nobody would observe"));
        }
        let places = pois.as_ref().map(Vec::len);
        let steps = WorldConfig::steps(r).number(between(1, MAX_STEPS), 25);
        let counts =
            leaders.as_ref().zip(followers.as_ref()).map(|(leaders, followers)| [leaders.len(), followers.len()]);
        let heading = Heading::read(r, counts);
        WorldConfig {
            map,
            coupling: Coupling::read(r, counted.clamp(1, MAX_AGENTS), observers.counted(), places),
            observers,
            windows: windows(r, steps, places),
            after: after(r, places),
            leaders: leaders.unwrap_or_default(),
            followers: followers.unwrap_or_default(),
            pois: pois.unwrap_or_default(),
            observation_radius: observation_radius(r),
            steps,
            dt: WorldConfig::dt(r).number(between(1e-4, 10.0), 0.2),
            heading,
            speed: WorldConfig::speed(r).number(start_speed, 0.0),
        }
    }

    /// Returns each agent's heading at the start in radians, leaders first.
    pub fn headings(&self) -> Vec<f64> {
        self.heading.of_agents(&self.leaders, &self.followers)
    }
}
