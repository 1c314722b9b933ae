//! The config of an experiment. Every key has a default except `world.leaders` and `world.pois`, or those of the lists
//! `[[agents]]` and `[[pois]]`, which replace them.
//!
//! [`Config::load`] reads a config from a file. [`Config::read`] reads it from text, together with keys that flags or a
//! sweep set.
//!
//! Each section is a struct of plain data, next to the declarations of its keys. A key is declared once, with its unit,
//! meaning, place in the paper, allowed values and default. Keys of a part of the step are declared with that part in
//! [`crate::model`], the others in this module. All problems of a text are found in one pass and reported by line, see
//! [`crate::reader`].

use std::collections::BTreeMap;

use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

use crate::model::policy::parameters;
use crate::model::start::nearest;
use crate::reader::{self, Document, Reader, Value, section_of};
use classes::Summary;

pub use crate::config_enum::Choice;
pub use crate::model::classes::{
    AGENTS, AgentClass, Channel, Classes, Combine, Control, ControlKind, Fitness, Frame, MAX_CHANNELS, MAX_CLASSES,
    MAX_INPUTS, MAX_SECTORS, MAX_TERMS, Measure, POIS, PoiGroup, Score, Sectors, Term, When,
};
pub use crate::model::follow::Follow;
pub use crate::model::motion::{Mobility, Motion};
pub use crate::model::policy::{Actions, MAX_HIDDEN_LAYERS, MAX_HIDDEN_UNITS, Policy};
pub use crate::model::region::Region;
pub use crate::model::rule::{Coupling, Observers};
pub use crate::model::sense::{Density, MOST_MEASURED, Sense};
pub use crate::model::start::Heading;
pub use crate::reader::{Definition, Override, Problem, key_path};

pub use classes::{drawn_agents, drawn_every};
pub use credit::{CreditConfig, LedBy};
pub use learning::{
    CheckpointConfig, Elites, Initial, Learning, Leniency, MAX_EPISODES, MAX_GENERATIONS, MAX_HALL_OF_FAME,
    MAX_PARTNERS, MAX_POPULATION, MAX_TRIALS, Method, Mutation, Paradigm, Parents, Sharing, Teams,
};
pub use load::name;
pub use load::{is_standard_input, read_file, read_text};
pub use populations::{own_populations, population_count};
pub use stages::MAX_STAGES;
pub use stages::{GENERATIONS, STAGES, Stage};
pub use valid::{StageConfig, ValidConfig};
use world::MAX_RECORD_BYTES;
pub use world::{MAX_AGENTS, MAX_LEARNERS, MAX_POIS, MAX_STEPS, WorldConfig};

mod classes;
mod credit;
mod learning;
mod load;
mod populations;
mod stages;
mod valid;
mod world;

/// The configs of the paper's layouts, each with its name.
pub const LAYOUTS: [(&str, &str); 3] = [
    ("generally forward", include_str!("../../configs/generally_forward.toml")),
    ("strictly forward", include_str!("../../configs/strictly_forward.toml")),
    ("chaotic", include_str!("../../configs/chaotic.toml")),
];
/// Maximum size of the policies of all trials of a run, in bytes.
pub(crate) const MAX_POLICY_BYTES: u64 = 1 << 38;
/// The name in errors of a config that does not come from a file.
const OWN_NAME: &str = "the config";
/// The section that makes a config a sweep: lists of values to combine.
pub const GRID: &str = "grid";
/// The section of a sweep with values to try one at a time.
pub const VARY: &str = "vary";

/// Returns every key of a config, in the order of [`Config::to_toml`].
pub fn keys() -> Vec<Definition> {
    let (config, reader::Keys { sections: mut keys, .. }) = reader::keys(Config::ask);
    let text = config.to_toml();
    let place = |key: &Definition| {
        let (section, leaf) = key.name.split_once('.')?;
        let start = text.find(&format!("[{section}]\n"))?;
        Some(start + text[start..].find(&format!("\n{leaf} = "))?)
    };
    keys.sort_by_key(place);
    keys
}

/// Returns the keys of the tables of a config, by the dotted name of each list or table: `agents`, `agents.motion`.
pub fn table_keys() -> Vec<(&'static str, Vec<Definition>)> {
    reader::keys(Config::ask).1.tables
}

