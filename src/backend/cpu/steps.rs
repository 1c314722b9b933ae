//! Episodes whose steps are written to the caller's arrays, on all threads, with noise on the actions if wanted.

use fearless_simd::{Simd, dispatch, f32x4, prelude::*};

use super::batch::{WorldBatch, world_batches};
use super::episode::EpisodeBlock;
use super::transpose::transpose4;
use super::{BackendError, Cpu, Group, GroupScores, ScoreTable};
use crate::credit;
use crate::evolve::{self, Key};
use crate::kernels::{clamp_to, splat};
use crate::parallel::*;
use crate::world::{INPUTS, OUTPUTS, World};

/// Arrays for every step of every team. Empty arrays are not written.
///
/// The teams of all groups follow each other. Index 0 of `inputs`, `outputs`, `actions` and `near` is the first step;
/// index 0 of the others is the start.
#[derive(Default)]
pub struct StepArrays<'a> {
    /// `[teams][steps + 1][agents][2]`, in units.
    pub positions: &'a mut [f32],
    /// `[teams][steps + 1][agents][2]`, unit vectors.
    pub headings: &'a mut [f32],
    /// `[teams][steps + 1][agents]`, in units per second.
    pub speeds: &'a mut [f32],
    /// Inputs of the leaders, `[teams][steps][leaders][8]`.
    pub inputs: &'a mut [f32],
    /// The answers of their policies, `[teams][steps][leaders][2]`.
    pub outputs: &'a mut [f32],
    /// These with noise, before they are clamped to -1..1, `[teams][steps][leaders][2]`.
    pub actions: &'a mut [f32],
    /// The agents within the observation radius of each POI, one bit per agent, `[teams][steps][pois][words]`.
    pub near: &'a mut [u32],
    /// The step, from 1, at which each POI was observed, or 0, `[teams][pois]`.
    pub observed_at: &'a mut [u32],
}

/// Numbers that one team has in each of [`StepArrays`], in their order.
fn step_sizes(world: &World) -> [usize; 8] {
    let (agents, steps) = (world.agents(), world.steps());
    let leaders = steps * world.leaders();
    let states = (steps + 1) * agents;
    let (inputs, outputs) = (leaders * INPUTS, leaders * OUTPUTS);
    [states * 2, states * 2, states, inputs, outputs, outputs, world.set_words(), world.pois.len()]
}

/// Normal noise on the actions of leaders.
#[derive(Clone, Copy, Debug)]
pub struct Noise<'a> {
    /// The key of [`Purpose::Exploration`](crate::evolve::Purpose::Exploration).
    pub key: Key,
    /// The standard deviation of each leader's turn and speed, `[leaders]`.
    pub deviations: &'a [[f32; OUTPUTS]],
    /// The number of the first team, which with those after it selects the noise.
    pub first: u32,
}

impl<'a> StepArrays<'a> {
    /// Returns the index of the first array that is neither empty nor as long as needed.
    fn wrong_length(&self, sizes: [usize; 8], teams: usize) -> Option<usize> {
        let StepArrays { positions, headings, speeds, inputs, outputs, actions, near, observed_at } = self;
        let found = [positions, headings, speeds, inputs, outputs, actions].map(|array| array.len());
        let found = found.into_iter().chain([near.len(), observed_at.len()]);
        found.zip(sizes).position(|(found, size)| found != 0 && found != size * teams)
    }

    /// Splits off the first teams.
    fn split(&mut self, sizes: [usize; 8], teams: usize) -> StepArrays<'a> {
        fn take<'a, T>(slice: &mut &'a mut [T], count: usize) -> &'a mut [T] {
            let count = count.min(slice.len());
            let (taken, rest) = std::mem::take(slice).split_at_mut(count);
            *slice = rest;
            taken
        }
        let [positions, headings, speeds, inputs, outputs, actions, near, observed_at] = sizes.map(|size| size * teams);
        StepArrays {
            positions: take(&mut self.positions, positions),
            headings: take(&mut self.headings, headings),
            speeds: take(&mut self.speeds, speeds),
            inputs: take(&mut self.inputs, inputs),
            outputs: take(&mut self.outputs, outputs),
            actions: take(&mut self.actions, actions),
            near: take(&mut self.near, near),
            observed_at: take(&mut self.observed_at, observed_at),
        }
    }
}

