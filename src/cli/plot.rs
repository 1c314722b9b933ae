//! `flotilla plot`: the curves of one run, or of several side by side.

use std::path::{Path, PathBuf};

use super::{Error, print};
use crate::record::RecordError;
use crate::record::disk::Disk;
use crate::report::curves::PRINT;
use crate::report::runs::{self, MAX_RUNS};
use crate::report::scene::{Kind, Scene};

#[derive(clap::Args)]
pub struct Args {
    /// Folders that `flotilla train` made
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Picture to write, .svg, .pdf or .png [default: curves.svg in the folder of one run, comparison.svg here of several]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub fn run(args: Args) -> Result<(), Error> {
    let Args { runs, out } = args;
    if runs.len() > MAX_RUNS {
        let count = runs.len();
        return Err(Error::Usage(format!("{count} runs are too many to tell apart; name {MAX_RUNS} at most")));
    }
    let out = out.unwrap_or_else(|| match &*runs {
        [run] => run.join("curves.svg"),
        _ => "comparison.svg".into(),
    });
    let kind = kind_of(&out)?;
    let scene = runs::figure(&runs)?.scene();
    write(&scene, kind, &out)?;
    print(&format!("{}\n", out.display()))
}

/// What a picture is written as, by the end of its file's name.
///
/// # Errors
/// Nothing that a picture can be.
pub(super) fn kind_of(path: &Path) -> Result<Kind, Error> {
    let wrong = || Error::Usage(format!("--out {}: its name must end in .svg, .pdf or .png", path.display()));
    Kind::of(path).ok_or_else(wrong)
}

/// Writes a picture, whole or not at all.
///
/// # Errors
/// The file cannot be written.
pub(super) fn write(scene: &Scene, kind: Kind, path: &Path) -> Result<(), Error> {
    let content = scene.file(kind, PRINT);
    let written = content.and_then(|content| Disk::default().replace(path, |output| output.write_all(&content)));
    Ok(written.map_err(|error| RecordError::Write { path: path.into(), error })?)
}
