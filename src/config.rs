//! The config file: what an experiment is, with every default of the paper's calibration.
//!
//! A file is read by [`Config::load`], or by [`Config::read`] where flags or a sweep change some of its keys. One
//! function below, `experiment`, knows the keys: each stands there once, with the values it allows and its default.
//! Everything wrong with a file is found in one pass and reported by line.

use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;
use std::fmt::{self, Display};
use std::io::Read;
use std::ops::RangeInclusive;
use std::path::Path;

use serde::Serialize;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::file;
use crate::world::{INPUTS, OUTPUTS};

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
/// Most generations after the random start.
pub const MAX_GENERATIONS: usize = 1_000_000;
/// Most trials in one run.
pub const MAX_TRIALS: usize = 4096;
/// Most episodes averaged for one team's score.
pub const MAX_EPISODES: usize = 1000;
/// A team's record stays under a gigabyte whatever the config.
const _: () = assert!(MAX_STEPS * MAX_POIS * MAX_AGENTS.div_ceil(32) * size_of::<u32>() < 1 << 30);
/// Most bytes that the policies of all trials of a run may take.
pub const MAX_POLICY_BYTES: usize = 1 << 38;
/// Most bytes in a config file.
pub const MAX_FILE_BYTES: u64 = 1 << 20;
/// The sections that make a config a sweep: values to combine, and values to try one at a time.
pub const GRID: &str = "grid";
pub const VARY: &str = "vary";
/// Most problems listed of one file.
const MAX_LISTED: usize = 50;
/// Longest map side, radius or range: squares of distances stay far from the ends of f32.
const LONGEST: f64 = 1e4;
/// Least size of a length or speed that is not 0: its square stays far from the denormals of f32.
const LEAST: f64 = 1e-6;

/// What is to be known of one key: the table behind `docs/reference.md` and every commented config.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key {
    /// Dotted: `world.dt`.
    pub name: &'static str,
    /// Empty where it has none.
    pub unit: &'static str,
    /// What kind of value it takes: `number`, `word`, `list of positions [x, y]`.
    pub kind: String,
    /// The values it takes; bounds that other keys set go by these keys' names.
    pub range: String,
    /// As TOML; none where the key has to be given.
    pub default: Option<String>,
    /// Without a full stop.
    pub meaning: &'static str,
    /// Section and equation of the paper; empty where it says nothing of this.
    pub paper: &'static str,
}

/// Every key of a config, in the order of [`Config::to_toml`].
pub fn keys() -> Vec<Key> {
    let mut reader = Reader { table: Some(vec![]), ..Reader::default() };
    let config = Config::experiment(&mut reader);
    let mut keys = reader.table.unwrap_or_default();
    let mut order = Vec::new();
    let text = config.to_toml();
    let mut section = "";
    for line in text.lines() {
        match line.split_once(" = ") {
            Some((leaf, _)) => order.push(format!("{section}.{leaf}")),
            None => section = line.trim_matches(['[', ']']),
        }
    }
    keys.sort_by_key(|key| order.iter().position(|name| name == key.name));
    keys
}

/// One experiment, as written in a config file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Config {
    pub world: World,
    pub motion: Motion,
    pub follow: Follow,
    pub sense: Sense,
    pub policy: Policy,
    pub learning: Learning,
    pub checkpoint: Checkpoint,
}

/// `[world]`: where everything starts. Lengths in map units, time in seconds, angles in radians.
#[derive(Clone, Debug, PartialEq, Serialize)]
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
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Coupling {
    Same(usize),
    Each(Vec<usize>),
}

/// `[motion]`: the limits of every agent's movement.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Motion {
    pub min_speed: f64,
    pub max_speed: f64,
    pub max_acceleration: f64,
    pub max_turn_rate: f64,
}

/// `[follow]`: the followers' preset behaviour.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Follow {
    pub attraction_radius: f64,
    pub repulsion_radius: f64,
    pub attraction_gain: f64,
    pub repulsion_gain: f64,
    pub wall_gain: f64,
}

/// `[sense]`: what a leader senses. An infinite range is unlimited; a config file says so with `inf`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sense {
    pub poi_range: f64,
    pub agent_range: f64,
    pub density: Density,
}

/// `[policy]`: the leaders' network, `8, hidden…, 2`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Policy {
    pub hidden: Vec<usize>,
}

/// `[learning]`: the cooperative coevolution.
#[derive(Clone, Debug, PartialEq, Serialize)]
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

/// `[checkpoint]`: how often a run saves what it needs to go on, without a say in its results; 0 is never.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Checkpoint {
    /// After so many generations.
    pub generations: usize,
    /// After so many seconds.
    pub seconds: f64,
}

impl Default for Checkpoint {
    fn default() -> Checkpoint {
        Checkpoint { generations: 0, seconds: 30.0 }
    }
}

/// A key whose value is one of a few words.
pub trait Choice: Copy + Serialize + 'static {
    /// Every word with what it stands for.
    const ALL: &'static [(&'static str, Self)];

    /// The words, for a command line's list of possible values.
    fn names() -> impl Iterator<Item = &'static str> {
        Self::ALL.iter().map(|&(name, _)| name)
    }
}

