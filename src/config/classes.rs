//! Classes of agents and groups of POIs: what every config describes, whether it is written in full or in short.
//!
//! `[[agents]]` and `[[pois]]` write them in full. The sections `[motion]`, `[follow]` and `[sense]`, and the keys of
//! `[world]` for leaders, followers and POIs, are short for two classes, `leader` and `follower`, and one group of POIs.

use serde::Serialize;

use super::{Config, Coupling, Density, Follow, Heading, Motion, Observers, Paradigm, Sense};
use crate::config_enum::config_enum;
use crate::model::sense::{Combine, Frame, Measure};
use crate::reader::OneOrEach;

/// Maximum number of classes of agents.
pub const MAX_CLASSES: usize = 8;
/// Maximum number of channels of a class's senses.
pub const MAX_CHANNELS: usize = 8;
/// Maximum number of terms of a class's rule.
pub const MAX_TERMS: usize = 8;
/// Maximum number of sectors of a channel.
pub const MAX_SECTORS: usize = 16;

/// The name that stands for all other agents in channels and terms.
pub const AGENTS: &str = "agents";
/// The name that stands for POIs in channels.
pub const POIS: &str = "pois";

/// The classes of agents and the groups of POIs of a config.
#[derive(Clone, Debug, PartialEq)]
pub struct Classes {
    /// The classes of agents. Those that learn come first. Agents are numbered class by class.
    pub agents: Vec<AgentClass>,
    /// The groups of POIs. POIs are numbered group by group.
    pub pois: Vec<PoiGroup>,
}

/// A class of agents, `[[agents]]`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AgentClass {
    /// The class's name: letters, digits, `_` and `-`.
    pub name: String,
    /// Start positions in units.
    pub at: Vec<[f64; 2]>,
    /// Headings at the start in radians, from the x axis towards the y axis: one for all, or one per agent.
    pub heading: OneOrEach<f64>,
    /// The speed at the start, in units per second.
    pub speed: f64,
    /// What decides how its agents move.
    pub control: Control,
    /// How its agents can move.
    pub motion: Mobility,
    /// The inputs of its policies, channel by channel.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub senses: Vec<Channel>,
    /// The terms of its rule.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rule: Vec<Term>,
    /// The distance in units within which walls push agents that obey a rule.
    pub wall_radius: f64,
    /// The push of a wall for each unit nearer than the wall radius, in 1/s.
    pub wall_gain: f64,
    /// The classes whose agents it influences.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub leads: Vec<String>,
    /// The distance in units up to which it influences them. By default, the largest radius of the led class's rule.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub influence_radius: Option<f64>,
    /// Whether it counts at POIs that do not name their observers.
    pub observes: bool,
}

config_enum! {
    /// What decides how an agent moves.
    Control {
        /// A policy, which learns.
        Policy = "policy",
        /// The class's rule.
        Follow = "follow",
        /// It stays where it is.
        Still = "still",
    }
}

/// How an agent can move.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum Mobility {
    /// It has a heading and a speed, and turns and accelerates within limits.
    Steered(Motion),
    /// It has any velocity whose components do not exceed a maximum, and no heading.
    Free {
        /// The largest speed along each axis of the map, in units per second.
        max_speed: f64,
    },
}

/// One channel of senses: what agents or POIs add to the inputs of a policy, sector by sector.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Channel {
    /// Names of classes, or [`AGENTS`], or [`POIS`].
    pub of: Vec<String>,
    /// The groups of POIs that it senses, of all if empty.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub pois: Vec<String>,
    /// The number of sectors of equal angle, counterclockwise.
    pub sectors: usize,
    /// What the sectors turn with.
    pub frame: Frame,
    /// The distance in units up to which it senses; may be infinite.
    pub range: f64,
    /// What an entity at a distance counts.
    pub measure: Measure,
    /// Nearer than this, in units, the inverse measures do not grow.
    pub nearest: f64,
    /// How the measures of a sector become one input.
    pub combine: Combine,
    /// The input of a sector with nothing in it.
    pub empty: f64,
    /// Multiplies the inputs of sectors that have something in them.
    pub gain: f64,
}

/// One term of a rule. It has either a gain or an alignment.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Term {
    /// Names of classes, or [`AGENTS`].
    pub of: Vec<String>,
    /// The distance in units above which an agent counts; 0 includes agents at the same place.
    pub from: f64,
    /// The distance in units up to which an agent counts.
    pub to: f64,
    /// The pull at the distance `to`, in units per second; a push if negative.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// The pull towards the others' mean heading, in units per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub align: Option<f64>,
}

