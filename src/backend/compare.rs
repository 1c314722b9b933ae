//! Comparison of two backends by traces, scores and breeding.

use super::{Backend, BackendError, Group, GroupScores, MOMENT_WORDS, Trace};
use crate::config::Learning;
use crate::evolve::{Breeding, Key, Purpose, UNCHANGED};
use crate::world::World;

/// The quantities of a step, in the order in which a step computes them.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
enum Quantity {
    /// The inputs of a leader's policy.
    Sense,
    /// The outputs of a leader's policy.
    Policy,
    /// The leaders that a follower saw at the step.
    Sight,
    /// The force on a follower.
    Follow,
    /// Position, heading and speed after the step.
    Move,
    /// The agents at a POI.
    Couple,
    /// At how many steps a follower saw a leader.
    Influence,
}

/// Traces a group on two backends. Describes the first difference.
pub(crate) fn compare_traces(
    group: &Group<'_>,
    reference: &mut dyn Backend,
    backend: &mut dyn Backend,
) -> Result<Option<String>, BackendError> {
    let (expected, found) = (reference.trace(group)?, backend.trace(group)?);
    Ok(first_mismatch(group.world, &expected, &found))
}

/// Returns the first group whose scores differ, and how.
pub(crate) fn first_difference(
    groups: &[Group<'_>],
    expected: &[GroupScores],
    found: &[GroupScores],
) -> Option<(usize, String)> {
    let differs = |(index, (expected, found)): (usize, (&GroupScores, &GroupScores))| {
        let group = &groups[index];
        let (per_team, fitnesses) = (group.fitnesses.len() * group.world.leaders(), group.fitnesses);
        let of = |scores: &GroupScores, team: usize| {
            let own = scores.scores[team * per_team..][..per_team].iter().map(|score| score.to_bits());
            (scores.observed[team], own.collect::<Vec<u32>>())
        };
        let team = (0..group.team_count()).find(|&team| of(expected, team) != of(found, team))?;
        let shown = |scores: &GroupScores| {
            format!("{} POIs and {:?}", scores.observed[team], &scores.scores[team * per_team..][..per_team])
        };
        let (expected, found) = (shown(expected), shown(found));
        Some((index, format!("team {team}, scores by {fitnesses:?}: expected {expected}, found {found}")))
    };
    expected.iter().zip(found).enumerate().find_map(differs)
}

/// Breeds policies, `[populations, slots, parameters]`, on the device of a backend, if that holds them. Returns the
/// first weight that differs from the host's.
pub(crate) fn compare_breeding(
    weights: &[f32],
    sizes: [usize; 3],
    learning: &Learning,
    backend: &mut dyn Backend,
) -> Result<Option<String>, BackendError> {
    let [populations, slots, parameters] = sizes;
    let Some(mut held) = backend.hold(weights, sizes)? else { return Ok(None) };
    // Each slot's parent is the next slot. Every fourth slot does not mutate.
    let planned = |place: usize| ((place + 1) % slots) as u32 | if place % 4 == 3 { UNCHANGED } else { 0 };
    let parents: Vec<u32> = (0..populations).flat_map(|_| (0..slots).map(planned)).collect();
    let key = Key::new(learning.seed, 0, Purpose::Mutation);
    let breeding = Breeding { parents: &parents, key, generation: 0, learning };
    held.breed(&breeding)?;
    let mut found = vec![0.0; weights.len()];
    held.fetch(&mut found)?;
    let expected = breeding.on_host(sizes, weights)?;
    let differs = |index: &usize| expected[*index].to_bits() != found[*index].to_bits();
    Ok((0..found.len()).find(differs).map(|index| {
        let (leader, slot, weight) = (index / parameters / slots, index / parameters % slots, index % parameters);
        let (expected, found) = (expected[index], found[index]);
        format!(
            "stage breed, leader {leader}, slot {slot}, weight {weight}: expected {:#010x} ({expected:?}), \
             found {:#010x} ({found:?})",
            expected.to_bits(),
            found.to_bits()
        )
    }))
}

/// Describes the first difference of two traces of the same group: by step, then stage, then team. Steps count from 1;
/// step 0 is the start. Counts over an episode belong to its last step.
fn first_mismatch(world: &World, expected: &Trace, found: &Trace) -> Option<String> {
    let mut first: Option<((usize, Quantity, usize), String)> = None;
    // Compares two arrays. `locate` returns step, quantity, team and place of a number.
    let mut compare = |a: &[u32], b: &[u32], locate: &dyn Fn(usize) -> (usize, Quantity, usize, String)| {
        for (index, (&expected, &found)) in a.iter().zip(b).enumerate().filter(|(_, (a, b))| a != b) {
            let (step, stage, team, place) = locate(index);
            if first.as_ref().is_none_or(|(earlier, _)| (step, stage, team) < *earlier) {
                let shown = |bits: u32| match stage {
                    Quantity::Sight | Quantity::Couple | Quantity::Influence => format!("{bits:#010x}"),
                    _ => format!("{bits:#010x} ({:?})", f32::from_bits(bits)),
                };
                let (name, expected, found) = (format!("{stage:?}").to_lowercase(), shown(expected), shown(found));
                let text =
                    format!("stage {name}, team {team}, {place}, step {step}: expected {expected}, found {found}");
                first = Some(((step, stage, team), text));
            }
        }
    };
    let [moments, found_moments] = [expected, found].map(|trace| bytemuck::cast_slice(&trace.moments));
    compare(moments, found_moments, &|index| {
        let (moment, (stage, name)) = (index / MOMENT_WORDS, FIELDS[index % MOMENT_WORDS]);
        let (agent, team) = (moment % expected.agents, moment / expected.agents % expected.teams);
        (moment / expected.agents / expected.teams, stage, team, format!("agent {agent}, {name}"))
    });
    let (leaders, width) = (world.leaders(), world.inputs());
    let [inputs, found_inputs] = [expected, found].map(|trace| bytemuck::cast_slice(&trace.inputs));
    compare(inputs, found_inputs, &|index| {
        let (leader, step) = (index / width, index / width / leaders / expected.teams);
        let place = format!("agent {}, input {}", leader % leaders, index % width);
        (step, Quantity::Sense, leader / leaders % expected.teams, place)
    });
    let (pois, words) = (world.pois.len(), world.constants.words as usize);
    compare(&expected.sets, &found.sets, &|index| {
        let (team, row) = (index / world.set_words(), index % world.set_words());
        let place = format!("POI {}, agents from {}", row / words % pois, row % words * 32);
        (row / words / pois + 1, Quantity::Couple, team, place)
    });
    let (followers, words, of_team) = (world.followers(), world.leader_words(), world.sight_words());
    // Paths were compared with the moments.
    let sights = if world.paths.is_some() { 0 } else { expected.trail.len() };
    compare(&expected.trail[..sights], &found.trail[..sights], &|index| {
        let row = index % of_team / words;
        let place = format!("follower {}, leaders from {}", row % followers, index % words * 32);
        (row / followers + 1, Quantity::Sight, index / of_team, place)
    });
    compare(&expected.seen, &found.seen, &|index| {
        let (team, pair) = (index / (leaders * followers), index % (leaders * followers));
        let place = format!("follower {}, leader {}", pair / leaders, pair % leaders);
        (world.steps(), Quantity::Influence, team, place)
    });
    first.map(|(_, text)| text)
}

/// The quantity and the name of each word of a [`Moment`](super::Moment).
const FIELDS: [(Quantity, &str); MOMENT_WORDS] = [
    (Quantity::Policy, "turn"),
    (Quantity::Policy, "speed"),
    (Quantity::Follow, "force x"),
    (Quantity::Follow, "force y"),
    (Quantity::Move, "x"),
    (Quantity::Move, "y"),
    (Quantity::Move, "heading x"),
    (Quantity::Move, "heading y"),
    (Quantity::Move, "speed"),
];
