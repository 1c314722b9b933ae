//! Whole episodes on a GPU: teams are packed into workgroups, workgroups into batches that fit the device.
//!
//! | file | holds |
//! |---|---|
//! | `plan` | teams cut into tasks, tasks into batches, and the recording of each batch |
//! | `count` | sums that a device computes from each record, and the scores that follow |
//! | `check` | the test of the kernel of large teams |
//! | `inspect` | shaders and inputs of one workgroup, to see what compilers make of them |
//!
//! One shader text makes two kernels. The generic one plays any world. The specialised one is compiled for a world's
//! sizes: all loops have constant bounds and the policy is straight-line code. See [`Kernel`]. Large teams have a kernel of
//! their own, `shaders/swarm.wgsl`, with several dispatches per step.
//!
//! While the GPU plays one batch, the CPU reads the record of the batch before it. If only scores are requested, the
//! GPU keeps the record, and returns only sums that the scores follow from, see [`Records`].

use std::any::Any;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use super::device::{DeviceError, Executor, Gpu, Kind, Traffic, Workspace};
use super::population::{Held, Population};
use super::recording::{Readback, iterations};
use super::shape::{Capacity, MAX_OFFSET, specialised_shapes};
use super::source::{NOWHERE, Pipeline, Task};
use crate::backend::grid::LARGE_FROM;
use crate::backend::scores::ScoreTable;
use crate::backend::{
    BATCH_BYTES, Backend, BackendError, DevicePopulation, Group, GroupScores, HELD_FROM, MOMENT_WORDS, Moment, Trace,
    WeightVector, Weights, check_sizes,
};
use crate::credit::{Episode, Paths, Strided};
use crate::host::Instant;
use crate::parallel::*;

mod check;
mod count;
mod inspect;
mod plan;

pub use super::shape::Kernel;
pub use inspect::{WorkgroupBuffers, shader_of, workgroup_of};
pub(crate) use plan::dispatch_bytes;

use count::Counting;
use plan::{BatchPlan, BatchReadback, PlannedTask, RecordingOptions, plan};

/// Default minimum bytes of a batch's records of which a GPU counts what scores depend on: about what the bus transfers in
/// the time of one more dispatch. An estimate, not a measurement. Software renderers count nothing.
const COUNTED_FROM: u64 = 1 << 20;
/// Target time of a submission, in seconds: no watchdog ends it, even if its kernels are several times as slow as others.
/// Windows ends a submission after 2 s, other systems even earlier.
const SUBMISSION_TIME: f64 = 0.1;
/// Iterations per submission before the device's speed is known, and at least. They take milliseconds on slow GPUs.
const MIN_CAP: u64 = 1 << 24;
/// A batch that took less time, or for which the host hardly waited, shows only that the device is at least so fast.
const SHORT: Duration = Duration::from_millis(5);

/// Selects the populations that a device holds between generations. Results do not depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResidencyPolicy {
    /// None.
    Never,
    /// Those of at least so many bytes per trial, if they fit.
    From(u64),
    /// All. Populations that do not fit are an error.
    Always,
}

/// How records are copied to the host if only scores are requested. Results do not depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Records {
    /// As they are.
    Whole,
    /// Sums, if the records of a batch have at least so many bytes: the device adds up what is lost without each leader.
    /// Records whose scores need more are copied whole.
    CountedFrom(u64),
}

impl Records {
    /// Reports whether the device counts what a record of so many bytes has.
    fn counts(self, bytes: u64) -> bool {
        matches!(self, Records::CountedFrom(minimum) if bytes >= minimum)
    }
}

/// Plays episodes on a GPU.
pub struct GpuBackend {
    executor: Executor,
    kernel: Kernel,
    residency: ResidencyPolicy,
    records: Records,
    /// Target bytes of one buffer of a batch.
    batch_bytes: u64,
    /// Agents from which teams are large.
    large_from: usize,
    /// Whether the kernel of large teams is to be tested before they play for the first time.
    tests_large: bool,
    /// Whether rollouts are timed by the device's clock.
    clock: bool,
    /// Two sets of buffers, so that one batch plays while the other is read.
    workspaces: [Workspace; 2],
    /// Weights to be copied to the device.
    staging: Vec<WeightVector>,
    /// Maximum work of a submission, in estimated iterations.
    cap: u64,
    /// When the last batch finished.
    done_at: Option<Instant>,
    times: PhaseTimes,
}

