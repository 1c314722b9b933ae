//! The fast path: every fitness but Dt, unless it matters when agents are at a POI, in one pass over the sets.

use super::assignment::{assign, gather};
use super::{Credit, Episode, Strided, each_bit, fill_with_zeros, stepping_stone};
use crate::world::World;

impl Credit {
    /// Finds which POIs were observed.
    pub(super) fn observe(&mut self, episode: &Episode<'_>, world: &World) {
        let Credit { observed, sets, .. } = self;
        each_set(&episode.sets, world, sets, |poi| world.coupling[poi], |poi, _, _| observed[poi] = true);
    }

    /// Finds the leaders without whom a POI is lost. Such a leader is in every set with enough agents, and no such set
    /// has an agent to spare.
    pub(super) fn find_critical_leaders(&mut self, episode: &Episode<'_>, world: &World) {
        self.mark_all_critical(world);
        let Credit { observed, critical, sets, .. } = self;
        let enough = |poi: usize| world.coupling[poi];
        each_set(&episode.sets, world, sets, enough, |poi, size, set| {
            observed[poi] = true;
            narrow(&mut critical[poi * set.len()..][..set.len()], set, size == world.coupling[poi]);
        });
    }

    /// Finds the leaders without whose group a POI is lost. Every set with enough agents has more members of the group
    /// than agents to spare.
    pub(super) fn find_critical_groups(&mut self, episode: &Episode<'_>, world: &World) {
        self.mark_all_critical(world);
        let Credit { observed, critical, owner, groups, sets, .. } = self;
        let words = world.constants.words as usize;
        groups.clear();
        let enough = |poi: usize| world.coupling[poi];
        each_set(&episode.sets, world, sets, enough, |poi, size, set| {
            observed[poi] = true;
            let spare = size - world.coupling[poi];
            for (index, critical) in critical[poi * words..][..words].iter_mut().enumerate() {
                let mut suspects = *critical;
                if suspects != 0 && groups.is_empty() {
                    assign(&episode.seen, world, owner);
                    gather(owner, world, groups);
                }
                while suspects != 0 {
                    let leader = index * 32 + suspects.trailing_zeros() as usize;
                    let group = &groups[leader * words..][..words];
                    let members: u32 = group.iter().zip(set).map(|(group, set)| (group & set).count_ones()).sum();
                    if members <= spare {
                        *critical &= !(1 << (leader % 32));
                    }
                    suspects &= suspects - 1;
                }
            }
        });
    }

    /// Finds what [`Credit::find_critical_leaders`] finds, and the size of the largest set with each leader at every POI that
    /// was not observed.
    pub(super) fn find_critical_leaders_and_largest_sets(&mut self, episode: &Episode<'_>, world: &World) {
        self.mark_all_critical(world);
        let leaders = world.leaders();
        fill_with_zeros(&mut self.largest_set_with, world.pois.len() * leaders);
        let Credit { observed, critical, largest_set_with, sets, .. } = self;
        each_set(
            &episode.sets,
            world,
            sets,
            |_| 1,
            |poi, size, set| {
                if size >= world.coupling[poi] {
                    observed[poi] = true;
                    narrow(&mut critical[poi * set.len()..][..set.len()], set, size == world.coupling[poi]);
                } else if !observed[poi] {
                    for leader in bits(set).take_while(|&agent| agent < leaders) {
                        let most = &mut largest_set_with[poi * leaders + leader];
                        *most = size.max(*most);
                    }
                }
            },
        );
    }