/// One experiment, as written in a config file.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// `[world]`: start positions, the length of an episode, and how POIs are observed.
    pub world: WorldConfig,
    /// `[motion]`: how agents move.
    pub motion: Motion,
    /// `[follow]`: the behaviour of followers.
    pub follow: Follow,
    /// `[sense]`: the inputs of leaders.
    pub sense: Sense,
    /// `[policy]`: the leaders' network.
    pub policy: Policy,
    /// `[learning]`: the coevolution.
    pub learning: Learning,
    /// `[credit]`: what is taken out to see what a learner was worth.
    pub credit: CreditConfig,
    /// `[checkpoint]`: how often a run saves.
    pub checkpoint: CheckpointConfig,
    /// `[[agents]]`: classes of agents, written in full. Empty if they are written in short, see [`Config::classes`].
    pub agents: Vec<AgentClass>,
    /// `[[pois]]`: groups of POIs, written in full. Empty if they are written in short.
    pub pois: Vec<PoiGroup>,
    /// `[[stages]]`: keys that change from some generation on, see [`ValidConfig::stages`].
    pub stages: Vec<Stage>,
}

/// Writes the keys that the config's tables do not replace, then its tables and stages.
impl Serialize for Config {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        self.sections().0.iter().try_for_each(|(section, keys)| map.serialize_entry(section, keys))?;
        if !self.agents.is_empty() {
            map.serialize_entry(AGENTS, &self.agents)?;
        }
        if !self.pois.is_empty() {
            map.serialize_entry(POIS, &self.pois)?;
        }
        if !self.stages.is_empty() {
            map.serialize_entry(STAGES, &self.stages)?;
        }
        map.end()
    }
}

/// A map in the order of its entries. A dotted key is written as its last part.
struct Map<V>(Vec<(&'static str, V)>);

impl<V: Serialize> Serialize for Map<V> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let name = |key: &'static str| key.rsplit_once('.').map_or(key, |(_, name)| name);
        serializer.collect_map(self.0.iter().map(|(key, value)| (name(key), value)))
    }
}

impl Config {
    /// Reads a config from its text. Errors use `name` as the file's name.
    ///
    /// # Errors
    /// Fails if the text is invalid. The error lists its problems.
    pub fn parse(text: &str, name: &str) -> Result<Config, ConfigError> {
        Config::read(text, name, &[], &[])
    }

    /// Reads a config with some keys set by overrides, and checks text and overrides together.
    ///
    /// Sections named in `ignored`, such as a sweep's `grid`, are ignored.
    ///
    /// # Errors
    /// Fails if the text or an override is invalid. The error lists their problems.
    pub fn read(text: &str, name: &str, ignored: &[&str], overrides: &[Override]) -> Result<Config, ConfigError> {
        Ok(Config::read_noted(&Document::parse(text), name, ignored, overrides)?.0.into_config())
    }

    /// Reads a config from a parsed text as [`Config::read`] does, and returns notes for its author. The notes report
    /// defaults that other keys do not allow, flags that a stage overrides, and the results of [`ValidConfig::notes`].
    ///
    /// # Errors
    /// Fails if the text or an override is invalid. The error lists their problems.
    pub fn read_noted(
        document: &Document<'_>,
        name: &str,
        ignored: &[&str],
        overrides: &[Override],
    ) -> Result<(ValidConfig, Vec<String>), ConfigError> {
        let is_sweep = "this makes the file a sweep, of many configs; use `flotilla sweep`";
        let refused: &[&str] = if ignored.contains(&GRID) { &[] } else { &[GRID, VARY] };
        let ignored = [ignored, &[STAGES]].concat();
        let values = || Reader::of_text(document, &ignored, refused, is_sweep);
        resolve(name, overrides, values, || stages::unresolved(document, false))
    }

    /// Returns this config with some keys changed.
    ///
    /// # Errors
    /// Fails if an override is invalid. The error lists the problems.
    pub fn with(&self, overrides: &[Override]) -> Result<Config, ConfigError> {
        Ok(self.resolved(overrides)?.into_config())
    }

