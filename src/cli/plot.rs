//! `flotilla plot`: the curves of one run, or of several side by side.

use std::path::{Path, PathBuf};

use super::{Error, print, say};
use crate::record::RecordError;
use crate::record::disk::Disk;
use crate::report::curves::PRINT;
use crate::report::runs::{self, MAX_RUNS};
use crate::report::scene::Scene;

#[derive(clap::Args)]
pub struct Args {
    /// Folders that `flotilla train` made
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Picture to write, .svg or .png [default: curves.svg in the folder of one run, comparison.svg here of several]
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
    let kind = Kind::of(&out)?;
    let scene = runs::figure(&runs)?.scene();
    write(&scene, kind, &out)?;
    if runs::paired(&runs)? {
        say("note: these runs have one seed, so their trials are pairs: compare trial with trial, not only the means");
    }
    print(&format!("{}\n", out.display()))
}

/// What a picture is written as.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Svg,
    Png,
}

impl Kind {
    fn of(path: &Path) -> Result<Kind, Error> {
        match path.extension().map(|extension| extension.to_ascii_lowercase()) {
            Some(extension) if extension == "svg" => Ok(Kind::Svg),
            Some(extension) if extension == "png" => Ok(Kind::Png),
            _ => Err(Error::Usage(format!("--out {}: its name must end in .svg or .png", path.display()))),
        }
    }
}

/// Writes a picture, whole or not at all.
fn write(scene: &Scene, kind: Kind, path: &Path) -> Result<(), Error> {
    let failed = |error| RecordError::Write { path: path.into(), error };
    let content = match kind {
        Kind::Svg => scene.svg().into_bytes(),
        Kind::Png => scene.png(PRINT).map_err(failed)?,
    };
    Ok(Disk::default().replace(path, |output| output.write_all(&content)).map_err(failed)?)
}
