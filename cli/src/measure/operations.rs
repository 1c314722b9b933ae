//! The minimum number of lane operations per team-step, counted from the formulas and from a trace of random teams.
//!
//! | counted | not counted |
//! |---|---|
//! | each f32 or integer operation, comparison and selection of [`flotilla::model`] | constants and moves |
//! | what two formulas share, once | idle lanes, loads and stores, scoring |
//! | entities in reach of an agent of their team | tests of pairs that are out of reach |

use flotilla::backend::Trace;
use flotilla::model::Constants;
use flotilla::model::policy::{Actions, PolicyConstants};
use flotilla::model::sense::Density;
use flotilla::world::{INPUTS, World};

/// Numbers of entities in reach of agents, as means over a trace's teams and steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reach {
    /// POIs within the range of a leader, summed over leaders.
    pub sensed_pois: f64,
    /// Agents within the range of a leader, summed over leaders.
    pub sensed_agents: f64,
    /// Agents within the attraction radius of a follower, summed over followers.
    pub drawn: f64,
    /// How many of those are leaders.
    pub seen: f64,
    /// Pairs of agents of which one senses or is drawn to the other, each counted once.
    pub pairs: f64,
}

impl Reach {
    /// Computes the means of a trace, from the state before each step.
    pub fn of(world: &World, trace: &Trace) -> Reach {
        let Constants { sense, follow, .. } = world.constants;
        let (agents, leaders) = (world.agents(), world.leaders());
        let [mut sensed_pois, mut sensed_agents, mut drawn, mut seen, mut pairs] = [0u64; 5];
        for moments in trace.moments.chunks_exact(agents).take(world.steps() * trace.teams) {
            let d2 = |[ax, ay]: [f32; 2], [bx, by]: [f32; 2]| {
                let (dx, dy) = (bx - ax, by - ay);
                dx * dx + dy * dy
            };
            for (i, a) in moments.iter().enumerate() {
                if i < leaders {
                    let near = world.pois.iter().filter(|poi| d2(a.position, poi.to_array()) <= sense.poi_range2);
                    sensed_pois += near.count() as u64;
                }
                for (j, b) in moments.iter().enumerate().skip(i + 1) {
                    let d2 = d2(a.position, b.position);
                    let (senses, draws) = (d2 <= sense.agent_range2, d2 <= follow.attraction_radius2);
                    // The first of the two is a leader if either is.
                    let (first_leads, second_leads) = (i < leaders, j < leaders);
                    let sensing = u64::from(senses && first_leads) + u64::from(senses && second_leads);
                    let drawing = u64::from(draws && !first_leads) + u64::from(draws && !second_leads);
                    sensed_agents += sensing;
                    drawn += drawing;
                    seen += u64::from(draws && first_leads && !second_leads);
                    pairs += u64::from(sensing + drawing > 0);
                }
            }
        }
        let mean = |count: u64| count as f64 / (world.steps() * trace.teams) as f64;
        Reach {
            sensed_pois: mean(sensed_pois),
            sensed_agents: mean(sensed_agents),
            drawn: mean(drawn),
            seen: mean(seen),
            pairs: mean(pairs),
        }
    }
}

