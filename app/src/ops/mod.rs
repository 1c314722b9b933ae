//! The use cases of the program, below the command line, Python and the page.
//!
//! Each use case takes a request and reports its progress to a [`Context`]. It returns an outcome, or an [`Error`] with a
//! stable code. Outcomes can be serialised.
//!
//! # Example
//!
//! ```
//! use flotilla_app::ops::{self, ConfigText, Context, check};
//!
//! let text = flotilla::config::LAYOUTS[2].1.into();
//! let config = ConfigText { text, name: "chaotic.toml".into(), set: vec![] };
//! let request = check::CheckRequest { config, name: "chaotic".into(), out: None };
//! let found = check::run(&request, Context::new(&|_| ()))?;
//! println!("{} teams play {} steps", found.cost.teams, found.cost.team_steps);
//! # Ok::<(), ops::Error>(())
//! ```
//!
//! | module | use case |
//! |---|---|
//! | [`error`] | the error of all of them |
//! | [`output`] | which files may be written |
//! | [`train`] | training of one config |
//! | [`check`] | the values and the cost of a config |
//! | [`rollout`] | scores of trained or given policies |
//! | [`replay`] | a page, a film or a picture of an episode |
//! | [`plot`] | learning curves |
//! | [`baseline`] | teams that do not learn |
//! | [`sweep`] | training of a grid of runs, and collection of its results |
//! | [`compare`] | comparison of runs |
//! | [`verify`] | comparison of GPUs with the CPU |

use std::ffi::OsString;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use crate::choice::Work;
use crate::report::replay::numbered;
use crate::run::{Options, Progress, RunError};
use flotilla::backend::{BackendError, OpenBackend};
use flotilla::config::{Config, Override, STAGES, ValidConfig};
use flotilla::escape::PathExt;
use flotilla::front;
use flotilla::memory::Peaks;
use flotilla::parallel;
use flotilla::reader::Document;
use flotilla::trainer::Row;

pub mod baseline;
pub mod check;
pub mod compare;
pub mod error;
pub mod output;
pub mod plot;
pub mod replay;
pub mod rollout;
pub mod sweep;
pub mod train;
pub mod verify;

pub use crate::record::folder::ProcessorInfo;
pub use error::{Error, MessageWithRemedy, with_remedy};

/// An event while a use case runs.
pub enum Event<'a> {
    /// Progress, for people.
    Message(String),
    /// A remark, shown also to people who want no progress.
    Note(String),
    /// A warning, shown also to people who want no progress.
    Warning(String),
    /// Training of these experiments begins: their names and numbers of POIs, the next and the last generation.
    Begin(Vec<(String, Option<usize>)>, usize, usize),
    /// Experiments have played.
    Rows {
        /// The next generation.
        next: usize,
        /// The rows that became complete.
        rows: &'a [Row],
        /// The best policy of each population of that generation, `[trials][populations][parameters]`, if they were
        /// asked for.
        champions: Option<&'a [f32]>,
    },
    /// The fraction of the work that is done, 0 to 1, and what is done now.
    Fraction(f64, String),
    /// No more progress is reported for now.
    Pause,
}

/// How a use case reports to its caller, and how the caller stops it.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// Receives events.
    pub report: &'a dyn Fn(Event<'_>),
    /// Set by the caller to save and stop.
    pub stop: &'a AtomicBool,
    /// Set by the caller to save and continue.
    pub save: &'a AtomicBool,
    /// Set by the caller together with `stop` to make the generation that plays next the last. See [`Session::end`].
    ///
    /// [`Session::end`]: crate::run::Session::end
    pub end: &'a AtomicBool,
    /// Command that is recorded in `run.json`.
    pub command: &'a str,
    /// Flags that choose the processor, for commands in advice.
    pub flags: &'a [OsString],
}

impl<'a> Context<'a> {
    /// Returns a context that reports to `report`, and never stops.
    pub fn new(report: &'a dyn Fn(Event<'_>)) -> Context<'a> {
        static NEVER: AtomicBool = AtomicBool::new(false);
        Context { report, stop: &NEVER, save: &NEVER, end: &NEVER, command: "", flags: &[] }
    }
}

