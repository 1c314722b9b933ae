//! Tests that a killed training process resumes to the same bytes.
//!
//! This uses only the core and the recording of runs, not the program, which takes long to build for some machines.
//! `cli/tests/recovery.rs` has the other tests of kills.

use std::path::Path;
use std::process::{Child, Command, ExitStatus};
use std::sync::atomic::AtomicBool;
use std::time::Duration;
use std::{env, fs};

use flotilla::backend::cpu::Cpu;
use flotilla::backend::{Machine, OpenBackend};
use flotilla::config::Config;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{METRICS, POLICIES, Start};
use flotilla_app::run::{SessionEnd, Options, Session};

const TEST: &str = "a_killed_process_resumes_to_the_same_bytes";
/// The environment variable with the directory to train in. If it is set, this process is one that will be killed.
const FOLDER: &str = "FLOTILLA_PORTS_FOLDER";
const KILLS: usize = 6;

/// Returns a config that trains in seconds under an emulator. Most of the time goes into checkpoints.
fn config() -> Config {
    let text = "
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [22, 2]]
pois = [[10, 9], [20, 9]]
coupling = 2
steps = 6
[policy]
hidden = [16]
[learning]
population = 20
generations = 60
trials = 2
[checkpoint]
generations = 1
seconds = 0
";
    Config::parse(text, "ports.toml").unwrap()
}

fn train(folder: &Path) {
    let (mut session, notes) = Session::open(vec![(config(), folder.into())], Start::Resume, &Disk::default()).unwrap();
    assert!(!notes.iter().any(|(_, note)| note.is_damage), "{notes:?}");
    let mut backend: OpenBackend = (Box::new(Cpu::default()), Machine::default());
    let (stop, save) = (AtomicBool::new(false), AtomicBool::new(false));
    let mut options = Options {
        command: "",
        stop: &stop,
        save: &save,
        fallback: &mut |_| None,
        // Slow down, so that there is time for a kill.
        watch: &mut |_| std::thread::sleep(Duration::from_millis(10)),
    };
    assert_eq!(session.train(&mut backend, &mut options).unwrap(), SessionEnd::Finished);
}

/// Returns the bytes of the policies, and the metrics without the seconds.
fn results(folder: &Path) -> (Vec<u8>, Vec<String>) {
    let metrics = fs::read_to_string(folder.join(METRICS)).unwrap();
    let without_seconds = |line: &str| line.split(',').take(5).collect::<Vec<_>>().join(",");
    (fs::read(folder.join(POLICIES)).unwrap(), metrics.lines().map(without_seconds).collect())
}

/// Kills a process when the run has two more rows of metrics, and returns `None`. Without `kill`, or if the process
/// ends before, returns its exit status.
fn kill_or_wait(child: &mut Child, metrics: &Path, kill: bool) -> Option<ExitStatus> {
    let rows = || fs::read(metrics).map_or(0, |text| text.iter().filter(|&&byte| byte == b'\n').count());
    let before = rows();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return Some(status);
        }
        if kill && rows() >= before + 2 {
            child.kill().unwrap();
            child.wait().unwrap();
            return None;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_killed_process_resumes_to_the_same_bytes() {
    if let Some(folder) = env::var_os(FOLDER) {
        return train(Path::new(&folder));
    }
    let scratch = tempfile::tempdir().unwrap();
    let [uninterrupted, killed] = ["uninterrupted", "killed"].map(|name| scratch.path().join(name));
    train(&uninterrupted);
    let mut kills = 0;
    let status = loop {
        let mut command = Command::new(env::current_exe().unwrap());
        let mut child = command.args(["--exact", TEST]).env(FOLDER, &killed).spawn().unwrap();
        match kill_or_wait(&mut child, &killed.join(METRICS), kills < KILLS) {
            None => kills += 1,
            Some(status) => break status,
        }
    };
    assert!(status.success(), "{status}");
    assert_eq!(kills, KILLS);
    assert!(results(&killed) == results(&uninterrupted), "{} differs", killed.display());
}
