//! What a backend is asked to play.

use glam::Vec2;

use super::{BackendError, Held};
use crate::config::Fitness;
use crate::world::World;

/// Teams of one world that start alike and are made of one set of policies.
#[derive(Clone, Copy, Debug)]
pub struct Group<'a> {
    /// The world that they play in.
    pub world: &'a World,
    /// Start positions `[agents]`, leaders first; after them places of the POIs, `[pois]`, unless these are the
    /// world's.
    pub starts: &'a [Vec2],
    /// The policies.
    pub weights: Weights<'a>,
    /// Policies a leader has to choose from.
    pub policies: usize,
    /// The policy each leader plays in each team, `[teams][leaders]`.
    pub teams: &'a [u32],
    /// What its episodes must tell.
    pub need: Need,
}

impl<'a> Group<'a> {
    /// How many teams play.
    pub fn team_count(&self) -> usize {
        self.teams.len() / self.world.leaders()
    }

    /// Where its POIs are, if not where the world has them.
    pub fn moved_pois(&self) -> Option<&'a [Vec2]> {
        Some(&self.starts[self.world.agents()..]).filter(|pois| !pois.is_empty())
    }

    /// Where the weights of a leader's policy start among those on the host.
    #[inline]
    pub(crate) fn place(&self, weights: &[f32], leader: usize, policy: usize) -> usize {
        let parameters = self.world.parameters();
        let shared = weights.len() == self.policies * parameters;
        (if shared { policy } else { leader * self.policies + policy }) * parameters
    }

    /// Whether its parts fit each other. Every backend asks this before it plays.
    ///
    /// # Errors
    /// Places, weights or choices are too few or too many, or a team plays a policy that there is not.
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

/// What is wanted of an episode. A backend may tell more, and does where that costs nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// The whole record, but for who was seen at which step.
    Record,
    /// The whole record: what every fitness is worked out from.
    Sights,
    /// What every fitness but Dt is worked out from.
    Scores,
    /// What this fitness is worked out from.
    Score(Fitness),
}

impl Need {
    /// Every need of scores alone.
    pub const OF_SCORES: [Need; 6] = [
        Need::Scores,
        Need::Score(Fitness::G),
        Need::Score(Fitness::D),
        Need::Score(Fitness::Df),
        Need::Score(Fitness::Dpp),
        Need::Score(Fitness::Dt),
    ];

    /// How many agents a set must have to make a difference, where so many must be near; none where the whole record
    /// is wanted.
    pub fn least(self, coupling: u32) -> Option<u32> {
        match self {
            // Dt asks when.
            Need::Record | Need::Sights | Need::Score(Fitness::Dt) => None,
            // D++ asks how many are missing.
            Need::Scores | Need::Score(Fitness::Dpp) => Some(1),
            Need::Score(Fitness::G | Fitness::D | Fitness::Df) => Some(coupling),
        }
    }

    /// Whether it matters which leader a follower saw most.
    pub fn owners(self) -> bool {
        matches!(self, Need::Record | Need::Sights | Need::Scores | Need::Score(Fitness::Df))
    }

    /// Whether it matters which leaders a follower saw at which step.
    pub fn sights(self) -> bool {
        matches!(self, Need::Sights | Need::Score(Fitness::Dt))
    }
}

/// What the policies of a group are, `[leaders][policies][parameters]`, or `[1][policies][parameters]` where all
/// leaders choose from the same: each number 0 or of size 2^-30 to 2^20.
#[derive(Clone, Copy, Debug)]
pub enum Weights<'a> {
    /// In the host's memory.
    OnHost(&'a [f32]),
    /// In the memory of the backend that plays.
    Held(&'a (dyn Held + 'static)),
}

impl<'a> From<&'a [f32]> for Weights<'a> {
    fn from(weights: &'a [f32]) -> Weights<'a> {
        Weights::OnHost(weights)
    }
}

impl<'a> Weights<'a> {
    /// The numbers, where they are at hand.
    ///
    /// # Errors
    /// Another backend holds them.
    pub fn on_host(self) -> Result<&'a [f32], BackendError> {
        match self {
            Weights::OnHost(weights) => Ok(weights),
            Weights::Held(_) => Err(BackendError::HeldElsewhere),
        }
    }
}
