//! Shared by the commands that train recorded runs: flags, signals, and reports of failing devices.

use std::ffi::OsString;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::ValueEnum;

use super::{Error, RunOptions, number};
use flotilla::config::Override;
use flotilla_app::shell;

/// How often runs are saved. Overrides the config.
#[derive(clap::Args)]
pub struct Checkpoints {
    /// Write a checkpoint every N generations; 0 means never
    #[arg(long, value_name = "N", value_parser = number)]
    checkpoint_generations: Option<String>,
    /// Write a checkpoint every S seconds; 0 means never
    #[arg(long, value_name = "S", value_parser = number)]
    checkpoint_seconds: Option<String>,
}

impl Checkpoints {
    /// Returns the keys that were set, each with its flag as its name in errors.
    pub fn list(&self) -> Vec<Override> {
        let Checkpoints { checkpoint_generations, checkpoint_seconds } = self;
        let set = |(name, value): (&str, &Option<String>)| {
            Some(Override::of_text(format!("checkpoint.{name}"), value.clone()?, format!("--checkpoint-{name}")))
        };
        [("generations", checkpoint_generations), ("seconds", checkpoint_seconds)].into_iter().filter_map(set).collect()
    }
}

/// Returns the flags that set config keys, as typed.
pub fn words_of(overrides: &[Override]) -> impl Iterator<Item = OsString> {
    overrides.iter().flat_map(|set| match set.name.split_once(' ') {
        Some((flag, key)) => [flag.into(), format!("{key}={}", set.text).into()],
        None => [set.name.clone().into(), set.text.trim_matches(['"', '\'']).into()],
    })
}

/// Returns the flags that choose what to run on, as typed, without those at their defaults.
pub fn words_of_machine(run: &RunOptions) -> Vec<OsString> {
    fn word<T: ValueEnum + PartialEq>(value: T, default: T) -> Option<String> {
        (value != default).then(|| value.to_possible_value()).flatten().map(|value| value.get_name().to_string())
    }
    let RunOptions { backend, adapter, breed, threads } = run.clone();
    let flags = [
        ("--backend", word(backend, super::BackendChoice::Auto)),
        ("--adapter", adapter),
        ("--breed", word(breed, super::Breed::Auto)),
        ("--threads", threads.map(|threads| threads.to_string())),
    ];
    let words = |(flag, value): (&str, Option<String>)| match value? {
        // As a separate word it would be read as a flag.
        value if value.starts_with('-') => Some(vec![format!("{flag}={value}").into()]),
        value => Some(vec![flag.into(), value.into()]),
    };
    flags.into_iter().filter_map(words).flatten().collect()
}

/// Quotes a path as an argument in a shell.
pub fn quoted(path: &Path) -> String {
    shell::quoted(shell::argument(path))
}

/// Maximum number of characters of a command line that are kept.
const MAX_LINE: usize = 1 << 13;

/// Returns the command line, quoted for a shell.
pub fn command_line() -> String {
    let line = shell::command(super::words());
    match line.char_indices().nth(MAX_LINE) {
        Some((end, _)) => format!("{} …", &line[..end]),
        None => line,
    }
}

/// Flags that signals set.
#[derive(Default)]
pub struct Signals {
    /// Set if the run should save and stop.
    pub stop: Arc<AtomicBool>,
    /// Set if the run should save and continue.
    pub save: Arc<AtomicBool>,
}

impl Signals {
    /// Installs the signal handlers. SIGINT, SIGTERM and, unless it is ignored as under `nohup`, SIGHUP set `stop`.
    /// SIGUSR1 sets `save`.
    ///
    /// A SIGINT after any of the first three ends the process at once, because a person who presses Ctrl-C again does not
    /// want to wait. Another SIGTERM changes nothing: batch systems send it to a script and to its processes, and to
    /// these twice at a time limit.
    pub fn listen() -> Result<Signals, Error> {
        use signal_hook::consts::{SIGINT, SIGTERM};
        use signal_hook::flag;
        let signals = Signals { stop: Arc::default(), save: Arc::default() };
        let listen = || -> io::Result<()> {
            flag::register_conditional_shutdown(SIGINT, 128 + SIGINT, signals.stop.clone())?;
            for signal in [SIGINT, SIGTERM] {
                flag::register(signal, signals.stop.clone())?;
            }
            #[cfg(unix)]
            {
                use signal_hook::consts::{SIGHUP, SIGUSR1};
                if hangup_ends() {
                    flag::register(SIGHUP, signals.stop.clone())?;
                }
                flag::register(SIGUSR1, signals.save.clone())?;
            }
            Ok(())
        };
        listen().map_err(Error::Signals)?;
        Ok(signals)
    }
}

/// Reports whether SIGHUP, which a closed terminal sends, would end this process. Elsewhere than on Linux this is not
/// known, so that the signal keeps its usual effect.
#[cfg(unix)]
fn hangup_ends() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    // Signal 1 is the lowest bit.
    ignored.and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok()).is_some_and(|bits| bits & 1 == 0)
}
