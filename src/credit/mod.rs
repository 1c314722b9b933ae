//! Structural credit assignment: what each leader was worth to its team, from the record of one episode.
//!
//! Every fitness is a share of what the world's POIs are [worth](crate::world::WorldParts::worth), so it is added up in
//! whole numbers and divided once. Nothing is
//! simulated again. The record of who was at a POI at which step determines what would have been observed without a
//! leader, without its whole group, without those that it led at each step, or with more copies of it.
//!
//! Under the default [rule](crate::model::rule::Rule) no fitness but Dt depends on when or how often a set of agents
//! was at a POI. A set changes nothing if another set of the same POI contains it: the larger set still has at least
//! as many agents after any removal or copy. So only the maximal sets of each POI matter and, except for D++, only
//! those with at least as many agents as the POI needs.

mod assignment;
mod fast;
mod lanes;
mod paths;
mod record;
mod replay;

pub use assignment::{UNASSIGNED, assign};
pub use assignment::{find_leading, is_led_by};
pub(crate) use lanes::LaneCredit;
pub(crate) use paths::PathCredit;
pub use record::{Episode, Paths, RecordRequest, Strided};
pub use replay::observed_at;

use fearless_simd::{Level, dispatch};

use crate::config::Fitness;
use crate::world::World;

/// Every fitness of one team. Each difference is `[leaders]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// The summed [worth](crate::world::WorldParts::worth) of the observed POIs; their number with equal values. Without
    /// windows and orders: those with enough observers within their radius at some step.
    pub observed: u32,
    /// G: what the observed POIs are worth as a share of all, the same for every leader (paper, Equation 1).
    pub g: f32,
    /// D: G minus G without the leader (paper, Equation 5; "leader trajectory removal").
    pub d: Vec<f32>,
    /// Df: G minus G without the leader and its followers (paper, Section 4.2; "leader-follower trajectory
    /// assignment").
    pub df: Vec<f32>,
    /// D++: D, or the gain per added copy of this leader if that is larger (Rahmattalabi et al., the paper's reference
    /// 12).
    pub dpp: Vec<f32>,
    /// Dt: G minus G without the leader and, at each step, the followers that it [leads](find_leading) at that step.
    /// Empty if the [sightings](Episode::sights) were not recorded. Without followers it is D.
    pub dt: Vec<f32>,
}

/// Scratch memory for scoring episodes without allocating; one per thread.
#[derive(Clone, Debug, Default)]
pub struct Credit {
    /// Whether each POI was observed, `[pois]`.
    observed: Vec<bool>,
    /// The leaders without whom (D), or without whose groups (Df), an observed POI is lost, `[pois][words]`.
    critical: Vec<u32>,
    /// The summed worth of the POIs that are lost without the leader, `[leaders]`.
    lost: Vec<u32>,
    /// The leader that each agent belongs to, or [`UNASSIGNED`], `[agents]`.
    owner: Vec<u32>,
    /// The agents of each leader's group, `[leaders][words]`; empty until needed.
    groups: Vec<u32>,
    /// The largest set at the POI that has the leader in it, `[pois][leaders]`.
    largest_set_with: Vec<u32>,
    /// The summed worth of the unobserved POIs that this number of copies of one leader would complete, `[copies]`.
    completed: Vec<u32>,
    /// One set, and the set of the step before, `[2][words]`.
    sets: Vec<u32>,
    /// The step at which each POI was observed, and would be observed with other agents, `[pois]`. Used by
    /// [`Credit::replay`].
    observed_at: Vec<u32>,
    counterfactual: Vec<u32>,
    /// The output of [`find_leading`].
    led: Vec<u32>,
    paths: PathCredit,
}

