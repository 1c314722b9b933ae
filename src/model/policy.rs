//! A leader's policy: a fully connected network with a bias and tanh in every layer (Sections 2.4 and 3.1).

use fearless_simd::Simd;
use serde::Serialize;

use super::{Lanes, sense::INPUTS};
use crate::declare::shared;
use crate::kernels::{
    math,
    operations::{FLUSH, TANH},
};
use crate::reader::{Reader, between};

/// The shader's part.
pub const WGSL: &str = include_str!("../../shaders/policy.wgsl");

/// Outputs of a policy: wanted change of heading and wanted speed.
pub const OUTPUTS: usize = 2;
/// Most hidden layers of a policy.
pub const MAX_HIDDEN_LAYERS: usize = 3;
/// Most units in one hidden layer.
pub const MAX_HIDDEN_UNITS: usize = 64;

/// `[policy]`: the leaders' network, `inputs, hidden…, outputs`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Policy {
    pub hidden: Vec<usize>,
}

impl Policy {
    pub(crate) fn read(r: &mut Reader<'_>) -> Policy {
        Policy {
            hidden: r
                .key(
                    "policy.hidden",
                    "units of a layer",
                    "hidden layers of a policy, between 8 inputs and 2 outputs",
                    "2.4, 3.1",
                )
                .numbers(0..=MAX_HIDDEN_LAYERS, between(1, MAX_HIDDEN_UNITS), vec![10]),
        }
    }

    /// Weights of one policy, biases included.
    pub fn parameters(&self) -> usize {
        let widths = [&[INPUTS], &self.hidden[..], &[OUTPUTS]].concat();
        widths.windows(2).map(|w| (w[0] + 1) * w[1]).sum()
    }
}

shared! {
    /// The sizes of a policy.
    pub struct PolicyConstants as PolicyLanes {
        /// Weight layers, and the widths `inputs, hidden…, outputs` (unused entries 0).
        pub layers: u32,
        pub widths: [u32; MAX_HIDDEN_LAYERS + 2],
        /// Weights.
        pub parameters: u32,
    }
}

impl PolicyConstants {
    pub fn new(policy: &Policy) -> PolicyConstants {
        let mut widths = [0; MAX_HIDDEN_LAYERS + 2];
        let layers = policy.hidden.len() + 1;
        widths[0] = INPUTS as u32;
        for (width, &units) in widths[1..].iter_mut().zip(&policy.hidden) {
            *width = units as u32;
        }
        widths[layers] = OUTPUTS as u32;
        PolicyConstants { layers: layers as u32, widths, parameters: policy.parameters() as u32 }
    }

    /// Units of the widest layer, inputs included.
    pub fn widest(&self) -> usize {
        self.widths.into_iter().max().unwrap_or(0) as usize
    }

    /// Words that a vector of teams takes of one leader: its weights, inputs, two layers and outputs.
    pub fn words(&self) -> usize {
        self.parameters as usize + INPUTS + 2 * self.widest() + OUTPUTS
    }

    /// Lane operations of one leader: a product and a sum a weight (the bias is where a sum starts), every unit's
    /// activation, and what is wanted of the outputs.
    pub fn operations(&self) -> u32 {
        let layers = self.widths[..=self.layers as usize].windows(2);
        layers.map(|widths| widths[1] * (2 * widths[0] + FLUSH + TANH)).sum::<u32>() + 1 + 3
    }
}

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
    math::limit_tanh::<S>(math::flush::<S>(sum, TINY))
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
    (output + 1.0) * 0.5 * world.motion.max_speed
}
