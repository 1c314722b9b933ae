//! `flotilla devices`: lists the processors and GPUs that can play episodes, and the pass of each GPU.

use serde_json::json;

use super::{Error, backend, print, print_json, remedy};
use crate::backend::Backend;
use crate::backend::cpu::Cpu;
use crate::backend::gpu;
use crate::backend::gpu::device::{self, Gpu, Wanted};

#[derive(clap::Args)]
pub struct Args {
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Opens every adapter in turn, because only an open device can be tested.
pub fn run(args: Args) -> Result<(), Error> {
    backend::start_threads(None);
    let adapters: Vec<_> = device::adapters()
        .into_iter()
        .enumerate()
        .map(|(index, info)| (index, info, gpu::open(Wanted::Named(index.to_string()))))
        .collect();
    if args.json {
        let adapters: Vec<_> = adapters
            .iter()
            .map(|(index, info, opened)| {
                json!({
                    "index": index,
                    "name": info.name,
                    "driver": info.driver,
                    "api": info.backend,
                    "kind": info.kind.to_string(),
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
    for (index, info, opened) in &adapters {
        text += &format!("{index}: {info}\n");
        text += &match opened {
            Ok(gpu) => exact(gpu),
            Err(error) => format!("   not usable: {error}{}\n", remedy::device(error)),
        };
    }
    if adapters.is_empty() {
        text += "no GPU adapter found: no Vulkan, Metal or DirectX 12 driver answers\n";
    }
    print(&text)
}

fn exact(gpu: &Gpu) -> String {
    let limits = &gpu.limits;
    format!(
        "   exact under the {} pass; workgroups of {} threads and {} KiB, buffers of {} MiB\n",
        gpu.pass,
        limits.max_compute_invocations_per_workgroup,
        limits.max_compute_workgroup_storage_size >> 10,
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) >> 20,
    )
}
