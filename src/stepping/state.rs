//! The state of all teams as bytes, so that environments can be saved, copied and sent to other processes.

use glam::Vec2;

use super::{Command, StepError, Stepper};
use crate::world::World;

/// The first word of a saved state, which names the format and its version.
const MAGIC: u32 = 0x3173_6c66;
/// Words before the arrays: the format, and the sizes that have to match.
const HEADER: usize = 6;

/// The part of a saved state that the vectors of teams hold, of all teams.
pub(super) struct Saved<'a> {
    /// `[teams][agents][2]`.
    pub positions: &'a [f32],
    /// `[teams][agents][2]`.
    pub headings: &'a [f32],
    /// `[teams][agents]`.
    pub speeds: &'a [f32],
    /// Whether the POIs of [`GoneWithin`](crate::world::GoneWithin) are gone, all bits or none, `[teams][gone_within]`.
    pub gone: &'a [u32],
    /// `[teams][followers][leaders]`; empty unless recorded, as are the next two.
    pub counts: &'a [u32],
    /// `[teams][steps][pois][words]`.
    pub record: &'a [u32],
    /// `[teams][steps][followers][words of leaders]`, or `[teams][steps + 1][agents][2]`.
    pub trail: &'a [u32],
}

/// Takes the arrays of a saved state one after the other.
struct Words<'a>(&'a [u32]);

impl<'a> Words<'a> {
    fn take(&mut self, count: usize) -> &'a [u32] {
        let (taken, rest) = self.0.split_at(count);
        self.0 = rest;
        taken
    }

    fn numbers(&mut self, count: usize) -> &'a [f32] {
        bytemuck::cast_slice(self.take(count))
    }
}

impl Stepper {
    /// Returns the state of all teams, for [`Stepper::restore`]. It is the same on every instruction set.
    pub fn save(&mut self) -> Vec<u8> {
        self.run(Command::Show);
        let (header, observations) = (self.header(self.moved.len() / self.teams()), &self.observations);
        let mut words = header.to_vec();
        for numbers in [&observations.positions, &observations.headings, &observations.speeds] {
            words.extend_from_slice(bytemuck::cast_slice(numbers));
        }
        words.extend_from_slice(&observations.agents_at_poi);
        for flags in [&observations.newly, &observations.observed] {
            words.extend(flags.iter().map(|&flag| u32::from(flag)));
        }
        words.extend_from_slice(&observations.steps);
        words.extend_from_slice(bytemuck::cast_slice(&self.moved));
        (0..self.teams()).for_each(|team| words.extend(self.vectors.gone(team)));
        let (mut seen, mut sets, mut trail) = (Vec::new(), Vec::new(), Vec::new());
        for team in 0..self.teams() {
            if let Some(episode) = self.vectors.episode(team, &self.world, &self.moved, &mut seen) {
                words.extend(episode.seen.iter());
                sets.extend(episode.sets.iter());
                trail.extend(episode.trail().iter());
            }
        }
        words.extend_from_slice(&sets);
        words.extend_from_slice(&trail);
        words.iter_mut().for_each(|word| *word = word.to_le());
        bytemuck::cast_slice(&words).to_vec()
    }

