//! Teams, selection and mutation: cooperative coevolution with an n-elites binary tournament (Algorithm 1).
//!
//! Everything random is a pure function of counters, so that it depends on neither threads, batch size, backend nor
//! on having been interrupted.

use std::ops::Range;

use fearless_simd::{Level, Simd, SimdMask, dispatch, prelude::*};
use glam::Vec2;

use crate::config::{Learning, Mutation, Parents, Sharing};
use crate::kernels::{bound, math, splat};
use crate::parallel::*;
use crate::world::{World, on_grid};

/// Weights are 0 or of this size (2^-30) at least, so that no product in a policy is denormal.
pub const MIN_WEIGHT: f32 = 1.0 / 1_073_741_824.0;
/// Weights of larger size (2^20) stay at it.
pub const MAX_WEIGHT: f32 = 1_048_576.0;

/// Whether a number may be a weight.
pub fn is_weight(number: f32) -> bool {
    number == 0.0 || (MIN_WEIGHT..=MAX_WEIGHT).contains(&number.abs())
}

/// Makes weights fit for the kernels: those too small for them become 0. Gives the place of one that is too large or
/// no number.
pub fn admit(weights: &mut [f32]) -> Option<usize> {
    weights.iter_mut().position(|weight| {
        if weight.abs() < MIN_WEIGHT {
            *weight = 0.0;
        }
        weight.is_nan() || weight.abs() > MAX_WEIGHT
    })
}

/// Lanes of the widest vectors.
const WIDEST: usize = 16;

/// What a random number is for; no two purposes share any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    /// The weights that a run starts from.
    Weights = 1,
    /// Which policies play together, [`form_teams`].
    Teams = 2,
    /// Agents' starts in training, [`jitter_starts`].
    Starts = 3,
    /// Which policies become parents, [`draw_parents`].
    Tournament = 4,
    /// Which weights change, and by how much, [`mutate`].
    Mutation = 5,
    /// Weights of random teams that evolution is held against.
    Baseline = 6,
    /// Starts that teams are evaluated from, not trained.
    HeldOut = 7,
    /// POIs' places in training, [`jitter_pois`].
    Pois = 8,
    /// Places of POIs that teams are evaluated at, not trained.
    HeldOutPois = 9,
}

/// A place in the space of all randomness; [`Key::draw`] gives its numbers, by a counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key([u32; 4]);

impl Key {
    /// The place of a trial of a seed, for a purpose.
    pub fn new(seed: u64, trial: usize, purpose: Purpose) -> Key {
        Key(math::draw_scalar([seed as u32, (seed >> 32) as u32, trial as u32, purpose as u32]))
    }

    /// The key of one slot of one population of a generation.
    pub fn at(self, generation: usize, population: usize, slot: usize) -> Key {
        let [x, y, z, w] = self.of_population(generation, population);
        Key(math::draw_scalar([x, y, z ^ slot as u32, w]))
    }

    /// The counters of [`Key::at`], to which a slot is yet to be xored in the third place.
    pub fn of_population(self, generation: usize, population: usize) -> [u32; 4] {
        let Key([x, y, z, w]) = self;
        [x ^ generation as u32, y ^ population as u32, z, w]
    }

    /// Four random words.
    pub fn draw(self, counter: u32) -> [u32; 4] {
        let Key([x, y, z, w]) = self;
        math::draw_scalar([x, y, z, w ^ counter])
    }

    /// Another key of the same place, with numbers of its own: those of a counter that nothing else uses.
    pub fn fork(self) -> Key {
        Key(self.draw(u32::MAX))
    }

    /// [`Key::at`] for a slot a lane.
    #[inline(always)]
    fn at_lanes<S: Simd>(self, generation: usize, population: usize, slot: S::u32s) -> [S::u32s; 4] {
        let simd = slot.token();
        let Key([x, y, z, w]) = self;
        let word = |word| S::u32s::simd_from(simd, word);
        math::draw::<S>(word(x ^ generation as u32), word(y ^ population as u32), slot ^ z, word(w))
    }

