//! Mutation: carries out the plan of the next generation.

use std::ops::Range;

use fearless_simd::{Level, Simd, SimdMask, dispatch, prelude::*};

use super::random::Key;
use super::selection::UNCHANGED;
use super::weights::within_limits;
use crate::config::{Learning, Mutation};
use crate::host::prefetch;
use crate::kernels::math;

/// Mutates a policy `[parameters]`. With the configured probability, each weight w gains noise: N(0, σ), or w · N(0, σ)
/// for [`Mutation::Scaled`].
///
/// `key` is a slot's key of [`Purpose::Mutation`](super::Purpose::Mutation). `scratch` may hold anything.
pub fn mutate(level: Level, key: Key, learning: &Learning, weights: &mut [f32], scratch: &mut Vec<u32>) {
    dispatch!(level, simd => mutate_lanes(simd, key, learning, weights, scratch));
}

#[inline(always)]
fn mutate_lanes<S: Simd>(simd: S, key: Key, learning: &Learning, weights: &mut [f32], scratch: &mut Vec<u32>) {
    let mut mutations = MutationList::new(scratch, 1, weights.len());
    mutations.mark(simd, 0, key, learning.mutation_probability);
    let listed = mutations.collect_indices(0);
    mutations.fill_positions(simd, 0, listed, key.fork());
    mutations.mutate(simd, learning, weights);
}

/// A breeding plan that does not match the populations it is applied to.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct InvalidInput(String);

/// How to make the next generation of a trial's populations.
#[derive(Clone, Debug)]
pub struct Breeding<'a> {
    /// The plan, `[populations][slots]`, see [`draw_parents`](super::draw_parents).
    pub parents: &'a [u32],
    /// The trial's key of [`Purpose::Mutation`](super::Purpose::Mutation).
    pub key: Key,
    /// The generation that ends.
    pub generation: usize,
    /// The mutation's kind, probability and standard deviation.
    pub learning: &'a Learning,
}

impl Breeding<'_> {
    /// Checks the plan against the sizes of the populations, `[populations, slots, parameters]`. Every backend calls
    /// this before it breeds.
    ///
    /// # Errors
    /// The plan has too few or too many entries, or a parent that does not exist.
    pub fn check(&self, [populations, slots, _]: [usize; 3]) -> Result<(), InvalidInput> {
        let invalid = |text: String| Err(InvalidInput(text));
        if self.parents.len() != populations * slots {
            return invalid(format!("{} parents for {populations} populations of {slots}", self.parents.len()));
        }
        // Finding the maximum is vectorised. The position is searched only after a failure.
        if self.parents.iter().map(|planned| planned & !UNCHANGED).max().is_none_or(|parent| (parent as usize) < slots)
        {
            return Ok(());
        }
        match self.parents.iter().position(|&planned| (planned & !UNCHANGED) as usize >= slots) {
            None => Ok(()),
            Some(place) => invalid(format!(
                "slot {} of population {} has policy {} of {slots} as its parent (they count from 0)",
                place % slots,
                place / slots,
                self.parents[place] & !UNCHANGED
            )),
        }
    }

    /// Returns the next generation of `weights`, computed on the host. Every backend must return the same bits.
    ///
    /// # Errors
    /// The plan does not match the sizes, see [`Breeding::check`].
    pub fn on_host(&self, sizes: [usize; 3], weights: &[f32]) -> Result<Vec<f32>, InvalidInput> {
        self.check(sizes)?;
        let [_, slots, parameters] = sizes;
        let (mut children, mut scratch) = (Vec::with_capacity(weights.len()), Vec::new());
        for (place, planned) in self.parents.iter().enumerate() {
            let (population, slot, first) = (place / slots, place % slots, children.len());
            let parent = population * slots + (planned & !UNCHANGED) as usize;
            children.extend_from_slice(&weights[parent * parameters..(parent + 1) * parameters]);
            if planned & UNCHANGED == 0 {
                let key = self.key.at(self.generation, population, slot);
                mutate(Level::new(), key, self.learning, &mut children[first..], &mut scratch);
            }
        }
        Ok(children)
    }
}

/// Some slots of one population, to be filled according to a plan.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Offspring<'a> {
    /// The trial's key of [`Purpose::Mutation`](super::Purpose::Mutation).
    pub key: Key,
    /// The generation that ends.
    pub generation: usize,
    /// The index of the population in its trial.
    pub population: usize,
    /// The index of the first slot.
    pub first: usize,
    /// The plan of all slots of the population, see [`draw_parents`](super::draw_parents).
    pub parents: &'a [u32],
    /// The population that ends, `[slots][parameters]`.
    pub policies: &'a [f32],
}

