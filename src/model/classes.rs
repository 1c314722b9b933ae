//! Classes of agents and groups of POIs as configs describe them, `[[agents]]` and `[[pois]]`.

use std::f64::consts::TAU;
use std::fmt;
use std::ops::Range;

use serde::{Serialize, Serializer};

use super::motion::Mobility;
use super::region::Region;
use super::rule::Coupling;
use crate::config_enum::config_enum;
use crate::kernels::math;
use crate::reader::{OneOrEach, table};

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
        #[serde(skip_serializing_if = "Vec::is_empty")]
        at: Vec<[f64; 2]> = "units",
        /// without `at`: how many agents start in the region `in`
        #[serde(skip_serializing_if = "Option::is_none")]
        count: Option<usize> = "agents",
        /// without `at`: the region in which its agents start, drawn anew for every episode, the same for all teams of a
        /// generation
        #[serde(skip_serializing_if = "Option::is_none")]
        region as "in": Option<Region> = "",
        /// headings at the start, from the x axis towards the y axis: one number for all its agents, one per agent, or
        /// drawn anew for every episode, the same for all teams of a generation
        #[serde(serialize_with = "or_drawn")]
        heading: Option<OneOrEach<f64>> = "rad",
        /// speed at the start
        speed: f64 = "units/s",
        /// what decides how its agents move: a policy, which learns; its `rule`; the nearest agent of a class, to which
        /// they move (if motion is free, straight, and they stay if there is none); a policy, which learns, with one
        /// output per agent of a class and one for nobody, so that they move in the same way to the one with the
        /// largest (ties go to the first); or nothing, so that they stay where they are; classes that learn come first
        control: Control = "",
        /// with control = "nearest:CLASS": the distance up to which they move to an agent
        #[serde(skip_serializing_if = "Option::is_none")]
        reach: Option<f64> = "units",
        /// how its agents can move, see below
        motion: Mobility = "",
        /// a rectangle that its agents cannot leave, with the corners (x0, y0) and (x1, y1), whose sides are its walls;
        /// by default the map
        #[serde(skip_serializing_if = "Option::is_none")]
        stays_in: Option<[f64; 4]> = "units",
        /// a class that it senses: at a step before which an agent senses none of its agents, the agent keeps its place,
        /// heading and speed
        #[serde(skip_serializing_if = "Option::is_none")]
        moves_near: Option<String> = "",
        /// of classes that learn, which need one or more: what their policies sense, channel by channel, see below
        #[serde(skip_serializing_if = "Vec::is_empty")]
        senses: Vec<Channel> = "",
        /// with control = "follow", which needs one or more: the terms of the force on its agents, see below
        #[serde(skip_serializing_if = "Vec::is_empty")]
        rule: Vec<Term> = "",
        /// distance within which walls push agents that obey a rule
        wall_radius: f64 = "units",
        /// push of a wall for each unit nearer than the wall radius
        wall_gain: f64 = "1/s",
        /// classes whose agents it influences, for Df and Dt; only classes that learn can lead
        #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "one_or_list")]
        leads: Vec<String> = "",
        /// distance up to which it influences them; has to be given if a class that it leads has no rule
        #[serde(skip_serializing_if = "Option::is_none")]
        influence_radius: Option<f64> = "units",
        /// whether it counts at POIs that do not name their observers
        observes: bool = "",
        /// what its policies are selected by, by default learning.fitness
        #[serde(skip_serializing_if = "Option::is_none")]
        fitness: Option<Fitness> = "",
    }
}

/// The word for [headings](AgentClass::heading) that are drawn.
pub(crate) const DRAWN: &str = "random";

fn or_drawn<S: Serializer>(heading: &Option<OneOrEach<f64>>, serializer: S) -> Result<S::Ok, S::Error> {
    match heading {
        Some(heading) => heading.serialize(serializer),
        None => DRAWN.serialize(serializer),
    }
}

/// Returns the angle that a uniform random word selects, in radians.
pub(crate) fn turn(word: u32) -> f64 {
    TAU * f64::from(word) / (1u64 << 32) as f64
}

/// The source of an agent's decisions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Control {
    /// A policy, which learns.
    Policy,
    /// The class's rule.
    Follow,
    /// It moves straight to the nearest agent of this class, if one is within its reach.
    Nearest(String),
    /// A policy, which learns, chooses the agent of this class that it moves straight to, or nobody.
    Choose(String),
    /// It stays where it is.
    Still,
}

