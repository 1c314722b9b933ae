//! Selection: elites, binary tournaments, and the plan of the next generation.

use std::hint::select_unpredictable;

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use super::random::{Key, index_below};
use crate::config::{Learning, Parents};
use crate::kernels::math;
use crate::parallel::*;

/// Returns the indices of the `count` best scores, best first. Ties go to the lower index.
pub fn top_indices(scores: &[f32], count: usize) -> Vec<usize> {
    if count <= MAX_SEARCHED {
        // The best so far, in order. Few scores are inserted, so that this is faster than sorting.
        let mut order: Vec<usize> = Vec::with_capacity(count + 1);
        for (index, score) in scores.iter().enumerate() {
            if order.len() < count || order.last().is_some_and(|&last| score.total_cmp(&scores[last]).is_gt()) {
                order.insert(order.partition_point(|&other| scores[other].total_cmp(score).is_ge()), index);
                order.truncate(count);
            }
        }
        return order;
    }
    // Sorting keys of score and index is faster than sorting indices by their scores.
    let key = |(index, score): (u64, &f32)| {
        let bits = score.to_bits();
        let ascending = bits ^ if bits >> 31 == 0 { 1 << 31 } else { u32::MAX };
        u64::from(!ascending) << 32 | index
    };
    let mut order: Vec<u64> = (0..).zip(scores).map(key).collect();
    if count < order.len() {
        order.select_nth_unstable(count - 1);
        order.truncate(count);
    }
    order.sort_unstable();
    order.into_iter().map(|key| key as u32 as usize).collect()
}

/// Up to this count, [`top_indices`] searches without sorting.
const MAX_SEARCHED: usize = 16;

/// Returns the winner of one slot's binary tournament: of two distinct random policies, the one with the higher score
/// (`scores` is `[policies]`). Ties go to the policy that was drawn first.
pub fn tournament(key: Key, scores: &[f32]) -> usize {
    let [first, second, ..] = key.draw(0);
    winner(first, second, scores)
}

/// Returns the winner between the two policies that two random words select.
#[inline(always)]
fn winner(first: u32, second: u32, scores: &[f32]) -> usize {
    let a = index_below(first, scores.len());
    let b = index_below(second, scores.len() - 1);
    let b = if b >= a { b + 1 } else { b };
    // A branch would often be predicted wrongly, because the winner is random.
    select_unpredictable(scores[b] > scores[a], b, a)
}

/// Flag of a plan's entry, see [`draw_parents`]: the slot keeps its parent's weights.
pub const UNCHANGED: u32 = 1 << 31;

/// The rule by which policies survive and become parents.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Selection {
    /// The number of policies that survive unchanged.
    pub elites: usize,
    /// The number of teams with the largest G that survive as teams.
    pub team_elites: usize,
    /// The number of further policies that survive because of their team's G.
    pub team_g_elites: usize,
    /// The policies that may become parents.
    pub parents: Parents,
}

impl Selection {
    /// Returns the selection that a config asks for.
    pub fn of(learning: &Learning) -> Selection {
        let Learning { population, elites, team_elites, team_g_elites, parents, .. } = *learning;
        Selection { elites: elites.count(population), team_elites, team_g_elites, parents }
    }

    /// Returns the elites, best first, or without any the champion.
    fn best(self, key: Key, generation: usize, population: usize, scores: &[f32]) -> Vec<usize> {
        match self.elites {
            0 | 1 => vec![champion(key.at(generation, population, scores.len()), scores)],
            elites => top_indices(scores, elites),
        }
    }
}

/// Returns the best policy. If several tie, it is policy 0, the elite of the generation before, if that is among them, or
/// else a random one of them.
///
/// Teams are rotations, see [`order_policies`](super::order_policies). With ties to the lowest index, the champions of
/// all populations would therefore come from one team too often.
fn champion(key: Key, scores: &[f32]) -> usize {
    let best = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if scores.first() == Some(&best) {
        return 0;
    }
    let [word, ..] = key.draw(0);
    let tied = index_below(word, scores.iter().filter(|&&score| score == best).count());
    (0..).zip(scores).filter(|&(_, &score)| score == best).nth(tied).map_or(0, |(policy, _)| policy)
}

/// Returns the policies of a population that has played, best first: the elites, then the others by score, ties to the
/// lower index. `key` is of [`Purpose::Tournament`](super::Purpose::Tournament), `scores` are `[policies]`.
pub fn ranking(key: Key, generation: usize, population: usize, selection: Selection, scores: &[f32]) -> Vec<usize> {
    let mut ranking = selection.best(key, generation, population, scores);
    let champion = ranking[0];
    ranking.truncate(1);
    ranking.extend(top_indices(scores, scores.len()).into_iter().filter(|&policy| policy != champion));
    ranking
}

