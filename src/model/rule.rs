//! Who observes a POI, when and in what order.

use std::ops::{Range, RangeInclusive};

use crate::config_enum::config_enum;
use crate::reader::{KeyRequest, OneOrEach, between};

/// Agents needed at a POI at the same step: one number for all POIs, or one per POI.
pub type Coupling = OneOrEach<usize>;

config_enum! {
    /// Whose presence at a POI counts.
    Observers {
        /// Every agent's.
        All = "all",
        /// Leaders' alone.
        Leaders = "leaders",
        /// Followers' alone.
        Followers = "followers",
    }
}

impl Observers {
    /// Returns the agents that are observers.
    pub fn among(self, leaders: usize, followers: usize) -> Range<usize> {
        match self {
            Observers::All => 0..leaders + followers,
            Observers::Leaders => 0..leaders,
            Observers::Followers => leaders..leaders + followers,
        }
    }

    /// Returns how errors name the number of observers.
    pub(crate) fn counted(self) -> &'static str {
        match self {
            Observers::All => "the number of agents",
            Observers::Leaders => "the number of leaders, because only they observe",
            Observers::Followers => "the number of followers, because only they observe",
        }
    }
}

/// Reads the steps at which each POI can be observed, as many as the key `of` has items, see [`KeyRequest::lists`].
pub(crate) fn windows(asked: KeyRequest<'_, '_>, of: (&str, Option<usize>), steps: usize) -> Vec<[usize; 2]> {
    let reversed = |windows: &[Vec<usize>]| {
        let wrong = windows.iter().enumerate().filter(|(_, window)| window[0] > window[1]);
        let problems = wrong.map(|(poi, window)| {
            let message = format!("found the steps from {} to {}, allowed the earlier one first", window[0], window[1]);
            (poi, message)
        });
        problems.collect()
    };
    let windows = asked.lists(WINDOWS, of, 2..=2, between(1, steps).because("world.steps"), reversed);
    windows.into_iter().map(|window| [window[0], window[1]]).collect()
}

/// The form of windows, for errors.
pub(crate) const WINDOWS: &str = "pairs [first, last]";

/// Reads which POIs each one comes after. `pois` is `None` if their list is invalid.
pub(crate) fn after(asked: KeyRequest<'_, '_>, pois: Option<usize>) -> Vec<Vec<usize>> {
    let most = pois.map_or(usize::MAX, |pois| pois - 1);
    let wrong = |after: &[Vec<usize>]| {
        if pois.is_none() {
            // The list of POIs has to be fixed first.
            return vec![];
        }
        let own = after.iter().enumerate().filter(|(poi, after)| after.contains(poi));
        let mut problems: Vec<_> =
            own.map(|(poi, _)| (poi, "found the POI itself, allowed others".to_string())).collect();
        if let (true, Some(cycle)) = (problems.is_empty(), cycle(after)) {
            let names: Vec<_> = cycle.iter().chain(&cycle[..1]).map(|poi| format!("POI {poi}")).collect();
            problems.push((cycle[0], format!("found {}, which can never begin", names.join(" after "))));
        }
        problems
    };
    let lengths = 0..=pois.unwrap_or(usize::MAX);
    asked.lists("lists of POIs", ("world.pois", pois), lengths, between(0, most).because("the last POI"), wrong)
}

/// Sorts POIs topologically: each after those it comes after. Also returns the POIs that have no such order.
fn sorted(after: &[Vec<usize>]) -> (Vec<usize>, Vec<usize>) {
    let (mut order, mut left): (Vec<usize>, Vec<usize>) = (vec![], (0..after.len()).collect());
    let mut placed = vec![false; after.len()];
    loop {
        let free = |&poi: &usize| after[poi].iter().all(|&other| placed.get(other) == Some(&true));
        let (next, others): (Vec<usize>, Vec<usize>) = left.into_iter().partition(free);
        left = others;
        if next.is_empty() {
            return (order, left);
        }
        next.iter().for_each(|&poi| placed[poi] = true);
        order.extend(next);
    }
}

/// Returns POIs of which each comes after the next, and the last after the first.
pub(crate) fn cycle(after: &[Vec<usize>]) -> Option<Vec<usize>> {
    let (_, left) = sorted(after);
    let mut path = vec![*left.first()?];
    loop {
        // A POI without an order waits for another one without.
        let next = *after[path[path.len() - 1]].iter().find(|poi| left.contains(poi))?;
        if let Some(first) = path.iter().position(|&poi| poi == next) {
            return Some(path.split_off(first));
        }
        path.push(next);
    }
}

/// Who observes POIs, when, and in what order.
///
/// A POI is observed at the first step that is within its window, at which all POIs that it comes after were observed
/// at earlier steps, and at which at least as many observers as its coupling are within its radius. Steps count from 1.
///
/// By default all agents are observers, at any step and in any order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rule {
    /// One bit per agent, set if it is an observer of the POI, `[pois][words]`. Empty if all are of all.
    counted: Vec<u32>,
    words: usize,
    /// The first and last step of each POI, `[pois]`. Empty without windows.
    windows: Vec<[u32; 2]>,
    /// The POIs that each one comes after, `[pois]`, and a topological order of all. Empty without orders.
    after: Vec<Vec<usize>>,
    order: Vec<usize>,
}

