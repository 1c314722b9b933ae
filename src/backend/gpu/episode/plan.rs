//! Plans: cuts groups of teams into tasks, tasks into batches that fit the device, and records what each batch does.

use std::collections::{BTreeSet, HashSet};
use std::ops::Range;

use glam::Vec2;

use super::Records;
use super::count::Counting;
use crate::backend::gpu::population::Held;
use crate::backend::gpu::recording::{BINDING_ALIGNMENT, Buffer, Command, Recording, Slice, grid};
use crate::backend::gpu::shape::{Capacity, MAX_THREADS, Recorded, Shape, WORKGROUPS, Workgroup};
use crate::backend::gpu::source::{
    COUNT_WORKGROUP, GatherJob, LEADERS_PER_GATHER, MAX_ITERATIONS, NOWHERE, Pipeline, State, SwarmPart, Task,
};
use crate::backend::grid::{Grid, LARGE_FROM, is_large};
use crate::backend::{BackendError, Group, VECTOR, WeightVector, Weights, record_words, traced_words, weight_vectors};
use crate::config::{Choice, MAX_CLASSES};
use crate::credit::RecordRequest;
use crate::model::Constants;
use crate::model::class::Class;
use crate::model::policy::PolicyConstants;
use crate::model::sense::{ChannelConstants, NOTHING};
use crate::parallel::*;
use crate::world::{GoneWithin, World};

/// Words of a task's status.
const STATUS: usize = 1;
/// Alignment of each kernel's first task, in tasks, so that a binding may start there.
const TASK_ALIGNMENT: usize = BINDING_ALIGNMENT / size_of::<Task>();
const _: () = assert!(BINDING_ALIGNMENT.is_multiple_of(size_of::<Task>()));

/// Words of a cell of a large team, see `shaders/swarm.wgsl`.
const CELL_WORDS: usize = 3;
/// Maximum workgroups that clear the record of a large team.
const CLEARERS: usize = 4096;

/// Returns the first words of the cells of each class after a large team's status word, and the words in all. A word per
/// class precedes them.
fn cell_words(world: &World) -> (Vec<usize>, usize) {
    let mut words = MAX_CLASSES;
    let first = |class| {
        words += CELL_WORDS * Grid::new(world, class).cells();
        words - CELL_WORDS * Grid::new(world, class).cells()
    };
    (world.classes.iter().map(first).collect(), words)
}

/// Returns the workgroups of a part of a step of a large team.
fn workgroups(part: SwarmPart, world: &World, workgroup: usize) -> usize {
    let (_, cells) = cell_words(world);
    match part {
        SwarmPart::Clear => (world.set_words() + cells).div_ceil(workgroup).min(CLEARERS),
        SwarmPart::Enter | SwarmPart::Fill => world.agents().div_ceil(workgroup),
        SwarmPart::Allocate => ((cells - MAX_CLASSES) / CELL_WORDS).div_ceil(workgroup),
        SwarmPart::Learn => world.leaders(),
        SwarmPart::ObeyRule => world.followers().div_ceil(workgroup).max(1),
    }
}

/// Returns the estimated loop iterations of a step of a large team over all threads, if agents are spread evenly.
fn iterations_of_large(world: &World) -> usize {
    let visits = |class: &Class| {
        let near = |other: &Class| 9 * other.agents().len().div_ceil(Grid::new(world, other).cells());
        let terms = if class.terms().is_empty() { 0 } else { world.classes.iter().map(near).sum() };
        let senses = if class.channels().is_empty() { 0 } else { world.agents() };
        class.agents().len() * (terms * class.terms().len() + senses * class.channels().len() + world.pois.len() + 50)
    };
    world.classes.iter().map(visits).sum()
}

/// Returns the estimated loop iterations per thread and step, over all loops.
fn iterations_per_step(world: &World, workgroup: Workgroup, records: Recorded) -> usize {
    let Constants { words, policy: PolicyConstants { widths, .. }, .. } = world.constants;
    let network: u32 = widths.windows(2).map(|w| (w[0] + 2) * w[1]).sum();
    // Each channel iterates over all agents, again over those in reach, or over all POIs, and over sectors for each; each
    // term over all agents.
    let channel = |channel: &ChannelConstants| {
        let entities = match channel.shape.of_pois {
            0 => 2 * world.agents() + words as usize,
            _ => world.pois.len(),
        };
        let sectors = channel.shape.sectors as usize;
        if sectors == 4 || channel.shape.each != 0 { entities } else { entities * (1 + sectors) + 2 * sectors }
    };
    let class = |class: &Class| {
        let shape = &class.constants.shape;
        let pursued = (shape.end_target - shape.first_target + shape.end_near - shape.first_near) as usize;
        class.channels().iter().map(channel).sum::<usize>() + class.terms().len() * world.agents() + pursued
    };
    let busiest = world.classes.iter().map(class).max().unwrap_or(0);
    let agent = busiest + world.leaders() + network as usize + 20 + world.classes.len() * 4;
    let sights = if records.sightings { world.followers() * world.leader_words() } else { 0 };
    let items = |rows: usize| (rows * workgroup.teams).div_ceil(workgroup.threads);
    let gone = items(world.gone_within.len()) * world.agents();
    let items = items(world.pois.len() * words as usize) + items(sights);
    workgroup.slots * agent + items * 33 + gone
}

