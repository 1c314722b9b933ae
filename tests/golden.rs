//! Compares whole training runs with recorded digests ("golden digests").
//!
//! The digests have to be the same on any number of threads, every instruction set and every GPU, and in batches of any
//! size. `tests/golden.txt` describes each digest, and says when it may be recorded again.

#[cfg(feature = "gpu")]
mod support;

use std::fmt::Write;
use std::sync::LazyLock;

use flotilla::backend::cpu::{Cpu, level_name};
#[cfg(feature = "gpu")]
use flotilla::backend::gpu::{self, episode::GpuBackend};
use flotilla::backend::{Backend, BackendError, Group, GroupScores, Trace};
use flotilla::config::{self, Config, Override, ValidConfig};
use flotilla::trainer::{Row, Trainer};
use flotilla::world::World;
use sha2::{Digest, Sha256};

const GENERALLY_FORWARD: &str = include_str!("../configs/generally_forward.toml");
const STRICTLY_FORWARD: &str = include_str!("../configs/strictly_forward.toml");
const CHAOTIC: &str = include_str!("../configs/chaotic.toml");
/// Ten groups of one leader and three followers. A set of 40 agents needs two words.
const FORTY_AGENTS: &str = "
[world]
leaders = [[5, 5], [15, 5], [25, 5], [35, 5], [45, 5], [5, 40], [15, 40], [25, 40], [35, 40], [45, 40]]
followers = [
    [7, 2], [3, 2], [5, 8], [17, 2], [13, 2], [15, 8], [27, 2], [23, 2], [25, 8], [37, 2], [33, 2], [35, 8],
    [47, 2], [43, 2], [45, 8], [7, 37], [3, 37], [5, 43], [17, 37], [13, 37], [15, 43], [27, 37], [23, 37], [25, 43],
    [37, 37], [33, 37], [35, 43], [47, 37], [43, 37], [45, 43],
]
pois = [[5, 12], [20, 12], [45, 12], [10, 47], [30, 47], [48, 30]]
coupling = 4
";

/// Name, description, config, and the keys that are changed.
type Case = (&'static str, &'static str, &'static str, &'static [(&'static str, &'static str)]);