/// Fills slots, `[slots][parameters]`: copies each one's parent and [`mutate`]s it. `scratch` may hold anything.
pub(crate) fn breed(
    level: Level,
    learning: &Learning,
    offspring: Offspring<'_>,
    children: &mut [f32],
    scratch: &mut Vec<u32>,
) {
    let parameters = offspring.policies.len() / offspring.parents.len();
    // As many policies as fit into the first-level cache.
    let together = (BRED_TOGETHER / parameters).clamp(1, MAX_LANES);
    for (batch, children) in children.chunks_mut(together * parameters).enumerate() {
        let batch = Offspring { first: offspring.first + batch * together, ..offspring };
        dispatch!(level, simd => mutate_offspring(simd, learning, batch, children, scratch));
    }
}

/// Weights that are copied before they are mutated.
const BRED_TOGETHER: usize = 2048;

#[inline(always)]
fn mutate_offspring<S: Simd>(
    simd: S,
    learning: &Learning,
    offspring: Offspring<'_>,
    children: &mut [f32],
    scratch: &mut Vec<u32>,
) {
    let parameters = offspring.policies.len() / offspring.parents.len();
    let policy = |parent: u32| &offspring.policies[(parent & !UNCHANGED) as usize * parameters..][..parameters];
    let (parents, later) = offspring.parents[offspring.first..].split_at(children.len() / parameters);
    let mut mutations = MutationList::new(scratch, parents.len(), parameters);
    for (batch, parents) in parents.chunks(S::f32s::LEN).enumerate() {
        let first = batch * S::f32s::LEN;
        let slots = S::u32s::from_fn(simd, |lane| (offspring.first + first + lane) as u32);
        let keys = offspring.key.at_lanes::<S>(offspring.generation, offspring.population, slots);
        let [x, y, z, w] = keys;
        let forks = math::pcg4d::<S>(x, y, z, w ^ u32::MAX);
        let key = |of: &[S::u32s; 4], lane: usize| Key([of[0][lane], of[1][lane], of[2][lane], of[3][lane]]);
        let mutating = || (0..).zip(parents).filter(|(_, parent)| *parent & UNCHANGED == 0).map(|(lane, _)| lane);
        // These loops are separate so that the processor draws for several policies at once.
        for (lane, &parent) in parents.iter().enumerate() {
            // Parents are in random places of memory. While one batch mutates, those of the next are loaded.
            if let Some(&parent) = later.get(first + lane) {
                prefetch(policy(parent));
            }
            copy(simd, policy(parent), &mut children[(first + lane) * parameters..][..parameters]);
            if parent & UNCHANGED != 0 {
                continue;
            }
            mutations.mark(simd, first + lane, key(&keys, lane), learning.mutation_probability);
        }
        let mut listed = [(0, 0); MAX_LANES];
        for lane in mutating() {
            listed[lane] = mutations.collect_indices(first + lane);
        }
        for lane in mutating() {
            mutations.fill_positions(simd, first + lane, listed[lane], key(&forks, lane));
        }
    }
    mutations.mutate(simd, learning, children);
}

/// Lanes of the widest vectors.
const MAX_LANES: usize = 16;

/// Copies a policy with vector loads and stores.
#[inline(always)]
fn copy<S: Simd>(simd: S, from: &[f32], to: &mut [f32]) {
    let whole = from.len() / S::f32s::LEN * S::f32s::LEN;
    for (from, to) in from.chunks_exact(S::f32s::LEN).zip(to.chunks_exact_mut(S::f32s::LEN)) {
        S::f32s::from_slice(simd, from).store_slice(to);
    }
    to[whole..].copy_from_slice(&from[whole..]);
}

/// The weights that mutate, of one policy or several, collected so that no lane is idle.
struct MutationList<'a> {
    /// Weights per policy.
    parameters: usize,
    /// One bit per weight, set if it mutates; see [`MutationList::words`].
    masks: &'a mut [u32],
    /// The number of weights listed.
    count: usize,
    /// Per listed weight: its index in its policy, its index among all weights, its bits, and the key of its noise.
    indices: &'a mut [u32],
    positions: &'a mut [u32],
    bits: &'a mut [u32],
    keys: [&'a mut [u32]; 4],
}

