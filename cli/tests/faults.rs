//! Tests that no failed file-system call, and no kill at one, loses results.
//!
//! `cc` compiles `faults/shim.c` to a library that makes one call of the program fail, or kills the program there.
//! Afterwards `--resume` must produce the files of an undisturbed run, or fail with a message that names a command that
//! does.
//!
//! By default a few hundred faults are injected. `FLOTILLA_LONG=1` injects more than 5000, in about 15 minutes of one
//! processor: every call of the small scenarios fails in each way, and evenly spread calls of the large ones.
//! `FLOTILLA_FAULTS=train,sweep` selects scenarios.

#![cfg(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64")))]

use crate::support;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

use flotilla_app::record::folder::METRICS;
use tempfile::TempDir;

const STAGES: &str = "[[stages]]\nfrom = 2\nset = { 'world.coupling' = 1 }\n";
const GRID: &str = "[grid]\n\"learning.fitness\" = ['D', 'Df']\n";
/// A command that takes longer than this counts as hanging.
const LIMIT: Duration = Duration::from_secs(120);

/// A command that is started, disturbed by a fault, and resumed.
struct Scenario {
    name: &'static str,
    /// Commands that prepare the directory and are not disturbed.
    before: &'static [&'static str],
    /// The command that is disturbed.
    command: &'static str,
    /// Number of faults in the default run.
    short: usize,
    /// Maximum number of disturbed calls in a long run.
    long: usize,
}

const fn scenario(
    name: &'static str,
    before: &'static [&'static str],
    command: &'static str,
    short: usize,
) -> Scenario {
    Scenario { name, before, command, short, long: 1000 }
}

const SCENARIOS: [Scenario; 9] = [
    scenario("train", &[], "train small.toml --out out", 60),
    scenario("extension", &["train small.toml --out out --generations 2"], "train small.toml --out out --resume", 50),
    scenario("force", &["train small.toml --out out --seed 5"], "train small.toml --out out --force", 50),
    scenario(
        "init",
        &["train small.toml --out first --seed 5"],
        "train small.toml --out out --init first/policies.safetensors",
        50,
    ),
    scenario("stages", &[], "train stages.toml --out out", 24),
    scenario("sweep", &[], "sweep grid.toml --out out", 40),
    Scenario { long: 120, ..scenario("paper", &[], "paper --trials 1 --generations 1 --out out", 8) },
    Scenario {
        long: 100,
        ..scenario(
            "paper-force",
            &["paper --trials 1 --generations 1 --out out --seed 5"],
            "paper --trials 1 --generations 1 --out out --force",
            6,
        )
    },
    Scenario { long: 120, ..scenario("questions", &[], "paper --questions=g --trials 2 --generations 1 --out out", 6) },
];

impl Scenario {
    /// Returns the command that resumes and keeps finished work. If it may be refused, also returns what to run then.
    fn resume(&self) -> (String, Option<String>) {
        let command = self.command;
        if let Some(start) = command.strip_suffix(" --force") {
            // If the fault came before anything was overwritten, the folder still contains the run with seed 5.
            (format!("{start} --resume"), Some(command.into()))
        } else if let Some((start, _)) = command.split_once(" --init ") {
            (format!("{start} --resume"), Some(format!("{command} --resume")))
        } else {
            (format!("{} --resume", command.trim_end_matches(" --resume")), None)
        }
    }
}

/// The fault injected into a system call.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    /// The disk is full, for this call only.
    Full,
    /// The disk is full from this call on.
    FullFromHere,
    /// The disk fails once.
    Broken,
    /// The disk becomes read-only at this call, as Linux makes it after an error.
    ReadOnly,
    /// The process ends.
    Killed,
}

const FAULTS: [Fault; 5] = [Fault::Killed, Fault::Full, Fault::FullFromHere, Fault::Broken, Fault::ReadOnly];

/// One fault at one call of a scenario.
struct Case<'a> {
    scenario: &'a Scenario,
    /// From 1.
    call: usize,
    fault: Fault,
}

