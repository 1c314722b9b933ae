//! Classes of agents and groups of POIs: what every config describes, whether it is written in full or in short.
//!
//! `[[agents]]` and `[[pois]]` write them in full. The sections `[motion]`, `[follow]` and `[sense]`, and the keys of
//! `[world]` for leaders, followers and POIs, are short for two classes, `leader` and `follower`, and one group of POIs.

use serde::{Serialize, Serializer};

use super::{Config, Coupling, Density, Follow, Heading, Motion, Observers, Paradigm, Sense, Sharing, WorldConfig};
use crate::config_enum::config_enum;
use crate::model::sense::{Combine, Frame, Measure};
use crate::reader::{OneOrEach, Reader, includes, table};

mod read;
mod write;

pub(super) use read::{ClassSummary, GroupSummary, Summary, read_agents, read_pois};

/// Keys that `[[agents]]` replaces. A name that ends with a dot is a whole section.
pub(super) const REPLACED_BY_AGENTS: &[&str] = &[
    "world.leaders",
    "world.followers",
    "world.heading",
    "world.speed",
    "world.observers",
    "motion.",
    "follow.",
    "sense.",
    "learning.paradigm",
];
/// Keys that `[[pois]]` replaces.
pub(super) const REPLACED_BY_POIS: &[&str] =
    &["world.pois", "world.coupling", "world.observation_radius", "world.observers", "world.windows", "world.after"];

/// Maximum number of classes of agents.
pub const MAX_CLASSES: usize = 8;
/// Maximum number of channels of a class's senses.
pub const MAX_CHANNELS: usize = 8;
/// Maximum number of terms of a class's rule.
pub const MAX_TERMS: usize = 8;
/// Maximum number of sectors of a channel.
pub const MAX_SECTORS: usize = 16;

/// Maximum number of inputs of a class's policies.
pub const MAX_INPUTS: usize = 64;

/// Inputs of the leaders of the short form: POIs and agents in four quadrants each.
const SHORT_INPUTS: usize = 8;

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

