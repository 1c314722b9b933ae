//! `flotilla paper`: trains the paper's experiments, draws its figures and checks its claims.

use std::ffi::OsString;
use std::path::PathBuf;

use super::console::Console;
use super::recovery::{self, Checkpoints};
use super::{Error, ExistingResults, Overrides, Printed, RunOptions, SetKeys, number};
use flotilla::config::Override;
use flotilla::escape::PathExt;
use flotilla_app::record::folder::ARMS;
use flotilla_app::shell;
use flotilla_studies::paper::run::{OUT, Request};
use flotilla_studies::populations::layout;
use flotilla_studies::questions::letter;

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
        default_missing_value = "generally-forward,strictly-forward,chaotic,coupling-6", value_parser = layout,
        conflicts_with = "questions")]
    populations: Vec<String>,
    /// Independent repetitions [default: 5, or 30 with --questions]
    #[arg(long, value_name = "N", value_parser = number)]
    trials: Option<String>,
    /// Number of generations after the random generation 0 [default: 100, or the question's own]
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
        let questions = (!letters.is_empty()).then(|| format!("--questions={}", letters.join(",")).into());
        let words = ["flotilla", "paper"].map(OsString::from).into_iter().chain(questions);
        let layouts =
            (!self.populations.is_empty()).then(|| format!("--populations={}", self.populations.join(",")).into());
        let words = words.chain(layouts).chain(["--out".into(), out]);
        let machine = recovery::words_of_machine(&self.run);
        shell::command(words.chain(recovery::words_of(&overrides)).chain(["--resume".into()]).chain(machine))
    }
}

pub fn run(args: Args) -> Result<(), Error> {
    let mut console = Console::new(&args.run, args.printed.quiet);
    let (set, start) = (args.overrides(), args.existing.start());
    let (questions, populations) = (args.questions.clone(), args.populations.clone());
    let request = Request { out: args.out.clone(), start, set, questions, populations };
    let resume = |error: Error| error.or_advise(|| format!("continue with\n  {}", args.command_to_resume()));
    let out = args.out.escaped();
    if !args.populations.is_empty() {
        let found = console
            .run(|backends, context| flotilla_studies::populations::run(&request, backends, context))
            .map_err(resume)?;
        return args.printed.outcome(&found, |found| {
            format!(
                "{}\nFiles in {out}: populations (.svg, .png, .pdf), cells.csv, pairs.csv, and a run each in {ARMS}/\n",
                found.text
            )
        });
    }
    if !args.questions.is_empty() {
        let found = console
            .run(|backends, context| flotilla_studies::questions::run::run(&request, backends, context))
            .map_err(resume)?;
        return args.printed.outcome(&found, |found| {
            format!(
                "{}\nFiles in {out}: questions.md, for each table its figure (.svg, .png, .pdf) and every comparison (.csv), and \
                 the sweep that it is of, in a folder\n",
                found.text
            )
        });
    }
    let found = console
        .run(|backends, context| flotilla_studies::paper::run::run(&request, backends, context))
        .map_err(resume)?;
    args.printed.outcome(&found, |found| {
        format!(
            "{}Trained in {:.1} s. Files in {out}: figure4, figure5, figure6 (.svg, .png, .pdf), claims.md (with every \
             figure), summary.json, and a run each in {ARMS}/\n",
            found.text, found.seconds
        )
    })
}
