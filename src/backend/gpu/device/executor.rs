//! The executor: carries recordings out, and reads what they bring back.

use std::collections::HashMap;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_channel::oneshot;
use wgpu::BufferUsages as Usage;

use super::{DeviceError, Gpu};
use crate::backend::gpu::exact;
use crate::backend::gpu::recording::{Buffer, Command, Readback, Recording, Slice, iterations};
use crate::backend::gpu::source::{Binding, Pipeline};
use crate::host::{self, Instant};
use crate::parallel::*;

/// Maximum of pipelines kept from one recording to the next, unless one needs more. A driver needs megabytes for each, and
/// a process may play ever new kinds of worlds with specialised kernels.
const KEPT_PIPELINES: usize = 512;

/// Bytes between host and device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// To the device.
    pub up: u64,
    /// From the device.
    pub down: u64,
}

impl std::ops::Sub for Traffic {
    type Output = Traffic;

    fn sub(self, other: Traffic) -> Traffic {
        Traffic { up: self.up - other.up, down: self.down - other.down }
    }
}

impl std::ops::AddAssign for Traffic {
    fn add_assign(&mut self, other: Traffic) {
        (self.up, self.down) = (self.up + other.up, self.down + other.down);
    }
}

/// Buffers that recordings share. They only grow.
#[derive(Debug, Default)]
pub struct Workspace {
    buffers: HashMap<Buffer, wgpu::Buffer>,
    /// Times the recordings by the device's clock.
    stopwatch: Option<Stopwatch>,
}

impl Workspace {
    /// Returns a buffer of the workspace, or of the populations that a group plays.
    fn buffer<'a>(&'a self, buffer: Buffer, groups: &[Option<&'a Workspace>]) -> &'a wgpu::Buffer {
        let (workspace, buffer) = match buffer {
            Buffer::GroupPolicies(group, index) => (groups[group].unwrap_or(self), Buffer::Policies(index)),
            Buffer::GroupStatus(group) => (groups[group].unwrap_or(self), Buffer::Status),
            own => (self, own),
        };
        &workspace.buffers[&buffer]
    }
}

/// Carries recordings out. Clones share their pipelines.
#[derive(Clone, Debug)]
pub struct Executor {
    /// The device.
    pub gpu: Gpu,
    pipelines: Arc<Mutex<HashMap<Pipeline, wgpu::ComputePipeline>>>,
}

impl Executor {
    /// Returns an executor without pipelines.
    pub fn new(gpu: Gpu) -> Executor {
        Executor { gpu, pipelines: Arc::default() }
    }

    /// Reports whether both share their pipelines.
    pub(in crate::backend::gpu) fn is_clone_of(&self, other: &Executor) -> bool {
        Arc::ptr_eq(&self.pipelines, &other.pipelines)
    }

    /// Returns the compiled pipelines.
    pub(in crate::backend::gpu) fn pipelines(&self) -> HashMap<Pipeline, wgpu::ComputePipeline> {
        lock(&self.pipelines).clone()
    }

