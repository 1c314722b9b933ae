//! The rule of agents that do not learn: a force from other agents and walls. The paper's followers are attracted by agents
//! in sight and repelled by close ones (Section 4.1, Figure 2b).

use std::ops::Range;

use fearless_simd::{Simd, prelude::*};

use super::classes::{AGENTS, AgentClass, Term};
use super::motion::{GRID, MotionConstants, MotionLanes, rotate};
use super::sense::NOTHING;
use super::{LONGEST, Ranges, TINY, one_range, ranges};
use crate::gpu_struct::gpu_struct;
use crate::kernels::{
    larger,
    math::{flush, lattice, nearest_f32, recip, rsqrt},
    select, splat, zero_unless,
};
use crate::reader::{Reader, between, section};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/follow.wgsl");

/// Maximum gain of a force.
const MAX_GAIN: f64 = 1e3;
/// The finest lattice of headings, on which they are added: 2^-20.
const FINEST_HEADING: f64 = 1.0 / 1_048_576.0;

section! {
    /// `[follow]`: the followers' preset behaviour.
    Follow = "follow" {
        /// a follower sees other agents within this distance: they attract it, and the leaders among them count for Df
        /// and Dt
        attraction_radius: f64 = "units", "4.1, 4.2",
        /// agents and walls within this distance repel a follower
        repulsion_radius: f64 = "units", "4.1",
        /// pull of others at the attraction radius
        attraction_gain: f64 = "units/s", "4.1, Fig. 2b",
        /// push of others at the repulsion radius
        repulsion_gain: f64 = "units/s", "4.1, Fig. 2b",
        /// push of a wall for each unit nearer than the repulsion radius
        wall_gain: f64 = "1/s", "",
    }
}

impl Follow {
    /// Reads the section.
    pub(crate) fn read(r: &mut Reader<'_>) -> Follow {
        let attraction_radius = Follow::attraction_radius(r).number(between(0.01, LONGEST), 5.0);
        let closest = between(0.01, attraction_radius).because("follow.attraction_radius");
        let gain = between(1e-3, MAX_GAIN).or_zero();
        Follow {
            attraction_radius,
            repulsion_radius: Follow::repulsion_radius(r).number(closest, 1.0),
            attraction_gain: Follow::attraction_gain(r).number(gain, 5.0),
            repulsion_gain: Follow::repulsion_gain(r).number(gain, 1.0),
            wall_gain: Follow::wall_gain(r).number(gain, 1.0),
        }
    }
}

gpu_struct! {
    /// The parts of a rule's term that kernels are specialised for.
    #[derive(Eq, Hash, Ord, PartialOrd)]
    pub struct TermShape as itself {
        /// Not 0 if it aligns headings, 0 if it pulls towards positions.
        pub aligns: u32,
        /// The agents that count.
        pub ranges: Ranges,
    }

    /// Constants of a rule's term.
    pub struct TermConstants as TermLanes {
        /// The parts that kernels are specialised for.
        pub shape: TermShape,
        /// The squared distance above which agents count.
        pub inner2: f32,
        /// The squared distance up to which agents count.
        pub outer2: f32,
        /// The gain over the outer distance, or of an alignment, per lattice distance.
        pub scale: f32,
    }

    /// Constants of a rule besides its terms.
    pub struct RuleConstants as RuleLanes {
        /// The distance within which walls push.
        pub wall_radius: f32,
        /// The x up to which the wall on the left pushes.
        pub near_x: f32,
        /// The y up to which the wall below pushes.
        pub near_y: f32,
        /// The push per unit that a wall is nearer than that.
        pub wall_gain: f32,
        /// The base of the lattice of offsets, on which they are added.
        pub offset_base: f32,
        /// The base of the lattice of headings.
        pub heading_base: f32,
    }
}

/// The lattice of offsets within these terms, in teams of so many agents, and that of headings: bases and distances.
fn lattices(terms: &[Term], agents: usize) -> [[f32; 2]; 2] {
    let farthest = terms.iter().map(|term| term.to).fold(0.0, f64::max);
    // Within a radius, which is squared and rounded, an offset may exceed it by rounding.
    [lattice(agents, farthest * 1.01, 1.0 / f64::from(GRID)), lattice(agents, 1.01, FINEST_HEADING)]
}

impl RuleConstants {
    /// Computes the constants of a class's rule, in teams of so many agents.
    pub(crate) fn new(class: &AgentClass, motion: &MotionConstants, agents: usize) -> RuleConstants {
        let [[offset_base, _], [heading_base, _]] = lattices(&class.rule, agents);
        RuleConstants {
            wall_radius: class.wall_radius as f32,
            near_x: motion.low_x + class.wall_radius as f32,
            near_y: motion.low_y + class.wall_radius as f32,
            wall_gain: class.wall_gain as f32,
            offset_base,
            heading_base,
        }
    }
}

