//! `flotilla plot`: draws the curves of one run, or of several side by side.

use std::path::{Path, PathBuf};

use super::output::{self, Destination};
use super::{Error, print, print_json, said, say};
use crate::escape::PathExt;
use crate::record::RecordError;
use crate::record::archive::RunFolder;
use crate::record::digests::{self, UNVERIFIED, Verification};
use crate::record::ownership::CURVES;
use crate::report::curves::{Band, PRINT};
use crate::report::runs::{self, MAX_RUNS, TeamKind};
use crate::report::scene::{Format, Scene};

#[derive(clap::Args)]
pub struct Args {
    /// Run directories, made by `flotilla train`, or zip files of runs
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Picture to write, .svg, .pdf or .png [default: curves.svg in the folder of one run, comparison.svg here of
    /// several]
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Team whose G to show: the best, the champion, or the mean over all teams [default: all three of one run, the best
    /// of several]
    #[arg(long, value_name = "best|champion|mean")]
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
    let verification = Verification::unless(unverified);
    if runs.len() > MAX_RUNS {
        let count = runs.len();
        return Err(Error::Usage(said(
            format!("{count} runs are too many to tell apart"),
            format!("name {MAX_RUNS} at most"),
        )));
    }
    let opened = runs.iter().map(|run| RunFolder::open(run)).collect::<Result<Vec<_>, _>>()?;
    let named = runs;
    let runs: Vec<PathBuf> = opened.iter().map(|run| run.path().into()).collect();
    let place = match (out, &*opened) {
        (Some(out), _) => Destination::Named(out),
        (None, [run]) if run.is_unpacked() => Destination::Here(CURVES.into()),
        (None, [run]) => Destination::OfRun(run.path().join(CURVES)),
        (None, _) => Destination::Here("comparison.svg".into()),
    };
    let out = place.path();
    let kind = kind_of(out)?;
    let scene = runs::figure(&runs, measure, band, verification)?.scene();
    digests::without(runs.iter().map(|run| &**run)).into_iter().for_each(say);
    place.check()?;
    let content = scene.file(kind, PRINT).map_err(|error| RecordError::Write { path: out.into(), error })?;
    place.write(|output| output.write_all(&content))?;
    if runs::paired(&runs, verification)? {
        say("note: these runs have one seed, so their trials are pairs: compare trial with trial, not only the means");
    }
    let out = out.escaped().to_string();
    match json {
        true => {
            let runs: Vec<_> = named.iter().map(|run| run.escaped().to_string()).collect();
            print_json(&serde_json::json!({ "out": out, "runs": runs, "unverified": unverified }))
        }
        false if unverified => print(&format!("{out}\n{UNVERIFIED}\n")),
        false => print(&format!("{out}\n")),
    }
}

/// Returns the format of a picture, from the extension of its file name.
///
/// # Errors
/// Fails if the extension is not that of a picture.
pub(super) fn kind_of(path: &Path) -> Result<Format, Error> {
    let wrong = || Error::Usage(format!("--out {}: its name must end in .svg, .pdf or .png", path.escaped()).into());
    Format::of(path).ok_or_else(wrong)
}

/// Writes a picture completely or not at all.
///
/// # Errors
/// Fails if the file cannot be written.
pub(super) fn write(scene: &Scene, kind: Format, path: &Path) -> Result<(), Error> {
    let failed = |error| RecordError::Write { path: path.into(), error };
    let content = scene.file(kind, PRINT).map_err(failed)?;
    output::write(path, |output| output.write_all(&content))
}
