//! Whole episodes of one vector of teams.

use std::ops::Range;

use fearless_simd::{Simd, prelude::*};

use super::arrays::{StepArrays, write_columns};
use super::batch::WorldBatch;
use super::block::Block;
use super::network::Network;
use super::together::{Observer, Together};
use super::{Moment, ScoreTable};
use crate::config::Fitness;
use crate::credit::{Episode, LaneCredit, PathCredit, Paths, Strided};
use crate::model::class::Class;
use crate::world::{OUTPUTS, World};

/// Whole episodes of one vector of teams: their state, policies and record.
pub(super) struct EpisodeBlock<S: Simd> {
    classes: Vec<Class>,
    block: Block<S>,
    network: Network<S>,
    /// The group and team of each lane.
    places: Vec<(usize, usize)>,
    /// The sets, `[steps][pois][words][lanes]`, and the final counts, `[followers][leaders][lanes]`.
    sets: Vec<u32>,
    seen: Vec<u32>,
    /// The sightings, `[steps][followers][words of leaders][lanes]`; empty unless recorded.
    sights: Vec<u32>,
    /// The positions at the start and after each step, f32 as bits, `[steps + 1][agents][2][lanes]`; empty unless scores
    /// need them.
    paths: Vec<u32>,
    credit: LaneCredit<S>,
    path_credit: PathCredit,
}

/// Returns the words of a team's sightings: 0 unless recorded.
pub(super) fn sight_words(world: &World, sighted: bool) -> usize {
    if sighted { world.sight_words() } else { 0 }
}

impl<S: Simd> EpisodeBlock<S> {
    /// Puts teams at their start. Unused lanes repeat the first team.
    #[inline(always)]
    fn load(&mut self, batch: &WorldBatch<'_>, teams: Range<usize>) {
        let EpisodeBlock { block, network, places, .. } = self;
        places.clear();
        let team = |lane: usize| teams.start + if lane < teams.len() { lane } else { 0 };
        places.extend((0..S::f32s::LEN).map(|lane| batch.locate(team(lane))));
        for (lane, &(group, _)) in places.iter().enumerate() {
            block.place(lane, batch.groups[group].starts, batch.groups[group].headings());
            block.place_pois(lane, batch.groups[group].pois());
        }
        block.start();
        network.load_policies(
            #[inline(always)]
            |leader, lane| batch.policy(leader, places[lane]),
        );
    }

    /// Records the positions of a moment, if scores need them.
    #[inline(always)]
    fn record_positions(&mut self, moment: usize) {
        let words = self.block.agents.len() * 2 * S::f32s::LEN;
        let Some(paths) = self.paths.get_mut(moment * words..(moment + 1) * words) else { return };
        for (agent, to) in self.block.agents.iter().zip(paths.chunks_exact_mut(2 * S::f32s::LEN)) {
            let (x, y) = to.split_at_mut(S::f32s::LEN);
            agent.x.bitcast::<S::u32s>().store_slice(x);
            agent.y.bitcast::<S::u32s>().store_slice(y);
        }
    }
}

impl<S: Simd> Together<S> for EpisodeBlock<S> {
    const MAX_TEAMS: usize = S::f32s::LEN;

    fn allocate(simd: S, batch: &WorldBatch<'_>, _: bool) -> EpisodeBlock<S> {
        let (world, policy) = (batch.world, &batch.world.constants.policy);
        let used = (0..world.leaders()).map(|leader| world.class_of(leader).inputs()).collect();
        EpisodeBlock {
            classes: world.classes.clone(),
            block: Block::new(simd, world),
            network: Network::new(simd, policy, world.choices(), used),
            places: Vec::with_capacity(S::f32s::LEN),
            sets: vec![0; world.set_words() * S::f32s::LEN],
            seen: vec![0; world.followers() * world.leaders() * S::f32s::LEN],
            sights: vec![0; sight_words(world, batch.sighted) * S::f32s::LEN],
            paths: vec![0; if world.paths.is_some() { world.path_words() * S::f32s::LEN } else { 0 }],
            credit: LaneCredit::new(simd, world),
            path_credit: PathCredit::default(),
        }
    }

    fn fits(&self, batch: &WorldBatch<'_>) -> bool {
        let world = batch.world;
        bytemuck::cast_slice::<_, u8>(&self.classes) == bytemuck::cast_slice::<_, u8>(&world.classes)
            && self.block.world.constants == world.constants
            && [&self.block.radii2, &self.block.values] == [&world.radii2, &world.values]
            && self.block.gone_within == world.gone_within
            && self.sights.len() == sight_words(world, batch.sighted) * S::f32s::LEN
            && self.paths.is_empty() == world.paths.is_none()
    }

