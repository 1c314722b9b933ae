//! The parts of a step, each in one place: its keys, its constants, its formulas, its shader and what they cost.
//!
//! Formulas are pure functions over lanes of teams, the twins of `shaders/*.wgsl`: same names, same order. A part's
//! keys make its section of the config, and its constants are computed once from that, in f64, and rounded once.

use fearless_simd::Simd;

use crate::declare::{Field, Shared, shared};

pub mod couple;
pub mod follow;
pub mod motion;
pub mod policy;
pub mod rule;
pub mod sense;
pub mod start;

use couple::{CoupleConstants, CoupleLanes};
use follow::{FollowConstants, FollowLanes};
use motion::{MotionConstants, MotionLanes};
use policy::PolicyConstants;
use sense::{Density, SenseConstants, SenseLanes};

/// Longest map side, radius or range: squares of distances stay far from the ends of f32.
pub(crate) const LONGEST: f64 = 1e4;
/// Least size of a length or speed that is not 0: its square stays far from the denormals of f32.
pub(crate) const LEAST: f64 = 1e-6;

shared! {
    /// What every kernel reads; in the shaders the fields of all parts stand side by side.
    pub struct Constants {
        /// Learners of a team, agents 0 on.
        pub leaders: u32,
        /// Agents after them.
        pub followers: u32,
        /// Points of interest.
        pub pois: u32,
        /// T, of an episode.
        pub steps: u32,
        /// u32 words in the set of agents near one POI.
        pub words: u32,
        /// At the start, units a second.
        pub speed: f32,
        /// What kernels have code of their own for.
        pub variant: Variant,
        /// Sizes of a policy.
        pub policy: PolicyConstants,
        /// How agents move.
        pub motion: MotionConstants,
        /// Who is at a POI.
        pub couple: CoupleConstants,
        /// What followers do.
        pub follow: FollowConstants,
        /// What leaders sense.
        pub sense: SenseConstants,
    }

    /// What a step has code of its own for: a kernel made for its world has it as a constant.
    #[derive(Eq, Hash, Ord, PartialOrd)]
    pub struct Variant as VariantLanes {
        /// A [`Density`].
        pub density: u32,
        /// See [`MotionConstants::by_sine`].
        pub by_sine: u32,
    }
}

impl Variant {
    /// How a leader senses.
    pub fn density(&self) -> Density {
        Density::of(self.density)
    }
}

/// The constants, and those of the parts with every float in all lanes.
#[derive(Clone, Copy)]
pub struct Lanes<S: Simd> {
    /// As they are.
    pub constants: Constants,
    /// In all lanes.
    pub motion: MotionLanes<S>,
    /// In all lanes.
    pub couple: CoupleLanes<S>,
    /// In all lanes.
    pub follow: FollowLanes<S>,
    /// In all lanes.
    pub sense: SenseLanes<S>,
}

impl<S: Simd> Lanes<S> {
    /// Puts every float into all lanes.
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

/// The structs and constants that the parts' shaders read.
pub fn declarations() -> String {
    let inputs = format!("const INPUTS: u32 = {}u;\n", sense::INPUTS);
    [Constants::wgsl(), Variant::wgsl(), Density::wgsl(), inputs].concat()
}

/// The parts' shaders.
pub const WGSL: [&str; 5] = [sense::WGSL, policy::WGSL, follow::WGSL, motion::WGSL, couple::WGSL];
