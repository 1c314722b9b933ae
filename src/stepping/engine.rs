//! The vectors of teams behind a [`Stepper`](super::Stepper).

use std::sync::Mutex;

use fearless_simd::{Simd, prelude::*};
use glam::Vec2;

use crate::backend::cpu::{Agent, Block, BlockState, StepArrays, step_sizes, transpose_rows};
use crate::credit::Episode;
use crate::kernels::{clamp_to, count_ones, splat};
use crate::parallel::*;
use crate::world::{OUTPUTS, World};

use super::state::Saved;

/// The arrays that a stepper shows, of all teams.
pub(super) struct Observations {
    /// Inputs of the leaders, `[teams][leaders][inputs]`.
    pub(super) inputs: Vec<f32>,
    /// The agents at each POI, one bit per agent, `[teams][pois][words]`.
    pub(super) agents_at_poi: Vec<u32>,
    /// Whether a POI was first observed in the last step, `[teams][pois]`.
    pub(super) newly: Vec<bool>,
    /// Whether a POI was observed, `[teams][pois]`.
    pub(super) observed: Vec<bool>,
    /// The steps that each team has played, `[teams]`.
    pub(super) steps: Vec<u32>,
    /// Positions in units, `[teams][agents][2]`.
    pub(super) positions: Vec<f32>,
    /// Headings as unit vectors, `[teams][agents][2]`.
    pub(super) headings: Vec<f32>,
    /// Speeds in units per second, `[teams][agents]`.
    pub(super) speeds: Vec<f32>,
}

