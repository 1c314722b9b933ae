//! A follower's preset behaviour: drawn to agents in sight, pushed off close ones and walls (Section 4.1, Figure 2b).

use fearless_simd::{Simd, prelude::*};

use super::{
    Lanes,
    math::{flush, recip, rsqrt},
    motion::rotate,
    only, select, splat,
};

/// Forces under this size (2^-30) count as 0.
pub const TINY: f32 = 1.0 / 1_073_741_824.0;

/// Offsets to the agents within a follower's radii, summed and counted.
#[derive(Clone, Copy)]
pub struct Sums<S: Simd> {
    pub repel_x: S::f32s,
    pub repel_y: S::f32s,
    pub repel_count: S::i32s,
    pub attract_x: S::f32s,
    pub attract_y: S::f32s,
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

/// Adds the agent at offset (`dx`, `dy`); tells in which lanes it is within the attraction radius.
#[inline(always)]
pub fn influence<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s, sums: &mut Sums<S>) -> S::mask32s {
    let d2 = dx * dx + dy * dy;
    let near = d2.simd_le(world.repulsion_radius2);
    let seen = d2.simd_le(world.attraction_radius2);
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
    pub x: S::f32s,
    pub y: S::f32s,
    pub influenced: S::mask32s,
}

/// The push of the two walls of one axis, at 0 and at `size`, and a number that is not negative if either is within the
/// repulsion radius.
#[inline(always)]
fn walls<S: Simd>(world: &Lanes<S>, at: S::f32s, size: S::f32s) -> (S::f32s, S::f32s) {
    let zero = splat(at.token(), 0.0);
    let low = world.repulsion_radius - at;
    let high = world.repulsion_radius - (size - at);
    ((low.max(zero) - high.max(zero)) * world.wall_gain, low.max(high))
}

/// The sum of repulsion, attraction and wall push at a place: mean offsets, scaled by gain over radius.
#[inline(always)]
pub fn force<S: Simd>(world: &Lanes<S>, sums: &Sums<S>, x: S::f32s, y: S::f32s) -> Pull<S> {
    let repel = recip::<S>(sums.repel_count.max(1).to_float()) * world.repulsion_scale;
    let attract = recip::<S>(sums.attract_count.max(1).to_float()) * world.attraction_scale;
    let (push_x, near_x) = walls::<S>(world, x, world.map_x);
    let (push_y, near_y) = walls::<S>(world, y, world.map_y);
    let force_x = sums.attract_x * attract - sums.repel_x * repel + push_x;
    let force_y = sums.attract_y * attract - sums.repel_y * repel + push_y;
    Pull {
        x: flush::<S>(force_x, TINY),
        y: flush::<S>(force_y, TINY),
        influenced: (sums.repel_count + sums.attract_count).simd_gt(0) | near_x.max(near_y).simd_ge(0.0),
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
/// A cosine near 1 cannot tell small angles apart, a sine near 1 cannot tell large ones: `BY_SINE` where the largest turn
/// is small.
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
    let sine = select::<S>(zero - world.max_turn_sin, world.max_turn_sin, across.simd_ge(zero));
    let (turned_x, turned_y) = rotate::<S>(hx, hy, world.max_turn_cos, sine);
    let pulled = force2.simd_gt(zero);
    // Without a force, `along` is 0.
    let reached = if BY_SINE {
        along.simd_gt(zero) & across.abs().simd_le(world.max_turn_sin)
    } else {
        along.simd_ge(world.max_turn_cos) & pulled
    };
    // In this order of selection no heading is selected last: the compiler would make a masked store of that, which is slow.
    let next_x = select::<S>(select::<S>(hx, turned_x, pulled), ux, reached);
    let next_y = select::<S>(select::<S>(hy, turned_y, pulled), uy, reached);
    let ahead = select::<S>(world.min_speed, force2 * inverse, along.simd_gt(zero));
    let wanted = select::<S>(speed, only::<S>(ahead, pulled), pull.influenced);
    (next_x, next_y, wanted)
}