/// Defines an enum whose variants are written in configs as the words given.
macro_rules! choice {
    ($(#[$doc:meta])* $name:ident { $($(#[$variant_doc:meta])* $variant:ident = $word:literal,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
        pub enum $name {
            $($(#[$variant_doc])* #[serde(rename = $word)] $variant,)*
        }

        impl Choice for $name {
            const ALL: &'static [(&'static str, Self)] = &[$(($word, Self::$variant),)*];
        }

        impl Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(match self { $(Self::$variant => $word,)* })
            }
        }
    };
}

choice! {
    /// How a sensed distance counts.
    Density {
        /// `1 - d/D` with D = √2·max(map).
        Linear = "linear",
        /// `1 / max(d, 1)`.
        Inverse = "inverse",
    }
}

choice! {
    /// Who learns.
    Paradigm {
        /// The leaders; followers keep their preset behaviour.
        LeaderFollower = "leader-follower",
        /// Every agent: the followers' places become leaders, appended after the leaders.
        AllLeaders = "all-leaders",
    }
}

choice! {
    /// Which score a policy is selected by (see [`crate::credit`]).
    Fitness {
        /// The team's score.
        G = "G",
        /// Difference evaluation.
        D = "D",
        /// Difference evaluation that takes a leader's followers out with it.
        Df = "Df",
        /// Difference evaluation with copies of the leader as stepping stones.
        Dpp = "D++",
    }
}

choice! {
    /// How a mutated weight gains its noise.
    Mutation {
        /// Times itself.
        Scaled = "scaled",
        /// Plainly.
        Additive = "additive",
    }
}

impl Config {
    /// Reads a config file.
    ///
    /// # Errors
    /// A file that cannot be read, or everything that is wrong with what it says.
    pub fn load(path: &Path) -> Result<Config, ConfigError> {
        Config::parse(&read_file(path)?, &name(path))
    }

    /// Reads a config from its text; `name` stands for the file in errors.
    ///
    /// # Errors
    /// Everything that is wrong with the text.
    pub fn parse(text: &str, name: &str) -> Result<Config, ConfigError> {
        Config::read(text, name, &[], &[])
    }

    /// Reads a config with some keys set from elsewhere, checked together with the rest.
    ///
    /// Sections named in `foreign` belong to somebody else (a sweep's `grid`) and are passed over.
    ///
    /// # Errors
    /// Everything that is wrong with the text and the overrides.
    pub fn read(text: &str, name: &str, foreign: &[&str], overrides: &[Override]) -> Result<Config, ConfigError> {
        let (document, errors) = DeTable::parse_recoverable(text);
        let mut reader = Reader::default();
        for error in first_slips(text, &errors) {
            let span = error.span().unwrap_or(0..0);
            let at = text.get(span.clone()).filter(|at| !at.trim().is_empty());
            let at = at.map_or(String::new(), |at| format!(" (at `{}`)", shorten(at)));
            let message = error.message().trim().replace('\n', ", ") + &at;
            reader.blame(Place::Offset(span.start), "", message);
        }
        if reader.problems.is_empty() && !foreign.contains(&GRID) {
            // Of a sweep taken for a config nothing else is worth saying.
            let sections = document.get_ref().keys();
            let mut of_sweeps = sections.filter(|key| [GRID, VARY].contains(&key.get_ref().as_ref()));
            if let Some(section) = of_sweeps.next() {
                let message = "this makes the file a sweep, of many configs; use `flotilla sweep`";
                reader.blame(Place::Offset(section.span().start), section.get_ref(), message.into());
            }
        }
        if reader.problems.is_empty() {
            reader.fill(document.into_inner(), text, foreign, overrides);
            let config = Config::experiment(&mut reader);
            reader.blame_unknown();
            if reader.problems.is_empty() {
                return Ok(config);
            }
        }
        Err(reader.into_error(text, name))
    }

    /// This config with some keys changed.
    ///
    /// # Errors
    /// Everything that is wrong with the overrides.
    pub fn with(&self, overrides: &[Override]) -> Result<Config, ConfigError> {
        Config::read(&self.to_toml(), "the config", &[], overrides)
    }

