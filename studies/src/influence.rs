//! The study of credits for rovers and UAVs: one sweep per layout, every pair of its credits, and its baselines.

use std::path::PathBuf;

use serde::Serialize;

use crate::paper::run::{Request, check_folder, check_trials};
use crate::tasks::{mean, play_baselines};
use flotilla::baseline::NAMES;
use flotilla::escape::PathExt;
use flotilla_app::choice::Work;
use flotilla_app::ops::sweep::{PointOutcome, SweepRequest, same_sweep};
use flotilla_app::ops::{BackendSource, Context, Error, check_memory, compare, sweep};
use flotilla_app::record::folder::POINTS;
use flotilla_app::record::{RecordError, ownership};
use flotilla_app::report::comparison::{self, Comparison, Measure};
use flotilla_app::sweep::Sweep;
use flotilla_app::sweep::results::point_folder;

macro_rules! layouts {
    ($($name:literal),*) => {
        /// The layouts: the name of each, and its sweep.
        const LAYOUTS: &[(&str, &str)] = &[$(($name, include_str!(concat!("../configs/influence/", $name, ".toml")))),*];
        pub const LAYOUT_NAMES: &[&str] = &[$($name),*];
    };
}

layouts!("rover_uav", "3_rovers_1_uav", "3_rovers_3_uavs", "4_rovers_4_uavs", "3_rovers_3_uavs_random");

/// The file with the baselines of all layouts.
const BASELINES: &str = "baselines.csv";

#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    pub folder: String,
    pub layouts: Vec<LayoutOutcome>,
    /// The results for people.
    #[serde(skip)]
    pub text: String,
}

#[derive(Clone, Debug, Serialize)]
pub struct LayoutOutcome {
    pub name: &'static str,
    /// The credits.
    pub points: Vec<PointOutcome>,
    /// Every pair of credits, over pairs of trials.
    pub pairs: Comparison,
    /// G of each baseline of [`NAMES`], per seed.
    pub baselines: [Vec<f64>; NAMES.len()],
}

/// Trains the sweep of each layout in a folder of its own, compares its credits, and plays baselines.
///
/// # Errors
/// The folder or a config cannot be used, training fails or is stopped, or files cannot be written.
pub fn run(request: &Request, backends: &mut dyn BackendSource, context: Context<'_>) -> Result<Outcome, Error> {
    let out = &request.out;
    let chosen = LAYOUTS.iter().filter(|(name, _)| request.influence.iter().any(|other| other == name));
    let sweeps = chosen.map(|&(name, text)| {
        let file = format!("studies/configs/influence/{name}.toml");
        Ok((name, Sweep::read(text, &file, &request.set, false)?))
    });
    let sweeps: Vec<(&str, Sweep)> = sweeps.collect::<Result<_, Error>>()?;
    let configs = || sweeps.iter().flat_map(|(_, sweep)| &sweep.points).map(|point| &point.config);
    check_trials(configs().map(|config| &**config))?;
    check_folder(out)?;
    for (name, sweep) in &sweeps {
        same_sweep(sweep, &out.join(name))?;
    }
    let (mut backend, on) = backends.open(Work::of(configs().map(|config| &**config)))?;
    check_memory(configs(), backend)?;
    let products = LAYOUT_NAMES.iter().flat_map(|name| [csv_name(name, ""), csv_name(name, "_pairs")]);
    let (disk, _lock) = request.open_folder(products.chain([BASELINES.into()]))?;
    context.message(format_args!("training {} experiments on {on}, into {}", configs().count(), out.escaped()));
    let mut layouts = Vec::new();
    for (name, sweep) in &sweeps {
        let folder = out.join(name);
        let points = train(sweep, folder.clone(), request, &mut backend, context)?;
        let path = folder.join(POINTS);
        let table = std::fs::read(&path).map_err(RecordError::read(&path))?;
        ownership::publish_bytes(&disk, &out.join(csv_name(name, "")), &table)?;
        let pairs = pairs(sweep.points.iter().map(|point| point_folder(&folder, point)).collect(), context)?;
        let table = comparison::csv(std::slice::from_ref(&pairs));
        ownership::publish_bytes(&disk, &out.join(csv_name(name, "_pairs")), &table)?;
        let baselines = play_baselines(&sweep.points[0].config, &mut *backend.0, context)?;
        layouts.push(LayoutOutcome { name, points, pairs, baselines });
    }
    context.pause();
    let table = table(&layouts);
    ownership::publish_bytes(&disk, &out.join(BASELINES), table.as_bytes())?;
    Ok(Outcome { folder: out.escaped(), layouts, text: table })
}

fn csv_name(layout: &str, ending: &str) -> String {
    format!("{layout}{ending}.csv")
}

/// Trains the points of a sweep, and collects their results.
fn train(
    sweep: &Sweep,
    out: PathBuf,
    request: &Request,
    backend: &mut dyn BackendSource,
    context: Context<'_>,
) -> Result<Vec<PointOutcome>, Error> {
    let request = SweepRequest {
        text: sweep.text.clone(),
        name: sweep.name.clone(),
        set: vec![],
        skip_impossible: false,
        out,
        named: request.is_out_named(),
        start: request.start,
        shard: None,
        memory: None,
        results: Default::default(),
    };
    let found = sweep::run(&request, backend, context)?;
    found.missing().map_or(Ok(found.points), Err)
}

/// Compares the champions of every pair of credits, trial by trial.
fn pairs(folders: Vec<PathBuf>, context: Context<'_>) -> Result<Comparison, Error> {
    let request = compare::CompareRequest {
        folders,
        by: None,
        at: vec!["last".into()],
        reach: 0.75,
        paired: true,
        unverified: false,
    };
    let mut found = compare::run(&request, context.quiet())?.comparisons.remove(0);
    // The best of noisy episodes is optimistic, so test episodes count where there are any.
    let tests = found.measures.iter().any(|measured| matches!(measured.measure, Measure::TestG { .. }));
    found.measures.retain(|measured| match measured.measure {
        Measure::TestG { .. } => true,
        Measure::ChampionG { .. } => !tests,
        _ => false,
    });
    // The sweep's table has the champions of the arms.
    found.measures.iter_mut().filter(|_| !tests).for_each(|measured| measured.arms.clear());
    Ok(found)
}

/// Returns the baselines of all layouts as comma-separated values: the mean G over seeds, the least and the most.
fn table(layouts: &[LayoutOutcome]) -> String {
    let mut text = String::from("layout,baseline,seeds,g,least,most\n");
    for LayoutOutcome { name, baselines, .. } in layouts {
        for (baseline, seeds) in NAMES.iter().zip(baselines) {
            let [least, most] = seeds.iter().fold([f64::MAX, 0.0], |[low, high], &g| [low.min(g), f64::max(high, g)]);
            let (count, g) = (seeds.len(), mean(seeds));
            text += &format!("{name},{baseline},{count},{g:.4},{least:.4},{most:.4}\n");
        }
    }
    text
}
