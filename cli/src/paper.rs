//! `flotilla paper`: trains the paper's experiments, draws its figures and checks its claims.

use std::ffi::OsString;
use std::path::PathBuf;

use serde::Serialize;

use super::recovery::{self, Checkpoints};
use super::{Error, ExistingResults, Overrides, Printed, RunOptions, SetKeys, console, number};
use flotilla::config::Override;
use flotilla::escape::PathExt;
use flotilla_app::ops::{BackendSource, Context};
use flotilla_app::record::folder::ARMS;
use flotilla_app::shell;
use flotilla_studies::paper::run::{OUT, Request};
use flotilla_studies::questions::letter;
use flotilla_studies::{influence, paper, populations, questions};

#[derive(clap::Args)]
pub struct Args {
    /// Directory for the figures, the claims and the curves
    #[arg(long, short, value_name = "DIR", default_value = OUT)]
    out: PathBuf,
    /// Train the paper's open questions instead, or some of them: --questions=a,c (docs/results/questions.md)
    #[arg(long, value_name = "LETTERS", num_args = 0..=1, require_equals = true, value_delimiter = ',',
        default_missing_value = "a,b,c,d,e,f,g", value_parser = letter)]
    questions: Vec<char>,
    /// Vary followers and the number of populations instead, on all layouts or some of generally-forward, strictly-forward,
    /// chaotic, coupling-6 (docs/results/populations.md)
    #[arg(long, value_name = "LAYOUTS", num_args = 0..=1, require_equals = true, value_delimiter = ',',
        default_missing_value = "generally-forward,strictly-forward,chaotic,coupling-6",
        value_parser = one_of(&populations::LAYOUT_NAMES),
        conflicts_with = "questions")]
    populations: Vec<String>,
    /// Compare credits for rovers and UAVs instead, in all layouts or some of rover_uav, 3_rovers_1_uav, 3_rovers_3_uavs,
    /// 4_rovers_4_uavs, 3_rovers_3_uavs_random (docs/results/influence.md)
    #[arg(long, value_name = "LAYOUTS", num_args = 0..=1, require_equals = true, value_delimiter = ',',
        default_missing_value = "rover_uav,3_rovers_1_uav,3_rovers_3_uavs,4_rovers_4_uavs,3_rovers_3_uavs_random",
        value_parser = one_of(influence::LAYOUT_NAMES),
        conflicts_with_all = ["questions", "populations"])]
    influence: Vec<String>,
    /// Independent repetitions [default: 5, or 30 with --questions or --influence]
    #[arg(long, value_name = "N", value_parser = number)]
    trials: Option<String>,
    /// Number of generations after the random generation 0 [default: 100, or the study's own]
    #[arg(long, value_name = "N", value_parser = number)]
    generations: Option<String>,
    /// Random seed [default: 0]
    #[arg(long, value_name = "N", value_parser = number)]
    seed: Option<String>,
    #[command(flatten)]
    set: SetKeys,
    #[command(flatten)]
    existing: ExistingResults,
    #[command(flatten)]
    printed: Printed,
    #[command(flatten)]
    checkpoints: Checkpoints,
    #[command(flatten)]
    run: RunOptions,
}

/// Returns a parser of names.
fn one_of(names: &'static [&'static str]) -> impl Fn(&str) -> Result<String, String> + Clone + Send + Sync {
    move |text| match names.contains(&text) {
        true => Ok(text.into()),
        false => Err(format!("{text:?} is none of {}", names.join(", "))),
    }
}

impl Args {
    fn overrides(&self) -> Vec<Override> {
        let Args { seed, trials, generations, set, .. } = self;
        let [seed, trials, generations] = [seed, trials, generations].map(Clone::clone);
        let overrides = Overrides { seed, trials, generations, set: set.clone(), ..Overrides::default() };
        [overrides.list(), self.checkpoints.list()].concat()
    }

    /// Returns the command that resumes the paper.
    fn command_to_resume(&self) -> String {
        let (overrides, out) = (self.overrides(), shell::argument(&self.out));
        let letters: Vec<String> = self.questions.iter().map(char::to_string).collect();
        let studies = [("questions", &letters), ("populations", &self.populations), ("influence", &self.influence)];
        let study = |(name, chosen): (&str, &Vec<String>)| {
            (!chosen.is_empty()).then(|| format!("--{name}={}", chosen.join(",")).into())
        };
        let words = ["flotilla", "paper"].map(OsString::from).into_iter().chain(studies.into_iter().filter_map(study));
        let words = words.chain(["--out".into(), out]);
        let machine = recovery::words_of_machine(&self.run);
        shell::command(words.chain(recovery::words_of(&overrides)).chain(["--resume".into()]).chain(machine))
    }
}

/// A study: trains what a request asks for.
type Study<T> = fn(&Request, &mut dyn BackendSource, Context<'_>) -> Result<T, Error>;

pub fn run(args: Args) -> Result<(), Error> {
    let out = args.out.escaped();
    if !args.populations.is_empty() {
        return args.study(populations::run, |found| {
            format!(
                "{}\nFiles in {out}: populations (.svg, .png, .pdf), cells.csv, pairs.csv, and a run each in {ARMS}/\n",
                found.text
            )
        });
    }
    if !args.influence.is_empty() {
        return args.study(influence::run, |found| {
            format!(
                "{}\nFiles in {out}: baselines.csv, and of each layout its credits (LAYOUT.csv), every pair of them \
                 (LAYOUT_pairs.csv) and its sweep, in a folder\n",
                found.text
            )
        });
    }
    if !args.questions.is_empty() {
        return args.study(questions::run::run, |found| {
            format!(
                "{}\nFiles in {out}: questions.md, for each table its figure (.svg, .png, .pdf) and every comparison (.csv), and \
                 the sweep that it is of, in a folder\n",
                found.text
            )
        });
    }
    args.study(paper::run::run, |found| {
        format!(
            "{}Trained in {:.1} s. Files in {out}: figure4, figure5, figure6 (.svg, .png, .pdf), claims.md (with every \
             figure), summary.json, and a run each in {ARMS}/\n",
            found.text, found.seconds
        )
    })
}

impl Args {
    /// Runs a study, and prints its results. If it is stopped, advises how to continue.
    fn study<T: Serialize>(&self, study: Study<T>, text: impl FnOnce(&T) -> String) -> Result<(), Error> {
        let Args { out, questions, populations, influence, existing, printed, .. } = self;
        let request = Request {
            out: out.clone(),
            start: existing.start(),
            set: self.overrides(),
            questions: questions.clone(),
            populations: populations.clone(),
            influence: influence.clone(),
        };
        let found = console::run(&self.run, printed.quiet, |backends, context| study(&request, backends, context));
        let resume = |error: Error| error.or_advise(|| format!("continue with\n  {}", self.command_to_resume()));
        printed.outcome(&found.map_err(resume)?, text)
    }
}
