//! Pipelines and dispatches.

use std::borrow::Cow;
use std::time::Duration;

use super::{DeviceError, Gpu, PipelineKey};
use crate::backend::gpu::exact;
use crate::host::Instant;
use crate::parallel::lock;

/// Offsets of bindings are multiples of this on every WebGPU device.
pub(in crate::backend::gpu) const BINDING_ALIGNMENT: usize = 256;

/// How a shader uses a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Binding {
    /// `var<uniform>`.
    Uniform,
    /// `var<storage, read>`.
    Read,
    /// `var<storage, read_write>`.
    Write,
}

/// The layout of a pipeline's buffers: group 0, the guard at binding 0, the others from binding 1 on.
#[derive(Clone, Debug)]
pub struct Bindings {
    bindings: wgpu::BindGroupLayout,
    pipeline: wgpu::PipelineLayout,
}

impl Gpu {
    /// Returns the layout of a pipeline that uses these buffers as bindings 1, 2, … of group 0.
    ///
    /// # Errors
    /// The device does not support so many buffers.
    pub fn layout(&self, label: &str, buffers: &[Binding]) -> Result<Bindings, DeviceError> {
        let entry = |(binding, &kind): (u32, &Binding)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: match kind {
                    Binding::Uniform => wgpu::BufferBindingType::Uniform,
                    Binding::Read => wgpu::BufferBindingType::Storage { read_only: true },
                    Binding::Write => wgpu::BufferBindingType::Storage { read_only: false },
                },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        };
        let entries: Vec<_> = (0..).zip(std::iter::once(&Binding::Uniform).chain(buffers)).map(entry).collect();
        self.scoped(label, || {
            let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries };
            let bindings = self.device.create_bind_group_layout(&descriptor);
            let pipeline = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(label),
                bind_group_layouts: &[Some(&bindings)],
                immediate_size: 0,
            });
            Bindings { bindings, pipeline }
        })
    }

    /// Binds buffers for a pipeline, in the order of its layout.
    ///
    /// # Errors
    /// A buffer does not fit its binding.
    pub fn bind(
        &self,
        label: &str,
        layout: &Bindings,
        buffers: &[wgpu::BufferBinding<'_>],
    ) -> Result<wgpu::BindGroup, DeviceError> {
        let all = std::iter::once(self.guard.as_entire_buffer_binding()).chain(buffers.iter().cloned());
        let entries: Vec<_> = (0..)
            .zip(all)
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::Buffer(buffer) })
            .collect();
        let descriptor = wgpu::BindGroupDescriptor { label: Some(label), layout: &layout.bindings, entries: &entries };
        self.scoped(label, || self.device.create_bind_group(&descriptor))
    }

    /// Returns the text of a shader, edited under injected faults.
    fn text<'a>(&self, text: &'a str) -> Cow<'a, str> {
        match &self.faults {
            Some(faults) => faults.edits(text.into()).into(),
            None => text.into(),
        }
    }

    /// Compiles one of the crate's own shaders.
    ///
    /// # Errors
    /// See [`Gpu::pipeline`].
    pub fn own_pipeline(
        &self,
        label: &str,
        wgsl: &str,
        entry: &str,
        layout: &Bindings,
    ) -> Result<wgpu::ComputePipeline, DeviceError> {
        let key = (self.text(wgsl).into_owned(), entry.to_owned(), self.pass);
        let kept = |key: &PipelineKey| lock(&self.kept).get(key).cloned();
        if let Some(pipeline) = kept(&key) {
            return Ok(pipeline);
        }
        // SAFETY: the loops of the crate's own shaders end, their bindings are those of their layouts, and their
        // indices are in bounds for groups and plans that were checked, as the checked builds in the tests show.
        #[expect(unsafe_code, reason = "shaders of the crate's own are compiled without bounds checks")]
        let pipeline = unsafe { self.pipeline(label, &key.0, entry, layout) }?;
        if self.keeps {
            lock(&self.kept).insert(key, pipeline.clone());
        }
        Ok(pipeline)
    }

    /// Compiles an entry point under the device's pass. Workgroup memory starts undefined unless `checked`.
    ///
    /// # Safety
    /// Unless `checked`, the shader is compiled without bounds checks. Its indices must be in bounds, and its loops
    /// must end. It must not divide an integer by zero, or read workgroup memory that it did not write. Its bindings
    /// must match the layout, `checked` or not.
    ///
    /// # Errors
    /// The shader uses operations that differ between devices, exceeds the device's limits, or the driver refuses it.
    #[expect(unsafe_code, reason = "shaders of the crate's own are compiled without bounds checks")]
    pub unsafe fn pipeline(
        &self,
        label: &str,
        wgsl: &str,
        entry: &str,
        layout: &Bindings,
    ) -> Result<wgpu::ComputePipeline, DeviceError> {
        let compiled = self.scoped(label, || {
            // SAFETY: see the function's own contract.
            unsafe { exact::compile(&self.device, label, wgsl, self.pass, self.checked) }
        })?;
        let module = compiled.map_err(|source| DeviceError::Shader { label: label.into(), source })?;
        let descriptor = wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: Some(&layout.pipeline),
            module: &module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: self.checked,
                ..Default::default()
            },
            cache: None,
        };
        self.scoped(label, || self.device.create_compute_pipeline(&descriptor))
    }

    /// Submits commands. `iterations` is their estimated work.
    pub(in crate::backend::gpu) fn submit_commands(
        &self,
        what: &str,
        iterations: u64,
        encoder: wgpu::CommandEncoder,
    ) -> wgpu::SubmissionIndex {
        let commands = encoder.finish();
        match self.drops(what, iterations) {
            true => self.queue.submit([]),
            false => self.queue.submit([commands]),
        }
    }

    /// Writes to buffers, see [`Gpu::write`], and submits that.
    pub(in crate::backend::gpu) fn submit_writes(&self, what: &str, writes: &[(&wgpu::Buffer, usize, &[u8])]) {
        let dropped = self.drops(what, 0);
        for (buffer, offset, bytes) in writes.iter().filter(|_| !dropped) {
            self.write(buffer, *offset as u64, bytes);
        }
        self.queue.submit([]);
    }

    /// Reports whether a submission is dropped under injected faults.
    fn drops(&self, what: &str, iterations: u64) -> bool {
        self.faults.as_ref().is_some_and(|faults| faults.drops(what, iterations))
    }

    /// Submits one dispatch, without waiting for it.
    ///
    /// # Errors
    /// The device was lost, or refuses the dispatch.
    pub fn dispatch(
        &self,
        what: &str,
        pipeline: &wgpu::ComputePipeline,
        buffers: &wgpu::BindGroup,
        workgroups: [u32; 3],
    ) -> Result<(), DeviceError> {
        self.submit(what, pipeline, buffers, workgroups, None)
    }

    fn submit(
        &self,
        what: &str,
        pipeline: &wgpu::ComputePipeline,
        buffers: &wgpu::BindGroup,
        [x, y, z]: [u32; 3],
        watch: Option<&Stopwatch>,
    ) -> Result<(), DeviceError> {
        self.scoped(what, || {
            let mut encoder = self.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&timed(watch));
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, buffers, &[]);
            pass.dispatch_workgroups(x, y, z);
            drop(pass);
            watch.inspect(|watch| watch.stop(&mut encoder));
            self.queue.submit([encoder.finish()]);
        })
    }

    /// Returns how long one dispatch takes: by the device's clock if it has one, else from submission to completion.
    ///
    /// # Errors
    /// The device was lost, or refuses the dispatch.
    pub fn time(
        &self,
        what: &str,
        pipeline: &wgpu::ComputePipeline,
        buffers: &wgpu::BindGroup,
        workgroups: [u32; 3],
    ) -> Result<Duration, DeviceError> {
        let watch = self.stopwatch()?;
        self.wait()?;
        let start = Instant::now();
        self.submit(what, pipeline, buffers, workgroups, watch.as_ref())?;
        self.wait()?;
        let elapsed = start.elapsed();
        match watch {
            // Some software drivers have a clock that stands still.
            Some(watch) => Ok(Some(watch.read(self)?).filter(|time| !time.is_zero()).unwrap_or(elapsed)),
            None => Ok(elapsed),
        }
    }

    /// Reports whether the device has a clock.
    pub(crate) fn has_clock(&self) -> bool {
        self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY)
    }

    /// Returns a stopwatch, if the device has a clock.
    ///
    /// # Errors
    /// There is too little memory.
    pub(in crate::backend::gpu) fn stopwatch(&self) -> Result<Option<Stopwatch>, DeviceError> {
        if !self.has_clock() {
            return Ok(None);
        }
        let bytes = 2 * u64::from(wgpu::QUERY_SIZE);
        let queries = self.scoped("timestamps", || {
            let (label, ty) = (Some("timestamps"), wgpu::QueryType::Timestamp);
            self.device.create_query_set(&wgpu::QuerySetDescriptor { label, ty, count: 2 })
        })?;
        use wgpu::BufferUsages as Usage;
        let ticks = self.buffer("timestamps", bytes, Usage::QUERY_RESOLVE | Usage::COPY_SRC)?;
        let readback_buffer = self.buffer("timestamps, read back", bytes, Usage::COPY_DST | Usage::MAP_READ)?;
        Ok(Some(Stopwatch { queries, ticks, readback_buffer }))
    }
}

