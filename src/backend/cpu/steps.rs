//! Episodes whose steps are written to the caller's arrays, on all threads, with noise on the actions if wanted.

use fearless_simd::{Simd, dispatch, prelude::*};

use super::agent::Agent;
use super::batch::{WorldBatch, world_batches};
use super::block::Block;
use super::episode::Observer;
use super::swarm::{Swarm, Watch};
use super::transpose::to_rows;
use super::{BackendError, Cpu, Group, GroupScores, ScoreTable, Workspace, is_large};
use crate::credit::{self, Episode};
use crate::evolve::{self, Key};
use crate::kernels::{clamp_to, splat};
use crate::parallel::*;
use crate::world::{OUTPUTS, World};

/// Arrays for every step of every team. Empty arrays are not written.
///
/// The teams of all groups follow each other. Index 0 of `inputs`, `outputs`, `actions` and `agents_at_poi` is the first
/// step; index 0 of the others is the start.
#[derive(Default)]
pub struct StepArrays<'a> {
    /// `[teams][steps + 1][agents][2]`, in units.
    pub positions: &'a mut [f32],
    /// `[teams][steps + 1][agents][2]`, unit vectors.
    pub headings: &'a mut [f32],
    /// `[teams][steps + 1][agents]`, in units per second.
    pub speeds: &'a mut [f32],
    /// Inputs of the leaders, `[teams][steps][leaders][inputs]`.
    pub inputs: &'a mut [f32],
    /// Outputs of their policies, `[teams][steps][leaders][2]`.
    pub outputs: &'a mut [f32],
    /// These with noise, before they are clamped to -1..1, `[teams][steps][leaders][2]`.
    pub actions: &'a mut [f32],
    /// The agents within the observation radius of each POI, one bit per agent, `[teams][steps][pois][words]`.
    pub agents_at_poi: &'a mut [u32],
    /// The step, from 1, at which each POI was observed, or 0, `[teams][pois]`.
    pub observed_at: &'a mut [u32],
}

/// Numbers that one team has in each of [`StepArrays`], in their order, with so many states and steps.
pub(crate) fn step_sizes(world: &World, states: usize, steps: usize) -> [usize; 8] {
    let (states, leaders) = (states * world.agents(), steps * world.leaders());
    let (inputs, outputs, sets) = (leaders * world.inputs(), leaders * OUTPUTS, steps * world.words_per_step());
    [states * 2, states * 2, states, inputs, outputs, outputs, sets, world.pois.len()]
}

/// Normal noise on the actions of leaders.
#[derive(Clone, Copy, Debug)]
pub struct Noise<'a> {
    /// The key of [`Purpose::Exploration`](crate::evolve::Purpose::Exploration).
    pub key: Key,
    /// The standard deviation of each leader's turn and speed, `[leaders]`.
    pub deviations: &'a [[f32; OUTPUTS]],
    /// The number of the first team. A team's number selects its noise.
    pub first: u32,
}

impl<'a> StepArrays<'a> {
    /// Returns the index of the first array that is neither empty nor as long as needed.
    fn wrong_length(&self, sizes: [usize; 8], teams: usize) -> Option<usize> {
        let StepArrays { positions, headings, speeds, inputs, outputs, actions, agents_at_poi, observed_at } = self;
        let found = [positions, headings, speeds, inputs, outputs, actions].map(|array| array.len());
        let found = found.into_iter().chain([agents_at_poi.len(), observed_at.len()]);
        found.zip(sizes).position(|(found, size)| found != 0 && found != size * teams)
    }

    /// Splits off the first teams. Empty arrays stay empty.
    pub(crate) fn split(&mut self, sizes: [usize; 8], teams: usize) -> StepArrays<'a> {
        let [positions, headings, speeds, inputs, outputs, actions, agents_at_poi, observed_at] =
            sizes.map(|size| size * teams);
        StepArrays {
            positions: self.positions.split_off_mut(..positions).unwrap_or_default(),
            headings: self.headings.split_off_mut(..headings).unwrap_or_default(),
            speeds: self.speeds.split_off_mut(..speeds).unwrap_or_default(),
            inputs: self.inputs.split_off_mut(..inputs).unwrap_or_default(),
            outputs: self.outputs.split_off_mut(..outputs).unwrap_or_default(),
            actions: self.actions.split_off_mut(..actions).unwrap_or_default(),
            agents_at_poi: self.agents_at_poi.split_off_mut(..agents_at_poi).unwrap_or_default(),
            observed_at: self.observed_at.split_off_mut(..observed_at).unwrap_or_default(),
        }
    }
}

