//! `flotilla tasks`: trains the tasks of a suite, and checks that no baseline and no small population solves them.

use std::path::{Path, PathBuf};

use super::{ConfigFile, Error, ExistingResults, Printed, RunOptions, SetKeys, between, console};
use flotilla::baseline::NAMES;
use flotilla::config;
use flotilla::escape::PathExt;
use flotilla::file;
use flotilla::statistics;
use flotilla_app::report::table::markdown;
use flotilla_app::script::Script;
use flotilla_studies::tasks::{self, FITNESSES, OUT, Outcome, Request, SMALL, Task, mean};

#[derive(clap::Args)]
pub struct Args {
    /// Config files (TOML), one per task
    #[arg(value_name = "CONFIG", required = true)]
    configs: Vec<PathBuf>,
    /// Folder for the runs
    #[arg(long, short, value_name = "DIR", default_value = OUT)]
    out: PathBuf,
    /// Independent repetitions of every training
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = between(2..=4096u32))]
    trials: u32,
    /// Policies per population of the large populations, of which 10 % are elites; 0 trains none
    #[arg(long, value_name = "N", default_value_t = 5000, value_parser = between(0..=1_048_576u32))]
    population: u32,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 777)]
    seed: u32,
    #[command(flatten)]
    set: SetKeys,
    #[command(flatten)]
    existing: ExistingResults,
    #[command(flatten)]
    printed: Printed,
    #[command(flatten)]
    run: RunOptions,
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { configs, out, trials, population, seed, set, existing, printed, run } = args;
    let task = |path: PathBuf| {
        let (name, table) = (file::stem(&path, "task"), path.with_extension("csv"));
        let script = if table.is_file() { Some(read_script(&table)?) } else { None };
        Ok::<_, Error>(Task { name, config: ConfigFile { path }.text(set.set.clone())?, script })
    };
    let tasks = configs.into_iter().map(task).collect::<Result<_, _>>()?;
    let (named, start) = (out != Path::new(OUT), existing.start());
    let request = Request { tasks, out, named, start, trials, population, seed };
    let found = console::run(&run, printed.quiet, |backends, context| tasks::run(&request, backends, context))
        .map_err(|error| match error {
            Error::Stopped(_) => error.or_advise(|| "run the same command with --resume to continue".into()),
            error => error,
        })?;
    printed.outcome(&found, in_words)?;
    found.refused().map_or(Ok(()), Err)
}

/// Reads the scripted team beside a config.
fn read_script(path: &Path) -> Result<Script, Error> {
    let invalid = |error: csv::Error| format!("{}: {error}", path.escaped());
    let text = config::read_file(path)?;
    Script::parse(&text).map_err(|error| Error::Usage(invalid(error).into()))
}

fn in_words(found: &Outcome) -> String {
    let mut head = vec!["task".to_string()];
    head.extend(NAMES.map(String::from));
    for population in [SMALL.0, found.population.into()].into_iter().filter(|&policies| policies > 0) {
        head.extend(FITNESSES.map(|fitness| format!("{population} policies, {fitness}")));
    }
    head.extend(["scripted team".into(), "admitted".into()]);
    let row = |task: &tasks::Found| {
        let mut row = vec![task.name.clone()];
        row.extend(task.baselines.iter().map(|g| {
            let most = g.iter().copied().fold(0.0, f64::max);
            format!("{:.2} (at most {most:.2})", mean(g))
        }));
        row.extend(task.trained.iter().map(|found| {
            let champion = statistics::bounded(&found.champion_g.iter().collect(), [0.0, 1.0]);
            let champion = champion.map_or(String::new(), |g| format!("{:.2} [{:.2}, {:.2}]", g.value, g.low, g.high));
            format!("{champion} ({:.2}; {} of {})", mean(&found.best_g), found.solved(), found.champion_g.len())
        }));
        row.push(task.scripted_g.map_or("none".into(), |g| format!("{g:.2}")));
        row.push(if task.refused.is_none() { "yes" } else { "no" }.into());
        row
    };
    format!("{}\n", markdown(&[head].into_iter().chain(found.tasks.iter().map(row)).collect::<Vec<_>>()))
}
