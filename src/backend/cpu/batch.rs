//! Teams that may share a block: those of consecutive groups in the same world.

use crate::backend::Group;
use crate::world::World;

/// Groups that follow each other in the same world: their teams may share a block.
pub(super) struct Chain<'a> {
    pub(super) world: &'a World,
    /// Index in the batch of the first group, and the groups.
    pub(super) first: usize,
    pub(super) groups: &'a [Group<'a>],
    pub(super) teams: usize,
    /// Whether sights are recorded.
    pub(super) sighted: bool,
}

impl Chain<'_> {
    /// Group (in the run) and team (in the group) of a team of the run.
    pub(super) fn locate(&self, mut team: usize) -> (usize, usize) {
        for (index, group) in self.groups.iter().enumerate() {
            if team < group.team_count() {
                return (index, team);
            }
            team -= group.team_count();
        }
        unreachable!("a team of the run")
    }
}

pub(super) fn runs<'a>(groups: &'a [Group<'a>]) -> Vec<Chain<'a>> {
    let mut first = 0;
    let mut runs = Vec::new();
    for groups in groups.chunk_by(|a, b| std::ptr::eq(a.world, b.world)) {
        let teams = groups.iter().map(Group::team_count).sum();
        let sighted = groups.iter().any(|group| group.need.sights());
        runs.push(Chain { world: groups[0].world, first, groups, teams, sighted });
        first += groups.len();
    }
    runs
}