    /// [`Key::draw`] for a counter a lane.
    #[inline(always)]
    fn draw_lanes<S: Simd>(self, counter: S::u32s) -> [S::u32s; 4] {
        let simd = counter.token();
        let Key([x, y, z, w]) = self;
        let word = |word| S::u32s::simd_from(simd, word);
        math::draw::<S>(word(x), word(y), word(z), counter ^ w)
    }
}

/// A number in `0..below` from a random word.
fn pick(word: u32, below: usize) -> usize {
    ((word as u64 * below as u64) >> 32) as usize
}

/// Teams of one generation: a random permutation per population puts each policy on exactly one team.
///
/// Writes the policy of each leader, `[teams][leaders]`; `key` is of purpose [`Purpose::Teams`].
pub fn form_teams(key: Key, generation: usize, leaders: usize, teams: &mut [u32]) {
    let mut order = vec![0; teams.len() / leaders];
    for leader in 0..leaders {
        shuffle(Level::new(), key, generation, leader, &mut order);
        teams.iter_mut().skip(leader).step_by(leaders).zip(&order).for_each(|(policy, &shuffled)| *policy = shuffled);
    }
}

/// Teams of one generation of a trial, `[teams][leaders]`: by [`form_teams`], or where all leaders share a policy, team
/// `t` of policy `t`.
pub fn teams_of(learning: &Learning, trial: usize, generation: usize, leaders: usize) -> Vec<u32> {
    let mut teams = one_policy_a_team(learning.population, leaders);
    if learning.sharing == Sharing::None {
        form_teams(Key::new(learning.seed, trial, Purpose::Teams), generation, leaders, &mut teams);
    }
    teams
}

/// The choice of policies by which team `t` is made of every leader's policy `t`, `[teams][leaders]`.
pub fn one_policy_a_team(teams: usize, leaders: usize) -> Vec<u32> {
    (0..teams as u32).flat_map(|policy| std::iter::repeat_n(policy, leaders)).collect()
}

/// What [`form_teams`] has of one population: its policy in each team.
pub fn shuffle(level: Level, key: Key, generation: usize, population: usize, order: &mut [u32]) {
    let key = key.at(generation, population, 0);
    dispatch!(level, simd => shuffle_lanes(simd, key, order));
}

#[inline(always)]
fn shuffle_lanes<S: Simd>(simd: S, key: Key, order: &mut [u32]) {
    for first in (0..order.len()).step_by(S::f32s::LEN) {
        let [words, ..] = key.draw_lanes::<S>(S::u32s::from_fn(simd, |lane| (first + lane) as u32));
        for (newcomer, &word) in (first..order.len()).zip(words.as_slice()) {
            // Fisher and Yates, inside out: the newcomer takes a random place, whoever was there moves to the end.
            let place = pick(word, newcomer + 1);
            order[newcomer] = order[place];
            order[place] = newcomer as u32;
        }
    }
}

/// Places of one episode of a trial's generation, as a [`crate::backend::Group`] has them: where agents start, and if
/// POIs move, where these are.
pub fn places(
    learning: &Learning,
    trial: usize,
    generation: usize,
    episode: usize,
    world: &World,
    places: &mut Vec<Vec2>,
) {
    let key = Key::new(learning.seed, trial, Purpose::Starts);
    jitter_starts(key, generation, episode, world, learning.start_jitter, places);
    if learning.poi_jitter > 0.0 {
        let key = Key::new(learning.seed, trial, Purpose::Pois);
        jitter_pois(key, generation, episode, world, learning.poi_jitter, places);
    }
}

/// Start positions of one episode: the world's, each moved by a uniform offset in `-jitter..jitter` on both axes.
pub fn jitter_starts(key: Key, generation: usize, episode: usize, world: &World, jitter: f64, starts: &mut Vec<Vec2>) {
    starts.clone_from(&world.starts);
    scatter(key.at(generation, episode, 0), world.map(), jitter, starts);
}

/// Adds the POIs of one episode, moved likewise, to the start positions; none where nothing moves them.
pub fn jitter_pois(key: Key, generation: usize, episode: usize, world: &World, jitter: f64, places: &mut Vec<Vec2>) {
    if jitter > 0.0 {
        let first = places.len();
        places.extend(&world.pois);
        scatter(key.at(generation, episode, 0), world.map(), jitter, &mut places[first..]);
    }
}