/// Called for each task with the trace of its batch, and what was counted of it or its record.
type Done<'a> = dyn Fn(&PlannedTask, &[u32], &[f32]) + Sync + 'a;

/// A submitted batch.
struct Submitted<'a> {
    plan: &'a BatchPlan,
    /// The index of its workspace.
    workspace: usize,
    submissions: Vec<wgpu::SubmissionIndex>,
    start: Instant,
    /// The estimated work.
    iterations: u64,
    /// The words that the batch reads back, and the places of its results among them.
    readback: Readback,
    ranges: BatchReadback,
}

/// The time that rollouts took, by phase. The CPU's phases do not overlap; the GPU works at the same time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhaseTimes {
    /// Planning batches and gathering weights.
    pub gather: Duration,
    /// Copying inputs to the driver and submitting.
    pub upload: Duration,
    /// Waiting for the GPU.
    pub wait: Duration,
    /// Mapping the record into the host's memory.
    pub read_back: Duration,
    /// Computing scores from the record.
    pub score: Duration,
    /// Playing, by the GPU's clock. 0 if that was not requested or there is none.
    pub gpu: Duration,
    /// The longest submission, if those of a batch take equally long: by the GPU's clock if that was requested, else as
    /// the host saw it.
    pub longest: Duration,
    /// Bytes copied to and from the device.
    pub traffic: Traffic,
}

impl GpuBackend {
    /// Prepares an opened device for episodes.
    ///
    /// # Errors
    /// The device does not support the episode's bindings.
    pub fn new(gpu: Gpu) -> Result<GpuBackend, DeviceError> {
        Ok(GpuBackend { tests_large: true, ..GpuBackend::with_executor(Executor::new(gpu)) })
    }

    /// Returns a backend that shares the pipelines of an executor, and tests nothing.
    pub(super) fn with_executor(executor: Executor) -> GpuBackend {
        let software = executor.gpu.adapter.kind == Kind::Software;
        GpuBackend {
            executor,
            kernel: if software { Kernel::Generic } else { Kernel::Best },
            residency: if software { ResidencyPolicy::Never } else { ResidencyPolicy::From(HELD_FROM) },
            records: if software { Records::Whole } else { Records::CountedFrom(COUNTED_FROM) },
            batch_bytes: BATCH_BYTES,
            large_from: LARGE_FROM,
            tests_large: false,
            clock: false,
            workspaces: Default::default(),
            staging: Vec::new(),
            cap: MIN_CAP,
            done_at: None,
            times: PhaseTimes::default(),
        }
    }

    /// Sets the target bytes of a batch's buffers. Results do not depend on it.
    pub fn with_batch_bytes(self, bytes: u64) -> GpuBackend {
        GpuBackend { batch_bytes: bytes, ..self }
    }

    /// Plays teams of at least so many agents as large ones. Results do not depend on it.
    pub fn with_large_from(self, agents: usize) -> GpuBackend {
        GpuBackend { large_from: agents, ..self }
    }

    /// Chooses kernels. The default is [`Kernel::Best`], and [`Kernel::Generic`] on software renderers, whose compilers
    /// take about a second for each specialised kernel.
    pub fn with_kernel(self, kernel: Kernel) -> GpuBackend {
        GpuBackend { kernel, ..self }
    }

    /// Returns how many generic and how many specialised kernels are compiled.
    pub fn compiled(&self) -> [usize; 2] {
        let pipelines = self.executor.pipelines();
        let shapes = pipelines.keys().filter_map(Pipeline::shape);
        let (specialised, generic): (Vec<_>, Vec<_>) = shapes.partition(|shape| shape.is_specialised());
        [generic.len(), specialised.len()]
    }

    /// Chooses which populations the device holds.
    pub fn with_residency(self, residency: ResidencyPolicy) -> GpuBackend {
        GpuBackend { residency, ..self }
    }

    /// Chooses how records are copied to the host.
    pub fn with_records(self, records: Records) -> GpuBackend {
        GpuBackend { records, ..self }
    }