/// A command to all vectors of teams.
#[derive(Clone, Copy)]
pub(super) enum Command<'a> {
    /// Resets the `chosen` teams, `[teams]`, or all, to `starts` and `headings`, `[teams][agents]`, or to the world's.
    Reset { chosen: Option<&'a [bool]>, starts: Option<&'a [Vec2]>, headings: Option<&'a [Vec2]> },
    /// Plays a step with actions, `[teams][leaders][2]`.
    Step(&'a [f32]),
    /// Puts all teams into a saved state. Of the observations, only the inputs change.
    Restore(&'a Saved<'a>),
    /// Writes the positions, headings and speeds.
    Show,
}

/// Vectors of teams of any instruction set.
pub(super) trait Vectors: Send + Sync {
    /// Executes a command. `moved` are the POI positions, `[teams][pois]`; empty if all teams have the world's.
    fn run(&mut self, world: &World, moved: &[Vec2], command: Command<'_>, observations: &mut Observations);
    /// Returns whether the POIs of [`GoneWithin`](crate::world::GoneWithin) are gone in a team, all bits or none, `[gone_within]`.
    fn gone(&self, team: usize) -> Vec<u32>;
    /// Returns the record of a team, if one is kept. `moved` are POI positions, as in [`Vectors::run`]. `seen` is scratch
    /// memory that holds a part of it.
    fn episode<'a>(
        &'a self,
        team: usize,
        world: &'a World,
        moved: &'a [Vec2],
        seen: &'a mut Vec<u32>,
    ) -> Option<Episode<'a>>;
}

/// The state of one vector of teams between steps. It is small, because all of them pass through the caches in each
/// step.
struct TeamBlock<S: Simd> {
    /// The index of the first team, and the number of teams.
    first: usize,
    teams: usize,
    state: BlockState<S>,
    /// The agents at each POI at each step, `[teams][steps][pois][words]`; empty unless recorded.
    record: Vec<u32>,
    /// The leaders that each follower saw at each step, `[teams][steps][followers][words of leaders]`; or, if scores need
    /// paths, the positions so far, f32 as bits, `[teams][steps + 1][agents][2]`. Empty unless recorded.
    trail: Vec<u32>,
}

/// Returns a word of a trail before it is recorded: no leader is seen, or an agent is at no place.
fn unrecorded(world: &World) -> u32 {
    if world.paths.is_some() { f32::NAN.to_bits() } else { 0 }
}

/// Scratch memory of a thread. Its block takes on the state of one vector of teams after the other.
struct Workspace<S: Simd> {
    block: Block<S>,
    /// The agents at each POI, `[pois][words][lanes]`.
    sets: Vec<u32>,
    /// The leaders that each follower sees, `[followers][words of leaders][lanes]`.
    sights: Vec<u32>,
    /// Agents and counts before a step, if some teams' episodes are over.
    kept: (Vec<Agent<S>>, Vec<S::u32s>),
    /// Whether the POIs were last elsewhere than in the world.
    moved: bool,
}

/// All vectors of teams, and the workspaces that no thread is using.
struct TeamBlocks<S: Simd> {
    simd: S,
    blocks: Vec<TeamBlock<S>>,
    idle: Mutex<Vec<Box<Workspace<S>>>>,
}

/// Returns vectors of teams that record so many words of sets and of their trail per team.
pub(super) fn vectors<S: Simd>(simd: S, world: &World, teams: usize, [sets, trail]: [usize; 2]) -> Box<dyn Vectors> {
    let block = |first: usize| {
        let teams = S::f32s::LEN.min(teams - first);
        let state = Block::new(simd, world).into_state(sets > 0);
        TeamBlock { first, teams, state, record: vec![0; teams * sets], trail: vec![unrecorded(world); teams * trail] }
    };
    let blocks = (0..teams).step_by(S::f32s::LEN).map(block).collect();
    Box::new(TeamBlocks { simd, blocks, idle: Mutex::default() })
}

/// Vectors per task, so that waking a thread is worth its time.
pub(super) const VECTORS_PER_TASK: usize = 8;

impl<S: Simd> Vectors for TeamBlocks<S> {
    fn run(&mut self, world: &World, moved: &[Vec2], command: Command<'_>, observations: &mut Observations) {
        let (simd, idle) = (self.simd, &self.idle);
        let mut parts: Vec<_> = self.blocks.iter_mut().zip(observations.split(world, S::f32s::LEN)).collect();
        let run = |parts: &mut [(&mut TeamBlock<S>, Slices<'_>)]| {
            let workspace = lock(idle).pop();
            let mut workspace = workspace.unwrap_or_else(|| Box::new(Workspace::new(simd, world)));
            for (block, slices) in parts {
                simd.vectorize(
                    #[inline(always)]
                    || workspace.run(simd, world, moved, block, command, slices),
                );
            }
            lock(idle).push(workspace);
        };
        match parts.len() {
            // Waking other threads would take longer.
            ..=VECTORS_PER_TASK => run(&mut parts),
            _ => parts.par_chunks_mut(VECTORS_PER_TASK).for_each(run),
        }
    }

    fn gone(&self, team: usize) -> Vec<u32> {
        let (block, lane) = (&self.blocks[team / S::f32s::LEN], team % S::f32s::LEN);
        block.state.gone.iter().map(|gone| gone[lane]).collect()
    }

    fn episode<'a>(
        &'a self,
        team: usize,
        world: &'a World,
        moved: &'a [Vec2],
        seen: &'a mut Vec<u32>,
    ) -> Option<Episode<'a>> {
        let (block, lane) = (&self.blocks[team / S::f32s::LEN], team % S::f32s::LEN);
        let words = world.set_words();
        let sets = block.record.get(lane * words..(lane + 1) * words)?;
        seen.clear();
        seen.extend(block.state.counts.iter().map(|count| count[lane]));
        let words = block.trail.len() / block.teams;
        let trail = &block.trail[lane * words..][..words];
        let pois = moved.chunks_exact(world.pois.len()).nth(team).unwrap_or(&world.pois);
        Some(Episode::whole(sets, seen, trail, world.paths.is_some().then_some(pois)))
    }
}

/// The [`Observations`] of some teams.
pub(super) struct Slices<'a> {
    pub(super) arrays: StepArrays<'a>,
    pub(super) newly: &'a mut [bool],
    pub(super) observed: &'a mut [bool],
    pub(super) steps: &'a mut [u32],
}

