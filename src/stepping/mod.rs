//! Stepping: the caller decides the leaders' actions, step by step, on the CPU.
//!
//! A [`Stepper`] plays the episodes of [`crate::backend`] with the same kernels, but takes actions from the caller.
//! Given a policy's own outputs, it returns the bits of [`Backend::trace`](crate::backend::Backend::trace).
//!
//! ```
//! use flotilla::{config::Config, stepping::{Recording, Stepper}, world::World};
//!
//! let config = Config::parse(include_str!("../../configs/generally_forward.toml"), "generally_forward.toml")?;
//! let mut stepper = Stepper::new(World::new(&config.validate()?), 64, Recording::None)?;
//! // Every leader of every team straight ahead at full speed: [teams][leaders][2].
//! let ahead = [0.0, 1.0].repeat(64 * stepper.world().leaders());
//! while !stepper.is_over(0) {
//!     stepper.step(&ahead)?;
//! }
//! let observed = stepper.observed()[..4].iter().filter(|&&observed| observed).count();
//! println!("team 0 observed {observed} of 4 POIs, its first leader senses {:?}", &stepper.inputs()[..8]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::cell::RefCell;

use fearless_simd::{Level, dispatch};
use glam::Vec2;

use crate::backend::cpu::block_bytes;
use crate::backend::grid::{LARGE_FROM, is_large};
use crate::config::{Fitness, MAX_POPULATION};
use crate::credit::{Credit, Scores};
use crate::memory;
use crate::parallel::*;
use crate::world::{GRID, OUTPUTS, World, on_grid};

mod engine;
mod large;
mod state;

use engine::{Command, Observations, VECTORS_PER_TASK, Vectors, vectors};
use large::large_teams;

/// Teams of one world, each at its own step.
///
/// Arrays are flat and keep their addresses from step to step. Shapes are row-major: the last index of
/// `[teams][leaders][inputs]` varies fastest. Leaders come before followers.
pub struct Stepper {
    world: World,
    vectors: Box<dyn Vectors>,
    observations: Observations,
    /// Each team's POI positions, `[teams][pois]`; empty if all teams have the world's.
    moved: Vec<Vec2>,
}

/// The part of every step that a stepper records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recording {
    /// Nothing.
    None,
    /// The agents at each POI, for [`Stepper::scores`] and [`Stepper::fitness`].
    Sets,
    /// Also which leaders each follower sees, for Dt.
    SetsAndSights,
}

/// The state of all agents.
#[derive(Clone, Copy, Debug)]
pub struct States<'a> {
    /// Positions on the map, `[teams][agents][2]`, in units.
    pub positions: &'a [f32],
    /// Headings, unit vectors, `[teams][agents][2]`.
    pub headings: &'a [f32],
    /// Speeds, `[teams][agents]`, in units per second.
    pub speeds: &'a [f32],
}

/// Why teams could not be created, reset, stepped or scored. Their state is unchanged.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StepError {
    /// The number of teams is 0 or too large.
    #[error("{0} teams; there may be 1 to {MAX_POPULATION}")]
    Teams(usize),
    /// The system has too little memory.
    #[error("not enough memory for {teams} teams, {bytes} bytes")]
    Memory {
        /// The number of teams.
        teams: usize,
        /// Bytes needed.
        bytes: u128,
    },
    /// An array has the wrong length, a number in it is out of range, or the team does not exist.
    #[error("{0}")]
    Invalid(String),
    /// A saved state does not fit.
    #[error("the saved state does not fit: {0}")]
    State(&'static str),
    /// Scores need a record, see [`Recording`].
    #[error("no record to score; create the stepper with `Recording::Sets`")]
    NotRecorded,
    /// Dt needs a record of sightings, see [`Recording`].
    #[error(
        "no record of who saw whom at which step, which Dt needs; create the stepper with `Recording::SetsAndSights`"
    )]
    NotSeen,
}

impl Stepper {
    /// Creates teams at the world's start.
    ///
    /// # Errors
    /// The number of teams is 0 or above [`MAX_POPULATION`], or there is too little memory.
    pub fn new(world: World, teams: usize, recording: Recording) -> Result<Stepper, StepError> {
        Stepper::at_level(Level::new(), LARGE_FROM, world, teams, recording)
    }

