//! The reference backend: one team a lane, one vector of teams a block, blocks shared out over threads.
//!
//! The loops here may skip whatever adds nothing (an agent out of reach of every lane), since sums start at +0 and
//! keep their order; the formulas are [`crate::model`]'s.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use fearless_simd::{Level, Simd, SimdMask, dispatch, f32x4, prelude::*};
use glam::Vec2;

use super::{Backend, BackendError, Episode, Group, Moment, Need, Seen, Strided, Trace, Visit, Weights};
use crate::declare::Fixed;
use crate::kernels::math::{self, within};
use crate::kernels::{only, splat};
use crate::model::policy::PolicyConstants;
use crate::model::{Constants, Lanes, couple, follow, motion, policy, sense};
use crate::parallel::*;
use crate::world::{INPUTS, OUTPUTS, World};

/// Plays episodes on the processor, at the widest instruction set it has, on the threads of the current rayon pool.
pub struct Cpu {
    level: Level,
}

impl Default for Cpu {
    fn default() -> Cpu {
        Cpu::at_level(Level::new())
    }
}

impl Cpu {
    /// A backend that uses a chosen instruction set (tests compare them; benches choose one).
    pub fn at_level(level: Level) -> Cpu {
        Cpu { level }
    }

    /// Every instruction set that this processor has, narrowest first; with the feature `scalar` also doing without
    /// one.
    pub fn levels() -> Vec<Level> {
        let best = Level::new();
        let mut levels = vec![Level::baseline()];
        #[cfg(feature = "scalar")]
        if !levels[0].is_fallback() {
            levels.insert(0, Level::fallback());
        }
        #[cfg(target_arch = "x86_64")]
        {
            levels.extend(best.as_sse4_2().map(Level::Sse4_2));
            levels.extend(best.as_avx2().map(Level::Avx2));
            levels.extend(best.as_avx512().map(Level::Avx512));
        }
        if levels.iter().all(|level| level_name(*level) != level_name(best)) {
            levels.push(best);
        }
        levels
    }
}

/// What people call an instruction set.
pub fn level_name(level: Level) -> &'static str {
    #[cfg(target_arch = "x86_64")]
    match level {
        Level::Sse2(_) => return "SSE2",
        Level::Sse4_2(_) => return "SSE4.2",
        Level::Avx2(_) => return "AVX2",
        Level::Avx512(_) => return "AVX-512",
        _ => {}
    }
    #[cfg(target_arch = "aarch64")]
    if level.as_neon().is_some() {
        return "NEON";
    }
    #[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
    if level.as_wasm_simd128().is_some() {
        return "SIMD128";
    }
    let _ = level;
    "scalar"
}

impl Backend for Cpu {
    fn rollout(&mut self, groups: &[Group<'_>], visit: &Visit<'_>) -> Result<(), BackendError> {
        groups.iter().try_for_each(|group| group.check().and(group.weights.on_host().map(drop)))?;
        let level = self.level;
        dispatch!(level, simd => rollout(simd, groups, visit));
        Ok(())
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        group.check()?;
        group.weights.on_host()?;
        let level = self.level;
        Ok(dispatch!(level, simd => trace(simd, group)))
    }

    fn describe(&self) -> String {
        let threads = current_num_threads();
        format!("cpu ({}, {threads} thread{})", level_name(self.level), if threads == 1 { "" } else { "s" })
    }
}

/// Groups that follow each other in the same world: their teams may share a block.
struct Chain<'a> {
    world: &'a World,
    /// Index in the batch of the first group, and the groups.
    first: usize,
    groups: &'a [Group<'a>],
    teams: usize,
    /// Whether sights are recorded.
    sighted: bool,
}

impl Chain<'_> {
    /// Group (in the run) and team (in the group) of a team of the run.
    fn locate(&self, mut team: usize) -> (usize, usize) {
        for (index, group) in self.groups.iter().enumerate() {
            if team < group.team_count() {
                return (index, team);
            }
            team -= group.team_count();
        }
        unreachable!("a team of the run")
    }
}