    #[inline(always)]
    fn play<O: Observer<S, Self>>(&mut self, batch: &WorldBatch<'_>, teams: Range<usize>, observer: &mut O) {
        self.load(batch, teams);
        let steps = batch.world.steps();
        let [sets_per_step, sights_per_step] = [self.sets.len() / steps, self.sights.len() / steps];
        let needs_sets = O::READS_SETS || batch.world.paths.is_none();
        observer.started(self);
        self.record_positions(0);
        for step in 0..steps {
            self.block.sense();
            self.network.decide(&self.block.inputs, &mut self.block.outputs);
            observer.decided(self, step);
            let sights = &mut self.sights[step * sights_per_step..][..sights_per_step];
            let sets = &mut self.sets[step * sets_per_step..][..sets_per_step];
            self.block.step(sights, needs_sets.then_some(sets));
            observer.moved(self, step);
            self.record_positions(step + 1);
        }
        for (words, count) in self.seen.chunks_exact_mut(S::f32s::LEN).zip(&self.block.counts) {
            count.store_slice(words);
        }
    }

    /// Scores all lanes at once if the fitnesses allow it.
    #[inline(always)]
    fn score(&mut self, batch: &WorldBatch<'_>, teams: Range<usize>, scores: &ScoreTable<'_>) {
        // Without a fitness, only the observed POIs are wanted.
        let counted = batch.fitnesses.map(|fitnesses| if fitnesses.is_empty() { &[Fitness::G] } else { fitnesses });
        let in_lanes =
            |fitness: &Fitness| batch.world.paths.is_some() || LaneCredit::<S>::can_score(batch.world, *fitness);
        let Some(counted) = counted.filter(|fitnesses| fitnesses.iter().all(in_lanes)) else {
            for lane in 0..teams.len() {
                let (group, team) = self.places[lane];
                scores.score(batch.first + group, team, &self.episode_of(batch, lane));
            }
            return;
        };
        let EpisodeBlock { block, places, sets, paths, credit, path_credit, .. } = self;
        for (row, &fitness) in counted.iter().enumerate() {
            match &batch.world.paths {
                Some(rule) => path_credit.score_teams(block.simd, paths, &block.pois, batch.world, rule, fitness),
                None => credit.score(sets, &block.counts, batch.world, fitness),
            }
            for (lane, &(group, team)) in places[..teams.len()].iter().enumerate() {
                let place = (batch.first + group, team);
                match batch.world.paths {
                    Some(_) => scores.put(place, row, path_credit.observed(lane), path_credit.scores(lane)),
                    None => scores.put(place, row, credit.observed(lane), credit.scores(lane)),
                }
            }
        }
    }

    fn episode_of<'a>(&'a self, batch: &WorldBatch<'a>, team: usize) -> Episode<'a> {
        let strided = |words| Strided { words, stride: S::f32s::LEN, offset: team };
        let seen = strided(&self.seen);
        let pois = batch.groups[self.places[team].0].pois();
        let paths = batch.world.paths.is_some().then(|| Paths { positions: strided(&self.paths), pois });
        Episode { sets: strided(&self.sets), seen, sights: strided(&self.sights), paths }
    }

    #[inline(always)]
    fn outputs(&mut self) -> &mut [[S::f32s; OUTPUTS]] {
        &mut self.block.outputs
    }

    #[inline(always)]
    fn outputs_at(leader: usize) -> (usize, usize) {
        (leader, 0)
    }

    fn moments(&self, team: usize, sensed: bool, moments: &mut [Moment], inputs: &mut [f32]) {
        self.block.moments(team, sensed, moments, inputs);
    }

    #[inline(always)]
    fn store_states(&self, row: (usize, usize), arrays: &mut StepArrays<'_>) {
        arrays.write_states(self.block.simd, &self.block.agents, row);
    }

    #[inline(always)]
    fn store_inputs(&self, row: (usize, usize), arrays: &mut StepArrays<'_>) {
        arrays.write_inputs(&self.block, row);
    }

    #[inline(always)]
    fn store_outputs(&self, row: (usize, usize), outputs: &mut [f32]) {
        write_columns(self.block.simd, self.block.outputs.as_flattened(), row, outputs);
    }

    #[inline(always)]
    fn store_sets(&self, row: (usize, usize), arrays: &mut StepArrays<'_>) {
        let words = self.sets.len() / row.1;
        arrays.write_sets(self.block.simd, &self.sets[row.0 * words..][..words], row);
    }
}
