//! Kernels of episodes: what each is compiled for, and how teams are packed into its workgroups.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Mutex;

use glam::Vec2;

use crate::backend::Group;
use crate::backend::grid::{LARGE_FROM, is_large};
use crate::config::MAX_HIDDEN_LAYERS;
use crate::config_enum::config_enum;
use crate::model::Constants;
use crate::model::class::{Class, ClassShape};
use crate::model::follow::TermShape;
use crate::model::policy::Actions;
use crate::model::sense::ChannelShape;
use crate::parallel::lock;
use crate::world::World;

/// Maximum bytes of a buffer, because offsets are u32 words.
pub(super) const MAX_OFFSET: u64 = 1 << 33;
/// Threads of a warp on most GPUs. Classes start at multiples of it, so that two rarely share a warp.
pub(super) const ROLE: usize = 32;
/// Workgroup sizes that the generic kernel may have. Every WebGPU device allows them.
pub(super) const WORKGROUPS: [usize; 3] = [64, 128, 256];
/// Teams per workgroup that a specialised kernel may have, best first: 32 teams fill a warp with one agent of each.
pub(super) const TEAMS: [usize; 3] = [32, 16, 8];
/// Maximum threads per workgroup of a specialised kernel: two or more workgroups then fit into a compute unit and hide
/// each other's latency.
pub(super) const MAX_THREADS: usize = 512;
/// Minimum width that the generic kernel has room for: the inputs that behaviours use.
const LEAST_WIDTH: usize = 8;
/// Maximum weights of a policy that are written out as straight-line code.
const MAX_STRAIGHT_WEIGHTS: usize = 512;
/// Maximum number of specialised kernels per rollout under [`Kernel::Best`]: each takes a fraction of a second to compile.
const MAX_SPECIALISED: usize = 16;

config_enum! {
    /// Selects the kernel that plays. Results do not depend on it.
    Kernel {
        /// In rollouts a specialised kernel for the kinds of worlds with most to play, up to a limit. Otherwise the
        /// generic one.
        Best = "best",
        /// The generic kernel.
        Generic = "generic",
        /// A specialised kernel wherever one is possible.
        Specialised = "specialised",
    }
}

/// Everything that an episode's kernel is compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Shape {
    /// Threads per workgroup.
    pub(super) workgroup: usize,
    /// Agents that a thread plays, one after another.
    pub(super) slots: usize,
    /// Whether it records all quantities of every step.
    pub(super) trace: bool,
    pub(super) sizes: Sizes,
}

/// Additional records of episodes, besides sets and counts.
#[derive(Clone, Copy)]
pub struct Recorded {
    /// All quantities of every step.
    pub(super) trace: bool,
    /// The leaders that each follower sees at each step.
    pub(super) sightings: bool,
}

impl Recorded {
    pub(super) fn of(group: &Group<'_>, trace: bool) -> Recorded {
        Recorded { trace, sightings: group.records().sights() && group.world.followers() > 0 }
    }
}

/// The sizes that a kernel is compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Sizes {
    /// The widest layer, inputs included and rounded up to save compilations, and whether teams are large: each step
    /// then takes several dispatches.
    Any { widest: usize, large: bool },
    /// Everything that the code depends on.
    Fixed {
        teams: usize,
        leaders: u32,
        agents: u32,
        pois: u32,
        widths: [u32; WIDTHS],
        kinds: &'static [ClassKind],
        /// Whether the outputs of policies choose a behaviour.
        chooses: bool,
        /// Whether any POI is gone once an observer has come near.
        gone: bool,
        sightings: bool,
    },
}

/// The shapes of a class, its channels and its terms.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClassKind {
    pub(super) shape: ClassShape,
    pub(super) channels: Vec<ChannelShape>,
    pub(super) terms: Vec<TermShape>,
}

