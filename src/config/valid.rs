//! Configs that are validated as a whole.

use std::ops::Deref;

use super::{Config, ConfigError, Problem};

/// A config whose every key is in its range, with its stages resolved. Only [`Config::validate`] makes one.
#[derive(Clone, Debug, PartialEq)]
pub struct ValidConfig {
    config: Config,
    /// Each stage's first generation and config; never empty.
    stages: Vec<(usize, Config)>,
}

impl Deref for ValidConfig {
    type Target = Config;

    fn deref(&self) -> &Config {
        &self.config
    }
}

impl Config {
    /// Validates a config whose fields a program has set, as if it had been read from a file.
    ///
    /// # Errors
    /// Fails if the config is invalid. The error lists its problems.
    pub fn validate(&self) -> Result<ValidConfig, ConfigError> {
        let name = "the config";
        let text = toml::to_string(self).map_err(|error| {
            let problem = Problem { line: None, key: String::new(), message: error.to_string() };
            ConfigError::Invalid { name: name.into(), problems: vec![problem], unlisted: 0 }
        })?;
        let config = Config::parse(&text, name)?;
        Ok(ValidConfig { stages: config.staged(), config })
    }
}

impl ValidConfig {
    /// Validates several configs.
    ///
    /// # Errors
    /// Fails at the first invalid config. The error lists its problems.
    pub fn all(configs: &[Config]) -> Result<Vec<ValidConfig>, ConfigError> {
        configs.iter().map(Config::validate).collect()
    }

    /// Returns the stages, each with its first generation, in order. A config without stages is its own only stage.
    pub fn stages(&self) -> &[(usize, Config)] {
        &self.stages
    }

    /// Returns the config with at most this number of generations. Stages that begin later are never played.
    pub(crate) fn ending_at(mut self, generation: usize) -> ValidConfig {
        self.config.learning.generations = self.config.learning.generations.min(generation);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "world.leaders = [[5, 5]]\nworld.pois = [[9, 9]]\nworld.coupling = 1\n\
                        [[stages]]\nfrom = 3\nset = { \"world.steps\" = 7 }\n";

    #[test]
    fn a_config_out_of_range_is_not_valid() {
        let mut config = Config::parse(TEXT, "test.toml").unwrap();
        let valid = config.validate().unwrap();
        assert_eq!((*valid).clone(), config);
        assert_eq!(valid.stages().iter().map(|(from, _)| *from).collect::<Vec<_>>(), [0, 3]);
        assert_eq!(valid.ending_at(2).learning.generations, 2);
        config.learning.population = 1;
        let error = config.validate().unwrap_err().to_string();
        assert!(error.contains("learning.population: found 1"), "{error}");
    }

    #[test]
    fn an_edited_stage_is_no_panic() {
        let mut config = Config::parse(TEXT, "test.toml").unwrap();
        config.stages[0].set.insert("world.coupling".into(), 9.into());
        assert!(config.validate().unwrap_err().to_string().contains("stages[0].set.world.coupling"));
        config.learning.seed = u64::MAX;
        assert!(config.validate().is_err());
    }
}
