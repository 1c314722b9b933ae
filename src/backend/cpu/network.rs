//! The leaders' policies of one vector of teams.

use fearless_simd::{Simd, prelude::*};

use super::transpose::transpose_rows;
use crate::kernels::{math, splat};
use crate::model::policy::{Actions, PolicyConstants};
use crate::model::{policy, pursue};
use crate::world::OUTPUTS;

/// The leaders' policies of one vector of teams.
pub(super) struct Network<S: Simd> {
    simd: S,
    /// The number of agents among which each leader chooses, `[leaders]`: 0 unless it chooses agents.
    choices: Vec<usize>,
    /// The number of inputs that each leader has, `[leaders]`. The rest are 0.
    used: Vec<usize>,
    constants: PolicyConstants,
    /// `[leaders][parameters]`, layer by layer. Units that are computed together (see [`together`]) form a block: one
    /// row per input, then the biases.
    weights: Vec<S::f32s>,
    /// The index in `weights` of each weight of a policy.
    slots: Vec<usize>,
    /// The units of a layer and of the next, `[leaders][units]`.
    hidden: [Vec<S::f32s>; 2],
}

impl<S: Simd> Network<S> {
    pub(super) fn new(simd: S, policy: &PolicyConstants, choices: Vec<usize>, used: Vec<usize>) -> Network<S> {
        let leaders = choices.len();
        let (zero, widest, parameters) = (splat(simd, 0.0), policy.widest(), policy.parameters as usize);
        let mut slots = vec![0; parameters];
        let (mut first, mut slot) = (0, 0);
        for widths in policy.widths[..=policy.layers as usize].windows(2) {
            let (rows, columns) = (widths[0] as usize + 1, widths[1] as usize);
            let mut column = 0;
            while column < columns {
                let block = together(columns - column);
                for (row, unit) in (0..rows).flat_map(|row| (0..block).map(move |unit| (row, unit))) {
                    slots[first + row * columns + column + unit] = slot;
                    slot += 1;
                }
                column += block;
            }
            first += rows * columns;
        }
        Network {
            simd,
            choices,
            used,
            constants: *policy,
            weights: vec![zero; leaders * parameters],
            slots,
            hidden: [vec![zero; leaders * widest], vec![zero; leaders * widest]],
        }
    }

