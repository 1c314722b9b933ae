//! Sums that a device computes from each team's record (`shaders/count.wgsl`), and the scores that follow from them.

use crate::backend::Group;
use crate::backend::gpu::source::{COPIES, COPIES_SHIFT, COUNT_WORKGROUP, GROUP, LEADER, MAX_COPIES, Task};
use crate::backend::scores::ScoreTable;
use crate::config::Fitness;
use crate::credit::share;
use crate::world::World;

/// Maximum fitnesses: the shader has two bits for each.
const MAX_FITNESSES: usize = 16;

/// The sums that the scores of a group's teams follow from: what the observed POIs are worth, and for each fitness but G a
/// number per leader.
#[derive(Clone, Copy)]
pub(super) struct Counting<'a> {
    group: &'a Group<'a>,
    world: &'a World,
}

impl<'a> Counting<'a> {
    /// Returns the sums of a group. Returns `None` if a device cannot compute them: scores depend on when agents are at a
    /// POI, or D++ may need too many copies.
    pub(super) fn of(group: &'a Group<'a>) -> Option<Counting<'a>> {
        let Group { world, fitnesses, .. } = *group;
        let can_count = |fitness: &Fitness| match fitness {
            Fitness::G | Fitness::D | Fitness::Df => true,
            Fitness::Dpp => world.coupling.iter().all(|&coupling| (coupling as usize) < MAX_COPIES),
            Fitness::Dt => false,
        };
        let timed = world.paths.is_some() || world.rule.is_timed();
        let all = !timed && fitnesses.len() <= MAX_FITNESSES && fitnesses.iter().all(can_count);
        all.then_some(Counting { group, world })
    }

    /// Returns who is taken out or added for a fitness, 0 for nobody.
    fn kind(&self, fitness: Fitness) -> u32 {
        match fitness {
            Fitness::Df if self.world.followers() > 0 => GROUP,
            Fitness::D | Fitness::Df => LEADER,
            Fitness::Dpp => COPIES,
            Fitness::G | Fitness::Dt => 0,
        }
    }

    /// Returns the kinds of all fitnesses but G, two bits each from the lowest on.
    pub(super) fn kinds(&self) -> u32 {
        let kinds = self.group.fitnesses.iter().map(|&fitness| self.kind(fitness)).filter(|&kind| kind != 0);
        kinds.enumerate().map(|(index, kind)| kind << (2 * index)).sum()
    }

    /// Returns the number of sums per team.
    fn rows(&self) -> usize {
        let kinds = self.group.fitnesses.iter().filter(|&&fitness| self.kind(fitness) != 0);
        1 + kinds.count() * self.world.leaders()
    }

    /// Returns the bits of a sum.
    fn bits(&self) -> usize {
        match self.world.total_worth {
            _ if self.group.fitnesses.contains(&Fitness::Dpp) => 32,
            0..=0xff => 8,
            0x100..=0xffff => 16,
            _ => 32,
        }
    }

    /// Returns the words of so many teams' sums.
    pub(super) fn words(&self, teams: usize) -> usize {
        (self.rows() * teams * self.bits()).div_ceil(32)
    }

    /// Returns the group's part of `scoring` in the shader.
    pub(super) fn scoring(&self) -> Vec<u32> {
        let world = self.world;
        let mut scoring = vec![self.bits() as u32];
        for (poi, (&coupling, &worth)) in world.coupling.iter().zip(&world.worth).enumerate() {
            scoring.extend([coupling, worth]);
            scoring.extend((0..world.constants.words as usize).map(|word| world.rule.counted(poi, word, u32::MAX)));
        }
        scoring
    }

    /// Returns the maximum loop iterations per thread to count so many teams.
    pub(super) fn iterations(&self, teams: usize) -> usize {
        let (leaders, words) = (self.world.leaders(), self.world.constants.words as usize);
        let items = |rows: usize| (rows * teams).div_ceil(COUNT_WORKGROUP);
        items(words) * 32 * (leaders + 1) + items(self.rows()) * self.world.set_words().max(self.world.steps()) * 2
    }

    /// Scores the teams of a task by the sums of its batch. `first` is the index of their group, and that of the first team.
    pub(super) fn score(&self, words: &[u32], task: &Task, first: (usize, usize), scores: &ScoreTable<'_>) {
        let (bits, teams, leaders) = (self.bits(), task.teams as usize, self.world.leaders());
        let (start, total) = (task.counted as usize, u64::from(self.world.total_worth));
        let sum = |row: usize, team: usize| {
            let bit = (row * teams + team) * bits;
            words[start + bit / 32] >> (bit % 32) & (u32::MAX >> (32 - bits))
        };
        for team in 0..teams {
            let (place, observed) = ((first.0, first.1 + team), sum(0, team));
            let mut row = 1;
            for (index, &fitness) in self.group.fitnesses.iter().enumerate() {
                let kind = self.kind(fitness);
                let score = |leader: usize| match kind {
                    0 => share(observed, total),
                    COPIES => {
                        let sum = sum(row + leader, team);
                        share(sum & ((1 << COPIES_SHIFT) - 1), total * u64::from(sum >> COPIES_SHIFT))
                    }
                    _ => share(sum(row + leader, team), total),
                };
                scores.put(place, index, observed, (0..leaders).map(score));
                row += if kind == 0 { 0 } else { leaders };
            }
            if self.group.fitnesses.is_empty() {
                scores.put(place, 0, observed, std::iter::empty());
            }
        }
    }
}
