//! Sensing: what agents and POIs add to the inputs of a policy, by channel and sector. The paper's leaders sense the
//! density of POIs and of agents in four quadrants around their heading (Section 3.1).

use std::ops::Range;

use fearless_simd::{Simd, prelude::*};

use super::classes::{AGENTS, Channel, Combine, Frame, MAX_SECTORS, Measure, POIS, Sectors as SectorsOf};
use super::{LONGEST, Ranges, one_range, ranges};
use crate::config_enum::{Choice, config_enum};
use crate::gpu_struct::gpu_struct;
use crate::kernels::{
    larger,
    math::{exact_sqrt, exp_negative, lattice, less_base, nearest_f32, on_lattice, recip, rsqrt},
    select, splat,
};
use crate::reader::{Reader, between, section};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/sense.wgsl");
// The shader has a case for each, and takes the last for the other one.
const _: () = assert!(Measure::ALL.len() == 6, "add the new measure to shaders/sense.wgsl, too, and raise this number");

/// Maximum of a measure times a POI's value.
pub const MOST_MEASURED: f64 = 2000.0;
/// The finest lattice of measures, on which they are added: 2^-20.
const FINEST: f64 = 1.0 / 1_048_576.0;
/// A squared range that exceeds every distance on a map.
const UNLIMITED: f32 = 1e30;
/// A squared range within which nothing is.
pub(crate) const NOTHING: f32 = -1.0;

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

gpu_struct! {
    /// The parts of a channel that kernels are specialised for.
    #[derive(Eq, Hash, Ord, PartialOrd)]
    pub struct ChannelShape as itself {
        /// Not 0 if it senses POIs, 0 if agents.
        pub of_pois: u32,
        /// The POIs or agents that it senses.
        pub ranges: Ranges,
        /// Sectors.
        pub sectors: u32,
        /// Not 0 if each POI or agent has a sector of its own.
        pub each: u32,
        /// A [`Frame`], by its number.
        pub frame: u32,
        /// A [`Measure`], by its number.
        pub measure: u32,
        /// A [`Combine`], by its number.
        pub combine: u32,
        /// Not 0 if the entities of each sector are counted.
        pub counts: u32,
        /// The first of its inputs.
        pub input: u32,
    }

    /// Constants of a channel.
    pub struct ChannelConstants as ChannelLanes {
        /// The parts that kernels are specialised for.
        pub shape: ChannelShape,
        /// The squared range.
        pub range2: f32,
        /// The base of the lattice of measures.
        pub base: f32,
        /// The change of a linear measure per unit: 1/D with D = √2·max(map), or 1/range.
        pub slope: f32,
        /// The squared distance below which inverse measures do not grow.
        pub nearest2: f32,
        /// Multiplies a sum, a mean or a maximum in lattice distances.
        pub scale: f32,
        /// The input of an empty sector.
        pub empty: f32,
        /// The direction at which each sector begins, x and y, relative to the frame.
        pub boundaries: [f32; 2 * MAX_SECTORS],
    }
}

impl Measure {
    /// Returns its largest value, if it does not grow below the distance `nearest`.
    pub(crate) fn largest(self, nearest: f64) -> f64 {
        match self {
            Measure::Inverse => 1.0 / nearest,
            Measure::InverseSquared => 1.0 / (nearest * nearest),
            _ => 1.0,
        }
    }
}

