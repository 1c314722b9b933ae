//! The vectors of teams behind a [`Stepper`](super::Stepper).

use std::sync::{Mutex, PoisonError};

use fearless_simd::{Simd, f32x4, prelude::*};
use glam::Vec2;

use crate::backend::cpu::{Agent, Block, Standing, transposed, turn};
use crate::backend::{Episode, Seen, Strided};
use crate::kernels::{bound, splat};
use crate::parallel::*;
use crate::world::{INPUTS, OUTPUTS, World};

/// What is told of all teams.
pub(super) struct Shown {
    pub(super) inputs: Vec<f32>,
    pub(super) near: Vec<u32>,
    pub(super) newly: Vec<bool>,
    pub(super) observed: Vec<bool>,
    pub(super) steps: Vec<u32>,
    pub(super) positions: Vec<f32>,
    pub(super) headings: Vec<f32>,
    pub(super) speeds: Vec<f32>,
}

/// Vectors of teams of some instruction set.
pub(super) trait Vectors: Send + Sync {
    fn reset(&mut self, world: &World, chosen: Option<&[bool]>, starts: Option<&[Vec2]>, shown: &mut Shown);
    fn step(&mut self, world: &World, actions: &[f32], shown: &mut Shown);
    fn states(&mut self, world: &World, shown: &mut Shown);
    /// Makes room for the sights of all steps.
    fn keep_sights(&mut self, world: &World);
    /// The record of a team, if one is kept; `seen` takes a part of it.
    fn episode<'a>(&'a self, team: usize, world: &World, seen: &'a mut Vec<u32>) -> Option<Episode<'a>>;
}

/// One vector of teams. Between steps it keeps no more than it needs, for many go through the caches.
struct Part<S: Simd> {
    /// The first of the teams, and how many there are.
    first: usize,
    teams: usize,
    standing: Standing<S>,
    /// Who was near each POI at each step, `[teams][steps][pois][words]`, if that is kept.
    record: Vec<u32>,
    /// Which leaders each follower saw at each step, `[teams][steps][followers][words of leaders]`, if that is kept.
    sights: Vec<u32>,
}

/// What a thread plays a step with: the block takes on what stands of one vector of teams after the other.
struct Room<S: Simd> {
    block: Block<S>,
    /// Who is near each POI, `[pois][words][lanes]`.
    sets: Vec<u32>,
    /// Which leaders each follower sees, `[followers][words of leaders][lanes]`.
    sights: Vec<u32>,
    /// Agents and counts before a step, where some teams are over.
    kept: (Vec<Agent<S>>, Vec<S::u32s>),
}

/// Vectors of teams, and the rooms of as many threads as have been at work at once.
struct Batch<S: Simd> {
    simd: S,
    parts: Vec<Part<S>>,
    idle: Mutex<Vec<Box<Room<S>>>>,
}

pub(super) fn vectors<S: Simd>(simd: S, world: &World, teams: usize, record: usize) -> Box<dyn Vectors> {
    let part = |first: usize| {
        let teams = S::f32s::LEN.min(teams - first);
        let standing = Block::new(simd, world).into_standing(record > 0);
        Part { first, teams, standing, record: vec![0; teams * record], sights: vec![] }
    };
    let parts = (0..teams).step_by(S::f32s::LEN).map(part).collect();
    Box::new(Batch { simd, parts, idle: Mutex::default() })
}

/// So many vectors are done by one thread, which takes less time than to wake another.
pub(super) const FEW: usize = 8;

impl<S: Simd> Vectors for Batch<S> {
    fn reset(&mut self, world: &World, chosen: Option<&[bool]>, starts: Option<&[Vec2]>, shown: &mut Shown) {
        let simd = self.simd;
        self.each(world, shown, &|room, part, shown| {
            simd.vectorize(
                #[inline(always)]
                || room.reset(simd, world, part, chosen, starts, shown),
            );
        });
    }

    fn step(&mut self, world: &World, actions: &[f32], shown: &mut Shown) {
        let simd = self.simd;
        self.each(world, shown, &|room, part, shown| {
            simd.vectorize(
                #[inline(always)]
                || room.step(simd, world, part, actions, shown),
            );
        });
    }

    fn states(&mut self, world: &World, shown: &mut Shown) {
        let simd = self.simd;
        self.each(world, shown, &|_, part, shown| {
            simd.vectorize(
                #[inline(always)]
                || show(simd, &part.standing.agents, shown),
            );
        });
    }

    fn keep_sights(&mut self, world: &World) {
        for part in &mut self.parts {
            part.sights = vec![0; part.teams * world.sight_words()];
        }
    }

