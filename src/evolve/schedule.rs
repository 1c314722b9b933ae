//! Who plays with whom and from where: teams of a generation, and the start positions of its episodes.

use fearless_simd::{Level, Simd, dispatch, prelude::*};
use glam::Vec2;

use super::random::{Key, Purpose, index_below};
use super::selection::Selection;
use crate::config::{Learning, Method, population_count};
use crate::world::{World, on_grid};

/// Returns the teams of contemporaries in one generation of a trial, `[teams][leaders]`, round by round. `populations`
/// are the leaders'. If there is only one, team `t` is policy `t`; otherwise see [`order_policies`].
pub fn contemporary_teams(learning: &Learning, trial: usize, generation: usize, populations: &[u32]) -> Vec<u32> {
    let (leaders, count) = (populations.len(), population_count(populations));
    let mut teams = aligned_teams(learning.population, leaders).repeat(learning.partners);
    if count > 1 {
        let mut order = vec![0; learning.population];
        for (round, teams) in teams.chunks_exact_mut(learning.population * leaders).enumerate() {
            for population in 0..count {
                order_policies(Level::new(), learning, trial, generation, [round, population], &mut order);
                for (team, &policy) in teams.chunks_exact_mut(leaders).zip(&order) {
                    let members = team.iter_mut().zip(populations).filter(|&(_, &of)| of as usize == population);
                    members.for_each(|(to, _)| *to = policy);
                }
            }
        }
    }
    teams
}

/// Writes the policy of a population in each team of a round, `[teams]`: each policy is on exactly one team.
///
/// All ways to form teams have the same probability. The children of tournaments are drawn independently, so a random
/// rotation is enough unless there are several elites, partners or evolution strategies, or policies were given at the
/// start. Neighbouring teams then have neighbouring policies, which is faster.
pub fn order_policies(
    level: Level,
    learning: &Learning,
    trial: usize,
    generation: usize,
    [round, population]: [usize; 2],
    order: &mut [u32],
) {
    let key = Key::new(learning.seed, trial, Purpose::Teams).at(generation, population, round);
    let independent = learning.method == Method::Tournament && Selection::of(learning).elites <= 1;
    if independent && learning.partners == 1 && generation > 0 {
        let [word, ..] = key.draw(0);
        let (last, first) = order.split_at_mut(order.len() - index_below(word, order.len()));
        first.iter_mut().chain(last).zip(0..).for_each(|(policy, index)| *policy = index);
    } else {
        dispatch!(level, simd => shuffle(simd, key, order));
    }
}

/// Returns teams in which team `t` is every leader's policy `t`, `[teams][leaders]`.
pub fn aligned_teams(teams: usize, leaders: usize) -> Vec<u32> {
    (0..teams as u32).flat_map(|policy| std::iter::repeat_n(policy, leaders)).collect()
}

/// Returns the slot of the past champions that the policies of a generation play with, or `None` if there are none yet.
/// It is the same for all policies, so that the scores differ only because of them.
pub fn past_champions(learning: &Learning, trial: usize, generation: usize) -> Option<usize> {
    let Learning { seed, population, hall_of_fame, .. } = *learning;
    let kept = hall_of_fame.min(generation);
    if kept == 0 {
        return None;
    }
    let [word, ..] = Key::new(seed, trial, Purpose::HallOfFame).at(generation, 0, 0).draw(0);
    let past = generation - 1 - index_below(word, kept);
    Some(population + 1 + past % hall_of_fame)
}

/// Writes a random permutation.
#[inline(always)]
fn shuffle<S: Simd>(simd: S, key: Key, order: &mut [u32]) {
    for first in (0..order.len()).step_by(S::f32s::LEN) {
        let [words, ..] = key.draw_lanes::<S>(S::u32s::from_fn(simd, |lane| (first + lane) as u32));
        for (newcomer, &word) in (first..order.len()).zip(words.as_slice()) {
            // Fisher-Yates shuffle, inside out: the new element takes a random position, and the element there moves to
            // the end.
            let place = index_below(word, newcomer + 1);
            order[newcomer] = order[place];
            order[place] = newcomer as u32;
        }
    }
}

/// Writes the positions of one episode of a trial's generation, as [`Group::starts`](crate::backend::Group::starts) has
/// them: the agents' starts, then the POIs if they move.
pub fn episode_positions(
    learning: &Learning,
    trial: usize,
    generation: usize,
    episode: usize,
    world: &World,
    positions: &mut Vec<Vec2>,
) {
    let key = Key::new(learning.seed, trial, Purpose::Starts);
    jitter_starts(key, generation, episode, world, learning.start_jitter, positions);
    if learning.poi_jitter > 0.0 {
        let key = Key::new(learning.seed, trial, Purpose::Pois);
        jitter_pois(key, generation, episode, world, learning.poi_jitter, positions);
    }
}

/// Writes the start positions of one episode, `[agents]`: the world's, each moved by a uniform offset in
/// `-jitter..jitter` units on both axes. `key` is of [`Purpose::Starts`] or [`Purpose::HeldOut`].
pub fn jitter_starts(key: Key, generation: usize, episode: usize, world: &World, jitter: f64, starts: &mut Vec<Vec2>) {
    starts.clone_from(&world.starts);
    scatter(key.at(generation, episode, 0), world.map(), jitter, starts);
}

/// Appends the POI positions of one episode, `[pois]`, moved the same way. Appends nothing if `jitter` is 0. `key` is
/// of [`Purpose::Pois`] or [`Purpose::HeldOutPois`].
pub fn jitter_pois(key: Key, generation: usize, episode: usize, world: &World, jitter: f64, positions: &mut Vec<Vec2>) {
    if jitter > 0.0 {
        let first = positions.len();
        positions.extend(&world.pois);
        scatter(key.at(generation, episode, 0), world.map(), jitter, &mut positions[first..]);
    }
}

/// Moves each position by a uniform offset in `-jitter..jitter` on both axes.
fn scatter(key: Key, map: Vec2, jitter: f64, positions: &mut [Vec2]) {
    if jitter == 0.0 {
        return;
    }
    for (index, position) in positions.iter_mut().enumerate() {
        let [x, y, ..] = key.draw(index as u32).map(|word| {
            // In -1..1 and exact in f64. The product with `jitter` rounds in f64, and again in the conversion to f32.
            ((word as f64 / (1u64 << 32) as f64) * 2.0 - 1.0) * jitter
        });
        *position = on_grid(*position + Vec2::new(x as f32, y as f32), map);
    }
}
