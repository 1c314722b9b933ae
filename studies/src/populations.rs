//! The study of followers and of the number of evolving populations, each varied apart from the other.
//!
//! Each [`Arm`] has followers or none, and a population per agent, per group or one for all. It is trained under each
//! fitness, with each largest speed and density. Trials with the same number form pairs. Champions also play from
//! held-out starts.

use std::path::Path;

use serde::Serialize;

use crate::paper::check_fixed;
use crate::paper::run::{Request, check_folder, check_trials};
use crate::tasks;
use flotilla::backend::Backend;
use flotilla::config::{Choice, Config, Density, Fitness, LAYOUTS, Paradigm, Sharing, ValidConfig};
use flotilla::escape::PathExt;
use flotilla::evaluate::Starts;
use flotilla::statistics::{self, Average, Estimate};
use flotilla_app::choice::Work;
use flotilla_app::ops::{BackendSource, Context, Error, check_memory};
use flotilla_app::record::disk::Disk;
use flotilla_app::record::folder::{self, ARMS};
use flotilla_app::record::{RecordError, ownership};
use flotilla_app::report::grid::{Dots, Interval};
use flotilla_app::report::scene::Format;

/// The names of the layouts: the paper's, and the first with a coupling that takes two groups.
pub const LAYOUT_NAMES: [&str; 4] = ["generally-forward", "strictly-forward", "chaotic", "coupling-6"];
/// The largest speeds: the default and the authors'.
const SPEEDS: [f64; 2] = [3.0, 10.0];
/// The densities: the default and the paper's words.
const DENSITIES: [Density; 2] = [Density::Linear, Density::Mean];
/// The keys that all experiments fix. Stages could change some of them.
const FIXED: [&str; 6] =
    ["learning.paradigm", "learning.sharing", "learning.fitness", "motion.max_speed", "sense.density", "stages"];
/// Number of held-out episodes per champion, and the largest offset of each start, in units.
const HELD_OUT: (u32, f64) = (100, 2.0);
/// The files with the results.
const CELLS: &str = "cells.csv";
/// See [`CELLS`].
const PAIRS: &str = "pairs.csv";
/// The name of the picture.
const PICTURE: &str = "populations";

/// A paradigm, the agents that share a population, and the name of both together.
type Arm = (Paradigm, Sharing, &'static str);
/// The arms. A group of leader-follower teams has one leader.
const ARMS_OF: [Arm; 5] = [
    (Paradigm::AllLeaders, Sharing::PerLeader, "no followers, a population per agent"),
    (Paradigm::AllLeaders, Sharing::Group, "no followers, one per group"),
    (Paradigm::AllLeaders, Sharing::Shared, "no followers, one for all"),
    (Paradigm::LeaderFollower, Sharing::PerLeader, "followers, one per leader"),
    (Paradigm::LeaderFollower, Sharing::Shared, "followers, one for all"),
];
/// The contrasts: what each isolates, and the arms whose difference it is.
const CONTRASTS: [(&str, [usize; 2]); 5] = [
    ("fewer populations: one per group or per agent, no followers", [1, 0]),
    ("followers, at one population per group", [3, 1]),
    ("followers, at one population for all", [4, 2]),
    ("one population for all or one per leader, with followers", [4, 3]),
    ("the paper's contrast: both at once", [3, 0]),
];

/// One experiment.
struct Cell {
    layout: &'static str,
    arm: usize,
    config: Config,
    /// G of the champion from the config's start, of the mean team, and of the champion from held-out starts, per trial.
    measured: [Vec<f64>; 3],
}

/// The names of what is measured.
const MEASURES: [&str; 3] = ["champion", "mean team", "champion, held-out starts"];

impl Cell {
    fn name(&self) -> String {
        let (paradigm, sharing, _) = ARMS_OF[self.arm];
        let Config { learning, motion, sense, .. } = &self.config;
        let (layout, fitness, speed, density) = (self.layout, learning.fitness, motion.max_speed, sense.density);
        format!("{layout}-{paradigm}-{sharing}-{fitness}-{speed}-{density}")
    }

    /// Returns what all cells that are compared with this one have in common.
    fn place(&self) -> (&'static str, Fitness, f64, Density) {
        (self.layout, self.config.learning.fitness, self.config.motion.max_speed, self.config.sense.density)
    }
}

#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    pub folder: String,
    /// The number of trials of each experiment.
    pub trials: usize,
    /// Policies per population.
    pub population: usize,
    /// The cells: G of each experiment.
    pub cells: Vec<Row>,
    /// The contrasts.
    pub pairs: Vec<Row>,
    /// The table for people.
    #[serde(skip)]
    pub text: String,
}

