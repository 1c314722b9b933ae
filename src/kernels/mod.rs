//! Arithmetic on lanes of teams that comes out alike everywhere: what the parts of [`crate::model`] are made of.
//!
//! Every function is generic over the processor's lane type, `S::f32s`, one team a lane. Only `+ - *`, comparison,
//! select, abs, floor and integer operations are used, each correctly rounded everywhere, so lane width, processor
//! and GPU cannot show in the bits.

use fearless_simd::{Select, Simd, prelude::*};

pub mod math;

/// `if_true` in the lanes where `condition` holds, `if_false` elsewhere, in WGSL's order of arguments.
#[inline(always)]
pub fn select<S: Simd>(if_false: S::f32s, if_true: S::f32s, condition: S::mask32s) -> S::f32s {
    condition.select(if_true, if_false)
}

/// `select(0.0, x, condition)` in one operation: masks of whole lanes are spared the test of their sign.
#[inline(always)]
pub fn only<S: Simd>(x: S::f32s, condition: S::mask32s) -> S::f32s {
    let bits: S::i32s = x.bitcast();
    (bits & condition.to_vector()).bitcast()
}

/// `select(x, 0.0, condition)`, likewise.
#[inline(always)]
pub fn except<S: Simd>(x: S::f32s, condition: S::mask32s) -> S::f32s {
    let bits: S::i32s = x.bitcast();
    (bits & !condition.to_vector()).bitcast()
}

/// The same number in every lane.
#[inline(always)]
pub fn splat<S: Simd>(simd: S, value: f32) -> S::f32s {
    S::f32s::simd_from(simd, value)
}

/// The larger of two numbers, for zeros of different signs either. WebAssembly's own maximum minds NaN and those signs, by
/// eight instructions where processors have no such one.
#[inline(always)]
pub fn larger<S: Simd>(a: S::f32s, b: S::f32s) -> S::f32s {
    if cfg!(target_family = "wasm") { select::<S>(b, a, a.simd_gt(b)) } else { a.max(b) }
}

/// The smaller of two numbers, likewise.
#[inline(always)]
pub fn smaller<S: Simd>(a: S::f32s, b: S::f32s) -> S::f32s {
    if cfg!(target_family = "wasm") { select::<S>(b, a, a.simd_lt(b)) } else { a.min(b) }
}

/// `x` moved into `low..=high`: for numbers this is the shader's pair of selects, in half the operations. Where `x` and
/// a bound are zeros of different signs, either may come out.
#[inline(always)]
pub fn bound<S: Simd>(x: S::f32s, low: S::f32s, high: S::f32s) -> S::f32s {
    smaller::<S>(larger::<S>(x, low), high)
}

/// Lane operations of each function here: an f32 or integer operation, comparison or selection is one.
pub mod operations {
    /// [`rsqrt`](super::math::rsqrt).
    pub const RSQRT: u32 = 12;
    /// [`root`](super::math::root).
    pub const ROOT: u32 = 12;
    /// [`recip`](super::math::recip).
    pub const RECIP: u32 = 8;
    /// A bound, a square, 5 and 3 for numerator and denominator; their squares' sum, its rough reciprocal (4) and 6
    /// more.
    pub const TANH: u32 = BOUND + 1 + 5 + 3 + 3 + 4 + 6;
    /// [`sin_cos`](super::math::sin_cos).
    pub const SIN_COS: u32 = 26;
    /// [`flush`](super::math::flush).
    pub const FLUSH: u32 = 3;
    /// A clamp: minimum and maximum.
    pub const BOUND: u32 = 2;
    /// An offset and its square: 2 differences, 2 products, a sum.
    pub const SQUARED_DISTANCE: u32 = 5;
    /// A rotation, or an offset seen from a heading: 4 products, 2 sums.
    pub const ROTATE: u32 = 6;
}
