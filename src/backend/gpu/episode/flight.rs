//! Work in flight: the device's buffers of one batch, and how a batch is submitted.

use std::any::Any;
use std::collections::HashMap;
use std::ops::Range;

use bytemuck::Pod;
use wgpu::BufferUsages as Usage;

use super::planner::{BatchPlan, PACKED_HEAD, PlannedTask, Task, gather};
use super::shape::Shape;
use super::{GpuBackend, Records};
use crate::backend::gpu::device::{BINDING_ALIGNMENT, DeviceError, Gpu, Stopwatch, timed};
use crate::backend::gpu::population::{Dispatch, GatherJob, LEADERS_PER_GATHER, Population, parts};
use crate::backend::{BackendError, FOUR, Group, Weights};
use crate::host::Instant;
use crate::parallel::*;

/// Alignment of each kernel's first task, in tasks, so that a binding may start there.
const TASK_ALIGNMENT: usize = BINDING_ALIGNMENT / size_of::<Task>();
const _: () = assert!(BINDING_ALIGNMENT.is_multiple_of(size_of::<Task>()));
/// Initial share of all sets that a packed record has room for.
pub(super) const KEPT_SHARE: f64 = 1.0 / 16.0;
/// Words of a packed record beyond that share.
const SPARE_PACKED_WORDS: usize = 256;

const INPUT: Usage = Usage::STORAGE.union(Usage::COPY_DST);
const OUTPUT: Usage = Usage::STORAGE.union(Usage::COPY_SRC);
const READ_BACK: Usage = Usage::COPY_DST.union(Usage::MAP_READ);

/// The name of the buffer that the whole record is copied to.
const RECORD_BACK: &str = "record, read back";

/// Populations on the device, and which of them each leader chooses from.
type HeldPolicies<'a> = (&'a Population, &'a [u32]);
/// Jobs to gather from populations on the device, and the policies of the teams, one slice `[teams][leaders]` per
/// group. The slices are adjacent on the device.
type Gathering<'a> = (Vec<(GatherJob, HeldPolicies<'a>)>, Vec<&'a [u32]>);

/// Buffers and stopwatches that later batches reuse.
#[derive(Default)]
pub(super) struct Flight {
    buffers: Buffers,
    /// Stopwatches of the submissions, if they are timed by the device's clock.
    pub(super) watches: Vec<Stopwatch>,
}

