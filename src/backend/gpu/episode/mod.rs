//! Whole episodes on a GPU: teams are packed into workgroups, workgroups into batches that fit the device.
//!
//! One shader text makes two kernels: the generic one, which plays any world, and the specialised one, made for a
//! world's sizes, in which all loops have constant bounds and the policy is straight-line code. See [`Kernel`].
//!
//! While the GPU plays one batch, the CPU reads the record of the batch before it. Where only scores are wanted, the
//! GPU keeps the record and returns only what the scores depend on, see [`Records`].

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytemuck::Zeroable;

use super::device::{Binding, Bindings, DeviceError, Gpu, Kind, Traffic};
use super::population::Kernels;
use crate::backend::{
    BATCH_BYTES, Backend, BackendError, Episode, FOUR, Group, HELD_FROM, Held, Moment, PACKED_FROM, Seen, Strided,
    Trace, Visit,
};
use crate::host::Instant;

mod flight;
mod pipelines;
mod planner;
mod readback;
mod shape;
mod source;

pub use planner::{State, Task};
pub use shape::Kernel;
pub use source::{Workgroup, shader_of, shaders, workgroup_of};

use flight::{Buffers, KEPT};
use pipelines::{Compiled, IDLE_PLAYS, KEPT_KERNELS};
use planner::{NOWHERE, owner_words, plan};
use readback::{Done, Home};
use shape::Shape;

/// Which populations a device holds in its own memory between generations; no result depends on that.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Holding {
    /// None.
    Never,
    /// Those that take at least so many bytes a trial and fit.
    From(u64),
    /// All; what does not fit is an error.
    Always,
}

/// How records come home where only scores are wanted; no result depends on that.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Records {
    /// Whole.
    Whole,
    /// Those of batches that take at least so many bytes are packed on the device first: of each POI the sets that
    /// another one contains are left out, and of what followers saw only whom they saw most.
    PackedFrom(u64),
    /// All are packed, and room is made for as much as a whole record takes, so that little is ever brought whole.
    Packed,
}

impl Records {
    /// Whether a record of so many bytes is packed.
    fn packs(self, bytes: u64) -> bool {
        match self {
            Records::Whole => false,
            Records::PackedFrom(least) => bytes >= least,
            Records::Packed => true,
        }
    }
}

/// Plays episodes on a GPU.
pub struct GpuEpisodes {
    gpu: Gpu,
    layout: Bindings,
    kernel: Kernel,
    pipelines: HashMap<Shape, Compiled>,
    /// Calls of `play` so far.
    plays: u64,
    holding: Holding,
    records: Records,
    /// Compiled once something is to be packed.
    pack: Option<(wgpu::ComputePipeline, Bindings)>,
    /// The part of all sets for which room is made.
    kept: f64,
    /// Compiled once something is to be held.
    kernels: Option<Arc<Kernels>>,
    /// Two sets, so that one batch plays while the other is read.
    flights: [Buffers; 2],
    /// Weights on their way to the device.
    staging: Vec<[f32; FOUR]>,
    /// Bytes of one buffer that a batch aims for.
    batch_bytes: u64,
    kept_kernels: usize,
    idle_plays: u64,
    /// Changes the shader's text, so that tests can show that a change is noticed.
    edit: fn(String) -> String,
    stages: Stages,
}

/// Where the time of rollouts went. The CPU's stages follow each other; the GPU works beside all of them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Stages {
    /// Cutting the batch up and gathering its weights.
    pub gather: Duration,
    /// Handing everything to the driver.
    pub upload: Duration,
    /// Waiting for the GPU.
    pub wait: Duration,
    /// Mapping the record.
    pub read_back: Duration,
    /// Reading and scoring the record.
    pub score: Duration,
    /// Playing, by the GPU's own clock; 0 where that was not asked for or there is none.
    pub gpu: Duration,
    /// Bytes that went to the device, and came from it.
    pub traffic: Traffic,
}

