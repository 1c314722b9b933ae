//! Helpers for tests: commands, a temporary directory in which they run, and training in the test's own process.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::time::Duration;

use assert_cmd::cargo::cargo_bin;
use flotilla::backend::{BackendError, OpenBackend};
use flotilla_app::run::{Options, RunError, Session, SessionEnd};
use tempfile::TempDir;

/// Returns the path of a file in the checkout.
pub fn root(path: &str) -> PathBuf {
    Path::new(crate::ROOT).join(path)
}

/// Returns a command that runs the program at the root of the checkout. It does not run as a task of a cluster's job, even if this test does.
pub fn flotilla() -> Command {
    let mut command = outside_jobs(cargo_bin!("flotilla").as_os_str());
    command.current_dir(crate::ROOT);
    command
}

/// Returns a command that runs a script with a shell. `flotilla` is on its path.
pub fn shell(name: &str, script: &str) -> Command {
    let program = cargo_bin!("flotilla");
    let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap_or_default());
    let mut shell = outside_jobs(name.as_ref());
    shell.args(["-c", script]).env("PATH", path);
    shell
}

/// Removes the variables from which the program would take a shard.
fn outside_jobs(program: &OsStr) -> Command {
    let mut command = Command::new(program);
    for name in ["SLURM_ARRAY_TASK_ID", "JOB_COMPLETION_INDEX", "FLOTILLA_SHARDS"] {
        command.env_remove(name);
    }
    command
}

/// Arguments of a command: a line to be split at spaces, or a list.
pub trait Words {
    fn words(self) -> Vec<OsString>;
}

impl Words for &str {
    fn words(self) -> Vec<OsString> {
        self.split_whitespace().map(OsString::from).collect()
    }
}

impl Words for &String {
    fn words(self) -> Vec<OsString> {
        self.as_str().words()
    }
}

impl<T: AsRef<OsStr>, const N: usize> Words for &[T; N] {
    fn words(self) -> Vec<OsString> {
        self[..].words()
    }
}

impl<T: AsRef<OsStr>> Words for &Vec<T> {
    fn words(self) -> Vec<OsString> {
        self[..].words()
    }
}

impl<T: AsRef<OsStr>> Words for &[T] {
    fn words(self) -> Vec<OsString> {
        self.iter().map(OsString::from).collect()
    }
}

/// A temporary directory in which commands run.
pub struct Place {
    folder: TempDir,
    on_cpu: bool,
}

impl Place {
    /// Makes a directory with files, given as names and texts.
    pub fn new(files: &[(&str, &str)]) -> Place {
        let place = Place { folder: tempfile::tempdir().unwrap(), on_cpu: false };
        files.iter().for_each(|(name, text)| place.write(name, text));
        place
    }

    /// Makes all commands use the CPU: adds `--backend cpu` unless a command has `--backend` or is `plot`.
    pub fn on_cpu(self) -> Place {
        Place { on_cpu: true, ..self }
    }

    pub fn root(&self) -> &Path {
        self.folder.path()
    }

    pub fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        self.root().join(name)
    }

    pub fn read(&self, name: impl AsRef<Path>) -> String {
        fs::read_to_string(self.path(&name)).unwrap_or_else(|error| panic!("{}: {error}", name.as_ref().display()))
    }

    pub fn write(&self, name: impl AsRef<Path>, text: impl AsRef<[u8]>) {
        fs::write(self.path(name), text).unwrap();
    }

    /// Returns the sorted names of the directory's entries.
    pub fn names(&self) -> Vec<String> {
        let names = fs::read_dir(self.root()).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<_> = names.map(|name| name.to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Returns a command that runs the program here. Its standard input is empty. It is killed after a minute.
    pub fn command(&self) -> assert_cmd::Command {
        self.here(flotilla())
    }

    /// Runs the program with the given arguments.
    pub fn run(&self, words: impl Words) -> Output {
        let mut words = words.words();
        let plays = words.first().is_some_and(|command| command != "plot");
        if self.on_cpu && plays && !words.iter().any(|word| word == "--backend") {
            words.extend(["--backend".into(), "cpu".into()]);
        }
        self.command().args(words).output().unwrap()
    }

    /// Runs a script with `bash`.
    pub fn shell(&self, script: &str) -> Output {
        self.here(shell("bash", script)).output().unwrap()
    }

    fn here(&self, mut command: Command) -> assert_cmd::Command {
        command.current_dir(self.root());
        let mut command = assert_cmd::Command::from_std(command);
        command.timeout(Duration::from_secs(60));
        command
    }

    /// Runs a command that must succeed. Returns its standard output and standard error.
    pub fn good(&self, words: impl Words) -> (String, String) {
        let words = words.words();
        let output = self.run(&words[..]);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{words:?}: {stderr}");
        (String::from_utf8(output.stdout).unwrap(), stderr)
    }

    /// Runs a command that must fail with this exit code. Its standard output must be empty, or with `--json` have
    /// the error as an object. Returns its error message.
    pub fn refused(&self, code: i32, words: impl Words) -> String {
        let words = words.words();
        let output = self.run(&words[..]);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{words:?}: {stderr}");
        if words.iter().any(|word| *word == "--json") {
            let object: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
            assert!(object["code"].is_string() && object["message"].is_string(), "{words:?}: {object}");
        } else {
            assert!(output.stdout.is_empty(), "{words:?}");
        }
        assert!(stderr.contains("error: ") && !stderr.contains("panicked"), "{words:?}: {stderr}");
        stderr
    }
}

/// Trains until the runs are finished, or until `stops` returns true for the generations that they play next.
/// `fallback` may return another backend after one failed.
pub fn train(
    session: &mut Session,
    mut backend: OpenBackend,
    fallback: &mut dyn FnMut(&BackendError) -> Option<OpenBackend>,
    stops: &mut dyn FnMut(&[usize]) -> bool,
) -> Result<SessionEnd, RunError> {
    let (stop, save) = (AtomicBool::new(false), AtomicBool::new(false));
    let mut options = Options {
        command: "",
        stop: &stop,
        save: &save,
        fallback,
        watch: &mut |now| stop.store(stops(now.generations), SeqCst),
    };
    session.train(&mut backend, &mut options)
}
