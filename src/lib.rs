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
//! // Step teams by given actions, [teams][leaders][2] in -1..1, and see what leaders sense: [teams][leaders][inputs].
//! let mut stepper = flotilla::stepper(&config, 16, false)?;
//! let actions = vec![0.5; 16 * 4 * 2];
//! stepper.step(&actions)?;
//! println!("{:?}", &stepper.inputs()[..8]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`front`] has these functions and more. `app/examples/` has complete programs.
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
//! 2. [`world`] computes one experiment's constants and start state from its config. The engine knows classes of agents
//!    only: leaders and followers of the short form are two of them.
//! 3. [`trainer`] draws team schedules with [`evolve`] and passes the teams of all trials to a [`backend`] as one
//!    batch.
//! 4. The backend plays each team's whole episode: with [`model`] on the CPU, with the equivalent shaders under
//!    `shaders/` on a GPU. It records who was at which POI at which step and which leader each follower saw, or as much
//!    of that as the fitness needs. Records do not leave the backend.
//! 5. [`credit`] computes G, D, Df, D++ and Dt from a record, on the CPU while other teams play. The backend returns
//!    these scores.
//! 6. [`evolve`] selects and mutates on the host, or plans this for a GPU that holds the populations.
//!
//! # Where to change what
//!
//! *Common tasks* in `CONTRIBUTING.md` has the steps, and the commands that record digests and references again.
//!
//! | to | change |
//! |---|---|
//! | add a measure of senses | the files of the worked example in `CONTRIBUTING.md` |
//! | add a key of classes or POIs | `model/classes.rs`, `config/classes/read.rs`; what kernels read of it in `model/class.rs` or `world.rs` |
//! | add a fitness | `config/learning.rs`, `credit/` (`mod.rs`, `replay.rs`; `record.rs` for what it needs, `fast.rs` and `lanes.rs` for speed); then show it, because Python offers every fitness |
//! | test a new word of a key | `cli/tests/model.rs` or `tests/credit.rs`, a line in `tests/data/refusals/keys.txt` or, of classes, `tests/data/refusals/classes.txt`, a case in `tests/golden/cases.txt`; for a fitness `KINDS` in `verify.rs` and `tests/evolve.rs` |
//! | show a fitness beside the others | `evaluate.rs`, `front/play.rs`, `app/src/ops/rollout.rs`, `app/src/report/replay/page.rs`, `python/src/play.rs`, `python/flotilla/_play.py`, `web/page/`, `docs/explain/credits.md` |
//! | add a place that holds populations | a backend with `Backend::hold` and a `DevicePopulation`, such as `FakeDevice` in `cli/tests/population.rs` |
//! | add a kind of value in configs | `reader/request.rs`, `reader/allowed.rs` |
//!
//! # Packages
//!
//! Each package uses only those above it.
//!
//! | folder | package, library | contents |
//! |---|---|---|
//! | `src/`, `shaders/` | `flotilla-engine`, `flotilla` | the engine: this crate |
//! | `app/` | `flotilla-app`, `flotilla_app` | runs on disk, sweeps, pictures and pages, and the use cases of the program |
//! | `studies/` | `flotilla-studies`, `flotilla_studies` | the paper with its claims, the open questions, the tasks |
//! | `cli/` | `flotilla-teams`, `flotilla_cli`, the command `flotilla` | the command line, and `bench` |
//! | `python/`, `web/` | | the Python package; the page that trains in a browser tab |
//!
//! Tests of the engine alone are in `tests/`, all others in `cli/tests/`.
//!
//! # Modules
//!
//! Each module imports only modules above it.
//!
//! | module | contents |
//! |---|---|
//! | [`version`] | the version, commit and target of this build |
//! | [`escape`], [`mod@file`] | reading and writing of names and files |
//! | [`host`], [`parallel`] | time, waiting, threads and the cache |
//! | [`config_enum`], [`gpu_struct`] | enums whose variants are words, structs shared with shaders |
//! | [`reader`] | reading configs key by key, from TOML or from programs |
//! | [`kernels`] | vector arithmetic on many teams at once |
//! | [`model`] | the parts of a step: keys, constants, formulas, shaders |
//! | [`config`] | the config, which defines an experiment |
//! | [`world`] | one experiment's constants and start state |
//! | [`reach`] | how far agents can travel, and which POIs no team can observe |
//! | [`evolve`] | random numbers, team schedules, selection and mutation |
//! | [`sample`] | random worlds for tests |
//! | [`credit`] | the record of an episode, and G, D, Df, D++ and Dt from it |
//! | [`backend`] | whole episodes of many teams on the CPU, and with `gpu` on a GPU |
//! | [`trainer`] | the generation loop |
//! | [`statistics`] | confidence intervals and tests |
//! | [`evaluate`] | evaluation of trained teams from held-out starts |
//! | [`verify`] | check that two backends agree bit for bit |
//! | [`memory`] | a run's peak memory |
//! | [`stepping`] | stepping of teams with given actions |
//! | [`baseline`] | baselines without coevolution |
//! | [`front`] | the functions that most programs need |
//!
//! Only `backend::gpu` uses wgpu. The model does not depend on threads or GPUs. Only [`host`] reads the clock.
//!
//! # Stability
//!
//! Programs build on [`front`], [`Config`] and the types that these use. A minor version may change them, and the
//! changelog says so. The other modules are public for the program and for tests, and may change in any version.
//!
//! # Features
//!
//! | feature | adds | total crates, approximately |
//! |---|---|---|
//! | (none) | training, evaluation and verification on the CPU; on WebAssembly with one thread | 35 |
//! | `gpu` (default) | any GPU, using wgpu | 85 |
//! | `scalar` | episodes without vector instructions, for tests | 35 |

#![deny(missing_docs, clippy::missing_errors_doc)]
#![allow(rustdoc::private_intra_doc_links, reason = "tables of modules name the internal ones, too")]

pub mod backend;
pub mod baseline;
pub mod config;
pub(crate) mod config_enum;
pub mod credit;
#[doc(hidden)]
pub mod escape;
pub mod evaluate;
pub mod evolve;
#[doc(hidden)]
pub mod file;
pub mod front;
#[doc(hidden)]
pub mod gpu_struct;
#[doc(hidden)]
pub mod host;
#[doc(hidden)]
pub mod kernels;
pub mod memory;
pub mod model;
#[doc(hidden)]
pub mod parallel;
pub mod reach;
pub mod reader;
#[doc(hidden)]
pub mod sample;
pub mod statistics;
pub mod stepping;
pub mod trainer;
pub mod verify;
#[doc(hidden)]
pub mod version;
pub mod world;

pub use config::Config;
#[cfg(feature = "gpu")]
pub use front::open;
pub use front::{play, stepper, trace, train};
pub use version::{COMMIT, VERSION};
