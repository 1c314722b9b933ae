//! The parts of a step. Each file has one part's config keys, constants, formulas and shader.
//!
//! Formulas are pure functions over lanes of teams. Each has a twin in `shaders/*.wgsl` with the same names and the
//! same order of operations. Constants are computed once from the config, in f64, and rounded once.

use fearless_simd::Simd;

use crate::gpu_struct::{Field, GpuStruct, gpu_constants, gpu_struct};

pub(crate) mod couple;
pub(crate) mod follow;
pub(crate) mod motion;
pub mod policy;
pub mod rule;
pub mod sense;
pub mod start;

use couple::{CoupleConstants, CoupleLanes};
use follow::{FollowConstants, FollowLanes};
use motion::{GRID, INVERSE_GRID, MotionConstants, MotionLanes};
use policy::{BEHAVIOURS, PolicyConstants};
use sense::{Density, INPUTS, SenseConstants, SenseLanes};

/// The maximum length of a map side, radius or range. Its square is far from f32's overflow.
pub(crate) const LONGEST: f64 = 1e4;
/// The minimum size of a length or speed other than 0. Its square is far from f32's denormals.
pub(crate) const LEAST: f64 = 1e-6;
/// Sums, forces and components of a heading smaller than this (2^-30) are flushed to 0, so that no denormal follows.
pub(crate) const TINY: f32 = 1.0 / 1_073_741_824.0;

gpu_struct! {
    /// The constants of a world. In the shaders the fields of all parts are fields of this struct.
    pub struct Constants {
        /// Leaders of a team, agents 0 on.
        pub leaders: u32,
        /// Followers of a team, the agents after the leaders.
        pub followers: u32,
        /// Points of interest.
        pub pois: u32,
        /// T: steps of an episode.
        pub steps: u32,
        /// u32 words in a set of agents.
        pub words: u32,
        /// The initial speed, in units per second.
        pub speed: f32,
        /// Choices that kernels are specialised for.
        pub variant: Variant,
        /// The sizes of a policy.
        pub policy: PolicyConstants,
        /// Constants of motion.
        pub motion: MotionConstants,
        /// Constants of coupling.
        pub couple: CoupleConstants,
        /// Constants of following.
        pub follow: FollowConstants,
        /// Constants of sensing.
        pub sense: SenseConstants,
    }

    /// Choices between formulas. In a specialised kernel they are constants.
    #[derive(Eq, Hash, Ord, PartialOrd)]
    pub struct Variant as VariantLanes {
        /// A [`Density`], by its number.
        pub density: u32,
        /// See [`MotionConstants::by_sine`].
        pub by_sine: u32,
    }
}

impl Variant {
    /// Returns the density.
    pub fn density(&self) -> Density {
        Density::of(self.density)
    }
}

/// A world's constants, and every float of the parts in all lanes.
#[derive(Clone, Copy)]
pub struct Lanes<S: Simd> {
    /// The constants.
    pub constants: Constants,
    /// Motion.
    pub motion: MotionLanes<S>,
    /// Coupling.
    pub couple: CoupleLanes<S>,
    /// Following.
    pub follow: FollowLanes<S>,
    /// Sensing.
    pub sense: SenseLanes<S>,
}

impl<S: Simd> Lanes<S> {
    /// Copies every float to all lanes.
    pub fn new(simd: S, constants: Constants) -> Lanes<S> {
        let Constants { motion, couple, follow, sense, .. } = constants;
        Lanes {
            constants,
            motion: motion.lanes(simd),
            couple: couple.lanes(simd),
            follow: follow.lanes(simd),
            sense: sense.lanes(simd),
        }
    }
}

/// Returns the WGSL of the structs and constants that the parts' shaders use.
pub(crate) fn declarations() -> String {
    let constants = gpu_constants!(INPUTS, BEHAVIOURS, TINY, GRID, INVERSE_GRID);
    [Constants::wgsl(), Variant::wgsl(), Density::wgsl(), constants].concat()
}

/// The parts' shaders.
pub(crate) const WGSL: [&str; 5] = [sense::WGSL, policy::WGSL, follow::WGSL, motion::WGSL, couple::WGSL];
