//! Trains in memory, or in a run directory as the program does.

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use flotilla::backend::{Backend, OpenBackend};
use flotilla::choice::Work;
use flotilla::front::{self, Coevolution, Trained};
use flotilla::ops::{self, ConfigText, train::Request};
use flotilla::record::digests::Verification;
use flotilla::record::disk::Disk;
use flotilla::record::finished::Finished;
use flotilla::record::folder::{self, Folder, METRICS, Start, StartFrom};
use flotilla::record::{RecordError, metrics, policies};
use flotilla::trainer::{Ending, Row};
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBool;

use crate::config::Config;
use crate::errors::Raise;
use crate::program::perform;
use crate::workers;

/// Minimum time between checks for Ctrl-C if there is no callback.
const PATIENCE: Duration = Duration::from_millis(50);

/// One generation, as callbacks of `train` receive it.
///
/// Attributes:
///     generation: its number; 0 is the random start.
///     last: the number of the last generation.
///     best_g: G of its best team, float64 `[trials]`.
///     mean_g: mean G of its teams, of the same shape.
///     champion_g: G of the champion, the team of every population's best policy, of the same shape.
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

/// Calls the callback after every generation, and checks for Ctrl-C.
struct Watcher<'a> {
    callback: Option<&'a Py<PyAny>>,
    asked: Instant,
    error: Option<PyErr>,
    /// Seconds since the start of training at which each generation was complete.
    times: Vec<f64>,
    since: Instant,
}