    /// The config file that says this, every key written out.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("numbers, words and lists of them under plain keys are TOML")
    }

    /// Everything that learns: the leaders, and in the all-leaders paradigm the followers too.
    pub fn learners(&self) -> usize {
        match self.learning.paradigm {
            Paradigm::LeaderFollower => self.world.leaders.len(),
            Paradigm::AllLeaders => self.world.leaders.len() + self.world.followers.len(),
        }
    }

    /// Weights of one policy, biases included.
    pub fn parameters(&self) -> usize {
        let widths = [&[INPUTS], &self.policy.hidden[..], &[OUTPUTS]].concat();
        widths.windows(2).map(|w| (w[0] + 1) * w[1]).sum()
    }

    /// Bytes that the policies of all trials take.
    pub fn policy_bytes(&self) -> usize {
        self.learning.trials * self.learners() * self.learning.population * self.parameters() * size_of::<f32>()
    }

    /// Every key with its unit, its meaning, where the paper has it, what it allows and its default. A faulty number
    /// reads as the most that is allowed, a faulty list as none, so that what depends on it is not blamed as well.
    fn experiment(r: &mut Reader<'_>) -> Config {
        let map = r
            .key("world.map", "units", "width and height; positions stay within 0 to these", "3.1")
            .pair(between(1.0, LONGEST), [50.0, 50.0]);
        let leaders = r
            .key("world.leaders", "units", "start positions of the leaders, which are agents 0 to L − 1", "4.1, Fig. 3")
            .points(1..=MAX_AGENTS, map, None);
        let followers = r
            .key(
                "world.followers",
                "units",
                "start positions of the followers, agents L to N − 1; in the all-leaders paradigm leaders stand there",
                "4.1, Fig. 3",
            )
            .points(0..=MAX_AGENTS - 1, map, Some(vec![]));
        let pois = r
            .key(
                "world.pois",
                "units",
                "positions of the P points of interest, which stay where they are",
                "3.1, Fig. 3",
            )
            .points(1..=MAX_POIS, map, None);
        let agents = leaders.as_ref().zip(followers.as_ref()).map_or(MAX_AGENTS, |(l, f)| l.len() + f.len());
        if agents > MAX_AGENTS {
            let message = format!("found {agents} agents with the leaders, allowed 1 to {MAX_AGENTS}");
            r.blame_key("world.followers", message);
        }
        let needed = between(1, agents.min(MAX_AGENTS)).because("the number of agents");

        let max_speed = r
            .key(
                "motion.max_speed",
                "units/s",
                "largest speed of any agent, and a leader's wanted speed at most",
                "3.1",
            )
            .number(between(LEAST, 1e3).or_zero(), 3.0);
        let slowest = between(LEAST, max_speed).or_zero().because("motion.max_speed");
        let before = r.problems.len();
        let min_speed = r
            .key("motion.min_speed", "units/s", "smallest speed of any agent: above 0, nobody can stop", "3.1")
            .number(slowest, 0.0);
        let least = if r.problems.len() > before { 0.0 } else { min_speed };
        let start_speed = between(least.max(LEAST), max_speed).because("motion.min_speed to motion.max_speed");
        let start_speed = if least == 0.0 { start_speed.or_zero() } else { start_speed };
        let attraction_radius = r
            .key(
                "follow.attraction_radius",
                "units",
                "within it a follower sees others: it is drawn to them, and counts the leaders among them for Df",
                "4.1, 4.2",
            )
            .number(between(0.01, LONGEST), 5.0);
        let closest = between(0.01, attraction_radius).because("follow.attraction_radius");
        let gain = between(1e-3, 1e3).or_zero();
        let population = r
            .key("learning.population", "policies", "k: policies of each learner, and teams of a generation", "4.3")
            .number(between(2, MAX_POPULATION), 50);

        let config = Config {
            world: World {
                map,
                coupling: r
                    .key(
                        "world.coupling",
                        "agents",
                        "C: how many must be at a POI at the same step for it to be observed; one number for all \
                         POIs, or one per POI",
                        "3.2, Eq. 2",
                    )
                    .coupling(needed, pois.as_ref().map(Vec::len)),
                leaders: leaders.unwrap_or_default(),
                followers: followers.unwrap_or_default(),
                pois: pois.unwrap_or_default(),
                observation_radius: r
                    .key("world.observation_radius", "units", "σ₀: an agent this near to a POI is at it", "3.2, Eq. 3")
                    .number(between(0.01, LONGEST), 5.0),
                steps: r
                    .key("world.steps", "steps", "T: length of an episode", "3.2, Eq. 2")
                    .number(between(1, MAX_STEPS), 25),
                dt: r.key("world.dt", "s", "time that a step takes", "").number(between(1e-4, 10.0), 0.2),
                heading: r
                    .key(
                        "world.heading",
                        "rad",
                        "every agent's heading at the start, from the x axis towards the y axis: π/2 faces the POIs",
                        "3.1, Fig. 3",
                    )
                    .number(between(-1e3, 1e3), FRAC_PI_2),
                speed: r
                    .key("world.speed", "units/s", "every agent's speed at the start", "3.1")
                    .number(start_speed, 0.0),
            },
            motion: Motion {
                min_speed,
                max_speed,
                max_acceleration: r
                    .key(
                        "motion.max_acceleration",
                        "units/s²",
                        "an agent's speed changes by at most this times dt",
                        "3.1",
                    )
                    .number(between(1e-3, 1e3).or_zero(), 5.0),
                max_turn_rate: r
                    .key("motion.max_turn_rate", "rad/s", "an agent's heading turns by at most this times dt", "3.1")
                    .number(between(1e-3, 1e3).or_zero(), FRAC_PI_2),
            },
            follow: Follow {
                attraction_radius,
                repulsion_radius: r
                    .key("follow.repulsion_radius", "units", "within it others, and walls, push a follower away", "4.1")
                    .number(closest, 1.0),
                attraction_gain: r
                    .key("follow.attraction_gain", "units/s", "pull of others at the attraction radius", "4.1, Fig. 2b")
                    .number(gain, 5.0),
                repulsion_gain: r
                    .key("follow.repulsion_gain", "units/s", "push of others at the repulsion radius", "4.1, Fig. 2b")
                    .number(gain, 1.0),
                wall_gain: r
                    .key("follow.wall_gain", "1/s", "push of a wall for each unit nearer than the repulsion radius", "")
                    .number(gain, 1.0),
            },
            sense: Sense {
                poi_range: r
                    .key("sense.poi_range", "units", "how far leaders sense POIs", "3.1")
                    .number(between(0.01, LONGEST).or_unlimited(), f64::INFINITY),
                agent_range: r
                    .key("sense.agent_range", "units", "how far leaders sense other agents", "3.1")
                    .number(between(0.01, LONGEST).or_unlimited(), 5.0),
                density: r
                    .key(
                        "sense.density",
                        "",
                        "what something at distance d adds to its quadrant's density: 1 − d/(√2·max(map)) if linear, \
                         1/max(d, 1) if inverse",
                        "3.1",
                    )
                    .choice(Density::Linear),
            },
            policy: Policy {
                hidden: r
                    .key(
                        "policy.hidden",
                        "units of a layer",
                        "hidden layers of a policy, between 8 inputs and 2 outputs",
                        "2.4, 3.1",
                    )
                    .numbers(0..=MAX_HIDDEN_LAYERS, between(1, MAX_HIDDEN_UNITS), vec![10]),
            },
            learning: Learning {
                paradigm: r
                    .key("learning.paradigm", "", "who learns: the leaders, or every agent", "4.1, 4.4")
                    .choice(Paradigm::LeaderFollower),
                fitness: r
                    .key(
                        "learning.fitness",
                        "",
                        "what policies are selected by: the team's score G, D without a leader, Df without a leader \
                         and its followers, or D++ with copies of a leader",
                        "3.2, Eq. 1; 4.2, Eq. 5; 2.2",
                    )
                    .choice(Fitness::Df),
                population,
                generations: r
                    .key("learning.generations", "generations", "how many follow the random start", "4.3, Alg. 1")
                    .number(between(0, MAX_GENERATIONS), 100),
                trials: r
                    .key("learning.trials", "trials", "independent repetitions", "5")
                    .number(between(1, MAX_TRIALS), 5),
                elites: r
                    .key(
                        "learning.elites",
                        "policies",
                        "n: the best of a population, which survive unchanged",
                        "4.3, Alg. 1",
                    )
                    .number(between(0, population).because("learning.population"), 1),
                mutation: r
                    .key(
                        "learning.mutation",
                        "",
                        "what a mutated weight w gains: w·N(0, σ) if scaled, N(0, σ) if additive",
                        "2.4, 4.3",
                    )
                    .choice(Mutation::Scaled),
                mutation_probability: r
                    .key("learning.mutation_probability", "", "of each weight of a new policy, to mutate", "2.4, 4.3")
                    .number(between(LEAST, 1.0).or_zero(), 0.15),
                mutation_sigma: r
                    .key("learning.mutation_sigma", "", "σ: standard deviation of a mutation", "2.4, 4.3")
                    .number(between(LEAST, 100.0).or_zero(), 0.1),
                episodes_per_team: r
                    .key("learning.episodes_per_team", "episodes", "over which a team's scores are averaged", "")
                    .number(between(1, MAX_EPISODES), 1),
                start_jitter: r
                    .key(
                        "learning.start_jitter",
                        "units",
                        "j: in every episode each agent's start is moved by a uniform offset in −j to j on both axes, \
                         the same for all teams of a generation",
                        "",
                    )
                    .number(between(LEAST, LONGEST).or_zero(), 0.0),
                seed: r
                    .key("learning.seed", "", "start of all randomness: config and seed decide every bit", "")
                    .number(between(0, i64::MAX as u64), 0),
            },
            checkpoint: Checkpoint {
                generations: r
                    .key(
                        "checkpoint.generations",
                        "generations",
                        "between checkpoints, which change no result; 0 is never",
                        "",
                    )
                    .number(between(0, MAX_GENERATIONS), 0),
                seconds: r
                    .key("checkpoint.seconds", "s", "between checkpoints, which change no result; 0 is never", "")
                    .number(between(0.01, 1e9).or_zero(), Checkpoint::default().seconds),
            },
        };
        if r.problems.is_empty() && config.policy_bytes() > MAX_POLICY_BYTES {
            let gib = |bytes: usize| bytes.div_ceil(1 << 30);
            let (bytes, most) = (gib(config.policy_bytes()), gib(MAX_POLICY_BYTES));
            let text = format!("found {population}, whose policies of all trials take {bytes} GiB, allowed {most} GiB");
            r.blame_key("learning.population", text);
        }
        config
    }
}