impl TermConstants {
    /// Computes the constants of each term of a class's rule, in teams of so many agents. `of` returns the agents of a
    /// class.
    pub(crate) fn all(class: &AgentClass, of: &dyn Fn(&str) -> Range<usize>, agents: usize) -> Vec<TermConstants> {
        let [[_, offset], [_, heading]] = lattices(&class.rule, agents);
        let term = |term: &Term| {
            let ranges =
                if term.of == [AGENTS] { one_range(0..agents) } else { ranges(term.of.iter().map(|name| of(name))) };
            let scale = match term.align {
                Some(gain) => gain * f64::from(heading),
                None => term.gain.unwrap_or(0.0) / term.to * f64::from(offset),
            };
            TermConstants {
                shape: TermShape { aligns: term.align.is_some().into(), ranges },
                inner2: if term.from == 0.0 { NOTHING } else { (term.from * term.from) as f32 },
                outer2: (term.to * term.to) as f32,
                scale: scale as f32,
            }
        };
        class.rule.iter().map(term).collect()
    }
}

/// Returns the terms that are added together, each alone or two rings: one without an inner radius, and the one around it
/// that counts the same agents and adds the same quantity.
pub(crate) fn rings(terms: &[TermConstants]) -> Vec<Range<usize>> {
    let mut rings: Vec<Range<usize>> = vec![];
    for (index, outer) in terms.iter().enumerate() {
        let is_around = |inner: &TermConstants| {
            inner.shape == outer.shape
                && inner.inner2 < 0.0
                && outer.inner2 == inner.outer2
                && outer.outer2 >= inner.outer2
        };
        match rings.last_mut() {
            Some(ring) if ring.len() == 1 && is_around(&terms[ring.start]) => ring.end += 1,
            _ => rings.push(index..index + 1),
        }
    }
    rings
}

/// The sum over the agents that count for a term, in lattice distances, and their number.
#[derive(Clone, Copy)]
pub(crate) struct Sum<S: Simd> {
    x: S::i32s,
    y: S::i32s,
    count: S::i32s,
}

impl<S: Simd> Sum<S> {
    #[inline(always)]
    pub(crate) fn new(simd: S) -> Sum<S> {
        let none = S::i32s::splat(simd, 0);
        Sum { x: none, y: none, count: none }
    }

    /// Adds an agent's offset or heading, on its lattice, in the lanes in which it counts.
    #[inline(always)]
    pub(crate) fn add(&mut self, counts: S::mask32s, [x, y]: [S::i32s; 2]) {
        let counts = counts.to_vector();
        self.x += x & counts;
        self.y += y & counts;
        self.count -= counts;
    }
}

/// The force on an agent that obeys a rule.
#[derive(Clone, Copy)]
pub struct SteeringForce<S: Simd> {
    /// Along x, in units per second.
    pub x: S::f32s,
    /// Along y, in units per second.
    pub y: S::f32s,
    /// The lanes in which any agent or wall is near.
    pub influenced: S::mask32s,
}

impl<S: Simd> SteeringForce<S> {
    /// Returns no force.
    #[inline(always)]
    pub(crate) fn none(simd: S) -> SteeringForce<S> {
        SteeringForce { x: splat(simd, 0.0), y: splat(simd, 0.0), influenced: S::mask32s::splat(simd, false) }
    }

    /// Adds a term, the scaled mean of its sum.
    #[inline(always)]
    pub(crate) fn add(&mut self, term: &TermLanes<S>, sum: &Sum<S>) {
        let scale = recip::<S>(nearest_f32::<S>(sum.count.max(1))) * term.scale;
        self.x += nearest_f32::<S>(sum.x) * scale;
        self.y += nearest_f32::<S>(sum.y) * scale;
        self.influenced |= sum.count.simd_gt(0);
    }

    /// Adds the walls' push at a position, after all terms.
    #[inline(always)]
    pub(crate) fn add_walls(&mut self, rule: &RuleLanes<S>, motion: &MotionLanes<S>, x: S::f32s, y: S::f32s) {
        let (push_x, near_x) = walls::<S>(rule, x, rule.near_x, motion.high_x);
        let (push_y, near_y) = walls::<S>(rule, y, rule.near_y, motion.high_y);
        self.x = flush::<S>(self.x + push_x, TINY);
        self.y = flush::<S>(self.y + push_y, TINY);
        self.influenced |= larger::<S>(near_x, near_y).simd_ge(0.0);
    }
}

/// Returns the push of the two walls of one axis, and a number that is not negative if either is within their radius. The
/// first pushes up to `near`, and the other is at `end`.
#[inline(always)]
fn walls<S: Simd>(rule: &RuleLanes<S>, at: S::f32s, near: S::f32s, end: S::f32s) -> (S::f32s, S::f32s) {
    let zero = splat(at.token(), 0.0);
    let low = near - at;
    let high = rule.wall_radius - (end - at);
    ((larger::<S>(low, zero) - larger::<S>(high, zero)) * rule.wall_gain, larger::<S>(low, high))
}

