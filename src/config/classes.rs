//! Classes of agents and groups of POIs: what every config describes, whether it is written in full or in short.
//!
//! `[[agents]]` and `[[pois]]` write them in full. The sections `[motion]`, `[follow]` and `[sense]`, and the keys of
//! `[world]` for leaders, followers and POIs, are short for two classes, `leader` and `follower`, and one group of POIs.

use super::{Config, Coupling, Density, Fitness, Follow, Heading, Observers, Paradigm, Sense, Sharing, WorldConfig};
use crate::model::classes::{
    AGENTS, AgentClass, Channel, Classes, Combine, Control, Frame, Measure, POIS, PoiGroup, Score, Sectors, Term, When,
};
use crate::model::motion::Mobility;
use crate::reader::{OneOrEach, Reader, includes};

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

/// Inputs of the leaders of the short form: POIs and agents in four quadrants each.
const SHORT_INPUTS: usize = 8;

/// Maximum number of agents of a team that do not learn in pictures.
const MOST_DRAWN: usize = 2000;

/// Returns the agents that pictures draw: those that learn, and of the others every n-th if there are very many.
pub fn drawn_agents(learners: usize, agents: usize) -> Vec<usize> {
    (0..learners).chain((learners..agents).step_by(drawn_every(learners, agents))).collect()
}

/// Returns n if pictures draw every n-th agent that does not learn.
pub fn drawn_every(learners: usize, agents: usize) -> usize {
    (agents - learners).div_ceil(MOST_DRAWN).max(1)
}

impl Config {
    /// Returns the number of agents in a team.
    pub fn agent_count(&self) -> usize {
        match &self.agents[..] {
            [] => self.world.leaders.len() + self.world.followers.len(),
            classes => classes.iter().map(|class| class.size()).sum(),
        }
    }

    /// Returns the number of POIs.
    pub fn poi_count(&self) -> usize {
        match &self.pois[..] {
            [] => self.world.pois.len(),
            groups => groups.iter().map(|group| group.size()).sum(),
        }
    }

    /// Returns the sum of the values of all POIs. G times it is the sum that a team observed.
    pub fn poi_value(&self) -> f64 {
        match &self.pois[..] {
            [] => self.world.pois.len() as f64,
            groups => groups.iter().map(|group| group.size() as f64 * group.value).sum(),
        }
    }

