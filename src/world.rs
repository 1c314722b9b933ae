//! One experiment's constants and start state, as kernels and shaders read them.

use std::ops::{Deref, Range};

use glam::{DVec2, Vec2};

use crate::config::{Config, LedBy, PoiGroup, Region, Score, StageConfig, When};
use crate::model::class::Class;
use crate::model::motion::MapConstants;
use crate::model::policy::PolicyConstants;
use crate::model::rule::Rule;
use crate::model::sense::squared_range;

pub use crate::model::Constants;
pub use crate::model::motion::{GRID, on_grid};
pub use crate::model::policy::OUTPUTS;

/// One world: constants, classes of agents, POIs, and the rule of observation.
///
/// Agents that learn come first. Here and in the record of an episode they are called leaders, and all others followers.
///
/// Only a valid config makes a world, and its [parts](WorldParts) can be read but not changed, so that they agree with each
/// other. Shaders run without bounds checks and rely on this.
#[derive(Clone, Debug, PartialEq)]
pub struct World(WorldParts);

/// The parts of a [`World`].
#[derive(Clone, Debug, PartialEq)]
pub struct WorldParts {
    /// The constants of kernels.
    pub constants: Constants,
    /// The classes of agents, those that learn first.
    pub classes: Vec<Class>,
    /// Start positions in units, on the kernels' grid, `[agents]`.
    pub starts: Vec<Vec2>,
    /// Initial headings, unit vectors, `[agents]`.
    pub headings: Vec<Vec2>,
    /// The agents whose headings are drawn anew for every episode.
    pub drawn_headings: Vec<Range<usize>>,
    /// The agents that start in each region. Their starts here are examples.
    pub start_regions: Vec<(Range<usize>, Region)>,
    /// POI positions in units, on the kernels' grid, `[pois]`.
    pub pois: Vec<Vec2>,
    /// The POIs in each region. Their positions here are examples.
    pub poi_regions: Vec<(Range<usize>, Region)>,
    /// The squared observation radius of each POI, `[pois]`.
    pub radii2: Vec<f32>,
    /// The POIs that are gone once an observer has come near.
    pub gone_within: Vec<GoneWithin>,
    /// The value of each POI, `[pois]`.
    pub values: Vec<f32>,
    /// The value of each POI as a multiple of a common unit, and their sum. Scores are counted in these units.
    pub worth: Vec<u32>,
    /// The sum of [`WorldParts::worth`].
    pub total_worth: u32,
    /// C: observers that each POI needs at the same step, `[pois]`.
    pub coupling: Vec<u32>,
    /// Who observes, when, and in what order.
    pub rule: Rule,
    /// The rule by which leaders lead followers, for Dt.
    pub led: Led,
    /// The rule of scores that are computed from paths; `None` if they are computed from sets.
    pub paths: Option<PathRule>,
    /// The population that each leader chooses its policy from, `[leaders]`.
    pub populations: Vec<u32>,
}

/// A POI that is gone once an observer has come near: nobody senses it any more, though it can still be observed.
#[derive(Clone, Debug, PartialEq)]
pub struct GoneWithin {
    /// The index of the POI.
    pub poi: usize,
    /// The squared distance within which an observer makes it gone.
    pub distance2: f32,
    /// The classes whose agents observe it.
    pub classes: Vec<usize>,
}

/// The rule by which scores are computed from [paths](crate::credit::Paths).
#[derive(Clone, Debug, PartialEq)]
pub struct PathRule {
    /// The score of each POI and the step whose score counts, `[pois]`.
    pub scores: Vec<(Score, When)>,
    /// Whether the start counts as a step.
    pub start_counts: bool,
    /// The agents that D takes out for each learner, one bit per agent, `[leaders][words]`. Empty if that is the learner.
    pub removes: Vec<u32>,
}

/// The rule by which leaders lead a follower at a step, for [`Dt`](crate::config::Fitness::Dt).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Led {
    /// The number of recent steps that count, including the present one. 0 counts all since the start.
    pub within: usize,
    /// The leaders that lead, of those seen at these steps.
    pub by: LedBy,
}

impl PathRule {
    fn new(config: &Config, groups: &[&PoiGroup], leaders: usize, agents: usize) -> PathRule {
        let (words, removes) = (agents.div_ceil(32), &config.credit.removes);
        let mut bits = vec![0; if removes.is_empty() { 0 } else { leaders * words }];
        for (leader, bits) in bits.chunks_exact_mut(words).enumerate() {
            let removed = removes.get(leader).unwrap_or(&removes[0]);
            removed.iter().for_each(|agent| bits[agent / 32] |= 1 << (agent % 32));
        }
        PathRule {
            scores: groups.iter().map(|group| (group.score, group.when)).collect(),
            start_counts: config.world.start_counts,
            removes: bits,
        }
    }
}