/// Returns the maximum steps per dispatch, see [`MAX_ITERATIONS`].
fn steps_per_dispatch(world: &World, workgroup: Workgroup, records: Recorded) -> usize {
    (MAX_ITERATIONS / iterations_per_step(world, workgroup, records)).max(1)
}

/// Returns the bytes of a team's states between two dispatches, 0 if one dispatch plays the whole episode, and of its share
/// of the tasks of all dispatches. Adapters with larger workgroups may need no states.
pub fn dispatch_bytes(world: &World, request: RecordRequest<'_>) -> [u64; 2] {
    let recorded = Recorded { trace: false, sightings: request.sights() && world.followers() > 0 };
    let is_large = is_large(world, LARGE_FROM);
    let generic = Workgroup::generic(world, WORKGROUPS[2]);
    let specialised = Workgroup::specialised(world, Capacity::of_workgroups(MAX_THREADS));
    let rounds = |workgroup| world.steps().div_ceil(steps_per_dispatch(world, workgroup, recorded));
    let all = || specialised.into_iter().chain([generic]);
    let tasks = match is_large {
        true => world.steps() * size_of::<Task>(),
        false => all().map(|each| (rounds(each) * size_of::<Task>()).div_ceil(each.teams)).max().unwrap_or(0),
    };
    let states = states(world, is_large, all().any(|each| rounds(each) > 1)) * size_of::<State>();
    [states as u64 + if is_large { words(cell_words(world).1) } else { 0 }, tasks as u64]
}

/// Returns the number of jobs that gather the policies of a group.
fn gather_jobs(world: &World) -> usize {
    world.leaders().div_ceil(LEADERS_PER_GATHER)
}

/// Returns the number of states that a team keeps between two dispatches.
fn states(world: &World, is_large: bool, is_parted: bool) -> usize {
    let per_agent = match world.aligns() {
        _ if is_large => 3,
        true => 2,
        false => usize::from(is_parted),
    };
    per_agent * world.agents()
}

/// A task and where its teams come from.
#[derive(Clone, Copy)]
pub(super) struct PlannedTask {
    pub(super) group: usize,
    pub(super) first_team: usize,
    /// The task, with all steps of the episode.
    pub(super) task: Task,
}

/// The tasks of one group in a batch, and what they have in common.
#[derive(Clone)]
pub(super) struct Part {
    group: usize,
    /// The range of its tasks. The first is the largest.
    tasks: Range<usize>,
    pub(super) shape: Shape,
    steps: usize,
    steps_per_dispatch: usize,
    /// The estimated work of a step of a task: loop iterations over all threads.
    iterations_per_step: usize,
}

impl Part {
    /// Returns the number of rounds of dispatches.
    fn rounds(&self) -> usize {
        self.steps.div_ceil(self.steps_per_dispatch)
    }

    /// Returns the steps of one round of dispatches, none after its last round.
    fn round(&self, round: usize) -> Range<usize> {
        let first = round * self.steps_per_dispatch;
        first..self.steps.min(first + self.steps_per_dispatch)
    }

    /// Reports whether its policies are on the host.
    fn is_on_host(&self, groups: &[Group<'_>]) -> bool {
        matches!(groups[self.group].weights, Weights::OnHost(_))
    }
}

/// Numbers of elements in the buffers that grow with the teams. [`BatchPlan::is_full`] counts those that grow with the
/// groups.
#[derive(Clone, Copy, Default)]
struct Elements {
    /// Words of records.
    record: usize,
    /// Vectors of weights.
    weights: usize,
    /// Words of a trace.
    traced: usize,
    /// States between two dispatches.
    states: usize,
}

impl Elements {
    /// Returns the bytes of each buffer, in the order of the fields.
    fn bytes(self) -> [u64; 4] {
        let bytes = |count: usize, size: usize| count as u64 * size as u64;
        [
            bytes(self.record, size_of::<u32>()),
            bytes(self.weights, size_of::<WeightVector>()),
            bytes(self.traced, size_of::<f32>()),
            bytes(self.states, size_of::<State>()),
        ]
    }

    /// Returns the bytes of the largest buffer. One buffer takes both records and traces to the host.
    fn largest(self) -> u64 {
        let [record, weights, traced, states] = self.bytes();
        weights.max(states).max(record + traced)
    }
}

/// The division of one group's teams into tasks.
struct GroupPlan<'a> {
    group: &'a Group<'a>,
    per_team: Elements,
    /// Words after a task's record.
    after_record: usize,
    /// Maximum bytes per team in one buffer.
    bytes_per_team: u64,
    teams_per_task: usize,
    /// A part without tasks.
    part: Part,
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
        let own_kernel = Shape::specialised(world, capacity, recorded).filter(|(shape, _)| specialised.contains(shape));
        let (shape, workgroup) = own_kernel.unwrap_or_else(|| Shape::generic(world, capacity, trace));
        let (steps_per_dispatch, iterations_per_step) = match shape.is_large() {
            true => (1, iterations_of_large(world)),
            false => (
                steps_per_dispatch(world, workgroup, recorded),
                iterations_per_step(world, workgroup, recorded) * workgroup.threads,
            ),
        };
        let per_team = Elements {
            record: record_words(world, group.records()),
            weights: weight_vectors(world),
            traced: if trace { (world.steps() + 1) * traced_words(world) } else { 0 },
            states: states(world, shape.is_large(), world.steps() > steps_per_dispatch),
        };
        let after_record = STATUS + if shape.is_large() { cell_words(world).1 } else { 0 };
        let bytes_per_team = Elements { record: per_team.record + after_record, ..per_team }.largest();
        if bytes_per_team > capacity.buffer {
            return Err(BackendError::TooLarge(format!(
                "one team takes {bytes_per_team} bytes in one buffer, this adapter allows {}; \
                 use the CPU, fewer steps or fewer POIs",
                capacity.buffer
            )));
        }
        let teams_per_task = workgroup.teams.min((capacity.target() / bytes_per_team.max(1)).max(1) as usize);
        let (tasks, steps) = (0..0, world.steps());
        let part = Part { group: index, tasks, shape, steps, steps_per_dispatch, iterations_per_step };
        Ok(GroupPlan { group, per_team, after_record, bytes_per_team, teams_per_task, part })
    }
}