impl Observations {
    /// Splits the arrays into those of at most `most` teams each.
    pub(super) fn split<'o>(&'o mut self, world: &World, most: usize) -> impl Iterator<Item = Slices<'o>> {
        let Observations { inputs, agents_at_poi, newly, observed, steps, positions, headings, speeds } = self;
        let mut all = StepArrays { positions, headings, speeds, inputs, agents_at_poi, ..StepArrays::default() };
        let (sizes, pois) = (step_sizes(world, 1, 1), world.pois.len());
        let flags = newly.chunks_mut(pois * most).zip(observed.chunks_mut(pois * most));
        flags.zip(steps.chunks_mut(most)).map(move |((newly, observed), steps)| {
            let arrays = all.split(sizes, steps.len());
            Slices { arrays, newly, observed, steps }
        })
    }
}

impl Slices<'_> {
    /// Clears the observations of a team that is reset.
    pub(super) fn reset(&mut self, world: &World, team: usize) {
        let (pois, words) = (world.pois.len(), world.words_per_step());
        self.arrays.agents_at_poi[team * words..][..words].fill(0);
        self.newly[team * pois..][..pois].fill(false);
        self.observed[team * pois..][..pois].fill(false);
        self.steps[team] = 0;
    }
}

/// Returns the team in a lane. Unused lanes repeat the first team.
#[inline(always)]
fn team_of(lane: usize, teams: usize) -> usize {
    if lane < teams { lane } else { 0 }
}

/// Returns every lane and its team.
#[inline(always)]
fn lanes<S: Simd>(teams: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..S::f32s::LEN).map(move |lane| (lane, team_of(lane, teams)))
}

impl<S: Simd> Workspace<S> {
    fn new(simd: S, world: &World) -> Workspace<S> {
        let sets = vec![0; world.words_per_step() * S::f32s::LEN];
        let sights = vec![0; world.followers() * world.leader_words() * S::f32s::LEN];
        Workspace { block: Block::new(simd, world), sets, sights, kept: Default::default(), moved: false }
    }

    /// Puts the POIs of a vector of teams in their places.
    fn move_pois(&mut self, world: &World, moved: &[Vec2], first: usize, teams: usize) {
        let moves = !moved.is_empty();
        if !std::mem::replace(&mut self.moved, moves) && !moves {
            return;
        }
        for lane in 0..S::f32s::LEN {
            let places = if moves { &moved[(first + team_of(lane, teams)) * world.pois.len()..] } else { &world.pois };
            self.block.place_pois(lane, places);
        }
    }

    /// Executes a command for one vector of teams.
    #[inline(always)]
    fn run(
        &mut self,
        simd: S,
        world: &World,
        moved: &[Vec2],
        block: &mut TeamBlock<S>,
        command: Command<'_>,
        slices: &mut Slices<'_>,
    ) {
        self.move_pois(world, moved, block.first, block.teams);
        self.block.swap(&mut block.state);
        let has_changed = match command {
            Command::Reset { chosen, starts, headings } => self.reset(world, block, chosen, [starts, headings], slices),
            Command::Step(actions) => self.step(simd, world, block, actions, slices),
            Command::Restore(saved) => self.restore(world, block, saved),
            Command::Show => {
                slices.arrays.write_states(simd, &self.block.agents, (0, 1));
                false
            }
        };
        if has_changed {
            self.block.sense();
            slices.arrays.write_inputs(&self.block, (0, 1));
        }
        self.block.swap(&mut block.state);
    }

