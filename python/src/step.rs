//! Teams that are stepped by given actions.

use std::sync::{Mutex, MutexGuard, PoisonError};

use flotilla::config::{Choice, Fitness};
use flotilla::front;
use flotilla::report::map::{self, Marker, Poi, Team, Viewport};
use flotilla::report::scene::Scene;
use flotilla::stepping;
use flotilla::world::{INPUTS, OUTPUTS};
use glam::{DVec2, Vec2};
use numpy::ndarray::ArrayView;
use numpy::{
    Element, PyArray1, PyArray2, PyArray3, PyArrayDyn, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray3,
    PyReadwriteArray2, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::config::Config;
use crate::errors::Raise;
use crate::workers;

type States<'py> = (Bound<'py, PyArray3<f32>>, Bound<'py, PyArray3<f32>>, Bound<'py, PyArray2<f32>>);

/// So many teams of a world.
#[pyclass(frozen)]
pub struct Stepper {
    config: flotilla::Config,
    inner: Mutex<stepping::Stepper>,
}

impl Stepper {
    fn inner(&self) -> MutexGuard<'_, stepping::Stepper> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What one of the stepper's arrays holds, to be looked at where it lies.
fn shown<'py, T: Element>(
    of: &Bound<'py, Stepper>,
    values: &[T],
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let view = ArrayView::from_shape(shape, values).map_err(|error| PyValueError::new_err(error.to_string()))?;
    // SAFETY: a stepper's arrays stay where they are from step to step (`stepping::Stepper` says so, and a test of this
    // package looks), and the array keeps the stepper. Who reads while another thread steps reads some of both steps.
    #[expect(unsafe_code, reason = "a copy a step would cost as much as a good part of the step")]
    let array = unsafe { PyArrayDyn::borrow_from_array(&view, of.clone().into_any()) };
    array.readwrite().make_nonwriteable();
    Ok(array)
}

#[pymethods]
impl Stepper {
    #[new]
    fn new(py: Python<'_>, config: &Config, teams: usize, recording: bool) -> PyResult<Stepper> {
        let made = workers::aside(py, || front::stepper(&config.0, teams, recording)).raise()?;
        Ok(Stepper { config: config.0.clone(), inner: Mutex::new(made) })
    }

    #[getter]
    fn teams(&self) -> usize {
        self.inner().teams()
    }

    /// Puts all teams, or the chosen ones, at the world's start or where they are told to.
    fn reset(
        &self,
        py: Python<'_>,
        chosen: Option<PyReadonlyArray1<'_, bool>>,
        starts: Option<PyReadonlyArray3<'_, f32>>,
    ) -> PyResult<()> {
        let chosen = chosen.as_ref().map(|chosen| contiguous("reset_mask", chosen.as_slice())).transpose()?;
        let starts = starts.as_ref().map(|starts| contiguous("starts", starts.as_slice())).transpose()?;
        workers::aside(py, || {
            let mut stepper = self.inner();
            match (chosen, starts) {
                (Some(chosen), starts) => stepper.reset_some(chosen, starts),
                (None, Some(starts)) => stepper.reset_to(starts),
                (None, None) => {
                    stepper.reset();
                    Ok(())
                }
            }
        })
        .raise()
    }

    /// Plays a step by actions `[teams, leaders, 2]`, and writes to `rewards`, `[teams, leaders]`, which share of the POIs
    /// each leader's team observed for the first time.
    fn step(
        &self,
        py: Python<'_>,
        actions: PyReadonlyArray3<'_, f32>,
        rewards: Option<PyReadwriteArray2<'_, f32>>,
    ) -> PyResult<()> {
        let shape = [self.teams(), self.config.learners(), OUTPUTS];
        if actions.shape() != shape {
            let text = format!("actions are {:?}, allowed is [teams, leaders, 2] = {shape:?}", actions.shape());
            return Err(PyValueError::new_err(text));
        }
        let (mut rewards, leaders) = (rewards, self.config.learners());
        let rewards = rewards.as_mut().map(|rewards| contiguous("rewards", rewards.as_slice_mut())).transpose()?;
        let actions = contiguous("actions", actions.as_slice())?;
        workers::aside(py, || {
            let mut stepper = self.inner();
            stepper.step(actions)?;
            let pois = self.config.world.pois.len();
            for (team, newly) in rewards
                .into_iter()
                .flat_map(|rewards| rewards.chunks_exact_mut(leaders).zip(stepper.newly_observed().chunks_exact(pois)))
            {
                team.fill(newly.iter().filter(|&&newly| newly).count() as f32 / pois as f32);
            }
            Ok::<_, stepping::StepError>(())
        })
        .raise()
    }

    /// Writes what every leader was worth so far by a fitness to `scores`, `[teams, leaders]`.
    fn fitness(&self, py: Python<'_>, fitness: &str, mut scores: PyReadwriteArray2<'_, f32>) -> PyResult<()> {
        let Some(&(_, fitness)) = Fitness::ALL.iter().find(|(name, _)| *name == fitness) else {
            let names: Vec<_> = Fitness::names().collect();
            return Err(PyValueError::new_err(format!("fitness {fitness:?}, allowed are {}", names.join(", "))));
        };
        let scores = contiguous("scores", scores.as_slice_mut())?;
        workers::aside(py, || self.inner().fitness(fitness, scores)).raise()
    }

