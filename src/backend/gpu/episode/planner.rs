//! The planner: cuts groups of teams into tasks, and tasks into batches that fit the device.

use std::collections::{BTreeSet, HashSet};

use glam::Vec2;

use super::Records;
use super::shape::{Capacity, MAX_THREADS, Recorded, Shape, WORKGROUPS, Workgroup};
use crate::backend::{BackendError, FOUR, Group, Moment, fours, record_words};
use crate::credit::{RecordRequest, owner_bits};
use crate::gpu_struct::gpu_struct;
use crate::model::Constants;
use crate::model::policy::PolicyConstants;
use crate::world::World;

/// Maximum loop iterations per thread and dispatch, over all loops. Longer episodes take several dispatches: Mesa's
/// llvmpipe 22.3 abandons every loop after 65 535 iterations, and drivers stop a dispatch that runs for seconds.
const MAX_ITERATIONS: usize = 60_000;
/// Threads per workgroup of the kernel that packs records.
pub(super) const PACK_WORKGROUP: usize = 64;
/// Words before the others in a packed record (`struct Packed` in the shader): words used, and words available.
pub(super) const PACKED_HEAD: usize = 2;
/// Words after a task's record.
const STATUS: usize = 1;
/// Sentinel: no offset.
pub(super) const NOWHERE: u32 = u32::MAX;

gpu_struct! {
    /// The work of one workgroup: some teams of one group. All offsets are in elements.
    #[derive(Default)]
    pub struct Task {
        /// The index of the world in the batch.
        pub world: u32,
        /// The offset of the agents' start positions.
        pub starts: u32,
        /// The offset of the POI positions.
        pub pois: u32,
        /// The offset of the weights.
        pub weights: u32,
        /// The offset of the sets of agents at each POI.
        pub sets: u32,
        /// The offset of the counts of leaders that followers saw.
        pub seen: u32,
        /// The offset of a trace's moments.
        pub moments: u32,
        /// The offset of the agents' states between two dispatches.
        pub states: u32,
        /// The number of teams.
        pub teams: u32,
        /// The first step of a dispatch.
        pub first: u32,
        /// The step before which a dispatch ends.
        pub end: u32,
        /// The offset of the minimum size of each POI's sets, for packing (`shaders/pack.wgsl`).
        pub least: u32,
        /// The offset of the table of packed sets, which packing writes.
        pub table: u32,
        /// The offset of the leaders that followers saw most, which packing writes, or all ones for nowhere.
        pub owners: u32,
        /// The offset of the status word in the record. The first dispatch writes the nonce there; each later one adds
        /// 1.
        pub status: u32,
        /// A number that no earlier work of the device had.
        pub nonce: u32,
    }

    /// The state of an agent between two dispatches.
    pub struct State {
        /// x, in units.
        pub x: f32,
        /// y, in units.
        pub y: f32,
        /// The heading's cosine.
        pub hx: f32,
        /// The heading's sine.
        pub hy: f32,
        /// The speed, in units per second.
        pub speed: f32,
    }
}

/// Returns the estimated loop iterations per thread and step, over all loops.
fn iterations_per_step(world: &World, workgroup: Workgroup, records: Recorded) -> usize {
    let Constants { words, policy: PolicyConstants { widths, .. }, .. } = world.constants;
    let network: u32 = widths.windows(2).map(|w| (w[0] + 2) * w[1]).sum();
    // A leader iterates over all agents, and again over those in reach.
    let agent = world.pois.len() + 2 * world.agents() + words as usize + network as usize + 20;
    let sights = if records.sights { world.followers() * world.leader_words() } else { 0 };
    let items = |rows: usize| (rows * workgroup.teams).div_ceil(workgroup.threads);
    let items = items(world.pois.len() * words as usize) + items(sights);
    workgroup.slots * agent + items * 33
}

/// Returns the maximum steps per dispatch, see [`MAX_ITERATIONS`].
fn steps_per_dispatch(world: &World, workgroup: Workgroup, records: Recorded) -> usize {
    (MAX_ITERATIONS / iterations_per_step(world, workgroup, records)).max(1)
}

