//! The reference backend: one team per lane, one vector of teams per block, blocks shared out over threads.
//!
//! The loops here may skip whatever adds nothing (an agent out of reach in every lane), since sums start at +0 and
//! keep their order. The formulas are those of [`crate::model`].

use std::sync::{Mutex, PoisonError};

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use super::{Backend, BackendError, Group, RecordRequest, Trace, Visit};
use crate::parallel::*;
use crate::world::World;

mod agent;
mod batch;
mod block;
mod episode;
mod neighbours;
mod network;
mod record;
mod transpose;

pub(crate) use agent::Agent;
pub(crate) use block::{Block, BlockState};
pub(crate) use transpose::{transpose_rows, transpose4};

use batch::{WorldBatch, world_batches};
use episode::{EpisodeBlock, sight_words};

/// Plays episodes on the CPU, with the widest instruction set that it has, on the threads of the current rayon pool.
pub struct Cpu {
    level: Level,
}

impl Default for Cpu {
    fn default() -> Cpu {
        Cpu::at_level(Level::new())
    }
}

impl Cpu {
    /// Returns a backend that uses a given instruction set, for tests and benchmarks.
    pub fn at_level(level: Level) -> Cpu {
        Cpu { level }
    }

    /// Returns every instruction set of this CPU, narrowest first. With the feature `scalar` the first uses no vectors.
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

/// Returns the common name of an instruction set.
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

fn rollout<S: Simd>(simd: S, groups: &[Group<'_>], visit: &Visit<'_>) {
    let width = S::f32s::LEN;
    let runs = world_batches(groups);
    let blocks: Vec<(&WorldBatch<'_>, usize)> =
        runs.iter().flat_map(|run| (0..run.teams).step_by(width).map(move |team| (run, team))).collect();
    // Blocks that no thread is using. As many are allocated as threads play at once.
    let idle: Mutex<Vec<EpisodeBlock<S>>> = Mutex::default();
    let take = |&WorldBatch { world, sighted, .. }: &WorldBatch<'_>| {
        let mut idle = idle.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = idle.iter().position(|whole| {
            whole.block.world.constants == world.constants
                && whole.sights.len() == sight_words(world, sighted) * S::f32s::LEN
        });
        if fits.is_none() {
            // They are of an earlier world.
            idle.clear();
        }
        fits.map(|index| idle.swap_remove(index))
    };
    blocks.par_iter().with_max_len(1).for_each(|&(run, first)| {
        let mut whole = take(run).unwrap_or_else(|| EpisodeBlock::new(simd, run.world, run.sighted));
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
    let run = WorldBatch { world, first: 0, groups: std::slice::from_ref(group), teams, sighted };
    let mut moments = vec![bytemuck::Zeroable::zeroed(); (steps + 1) * teams * agents];
    let (mut sets, mut seen, mut sights) = (Vec::new(), Vec::new(), Vec::new());
    let mut whole = EpisodeBlock::new(simd, world, sighted);
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

/// Returns the number of lanes of this CPU's vectors.
pub fn lanes() -> u64 {
    fn count<S: Simd>(_: S) -> u64 {
        S::f32s::LEN as u64
    }
    dispatch!(Level::new(), simd => count(simd))
}

/// Returns the bytes of one vector of teams, with the record that is requested.
pub fn block_bytes(world: &World, need: RecordRequest) -> u64 {
    let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
    let record = world.set_words() + followers * leaders + sight_words(world, need.sights());
    let words = 8 * agents + leaders * world.constants.policy.words() + 3 * followers + record;
    words as u64 * lanes() * 4 + (8 * world.parameters() + agents * agents.div_ceil(64) * 8) as u64
}
