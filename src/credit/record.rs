//! The record of one team's episode: who was at which POI, and which leaders followers saw.

use glam::Vec2;

use crate::config::Fitness;

/// The record of one team's episode. Credit is computed from it.
#[derive(Clone, Copy, Debug)]
pub struct Episode<'a> {
    /// The agents at each POI after each step, one bit per agent, `[steps][pois][words]`.
    pub sets: Strided<'a>,
    /// The number of steps at which each follower saw each leader, `[followers][leaders]`.
    pub seen: Strided<'a>,
    /// The leaders that each follower saw before the move of each step, one bit per leader, `[steps][followers][words
    /// of leaders]`. Empty unless [needed](RecordRequest::sights).
    pub sights: Strided<'a>,
    /// Where the agents were, if [scores need it](crate::world::WorldParts::paths).
    pub paths: Option<Paths<'a>>,
}

impl<'a> Episode<'a> {
    /// Returns the record of a team whose words are not interleaved with those of other teams. `trail` are the sightings, or
    /// if scores need paths, the positions; `pois` are then where the POIs were.
    pub fn whole(sets: &'a [u32], seen: &'a [u32], trail: &'a [u32], pois: Option<&'a [Vec2]>) -> Episode<'a> {
        let [sets, seen, trail] = [sets, seen, trail].map(Strided::contiguous);
        let sights = if pois.is_some() { Strided::NONE } else { trail };
        Episode { sets, seen, sights, paths: pois.map(|pois| Paths { positions: trail, pois }) }
    }

    /// Returns the sightings, or the positions of its paths.
    pub(crate) fn trail(&self) -> Strided<'a> {
        self.paths.map_or(self.sights, |paths| paths.positions)
    }
}

/// The part of a record that some fitnesses and the number of observed POIs are computed from. A record may have more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordRequest<'a>(pub &'a [Fitness]);

impl RecordRequest<'_> {
    /// Reports whether the leader that each follower saw most is needed.
    pub fn owners(self) -> bool {
        self.0.iter().any(|fitness| match fitness {
            Fitness::Df => true,
            Fitness::G | Fitness::D | Fitness::Dpp | Fitness::Dt => false,
        })
    }

    /// Reports whether the leaders that each follower saw at each step are needed.
    pub(crate) fn sights(self) -> bool {
        self.0.iter().any(|fitness| match fitness {
            Fitness::Dt => true,
            Fitness::G | Fitness::D | Fitness::Df | Fitness::Dpp => false,
        })
    }
}

/// The paths of one team: where its agents were.
#[derive(Clone, Copy, Debug)]
pub struct Paths<'a> {
    /// Positions at the start and after each step in units, f32 as bits, `[steps + 1][agents][2]`.
    pub positions: Strided<'a>,
    /// Positions of the POIs in units, `[pois]`.
    pub pois: &'a [Vec2],
}

/// The words of one team in an array that interleaves several: word i is `words[i * stride + offset]`.
#[derive(Clone, Copy, Debug)]
pub struct Strided<'a> {
    /// The words of all teams.
    pub words: &'a [u32],
    /// The number of teams, and so the distance between a team's words.
    pub stride: usize,
    /// The index of this team, less than the stride.
    pub offset: usize,
}

impl<'a> Strided<'a> {
    /// An empty view.
    pub const NONE: Strided<'static> = Strided::contiguous(&[]);

    /// Returns the view of an array that has the words of only one team.
    pub const fn contiguous(words: &'a [u32]) -> Strided<'a> {
        Strided { words, stride: 1, offset: 0 }
    }

    /// Returns all words of this team.
    pub fn iter(self) -> impl Iterator<Item = u32> + 'a {
        (0..self.len()).map(move |index| self.get(index))
    }

    /// Returns word `index` of this team.
    #[inline]
    pub fn get(&self, index: usize) -> u32 {
        self.words[index * self.stride + self.offset]
    }

    /// Returns the number of words of each team.
    pub fn len(&self) -> usize {
        self.words.len() / self.stride
    }

    /// Reports whether there are no words.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
