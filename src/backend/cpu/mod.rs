//! The reference backend: one team per lane, one vector of teams per block, blocks shared out over threads. Large teams play
//! one at a time ([`swarm`]).
//!
//! The loops here may skip whatever adds nothing (an agent out of reach in every lane), since sums start at +0 and
//! keep their order. The formulas are those of [`crate::model`].

use std::any::Any;
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
mod batch;
mod block;
mod episode;
mod forward;
mod neighbours;
mod network;
mod record;
mod steps;
mod swarm;
mod transpose;

pub(crate) use agent::Agent;
pub(crate) use block::{Block, BlockState};
pub use forward::forward;
pub(crate) use steps::step_sizes;
pub use steps::{Noise, StepArrays};
pub(crate) use swarm::{Recorded, Swarm};
pub(crate) use transpose::transpose_rows;

use batch::{WorldBatch, world_batches};
use episode::{EpisodeBlock, Observer, sight_words};
use swarm::Watch;

/// Plays episodes on the CPU, with the widest instruction set that it has, on the threads of the current rayon pool.
pub struct Cpu {
    level: Level,
    /// Teams of so many agents play one at a time.
    large_from: usize,
    /// A [`Workspace`] per thread, kept between batches.
    workspaces: Option<Box<dyn Any + Send>>,
}

/// The memory of a thread, as it was last used.
enum Workspace<S: Simd> {
    Unused,
    /// For one vector of teams.
    Block(Box<EpisodeBlock<S>>),
    /// For one large team.
    Swarm(Box<Swarm<S>>),
}

impl Default for Cpu {
    fn default() -> Cpu {
        Cpu::at_level(Level::new())
    }
}

