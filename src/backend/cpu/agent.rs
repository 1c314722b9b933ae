//! The state of one agent in a vector of teams.

use fearless_simd::Simd;

/// Position, heading (a unit vector) and speed of one agent, one team per lane. Units, and units per second.
#[derive(Clone, Copy)]
pub(crate) struct Agent<S: Simd> {
    pub x: S::f32s,
    pub y: S::f32s,
    pub hx: S::f32s,
    pub hy: S::f32s,
    pub speed: S::f32s,
}
