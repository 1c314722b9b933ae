//! Episodes whose steps are written to the caller's arrays, on all threads, with noise on the actions if wanted.

use std::ops::Range;

use fearless_simd::{Simd, dispatch, prelude::*};

use super::agent::Agent;
use super::batch::{WorldBatch, world_batches};
use super::block::Block;
use super::episode::EpisodeBlock;
use super::swarm::Swarm;
use super::together::{Observer, Together, play_together};
use super::transpose::to_rows;
use super::{BackendError, Cpu, Group, GroupScores, ScoreTable, is_large};
use crate::credit;
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

/// Writes columns, one team per lane, to row `row` of each team's `rows` rows.
#[inline(always)]
pub(super) fn write_columns<S: Simd>(simd: S, columns: &[S::f32s], row: (usize, usize), to: &mut [f32]) {
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
        dispatch!(level, simd => match is_large {
            true => record::<_, Swarm<_>>(simd, batch, noise, arrays, &scores),
            false => record::<_, EpisodeBlock<_>>(simd, batch, noise, arrays, &scores),
        });
        Ok(scores.finish())
    }
}

/// Plays and scores the teams of a batch, and writes every step to the arrays.
fn record<S: Simd, T: Together<S>>(
    simd: S,
    batch: &WorldBatch<'_>,
    noise: Option<Noise<'_>>,
    mut arrays: StepArrays<'_>,
    scores: &ScoreTable<'_>,
) {
    let (world, steps) = (batch.world, batch.world.steps());
    let sizes = step_sizes(world, steps + 1, steps);
    let part = |first: usize| {
        let teams = first..batch.teams.min(first + T::MOST);
        (teams.clone(), arrays.split(sizes, teams.len()))
    };
    let mut parts: Vec<(Range<usize>, StepArrays<'_>)> = (0..batch.teams).step_by(T::MOST).map(part).collect();
    // One workspace for several large teams, because it is large.
    let parts_per_task =
        if T::MOST == 1 { parts.len().div_ceil(current_num_threads()).max(1) } else { VECTORS_PER_TASK };
    parts.par_chunks_mut(parts_per_task).for_each(|parts| {
        let mut workspace = None;
        for (teams, arrays) in parts {
            let observed_at = std::mem::take(&mut arrays.observed_at);
            let mut recorder = Recorder { simd, steps, noise, first: teams.start, arrays };
            let played: &T = play_together(simd, &mut workspace, batch, teams.clone(), &mut recorder, scores);
            // The step, from 1, at which each POI was observed, or 0.
            for (team, to) in observed_at.chunks_exact_mut(world.pois.len()).enumerate() {
                let steps = credit::observed_at(played.episode_of(batch, team).sets, world);
                to.iter_mut().zip(steps).for_each(|(to, step)| *to = step.unwrap_or(0) as u32);
            }
        }
    });
}

/// Vectors of teams per task.
const VECTORS_PER_TASK: usize = 8;

/// Writes the steps of teams that play together, whose first is team `first`, and adds noise to their actions.
struct Recorder<'a, 'b, S: Simd> {
    simd: S,
    steps: usize,
    noise: Option<Noise<'a>>,
    first: usize,
    arrays: &'a mut StepArrays<'b>,
}

impl<S: Simd, T: Together<S>> Observer<S, T> for Recorder<'_, '_, S> {
    #[inline(always)]
    fn started(&mut self, teams: &mut T) {
        teams.store_states((0, self.steps + 1), self.arrays);
    }

    #[inline(always)]
    fn decided(&mut self, teams: &mut T, step: usize) {
        let (simd, arrays, row) = (self.simd, &mut *self.arrays, (step, self.steps));
        teams.store_inputs(row, arrays);
        teams.store_outputs(row, arrays.outputs);
        if let Some(Noise { key, deviations, first: number }) = self.noise {
            let numbers = S::u32s::from_fn(simd, |lane| number.wrapping_add((self.first + lane) as u32));
            for (leader, deviations) in deviations.iter().enumerate() {
                let drawn = evolve::noise::<S>(key, step, leader, numbers);
                let (index, lane) = T::place(leader);
                for ((output, &deviation), drawn) in teams.outputs()[index].iter_mut().zip(deviations).zip(drawn) {
                    let noise = drawn * splat(simd, deviation);
                    let outputs = &mut output.as_mut_slice()[lane..lane + T::MOST];
                    outputs.iter_mut().zip(noise.as_slice()).for_each(|(output, noise)| *output += noise);
                }
            }
        }
        teams.store_outputs(row, arrays.actions);
        if self.noise.is_some() {
            for output in teams.outputs().as_flattened_mut() {
                *output = clamp_to::<S>(*output, splat(simd, -1.0), splat(simd, 1.0));
            }
        }
    }

    #[inline(always)]
    fn moved(&mut self, teams: &mut T, step: usize) {
        teams.store_states((step + 1, self.steps + 1), self.arrays);
        teams.store_sets((step, self.steps), self.arrays);
    }
}
