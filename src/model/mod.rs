//! The parts of a step. Each file has one part's config keys, constants, formulas and shader.
//!
//! Formulas are pure functions over lanes of teams. Each has a twin in `shaders/*.wgsl` with the same names and the
//! same order of operations. Constants are computed once from the config, in f64, and rounded once.

use std::ops::Range;

use fearless_simd::Simd;

use crate::gpu_struct::{GpuStruct, gpu_constants, gpu_struct};

pub mod class;
pub mod classes;
pub(crate) mod couple;
pub(crate) mod follow;
pub(crate) mod motion;
pub mod policy;
pub(crate) mod pursue;
pub mod region;
pub mod rule;
pub mod sense;
pub mod start;

use class::{Class, ClassConstants, ClassLanes, ClassShape};
use classes::{Combine, ControlKind, Frame, Measure};
use follow::{TermConstants, TermShape};
use motion::{GRID, INVERSE_GRID, MapConstants, MapLanes};
use policy::{Actions, BEHAVIOURS, PolicyConstants};
use sense::{ChannelConstants, ChannelShape};

/// The maximum length of a map side, radius or range. Its square is far from f32's overflow.
pub(crate) const LONGEST: f64 = 1e4;
/// The minimum size of a length or speed other than 0. Its square is far from f32's denormals.
pub(crate) const LEAST: f64 = 1e-6;
/// Sums, forces and components of a heading smaller than this (2^-30) are flushed to 0, so that no denormal follows.
pub(crate) const TINY: f32 = 1.0 / 1_073_741_824.0;

/// Maximum number of separate runs of agents or POIs that a channel or a term names.
pub const MAX_RANGES: usize = 4;

/// Runs of agents or POIs, ascending: the first of each, and the one after its last. Unused runs are empty.
pub type Ranges = [u32; 2 * MAX_RANGES];

/// Joins runs that meet.
///
/// # Panics
/// There are more than [`MAX_RANGES`] separate ones.
pub(crate) fn ranges(runs: impl IntoIterator<Item = Range<usize>>) -> Ranges {
    let mut runs: Vec<Range<usize>> = runs.into_iter().filter(|run| !run.is_empty()).collect();
    runs.sort_by_key(|run| run.start);
    runs.dedup_by(|next, run| {
        let meet = next.start <= run.end;
        if meet {
            run.end = run.end.max(next.end);
        }
        meet
    });
    let mut joined = [0; 2 * MAX_RANGES];
    for (to, run) in joined.chunks_exact_mut(2).zip(&runs) {
        to.copy_from_slice(&[run.start as u32, run.end as u32]);
    }
    assert!(runs.len() <= MAX_RANGES, "a valid config names fewer runs");
    joined
}

/// Returns one run.
pub(crate) fn one_range(run: Range<usize>) -> Ranges {
    ranges(std::iter::once(run))
}

/// Returns the runs that are not empty.
pub fn each(ranges: &Ranges) -> impl Iterator<Item = Range<usize>> {
    ranges.chunks_exact(2).map(|run| run[0] as usize..run[1] as usize).filter(|run| !run.is_empty())
}

gpu_struct! {
    /// The constants of a world, without its classes. In the shaders the fields of all parts are fields of this struct.
    pub struct Constants {
        /// Agents of a team that learn, agents 0 on.
        pub leaders: u32,
        /// The other agents of a team.
        pub followers: u32,
        /// Points of interest.
        pub pois: u32,
        /// T: steps of an episode.
        pub steps: u32,
        /// u32 words in a set of agents.
        pub words: u32,
        /// Classes of agents.
        pub class_count: u32,
        /// The index of its first class on a GPU.
        pub first_class: u32,
        /// Not 0 if any rule aligns headings.
        pub aligns: u32,
        /// Not 0 if any POI is gone once an observer has come near.
        pub gone: u32,
        /// The map and the length of a step.
        pub map: MapConstants,
        /// The sizes of a policy.
        pub policy: PolicyConstants,
    }
}

/// A world's constants and classes, and every float of them in all lanes.
#[derive(Clone)]
pub struct Lanes<S: Simd> {
    /// The constants.
    pub constants: Constants,
    /// The map and the length of a step.
    pub map: MapLanes<S>,
    /// `[classes]`.
    pub classes: Vec<ClassLanes<S>>,
}

impl<S: Simd> Lanes<S> {
    /// Copies every float to all lanes.
    pub fn new(simd: S, constants: Constants, classes: &[Class]) -> Lanes<S> {
        use crate::gpu_struct::Field;
        let classes = classes.iter().map(|class| class.lanes(simd)).collect();
        Lanes { constants, map: constants.map.lanes(simd), classes }
    }
}

/// Returns the WGSL of the structs and constants that the parts' shaders use.
#[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only GPUs have shaders"))]
pub(crate) fn declarations() -> String {
    let constants = gpu_constants!(BEHAVIOURS, TINY, GRID, INVERSE_GRID, MAX_RANGES);
    let structs = [
        Constants::wgsl(),
        ChannelShape::wgsl(),
        ChannelConstants::wgsl(),
        TermShape::wgsl(),
        TermConstants::wgsl(),
        ClassShape::wgsl(),
        ClassConstants::wgsl(),
        Class::wgsl(),
    ];
    let enums = [Measure::wgsl(), Combine::wgsl(), Frame::wgsl(), ControlKind::wgsl(), Actions::wgsl()];
    [structs.concat(), enums.concat(), constants].concat()
}

/// The parts' shaders.
#[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only GPUs have shaders"))]
pub(crate) const WGSL: [&str; 6] = [sense::WGSL, policy::WGSL, follow::WGSL, pursue::WGSL, motion::WGSL, couple::WGSL];
