//! Runs use cases in a terminal: opens the backend, listens for signals, and shows what happens.

use std::cell::RefCell;
use std::ffi::OsString;

use super::recovery::{self, Signals};
use super::{Error, RunOptions, backend, say};
use crate::progress::Progress;
use flotilla::backend::OpenBackend;
use flotilla_app::choice::Work;
use flotilla_app::ops::{BackendSource, Context, Event};

/// The backend that the flags choose, opened when it is needed.
struct Machine<'a> {
    options: &'a RunOptions,
    open: Option<(OpenBackend, String)>,
}

impl BackendSource for Machine<'_> {
    fn open(&mut self, work: Work) -> Result<(&mut OpenBackend, String), Error> {
        let (open, description) = match &mut self.open {
            Some(open) => open,
            closed => closed.insert(backend::open_for(self.options, work)?),
        };
        Ok((open, description.clone()))
    }
}

/// Runs a use case on the processor that the flags choose. Signals stop it.
pub fn run<R>(
    options: &RunOptions,
    quiet: bool,
    work: impl FnOnce(&mut dyn BackendSource, Context<'_>) -> Result<R, Error>,
) -> Result<R, Error> {
    run_on_machine(options, quiet, &Signals::listen()?, work)
}

/// Runs a use case like [`run`]. Signals end it at once, because it leaves nothing to save.
pub fn play<R>(
    options: &RunOptions,
    quiet: bool,
    work: impl FnOnce(&mut dyn BackendSource, Context<'_>) -> Result<R, Error>,
) -> Result<R, Error> {
    run_on_machine(options, quiet, &Signals::default(), work)
}

fn run_on_machine<R>(
    options: &RunOptions,
    quiet: bool,
    signals: &Signals,
    work: impl FnOnce(&mut dyn BackendSource, Context<'_>) -> Result<R, Error>,
) -> Result<R, Error> {
    let (mut machine, flags) = (Machine { options, open: None }, recovery::words_of_machine(options));
    run_reported(quiet, signals, &flags, |context| work(&mut machine, context))
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