impl Context<'_> {
    /// Returns this context without reports.
    pub fn quiet(self) -> Self {
        Context { report: &|_| (), ..self }
    }

    /// Reports progress, for people.
    pub fn message(&self, text: impl ToString) {
        (self.report)(Event::Message(text.to_string()));
    }

    pub(crate) fn note(&self, text: impl ToString) {
        (self.report)(Event::Note(text.to_string()));
    }

    /// Reports rows that became complete.
    pub fn rows(&self, next: usize, rows: &[Row]) {
        (self.report)(Event::Rows { next, rows, champions: None });
    }

    /// Reports the fraction of the work that is done.
    pub(crate) fn fraction(&self, part: f64, text: impl ToString) {
        (self.report)(Event::Fraction(part, text.to_string()));
    }

    /// Reports notes for the author of a config.
    fn notes(&self, notes: &[String]) {
        notes.iter().for_each(|note| self.note(format_args!("note: {note}")));
    }

    /// Reports that no more progress follows for now.
    pub fn pause(&self) {
        (self.report)(Event::Pause);
    }

    /// Warns about every POI of a config that no team can observe.
    pub(crate) fn warn_of_unreachable(&self, config: &ValidConfig) {
        sweep::unreachable(config).iter().for_each(|line| self.warn(format_args!("warning: {line}")));
    }

    pub fn warn(&self, text: impl ToString) {
        (self.report)(Event::Warning(text.to_string()));
    }

    /// Reports whether the caller asked to stop.
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Relaxed)
    }

    /// Fails if the caller asked to stop work that leaves nothing to resume.
    fn check_not_stopped(&self) -> Result<(), Error> {
        let stopped = || Error::Stopped("before everything was played; nothing was written".into());
        if self.is_stopped() { Err(stopped()) } else { Ok(()) }
    }

    /// Reports whether a stopped training ends with the generation that plays next. If so, it continues until then.
    fn ends(&self) -> bool {
        let ends = self.end.swap(false, Relaxed);
        self.stop.fetch_and(!ends, Relaxed);
        ends
    }

    /// Returns the CPU, to continue with after a device failed. Returns `None` after any other error.
    pub fn fallback(&self, error: &BackendError) -> Option<OpenBackend> {
        error.is_device_failure().then(|| {
            let (backend, machine) = front::cpu();
            let cpu = backend.describe();
            self.warn(format_args!(
                "note: {error}\ncontinuing on {cpu} from the last checkpoint, with the same results"
            ));
            (backend, machine)
        })
    }

    /// Calls `work` with the options of a training that calls `watch` after every generation.
    pub fn train<R>(&self, watch: &mut dyn FnMut(&Progress<'_>), work: impl FnOnce(&mut Options<'_>) -> R) -> R {
        work(&mut Options {
            command: self.command,
            stop: self.stop,
            save: self.save,
            fallback: &mut |error| self.fallback(error),
            watch,
        })
    }
}

/// Opens the backend when it is needed, so that requests are checked first.
pub trait BackendSource {
    /// Returns the backend that plays some work, and its description for people.
    fn open(&mut self, work: Work) -> Result<(&mut OpenBackend, String), Error>;
}

impl BackendSource for &mut OpenBackend {
    fn open(&mut self, _: Work) -> Result<(&mut OpenBackend, String), Error> {
        let description = self.0.describe();
        Ok((self, description))
    }
}

/// A config as a request carries it.
#[derive(Clone, Debug)]
pub struct ConfigText {
    pub text: String,
    /// The file's name in errors.
    pub name: String,
    /// Config keys to set.
    pub set: Vec<Override>,
}

impl ConfigText {
    pub fn read(&self) -> Result<Config, Error> {
        Ok(Config::read(&self.text, &self.name, &[], &self.set)?)
    }

    /// Reads the config with which a stage plays. Keys are set there, after those of the stage. Without `stage` this is
    /// the config of the file, and a note says so if it has stages.
    fn in_stage(&self, stage: Option<usize>, context: Context<'_>) -> Result<Config, Error> {
        let Some(stage) = stage else {
            let config = self.read()?;
            if !config.stages.is_empty() {
                context.note("note: this plays in the world before any stage; --stage N plays in stage N");
            }
            return Ok(config);
        };
        let (stages, set): (Vec<_>, Vec<_>) = self.set.iter().cloned().partition(|set| set.key == STAGES);
        let mut config = Config::read(&self.text, &self.name, &[], &stages)?;
        let generations = config.learning.generations;
        // A stage can be played even if the run ended before it.
        config.learning.generations = config.stages.iter().fold(generations, |last, stage| last.max(stage.from));
        let valid = config.validate()?;
        let Some((_, of_stage)) = valid.stages().get(stage) else {
            let stages = match valid.stages().len() {
                1 => "no [[stages]]".into(),
                count => numbered(count, "stage"),
            };
            return Err(Error::Usage(format!("--stage {stage}: the config has {stages}").into()));
        };
        let mut config = Config { stages: vec![], ..Config::clone(of_stage) };
        config.learning.generations = generations;
        Ok(config.with(&set)?)
    }

    /// Reads the config. Reports notes for its author, and returns them, too.
    fn read_noted(&self, context: Context<'_>) -> Result<(ValidConfig, Vec<String>), Error> {
        let (config, notes) = Config::read_noted(&Document::parse(&self.text), &self.name, &[], &self.set)?;
        context.notes(&notes);
        Ok((config, notes))
    }
}

/// Serialises a path as in messages, with control characters escaped.
fn escaped<S: serde::Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.escaped())
}

/// Refuses configs that need more memory than there is, each alone.
pub fn check_memory<'a>(
    configs: impl IntoIterator<Item = &'a ValidConfig>,
    (_, machine): &OpenBackend,
) -> Result<(), Error> {
    for config in configs {
        let plan = Peaks::of([config], parallel::current_num_threads());
        plan.check(machine.backend == "gpu").map_err(RunError::from)?;
    }
    Ok(())
}
