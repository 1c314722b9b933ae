//! The command line. Each command has a file of its own, and this module contains what they share.
//!
//! A command's file contains `Args` (its flags) and `run(Args) -> Result<(), Error>`. The list `commands!` below names
//! it.

use std::ffi::OsString;
use std::fmt::Display;
use std::io::{self, Write};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::{LazyLock, OnceLock};

use clap::builder::PossibleValuesParser as Words;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use serde::Serialize;

use crate::backend::BackendError;
use crate::backend::gpu::device::DeviceError;
use crate::config::{self, Choice, Config, ConfigError, Fitness, Override, Paradigm};
use crate::escape;
use crate::file;
use crate::reader::Document;
use crate::record::RecordError;
use crate::report::replay::ReplayError;
use crate::run::RunError;
use crate::sweep::questions::Unanswered;

mod backend;
mod baseline;
mod bench;
mod check;
mod compare;
mod completions;
mod devices;
mod init;
mod layout;
mod man;
mod output;
mod paper;
mod plot;
mod points;
mod process;
mod questions;
mod recovery;
mod remedy;
mod replay;
mod rollout;
mod sweep;
mod train;
mod verify;
mod warnings;

/// Declares the commands, each with its file, and runs the one that was typed.
macro_rules! commands {
    ($($(#[$doc:meta])* $name:ident($file:ident),)*) => {
        /// What to do.
        #[derive(Subcommand)]
        enum Command {
            $($(#[$doc])* $name($file::Args),)*
        }

        impl Command {
            fn run(self) -> Result<(), Error> {
                match self { $(Command::$name(args) => $file::run(args),)* }
            }
        }
    };
}

commands! {
    /// Write a commented config to start from.
    Init(init),
    /// Check a config; print it with every value written out, and the cost of a run.
    Check(check),
    /// Train the teams of a config, and save what they learned.
    Train(train),
    /// Play what needs no learning: constant actions and random teams.
    Baseline(baseline),
    /// Play teams of given policies without training, and score every leader.
    Rollout(rollout),
    /// Train all of the paper's experiments, draw its figures and check its claims.
    Paper(paper),
    /// Draw the learning curves of one run, or of several side by side.
    Plot(plot),
    /// Compare runs, or the points of a sweep along an axis, with intervals and tests.
    Compare(compare),
    /// Play a team of a trial and generation again, as a page or a picture.
    Replay(replay),
    /// Measure how fast teams are played, alone and in whole generations.
    Bench(bench),
    /// Compare every GPU with the CPU, bit for bit.
    Verify(verify),
    /// List the processors and GPUs to train on.
    Devices(devices),
    /// Train every point of a grid side by side, on one machine or many.
    Sweep(sweep),
    /// Print a shell completion script.
    Completions(completions),
    /// Write manual pages.
    Man(man),
}

/// Trains cooperative teams by coevolution on any GPU, with the same bits on a CPU.
#[derive(Parser)]
#[command(name = "flotilla", version, long_version = VERSION.as_str(), arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

/// Text of `--version`: the version, and the commit and target of the build.
static VERSION: LazyLock<String> = LazyLock::new(|| {
    let commit = crate::COMMIT.unwrap_or("not recorded");
    format!("{}\ncommit  {commit}\ntarget  {}", env!("CARGO_PKG_VERSION"), env!("FLOTILLA_TARGET"))
});

/// The command line, program name first, if it differs from the process's own arguments.
static WORDS: OnceLock<Vec<OsString>> = OnceLock::new();

/// Returns the command line, program name first.
fn words() -> Vec<OsString> {
    WORDS.get().cloned().unwrap_or_else(|| std::env::args_os().collect())
}

/// Returns the program's path, for commands that start more processes.
fn program() -> PathBuf {
    let named = WORDS.get().and_then(|words| words.first()).map(PathBuf::from);
    named.or_else(|| std::env::current_exe().ok()).unwrap_or_else(|| "flotilla".into())
}

/// Sets the process up, runs the command, reports its error, and returns the exit code. If clap rejects the command
/// line, the process exits here with code 2.
///
/// `words` replaces the process's own arguments, with the program's name first. Only the `words` of the first call are
/// used.
pub fn main(words: Option<Vec<OsString>>) -> u8 {
    if let Some(words) = words {
        WORDS.get_or_init(|| words);
    }
    match process::set_up().and_then(|()| run()) {
        Ok(()) => 0,
        Err(error) => {
            let word = if matches!(error, Error::Stopped(_)) { "stopped" } else { "error" };
            say(format_args!("{word}: {error}"));
            error.exit_code()
        }
    }
}

fn run() -> Result<(), Error> {
    let words = words();
    reject_control_chars(words.iter().skip(1).cloned())?;
    let matches = command().try_get_matches_from(words).unwrap_or_else(|error| hinted(error).exit());
    let typed = Cli::from_arg_matches(&matches);
    match typed.unwrap_or_else(|error| error.format(&mut command()).exit()).command {
        Command::Paper(args) if !args.questions.is_empty() => questions::run(&args),
        command => command.run(),
    }
}

/// Removes clap's advice to pass an unknown flag as a value, which does not apply to any command. Suggests `--team` in
/// place of `--champion` and `--best`.
fn hinted(mut error: clap::Error) -> clap::Error {
    if error.kind() == ErrorKind::UnknownArgument {
        error.remove(ContextKind::Suggested);
        let unknown = error.get(ContextKind::InvalidArg).map(ToString::to_string);
        if let Some(flag @ ("--champion" | "--best")) = unknown.as_deref() {
            let meant = format!("--team {}", flag.trim_start_matches('-'));
            error.insert(ContextKind::SuggestedArg, ContextValue::String(meant));
        }
    }
    error
}

/// Returns the definition of the command line, without parsing or running anything.
pub fn command() -> clap::Command {
    // A negative number is a value, even if an invalid one, and not a flag.
    Cli::command().mut_subcommands(|command| {
        command.mut_args(|arg| match arg.get_long().is_some() && arg.get_action().takes_values() {
            true => arg.allow_negative_numbers(true),
            false => arg,
        })
    })
}

/// Parses a number for a config key, and returns it as TOML. The config checks its range.
fn number(text: &str) -> Result<String, String> {
    let digits = text.strip_prefix(['-', '+']).unwrap_or(text);
    // Whole numbers do not become floats, which would lose digits. Those too large for TOML stay as typed.
    match !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit()) {
        true => Ok(text.parse::<i64>().map_or(text.into(), |number| number.to_string())),
        false => real(text).map(|number| toml::Value::from(number).to_string()),
    }
}

/// Parses a whole number, from 0.
fn whole(text: &str) -> Result<usize, String> {
    text.parse().map_err(|_| "allowed a whole number, from 0".into())
}

/// Returns a parser of whole numbers in a range.
fn between<T>(allowed: RangeInclusive<T>) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync
where
    T: FromStr + PartialOrd + Display + Clone + Send + Sync,
{
    move |text| {
        let number = text.parse().ok().filter(|number| allowed.contains(number));
        number.ok_or_else(|| format!("allowed a whole number from {} to {}", allowed.start(), allowed.end()))
    }
}

/// Parses a number.
fn real(text: &str) -> Result<f64, String> {
    text.parse().map_err(|_| "allowed a number".into())
}

/// Rejects names and values with control characters, such as line breaks and escape sequences. Nothing needs them, and
/// in a script, a table or a terminal they could act as something else than a name.
fn reject_control_chars(words: impl Iterator<Item = OsString>) -> Result<(), Error> {
    for word in words {
        if word.to_string_lossy().contains(escape::is_control) {
            return Err(Error::Usage(format!(
                "'{}' holds a line break or another control character, which no name or value may have",
                escape::line(&word.to_string_lossy())
            )));
        }
    }
    Ok(())
}

/// The error of a command.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A config that cannot be read or is invalid.
    #[error("{}{}", .0, remedy::config(.0))]
    Config(#[from] ConfigError),
    /// Episodes that could not be played.
    #[error("{}{}", .0, remedy::backend(.0))]
    Backend(#[from] BackendError),
    /// A GPU that could not be opened, or that failed.
    #[error("{}{}", .0, remedy::device(.0))]
    Device(#[from] DeviceError),
    /// There is no GPU to compare with the CPU.
    #[error("{0}; --report FILE without --adapter compares the instruction sets of the processor alone")]
    NoneToVerify(DeviceError),
    /// Files of runs that could not be written, read or used.
    #[error("{}{}", .0, remedy::record(.0, "run it again"))]
    Record(#[from] RecordError),
    /// A run that could not continue.
    #[error("{}{}", .0, remedy::run(.0))]
    Run(#[from] RunError),
    /// A run that could not be read to show it.
    #[error("{}{}", .0, remedy::shown(.0))]
    Shown(#[from] crate::report::runs::ReadError),
    /// A question that could not be answered.
    #[error(transparent)]
    Unanswered(#[from] Unanswered),
    /// An episode that could not be replayed.
    #[error("{}{}", .0, remedy::replayed(.0))]
    Replayed(#[from] ReplayError),
    /// Results that could not be printed.
    #[error("standard output cannot be written: {0}")]
    Output(io::Error),
    /// Signal handlers that could not be installed.
    #[error("signals cannot be listened for: {0}")]
    Signals(io::Error),
    /// Wrong usage that is only found when flags are read together.
    #[error("{0}")]
    Usage(String),
    /// Results that differ but should be equal.
    #[error("{0}")]
    Different(String),
    /// A command that is refused, for example because it would overwrite files.
    #[error("{0}")]
    Refused(String),
    /// Results that do not exist yet.
    #[error("{0}")]
    Missing(String),
    /// Stopped by a signal. Runs are saved and can be resumed.
    #[error("{0}")]
    Stopped(String),
}

impl Error {
    /// Returns the process's exit code: 1 for a failure, 2 for wrong usage, 75 if stopped and ready to be resumed.
    ///
    /// A flag's value that does not fit the file or the machine is wrong usage, too. If the file is also invalid, the
    /// code is 1.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Usage(_)
            | Error::Device(DeviceError::UnknownAdapter { .. })
            | Error::NoneToVerify(DeviceError::UnknownAdapter { .. })
            | Error::Record(RecordError::NoTrial { .. })
            | Error::Replayed(
                ReplayError::NoTrial { .. } | ReplayError::NoGeneration { .. } | ReplayError::NoTeam { .. },
            ) => 2,
            Error::Config(error) if error.is_usage() => 2,
            Error::Stopped(_) => 75,
            _ => 1,
        }
    }
}

/// Prints a message to standard error, with control characters escaped. A failure is ignored, because there is no other
/// place to report it.
pub fn say(text: impl Display) {
    let _ = writeln!(io::stderr(), "{}", escape::lines(&text.to_string()));
}

/// Prints a result to standard output, with control characters escaped. A reader that closes the pipe early (`| head`)
/// causes no error.
///
/// # Errors
/// Fails if standard output cannot be written, for example because the disk is full.
pub fn print(text: &str) -> Result<(), Error> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(escape::lines(text).as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(Error::Output(error)),
        _ => Ok(()),
    }
}

/// Prints a result as one line of JSON to standard output. Control characters are written as JSON escapes, so that
/// every reader gets the same text back.
///
/// # Errors
/// Fails if standard output cannot be written, for example because the disk is full.
pub fn print_json(value: &impl Serialize) -> Result<(), Error> {
    let text = serde_json::to_string(value).expect("numbers, texts and lists of them are JSON");
    print(&(escape::json(&text).into_owned() + "\n"))
}

const IN_CONFIG: &str = "Config overrides";
const WHERE: &str = "Where to run (the results are the same)";

/// A config file.
#[derive(clap::Args)]
pub struct ConfigFile {
    /// Config file (TOML), or - for standard input
    #[arg(value_name = "CONFIG")]
    pub path: PathBuf,
}

impl ConfigFile {
    /// Loads the config, with the keys that a command's own flags set.
    ///
    /// # Errors
    /// Fails if the file cannot be read, or if it or a flag is invalid. The error lists the problems.
    pub fn load(&self, overrides: &[Override]) -> Result<Config, Error> {
        Ok(self.load_noted(overrides)?.0)
    }

    /// Loads the config as [`ConfigFile::load`] does, and returns notes for its author.
    fn load_noted(&self, overrides: &[Override]) -> Result<(Config, Vec<String>), Error> {
        let text = config::read_file(&self.path)?;
        Ok(Config::read_noted(&Document::parse(&text), &config::name(&self.path), &[], overrides)?)
    }
}

/// A config file and the flags that change it.
#[derive(clap::Args)]
pub struct ConfigArgs {
    /// The file.
    #[command(flatten)]
    pub file: ConfigFile,
    /// The flags.
    #[command(flatten)]
    pub overrides: Overrides,
}

impl ConfigArgs {
    /// Returns the file's name without folder and extension, or `config` for standard input.
    pub fn name(&self) -> String {
        match &self.file.path {
            path if config::is_standard_input(path) => "config".into(),
            path => file::stem(path, "config"),
        }
    }

    /// Loads the config, with the keys that the flags and `more` set. Prints the notes for its author, and returns them
    /// as well.
    ///
    /// # Errors
    /// Fails if the file cannot be read, or if it or a flag is invalid. The error lists the problems.
    pub fn load(&self, more: Vec<Override>) -> Result<(Config, Vec<String>), Error> {
        let (config, notes) = self.file.load_noted(&[self.overrides.list(), more].concat())?;
        notes.iter().for_each(|note| say(format_args!("note: {note}")));
        Ok((config, notes))
    }
}

/// Flags that stand for config keys; their ranges are checked with the config.
#[derive(clap::Args, Default)]
pub struct Overrides {
    /// Random seed
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub seed: Option<String>,
    /// Independent repetitions
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub trials: Option<String>,
    /// Generations after generation 0, which is random
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub generations: Option<String>,
    /// Policies per population, and teams per generation
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub population: Option<String>,
    /// Score that policies are selected by
    #[arg(long, help_heading = IN_CONFIG, value_name = "NAME", value_parser = Words::new(Fitness::names()), ignore_case = true)]
    pub fitness: Option<String>,
    /// Who learns
    #[arg(long, help_heading = IN_CONFIG, value_name = "NAME", value_parser = Words::new(Paradigm::names()), ignore_case = true)]
    pub paradigm: Option<String>,
    /// Any key of the config, as world.steps=60; may be given more than once
    #[arg(long, help_heading = IN_CONFIG, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<Override>,
}

/// Parses `KEY=VALUE`. The value is TOML or a word.
fn assignment(text: &str) -> Result<Override, String> {
    let (key, value) = text.split_once('=').ok_or("allowed KEY=VALUE, as world.steps=60")?;
    let (key, value) = (key.trim(), value.trim());
    let is_toml = format!("value = {value}").parse::<toml::Table>().is_ok();
    let text = if is_toml { value.to_string() } else { toml::Value::from(value).to_string() };
    Ok(Override { key: key.into(), text, name: format!("--set {key}") })
}

/// Returns the spelling in `names` of a word typed in any case. An unknown word stays as typed.
fn canonical(mut names: impl Iterator<Item = &'static str>, typed: &str) -> toml::Value {
    match names.find(|name| name.eq_ignore_ascii_case(typed)) {
        Some(name) => name.into(),
        None => typed.into(),
    }
}

impl Overrides {
    /// Returns the keys that were set, each with its flag as its name in errors.
    pub fn list(&self) -> Vec<Override> {
        let Overrides { seed, trials, generations, population, fitness, paradigm, set: given } = self;
        let numbers = [("seed", seed), ("trials", trials), ("generations", generations), ("population", population)]
            .map(|(name, value)| (name, value.clone()));
        let fitness = fitness.as_ref().map(|typed| canonical(Fitness::names(), typed));
        let paradigm = paradigm.as_ref().map(|typed| canonical(Paradigm::names(), typed));
        let words = [("fitness", fitness), ("paradigm", paradigm)]
            .map(|(name, value)| (name, value.map(|value| value.to_string())));
        let set = |(name, value): (&str, Option<String>)| {
            Some(Override::of_text(format!("learning.{name}"), value?, format!("--{name}")))
        };
        numbers.into_iter().chain(words).filter_map(set).chain(given.iter().cloned()).collect()
    }
}

/// What to run on.
#[derive(clap::Args, Clone, Debug)]
pub struct RunOptions {
    /// Processor
    #[arg(long, help_heading = WHERE, value_enum, default_value_t = BackendChoice::Auto)]
    pub backend: BackendChoice,
    /// GPU of this number in `flotilla devices`, or whose name contains this; also one that is a software renderer
    #[arg(long, help_heading = WHERE, value_name = "NAME")]
    pub adapter: Option<String>,
    /// Where populations are kept and the next generation is bred
    #[arg(long, help_heading = WHERE, value_enum, default_value_t = Breed::Auto)]
    pub breed: Breed,
    /// CPU threads [default: all]
    #[arg(long, help_heading = WHERE, value_name = "N", value_parser = between(1..=1024u16))]
    pub threads: Option<u16>,
}

/// Which kind of processor plays the episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BackendChoice {
    /// A GPU where there is one, else the CPU
    Auto,
    /// All cores, or `--threads`
    Cpu,
    /// A GPU, or fail; a software renderer is none, and taken only by --adapter
    Gpu,
}

/// Where populations are kept between generations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Breed {
    /// With a GPU, in its memory from 1 MiB a trial on and where they fit (an estimate, not measured); else in the
    /// host's
    Auto,
    /// In the host's memory
    Host,
    /// In the GPU's memory, or fail
    Device,
}
