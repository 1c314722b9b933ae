//! Structural credit assignment: what each leader was worth to its team, from the record of one episode.
//!
//! Every fitness is a share of the world's P POIs, so it is counted in whole POIs and divided once. Nothing is
//! simulated again: who stood near a POI at which step says what would have been observed without a leader, without
//! its whole group, without those that it led at each step, or with more of it.
//!
//! By the default [`Rule`](crate::model::couple::Rule) no fitness but Dt asks when a set stood, nor how often. Nor does
//! a set make a difference to them that another set of its POI holds as a subset: without whomever, and with however
//! many copies of whomever, the larger one still has at least as many agents. So of a record only the sets matter that
//! no other of their POI contains; and of these, but for D++, only those with as many agents as the POI needs. A
//! backend may leave out the others, see [`crate::backend::Need`]. Dt, and rules that ask when, take the whole record.

use std::ops::RangeInclusive;

use crate::backend::{Episode, Seen, Strided, owner_bits};
use crate::config::{Fitness, LedBy};
use crate::model::couple::NEVER;
use crate::world::{Led, World};

/// Owner of an agent that belongs to no group.
pub const NOBODY: u32 = u32::MAX;

/// Every fitness of one team; the differences are `[leaders]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// POIs that were observed: by the default rule, that at some step had as many agents near as they need.
    pub observed: u32,
    /// Observed POIs over P, the same for every leader (paper, Equation 1).
    pub g: f32,
    /// G less G without the leader (paper, Equation 5; "leader trajectory removal").
    pub d: Vec<f32>,
    /// G less G without the leader and its followers (paper, section 4.2; "leader-follower trajectory assignment").
    pub df: Vec<f32>,
    /// D, or what copies of the leader would add, each its share (Rahmattalabi et al., the paper's reference 12).
    pub dpp: Vec<f32>,
    /// G less G without the leader and, at each step, the followers that it [leads](lead) then. Empty where the
    /// [sights](Episode::sights) were not recorded, unless nobody follows: then it is D.
    pub dt: Vec<f32>,
}

/// Scratch for scoring one episode after another without allocating; one a thread.
#[derive(Clone, Debug, Default)]
pub struct Credit {
    /// Was the POI observed? `[pois]`
    observed: Vec<bool>,
    /// The leaders without any one of whom (D), or of whose groups (Df), an observed POI is lost: `[pois][words]`.
    critical: Vec<u32>,
    /// POIs lost without the leader, `[leaders]`.
    lost: Vec<u32>,
    /// The leader in whose group an agent is, itself for a leader, or [`NOBODY`]: `[agents]`.
    owner: Vec<u32>,
    /// The agents of each leader's group, or nothing before they are needed, `[leaders][words]`.
    groups: Vec<u32>,
    /// Most agents near the POI at a step with the leader among them, `[pois][leaders]`.
    company: Vec<u32>,
    /// Unobserved POIs that a number of copies of one leader would just complete, `[copies]`.
    completed: Vec<u32>,
    /// One set and the one before it, `[2][words]`.
    sets: Vec<u32>,
    /// By another rule than the default: the step at which each POI was observed, and would be otherwise, `[pois]`.
    observed_at: Vec<u32>,
    otherwise: Vec<u32>,
    /// See [`lead`].
    led: Vec<u32>,
}

impl Credit {
    /// Scores every leader of the team by `fitness` into `scores`, `[leaders]`, and returns how many POIs the team
    /// observed. The episode must be one of `world`, played with that fitness as a [need](crate::backend::Need).
    pub fn score(&mut self, episode: &Episode<'_>, world: &World, fitness: Fitness, scores: &mut [f32]) -> u32 {
        if !world.rule.is_plain() || fitness == Fitness::Dt {
            return self.replay(episode, world, fitness, scores);
        }
        self.observed.clear();
        self.observed.resize(world.pois.len(), false);
        let pois = world.pois.len();
        match fitness {
            Fitness::G => {
                self.observe(episode, world);
                scores.fill(share(self.count_observed(), pois));
            }
            Fitness::D | Fitness::Df => {
                match fitness == Fitness::Df && world.followers() > 0 {
                    true => self.lose_groups(episode, world),
                    false => self.lose_leaders(episode, world),
                }
                self.count_lost(world);
                scores.iter_mut().zip(&self.lost).for_each(|(score, &lost)| *score = share(lost, pois));
            }
            Fitness::Dt => unreachable!("it was replayed"),
            Fitness::Dpp => {
                self.add_copies(episode, world);
                self.count_lost(world);
                for (leader, score) in scores.iter_mut().enumerate().take(world.leaders()) {
                    *score = self.stepping_stone(world, leader);
                }
            }
        }
        self.count_observed()
    }

