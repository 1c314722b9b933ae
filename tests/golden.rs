//! Golden digests of whole training runs: the same bits on any number of threads, by every instruction set, in one
//! batch or in many, and the same as when they were minted.
//!
//! `tests/golden.txt` says what each of its lines covers and when they may be minted anew.

#[cfg(feature = "gpu")]
mod support;

use std::fmt::Write;
use std::sync::LazyLock;

use flotilla::backend::cpu::{Cpu, level_name};
#[cfg(feature = "gpu")]
use flotilla::backend::gpu::{self, episode::GpuBackend};
use flotilla::backend::{Backend, BackendError, Group, GroupScores, Trace};
use flotilla::config::{Config, Override, ValidConfig};
use flotilla::trainer::{Row, Trainer};
use flotilla::world::World;
use sha2::{Digest, Sha256};

const GENERALLY_FORWARD: &str = include_str!("../configs/generally_forward.toml");
const STRICTLY_FORWARD: &str = include_str!("../configs/strictly_forward.toml");
const CHAOTIC: &str = include_str!("../configs/chaotic.toml");
/// Ten groups of a leader and three followers: a set of agents takes two words.
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

/// Name, what is covered, the config and what of it is changed.
type Case = (&'static str, &'static str, &'static str, &'static [(&'static str, &'static str)]);

/// Together these cases cover every choice that a config has, and sizes on both sides of every special case.
const CASES: [Case; 33] = [
    ("generally-forward", "first layout, leader-follower, Df", GENERALLY_FORWARD, &[]),
    ("strictly-forward", "second layout, D++", STRICTLY_FORWARD, &[("learning.fitness", "'D++'")]),
    ("chaotic", "third layout, G", CHAOTIC, &[("learning.fitness", "'G'")]),
    (
        "all-leaders",
        "all-leaders, D, two agents at a POI",
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
        "three episodes a team from jittered starts, D",
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
        "inverse density, POIs sensed only when near",
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
        "a coupling for each POI, a seed above 32 bits",
        CHAOTIC,
        &[("world.coupling", "[1, 2, 5, 7]"), ("learning.seed", "81985529216486895")],
    ),
    ("forty-agents", "40 agents, two words a set, six POIs", FORTY_AGENTS, &[]),
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
        "POIs that can be observed at some steps, D",
        CHAOTIC,
        &[("world.windows", "[[1, 20], [16, 24], [30, 50], [21, 21]]"), ("learning.fitness", "'D'")],
    ),
    (
        "after",
        "POIs one after the other, Df, two words a set",
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
        "two episodes a team with POIs elsewhere",
        GENERALLY_FORWARD,
        &[("learning.poi_jitter", "3.0"), ("learning.episodes_per_team", "2"), ("learning.population", "13")],
    ),
    (
        "stages",
        "coupling 1, from generation 3 on 3 with moved starts, from generation 6 on all of a team's speed",
        GENERALLY_FORWARD,
        &[(
            "stages",
            "[{from = 0, set = {'world.coupling' = 1}}, {from = 3, set = {'learning.start_jitter' = 0.5}}, \
             {from = 6, set = {'motion.max_speed' = 10.0}}]",
        )],
    ),
    ("led-step-by-step", "Dt, led by whom it saw most so far", CHAOTIC, &[("learning.fitness", "'Dt'")]),
    (
        "relay",
        "Dt, led by any of the last 3 steps, only followers observe, one POI after the other",
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
        "the mean of three teams a policy, D",
        GENERALLY_FORWARD,
        &[("learning.partners", "3"), ("learning.fitness", "'D'"), ("world.coupling", "2")],
    ),
    (
        "lenient",
        "the best of two teams a policy, all-leaders, two episodes from jittered starts",
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
        "two teams a policy and one with the champions of a generation out of the last three, all-leaders, Df",
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
        "inputs of the inverse density times 8, three agents at a POI, all-leaders, D++",
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
        "evolution strategy of OpenAI, an odd population",
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
        "evolution strategy of OpenAI, all leaders share a policy, more of the gradient from generation 4 on",
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
    /// Bytes hashed and their SHA-256, as `flotilla train` tells it.
    pub bytes: usize,
    pub sha256: String,
    /// SHA-256 of every stage of every step of the last policies: one flipped bit need not change what is selected.
    pub episodes: String,
}

