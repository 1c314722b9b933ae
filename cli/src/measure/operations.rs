//! The minimum number of lane operations per team-step, counted from the formulas and from a trace of random teams.
//!
//! | counted | not counted |
//! |---|---|
//! | each f32 or integer operation, comparison and selection of [`flotilla::model`] | constants and moves |
//! | what two formulas share, once | idle lanes, loads and stores, scoring |
//! | entities in reach of an agent of their team | tests of pairs that are out of reach |

use flotilla::backend::Trace;
use flotilla::config::{Combine, ControlKind, Measure};
use flotilla::model;
use flotilla::model::class::Class;
use flotilla::model::policy::{Actions, PolicyConstants};
use flotilla::model::sense::ChannelConstants;
use flotilla::world::World;

/// Numbers of entities in reach of agents, as means over a trace's teams and steps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reach {
    /// Entities within the range of each channel, summed over the agents of its class, `[classes][channels]`.
    pub sensed: Vec<Vec<f64>>,
    /// Agents within the distance of each term, summed over the agents of its class, `[classes][terms]`.
    pub met: Vec<Vec<f64>>,
    /// Leaders within the distance of influence, summed over followers.
    pub seen: f64,
    /// Pairs of agents of which one matters to the other, each counted once.
    pub pairs: f64,
}

impl Reach {
    /// Computes the means of a trace, from the state before each step.
    pub fn of(world: &World, trace: &Trace) -> Reach {
        let agents = world.agents();
        let zeros = |of: &dyn Fn(&Class) -> usize| -> Vec<Vec<f64>> {
            world.classes.iter().map(|class| vec![0.0; of(class)]).collect()
        };
        let (mut sensed, mut met) = (zeros(&|class| class.channels().len()), zeros(&|class| class.terms().len()));
        let [mut seen, mut pairs] = [0.0; 2];
        // Of a large class every n-th agent is looked at, and stands for as many as it is one of.
        let most = (LOOKED_AT / agents).clamp(16, 1024);
        let looked_at = |class: &Class| class.agents().step_by(class.agents().len().div_ceil(most).max(1));
        let stands_for =
            |class: &Class| class.agents().len() as f64 / (looked_at(class).len() * world.steps() * trace.teams) as f64;
        let class_of: Vec<usize> =
            world.classes.iter().enumerate().flat_map(|(index, class)| vec![index; class.agents().len()]).collect();
        for moments in trace.moments.chunks_exact(agents).take(world.steps() * trace.teams) {
            let d2_of = |[ax, ay]: [f32; 2], [bx, by]: [f32; 2]| {
                let (dx, dy) = (bx - ax, by - ay);
                dx * dx + dy * dy
            };
            let d2 = |i: usize, j: usize| d2_of(moments[i].position, moments[j].position);
            let sees = |i: usize, j: usize| {
                let leads = j < world.leaders() && i >= world.leaders();
                leads && d2(i, j) <= world.classes[class_of[j]].constants.influence2[class_of[i]]
            };
            let has = |ranges: &model::Ranges, j: usize| model::each(ranges).any(|range| range.contains(&j));
            let matters = |i: usize, j: usize| {
                let (class, d2) = (&world.classes[class_of[i]], d2(i, j));
                let of_agents = class.channels().iter().filter(|channel| channel.shape.of_pois == 0);
                of_agents.into_iter().any(|channel| d2 <= channel.range2 && has(&channel.shape.ranges, j))
                    || class.terms().iter().any(|term| d2 <= term.outer2 && has(&term.shape.ranges, j))
                    || sees(i, j)
            };
            for (i, class) in world.classes.iter().flat_map(|class| looked_at(class).map(move |i| (i, class))) {
                let (a, share) = (&moments[i], stands_for(class));
                let others = |ranges: &model::Ranges, counts: &dyn Fn(usize) -> bool| {
                    model::each(ranges).flatten().filter(|&j| j != i && counts(j)).count()
                };
                for (channel, sensed) in class.channels().iter().zip(&mut sensed[class_of[i]]) {
                    let near = if channel.shape.of_pois == 0 {
                        others(&channel.shape.ranges, &|j| d2(i, j) <= channel.range2)
                    } else {
                        let pois = model::each(&channel.shape.ranges).flatten();
                        let place = |poi: usize| world.pois[poi].to_array();
                        pois.filter(|&poi| d2_of(a.position, place(poi)) <= channel.range2).count()
                    };
                    *sensed += near as f64 * share;
                }
                for (term, met) in class.terms().iter().zip(&mut met[class_of[i]]) {
                    let is_met = |j: usize| d2(i, j) <= term.outer2 && d2(i, j) > term.inner2;
                    *met += others(&term.shape.ranges, &is_met) as f64 * share;
                }
                seen += (0..world.leaders()).filter(|&j| sees(i, j)).count() as f64 * share;
                let in_reach = (0..agents).filter(|&j| j != i && (matters(i, j) || matters(j, i)));
                pairs += in_reach.count() as f64 * share / 2.0;
            }
        }
        Reach { sensed, met, seen, pairs }
    }
}

