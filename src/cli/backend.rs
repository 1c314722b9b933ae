//! Opens the backends that play episodes.

use super::choice::{self, Work};
use super::{BackendChoice, Breed, Error, RunOptions, said, say};
use crate::backend::OpenBackend;
use crate::backend::gpu::device::{self, Wanted};
use crate::backend::gpu::episode::{GpuBackend, ResidencyPolicy};
use crate::front::{self, Found, Processor};
use crate::host::Instant;
use crate::ops::advice_on_device;
use crate::parallel;

/// Opens the requested backend. `--backend auto` takes any usable GPU. `--threads` applies to the whole process.
///
/// # Errors
/// Fails if the backend is not available, or if the flags contradict each other.
pub fn open(options: &RunOptions) -> Result<OpenBackend, Error> {
    Ok(open_gpu(options, None)?.0.map_or_else(front::cpu, front::on_gpu))
}

/// Opens the requested backend for some work, by which `--backend auto` decides, and describes it for people.
///
/// # Errors
/// As for [`open`].
pub fn open_for(options: &RunOptions, work: Work) -> Result<(OpenBackend, String), Error> {
    let (gpu, reason) = open_gpu(options, Some(work))?;
    let opened = gpu.map_or_else(front::cpu, front::on_gpu);
    let reason = reason.map_or(String::new(), |reason| format!(" [auto: {reason}]"));
    let description = format!("{}{reason}", opened.0.describe());
    Ok((opened, description))
}

/// Opens the requested GPU. Returns `None` if the CPU plays, and why that was chosen if nobody asked for it. Without
/// `work`, `--backend auto` takes any usable GPU. `--threads` applies to the whole process.
///
/// # Errors
/// Fails if the GPU is not available, or if the flags contradict each other.
pub fn open_gpu(options: &RunOptions, work: Option<Work>) -> Result<(Option<GpuBackend>, Option<String>), Error> {
    start_threads(options.threads);
    let holding = match options.breed {
        Breed::Auto => None,
        Breed::Host => Some(ResidencyPolicy::Never),
        Breed::Device => Some(ResidencyPolicy::Always),
    };
    if (options.backend, options.breed) == (BackendChoice::Cpu, Breed::Device) {
        return Err(Error::Usage(said(
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
    let threads = parallel::current_num_threads();
    let work = work.filter(|_| processor == Processor::Auto && holding != Some(ResidencyPolicy::Always));
    if let Some(choice) = work.and_then(|work| choice::choose(work, threads, None)) {
        return Ok((None, Some(choice.reason)));
    }
    let mut measured = None;
    if let Some(work) = work {
        let found = device::adapters();
        measured = device::position(&Wanted::Real, &found).ok().and_then(|index| choice::recall(&found[index]));
        let choice = measured.and_then(|measured| choice::choose(work, threads, Some(measured)));
        if let Some(choice) = choice.filter(|choice| !choice.gpu) {
            return Ok((None, Some(choice.reason)));
        }
    }
    let start = Instant::now();
    let Found { mut gpu, passed_over } = front::find_gpu(&processor, holding)?;
    let mut reason = None;
    if let (Some(work), Some(opened)) = (work, &mut gpu) {
        let fresh = match measured {
            Some(measured) => measured,
            None => {
                let measured = choice::measure(opened, start.elapsed().as_secs_f64(), threads)?;
                choice::remember(&opened.gpu().adapter, &measured);
                measured
            }
        };
        let choice = choice::choose(work, threads, Some(fresh));
        if choice.as_ref().is_some_and(|choice| !choice.gpu) {
            gpu = None;
        }
        reason = choice.map(|choice| choice.reason);
    } else if work.is_some() && passed_over.is_none() {
        reason = Some("no GPU found".into());
    }
    if let Some(error) = passed_over {
        say(format_args!("note: no GPU is used: {error}{}", advice_on_device(&error)));
    }
    Ok((gpu, reason))
}

/// Starts the threads of the whole process: as many as `--threads` requests, or fewer if the system does not allow
/// them.
pub fn start_threads(threads: Option<u16>) {
    let threads = parallel::start(threads.map(usize::from));
    if threads.is_short() {
        say(format_args!("note: {threads}"));
    }
}
