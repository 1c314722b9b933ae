//! G, D and Df of a whole vector of teams at once, unless it matters when agents are at a POI.
//! [`Credit::score`](super::Credit::score) is the plain twin.

use std::slice::Chunks;

use fearless_simd::{Simd, prelude::*};

use super::share;
use crate::config::Fitness;
use crate::kernels::count_ones;
use crate::model::rule::Rule;
use crate::world::World;

/// Scores of one vector of teams, with scratch memory for the next.
///
/// Only the maximal sets of a POI matter, see [`crate::credit`]. Its sets mostly grow as agents come near, then shrink.
/// So one pass is enough, which skips the sets that the kept set before or the next set contains.
pub(crate) struct LaneCredit<S: Simd> {
    simd: S,
    /// The summed worth of the observed POIs.
    observed: S::u32s,
    /// The summed worth of the POIs that are lost without each leader, or without its group, `[leaders]`.
    lost: Vec<S::u32s>,
    /// The leaders without whom, or without whose groups, the POI is lost, `[words]`.
    critical: Vec<S::u32s>,
    /// The agents of each leader's group, `[leaders][words]`.
    groups: Vec<S::u32s>,
    /// The summed worth of all POIs, and each sum up to it as a share, `[total + 1]`; empty if that is large.
    total: u32,
    shares: Vec<f32>,
}

/// Maximum number of shares that are computed in advance.
const MOST_SHARES: u32 = 1024;

/// The agents that are taken out for a score: nobody (G), a leader (D), or a leader with its followers (Df).
const NOBODY: u32 = 0;
const LEADER: u32 = 1;
const GROUP: u32 = 2;

impl<S: Simd> LaneCredit<S> {
    pub(crate) fn new(simd: S, world: &World) -> LaneCredit<S> {
        let (zero, words, total) = (S::u32s::splat(simd, 0), world.constants.words as usize, world.total_worth);
        LaneCredit {
            simd,
            observed: zero,
            lost: vec![zero; world.leaders()],
            critical: vec![zero; words],
            groups: vec![zero; world.leaders() * words],
            total,
            shares: if total > MOST_SHARES {
                vec![]
            } else {
                (0..=total).map(|worth| share(worth, total.into())).collect()
            },
        }
    }

    /// Reports whether a world's teams can be scored by a fitness.
    pub(crate) fn can_score(world: &World, fitness: Fitness) -> bool {
        world.paths.is_none() && !world.rule.is_timed() && matches!(fitness, Fitness::G | Fitness::D | Fitness::Df)
    }

    /// Scores episodes. `sets` has the agents at each POI after each step, `[steps][pois][words][lanes]`, and `seen` the
    /// number of steps at which each follower saw each leader, `[followers][leaders]`.
    #[inline(always)]
    pub(crate) fn score(&mut self, sets: &[u32], seen: &[S::u32s], world: &World, fitness: Fitness) {
        if fitness == Fitness::Df && world.followers() > 0 {
            self.find_groups(seen, world);
        }
        let zero = S::u32s::splat(self.simd, 0);
        match world.constants.words {
            // Teams of at most 32 agents. The compiler keeps their candidate in a register.
            1 => self.score_pois(sets, world, fitness, &mut [zero]),
            words => self.score_pois(sets, world, fitness, &mut vec![zero; words as usize]),
        }
    }

    /// [`LaneCredit::score`], with room for the set of one POI that counts unless the next one contains it, `[words]`.
    #[inline(always)]
    fn score_pois(&mut self, sets: &[u32], world: &World, fitness: Fitness, candidate: &mut [S::u32s]) {
        let zero = S::u32s::splat(self.simd, 0);
        let by_group = world.followers() > 0;
        self.observed = zero;
        self.lost.fill(zero);
        let words = candidate.len() * S::f32s::LEN;
        for (poi, &coupling) in world.coupling.iter().enumerate() {
            let sets = sets[poi * words..].chunks(world.pois.len() * words);
            self.critical.fill(!zero);
            let observed = match fitness {
                Fitness::Df if by_group => self.score_poi::<GROUP>(sets, (world, poi), coupling, candidate),
                Fitness::G => self.score_poi::<NOBODY>(sets, (world, poi), coupling, candidate),
                _ => self.score_poi::<LEADER>(sets, (world, poi), coupling, candidate),
            };
            let worth = S::u32s::splat(self.simd, world.worth[poi]);
            self.observed += observed & worth;
            for (leader, lost) in self.lost.iter_mut().enumerate() {
                let is_critical = zero - ((self.critical[leader / 32] >> (leader % 32) as u32) & 1);
                *lost += is_critical & observed & worth;
            }
        }
        if fitness == Fitness::G {
            self.lost.fill(self.observed);
        }
    }