    fn episode<'a>(&'a self, team: usize, world: &World, seen: &'a mut Vec<u32>) -> Option<Episode<'a>> {
        let (part, lane) = (&self.parts[team / S::f32s::LEN], team % S::f32s::LEN);
        let words = world.set_words();
        let sets = part.record.get(lane * words..(lane + 1) * words)?;
        seen.clear();
        seen.extend(part.standing.counts.iter().map(|count| count[lane]));
        let plain = |words| Strided { words, stride: 1, offset: 0 };
        let (first, words) = (lane * world.sight_words(), world.sight_words());
        let sights = plain(part.sights.get(first..first + words).unwrap_or_default());
        Some(Episode { group: 0, team, sets: plain(sets), seen: Seen::Counts(plain(seen)), sights })
    }
}

impl<S: Simd> Batch<S> {
    /// Does something with every vector, shared out over threads.
    fn each(
        &mut self,
        world: &World,
        shown: &mut Shown,
        act: &(impl Fn(&mut Room<S>, &mut Part<S>, Slices<'_>) + Sync),
    ) {
        let (simd, parts, idle) = (self.simd, &mut self.parts, &self.idle);
        View::new(parts, shown).each(world, &|parts, mut shown| {
            let room = idle.lock().unwrap_or_else(PoisonError::into_inner).pop();
            let mut room = room.unwrap_or_else(|| Box::new(Room::new(simd, world)));
            for part in parts {
                let own = shown.split(part.teams, world);
                act(&mut room, part, own);
            }
            idle.lock().unwrap_or_else(PoisonError::into_inner).push(room);
        });
    }
}

/// Some vectors of teams, and what is told of them.
struct View<'a, S: Simd> {
    parts: &'a mut [Part<S>],
    shown: Slices<'a>,
}

/// [`Shown`] of some teams.
struct Slices<'a> {
    inputs: &'a mut [f32],
    near: &'a mut [u32],
    newly: &'a mut [bool],
    observed: &'a mut [bool],
    steps: &'a mut [u32],
    positions: &'a mut [f32],
    headings: &'a mut [f32],
    speeds: &'a mut [f32],
}

impl<'a, S: Simd> View<'a, S> {
    fn new(parts: &'a mut [Part<S>], shown: &'a mut Shown) -> View<'a, S> {
        let Shown { inputs, near, newly, observed, steps, positions, headings, speeds } = shown;
        View { parts, shown: Slices { inputs, near, newly, observed, steps, positions, headings, speeds } }
    }

    /// Does something with a few at a time, shared out over threads.
    fn each(self, world: &World, act: &(impl Fn(&'a mut [Part<S>], Slices<'a>) + Sync)) {
        let View { parts, mut shown } = self;
        if parts.len() > FEW {
            let (low, high) = parts.split_at_mut(parts.len() / 2);
            let first = shown.split(low.len() * S::f32s::LEN, world);
            let (low, high) = (View { parts: low, shown: first }, View { parts: high, shown });
            join(|| low.each(world, act), || high.each(world, act));
        } else {
            act(parts, shown);
        }
    }
}

impl<'a> Slices<'a> {
    /// Takes the first teams off.
    fn split(&mut self, teams: usize, world: &World) -> Slices<'a> {
        fn take<'a, T>(slice: &mut &'a mut [T], count: usize) -> &'a mut [T] {
            let (taken, rest) = std::mem::take(slice).split_at_mut(count);
            *slice = rest;
            taken
        }
        let (agents, pois) = (world.agents(), world.pois.len());
        Slices {
            inputs: take(&mut self.inputs, teams * world.leaders() * INPUTS),
            near: take(&mut self.near, teams * pois * world.constants.words as usize),
            newly: take(&mut self.newly, teams * pois),
            observed: take(&mut self.observed, teams * pois),
            steps: take(&mut self.steps, teams),
            positions: take(&mut self.positions, teams * agents * 2),
            headings: take(&mut self.headings, teams * agents * 2),
            speeds: take(&mut self.speeds, teams * agents),
        }
    }
}

/// The team in a lane of a vector of so many; lanes left over repeat the first.
#[inline(always)]
fn team_of(lane: usize, teams: usize) -> usize {
    if lane < teams { lane } else { 0 }
}

/// Every lane and its team, in a vector of so many.
#[inline(always)]
fn lanes<S: Simd>(teams: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..S::f32s::LEN).map(move |lane| (lane, team_of(lane, teams)))
}

impl<S: Simd> Room<S> {
    fn new(simd: S, world: &World) -> Room<S> {
        let sets = vec![0; world.pois.len() * world.constants.words as usize * S::f32s::LEN];
        let sights = vec![0; world.followers() * world.leader_words() * S::f32s::LEN];
        Room { block: Block::new(simd, world), sets, sights, kept: Default::default() }
    }