impl ClassKind {
    /// Returns the kinds of all classes of a world. Each list is kept for as long as the process runs, so that a [`Shape`]
    /// is small.
    fn of(world: &World) -> &'static [ClassKind] {
        static KEPT: Mutex<BTreeSet<&'static [ClassKind]>> = Mutex::new(BTreeSet::new());
        let kind = |class: &Class| ClassKind {
            shape: class.constants.shape,
            channels: class.channels().iter().map(|channel| channel.shape).collect(),
            terms: class.terms().iter().map(|term| term.shape).collect(),
        };
        let kinds: Vec<ClassKind> = world.classes.iter().map(kind).collect();
        let mut kept = lock(&KEPT);
        if let Some(kinds) = kept.get(&kinds[..]) {
            return kinds;
        }
        let kinds: &'static [ClassKind] = kinds.leak();
        kept.insert(kinds);
        kinds
    }
}

pub(super) const WIDTHS: usize = MAX_HIDDEN_LAYERS + 2;

impl Shape {
    /// Reports whether the kernel is for worlds of these sizes only.
    pub(super) fn is_specialised(&self) -> bool {
        matches!(self.sizes, Sizes::Fixed { .. })
    }

    /// Returns the kernel that plays any world with policies up to this width.
    pub(super) fn generic(world: &World, capacity: Capacity, trace: bool) -> (Shape, Workgroup) {
        let large = is_large(world, capacity.large_from);
        let workgroup = match large {
            true => Workgroup { threads: WORKGROUPS[0], slots: 1, teams: 1 },
            false => Workgroup::generic(world, capacity.workgroup),
        };
        let widest = world.constants.policy.widest().next_power_of_two().max(LEAST_WIDTH);
        Shape::new(workgroup, trace, Sizes::Any { widest, large })
    }

    fn new(workgroup: Workgroup, trace: bool, sizes: Sizes) -> (Shape, Workgroup) {
        let Workgroup { threads, slots, .. } = workgroup;
        (Shape { workgroup: threads, slots, trace, sizes }, workgroup)
    }

    /// Reports whether each step takes several dispatches.
    pub(super) fn is_large(&self) -> bool {
        matches!(self.sizes, Sizes::Any { large: true, .. })
    }

    /// Returns the kernel that plays worlds of these sizes only, if one is possible.
    pub(super) fn specialised(world: &World, capacity: Capacity, records: Recorded) -> Option<(Shape, Workgroup)> {
        let workgroup = Workgroup::specialised(world, capacity).filter(|_| !is_large(world, capacity.large_from))?;
        let Constants { leaders, followers, pois, policy, gone, .. } = world.constants;
        let sizes = Sizes::Fixed {
            teams: workgroup.teams,
            leaders,
            agents: leaders + followers,
            pois,
            widths: policy.widths,
            kinds: ClassKind::of(world),
            // Policies that choose agents may have fewer outputs than there are behaviours.
            chooses: policy.actions() == Actions::Behaviours && world.choices().contains(&0),
            gone: gone != 0,
            sightings: records.sightings,
        };
        Some(Shape::new(workgroup, records.trace, sizes))
    }
}

/// Returns the shapes of some groups that get a specialised kernel. Under [`Kernel::Best`] these are the compiled ones,
/// and of the others those with most agent-steps, up to [`MAX_SPECIALISED`] in all. Traces are not worth a compilation.
pub(super) fn specialised_shapes(
    groups: &[Group<'_>],
    trace: bool,
    kernel: Kernel,
    capacity: Capacity,
    is_compiled: &dyn Fn(Shape) -> bool,
) -> HashSet<Shape> {
    if kernel == Kernel::Generic || kernel == Kernel::Best && trace {
        return HashSet::new();
    }
    let mut agent_steps: BTreeMap<Shape, usize> = BTreeMap::new();
    for group in groups {
        if let Some((shape, _)) = Shape::specialised(group.world, capacity, Recorded::of(group, trace)) {
            *agent_steps.entry(shape).or_default() += group.team_count() * group.world.agents() * group.world.steps();
        }
    }
    let mut shapes: Vec<_> = agent_steps.into_iter().collect();
    shapes.sort_by_key(|&(shape, agent_steps)| (!is_compiled(shape), Reverse(agent_steps)));
    let most = if kernel == Kernel::Best { MAX_SPECIALISED } else { usize::MAX };
    let shapes = shapes.into_iter().map(|(shape, _)| shape).enumerate();
    shapes.filter(|&(index, shape)| index < most || is_compiled(shape)).map(|(_, shape)| shape).collect()
}

/// A workgroup of one world's kernel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Workgroup {
    pub(super) threads: usize,
    /// Agents per thread.
    pub(super) slots: usize,
    /// Teams per workgroup.
    pub(super) teams: usize,
}