/// The device's buffers by name. They only grow.
#[derive(Default)]
pub(super) struct Buffers(HashMap<&'static str, wgpu::Buffer>);

impl Buffers {
    /// Returns a buffer of at least so many bytes. Replaces the present one if it is too small.
    fn sized(&mut self, gpu: &Gpu, what: &'static str, bytes: u64, usage: Usage) -> Result<wgpu::Buffer, DeviceError> {
        let bytes = bytes.max(BINDING_ALIGNMENT as u64);
        if let Some(buffer) = self.0.get(what).filter(|buffer| buffer.size() >= bytes) {
            return Ok(buffer.clone());
        }
        // The old buffer is freed first, because both together may not fit.
        if let Some(old) = self.0.remove(what) {
            old.destroy();
        }
        let buffer = gpu.buffer(what, bytes, usage)?;
        self.0.insert(what, buffer.clone());
        Ok(buffer)
    }

    /// Returns a buffer that starts with the items.
    fn upload<T: Pod>(&mut self, gpu: &Gpu, what: &'static str, items: &[T]) -> Result<wgpu::Buffer, DeviceError> {
        let buffer = self.sized(gpu, what, size_of_val(items) as u64, INPUT)?;
        gpu.scoped(what, || gpu.write(&buffer, 0, bytemuck::cast_slice(items)))?;
        Ok(buffer)
    }
}

/// A packed record that is copied to the host.
#[derive(Clone, Copy)]
pub(super) struct PackedReadback {
    /// Words that there is room for, including tables and owners.
    pub(super) room: usize,
    /// Bytes that are copied: the whole record, or only its header.
    pub(super) bytes: u64,
}

/// The buffers that kernels use.
struct KernelBuffers {
    worlds: wgpu::Buffer,
    tasks: wgpu::Buffer,
    places: wgpu::Buffer,
    weights: wgpu::Buffer,
    record: wgpu::Buffer,
    moments: wgpu::Buffer,
    states: wgpu::Buffer,
    /// The minimum sizes of sets, and the packed record, if there is one.
    packing: Option<[wgpu::Buffer; 2]>,
}

/// A submitted batch.
pub(super) struct SubmittedBatch {
    /// The index of its [`Flight`].
    pub(super) flight: usize,
    /// The last submission, and the number of submissions.
    pub(super) last: wgpu::SubmissionIndex,
    pub(super) submissions: usize,
    /// The time before the first submission, unless some were waited for, and their work.
    pub(super) started: Option<Instant>,
    pub(super) iterations: u64,
    pub(super) nonce: u32,
    pub(super) record: wgpu::Buffer,
    pub(super) readback: ReadbackBuffers,
}

/// The buffers that a batch is copied to, for the host.
#[derive(Default)]
pub(super) struct ReadbackBuffers {
    pub(super) moments: Option<wgpu::Buffer>,
    /// The status words of the populations, and their values if everything was done.
    pub(super) populations: Option<(wgpu::Buffer, Vec<u32>)>,
    pub(super) packed: Option<(wgpu::Buffer, PackedReadback)>,
    /// The whole record.
    pub(super) record: Option<wgpu::Buffer>,
}

/// A copy from one buffer to another: from its start, and to an offset. Bytes.
type BufferCopy<'a> = (&'a wgpu::Buffer, wgpu::Buffer, u64, u64);

/// Tasks of one shape and round.
struct Run {
    shape: Shape,
    round: usize,
    tasks: Range<usize>,
    /// The estimated work of a task.
    iterations: u64,
}

/// Lays out the tasks of all rounds. In each round the tasks of a shape are consecutive, and the first is at an offset
/// where a binding may start.
fn lay_out(batch: &BatchPlan, rounds: usize, nonce: u32) -> (Vec<Task>, Vec<Run>) {
    let (mut tasks, mut runs): (Vec<Task>, Vec<Run>) = Default::default();
    for (round, &shape) in (0..rounds).flat_map(|round| batch.shapes.iter().map(move |shape| (round, shape))) {
        tasks.resize(tasks.len().next_multiple_of(TASK_ALIGNMENT), Task::default());
        let (first, mut iterations) = (tasks.len(), 1);
        for planned in batch.tasks.iter().filter(|planned| planned.shape == shape) {
            if let Some(task) = planned.round(round, nonce) {
                iterations = iterations.max(planned.iterations(&task));
                tasks.push(task);
            }
        }
        if tasks.len() > first {
            runs.push(Run { shape, round, tasks: first..tasks.len(), iterations });
        }
    }
    (tasks, runs)
}

/// The dispatches of a batch on their way to the device, in submissions that no watchdog ends.
#[derive(Default)]
struct Queue {
    /// Dispatches of the next submission, and their estimated work.
    dispatches: Vec<Dispatch>,
    iterations: u64,
    /// Dispatches that pack records, after all others.
    packing: Vec<Dispatch>,
    /// See [`SubmittedBatch`].
    submissions: usize,
    started: Option<Instant>,
    all_iterations: u64,
}