fn runs<'a>(groups: &'a [Group<'a>]) -> Vec<Chain<'a>> {
    let mut first = 0;
    let mut runs = Vec::new();
    for groups in groups.chunk_by(|a, b| std::ptr::eq(a.world, b.world)) {
        let teams = groups.iter().map(Group::team_count).sum();
        let sighted = groups.iter().any(|group| group.need.sights());
        runs.push(Chain { world: groups[0].world, first, groups, teams, sighted });
        first += groups.len();
    }
    runs
}

fn rollout<S: Simd>(simd: S, groups: &[Group<'_>], visit: &Visit<'_>) {
    let width = S::f32s::LEN;
    let runs = runs(groups);
    let blocks: Vec<(&Chain<'_>, usize)> =
        runs.iter().flat_map(|run| (0..run.teams).step_by(width).map(move |team| (run, team))).collect();
    // A thread takes whatever lies idle: as many are made as threads play at once.
    let idle: Mutex<Vec<Whole<S>>> = Mutex::default();
    let take = |&Chain { world, sighted, .. }: &Chain<'_>| {
        let mut idle = idle.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = idle.iter().position(|whole| {
            whole.block.world.constants == world.constants
                && whole.sights.len() == sight_words(world, sighted) * S::f32s::LEN
        });
        if fits.is_none() {
            // Left over from a world that is done.
            idle.clear();
        }
        fits.map(|index| idle.swap_remove(index))
    };
    blocks.par_iter().with_max_len(1).for_each(|&(run, first)| {
        let mut whole = take(run).unwrap_or_else(|| Whole::new(simd, run.world, run.sighted));
        let teams = width.min(run.teams - first);
        simd.vectorize(
            #[inline(always)]
            || {
                whole.load(run, first, teams);
                whole.play(run.world, 0..run.world.steps());
            },
        );
        for lane in 0..teams {
            let (group, team) = run.locate(first + lane);
            visit(whole.episode(lane, run.first + group, team));
        }
        idle.lock().unwrap_or_else(PoisonError::into_inner).push(whole);
    });
}

fn trace<S: Simd>(simd: S, group: &Group<'_>) -> Trace {
    let world = group.world;
    let (teams, agents, steps) = (group.team_count(), world.agents(), world.steps());
    let sighted = group.need.sights();
    let run = Chain { world, first: 0, groups: std::slice::from_ref(group), teams, sighted };
    let mut moments = vec![bytemuck::Zeroable::zeroed(); (steps + 1) * teams * agents];
    let (mut sets, mut seen, mut sights) = (Vec::new(), Vec::new(), Vec::new());
    let mut whole = Whole::new(simd, world, sighted);
    for first in (0..teams).step_by(S::f32s::LEN) {
        let lanes = S::f32s::LEN.min(teams - first);
        whole.load(&run, first, lanes);
        for step in 0..=steps {
            if step > 0 {
                simd.vectorize(
                    #[inline(always)]
                    || whole.play(world, step - 1..step),
                );
            }
            for lane in 0..lanes {
                let at = (step * teams + first + lane) * agents;
                whole.block.moments(lane, step > 0, &mut moments[at..at + agents]);
            }
        }
        for lane in 0..lanes {
            let episode = whole.episode(lane, 0, first + lane);
            sets.extend(episode.sets.iter());
            seen.extend(episode.seen.words().iter());
            sights.extend(episode.sights.iter());
        }
    }
    Trace { teams, agents, moments, sets, seen, sights }
}

/// Whole episodes of one vector of teams: their policies, and their record.
struct Whole<S: Simd> {
    block: Block<S>,
    network: Network<S>,
    /// Group and team of each lane.
    places: Vec<(usize, usize)>,
    /// Where POIs are, a lane each; empty where they are the world's in all.
    moved: Vec<[S::f32s; 2]>,
    /// `[steps][pois][words][lanes]`, and the counts when they are complete, `[followers][leaders][lanes]`.
    sets: Vec<u32>,
    seen: Vec<u32>,
    /// `[steps][followers][words of leaders][lanes]`, where they are recorded.
    sights: Vec<u32>,
}

/// Words of a team's sights, if they are recorded.
fn sight_words(world: &World, sighted: bool) -> usize {
    if sighted { world.sight_words() } else { 0 }
}

impl<S: Simd> Whole<S> {
    fn new(simd: S, world: &World, sighted: bool) -> Whole<S> {
        Whole {
            block: Block::new(simd, world),
            network: Network::new(simd, world),
            places: Vec::with_capacity(S::f32s::LEN),
            moved: Vec::new(),
            sets: vec![0; world.set_words() * S::f32s::LEN],
            seen: vec![0; world.followers() * world.leaders() * S::f32s::LEN],
            sights: vec![0; sight_words(world, sighted) * S::f32s::LEN],
        }
    }

    /// Puts `teams` teams of the run, from `first` on, at their start; lanes left over repeat the first.
    #[inline(always)]
    fn load(&mut self, run: &Chain<'_>, first: usize, teams: usize) {
        let Whole { block, network, places, moved, .. } = self;
        moved.clear();
        places.clear();
        places.extend((0..S::f32s::LEN).map(|lane| run.locate(first + if lane < teams { lane } else { 0 })));
        for (lane, &(group, _)) in places.iter().enumerate() {
            block.place(lane, run.groups[group].starts);
        }
        if places.iter().any(|&(group, _)| run.groups[group].moved_pois().is_some()) {
            moved.resize(run.world.pois.len(), [splat(block.simd, 0.0); 2]);
            for (lane, &(group, _)) in places.iter().enumerate() {
                let pois = run.groups[group].moved_pois().unwrap_or(&run.world.pois);
                for ([x, y], poi) in moved.iter_mut().zip(pois) {
                    (x[lane], y[lane]) = (poi.x, poi.y);
                }
            }
        }
        block.start();
        network.load(run, places);
    }

    /// Plays some steps.
    #[inline(always)]
    fn play(&mut self, world: &World, steps: Range<usize>) {
        let Whole { block, network, moved, sets, seen, sights, .. } = self;
        if moved.is_empty() {
            play(block, network, &world.pois, sets, sights, steps);
        } else {
            play(block, network, moved, sets, sights, steps);
        }
        for (words, count) in seen.chunks_exact_mut(S::f32s::LEN).zip(&block.counts) {
            count.store_slice(words);
        }
    }

    /// One lane's record.
    fn episode(&self, lane: usize, group: usize, team: usize) -> Episode<'_> {
        let strided = |words| Strided { words, stride: S::f32s::LEN, offset: lane };
        let seen = Seen::Counts(strided(&self.seen));
        Episode { group, team, sets: strided(&self.sets), seen, sights: strided(&self.sights) }
    }
}

/// Plays some steps; the sets are of all steps, and so are the sights, if there are any.
#[inline(always)]
fn play<S: Simd>(
    block: &mut Block<S>,
    network: &mut Network<S>,
    pois: &[impl Locus<S>],
    sets: &mut [u32],
    sights: &mut [u32],
    steps: Range<usize>,
) {
    let size = pois.len() * block.world.constants.words as usize * S::f32s::LEN;
    let of_step = sights.len() / block.world.constants.steps as usize;
    for step in steps {
        block.look(pois);
        network.decide(&block.inputs, &mut block.outputs);
        if of_step > 0 {
            block.watch(&mut sights[step * of_step..]);
        }
        block.go();
        block.couple(pois, &mut sets[step * size..]);
    }
}

/// Where a POI is.
pub(crate) trait Locus<S: Simd>: Copy {
    /// One team a lane.
    fn lanes(self, simd: S) -> [S::f32s; 2];
}

/// The same in all teams.
impl<S: Simd> Locus<S> for Vec2 {
    #[inline(always)]
    fn lanes(self, simd: S) -> [S::f32s; 2] {
        [splat(simd, self.x), splat(simd, self.y)]
    }
}

/// In each team its own.
impl<S: Simd> Locus<S> for [S::f32s; 2] {
    #[inline(always)]
    fn lanes(self, _: S) -> [S::f32s; 2] {
        self
    }
}

/// The leaders' policies of one vector of teams.
struct Network<S: Simd> {
    simd: S,
    constants: Constants,
    /// `[leaders]`, layer by layer, units that are weighed together (see [`together`]) a row an input, then the biases.
    weights: Vec<S::f32s>,
    /// Where in there each weight of a policy belongs.
    slots: Vec<usize>,
    /// A layer's units and the next one's, `[leaders][units]`.
    hidden: [Vec<S::f32s>; 2],
}

impl<S: Simd> Network<S> {
    fn new(simd: S, world: &World) -> Network<S> {
        let constants = world.constants;
        let zero = splat(simd, 0.0);
        let widest = constants.policy.widest();
        let mut slots = vec![0; world.parameters()];
        let (mut first, mut slot) = (0, 0);
        for widths in constants.policy.widths[..=constants.policy.layers as usize].windows(2) {
            let (rows, columns) = (widths[0] as usize + 1, widths[1] as usize);
            let mut column = 0;
            while column < columns {
                let block = together(columns - column);
                for (row, unit) in (0..rows).flat_map(|row| (0..block).map(move |unit| (row, unit))) {
                    slots[first + row * columns + column + unit] = slot;
                    slot += 1;
                }
                column += block;
            }
            first += rows * columns;
        }
        Network {
            simd,
            constants,
            weights: vec![zero; world.leaders() * world.parameters()],
            slots,
            hidden: [vec![zero; world.leaders() * widest], vec![zero; world.leaders() * widest]],
        }
    }

    /// Takes the policies of each lane's group and team.
    #[inline(always)]
    fn load(&mut self, run: &Chain<'_>, places: &[(usize, usize)]) {
        let Network { simd, weights, slots, .. } = self;
        let (leaders, parameters) = (run.world.leaders(), run.world.parameters());
        for (leader, weights) in weights.chunks_exact_mut(parameters).enumerate() {
            // Four lanes at a time, the narrowest vector: four policies' weights are turned into four weights' lanes.
            for (quad, places) in places.as_chunks::<4>().0.iter().enumerate() {
                let policies = places.map(|(group, team)| {
                    let group = &run.groups[group];
                    let policy = group.teams[team * leaders + leader] as usize;
                    let Weights::OnHost(weights) = group.weights else { unreachable!("seen before playing") };
                    &weights[group.place(weights, leader, policy)..][..parameters]
                });
                turn(
                    *simd,
                    policies,
                    #[inline(always)]
                    |parameter, lanes| {
                        weights[slots[parameter]].as_mut_slice()[quad * 4..quad * 4 + 4].copy_from_slice(lanes);
                    },
                );
            }
        }
    }

    /// Leaders decide where to turn and how fast to go.
    #[inline(always)]
    fn decide(&mut self, inputs: &[[S::f32s; INPUTS]], outputs: &mut [[S::f32s; OUTPUTS]]) {
        let Network { weights, hidden, constants, .. } = self;
        let &mut Constants { leaders, policy: PolicyConstants { layers, widths, parameters }, .. } = constants;
        let mut first = 0;
        let [mut to, mut from] = hidden.each_mut().map(|units| &mut units[..]);
        for (layer, widths) in widths[..=layers as usize].windows(2).enumerate() {
            let [rows, columns] = [widths[0] as usize, widths[1] as usize];
            let inputs = if layer == 0 { inputs.as_flattened() } else { &*from };
            let units = &mut to[..leaders as usize * columns];
            let weights = (0..leaders as usize).map(|leader| &weights[leader * parameters as usize + first..]);
            match (rows, columns) {
                // The paper's network, whose sizes the compiler makes use of.
                (INPUTS, 10) => weigh_layer::<S, INPUTS, 10>(inputs, units, weights),
                (10, OUTPUTS) => weigh_layer::<S, 10, OUTPUTS>(inputs, units, weights),
                _ => {
                    let leaders = inputs.chunks_exact(rows).zip(units.chunks_exact_mut(columns));
                    for ((inputs, units), weights) in leaders.zip(weights) {
                        weigh::<S>(inputs, units, weights);
                    }
                }
            }
            // All leaders' tanh at once, and in short loops: the processor sees far enough ahead to keep its units
            // busy.
            for unit in &mut *units {
                *unit = policy::tame::<S>(*unit);
            }
            let (eights, rest) = units.as_chunks_mut::<8>();
            for units in eights {
                let mut halves = [(units[0], units[0]); 8];
                for (half, &unit) in halves.iter_mut().zip(&*units) {
                    *half = math::half_tanh::<S>(unit);
                }
                for (unit, &half) in units.iter_mut().zip(&halves) {
                    *unit = math::whole_tanh::<S>(half);
                }
            }
            for unit in rest {
                *unit = math::whole_tanh::<S>(math::half_tanh::<S>(*unit));
            }
            first += (rows + 1) * columns;
            std::mem::swap(&mut from, &mut to);
        }
        if widths[layers as usize] as usize == OUTPUTS {
            return outputs.copy_from_slice(&from.as_chunks::<OUTPUTS>().0[..leaders as usize]);
        }
        for ((answer, inputs), wanted) in outputs.iter_mut().zip(inputs).zip(from.as_chunks().0) {
            *answer = policy::choose::<S>(inputs, wanted);
        }
    }
}

/// The state of one vector of teams, everything a lane a team, and a step of it. Every read in a step is of the state
/// before it.
pub(crate) struct Block<S: Simd> {
    simd: S,
    world: Lanes<S>,
    /// Leaders first.
    pub agents: Vec<Agent<S>>,
    pub inputs: Vec<[S::f32s; INPUTS]>,
    pub outputs: Vec<[S::f32s; OUTPUTS]>,
    /// The speed that each agent wants next.
    wanted: Vec<S::f32s>,
    followers: Vec<Follower<S>>,
    /// At how many steps each follower saw each leader, `[followers][leaders]`.
    pub counts: Vec<S::u32s>,
    /// A bit for each pair of agents that may be in reach in some lane: `[words][agents]`.
    near: Vec<u64>,
    bounds: Vec<Bounds<S>>,
}

/// What of a [`Block`] must be kept from one step to the next, once it has looked.
pub(crate) struct Standing<S: Simd> {
    pub agents: Vec<Agent<S>>,
    /// None where nobody asks for them.
    pub counts: Vec<S::u32s>,
    near: Vec<u64>,
}

#[derive(Clone, Copy)]
pub(crate) struct Agent<S: Simd> {
    pub x: S::f32s,
    pub y: S::f32s,
    pub hx: S::f32s,
    pub hy: S::f32s,
    pub speed: S::f32s,
}

#[derive(Clone, Copy)]
struct Follower<S: Simd> {
    sums: follow::Sums<S>,
    pull: follow::Pull<S>,
    sizes: (S::f32s, S::f32s),
}

impl<S: Simd> Block<S> {
    pub fn new(simd: S, world: &World) -> Block<S> {
        let zero = splat(simd, 0.0);
        let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
        let pull = follow::Pull { x: zero, y: zero, influenced: S::mask32s::splat(simd, false) };
        Block {
            simd,
            world: Lanes::new(simd, world.constants),
            agents: vec![Agent { x: zero, y: zero, hx: zero, hy: zero, speed: zero }; agents],
            inputs: vec![[zero; INPUTS]; leaders],
            outputs: vec![[zero; OUTPUTS]; leaders],
            wanted: vec![zero; agents],
            followers: vec![Follower { sums: follow::Sums::new(simd), pull, sizes: (zero, zero) }; followers],
            counts: vec![S::u32s::splat(simd, 0); followers * leaders],
            near: vec![0; agents.div_ceil(64) * agents],
            bounds: vec![Bounds::nowhere(simd); agents.div_ceil(S::f32s::LEN)],
        }
    }

    /// Only what is kept, with the counts or without.
    pub fn into_standing(self, counted: bool) -> Standing<S> {
        let Block { agents, counts, near, .. } = self;
        Standing { agents, counts: if counted { counts } else { vec![] }, near }
    }

    /// Takes on what stands of other teams, for what stands of these.
    #[inline(always)]
    pub fn swap(&mut self, standing: &mut Standing<S>) {
        std::mem::swap(&mut self.agents, &mut standing.agents);
        if !standing.counts.is_empty() {
            std::mem::swap(&mut self.counts, &mut standing.counts);
        }
        std::mem::swap(&mut self.near, &mut standing.near);
    }

    /// Puts one lane's agents where they start.
    #[inline(always)]
    pub fn place(&mut self, lane: usize, starts: &[Vec2]) {
        for (agent, start) in self.agents.iter_mut().zip(starts) {
            agent.x[lane] = start.x;
            agent.y[lane] = start.y;
        }
    }

    /// Sets all lanes' agents to their first heading and speed.
    #[inline(always)]
    pub fn start(&mut self) {
        let Block { simd, world, agents, counts, .. } = self;
        for agent in agents {
            agent.hx = splat(*simd, world.constants.heading_x);
            agent.hy = splat(*simd, world.constants.heading_y);
            agent.speed = splat(*simd, world.constants.speed);
        }
        counts.fill(S::u32s::splat(*simd, 0));
    }

    /// [`Block::start`] of one lane.
    #[inline(always)]
    pub fn start_lane(&mut self, lane: usize) {
        let Constants { heading_x, heading_y, speed, .. } = self.world.constants;
        for agent in &mut self.agents {
            (agent.hx[lane], agent.hy[lane], agent.speed[lane]) = (heading_x, heading_y, speed);
        }
        self.counts.iter_mut().for_each(|count| count[lane] = 0);
    }

    /// What leaders sense, for the policies to answer.
    #[inline(always)]
    pub fn look(&mut self, pois: &[impl Locus<S>]) {
        self.find_near();
        self.sense(pois);
    }

    /// Everyone moves: leaders as their policies answered, followers after whoever was near.
    #[inline(always)]
    pub fn go(&mut self) {
        self.act();
        self.follow();
        self.advance();
    }

    /// Marks the pairs of agents that one of them may sense or be drawn to, in any lane.
    #[inline(always)]
    fn find_near(&mut self) {
        self.near.fill(0);
        let Block { world, agents, near, bounds, .. } = self;
        let (count, leaders) = (agents.len(), world.constants.leaders as usize);
        let drawn = world.constants.follow.attraction_radius2;
        let sensed = world.constants.sense.agent_range2.max(drawn);
        let reach2 = |agent: usize| if agent < leaders { sensed } else { drawn };
        if count > MANY {
            let lanes = S::f32s::LEN;
            for (bounds, agents) in bounds.iter_mut().zip(agents.chunks(lanes)) {
                bounds.enclose(agents);
            }
            for (i, agent) in agents.iter().enumerate() {
                let reach2 = reach2(i);
                let own = bounds[i / lanes].around(i % lanes, reach2);
                for (vector, bounds) in bounds.iter().enumerate().skip(i / lanes) {
                    let first = vector * lanes;
                    let mut bits = bounds.meet(own);
                    if first <= i {
                        bits &= u64::MAX << (i - first) << 1;
                    }
                    let mut row = 0;
                    while bits != 0 {
                        let j = first + bits.trailing_zeros() as usize;
                        // Without a branch: of those whose boxes are near, the processor cannot guess who is.
                        let within = u64::from(meet::<S>(agent, &agents[j], reach2));
                        row |= within << (j % 64);
                        near[i / 64 * count + j] |= within << (i % 64);
                        bits &= bits - 1;
                    }
                    near[first / 64 * count + i] |= row;
                }
            }
        } else {
            let near = &mut near[..count];
            for (i, agent) in agents.iter().enumerate() {
                let reach2 = reach2(i);
                let mut row = 0;
                for j in i + 1..count {
                    if meet::<S>(agent, &agents[j], reach2) {
                        row |= 1 << j;
                        near[j] |= 1 << i;
                    }
                }
                near[i] |= row;
            }
        }
    }

    /// Leaders sense: all POIs, then the other agents, each in ascending order.
    #[inline(always)]
    fn sense(&mut self, pois: &[impl Locus<S>]) {
        self.world.constants.variant.density().fix(Sensing { block: self, pois });
    }

    #[inline(always)]
    fn sense_by<P: Locus<S>, const DENSITY: u32>(&mut self, pois: &[P]) {
        let Block { simd, world, agents, near, inputs, .. } = self;
        for (leader, (agent, inputs)) in agents.iter().zip(inputs).enumerate() {
            let &Agent { x, y, hx, hy, .. } = agent;
            let mut of_pois = [splat(*simd, 0.0); 4];
            let (fours, rest) = pois.as_chunks::<4>();
            for pois in fours {
                let mut densities = [x; 4];
                for (density, poi) in densities.iter_mut().zip(pois) {
                    let [px, py] = poi.lanes(*simd);
                    let [dx, dy] = [px - x, py - y];
                    *density = sensed::<S, DENSITY>(world, world.sense.poi_range2, dx, dy);
                }
                for (&density, poi) in densities.iter().zip(pois) {
                    let [px, py] = poi.lanes(*simd);
                    let [dx, dy] = [px - x, py - y];
                    sense::sense::<S>(density, dx, dy, hx, hy, &mut of_pois);
                }
            }
            for poi in rest {
                let [px, py] = poi.lanes(*simd);
                let [dx, dy] = [px - x, py - y];
                let density = sensed::<S, DENSITY>(world, world.sense.poi_range2, dx, dy);
                sense::sense::<S>(density, dx, dy, hx, hy, &mut of_pois);
            }
            let mut of_agents = [splat(*simd, 0.0); 4];
            each_near(
                near,
                agents,
                leader,
                #[inline(always)]
                |_, other| {
                    let (dx, dy) = (other.x - x, other.y - y);
                    let density = sensed::<S, DENSITY>(world, world.sense.agent_range2, dx, dy);
                    sense::sense::<S>(density, dx, dy, hx, hy, &mut of_agents);
                },
            );
            *inputs = sense::weigh_in::<S>(world, of_pois, of_agents);
        }
    }

    /// Leaders turn and wish for a speed as their policies say.
    #[inline(always)]
    fn act(&mut self) {
        let Block { world, agents, outputs, wanted, .. } = self;
        for ((agent, wanted), &[turn, speed]) in agents.iter_mut().zip(wanted).zip(&*outputs) {
            (agent.hx, agent.hy) = motion::turn::<S>(world, agent.hx, agent.hy, policy::wanted_turn::<S>(turn));
            *wanted = policy::wanted_speed::<S>(world, speed);
        }
    }

    /// Followers count the leaders they see and follow whoever is near.
    #[inline(always)]
    fn follow(&mut self) {
        let Block { simd, world, agents, wanted, near, followers, counts, .. } = self;
        let leaders = world.constants.leaders as usize;
        for (index, (follower, counts)) in followers.iter_mut().zip(counts.chunks_exact_mut(leaders)).enumerate() {
            let &Agent { x, y, .. } = &agents[leaders + index];
            let mut sums = follow::Sums::new(*simd);
            each_near(
                near,
                agents,
                leaders + index,
                #[inline(always)]
                |index, other| {
                    let seen = follow::influence::<S>(world, other.x - x, other.y - y, &mut sums);
                    if let Some(count) = counts.get_mut(index) {
                        *count -= seen.to_vector().bitcast::<S::u32s>();
                    }
                },
            );
            follower.sums = sums;
        }
        let (agents, wanted) = (&mut agents[leaders..], &mut wanted[leaders..]);
        if world.constants.variant.by_sine != 0 {
            steer::<S, true>(world, agents, followers, wanted);
        } else {
            steer::<S, false>(world, agents, followers, wanted);
        }
    }

    /// Records which leaders each follower sees, `[followers][words of leaders][lanes]`.
    #[inline(always)]
    pub fn watch(&self, sights: &mut [u32]) {
        let Block { simd, world, agents, .. } = self;
        let (leaders, followers) = agents.split_at(world.constants.leaders as usize);
        let pairs = followers.iter().flat_map(|follower| leaders.chunks(32).map(move |leaders| (follower, leaders)));
        for ((follower, leaders), words) in pairs.zip(sights.chunks_exact_mut(S::f32s::LEN)) {
            let (mut seen, mut bit) = (S::u32s::splat(*simd, 0), S::u32s::splat(*simd, 1));
            for leader in leaders {
                let sees = follow::sees::<S>(world, leader.x - follower.x, leader.y - follower.y);
                seen |= sees.to_vector().bitcast::<S::u32s>() & bit;
                bit += bit;
            }
            seen.store_slice(words);
        }
    }

    /// Everyone moves.
    #[inline(always)]
    fn advance(&mut self) {
        let world = &self.world;
        for (agent, &wanted) in self.agents.iter_mut().zip(&self.wanted) {
            (agent.hx, agent.hy) = motion::renormalize::<S>(agent.hx, agent.hy);
            agent.speed = motion::accelerate::<S>(world, agent.speed, wanted);
        }
        for agent in &mut self.agents {
            let step = agent.speed * world.motion.dt;
            agent.x = motion::advance::<S>(agent.x, step, agent.hx, world.motion.map_x);
            agent.y = motion::advance::<S>(agent.y, step, agent.hy, world.motion.map_y);
        }
    }

    /// Records who is near each POI, `[pois][words][lanes]`.
    #[inline(always)]
    pub fn couple(&mut self, pois: &[impl Locus<S>], mut sets: &mut [u32]) {
        let (fours, rest) = pois.as_chunks::<4>();
        for pois in fours {
            sets = observe(self.simd, &self.world, &self.agents, pois, sets);
        }
        for poi in rest {
            sets = observe(self.simd, &self.world, &self.agents, std::array::from_ref(poi), sets);
        }
    }

    /// One lane's agents as they stand; before the first step nothing has been sensed yet.
    fn moments(&self, lane: usize, sensed: bool, moments: &mut [Moment]) {
        let leaders = self.outputs.len();
        for (index, (agent, moment)) in self.agents.iter().zip(moments).enumerate() {
            if sensed && index < leaders {
                moment.inputs = self.inputs[index].map(|input| input[lane]);
                moment.outputs = self.outputs[index].map(|output| output[lane]);
            } else if sensed {
                let follower = &self.followers[index - leaders];
                moment.force = [follower.pull.x[lane], follower.pull.y[lane]];
            }
            moment.position = [agent.x[lane], agent.y[lane]];
            moment.heading = [agent.hx[lane], agent.hy[lane]];
            moment.speed = agent.speed[lane];
        }
    }
}

/// Leaders sense by one of the densities.
struct Sensing<'a, S: Simd, P> {
    block: &'a mut Block<S>,
    pois: &'a [P],
}