    /// Returns what the POIs are worth that one lane's team observed.
    pub(crate) fn observed(&self, lane: usize) -> u32 {
        self.observed[lane]
    }

    /// Returns the scores of one lane's leaders.
    pub(crate) fn scores(&self, lane: usize) -> impl Iterator<Item = f32> {
        let of = move |lost: &S::u32s| {
            let lost = lost[lane];
            self.shares.get(lost as usize).copied().unwrap_or_else(|| share(lost, self.total.into()))
        };
        self.lost.iter().map(of)
    }

    /// Puts each follower into the group of the leader that it saw at most steps, ties to the lower index.
    #[inline(always)]
    fn find_groups(&mut self, seen: &[S::u32s], world: &World) {
        let (simd, leaders, words) = (self.simd, world.leaders(), world.constants.words as usize);
        let zero = S::u32s::splat(simd, 0);
        self.groups.fill(zero);
        for leader in 0..leaders {
            self.groups[leader * words + leader / 32] = S::u32s::splat(simd, 1 << (leader % 32));
        }
        for (agent, seen) in (leaders..).zip(seen.chunks_exact(leaders)) {
            let mut most = zero;
            for &steps in seen {
                most = most.max(steps);
            }
            let (bit, mut free) = (S::u32s::splat(simd, 1 << (agent % 32)), !zero);
            // Nobody who saw no leader belongs to a group.
            free &= mask::<S>(!most.simd_eq(zero));
            for (leader, &steps) in seen.iter().enumerate() {
                let owner = mask::<S>(steps.simd_eq(most)) & free;
                self.groups[leader * words + agent / 32] |= owner & bit;
                free &= !owner;
            }
        }
    }

    /// Finds the critical leaders of one POI, and returns the lanes that observed it, all bits of each.
    #[inline(always)]
    fn score_poi<const TAKEN: u32>(
        &mut self,
        sets: Chunks<'_, u32>,
        place: (&World, usize),
        coupling: u32,
        candidate: &mut [S::u32s],
    ) -> S::u32s {
        let zero = S::u32s::splat(self.simd, 0);
        let mut observed = zero;
        candidate.fill(zero);
        for step in sets {
            let now = step[..candidate.len() * S::f32s::LEN].chunks_exact(S::f32s::LEN);
            let (mut more, mut less) = (zero, zero);
            for (now, &candidate) in now.clone().zip(&*candidate) {
                let now = S::u32s::from_slice(self.simd, now);
                more |= now & !candidate;
                less |= candidate & !now;
            }
            let replaced = !more.simd_eq(zero);
            if !replaced.any_true() {
                continue;
            }
            let maximal = replaced & !less.simd_eq(zero);
            if maximal.any_true() {
                observed |= self.count::<TAKEN>(place, coupling, mask::<S>(maximal), candidate);
            }
            for (now, candidate) in now.zip(&mut *candidate) {
                *candidate = replaced.select(S::u32s::from_slice(self.simd, now), *candidate);
            }
        }
        observed | self.count::<TAKEN>(place, coupling, !zero, candidate)
    }

    /// Keeps the leaders as critical without whom, or without whose group, the set of some lanes has too few agents.
    /// Returns the lanes in which the set has enough.
    #[inline(always)]
    fn count<const TAKEN: u32>(
        &mut self,
        (world, poi): (&World, usize),
        coupling: u32,
        lanes: S::u32s,
        set: &[S::u32s],
    ) -> S::u32s {
        let zero = S::u32s::splat(self.simd, 0);
        // A set that contains another also contains its observers, so only here others are left out.
        let (simd, rule) = (self.simd, &world.rule);
        let mut size = zero;
        for (word, &set) in set.iter().enumerate() {
            size += count_ones::<S>(set & observers::<S>(simd, rule, poi, word));
        }
        let enough = mask::<S>(size.simd_ge(S::u32s::splat(self.simd, coupling))) & lanes;
        let spare = size - S::u32s::splat(self.simd, coupling);
        if TAKEN == LEADER {
            // A set with agents to spare needs nobody.
            let needed = mask::<S>(spare.simd_eq(zero));
            for (word, (critical, &set)) in self.critical.iter_mut().zip(set).enumerate() {
                *critical &= (set & observers::<S>(simd, rule, poi, word) & needed) | !enough;
            }
        }
        if TAKEN == GROUP && !enough.simd_eq(zero).all_true() {
            for (leader, group) in self.groups.chunks_exact(set.len()).enumerate() {
                let bit = S::u32s::splat(self.simd, 1 << (leader % 32));
                let critical = &mut self.critical[leader / 32];
                if (*critical & bit & enough).simd_eq(zero).all_true() {
                    continue;
                }
                let mut members = zero;
                for (word, (&group, &set)) in group.iter().zip(set).enumerate() {
                    members += count_ones::<S>(group & set & observers::<S>(simd, rule, poi, word));
                }
                *critical &= !(bit & enough & mask::<S>(members.simd_le(spare)));
            }
        }
        enough
    }
}