/// A row of a table: one cell, or one contrast of two.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub layout: &'static str,
    pub fitness: Fitness,
    /// The largest speed, in units per second.
    pub max_speed: f64,
    pub density: Density,
    /// The arm, or what the contrast isolates.
    pub what: String,
    /// The measure: see [`MEASURES`].
    pub measure: &'static str,
    /// G, or a difference of G over pairs of trials, with its 95 % interval.
    #[serde(flatten)]
    pub estimate: Estimate,
    /// Wilcoxon's p of a contrast over pairs, with Holm's correction for all contrasts of one measure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p_holm: Option<f64>,
}

/// Returns the experiments on some layouts.
fn cells(request: &Request) -> Result<Vec<Cell>, Error> {
    check_fixed(&request.set, &FIXED, "the study's experiments")?;
    let mut cells = Vec::new();
    for (index, layout) in LAYOUT_NAMES.into_iter().enumerate() {
        if !request.populations.iter().any(|name| name == layout) {
            continue;
        }
        if index == LAYOUTS.len() {
            check_fixed(&request.set, &["world.coupling", "world.steps"], "the experiments of coupling-6")?;
        }
        for (arm, (paradigm, sharing, _)) in ARMS_OF.into_iter().enumerate() {
            for fitness in [Fitness::G, Fitness::D, Fitness::Df] {
                if fitness == Fitness::Df && paradigm == Paradigm::AllLeaders {
                    continue;
                }
                for (max_speed, density) in SPEEDS.into_iter().flat_map(|s| DENSITIES.map(|density| (s, density))) {
                    let (name, text) = LAYOUTS[index % LAYOUTS.len()];
                    let mut config = Config::read(text, name, &[], &request.set)?;
                    (config.learning.paradigm, config.learning.sharing) = (paradigm, sharing);
                    (config.learning.fitness, config.motion.max_speed) = (fitness, max_speed);
                    config.sense.density = density;
                    if index == LAYOUTS.len() {
                        config.world.coupling = flotilla::config::Coupling::Same(6);
                        config.world.steps = 50;
                    }
                    cells.push(Cell { layout, arm, config, measured: Default::default() });
                }
            }
        }
    }
    Ok(cells)
}

/// Trains every experiment, each as a run in a folder of its own, and writes tables and a picture.
///
/// # Errors
/// The folder or a config cannot be used, training fails or is stopped, or files cannot be written.
pub fn run(request: &Request, backends: &mut dyn BackendSource, context: Context<'_>) -> Result<Outcome, Error> {
    let out = &request.out;
    let mut cells = cells(request)?;
    let configs: Vec<Config> = cells.iter().map(|cell| cell.config.clone()).collect();
    let learning = configs[0].learning.clone();
    check_trials(&configs)?;
    check_folder(out)?;
    let mut work = Work::default();
    configs.iter().for_each(|config| work += Work::of([config]));
    let (backend, on) = backends.open(work)?;
    for config in ValidConfig::all(&configs)? {
        check_memory([&config], backend)?;
    }
    let (disk, _lock) = request.open_folder(products())?;
    let parent = out.join(ARMS);
    disk.create_folder(&parent).map_err(RecordError::write(&parent))?;
    let folders: Vec<_> = cells.iter().map(|cell| parent.join(cell.name())).collect();
    folder::check(&disk, folders.iter().map(|path| &**path).zip(&configs), request.start)?;
    context.message(format_args!("training {} experiments on {on}, into {}", cells.len(), out.escaped()));
    for (cell, folder) in cells.iter_mut().zip(&folders) {
        tasks::train(&cell.config, &cell.name(), folder, request.start, &disk, backend, context)?;
        measure(cell, &disk, folder, &mut *backend.0)?;
    }
    let (found, pairs) = (rows(&cells), contrasts(&cells));
    for (name, rows) in [(CELLS, &found), (PAIRS, &pairs)] {
        ownership::publish_bytes(&disk, &out.join(name), csv(rows).as_bytes())?;
    }
    picture(&found).scene().publish(&disk, out, PICTURE)?;
    Ok(Outcome {
        folder: out.escaped(),
        trials: learning.trials,
        population: learning.population,
        text: csv(&pairs.iter().filter(|row| row.measure == MEASURES[0]).cloned().collect::<Vec<_>>()),
        cells: found,
        pairs,
    })
}

/// Returns the names of all files that are made from the runs.
fn products() -> impl Iterator<Item = String> {
    [CELLS, PAIRS].map(String::from).into_iter().chain(Format::names(PICTURE))
}

/// Reads a finished run, and plays its champions from held-out starts.
fn measure(cell: &mut Cell, disk: &Disk, folder: &Path, backend: &mut dyn Backend) -> Result<(), Error> {
    let config = &cell.config;
    let [champion, mean] = tasks::last_g(config, disk, folder, |row| row.mean_g)?;
    let (episodes, jitter) = HELD_OUT;
    let starts = Starts::Drawn { episodes, seed: config.learning.seed, jitter, poi_jitter: 0.0 };
    cell.measured = [champion, mean, tasks::play_champions(config, disk, folder, &starts, backend)?];
    Ok(())
}