impl<'a> Watcher<'a> {
    fn new(callback: Option<&'a Py<PyAny>>) -> Watcher<'a> {
        Watcher { callback, asked: Instant::now(), error: None, times: vec![], since: Instant::now() }
    }

    /// Reports a generation to the callback. Returns whether to stop.
    fn tell(&mut self, rows: &[Row], last: usize, champions: Option<(Vec<f32>, usize)>) -> bool {
        self.times.push(self.since.elapsed().as_secs_f64());
        if self.callback.is_none() && self.asked.elapsed() < PATIENCE {
            return false;
        }
        let told = Python::attach(|py| {
            py.check_signals()?;
            let (Some(callback), Some(row)) = (self.callback, rows.first()) else { return Ok(false) };
            let answer = callback.bind(py).call1((Generation {
                generation: row.generation,
                last,
                rows: rows.into(),
                champions,
            },))?;
            if answer.is_none() {
                return Ok(false);
            }
            let named = |name: &str| answer.get_type().name().is_ok_and(|found| found == name);
            if answer.is_instance_of::<PyBool>() || named("bool") || named("bool_") {
                return answer.is_truthy();
            }
            let text = format!("the callback gave {answer:.60}, allowed are True to stop, False and None");
            Err(PyTypeError::new_err(text))
        });
        self.asked = Instant::now();
        told.unwrap_or_else(|error| {
            self.error = Some(error);
            true
        })
    }
}

/// The result of a training: config, metrics, policies and digest.
///
/// Each of the three metrics is `[trials, generations + 1]`, and each trial's policies are
/// `[leaders or 1, policies, parameters]`.
pub type Outcomes<'py> =
    (Config, [Bound<'py, PyArray2<f64>>; 3], Vec<Bound<'py, PyArray3<f32>>>, String, End<Bound<'py, PyArray1<f32>>>);

pub fn outcomes(py: Python<'_>, trained: Trained, digest: String) -> PyResult<Outcomes<'_>> {
    let Trained { config, best_g, mean_g, champion_g, policies, ending, .. } = trained;
    let learning = &config.learning;
    let table = |values| PyArray1::from_vec(py, values).reshape([learning.trials, learning.generations + 1]);
    let shape = [config.populations(), learning.population, config.parameters()];
    let policies = policies.into_iter().map(|trial| PyArray1::from_vec(py, trial).reshape(shape));
    let metrics = [table(best_g)?, table(mean_g)?, table(champion_g)?];
    let policies = policies.collect::<PyResult<_>>()?;
    let end = ending.map(|Ending { fitness, pending }| {
        (fitness.into_iter().map(|scores| PyArray1::from_vec(py, scores)).collect(), pending)
    });
    Ok((Config(config), metrics, policies, digest, end))
}

/// State that a longer run continues from: each trial's scores, `[leaders or 1][policies]`, and the best and mean G of the last
/// generation.
type End<T> = Option<(Vec<T>, Vec<Option<[f64; 2]>>)>;

/// The backend, "cpu" or "gpu", its description, and the digest of the initial policies if they were given.
type Played = (String, String, Option<String>);

fn named((backend, machine): &OpenBackend) -> Played {
    (machine.backend.clone(), backend.describe(), None)
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
    let mut watcher = Watcher::new(callback.as_ref());
    let (trained, digest, played) = workers::play(py, backend, Work::of([&config.0]), |player| {
        let played = named(player);
        if champions {
            let trained = with_champions(&config.0, &mut *player.0, &mut watcher)?;
            let digest = trained.digest();
            return Ok((trained, digest, played));
        }
        let trained = front::train(&config.0, &mut *player.0, |generation| {
            let stop = watcher.error.is_none() && watcher.tell(generation.rows, generation.last, None);
            if stop { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        let trained = trained.raise()?;
        let digest = trained.digest();
        Ok((trained, digest, played))
    })?;
    if let Some(error) = watcher.error {
        return Err(error);
    }
    // After a stop, one more generation is played, which the watcher has not seen.
    watcher.times.resize(trained.config.learning.generations + 1, watcher.since.elapsed().as_secs_f64());
    Ok((outcomes(py, trained, digest)?, played, watcher.times))
}

/// Trains with the champions of every generation for the callback. The populations stay on the host.
fn with_champions(
    config: &flotilla::Config,
    backend: &mut dyn Backend,
    watcher: &mut Watcher<'_>,
) -> PyResult<Trained> {
    let mut coevolution = Coevolution::new(config).raise()?;
    let (mut champions, mut stopped) = (Vec::new(), false);
    while !coevolution.is_done() {
        let told = coevolution.tell(backend, None).raise()?;
        let (rows, last) = (told.rows.to_vec(), told.last);
        let next = coevolution.best().raise()?;
        // A generation is complete when its champions have played with the next one.
        for (place, rows) in rows.chunk_by(|a, b| a.generation == b.generation).enumerate() {
            let own = if place == 0 && !champions.is_empty() { &champions } else { &next };
            if !stopped
                && watcher.error.is_none()
                && watcher.tell(rows, last, Some((own.clone(), config.populations())))
            {
                stopped = true;
                if !coevolution.is_done() {
                    coevolution.stop();
                }
            }
        }
        champions = next;
    }
    coevolution.finish().raise()
}

/// Returns the number of policies, and the given policies, `[populations][policies][parameters]`, of each trial.
pub fn first_policies(policies: &[PyReadonlyArray3<'_, f32>]) -> PyResult<(usize, Vec<Vec<f32>>)> {
    let count = policies.first().map_or(0, |policies| policies.shape()[1]);
    if policies.iter().any(|policies| policies.shape()[1] != count) {
        return Err(PyValueError::new_err("init: all trials must have the same number of policies"));
    }
    let contiguous = |policies: &PyReadonlyArray3<'_, f32>| {
        let slice = policies.as_slice().map_err(|_| PyValueError::new_err("init is not C-contiguous"))?;
        PyResult::Ok(slice.to_vec())
    };
    Ok((count, policies.iter().map(contiguous).collect::<PyResult<_>>()?))
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
    let request = Request { config, name: "run".into(), out: Some(out), start, init, tensorboard: false };
    let mut watcher = Watcher::new(callback.as_ref());
    let mut watch = |rows: &[Row], last| {
        let stop = watcher.tell(rows, last, None);
        watcher.error.take().map_or(Ok(stop), Err)
    };
    perform(py, backend, command, &mut watch, |player, context| ops::train::run(&request, player, context)).map(drop)
}

/// Reads a finished run.
#[pyfunction]
pub fn open(py: Python<'_>, folder: PathBuf, unverified: bool) -> PyResult<(Outcomes<'_>, Played, Vec<f64>)> {
    let (trained, digest, run, times) = workers::aside(py, || {
        let trained = Trained::read(&folder, Verification::unless(unverified)).raise()?;
        let run = folder::Run::read(&folder.join(folder::RUN)).raise()?;
        let digest = trained.digest();
        let path = folder.join(METRICS);
        let times = metrics::open(&path).raise()?.filter_map(|row| match row {
            Ok((row, seconds)) => (row.trial == 0).then_some(Ok(seconds)),
            Err(reason) => Some(Err(RecordError::Damaged { path: path.clone(), reason: reason.to_string() })),
        });
        Ok::<_, PyErr>((trained, digest, run, times.collect::<Result<_, _>>().raise()?))
    })?;
    Ok((outcomes(py, trained, digest)?, (run.backend, run.description, run.init), times))
}

/// Writes the results of a training in memory as a run directory, and returns the digest.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "these are all that a run is")]
pub fn save(
    py: Python<'_>,
    config: &Config,
    metrics: [PyReadonlyArray2<'_, f64>; 3],
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
    let fits = metrics.iter().all(|metrics| metrics.shape() == [trials, columns])
        && policies.len() == trials
        && policies.iter().all(|policies| policies.shape() == shape)
        && times.len() == columns
        && end.iter().all(|(fitness, pending)| {
            let scores = config.populations() * learning.population;
            fitness.len() == trials && pending.len() == trials && fitness.iter().all(|trial| trial.len() == scores)
        });
    let slices = |fits: bool| {
        let metrics = metrics.iter().map(|metrics| metrics.as_slice().ok()).collect::<Option<Vec<_>>>()?;
        let policies = policies.iter().map(|policies| policies.as_slice().ok()).collect::<Option<Vec<_>>>()?;
        fits.then_some((metrics, policies))
    };
    let Some((scores, weights)) = slices(fits) else {
        return Err(PyValueError::new_err("the run's arrays no longer have the shapes that its config gives them"));
    };
    let ending = end.map(|(fitness, pending)| {
        let fitness = fitness.iter().map(|trial| trial.as_array().iter().copied().collect()).collect();
        Ending { fitness, pending }
    });
    let rows = (0..columns).flat_map(|generation| (0..trials).map(move |trial| (generation, trial)));
    let row = |(generation, trial): (usize, usize)| {
        let of = |score: &[f64]| score[trial * columns + generation];
        let (best_g, mean_g, champion_g) = (of(scores[0]), of(scores[1]), of(scores[2]));
        (Row { experiment: 0, trial, generation, best_g, mean_g, champion_g }, times[generation])
    };
    let rows: Vec<(Row, f64)> = rows.map(row).collect();
    workers::aside(py, || {
        let (backend, description, init) = played;
        let run = folder::Run {
            version: env!("CARGO_PKG_VERSION").into(),
            backend,
            description,
            threads: rayon::current_num_threads(),
            updated: folder::now(),
            sessions: 1,
            command: command.into(),
            commit: flotilla::COMMIT.map(String::from),
            init,
            ..folder::Run::new(config)
        };
        let finished = Finished { config, rows: &rows, policies: &weights, ending, run };
        let start = if force { Start::Force } else { Start::Fresh };
        let (mut kept, _) = Folder::open(&folder, start, config, StartFrom::Random, Disk::default()).raise()?;
        ops::train::save(finished, &mut kept).raise()
    })
}
