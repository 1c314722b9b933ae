//! What a leader senses: the density of POIs and of agents in four quadrants around its heading (Section 3.1).

use fearless_simd::{Simd, prelude::*};

use super::{
    Lanes, except,
    math::{root, rsqrt},
    only, select, splat,
};

/// What an entity at squared distance `d2` adds to a density.
#[inline(always)]
pub fn density<S: Simd>(world: &Lanes<S>, d2: S::f32s) -> S::f32s {
    let simd = d2.token();
    let one = splat(simd, 1.0);
    if world.constants.density == 0 {
        one - root::<S>(d2) * world.inverse_diagonal
    } else {
        rsqrt::<S>(select::<S>(one, d2, d2.simd_gt(one)))
    }
}

/// Adds the entity at offset (`dx`, `dy`) to the sum of its quadrant, in the order of the policy's inputs:
/// back-right, front-right, front-left, back-left.
///
/// The quadrant is read off the signs of the offset along the heading and to its left; a tie goes one quarter turn
/// clockwise, so that each boundary belongs to exactly one quadrant.
#[inline(always)]
pub fn sense<S: Simd>(
    world: &Lanes<S>,
    range2: S::f32s,
    dx: S::f32s,
    dy: S::f32s,
    hx: S::f32s,
    hy: S::f32s,
    sums: &mut [S::f32s; 4],
) {
    let zero = splat(dx.token(), 0.0);
    let d2 = dx * dx + dy * dy;
    let fx = dx * hx + dy * hy;
    let fy = dy * hx - dx * hy;
    let value = only::<S>(density::<S>(world, d2), d2.simd_le(range2));
    let left = fy.simd_gt(zero) | (fy.simd_ge(zero) & fx.simd_ge(zero));
    let front = fx.simd_gt(zero) | (fx.simd_ge(zero) & !fy.simd_gt(zero));
    let value_left = only::<S>(value, left);
    let value_right = except::<S>(value, left);
    sums[0] += except::<S>(value_right, front);
    sums[1] += only::<S>(value_right, front);
    sums[2] += only::<S>(value_left, front);
    sums[3] += except::<S>(value_left, front);
}