/// A group of POIs, `[[pois]]`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PoiGroup {
    /// The group's name: letters, digits, `_` and `-`.
    pub name: String,
    /// Positions in units.
    pub at: Vec<[f64; 2]>,
    /// The weight of each POI in G.
    pub value: f64,
    /// Agents that each POI needs at the same step.
    pub coupling: Coupling,
    /// The distance in units up to which an agent observes one of them.
    pub radius: f64,
    /// The classes whose agents count here; if empty, every class that [observes](AgentClass::observes).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub observers: Vec<String>,
    /// The first and the last step, from 1, at which each POI can be observed. Empty if they are always open.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub windows: Vec<[usize; 2]>,
    /// The groups that must have been observed before, all their POIs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub after: Vec<String>,
}

impl Config {
    /// Returns the classes and groups, written out in full.
    pub fn classes(&self) -> Classes {
        Classes {
            agents: if self.agents.is_empty() { self.short_agents() } else { self.agents.clone() },
            pois: if self.pois.is_empty() { self.short_pois() } else { self.pois.clone() },
        }
    }

    /// Returns the classes that the short form stands for.
    fn short_agents(&self) -> Vec<AgentClass> {
        let Config { world, motion, follow, sense, learning, .. } = self;
        let headings = world.headings();
        let class = |name: &str, at: Vec<[f64; 2]>, first: usize, control: Control| AgentClass {
            name: name.into(),
            heading: match world.heading {
                Heading::Same(heading) => OneOrEach::Same(heading),
                Heading::Each(_) => OneOrEach::Each(headings[first..first + at.len()].to_vec()),
            },
            at,
            speed: world.speed,
            control,
            motion: Mobility::Steered(motion.clone()),
            senses: vec![],
            rule: vec![],
            wall_radius: follow.repulsion_radius,
            wall_gain: follow.wall_gain,
            leads: vec![],
            influence_radius: None,
            observes: match world.observers {
                Observers::All => true,
                Observers::Leaders => control == Control::Policy,
                Observers::Followers => control == Control::Follow,
            },
        };
        let (mut leaders, mut followers) = (world.leaders.clone(), world.followers.clone());
        if learning.paradigm == Paradigm::AllLeaders {
            leaders.append(&mut followers);
        }
        let count = leaders.len();
        let mut leader = AgentClass { senses: sense.channels(), ..class("leader", leaders, 0, Control::Policy) };
        if followers.is_empty() {
            return vec![leader];
        }
        leader.leads = vec!["follower".into()];
        leader.influence_radius = Some(follow.attraction_radius);
        let follower = AgentClass { rule: follow.terms(), ..class("follower", followers, count, Control::Follow) };
        vec![leader, follower]
    }

    /// Returns the groups that the short form stands for: one, or one per POI if some POIs come after others.
    fn short_pois(&self) -> Vec<PoiGroup> {
        let world = &self.world;
        let group = |name: String, at: &[[f64; 2]], coupling: Coupling, windows: &[[usize; 2]]| PoiGroup {
            name,
            at: at.to_vec(),
            value: 1.0,
            coupling,
            radius: world.observation_radius,
            observers: vec![],
            windows: windows.to_vec(),
            after: vec![],
        };
        if world.after.iter().all(Vec::is_empty) {
            return vec![group("poi".into(), &world.pois, world.coupling.clone(), &world.windows)];
        }
        let name = |poi: usize| format!("poi{poi}");
        let coupling = world.coupling.of_each(world.pois.len());
        let one = |(poi, at): (usize, &[f64; 2])| {
            let window = world.windows.get(poi).map_or(&[][..], std::slice::from_ref);
            let coupling = Coupling::Same(coupling[poi]);
            let after = world.after[poi].iter().map(|&other| name(other)).collect();
            PoiGroup { after, ..group(name(poi), std::slice::from_ref(at), coupling, window) }
        };
        world.pois.iter().enumerate().map(one).collect()
    }
}

impl Sense {
    /// Returns the channels that the section stands for: POIs, then other agents.
    fn channels(&self) -> Vec<Channel> {
        let channel = |of: &str, range: f64| Channel {
            of: vec![of.into()],
            pois: vec![],
            sectors: 4,
            frame: Frame::Heading,
            range,
            measure: if self.density == Density::Linear { Measure::Linear } else { Measure::Inverse },
            nearest: 1.0,
            combine: if self.density == Density::Mean { Combine::Mean } else { Combine::Share },
            empty: 0.0,
            gain: self.gain,
        };
        vec![channel(POIS, self.poi_range), channel(AGENTS, self.agent_range)]
    }
}

impl Follow {
    /// Returns the terms that the section stands for: repulsion, then attraction.
    fn terms(&self) -> Vec<Term> {
        let (near, far) = (self.repulsion_radius, self.attraction_radius);
        let term =
            |from: f64, to: f64, gain: f64| Term { of: vec![AGENTS.into()], from, to, gain: Some(gain), align: None };
        vec![term(0.0, near, -self.repulsion_gain), term(near, far, self.attraction_gain)]
    }
}
