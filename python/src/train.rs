//! Trains in memory, or in a run directory as the program does.

use std::path::PathBuf;

use flotilla::front::Trained;
use flotilla::trainer::{Ending, Row};
use flotilla_app::ops::train::TrainRequest;
use flotilla_app::ops::{self, ConfigText, ProcessorInfo};
use flotilla_app::record::digests::Verification;
use flotilla_app::record::disk::Disk;
use flotilla_app::record::finished::Finished;
use flotilla_app::record::folder::{self, Folder, METRICS, Start, StartFrom};
use flotilla_app::record::{RecordError, metrics, policies, runs};
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBool;

use crate::config::Config;
use crate::errors::{Raise, contiguous};
use crate::program::perform;
use crate::workers;

/// One generation, as callbacks of `train` receive it.
///
/// Attributes:
///     generation: its number; 0 is the random start.
///     last: the number of the last generation.
///     best_g: G of its best team, float64 `[trials]`.
///     mean_g: mean G of its teams, of the same shape.
///     champion_g: G of the champion, the team of every population's best policy, of the same shape.
///     test_g: mean G of the best team over its test episodes, of the same shape. None without
///         `learning.test_episodes`.
///     champions: the policies of the champion, float32 `[trials, leaders, parameters]`, or
///         `[trials, 1, parameters]` if leaders share a policy. None unless `train` was asked for `champions`.
///
/// Example:
///     >>> seen = []
///     >>> config = flotilla.Config.paper().replace(learning={"generations": 2})
///     >>> run = flotilla.train(config, callback=seen.append)
///     >>> [generation.generation for generation in seen]
///     [0, 1, 2]
#[pyclass(frozen, module = "flotilla")]
pub struct Generation {
    #[pyo3(get)]
    generation: usize,
    #[pyo3(get)]
    last: usize,
    rows: Vec<Row>,
    /// `[trials][populations][parameters]`, and the number of populations.
    champions: Option<(Vec<f32>, usize)>,
}

impl Generation {
    /// Returns the generations of some rows, in their order.
    pub fn of_rows(rows: &[Row], last: usize) -> Vec<Generation> {
        let same = |a: &Row, b: &Row| a.generation == b.generation;
        let of = |rows: &[Row]| Generation { generation: rows[0].generation, last, rows: rows.into(), champions: None };
        rows.chunk_by(same).map(of).collect()
    }

    fn column<'py>(&self, py: Python<'py>, of: impl Fn(&Row) -> f64) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_iter(py, self.rows.iter().map(of))
    }
}

#[pymethods]
impl Generation {
    #[getter]
    fn best_g<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |row| row.best_g)
    }

    #[getter]
    fn mean_g<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |row| row.mean_g)
    }

    #[getter]
    fn champion_g<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |row| row.champion_g)
    }

    #[getter]
    fn test_g<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        let test = self.rows.iter().map(|row| row.test_g).collect::<Option<Vec<f64>>>()?;
        Some(PyArray1::from_vec(py, test))
    }

    #[getter]
    fn champions<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray3<f32>>>> {
        let Some((champions, populations)) = &self.champions else { return Ok(None) };
        let trials = self.rows.len();
        let shape = [trials, *populations, champions.len() / (trials * populations).max(1)];
        PyArray1::from_slice(py, champions).reshape(shape).map(Some)
    }

    fn __repr__(&self) -> String {
        let best = self.rows.iter().map(|row| row.best_g).fold(0.0, f64::max);
        format!("<flotilla.Generation {} of {}: best G {best:.3}>", self.generation, self.last)
    }
}

/// The callback and its arguments.
struct Watcher<'a> {
    callback: Option<&'a Py<PyAny>>,
    populations: usize,
}

impl Watcher<'_> {
    /// Passes a generation to the callback. Returns whether to stop.
    fn tell(&self, rows: &[Row], last: usize, champions: Option<&[f32]>) -> PyResult<bool> {
        let (Some(callback), Some(row)) = (self.callback, rows.first()) else { return Ok(false) };
        Python::attach(|py| {
            let champions = champions.map(|champions| (champions.to_vec(), self.populations));
            let generation = Generation { generation: row.generation, last, rows: rows.into(), champions };
            let answer = callback.bind(py).call1((generation,))?;
            if answer.is_none() {
                return Ok(false);
            }
            let named = |name: &str| answer.get_type().name().is_ok_and(|found| found == name);
            if answer.is_instance_of::<PyBool>() || named("bool") || named("bool_") {
                return answer.is_truthy();
            }
            let text = format!("the callback gave {answer:.60}, allowed are True to stop, False and None");
            Err(PyTypeError::new_err(text))
        })
    }
}