/// The step of an event that never happens.
pub(crate) const NEVER: u32 = u32::MAX;

impl Rule {
    /// Creates a rule from the observers of each POI, of `agents`, the windows, and the POIs that each one comes after, all
    /// `[pois]`. Windows and orders may be empty.
    pub(crate) fn new(
        observers: &[Vec<Range<usize>>],
        agents: usize,
        windows: &[[usize; 2]],
        after: &[Vec<usize>],
    ) -> Rule {
        let words = agents.div_ceil(32);
        let mut counted = vec![0; observers.len() * words];
        for (bits, observers) in counted.chunks_exact_mut(words).zip(observers) {
            observers.iter().cloned().flatten().for_each(|agent| bits[agent / 32] |= 1 << (agent % 32));
        }
        let all = observers.iter().all(|observers| observers.iter().map(Range::len).sum::<usize>() == agents);
        let after = if after.iter().all(Vec::is_empty) { vec![] } else { after.to_vec() };
        Rule {
            counted: if all { vec![] } else { counted },
            words,
            windows: windows.iter().map(|window| window.map(|step| step as u32)).collect(),
            order: sorted(&after).0,
            after,
        }
    }

    /// Reports whether the rule is consistent with the words of a set and the number of POIs: sizes match, windows
    /// start at step 1 or later, and no POI waits for itself.
    #[cfg(test)]
    pub(crate) fn fits(&self, words: usize, pois: usize) -> bool {
        let fits = |len: usize, wanted: usize| len == 0 || len == wanted;
        fits(self.counted.len(), words * pois)
            && fits(self.windows.len(), pois)
            && fits(self.after.len(), pois)
            && self.windows.iter().all(|&[first, _]| first > 0)
            && self.order.len() == self.after.len()
    }

    /// Reports whether it matters when agents are at a POI.
    pub fn is_timed(&self) -> bool {
        !self.windows.is_empty() || !self.after.is_empty()
    }

    /// Reports whether an agent is an observer of any POI.
    pub fn counts(&self, agent: usize) -> bool {
        let mut sets = self.counted.chunks_exact(self.words.max(1));
        self.counted.is_empty() || sets.any(|set| set[agent / 32] >> (agent % 32) & 1 != 0)
    }

    /// Reports whether an agent is an observer of a POI.
    pub fn counts_at(&self, poi: usize, agent: usize) -> bool {
        self.counted(poi, agent / 32, 1 << (agent % 32)) != 0
    }

    /// Masks a word of the set of a POI to its observers.
    #[inline]
    pub(crate) fn counted(&self, poi: usize, word: usize, agents: u32) -> u32 {
        agents & self.counted.get(poi * self.words + word).copied().unwrap_or(u32::MAX)
    }

    /// Counts the observers in the set of a POI, `[words]`.
    #[inline]
    pub fn count(&self, poi: usize, set: impl IntoIterator<Item = u32>) -> u32 {
        set.into_iter().enumerate().map(|(word, agents)| self.counted(poi, word, agents).count_ones()).sum()
    }

    /// Returns the first and last step of a POI's window, if it has one.
    pub fn window(&self, poi: usize) -> Option<[u32; 2]> {
        self.windows.get(poi).copied()
    }

    /// Returns the POIs that a POI comes after.
    pub fn after(&self, poi: usize) -> &[usize] {
        self.after.get(poi).map_or(&[], |after| after)
    }

    /// Reports whether a POI can be observed at a step, if these POIs were observed before.
    pub fn is_open(&self, poi: usize, step: u32, observed: &[bool]) -> bool {
        self.window(poi).is_none_or(|[first, last]| (first..=last).contains(&step))
            && self.after(poi).iter().all(|&other| observed[other])
    }

    /// Writes the step at which each POI is observed in an episode of so many steps, `[pois]`, or [`NEVER`].
    ///
    /// `first_enough` returns the first of the given steps at which a POI has enough observers. It is called with the
    /// steps that the rule allows, if there are any.
    pub fn observe(
        &self,
        steps: u32,
        observed_at: &mut [u32],
        mut first_enough: impl FnMut(usize, RangeInclusive<u32>) -> Option<u32>,
    ) {
        for place in 0..observed_at.len() {
            let poi = self.order.get(place).copied().unwrap_or(place);
            let [first, last] = self.window(poi).unwrap_or([1, steps]);
            let latest = self.after(poi).iter().map(|&other| observed_at[other]).max();
            // Saturates at NEVER.
            let open = latest.map_or(first, |latest| first.max(latest.saturating_add(1)))..=last.min(steps);
            observed_at[poi] = if open.is_empty() { None } else { first_enough(poi, open) }.unwrap_or(NEVER);
        }
    }
}
