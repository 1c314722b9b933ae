//! The record of one team's episode: who was at which POI, and which leaders followers saw.

/// The record of one team's episode. Credit is computed from it.
#[derive(Clone, Copy, Debug)]
pub struct Episode<'a> {
    /// The index of its group in the batch.
    pub group: usize,
    /// The index of the team in the group.
    pub team: usize,
    /// The agents at each POI after each step, one bit per agent, `[steps][pois][words]`. If only scores were
    /// [requested](super::RecordRequest), there may be fewer steps, down to none, whose sets give the same scores; see
    /// [`crate::credit`].
    pub sets: Strided<'a>,
    /// The leaders that the followers saw.
    pub seen: Seen<'a>,
    /// The leaders that each follower saw before the move of each step, one bit per leader, `[steps][followers][words
    /// of leaders]`. Empty unless [requested](super::RecordRequest::sights).
    pub sights: Strided<'a>,
}

/// The leaders that the followers of one team saw.
#[derive(Clone, Copy, Debug)]
pub enum Seen<'a> {
    /// The number of steps at which each follower saw each leader, `[followers][leaders]`.
    Counts(Strided<'a>),
    /// The leader that each follower saw at most steps, see [`crate::credit::assign`]: [`owner_bits`] bits per
    /// follower, from the lowest of a word, all ones for nobody. Empty unless
    /// [requested](super::RecordRequest::owners).
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
    pub const NONE: Strided<'static> = Strided { words: &[], stride: 1, offset: 0 };

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
