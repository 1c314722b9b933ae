//! The trace of a group: all quantities of every step.

use bytemuck::Zeroable;
use glam::Vec2;

use super::Group;
use crate::credit::Episode;
use crate::gpu_struct::gpu_struct;
use crate::world::{OUTPUTS, World};

gpu_struct! {
    /// The floats of one agent at one step of a [`Trace`], in this order.
    ///
    /// Only leaders have outputs, only followers a force. Other agents, and step 0 (the start), have zeros.
    pub struct Moment {
        /// The outputs of the policy, each in -1..1.
        pub outputs: [f32; OUTPUTS],
        /// The sum of the terms of its rule and of the push of walls.
        pub force: [f32; 2],
        /// The position after the step, x and y in units.
        pub position: [f32; 2],
        /// The heading after the step, a unit vector.
        pub heading: [f32; 2],
        /// The speed after the step, in units per second.
        pub speed: f32,
    }
}

/// 32-bit words of a [`Moment`].
pub(crate) const MOMENT_WORDS: usize = size_of::<Moment>() / size_of::<u32>();

/// All quantities of every step: `moments[(step * teams + team) * agents + agent]`, steps `0..=steps`.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// Teams of the group.
    pub teams: usize,
    /// Agents of a team.
    pub agents: usize,
    /// The agents that learn.
    pub leaders: usize,
    /// `[steps + 1][teams][agents]`.
    pub moments: Vec<Moment>,
    /// The inputs of the leaders' policies, `[steps + 1][teams][leaders][inputs]`; zeros at step 0.
    pub inputs: Vec<f32>,
    /// The agents at each POI after each step, one bit per agent, `[teams][steps][pois][words]`.
    pub sets: Vec<u32>,
    /// The number of steps at which each follower saw each leader, `[teams][followers][leaders]`.
    pub seen: Vec<u32>,
    /// The leaders that each follower saw before the move of each step, one bit per leader,
    /// `[teams][steps][followers][words of leaders]`; empty unless Dt is among the group's
    /// [fitnesses](super::Group::fitnesses). If [scores need paths](crate::world::WorldParts::paths), instead the positions,
    /// f32 as bits, `[teams][steps + 1][agents][2]`.
    pub trail: Vec<u32>,
    /// Positions of the POIs, `[pois]`.
    pub pois: Vec<Vec2>,
}

impl Trace {
    /// Returns a trace of a group with zeros in all arrays.
    pub(super) fn of_zeros(group: &Group<'_>) -> Trace {
        let (world, teams) = (group.world, group.team_count());
        let (agents, leaders, moments) = (world.agents(), world.leaders(), (world.steps() + 1) * teams);
        let trail = match world.paths {
            Some(_) => world.path_words(),
            None if group.records().sights() => world.sight_words(),
            None => 0,
        };
        Trace {
            teams,
            agents,
            leaders,
            moments: vec![Moment::zeroed(); moments * agents],
            inputs: vec![0.0; moments * leaders * world.inputs()],
            sets: vec![0; teams * world.set_words()],
            seen: vec![0; teams * leaders * world.followers()],
            trail: vec![0; teams * trail],
            pois: group.pois().to_vec(),
        }
    }

    /// Stores the record of one team.
    pub(super) fn store(&mut self, team: usize, episode: &Episode<'_>) {
        let Trace { sets, seen, trail, .. } = self;
        for (all, words) in [(sets, episode.sets), (seen, episode.seen), (trail, episode.trail())] {
            let to = all[team * words.len()..].iter_mut();
            to.zip(words.iter()).for_each(|(to, word)| *to = word);
        }
    }

    /// Returns what one agent of one team did at one step.
    pub fn moment(&self, step: usize, team: usize, agent: usize) -> &Moment {
        &self.moments[(step * self.teams + team) * self.agents + agent]
    }

    /// Returns the inputs of one leader's policy at one step.
    pub fn inputs_of(&self, step: usize, team: usize, leader: usize) -> &[f32] {
        let inputs = self.inputs.len() / (self.moments.len() / self.agents * self.leaders);
        &self.inputs[((step * self.teams + team) * self.leaders + leader) * inputs..][..inputs]
    }

    /// Returns the record of one team, which credit is computed from.
    pub fn episode(&self, world: &World, team: usize) -> Episode<'_> {
        let part = |words, size: usize| <[u32]>::get(words, team * size..(team + 1) * size).unwrap_or_default();
        let counts = part(&self.seen, world.leaders() * world.followers());
        let sets = part(&self.sets, world.set_words());
        let trail = part(&self.trail, if world.paths.is_some() { world.path_words() } else { world.sight_words() });
        Episode::whole(sets, counts, trail, world.paths.is_some().then_some(&self.pois))
    }
}
