//! The studies that come with flotilla: programs on the public interface of the engine and of [`flotilla_app`].
//!
//! Each module imports only modules above it.
//!
//! | module | contents |
//! |---|---|
//! | [`paper`] | the paper's experiments, figures and claims |
//! | [`questions`] | the open questions of the paper, as sweeps |
//! | [`tasks`] | a suite of tasks, and which of them no baseline solves |
//! | [`populations`] | followers against the number of populations |
//! | [`influence`] | credits for rovers and UAVs |

#![allow(rustdoc::private_intra_doc_links, reason = "tables of modules name the internal ones, too")]

pub mod influence;
pub mod paper;
pub mod populations;
pub mod questions;
pub mod tasks;
