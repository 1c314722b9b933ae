//! Assignment of followers to leaders: over the episode (Df), or at each step (Dt).

use super::{Strided, each_bit, fill_with_zeros};
use crate::config::LedBy;
use crate::world::{Led, World};

/// The owner of an agent that belongs to no group.
pub const UNASSIGNED: u32 = u32::MAX;

/// Assigns each follower to the leader that it saw at most steps. Ties go to the lower index. Followers that saw no
/// leader get [`UNASSIGNED`].
///
/// Writes the owner of every agent, `[agents]`. A leader owns itself.
pub fn assign(seen: &Strided<'_>, world: &World, owner: &mut Vec<u32>) {
    let leaders = world.constants.leaders;
    owner.clear();
    owner.extend(0..leaders);
    owner.extend((0..world.followers()).map(|follower| {
        let steps = (0..leaders as usize).map(|leader| seen.get(follower * leaders as usize + leader));
        first_most(steps).map_or(UNASSIGNED, |leader| leader as u32)
    }));
}

/// Returns the index of the largest number, the first of equal ones. `None` if all are 0.
pub(super) fn first_most(numbers: impl Iterator<Item = u32>) -> Option<usize> {
    let larger = |(most, first), (index, number)| if number > most { (number, Some(index)) } else { (most, first) };
    numbers.enumerate().fold((0, None), larger).1
}

/// Writes the agents that belong to each leader, one bit per agent, `[leaders][words]`.
pub(super) fn gather(owner: &[u32], world: &World, groups: &mut Vec<u32>) {
    let words = world.constants.words as usize;
    fill_with_zeros(groups, world.leaders() * words);
    for (agent, &leader) in owner.iter().enumerate().filter(|&(_, &leader)| leader != UNASSIGNED) {
        groups[leader as usize * words + agent / 32] |= 1 << (agent % 32);
    }
}

/// Writes which leaders lead each follower at each step, one bit per leader, `[steps][followers][words of leaders]`.
/// `sights` has the leaders that each follower saw, in the same shape.
pub fn find_leading(sights: &Strided<'_>, world: &World, led: &mut Vec<u32>) {
    let (followers, leaders, words) = (world.followers(), world.leaders(), world.leader_words());
    fill_with_zeros(led, sights.len());
    let place = |step: usize, follower: usize, word: usize| (step * followers + follower) * words + word;
    let steps = sights.len() / (followers * words).max(1);
    lead(sights, led, [steps, followers, leaders], world.led, place);
}

/// Computes [`find_leading`] in any layout. The numbers are of steps, of followers or other agents that are led, and of
/// leaders. `place` returns where `sights` and `led` have a word of leaders, by step and follower.
pub(super) fn lead(
    sights: &Strided<'_>,
    led: &mut [u32],
    [steps, followers, leaders]: [usize; 3],
    Led { within, by }: Led,
    place: impl Fn(usize, usize, usize) -> usize,
) {
    let (words, place) = (leaders.div_ceil(32), &place);
    if within == 1 && words == 1 {
        return match sights.stride {
            // Without strides this is compiled to vector instructions.
            1 => choose(by, leaders, led.iter_mut().zip(sights.words.iter().copied())),
            _ => choose(by, leaders, led.iter_mut().zip(sights.iter())),
        };
    }
    let mut counts = vec![0u32; leaders];
    for follower in 0..followers {
        counts.fill(0);
        for step in 0..steps {
            let seen = |step: usize| {
                let of_word = move |word| (word, sights.get(place(step, follower, word)));
                (0..words).map(of_word).flat_map(|(word, seen)| each_bit(seen).map(move |bit| word * 32 + bit))
            };
            seen(step).for_each(|leader| counts[leader] += 1);
            if within > 0 && step >= within {
                seen(step - within).for_each(|leader| counts[leader] -= 1);
            }
            let mut lead = |leader: usize| led[place(step, follower, leader / 32)] |= 1 << (leader % 32);
            let mut counted = counts.iter().enumerate().filter(|(_, count)| **count > 0);
            match by {
                LedBy::AnySeen => counted.for_each(|(leader, _)| lead(leader)),
                LedBy::First => counted.next().into_iter().for_each(|(leader, _)| lead(leader)),
                LedBy::Alone => {
                    if let (Some((leader, _)), None) = (counted.next(), counted.next()) {
                        lead(leader);
                    }
                }
                LedBy::Anyone if counted.next().is_some() => (0..leaders).for_each(lead),
                LedBy::Anyone => {}
                LedBy::MostSeen => first_most(counts.iter().copied()).into_iter().for_each(lead),
            }
        }
    }
}

/// Writes who leads, of up to 32 leaders that were seen at the one step that counts.
fn choose<'a>(by: LedBy, leaders: usize, words: impl Iterator<Item = (&'a mut u32, u32)>) {
    match by {
        LedBy::AnySeen => words.for_each(|(led, seen)| *led = seen),
        LedBy::MostSeen | LedBy::First => words.for_each(|(led, seen)| *led = seen & seen.wrapping_neg()),
        // A word of at most one bit is 0 without its lowest bit.
        LedBy::Alone => words.for_each(|(led, seen)| *led = if seen & seen.wrapping_sub(1) == 0 { seen } else { 0 }),
        LedBy::Anyone => {
            let all = u32::MAX >> (32 - leaders);
            words.for_each(|(led, seen)| *led = if seen != 0 { all } else { 0 });
        }
    }
}

/// Reports whether a leader leads a follower at a step, from 0, according to the output of [`find_leading`].
pub fn is_led_by(led: &[u32], world: &World, step: usize, follower: usize, leader: usize) -> bool {
    let place = (step * world.followers() + follower) * world.leader_words() + leader / 32;
    led[place] >> (leader % 32) & 1 != 0
}
