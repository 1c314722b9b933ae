//! Opens what episodes are played on.

use super::{BackendChoice, Breed, Error, RunOptions, say};
use crate::backend::cpu::Cpu;
use crate::backend::gpu;
use crate::backend::gpu::device::{Choice, DeviceError};
use crate::backend::gpu::episode::{GpuEpisodes, Holding};
use crate::run::{Machine, Player};

/// Opens the backend that was asked for; `--threads` holds for the whole process.
///
/// # Errors
/// There is no such backend here, or no threads.
pub fn open(options: &RunOptions) -> Result<Player, Error> {
    Ok(open_gpu(options)?.map_or_else(cpu, player))
}

/// The GPU that was asked for, if any; `--threads` holds for the whole process.
///
/// # Errors
/// There is no such GPU here, or no threads.
pub fn open_gpu(options: &RunOptions) -> Result<Option<GpuEpisodes>, Error> {
    start_threads(options)?;
    let named = options.adapter.clone().map(Choice::Named);
    let gpu = |choice| gpu(choice, options.breed);
    if (options.backend, options.breed) == (BackendChoice::Cpu, Breed::Device) {
        return Err(Error::Usage(
            "--breed device needs a GPU, --backend cpu uses none; leave out one of the two".into(),
        ));
    }
    match (options.backend, named) {
        (BackendChoice::Cpu, Some(_)) => {
            Err(Error::Usage("--adapter names a GPU, --backend cpu uses none; leave out one of the two".into()))
        }
        (BackendChoice::Cpu, None) => Ok(None),
        (BackendChoice::Auto, None) => match gpu(Choice::Real) {
            Err(error) if options.breed == Breed::Device => Err(error.into()),
            Err(DeviceError::NoAdapter | DeviceError::NoRealAdapter { .. }) => Ok(None),
            Err(error) => {
                say(format_args!("note: no GPU is used: {error}"));
                Ok(None)
            }
            opened => Ok(Some(opened?)),
        },
        (BackendChoice::Auto | BackendChoice::Gpu, Some(named)) => Ok(Some(gpu(named)?)),
        (BackendChoice::Gpu, None) => Ok(Some(gpu(Choice::Real)?)),
    }
}

/// Makes `--threads` hold for the whole process.
///
/// # Errors
/// So many cannot be started.
pub fn start_threads(options: &RunOptions) -> Result<(), Error> {
    let Some(threads) = options.threads else { return Ok(()) };
    let started = rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build_global();
    started.map_err(|error| Error::Usage(format!("--threads {threads} cannot be started: {error}")))
}

fn gpu(choice: Choice, breed: Breed) -> Result<GpuEpisodes, DeviceError> {
    let backend = GpuEpisodes::new(gpu::open(choice)?)?;
    Ok(match breed {
        Breed::Auto => backend,
        Breed::Host => backend.holding(Holding::Never),
        Breed::Device => backend.holding(Holding::Always),
    })
}

fn player(backend: GpuEpisodes) -> Player {
    let machine = machine(&backend);
    (Box::new(backend), machine)
}

/// What a GPU backend runs on.
pub fn machine(backend: &GpuEpisodes) -> Machine {
    let adapter = &backend.gpu().adapter;
    Machine {
        backend: "gpu".into(),
        adapter: Some(adapter.name.clone()),
        driver: Some(adapter.driver.clone()),
        threads: rayon::current_num_threads(),
    }
}

/// The backend that is always there.
pub fn cpu() -> Player {
    let machine = Machine { backend: "cpu".into(), threads: rayon::current_num_threads(), ..Machine::default() };
    (Box::new(Cpu::default()), machine)
}
