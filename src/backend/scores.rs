//! The output of a backend: scores, computed by the threads that play.

use std::cell::RefCell;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use super::Group;
use crate::config::Fitness;
use crate::credit::{Credit, Episode};
use crate::parallel::*;

/// Minimum number of scores per rayon task that sets them to zero.
const ZEROED_TOGETHER: usize = 1 << 16;

/// The scores of one group's teams.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroupScores {
    /// The summed [worth](crate::world::WorldParts::worth) of the observed POIs, `[teams]`: with equal values, their number.
    pub observed: Vec<u32>,
    /// The leaders' scores, `[teams][fitnesses][leaders]`.
    pub scores: Vec<f32>,
}

/// The scores of the groups of a batch. Several threads may write at a time; each team is scored once.
pub(crate) struct ScoreTable<'a> {
    groups: &'a [Group<'a>],
    /// The summed worth of the observed POIs, `[teams]` per group.
    observed: Vec<Vec<AtomicU32>>,
    /// Scores, f32 as bits, `[teams][fitnesses][leaders]` per group.
    scores: Vec<Vec<AtomicU32>>,
}

impl<'a> ScoreTable<'a> {
    /// Returns a table of zeros.
    pub(crate) fn new(groups: &'a [Group<'a>]) -> ScoreTable<'a> {
        // Threads share the memory's first use, which takes longer than the zeros.
        let zeros = |count: usize| {
            (0..count).into_par_iter().with_min_len(ZEROED_TOGETHER).map(|_| AtomicU32::default()).collect()
        };
        ScoreTable {
            groups,
            observed: groups.iter().map(|group| zeros(group.team_count())).collect(),
            scores: groups.iter().map(|group| zeros(group.teams.len() * group.fitnesses.len())).collect(),
        }
    }

    /// Scores a team of a group from the record of its episode.
    pub(crate) fn score(&self, group: usize, team: usize, episode: &Episode<'_>) {
        thread_local! { static CREDIT: RefCell<(Credit, Vec<f32>)> = RefCell::default(); }
        let Group { world, fitnesses, .. } = self.groups[group];
        CREDIT.with_borrow_mut(|(credit, scores)| {
            scores.resize(world.leaders(), 0.0);
            // Without a fitness, only the observed POIs are wanted.
            let wanted = if fitnesses.is_empty() { &[Fitness::G] } else { fitnesses };
            for (index, &fitness) in wanted.iter().enumerate() {
                let observed = credit.score(episode, world, fitness, scores);
                self.put((group, team), index, observed, scores.iter().copied());
            }
        });
    }

    /// Puts what the POIs that a team observed are worth, and the scores of its leaders by one of the group's fitnesses, if
    /// it has any.
    #[inline(always)]
    pub(crate) fn put(
        &self,
        (group, team): (usize, usize),
        fitness: usize,
        observed: u32,
        scores: impl Iterator<Item = f32>,
    ) {
        let Group { world, fitnesses, .. } = self.groups[group];
        let row = self.scores[group].chunks_exact(world.leaders()).nth(team * fitnesses.len() + fitness);
        row.into_iter().flatten().zip(scores).for_each(|(to, score)| to.store(score.to_bits(), Relaxed));
        self.observed[group][team].store(observed, Relaxed);
    }

    /// Returns the scores of each group.
    pub(crate) fn finish(self) -> Vec<GroupScores> {
        let groups = self.observed.into_iter().zip(self.scores);
        let scores = |(observed, scores): (Vec<AtomicU32>, Vec<AtomicU32>)| GroupScores {
            observed: observed.into_iter().map(AtomicU32::into_inner).collect(),
            scores: scores.into_iter().map(|score| f32::from_bits(score.into_inner())).collect(),
        };
        groups.map(scores).collect()
    }
}
