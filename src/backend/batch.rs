//! The input of a backend: groups of teams to play.

use glam::Vec2;

use super::{BackendError, DevicePopulation};
use crate::config::Fitness;
use crate::world::World;

/// Teams of one world that start at the same positions and choose from the same policies.
#[derive(Clone, Copy, Debug)]
pub struct Group<'a> {
    /// The world.
    pub world: &'a World,
    /// Start positions, `[agents]`, leaders first, optionally followed by POI positions, `[pois]`, that replace the
    /// world's.
    pub starts: &'a [Vec2],
    /// The policies.
    pub weights: Weights<'a>,
    /// Policies per leader.
    pub policies: usize,
    /// The policy of each leader in each team, `[teams][leaders]`.
    pub teams: &'a [u32],
    /// The requested record.
    pub need: RecordRequest,
}

impl<'a> Group<'a> {
    /// Returns the number of teams.
    pub fn team_count(&self) -> usize {
        self.teams.len() / self.world.leaders()
    }

    /// Returns the POI positions, if they are not the world's.
    pub fn moved_pois(&self) -> Option<&'a [Vec2]> {
        Some(&self.starts[self.world.agents()..]).filter(|pois| !pois.is_empty())
    }

    /// Returns the index of a policy's first weight.
    #[inline]
    pub(crate) fn place(&self, weights: &[f32], leader: usize, policy: usize) -> usize {
        let parameters = self.world.parameters();
        let shared = weights.len() == self.policies * parameters;
        (if shared { policy } else { leader * self.policies + policy }) * parameters
    }

    /// Checks the group. Every backend calls this before it plays.
    ///
    /// # Errors
    /// An array has the wrong length, the world is inconsistent, or a team plays a policy that does not exist.
    pub fn check(&self) -> Result<(), BackendError> {
        let Group { world, starts, weights, policies, teams, .. } = *self;
        let invalid = |text: String| Err(BackendError::InvalidInput(text));
        if let Err(field) = world.validate() {
            return invalid(format!("the world is inconsistent: its {field} do not match the rest"));
        }
        let (agents, leaders) = (world.agents(), world.leaders());
        if starts.len() != agents && starts.len() != agents + world.pois.len() {
            return invalid(format!("{} start positions for {agents} agents", starts.len()));
        }
        if !teams.len().is_multiple_of(leaders) {
            return invalid(format!("{} choices of policies for teams of {leaders} leaders", teams.len()));
        }
        let shared = policies * world.parameters();
        let numbers = leaders * shared;
        if let Weights::OnHost(weights) = weights
            && ![shared, numbers].contains(&weights.len())
        {
            return invalid(format!("{} weights, but {policies} policies a leader have {numbers}", weights.len()));
        }
        match teams.iter().position(|&policy| policy as usize >= policies) {
            None => Ok(()),
            Some(place) => invalid(format!(
                "leader {} of team {} plays policy {} of {policies} (they count from 0)",
                place % leaders,
                place / leaders,
                teams[place]
            )),
        }
    }
}

/// A request for what to record of an episode. A backend may record more if that costs nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecordRequest {
    /// The whole record, except which leaders were seen at which step.
    Record,
    /// The whole record. Every fitness can be computed from it.
    Sights,
    /// The part that every fitness but Dt is computed from.
    Scores,
    /// The part that one fitness is computed from.
    Score(Fitness),
}

impl RecordRequest {
    /// Every request that asks for scores only.
    pub const OF_SCORES: [RecordRequest; 6] = [
        RecordRequest::Scores,
        RecordRequest::Score(Fitness::G),
        RecordRequest::Score(Fitness::D),
        RecordRequest::Score(Fitness::Df),
        RecordRequest::Score(Fitness::Dpp),
        RecordRequest::Score(Fitness::Dt),
    ];

    /// Returns the minimum number of agents in a set that can affect a score, at a POI of this coupling. `None` if the
    /// whole record is requested.
    pub fn least(self, coupling: u32) -> Option<u32> {
        match self {
            // Dt depends on when sets occur.
            RecordRequest::Record | RecordRequest::Sights | RecordRequest::Score(Fitness::Dt) => None,
            // D++ depends on how many agents are missing.
            RecordRequest::Scores | RecordRequest::Score(Fitness::Dpp) => Some(1),
            RecordRequest::Score(Fitness::G | Fitness::D | Fitness::Df) => Some(coupling),
        }
    }

    /// Reports whether the leader that each follower saw most is needed.
    pub fn owners(self) -> bool {
        matches!(
            self,
            RecordRequest::Record | RecordRequest::Sights | RecordRequest::Scores | RecordRequest::Score(Fitness::Df)
        )
    }

    /// Reports whether the leaders that each follower saw at each step are needed.
    pub fn sights(self) -> bool {
        matches!(self, RecordRequest::Sights | RecordRequest::Score(Fitness::Dt))
    }
}

/// The policies of a group: `[leaders][policies][parameters]`, or `[1][policies][parameters]` if all leaders choose
/// from the same. Each number is 0, or of size 2^-30 to 2^20.
#[derive(Clone, Copy, Debug)]
pub enum Weights<'a> {
    /// In the host's memory.
    OnHost(&'a [f32]),
    /// In the memory of the backend that plays.
    OnDevice(&'a (dyn DevicePopulation + 'static)),
}

impl<'a> From<&'a [f32]> for Weights<'a> {
    fn from(weights: &'a [f32]) -> Weights<'a> {
        Weights::OnHost(weights)
    }
}

impl<'a> Weights<'a> {
    /// Returns the weights, if they are in the host's memory.
    ///
    /// # Errors
    /// A device holds them.
    pub fn on_host(self) -> Result<&'a [f32], BackendError> {
        match self {
            Weights::OnHost(weights) => Ok(weights),
            Weights::OnDevice(_) => Err(BackendError::HeldElsewhere),
        }
    }
}
