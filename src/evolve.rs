//! Teams, selection and mutation: cooperative coevolution with an n-elites binary tournament (Algorithm 1).
//!
//! Everything random is a pure function of counters, so that it depends on neither threads, batch size, backend nor
//! on having been interrupted.

use fearless_simd::{Level, Simd, SimdMask, dispatch, prelude::*};
use glam::Vec2;
use rayon::prelude::*;

use crate::config::{Learning, Mutation};
use crate::kernels::{bound, math, splat};
use crate::world::{World, on_grid};

/// Weights are 0 or of this size (2^-30) at least, so that no product in a policy is denormal.
pub const MIN_WEIGHT: f32 = 1.0 / 1_073_741_824.0;
/// Weights of larger size (2^20) stay at it.
pub const MAX_WEIGHT: f32 = 1_048_576.0;

/// What a random number is for; no two purposes share any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    Weights = 1,
    Teams = 2,
    Starts = 3,
    Tournament = 4,
    Mutation = 5,
}

/// A place in the space of all randomness; [`Key::draw`] gives its numbers, by a counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key([u32; 4]);

impl Key {
    pub fn new(seed: u64, trial: usize, purpose: Purpose) -> Key {
        Key(math::draw_scalar([seed as u32, (seed >> 32) as u32, trial as u32, purpose as u32]))
    }

    /// The key of one slot of one population of a generation.
    pub fn at(self, generation: usize, population: usize, slot: usize) -> Key {
        let Key([x, y, z, w]) = self;
        Key(math::draw_scalar([x ^ generation as u32, y ^ population as u32, z ^ slot as u32, w]))
    }

    /// Four random words.
    pub fn draw(self, counter: u32) -> [u32; 4] {
        let Key([x, y, z, w]) = self;
        math::draw_scalar([x, y, z, w ^ counter])
    }

    /// Another key of the same place, with numbers of its own: those of a counter that nothing else uses.
    pub fn fork(self) -> Key {
        Key(self.draw(u32::MAX))
    }

    /// [`Key::draw`] for a counter a lane.
    #[inline(always)]
    fn draw_lanes<S: Simd>(self, counter: S::u32s) -> [S::u32s; 4] {
        let simd = counter.token();
        let Key([x, y, z, w]) = self;
        let word = |word| S::u32s::simd_from(simd, word);
        math::draw::<S>(word(x), word(y), word(z), counter ^ w)
    }
}

/// A number in `0..below` from a random word.
fn pick(word: u32, below: usize) -> usize {
    ((word as u64 * below as u64) >> 32) as usize
}

/// Teams of one generation: a random permutation per population puts each policy on exactly one team.
///
/// Writes the policy of each leader, `[teams][leaders]`; `key` is of purpose [`Purpose::Teams`].
pub fn form_teams(key: Key, generation: usize, leaders: usize, teams: &mut [u32]) {
    let population = teams.len() / leaders;
    for leader in 0..leaders {
        let key = key.at(generation, leader, 0);
        for team in 0..population {
            // Fisher and Yates, inside out: the newcomer takes a random place, whoever was there moves to the end.
            let place = pick(key.draw(team as u32)[0], team + 1);
            teams[team * leaders + leader] = teams[place * leaders + leader];
            teams[place * leaders + leader] = team as u32;
        }
    }
}

/// Start positions of one episode: the world's, each moved by a uniform offset in `-jitter..jitter` on both axes.
pub fn jitter_starts(key: Key, generation: usize, episode: usize, world: &World, jitter: f64, starts: &mut Vec<Vec2>) {
    starts.clone_from(&world.starts);
    if jitter == 0.0 {
        return;
    }
    let key = key.at(generation, episode, 0);
    let map = Vec2::new(world.constants.map_x, world.constants.map_y);
    for (agent, start) in starts.iter_mut().enumerate() {
        let [x, y, ..] = key.draw(agent as u32).map(|word| {
            // 53 bits are exact in f64, and so is every step but the last, which rounds to f32.
            ((word as f64 / (1u64 << 32) as f64) * 2.0 - 1.0) * jitter
        });
        *start = on_grid(*start + Vec2::new(x as f32, y as f32), map);
    }
}

/// The indices of the `count` best scores, best first; ties go to the lower index.
pub fn best(scores: &[f32], count: usize) -> Vec<usize> {
    let better = |a: &usize, b: &usize| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b));
    let mut order: Vec<usize> = (0..scores.len()).collect();
    if count < order.len() && count > 0 {
        order.select_nth_unstable_by(count - 1, better);
    }
    order.truncate(count);
    order.sort_unstable_by(better);
    order
}

/// The winner of the binary tournament of one slot: two distinct policies, the higher score, ties to the lower index.
pub fn tournament(key: Key, scores: &[f32]) -> usize {
    let [first, second, ..] = key.draw(0);
    let a = pick(first, scores.len());
    let b = pick(second, scores.len() - 1);
    let b = if b >= a { b + 1 } else { b };
    let (low, high) = (a.min(b), a.max(b));
    if scores[high] > scores[low] { high } else { low }
}

