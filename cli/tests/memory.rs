//! Tests that a run uses as much memory as `flotilla check` predicts.
//!
//! A run that needs more memory than is available must not start.

use crate::support;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use flotilla::backend::cpu::Cpu;
use flotilla::config::{Config, MAX_TRIALS};
use flotilla::front::Failure;
use flotilla::memory::{self, Peaks};
use flotilla::trainer::Trainer;
use flotilla_app::record::checkpoint::{self, Checkpoint, CheckpointWriter};
use flotilla_app::record::disk::Disk;
use flotilla_app::record::metrics;

const GENERALLY_FORWARD: &str = include_str!("../../configs/generally_forward.toml");

/// Returns the config of generally forward with other sizes and checkpoint settings.
fn config_text(population: usize, trials: usize, generations: usize, checkpoint: &str) -> String {
    let change = |line: &str| match line.split(" = ").next() {
        Some("population") => format!("population = {population}"),
        Some("trials") => format!("trials = {trials}"),
        Some("generations") => format!("generations = {generations}"),
        _ => line.to_string(),
    };
    let lines: Vec<_> = GENERALLY_FORWARD.lines().map(change).collect();
    format!("{}\n\n[checkpoint]\n{checkpoint}\n", lines.join("\n"))
}

/// Returns the peak resident memory of a process in bytes, or `None` if the system does not report it.
fn peak(command: &mut Command) -> Option<u64> {
    let mut child = command.stdout(Stdio::null()).spawn().unwrap();
    let mut peak = None;
    loop {
        // The system records the peak only while the process exists, so it is read until the end.
        let status = fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
        peak = peak.max(kib.map(|kib| kib * 1024));
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success());
            return peak;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn predicted(config: &std::path::Path) -> u64 {
    let output = support::flotilla().arg("check").arg(config).arg("--json").output().unwrap();
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    json["cost"]["host_bytes"].as_u64().unwrap()
}

fn peaks(configs: &[&Config], threads: usize) -> Peaks {
    let valid: Vec<_> = configs.iter().map(|config| config.validate().unwrap()).collect();
    Peaks::of(&valid, threads)
}

#[test]
fn runs_use_the_predicted_memory() {
    for (population, trials, checkpoint) in [
        (1 << 15, 1, "generations = 0\nseconds = 0.0"),
        // A run that is small enough for a copy of its checkpoint, and one that is too large.
        (1 << 15, 1, "generations = 1"),
        (1 << 15, 2, "generations = 1"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let config = folder.path().join("config.toml");
        fs::write(&config, config_text(population, trials, 2, checkpoint)).unwrap();
        let mut train = support::flotilla();
        train.arg("train").arg(&config).args(["--backend", "cpu", "--quiet", "--out"]).arg(folder.path().join("run"));
        let Some(peak) = peak(&mut train) else {
            let test = "runs_use_the_predicted_memory";
            return support::skip(test, "this system does not report the memory of a process");
        };
        let predicted = predicted(&config);
        let share = peak as f64 / predicted as f64;
        println!("{trials} trials of {population} policies: predicted {predicted} bytes, used {peak}: {share:.3}");
        assert!(
            (0.9..=1.1).contains(&share),
            "{trials} × {population}, {checkpoint}: {predicted} predicted, {peak} used"
        );
    }
}

#[test]
fn memory_grows_with_the_generations_as_predicted() {
    let folder = tempfile::tempdir().unwrap();
    let measured = |generations: usize| {
        let config = folder.path().join(format!("{generations}.toml"));
        let text = support::TINY.replace("steps = 8", "steps = 1").replace("population = 6", "population = 2");
        let text = text.replace("trials = 2", "trials = 1").replace("= 4\n", &format!("= {generations}\n"));
        fs::write(&config, format!("{text}[checkpoint]\ngenerations = 0\nseconds = 0.0\n")).unwrap();
        let mut train = support::flotilla();
        train.arg("train").arg(&config).args(["--backend", "cpu", "--quiet", "--threads", "1", "--out"]);
        let used = peak(train.arg(config.with_extension("")))?;
        Some([used, predicted(&config)].map(|bytes| bytes as f64))
    };
    let (Some([short, expected_short]), Some([long, expected_long])) = (measured(1), measured(32_000)) else {
        let test = "memory_grows_with_the_generations_as_predicted";
        return support::skip(test, "this system does not report the memory of a process");
    };
    let share = (long - short) / (expected_long - expected_short);
    assert!((0.6..=1.4).contains(&share), "grew by {}, {share:.3} of the prediction", long - short);
}

#[test]
fn a_run_without_enough_memory_does_not_start() {
    let folder = tempfile::tempdir().unwrap();
    let (path, out) = (folder.path().join("config.toml"), folder.path().join("run"));
    let Some(available) = memory::available() else {
        return support::skip("a_run_without_enough_memory_does_not_start", "this system does not report free memory");
    };
    // A third more than there is now, because other programs may end.
    let text = |trials| config_text(1 << 20, trials, 1, "generations = 0\nseconds = 0.0");
    let needed = |trials| peaks(&[&Config::parse(&text(trials), "config").unwrap()], 1).host;
    let trials = (1..=MAX_TRIALS).find(|&trials| needed(trials) > available / 3 * 4);
    let text = text(trials.expect("4096 trials of 1048576 policies need more than any machine has"));
    let config = Config::parse(&text, "config").unwrap();
    let trained = flotilla::train(&config, &mut Cpu::default(), |_| panic!("training has started"));
    assert!(matches!(trained, Err(Failure::TooLittle(_))));
    fs::write(&path, text).unwrap();
    let mut train = support::flotilla();
    let output = train.arg("train").arg(&path).args(["--backend", "cpu", "--out"]).arg(&out).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let stderr = String::from_utf8(output.stderr).unwrap();
    for part in ["GiB of memory at its peak", "is available", "choose fewer policies"] {
        assert!(stderr.contains(part), "{stderr}");
    }
    assert!(
        !stderr.contains("checkpoints"),
        "a run without checkpoints cannot save memory by leaving them out: {stderr}"
    );
    assert!(!out.exists(), "the output directory exists");
}

/// Configs that train together share the memory that they use in turns. The rest adds up.
#[test]
fn peaks_of_configs_that_train_together_add_up() {
    let config = |population| Config::parse(&config_text(population, 2, 1, "generations = 1"), "config").unwrap();
    let [small, large] = [config(1000), config(9000)];
    let [small_only, large_only, both] =
        [vec![&small], vec![&large], vec![&small, &large]].map(|configs| peaks(&configs, 3));
    let growing = |plan: Peaks| plan.host - memory::PROGRAM;
    assert_eq!(both.checkpoint, small_only.checkpoint + large_only.checkpoint);
    assert!(growing(both) > growing(large_only) && growing(both) <= growing(small_only) + growing(large_only));
    assert!(both.adapter > large_only.adapter && both.gpu_host > both.host - both.checkpoint);
    assert!(memory::copies_checkpoint([&small, &large]));
    assert!(!memory::copies_checkpoint(&[config(40_000)]));
}

/// The stage that needs the most memory counts, wherever it is in the order.
#[test]
fn the_largest_stage_determines_the_peak() {
    let plain = config_text(1000, 2, 9, "generations = 1");
    let config = |stages: &str| Config::parse(&[&plain, stages].concat(), "config").unwrap();
    let stage = |from: usize, set: &str| format!("[[stages]]\nfrom = {from}\nset = {{ {set} }}\n");
    let (large, small) = ("learning.episodes_per_team = 5, world.steps = 90", "world.steps = 5");
    let expected = peaks(&[&config(&stage(0, large))], 3);
    assert!(expected.host > peaks(&[&config("")], 3).host);
    for stages in [stage(4, large), stage(2, large) + &stage(4, small), stage(2, small) + &stage(4, large)] {
        assert_eq!(peaks(&[&config(&stages)], 3), expected, "{stages}");
    }
}

/// A GPU that adds up records takes memory for the sums, and one that holds populations for these.
#[test]
fn sums_and_populations_on_a_gpu_are_counted() {
    let adapter = |population| {
        let config = Config::parse(&config_text(population, 2, 1, "generations = 0"), "config").unwrap();
        peaks(&[&config], 1).adapter
    };
    // Per team, weights and record: 4 leaders of 112 weights; 25 steps of 4 POIs, 8 followers with 4 leaders each, and
    // five sums. A task has 16 teams or more.
    let (weights, record, task) = (4 * 112 * 4, (25 * 4 + 8 * 4 + 5) * 4, 64 / 16);
    assert_eq!(adapter(50), 2 * 51 * (weights + record + task));
    // Populations of this size stay on the device, which takes five more sets of weights per team, and the parents.
    let population = 5 * 112 * 4 + 4 * 4;
    assert_eq!(adapter(2000), 2 * 2001 * (weights + record + task + population));
}

/// A batch has at least one team, however large.
#[test]
fn a_team_larger_than_a_batch_is_counted() {
    let text = "[world]\nmap = [400, 400]\nsteps = 5\n\
                [[agents]]\nname = 'leader'\ncount = 200\nin = { disc = [200, 200, 10] }\nsenses = [{ of = 'pois' }]\n\
                leads = 'follower'\ninfluence_radius = 5\n\
                [[agents]]\nname = 'follower'\ncount = 1000000\nin = { disc = [200, 200, 160] }\ncontrol = 'follow'\n\
                rule = [{ of = 'leader', to = 5, gain = 5 }]\n\
                [[pois]]\nname = 'place'\nat = [[150, 100]]\n[learning]\npopulation = 4\ntrials = 1\n";
    let peaks = peaks(&[&Config::parse(text, "huge").unwrap()], 1);
    // Two teams, of which each pair of leader and follower has a count of 4 bytes.
    let records = 2 * 200 * 1_000_000 * 4;
    assert!(peaks.adapter > records && peaks.gpu_host > records, "{peaks:?}");
}

/// Episodes of large teams take several dispatches on a GPU. The agents' states between them and the tasks of each must
/// count, too.
#[test]
fn states_between_dispatches_are_counted() {
    let text = |agents: usize| {
        let followers = vec!["[2, 2]"; agents - 1].join(", ");
        format!("[world]\nleaders = [[1, 1]]\nfollowers = [{followers}]\npois = [[9, 9]]\n[learning]\ntrials = 1\n")
    };
    let config = Config::parse(&text(1024), "config").unwrap();
    // Per team, weights, record, states and tasks: 112 weights; 25 steps of 32 words, 1023 followers with one leader, and
    // two sums; 5 dispatches.
    let (weights, record, states, tasks) = (112 * 4, (25 * 32 + 1023 + 2) * 4, 1024 * 20, 5 * 64);
    assert_eq!(peaks(&[&config], 1).adapter, 51 * (weights + record + states + tasks));
}

/// A checkpoint written from the populations must equal one written from a copy of them.
#[test]
fn checkpoints_from_a_copy_and_a_view_are_equal() {
    let config = Config::parse(&config_text(60, 2, 9, "generations = 1"), "config").unwrap();
    let mut trainer = Trainer::new([config.validate().unwrap()]);
    for _ in 0..3 {
        trainer.advance(&mut Cpu::default()).unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::default();
    let mut metrics = metrics::Writer::create(&disk, &folder.path().join("metrics.csv"), &config).unwrap();
    let files = ["copy", "view"].map(|name| {
        let path = folder.path().join(name);
        fs::create_dir(&path).unwrap();
        let mut writer = CheckpointWriter::new(disk.clone(), path.clone(), config.clone(), vec![0, 1], 1);
        let (config, seconds) = (flotilla_app::record::config_digest(&config), 2.5);
        let (metrics, output) = metrics.mark().unwrap();
        match name {
            "copy" => {
                let snapshot = trainer.snapshot(0).unwrap();
                let checkpoint = Checkpoint { config, init: None, seconds, metrics, snapshot };
                writer.save(checkpoint, output, Instant::now()).unwrap();
                writer.wait().unwrap();
            }
            _ => {
                let checkpoint =
                    Checkpoint { config, init: None, seconds, metrics, snapshot: trainer.view(0).unwrap() };
                writer.save_now(&checkpoint, &output, Instant::now()).unwrap();
            }
        }
        assert_eq!(writer.newest(), Some(3));
        fs::read(checkpoint::path(&path, 3)).unwrap()
    });
    assert!(files[0].len() as u64 > config.policy_bytes() && files[0] == files[1]);
    let loaded = checkpoint::read(&checkpoint::path(&folder.path().join("view"), 3), Path::new("none"), &config);
    let loaded = loaded.unwrap().expect("a checkpoint with weights");
    assert_eq!(loaded.snapshot, trainer.snapshot(0).unwrap());
    let mut resumed = Trainer::new([config.validate().unwrap()]);
    assert!(resumed.restore(0, loaded.snapshot));
    let rows = |trainer: &mut Trainer| trainer.advance(&mut Cpu::default()).unwrap();
    assert_eq!(rows(&mut resumed), rows(&mut trainer));
    assert_eq!(resumed.policies(0), trainer.policies(0));
    assert_eq!(resumed.policies(0), resumed.ends(&[0]).remove(0).0);
}
