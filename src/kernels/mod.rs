//! Arithmetic on lanes of teams that has the same bits everywhere. [`crate::model`] consists of it.
//!
//! Every function is generic over the processor's lane type, `S::f32s`, one team per lane. Only `+ - *`, comparison,
//! select, abs, floor and integer operations are used. All of them round correctly everywhere, so results do not depend
//! on lane width, processor or GPU.

use fearless_simd::{Select, Simd, prelude::*};

pub mod math;

/// `if_true` in the lanes in which `condition` holds, else `if_false`. The arguments are in WGSL's order.
#[inline(always)]
pub(crate) fn select<S: Simd>(if_false: S::f32s, if_true: S::f32s, condition: S::mask32s) -> S::f32s {
    condition.select(if_true, if_false)
}

/// `select(0.0, x, condition)` as one bitwise operation.
#[inline(always)]
pub(crate) fn zero_unless<S: Simd>(x: S::f32s, condition: S::mask32s) -> S::f32s {
    let bits: S::i32s = x.bitcast();
    (bits & condition.to_vector()).bitcast()
}

/// `select(x, 0.0, condition)` as one bitwise operation.
#[inline(always)]
pub(crate) fn zero_if<S: Simd>(x: S::f32s, condition: S::mask32s) -> S::f32s {
    let bits: S::i32s = x.bitcast();
    (bits & !condition.to_vector()).bitcast()
}

/// The same number in every lane.
#[inline(always)]
pub(crate) fn splat<S: Simd>(simd: S, value: f32) -> S::f32s {
    S::f32s::simd_from(simd, value)
}

/// The larger of two numbers; either zero if their signs differ. WebAssembly's own maximum treats NaN and these signs
/// specially, which costs eight instructions on most processors.
#[inline(always)]
pub(crate) fn larger<S: Simd>(a: S::f32s, b: S::f32s) -> S::f32s {
    if cfg!(target_family = "wasm") { select::<S>(b, a, a.simd_gt(b)) } else { a.max(b) }
}

/// The smaller of two numbers, see [`larger`].
#[inline(always)]
pub(crate) fn smaller<S: Simd>(a: S::f32s, b: S::f32s) -> S::f32s {
    if cfg!(target_family = "wasm") { select::<S>(b, a, a.simd_lt(b)) } else { a.min(b) }
}

/// `x` clamped to `low..=high`. Equal to the shader's pair of selects for numbers, in half the operations. If `x` and a
/// bound are zeros of different signs, either may result.
#[inline(always)]
pub(crate) fn clamp_to<S: Simd>(x: S::f32s, low: S::f32s, high: S::f32s) -> S::f32s {
    smaller::<S>(larger::<S>(x, low), high)
}

/// Counts the set bits of each lane.
#[inline(always)]
pub(crate) fn count_ones<S: Simd>(word: S::u32s) -> S::u32s {
    let in_pairs = word - ((word >> 1) & 0x5555_5555);
    let in_halves = (in_pairs & 0x3333_3333) + ((in_pairs >> 2) & 0x3333_3333);
    let in_bytes = (in_halves + (in_halves >> 4)) & 0x0f0f_0f0f;
    (in_bytes * 0x0101_0101) >> 24
}
