//! Teams of several groups that play together.

use std::ops::Range;

use crate::backend::{Group, Weights};
use crate::config::Fitness;
use crate::host::prefetch;
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
    /// Whether it matters which leader each follower saw most.
    pub(super) counted: bool,
    /// The fitnesses of every group; `None` if these differ.
    pub(super) fitnesses: Option<&'a [Fitness]>,
    /// The number of teams up to the end of each group, `[groups]`.
    ends: Vec<usize>,
}

impl<'a> WorldBatch<'a> {
    /// Joins groups, at least one, in the same world. `first` is the index of the first in its batch.
    pub(super) fn new(groups: &'a [Group<'a>], first: usize) -> WorldBatch<'a> {
        let mut teams = 0;
        let add = |group: &Group<'_>| {
            teams += group.team_count();
            teams
        };
        let ends = groups.iter().map(add).collect();
        let sighted = groups.iter().any(|group| group.records().sights());
        let counted = groups.iter().any(|group| group.records().owners());
        let fitnesses = Some(groups[0].fitnesses);
        let fitnesses = fitnesses.filter(|fitnesses| groups.iter().all(|group| group.fitnesses == *fitnesses));
        WorldBatch { world: groups[0].world, first, groups, teams, sighted, counted, fitnesses, ends }
    }

    /// Returns the group, by its index here, and the team in it of a team of this batch.
    pub(super) fn locate(&self, team: usize) -> (usize, usize) {
        let group = self.ends.partition_point(|&end| end <= team);
        (group, team - group.checked_sub(1).map_or(0, |before| self.ends[before]))
    }

    /// Returns the policy of a leader of a group's team.
    #[inline(always)]
    pub(super) fn policy(&self, leader: usize, (group, team): (usize, usize)) -> &'a [f32] {
        let group = &self.groups[group];
        let policy = group.teams[team * self.world.leaders() + leader] as usize;
        let Weights::OnHost(weights) = group.weights else { unreachable!("the backend checks this before playing") };
        &weights[group.place(leader, policy)..][..self.world.parameters()]
    }

    /// Prefetches a share of the policies of some teams. The calls of all steps of an episode prefetch all of them: a
    /// few at a time, because the processor has room for few requests.
    #[inline(always)]
    pub(super) fn prefetch(&self, teams: Range<usize>, step: usize) {
        let (steps, policies) = (self.world.steps(), teams.len() * self.world.leaders());
        for index in policies * step / steps..policies * (step + 1) / steps {
            let (leader, team) = (index / teams.len(), teams.start + index % teams.len());
            prefetch(self.policy(leader, self.locate(team)));
        }
    }
}

/// Joins consecutive groups in the same world.
pub(super) fn world_batches<'a>(groups: &'a [Group<'a>]) -> Vec<WorldBatch<'a>> {
    let mut first = 0;
    let join = |groups: &'a [Group<'a>]| {
        let batch = WorldBatch::new(groups, first);
        first += groups.len();
        batch
    };
    groups.chunk_by(|a, b| std::ptr::eq(a.world, b.world)).map(join).collect()
}
