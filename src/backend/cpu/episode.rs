//! Whole episodes of one vector of teams.

use std::ops::Range;

use fearless_simd::{Simd, prelude::*};

use super::batch::WorldBatch;
use super::block::Block;
use super::network::Network;
use super::pois::{PoiPosition, load_pois, with_pois};
use crate::credit::{Episode, Seen, Strided};
use crate::world::World;

/// Whole episodes of one vector of teams: their state, policies and record.
pub(super) struct EpisodeBlock<S: Simd> {
    pub(super) block: Block<S>,
    network: Network<S>,
    /// The group and team of each lane.
    places: Vec<(usize, usize)>,
    /// The POI positions, `[pois]`; empty if every lane has the world's.
    moved: Vec<[S::f32s; 2]>,
    /// The sets, `[steps][pois][words][lanes]`, and the final counts, `[followers][leaders][lanes]`.
    sets: Vec<u32>,
    seen: Vec<u32>,
    /// The sightings, `[steps][followers][words of leaders][lanes]`; empty unless recorded.
    sights: Vec<u32>,
}

/// Returns the words of a team's sightings: 0 unless recorded.
pub(super) fn sight_words(world: &World, sighted: bool) -> usize {
    if sighted { world.sight_words() } else { 0 }
}

impl<S: Simd> EpisodeBlock<S> {
    pub(super) fn new(simd: S, world: &World, sighted: bool) -> EpisodeBlock<S> {
        EpisodeBlock {
            block: Block::new(simd, world),
            network: Network::new(simd, &world.constants.policy, world.leaders()),
            places: Vec::with_capacity(S::f32s::LEN),
            moved: Vec::new(),
            sets: vec![0; world.set_words() * S::f32s::LEN],
            seen: vec![0; world.followers() * world.leaders() * S::f32s::LEN],
            sights: vec![0; sight_words(world, sighted) * S::f32s::LEN],
        }
    }

    /// Reports whether it has the sizes and constants of a world and its record.
    pub(super) fn fits(&self, world: &World, sighted: bool) -> bool {
        self.block.world.constants == world.constants && self.sights.len() == sight_words(world, sighted) * S::f32s::LEN
    }

    /// Puts `teams` teams of the batch, from `first` on, at their start. Unused lanes repeat the first team.
    #[inline(always)]
    pub(super) fn load(&mut self, batch: &WorldBatch<'_>, first: usize, teams: usize) {
        let EpisodeBlock { block, network, places, moved, .. } = self;
        places.clear();
        places.extend((0..S::f32s::LEN).map(|lane| batch.locate(first + if lane < teams { lane } else { 0 })));
        for (lane, &(group, _)) in places.iter().enumerate() {
            block.place(lane, batch.groups[group].starts, &batch.world.headings);
        }
        load_pois(
            block.simd,
            batch.world,
            moved,
            #[inline(always)]
            |lane| batch.groups[places[lane].0].moved_pois(),
        );
        block.start();
        network.load(batch, places);
    }

    /// Plays some steps. Calls `before` with the number of each step before it plays.
    #[inline(always)]
    pub(super) fn play(&mut self, world: &World, steps: Range<usize>, before: impl Fn(usize)) {
        let EpisodeBlock { block, network, moved, sets, sights, .. } = self;
        with_pois!(moved, world, pois => for step in steps {
            before(step);
            sense(block, network, pois);
            advance(block, pois, sets, sights, step);
        });
        self.store_counts();
    }

    /// Writes the counts to the record, after the last step that was played.
    #[inline(always)]
    pub(super) fn store_counts(&mut self) {
        for (words, count) in self.seen.chunks_exact_mut(S::f32s::LEN).zip(&self.block.counts) {
            count.store_slice(words);
        }
    }

    /// Plays the first half of a step, see [`sense`].
    #[inline(always)]
    pub(super) fn sense(&mut self, world: &World) {
        let EpisodeBlock { block, network, moved, .. } = self;
        with_pois!(moved, world, pois => sense(block, network, pois));
    }

    /// Plays the second half of a step, see [`advance`].
    #[inline(always)]
    pub(super) fn advance(&mut self, world: &World, step: usize) {
        let EpisodeBlock { block, moved, sets, sights, .. } = self;
        with_pois!(moved, world, pois => advance(block, pois, sets, sights, step));
    }

    /// Returns the sets of a step, `[pois * words][lanes]`.
    #[inline(always)]
    pub(super) fn sets_of(&self, step: usize, words: usize) -> &[u32] {
        &self.sets[step * words * S::f32s::LEN..][..words * S::f32s::LEN]
    }

    /// Returns one lane's record.
    pub(super) fn episode(&self, lane: usize) -> Episode<'_> {
        let strided = |words| Strided { words, stride: S::f32s::LEN, offset: lane };
        let seen = Seen::Counts(strided(&self.seen));
        Episode { sets: strided(&self.sets), seen, sights: strided(&self.sights) }
    }
}

/// Plays the first half of a step: leaders sense, and their policies answer.
#[inline(always)]
fn sense<S: Simd>(block: &mut Block<S>, network: &mut Network<S>, pois: &[impl PoiPosition<S>]) {
    block.sense(pois);
    network.decide(&block.inputs, &mut block.outputs);
}

/// Plays the second half of a step: all agents move, and the record is written. `sets` and `sights` are of all steps;
/// `sights` may be empty.
#[inline(always)]
fn advance<S: Simd>(
    block: &mut Block<S>,
    pois: &[impl PoiPosition<S>],
    sets: &mut [u32],
    sights: &mut [u32],
    step: usize,
) {
    let steps = block.world.constants.steps as usize;
    let [sets_per_step, sights_per_step] = [sets.len() / steps, sights.len() / steps];
    if sights_per_step > 0 {
        block.record_sightings(&mut sights[step * sights_per_step..]);
    }
    block.advance();
    block.record_poi_sets(pois, &mut sets[step * sets_per_step..]);
}
