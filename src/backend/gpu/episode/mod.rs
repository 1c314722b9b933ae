//! Whole episodes on a GPU: teams are packed into workgroups, workgroups into batches that fit the device.
//!
//! | file | holds |
//! |---|---|
//! | `shape` | kernels: what they are compiled for, and how teams fill their workgroups |
//! | `planner` | teams cut into tasks, and tasks into batches |
//! | `source` | the text of the shaders |
//! | `pipelines` | compiled kernels |
//! | `pace` | how long submissions take, so that none is too long |
//! | `flight` | buffers, and submitting a batch |
//! | `readback` | waiting for a batch, and reading its record |
//!
//! One shader text makes two kernels. The generic one plays any world. The specialised one is compiled for a world's
//! sizes: all loops have constant bounds and the policy is straight-line code. See [`Kernel`].
//!
//! While the GPU plays one batch, the CPU reads the record of the batch before it. If only scores are requested, the
//! GPU keeps the record and returns only what the scores depend on, see [`Records`].

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytemuck::Zeroable;

use super::device::{Binding, Bindings, DeviceError, Gpu, Kind, Traffic};
use super::faults::Faults;
use super::population::Kernels;
use crate::backend::scores::ScoreTable;
use crate::backend::{
    BATCH_BYTES, Backend, BackendError, DevicePopulation, FOUR, Group, GroupScores, HELD_FROM, Moment, PACKED_FROM,
    Trace, check_sizes,
};
use crate::credit::{Episode, Seen, Strided};
use crate::host::Instant;
use crate::parallel::lock;

mod flight;
mod pace;
mod pipelines;
mod planner;
mod readback;
mod shape;
mod source;

pub(crate) use planner::state_bytes;
pub use planner::{State, Task};
pub use shape::Kernel;
pub use source::{WorkgroupBuffers, shader_of, shaders, workgroup_of};

use flight::{Flight, KEPT_SHARE};
use pace::Pace;
use pipelines::KEPT_KERNELS;
use planner::{NOWHERE, owner_words, plan};
use readback::{Done, Readback};
use shape::Shape;

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
    /// Unpacked.
    Whole,
    /// Batches with records of at least so many bytes are packed on the device first. Packing drops the sets that
    /// another set of the same POI contains, and of the counts it keeps only the leader that each follower saw most.
    PackedFrom(u64),
    /// All are packed, with room for as much as a whole record, so that the whole is rarely copied.
    Packed,
}

impl Records {
    /// Reports whether a record of so many bytes is packed.
    fn packs(self, bytes: u64) -> bool {
        match self {
            Records::Whole => false,
            Records::PackedFrom(least) => bytes >= least,
            Records::Packed => true,
        }
    }
}

