//! What a leader senses: the density of POIs and of agents in four quadrants around its heading (Section 3.1).

use fearless_simd::{Simd, prelude::*};

use super::{
    Lanes, except,
    math::{root, rsqrt},
    only, select, splat,
};

/// What an entity at offset (`dx`, `dy`) adds to the density of its quadrant: nothing beyond the range.
#[inline(always)]
pub fn density<S: Simd, const LINEAR: bool>(world: &Lanes<S>, range2: S::f32s, dx: S::f32s, dy: S::f32s) -> S::f32s {
    let one = splat(dx.token(), 1.0);
    let d2 = dx * dx + dy * dy;
    let density = if LINEAR {
        one - root::<S>(d2) * world.inverse_diagonal
    } else {
        rsqrt::<S>(select::<S>(one, d2, d2.simd_gt(one)))
    };
    only::<S>(density, d2.simd_le(range2))
}

/// Adds the density of the entity at offset (`dx`, `dy`) to the sum of its quadrant, in the order of the policy's inputs:
/// back-right, front-right, front-left, back-left.
///
/// The quadrant is read off the signs of the offset along the heading and to its left; a tie goes to the quadrant
/// counterclockwise of it, so that each boundary belongs to exactly one quadrant.
#[inline(always)]
pub fn sense<S: Simd>(density: S::f32s, dx: S::f32s, dy: S::f32s, hx: S::f32s, hy: S::f32s, sums: &mut [S::f32s; 4]) {
    let zero = splat(dx.token(), 0.0);
    let fx = dx * hx + dy * hy;
    let fy = dy * hx - dx * hy;
    let left = fy.simd_gt(zero) | (fy.simd_ge(zero) & fx.simd_ge(zero));
    let front = fx.simd_gt(zero) | (fx.simd_ge(zero) & !fy.simd_gt(zero));
    let density_left = only::<S>(density, left);
    let density_right = except::<S>(density, left);
    sums[0] += except::<S>(density_right, front);
    sums[1] += only::<S>(density_right, front);
    sums[2] += only::<S>(density_left, front);
    sums[3] += except::<S>(density_left, front);
}