    /// Puts all teams into a state that [`Stepper::save`] returned for the same world and number of teams, and the same
    /// kind of record. They continue with the same bits.
    ///
    /// # Errors
    /// The state is of another world or kind of stepper, or it is damaged. No team has changed then.
    pub fn restore(&mut self, state: &[u8]) -> Result<(), StepError> {
        let words: Vec<u32> = state.as_chunks::<4>().0.iter().map(|&bytes| u32::from_le_bytes(bytes)).collect();
        let (world, teams) = (&self.world, self.teams());
        let (agents, pois) = (world.agents(), world.pois.len());
        let moved = if words.get(HEADER - 1) == Some(&0) { 0 } else { pois };
        let header = self.header(moved);
        let [_, _, _, record, trail, _] = header.map(|size| size as usize);
        let counts = if record > 0 { world.followers() * world.leaders() } else { 0 };
        let (sets, gone_within) = (pois * world.constants.words as usize, world.gone_within.len());
        let of_team = agents * 5 + sets + pois * 2 + 1 + moved * 2 + gone_within + counts + record + trail;
        if words.get(..HEADER) != Some(&header) || state.len() != (HEADER + teams * of_team) * 4 {
            return Err(StepError::State("it is of another world, number of teams or kind of record"));
        }
        let mut words = Words(&words[HEADER..]);
        let [positions, headings] = [(); 2].map(|()| words.numbers(teams * agents * 2));
        let speeds = words.numbers(teams * agents);
        let agents_at_poi = words.take(teams * sets);
        let [newly, observed] = [(); 2].map(|()| words.take(teams * pois));
        let steps = words.take(teams);
        let moved: &[Vec2] = bytemuck::cast_slice(words.numbers(teams * moved * 2));
        let saved = Saved {
            positions,
            headings,
            speeds,
            gone: words.take(teams * gone_within),
            counts: words.take(teams * counts),
            record: words.take(teams * record),
            trail: words.take(teams * trail),
        };
        check(world, agents_at_poi, &saved, moved)?;
        if newly.iter().chain(observed).any(|&flag| flag > 1)
            || saved.gone.iter().any(|&gone| gone != 0 && gone != u32::MAX)
            || steps.iter().any(|&step| step > world.constants.steps)
        {
            return Err(StepError::State("a step or flag is out of range"));
        }
        self.moved = moved.to_vec();
        self.observations.agents_at_poi.copy_from_slice(agents_at_poi);
        self.observations.newly.iter_mut().zip(newly).for_each(|(to, &flag)| *to = flag == 1);
        self.observations.observed.iter_mut().zip(observed).for_each(|(to, &flag)| *to = flag == 1);
        self.observations.steps.copy_from_slice(steps);
        self.run(Command::Restore(&saved));
        Ok(())
    }

    /// Returns the format, and the sizes that a saved state has to match: teams, agents, and each team's words of
    /// record, trail and moved POIs.
    fn header(&self, moved: usize) -> [u32; HEADER] {
        let mut seen = Vec::new();
        let episode = self.vectors.episode(0, &self.world, &self.moved, &mut seen);
        let [record, trail] = episode.map_or([0, 0], |episode| [episode.sets.len(), episode.trail().len()]);
        [MAGIC, self.teams() as u32, self.world.agents() as u32, record as u32, trail as u32, moved as u32]
    }
}

/// Checks that all numbers and sets are in the range of a state that was played. `agents_at_poi` has the agents at each POI.
fn check(world: &World, agents_at_poi: &[u32], saved: &Saved<'_>, moved: &[Vec2]) -> Result<(), StepError> {
    let map = world.map();
    let on_map = |place: &[f32]| (0.0..=map.x).contains(&place[0]) && (0.0..=map.y).contains(&place[1]);
    let unit = |heading: &[f32]| (libm::hypotf(heading[0], heading[1]) - 1.0).abs() < 0.01;
    if !saved.positions.chunks_exact(2).all(on_map) || !moved.iter().all(|place| on_map(&place.to_array())) {
        return Err(StepError::State("a position is off the map"));
    }
    if !saved.headings.chunks_exact(2).all(unit) || !saved.speeds.iter().all(|speed| speed.is_finite()) {
        return Err(StepError::State("a heading or speed is out of range"));
    }
    // Scores use the members of sets as indices.
    let agents = |sets: &[u32]| has_only(world.agents(), sets);
    let is_seen = world.paths.is_some() || has_only(world.leaders(), saved.trail);
    if !agents(agents_at_poi) || !agents(saved.record) || !is_seen {
        return Err(StepError::State("a set has an agent that does not exist"));
    }
    Ok(())
}

/// Reports whether sets of bits, each of as many words as `members` need, have no bit beyond the last member.
fn has_only(members: usize, sets: &[u32]) -> bool {
    let (words, used) = (members.div_ceil(32), members % 32);
    used == 0 || sets.chunks_exact(words).all(|set| set[words - 1] >> used == 0)
}