impl ChannelConstants {
    /// Computes the constants. `of` returns the agents of a class and the POIs of a group; `values` are those of the POIs,
    /// and `agents` is the number of agents.
    pub(crate) fn new(
        channel: &Channel,
        input: usize,
        class: &dyn Fn(&str) -> Range<usize>,
        group: &dyn Fn(&str) -> Range<usize>,
        values: &[f32],
        agents: usize,
        map: [f64; 2],
    ) -> ChannelConstants {
        let Channel { of, pois, sectors, frame, range, measure, nearest, combine, empty, gain } = channel;
        let of_pois = of == &[POIS];
        let ranges = match of_pois {
            true if pois.is_empty() => one_range(0..values.len()),
            true => ranges(pois.iter().map(|name| group(name))),
            false if of == &[AGENTS] => one_range(0..agents),
            false => ranges(of.iter().map(|name| class(name))),
        };
        // POIs of other groups may be worth so much more that the lattice would be too coarse for these.
        let value = match of_pois {
            true => super::each(&ranges).flat_map(|pois| &values[pois]).copied().fold(0.0, f32::max),
            false => 1.0,
        };
        // No measure exceeds the largest by more than rounding.
        let size = 1.01 * measure.largest(*nearest) * f64::from(value);
        let [base, distance] = lattice(agents.max(values.len()), size, FINEST);
        let count = super::each(&ranges).map(|range| range.len()).sum::<usize>();
        let scale = gain * f64::from(distance) / if *combine == Combine::Share { count as f64 } else { 1.0 };
        let mut boundaries = [0.0; 2 * MAX_SECTORS];
        if let SectorsOf::Equal(sectors) = *sectors {
            for (sector, boundary) in boundaries.chunks_exact_mut(2).take(sectors).enumerate() {
                boundary.copy_from_slice(&boundary_of(sector, sectors, *frame));
            }
        }
        ChannelConstants {
            shape: ChannelShape {
                of_pois: of_pois.into(),
                ranges,
                sectors: sectors.count() as u32,
                each: matches!(sectors, SectorsOf::Each(_)).into(),
                frame: *frame as u32,
                measure: *measure as u32,
                combine: *combine as u32,
                counts: (matches!(combine, Combine::Mean | Combine::Closest) || *empty != 0.0).into(),
                input: input as u32,
            },
            range2: squared_range(*range),
            base,
            slope: match measure {
                Measure::Distance | Measure::Closeness => (1.0 / range) as f32,
                _ => (1.0 / (2f64.sqrt() * map[0].max(map[1]))) as f32,
            },
            nearest2: (nearest * nearest) as f32,
            scale: scale as f32,
            empty: *empty as f32,
            boundaries,
        }
    }
}

impl ChannelShape {
    /// Reports whether its sectors are quadrants whose measures are added, see [`Quadrants`].
    pub(crate) fn is_in_quadrants(&self) -> bool {
        self.each == 0 && self.sectors == 4 && self.combine != Combine::Closest as u32
    }
}

impl<S: Simd> ChannelLanes<S> {
    /// Returns the heading that the sectors of an agent with this heading turn with: the x axis if they are fixed to the
    /// map.
    #[inline(always)]
    pub(crate) fn heading(&self, hx: S::f32s, hy: S::f32s) -> [S::f32s; 2] {
        match self.shape.frame == Frame::Map as u32 {
            true => [1.0, 0.0].map(|component| splat(hx.token(), component)),
            false => [hx, hy],
        }
    }
}

/// Returns the square of a range.
pub(crate) fn squared_range(range: f64) -> f32 {
    match range {
        _ if range.is_infinite() => UNLIMITED,
        0.0 => NOTHING,
        _ => (range * range) as f32,
    }
}

/// Returns the direction at which a sector begins. Components smaller than 1e-9 become 0, so that the axes are exact.
fn boundary_of(sector: usize, sectors: usize, frame: Frame) -> [f32; 2] {
    let behind = if frame == Frame::Heading { 0.5 } else { 0.0 };
    let angle = std::f64::consts::TAU * (sector as f64 / sectors as f64 + behind);
    [libm::cos(angle), libm::sin(angle)].map(|component| if component.abs() < 1e-9 { 0.0 } else { component as f32 })
}

