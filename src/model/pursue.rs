//! Pursuit: moving straight to an agent, the nearest of a class or the one that a policy chooses.

use fearless_simd::{Simd, prelude::*};

use super::TINY;
use super::classes::{AGENTS, AgentClass, Channel};
use super::follow::SteeringForce;
use super::motion::MotionLanes;
use super::policy::OUTPUTS;
use super::sense::squared_range;
use crate::gpu_struct::gpu_struct;
use crate::kernels::math::{flush, rsqrt};
use crate::kernels::{clamp_to, select, smaller, splat};

/// The shader of this part.
pub(crate) const WGSL: &str = include_str!("../../shaders/pursue.wgsl");

gpu_struct! {
    /// Constants of a class whose agents move to others, or only near others.
    pub struct PursuitConstants as PursuitLanes {
        /// The squared distance up to which its agents move to the nearest of a class.
        pub reach2: f32,
        /// The squared distance within which an agent of another class has to be, so that they move.
        pub near2: f32,
        /// 1 over the distance of a step at the maximum speed; 0 if they cannot move.
        pub inverse_step: f32,
        /// The difference of the actions that choose neighbouring agents.
        pub choice_step: f32,
        /// Half the number of agents to choose among.
        pub half_choices: f32,
    }
}

impl PursuitConstants {
    /// Computes the constants of a class that chooses among so many agents, for steps of `dt` seconds.
    pub(crate) fn new(class: &AgentClass, choices: usize, dt: f64) -> PursuitConstants {
        let step = class.motion.max_speed() * dt;
        let sensed = class.moves_near.as_ref().map(|near| class.sense_range(near));
        PursuitConstants {
            reach2: squared_range(class.reach.unwrap_or(f64::INFINITY)),
            near2: squared_range(sensed.unwrap_or(0.0)),
            inverse_step: if step == 0.0 { 0.0 } else { (1.0 / step) as f32 },
            choice_step: choice_step(choices),
            half_choices: choices as f32 * 0.5,
        }
    }
}

impl AgentClass {
    /// Returns the largest distance up to which it senses agents of a class.
    pub(crate) fn sense_range(&self, of: &str) -> f64 {
        self.senses.iter().filter(|channel| channel.senses(of)).map(|channel| channel.range).fold(0.0, f64::max)
    }
}

impl Channel {
    /// Reports whether it senses agents of a class.
    pub(crate) fn senses(&self, class: &str) -> bool {
        self.of.iter().any(|of| of == class || of == AGENTS)
    }
}

/// Returns the difference of the actions that choose neighbouring ones of so many agents.
pub(crate) fn choice_step(choices: usize) -> f32 {
    if choices == 0 { 0.0 } else { (2.0 / choices as f64) as f32 }
}

/// Returns the actions of a policy that chooses an agent. It wants each of them, and at last nobody, by so much. The first
/// action is the first of the most wanted: from -1, the first agent, to 1, nobody, in equal steps. The other is 0.
#[inline(always)]
pub(crate) fn choose<S: Simd>(wanted: &[S::f32s]) -> [S::f32s; OUTPUTS] {
    let simd = wanted[0].token();
    let (mut most, mut choice) = (wanted[0], splat(simd, 0.0));
    for (index, &wanted) in (1u8..).zip(&wanted[1..]) {
        let more = wanted.simd_gt(most);
        most = select::<S>(most, wanted, more);
        choice = select::<S>(choice, splat(simd, index.into()), more);
    }
    let action = choice * choice_step(wanted.len() - 1) - 1.0;
    [clamp_to::<S>(action, splat(simd, -1.0), splat(simd, 1.0)), splat(simd, 0.0)]
}

/// Returns the offset to the agent that an action chooses, of these agents and offsets: 0 for nobody.
#[inline(always)]
pub(crate) fn chosen<S: Simd>(
    pursuit: &PursuitLanes<S>,
    action: S::f32s,
    offsets: impl Iterator<Item = (usize, [S::f32s; 2])>,
) -> [S::f32s; 2] {
    let simd = action.token();
    let choice = ((action + 1.0) * pursuit.half_choices + 0.5).floor();
    let (mut to, mut index) = ([splat(simd, 0.0); 2], splat(simd, 0.0));
    for (_, [dx, dy]) in offsets {
        let is_it = choice.simd_eq(index);
        to = [select::<S>(to[0], dx, is_it), select::<S>(to[1], dy, is_it)];
        index += 1.0;
    }
    to
}

/// Returns the smallest of an agent's offsets to others within a squared distance, the first of equals, and the lanes in
/// which there is one. In the rest it is 0.
#[inline(always)]
pub(crate) fn nearest<S: Simd>(
    agent: usize,
    reach2: S::f32s,
    offsets: impl Iterator<Item = (usize, [S::f32s; 2])>,
) -> ([S::f32s; 2], S::mask32s) {
    let simd = reach2.token();
    let (mut to, mut least, mut found) = ([splat(simd, 0.0); 2], splat(simd, f32::MAX), S::mask32s::splat(simd, false));
    for (other, [dx, dy]) in offsets {
        if other == agent {
            continue;
        }
        let d2 = dx * dx + dy * dy;
        let nearer = d2.simd_le(reach2) & d2.simd_lt(least);
        to = [select::<S>(to[0], dx, nearer), select::<S>(to[1], dy, nearer)];
        least = select::<S>(least, d2, nearer);
        found |= nearer;
    }
    (to, found)
}

/// Returns the force that moves an agent by an offset: straight, at most at the maximum speed, and not beyond. Without an
/// offset, the agent stops.
#[inline(always)]
pub(crate) fn towards<S: Simd>(
    pursuit: &PursuitLanes<S>,
    motion: &MotionLanes<S>,
    [dx, dy]: [S::f32s; 2],
) -> SteeringForce<S> {
    let scale = smaller::<S>(rsqrt::<S>(dx * dx + dy * dy), pursuit.inverse_step);
    SteeringForce {
        x: flush::<S>(dx * scale, TINY) * motion.max_speed,
        y: flush::<S>(dy * scale, TINY) * motion.max_speed,
        influenced: S::mask32s::splat(dx.token(), true),
    }
}
