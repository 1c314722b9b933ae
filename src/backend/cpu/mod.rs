//! The reference backend: one team per lane, one vector of teams per block, blocks shared out over threads. Large teams play
//! one at a time ([`swarm`]).
//!
//! The loops here may skip whatever adds nothing (an agent out of reach in every lane), since sums start at +0 and
//! keep their order. The formulas are those of [`crate::model`].

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use super::grid::{LARGE_FROM, is_large};
use super::scores::ScoreTable;
use super::{Backend, BackendError, Group, GroupScores, Moment, Trace};
use crate::config::Fitness;
use crate::parallel::*;
use crate::world::{OUTPUTS, World};

mod agent;
mod arrays;
mod batch;
mod block;
mod episode;
mod forward;
mod neighbours;
mod network;
mod record;
mod steps;
mod swarm;
mod together;
mod transpose;

pub(crate) use agent::Agent;
pub use arrays::StepArrays;
pub(crate) use arrays::step_sizes;
pub(crate) use block::{Block, BlockState};
pub use forward::forward;
pub use steps::Noise;
pub(crate) use swarm::{Recorded, Swarm};
pub(crate) use transpose::transpose_rows;

use batch::{WorldBatch, world_batches};
use episode::{EpisodeBlock, sight_words};
use together::{Observer, Together, Workspace, play_together};

/// Plays episodes on the CPU, with the widest instruction set that it has, on the threads of the current rayon pool.
pub struct Cpu {
    level: Level,
    /// Teams of so many agents play one at a time.
    large_from: usize,
    /// One per thread, kept between batches.
    workspaces: Vec<Workspace>,
}

impl Default for Cpu {
    fn default() -> Cpu {
        Cpu::at_level(Level::new())
    }
}

impl Cpu {
    /// Returns a backend that uses a given instruction set, for tests and benchmarks.
    pub fn at_level(level: Level) -> Cpu {
        Cpu { level, large_from: LARGE_FROM, workspaces: vec![] }
    }

