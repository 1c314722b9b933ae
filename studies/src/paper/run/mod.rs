//! Trains the paper's experiments, draws its figures and checks its claims.

use std::fs::File;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::paper::claims::Claim;
use crate::paper::{self, Evidence, Experiment, Summary, Trajectory, claims, tables};
use flotilla::backend::OpenBackend;
use flotilla::baseline::{Baseline, Baselines};
use flotilla::config::{Actions, Config, Fitness, Override, Paradigm, ValidConfig};
use flotilla::escape::PathExt;
use flotilla::memory;
use flotilla::parallel::current_num_threads;
use flotilla_app::choice::Work;
use flotilla_app::ops::{BackendSource, Context, Error, Event, ProcessorInfo, with_remedy};
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{self, Start};
use flotilla_app::record::{RecordError, ownership};
use flotilla_app::report::scene::Format;
use flotilla_app::run::RunError;

mod experiments;
mod identity;

use experiments::Experiments;
use identity::Identity;

/// The results in a paper's folder, for people and for programs.
const CLAIMS: &str = "claims.md";
const SUMMARY: &str = "summary.json";

/// The default folder of a paper.
pub const OUT: &str = "paper";

/// Request to train the paper's experiments.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Request {
    /// The folder for figures, claims and runs.
    pub out: PathBuf,
    /// Treatment of a paper that is in the folder.
    pub start: Start,
    /// Config keys to set in all experiments.
    #[serde(default)]
    pub set: Vec<Override>,
    /// Letters of the open questions. Only [`crate::questions`] uses them.
    #[serde(default)]
    pub questions: Vec<char>,
    /// Names of layouts. Only [`crate::populations`] uses them.
    #[serde(default)]
    pub populations: Vec<String>,
    /// Names of layouts. Only [`crate::influence`] uses them.
    #[serde(default)]
    pub influence: Vec<String>,
}

impl Request {
    /// Reports whether the user chose the folder.
    pub fn is_out_named(&self) -> bool {
        self.out != Path::new(OUT)
    }

    /// Opens and locks the folder of a study that is not the paper. A new study does not replace `files`, its results.
    pub(crate) fn open_folder(&self, files: impl Iterator<Item = String>) -> Result<(Disk, Option<File>), Error> {
        let out = &self.out;
        let disk = ownership::create_output_folder(&Disk::default(), out, self.is_out_named())?;
        let lock = folder::lock(&disk, out)?;
        let files: Vec<String> = files.collect();
        ownership::check(&disk, files.iter().map(|name| out.join(name)))?;
        match files.iter().find(|name| self.start == Start::Fresh && out.join(name).exists()) {
            Some(name) => Err(Error::Refused(with_remedy(
                format!("{} holds {name} already", out.escaped()),
                "pass --resume to continue the study or --force to overwrite it, or choose another --out",
            ))),
            None => Ok((disk, lock)),
        }
    }
}

/// Returns the error for a folder that holds something other than a study's results.
pub(crate) fn holds(out: &Path, what: &str) -> Error {
    Error::Refused(with_remedy(format!("{} holds {what}", out.escaped()), "choose another --out"))
}

/// Refuses the folder of a paper, a sweep or a run.
pub(crate) fn check_folder(out: &Path) -> Result<(), Error> {
    let is_run = folder::holds_run(out)?;
    folder::collection(out).or(is_run.then_some("a run")).map_or(Ok(()), |what| Err(holds(out, what)))
}

/// Fails if a config has fewer trials than intervals and tests need.
pub(crate) fn check_trials<'a>(configs: impl IntoIterator<Item = &'a Config>) -> Result<(), Error> {
    match configs.into_iter().map(|config| config.learning.trials).find(|&trials| trials < 2) {
        None => Ok(()),
        Some(trials) => {
            Err(Error::Usage(format!("--trials {trials}: intervals and tests take two trials or more").into()))
        }
    }
}