/// The syntax errors that no earlier one explains: a slip can break the rest of its line, a list left open the rest of
/// the file.
fn first_slips<'e>(text: &str, errors: &'e [toml::de::Error]) -> impl Iterator<Item = &'e toml::de::Error> {
    let left_open = errors.iter().any(|error| error.message().contains("unclosed array"));
    let in_list = |error: &toml::de::Error| left_open && error.message().contains("array");
    let end = errors.iter().position(in_list).map_or(errors.len(), |first| first + 1);
    let mut last = None;
    errors[..end].iter().filter(move |error| {
        let start = error.span().map_or(0, |span| span.start);
        let new_line = last.is_none_or(|last| text.get(last..start).is_some_and(|since| since.contains('\n')));
        last = if new_line { Some(start) } else { last };
        new_line
    })
}

/// Whether a config is to come from standard input, not from a file.
pub fn is_standard_input(path: &Path) -> bool {
    path == "-"
}

/// What errors call a config or sweep file.
pub fn name(path: &Path) -> String {
    if is_standard_input(path) { "standard input".into() } else { path.display().to_string() }
}

/// The text of a config or sweep file; of standard input, where that is what `-` means.
///
/// # Errors
/// No such file, not a file, larger than [`MAX_FILE_BYTES`], not UTF-8.
pub fn read_file(path: &Path) -> Result<String, ConfigError> {
    let fail = |reason: String| ConfigError::Unreadable { name: name(path), reason };
    let mut bytes = Vec::new();
    let file: Box<dyn Read> = if is_standard_input(path) {
        Box::new(std::io::stdin())
    } else if path.is_dir() {
        return Err(fail("it is a directory; name a config file in it".into()));
    } else {
        Box::new(file::open(path).map_err(|error| fail(error.to_string()))?)
    };
    file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes).map_err(|error| fail(error.to_string()))?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(fail(format!("it is larger than {MAX_FILE_BYTES} bytes, the most a config file may have")));
    }
    String::from_utf8(bytes).map_err(|error| {
        let line =
            error.as_bytes()[..error.utf8_error().valid_up_to()].iter().filter(|&&byte| byte == b'\n').count() + 1;
        fail(format!("line {line} is not UTF-8 text"))
    })
}

