//! The arithmetic ceiling of a GPU: how many f32 sums and products per second it computes at most, none of them fused.

use std::time::Duration;

use flotilla::backend::gpu::device::{DeviceError, Executor, Gpu, Workspace};
use flotilla::backend::gpu::recording::{Buffer, Command, Recording};
use flotilla::backend::gpu::source::Pipeline;

/// Threads per workgroup, as `shaders/ceiling.wgsl` has it.
const WORKGROUP: usize = 64;
/// Lane operations per iteration of the shader's loop: 8 times 6 products and 6 sums.
const OPERATIONS_PER_ITERATION: f64 = 8.0 * 12.0;
/// Maximum iterations of the loop in one dispatch, because some drivers abandon long loops.
const MAX_ITERATIONS: u32 = 4096;
/// Minimum time of a dispatch: long enough to be timed, and short enough for any driver's watchdog.
const MIN_TIME: Duration = Duration::from_millis(20);

/// Measures the arithmetic ceiling of a device under its pass.
pub(crate) struct Ceiling {
    executor: Executor,
    workspace: Workspace,
    iterations: u32,
    workgroups: u32,
}

impl Ceiling {
    /// Prepares the measurement: finds a workload that keeps the device busy for a while.
    ///
    /// # Errors
    /// The device failed.
    pub fn new(gpu: &Gpu) -> Result<Ceiling, DeviceError> {
        let most = gpu.limits.max_compute_workgroups_per_dimension;
        let (executor, workspace) = (Executor::new(gpu.clone()), Workspace::default());
        // As many threads as fill any GPU several times. More iterations, then more threads, until it takes long
        // enough.
        let mut ceiling = Ceiling { executor, workspace, iterations: 64, workgroups: 4096 };
        while ceiling.operations() / ceiling.measure()? < MIN_TIME.as_secs_f64() {
            if ceiling.iterations < MAX_ITERATIONS {
                ceiling.iterations *= 2;
            } else if ceiling.workgroups * 2 <= most {
                ceiling.workgroups *= 2;
            } else {
                break;
            }
        }
        Ok(ceiling)
    }

    fn operations(&self) -> f64 {
        f64::from(self.iterations) * OPERATIONS_PER_ITERATION * f64::from(self.workgroups) * WORKGROUP as f64
    }

    /// Returns lane operations per second.
    ///
    /// # Errors
    /// The device failed.
    pub(crate) fn measure(&mut self) -> Result<f64, DeviceError> {
        let mut recording = Recording::new("ceiling");
        let bindings = vec![
            recording.input(Buffer::Input, vec![1.000_000_1f32, 0.25, -1.0, 0.0]),
            recording.input(Buffer::Iterations, vec![self.iterations; 4]),
            recording.buffer(Buffer::Output, (WORKGROUP * size_of::<f32>()) as u64),
        ];
        let grid = [self.workgroups, 1, 1];
        recording.commands.push(Command::Dispatch { pipeline: Pipeline::Ceiling, bindings, grid, iterations: 0 });
        let time = self.executor.time(&recording, &mut self.workspace)?;
        Ok(self.operations() / time.as_secs_f64())
    }
}
