//! Step by step: teams whose leaders do what the caller says, on the CPU.
//!
//! A [`Stepper`] plays the episodes of [`crate::backend`], by the same kernels on the same vectors of teams, but in
//! place of policies' answers it takes actions. Given a policy's own answers, it comes to the bits of
//! [`Backend::trace`](crate::backend::Backend::trace).
//!
//! ```
//! use flotilla::{config::Config, stepping::Stepper, world::World};
//!
//! let config = Config::parse(include_str!("../configs/generally_forward.toml"), "generally_forward.toml")?;
//! let mut stepper = Stepper::new(World::new(&config), 64)?;
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

use crate::config::{Fitness, MAX_POPULATION};
use crate::credit::{Credit, Scores};
use crate::parallel::*;
use crate::world::{GRID, INPUTS, OUTPUTS, World, on_grid};

mod engine;

use engine::{FEW, Shown, Vectors, vectors};

/// Teams of one world, each at a step of its own.
///
/// Arrays are flat and stay where they are from step to step; their shapes are written `[teams][leaders][8]`, the last
/// index moving fastest. Agents are counted leaders first.
pub struct Stepper {
    world: World,
    vectors: Box<dyn Vectors>,
    shown: Shown,
}

/// Where all agents are.
#[derive(Clone, Copy, Debug)]
pub struct States<'a> {
    /// `[teams][agents][2]`: x and y on the map.
    pub positions: &'a [f32],
    /// `[teams][agents][2]`: unit vectors.
    pub headings: &'a [f32],
    /// `[teams][agents]`.
    pub speeds: &'a [f32],
}

/// Why teams could not be made, started, stepped or scored. They are then as they were.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StepError {
    /// No team, or more than there may be.
    #[error("{0} teams; there may be 1 to {MAX_POPULATION}")]
    Teams(usize),
    /// A world that [`World::new`] did not make of a valid config.
    #[error("the world's {0} do not fit its numbers of agents and POIs")]
    World(&'static str),
    /// The system gives no memory for them.
    #[error("there is no memory for {teams} teams, {bytes} bytes")]
    Memory {
        /// How many were asked for.
        teams: usize,
        /// What these take.
        bytes: u128,
    },
    /// An array of another length.
    #[error("{found} {what}, but {shape} are {expected}")]
    Length {
        /// What it holds.
        what: &'static str,
        /// Its indices.
        shape: &'static str,
        /// How many numbers that makes.
        expected: usize,
        /// How many were given.
        found: usize,
    },
    /// An action that is infinite or no number.
    #[error("the {} of leader {leader} in team {team} is {value}, which is no finite number", ["turn", "speed"][*.output])]
    Action {
        /// Which team, from 0.
        team: usize,
        /// Which leader of it, from 0.
        leader: usize,
        /// 0 for the turn, 1 for the speed.
        output: usize,
        /// What was given.
        value: f32,
    },
    /// A start that is not on the map.
    #[error("agent {agent} of team {team} would start at ({}, {}), which is not on the map", at[0], at[1])]
    Start {
        /// Which team, from 0.
        team: usize,
        /// Which agent of it, leaders first.
        agent: usize,
        /// Where, in units.
        at: [f32; 2],
    },
    /// A team that there is not.
    #[error("team {team} of {teams} (they count from 0)")]
    NoTeam {
        /// Which team, from 0.
        team: usize,
        /// How many there are.
        teams: usize,
    },
    /// Scores need a record, which [`Stepper::recording`] keeps.
    #[error("no record was kept to score teams by")]
    NotRecorded,
    /// Dt needs a record of sights, which [`Stepper::with_sights`] keeps.
    #[error("no record was kept of who saw whom at which step, which Dt asks; make the stepper `with_sights`")]
    NotSeen,
}

impl Stepper {
    /// So many teams, all at the world's start. No record is kept.
    ///
    /// # Errors
    /// No team or more than [`MAX_POPULATION`], or there is no memory for them.
    pub fn new(world: World, teams: usize) -> Result<Stepper, StepError> {
        Stepper::at_level(Level::new(), world, teams, false)
    }

    /// So many teams, all at the world's start, with a record of who was near which POI at which step, by which
    /// [`Stepper::scores`] and [`Stepper::fitness`] tell what each leader was worth.
    ///
    /// # Errors
    /// No team or more than [`MAX_POPULATION`], or there is no memory for them.
    pub fn recording(world: World, teams: usize) -> Result<Stepper, StepError> {
        Stepper::at_level(Level::new(), world, teams, true)
    }

