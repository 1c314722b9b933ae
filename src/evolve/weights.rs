//! The range of a policy's weights, and random policies.

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use super::random::Key;
use crate::config::{Initial, Learning};
use crate::kernels::{clamp_to, math, splat};

/// The smallest size of a weight other than 0 (2^-30): no product in a policy is denormal.
pub const MIN_WEIGHT: f32 = 1.0 / 1_073_741_824.0;
/// The largest size of a weight (2^20). Mutation clamps to it.
pub const MAX_WEIGHT: f32 = 1_048_576.0;

/// Reports whether a number may be a weight.
pub fn is_weight(number: f32) -> bool {
    number == 0.0 || (MIN_WEIGHT..=MAX_WEIGHT).contains(&number.abs())
}

/// Flushes weights that are too small to 0. Returns the index of the first that is too large or not a number, if any;
/// weights after it stay unchanged.
pub fn flush_and_validate(weights: &mut [f32]) -> Option<usize> {
    weights.iter_mut().position(|weight| {
        if weight.abs() < MIN_WEIGHT {
            *weight = 0.0;
        }
        weight.is_nan() || weight.abs() > MAX_WEIGHT
    })
}

/// Fills a new policy, `[parameters]`, with weights from N(0, 1). `key` is a slot's key of
/// [`Purpose::Weights`](super::Purpose::Weights).
pub fn random_policy(level: Level, key: Key, weights: &mut [f32]) {
    dispatch!(level, simd => random_lanes(simd, key, Initial::Normal, 1.0, weights));
}

/// Fills a policy of generation 0, `[parameters]`, with weights from the config's distribution. `key` is that of
/// [`random_policy`].
pub fn initial_policy(level: Level, key: Key, learning: &Learning, weights: &mut [f32]) {
    let Learning { initial, initial_scale, .. } = *learning;
    dispatch!(level, simd => random_lanes(simd, key, initial, initial_scale as f32, weights));
}

#[inline(always)]
fn random_lanes<S: Simd>(simd: S, key: Key, initial: Initial, scale: f32, weights: &mut [f32]) {
    let width = S::f32s::LEN;
    let mut index = S::u32s::from_fn(simd, |lane| lane as u32);
    for chunk in weights.chunks_mut(width) {
        let [a, b, ..] = key.draw_lanes::<S>(index);
        let weight = match initial {
            Initial::Normal => math::normal::<S>(a, b),
            // The top 24 bits of `a` are a uniform number in [-1, 1).
            Initial::Uniform => (a >> 8).to_float::<S::f32s>() * 1.1920929e-7 - 1.0,
        };
        let weight = within_limits(simd, weight * scale);
        chunk.copy_from_slice(&weight.as_slice()[..chunk.len()]);
        index += width as u32;
    }
}

/// Clamps a weight to [`MAX_WEIGHT`], and flushes it to 0 below [`MIN_WEIGHT`].
#[inline(always)]
pub(super) fn within_limits<S: Simd>(simd: S, weight: S::f32s) -> S::f32s {
    let bounded = clamp_to::<S>(weight, splat(simd, -MAX_WEIGHT), splat(simd, MAX_WEIGHT));
    math::flush::<S>(bounded, MIN_WEIGHT)
}
