//! A follower's preset behaviour: drawn to agents in sight, pushed off close ones and walls (Section 4.1, Figure 2b).

use fearless_simd::{Simd, prelude::*};

use super::{LONGEST, Lanes, motion::rotate};
use crate::declare::shared;
use crate::kernels::{
    larger,
    math::{flush, recip, rsqrt, within},
    only,
    operations::{FLUSH, RECIP, ROTATE, RSQRT, SQUARED_DISTANCE},
    select, splat,
};
use crate::reader::{Reader, between, section};

/// The shader's part.
pub const WGSL: &str = include_str!("../../shaders/follow.wgsl");

section! {
    /// `[follow]`: the followers' preset behaviour.
    Follow = "follow" {
        /// within it a follower sees others: it is drawn to them, and counts the leaders among them for Df and Dt
        attraction_radius: f64 = "units", "4.1, 4.2",
        /// within it others, and walls, push a follower away
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
        let gain = between(1e-3, 1e3).or_zero();
        Follow {
            attraction_radius,
            repulsion_radius: Follow::repulsion_radius(r).number(closest, 1.0),
            attraction_gain: Follow::attraction_gain(r).number(gain, 5.0),
            repulsion_gain: Follow::repulsion_gain(r).number(gain, 1.0),
            wall_gain: Follow::wall_gain(r).number(gain, 1.0),
        }
    }
}

shared! {
    /// What following reads.
    pub struct FollowConstants as FollowLanes {
        /// The attraction radius, squared.
        pub attraction_radius2: f32,
        /// The repulsion radius, squared.
        pub repulsion_radius2: f32,
        /// Walls push within this distance.
        pub repulsion_radius: f32,
        /// Attraction's gain over its radius.
        pub attraction_scale: f32,
        /// Repulsion's gain over its radius.
        pub repulsion_scale: f32,
        /// Push for each unit that a wall is nearer than the repulsion radius.
        pub wall_gain: f32,
    }
}

impl FollowConstants {
    /// Of a valid section.
    pub fn new(follow: &Follow) -> FollowConstants {
        let squared = |radius: f64| (radius * radius) as f32;
        FollowConstants {
            attraction_radius2: squared(follow.attraction_radius),
            repulsion_radius2: squared(follow.repulsion_radius),
            repulsion_radius: follow.repulsion_radius as f32,
            attraction_scale: (follow.attraction_gain / follow.attraction_radius) as f32,
            repulsion_scale: (follow.repulsion_gain / follow.repulsion_radius) as f32,
            wall_gain: follow.wall_gain as f32,
        }
    }
}

/// Lane operations of meeting an agent within the attraction radius: 2 tests and their difference, 4 selections, 4
/// sums, 2 counts.
pub const INFLUENCE: u32 = SQUARED_DISTANCE + 3 + 4 + 4 + 2;
/// That agent is a leader: counted.
pub const SEEN: u32 = 1;
/// Lane operations of a follower, whoever it met.
pub const FOLLOW: u32 = FORCE + INFLUENCED + STEER;
/// The force: 2 means (a reciprocal of a count of at least 1, scaled), and on each axis the two weighed sums (4), the
/// walls (3 differences, 2 maxima, a difference, a gain) and a flush.
const FORCE: u32 = 2 * (RECIP + 3) + 2 * (4 + 7 + FLUSH);
/// Whether anything is near: the counts' sum and test, the nearest of 4 walls and its test, and joining them.
const INFLUENCED: u32 = 2 + 3 + 1 + 1;
/// Steering: the force's square and direction (3, an inverse root, 2), along and across (6), the largest turn to its
/// side (2 and a rotation), whether the force lies within it, 4 selections of the heading, the speed ahead (2) and 3
/// selections of the speed, 2 tests of the force.
const STEER: u32 = 3 + RSQRT + 2 + 6 + 2 + ROTATE + WITHIN + 4 + 2 + 3 + 2;
/// A test of the sine and its size, joined to one that is counted already.
const WITHIN: u32 = 3;

/// Forces under this size (2^-30) count as 0.
pub const TINY: f32 = 1.0 / 1_073_741_824.0;

/// Offsets to the agents within a follower's radii, summed and counted.
#[derive(Clone, Copy)]
pub struct Sums<S: Simd> {
    /// Within the repulsion radius.
    pub repel_x: S::f32s,
    /// Likewise.
    pub repel_y: S::f32s,
    /// How many these are.
    pub repel_count: S::i32s,
    /// Within the attraction radius alone.
    pub attract_x: S::f32s,
    /// Likewise.
    pub attract_y: S::f32s,
    /// How many these are.
    pub attract_count: S::i32s,
}

impl<S: Simd> Sums<S> {
    /// Nobody near.
    #[inline(always)]
    pub fn new(simd: S) -> Sums<S> {
        let (zero, none) = (splat(simd, 0.0), S::i32s::splat(simd, 0));
        Sums { repel_x: zero, repel_y: zero, repel_count: none, attract_x: zero, attract_y: zero, attract_count: none }
    }
}

/// In which lanes a follower sees the agent at offset (`dx`, `dy`): where it is within the attraction radius.
#[inline(always)]
pub fn sees<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    within::<S>(dx, dy, world.follow.attraction_radius2)
}