impl<S: Simd, P: Locus<S>> Fixed for Sensing<'_, S, P> {
    type Output = ();

    #[inline(always)]
    fn with<const DENSITY: u32>(self) {
        self.block.sense_by::<P, DENSITY>(self.pois);
    }
}

/// Turns rows of equal length into columns: `put` gets the number of each and its four numbers.
#[inline(always)]
pub(crate) fn turn<S: Simd>(simd: S, rows: [&[f32]; 4], mut put: impl FnMut(usize, &[f32])) {
    let [a, b, c, d] = rows;
    let columns = a.len();
    let whole = columns / 4 * 4;
    for at in (0..whole).step_by(4) {
        // Written out: a call that is not inlined knows nothing of wide instructions.
        let fours = [
            f32x4::from_slice(simd, &a[at..at + 4]),
            f32x4::from_slice(simd, &b[at..at + 4]),
            f32x4::from_slice(simd, &c[at..at + 4]),
            f32x4::from_slice(simd, &d[at..at + 4]),
        ];
        for (column, four) in (at..).zip(&transposed(fours)) {
            put(column, four.as_slice());
        }
    }
    for column in whole..columns {
        put(column, &[a[column], b[column], c[column], d[column]]);
    }
}

/// Lanes of the vectors that this processor plays on.
pub fn lanes() -> u64 {
    fn count<S: Simd>(_: S) -> u64 {
        S::f32s::LEN as u64
    }
    dispatch!(Level::new(), simd => count(simd))
}

