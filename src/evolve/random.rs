//! Counter-based random numbers: a [`Key`] names a place in the space of all randomness.

use fearless_simd::{Simd, prelude::*};

use crate::kernels::math;

/// The purpose of a random number. No two purposes share any number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    /// The weights of the initial policies.
    Weights = 1,
    /// The teams of a generation, see [`order_policies`](super::order_policies).
    Teams = 2,
    /// Start positions in training, see [`jitter_starts`](super::jitter_starts).
    Starts = 3,
    /// The parents and the champion of a generation, see [`draw_parents`](super::draw_parents).
    Tournament = 4,
    /// The weights that change, and by how much, see [`mutate`](super::mutate).
    Mutation = 5,
    /// The weights of random teams, a baseline without learning.
    Baseline = 6,
    /// Held-out start positions, for evaluation.
    HeldOut = 7,
    /// POI positions in training, see [`jitter_pois`](super::jitter_pois).
    Pois = 8,
    /// Held-out POI positions, for evaluation.
    HeldOutPois = 9,
    /// Random constant actions that evolution is compared with.
    ConstantActions = 10,
    /// Noise on the actions of leaders, see [`noise`].
    Exploration = 11,
    /// The samples of an evolution strategy, see [`Strategy::sample`](super::Strategy::sample).
    Search = 12,
    /// The past champions that policies play with, see [`past_champions`](super::past_champions).
    HallOfFame = 13,
    /// The weights of random networks that all leaders share, a baseline.
    SharedBaseline = 14,
    /// Teams of networks that a baseline climbs to.
    Climber = 15,
    /// Open-loop teams that a baseline climbs to.
    OpenLoop = 16,
    /// Start positions of the episodes that test a generation's best team.
    TestStarts = 17,
    /// POI positions of these episodes.
    TestPois = 18,
}

/// A key of the counter-based random number generator. [`Key::draw`] returns the words of a counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key(pub(super) [u32; 4]);

impl Key {
    /// Returns the key of a trial and a purpose.
    pub fn new(seed: u64, trial: usize, purpose: Purpose) -> Key {
        Key(math::pcg4d_scalar([seed as u32, (seed >> 32) as u32, trial as u32, purpose as u32]))
    }

    /// Returns the key of one slot of one population in one generation.
    pub fn at(self, generation: usize, population: usize, slot: usize) -> Key {
        let [x, y, z, w] = self.of_population(generation, population);
        Key(math::pcg4d_scalar([x, y, z ^ slot as u32, w]))
    }

    /// Returns the state of [`Key::at`] before the slot is xored into its third word.
    pub(crate) fn of_population(self, generation: usize, population: usize) -> [u32; 4] {
        let Key([x, y, z, w]) = self;
        [x ^ generation as u32, y ^ population as u32, z, w]
    }

    /// Returns four random words for a counter.
    pub fn draw(self, counter: u32) -> [u32; 4] {
        let Key([x, y, z, w]) = self;
        math::pcg4d_scalar([x, y, z, w ^ counter])
    }

    /// Returns an independent key, made from a counter that nothing else uses.
    pub fn fork(self) -> Key {
        Key(self.draw(u32::MAX))
    }

    /// [`Key::at`] with one slot per lane.
    #[inline(always)]
    pub(super) fn at_lanes<S: Simd>(self, generation: usize, population: usize, slot: S::u32s) -> [S::u32s; 4] {
        let simd = slot.token();
        let Key([x, y, z, w]) = self;
        let word = |word| S::u32s::simd_from(simd, word);
        math::pcg4d::<S>(word(x ^ generation as u32), word(y ^ population as u32), slot ^ z, word(w))
    }

    /// [`Key::draw`] with one counter per lane.
    #[inline(always)]
    pub(super) fn draw_lanes<S: Simd>(self, counter: S::u32s) -> [S::u32s; 4] {
        let simd = counter.token();
        let Key([x, y, z, w]) = self;
        let word = |word| S::u32s::simd_from(simd, word);
        math::pcg4d::<S>(word(x), word(y), word(z), counter ^ w)
    }
}

/// Returns the noise on one leader's turn and speed at one step: two standard normal deviates, one team per lane. `key`
/// is of [`Purpose::Exploration`].
#[inline(always)]
pub(crate) fn noise<S: Simd>(key: Key, step: usize, leader: usize, team: S::u32s) -> [S::f32s; 2] {
    let [a, b, c, d] = key.at_lanes::<S>(step, leader, team);
    let [a, b, c, d] = math::pcg4d::<S>(a, b, c, d);
    [math::normal::<S>(a, b), math::normal::<S>(c, d)]
}

/// Maps a random word to an index in `0..below`.
pub(super) fn index_below(word: u32, below: usize) -> usize {
    ((word as u64 * below as u64) >> 32) as usize
}
