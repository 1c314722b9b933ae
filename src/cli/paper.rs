//! `flotilla paper`: trains the paper's experiments, draws its figures and checks its claims.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

use serde_json::json;

use super::recovery::{self, Checkpoints, Loss, Signals};
use super::{Error, Overrides, RunOptions, backend, number, print, print_json, say};
use crate::baseline::Baselines;
use crate::config::{self, Override};
use crate::escape::PathExt;
use crate::memory;
use crate::record::RecordError;
use crate::record::digests::Verification;
use crate::record::disk::Disk;
use crate::record::folder::{self, ARMS, Folder, PAPER, POINTS, SWEEP, Start, StartFrom};
use crate::record::ownership;
use crate::report::curves::PRINT;
use crate::report::paper::{self, Evidence, Experiment, Summary, Trajectory, claims, tables};
use crate::report::progress::{Board, Meter};
use crate::report::runs;
use crate::report::scene::Format;
use crate::run::{self, Ended, Options, RunError, Session, Twin};
use crate::shell;
use crate::sweep::questions::letter;
use crate::trainer::Row;

/// The results in a paper's folder, for people and for programs.
const CLAIMS: &str = "claims.md";
const SUMMARY: &str = "summary.json";

/// The default folder of a paper.
const OUT: &str = "paper";

#[derive(clap::Args)]
pub struct Args {
    /// Folder for the figures, the claims and the curves
    #[arg(long, short, value_name = "DIR", default_value = OUT)]
    pub(super) out: PathBuf,
    /// Instead of the paper's experiments, train what answers the questions that it leaves open, or =a,c some of them
    /// (docs/results/questions.md)
    #[arg(long, value_name = "LETTERS", num_args = 0..=1, require_equals = true, value_delimiter = ',',
        default_missing_value = "a,b,c,d,e,f,g", value_parser = letter)]
    pub(super) questions: Vec<char>,
    /// Independent repetitions [default: 5, or 30 of questions]
    #[arg(long, value_name = "N", value_parser = number)]
    trials: Option<String>,
    /// Generations after generation 0, which is random [default: 100, or what a question's config says]
    #[arg(long, value_name = "N", value_parser = number)]
    generations: Option<String>,
    /// Random seed [default: 0]
    #[arg(long, value_name = "N", value_parser = number)]
    seed: Option<String>,
    /// Resume the paper in the directory, or start it; for a finished one, draw figures and claims again
    #[arg(long, conflicts_with = "force")]
    pub(super) resume: bool,
    /// Write over the paper in the folder
    #[arg(long)]
    pub(super) force: bool,
    /// No progress on standard error
    #[arg(long, short)]
    pub(super) quiet: bool,
    /// Print the results as one JSON object (docs/reference/json.md)
    #[arg(long)]
    pub(super) json: bool,
    #[command(flatten)]
    checkpoints: Checkpoints,
    #[command(flatten)]
    pub(super) loss: Loss,
    #[command(flatten)]
    pub(super) run: RunOptions,
}

impl Args {
    pub(super) fn overrides(&self) -> Vec<Override> {
        let Args { seed, trials, generations, .. } = self;
        let [seed, trials, generations] = [seed, trials, generations].map(Clone::clone);
        let overrides = Overrides { seed, trials, generations, ..Overrides::default() };
        [overrides.list(), self.checkpoints.list()].concat()
    }

    /// Returns whether the user chose the folder.
    pub(super) fn is_out_named(&self) -> bool {
        self.out != Path::new(OUT)
    }

    /// Returns what to do with a paper that is in the folder.
    pub(super) fn start(&self) -> Start {
        match (self.resume, self.force) {
            (true, _) => Start::Resume,
            (_, true) => Start::Force,
            _ => Start::Fresh,
        }
    }

    /// Returns the command that resumes the paper.
    pub(super) fn command_to_resume(&self) -> String {
        let (overrides, out) = (self.overrides(), shell::argument(&self.out));
        let letters: Vec<String> = self.questions.iter().map(char::to_string).collect();
        let questions = (!letters.is_empty()).then(|| format!("--questions={}", letters.join(",")).into());
        let words = ["flotilla", "paper"].map(OsString::from).into_iter().chain(questions);
        let words = words.chain(["--out".into(), out]);
        let machine = recovery::words_of_machine(&self.run, self.loss);
        shell::command(words.chain(recovery::words_of(&overrides)).chain(["--resume".into()]).chain(machine))
    }
}