    /// Submits a recording, after its buffers were created and its pipelines compiled. Returns its submissions.
    /// Waits for nothing. `groups` has the workspaces of the populations that each group plays.
    ///
    /// # Errors
    /// There is too little memory, a shader does not compile, or the device was lost or refuses a command.
    pub(in crate::backend::gpu) fn run(
        &self,
        recording: &Recording<'_>,
        workspace: &mut Workspace,
        groups: &[Option<&Workspace>],
    ) -> Result<Vec<wgpu::SubmissionIndex>, DeviceError> {
        let gpu = &self.gpu;
        self.create_buffers(recording, workspace)?;
        let pipelines = self.compile(recording)?;
        let is_dispatch = |command: &Command<'_>| matches!(command, Command::Dispatch { .. });
        let mut passes_left = recording.submissions().filter(|commands| commands.iter().any(is_dispatch)).count();
        let mut is_first = true;
        gpu.scoped(recording.what, || {
            let mut submitted = Vec::new();
            for commands in recording.submissions() {
                let dropped = gpu.faults().is_some_and(|faults| faults.drops(recording.what, iterations(commands)));
                let mut encoder = gpu.device.create_command_encoder(&Default::default());
                for command in commands.iter().filter(|_| !dropped) {
                    if let Command::Upload { to, offset, bytes } = command {
                        gpu.traffic[0].fetch_add(bytes.len() as u64, Relaxed);
                        gpu.queue.write_buffer(workspace.buffer(*to, groups), *offset, bytes);
                    }
                }
                if commands.iter().any(is_dispatch) {
                    passes_left -= 1;
                    let stopwatch = workspace.stopwatch.as_ref();
                    let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                        label: None,
                        timestamp_writes: stopwatch.and_then(|watch| watch.writes(is_first, passes_left == 0)),
                    });
                    is_first = false;
                    for command in commands {
                        if let Command::Dispatch { pipeline, bindings, grid: [x, y, z], .. } = command {
                            let pipeline = &pipelines[pipeline];
                            pass.set_pipeline(pipeline);
                            pass.set_bind_group(0, &self.bind(pipeline, bindings, workspace, groups), &[]);
                            pass.dispatch_workgroups(*x, *y, *z);
                        }
                    }
                    drop(pass);
                    stopwatch.filter(|_| passes_left == 0).inspect(|watch| watch.stop(&mut encoder));
                }
                for command in commands {
                    if let Command::ReadBack { from: Slice { buffer, bytes }, offset } = command {
                        let (from, to) = (workspace.buffer(*buffer, groups), workspace.buffer(Buffer::Readback, &[]));
                        encoder.copy_buffer_to_buffer(from, bytes.start, to, *offset, bytes.end - bytes.start);
                    }
                }
                let commands = encoder.finish();
                submitted.push(gpu.queue.submit(Some(commands).filter(|_| !dropped)));
            }
            submitted
        })
    }

    /// Waits for the submissions of a recording, and calls `show` with what they read back.
    ///
    /// # Errors
    /// The device was lost, or the bytes cannot be read. A device also counts as lost if a status word is missing: it did
    /// not do the work that its driver reports as done.
    pub(in crate::backend::gpu) fn read<T>(
        &self,
        submitted: &[wgpu::SubmissionIndex],
        workspace: &Workspace,
        readback: &Readback,
        show: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, DeviceError> {
        self.gpu.wait_for(submitted)?;
        self.gpu.mapped(workspace.buffer(Buffer::Readback, &[]), readback.bytes, |bytes| {
            let is_done = |&(at, word): &(usize, u32)| bytes[at..at + size_of::<u32>()] == word.to_ne_bytes();
            match readback.status.par_iter().all(is_done) {
                true => Ok(show(bytes)),
                false => Err(self.gpu.lose_undone()),
            }
        })?
    }

    /// Returns how long a recording takes: by the device's clock if it has one, else from submission to completion.
    ///
    /// # Errors
    /// See [`Executor::run`].
    pub fn time(&self, recording: &Recording<'_>, workspace: &mut Workspace) -> Result<Duration, DeviceError> {
        self.start_clock(workspace)?;
        self.gpu.wait()?;
        let start = Instant::now();
        self.gpu.wait_for(&self.run(recording, workspace, &[])?)?;
        let elapsed = start.elapsed();
        // Some software drivers have a clock that stands still.
        Ok(self.clock(workspace)?.filter(|time| !time.is_zero()).unwrap_or(elapsed))
    }

    /// Starts to time the recordings of a workspace by the device's clock, if it has one.
    ///
    /// # Errors
    /// There is too little memory.
    pub fn start_clock(&self, workspace: &mut Workspace) -> Result<(), DeviceError> {
        if workspace.stopwatch.is_none() && self.gpu.has_clock() {
            workspace.stopwatch = Some(Stopwatch::new(&self.gpu)?);
        }
        Ok(())
    }

    /// Returns how long the last recording of a workspace took by the device's clock, if that was started. It must have
    /// been waited for.
    ///
    /// # Errors
    /// The device was lost.
    pub fn clock(&self, workspace: &Workspace) -> Result<Option<Duration>, DeviceError> {
        workspace.stopwatch.as_ref().map(|watch| watch.read(&self.gpu)).transpose()
    }

    /// Creates the buffers of a recording, unless the workspace has buffers that are large enough.
    fn create_buffers(&self, recording: &Recording<'_>, workspace: &mut Workspace) -> Result<(), DeviceError> {
        let read_back = Some((Buffer::Readback, recording.readback.bytes)).filter(|(_, bytes)| *bytes > 0);
        for (id, bytes) in recording.buffers.iter().copied().chain(read_back) {
            let buffers = &mut workspace.buffers;
            if buffers.get(&id).is_some_and(|buffer| buffer.size() >= bytes) {
                continue;
            }
            // The old buffer is freed first, because both together may not fit.
            if let Some(old) = buffers.remove(&id) {
                old.destroy();
            }
            let usage = match id {
                Buffer::Readback => Usage::COPY_DST | Usage::MAP_READ,
                _ => Usage::STORAGE | Usage::COPY_DST | Usage::COPY_SRC,
            };
            let what = format!("{id:?}").to_lowercase();
            buffers.insert(id, self.gpu.buffer(&what, bytes, usage)?);
        }
        Ok(())
    }

    /// Returns the pipelines of a recording. Compiles those that are new, side by side, and drops others if there are too
    /// many.
    fn compile(&self, recording: &Recording<'_>) -> Result<HashMap<Pipeline, wgpu::ComputePipeline>, DeviceError> {
        let needed = recording.pipelines();
        let mut kept = lock(&self.pipelines);
        let new: Vec<Pipeline> = needed.iter().filter(|pipeline| !kept.contains_key(pipeline)).copied().collect();
        if kept.len() + new.len() > KEPT_PIPELINES {
            kept.retain(|pipeline, _| needed.contains(pipeline));
        }
        let compile = |pipeline: Pipeline| match self.gpu.tested.get(&pipeline) {
            Some(compiled) => Ok((pipeline, compiled.clone())),
            None => Ok((pipeline, self.gpu.own_pipeline(pipeline)?)),
        };
        kept.extend(new.into_par_iter().map(compile).collect::<Result<Vec<_>, DeviceError>>()?);
        Ok(needed.into_iter().map(|pipeline| (pipeline, kept[&pipeline].clone())).collect())
    }

    fn bind(
        &self,
        pipeline: &wgpu::ComputePipeline,
        bindings: &[Slice],
        workspace: &Workspace,
        groups: &[Option<&Workspace>],
    ) -> wgpu::BindGroup {
        let buffers = bindings.iter().map(|Slice { buffer, bytes }| wgpu::BufferBinding {
            buffer: workspace.buffer(*buffer, groups),
            offset: bytes.start,
            size: wgpu::BufferSize::new(bytes.end - bytes.start),
        });
        let buffers = std::iter::once(self.gpu.guard.as_entire_buffer_binding()).chain(buffers);
        let resources = buffers.map(wgpu::BindingResource::Buffer);
        let entries: Vec<_> =
            (0..).zip(resources).map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource }).collect();
        let layout = pipeline.get_bind_group_layout(0);
        self.gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &layout,
            entries: &entries,
        })
    }
}

