//! Sensing: the density of POIs and of agents in four quadrants around a leader's heading (paper, Section 3.1).

use fearless_simd::{Simd, prelude::*};

use super::{LONGEST, Lanes};
use crate::config_enum::{Choice, config_enum};
use crate::gpu_struct::gpu_struct;
use crate::kernels::{
    larger,
    math::{exact_sqrt, lattice, less_base, nearest_f32, on_lattice, recip, rsqrt},
    select, splat,
};
use crate::reader::{Reader, between, section};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/sense.wgsl");
// The shader takes every density except the first for an inverse one.
const _: () = assert!(Density::ALL.len() == 3, "add the new density to shaders/sense.wgsl, too, and raise this number");

/// Inputs of a policy: POI and agent density in four quadrants each.
pub const INPUTS: usize = 8;
/// The inputs' names, in order.
pub(crate) const NAMES: [&str; INPUTS] = [
    "POIs back right",
    "POIs front right",
    "POIs front left",
    "POIs back left",
    "agents back right",
    "agents front right",
    "agents front left",
    "agents back left",
];
/// The finest lattice of densities, on which they are added: 2^-20.
const FINEST: f64 = 1.0 / 1_048_576.0;
/// A squared range that exceeds every distance on a map.
const UNLIMITED: f32 = 1e30;

section! {
    /// `[sense]`: what a leader senses. An infinite range is unlimited; a config file says so with `inf`. With a range
    /// of 0 nothing is sensed, not even what is at the leader's own place.
    Sense = "sense" {
        /// distance up to which leaders sense POIs; with 0 they sense none
        poi_range: f64 = "units", "3.1",
        /// distance up to which leaders sense other agents; with 0 they sense none
        agent_range: f64 = "units", "3.1",
        /// what something at distance d adds to its quadrant's density: 1 − d/(√2·max(map)) if linear, 1/max(d, 1) if
        /// inverse, and this as a share of all POIs or agents in the world; if mean, the density is the mean of
        /// 1/max(d, 1) over those sensed in the quadrant, which is the paper's definition
        density: Density = "", "3.1",
        /// multiplies all inputs of the leaders' policies
        gain: f64 = "", "",
    }
}

impl Sense {
    /// Reads the section.
    pub(crate) fn read(r: &mut Reader<'_>) -> Sense {
        Sense {
            poi_range: Sense::poi_range(r).number(between(0.01, LONGEST).or_zero().or_unlimited(), f64::INFINITY),
            agent_range: Sense::agent_range(r).number(between(0.01, LONGEST).or_zero().or_unlimited(), 5.0),
            density: Sense::density(r).choice(Density::Linear),
            gain: Sense::gain(r).number(between(1e-3, 1e3), 1.0),
        }
    }
}

config_enum! {
    /// How a sensed distance counts.
    Density {
        /// `1 - d/D` with D = √2·max(map).
        Linear = "linear",
        /// `1 / max(d, 1)`.
        Inverse = "inverse",
        /// The mean of `1 / max(d, 1)` over the quadrant.
        Mean = "mean",
    }
}

config_enum! {
    /// What an entity at distance d counts in its sector.
    Measure {
        /// `1 - d/D` with D = √2·max(map).
        Linear = "linear",
        /// `1 / max(d, nearest)`.
        Inverse = "inverse",
        /// `1 / max(d, nearest)²`.
        InverseSquared = "inverse-squared",
        /// `exp(-d)`.
        Exponential = "exponential",
        /// `d / range`.
        Distance = "distance",
        /// `1 - d / range`.
        Closeness = "closeness",
    }
}

config_enum! {
    /// How the measures of a sector become one input.
    Combine {
        /// Their sum divided by the number of such entities in the world.
        Share = "share",
        /// Their sum.
        Sum = "sum",
        /// Their mean.
        Mean = "mean",
        /// The largest of them.
        Closest = "closest",
    }
}

config_enum! {
    /// What the sectors of a channel turn with.
    Frame {
        /// The agent's heading: the first sector begins straight behind.
        Heading = "heading",
        /// The map: the first sector begins at the x axis.
        Map = "map",
    }
}

gpu_struct! {
    /// Constants of sensing.
    pub struct SenseConstants as SenseLanes {
        /// The squared range of POIs.
        pub poi_range2: f32,
        /// The squared range of agents.
        pub agent_range2: f32,
        /// The base of the lattice of densities.
        pub density_base: f32,
        /// Multiplies a sum over POIs, in lattice distances: gain/P, or the gain if densities are means, times the
        /// distance; 0 if no POI is sensed.
        pub poi_share: f32,
        /// The same for sums over agents.
        pub agent_share: f32,
        /// 1/D with D = √2·max(map).
        pub inverse_diagonal: f32,
    }
}

