//! Steps teams with given actions, with NumPy arrays in and out.

use std::sync::{Mutex, MutexGuard};

use flotilla::config::{Choice, Fitness};
use flotilla::front;
use flotilla::stepping;
use flotilla::world::OUTPUTS;
use flotilla_app::report::map::{Form, Marker, Poi, Team, Viewport};
use flotilla_app::report::scene::Scene;
use glam::{DVec2, Vec2};
use numpy::{
    Element, PyArray1, PyArray2, PyArray3, PyArrayDyn, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray3,
    PyReadwriteArray2, PyReadwriteArray3, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::config::Config;
use crate::errors::{Raise, contiguous};
use crate::play::write_members;
use crate::workers;

type States<'py> = (Bound<'py, PyArray3<f32>>, Bound<'py, PyArray3<f32>>, Bound<'py, PyArray2<f32>>);

const SHARED: &str = "another thread is stepping this environment: make one environment per thread";

/// Teams of one world that are stepped with given actions.
#[pyclass(frozen)]
pub struct Stepper {
    config: flotilla::Config,
    inner: Mutex<stepping::Stepper>,
}

impl Stepper {
    fn stepper(&self) -> PyResult<MutexGuard<'_, stepping::Stepper>> {
        workers::locked(&self.inner, SHARED)
    }
}

/// Copies one of the stepper's arrays to a new NumPy array.
fn copied<'py, T: Element + Copy>(
    py: Python<'py>,
    values: &[T],
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    PyArray1::from_slice(py, values).reshape(shape)
}

#[pymethods]
impl Stepper {
    #[new]
    fn new(py: Python<'_>, config: &Config, teams: usize, recording: bool) -> PyResult<Stepper> {
        let made = workers::aside(py, || front::stepper(&config.0, teams, recording)).raise()?;
        Ok(Stepper { config: config.0.clone(), inner: Mutex::new(made) })
    }

    #[getter]
    fn teams(&self) -> PyResult<usize> {
        Ok(self.stepper()?.teams())
    }

