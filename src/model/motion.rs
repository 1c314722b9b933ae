//! Motion: a proportional controller, limited in turn, acceleration and speed (paper, Section 3.1).

use std::f64::consts::{FRAC_PI_2, PI};

use fearless_simd::{Simd, prelude::*};
use glam::{DVec2, Vec2};

use super::{LEAST, TINY};
use crate::gpu_struct::gpu_struct;
use crate::kernels::{
    clamp_to,
    math::{flush, sin_cos},
    splat,
};
use crate::reader::{Allowed, Reader, between, section};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/motion.wgsl");

section! {
    /// `[motion]`: the limits of every agent's movement.
    Motion = "motion" {
        /// smallest speed of any agent: above 0, nobody can stop
        min_speed: f64 = "units/s", "3.1",
        /// largest speed of any agent, and largest wanted speed of a leader
        max_speed: f64 = "units/s", "3.1",
        /// an agent's speed changes by at most this times dt
        max_acceleration: f64 = "units/s²", "3.1",
        /// an agent's heading turns by at most this times dt
        max_turn_rate: f64 = "rad/s", "3.1",
    }
}

/// The kind of motion of an agent.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum Mobility {
    /// It has a heading and a speed, and turns and accelerates within limits.
    Steered(Motion),
    /// It has any velocity whose components do not exceed a maximum, and no heading.
    Free {
        /// The largest speed along each axis of the map, in units per second.
        max_speed: f64,
    },
}

impl Mobility {
    /// Returns the largest speed, of free motion along each axis, in units per second.
    pub fn max_speed(&self) -> f64 {
        match self {
            Mobility::Steered(motion) => motion.max_speed,
            Mobility::Free { max_speed } => *max_speed,
        }
    }
}

impl Motion {
    /// Reads the section, and returns the range of start speeds too.
    pub(crate) fn read(r: &mut Reader<'_>) -> (Motion, Allowed<f64>) {
        let max_speed = Motion::read_max_speed(r);
        let slowest = between(LEAST, max_speed).or_zero().because("motion.max_speed");
        let before = r.error_count();
        let min_speed = Motion::min_speed(r).number(slowest, 0.0);
        let min = if r.error_count() > before { 0.0 } else { min_speed };
        let start_speed = between(min.max(LEAST), max_speed).because("motion.min_speed to motion.max_speed");
        let start_speed = if min == 0.0 { start_speed.or_zero() } else { start_speed };
        let motion = Motion {
            min_speed,
            max_speed,
            max_acceleration: Motion::max_acceleration(r).number(between(1e-3, 1e3).or_zero(), 5.0),
            max_turn_rate: Motion::max_turn_rate(r).number(between(1e-3, 1e3).or_zero(), FRAC_PI_2),
        };
        (motion, start_speed)
    }

    /// Reads the largest speed.
    pub(crate) fn read_max_speed(r: &mut Reader<'_>) -> f64 {
        Motion::max_speed(r).number(between(LEAST, 1e3).or_zero(), 3.0)
    }
}

impl Motion {
    /// Returns what is wrong with steps of this time on this map, if they are so short that rounding of positions
    /// shows. `motion` is the name of the limits.
    pub(crate) fn too_short(&self, motion: &str, dt: f64, map: [f64; 2]) -> Option<String> {
        let (step, resolution) = (self.max_speed * dt, resolution(map));
        (step > 0.0 && step < SHORTEST * resolution).then(|| {
            format!(
                "{motion}.max_speed times world.dt is {step:.2e} units, and positions on this map are {resolution:.2e} units \
                 apart: agents stand still or get too far or not far enough; set a larger world.dt or a smaller world.map, \
                 so that a step is at min {:.2e} units",
                SHORTEST * resolution
            )
        })
    }
}

/// The shortest step that rounding does not change noticeably, in distances between neighbouring positions. A step is
/// off by at most one and a half of these distances on each axis, 0.6 % of so long a step.
const SHORTEST: f64 = 256.0;

/// Returns the largest distance between neighbouring positions on a map: the grid's, or where f32 is coarser, f32's.
pub(crate) fn resolution(map: [f64; 2]) -> f64 {
    let side = map[0].max(map[1]) as f32;
    f64::from((side - side.next_down()).max(1.0 / GRID))
}

gpu_struct! {
    /// The space and the time that all agents move in.
    pub struct MapConstants as MapLanes {
        /// Width of the map, in units.
        pub map_x: f32,
        /// Height of the map, in units.
        pub map_y: f32,
        /// The length of a step, in seconds.
        pub dt: f32,
    }

    /// Constants of a class's motion. With free motion only the maximum speed counts.
    pub struct MotionConstants as MotionLanes {
        /// The speed at the start, in units per second.
        pub speed: f32,
        /// The minimum speed, in units per second.
        pub min_speed: f32,
        /// The maximum speed, in units per second.
        pub max_speed: f32,
        /// The maximum change of speed per step, in units per second.
        pub max_speed_change: f32,
        /// The maximum turn per step, in radians, at most π.
        pub max_turn: f32,
        /// The cosine of the maximum turn, or -2 if any turn is allowed.
        pub max_turn_cos: f32,
        /// The sine of the maximum turn, or 0 if any turn is allowed.
        pub max_turn_sin: f32,
        /// The limits of x, in units: those of the map, or of a box on the grid.
        pub low_x: f32,
        /// The upper limit of x.
        pub high_x: f32,
        /// The limits of y.
        pub low_y: f32,
        /// The upper limit of y.
        pub high_y: f32,
    }
}