    /// Every fitness of every leader. The episode must be one of `world`, played with all scores or the record as a
    /// need.
    pub fn all(&mut self, episode: &Episode<'_>, world: &World) -> Scores {
        let leaders = world.leaders();
        let mut by = |fitness| {
            let mut scores = vec![0.0; leaders];
            let observed = self.score(episode, world, fitness, &mut scores);
            (observed, scores)
        };
        let ((observed, d), (_, df), (_, dpp)) = (by(Fitness::D), by(Fitness::Df), by(Fitness::Dpp));
        let dt = match (world.followers(), episode.sights.is_empty()) {
            (0, _) => d.clone(),
            (_, true) => vec![],
            (_, false) => by(Fitness::Dt).1,
        };
        Scores { observed, g: share(observed, world.pois.len()), d, df, dpp, dt }
    }

    /// Which POIs were observed.
    fn observe(&mut self, episode: &Episode<'_>, world: &World) {
        let Credit { observed, sets, .. } = self;
        each_set(&episode.sets, world, sets, |poi| world.coupling[poi], |poi, _, _| observed[poi] = true);
    }

    /// A POI is lost without an agent who was in every set that was large enough, each without one to spare.
    fn lose_leaders(&mut self, episode: &Episode<'_>, world: &World) {
        self.all_critical(world);
        let Credit { observed, critical, sets, .. } = self;
        let least = |poi: usize| world.coupling[poi];
        each_set(&episode.sets, world, sets, least, |poi, size, set| {
            observed[poi] = true;
            narrow(&mut critical[poi * set.len()..][..set.len()], set, size == world.coupling[poi]);
        });
    }

    /// A POI is lost without a group of whom every set that was large enough had more members than agents to spare.
    fn lose_groups(&mut self, episode: &Episode<'_>, world: &World) {
        self.all_critical(world);
        let Credit { observed, critical, owner, groups, sets, .. } = self;
        let words = world.constants.words as usize;
        groups.clear();
        let least = |poi: usize| world.coupling[poi];
        each_set(&episode.sets, world, sets, least, |poi, size, set| {
            observed[poi] = true;
            let spare = size - world.coupling[poi];
            for (index, critical) in critical[poi * words..][..words].iter_mut().enumerate() {
                let mut suspects = *critical;
                if suspects != 0 && groups.is_empty() {
                    assign(&episode.seen, world, owner);
                    gather(owner, world, groups);
                }
                while suspects != 0 {
                    let leader = index * 32 + suspects.trailing_zeros() as usize;
                    let group = &groups[leader * words..][..words];
                    let members: u32 = group.iter().zip(set).map(|(group, set)| (group & set).count_ones()).sum();
                    if members <= spare {
                        *critical &= !(1 << (leader % 32));
                    }
                    suspects &= suspects - 1;
                }
            }
        });
    }

    /// What [`Credit::lose_leaders`] finds, and how close each leader came to every other POI.
    fn add_copies(&mut self, episode: &Episode<'_>, world: &World) {
        self.all_critical(world);
        let leaders = world.leaders();
        self.company.clear();
        self.company.resize(world.pois.len() * leaders, 0);
        let Credit { observed, critical, company, sets, .. } = self;
        each_set(
            &episode.sets,
            world,
            sets,
            |_| 1,
            |poi, size, set| {
                if size >= world.coupling[poi] {
                    observed[poi] = true;
                    narrow(&mut critical[poi * set.len()..][..set.len()], set, size == world.coupling[poi]);
                } else if !observed[poi] {
                    for leader in bits(set).take_while(|&agent| agent < leaders) {
                        let most = &mut company[poi * leaders + leader];
                        *most = size.max(*most);
                    }
                }
            },
        );
    }

    /// D++ of one leader.
    fn stepping_stone(&mut self, world: &World, leader: usize) -> f32 {
        let most = world.coupling.iter().copied().max().unwrap_or(0);
        self.completed.clear();
        self.completed.resize(most as usize + 1, 0);
        let mut at_most = 0u32;
        for (poi, &coupling) in world.coupling.iter().enumerate() {
            let company = self.company[poi * world.leaders() + leader];
            if !self.observed[poi] && company > 0 {
                self.completed[(coupling - company) as usize] += 1;
                at_most += 1;
            }
        }
        // Copies needed are under the largest coupling, so that many complete all that any number would.
        let mut gain = 0;
        stepping_stone(self.lost[leader], most, at_most, world.pois.len(), |copies| {
            gain += self.completed[copies as usize];
            gain
        })
    }