/// Moves each place by a uniform offset in `-jitter..jitter` on both axes.
fn scatter(key: Key, map: Vec2, jitter: f64, places: &mut [Vec2]) {
    if jitter == 0.0 {
        return;
    }
    for (index, place) in places.iter_mut().enumerate() {
        let [x, y, ..] = key.draw(index as u32).map(|word| {
            // 53 bits are exact in f64, and so is every step but the last, which rounds to f32.
            ((word as f64 / (1u64 << 32) as f64) * 2.0 - 1.0) * jitter
        });
        *place = on_grid(*place + Vec2::new(x as f32, y as f32), map);
    }
}

/// The indices of the `count` best scores, best first; ties go to the lower index.
pub fn best(scores: &[f32], count: usize) -> Vec<usize> {
    let better = |a: &usize, b: &usize| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b));
    let mut order: Vec<usize>;
    if count <= FEW {
        // The best so far, in order; hardly any other score comes near them.
        order = Vec::with_capacity(count + 1);
        for (index, score) in scores.iter().enumerate() {
            if order.len() < count || order.last().is_some_and(|&last| score.total_cmp(&scores[last]).is_gt()) {
                order.insert(order.partition_point(|&other| scores[other].total_cmp(score).is_ge()), index);
                order.truncate(count);
            }
        }
        return order;
    }
    order = (0..scores.len()).collect();
    if count < order.len() {
        order.select_nth_unstable_by(count - 1, better);
    }
    order.truncate(count);
    order.sort_unstable_by(better);
    order
}

/// So few best scores are found without sorting.
const FEW: usize = 16;

/// The winner of the binary tournament of one slot: two distinct policies, the higher score, ties to the lower index.
pub fn tournament(key: Key, scores: &[f32]) -> usize {
    let [first, second, ..] = key.draw(0);
    winner(first, second, scores)
}

/// The winner between the policies that two random words pick.
#[inline(always)]
fn winner(first: u32, second: u32, scores: &[f32]) -> usize {
    let a = pick(first, scores.len());
    let b = pick(second, scores.len() - 1);
    let b = if b >= a { b + 1 } else { b };
    let (low, high) = (a.min(b), a.max(b));
    if scores[high] > scores[low] { high } else { low }
}

/// Set in a slot's entry of the plan of [`draw_parents`] where the slot keeps its parent's weights as they are.
pub const UNCHANGED: u32 = 1 << 31;

/// Which policies of a population survive, and which may become parents.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Selection {
    /// The number of policies that survive unchanged.
    pub elites: usize,
    /// Which policies may become parents.
    pub parents: Parents,
}

impl Selection {
    /// Returns the selection that a config asks for.
    pub fn of(learning: &Learning) -> Selection {
        Selection { elites: learning.elites.count(learning.population), parents: learning.parents }
    }
}

/// Plans one population's next generation: the policy from which each slot comes, `[policies + 1]`, with [`UNCHANGED`]
/// where it does not mutate.
///
/// The first slots are the elites', best first. The others' parents win [`tournament`]s, or with [`Parents::Elites`] are
/// elites, each with the same probability. The last slot gets the best of all, the champion. `key` is of purpose
/// [`Purpose::Tournament`], `scores` are `[policies]`.
pub fn draw_parents(
    level: Level,
    key: Key,
    generation: usize,
    population: usize,
    selection: Selection,
    scores: &[f32],
    parents: &mut [u32],
) {
    let policies = scores.len();
    let best = best(scores, selection.elites.max(1));
    let choose = |first, second| match selection.parents {
        Parents::All => winner(first, second, scores),
        Parents::Elites => best[pick(first, best.len())],
    };
    parents[..policies].par_chunks_mut(DRAWN_TOGETHER).enumerate().for_each(|(chunk, parents)| {
        let first = chunk * DRAWN_TOGETHER;
        dispatch!(level, simd => draw_parents_lanes(simd, key, generation, population, first, choose, parents));
    });
    for (parent, elite) in parents.iter_mut().zip(&best[..selection.elites]) {
        *parent = *elite as u32 | UNCHANGED;
    }
    parents[policies] = best[0] as u32 | UNCHANGED;
}

