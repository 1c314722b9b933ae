//! Configs, made from text or from Python values.

use std::path::PathBuf;

use flotilla::config::{self, Control, Definition, Override};
use flotilla::world::World;
use flotilla_app::sweep::Sweep;
use flotilla_studies::paper::{Experiment, arms};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};
use toml::Value;

use crate::errors::Raise;

/// A valid config.
#[pyclass(frozen, eq)]
#[derive(PartialEq)]
pub struct Config(pub flotilla::Config);

#[pymethods]
impl Config {
    #[staticmethod]
    fn load(path: PathBuf) -> PyResult<Config> {
        let text = flotilla_app::import::read_file(&path).raise()?;
        flotilla::Config::parse(&text, &flotilla::config::name(&path)).raise().map(Config)
    }

    #[staticmethod]
    fn parse(text: &str, name: &str) -> PyResult<Config> {
        flotilla::Config::parse(text, name).raise().map(Config)
    }

    /// Returns the config of one of the paper's layouts.
    #[staticmethod]
    fn paper(layout: &str) -> PyResult<Config> {
        let arms = arms(&[]).raise()?;
        let name = |arm: &Experiment| arm.layout.name.replace(' ', "_");
        let found = arms.iter().find(|arm| name(arm) == layout.replace([' ', '-'], "_"));
        found.map(|arm| Config(arm.config.clone())).ok_or_else(|| {
            let mut names: Vec<_> = Vec::new();
            for name in arms.iter().map(name) {
                if !names.contains(&name) {
                    names.push(name);
                }
            }
            PyValueError::new_err(format!("layout {layout:?}, allowed are {}", names.join(", ")))
        })
    }