/// Returns the bytes of a team's states between two dispatches, 0 if one dispatch plays the whole episode. This is an
/// upper bound: adapters with larger workgroups may need none.
pub fn state_bytes(world: &World, request: RecordRequest<'_>) -> u64 {
    let recorded = Recorded { trace: false, sights: request.sights() && world.followers() > 0 };
    let generic = Workgroup::generic(world, WORKGROUPS[2]);
    let specialised = Workgroup::specialised(world, Capacity::of_workgroups(MAX_THREADS));
    let workgroups = [generic].into_iter().chain(specialised);
    let parted = workgroups.into_iter().any(|workgroup| world.steps() > steps_per_dispatch(world, workgroup, recorded));
    if parted { (world.agents() * size_of::<State>()) as u64 } else { 0 }
}

/// A task and where its teams come from.
#[derive(Clone, Copy)]
pub(super) struct PlannedTask {
    pub(super) group: usize,
    pub(super) first_team: usize,
    pub(super) shape: Shape,
    /// The task, with all steps of the episode.
    pub(super) task: Task,
    pub(super) steps_per_dispatch: usize,
    /// The estimated work of a step: loop iterations over all threads.
    pub(super) iterations_per_step: usize,
}

impl PlannedTask {
    /// Returns the estimated work of a round: loop iterations over all threads.
    pub(super) fn iterations(&self, round: &Task) -> u64 {
        u64::from(round.end - round.first) * self.iterations_per_step as u64
    }

    /// Returns the number of weights of its teams, in fours.
    pub(super) fn fours(&self, groups: &[Group<'_>]) -> usize {
        self.task.teams as usize * fours(groups[self.group].world)
    }

    /// Returns the number of rounds of dispatches.
    pub(super) fn rounds(&self) -> usize {
        (self.task.end as usize).div_ceil(self.steps_per_dispatch)
    }

    /// Returns the task with the steps of one round of dispatches, or `None` after its last round.
    pub(super) fn round(&self, round: usize, nonce: u32) -> Option<Task> {
        let first = (round * self.steps_per_dispatch) as u32;
        let end = self.task.end.min(first + self.steps_per_dispatch as u32);
        (first < end).then_some(Task { first, end, nonce, ..self.task })
    }

    /// Returns the offset of the status word in a packed record. It follows the table.
    pub(super) fn packed_status(&self) -> usize {
        (self.task.table + self.task.teams) as usize + 1
    }

    /// Returns the value of the status word after the last round.
    pub(super) fn final_status(&self, nonce: u32) -> u32 {
        nonce.wrapping_add(self.rounds() as u32 - 1)
    }
}

/// Numbers of elements in the buffers that grow with the teams. [`BatchPlan::is_full`] counts those that grow with the
/// groups.
#[derive(Clone, Copy, Default)]
pub(super) struct Elements {
    /// Words of records.
    pub(super) record: usize,
    /// Weights, in fours.
    pub(super) weights: usize,
    /// Moments of a trace.
    pub(super) moments: usize,
    /// States between two dispatches.
    pub(super) states: usize,
}

impl Elements {
    /// Returns the bytes of each buffer, in the order of the fields.
    pub(super) fn bytes(self) -> [u64; 4] {
        let bytes = |count: usize, size: usize| count as u64 * size as u64;
        [
            bytes(self.record, size_of::<u32>()),
            bytes(self.weights, size_of::<[f32; FOUR]>()),
            bytes(self.moments, size_of::<Moment>()),
            bytes(self.states, size_of::<State>()),
        ]
    }
}

/// How the teams of one group become tasks.
struct GroupPlan<'a> {
    group: &'a Group<'a>,
    per_team: Elements,
    /// Maximum bytes per team in one buffer.
    bytes_per_team: u64,
    teams_per_task: usize,
    /// A task without teams.
    template: PlannedTask,
}

