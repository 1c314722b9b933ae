//! The range of a policy's weights, and random initial policies.

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use super::random::Key;
use crate::kernels::{bound, math, splat};

/// Weights are 0 or of this size (2^-30) at least, so that no product in a policy is denormal.
pub const MIN_WEIGHT: f32 = 1.0 / 1_073_741_824.0;
/// Weights of larger size (2^20) stay at it.
pub const MAX_WEIGHT: f32 = 1_048_576.0;

/// Whether a number may be a weight.
pub fn is_weight(number: f32) -> bool {
    number == 0.0 || (MIN_WEIGHT..=MAX_WEIGHT).contains(&number.abs())
}

/// Makes weights fit for the kernels: those too small for them become 0. Gives the place of one that is too large or
/// no number.
pub fn admit(weights: &mut [f32]) -> Option<usize> {
    weights.iter_mut().position(|weight| {
        if weight.abs() < MIN_WEIGHT {
            *weight = 0.0;
        }
        weight.is_nan() || weight.abs() > MAX_WEIGHT
    })
}

/// Weights N(0, 1) for a new policy; `key` is a slot's of purpose [`Purpose::Weights`].
pub fn random_policy(level: Level, key: Key, weights: &mut [f32]) {
    dispatch!(level, simd => random_lanes(simd, key, weights));
}

#[inline(always)]
fn random_lanes<S: Simd>(simd: S, key: Key, weights: &mut [f32]) {
    let width = S::f32s::LEN;
    let mut index = S::u32s::from_fn(simd, |lane| lane as u32);
    for chunk in weights.chunks_mut(width) {
        let [a, b, ..] = key.draw_lanes::<S>(index);
        let weight = within_limits(simd, math::normal::<S>(a, b));
        chunk.copy_from_slice(&weight.as_slice()[..chunk.len()]);
        index += width as u32;
    }
}

/// A weight brought within the sizes that policies may have.
#[inline(always)]
pub(super) fn within_limits<S: Simd>(simd: S, weight: S::f32s) -> S::f32s {
    let bounded = bound::<S>(weight, splat(simd, -MAX_WEIGHT), splat(simd, MAX_WEIGHT));
    math::flush::<S>(bounded, MIN_WEIGHT)
}
