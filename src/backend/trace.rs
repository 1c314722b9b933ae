//! The trace of a group: every stage of every step.

use crate::declare::shared;
use crate::world::{INPUTS, OUTPUTS};

shared! {
    /// Floats that a [`Trace`] holds of one agent at one step, in this order.
    ///
    /// The inputs and the outputs are a leader's, the force a follower's; who has none has zeros. So does step 0, the
    /// start.
    pub struct Moment {
        /// Sensed densities.
        pub inputs: [f32; INPUTS],
        /// What the policy answered, each in -1..1.
        pub outputs: [f32; OUTPUTS],
        /// Attraction, repulsion and wall push together.
        pub force: [f32; 2],
        /// Where the agent is after the step, x and y in units.
        pub position: [f32; 2],
        /// Where it heads then, a unit vector.
        pub heading: [f32; 2],
        /// How fast it is then, in units a second.
        pub speed: f32,
    }
}

/// Every stage of every step: `moments[(step * teams + team) * agents + agent]`, steps `0..=steps`.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// Teams of the group.
    pub teams: usize,
    /// Agents of a team.
    pub agents: usize,
    /// `[steps + 1][teams][agents]`.
    pub moments: Vec<Moment>,
    /// The agents near each POI after each step, a bit an agent: `[teams][steps][pois][words]`.
    pub sets: Vec<u32>,
    /// At how many steps each follower saw each leader, `[teams][followers][leaders]`.
    pub seen: Vec<u32>,
    /// Where [needed](Need::sights), which leaders each follower saw before each step's move, a bit a leader:
    /// `[teams][steps][followers][words of leaders]`.
    pub sights: Vec<u32>,
}

impl Trace {
    /// What one agent of one team did at one step.
    pub fn moment(&self, step: usize, team: usize, agent: usize) -> &Moment {
        &self.moments[(step * self.teams + team) * self.agents + agent]
    }
}
