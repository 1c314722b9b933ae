//! Counter-based random numbers: a [`Key`] names a place in the space of all randomness.

use fearless_simd::{Simd, prelude::*};

use crate::kernels::math;

/// What a random number is for; no two purposes share any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    /// The weights that a run starts from.
    Weights = 1,
    /// Which policies play together, [`form_teams`].
    Teams = 2,
    /// Agents' starts in training, [`jitter_starts`].
    Starts = 3,
    /// Which policies become parents, [`draw_parents`].
    Tournament = 4,
    /// Which weights change, and by how much, [`mutate`].
    Mutation = 5,
    /// Weights of random teams that evolution is held against.
    Baseline = 6,
    /// Starts that teams are evaluated from, not trained.
    HeldOut = 7,
    /// POIs' places in training, [`jitter_pois`].
    Pois = 8,
    /// Places of POIs that teams are evaluated at, not trained.
    HeldOutPois = 9,
}

/// A place in the space of all randomness; [`Key::draw`] gives its numbers, by a counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key(pub(super) [u32; 4]);

impl Key {
    /// The place of a trial of a seed, for a purpose.
    pub fn new(seed: u64, trial: usize, purpose: Purpose) -> Key {
        Key(math::draw_scalar([seed as u32, (seed >> 32) as u32, trial as u32, purpose as u32]))
    }

    /// The key of one slot of one population of a generation.
    pub fn at(self, generation: usize, population: usize, slot: usize) -> Key {
        let [x, y, z, w] = self.of_population(generation, population);
        Key(math::draw_scalar([x, y, z ^ slot as u32, w]))
    }

    /// The counters of [`Key::at`], to which a slot is yet to be xored in the third place.
    pub fn of_population(self, generation: usize, population: usize) -> [u32; 4] {
        let Key([x, y, z, w]) = self;
        [x ^ generation as u32, y ^ population as u32, z, w]
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

    /// [`Key::at`] for a slot a lane.
    #[inline(always)]
    pub(super) fn at_lanes<S: Simd>(self, generation: usize, population: usize, slot: S::u32s) -> [S::u32s; 4] {
        let simd = slot.token();
        let Key([x, y, z, w]) = self;
        let word = |word| S::u32s::simd_from(simd, word);
        math::draw::<S>(word(x ^ generation as u32), word(y ^ population as u32), slot ^ z, word(w))
    }

    /// [`Key::draw`] for a counter a lane.
    #[inline(always)]
    pub(super) fn draw_lanes<S: Simd>(self, counter: S::u32s) -> [S::u32s; 4] {
        let simd = counter.token();
        let Key([x, y, z, w]) = self;
        let word = |word| S::u32s::simd_from(simd, word);
        math::draw::<S>(word(x), word(y), word(z), counter ^ w)
    }
}

/// A number in `0..below` from a random word.
pub(super) fn pick(word: u32, below: usize) -> usize {
    ((word as u64 * below as u64) >> 32) as usize
}