    #[inline(always)]
    fn reset(
        &mut self,
        simd: S,
        world: &World,
        part: &mut Part<S>,
        chosen: Option<&[bool]>,
        starts: Option<&[Vec2]>,
        shown: Slices<'_>,
    ) {
        let Slices { inputs, near, newly, observed, steps, .. } = shown;
        let (agents, pois, words) = (world.agents(), world.pois.len(), world.constants.words as usize);
        let Part { first, teams, ref mut standing, ref mut record, ref mut sights } = *part;
        let is_chosen = |team: usize| chosen.is_none_or(|chosen| chosen[team]);
        if !(first..first + teams).any(is_chosen) {
            return;
        }
        self.block.swap(standing);
        let all = (first..first + teams).all(is_chosen);
        if all {
            self.block.start();
        }
        for (lane, team) in lanes::<S>(teams).filter(|&(_, team)| is_chosen(first + team)) {
            let at = (first + team) * agents;
            let starts = starts.map_or(&world.starts[..], |starts| &starts[at..at + agents]);
            self.block.place(lane, starts, &world.headings);
            if !all {
                self.block.start_lane(lane);
            }
        }
        let (size, seen) = (record.len() / teams, sights.len() / teams);
        for team in (0..teams).filter(|team| is_chosen(first + team)) {
            near[team * pois * words..][..pois * words].fill(0);
            newly[team * pois..][..pois].fill(false);
            observed[team * pois..][..pois].fill(false);
            steps[team] = 0;
            record[team * size..][..size].fill(0);
            sights[team * seen..][..seen].fill(0);
        }
        self.sense(simd, world, inputs);
        self.block.swap(standing);
    }

    #[inline(always)]
    fn step(&mut self, simd: S, world: &World, part: &mut Part<S>, actions: &[f32], shown: Slices<'_>) {
        let Slices { inputs, near, newly, observed, steps, .. } = shown;
        let last = world.constants.steps;
        let playing = (0..).zip(&*steps).map(|(team, &step)| u64::from(step < last) << team).sum::<u64>();
        newly.fill(false);
        let Part { first, teams, ref mut standing, ref mut record, ref mut sights } = *part;
        if playing == 0 {
            return;
        }
        self.block.swap(standing);
        self.take(simd, world, &actions[first * world.leaders() * OUTPUTS..], teams);
        if !sights.is_empty() {
            self.watch(world, steps, sights);
        }
        if playing.count_ones() as usize == teams {
            self.block.go();
        } else {
            let (agents, counts) = &mut self.kept;
            agents.clone_from(&self.block.agents);
            counts.clone_from(&self.block.counts);
            self.block.go();
            lanes::<S>(teams).filter(|&(_, team)| steps[team] >= last).for_each(|(lane, _)| self.keep(lane));
        }
        self.block.couple(&world.pois, &mut self.sets);
        let (pois, words) = (world.pois.len(), world.constants.words as usize);
        let width = S::f32s::LEN;
        let sets = bytemuck::cast_slice::<u32, f32>(&self.sets);
        to_rows(
            simd,
            pois * words,
            #[inline(always)]
            |column| &sets[column * width..][..width],
            bytemuck::cast_slice_mut(near),
        );
        // What is observed by a step opens no other POI before the next.
        let rule = &world.rule;
        for (poi, (sets, &coupling)) in self.sets.chunks_exact(words * width).zip(&world.coupling).enumerate() {
            let count = sets.chunks_exact(width).enumerate().fold(S::u32s::splat(simd, 0), |count, (word, sets)| {
                count + ones::<S>(S::u32s::from_slice(simd, sets) & rule.counted(word, u32::MAX))
            });
            let mut enough = count.simd_ge(coupling).to_bitmask() & playing;
            while enough != 0 {
                let team = enough.trailing_zeros() as usize;
                let before = &observed[team * pois..][..pois];
                newly[team * pois + poi] = !before[poi] && rule.is_open(poi, steps[team] + 1, before);
                enough &= enough - 1;
            }
        }
        observed.iter_mut().zip(newly).for_each(|(observed, newly)| *observed |= *newly);
        if !record.is_empty() {
            let size = pois * words;
            for (team, &step) in steps.iter().enumerate().filter(|(_, step)| **step < last) {
                let at = team * world.set_words() + step as usize * size;
                record[at..at + size].copy_from_slice(&near[team * size..][..size]);
            }
        }
        steps.iter_mut().for_each(|step| *step = last.min(*step + 1));
        self.sense(simd, world, inputs);
        self.block.swap(standing);
    }

    /// Records who sees whom before this step of each team that has not played its last.
    #[inline(always)]
    fn watch(&mut self, world: &World, steps: &[u32], sights: &mut [u32]) {
        self.block.watch(&mut self.sights);
        let size = world.followers() * world.leader_words();
        for (team, &step) in steps.iter().enumerate().filter(|(_, step)| **step < world.constants.steps) {
            let to = &mut sights[team * world.sight_words() + step as usize * size..][..size];
            to.iter_mut().zip(self.sights[team..].iter().step_by(S::f32s::LEN)).for_each(|(to, &seen)| *to = seen);
        }
    }

