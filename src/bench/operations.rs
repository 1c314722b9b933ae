//! How many lane operations a team-step takes at least, counted from the formulas and from who is in reach of whom.
//!
//! Counted is what the episode's definition asks of any implementation of [`crate::kernels`]: each f32 or integer
//! operation, comparison and selection is one, constants and moves are free, and what two formulas share is counted
//! once. An entity counts where it is in reach of its own team's agent, as a trace of random teams finds it. Not
//! counted is what an implementation adds: testing pairs that turn out to be out of reach, lanes that wait for their
//! neighbours, loading and storing, scoring.

use crate::backend::Trace;
use crate::world::{Constants, OUTPUTS, World};

/// The functions of [`crate::kernels::math`].
const RSQRT: u32 = 12;
const ROOT: u32 = 12;
const RECIP: u32 = 8;
/// A bound, a square, 5 and 3 for numerator and denominator; their squares' sum, its rough reciprocal (4) and 6 more.
const TANH: u32 = BOUND + 1 + 5 + 3 + 3 + 4 + 6;
const SIN_COS: u32 = 26;
const FLUSH: u32 = 3;

/// An offset and its square: 2 differences, 2 products, a sum.
const SQUARED_DISTANCE: u32 = 5;
/// A rotation, or an offset seen from a heading: 4 products, 2 sums.
const ROTATE: u32 = 6;
/// A clamp: minimum and maximum.
const BOUND: u32 = 2;

/// A leader senses an entity: the range's test and selection, the quadrant's 4 tests and what joins them (4), 2 selections
/// by the side and 4 by the front, 4 sums; and the density, see [`density`].
const SENSE: u32 = SQUARED_DISTANCE + ROTATE + 2 + 4 + 4 + 2 + 4 + 4;
/// A density is weighed by the share of its kind, 8 times a leader.
const INPUTS: u32 = 8;
/// A unit's activation.
const ACTIVATE: u32 = FLUSH + TANH;
/// A policy's outputs become a turned heading (scaled, bounded, rotated) and a wanted speed.
const DECIDE: u32 = 1 + BOUND + SIN_COS + ROTATE + 3;

/// A follower meets an agent within its attraction radius: 2 tests and their difference, 4 selections, 4 sums, 2
/// counts.
const INFLUENCE: u32 = SQUARED_DISTANCE + 3 + 4 + 4 + 2;
/// That agent is a leader: counted.
const SEEN: u32 = 1;
/// A follower's force: 2 means (a reciprocal of a count of at least 1, scaled), and on each axis the two weighed sums
/// (4), the walls (3 differences, 2 maxima, a difference, a gain) and a flush.
const FORCE: u32 = 2 * (RECIP + 3) + 2 * (4 + 7 + FLUSH);
/// Whether anything is near: the counts' sum and test, the nearest of 4 walls and its test, and joining them.
const INFLUENCED: u32 = 2 + 3 + 1 + 1;
/// A follower steers: the force's square and direction (3, an inverse root, 2), along and across (6), the largest turn
/// to its side (2 and a rotation), whether the force lies within it, 4 selections of the heading, the speed ahead (2)
/// and 3 selections of the speed, 2 tests of the force.
const STEER: u32 = 3 + RSQRT + 2 + 6 + 2 + ROTATE + WITHIN + 4 + 2 + 3 + 2;
/// A test of the sine and its size, joined to one that is counted already.
const WITHIN: u32 = 3;

/// An agent moves: the heading straightened (its square 3, a scale 2, 2 products, 2 flushes), the speed brought up
/// within 2 bounds, and on each axis a step (after one common product), snapped to the grid (4) and kept on the map.
const MOVE: u32 = 3 + 2 + 2 + 2 * FLUSH + (2 + 2 * BOUND) + 1 + 2 * (2 + 4 + BOUND);
/// An agent is tested for a POI and noted in its set: a test, a selection, a union.
const OBSERVE: u32 = SQUARED_DISTANCE + 3;

/// Who is in reach of whom, in the mean over a trace's teams and steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reach {
    /// POIs and agents within the ranges of a leader, summed over leaders.
    pub sensed_pois: f64,
    pub sensed_agents: f64,
    /// Agents within the attraction radius of a follower, summed over followers, and how many of those are leaders.
    pub drawn: f64,
    pub seen: f64,
    /// Pairs of agents of which one senses or is drawn to the other, each counted once.
    pub pairs: f64,
}

impl Reach {
    /// Of a trace in its world, from the state before each step.
    pub fn of(world: &World, trace: &Trace) -> Reach {
        let Constants { agent_range2, poi_range2, attraction_radius2, .. } = world.constants;
        let (agents, leaders) = (world.agents(), world.leaders());
        let [mut sensed_pois, mut sensed_agents, mut drawn, mut seen, mut pairs] = [0u64; 5];
        for moments in trace.moments.chunks_exact(agents).take(world.steps() * trace.teams) {
            let d2 = |[ax, ay]: [f32; 2], [bx, by]: [f32; 2]| {
                let (dx, dy) = (bx - ax, by - ay);
                dx * dx + dy * dy
            };
            for (i, a) in moments.iter().enumerate() {
                if i < leaders {
                    let near = world.pois.iter().filter(|poi| d2(a.position, poi.to_array()) <= poi_range2);
                    sensed_pois += near.count() as u64;
                }
                for (j, b) in moments.iter().enumerate().skip(i + 1) {
                    let d2 = d2(a.position, b.position);
                    let (senses, draws) = (d2 <= agent_range2, d2 <= attraction_radius2);
                    // The earlier of the two is a leader if any is.
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

/// Lane operations of one team-step.
pub fn per_team_step(world: &World, reach: &Reach) -> f64 {
    let count = |count: usize, operations: u32| count as f64 * f64::from(operations);
    let sensed = (reach.sensed_pois + reach.sensed_agents) * f64::from(SENSE + density(&world.constants));
    let met = reach.drawn * f64::from(INFLUENCE) + reach.seen * f64::from(SEEN);
    sensed
        + met
        + count(world.leaders(), INPUTS + network(&world.constants) + DECIDE)
        + count(world.followers(), FORCE + INFLUENCED + STEER)
        + count(world.agents(), MOVE)
        + count(world.agents() * world.pois.len(), OBSERVE)
}

/// The value of a sensed entity: a root, scaled and taken from 1, or an inverse root of at least 1.
fn density(world: &Constants) -> u32 {
    if world.density == 0 { ROOT + 2 } else { RSQRT + 2 }
}

/// A policy: a product and a sum a weight (the bias is where a sum starts), and every unit's activation.
fn network(world: &Constants) -> u32 {
    let layers = world.widths[..=world.layers as usize].windows(2);
    debug_assert_eq!(world.widths[world.layers as usize], OUTPUTS as u32);
    layers.map(|widths| widths[1] * (2 * widths[0] + ACTIVATE)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::cpu::Cpu;
    use crate::backend::{Backend, Group, Need};
    use crate::config::Config;
    use crate::sample;

    fn world(text: &str) -> World {
        World::new(&Config::parse(text, "test.toml").expect("a good config"))
    }

    fn reach(world: &World, teams: usize) -> Reach {
        let weights = sample::weights(world, teams, 0);
        let order: Vec<u32> = (0..teams as u32).flat_map(|team| vec![team; world.leaders()]).collect();
        let need = Need::Record;
        let group =
            Group { world, starts: &world.starts, weights: weights[..].into(), policies: teams, teams: &order, need };
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