impl MapConstants {
    /// Computes the constants for steps of `dt` seconds on a map.
    pub(crate) fn new(map: [f64; 2], dt: f64) -> MapConstants {
        MapConstants { map_x: map[0] as f32, map_y: map[1] as f32, dt: dt as f32 }
    }
}

impl MotionConstants {
    /// Computes the constants for steps of `dt` seconds on a map, in a box `[x0, y0, x1, y1]` if given.
    pub(crate) fn new(
        mobility: &Mobility,
        speed: f64,
        stays_in: Option<[f64; 4]>,
        map: [f64; 2],
        dt: f64,
    ) -> MotionConstants {
        let free = |max_speed| Motion { min_speed: 0.0, max_speed, max_acceleration: 0.0, max_turn_rate: 0.0 };
        let motion = match mobility {
            Mobility::Steered(motion) => motion.clone(),
            Mobility::Free { max_speed } => free(*max_speed),
        };
        let map = Vec2::new(map[0] as f32, map[1] as f32);
        let [low, high] = stays_in.map_or([Vec2::ZERO, map], |[x0, y0, x1, y1]| {
            [[x0, y0], [x1, y1]].map(|corner| on_grid(DVec2::from(corner).as_vec2(), map))
        });
        let turn = (motion.max_turn_rate * dt).min(PI);
        let any_turn = turn >= PI;
        MotionConstants {
            speed: speed as f32,
            min_speed: motion.min_speed as f32,
            max_speed: motion.max_speed as f32,
            max_speed_change: (motion.max_acceleration * dt) as f32,
            max_turn: turn as f32,
            max_turn_cos: if any_turn { -2.0 } else { libm::cos(turn) as f32 },
            max_turn_sin: if any_turn { 0.0 } else { libm::sin(turn) as f32 },
            low_x: low.x,
            high_x: high.x,
            low_y: low.y,
            high_y: high.y,
        }
    }

    /// Clamps a place to the limits.
    pub(crate) fn confine(&self, place: Vec2) -> Vec2 {
        place.clamp(Vec2::new(self.low_x, self.low_y), Vec2::new(self.high_x, self.high_y))
    }

    /// Reports whether the maximum turn is so small that angles are compared by their sines instead of their cosines.
    pub(crate) fn by_sine(&self) -> bool {
        self.max_turn_cos > 0.7
    }
}

/// Positions are multiples of 1/GRID = 2^-18, or on a wall. Their differences are exact, and the squares of these far
/// from denormal.
pub const GRID: f32 = 262_144.0;
/// The size of a grid cell.
pub(crate) const INVERSE_GRID: f32 = 1.0 / GRID;

/// Rounds a position to the kernels' grid, and clamps it to the map.
pub fn on_grid(place: Vec2, map: Vec2) -> Vec2 {
    ((place * GRID + 0.5).floor() / GRID).clamp(Vec2::ZERO, map)
}

/// Rotates a heading to the left, by the angle of this cosine and sine.
#[inline(always)]
pub(crate) fn rotate<S: Simd>(hx: S::f32s, hy: S::f32s, cosine: S::f32s, sine: S::f32s) -> (S::f32s, S::f32s) {
    (hx * cosine - hy * sine, hx * sine + hy * cosine)
}

/// Turns a heading by a wanted angle (radians, to the left), at most the maximum turn.
#[inline(always)]
pub fn turn<S: Simd>(motion: &MotionLanes<S>, hx: S::f32s, hy: S::f32s, wanted: S::f32s) -> (S::f32s, S::f32s) {
    let angle = clamp_to::<S>(wanted, -motion.max_turn, motion.max_turn);
    let (sine, cosine) = sin_cos::<S>(angle);
    rotate::<S>(hx, hy, cosine, sine)
}

/// Scales a heading back to length 1 by one Newton step, because each turn adds a rounding error.
#[inline(always)]
pub(crate) fn renormalize<S: Simd>(hx: S::f32s, hy: S::f32s) -> (S::f32s, S::f32s) {
    let scale = splat(hx.token(), 1.5) - (hx * hx + hy * hy) * 0.5;
    (flush::<S>(hx * scale, TINY), flush::<S>(hy * scale, TINY))
}

/// Changes the speed towards the wanted one, within the limits.
#[inline(always)]
pub(crate) fn accelerate<S: Simd>(motion: &MotionLanes<S>, speed: S::f32s, wanted: S::f32s) -> S::f32s {
    let limit = motion.max_speed_change;
    let change = clamp_to::<S>(wanted - speed, -limit, limit);
    clamp_to::<S>(speed + change, motion.min_speed, motion.max_speed)
}

/// Moves one coordinate by a distance along one component of a heading, rounded to the grid and clamped to limits.
#[inline(always)]
pub fn advance<S: Simd>(at: S::f32s, step: S::f32s, heading: S::f32s, [low, high]: [S::f32s; 2]) -> S::f32s {
    clamp_to::<S>(snap::<S>(at + step * heading), low, high)
}

/// Rounds a coordinate to the grid.
#[inline(always)]
pub(crate) fn snap<S: Simd>(at: S::f32s) -> S::f32s {
    (at * GRID + 0.5).floor() * INVERSE_GRID
}
