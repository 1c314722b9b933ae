//! Training by ask and tell.

use std::sync::{Mutex, MutexGuard};

use flotilla::front;
use flotilla::trainer::{Row, Snapshot};
use flotilla_app::choice::Work;
use numpy::{PyArray1, PyArray2, PyArray3, PyArray4, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::prelude::*;

use crate::config::Config;
use crate::errors::{Raise, contiguous};
use crate::train::{Generation, Outcomes, outcomes};
use crate::workers;

/// The state of a training, with one array for all trials, the rows, and
/// whether any fitness was not the config's.
type State<'py> = (usize, Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>, Vec<Flat>, Vec<Flat>, bool);
type Given<'py> = (usize, PyReadonlyArray1<'py, f32>, PyReadonlyArray1<'py, f32>, Vec<Flat>, Vec<Flat>, bool);
/// Policies `[trials, populations, slots, parameters]`, teams `[trials, teams, leaders]`, and starts
/// `[trials, episodes, agents (+ pois), 2]`.
type Candidates<'py> = (Bound<'py, PyArray4<f32>>, Bound<'py, PyArray3<u32>>, Bound<'py, PyArray4<f32>>);

/// A training whose caller scores the policies.
#[pyclass(frozen)]
pub struct Coevolution {
    inner: Mutex<front::Coevolution>,
}

impl Coevolution {
    fn lock(&self) -> PyResult<MutexGuard<'_, front::Coevolution>> {
        workers::locked(&self.inner, "another thread uses this Coevolution: make one Coevolution per thread")
    }
}

/// A row: generation, trial, best, mean, champion and test G.
type Flat = (usize, usize, f64, f64, f64, Option<f64>);

fn flat(row: &Row) -> Flat {
    (row.generation, row.trial, row.best_g, row.mean_g, row.champion_g, row.test_g)
}

fn row((generation, trial, best_g, mean_g, champion_g, test_g): Flat) -> Row {
    Row { experiment: 0, trial, generation, best_g, mean_g, champion_g, test_g }
}

#[pymethods]
impl Coevolution {
    #[new]
    fn new(py: Python<'_>, config: &Config) -> PyResult<Coevolution> {
        let made = workers::aside(py, || front::Coevolution::new(&config.0)).raise()?;
        Ok(Coevolution { inner: Mutex::new(made) })
    }

    /// Replaces the random policies by given ones, `[populations, policies, parameters]` per trial.
    fn start_from(&self, policies: Vec<PyReadonlyArray3<'_, f32>>) -> PyResult<()> {
        let (count, first) = crate::train::first_policies(&policies)?;
        self.lock()?.start_from(count, &first).raise()
    }

    #[getter]
    fn generation(&self) -> PyResult<usize> {
        Ok(self.lock()?.generation())
    }

    /// Teams of the generation per trial, without the champions'.
    #[getter]
    fn teams(&self) -> PyResult<usize> {
        Ok(self.lock()?.world().1)
    }

    #[getter]
    fn done(&self) -> PyResult<bool> {
        Ok(self.lock()?.is_done())
    }

    /// Whether any fitness so far was not the config's.
    #[getter]
    fn own_fitness(&self) -> PyResult<bool> {
        Ok(self.lock()?.own_fitness())
    }