/// Tasks that fit the device's buffers together: one batch.
#[derive(Default)]
pub(super) struct BatchPlan {
    pub(super) tasks: Vec<PlannedTask>,
    /// One per group.
    pub(super) parts: Vec<Part>,
    pub(super) worlds: Vec<Constants>,
    pub(super) classes: Vec<Class>,
    pub(super) places: Vec<Vec2>,
    /// The elements that its tasks use.
    used: Elements,
    /// An upper bound of the tasks in [`Buffer::Tasks`]: each of its tasks once per round, and those that align the first of
    /// each part.
    laid_out: usize,
    /// Maximum jobs that gather its policies.
    jobs: usize,
    /// The words of all sums and their status words, 0 if the whole record is copied; and the `scoring` of the shader.
    counted: usize,
    scoring: Vec<u32>,
}

impl BatchPlan {
    /// Reports whether `teams` more teams of a group exceed the capacity, with the group's world and positions.
    fn is_full(&self, plan: &GroupPlan<'_>, teams: usize, capacity: Capacity) -> bool {
        let more = teams as u64 * plan.bytes_per_team;
        let world = plan.group.world;
        let (tasks, jobs) = (self.laid_out + TASK_ALIGNMENT * plan.part.rounds(), self.jobs + gather_jobs(world));
        let places = self.places.len()
            + plan.group.starts.len()
            + 3 * world.pois.len()
            + 2 * world.classes.len()
            + world.headings.len();
        let of_groups = [
            places * size_of::<Vec2>(),
            (self.worlds.len() + 1) * size_of::<Constants>(),
            (self.classes.len() + world.classes.len()) * size_of::<Class>(),
            tasks * size_of::<Task>(),
            jobs * BINDING_ALIGNMENT,
        ];
        self.used.largest() + more > capacity.target()
            || of_groups.into_iter().any(|bytes| bytes as u64 > capacity.target())
    }

    /// Begins a group's part: stores its world, starts and POIs, and returns a task that refers to them.
    fn store(&mut self, plan: &GroupPlan<'_>) -> Task {
        let Group { world, starts, .. } = *plan.group;
        let (index, first) = (self.worlds.len() as u32, self.places.len() as u32);
        self.places.extend(&starts[..world.agents()]);
        self.places.extend(plan.group.pois());
        // The shader finds headings behind the POIs, and then more about these.
        self.places.extend(plan.group.headings());
        self.places.extend(world.radii2.iter().zip(&world.values).map(|(&radius2, &value)| Vec2::new(radius2, value)));
        if !world.gone_within.is_empty() {
            let first = self.places.len();
            self.places.resize(first + world.pois.len(), Vec2::new(NOTHING, 0.0));
            for GoneWithin { poi, distance2, classes } in &world.gone_within {
                let bits = classes.iter().map(|class| 1u32 << class).sum::<u32>();
                self.places[first + poi] = Vec2::new(*distance2, bits as f32);
            }
        }
        if plan.part.shape.is_large() {
            for (class, word) in world.classes.iter().zip(cell_words(world).0) {
                let grid = Grid::new(world, class);
                let numbers = [grid.columns as f32, grid.rows as f32, grid.inverse, word as f32];
                self.places.extend([Vec2::new(numbers[0], numbers[1]), Vec2::new(numbers[2], numbers[3])]);
            }
        }
        self.laid_out += (TASK_ALIGNMENT - 1) * plan.part.rounds();
        self.jobs += gather_jobs(world);
        self.worlds.push(Constants { first_class: self.classes.len() as u32, ..world.constants });
        self.classes.extend(&world.classes);
        self.parts.push(Part { tasks: self.tasks.len()..self.tasks.len(), ..plan.part.clone() });
        let (pois, end) = (first + world.agents() as u32, world.constants.steps);
        Task { world: index, starts: first, pois, end, counted: NOWHERE, ..Task::default() }
    }

    /// Adds a task to the last part. `stored` refers to its group's world.
    fn push(&mut self, plan: &GroupPlan<'_>, first_team: usize, teams: usize, stored: Task) {
        let (used, per_team, sets) = (&mut self.used, plan.per_team, plan.group.world.set_words() * teams);
        let task = Task {
            weights: used.weights as u32,
            sets: used.record as u32,
            counts: (used.record + sets) as u32,
            traced: used.traced as u32,
            states: used.states as u32,
            teams: teams as u32,
            status: (used.record + per_team.record * teams) as u32,
            ..stored
        };
        used.record += per_team.record * teams + plan.after_record;
        used.weights += per_team.weights * teams;
        used.traced += per_team.traced * teams;
        used.states += per_team.states * teams;
        self.laid_out += plan.part.rounds();
        self.tasks.push(PlannedTask { group: plan.part.group, first_team, task });
        self.parts.last_mut().expect("a part has begun").tasks.end = self.tasks.len();
    }

