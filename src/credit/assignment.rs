//! Assignment of followers to leaders: over the episode (Df), or at each step (Dt).

use super::{Seen, Strided, each_bit, owner_bits};
use crate::config::LedBy;
use crate::world::{Led, World};

/// The owner of an agent that belongs to no group.
pub const UNASSIGNED: u32 = u32::MAX;

/// Assigns each follower to the leader that it saw at most steps. Ties go to the lower index. Followers that saw no
/// leader get [`UNASSIGNED`].
///
/// Writes the owner of every agent, `[agents]`. A leader owns itself.
pub fn assign(seen: &Seen<'_>, world: &World, owner: &mut Vec<u32>) {
    let leaders = world.constants.leaders;
    owner.clear();
    owner.extend(0..leaders);
    let followers = 0..world.followers();
    match seen {
        Seen::Counts(seen) => owner.extend(followers.map(|follower| {
            let (mut most, mut best) = (0, UNASSIGNED);
            for leader in 0..leaders {
                let steps = seen.get(follower * leaders as usize + leader as usize);
                if steps > most {
                    (most, best) = (steps, leader);
                }
            }
            best
        })),
        Seen::Owners(owners) => {
            let bits = owner_bits(leaders);
            let (owners_per_word, nobody) = ((32 / bits) as usize, (1 << bits) - 1);
            owner.extend(followers.map(|follower| {
                let owner =
                    owners.get(follower / owners_per_word) >> (follower % owners_per_word * bits as usize) & nobody;
                if owner == nobody { UNASSIGNED } else { owner }
            }));
        }
    }
}

/// Writes the agents that belong to each leader, one bit per agent, `[leaders][words]`.
pub(super) fn gather(owner: &[u32], world: &World, groups: &mut Vec<u32>) {
    let words = world.constants.words as usize;
    groups.clear();
    groups.resize(world.leaders() * words, 0);
    for (agent, &leader) in owner.iter().enumerate().filter(|&(_, &leader)| leader != UNASSIGNED) {
        groups[leader as usize * words + agent / 32] |= 1 << (agent % 32);
    }
}

/// Writes which leaders lead each follower at each step, one bit per leader, `[steps][followers][words of leaders]`.
/// `sights` has the leaders that each follower saw, in the same shape.
///
/// Only the steps that [count](crate::world::Led) matter. The leader that the follower saw at most of them leads it,
/// ties to the lower index; or with [`LedBy::AnySeen`] every leader that it saw.
pub fn find_leading(sights: &Strided<'_>, world: &World, led: &mut Vec<u32>) {
    let (followers, words) = (world.followers(), world.leader_words());
    let (steps, Led { within, by }) = (sights.len() / (followers * words).max(1), world.led);
    led.clear();
    led.resize(sights.len(), 0);
    let mut counts = vec![0u32; world.leaders()];
    for follower in 0..followers {
        counts.fill(0);
        for step in 0..steps {
            let place = |step: usize| (step * followers + follower) * words;
            let seen = |step: usize| {
                (0..words)
                    .flat_map(move |word| each_bit(sights.get(place(step) + word)).map(move |bit| word * 32 + bit))
            };
            seen(step).for_each(|leader| counts[leader] += 1);
            if within > 0 && step >= within {
                seen(step - within).for_each(|leader| counts[leader] -= 1);
            }
            let leading = &mut led[place(step)..][..words];
            let mut lead = |leader: usize| leading[leader / 32] |= 1 << (leader % 32);
            let mut counted = counts.iter().enumerate().filter(|(_, count)| **count > 0);
            match by {
                LedBy::AnySeen => counted.for_each(|(leader, _)| lead(leader)),
                LedBy::MostSeen => {
                    let first = counted.next();
                    let most =
                        first.map(|first| counted.fold(first, |most, next| if next.1 > most.1 { next } else { most }));
                    most.into_iter().for_each(|(leader, _)| lead(leader));
                }
            }
        }
    }
}

/// Reports whether a leader leads a follower at a step, from 0, according to the output of [`find_leading`].
pub fn is_led_by(led: &[u32], world: &World, step: usize, follower: usize, leader: usize) -> bool {
    let place = (step * world.followers() + follower) * world.leader_words() + leader / 32;
    led[place] >> (leader % 32) & 1 != 0
}
