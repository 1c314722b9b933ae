//! The reference backend: one team a lane, one vector of teams a block, blocks shared out over threads.
//!
//! The loops here may skip whatever adds nothing (an agent out of reach of every lane), since sums start at +0 and
//! keep their order; the formulas are [`crate::kernels`]'.

use std::sync::{Mutex, PoisonError};

use fearless_simd::{Level, Select, Simd, SimdMask, dispatch, f32x4, prelude::*};
use glam::Vec2;
use rayon::prelude::*;

use super::{Backend, BackendError, Episode, Group, Moment, Strided, Trace, Visit};
use crate::kernels::{couple, follow, math, motion, policy, sense, splat};
use crate::world::{Constants, INPUTS, OUTPUTS, World};

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

    /// Every instruction set that this processor has, narrowest first.
    pub fn levels() -> Vec<Level> {
        let best = Level::new();
        let mut levels = vec![Level::baseline()];
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
    let _ = level;
    "scalar"
}

impl Backend for Cpu {
    fn rollout(&mut self, groups: &[Group<'_>], visit: &Visit<'_>) -> Result<(), BackendError> {
        let level = self.level;
        dispatch!(level, simd => rollout(simd, groups, visit));
        Ok(())
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        let level = self.level;
        Ok(dispatch!(level, simd => trace(simd, group)))
    }

    fn describe(&self) -> String {
        let threads = rayon::current_num_threads();
        format!("cpu ({}, {threads} thread{})", level_name(self.level), if threads == 1 { "" } else { "s" })
    }
}

/// Groups that follow each other in the same world: their teams may share a block.
struct Run<'a> {
    world: &'a World,
    /// Index in the batch of the first group, and the groups.
    first: usize,
    groups: &'a [Group<'a>],
    teams: usize,
}

impl Run<'_> {
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

