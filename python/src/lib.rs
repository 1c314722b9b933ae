//! The native module of flotilla's Python package: the crate's functions on NumPy arrays.
//!
//! The public interface is `flotilla/*.py`, which also checks arguments where that is simpler. Long-running functions
//! release the interpreter's lock.

use pyo3::prelude::*;

mod coevolution;
mod config;
mod errors;
mod play;
mod program;
mod show;
mod step;
mod train;
mod workers;

/// The native module of `flotilla`.
#[pymodule(gil_used = false)]
mod _native {
    use pyo3::prelude::*;

    #[pymodule_export]
    use crate::coevolution::Coevolution;
    #[pymodule_export]
    use crate::config::{Config, keys, sweep, value_as_toml};
    #[pymodule_export]
    use crate::play::{forward, record, rollout, score, starts};
    #[pymodule_export]
    use crate::program::{adapters, answer, main};
    #[pymodule_export]
    use crate::show::{Figure, Replay, figure, replay, replay_policies, write};
    #[pymodule_export]
    use crate::step::Stepper;
    #[pymodule_export]
    use crate::train::{Generation, open, save, train, train_into, write_policies};
    #[pymodule_export]
    use crate::workers::{forked, threads};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        use flotilla::config::{Choice, Fitness};
        use numpy::PyArray1;
        // The first array loads NumPy's interface. A signal that is pending then would make that fail.
        drop(PyArray1::<f32>::zeros(module.py(), 0, false));
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("COMMIT", flotilla::COMMIT)?;
        module.add("FITNESSES", Fitness::names().collect::<Vec<_>>())?;
        module.add("OUTPUTS", flotilla::world::OUTPUTS)
    }
}
