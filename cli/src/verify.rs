//! `flotilla verify`: compares every adapter with the CPU, bit for bit.

use std::path::PathBuf;

use super::{Error, Printed, SetKeys, backend, between, console};
use flotilla::config;
use flotilla_app::import;
use flotilla_app::ops::verify::{self, Compared, TEAMS, VerifyRequest};

#[derive(clap::Args)]
#[command(after_help = EXIT_CODES)]
pub struct Args {
    /// Compare only this experiment, instead of random worlds of every kind; - is standard input
    config: Option<PathBuf>,
    #[command(flatten)]
    set: SetKeys,
    /// Random teams per world
    #[arg(long, value_name = "N", default_value_t = TEAMS, value_parser = between(1..=65_536u32))]
    teams: u32,
    /// Random worlds per adapter, pass and kernel [default: as many of 200 as take about a minute]
    #[arg(long, value_name = "N", conflicts_with = "config", value_parser = between(1..=100_000u32))]
    worlds: Option<u32>,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = between(0..=u32::MAX))]
    seed: u32,
    /// Only this adapter: its number or part of its name; `cpu` compares the processor's instruction sets instead
    #[arg(long, value_name = "NAME")]
    adapter: Option<String>,
    /// Only this pass, instead of all exact ones; `plain` shows why passes are needed
    #[arg(long, value_name = "PASS", value_parser = ["no-contraction", "guarded", "plain"])]
    pass: Option<String>,
    /// Only this kernel, instead of both
    #[arg(long, value_name = "KERNEL", value_parser = ["generic", "specialised"])]
    kernel: Option<String>,
    #[command(flatten)]
    printed: Printed,
}

/// Shown below the help.
const EXIT_CODES: &str =
    "Exit codes: 0 all equal, 1 failed, 2 wrong usage, 3 a comparison found other bits than the CPU's";

/// Prints a table of adapters, passes and kernels, and the differences below it.
pub fn run(args: Args) -> Result<(), Error> {
    backend::start_threads(None);
    let read = |path: PathBuf| Ok::<_, Error>((config::name(&path), import::read_file(&path)?));
    let Args { config, set, teams, worlds, seed, adapter, pass, kernel, printed } = args;
    let request = VerifyRequest {
        config: config.map(read).transpose()?,
        set: set.set,
        teams: Some(teams),
        worlds,
        seed,
        adapter,
        pass,
        kernel,
    };
    let found = console::run_without_backend(printed.quiet, |context| verify::run(&request, context))?;
    printed.outcome(&found, |found| in_words(&found.comparisons))?;
    found.difference().map_or(Ok(()), Err)
}

/// Returns a table, and the differences below it.
fn in_words(lines: &[Compared]) -> String {
    let mut text =
        format!("{:<15} {:<12} {:>7} {:>13} {:<10} adapter\n", "pass", "kernel", "worlds", "agent-steps", "result");
    let mut failures = String::new();
    for Compared { adapter, pass, kernel, against, worlds, agent_steps, equal, failure } in lines {
        let result = if *equal { "equal" } else { "DIFFERENT" };
        let [pass, kernel] = [pass, kernel].map(|name| name.as_deref().unwrap_or("-"));
        text += &format!("{pass:<15} {kernel:<12} {worlds:>7} {agent_steps:>13} {result:<10} {adapter}\n");
        failures.extend(failure.iter().map(|what| match pass {
            "-" => format!("\n{adapter}, against {against}:\n  {what}\n"),
            pass => format!("\n{adapter}, {pass} pass, {kernel} kernel:\n  {what}\n"),
        }));
    }
    text + &failures
}
