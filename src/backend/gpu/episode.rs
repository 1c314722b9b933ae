//! Whole episodes on a GPU: teams are packed into workgroups, workgroups into batches that fit the device.
//!
//! One shader text makes two kernels: the generic one, which plays any world, and the specialised one, made for a
//! world's sizes, in which all loops have constant bounds and the policy is straight-line code. See [`Kernel`].
//!
//! While the GPU plays one batch, the CPU reads the record of the batch before it. Where only scores are wanted, the
//! GPU keeps the record and hands over what of it they hang on, see [`Records`].

use std::any::Any;
use std::cmp::Reverse;
use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::fmt::{self, Write};
use std::sync::Arc;
use std::time::Duration;

use bytemuck::Zeroable;
use glam::Vec2;

use super::device::{BINDING_ALIGNMENT, Binding, Bindings, DeviceError, Gpu, Kind, Stopwatch, Traffic, grid, timed};
use super::exact;
use super::population::{Kernels, Population, Stretch, TOGETHER, parts};
use crate::backend::{
    BATCH_BYTES, Backend, BackendError, Episode, FOUR, Group, HELD_FROM, Held, Moment, PACKED_FROM, Seen, Strided,
    Trace, Visit, Weights, fours, owner_bits, record_words,
};
use crate::config::{MAX_AGENTS, MAX_HIDDEN_LAYERS};
use crate::declare::{Shared, shared};
use crate::host::Instant;
use crate::model::policy::{Actions, PolicyConstants};
use crate::model::{self, Constants, Variant};
use crate::parallel::*;
use crate::world::{INPUTS, OUTPUTS, World};

/// Threads that share a warp on most GPUs; leaders and followers are kept apart by as many (`ROLE` in the shader).
const ROLE: usize = 32;
/// Workgroup sizes of the generic kernel to choose from; every WebGPU device takes them.
const WORKGROUPS: [usize; 3] = [64, 128, 256];
/// Teams of a workgroup of a specialised kernel: most fill a warp with one agent of as many teams.
const TEAMS: [usize; 3] = [32, 16, 8];
/// Threads of such a workgroup at most, so that two or more fit into a compute unit and hide each other's waiting.
const MOST_THREADS: usize = 512;
/// Weights of one policy at most that are written out as straight-line code.
const MOST_WEIGHTS: usize = 512;
/// Leaders at most whose sights a follower counts in registers.
const SIGHTS: usize = 8;
/// Specialised kernels at most, where nobody asks for more: each takes a fraction of a second to compile.
const SPECIALISED: usize = 16;
/// Kernels at most that one batch takes and that stay compiled from one to the next: a driver keeps megabytes of each.
const KEPT_KERNELS: usize = 64;
/// Plays, of a generation as a rule, after which a kernel that none of them took is let go of: a process that trains one
/// layout after another has kernels of its own for each, and one that plays ever new worlds seldom compiles.
const IDLE_PLAYS: u64 = 1000;
/// Tasks, as many as end where a binding may start (their size is no power of two).
const TASK_ALIGNMENT: usize = BINDING_ALIGNMENT / 4;
/// Offsets within a buffer are u32 words.
const MAX_OFFSET: u64 = 1 << 33;
/// Turns of loops that one thread takes in a dispatch, over all loops. Mesa's llvmpipe 22.3 leaves every loop for good
/// after 65 535, and drivers stop a dispatch that runs for seconds: longer episodes take several dispatches.
const TURNS: usize = 60_000;

shared! {
    /// One workgroup's share of the work: some teams of one group.
    #[derive(Default)]
    pub struct Task {
        /// Which of the batch's worlds they play in.
        pub world: u32,
        /// Where the agents' start positions begin in their buffer; all such places are in elements.
        pub starts: u32,
        /// Where the POIs begin.
        pub pois: u32,
        /// Where the weights begin.
        pub weights: u32,
        /// Where the agents near each POI are recorded.
        pub sets: u32,
        /// Where it is recorded whom followers saw.
        pub seen: u32,
        /// Where a trace's moments go.
        pub moments: u32,
        /// Where agents stand between two dispatches.
        pub states: u32,
        /// How many teams it has.
        pub teams: u32,
        /// The first step that a dispatch plays.
        pub first: u32,
        /// The one before which it ends.
        pub end: u32,
        /// Where packing finds how many agents each POI needs, see `shaders/pack.wgsl`.
        pub least: u32,
        /// Where packing leaves the table of where each team's kept sets are.
        pub table: u32,
        /// Where packing leaves the leaders that followers saw most, or all ones for nowhere.
        pub owners: u32,
    }

    /// An agent between two dispatches.
    pub struct State {
        /// Where it is, in units.
        pub x: f32,
        /// Likewise.
        pub y: f32,
        /// Where it heads, a unit vector.
        pub hx: f32,
        /// Likewise.
        pub hy: f32,
        /// How fast it is, in units a second.
        pub speed: f32,
    }
}

/// Which kernel plays; no result depends on that.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kernel {
    /// In rollouts a specialised one, for as many kinds of worlds as are worth compiling for, those with most to play
    /// first; else the generic one.
    Best,
    /// The generic one.
    Generic,
    /// One made for its world's sizes, wherever there can be one.
    Specialised,
}

impl fmt::Display for Kernel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Kernel::Best => "best",
            Kernel::Generic => "generic",
            Kernel::Specialised => "specialised",
        })
    }
}

/// What a pipeline is compiled for: pipelines are kept by this.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
struct Shape {
    workgroup: usize,
    /// Agents a thread plays, one after another.
    slots: usize,
    records: Kept,
    sizes: Sizes,
}