/// Lane operations of [`kernels`](flotilla::kernels): an f32 or integer operation, a comparison or a selection is one.
mod kernel {
    /// [`rsqrt`](flotilla::kernels::math::rsqrt).
    pub(crate) const RSQRT: u32 = 12;
    /// [`exact_sqrt`](flotilla::kernels::math::exact_sqrt).
    pub(crate) const SQRT: u32 = 12;
    /// [`recip`](flotilla::kernels::math::recip).
    pub(crate) const RECIP: u32 = 8;
    /// [`limit_tanh`](flotilla::kernels::math::limit_tanh) and [`half_tanh`](flotilla::kernels::math::half_tanh).
    pub(crate) const TANH: u32 = CLAMP + 1 // the square
        + 5 + 3 // numerator and denominator
        + 3 + 4 + 6; // the sum of their squares, its rough reciprocal, the quotient
    /// [`sin_cos`](flotilla::kernels::math::sin_cos).
    pub(crate) const SIN_COS: u32 = 26;
    /// [`flush`](flotilla::kernels::math::flush).
    pub(crate) const FLUSH: u32 = 3;
    /// Minimum and maximum.
    pub(crate) const CLAMP: u32 = 2;
    /// An offset and its squared length: 2 differences, 2 products, a sum.
    pub(crate) const SQUARED_DISTANCE: u32 = 5;
    /// A rotation, or an offset relative to a heading: 4 products, 2 sums.
    pub(crate) const ROTATE: u32 = 6;
}
use kernel::*;

/// A leader converts and scales its 8 sums. The quadrants follow from the halves by 5 differences and sums per kind.
const SCALE_INPUTS: u32 = 2 * INPUTS as u32 + 2 * 5;
/// A leader turns.
const TURN: u32 = CLAMP + SIN_COS + ROTATE;
/// An agent moves.
const MOVE: u32 = 3 + 2 + 2 + 2 * FLUSH // heading: square, scale, 2 products, 2 flushes
    + 2 + 2 * CLAMP // speed: a change within limits
    + 1 // a product that both axes share
    + 2 * (2 + 4 + CLAMP); // position, per axis: step, rounding to the grid, map
/// A leader chooses a behaviour.
const CHOOSE: u32 = 4 * 3 // the largest output: 4 comparisons with 2 selections each
    + 2 * (3 * 3 + 3 + 2) // per kind of entity: the largest quadrant, the opposite one, whether there is any
    + 8; // kind, direction, the two actions
/// A follower meets an agent within the attraction radius.
const INFLUENCE: u32 = SQUARED_DISTANCE + 3 // 2 tests and their difference
    + 2 * LATTICE // both offsets
    + 4 + 4 // 4 selections, 4 sums
    + 2; // 2 counts
/// A number is put on a lattice: a sum, a difference.
const LATTICE: u32 = 2;
/// A follower counts a leader that it sees.
const SEE: u32 = 1;
/// A follower steers, whoever it met.
const FOLLOW: u32 = FORCE + INFLUENCED + STEER;
/// The force on a follower.
const FORCE: u32 = 2 * (RECIP + 3) // means: the reciprocal of a count of at least 1, scaled
    + 2 * (2 + 4) // per axis: two sums, converted and weighted
    + 2 * (3 + 2 + 1 + 1) // per axis, walls: 3 differences, 2 maxima, a difference, a gain
    + 2 * FLUSH;
/// The test whether anything is near.
const INFLUENCED: u32 = 2 // the sum of the counts, its test
    + 3 + 1 // the nearest of 4 walls, its test
    + 1; // either of them
/// A follower turns towards the force.
const STEER: u32 = 3 + RSQRT + 2 // the force's square and direction
    + 6 // along and across the heading
    + 2 + ROTATE // the maximum turn to the force's side
    + WITHIN + 4 // the new heading: 4 selections
    + 2 + 3 // the speed ahead, 3 selections of the speed
    + 2; // 2 tests of the force
/// The test whether the force is within the maximum turn: the sine, its size, and a test that is already counted.
const WITHIN: u32 = 3;
/// An agent is tested for a POI and added to its set: a test, a selection, a union.
const OBSERVE: u32 = SQUARED_DISTANCE + 3;

/// Returns the operations of a leader that senses one entity.
fn sense(density: Density) -> u32 {
    let density = match density {
        // A root, scaled and subtracted from 1 on the lattice.
        Density::Linear => SQRT + LATTICE + 1,
        // An inverse root of at least 1.
        Density::Inverse => RSQRT + 2 + LATTICE,
        // Also a count: at most 1, its selections and sums.
        Density::Mean => RSQRT + 2 + LATTICE + 1 + 3 + 4,
    };
    SQUARED_DISTANCE + ROTATE
        + 2 // the range: a test, a selection
        + 4 + 4 // the quadrant: 4 tests, their combinations
        + 3 + 4 // 3 selections of halves, 4 sums
        + density
}