    /// Before any large enough set, every leader may be critical.
    fn all_critical(&mut self, world: &World) {
        let (leaders, words) = (world.leaders(), world.constants.words as usize);
        // Bits past the last leader stay out.
        let of_word =
            |word: usize| u32::MAX.checked_shl(leaders.saturating_sub(word * 32) as u32).map_or(u32::MAX, |v| !v);
        self.critical.clear();
        self.critical.extend((0..world.pois.len() * words).map(|index| of_word(index % words)));
    }

    fn count_observed(&self) -> u32 {
        self.observed.iter().filter(|&&observed| observed).count() as u32
    }

    /// Counts the observed POIs to which each leader was critical.
    fn count_lost(&mut self, world: &World) {
        let (leaders, words) = (world.leaders(), world.constants.words as usize);
        self.lost.clear();
        self.lost.resize(leaders, 0);
        for (critical, _) in self.critical.chunks_exact(words).zip(&self.observed).filter(|&(_, &observed)| observed) {
            bits(critical).for_each(|leader| self.lost[leader] += 1);
        }
    }
}

/// By any other rule than the default, and Dt.
impl Credit {
    /// [`Credit::score`], each fitness by its definition.
    fn replay(&mut self, episode: &Episode<'_>, world: &World, fitness: Fitness, scores: &mut [f32]) -> u32 {
        let Credit { owner, groups, observed_at, otherwise, led, .. } = self;
        let (pois, words, leaders) = (world.pois.len(), world.constants.words as usize, world.leaders());
        let replay = Replay { sets: episode.sets, world };
        replay.observe(observed_at);
        let observed = count(observed_at);
        // Whom else D takes out; nobody is missed where nothing was observed.
        let taken = if world.followers() == 0 || observed == 0 { Fitness::D } else { fitness };
        match taken {
            Fitness::Df => {
                assign(&episode.seen, world, owner);
                groups.clear();
                gather(owner, world, groups);
            }
            Fitness::Dt => lead(&episode.sights, world, led),
            _ => {}
        }
        for (leader, score) in scores.iter_mut().enumerate().take(leaders) {
            let mut lost = || {
                let alone = |_, word, agents| agents & !alone(leader, word);
                match taken {
                    Fitness::Df => {
                        let group = &groups[leader * words..][..words];
                        replay.observe_without(observed_at, |_, word, agents| agents & !group[word], otherwise);
                    }
                    Fitness::Dt => {
                        let stay = |step, word, agents| {
                            let follow = each_bit(alone(step, word, agents)).filter(|bit| {
                                let agent = word * 32 + bit;
                                agent < leaders || !leads(led, world, step as usize - 1, agent - leaders, leader)
                            });
                            follow.map(|bit| 1 << bit).sum()
                        };
                        replay.observe_without(observed_at, stay, otherwise);
                    }
                    _ => replay.observe_without(observed_at, alone, otherwise),
                }
                observed - count(otherwise)
            };
            *score = match fitness {
                Fitness::G => share(observed, pois),
                Fitness::D | Fitness::Df | Fitness::Dt => share(lost(), pois),
                Fitness::Dpp => {
                    let (lost, most) = (lost(), world.coupling.iter().copied().max().unwrap_or(0));
                    let mut gain = |copies| {
                        replay.observe_with(observed_at, leader, copies, otherwise);
                        count(otherwise) - observed
                    };
                    stepping_stone(lost, most, gain(most), pois, gain)
                }
            };
        }
        observed
    }
}

/// Which leaders lead each follower at each step, laid out as the sights are, `[steps][followers][words of leaders]`:
/// of those that the follower saw at the steps that [count](crate::world::Led), the one that it saw at most, ties to
/// the lower index, or all.
pub fn lead(sights: &Strided<'_>, world: &World, led: &mut Vec<u32>) {
    let (followers, words) = (world.followers(), world.leader_words());
    let (steps, Led { within, by }) = (sights.len() / (followers * words).max(1), world.led);
    led.clear();
    led.resize(sights.len(), 0);
    let mut counts = vec![0u32; world.leaders()];
    for follower in 0..followers {
        counts.fill(0);
        for step in 0..steps {
            let place = |step: usize| (step * followers + follower) * words;
            let seen = |step: usize| {
                (0..words)
                    .flat_map(move |word| each_bit(sights.get(place(step) + word)).map(move |bit| word * 32 + bit))
            };
            seen(step).for_each(|leader| counts[leader] += 1);
            if within > 0 && step >= within {
                seen(step - within).for_each(|leader| counts[leader] -= 1);
            }
            let leading = &mut led[place(step)..][..words];
            let mut lead = |leader: usize| leading[leader / 32] |= 1 << (leader % 32);
            let mut counted = counts.iter().enumerate().filter(|(_, count)| **count > 0);
            match by {
                LedBy::AnySeen => counted.for_each(|(leader, _)| lead(leader)),
                LedBy::MostSeen => {
                    let first = counted.next();
                    let most =
                        first.map(|first| counted.fold(first, |most, next| if next.1 > most.1 { next } else { most }));
                    most.into_iter().for_each(|(leader, _)| lead(leader));
                }
            }
        }
    }
}

