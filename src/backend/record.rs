//! The record of one team's episode: who was at which POI, and which leaders followers saw.

/// What one team did, as far as credit needs it.
#[derive(Clone, Copy, Debug)]
pub struct Episode<'a> {
    /// Index of its group in the batch.
    pub group: usize,
    /// Index of the team in the group.
    pub team: usize,
    /// The agents near each POI after each step, a bit an agent: `[steps][pois][words]`. Where only scores are
    /// [needed](Need), there may be fewer steps, down to none, whose sets give the same scores, see [`crate::credit`].
    pub sets: Strided<'a>,
    /// Which leaders its followers saw, as counts or as what [is needed](Need) of them.
    pub seen: Seen<'a>,
    /// The leaders that each follower saw before the move of each step, a bit a leader:
    /// `[steps][followers][words of leaders]`. Empty where nobody [needs](Need::sights) it.
    pub sights: Strided<'a>,
}

/// Which leaders the followers of one team saw.
#[derive(Clone, Copy, Debug)]
pub enum Seen<'a> {
    /// At how many steps each follower saw each leader: `[followers][leaders]`.
    Counts(Strided<'a>),
    /// The leader that each follower saw at most steps, as [`crate::credit::assign`] has it: [`owner_bits`] bits a
    /// follower, all ones for nobody, from the lowest of a word on. Empty where nobody [needs](Need) it.
    Most(Strided<'a>),
}

impl<'a> Seen<'a> {
    /// The words, whichever they are.
    pub fn words(self) -> Strided<'a> {
        match self {
            Seen::Counts(words) | Seen::Most(words) => words,
        }
    }
}

/// Bits that a leader's index takes in [`Seen::Most`].
pub fn owner_bits(leaders: u32) -> u32 {
    if leaders < 255 { 8 } else { 16 }
}

/// Words of one team among those of its neighbours: word i of this team is `words[i * stride + offset]`.
#[derive(Clone, Copy, Debug)]
pub struct Strided<'a> {
    /// The words of all these teams.
    pub words: &'a [u32],
    /// How many words on a team's next word is.
    pub stride: usize,
    /// Where this team's first word is, under the stride.
    pub offset: usize,
}

impl<'a> Strided<'a> {
    /// No words.
    pub const NONE: Strided<'static> = Strided { words: &[], stride: 1, offset: 0 };

    /// All words of this team.
    pub fn iter(self) -> impl Iterator<Item = u32> + 'a {
        (0..self.len()).map(move |index| self.get(index))
    }

    /// Word `index` of this team.
    #[inline]
    pub fn get(&self, index: usize) -> u32 {
        self.words[index * self.stride + self.offset]
    }

    /// Words of each team.
    pub fn len(&self) -> usize {
        self.words.len() / self.stride
    }

    /// Whether there is no word.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
