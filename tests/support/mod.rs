//! Helpers for tests: small configs, a temporary directory in which commands run, and GPU adapters.
#![allow(dead_code, unused_imports, reason = "no test uses all helpers")]

use std::io::Write;

#[cfg(feature = "cli")]
pub use commands::*;
#[cfg(feature = "gpu")]
use flotilla::backend::gpu::device::{self, AdapterChoice, AdapterInfo, Request};
use flotilla::config::{Config, Paradigm};
use flotilla::world::World;

/// A small config that trains in milliseconds.
pub const SMALL: &str = "
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [22, 2], [30, 2]]
pois = [[10, 9], [20, 9]]
coupling = 2
steps = 9
[policy]
hidden = [5]
[learning]
population = 8
generations = 6
trials = 3
";

/// A smaller config, for tests that train many times.
pub const TINY: &str = "\
[world]
leaders = [[10, 5], [20, 5]]
followers = [[12, 2], [22, 2]]
pois = [[10, 9], [20, 9]]
coupling = 2
steps = 8
[policy]
hidden = [3]
[learning]
population = 6
generations = 4
trials = 2
";

/// Returns [`TINY`] with the given number of generations, and with the given lines in a section `[checkpoint]`.
pub fn tiny(generations: usize, checkpoint: &str) -> String {
    format!("{}[checkpoint]\n{checkpoint}\n", TINY.replace("generations = 4", &format!("generations = {generations}")))
}

/// Loads a config of the directory `configs/` by its name.
pub fn layout(name: &str) -> Config {
    let path = format!("{}/configs/{name}.toml", env!("CARGO_MANIFEST_DIR"));
    Config::load(path.as_ref()).unwrap_or_else(|error| panic!("{error}"))
}

/// Returns the worlds of the paper's layouts in both paradigms, with their names.
pub fn papers_worlds() -> Vec<(String, World)> {
    let layouts = ["generally_forward", "strictly_forward", "chaotic"];
    let paradigms = [(Paradigm::LeaderFollower, ""), (Paradigm::AllLeaders, ", all leaders")];
    let pairs = layouts.into_iter().flat_map(|name| paradigms.map(|paradigm| (name, paradigm)));
    pairs
        .map(|(name, (paradigm, suffix))| {
            let mut config = layout(name);
            config.learning.paradigm = paradigm;
            (format!("{}{suffix}", name.replace('_', " ")), World::new(&config))
        })
        .collect()
}

#[cfg(feature = "cli")]
mod commands {
    use std::ffi::{OsStr, OsString};
    use std::fs;
    use std::path::{Path, PathBuf};
    use std::process::{Command, Output};
    use std::time::Duration;

    use assert_cmd::cargo::cargo_bin;
    use tempfile::TempDir;

    /// Returns a command that runs the program. It does not run as a task of a cluster's job, even if this test does.
    pub fn flotilla() -> Command {
        outside_jobs(cargo_bin!("flotilla").as_os_str())
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
}

/// Whether tests run in their long forms, as in `.ci/nightly`.
pub fn is_long() -> bool {
    std::env::var("FLOTILLA_LONG").is_ok_and(|long| long == "1")
}

/// Prints that a test was skipped, and why.
///
/// Writes to the stream, because the output of `eprintln!` is not shown for a passing test.
pub fn skip(test: &str, reason: &str) {
    writeln!(std::io::stderr(), "\n{test}: skipped: {reason}").expect("standard error is writable");
}

/// Prints that a test was skipped because a program of this machine is missing.
///
/// With `FLOTILLA_REQUIRE_TOOLS=1`, as in `.ci/run`, panics instead.
pub fn skip_without(test: &str, reason: &str) {
    let required = std::env::var("FLOTILLA_REQUIRE_TOOLS").is_ok_and(|required| required == "1");
    assert!(!required, "{test}: {reason}, but it is required");
    skip(test, reason);
}

/// Returns whether an edit changes at least one shader, so that a renamed variable is noticed without a GPU.
#[cfg(feature = "gpu")]
pub fn edits_a_shader(edit: fn(String) -> String) -> bool {
    flotilla::backend::gpu::shaders().into_iter().any(|(_, text)| edit(text.clone()) != text)
}

/// Returns every adapter, each with the request that opens it.
///
/// If there is none, prints that the test was skipped. With `FLOTILLA_REQUIRE_GPU=1`, panics instead.
#[cfg(feature = "gpu")]
pub fn adapters(test: &str) -> Vec<(Request, AdapterInfo)> {
    let found = device::adapters();
    if found.is_empty() {
        let set = |name: &str| std::env::var(name).map_or(format!("{name} not set"), |value| format!("{name}={value}"));
        let reason = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES", "WGPU_BACKEND"].map(set).join(", ");
        let reason = format!("no GPU adapter found ({reason})");
        assert!(std::env::var("FLOTILLA_REQUIRE_GPU").as_deref() != Ok("1"), "{test}: {reason}, but one is required");
        skip(test, &reason);
    }
    let request = |index: usize| Request::from(AdapterChoice::Named(index.to_string()));
    found.into_iter().enumerate().map(|(index, info)| (request(index), info)).collect()
}