/// Whether a leader leads a follower at a step, from 0, as [`lead`] found.
pub fn leads(led: &[u32], world: &World, step: usize, follower: usize, leader: usize) -> bool {
    let place = (step * world.followers() + follower) * world.leader_words() + leader / 32;
    led[place] >> (leader % 32) & 1 != 0
}

/// Who was near which POI at which step, by a rule that is replayed.
#[derive(Clone, Copy)]
struct Replay<'a> {
    sets: Strided<'a>,
    world: &'a World,
}

impl Replay<'_> {
    /// How many observers are near a POI after a step, of those of each word that `stay` lets stay.
    fn near(&self, poi: usize, step: u32, stay: impl Fn(usize, u32) -> u32) -> u32 {
        let Replay { sets, world } = self;
        let words = world.constants.words as usize;
        let first = ((step as usize - 1) * world.pois.len() + poi) * words;
        world.rule.count((0..words).map(|word| stay(word, sets.get(first + word))))
    }

    /// At which step each POI is observed, where it has `enough` agents after one, which is asked for the steps that
    /// are `worth` asking among those at which the rule lets it be.
    fn play(
        &self,
        observed_at: &mut Vec<u32>,
        worth: impl Fn(usize, RangeInclusive<u32>) -> RangeInclusive<u32>,
        near: impl Fn(usize, u32) -> u32,
    ) {
        let Replay { sets, world } = self;
        let pois = world.pois.len();
        observed_at.clear();
        observed_at.resize(pois, NEVER);
        let steps = sets.len() / (pois * world.constants.words as usize);
        world.rule.observe(steps as u32, observed_at, |poi, open| {
            worth(poi, open).find(|&step| near(poi, step) >= world.coupling[poi])
        });
    }

    /// As it was.
    fn observe(&self, observed_at: &mut Vec<u32>) {
        self.play(observed_at, |_, open| open, |poi, step| self.near(poi, step, |_, agents| agents));
    }

    /// With some agents left out, by step and word: no POI is observed sooner than it was.
    fn observe_without(&self, was: &[u32], stay: impl Fn(u32, usize, u32) -> u32, observed_at: &mut Vec<u32>) {
        let later = |poi: usize, open: RangeInclusive<u32>| was[poi].max(*open.start())..=*open.end();
        self.play(observed_at, later, |poi, step| self.near(poi, step, |word, agents| stay(step, word, agents)));
    }

    /// With so many more copies of an agent: no POI is observed later than it was.
    fn observe_with(&self, was: &[u32], agent: usize, copies: u32, observed_at: &mut Vec<u32>) {
        let sooner = |poi: usize, open: RangeInclusive<u32>| *open.start()..=was[poi].min(*open.end());
        self.play(observed_at, sooner, |poi, step| {
            let copied = self.near(poi, step, |word, agents| agents & alone(agent, word));
            self.near(poi, step, |_, agents| agents) + copies * copied
        });
    }
}

/// How many POIs are observed.
fn count(observed_at: &[u32]) -> u32 {
    observed_at.iter().filter(|&&step| step != NEVER).count() as u32
}

/// The step at which each POI is observed, from 1, or none: `[pois]`.
pub fn observed_at(sets: Strided<'_>, world: &World) -> Vec<Option<usize>> {
    let mut observed_at = Vec::new();
    Replay { sets, world }.observe(&mut observed_at);
    observed_at.into_iter().map(|step| (step != NEVER).then_some(step as usize)).collect()
}

/// A word of the set of one agent.
fn alone(agent: usize, word: usize) -> u32 {
    if agent / 32 == word { 1 << (agent % 32) } else { 0 }
}