/// What a kernel keeps beside sets and counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
struct Kept {
    /// Every stage of every step.
    trace: bool,
    /// Which leaders each follower sees at each step.
    sights: bool,
}

impl Kept {
    fn of(group: &Group<'_>, trace: bool) -> Kept {
        Kept { trace, sights: group.need.sights() && group.world.followers() > 0 }
    }
}

/// What a kernel knows of the worlds that it plays.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Sizes {
    /// The widest layer, inputs included, rounded up to spare compilations, and whether the outputs choose a behaviour.
    Any { widest: usize, chooses: bool },
    /// All that makes a difference to the code.
    Fixed { teams: usize, leaders: u32, agents: u32, pois: u32, widths: [u32; WIDTHS], variant: Variant },
}

const WIDTHS: usize = MAX_HIDDEN_LAYERS + 2;

impl Shape {
    fn is_specialised(&self) -> bool {
        matches!(self.sizes, Sizes::Fixed { .. })
    }

    fn generic(world: &World, packing: Packing, records: Kept) -> Shape {
        let policy = &world.constants.policy;
        let chooses = policy.actions() == Some(Actions::Behaviours);
        let sizes = Sizes::Any { widest: policy.widest().next_power_of_two(), chooses };
        Shape { workgroup: packing.workgroup, slots: packing.slots, records, sizes }
    }

    /// The specialised one, if it is asked for and there can be one.
    fn asked_for(world: &World, kernel: Kernel, room: Capacity, records: Kept) -> Option<Shape> {
        let packing = Packing::specialised(world, room).filter(|_| kernel != Kernel::Generic);
        packing.map(|packing| Shape::specialised(world, packing, records))
    }

    fn specialised(world: &World, packing: Packing, records: Kept) -> Shape {
        let Constants { leaders, followers, pois, variant, policy: PolicyConstants { widths, .. }, .. } =
            world.constants;
        let sizes = Sizes::Fixed { teams: packing.teams, leaders, agents: leaders + followers, pois, widths, variant };
        Shape { workgroup: packing.workgroup, slots: packing.slots, records, sizes }
    }
}

/// How the teams of one world are packed.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Packing {
    workgroup: usize,
    slots: usize,
    /// Teams of a workgroup.
    teams: usize,
}

/// Threads that `teams` teams take.
fn seats(world: &World, teams: usize) -> usize {
    (teams * world.leaders()).next_multiple_of(ROLE) + teams * world.followers()
}

impl Packing {
    /// For a specialised kernel: as many teams as a warp has threads, or as many as fit. None where there had
    /// better be none: too many agents, or too large a policy.
    fn specialised(world: &World, room: Capacity) -> Option<Packing> {
        let threads = |teams: usize| seats(world, teams).next_multiple_of(ROLE);
        let bytes = |teams: usize| 2 * teams * world.agents() * size_of::<Vec2>();
        let fits =
            |&teams: &usize| threads(teams) <= room.workgroup.min(MOST_THREADS) && bytes(teams) <= room.workgroup_bytes;
        let teams = TEAMS.into_iter().find(fits).filter(|_| world.parameters() <= MOST_WEIGHTS)?;
        Some(Packing { workgroup: threads(teams), slots: 1, teams })
    }

    /// For the generic kernel: the packing that leaves the fewest threads idle.
    fn generic(world: &World, largest: usize) -> Packing {
        let sizes = WORKGROUPS.into_iter().filter(|&size| size <= largest);
        let packed = sizes.clone().filter_map(|workgroup| {
            let teams = (1..=workgroup).take_while(|&teams| seats(world, teams) <= workgroup).last()?;
            Some(Packing { workgroup, slots: 1, teams })
        });
        // The share of threads that play, compared crosswise to stay in integers; the smaller workgroup wins ties.
        packed.reduce(|a, b| if b.teams * a.workgroup > a.teams * b.workgroup { b } else { a }).unwrap_or_else(|| {
            let workgroup = sizes.max().unwrap_or(WORKGROUPS[0]);
            Packing { workgroup, slots: seats(world, 1).div_ceil(workgroup), teams: 1 }
        })
    }
}

/// Steps that one dispatch may play, see [`TURNS`].
fn steps_a_dispatch(world: &World, packing: Packing, records: Kept) -> usize {
    let Constants { words, policy: PolicyConstants { widths, .. }, .. } = world.constants;
    let network: u32 = widths.windows(2).map(|w| (w[0] + 2) * w[1]).sum();
    // A leader goes through the agents, and through those in reach.
    let agent = world.pois.len() + 2 * world.agents() + words as usize + network as usize + 20;
    let sights = if records.sights { world.followers() * world.leader_words() } else { 0 };
    let items = |rows: usize| (rows * packing.teams).div_ceil(packing.workgroup);
    let items = items(world.pois.len() * words as usize) + items(sights);
    (TURNS / (packing.slots * agent + items * 33)).max(1)
}

/// A task and where its teams come from.
struct Share {
    group: usize,
    first_team: usize,
    shape: Shape,
    /// All steps of the episode.
    task: Task,
    steps_a_dispatch: usize,
}

/// What came home of a batch's record.
#[derive(Clone, Copy)]
enum Home<'a> {
    /// All of it.
    Whole(&'a [u32]),
    /// What scores hang on, as `shaders/pack.wgsl` has it.
    Packed(&'a [u32]),
}

/// Gets a task with the record and the moments of its batch.
type Done<'a> = dyn Fn(&Share, Home<'_>, &[Moment]) + Sync + 'a;