/// Plans one population's next generation: the policy that each slot is copied from, `[slots]`, with [`UNCHANGED`] if
/// it does not mutate.
///
/// The first slots are the elites', best first. The others' parents win [`tournament`]s, or with [`Parents::Elites`]
/// are elites, each with the same probability. The slot after the policies gets the best of all, the champion. Any
/// slots after it are the hall of fame, in which the champion replaces the oldest. `key` is of
/// [`Purpose::Tournament`](super::Purpose::Tournament), `scores` are `[policies]`.
pub fn draw_parents(
    level: Level,
    key: Key,
    generation: usize,
    population: usize,
    selection: Selection,
    scores: &[f32],
    parents: &mut [u32],
) {
    let policies = scores.len();
    let best = selection.best(key, generation, population, scores);
    let choose = |first, second| match selection.parents {
        Parents::All => winner(first, second, scores),
        Parents::Elites => best[index_below(first, best.len())],
    };
    parents[..policies].par_chunks_mut(DRAWN_TOGETHER).enumerate().for_each(|(chunk, parents)| {
        let first = chunk * DRAWN_TOGETHER;
        dispatch!(level, simd => draw_parents_lanes(simd, key, generation, population, first, choose, parents));
    });
    for (parent, elite) in parents.iter_mut().zip(&best[..selection.elites]) {
        *parent = *elite as u32 | UNCHANGED;
    }
    let champion = best[0] as u32 | UNCHANGED;
    parents[policies] = champion;
    let first = policies + 1;
    (first..).zip(&mut parents[first..]).for_each(|(slot, parent)| *parent = slot as u32 | UNCHANGED);
    if let Some(oldest) = generation.checked_rem(parents.len() - first) {
        parents[first + oldest] = champion;
    }
}

/// Keeps the policies of the best teams in a plan of [`draw_parents`], in the slots after the elites': first those of the
/// teams that survive, then further ones by their team's G. `ranks` are minus the rank of each policy's team by G,
/// `[policies]`.
pub fn keep_teams(selection: Selection, ranks: &[f32], parents: &mut [u32]) {
    let Selection { elites, team_elites, team_g_elites, .. } = selection;
    let best = top_indices(ranks, elites + team_elites + team_g_elites);
    let best = best.into_iter().map(|policy| policy as u32 | UNCHANGED);
    let (elites, others) = parents.split_at_mut(elites);
    let further = best.clone().skip(team_elites).filter(|policy| !elites.contains(policy));
    let kept = best.take(team_elites).chain(further.take(team_g_elites));
    others.iter_mut().zip(kept).for_each(|(parent, policy)| *parent = policy);
}

/// Plans the end of the last generation: every policy stays, and the champion gets its slot. Arguments are those of
/// [`draw_parents`].
pub fn keep_parents(
    key: Key,
    generation: usize,
    population: usize,
    selection: Selection,
    scores: &[f32],
    parents: &mut [u32],
) {
    for (slot, parent) in parents.iter_mut().enumerate() {
        *parent = slot as u32 | UNCHANGED;
    }
    parents[scores.len()] = selection.best(key, generation, population, scores)[0] as u32 | UNCHANGED;
}

/// Slots per rayon task.
const DRAWN_TOGETHER: usize = 4096;

#[inline(always)]
fn draw_parents_lanes<S: Simd>(
    simd: S,
    key: Key,
    generation: usize,
    population: usize,
    first: usize,
    choose: impl Fn(u32, u32) -> usize,
    parents: &mut [u32],
) {
    for (slot, parents) in (first..).step_by(S::f32s::LEN).zip(parents.chunks_mut(S::f32s::LEN)) {
        let slots = S::u32s::from_fn(simd, |lane| (slot + lane) as u32);
        let [x, y, z, w] = key.at_lanes::<S>(generation, population, slots);
        let [firsts, seconds, ..] = math::pcg4d::<S>(x, y, z, w);
        for ((parent, &first), &second) in parents.iter_mut().zip(firsts.as_slice()).zip(seconds.as_slice()) {
            *parent = choose(first, second) as u32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_are_those_of_a_stable_sort() {
        let special = [0.0, -0.0, f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MIN_POSITIVE, -1.5, 1.5];
        let scores: Vec<f32> = (0..90).map(|index| special[index * index % 23 % special.len()]).collect();
        let mut expected: Vec<usize> = (0..scores.len()).collect();
        expected.sort_by(|a, b| scores[*b].total_cmp(&scores[*a]));
        for count in 0..=scores.len() {
            assert_eq!(top_indices(&scores, count), expected[..count], "{count} of {}", scores.len());
        }
    }
}
