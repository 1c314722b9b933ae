//! Replays and learning curves.

use std::path::PathBuf;

use flotilla_app::ops::replay::{Played, play};
use flotilla_app::ops::{self, output};
use flotilla_app::record::RecordError;
use flotilla_app::record::digests::Verification;
use flotilla_app::report::curves::{Band, PRINT};
use flotilla_app::report::replay::{self as again, Film, Replayed, Which};
use flotilla_app::report::runs;
use flotilla_app::report::scene::{Format, Scene};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::errors::{Raise, Raised};
use crate::program::perform;
use crate::workers;

/// Replayed episodes.
#[pyclass(frozen)]
pub struct Replay {
    name: String,
    /// The config of the stage that the episodes belong to.
    config: flotilla::Config,
    played: Vec<Replayed>,
}

/// Replays the best teams of some generations of a trial.
#[pyfunction]
pub fn replay(
    py: Python<'_>,
    folder: PathBuf,
    trial: usize,
    generations: Vec<usize>,
    unverified: bool,
    backend: &str,
) -> PyResult<Replay> {
    let verification = Verification::unless(unverified);
    let Played { config, episodes, .. } = perform(py, backend, "", &|_, _, _| Ok(false), |backends, context| {
        play(&folder, trial, &generations, Which::Best, verification, backends, context)
    })?;
    let name = folder.file_name().map_or("run".into(), |name| name.to_string_lossy().into_owned());
    Ok(Replay { name, config, played: episodes })
}

#[pymethods]
impl Replay {
    /// Trial, generation, team, G and number of observed POIs, per episode.
    #[getter]
    fn episodes(&self) -> Vec<(usize, usize, usize, f64, usize)> {
        let row = |played: &Replayed| {
            let Replayed { trial, generation, team, team_g, ref observed, .. } = *played;
            (trial, generation, team, team_g, observed.iter().flatten().count())
        };
        self.played.iter().map(row).collect()
    }

    fn page(&self, py: Python<'_>) -> String {
        workers::aside(py, || again::page(&self.name, &self.config, &self.played))
    }

    fn gif<'py>(&self, py: Python<'py>, width: Option<u32>, fps: u32) -> PyResult<Bound<'py, PyBytes>> {
        let motion = Film { width, fps };
        let bytes = workers::aside(py, || again::gif(&self.config, &self.played, motion)).raise()?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn still(&self, step: Option<usize>) -> PyResult<Figure> {
        let steps = self.config.world.steps;
        match step.unwrap_or(steps) {
            step if step <= steps => Ok(Figure(again::still(&self.config, &self.played, step))),
            step => Err(PyValueError::new_err(format!("step {step}: the episode has steps 0 to {steps}"))),
        }
    }
}

/// A picture.
#[pyclass(frozen)]
pub struct Figure(Scene);

/// Returns the learning curves of one run, or of several side by side.
#[pyfunction]
pub fn figure(py: Python<'_>, folders: Vec<PathBuf>, unverified: bool) -> PyResult<Figure> {
    let verification = Verification::unless(unverified);
    workers::aside(py, || {
        runs::figure(&folders, None, Band::Interval, verification).map(|figure| Figure(figure.scene()))
    })
    .raise()
}

/// Writes a file that the user named, whole or not at all.
#[pyfunction]
pub fn write(py: Python<'_>, path: PathBuf, content: &[u8]) -> PyResult<()> {
    py.detach(|| output::check(&[("path", Some(&*path))], &[]).and_then(|()| output::write(&path, content))).map_err(
        |error| match error {
            ops::Error::Record(RecordError::Write { error, .. }) => error.into(),
            error => error.raised(),
        },
    )
}

#[pymethods]
impl Figure {
    fn svg(&self) -> String {
        self.0.svg()
    }

    /// Returns the content of a picture file, in the format of the path's extension.
    ///
    /// `width` is in pixels, and only counts for .png.
    fn file<'py>(&self, py: Python<'py>, path: PathBuf, width: Option<u32>) -> PyResult<Bound<'py, PyBytes>> {
        let Some(kind) = Format::of(&path) else {
            let text = format!("{}: its name must end in .svg, .pdf or .png", path.display());
            return Err(PyValueError::new_err(text));
        };
        let per_mm = width.map_or(PRINT, |width| f64::from(width.clamp(100, 8192)) / self.0.width);
        let bytes = workers::aside(py, || self.0.file(kind, per_mm)).raise()?;
        Ok(PyBytes::new(py, &bytes))
    }
}
