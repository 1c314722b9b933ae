//! Compares whole training runs with recorded digests ("golden digests").
//!
//! The digests have to be the same on any number of threads, every instruction set and every GPU, and in batches of any
//! size. `tests/golden.txt` describes each digest, and says when it may be recorded again.

#[cfg(feature = "gpu")]
use crate::support;
use std::fmt::Write;
use std::sync::LazyLock;

use flotilla::backend::cpu::{Cpu, level_name};
#[cfg(feature = "gpu")]
use flotilla::backend::gpu::{self, episode::GpuBackend};
use flotilla::backend::{Backend, BackendError, Group, GroupScores, Trace};
use flotilla::config::{self, Config, ValidConfig};
use flotilla::trainer::{Row, Trainer};
use flotilla::world::World;
use sha2::{Digest, Sha256};

#[path = "golden/cases.rs"]
pub mod cases;

use cases::{CASES, CONFIGS, Case};

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
    let header = |config: &Config| {
        let test_g = if config.learning.test_episodes > 0 { ",test_g" } else { "" };
        format!("trial,generation,best_g,mean_g,champion_g{test_g}\n")
    };
    let mut texts: Vec<String> = configs.iter().map(header).collect();
    let mut largest_g = vec![0f64; configs.len()];
    for row in trainer.finish(backend).unwrap() {
        largest_g[row.experiment] = largest_g[row.experiment].max(row.best_g);
        let Row { experiment, trial, generation, best_g, mean_g, champion_g, test_g } = row;
        let test_g = test_g.map_or(String::new(), |test_g| format!(",{test_g}"));
        writeln!(texts[experiment], "{trial},{generation},{best_g},{mean_g},{champion_g}{test_g}").unwrap();
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
    let trace = backend.trace(&Group::new(world, weights, policies, &teams)).unwrap();
    // Each agent's inputs, zeros if it follows, and its moment.
    let mut floats: Vec<f32> = vec![];
    for (index, moment) in trace.moments.iter().enumerate() {
        let (row, agent) = (index / trace.agents, index % trace.agents);
        let leads = agent < trace.leaders;
        let inputs = trace.inputs_of(row / trace.teams, row % trace.teams, if leads { agent } else { 0 });
        floats.extend(inputs.iter().map(|input| if leads { input + 0.0 } else { 0.0 }));
        floats.extend(bytemuck::cast_slice(std::slice::from_ref(moment)).iter().map(|float: &f32| float + 0.0));
    }
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
# Each config is a layout of the paper, of configs/influence or of tests/golden.rs, with 2 trials of 8 generations of 20 policies and the
# changes in that file. The first SHA-256 is the digest that `flotilla train` prints: of the rows of metrics.csv without
# seconds, then of the policies. The second is of every stage of every step that the last policies of trial 0 play.
#
# Users with runs of earlier versions rely on these digests. If results have to change, give the reason in the changelog
# and record the digests again: FLOTILLA_MINT=1 cargo test golden::
";

#[test]
fn the_cases_have_every_word_of_every_key() {
    let tables: Vec<toml::Table> = CONFIGS.iter().map(|config| config.to_toml().parse().unwrap()).collect();
    let keys = config::keys().into_iter().filter(|key| key.kind == "word");
    let mut words = 0;
    for key in keys {
        let (section, name) = key.name.split_once('.').unwrap();
        for word in key.range.split(" or ").map(|word| word.trim_matches('"')) {
            let has_word =
                |table: &toml::Table| table.get(section).and_then(|keys| keys.get(name)?.as_str()) == Some(word);
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

fn on_threads(count: usize, work: impl FnOnce() + Send) {
    rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap().install(work);
}

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

/// Returns the configs of the repository for a few generations of small populations, each with its long form.
#[cfg(not(target_family = "wasm"))]
fn both_forms() -> Vec<(String, [Config; 2])> {
    let mut paths = vec![];
    // The package in `tests/ports` runs this file in its own folder.
    let root = if std::fs::exists("configs").unwrap() { "." } else { "../.." };
    for folder in ["configs", "configs/tasks", "configs/influence"] {
        let files = std::fs::read_dir(format!("{root}/{folder}")).unwrap().map(|entry| entry.unwrap().path());
        paths.extend(files.filter(|path| path.extension().is_some_and(|extension| extension == "toml")));
    }
    let small = |path: std::path::PathBuf| {
        let mut config = Config::load(&path).unwrap();
        let learning = &mut config.learning;
        (learning.trials, learning.generations, learning.population) = (1, 3, 16);
        let long = config.expanded();
        assert!(!long.agents.is_empty() && !long.pois.is_empty(), "{}", path.display());
        (path.display().to_string(), [config, long])
    };
    paths.into_iter().map(small).collect()
}

#[cfg(not(target_family = "wasm"))]
fn check_forms(backend: &mut dyn Backend) {
    // Large teams have no short form, and would take minutes on software drivers.
    let is_small = |(_, [config, _]): &(String, [Config; 2])| config.agent_count() <= config::MAX_LEARNERS;
    let forms: Vec<_> = both_forms().into_iter().filter(is_small).collect();
    assert!(forms.len() >= 17);
    for (name, forms) in forms {
        let [short, long] = forms.map(|config| train(&[config], backend).remove(0));
        assert_eq!(short, long, "{name}, {}", backend.describe());
    }
}

#[cfg(not(target_family = "wasm"))]
#[test]
fn configs_and_their_long_forms_give_equal_digests() {
    check_forms(&mut Cpu::default());
    #[cfg(feature = "gpu")]
    for (request, _) in support::adapters("configs_and_their_long_forms_give_equal_digests") {
        check_forms(&mut GpuBackend::new(gpu::open(request).unwrap()).unwrap());
    }
}