impl<'a> GroupPlan<'a> {
    /// Plans group `index`. Its world gets the specialised kernel if its shape is one of `specialised`.
    fn new(
        index: usize,
        group: &'a Group<'a>,
        trace: bool,
        capacity: Capacity,
        specialised: &HashSet<Shape>,
    ) -> Result<GroupPlan<'a>, BackendError> {
        let world = group.world;
        let recorded = Recorded::of(group, trace);
        let own_kernel = Workgroup::specialised(world, capacity)
            .map(|workgroup| (workgroup, Shape::specialised(world, workgroup, recorded)));
        let (workgroup, shape) = own_kernel.filter(|(_, shape)| specialised.contains(shape)).unwrap_or_else(|| {
            let workgroup = Workgroup::generic(world, capacity.workgroup);
            (workgroup, Shape::generic(world, workgroup, recorded))
        });
        let steps_per_dispatch = steps_per_dispatch(world, workgroup, recorded);
        let per_team = Elements {
            record: record_words(world, group.records()),
            weights: fours(world),
            moments: if trace { (world.steps() + 1) * world.agents() } else { 0 },
            states: if world.steps() > steps_per_dispatch { world.agents() } else { 0 },
        };
        let with_status = Elements { record: per_team.record + STATUS, ..per_team };
        let bytes_per_team = with_status.bytes().into_iter().max().unwrap_or(0);
        if bytes_per_team > capacity.buffer {
            return Err(BackendError::TooLarge(format!(
                "one team takes {bytes_per_team} bytes in one buffer, this adapter allows {}; \
                 use the CPU, fewer steps or fewer POIs",
                capacity.buffer
            )));
        }
        let teams_per_task = workgroup.teams.min((capacity.target() / bytes_per_team.max(1)).max(1) as usize);
        let template = PlannedTask {
            group: index,
            first_team: 0,
            shape,
            task: Task::default(),
            steps_per_dispatch,
            iterations_per_step: iterations_per_step(world, workgroup, recorded) * workgroup.threads,
        };
        Ok(GroupPlan { group, per_team, bytes_per_team, teams_per_task, template })
    }
}

/// Tasks that fit the device's buffers together: one batch.
#[derive(Default)]
pub(super) struct BatchPlan {
    pub(super) tasks: Vec<PlannedTask>,
    /// The shapes of its kernels.
    pub(super) shapes: BTreeSet<Shape>,
    pub(super) worlds: Vec<Constants>,
    pub(super) places: Vec<Vec2>,
    /// The elements that its tasks use.
    pub(super) used: Elements,
    /// Words of all sets in the record.
    pub(super) sets: usize,
    /// If the record is packed: the words of tables and owners, and the minimum size of a set, `[pois]` per group.
    pub(super) head: Option<usize>,
    pub(super) least: Vec<u32>,
}

impl BatchPlan {
    /// Reports whether `teams` more teams of a group exceed the capacity, with the group's world and positions.
    fn is_full(&self, plan: &GroupPlan<'_>, teams: usize, capacity: Capacity) -> bool {
        let more = teams as u64 * plan.bytes_per_team;
        let world = plan.group.world;
        let places = self.places.len() + plan.group.starts.len() + world.pois.len() + world.headings.len();
        let of_groups = [
            places * size_of::<Vec2>(),
            (self.worlds.len() + 1) * size_of::<Constants>(),
            (self.tasks.len() + 1) * size_of::<Task>(),
        ];
        self.used.bytes().into_iter().any(|used| used + more > capacity.target())
            || of_groups.into_iter().any(|bytes| bytes as u64 > capacity.target())
            || self.shapes.len() >= capacity.kernels && !self.shapes.contains(&plan.template.shape)
    }

    /// Stores a group's world, starts and POIs, and returns a task that refers to them.
    fn store(&mut self, plan: &GroupPlan<'_>) -> Task {
        let Group { world, starts, .. } = *plan.group;
        let (index, first) = (self.worlds.len() as u32, self.places.len() as u32);
        self.places.extend(starts);
        if plan.group.moved_pois().is_none() {
            self.places.extend(&world.pois);
        }
        // The shader finds headings behind the POIs.
        self.places.extend(&world.headings);
        self.worlds.push(world.constants);
        self.shapes.insert(plan.template.shape);
        let (pois, end) = (first + world.agents() as u32, world.constants.steps);
        Task { world: index, starts: first, pois, end, ..Task::default() }
    }