    /// Takes the actions of so many teams as the policies' answers.
    #[inline(always)]
    fn take(&mut self, simd: S, world: &World, actions: &[f32], teams: usize) {
        let columns = world.leaders() * OUTPUTS;
        for quad in 0..S::f32s::LEN / 4 {
            let row = |lane: usize| &actions[team_of(quad * 4 + lane, teams) * columns..][..columns];
            let rows = [row(0), row(1), row(2), row(3)];
            let outputs = self.block.outputs.as_flattened_mut();
            turn(
                simd,
                rows,
                #[inline(always)]
                |column, lanes| outputs[column].as_mut_slice()[quad * 4..quad * 4 + 4].copy_from_slice(lanes),
            );
        }
        for output in self.block.outputs.as_flattened_mut() {
            *output = bound::<S>(*output, splat(simd, -1.0), splat(simd, 1.0));
        }
    }

    /// Puts a lane back to what was kept of it.
    #[inline(always)]
    fn keep(&mut self, lane: usize) {
        let (agents, counts) = &self.kept;
        for (agent, kept) in self.block.agents.iter_mut().zip(agents) {
            agent.x[lane] = kept.x[lane];
            agent.y[lane] = kept.y[lane];
            agent.hx[lane] = kept.hx[lane];
            agent.hy[lane] = kept.hy[lane];
            agent.speed[lane] = kept.speed[lane];
        }
        for (count, kept) in self.block.counts.iter_mut().zip(counts) {
            count[lane] = kept[lane];
        }
    }

    #[inline(always)]
    fn sense(&mut self, simd: S, world: &World, inputs: &mut [f32]) {
        self.block.look(&world.pois);
        let columns = self.block.inputs.as_flattened();
        to_rows(
            simd,
            columns.len(),
            #[inline(always)]
            |column| columns[column].as_slice(),
            inputs,
        );
    }
}

/// Shows everyone's places, headings and speeds.
#[inline(always)]
fn show<S: Simd>(simd: S, agents: &[Agent<S>], shown: Slices<'_>) {
    to_rows(
        simd,
        2 * agents.len(),
        #[inline(always)]
        |column| if column % 2 == 0 { agents[column / 2].x.as_slice() } else { agents[column / 2].y.as_slice() },
        shown.positions,
    );
    to_rows(
        simd,
        2 * agents.len(),
        #[inline(always)]
        |column| if column % 2 == 0 { agents[column / 2].hx.as_slice() } else { agents[column / 2].hy.as_slice() },
        shown.headings,
    );
    to_rows(
        simd,
        agents.len(),
        #[inline(always)]
        |column| agents[column].speed.as_slice(),
        shown.speeds,
    );
}

/// How many bits of each lane are set.
#[inline(always)]
fn ones<S: Simd>(bits: S::u32s) -> S::u32s {
    let pairs = bits - ((bits >> 1) & 0x5555_5555);
    let fours = (pairs & 0x3333_3333) + ((pairs >> 2) & 0x3333_3333);
    let eights = (fours + (fours >> 4)) & 0x0f0f_0f0f;
    let halves = eights + (eights >> 8);
    (halves + (halves >> 16)) & 0x3f
}

/// Turns columns, a lane a team, into a row of numbers a team; lanes that have no row are left out.
#[inline(always)]
fn to_rows<'a, S: Simd>(simd: S, count: usize, column: impl Fn(usize) -> &'a [f32], rows: &mut [f32]) {
    let whole = count / 4 * 4;
    for (first, rows) in (0..).step_by(4).zip(rows.chunks_mut(count * 4)) {
        let mut start = 0;
        if rows.len() == count * 4 {
            let (ab, cd) = rows.split_at_mut(count * 2);
            let ((a, b), (c, d)) = (ab.split_at_mut(count), cd.split_at_mut(count));
            for at in (0..whole).step_by(4) {
                let four = |at: usize| f32x4::from_slice(simd, &column(at)[first..first + 4]);
                let turned = transposed([four(at), four(at + 1), four(at + 2), four(at + 3)]);
                turned[0].store_slice(&mut a[at..at + 4]);
                turned[1].store_slice(&mut b[at..at + 4]);
                turned[2].store_slice(&mut c[at..at + 4]);
                turned[3].store_slice(&mut d[at..at + 4]);
            }
            start = whole;
        }
        for at in start..count {
            rows.chunks_exact_mut(count).zip(&column(at)[first..]).for_each(|(row, &number)| row[at] = number);
        }
    }
}