/// Returns the squared size of a force, and the inverse of its size.
#[inline(always)]
pub fn sizes<S: Simd>(force: &SteeringForce<S>) -> (S::f32s, S::f32s) {
    let force2 = force.x * force.x + force.y * force.y;
    (force2, rsqrt::<S>(force2))
}

/// Turns the heading towards the force by at most the maximum turn. Returns the heading and the wanted speed. The
/// second argument is the force's [`sizes`].
///
/// No angle is computed. The sine or cosine shows whether the force's direction is within the maximum turn. If so, it
/// becomes the heading. Otherwise the heading turns by the maximum, to the side of the force.
///
/// A cosine near 1 cannot resolve small angles, and a sine near 1 cannot resolve large ones. So `BY_SINE` is set if the
/// maximum turn is small.
#[inline(always)]
pub(crate) fn steer<S: Simd, const BY_SINE: bool>(
    motion: &MotionLanes<S>,
    force: &SteeringForce<S>,
    (force2, inverse): (S::f32s, S::f32s),
    hx: S::f32s,
    hy: S::f32s,
    speed: S::f32s,
) -> (S::f32s, S::f32s, S::f32s) {
    let zero = splat(hx.token(), 0.0);
    let ux = force.x * inverse;
    let uy = force.y * inverse;
    let along = hx * ux + hy * uy;
    let across = hx * uy - hy * ux;
    let sine = select::<S>(zero - motion.max_turn_sin, motion.max_turn_sin, across.simd_ge(zero));
    let (turned_x, turned_y) = rotate::<S>(hx, hy, motion.max_turn_cos, sine);
    let has_force = force2.simd_gt(zero);
    // Without a force, `along` is 0.
    let reached = if BY_SINE {
        along.simd_gt(zero) & across.abs().simd_le(motion.max_turn_sin)
    } else {
        along.simd_ge(motion.max_turn_cos) & has_force
    };
    // The order matters for speed only: with the heading selected last, the compiler would emit a slow masked store.
    let next_x = select::<S>(select::<S>(hx, turned_x, has_force), ux, reached);
    let next_y = select::<S>(select::<S>(hy, turned_y, has_force), uy, reached);
    let ahead = select::<S>(motion.min_speed, force2 * inverse, along.simd_gt(zero));
    let wanted = select::<S>(speed, zero_unless::<S>(ahead, has_force), force.influenced);
    (next_x, next_y, wanted)
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;
    use crate::config::Config;
    use crate::model::Lanes;
    use crate::world::World;

    /// Each component of a force is at most the two gains, as each mean offset is within its radius, and the push of
    /// the walls, which is at most the gain times the radius or the side. So the square is in the range of [`rsqrt`],
    /// whose error holds up to 2^48.
    #[test]
    fn the_largest_force_of_any_config_is_in_the_range_of_rsqrt() {
        const RANGE: f64 = (1u64 << 48) as f64;
        let rounding = 1.0 + f64::from(f32::EPSILON) * 2048.0;
        let component = (2.0 * MAX_GAIN + LONGEST * MAX_GAIN) * rounding;
        assert!(2.0 * component * component < RANGE);
        // A follower in a corner of the largest map, with walls, radii and gains as large as may be.
        let text = format!(
            "[world]\nmap = [{LONGEST:?}, {LONGEST:?}]\nleaders = [[1, 1]]\nfollowers = [[0, 0]]\npois = [[9, 9]]\n\
             [follow]\nattraction_radius = {LONGEST:?}\nrepulsion_radius = {LONGEST:?}\nattraction_gain = {MAX_GAIN:?}\n\
             repulsion_gain = {MAX_GAIN:?}\nwall_gain = {MAX_GAIN:?}"
        );
        let config = Config::parse(&text, "largest.toml").expect("the largest values are valid");
        let world = World::new(&config.validate().unwrap());
        fn squared<S: Simd>(simd: S, world: &World) -> f32 {
            let (lanes, zero) = (Lanes::new(simd, world.constants, &world.classes), splat(simd, 0.0));
            let (class, mut force) = (&lanes.classes[1], SteeringForce::none(simd));
            (0..2).for_each(|term| force.add(&class.terms[term], &Sum::new(simd)));
            force.add_walls(&class.constants.rule, &class.constants.motion, zero, zero);
            let force2 = sizes::<S>(&force).0;
            force2[0]
        }
        let found = f64::from(dispatch!(Level::new(), simd => squared(simd, &world)));
        assert!((1e14..RANGE).contains(&found), "{found:e}");
        let over = text.replace(&format!("wall_gain = {MAX_GAIN:?}"), "wall_gain = 1001.0");
        assert!(Config::parse(&over, "larger.toml").is_err());
    }
}
