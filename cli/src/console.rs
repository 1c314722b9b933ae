//! Runs use cases in a terminal: opens the backend, listens for signals, and shows what happens.

use std::cell::RefCell;
use std::ffi::OsString;

use super::recovery::{self, Signals};
use super::{Error, RunOptions, backend, say};
use crate::progress::Progress;
use flotilla::backend::OpenBackend;
use flotilla_app::choice::Work;
use flotilla_app::ops::{BackendSource, Context, Event};

/// The flags of a command that concern every use case.
pub struct Console<'a> {
    options: &'a RunOptions,
    /// The backend that the flags choose, opened when it is needed.
    open: Option<(OpenBackend, String)>,
    quiet: bool,
}

impl BackendSource for Console<'_> {
    fn open(&mut self, work: Work) -> Result<(&mut OpenBackend, String), Error> {
        let (open, description) = match &mut self.open {
            Some(open) => open,
            closed => closed.insert(backend::open_for(self.options, work)?),
        };
        Ok((open, description.clone()))
    }
}

impl<'a> Console<'a> {
    /// Returns a console with a command's flags.
    pub fn new(options: &'a RunOptions, quiet: bool) -> Console<'a> {
        Console { options, open: None, quiet }
    }

    /// Runs a use case that signals stop.
    pub fn run<R>(
        &mut self,
        work: impl FnOnce(&mut dyn BackendSource, Context<'_>) -> Result<R, Error>,
    ) -> Result<R, Error> {
        self.with(&Signals::listen()?, work)
    }

    /// Runs a use case that signals end at once, because it leaves nothing to save.
    pub fn play<R>(
        &mut self,
        work: impl FnOnce(&mut dyn BackendSource, Context<'_>) -> Result<R, Error>,
    ) -> Result<R, Error> {
        self.with(&Signals::default(), work)
    }

    fn with<R>(
        &mut self,
        signals: &Signals,
        work: impl FnOnce(&mut dyn BackendSource, Context<'_>) -> Result<R, Error>,
    ) -> Result<R, Error> {
        let flags = recovery::words_of_machine(self.options);
        run_reported(self.quiet, signals, &flags, |context| work(self, context))
    }
}

/// Runs a use case that needs no backend. A signal ends the process.
pub fn run_without_backend<R>(quiet: bool, work: impl FnOnce(Context<'_>) -> Result<R, Error>) -> Result<R, Error> {
    run_reported(quiet, &Signals::default(), &[], work)
}

fn run_reported<R>(
    quiet: bool,
    signals: &Signals,
    flags: &[OsString],
    work: impl FnOnce(Context<'_>) -> Result<R, Error>,
) -> Result<R, Error> {
    let (show, command) = (Display { quiet, progress: RefCell::default() }, recovery::command_line());
    let (Signals { stop, save }, report) = (signals, |event: Event<'_>| show.event(event));
    let done = work(Context { stop, save, command: &command, flags, ..Context::new(&report) });
    show.event(Event::Pause);
    done
}

/// Shows events on standard error.
struct Display {
    quiet: bool,
    progress: RefCell<Option<Progress>>,
}

impl Display {
    fn event(&self, event: Event<'_>) {
        let progress = &mut *self.progress.borrow_mut();
        match event {
            Event::Warning(text) | Event::Note(text) => say(text),
            Event::Message(text) if !self.quiet => say(text),
            Event::Message(_) => {}
            Event::Begin(names, from, last) => *progress = Some(Progress::of_arms(names, from, last, self.quiet)),
            Event::Rows { next, rows, .. } => progress.iter_mut().for_each(|progress| progress.add(next, rows)),
            Event::Fraction(part, text) => {
                *progress = progress.take().filter(|progress| !progress.has_arms());
                progress.get_or_insert_with(|| Progress::of_fraction(self.quiet)).show(part, || text);
            }
            Event::Pause => progress.take().iter().for_each(Progress::clear),
        }
    }
}