impl Credit {
    /// Scores every leader of the team by `fitness` into `scores`, `[leaders]`, and returns what the POIs are worth that
    /// the team observed. The episode must be of `world`, with the [record](RecordRequest) that the fitness needs.
    pub fn score(&mut self, episode: &Episode<'_>, world: &World, fitness: Fitness, scores: &mut [f32]) -> u32 {
        if let (Some(rule), Some(paths)) = (&world.paths, &episode.paths) {
            return dispatch!(Level::new(), simd => self.paths.score(simd, paths, world, rule, fitness, scores));
        }
        if world.rule.is_timed() || fitness == Fitness::Dt {
            return self.replay(episode, world, fitness, scores);
        }
        fill_with_zeros(&mut self.observed, world.pois.len());
        let total = world.total_worth;
        match fitness {
            Fitness::G => {
                self.observe(episode, world);
                scores.fill(share(self.observed_worth(world), total.into()));
            }
            Fitness::D | Fitness::Df => {
                match fitness == Fitness::Df && world.followers() > 0 {
                    true => self.find_critical_groups(episode, world),
                    false => self.find_critical_leaders(episode, world),
                }
                self.count_lost(world);
                scores.iter_mut().zip(&self.lost).for_each(|(score, &lost)| *score = share(lost, total.into()));
            }
            Fitness::Dt => unreachable!("it was replayed"),
            Fitness::Dpp => {
                self.find_critical_leaders_and_largest_sets(episode, world);
                self.count_lost(world);
                for (leader, score) in scores.iter_mut().enumerate().take(world.leaders()) {
                    *score = self.dpp(world, leader);
                }
            }
        }
        self.observed_worth(world)
    }

    /// Returns every fitness of every leader. The episode must be of `world`, with the [record](RecordRequest) that D++
    /// and Df need.
    pub fn all(&mut self, episode: &Episode<'_>, world: &World) -> Scores {
        let leaders = world.leaders();
        let mut by = |fitness| {
            let mut scores = vec![0.0; leaders];
            let observed = self.score(episode, world, fitness, &mut scores);
            (observed, scores)
        };
        let ((observed, d), (_, df), (_, dpp)) = (by(Fitness::D), by(Fitness::Df), by(Fitness::Dpp));
        let dt = match world.followers() {
            _ if episode.paths.is_some() || !episode.sights.is_empty() => by(Fitness::Dt).1,
            0 => d.clone(),
            _ => vec![],
        };
        Scores { observed, g: share(observed, world.total_worth.into()), d, df, dpp, dt }
    }
}

/// Returns D++ of a leader whose removal loses POIs worth `lost`, of `total`. `gain(n)` is the worth of the POIs that n
/// copies add; `at_most` is `gain(most)`.
///
/// That is D if it is at least D++(most). Otherwise it is the first `D++(n) = gain(n) / n`, n = 1, 2, …, that D++(n +
/// 1) does not exceed.
#[inline(always)]
fn stepping_stone(lost: u32, most: u32, at_most: u32, total: u32, mut gain: impl FnMut(u32) -> u32) -> f32 {
    if u64::from(lost) * u64::from(most) >= u64::from(at_most) {
        return share(lost, total.into());
    }
    let mut now = gain(1);
    for copies in 1..most {
        let next = gain(copies + 1);
        if u64::from(next) * u64::from(copies) <= u64::from(now) * (u64::from(copies) + 1) {
            return share(now, u64::from(total) * u64::from(copies));
        }
        now = next;
    }
    share(now, u64::from(total) * u64::from(most))
}

/// Returns a ratio of two numbers, each exact in f32 up to 2^24.
pub(crate) fn share(count: u32, of: u64) -> f32 {
    count as f32 / of as f32
}

/// Returns the positions of a word's set bits, in ascending order.
fn each_bit(word: u32) -> impl Iterator<Item = usize> {
    std::iter::successors(Some(word), |word| Some(word & word.wrapping_sub(1)))
        .take_while(|&word| word != 0)
        .map(|word| word.trailing_zeros() as usize)
}

/// Makes an array have this length, and only zeros or `false`.
fn fill_with_zeros<T: Clone + Default>(array: &mut Vec<T>, length: usize) {
    array.clear();
    array.resize(length, T::default());
}
