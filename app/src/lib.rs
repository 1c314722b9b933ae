//! Runs on disk, sweeps, pictures and use cases, which the command, the Python package, the page and the studies share,
//! on top of the engine ([`flotilla`]).
//!
//! Each module imports only modules above it. Errors are described by their types; a section on errors says what these do
//! not.
//!
//! | module | contents |
//! |---|---|
//! | [`shell`] | command lines for people to copy |
//! | [`script`] | teams whose leaders drive to given places |
//! | [`record`] | files: policies, metrics, checkpoints, folders |
//! | [`import`] | configs of the authors' programs |
//! | [`run`] | a trainer together with its runs' folders |
//! | [`report`] | pictures, films and pages |
//! | [`sweep`] | many runs of a parameter grid |
//! | [`choice`] | the processor that is expected to finish first |
//! | [`ops`] | the use cases of the program, and their errors |

#![allow(rustdoc::private_intra_doc_links, reason = "tables of modules name the internal ones, too")]

pub mod choice;
pub mod import;
pub mod ops;
pub mod record;
pub mod report;
pub mod run;
pub mod script;
#[doc(hidden)]
pub mod shell;
pub mod sweep;
