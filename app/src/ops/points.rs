//! Reads a run's folder, and helps if a sweep's folder is named in its place.

use std::fmt::Write;
use std::path::Path;

use super::Error;
use crate::record::digests::Verification;
use crate::record::folder::SWEEP;
use crate::report::runs::{self, ReadError};
use crate::sweep::{Sweep, results};
use flotilla::config::Config;
use flotilla::escape::PathExt;

/// Maximum number of points that are listed.
const MAX_LISTED_POINTS: usize = 40;

/// Reads a run's config. If the folder is a sweep's, the error lists its points with their values.
pub fn config(folder: &Path, verification: Verification) -> Result<Config, Error> {
    runs::config(folder, verification).map_err(|error| match error {
        ReadError::Collection { what: "a sweep", .. } => match Sweep::load(&folder.join(SWEEP), &[], false) {
            Ok(sweep) => Error::Refused(list(&sweep, folder).into()),
            Err(error) => error.into(),
        },
        error => error.into(),
    })
}

fn list(sweep: &Sweep, folder: &Path) -> String {
    let mut text = format!("{} holds a sweep; name one of its points:", folder.escaped());
    for point in sweep.points.iter().take(MAX_LISTED_POINTS) {
        let _ = write!(text, "\n  {}  {}", results::point_folder(folder, point).escaped(), sweep.describe(point));
    }
    if let more @ 1.. = sweep.points.len().saturating_sub(MAX_LISTED_POINTS) {
        let _ = write!(text, "\n  … and {more} more");
    }
    text
}