config_enum! {
    /// A [`Control`] without its class.
    ControlKind {
        /// See [`Control::Policy`].
        Policy = "policy",
        /// See [`Control::Follow`].
        Follow = "follow",
        /// See [`Control::Nearest`].
        Nearest = "nearest",
        /// See [`Control::Choose`].
        Choose = "choose",
        /// See [`Control::Still`].
        Still = "still",
    }
}

impl Control {
    /// Returns the control that a word of a config names, if any.
    pub(crate) fn of(word: &str) -> Option<Control> {
        match word.split_once(':') {
            Some(("nearest", class)) => Some(Control::Nearest(class.into())),
            Some(("choose", class)) => Some(Control::Choose(class.into())),
            Some(_) => None,
            None => [Control::Policy, Control::Follow, Control::Still].into_iter().find(|of| of.to_string() == word),
        }
    }

    /// Returns its kind.
    pub fn kind(&self) -> ControlKind {
        match self {
            Control::Policy => ControlKind::Policy,
            Control::Follow => ControlKind::Follow,
            Control::Nearest(_) => ControlKind::Nearest,
            Control::Choose(_) => ControlKind::Choose,
            Control::Still => ControlKind::Still,
        }
    }

    /// Returns the class to whose agents it moves, if any.
    pub fn target(&self) -> Option<&str> {
        if let Control::Nearest(class) | Control::Choose(class) = self { Some(class) } else { None }
    }

    /// Reports whether it learns.
    pub fn learns(&self) -> bool {
        self.kind().learns()
    }
}

impl ControlKind {
    /// Reports whether it learns.
    pub fn learns(self) -> bool {
        matches!(self, ControlKind::Policy | ControlKind::Choose)
    }
}

impl fmt::Display for Control {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.target() {
            Some(class) => write!(f, "{}:{class}", self.kind()),
            None => self.kind().fmt(f),
        }
    }
}

impl Serialize for Control {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

config_enum! {
    /// The score that policies are selected by (see [`crate::credit`]).
    Fitness {
        /// The team's score.
        G = "G",
        /// Difference evaluation without the leader.
        D = "D",
        /// Difference evaluation without the leader and its followers.
        Df = "Df",
        /// Difference evaluation with copies of the leader as stepping stones.
        Dpp = "D++",
        /// Difference evaluation without the leader and, at each step, the followers that it leads then.
        Dt = "Dt",
    }
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
        /// number of sectors of equal angle, counterclockwise; each is an input; with "each", every agent or POI that it
        /// may sense has a sector of its own, in their order, the agent itself included, whose sector is empty
        sectors: Sectors = "",
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

/// The sectors of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sectors {
    /// Sectors of equal angle: their number.
    Equal(usize),
    /// A sector of its own for each agent or POI that the channel names: their number.
    Each(usize),
}

impl Sectors {
    /// The word for [`Sectors::Each`].
    pub(crate) const EACH: &str = "each";

    /// Returns their number.
    pub fn count(self) -> usize {
        let (Sectors::Equal(count) | Sectors::Each(count)) = self;
        count
    }
}

impl Serialize for Sectors {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Sectors::Equal(count) => count.serialize(serializer),
            Sectors::Each(_) => Sectors::EACH.serialize(serializer),
        }
    }
}

config_enum! {
    /// The number that an entity at distance d adds to its sector.
    Measure {
        /// `1 - d/D` with D = √2·max(map).
        Linear = "linear",
        /// `1 / max(d, nearest)`.
        Inverse = "inverse",
        /// `1 / max(d, nearest)²`.
        InverseSquared = "inverse-squared",
        /// `exp(-d)`.
        Exponential = "exponential",
        /// `d / range`.
        Distance = "distance",
        /// `1 - d / range`.
        Closeness = "closeness",
    }
}

config_enum! {
    /// The function that makes one input of the measures of a sector.
    Combine {
        /// Their sum divided by the number of such entities in the world.
        Share = "share",
        /// Their sum.
        Sum = "sum",
        /// Their mean.
        Mean = "mean",
        /// The largest of them.
        Closest = "closest",
    }
}

