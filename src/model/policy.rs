//! A leader's policy: a fully connected network with biases and tanh in every layer (paper, Sections 2.4 and 3.1). Its
//! outputs are actions, or choose among behaviours.

use fearless_simd::{Simd, prelude::*};

use super::{TINY, motion::MotionLanes};
use crate::config_enum::config_enum;
use crate::gpu_struct::gpu_struct;
use crate::kernels::{math, select, splat};
use crate::reader::{Reader, between, section};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/policy.wgsl");

/// Actions of a leader: a wanted turn and a wanted speed.
pub const OUTPUTS: usize = 2;
/// Behaviours to choose among: hold, towards or away from POIs, towards or away from agents.
pub(crate) const BEHAVIOURS: usize = 5;
/// Maximum number of hidden layers.
pub const MAX_HIDDEN_LAYERS: usize = 3;
/// Maximum units per hidden layer.
pub const MAX_HIDDEN_UNITS: usize = 64;

section! {
    /// `[policy]`: the leaders' network, `inputs, hidden…, outputs`.
    #[derive(Eq)]
    Policy = "policy" {
        /// hidden layers of a policy, between its inputs and 2 outputs, or 5 that choose a behaviour
        hidden: Vec<usize> = "units of a layer", "2.4, 3.1",
        /// what the outputs are: a wanted turn and speed, or how much each of 5 behaviours is wanted: hold, towards or
        /// away from most POIs, towards or away from most agents
        actions: Actions = "", "1, 2.4",
    }
}

config_enum! {
    /// The meaning of a policy's outputs.
    Actions {
        /// The wanted change of heading and the wanted speed.
        Direct = "direct",
        /// A weight per behaviour. The leader does the one with the largest weight; ties go to the first.
        Behaviours = "behaviours",
    }
}

impl Actions {
    /// Returns the number of outputs of the network.
    pub const fn outputs(self) -> usize {
        match self {
            Actions::Direct => OUTPUTS,
            Actions::Behaviours => BEHAVIOURS,
        }
    }
}

impl Policy {
    /// Reads the section.
    pub(crate) fn read(r: &mut Reader<'_>) -> Policy {
        Policy {
            hidden: Policy::hidden(r).numbers(0..=MAX_HIDDEN_LAYERS, between(1, MAX_HIDDEN_UNITS), vec![10]),
            actions: Policy::actions(r).choice(Actions::Direct),
        }
    }
}

/// Returns the weights of one policy with layers of these widths, biases included.
pub fn parameters(widths: &[usize]) -> usize {
    widths.windows(2).map(|w| (w[0] + 1) * w[1]).sum()
}

gpu_struct! {
    /// The sizes of a policy.
    pub struct PolicyConstants as PolicyLanes {
        /// Layers of weights.
        pub layers: u32,
        /// `inputs, hidden…, outputs`, padded with 0.
        pub widths: [u32; MAX_HIDDEN_LAYERS + 2],
        /// Weights, biases included.
        pub parameters: u32,
        /// The [`Actions`] of policies that choose no agent, by their number.
        pub actions: u32,
    }
}

impl PolicyConstants {
    /// Computes the sizes of layers of these widths, from inputs to outputs.
    ///
    /// # Panics
    /// There are too many layers.
    pub fn new(layers: &[usize], actions: Actions) -> PolicyConstants {
        let mut widths = [0; MAX_HIDDEN_LAYERS + 2];
        for (width, &units) in widths[..layers.len()].iter_mut().zip(layers) {
            *width = units as u32;
        }
        PolicyConstants {
            layers: layers.len() as u32 - 1,
            widths,
            parameters: parameters(layers) as u32,
            actions: actions as u32,
        }
    }

    /// Returns what the outputs of policies that choose no agent are.
    pub fn actions(&self) -> Actions {
        Actions::of(self.actions)
    }

    /// Returns the widest layer, inputs included.
    pub(crate) fn widest(&self) -> usize {
        self.widths.into_iter().max().unwrap_or(0) as usize
    }

