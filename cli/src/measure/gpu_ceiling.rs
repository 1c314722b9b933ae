//! The arithmetic ceiling of a GPU: how many f32 sums and products per second it computes at most, none of them fused.

use std::time::Duration;

use wgpu::BufferUsages;

use flotilla::backend::gpu::CEILING;
use flotilla::backend::gpu::device::{Binding, DeviceError, Gpu};

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
    gpu: Gpu,
    pipeline: wgpu::ComputePipeline,
    buffers: wgpu::BindGroup,
    iterations: wgpu::Buffer,
    workgroups: u32,
    operations: f64,
}

impl Ceiling {
    /// Prepares the measurement: finds a workload that keeps the device busy for a while.
    ///
    /// # Errors
    /// The device failed.
    pub fn new(gpu: &Gpu) -> Result<Ceiling, DeviceError> {
        let layout = gpu.layout("ceiling", &[Binding::Read, Binding::Read, Binding::Write])?;
        let pipeline = gpu.own_pipeline("ceiling", CEILING, "ceiling", &layout)?;
        let numbers = gpu.upload("ceiling's numbers", &[1.000_000_1f32, 0.25, -1.0, 0.0], BufferUsages::STORAGE)?;
        let iterations = gpu.upload("ceiling's iterations", &[0u32; 4], BufferUsages::STORAGE)?;
        let result = gpu.buffer("ceiling's result", (WORKGROUP * size_of::<f32>()) as u64, BufferUsages::STORAGE)?;
        let bound = [&numbers, &iterations, &result].map(|buffer| buffer.as_entire_buffer_binding());
        let buffers = gpu.bind("ceiling", &layout, &bound)?;
        let mut ceiling = Ceiling { gpu: gpu.clone(), pipeline, buffers, iterations, workgroups: 0, operations: 0.0 };
        // As many threads as fill any GPU several times. More iterations, then more threads, until it takes long
        // enough.
        let (mut iterations, mut workgroups) = (64, 4096);
        loop {
            ceiling.set(iterations, workgroups)?;
            let seconds = ceiling.operations / ceiling.measure()?;
            if seconds >= MIN_TIME.as_secs_f64() {
                return Ok(ceiling);
            } else if iterations < MAX_ITERATIONS {
                iterations *= 2;
            } else if workgroups * 2 <= gpu.limits.max_compute_workgroups_per_dimension {
                workgroups *= 2;
            } else {
                return Ok(ceiling);
            }
        }
    }

    fn set(&mut self, iterations: u32, workgroups: u32) -> Result<(), DeviceError> {
        let words = [iterations; 4];
        self.gpu.scoped("ceiling's iterations", || {
            self.gpu.write(&self.iterations, 0, bytemuck::cast_slice(&words));
        })?;
        self.workgroups = workgroups;
        self.operations = f64::from(iterations) * OPERATIONS_PER_ITERATION * f64::from(workgroups) * WORKGROUP as f64;
        Ok(())
    }

    /// Returns lane operations per second.
    ///
    /// # Errors
    /// The device failed.
    pub(crate) fn measure(&self) -> Result<f64, DeviceError> {
        let time = self.gpu.time("ceiling", &self.pipeline, &self.buffers, [self.workgroups, 1, 1])?;
        Ok(self.operations / time.as_secs_f64())
    }
}