config_enum! {
    /// The direction from which the sectors of a channel are counted.
    Frame {
        /// The agent's heading: the first sector begins straight behind.
        Heading = "heading",
        /// The map: the first sector begins at the x axis.
        Map = "map",
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
        /// pull towards their mean heading; agents with free motion keep the heading of their start
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
        #[serde(skip_serializing_if = "Vec::is_empty")]
        at: Vec<[f64; 2]> = "units",
        /// without `at`: how many POIs are in the region `in`
        #[serde(skip_serializing_if = "Option::is_none")]
        count: Option<usize> = "POIs",
        /// without `at`: the region of its POIs, drawn anew for every episode, the same for all teams of a generation
        #[serde(skip_serializing_if = "Option::is_none")]
        region as "in": Option<Region> = "",
        /// weight of each POI in G
        value: f64 = "",
        /// agents that each POI needs at the same step; one number for all its POIs, or one per POI
        coupling: Coupling = "agents",
        /// distance up to which an agent observes one of its POIs
        radius: f64 = "units",
        /// classes whose agents count here, by default those that observe
        #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "one_or_list")]
        observers: Vec<String> = "",
        /// the first and the last step, from 1, at which each POI can be observed; one pair for all, or one per POI;
        /// a window of all steps has the start, too, if world.start_counts is true
        #[serde(skip_serializing_if = "Vec::is_empty")]
        windows: Vec<[usize; 2]> = "steps",
        /// once an observer has come this near, nobody senses the POI any more, though it can still be observed; with 0 it
        /// is always sensed
        gone_within: f64 = "units",
        /// what it counts for at a step with enough observers within its radius: 1 if observed; if closeness, the product
        /// of 1/max(d, 1) over the distances d of as many of the nearest as it needs
        score: Score = "",
        /// which step counts: the best if ever, the last if end, or all if mean; steps outside its window count 0
        when: When = "",
        /// groups whose POIs must all have been observed at earlier steps
        #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "one_or_list")]
        after: Vec<String> = "",
    }
}

config_enum! {
    /// The number that a POI counts for at a step with enough observers within its radius.
    Score {
        /// 1.
        Observed = "observed",
        /// The product of 1/max(d, 1) over the distances d of the nearest observers, as many as the POI needs.
        Closeness = "closeness",
    }
}

config_enum! {
    /// The step whose score a POI counts with.
    When {
        /// The best.
        Ever = "ever",
        /// The last.
        End = "end",
        /// All: the mean over steps.
        Mean = "mean",
    }
}

/// Writes a list of one name as that name.
fn one_or_list<S: Serializer>(names: &[String], serializer: S) -> Result<S::Ok, S::Error> {
    if let [name] = names { name.serialize(serializer) } else { names.serialize(serializer) }
}

impl Classes {
    /// Returns the start position of each agent in units, `[agents]`: an example for those that start in regions.
    pub fn starts(&self) -> Vec<[f64; 2]> {
        examples(self.agents.iter().map(|class| (&class.at[..], class.size(), class.region)))
    }

    /// Returns the agents that start in each region.
    pub fn start_regions(&self) -> Vec<(Range<usize>, Region)> {
        regions(self.agents.iter().map(AgentClass::size), self.agents.iter().map(|class| class.region))
    }

    /// Returns each agent's heading at the start in radians, `[agents]`: examples of those that are drawn.
    pub fn headings(&self) -> Vec<f64> {
        let of = |class: &AgentClass| match &class.heading {
            Some(heading) => heading.of_each(class.size()),
            None => (0..class.size()).map(|index| turn(math::pcg4d_scalar([index as u32, 0, 1, 0])[0])).collect(),
        };
        self.agents.iter().flat_map(of).collect()
    }

    /// Returns the agents whose headings are drawn.
    pub fn drawn_headings(&self) -> Vec<Range<usize>> {
        let drawn = (0..self.agents.len()).filter(|&class| self.agents[class].heading.is_none());
        drawn.map(|class| self.agents_of(class)).collect()
    }

    /// Returns the agents of a class.
    pub fn agents_of(&self, class: usize) -> Range<usize> {
        successive(self.agents.iter().map(AgentClass::size)).swap_remove(class)
    }

    /// Returns the index of each agent's class, `[agents]`.
    pub fn class_of_each(&self) -> Vec<usize> {
        let of_class = |(index, class): (usize, &AgentClass)| vec![index; class.size()];
        self.agents.iter().enumerate().flat_map(of_class).collect()
    }

    /// Returns the position of each POI in units, `[pois]`: an example for those in regions.
    pub fn places(&self) -> Vec<[f64; 2]> {
        examples(self.pois.iter().map(|group| (&group.at[..], group.size(), group.region)))
    }

