//! Configs that are validated as a whole.

use std::collections::HashSet;
use std::ops::Deref;

use super::{AgentClass, Classes, Config, ConfigError, Fitness, LedBy, Mobility, Score, Stage, WorldConfig};

/// A config whose every key is in its range: one that a [`World`](crate::world::World) is made from.
#[derive(Clone, Debug, PartialEq)]
pub struct StageConfig(Config);

impl Deref for StageConfig {
    type Target = Config;

    fn deref(&self) -> &Config {
        &self.0
    }
}

/// A config whose every key is in its range, with its stages resolved. Only reading or [`Config::validate`] returns one.
#[derive(Clone, Debug, PartialEq)]
pub struct ValidConfig {
    config: StageConfig,
    /// First generation and config of each stage that is played; never empty.
    stages: Vec<(usize, StageConfig)>,
}

impl Deref for ValidConfig {
    type Target = Config;

    fn deref(&self) -> &Config {
        &self.config
    }
}

impl AsRef<StageConfig> for StageConfig {
    fn as_ref(&self) -> &StageConfig {
        self
    }
}

/// The config's own keys, without its stages.
impl AsRef<StageConfig> for ValidConfig {
    fn as_ref(&self) -> &StageConfig {
        &self.config
    }
}

impl ValidConfig {
    /// Returns a config with the resolved configs of its stages.
    pub(super) fn new(config: Config, of_stages: Vec<Config>) -> ValidConfig {
        let played = config.stages.iter().zip(of_stages).filter(|(stage, _)| config.plays(stage));
        let mut stages: Vec<_> = played.map(|(stage, of_stage)| (stage.from, StageConfig(of_stage))).collect();
        if stages.first().is_none_or(|(from, _)| *from > 0) {
            stages.insert(0, (0, StageConfig(Config { stages: vec![], ..config.clone() })));
        }
        ValidConfig { config: StageConfig(config), stages }
    }

    /// Validates several configs.
    ///
    /// # Errors
    /// Fails at the first invalid config. The error lists its problems.
    pub fn all(configs: &[Config]) -> Result<Vec<ValidConfig>, ConfigError> {
        configs.iter().map(Config::validate).collect()
    }

    /// Returns the config of each stage that is played with its first generation, in order. If the first stage starts
    /// after generation 0, the file's own config comes before it.
    pub fn stages(&self) -> &[(usize, StageConfig)] {
        &self.stages
    }

    /// Returns the index of a generation's stage in [`ValidConfig::stages`].
    pub fn stage_of(&self, generation: usize) -> usize {
        self.stages.iter().rposition(|(from, _)| *from <= generation).unwrap_or(0)
    }

    /// Returns the config that a generation plays with.
    pub fn at(&self, generation: usize) -> &StageConfig {
        &self.stages[self.stage_of(generation)].1
    }

    /// Returns the number of generations that each stage plays, including generation 0, with the stage's config.
    pub fn stage_lengths(&self) -> impl Iterator<Item = (usize, &StageConfig)> {
        let ends = self.stages.iter().skip(1).map(|(from, _)| *from).chain([self.learning.generations + 1]);
        self.stages.iter().zip(ends).map(|((from, config), end)| (end.saturating_sub(*from), config))
    }

    /// Returns the number of POIs, or `None` if it differs between stages.
    pub fn pois(&self) -> Option<usize> {
        let count = self.stages[0].1.poi_count();
        self.stages.iter().all(|(_, config)| config.poi_count() == count).then_some(count)
    }

    /// Returns the sum of the values of all POIs, or `None` if it differs between stages.
    pub fn poi_value(&self) -> Option<f64> {
        let value = self.stages[0].1.poi_value();
        self.stages.iter().all(|(_, config)| config.poi_value() == value).then_some(value)
    }

    /// Returns what the POIs observed are weighted by in reports, see [`Config::weighted_by`], in the first stage where
    /// they are.
    pub fn weighted_by(&self) -> Option<&'static str> {
        self.stages.iter().find_map(|(_, config)| config.weighted_by())
    }

    /// Returns a note for each setting that is valid but likely a mistake.
    pub fn notes(&self) -> Vec<String> {
        let mut shown = HashSet::new();
        let of_stage = |(index, (_, config)): (usize, &(usize, StageConfig))| {
            let new = notes(config).into_iter().filter(|note| shown.insert(note.clone()));
            new.map(|note| if index == 0 { note } else { format!("stage {index}: {note}") }).collect::<Vec<_>>()
        };
        let last = self.learning.generations;
        let never_played =
            self.config.stages.iter().filter(|stage| !self.plays(stage)).map(|Stage { from, .. }| {
                format!(
                    "the stage from generation {from} on is never played, because the run ends with generation {last}"
                )
            });
        never_played.chain(self.stages.iter().enumerate().flat_map(of_stage)).collect()
    }

    /// Returns the config as it was read, without its resolved stages.
    pub fn into_config(self) -> Config {
        self.config.0
    }
}