    /// Validates a config whose fields a program has set, as if it had been read from a file.
    ///
    /// # Errors
    /// Fails if the config is invalid. The error lists its problems.
    pub fn validate(&self) -> Result<ValidConfig, ConfigError> {
        self.resolved(&[])
    }

    fn resolved(&self, overrides: &[Override]) -> Result<ValidConfig, ConfigError> {
        let stages = || (self.stages.iter().enumerate().map(stages::UnresolvedStage::of).collect(), vec![]);
        Ok(resolve(OWN_NAME, overrides, || Ok(Reader::of_values(self.values())), stages)?.0)
    }

    /// Returns the sections with the value of each dotted key, without the keys that tables replace.
    fn sections(&self) -> Map<Map<Value<'static>>> {
        let Config { world, motion, follow, sense, policy, learning, credit, checkpoint, .. } = self;
        let sections = [world.values(), motion.values(), follow.values(), sense.values(), policy.values()];
        let sections = sections.into_iter().chain([learning.values(), credit.values(), checkpoint.values()]);
        let written = sections.filter_map(|mut values| {
            values.retain(|(key, _)| self.is_written(key));
            Some((section_of(values.first()?.0), Map(values)))
        });
        Map(written.collect())
    }

    /// Returns the value of each dotted key and of the lists of tables, without the stages.
    fn values(&self) -> impl Iterator<Item = (&'static str, Value<'static>)> {
        let agents = (!self.agents.is_empty()).then(|| (AGENTS, Value::of(&self.agents)));
        let pois = (!self.pois.is_empty()).then(|| (POIS, Value::of(&self.pois)));
        self.sections().0.into_iter().flat_map(|(_, values)| values.0).chain(agents).chain(pois)
    }

    /// Returns the text of a config file for this config, with every key written out.
    ///
    /// # Panics
    /// Panics if a program has set a whole number that TOML cannot represent, which is one above 2⁶³ − 1. Such a config
    /// is invalid, see [`Config::validate`].
    pub fn to_toml(&self) -> String {
        const IS_TOML: &str = "numbers, words and lists of them under plain keys are TOML";
        let mut parts = vec![toml::to_string(&self.sections()).expect(IS_TOML)];
        parts.extend(self.tables_to_toml());
        if !self.stages.is_empty() {
            parts.push(toml::to_string(&BTreeMap::from([(STAGES, &self.stages)])).expect(IS_TOML));
        }
        parts.join("\n")
    }

    /// Returns the number of agents that learn: those of classes with a policy. In short these are the leaders, and in
    /// the all-leaders paradigm also the followers.
    pub fn learners(&self) -> usize {
        match self.learning.paradigm {
            _ if !self.agents.is_empty() => {
                self.agents.iter().filter(|class| class.learns()).map(|class| class.size()).sum()
            }
            Paradigm::LeaderFollower => self.world.leaders.len(),
            Paradigm::AllLeaders => self.world.leaders.len() + self.world.followers.len(),
        }
    }

    /// Returns the bytes of everything that any fitness may need of one team's episode: the agents at each POI, the leaders
    /// that followers saw, and positions if [scores need these](Config::needs_paths).
    fn record_bytes(&self) -> u64 {
        let numbers = [self.agent_count(), self.learners(), self.poi_count(), self.world.steps];
        let [agents, learners, pois, steps] = numbers.map(|number| number as u64);
        let followers = agents.saturating_sub(learners);
        let sights = followers * learners.div_ceil(32);
        let paths = if self.needs_paths().is_empty() { 0 } else { 2 * agents };
        4 * (steps * (pois * agents.div_ceil(32) + sights) + followers * learners + (steps + 1) * paths)
    }

    /// Returns the number of populations in a trial.
    pub fn populations(&self) -> usize {
        population_count(&self.population_of_each())
    }

    /// Returns the population of each learner, `[learners]`.
    pub fn population_of_each(&self) -> Vec<u32> {
        let (learners, leaders) = (self.learners(), &self.world.leaders);
        match (self.learning.sharing, &self.learning.groups[..]) {
            (Sharing::PerLeader, _) => own_populations(learners).to_vec(),
            (Sharing::Shared, _) => vec![0; learners],
            (Sharing::Group, []) if !self.agents.is_empty() => {
                let sizes = self.agents.iter().filter(|class| class.learns()).map(AgentClass::size);
                (0..).zip(sizes).flat_map(|(population, size)| vec![population; size]).collect()
            }
            (Sharing::Group, []) => {
                let others = self.world.followers.iter().map(|place| nearest(place, leaders) as u32);
                own_populations(leaders.len()).iter().copied().chain(others).take(learners).collect()
            }
            (Sharing::Group, groups) => {
                let mut of_each = vec![0; learners];
                for (population, group) in (0..).zip(groups) {
                    group.iter().for_each(|&learner| of_each[learner] = population);
                }
                of_each
            }
        }
    }

    /// Returns the population of each learner if there are this many populations, for policies that may be from another
    /// config: as in this config, or one per learner, or one for all. Returns `None` for other numbers.
    pub fn populations_for(&self, populations: usize) -> Option<Vec<u32>> {
        let (own, learners) = (self.population_of_each(), self.learners());
        match populations {
            _ if populations == population_count(&own) => Some(own),
            _ if populations == learners => Some(own_populations(learners).to_vec()),
            1 => Some(vec![0; learners]),
            _ => None,
        }
    }

    /// Returns the number of teams with past champions in a generation of a trial: one per policy of every population.
    pub fn hall_teams(&self, generation: usize) -> usize {
        let plays = self.learning.hall_of_fame > 0 && generation > 0;
        if plays { self.populations() * self.learning.population } else { 0 }
    }

    /// Returns the largest number of teams in a generation of a trial, including the champions' team.
    pub fn max_teams(&self) -> usize {
        self.learning.team_count() + self.hall_teams(1) + 1
    }

    /// Returns the numbers of a trial's fitness, `[populations][policies]`, followed by the rank of each policy's team if
    /// [teams are kept](Learning::keeps_teams).
    pub fn fitness_len(&self) -> usize {
        let scores = self.populations() * self.learning.population;
        if self.learning.keeps_teams() { 2 * scores } else { scores }
    }

    /// Returns the number of weights in one policy, including biases.
    pub fn parameters(&self) -> usize {
        parameters(&self.widths())
    }

    /// Returns the size of the policies of all trials, in bytes.
    pub fn policy_bytes(&self) -> u64 {
        let counts = [self.learning.trials, self.populations(), self.learning.population, self.parameters()];
        counts.map(|count| count as u64).iter().product::<u64>() * size_of::<f32>() as u64
    }

    /// Reads every key. An invalid number reads as the largest allowed one, and an invalid list as empty. This way keys
    /// that depend on them are not reported as well.
    fn ask(r: &mut Reader<'_>) -> Config {
        let has_agents = r.replace(AGENTS, classes::REPLACED_BY_AGENTS);
        let has_pois = r.replace(POIS, classes::REPLACED_BY_POIS);
        let mut summary = Summary::peek(r);
        let (motion, start_speed) = Motion::read(r);
        let paradigm = Paradigm::read(r);
        let (world, sides) =
            WorldConfig::read(r, start_speed, paradigm, has_agents.then(|| summary.observers()), has_pois);
        if !has_agents {
            summary.classes = world.class_summaries(paradigm);
        }
        if !has_pois {
            summary.groups = world.group_summaries();
        }
        let agents = classes::read_agents(r, sides, &summary);
        if has_agents && !has_pois && summary.observers() == 0 && summary.classes.iter().all(|class| class.agents > 0) {
            r.report_key(AGENTS, "found no class that observes, allowed one or more with observes = true".into());
        }
        let pois = classes::read_pois(r, sides, world.steps, &summary);
        // Without leaders the list is wrong, and the number of learners is unknown.
        let learners = if has_agents || !world.leaders.is_empty() { summary.learners() } else { 0 };
        let agent_count = match has_agents {
            true => agents.iter().map(AgentClass::size).sum(),
            false => world.leaders.len() + world.followers.len(),
        };
        let config = Config {
            world,
            motion,
            follow: Follow::read(r),
            sense: Sense::read(r),
            policy: Policy::read(r),
            learning: Learning::read(r, paradigm, learners),
            credit: CreditConfig::read(r, learners, agent_count),
            checkpoint: CheckpointConfig::read(r),
            agents,
            pois,
            stages: vec![],
        };
        if has_agents && learners > MAX_LEARNERS {
            r.report_key(AGENTS, format!("found {learners} agents that learn, allowed up to {MAX_LEARNERS}"));
        }
        let small_only = config.agents.iter().find(|class| class.is_of_small_teams());
        if let (true, Some(class)) = (agent_count > MAX_LEARNERS, small_only) {
            let message = format!(
                "found {agent_count} agents, allowed up to {MAX_LEARNERS}, because agents of {:?} move to others, sense each, \
                 or move only near others",
                class.name
            );
            r.report_key(AGENTS, message);
        }
        let record = config.record_bytes();
        if r.error_count() == 0 && record > MAX_RECORD_BYTES {
            let [found, most] = [record, MAX_RECORD_BYTES].map(|bytes| bytes.div_ceil(1 << 20));
            let text = format!(
                "found {}, with which the record of an episode takes {found} MiB, allowed {most} MiB: it grows with \
                 agents × learners, steps × agents × learners and steps × agents × POIs",
                config.world.steps
            );
            r.report_key("world.steps", text);
        }
        let needs_quadrants =
            config.agents.iter().find(|class| class.control == Control::Policy && !class.senses_quadrants());
        if let (Actions::Behaviours, Some(class)) = (config.policy.actions, needs_quadrants) {
            let message = format!(
                "found \"behaviours\", but the senses of {:?} do not begin with POIs and agents in 4 sectors around the \
                 heading",
                class.name
            );
            r.report_key("policy.actions", message);
        }
        let why = config.needs_paths();
        if r.error_count() == 0
            && !why.is_empty()
            && let Some(group) = config.classes().pois.iter().find(|group| !group.after.is_empty())
        {
            let (key, pois) = match has_pois {
                true => (POIS, format!("{:?}, which comes", group.name)),
                false => ("world.after", "POIs that come".into()),
            };
            r.report_key(key, format!("found {pois} after others, allowed without {}", why.join(", ")));
        }
        let Learning { population, hall_of_fame, .. } = config.learning;
        if r.error_count() == 0 && config.populations() == 1 {
            let what = if config.learners() == 1 { "leader" } else { "population" };
            let partners = config.learning.partners;
            let partners = (partners > 1).then(|| ("learning.partners", partners.to_string(), "1".into()));
            for (key, found, default) in config.learning.team_keys().chain(partners) {
                r.report_key(key, format!("found {found} with a single {what}, allowed {default}: it has no partners"));
            }
        }
        let teams = if r.error_count() == 0 { config.max_teams() - 1 } else { 0 };
        if hall_of_fame > 0 && teams > MAX_POPULATION {
            let text =
                format!("found {hall_of_fame}, which makes {teams} teams per generation, allowed {MAX_POPULATION}");
            r.report_key("learning.hall_of_fame", text);
        }
        // With too many agents there are no populations to count.
        let bytes = |config: &Config| config.policy_bytes() / population as u64 * (population + hall_of_fame) as u64;
        if r.error_count() == 0 && bytes(&config) > MAX_POLICY_BYTES {
            let bytes = bytes(&config);
            let gib = |bytes: u64| bytes.div_ceil(1 << 30);
            let (bytes, most) = (gib(bytes), gib(MAX_POLICY_BYTES));
            let text = format!("found {population}, whose policies of all trials take {bytes} GiB, allowed {most} GiB");
            r.report_key("learning.population", text);
        }
        config
    }
}

