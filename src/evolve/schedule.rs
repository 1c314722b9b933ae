//! Who plays with whom and from where: teams of a generation, and the start positions of its episodes.

use fearless_simd::{Level, Simd, dispatch, prelude::*};
use glam::Vec2;

use super::random::{Key, Purpose, pick};
use crate::config::{Learning, Sharing};
use crate::world::{World, on_grid};

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
