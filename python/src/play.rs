//! Plays teams of given policies.

use std::ops::ControlFlow;
use std::time::Instant;

use flotilla::backend::cpu::{self, StepArrays};
use flotilla::config::{Actions, Choice, Fitness, MAX_HIDDEN_UNITS};
use flotilla::evaluate::{self, Batch, Spread, Starts, Tally};
use flotilla::evolve::{self, MAX_WEIGHT};
use flotilla::front::{self, ActionNoise, Failure, Played, Scored};
use flotilla::model::policy::{MAX_HIDDEN_LAYERS, PolicyConstants};
use flotilla::world::{OUTPUTS, World};
use flotilla_app::choice::Work;
use glam::Vec2;
use numpy::{
    Element, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
    PyReadonlyArray4, PyReadwriteArray2, PyReadwriteArrayDyn, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use rayon::prelude::*;

use crate::config::Config;
use crate::errors::{Raise, contiguous};
use crate::workers::{self, PATIENCE};

/// Returns the starts of episodes: the config's own, or held-out ones, from `(episodes, seed, jitter, poi_jitter)`.
pub fn drawn(drawn: Option<(u32, u64, f64, f64)>) -> Starts {
    drawn.map_or(Starts::Own, |(episodes, seed, jitter, poi_jitter)| Starts::Drawn {
        episodes,
        seed,
        jitter,
        poi_jitter,
    })
}

/// Returns the number of teams and the policies, `[populations][teams][parameters]`, without a copy.
pub fn weights<'a>(config: &Config, policies: &'a PyReadonlyArray3<'_, f32>) -> PyResult<(usize, &'a [f32])> {
    let (&[leaders, teams, parameters], config) = (policies.shape(), &config.0) else { unreachable!("three axes") };
    let (all, expected) = (config.learners(), config.parameters());
    if parameters != expected || ![1, all, config.populations()].contains(&leaders) || teams == 0 {
        return Err(PyValueError::new_err(format!(
            "policies are [{leaders}, {teams}, {parameters}], allowed is [leaders, teams, parameters] = [{all}, 1 or more, \
             {expected}], or [1, 1 or more, {expected}] if leaders share a policy"
        )));
    }
    Ok((teams, contiguous("policies are", policies.as_slice())?))
}

type Scores<'py> = (
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Option<Bound<'py, PyArray2<f32>>>,
);
/// See `rollout`.
type Spreads<'py> = (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<u32>>);

type PathScores<'py> = (
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
);

/// Scores paths, `[teams, steps + 1, agents, 2]`. Returns the values observed and G, `[teams]`, and D, Df, D++, Dt and the
/// fitness of the config, `[teams, learners]`.
#[pyfunction]
pub fn score<'py>(
    py: Python<'py>,
    config: &Config,
    positions: PyReadonlyArray4<'py, f32>,
) -> PyResult<PathScores<'py>> {
    let teams = positions.shape()[0];
    let positions = contiguous("positions are", positions.as_slice())?;
    let scored = workers::aside(py, || front::score(&config.0, positions).raise())?;
    let rows = |scores: Vec<f32>| PyArray1::from_vec(py, scores).reshape([teams, config.0.learners()]);
    let Scored { value, g, d, df, dpp, dt, fitness, .. } = scored;
    let (value, g) = (PyArray1::from_vec(py, value), PyArray1::from_vec(py, g));
    Ok((value, g, rows(d)?, rows(df)?, rows(dpp)?, rows(dt)?, rows(fitness)?))
}

