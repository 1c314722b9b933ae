//! One experiment's constants and start state, in the form that kernels and shaders read.

use glam::{DVec2, Vec2};

use crate::config::Config;
use crate::model::couple::CoupleConstants;
use crate::model::follow::FollowConstants;
use crate::model::motion::MotionConstants;
use crate::model::policy::PolicyConstants;
use crate::model::sense::SenseConstants;

pub use crate::model::motion::GRID;
pub use crate::model::policy::OUTPUTS;
pub use crate::model::sense::INPUTS;
pub use crate::model::{Constants, Variant};

/// One world: constants, start positions of all agents (leaders first), POIs and how many agents each needs.
#[derive(Clone, Debug, PartialEq)]
pub struct World {
    pub constants: Constants,
    pub starts: Vec<Vec2>,
    pub pois: Vec<Vec2>,
    pub coupling: Vec<u32>,
}

impl World {
    /// Builds the world of a valid config; in the all-leaders paradigm the followers' places hold leaders.
    pub fn new(config: &Config) -> World {
        let Config { world, motion, follow, sense, policy, .. } = config;
        let (agents, leaders) = (world.leaders.len() + world.followers.len(), config.learners());
        let pois = world.pois.len();
        let (heading_x, heading_y) = unit(world.heading);
        let motion = MotionConstants::new(motion, world.dt, world.map);
        let constants = Constants {
            leaders: leaders as u32,
            followers: (agents - leaders) as u32,
            pois: pois as u32,
            steps: world.steps as u32,
            words: agents.div_ceil(32) as u32,
            heading_x,
            heading_y,
            speed: world.speed as f32,
            variant: Variant { density: sense.density as u32, by_sine: motion.by_sine().into() },
            policy: PolicyConstants::new(policy),
            motion,
            couple: CoupleConstants::new(world.observation_radius),
            follow: FollowConstants::new(follow),
            sense: SenseConstants::new(sense, agents, pois, world.map),
        };
        let map = Vec2::new(motion.map_x, motion.map_y);
        let points =
            |list: &[[f64; 2]]| list.iter().map(|&at| on_grid(DVec2::from(at).as_vec2(), map)).collect::<Vec<_>>();
        World {
            constants,
            starts: [points(&world.leaders), points(&world.followers)].concat(),
            pois: points(&world.pois),
            coupling: world.coupling.of_each(pois),
        }
    }

    /// Its width and height.
    pub fn map(&self) -> Vec2 {
        Vec2::new(self.constants.motion.map_x, self.constants.motion.map_y)
    }

    pub fn leaders(&self) -> usize {
        self.constants.leaders as usize
    }

    pub fn followers(&self) -> usize {
        self.constants.followers as usize
    }

    pub fn agents(&self) -> usize {
        self.leaders() + self.followers()
    }

    pub fn steps(&self) -> usize {
        self.constants.steps as usize
    }

    /// Weights of one policy.
    pub fn parameters(&self) -> usize {
        self.constants.policy.parameters as usize
    }

    /// Words in one team's record of sets: steps × POIs × words a set.
    pub fn set_words(&self) -> usize {
        self.steps() * self.pois.len() * self.constants.words as usize
    }
}

/// The nearest place of the kernels' grid that is on the map.
pub fn on_grid(place: Vec2, map: Vec2) -> Vec2 {
    ((place * GRID + 0.5).floor() / GRID).clamp(Vec2::ZERO, map)
}

/// The unit vector of an angle; a component under 1e-6 in size is 0, so that layouts full of exact ties keep them.
///
/// Sines and cosines here are [`libm`]'s: those of the platform may differ in the last bit from one system to another.
fn unit(angle: f64) -> (f32, f32) {
    let tidy = |component: f64| if component.abs() < 1e-6 { 0.0 } else { component as f32 };
    (tidy(libm::cos(angle)), tidy(libm::sin(angle)))
}
