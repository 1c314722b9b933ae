//! A leader's policy: a fully connected network with a bias and tanh in every layer (Sections 2.4 and 3.1).

use fearless_simd::Simd;

use super::{Lanes, math};

/// Some units before their tanh: the bias (the last of a unit's weights) and the weighted inputs, added in order.
///
/// `weights` holds a row an input, and the biases, of `UNITS` weights each.
#[inline(always)]
pub fn weigh<S: Simd, const UNITS: usize>(inputs: &[S::f32s], weights: &[S::f32s]) -> [S::f32s; UNITS] {
    let (rows, _) = weights.as_chunks::<UNITS>();
    let mut sums = rows[inputs.len()];
    for (&input, row) in inputs.iter().zip(rows) {
        for (sum, &weight) in sums.iter_mut().zip(row) {
            *sum += input * weight;
        }
    }
    sums
}

/// The sum, ready for its tanh; sums too small to matter become 0, which keeps the next layer away from denormals.
#[inline(always)]
pub fn tame<S: Simd>(sum: S::f32s) -> S::f32s {
    math::limit_tangent::<S>(math::flush::<S>(sum, TINY))
}

/// Sums under this size (2^-30) count as 0.
pub const TINY: f32 = 1.0 / 1_073_741_824.0;

/// The wanted turn, in radians to the left, of the policy's first output in -1..1.
#[inline(always)]
pub fn wanted_turn<S: Simd>(output: S::f32s) -> S::f32s {
    output * std::f32::consts::PI
}

/// The wanted speed of the policy's second output in -1..1.
#[inline(always)]
pub fn wanted_speed<S: Simd>(world: &Lanes<S>, output: S::f32s) -> S::f32s {
    (output + 1.0) * 0.5 * world.max_speed
}