/// Trains the experiments side by side, each as a run, and writes figures, claims and summary.
pub fn run(args: Args) -> Result<(), Error> {
    let Args { ref out, quiet, .. } = args;
    let mut arms = paper::arms(&args.overrides())?;
    let start = args.start();
    let marks = Marks::of(&arms[0].config.learning);
    marks.compare(out, start)?;
    let mut player = backend::open(&args.run)?;
    let (configs, places) = paper::trained(&arms);
    let plan = memory::Peaks::of(&configs, rayon::current_num_threads());
    plan.check(player.1.backend == "gpu").map_err(RunError::from)?;
    let disk = Disk::default();
    disk.create_folder(out).map_err(|error| RecordError::Write { path: out.clone(), error })?;
    let disk = ownership::enter(&disk, out, args.is_out_named())?;
    let _lock = folder::lock(&disk, out)?;
    // Compared again, because another process could write here until the folder was locked.
    marks.compare(out, start)?;
    let folders: Vec<PathBuf> = arms.iter().map(|arm| out.join(ARMS).join(arm_name(arm))).collect();
    let configs_of_arms = arms.iter().map(|arm| &arm.config);
    folder::check(&disk, folders.iter().map(|path| &**path).zip(configs_of_arms), start)?;
    ownership::check(&disk, products().map(|name| out.join(name)))?;
    marks.claim(out, start, &disk)?;
    // Several arms can have the same config. Only the first of them is trained, and the others are copies.
    let trained: Vec<usize> =
        (0..configs.len()).filter_map(|place| places.iter().position(|at| *at == place)).collect();
    let runs: Vec<_> = configs.iter().cloned().zip(trained.iter().map(|&arm| folders[arm].clone())).collect();
    let signals = Signals::listen()?;
    let (mut session, notes) = Session::open(runs, start, &disk)?;
    for (run, note) in notes.iter().filter(|(_, note)| note.is_damage()) {
        say(format_args!("{}: {note}", arms[trained[*run]].name()));
    }
    let twins: Vec<usize> = (0..arms.len()).filter(|&arm| trained[places[arm]] != arm).collect();
    if start == Start::Force {
        // Old results are removed now, so that none are left if this run is stopped.
        for &arm in &twins {
            Folder::open(&folders[arm], start, &arms[arm].config, StartFrom::Random, disk.clone())?;
        }
    }
    let learning = arms[0].config.learning.clone();
    if !session.is_done() {
        if !quiet {
            let (count, different, trials) = (arms.len(), configs.len(), learning.trials);
            let on = player.0.describe();
            say(format_args!(
                "training {count} experiments, {different} of them different, of {trials} trials each on {on}, into {}",
                out.escaped()
            ));
        }
        let names = arms.iter().map(|arm| (arm.name(), Some(arm.pois()))).collect();
        let next = |generations: &[usize]| generations.iter().min().copied().unwrap_or(0);
        let mut progress = Board::new(names, next(session.generations()), learning.generations, quiet);
        let of_arms = |row: &Row| {
            let (row, places) = (*row, places.iter().enumerate());
            places.filter(move |&(_, &place)| place == row.arm).map(move |(arm, _)| Row { arm, ..row })
        };
        let ended = session.train(
            &mut player,
            &mut Options {
                command: &recovery::typed(),
                stop: &signals.stop,
                save: &signals.save,
                instead: &mut |error| args.loss.instead(error),
                setback: &mut recovery::setback,
                watch: &mut |now| {
                    let rows: Vec<Row> = now.rows.iter().flat_map(of_arms).collect();
                    progress.show(next(now.generations), &rows);
                },
            },
        );
        progress.clear();
        if ended? == Ended::Stopped {
            return Err(Error::Stopped(format!(
                "before generation {} of {}, with everything saved; go on with\n  {}",
                next(session.generations()),
                learning.generations,
                args.command_to_resume()
            )));
        }
    }
    let twins = twins.into_iter().map(|arm| Twin {
        of: folders[trained[places[arm]]].clone(),
        of_config: configs[places[arm]].clone(),
        folder: folders[arm].clone(),
        config: arms[arm].config.clone(),
    });
    run::record_twins(twins.collect(), Start::Resume, &disk)?;
    for (arm, folder) in arms.iter_mut().zip(&folders) {
        let config = arm.config.clone();
        runs::metrics(folder, &config, Verification::Required, |row| arm.add(row))?;
    }
    let mut baselines = Baselines::new(paper::grounds(&arms));
    let mut meter = Meter::new(quiet);
    while !baselines.is_done() {
        if signals.stop.load(Relaxed) {
            meter.clear();
            return Err(Error::Stopped(format!(
                "before all that needs no learning was played, with every run done; go on with\n  {}",
                args.command_to_resume()
            )));
        }
        if let Err(error) = baselines.advance(&mut *player.0) {
            player = args.loss.instead(&error).ok_or(error)?;
            continue;
        }
        let (generation, last) = (baselines.generation(), learning.generations);
        let part = generation as f64 / (last + 1) as f64;
        meter.show(part, || format!("playing random teams: generation {generation} of {last}"));
    }
    meter.clear();
    let baselines = baselines.found();
    let found = Evidence { arms: &arms, baselines: &baselines };
    let ran = (0..configs.len()).map(|run| session.run(run));
    let seconds = ran.map(|run| run.seconds).fold(0.0, f64::max);

    let failed = |path: &Path| {
        let path = path.to_path_buf();
        |error| RecordError::Write { path, error }
    };
    let write = |name: String, content: &[u8]| -> Result<(), Error> {
        Ok(ownership::publish(&disk, &out.join(name), |output| output.write_all(content))?)
    };
    for (index, layout) in paper::LAYOUTS.iter().enumerate() {
        let Some(number) = layout.figure else { continue };
        let scene = paper::figure(found, index).scene();
        for kind in Format::ALL {
            let name = format!("figure{number}.{}", kind.extension());
            let picture = scene.file(kind, PRINT).map_err(failed(&out.join(&name)))?;
            write(name, &picture)?;
        }
    }
    let claims = claims::claims(found);
    let baseline = tables::without_learning(found);
    let heading = tables::heading(&learning, &claims);
    let full = tables::full(&claims);
    write(CLAIMS.into(), tables::page(&baseline, &heading, &full).as_bytes())?;
    let summary = Summary {
        version: env!("CARGO_PKG_VERSION"),
        backend: session.run(0).description.clone(),
        seconds,
        seed: learning.seed,
        trials: learning.trials,
        generations: learning.generations,
        curves: Trajectory::all(found),
        claims: &claims,
    };
    let summary = serde_json::to_string(&summary).expect("plain fields are JSON") + "\n";
    write(SUMMARY.into(), summary.as_bytes())?;
    if args.json {
        let arm = |(index, arm): (usize, &Experiment)| {
            let last = arm.best.iter().filter_map(|trial| trial.last()).sum::<f64>() / arm.best.len() as f64;
            json!({
                "name": arm_name(arm),
                "folder": folders[index].escaped().to_string(),
                "layout": arm.layout.name,
                "paradigm": arm.paradigm,
                "actions": arm.config.policy.actions,
                "fitness": arm.fitness,
                "pois": arm.pois(),
                "digest": session.results(places[index]).map(|results| &results.digest),
                "best_g": last,
            })
        };
        let path = |name: &str| out.join(name).escaped().to_string();
        let told = json!({
            "folder": out.escaped().to_string(),
            "seed": learning.seed,
            "trials": learning.trials,
            "generations": learning.generations,
            "backend": session.run(0).description,
            "seconds": seconds,
            "arms": arms.iter().enumerate().map(arm).collect::<Vec<_>>(),
            "claims": &claims,
            "files": { "claims": path(CLAIMS), "summary": path(SUMMARY), "figures": FIGURES.map(path) },
        });
        return print_json(&told);
    }
    print(&format!(
        "{baseline}\n{}\n{heading}\n\nTrained in {seconds:.1} s. Files in {}: figure4, figure5, figure6 (.svg, .png, .pdf), \
         claims.md (with every figure), summary.json, and a run each in {ARMS}/\n",
        tables::verdicts(&claims),
        out.escaped()
    ))
}