    /// Lays out the sums, unless the whole record is requested, scores need more, one dispatch would take too long, or the
    /// sums would be no smaller.
    fn count(&mut self, groups: &[Group<'_>], records: Records) {
        let largest = |part: &Part| self.tasks[part.tasks.start].task.teams as usize;
        let of_part = |part: &Part| {
            let fits = |counting: &Counting<'_>| counting.iterations(largest(part)) <= MAX_ITERATIONS;
            Counting::of(&groups[part.group]).filter(fits)
        };
        let Some(countings) = self.parts.iter().map(of_part).collect::<Option<Vec<_>>>() else { return };
        let words_of = |(counting, part): (&Counting<'_>, &Part)| {
            let of_task = |planned: &PlannedTask| counting.words(planned.task.teams as usize) + STATUS;
            self.tasks[part.tasks.clone()].iter().map(of_task).sum::<usize>()
        };
        let counted: usize = countings.iter().zip(&self.parts).map(words_of).sum();
        let tables: Vec<Vec<u32>> = countings.iter().map(Counting::scoring).collect();
        let copied = counted + tables.iter().map(Vec::len).sum::<usize>();
        if !records.counts(self.used.bytes()[0]) || copied >= self.used.record {
            return;
        }
        self.counted = counted;
        let mut end = 0;
        for ((counting, part), table) in countings.iter().zip(&self.parts).zip(tables) {
            let (scoring, kinds) = (self.scoring.len() as u32, counting.kinds());
            self.scoring.extend(table);
            for PlannedTask { task, .. } in &mut self.tasks[part.tasks.clone()] {
                (task.scoring, task.kinds, task.counted) = (scoring, kinds, end as u32);
                end += counting.words(task.teams as usize) + STATUS;
            }
        }
    }

    /// Returns the number of nonces that its status words need.
    pub(super) fn rounds(&self) -> usize {
        self.parts.iter().map(Part::rounds).max().unwrap_or(0)
    }

    /// Gathers the weights of every task whose policies are on the host, and leaves room for the others.
    pub(super) fn stage(&self, groups: &[Group<'_>], staging: &mut Vec<WeightVector>) {
        for part in &self.parts {
            let group = &groups[part.group];
            let Weights::OnHost(weights) = group.weights else { continue };
            staging.resize(self.used.weights, WeightVector::default());
            let (tasks, staged) = (&self.tasks[part.tasks.clone()], &mut staging[self.weights(part, groups)]);
            let per_task = tasks[0].task.teams as usize * weight_vectors(group.world);
            tasks.par_iter().zip(staged.par_chunks_mut(per_task)).for_each(|(planned, staged)| {
                gather(group, weights, planned.first_team, planned.task.teams as usize, staged);
            });
        }
    }

    /// Returns the range of a part's weights, in vectors.
    fn weights(&self, part: &Part, groups: &[Group<'_>]) -> Range<usize> {
        let tasks = &self.tasks[part.tasks.clone()];
        let teams: u32 = tasks.iter().map(|planned| planned.task.teams).sum();
        let first = tasks[0].task.weights as usize;
        first..first + teams as usize * weight_vectors(groups[part.group].world)
    }

    /// Returns everything that the batch does on a device.
    pub(super) fn record<'a>(&'a self, options: &RecordingOptions<'a>) -> (Recording<'a>, BatchReadback) {
        let &RecordingOptions { groups, held, weights: staging, trace, nonce, .. } = options;
        let mut recording = Recording::new("episodes");
        let [record, weights, traced, states] = self.used.bytes();
        let (tasks, runs) = self.lay_out(groups, nonce);
        let worlds = recording.input(Buffer::Worlds, &self.worlds);
        recording.input(Buffer::Tasks, tasks);
        let places = recording.input(Buffer::Places, &self.places);
        let classes = recording.input(Buffer::Classes, &self.classes);
        let [weights, record, traced, states] =
            [(Buffer::Weights, weights), (Buffer::Record, record), (Buffer::Traced, traced), (Buffer::States, states)]
                .map(|(buffer, bytes)| recording.buffer(buffer, bytes));
        for parts in self.parts.chunk_by(|a, b| a.is_on_host(groups) == b.is_on_host(groups)) {
            if parts[0].is_on_host(groups) {
                let end = self.weights(&parts[parts.len() - 1], groups).end;
                let range = self.weights(&parts[0], groups).start..end;
                let offset = (range.start * size_of::<WeightVector>()) as u64;
                recording.upload(Buffer::Weights, offset, &staging[range]);
            }
        }
        self.record_gathering(options, weights.clone(), &mut recording);
        let counting = (self.counted > 0).then(|| {
            let counted = recording.buffer(Buffer::Counted, words(self.counted));
            (counted, recording.input(Buffer::Scoring, &self.scoring))
        });
        // The dispatches, in submissions of at most `cap` iterations, and then those that count.
        let most = options.most_workgroups as usize / TASK_ALIGNMENT * TASK_ALIGNMENT;
        let (mut count, mut load) = (Vec::new(), 0);
        for Run { dispatches, is_first_round, mut tasks, iterations: per_task, counting: per_count } in runs {
            while !tasks.is_empty() {
                let allowed = (options.cap.saturating_sub(load) / per_task) as usize / TASK_ALIGNMENT * TASK_ALIGNMENT;
                if allowed == 0 && load > 0 {
                    recording.commands.push(Command::Submit);
                    load = 0;
                    continue;
                }
                let part = tasks.start..tasks.end.min(tasks.start + allowed.clamp(TASK_ALIGNMENT, most));
                tasks.start = part.end;
                let work = part.len() as u64 * per_task;
                load += work;
                let workgroups = part.len() as u32;
                let bytes = (part.start * size_of::<Task>()) as u64..(part.end * size_of::<Task>()) as u64;
                let tasks = Slice { buffer: Buffer::Tasks, bytes };
                if let (Some((counted, scoring)), true) = (&counting, is_first_round) {
                    let bindings = [&worlds, &tasks, scoring, counted, &record].map(Slice::clone).into();
                    let (grid, iterations) = ([workgroups, 1, 1], part.len() as u64 * per_count);
                    count.push((
                        iterations,
                        Command::Dispatch { pipeline: Pipeline::Count, bindings, grid, iterations },
                    ));
                }
                for (index, &(pipeline, several)) in dispatches.iter().enumerate() {
                    let bindings = [&worlds, &tasks, &places, &weights, &record, &traced, &states, &classes];
                    let bindings = bindings.map(Slice::clone).into();
                    let grid = several.map_or([workgroups, 1, 1], |several| [several as u32, workgroups, 1]);
                    let iterations = if index + 1 == dispatches.len() { work } else { 0 };
                    recording.commands.push(Command::Dispatch { pipeline, bindings, grid, iterations });
                }
            }
        }
        for (work, command) in count {
            if load > 0 && load + work > options.cap {
                recording.commands.push(Command::Submit);
                load = 0;
            }
            load += work;
            recording.commands.push(command);
        }
        // Its status words stand for everything before it, so this is read back last.
        let [.., traced_bytes, _] = self.used.bytes();
        let traced = if trace { recording.read_back(first(Buffer::Traced, traced_bytes)) } else { 0..0 };
        for group in self.parts.iter().map(|part| part.group) {
            if let Some(held) = held[group] {
                recording.read_status(Buffer::GroupStatus(group), &held.status);
            }
        }
        let read = match self.counted {
            0 => recording.read_back(first(Buffer::Record, self.used.bytes()[0])),
            counted => recording.read_back(first(Buffer::Counted, words(counted))),
        };
        // A status word stays as it is if the device did not play the task.
        for part in &self.parts {
            let status = nonce.wrapping_add(part.rounds() as u32 - 1);
            let counting = Counting::of(&groups[part.group]).filter(|_| self.counted > 0);
            let expect = |PlannedTask { task, .. }: &PlannedTask| {
                let at = match counting {
                    Some(counting) => task.counted as usize + counting.words(task.teams as usize),
                    None => task.status as usize,
                };
                (read.start + words(at) as usize, status)
            };
            recording.readback.status.extend(self.tasks[part.tasks.clone()].iter().map(expect));
        }
        (recording, BatchReadback { traced, words: read })
    }

    /// Lays out the tasks of all rounds. In each round the tasks of a shape are consecutive, and the first is at an
    /// offset where a binding may start.
    fn lay_out(&self, groups: &[Group<'_>], nonce: u32) -> (Vec<Task>, Vec<Run>) {
        let shapes: BTreeSet<Shape> = self.parts.iter().map(|part| part.shape).collect();
        let (mut tasks, mut runs): (Vec<Task>, Vec<Run>) = Default::default();
        for (round, &shape) in (0..self.rounds()).flat_map(|round| shapes.iter().map(move |shape| (round, shape))) {
            tasks.resize(tasks.len().next_multiple_of(TASK_ALIGNMENT), Task::default());
            let (first, mut iterations, mut counting) = (tasks.len(), 1, 0);
            for part in self.parts.iter().filter(|part| part.shape == shape && round < part.rounds()) {
                let steps = part.round(round);
                iterations = iterations.max((steps.len() * part.iterations_per_step) as u64);
                let teams = self.tasks[part.tasks.start].task.teams as usize;
                let counted = Counting::of(&groups[part.group]).map_or(0, |counting| counting.iterations(teams));
                counting = counting.max((counted * COUNT_WORKGROUP) as u64);
                let (first, end) = (steps.start as u32, steps.end as u32);
                let of_round = |planned: &PlannedTask| Task { first, end, nonce, ..planned.task };
                tasks.extend(self.tasks[part.tasks.clone()].iter().map(of_round));
            }
            if tasks.len() > first {
                let (tasks, is_first_round) = (first..tasks.len(), round == 0);
                let dispatches = self.dispatches(groups, shape, is_first_round);
                runs.push(Run { dispatches, is_first_round, tasks, iterations, counting });
            }
        }
        (tasks, runs)
    }

    /// Returns the dispatches of a round of a shape: pipelines and, if a task takes several, the workgroups of each task.
    fn dispatches(&self, groups: &[Group<'_>], shape: Shape, is_first_round: bool) -> Vec<(Pipeline, Option<usize>)> {
        if !shape.is_large() {
            return vec![(Pipeline::Episode(shape), None)];
        }
        let parts = self.parts.iter().filter(|part| part.shape == shape);
        let worlds: Vec<&World> = parts.map(|part| groups[part.group].world).collect();
        let dispatch = |&(_, part): &(_, SwarmPart)| {
            let most = worlds.iter().map(|world| workgroups(part, world, shape.workgroup)).max();
            (Pipeline::Swarm(part, shape), most)
        };
        // The first two only start an episode.
        SwarmPart::ALL[if is_first_round { 0 } else { 2 }..].iter().map(dispatch).collect()
    }

    /// Records how policies are gathered from populations on the device.
    fn record_gathering<'a>(&self, options: &RecordingOptions<'a>, weights: Slice, recording: &mut Recording<'a>) {
        let (mut jobs, mut policies, mut chosen): (Vec<GatherJob>, Vec<[Slice; LEADERS_PER_GATHER]>, _) =
            (Vec::new(), Vec::new(), 0);
        for part in &self.parts {
            let (index, group, tasks) = (part.group, &options.groups[part.group], &self.tasks[part.tasks.clone()]);
            let Some(held) = options.held[index] else { continue };
            let leaders = group.world.leaders();
            let teams: u32 = tasks.iter().map(|planned| planned.task.teams).sum();
            let choices = &group.teams[tasks[0].first_team * leaders..][..teams as usize * leaders];
            for first in (0..leaders).step_by(LEADERS_PER_GATHER) {
                let count = LEADERS_PER_GATHER.min(leaders - first);
                jobs.push(GatherJob {
                    leaders: leaders as u32,
                    first: first as u32,
                    count: count as u32,
                    parameters: group.world.constants.policy.parameters,
                    teams,
                    teams_per_task: tasks[0].task.teams,
                    choices: chosen as u32,
                    weights: tasks[0].task.weights,
                });
                // With fewer leaders, the remaining bindings are not read.
                policies.push(std::array::from_fn(|leader| {
                    held.policies_of(index, group.populations[first + leader.min(count - 1)] as usize)
                }));
            }
            recording.upload(Buffer::Choices, words(chosen), choices);
            chosen += choices.len();
        }
        if jobs.is_empty() {
            return;
        }
        let choices = recording.buffer(Buffer::Choices, words(chosen));
        let parts = recording.jobs(Buffer::Jobs, &jobs);
        for ((job, part), [first, second, third, fourth]) in jobs.iter().zip(parts).zip(policies) {
            recording.commands.push(Command::Dispatch {
                pipeline: Pipeline::Gather,
                bindings: vec![part, choices.clone(), first, weights.clone(), second, third, fourth],
                grid: grid(job.workgroups(), options.most_workgroups),
                iterations: 0,
            });
        }
    }
}

/// Tasks of one shape and round.
struct Run {
    /// See [`BatchPlan::dispatches`].
    dispatches: Vec<(Pipeline, Option<usize>)>,
    is_first_round: bool,
    tasks: Range<usize>,
    /// The estimated work of a task.
    iterations: u64,
    /// The estimated work of counting it.
    counting: u64,
}

/// The inputs of a batch's recording besides its plan.
#[derive(Clone, Copy)]
pub(super) struct RecordingOptions<'a> {
    pub(super) groups: &'a [Group<'a>],
    /// The populations that each group plays, if they are on the device.
    pub(super) held: &'a [Option<&'a Held>],
    /// The weights of policies on the host, see [`BatchPlan::stage`].
    pub(super) weights: &'a [WeightVector],
    pub(super) trace: bool,
    /// The first of [`BatchPlan::rounds`] nonces.
    pub(super) nonce: u32,
    /// Maximum iterations per submission.
    pub(super) cap: u64,
    /// Maximum workgroups in each dimension of a dispatch.
    pub(super) most_workgroups: u32,
}

