//! The use cases of the program, below the command line, Python and the page.
//!
//! Each takes a request that can be serialised, tells a [`Context`] what happens on the way, and returns an outcome that
//! can be serialised, or an [`Error`] with a stable code. [`answer`] takes any request as data.
//!
//! | module | use case |
//! |---|---|
//! | [`error`] | the error of all of them |
//! | [`sweep`] | training of a grid of runs, and collection of its results |
//! | [`questions`] | training for the open questions of the paper |
//! | [`paper`] | training of the paper's experiments, and a check of its claims |
//! | [`compare`] | comparison of runs |
//! | [`verify`] | comparison of GPUs with the CPU |

use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use serde::{Deserialize, Serialize};

use crate::backend::{BackendError, Machine, OpenBackend};
use crate::choice::Work;
use crate::front;
use crate::memory::Peaks;
use crate::parallel;
use crate::record::folder::Run;
use crate::run::{Options, Progress, RunError};
use crate::trainer::Row;

pub mod compare;
pub mod error;
pub mod paper;
pub mod questions;
mod remedy;
pub mod sweep;
pub mod verify;

pub use error::{Error, Said, said};
#[cfg(feature = "cli")]
pub(crate) use remedy::{RUNS, device as advice_on_device};

/// An event while a use case runs.
#[non_exhaustive]
pub enum Event<'a> {
    /// Progress, for people.
    Message(String),
    /// A warning, shown also to people who want no progress.
    Warning(String),
    /// Training of these experiments begins: their names and numbers of POIs, the next and the last generation.
    Begin(Vec<(String, Option<usize>)>, usize, usize),
    /// Experiments have played: the next generation, and the rows that became complete.
    Rows(usize, &'a [Row]),
    /// The share of the work that is done, 0 to 1, and what is done now.
    Share(f64, String),
    /// No more progress is reported for now.
    Pause,
}

/// How a use case reports to its caller, and how the caller stops it.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// Receives events.
    pub tell: &'a dyn Fn(Event<'_>),
    /// Set by the caller to save and stop.
    pub stop: &'a AtomicBool,
    /// Set by the caller to save and continue.
    pub save: &'a AtomicBool,
    /// Command that is recorded in `run.json`.
    pub command: &'a str,
    /// Whether the CPU continues if a device fails during a run.
    pub falls_back: bool,
}

impl Context<'_> {
    pub(crate) fn message(&self, text: impl ToString) {
        (self.tell)(Event::Message(text.to_string()));
    }

    /// Reports a warning.
    pub fn warn(&self, text: impl ToString) {
        (self.tell)(Event::Warning(text.to_string()));
    }

    fn is_stopped(&self) -> bool {
        self.stop.load(Relaxed)
    }

    /// Returns the CPU backend to continue with after another backend failed, if that is allowed.
    pub fn instead(&self, error: &BackendError) -> Option<OpenBackend> {
        self.falls_back.then(|| {
            let (backend, machine) = front::cpu();
            self.warn(format_args!("{error}\ncontinuing on {}, with the same results", backend.describe()));
            (backend, machine)
        })
    }

    /// Reports that populations moved to the host.
    pub fn setback(&self, error: &BackendError) {
        self.warn(format_args!("{error}\nthe populations are kept by the host from here on, to the same results"));
    }

    /// Calls `work` with the options of a training that calls `watch` after every generation.
    pub fn train<R>(&self, watch: &mut dyn FnMut(&Progress<'_>), work: impl FnOnce(&mut Options<'_>) -> R) -> R {
        work(&mut Options {
            command: self.command,
            stop: self.stop,
            save: self.save,
            instead: &mut |error| self.instead(error),
            setback: &mut |error| self.setback(error),
            watch,
        })
    }
}

/// Opens the backend when it is needed, so that requests are checked first.
pub trait Player {
    /// Returns the backend that plays some work, and its description for people.
    ///
    /// # Errors
    /// It cannot be opened.
    fn open(&mut self, work: Work) -> Result<(&mut OpenBackend, String), Error>;
}

impl Player for &mut OpenBackend {
    fn open(&mut self, _: Work) -> Result<(&mut OpenBackend, String), Error> {
        let description = self.0.describe();
        Ok((self, description))
    }
}

/// Refuses configs that need more memory than there is, each alone.
fn check_memory<'a>(
    configs: impl IntoIterator<Item = &'a crate::config::Config>,
    (_, machine): &OpenBackend,
) -> Result<(), Error> {
    for config in configs {
        let plan = Peaks::of([config], parallel::current_num_threads());
        plan.check(machine.backend == "gpu").map_err(RunError::from)?;
    }
    Ok(())
}

/// The processor that episodes were played on, with the names that `run.json` has.
#[derive(Clone, Debug, Serialize)]
#[non_exhaustive]
pub struct Processor {
    /// "cpu" or "gpu".
    pub backend: String,
    /// The processor in words.
    pub description: String,
    /// The GPU's name.
    pub adapter: Option<String>,
    /// The GPU's driver.
    pub driver: Option<String>,
    /// CPU threads.
    pub threads: usize,
}

impl Processor {
    /// Returns an open backend.
    pub fn of(machine: &Machine, description: &str) -> Processor {
        let Machine { backend, adapter, driver, threads } = machine.clone();
        Processor { backend, description: description.into(), adapter, driver, threads }
    }

    /// Returns the processor of a run's last session.
    pub fn of_run(run: &Run) -> Processor {
        let Run { backend, description, adapter, driver, threads, .. } = run.clone();
        Processor { backend, description, adapter, driver, threads }
    }

    /// Adds the fields to a JSON object.
    pub fn add_to(&self, object: &mut serde_json::Value) {
        let fields = serde_json::to_value(self).expect("texts and numbers are JSON");
        for (name, value) in fields.as_object().into_iter().flatten() {
            object[name] = value.clone();
        }
    }
}

/// A request as data.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "use_case", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Request {
    /// See [`paper`].
    Paper(paper::Request),
    /// See [`questions`].
    Questions(paper::Request),
    /// See [`sweep`].
    Sweep(sweep::Request),
    /// See [`compare`].
    Compare(compare::Request),
    /// See [`verify`].
    Verify(verify::Request),
}

/// Runs any use case, and returns its outcome as data.
///
/// # Errors
/// Those of the use case. A sweep with missing points, and a comparison with the CPU that finds a difference, are
/// outcomes.
pub fn answer(request: &Request, player: &mut dyn Player, context: Context<'_>) -> Result<serde_json::Value, Error> {
    let outcome = match request {
        Request::Paper(request) => serde_json::to_value(paper::run(request, player, context)?),
        Request::Questions(request) => serde_json::to_value(questions::run(request, player, context)?),
        Request::Sweep(request) => serde_json::to_value(sweep::run(request, player, context)?),
        Request::Compare(request) => serde_json::to_value(compare::run(request, context)?),
        Request::Verify(request) => serde_json::to_value(verify::run(request, context)?),
    };
    Ok(outcome.expect("outcomes are JSON"))
}
