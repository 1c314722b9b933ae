//! flotilla trains cooperative teams by coevolution, in batches, on any GPU, with the same bits on a CPU.
//!
//! # Follow one team from config to fitness
//!
//! ```text
//! config ─▶ world ─▶ trainer ──▶ backend.rollout(teams) ──▶ credit ──▶ evolve ─┐
//!                       ▲              │ sense ▸ policy ▸ influence ▸ follow ▸ move ▸ couple
//!                       └──────────────┴────────────── next generation ◀───────┘
//! ```
//!
//! 1. [`config`] reads a TOML file and names everything that is wrong with it.
//! 2. [`world`] turns it into one experiment's constants and start state.
//! 3. [`trainer`] asks [`evolve`] for teams and hands all of them, of all trials, to a [`backend`] as one batch.
//! 4. The backend plays each team's whole episode: by [`kernels`] on the CPU, by their twins under `shaders/` on a GPU.
//!    It reports who was near which POI at which step, and which leader each follower saw, or as much of that as is needed.
//! 5. [`credit`] turns that record into G, D, Df and D++.
//! 6. [`evolve`] selects and mutates, or has a GPU that holds the populations do the latter; [`run`] keeps what came out
//!    by [`record`]; [`report`] draws it.
//!
//! Around that: [`run`] keeps a trainer and its runs' folders and checkpoints together, [`sweep`] makes many runs of a grid,
//! [`evaluate`] plays trained teams from starts that no training saw, [`baseline`] plays what needs no learning,
//! [`statistics`] says what chance leaves open, [`memory`] tells what a run will take, [`verify`] compares two backends on
//! the random worlds of [`sample`], [`mod@bench`] times a backend against what the machine can do at most, and [`cli`]
//! turns what was typed into all this.
//!
//! Imports run one way: `main ▸ cli ▸ {run, sweep, report, evaluate, verify, bench} ▸ trainer ▸ {evolve, credit,
//! backend}`, `backend ▸ {evolve, kernels}`. Only `backend::gpu` knows wgpu; the kernels know neither threads nor GPUs.

/// The commit that this was built from, where that is known; a debug build does not know it.
pub const COMMIT: Option<&str> = {
    let commit = env!("FLOTILLA_COMMIT");
    if commit.is_empty() { None } else { Some(commit) }
};

pub mod backend;
pub mod baseline;
pub mod bench;
pub mod cli;
pub mod config;
pub mod credit;
pub mod escape;
pub mod evaluate;
pub mod evolve;
pub mod file;
pub mod kernels;
pub mod memory;
pub mod record;
pub mod report;
pub mod run;
pub mod sample;
pub mod shell;
pub mod statistics;
pub mod sweep;
pub mod trainer;
pub mod verify;
pub mod world;
