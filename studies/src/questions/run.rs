//! Trains experiments for the questions that the paper leaves open.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::paper::run::{self, Request, check_trials, holds};
use crate::questions::{self, Answer, OpenQuestion, QUESTIONS, Study, Warm};
use flotilla::backend::OpenBackend;
use flotilla::config::Config;
use flotilla::escape::PathExt;
use flotilla_app::choice::Work;
use flotilla_app::ops::sweep::{claim, free_memory, same_sweep, train_points};
use flotilla_app::ops::{BackendSource, Context, Error, Event, check_memory};
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{self, SWEEP, StartFrom};
use flotilla_app::record::{RecordError, ownership, policies};
use flotilla_app::report::comparison::{self, Comparison};
use flotilla_app::report::scene::Format;
use flotilla_app::run::{Session, SessionEnd};
use flotilla_app::sweep::results::point_folder;
use flotilla_app::sweep::run::SweepProgress;
use flotilla_app::sweep::{Sweep, shard};

/// The page with the results.
const PAGE: &str = "questions.md";

#[derive(Clone, Debug, Serialize)]
pub struct QuestionOutcome {
    pub letter: char,
    pub title: &'static str,
    /// The comparisons of all its parts.
    pub comparisons: Vec<Comparison>,
}

#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    pub folder: String,
    /// The random seed of all experiments.
    pub seed: u64,
    /// The number of trials of each.
    pub trials: usize,
    pub questions: Vec<QuestionOutcome>,
    /// The path of the page with the results.
    pub page: String,
    /// The page.
    #[serde(skip)]
    pub text: String,
}

fn all_parts() -> impl Iterator<Item = &'static Study> {
    QUESTIONS.iter().flat_map(|question| question.parts)
}

/// Returns the names of the files that are made for each part.
fn files() -> impl Iterator<Item = String> {
    all_parts().flat_map(|part| Format::names(part.name).into_iter().chain([format!("{}.csv", part.name)]))
}

/// Trains every part of the questions, each as a sweep in a folder of its own, and writes the results.
///
/// # Errors
/// The folder or a config cannot be used, training fails or is stopped, or files cannot be written.
pub fn run(request: &Request, backends: &mut dyn BackendSource, context: Context<'_>) -> Result<Outcome, Error> {
    let (out, start) = (&request.out, request.start);
    let parts: Vec<(&Study, Sweep)> = questions::parts(&request.questions)
        .into_iter()
        .map(|part| Ok((part, part.sweep(&request.set)?)))
        .collect::<Result<_, Error>>()?;
    check_trials(parts.iter().map(|(_, sweep)| &*sweep.points[0].config))?;
    check_folder(&parts, out)?;
    let configs = || parts.iter().flat_map(|(_, sweep)| &sweep.points).map(|point| &point.config);
    let (backend, on) = backends.open(Work::of(configs().map(|config| &**config)))?;
    check_memory(configs(), backend)?;
    let (disk, _lock) = request.open_folder(files().chain([PAGE.into()]))?;
    let points: usize = parts.iter().map(|(_, sweep)| sweep.points.len()).sum();
    context.message(format_args!("training {points} experiments on {on}, into {}", out.escaped()));

    let warm: Vec<_> = parts.iter().map(|(part, sweep)| part.warm(sweep, out)).collect();
    // All folders are checked before training, so that no part is trained only to fail at another part's folder.
    let points = parts.iter().flat_map(|(part, sweep)| {
        sweep.points.iter().map(|point| (point_folder(&out.join(part.name), point), &*point.config))
    });
    let warm_runs = warm.iter().flatten().map(|run| (run.folder.clone(), &run.config));
    let folders: Vec<(PathBuf, &Config)> = points.chain(warm_runs).collect();
    folder::check(&disk, folders.iter().map(|(path, config)| (&**path, *config)), start)?;

    train(&parts, &warm, request, &disk, backend, context)?;
    let answers = compare(&parts, request, &disk, backend, context)?;
    let first = &parts[0].1.points[0].config.learning;
    let heading = format!(
        "Means over {} trials of seed {} with 95 % intervals; generations are medians. In parentheses beside a champion's G is that of the\n\
         best of {} teams. p is from Mann and Whitney's test, two-sided, with Holm's correction for all pairs of arms at\n\
         one place.\n",
        first.trials,
        first.seed,
        first.team_count()
    );
    let page = questions::page(&answers, &heading);
    ownership::publish_bytes(&disk, &out.join(PAGE), page.as_bytes())?;
    let of = |(question, answers): &(OpenQuestion, Vec<Answer>)| QuestionOutcome {
        letter: question.letter,
        title: question.title,
        comparisons: answers.iter().flat_map(Answer::comparisons).cloned().collect(),
    };
    Ok(Outcome {
        folder: out.escaped(),
        seed: first.seed,
        trials: first.trials,
        questions: answers.iter().map(of).collect(),
        page: out.join(PAGE).escaped(),
        text: page,
    })
}

