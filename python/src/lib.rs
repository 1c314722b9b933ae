//! flotilla's Python package, its private part: the crate's own functions on NumPy's arrays.
//!
//! What people see is `flotilla/*.py`; shapes and words are checked and told there where that is simpler. Nothing here holds
//! the interpreter while it works.

use pyo3::prelude::*;

mod config;
mod errors;
mod play;
mod program;
mod show;
mod step;
mod train;
mod workers;

/// The private part of `flotilla`.
#[pymodule(gil_used = false)]
mod _native {
    use pyo3::prelude::*;

    #[pymodule_export]
    use crate::config::{Config, keys, sweep};
    #[pymodule_export]
    use crate::play::{rollout, starts, trace};
    #[pymodule_export]
    use crate::program::{adapters, main};
    #[pymodule_export]
    use crate::show::{Figure, Replay, figure, replay};
    #[pymodule_export]
    use crate::step::Stepper;
    #[pymodule_export]
    use crate::train::{Generation, open, save, train, train_into};
    #[pymodule_export]
    use crate::workers::forked;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        use flotilla::config::{Choice, Fitness};
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("COMMIT", flotilla::COMMIT)?;
        module.add("FITNESSES", Fitness::names().collect::<Vec<_>>())?;
        module.add("INPUTS", flotilla::world::INPUTS)?;
        module.add("OUTPUTS", flotilla::world::OUTPUTS)
    }
}