/// Writes the quantities of one vector of teams to row `row` of each team's `rows` rows.
impl StepArrays<'_> {
    /// Writes positions, headings and speeds.
    #[inline(always)]
    pub(crate) fn write_states<S: Simd>(&mut self, simd: S, all: &[Agent<S>], row: (usize, usize)) {
        let agents = all.len();
        to_rows(
            simd,
            agents * 2,
            row,
            self.positions,
            #[inline(always)]
            |column| if column % 2 == 0 { all[column / 2].x.as_slice() } else { all[column / 2].y.as_slice() },
        );
        to_rows(
            simd,
            agents * 2,
            row,
            self.headings,
            #[inline(always)]
            |column| if column % 2 == 0 { all[column / 2].hx.as_slice() } else { all[column / 2].hy.as_slice() },
        );
        to_rows(
            simd,
            agents,
            row,
            self.speeds,
            #[inline(always)]
            |column| all[column].speed.as_slice(),
        );
    }

    /// Writes what the leaders sense.
    #[inline(always)]
    pub(crate) fn write_inputs<S: Simd>(&mut self, block: &Block<S>, row: (usize, usize)) {
        write_columns(block.simd, &block.inputs, row, self.inputs);
    }

    /// Writes the agents at each POI, `[pois][words][lanes]`.
    #[inline(always)]
    pub(crate) fn write_sets<S: Simd>(&mut self, simd: S, sets: &[u32], row: (usize, usize)) {
        let (sets, to) = (bytemuck::cast_slice(sets), bytemuck::cast_slice_mut(self.agents_at_poi));
        to_rows(
            simd,
            sets.len() / S::f32s::LEN,
            row,
            to,
            #[inline(always)]
            |column| &sets[column * S::f32s::LEN..][..S::f32s::LEN],
        );
    }
}

#[inline(always)]
fn write_columns<S: Simd>(simd: S, columns: &[S::f32s], row: (usize, usize), to: &mut [f32]) {
    to_rows(
        simd,
        columns.len(),
        row,
        to,
        #[inline(always)]
        |column| columns[column].as_slice(),
    );
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
        let [batch] = &batches[..] else {
            return Err(BackendError::InvalidInput("steps are recorded of groups of one world".into()));
        };
        if let Some(index) =
            arrays.wrong_length(step_sizes(batch.world, batch.world.steps() + 1, batch.world.steps()), batch.teams)
        {
            return Err(BackendError::InvalidInput(format!("array {index} of the steps has the wrong length")));
        }
        if noise.is_some_and(|noise| noise.deviations.len() != batch.world.leaders()) {
            return Err(BackendError::InvalidInput("noise is of every leader".into()));
        }
        let (level, scores) = (self.level, ScoreTable::new(groups));
        let is_large = is_large(batch.world, self.large_from);
        dispatch!(level, simd => record(simd, batch, is_large, noise, arrays, &scores));
        Ok(scores.finish())
    }
}

/// Plays and scores the teams of a batch, and writes every step to the arrays. Large teams play one at a time.
fn record<S: Simd>(
    simd: S,
    batch: &WorldBatch<'_>,
    is_large: bool,
    noise: Option<Noise<'_>>,
    mut arrays: StepArrays<'_>,
    scores: &ScoreTable<'_>,
) {
    let (world, steps) = (batch.world, batch.world.steps());
    let (width, sizes) = (if is_large { 1 } else { S::f32s::LEN }, step_sizes(world, steps + 1, steps));
    let part = |first: usize| {
        let teams = width.min(batch.teams - first);
        (first, teams, arrays.split(sizes, teams))
    };
    let mut parts: Vec<(usize, usize, StepArrays<'_>)> = (0..batch.teams).step_by(width).map(part).collect();
    // One workspace for several parts, because they are large.
    let together = if is_large { parts.len().div_ceil(current_num_threads()).max(1) } else { VECTORS_PER_TASK };
    parts.par_chunks_mut(together).for_each(|parts| {
        let mut workspace = Workspace::Unused;
        for &mut (first, teams, ref mut arrays) in parts {
            let observed_at = std::mem::take(&mut arrays.observed_at);
            if is_large {
                let swarm = workspace.swarm(simd, batch);
                swarm.play(batch, first, &mut LargeRecorder { world, noise, team: first, arrays });
                swarm.score(batch, first, scores);
                write_observed(world, observed_at, |_| swarm.episode());
            } else {
                let block = workspace.block(simd, batch);
                simd.vectorize(
                    #[inline(always)]
                    || {
                        block.play(batch, first, teams, &mut Recorder { world, noise, first, arrays });
                        block.score(batch, first, teams, scores);
                    },
                );
                write_observed(world, observed_at, |lane| block.episode(batch, lane));
            }
        }
    });
}

/// Writes the step, from 1, at which each POI was observed, or 0, `[teams][pois]`, from the record of each team.
fn write_observed<'a>(world: &World, observed_at: &mut [u32], episode: impl Fn(usize) -> Episode<'a>) {
    for (team, to) in observed_at.chunks_exact_mut(world.pois.len()).enumerate() {
        let steps = credit::observed_at(episode(team).sets, world);
        to.iter_mut().zip(steps).for_each(|(to, step)| *to = step.unwrap_or(0) as u32);
    }
}

