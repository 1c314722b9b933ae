//! Helpers for tests: commands, a temporary directory in which they run, and training in the test's own process.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::time::Duration;

use assert_cmd::cargo::cargo_bin;
use flotilla::backend::{BackendError, OpenBackend};
use flotilla_app::record::folder::{METRICS, POLICIES};
use flotilla_app::run::{Options, RunError, Session, SessionEnd};
use serde_json::Value;
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
    limit: Duration,
}

impl Place {
    /// Makes a directory with files, given as names and texts.
    pub fn new(files: &[(&str, &str)]) -> Place {
        let limit = Duration::from_secs(60);
        let place = Place { folder: tempfile::tempdir().unwrap(), on_cpu: false, limit };
        files.iter().for_each(|(name, text)| place.write(name, text));
        place
    }

    /// Makes all commands use the CPU: adds `--backend cpu` to every command that has the flag and does not set it.
    pub fn on_cpu(self) -> Place {
        Place { on_cpu: true, ..self }
    }

    /// Gives each command an hour instead of a minute.
    pub fn slow(self) -> Place {
        Place { limit: Duration::from_secs(3600), ..self }
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

    pub fn bytes(&self, name: impl AsRef<Path>) -> Vec<u8> {
        fs::read(self.path(&name)).unwrap_or_else(|error| panic!("{}: {error}", name.as_ref().display()))
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

    /// Returns a command that runs the program here. Its standard input is empty. It is killed after a minute, unless
    /// the place is [`slow`](Self::slow).
    pub fn command(&self) -> assert_cmd::Command {
        self.here(flotilla())
    }

    /// Runs the program with the given arguments.
    pub fn run(&self, words: impl Words) -> Output {
        let mut words = words.words();
        if self.on_cpu && has_backend(&words) && !words.iter().any(|word| word == "--backend") {
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
        command.timeout(self.limit);
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
            let object: Value = serde_json::from_slice(&output.stdout).unwrap();
            assert!(object["code"].is_string() && object["message"].is_string(), "{words:?}: {object}");
        } else {
            assert!(output.stdout.is_empty(), "{words:?}");
        }
        assert!(stderr.contains("error: ") && !stderr.contains("panicked"), "{words:?}: {stderr}");
        stderr
    }

    /// Runs a command that [`Self::good`] accepts. Its standard output must contain all of `parts`, and is returned.
    pub fn prints(&self, words: impl Words, parts: &[&str]) -> String {
        let words = words.words();
        containing(self.good(&words).0, parts, &words)
    }

    /// Runs a command that [`Self::good`] accepts. Its standard error must contain all of `parts`, and is returned.
    pub fn notes(&self, words: impl Words, parts: &[&str]) -> String {
        let words = words.words();
        containing(self.good(&words).1, parts, &words)
    }

    /// Runs a command that [`Self::refused`] accepts. Its error message must contain all of `parts`, and is returned.
    pub fn fails(&self, code: i32, words: impl Words, parts: &[&str]) -> String {
        let words = words.words();
        containing(self.refused(code, &words), parts, &words)
    }

    /// Runs a script with `bash`, which must end with this exit code. Its standard error must contain all of `parts`, and
    /// is returned.
    pub fn script(&self, code: i32, script: &str, parts: &[&str]) -> String {
        let output = self.shell(script);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{script}: {:?}: {stderr}", output.status);
        containing(stderr, parts, &[script.into()])
    }

    /// Runs a command that [`Self::good`] accepts. Returns the JSON value on its standard output.
    pub fn json(&self, words: impl Words) -> Value {
        serde_json::from_str(&self.good(words).0).unwrap()
    }
}

/// Reports whether the command has the flag `--backend`.
fn has_backend(words: &[OsString]) -> bool {
    let program = flotilla_cli::command();
    let command = words.first().and_then(|name| program.find_subcommand(name));
    command.is_some_and(|command| command.get_arguments().any(|flag| flag.get_long() == Some("backend")))
}

/// Returns a text that must contain all of `parts`.
fn containing(text: String, parts: &[&str], words: &[OsString]) -> String {
    for part in parts {
        assert!(text.contains(part), "{words:?}: {part:?} is not in: {text}");
    }
    text
}

/// Returns every file below a folder by its path in the folder. Links are not followed into folders.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).unwrap().map(Result::unwrap) {
            let (path, kind) = (entry.path(), entry.file_type().unwrap());
            if kind.is_dir() {
                folders.push(path);
            } else {
                let bytes = fs::read(&path);
                // A link may lead to a folder, or to nothing.
                let bytes = if kind.is_symlink() { bytes.unwrap_or_default() } else { bytes.unwrap() };
                files.insert(path.strip_prefix(folder).unwrap().into(), bytes);
            }
        }
    }
    files
}

/// Copies a folder with everything in it.
pub fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy(&entry.path(), &to),
            false => drop(fs::copy(entry.path(), to).unwrap()),
        }
    }
}

/// Returns the data of a replay page.
pub fn page_data(page: &Path) -> Value {
    let page = fs::read_to_string(page).unwrap();
    let (_, data) = page.split_once("id=\"data\">").unwrap();
    serde_json::from_str(data.split_once("</script>").unwrap().0).unwrap()
}

/// Returns the cells of a run's metrics by row, without the column of seconds, which differs between equal runs.
pub fn metrics_without_seconds(run: &Path) -> Vec<Vec<String>> {
    let text = fs::read_to_string(run.join(METRICS)).unwrap();
    let seconds = text.lines().next().and_then(|header| header.split(',').position(|name| name == "seconds"));
    let row = |line: &str| {
        let cells = line.split(',').enumerate().filter(|(column, _)| Some(*column) != seconds);
        cells.map(|(_, cell)| cell.to_string()).collect()
    };
    text.lines().map(row).collect()
}

/// Returns what equal runs have in common: their metrics without seconds, and their policies.
pub fn results(run: &Path) -> (Vec<Vec<String>>, Vec<u8>) {
    (metrics_without_seconds(run), fs::read(run.join(POLICIES)).unwrap())
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