    #[inline(always)]
    fn restore(&mut self, world: &World, block: &mut TeamBlock<S>, saved: &Saved<'_>) -> bool {
        let TeamBlock { first, teams, ref mut record, ref mut trail, .. } = *block;
        let (agents, pairs) = (world.agents(), world.followers() * world.leaders());
        for (lane, team) in lanes::<S>(teams) {
            let at = (first + team) * agents;
            for (agent, index) in self.block.agents.iter_mut().zip(at..) {
                (agent.x[lane], agent.y[lane]) = (saved.positions[index * 2], saved.positions[index * 2 + 1]);
                (agent.hx[lane], agent.hy[lane]) = (saved.headings[index * 2], saved.headings[index * 2 + 1]);
                agent.speed[lane] = saved.speeds[index];
            }
            let gone = &saved.gone[(first + team) * world.gone_within.len()..];
            self.block.gone.iter_mut().zip(gone).for_each(|(to, &gone)| to[lane] = gone);
            if !saved.counts.is_empty() {
                let counts = &saved.counts[(first + team) * pairs..][..pairs];
                self.block.counts.iter_mut().zip(counts).for_each(|(count, &saved)| count[lane] = saved);
            }
        }
        let (size, trailed) = (record.len() / teams, trail.len() / teams);
        record.copy_from_slice(&saved.record[first * size..][..teams * size]);
        trail.copy_from_slice(&saved.trail[first * trailed..][..teams * trailed]);
        true
    }

    /// Returns whether any team is chosen.
    #[inline(always)]
    fn reset(
        &mut self,
        world: &World,
        block: &mut TeamBlock<S>,
        chosen: Option<&[bool]>,
        [starts, headings]: [Option<&[Vec2]>; 2],
        slices: &mut Slices<'_>,
    ) -> bool {
        let agents = world.agents();
        let TeamBlock { first, teams, ref mut record, ref mut trail, .. } = *block;
        let is_chosen = |team: usize| chosen.is_none_or(|chosen| chosen[team]);
        if !(first..first + teams).any(is_chosen) {
            return false;
        }
        let all = (first..first + teams).all(is_chosen);
        if all {
            self.block.start();
        }
        for (lane, team) in lanes::<S>(teams).filter(|&(_, team)| is_chosen(first + team)) {
            let at = (first + team) * agents;
            let starts = starts.map_or(&world.starts[..], |starts| &starts[at..at + agents]);
            let headings = headings.map_or(&world.headings[..], |headings| &headings[at..at + agents]);
            self.block.place(lane, starts, headings);
            if !all {
                self.block.start_lane(lane);
            }
        }
        let (size, trailed) = (record.len() / teams, trail.len() / teams);
        for team in (0..teams).filter(|team| is_chosen(first + team)) {
            slices.reset(world, team);
            record[team * size..][..size].fill(0);
            trail[team * trailed..][..trailed].fill(unrecorded(world));
            self.record_positions(world, trail, team, 0);
        }
        true
    }

    /// Returns whether any team still plays.
    #[inline(always)]
    fn step(
        &mut self,
        simd: S,
        world: &World,
        block: &mut TeamBlock<S>,
        actions: &[f32],
        Slices { arrays, newly, observed, steps }: &mut Slices<'_>,
    ) -> bool {
        let last = world.constants.steps;
        let playing = (0..).zip(&**steps).map(|(team, &step)| u64::from(step < last) << team).sum::<u64>();
        newly.fill(false);
        let TeamBlock { first, teams, ref mut record, ref mut trail, .. } = *block;
        if playing == 0 {
            return false;
        }
        self.take(simd, world, &actions[first * world.leaders() * OUTPUTS..], teams);
        let is_partial = (playing.count_ones() as usize) < teams;
        if is_partial {
            let (agents, counts) = &mut self.kept;
            agents.clone_from(&self.block.agents);
            counts.clone_from(&self.block.counts);
        }
        let records_sights = world.paths.is_none() && !trail.is_empty();
        let seen = if records_sights { &mut self.sights } else { &mut [][..] };
        self.block.step(seen, Some(&mut self.sets));
        if is_partial {
            for (lane, _) in lanes::<S>(teams).filter(|&(_, team)| steps[team] >= last) {
                keep(&mut self.block, &self.kept, lane);
            }
            self.block.record_poi_sets(&mut self.sets);
        }
        arrays.write_sets(simd, &self.sets, (0, 1));
        if records_sights {
            self.record_sightings(world, steps, trail);
        }
        for (team, &step) in steps.iter().enumerate().filter(|(_, step)| **step < last) {
            self.record_positions(world, trail, team, step as usize + 1);
        }
        let (pois, words, width) = (world.pois.len(), world.constants.words as usize, S::f32s::LEN);
        // A POI that this step observes opens another one from the next step on.
        let rule = &world.rule;
        for (poi, (sets, &coupling)) in self.sets.chunks_exact(words * width).zip(&world.coupling).enumerate() {
            let count = sets.chunks_exact(width).enumerate().fold(S::u32s::splat(simd, 0), |count, (word, sets)| {
                count + count_ones::<S>(S::u32s::from_slice(simd, sets) & rule.counted(poi, word, u32::MAX))
            });
            let mut enough = count.simd_ge(coupling).to_bitmask() & playing;
            while enough != 0 {
                let team = enough.trailing_zeros() as usize;
                let before = &observed[team * pois..][..pois];
                newly[team * pois + poi] = !before[poi] && rule.is_open(poi, steps[team] + 1, before);
                enough &= enough - 1;
            }
        }
        observed.iter_mut().zip(&**newly).for_each(|(observed, newly)| *observed |= *newly);
        if !record.is_empty() {
            let size = pois * words;
            for (team, &step) in steps.iter().enumerate().filter(|(_, step)| **step < last) {
                let at = team * world.set_words() + step as usize * size;
                record[at..at + size].copy_from_slice(&arrays.agents_at_poi[team * size..][..size]);
            }
        }
        steps.iter_mut().for_each(|step| *step = last.min(*step + 1));
        true
    }

