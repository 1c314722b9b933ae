//! The caller's arrays to which the steps of episodes are written.

use fearless_simd::{Simd, prelude::*};

use super::agent::Agent;
use super::block::Block;
use super::transpose::to_rows;
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

impl<'a> StepArrays<'a> {
    /// Returns the index of the first array that is neither empty nor as long as needed.
    pub(super) fn wrong_length(&self, sizes: [usize; 8], teams: usize) -> Option<usize> {
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