    fn ask<'py>(&self, py: Python<'py>) -> PyResult<Candidates<'py>> {
        let mut inner = self.lock()?;
        let config = inner.config().clone();
        let (leaders, count) = (inner.world().0.leaders(), inner.world().1);
        let (populations, slots) = (config.populations(), config.learning.slots());
        let asked = inner.ask().raise()?;
        let trials = asked.len();
        let (mut weights, mut teams, mut starts) = (Vec::new(), Vec::new(), Vec::new());
        weights.reserve_exact(trials * populations * slots * config.parameters());
        for trial in &asked {
            weights.extend_from_slice(trial.weights);
            teams.extend_from_slice(&trial.teams[..count * leaders]);
            starts.extend(trial.starts.iter().flatten().flat_map(|place| place.to_array()));
        }
        let (episodes, places) = (asked[0].starts.len(), asked[0].starts[0].len());
        Ok((
            PyArray1::from_vec(py, weights).reshape([trials, populations, slots, config.parameters()])?,
            PyArray1::from_vec(py, teams).reshape([trials, count, leaders])?,
            PyArray1::from_vec(py, starts).reshape([trials, episodes, places, 2])?,
        ))
    }

    /// Plays the generation. Returns G `[trials, teams]`, and the config's fitness `[trials, teams, leaders]`.
    #[expect(clippy::type_complexity, reason = "it is taken apart at once")]
    fn play<'py>(
        &self,
        py: Python<'py>,
        backend: &str,
    ) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray3<f32>>)> {
        let work = Work::of_generation(self.lock()?.config());
        let (trials, teams, leaders, (g, fitness)) = workers::play(py, backend, work, |(backend, _)| {
            let mut inner = self.lock()?;
            let played = inner.play(&mut **backend).raise()?;
            let (world, teams) = inner.world();
            Ok((inner.config().learning.trials, teams, world.leaders(), played))
        })?;
        Ok((
            PyArray1::from_vec(py, g).reshape([trials, teams])?,
            PyArray1::from_vec(py, fitness).reshape([trials, teams, leaders])?,
        ))
    }

    /// Breeds the next generation, and returns the generations that became complete.
    fn tell(&self, py: Python<'_>, fitness: PyReadonlyArray3<'_, f32>, backend: &str) -> PyResult<Vec<Generation>> {
        let fitness = contiguous("fitness is", fitness.as_slice())?;
        workers::play(py, backend, Work::default(), |(backend, _)| {
            let mut inner = self.lock()?;
            let told = inner.tell(&mut **backend, Some(fitness)).raise()?;
            Ok(Generation::of_rows(told.rows, told.last))
        })
    }

    /// Returns the champions of the generation that was told last, `[trials, populations, parameters]`.
    fn best<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let mut inner = self.lock()?;
        let best = inner.best().raise()?;
        let config = inner.config();
        PyArray1::from_vec(py, best).reshape([config.learning.trials, config.populations(), config.parameters()])
    }

    fn state<'py>(&self, py: Python<'py>) -> PyResult<State<'py>> {
        let front::Progress { snapshot, rows, own_fitness } = self.lock()?.state().raise()?;
        let Snapshot { generation, weights, fitness, pending, .. } = snapshot;
        let whole = |trials: Vec<Vec<f32>>| PyArray1::from_vec(py, trials.concat());
        let pending = pending.iter().flatten().map(flat).collect();
        Ok((generation, whole(weights), whole(fitness), pending, rows.iter().map(flat).collect(), own_fitness))
    }

    fn restore(&self, state: Given<'_>) -> PyResult<()> {
        let mut inner = self.lock()?;
        let (generation, weights, fitness, pending, rows, own_fitness) = state;
        let (trials, last) = (inner.config().learning.trials, inner.config().learning.generations);
        let split = |numbers: &[f32]| {
            numbers.chunks(numbers.len().div_ceil(trials).max(1)).map(<[f32]>::to_vec).collect::<Vec<_>>()
        };
        let pending =
            if generation == 0 { vec![None; trials] } else { pending.into_iter().map(|r| Some(row(r))).collect() };
        let (weights, fitness) = (split(weights.as_slice()?), split(fitness.as_slice()?));
        let snapshot = Snapshot { generation, last, weights, fitness, pending };
        let rows = rows.into_iter().map(row).collect();
        inner.restore(front::Progress { snapshot, rows, own_fitness }).raise()
    }

    /// Returns the results of a training that is done.
    fn finish<'py>(&self, py: Python<'py>) -> PyResult<Outcomes<'py>> {
        let trained = self.lock()?.finish().raise()?;
        let digest = trained.digest();
        outcomes(py, trained, digest)
    }
}