    /// Returns the POIs that are in each region.
    pub fn poi_regions(&self) -> Vec<(Range<usize>, Region)> {
        regions(self.pois.iter().map(PoiGroup::size), self.pois.iter().map(|group| group.region))
    }

    /// Returns the index of each POI's group, `[pois]`.
    pub fn group_of_each(&self) -> Vec<usize> {
        let of_group = |(index, group): (usize, &PoiGroup)| vec![index; group.size()];
        self.pois.iter().enumerate().flat_map(of_group).collect()
    }

    /// Returns the number of agents that each POI needs, `[pois]`.
    pub fn couplings(&self) -> Vec<u32> {
        self.pois.iter().flat_map(|group| group.coupling.of_each(group.size())).map(|count| count as u32).collect()
    }

    /// Returns the first and the last step of each POI, `[pois]`, in episodes of so many steps. Empty without windows.
    pub fn windows(&self, steps: usize) -> Vec<[usize; 2]> {
        if self.pois.iter().all(|group| group.windows.is_empty()) {
            return vec![];
        }
        let of_group = |group: &PoiGroup| match *group.windows {
            [] => vec![[1, steps]; group.size()],
            [of_all] => vec![of_all; group.size()],
            _ => group.windows.clone(),
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
        self.pois.iter().flat_map(|group| vec![before(group); group.size()]).collect()
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

/// Returns positions, or examples of those in regions.
fn examples<'a>(tables: impl Iterator<Item = (&'a [[f64; 2]], usize, Option<Region>)>) -> Vec<[f64; 2]> {
    let mut places = Vec::new();
    for (at, count, region) in tables {
        match region {
            Some(region) => places.extend((places.len()..).take(count).map(|index| region.example(index))),
            None => places.extend(at),
        }
    }
    places
}

/// Returns the regions of those that are in one, with their indices.
fn regions(
    sizes: impl Iterator<Item = usize>,
    regions: impl Iterator<Item = Option<Region>>,
) -> Vec<(Range<usize>, Region)> {
    successive(sizes).into_iter().zip(regions).filter_map(|(range, region)| Some((range, region?))).collect()
}

/// Returns where each of some counts begins and ends, one after the other.
pub(crate) fn successive(counts: impl Iterator<Item = usize>) -> Vec<Range<usize>> {
    let mut end = 0;
    let range = |count| {
        end += count;
        end - count..end
    };
    counts.map(range).collect()
}

impl PoiGroup {
    /// Returns the number of its POIs.
    pub fn size(&self) -> usize {
        self.count.unwrap_or(self.at.len())
    }
}

impl AgentClass {
    /// Returns the number of its agents.
    pub fn size(&self) -> usize {
        self.count.unwrap_or(self.at.len())
    }

    /// Reports whether its starts or headings are drawn anew for every episode.
    pub(crate) fn is_drawn(&self) -> bool {
        self.region.is_some() || self.heading.is_none()
    }

    /// Reports whether only small teams can have it.
    pub(crate) fn is_of_small_teams(&self) -> bool {
        let senses_each = self.senses.iter().any(|channel| matches!(channel.sectors, Sectors::Each(_)));
        senses_each || self.moves_near.is_some() || matches!(self.control, Control::Nearest(_) | Control::Choose(_))
    }

    /// Reports whether its agents learn.
    pub fn learns(&self) -> bool {
        self.control.learns()
    }

    /// Returns the number of inputs that its policies use.
    pub fn inputs(&self) -> usize {
        self.senses.iter().map(|channel| channel.sectors.count()).sum()
    }

    /// Reports whether behaviours can use its inputs, which begin with POIs and agents in the quadrants around its heading.
    pub(crate) fn senses_quadrants(&self) -> bool {
        let is_quadrants = |(channel, of): (&Channel, &str)| {
            channel.of == [of] && channel.sectors == Sectors::Equal(4) && channel.frame == Frame::Heading
        };
        self.senses.len() >= 2 && self.senses.iter().zip([POIS, AGENTS]).all(is_quadrants)
    }
}

impl Channel {
    /// Reports whether an agent of a class can never sense anything with this channel.
    pub(crate) fn is_blind(&self, class: &AgentClass, classes: &Classes) -> bool {
        let sensed = |other: &&AgentClass| self.of.contains(&other.name) || self.of == [AGENTS];
        let others = || classes.agents.iter().filter(sensed).map(|other| other.size() - usize::from(other == class));
        self.range == 0.0 || self.of != [POIS] && others().sum::<usize>() == 0
    }
}