    /// Loads the policy of each leader and lane.
    #[inline(always)]
    pub(super) fn load_policies<'a>(&mut self, policy: impl Fn(usize, usize) -> &'a [f32]) {
        let Network { simd, weights, slots, .. } = self;
        for (leader, weights) in weights.chunks_exact_mut(slots.len()).enumerate() {
            // Four lanes at a time, the width of the narrowest vector.
            for lane in (0..S::f32s::LEN).step_by(4) {
                transpose_rows(
                    *simd,
                    [
                        policy(leader, lane),
                        policy(leader, lane + 1),
                        policy(leader, lane + 2),
                        policy(leader, lane + 3),
                    ],
                    #[inline(always)]
                    |parameter, lanes| {
                        weights[slots[parameter]].as_mut_slice()[lane..lane + 4].copy_from_slice(lanes);
                    },
                );
            }
        }
    }

    /// Computes the leaders' outputs.
    pub(super) fn decide(&mut self, inputs: &[S::f32s], outputs: &mut [[S::f32s; OUTPUTS]]) {
        self.simd.vectorize(
            #[inline(always)]
            || self.answer(inputs, outputs),
        );
    }

    #[inline(always)]
    fn answer(&mut self, inputs: &[S::f32s], outputs: &mut [[S::f32s; OUTPUTS]]) {
        let Network { weights, hidden, choices, used, constants, .. } = self;
        let (leaders, &mut PolicyConstants { layers, widths, parameters, .. }) = (choices.len(), &mut *constants);
        let mut first = 0;
        let [mut to, mut from] = hidden.each_mut().map(|units| &mut units[..]);
        for (layer, widths) in widths[..=layers as usize].windows(2).enumerate() {
            let [rows, columns] = [widths[0] as usize, widths[1] as usize];
            let inputs = if layer == 0 { inputs } else { &*from };
            let units = &mut to[..leaders * columns];
            let weights = (0..leaders).map(|leader| &weights[leader * parameters as usize + first..]);
            match (rows, columns) {
                // The paper's network, with constant sizes.
                (8, 10) => affine_layer::<S, 8, 10>(inputs, units, weights),
                (10, OUTPUTS) => affine_layer::<S, 10, OUTPUTS>(inputs, units, weights),
                _ => {
                    let leaders = inputs.chunks_exact(rows).zip(units.chunks_exact_mut(columns));
                    for (((inputs, units), weights), &used) in leaders.zip(weights).zip(&*used) {
                        affine::<S>(inputs, if layer == 0 { used } else { rows }, units, weights);
                    }
                }
            }
            // All leaders' tanh together, in short loops: out-of-order execution overlaps iterations only if they are
            // short.
            let (eights, rest) = units.as_chunks_mut::<8>();
            for units in eights {
                let mut halves = [(units[0], units[0]); 8];
                for (half, &unit) in halves.iter_mut().zip(&*units) {
                    *half = math::half_tanh::<S>(policy::clamp_preactivation::<S>(unit));
                }
                for (unit, &half) in units.iter_mut().zip(&halves) {
                    *unit = math::whole_tanh::<S>(half);
                }
            }
            for unit in rest {
                *unit = math::whole_tanh::<S>(math::half_tanh::<S>(policy::clamp_preactivation::<S>(*unit)));
            }
            first += (rows + 1) * columns;
            std::mem::swap(&mut from, &mut to);
        }
        let (actions, width) = (constants.actions(), widths[layers as usize] as usize);
        if width == OUTPUTS && choices.iter().all(|&choices| choices == 0) {
            return outputs.copy_from_slice(&from.as_chunks::<OUTPUTS>().0[..leaders]);
        }
        let answers = outputs.iter_mut().zip(inputs.chunks_exact(widths[0] as usize)).zip(from.chunks_exact(width));
        for (((answer, inputs), units), &choices) in answers.zip(&*choices) {
            *answer = match (choices, actions) {
                (1.., _) => pursue::choose::<S>(&units[..=choices]),
                (0, Actions::Direct) => [units[0], units[1]],
                (0, Actions::Behaviours) => {
                    policy::choose::<S>(inputs, units.first_chunk().expect("there is an output per behaviour"))
                }
            };
        }
    }
}

/// Returns how many of the `left` units of a layer are computed together, so that their inputs are loaded once.
#[inline(always)]
fn together(left: usize) -> usize {
    match left {
        10 => 10,
        4.. => 4,
        2 | 3 => 2,
        _ => 1,
    }
}

/// Computes every leader's units of one layer, before tanh.
#[inline(always)]
fn affine_layer<'a, S: Simd, const INPUTS: usize, const UNITS: usize>(
    inputs: &[S::f32s],
    units: &mut [S::f32s],
    weights: impl Iterator<Item = &'a [S::f32s]>,
) {
    let leaders = inputs.as_chunks::<INPUTS>().0.iter().zip(units.as_chunks_mut::<UNITS>().0);
    for ((inputs, units), weights) in leaders.zip(weights) {
        *units = policy::affine::<S, UNITS>(inputs, &weights[..(INPUTS + 1) * UNITS]);
    }
}

/// Computes one leader's units of one layer from the first `used` inputs, before tanh.
#[inline(always)]
fn affine<S: Simd>(inputs: &[S::f32s], used: usize, mut units: &mut [S::f32s], mut weights: &[S::f32s]) {
    while !units.is_empty() {
        let count = together(units.len());
        let (these, weights_of_these);
        (these, units) = units.split_at_mut(count);
        (weights_of_these, weights) = weights.split_at((inputs.len() + 1) * count);
        let inputs = &inputs[..used];
        match count {
            10 => these.copy_from_slice(&policy::affine::<S, 10>(inputs, weights_of_these)),
            4 => these.copy_from_slice(&policy::affine::<S, 4>(inputs, weights_of_these)),
            2 => these.copy_from_slice(&policy::affine::<S, 2>(inputs, weights_of_these)),
            _ => these.copy_from_slice(&policy::affine::<S, 1>(inputs, weights_of_these)),
        }
    }
}
