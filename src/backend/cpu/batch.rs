//! Teams that may share a block: those of consecutive groups in the same world.

use crate::backend::Group;
use crate::world::World;

/// Consecutive groups in the same world. Their teams may share a block.
pub(super) struct WorldBatch<'a> {
    pub(super) world: &'a World,
    /// The index in the batch of the first group, and the groups.
    pub(super) first: usize,
    pub(super) groups: &'a [Group<'a>],
    pub(super) teams: usize,
    /// Whether sightings are recorded.
    pub(super) sighted: bool,
}

impl WorldBatch<'_> {
    /// Returns the group, by its index here, and the team in it of a team of this batch.
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

pub(super) fn world_batches<'a>(groups: &'a [Group<'a>]) -> Vec<WorldBatch<'a>> {
    let mut first = 0;
    let mut batches = Vec::new();
    for groups in groups.chunk_by(|a, b| std::ptr::eq(a.world, b.world)) {
        let teams = groups.iter().map(Group::team_count).sum();
        let sighted = groups.iter().any(|group| group.need.sights());
        batches.push(WorldBatch { world: groups[0].world, first, groups, teams, sighted });
        first += groups.len();
    }
    batches
}