    /// Changes the text of shaders, so that tests can show that a change is detected.
    ///
    /// # Safety
    /// Shaders are compiled without bounds checks. An edited shader must keep its indices in bounds and its loops
    /// finite, see [`Gpu::pipeline`].
    #[cfg(debug_assertions)]
    #[doc(hidden)]
    #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
    pub unsafe fn edited(self, edit: fn(String) -> String) -> GpuBackend {
        struct Edit(fn(String) -> String);
        impl super::faults::Faults for Edit {
            fn edits(&self, text: String) -> String {
                (self.0)(text)
            }
        }
        // SAFETY: see the function's own contract.
        let gpu = unsafe { self.executor.gpu.failing(std::sync::Arc::new(Edit(edit))) };
        GpuBackend { executor: Executor::new(gpu), tests_large: false, ..self }
    }

    /// Starts to time rollouts by the GPU's clock, if it has one.
    pub fn use_clock(&mut self) {
        self.clock = true;
    }

    /// Returns and resets the times of rollouts.
    pub fn take_times(&mut self) -> PhaseTimes {
        std::mem::take(&mut self.times)
    }

    /// Returns the device.
    pub fn gpu(&self) -> &Gpu {
        &self.executor.gpu
    }

    /// Returns the limits of the device and of this backend for a batch.
    fn capacity(&self) -> Capacity {
        let limits = &self.gpu().limits;
        Capacity {
            batch: self.batch_bytes,
            // Status words are read through the same buffer as the record.
            buffer: (limits.max_buffer_size - (1 << 20)).min(limits.max_storage_buffer_binding_size).min(MAX_OFFSET),
            workgroup: limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x) as usize,
            workgroup_bytes: limits.max_compute_workgroup_storage_size as usize,
            large_from: self.large_from,
        }
    }

    /// Returns the populations that a group plays, if they are on the device.
    fn population<'a>(&self, group: &Group<'a>) -> Result<Option<&'a Population>, BackendError> {
        let Weights::OnDevice(held) = group.weights else { return Ok(None) };
        let own = (held as &dyn Any).downcast_ref().filter(|population: &&Population| population.is_of(&self.executor));
        let population = own.ok_or(BackendError::HeldElsewhere)?;
        population.check([group.population_count(), group.policies, group.world.parameters()])?;
        Ok(Some(population))
    }

    /// Plays all tasks, and calls `done` for each with the record and the trace of its batch.
    fn play_tasks(&mut self, groups: &[Group<'_>], trace: bool, done: &Done<'_>) -> Result<(), BackendError> {
        let (start, before, capacity) = (Instant::now(), self.gpu().traffic(), self.capacity());
        let populations = groups.iter().map(|group| self.population(group)).collect::<Result<Vec<_>, _>>()?;
        let compiled = self.executor.pipelines();
        let is_compiled = |shape| compiled.contains_key(&Pipeline::Episode(shape));
        let specialised = specialised_shapes(groups, trace, self.kernel, capacity, &is_compiled);
        let batches = plan(groups, trace, self.records, capacity, &specialised)?;
        if self.tests_large && batches.iter().flat_map(|batch| &batch.parts).any(|part| part.shape.is_large()) {
            if let Some(mismatch) = check::large_teams(&self.executor)? {
                let (adapter, failures) = (self.gpu().adapter.to_string(), vec![(self.gpu().pass, mismatch)]);
                return Err(DeviceError::Inexact { adapter, failures }.into());
            }
            self.tests_large = false;
        }
        self.times.gather += start.elapsed();
        let mut previous = None;
        for (index, plan) in batches.iter().enumerate() {
            let submitted = self.submit(index % 2, groups, &populations, plan, trace)?;
            if let Some(submitted) = previous.replace(submitted) {
                self.collect(submitted, done)?;
            }
        }
        if let Some(submitted) = previous {
            self.collect(submitted, done)?;
        }
        self.times.traffic += self.gpu().traffic() - before;
        Ok(())
    }

    /// Submits one batch.
    fn submit<'a>(
        &mut self,
        workspace: usize,
        groups: &[Group<'_>],
        populations: &[Option<&Population>],
        plan: &'a BatchPlan,
        trace: bool,
    ) -> Result<Submitted<'a>, DeviceError> {
        let start = Instant::now();
        plan.stage(groups, &mut self.staging);
        let gathered = Instant::now();
        let held: Vec<Option<&Held>> = populations.iter().map(|held| Some(&(*held)?.held)).collect();
        let workspaces: Vec<_> = populations.iter().map(|held| Some(&(*held)?.workspace)).collect();
        let nonce = self.gpu().nonces(plan.rounds() as u32);
        let options = RecordingOptions {
            groups,
            held: &held,
            weights: &self.staging,
            trace,
            nonce,
            cap: self.cap,
            most_workgroups: self.gpu().limits.max_compute_workgroups_per_dimension,
        };
        let (recording, ranges) = plan.record(&options);
        let iterations = iterations(&recording.commands);
        if self.clock {
            self.executor.start_clock(&mut self.workspaces[workspace])?;
        }
        let submission = Instant::now();
        let submissions = self.executor.run(&recording, &mut self.workspaces[workspace], &workspaces)?;
        self.times.gather += gathered - start;
        self.times.upload += gathered.elapsed();
        let (start, readback) = (submission, recording.readback);
        Ok(Submitted { plan, workspace, submissions, start, iterations, readback, ranges })
    }

    /// Waits for one batch, and passes its record on.
    fn collect(&mut self, submitted: Submitted<'_>, done: &Done<'_>) -> Result<(), DeviceError> {
        let start = Instant::now();
        self.gpu().wait_for(&submitted.submissions)?;
        let waited = start.elapsed();
        let elapsed = self.measure(&submitted, waited);
        let clock = self.executor.clock(&self.workspaces[submitted.workspace])?;
        let score = self.score(&submitted, done)?;
        self.times.gpu += clock.unwrap_or_default();
        self.times.longest = self.times.longest.max(clock.unwrap_or(elapsed) / submitted.submissions.len() as u32);
        self.times.wait += waited;
        self.times.score += score;
        self.times.read_back += start.elapsed().saturating_sub(waited + score);
        Ok(())
    }

    /// Returns how long a batch took that is done, after the host has waited for it. Sets the cap of submissions by
    /// that.
    fn measure(&mut self, submitted: &Submitted<'_>, waited: Duration) -> Duration {
        let now = Instant::now();
        // The device plays one batch after the other.
        let before = self.done_at.replace(now);
        let elapsed = now - before.map_or(submitted.start, |before| submitted.start.max(before));
        let seems = self.gpu().faults().and_then(|faults| faults.takes(submitted.iterations));
        let elapsed = seems.unwrap_or(elapsed);
        let cap = (submitted.iterations as f64 / elapsed.as_secs_f64().max(1e-9) * SUBMISSION_TIME) as u64;
        if cap > self.cap || waited.min(elapsed) >= SHORT {
            self.cap = cap.max(MIN_CAP);
        }
        elapsed
    }

    /// Passes the results of a batch on. Returns how long that took.
    fn score(&self, submitted: &Submitted<'_>, done: &Done<'_>) -> Result<Duration, DeviceError> {
        let Submitted { plan, workspace, submissions, readback, ranges: BatchReadback { traced, words }, .. } =
            submitted;
        self.executor.read(submissions, &self.workspaces[*workspace], readback, |bytes| {
            let start = Instant::now();
            let words = bytemuck::cast_slice(&bytes[words.clone()]);
            let traced = bytemuck::cast_slice(&bytes[traced.clone()]);
            plan.tasks.par_iter().for_each(|planned| done(planned, words, traced));
            start.elapsed()
        })
    }
}

