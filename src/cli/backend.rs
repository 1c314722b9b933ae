//! Opens the backends that play episodes.

use super::{BackendChoice, Breed, Error, RunOptions, remedy, say};
use crate::backend::OpenBackend;
use crate::backend::gpu::episode::{GpuBackend, ResidencyPolicy};
use crate::front::{self, Found, Processor};
use crate::parallel;

/// Opens the requested backend. `--threads` applies to the whole process.
///
/// # Errors
/// Fails if the backend is not available, or if the flags contradict each other.
pub fn open(options: &RunOptions) -> Result<OpenBackend, Error> {
    Ok(open_gpu(options)?.map_or_else(front::cpu, front::on_gpu))
}

/// Opens the requested GPU. Returns `None` if the CPU plays. `--threads` applies to the whole process.
///
/// # Errors
/// Fails if the GPU is not available, or if the flags contradict each other.
pub fn open_gpu(options: &RunOptions) -> Result<Option<GpuBackend>, Error> {
    start_threads(options.threads);
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

/// Starts the threads of the whole process: as many as `--threads` requests, or fewer if the system does not allow
/// them.
pub fn start_threads(threads: Option<u16>) {
    let threads = parallel::start(threads.map(usize::from));
    if threads.is_short() {
        say(format_args!("note: {threads}"));
    }
}
