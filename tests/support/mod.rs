//! Shared by tests: a folder to run commands in, GPU adapters, and small helpers.
#![allow(dead_code, unused_imports, reason = "no test needs all of it")]

#[cfg(feature = "gpu")]
use std::io::Write;

#[cfg(feature = "cli")]
pub use commands::*;
#[cfg(feature = "gpu")]
use flotilla::backend::gpu::device::{self, AdapterInfo, Request, Wanted};
use flotilla::config::{Config, Paradigm};
use flotilla::world::World;

/// A config that is small and played at once.
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

/// Returns [`TINY`] with another number of generations, and with these keys of `[checkpoint]`.
pub fn tiny(generations: usize, checkpoint: &str) -> String {
    format!("{}[checkpoint]\n{checkpoint}\n", TINY.replace("generations = 4", &format!("generations = {generations}")))
}

/// One of the project's own configs, by its name.
pub fn layout(name: &str) -> Config {
    let path = format!("{}/configs/{name}.toml", env!("CARGO_MANIFEST_DIR"));
    Config::load(path.as_ref()).unwrap_or_else(|error| panic!("{error}"))
}

/// The worlds of the paper's layouts, led and where everyone leads, by name.
pub fn papers_worlds() -> Vec<(String, World)> {
    let layouts = ["generally_forward", "strictly_forward", "chaotic"];
    let paradigms = [(Paradigm::LeaderFollower, ""), (Paradigm::AllLeaders, ", all leaders")];
    let pairs = layouts.into_iter().flat_map(|name| paradigms.map(|paradigm| (name, paradigm)));
    pairs
        .map(|(name, (paradigm, leads))| {
            let mut config = layout(name);
            config.learning.paradigm = paradigm;
            (format!("{}{leads}", name.replace('_', " ")), World::new(&config))
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

    /// The program, as no part of a cluster's job.
    pub fn flotilla() -> Command {
        alone(cargo_bin!("flotilla").as_os_str())
    }

    /// A shell that is to run a script with the program on its path.
    pub fn shell(name: &str, script: &str) -> Command {
        let program = cargo_bin!("flotilla");
        let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap_or_default());
        let mut shell = alone(name.as_ref());
        shell.args(["-c", script]).env("PATH", path);
        shell
    }

    fn alone(program: &OsStr) -> Command {
        let mut command = Command::new(program);
        for name in ["SLURM_ARRAY_TASK_ID", "JOB_COMPLETION_INDEX", "FLOTILLA_SHARDS"] {
            command.env_remove(name);
        }
        command
    }

    /// The words of a command: a line that is split at spaces, or each by itself.
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

    /// A folder where commands run.
    pub struct Place {
        folder: TempDir,
        on_cpu: bool,
    }

    impl Place {
        /// With these files in it, by name and text.
        pub fn new(files: &[(&str, &str)]) -> Place {
            let place = Place { folder: tempfile::tempdir().unwrap(), on_cpu: false };
            files.iter().for_each(|(name, text)| place.write(name, text));
            place
        }

        /// Commands run on the CPU unless they say otherwise; all but `plot` must have `--backend`.
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

        /// Everything in it.
        pub fn names(&self) -> Vec<String> {
            let names = fs::read_dir(self.root()).unwrap().map(|entry| entry.unwrap().file_name());
            let mut names: Vec<_> = names.map(|name| name.to_string_lossy().into_owned()).collect();
            names.sort();
            names
        }

        /// The program in this folder, with nothing to read unless it is given; it is ended if it waits for something.
        pub fn command(&self) -> assert_cmd::Command {
            self.alone(flotilla())
        }

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
            self.alone(shell("bash", script)).output().unwrap()
        }

        fn alone(&self, mut command: Command) -> assert_cmd::Command {
            command.current_dir(self.root());
            let mut command = assert_cmd::Command::from_std(command);
            command.timeout(Duration::from_secs(60));
            command
        }

        /// Standard output and standard error of a command that must succeed.
        pub fn good(&self, words: impl Words) -> (String, String) {
            let words = words.words();
            let output = self.run(&words[..]);
            let told = String::from_utf8(output.stderr).unwrap();
            assert_eq!(output.status.code(), Some(0), "{words:?}: {told}");
            (String::from_utf8(output.stdout).unwrap(), told)
        }

        /// Runs a command that must fail with this code and print nothing, or with `--json` its error as an object. Returns
        /// its error message.
        pub fn refused(&self, code: i32, words: impl Words) -> String {
            let words = words.words();
            let output = self.run(&words[..]);
            let told = String::from_utf8(output.stderr).unwrap();
            assert_eq!(output.status.code(), Some(code), "{words:?}: {told}");
            if words.iter().any(|word| *word == "--json") {
                let object: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
                assert!(object["code"].is_string() && object["message"].is_string(), "{words:?}: {object}");
            } else {
                assert!(output.stdout.is_empty(), "{words:?}");
            }
            assert!(told.contains("error: ") && !told.contains("panicked"), "{words:?}: {told}");
            told
        }
    }
}

/// Every adapter, each with the request that opens it.
///
/// Without any, the test is skipped in plain sight, or fails where `FLOTILLA_REQUIRE_GPU=1` says that a GPU is needed.
#[cfg(feature = "gpu")]
pub fn adapters(test: &str) -> Vec<(Request, AdapterInfo)> {
    let found = device::adapters();
    if found.is_empty() {
        let set = |name: &str| std::env::var(name).map_or(format!("{name} not set"), |value| format!("{name}={value}"));
        let reason = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES", "WGPU_BACKEND"].map(set).join(", ");
        let message = format!("{test}: skipped: no GPU adapter found ({reason})");
        assert!(std::env::var("FLOTILLA_REQUIRE_GPU").as_deref() != Ok("1"), "{message}, but one is required");
        // Straight to the stream: what a passing test prints by macro is not shown.
        writeln!(std::io::stderr(), "\n{message}").expect("standard error takes a line");
    }
    let request = |index: usize| Request::from(Wanted::Named(index.to_string()));
    found.into_iter().enumerate().map(|(index, info)| (request(index), info)).collect()
}
