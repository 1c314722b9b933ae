//! The GPU backend, on any adapter that wgpu reaches.
//!
//! Each module imports only those above it:
//!
//! | module | holds |
//! |---|---|
//! | [`exact`] | what makes the shaders' arithmetic bit-identical to the CPU's |
//! | [`mod@faults`] | faults that tests inject |
//! | [`device`] | adapters, and what is asked of an opened one |
//! | [`population`] | policies that stay on the device |
//! | [`episode`] | whole episodes |
//! | [`mod@self_test`] | opening a device, and the tests that it must pass |

pub mod device;
pub mod episode;
pub mod exact;
#[doc(hidden)]
pub mod faults;
pub mod population;
pub mod self_test;

pub use self_test::{open, self_test};

/// The shader that measures a device's arithmetic ceiling.
pub const CEILING: &str = include_str!("../../../shaders/ceiling.wgsl");

/// Returns the name and the text of every shader, for lints and exactness tests.
pub fn shaders() -> Vec<(&'static str, String)> {
    [vec![("probe", self_test::SHADER.into()), ("ceiling", CEILING.into())], episode::shaders(), population::shaders()]
        .concat()
}