    /// Plays teams of at least so many agents one at a time. The bits are the same, so this is for tests and benchmarks.
    pub fn with_large_from(self, agents: usize) -> Cpu {
        Cpu { large_from: agents, ..self }
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

/// Returns the actions of a leader at a step, each in -1..1. The team is given by its group's index and its index there.
pub(crate) type Actions<'a> = dyn Fn((usize, usize), usize, usize) -> [f32; OUTPUTS] + Sync + 'a;

impl Cpu {
    /// Plays groups as [`Backend::play`] does, with `actions` in place of those of policies if they are given.
    ///
    /// # Errors
    /// A group is inconsistent.
    pub(crate) fn play_with(
        &mut self,
        groups: &[Group<'_>],
        actions: Option<&Actions<'_>>,
    ) -> Result<Vec<GroupScores>, BackendError> {
        groups.iter().try_for_each(|group| group.check().and(group.weights.on_host().map(drop)))?;
        let Cpu { level, large_from, workspaces } = self;
        let (level, scores) = (*level, ScoreTable::new(groups));
        dispatch!(level, simd => play(simd, groups, *large_from, workspaces, actions, &scores));
        Ok(scores.finish())
    }
}

impl Backend for Cpu {
    fn play(&mut self, groups: &[Group<'_>]) -> Result<Vec<GroupScores>, BackendError> {
        self.play_with(groups, None)
    }

    fn trace(&mut self, group: &Group<'_>) -> Result<Trace, BackendError> {
        group.check()?;
        group.weights.on_host()?;
        let level = self.level;
        let is_large = is_large(group.world, self.large_from);
        Ok(dispatch!(level, simd => match is_large {
            true => trace::<_, Swarm<_>>(simd, group),
            false => trace::<_, EpisodeBlock<_>>(simd, group),
        }))
    }

    fn describe(&self) -> String {
        let threads = current_num_threads();
        format!("cpu ({}, {threads} thread{})", level_name(self.level), if threads == 1 { "" } else { "s" })
    }
}

/// Minimum number of vectors of teams per thread for prefetching: a thread then takes its next vector before it plays
/// one. Policies of fewer teams fit into the cache, and threads that take vectors early finish less evenly.
const PREFETCH_FROM: usize = 32;

/// Plays all groups. Threads take one vector of teams, or one large team, after another from a common counter, so that none
/// waits for a lock and none is left with much to do at the end.
fn play<S: Simd>(
    simd: S,
    groups: &[Group<'_>],
    large_from: usize,
    workspaces: &mut Vec<Workspace>,
    actions: Option<&Actions<'_>>,
    scores: &ScoreTable<'_>,
) {
    let batches = world_batches(groups);
    let width = |batch: &WorldBatch<'_>| if is_large(batch.world, large_from) { 1 } else { S::f32s::LEN };
    let blocks: Vec<(&WorldBatch<'_>, usize)> = batches
        .iter()
        .flat_map(|batch| (0..batch.teams).step_by(width(batch)).map(move |team| (batch, team)))
        .collect();
    workspaces.resize_with(current_num_threads(), || None);
    let next = AtomicUsize::new(0);
    let threads = workspaces.len().min(blocks.len());
    let early = blocks.len() >= PREFETCH_FROM * threads;
    workspaces[..threads].par_iter_mut().with_max_len(1).for_each(|workspace| {
        let take = || blocks.get(next.fetch_add(1, Relaxed));
        let mut current = take();
        while let Some(&(batch, first)) = current {
            let following = if early { take() } else { None };
            let teams_from = |first: usize| first..batch.teams.min(first + width(batch));
            let ahead = match following {
                Some((next, first)) if std::ptr::eq(*next, batch) => teams_from(*first),
                _ => 0..0,
            };
            let teams = teams_from(first);
            let mut observer = Playing { batch, playing: teams.clone(), ahead, actions };
            if is_large(batch.world, large_from) {
                let _: &Swarm<S> = play_together(simd, workspace, batch, teams, &mut observer, scores);
            } else {
                let _: &EpisodeBlock<S> = play_together(simd, workspace, batch, teams, &mut observer, scores);
            }
            current = if early { following } else { take() };
        }
    });
}

/// Prefetches the policies of the teams that play next, during the steps of those before, and replaces the actions of these
/// if others are given.
struct Playing<'a> {
    batch: &'a WorldBatch<'a>,
    playing: Range<usize>,
    /// Empty if there are none.
    ahead: Range<usize>,
    actions: Option<&'a Actions<'a>>,
}

impl<S: Simd, T: Together<S>> Observer<S, T> for Playing<'_> {
    const READS_SETS: bool = false;

    #[inline(always)]
    fn decided(&mut self, teams: &mut T, step: usize) {
        self.batch.prefetch(self.ahead.clone(), step);
        let Some(actions) = self.actions else { return };
        for leader in 0..self.batch.world.leaders() {
            let (index, first) = T::outputs_at(leader);
            let outputs = &mut teams.outputs()[index];
            for (lane, team) in (first..).zip(self.playing.clone()) {
                let (group, team) = self.batch.locate(team);
                let actions = actions((self.batch.first + group, team), leader, step);
                outputs.iter_mut().zip(actions).for_each(|(to, action)| to[lane] = action);
            }
        }
    }
}

/// Plays a group, and records all quantities of every step.
fn trace<S: Simd, T: Together<S>>(simd: S, group: &Group<'_>) -> Trace {
    let batch = WorldBatch::new(std::slice::from_ref(group), 0);
    let (mut trace, mut together) = (Trace::of_zeros(group), T::allocate(simd, &batch, true));
    for first in (0..batch.teams).step_by(T::MAX_TEAMS) {
        let teams = first..batch.teams.min(first + T::MAX_TEAMS);
        together.play(&batch, teams.clone(), &mut Moments { trace: &mut trace, playing: teams.clone() });
        for team in teams {
            trace.store(team, &together.episode_of(&batch, team - first));
        }
    }
    trace
}

/// Writes the moments and inputs of teams that play together to a trace.
struct Moments<'a> {
    trace: &'a mut Trace,
    playing: Range<usize>,
}

impl Moments<'_> {
    fn write<S: Simd, T: Together<S>>(&mut self, together: &T, step: usize) {
        let Trace { teams, agents, ref mut moments, ref mut inputs, .. } = *self.trace;
        let of_team = inputs.len() / (moments.len() / agents);
        for (index, team) in self.playing.clone().enumerate() {
            let place = step * teams + team;
            let (moments, inputs) = (&mut moments[place * agents..], &mut inputs[place * of_team..]);
            together.moments(index, step > 0, &mut moments[..agents], &mut inputs[..of_team]);
        }
    }
}

impl<S: Simd, T: Together<S>> Observer<S, T> for Moments<'_> {
    #[inline(always)]
    fn started(&mut self, teams: &mut T) {
        self.write(teams, 0);
    }

    #[inline(always)]
    fn moved(&mut self, teams: &mut T, step: usize) {
        self.write(teams, step + 1);
    }
}

/// Returns the number of lanes of this CPU's vectors.
pub fn lanes() -> u64 {
    fn count<S: Simd>(_: S) -> u64 {
        S::f32s::LEN as u64
    }
    dispatch!(Level::new(), simd => count(simd))
}

/// Returns the bytes of one vector of teams, or one large team, that are scored by a fitness.
pub(crate) fn block_bytes(world: &World, fitness: Fitness) -> u64 {
    let (agents, leaders, followers) = (world.agents(), world.leaders(), world.followers());
    let is_large = is_large(world, LARGE_FROM);
    let paths = if world.paths.is_some() { world.path_words() } else { 0 };
    let counted = if is_large && fitness != Fitness::Df { 0 } else { followers * leaders };
    let record = world.set_words() + counted + sight_words(world, fitness == Fitness::Dt) + paths;
    let policies = leaders * world.constants.policy.words();
    // Scores from paths need each agent's distance from a POI, and under Dt who leads whom, at each moment. Those of one
    // large team copy its paths.
    let (copied, moments) = if is_large { (2, world.steps() + 1 + lanes() as usize) } else { (0, world.steps() + 2) };
    let scratch = match (paths, fitness) {
        (0, _) => 0,
        (_, Fitness::Dt) => moments * agents * (copied + 1 + 2 * world.leader_words()),
        _ => moments * agents * (copied + 1),
    };
    // Who leads whom, of one team at a time.
    let led = if paths == 0 { sight_words(world, fitness == Fitness::Dt) } else { 0 };
    if is_large {
        return (4 * (policies + record + scratch + led) + swarm::bytes(agents)) as u64;
    }
    let words = 8 * agents + policies + 3 * followers + record + scratch;
    words as u64 * lanes() * 4 + (8 * world.parameters() + 4 * led + agents * agents.div_ceil(64) * 8) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::grid;
    use crate::config::own_populations;
    use crate::evaluate::SCORES_AND_DT;
    use crate::sample;
    use crate::stepping::{Recording, Stepper};

    #[test]
    fn given_actions_score_as_in_steps_also_in_large_teams() {
        let worlds = (0..300).map(|seed| (seed, World::new(&sample::any_world(seed).validate().unwrap())));
        let worlds: Vec<_> = worlds.filter(|(_, world)| grid::is_large(world, 0)).take(100).collect();
        assert_eq!(worlds.len(), 100);
        let mut observed = 0;
        for (seed, world) in worlds {
            const TEAMS: usize = 3;
            let action = |(_, team): (usize, usize), leader: usize, step: usize| {
                let angle = (team * 7 + leader * 3) as f32 + step as f32 * 0.1;
                [libm::sinf(angle) * 0.3, libm::cosf(angle * 0.7)]
            };
            let (weights, teams) = (sample::weights(&world, 1, seed), vec![0; TEAMS * world.leaders()]);
            let (populations, fitnesses) = (own_populations(world.leaders()), SCORES_AND_DT);
            let group = Group { populations, fitnesses, ..Group::new(&world, &weights[..], 1, &teams) };
            let mut stepper = Stepper::new(world.clone(), TEAMS, Recording::SetsAndSights).unwrap();
            for step in 0..world.steps() {
                let leaders = (0..TEAMS).flat_map(|team| (0..world.leaders()).map(move |leader| (team, leader)));
                let actions: Vec<f32> = leaders.flat_map(|(team, leader)| action((0, team), leader, step)).collect();
                stepper.step(&actions).unwrap();
            }
            for large_from in [grid::LARGE_FROM, 0] {
                let mut cpu = Cpu::default().with_large_from(large_from);
                let [scores] = &cpu.play_with(std::slice::from_ref(&group), Some(&action)).unwrap()[..] else {
                    unreachable!()
                };
                for (row, &fitness) in SCORES_AND_DT.iter().enumerate() {
                    let mut stepped = vec![0.0; teams.len()];
                    stepper.fitness(fitness, &mut stepped).unwrap();
                    let rows = scores.scores.chunks_exact(world.leaders()).skip(row).step_by(SCORES_AND_DT.len());
                    assert!(rows.flatten().eq(&stepped), "world {seed}, {fitness:?}, large from {large_from}");
                }
                observed += scores.observed.iter().filter(|&&observed| observed > 0).count();
            }
        }
        assert!(observed > 50, "{observed} teams observed something");
    }
}
