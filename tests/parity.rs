//! GPUs against the CPU, bit for bit: stage by stage on random worlds, whole rollouts, and whole training runs.

mod common;

use flotilla::backend::cpu::Cpu;
use flotilla::backend::gpu::device::{self, Request};
use flotilla::backend::gpu::episode::GpuEpisodes;
use flotilla::backend::gpu::exact::Pass;
use flotilla::verify;

fn backend(request: &Request, pass: Pass) -> GpuEpisodes {
    let gpu = device::open(Request { pass: Some(pass), ..request.clone() }).unwrap();
    GpuEpisodes::new(gpu).unwrap()
}

#[test]
fn random_worlds_agree_stage_by_stage() {
    for (request, info) in common::adapters("random_worlds_agree_stage_by_stage") {
        for pass in [Pass::NoContraction, Pass::Guarded] {
            let outcome =
                verify::compare_random(&mut Cpu::default(), &mut backend(&request, pass), 0..40, 9, |_| ()).unwrap();
            println!("{info}, {pass}: {} worlds, {} agent-steps", outcome.worlds, outcome.agent_steps);
            assert_eq!(outcome.mismatch, None, "{info}, {pass}");
        }
    }
}