/// Times one compute pass by the device's clock.
pub(in crate::backend::gpu) struct Stopwatch {
    queries: wgpu::QuerySet,
    ticks: wgpu::Buffer,
    readback_buffer: wgpu::Buffer,
}

impl Stopwatch {
    /// Copies the times of the pass to the host, after it.
    pub fn stop(&self, encoder: &mut wgpu::CommandEncoder) {
        encoder.resolve_query_set(&self.queries, 0..2, &self.ticks, 0);
        encoder.copy_buffer_to_buffer(&self.ticks, 0, &self.readback_buffer, 0, self.ticks.size());
    }

    /// Returns how long the last submitted pass took, which must have been waited for.
    ///
    /// # Errors
    /// The device was lost.
    pub fn read(&self, gpu: &Gpu) -> Result<Duration, DeviceError> {
        let read = |bytes: &[u8]| bytemuck::pod_collect_to_vec::<u8, u64>(bytes);
        let ticks = gpu.mapped(&self.readback_buffer, 0..self.readback_buffer.size(), read)?;
        let period = f64::from(gpu.queue.get_timestamp_period());
        Ok(Duration::from_nanos((ticks[1].saturating_sub(ticks[0]) as f64 * period) as u64))
    }
}

/// Describes a compute pass, timed if there is a stopwatch.
pub(in crate::backend::gpu) fn timed(watch: Option<&Stopwatch>) -> wgpu::ComputePassDescriptor<'_> {
    let timestamp_writes = watch.map(|watch| wgpu::ComputePassTimestampWrites {
        query_set: &watch.queries,
        beginning_of_pass_write_index: Some(0),
        end_of_pass_write_index: Some(1),
    });
    wgpu::ComputePassDescriptor { label: None, timestamp_writes }
}

/// Returns a grid of at least `tasks` workgroups, within the device's limit on each dimension.
pub(in crate::backend::gpu) fn grid(tasks: usize, limits: &wgpu::Limits) -> [u32; 3] {
    let rows = tasks.div_ceil(limits.max_compute_workgroups_per_dimension as usize).max(1);
    [tasks.div_ceil(rows) as u32, rows as u32, 1]
}