/// Adds the agent at offset (`dx`, `dy`); tells in which lanes it is within the attraction radius.
#[inline(always)]
pub fn influence<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s, sums: &mut Sums<S>) -> S::mask32s {
    let near = within::<S>(dx, dy, world.follow.repulsion_radius2);
    let seen = within::<S>(dx, dy, world.follow.attraction_radius2);
    let far = seen & !near;
    sums.repel_x += only::<S>(dx, near);
    sums.repel_y += only::<S>(dy, near);
    sums.repel_count -= near.to_vector();
    sums.attract_x += only::<S>(dx, far);
    sums.attract_y += only::<S>(dy, far);
    sums.attract_count -= far.to_vector();
    seen
}

/// What acts on a follower: the force, and in which lanes any agent or wall is near.
#[derive(Clone, Copy)]
pub struct Pull<S: Simd> {
    /// The force along x, in units a second.
    pub x: S::f32s,
    /// The force along y.
    pub y: S::f32s,
    /// Where any agent or wall is near.
    pub influenced: S::mask32s,
}

/// The push of the two walls of one axis, at 0 and at `size`, and a number that is not negative if either is within the
/// repulsion radius.
#[inline(always)]
fn walls<S: Simd>(world: &Lanes<S>, at: S::f32s, size: S::f32s) -> (S::f32s, S::f32s) {
    let zero = splat(at.token(), 0.0);
    let low = world.follow.repulsion_radius - at;
    let high = world.follow.repulsion_radius - (size - at);
    ((larger::<S>(low, zero) - larger::<S>(high, zero)) * world.follow.wall_gain, larger::<S>(low, high))
}

/// The sum of repulsion, attraction and wall push at a place: mean offsets, scaled by gain over radius.
#[inline(always)]
pub fn force<S: Simd>(world: &Lanes<S>, sums: &Sums<S>, x: S::f32s, y: S::f32s) -> Pull<S> {
    let repel = recip::<S>(sums.repel_count.max(1).to_float()) * world.follow.repulsion_scale;
    let attract = recip::<S>(sums.attract_count.max(1).to_float()) * world.follow.attraction_scale;
    let (push_x, near_x) = walls::<S>(world, x, world.motion.map_x);
    let (push_y, near_y) = walls::<S>(world, y, world.motion.map_y);
    let force_x = sums.attract_x * attract - sums.repel_x * repel + push_x;
    let force_y = sums.attract_y * attract - sums.repel_y * repel + push_y;
    Pull {
        x: flush::<S>(force_x, TINY),
        y: flush::<S>(force_y, TINY),
        influenced: (sums.repel_count + sums.attract_count).simd_gt(0) | larger::<S>(near_x, near_y).simd_ge(0.0),
    }
}

/// The squared size of a force, and 1 over its size.
#[inline(always)]
pub fn sizes<S: Simd>(pull: &Pull<S>) -> (S::f32s, S::f32s) {
    let force2 = pull.x * pull.x + pull.y * pull.y;
    (force2, rsqrt::<S>(force2))
}

/// The heading turned towards the force, of these [`sizes`], by at most the largest turn, and the wanted speed.
///
/// No angle is needed: the force's direction is taken where it lies within the largest turn (by its sine or cosine),
/// else the heading turns by that much, to the side of the force.
///
/// A cosine near 1 cannot tell small angles apart, a sine near 1 cannot tell large ones: `BY_SINE` where the largest
/// turn is small.
#[inline(always)]
pub fn steer<S: Simd, const BY_SINE: bool>(
    world: &Lanes<S>,
    pull: &Pull<S>,
    (force2, inverse): (S::f32s, S::f32s),
    hx: S::f32s,
    hy: S::f32s,
    speed: S::f32s,
) -> (S::f32s, S::f32s, S::f32s) {
    let zero = splat(hx.token(), 0.0);
    let ux = pull.x * inverse;
    let uy = pull.y * inverse;
    let along = hx * ux + hy * uy;
    let across = hx * uy - hy * ux;
    let sine = select::<S>(zero - world.motion.max_turn_sin, world.motion.max_turn_sin, across.simd_ge(zero));
    let (turned_x, turned_y) = rotate::<S>(hx, hy, world.motion.max_turn_cos, sine);
    let pulled = force2.simd_gt(zero);
    // Without a force, `along` is 0.
    let reached = if BY_SINE {
        along.simd_gt(zero) & across.abs().simd_le(world.motion.max_turn_sin)
    } else {
        along.simd_ge(world.motion.max_turn_cos) & pulled
    };
    // In this order of selection no heading is selected last: the compiler would make a masked store of that, which is
    // slow.
    let next_x = select::<S>(select::<S>(hx, turned_x, pulled), ux, reached);
    let next_y = select::<S>(select::<S>(hy, turned_y, pulled), uy, reached);
    let ahead = select::<S>(world.motion.min_speed, force2 * inverse, along.simd_gt(zero));
    let wanted = select::<S>(speed, only::<S>(ahead, pulled), pull.influenced);
    (next_x, next_y, wanted)
}
