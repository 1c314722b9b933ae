//! `flotilla paper`: the paper's experiments, its figures and its claims, measured here.

use std::path::PathBuf;
use std::time::Instant;

use super::{Error, Overrides, RunOptions, backend, print, say};
use crate::baseline::Baselines;
use crate::memory;
use crate::record::RecordError;
use crate::record::disk::Disk;
use crate::record::metrics::Row;
use crate::report::curves::PRINT;
use crate::report::paper::{self, Measured, Results, Summary, claims, tables};
use crate::report::progress::Progress;
use crate::run::RunError;
use crate::trainer::Trainer;

#[derive(clap::Args)]
pub struct Args {
    /// Folder for the figures, the claims and the curves
    #[arg(long, value_name = "DIR", default_value = "paper")]
    out: PathBuf,
    /// Independent repetitions [default: 5]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    trials: Option<i64>,
    /// Generations after the random start [default: 100]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    generations: Option<i64>,
    /// Start of all randomness [default: 0]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    seed: Option<i64>,
    /// No progress on standard error
    #[arg(long)]
    quiet: bool,
    #[command(flatten)]
    run: RunOptions,
}

/// Trains every experiment side by side, and writes what came out.
pub fn run(args: Args) -> Result<(), Error> {
    let Args { out, trials, generations, seed, quiet, run } = args;
    let overrides = Overrides { seed, trials, generations, ..Overrides::default() };
    let mut arms = paper::arms(&overrides.list())?;
    // Seconds of training leave nothing to go on from.
    arms.iter_mut().for_each(|arm| (arm.config.checkpoint.generations, arm.config.checkpoint.seconds) = (0, 0.0));
    let (mut backend, machine) = backend::open(&run)?;
    // Before training: a folder that cannot be written should not cost the time.
    let disk = Disk::default();
    let failed = |path: &PathBuf| {
        let path = path.clone();
        |error| RecordError::Write { path, error }
    };
    disk.create_folder(&out).map_err(failed(&out))?;
    let learning = arms[0].config.learning.clone();
    let (configs, places) = paper::trained(&arms);
    if !quiet {
        let (count, different, trials) = (arms.len(), configs.len(), learning.trials);
        let on = backend.describe();
        say(format_args!(
            "training {count} experiments, {different} of them different, of {trials} trials each on {on}"
        ));
    }

    let since = Instant::now();
    let plan = memory::Plan::of(&configs, rayon::current_num_threads());
    plan.check(machine.backend == "gpu").map_err(RunError::from)?;
    let mut trainer = Trainer::new(configs);
    let names = arms.iter().map(|arm| (arm.name(), arm.pois())).collect();
    let mut progress = Progress::new(names, 0, learning.generations, quiet);
    while !trainer.is_done() {
        let rows = trainer.advance(&mut *backend)?;
        let of_arms = |row: &Row| {
            let (row, places) = (*row, places.iter().enumerate());
            places.filter(move |&(_, &place)| place == row.arm).map(move |(arm, _)| Row { arm, ..row })
        };
        let rows: Vec<Row> = rows.iter().flat_map(of_arms).collect();
        rows.iter().for_each(|row| arms[row.arm].add(row));
        progress.show(trainer.generation(), &rows);
    }
    drop(trainer);
    let mut baselines = Baselines::new(paper::grounds(&arms));
    while !baselines.is_done() {
        baselines.advance(&mut *backend)?;
    }
    let baselines = baselines.found();
    let results = Results { arms: &arms, baselines: &baselines };
    progress.clear();
    let seconds = since.elapsed().as_secs_f64();

    let write = |name: String, content: &[u8]| -> Result<(), Error> {
        let path = out.join(name);
        Ok(disk.replace(&path, |output| output.write_all(content)).map_err(failed(&path))?)
    };
    for (index, layout) in paper::LAYOUTS.iter().enumerate() {
        let scene = paper::figure(results, index).scene();
        write(format!("figure{}.svg", layout.figure), scene.svg().as_bytes())?;
        let name = format!("figure{}.png", layout.figure);
        let png = scene.png(PRINT).map_err(failed(&out.join(&name)))?;
        write(name, &png)?;
    }
    let claims = claims::claims(results);
    let baseline = tables::without_learning(results);
    let heading = tables::heading(&learning, &claims);
    let full = tables::full(&claims);
    write("claims.md".into(), tables::page(&baseline, &heading, &full).as_bytes())?;
    let summary = Summary {
        version: env!("CARGO_PKG_VERSION"),
        backend: backend.describe(),
        seconds,
        seed: learning.seed,
        trials: learning.trials,
        generations: learning.generations,
        curves: Measured::all(results),
        claims: &claims,
    };
    let summary = serde_json::to_string(&summary).expect("plain fields are JSON") + "\n";
    write("summary.json".into(), summary.as_bytes())?;
    print(&format!(
        "{baseline}\n{}\n{heading}\n\nTrained and played in {seconds:.1} s. Files in {}: figure4, figure5, figure6 \
         (.svg, .png), claims.md (with every figure), summary.json\n",
        tables::verdicts(&claims),
        out.display()
    ))
}