impl Gpu {
    /// Creates a buffer of `bytes` bytes, all zero.
    ///
    /// # Errors
    /// It exceeds the device's limits, or there is too little memory.
    pub fn buffer(&self, what: &str, bytes: u64, usage: Usage) -> Result<wgpu::Buffer, DeviceError> {
        let mut allowed = self.limits.max_buffer_size;
        if usage.contains(Usage::STORAGE) {
            allowed = allowed.min(self.limits.max_storage_buffer_binding_size);
        }
        if bytes > allowed {
            return Err(DeviceError::TooLarge { adapter: self.adapter.to_string(), what: what.into(), bytes, allowed });
        }
        if self.faults().is_some_and(|faults| faults.lacks_memory(what)) {
            return Err(DeviceError::OutOfMemory { adapter: self.adapter.to_string(), what: what.into() });
        }
        let descriptor = wgpu::BufferDescriptor { label: Some(what), size: bytes, usage, mapped_at_creation: false };
        self.scoped(what, || self.device.create_buffer(&descriptor))
    }

    /// Returns the bytes written to and read from the device since it was opened.
    pub fn traffic(&self) -> Traffic {
        let [up, down] = [0, 1].map(|way| self.traffic[way].load(Relaxed));
        Traffic { up, down }
    }

    /// Calls `show` with the first bytes of a buffer (a multiple of 4; usage `MAP_READ`). All work that writes it must
    /// have been waited for.
    fn mapped<T>(&self, buffer: &wgpu::Buffer, bytes: u64, show: impl FnOnce(&[u8]) -> T) -> Result<T, DeviceError> {
        self.traffic[1].fetch_add(bytes, Relaxed);
        let (send, receive) = oneshot::channel();
        // The receiver is dropped only after an error.
        self.scoped("reading back", || {
            buffer.map_async(wgpu::MapMode::Read, 0..bytes, move |result| drop(send.send(result)));
        })?;
        // The work is done, so one poll completes the mapping.
        let polled = self.device.poll(wgpu::PollType::Poll);
        self.check()?;
        polled.map_err(|error| self.failed("reading back", error))?;
        let mapped = host::wait(receive).map_err(|error| self.failed("reading back", error))?;
        mapped.map_err(|error| self.failed("reading back", error))?;
        let view = buffer.get_mapped_range(0..bytes).map_err(|error| self.failed("reading back", error))?;
        let instead = self.faults().and_then(|faults| faults.reads(buffer, &view));
        let shown = show(instead.as_deref().unwrap_or(&view));
        drop(view);
        buffer.unmap();
        Ok(shown)
    }