/// Set in a slot's entry of the plan of [`draw_parents`] where the slot keeps its parent's weights as they are.
pub const UNCHANGED: u32 = 1 << 31;

/// Plans one population's next generation: the policy from which each slot comes, `[policies + 1]`, with [`UNCHANGED`]
/// where it does not mutate.
///
/// The first slots are the elites', best first; the last, the champion's, stays. `key` is of purpose
/// [`Purpose::Tournament`], `scores` are `[policies]`.
pub fn draw_parents(
    key: Key,
    generation: usize,
    population: usize,
    elites: usize,
    scores: &[f32],
    parents: &mut [u32],
) {
    let policies = scores.len();
    let draw = |(slot, parent): (usize, &mut u32)| {
        *parent = tournament(key.at(generation, population, slot), scores) as u32;
    };
    parents[..policies].par_iter_mut().with_min_len(1024).enumerate().skip(elites).for_each(draw);
    for (parent, elite) in parents.iter_mut().zip(best(scores, elites)) {
        *parent = elite as u32 | UNCHANGED;
    }
    parents[policies] = policies as u32 | UNCHANGED;
}

/// Weights N(0, 1) for a new policy; `key` is a slot's of purpose [`Purpose::Weights`].
pub fn random_policy(level: Level, key: Key, weights: &mut [f32]) {
    dispatch!(level, simd => random_lanes(simd, key, weights));
}

#[inline(always)]
fn random_lanes<S: Simd>(simd: S, key: Key, weights: &mut [f32]) {
    let width = S::f32s::LEN;
    let mut index = S::u32s::from_fn(simd, |lane| lane as u32);
    for chunk in weights.chunks_mut(width) {
        let [a, b, ..] = key.draw_lanes::<S>(index);
        let weight = within_limits(simd, math::normal::<S>(a, b));
        chunk.copy_from_slice(&weight.as_slice()[..chunk.len()]);
        index += width as u32;
    }
}

/// Mutates a policy: every weight, with the configured probability, gains noise, `N(0, sigma)` times itself or plainly.
///
/// `key` is a slot's of purpose [`Purpose::Mutation`]; `chosen` is scratch.
pub fn mutate(level: Level, key: Key, learning: &Learning, weights: &mut [f32], chosen: &mut Vec<u32>) {
    dispatch!(level, simd => mutate_lanes(simd, key, learning, weights, chosen));
}

#[inline(always)]
fn mutate_lanes<S: Simd>(simd: S, key: Key, learning: &Learning, weights: &mut [f32], chosen: &mut Vec<u32>) {
    choose(simd, key, learning.mutation_probability, weights.len(), chosen);
    let noises = key.fork();
    let sigma = learning.mutation_sigma as f32;
    for chosen in chosen.chunks(S::f32s::LEN) {
        let (mut index, mut weight) = (S::u32s::simd_from(simd, 0), splat(simd, 0.0));
        for (lane, &chosen) in chosen.iter().enumerate() {
            index.as_mut_slice()[lane] = chosen;
            weight.as_mut_slice()[lane] = weights[chosen as usize];
        }
        let [a, b, ..] = noises.draw_lanes::<S>(index);
        let noise = math::normal::<S>(a, b) * sigma;
        let noise = if learning.mutation == Mutation::Scaled { noise * weight } else { noise };
        let mutated = within_limits(simd, weight + noise);
        for (lane, &chosen) in chosen.iter().enumerate() {
            weights[chosen as usize] = mutated.as_slice()[lane];
        }
    }
}

/// Which of `count` weights mutate: each by a random word of its own, of which a draw makes four.
///
/// Weight 64·block + 16·word + place takes its word from counter 16·block + place: no lane width shows in that.
#[inline(always)]
fn choose<S: Simd>(simd: S, key: Key, probability: f64, count: usize, chosen: &mut Vec<u32>) {
    chosen.clear();
    if probability >= 1.0 {
        chosen.extend(0..count as u32);
        return;
    }
    let threshold = (probability * (1u64 << 32) as f64) as u32;
    for block in 0..count.div_ceil(64) as u32 {
        let mut mutates = 0u64;
        for place in (0..16).step_by(S::f32s::LEN) {
            let counter = S::u32s::from_fn(simd, |lane| 16 * block + place + lane as u32);
            for (index, word) in (0..).zip(key.draw_lanes::<S>(counter)) {
                mutates |= word.simd_lt(threshold).to_bitmask() << (16 * index + place);
            }
        }
        while mutates != 0 {
            let index = 64 * block + mutates.trailing_zeros();
            if index < count as u32 {
                chosen.push(index);
            }
            mutates &= mutates - 1;
        }
    }
}

/// A weight brought within the sizes that policies may have.
#[inline(always)]
fn within_limits<S: Simd>(simd: S, weight: S::f32s) -> S::f32s {
    let bounded = bound::<S>(weight, splat(simd, -MAX_WEIGHT), splat(simd, MAX_WEIGHT));
    math::flush::<S>(bounded, MIN_WEIGHT)
}