/// Calls `visit` with the record of each team of a task, and the team's index in its group.
fn each_episode(
    groups: &[Group<'_>],
    planned: &PlannedTask,
    words: &[u32],
    traced: &[f32],
    mut visit: impl FnMut(usize, &Episode<'_>),
) {
    let (group, world) = (&groups[planned.group], groups[planned.group].world);
    const POSITION: usize = std::mem::offset_of!(Moment, position) / size_of::<f32>();
    let Task { sets, counts, .. } = planned.task;
    let stride = planned.task.teams as usize;
    let sets = &words[sets as usize..][..world.set_words() * stride];
    let sight_words = if group.records().sights() { world.sight_words() } else { 0 };
    let (counts, sights) = words[counts as usize..].split_at(world.leaders() * world.followers() * stride);
    let sights = &sights[..sight_words * stride];
    let (traced, mut positions) = (&traced[planned.task.traced as usize..], Vec::new());
    for offset in 0..stride {
        let strided = |words| Strided { words, stride, offset };
        let (sets, seen, sights) = (strided(sets), strided(counts), strided(sights));
        let paths = world.paths.is_some().then(|| {
            positions.clear();
            let moment = world.agents() * MOMENT_WORDS;
            for moment in traced[offset * moment..].chunks(stride * moment).take(world.steps() + 1) {
                let agents = moment.chunks_exact(MOMENT_WORDS).take(world.agents());
                let places = agents.flat_map(|agent| [agent[POSITION], agent[POSITION + 1]]);
                positions.extend(places.map(f32::to_bits));
            }
            Paths { positions: Strided::contiguous(&positions), pois: group.pois() }
        });
        visit(planned.first_team + offset, &Episode { sets, seen, sights, paths });
    }
}

impl Backend for GpuBackend {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        groups.iter().try_for_each(Group::check)?;
        let scores = ScoreTable::new(groups);
        // What a group is scored from: 0 sums, 1 its whole record, 2 a trace, for its paths. Each has batches of its own,
        // because a batch is copied as the group in it that needs most.
        let source = |group: &Group<'_>| match group.world.paths {
            Some(_) => 2,
            None => usize::from(Counting::of(group).is_none()),
        };
        for played in 0..3 {
            let of_source = groups.iter().enumerate().filter(|(_, group)| source(group) == played);
            let (places, groups): (Vec<usize>, Vec<Group<'_>>) =
                of_source.map(|(place, &group)| (place, group)).unzip();
            self.play_tasks(&groups, played == 2, &|planned, words, traced| {
                let place = places[planned.group];
                match Counting::of(&groups[planned.group]) {
                    Some(counting) if planned.task.counted != NOWHERE => {
                        counting.score(words, &planned.task, (place, planned.first_team), &scores)
                    }
                    _ => each_episode(&groups, planned, words, traced, |team, episode| {
                        scores.score(place, team, episode)
                    }),
                }
            })?;
        }
        Ok(scores.finish())
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        group.check()?;
        let (world, groups) = (group.world, std::slice::from_ref(group));
        let trace = Mutex::new(Trace::of_zeros(group));
        self.play_tasks(groups, true, &|planned, words, traced| {
            let all = &mut *lock(&trace);
            each_episode(groups, planned, words, traced, |team, episode| all.store(team, episode));
            // The moments of all steps, then the inputs.
            let stride = planned.task.teams as usize;
            let mut from = &traced[planned.task.traced as usize..];
            let parts: [(&mut [f32], usize); 2] = [
                (bytemuck::cast_slice_mut(&mut all.moments), world.agents() * MOMENT_WORDS),
                (&mut all.inputs, world.leaders() * world.inputs()),
            ];
            for (all, size) in parts {
                let part;
                (part, from) = from.split_at((world.steps() + 1) * stride * size);
                for (step, words) in part.chunks_exact(stride * size).enumerate() {
                    all[(step * group.team_count() + planned.first_team) * size..][..words.len()]
                        .copy_from_slice(words);
                }
            }
        })?;
        Ok(trace.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    fn hold(&mut self, weights: &[f32], sizes: [usize; 3]) -> Result<Option<Box<dyn DevicePopulation>>, BackendError> {
        check_sizes(weights.len(), sizes)?;
        let [populations, slots, parameters] = sizes;
        let allowed = self.capacity().buffer;
        let bytes = (slots * parameters * size_of::<f32>()) as u64;
        let optional = match self.residency {
            ResidencyPolicy::Never => return Ok(None),
            ResidencyPolicy::From(minimum) if populations as u64 * bytes < minimum => return Ok(None),
            ResidencyPolicy::From(_) => true,
            ResidencyPolicy::Always => false,
        };
        let parents = (populations * slots * size_of::<u32>()) as u64;
        if bytes.max(parents) > allowed {
            let text = || {
                format!(
                    "one population takes {bytes} bytes and all parents {parents}, this adapter holds {allowed} in one buffer; \
                     breed on the host, or use a smaller population"
                )
            };
            return if optional { Ok(None) } else { Err(BackendError::TooLarge(text())) };
        }
        match Population::new(self.executor.clone(), weights, sizes) {
            Ok(population) => Ok(Some(Box::new(population))),
            Err(DeviceError::OutOfMemory { .. } | DeviceError::TooLarge { .. }) if optional => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    fn describe(&self) -> String {
        let held = match self.residency {
            ResidencyPolicy::Never => String::new(),
            ResidencyPolicy::From(bytes) => format!(", holds populations of {} KiB or more", bytes >> 10),
            ResidencyPolicy::Always => ", holds all populations".into(),
        };
        format!("gpu ({}, {} pass{held})", self.gpu().adapter, self.gpu().pass)
    }
}