    /// Compiles one of the crate's own pipelines.
    fn own_pipeline(&self, pipeline: Pipeline) -> Result<wgpu::ComputePipeline, DeviceError> {
        let text = match self.faults() {
            Some(faults) => faults.edits(pipeline.text()),
            None => pipeline.text(),
        };
        // SAFETY: the loops of the crate's own shaders end, their bindings are those of their layouts, and their
        // indices are in bounds for groups and plans that were checked, as the checked builds in the tests show.
        #[expect(unsafe_code, reason = "shaders of the crate's own are compiled without bounds checks")]
        unsafe {
            self.pipeline(pipeline.entry(), &text, pipeline.entry(), pipeline.bindings())
        }
    }

    /// Compiles an entry point under the device's pass. Its bindings are those of group 0, from 1 on. Workgroup memory
    /// starts undefined unless `checked`.
    ///
    /// # Safety
    /// Unless `checked`, the shader is compiled without bounds checks. Its indices must be in bounds, and its loops
    /// must end. It must not divide an integer by zero, or read workgroup memory that it did not write. Its bindings
    /// must be as listed, `checked` or not.
    ///
    /// # Errors
    /// The shader uses operations that differ between devices, exceeds the device's limits, or the driver refuses it.
    #[expect(unsafe_code, reason = "shaders of the crate's own are compiled without bounds checks")]
    pub unsafe fn pipeline(
        &self,
        label: &str,
        wgsl: &str,
        entry: &str,
        bindings: &[Binding],
    ) -> Result<wgpu::ComputePipeline, DeviceError> {
        let compiled = self.scoped(label, || {
            // SAFETY: see the function's own contract.
            unsafe { exact::compile(&self.device, label, wgsl, self.pass, self.checked) }
        })?;
        let module = compiled.map_err(|source| DeviceError::Shader { label: label.into(), source })?;
        let layout = |(binding, kind): (u32, &Binding)| wgpu::BindGroupLayoutEntry {
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
        let entries: Vec<_> = (0..).zip(std::iter::once(&Binding::Uniform).chain(bindings)).map(layout).collect();
        self.scoped(label, || {
            let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries };
            let layout = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(label),
                bind_group_layouts: &[Some(&self.device.create_bind_group_layout(&descriptor))],
                immediate_size: 0,
            });
            self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(label),
                layout: Some(&layout),
                module: &module,
                entry_point: Some(entry),
                compilation_options: wgpu::PipelineCompilationOptions {
                    zero_initialize_workgroup_memory: self.checked,
                    ..Default::default()
                },
                cache: None,
            })
        })
    }

    /// Reports whether the device has a clock.
    fn has_clock(&self) -> bool {
        self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY)
    }
}

/// Times a recording by the device's clock.
#[derive(Debug)]
struct Stopwatch {
    queries: wgpu::QuerySet,
    ticks: wgpu::Buffer,
    readback: wgpu::Buffer,
}

impl Stopwatch {
    fn new(gpu: &Gpu) -> Result<Stopwatch, DeviceError> {
        let bytes = 2 * u64::from(wgpu::QUERY_SIZE);
        let queries = gpu.scoped("timestamps", || {
            let (label, ty) = (Some("timestamps"), wgpu::QueryType::Timestamp);
            gpu.device.create_query_set(&wgpu::QuerySetDescriptor { label, ty, count: 2 })
        })?;
        let ticks = gpu.buffer("timestamps", bytes, Usage::QUERY_RESOLVE | Usage::COPY_SRC)?;
        let readback = gpu.buffer("timestamps", bytes, Usage::COPY_DST | Usage::MAP_READ)?;
        Ok(Stopwatch { queries, ticks, readback })
    }

    /// Returns what the first and the last pass of a recording write.
    fn writes(&self, is_first: bool, is_last: bool) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        (is_first || is_last).then_some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: is_first.then_some(0),
            end_of_pass_write_index: is_last.then_some(1),
        })
    }

    /// Copies the times to the host, after the last pass.
    fn stop(&self, encoder: &mut wgpu::CommandEncoder) {
        encoder.resolve_query_set(&self.queries, 0..2, &self.ticks, 0);
        encoder.copy_buffer_to_buffer(&self.ticks, 0, &self.readback, 0, self.ticks.size());
    }

    fn read(&self, gpu: &Gpu) -> Result<Duration, DeviceError> {
        let read = |bytes: &[u8]| bytemuck::pod_collect_to_vec::<u8, u64>(bytes);
        let ticks = gpu.mapped(&self.readback, self.readback.size(), read)?;
        let period = f64::from(gpu.queue.get_timestamp_period());
        Ok(Duration::from_nanos((ticks[1].saturating_sub(ticks[0]) as f64 * period) as u64))
    }
}