/// Bytes that one vector of teams takes, of whom this is needed.
pub fn block_bytes(world: &World, need: Need) -> u64 {
    let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
    let record = world.set_words() + followers * leaders + sight_words(world, need.sights());
    let words = 8 * agents + leaders * world.constants.policy.words() + 3 * followers + record;
    words as u64 * lanes() * 4 + (8 * world.parameters() + agents * agents.div_ceil(64) * 8) as u64
}

/// Rows turned into columns.
#[inline(always)]
pub(crate) fn transposed<S: Simd>([a, b, c, d]: [f32x4<S>; 4]) -> [f32x4<S>; 4] {
    let (low, high) = (a.zip_low(c), a.zip_high(c));
    let (other_low, other_high) = (b.zip_low(d), b.zip_high(d));
    [low.zip_low(other_low), low.zip_high(other_low), high.zip_low(other_high), high.zip_high(other_high)]
}

/// Units that are weighed together, of those left in a layer: inputs are read once for all.
#[inline(always)]
fn together(left: usize) -> usize {
    match left {
        10 => 10,
        4.. => 4,
        2 | 3 => 2,
        _ => 1,
    }
}

/// Every leader's units of one layer, before their tanh.
#[inline(always)]
fn weigh_layer<'a, S: Simd, const INPUTS: usize, const UNITS: usize>(
    inputs: &[S::f32s],
    units: &mut [S::f32s],
    weights: impl Iterator<Item = &'a [S::f32s]>,
) {
    let leaders = inputs.as_chunks::<INPUTS>().0.iter().zip(units.as_chunks_mut::<UNITS>().0);
    for ((inputs, units), weights) in leaders.zip(weights) {
        *units = policy::weigh::<S, UNITS>(inputs, &weights[..(INPUTS + 1) * UNITS]);
    }
}

