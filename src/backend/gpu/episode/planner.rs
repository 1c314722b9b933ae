//! The planner: cuts groups of teams into tasks, and tasks into batches that fit the device.

use std::collections::{BTreeSet, HashSet};

use glam::Vec2;

use super::Records;
use super::shape::{Capacity, Kept, Packing, Shape};
use crate::backend::{BackendError, FOUR, Group, Moment, fours, owner_bits, record_words};
use crate::declare::shared;
use crate::model::Constants;
use crate::model::policy::PolicyConstants;
use crate::world::World;

/// Maximum loop iterations per thread and dispatch, over all loops. Longer episodes take several dispatches: Mesa's
/// llvmpipe 22.3 abandons every loop after 65 535 iterations, and drivers stop a dispatch that runs for seconds.
const TURNS: usize = 60_000;
/// Threads per workgroup of the kernel that packs records.
pub(super) const PACK_WORKGROUP: usize = 64;
/// Words before the others in a packed record (`struct Packed` in the shader): words used, and words available.
pub(super) const PACKED_HEAD: usize = 2;
/// Sentinel: no offset.
pub(super) const NOWHERE: u32 = u32::MAX;

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
pub(super) struct Share {
    pub(super) group: usize,
    pub(super) first_team: usize,
    pub(super) shape: Shape,
    /// All steps of the episode.
    pub(super) task: Task,
    pub(super) steps_a_dispatch: usize,
}

impl Share {
    /// How many weights its teams have, in fours.
    pub(super) fn fours(&self, groups: &[Group<'_>]) -> usize {
        self.task.teams as usize * fours(groups[self.group].world)
    }

    /// The task's part in one round of dispatches; none when it is done.
    pub(super) fn round(&self, round: usize) -> Option<Task> {
        let first = (round * self.steps_a_dispatch) as u32;
        let end = self.task.end.min(first + self.steps_a_dispatch as u32);
        (first < end).then_some(Task { first, end, ..self.task })
    }
}

/// Tasks that fit the device's buffers together.
#[derive(Default)]
pub(super) struct Work {
    pub(super) shares: Vec<Share>,
    /// What its kernels are made for.
    pub(super) shapes: BTreeSet<Shape>,
    pub(super) worlds: Vec<Constants>,
    pub(super) places: Vec<Vec2>,
    /// In fours.
    pub(super) weights: usize,
    pub(super) record: usize,
    pub(super) moments: usize,
    pub(super) states: usize,
    /// Words of all sets in the record.
    pub(super) sets: usize,
    /// If the record is packed: the words of tables and owners, and how many agents a set must have, `[pois]` a group.
    pub(super) head: Option<usize>,
    pub(super) least: Vec<u32>,
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
pub(super) fn owner_words(world: &World) -> usize {
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

/// Cuts the groups' teams into tasks and the tasks into batches; worlds of the given shapes have kernels of their own.
///
/// # Errors
/// When one team's record is larger than the device's largest buffer.
pub(super) fn plan(
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
                // The shader finds headings behind the POIs.
                work.places.extend(&world.headings);
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
pub(super) fn gather(group: &Group<'_>, weights: &[f32], first_team: usize, teams: usize, to: &mut [[f32; FOUR]]) {
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
