//! Work in flight: the device's buffers of one batch, and how a batch is submitted.

use std::any::Any;
use std::ops::Range;

use super::planner::{BatchPlan, PACKED_HEAD, PlannedTask, State, Task, gather};
use super::shape::Shape;
use super::{GpuBackend, Records};
use crate::backend::gpu::device::{BINDING_ALIGNMENT, DeviceError, Gpu, Stopwatch, timed};
use crate::backend::gpu::population::{Dispatch, GatherJob, Population, TOGETHER, parts};
use crate::backend::{BackendError, FOUR, Group, Moment, Weights};
use crate::host::Instant;
use crate::parallel::*;

/// Alignment of each kernel's first task, in tasks, so that a binding may start there.
const TASK_ALIGNMENT: usize = BINDING_ALIGNMENT / size_of::<Task>();
const _: () = assert!(BINDING_ALIGNMENT.is_multiple_of(size_of::<Task>()));
/// Initial share of all sets that a packed record has room for.
pub(super) const KEPT_SHARE: f64 = 1.0 / 16.0;
/// Words of a packed record beyond that share.
const MIN_KEPT_SETS: usize = 256;

/// Jobs to gather from populations on the device, and the policies of the teams, one slice `[teams][leaders]` per
/// group. The slices are adjacent on the device.
type Gathering<'a> = (Vec<(GatherJob, &'a Population)>, Vec<&'a [u32]>);

/// The device's buffers of one batch. They only grow.
#[derive(Default)]
pub(super) struct Buffers {
    pub(super) worlds: Option<wgpu::Buffer>,
    pub(super) tasks: Option<wgpu::Buffer>,
    pub(super) places: Option<wgpu::Buffer>,
    pub(super) jobs: Option<wgpu::Buffer>,
    pub(super) choices: Option<wgpu::Buffer>,
    pub(super) weights: Option<wgpu::Buffer>,
    pub(super) record: Option<wgpu::Buffer>,
    pub(super) moments: Option<wgpu::Buffer>,
    pub(super) states: Option<wgpu::Buffer>,
    pub(super) record_back: Option<wgpu::Buffer>,
    pub(super) moments_back: Option<wgpu::Buffer>,
    pub(super) least: Option<wgpu::Buffer>,
    pub(super) packed: Option<wgpu::Buffer>,
    pub(super) packed_back: Option<wgpu::Buffer>,
    /// The packed record, if any, and whether the whole record is copied to the host too.
    pub(super) sent: Option<PackedReadback>,
    pub(super) whole: bool,
    /// Stopwatches of the submissions, if they are timed by the device's clock.
    pub(super) watches: Vec<Stopwatch>,
    /// The number of submissions, the time before the first, unless some were waited for, and their work.
    pub(super) submissions: usize,
    pub(super) started: Option<Instant>,
    pub(super) iterations: u64,
    /// The last submission.
    pub(super) submitted: Option<wgpu::SubmissionIndex>,
    /// The nonce of the batch.
    pub(super) nonce: u32,
    /// The status words of the populations that it plays, on their way to the host, and their values if everything
    /// was done.
    pub(super) populations_back: Option<wgpu::Buffer>,
    pub(super) populations: Vec<u32>,
}

/// A packed record that is copied to the host.
#[derive(Clone, Copy)]
pub(super) struct PackedReadback {
    /// Words that there is room for, including tables and owners.
    pub(super) room: usize,
    /// Bytes that are copied: everything, or only how many words were used.
    pub(super) bytes: u64,
}

impl Buffers {
    /// Copies the whole record of a batch that was played, and waits for it.
    pub(super) fn bring_record(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), DeviceError> {
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let back = grown(gpu, &mut self.record_back, "record, read back", bytes, usage)?;
        let Some(record) = &self.record else { return Ok(()) };
        let submitted = gpu.scoped("record, read back", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(record, 0, back, 0, bytes);
            gpu.submit_commands("reading back", 0, encoder)
        })?;
        gpu.wait_for(Some(submitted))
    }
}