/// One leader's units of one layer, before their tanh.
#[inline(always)]
fn weigh<S: Simd>(inputs: &[S::f32s], mut units: &mut [S::f32s], mut weights: &[S::f32s]) {
    while !units.is_empty() {
        let count = together(units.len());
        let (these, weights_of_these);
        (these, units) = units.split_at_mut(count);
        (weights_of_these, weights) = weights.split_at((inputs.len() + 1) * count);
        match count {
            10 => these.copy_from_slice(&policy::weigh::<S, 10>(inputs, weights_of_these)),
            4 => these.copy_from_slice(&policy::weigh::<S, 4>(inputs, weights_of_these)),
            2 => these.copy_from_slice(&policy::weigh::<S, 2>(inputs, weights_of_these)),
            _ => these.copy_from_slice(&policy::weigh::<S, 1>(inputs, weights_of_these)),
        }
    }
}

/// Puts the agents near some POIs into their sets, `[N][words][lanes]`; gives back the sets after these.
#[inline(always)]
fn observe<'a, S: Simd, const N: usize>(
    simd: S,
    world: &Lanes<S>,
    agents: &[Agent<S>],
    pois: &[impl Locus<S>; N],
    sets: &'a mut [u32],
) -> &'a mut [u32] {
    let mut places = [[splat(simd, 0.0); 2]; N];
    for (place, poi) in places.iter_mut().zip(pois) {
        *place = poi.lanes(simd);
    }
    let words = world.constants.words as usize;
    for (word, agents) in agents.chunks(32).enumerate() {
        let (mut near, mut bit) = ([S::u32s::splat(simd, 0); N], S::u32s::splat(simd, 1));
        for agent in agents {
            for (near, &[x, y]) in near.iter_mut().zip(&places) {
                let observes = couple::observes::<S>(world, agent.x - x, agent.y - y);
                *near |= observes.to_vector().bitcast::<S::u32s>() & bit;
            }
            bit += bit;
        }
        for (poi, near) in near.iter().enumerate() {
            near.store_slice(&mut sets[(poi * words + word) * S::f32s::LEN..][..S::f32s::LEN]);
        }
    }
    &mut sets[N * words * S::f32s::LEN..]
}