    /// What every leader senses, `[teams, leaders, 8]`.
    #[getter]
    fn inputs<'py>(of: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let stepper = of.get().inner();
        shown(of, stepper.inputs(), &[stepper.teams(), stepper.world().leaders(), INPUTS])
    }

    /// Agents near each POI, a bit an agent, `[teams, pois, words]`.
    #[getter]
    fn near<'py>(of: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<u32>>> {
        let stepper = of.get().inner();
        let words = stepper.world().constants.words as usize;
        shown(of, stepper.near(), &[stepper.teams(), stepper.world().pois.len(), words])
    }

    /// POIs observed since the start, `[teams, pois]`.
    #[getter]
    fn observed<'py>(of: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<bool>>> {
        let stepper = of.get().inner();
        shown(of, stepper.observed(), &[stepper.teams(), stepper.world().pois.len()])
    }

    /// POIs observed for the first time by the last step, `[teams, pois]`.
    #[getter]
    fn newly_observed<'py>(of: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<bool>>> {
        let stepper = of.get().inner();
        shown(of, stepper.newly_observed(), &[stepper.teams(), stepper.world().pois.len()])
    }

    /// Steps played since the start, `[teams]`.
    #[getter]
    fn steps<'py>(of: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<u32>>> {
        let stepper = of.get().inner();
        shown(of, stepper.steps(), &[stepper.teams()])
    }

    /// Where everyone is: positions and headings `[teams, agents, 2]`, speeds `[teams, agents]`.
    fn states<'py>(&self, py: Python<'py>) -> PyResult<States<'py>> {
        let (teams, agents) = (self.teams(), self.config.world.leaders.len() + self.config.world.followers.len());
        let [positions, headings, speeds] = workers::aside(py, || {
            let mut stepper = self.inner();
            let stepping::States { positions, headings, speeds } = stepper.states();
            [positions, headings, speeds].map(<[f32]>::to_vec)
        });
        let pairs = |values| PyArray1::from_vec(py, values).reshape([teams, agents, 2]);
        Ok((pairs(positions)?, pairs(headings)?, PyArray1::from_vec(py, speeds).reshape([teams, agents])?))
    }

    /// A picture of a team, `[height, width, 3]`, its longer side of so many pixels.
    fn render<'py>(&self, py: Python<'py>, team: usize, pixels: u32) -> PyResult<Bound<'py, PyArray3<u8>>> {
        /// Millimetres of the longer side, which letters are sized for.
        const SIDE: f64 = 80.0;
        let drawn = workers::aside(py, || {
            let mut stepper = self.inner();
            if team >= stepper.teams() {
                return None;
            }
            let team = team_of(&mut stepper, team);
            let view = Viewport::new(&self.config, [DVec2::ZERO, self.config.world.map.into()], SIDE);
            let [width, height] = view.size();
            let mut scene = Scene::new(width, height);
            view.draw(&mut scene, &team);
            let picture = scene.pixels(f64::from(pixels.clamp(16, 4096)) / SIDE);
            let rgb: Vec<u8> =
                picture.data().chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
            Some((picture.height() as usize, picture.width() as usize, rgb))
        });
        let Some((height, width, rgb)) = drawn else {
            let text = format!("team {team} of {} (they count from 0)", self.teams());
            return Err(PyValueError::new_err(text));
        };
        PyArray1::from_vec(py, rgb).reshape([height, width, 3])
    }
}

/// A team as it stands, leaders in their colours.
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
    let near = |poi: usize| world.rule.count(stepper.near()[(team * pois + poi) * words..][..words].iter().copied());
    let (step, observed) = (stepper.steps()[team].max(1), &stepper.observed()[team * pois..][..pois]);
    let agent = |(agent, (place, heading))| {
        let group = (agent < leaders).then_some(agent);
        Marker { place, heading, group, counts: world.rule.counts(agent), trail: vec![place] }
    };
    let poi = |(poi, place): (usize, &Vec2)| {
        let (near, needed) = (near(poi), world.coupling[poi]);
        Poi {
            place: place.as_dvec2(),
            label: map::poi_label(&world.rule, poi, format!("{near}/{needed}")),
            share: Some(f64::from(near) / f64::from(needed)),
            observed: observed[poi],
            open: world.rule.is_open(poi, step, observed),
        }
    };
    Team {
        leaders,
        agents: places.into_iter().enumerate().map(agent).collect(),
        pois: world.pois.iter().enumerate().map(poi).collect(),
    }
}

/// An array as it lies in memory.
fn contiguous<T, E>(what: &str, slice: Result<T, E>) -> PyResult<T> {
    slice.map_err(|_| PyValueError::new_err(format!("{what} are not C-contiguous")))
}