    /// Returns D++ of one leader.
    pub(super) fn dpp(&mut self, world: &World, leader: usize) -> f32 {
        let most = world.coupling.iter().copied().max().unwrap_or(0);
        fill_with_zeros(&mut self.completed, most as usize + 1);
        let mut at_most = 0u32;
        for (poi, &coupling) in world.coupling.iter().enumerate() {
            let largest_set_with = self.largest_set_with[poi * world.leaders() + leader];
            if !self.observed[poi] && largest_set_with > 0 {
                self.completed[(coupling - largest_set_with) as usize] += world.worth[poi];
                at_most += world.worth[poi];
            }
        }
        // Fewer copies than the largest coupling are ever needed.
        let mut gain = 0;
        stepping_stone(self.lost[leader], most, at_most, world.total_worth, |copies| {
            gain += self.completed[copies as usize];
            gain
        })
    }

    /// Marks every leader as critical, as before the first large enough set.
    fn mark_all_critical(&mut self, world: &World) {
        let (leaders, words) = (world.leaders(), world.constants.words as usize);
        // Bits past the last leader stay 0.
        let of_word =
            |word: usize| u32::MAX.checked_shl(leaders.saturating_sub(word * 32) as u32).map_or(u32::MAX, |v| !v);
        self.critical.clear();
        self.critical.extend((0..world.pois.len() * words).map(|index| of_word(index % words)));
    }

    /// Returns what the observed POIs are worth.
    pub(super) fn observed_worth(&self, world: &World) -> u32 {
        self.observed.iter().zip(&world.worth).filter(|(observed, _)| **observed).map(|(_, worth)| worth).sum()
    }

    /// Adds up what the observed POIs are worth that each leader is critical to.
    pub(super) fn count_lost(&mut self, world: &World) {
        let (leaders, words) = (world.leaders(), world.constants.words as usize);
        fill_with_zeros(&mut self.lost, leaders);
        let pois = self.critical.chunks_exact(words).zip(&world.worth).zip(&self.observed);
        for ((critical, worth), _) in pois.filter(|(_, observed)| **observed) {
            bits(critical).for_each(|leader| self.lost[leader] += worth);
        }
    }
}

/// Calls `visit(poi, size, set)` for every set of at least `enough(poi)` observers that differs from the POI's set of the
/// step before, because repetition changes no fitness. Goes POI by POI, in order of steps.
#[inline(always)]
fn each_set(
    sets: &Strided<'_>,
    world: &World,
    scratch: &mut Vec<u32>,
    enough: impl Fn(usize) -> u32,
    mut visit: impl FnMut(usize, u32, &[u32]),
) {
    let (pois, words) = (world.pois.len(), world.constants.words as usize);
    if sets.is_empty() {
        return;
    }
    fill_with_zeros(scratch, 2 * words);
    for poi in 0..pois {
        let enough = enough(poi);
        let steps = sets.words[poi * words * sets.stride + sets.offset..].chunks(pois * words * sets.stride);
        if words == 1 {
            let mut before = 0;
            for step in steps {
                let set = world.rule.counted(poi, 0, step[0]);
                if set != before && set.count_ones() >= enough {
                    visit(poi, set.count_ones(), &[set]);
                }
                before = set;
            }
            continue;
        }
        let (mut set, mut before) = scratch.split_at_mut(words);
        before.fill(0);
        for step in steps {
            for (index, (word, &now)) in set.iter_mut().zip(step.iter().step_by(sets.stride)).enumerate() {
                *word = world.rule.counted(poi, index, now);
            }
            let size = set.iter().map(|word| word.count_ones()).sum();
            if set != before && size >= enough {
                visit(poi, size, set);
            }
            std::mem::swap(&mut set, &mut before);
        }
    }
}

/// Intersects `critical` with `set` if all of that set was needed; otherwise clears it.
fn narrow(critical: &mut [u32], set: &[u32], needed: bool) {
    critical.iter_mut().zip(set).for_each(|(word, set)| *word &= if needed { *set } else { 0 });
}

/// Returns the agents of a set, in ascending order.
fn bits(set: &[u32]) -> impl Iterator<Item = usize> {
    set.iter().enumerate().flat_map(|(index, &word)| each_bit(word).map(move |bit| index * 32 + bit))
}