impl Cpu {
    /// Plays every team of some groups of one world, writes their steps, and scores them.
    ///
    /// Without noise, the states are those of [`Backend::trace`](crate::backend::Backend::trace).
    ///
    /// # Errors
    /// A group is inconsistent, or an array has the wrong length.
    pub fn record(
        &self,
        groups: &[Group<'_>],
        noise: Option<Noise<'_>>,
        arrays: StepArrays<'_>,
    ) -> Result<Vec<GroupScores>, BackendError> {
        groups.iter().try_for_each(|group| group.check().and(group.weights.on_host().map(drop)))?;
        let batches = world_batches(groups);
        let [run] = &batches[..] else {
            return Err(BackendError::InvalidInput("steps are recorded of groups of one world".into()));
        };
        if let Some(index) = arrays.wrong_length(step_sizes(run.world), run.teams) {
            return Err(BackendError::InvalidInput(format!("array {index} of the steps has the wrong length")));
        }
        if noise.is_some_and(|noise| noise.deviations.len() != run.world.leaders()) {
            return Err(BackendError::InvalidInput("noise is of every leader".into()));
        }
        let (level, scores) = (self.level, ScoreTable::new(groups));
        dispatch!(level, simd => record(simd, run, noise, arrays, &scores));
        Ok(scores.finish())
    }
}

fn record<S: Simd>(
    simd: S,
    run: &WorldBatch<'_>,
    noise: Option<Noise<'_>>,
    mut arrays: StepArrays<'_>,
    scores: &ScoreTable<'_>,
) {
    let (width, sizes) = (S::f32s::LEN, step_sizes(run.world));
    let part = |first: usize| {
        let teams = width.min(run.teams - first);
        (first, teams, arrays.split(sizes, teams))
    };
    let mut parts: Vec<(usize, usize, StepArrays<'_>)> = (0..run.teams).step_by(width).map(part).collect();
    // One block for several vectors, because blocks are large.
    parts.par_chunks_mut(PARTS).for_each(|parts| {
        let mut whole = EpisodeBlock::new(simd, run.world, run.sighted);
        for (first, teams, arrays) in parts {
            simd.vectorize(
                #[inline(always)]
                || play(simd, &mut whole, run, noise, *first, *teams, arrays),
            );
            let mut observed_at = arrays.observed_at.chunks_exact_mut(run.world.pois.len());
            for lane in 0..*teams {
                let ((group, team), episode) = (run.locate(*first + lane), whole.episode(lane));
                scores.score(run.first + group, team, &episode);
                if let Some(to) = observed_at.next() {
                    let steps = credit::observed_at(episode.sets, run.world);
                    to.iter_mut().zip(steps).for_each(|(to, step)| *to = step.unwrap_or(0) as u32);
                }
            }
        }
    });
}

/// Vectors of teams per task.
const PARTS: usize = 8;

#[inline(always)]
fn play<S: Simd>(
    simd: S,
    whole: &mut EpisodeBlock<S>,
    run: &WorldBatch<'_>,
    noise: Option<Noise<'_>>,
    first: usize,
    teams: usize,
    arrays: &mut StepArrays<'_>,
) {
    let world = run.world;
    let (agents, leaders, steps) = (world.agents(), world.leaders(), world.steps());
    let sets = world.pois.len() * world.constants.words as usize;
    whole.load(run, first, teams);
    write_states(simd, whole, arrays, agents, steps, 0);
    for step in 0..steps {
        whole.sense(world);
        let (block, columns) = (&mut whole.block, leaders * OUTPUTS);
        rows(simd, leaders * INPUTS, steps, step, arrays.inputs, |column| {
            block.inputs.as_flattened()[column].as_slice()
        });
        rows(simd, columns, steps, step, arrays.outputs, |column| block.outputs.as_flattened()[column].as_slice());
        if let Some(Noise { key, deviations, first: number }) = noise {
            let teams = S::u32s::from_fn(simd, |lane| number.wrapping_add((first + lane) as u32));
            for (leader, (outputs, deviations)) in block.outputs.iter_mut().zip(deviations).enumerate() {
                let drawn = evolve::noise::<S>(key, step, leader, teams);
                for ((output, &deviation), drawn) in outputs.iter_mut().zip(deviations).zip(drawn) {
                    *output += drawn * splat(simd, deviation);
                }
            }
        }
        rows(simd, columns, steps, step, arrays.actions, |column| block.outputs.as_flattened()[column].as_slice());
        if noise.is_some() {
            for output in block.outputs.as_flattened_mut() {
                *output = clamp_to::<S>(*output, splat(simd, -1.0), splat(simd, 1.0));
            }
        }
        whole.advance(world, step);
        write_states(simd, whole, arrays, agents, steps, step + 1);
        let near = bytemuck::cast_slice_mut(arrays.near);
        let taken = bytemuck::cast_slice::<u32, f32>(whole.sets_of(step, sets));
        rows(simd, sets, steps, step, near, |column| &taken[column * S::f32s::LEN..][..S::f32s::LEN]);
    }
    whole.store_counts();
}

/// Writes positions, headings and speeds after a step.
#[inline(always)]
fn write_states<S: Simd>(
    simd: S,
    whole: &EpisodeBlock<S>,
    arrays: &mut StepArrays<'_>,
    agents: usize,
    steps: usize,
    step: usize,
) {
    let all = &whole.block.agents;
    rows(simd, agents * 2, steps + 1, step, arrays.positions, |column| {
        if column % 2 == 0 { all[column / 2].x.as_slice() } else { all[column / 2].y.as_slice() }
    });
    rows(simd, agents * 2, steps + 1, step, arrays.headings, |column| {
        if column % 2 == 0 { all[column / 2].hx.as_slice() } else { all[column / 2].hy.as_slice() }
    });
    rows(simd, agents, steps + 1, step, arrays.speeds, |column| all[column].speed.as_slice());
}

/// Transposes `count` columns, one team per lane, into row `step` of each team's `steps` rows. Does nothing without an
/// array.
#[inline(always)]
fn rows<'a, S: Simd>(
    simd: S,
    count: usize,
    steps: usize,
    step: usize,
    array: &mut [f32],
    column: impl Fn(usize) -> &'a [f32],
) {
    if array.is_empty() {
        return;
    }
    let size = count * steps;
    let whole = count / 4 * 4;
    for (first, teams) in (0..).step_by(4).zip(array.chunks_mut(size * 4)) {
        let mut start = 0;
        if teams.len() == size * 4 {
            let (ab, cd) = teams.split_at_mut(size * 2);
            let ((a, b), (c, d)) = (ab.split_at_mut(size), cd.split_at_mut(size));
            let [a, b, c, d] = [a, b, c, d].map(|row| &mut row[step * count..(step + 1) * count]);
            for at in (0..whole).step_by(4) {
                let fours = [
                    f32x4::from_slice(simd, &column(at)[first..first + 4]),
                    f32x4::from_slice(simd, &column(at + 1)[first..first + 4]),
                    f32x4::from_slice(simd, &column(at + 2)[first..first + 4]),
                    f32x4::from_slice(simd, &column(at + 3)[first..first + 4]),
                ];
                let turned = transpose4(fours);
                turned[0].store_slice(&mut a[at..at + 4]);
                turned[1].store_slice(&mut b[at..at + 4]);
                turned[2].store_slice(&mut c[at..at + 4]);
                turned[3].store_slice(&mut d[at..at + 4]);
            }
            start = whole;
        }
        for at in start..count {
            let lanes = &column(at)[first..];
            teams.chunks_exact_mut(size).zip(lanes).for_each(|(team, &number)| team[step * count + at] = number);
        }
    }
}