impl GpuEpisodes {
    /// Readies an opened device for episodes.
    ///
    /// # Errors
    /// When the device does not take the episode's bindings.
    pub fn new(gpu: Gpu) -> Result<GpuEpisodes, DeviceError> {
        use Binding::{Read, Write};
        let software = gpu.adapter.kind == Kind::Software;
        let layout = gpu.layout("episode", &[Read, Read, Read, Read, Write, Write, Write])?;
        Ok(GpuEpisodes {
            gpu,
            layout,
            kernel: if software { Kernel::Generic } else { Kernel::Best },
            pipelines: HashMap::new(),
            plays: 0,
            holding: if software { Holding::Never } else { Holding::From(HELD_FROM) },
            records: if software { Records::Whole } else { Records::PackedFrom(PACKED_FROM) },
            pack: None,
            kept: KEPT,
            kernels: None,
            flights: Default::default(),
            staging: Vec::new(),
            batch_bytes: BATCH_BYTES,
            kept_kernels: KEPT_KERNELS,
            idle_plays: IDLE_PLAYS,
            edit: |text| text,
            stages: Stages::default(),
        })
    }

    /// The same with batches of other sizes; no result depends on them.
    pub fn batched(self, bytes: u64) -> GpuEpisodes {
        GpuEpisodes { batch_bytes: bytes, ..self }
    }

    /// The same with another choice of kernels than by default: [`Kernel::Best`], but [`Kernel::Generic`] on a software
    /// renderer, whose compiler takes a second for each of the others.
    pub fn playing(self, kernel: Kernel) -> GpuEpisodes {
        GpuEpisodes { kernel, ..self }
    }

    /// The same with other numbers of kernels, at least one, of a batch and from one batch to the next, and of plays after
    /// which one that none of them took is let go of; no result depends on them.
    pub fn keeping(self, kernels: usize, plays: u64) -> GpuEpisodes {
        GpuEpisodes { kept_kernels: kernels.max(1), idle_plays: plays, ..self }
    }

    /// How many generic and specialised kernels are compiled and kept.
    pub fn compiled(&self) -> [usize; 2] {
        let specialised = self.pipelines.keys().filter(|shape| shape.is_specialised()).count();
        [self.pipelines.len() - specialised, specialised]
    }

    /// The same with other populations held than by default.
    pub fn holding(self, holding: Holding) -> GpuEpisodes {
        GpuEpisodes { holding, ..self }
    }

    /// The same with records brought home in another way than by default.
    pub fn bringing(self, records: Records) -> GpuEpisodes {
        GpuEpisodes { records, ..self }
    }

    /// The same with changed shaders, for tests that show that a change is noticed.
    #[doc(hidden)]
    pub fn edited(self, edit: fn(String) -> String) -> GpuEpisodes {
        GpuEpisodes { edit, ..self }
    }

    /// Asks the GPU's clock too from now on, if it has one.
    ///
    /// # Errors
    /// When the device fails.
    pub fn use_clock(&mut self) -> Result<(), DeviceError> {
        for flight in &mut self.flights {
            flight.watch = self.gpu.stopwatch()?;
        }
        Ok(())
    }

    /// Where the time went since this was last asked.
    pub fn take_stages(&mut self) -> Stages {
        std::mem::take(&mut self.stages)
    }