/// Returns what an entity of this value at offset (`dx`, `dy`) counts, in lattice distances: 0 out of range.
#[inline(always)]
pub(crate) fn measured<S: Simd>(
    channel: &ChannelLanes<S>,
    measure: Measure,
    value: S::f32s,
    dx: S::f32s,
    dy: S::f32s,
) -> (S::i32s, S::mask32s) {
    let ChannelLanes { base, slope, .. } = *channel;
    let d2 = dx * dx + dy * dy;
    let measured = match measure {
        Measure::Linear | Measure::Closeness => {
            less_base::<S>(value + base - exact_sqrt::<S>(d2) * (slope * value), base)
        }
        Measure::Distance => on_lattice::<S>(exact_sqrt::<S>(d2) * (slope * value), base),
        Measure::Inverse => on_lattice::<S>(rsqrt::<S>(larger::<S>(d2, channel.nearest2)) * value, base),
        Measure::InverseSquared => {
            let inverse = rsqrt::<S>(larger::<S>(d2, channel.nearest2));
            on_lattice::<S>(inverse * inverse * value, base)
        }
        Measure::Exponential => on_lattice::<S>(exp_negative::<S>(exact_sqrt::<S>(d2)) * value, base),
    };
    // Equal to the shader's comparison of bits, because no number is negative but a range of nothing.
    let within = d2.simd_le(channel.range2);
    (measured & within.to_vector(), within)
}

/// Returns an offset relative to a heading: along it, and to its left. What is at the same place is straight ahead.
#[inline(always)]
fn turned<S: Simd>([dx, dy]: [S::f32s; 2], [hx, hy]: [S::f32s; 2]) -> (S::f32s, S::f32s) {
    (dx * hx + dy * hy, dy * hx - dx * hy)
}

/// Sums over the entities around an agent: over all, over those on the left, in front, and both.
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

    /// Returns the sum of each quadrant: back right, front right, front left, back left.
    #[inline(always)]
    fn quadrants(self) -> [S::i32s; 4] {
        let Halves { all, left, front, both } = self;
        [all - left - front + both, front - both, both, left - both]
    }
}

/// A channel of four sectors, which are the quadrants around a heading. It needs fewer operations than [`Sectors`], and
/// gives the same bits.
#[derive(Clone, Copy)]
pub(crate) struct Quadrants<S: Simd> {
    /// The sums of measures, in lattice distances.
    sums: Halves<S>,
    /// The number of entities sensed.
    counts: Halves<S>,
}

impl<S: Simd> Quadrants<S> {
    #[inline(always)]
    pub(crate) fn new(simd: S) -> Quadrants<S> {
        let none = S::i32s::splat(simd, 0);
        let empty = Halves { all: none, left: none, front: none, both: none };
        Quadrants { sums: empty, counts: empty }
    }

    /// Adds an entity with this measure at an offset from an agent with this [heading](ChannelLanes::heading). `PLAIN`
    /// channels count no entities. `MAP` omits the rotation, which is right only if sectors are fixed to the map.
    ///
    /// The signs of the offset along the heading and to its left determine the quadrant. A tie goes to the
    /// counterclockwise quadrant, so that each boundary belongs to exactly one.
    #[inline(always)]
    pub(crate) fn add<const PLAIN: bool, const MAP: bool>(
        &mut self,
        (measured, within): (S::i32s, S::mask32s),
        offset: [S::f32s; 2],
        heading: [S::f32s; 2],
    ) {
        let (fx, fy) = if MAP { (offset[0], offset[1]) } else { turned::<S>(offset, heading) };
        let zero = splat(fx.token(), 0.0);
        let left = (fy.simd_gt(zero) | (fy.simd_ge(zero) & fx.simd_ge(zero))).to_vector();
        let front = (fx.simd_gt(zero) | (fx.simd_ge(zero) & !fy.simd_gt(zero))).to_vector();
        self.sums.add(measured, left, front);
        if !PLAIN {
            self.counts.add(-within.to_vector(), left, front);
        }
    }

    /// Writes the channel's inputs.
    #[inline(always)]
    pub(crate) fn write<const PLAIN: bool>(self, channel: &ChannelLanes<S>, inputs: &mut [S::f32s; 4]) {
        let (sums, counts) = (self.sums.quadrants(), self.counts.quadrants());
        for ((input, &sum), &count) in inputs.iter_mut().zip(&sums).zip(&counts) {
            *input = if PLAIN { nearest_f32::<S>(sum) * channel.scale } else { input_of::<S>(channel, sum, count) };
        }
        // Sectors of the map begin at the x axis, which is straight ahead.
        if channel.shape.frame == Frame::Map as u32 {
            let [back_right, front_right, front_left, back_left] = *inputs;
            *inputs = [front_left, back_left, back_right, front_right];
        }
    }
}