/// The plan that leaves all policies where they are, after the last generation; only the champion gets its slot.
pub fn keep_parents(scores: &[f32], parents: &mut [u32]) {
    for (slot, parent) in parents.iter_mut().enumerate() {
        *parent = slot as u32 | UNCHANGED;
    }
    parents[scores.len()] = best(scores, 1)[0] as u32 | UNCHANGED;
}

/// Slots whose parents one thread draws at a time.
const DRAWN_TOGETHER: usize = 4096;

#[inline(always)]
fn draw_parents_lanes<S: Simd>(
    simd: S,
    key: Key,
    generation: usize,
    population: usize,
    first: usize,
    choose: impl Fn(u32, u32) -> usize,
    parents: &mut [u32],
) {
    for (slot, parents) in (first..).step_by(S::f32s::LEN).zip(parents.chunks_mut(S::f32s::LEN)) {
        let slots = S::u32s::from_fn(simd, |lane| (slot + lane) as u32);
        let [x, y, z, w] = key.at_lanes::<S>(generation, population, slots);
        let [firsts, seconds, ..] = math::draw::<S>(x, y, z, w);
        for ((parent, &first), &second) in parents.iter_mut().zip(firsts.as_slice()).zip(seconds.as_slice()) {
            *parent = choose(first, second) as u32;
        }
    }
}

/// Weights N(0, 1) for a new policy; `key` is a slot's of purpose [`Purpose::Weights`].
pub fn random_policy(level: Level, key: Key, weights: &mut [f32]) {
    dispatch!(level, simd => random_lanes(simd, key, weights));
}

#[inline(always)]
fn random_lanes<S: Simd>(simd: S, key: Key, weights: &mut [f32]) {
    let width = S::f32s::LEN;
    let mut index = S::u32s::from_fn(simd, |lane| lane as u32);
    for chunk in weights.chunks_mut(width) {
        let [a, b, ..] = key.draw_lanes::<S>(index);
        let weight = within_limits(simd, math::normal::<S>(a, b));
        chunk.copy_from_slice(&weight.as_slice()[..chunk.len()]);
        index += width as u32;
    }
}

/// Mutates a policy: every weight, with the configured probability, gains noise, `N(0, sigma)` times itself or plainly.
///
/// `key` is a slot's of purpose [`Purpose::Mutation`]; `scratch` may hold anything.
pub fn mutate(level: Level, key: Key, learning: &Learning, weights: &mut [f32], scratch: &mut Vec<u32>) {
    dispatch!(level, simd => mutate_lanes(simd, key, learning, weights, scratch));
}

#[inline(always)]
fn mutate_lanes<S: Simd>(simd: S, key: Key, learning: &Learning, weights: &mut [f32], scratch: &mut Vec<u32>) {
    let mut chosen = Chosen::new(scratch, 1, weights.len());
    chosen.choose(simd, 0, key, learning.mutation_probability);
    let listed = chosen.list(0);
    chosen.address(simd, 0, listed, key.fork());
    chosen.mutate(simd, learning, weights);
}

/// A breeding plan that does not match the populations it is applied to.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct InvalidInput(String);

/// How the next generation of a trial's populations comes from this one.
#[derive(Clone, Debug)]
pub struct Breeding<'a> {
    /// The plan, `[populations][slots]`, see [`draw_parents`].
    pub parents: &'a [u32],
    /// The trial's key of [`Purpose::Mutation`].
    pub key: Key,
    /// The generation that ends.
    pub generation: usize,
    /// By which a weight mutates.
    pub learning: &'a Learning,
}

