//! Maps from the leaders of a team to the populations that their policies come from, `[leaders]`.

use super::MAX_LEARNERS;

/// Returns the number of populations that leaders choose from.
pub fn population_count(populations: &[u32]) -> usize {
    populations.iter().max().map_or(0, |&last| last as usize + 1)
}

/// Returns the populations of leaders that each have one of their own.
///
/// # Panics
/// There are more than [`MAX_LEARNERS`] leaders.
pub fn own_populations(leaders: usize) -> &'static [u32] {
    static OWN: [u32; MAX_LEARNERS] = {
        let mut own = [0; MAX_LEARNERS];
        let mut leader = 0;
        while leader < MAX_LEARNERS {
            own[leader] = leader as u32;
            leader += 1;
        }
        own
    };
    &OWN[..leaders]
}

/// Returns the populations of leaders that all share one.
///
/// # Panics
/// There are more than [`MAX_LEARNERS`] leaders.
pub fn one_population(leaders: usize) -> &'static [u32] {
    static ONE: [u32; MAX_LEARNERS] = [0; MAX_LEARNERS];
    &ONE[..leaders]
}
