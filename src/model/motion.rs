//! How agents move: a proportional controller within the limits of turn, acceleration and speed (Section 3.1).

use std::f64::consts::{FRAC_PI_2, PI};

use fearless_simd::{Simd, prelude::*};

use super::{LEAST, Lanes};
use crate::declare::shared;
use crate::kernels::{
    bound,
    math::{flush, sin_cos},
    operations::{self, BOUND, FLUSH, SIN_COS},
    splat,
};
use crate::reader::{Allowed, Reader, between, section};

/// The shader's part.
pub const WGSL: &str = include_str!("../../shaders/motion.wgsl");

section! {
    /// `[motion]`: the limits of every agent's movement.
    Motion = "motion" {
        /// smallest speed of any agent: above 0, nobody can stop
        min_speed: f64 = "units/s", "3.1",
        /// largest speed of any agent, and a leader's wanted speed at most
        max_speed: f64 = "units/s", "3.1",
        /// an agent's speed changes by at most this times dt
        max_acceleration: f64 = "units/s²", "3.1",
        /// an agent's heading turns by at most this times dt
        max_turn_rate: f64 = "rad/s", "3.1",
    }
}

impl Motion {
    /// Reads the section; also the speeds that agents may start with.
    pub(crate) fn read(r: &mut Reader<'_>) -> (Motion, Allowed<f64>) {
        let max_speed = Motion::max_speed(r).number(between(LEAST, 1e3).or_zero(), 3.0);
        let slowest = between(LEAST, max_speed).or_zero().because("motion.max_speed");
        let before = r.error_count();
        let min_speed = Motion::min_speed(r).number(slowest, 0.0);
        let least = if r.error_count() > before { 0.0 } else { min_speed };
        let start_speed = between(least.max(LEAST), max_speed).because("motion.min_speed to motion.max_speed");
        let start_speed = if least == 0.0 { start_speed.or_zero() } else { start_speed };
        let motion = Motion {
            min_speed,
            max_speed,
            max_acceleration: Motion::max_acceleration(r).number(between(1e-3, 1e3).or_zero(), 5.0),
            max_turn_rate: Motion::max_turn_rate(r).number(between(1e-3, 1e3).or_zero(), FRAC_PI_2),
        };
        (motion, start_speed)
    }
}

shared! {
    /// What moving reads.
    pub struct MotionConstants as MotionLanes {
        /// Width of the map, in units.
        pub map_x: f32,
        /// Height of the map, in units.
        pub map_y: f32,
        /// Seconds of a step: a speed times this is how far it goes.
        pub dt: f32,
        /// Units a second, as its key has it.
        pub min_speed: f32,
        /// Units a second, as its key has it.
        pub max_speed: f32,
        /// Largest change of speed in a step, in units a second.
        pub max_speed_change: f32,
        /// Largest turn in a step, in radians, at most π.
        pub max_turn: f32,
        /// Its cosine; -2, which any cosine is above, where any turn is allowed.
        pub max_turn_cos: f32,
        /// Its sine; 0 where any turn is allowed.
        pub max_turn_sin: f32,
    }
}

impl MotionConstants {
    /// Of steps of this length on this map.
    pub fn new(motion: &Motion, dt: f64, map: [f64; 2]) -> MotionConstants {
        let turn = (motion.max_turn_rate * dt).min(PI);
        let any_turn = turn >= PI;
        MotionConstants {
            map_x: map[0] as f32,
            map_y: map[1] as f32,
            dt: dt as f32,
            min_speed: motion.min_speed as f32,
            max_speed: motion.max_speed as f32,
            max_speed_change: (motion.max_acceleration * dt) as f32,
            max_turn: turn as f32,
            max_turn_cos: if any_turn { -2.0 } else { libm::cos(turn) as f32 },
            max_turn_sin: if any_turn { 0.0 } else { libm::sin(turn) as f32 },
        }
    }

    /// Whether the largest turn is so small that its sine tells angles apart, not its cosine.
    pub fn by_sine(&self) -> bool {
        self.max_turn_cos > 0.7
    }
}

/// Positions lie on a grid of 2^-18 (or on a wall): their differences are exact, and their squares far from denormal.
pub const GRID: f32 = 262_144.0;

/// Lane operations of a leader's turn: bounded, and rotated.
pub const TURN: u32 = BOUND + SIN_COS + operations::ROTATE;
/// Lane operations of an agent's move: the heading renormalized (its square 3, a scale 2, 2 products, 2 flushes), the
/// speed brought up within 2 bounds, and on each axis a step (after one common product), snapped to the grid (4) and
/// kept on the map.
pub const MOVE: u32 = 3 + 2 + 2 + 2 * FLUSH + (2 + 2 * BOUND) + 1 + 2 * (2 + 4 + BOUND);

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
    let angle = bound::<S>(wanted, -world.motion.max_turn, world.motion.max_turn);
    let (sine, cosine) = sin_cos::<S>(angle);
    rotate::<S>(hx, hy, cosine, sine)
}

/// The heading scaled back to length 1, by one Newton step: turning lets it drift by a rounding.
#[inline(always)]
pub fn renormalize<S: Simd>(hx: S::f32s, hy: S::f32s) -> (S::f32s, S::f32s) {
    let scale = splat(hx.token(), 1.5) - (hx * hx + hy * hy) * 0.5;
    (flush::<S>(hx * scale, TINY), flush::<S>(hy * scale, TINY))
}

/// The speed brought towards the wanted one, as far as one step and the limits allow.
#[inline(always)]
pub fn accelerate<S: Simd>(world: &Lanes<S>, speed: S::f32s, wanted: S::f32s) -> S::f32s {
    let limit = world.motion.max_speed_change;
    let change = bound::<S>(wanted - speed, -limit, limit);
    bound::<S>(speed + change, world.motion.min_speed, world.motion.max_speed)
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