    /// Builds a config from dotted keys and their values. All other keys have their defaults.
    #[staticmethod]
    fn build(keys: Vec<(String, Bound<'_, PyAny>)>) -> PyResult<Config> {
        flotilla::Config::read("", "the config", &[], &overrides(keys)?).raise().map(Config)
    }

    fn replace(&self, keys: Vec<(String, Bound<'_, PyAny>)>) -> PyResult<Config> {
        self.0.with(&overrides(keys)?).raise().map(Config)
    }

    /// Returns the config with one fitness for all learners.
    fn with_fitness(&self, fitness: &str) -> PyResult<Config> {
        let mut config = self.0.with(&[Override::new("learning.fitness", fitness, "the fitness")]).raise()?;
        config.agents.iter_mut().for_each(|class| class.fitness = None);
        Ok(Config(config))
    }

    fn to_toml(&self) -> String {
        self.0.to_toml()
    }

    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let table = toml::Table::try_from(&self.0).map_err(|error| PyValueError::new_err(error.to_string()))?;
        to_python(py, Value::Table(table))
    }

    #[getter]
    fn learners(&self) -> usize {
        self.0.learners()
    }

    #[getter]
    fn populations(&self) -> usize {
        self.0.populations()
    }

    /// Numbers of agents, POIs and steps.
    #[getter]
    fn sizes(&self) -> (usize, usize, usize) {
        (self.0.agent_count(), self.0.poi_count(), self.0.world.steps)
    }

    /// Number of a policy's inputs: the most that any learning class has.
    #[getter]
    fn inputs(&self) -> usize {
        self.0.inputs()
    }

    /// Lower bound of a policy's inputs. Only a channel that senses nothing can give less than 0.
    #[getter]
    fn least_input(&self) -> f64 {
        let classes = self.0.classes();
        let negative = classes.agents.iter().flat_map(|class| &class.senses).any(|channel| channel.empty < 0.0);
        if negative { f64::NEG_INFINITY } else { 0.0 }
    }

    /// Whether scores are computed from paths.
    #[getter]
    fn needs_paths(&self) -> PyResult<bool> {
        Ok(World::new(&self.0.validate().raise()?).paths.is_some())
    }

    /// The worth of each POI, as a multiple of a common unit.
    #[getter]
    fn worth(&self) -> PyResult<Vec<u32>> {
        Ok(World::new(&self.0.validate().raise()?).worth.clone())
    }

    /// Widths of a policy's layers, inputs and outputs included.
    #[getter]
    fn widths(&self) -> Vec<usize> {
        self.0.widths()
    }

    #[getter]
    fn parameters(&self) -> usize {
        self.0.parameters()
    }

    /// Whether policies of any class choose agents to move to.
    #[getter]
    fn chooses_agents(&self) -> bool {
        self.0.agents.iter().any(|class| matches!(class.control, Control::Choose(_)))
    }

    /// Whether starts, headings or POIs are drawn, so that there is no start of its own.
    #[getter]
    fn draws_starts(&self) -> bool {
        self.0.draws_starts()
    }
}

/// Returns every config key: name, unit, kind, range, default, meaning, and the paper's section.
#[pyfunction]
#[expect(clippy::type_complexity, reason = "it is taken apart at once")]
pub fn keys() -> Vec<(String, String, String, String, Option<String>, String, String)> {
    let row = |Definition { name, unit, kind, range, default, meaning, paper }| {
        let [name, unit, meaning, paper] = [name, unit, meaning, paper].map(String::from);
        (name, unit, kind, range, default, meaning, paper)
    };
    config::keys().into_iter().map(row).collect()
}

/// Reads a sweep. Returns the keys of its axes, each point's number, values and config, and its normalised text.
#[pyfunction]
#[expect(clippy::type_complexity, reason = "it is taken apart at once")]
pub fn sweep<'py>(
    py: Python<'py>,
    text: &str,
    name: &str,
    skip_impossible: bool,
) -> PyResult<(Vec<String>, Vec<(usize, Vec<Bound<'py, PyAny>>, Config)>, String)> {
    let sweep = Sweep::read(text, name, &[], skip_impossible).raise()?;
    let values = |point: &flotilla_app::sweep::Point| {
        let pairs = sweep.axes.iter().zip(&point.values);
        pairs.map(|(axis, &value)| to_python(py, axis.values[value].clone())).collect::<PyResult<Vec<_>>>()
    };
    let points =
        sweep.points.iter().map(|point| Ok((point.index, values(point)?, Config(point.config.clone().into_config()))));
    let points = points.collect::<PyResult<Vec<_>>>()?;
    Ok((sweep.axes.iter().map(|axis| axis.key.clone()).collect(), points, sweep.text))
}

/// Returns a value as a config file has it. `key` is its name in errors.
#[pyfunction]
pub fn value_as_toml(key: &str, value: &Bound<'_, PyAny>) -> PyResult<String> {
    Ok(value_of(key, value)?.to_string())
}

fn overrides(keys: Vec<(String, Bound<'_, PyAny>)>) -> PyResult<Vec<Override>> {
    let set = |(key, value): (String, Bound<'_, PyAny>)| Ok(Override::new(&*key, value_of(&key, &value)?, &*key));
    keys.into_iter().map(set).collect()
}

fn value_of(key: &str, value: &Bound<'_, PyAny>) -> PyResult<Value> {
    to_toml(value, 0).map_err(|error| match error {
        Odd::Value(what) => PyTypeError::new_err(format!("{key}: {what}, allowed is what a config file may hold")),
        Odd::Python(error) => error,
    })
}

/// The reason why a value cannot be part of a config.
enum Odd {
    Value(String),
    Python(PyErr),
}

impl From<PyErr> for Odd {
    fn from(error: PyErr) -> Odd {
        Odd::Python(error)
    }
}

/// Maximum nesting depth of lists and tables.
const DEEPEST: usize = 8;

fn to_toml(value: &Bound<'_, PyAny>, depth: usize) -> Result<Value, Odd> {
    if depth > DEEPEST {
        return Err(Odd::Value("lists within lists".into()));
    }
    if value.is_instance_of::<PyBool>() {
        Ok(Value::Boolean(value.extract()?))
    } else if value.is_instance_of::<PyInt>() {
        let whole = value.extract::<i64>();
        whole.map(Value::Integer).map_err(|_| Odd::Value("found a whole number of more than 63 bits".into()))
    } else if value.is_instance_of::<PyFloat>() {
        Ok(Value::Float(value.extract()?))
    } else if value.is_instance_of::<PyString>() {
        Ok(Value::String(value.extract().map_err(|_| Odd::Value("found text that is not Unicode".into()))?))
    } else if let Ok(table) = value.cast::<PyDict>() {
        let mut entries = toml::Table::new();
        for (key, value) in table.iter() {
            let Ok(key) = key.extract::<String>() else { return Err(Odd::Value("found a key that is no text".into())) };
            entries.insert(key, to_toml(&value, depth + 1)?);
        }
        Ok(Value::Table(entries))
    } else if value.is_instance_of::<PyList>() || value.is_instance_of::<PyTuple>() {
        let values = value.try_iter()?.map(|value| to_toml(&value?, depth + 1));
        Ok(Value::Array(values.collect::<Result<_, _>>()?))
    } else if let Ok(plain) = value.call_method0("tolist") {
        // NumPy arrays and scalars.
        to_toml(&plain, depth + 1)
    } else {
        Err(Odd::Value(format!("found {}", value.get_type().name()?)))
    }
}

fn to_python(py: Python<'_>, value: Value) -> PyResult<Bound<'_, PyAny>> {
    Ok(match value {
        Value::String(text) => text.into_pyobject(py)?.into_any(),
        Value::Integer(whole) => whole.into_pyobject(py)?.into_any(),
        Value::Float(number) => number.into_pyobject(py)?.into_any(),
        Value::Boolean(truth) => truth.into_pyobject(py)?.to_owned().into_any(),
        Value::Datetime(date) => date.to_string().into_pyobject(py)?.into_any(),
        Value::Array(values) => {
            let values = values.into_iter().map(|value| to_python(py, value)).collect::<PyResult<Vec<_>>>()?;
            PyList::new(py, values)?.into_any()
        }
        Value::Table(table) => {
            let entries = PyDict::new(py);
            for (key, value) in table {
                entries.set_item(key, to_python(py, value)?)?;
            }
            entries.into_any()
        }
    })
}