/// Plays teams. Returns what the observed POIs are worth, `[teams]`, and D, Df, D++ and Dt, `[teams, leaders]`. Dt is
/// `None` unless it is the config's fitness.
///
/// With `spread`, also returns deviation, low and high of G times the number of POIs, `[teams, 3]`, NaN for one episode, and
/// what the POIs are worth that are observed in each episode, `[episodes, teams]`.
#[pyfunction]
pub fn rollout<'py>(
    py: Python<'py>,
    config: &Config,
    policies: PyReadonlyArray3<'py, f32>,
    starts: Option<(u32, u64, f64, f64)>,
    backend: &str,
    spread: bool,
) -> PyResult<(Scores<'py>, Option<Spreads<'py>>)> {
    let (teams, weights) = weights(config, &policies)?;
    let starts = drawn(starts);
    let episodes = starts.episodes();
    let mut each = Vec::new();
    if spread && each.try_reserve_exact(episodes.saturating_mul(teams)).is_err() {
        let bytes = 4 * episodes as u128 * teams as u128;
        return Err(Failure::Memory { what: "the scores of all episodes", bytes }).raise();
    }
    let (mut interrupted, mut asked) = (None, Instant::now());
    let work = Work::of_teams(&config.0, teams.saturating_mul(episodes));
    let evaluation = workers::play(py, backend, work, |(backend, _)| {
        let watch = &mut |batch: Batch<'_>| {
            if spread {
                each.extend_from_slice(batch.observed);
            }
            if asked.elapsed() > PATIENCE {
                asked = Instant::now();
                interrupted = Python::attach(|py| py.check_signals()).err();
            }
            if interrupted.is_some() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        front::play_until(&config.0, &mut **backend, teams, weights, &starts, watch).raise()
    })?;
    if let Some(error) = interrupted {
        return Err(error);
    }
    let spreads = spread.then(|| {
        let of_team = |team| {
            let Spread { deviation, interval, .. } = evaluation.team(team);
            let [low, high] = interval.unwrap_or([f64::NAN; 2]);
            [deviation.unwrap_or(f64::NAN), low, high]
        };
        let rows: Vec<f64> = workers::aside(py, || (0..teams).flat_map(of_team).collect());
        let each = PyArray1::from_vec(py, each).reshape([episodes, teams])?;
        PyResult::Ok((PyArray1::from_vec(py, rows).reshape([teams, 3])?, each))
    });
    let Played { d, df, dpp, dt, .. } = Played::from(&evaluation);
    let worth: Vec<f64> = evaluation.observed.iter().map(Tally::mean).collect();
    let timed = !dt.is_empty();
    let shape = [teams, config.0.learners()];
    let rows = |scores: Vec<f32>| PyArray1::from_vec(py, scores).reshape(shape);
    let dt = timed.then(|| rows(dt)).transpose()?;
    Ok(((PyArray1::from_vec(py, worth), rows(d)?, rows(df)?, rows(dpp)?, dt), spreads.transpose()?))
}