impl Cpu {
    /// Returns a backend that uses a given instruction set, for tests and benchmarks.
    pub fn at_level(level: Level) -> Cpu {
        Cpu { level, large_from: LARGE_FROM, workspaces: None }
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

/// The actions of a team's leader at a step, each in -1..1. Teams are counted over all groups.
pub(crate) type Actions<'a> = dyn Fn(usize, usize, usize) -> [f32; OUTPUTS] + Sync + 'a;

impl Cpu {
    /// Plays groups as [`Backend::play`] does, with `actions` in place of those of policies if they are given. All groups are
    /// then of one world.
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
        Ok(dispatch!(level, simd => if is_large { trace_large(simd, group) } else { trace(simd, group) }))
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
    workspaces: &mut Option<Box<dyn Any + Send>>,
    actions: Option<&Actions<'_>>,
    scores: &ScoreTable<'_>,
) {
    let batches = world_batches(groups);
    let width = |batch: &WorldBatch<'_>| if is_large(batch.world, large_from) { 1 } else { S::f32s::LEN };
    let blocks: Vec<(&WorldBatch<'_>, usize)> = batches
        .iter()
        .flat_map(|batch| (0..batch.teams).step_by(width(batch)).map(move |team| (batch, team)))
        .collect();
    let mut own = workspaces.take().and_then(|kept| kept.downcast::<Vec<Workspace<S>>>().ok()).unwrap_or_default();
    own.resize_with(current_num_threads(), || Workspace::Unused);
    let next = AtomicUsize::new(0);
    let threads = own.len().min(blocks.len());
    let early = blocks.len() >= PREFETCH_FROM * threads;
    own[..threads].par_iter_mut().with_max_len(1).for_each(|workspace| {
        let take = || blocks.get(next.fetch_add(1, Relaxed));
        let mut current = take();
        while let Some(&(batch, first)) = current {
            let following = if early { take() } else { None };
            if is_large(batch.world, large_from) {
                let swarm = workspace.swarm(simd, batch);
                swarm.play(batch, first, &mut Directed { team: first, actions });
                swarm.score(batch, first, scores);
            } else {
                let episodes = workspace.block(simd, batch);
                let teams = S::f32s::LEN.min(batch.teams - first);
                let ahead = match following {
                    Some((next, first)) if std::ptr::eq(*next, batch) => {
                        *first..(first + S::f32s::LEN).min(batch.teams)
                    }
                    _ => 0..0,
                };
                simd.vectorize(
                    #[inline(always)]
                    || {
                        let playing = first..first + teams;
                        let mut observer = Playing { batch, playing, ahead: ahead.clone(), actions };
                        episodes.play(batch, first, teams, &mut observer);
                        episodes.score(batch, first, teams, scores);
                    },
                );
            }
            current = if early { following } else { take() };
        }
    });
    *workspaces = Some(own);
}

impl<S: Simd> Workspace<S> {
    /// Returns memory for vectors of teams of a batch.
    fn block(&mut self, simd: S, batch: &WorldBatch<'_>) -> &mut EpisodeBlock<S> {
        if !matches!(self, Workspace::Block(block) if block.fits(batch.world, batch.sighted)) {
            *self = Workspace::Block(Box::new(EpisodeBlock::new(simd, batch.world, batch.sighted)));
        }
        let Workspace::Block(block) = self else { unreachable!("it was just made") };
        block
    }

    /// Returns memory for large teams of a batch.
    fn swarm(&mut self, simd: S, batch: &WorldBatch<'_>) -> &mut Swarm<S> {
        let recorded = Recorded { counts: batch.counted, sights: batch.sighted, forces: false };
        if !matches!(self, Workspace::Swarm(swarm) if swarm.fits(batch.world, recorded)) {
            *self = Workspace::Swarm(Box::new(Swarm::new(simd, batch.world, recorded)));
        }
        let Workspace::Swarm(swarm) = self else { unreachable!("it was just made") };
        swarm
    }
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

impl<S: Simd> Observer<S> for Playing<'_> {
    #[inline(always)]
    fn decided(&mut self, block: &mut Block<S>, step: usize) {
        self.batch.prefetch(self.ahead.clone(), step);
        let Some(actions) = self.actions else { return };
        for (leader, outputs) in block.outputs.iter_mut().enumerate() {
            for (lane, team) in self.playing.clone().enumerate() {
                outputs.iter_mut().zip(actions(team, leader, step)).for_each(|(to, action)| to[lane] = action);
            }
        }
    }
}

/// Replaces the actions of a large team if others are given.
struct Directed<'a> {
    team: usize,
    actions: Option<&'a Actions<'a>>,
}

impl<S: Simd> Watch<S> for Directed<'_> {
    fn decided(&mut self, swarm: &mut Swarm<S>, step: usize) {
        let Some(actions) = self.actions else { return };
        for leader in 0..swarm.leaders() {
            let outputs = swarm.outputs[leader / S::f32s::LEN].iter_mut();
            let given = actions(self.team, leader, step);
            outputs.zip(given).for_each(|(to, action)| to[leader % S::f32s::LEN] = action);
        }
    }
}

/// Plays a group, and records all quantities of every step.
fn trace<S: Simd>(simd: S, group: &Group<'_>) -> Trace {
    let world = group.world;
    let (teams, agents, steps) = (group.team_count(), world.agents(), world.steps());
    let batch = WorldBatch::new(std::slice::from_ref(group), 0);
    let mut moments = vec![bytemuck::Zeroable::zeroed(); (steps + 1) * teams * agents];
    let of_team = world.leaders() * world.inputs();
    let mut inputs = vec![0.0; (steps + 1) * teams * of_team];
    let (mut sets, mut seen, mut trail) = (Vec::new(), Vec::new(), Vec::new());
    let mut episodes = EpisodeBlock::new(simd, world, batch.sighted);
    for first in (0..teams).step_by(S::f32s::LEN) {
        let lanes = S::f32s::LEN.min(teams - first);
        let mut observer = Moments { moments: &mut moments, inputs: &mut inputs, of_team, teams, first, lanes };
        episodes.play(&batch, first, lanes, &mut observer);
        for lane in 0..lanes {
            let episode = episodes.episode(&batch, lane);
            sets.extend(episode.sets.iter());
            seen.extend(episode.seen.words().iter());
            trail.extend(episode.trail().iter());
        }
    }
    Trace { teams, agents, leaders: world.leaders(), moments, inputs, sets, seen, trail, pois: group.pois().to_vec() }
}

/// [`trace`] of large teams.
fn trace_large<S: Simd>(simd: S, group: &Group<'_>) -> Trace {
    let world = group.world;
    let (teams, agents, leaders) = (group.team_count(), world.agents(), world.leaders());
    let of_team = leaders * world.inputs();
    let batch = WorldBatch::new(std::slice::from_ref(group), 0);
    let recorded = Recorded { counts: true, sights: batch.sighted, forces: true };
    let mut swarm = Swarm::new(simd, world, recorded);
    let mut watch = LargeMoments {
        moments: vec![bytemuck::Zeroable::zeroed(); (world.steps() + 1) * teams * agents],
        inputs: vec![0.0; (world.steps() + 1) * teams * of_team],
        sizes: [teams, agents, of_team],
        team: 0,
    };
    let (mut sets, mut seen, mut trail) = (Vec::new(), Vec::new(), Vec::new());
    for team in 0..teams {
        watch.team = team;
        swarm.play(&batch, team, &mut watch);
        let episode = swarm.episode();
        sets.extend(episode.sets.iter());
        seen.extend(episode.seen.words().iter());
        trail.extend(episode.trail().iter());
    }
    let LargeMoments { moments, inputs, .. } = watch;
    Trace { teams, agents, leaders, moments, inputs, sets, seen, trail, pois: group.pois().to_vec() }
}

/// The moments and inputs of a [`Trace`] of large teams.
struct LargeMoments {
    moments: Vec<Moment>,
    inputs: Vec<f32>,
    /// Teams, agents, and inputs of a team.
    sizes: [usize; 3],
    team: usize,
}

impl LargeMoments {
    fn write<S: Simd>(&mut self, swarm: &Swarm<S>, row: usize) {
        let [teams, agents, inputs] = self.sizes;
        let place = row * teams + self.team;
        let moments = &mut self.moments[place * agents..][..agents];
        swarm.moments(row > 0, moments, &mut self.inputs[place * inputs..][..inputs]);
    }
}

impl<S: Simd> Watch<S> for LargeMoments {
    fn started(&mut self, swarm: &mut Swarm<S>) {
        self.write(swarm, 0);
    }