impl Share {
    /// How many weights its teams have, in fours.
    fn fours(&self, groups: &[Group<'_>]) -> usize {
        self.task.teams as usize * fours(groups[self.group].world)
    }

    /// The task's part in one round of dispatches; none when it is done.
    fn round(&self, round: usize) -> Option<Task> {
        let first = (round * self.steps_a_dispatch) as u32;
        let end = self.task.end.min(first + self.steps_a_dispatch as u32);
        (first < end).then_some(Task { first, end, ..self.task })
    }
}

/// Tasks that fit the device's buffers together.
#[derive(Default)]
struct Work {
    shares: Vec<Share>,
    /// What its kernels are made for.
    shapes: BTreeSet<Shape>,
    worlds: Vec<Constants>,
    places: Vec<Vec2>,
    /// In fours.
    weights: usize,
    record: usize,
    moments: usize,
    states: usize,
    /// Words of all sets in the record.
    sets: usize,
    /// If the record is packed: the words of tables and owners, and how many agents a set must have, `[pois]` a group.
    head: Option<usize>,
    least: Vec<u32>,
}

impl Work {
    /// Finds a place for what is packed of the record; none where the whole record is wanted, where it matters when
    /// sets stood, where packing takes too long for one dispatch, or where there is nothing to gain.
    fn pack(&mut self, groups: &[Group<'_>], records: Records) {
        let packs = |share: &Share| {
            let Group { world, need, .. } = groups[share.group];
            need.least(1).is_some() && !world.rule.is_timed() && pack_turns(groups, share) <= TURNS
        };
        if !records.packs((self.record * size_of::<u32>()) as u64) || !self.shares.iter().all(packs) {
            return;
        }
        let mut head = 0;
        for shares in self.shares.chunk_by_mut(|a, b| a.group == b.group) {
            let Group { world, need, .. } = groups[shares[0].group];
            let least = self.least.len() as u32;
            self.least.extend(world.coupling.iter().filter_map(|&coupling| need.least(coupling)));
            for Share { task, .. } in shares {
                let teams = task.teams as usize;
                (task.least, task.table, task.owners) = (least, head as u32, NOWHERE);
                head += teams + 1;
                if need.owners() && world.followers() > 0 {
                    task.owners = head as u32;
                    head += owner_words(world) * teams;
                }
            }
        }
        self.head = Some(head).filter(|head| head + PACKED_HEAD < self.record);
    }
}

/// Words of a team that say which leader each follower saw most.
fn owner_words(world: &World) -> usize {
    world.followers().div_ceil((32 / owner_bits(world.constants.leaders)) as usize)
}

/// Turns of loops that a thread takes at most to pack a task.
fn pack_turns(groups: &[Group<'_>], share: &Share) -> usize {
    let (world, teams) = (groups[share.group].world, share.task.teams as usize);
    let sets = (world.pois.len() * teams).div_ceil(PACK_WORKGROUP);
    let owners = (owner_words(world) * teams).div_ceil(PACK_WORKGROUP) * 4 * (world.leaders() + 2);
    // Each set is read twice; as many at most are written or left empty.
    sets * 4 * world.steps() * (world.constants.words as usize + 1) + owners + 3 * teams
}

/// Sizes of a device that bound a batch.
#[derive(Clone, Copy, Debug)]
struct Capacity {
    /// Bytes of one buffer that a batch aims for.
    batch: u64,
    /// Bytes of the largest buffer.
    buffer: u64,
    /// Kernels of a batch.
    kernels: usize,
    /// Threads of the largest workgroup, and bytes of its memory.
    workgroup: usize,
    workgroup_bytes: usize,
}

impl Capacity {
    /// Of a device whose largest workgroup is told, and that no batch fills.
    fn of_workgroups(threads: usize) -> Capacity {
        let bytes = MAX_OFFSET;
        Capacity { batch: bytes, buffer: bytes, kernels: 1, workgroup: threads, workgroup_bytes: 16 << 10 }
    }
}

/// The shapes to play by kernels of their own: those compiled already, and of the others those with most to play, up to
/// [`SPECIALISED`] in all.
fn worth_compiling(work: BTreeMap<Shape, u64>, compiled: &HashSet<Shape>) -> HashSet<Shape> {
    let room = SPECIALISED.saturating_sub(compiled.iter().filter(|shape| shape.is_specialised()).count());
    let (mut shapes, mut new): (Vec<_>, Vec<_>) = work.into_iter().partition(|(shape, _)| compiled.contains(shape));
    new.sort_by_key(|(_, agent_steps)| Reverse(*agent_steps));
    shapes.extend(new.into_iter().take(room));
    shapes.into_iter().map(|(shape, _)| shape).collect()
}

/// Cuts the groups' teams into tasks and the tasks into batches; worlds of the given shapes have kernels of their own.
///
/// # Errors
/// When one team's record is larger than the device's largest buffer.
fn plan(
    groups: &[Group<'_>],
    trace: bool,
    records: Records,
    room: Capacity,
    specialised: &HashSet<Shape>,
) -> Result<Vec<Work>, BackendError> {
    let target = room.buffer.min(room.batch);
    let mut batches = vec![Work::default()];
    for (index, group) in groups.iter().enumerate() {
        let world = group.world;
        let kept = Kept::of(group, trace);
        let moments_a_team = if trace { (world.steps() + 1) * world.agents() } else { 0 };
        let bytes_a_team = [
            record_words(world, group.need) * size_of::<u32>(),
            fours(world) * size_of::<[f32; FOUR]>(),
            moments_a_team * size_of::<Moment>(),
        ]
        .into_iter()
        .max()
        .unwrap_or(0) as u64;
        if bytes_a_team > room.buffer {
            return Err(BackendError::TooLarge(format!(
                "one team takes {bytes_a_team} bytes in one buffer, this adapter allows {}; \
                 use the CPU, fewer steps or fewer POIs",
                room.buffer
            )));
        }
        let for_it =
            Packing::specialised(world, room).map(|packing| (packing, Shape::specialised(world, packing, kept)));
        let (packing, shape) = for_it.filter(|(_, shape)| specialised.contains(shape)).unwrap_or_else(|| {
            let packing = Packing::generic(world, room.workgroup);
            (packing, Shape::generic(world, packing, kept))
        });
        let teams_a_task = packing.teams.min((target / bytes_a_team.max(1)).max(1) as usize);
        let steps_a_dispatch = steps_a_dispatch(world, packing, kept);
        // A group's world, starts and POIs are stored once a batch.
        let mut stored: Option<(usize, Task)> = None;
        for first_team in (0..group.team_count()).step_by(teams_a_task) {
            let teams = teams_a_task.min(group.team_count() - first_team);
            let mut work = batches.last_mut().expect("there is a batch");
            let full = |used: usize, size: usize| used as u64 * size as u64 + teams as u64 * bytes_a_team > target;
            if full(work.record, size_of::<u32>())
                || full(work.weights, size_of::<[f32; FOUR]>())
                || full(work.moments, size_of::<Moment>())
                || work.shapes.len() >= room.kernels && !work.shapes.contains(&shape)
            {
                batches.push(Work::default());
                work = batches.last_mut().expect("just pushed");
                stored = None;
            }
            let (world_index, base) = *stored.get_or_insert_with(|| {
                let starts = work.places.len() as u32;
                let pois = starts + world.agents() as u32;
                work.places.extend(group.starts);
                if group.moved_pois().is_none() {
                    work.places.extend(&world.pois);
                }
                work.worlds.push(world.constants);
                (work.worlds.len() - 1, Task { starts, pois, ..Task::default() })
            });
            let task = Task {
                world: world_index as u32,
                weights: work.weights as u32,
                sets: work.record as u32,
                seen: (work.record + world.set_words() * teams) as u32,
                moments: work.moments as u32,
                states: work.states as u32,
                teams: teams as u32,
                end: world.constants.steps,
                ..base
            };
            work.weights += fours(world) * teams;
            work.record += record_words(world, group.need) * teams;
            work.sets += world.set_words() * teams;
            work.moments += moments_a_team * teams;
            if world.steps() > steps_a_dispatch {
                work.states += world.agents() * teams;
            }
            work.shapes.insert(shape);
            work.shares.push(Share { group: index, first_team, shape, task, steps_a_dispatch });
        }
    }
    batches.retain(|work| !work.shares.is_empty());
    if !trace {
        batches.iter_mut().for_each(|work| work.pack(groups, records));
    }
    Ok(batches)
}

/// A task's weights, `[fours of a policy's weights][leaders][teams]`: neighbouring threads read neighbouring weights.
fn gather(group: &Group<'_>, weights: &[f32], first_team: usize, teams: usize, to: &mut [[f32; FOUR]]) {
    let (leaders, parameters) = (group.world.leaders(), group.world.parameters());
    let policies = &group.teams[first_team * leaders..(first_team + teams) * leaders];
    for (place, &policy) in policies.iter().enumerate() {
        let (team, leader) = (place / leaders, place % leaders);
        let from = group.place(weights, leader, policy as usize);
        let column = to[leader * teams + team..].iter_mut().step_by(leaders * teams);
        for (four, weights) in column.zip(weights[from..from + parameters].chunks(FOUR)) {
            four[..weights.len()].copy_from_slice(weights);
        }
    }
}

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

/// Threads of a workgroup that packs a task.
const PACK_WORKGROUP: usize = 64;
/// Words before the others in what is packed (`struct Packed` in the shader): how many are taken, and of how many.
const PACKED_HEAD: usize = 2;
/// An offset that there is not.
const NOWHERE: u32 = u32::MAX;
/// The part of all sets for which room is made at first, and words for chance beside it.
const KEPT: f64 = 1.0 / 16.0;
const KEPT_AT_LEAST: usize = 256;

/// A kernel, and the last play that took it.
struct Compiled {
    pipeline: wgpu::ComputePipeline,
    played: u64,
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

/// What is to be gathered from populations on the device, and the choices of those teams, `[teams][leaders]` each.
type Gathering<'a> = (Vec<(Stretch, &'a Population)>, Vec<u32>);

/// The device's side of one batch; buffers only grow.
#[derive(Default)]
struct Buffers {
    worlds: Option<wgpu::Buffer>,
    tasks: Option<wgpu::Buffer>,
    places: Option<wgpu::Buffer>,
    stretches: Option<wgpu::Buffer>,
    choices: Option<wgpu::Buffer>,
    weights: Option<wgpu::Buffer>,
    record: Option<wgpu::Buffer>,
    moments: Option<wgpu::Buffer>,
    states: Option<wgpu::Buffer>,
    record_back: Option<wgpu::Buffer>,
    moments_back: Option<wgpu::Buffer>,
    least: Option<wgpu::Buffer>,
    packed: Option<wgpu::Buffer>,
    packed_back: Option<wgpu::Buffer>,
    /// What comes home of the packed record, if it is packed, and whether the whole one comes in any case.
    sent: Option<Parcel>,
    whole: bool,
    watch: Option<Stopwatch>,
    /// What to wait for.
    submitted: Option<wgpu::SubmissionIndex>,
}

/// A packed record on its way home.
#[derive(Clone, Copy)]
struct Parcel {
    /// Words that there is room for, tables and owners among them.
    room: usize,
    /// Bytes that are copied: all, or only how many words were taken.
    bytes: u64,
}

impl Buffers {
    /// Copies the whole record of a batch that was played, and waits for it.
    fn bring_record(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), DeviceError> {
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let back = grown(gpu, &mut self.record_back, "record, read back", bytes, usage)?;
        let Some(record) = &self.record else { return Ok(()) };
        let submitted = gpu.scoped("record, read back", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(record, 0, back, 0, bytes);
            gpu.queue.submit([encoder.finish()])
        })?;
        gpu.wait_for(Some(submitted))
    }
}

/// A buffer of at least so many bytes, made anew where the present one is too small.
fn grown<'a>(
    gpu: &Gpu,
    buffer: &'a mut Option<wgpu::Buffer>,
    what: &str,
    bytes: u64,
    usage: wgpu::BufferUsages,
) -> Result<&'a wgpu::Buffer, DeviceError> {
    let bytes = bytes.max(BINDING_ALIGNMENT as u64);
    if buffer.as_ref().is_none_or(|buffer| buffer.size() < bytes) {
        // Free the old one first: the two together may not fit.
        if let Some(old) = buffer.take() {
            old.destroy();
        }
        *buffer = Some(gpu.buffer(what, bytes, usage)?);
    }
    Ok(buffer.as_ref().expect("just made"))
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