/// The result of a training: config, metrics, policies and digest.
///
/// The metrics are best, mean and champion G, and test G if the config has test episodes. Each is `[trials, generations + 1]`, and each trial's policies are
/// `[leaders or 1, policies, parameters]`.
pub type Outcomes<'py> =
    (Config, Vec<Bound<'py, PyArray2<f64>>>, Vec<Bound<'py, PyArray3<f32>>>, String, End<Bound<'py, PyArray1<f32>>>);

pub fn outcomes(py: Python<'_>, trained: Trained, digest: String) -> PyResult<Outcomes<'_>> {
    let Trained { config, best_g, mean_g, champion_g, test_g, policies, ending, .. } = trained;
    let learning = &config.learning;
    let table = |values| PyArray1::from_vec(py, values).reshape([learning.trials, learning.generations + 1]);
    let shape = [config.populations(), learning.population, config.parameters()];
    let policies = policies.into_iter().map(|trial| PyArray1::from_vec(py, trial).reshape(shape));
    let metrics = [best_g, mean_g, champion_g, test_g].into_iter().filter(|metric| !metric.is_empty());
    let metrics = metrics.map(table).collect::<PyResult<_>>()?;
    let policies = policies.collect::<PyResult<_>>()?;
    let arrays = |trials: Vec<Vec<f32>>| trials.into_iter().map(|trial| PyArray1::from_vec(py, trial)).collect();
    let end = ending.map(|Ending { weights, fitness }| (arrays(weights), arrays(fitness)));
    Ok((Config(config), metrics, policies, digest, end))
}

/// State that a longer run continues from: of each trial the weights, if they are needed, and the scores.
type End<T> = Option<(Vec<T>, Vec<T>)>;

/// The fields of [`ProcessorInfo`], the time when the training started, the digest of the initial policies if they were
/// given, and whether the fitness was not the config's.
type Played = (String, String, Option<String>, Option<String>, usize, String, Option<String>, bool);

fn played(processor: ProcessorInfo, started: String, init: Option<String>, own_fitness: bool) -> Played {
    let ProcessorInfo { backend, description, adapter, driver, threads, .. } = processor;
    (backend, description, adapter, driver, threads, started, init, own_fitness)
}

/// Trains in memory. Also returns the backend, and the seconds at which each generation was complete.
#[pyfunction]
pub fn train<'py>(
    py: Python<'py>,
    config: &Config,
    backend: &str,
    callback: Option<Py<PyAny>>,
    champions: bool,
) -> PyResult<(Outcomes<'py>, Played, Vec<f64>)> {
    let started = folder::now();
    let watcher = Watcher { callback: callback.as_ref(), populations: config.0.populations() };
    let (trained, digest, seconds, processor) =
        perform(py, backend, "", &|rows, last, champions| watcher.tell(rows, last, champions), |backends, context| {
            let (trained, seconds, processor) = ops::train::in_memory(&config.0, champions, backends, context)?;
            let digest = trained.digest();
            Ok((trained, digest, seconds, processor))
        })?;
    Ok((outcomes(py, trained, digest)?, played(processor, started, None, false), seconds))
}

/// Returns the number of policies, and the given policies, `[populations][policies][parameters]`, of each trial.
pub fn first_policies(policies: &[PyReadonlyArray3<'_, f32>]) -> PyResult<(usize, Vec<Vec<f32>>)> {
    let count = policies.first().map_or(0, |policies| policies.shape()[1]);
    if policies.iter().any(|policies| policies.shape()[1] != count) {
        return Err(PyValueError::new_err("init: all trials must have the same number of policies"));
    }
    let copied = |policies: &PyReadonlyArray3<'_, f32>| Ok(contiguous("init is", policies.as_slice())?.to_vec());
    Ok((count, policies.iter().map(copied).collect::<PyResult<_>>()?))
}

/// Writes policies, one array `[populations, policies, parameters]` per trial, as a file of a config that has so many.
#[pyfunction]
pub fn write_policies(config: &Config, policies: Vec<PyReadonlyArray3<'_, f32>>, path: PathBuf) -> PyResult<()> {
    let shape = [config.0.populations(), config.0.learning.population, config.0.parameters()];
    if policies.len() != config.0.learning.trials || policies.iter().any(|policies| policies.shape() != shape) {
        return Err(PyValueError::new_err(format!("init must have the shape {shape:?}")));
    }
    let (_, weights) = first_policies(&policies)?;
    let weights: Vec<&[f32]> = weights.iter().map(|weights| &weights[..]).collect();
    policies::write(&Disk::default(), &path, &config.0, &weights).raise()?;
    Ok(())
}

/// Trains in a run directory, as `flotilla train` does. [`open`] reads the results.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "these are all that a run is")]
pub fn train_into(
    py: Python<'_>,
    config: &Config,
    out: PathBuf,
    start: &str,
    init: Option<PathBuf>,
    backend: &str,
    command: &str,
    callback: Option<Py<PyAny>>,
) -> PyResult<()> {
    let start = match start {
        "resume" => Start::Resume,
        "force" => Start::Force,
        _ => Start::Fresh,
    };
    let config = ConfigText { text: config.0.to_toml(), name: "config".into(), set: vec![] };
    let request = TrainRequest { config, name: "run".into(), out: Some(out), start, init };
    let watcher = Watcher { callback: callback.as_ref(), populations: 0 };
    let watch = |rows: &[Row], last, _: Option<&[f32]>| watcher.tell(rows, last, None);
    perform(py, backend, command, &watch, |backends, context| ops::train::run(&request, backends, context)).map(drop)
}

/// Reads a finished run.
#[pyfunction]
pub fn open(py: Python<'_>, folder: PathBuf, unverified: bool) -> PyResult<(Outcomes<'_>, Played, Vec<f64>)> {
    let (trained, digest, run, times) = workers::aside(py, || {
        let trained = runs::trained(&folder, Verification::unless(unverified)).raise()?;
        let run = folder::Run::read(&folder.join(folder::RUN)).raise()?;
        let digest = trained.digest();
        let path = folder.join(METRICS);
        let times = metrics::open(&path).raise()?.filter_map(|row| match row {
            Ok((row, seconds)) => (row.trial == 0).then_some(Ok(seconds)),
            Err(reason) => Some(Err(RecordError::Damaged { path: path.clone(), reason: reason.to_string() })),
        });
        Ok::<_, PyErr>((trained, digest, run, times.collect::<Result<_, _>>().raise()?))
    })?;
    Ok((outcomes(py, trained, digest)?, played(run.processor, run.started, run.init, run.own_fitness), times))
}

/// Writes the results of a training in memory as a run directory, and returns the digest.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "these are all that a run is")]
pub fn save(
    py: Python<'_>,
    config: &Config,
    metrics: Vec<PyReadonlyArray2<'_, f64>>,
    policies: Vec<PyReadonlyArray3<'_, f32>>,
    end: End<PyReadonlyArray1<'_, f32>>,
    times: Vec<f64>,
    played: Played,
    folder: PathBuf,
    force: bool,
    command: &str,
) -> PyResult<String> {
    let (config, learning) = (&config.0, &config.0.learning);
    let (trials, columns) = (learning.trials, learning.generations + 1);
    let shape = [config.populations(), learning.population, config.parameters()];
    let fits = metrics.len() == 3 + usize::from(learning.test_episodes > 0)
        && metrics.iter().all(|metrics| metrics.shape() == [trials, columns])
        && policies.len() == trials
        && policies.iter().all(|policies| policies.shape() == shape)
        && times.len() == columns
        && end.iter().all(|(weights, fitness)| {
            let slots = config.populations() * learning.slots() * config.parameters();
            let scores = config.fitness_len();
            let of =
                |all: &[PyReadonlyArray1<'_, f32>], len| all.len() == trials && all.iter().all(|one| one.len() == len);
            (weights.is_empty() || of(weights, slots)) && of(fitness, scores)
        });
    let slices = |fits: bool| {
        let metrics = metrics.iter().map(|metrics| metrics.as_slice().ok()).collect::<Option<Vec<_>>>()?;
        let policies = policies.iter().map(|policies| policies.as_slice().ok()).collect::<Option<Vec<_>>>()?;
        fits.then_some((metrics, policies))
    };
    let Some((scores, weights)) = slices(fits) else {
        return Err(PyValueError::new_err("the run's arrays no longer have the shapes that its config gives them"));
    };
    let copies = |trials: Vec<PyReadonlyArray1<'_, f32>>| {
        trials.iter().map(|trial| trial.as_array().iter().copied().collect()).collect()
    };
    let ending = end.map(|(weights, fitness)| Ending { weights: copies(weights), fitness: copies(fitness) });
    let rows = (0..columns).flat_map(|generation| (0..trials).map(move |trial| (generation, trial)));
    let row = |(generation, trial): (usize, usize)| {
        let of = |score: &[f64]| score[trial * columns + generation];
        let (best_g, mean_g, champion_g) = (of(scores[0]), of(scores[1]), of(scores[2]));
        let test_g = scores.get(3).map(|test_g| of(test_g));
        (Row { experiment: 0, trial, generation, best_g, mean_g, champion_g, test_g }, times[generation])
    };
    let rows: Vec<(Row, f64)> = rows.map(row).collect();
    workers::aside(py, || {
        let (backend, description, adapter, driver, threads, started, init, own_fitness) = played;
        let processor = ProcessorInfo { backend, description, adapter, driver, threads };
        let run = folder::Run { init, own_fitness, ..processor.record(config, command, started) };
        let finished = Finished { config, rows: &rows, policies: &weights, ending, run };
        let start = if force { Start::Force } else { Start::Fresh };
        let (mut kept, _) = Folder::open(&folder, start, config, StartFrom::Random, Disk::default()).raise()?;
        ops::train::save(finished, &mut kept).raise()
    })
}
