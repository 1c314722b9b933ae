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
    pub repel_count: S::f32s,
    pub attract_x: S::f32s,
    pub attract_y: S::f32s,
    pub attract_count: S::f32s,
}

impl<S: Simd> Sums<S> {
    /// Nobody near.
    #[inline(always)]
    pub fn new(simd: S) -> Sums<S> {
        let zero = splat(simd, 0.0);
        Sums { repel_x: zero, repel_y: zero, repel_count: zero, attract_x: zero, attract_y: zero, attract_count: zero }
    }
}

/// Adds the agent at offset (`dx`, `dy`); tells in which lanes it is within the attraction radius.
#[inline(always)]
pub fn influence<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s, sums: &mut Sums<S>) -> S::mask32s {
    let simd = dx.token();
    let one = splat(simd, 1.0);
    let d2 = dx * dx + dy * dy;
    let near = d2.simd_le(world.repulsion_radius2);
    let seen = d2.simd_le(world.attraction_radius2);
    let far = seen & !near;
    sums.repel_x += only::<S>(dx, near);
    sums.repel_y += only::<S>(dy, near);
    sums.repel_count += only::<S>(one, near);
    sums.attract_x += only::<S>(dx, far);
    sums.attract_y += only::<S>(dy, far);
    sums.attract_count += only::<S>(one, far);
    seen
}

/// The push of the two walls of one axis, at 0 and at `size`.
#[inline(always)]
pub fn wall_push<S: Simd>(world: &Lanes<S>, at: S::f32s, size: S::f32s) -> S::f32s {
    let simd = at.token();
    let (zero, radius) = (splat(simd, 0.0), world.repulsion_radius);
    let low = radius - at;
    let high = radius - (size - at);
    let push = only::<S>(low, low.simd_gt(zero)) - only::<S>(high, high.simd_gt(zero));
    push * world.wall_gain
}

/// In which lanes a wall of one axis is within the repulsion radius.
#[inline(always)]
pub fn wall_near<S: Simd>(world: &Lanes<S>, at: S::f32s, size: S::f32s) -> S::mask32s {
    let high = size - at;
    at.simd_le(world.repulsion_radius) | high.simd_le(world.repulsion_radius)
}

/// The sum of repulsion, attraction and wall push at a place: mean offsets, scaled by gain over radius.
#[inline(always)]
pub fn force<S: Simd>(world: &Lanes<S>, sums: &Sums<S>, x: S::f32s, y: S::f32s) -> (S::f32s, S::f32s) {
    let one = splat(x.token(), 1.0);
    let repel = recip::<S>(select::<S>(one, sums.repel_count, sums.repel_count.simd_gt(one))) * world.repulsion_scale;
    let attract =
        recip::<S>(select::<S>(one, sums.attract_count, sums.attract_count.simd_gt(one))) * world.attraction_scale;
    let force_x = sums.attract_x * attract - sums.repel_x * repel + wall_push::<S>(world, x, world.map_x);
    let force_y = sums.attract_y * attract - sums.repel_y * repel + wall_push::<S>(world, y, world.map_y);
    (flush::<S>(force_x, TINY), flush::<S>(force_y, TINY))
}

/// The heading turned towards the force by at most the largest turn, and the wanted speed.
///
/// No angle is needed: the force's direction is taken where it lies within the largest turn (by its sine or cosine),
/// else the heading turns by that much, to the side of the force.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
pub fn steer<S: Simd>(
    world: &Lanes<S>,
    force_x: S::f32s,
    force_y: S::f32s,
    influenced: S::mask32s,
    hx: S::f32s,
    hy: S::f32s,
    speed: S::f32s,
) -> (S::f32s, S::f32s, S::f32s) {
    let simd = hx.token();
    let zero = splat(simd, 0.0);
    let force2 = force_x * force_x + force_y * force_y;
    let inverse = rsqrt::<S>(force2);
    let ux = force_x * inverse;
    let uy = force_y * inverse;
    let along = hx * ux + hy * uy;
    let across = hx * uy - hy * ux;
    let sine = select::<S>(zero - world.max_turn_sin, world.max_turn_sin, across.simd_ge(zero));
    let (turned_x, turned_y) = rotate::<S>(hx, hy, world.max_turn_cos, sine);
    // A cosine near 1 cannot tell small angles apart, a sine near 1 cannot tell large ones.
    let reached = if world.constants.max_turn_cos > 0.7 {
        along.simd_gt(zero) & across.abs().simd_le(world.max_turn_sin)
    } else {
        along.simd_ge(world.max_turn_cos)
    };
    let pulled = force2.simd_gt(zero);
    let next_x = select::<S>(hx, select::<S>(turned_x, ux, reached), pulled);
    let next_y = select::<S>(hy, select::<S>(turned_y, uy, reached), pulled);
    let ahead = select::<S>(world.min_speed, force2 * inverse, along.simd_gt(zero));
    let wanted = select::<S>(speed, only::<S>(ahead, pulled), influenced);
    (next_x, next_y, wanted)
}
