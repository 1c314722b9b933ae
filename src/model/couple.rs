//! Who is close enough to a POI to observe it (Equations 3 and 4). Its keys stand in `[world]`.

use fearless_simd::{Simd, prelude::*};
use serde::Serialize;

use super::{LONGEST, Lanes};
use crate::declare::shared;
use crate::kernels::operations::SQUARED_DISTANCE;
use crate::reader::{OneOrList, Reader, between};

/// The shader's part.
pub const WGSL: &str = include_str!("../../shaders/couple.wgsl");

/// Agents needed at a POI at the same step: one number for all POIs, or one per POI.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Coupling {
    Same(usize),
    Each(Vec<usize>),
}

impl Coupling {
    /// Reads it, of so many agents and POIs (none where their number is unknown).
    pub(crate) fn read(r: &mut Reader<'_>, agents: usize, pois: Option<usize>) -> Coupling {
        let coupling = r
            .key(
                "world.coupling",
                "agents",
                "C: how many must be at a POI at the same step for it to be observed; one number for all POIs, or one \
                 per POI",
                "3.2, Eq. 2",
            )
            .one_or_list(
                between(1, agents).because("the number of agents"),
                pois.map_or(0..=usize::MAX, |pois| pois..=pois),
                3,
            );
        match coupling {
            OneOrList::One(coupling) => Coupling::Same(coupling),
            OneOrList::List(couplings) => Coupling::Each(couplings),
        }
    }

    /// Of each of so many POIs.
    pub fn of_each(&self, pois: usize) -> Vec<u32> {
        match self {
            Coupling::Same(count) => vec![*count as u32; pois],
            Coupling::Each(counts) => counts.iter().map(|&count| count as u32).collect(),
        }
    }
}

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
    pub fn new(observation_radius: f64) -> CoupleConstants {
        CoupleConstants { observation_radius2: (observation_radius * observation_radius) as f32 }
    }
}

/// Lane operations of an agent tested for a POI and noted in its set: a test, a selection, a union.
pub const OBSERVE: u32 = SQUARED_DISTANCE + 3;

/// In which lanes the POI at offset (`dx`, `dy`) is within its observation radius.
#[inline(always)]
pub fn observes<S: Simd>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s) -> S::mask32s {
    let d2 = dx * dx + dy * dy;
    d2.simd_le(world.couple.observation_radius2)
}
