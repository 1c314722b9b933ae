//! Baselines without learning, for the chart.

use flotilla::backend::cpu::Cpu;
use flotilla::baseline::Baselines;
use flotilla::config::{Config, ValidConfig};
use flotilla::host::Instant;
use serde_json::{Value, json};

use crate::answer::{Refusal, refuse};

/// Episodes from which G of a constant action is averaged if starts or POIs move.
const EPISODES: u32 = 20;

/// Returns the config of the last stage, whose champions baselines are compared with.
fn in_last_stage(config: &ValidConfig) -> Config {
    Config::clone(config.at(config.learning.generations))
}

/// Returns G of the best constant action, as a mean over trials.
///
/// # Errors
/// The backend fails.
pub fn constant(config: &ValidConfig) -> Result<Value, Refusal> {
    let mut config = in_last_stage(config);
    // If nothing moves, all generations and trials are equal.
    if !config.starts_move() && !config.pois_move() {
        let learning = &mut config.learning;
        (learning.generations, learning.trials) = (0, 1);
    }
    let trials = config.learning.trials as f64;
    let (mut baselines, mut cpu) = (Baselines::of_constants(&config.validate()?), Cpu::default());
    while !baselines.is_done() {
        baselines.advance(&mut cpu).map_err(refuse)?;
    }
    let outcomes = baselines.outcomes(&mut cpu, EPISODES).map_err(refuse)?.remove(0);
    let g = outcomes.iter().map(|outcome| outcome.constants[outcome.best_constant]).sum::<f64>() / trials;
    Ok(json!({ "g": g }))
}

/// The best of as many random networks as training evaluates.
pub struct Random(Baselines);

impl Random {
    pub fn new(config: &ValidConfig) -> Result<Random, Refusal> {
        Ok(Random(Baselines::new(&[in_last_stage(config).validate()?]).without_climbers()))
    }

    /// Plays generations for `time` milliseconds, at least one. Returns G of the best so far per generation, as means
    /// over trials.
    ///
    /// # Errors
    /// The backend fails.
    pub fn advance(&mut self, time: f64) -> Result<Value, Refusal> {
        let (start, mut cpu) = (Instant::now(), Cpu::default());
        while !self.0.is_done() {
            self.0.advance(&mut cpu).map_err(refuse)?;
            if start.elapsed().as_secs_f64() * 1000.0 >= time {
                break;
            }
        }
        let trials = self.0.so_far().next().map_or(&[][..], |found| &found.random);
        let mean = |generation: usize| trials.iter().map(|g| g[generation]).sum::<f64>() / trials.len() as f64;
        let g: Vec<f64> = (0..self.0.generation()).map(mean).collect();
        Ok(json!({ "done": self.0.is_done(), "g": g }))
    }
}