/// A key set from outside the config file.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    /// The dotted key: `learning.population`.
    pub key: String,
    /// What it is set to, as TOML.
    pub text: String,
    /// What errors call it: `--population`.
    pub name: String,
}

impl Override {
    /// Sets `key` to `value`; errors call it `name`.
    pub fn new(key: impl Into<String>, value: impl Into<toml::Value>, name: impl Into<String>) -> Override {
        Override { key: key.into(), text: value.into().to_string(), name: name.into() }
    }
}

/// Why there is no config.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    #[error("{name}: cannot be read: {reason}")]
    Unreadable { name: String, reason: String },
    /// All that is wrong, by line; what came from outside the file (see [`Override`]) last.
    #[error("{}", list(name, problems, *unlisted))]
    Invalid { name: String, problems: Vec<Problem>, unlisted: usize },
}

impl ConfigError {
    /// Whether nothing in the file is wrong, but flags given beside it are.
    pub fn is_usage(&self) -> bool {
        match self {
            ConfigError::Unreadable { .. } => false,
            ConfigError::Invalid { problems, .. } => problems.iter().all(|problem| problem.key.starts_with("--")),
        }
    }
}

/// One thing wrong with a config.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// The line in the file, from 1; none for an [`Override`].
    pub line: Option<usize>,
    /// The dotted key with any place in its list, `world.leaders[3][1]`, or the override's name; empty for broken TOML.
    pub key: String,
    /// What was found and what is allowed.
    pub message: String,
}

fn list(name: &str, problems: &[Problem], unlisted: usize) -> String {
    let lines = problems.iter().map(|Problem { line, key, message }| {
        let place = line.map_or(String::new(), |line| format!("{name}:{line}: "));
        let key = if key.is_empty() { String::new() } else { format!("{key}: ") };
        format!("{place}{key}{message}")
    });
    let mut lines: Vec<String> = lines.collect();
    if unlisted > 0 {
        lines.push(format!("… and {unlisted} more"));
    }
    if lines.len() > 1 {
        lines.insert(0, format!("{} problems in {name}", problems.len() + unlisted));
    }
    lines.join("\n")
}

/// The values a number may have.
#[derive(Clone, Copy, Debug)]
struct Allowed<T> {
    low: T,
    high: T,
    zero: bool,
    unlimited: bool,
    /// Where the bounds come from.
    because: &'static str,
}

fn between<T>(low: T, high: T) -> Allowed<T> {
    Allowed { low, high, zero: false, unlimited: false, because: "" }
}

impl<T: Number> Allowed<T> {
    /// Also 0, where the least other value is greater.
    fn or_zero(self) -> Self {
        Allowed { zero: true, ..self }
    }

    /// Also infinity.
    fn or_unlimited(self) -> Self {
        Allowed { unlimited: true, ..self }
    }

    fn because(self, because: &'static str) -> Self {
        Allowed { because, ..self }
    }

    fn holds(&self, value: T) -> bool {
        (self.low..=self.high).contains(&value)
            || self.zero && value == T::ZERO
            || self.unlimited && value.is_infinite()
    }

    /// The default, or the bound next to it where other keys leave no room for it.
    fn nearest(&self, default: T) -> T {
        match default {
            _ if self.holds(default) => default,
            _ if default < self.low => self.low,
            _ => self.high,
        }
    }
}

impl<T: Number> Allowed<T> {
    /// What is allowed in any config: a bound that other keys set goes by their names.
    fn in_general(&self) -> String {
        match self.because {
            "" => self.to_string(),
            both if both.contains(" to ") => both.into(),
            most => format!("{}{} to {most}", if self.zero { "0 or " } else { "" }, self.low),
        }
    }
}