    fn room(&self) -> Capacity {
        let limits = &self.gpu.limits;
        Capacity {
            batch: self.batch_bytes,
            kernels: self.kept_kernels,
            buffer: limits.max_buffer_size.min(limits.max_storage_buffer_binding_size).min(MAX_OFFSET),
            workgroup: limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x) as usize,
            workgroup_bytes: limits.max_compute_workgroup_storage_size as usize,
        }
    }

    /// The shapes that get kernels of their own.
    fn specialised(&self, groups: &[Group<'_>], trace: bool) -> HashSet<Shape> {
        let mut work: BTreeMap<Shape, u64> = BTreeMap::new();
        for group in groups {
            if let Some(packing) = Packing::specialised(group.world, self.room()) {
                let agent_steps = group.team_count() * group.world.agents() * group.world.steps();
                let shape = Shape::specialised(group.world, packing, Kept::of(group, trace));
                *work.entry(shape).or_default() += agent_steps as u64;
            }
        }
        match self.kernel {
            Kernel::Generic => HashSet::new(),
            Kernel::Specialised => work.into_keys().collect(),
            // Nobody traces for speed.
            Kernel::Best if trace => HashSet::new(),
            Kernel::Best => worth_compiling(work, &self.pipelines.keys().copied().collect()),
        }
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

    /// Hands one batch to the device.
    fn submit(&mut self, flight: usize, groups: &[Group<'_>], work: &Work, trace: bool) -> Result<(), BackendError> {
        use wgpu::BufferUsages as Usage;
        let start = Instant::now();
        let (stretches, choices) = self.stretches(groups, work)?;
        self.fill_staging(groups, work);
        let gathered = Instant::now();
        self.stages.gather += gathered - start;
        // Round by round, each shape's tasks stand together, from where a binding may start.
        let mut tasks: Vec<Task> = Vec::new();
        let mut dispatches: Vec<(Shape, usize, [u32; 3])> = Vec::new();
        // Those that play every task once.
        let mut first_round = 0;
        let shapes = &work.shapes;
        let new = shapes.iter().filter(|shape| !self.pipelines.contains_key(shape)).count();
        if self.pipelines.len() + new > self.kept_kernels {
            self.pipelines.retain(|shape, _| shapes.contains(shape));
        }
        let rounds = work.shares.iter().map(|share| (share.task.end as usize).div_ceil(share.steps_a_dispatch)).max();
        for (round, &shape) in (0..rounds.unwrap_or(0)).flat_map(|round| shapes.iter().map(move |shape| (round, shape)))
        {
            tasks.resize(tasks.len().next_multiple_of(TASK_ALIGNMENT), Task::default());
            let first = tasks.len();
            tasks
                .extend(work.shares.iter().filter(|share| share.shape == shape).filter_map(|share| share.round(round)));
            if tasks.len() > first {
                let grid = grid(tasks.len() - first, &self.gpu.limits);
                // The grid's last row may be longer than the tasks: those workgroups play no team.
                tasks.resize(first + (grid[0] * grid[1]) as usize, Task::default());
                dispatches.push((shape, first, grid));
                self.prepare_pipeline(shape)?;
                first_round += usize::from(round == 0);
            }
        }
        if work.head.is_some() {
            self.prepare_packing()?;
        }
        let sent = work.head.map(|head| {
            let most = work.record - PACKED_HEAD - 1;
            let room = match self.records {
                Records::Packed => most,
                _ => head + (work.sets as f64 * self.kept) as usize + KEPT_AT_LEAST,
            };
            // Where nearly all sets are kept, they are packed only to see when that changes.
            match room <= most {
                true => Parcel { room, bytes: ((PACKED_HEAD + room) * size_of::<u32>()) as u64 },
                false => Parcel { room: head, bytes: (PACKED_HEAD * size_of::<u32>()) as u64 },
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
        let mut gathers = Vec::with_capacity(stretches.len());
        if let Some(kernels) = self.kernels.as_ref().filter(|_| !stretches.is_empty()) {
            let structs: Vec<Stretch> = stretches.iter().map(|(stretch, _)| *stretch).collect();
            let structs = upload(&mut buffers.stretches, "stretches", &parts(&structs))?;
            let choices = upload(&mut buffers.choices, "choices", bytemuck::cast_slice(&choices))?;
            for (part, (stretch, population)) in stretches.iter().enumerate() {
                gathers.push(kernels.gather((&structs, part), stretch, &choices, population, &weights)?);
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

        let (mut bound, mut packs) = (Vec::with_capacity(dispatches.len()), Vec::new());
        for (index, (shape, first, grid)) in dispatches.into_iter().enumerate() {
            let tasks = wgpu::BufferBinding {
                buffer: &all_tasks,
                offset: (first * size_of::<Task>()) as u64,
                size: wgpu::BufferSize::new(u64::from(grid[0] * grid[1]) * size_of::<Task>() as u64),
            };
            let [worlds, places, weights, record, moments, states] =
                [&worlds, &places, &weights, record, moments, states].map(|buffer| buffer.as_entire_buffer_binding());
            if let Some(((pipeline, layout), least, packed, ..)) = packing.as_ref().filter(|_| index < first_round) {
                let [least, packed] = [least, *packed].map(|buffer| buffer.as_entire_buffer_binding());
                let group =
                    gpu.bind("pack", layout, &[worlds.clone(), tasks.clone(), least, packed, record.clone()])?;
                packs.push((pipeline, group, grid));
            }
            let group =
                gpu.bind("episode", &self.layout, &[worlds, tasks, places, weights, record, moments, states])?;
            bound.push((&self.pipelines[&shape].pipeline, group, grid));
        }
        let watch = buffers.watch.as_ref();
        let submitted = gpu.scoped("episodes", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&timed(watch));
            for (pipeline, group, [x, y, z]) in gathers.iter().chain(&bound).chain(&packs) {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(*x, *y, *z);
            }
            drop(pass);
            watch.inspect(|watch| watch.stop(&mut encoder));
            if let Some(record_back) = record_back {
                encoder.copy_buffer_to_buffer(record, 0, record_back, 0, record_bytes);
            }
            if let Some((.., packed, back, bytes)) = packing {
                encoder.copy_buffer_to_buffer(packed, 0, back, 0, bytes);
            }
            if let Some(moments_back) = moments_back {
                encoder.copy_buffer_to_buffer(moments, 0, moments_back, 0, moment_bytes);
            }
            gpu.queue.submit([encoder.finish()])
        })?;
        buffers.submitted = Some(submitted);
        (buffers.sent, buffers.whole) = (sent, whole);
        self.stages.upload += gathered.elapsed();
        Ok(())
    }

    /// Waits for one batch and hands its record on.
    fn collect(&mut self, flight: usize, work: &Work, trace: bool, done: &Done<'_>) -> Result<(), DeviceError> {
        let start = Instant::now();
        self.gpu.wait_for(self.flights[flight].submitted.clone())?;
        let done_waiting = Instant::now();
        let mut score = Duration::ZERO;
        let mut share_out = |record: Home<'_>, moments: &[Moment]| {
            let start = Instant::now();
            work.shares.par_iter().for_each(|share| done(share, record, moments));
            score += start.elapsed();
        };
        let record_bytes = (work.record * size_of::<u32>()) as u64;
        let moment_bytes = (work.moments * size_of::<Moment>()) as u64;
        let buffers = &mut self.flights[flight];
        let mut fits = false;
        if let (Some(head), Some(Parcel { room, bytes }), Some(back)) = (work.head, buffers.sent, &buffers.packed_back)
        {
            let used = self.gpu.mapped(back, 0..bytes, |bytes| {
                let words: &[u32] = bytemuck::cast_slice(bytes);
                let used = words[0] as usize;
                fits = used <= room && words.len() > PACKED_HEAD;
                if fits {
                    share_out(Home::Packed(&words[PACKED_HEAD..]), &[]);
                }
                used
            })?;
            // Half as much again, since the next generation may keep more; and a batch that did stays in mind for a
            // while.
            let kept = 1.5 * used.saturating_sub(head) as f64 / work.sets as f64;
            self.kept = kept.max(0.9 * self.kept);
        }
        if !fits {
            if !buffers.whole {
                buffers.bring_record(&self.gpu, record_bytes)?;
            }
            match (&buffers.record_back, &buffers.moments_back) {
                (Some(record), Some(moments)) if trace => self.gpu.mapped(record, 0..record_bytes, |record| {
                    self.gpu.mapped(moments, 0..moment_bytes, |moments| {
                        share_out(Home::Whole(bytemuck::cast_slice(record)), bytemuck::cast_slice(moments));
                    })
                })??,
                (Some(record), _) => self.gpu.mapped(record, 0..record_bytes, |record| {
                    share_out(Home::Whole(bytemuck::cast_slice(record)), &[]);
                })?,
                _ => unreachable!("a batch was submitted"),
            }
        }
        if let Some(watch) = &buffers.watch {
            self.stages.gpu += watch.read(&self.gpu)?;
        }
        self.stages.wait += done_waiting - start;
        self.stages.score += score;
        self.stages.read_back += done_waiting.elapsed().saturating_sub(score);
        Ok(())
    }

    /// What a batch has to gather.
    fn stretches<'a>(&self, groups: &[Group<'a>], work: &Work) -> Result<Gathering<'a>, BackendError> {
        let (mut stretches, mut choices) = (Vec::new(), Vec::new());
        for shares in work.shares.chunk_by(|a, b| a.group == b.group) {
            let group = &groups[shares[0].group];
            let Weights::Held(held) = group.weights else { continue };
            let ours = |population: &&Population| self.kernels.as_ref().is_some_and(|k| population.is_of(k));
            let population = (held as &dyn Any).downcast_ref().filter(ours).ok_or(BackendError::HeldElsewhere)?;
            let leaders = group.world.leaders();
            population.check([leaders, group.policies, group.world.parameters()])?;
            let teams: u32 = shares.iter().map(|share| share.task.teams).sum();
            for first in (0..leaders).step_by(TOGETHER) {
                let stretch = Stretch {
                    leaders: leaders as u32,
                    first: first as u32,
                    count: TOGETHER.min(leaders - first) as u32,
                    parameters: group.world.constants.policy.parameters,
                    teams,
                    teams_a_task: shares[0].task.teams,
                    choices: choices.len() as u32,
                    weights: shares[0].task.weights,
                };
                stretches.push((stretch, population));
            }
            choices.extend(&group.teams[shares[0].first_team * leaders..][..teams as usize * leaders]);
        }
        Ok((stretches, choices))
    }

    /// Gathers the weights of every task whose policies are on the host; leaves room for the others'.
    fn fill_staging(&mut self, groups: &[Group<'_>], work: &Work) {
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

    fn prepare_packing(&mut self) -> Result<(), DeviceError> {
        use Binding::{Read, Write};
        if self.pack.is_none() {
            let layout = self.gpu.layout("pack", &[Read, Read, Read, Write, Write])?;
            let pipeline = self.gpu.own_pipeline("pack", &(self.edit)(packing()), "pack", &layout)?;
            self.pack = Some((pipeline, layout));
        }
        Ok(())
    }

    fn prepare_pipeline(&mut self, shape: Shape) -> Result<(), DeviceError> {
        match self.pipelines.entry(shape) {
            Entry::Occupied(mut entry) => entry.get_mut().played = self.plays,
            Entry::Vacant(entry) => {
                let pipeline =
                    self.gpu.own_pipeline("episode", &(self.edit)(source(shape)), "episode", &self.layout)?;
                entry.insert(Compiled { pipeline, played: self.plays });
            }
        }
        Ok(())
    }
}

/// The whole shader that packs records, with its constants in front.
fn packing() -> String {
    let most = WORKGROUPS[WORKGROUPS.len() - 1].max(TEAMS[0]);
    let structs = [model::declarations(), Task::wgsl(), State::wgsl(), Moment::wgsl()].concat();
    exact::assemble(&[
        &structs,
        &format!(
            "const WORKGROUP: u32 = {PACK_WORKGROUP}u;\nconst TEAMS: u32 = {most}u;\nconst NOWHERE: u32 = {NOWHERE}u;"
        ),
        include_str!("../../../shaders/lib/layout.wgsl"),
        include_str!("../../../shaders/pack.wgsl"),
    ])
}

fn is_on_host(groups: &[Group<'_>], share: &Share) -> bool {
    matches!(groups[share.group].weights, Weights::OnHost(_))
}

/// The whole shader, with what it has in front.
fn source(shape: Shape) -> String {
    let Shape { workgroup, slots, records: Kept { trace, sights: sighted }, sizes } = shape;
    let (shared, tally, sights) = match sizes {
        // As many agents as one team may have, or several teams on a thread each.
        Sizes::Any { .. } => ((workgroup * slots).min(MAX_AGENTS), false, 1),
        Sizes::Fixed { teams, leaders, agents, .. } => {
            let tally = leaders < agents && leaders as usize <= SIGHTS;
            (teams * agents as usize, tally, if tally { leaders } else { 1 })
        }
    };
    let constants = format!(
        "const WORKGROUP: u32 = {workgroup}u;\nconst SLOTS: u32 = {slots}u;\nconst SHARED: u32 = {shared}u;\n\
         const TRACE: bool = {trace};\nconst SIGHTED: bool = {sighted};\nconst TALLY: bool = {tally};\nconst SIGHTS: u32 = {sights}u;"
    );
    let front = match sizes {
        Sizes::Any { widest, chooses } => {
            let variant = Variant::copied_from("world");
            let generic = include_str!("../../../shaders/generic.wgsl");
            format!(
                "const WIDEST: u32 = {widest}u;\nconst CHOOSES: bool = {chooses};\n\
                 fn world_variant() -> Variant {{ return {variant}; }}\n{generic}"
            )
        }
        Sizes::Fixed { teams, leaders, agents, pois, widths, variant } => format!(
            "const shape = Shape({leaders}u, {agents}u, {pois}u, {words}u, {teams}u);\nconst variant = {variant};\n\
             fn adopt(task: Task) {{}}\n{}",
            straight_policy(&widths),
            words = agents.div_ceil(32),
            variant = variant.value()
        ),
    };
    let structs = [Task::wgsl(), State::wgsl(), Moment::wgsl()].concat();
    let (front, math) =
        ([constants, front, model::declarations(), structs], include_str!("../../../shaders/lib/math.wgsl"));
    let front = front.iter().map(String::as_str).chain([include_str!("../../../shaders/lib/layout.wgsl"), math]);
    let parts = front.chain(model::WGSL).chain([include_str!("../../../shaders/episode.wgsl")]);
    exact::assemble(&parts.collect::<Vec<_>>())
}

/// A policy of these widths as straight-line code: `decide` of `shaders/generic.wgsl`, its loops written out. Each unit
/// is a variable, and four weights at a time are read in the order in which they are needed, so that a compiler may
/// read many before it waits for any.
fn straight_policy(widths: &[u32; WIDTHS]) -> String {
    let mut text = String::from("fn decide(start: u32, stride: u32, inputs: array<f32, INPUTS>) -> vec2<f32> {\n");
    let mut line = |line: std::fmt::Arguments<'_>| writeln!(text, "    {line}").expect("a string takes a line");
    let mut read = HashSet::new();
    let mut inputs: Vec<String> = (0..INPUTS).map(|input| format!("inputs[{input}]")).collect();
    let mut first = 0;
    let layers = widths.windows(2).take_while(|pair| pair[1] > 0);
    for (layer, pair) in layers.enumerate() {
        let (rows, columns) = (pair[0] as usize, pair[1] as usize);
        // The biases first.
        for row in std::iter::once(rows).chain(0..rows) {
            for column in 0..columns {
                let weight = first + row * columns + column;
                let (four, axis) = (weight / FOUR, AXES[weight % FOUR]);
                if read.insert(four) {
                    line(format_args!("let w{four} = weights[start + {four}u * stride];"));
                }
                match row == rows {
                    true => line(format_args!("var s{layer}_{column} = w{four}.{axis};")),
                    false => line(format_args!("s{layer}_{column} += {} * w{four}.{axis};", inputs[row])),
                }
            }
        }
        inputs = (0..columns).map(|column| format!("u{layer}_{column}")).collect();
        for (column, unit) in inputs.iter().enumerate() {
            line(format_args!("let {unit} = activate(s{layer}_{column});"));
        }
        first += (rows + 1) * columns;
    }
    match inputs.len() {
        OUTPUTS => line(format_args!("return vec2({});", inputs.join(", "))),
        _ => line(format_args!("return choose(inputs, array({}));", inputs.join(", "))),
    }
    text + "}\n"
}

const AXES: [&str; FOUR] = ["x", "y", "z", "w"];

/// The episode's shader in a few of its variants, generic and specialised for the paper's first layout.
pub fn shaders() -> Vec<(&'static str, String)> {
    let generic = |workgroup, slots, widest, records: Kept| {
        source(Shape { workgroup, slots, records, sizes: Sizes::Any { widest, chooses: records.trace } })
    };
    let specialised = |records, actions: Actions| {
        let widths = [INPUTS as u32, 10, actions.outputs() as u32, 0, 0];
        let variant = Variant { density: 0, by_sine: 1 };
        let sizes = Sizes::Fixed { teams: 32, leaders: 4, agents: 12, pois: 4, widths, variant };
        source(Shape { workgroup: 384, slots: 1, records, sizes })
    };
    let [little, sights, trace] =
        [(false, false), (false, true), (true, true)].map(|(trace, sights)| Kept { trace, sights });
    vec![
        ("episode", generic(64, 1, 16, little)),
        ("episode, traced", generic(128, 1, 64, trace)),
        ("episode, large teams", generic(256, 5, 64, little)),
        ("episode, specialised", specialised(little, Actions::Direct)),
        ("episode, specialised, behaviours", specialised(little, Actions::Behaviours)),
        ("episode, specialised, with sights", specialised(sights, Actions::Direct)),
        ("episode, specialised, traced", specialised(trace, Actions::Direct)),
        ("pack", packing()),
    ]
}

/// The shader that would play a world: the specialised one, where there can be one, or the generic one; for looking at
/// what compilers make of it. `threads` is the size of the largest workgroup.
#[doc(hidden)]
pub fn shader_of(world: &World, kernel: Kernel, threads: usize) -> String {
    let room = Capacity::of_workgroups(threads);
    let little = Kept { trace: false, sights: false };
    let made = Shape::asked_for(world, kernel, room, little);
    source(made.unwrap_or_else(|| Shape::generic(world, Packing::generic(world, threads), little)))
}

/// What one workgroup gets to play a group's first teams, and where it leaves what comes of that; for running what
/// compilers make of its shader.
#[doc(hidden)]
pub struct Workgroup {
    /// Its shader.
    pub shader: String,
    /// How many threads it has, and how many teams they play.
    pub threads: usize,
    /// See `threads`.
    pub teams: usize,
    /// The words of each binding: nothing for the guard, worlds, tasks, places, weights, and yet to write the record,
    /// moments and states.
    pub buffers: [Vec<u32>; 8],
}

/// The workgroup that plays a group's first teams, policies on the host, in one dispatch: by a kernel made for their world
/// if that is asked for and can be, or by the generic one. It takes another dispatch to follow, and leaves where the agents
/// stand in the end. `threads` is the size of the largest workgroup.
///
/// # Errors
/// A team is too large for any device.
#[doc(hidden)]
pub fn workgroup_of(group: &Group<'_>, kernel: Kernel, threads: usize) -> Result<Workgroup, BackendError> {
    let room = Capacity::of_workgroups(threads);
    let made = Shape::asked_for(group.world, kernel, room, Kept::of(group, false));
    let batches = plan(&[*group], false, Records::Whole, room, &made.into_iter().collect())?;
    let work = &batches[0];
    let Share { task, first_team, shape, .. } = work.shares[0];
    let mut weights = vec![[0.0; FOUR]; fours(group.world) * task.teams as usize];
    if let Weights::OnHost(policies) = group.weights {
        gather(group, policies, first_team, task.teams as usize, &mut weights);
    }
    let words = |bytes: &[u8]| bytemuck::pod_collect_to_vec(bytes);
    let world = Constants { steps: task.end + 1, ..work.worlds[0] };
    let agents = group.world.agents() * task.teams as usize;
    Ok(Workgroup {
        shader: source(shape),
        threads: shape.workgroup,
        teams: task.teams as usize,
        buffers: [
            vec![0; 4],
            words(bytemuck::bytes_of(&world)),
            words(bytemuck::bytes_of(&task)),
            words(bytemuck::cast_slice(&work.places)),
            words(bytemuck::cast_slice(&weights)),
            vec![0; record_words(group.world, group.need) * task.teams as usize],
            Vec::new(),
            vec![0; agents * size_of::<State>() / 4],
        ],
    })
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