/// Writes the steps of a large team, and adds noise to its actions.
struct LargeRecorder<'a, 'b> {
    world: &'a World,
    noise: Option<Noise<'a>>,
    team: usize,
    arrays: &'a mut StepArrays<'b>,
}

/// Returns row `row` of an array of so many rows, or nothing of an empty array.
fn row(array: &mut [f32], row: usize, rows: usize) -> &mut [f32] {
    let width = array.len() / rows;
    &mut array[row * width..][..width]
}

impl LargeRecorder<'_, '_> {
    fn write_states<S: Simd>(&mut self, swarm: &Swarm<S>, moment: usize) {
        let StepArrays { positions, headings, speeds, .. } = &mut *self.arrays;
        let [positions, headings, speeds] =
            [positions, headings, speeds].map(|array| row(array, moment, self.world.steps() + 1));
        swarm.write_states(positions, headings, speeds);
    }
}

impl<S: Simd> Watch<S> for LargeRecorder<'_, '_> {
    fn started(&mut self, swarm: &mut Swarm<S>) {
        self.write_states(swarm, 0);
    }

    fn decided(&mut self, swarm: &mut Swarm<S>, step: usize) {
        let steps = self.world.steps();
        let StepArrays { inputs, outputs, actions, .. } = &mut *self.arrays;
        swarm.write_inputs(row(inputs, step, steps));
        swarm.write_outputs(row(outputs, step, steps));
        if let Some(Noise { key, deviations, first }) = self.noise {
            let team = S::u32s::splat(swarm.simd, first.wrapping_add(self.team as u32));
            for (leader, deviations) in deviations.iter().enumerate() {
                let drawn = evolve::noise::<S>(key, step, leader, team);
                let outputs = &mut swarm.outputs[leader / S::f32s::LEN];
                for ((output, &deviation), drawn) in outputs.iter_mut().zip(deviations).zip(drawn) {
                    output[leader % S::f32s::LEN] += drawn[0] * deviation;
                }
            }
        }
        swarm.write_outputs(row(actions, step, steps));
        if self.noise.is_some() {
            for output in swarm.outputs.as_flattened_mut() {
                *output = clamp_to::<S>(*output, splat(swarm.simd, -1.0), splat(swarm.simd, 1.0));
            }
        }
    }

    fn moved(&mut self, swarm: &mut Swarm<S>, step: usize) {
        self.write_states(swarm, step + 1);
        if !self.arrays.agents_at_poi.is_empty() {
            let words = self.world.words_per_step();
            let sets = &swarm.sets[step * words..][..words];
            self.arrays.agents_at_poi[step * words..][..words].copy_from_slice(sets);
        }
    }
}

/// Vectors of teams per task.
const VECTORS_PER_TASK: usize = 8;

/// Writes the steps of one vector of teams, whose first is team `first`, and adds noise to their actions.
struct Recorder<'a, 'b> {
    world: &'a World,
    noise: Option<Noise<'a>>,
    first: usize,
    arrays: &'a mut StepArrays<'b>,
}

impl<S: Simd> Observer<S> for Recorder<'_, '_> {
    #[inline(always)]
    fn started(&mut self, block: &Block<S>) {
        self.arrays.write_states(block.simd, &block.agents, (0, self.world.steps() + 1));
    }

    #[inline(always)]
    fn decided(&mut self, block: &mut Block<S>, step: usize) {
        let (simd, arrays, row) = (block.simd, &mut *self.arrays, (step, self.world.steps()));
        arrays.write_inputs(block, row);
        write_columns(simd, block.outputs.as_flattened(), row, arrays.outputs);
        if let Some(Noise { key, deviations, first: number }) = self.noise {
            let teams = S::u32s::from_fn(simd, |lane| number.wrapping_add((self.first + lane) as u32));
            for (leader, (outputs, deviations)) in block.outputs.iter_mut().zip(deviations).enumerate() {
                let drawn = evolve::noise::<S>(key, step, leader, teams);
                for ((output, &deviation), drawn) in outputs.iter_mut().zip(deviations).zip(drawn) {
                    *output += drawn * splat(simd, deviation);
                }
            }
        }
        write_columns(simd, block.outputs.as_flattened(), row, arrays.actions);
        if self.noise.is_some() {
            for output in block.outputs.as_flattened_mut() {
                *output = clamp_to::<S>(*output, splat(simd, -1.0), splat(simd, 1.0));
            }
        }
    }

    #[inline(always)]
    fn moved(&mut self, block: &Block<S>, sets: &[u32], step: usize) {
        let (simd, steps) = (block.simd, self.world.steps());
        self.arrays.write_states(simd, &block.agents, (step + 1, steps + 1));
        self.arrays.write_sets(simd, sets, (step, steps));
    }
}