/// Returns the threads that `teams` teams need: each class starts at a multiple of [`ROLE`].
fn threads_needed(world: &World, teams: usize) -> usize {
    let add = |threads: usize, class: &Class| threads.next_multiple_of(ROLE) + teams * class.agents().len();
    world.classes.iter().fold(0, add)
}

impl Workgroup {
    /// Returns the workgroup of a specialised kernel: as many teams as a warp has threads, or as many as fit. `None` if
    /// there are too many agents or the policy is too large.
    pub(super) fn specialised(world: &World, capacity: Capacity) -> Option<Workgroup> {
        let threads = |teams: usize| threads_needed(world, teams).next_multiple_of(ROLE);
        let bytes = |teams: usize| 2 * teams * world.agents() * size_of::<Vec2>();
        let fits = |&teams: &usize| {
            threads(teams) <= capacity.workgroup.min(MAX_THREADS) && bytes(teams) <= capacity.workgroup_bytes
        };
        let teams = TEAMS.into_iter().find(fits).filter(|_| world.parameters() <= MAX_STRAIGHT_WEIGHTS)?;
        Some(Workgroup { threads: threads(teams), slots: 1, teams })
    }

    /// Returns the workgroup of the generic kernel that leaves the fewest threads idle.
    pub(super) fn generic(world: &World, largest: usize) -> Workgroup {
        let sizes = WORKGROUPS.into_iter().filter(|&size| size <= largest);
        let one_each = sizes.clone().filter_map(|threads| {
            let teams = (1..=threads).take_while(|&teams| threads_needed(world, teams) <= threads).last()?;
            Some(Workgroup { threads, slots: 1, teams })
        });
        // Compares the shares of busy threads by cross-multiplication. The smaller workgroup wins ties.
        one_each.reduce(|a, b| if b.teams * a.threads > a.teams * b.threads { b } else { a }).unwrap_or_else(|| {
            let threads = sizes.max().unwrap_or(WORKGROUPS[0]);
            Workgroup { threads, slots: threads_needed(world, 1).div_ceil(threads), teams: 1 }
        })
    }
}

/// The limits of a device that bound a batch.
#[derive(Clone, Copy, Debug)]
pub(super) struct Capacity {
    /// Target bytes of one buffer.
    pub(super) batch: u64,
    /// Maximum bytes of a buffer.
    pub(super) buffer: u64,
    /// Maximum threads per workgroup, and bytes of workgroup memory.
    pub(super) workgroup: usize,
    pub(super) workgroup_bytes: usize,
    /// Agents from which teams are large.
    pub(super) large_from: usize,
}

impl Capacity {
    /// Returns the bytes of one buffer after which a batch is full.
    pub(super) fn target(&self) -> u64 {
        self.buffer.min(self.batch)
    }

    /// Returns the limits of a device with this maximum of threads per workgroup, and no limit on batches.
    pub(super) fn of_workgroups(threads: usize) -> Capacity {
        let bytes = MAX_OFFSET;
        Capacity { batch: bytes, buffer: bytes, workgroup: threads, workgroup_bytes: 16 << 10, large_from: LARGE_FROM }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample;

    /// Software drivers take seconds to compile a kernel.
    #[test]
    fn random_worlds_share_few_generic_kernels() {
        let shape = |seed: u64| {
            let world = World::new(sample::any_world(seed).validate().unwrap().at(0));
            Shape::generic(&world, Capacity::of_workgroups(256), false).0
        };
        let shapes: HashSet<Shape> = (0..2000).map(shape).collect();
        assert!((2..=20).contains(&shapes.len()), "{} kernels", shapes.len());
    }
}