/// File names of the figures.
const FIGURES: [&str; 9] = [
    "figure4.svg",
    "figure4.png",
    "figure4.pdf",
    "figure5.svg",
    "figure5.png",
    "figure5.pdf",
    "figure6.svg",
    "figure6.png",
    "figure6.pdf",
];

/// Returns the names of all files that are made from the runs.
fn products() -> impl Iterator<Item = &'static str> {
    [CLAIMS, SUMMARY].into_iter().chain(FIGURES)
}

/// Returns the name of an arm's folder, such as `chaotic-all-leaders-Df`.
fn arm_name(arm: &Experiment) -> String {
    arm.name().replace(", ", "-").replace(' ', "-")
}

/// The keys that all arms of a paper have in common, as recorded in its folder.
struct Marks([(&'static str, u64); 3]);

impl Marks {
    fn of(learning: &config::Learning) -> Marks {
        let generations = learning.generations as u64;
        Marks([("seed", learning.seed), ("trials", learning.trials as u64), ("generations", generations)])
    }

    fn text(&self) -> String {
        self.0.iter().map(|(key, value)| format!("{key} = {value}\n")).collect()
    }

    /// Refuses a folder with other content.
    fn compare(&self, out: &Path, start: Start) -> Result<(), Error> {
        if out.is_file() {
            return Err(RecordError::NoFolder { path: out.into() }.into());
        }
        let (name, holds) = (out.escaped(), |name: &str| out.join(name).exists());
        let like_ours = [ARMS, CLAIMS, SUMMARY].iter().chain(&FIGURES).find(|name| holds(name));
        let what = match () {
            () if holds(PAPER) => "a paper",
            () if [SWEEP, POINTS].into_iter().any(holds) => "a sweep",
            () if folder::holds_run(out)? => "a run",
            () => match like_ours {
                None => return Ok(()),
                Some(theirs) => {
                    return Err(Error::Refused(format!(
                        "{name} holds {theirs}, but no {PAPER}, which would say that it is a paper's; choose another --out"
                    )));
                }
            },
        };
        match start {
            Start::Force if what == "a paper" => self.compare_mark(out),
            Start::Fresh if what == "a paper" => Err(Error::Refused(format!(
                "{name} holds a paper already; go on with it by --resume, write over it by --force, or choose another --out"
            ))),
            Start::Resume if what == "a paper" => self.compare_paper(out),
            _ => Err(Error::Refused(format!("{name} holds {what}, no paper; choose another --out"))),
        }
    }

    /// Refuses a folder whose `paper.toml` was not made by flotilla.
    fn compare_mark(&self, out: &Path) -> Result<(), Error> {
        let path = out.join(PAPER);
        let there: Option<toml::Table> = config::read_file(&path)?.parse().ok();
        let like_ours = there.is_some_and(|there| self.0.iter().all(|(key, _)| there.contains_key(*key)));
        match like_ours || out.join(ARMS).is_dir() {
            true => Ok(()),
            false => Err(RecordError::NotOurs { path }.into()),
        }
    }

    /// Refuses to resume another paper. Only the number of generations may be larger than before.
    fn compare_paper(&self, out: &Path) -> Result<(), Error> {
        let path = out.join(PAPER);
        let text = config::read_file(&path)?;
        let there: toml::Table = text.parse().map_err(|error: toml::de::Error| RecordError::Damaged {
            path: path.clone(),
            reason: format!("it is damaged: {}; write over the paper by --force", error.message()),
        })?;
        let differs = |&(key, here): &(&str, u64)| {
            let there = there.get(key).and_then(toml::Value::as_integer).and_then(|there| u64::try_from(there).ok());
            match there {
                Some(there) if there == here || key == "generations" && there < here => None,
                Some(there) => Some(format!("\n  {key}: {there} there, {here} here")),
                None => Some(format!("\n  {key}: nothing there, {here} here")),
            }
        };
        let differences: String = self.0.iter().filter_map(differs).collect();
        if differences.is_empty() {
            return Ok(());
        }
        Err(Error::Refused(format!(
            "{} holds another paper; what differs:{differences}\ngo on with its own flags (generations may be more), or choose \
             another --out",
            out.escaped()
        )))
    }

    /// Marks the folder as this paper's. `Start::Force` first removes what was made from earlier runs.
    fn claim(&self, out: &Path, start: Start, disk: &Disk) -> Result<(), Error> {
        let failed = |path: &Path| {
            let path = path.to_path_buf();
            |error| RecordError::Write { path, error }
        };
        if start == Start::Force {
            products().try_for_each(|name| ownership::withdraw(disk, &out.join(name)))?;
        }
        let path = out.join(PAPER);
        Ok(disk.replace(&path, |output| output.write_all(self.text().as_bytes())).map_err(failed(&path))?)
    }
}