/// Turns followers to where they are pulled. In short loops: the processor sees far enough ahead to keep its units
/// busy.
#[inline(always)]
fn steer<S: Simd, const BY_SINE: bool>(
    world: &Lanes<S>,
    agents: &mut [Agent<S>],
    followers: &mut [Follower<S>],
    wanted: &mut [S::f32s],
) {
    for (agent, follower) in agents.iter().zip(&mut *followers) {
        follower.pull = follow::force::<S>(world, &follower.sums, agent.x, agent.y);
    }
    for follower in &mut *followers {
        follower.sizes = follow::sizes::<S>(&follower.pull);
    }
    for ((agent, wanted), follower) in agents.iter_mut().zip(wanted).zip(followers) {
        let &mut Agent { hx, hy, speed, .. } = agent;
        let &mut Follower { pull, sizes, .. } = follower;
        (agent.hx, agent.hy, *wanted) = follow::steer::<S, BY_SINE>(world, &pull, sizes, hx, hy, speed);
    }
}

/// What an entity at offset (`dx`, `dy`) adds to the density of its quadrant: nothing beyond the range.
#[inline(always)]
fn sensed<S: Simd, const DENSITY: u32>(world: &Lanes<S>, range2: S::f32s, dx: S::f32s, dy: S::f32s) -> S::f32s {
    only::<S>(sense::density::<S, DENSITY>(world, dx, dy), within::<S>(dx, dy, range2))
}

