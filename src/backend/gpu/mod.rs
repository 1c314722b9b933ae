//! The GPU backend, on any adapter that wgpu reaches.
//!
//! Each module imports only those above it. The first five need no device:
//!
//! | module | holds |
//! |---|---|
//! | [`exact`] | what makes the shaders' arithmetic bit-identical to the CPU's |
//! | [`mod@faults`] | faults that tests inject |
//! | [`shape`] | the kernels of episodes: what each is compiled for, and how teams fill its workgroups |
//! | [`source`] | pipelines: the texts of their shaders, and the structs that these share with the host |
//! | [`recording`] | GPU work as data |
//! | [`device`] | adapters, and the executor of recordings |
//! | [`population`] | policies that stay on the device |
//! | [`episode`] | whole episodes: their plan, and the backend |
//! | [`mod@self_test`] | opening a device, and the tests that it must pass |

pub mod device;
pub mod episode;
pub mod exact;
#[doc(hidden)]
pub mod faults;
pub mod population;
pub mod recording;
pub mod self_test;
pub(crate) mod shape;
pub mod source;

pub use self_test::{open, self_test};
pub use source::shaders;
