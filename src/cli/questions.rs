//! `flotilla paper --questions`: trains experiments for the questions that the paper leaves open.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

use serde_json::json;

use super::paper::Args;
use super::recovery::{self, Signals};
use super::sweep::{claim, free_memory, same_sweep};
use super::{Error, backend, print, print_json, say};
use crate::config::Config;
use crate::escape::PathExt;
use crate::memory::Peaks;
use crate::record::disk::Disk;
use crate::record::folder::{self, SWEEP};
use crate::record::{RecordError, ownership, policies};
use crate::report::comparison;
use crate::report::curves::PRINT;
use crate::report::progress::Meter;
use crate::report::scene::Format;
use crate::run::{Ended, Options, RunError, Session};
use crate::sweep::questions::{self, Answer, OpenQuestion, QUESTIONS, Study};
use crate::sweep::results::point_folder;
use crate::sweep::run::{self, SweepOptions};
use crate::sweep::{Sweep, shard};

/// The page with the results.
const PAGE: &str = "questions.md";

/// Returns all parts of all questions.
fn all_parts() -> impl Iterator<Item = &'static Study> {
    QUESTIONS.iter().flat_map(|question| question.parts)
}

/// Returns the names of the files that are made for each part.
fn files() -> impl Iterator<Item = String> {
    let endings = || Format::ALL.map(Format::extension).into_iter().chain(["csv"]);
    all_parts().flat_map(move |part| endings().map(|ending| format!("{}.{ending}", part.name)))
}

