//! Maps from the leaders of a team to the populations that their policies come from, `[leaders]`.

use std::sync::LazyLock;

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
    static OWN: LazyLock<Vec<u32>> = LazyLock::new(|| (0..MAX_LEARNERS as u32).collect());
    &OWN[..leaders]
}
