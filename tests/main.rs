//! Tests of the engine, as one program, because a link takes longer than most tests.

#[cfg(feature = "gpu")]
#[path = "support/adapters.rs"]
mod adapters;
mod classes;
mod config;
mod credit;
mod evolve;
mod fit;
mod golden;
#[path = "support/mod.rs"]
mod helpers;
mod influence;
mod math;
#[cfg(feature = "gpu")]
mod parity;
mod stepping;
mod strategy;
mod support {
    #[cfg(feature = "gpu")]
    pub use crate::adapters::*;
    pub use crate::helpers::*;
}
mod structure;
mod swarm;
// Release builds have no faults to inject.
#[cfg(all(debug_assertions, feature = "gpu"))]
mod watchdog;

/// The root of the checkout.
const ROOT: &str = env!("CARGO_MANIFEST_DIR");
