//! A leader's policy: a fully connected network with a bias and tanh in every layer (Sections 2.4 and 3.1), whose
//! outputs are what it does, or choose among known behaviours.

use fearless_simd::{Simd, prelude::*};

use super::{Lanes, sense::INPUTS};
use crate::declare::{config_enum, shared};
use crate::kernels::{
    math,
    operations::{FLUSH, TANH},
    select, splat,
};
use crate::reader::{Reader, between, section};

/// The shader's part.
pub const WGSL: &str = include_str!("../../shaders/policy.wgsl");

/// What a leader answers to its inputs: wanted change of heading and wanted speed.
pub const OUTPUTS: usize = 2;
/// Behaviours to choose among: hold, towards POIs, away from POIs, towards agents, away from agents.
pub const BEHAVIOURS: usize = 5;
/// Most hidden layers of a policy.
pub const MAX_HIDDEN_LAYERS: usize = 3;
/// Most units in one hidden layer.
pub const MAX_HIDDEN_UNITS: usize = 64;

section! {
    /// `[policy]`: the leaders' network, `inputs, hidden…, outputs`.
    #[derive(Eq)]
    Policy = "policy" {
        /// hidden layers of a policy, between 8 inputs and 2 outputs, or 5 that choose a behaviour
        hidden: Vec<usize> = "units of a layer", "2.4, 3.1",
        /// what the outputs are: a wanted turn and speed, or how much each of 5 behaviours is wanted: hold, towards or
        /// away from most POIs, towards or away from most agents
        actions: Actions = "", "1, 2.4",
    }
}

config_enum! {
    /// What a policy's outputs are.
    Actions {
        /// What the leader does: its wanted change of heading and its wanted speed.
        Direct = "direct",
        /// How much each behaviour is wanted: the leader does the most wanted one, ties to the first.
        Behaviours = "behaviours",
    }
}

impl Actions {
    /// Outputs of the network.
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

    /// The widths of all layers, inputs and outputs included.
    pub fn widths(&self) -> Vec<usize> {
        [&[INPUTS], &self.hidden[..], &[self.actions.outputs()]].concat()
    }

    /// Weights of one policy, biases included.
    pub fn parameters(&self) -> usize {
        self.widths().windows(2).map(|w| (w[0] + 1) * w[1]).sum()
    }
}

shared! {
    /// The sizes of a policy.
    pub struct PolicyConstants as PolicyLanes {
        /// Layers of weights.
        pub layers: u32,
        /// `inputs, hidden…, outputs`; unused entries are 0.
        pub widths: [u32; MAX_HIDDEN_LAYERS + 2],
        /// Weights, biases included.
        pub parameters: u32,
    }
}

impl PolicyConstants {
    /// Of a valid section.
    pub fn new(policy: &Policy) -> PolicyConstants {
        let mut widths = [0; MAX_HIDDEN_LAYERS + 2];
        for (width, units) in widths.iter_mut().zip(policy.widths()) {
            *width = units as u32;
        }
        PolicyConstants { layers: policy.hidden.len() as u32 + 1, widths, parameters: policy.parameters() as u32 }
    }

    /// What the last layer is; none where it is neither.
    pub fn actions(&self) -> Option<Actions> {
        let outputs = *self.widths.get(self.layers as usize)? as usize;
        [Actions::Direct, Actions::Behaviours].into_iter().find(|actions| actions.outputs() == outputs)
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
        let chosen = if self.actions() == Some(Actions::Behaviours) { CHOICE } else { 0 };
        layers.map(|widths| widths[1] * (2 * widths[0] + FLUSH + TANH)).sum::<u32>() + chosen + 1 + 3
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

/// Lane operations of a choice: 4 comparisons with 2 selections each; of both classes 3 such, the opposite quadrant (a
/// comparison, a selection, a sum) and whether there is any (2); and the class, the direction and the two answers.
const CHOICE: u32 = 4 * 3 + 2 * (3 * 3 + 3 + 2) + 8;

/// What the most wanted behaviour is as a direct answer: the first of the largest `wanted`, each in -1..1.
///
/// Behaviours: hold; towards and away from the quadrant of most POIs; towards and away from that of most agents, the
/// first where several are alike. Where nothing is sensed, straight ahead.
#[inline(always)]
pub fn choose<S: Simd>(inputs: &[S::f32s; INPUTS], wanted: &[S::f32s; BEHAVIOURS]) -> [S::f32s; OUTPUTS] {
    let simd = wanted[0].token();
    let number = |number: f32| splat(simd, number);
    let (mut most, mut behaviour) = (wanted[0], number(0.0));
    for (index, &wanted) in (1u8..).zip(&wanted[1..]) {
        let more = wanted.simd_gt(most);
        most = select::<S>(most, wanted, more);
        behaviour = select::<S>(behaviour, number(index.into()), more);
    }
    let [pois, agents] = [[0, 1, 2, 3], [4, 5, 6, 7]].map(
        #[inline(always)]
        |quadrants: [usize; 4]| {
            let (mut most, mut turn) = (inputs[quadrants[0]], number(-0.75));
            for (middle, quadrant) in [(-0.25, quadrants[1]), (0.25, quadrants[2]), (0.75, quadrants[3])] {
                let more = inputs[quadrant].simd_gt(most);
                most = select::<S>(most, inputs[quadrant], more);
                turn = select::<S>(turn, number(middle), more);
            }
            let back = turn + select::<S>(number(-1.0), number(1.0), turn.simd_lt(0.0));
            let away = behaviour.simd_eq(2.0) | behaviour.simd_eq(4.0);
            select::<S>(number(0.0), select::<S>(turn, back, away), most.simd_gt(0.0))
        },
    );
    let turn = select::<S>(agents, pois, behaviour.simd_lt(3.0));
    let moves = behaviour.simd_gt(0.0);
    [select::<S>(number(0.0), turn, moves), select::<S>(number(-1.0), number(1.0), moves)]
}

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
