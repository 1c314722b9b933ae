//! flotilla trains cooperative teams by coevolution. Episodes play in batches on any GPU or on the CPU, and both give
//! the same bits.
//!
//! # Example
//!
//! Train with a callback that is called after every generation and may stop the training:
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
//! [`front`] has these functions and more. `examples/` has complete programs.
//!
//! # Follow one team from config to fitness
//!
//! ```text
//! config ─▶ world ─▶ trainer ──▶ backend.play(teams) ──▶ scores ──▶ evolve ─┐
//!                       ▲              │ sense ▸ policy ▸ follow ▸ motion ▸ couple ▸ credit
//!                       └──────────────┴──────────── next generation ◀──────┘
//! ```
//!
//! 1. [`config`] reads a TOML file and reports every problem in it. [`model`] has the config sections, constants and
//!    formulas of the parts of a step.
//! 2. [`world`] computes one experiment's constants and start state from its config.
//! 3. [`trainer`] draws team schedules with [`evolve`] and passes the teams of all trials to a [`backend`] as one
//!    batch.
//! 4. The backend plays each team's whole episode: with [`model`] on the CPU, with the equivalent shaders under
//!    `shaders/` on a GPU. It records who was at which POI at which step and which leader each follower saw, or as much
//!    of that as the fitness needs. Records do not leave the backend.
//! 5. [`credit`] computes G, D, Df, D++ and Dt from a record, on the CPU while other teams play. The backend returns
//!    these scores.
//! 6. [`evolve`] selects and mutates on the host, or plans this for a GPU that holds the populations. [`run`] saves the
//!    results with [`record`], and [`report`] draws them.
//!
//! # Where to change what
//!
//! | to | change |
//! |---|---|
//! | add a density | `model/sense.rs` and its shader `shaders/sense.wgsl`, `bench/operations.rs` |
//! | add a fitness | `config/learning.rs`, `credit/` (`mod.rs`, `replay.rs`; `record.rs` for what it needs, `fast.rs` for speed) |
//! | test a new word of a key | `tests/model.rs` or `tests/credit.rs`, a case in `tests/golden.rs`; for a fitness `KINDS` in `verify.rs` |
//! | show a fitness beside the others | `evaluate.rs`, `ops/rollout.rs`, `report/replay/page.rs`, `python/flotilla/_play.py`, `web/page/` |
//! | add a place that holds populations | a backend with `Backend::hold` and a `DevicePopulation`, such as `FakeDevice` in `tests/population.rs` |
//! | add a claim of the paper | `report/paper/claims/list.rs` |
//! | add an open question | `sweep/questions/list.rs`, `configs/questions/` |
//! | add a kind of value in configs | `reader/request.rs`, `reader/allowed.rs` |
//! | change where a run resumes | `record/folder/resume.rs`, `record/checkpoint.rs` |
//!
//! # Modules
//!
//! Each module imports only modules above it. Modules without a feature are always compiled.
//!
//! | module | feature | contents |
//! |---|---|---|
//! | [`version`] | | the version and commit of this build |
//! | [`escape`], [`mod@file`], [`shell`] | | reading and writing of names, files and command lines |
//! | [`host`], [`parallel`] | | time, waiting, threads and the cache |
//! | [`config_enum`], [`gpu_struct`] | | enums that configs write as words, structs shared with shaders |
//! | [`reader`] | | reading a TOML text key by key |
//! | [`kernels`] | | vector arithmetic on many teams at once |
//! | [`model`] | | the parts of a step: keys, constants, formulas, shaders |
//! | [`config`] | | the config, which defines an experiment |
//! | [`world`] | | one experiment's constants and start state |
//! | [`reach`] | | how far agents can travel, and which POIs no team can observe |
//! | [`evolve`] | | random numbers, team schedules, selection and mutation |
//! | [`sample`] | | random worlds for tests |
//! | [`credit`] | | the record of an episode, and G, D, Df, D++ and Dt from it |
//! | [`backend`] | | whole episodes of many teams on the CPU, and with `gpu` on a GPU |
//! | [`trainer`] | | the generation loop |
//! | [`statistics`] | | confidence intervals and tests |
//! | [`evaluate`] | | evaluation of trained teams from held-out starts |
//! | [`verify`] | | check that two backends agree bit for bit |
//! | [`baseline`] | | baselines without learning |
//! | [`stepping`] | | stepping of teams with given actions |
//! | [`script`] | `report` | teams whose leaders drive to given places |
//! | [`memory`] | | a run's peak memory |
//! | [`record`] | `record` | files: policies, metrics, checkpoints, folders |
//! | [`run`] | `record` | a trainer together with its runs' folders |
//! | [`report`] | `report` | pictures, films, pages; the paper's claims |
//! | [`sweep`] | `report` | many runs of a parameter grid |
//! | [`front`] | | the functions that most programs need |
//! | [`choice`] | `gpu` and `record` | the processor that is expected to finish first |
//! | [`ops`] | `gpu` and `report` | the use cases of the program, and their errors |
//! | [`mod@bench`] | `cli` | a backend's speed, and the machine's arithmetic ceiling |
//! | [`cli`] | `cli` | the command line |
//!
//! Only `backend::gpu` and the GPU's ceiling in [`mod@bench`] use wgpu. The model does not depend on threads or GPUs.
//! Only [`host`] reads the clock.
//!
//! # Stability
//!
//! Programs build on [`front`], [`ops`], [`Config`] and the types that these use. A minor version may change them, and
//! the changelog says so. The other modules are public for this crate's tests and tools, and may change in any version.
//!
//! # Features
//!
//! | feature | adds | total crates, approximately |
//! |---|---|---|
//! | (none) | training, evaluation and verification on one CPU thread; also on WebAssembly | 30 |
//! | `scalar` | also episodes without vector instructions, for `verify --report` | 30 |
//! | `parallel` | all threads, using rayon; results keep the same bits | 35 |
//! | `gpu` | any GPU, using wgpu | 80 |
//! | `record` | runs on disk | 60 |
//! | `report` | pictures; includes `record` | 75 |
//! | `cli` (default) | the program; includes all of the above except `scalar` | 145 |