/// Returns the notes about one stage.
fn notes(config: &Config) -> Vec<String> {
    let WorldConfig { map, dt, .. } = config.world;
    let classes = config.classes();
    let of_learning = [unused_fitness(config, &classes), slow_credit(config)].into_iter().flatten();
    let without_credit = without_credit(config, &classes).into_iter().chain(of_learning);
    if config.agents.is_empty() {
        let notes = [config.motion.too_short("motion", dt, map), config.world.heading.likely_degrees("world.heading")];
        return notes.into_iter().flatten().chain(without_credit).collect();
    }
    let of_class = |(index, class): (usize, &AgentClass)| {
        let name = format!("agents[{index}]");
        let too_short = match &class.motion {
            Mobility::Steered(motion) => motion.too_short(&format!("{name}.motion"), dt, map),
            Mobility::Free { .. } => None,
        };
        let degrees = class.heading.as_ref().and_then(|heading| heading.likely_degrees(&format!("{name}.heading")));
        let blind = class.senses.iter().enumerate().filter(|(_, channel)| channel.is_blind(class, &classes));
        let blind = blind.map(|(channel, _)| format!("{name}.senses[{channel}] never senses anything in this world"));
        too_short.into_iter().chain(degrees).chain(blind).collect::<Vec<_>>()
    };
    config.agents.iter().enumerate().flat_map(of_class).chain(without_credit).collect()
}

/// Returns a note for each class that learns by a fitness that is always 0, because its agents count at no POI and are taken
/// out alone, and one for Df or Dt if no class leads another.
fn without_credit(config: &Config, classes: &Classes) -> Vec<String> {
    let counts_somewhere = |index| (0..classes.pois.len()).any(|group| classes.observes(index, group));
    let of_class = |(index, class): (usize, &AgentClass)| {
        let fitness = class.fitness.unwrap_or(config.learning.fitness);
        // With this key, Dt takes out all agents that any class leads.
        let by_anyone = fitness == Fitness::Dt && config.credit.led_by == LedBy::Anyone;
        let leading = |leader: &&AgentClass| by_anyone || leader.name == class.name;
        let led: Vec<_> = classes.agents.iter().filter(leading).flat_map(|leader| &leader.leads).collect();
        let mut others = classes.agents.iter().enumerate();
        let led_count = others.any(|(other, agents)| led.contains(&&agents.name) && counts_somewhere(other));
        let is_alone = match fitness {
            Fitness::D => config.credit.removes.is_empty(),
            Fitness::Dpp => true,
            Fitness::Df | Fitness::Dt => !led_count,
            Fitness::G => false,
        };
        let better = if led_count { "G, Df or Dt" } else { "G, or Df with `leads`" };
        (class.learns() && is_alone && !counts_somewhere(index) && !config.credit.add_g).then(|| {
            format!(
                "{fitness} of every {} is always 0, because none counts at a POI: selection is random; use {better}",
                class.name
            )
        })
    };
    let always_0: Vec<String> = classes.agents.iter().enumerate().filter_map(of_class).collect();
    let by_led = |class: &AgentClass| {
        let fitness = class.fitness.unwrap_or(config.learning.fitness);
        (class.learns() && matches!(fitness, Fitness::Df | Fitness::Dt)).then_some(fitness)
    };
    let leads = classes.agents.iter().any(|class| !class.leads.is_empty());
    let equal = classes.agents.iter().find_map(by_led).filter(|_| !leads && !config.agents.is_empty());
    let equal = equal.filter(|_| always_0.is_empty());
    let note = equal.map(|fitness| format!("{fitness} equals D here, because no class has `leads`"));
    always_0.into_iter().chain(note).collect()
}

/// Reports whether every class that learns has its own fitness, so that `learning.fitness` has no effect.
pub(super) fn learn_by_own_fitness(config: &Config) -> bool {
    let learning = || config.agents.iter().filter(|class| class.learns());
    learning().next().is_some() && learning().all(|class| class.fitness.is_some())
}

/// Returns a note for a fitness that no class learns by, because each has its own.
fn unused_fitness(config: &Config, classes: &Classes) -> Option<String> {
    let fitness = config.learning.fitness;
    let uses = |class: &AgentClass| class.learns() && class.fitness.unwrap_or(fitness) == fitness;
    let is_used = fitness == Fitness::Df || classes.agents.iter().any(uses);
    (!is_used).then(|| format!("learning.fitness = \"{fitness}\" has no effect: every class that learns has its own"))
}

/// Returns a note if D++ by closeness takes very long, because it finds the nearest observers again for each number of
/// copies.
fn slow_credit(config: &Config) -> Option<String> {
    const LARGE: usize = 256;
    let close = config.pois.iter().filter(|group| group.score == Score::Closeness);
    let coupling =
        close.flat_map(|group| group.coupling.of_each(group.size())).max().filter(|&coupling| coupling >= LARGE)?;
    config.fitnesses().contains(&Fitness::Dpp).then(|| {
        format!(
            "D++ by closeness takes a time that grows with the cube of the coupling, which is {coupling} here: D or Df take \
             far less"
        )
    })
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
        config.learning.generations = 2;
        let shorter = config.validate().unwrap();
        assert_eq!((shorter.stages().len(), shorter.last_from(), shorter.config.stages.len()), (1, 0, 1));
        assert!(shorter.notes().iter().any(|note| note.contains("from generation 3 on is never played")));
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
        assert!(config.validate().is_err() && config.with(&[]).is_err());
    }
}
