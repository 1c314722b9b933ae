//! flotilla trains cooperative teams by coevolution, in batches, on any GPU, with the same bits on a CPU.
//!
//! # In a few lines
//!
//! Train, with a callback a generation that may stop:
//!
//! ```
//! use std::ops::ControlFlow::{Break, Continue};
//! use flotilla::{Config, front::Processor};
//!
//! let mut config = Config::parse(include_str!("../configs/generally_forward.toml"), "generally_forward.toml")?;
//! (config.learning.trials, config.learning.generations) = (2, 10);
//! let ((mut backend, _), _) = flotilla::open(&Processor::Cpu)?;
//!
//! let trained = flotilla::train(&config, &mut *backend, |generation| {
//!     println!("{} of {}: {:?}", generation.generation, generation.last, generation.rows);
//!     if generation.rows.iter().all(|row| row.champion_g == 1.0) { Break(()) } else { Continue(()) }
//! })?;
//! println!("{:?}, digest {}", trained.champion_g, trained.digest());
//!
//! // Play policies from wherever they come, here what trial 0 learned, and see what each leader was worth.
//! use flotilla::evaluate::Starts;
//! let played = flotilla::play(&config, &mut *backend, config.learning.population, &trained.policies[0], &Starts::Own)?;
//! println!("the champion observes {} POIs; its leaders' D: {:?}", played.observed[0], &played.d[..4]);
//!
//! // Step teams by given actions, [teams][leaders][2] in -1..1, and see what leaders sense: [teams][leaders][8].
//! let mut stepper = flotilla::stepper(&config, 16, false)?;
//! let actions = vec![0.5; 16 * 4 * 2];
//! stepper.step(&actions)?;
//! println!("{:?}", &stepper.inputs()[..8]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`front`] has these and more; `examples/` has whole programs.
//!
//! # Follow one team from config to fitness
//!
//! ```text
//! config ─▶ world ─▶ trainer ──▶ backend.rollout(teams) ──▶ credit ──▶ evolve ─┐
//!                       ▲              │ sense ▸ policy ▸ follow ▸ motion ▸ couple
//!                       └──────────────┴────────────── next generation ◀───────┘
//! ```
//!
//! 1. [`config`] reads a TOML file and names everything that is wrong with it. The sections of a step's parts, and all
//!    else that is to be said of a part, stand in [`model`].
//! 2. [`world`] turns it into one experiment's constants and start state.
//! 3. [`trainer`] asks [`evolve`] for teams and hands all of them, of all trials, to a [`backend`] as one batch.
//! 4. The backend plays each team's whole episode: by [`model`] on the CPU, by its twins under `shaders/` on a GPU.
//!    It reports who was near which POI at which step, and which leader each follower saw, or as much of that as is
//!    needed.
//! 5. [`credit`] turns that record into G, D, Df, D++ and Dt.
//! 6. [`evolve`] selects and mutates, or has a GPU that holds the populations do the latter; [`run`] keeps what came out
//!    by [`record`]; [`report`] draws it.
//!
//! # Modules
//!
//! Each imports only those above it; a module without a feature is always there.
//!
//! | module | feature | holds |
//! |---|---|---|
//! | [`escape`], [`mod@file`], [`shell`] | | names, paths and command lines on their way in and out |
//! | [`host`], [`parallel`] | | time, waiting and threads, as whoever runs flotilla has them |
//! | [`declare`] | | what is declared once and has several forms: shared structs, choices of words |
//! | [`reader`] | | a TOML text, read key by key |
//! | [`kernels`] | | arithmetic on lanes of teams |
//! | [`model`] | | each part of a step: keys, constants, formulas, shader, costs |
//! | [`config`] | | the config: what an experiment is |
//! | [`world`] | | one experiment's constants and start state |
//! | [`evolve`] | | teams, selection and mutation, by counters |
//! | [`sample`] | | random worlds for tests |
//! | [`backend`] | | whole episodes of many teams: on the CPU, and with `gpu` on a GPU |
//! | [`credit`] | | G, D, Df, D++ and Dt |
//! | [`trainer`] | | the generation loop |
//! | [`verify`] | | whether two backends agree to the bit |
//! | [`statistics`] | | what chance leaves open |
//! | [`baseline`] | | what needs no learning |
//! | [`evaluate`] | | trained teams, from starts that no training saw |
//! | [`stepping`] | | teams stepped by given actions |
//! | [`memory`] | | what a run will take |
//! | [`record`] | `record` | files: policies, metrics, checkpoints, folders |
//! | [`run`] | `record` | a trainer and its runs' folders, kept together |
//! | [`report`] | `report` | pictures, films, pages; the paper's claims |
//! | [`sweep`] | `report` | many runs of a grid |
//! | [`front`] | | what programs need, in a few lines |
//! | [`mod@bench`] | `cli` | a backend's speed, and what the machine can do at most |
//! | [`cli`] | `cli` | what was typed, turned into all this |
//!
//! Only `backend::gpu` knows wgpu; the model knows neither threads nor GPUs; only [`host`] asks for the time.
//!
//! # Features
//!
//! | feature | brings | crates in all, about |
//! |---|---|---|
//! | (none) | training, evaluation and verification by the CPU, on one thread; on WebAssembly too | 30 |
//! | `scalar` | episodes without vector instructions, too, for `verify --report` | 30 |
//! | `parallel` | all threads, by rayon; the bits stay | 35 |
//! | `gpu` | any GPU, by wgpu | 80 |
//! | `record` | runs on disk | 55 |
//! | `report` | `record`, and pictures | 75 |
//! | `cli` (default) | the program, with all of these | 145 |

#![deny(missing_docs)]

/// The commit that this was built from, where that is known; a debug build does not know it.
pub const COMMIT: Option<&str> = {
    let commit = env!("FLOTILLA_COMMIT");
    if commit.is_empty() { None } else { Some(commit) }
};

/// The version of this crate, as `run.json` has it.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

pub mod backend;
pub mod baseline;
#[cfg(feature = "cli")]
pub mod bench;
#[cfg(feature = "cli")]
pub mod cli;
pub mod config;
pub mod credit;
pub mod declare;
pub mod escape;
pub mod evaluate;
pub mod evolve;
pub mod file;
pub mod front;
pub mod host;
pub mod kernels;
pub mod memory;
pub mod model;
pub mod parallel;
pub mod reader;
#[cfg(feature = "record")]
pub mod record;
#[cfg(feature = "report")]
pub mod report;
#[cfg(feature = "record")]
pub mod run;
pub mod sample;
pub mod shell;
pub mod statistics;
pub mod stepping;
#[cfg(feature = "report")]
pub mod sweep;
pub mod trainer;
pub mod verify;
pub mod world;

pub use config::Config;
#[cfg(feature = "gpu")]
pub use front::open;
pub use front::{play, stepper, trace, train};