fn rows(cells: &[Cell]) -> Vec<Row> {
    let row = |cell: &Cell, measure: usize| {
        let average: Average = cell.measured[measure].iter().collect();
        let estimate = statistics::bounded(&average, [0.0, 1.0])?;
        Some(Row {
            what: ARMS_OF[cell.arm].2.into(),
            measure: MEASURES[measure],
            estimate,
            p_holm: None,
            ..blank(cell)
        })
    };
    cells.iter().flat_map(|cell| (0..MEASURES.len()).filter_map(move |measure| row(cell, measure))).collect()
}

/// Compares arms that differ in one thing, and each fitness with G, over pairs of trials.
fn contrasts(cells: &[Cell]) -> Vec<Row> {
    let mut all = Vec::new();
    for (measured, measure) in MEASURES.into_iter().enumerate() {
        let mut rows = Vec::new();
        for cell in cells {
            let (layout, fitness, speed, density) = cell.place();
            let find = |arm: usize, place| cells.iter().find(|other| other.arm == arm && other.place() == place);
            let of_arms = CONTRASTS.iter().filter(|(_, [one, _])| *one == cell.arm);
            let of_arms = of_arms.map(|&(what, [_, other])| (what.to_string(), find(other, cell.place())));
            let name = ARMS_OF[cell.arm].2;
            let of_credit = (fitness != Fitness::G).then(|| {
                (format!("{fitness} instead of G: {name}"), find(cell.arm, (layout, Fitness::G, speed, density)))
            });
            for (what, other) in of_arms.chain(of_credit) {
                let Some(other) = other else { continue };
                let pairs = cell.measured[measured].iter().zip(&other.measured[measured]);
                let differences: Vec<f64> = pairs.map(|(one, other)| one - other).collect();
                let estimate = statistics::paired(&differences.iter().collect(), 1.0);
                if let (Some(estimate), Some(tested)) = (estimate, statistics::signed_rank(&differences)) {
                    rows.push(Row { what, measure, estimate, p_holm: Some(tested.p), ..blank(cell) });
                }
            }
        }
        let p: Vec<f64> = rows.iter().filter_map(|row| row.p_holm).collect();
        rows.iter_mut().zip(statistics::holm(&p)).for_each(|(row, p)| row.p_holm = Some(p));
        all.extend(rows);
    }
    all
}

/// Returns a row with the place of a cell.
fn blank(cell: &Cell) -> Row {
    let (layout, fitness, max_speed, density) = cell.place();
    Row {
        layout,
        fitness,
        max_speed,
        density,
        what: String::new(),
        measure: "",
        estimate: Estimate::exact(0.0),
        p_holm: None,
    }
}

/// Returns rows as a table of comma-separated values.
fn csv(rows: &[Row]) -> String {
    let mut text = String::from("layout,fitness,max_speed,density,what,measure,g,low,high");
    text += if rows.iter().any(|row| row.p_holm.is_some()) { ",p_holm\n" } else { "\n" };
    for Row { layout, fitness, max_speed, density, what, measure, estimate, p_holm } in rows {
        let Estimate { value, low, high } = estimate;
        let p = p_holm.map_or(String::new(), |p| format!(",{p:.4}"));
        text += &format!(
            "{layout},{fitness},{max_speed},{density},\"{what}\",\"{measure}\",{value:.4},{low:.4},{high:.4}{p}\n"
        );
    }
    text
}

/// Draws the champions' G under G, one panel per speed and density.
fn picture(rows: &[Row]) -> Dots {
    let layouts: Vec<&str> =
        LAYOUT_NAMES.into_iter().filter(|name| rows.iter().any(|row| row.layout == *name)).collect();
    let arms = || ARMS_OF.iter().map(|(.., what)| *what);
    let groups = layouts.iter().map(|layout| (layout.replace('-', " "), arms().map(String::from).collect()));
    let panel = |(speed, density): (f64, Density)| {
        let found = |layout: &str, what: &str| -> Option<Interval> {
            let is = |row: &&Row| {
                (row.layout, &*row.what, row.measure) == (layout, what, MEASURES[0])
                    && (row.fitness, row.max_speed, row.density) == (Fitness::G, speed, density)
            };
            rows.iter().find(is).map(|row| [row.estimate.value, row.estimate.low, row.estimate.high])
        };
        let words = Density::names().nth(density as usize).unwrap_or_default();
        let results = layouts.iter().flat_map(|layout| arms().map(move |what| found(layout, what)));
        (format!("speed {speed}, {words} density"), None, results.collect())
    };
    Dots {
        title: "What followers change, and what the number of populations changes".into(),
        x_label: "G of the champion: mean and 95 % interval".into(),
        groups: groups.collect(),
        panels: SPEEDS.into_iter().flat_map(|speed| DENSITIES.map(|density| (speed, density))).map(panel).collect(),
    }
}