/// Reads a config from its values and stages, with some keys set by overrides. Also returns notes for its author, see
/// [`Config::read_noted`].
fn resolve<'a>(
    name: &str,
    overrides: &[Override],
    values: impl Fn() -> Result<Reader<'a>, Vec<Problem>>,
    stages: impl Fn() -> (Vec<stages::UnresolvedStage<'a>>, Vec<Problem>),
) -> Result<(ValidConfig, Vec<String>), ConfigError> {
    let (staging, overrides): (Vec<_>, Vec<_>) = overrides.iter().cloned().partition(|set| set.key == stages::STAGES);
    let invalid = |mut problems: Vec<Problem>| {
        let unlisted = problems.len().saturating_sub(reader::MAX_LISTED);
        problems.truncate(reader::MAX_LISTED);
        ConfigError::Invalid { name: name.to_string(), problems, unlisted }
    };
    let without_stages = |overrides: &[Override]| {
        let mut reader: Reader<'_> = values()?;
        reader.set_all(overrides, &[AGENTS, POIS]);
        reader.read(Config::ask)
    };
    let (own, mut notes) = without_stages(&overrides).map_err(invalid)?;
    let resolved = match staging.last() {
        Some(set) => {
            let text = format!("{} = {}", stages::STAGES, set.text);
            stages::resolve(stages::unresolved(&Document::parse(&text), true), &own)
                .map_err(|problems| stages::of_flags(problems, &set.name))
        }
        None => stages::resolve(stages(), &own).map_err(|problems| {
            let is_valid = |overrides: &[Override]| {
                without_stages(overrides).is_ok_and(|(own, _)| stages::resolve(stages(), &own).is_ok())
            };
            stages::attribute(problems, &overrides, is_valid)
        }),
    };
    let (stages, configs): (Vec<_>, Vec<_>) = resolved.map_err(invalid)?.into_iter().unzip();
    let is_unused = std::iter::once(&own).chain(&configs).all(valid::learn_by_own_fitness);
    if let Some(set) = overrides.iter().find(|set| is_unused && set.key == "learning.fitness") {
        let message = "no effect, because every class that learns has its own; set agents.NAME.fitness instead";
        return Err(invalid(vec![Problem { line: None, key: set.name.clone(), message: message.into() }]));
    }
    for set in &overrides {
        let path = stages::path_of(&set.key, &own);
        let sets = |key: &String| {
            let other = stages::path_of(key, &own);
            other.starts_with(&path) || path.starts_with(&other)
        };
        notes.extend(stages.iter().filter(|stage| stage.set.keys().any(sets)).map(|Stage { from, .. }| {
            format!("{}: the stage from generation {from} on sets this, too, and its value counts there", set.name)
        }));
    }
    let config = ValidConfig::new(Config { stages, ..own }, configs);
    notes.extend(config.notes());
    Ok((config, notes))
}