/// The places of a batch's results in [`Buffer::Readback`], in bytes.
#[derive(Default)]
pub(super) struct BatchReadback {
    pub(super) traced: Range<usize>,
    /// The sums, or the whole record.
    pub(super) words: Range<usize>,
}

/// Returns the first bytes of a buffer.
fn first(buffer: Buffer, bytes: u64) -> Slice {
    Slice { buffer, bytes: 0..bytes }
}

/// Returns the bytes of some words.
fn words(count: usize) -> u64 {
    (count * size_of::<u32>()) as u64
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
        batches.iter_mut().for_each(|batch| batch.count(groups, records));
    }
    Ok(batches)
}

/// Writes a task's weights, `[vectors of a policy's weights][leaders][teams]`, so that neighbouring threads load
/// neighbouring weights.
pub(super) fn gather(group: &Group<'_>, weights: &[f32], first_team: usize, teams: usize, to: &mut [WeightVector]) {
    let (leaders, parameters) = (group.world.leaders(), group.world.parameters());
    let policies = &group.teams[first_team * leaders..(first_team + teams) * leaders];
    for (place, &policy) in policies.iter().enumerate() {
        let (team, leader) = (place / leaders, place % leaders);
        let from = group.place(leader, policy as usize);
        let column = to[leader * teams + team..].iter_mut().step_by(leaders * teams);
        for (vector, weights) in column.zip(weights[from..from + parameters].chunks(VECTOR)) {
            vector[..weights.len()].copy_from_slice(weights);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::BATCH_BYTES;
    use crate::backend::gpu::recording::iterations;
    use crate::config::{Config, Fitness};

    /// Returns a world of one leader, 255 followers and one POI. Episodes of more than about 40 steps take several
    /// dispatches.
    fn crowd(steps: usize) -> World {
        let followers = vec!["[2, 2]"; 255].join(", ");
        let text =
            format!("[world]\nleaders = [[1, 1]]\nfollowers = [{followers}]\npois = [[9, 9]]\nsteps = {steps}\n");
        World::new(&Config::parse(&text, "large").unwrap().validate().unwrap())
    }

    /// Plans groups, `(teams, world)` each, and checks the recording of every batch. Returns the numbers of batches,
    /// submissions, and dispatches that play.
    fn check(groups: &[(usize, &World)], buffer: u64, limits: [u64; 2], records: Records, is_held: bool) -> [usize; 3] {
        check_from(groups, buffer, limits, records, is_held, LARGE_FROM)
    }

    /// [`check`] with large teams of at least so many agents.
    fn check_from(
        groups: &[(usize, &World)],
        buffer: u64,
        [cap, most_workgroups]: [u64; 2],
        records: Records,
        is_held: bool,
        large_from: usize,
    ) -> [usize; 3] {
        let held = Held { sizes: [1, 1, groups[0].1.parameters()], turn: 1, status: vec![7, 8] };
        let (weights, choices) = (vec![0.0; groups[0].1.parameters()], vec![0; 30_000]);
        let shared = &choices[..];
        let groups = groups.iter().map(|&(teams, world)| Group {
            populations: &shared[..world.leaders()],
            fitnesses: &[Fitness::Df],
            ..Group::new(world, &weights[..], 1, &choices[..teams])
        });
        let groups: Vec<Group<'_>> = groups.collect();
        let capacity = Capacity { batch: BATCH_BYTES, buffer, large_from, ..Capacity::of_workgroups(256) };
        let batches = plan(&groups, false, records, capacity, &HashSet::new()).unwrap();
        // Every team is in one task.
        let mut next = vec![0; groups.len()];
        for planned in batches.iter().flat_map(|batch| &batch.tasks) {
            assert_eq!(planned.first_team, next[planned.group]);
            next[planned.group] += planned.task.teams as usize;
        }
        assert_eq!(next, groups.iter().map(Group::team_count).collect::<Vec<_>>());
        let held: Vec<_> = groups.iter().map(|_| Some(&held).filter(|_| is_held)).collect();
        let (mut weights, most_workgroups) = (Vec::new(), most_workgroups as u32);
        let mut counts = [batches.len(), 0, 0];
        for batch in &batches {
            batch.stage(&groups, &mut weights);
            let (groups, held, weights) = (&groups[..], &held[..], &weights[..]);
            let options = RecordingOptions { groups, held, weights, trace: false, nonce: 5, cap, most_workgroups };
            let (recording, _) = batch.record(&options);
            let held = if is_held { 2 * batch.worlds.len() } else { 0 };
            assert_eq!(recording.readback.status.len(), batch.tasks.len() + held);
            counts[1] += recording.submissions().count();
            counts[2] += check_recording(&recording, batch, [cap, buffer], most_workgroups);
        }
        counts
    }

    /// Checks one recording. Returns its dispatches that play.
    fn check_recording(recording: &Recording<'_>, batch: &BatchPlan, [cap, buffer]: [u64; 2], most: u32) -> usize {
        let bytes_of = |buffer| recording.buffers.iter().find(|(other, _)| *other == buffer).map(|(_, bytes)| *bytes);
        let fits = |slice: &Slice| bytes_of(slice.buffer).is_none_or(|bytes| slice.bytes.end <= bytes);
        let too_large = recording.buffers.iter().find(|(_, bytes)| *bytes > buffer);
        assert_eq!(too_large, None);
        let (mut tasks, mut played): (Vec<Task>, Vec<Task>) = Default::default();
        let (mut counted, mut copied, mut dispatches) = (0, 0, 0);
        for command in &recording.commands {
            match command {
                Command::Upload { to, offset, bytes } => {
                    assert!(offset + bytes.len() as u64 <= bytes_of(*to).unwrap(), "{to:?} is too small");
                    if *to == Buffer::Tasks {
                        tasks = bytemuck::pod_collect_to_vec(bytes);
                    }
                }
                Command::Dispatch { pipeline, bindings, grid, .. } => {
                    assert_eq!(bindings.len(), pipeline.bindings().len());
                    assert!(bindings.iter().all(fits) && grid.iter().all(|&count| count <= most), "{grid:?}");
                    assert!(bindings.iter().all(|slice| slice.bytes.start % BINDING_ALIGNMENT as u64 == 0));
                    let Some(slice) = bindings.iter().find(|slice| slice.buffer == Buffer::Tasks) else { continue };
                    let [start, end] = [slice.bytes.start, slice.bytes.end].map(|at| at as usize / size_of::<Task>());
                    let per_task = if let Pipeline::Swarm(..) = pipeline { grid[0] } else { 1 };
                    assert_eq!(grid.iter().product::<u32>() as usize, (end - start) * per_task as usize);
                    if *pipeline == Pipeline::Count {
                        counted += tasks[start..end].iter().map(|task| task.teams).sum::<u32>();
                    } else if let Pipeline::Swarm(part, _) = pipeline {
                        // The last of each step has its work.
                        played.extend(tasks[start..end].iter().filter(|_| *part == SwarmPart::ObeyRule));
                        dispatches += 1;
                    } else {
                        played.extend(&tasks[start..end]);
                        dispatches += 1;
                    }
                }
                Command::ReadBack { from, offset } => {
                    assert!(fits(from) && *offset == copied, "{from:?}");
                    copied += from.bytes.end - from.bytes.start;
                }
                Command::Submit => {}
            }
        }
        for commands in recording.submissions() {
            let playing = |command: &&Command<'_>| matches!(command, Command::Dispatch { iterations: 1.., .. });
            assert!(iterations(commands) <= cap || commands.iter().filter(playing).count() == 1);
        }
        // Every task plays each of its steps once, in order.
        for planned in &batch.tasks {
            let own = played.iter().filter(|task| task.teams > 0 && task.status == planned.task.status);
            let last = own.fold(0, |end, task| {
                assert_eq!((task.first, task.teams), (end, planned.task.teams));
                task.end
            });
            assert_eq!(last, planned.task.end);
        }
        let teams: u32 = batch.tasks.iter().map(|planned| planned.task.teams).sum();
        assert_eq!(counted, if batch.counted > 0 { teams } else { 0 });
        // Tasks follow each other in every buffer, without overlap.
        for pair in batch.tasks.windows(2) {
            let [before, after] = [pair[0].task, pair[1].task];
            assert!(before.sets < before.counts && before.counts < before.status && before.status < after.sets);
            assert!(before.weights < after.weights && before.states <= after.states);
            assert!(batch.counted == 0 || before.counted + (STATUS as u32) < after.counted);
        }
        dispatches
    }

    /// A small batch is one submission of one dispatch. Low caps, limits on workgroups, long episodes, small buffers and
    /// many groups split work. Either way every team plays every step once, in memory of its own.
    #[test]
    fn recordings_play_every_team_once() {
        const FREE: [u64; 2] = [u64::MAX, 65_535];
        let (short, long) = (crowd(20), crowd(60));
        let both = [(150, &short), (150, &long)];
        // Batches, submissions, and dispatches that play.
        let found = [
            check(&[(3, &short)], 1 << 20, FREE, Records::Whole, false),
            check(&[(3, &short)], 1 << 20, FREE, Records::CountedFrom(0), true),
            // The long episode takes a second round.
            check(&both, 1 << 24, FREE, Records::CountedFrom(0), false),
            // 300 tasks in dispatches of 8, then 150.
            check(&both, 1 << 24, [u64::MAX, 8], Records::Whole, true),
            // The smallest dispatches have 4 tasks. So do those that count.
            check(&both, 1 << 24, [1, 65_535], Records::CountedFrom(0), true),
            // 4 tasks of the first round stay below the cap, or 12 of the second.
            check(&both, 1 << 24, [1 << 26, 65_535], Records::Whole, false),
            // Agents that wait between two dispatches count towards a batch, too.
            check(&[(27_000, &long)], 1 << 20, FREE, Records::Whole, false),
            // With one team per group, classes of agents take more than records and weights.
            check(&[(1, &short); 1000], 1 << 20, FREE, Records::Whole, false),
        ];
        let one_batch = [[1, 1, 1], [1, 1, 1], [1, 1, 2], [1, 1, 38 + 19], [1, 75 + 38 + 75, 75 + 38], [1, 94, 94]];
        assert_eq!(found[..6], one_batch);
        assert_eq!(found[6..], [[133, 133, 266], [5, 5, 5]]);
        assert_eq!(dispatch_bytes(&long, RecordRequest(&[Fitness::Df])), [256 * 20, 2 * 64]);
    }

    /// If each step is a dispatch of its own, the tasks of all steps take more than records.
    #[test]
    fn tasks_of_many_dispatches_fill_a_batch() {
        let senses = ["{ of = 'agents', sectors = 16 }"; 4].join(", ");
        let text = format!(
            "[world]\nsteps = 100\n[[agents]]\nname = 'leader'\nat = [[1, 1]]\nleads = 'follower'\nsenses = [{senses}]\n\
             [[agents]]\nname = 'follower'\ncontrol = 'follow'\nat = [{}]\nrule = [{{ of = 'leader', to = 9, gain = 1 }}]\n\
             [[pois]]\nname = 'place'\nat = [[9, 9]]\n",
            ["[2, 2]"; 255].join(", ")
        );
        let world = World::new(&Config::parse(&text, "many steps").unwrap().validate().unwrap());
        let found = check(&[(300, &world)], 1 << 20, [u64::MAX, 65_535], Records::Whole, false);
        assert_eq!(found, [2, 2, 200]);
        assert_eq!(dispatch_bytes(&world, RecordRequest(&[Fitness::Df]))[1], 100 * 64);
    }

    /// Each step of large teams takes four dispatches, after two at the start. Each team is a task.
    #[test]
    fn recordings_of_large_teams_play_every_step_once() {
        const FREE: [u64; 2] = [u64::MAX, 65_535];
        let (short, long) = (crowd(20), crowd(60));
        let check = |groups: &[(usize, &World)], limits| check_from(groups, 1 << 24, limits, Records::Whole, true, 256);
        assert_eq!(check(&[(3, &short)], FREE), [1, 1, 2 + 4 * 20]);
        assert_eq!(check(&[(3, &short), (2, &long)], FREE), [1, 1, 2 + 4 * 60]);
        // Every step is a submission.
        assert_eq!(check(&[(3, &short)], [1, 65_535]), [1, 20, 2 + 4 * 20]);
    }
}
