//! Tests `flotilla verify`, and that a comparison of backends notices every difference.

use assert_cmd::cargo::cargo_bin_cmd;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Backend, BackendError, Group, GroupScores, Trace};
use flotilla::config::{Choice, Fitness};
use flotilla::verify::{self, Plan};

fn verify_command(arguments: &[&str]) -> assert_cmd::Command {
    let mut command = cargo_bin_cmd!("flotilla");
    command.args(["verify", "-q", "--worlds", "2", "--teams", "3"]).args(arguments);
    command.envs([("VK_DRIVER_FILES", "/nonexistent"), ("VK_ICD_FILENAMES", "/nonexistent")]);
    command.env("WGPU_BACKEND", "vulkan");
    command
}

#[test]
fn instruction_sets_are_compared_without_a_gpu() {
    let output = verify_command(&["--adapter", "cpu"]).output().unwrap();
    let [table, stderr] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    match Cpu::levels().len() {
        1 => assert!(!output.status.success() && stderr.contains("nothing to compare"), "{stderr}"),
        sets => {
            assert!(output.status.success(), "{stderr}");
            let is_equal = |line: &&str| line.contains(" equal ") && line.contains("cpu (");
            assert_eq!(table.lines().filter(is_equal).count(), sets - 1, "{table}");
        }
    }
    let output = verify_command(&["--adapter", "cpu", "--pass", "plain"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
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
    let worlds = vec![("generally forward".into(), crate::support::layout("generally_forward"))];
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
fn without_a_gpu_verify_names_what_it_can_compare() {
    let output = verify_command(&[]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(
        stderr.contains("no GPU adapter") && stderr.contains("--adapter cpu") && !stderr.contains("--backend"),
        "{stderr}"
    );
    let output = verify_command(&["--adapter", "mine"]).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.contains("mine") && stderr.contains("--adapter cpu") && !stderr.contains("--backend"), "{stderr}");
}