/// Returns a buffer of at least so many bytes. Replaces the present one if it is too small.
fn grown<'a>(
    gpu: &Gpu,
    buffer: &'a mut Option<wgpu::Buffer>,
    what: &str,
    bytes: u64,
    usage: wgpu::BufferUsages,
) -> Result<&'a wgpu::Buffer, DeviceError> {
    let bytes = bytes.max(BINDING_ALIGNMENT as u64);
    if buffer.as_ref().is_none_or(|buffer| buffer.size() < bytes) {
        // The old buffer is freed first, because both together may not fit.
        if let Some(old) = buffer.take() {
            old.destroy();
        }
        *buffer = Some(gpu.buffer(what, bytes, usage)?);
    }
    Ok(buffer.as_ref().expect("just made"))
}

/// Tasks of one shape and round.
struct Run {
    shape: Shape,
    round: usize,
    tasks: Range<usize>,
    /// The estimated work of a task.
    iterations: u64,
}

/// The dispatches of a batch on their way to the device, in submissions that no watchdog ends.
struct Submission<'a> {
    gpu: &'a Gpu,
    /// Whether submissions are timed by the device's clock.
    clock: bool,
    watches: &'a mut Vec<Stopwatch>,
    /// The number of submissions.
    count: usize,
    /// Dispatches of the next submission, their estimated time in seconds and their estimated work.
    dispatches: Vec<Dispatch<'a>>,
    load: f64,
    iterations: u64,
}

impl Submission<'_> {
    /// Submits the dispatches, and whatever `copy` adds.
    fn submit(&mut self, copy: impl FnOnce(&mut wgpu::CommandEncoder)) -> Result<wgpu::SubmissionIndex, DeviceError> {
        let Submission { gpu, clock, watches, count, dispatches, iterations, .. } = self;
        if *clock && watches.len() == *count {
            watches.extend(gpu.stopwatch()?);
        }
        let watch = watches.get(*count);
        let submitted = gpu.scoped("episodes", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&timed(watch));
            for (pipeline, group, [x, y, z]) in dispatches.iter() {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(*x, *y, *z);
            }
            drop(pass);
            watch.inspect(|watch| watch.stop(&mut encoder));
            copy(&mut encoder);
            gpu.submit_commands("episodes", *iterations, encoder)
        })?;
        dispatches.clear();
        (self.count, self.load, self.iterations) = (self.count + 1, 0.0, 0);
        Ok(submitted)
    }
}

