//! One agent's step, as pure functions over lanes of teams: the twins of `shaders/*.wgsl`, same names, same order.
//!
//! Every function is generic over the processor's lane type, `S::f32s`, one team a lane. Only `+ - *`, comparison,
//! select, abs, floor and integer operations are used, each correctly rounded everywhere, so lane width, processor
//! and GPU cannot show in the bits.

pub mod math;
