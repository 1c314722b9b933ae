//! One experiment's constants and start state, as kernels and shaders read them.

use std::ops::Deref;

use glam::{DVec2, Vec2};

use crate::config::{Config, LedBy, StageConfig};
use crate::model::couple::CoupleConstants;
use crate::model::follow::FollowConstants;
use crate::model::motion::MotionConstants;
use crate::model::policy::PolicyConstants;
use crate::model::rule::Rule;
use crate::model::sense::SenseConstants;

pub use crate::model::motion::GRID;
pub use crate::model::policy::OUTPUTS;
pub use crate::model::sense::INPUTS;
pub use crate::model::{Constants, Variant};

/// One world: constants, start positions (leaders first), POIs, their coupling, and the rule of observation.
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
    /// Start positions in units, on the kernels' grid, `[agents]`.
    pub starts: Vec<Vec2>,
    /// Initial headings, unit vectors, `[agents]`.
    pub headings: Vec<Vec2>,
    /// POI positions in units, on the kernels' grid, `[pois]`.
    pub pois: Vec<Vec2>,
    /// C: observers that each POI needs at the same step, `[pois]`.
    pub coupling: Vec<u32>,
    /// Who observes, when, and in what order.
    pub rule: Rule,
    /// The rule by which leaders lead followers, for Dt.
    pub led: Led,
    /// The population that each leader chooses its policy from, `[leaders]`.
    pub populations: Vec<u32>,
}

/// The rule by which leaders lead a follower at a step, for [`Dt`](crate::config::Fitness::Dt).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Led {
    /// The number of recent steps that count, including the present one. 0 counts all since the start.
    pub within: usize,
    /// The leaders that lead, of those seen at these steps.
    pub by: LedBy,
}

impl Default for Led {
    fn default() -> Led {
        Led { within: 0, by: LedBy::MostSeen }
    }
}

impl Deref for World {
    type Target = WorldParts;

    fn deref(&self) -> &WorldParts {
        &self.0
    }
}

impl World {
    /// Builds the world of a valid config. In the all-leaders paradigm the followers are leaders too.
    pub fn new(config: &impl AsRef<StageConfig>) -> World {
        let Config { world, motion, follow, sense, policy, learning, .. } = &**config.as_ref();
        let (agents, leaders) = (world.leaders.len() + world.followers.len(), config.as_ref().learners());
        let pois = world.pois.len();
        let motion = MotionConstants::new(motion, world.dt, world.map);
        let constants = Constants {
            leaders: leaders as u32,
            followers: (agents - leaders) as u32,
            pois: pois as u32,
            steps: world.steps as u32,
            words: agents.div_ceil(32) as u32,
            speed: world.speed as f32,
            variant: Variant { density: sense.density as u32, by_sine: motion.by_sine().into() },
            policy: PolicyConstants::new(policy, config.as_ref().inputs()),
            motion,
            couple: CoupleConstants::new(world.observation_radius),
            follow: FollowConstants::new(follow, agents),
            sense: SenseConstants::new(sense, agents, pois, world.map),
        };
        let map = Vec2::new(motion.map_x, motion.map_y);
        let points =
            |list: &[[f64; 2]]| list.iter().map(|&at| on_grid(DVec2::from(at).as_vec2(), map)).collect::<Vec<_>>();
        World(WorldParts {
            constants,
            starts: [points(&world.leaders), points(&world.followers)].concat(),
            headings: world.headings().into_iter().map(unit).collect(),
            pois: points(&world.pois),
            coupling: world.coupling.of_each(pois),
            populations: config.as_ref().population_of_each(),
            led: Led { within: learning.led_within, by: learning.led_by },
            rule: Rule::new(world.observers.among(leaders, agents - leaders), agents, &world.windows, &world.after),
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
        Vec2::new(self.constants.motion.map_x, self.constants.motion.map_y)
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

    /// Returns the words of one team's record of sets: steps × POIs × words per set.
    pub fn set_words(&self) -> usize {
        self.steps() * self.words_per_step()
    }

    /// Returns the words of one step of such a record.
    pub(crate) fn words_per_step(&self) -> usize {
        self.pois.len() * self.constants.words as usize
    }
}

/// Rounds a position to the kernels' grid, and clamps it to the map.
pub fn on_grid(place: Vec2, map: Vec2) -> Vec2 {
    ((place * GRID + 0.5).floor() / GRID).clamp(Vec2::ZERO, map)
}

/// Returns the unit vector of an angle. Components smaller than 1e-6 become 0, so that layouts keep exact ties.
///
/// Sine and cosine are from [`libm`], because the platform's may differ in the last bit.
fn unit(angle: f64) -> Vec2 {
    let tidy = |component: f64| if component.abs() < 1e-6 { 0.0 } else { component as f32 };
    Vec2::new(tidy(libm::cos(angle)), tidy(libm::sin(angle)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::MAX_HIDDEN_UNITS;
    use crate::config_enum::Choice;
    use crate::model::sense::Density;
    use crate::sample;

    /// Shaders run without bounds checks and rely on this.
    #[test]
    fn the_parts_of_a_world_agree() {
        for seed in 0..200 {
            let world = World::new(&sample::world(seed).validate().unwrap());
            let WorldParts { constants, starts, headings, pois, coupling, rule, .. } = &*world;
            let PolicyConstants { layers, widths, parameters } = constants.policy;
            let (used, unused) = widths.split_at(layers as usize + 1);
            let weights: u32 = used.windows(2).map(|widths| (widths[0] + 1) * widths[1]).sum();
            assert!(constants.leaders > 0 && constants.pois > 0 && constants.steps > 0, "{seed}: {constants:?}");
            assert_eq!([starts.len(), headings.len()], [world.agents(); 2], "{seed}");
            assert_eq!([pois.len(), coupling.len()], [constants.pois as usize; 2], "{seed}");
            assert_eq!(constants.words as usize, world.agents().div_ceil(32), "{seed}");
            assert!(rule.fits(constants.words as usize, pois.len()), "{seed}: {rule:?}");
            assert!((constants.variant.density as usize) < Density::ALL.len(), "{seed}");
            assert_eq!((used[0] as usize, weights), (INPUTS, parameters), "{seed}: {widths:?}");
            assert!(
                constants.policy.actions().is_some() && unused.iter().all(|&width| width == 0),
                "{seed}: {widths:?}"
            );
            assert!(used.iter().all(|&width| (1..=MAX_HIDDEN_UNITS as u32).contains(&width)), "{seed}: {widths:?}");
        }
    }
}
