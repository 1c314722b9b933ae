//! Whole episodes of one vector of teams.

use fearless_simd::{Simd, prelude::*};

use super::ScoreTable;
use super::batch::WorldBatch;
use super::block::Block;
use super::network::Network;
use crate::config::Fitness;
use crate::credit::{Episode, LaneCredit, Paths, Seen, Strided};
use crate::model::class::Class;
use crate::world::World;

/// Follows the episodes of one vector of teams. By default nothing is done.
pub(super) trait Observer<S: Simd> {
    /// The teams are at their start.
    #[inline(always)]
    fn started(&mut self, _: &Block<S>) {}

    /// Policies have answered what leaders sense before this step, and agents are about to move. The outputs may be
    /// changed.
    #[inline(always)]
    fn decided(&mut self, _: &mut Block<S>, _step: usize) {}

    /// The agents have moved. `sets` are the agents at each POI, `[pois][words][lanes]`.
    #[inline(always)]
    fn moved(&mut self, _: &Block<S>, _sets: &[u32], _step: usize) {}
}

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
}

/// Returns the words of a team's sightings: 0 unless recorded.
pub(super) fn sight_words(world: &World, sighted: bool) -> usize {
    if sighted { world.sight_words() } else { 0 }
}

impl<S: Simd> EpisodeBlock<S> {
    pub(super) fn new(simd: S, world: &World, sighted: bool) -> EpisodeBlock<S> {
        EpisodeBlock {
            classes: world.classes.clone(),
            block: Block::new(simd, world),
            network: Network::new(simd, &world.constants.policy, world.choices()),
            places: Vec::with_capacity(S::f32s::LEN),
            sets: vec![0; world.set_words() * S::f32s::LEN],
            seen: vec![0; world.followers() * world.leaders() * S::f32s::LEN],
            sights: vec![0; sight_words(world, sighted) * S::f32s::LEN],
            paths: vec![0; if world.paths.is_some() { world.path_words() * S::f32s::LEN } else { 0 }],
            credit: LaneCredit::new(simd, world),
        }
    }

    /// Reports whether it has the sizes and constants of a world and its record.
    pub(super) fn fits(&self, world: &World, sighted: bool) -> bool {
        bytemuck::cast_slice::<_, u8>(&self.classes) == bytemuck::cast_slice::<_, u8>(&world.classes)
            && self.block.world.constants == world.constants
            && [&self.block.radii2, &self.block.values] == [&world.radii2, &world.values]
            && self.block.gone_within == world.gone_within
            && self.sights.len() == sight_words(world, sighted) * S::f32s::LEN
            && self.paths.is_empty() == world.paths.is_none()
    }

    /// Puts teams at their start, see [`EpisodeBlock::play`].
    #[inline(always)]
    fn load(&mut self, batch: &WorldBatch<'_>, first: usize, teams: usize) {
        let EpisodeBlock { block, network, places, .. } = self;
        places.clear();
        places.extend((0..S::f32s::LEN).map(|lane| batch.locate(first + if lane < teams { lane } else { 0 })));
        for (lane, &(group, _)) in places.iter().enumerate() {
            block.place(lane, batch.groups[group].starts, batch.groups[group].headings());
            block.place_pois(lane, batch.groups[group].pois());
        }
        block.start();
        network.load(batch, places);
    }

    /// Plays the whole episode of `teams` teams of the batch, from `first` on. Unused lanes repeat the first team.
    #[inline(always)]
    pub(super) fn play(&mut self, batch: &WorldBatch<'_>, first: usize, teams: usize, observer: &mut impl Observer<S>) {
        self.load(batch, first, teams);
        let EpisodeBlock { block, network, sets, seen, sights, paths, .. } = self;
        let steps = batch.world.steps();
        let [sets_per_step, sights_per_step] = [sets.len() / steps, sights.len() / steps];
        let moment = (paths.len() / (steps + 1)).max(1);
        let mut moments = paths.chunks_exact_mut(moment);
        observer.started(block);
        write_positions(block, &mut moments);
        for step in 0..steps {
            block.sense();
            network.decide(&block.inputs, &mut block.outputs);
            observer.decided(block, step);
            let sets = &mut sets[step * sets_per_step..][..sets_per_step];
            block.step(&mut sights[step * sights_per_step..][..sights_per_step], sets);
            observer.moved(block, sets, step);
            write_positions(block, &mut moments);
        }
        for (words, count) in seen.chunks_exact_mut(S::f32s::LEN).zip(&block.counts) {
            count.store_slice(words);
        }
    }

    /// Scores the teams that [`EpisodeBlock::play`] played: all lanes at once if the fitnesses allow it.
    #[inline(always)]
    pub(super) fn score(&mut self, batch: &WorldBatch<'_>, first: usize, teams: usize, scores: &ScoreTable<'_>) {
        let places = |lane: usize| {
            let (group, team) = batch.locate(first + lane);
            (batch.first + group, team)
        };
        // Without a fitness, only the observed POIs are wanted.
        let counted = batch.fitnesses.map(|fitnesses| if fitnesses.is_empty() { &[Fitness::G] } else { fitnesses });
        let in_lanes = |fitness: &Fitness| LaneCredit::<S>::can_score(batch.world, *fitness);
        let Some(counted) = counted.filter(|fitnesses| fitnesses.iter().all(in_lanes)) else {
            for lane in 0..teams {
                let (group, team) = places(lane);
                scores.score(group, team, &self.episode(batch, lane));
            }
            return;
        };
        for (row, &fitness) in counted.iter().enumerate() {
            self.credit.score(&self.sets, &self.block.counts, batch.world, fitness);
            for lane in 0..teams {
                scores.put(places(lane), row, self.credit.observed(lane), self.credit.scores(lane));
            }
        }
    }

    /// Returns one lane's record of a batch that was played.
    pub(super) fn episode<'a>(&'a self, batch: &WorldBatch<'a>, lane: usize) -> Episode<'a> {
        let strided = |words| Strided { words, stride: S::f32s::LEN, offset: lane };
        let seen = Seen::Counts(strided(&self.seen));
        let pois = batch.groups[self.places[lane].0].pois();
        let paths = batch.world.paths.is_some().then(|| Paths { positions: strided(&self.paths), pois });
        Episode { sets: strided(&self.sets), seen, sights: strided(&self.sights), paths }
    }
}

/// Writes the positions of a moment, `[agents][2][lanes]`, if they are recorded.
#[inline(always)]
fn write_positions<'a, S: Simd>(block: &Block<S>, moments: &mut impl Iterator<Item = &'a mut [u32]>) {
    let Some(moment) = moments.next() else { return };
    for (agent, to) in block.agents.iter().zip(moment.chunks_exact_mut(2 * S::f32s::LEN)) {
        let (x, y) = to.split_at_mut(S::f32s::LEN);
        agent.x.bitcast::<S::u32s>().store_slice(x);
        agent.y.bitcast::<S::u32s>().store_slice(y);
    }
}