fn runs<'a>(groups: &'a [Group<'a>]) -> Vec<Run<'a>> {
    let mut first = 0;
    let mut runs = Vec::new();
    for groups in groups.chunk_by(|a, b| std::ptr::eq(a.world, b.world)) {
        let teams = groups.iter().map(Group::team_count).sum();
        runs.push(Run { world: groups[0].world, first, groups, teams });
        first += groups.len();
    }
    runs
}

fn rollout<S: Simd>(simd: S, groups: &[Group<'_>], visit: &Visit<'_>) {
    let width = S::f32s::LEN;
    let runs = runs(groups);
    let blocks: Vec<(&Run<'_>, usize)> =
        runs.iter().flat_map(|run| (0..run.teams).step_by(width).map(move |team| (run, team))).collect();
    // A thread takes whatever block lies idle: as many are made as threads play at once.
    let idle: Mutex<Vec<Block<S>>> = Mutex::default();
    let take = |world: &World| {
        let mut idle = idle.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = idle.iter().position(|block| block.world == world.constants);
        if fits.is_none() {
            // Left over from a world that is done.
            idle.clear();
        }
        fits.map(|index| idle.swap_remove(index))
    };
    blocks.par_iter().with_max_len(1).for_each(|&(run, first)| {
        let mut block = take(run.world).unwrap_or_else(|| Block::new(simd, run.world));
        let teams = width.min(run.teams - first);
        simd.vectorize(
            #[inline(always)]
            || {
                block.load(run, first, teams);
                for step in 0..run.world.steps() {
                    block.step(run.world, step);
                }
            },
        );
        for lane in 0..teams {
            let (group, team) = run.locate(first + lane);
            visit(block.episode(lane, run.first + group, team));
        }
        idle.lock().unwrap_or_else(PoisonError::into_inner).push(block);
    });
}

fn trace<S: Simd>(simd: S, group: &Group<'_>) -> Trace {
    let world = group.world;
    let (teams, agents, steps) = (group.team_count(), world.agents(), world.steps());
    let run = Run { world, first: 0, groups: std::slice::from_ref(group), teams };
    let mut moments = vec![bytemuck::Zeroable::zeroed(); (steps + 1) * teams * agents];
    let (mut sets, mut seen) = (Vec::new(), Vec::new());
    let mut block = Block::new(simd, world);
    for first in (0..teams).step_by(S::f32s::LEN) {
        let lanes = S::f32s::LEN.min(teams - first);
        block.load(&run, first, lanes);
        for step in 0..=steps {
            if step > 0 {
                simd.vectorize(
                    #[inline(always)]
                    || block.step(world, step - 1),
                );
            }
            for lane in 0..lanes {
                let at = (step * teams + first + lane) * agents;
                block.moments(lane, step > 0, &mut moments[at..at + agents]);
            }
        }
        for lane in 0..lanes {
            let episode = block.episode(lane, 0, first + lane);
            sets.extend(episode.sets.iter());
            seen.extend(episode.seen.iter());
        }
    }
    Trace { teams, agents, moments, sets, seen }
}

/// The state of one vector of teams, everything a lane a team. Agents are leaders first.
struct Block<S: Simd> {
    simd: S,
    world: Constants,
    x: Vec<S::f32s>,
    y: Vec<S::f32s>,
    hx: Vec<S::f32s>,
    hy: Vec<S::f32s>,
    speed: Vec<S::f32s>,
    /// What each agent wants next: heading and speed.
    next: Vec<[S::f32s; 3]>,
    /// `[leaders]`, layer by layer, units that are weighed together (see [`together`]) a row an input, then the biases.
    weights: Vec<S::f32s>,
    /// Where in there each weight of a policy belongs.
    slots: Vec<usize>,
    /// Group and team of each lane.
    places: Vec<(usize, usize)>,
    inputs: Vec<S::f32s>,
    /// A layer's units and the next one's, `[leaders][units]`.
    hidden: [Vec<S::f32s>; 2],
    /// What some units' tanh will be made of.
    halves: [(S::f32s, S::f32s); 16],
    outputs: Vec<S::f32s>,
    forces: Vec<[S::f32s; 2]>,
    influenced: Vec<S::mask32s>,
    /// A bit for each pair of agents that may be in reach in some lane: `[agents][near_words]`.
    near: Vec<u64>,
    near_words: usize,
    /// `[steps][pois][words][lanes]` and `[followers][leaders][lanes]`.
    sets: Vec<u32>,
    seen: Vec<u32>,
}

impl<S: Simd> Block<S> {
    fn new(simd: S, world: &World) -> Block<S> {
        let constants = world.constants;
        let zero = splat(simd, 0.0);
        let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
        let widest = constants.widths.into_iter().max().unwrap_or(0) as usize;
        let near_words = agents.div_ceil(64);
        let mut slots = vec![0; world.parameters()];
        let (mut first, mut slot) = (0, 0);
        for widths in constants.widths[..=constants.layers as usize].windows(2) {
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
        Block {
            simd,
            world: constants,
            x: vec![zero; agents],
            y: vec![zero; agents],
            hx: vec![zero; agents],
            hy: vec![zero; agents],
            speed: vec![zero; agents],
            next: vec![[zero; 3]; agents],
            weights: vec![zero; leaders * world.parameters()],
            slots,
            places: Vec::with_capacity(S::f32s::LEN),
            inputs: vec![zero; leaders * INPUTS],
            hidden: [vec![zero; leaders * widest], vec![zero; leaders * widest]],
            halves: [(zero, zero); 16],
            outputs: vec![zero; leaders * OUTPUTS],
            forces: vec![[zero; 2]; followers],
            influenced: vec![S::mask32s::splat(simd, false); followers],
            near: vec![0; agents * near_words],
            near_words,
            sets: vec![0; world.set_words() * S::f32s::LEN],
            seen: vec![0; followers * leaders * S::f32s::LEN],
        }
    }

    /// Puts `teams` teams of the run, from `first` on, at their start; lanes left over repeat the first.
    #[inline(always)]
    fn load(&mut self, run: &Run<'_>, first: usize, teams: usize) {
        let (leaders, parameters, lanes) = (self.world.leaders as usize, self.world.parameters as usize, S::f32s::LEN);
        self.places.clear();
        self.places.extend((0..lanes).map(|lane| run.locate(first + if lane < teams { lane } else { 0 })));
        for (lane, &(group, _)) in self.places.iter().enumerate() {
            for (agent, start) in run.groups[group].starts.iter().enumerate() {
                self.x[agent][lane] = start.x;
                self.y[agent][lane] = start.y;
            }
        }
        for leader in 0..leaders {
            let policy = |&(group, team): &(usize, usize)| {
                let group = &run.groups[group];
                let policy = group.teams[team * leaders + leader] as usize;
                &group.weights[(leader * group.policies + policy) * parameters..][..parameters]
            };
            // Policies lie all over memory: when all are asked for at once, their way to the processor overlaps.
            // Four lanes at a time, the narrowest vector: four policies' weights are turned into four weights' lanes.
            let to = &mut self.weights[leader * parameters..(leader + 1) * parameters];
            for (quad, places) in self.places.as_chunks::<4>().0.iter().enumerate() {
                let policies = places.each_ref().map(policy);
                let mut put = |place: usize, lanes: &[f32]| {
                    to[place].as_mut_slice()[quad * 4..quad * 4 + 4].copy_from_slice(lanes);
                };
                let (fours, rest) = self.slots.as_chunks::<4>();
                for (at, slots) in (0..).step_by(4).zip(fours) {
                    let rows = policies.map(|policy| f32x4::from_slice(self.simd, &policy[at..at + 4]));
                    for (&slot, lanes) in slots.iter().zip(transposed(rows)) {
                        put(slot, lanes.as_slice());
                    }
                }
                for (at, &slot) in (fours.len() * 4..).zip(rest) {
                    put(slot, &policies.map(|policy| policy[at]));
                }
            }
        }
        self.hx.fill(splat(self.simd, self.world.heading_x));
        self.hy.fill(splat(self.simd, self.world.heading_y));
        self.speed.fill(splat(self.simd, self.world.speed));
        self.seen.fill(0);
    }

    /// One step of all agents; every read is of the state before it.
    #[inline(always)]
    fn step(&mut self, world: &World, step: usize) {
        self.find_near();
        self.sense(&world.pois);
        self.decide();
        self.follow();
        self.advance();
        self.couple(&world.pois, step);
    }

    /// Marks the pairs of agents that one of them may sense or be drawn to, in any lane.
    #[inline(always)]
    fn find_near(&mut self) {
        let (agents, leaders) = (self.x.len(), self.world.leaders as usize);
        let (sensed, drawn) = (self.world.agent_range2, self.world.attraction_radius2);
        self.near.fill(0);
        for i in 0..agents {
            let split = leaders.max(i + 1);
            let to_leaders = (i + 1..split, sensed);
            let to_followers = (split..agents, if i < leaders { sensed.max(drawn) } else { drawn });
            for (others, reach2) in [to_leaders, to_followers] {
                let (x, y) = (self.x[i], self.y[i]);
                for ((j, &other_x), &other_y) in others.clone().zip(&self.x[others.clone()]).zip(&self.y[others]) {
                    let dx = other_x - x;
                    let dy = other_y - y;
                    if (dx * dx + dy * dy).simd_le(reach2).any_true() {
                        self.near[i * self.near_words + j / 64] |= 1 << (j % 64);
                        self.near[j * self.near_words + i / 64] |= 1 << (i % 64);
                    }
                }
            }
        }
    }

    /// Leaders sense: all POIs, then the other agents, each in ascending order.
    #[inline(always)]
    fn sense(&mut self, pois: &[Vec2]) {
        let world = &self.world;
        for leader in 0..world.leaders as usize {
            let (x, y, hx, hy) = (self.x[leader], self.y[leader], self.hx[leader], self.hy[leader]);
            let mut sums = [splat(self.simd, 0.0); 4];
            for poi in pois {
                let dx = splat(self.simd, poi.x) - x;
                let dy = splat(self.simd, poi.y) - y;
                sense::sense::<S>(world, world.poi_range2, dx, dy, hx, hy, &mut sums);
            }
            let inputs = &mut self.inputs[leader * INPUTS..(leader + 1) * INPUTS];
            for (input, sum) in inputs.iter_mut().zip(sums) {
                *input = sum * world.poi_share;
            }
            let mut sums = [splat(self.simd, 0.0); 4];
            let near = &self.near[leader * self.near_words..(leader + 1) * self.near_words];
            let (xs, ys) = (&self.x, &self.y);
            each_bit(
                near,
                #[inline(always)]
                |agent| {
                    sense::sense::<S>(world, world.agent_range2, xs[agent] - x, ys[agent] - y, hx, hy, &mut sums);
                },
            );
            for (input, sum) in inputs[4..].iter_mut().zip(sums) {
                *input = sum * world.agent_share;
            }
        }
    }

    /// Leaders decide where to turn and how fast to go: layer by layer, all leaders' sums first, then all their tanh.
    #[inline(always)]
    fn decide(&mut self) {
        let world = &self.world;
        let (leaders, parameters) = (world.leaders as usize, world.parameters as usize);
        let [mut from, mut to] = self.hidden.each_mut().map(|units| &mut units[..]);
        from[..leaders * INPUTS].copy_from_slice(&self.inputs);
        let mut first = 0;
        for layer in 0..world.layers as usize {
            let (inputs, units) = (world.widths[layer] as usize, world.widths[layer + 1] as usize);
            for leader in 0..leaders {
                let from = &from[leader * inputs..(leader + 1) * inputs];
                let to = &mut to[leader * units..(leader + 1) * units];
                let weights = &self.weights[leader * parameters + first..];
                let mut unit = 0;
                while unit < units {
                    let (to, weights) = (&mut to[unit..], &weights[unit * (inputs + 1)..]);
                    unit += match together(units - unit) {
                        10 => put(to, policy::weigh::<S, 10>(from, weights)),
                        4 => put(to, policy::weigh::<S, 4>(from, weights)),
                        2 => put(to, policy::weigh::<S, 2>(from, weights)),
                        _ => put(to, policy::weigh::<S, 1>(from, weights)),
                    };
                }
            }
            // In short loops the processor sees far enough ahead to keep its units busy.
            for units in to[..leaders * units].chunks_mut(self.halves.len()) {
                for (half, &unit) in self.halves.iter_mut().zip(&*units) {
                    *half = policy::activate::<S>(unit);
                }
                for (unit, &half) in units.iter_mut().zip(&self.halves) {
                    *unit = math::whole_tangent::<S>(half);
                }
            }
            first += (inputs + 1) * units;
            std::mem::swap(&mut from, &mut to);
        }
        self.outputs.copy_from_slice(&from[..leaders * OUTPUTS]);
        for (leader, outputs) in from[..leaders * OUTPUTS].chunks_exact(OUTPUTS).enumerate() {
            let turn = policy::wanted_turn::<S>(outputs[0]);
            let (hx, hy) = motion::turn::<S>(world, self.hx[leader], self.hy[leader], turn);
            self.next[leader] = [hx, hy, policy::wanted_speed::<S>(outputs[1], world.max_speed)];
        }
    }

    /// Followers count the leaders they see and follow whoever is near.
    #[inline(always)]
    fn follow(&mut self) {
        let world = &self.world;
        let (leaders, lanes) = (world.leaders as usize, S::f32s::LEN);
        for follower in 0..world.followers as usize {
            let agent = leaders + follower;
            let (x, y) = (self.x[agent], self.y[agent]);
            let mut sums = follow::Sums::new(self.simd);
            let near = &self.near[agent * self.near_words..(agent + 1) * self.near_words];
            let (xs, ys, counts) = (&self.x, &self.y, &mut self.seen);
            each_bit(
                near,
                #[inline(always)]
                |other| {
                    let seen = follow::influence::<S>(world, xs[other] - x, ys[other] - y, &mut sums);
                    if other < leaders {
                        let counts = &mut counts[(follower * leaders + other) * lanes..][..lanes];
                        let count = S::u32s::from_slice(self.simd, counts);
                        seen.select(count + 1, count).store_slice(counts);
                    }
                },
            );
            let (force_x, force_y) = follow::force::<S>(world, &sums, x, y);
            self.forces[follower] = [force_x, force_y];
            self.influenced[follower] = (sums.repel_count + sums.attract_count).simd_gt(0.0)
                | follow::wall_near::<S>(world, x, world.map_x)
                | follow::wall_near::<S>(world, y, world.map_y);
        }
        for (follower, (&[force_x, force_y], &influenced)) in self.forces.iter().zip(&self.influenced).enumerate() {
            let agent = leaders + follower;
            let (hx, hy, speed) = (self.hx[agent], self.hy[agent], self.speed[agent]);
            let (hx, hy, wanted) = follow::steer::<S>(world, force_x, force_y, influenced, hx, hy, speed);
            self.next[agent] = [hx, hy, wanted];
        }
    }

    /// Everyone moves.
    #[inline(always)]
    fn advance(&mut self) {
        let world = &self.world;
        for (agent, &[hx, hy, wanted]) in self.next.iter().enumerate() {
            let (hx, hy) = motion::straighten::<S>(hx, hy);
            let speed = motion::accelerate::<S>(world, self.speed[agent], wanted);
            let step = speed * world.dt;
            self.x[agent] = motion::advance::<S>(self.x[agent], step, hx, world.map_x);
            self.y[agent] = motion::advance::<S>(self.y[agent], step, hy, world.map_y);
            self.hx[agent] = hx;
            self.hy[agent] = hy;
            self.speed[agent] = speed;
        }
    }

    /// Records who is near each POI.
    #[inline(always)]
    fn couple(&mut self, pois: &[Vec2], step: usize) {
        let world = &self.world;
        let (words, lanes) = (world.words as usize, S::f32s::LEN);
        let zero = S::u32s::simd_from(self.simd, 0);
        for (index, poi) in pois.iter().enumerate() {
            let (x, y) = (splat(self.simd, poi.x), splat(self.simd, poi.y));
            for word in 0..words {
                let mut set = zero;
                let agents = word * 32..self.x.len().min(word * 32 + 32);
                for (bit, agent) in agents.enumerate() {
                    let near = couple::observes::<S>(world, x - self.x[agent], y - self.y[agent]);
                    set |= near.select(S::u32s::simd_from(self.simd, 1 << bit), zero);
                }
                let at = ((step * pois.len() + index) * words + word) * lanes;
                set.store_slice(&mut self.sets[at..at + lanes]);
            }
        }
    }

    /// One lane's record.
    fn episode(&self, lane: usize, group: usize, team: usize) -> Episode<'_> {
        let strided = |words| Strided { words, stride: S::f32s::LEN, offset: lane };
        Episode { group, team, sets: strided(&self.sets), seen: strided(&self.seen) }
    }

    /// One lane's agents as they stand; before the first step nothing has been sensed yet.
    fn moments(&self, lane: usize, sensed: bool, moments: &mut [Moment]) {
        let leaders = self.world.leaders as usize;
        for (agent, moment) in moments.iter_mut().enumerate() {
            if sensed && agent < leaders {
                moment.inputs = std::array::from_fn(|i| self.inputs[agent * INPUTS + i][lane]);
                moment.outputs = std::array::from_fn(|i| self.outputs[agent * OUTPUTS + i][lane]);
            } else if sensed {
                moment.force = self.forces[agent - leaders].map(|component| component[lane]);
            }
            moment.position = [self.x[agent][lane], self.y[agent][lane]];
            moment.heading = [self.hx[agent][lane], self.hy[agent][lane]];
            moment.speed = self.speed[agent][lane];
        }
    }
}

/// Rows turned into columns.
#[inline(always)]
fn transposed<S: Simd>([a, b, c, d]: [f32x4<S>; 4]) -> [f32x4<S>; 4] {
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

/// Puts some units where they belong, and tells how many.
#[inline(always)]
fn put<V: Copy, const UNITS: usize>(to: &mut [V], units: [V; UNITS]) -> usize {
    to[..UNITS].copy_from_slice(&units);
    UNITS
}

/// Calls `f` with the indices of set bits, ascending.
#[inline(always)]
fn each_bit(words: &[u64], mut f: impl FnMut(usize)) {
    for (index, &word) in words.iter().enumerate() {
        let mut word = word;
        while word != 0 {
            f(index * 64 + word.trailing_zeros() as usize);
            word &= word - 1;
        }
    }
}