impl Deref for World {
    type Target = WorldParts;

    fn deref(&self) -> &WorldParts {
        &self.0
    }
}

impl World {
    /// Builds the world of a valid config.
    pub fn new(config: &impl AsRef<StageConfig>) -> World {
        World::build(config.as_ref(), !config.as_ref().needs_paths().is_empty())
    }

    /// Builds the world of a valid config, whose scores are computed from paths even if they do not need that. POIs have no
    /// order.
    pub fn scored_by_paths(config: &impl AsRef<StageConfig>) -> World {
        World::build(config.as_ref(), true)
    }

    fn build(config: &StageConfig, by_paths: bool) -> World {
        let Config { world, policy, credit, .. } = &**config;
        let described = config.classes();
        let map = Vec2::new(world.map[0] as f32, world.map[1] as f32);
        let on_grid = |at: [f64; 2]| on_grid(DVec2::from(at).as_vec2(), map);
        let of_each: Vec<&PoiGroup> =
            described.group_of_each().into_iter().map(|group| &described.pois[group]).collect();
        let (mut worth, mut total_worth) = worth(of_each.iter().map(|group| group.value));
        if !config.needs_paths().is_empty() {
            // Scores are shares of these units.
            let finer = MOST_UNITS / total_worth;
            worth.iter_mut().for_each(|worth| *worth *= finer);
            total_worth *= finer;
        }
        let values: Vec<f32> = of_each.iter().map(|group| group.value as f32).collect();
        let classes = Class::all(&described, &values, world.map, world.dt);
        let learns = |class: &&Class| class.constants.shape.control().learns();
        let leaders = classes.iter().filter(learns).map(|class| class.agents().len()).sum::<usize>();
        let starts: Vec<Vec2> = described.starts().into_iter().map(on_grid).collect();
        let agents = starts.len();
        let aligns = classes.iter().flat_map(Class::terms).any(|term| term.shape.aligns != 0);
        let constants = Constants {
            leaders: leaders as u32,
            followers: (agents - leaders) as u32,
            pois: values.len() as u32,
            steps: world.steps as u32,
            words: agents.div_ceil(32) as u32,
            class_count: classes.len() as u32,
            first_class: 0,
            aligns: aligns.into(),
            gone: of_each.iter().any(|group| group.gone_within > 0.0).into(),
            map: MapConstants::new(world.map, world.dt),
            policy: PolicyConstants::new(&config.widths(), policy.actions),
        };
        let observing = |group: usize| (0..classes.len()).filter(|&class| described.observes(class, group)).collect();
        let observers: Vec<Vec<usize>> = described.group_of_each().into_iter().map(observing).collect();
        let agents_of = |of: &Vec<usize>| of.iter().map(|&class| classes[class].agents()).collect();
        let can_go = of_each.iter().zip(&observers).enumerate().filter(|(_, (group, _))| group.gone_within > 0.0);
        let gone_within = can_go.map(|(poi, (group, classes))| GoneWithin {
            poi,
            distance2: squared_range(group.gone_within),
            classes: classes.clone(),
        });
        World(WorldParts {
            constants,
            starts,
            headings: described.headings().into_iter().map(unit).collect(),
            drawn_headings: described.drawn_headings(),
            start_regions: described.start_regions(),
            pois: described.places().into_iter().map(on_grid).collect(),
            poi_regions: described.poi_regions(),
            radii2: of_each.iter().map(|group| (group.radius * group.radius) as f32).collect(),
            gone_within: gone_within.collect(),
            values,
            worth,
            total_worth,
            coupling: described.couplings(),
            populations: config.population_of_each(),
            led: Led { within: credit.led_within, by: credit.led_by },
            paths: by_paths.then(|| PathRule::new(config, &of_each, leaders, agents)),
            rule: Rule::new(
                &observers.iter().map(agents_of).collect::<Vec<_>>(),
                agents,
                &described.windows(world.steps),
                &described.after(),
            ),
            classes,
        })
    }

    /// Returns this world with its POIs at other positions, `[pois]`.
    ///
    /// # Panics
    /// The number of POIs changes.
    pub fn with_pois(mut self, pois: &[Vec2]) -> World {
        self.0.pois.copy_from_slice(pois);
        self
    }

    /// Returns the width and height of the map.
    pub fn map(&self) -> Vec2 {
        Vec2::new(self.constants.map.map_x, self.constants.map.map_y)
    }

    /// Returns the inputs of a policy: the most that any class has.
    pub fn inputs(&self) -> usize {
        self.constants.policy.inputs()
    }

    /// Reports whether any rule aligns headings.
    pub(crate) fn aligns(&self) -> bool {
        self.constants.aligns != 0
    }