    /// [`Stepper::new`] with a given instruction set, for tests and benchmarks. Teams of `large_from` agents or more are
    /// large, if large teams can play the world.
    ///
    /// # Errors
    /// See [`Stepper::new`].
    pub fn at_level(
        level: Level,
        large_from: usize,
        world: World,
        teams: usize,
        recording: Recording,
    ) -> Result<Stepper, StepError> {
        if !(1..=MAX_POPULATION).contains(&teams) {
            return Err(StepError::Teams(teams));
        }
        let (agents, leaders, pois) = (world.agents(), world.leaders(), world.pois.len());
        let words = world.constants.words as usize;
        // Probed first, because a failing allocation below would abort. Counts a team's numbers, both in the vectors and
        // as shown.
        let [sets, trail] = match recording {
            Recording::None => [0, 0],
            _ if world.paths.is_some() => [world.set_words(), world.path_words()],
            Recording::Sets => [world.set_words(), 0],
            Recording::SetsAndSights => [world.set_words(), world.sight_words()],
        };
        let is_large = is_large(&world, large_from);
        let state = if is_large {
            block_bytes(&world, if sets > 0 { Fitness::Df } else { Fitness::G }) as usize / 4
        } else {
            agents * 6 + leaders * (world.inputs() + OUTPUTS) + world.followers() * (11 + leaders) + pois * words + sets
        };
        let numbers = state + trail + leaders * world.inputs() + agents * 5 + pois * (words + 1) + 1;
        let bytes = numbers as u128 * 4 * teams as u128;
        if !memory::can_allocate(bytes) {
            return Err(StepError::Memory { teams, bytes });
        }
        let vectors = dispatch!(level, simd => if is_large {
            large_teams(simd, &world, teams, recording)
        } else {
            vectors(simd, &world, teams, [sets, trail])
        });
        let observations = Observations {
            inputs: vec![0.0; teams * leaders * world.inputs()],
            agents_at_poi: vec![0; teams * pois * words],
            newly: vec![false; teams * pois],
            observed: vec![false; teams * pois],
            steps: vec![0; teams],
            positions: vec![0.0; teams * agents * 2],
            headings: vec![0.0; teams * agents * 2],
            speeds: vec![0.0; teams * agents],
        };
        let mut stepper = Stepper { world, vectors, observations, moved: vec![] };
        stepper.reset();
        Ok(stepper)
    }

    /// Returns the world.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Returns the number of teams.
    pub fn teams(&self) -> usize {
        self.observations.steps.len()
    }

    /// Resets all teams to the world's start.
    pub fn reset(&mut self) {
        self.moved.clear();
        self.run(Command::Reset { chosen: None, starts: None, headings: None });
    }

    /// Resets all teams to given start positions, `[teams][agents][2]`, or `[teams][agents + pois][2]` with POI
    /// positions that replace the world's, or `[teams][agents + pois + agents][2]` with headings, unit vectors, that
    /// do. Each position is rounded to the kernels' grid (within 2^-19).
    /// [`crate::evaluate::Starts`] draws such positions.
    ///
    /// # Errors
    /// The length is wrong, a position is off the map, or a heading is no unit vector.
    pub fn reset_to(&mut self, starts: &[f32]) -> Result<(), StepError> {
        let given = self.checked(starts, None)?;
        self.moved = given.pois;
        self.run(Command::Reset { chosen: None, starts: Some(&given.starts), headings: given.headings.as_deref() });
        Ok(())
    }

    /// Resets the chosen teams, `[teams]`, to the world's start, or to given positions like [`Stepper::reset_to`]. The
    /// other teams, and their positions in `starts`, are ignored.
    ///
    /// # Errors
    /// A length is wrong, a position is off the map, or a heading is no unit vector.
    pub fn reset_some(&mut self, chosen: &[bool], starts: Option<&[f32]>) -> Result<(), StepError> {
        self.check_length("choices", "[teams]", self.teams(), chosen.len())?;
        let all = starts.map(|starts| self.checked(starts, Some(chosen))).transpose()?;
        let given = all.as_ref().map_or(&[][..], |all| &all.pois);
        if self.moved.is_empty() && !given.is_empty() {
            self.moved = self.world.pois.repeat(self.teams());
        }
        let pois = self.world.pois.len();
        for (team, moved) in self.moved.chunks_exact_mut(pois).enumerate().filter(|&(team, _)| chosen[team]) {
            moved.copy_from_slice(given.get(team * pois..(team + 1) * pois).unwrap_or(&self.world.pois));
        }
        let starts = all.as_ref().map(|all| &all.starts[..]);
        let headings = all.as_ref().and_then(|all| all.headings.as_deref());
        self.run(Command::Reset { chosen: Some(chosen), starts, headings });
        Ok(())
    }