/// The directory that a scenario starts from, with the results and the calls of an undisturbed run.
struct Prepared {
    before: TempDir,
    expected: BTreeMap<PathBuf, Vec<u8>>,
    calls: usize,
}

/// The library that disturbs a process.
struct Shim(TempDir);

impl Shim {
    /// Compiles the shim. Returns the reason if this machine cannot compile or load it.
    fn compile() -> Result<Shim, String> {
        let folder = TempDir::new().unwrap();
        let source = Path::new(crate::ROOT).join("cli/tests/faults/shim.c");
        let compiled = Command::new("cc")
            .args(["-O1", "-Wall", "-Werror", "-shared", "-fPIC", "-o"])
            .arg(folder.path().join("shim.so"))
            .arg(source)
            .output()
            .map_err(|error| format!("cc cannot be run: {error}"))?;
        assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
        let shim = Shim(folder);
        let trial = shim.disturb(Command::new("true"), 0, Fault::Full, None).output();
        match trial.map_err(|error| error.to_string())? {
            trial if trial.status.success() => Ok(shim),
            trial => Err(String::from_utf8_lossy(&trial.stderr).trim().into()),
        }
    }

    /// Prepares a command whose `call`-th file-system call fails; 0 disturbs no call. `count` names a file that
    /// receives the number of calls.
    fn disturb(&self, mut command: Command, call: usize, fault: Fault, count: Option<&Path>) -> Command {
        let kind = match fault {
            Fault::Killed => "KILL",
            Fault::Broken => "EIO",
            Fault::Full | Fault::FullFromHere => "ENOSPC",
            Fault::ReadOnly => "EROFS",
        };
        command.env("LD_PRELOAD", self.0.path().join("shim.so"));
        command.env("FAULT_AT", call.to_string()).env("FAULT_KIND", kind);
        if matches!(fault, Fault::FullFromHere | Fault::ReadOnly) {
            command.env("FAULT_ALL", "1");
        }
        if let Some(count) = count {
            command.env("FAULT_COUNT", count);
        }
        command
    }
}

/// Creates a directory in memory if possible, because disks are slow.
fn folder() -> TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| TempDir::new().unwrap())
}

fn program(folder: &Path, words: &str) -> Command {
    let mut command = support::flotilla();
    command.current_dir(folder).args(words.split_whitespace());
    // With one thread, nearly the same calls are made in the same order.
    command.args(["--backend", "cpu", "--threads", "1", "--quiet"]);
    command
}

/// Runs a command to its end. Fails the test if the command hangs or panics.
fn output(mut command: Command, context: &str) -> Output {
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let since = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if since.elapsed() > LIMIT {
            child.kill().unwrap();
            panic!("{context}: {command:?} did not finish within {LIMIT:?}");
        }
        std::thread::sleep(Duration::from_millis(3));
    }
    let output = child.wait_with_output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(!stderr.contains("panicked"), "{context}: {command:?}: {stderr}");
    output
}

fn succeed(folder: &Path, words: &str, context: &str) {
    let output = output(program(folder, words), context);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{context}: {words}: {stderr}");
}

/// Reads the results: every file except those that record time and place.
///
/// `metrics.csv` is read without its seconds.
fn outcome(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut results = support::files(folder);
    results.retain(|path, _| {
        let name = path.file_name().unwrap().to_string_lossy();
        // Checkpoints depend on how often they are saved. Killed writers leave temporary files.
        let irrelevant =
            name.starts_with('.') || name.ends_with(".tmp") || path.iter().any(|part| part == "checkpoints");
        !irrelevant && !["run.json", "summary.json"].contains(&&*name)
    });
    for (path, bytes) in results.iter_mut().filter(|(path, _)| path.ends_with(METRICS)) {
        let rows = support::metrics_without_seconds(&folder.join(path.parent().unwrap()));
        *bytes = format!("{rows:?}").into_bytes();
    }
    results
}