impl Breeding<'_> {
    /// Whether the plan is one for populations of these sizes, `[leaders, slots, parameters]`. Every backend asks this
    /// before it breeds.
    ///
    /// # Errors
    /// It has too few or too many places, or a parent that there is not.
    pub fn check(&self, [leaders, slots, _]: [usize; 3]) -> Result<(), InvalidInput> {
        let invalid = |text: String| Err(InvalidInput(text));
        if self.parents.len() != leaders * slots {
            return invalid(format!("{} parents for {leaders} populations of {slots}", self.parents.len()));
        }
        match self.parents.iter().position(|&planned| (planned & !UNCHANGED) as usize >= slots) {
            None => Ok(()),
            Some(place) => invalid(format!(
                "slot {} of population {} has policy {} of {slots} as its parent (they count from 0)",
                place % slots,
                place / slots,
                self.parents[place] & !UNCHANGED
            )),
        }
    }

    /// The next generation of these weights, worked out on the host: what every backend must come to.
    ///
    /// # Errors
    /// The plan is not one for these sizes, see [`Breeding::check`].
    pub fn on_host(&self, sizes: [usize; 3], weights: &[f32]) -> Result<Vec<f32>, InvalidInput> {
        self.check(sizes)?;
        let [_, slots, parameters] = sizes;
        let (mut children, mut scratch) = (Vec::with_capacity(weights.len()), Vec::new());
        for (place, planned) in self.parents.iter().enumerate() {
            let (leader, slot, first) = (place / slots, place % slots, children.len());
            let parent = leader * slots + (planned & !UNCHANGED) as usize;
            children.extend_from_slice(&weights[parent * parameters..(parent + 1) * parameters]);
            if planned & UNCHANGED == 0 {
                let key = self.key.at(self.generation, leader, slot);
                mutate(Level::new(), key, self.learning, &mut children[first..], &mut scratch);
            }
        }
        Ok(children)
    }
}

/// The slots of one population to be filled by a plan.
#[derive(Clone, Copy, Debug)]
pub struct Offspring<'a> {
    /// Of purpose [`Purpose::Mutation`].
    pub key: Key,
    /// The generation that ends.
    pub generation: usize,
    /// Its place among the trial's.
    pub population: usize,
    /// The first of the slots.
    pub first: usize,
    /// Each slot's entry of the plan of [`draw_parents`].
    pub parents: &'a [u32],
    /// `[policies + 1][parameters]`.
    pub policies: &'a [f32],
}

/// Fills slots, `[slots][parameters]`: each gets its parent's weights and [`mutate`]s. `scratch` may hold anything.
pub fn breed(level: Level, learning: &Learning, brood: Offspring<'_>, children: &mut [f32], scratch: &mut Vec<u32>) {
    let parameters = children.len() / brood.parents.len();
    // As many as stay in the innermost cache.
    let together = (BRED_TOGETHER / parameters).clamp(1, WIDEST);
    for (batch, (children, parents)) in
        children.chunks_mut(together * parameters).zip(brood.parents.chunks(together)).enumerate()
    {
        let batch = Offspring { first: brood.first + batch * together, parents, ..brood };
        dispatch!(level, simd => mutate_brood(simd, learning, batch, children, scratch));
    }
}

/// Weights that are copied, then mutated.
const BRED_TOGETHER: usize = 2048;

#[inline(always)]
fn mutate_brood<S: Simd>(
    simd: S,
    learning: &Learning,
    brood: Offspring<'_>,
    children: &mut [f32],
    scratch: &mut Vec<u32>,
) {
    let parameters = children.len() / brood.parents.len();
    let mut chosen = Chosen::new(scratch, brood.parents.len(), parameters);
    for (batch, parents) in brood.parents.chunks(S::f32s::LEN).enumerate() {
        let first = batch * S::f32s::LEN;
        let slots = S::u32s::from_fn(simd, |lane| (brood.first + first + lane) as u32);
        let keys = brood.key.at_lanes::<S>(brood.generation, brood.population, slots);
        let [x, y, z, w] = keys;
        let forks = math::draw::<S>(x, y, z, w ^ u32::MAX);
        let key = |of: &[S::u32s; 4], lane: usize| Key([of[0][lane], of[1][lane], of[2][lane], of[3][lane]]);
        let mutating = || (0..).zip(parents).filter(|(_, parent)| *parent & UNCHANGED == 0).map(|(lane, _)| lane);
        // In loops of their own, so that the processor draws for several policies at once.
        for (lane, &parent) in parents.iter().enumerate() {
            // The processor waits for the next parents while it draws.
            let (to, from) = ((first + lane) * parameters, (parent & !UNCHANGED) as usize * parameters);
            copy(simd, &brood.policies[from..from + parameters], &mut children[to..to + parameters]);
            if parent & UNCHANGED != 0 {
                continue;
            }
            chosen.choose(simd, first + lane, key(&keys, lane), learning.mutation_probability);
        }
        let mut listed = [(0, 0); WIDEST];
        for lane in mutating() {
            listed[lane] = chosen.list(first + lane);
        }
        for lane in mutating() {
            chosen.address(simd, first + lane, listed[lane], key(&forks, lane));
        }
    }
    chosen.mutate(simd, learning, children);
}