/// Whether a direction is less than half a turn after the beginning of a sector.
#[inline(always)]
fn is_after<S: Simd>(channel: &ChannelLanes<S>, sector: usize, fx: S::f32s, fy: S::f32s) -> S::mask32s {
    let (simd, zero) = (fx.token(), splat(fx.token(), 0.0));
    let (bx, by) = (splat(simd, channel.boundaries[sector * 2]), splat(simd, channel.boundaries[sector * 2 + 1]));
    let across = bx * fy - by * fx;
    across.simd_gt(zero) | (across.simd_ge(zero) & (bx * fx + by * fy).simd_ge(zero))
}

/// A channel of any number of sectors.
pub(crate) struct Sectors<S: Simd> {
    /// The sum of the measures of each sector, or the largest of them, in lattice distances.
    sums: [S::i32s; MAX_SECTORS],
    /// The number of entities sensed in each sector.
    counts: [S::i32s; MAX_SECTORS],
}

/// Less than every measure.
const NO_MEASURE: i32 = i32::MIN;

impl<S: Simd> Sectors<S> {
    #[inline(always)]
    pub(crate) fn new(simd: S, combine: Combine) -> Sectors<S> {
        let none = S::i32s::splat(simd, if combine == Combine::Closest { NO_MEASURE } else { 0 });
        Sectors { sums: [none; MAX_SECTORS], counts: [S::i32s::splat(simd, 0); MAX_SECTORS] }
    }

    /// Adds an entity as [`Quadrants::add`] does.
    #[inline(always)]
    pub(crate) fn add(
        &mut self,
        channel: &ChannelLanes<S>,
        (measured, within): (S::i32s, S::mask32s),
        offset: [S::f32s; 2],
        heading: [S::f32s; 2],
    ) {
        let (fx, fy) = turned::<S>(offset, heading);
        let simd = fx.token();
        let (zero, sectors) = (splat(simd, 0.0), channel.shape.sectors as usize);
        // What is at the same place is straight ahead.
        let fx = select::<S>(fx, splat(simd, 1.0), fx.simd_eq(zero) & fy.simd_eq(zero));
        let first = is_after::<S>(channel, 0, fx, fy);
        let mut begun = first;
        for sector in 0..sectors {
            let inside = match sectors {
                1 => within,
                2 if sector == 1 => within & !first,
                2 => within & first,
                _ => {
                    let next = if sector + 1 < sectors { is_after::<S>(channel, sector + 1, fx, fy) } else { first };
                    let inside = within & begun & !next;
                    begun = next;
                    inside
                }
            };
            let sum = &mut self.sums[sector];
            if channel.shape.combine == Combine::Closest as u32 {
                *sum = inside.select((*sum).max(measured), *sum);
            } else {
                *sum += measured & inside.to_vector();
            }
            self.counts[sector] -= inside.to_vector();
        }
    }

    /// Writes the channel's inputs.
    #[inline(always)]
    pub(crate) fn write(&self, channel: &ChannelLanes<S>, inputs: &mut [S::f32s]) {
        for ((to, &sum), &count) in inputs.iter_mut().zip(&self.sums).zip(&self.counts) {
            *to = input_of::<S>(channel, sum, count);
        }
    }
}

/// Returns the input of a sector from the sum, or the largest, of its measures, and the number of its entities.
#[inline(always)]
pub(crate) fn input_of<S: Simd>(channel: &ChannelLanes<S>, sum: S::i32s, count: S::i32s) -> S::f32s {
    let (sum, simd) = (nearest_f32::<S>(sum), channel.scale.token());
    let shape = &channel.shape;
    let value = if shape.combine == Combine::Mean as u32 {
        sum * recip::<S>(nearest_f32::<S>(count.max(1))) * channel.scale
    } else {
        sum * channel.scale
    };
    let sensed = count.simd_gt(S::i32s::splat(simd, 0));
    if shape.counts != 0 { select::<S>(channel.empty, value, sensed) } else { value }
}
