//! `flotilla compare`: compares runs, or the points of a sweep along an axis, with intervals and tests.

use std::path::PathBuf;

use super::sweep::share;
use super::{Error, console, print, print_json};
use flotilla_app::ops;
use flotilla_app::ops::compare::{CompareRequest, at};
use flotilla_app::record::digests::UNVERIFIED;
use flotilla_app::report::comparison;

#[derive(clap::Args)]
pub struct Args {
    /// At least two run directories, or the directory of one sweep
    #[arg(required = true, value_name = "RUN")]
    folders: Vec<PathBuf>,
    /// Axis of a sweep whose values are compared, for each combination of the others [default: its only axis]
    #[arg(long, value_name = "AXIS")]
    by: Option<String>,
    /// Generations at which to compare G, as 0,50,last; last is the last one that all arms have reached
    #[arg(long, value_name = "N,…", value_delimiter = ',', default_value = "last", value_parser = generation)]
    at: Vec<String>,
    /// Compare the generations that the champion needs to reach this G, in 0..1
    #[arg(long, value_name = "G", default_value_t = 0.75, value_parser = share)]
    reach: f64,
    /// Compare pair by pair; trials with the same seed and number are pairs
    #[arg(long)]
    paired: bool,
    /// Also read files that differ from their digests in run.json, and mark the results as unverified
    #[arg(long)]
    unverified: bool,
    /// Print one JSON object (docs/reference/json.md)
    #[arg(long, conflicts_with_all = ["csv", "latex"])]
    json: bool,
    /// Print CSV, one row per mean or difference
    #[arg(long, conflicts_with = "latex")]
    csv: bool,
    /// Print LaTeX tables, which need no package
    #[arg(long)]
    latex: bool,
}

/// Checks a generation to compare at.
fn generation(text: &str) -> Result<String, String> {
    at(text).map(|_| text.to_string())
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { folders, by, at, reach, paired, unverified, json, csv, latex } = args;
    let request = CompareRequest { folders, by, at, reach, paired, unverified };
    let found = console::run_without_backend(false, |context| ops::compare::run(&request, context))?;
    if csv {
        return print(&String::from_utf8_lossy(&comparison::csv(&found.comparisons)));
    }
    if json {
        return print_json(&found);
    }
    let text = if latex { comparison::latex } else { comparison::text }(&found.comparisons, &found.question);
    let mark = match (unverified, latex) {
        (false, _) => String::new(),
        (true, false) => format!("{UNVERIFIED}\n"),
        (true, true) => format!("% {UNVERIFIED}\n"),
    };
    print(&(mark + &text))
}