fn prepare(shim: &Shim, scenario: &Scenario) -> Prepared {
    let before = folder();
    let small = support::tiny(3, "generations = 1\nseconds = 0");
    let files = [("small", String::new()), ("stages", STAGES.into()), ("grid", GRID.into())];
    for (name, more) in files {
        fs::write(before.path().join(format!("{name}.toml")), format!("{small}{more}")).unwrap();
    }
    scenario.before.iter().for_each(|words| succeed(before.path(), words, scenario.name));
    let undisturbed = folder();
    support::copy(before.path(), undisturbed.path());
    let count = undisturbed.path().join("calls");
    let counted = shim.disturb(program(undisturbed.path(), scenario.command), 0, Fault::Full, Some(&count));
    let stderr = output(counted, scenario.name);
    assert!(stderr.status.success(), "{}: {}", scenario.name, String::from_utf8_lossy(&stderr.stderr));
    let calls = fs::read_to_string(&count).unwrap().trim().parse().unwrap();
    assert!(calls > 20, "{}: {calls}", scenario.name);
    Prepared { before, expected: outcome(&undisturbed.path().join("out")), calls }
}

/// Whether the message of a command that wrote nothing says what to do.
fn advises(stderr: &str) -> bool {
    ["run it again", "choose a place you may write to"].iter().any(|advice| stderr.contains(advice))
}

/// Disturbs one call and resumes. Returns a description of what went wrong, if anything.
fn inject(shim: &Shim, case: &Case<'_>, prepared: &Prepared) -> Option<String> {
    let Case { scenario, call, fault } = *case;
    let context = format!("{}, call {call} of {}, {fault:?}", scenario.name, prepared.calls);
    let place = folder();
    support::copy(prepared.before.path(), place.path());
    let disturbed = output(shim.disturb(program(place.path(), scenario.command), call, fault, None), &context);
    let stderr = String::from_utf8_lossy(&disturbed.stderr).into_owned();
    if disturbed.status.code() == Some(1) {
        assert!(stderr.contains("error: "), "{context}: {stderr}");
    } else {
        let ends = disturbed.status.success() || fault == Fault::Killed && disturbed.status.code().is_none();
        assert!(ends, "{context}: {:?}: {stderr}", disturbed.status);
    }
    let (mut resume, fallback) = scenario.resume();
    let started = fs::read_dir(place.path().join("out")).is_ok_and(|mut entries| entries.next().is_some());
    if !started {
        // The output directory is empty, so there is nothing to resume.
        if scenario.name == "init" && disturbed.status.code().is_some() && !advises(&stderr) {
            return Some(format!("{context}: {stderr}"));
        }
        resume = scenario.command.into();
    }
    let resumed = output(program(place.path(), &resume), &context);
    let resume_stderr = String::from_utf8_lossy(&resumed.stderr).into_owned();
    let mut refusal = None;
    if !resumed.status.success() {
        // The message must name a flag or a command that helps.
        let advised = resume_stderr.contains("--") || resume_stderr.contains("resume with");
        let Some(fallback) = fallback.filter(|_| resumed.status.code() == Some(1) && advised) else {
            return Some(format!("{context}: {stderr}\nthen {resume}: {:?}: {resume_stderr}", resumed.status));
        };
        let second = output(program(place.path(), &fallback), &context);
        refusal = Some(resume_stderr.clone());
        if !second.status.success() {
            return Some(format!(
                "{context}: {stderr}\nthen {resume_stderr}\nthen {}",
                String::from_utf8_lossy(&second.stderr)
            ));
        }
    }
    let results = outcome(&place.path().join("out"));
    let differ = |name: &&PathBuf| results.get(*name) != prepared.expected.get(*name);
    let mut names: Vec<_> = results.keys().chain(prepared.expected.keys()).filter(differ).cloned().collect();
    names.sort();
    names.dedup();
    (!names.is_empty()).then(|| format!("{context}: {stderr}\n{refusal:?}\ndiffers in {names:?}"))
}

