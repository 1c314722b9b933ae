//! How agents move: a proportional controller within the limits of turn, acceleration and speed (Section 3.1).

use fearless_simd::{Simd, prelude::*};

use super::{
    Lanes, bound,
    math::{flush, sin_cos},
    splat,
};
use crate::world::GRID;

/// Heading components under this size (2^-30) count as 0.
pub const TINY: f32 = 1.0 / 1_073_741_824.0;

/// The heading turned by the angle of this cosine and sine, to the left.
#[inline(always)]
pub fn rotate<S: Simd>(hx: S::f32s, hy: S::f32s, cosine: S::f32s, sine: S::f32s) -> (S::f32s, S::f32s) {
    (hx * cosine - hy * sine, hx * sine + hy * cosine)
}

/// The heading turned by a wanted angle (radians, to the left), as far as one step allows.
#[inline(always)]
pub fn turn<S: Simd>(world: &Lanes<S>, hx: S::f32s, hy: S::f32s, wanted: S::f32s) -> (S::f32s, S::f32s) {
    let angle = bound::<S>(wanted, -world.max_turn, world.max_turn);
    let (sine, cosine) = sin_cos::<S>(angle);
    rotate::<S>(hx, hy, cosine, sine)
}

/// The heading scaled back to length 1, by one Newton step: turning lets it drift by a rounding.
#[inline(always)]
pub fn straighten<S: Simd>(hx: S::f32s, hy: S::f32s) -> (S::f32s, S::f32s) {
    let scale = splat(hx.token(), 1.5) - (hx * hx + hy * hy) * 0.5;
    (flush::<S>(hx * scale, TINY), flush::<S>(hy * scale, TINY))
}

/// The speed brought towards the wanted one, as far as one step and the limits allow.
#[inline(always)]
pub fn accelerate<S: Simd>(world: &Lanes<S>, speed: S::f32s, wanted: S::f32s) -> S::f32s {
    let limit = world.max_speed_change;
    let change = bound::<S>(wanted - speed, -limit, limit);
    bound::<S>(speed + change, world.min_speed, world.max_speed)
}

/// One coordinate after a step along the new heading, on the map and on the grid.
#[inline(always)]
pub fn advance<S: Simd>(at: S::f32s, step: S::f32s, heading: S::f32s, size: S::f32s) -> S::f32s {
    bound::<S>(snap::<S>(at + step * heading), splat(at.token(), 0.0), size)
}

/// The nearest place on the grid.
#[inline(always)]
pub fn snap<S: Simd>(at: S::f32s) -> S::f32s {
    (at * GRID + 0.5).floor() * (1.0 / GRID)
}
