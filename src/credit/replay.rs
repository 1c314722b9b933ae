//! The general path: replays the record under any rule, for every fitness including Dt.

use std::ops::RangeInclusive;

use super::assignment::{assign, find_leading, gather, is_led_by};
use super::{Credit, Episode, Strided, each_bit, share, stepping_stone};
use crate::config::Fitness;
use crate::model::rule::NEVER;
use crate::world::World;

/// The general path.
impl Credit {
    /// Computes [`Credit::score`] by each fitness's definition.
    pub(super) fn replay(&mut self, episode: &Episode<'_>, world: &World, fitness: Fitness, scores: &mut [f32]) -> u32 {
        let Credit { owner, groups, observed_at, counterfactual, led, .. } = self;
        let (total, words, leaders) = (world.total_worth, world.constants.words as usize, world.leaders());
        let replay = Replay { sets: episode.sets, world };
        replay.observe(observed_at);
        let observed = worth(world, observed_at);
        // Without followers, Df and Dt are D. If nothing was observed, nothing can be lost.
        let taken = if world.followers() == 0 || observed == 0 { Fitness::D } else { fitness };
        match taken {
            Fitness::Df => {
                assign(&episode.seen, world, owner);
                gather(owner, world, groups);
            }
            Fitness::Dt => find_leading(&episode.sights, world, led),
            Fitness::G | Fitness::D | Fitness::Dpp => {}
        }
        for (leader, score) in scores.iter_mut().enumerate().take(leaders) {
            let mut lost = || {
                let alone = |_, word, agents| agents & !alone(leader, word);
                match taken {
                    Fitness::Df => {
                        let group = &groups[leader * words..][..words];
                        replay.observe_without(observed_at, |_, word, agents| agents & !group[word], counterfactual);
                    }
                    Fitness::Dt => {
                        let stay = |step, word, agents| {
                            let follow = each_bit(alone(step, word, agents)).filter(|bit| {
                                let agent = word * 32 + bit;
                                agent < leaders || !is_led_by(led, world, step as usize - 1, agent - leaders, leader)
                            });
                            follow.map(|bit| 1 << bit).sum()
                        };
                        replay.observe_without(observed_at, stay, counterfactual);
                    }
                    Fitness::G | Fitness::D | Fitness::Dpp => {
                        replay.observe_without(observed_at, alone, counterfactual);
                    }
                }
                observed - worth(world, counterfactual)
            };
            *score = match fitness {
                Fitness::G => share(observed, total.into()),
                Fitness::D | Fitness::Df | Fitness::Dt => share(lost(), total.into()),
                Fitness::Dpp => {
                    let (lost, most) = (lost(), world.coupling.iter().copied().max().unwrap_or(0));
                    let mut gain = |copies| {
                        replay.observe_with(observed_at, leader, copies, counterfactual);
                        worth(world, counterfactual) - observed
                    };
                    stepping_stone(lost, most, gain(most), total, gain)
                }
            };
        }
        observed
    }
}

/// The sets of an episode, to be replayed under the world's rule.
#[derive(Clone, Copy)]
struct Replay<'a> {
    sets: Strided<'a>,
    world: &'a World,
}

impl Replay<'_> {
    /// Counts the observers at a POI after a step. `stay` masks each word of the set.
    fn count_observers(&self, poi: usize, step: u32, stay: impl Fn(usize, u32) -> u32) -> u32 {
        let Replay { sets, world } = self;
        let words = world.constants.words as usize;
        let first = ((step as usize - 1) * world.pois.len() + poi) * words;
        world.rule.count(poi, (0..words).map(|word| stay(word, sets.get(first + word))))
    }

    /// Writes the step at which each POI is observed: the first of the steps to test, `steps_to_test(poi, open)`, with
    /// enough observers, `observers(poi, step)`. The rule allows it at the `open` steps.
    fn apply_rule(
        &self,
        observed_at: &mut Vec<u32>,
        steps_to_test: impl Fn(usize, RangeInclusive<u32>) -> RangeInclusive<u32>,
        observers: impl Fn(usize, u32) -> u32,
    ) {
        let Replay { sets, world } = self;
        let pois = world.pois.len();
        observed_at.clear();
        observed_at.resize(pois, NEVER);
        let steps = sets.len() / (pois * world.constants.words as usize);
        world.rule.observe(steps as u32, observed_at, |poi, open| {
            steps_to_test(poi, open).find(|&step| observers(poi, step) >= world.coupling[poi])
        });
    }

    /// Replays the episode as it was.
    fn observe(&self, observed_at: &mut Vec<u32>) {
        self.apply_rule(observed_at, |_, open| open, |poi, step| self.count_observers(poi, step, |_, agents| agents));
    }

    /// Replays the episode without some agents, by step and word. No POI is observed sooner than it was.
    fn observe_without(&self, was: &[u32], stay: impl Fn(u32, usize, u32) -> u32, observed_at: &mut Vec<u32>) {
        let later = |poi: usize, open: RangeInclusive<u32>| was[poi].max(*open.start())..=*open.end();
        self.apply_rule(observed_at, later, |poi, step| {
            self.count_observers(poi, step, |word, agents| stay(step, word, agents))
        });
    }

    /// Replays the episode with more copies of an agent. No POI is observed later than it was.
    fn observe_with(&self, was: &[u32], agent: usize, copies: u32, observed_at: &mut Vec<u32>) {
        let sooner = |poi: usize, open: RangeInclusive<u32>| *open.start()..=was[poi].min(*open.end());
        self.apply_rule(observed_at, sooner, |poi, step| {
            let copied = self.count_observers(poi, step, |word, agents| agents & alone(agent, word));
            self.count_observers(poi, step, |_, agents| agents) + copies * copied
        });
    }
}

/// Returns what the observed POIs are worth.
fn worth(world: &World, observed_at: &[u32]) -> u32 {
    observed_at.iter().zip(&world.worth).filter(|(step, _)| **step != NEVER).map(|(_, worth)| worth).sum()
}

/// Returns the step, from 1, at which each POI is observed, if any, `[pois]`. `sets` has the agents at each POI,
/// `[steps][pois][words]`.
pub fn observed_at(sets: Strided<'_>, world: &World) -> Vec<Option<usize>> {
    let mut observed_at = Vec::new();
    Replay { sets, world }.observe(&mut observed_at);
    observed_at.into_iter().map(|step| (step != NEVER).then_some(step as usize)).collect()
}

/// Returns a word of the set with only this agent.
fn alone(agent: usize, word: usize) -> u32 {
    if agent / 32 == word { 1 << (agent % 32) } else { 0 }
}