#[test]
fn resume_after_any_fault_gives_the_same_results() {
    let long = support::is_long();
    let only = std::env::var("FLOTILLA_FAULTS").ok();
    let shim = match Shim::compile() {
        Ok(shim) => shim,
        Err(reason) => {
            return support::skip_without("resume_after_any_fault_gives_the_same_results", &reason);
        }
    };
    let chosen: Vec<&Scenario> = SCENARIOS
        .iter()
        .filter(|scenario| only.as_ref().is_none_or(|only| only.split(',').any(|name| name == scenario.name)))
        .collect();
    assert!(!chosen.is_empty(), "no scenario has the name {only:?}");
    let prepared: Vec<Prepared> = chosen.iter().map(|scenario| prepare(&shim, scenario)).collect();
    let mut cases = Vec::new();
    for (scenario, prepared) in chosen.iter().zip(&prepared) {
        let calls = prepared.calls;
        if long {
            let count = calls.min(scenario.long);
            let spread = (0..count).map(|at| 1 + at * calls / count);
            let selected = spread.flat_map(|call| FAULTS.map(|fault| (call, fault)));
            cases.extend(selected.map(|(call, fault)| (Case { scenario, call, fault }, prepared)));
        } else {
            // The fault at the first call is always included: the first calls write the files that identify a run.
            let spread = (0..scenario.short).map(|at| 1 + at * calls / scenario.short);
            let selected = spread.enumerate().map(|(at, call)| (call, FAULTS[at % FAULTS.len()]));
            cases.extend(selected.map(|(call, fault)| (Case { scenario, call, fault }, prepared)));
        }
    }
    let (next, failures) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let times = Mutex::new(BTreeMap::<&str, (usize, Duration)>::new());
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(2, usize::from) {
            scope.spawn(|| {
                while let Some((case, prepared)) = cases.get(next.fetch_add(1, Relaxed)) {
                    let since = Instant::now();
                    let failure = inject(&shim, case, prepared);
                    failures.lock().unwrap().extend(failure);
                    let mut times = times.lock().unwrap();
                    let (faults, seconds) = times.entry(case.scenario.name).or_default();
                    (*faults, *seconds) = (*faults + 1, *seconds + since.elapsed());
                }
            });
        }
    });
    let failures = failures.into_inner().unwrap();
    let stderr = format!("{} of {} faults:\n{}", failures.len(), cases.len(), failures.join("\n\n"));
    assert!(failures.is_empty(), "{stderr}");
    assert!(only.is_some() || cases.len() >= if long { 4500 } else { 280 }, "{}", cases.len());
    for (name, (faults, time)) in times.into_inner().unwrap() {
        println!("{name}: {faults} faults in {:.0} s", time.as_secs_f64());
    }
    println!("{} faults", cases.len());
}

/// Without this test, a shim that injects nothing would let the other test pass.
#[test]
fn the_shim_fails_only_the_chosen_call() {
    let shim = match Shim::compile() {
        Ok(shim) => shim,
        Err(reason) => return support::skip_without("the_shim_fails_only_the_chosen_call", &reason),
    };
    let place = folder();
    let written = |call: usize, fault: Fault| -> (Option<i32>, bool) {
        let target: PathBuf = place.path().join("x");
        let _ = fs::remove_file(&target);
        let mut command = Command::new("sh");
        command.args(["-c", "echo one > x"]).current_dir(place.path()).stderr(Stdio::null());
        let ended = shim.disturb(command, call, fault, None).status().unwrap();
        (ended.code(), fs::read(&target).is_ok_and(|bytes| bytes == b"one\n"))
    };
    assert_eq!(written(0, Fault::Full), (Some(0), true));
    let (code, whole) = written(1, Fault::Full);
    assert!(code != Some(0) && !whole, "{code:?}");
    assert_eq!(written(1, Fault::Killed), (None, false));
    assert_eq!(written(1000, Fault::Broken), (Some(0), true));
}
