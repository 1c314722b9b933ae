//! Who plays with whom and from where: teams of a generation, and the start positions of its episodes.

use std::ops::Range;

use fearless_simd::{Level, Simd, dispatch, prelude::*};
use glam::{DVec2, Vec2};

use super::random::{Key, Purpose, index_below};
use super::selection::Selection;
use crate::config::{Learning, Method, Region, Teams, population_count};
use crate::model::classes::turn;
use crate::world::{World, on_grid, unit};

/// Returns the teams of contemporaries in one generation of a trial, `[teams][leaders]`, round by round. `populations`
/// are the leaders'. If there is only one, team `t` is policy `t`; otherwise see [`order_policies`], with a fitness of 0.
pub fn contemporary_teams(learning: &Learning, trial: usize, generation: usize, populations: &[u32]) -> Vec<u32> {
    let (leaders, count) = (populations.len(), population_count(populations));
    let mut teams = aligned_teams(learning.population, leaders).repeat(learning.partners);
    if count > 1 {
        let mut order = vec![0; learning.population];
        for (round, teams) in teams.chunks_exact_mut(learning.population * leaders).enumerate() {
            for population in 0..count {
                let place = [round, population];
                order_policies(Level::new(), learning, trial, generation, place, |_| 0.0, &mut order);
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
/// With [`Teams::Random`] all ways to form teams have the same probability. The children of tournaments are drawn
/// independently, so a random rotation is enough unless policies of other kinds survive, there are partners or evolution
/// strategies, or policies were given at the start. Neighbouring teams then have neighbouring policies, which is faster.
///
/// With [`Teams::Softmax`] and [`Teams::Sorted`] the order depends on the `fitness` of each slot's policy, or of its
/// parent, in the unit of POI values. Ties are in random order. Teams that were kept come first.
pub fn order_policies(
    level: Level,
    learning: &Learning,
    trial: usize,
    generation: usize,
    [round, population]: [usize; 2],
    fitness: impl Fn(usize) -> f64,
    order: &mut [u32],
) {
    let key = Key::new(learning.seed, trial, Purpose::Teams).at(generation, population, round);
    let Selection { elites, team_elites, team_g_elites, .. } = Selection::of(learning);
    let independent = learning.method == Method::Tournament && elites <= 1 && team_elites + team_g_elites == 0;
    // The slots of kept teams follow those of the elites.
    let kept = if generation > 0 { team_elites } else { 0 };
    let (teams, others) = order.split_at_mut(kept);
    teams.iter_mut().zip(elites as u32..).for_each(|(policy, slot)| *policy = slot);
    let slot = |index: u32| index + if index < elites as u32 { 0 } else { kept as u32 };
    match learning.teams {
        Teams::Random if independent && learning.partners == 1 && generation > 0 => {
            let [word, ..] = key.draw(0);
            let (last, first) = others.split_at_mut(others.len() - index_below(word, others.len()));
            first.iter_mut().chain(last).zip(0..).for_each(|(policy, index)| *policy = index);
        }
        Teams::Random => dispatch!(level, simd => shuffle(simd, key, others)),
        Teams::Softmax | Teams::Sorted => {
            let sort_key = |index: u32| {
                let [word, ..] = key.draw(index);
                let fitness = fitness(slot(index) as usize);
                let value = match learning.teams {
                    Teams::Softmax => fitness / learning.temperature + gumbel(word),
                    _ => fitness,
                };
                // Adding 0.0 turns -0.0 into 0.0, so that both are ties.
                (value + 0.0, word)
            };
            let keys: Vec<(f64, u32)> = (0..others.len() as u32).map(sort_key).collect();
            others.iter_mut().zip(0..).for_each(|(policy, index)| *policy = index);
            others.sort_by(|&a, &b| {
                let [a, b] = [a, b].map(|index| keys[index as usize]);
                b.0.total_cmp(&a.0).then(b.1.cmp(&a.1))
            });
        }
    }
    others.iter_mut().for_each(|policy| *policy = slot(*policy));
}

/// Returns a deviate of the standard Gumbel distribution. The order of x + deviate, largest first, is a draw without
/// replacement with probabilities ∝ exp(x).
fn gumbel(word: u32) -> f64 {
    let uniform = (f64::from(word) + 0.5) / (1u64 << 32) as f64;
    -libm::log(-libm::log(uniform))
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

/// The purposes of random starts and POIs in the episodes that all teams play.
pub const TRAINING_EPISODES: [Purpose; 2] = [Purpose::Starts, Purpose::Pois];
/// The purposes of random starts and POIs in the episodes that test the best team.
pub const TEST_EPISODES: [Purpose; 2] = [Purpose::TestStarts, Purpose::TestPois];

/// Writes the positions of one episode of a trial's generation, as [`Group::starts`](crate::backend::Group::starts) has
/// them: the agents' starts, then the POIs if they move, then headings if any are drawn.
pub fn episode_positions(
    learning: &Learning,
    trial: usize,
    generation: usize,
    (purposes, episode): ([Purpose; 2], usize),
    world: &World,
    positions: &mut Vec<Vec2>,
) {
    let [starts, pois] = purposes.map(|purpose| Key::new(learning.seed, trial, purpose));
    jitter_starts(starts, generation, episode, world, learning.start_jitter, positions);
    jitter_pois(pois, generation, episode, world, learning.poi_jitter, positions);
    draw_headings(starts, generation, episode, world, positions);
}

/// Writes the start positions of one episode, `[agents]`: the world's, or drawn from its regions, each moved by a uniform
/// offset in `-jitter..jitter` units on both axes, but not out of where its class stays. `key` is of [`Purpose::Starts`] or the like.
pub fn jitter_starts(key: Key, generation: usize, episode: usize, world: &World, jitter: f64, starts: &mut Vec<Vec2>) {
    starts.clone_from(&world.starts);
    spawn(key.at(generation, episode, 1), world.map(), &world.start_regions, starts);
    scatter(key.at(generation, episode, 0), world.map(), jitter, starts);
    for class in &world.classes {
        starts[class.agents()].iter_mut().for_each(|start| *start = class.constants.motion.confine(*start));
    }
}

/// Appends the POI positions of one episode, `[pois]`, drawn and moved the same way. Appends nothing if no POI moves.
/// `key` is of [`Purpose::Pois`] or the like.
pub fn jitter_pois(key: Key, generation: usize, episode: usize, world: &World, jitter: f64, positions: &mut Vec<Vec2>) {
    if jitter > 0.0 || !world.poi_regions.is_empty() {
        let first = positions.len();
        positions.extend(&world.pois);
        spawn(key.at(generation, episode, 1), world.map(), &world.poi_regions, &mut positions[first..]);
        scatter(key.at(generation, episode, 0), world.map(), jitter, &mut positions[first..]);
    }
}

/// Appends the headings of one episode, `[agents]`: the world's, or drawn. POIs come before them. Appends nothing if no
/// heading is drawn. `key` is that of [`jitter_starts`].
pub fn draw_headings(key: Key, generation: usize, episode: usize, world: &World, positions: &mut Vec<Vec2>) {
    if world.drawn_headings.is_empty() {
        return;
    }
    if positions.len() == world.agents() {
        positions.extend(&world.pois);
    }
    let (key, first) = (key.at(generation, episode, 2), positions.len());
    positions.extend(&world.headings);
    for agent in world.drawn_headings.iter().cloned().flatten() {
        positions[first + agent] = unit(turn(key.draw(agent as u32)[0]));
    }
}

/// Draws the positions in regions.
fn spawn(key: Key, map: Vec2, regions: &[(Range<usize>, Region)], positions: &mut [Vec2]) {
    for (range, region) in regions {
        for (index, position) in range.clone().zip(&mut positions[range.clone()]) {
            let [x, y, ..] = key.draw(index as u32);
            *position = on_grid(DVec2::from(region.place([x, y])).as_vec2(), map);
        }
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
