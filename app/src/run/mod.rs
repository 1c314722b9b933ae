//! Sessions: recorded runs that train together, with one trainer for all of them. Each run has its own folder and
//! checkpoints. A single run is a session of one.
//!
//! | module | contents |
//! |---|---|
//! | `session` | training of all runs of a session |
//! | `member` | one run of a session: its folder, metrics and checkpoints |
//! | `twin` | recording of a run that would train as another one did |

mod member;
mod session;
mod twin;

use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

pub use session::Session;
pub use twin::{Twin, record_twins};

use crate::record::RecordError;
use crate::record::folder::FirstAndLastRows;
use flotilla::backend::{BackendError, OpenBackend};
use flotilla::config::ConfigError;
use flotilla::memory::TooLittle;
use flotilla::trainer::{Row, SnapshotError};

/// Maximum number of runs whose files are flushed at the same time, each on its own thread.
const MAX_WRITERS: usize = 32;

/// Reason why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The files of a run could not be written, read or used.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The machine has too little memory.
    #[error(transparent)]
    TooLittle(#[from] TooLittle),
    /// The backend failed. The message also reports whether the earlier generations are saved.
    #[error("{error}\ngeneration {generation} could not be played{}", after(saved))]
    Backend {
        error: BackendError,
        /// Generation that could not be played.
        generation: usize,
        /// Whether the earlier generations were saved.
        saved: Result<(), Box<RunError>>,
    },
    /// An allocation failed.
    #[error(
        "not enough memory for {what}, {bytes} bytes; choose a smaller population, fewer trials or another machine"
    )]
    Memory {
        /// Purpose of the memory.
        what: &'static str,
        bytes: u64,
    },
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The populations could not be read back from the backend for a checkpoint.
    #[error("no checkpoint could be made: {0}")]
    Fetch(BackendError),
}

impl RunError {
    /// Converts the error of a snapshot of `bytes` bytes of policies.
    pub(crate) fn of_snapshot(error: SnapshotError, what: &'static str, bytes: u64) -> RunError {
        match error {
            SnapshotError::Memory(_) => RunError::Memory { what, bytes },
            SnapshotError::Backend(error) => RunError::Fetch(error),
        }
    }

    /// Returns what the user can do about it.
    pub fn help(&self) -> Option<String> {
        Some(match self {
            RunError::Record(error) => return error.help("continue with --resume"),
            RunError::Backend { saved: Err(error), .. } => return error.help(),
            RunError::Backend { saved: Ok(()), .. } => {
                "continue with --resume, with --backend cpu to change to the CPU".into()
            }
            RunError::TooLittle(_) => {
                "flotilla check shows what a config needs; `ulimit -v` and limits of a job or container count".into()
            }
            RunError::Fetch(_) => "--resume continues from the last checkpoint or the start".into(),
            RunError::Memory { .. } | RunError::Config(_) => return None,
        })
    }
}

fn after(saved: &Result<(), Box<RunError>>) -> String {
    match saved {
        Ok(()) => "; all before it is saved".into(),
        Err(error) => format!(", and what came before it could not be saved: {error}"),
    }
}

/// Inputs and callbacks of a session.
pub struct Options<'a> {
    /// Command that started this session, for `run.json`.
    pub command: &'a str,
    /// Set by the caller to make the runs finish their generation, save and stop.
    pub stop: &'a AtomicBool,
    /// Set by the caller to request a checkpoint of every run.
    pub save: &'a AtomicBool,
    /// Called after a backend fails. Returns another backend that continues from the last checkpoints, if there is one.
    pub fallback: &'a mut dyn FnMut(&BackendError) -> Option<OpenBackend>,
    /// Called after every generation.
    pub watch: &'a mut dyn FnMut(&Progress<'_>),
}

/// State after a generation.
pub struct Progress<'a> {
    /// Generation that each run plays next. It is two past the last generation if the run is finished.
    pub generations: &'a [usize],
    /// Rows that became complete, sorted by run (the field `experiment`), generation and trial.
    pub rows: &'a [Row],
}

#[derive(Clone, Debug, PartialEq)]
pub struct Results {
    /// Rows of the first and the last generation of every trial.
    pub rows: FirstAndLastRows,
    /// Digest of the run. See [`crate::record::folder::Folder::digest`].
    pub digest: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SessionEnd {
    Finished,
    /// The session was asked to stop, and everything is saved.
    Stopped,
}

/// Applies a slow function (such as flushing files) to all items on as many threads as the system allows, up to
/// [`MAX_WRITERS`].
fn on_threads<T: Send, R: Send>(
    all: Vec<T>,
    each: impl Fn(T) -> Result<R, RunError> + Sync,
) -> Result<Vec<R>, RunError> {
    let helpers = all.len().min(MAX_WRITERS).saturating_sub(1);
    let queue = Mutex::new(all.into_iter().enumerate());
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
    let work = || std::iter::from_fn(next).map(|(place, item)| (place, each(item))).collect::<Vec<_>>();
    let mut done = std::thread::scope(|scope| {
        let start = |_| std::thread::Builder::new().spawn_scoped(scope, work).ok();
        let threads: Vec<_> = (0..helpers).map_while(start).collect();
        let mut done = work();
        for thread in threads {
            done.extend(thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        }
        done
    });
    done.sort_by_key(|(place, _)| *place);
    done.into_iter().map(|(_, result)| result).collect()
}