#![deny(missing_docs)]
#![cfg_attr(
    not(feature = "cli"),
    allow(dead_code, unused_imports, reason = "the callers may be in features that are left out")
)]
#![allow(rustdoc::private_intra_doc_links, reason = "tables of modules name the internal ones, too")]

pub mod backend;
pub mod baseline;
#[cfg(feature = "cli")]
pub mod bench;
#[cfg(all(feature = "gpu", feature = "record"))]
pub mod choice;
#[cfg(feature = "cli")]
pub mod cli;
pub mod config;
pub(crate) mod config_enum;
pub mod credit;
pub(crate) mod escape;
pub mod evaluate;
pub mod evolve;
pub(crate) mod file;
pub mod front;
#[doc(hidden)]
pub mod gpu_struct;
#[doc(hidden)]
pub mod host;
#[doc(hidden)]
pub mod kernels;
pub mod memory;
pub mod model;
#[cfg(all(feature = "gpu", feature = "report"))]
pub mod ops;
#[doc(hidden)]
pub mod parallel;
pub mod reach;
pub mod reader;
#[cfg(feature = "record")]
pub mod record;
#[cfg(feature = "report")]
pub mod report;
#[cfg(feature = "record")]
pub mod run;
#[doc(hidden)]
pub mod sample;
#[cfg(feature = "report")]
pub mod script;
pub(crate) mod shell;
pub mod statistics;
pub mod stepping;
#[cfg(feature = "report")]
pub mod sweep;
pub mod trainer;
pub mod verify;
pub(crate) mod version;
pub mod world;

pub use config::Config;
#[cfg(feature = "gpu")]
pub use front::open;
pub use front::{play, stepper, trace, train};
pub use version::{COMMIT, VERSION};