    fn moved(&mut self, swarm: &mut Swarm<S>, step: usize) {
        self.write(swarm, step + 1);
    }
}

/// Writes the moments of a vector of teams to those of all teams, `[steps + 1][teams][agents]`, and the inputs, of which
/// each team has `of_team`.
struct Moments<'a> {
    moments: &'a mut [Moment],
    inputs: &'a mut [f32],
    of_team: usize,
    teams: usize,
    first: usize,
    lanes: usize,
}

impl Moments<'_> {
    fn write<S: Simd>(&mut self, block: &Block<S>, row: usize) {
        let agents = block.agents.len();
        let at = (row * self.teams + self.first) * agents;
        let moments = self.moments[at..at + self.lanes * agents].chunks_exact_mut(agents);
        let inputs = self.inputs[(row * self.teams + self.first) * self.of_team..].chunks_exact_mut(self.of_team);
        for (lane, (moments, inputs)) in moments.zip(inputs).enumerate() {
            block.moments(lane, row > 0, moments, inputs);
        }
    }
}

impl<S: Simd> Observer<S> for Moments<'_> {
    #[inline(always)]
    fn started(&mut self, block: &Block<S>) {
        self.write(block, 0);
    }

    #[inline(always)]
    fn moved(&mut self, block: &Block<S>, _: &[u32], step: usize) {
        self.write(block, step + 1);
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
    // Scores from paths copy these, and under Dt find who leads whom at each moment.
    let moments = world.steps() + 1 + lanes() as usize;
    let led = 2 * agents * leaders.div_ceil(32) + leaders * world.constants.words as usize;
    let scratch = match (paths, fitness) {
        (0, _) => 0,
        (_, Fitness::Dt) => moments * (3 * agents + led),
        _ => moments * 3 * agents,
    };
    if is_large {
        return (4 * (policies + record + scratch) + swarm::bytes(agents)) as u64;
    }
    let words = 8 * agents + policies + 3 * followers + record;
    words as u64 * lanes() * 4 + (8 * world.parameters() + agents * agents.div_ceil(64) * 8 + 4 * scratch) as u64
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
            let action = |team: usize, leader: usize, step: usize| {
                let angle = (team * 7 + leader * 3) as f32 + step as f32 * 0.1;
                [libm::sinf(angle) * 0.3, libm::cosf(angle * 0.7)]
            };
            let (weights, teams) = (sample::weights(&world, 1, seed), vec![0; TEAMS * world.leaders()]);
            let group = Group {
                world: &world,
                starts: &world.starts,
                weights: weights[..].into(),
                policies: 1,
                populations: own_populations(world.leaders()),
                teams: &teams,
                fitnesses: SCORES_AND_DT,
            };
            let mut stepper = Stepper::new(world.clone(), TEAMS, Recording::SetsAndSights).unwrap();
            for step in 0..world.steps() {
                let leaders = (0..TEAMS).flat_map(|team| (0..world.leaders()).map(move |leader| (team, leader)));
                let actions: Vec<f32> = leaders.flat_map(|(team, leader)| action(team, leader, step)).collect();
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