impl GpuBackend {
    /// Submits one batch.
    pub(super) fn submit(
        &mut self,
        flight: usize,
        groups: &[Group<'_>],
        work: &BatchPlan,
        trace: bool,
    ) -> Result<(), BackendError> {
        use wgpu::BufferUsages as Usage;
        let start = Instant::now();
        let (jobs, choices) = self.jobs(groups, work)?;
        let rounds = work.shares.iter().map(PlannedTask::rounds).max().unwrap_or(0);
        let nonce = self.gpu.nonces(rounds as u32);
        self.fill_staging(groups, work);
        let gathered = Instant::now();
        self.stages.gather += gathered - start;
        // In each round the tasks of a shape are consecutive. The first is at an offset where a binding may start.
        let mut tasks: Vec<Task> = Vec::new();
        let mut runs: Vec<Run> = Vec::new();
        let shapes = &work.shapes;
        self.prepare_pipelines(shapes)?;
        for (round, &shape) in (0..rounds).flat_map(|round| shapes.iter().map(move |shape| (round, shape))) {
            tasks.resize(tasks.len().next_multiple_of(TASK_ALIGNMENT), Task::default());
            let (first, mut iterations) = (tasks.len(), 1);
            for share in work.shares.iter().filter(|share| share.shape == shape) {
                if let Some(task) = share.round(round, nonce) {
                    iterations = iterations.max(share.iterations(&task));
                    tasks.push(task);
                }
            }
            if tasks.len() > first {
                runs.push(Run { shape, round, tasks: first..tasks.len(), iterations });
            }
        }
        if work.head.is_some() {
            self.prepare_packing()?;
        }
        let sent = work.head.map(|head| {
            let most = work.record - PACKED_HEAD - 1;
            let room = match self.records {
                Records::Packed => most,
                _ => head + (work.sets as f64 * self.kept_share) as usize + MIN_KEPT_SETS,
            };
            // If nearly all sets are kept, packing only measures when that changes.
            match room <= most {
                true => PackedReadback { room, bytes: ((PACKED_HEAD + room) * size_of::<u32>()) as u64 },
                false => PackedReadback { room: head, bytes: (PACKED_HEAD * size_of::<u32>()) as u64 },
            }
        });
        let whole = work.head.is_none_or(|head| sent.is_some_and(|sent| sent.room == head));

        let gpu = &self.gpu;
        let buffers = &mut self.flights[flight];
        let input = Usage::STORAGE | Usage::COPY_DST;
        let output = Usage::STORAGE | Usage::COPY_SRC;
        let back = Usage::COPY_DST | Usage::MAP_READ;
        let record_bytes = (work.record * size_of::<u32>()) as u64;
        let moment_bytes = (work.moments * size_of::<Moment>()) as u64;
        let upload = |buffer, what, bytes: &[u8]| -> Result<wgpu::Buffer, DeviceError> {
            let buffer = grown(gpu, buffer, what, bytes.len() as u64, input)?;
            gpu.scoped(what, || gpu.write(buffer, 0, bytes))?;
            Ok(buffer.clone())
        };
        let worlds = upload(&mut buffers.worlds, "worlds", bytemuck::cast_slice(&work.worlds))?;
        let all_tasks = upload(&mut buffers.tasks, "tasks", bytemuck::cast_slice(&tasks))?;
        let places = upload(&mut buffers.places, "places", bytemuck::cast_slice(&work.places))?;
        let weight_bytes = (work.weights * size_of::<[f32; FOUR]>()) as u64;
        let weights = grown(gpu, &mut buffers.weights, "weights", weight_bytes, input)?.clone();
        for run in work.shares.chunk_by(|a, b| is_on_host(groups, a) == is_on_host(groups, b)) {
            if is_on_host(groups, &run[0]) {
                let (first, last) = (run[0].task.weights as usize, &run[run.len() - 1]);
                let end = last.task.weights as usize + last.fours(groups);
                let bytes = bytemuck::cast_slice(&self.staging[first..end]);
                let offset = (first * size_of::<[f32; FOUR]>()) as u64;
                gpu.scoped("weights", || gpu.write(&weights, offset, bytes))?;
            }
        }
        let mut gathers = Vec::with_capacity(jobs.len());
        if let Some(kernels) = self.kernels.as_ref().filter(|_| !jobs.is_empty()) {
            let structs: Vec<GatherJob> = jobs.iter().map(|(job, _)| *job).collect();
            let structs = upload(&mut buffers.jobs, "jobs", &parts(&structs))?;
            let bytes = choices.iter().map(|slice| size_of_val(*slice) as u64).sum();
            let buffer = grown(gpu, &mut buffers.choices, "choices", bytes, input)?;
            gpu.scoped("choices", || {
                let mut offset = 0;
                for slice in &choices {
                    gpu.write(buffer, offset, bytemuck::cast_slice(slice));
                    offset += size_of_val(*slice) as u64;
                }
            })?;
            for (part, (job, population)) in jobs.iter().enumerate() {
                gathers.push(kernels.gather((&structs, part), job, buffer, population, &weights)?);
            }
        }
        let record = grown(gpu, &mut buffers.record, "record", record_bytes, output)?;
        let moments = grown(gpu, &mut buffers.moments, "moments", moment_bytes, output)?;
        let state_bytes = (work.states * size_of::<State>()) as u64;
        let states = grown(gpu, &mut buffers.states, "states", state_bytes, output)?;
        let record_back = match whole {
            true => Some(grown(gpu, &mut buffers.record_back, "record, read back", record_bytes, back)?),
            false => None,
        };
        let moments_back = match trace {
            true => Some(grown(gpu, &mut buffers.moments_back, "moments, read back", moment_bytes, back)?),
            false => None,
        };

        let packing = match (work.head, sent, &self.pack) {
            (Some(head), Some(sent), Some(pack)) => {
                let bytes = ((PACKED_HEAD + sent.room) * size_of::<u32>()) as u64;
                let packed = grown(gpu, &mut buffers.packed, "packed record", bytes, output | Usage::COPY_DST)?;
                let header = [head as u32, sent.room as u32];
                gpu.scoped("packed record", || gpu.write(packed, 0, bytemuck::cast_slice(&header)))?;
                let back = grown(gpu, &mut buffers.packed_back, "packed record, read back", sent.bytes, back)?;
                let least = upload(&mut buffers.least, "sizes of sets", bytemuck::cast_slice(&work.least))?;
                Some((pack, least, packed, back, sent.bytes))
            }
            _ => None,
        };

        let population_bytes = 4 * jobs.iter().map(|(_, population)| population.status().1.len() as u64).sum::<u64>();
        let populations_back = match jobs.is_empty() {
            false => Some(grown(gpu, &mut buffers.populations_back, "status, read back", population_bytes, back)?),
            true => None,
        };
        buffers.populations.clear();
        buffers.populations.extend(jobs.iter().flat_map(|(_, population)| population.status().1));

        let most = gpu.limits.max_compute_workgroups_per_dimension as usize / TASK_ALIGNMENT * TASK_ALIGNMENT;
        let (clock, watches) = (self.clock, &mut buffers.watches);
        let mut submission =
            Submission { gpu, clock, watches, count: 0, dispatches: gathers, load: 0.0, iterations: 0 };
        let (mut packs, mut started, mut total_iterations) = (Vec::new(), Some(Instant::now()), 0);
        for Run { shape, round, mut tasks, iterations } in runs {
            while !tasks.is_empty() {
                let pace = self.paces.entry(shape).or_default();
                let allowed = pace.tasks(iterations, submission.load) / TASK_ALIGNMENT * TASK_ALIGNMENT;
                if allowed == 0 && submission.iterations > 0 {
                    submission.submit(|_| ())?;
                    continue;
                }
                let part = tasks.start..tasks.end.min(tasks.start + allowed.clamp(TASK_ALIGNMENT, most));
                tasks.start = part.end;
                let (grid, part_iterations) = ([part.len() as u32, 1, 1], part.len() as u64 * iterations);
                let bound_tasks = wgpu::BufferBinding {
                    buffer: &all_tasks,
                    offset: (part.start * size_of::<Task>()) as u64,
                    size: wgpu::BufferSize::new((part.len() * size_of::<Task>()) as u64),
                };
                let [worlds, places, weights, record, moments, states] =
                    [&worlds, &places, &weights, record, moments, states]
                        .map(|buffer| buffer.as_entire_buffer_binding());
                if let Some(((pipeline, layout), least, packed, ..)) = packing.as_ref().filter(|_| round == 0) {
                    let [least, packed] = [least, *packed].map(|buffer| buffer.as_entire_buffer_binding());
                    let inputs = [worlds.clone(), bound_tasks.clone(), least, packed, record.clone()];
                    packs.push((pipeline, gpu.bind("pack", layout, &inputs)?, grid));
                }
                let inputs = [worlds, bound_tasks, places, weights, record, moments, states];
                let group = gpu.bind("episode", &self.layout, &inputs)?;
                submission.dispatches.push((&self.pipelines[&shape].pipeline, group, grid));
                total_iterations += part_iterations;
                submission.iterations += part_iterations;
                submission.load += pace.seconds(part_iterations);
                if !tasks.is_empty() && !pace.is_known() {
                    // The rest is cut by how long this part takes.
                    gpu.wait()?;
                    let start = Instant::now();
                    gpu.wait_for(Some(submission.submit(|_| ())?))?;
                    let elapsed = gpu.taken(part_iterations, start.elapsed());
                    pace.try_out(part_iterations, elapsed);
                    self.stages.longest = self.stages.longest.max(elapsed);
                    started = None;
                }
            }
        }
        if submission.count > 0 && !packs.is_empty() {
            submission.submit(|_| ())?;
        }
        submission.dispatches.extend(packs);
        let submitted = submission.submit(|encoder| {
            // The record comes last, because its status words stand for everything before it.
            if let Some(moments_back) = moments_back {
                encoder.copy_buffer_to_buffer(moments, 0, moments_back, 0, moment_bytes);
            }
            let mut to = 0;
            for (_, population) in &jobs {
                let (status, words) = population.status();
                let bytes = size_of_val(words) as u64;
                populations_back.inspect(|back| encoder.copy_buffer_to_buffer(status, 0, back, to, bytes));
                to += bytes;
            }
            if let Some((.., packed, back, bytes)) = packing {
                encoder.copy_buffer_to_buffer(packed, 0, back, 0, bytes);
            }
            if let Some(record_back) = record_back {
                encoder.copy_buffer_to_buffer(record, 0, record_back, 0, record_bytes);
            }
        })?;
        buffers.submissions = submission.count;
        buffers.submitted = Some(submitted);
        (buffers.sent, buffers.whole, buffers.nonce) = (sent, whole, nonce);
        (buffers.started, buffers.iterations) = (started, total_iterations);
        self.stages.upload += gathered.elapsed();
        Ok(())
    }

    /// Returns what a batch has to gather on the device.
    fn jobs<'a>(&self, groups: &[Group<'a>], work: &BatchPlan) -> Result<Gathering<'a>, BackendError> {
        let (mut jobs, mut choices, mut chosen) = (Vec::new(), Vec::new(), 0);
        for shares in work.shares.chunk_by(|a, b| a.group == b.group) {
            let group = &groups[shares[0].group];
            let Weights::OnDevice(held) = group.weights else { continue };
            let ours = |population: &&Population| self.kernels.as_ref().is_some_and(|k| population.is_of(k));
            let population = (held as &dyn Any).downcast_ref().filter(ours).ok_or(BackendError::HeldElsewhere)?;
            let leaders = group.world.leaders();
            population.check([group.populations(), group.policies, group.world.parameters()])?;
            let teams: u32 = shares.iter().map(|share| share.task.teams).sum();
            for first in (0..leaders).step_by(TOGETHER) {
                let job = GatherJob {
                    leaders: leaders as u32,
                    first: first as u32,
                    count: TOGETHER.min(leaders - first) as u32,
                    parameters: group.world.constants.policy.parameters,
                    teams,
                    teams_per_task: shares[0].task.teams,
                    choices: chosen as u32,
                    weights: shares[0].task.weights,
                };
                jobs.push((job, population));
            }
            choices.push(&group.teams[shares[0].first_team * leaders..][..teams as usize * leaders]);
            chosen += teams as usize * leaders;
        }
        Ok((jobs, choices))
    }

    /// Gathers the weights of every task whose policies are on the host, and leaves room for the others.
    fn fill_staging(&mut self, groups: &[Group<'_>], work: &BatchPlan) {
        if !work.shares.iter().any(|share| is_on_host(groups, share)) {
            return;
        }
        self.staging.resize(work.weights, [0.0; FOUR]);
        let mut rest = &mut self.staging[..];
        let mut parts = Vec::with_capacity(work.shares.len());
        for share in &work.shares {
            let group = &groups[share.group];
            let (part, tail) = rest.split_at_mut(share.fours(groups));
            rest = tail;
            if let Weights::OnHost(weights) = group.weights {
                parts.push((share, group, weights, part));
            }
        }
        parts.into_par_iter().for_each(|(share, group, weights, part)| {
            gather(group, weights, share.first_team, share.task.teams as usize, part);
        });
    }
}

fn is_on_host(groups: &[Group<'_>], share: &PlannedTask) -> bool {
    matches!(groups[share.group].weights, Weights::OnHost(_))
}