#[derive(Clone, Debug, Serialize)]
pub struct ExperimentOutcome {
    /// The name, which is that of its folder.
    pub name: String,
    pub folder: String,
    pub layout: &'static str,
    /// Who learns.
    pub paradigm: Paradigm,
    /// The kind of actions that policies choose.
    pub actions: Actions,
    /// The score that policies are selected by.
    pub fitness: Fitness,
    pub pois: usize,
    pub digest: Option<String>,
    /// The mean over trials of G of the last generation's champion.
    pub champion_g: f64,
    /// The same of the last generation's best team.
    pub best_g: f64,
}

impl ExperimentOutcome {
    fn of(experiment: &Experiment, folder: &Path, digest: Option<String>) -> ExperimentOutcome {
        let last =
            |trials: &[Vec<f64>]| trials.iter().filter_map(|trial| trial.last()).sum::<f64>() / trials.len() as f64;
        ExperimentOutcome {
            name: folder_name(experiment),
            folder: folder.escaped(),
            layout: experiment.layout.name,
            paradigm: experiment.paradigm,
            actions: experiment.config.policy.actions,
            fitness: experiment.fitness,
            pois: experiment.pois(),
            digest,
            champion_g: last(&experiment.champion),
            best_g: last(&experiment.best),
        }
    }
}

#[derive(Clone, Debug, Serialize)]
pub struct Files {
    /// The claims with every figure.
    pub claims: String,
    /// The curves and claims for programs.
    pub summary: String,
    pub figures: Vec<String>,
}

/// Results of the paper's experiments.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    pub folder: String,
    /// The random seed of all experiments.
    pub seed: u64,
    /// The number of trials of each.
    pub trials: usize,
    /// The last generation.
    pub generations: usize,
    /// The processor of the last session.
    #[serde(flatten)]
    pub processor: ProcessorInfo,
    /// Training time in seconds, including earlier sessions.
    pub seconds: f64,
    pub arms: Vec<ExperimentOutcome>,
    /// The paper's claims with their verdicts.
    pub claims: Vec<Claim>,
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
    let Request { ref out, start, .. } = *request;
    let mut experiments = Experiments::new(paper::arms(&request.set)?, out);
    let learning = experiments.all[0].config.learning.clone();
    let identity = Identity::of(&learning);
    identity.check(out, start)?;
    let (backend, on) = backends.open(Work::of(&experiments.configs))?;
    let plan = memory::Peaks::of(&ValidConfig::all(&experiments.configs)?, current_num_threads());
    plan.check(backend.1.backend == "gpu").map_err(RunError::from)?;
    let disk = ownership::create_output_folder(&Disk::default(), out, request.is_out_named())?;
    let _lock = folder::lock(&disk, out)?;
    // Checked again, because another process could write here until the folder was locked.
    identity.check(out, start)?;
    let configs = experiments.all.iter().map(|experiment| &experiment.config);
    folder::check(&disk, experiments.folders.iter().map(|path| &**path).zip(configs), start)?;
    ownership::check(&disk, products().map(|name| out.join(name)))?;
    // A new paper is marked first, so that it is recognised if it is stopped. A refused resume keeps the old mark.
    let resumes = start == Start::Resume && out.join(folder::PAPER).exists();
    if !resumes {
        identity.write(out, start, &disk)?;
    }
    let mut session = experiments.open(start, &disk, context)?;
    if resumes {
        identity.write(out, start, &disk)?;
    }
    if !session.is_done() {
        experiments.train(&mut session, backend, &on, out, context)?;
    }
    experiments.record_copies(&disk)?;
    experiments.read_metrics(&disk)?;
    let baselines = play_baselines(
        &ValidConfig::all(&paper::baseline_configs(&experiments.all))?,
        learning.generations,
        backend,
        context,
    )?;

    let found = Evidence { arms: &experiments.all, baselines: &baselines };
    let publish = |name: &str, content: &[u8]| ownership::publish_bytes(&disk, &out.join(name), content);
    for (index, layout) in paper::LAYOUTS.iter().enumerate() {
        let Some(number) = layout.figure else { continue };
        paper::figure(found, index).scene().publish(&disk, out, &format!("figure{number}"))?;
    }
    let claims = claims::claims(found);
    let baseline = tables::without_learning(found);
    const SHOWN: [&str; 3] = ["learning.seed", "learning.trials", "learning.generations"];
    let set = request.set.iter().filter(|set| !SHOWN.contains(&&*set.key));
    let set: Vec<String> = set.map(|set| format!("{} = {}", set.key, set.text)).collect();
    let changed = if set.is_empty() { String::new() } else { format!(" Changed keys: `{}`.", set.join("`, `")) };
    let heading = tables::heading(&learning, &claims) + &changed;
    let full = tables::full(&claims);
    publish(CLAIMS, tables::page(&baseline, &heading, &full).as_bytes())?;
    let seconds = (0..experiments.configs.len()).map(|run| session.run(run).seconds).fold(0.0, f64::max);
    let summary = Summary {
        version: flotilla::version::VERSION,
        backend: session.run(0).processor.backend.clone(),
        description: session.run(0).processor.description.clone(),
        seconds,
        seed: learning.seed,
        trials: learning.trials,
        generations: learning.generations,
        set,
        curves: Trajectory::all(found),
        claims: &claims,
    };
    let summary = serde_json::to_string(&summary).expect("plain fields are JSON") + "\n";
    publish(SUMMARY, summary.as_bytes())?;
    for folder in [&out.join(folder::ARMS), out] {
        disk.sync_folder(folder).map_err(RecordError::write(folder))?;
    }
    let digest = |index: usize| session.results(experiments.config_of[index]).map(|results| results.digest.clone());
    let outcome =
        |index: usize| ExperimentOutcome::of(&experiments.all[index], &experiments.folders[index], digest(index));
    let path = |name: &str| out.join(name).escaped();
    Ok(Outcome {
        folder: out.escaped(),
        seed: learning.seed,
        trials: learning.trials,
        generations: learning.generations,
        processor: session.run(0).processor.clone(),
        seconds,
        arms: (0..experiments.all.len()).map(outcome).collect(),
        files: Files {
            claims: path(CLAIMS),
            summary: path(SUMMARY),
            figures: figures().map(|name| path(&name)).collect(),
        },
        text: format!("{baseline}\n{}\n{heading}\n\n", tables::verdicts(&claims)),
        claims,
    })
}

