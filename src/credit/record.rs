//! The record of one team's episode: who was at which POI, and which leaders followers saw.

use glam::Vec2;

use crate::config::Fitness;

/// The record of one team's episode. Credit is computed from it.
#[derive(Clone, Copy, Debug)]
pub struct Episode<'a> {
    /// The agents at each POI after each step, one bit per agent, `[steps][pois][words]`. There may be fewer steps,
    /// down to none, whose sets give the same scores; see [`RecordRequest`].
    pub sets: Strided<'a>,
    /// The leaders that the followers saw.
    pub seen: Seen<'a>,
    /// The leaders that each follower saw before the move of each step, one bit per leader, `[steps][followers][words
    /// of leaders]`. Empty unless [needed](RecordRequest::sights).
    pub sights: Strided<'a>,
    /// Where the agents were, if [scores need it](crate::world::WorldParts::paths).
    pub paths: Option<Paths<'a>>,
}

impl<'a> Episode<'a> {
    /// Returns the record of a team whose words are not interleaved with those of other teams.
    pub fn whole(sets: &'a [u32], counts: &'a [u32], sights: &'a [u32]) -> Episode<'a> {
        let [sets, counts, sights] = [sets, counts, sights].map(Strided::contiguous);
        Episode { sets, seen: Seen::Counts(counts), sights, paths: None }
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
    /// Returns the minimum number of agents in a set that can affect a score, at a POI of this coupling. `None` if the
    /// sets of all steps are needed.
    pub fn min_agents(self, coupling: u32) -> Option<u32> {
        let min_agents = |fitness: &Fitness| match fitness {
            // Dt depends on when sets occur.
            Fitness::Dt => None,
            // D++ depends on how many agents are missing.
            Fitness::Dpp => Some(1),
            Fitness::G | Fitness::D | Fitness::Df => Some(coupling),
        };
        self.0.iter().map(min_agents).try_fold(coupling, |min, needed| Some(min.min(needed?)))
    }

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

/// The leaders that the followers of one team saw.
#[derive(Clone, Copy, Debug)]
pub enum Seen<'a> {
    /// The number of steps at which each follower saw each leader, `[followers][leaders]`.
    Counts(Strided<'a>),
    /// The leader that each follower saw at most steps, see [`assign`](super::assign): [`owner_bits`] bits per
    /// follower, from the lowest of a word, all ones for nobody. Empty unless [needed](RecordRequest::owners).
    Owners(Strided<'a>),
}

impl<'a> Seen<'a> {
    /// Returns the words of either form.
    pub fn words(self) -> Strided<'a> {
        match self {
            Seen::Counts(words) | Seen::Owners(words) => words,
        }
    }
}

/// Returns the bits per follower in [`Seen::Owners`].
pub fn owner_bits(leaders: u32) -> u32 {
    if leaders < 255 { 8 } else { 16 }
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
