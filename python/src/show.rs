//! Replays and learning curves.

use std::path::PathBuf;
use std::str::FromStr;

use flotilla::backend::cpu::Cpu;
use flotilla::evaluate::Starts;
use flotilla::front;
use flotilla_app::ops::replay::{WhichTrial, play};
use flotilla_app::ops::{self, output};
use flotilla_app::record::RecordError;
use flotilla_app::record::digests::Verification;
use flotilla_app::report::curves::Band;
use flotilla_app::report::replay::{self as again, Film, Replayed, Which};
use flotilla_app::report::runs::{self, TeamKind};
use flotilla_app::report::scene::{Format, PRINT, Scene};
use numpy::PyReadonlyArray3;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::config::Config;
use crate::errors::{Raise, Raised};
use crate::play::{drawn, weights};
use crate::program::perform;
use crate::workers;

/// Trial, generation, team, G and number of observed POIs of an episode. Given policies have no trial and no generation,
/// and the champion is no team of its generation.
type Episode = (Option<usize>, Option<usize>, Option<usize>, f64, usize);

/// Replayed episodes.
#[pyclass(frozen)]
pub struct Replay {
    name: String,
    /// The config of the stage that the episodes belong to.
    config: flotilla::Config,
    played: Vec<Replayed>,
}

/// Parses a word or number that `what` names.
fn parsed<T: FromStr<Err = String>>(what: &str, text: &str) -> PyResult<T> {
    text.parse().map_err(|reason| PyValueError::new_err(format!("{what} {text:?}: {reason}")))
}

/// Replays one team of each of some generations of a trial.
#[pyfunction]
pub fn replay(
    py: Python<'_>,
    folder: PathBuf,
    trial: &str,
    team: &str,
    generations: Vec<usize>,
    unverified: bool,
    backend: &str,
) -> PyResult<Replay> {
    let verification = Verification::unless(unverified);
    let (trial, team): (WhichTrial, Which) = (parsed("trial", trial)?, parsed("team", team)?);
    let (config, played) = perform(py, backend, "", &|_, _, _| Ok(false), |backends, context| {
        let config = runs::config(&folder, verification)?;
        let trial = trial.find(&folder, &config, generations.last().copied(), team, verification)?;
        play(&folder, trial, &generations, team, verification, backends, context)
    })?;
    let name = folder.file_name().map_or("run".into(), |name| name.to_string_lossy().into_owned());
    Ok(Replay { name, config, played })
}

/// Plays one episode of each of several teams on the CPU: their numbers, and their policies, `[leaders or 1, 1,
/// parameters]`. All have the same start, of `(episodes, seed, jitter, poi_jitter)` the first.
#[pyfunction]
pub fn replay_policies(
    py: Python<'_>,
    config: &Config,
    teams: Vec<(usize, PyReadonlyArray3<'_, f32>)>,
    starts: Option<(u32, u64, f64, f64)>,
) -> PyResult<Replay> {
    let starts = drawn(starts);
    let mut played = Vec::new();
    for (team, policies) in &teams {
        let (_, weights) = weights(config, policies)?;
        let one = workers::aside(py, || {
            front::with_team(&config.0, weights, &starts, |group| again::one(group, &mut Cpu::default()))
        });
        let one = one.raise()?.raise()?;
        played.push(Replayed { which: Which::Number(*team), team: *team, given: true, ..one });
    }
    let mut config = config.0.clone();
    // Pages and pictures draw moved POIs if the config moves them.
    config.learning.poi_jitter = match starts {
        Starts::Own => 0.0,
        Starts::Drawn { poi_jitter, .. } => poi_jitter,
    };
    Ok(Replay { name: "Given policies".into(), config, played })
}

#[pymethods]
impl Replay {
    /// Returns the episodes, in the order in which they are shown.
    #[getter]
    fn episodes(&self) -> Vec<Episode> {
        let row = |played: &Replayed| {
            let Replayed { trial, generation, which, team, team_g, ref observed, given, .. } = *played;
            let of_run = |number| (!given).then_some(number);
            let team = (which != Which::Champion).then_some(team);
            (of_run(trial), of_run(generation), team, team_g, observed.iter().flatten().count())
        };
        self.played.iter().map(row).collect()
    }

    fn page(&self, py: Python<'_>) -> String {
        workers::aside(py, || again::page(&self.name, &self.config, &self.played))
    }

    fn gif<'py>(&self, py: Python<'py>, width: Option<u32>, fps: u32) -> PyResult<Bound<'py, PyBytes>> {
        let motion = Film { width, fps };
        let draw = || again::gif(&again::Frames::new(&self.config, &self.played, motion), motion, |_| true);
        Ok(PyBytes::new(py, &workers::aside(py, draw).raise()?.unwrap_or_default()))
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

/// Returns the learning curves of one run, or of several side by side. `measure` is the team that is shown.
#[pyfunction]
pub fn figure(py: Python<'_>, folders: Vec<PathBuf>, measure: Option<&str>, unverified: bool) -> PyResult<Figure> {
    let verification = Verification::unless(unverified);
    let measure: Option<TeamKind> = measure.map(|measure| parsed("measure", measure)).transpose()?;
    workers::aside(py, || {
        runs::figure(&folders, measure, Band::Interval, verification).map(|figure| Figure(figure.scene()))
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
