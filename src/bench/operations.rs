//! The minimum number of lane operations per team-step, counted from the formulas and from who is in reach of whom.
//!
//! Counted is what any implementation of [`crate::model`] has to compute: each f32 or integer operation, comparison and
//! selection is one. Constants and moves are free, and what two formulas share counts once. An entity counts if it is
//! in reach of an agent of its own team, in a trace of random teams. Not counted is what an implementation adds:
//! testing pairs that are out of reach, idle lanes, loads and stores, scoring.

use crate::backend::Trace;
use crate::model::Constants;
use crate::model::policy::{Actions, PolicyConstants};
use crate::model::sense::Density;
use crate::world::{INPUTS, World};

/// Who is in reach of whom, as means over a trace's teams and steps.
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

/// Lane operations of [`kernels`](crate::kernels): an f32 or integer operation, a comparison or a selection is one.
mod kernel {
    /// [`rsqrt`](crate::kernels::math::rsqrt).
    pub(crate) const RSQRT: u32 = 12;
    /// [`exact_sqrt`](crate::kernels::math::exact_sqrt).
    pub(crate) const SQRT: u32 = 12;
    /// [`recip`](crate::kernels::math::recip).
    pub(crate) const RECIP: u32 = 8;
    /// A clamp, a square, 5 and 3 for numerator and denominator; their squares' sum, its rough reciprocal (4) and 6
    /// more.
    pub(crate) const TANH: u32 = CLAMP + 1 + 5 + 3 + 3 + 4 + 6;
    /// [`sin_cos`](crate::kernels::math::sin_cos).
    pub(crate) const SIN_COS: u32 = 26;
    /// [`flush`](crate::kernels::math::flush).
    pub(crate) const FLUSH: u32 = 3;
    /// Minimum and maximum.
    pub(crate) const CLAMP: u32 = 2;
    /// An offset and its squared length: 2 differences, 2 products, a sum.
    pub(crate) const SQUARED_DISTANCE: u32 = 5;
    /// A rotation, or an offset relative to a heading: 4 products, 2 sums.
    pub(crate) const ROTATE: u32 = 6;
}
use kernel::*;

/// A leader weights its 8 sums.
const WEIGHT_INPUTS: u32 = INPUTS as u32;
/// A leader turns: clamp, sine and cosine, rotation.
const TURN: u32 = CLAMP + SIN_COS + ROTATE;
/// An agent moves: the heading is renormalized (its square 3, a scale 2, 2 products, 2 flushes), the speed changed
/// within 2 clamps, and on each axis a step (after one common product) rounded to the grid (4) and clamped to the map.
const MOVE: u32 = 3 + 2 + 2 + 2 * FLUSH + (2 + 2 * CLAMP) + 1 + 2 * (2 + 4 + CLAMP);
/// A leader chooses a behaviour: 4 comparisons with 2 selections each; per kind of entity 3 such, the opposite quadrant
/// (a comparison, a selection, a sum) and whether there is any (2); then kind, direction and the two actions.
const CHOOSE: u32 = 4 * 3 + 2 * (3 * 3 + 3 + 2) + 8;
/// A follower meets an agent within the attraction radius: 2 tests and their difference, 4 selections, 4 sums, 2
/// counts.
const INFLUENCE: u32 = SQUARED_DISTANCE + 3 + 4 + 4 + 2;
/// A follower counts a leader that it sees.
const SEE: u32 = 1;
/// A follower steers, whoever it met.
const FOLLOW: u32 = FORCE + INFLUENCED + STEER;
/// The force: 2 means (a reciprocal of a count of at least 1, scaled), and on each axis the two weighted sums (4), the
/// walls (3 differences, 2 maxima, a difference, a gain) and a flush.
const FORCE: u32 = 2 * (RECIP + 3) + 2 * (4 + 7 + FLUSH);
/// Whether anything is near: the counts' sum and test, the nearest of 4 walls and its test, and their union.
const INFLUENCED: u32 = 2 + 3 + 1 + 1;
/// Steering: the force's square and direction (3, an inverse root, 2), along and across (6), the maximum turn to its
/// side (2 and a rotation), whether the force is within it, 4 selections of the heading, the speed ahead (2) and 3
/// selections of the speed, 2 tests of the force.
const STEER: u32 = 3 + RSQRT + 2 + 6 + 2 + ROTATE + WITHIN + 4 + 2 + 3 + 2;
/// A test of the sine and its size, combined with one that is counted already.
const WITHIN: u32 = 3;
/// An agent is tested for a POI and added to its set: a test, a selection, a union.
const OBSERVE: u32 = SQUARED_DISTANCE + 3;

/// Returns the operations of a leader that senses one entity: the test of the range and a selection, the quadrant's 4
/// tests and their combination (4), 2 selections by side and 4 by front, 4 sums; and the density: a root, scaled and
/// subtracted from 1, or an inverse root of at least 1.
fn sense(density: Density) -> u32 {
    let density = match density {
        Density::Linear => SQRT + 2,
        Density::Inverse => RSQRT + 2,
    };
    SQUARED_DISTANCE + ROTATE + 2 + 4 + 4 + 2 + 4 + 4 + density
}

/// Returns the operations of one leader's policy: a product and a sum per weight (the bias starts a sum), every unit's
/// activation, and the outputs' conversion to a wanted turn and speed.
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
        + count(world.leaders(), WEIGHT_INPUTS + decide(&policy) + TURN)
        + count(world.followers(), FOLLOW)
        + count(world.agents(), MOVE)
        + count(world.agents() * world.pois.len(), OBSERVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::cpu::Cpu;
    use crate::backend::{Backend, Group};
    use crate::config::{Config, Sharing};
    use crate::sample;

    fn world(text: &str) -> World {
        World::new(&Config::parse(text, "test.toml").expect("a good config"))
    }

    fn reach(world: &World, teams: usize) -> Reach {
        let weights = sample::weights(world, teams, 0);
        let order: Vec<u32> = (0..teams as u32).flat_map(|team| vec![team; world.leaders()]).collect();
        let group = Group {
            world,
            starts: &world.starts,
            weights: weights[..].into(),
            policies: teams,
            sharing: Sharing::PerLeader,
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
        assert_eq!(per_team_step(&world, &reach), 2.0 * 45.0 + 8.0 + units + 38.0 + 36.0 + 2.0 * 8.0);
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
