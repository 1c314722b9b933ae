//! `flotilla devices`: lists the processors and GPUs that can play episodes, and the pass of each GPU.

use serde_json::json;

use super::{Error, backend, print, print_json};
use flotilla::backend::Backend;
use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu;
use flotilla::backend::gpu::device::{self, AdapterChoice, DeviceError, Gpu};
use flotilla::host::Instant;
use flotilla_app::ops::MessageWithRemedy;

#[derive(clap::Args)]
pub struct Args {
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Opens every adapter, one after the other, because only an open device can be tested.
pub fn run(args: Args) -> Result<(), Error> {
    backend::start_threads(None);
    let adapters: Vec<_> = device::adapters()
        .into_iter()
        .enumerate()
        .map(|(index, info)| {
            let start = Instant::now();
            let opened = gpu::open(AdapterChoice::Named(index.to_string()));
            (index, info, opened, start.elapsed().as_secs_f64())
        })
        .collect();
    if args.json {
        let adapters: Vec<_> = adapters
            .iter()
            .map(|(index, info, opened, seconds)| {
                json!({
                    "index": index,
                    "name": info.name,
                    "driver": info.driver,
                    "api": info.backend,
                    "kind": info.kind.to_string(),
                    "pci": info.pci,
                    "compiler": device::compiler(&info.backend),
                    "open_s": seconds,
                    "pass": opened.as_ref().ok().map(|gpu| gpu.pass.to_string()),
                    "refused": opened.as_ref().err().map(ToString::to_string),
                    "limits": opened.as_ref().ok().map(|gpu| json!({
                        "workgroup_threads": gpu.limits.max_compute_invocations_per_workgroup,
                        "workgroup_bytes": gpu.limits.max_compute_workgroup_storage_size,
                        "binding_bytes": gpu.limits.max_storage_buffer_binding_size,
                        "buffer_bytes": gpu.limits.max_buffer_size,
                    })),
                })
            })
            .collect();
        return print_json(&json!({ "cpu": Cpu::default().describe(), "adapters": adapters }));
    }
    let mut text = format!("{}\n", Cpu::default().describe());
    for (index, info, opened, seconds) in &adapters {
        text += &format!("{index}: {info}\n");
        text += &match opened {
            Ok(gpu) => exact(gpu, *seconds),
            Err(error) => format!("   not usable: {}\n", MessageWithRemedy::from(error)),
        };
    }
    if adapters.is_empty() {
        text += &format!("{}\n", DeviceError::NoAdapter);
    }
    print(&text)
}

fn exact(gpu: &Gpu, seconds: f64) -> String {
    let limits = &gpu.limits;
    format!(
        "   exact under the {} pass; workgroups of {} threads and {} KiB, buffers of {} MiB\n   \
         opened and tested in {seconds:.2} s, with {}\n",
        gpu.pass,
        limits.max_compute_invocations_per_workgroup,
        limits.max_compute_workgroup_storage_size >> 10,
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) >> 20,
        device::compiler(&gpu.adapter.backend),
    )
}