    /// The device it plays on.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Plays all tasks; `done` gets each with the batch's record and moments.
    fn play(&mut self, groups: &[Group<'_>], trace: bool, done: &Done<'_>) -> Result<(), BackendError> {
        let (start, before) = (Instant::now(), self.gpu.traffic());
        self.plays += 1;
        let (plays, most) = (self.plays, self.idle_plays);
        self.pipelines.retain(|_, compiled| plays - compiled.played <= most);
        let batches = plan(groups, trace, self.records, self.room(), &self.specialised(groups, trace))?;
        self.stages.gather += start.elapsed();
        for index in 0..=batches.len() {
            if let Some(work) = batches.get(index) {
                self.submit(index % 2, groups, work, trace)?;
            }
            if let Some(previous) = index.checked_sub(1) {
                self.collect(previous % 2, &batches[previous], trace, done)?;
            }
        }
        self.stages.traffic += self.gpu.traffic() - before;
        Ok(())
    }
}

impl Backend for GpuEpisodes {
    fn rollout(&mut self, groups: &[Group<'_>], visit: &Visit<'_>) -> Result<(), BackendError> {
        groups.iter().try_for_each(Group::check)?;
        self.play(groups, false, &|share, home, _| {
            let Group { world, need, .. } = groups[share.group];
            let Task { sets, seen, table, owners, .. } = share.task;
            let stride = share.task.teams as usize;
            let (group, first) = (share.group, share.first_team);
            match home {
                Home::Whole(record) => {
                    let sets = &record[sets as usize..][..world.set_words() * stride];
                    let sight_words = if need.sights() { world.sight_words() } else { 0 };
                    let (seen, sights) = record[seen as usize..].split_at(world.leaders() * world.followers() * stride);
                    let sights = &sights[..sight_words * stride];
                    for offset in 0..stride {
                        let strided = |words| Strided { words, stride, offset };
                        let (sets, seen, sights) = (strided(sets), Seen::Counts(strided(seen)), strided(sights));
                        visit(Episode { group, team: first + offset, sets, seen, sights });
                    }
                }
                Home::Packed(words) => {
                    let table = &words[table as usize..][..=stride];
                    let owners = match owners {
                        NOWHERE => &[],
                        owners => &words[owners as usize..][..owner_words(world) * stride],
                    };
                    for (offset, ends) in table.windows(2).enumerate() {
                        let words = &words[ends[0] as usize..ends[1] as usize];
                        let sets = Strided { words, stride: 1, offset: 0 };
                        let seen = Seen::Most(Strided { words: owners, stride, offset });
                        visit(Episode { group, team: first + offset, sets, seen, sights: Strided::NONE });
                    }
                }
            }
        })
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        group.check()?;
        let world = group.world;
        let (teams, agents, steps) = (group.team_count(), world.agents(), world.steps());
        let (set_words, seen_words) = (world.set_words(), world.leaders() * world.followers());
        let sight_words = if group.need.sights() { world.sight_words() } else { 0 };
        let trace = std::sync::Mutex::new(Trace {
            teams,
            agents,
            moments: vec![Moment::zeroed(); (steps + 1) * teams * agents],
            sets: vec![0; teams * set_words],
            seen: vec![0; teams * seen_words],
            sights: vec![0; teams * sight_words],
        });
        self.play(std::slice::from_ref(group), true, &|share, home, moments| {
            let Home::Whole(record) = home else { unreachable!("no trace is packed") };
            let mut trace = trace.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            let task = share.task;
            let stride = task.teams as usize;
            for step in 0..=steps {
                let from = task.moments as usize + step * stride * agents;
                let to = (step * teams + share.first_team) * agents;
                trace.moments[to..to + stride * agents].copy_from_slice(&moments[from..from + stride * agents]);
            }
            for offset in 0..stride {
                let team = share.first_team + offset;
                for word in 0..set_words {
                    trace.sets[team * set_words + word] = record[task.sets as usize + word * stride + offset];
                }
                for word in 0..seen_words {
                    trace.seen[team * seen_words + word] = record[task.seen as usize + word * stride + offset];
                }
                for word in 0..sight_words {
                    let at = task.seen as usize + (seen_words + word) * stride + offset;
                    trace.sights[team * sight_words + word] = record[at];
                }
            }
        })?;
        Ok(trace.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
    }

    fn hold(&mut self, weights: &[f32], sizes: [usize; 3]) -> Result<Option<Box<dyn Held>>, BackendError> {
        let [leaders, slots, parameters] = sizes;
        let allowed = self.room().buffer;
        let bytes = (slots * parameters * size_of::<f32>()) as u64;
        let least = match self.holding {
            Holding::Never => return Ok(None),
            Holding::From(least) => least,
            Holding::Always => 0,
        };
        if leaders as u64 * bytes < least {
            return Ok(None);
        }
        if bytes > allowed {
            return match self.holding {
                Holding::Always => Err(BackendError::TooLarge(format!(
                    "the policies of one leader take {bytes} bytes, this adapter holds {allowed} in one buffer; \
                     breed on the host, or use a smaller population"
                ))),
                _ => Ok(None),
            };
        }
        let kernels = match &self.kernels {
            Some(kernels) => kernels,
            None => self.kernels.insert(Arc::new(Kernels::new(self.gpu.clone(), self.edit)?)),
        };
        match kernels.hold(weights, sizes) {
            Ok(population) => Ok(Some(Box::new(population))),
            Err(DeviceError::OutOfMemory { .. } | DeviceError::TooLarge { .. }) if self.holding != Holding::Always => {
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }

    fn describe(&self) -> String {
        let held = match self.holding {
            Holding::Never => String::new(),
            Holding::From(bytes) => format!(", holds populations of {} MiB or more", bytes >> 20),
            Holding::Always => ", holds all populations".into(),
        };
        format!("gpu ({}, {} pass{held})", self.gpu.adapter, self.gpu.pass)
    }
}
