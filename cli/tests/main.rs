//! Tests of the program, and of the engine with parts of the program, as one program, because a link takes longer than
//! most tests.

#[path = "../../tests/support/adapters.rs"]
mod adapters;
mod commands;
#[path = "../../tests/support/mod.rs"]
mod helpers;
mod support {
    pub use crate::adapters::*;
    pub use crate::commands::*;
    pub use crate::helpers::*;
}

mod claims;
mod classes;
mod cli;
mod cluster;
mod compare;
mod digests;
mod evidence;
mod exactness;
mod faults;
mod first;
mod front;
mod import;
mod influence;
mod input;
mod json;
mod learning;
mod manners;
mod memory;
mod model;
mod nvidia;
mod ownership;
mod pages;
mod pictures;
mod population;
mod questions;
mod records;
mod recovery;
mod reference;
mod report;
mod rules;
mod searchers;
mod stages;
mod stories;
mod swarm;
mod sweep;
mod tasks;
mod train;

/// The root of the checkout.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");