    /// Plays one step with given actions, `[teams][leaders][2]`: a turn to the left, as a fraction of a half turn, and
    /// a speed, from -1 (stop) to 1 (the maximum). Actions are clamped to -1..1.
    ///
    /// If policies of this world choose behaviours, actions are still turns and speeds. Each behaviour is a turn of 0,
    /// ±0.25 or ±0.75 and a speed of -1 or 1, see [`crate::model::policy::choose`].
    ///
    /// Actions of agents that move freely are velocities along x and y, as fractions of the maximum speed. The first action
    /// of an agent that chooses agents to move to is its choice: from -1, the first agent, to 1, nobody, in equal steps. It is
    /// rounded to the nearest of them.
    ///
    /// A team whose episode is over does not move until it is reset.
    ///
    /// # Errors
    /// The length is wrong, or a number is not finite. No team has moved then.
    pub fn step(&mut self, actions: &[f32]) -> Result<(), StepError> {
        let leaders = self.world.leaders();
        let expected = self.teams() * leaders * OUTPUTS;
        self.check_length("actions", "[teams][leaders][2]", expected, actions.len())?;
        // The fast test covers all actions. Only if it fails is the index searched.
        if !actions.iter().fold(true, |finite, action| finite & action.is_finite()) {
            let index = actions.iter().position(|action| !action.is_finite()).unwrap_or(0);
            let (team, leader) = (index / OUTPUTS / leaders, index / OUTPUTS % leaders);
            let (output, value) = (["turn", "speed"][index % OUTPUTS], actions[index]);
            return Err(StepError::Invalid(format!(
                "the {output} of leader {leader} in team {team} is {value}, which is no finite number"
            )));
        }
        self.run(Command::Step(actions));
        Ok(())
    }

    /// Returns a team's POI positions in units, `[pois]`. For a team that does not exist, they are the world's.
    pub fn pois(&self, team: usize) -> &[Vec2] {
        let pois = self.world.pois.len();
        self.moved.get(team * pois..(team + 1) * pois).unwrap_or(&self.world.pois)
    }

    /// Returns what every leader senses, `[teams][leaders][inputs]`: the density of POIs, then of agents, in four quadrants
    /// around its heading: back right, front right, front left, back left.
    pub fn inputs(&self) -> &[f32] {
        &self.observations.inputs
    }

    /// Returns the agents at each POI after the last step, `[teams][pois][words]`, one bit per agent. Before the first
    /// step there are none.
    pub fn agents_at_poi(&self) -> &[u32] {
        &self.observations.agents_at_poi
    }

    /// Returns which POIs the last step observed first, `[teams][pois]`.
    pub fn newly_observed(&self) -> &[bool] {
        &self.observations.newly
    }

    /// Returns which POIs have been observed since the start, `[teams][pois]`.
    pub fn observed(&self) -> &[bool] {
        &self.observations.observed
    }

    /// Returns how many steps each team has played since its start, `[teams]`. The episode is over after the world's
    /// number of steps.
    pub fn steps(&self) -> &[u32] {
        &self.observations.steps
    }

    /// Reports whether a team's episode is over. False for a team that does not exist.
    pub fn is_over(&self, team: usize) -> bool {
        self.observations.steps.get(team).is_some_and(|&step| step as usize >= self.world.steps())
    }

