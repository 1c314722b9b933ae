//! `flotilla plot`: draws the curves of one run, or of several side by side.

use std::path::PathBuf;

use super::{Error, console, print, print_json};
use flotilla::escape::PathExt;
use flotilla_app::ops::plot::{self, PlotRequest};
use flotilla_app::record::digests::UNVERIFIED;
use flotilla_app::report::curves::Band;
use flotilla_app::report::runs::TeamKind;

#[derive(clap::Args)]
pub struct Args {
    /// Run directories, made by `flotilla train`
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Picture to write, .svg, .pdf or .png [default: curves.svg in the folder of one run, comparison.svg here of
    /// several]
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Team whose G to show: the champion, the best of a generation, the mean over all teams, or the best in its test
    /// episodes [default: all of one run, the champions of several]
    #[arg(long, value_name = "champion|best|mean|test")]
    measure: Option<TeamKind>,
    /// Band around a mean: its 95 % interval, its standard error, or none
    #[arg(long, value_name = "interval|error|none", default_value = "interval")]
    band: Band,
    /// Also read files that differ from their digests in run.json, and mark the results as unverified
    #[arg(long)]
    unverified: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { runs, out, measure, band, unverified, json } = args;
    let request = PlotRequest { runs, out, measure, band, unverified };
    let found = console::run_without_backend(false, |context| plot::run(&request, context))?;
    let out = found.out.escaped();
    match json {
        true => print_json(&found),
        false if unverified => print(&format!("{out}\n{UNVERIFIED}\n")),
        false => print(&format!("{out}\n")),
    }
}