/// Whether the squared distance of two agents is `reach2` at most, in any lane.
#[inline(always)]
fn meet<S: Simd>(agent: &Agent<S>, other: &Agent<S>, reach2: f32) -> bool {
    within::<S>(other.x - agent.x, other.y - agent.y, splat(agent.x.token(), reach2)).any_true()
}

/// The boxes around some agents' places in all lanes, an agent a lane.
#[derive(Clone, Copy)]
struct Bounds<S: Simd> {
    low_x: S::f32s,
    high_x: S::f32s,
    low_y: S::f32s,
    high_y: S::f32s,
}

impl<S: Simd> Bounds<S> {
    /// Boxes that nothing is near, as lanes left over hold.
    fn nowhere(simd: S) -> Bounds<S> {
        let (low, high) = (splat(simd, f32::INFINITY), splat(simd, f32::NEG_INFINITY));
        Bounds { low_x: low, high_x: high, low_y: low, high_y: high }
    }

    #[inline(always)]
    fn enclose(&mut self, agents: &[Agent<S>]) {
        for (lane, agent) in agents.iter().enumerate() {
            self.low_x[lane] = agent.x.reduce_min();
            self.high_x[lane] = agent.x.reduce_max();
            self.low_y[lane] = agent.y.reduce_min();
            self.high_y[lane] = agent.y.reduce_max();
        }
    }

