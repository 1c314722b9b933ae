//! The record of a step: who is at each POI, and which leaders each follower sees.

use fearless_simd::{Simd, prelude::*};

use super::agent::Agent;
use super::block::Block;
use super::pois::PoiPosition;
use crate::kernels::splat;
use crate::model::{Lanes, couple, follow};

impl<S: Simd> Block<S> {
    /// Writes which leaders each follower sees, one bit per leader, `[followers][words of leaders][lanes]`.
    #[inline(always)]
    pub(super) fn record_sightings(&self, sights: &mut [u32]) {
        let Block { simd, world, agents, .. } = self;
        let (leaders, followers) = agents.split_at(world.constants.leaders as usize);
        let pairs = followers.iter().flat_map(|follower| leaders.chunks(32).map(move |leaders| (follower, leaders)));
        for ((follower, leaders), words) in pairs.zip(sights.chunks_exact_mut(S::f32s::LEN)) {
            let (mut seen, mut bit) = (S::u32s::splat(*simd, 0), S::u32s::splat(*simd, 1));
            for leader in leaders {
                let sees = follow::sees::<S>(world, leader.x - follower.x, leader.y - follower.y);
                seen |= sees.to_vector().bitcast::<S::u32s>() & bit;
                bit += bit;
            }
            seen.store_slice(words);
        }
    }

    /// Writes the agents at each POI, one bit per agent, `[pois][words][lanes]`.
    #[inline(always)]
    pub fn record_poi_sets(&mut self, pois: &[impl PoiPosition<S>], mut sets: &mut [u32]) {
        let (fours, rest) = pois.as_chunks::<4>();
        for pois in fours {
            sets = observe(self.simd, &self.world, &self.agents, pois, sets);
        }
        for poi in rest {
            sets = observe(self.simd, &self.world, &self.agents, std::array::from_ref(poi), sets);
        }
    }
}

/// Writes the sets of some POIs, `[N][words][lanes]`, and returns the rest of `sets`.
#[inline(always)]
fn observe<'a, S: Simd, const N: usize>(
    simd: S,
    world: &Lanes<S>,
    agents: &[Agent<S>],
    pois: &[impl PoiPosition<S>; N],
    sets: &'a mut [u32],
) -> &'a mut [u32] {
    let mut places = [[splat(simd, 0.0); 2]; N];
    for (place, poi) in places.iter_mut().zip(pois) {
        *place = poi.lanes(simd);
    }
    let words = world.constants.words as usize;
    for (word, agents) in agents.chunks(32).enumerate() {
        let (mut near, mut bit) = ([S::u32s::splat(simd, 0); N], S::u32s::splat(simd, 1));
        for agent in agents {
            for (near, &[x, y]) in near.iter_mut().zip(&places) {
                let observes = couple::observes::<S>(world, agent.x - x, agent.y - y);
                *near |= observes.to_vector().bitcast::<S::u32s>() & bit;
            }
            bit += bit;
        }
        for (poi, near) in near.iter().enumerate() {
            near.store_slice(&mut sets[(poi * words + word) * S::f32s::LEN..][..S::f32s::LEN]);
        }
    }
    &mut sets[N * words * S::f32s::LEN..]
}