impl<T: Number> Display for Allowed<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Allowed { low, high, .. } = self;
        match (self.zero, low.partial_cmp(high)) {
            (true, Some(std::cmp::Ordering::Less)) => write!(f, "0 or {low} to {high}")?,
            (true, _) => write!(f, "0")?,
            (false, Some(std::cmp::Ordering::Less)) => write!(f, "{low} to {high}")?,
            (false, _) => write!(f, "{high}")?,
        }
        if self.unlimited {
            write!(f, " or inf (unlimited)")?;
        }
        if !self.because.is_empty() {
            write!(f, " ({})", self.because)?;
        }
        Ok(())
    }
}

/// A type that keys have numbers of.
trait Number: Copy + PartialOrd + Display + Serialize {
    const ZERO: Self;
    const KIND: &'static str;

    /// The number that was written, `None` inside where the type cannot hold it, or `None` for another kind of value.
    fn read(value: &DeValue<'_>) -> Option<Option<Self>>;

    fn is_infinite(self) -> bool {
        false
    }
}

impl Number for f64 {
    const ZERO: f64 = 0.0;
    const KIND: &'static str = "a number";

    fn read(value: &DeValue<'_>) -> Option<Option<f64>> {
        match value {
            DeValue::Integer(_) => Some(i64::read(value)?.map(|integer| integer as f64)),
            DeValue::Float(float) => {
                let value: Option<f64> = float.as_str().parse().ok();
                let written = |value: &f64| value.is_finite() || float.as_str().contains("inf");
                // Adding 0 turns -0 into 0.
                Some(value.filter(written).map(|value| value + 0.0))
            }
            _ => None,
        }
    }

    fn is_infinite(self) -> bool {
        self == f64::INFINITY
    }
}

macro_rules! whole_number {
    ($($type:ty)*) => {$(
        impl Number for $type {
            const ZERO: $type = 0;
            const KIND: &'static str = "a whole number";

            fn read(value: &DeValue<'_>) -> Option<Option<$type>> {
                value.as_integer().map(|integer| <$type>::from_str_radix(integer.as_str(), integer.radix()).ok())
            }
        }
    )*};
}
whole_number!(i64 u64 usize);

/// Where a value was written, in the order in which problems are told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    /// This many bytes into the file.
    Offset(usize),
    Outside,
}

/// A value and what errors say of it.
struct Entry<'a> {
    value: Spanned<DeValue<'a>>,
    /// The text that the value's span counts in.
    text: &'a str,
    outside: bool,
    /// What the user calls it: the key, with any place in its list, or the override's name.
    name: String,
}

impl Entry<'_> {
    fn place(&self) -> Place {
        if self.outside { Place::Outside } else { Place::Offset(self.value.span().start) }
    }

    fn found(&self) -> String {
        match self.value.get_ref() {
            DeValue::Array(items) => format!("a list of {}", items.len()),
            DeValue::Table(_) => "a table".into(),
            _ => shorten(self.text.get(self.value.span()).unwrap_or_default()),
        }
    }
}

/// A text from the file, fit for one line of an error.
fn shorten(text: &str) -> String {
    let line = text.lines().next().unwrap_or_default();
    let end = line.char_indices().nth(40).map_or(line.len(), |(end, _)| end);
    let more = if end < text.len() { "…" } else { "" };
    line[..end].chars().map(|c| if c.is_control() { ' ' } else { c }).chain(more.chars()).collect()
}

/// The values of a file that were not asked for yet, and what is wrong with those that were.
#[derive(Default)]
struct Reader<'a> {
    /// By dotted key.
    entries: BTreeMap<String, Entry<'a>>,
    /// Values outside any section.
    strays: Vec<Entry<'a>>,
    /// Where each section starts.
    sections: BTreeMap<String, usize>,
    /// The keys asked for, with the place and name of those that were there.
    known: BTreeMap<&'static str, Option<(Place, String)>>,
    /// Place, name and message of each.
    problems: Vec<(Place, String, String)>,
    /// All there is to know of the keys asked for, where somebody wants to.
    table: Option<Vec<Key>>,
}

/// A key that is being asked for; what it allows and its default are yet to be said.
struct Asked<'r, 'a> {
    reader: &'r mut Reader<'a>,
    name: &'static str,
    unit: &'static str,
    meaning: &'static str,
    paper: &'static str,
}

impl<'a> Reader<'a> {
    fn fill(&mut self, document: DeTable<'a>, text: &'a str, foreign: &[&str], overrides: &'a [Override]) {
        for (section, value) in document {
            let start = section.span().start;
            let section = section.into_inner().into_owned();
            if foreign.contains(&section.as_str()) {
                continue;
            }
            let span = value.span();
            match value.into_inner() {
                DeValue::Table(table) => {
                    for (key, value) in table {
                        let name = format!("{section}.{}", key.into_inner());
                        self.entries.insert(name.clone(), Entry { value, text, outside: false, name });
                    }
                    self.sections.insert(section, start);
                }
                other => {
                    let value = Spanned::new(span, other);
                    self.strays.push(Entry { value, text, outside: false, name: section });
                }
            }
        }
        for Override { key, text, name } in overrides {
            let (value, errors) = DeValue::parse_recoverable(text);
            for error in errors {
                self.blame(Place::Outside, name, format!("found {}: {}", shorten(text), error.message().trim()));
            }
            self.entries.insert(key.clone(), Entry { value, text, outside: true, name: name.clone() });
        }
    }