/// Refuses a folder with other content, or with other sweeps.
fn check_folder(parts: &[(&Study, Sweep)], out: &Path) -> Result<(), Error> {
    run::check_folder(out)?;
    parts.iter().try_for_each(|(part, sweep)| same_sweep(sweep, &out.join(part.name)))?;
    let has_sweeps = all_parts().any(|part| out.join(part.name).join(SWEEP).exists());
    match files().chain([PAGE.into()]).find(|name| out.join(name).exists()) {
        Some(theirs) if !has_sweeps => Err(holds(out, &format!("{theirs}, but none of the questions' sweeps"))),
        _ => Ok(()),
    }
}

/// Returns the error for a command that the user stopped.
pub(crate) fn stopped() -> Error {
    Error::Stopped("with everything saved".into())
}

/// Trains the sweep of each part, and then its runs from policies of that sweep.
fn train(
    parts: &[(&Study, Sweep)],
    warm: &[Vec<Warm>],
    request: &Request,
    disk: &Disk,
    backend: &mut OpenBackend,
    context: Context<'_>,
) -> Result<(), Error> {
    let (out, start) = (&request.out, request.start);
    let cost = |sweep: &Sweep| sweep.points.iter().map(shard::cost).sum::<u128>() as f64;
    // Each warm start costs as much as an average point of its sweep.
    let times = |at: usize| 1.0 + warm[at].len() as f64 / parts[at].1.points.len() as f64;
    let whole: f64 = parts.iter().enumerate().map(|(at, (_, sweep))| cost(sweep) * times(at)).sum();
    let mut before = 0.0;
    for (at, (part, sweep)) in parts.iter().enumerate() {
        let folder = out.join(part.name);
        claim(disk, sweep, &folder)?;
        let points: Vec<_> = sweep.points.iter().collect();
        let share = |now: &SweepProgress| {
            let share = now.played as f64 / now.total.max(1) as f64;
            let text = format!("{}: {}/{} experiments done", part.name, now.done, now.points);
            (context.report)(Event::Fraction((before + share * cost(sweep)) / whole, text));
        };
        let ended = train_points(context, sweep, &points, &folder, start, disk, free_memory(), backend, &share)?;
        if ended == SessionEnd::Stopped {
            return Err(stopped());
        }
        before += cost(sweep);
        if warm[at].is_empty() {
            continue;
        }
        let runs = warm[at].iter().map(|run| {
            Ok((
                run.config.clone(),
                run.folder.clone(),
                Some(policies::read_init(disk.at(&run.policies), &run.config)?),
            ))
        });
        let runs = runs.collect::<Result<_, RecordError>>()?;
        let (mut session, _) = Session::open_from(runs, StartFrom::Unspecified, start, disk)?;
        let mut watch = |_: &flotilla_app::run::Progress<'_>| {
            (context.report)(Event::Fraction(before / whole, format!("{}: warm starts", part.name)));
        };
        if !session.is_done()
            && context.train(&mut watch, |options| session.train(backend, options))? == SessionEnd::Stopped
        {
            return Err(stopped());
        }
        before += cost(sweep) * (times(at) - 1.0);
    }
    Ok(())
}

/// Compares the results of each question's parts, and writes their pictures and tables.
fn compare(
    parts: &[(&Study, Sweep)],
    request: &Request,
    disk: &Disk,
    backend: &mut OpenBackend,
    context: Context<'_>,
) -> Result<Vec<(OpenQuestion, Vec<Answer>)>, Error> {
    let out = &request.out;
    let mut answers: Vec<(OpenQuestion, Vec<Answer>)> = Vec::new();
    for question in QUESTIONS.iter().filter(|question| request.questions.contains(&question.letter)) {
        let mut of_parts = Vec::new();
        for part in question.parts {
            if context.is_stopped() {
                return Err(stopped());
            }
            let sweep = parts.iter().find(|(other, _)| other.name == part.name).map(|(_, sweep)| sweep);
            let Some(sweep) = sweep else { continue };
            (context.report)(Event::Fraction(1.0, format!("comparing {}", part.name)));
            let answer = part.answer(sweep, out, &mut *backend.0)?;
            answer.scene().publish(disk, out, part.name)?;
            let all: Vec<_> = answer.comparisons().cloned().collect();
            ownership::publish_bytes(disk, &out.join(format!("{}.csv", part.name)), &comparison::csv(&all))?;
            of_parts.push(answer);
        }
        answers.push((*question, of_parts));
    }
    (context.report)(Event::Pause);
    Ok(answers)
}