/// Together these cases cover every choice in a config, and sizes on both sides of every special case.
const CASES: [Case; 33] = [
    ("generally-forward", "first layout, leader-follower, Df", GENERALLY_FORWARD, &[]),
    ("strictly-forward", "second layout, D++", STRICTLY_FORWARD, &[("learning.fitness", "'D++'")]),
    ("chaotic", "third layout, G", CHAOTIC, &[("learning.fitness", "'G'")]),
    (
        "all-leaders",
        "all-leaders, D, coupling 2",
        GENERALLY_FORWARD,
        &[("learning.paradigm", "'all-leaders'"), ("learning.fitness", "'D'"), ("world.coupling", "2")],
    ),
    (
        "all-leaders-chaotic",
        "20 leaders, D++",
        CHAOTIC,
        &[("learning.paradigm", "'all-leaders'"), ("learning.fitness", "'D++'")],
    ),
    (
        "jittered",
        "three episodes per team from jittered starts, D",
        GENERALLY_FORWARD,
        &[
            ("learning.start_jitter", "0.75"),
            ("learning.episodes_per_team", "3"),
            ("learning.population", "13"),
            ("learning.fitness", "'D'"),
        ],
    ),
    (
        "additive",
        "additive mutation of every weight, no elites",
        STRICTLY_FORWARD,
        &[
            ("learning.mutation", "'additive'"),
            ("learning.mutation_probability", "1.0"),
            ("learning.mutation_sigma", "0.3"),
            ("learning.elites", "0"),
        ],
    ),
    (
        "inverse",
        "inverse density, POIs sensed up to a distance of 12",
        GENERALLY_FORWARD,
        &[("sense.density", "'inverse'"), ("sense.poi_range", "12.0")],
    ),
    ("unlimited", "agents sensed at any distance", CHAOTIC, &[("sense.agent_range", "inf")]),
    (
        "two-hidden",
        "two hidden layers, three elites",
        GENERALLY_FORWARD,
        &[("policy.hidden", "[16, 7]"), ("learning.elites", "3")],
    ),
    ("no-hidden", "no hidden layer", GENERALLY_FORWARD, &[("policy.hidden", "[]")]),
    (
        "each-coupling",
        "one coupling per POI, a seed above 32 bits",
        CHAOTIC,
        &[("world.coupling", "[1, 2, 5, 7]"), ("learning.seed", "81985529216486895")],
    ),
    ("forty-agents", "40 agents, two words per set, six POIs", FORTY_AGENTS, &[]),
    (
        "followers-observe",
        "only followers observe, Df",
        GENERALLY_FORWARD,
        &[("world.observers", "'followers'"), ("world.coupling", "2")],
    ),
    (
        "leaders-observe",
        "only leaders observe, D++",
        GENERALLY_FORWARD,
        &[("world.observers", "'leaders'"), ("world.coupling", "1"), ("learning.fitness", "'D++'")],
    ),
    (
        "windows",
        "POIs that can be observed only in windows of steps, D",
        CHAOTIC,
        &[("world.windows", "[[1, 20], [16, 24], [30, 50], [21, 21]]"), ("learning.fitness", "'D'")],
    ),
    (
        "after",
        "POIs that have to be observed in order, Df, two words per set",
        FORTY_AGENTS,
        &[("world.after", "[[], [0], [1], [0], [3], [3]]"), ("world.coupling", "3")],
    ),
    (
        "behaviours",
        "policies choose behaviours, G",
        GENERALLY_FORWARD,
        &[("policy.actions", "'behaviours'"), ("learning.fitness", "'G'")],
    ),
    (
        "behaviours-of-all",
        "20 leaders choose behaviours, no hidden layer",
        CHAOTIC,
        &[("policy.actions", "'behaviours'"), ("policy.hidden", "[]"), ("learning.paradigm", "'all-leaders'")],
    ),
    (
        "shared",
        "all leaders share a policy, D of two episodes",
        GENERALLY_FORWARD,
        &[
            ("learning.sharing", "'all'"),
            ("learning.fitness", "'D'"),
            ("learning.start_jitter", "0.5"),
            ("learning.episodes_per_team", "2"),
        ],
    ),
    (
        "shared-by-all",
        "twelve leaders share a policy that chooses behaviours",
        GENERALLY_FORWARD,
        &[("learning.sharing", "'all'"), ("learning.paradigm", "'all-leaders'"), ("policy.actions", "'behaviours'")],
    ),
    (
        "moved-pois",
        "two episodes per team with moved POIs",
        GENERALLY_FORWARD,
        &[("learning.poi_jitter", "3.0"), ("learning.episodes_per_team", "2"), ("learning.population", "13")],
    ),
    (
        "stages",
        "coupling 1, from generation 3 on coupling 3 and jittered starts, from generation 6 on a larger speed",
        GENERALLY_FORWARD,
        &[(
            "stages",
            "[{from = 0, set = {'world.coupling' = 1}}, {from = 3, set = {'learning.start_jitter' = 0.5}}, \
             {from = 6, set = {'motion.max_speed' = 10.0}}]",
        )],
    ),
    (
        "led-step-by-step",
        "Dt, followers led by the leader that they saw most so far",
        CHAOTIC,
        &[("learning.fitness", "'Dt'")],
    ),
    (
        "relay",
        "Dt, followers led by all leaders seen in the last 3 steps, only followers observe, order and windows",
        CHAOTIC,
        &[
            ("learning.fitness", "'Dt'"),
            ("learning.led_within", "3"),
            ("learning.led_by", "'any-seen'"),
            ("world.observers", "'followers'"),
            ("world.coupling", "2"),
            ("world.after", "[[], [0], [1], []]"),
            ("world.windows", "[[1, 50], [20, 50], [25, 50], [10, 30]]"),
        ],
    ),
    (
        "truncation",
        "a fifth of each population are elites, and only they become parents",
        GENERALLY_FORWARD,
        &[("learning.elites", "'20%'"), ("learning.parents", "'elites'"), ("world.coupling", "2")],
    ),
    (
        "partners",
        "the mean of three teams per policy, D",
        GENERALLY_FORWARD,
        &[("learning.partners", "3"), ("learning.fitness", "'D'"), ("world.coupling", "2")],
    ),
    (
        "lenient",
        "the best of two teams per policy, all-leaders, two episodes from jittered starts",
        CHAOTIC,
        &[
            ("learning.partners", "2"),
            ("learning.leniency", "'max'"),
            ("learning.paradigm", "'all-leaders'"),
            ("learning.start_jitter", "0.5"),
            ("learning.episodes_per_team", "2"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "hall-of-fame",
        "two teams per policy and one with champions of one of the last three generations, all-leaders, Df",
        CHAOTIC,
        &[
            ("learning.hall_of_fame", "3"),
            ("learning.partners", "2"),
            ("learning.paradigm", "'all-leaders'"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "sense-gain",
        "inverse density with a gain of 8, coupling 3, all-leaders, D++",
        CHAOTIC,
        &[
            ("sense.density", "'inverse'"),
            ("sense.gain", "8.0"),
            ("world.coupling", "3"),
            ("learning.paradigm", "'all-leaders'"),
            ("learning.fitness", "'D++'"),
        ],
    ),
    (
        "openai-es",
        "OpenAI's evolution strategy, an odd population",
        GENERALLY_FORWARD,
        &[
            ("learning.method", "'openai-es'"),
            ("learning.search_step", "0.3"),
            ("learning.population", "21"),
            ("world.coupling", "2"),
        ],
    ),
    (
        "snes",
        "separable natural evolution strategies, D++, two partners",
        CHAOTIC,
        &[
            ("learning.method", "'snes'"),
            ("learning.search_sigma", "0.5"),
            ("learning.partners", "2"),
            ("learning.fitness", "'D++'"),
            ("world.coupling", "3"),
        ],
    ),
    (
        "shared-openai-es",
        "OpenAI's evolution strategy, all leaders share a policy, larger steps from generation 4 on",
        GENERALLY_FORWARD,
        &[
            ("learning.method", "'openai-es'"),
            ("learning.search_step", "0.3"),
            ("learning.sharing", "'all'"),
            ("learning.fitness", "'G'"),
            ("world.coupling", "2"),
            ("stages", "[{from = 4, set = {'learning.search_step' = 1.5}}]"),
        ],
    ),
];

static CONFIGS: LazyLock<Vec<Config>> = LazyLock::new(|| {
    let small = [("learning.trials", "2"), ("learning.generations", "8"), ("learning.population", "20")];
    let config = |(name, _, text, changes): Case| {
        let change = |&(key, text): &(&str, &str)| Override { key: key.into(), text: text.into(), name: key.into() };
        let small: Vec<Override> = small.iter().map(change).collect();
        let changes: Vec<Override> = changes.iter().map(change).collect();
        let config = Config::parse(text, name).and_then(|config| config.with(&small)?.with(&changes));
        config.unwrap_or_else(|error| panic!("{name}: {error}"))
    };
    CASES.map(config).into()
});

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The result of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Golden {
    /// The number of bytes hashed, and their SHA-256 as `flotilla train` prints it.
    pub bytes: usize,
    pub sha256: String,
    /// SHA-256 of every stage of every step that the last policies play. It detects a changed bit even if this bit does
    /// not change the selection.
    pub episodes: String,
}

/// Trains all configs side by side. Returns the digests and the largest G for each.
pub fn train(configs: &[Config], backend: &mut dyn Backend) -> Vec<(Golden, f64)> {
    let mut trainer = Trainer::new(ValidConfig::all(configs).unwrap());
    let mut texts = vec![String::from("trial,generation,best_g,mean_g,champion_g\n"); configs.len()];
    let mut largest_g = vec![0f64; configs.len()];
    for row in trainer.finish(backend).unwrap() {
        largest_g[row.experiment] = largest_g[row.experiment].max(row.best_g);
        let Row { experiment, trial, generation, best_g, mean_g, champion_g } = row;
        writeln!(texts[experiment], "{trial},{generation},{best_g},{mean_g},{champion_g}").unwrap();
    }
    let golden = |(experiment, text): (usize, &String)| {
        let mut hash = Sha256::new_with_prefix(text);
        let policies = trainer.policies(experiment).concat();
        hash.update(bytemuck::cast_slice::<f32, u8>(&policies));
        let golden = Golden {
            bytes: text.len() + size_of_val(&policies[..]),
            sha256: hex(&hash.finalize()),
            episodes: trace(backend, &configs[experiment], trainer.world(experiment), &trainer.policies(experiment)[0]),
        };
        (golden, largest_g[experiment])
    };
    texts.iter().enumerate().map(golden).collect()
}

/// Plays the policies of a trial and hashes every float. Team j has the policies with index j. Zeros lose their sign.
fn trace(backend: &mut dyn Backend, config: &Config, world: &World, weights: &[f32]) -> String {
    let policies = config.learning.population;
    let teams: Vec<u32> = (0..policies * world.leaders()).map(|place| (place / world.leaders()) as u32).collect();
    let group = Group {
        world,
        starts: &world.starts,
        weights: weights.into(),
        policies,
        sharing: config.learning.sharing,
        teams: &teams,
        fitnesses: &[],
    };
    let trace = backend.trace(&group).unwrap();
    let floats: Vec<f32> = bytemuck::cast_slice(&trace.moments).iter().map(|float: &f32| float + 0.0).collect();
    hex(&Sha256::digest(bytemuck::cast_slice::<f32, u8>(&floats)))
}

/// The recorded digests. `FLOTILLA_MINT=1` records them again.
static GOLDEN: LazyLock<Vec<Golden>> = LazyLock::new(|| {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden.txt");
    // Part of the program, because WebAssembly has no file system.
    let mut text = String::from(include_str!("golden.txt"));
    if std::env::var("FLOTILLA_MINT").as_deref() == Ok("1") {
        text = HEADER.into();
        let minted = train(&CONFIGS, &mut Cpu::default());
        for ((name, description, ..), (Golden { bytes, sha256, episodes }, _)) in CASES.iter().zip(minted) {
            writeln!(text, "{name:<20} {bytes:>6} {sha256} {episodes}  {description}").unwrap();
        }
        std::fs::write(path, &text).unwrap();
    }
    let lines: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).collect();
    assert_eq!(lines.len(), CASES.len(), "{path} needs one line per case");
    let golden = |((name, ..), line): (&Case, &&str)| {
        let mut words = line.split_whitespace();
        assert_eq!(words.next(), Some(*name), "{path}: {line}");
        let mut word = || words.next().unwrap_or_else(|| panic!("{path}: {line}"));
        Golden { bytes: word().parse().unwrap(), sha256: word().into(), episodes: word().into() }
    };
    CASES.iter().zip(&lines).map(golden).collect()
});

const HEADER: &str = "\
# Digests of whole training runs, one per line: name, bytes hashed, SHA-256 of the run, SHA-256 of its last episodes,
# description.
#
# Each config is a layout of the paper, or of tests/golden.rs, with 2 trials of 8 generations of 20 policies and the
# changes in that file. The first SHA-256 is the digest that `flotilla train` prints: of the rows of metrics.csv without
# seconds, then of the policies. The second is of every stage of every step that the last policies of trial 0 play.
#
# Users with runs of earlier versions rely on these digests. If results have to change, give the reason in the changelog
# and record the digests again: FLOTILLA_MINT=1 cargo test --test golden
";

#[test]
fn the_cases_have_every_word_of_every_key() {
    let tables: Vec<toml::Table> = CONFIGS.iter().map(|config| config.to_toml().parse().unwrap()).collect();
    let keys = config::keys().into_iter().filter(|key| key.kind == "word");
    let mut words = 0;
    for key in keys {
        let (section, name) = key.name.split_once('.').unwrap();
        for word in key.range.split(" or ").map(|word| word.trim_matches('"')) {
            let has_word = |table: &toml::Table| table[section][name].as_str() == Some(word);
            assert!(tables.iter().any(has_word), "no case has {} = '{word}'", key.name);
            words += 1;
        }
    }
    assert!(words > 20, "only {words} words were found in the table of keys");
}

/// Trains all cases and compares them with the recorded digests.
pub fn check(machine: &str, backend: &mut dyn Backend) {
    for (((name, ..), golden), (found, largest_g)) in CASES.iter().zip(&*GOLDEN).zip(train(&CONFIGS, backend)) {
        assert!(largest_g > 0.0, "{name}: no team observed a POI, so selection is not tested");
        assert_eq!(found, *golden, "{name}, {machine}");
    }
}

#[cfg(feature = "parallel")]
fn on_threads(count: usize, work: impl FnOnce() + Send) {
    rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap().install(work);
}

#[cfg(feature = "parallel")]
#[test]
fn digests_are_the_same_on_any_number_of_threads() {
    for count in [1, 2, 8] {
        on_threads(count, || check(&format!("{count} threads"), &mut Cpu::default()));
    }
}

#[test]
fn every_instruction_set() {
    for level in Cpu::levels() {
        check(level_name(level), &mut Cpu::at_level(level));
    }
}

#[cfg(feature = "gpu")]
#[test]
fn digests_are_the_same_on_every_adapter() {
    for (request, info) in support::adapters("digests_are_the_same_on_every_adapter") {
        check(&info.to_string(), &mut GpuBackend::new(gpu::open(request).unwrap()).unwrap());
    }
}

/// Plays at most `teams` teams per rollout.
struct SmallBatches {
    teams: usize,
    backend: Cpu,
}

impl Backend for SmallBatches {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        let mut scores = vec![GroupScores::default(); groups.len()];
        for (group, scores) in groups.iter().zip(&mut scores) {
            for teams in group.teams.chunks(self.teams * group.world.leaders()) {
                let batch = self.backend.play(&[Group { teams, ..*group }])?.remove(0);
                scores.observed.extend(batch.observed);
                scores.scores.extend(batch.scores);
            }
        }
        Ok(scores)
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        self.backend.trace(group)
    }

    fn describe(&self) -> String {
        format!("{}, {} teams at a time", self.backend.describe(), self.teams)
    }
}

#[test]
fn digests_are_the_same_in_small_batches() {
    for teams in [1, 5, 16] {
        let mut backend = SmallBatches { teams, backend: Cpu::default() };
        check(&backend.describe(), &mut backend);
    }
}

/// The program trains each case alone, not side by side with the others.
#[cfg(feature = "cli")]
#[test]
fn train_records_the_same_digest() {
    let folder = tempfile::tempdir().unwrap();
    for (index, (name, ..)) in CASES.iter().enumerate() {
        let file = folder.path().join(format!("{name}.toml"));
        std::fs::write(&file, CONFIGS[index].to_toml()).unwrap();
        let out = folder.path().join(name);
        let mut command = assert_cmd::cargo::cargo_bin_cmd!("flotilla");
        command.args(["train", "--quiet", "--backend", "cpu", "--out"]).arg(&out).arg(&file).assert().success();
        let run = std::fs::read_to_string(out.join("run.json")).unwrap();
        let run: serde_json::Value = serde_json::from_str(&run).unwrap();
        assert_eq!(run["digest"], GOLDEN[index].sha256, "{name}");
    }
}
