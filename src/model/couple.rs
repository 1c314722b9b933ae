//! Coupling: whether an agent is close enough to a POI to observe it (paper, Equations 3 and 4).

use fearless_simd::Simd;

use crate::kernels::math::within;

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/couple.wgsl");

/// Returns the lanes in which the POI at offset (`dx`, `dy`) is within its observation radius, given squared.
#[inline(always)]
pub fn observes<S: Simd>(radius2: S::f32s, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    within::<S>(dx, dy, radius2)
}