impl SenseConstants {
    /// Computes the constants for so many agents and POIs on a map.
    pub fn new(sense: &Sense, agents: usize, pois: usize, map: [f64; 2]) -> SenseConstants {
        // No density exceeds 1 by more than rounding.
        let [density_base, distance] = lattice(agents.max(pois), 1.01, FINEST);
        // A range of 0 still reaches what is at the same place: that weighs nothing, on every backend alike.
        let share = |range: f64, count: usize| match sense.density {
            _ if range == 0.0 => 0.0,
            Density::Mean => (sense.gain * f64::from(distance)) as f32,
            Density::Linear | Density::Inverse => (sense.gain * f64::from(distance) / count as f64) as f32,
        };
        let range2 = |range: f64| if range.is_infinite() { UNLIMITED } else { (range * range) as f32 };
        SenseConstants {
            poi_range2: range2(sense.poi_range),
            agent_range2: range2(sense.agent_range),
            density_base,
            poi_share: share(sense.poi_range, pois),
            agent_share: share(sense.agent_range, agents),
            inverse_diagonal: (1.0 / (2f64.sqrt() * map[0].max(map[1]))) as f32,
        }
    }
}

/// Returns the density of an entity at offset (`dx`, `dy`) in lattice distances. The caller checks that it is in range.
#[inline(always)]
pub(crate) fn density<S: Simd, const DENSITY: u32>(world: &Lanes<S>, dx: S::f32s, dy: S::f32s) -> S::i32s {
    let (one, base) = (splat(dx.token(), 1.0), world.sense.density_base);
    let d2 = dx * dx + dy * dy;
    match const { Density::of(DENSITY) } {
        Density::Linear => less_base::<S>(one + base - exact_sqrt::<S>(d2) * world.sense.inverse_diagonal, base),
        Density::Inverse | Density::Mean => on_lattice::<S>(rsqrt::<S>(select::<S>(one, d2, d2.simd_gt(one))), base),
    }
}

/// The entities of one class around a leader: sums over all, over those on the left, in front, and both.
#[derive(Clone, Copy)]
struct Halves<S: Simd> {
    all: S::i32s,
    left: S::i32s,
    front: S::i32s,
    both: S::i32s,
}

impl<S: Simd> Halves<S> {
    #[inline(always)]
    fn add(&mut self, number: S::i32s, left: S::i32s, front: S::i32s) {
        self.all += number;
        self.left += number & left;
        self.front += number & front;
        self.both += number & left & front;
    }

    /// Returns the sum of each quadrant, in the order of the policy's inputs: back right, front right, front left, back
    /// left.
    #[inline(always)]
    fn quadrants(self) -> [S::f32s; 4] {
        let Halves { all, left, front, both } = self;
        [all - left - front + both, front - both, both, left - both].map(nearest_f32::<S>)
    }
}

/// The entities of one class around a leader, by quadrant.
#[derive(Clone, Copy)]
pub struct Quadrants<S: Simd> {
    /// The sums of their densities, in lattice distances.
    densities: Halves<S>,
    /// The number of entities sensed. Only means need it.
    counts: Halves<S>,
}

impl<S: Simd> Quadrants<S> {
    /// Returns empty quadrants.
    #[inline(always)]
    pub fn new(simd: S) -> Quadrants<S> {
        let none = S::i32s::splat(simd, 0);
        let empty = Halves { all: none, left: none, front: none, both: none };
        Quadrants { densities: empty, counts: empty }
    }

    /// Adds an entity with this density, which is 0 out of range, at offset (`dx`, `dy`) from a leader with heading
    /// (`hx`, `hy`).
    ///
    /// The signs of the offset along the heading and to its left determine the quadrant. A tie goes to the
    /// counterclockwise quadrant, so that each boundary belongs to exactly one.
    #[inline(always)]
    pub fn add<const DENSITY: u32>(&mut self, density: S::i32s, dx: S::f32s, dy: S::f32s, hx: S::f32s, hy: S::f32s) {
        let zero = splat(dx.token(), 0.0);
        let fx = dx * hx + dy * hy;
        let fy = dy * hx - dx * hy;
        let left = (fy.simd_gt(zero) | (fy.simd_ge(zero) & fx.simd_ge(zero))).to_vector();
        let front = (fx.simd_gt(zero) | (fx.simd_ge(zero) & !fy.simd_gt(zero))).to_vector();
        self.densities.add(density, left, front);
        if const { matches!(Density::of(DENSITY), Density::Mean) } {
            self.counts.add(density.min(1), left, front);
        }
    }

    /// Returns the inputs: the sums, or the means, times a constant.
    #[inline(always)]
    fn inputs<const DENSITY: u32>(self, share: S::f32s) -> [S::f32s; 4] {
        let [sums, counts] = [self.densities.quadrants(), self.counts.quadrants()];
        std::array::from_fn(
            #[inline(always)]
            |quadrant| match const { Density::of(DENSITY) } {
                Density::Mean => {
                    let one = splat(share.token(), 1.0);
                    sums[quadrant] * recip::<S>(larger::<S>(counts[quadrant], one)) * share
                }
                Density::Linear | Density::Inverse => sums[quadrant] * share,
            },
        )
    }
}

/// Returns the policy's inputs: the densities of both kinds, each multiplied by its constant.
#[inline(always)]
pub(crate) fn scale_inputs<S: Simd, const DENSITY: u32>(
    world: &Lanes<S>,
    of_pois: Quadrants<S>,
    of_agents: Quadrants<S>,
) -> [S::f32s; INPUTS] {
    let [p0, p1, p2, p3] = of_pois.inputs::<DENSITY>(world.sense.poi_share);
    let [a0, a1, a2, a3] = of_agents.inputs::<DENSITY>(world.sense.agent_share);
    [p0, p1, p2, p3, a0, a1, a2, a3]
}
