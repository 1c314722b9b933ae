//! Answers to the page's requests: JSON and numbers, errors, and the description of a config.

use std::fmt::Display;

use flotilla::config::{Config, ConfigError, Problem, ValidConfig};
use flotilla::model::start;
use flotilla_app::report::replay;
use serde_json::{Value, json};

/// JSON and little-endian numbers.
pub type Answer = (Value, Vec<u8>);

/// An error as JSON: a message, and for an invalid config its problems by line.
pub struct Refusal(Value);

impl From<Refusal> for Value {
    fn from(refusal: Refusal) -> Value {
        refusal.0
    }
}

impl From<ConfigError> for Refusal {
    fn from(error: ConfigError) -> Refusal {
        let mut words = json!({ "error": error.to_string() });
        if let ConfigError::Invalid { problems, unlisted, .. } = error {
            let problem =
                |problem: Problem| json!({ "line": problem.line, "key": problem.key, "message": problem.message });
            words["problems"] = problems.into_iter().map(problem).collect();
            words["unlisted"] = unlisted.into();
        }
        Refusal(words)
    }
}

/// Wraps any error that has only a message.
pub fn refuse(error: impl Display) -> Refusal {
    Refusal(json!({ "error": error.to_string() }))
}

/// Copies bytes of any alignment to f32 numbers. Incomplete trailing bytes are ignored.
pub fn floats(bytes: &[u8]) -> Vec<f32> {
    bytemuck::pod_collect_to_vec(&bytes[..bytes.len() / 4 * 4])
}

/// Returns a config as TOML and as JSON, with its number of POIs (null if stages or the values of POIs differ, because G
/// does not count POIs then), parameters per policy, and start. With the start come the notes, and whether any class learns
/// by the config's own fitness.
pub fn described(config: &ValidConfig) -> Value {
    let (toml, pois, parameters) = (config.to_toml(), config.pois(), config.parameters());
    let mut words = json!({ "toml": toml, "config": **config, "pois": pois, "parameters": parameters });
    // JavaScript numbers cannot represent every 64-bit seed.
    words["config"]["learning"]["seed"] = config.learning.seed.to_string().into();
    // The page draws leaders and followers.
    if !config.agents.is_empty() || !config.pois.is_empty() {
        words["config"]["world"] = json!(config.drawn());
        words["config"]["follow"] = json!({ "attraction_radius": config.influence_radius() });
    }
    words["start"] = start_of(config);
    words["start"]["notes"] = config.notes().into();
    let mut learners = config.classes().agents.into_iter().filter(|class| class.learns());
    words["start"]["common_fitness"] = learners.any(|class| class.fitness.is_none()).into();
    if !words["start"]["values"].is_null() {
        words["pois"] = Value::Null;
    }
    words
}

/// Returns each POI's coupling, each agent's heading, the leader that each agent would follow first (-1 for none), and
/// what only full configs have.
fn start_of(config: &Config) -> Value {
    let (world, radius) = (config.drawn(), config.influence_radius());
    let first = |follower: &[f64; 2]| {
        let leader = start::nearest(follower, &world.leaders);
        let [dx, dy] = [0, 1].map(|axis| world.leaders[leader][axis] - follower[axis]);
        if dx.hypot(dy) <= radius { leader as i64 } else { -1 }
    };
    let owner: Vec<i64> = (0..world.leaders.len() as i64).chain(world.followers.iter().map(first)).collect();
    let coupling = world.coupling.of_each(world.pois.len());
    let mut start = json!({ "owner": owner, "coupling": coupling, "headings": world.headings() });
    for (key, value) in replay::parts(config) {
        start[key] = value;
    }
    start
}