/// Returns the operations of one leader's policy: a product and a sum per weight, an activation per unit, and the
/// conversion of the outputs to a wanted turn and speed. A bias starts a sum.
fn decide(policy: &PolicyConstants) -> u32 {
    let layers = policy.widths[..=policy.layers as usize].windows(2);
    let chosen = if policy.actions() == Some(Actions::Behaviours) { CHOOSE } else { 0 };
    layers.map(|widths| widths[1] * (2 * widths[0] + FLUSH + TANH)).sum::<u32>() + chosen + 1 + 3
}

/// Returns the lane operations per team-step.
pub fn per_team_step(world: &World, reach: &Reach) -> f64 {
    let Constants { variant, policy, .. } = world.constants;
    let count = |count: usize, operations: u32| count as f64 * f64::from(operations);
    let sensed = (reach.sensed_pois + reach.sensed_agents) * f64::from(sense(variant.density()));
    let met = reach.drawn * f64::from(INFLUENCE) + reach.seen * f64::from(SEE);
    sensed
        + met
        + count(world.leaders(), SCALE_INPUTS + decide(&policy) + TURN)
        + count(world.followers(), FOLLOW)
        + count(world.agents(), MOVE)
        + count(world.agents() * world.pois.len(), OBSERVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use flotilla::backend::cpu::Cpu;
    use flotilla::backend::{Backend, Group};
    use flotilla::config::Config;
    use flotilla::sample;

    fn world(text: &str) -> World {
        World::new(&Config::parse(text, "test.toml").unwrap().validate().expect("a good config"))
    }

    fn reach(world: &World, teams: usize) -> Reach {
        let weights = sample::weights(world, teams, 0);
        let order: Vec<u32> = (0..teams as u32).flat_map(|team| vec![team; world.leaders()]).collect();
        let group = Group {
            world,
            starts: &world.starts,
            weights: weights[..].into(),
            policies: teams,
            populations: &world.populations,
            teams: &order,
            fitnesses: &[],
        };
        Reach::of(world, &Cpu::default().trace(&group).expect("the CPU plays"))
    }

    #[test]
    fn an_agent_alone() {
        let world = world("[world]\nleaders = [[10, 5]]\npois = [[10, 15], [40, 40]]\nsteps = 1\ncoupling = 1\n");
        let reach = reach(&world, 3);
        assert_eq!(reach, Reach { sensed_pois: 2.0, ..Reach::default() });
        // 2 POIs sensed; 8 inputs; 10 units of 8 inputs and 2 of 10; the turn and the speed; the move; 2 POIs tested.
        let units = 10.0 * (16.0 + 27.0) + 2.0 * (20.0 + 27.0);
        assert_eq!(per_team_step(&world, &reach), 2.0 * 43.0 + 26.0 + units + 38.0 + 36.0 + 2.0 * 8.0);
    }

    #[test]
    fn pairs_are_counted_from_both_sides() {
        // At the start, all of the first step: two leaders in reach of each other, a follower in reach of one, and a
        // follower alone.
        let world = world(
            "[world]\nleaders = [[10, 5], [14, 5]]\nfollowers = [[17, 5], [40, 40]]\npois = [[10, 15]]\nsteps = 1\n\
             coupling = 1\n[sense]\npoi_range = 10.5\nagent_range = 4\n",
        );
        let reach = reach(&world, 2);
        // The follower stands 3 from the second leader, who senses it; both leaders sense each other.
        let expected = Reach { sensed_pois: 1.0, sensed_agents: 3.0, drawn: 1.0, seen: 1.0, pairs: 2.0 };
        assert_eq!(reach, expected);
    }
}