    /// Adds a task. `stored` refers to its group's world.
    fn push(&mut self, plan: &GroupPlan<'_>, first_team: usize, teams: usize, stored: Task) {
        let (used, per_team, sets) = (&mut self.used, plan.per_team, plan.group.world.set_words() * teams);
        let task = Task {
            weights: used.weights as u32,
            sets: used.record as u32,
            seen: (used.record + sets) as u32,
            moments: used.moments as u32,
            states: used.states as u32,
            teams: teams as u32,
            status: (used.record + per_team.record * teams) as u32,
            ..stored
        };
        used.record += per_team.record * teams + STATUS;
        used.weights += per_team.weights * teams;
        used.moments += per_team.moments * teams;
        used.states += per_team.states * teams;
        self.sets += sets;
        self.tasks.push(PlannedTask { first_team, task, ..plan.template });
    }

    /// Lays out the packed record, unless the whole record is requested, the rule depends on when sets occur, packing
    /// would take too long for one dispatch, or it would save nothing.
    fn pack(&mut self, groups: &[Group<'_>], records: Records) {
        let packs = |planned: &PlannedTask| {
            let (world, need) = (groups[planned.group].world, groups[planned.group].records());
            need.least(1).is_some() && !world.rule.is_timed() && pack_iterations(groups, planned) <= MAX_ITERATIONS
        };
        // The first task of a group is the largest.
        let all_pack = self.tasks.chunk_by(|a, b| a.group == b.group).all(|tasks| packs(&tasks[0]));
        if !records.packs(self.used.bytes()[0]) || !all_pack {
            return;
        }
        let mut head = 0;
        for tasks in self.tasks.chunk_by_mut(|a, b| a.group == b.group) {
            let (world, need) = (groups[tasks[0].group].world, groups[tasks[0].group].records());
            let least = self.least.len() as u32;
            self.least.extend(world.coupling.iter().filter_map(|&coupling| need.least(coupling)));
            for PlannedTask { task, .. } in tasks {
                let teams = task.teams as usize;
                (task.least, task.table, task.owners) = (least, head as u32, NOWHERE);
                head += teams + 2;
                if need.owners() && world.followers() > 0 {
                    task.owners = head as u32;
                    head += owner_words(world) * teams;
                }
            }
        }
        self.head = Some(head).filter(|head| head + PACKED_HEAD < self.used.record);
    }
}

/// Returns the words per team for the leader that each follower saw most.
pub(super) fn owner_words(world: &World) -> usize {
    world.followers().div_ceil((32 / owner_bits(world.constants.leaders)) as usize)
}

/// Returns the maximum loop iterations per thread to pack a task.
fn pack_iterations(groups: &[Group<'_>], planned: &PlannedTask) -> usize {
    let (world, teams) = (groups[planned.group].world, planned.task.teams as usize);
    let sets = (world.pois.len() * teams).div_ceil(PACK_WORKGROUP);
    let owners = (owner_words(world) * teams).div_ceil(PACK_WORKGROUP) * 4 * (world.leaders() + 2);
    // Each set is read twice, and at most as many are written or skipped.
    sets * 4 * world.steps() * (world.constants.words as usize + 1) + owners + 3 * teams
}

/// Cuts the groups' teams into tasks, and the tasks into batches. Worlds with one of the `specialised` shapes get that
/// kernel.
///
/// # Errors
/// One team's record exceeds the device's largest buffer.
pub(super) fn plan(
    groups: &[Group<'_>],
    trace: bool,
    records: Records,
    capacity: Capacity,
    specialised: &HashSet<Shape>,
) -> Result<Vec<BatchPlan>, BackendError> {
    let mut batches = vec![BatchPlan::default()];
    for (index, group) in groups.iter().enumerate() {
        let plan = GroupPlan::new(index, group, trace, capacity, specialised)?;
        // A group's world, starts and POIs are stored once per batch.
        let mut stored = None;
        for first_team in (0..group.team_count()).step_by(plan.teams_per_task) {
            let teams = plan.teams_per_task.min(group.team_count() - first_team);
            let mut batch = batches.last_mut().expect("there is a batch");
            if batch.is_full(&plan, teams, capacity) {
                batches.push(BatchPlan::default());
                batch = batches.last_mut().expect("just pushed");
                stored = None;
            }
            let stored = *stored.get_or_insert_with(|| batch.store(&plan));
            batch.push(&plan, first_team, teams, stored);
        }
    }
    batches.retain(|batch| !batch.tasks.is_empty());
    if !trace {
        batches.iter_mut().for_each(|batch| batch.pack(groups, records));
    }
    Ok(batches)
}

/// Writes a task's weights, `[fours of a policy's weights][leaders][teams]`, so that neighbouring threads load
/// neighbouring weights.
pub(super) fn gather(group: &Group<'_>, weights: &[f32], first_team: usize, teams: usize, to: &mut [[f32; FOUR]]) {
    let (leaders, parameters) = (group.world.leaders(), group.world.parameters());
    let policies = &group.teams[first_team * leaders..(first_team + teams) * leaders];
    for (place, &policy) in policies.iter().enumerate() {
        let (team, leader) = (place / leaders, place % leaders);
        let from = group.place(leader, policy as usize);
        let column = to[leader * teams + team..].iter_mut().step_by(leaders * teams);
        for (four, weights) in column.zip(weights[from..from + parameters].chunks(FOUR)) {
            four[..weights.len()].copy_from_slice(weights);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::{BATCH_BYTES, Weights};
    use crate::config::Config;

    /// Agents that wait between two dispatches count towards a batch, too.
    #[test]
    fn no_batch_outgrows_a_buffer() {
        let text = "[world]\nleaders = [[1, 1]]\nfollowers = [FOLLOWERS]\npois = [[9, 9]]\nsteps = 45\n";
        let text = text.replace("FOLLOWERS", &vec!["[2, 2]"; 255].join(", "));
        let world = World::new(&Config::parse(&text, "large").unwrap().validate().unwrap());
        let (policies, population) = (vec![0.0; world.parameters()], 27_000);
        let group = Group {
            world: &world,
            starts: &world.starts,
            weights: Weights::OnHost(&policies),
            policies: 1,
            teams: &vec![0; population],
            populations: &world.populations,
            fitnesses: &[crate::config::Fitness::Df],
        };
        for buffer in [128 << 20, 1 << 20, 1 << 14] {
            let capacity = Capacity { batch: BATCH_BYTES, buffer, ..Capacity::of_workgroups(256) };
            let batches = plan(&[group], false, Records::Whole, capacity, &HashSet::new()).unwrap();
            for batch in &batches {
                let [record, .., states] = batch.used.bytes();
                assert!(states > 0 && states <= buffer, "{states} bytes of states, {buffer} allowed");
                assert!(record <= buffer);
            }
            let teams: u32 = batches.iter().flat_map(|batch| &batch.tasks).map(|planned| planned.task.teams).sum();
            assert_eq!(teams as usize, population);
        }
        assert_eq!(state_bytes(&world, group.records()), 256 * 20);
    }

    /// With one team per group, worlds and positions take more than records and weights.
    #[test]
    fn groups_of_one_team_do_not_outgrow_a_buffer() {
        let text = "[world]\nleaders = [[1, 1]]\nfollowers = [FOLLOWERS]\npois = [[9, 9]]\nsteps = 1\n";
        let text = text.replace("FOLLOWERS", &vec!["[2, 2]"; 255].join(", "));
        let world = World::new(&Config::parse(&text, "large").unwrap().validate().unwrap());
        let policies = vec![0.0; world.parameters()];
        let group = Group {
            world: &world,
            starts: &world.starts,
            weights: Weights::OnHost(&policies),
            policies: 1,
            teams: &[0],
            populations: &world.populations,
            fitnesses: &[crate::config::Fitness::Df],
        };
        let (groups, buffer) = (vec![group; 1000], 1 << 20);
        let capacity = Capacity { batch: BATCH_BYTES, buffer, ..Capacity::of_workgroups(256) };
        let batches = plan(&groups, false, Records::Whole, capacity, &HashSet::new()).unwrap();
        for batch in &batches {
            let bytes = [size_of_val(&batch.places[..]), size_of_val(&batch.worlds[..])];
            assert!(bytes.iter().all(|&bytes| bytes as u64 <= buffer), "{bytes:?}");
        }
        assert_eq!(batches.iter().map(|batch| batch.tasks.len()).sum::<usize>(), groups.len());
    }
}
