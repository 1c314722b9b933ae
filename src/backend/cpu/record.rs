//! The record of a step: who is at each POI, and which leaders each follower sees.

use fearless_simd::{Simd, prelude::*};

use super::agent::Agent;
use super::block::Block;
use crate::kernels::math::within;
use crate::kernels::splat;
use crate::model::couple;

impl<S: Simd> Block<S> {
    /// Writes which leaders each follower sees, one bit per leader, `[followers][words of leaders][lanes]`.
    #[inline(always)]
    pub(super) fn record_sightings(&self, sights: &mut [u32]) {
        let Block { simd, world, agents, .. } = self;
        let leaders = world.constants.leaders as usize;
        let mut rows = sights.chunks_exact_mut(leaders.div_ceil(32) * S::f32s::LEN);
        for (class, led) in world.classes.iter().enumerate() {
            for follower in led.agents().filter(|&agent| agent >= leaders) {
                let row = rows.next().expect("sights have a row per follower");
                row.fill(0);
                for leading in &world.classes {
                    for leader in leading.agents().take_while(|&agent| agent < leaders) {
                        let (dx, dy) = (agents[leader].x - agents[follower].x, agents[leader].y - agents[follower].y);
                        let sees = within::<S>(dx, dy, splat(*simd, leading.constants.influence2[class]));
                        let words = &mut row[leader / 32 * S::f32s::LEN..][..S::f32s::LEN];
                        let seen = S::u32s::from_slice(*simd, words)
                            | sees.to_vector().bitcast::<S::u32s>() & S::u32s::splat(*simd, 1 << (leader % 32));
                        seen.store_slice(words);
                    }
                }
            }
        }
    }

    /// Writes the agents at each POI, one bit per agent, `[pois][words][lanes]`.
    pub fn record_poi_sets(&mut self, mut sets: &mut [u32]) {
        let ((fours, rest), (radii2, last)) = (self.pois.as_chunks::<4>(), self.radii2.as_chunks::<4>());
        let words = self.world.constants.words as usize;
        self.simd.vectorize(
            #[inline(always)]
            || {
                for (pois, radii2) in fours.iter().zip(radii2) {
                    sets = observe(self.simd, words, &self.agents, pois, radii2, std::mem::take(&mut sets));
                }
                for (poi, radius2) in rest.iter().zip(last) {
                    let (pois, radii2) = (std::array::from_ref(poi), std::array::from_ref(radius2));
                    sets = observe(self.simd, words, &self.agents, pois, radii2, std::mem::take(&mut sets));
                }
            },
        );
    }
}

/// Writes the sets of some POIs, `[N][words][lanes]`, and returns the rest of `sets`.
#[inline(always)]
fn observe<'a, S: Simd, const N: usize>(
    simd: S,
    words: usize,
    agents: &[Agent<S>],
    pois: &[[S::f32s; 2]; N],
    radii2: &[f32; N],
    sets: &'a mut [u32],
) -> &'a mut [u32] {
    for (word, agents) in agents.chunks(32).enumerate() {
        let (mut near, mut bit) = ([S::u32s::splat(simd, 0); N], S::u32s::splat(simd, 1));
        for agent in agents {
            for ((near, &[x, y]), &radius2) in near.iter_mut().zip(pois).zip(radii2) {
                let observes = couple::observes::<S>(splat(simd, radius2), agent.x - x, agent.y - y);
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
