//! The answers of policies to given inputs, with the arithmetic of episodes.

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use super::network::Network;
use super::transpose::transpose_rows;
use crate::kernels::splat;
use crate::model::policy::PolicyConstants;
use crate::parallel::*;
use crate::world::OUTPUTS;

/// Computes the outputs of policies for given inputs, with the bits of an episode.
///
/// `weights` are `[policies][parameters]`, each 0 or of size 2^-30 to 2^20. `inputs` are `[rows][inputs]`. Row `i` is answered
/// by policy `of(i)`. If policies choose agents, it is among `choices` agents; otherwise this is 0. Writes `outputs`,
/// `[rows][2]`.
///
/// # Panics
/// An array has the wrong length, or a policy does not exist.
pub fn forward(
    policy: &PolicyConstants,
    weights: &[f32],
    inputs: &[f32],
    of: &(impl Fn(usize) -> usize + Sync),
    choices: usize,
    outputs: &mut [f32],
) {
    assert_eq!(inputs.len() / policy.inputs(), outputs.len() / OUTPUTS);
    dispatch!(Level::new(), simd => forward_rows(simd, policy, weights, inputs, of, choices, outputs));
}

/// Rows per task.
const ROWS_PER_TASK: usize = 1024;

fn forward_rows<S: Simd>(
    simd: S,
    policy: &PolicyConstants,
    weights: &[f32],
    inputs: &[f32],
    of: &(impl Fn(usize) -> usize + Sync),
    choices: usize,
    outputs: &mut [f32],
) {
    outputs.par_chunks_mut(ROWS_PER_TASK * OUTPUTS).enumerate().for_each(|(part, outputs)| {
        let (width, size, parameters) = (S::f32s::LEN, policy.inputs(), policy.parameters as usize);
        let mut network = Network::new(simd, policy, vec![choices], vec![size]);
        let (mut loaded, mut sensed) = (None, vec![splat(simd, 0.0); size]);
        let zero = splat(simd, 0.0);
        for (chunk, outputs) in outputs.chunks_mut(width * OUTPUTS).enumerate() {
            let (first, rows) = (part * ROWS_PER_TASK + chunk * width, outputs.len() / OUTPUTS);
            let row = |lane: usize| first + if lane < rows { lane } else { 0 };
            sensed.fill(zero);
            let mut answers = [[zero; OUTPUTS]];
            simd.vectorize(
                #[inline(always)]
                || {
                    for quad in (0..width).step_by(4) {
                        let rows = [0, 1, 2, 3].map(|lane| &inputs[row(quad + lane) * size..][..size]);
                        transpose_rows(
                            simd,
                            rows,
                            #[inline(always)]
                            |column, lanes| sensed[column].as_mut_slice()[quad..quad + 4].copy_from_slice(lanes),
                        );
                    }
                    let one = of(first);
                    let same = (0..width).all(|lane| of(row(lane)) == one);
                    if !(same && loaded == Some(one)) {
                        network.load_policies(|_, lane| &weights[of(row(lane)) * parameters..][..parameters]);
                    }
                    loaded = same.then_some(one);
                    network.decide(&sensed, &mut answers);
                },
            );
            for (lane, answer) in outputs.chunks_exact_mut(OUTPUTS).enumerate() {
                answer.iter_mut().zip(&answers[0]).for_each(|(to, answer)| *to = answer[lane]);
            }
        }
    });
}
