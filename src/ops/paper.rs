//! Trains the paper's experiments, draws its figures and checks its claims.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{BackendSource, Context, Error, Event, Processor, with_remedy};
use crate::baseline::Baselines;
use crate::choice::Work;
use crate::config::{self, Actions, Fitness, Override, Paradigm, ValidConfig};
use crate::escape::PathExt;
use crate::memory;
use crate::parallel::current_num_threads;
use crate::record::RecordError;
use crate::record::digests::Verification;
use crate::record::disk::Disk;
use crate::record::folder::{self, ARMS, Folder, PAPER, POINTS, SWEEP, Start, StartFrom};
use crate::record::ownership;
use crate::report::curves::PRINT;
use crate::report::paper::claims::Claim;
use crate::report::paper::{self, Evidence, Experiment, Summary, Trajectory, claims, tables};
use crate::report::runs;
use crate::report::scene::Format;
use crate::run::{self, RunError, Session, SessionEnd, Twin};
use crate::trainer::Row;

/// The results in a paper's folder, for people and for programs.
const CLAIMS: &str = "claims.md";
const SUMMARY: &str = "summary.json";

/// The default folder of a paper.
pub const OUT: &str = "paper";

/// Request to train the paper's experiments.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Request {
    /// The folder for figures, claims and runs.
    pub out: PathBuf,
    /// Treatment of a paper that is in the folder.
    pub start: Start,
    /// Config keys to set in all experiments.
    #[serde(default)]
    pub set: Vec<Override>,
    /// Letters of the open questions. Only [`super::questions`] uses them.
    #[serde(default)]
    pub questions: Vec<char>,
}

impl Request {
    /// Reports whether the user chose the folder.
    pub(super) fn is_out_named(&self) -> bool {
        self.out != Path::new(OUT)
    }
}

/// A trained experiment.
#[derive(Clone, Debug, Serialize)]
#[non_exhaustive]
pub struct ExperimentOutcome {
    /// The name, which is that of its folder.
    pub name: String,
    /// The run's folder.
    pub folder: String,
    /// The layout.
    pub layout: &'static str,
    /// Who learns.
    pub paradigm: Paradigm,
    /// The kind of actions that policies choose.
    pub actions: Actions,
    /// The score that policies are selected by.
    pub fitness: Fitness,
    /// The number of POIs.
    pub pois: usize,
    /// The run's digest.
    pub digest: Option<String>,
    /// The mean over trials of the last generation's best team, as G.
    pub best_g: f64,
}

/// The files that were written.
#[derive(Clone, Debug, Serialize)]
#[non_exhaustive]
pub struct Files {
    /// The claims with every figure.
    pub claims: String,
    /// The curves and claims for programs.
    pub summary: String,
    /// The pictures.
    pub figures: Vec<String>,
}

/// Results of the paper's experiments.
#[derive(Clone, Debug, Serialize)]
#[non_exhaustive]
pub struct Outcome {
    /// The folder.
    pub folder: String,
    /// The random seed of all experiments.
    pub seed: u64,
    /// The number of trials of each.
    pub trials: usize,
    /// The last generation.
    pub generations: usize,
    /// The processor of the last session.
    #[serde(flatten)]
    pub processor: Processor,
    /// Training time in seconds, including earlier sessions.
    pub seconds: f64,
    /// The experiments.
    pub arms: Vec<ExperimentOutcome>,
    /// The paper's claims with their verdicts.
    pub claims: Vec<Claim>,
    /// The files.
    pub files: Files,
    /// The tables for people.
    #[serde(skip)]
    pub text: String,
}