table! {
    /// A class of agents, `[[agents]]`.
    AgentClass = "agents" {
        /// the class's name: letters, digits, `_` and `-`
        name: String = "",
        /// start positions of its agents, which are numbered class by class
        at: Vec<[f64; 2]> = "units",
        /// headings at the start, from the x axis towards the y axis: one number for all its agents, or one per agent
        heading: OneOrEach<f64> = "rad",
        /// speed at the start
        speed: f64 = "units/s",
        /// what decides how its agents move: a policy, which learns, its `rule`, or nothing, so that they stay where they
        /// are; classes that learn come first
        control: Control = "",
        /// how its agents can move, see below
        motion: Mobility = "",
        /// with control = "policy": what its policies sense, channel by channel, see below
        #[serde(skip_serializing_if = "Vec::is_empty")]
        senses: Vec<Channel> = "",
        /// with control = "follow": the terms of the force on its agents, see below
        #[serde(skip_serializing_if = "Vec::is_empty")]
        rule: Vec<Term> = "",
        /// distance within which walls push agents that obey a rule
        wall_radius: f64 = "units",
        /// push of a wall for each unit nearer than the wall radius
        wall_gain: f64 = "1/s",
        /// classes whose agents it influences, for Df and Dt
        #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "one_or_list")]
        leads: Vec<String> = "",
        /// distance up to which it influences them
        #[serde(skip_serializing_if = "Option::is_none")]
        influence_radius: Option<f64> = "units",
        /// whether it counts at POIs that do not name their observers
        observes: bool = "",
    }
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

table! {
    /// One channel of senses: what agents or POIs add to the inputs of a policy, sector by sector.
    Channel = "agents.senses" {
        /// what it senses: agents of these classes, "agents" for all other agents, or "pois"
        #[serde(serialize_with = "one_or_list")]
        of: Vec<String> = "",
        /// with of = "pois": the groups of POIs that it senses, by default all
        #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "one_or_list")]
        pois: Vec<String> = "",
        /// number of sectors of equal angle, counterclockwise; each is an input
        sectors: usize = "",
        /// what the sectors turn with: the agent's heading, so that the first begins straight behind, or the map, so that
        /// it begins at the x axis; always "map" with free motion
        frame: Frame = "",
        /// distance up to which it senses; with 0 it senses nothing; finite for "distance" and "closeness"
        range: f64 = "units",
        /// what something at distance d counts: 1 − d/(√2·max(map)) if linear, 1/max(d, nearest) if inverse, the square
        /// of that, e^(−d) if exponential, d/range if distance, 1 − d/range if closeness
        measure: Measure = "",
        /// distance below which the inverse measures do not grow
        nearest: f64 = "units",
        /// how the measures of a sector become its input: their sum divided by the number of such agents or POIs in the
        /// world, their sum, their mean, or the largest
        combine: Combine = "",
        /// input of a sector with nothing in it
        empty: f64 = "",
        /// multiplies the inputs of sectors with something in them
        gain: f64 = "",
    }
}

table! {
    /// One term of a rule. It has either a gain or an alignment.
    Term = "agents.rule" {
        /// agents that count: those of these classes, or "agents" for all others
        #[serde(serialize_with = "one_or_list")]
        of: Vec<String> = "",
        /// distance above which they count; 0 includes those at the same place
        from: f64 = "units",
        /// distance up to which they count
        to: f64 = "units",
        /// pull towards them at the distance `to`, less in proportion when nearer; a push if negative
        #[serde(skip_serializing_if = "Option::is_none")]
        gain: Option<f64> = "units/s",
        /// pull towards their mean heading
        #[serde(skip_serializing_if = "Option::is_none")]
        align: Option<f64> = "units/s",
    }
}

table! {
    /// A group of POIs, `[[pois]]`.
    PoiGroup = "pois" {
        /// the group's name: letters, digits, `_` and `-`
        name: String = "",
        /// positions of its POIs, which are numbered group by group
        at: Vec<[f64; 2]> = "units",
        /// weight of each POI in G
        value: f64 = "",
        /// agents that each POI needs at the same step; one number for all its POIs, or one per POI
        coupling: Coupling = "agents",
        /// distance up to which an agent observes one of its POIs
        radius: f64 = "units",
        /// classes whose agents count here, by default those that observe
        #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "one_or_list")]
        observers: Vec<String> = "",
        /// the first and the last step, from 1, at which each POI can be observed; one pair for all, or one per POI
        #[serde(skip_serializing_if = "Vec::is_empty")]
        windows: Vec<[usize; 2]> = "steps",
        /// groups whose POIs must all have been observed at earlier steps
        #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "one_or_list")]
        after: Vec<String> = "",
    }
}

/// Writes a list of one name as that name.
fn one_or_list<S: Serializer>(names: &[String], serializer: S) -> Result<S::Ok, S::Error> {
    if let [name] = names { name.serialize(serializer) } else { names.serialize(serializer) }
}

impl Classes {
    /// Returns the start position of each agent in units, `[agents]`.
    pub fn starts(&self) -> Vec<[f64; 2]> {
        self.agents.iter().flat_map(|class| class.at.iter().copied()).collect()
    }

    /// Returns each agent's heading at the start in radians, `[agents]`.
    pub fn headings(&self) -> Vec<f64> {
        self.agents.iter().flat_map(|class| class.heading.of_each(class.at.len())).collect()
    }

    /// Returns the index of each agent's class, `[agents]`.
    pub fn class_of_each(&self) -> Vec<usize> {
        let of_class = |(index, class): (usize, &AgentClass)| vec![index; class.at.len()];
        self.agents.iter().enumerate().flat_map(of_class).collect()
    }

    /// Returns the position of each POI in units, `[pois]`.
    pub fn places(&self) -> Vec<[f64; 2]> {
        self.pois.iter().flat_map(|group| group.at.iter().copied()).collect()
    }

    /// Returns the index of each POI's group, `[pois]`.
    pub fn group_of_each(&self) -> Vec<usize> {
        let of_group = |(index, group): (usize, &PoiGroup)| vec![index; group.at.len()];
        self.pois.iter().enumerate().flat_map(of_group).collect()
    }

    /// Returns the number of agents that each POI needs, `[pois]`.
    pub fn couplings(&self) -> Vec<u32> {
        self.pois.iter().flat_map(|group| group.coupling.of_each(group.at.len())).map(|count| count as u32).collect()
    }

    /// Returns the first and the last step of each POI, `[pois]`, in episodes of so many steps. Empty without windows.
    pub fn windows(&self, steps: usize) -> Vec<[usize; 2]> {
        if self.pois.iter().all(|group| group.windows.is_empty()) {
            return vec![];
        }
        let of_group = |group: &PoiGroup| match group.windows.is_empty() {
            true => vec![[1, steps]; group.at.len()],
            false => group.windows.clone(),
        };
        self.pois.iter().flat_map(of_group).collect()
    }

    /// Returns the POIs that each POI comes after, `[pois]`. Empty if their order is free.
    pub fn after(&self) -> Vec<Vec<usize>> {
        if self.pois.iter().all(|group| group.after.is_empty()) {
            return vec![];
        }
        let groups = self.group_of_each();
        let of_name = |name: &String| {
            let is_before = |(_, group): &(usize, &usize)| self.pois[**group].name == *name;
            groups.iter().enumerate().filter(is_before).map(|(poi, _)| poi).collect::<Vec<_>>()
        };
        let before = |group: &PoiGroup| group.after.iter().flat_map(of_name).collect::<Vec<_>>();
        self.pois.iter().flat_map(|group| vec![before(group); group.at.len()]).collect()
    }

    /// Reports whether the agents of a class count at a group's POIs.
    pub fn observes(&self, class: usize, group: usize) -> bool {
        let (class, group) = (&self.agents[class], &self.pois[group]);
        if group.observers.is_empty() { class.observes } else { group.observers.contains(&class.name) }
    }

    /// Returns the distance up to which agents of a class influence those of a class that it leads.
    pub fn influence_radius(&self, leader: usize, led: usize) -> Option<f64> {
        let (leader, led) = (&self.agents[leader], &self.agents[led]);
        let largest = || led.rule.iter().map(|term| term.to).fold(0.0, f64::max);
        leader.leads.contains(&led.name).then(|| leader.influence_radius.unwrap_or_else(largest))
    }
}

impl AgentClass {
    /// Reports whether its agents learn.
    pub fn learns(&self) -> bool {
        self.control == Control::Policy
    }

    /// Returns the number of inputs that its policies use.
    pub fn inputs(&self) -> usize {
        self.senses.iter().map(|channel| channel.sectors).sum()
    }

    /// Reports whether behaviours can use its inputs, which begin with POIs and agents in the quadrants around its heading.
    pub(super) fn senses_quadrants(&self) -> bool {
        let is_quadrants = |(channel, of): (&Channel, &str)| {
            channel.of == [of] && channel.sectors == 4 && channel.frame == Frame::Heading
        };
        self.senses.len() >= 2 && self.senses.iter().zip([POIS, AGENTS]).all(is_quadrants)
    }
}

impl Channel {
    /// Reports whether an agent of a class can never sense anything with this channel.
    pub(super) fn is_blind(&self, class: &AgentClass, classes: &Classes) -> bool {
        let sensed = |other: &&AgentClass| self.of.contains(&other.name) || self.of == [AGENTS];
        let others = || classes.agents.iter().filter(sensed).map(|other| other.at.len() - usize::from(other == class));
        self.range == 0.0 || self.of != [POIS] && others().sum::<usize>() == 0
    }
}

impl Config {
    /// Returns the number of agents in a team.
    pub fn agent_count(&self) -> usize {
        match &self.agents[..] {
            [] => self.world.leaders.len() + self.world.followers.len(),
            classes => classes.iter().map(|class| class.at.len()).sum(),
        }
    }

    /// Returns the number of POIs.
    pub fn poi_count(&self) -> usize {
        match &self.pois[..] {
            [] => self.world.pois.len(),
            groups => groups.iter().map(|group| group.at.len()).sum(),
        }
    }

    /// Returns the number of inputs of a policy: the most that the policies of any class use.
    pub fn inputs(&self) -> usize {
        let learning = self.agents.iter().filter(|class| class.learns());
        learning.map(AgentClass::inputs).max().unwrap_or(SHORT_INPUTS)
    }

    /// Returns the world in short as pictures draw it. Agents that learn are leaders, others are followers, and all POIs
    /// have the largest radius of any.
    pub fn drawn(&self) -> WorldConfig {
        let mut world = self.world.clone();
        let classes = self.classes();
        if !self.agents.is_empty() {
            let places = |learn: bool| {
                let shown = classes.agents.iter().filter(|class| class.learns() == learn);
                shown.flat_map(|class| class.at.iter().copied()).collect::<Vec<_>>()
            };
            (world.leaders, world.followers) = (places(true), places(false));
            world.heading = Heading::Each(classes.headings());
        }
        if !self.pois.is_empty() {
            world.pois = classes.places();
            world.coupling = Coupling::Each(classes.couplings().into_iter().map(|count| count as usize).collect());
            world.observation_radius = classes.pois.iter().map(|group| group.radius).fold(0.0, f64::max);
            (world.windows, world.after) = (classes.windows(world.steps), classes.after());
        }
        if !self.agents.is_empty() || !self.pois.is_empty() {
            let observe = |learn: bool| {
                let mut shown = (0..classes.agents.len()).filter(|&class| classes.agents[class].learns() == learn);
                shown.any(|class| (0..classes.pois.len()).any(|group| classes.observes(class, group)))
            };
            world.observers = match [observe(true), observe(false)] {
                [true, false] if !world.followers.is_empty() => Observers::Leaders,
                [false, true] => Observers::Followers,
                _ => Observers::All,
            };
        }
        world
    }

    /// Returns the largest distance in units up to which any agent influences another: in short, the attraction radius.
    pub fn influence_radius(&self) -> f64 {
        let classes = self.classes();
        let all = 0..classes.agents.len();
        let radii = all.clone().flat_map(|leader| all.clone().map(move |led| [leader, led]));
        let largest = radii.filter_map(|[leader, led]| classes.influence_radius(leader, led)).fold(0.0, f64::max);
        if self.agents.is_empty() { self.follow.attraction_radius } else { largest }
    }

    /// Returns the same config in full: with `[[agents]]` and `[[pois]]`, and groups of learners written out. Keys that
    /// a stage sets stay as they are, because stages cannot set keys of tables.
    pub fn expanded(&self) -> Config {
        let Classes { agents, pois } = self.classes();
        let mut config = self.clone();
        let is_set = |keys: &[&str]| {
            let mut set = self.stages.iter().flat_map(|stage| stage.set.keys());
            set.any(|key| keys.iter().any(|name| includes(name, key)))
        };
        let has_agents = !self.agents.is_empty() || !is_set(REPLACED_BY_AGENTS);
        // In short, only `world.observers` says which classes observe.
        let is_free = has_agents || self.world.observers == Observers::All;
        let has_pois = !self.pois.is_empty() || is_free && !is_set(REPLACED_BY_POIS);
        if config.learning.sharing == Sharing::Group {
            let populations = self.population_of_each();
            let members = |population: u32| {
                let members = populations.iter().enumerate().filter(|(_, own)| **own == population);
                members.map(|(learner, _)| learner).collect()
            };
            config.learning.groups = (0..self.populations() as u32).map(members).collect();
        }
        config.agents = if has_agents { agents } else { vec![] };
        config.pois = if has_pois { pois } else { vec![] };
        config.without_replaced()
    }

    /// Returns the config with the defaults of all keys that its tables replace, as it is read from a file.
    pub(crate) fn without_replaced(mut self) -> Config {
        let defaults = Config::ask(&mut Reader::default());
        let world = WorldConfig { map: self.world.map, steps: self.world.steps, dt: self.world.dt, ..defaults.world };
        if !self.agents.is_empty() {
            let WorldConfig { pois, coupling, observation_radius, windows, after, .. } = self.world;
            self.world = WorldConfig { pois, coupling, observation_radius, windows, after, ..world.clone() };
            (self.motion, self.follow, self.sense) = (defaults.motion, defaults.follow, defaults.sense);
            self.learning.paradigm = defaults.learning.paradigm;
        }
        if !self.pois.is_empty() {
            let WorldConfig { leaders, followers, heading, speed, .. } = self.world;
            self.world = WorldConfig { leaders, followers, heading, speed, ..world };
        }
        self
    }

    /// Reports whether a key is not replaced by the tables of this config.
    pub(super) fn is_written(&self, key: &str) -> bool {
        let has = |keys: &[&str]| keys.iter().any(|name| includes(name, key));
        (self.agents.is_empty() || !has(REPLACED_BY_AGENTS)) && (self.pois.is_empty() || !has(REPLACED_BY_POIS))
    }

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
