//! The config file: what an experiment is, with every default of the paper's calibration.

use serde::{Deserialize, Serialize};

/// Most agents (leaders and followers) in a team.
pub const MAX_AGENTS: usize = 1024;
/// Most POIs in a world.
pub const MAX_POIS: usize = 256;
/// Most steps in an episode.
pub const MAX_STEPS: usize = 10_000;
/// Most hidden layers of a policy.
pub const MAX_HIDDEN_LAYERS: usize = 3;
/// Most units in one hidden layer.
pub const MAX_HIDDEN_UNITS: usize = 64;
/// Most teams (policies a population) in one generation.
pub const MAX_POPULATION: usize = 1 << 20;

/// One experiment, as written in a config file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Config {
    pub world: World,
    pub motion: Motion,
    pub follow: Follow,
    pub sense: Sense,
    pub policy: Policy,
    pub learning: Learning,
}

/// `[world]`: where everything starts. Lengths in map units, time in seconds, angles in radians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct World {
    pub map: [f64; 2],
    pub leaders: Vec<[f64; 2]>,
    pub followers: Vec<[f64; 2]>,
    pub pois: Vec<[f64; 2]>,
    pub coupling: Coupling,
    pub observation_radius: f64,
    pub steps: usize,
    pub dt: f64,
    pub heading: f64,
    pub speed: f64,
}

/// Agents needed at a POI at the same step: one number for all POIs, or one per POI.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Coupling {
    Same(usize),
    Each(Vec<usize>),
}

/// `[motion]`: the limits of every agent's movement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Motion {
    pub min_speed: f64,
    pub max_speed: f64,
    pub max_acceleration: f64,
    pub max_turn_rate: f64,
}

/// `[follow]`: the followers' preset behaviour.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Follow {
    pub attraction_radius: f64,
    pub repulsion_radius: f64,
    pub attraction_gain: f64,
    pub repulsion_gain: f64,
    pub wall_gain: f64,
}

/// `[sense]`: what a leader senses. A range left out is unlimited.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sense {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poi_range: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub agent_range: Option<f64>,
    pub density: Density,
}

/// How a sensed distance `d` counts: `1 - d/D` with D the map's diagonal bound, or `1 / max(d, 1)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Density {
    Linear,
    Inverse,
}

/// `[policy]`: the leaders' network, `8, hidden…, 2`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Policy {
    pub hidden: Vec<usize>,
}

/// `[learning]`: the cooperative coevolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Learning {
    pub paradigm: Paradigm,
    pub fitness: Fitness,
    pub population: usize,
    pub generations: usize,
    pub trials: usize,
    pub elites: usize,
    pub mutation: Mutation,
    pub mutation_probability: f64,
    pub mutation_sigma: f64,
    pub episodes_per_team: usize,
    pub start_jitter: f64,
    pub seed: u64,
}

/// Who learns: the leaders alone, or every agent (the followers' places become leaders, appended after the leaders).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Paradigm {
    LeaderFollower,
    AllLeaders,
}

/// Which score a policy is selected by (see [`crate::credit`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Fitness {
    G,
    D,
    Df,
    #[serde(rename = "D++")]
    Dpp,
}

/// How a mutated weight gains its noise: times itself, or plainly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mutation {
    Scaled,
    Additive,
}
