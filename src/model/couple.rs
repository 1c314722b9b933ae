//! Coupling: whether an agent is close enough to a POI to observe it (paper, Equations 3 and 4). Its key is in
//! `[world]`.

use fearless_simd::Simd;

use super::{LONGEST, Lanes};
use crate::gpu_struct::gpu_struct;
use crate::kernels::math::within;
use crate::reader::{Reader, between};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/couple.wgsl");

/// Reads the observation radius.
pub(crate) fn observation_radius(r: &mut Reader<'_>) -> f64 {
    r.key("world.observation_radius", "units", "σ₀: distance up to which an agent observes a POI", "3.2, Eq. 3")
        .number(between(0.01, LONGEST), 5.0)
}

gpu_struct! {
    /// Constants of coupling.
    pub struct CoupleConstants as CoupleLanes {
        /// The observation radius, squared.
        pub observation_radius2: f32,
    }
}

impl CoupleConstants {
    /// Computes the constants.
    pub fn new(observation_radius: f64) -> CoupleConstants {
        CoupleConstants { observation_radius2: (observation_radius * observation_radius) as f32 }
    }
}

/// Returns the lanes in which the POI at offset (`dx`, `dy`) is within its observation radius.
#[inline(always)]
pub fn observes<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    within::<S>(dx, dy, world.couple.observation_radius2)
}
