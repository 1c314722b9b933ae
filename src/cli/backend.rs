//! Opens what episodes are played on.

use super::{BackendChoice, Breed, Error, RunOptions, remedy, say};
use crate::backend::OpenBackend;
use crate::backend::gpu::episode::{GpuBackend, ResidencyPolicy};
use crate::front::{self, Found, Processor};

/// Opens the backend that was asked for; `--threads` holds for the whole process.
///
/// # Errors
/// There is no such backend here, or no threads.
pub fn open(options: &RunOptions) -> Result<OpenBackend, Error> {
    Ok(open_gpu(options)?.map_or_else(front::cpu, front::on_gpu))
}

/// The GPU that was asked for, if any; `--threads` holds for the whole process.
///
/// # Errors
/// There is no such GPU here, or no threads.
pub fn open_gpu(options: &RunOptions) -> Result<Option<GpuBackend>, Error> {
    start_threads(options)?;
    let holding = match options.breed {
        Breed::Auto => None,
        Breed::Host => Some(ResidencyPolicy::Never),
        Breed::Device => Some(ResidencyPolicy::Always),
    };
    if (options.backend, options.breed) == (BackendChoice::Cpu, Breed::Device) {
        return Err(Error::Usage(
            "--breed device needs a GPU, --backend cpu uses none; leave out one of the two".into(),
        ));
    }
    let processor = match (options.backend, options.adapter.clone()) {
        (BackendChoice::Cpu, Some(_)) => {
            let text = "--adapter names a GPU, --backend cpu uses none; leave out one of the two";
            return Err(Error::Usage(text.into()));
        }
        (BackendChoice::Cpu, None) => Processor::Cpu,
        (BackendChoice::Auto, None) => Processor::Auto,
        (BackendChoice::Gpu, None) => Processor::Gpu,
        (BackendChoice::Auto | BackendChoice::Gpu, Some(named)) => Processor::Adapter(named),
    };
    let Found { gpu, passed_over } = front::find_gpu(&processor, holding)?;
    if let Some(error) = passed_over {
        say(format_args!("note: no GPU is used: {error}{}", remedy::device(&error)));
    }
    Ok(gpu)
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
