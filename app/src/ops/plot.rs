//! Draws the curves of one run, or of several side by side.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::output::{self, Destination};
use super::{Context, Error, escaped, with_remedy};
use crate::record::RecordError;
use crate::record::digests::Verification;
use crate::record::ownership::CURVES;
use crate::report::curves::Band;
use crate::report::runs::{self, MAX_RUNS, TeamKind};
use crate::report::scene::{Format, PRINT, Scene};
use flotilla::escape::PathExt;

/// A request to draw learning curves.
#[derive(Clone, Debug)]
pub struct PlotRequest {
    pub runs: Vec<PathBuf>,
    /// The picture. By default `curves.svg` in the folder of one run, or `comparison.svg` here of several.
    pub out: Option<PathBuf>,
    /// Team whose G is shown. By default all of one run, and the champions of several.
    pub measure: Option<TeamKind>,
    /// Range that is shown around a mean.
    pub band: Band,
    /// Whether files that differ from their digests are read.
    pub unverified: bool,
}

#[derive(Clone, Debug, Serialize)]
pub struct PlotOutcome {
    /// The file.
    #[serde(serialize_with = "escaped")]
    pub out: PathBuf,
    /// The runs as they were named.
    pub runs: Vec<String>,
    /// Whether files were read that differ from their digests.
    pub unverified: bool,
}

/// Draws the curves of runs.
pub fn run(request: &PlotRequest, context: Context<'_>) -> Result<PlotOutcome, Error> {
    let verification = Verification::unless(request.unverified);
    if request.runs.len() > MAX_RUNS {
        let text = format!("{} runs are too many to tell apart", request.runs.len());
        return Err(Error::Usage(with_remedy(text, format!("name {MAX_RUNS} at most"))));
    }
    let runs = &request.runs;
    let place = match (&request.out, &**runs) {
        (Some(out), _) => Destination::Named(out.clone()),
        (None, [run]) => Destination::OfRun(run.join(CURVES)),
        (None, _) => Destination::Here("comparison.svg".into()),
    };
    let out = place.path();
    let kind = kind_of(out)?;
    output::check(&[("--out", request.out.as_deref())], &[])?;
    let scene = runs::figure(runs, request.measure, request.band, verification)?.scene();
    place.check()?;
    place.write(&content(&scene, kind, out)?)?;
    if runs::paired(runs, verification)? {
        context.note(
            "note: these runs have one seed, so their trials are pairs; `flotilla compare RUN … --paired` compares them pair by pair",
        );
    }
    let named = runs.iter().map(|run| run.escaped()).collect();
    Ok(PlotOutcome { out: out.into(), runs: named, unverified: request.unverified })
}

/// Returns the format of a picture, from the extension of its file name.
pub(super) fn kind_of(path: &Path) -> Result<Format, Error> {
    let wrong = || Error::Usage(format!("--out {}: its name must end in .svg, .pdf or .png", path.escaped()).into());
    Format::of(path).ok_or_else(wrong)
}

/// Returns the content of a picture's file.
pub(super) fn content(scene: &Scene, kind: Format, path: &Path) -> Result<Vec<u8>, RecordError> {
    scene.file(kind, PRINT).map_err(RecordError::write(path))
}