/// D++: what is lost without the leader, if that is at least D++(most), else the first `D++(n) = gain(n) / n`,
/// n = 1, 2, …, that D++(n + 1) does not better. All in POIs; `gain` is asked in this order, of `most` copies it is
/// `at_most`.
#[inline(always)]
fn stepping_stone(lost: u32, most: u32, at_most: u32, pois: usize, mut gain: impl FnMut(u32) -> u32) -> f32 {
    if u64::from(lost) * u64::from(most) >= u64::from(at_most) {
        return share(lost, pois);
    }
    let mut now = gain(1);
    for copies in 1..most {
        let next = gain(copies + 1);
        if u64::from(next) * u64::from(copies) <= u64::from(now) * (u64::from(copies) + 1) {
            return share(now, pois * copies as usize);
        }
        now = next;
    }
    share(now, pois * most as usize)
}

/// A count over a count, both exact in f32.
fn share(count: u32, of: usize) -> f32 {
    count as f32 / of as f32
}

/// Calls `visit(poi, size, set)`, POI by POI and in order of steps, for every set of at least `least(poi)` agents, and
/// at least one, that is not that POI's set of the step before: repetition changes no fitness.
#[inline(always)]
fn each_set(
    sets: &Strided<'_>,
    world: &World,
    scratch: &mut Vec<u32>,
    least: impl Fn(usize) -> u32,
    mut visit: impl FnMut(usize, u32, &[u32]),
) {
    let (pois, words) = (world.pois.len(), world.constants.words as usize);
    if sets.is_empty() {
        return;
    }
    scratch.clear();
    scratch.resize(2 * words, 0);
    for poi in 0..pois {
        let least = least(poi);
        let steps = sets.words[poi * words * sets.stride + sets.offset..].chunks(pois * words * sets.stride);
        if words == 1 {
            let mut before = 0;
            for step in steps {
                let set = step[0];
                if set != before && set.count_ones() >= least {
                    visit(poi, set.count_ones(), &[set]);
                }
                before = set;
            }
            continue;
        }
        let (mut set, mut before) = scratch.split_at_mut(words);
        before.fill(0);
        for step in steps {
            set.iter_mut().zip(step.iter().step_by(sets.stride)).for_each(|(word, now)| *word = *now);
            let size = set.iter().map(|word| word.count_ones()).sum();
            if set != before && size >= least {
                visit(poi, size, set);
            }
            std::mem::swap(&mut set, &mut before);
        }
    }
}

/// Gives each follower to the leader it saw at most steps, ties to the lower index, or to [`NOBODY`] if it saw none:
/// the owner of every agent, leaders their own, `[agents]`.
pub fn assign(seen: &Seen<'_>, world: &World, owner: &mut Vec<u32>) {
    let leaders = world.constants.leaders;
    owner.clear();
    owner.extend(0..leaders);
    let followers = 0..world.followers();
    match seen {
        Seen::Counts(seen) => owner.extend(followers.map(|follower| {
            let (mut most, mut best) = (0, NOBODY);
            for leader in 0..leaders {
                let steps = seen.get(follower * leaders as usize + leader as usize);
                if steps > most {
                    (most, best) = (steps, leader);
                }
            }
            best
        })),
        Seen::Most(owners) => {
            let bits = owner_bits(leaders);
            let (a_word, nobody) = ((32 / bits) as usize, (1 << bits) - 1);
            owner.extend(followers.map(|follower| {
                let owner = owners.get(follower / a_word) >> (follower % a_word * bits as usize) & nobody;
                if owner == nobody { NOBODY } else { owner }
            }));
        }
    }
}

/// The agents that belong to each leader, a bit an agent, `[leaders][words]`.
fn gather(owner: &[u32], world: &World, groups: &mut Vec<u32>) {
    let words = world.constants.words as usize;
    groups.resize(world.leaders() * words, 0);
    for (agent, &leader) in owner.iter().enumerate().filter(|&(_, &leader)| leader != NOBODY) {
        groups[leader as usize * words + agent / 32] |= 1 << (agent % 32);
    }
}

/// Leaves the agents of `critical` that are in `set`, if any of that set was needed, or none.
fn narrow(critical: &mut [u32], set: &[u32], needed: bool) {
    critical.iter_mut().zip(set).for_each(|(word, set)| *word &= if needed { *set } else { 0 });
}

/// The agents of a set, in ascending order.
fn bits(set: &[u32]) -> impl Iterator<Item = usize> {
    set.iter().enumerate().flat_map(|(index, &word)| each_bit(word).map(move |bit| index * 32 + bit))
}

/// The places of a word's bits, in ascending order.
fn each_bit(word: u32) -> impl Iterator<Item = usize> {
    std::iter::successors(Some(word), |word| Some(word & word.wrapping_sub(1)))
        .take_while(|&word| word != 0)
        .map(|word| word.trailing_zeros() as usize)
}