/// Trains all configs side by side: what each came to, and the most that a team of it observed.
pub fn train(configs: &[Config], backend: &mut dyn Backend) -> Vec<(Golden, f64)> {
    let mut trainer = Trainer::new(ValidConfig::all(configs).unwrap());
    let mut texts = vec![String::from("trial,generation,best_g,mean_g,champion_g\n"); configs.len()];
    let mut most = vec![0f64; configs.len()];
    for row in trainer.finish(backend).unwrap() {
        most[row.experiment] = most[row.experiment].max(row.best_g);
        let Row { experiment: arm, trial, generation, best_g, mean_g, champion_g } = row;
        writeln!(texts[arm], "{trial},{generation},{best_g},{mean_g},{champion_g}").unwrap();
    }
    let golden = |(arm, text): (usize, &String)| {
        let mut hash = Sha256::new_with_prefix(text);
        let policies = trainer.policies(arm).concat();
        hash.update(bytemuck::cast_slice::<f32, u8>(&policies));
        let golden = Golden {
            bytes: text.len() + size_of_val(&policies[..]),
            sha256: hex(&hash.finalize()),
            episodes: trace(backend, &configs[arm], trainer.world(arm), &trainer.policies(arm)[0]),
        };
        (golden, most[arm])
    };
    texts.iter().enumerate().map(golden).collect()
}

/// Plays a trial's policies, team j of the policies with index j, and hashes every float without the sign of a zero.
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

/// The recorded runs. `FLOTILLA_MINT=1` records them anew.
static GOLDEN: LazyLock<Vec<Golden>> = LazyLock::new(|| {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden.txt");
    // Not read from disk, where there is none.
    let mut text = String::from(include_str!("golden.txt"));
    if std::env::var("FLOTILLA_MINT").as_deref() == Ok("1") {
        text = HEADER.into();
        let minted = train(&CONFIGS, &mut Cpu::default());
        for ((name, what, ..), (Golden { bytes, sha256, episodes }, _)) in CASES.iter().zip(minted) {
            writeln!(text, "{name:<20} {bytes:>6} {sha256} {episodes}  {what}").unwrap();
        }
        std::fs::write(path, &text).unwrap();
    }
    let lines: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).collect();
    assert_eq!(lines.len(), CASES.len(), "{path} has a line a case");
    let golden = |((name, ..), line): (&Case, &&str)| {
        let mut words = line.split_whitespace();
        assert_eq!(words.next(), Some(*name), "{path}: {line}");
        let mut word = || words.next().unwrap_or_else(|| panic!("{path}: {line}"));
        Golden { bytes: word().parse().unwrap(), sha256: word().into(), episodes: word().into() }
    };
    CASES.iter().zip(&lines).map(golden).collect()
});

const HEADER: &str = "\
# Digests of whole training runs, one a line: name, bytes hashed, SHA-256 of the run, SHA-256 of its last episodes, what
# the line covers.
#
# Each is a layout of the paper, or one of tests/golden.rs, with 2 trials of 8 generations of 20 policies, changed as
# that file says. Of the run, the rows of metrics.csv without the seconds and then the policies are hashed: the digest
# that `flotilla train` prints. Of the episodes, every stage of every step that the first trial's last policies play.
#
# These are promises to whoever has runs of earlier versions. Where results have to change, say why in the changelog and
# mint them anew: FLOTILLA_MINT=1 cargo test --test golden
";

pub fn check(what: &str, backend: &mut dyn Backend) {
    for (((name, ..), golden), (found, most)) in CASES.iter().zip(&*GOLDEN).zip(train(&CONFIGS, backend)) {
        assert!(most > 0.0, "{name}: nothing was observed, so selection had nothing to go by");
        assert_eq!(found, *golden, "{name}, {what}");
    }
}

#[cfg(feature = "parallel")]
fn on_threads(count: usize, work: impl FnOnce() + Send) {
    rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap().install(work);
}

#[cfg(feature = "parallel")]
#[test]
fn any_number_of_threads() {
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
fn every_adapter() {
    for (request, info) in support::adapters("every_adapter") {
        check(&info.to_string(), &mut GpuBackend::new(gpu::open(request).unwrap()).unwrap());
    }
}

/// Plays so many teams at a time: each group, and each group's teams, in rollouts of their own.
struct Few {
    teams: usize,
    backend: Cpu,
}

impl Backend for Few {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        let mut all = vec![GroupScores::default(); groups.len()];
        for (group, all) in groups.iter().zip(&mut all) {
            for teams in group.teams.chunks(self.teams * group.world.leaders()) {
                let few = self.backend.play(&[Group { teams, ..*group }])?.remove(0);
                all.observed.extend(few.observed);
                all.scores.extend(few.scores);
            }
        }
        Ok(all)
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        self.backend.trace(group)
    }

    fn describe(&self) -> String {
        format!("{}, {} teams at a time", self.backend.describe(), self.teams)
    }
}

#[test]
fn one_batch_or_many() {
    for teams in [1, 5, 16] {
        let mut backend = Few { teams, backend: Cpu::default() };
        check(&backend.describe(), &mut backend);
    }
}

/// Alone and from the command line, a case ends as it does here, side by side with all others.
#[cfg(feature = "cli")]
#[test]
fn the_program_tells_the_same_digest() {
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