/// Trains every part of the questions, each as a sweep in a folder of its own, and writes the results.
pub fn run(args: &Args) -> Result<(), Error> {
    let (out, start) = (&args.out, args.start());
    let parts: Vec<(&Study, Sweep)> = questions::parts(&args.questions)
        .into_iter()
        .map(|part| Ok((part, part.sweep(&args.overrides())?)))
        .collect::<Result<_, Error>>()?;
    if let Some((_, sweep)) = parts.iter().find(|(_, sweep)| sweep.points[0].config.learning.trials < 2) {
        let trials = sweep.points[0].config.learning.trials;
        return Err(Error::Usage(format!("--trials {trials}: intervals and tests take two trials or more")));
    }
    if let Some(what) = folder::collection(out) {
        return Err(Error::Refused(format!("{} holds {what}; choose another --out", out.escaped())));
    }
    if folder::holds_run(out)? {
        return Err(Error::Refused(format!("{} holds a run; choose another --out", out.escaped())));
    }
    parts.iter().try_for_each(|(part, sweep)| same_sweep(sweep, &out.join(part.name)))?;
    if !all_parts().any(|part| out.join(part.name).join(SWEEP).exists())
        && let Some(theirs) = files().chain([PAGE.into()]).find(|name| out.join(name).exists())
    {
        return Err(Error::Refused(format!(
            "{} holds {theirs}, but none of the questions' sweeps; choose another --out",
            out.escaped()
        )));
    }
    let mut player = backend::open(&args.run)?;
    for config in parts.iter().flat_map(|(_, sweep)| &sweep.points).map(|point| &point.config) {
        Peaks::of([config], rayon::current_num_threads()).check(player.1.backend == "gpu").map_err(RunError::from)?;
    }
    let disk = Disk::default();
    disk.create_folder(out).map_err(|error| RecordError::Write { path: out.clone(), error })?;
    let disk = ownership::enter(&disk, out, args.is_out_named())?;
    let _lock = folder::lock(&disk, out)?;
    ownership::check(&disk, files().chain([PAGE.into()]).map(|name| out.join(name)))?;
    if !args.quiet {
        let points: usize = parts.iter().map(|(_, sweep)| sweep.points.len()).sum();
        say(format_args!("training {points} experiments on {}, into {}", player.0.describe(), out.escaped()));
    }

    let warm: Vec<_> = parts.iter().map(|(part, sweep)| part.warm(sweep, out)).collect();
    // All folders are checked before training, so that no part is trained only to fail at another part's folder.
    let points = parts.iter().flat_map(|(part, sweep)| {
        sweep.points.iter().map(|point| (point_folder(&out.join(part.name), point), &point.config))
    });
    let warm_runs = warm.iter().flatten().map(|run| (run.folder.clone(), &run.config));
    let folders: Vec<(PathBuf, &Config)> = points.chain(warm_runs).collect();
    folder::check(&disk, folders.iter().map(|(path, config)| (&**path, *config)), start)?;

    let signals = Signals::listen()?;
    let mut meter = Meter::new(args.quiet);
    let stopped = || Error::Stopped(format!("with everything saved; go on with\n  {}", args.command_to_resume()));
    let cost = |sweep: &Sweep| sweep.points.iter().map(shard::cost).sum::<u128>() as f64;
    // Each warm start costs as much as an average point of its sweep.
    let times = |at: usize| 1.0 + warm[at].len() as f64 / parts[at].1.points.len() as f64;
    let whole: f64 = parts.iter().enumerate().map(|(at, (_, sweep))| cost(sweep) * times(at)).sum();
    let mut before = 0.0;
    for (at, (part, sweep)) in parts.iter().enumerate() {
        let folder = out.join(part.name);
        claim(&disk, sweep, &folder)?;
        let points: Vec<_> = sweep.points.iter().collect();
        let mut manner = SweepOptions {
            start,
            disk: &disk,
            memory: free_memory(),
            runs: Options {
                command: &recovery::typed(),
                stop: &signals.stop,
                save: &signals.save,
                instead: &mut |error| args.loss.instead(error),
                setback: &mut recovery::setback,
                watch: &mut |_| {},
            },
            watch: &mut |now| {
                let share = now.played as f64 / now.total.max(1) as f64;
                meter.show((before + share * cost(sweep)) / whole, || {
                    format!("{}: {}/{} experiments done", part.name, now.done, now.points)
                });
            },
            note: &mut |point, note| {
                if note.is_damage() {
                    say(format_args!("{}: {note}", sweep.describe(point)));
                }
            },
        };
        if run::run(&points, &folder, &mut player, &mut manner)? == Ended::Stopped {
            meter.clear();
            return Err(stopped());
        }
        before += cost(sweep);
        if warm[at].is_empty() {
            continue;
        }
        let runs = warm[at].iter().map(|run| {
            Ok((run.config.clone(), run.folder.clone(), Some(policies::read_init(&run.policies, &run.config)?)))
        });
        let (mut session, _) = Session::open_from(runs.collect::<Result<_, RecordError>>()?, start, &disk)?;
        let mut options = Options {
            command: &recovery::typed(),
            stop: &signals.stop,
            save: &signals.save,
            instead: &mut |error| args.loss.instead(error),
            setback: &mut recovery::setback,
            watch: &mut |_| meter.show(before / whole, || format!("{}: warm starts", part.name)),
        };
        if !session.is_done() && session.train(&mut player, &mut options)? == Ended::Stopped {
            meter.clear();
            return Err(stopped());
        }
        before += cost(sweep) * (times(at) - 1.0);
    }

    let mut answers: Vec<(OpenQuestion, Vec<Answer>)> = Vec::new();
    for question in QUESTIONS.iter().filter(|question| args.questions.contains(&question.letter)) {
        let mut of_parts = Vec::new();
        for part in question.parts {
            if signals.stop.load(Relaxed) {
                meter.clear();
                return Err(stopped());
            }
            let sweep = parts.iter().find(|(other, _)| other.name == part.name).map(|(_, sweep)| sweep);
            let Some(sweep) = sweep else { continue };
            meter.show(1.0, || format!("comparing {}", part.name));
            let answer = part.answer(sweep, out, &mut *player.0)?;
            for kind in Format::ALL {
                let path = out.join(format!("{}.{}", part.name, kind.extension()));
                let bytes = answer.scene().file(kind, PRINT);
                write(&disk, &path, bytes)?;
            }
            let mut csv = Vec::new();
            let all: Vec<_> = answer.comparisons().cloned().collect();
            let path = out.join(format!("{}.csv", part.name));
            write(&disk, &path, comparison::csv(&all, &mut csv).map(|()| csv))?;
            of_parts.push(answer);
        }
        answers.push((*question, of_parts));
    }
    meter.clear();
    let first = &parts[0].1.points[0].config.learning;
    let heading = format!(
        "Means over {} trials of seed {} with 95 % bootstrap intervals; p by Mann and Whitney's test, two-sided, by Holm's\n\
         correction for all pairs of arms at one place.\n",
        first.trials, first.seed
    );
    let page = questions::page(&answers, &heading);
    write(&disk, &out.join(PAGE), Ok(page.clone().into_bytes()))?;
    if args.json {
        let all = answers.iter().map(|(question, answers)| {
            let comparisons: Vec<_> = answers.iter().flat_map(Answer::comparisons).collect();
            json!({ "letter": question.letter, "title": question.title, "comparisons": comparisons })
        });
        let told = json!({
            "folder": out.escaped().to_string(),
            "seed": first.seed,
            "trials": first.trials,
            "questions": all.collect::<Vec<_>>(),
            "page": out.join(PAGE).escaped().to_string(),
        });
        return print_json(&told);
    }
    print(&format!(
        "{page}\nFiles in {}: {PAGE}, for each table its figure (.svg, .png, .pdf) and every comparison (.csv), and the sweep \
         that it is of, in a folder\n",
        out.escaped()
    ))
}

fn write(disk: &Disk, path: &Path, bytes: std::io::Result<Vec<u8>>) -> Result<(), Error> {
    let bytes = bytes.map_err(|error| RecordError::Write { path: path.into(), error })?;
    Ok(ownership::publish(disk, path, |output| output.write_all(&bytes))?)
}
