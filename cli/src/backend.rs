//! Opens the backends that play episodes.

use super::{BackendChoice, Breed, Error, RunOptions, say, with_remedy};
use flotilla::backend::OpenBackend;
use flotilla::backend::gpu::device;
use flotilla::backend::gpu::episode::{GpuBackend, ResidencyPolicy};
use flotilla::front::{self, Processor};
use flotilla::parallel;
use flotilla_app::choice::{self, Chosen, Work};
use flotilla_app::ops::MessageWithRemedy;

/// Opens the requested backend for some work, by which `--backend auto` decides, and describes it for people.
/// `--threads` applies to the whole process.
pub fn open_for(options: &RunOptions, work: Work) -> Result<(OpenBackend, String), Error> {
    let (gpu, reason) = open_gpu(options, Some(work))?;
    let opened = gpu.map_or_else(front::cpu, front::on_gpu);
    let reason = reason.map_or(String::new(), |reason| format!(" [auto: {reason}]"));
    let description = format!("{}{reason}", opened.0.describe());
    Ok((opened, description))
}

/// Opens the requested GPU. Returns `None` if the CPU plays, and why that was chosen if nobody asked for it. Without
/// `work`, `--backend auto` takes any usable GPU. `--threads` applies to the whole process.
pub fn open_gpu(options: &RunOptions, work: Option<Work>) -> Result<(Option<GpuBackend>, Option<&'static str>), Error> {
    start_threads(options.threads);
    let holding = match options.breed {
        Breed::Auto => None,
        Breed::Host => Some(ResidencyPolicy::Never),
        Breed::Device => Some(ResidencyPolicy::Always),
    };
    if (options.backend, options.breed) == (BackendChoice::Cpu, Breed::Device) {
        return Err(Error::Usage(with_remedy(
            "--breed device needs a GPU, --backend cpu uses none",
            "leave out one of the two",
        )));
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
    device::report_stalls(|text| say(format_args!("note: {text}")));
    let Chosen { gpu, reason, passed_over } = choice::find(&processor, holding, work)?;
    if let Some(error) = passed_over {
        say(format_args!("note: no GPU is used: {}", MessageWithRemedy::from(&error)));
    }
    Ok((gpu, reason))
}

/// Starts the threads of the whole process: as many as `--threads` requests, or fewer if the system does not allow
/// them.
pub fn start_threads(threads: Option<u16>) {
    let threads = parallel::start_with_caller(threads.map(usize::from));
    if threads.is_short() {
        say(format_args!("note: {threads}"));
    }
}