/// Plays episodes on a GPU.
pub struct GpuBackend {
    gpu: Gpu,
    layout: Bindings,
    kernel: Kernel,
    pipelines: HashMap<Shape, wgpu::ComputePipeline>,
    pace: Pace,
    /// When the last batch finished.
    done_at: Option<Instant>,
    /// Whether rollouts are timed by the device's clock.
    clock: bool,
    residency: ResidencyPolicy,
    records: Records,
    /// Compiled when first needed.
    pack: Option<(wgpu::ComputePipeline, Bindings)>,
    /// The share of all sets that packed records have room for.
    kept_share: f64,
    /// Compiled when populations are first held.
    kernels: Option<Arc<Kernels>>,
    /// Two sets of buffers, so that one batch plays while the other is read.
    flights: [Flight; 2],
    /// Weights to be copied to the device.
    staging: Vec<[f32; FOUR]>,
    /// Target bytes of one buffer of a batch.
    batch_bytes: u64,
    kept_kernels: usize,
    times: PhaseTimes,
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
    /// The longest submission: by the GPU's clock if that was requested, else as the host saw it.
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
        use Binding::{Read, Write};
        let software = gpu.adapter.kind == Kind::Software;
        let layout = gpu.layout("episode", &[Read, Read, Read, Read, Write, Write, Write])?;
        Ok(GpuBackend {
            gpu,
            layout,
            kernel: if software { Kernel::Generic } else { Kernel::Best },
            pipelines: HashMap::new(),
            pace: Pace::default(),
            done_at: None,
            clock: false,
            residency: if software { ResidencyPolicy::Never } else { ResidencyPolicy::From(HELD_FROM) },
            records: if software { Records::Whole } else { Records::PackedFrom(PACKED_FROM) },
            pack: None,
            kept_share: KEPT_SHARE,
            kernels: None,
            flights: Default::default(),
            staging: Vec::new(),
            batch_bytes: BATCH_BYTES,
            kept_kernels: KEPT_KERNELS,
            times: PhaseTimes::default(),
        })
    }

    /// Sets the target bytes of a batch's buffers. Results do not depend on it.
    pub fn with_batch_bytes(self, bytes: u64) -> GpuBackend {
        GpuBackend { batch_bytes: bytes, ..self }
    }

    /// Chooses kernels. The default is [`Kernel::Best`], and [`Kernel::Generic`] on software renderers, whose compilers
    /// take about a second for each specialised kernel.
    pub fn with_kernel(self, kernel: Kernel) -> GpuBackend {
        GpuBackend { kernel, ..self }
    }

    /// Sets the maximum number of kernels per batch and kept between batches, at least one. Results do not depend on it.
    pub fn with_kernel_cache(self, kernels: usize) -> GpuBackend {
        GpuBackend { kept_kernels: kernels.max(1), ..self }
    }

    /// Returns how many generic and how many specialised kernels are compiled.
    pub fn compiled(&self) -> [usize; 2] {
        let specialised = self.pipelines.keys().filter(|shape| shape.is_specialised()).count();
        [self.pipelines.len() - specialised, specialised]
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
    #[doc(hidden)]
    #[expect(unsafe_code, reason = "edited shaders are compiled without bounds checks")]
    pub unsafe fn edited(self, edit: fn(String) -> String) -> GpuBackend {
        struct Edit(fn(String) -> String);
        impl Faults for Edit {
            fn edits(&self, text: String) -> String {
                (self.0)(text)
            }
        }
        // SAFETY: see the function's own contract.
        GpuBackend { gpu: unsafe { self.gpu.failing(Arc::new(Edit(edit))) }, ..self }
    }

    /// Starts to time rollouts by the GPU's clock, if it has one.
    pub fn use_clock(&mut self) {
        self.clock = self.gpu.has_clock();
    }

    /// Returns and resets the times of rollouts.
    pub fn take_times(&mut self) -> PhaseTimes {
        std::mem::take(&mut self.times)
    }

    /// Returns the device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Plays all tasks, and calls `done` for each with the record and the moments of its batch.
    fn play_tasks(&mut self, groups: &[Group<'_>], trace: bool, done: &Done<'_>) -> Result<(), BackendError> {
        let (start, before) = (Instant::now(), self.gpu.traffic());
        let batches = plan(groups, trace, self.records, self.capacity(), &self.specialised(groups, trace))?;
        self.times.gather += start.elapsed();
        let mut previous = None;
        for (index, plan) in batches.iter().enumerate() {
            let submitted = self.submit(index % 2, groups, plan, trace)?;
            if let Some((plan, submitted)) = previous.replace((plan, submitted)) {
                self.collect(plan, submitted, done)?;
            }
        }
        if let Some((plan, submitted)) = previous {
            self.collect(plan, submitted, done)?;
        }
        self.times.traffic += self.gpu.traffic() - before;
        Ok(())
    }

    /// Plays all groups, and calls `visit` with each team's group, its index there, and its record, from several
    /// threads.
    pub(crate) fn visit(
        &mut self,
        groups: &[Group<'_>],
        visit: &(dyn Fn(usize, usize, &Episode<'_>) + Sync),
    ) -> Result<(), BackendError> {
        self.play_tasks(groups, false, &|planned, readback, _| {
            let world = groups[planned.group].world;
            let Task { sets, seen, table, owners, .. } = planned.task;
            let stride = planned.task.teams as usize;
            let (group, first) = (planned.group, planned.first_team);
            match readback {
                Readback::Whole(record) => {
                    let sets = &record[sets as usize..][..world.set_words() * stride];
                    let sight_words = if groups[group].records().sights() { world.sight_words() } else { 0 };
                    let (seen, sights) = record[seen as usize..].split_at(world.leaders() * world.followers() * stride);
                    let sights = &sights[..sight_words * stride];
                    for offset in 0..stride {
                        let strided = |words| Strided { words, stride, offset };
                        let (sets, seen, sights) = (strided(sets), Seen::Counts(strided(seen)), strided(sights));
                        visit(group, first + offset, &Episode { sets, seen, sights });
                    }
                }
                Readback::Packed(words) => {
                    let table = &words[table as usize..][..=stride];
                    let owners = match owners {
                        NOWHERE => &[],
                        owners => &words[owners as usize..][..owner_words(world) * stride],
                    };
                    for (offset, ends) in table.windows(2).enumerate() {
                        let words = &words[ends[0] as usize..ends[1] as usize];
                        let sets = Strided::contiguous(words);
                        let seen = Seen::Owners(Strided { words: owners, stride, offset });
                        visit(group, first + offset, &Episode { sets, seen, sights: Strided::NONE });
                    }
                }
            }
        })
    }
}

impl Backend for GpuBackend {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        groups.iter().try_for_each(Group::check)?;
        let scores = ScoreTable::new(groups);
        self.visit(groups, &|group, team, episode| scores.score(group, team, episode))?;
        Ok(scores.finish())
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        group.check()?;
        let world = group.world;
        let (teams, agents, steps) = (group.team_count(), world.agents(), world.steps());
        let (set_words, seen_words) = (world.set_words(), world.leaders() * world.followers());
        let sight_words = if group.records().sights() { world.sight_words() } else { 0 };
        let trace = Mutex::new(Trace {
            teams,
            agents,
            moments: vec![Moment::zeroed(); (steps + 1) * teams * agents],
            sets: vec![0; teams * set_words],
            seen: vec![0; teams * seen_words],
            sights: vec![0; teams * sight_words],
        });
        self.play_tasks(std::slice::from_ref(group), true, &|planned, readback, moments| {
            let Readback::Whole(record) = readback else { unreachable!("no trace is packed") };
            let Trace { moments: all_moments, sets, seen, sights, .. } = &mut *lock(&trace);
            let Task { teams: stride, moments: first_moment, sets: first_set, seen: first_seen, .. } = planned.task;
            let [stride, first_moment, first_set, first_seen] =
                [stride, first_moment, first_set, first_seen].map(|number| number as usize);
            for step in 0..=steps {
                let from = first_moment + step * stride * agents;
                let to = (step * teams + planned.first_team) * agents;
                all_moments[to..to + stride * agents].copy_from_slice(&moments[from..from + stride * agents]);
            }
            // Copies words that are interleaved by team.
            let scatter = |from: usize, words: usize, all: &mut [u32]| {
                for (word, numbers) in record[from..].chunks_exact(stride).take(words).enumerate() {
                    let to = all[planned.first_team * words + word..].iter_mut().step_by(words);
                    to.zip(numbers).for_each(|(to, &number)| *to = number);
                }
            };
            scatter(first_set, set_words, sets);
            scatter(first_seen, seen_words, seen);
            scatter(first_seen + seen_words * stride, sight_words, sights);
        })?;
        Ok(trace.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    fn hold(&mut self, weights: &[f32], sizes: [usize; 3]) -> Result<Option<Box<dyn DevicePopulation>>, BackendError> {
        check_sizes(weights.len(), sizes)?;
        let [populations, slots, parameters] = sizes;
        let allowed = self.capacity().buffer;
        let bytes = (slots * parameters * size_of::<f32>()) as u64;
        let least = match self.residency {
            ResidencyPolicy::Never => return Ok(None),
            ResidencyPolicy::From(least) => least,
            ResidencyPolicy::Always => 0,
        };
        if populations as u64 * bytes < least {
            return Ok(None);
        }
        if bytes > allowed {
            return match self.residency {
                ResidencyPolicy::Always => Err(BackendError::TooLarge(format!(
                    "one population takes {bytes} bytes, this adapter holds {allowed} in one buffer; \
                     breed on the host, or use a smaller population"
                ))),
                _ => Ok(None),
            };
        }
        let kernels = match &self.kernels {
            Some(kernels) => kernels,
            None => self.kernels.insert(Arc::new(Kernels::new(self.gpu.clone())?)),
        };
        match kernels.hold(weights, sizes) {
            Ok(population) => Ok(Some(Box::new(population))),
            Err(DeviceError::OutOfMemory { .. } | DeviceError::TooLarge { .. })
                if self.residency != ResidencyPolicy::Always =>
            {
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }

    fn describe(&self) -> String {
        let held = match self.residency {
            ResidencyPolicy::Never => String::new(),
            ResidencyPolicy::From(bytes) => format!(", holds populations of {} KiB or more", bytes >> 10),
            ResidencyPolicy::Always => ", holds all populations".into(),
        };
        format!("gpu ({}, {} pass{held})", self.gpu.adapter, self.gpu.pass)
    }
}