    /// [`Stepper::new`] or [`Stepper::recording`], by a chosen instruction set (tests compare them; benches choose
    /// one).
    ///
    /// # Errors
    /// No team or more than [`MAX_POPULATION`], or there is no memory for them.
    pub fn at_level(level: Level, world: World, teams: usize, recording: bool) -> Result<Stepper, StepError> {
        if !(1..=MAX_POPULATION).contains(&teams) {
            return Err(StepError::Teams(teams));
        }
        if let Err(field) = world.validate() {
            return Err(StepError::World(field));
        }
        let (agents, leaders, pois) = (world.agents(), world.leaders(), world.pois.len());
        let words = world.constants.words as usize;
        // Asked for first, since later a refusal would be an abort: a team's numbers, in the vectors and as shown.
        let record = if recording { world.set_words() } else { 0 };
        let in_vectors = agents * 6 + leaders * (INPUTS + OUTPUTS) + world.followers() * (11 + leaders) + pois * words;
        let numbers = in_vectors + record + leaders * INPUTS + agents * 5 + pois * (words + 1) + 1;
        let bytes = numbers as u128 * 4 * teams as u128;
        usize::try_from(bytes)
            .ok()
            .and_then(|bytes| Vec::<u8>::new().try_reserve_exact(bytes).ok())
            .ok_or(StepError::Memory { teams, bytes })?;
        let vectors = dispatch!(level, simd => vectors(simd, &world, teams, record));
        let shown = Shown {
            inputs: vec![0.0; teams * leaders * INPUTS],
            near: vec![0; teams * pois * words],
            newly: vec![false; teams * pois],
            observed: vec![false; teams * pois],
            steps: vec![0; teams],
            positions: vec![0.0; teams * agents * 2],
            headings: vec![0.0; teams * agents * 2],
            speeds: vec![0.0; teams * agents],
        };
        let mut stepper = Stepper { world, vectors, shown };
        stepper.reset();
        Ok(stepper)
    }

    /// The same, all at the world's start, with a record of which leaders each follower saw at which step, too, for Dt.
    ///
    /// # Errors
    /// There is no memory for it.
    pub fn with_sights(mut self) -> Result<Stepper, StepError> {
        let teams = self.teams();
        let bytes = self.world.sight_words() as u128 * 4 * teams as u128;
        usize::try_from(bytes)
            .ok()
            .and_then(|bytes| Vec::<u8>::new().try_reserve_exact(bytes).ok())
            .ok_or(StepError::Memory { teams, bytes })?;
        self.vectors.keep_sights(&self.world);
        self.reset();
        Ok(self)
    }

    /// The world that all teams are in.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// How many teams there are.
    pub fn teams(&self) -> usize {
        self.shown.steps.len()
    }

    /// Puts all teams at the world's start.
    pub fn reset(&mut self) {
        self.vectors.reset(&self.world, None, None, &mut self.shown);
    }

    /// Puts all teams where they are told to start, `[teams][agents][2]`, each place moved to the nearest one of the
    /// kernels' grid (within 2^-19). [`crate::evaluate::Starts`] draws such places.
    ///
    /// # Errors
    /// Too few or too many numbers, or a place that is not on the map.
    pub fn reset_to(&mut self, starts: &[f32]) -> Result<(), StepError> {
        let starts = self.checked(starts, None)?;
        self.vectors.reset(&self.world, None, Some(&starts), &mut self.shown);
        Ok(())
    }

    /// Puts the chosen teams, `[teams]`, at the world's start or where they are told to, as [`Stepper::reset_to`] does;
    /// the others' places are not looked at, and they stay as they are.
    ///
    /// # Errors
    /// Too few or too many choices or numbers, or a place that is not on the map.
    pub fn reset_some(&mut self, chosen: &[bool], starts: Option<&[f32]>) -> Result<(), StepError> {
        self.check_length("choices", "[teams]", self.teams(), chosen.len())?;
        let starts = starts.map(|starts| self.checked(starts, Some(chosen))).transpose()?;
        self.vectors.reset(&self.world, Some(chosen), starts.as_deref(), &mut self.shown);
        Ok(())
    }

    /// Plays one step by what every leader is to do, `[teams][leaders][2]`: a turn, in parts of a half turn to the
    /// left, and a speed, from -1 for standing still to 1 for the highest. Numbers beyond -1..1 are taken as -1 or 1.
    /// Where policies of the world choose behaviours, these are still the actions: each behaviour comes to a turn of 0,
    /// ±0.25 or ±0.75 and a speed of -1 or 1, see [`crate::model::policy::choose`].
    ///
    /// A team that has played its last step stays as it is, whatever is asked of it, until it is reset.
    ///
    /// # Errors
    /// Too few or too many numbers, or one that is not finite; no team has moved then.
    pub fn step(&mut self, actions: &[f32]) -> Result<(), StepError> {
        let leaders = self.world.leaders();
        let expected = self.teams() * leaders * OUTPUTS;
        self.check_length("actions", "[teams][leaders][2]", expected, actions.len())?;
        // All at once, which is quick; where the bad one is, is looked for only if there is one.
        if !actions.iter().fold(true, |finite, action| finite & action.is_finite()) {
            let index = actions.iter().position(|action| !action.is_finite()).unwrap_or(0);
            let (leader, output) = (index / OUTPUTS, index % OUTPUTS);
            return Err(StepError::Action {
                team: leader / leaders,
                leader: leader % leaders,
                output,
                value: actions[index],
            });
        }
        self.vectors.step(&self.world, actions, &mut self.shown);
        Ok(())
    }