    fn take(&mut self, key: &'static str) -> Option<Entry<'a>> {
        let entry = self.entries.remove(key);
        self.known.insert(key, entry.as_ref().map(|entry| (entry.place(), entry.name.clone())));
        entry
    }

    /// Asks for a key.
    fn key<'r>(
        &'r mut self,
        name: &'static str,
        unit: &'static str,
        meaning: &'static str,
        paper: &'static str,
    ) -> Asked<'r, 'a> {
        Asked { reader: self, name, unit, meaning, paper }
    }

    /// A number, or its default where there is none.
    fn number<T: Number>(&mut self, entry: Option<Entry<'_>>, allowed: Allowed<T>, default: T) -> T {
        entry.map_or_else(|| allowed.nearest(default), |entry| self.check(&entry, allowed))
    }

    fn check<T: Number>(&mut self, entry: &Entry<'_>, allowed: Allowed<T>) -> T {
        let kind = match T::read(entry.value.get_ref()) {
            Some(Some(value)) if allowed.holds(value) => return value,
            Some(_) => String::new(),
            None => format!("{}, ", T::KIND),
        };
        self.blame(entry.place(), &entry.name, format!("found {}, allowed {kind}{allowed}", entry.found()));
        allowed.high
    }

    /// The items of a list, or none of a list of another length or of another thing.
    fn items(&mut self, entry: Entry<'a>, lengths: RangeInclusive<usize>, what: &str) -> Option<Vec<Entry<'a>>> {
        let found = entry.found();
        let (place, Entry { value, text, outside, name }) = (entry.place(), entry);
        match value.into_inner() {
            DeValue::Array(items) if lengths.contains(&items.len()) => {
                let named = |(index, value)| Entry { value, text, outside, name: format!("{name}[{index}]") };
                Some(items.into_iter().enumerate().map(named).collect())
            }
            _ => {
                let lengths = between(*lengths.start(), *lengths.end());
                self.blame(place, &name, format!("found {found}, allowed a list of {lengths} {what}"));
                None
            }
        }
    }

    fn two(&mut self, entry: Entry<'a>, allowed: [Allowed<f64>; 2]) -> [f64; 2] {
        let most = allowed.map(|side| side.high);
        let Some(items) = self.items(entry, 2..=2, "numbers") else { return most };
        let mut values = most;
        for ((value, item), side) in values.iter_mut().zip(&items).zip(allowed) {
            *value = self.check(item, side);
        }
        values
    }

    fn numbers<T: Number>(&mut self, entry: Entry<'a>, counts: RangeInclusive<usize>, allowed: Allowed<T>) -> Vec<T> {
        let items = self.items(entry, counts, &format!("numbers, each {allowed}")).unwrap_or_default();
        items.iter().map(|item| self.check(item, allowed)).collect()
    }

    fn blame(&mut self, place: Place, name: &str, message: String) {
        self.problems.push((place, name.to_string(), message));
    }

    /// Blames a key that was asked for; where it is missing, at its section's start.
    fn blame_key(&mut self, key: &'static str, message: String) {
        let section = || self.sections.get(section(key)).copied().unwrap_or(0);
        let known = self.known.get(key).cloned().flatten();
        let (place, name) = known.unwrap_or_else(|| (Place::Offset(section()), key.to_string()));
        self.blame(place, &name, message);
    }

    /// Blames all that was not asked for.
    fn blame_unknown(&mut self) {
        let known: Vec<&str> = self.known.keys().copied().collect();
        let mut sections: Vec<&str> = known.iter().map(|key| section(key)).collect();
        sections.dedup();
        for entry in std::mem::take(&mut self.strays) {
            let name = &entry.name;
            let message = if sections.contains(&name.as_str()) {
                format!("found {}, allowed a section [{name}]", entry.found())
            } else {
                format!("unknown key{}", hint(name, &known))
            };
            self.blame(entry.place(), &shorten(name), message);
        }
        for (name, start) in std::mem::take(&mut self.sections) {
            if !sections.contains(&name.as_str()) {
                let message = format!("unknown section{}", hint(&name, &sections));
                self.blame(Place::Offset(start), &shorten(&name), message);
                self.entries.retain(|key, entry| entry.outside || section(key) != name);
            }
        }
        for (key, entry) in std::mem::take(&mut self.entries) {
            self.blame(entry.place(), &shorten(&entry.name), format!("unknown key{}", hint(&key, &known)));
        }
    }

    fn into_error(mut self, text: &str, name: &str) -> ConfigError {
        self.problems.sort_by_key(|problem| problem.0);
        let unlisted = self.problems.len().saturating_sub(MAX_LISTED);
        let problems = self.problems.into_iter().take(MAX_LISTED).map(|(place, key, message)| {
            let line = match place {
                Place::Offset(offset) => Some(text.bytes().take(offset).filter(|&byte| byte == b'\n').count() + 1),
                Place::Outside => None,
            };
            Problem { line, key, message }
        });
        ConfigError::Invalid { name: name.to_string(), problems: problems.collect(), unlisted }
    }
}

impl<'a> Asked<'_, 'a> {
    /// What was written in the config. Where somebody wants to know of the key, its kind, range and default are noted.
    fn take(&mut self, about: impl FnOnce() -> (String, String, Option<String>)) -> Option<Entry<'a>> {
        if let Some(table) = &mut self.reader.table {
            let Asked { name, unit, meaning, paper, .. } = *self;
            let (kind, range, default) = about();
            table.push(Key { name, unit, kind, range, default, meaning, paper });
        }
        self.reader.take(self.name)
    }

    /// A number, or its default where the key was left out.
    fn number<T: Number>(mut self, allowed: Allowed<T>, default: T) -> T {
        let entry = self.take(|| (kind::<T>().into(), allowed.in_general(), Some(written(&default))));
        self.reader.number(entry, allowed, default)
    }

    fn choice<T: Choice>(mut self, default: T) -> T {
        let words = || T::names().map(|word| format!("{word:?}")).collect::<Vec<_>>().join(" or ");
        let Some(entry) = self.take(|| ("word".into(), words(), Some(written(&default)))) else { return default };
        let word = entry.value.get_ref().as_str();
        T::ALL.iter().find(|choice| Some(choice.0) == word).map_or_else(
            || {
                let message = format!("found {}, allowed {}", entry.found(), words());
                self.reader.blame(entry.place(), &entry.name, message);
                default
            },
            |choice| choice.1,
        )
    }

    fn pair(mut self, allowed: Allowed<f64>, default: [f64; 2]) -> [f64; 2] {
        let about = || ("two numbers".into(), format!("each {}", allowed.in_general()), Some(written(&default)));
        let Some(entry) = self.take(about) else { return default };
        self.reader.two(entry, [allowed; 2])
    }

    /// Positions on the map.
    fn points(
        mut self,
        counts: RangeInclusive<usize>,
        map: [f64; 2],
        default: Option<Vec<[f64; 2]>>,
    ) -> Option<Vec<[f64; 2]>> {
        const WHAT: &str = "positions [x, y]";
        let (fewest, most) = (*counts.start(), *counts.end());
        let range = || format!("{} of them, on the map", between(fewest, most));
        let Some(entry) = self.take(|| (format!("list of {WHAT}"), range(), default.as_ref().map(written))) else {
            if default.is_none() {
                let message = format!("missing, allowed a list of {} {WHAT}", between(fewest, most));
                self.reader.blame_key(self.name, message);
            }
            return default;
        };
        let sides = map.map(|side| between(LEAST, side).or_zero().because("the map"));
        let items = self.reader.items(entry, counts, WHAT)?;
        Some(items.into_iter().map(|item| self.reader.two(item, sides)).collect())
    }

    fn numbers<T: Number>(mut self, counts: RangeInclusive<usize>, allowed: Allowed<T>, default: Vec<T>) -> Vec<T> {
        let range = || format!("{} of them, each {}", between(*counts.start(), *counts.end()), allowed.in_general());
        let about = || (format!("list of {}s", kind::<T>()), range(), Some(written(&default)));
        match self.take(about) {
            Some(entry) => self.reader.numbers(entry, counts, allowed),
            None => default,
        }
    }

    /// One number, or one for each of the POIs (whose count is none where it is unknown).
    fn coupling(mut self, allowed: Allowed<usize>, pois: Option<usize>) -> Coupling {
        const DEFAULT: usize = 3;
        let about = || ("whole number, or a list of them".into(), allowed.in_general(), Some(written(&DEFAULT)));
        match self.take(about) {
            Some(entry) if entry.value.get_ref().is_array() => {
                let counts = pois.map_or(0..=usize::MAX, |pois| pois..=pois);
                Coupling::Each(self.reader.numbers(entry, counts, allowed))
            }
            entry => Coupling::Same(self.reader.number(entry, allowed, DEFAULT)),
        }
    }
}