impl GpuBackend {
    /// Submits one batch.
    pub(super) fn submit(
        &mut self,
        flight: usize,
        groups: &[Group<'_>],
        batch: &BatchPlan,
        trace: bool,
    ) -> Result<SubmittedBatch, BackendError> {
        let start = Instant::now();
        let gathering = self.gathering(groups, batch)?;
        let rounds = batch.tasks.iter().map(PlannedTask::rounds).max().unwrap_or(0);
        let nonce = self.gpu.nonces(rounds as u32);
        self.fill_staging(groups, batch);
        let gathered = Instant::now();
        self.times.gather += gathered - start;
        let (tasks, runs) = lay_out(batch, rounds, nonce);
        self.prepare_pipelines(&batch.shapes)?;
        if batch.head.is_some() {
            self.prepare_packing()?;
        }
        let packed = self.packed_readback(batch);
        let buffers = self.upload(flight, groups, batch, &tasks, packed)?;
        let dispatches = self.gather_dispatches(flight, &gathering, &buffers.weights)?;
        let (readback, copies) = self.readback(flight, batch, &buffers, packed, &gathering.0, trace)?;
        let mut queue = Queue { dispatches, started: Some(Instant::now()), ..Queue::default() };
        for run in runs {
            self.enqueue(flight, run, &buffers, &mut queue)?;
        }
        if queue.submissions > 0 && !queue.packing.is_empty() {
            self.flush(flight, &mut queue, &[])?;
        }
        queue.dispatches.append(&mut queue.packing);
        let last = self.flush(flight, &mut queue, &copies)?;
        self.times.upload += gathered.elapsed();
        let Queue { submissions, started, all_iterations: iterations, .. } = queue;
        let record = buffers.record;
        Ok(SubmittedBatch { flight, last, submissions, started, iterations, nonce, record, readback })
    }

    /// Returns how much of a packed record is copied to the host, if a batch has one.
    fn packed_readback(&self, batch: &BatchPlan) -> Option<PackedReadback> {
        let head = batch.head?;
        let most = batch.used.record - PACKED_HEAD - 1;
        let room = match self.records {
            Records::Packed => most,
            _ => head + (batch.sets as f64 * self.kept_share) as usize + SPARE_PACKED_WORDS,
        };
        // If nearly all sets are kept, packing only measures when that changes.
        let (room, words) = if room <= most { (room, PACKED_HEAD + room) } else { (head, PACKED_HEAD) };
        Some(PackedReadback { room, bytes: (words * size_of::<u32>()) as u64 })
    }

    /// Fills the buffers that kernels read, and makes those that they write.
    fn upload(
        &mut self,
        flight: usize,
        groups: &[Group<'_>],
        batch: &BatchPlan,
        tasks: &[Task],
        packed: Option<PackedReadback>,
    ) -> Result<KernelBuffers, DeviceError> {
        let (gpu, buffers) = (&self.gpu, &mut self.flights[flight].buffers);
        let [record, weights, moments, states] = batch.used.bytes();
        let kernel_buffers = KernelBuffers {
            worlds: buffers.upload(gpu, "worlds", &batch.worlds)?,
            tasks: buffers.upload(gpu, "tasks", tasks)?,
            places: buffers.upload(gpu, "places", &batch.places)?,
            weights: buffers.sized(gpu, "weights", weights, INPUT)?,
            record: buffers.sized(gpu, "record", record, OUTPUT)?,
            moments: buffers.sized(gpu, "moments", moments, OUTPUT)?,
            states: buffers.sized(gpu, "states", states, OUTPUT)?,
            packing: match (batch.head, packed) {
                (Some(head), Some(PackedReadback { room, .. })) => {
                    let bytes = ((PACKED_HEAD + room) * size_of::<u32>()) as u64;
                    let packed = buffers.sized(gpu, "packed record", bytes, OUTPUT | Usage::COPY_DST)?;
                    let header = [head as u32, room as u32];
                    gpu.scoped("packed record", || gpu.write(&packed, 0, bytemuck::cast_slice(&header)))?;
                    Some([buffers.upload(gpu, "sizes of sets", &batch.least)?, packed])
                }
                _ => None,
            },
        };
        for tasks in batch.tasks.chunk_by(|a, b| is_on_host(groups, a) == is_on_host(groups, b)) {
            if is_on_host(groups, &tasks[0]) {
                let (first, last) = (tasks[0].task.weights as usize, &tasks[tasks.len() - 1]);
                let end = last.task.weights as usize + last.fours(groups);
                let bytes = bytemuck::cast_slice(&self.staging[first..end]);
                let offset = (first * size_of::<[f32; FOUR]>()) as u64;
                gpu.scoped("weights", || gpu.write(&kernel_buffers.weights, offset, bytes))?;
            }
        }
        Ok(kernel_buffers)
    }

    /// Returns the dispatches that gather policies from populations on the device.
    fn gather_dispatches(
        &mut self,
        flight: usize,
        (jobs, choices): &Gathering<'_>,
        weights: &wgpu::Buffer,
    ) -> Result<Vec<Dispatch>, DeviceError> {
        let Some(kernels) = self.kernels.as_ref().filter(|_| !jobs.is_empty()) else { return Ok(vec![]) };
        let (gpu, buffers) = (&self.gpu, &mut self.flights[flight].buffers);
        let structs: Vec<GatherJob> = jobs.iter().map(|(job, _)| *job).collect();
        let structs = buffers.upload(gpu, "jobs", &parts(&structs))?;
        let bytes = choices.iter().map(|slice| size_of_val(*slice) as u64).sum();
        let buffer = buffers.sized(gpu, "choices", bytes, INPUT)?;
        gpu.scoped("choices", || {
            let mut offset = 0;
            for slice in choices {
                gpu.write(&buffer, offset, bytemuck::cast_slice(slice));
                offset += size_of_val(*slice) as u64;
            }
        })?;
        let dispatch = |(part, (job, held)): (usize, &(GatherJob, HeldPolicies<'_>))| {
            kernels.gather((&structs, part), job, &buffer, *held, weights)
        };
        jobs.iter().enumerate().map(dispatch).collect()
    }

    /// Returns the buffers that are copied to the host, and these copies.
    fn readback<'a>(
        &mut self,
        flight: usize,
        batch: &BatchPlan,
        kernels: &'a KernelBuffers,
        packed: Option<PackedReadback>,
        jobs: &[(GatherJob, HeldPolicies<'a>)],
        trace: bool,
    ) -> Result<(ReadbackBuffers, Vec<BufferCopy<'a>>), DeviceError> {
        let (gpu, buffers) = (&self.gpu, &mut self.flights[flight].buffers);
        let [record_bytes, _, moment_bytes, _] = batch.used.bytes();
        let (mut readback, mut copies) = (ReadbackBuffers::default(), Vec::new());
        if trace {
            let back = buffers.sized(gpu, "moments, read back", moment_bytes, READ_BACK)?;
            copies.push((&kernels.moments, back.clone(), 0, moment_bytes));
            readback.moments = Some(back);
        }
        if !jobs.is_empty() {
            let expected: Vec<u32> = jobs.iter().flat_map(|(_, held)| held.0.status().1).copied().collect();
            let back = buffers.sized(gpu, "status, read back", size_of_val(&expected[..]) as u64, READ_BACK)?;
            let mut offset = 0;
            for (status, words) in jobs.iter().map(|(_, held)| held.0.status()) {
                copies.push((status, back.clone(), offset, size_of_val(words) as u64));
                offset += size_of_val(words) as u64;
            }
            readback.populations = Some((back, expected));
        }
        if let (Some(packed), Some([_, buffer])) = (packed, &kernels.packing) {
            let back = buffers.sized(gpu, "packed record, read back", packed.bytes, READ_BACK)?;
            copies.push((buffer, back.clone(), 0, packed.bytes));
            readback.packed = Some((back, packed));
        }
        // The record comes last, because its status words stand for everything before it.
        if batch.head.is_none_or(|head| packed.is_some_and(|packed| packed.room == head)) {
            let back = buffers.sized(gpu, RECORD_BACK, record_bytes, READ_BACK)?;
            copies.push((&kernels.record, back.clone(), 0, record_bytes));
            readback.record = Some(back);
        }
        Ok((readback, copies))
    }

    /// Adds a run's dispatches to the queue. Submits the queue whenever it has as much work as a submission may have.
    fn enqueue(
        &mut self,
        flight: usize,
        Run { shape, round, mut tasks, iterations }: Run,
        buffers: &KernelBuffers,
        queue: &mut Queue,
    ) -> Result<(), DeviceError> {
        let most = self.gpu.limits.max_compute_workgroups_per_dimension as usize / TASK_ALIGNMENT * TASK_ALIGNMENT;
        while !tasks.is_empty() {
            let allowed = self.pace.tasks(iterations, queue.iterations) / TASK_ALIGNMENT * TASK_ALIGNMENT;
            if allowed == 0 && queue.iterations > 0 {
                self.flush(flight, queue, &[])?;
                continue;
            }
            let part = tasks.start..tasks.end.min(tasks.start + allowed.clamp(TASK_ALIGNMENT, most));
            tasks.start = part.end;
            let part_iterations = part.len() as u64 * iterations;
            queue.all_iterations += part_iterations;
            queue.iterations += part_iterations;
            let is_trial = !tasks.is_empty() && !self.pace.is_measured();
            self.dispatch(shape, part, buffers, queue, round == 0)?;
            if is_trial {
                // The rest is cut by how long this part takes.
                self.gpu.wait()?;
                let (start, trial_iterations) = (Instant::now(), queue.iterations);
                let submitted = self.flush(flight, queue, &[])?;
                self.gpu.wait_for(Some(submitted))?;
                let elapsed = self.gpu.taken(trial_iterations, start.elapsed());
                self.pace.record_trial(trial_iterations, elapsed);
                self.times.longest = self.times.longest.max(elapsed);
                queue.started = None;
            }
        }
        Ok(())
    }

    /// Adds the dispatches of some tasks to the queue: the one that plays them, and in the first round the one that
    /// packs their records.
    fn dispatch(
        &self,
        shape: Shape,
        tasks: Range<usize>,
        buffers: &KernelBuffers,
        queue: &mut Queue,
        is_first_round: bool,
    ) -> Result<(), DeviceError> {
        let KernelBuffers { worlds, places, weights, record, moments, states, packing, .. } = buffers;
        let grid = [tasks.len() as u32, 1, 1];
        let tasks = wgpu::BufferBinding {
            buffer: &buffers.tasks,
            offset: (tasks.start * size_of::<Task>()) as u64,
            size: wgpu::BufferSize::new((tasks.len() * size_of::<Task>()) as u64),
        };
        let [worlds, places, weights, record, moments, states] =
            [worlds, places, weights, record, moments, states].map(|buffer| buffer.as_entire_buffer_binding());
        if let (Some(packing), Some((pipeline, layout)), true) = (packing, &self.pack, is_first_round) {
            let [least, packed] = packing.each_ref().map(|buffer| buffer.as_entire_buffer_binding());
            let inputs = [worlds.clone(), tasks.clone(), least, packed, record.clone()];
            queue.packing.push((pipeline.clone(), self.gpu.bind("pack", layout, &inputs)?, grid));
        }
        let inputs = [worlds, tasks, places, weights, record, moments, states];
        let group = self.gpu.bind("episode", &self.layout, &inputs)?;
        queue.dispatches.push((self.pipelines[&shape].clone(), group, grid));
        Ok(())
    }

    /// Submits the dispatches of the queue, and then the copies.
    fn flush(
        &mut self,
        flight: usize,
        queue: &mut Queue,
        copies: &[BufferCopy<'_>],
    ) -> Result<wgpu::SubmissionIndex, DeviceError> {
        let (gpu, watches) = (&self.gpu, &mut self.flights[flight].watches);
        if self.clock && watches.len() == queue.submissions {
            watches.extend(gpu.stopwatch()?);
        }
        let watch = watches.get(queue.submissions);
        let submitted = gpu.scoped("episodes", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&timed(watch));
            for (pipeline, group, [x, y, z]) in &queue.dispatches {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(*x, *y, *z);
            }
            drop(pass);
            watch.inspect(|watch| watch.stop(&mut encoder));
            for (from, to, offset, bytes) in copies {
                encoder.copy_buffer_to_buffer(from, 0, to, *offset, *bytes);
            }
            gpu.submit_commands("episodes", queue.iterations, encoder)
        })?;
        queue.dispatches.clear();
        (queue.submissions, queue.iterations) = (queue.submissions + 1, 0);
        Ok(submitted)
    }

    /// Copies the whole record of a batch that was played, and waits for it.
    pub(super) fn bring_record(&mut self, batch: &SubmittedBatch, bytes: u64) -> Result<wgpu::Buffer, DeviceError> {
        let gpu = &self.gpu;
        let back = self.flights[batch.flight].buffers.sized(gpu, RECORD_BACK, bytes, READ_BACK)?;
        let submitted = gpu.scoped(RECORD_BACK, || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(&batch.record, 0, &back, 0, bytes);
            gpu.submit_commands("reading back", 0, encoder)
        })?;
        gpu.wait_for(Some(submitted))?;
        Ok(back)
    }

    /// Returns what a batch has to gather on the device.
    fn gathering<'a>(&self, groups: &[Group<'a>], batch: &BatchPlan) -> Result<Gathering<'a>, BackendError> {
        let (mut jobs, mut choices, mut chosen) = (Vec::new(), Vec::new(), 0);
        for tasks in batch.tasks.chunk_by(|a, b| a.group == b.group) {
            let group = &groups[tasks[0].group];
            let Weights::OnDevice(held) = group.weights else { continue };
            let ours = |population: &&Population| self.kernels.as_ref().is_some_and(|k| population.is_of(k));
            let population = (held as &dyn Any).downcast_ref().filter(ours).ok_or(BackendError::HeldElsewhere)?;
            let leaders = group.world.leaders();
            population.check([group.population_count(), group.policies, group.world.parameters()])?;
            let teams: u32 = tasks.iter().map(|planned| planned.task.teams).sum();
            for first in (0..leaders).step_by(LEADERS_PER_GATHER) {
                let job = GatherJob {
                    leaders: leaders as u32,
                    first: first as u32,
                    count: LEADERS_PER_GATHER.min(leaders - first) as u32,
                    parameters: group.world.constants.policy.parameters,
                    teams,
                    teams_per_task: tasks[0].task.teams,
                    choices: chosen as u32,
                    weights: tasks[0].task.weights,
                };
                jobs.push((job, (population, group.populations)));
            }
            choices.push(&group.teams[tasks[0].first_team * leaders..][..teams as usize * leaders]);
            chosen += teams as usize * leaders;
        }
        Ok((jobs, choices))
    }

    /// Gathers the weights of every task whose policies are on the host, and leaves room for the others.
    fn fill_staging(&mut self, groups: &[Group<'_>], batch: &BatchPlan) {
        if !batch.tasks.iter().any(|planned| is_on_host(groups, planned)) {
            return;
        }
        self.staging.resize(batch.used.weights, [0.0; FOUR]);
        let mut rest = &mut self.staging[..];
        let mut parts = Vec::with_capacity(batch.tasks.len());
        for planned in &batch.tasks {
            let group = &groups[planned.group];
            let part = rest.split_off_mut(..planned.fours(groups)).expect("staging holds every task's weights");
            if let Weights::OnHost(weights) = group.weights {
                parts.push((planned, group, weights, part));
            }
        }
        parts.into_par_iter().for_each(|(planned, group, weights, part)| {
            gather(group, weights, planned.first_team, planned.task.teams as usize, part);
        });
    }
}

fn is_on_host(groups: &[Group<'_>], planned: &PlannedTask) -> bool {
    matches!(groups[planned.group].weights, Weights::OnHost(_))
}
