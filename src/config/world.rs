//! `[world]`: its data and its keys.

use std::f64::consts::FRAC_PI_2;

use serde::Serialize;

use super::{Coupling, Observers, Paradigm};
use crate::model::couple::{after, observation_radius, windows};
use crate::model::{LEAST, LONGEST};
use crate::reader::{Allowed, Reader, between};

/// Most agents (leaders and followers) in a team.
pub const MAX_AGENTS: usize = 1024;
/// Most POIs in a world.
pub const MAX_POIS: usize = 256;
/// Most steps in an episode.
pub const MAX_STEPS: usize = 10_000;
/// A team's record stays under a gigabyte whatever the config.
const _: () = {
    // Half of the agents follow where sights take most.
    let (sets, sights) = (MAX_POIS * MAX_AGENTS.div_ceil(32), MAX_AGENTS / 2 * (MAX_AGENTS / 2).div_ceil(32));
    assert!(MAX_STEPS * (sets + sights) * size_of::<u32>() < 1 << 30);
};

/// `[world]`: where everything starts. Lengths in map units, time in seconds, angles in radians.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Domain {
    pub map: [f64; 2],
    pub leaders: Vec<[f64; 2]>,
    pub followers: Vec<[f64; 2]>,
    pub pois: Vec<[f64; 2]>,
    pub coupling: Coupling,
    pub observation_radius: f64,
    pub observers: Observers,
    /// The first and the last step, from 1, at which each POI can be observed; empty where that is any.
    pub windows: Vec<[usize; 2]>,
    /// The POIs that each comes after; empty where none comes after any.
    pub after: Vec<Vec<usize>>,
    pub steps: usize,
    pub dt: f64,
    pub heading: f64,
    pub speed: f64,
}

impl Domain {
    /// Reads the section; agents start with one of these speeds, and learn by this paradigm.
    pub(super) fn read(r: &mut Reader<'_>, start_speed: Allowed<f64>, paradigm: Paradigm) -> Domain {
        let map = r
            .key("world.map", "units", "width and height; positions stay within 0 to these", "3.1")
            .pair(between(1.0, LONGEST), [50.0, 50.0]);
        let sides = map.map(|side| between(LEAST, side).or_zero().because("the map"));
        let leaders = r
            .key("world.leaders", "units", "start positions of the leaders, which are agents 0 to L − 1", "4.1, Fig. 3")
            .positions(1..=MAX_AGENTS, sides, None);
        let followers = r
            .key(
                "world.followers",
                "units",
                "start positions of the followers, agents L to N − 1; in the all-leaders paradigm leaders stand there",
                "4.1, Fig. 3",
            )
            .positions(0..=MAX_AGENTS - 1, sides, Some(vec![]));
        let pois = r
            .key(
                "world.pois",
                "units",
                "positions of the P points of interest, which stay where they are",
                "3.1, Fig. 3",
            )
            .positions(1..=MAX_POIS, sides, None);
        let agents = leaders.as_ref().zip(followers.as_ref()).map_or(MAX_AGENTS, |(l, f)| l.len() + f.len());
        if agents > MAX_AGENTS {
            let message = format!("found {agents} agents with the leaders, allowed 1 to {MAX_AGENTS}");
            r.blame_key("world.followers", message);
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
            r.blame_key("world.observers", format!("found \"{observers}\", but {why}, so nobody would observe"));
        }
        let places = pois.as_ref().map(Vec::len);
        let steps =
            r.key("world.steps", "steps", "T: length of an episode", "3.2, Eq. 2").number(between(1, MAX_STEPS), 25);
        Domain {
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
            dt: r.key("world.dt", "s", "time that a step takes", "").number(between(1e-4, 10.0), 0.2),
            heading: r
                .key(
                    "world.heading",
                    "rad",
                    "every agent's heading at the start, from the x axis towards the y axis: π/2 faces the POIs",
                    "3.1, Fig. 3",
                )
                .number(between(-1e3, 1e3), FRAC_PI_2),
            speed: r.key("world.speed", "units/s", "every agent's speed at the start", "3.1").number(start_speed, 0.0),
        }
    }
}
