//! Finding agents that may be in reach of each other, in any lane.

use std::ops::Range;

use fearless_simd::{Simd, SimdMask, prelude::*};

use super::agent::Agent;
use crate::kernels::math::within;
use crate::kernels::splat;

/// Marks the pairs of agents that are close enough in any lane that one matters to the other. `reach2` is the largest
/// squared distance at which each agent and any after it matter to each other, `[agents]`.
///
/// Writes one bit per agent to `near`, `[words][agents]`. `bounds` is scratch memory, with one element per vector of
/// agents.
#[inline(always)]
pub(super) fn find_near<S: Simd>(reach2: &[f32], agents: &[Agent<S>], near: &mut [u64], bounds: &mut [Bounds<S>]) {
    near.fill(0);
    let count = agents.len();
    if count > MAX_UNBOUNDED_AGENTS {
        let lanes = S::f32s::LEN;
        for (bounds, agents) in bounds.iter_mut().zip(agents.chunks(lanes)) {
            bounds.enclose(agents);
        }
        for ((i, agent), &reach2) in agents.iter().enumerate().zip(reach2) {
            let own = bounds[i / lanes].around(i % lanes, reach2);
            for (vector, bounds) in bounds.iter().enumerate().skip(i / lanes) {
                let first = vector * lanes;
                let mut bits = bounds.meet(own);
                if first <= i {
                    bits &= u64::MAX << (i - first) << 1;
                }
                let mut row = 0;
                while bits != 0 {
                    let j = first + bits.trailing_zeros() as usize;
                    // Branch-free, because the branch predictor cannot guess which of the agents in overlapping boxes
                    // are in reach.
                    let within = u64::from(meet::<S>(agent, &agents[j], reach2));
                    row |= within << (j % 64);
                    near[i / 64 * count + j] |= within << (i % 64);
                    bits &= bits - 1;
                }
                near[first / 64 * count + i] |= row;
            }
        }
    } else {
        let near = &mut near[..count];
        for ((i, agent), &reach2) in agents.iter().enumerate().zip(reach2) {
            let mut row = 0;
            for j in i + 1..count {
                if meet::<S>(agent, &agents[j], reach2) {
                    row |= 1 << j;
                    near[j] |= 1 << i;
                }
            }
            near[i] |= row;
        }
    }
}

/// Reports whether the squared distance of two agents is at most `reach2` in any lane.
#[inline(always)]
fn meet<S: Simd>(agent: &Agent<S>, other: &Agent<S>, reach2: f32) -> bool {
    within::<S>(other.x - agent.x, other.y - agent.y, splat(agent.x.token(), reach2)).any_true()
}

/// Bounding boxes of some agents' positions over all lanes, one agent per lane.
#[derive(Clone, Copy)]
pub(super) struct Bounds<S: Simd> {
    low_x: S::f32s,
    high_x: S::f32s,
    low_y: S::f32s,
    high_y: S::f32s,
}

impl<S: Simd> Bounds<S> {
    /// Returns boxes that overlap nothing, for unused lanes.
    pub(super) fn nowhere(simd: S) -> Bounds<S> {
        let (low, high) = (splat(simd, f32::INFINITY), splat(simd, f32::NEG_INFINITY));
        Bounds { low_x: low, high_x: high, low_y: low, high_y: high }
    }

    #[inline(always)]
    fn enclose(&mut self, agents: &[Agent<S>]) {
        for (lane, agent) in agents.iter().enumerate() {
            self.low_x[lane] = agent.x.reduce_min();
            self.high_x[lane] = agent.x.reduce_max();
            self.low_y[lane] = agent.y.reduce_min();
            self.high_y[lane] = agent.y.reduce_max();
        }
    }

    /// Returns one agent's box in every lane, widened by its reach.
    #[inline(always)]
    fn around(&self, lane: usize, reach2: f32) -> Bounds<S> {
        let simd = self.low_x.token();
        // The margin covers rounding, so that no pair is missed.
        let reach = reach2.sqrt() * 1.001;
        Bounds {
            low_x: splat(simd, self.low_x[lane] - reach),
            high_x: splat(simd, self.high_x[lane] + reach),
            low_y: splat(simd, self.low_y[lane] - reach),
            high_y: splat(simd, self.high_y[lane] + reach),
        }
    }

    /// Returns one bit per agent, set if its box overlaps this one.
    #[inline(always)]
    fn meet(&self, other: Bounds<S>) -> u64 {
        let near_x = self.low_x.simd_le(other.high_x) & self.high_x.simd_ge(other.low_x);
        let near_y = self.low_y.simd_le(other.high_y) & self.high_y.simd_ge(other.low_y);
        (near_x & near_y).to_bitmask()
    }
}

/// With more agents than this, pairs are first tested by their bounding boxes.
const MAX_UNBOUNDED_AGENTS: usize = 32;

/// Some agents, as masks of the words of a set that have any: the index of the word, and its mask.
pub(super) type Masks = Vec<(usize, u64)>;

/// Returns the agents of some runs as masks.
pub(super) fn masks(runs: impl IntoIterator<Item = Range<usize>>) -> Masks {
    let mut masks: Masks = vec![];
    for agent in runs.into_iter().flatten() {
        let bit = 1 << (agent % 64);
        match masks.last_mut().filter(|(word, _)| *word == agent / 64) {
            Some((_, mask)) => *mask |= bit,
            None => masks.push((agent / 64, bit)),
        }
    }
    masks
}

/// Calls `f` with the index and the state of each of some agents that may be in reach of this one, ascending.
#[inline(always)]
pub(super) fn each_near<T>(
    near: &[u64],
    agents: &[T],
    agent: usize,
    of: &[(usize, u64)],
    mut f: impl FnMut(usize, &T),
) {
    for &(word, mask) in of {
        let mut bits = near[word * agents.len() + agent] & mask;
        while bits != 0 {
            let index = word * 64 + bits.trailing_zeros() as usize;
            f(index, &agents[index]);
            bits &= bits - 1;
        }
    }
}
