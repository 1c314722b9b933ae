//! Episodes whose steps are written to the caller's arrays, on all threads, with noise on the actions if wanted.

use std::ops::Range;

use fearless_simd::{Simd, dispatch, prelude::*};

use super::arrays::{StepArrays, step_sizes};
use super::batch::{WorldBatch, world_batches};
use super::episode::EpisodeBlock;
use super::swarm::Swarm;
use super::together::{Observer, Together, play_together};
use super::{BackendError, Cpu, Group, GroupScores, ScoreTable, is_large};
use crate::credit;
use crate::evolve::{self, Key};
use crate::kernels::{clamp_to, splat};
use crate::parallel::*;
use crate::world::OUTPUTS;

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
        let teams = first..batch.teams.min(first + T::MAX_TEAMS);
        (teams.clone(), arrays.split(sizes, teams.len()))
    };
    let mut parts: Vec<(Range<usize>, StepArrays<'_>)> = (0..batch.teams).step_by(T::MAX_TEAMS).map(part).collect();
    // One workspace for several large teams, because it is large.
    let parts_per_task =
        if T::MAX_TEAMS == 1 { parts.len().div_ceil(current_num_threads()).max(1) } else { VECTORS_PER_TASK };
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
                let (index, lane) = T::outputs_at(leader);
                for ((output, &deviation), drawn) in teams.outputs()[index].iter_mut().zip(deviations).zip(drawn) {
                    let noise = drawn * splat(simd, deviation);
                    let outputs = &mut output.as_mut_slice()[lane..lane + T::MAX_TEAMS];
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
