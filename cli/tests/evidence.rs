//! Tests `flotilla verify --report`, and that `docs/develop/evidence.md` agrees with the files in
//! `docs/develop/evidence/`.

use std::fs;
use std::path::PathBuf;

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, BackendError, Group, GroupScores, Trace};
use flotilla::config::{Choice, Fitness};
use flotilla::verify::{self, Plan};
use flotilla_app::record::evidence::{Compared, MachineReport, SCHEMA, Tier};

#[path = "../../app/examples/evidence.rs"]
mod evidence;

fn root() -> PathBuf {
    crate::ROOT.into()
}

fn verify_command(arguments: &[&str]) -> assert_cmd::Command {
    let mut command = cargo_bin_cmd!("flotilla");
    command.args(["verify", "-q", "--worlds", "2", "--teams", "3"]).args(arguments);
    command.envs([("VK_DRIVER_FILES", "/nonexistent"), ("VK_ICD_FILENAMES", "/nonexistent")]);
    command.env("WGPU_BACKEND", "vulkan");
    command
}

#[test]
fn a_report_needs_no_gpu() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("here.json");
    let output = verify_command(&["--note", "a test", "--report"]).arg(&file).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let table = String::from_utf8(output.stdout).unwrap();

    let text = fs::read_to_string(&file).unwrap();
    let report = MachineReport::parse(&text).unwrap();
    assert_eq!((report.schema, report.tier, report.note.as_deref()), (SCHEMA, Tier::Executed, Some("a test")));
    assert_eq!(report.date.len(), "2026-01-31".len());
    assert!(report.target.starts_with(std::env::consts::ARCH), "{}", report.target);
    assert!(report.toolchain.starts_with("rustc 1."), "{}", report.toolchain);
    if let Ok(text) = fs::read_to_string("/proc/cpuinfo") {
        let name = |line: &str| Some(line.strip_prefix("model name")?.split_once(':')?.1.trim().to_string());
        assert_eq!(report.processor, text.lines().find_map(name));
    }
    let widest = report.instructions.expect("the widest instruction set");
    let widest = format!("cpu ({widest}");
    assert!(report.comparisons.last().is_none_or(|last| last.adapter.starts_with(&widest)), "{widest}");
    assert_eq!(report.comparisons.len(), Cpu::levels().len() - 1, "expected every instruction set but the narrowest");
    for comparison in &report.comparisons {
        let Compared { adapter, worlds, agent_steps, equal, .. } = comparison;
        assert!(adapter.starts_with("cpu (") && (*worlds, *equal) == (2, true) && *agent_steps > 0, "{comparison:?}");
        assert_ne!(*adapter, comparison.against);
        assert!(table.contains(adapter), "{table}");
    }
    // The digests equal those of all other machines with a report.
    let digests = evidence::digests(&evidence::read(&root().join("docs/develop/evidence")).unwrap());
    assert_eq!(report.trained.len(), 6);
    for training in report.trained {
        assert_eq!(
            digests.get(&training.config),
            Some(&training.digest),
            "{}: differs from the reports",
            training.config
        );
    }
}

/// A backend that is correct except for one list of fitnesses. For that list, it reverses the order of the teams.
struct FaultyBackend {
    cpu: Cpu,
    fitnesses: &'static [Fitness],
}

impl Backend for FaultyBackend {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        let reversed: Vec<Vec<u32>> = groups.iter().map(|group| group.teams.iter().rev().copied().collect()).collect();
        let groups = groups.iter().zip(&reversed);
        let groups: Vec<Group<'_>> = groups
            .map(|(group, teams)| if group.fitnesses == self.fitnesses { Group { teams, ..*group } } else { *group })
            .collect();
        self.cpu.play(&groups)
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        self.cpu.trace(group)
    }

    fn describe(&self) -> String {
        "a faulty backend".into()
    }
}

#[test]
fn a_single_world_is_compared_with_every_kind_of_scores() {
    let worlds = verify::short_trainings().into_iter().take(1).collect();
    let plan = Plan { worlds, teams: 64, seed: 0, generations: 0 };
    for (word, fitness) in Fitness::ALL {
        assert!(verify::KINDS.contains(&&[*fitness][..]), "no kind of scores is {word} alone");
    }
    for fitnesses in verify::KINDS {
        let mut faulty = FaultyBackend { cpu: Cpu::default(), fitnesses };
        let outcome = verify::compare(&plan, &mut Cpu::default(), &mut faulty, |_| {}).unwrap();
        assert!(
            outcome.mismatch.as_ref().is_some_and(|message| message.contains("stage credit")),
            "{fitnesses:?}: {outcome:?}"
        );
    }
}

#[test]
fn without_a_gpu_verify_needs_report() {
    let output = verify_command(&[]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(
        stderr.contains("no GPU adapter") && stderr.contains("--report") && !stderr.contains("--backend"),
        "{stderr}"
    );
    let output = verify_command(&["--adapter", "mine"]).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.contains("mine") && stderr.contains("--report") && !stderr.contains("--backend"), "{stderr}");
    let output = verify_command(&["--note", "no report"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_report_needs_a_folder_and_does_not_overwrite_an_input() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("my.toml");
    fs::copy(root().join("configs/chaotic.toml"), &config).unwrap();
    let output = verify_command(&["--report"]).arg(&config).arg(&config).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stderr).contains("is read from"));
    let output = verify_command(&["--report"]).arg(folder.path().join("none/here.json")).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn the_page_is_up_to_date() {
    let expected = evidence::page(&root().join("docs/develop/evidence")).unwrap();
    let actual = fs::read_to_string(root().join("docs/develop/evidence.md")).unwrap();
    let difference = expected.lines().zip(actual.lines()).find(|(expected, actual)| expected != actual);
    assert!(
        expected == actual,
        "docs/develop/evidence.md is out of date; run cargo run --example evidence: {difference:#?}"
    );
}

#[test]
fn the_page_shows_differences_and_names_invalid_files() {
    let folder = tempfile::tempdir().unwrap();
    let write_report = |name: &str, digest: &str, failure: Option<&str>| {
        let comparison = Compared {
            adapter: "A GPU (discrete GPU, vulkan)".into(),
            pass: Some("guarded".into()),
            kernel: Some("generic".into()),
            against: "cpu (AVX2, 2 threads)".into(),
            worlds: 7,
            agent_steps: 1_234_567,
            equal: failure.is_none(),
            failure: failure.map(String::from),
        };
        let trained =
            vec![flotilla_app::record::evidence::ShortTraining { config: "chaotic".into(), digest: digest.into() }];
        let evidence = MachineReport { comparisons: vec![comparison], trained, ..MachineReport::new(Tier::Executed) };
        fs::write(folder.path().join(format!("{name}.json")), evidence.to_json()).unwrap();
    };
    write_report("one", "aa", None);
    write_report("two", "aa", None);
    let page = evidence::page(folder.path()).unwrap();
    assert!(page.contains("| 1 234 567 | equal | equal |") && page.contains("| chaotic | `aa` |"), "{page}");
    write_report("three", "bb", Some("stage move, team 1"));
    let page = evidence::page(folder.path()).unwrap();
    assert!(page.contains("**1 of 1 different**") && page.contains("**1 of 1 other digests**"), "{page}");
    assert!(page.contains("**stage move, team 1**"), "{page}");
    fs::write(folder.path().join("four.json"), "{\"schema\": 2}").unwrap();
    let error = evidence::page(folder.path()).unwrap_err();
    assert!(error.contains("four.json"), "{error}");
}
