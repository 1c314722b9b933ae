//! Who is close enough to a POI to observe it (paper, Equations 3 and 4). Its key is in `[world]`.

use fearless_simd::Simd;

use super::{LONGEST, Lanes};
use crate::declare::shared;
use crate::kernels::{math::within, operations::SQUARED_DISTANCE};
use crate::reader::{Reader, between};

/// The shader's part.
pub const WGSL: &str = include_str!("../../shaders/couple.wgsl");

/// Reads how near an agent must be to a POI to be at it.
pub(crate) fn observation_radius(r: &mut Reader<'_>) -> f64 {
    r.key("world.observation_radius", "units", "σ₀: an agent this near to a POI is at it", "3.2, Eq. 3")
        .number(between(0.01, LONGEST), 5.0)
}

shared! {
    /// What coupling reads.
    pub struct CoupleConstants as CoupleLanes {
        /// Squared.
        pub observation_radius2: f32,
    }
}

impl CoupleConstants {
    /// Of this radius.
    pub fn new(observation_radius: f64) -> CoupleConstants {
        CoupleConstants { observation_radius2: (observation_radius * observation_radius) as f32 }
    }
}

/// Lane operations of an agent tested for a POI and noted in its set: a test, a selection, a union.
pub const OBSERVE: u32 = SQUARED_DISTANCE + 3;

/// In which lanes the POI at offset (`dx`, `dy`) is within its observation radius.
#[inline(always)]
pub fn observes<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    within::<S>(dx, dy, world.couple.observation_radius2)
}
