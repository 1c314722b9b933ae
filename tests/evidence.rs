//! `flotilla verify --report` writes what it found, and `docs/develop/evidence.md` is what the files of `docs/develop/evidence/` make.

#![cfg(feature = "cli")]

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, BackendError, Group, GroupScores, Trace};
use flotilla::config::Fitness;
use flotilla::record::evidence::{Compared, MachineReport, SCHEMA, Tier};
use flotilla::verify::{self, Plan};

#[path = "../examples/evidence.rs"]
mod evidence;

fn root() -> PathBuf {
    env!("CARGO_MANIFEST_DIR").into()
}

fn verify_command(words: &[&str]) -> assert_cmd::Command {
    let mut command = cargo_bin_cmd!("flotilla");
    command.args(["verify", "-q", "--worlds", "2", "--teams", "3"]).args(words);
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
    let found = MachineReport::parse(&text).unwrap();
    assert_eq!((found.schema, found.tier, found.note.as_deref()), (SCHEMA, Tier::Executed, Some("a test")));
    assert_eq!(found.date.len(), "2026-01-31".len());
    assert!(found.target.starts_with(std::env::consts::ARCH), "{}", found.target);
    assert!(found.toolchain.starts_with("rustc 1."), "{}", found.toolchain);
    assert_eq!(found.comparisons.len(), Cpu::levels().len() - 1, "every instruction set but the narrowest");
    for comparison in &found.comparisons {
        let Compared { adapter, worlds, agent_steps, equal, .. } = comparison;
        assert!(adapter.starts_with("cpu (") && (*worlds, *equal) == (2, true) && *agent_steps > 0, "{comparison:?}");
        assert_ne!(*adapter, comparison.against);
        assert!(table.contains(adapter), "{table}");
    }
    // To the digests of all machines that sent one in.
    let digests = evidence::digests(&evidence::read(&root().join("docs/develop/evidence")).unwrap());
    assert_eq!(found.trained.len(), 6);
    for came in found.trained {
        assert_eq!(digests.get(&came.config), Some(&came.digest), "{}: not what the rows say", came.config);
    }
}

/// Right but where scores of one kind are asked for: there teams play each other's policies.
struct Liar {
    cpu: Cpu,
    about: &'static [Fitness],
}

impl Backend for Liar {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        let reversed: Vec<Vec<u32>> = groups.iter().map(|group| group.teams.iter().rev().copied().collect()).collect();
        let told = groups.iter().zip(&reversed);
        let told: Vec<Group<'_>> = told
            .map(|(group, teams)| if group.fitnesses == self.about { Group { teams, ..*group } } else { *group })
            .collect();
        self.cpu.play(&told)
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        self.cpu.trace(group)
    }

    fn describe(&self) -> String {
        "a liar".into()
    }
}

#[test]
fn one_world_is_asked_for_scores_of_every_kind() {
    let worlds = verify::short_trainings().into_iter().take(1).collect();
    let plan = Plan { worlds, teams: 64, seed: 0, generations: 0 };
    for about in verify::KINDS {
        let mut liar = Liar { cpu: Cpu::default(), about };
        let found = verify::compare(&plan, &mut Cpu::default(), &mut liar, |_| {}).unwrap();
        assert!(found.mismatch.as_ref().is_some_and(|told| told.contains("stage credit")), "{about:?}: {found:?}");
    }
}

#[test]
fn without_a_gpu_only_a_report_can_be_had() {
    let output = verify_command(&[]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains("no GPU adapter") && told.contains("--report") && !told.contains("--backend"), "{told}");
    let output = verify_command(&["--adapter", "mine"]).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains("mine") && told.contains("--report") && !told.contains("--backend"), "{told}");
    let output = verify_command(&["--note", "no report"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_report_is_written_over_no_input_and_nowhere() {
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
fn the_page_is_what_the_files_make() {
    let made = evidence::page(&root().join("docs/develop/evidence")).unwrap();
    let there = fs::read_to_string(root().join("docs/develop/evidence.md")).unwrap();
    let first = made.lines().zip(there.lines()).find(|(made, there)| made != there);
    assert!(made == there, "docs/develop/evidence.md is another, say cargo run --example evidence: {first:#?}");
}

#[test]
fn a_row_that_differs_shows() {
    let folder = tempfile::tempdir().unwrap();
    let row = |name: &str, digest: &str, failure: Option<&str>| {
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
            vec![flotilla::record::evidence::ShortTraining { config: "chaotic".into(), digest: digest.into() }];
        let evidence = MachineReport { comparisons: vec![comparison], trained, ..MachineReport::new(Tier::Executed) };
        fs::write(folder.path().join(format!("{name}.json")), evidence.to_json()).unwrap();
    };
    row("one", "aa", None);
    row("two", "aa", None);
    let page = evidence::page(folder.path()).unwrap();
    assert!(page.contains("| 1 234 567 | equal | equal |") && page.contains("| chaotic | `aa` |"), "{page}");
    row("three", "bb", Some("stage move, team 1"));
    let page = evidence::page(folder.path()).unwrap();
    assert!(page.contains("**1 of 1 different**") && page.contains("**1 of 1 other digests**"), "{page}");
    assert!(page.contains("**stage move, team 1**"), "{page}");
    fs::write(folder.path().join("four.json"), "{\"schema\": 2}").unwrap();
    let error = evidence::page(folder.path()).unwrap_err();
    assert!(error.contains("four.json"), "{error}");
}

/// Every test that the page names exists.
#[test]
fn the_tests_that_the_page_names_are_there() {
    let page = fs::read_to_string(root().join("docs/develop/evidence.md")).unwrap();
    let table = page.split("## What exactness relies on").nth(1).unwrap();
    let rows = table.lines().filter(|line| line.starts_with("| "));
    let names = rows.filter_map(|line| line.trim_end_matches(" |").rsplit(" | ").next());
    let names: Vec<&str> = names.flat_map(|cell| cell.split('`').skip(1).step_by(2)).collect();
    assert!(names.len() > 10, "{names:?}");
    let mut code = String::new();
    let mut folders = vec![root().join("tests"), root().join("src")];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false if path.extension().is_some_and(|ending| ending == "rs") => code += &read(&path),
                false => {}
            }
        }
    }
    for name in names {
        assert!(code.contains(&format!("fn {name}(")), "there is no test {name}");
    }
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap()
}
