//! Plays teams of given policies.

use flotilla::evaluate::Starts;
use flotilla::front::{self, Failure, Played, Traced};
use flotilla::world::{INPUTS, OUTPUTS, World};
use numpy::{PyArray1, PyArray2, PyArray3, PyArray4, PyArrayMethods, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::config::Config;
use crate::errors::Raise;
use crate::workers;

/// Returns the starts of episodes: the config's own, or held-out ones, from `(episodes, seed, jitter, poi_jitter)`.
fn drawn(drawn: Option<(u32, u64, f64, f64)>) -> Starts {
    drawn.map_or(Starts::Own, |(episodes, seed, jitter, poi_jitter)| Starts::Drawn {
        episodes,
        seed,
        jitter,
        poi_jitter,
    })
}

/// Returns the number of teams and the policies, `[leaders or 1][teams][parameters]`, without a copy.
fn weights<'a>(config: &Config, policies: &'a PyReadonlyArray3<'_, f32>) -> PyResult<(usize, &'a [f32])> {
    let (&[leaders, teams, parameters], config) = (policies.shape(), &config.0) else { unreachable!("three axes") };
    let (all, expected) = (config.learners(), config.parameters());
    if parameters != expected || ![1, all].contains(&leaders) || teams == 0 {
        return Err(PyValueError::new_err(format!(
            "policies are [{leaders}, {teams}, {parameters}], allowed is [leaders, teams, parameters] = [{all}, 1 or more, \
             {expected}], or [1, 1 or more, {expected}] where leaders share a policy"
        )));
    }
    Ok((teams, policies.as_slice().map_err(|_| PyValueError::new_err("policies are not C-contiguous"))?))
}

type Scores<'py> = (
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Option<Bound<'py, PyArray2<f32>>>,
);

/// Plays teams. Returns POIs observed and G, `[teams]`, and D, Df, D++ and Dt, `[teams, leaders]`.
///
/// Dt is `None` unless it is the config's fitness.
#[pyfunction]
pub fn rollout<'py>(
    py: Python<'py>,
    config: &Config,
    policies: PyReadonlyArray3<'py, f32>,
    starts: Option<(u32, u64, f64, f64)>,
    backend: &str,
) -> PyResult<Scores<'py>> {
    let (teams, weights) = weights(config, &policies)?;
    let starts = drawn(starts);
    let played = workers::play(py, backend, |(backend, _)| {
        front::play(&config.0, &mut **backend, teams, weights, &starts).raise()
    })?;
    let Played { observed, g, d, df, dpp, dt, .. } = played;
    let timed = !dt.is_empty();
    let shape = [teams, config.0.learners()];
    let rows = |scores: Vec<f32>| PyArray1::from_vec(py, scores).reshape(shape);
    Ok((
        PyArray1::from_vec(py, observed),
        PyArray1::from_vec(py, g),
        rows(d)?,
        rows(df)?,
        rows(dpp)?,
        timed.then(|| rows(dt)).transpose()?,
    ))
}

type Motion<'py> = (
    Bound<'py, PyArray4<f32>>,
    Bound<'py, PyArray4<f32>>,
    Bound<'py, PyArray3<f32>>,
    Bound<'py, PyArray4<f32>>,
    Bound<'py, PyArray4<f32>>,
    Bound<'py, PyArray4<u32>>,
);

/// Plays one episode, and returns every step of all teams.
///
/// The arrays are positions and headings `[teams, steps + 1, agents, 2]`, speeds `[teams, steps + 1, agents]`, inputs
/// `[teams, steps, leaders, 8]` and outputs `[teams, steps, leaders, 2]`. The last array is
/// `[teams, steps, pois, words]`, with one bit per agent within the observation radius of each POI.
#[pyfunction]
pub fn trace<'py>(
    py: Python<'py>,
    config: &Config,
    policies: PyReadonlyArray3<'py, f32>,
    starts: Option<(u32, u64, f64, f64)>,
    episode: usize,
    backend: &str,
) -> PyResult<Motion<'py>> {
    let (teams, weights) = weights(config, &policies)?;
    let starts = drawn(starts);
    let (world, traced) = workers::play(py, backend, |(backend, _)| {
        let traced = front::trace(&config.0, &mut **backend, teams, weights, &starts, episode).raise()?;
        Ok((World::new(&config.0), traced))
    })?;
    let Traced { positions, headings, speeds, inputs, outputs, near, .. } = traced;
    let (steps, agents, leaders, pois) = (world.steps(), world.agents(), world.leaders(), world.pois.len());
    let of_four = |values, shape: [usize; 4]| PyArray1::from_vec(py, values).reshape(shape);
    Ok((
        of_four(positions, [teams, steps + 1, agents, 2])?,
        of_four(headings, [teams, steps + 1, agents, 2])?,
        PyArray1::from_vec(py, speeds).reshape([teams, steps + 1, agents])?,
        of_four(inputs, [teams, steps, leaders, INPUTS])?,
        of_four(outputs, [teams, steps, leaders, OUTPUTS])?,
        PyArray1::from_vec(py, near).reshape([teams, steps, pois, world.constants.words as usize])?,
    ))
}

/// Draws start positions, `[count, agents, 2]`, moved by at most `jitter` on each axis, in map units.
///
/// Team `i` uses draw number `first + i`.
#[pyfunction]
pub fn starts<'py>(
    py: Python<'py>,
    config: &Config,
    seed: u64,
    jitter: f64,
    first: usize,
    count: usize,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let world = World::new(&config.0);
    let bytes = (count as u128) * world.agents() as u128 * 8;
    if !(jitter.is_finite() && jitter >= 0.0 && usize::try_from(bytes).is_ok_and(|bytes| bytes < 1 << 36)) {
        return Err(Failure::Starts { episodes: count.try_into().unwrap_or(u32::MAX), jitter }).raise();
    }
    let starts = Starts::Drawn { episodes: 1, seed, jitter, poi_jitter: 0.0 };
    let places = workers::aside(py, || {
        let mut places = Vec::with_capacity(count * world.agents() * 2);
        (0..count).for_each(|team| {
            let drawn = starts.of(first.wrapping_add(team), &world);
            places.extend(drawn.into_iter().flat_map(|place| place.to_array()));
        });
        places
    });
    PyArray1::from_vec(py, places).reshape([count, world.agents(), 2])
}