    /// Computes the state of all agents.
    pub fn states(&mut self) -> States<'_> {
        self.run(Command::Show);
        let Observations { positions, headings, speeds, .. } = &self.observations;
        States { positions, headings, speeds }
    }

    /// Returns every fitness of a team's episode so far. Dt needs a [record of sightings](Recording::SetsAndSights), unless
    /// there are no followers.
    ///
    /// # Errors
    /// The team does not exist, or no record was kept.
    pub fn scores(&self, team: usize) -> Result<Scores, StepError> {
        if team >= self.teams() {
            let teams = self.teams();
            return Err(StepError::Invalid(format!("team {team} does not exist: there are {teams}, counted from 0")));
        }
        let mut seen = Vec::new();
        let episode = self.vectors.episode(team, &self.world, &self.moved, &mut seen).ok_or(StepError::NotRecorded)?;
        Ok(Credit::default().all(&episode, &self.world))
    }

    /// Writes one fitness of every leader for the episodes so far, `[teams][leaders]`.
    ///
    /// # Errors
    /// The length is wrong, no record was kept, or Dt has no record of sightings.
    pub fn fitness(&self, fitness: Fitness, scores: &mut [f32]) -> Result<(), StepError> {
        thread_local! { static CREDIT: RefCell<(Credit, Vec<u32>)> = RefCell::default(); }
        let leaders = self.world.leaders();
        self.check_length("scores", "[teams][leaders]", self.teams() * leaders, scores.len())?;
        scores.par_chunks_exact_mut(leaders).with_min_len(VECTORS_PER_TASK).enumerate().try_for_each(
            |(team, scores)| {
                CREDIT.with_borrow_mut(|(credit, seen)| {
                    let episode =
                        self.vectors.episode(team, &self.world, &self.moved, seen).ok_or(StepError::NotRecorded)?;
                    if fitness == Fitness::Dt && self.world.followers() > 0 && episode.trail().is_empty() {
                        return Err(StepError::NotSeen);
                    }
                    credit.score(&episode, &self.world, fitness, scores);
                    Ok(())
                })
            },
        )
    }

    fn run(&mut self, command: Command<'_>) {
        self.vectors.run(&self.world, &self.moved, command, &mut self.observations);
    }

    fn check_length(&self, what: &str, shape: &str, expected: usize, found: usize) -> Result<(), StepError> {
        let message = || StepError::Invalid(format!("{found} {what}, but {shape} are {expected}"));
        if found == expected { Ok(()) } else { Err(message()) }
    }

    /// Returns the starts of the chosen teams, with positions rounded to the grid.
    fn checked(&self, starts: &[f32], chosen: Option<&[bool]>) -> Result<Given, StepError> {
        let (teams, agents, pois) = (self.teams(), self.world.agents(), self.world.pois.len());
        let shapes = [agents + pois + agents, agents + pois];
        let each = shapes.into_iter().find(|each| starts.len() == teams * each * 2).unwrap_or(agents);
        self.check_length("coordinates", "[teams][agents][2]", teams * each * 2, starts.len())?;
        let map = self.world.map();
        let mut given = Given { starts: Vec::with_capacity(teams * agents), pois: vec![], headings: None };
        if each > agents + pois {
            given.headings = Some(Vec::with_capacity(teams * agents));
        }
        for (index, &[x, y]) in starts.as_chunks::<2>().0.iter().enumerate() {
            let (team, place) = (index / each, index % each);
            let (ignored, at) = (chosen.is_some_and(|chosen| !chosen[team]), Vec2::new(x, y));
            let on_map = ignored || (0.0..=map.x).contains(&x) && (0.0..=map.y).contains(&y);
            let settled = || if ignored { Vec2::ZERO } else { settled(at, map) };
            let invalid = |what: String| Err(StepError::Invalid(what));
            if let (Some(headings), Some(agent)) = (&mut given.headings, place.checked_sub(agents + pois)) {
                if !ignored && !(-1e-3..1e-3).contains(&(at.length_squared() - 1.0)) {
                    return invalid(format!(
                        "agent {agent} of team {team} would have the heading ({x}, {y}), which is no unit vector"
                    ));
                }
                headings.push(at);
            } else if let Some(poi) = place.checked_sub(agents) {
                if !on_map {
                    return invalid(format!(
                        "POI {poi} of team {team} would be at ({x}, {y}), which is not on the map"
                    ));
                }
                given.pois.push(settled());
            } else {
                if !on_map {
                    return invalid(format!(
                        "agent {place} of team {team} would start at ({x}, {y}), which is not on the map"
                    ));
                }
                given.starts.push(settled());
            }
        }
        Ok(given)
    }
}

/// Given starts of all teams.
struct Given {
    /// `[teams][agents]`
    starts: Vec<Vec2>,
    /// `[teams][pois]`; empty unless given.
    pois: Vec<Vec2>,
    /// Unit vectors, `[teams][agents]`.
    headings: Option<Vec<Vec2>>,
}

/// Rounds a position to the grid. A coordinate on a wall stays.
fn settled(place: Vec2, map: Vec2) -> Vec2 {
    let near = on_grid(place, map);
    let settle = |at: f32, wall: f32, near: f32| if (at * GRID).fract() == 0.0 || at == wall { at } else { near };
    Vec2::new(settle(place.x, map.x, near.x), settle(place.y, map.y, near.y))
}
