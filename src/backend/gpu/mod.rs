//! The GPU backend, on any adapter that wgpu reaches.
//!
//! [`device`] finds and opens adapters, [`exact`] makes the shaders' arithmetic bit-identical to the CPU's,
//! [`probe`] tests on the opened device that it is; [`episode`] plays, [`population`] keeps policies on the device.

pub mod device;
pub mod episode;
pub mod exact;
pub mod population;
pub mod probe;

/// The whole text of every shader, with a name for each: what the lints and the exactness tests walk over.
pub fn shaders() -> Vec<(&'static str, String)> {
    [
        vec![("probe", probe::SHADER.into()), ("ceiling", probe::CEILING.into())],
        episode::shaders(),
        population::shaders(),
    ]
    .concat()
}
