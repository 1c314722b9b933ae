//! The command line. Each command has a file of its own, and this module contains what they share.
//!
//! A command's file contains `Args` (its flags) and `run(Args) -> Result<(), Error>`. The list `commands!` below names
//! it.

#![allow(rustdoc::private_intra_doc_links, reason = "tables of modules name the internal ones, too")]

use std::ffi::OsString;
use std::fmt::Display;
use std::io::{self, Write};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{LazyLock, OnceLock};

use clap::builder::PossibleValuesParser as Words;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use serde::Serialize;

use flotilla::config::{self, Choice, Fitness, Override, Paradigm};
use flotilla::escape;
use flotilla::file;
use flotilla::host::MAX_THREADS;
use flotilla_app::ops::ConfigText;
pub use flotilla_app::ops::{Error, ProcessorInfo, with_remedy};
use flotilla_app::record::folder::Start;

mod backend;
mod baseline;
mod bench;
mod check;
mod compare;
mod completions;
mod console;
mod devices;
mod import;
mod init;
mod layout;
mod man;
pub mod measure;
mod paper;
mod plot;
mod process;
mod progress;
mod recovery;
mod replay;
pub mod request;
mod rollout;
mod sweep;
mod tasks;
mod train;
mod verify;

/// Declares the commands, each with its file, and runs the one that was typed. Help lists them by group.
macro_rules! commands {
    ($($group:literal { $($(#[$doc:meta])* $name:ident($file:ident),)* })*) => {
        /// A command with its flags.
        #[derive(Subcommand)]
        enum Command {
            $($($(#[$doc])* $name($file::Args),)*)*
        }

        impl Command {
            fn run(self) -> Result<(), Error> {
                match self { $($(Command::$name(args) => $file::run(args),)*)* }
            }
        }

        /// The names of the commands by group, with a capital.
        const GROUPS: &[(&str, &[&str])] = &[$(($group, &[$(stringify!($name)),*])),*];
    };
}

commands! {
    "Design an experiment" {
        /// Write a commented config to start from.
        Init(init),
        /// Translate a config of the authors' programs.
        Import(import),
        /// Check a config, and show its values, cost and layout.
        Check(check),
        /// Score teams that need no learning.
        Baseline(baseline),
    }
    "Train" {
        /// Train teams, and save what they learned.
        Train(train),
        /// Train a grid of configs, on one machine or a cluster.
        Sweep(sweep),
        /// Train the paper's experiments, and check its claims.
        Paper(paper),
        /// Train a suite of tasks, and check that no baseline solves them.
        Tasks(tasks),
    }
    "Look at results" {
        /// Draw learning curves of one run or several.
        Plot(plot),
        /// Compare runs, with intervals and tests.
        Compare(compare),
        /// Show an episode as a page, a film or a picture.
        Replay(replay),
        /// Score trained or given policies, also from new starts.
        Rollout(rollout),
    }
    "Check the machine" {
        /// List the processors and GPUs to train on.
        Devices(devices),
        /// Measure speed.
        Bench(bench),
        /// Compare every GPU with the CPU, bit for bit.
        Verify(verify),
    }
    "Set up the shell" {
        /// Print a shell completion script.
        Completions(completions),
        /// Write manual pages.
        Man(man),
    }
}

/// Trains cooperative teams by coevolution on a CPU or a GPU, with the same bits on both.
#[derive(Parser)]
#[command(name = "flotilla", version, long_version = VERSION.as_str(), arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

/// Text of `--version`: the version, and the commit and target of the build.
static VERSION: LazyLock<String> = LazyLock::new(|| {
    let commit = flotilla::version::COMMIT.unwrap_or("not recorded");
    format!("{}\ncommit  {commit}\ntarget  {}", flotilla::version::VERSION, flotilla::version::TARGET)
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

/// Sets the process up, runs the command, reports its error, and returns the exit code.
///
/// With `--json`, the error is also printed as JSON on standard output, unless the command has already printed its
/// results there.
///
/// `words` replaces the process's own arguments, with the program's name first. Only the `words` of the first call are
/// used.
pub fn main(words: Option<Vec<OsString>>) -> u8 {
    if let Some(words) = words {
        WORDS.get_or_init(|| words);
    }
    let failed = match process::set_up().and_then(|()| run()) {
        Ok(Ok(())) => return 0,
        Ok(Err(rejected)) if rejected.use_stderr() => {
            let _ = rejected.print();
            of_clap(&rejected)
        }
        // Help and the version are no errors to clap's caller.
        Ok(Err(text)) => match printed(text.print().and_then(|()| io::stdout().flush())) {
            Ok(()) => return 0,
            Err(error) => reported(error),
        },
        Err(error) => reported(error),
    };
    if wants_json(&self::words()) && !PRINTED.load(Relaxed) {
        // The exit code already reports a failure.
        let _ = print_json(&failed);
    }
    failed.exit_code()
}

/// Prints an error to standard error, and returns it.
fn reported(error: Error) -> Error {
    let word = if matches!(error, Error::Stopped(_)) { "stopped" } else { "error" };
    say(format_args!("{word}: {error}"));
    error
}

/// Runs the command, or returns clap's error if it rejects the command line.
fn run() -> Result<Result<(), clap::Error>, Error> {
    let words = words();
    reject_control_chars(words.iter().skip(1).cloned())?;
    let matches = match command().try_get_matches_from(words) {
        Ok(matches) => matches,
        Err(error) => return Ok(Err(hinted(error))),
    };
    match Cli::from_arg_matches(&matches) {
        Err(error) => return Ok(Err(error.format(&mut command()))),
        Ok(Cli { command }) => command.run()?,
    }
    Ok(Ok(()))
}

/// Reports whether a command line asks for JSON. It may be one that clap rejects.
fn wants_json(words: &[OsString]) -> bool {
    words.iter().take_while(|word| *word != "--").any(|word| word == "--json")
}

/// Whether results were printed as JSON.
static PRINTED: AtomicBool = AtomicBool::new(false);

/// Converts clap's error, which has its advice in paragraphs after the message.
fn of_clap(error: &clap::Error) -> Error {
    let text = error.to_string();
    let text = text.trim().trim_start_matches("error: ");
    Error::Usage(match text.split_once("\n\n") {
        None => text.into(),
        Some((message, advice)) => with_remedy(message, advice.trim()),
    })
}

/// Removes clap's advice to pass an unknown flag as a value, which does not apply to any command. Suggests `--team` in
/// place of `--champion` and `--best`, and `--set` in place of flags named like config keys.
fn hinted(mut error: clap::Error) -> clap::Error {
    if error.kind() == ErrorKind::UnknownArgument {
        error.remove(ContextKind::Suggested);
        let unknown = error.get(ContextKind::InvalidArg).map(ToString::to_string);
        if let Some(flag @ ("--champion" | "--best")) = unknown.as_deref() {
            let meant = format!("--team {}", flag.trim_start_matches('-'));
            error.insert(ContextKind::SuggestedArg, ContextValue::String(meant));
        } else if let Some(key) = unknown.and_then(|flag| key_of(&flag)).filter(|key| takes_key(key)) {
            let meant = format!("--set {key}=VALUE");
            error.insert(ContextKind::SuggestedArg, ContextValue::String(meant));
        }
    }
    error
}

/// Returns the config key that a flag is named like: `world.steps` for `--steps`.
fn key_of(flag: &str) -> Option<&'static str> {
    let leaf = flag.strip_prefix("--")?.replace('-', "_");
    config::keys().iter().map(|key| key.name).find(|key| key.rsplit('.').next() == Some(&*leaf))
}

/// Reports whether the command that was typed has `--set`, and uses this key.
fn takes_key(key: &str) -> bool {
    let words = words();
    let typed = words.get(1).and_then(|word| word.to_str()).unwrap_or_default();
    if ["rollout", "baseline"].contains(&typed) && key.starts_with("learning.") {
        return false;
    }
    let command = Cli::command();
    command
        .find_subcommand(typed)
        .is_some_and(|command| command.get_arguments().any(|arg| arg.get_long() == Some("set")))
}

/// Returns the definition of the command line, without parsing or running anything.
pub fn command() -> clap::Command {
    let command = Cli::command();
    let template = template(&command);
    // A negative number is a value, even if an invalid one, and not a flag.
    command.help_template(template).mut_subcommands(|command| {
        command.mut_args(|arg| match arg.get_long().is_some() && arg.get_action().takes_values() {
            true => arg.allow_negative_numbers(true),
            false => arg,
        })
    })
}

/// Returns the help of the whole program, with its commands by group.
fn template(command: &clap::Command) -> String {
    let line = |name: &&str| {
        let name = name.to_lowercase();
        let about = command.find_subcommand(&name).and_then(clap::Command::get_about);
        format!("  {name:<13}{}\n", about.map_or(String::new(), ToString::to_string))
    };
    let group =
        |(title, names): &(&str, &[&str])| format!("{title}:\n{}\n", names.iter().map(line).collect::<String>());
    let groups: String = GROUPS.iter().map(group).collect();
    format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{groups}Options:\n{{options}}\n\n\
         'flotilla help COMMAND' lists the flags of a command. To begin: flotilla init --out my.toml"
    )
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
            return Err(Error::Usage(
                format!(
                    "'{}' holds a line break or another control character, which no name or value may have",
                    escape::line(&word.to_string_lossy())
                )
                .into(),
            ));
        }
    }
    Ok(())
}

/// Prints a message to standard error, with control characters escaped. A failure is ignored, because there is no other
/// place to report it.
pub fn say(text: impl Display) {
    let _ = writeln!(io::stderr(), "{}", escape::lines(&text.to_string()));
}

/// Prints a result to standard output, with control characters escaped. A reader that closes the pipe early (`| head`)
/// causes no error.
pub fn print(text: &str) -> Result<(), Error> {
    write_out(&escape::lines(text))
}

fn write_out(text: &str) -> Result<(), Error> {
    let mut stdout = io::stdout().lock();
    printed(stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()))
}

/// Converts the result of writing to standard output.
fn printed(result: io::Result<()>) -> Result<(), Error> {
    match result {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(Error::Output(error)),
        _ => Ok(()),
    }
}

/// Writes characters that steer a terminal as JSON's own escapes, where serde leaves them as they are.
struct TerminalSafe;

impl serde_json::ser::Formatter for TerminalSafe {
    fn write_string_fragment<W: ?Sized + Write>(&mut self, writer: &mut W, fragment: &str) -> io::Result<()> {
        for piece in fragment.split_inclusive(escape::is_control) {
            let text = piece.trim_end_matches(escape::is_control);
            writer.write_all(text.as_bytes())?;
            for control in piece[text.len()..].chars() {
                write!(writer, "\\u{:04x}", u32::from(control))?;
            }
        }
        Ok(())
    }
}

/// Prints a result as one line of JSON to standard output. JSON does not have the escapes of [`print()`].
pub fn print_json(value: &impl Serialize) -> Result<(), Error> {
    let mut text = Vec::new();
    let mut serializer = serde_json::Serializer::with_formatter(&mut text, TerminalSafe);
    value.serialize(&mut serializer).expect("numbers, texts and lists of them are JSON");
    text.push(b'\n');
    PRINTED.store(true, Relaxed);
    write_out(&String::from_utf8(text).expect("JSON is UTF-8"))
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
    /// Reads the file, for a request that sets some keys.
    pub fn text(&self, set: Vec<Override>) -> Result<ConfigText, Error> {
        Ok(ConfigText { text: flotilla_app::import::read_file(&self.path)?, name: config::name(&self.path), set })
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

    /// Reads the file, for a request that sets the keys of the flags and `more`.
    pub fn text(&self, more: Vec<Override>) -> Result<ConfigText, Error> {
        self.file.text([self.overrides.list(), more].concat())
    }
}

/// The flags that control what a command prints.
#[derive(clap::Args, Clone, Copy)]
pub struct Printed {
    /// Print no progress, and no summary of a training or an episode; --json still prints its object
    #[arg(long, short)]
    pub quiet: bool,
    /// Print the results as one JSON object (docs/reference/json.md)
    #[arg(long)]
    pub json: bool,
}

impl Printed {
    /// Prints an outcome as JSON or, by `text`, for people.
    pub fn outcome<T: Serialize>(self, outcome: &T, text: impl FnOnce(&T) -> String) -> Result<(), Error> {
        if self.json { print_json(outcome) } else { print(&text(outcome)) }
    }

    /// Prints an outcome that people may not want to see.
    pub fn summary<T: Serialize>(self, outcome: &T, text: impl FnOnce(&T) -> String) -> Result<(), Error> {
        if self.quiet && !self.json { Ok(()) } else { self.outcome(outcome, text) }
    }
}

/// The flags for results that are in the output directory.
#[derive(clap::Args, Clone, Copy)]
pub struct ExistingResults {
    /// Resume what is in the directory, and start what is missing
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Overwrite what is in the directory
    #[arg(long)]
    force: bool,
}

impl ExistingResults {
    /// Returns what happens to the results.
    pub fn start(self) -> Start {
        match (self.resume, self.force) {
            (true, _) => Start::Resume,
            (_, true) => Start::Force,
            _ => Start::Fresh,
        }
    }
}

/// Flags that set config keys. Their ranges are checked with the config.
#[derive(clap::Args, Default)]
pub struct Overrides {
    /// Random seed
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub seed: Option<String>,
    /// Independent repetitions
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub trials: Option<String>,
    /// Number of generations after the random generation 0
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub generations: Option<String>,
    /// Policies per population, and teams per generation
    #[arg(long, help_heading = IN_CONFIG, value_name = "N", value_parser = number)]
    pub population: Option<String>,
    /// Fitness: the score that selects policies
    #[arg(long, help_heading = IN_CONFIG, value_name = "NAME", value_parser = Words::new(Fitness::names()), ignore_case = true)]
    pub fitness: Option<String>,
    /// Who learns
    #[arg(long, help_heading = IN_CONFIG, value_name = "NAME", value_parser = Words::new(Paradigm::names()), ignore_case = true)]
    pub paradigm: Option<String>,
    /// Any other key.
    #[command(flatten)]
    pub set: SetKeys,
}

/// The flag that sets any key of a config.
#[derive(clap::Args, Clone, Default)]
pub struct SetKeys {
    /// Set any config key, for example world.steps=60 or agents.uav.speed=2; can be repeated
    #[arg(long, help_heading = IN_CONFIG, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<Override>,
}

/// Parses `KEY=VALUE`. The value is TOML or a word.
fn assignment(text: &str) -> Result<Override, String> {
    let parts = text.split_once('=').map(|(key, value)| (key.trim(), value.trim()));
    let (key, value) = parts.filter(|(key, _)| !key.is_empty()).ok_or("allowed KEY=VALUE, as world.steps=60")?;
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
        let Overrides { seed, trials, generations, population, fitness, paradigm, set: SetKeys { set: given } } = self;
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

/// The processor and its threads.
#[derive(clap::Args, Clone, Debug)]
pub struct RunOptions {
    /// Processor to run on
    #[arg(long, help_heading = WHERE, value_enum, default_value_t = BackendChoice::Auto)]
    pub backend: BackendChoice,
    /// GPU by its number in `flotilla devices` or part of its name; also selects software renderers
    #[arg(long, help_heading = WHERE, value_name = "NAME")]
    pub adapter: Option<String>,
    /// Memory that holds the populations, and processor that breeds them
    #[arg(long, help_heading = WHERE, value_enum, default_value_t = Breed::Auto)]
    pub breed: Breed,
    /// CPU threads [default: all]
    #[arg(long, help_heading = WHERE, value_name = "N", value_parser = between(1..=MAX_THREADS as u16))]
    pub threads: Option<u16>,
}

/// The kind of processor that plays the episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BackendChoice {
    /// A GPU if it is expected to finish before the CPU, otherwise the CPU
    Auto,
    /// All cores, or `--threads`
    Cpu,
    /// A GPU; fails without one, and ignores software renderers
    Gpu,
}

/// Where populations are kept between generations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Breed {
    /// GPU memory if populations have at least 128 KiB per trial and fit, otherwise main memory
    Auto,
    /// Main memory
    Host,
    /// GPU memory; fails if they do not fit
    Device,
}
