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

/// Plays generations of baselines for `time` milliseconds, at least one.
fn play(baselines: &mut Baselines, time: f64) -> Result<(), Refusal> {
    let (start, mut cpu) = (Instant::now(), Cpu::default());
    while !baselines.is_done() {
        baselines.advance(&mut cpu).map_err(refuse)?;
        if start.elapsed().as_secs_f64() * 1000.0 >= time {
            break;
        }
    }
    Ok(())
}

/// The best constant action.
pub struct Constant {
    /// The config as text.
    pub text: String,
    baselines: Baselines,
}

impl Constant {
    pub fn new(config: &ValidConfig, text: String) -> Result<Constant, Refusal> {
        let mut config = in_last_stage(config);
        // If nothing moves, all generations and trials are equal.
        if !config.starts_move() && !config.pois_move() {
            let learning = &mut config.learning;
            (learning.generations, learning.trials) = (0, 1);
        }
        Ok(Constant { text, baselines: Baselines::of_constants(&config.validate()?) })
    }

    /// Plays generations for `time` milliseconds, at least one. After the last, returns G as a mean over trials, else null.
    ///
    /// # Errors
    /// The backend fails.
    pub fn advance(&mut self, time: f64) -> Result<Value, Refusal> {
        play(&mut self.baselines, time)?;
        if !self.baselines.is_done() {
            return Ok(json!({ "g": null }));
        }
        let outcomes = self.baselines.outcomes(&mut Cpu::default(), EPISODES).map_err(refuse)?.remove(0);
        let sum: f64 = outcomes.iter().map(|outcome| outcome.constants[outcome.best_constant]).sum();
        Ok(json!({ "g": sum / outcomes.len() as f64 }))
    }
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
        play(&mut self.0, time)?;
        let trials = self.0.so_far().next().map_or(&[][..], |found| &found.random);
        let mean = |generation: usize| trials.iter().map(|g| g[generation]).sum::<f64>() / trials.len() as f64;
        let g: Vec<f64> = (0..self.0.generation()).map(mean).collect();
        Ok(json!({ "done": self.0.is_done(), "g": g }))
    }
}