/// Trains the experiments side by side, each as a run, and writes figures, claims and summary.
///
/// # Errors
/// The folder or a config cannot be used, training fails or is stopped, or files cannot be written.
pub fn run(request: &Request, backends: &mut dyn BackendSource, context: Context<'_>) -> Result<Outcome, Error> {
    let Request { out, start, .. } = request;
    let start = *start;
    let mut arms = paper::arms(&request.set)?;
    let marks = Marks::of(&arms[0].config.learning);
    marks.compare(out, start)?;
    let (configs, places) = paper::trained(&arms);
    let (backend, on) = backends.open(Work::of(&configs))?;
    let plan = memory::Peaks::of(&ValidConfig::all(&configs)?, current_num_threads());
    plan.check(backend.1.backend == "gpu").map_err(RunError::from)?;
    let disk = ownership::create_output_folder(&Disk::default(), out, request.is_out_named())?;
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
    let (mut session, notes) = Session::open(runs, start, &disk)?;
    for (run, note) in notes.iter().filter(|(_, note)| note.is_damage()) {
        context.warn(format_args!("{}: {note}", arms[trained[*run]].name()));
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
        let (count, different, trials) = (arms.len(), configs.len(), learning.trials);
        context.message(format_args!(
            "training {count} experiments, {different} of them different, of {trials} trials each on {on}, into {}",
            out.escaped()
        ));
        let names = arms.iter().map(|arm| (arm.name(), Some(arm.pois()))).collect();
        let next = |generations: &[usize]| generations.iter().min().copied().unwrap_or(0);
        (context.report)(Event::Begin(names, next(session.generations()), learning.generations));
        let of_arms = |row: &Row| {
            let (row, places) = (*row, places.iter().enumerate());
            places
                .filter(move |&(_, &place)| place == row.experiment)
                .map(move |(arm, _)| Row { experiment: arm, ..row })
        };
        let mut watch = |now: &run::Progress<'_>| {
            let rows: Vec<Row> = now.rows.iter().flat_map(of_arms).collect();
            context.rows(next(now.generations), &rows);
        };
        let ended = context.train(&mut watch, |options| session.train(backend, options));
        (context.report)(Event::Pause);
        if ended? == SessionEnd::Stopped {
            return Err(Error::Stopped(
                format!(
                    "before generation {} of {}, with everything saved",
                    next(session.generations()),
                    learning.generations
                )
                .into(),
            ));
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
    let mut baselines = Baselines::new(paper::baseline_configs(&arms));
    while !baselines.is_done() {
        if context.is_stopped() {
            return Err(Error::Stopped("before all that needs no learning was played, with every run done".into()));
        }
        if let Err(error) = baselines.advance(&mut *backend.0) {
            *backend = context.fallback(&error).ok_or(error)?;
            continue;
        }
        let (generation, last) = (baselines.generation(), learning.generations);
        let part = generation as f64 / (last + 1) as f64;
        (context.report)(Event::Fraction(part, format!("playing random teams: generation {generation} of {last}")));
    }
    (context.report)(Event::Pause);
    let baselines = baselines.found();
    let found = Evidence { arms: &arms, baselines: &baselines };
    let ran = (0..configs.len()).map(|run| session.run(run));
    let seconds = ran.map(|run| run.seconds).fold(0.0, f64::max);

    let write = |name: String, content: &[u8]| -> Result<(), Error> {
        Ok(ownership::publish(&disk, &out.join(name), |output| output.write_all(content))?)
    };
    for (index, layout) in paper::LAYOUTS.iter().enumerate() {
        let Some(number) = layout.figure else { continue };
        let scene = paper::figure(found, index).scene();
        for kind in Format::ALL {
            let name = format!("figure{number}.{}", kind.extension());
            let picture = scene.file(kind, PRINT).map_err(RecordError::write(&out.join(&name)))?;
            write(name, &picture)?;
        }
    }
    let claims = claims::claims(found);
    let baseline = tables::without_learning(found);
    let heading = tables::heading(&learning, &claims);
    let full = tables::full(&claims);
    write(CLAIMS.into(), tables::page(&baseline, &heading, &full).as_bytes())?;
    let summary = Summary {
        version: crate::version::VERSION,
        backend: session.run(0).backend.clone(),
        description: session.run(0).description.clone(),
        seconds,
        seed: learning.seed,
        trials: learning.trials,
        generations: learning.generations,
        curves: Trajectory::all(found),
        claims: &claims,
    };
    let summary = serde_json::to_string(&summary).expect("plain fields are JSON") + "\n";
    write(SUMMARY.into(), summary.as_bytes())?;
    let arm = |(index, arm): (usize, &Experiment)| ExperimentOutcome {
        name: arm_name(arm),
        folder: folders[index].escaped().to_string(),
        layout: arm.layout.name,
        paradigm: arm.paradigm,
        actions: arm.config.policy.actions,
        fitness: arm.fitness,
        pois: arm.pois(),
        digest: session.results(places[index]).map(|results| results.digest.clone()),
        best_g: arm.best.iter().filter_map(|trial| trial.last()).sum::<f64>() / arm.best.len() as f64,
    };
    let path = |name: &str| out.join(name).escaped().to_string();
    Ok(Outcome {
        folder: out.escaped().to_string(),
        seed: learning.seed,
        trials: learning.trials,
        generations: learning.generations,
        processor: Processor::of_run(session.run(0)),
        seconds,
        arms: arms.iter().enumerate().map(arm).collect(),
        files: Files { claims: path(CLAIMS), summary: path(SUMMARY), figures: FIGURES.map(path).to_vec() },
        text: format!("{baseline}\n{}\n{heading}\n\n", tables::verdicts(&claims)),
        claims,
    })
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
                    return Err(Error::Refused(with_remedy(
                        format!("{name} holds {theirs}, but no {PAPER}, which would say that it is a paper's"),
                        "choose another --out",
                    )));
                }
            },
        };
        match start {
            Start::Force if what == "a paper" => self.compare_mark(out),
            Start::Fresh if what == "a paper" => Err(Error::Refused(with_remedy(
                format!("{name} holds a paper already"),
                "pass --resume to continue it or --force to overwrite it, or choose another --out",
            ))),
            Start::Resume if what == "a paper" => self.compare_paper(out),
            _ => Err(Error::Refused(with_remedy(format!("{name} holds {what}, no paper"), "choose another --out"))),
        }
    }

    /// Refuses a folder whose `paper.toml` was not made by flotilla.
    fn compare_mark(&self, out: &Path) -> Result<(), Error> {
        let path = out.join(PAPER);
        let existing: Option<toml::Table> = config::read_file(&path)?.parse().ok();
        let like_ours = existing.is_some_and(|existing| self.0.iter().all(|(key, _)| existing.contains_key(*key)));
        match like_ours || out.join(ARMS).is_dir() {
            true => Ok(()),
            false => Err(RecordError::NotOurs { path }.into()),
        }
    }

    /// Refuses to resume another paper. Only the number of generations may be larger than before.
    fn compare_paper(&self, out: &Path) -> Result<(), Error> {
        let path = out.join(PAPER);
        let text = config::read_file(&path)?;
        let existing: toml::Table = text.parse().map_err(|error: toml::de::Error| RecordError::Damaged {
            path: path.clone(),
            reason: format!("it is damaged: {}; write over the paper by --force", error.message()),
        })?;
        let differs = |&(key, requested): &(&str, u64)| {
            let found = existing.get(key).and_then(toml::Value::as_integer).and_then(|found| u64::try_from(found).ok());
            match found {
                Some(found) if found == requested || key == "generations" && found < requested => None,
                Some(found) => Some(format!("\n  {key}: {found} there, {requested} here")),
                None => Some(format!("\n  {key}: nothing there, {requested} here")),
            }
        };
        let differences: String = self.0.iter().filter_map(differs).collect();
        if differences.is_empty() {
            return Ok(());
        }
        Err(Error::Refused(with_remedy(
            format!("{} holds another paper; what differs:{differences}", out.escaped()),
            "use its own flags (generations may be more), or choose another --out",
        )))
    }

    /// Marks the folder as this paper's. `Start::Force` first removes what was made from earlier runs.
    fn claim(&self, out: &Path, start: Start, disk: &Disk) -> Result<(), Error> {
        if start == Start::Force {
            products().try_for_each(|name| ownership::remove_published(disk, &out.join(name)))?;
        }
        let path = out.join(PAPER);
        Ok(disk.replace(&path, |output| output.write_all(self.text().as_bytes())).map_err(RecordError::write(&path))?)
    }
}