    /// Returns the number of agents among which each leader's policy chooses, `[leaders]`: 0 unless it chooses agents.
    pub(crate) fn choices(&self) -> Vec<usize> {
        let of_class = |class: &Class| vec![class.constants.shape.choices(); class.agents().len()];
        self.classes.iter().flat_map(of_class).take(self.leaders()).collect()
    }

    /// Returns the class of an agent.
    pub fn class_of(&self, agent: usize) -> &Class {
        let of = |class: &&Class| class.agents().contains(&agent);
        self.classes.iter().find(of).expect("every agent has a class")
    }

    /// Returns the number of leaders, the agents with a policy.
    pub fn leaders(&self) -> usize {
        self.constants.leaders as usize
    }

    /// Returns the number of followers.
    pub fn followers(&self) -> usize {
        self.constants.followers as usize
    }

    /// Returns the number of leaders and followers.
    pub fn agents(&self) -> usize {
        self.leaders() + self.followers()
    }

    /// Returns the steps of an episode.
    pub fn steps(&self) -> usize {
        self.constants.steps as usize
    }

    /// Returns the weights of one policy.
    pub fn parameters(&self) -> usize {
        self.constants.policy.parameters as usize
    }

    /// Returns the words of a set of leaders, one bit per leader.
    pub(crate) fn leader_words(&self) -> usize {
        self.leaders().div_ceil(32)
    }

    /// Returns the words of one team's record of sightings: steps × followers × words of leaders.
    pub fn sight_words(&self) -> usize {
        self.steps() * self.followers() * self.leader_words()
    }

    /// Returns the words of one team's path: moments × agents × 2.
    pub(crate) fn path_words(&self) -> usize {
        (self.steps() + 1) * self.agents() * 2
    }

    /// Returns the words of one team's record of sets: steps × POIs × words per set.
    pub fn set_words(&self) -> usize {
        self.steps() * self.words_per_step()
    }

    /// Returns the words of one step of such a record.
    pub(crate) fn words_per_step(&self) -> usize {
        self.pois.len() * self.constants.words as usize
    }
}

/// Maximum sum of [`WorldParts::worth`]: every share of it is an exact f32.
const MOST_UNITS: u32 = 1 << 24;

/// Returns values as whole multiples of a common unit, as small as possible, and their sum, at most 2^22. With equal values
/// each is 1.
fn worth(values: impl Iterator<Item = f64> + Clone) -> (Vec<u32>, u32) {
    let mut units = f64::from(1 << 20);
    while values.clone().sum::<f64>() * units > f64::from(1 << 22) {
        units /= 2.0;
    }
    let multiples: Vec<u32> = values.map(|value| ((value * units).round() as u32).max(1)).collect();
    let common = multiples.iter().copied().fold(0, greatest_common_divisor);
    let worth: Vec<u32> = multiples.into_iter().map(|multiple| multiple / common).collect();
    let total = worth.iter().sum();
    (worth, total)
}

fn greatest_common_divisor(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { greatest_common_divisor(b, a % b) }
}

/// Returns the unit vector of an angle. Components smaller than 1e-6 become 0, so that layouts keep exact ties.
///
/// Sine and cosine are from [`libm`], because the platform's may differ in the last bit.
pub(crate) fn unit(angle: f64) -> Vec2 {
    let tidy = |component: f64| if component.abs() < 1e-6 { 0.0 } else { component as f32 };
    Vec2::new(tidy(libm::cos(angle)), tidy(libm::sin(angle)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::MAX_HIDDEN_UNITS;
    use crate::sample;

    /// Shaders run without bounds checks and rely on this.
    #[test]
    fn the_parts_of_a_world_agree() {
        for seed in 0..200 {
            let world = World::new(&sample::any_world(seed).validate().unwrap());
            let WorldParts { constants, starts, headings, pois, coupling, rule, .. } = &*world;
            let PolicyConstants { layers, widths, parameters, .. } = constants.policy;
            let (used, unused) = widths.split_at(layers as usize + 1);
            let weights: u32 = used.windows(2).map(|widths| (widths[0] + 1) * widths[1]).sum();
            assert!(constants.leaders > 0 && constants.pois > 0 && constants.steps > 0, "{seed}: {constants:?}");
            assert_eq!([starts.len(), headings.len()], [world.agents(); 2], "{seed}");
            assert_eq!([pois.len(), coupling.len()], [constants.pois as usize; 2], "{seed}");
            assert_eq!(constants.words as usize, world.agents().div_ceil(32), "{seed}");
            assert!(rule.fits(constants.words as usize, pois.len()), "{seed}: {rule:?}");
            assert_eq!((used[0] as usize, weights), (world.inputs(), parameters), "{seed}: {widths:?}");
            assert!(unused.iter().all(|&width| width == 0), "{seed}: {widths:?}");
            assert!(used.iter().all(|&width| (1..=MAX_HIDDEN_UNITS as u32).contains(&width)), "{seed}: {widths:?}");
        }
    }
}