    /// One agent's box in every lane, widened by its reach.
    #[inline(always)]
    fn around(&self, lane: usize, reach2: f32) -> Bounds<S> {
        let simd = self.low_x.token();
        // No pair may be lost to a rounding.
        let reach = reach2.sqrt() * 1.001;
        Bounds {
            low_x: splat(simd, self.low_x[lane] - reach),
            high_x: splat(simd, self.high_x[lane] + reach),
            low_y: splat(simd, self.low_y[lane] - reach),
            high_y: splat(simd, self.high_y[lane] + reach),
        }
    }

    /// A bit for each agent whose box meets this one.
    #[inline(always)]
    fn meet(&self, other: Bounds<S>) -> u64 {
        let near_x = self.low_x.simd_le(other.high_x) & self.high_x.simd_ge(other.low_x);
        let near_y = self.low_y.simd_le(other.high_y) & self.high_y.simd_ge(other.low_y);
        (near_x & near_y).to_bitmask()
    }
}

/// Pairs of more agents than this are first looked for by their bounds.
const MANY: usize = 32;

/// Calls `f` with each agent that may be in reach of this one, and its index, ascending.
#[inline(always)]
fn each_near<T>(near: &[u64], agents: &[T], agent: usize, mut f: impl FnMut(usize, &T)) {
    let (mut at, mut first) = (agent, 0);
    while let Some(&near) = near.get(at) {
        let mut bits = near;
        while bits != 0 {
            let index = first + bits.trailing_zeros() as usize;
            f(index, &agents[index]);
            bits &= bits - 1;
        }
        (at, first) = (at + agents.len(), first + 64);
    }
}
