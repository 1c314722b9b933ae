//! Coupling: whether an agent is close enough to a POI to observe it (paper, Equations 3 and 4). Its key is in
//! `[world]`.

use fearless_simd::Simd;

use super::LONGEST;
use crate::kernels::math::within;
use crate::reader::{Reader, between};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/couple.wgsl");

/// Reads the observation radius.
pub(crate) fn observation_radius(r: &mut Reader<'_>) -> f64 {
    r.key("world.observation_radius", "units", "σ₀: distance up to which an agent observes a POI", "3.2, Eq. 3")
        .number(between(0.01, LONGEST), 5.0)
}

/// Returns the lanes in which the POI at offset (`dx`, `dy`) is within its observation radius, given squared.
#[inline(always)]
pub fn observes<S: Simd>(radius2: S::f32s, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    within::<S>(dx, dy, radius2)
}