/// About as many pairs of agents are looked at, per class and step.
const LOOKED_AT: usize = 1 << 24;

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
    /// [`exp_negative`](flotilla::kernels::math::exp_negative).
    pub(crate) const EXP: u32 = 25;
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

/// A channel of quadrants converts and scales its 4 sums. These follow from the halves by 5 differences and sums.
const SCALE_QUADRANTS: u32 = 2 * 4 + 5;
/// A leader turns.
const TURN: u32 = CLAMP + SIN_COS + ROTATE;
/// An agent moves.
const MOVE: u32 = 3 + 2 + 2 + 2 * FLUSH // heading: square, scale, 2 products, 2 flushes
    + 2 + 2 * CLAMP // speed: a change within limits
    + 1 // a product that both axes share
    + 2 * (2 + 4 + CLAMP); // position, per axis: step, rounding to the grid, map
/// An agent moves freely, per axis: step, rounding to the grid, map.
const MOVE_FREELY: u32 = 2 * (2 + 4 + CLAMP);
/// A leader chooses a behaviour.
const CHOOSE: u32 = 4 * 3 // the largest output: 4 comparisons with 2 selections each
    + 2 * (3 * 3 + 3 + 2) // per kind of entity: the largest quadrant, the opposite one, whether there is any
    + 8; // kind, direction, the two actions
/// An agent meets another that counts for one of its terms.
const MEET: u32 = SQUARED_DISTANCE + 3 // 2 tests, both of them
    + 2 * LATTICE // both offsets
    + 2 + 2 // 2 selections, 2 sums
    + 1; // a count
/// A number is put on a lattice: a sum, a difference.
const LATTICE: u32 = 2;
/// A follower counts a leader that it sees.
const SEE: u32 = 1;
/// A follower steers, whoever it met.
const FOLLOW: u32 = WALLS + INFLUENCED + STEER;
/// The force of a term: the reciprocal of a count of at least 1, scaled; per axis a sum, converted, weighted and added; and
/// the sum of the counts.
const TERM: u32 = RECIP + 3 + 2 * 3 + 1;
/// The push of walls, and the whole force.
const WALLS: u32 = 2 * (3 + 2 + 1 + 1) // per axis: 3 differences, 2 maxima, a difference, a gain
    + 2 // the sums
    + 2 * FLUSH;
/// The test whether anything is near.
const INFLUENCED: u32 = 1 // the test of the sum of the counts
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
/// An agent to which, or near which, another one may move: two tests, three selections.
const PURSUE: u32 = SQUARED_DISTANCE + 5;
/// An agent is tested for a POI and added to its set: a test, a selection, a union.
const OBSERVE: u32 = SQUARED_DISTANCE + 3;

/// Returns the operations of an agent that senses one entity.
fn sense(channel: &ChannelConstants) -> u32 {
    let valued = if channel.shape.of_pois != 0 { 1 } else { 0 };
    let measure = match Measure::of(channel.shape.measure) {
        // A root, scaled and subtracted from 1 on the lattice.
        Measure::Linear | Measure::Closeness => SQRT + LATTICE + 1 + valued,
        Measure::Distance => SQRT + LATTICE + 1 + valued,
        // An inverse root of at least 1.
        Measure::Inverse => RSQRT + 1 + LATTICE + valued,
        Measure::InverseSquared => RSQRT + 2 + LATTICE + valued,
        Measure::Exponential => SQRT + EXP + LATTICE + valued,
    };
    // The number, its selections and sums.
    let counted = if channel.shape.counts != 0 { 1 + 3 + 4 } else { 0 };
    let sectors = match (channel.shape.sectors, Combine::of(channel.shape.combine)) {
        _ if channel.shape.each != 0 => 1,
        // 4 tests, their combinations, 3 selections of halves, 4 sums.
        (4, Combine::Share | Combine::Sum | Combine::Mean) => 4 + 4 + 3 + 4 + counted,
        // Per sector: two products, their difference, as many for the tie, its tests, selections and sums.
        (sectors, _) => sectors * (3 + 3 + 3 + 2 + 4),
    };
    SQUARED_DISTANCE + ROTATE
        + 2 // the range: a test, a selection
        + sectors
        + measure
}