    /// What every leader senses where it is, `[teams][leaders][8]`: the density of POIs, then of agents, in four
    /// quadrants around its heading, back right, front right, front left, back left.
    pub fn inputs(&self) -> &[f32] {
        &self.shown.inputs
    }

    /// The agents near each POI after the last step, `[teams][pois][words]`, a bit an agent, 32 a word. A start counts
    /// for nothing: before its first step a team is near none.
    pub fn near(&self) -> &[u32] {
        &self.shown.near
    }

    /// The POIs that were observed for the first time by the last step, `[teams][pois]`.
    pub fn newly_observed(&self) -> &[bool] {
        &self.shown.newly
    }

    /// The POIs that have been observed since the start, `[teams][pois]`.
    pub fn observed(&self) -> &[bool] {
        &self.shown.observed
    }

    /// How many steps each team has played since its start, `[teams]`: after as many as the world's, its episode is
    /// over.
    pub fn steps(&self) -> &[u32] {
        &self.shown.steps
    }

    /// Whether a team has played its last step; a team that there is not never does.
    pub fn is_over(&self, team: usize) -> bool {
        self.shown.steps.get(team).is_some_and(|&step| step as usize >= self.world.steps())
    }

    /// Where everyone is, worked out now.
    pub fn states(&mut self) -> States<'_> {
        self.vectors.states(&self.world, &mut self.shown);
        let Shown { positions, headings, speeds, .. } = &self.shown;
        States { positions, headings, speeds }
    }

    /// Every fitness of a team's episode as far as it has been played; Dt only with a record [of
    /// sights](Stepper::with_sights), or where nobody follows.
    ///
    /// # Errors
    /// There is no such team, or no record was kept.
    pub fn scores(&self, team: usize) -> Result<Scores, StepError> {
        if team >= self.teams() {
            return Err(StepError::NoTeam { team, teams: self.teams() });
        }
        let mut seen = Vec::new();
        let episode = self.vectors.episode(team, &self.world, &mut seen).ok_or(StepError::NotRecorded)?;
        Ok(Credit::default().all(&episode, &self.world))
    }

    /// What every leader was worth, by one fitness, as far as its team's episode has been played: `[teams][leaders]`.
    ///
    /// # Errors
    /// There is room for fewer or more numbers, no record was kept, or none of sights for Dt.
    pub fn fitness(&self, fitness: Fitness, scores: &mut [f32]) -> Result<(), StepError> {
        thread_local! { static CREDIT: RefCell<(Credit, Vec<u32>)> = RefCell::default(); }
        let leaders = self.world.leaders();
        self.check_length("scores", "[teams][leaders]", self.teams() * leaders, scores.len())?;
        scores.par_chunks_exact_mut(leaders).with_min_len(FEW).enumerate().try_for_each(|(team, scores)| {
            CREDIT.with_borrow_mut(|(credit, seen)| {
                let episode = self.vectors.episode(team, &self.world, seen).ok_or(StepError::NotRecorded)?;
                if fitness == Fitness::Dt && self.world.followers() > 0 && episode.sights.is_empty() {
                    return Err(StepError::NotSeen);
                }
                credit.score(&episode, &self.world, fitness, scores);
                Ok(())
            })
        })
    }

    fn check_length(
        &self,
        what: &'static str,
        shape: &'static str,
        expected: usize,
        found: usize,
    ) -> Result<(), StepError> {
        if found == expected { Ok(()) } else { Err(StepError::Length { what, shape, expected, found }) }
    }

    /// The start positions of the chosen teams, on the grid.
    fn checked(&self, starts: &[f32], chosen: Option<&[bool]>) -> Result<Vec<Vec2>, StepError> {
        let (agents, constants) = (self.world.agents(), &self.world.constants);
        self.check_length("coordinates", "[teams][agents][2]", self.teams() * agents * 2, starts.len())?;
        let map = Vec2::new(constants.motion.map_x, constants.motion.map_y);
        let mut placed = Vec::with_capacity(self.teams() * agents);
        for (index, &[x, y]) in starts.as_chunks::<2>().0.iter().enumerate() {
            let (team, agent) = (index / agents, index % agents);
            let on_map = (0.0..=map.x).contains(&x) && (0.0..=map.y).contains(&y);
            if chosen.is_some_and(|chosen| !chosen[team]) {
                placed.push(Vec2::ZERO);
            } else if on_map {
                placed.push(settled(Vec2::new(x, y), map));
            } else {
                return Err(StepError::Start { team, agent, at: [x, y] });
            }
        }
        Ok(placed)
    }
}

/// The place itself where it is on the grid or a wall, coordinate by coordinate, else the nearest on the grid.
fn settled(place: Vec2, map: Vec2) -> Vec2 {
    let near = on_grid(place, map);
    let settle = |at: f32, wall: f32, near: f32| if (at * GRID).fract() == 0.0 || at == wall { at } else { near };
    Vec2::new(settle(place.x, map.x, near.x), settle(place.y, map.y, near.y))
}
