//! The input of a backend: groups of teams to play.

use glam::Vec2;

use super::{BackendError, DevicePopulation};
use crate::config::{Fitness, population_count};
use crate::credit::RecordRequest;
use crate::parallel::*;
use crate::world::World;

/// Choices of policies per rayon task.
const CHECKED_TOGETHER: usize = 1 << 16;

/// Teams of one world that start at the same positions and choose from the same policies.
#[derive(Clone, Copy, Debug)]
pub struct Group<'a> {
    /// The world.
    pub world: &'a World,
    /// Start positions, `[agents]`, leaders first, optionally followed by POI positions, `[pois]`, and these by headings,
    /// unit vectors, `[agents]`, that replace the world's.
    pub starts: &'a [Vec2],
    /// The policies.
    pub weights: Weights<'a>,
    /// Policies per population. In training these are its [slots](crate::config::Learning::slots).
    pub policies: usize,
    /// The population that each leader chooses from, `[leaders]`. A config's are its world's; see also
    /// [`own_populations`](crate::config::own_populations).
    pub populations: &'a [u32],
    /// The policy of each leader in each team, `[teams][leaders]`.
    pub teams: &'a [u32],
    /// The fitnesses to score every leader by. A trace has sightings only if Dt is among them.
    pub fitnesses: &'a [Fitness],
}

impl<'a> Group<'a> {
    /// Returns a group of teams that start at the world's positions, choose from its populations, and are not scored.
    pub fn new(world: &'a World, weights: impl Into<Weights<'a>>, policies: usize, teams: &'a [u32]) -> Group<'a> {
        let (starts, weights, populations) = (&world.starts, weights.into(), &world.populations);
        Group { world, starts, weights, policies, populations, teams, fitnesses: &[] }
    }

    /// Returns the number of teams.
    pub fn team_count(&self) -> usize {
        self.teams.len() / self.world.leaders()
    }

    /// Returns the POI positions, if they are not the world's.
    pub fn moved_pois(&self) -> Option<&'a [Vec2]> {
        let agents = self.world.agents();
        self.starts.get(agents..agents + self.world.pois.len())
    }

    /// Returns the headings at the start, `[agents]`.
    pub(crate) fn headings(&self) -> &'a [Vec2] {
        let given = self.starts.get(self.world.agents() + self.world.pois.len()..);
        given.filter(|headings| !headings.is_empty()).unwrap_or(&self.world.headings)
    }

    /// Returns the POI positions.
    pub fn pois(&self) -> &'a [Vec2] {
        self.moved_pois().unwrap_or(&self.world.pois)
    }

    /// Returns the part of a record that the fitnesses are computed from, besides paths.
    pub(crate) fn records(&self) -> RecordRequest<'a> {
        RecordRequest(if self.world.paths.is_some() { &[] } else { self.fitnesses })
    }

    /// Returns the number of populations.
    pub fn population_count(&self) -> usize {
        population_count(self.populations)
    }

    /// Returns the index of a policy's first weight.
    #[inline]
    pub(crate) fn place(&self, leader: usize, policy: usize) -> usize {
        (self.populations[leader] as usize * self.policies + policy) * self.world.parameters()
    }

    /// Checks the group. Every backend calls this before it plays. A backend that holds the policies also checks their
    /// number.
    ///
    /// # Errors
    /// An array has the wrong length, or a team plays a policy that does not exist.
    pub fn check(&self) -> Result<(), BackendError> {
        let Group { world, starts, weights, policies, teams, .. } = *self;
        let invalid = |text: String| Err(BackendError::InvalidInput(text));
        let (agents, leaders) = (world.agents(), world.leaders());
        let pois = world.pois.len();
        if ![agents, agents + pois, agents + pois + agents].contains(&starts.len()) {
            return invalid(format!("{} start positions for {agents} agents", starts.len()));
        }
        if !teams.len().is_multiple_of(leaders) {
            return invalid(format!("{} choices of policies for teams of {leaders} leaders", teams.len()));
        }
        if self.populations.len() != leaders {
            return invalid(format!("populations of {} leaders for {leaders}", self.populations.len()));
        }
        let populations = self.population_count();
        let numbers = populations * policies * world.parameters();
        if let Weights::OnHost(weights) = weights
            && weights.len() != numbers
        {
            let found = weights.len();
            return invalid(format!("{found} weights, but {populations} populations of {policies} have {numbers}"));
        }
        // Finding the maximum is vectorised. The position is searched only after a failure.
        let exist = |teams: &[u32]| teams.iter().copied().max().is_none_or(|policy| (policy as usize) < policies);
        if teams.par_chunks(CHECKED_TOGETHER).all(exist) {
            return Ok(());
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

/// The policies of a group, `[populations][policies][parameters]`. Each number is 0, or of size 2^-30 to 2^20.
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