impl<'a> MutationList<'a> {
    /// Returns an empty list for a number of policies.
    #[inline(always)]
    fn new(scratch: &'a mut Vec<u32>, policies: usize, parameters: usize) -> MutationList<'a> {
        // Whole vectors are stored at unaligned positions.
        let room = policies * parameters.next_multiple_of(64) + MAX_LANES;
        if scratch.len() < 8 * room {
            scratch.resize(8 * room, 0);
        }
        let mut fields = scratch.chunks_exact_mut(room);
        let mut field = || fields.next().expect("there is room for eight");
        let (masks, indices, positions, bits) = (field(), field(), field(), field());
        let keys = [field(), field(), field(), field()];
        MutationList { parameters, masks, count: 0, indices, positions, bits, keys }
    }

    /// Returns the range of a policy's masks.
    #[inline(always)]
    fn words(&self, policy: usize) -> Range<usize> {
        let words = 2 * self.parameters.div_ceil(64);
        policy * words..(policy + 1) * words
    }

    /// Marks the weights of a policy that mutate. Each has a random word of its own; a draw makes four words.
    ///
    /// Weight `64·block + 16·word + place` uses the word of counter `16·block + place`, whatever the number of lanes.
    #[inline(always)]
    fn mark<S: Simd>(&mut self, simd: S, policy: usize, key: Key, probability: f64) {
        let threshold = mutation_threshold(probability);
        let words = self.words(policy);
        let lanes = S::u32s::from_fn(simd, |lane| lane as u32);
        for (block, masks) in self.masks[words].as_chunks_mut::<2>().0.iter_mut().enumerate() {
            let mut mutates = 0u64;
            for place in (0..16).step_by(S::f32s::LEN) {
                let counter = lanes + (16 * block + place) as u32;
                for (index, word) in (0..).zip(key.draw_lanes::<S>(counter)) {
                    mutates |= word.simd_lt(threshold.unwrap_or_default()).to_bitmask() << (16 * index + place);
                }
            }
            if threshold.is_none() {
                mutates = u64::MAX;
            }
            let left = self.parameters - 64 * block;
            if left < 64 {
                mutates &= (1 << left) - 1;
            }
            *masks = [mutates as u32, (mutates >> 32) as u32];
        }
    }

    /// Lists the marked weights of a policy, and returns the range of their entries.
    #[inline(always)]
    fn collect_indices(&mut self, policy: usize) -> (usize, usize) {
        let before = self.count;
        let mut count = before;
        for (word, &mask) in (0..).step_by(32).zip(&self.masks[self.words(policy)]) {
            for (index, byte) in (word..).step_by(8).zip(mask.to_le_bytes()) {
                let to = &mut self.indices[count..count + 8];
                for (to, &bit) in to.iter_mut().zip(&BITS[byte as usize]) {
                    *to = index + u32::from(bit);
                }
                count += byte.count_ones() as usize;
            }
        }
        self.count = count;
        (before, count)
    }

    /// Fills in the positions and noise keys of a policy's listed weights.
    ///
    /// This is separate from [`MutationList::collect_indices`], because a vector load right after narrow stores to the
    /// same bytes would stall.
    #[inline(always)]
    fn fill_positions<S: Simd>(&mut self, simd: S, policy: usize, (first, end): (usize, usize), noises: Key) {
        let first_weight = (policy * self.parameters) as u32;
        let listed = first..first + (end - first).next_multiple_of(S::f32s::LEN);
        let positions = self.positions[listed.clone()].chunks_exact_mut(S::f32s::LEN);
        for (index, position) in self.indices[listed.clone()].chunks_exact(S::f32s::LEN).zip(positions) {
            (S::u32s::from_slice(simd, index) + first_weight).store_slice(position);
        }
        for (to, word) in self.keys.iter_mut().zip(noises.0) {
            let word = S::u32s::simd_from(simd, word);
            to[listed.clone()].chunks_exact_mut(S::f32s::LEN).for_each(|to| word.store_slice(to));
        }
    }

    /// Adds its noise to each listed weight.
    #[inline(always)]
    fn mutate<S: Simd>(self, simd: S, learning: &Learning, weights: &mut [f32]) {
        let MutationList { count, indices, positions, bits, keys: [x, y, z, w], .. } = self;
        let sigma = learning.mutation_sigma as f32;
        for (bits, &position) in bits[..count].iter_mut().zip(&*positions) {
            *bits = weights[position as usize].to_bits();
        }
        let whole = count.next_multiple_of(S::f32s::LEN);
        let load = |from: &[u32]| S::u32s::from_slice(simd, from);
        let vectors = |from: &'a [u32]| from[..whole].chunks_exact(S::f32s::LEN);
        let [x, y] = [x, y].map(|words| &mut words[..whole]);
        let drawn = x.chunks_exact_mut(S::f32s::LEN).zip(y.chunks_exact_mut(S::f32s::LEN));
        // Several short loops: out-of-order execution overlaps iterations only if they are short.
        for ((((x, y), z), w), indices) in drawn.zip(vectors(z)).zip(vectors(w)).zip(vectors(indices)) {
            let [a, b, ..] = math::pcg4d::<S>(load(x), load(y), load(z), load(w) ^ load(indices));
            a.store_slice(x);
            b.store_slice(y);
        }
        for x in x.chunks_exact_mut(S::f32s::LEN) {
            let radius: S::u32s = math::normal_radius::<S>(load(x)).bitcast();
            radius.store_slice(x);
        }
        let drawn = x.chunks_exact(S::f32s::LEN).zip(y.chunks_exact(S::f32s::LEN));
        for (bits, (x, y)) in bits[..whole].chunks_exact_mut(S::f32s::LEN).zip(drawn) {
            let (weight, radius): (S::f32s, S::f32s) = (load(bits).bitcast(), load(x).bitcast());
            let noise = math::normal_of::<S>(radius, math::normal_cosine::<S>(load(y))) * sigma;
            let noise = if learning.mutation == Mutation::Scaled { noise * weight } else { noise };
            let mutated: S::u32s = within_limits(simd, weight + noise).bitcast();
            mutated.store_slice(bits);
        }
        for (&bits, &position) in bits[..count].iter().zip(&*positions) {
            weights[position as usize] = f32::from_bits(bits);
        }
    }
}

/// Returns the threshold below which a weight's random word makes it mutate, or `None` if every weight mutates.
pub(crate) fn mutation_threshold(probability: f64) -> Option<u32> {
    (probability < 1.0).then_some((probability * (1u64 << 32) as f64) as u32)
}

/// Per byte: the indices of its set bits, ascending, padded with zeros.
const BITS: [[u8; 8]; 256] = {
    let mut bits = [[0; 8]; 256];
    let mut byte = 0;
    while byte < 256 {
        let (mut bit, mut count) = (0, 0);
        while bit < 8 {
            if byte >> bit & 1 == 1 {
                bits[byte][count] = bit;
                count += 1;
            }
            bit += 1;
        }
        byte += 1;
    }
    bits
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::evolve::{Purpose, random_policy};
    use crate::kernels::splat;

    /// [`mutate`], one weight after the other.
    fn mutate_plainly<S: Simd>(simd: S, key: Key, learning: &Learning, weights: &mut [f32]) {
        let threshold = mutation_threshold(learning.mutation_probability);
        for (index, weight) in weights.iter_mut().enumerate() {
            let chance = key.draw((index / 64 * 16 + index % 16) as u32)[index / 16 % 4];
            if threshold.is_none_or(|threshold| chance < threshold) {
                let [a, b] = [0, 1].map(|word| S::u32s::splat(simd, key.fork().draw(index as u32)[word]));
                let noise = math::normal::<S>(a, b) * learning.mutation_sigma as f32;
                let old = splat(simd, *weight);
                let noise = if learning.mutation == Mutation::Scaled { noise * old } else { noise };
                *weight = within_limits(simd, old + noise)[0];
            }
        }
    }

    #[test]
    fn bred_policies_equal_plain_mutations_of_their_parents() {
        const SLOTS: usize = 37;
        let text = "[world]\nleaders = [[1, 1]]\npois = [[9, 9]]\ncoupling = 1\n";
        let mut learning = Config::parse(text, "test.toml").unwrap().learning;
        let key = Key::new(3, 1, Purpose::Mutation);
        let planned = |slot: usize| (slot * 5 % SLOTS) as u32 | if slot % 4 == 3 { UNCHANGED } else { 0 };
        let parents: Vec<u32> = (0..SLOTS).map(planned).collect();
        for parameters in [1, 63, 64, 65, 112, 1000] {
            let mut policies = vec![0.0; SLOTS * parameters];
            random_policy(Level::new(), Key::new(3, 1, Purpose::Weights), &mut policies);
            for (mutation, probability) in [
                (Mutation::Scaled, 0.15),
                (Mutation::Additive, 0.15),
                (Mutation::Scaled, 0.0),
                (Mutation::Additive, 1.0),
            ] {
                (learning.mutation, learning.mutation_probability) = (mutation, probability);
                let offspring =
                    Offspring { key, generation: 7, population: 2, first: 0, parents: &parents, policies: &policies };
                let mut children = vec![f32::NAN; policies.len()];
                breed(Level::new(), &learning, offspring, &mut children, &mut vec![7; 9]);
                for (slot, child) in children.chunks_exact(parameters).enumerate() {
                    let parent = (parents[slot] & !UNCHANGED) as usize;
                    let mut expected = policies[parent * parameters..][..parameters].to_vec();
                    if parents[slot] & UNCHANGED == 0 {
                        let key = key.at(7, 2, slot);
                        dispatch!(Level::new(), simd => mutate_plainly(simd, key, &learning, &mut expected));
                    }
                    let bits = |weights: &[f32]| weights.iter().map(|weight| weight.to_bits()).collect::<Vec<_>>();
                    assert_eq!(
                        bits(child),
                        bits(&expected),
                        "{mutation} {probability}, {parameters} weights, slot {slot}"
                    );
                }
            }
        }
    }
}