/// Plays some episodes on the CPU, and writes every step of all teams to the arrays that are given. Returns the scores
/// of each episode's teams, as `rollout`.
///
/// The arrays are positions and headings `[teams, steps + 1, agents, 2]`, speeds `[teams, steps + 1, agents]`, inputs
/// `[teams, steps, leaders, inputs]`, outputs and actions `[teams, steps, leaders, 2]`, all float32, and near
/// `[teams, steps, pois, agents]`, bool, whether each agent is within the observation radius of each POI. `observed_at`,
/// `[teams, pois]`, uint32, is the step at which each POI was observed, from 1, or 0. `distances` are those from every POI
/// to every agent, `[teams, steps, pois, agents]`, and from every agent to the nearest other one, `[teams, steps, agents]`,
/// after each step. The teams of all episodes follow each other. `noise` is a seed and the standard deviations
/// `[leaders, 2]`.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "these are all that an episode is")]
pub fn record<'py>(
    py: Python<'py>,
    config: &Config,
    policies: PyReadonlyArray3<'py, f32>,
    starts: Option<(u32, u64, f64, f64)>,
    episodes: (usize, usize),
    noise: Option<(u64, PyReadonlyArray2<'py, f32>)>,
    arrays: [Option<PyReadwriteArrayDyn<'py, f32>>; 6],
    near: Option<PyReadwriteArrayDyn<'py, bool>>,
    observed_at: Option<PyReadwriteArrayDyn<'py, u32>>,
    distances: [Option<PyReadwriteArrayDyn<'py, f32>>; 2],
) -> PyResult<Scores<'py>> {
    let (teams, weights) = weights(config, &policies)?;
    let starts = drawn(starts);
    let (mut arrays, mut near, mut observed_at, mut distances) = (arrays, near, observed_at, distances);
    let mut slices = [(); 6].map(|()| Default::default());
    for (slice, array) in slices.iter_mut().zip(&mut arrays) {
        *slice = elements(array)?;
    }
    let [of_pois, of_agents] = &mut distances;
    let (of_pois, of_agents) = (elements(of_pois)?, elements(of_agents)?);
    let [positions, headings, speeds, inputs, outputs, actions] = slices;
    let (near, observed_at) = (elements(&mut near)?, elements(&mut observed_at)?);
    let world = World::new(&config.0.validate().raise()?);
    let sets = if near.is_empty() { 0 } else { near.len() / world.agents() * world.constants.words as usize };
    let deviations: Option<Vec<[f32; OUTPUTS]>> = noise.as_ref().map(|(_, deviations)| {
        let deviations = deviations.as_array();
        deviations.rows().into_iter().map(|row| std::array::from_fn(|output| row[output])).collect()
    });
    let noise = noise.as_ref().zip(deviations.as_deref());
    let noise = noise.map(|(&(seed, _), deviations)| ActionNoise { seed, deviations });
    let scores = workers::aside(py, || {
        let mut sets = vec![0; sets];
        let near_sets = &mut sets[..];
        let states = (episodes.1.saturating_sub(episodes.0)) * teams * (world.steps() + 1) * world.agents() * 2;
        let hidden = positions.is_empty() && !(of_pois.is_empty() && of_agents.is_empty());
        let mut own = vec![0.0; if hidden { states } else { 0 }];
        let positions = if hidden { &mut own[..] } else { positions };
        let arrays = StepArrays {
            positions: &mut *positions,
            headings,
            speeds,
            inputs,
            outputs,
            actions,
            agents_at_poi: near_sets,
            observed_at,
        };
        let scores =
            front::record(&config.0, teams, weights, &starts, episodes.0..episodes.1, noise, arrays).raise()?;
        write_members(&sets, world.agents(), near);
        let places = |team: usize| {
            let mut pois = starts.of(episodes.0 + team / teams, &world).split_off(world.agents());
            pois.truncate(world.pois.len());
            pois
        };
        write_distances(&world, positions, &places, of_pois, of_agents);
        PyResult::Ok(scores)
    })?;
    let (leaders, fitnesses) = (world.leaders(), evaluate::scores_beside(&config.0));
    let rows = |index: usize| {
        let teams = scores.iter().flat_map(|episode| episode.scores.chunks_exact(fitnesses.len() * leaders));
        let rows: Vec<f32> = teams.flat_map(|scores| &scores[index * leaders..][..leaders]).copied().collect();
        let shape = [rows.len() / leaders, leaders];
        PyArray1::from_vec(py, rows).reshape(shape)
    };
    let observed: Vec<f64> =
        scores.iter().flat_map(|episode| &episode.observed).map(|&observed| observed.into()).collect();
    let dt = fitnesses.iter().position(|&fitness| fitness == Fitness::Dt).map(rows).transpose()?;
    Ok((PyArray1::from_vec(py, observed), rows(0)?, rows(1)?, rows(2)?, dt))
}

/// The bits of each byte, lowest first.
const BITS: [[bool; 8]; 256] = {
    let (mut table, mut place) = ([[false; 8]; 256], 0);
    while place < 256 * 8 {
        table[place / 8][place % 8] = (place / 8) >> (place % 8) & 1 == 1;
        place += 1;
    }
    table
};

/// Writes sets of agents, one bit per agent in whole words, as one bool per agent.
pub fn write_members(sets: &[u32], agents: usize, members: &mut [bool]) {
    /// Minimum number of sets per task.
    const MIN_SETS_PER_TASK: usize = 4096;
    let sets = sets.par_chunks(agents.div_ceil(32)).with_min_len(MIN_SETS_PER_TASK);
    members.par_chunks_mut(agents).zip(sets).for_each(|(members, set)| {
        let bytes = set.iter().flat_map(|word| word.to_le_bytes());
        for (members, byte) in members.chunks_mut(8).zip(bytes) {
            members.copy_from_slice(&BITS[usize::from(byte)][..members.len()]);
        }
    });
}

/// Writes distances after each step, `[teams][steps][pois][agents]` and `[teams][steps][agents]` to the nearest other
/// agent, unless their slices are empty. `positions` are `[teams][steps + 1][agents][2]`, and `moved_pois` returns the POIs
/// of a team, or none if they are where the world has them.
fn write_distances(
    world: &World,
    positions: &[f32],
    moved_pois: &(dyn Fn(usize) -> Vec<Vec2> + Sync),
    of_pois: &mut [f32],
    of_agents: &mut [f32],
) {
    let (agents, steps, pois) = (world.agents(), world.steps(), world.pois.len());
    let place = |place: &[f32]| Vec2::new(place[0], place[1]);
    let teams =
        || positions.par_chunks((steps + 1) * agents * 2).map(|team| team[agents * 2..].chunks_exact(agents * 2));
    teams().zip(of_pois.par_chunks_mut(steps * pois * agents)).enumerate().for_each(|(team, (steps, distances))| {
        let moved = moved_pois(team);
        let pois = if moved.is_empty() { &world.pois } else { &moved };
        let rows = steps.flat_map(|step| pois.iter().map(move |&poi| (poi, step)));
        for ((poi, step), row) in rows.zip(distances.chunks_exact_mut(agents)) {
            row.iter_mut()
                .zip(step.chunks_exact(2))
                .for_each(|(distance, agent)| *distance = poi.distance(place(agent)));
        }
    });
    teams().zip(of_agents.par_chunks_mut(steps * agents)).for_each(|(steps, distances)| {
        for (step, row) in steps.zip(distances.chunks_exact_mut(agents)) {
            for (agent, distance) in row.iter_mut().enumerate() {
                let others = step.chunks_exact(2).enumerate().filter(|&(other, _)| other != agent);
                let at = place(&step[agent * 2..]);
                *distance = others.map(|(_, other)| at.distance(place(other))).fold(f32::INFINITY, f32::min);
            }
        }
    });
}

/// Returns the elements of an array, or none.
fn elements<'a, T: Element>(array: &'a mut Option<PyReadwriteArrayDyn<'_, T>>) -> PyResult<&'a mut [T]> {
    let Some(array) = array else { return Ok(&mut []) };
    array.as_slice_mut().map_err(|_| PyValueError::new_err("arrays of steps must be C-contiguous"))
}

/// Writes what policies answer to inputs, as in an episode: `inputs` are `[rows, widths[0]]`, `outputs` `[rows, 2]`.
///
/// `policies` are `[policies, parameters]`, with layers of the given widths. Row i is answered by policy `chosen[i]`.
#[pyfunction]
pub fn forward(
    py: Python<'_>,
    widths: Vec<usize>,
    policies: PyReadonlyArray2<'_, f32>,
    inputs: PyReadonlyArray2<'_, f32>,
    chosen: PyReadonlyArray1<'_, i64>,
    mut outputs: PyReadwriteArray2<'_, f32>,
) -> PyResult<()> {
    let small = |&width: &usize| (1..=MAX_HIDDEN_UNITS).contains(&width);
    if !(2..=MAX_HIDDEN_LAYERS + 2).contains(&widths.len()) || !widths.iter().all(small) {
        return Err(PyValueError::new_err(format!(
            "layers of {widths:?} units, allowed are up to {MAX_HIDDEN_LAYERS} \
             hidden ones of 1 to {MAX_HIDDEN_UNITS}"
        )));
    }
    let outputs_of = |&(_, actions): &&(_, Actions)| actions.outputs() == widths[widths.len() - 1];
    let actions = Actions::ALL.iter().find(outputs_of).map(|(_, actions)| *actions);
    let policy = PolicyConstants::new(&widths, actions.unwrap_or(Actions::Direct));
    let parameters = policy.parameters as usize;
    let fits = actions.is_some_and(|actions| actions == Actions::Direct || widths[0] >= 8);
    let (count, rows) = (policies.shape()[0], inputs.shape()[0]);
    let chosen = chosen.as_slice()?;
    if !fits
        || policies.shape()[1] != parameters
        || inputs.shape()[1] != widths[0]
        || outputs.shape() != [rows, OUTPUTS]
        || chosen.len() != rows
        || !chosen.iter().all(|&policy| (0..count as i64).contains(&policy))
    {
        return Err(PyValueError::new_err("the arrays do not fit each other"));
    }
    let (mut weights, inputs) = (policies.as_slice()?.to_vec(), inputs.as_slice()?);
    let outputs = outputs.as_slice_mut()?;
    if let Some(place) = evolve::flush_and_validate(&mut weights) {
        let (policy, parameter) = (place / parameters, place % parameters);
        let value = weights[place];
        let text =
            format!("weight {parameter} of policy {policy} is {value}, allowed are -{MAX_WEIGHT} to {MAX_WEIGHT}");
        return Err(PyValueError::new_err(text));
    }
    workers::aside(py, || cpu::forward(&policy, &weights, inputs, &|row| chosen[row] as usize, 0, outputs));
    Ok(())
}

/// Draws start positions, `[count, agents, 2]`, moved by at most `jitter` on each axis, in map units. If POIs
/// move, they follow, `[count, agents + pois, 2]`, moved by at most that. If headings are drawn, these follow, unit vectors,
/// `[count, agents + pois + agents, 2]`.
///
/// Team `i` uses draw number `first + i`.
#[pyfunction]
pub fn starts<'py>(
    py: Python<'py>,
    config: &Config,
    seed: u64,
    jitter: f64,
    poi_jitter: f64,
    first: usize,
    count: usize,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let world = World::new(&config.0.validate().raise()?);
    let starts = Starts::Drawn { episodes: 1, seed, jitter, poi_jitter };
    let places = starts.of(0, &world).len();
    let bytes = (count as u128) * places as u128 * 8;
    if ![jitter, poi_jitter].iter().all(|jitter| jitter.is_finite() && *jitter >= 0.0)
        || !(usize::try_from(bytes).is_ok_and(|bytes| bytes < 1 << 36))
    {
        return Err(Failure::Starts { episodes: count.try_into().unwrap_or(u32::MAX), jitter }).raise();
    }
    let drawn = workers::aside(py, || {
        let mut drawn = Vec::with_capacity(count * places * 2);
        (0..count).for_each(|team| {
            let of_team = starts.of(first.wrapping_add(team), &world);
            drawn.extend(of_team.into_iter().flat_map(|place| place.to_array()));
        });
        drawn
    });
    PyArray1::from_vec(py, drawn).reshape([count, places, 2])
}