/// An error in reading or validating a config.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read: it does not exist, is not UTF-8 text or is too large.
    #[error("{name}: cannot be read: {reason}")]
    Unreadable {
        /// The file's name in errors.
        name: String,
        /// The reason, from the system or from flotilla.
        reason: String,
        /// Whether the file does not exist.
        is_missing: bool,
    },
    /// The config is invalid. Problems are listed by line, and those from outside the file (see [`Override`]) come
    /// last.
    #[error("{}", list(name, problems, *unlisted))]
    Invalid {
        /// The file's name in errors.
        name: String,
        /// The first problems. Those beyond a limit are only counted.
        problems: Vec<Problem>,
        /// Number of problems that are not listed.
        unlisted: usize,
    },
}

impl ConfigError {
    /// Reports whether all problems come from flags and none from the file.
    pub fn is_usage(&self) -> bool {
        match self {
            ConfigError::Unreadable { .. } => false,
            ConfigError::Invalid { problems, .. } => problems.iter().all(|problem| problem.key.starts_with("--")),
        }
    }
}

fn list(name: &str, problems: &[Problem], unlisted: usize) -> String {
    let lines = problems.iter().map(|Problem { line, key, message }| {
        let place = line.map_or(String::new(), |line| format!("{name}:{line}: "));
        let key = if key.is_empty() { String::new() } else { format!("{key}: ") };
        format!("{place}{key}{message}")
    });
    let mut lines: Vec<String> = lines.collect();
    if let ([line], [Problem { line: None, key, .. }]) = (&mut lines[..], problems)
        && !key.is_empty()
        && !key.starts_with("--")
    {
        *line = format!("{name}: {line}");
    }
    if unlisted > 0 {
        lines.push(format!("… and {unlisted} more"));
    }
    if lines.len() > 1 {
        lines.insert(0, format!("{} problems in {name}", problems.len() + unlisted));
    }
    lines.join("\n")
}
