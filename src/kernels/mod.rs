//! One agent's step, as pure functions over lanes of teams: the twins of `shaders/*.wgsl`, same names, same order.
//!
//! Every function is generic over the processor's lane type, `S::f32s`, one team a lane. Only `+ - *`, comparison,
//! select, abs, floor and integer operations are used, each correctly rounded everywhere, so lane width, processor
//! and GPU cannot show in the bits.

use fearless_simd::{Select, Simd, prelude::*};

use crate::world::Constants;

pub mod couple;
pub mod follow;
pub mod math;
pub mod motion;
pub mod policy;
pub mod sense;

/// `if_true` in the lanes where `condition` holds, `if_false` elsewhere, in WGSL's order of arguments.
#[inline(always)]
pub fn select<S: Simd>(if_false: S::f32s, if_true: S::f32s, condition: S::mask32s) -> S::f32s {
    condition.select(if_true, if_false)
}

/// `select(0.0, x, condition)` in one operation: masks of whole lanes are spared the test of their sign.
#[inline(always)]
pub fn only<S: Simd>(x: S::f32s, condition: S::mask32s) -> S::f32s {
    let bits: S::i32s = x.bitcast();
    (bits & condition.to_vector()).bitcast()
}

/// `select(x, 0.0, condition)`, likewise.
#[inline(always)]
pub fn except<S: Simd>(x: S::f32s, condition: S::mask32s) -> S::f32s {
    let bits: S::i32s = x.bitcast();
    (bits & !condition.to_vector()).bitcast()
}

/// The same number in every lane.
#[inline(always)]
pub fn splat<S: Simd>(simd: S, value: f32) -> S::f32s {
    S::f32s::simd_from(simd, value)
}

/// `x` moved into `low..=high`: for numbers this is the shader's pair of selects, in half the operations. Where `x` and a
/// bound are zeros of different signs, either may come out.
#[inline(always)]
pub fn bound<S: Simd>(x: S::f32s, low: S::f32s, high: S::f32s) -> S::f32s {
    x.max(low).min(high)
}

macro_rules! lanes {
    ($($field:ident)*) => {
        /// The world's constants, each in every lane: the operation that needs one takes it from memory.
        #[derive(Clone, Copy)]
        pub struct Lanes<S: Simd> {
            pub constants: Constants,
            $(pub $field: S::f32s,)*
        }

        impl<S: Simd> Lanes<S> {
            pub fn new(simd: S, constants: Constants) -> Lanes<S> {
                Lanes { constants, $($field: splat(simd, constants.$field),)* }
            }
        }
    };
}

lanes! {
    map_x map_y dt min_speed max_speed max_speed_change max_turn max_turn_cos max_turn_sin observation_radius2
    attraction_radius2 repulsion_radius2 poi_range2 agent_range2 repulsion_radius attraction_scale repulsion_scale wall_gain
    poi_share agent_share inverse_diagonal
}