/// A kind of number without its article.
fn kind<T: Number>() -> &'static str {
    T::KIND.trim_start_matches("a ")
}

/// A value as TOML has it.
fn written<T: Serialize>(value: &T) -> String {
    toml::Value::try_from(value).expect("numbers, words and lists of them are TOML").to_string()
}

/// The section of a dotted key.
fn section(key: &str) -> &str {
    key.split_once('.').map_or(key, |(section, _)| section)
}

/// `, did you mean …?` with the known name nearest to an unknown one, or else what its section knows.
fn hint(name: &str, known: &[&str]) -> String {
    const LONGEST_NAME: usize = 64;
    let last = |key: &'_ str| key.rsplit('.').next().unwrap_or_default().to_lowercase();
    let leaf = last(name);
    let same_section = |key: &str| section(key) == section(name);
    let distance = |key: &str| (strsim::damerau_levenshtein(&last(key), &leaf), !same_section(key));
    let nearest = known.iter().filter(|_| name.len() <= LONGEST_NAME).min_by_key(|key| distance(key));
    if let Some(key) = nearest.filter(|key| distance(key).0 <= leaf.len() / 3) {
        return format!(", did you mean `{key}`?");
    }
    let siblings: Vec<String> = known.iter().filter(|key| same_section(key)).map(|key| last(key)).collect();
    match siblings.is_empty() {
        true => String::new(),
        false => format!("; [{}] has {}", section(name), siblings.join(", ")),
    }
}