/// Plays the baselines without learning of some configs, which have the same number of generations.
///
/// # Errors
/// The backend fails, or the user stops.
fn play_baselines(
    configs: &[ValidConfig],
    last: usize,
    backend: &mut OpenBackend,
    context: Context<'_>,
) -> Result<Vec<Baseline>, Error> {
    let mut baselines = Baselines::new(configs);
    while !baselines.is_done() {
        if context.is_stopped() {
            return Err(Error::Stopped("before the baselines were played; all runs are finished".into()));
        }
        if let Err(error) = baselines.advance(&mut *backend.0) {
            *backend = context.fallback(&error).ok_or(error)?;
            continue;
        }
        let generation = baselines.generation();
        let part = generation as f64 / (last + 1) as f64;
        (context.report)(Event::Fraction(part, format!("playing random teams: generation {generation} of {last}")));
    }
    (context.report)(Event::Pause);
    Ok(baselines.found())
}

/// Returns the file names of the figures.
fn figures() -> impl Iterator<Item = String> {
    let numbers = paper::LAYOUTS.into_iter().filter_map(|layout| layout.figure);
    numbers.flat_map(|number| Format::names(&format!("figure{number}")))
}

/// Returns the names of all files that are made from the runs.
fn products() -> impl Iterator<Item = String> {
    [CLAIMS, SUMMARY].map(String::from).into_iter().chain(figures())
}

/// Returns the name of an experiment's folder, such as `chaotic-all-leaders-Df`.
fn folder_name(experiment: &Experiment) -> String {
    experiment.name().replace(", ", "-").replace(' ', "-")
}