    /// Returns by what G weights the observed POIs: their values if these differ, and their scores by distance or by time.
    /// `None` means that G times the number of POIs is how many are observed.
    pub fn weighted_by(&self) -> Option<&'static str> {
        let values = self.pois.windows(2).any(|pair| pair[0].value != pair[1].value);
        let scores = self.pois.iter().any(|group| group.score != Score::Observed || group.when == When::Mean);
        match (values, scores) {
            (true, true) => Some("value and score"),
            (true, false) => Some("value"),
            (false, true) => Some("score"),
            (false, false) => None,
        }
    }

    /// Returns the number of inputs of a policy: the most that the policies of any class use.
    pub fn inputs(&self) -> usize {
        let learning = self.agents.iter().filter(|class| class.learns());
        learning.map(AgentClass::inputs).max().unwrap_or(SHORT_INPUTS)
    }

    /// Returns the widths of all layers of a policy, from inputs to outputs: the most that the policies of any class use.
    pub fn widths(&self) -> Vec<usize> {
        let learning = self.agents.iter().filter(|class| class.learns());
        let outputs = learning.map(|class| self.outputs(class)).max().unwrap_or(self.policy.actions.outputs());
        [&[self.inputs()], &self.policy.hidden[..], &[outputs]].concat()
    }

    /// Returns the number of outputs that the policies of a class use.
    pub(super) fn outputs(&self, class: &AgentClass) -> usize {
        let size = |name: &str| self.agents.iter().find(|class| class.name == name).map_or(0, AgentClass::size);
        match &class.control {
            Control::Choose(target) => size(target) + 1,
            _ => self.policy.actions.outputs(),
        }
    }

    /// Returns the world in short as pictures draw it. Agents that learn are leaders, others are followers, and all POIs
    /// have the largest radius of any. Of the followers of large teams some are drawn, see [`drawn_agents`].
    pub fn drawn(&self) -> WorldConfig {
        let mut world = self.world.clone();
        let classes = self.classes();
        if !self.agents.is_empty() {
            // Classes that learn come first.
            let (starts, headings, learners) = (classes.starts(), classes.headings(), self.learners());
            let drawn = drawn_agents(learners, starts.len());
            world.heading = Heading::Each(drawn.iter().map(|&agent| headings[agent]).collect());
            world.leaders = drawn.into_iter().map(|agent| starts[agent]).collect();
            world.followers = world.leaders.split_off(learners);
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

    /// Reports whether starts or POIs are drawn, so that the config has no start of its own.
    pub fn draws_starts(&self) -> bool {
        self.agents.iter().any(AgentClass::is_drawn) || self.pois.iter().any(|group| group.region.is_some())
    }

    /// Reports whether agents start elsewhere, or with other headings, in every episode.
    pub fn starts_move(&self) -> bool {
        self.learning.start_jitter > 0.0 || self.agents.iter().any(AgentClass::is_drawn)
    }

    /// Reports whether POIs are elsewhere in every episode.
    pub fn pois_move(&self) -> bool {
        self.learning.poi_jitter > 0.0 || self.pois.iter().any(|group| group.region.is_some())
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
    /// a stage sets stay as they are.
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
    pub(crate) fn without_replaced(self) -> Config {
        let config = Config::ask(&mut Reader::of_values(self.values()));
        Config { stages: self.stages, ..config }
    }

    /// Reports whether a key is not replaced by the tables of this config.
    pub(super) fn is_written(&self, key: &str) -> bool {
        let has = |keys: &[&str]| keys.iter().any(|name| includes(name, key));
        (self.agents.is_empty() || !has(REPLACED_BY_AGENTS)) && (self.pois.is_empty() || !has(REPLACED_BY_POIS))
    }

    /// Returns what makes scores depend on more than the agents at each POI and step, so that they are computed from paths.
    pub(crate) fn needs_paths(&self) -> Vec<&'static str> {
        let learn = |name: &String| self.agents.iter().any(|class| class.name == *name && class.learns());
        let reasons = [
            ("world.start_counts", self.world.start_counts),
            ("credit.removes", !self.credit.removes.is_empty()),
            ("score = \"closeness\"", self.pois.iter().any(|group| group.score != Score::Observed)),
            ("another `when` than \"ever\"", self.pois.iter().any(|group| group.when != When::Ever)),
            ("classes that learn and are led", self.agents.iter().flat_map(|class| &class.leads).any(learn)),
        ];
        reasons.into_iter().filter(|(_, holds)| *holds).map(|(reason, _)| reason).collect()
    }

    /// Returns the fitness of each learner, `[learners]`.
    pub fn fitness_of_each(&self) -> Vec<Fitness> {
        let of_class = |class: &AgentClass| vec![class.fitness.unwrap_or(self.learning.fitness); class.size()];
        match &self.agents[..] {
            [] => vec![self.learning.fitness; self.learners()],
            classes => classes.iter().filter(|class| class.learns()).flat_map(of_class).collect(),
        }
    }

    /// Returns the fitnesses of all learners, each once.
    pub fn fitnesses(&self) -> Vec<Fitness> {
        let mut fitnesses = vec![];
        for fitness in self.fitness_of_each() {
            if !fitnesses.contains(&fitness) {
                fitnesses.push(fitness);
            }
        }
        fitnesses
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
            heading: Some(match world.heading {
                Heading::Same(heading) => OneOrEach::Same(heading),
                Heading::Each(_) => OneOrEach::Each(headings[first..first + at.len()].to_vec()),
            }),
            at,
            count: None,
            region: None,
            speed: world.speed,
            control: control.clone(),
            reach: None,
            motion: Mobility::Steered(motion.clone()),
            stays_in: None,
            moves_near: None,
            senses: vec![],
            rule: vec![],
            wall_radius: follow.repulsion_radius,
            wall_gain: follow.wall_gain,
            leads: vec![],
            influence_radius: None,
            fitness: None,
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
            count: None,
            region: None,
            value: 1.0,
            coupling,
            radius: world.observation_radius,
            observers: vec![],
            windows: windows.to_vec(),
            gone_within: 0.0,
            score: Score::Observed,
            when: When::Ever,
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
            sectors: Sectors::Equal(4),
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