/// Returns the operations of an agent that turns the sums of a channel into inputs.
fn scale(channel: &ChannelConstants) -> u32 {
    let of_mean = if channel.shape.combine == Combine::Mean as u32 { RECIP + 3 } else { 0 };
    match channel.shape.sectors {
        4 => SCALE_QUADRANTS + 4 * of_mean,
        sectors => sectors * (2 + of_mean),
    }
}

/// Returns the operations of one leader's policy: a product and a sum per weight, an activation per unit, and the
/// conversion of the outputs to a wanted turn and speed. A bias starts a sum.
fn decide(policy: &PolicyConstants) -> u32 {
    let layers = policy.widths[..=policy.layers as usize].windows(2);
    let chosen = if policy.actions() == Actions::Behaviours { CHOOSE } else { 0 };
    layers.map(|widths| widths[1] * (2 * widths[0] + FLUSH + TANH)).sum::<u32>() + chosen + 1
}

/// Returns the lane operations per team-step.
pub fn per_team_step(world: &World, reach: &Reach) -> f64 {
    let count = |count: f64, operations: u32| count * f64::from(operations);
    let per_class = |(index, class): (usize, &Class)| {
        let agents = class.agents().len() as f64;
        let channels = class.channels().iter().zip(&reach.sensed[index]);
        let sensing: f64 =
            channels.map(|(channel, &sensed)| count(sensed, sense(channel)) + count(agents, scale(channel))).sum();
        let met: f64 = reach.met[index].iter().map(|&met| count(met, MEET) + count(agents, TERM)).sum();
        let shape = &class.constants.shape;
        let pursuit = (shape.end_target - shape.first_target) * PURSUE + (shape.end_near - shape.first_near) * PURSUE;
        let control = match (shape.control(), shape.free != 0) {
            (ControlKind::Policy, free) => {
                decide(&world.constants.policy)
                    + if free { 2 } else { TURN + 3 }
                    + if free { MOVE_FREELY } else { MOVE }
            }
            (ControlKind::Choose, free) => {
                decide(&world.constants.policy) + if free { MOVE_FREELY } else { STEER + MOVE }
            }
            (ControlKind::Follow, true) => WALLS + INFLUENCED + 2 * CLAMP + MOVE_FREELY,
            (ControlKind::Follow, false) => FOLLOW + MOVE,
            (ControlKind::Nearest, free) => {
                if free {
                    MOVE_FREELY
                } else {
                    STEER + MOVE
                }
            }
            (ControlKind::Still, _) => 0,
        };
        sensing + met + count(agents, control + pursuit)
    };
    world.classes.iter().enumerate().map(per_class).sum::<f64>()
        + count(reach.seen, SEE + SQUARED_DISTANCE + 1)
        + count((world.agents() * world.pois.len()) as f64, OBSERVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use flotilla::backend::cpu::Cpu;
    use flotilla::backend::{Backend, Group};
    use flotilla::config::Config;
    use flotilla::evolve::aligned_teams;
    use flotilla::sample;

    fn world(text: &str) -> World {
        World::new(&Config::parse(text, "test.toml").unwrap().validate().expect("a good config"))
    }

    fn reach(world: &World, teams: usize) -> Reach {
        let weights = sample::weights(world, teams, 0);
        let order = aligned_teams(teams, world.leaders());
        let group = Group::new(world, &weights[..], teams, &order);
        Reach::of(world, &Cpu::default().trace(&group).expect("the CPU plays"))
    }

    #[test]
    fn an_agent_alone() {
        let world = world("[world]\nleaders = [[10, 5]]\npois = [[10, 15], [40, 40]]\nsteps = 1\ncoupling = 1\n");
        let reach = reach(&world, 3);
        let expected = Reach { sensed: vec![vec![2.0, 0.0]], met: vec![vec![]], ..Reach::default() };
        assert_eq!(reach, expected);
        // 2 POIs sensed; 8 inputs; 10 units of 8 inputs and 2 of 10; the turn and the speed; the move; 2 POIs tested.
        let units = 10.0 * (16.0 + 27.0) + 2.0 * (20.0 + 27.0);
        assert_eq!(per_team_step(&world, &reach), 2.0 * 44.0 + 26.0 + units + 38.0 + 36.0 + 2.0 * 8.0);
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
        let expected =
            Reach { sensed: vec![vec![1.0, 3.0], vec![]], met: vec![vec![], vec![0.0, 1.0]], seen: 1.0, pairs: 2.0 };
        assert_eq!(reach, expected);
    }
}