/// Copies a policy by vectors.
#[inline(always)]
fn copy<S: Simd>(simd: S, from: &[f32], to: &mut [f32]) {
    let whole = from.len() / S::f32s::LEN * S::f32s::LEN;
    for at in (0..whole).step_by(S::f32s::LEN) {
        S::f32s::from_slice(simd, &from[at..at + S::f32s::LEN]).store_slice(&mut to[at..at + S::f32s::LEN]);
    }
    if whole < from.len() {
        to[whole..].copy_from_slice(&from[whole..]);
    }
}

/// The weights that mutate in one policy or several, so many that no lane idles.
struct Chosen<'a> {
    /// Weights of a policy.
    parameters: usize,
    /// A bit for each weight that mutates, [`Chosen::words`] a policy.
    masks: &'a mut [u32],
    /// How many are listed.
    count: usize,
    /// Each one's index in its policy and among all weights, its bits, and the key of its noise.
    indices: &'a mut [u32],
    places: &'a mut [u32],
    bits: &'a mut [u32],
    keys: [&'a mut [u32]; 4],
}

impl<'a> Chosen<'a> {
    /// None of so many policies' weights.
    #[inline(always)]
    fn new(scratch: &'a mut Vec<u32>, policies: usize, parameters: usize) -> Chosen<'a> {
        // Whole vectors are written from any place on.
        let room = policies * parameters.next_multiple_of(64) + WIDEST;
        if scratch.len() < 8 * room {
            scratch.resize(8 * room, 0);
        }
        let mut fields = scratch.chunks_exact_mut(room);
        let mut field = || fields.next().expect("there is room for eight");
        let (masks, indices, places, bits) = (field(), field(), field(), field());
        Chosen { parameters, masks, count: 0, indices, places, bits, keys: [field(), field(), field(), field()] }
    }

    /// Where a policy's masks are.
    #[inline(always)]
    fn words(&self, policy: usize) -> Range<usize> {
        let words = 2 * self.parameters.div_ceil(64);
        policy * words..(policy + 1) * words
    }

    /// Chooses which weights of a policy mutate: each by a random word of its own, of which a draw makes four.
    ///
    /// Weight 64·block + 16·word + place takes its word from counter 16·block + place: no lane width shows in that.
    #[inline(always)]
    fn choose<S: Simd>(&mut self, simd: S, policy: usize, key: Key, probability: f64) {
        let threshold = mutation_threshold(probability);
        let words = self.words(policy);
        let lanes = S::u32s::from_fn(simd, |lane| lane as u32);
        for (block, masks) in self.masks[words].as_chunks_mut::<2>().0.iter_mut().enumerate() {
            let mut mutates = 0u64;
            for place in (0..16).step_by(S::f32s::LEN) {
                let counter = lanes + (16 * block + place) as u32;
                for (index, word) in (0..).zip(key.draw_lanes::<S>(counter)) {
                    mutates |= word.simd_lt(threshold.unwrap_or_default()).to_bitmask() << (16 * index + place);
                }
            }
            if threshold.is_none() {
                mutates = u64::MAX;
            }
            let left = self.parameters - 64 * block;
            if left < 64 {
                mutates &= (1 << left) - 1;
            }
            *masks = [mutates as u32, (mutates >> 32) as u32];
        }
    }

    /// Lists the chosen weights of a policy; tells where.
    #[inline(always)]
    fn list(&mut self, policy: usize) -> (usize, usize) {
        let before = self.count;
        let mut count = before;
        for (word, &mask) in (0..).step_by(32).zip(&self.masks[self.words(policy)]) {
            for (index, byte) in (word..).step_by(8).zip(mask.to_le_bytes()) {
                let to = &mut self.indices[count..count + 8];
                for (to, &bit) in to.iter_mut().zip(&BITS[byte as usize]) {
                    *to = index + u32::from(bit);
                }
                count += byte.count_ones() as usize;
            }
        }
        self.count = count;
        (before, count)
    }

    /// Says of the listed weights of a policy where they are, and that their noise has this key.
    ///
    /// Not at once as they are listed: what was written in pieces can be read as a whole only after a while.
    #[inline(always)]
    fn address<S: Simd>(&mut self, simd: S, policy: usize, (first, end): (usize, usize), noises: Key) {
        let place = (policy * self.parameters) as u32;
        for at in (first..end).step_by(S::f32s::LEN) {
            let vector = at..at + S::f32s::LEN;
            let index = S::u32s::from_slice(simd, &self.indices[vector.clone()]);
            (index + place).store_slice(&mut self.places[vector.clone()]);
            for (to, word) in self.keys.iter_mut().zip(noises.0) {
                S::u32s::simd_from(simd, word).store_slice(&mut to[vector.clone()]);
            }
        }
    }

    /// Adds its noise to each.
    #[inline(always)]
    fn mutate<S: Simd>(self, simd: S, learning: &Learning, weights: &mut [f32]) {
        let Chosen { count, indices, places, bits, keys: [x, y, z, w], .. } = self;
        let sigma = learning.mutation_sigma as f32;
        for (bits, &place) in bits[..count].iter_mut().zip(&*places) {
            *bits = weights[place as usize].to_bits();
        }
        let vectors = || (0..count).step_by(S::f32s::LEN).map(|at| at..at + S::f32s::LEN);
        let load = |from: &[u32]| S::u32s::from_slice(simd, from);
        // In short loops: the processor sees far enough ahead to keep its units busy.
        for at in vectors() {
            let counter = load(&w[at.clone()]) ^ load(&indices[at.clone()]);
            let [a, b, ..] = math::draw::<S>(load(&x[at.clone()]), load(&y[at.clone()]), load(&z[at.clone()]), counter);
            a.store_slice(&mut x[at.clone()]);
            b.store_slice(&mut y[at]);
        }
        for at in vectors() {
            let radius: S::u32s = math::normal_radius::<S>(load(&x[at.clone()])).bitcast();
            radius.store_slice(&mut x[at]);
        }
        for at in vectors() {
            let weight: S::f32s = load(&bits[at.clone()]).bitcast();
            let radius: S::f32s = load(&x[at.clone()]).bitcast();
            let noise = math::normal_of::<S>(radius, math::normal_cosine::<S>(load(&y[at.clone()]))) * sigma;
            let noise = if learning.mutation == Mutation::Scaled { noise * weight } else { noise };
            let mutated: S::u32s = within_limits(simd, weight + noise).bitcast();
            mutated.store_slice(&mut bits[at]);
        }
        for (&bits, &place) in bits[..count].iter().zip(&*places) {
            weights[place as usize] = f32::from_bits(bits);
        }
    }
}

/// A weight mutates where its random word is below this; none where all do.
pub fn mutation_threshold(probability: f64) -> Option<u32> {
    (probability < 1.0).then_some((probability * (1u64 << 32) as f64) as u32)
}

/// The bits that are set in each byte, ascending, then zeros.
const BITS: [[u8; 8]; 256] = {
    let mut bits = [[0; 8]; 256];
    let mut byte = 0;
    while byte < 256 {
        let (mut bit, mut count) = (0, 0);
        while bit < 8 {
            if byte >> bit & 1 == 1 {
                bits[byte][count] = bit;
                count += 1;
            }
            bit += 1;
        }
        byte += 1;
    }
    bits
};

/// A weight brought within the sizes that policies may have.
#[inline(always)]
fn within_limits<S: Simd>(simd: S, weight: S::f32s) -> S::f32s {
    let bounded = bound::<S>(weight, splat(simd, -MAX_WEIGHT), splat(simd, MAX_WEIGHT));
    math::flush::<S>(bounded, MIN_WEIGHT)
}