    /// Records which leaders each follower saw before this step, for teams whose episode is not over.
    #[inline(always)]
    fn record_sightings(&self, world: &World, steps: &[u32], sights: &mut [u32]) {
        let size = world.followers() * world.leader_words();
        for (team, &step) in steps.iter().enumerate().filter(|(_, step)| **step < world.constants.steps) {
            let to = &mut sights[team * world.sight_words() + step as usize * size..][..size];
            to.iter_mut().zip(self.sights[team..].iter().step_by(S::f32s::LEN)).for_each(|(to, &seen)| *to = seen);
        }
    }

    /// Records where the agents of a team are after so many steps, if scores need it.
    #[inline(always)]
    fn record_positions(&self, world: &World, trail: &mut [u32], team: usize, step: usize) {
        if world.paths.is_some() && !trail.is_empty() {
            let to = &mut trail[team * world.path_words() + step * world.agents() * 2..][..world.agents() * 2];
            for (to, agent) in to.chunks_exact_mut(2).zip(&self.block.agents) {
                to.copy_from_slice(&[agent.x[team], agent.y[team]].map(f32::to_bits));
            }
        }
    }

    /// Uses the actions of so many teams as the policies' outputs.
    #[inline(always)]
    fn take(&mut self, simd: S, world: &World, actions: &[f32], teams: usize) {
        let columns = world.leaders() * OUTPUTS;
        for quad in 0..S::f32s::LEN / 4 {
            let row = |lane: usize| &actions[team_of(quad * 4 + lane, teams) * columns..][..columns];
            let rows = [row(0), row(1), row(2), row(3)];
            let outputs = self.block.outputs.as_flattened_mut();
            transpose_rows(
                simd,
                rows,
                #[inline(always)]
                |column, lanes| outputs[column].as_mut_slice()[quad * 4..quad * 4 + 4].copy_from_slice(lanes),
            );
        }
        for output in self.block.outputs.as_flattened_mut() {
            *output = clamp_to::<S>(*output, splat(simd, -1.0), splat(simd, 1.0));
        }
    }
}

/// Restores a lane's agents and counts from before the step.
#[inline(always)]
fn keep<S: Simd>(block: &mut Block<S>, (agents, counts): &(Vec<Agent<S>>, Vec<S::u32s>), lane: usize) {
    for (agent, kept) in block.agents.iter_mut().zip(agents) {
        agent.x[lane] = kept.x[lane];
        agent.y[lane] = kept.y[lane];
        agent.hx[lane] = kept.hx[lane];
        agent.hy[lane] = kept.hy[lane];
        agent.speed[lane] = kept.speed[lane];
    }
    for (count, kept) in block.counts.iter_mut().zip(counts) {
        count[lane] = kept[lane];
    }
}
