//! Who is close enough to a POI to observe it (Equations 3 and 4).

use fearless_simd::{Simd, prelude::*};

use super::Lanes;

/// In which lanes the POI at offset (`dx`, `dy`) is within its observation radius.
#[inline(always)]
pub fn observes<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    let d2 = dx * dx + dy * dy;
    d2.simd_le(world.observation_radius2)
}