    /// Returns the state of all teams, for `restore`.
    fn save<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let state = workers::aside(py, || Ok::<_, PyErr>(self.stepper()?.save()))?;
        Ok(PyBytes::new(py, &state))
    }

    /// Puts all teams into a state that `save` returned.
    fn restore(&self, py: Python<'_>, state: &[u8]) -> PyResult<()> {
        workers::aside(py, || self.stepper()?.restore(state).raise())
    }

    /// Resets all teams, or the chosen ones, to the world's start or to the given starts `[teams, agents, 2]`, or
    /// `[teams, agents + pois, 2]` with POI positions, or `[teams, agents + pois + agents, 2]` with headings.
    fn reset(
        &self,
        py: Python<'_>,
        chosen: Option<PyReadonlyArray1<'_, bool>>,
        starts: Option<PyReadonlyArray3<'_, f32>>,
    ) -> PyResult<()> {
        let chosen = chosen.as_ref().map(|chosen| contiguous("reset_mask are", chosen.as_slice())).transpose()?;
        let starts = starts.as_ref().map(|starts| contiguous("starts are", starts.as_slice())).transpose()?;
        workers::aside(py, || {
            let mut stepper = self.stepper()?;
            match (chosen, starts) {
                (Some(chosen), starts) => stepper.reset_some(chosen, starts).raise(),
                (None, Some(starts)) => stepper.reset_to(starts).raise(),
                (None, None) => {
                    stepper.reset();
                    Ok(())
                }
            }
        })
    }

    /// Plays a step with actions `[teams, leaders, 2]`.
    ///
    /// Writes to `rewards`, `[teams, leaders]`, what the POIs are worth that each leader's team has just observed for the
    /// first time, as a share of all.
    fn step(
        &self,
        py: Python<'_>,
        actions: PyReadonlyArray3<'_, f32>,
        rewards: Option<Bound<'_, PyArray2<f32>>>,
    ) -> PyResult<()> {
        let shape = [self.teams()?, self.config.learners(), OUTPUTS];
        if actions.shape() != shape {
            let text = format!("actions are {:?}, allowed is [teams, leaders, 2] = {shape:?}", actions.shape());
            return Err(PyValueError::new_err(text));
        }
        let leaders = self.config.learners();
        let mut rewards =
            rewards.map(|rewards| rewards.try_readwrite().map_err(|_| PyValueError::new_err(SHARED))).transpose()?;
        let rewards = rewards.as_mut().map(|rewards| contiguous("rewards are", rewards.as_slice_mut())).transpose()?;
        let actions = contiguous("actions are", actions.as_slice())?;
        workers::aside(py, || {
            let mut stepper = self.stepper()?;
            stepper.step(actions).raise()?;
            let pois = self.config.poi_count();
            for (team, newly) in rewards
                .into_iter()
                .flat_map(|rewards| rewards.chunks_exact_mut(leaders).zip(stepper.newly_observed().chunks_exact(pois)))
            {
                let newly = newly.iter().zip(&stepper.world().worth).filter(|(newly, _)| **newly);
                let worth: u32 = newly.map(|(_, worth)| worth).sum();
                team.fill(worth as f32 / stepper.world().total_worth as f32);
            }
            Ok(())
        })
    }

    /// Writes each leader's fitness in the episode so far to `scores`, `[teams, leaders]`.
    fn fitness(&self, py: Python<'_>, fitness: &str, mut scores: PyReadwriteArray2<'_, f32>) -> PyResult<()> {
        let Some(&(_, fitness)) = Fitness::ALL.iter().find(|(name, _)| *name == fitness) else {
            let names: Vec<_> = Fitness::names().collect();
            return Err(PyValueError::new_err(format!("fitness {fitness:?}, allowed are {}", names.join(", "))));
        };
        let scores = contiguous("scores are", scores.as_slice_mut())?;
        workers::aside(py, || self.stepper()?.fitness(fitness, scores).raise())
    }

    /// Writes what every leader senses to `out`, `[teams, leaders, inputs]`.
    ///
    /// The interpreter's lock is held meanwhile, so no Python thread reads a half-written array.
    fn read_inputs(&self, mut out: PyReadwriteArray3<'_, f32>) -> PyResult<()> {
        let stepper = self.stepper()?;
        let shape = [stepper.teams(), stepper.world().leaders(), stepper.world().inputs()];
        if out.shape() != shape {
            let text = format!("out is {:?}, allowed is [teams, leaders, inputs] = {shape:?}", out.shape());
            return Err(PyValueError::new_err(text));
        }
        contiguous("out are", out.as_slice_mut())?.copy_from_slice(stepper.inputs());
        Ok(())
    }

    /// Whether each agent is within the observation radius of each POI, `[teams, pois, agents]`.
    #[getter]
    fn near<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<bool>>> {
        let (shape, members) = workers::aside(py, || {
            let stepper = self.stepper()?;
            let shape = [stepper.teams(), stepper.world().pois.len(), stepper.world().agents()];
            let mut members = vec![false; shape.iter().product()];
            write_members(stepper.agents_at_poi(), shape[2], &mut members);
            PyResult::Ok((shape, members))
        })?;
        PyArray1::from_vec(py, members).reshape(&shape[..])
    }

    /// POIs observed since the start, `[teams, pois]`.
    #[getter]
    fn observed<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<bool>>> {
        let stepper = self.stepper()?;
        copied(py, stepper.observed(), &[stepper.teams(), stepper.world().pois.len()])
    }

    /// Steps played since the start, `[teams]`.
    #[getter]
    fn steps<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<u32>>> {
        let stepper = self.stepper()?;
        copied(py, stepper.steps(), &[stepper.teams()])
    }

    /// Returns positions and headings `[teams, agents, 2]` and speeds `[teams, agents]`, leaders first.
    fn states<'py>(&self, py: Python<'py>) -> PyResult<States<'py>> {
        let (teams, agents) = (self.teams()?, self.config.agent_count());
        let [positions, headings, speeds] = workers::aside(py, || {
            let mut stepper = self.stepper()?;
            let stepping::States { positions, headings, speeds } = stepper.states();
            PyResult::Ok([positions, headings, speeds].map(<[f32]>::to_vec))
        })?;
        let pairs = |values| PyArray1::from_vec(py, values).reshape([teams, agents, 2]);
        Ok((pairs(positions)?, pairs(headings)?, PyArray1::from_vec(py, speeds).reshape([teams, agents])?))
    }

    /// Draws a team, `[height, width, 3]`; the longer side has the given number of pixels.
    fn render<'py>(&self, py: Python<'py>, team: usize, pixels: u32) -> PyResult<Bound<'py, PyArray3<u8>>> {
        /// Longer side in millimetres. The size of labels depends on it.
        const SIDE: f64 = 80.0;
        let drawn = workers::aside(py, || {
            let mut stepper = self.stepper()?;
            if team >= stepper.teams() {
                return Ok(None);
            }
            let team = team_of(&mut stepper, team);
            let view = Viewport::new(&self.config, [DVec2::ZERO, self.config.world.map.into()], SIDE);
            let [width, height] = view.size();
            let mut scene = Scene::new(width, height);
            view.draw(&mut scene, &team);
            let picture = scene.pixels(f64::from(pixels.clamp(16, 4096)) / SIDE);
            let rgb: Vec<u8> =
                picture.data().chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
            PyResult::Ok(Some((picture.height() as usize, picture.width() as usize, rgb)))
        })?;
        let Some((height, width, rgb)) = drawn else {
            let text = format!("team {team} of {} (they count from 0)", self.teams()?);
            return Err(PyValueError::new_err(text));
        };
        PyArray1::from_vec(py, rgb).reshape([height, width, 3])
    }
}

/// Returns the current state of a team in the form that the map draws.
fn team_of(stepper: &mut stepping::Stepper, team: usize) -> Team {
    let (agents, leaders) = (stepper.world().agents(), stepper.world().leaders());
    let at = |values: &[f32], agent: usize| {
        let place = (team * agents + agent) * 2;
        Vec2::new(values[place], values[place + 1]).as_dvec2()
    };
    let states = stepper.states();
    let places: Vec<_> = (0..agents).map(|agent| (at(states.positions, agent), at(states.headings, agent))).collect();
    let world = stepper.world();
    let (pois, words) = (world.pois.len(), world.constants.words as usize);
    let near = |poi: usize| {
        world.rule.count(poi, stepper.agents_at_poi()[(team * pois + poi) * words..][..words].iter().copied())
    };
    let (step, observed) = (stepper.steps()[team].max(1), &stepper.observed()[team * pois..][..pois]);
    let agent = |(agent, (place, heading))| {
        let group = (agent < leaders).then_some(agent);
        let (form, counts) = (Form::of_agent(world, agent), world.rule.counts(agent));
        Marker { place, heading, form, group, counts, trail: vec![place] }
    };
    let poi =
        |(poi, place): (usize, &Vec2)| Poi::new(world, poi, place.as_dvec2(), Some(near(poi)), step as usize, observed);
    Team {
        leaders,
        agents: places.into_iter().enumerate().map(agent).collect(),
        pois: stepper.pois(team).iter().enumerate().map(poi).collect(),
    }
}
