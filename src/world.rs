//! One experiment's constants and start state, in the form that kernels and shaders read.

use glam::{DVec2, Vec2};

use crate::config::{Config, Coupling, Density, MAX_HIDDEN_LAYERS, Paradigm};
use crate::declare::shared;

/// Inputs of a policy: POI and agent density in four quadrants each.
pub const INPUTS: usize = 8;
/// Outputs of a policy: wanted change of heading and wanted speed.
pub const OUTPUTS: usize = 2;
/// Positions lie on a grid of 2^-18 (or on a wall): their differences are exact, and their squares far from denormal.
pub const GRID: f32 = 262_144.0;
/// A squared range no distance on a map reaches.
const UNLIMITED: f32 = 1e30;

shared! {
    /// What every kernel reads.
    ///
    /// Derived numbers are computed here once, in f64, and rounded once.
    pub struct Constants {
        pub leaders: u32,
        pub followers: u32,
        pub pois: u32,
        pub steps: u32,
        /// u32 words in the set of agents near one POI.
        pub words: u32,
        /// Weight layers of a policy, and its widths `8, hidden…, 2` (unused entries 0).
        pub layers: u32,
        pub widths: [u32; MAX_HIDDEN_LAYERS + 2],
        /// Weights of one policy.
        pub parameters: u32,
        pub map_x: f32,
        pub map_y: f32,
        /// Speed times `dt` is the length of a step.
        pub dt: f32,
        pub heading_x: f32,
        pub heading_y: f32,
        pub speed: f32,
        pub min_speed: f32,
        pub max_speed: f32,
        /// Largest change of speed in a step.
        pub max_speed_change: f32,
        /// Largest turn in a step, at most π, with its cosine and sine (cosine -2 where any turn is allowed).
        pub max_turn: f32,
        pub max_turn_cos: f32,
        pub max_turn_sin: f32,
        /// Squared radii.
        pub observation_radius2: f32,
        pub attraction_radius2: f32,
        pub repulsion_radius2: f32,
        pub poi_range2: f32,
        pub agent_range2: f32,
        /// Walls push within this distance.
        pub repulsion_radius: f32,
        /// Gain over radius of each force.
        pub attraction_scale: f32,
        pub repulsion_scale: f32,
        pub wall_gain: f32,
        /// 1/P and 1/N.
        pub poi_share: f32,
        pub agent_share: f32,
        /// 0 linear, 1 inverse.
        pub density: u32,
        /// 1/D with D = √2·max(map).
        pub inverse_diagonal: f32,
    }
}

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
        let Config { world, motion, follow, sense, policy, learning, .. } = config;
        let (leaders, followers) = match learning.paradigm {
            Paradigm::LeaderFollower => (world.leaders.len(), world.followers.len()),
            Paradigm::AllLeaders => (world.leaders.len() + world.followers.len(), 0),
        };
        let agents = leaders + followers;
        let pois = world.pois.len();
        let mut widths = [0; MAX_HIDDEN_LAYERS + 2];
        let layers = policy.hidden.len() + 1;
        widths[0] = INPUTS as u32;
        for (width, &units) in widths[1..].iter_mut().zip(&policy.hidden) {
            *width = units as u32;
        }
        widths[layers] = OUTPUTS as u32;
        let parameters = widths.windows(2).map(|w| (w[0] + 1) * w[1]).sum();
        let (heading_x, heading_y) = unit(world.heading);
        let turn = (motion.max_turn_rate * world.dt).min(std::f64::consts::PI);
        let any_turn = turn >= std::f64::consts::PI;
        let squared = |radius: f64| (radius * radius) as f32;
        let range = |range: f64| if range.is_infinite() { UNLIMITED } else { squared(range) };
        let constants = Constants {
            leaders: leaders as u32,
            followers: followers as u32,
            pois: pois as u32,
            steps: world.steps as u32,
            words: agents.div_ceil(32) as u32,
            layers: layers as u32,
            widths,
            parameters,
            map_x: world.map[0] as f32,
            map_y: world.map[1] as f32,
            dt: world.dt as f32,
            heading_x,
            heading_y,
            speed: world.speed as f32,
            min_speed: motion.min_speed as f32,
            max_speed: motion.max_speed as f32,
            max_speed_change: (motion.max_acceleration * world.dt) as f32,
            max_turn: turn as f32,
            max_turn_cos: if any_turn { -2.0 } else { libm::cos(turn) as f32 },
            max_turn_sin: if any_turn { 0.0 } else { libm::sin(turn) as f32 },
            observation_radius2: squared(world.observation_radius),
            attraction_radius2: squared(follow.attraction_radius),
            repulsion_radius2: squared(follow.repulsion_radius),
            poi_range2: range(sense.poi_range),
            agent_range2: range(sense.agent_range),
            repulsion_radius: follow.repulsion_radius as f32,
            attraction_scale: (follow.attraction_gain / follow.attraction_radius) as f32,
            repulsion_scale: (follow.repulsion_gain / follow.repulsion_radius) as f32,
            wall_gain: follow.wall_gain as f32,
            poi_share: (1.0 / pois as f64) as f32,
            agent_share: (1.0 / agents as f64) as f32,
            density: match sense.density {
                Density::Linear => 0,
                Density::Inverse => 1,
            },
            inverse_diagonal: (1.0 / (2f64.sqrt() * world.map[0].max(world.map[1]))) as f32,
        };
        let map = Vec2::new(constants.map_x, constants.map_y);
        let points =
            |list: &[[f64; 2]]| list.iter().map(|&at| on_grid(DVec2::from(at).as_vec2(), map)).collect::<Vec<_>>();
        World {
            constants,
            starts: [points(&world.leaders), points(&world.followers)].concat(),
            pois: points(&world.pois),
            coupling: match &world.coupling {
                Coupling::Same(count) => vec![*count as u32; pois],
                Coupling::Each(counts) => counts.iter().map(|&count| count as u32).collect(),
            },
        }
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
        self.constants.parameters as usize
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