/// Returns a word of the set of a POI's observers, in all lanes.
#[inline(always)]
fn observers<S: Simd>(simd: S, rule: &Rule, poi: usize, word: usize) -> S::u32s {
    S::u32s::splat(simd, rule.counted(poi, word, u32::MAX))
}

/// Returns all bits of the lanes of a mask.
#[inline(always)]
fn mask<S: Simd>(lanes: S::mask32s) -> S::u32s {
    lanes.to_vector().bitcast()
}

#[cfg(test)]
mod tests {
    use fearless_simd::dispatch;
    use rand::rngs::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::backend::cpu::Cpu;
    use crate::credit::{Credit, Episode, Strided};
    use crate::sample;

    /// Compares the scores of random records with the plain twin. Counts those in which single agents matter.
    #[inline(always)]
    fn compare<S: Simd>(simd: S, rng: &mut ChaCha8Rng) -> [u32; 3] {
        let (lanes, mut found) = (S::f32s::LEN, [0; 3]);
        for seed in 0..300 {
            let world = World::new(&sample::any_world(seed).validate().unwrap());
            if world.rule.is_timed() {
                continue;
            }
            let (agents, words) = (world.agents(), world.constants.words as usize);
            let mut sets = vec![0; world.set_words() * lanes];
            for (index, set) in sets.chunks_exact_mut(words * lanes).enumerate() {
                // Mostly nobody is there, otherwise about as many as are needed. Then single agents matter.
                let coupling = world.coupling[index % world.pois.len()];
                let there = f64::from(coupling) / agents as f64 * 0.8;
                let share = if rng.random_bool(0.1) { there.min(0.9) } else { 0.0 };
                for (lane, agent) in (0..lanes).flat_map(|lane| (0..agents).map(move |agent| (lane, agent))) {
                    set[agent / 32 * lanes + lane] |= u32::from(rng.random_bool(share)) << (agent % 32);
                }
            }
            let seen: Vec<S::u32s> = (0..world.followers() * world.leaders())
                .map(|_| S::u32s::from_fn(simd, |_| rng.random_range(0..4)))
                .collect();
            let words: Vec<u32> = seen.iter().flat_map(|steps| steps.as_slice().to_vec()).collect();
            let (mut vector, mut plain) = (LaneCredit::new(simd, &world), Credit::default());
            let mut scores = vec![0.0; world.leaders()];
            for (found, fitness) in found.iter_mut().zip([Fitness::G, Fitness::D, Fitness::Df]) {
                vector.score(&sets, &seen, &world, fitness);
                for lane in 0..lanes {
                    let strided = |words| Strided { words, stride: lanes, offset: lane };
                    let seen = strided(&words);
                    let episode = Episode { sets: strided(&sets), seen, sights: Strided::NONE, paths: None };
                    let observed = plain.score(&episode, &world, fitness, &mut scores);
                    assert_eq!(vector.observed(lane), observed, "world {seed}, lane {lane}");
                    assert!(vector.scores(lane).eq(scores.iter().copied()), "world {seed}, lane {lane}, {fitness:?}");
                    *found += u32::from(scores.iter().any(|&score| score > 0.0 && score < 1.0));
                }
            }
        }
        found
    }

    #[test]
    fn vectors_of_teams_get_the_scores_of_single_teams() {
        for level in Cpu::levels() {
            let found = dispatch!(level, simd => compare(simd, &mut ChaCha8Rng::seed_from_u64(1)));
            assert!(found.iter().all(|&teams| teams > 20), "{found:?}");
        }
    }
}