    /// Returns the words per leader in a vector of teams: weights, inputs, two layers and outputs.
    pub fn words(&self) -> usize {
        self.parameters as usize + self.inputs() + 2 * self.widest() + OUTPUTS
    }

    /// Returns the number of inputs.
    pub fn inputs(&self) -> usize {
        self.widths[0] as usize
    }
}

/// Computes some units before tanh: the bias, plus the weighted inputs in order.
///
/// `weights` has one row of `UNITS` per input, then the biases. Inputs at the end that are 0 may be left out.
#[inline(always)]
pub(crate) fn affine<S: Simd, const UNITS: usize>(inputs: &[S::f32s], weights: &[S::f32s]) -> [S::f32s; UNITS] {
    let (rows, _) = weights.as_chunks::<UNITS>();
    let mut sums = rows[rows.len() - 1];
    for (&input, row) in inputs.iter().zip(rows) {
        for (sum, &weight) in sums.iter_mut().zip(row) {
            *sum += input * weight;
        }
    }
    sums
}

/// Clamps a sum to the range of tanh. Small sums are flushed to 0, so that the next layer has no denormals.
#[inline(always)]
pub(crate) fn clamp_preactivation<S: Simd>(sum: S::f32s) -> S::f32s {
    math::limit_tanh::<S>(math::flush::<S>(sum, TINY))
}

/// Returns the actions of the most wanted behaviour: the first of the largest `wanted`, each in -1..1.
///
/// Behaviours: hold; towards or away from the quadrant with the highest density of POIs; towards or away from the one
/// of agents. The first inputs are the densities of POIs by quadrant, then those of agents. Ties go to the first quadrant.
/// If nothing is sensed, the leader goes straight ahead.
#[inline(always)]
pub fn choose<S: Simd>(inputs: &[S::f32s], wanted: &[S::f32s; BEHAVIOURS]) -> [S::f32s; OUTPUTS] {
    let simd = wanted[0].token();
    let number = |number: f32| splat(simd, number);
    let (mut most, mut behaviour) = (wanted[0], number(0.0));
    for (index, &wanted) in (1u8..).zip(&wanted[1..]) {
        let more = wanted.simd_gt(most);
        most = select::<S>(most, wanted, more);
        behaviour = select::<S>(behaviour, number(index.into()), more);
    }
    let away = behaviour.simd_eq(2.0) | behaviour.simd_eq(4.0);
    let (pois, agents) = (turn_to_most::<S>(&inputs[..4], away), turn_to_most::<S>(&inputs[4..8], away));
    let turn = select::<S>(agents, pois, behaviour.simd_lt(3.0));
    let moves = behaviour.simd_gt(0.0);
    [select::<S>(number(0.0), turn, moves), select::<S>(number(-1.0), number(1.0), moves)]
}

/// Returns the output that turns a leader to the middle of the quadrant with the most, or away from it, or 0 if there is
/// nothing in any.
#[inline(always)]
fn turn_to_most<S: Simd>(quadrants: &[S::f32s], away: S::mask32s) -> S::f32s {
    let number = |number: f32| splat(away.token(), number);
    let (mut most, mut turn) = (quadrants[0], number(-0.75));
    for (middle, &quadrant) in [-0.25, 0.25, 0.75].into_iter().zip(&quadrants[1..]) {
        let more = quadrant.simd_gt(most);
        most = select::<S>(most, quadrant, more);
        turn = select::<S>(turn, number(middle), more);
    }
    let back = turn + select::<S>(number(-1.0), number(1.0), turn.simd_lt(0.0));
    select::<S>(number(0.0), select::<S>(turn, back, away), most.simd_gt(0.0))
}

/// Converts the first output, in -1..1, to a wanted turn in radians to the left.
#[inline(always)]
pub(crate) fn wanted_turn<S: Simd>(output: S::f32s) -> S::f32s {
    output * std::f32::consts::PI
}

/// Converts the second output, in -1..1, to a wanted speed.
#[inline(always)]
pub(crate) fn wanted_speed<S: Simd>(motion: &MotionLanes<S>, output: S::f32s) -> S::f32s {
    (output + 1.0) * 0.5 * motion.max_speed
}
