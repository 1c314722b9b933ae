//! The tables of a sweep, from the folders of its points. Their bytes do not depend on which process trained the
//! points, or in what order.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{Axis, Point, Sweep};
use crate::record::digests::{Digests, Verification};
use crate::record::disk::{Disk, Place};
use crate::record::folder::{CONFIG, METRICS, POINTS, RESULTS};
use crate::record::{RecordError, load_config, without_checkpoint};
use crate::record::{metrics, ownership};
use crate::report::curves::{Band, Curve};
use crate::report::grid::Interval;
use crate::report::runs::TeamKind;
use flotilla::escape::{self, PathExt};
use flotilla::statistics::{self, Average};
use flotilla::trainer::Row;

/// How the results of a sweep are collected.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ResultOptions {
    /// Generations per row of `results.csv`. The last generation always has a row.
    pub every: usize,
    /// The G, 0 to 1, whose first generation is reported.
    pub reach: f64,
    /// Whether files that differ from their digests are read.
    pub unverified: bool,
    /// The axes of the pictures, across and down. The first two by default.
    pub axes: Vec<String>,
    /// The team whose G the pictures show and must reach [`ResultOptions::reach`].
    pub measure: TeamKind,
    /// Range that pictures show around a mean.
    pub band: Band,
}

impl Default for ResultOptions {
    fn default() -> ResultOptions {
        let (measure, band) = (TeamKind::default(), Band::default());
        ResultOptions { every: 1, reach: 0.75, unverified: false, axes: vec![], measure, band }
    }
}

/// The results of a point's trials.
#[derive(Clone, Debug, PartialEq)]
pub struct PointResults {
    /// The best team's G in the last generation, averaged over trials.
    pub best: Average,
    /// The champion's G in the last generation, averaged over trials.
    pub champion: Average,
    /// The tested best team's G in the last generation, averaged over trials, if the point has test episodes.
    pub test: Option<Average>,
    /// The first generation of every trial at which [`ResultOptions::measure`]'s G is at least [`ResultOptions::reach`].
    pub reached: Vec<Option<usize>>,
    /// [`ResultOptions::measure`]'s G by generation, averaged over the trials, for each row of `results.csv`. The last
    /// generation is the last entry.
    pub curve: Vec<(usize, Average)>,
}

impl PointResults {
    /// Returns the average over trials of [`ResultOptions::measure`]'s G in the last generation.
    pub fn measured(&self) -> Average {
        self.curve.last().map_or(Average::default(), |(_, average)| *average)
    }

    /// Returns the curve of [`ResultOptions::measure`]'s G.
    pub(super) fn curve(&self) -> Curve {
        Curve::at(self.curve.iter().map(|(generation, average)| (*generation, average)), 1.0)
    }

    /// Returns the mean and the ends of the band of [`ResultOptions::measure`]'s G in the last generation.
    pub(super) fn interval(&self, options: &ResultOptions) -> Interval {
        let last = &self.curve[self.curve.len() - 1..];
        let curve = Curve::at(last.iter().map(|(generation, average)| (*generation, average)), 1.0);
        let [low, high] = curve.ends(options.band, 0, 1.0);
        [curve.mean[0], low, high]
    }

    /// Returns the median over trials of the first generation that reaches G. Trials that never reach it count as
    /// infinite. None if the median is infinite.
    pub(crate) fn median_reached(&self) -> Option<f64> {
        let reached = |reached: &Option<usize>| reached.map_or(f64::INFINITY, |generation| generation as f64);
        let reached: Vec<f64> = self.reached.iter().map(reached).collect();
        statistics::median(&reached).map(|median| median.value).filter(|median| median.is_finite())
    }
}

/// Returns the folder of a point's run.
pub fn point_folder(out: &Path, point: &Point) -> PathBuf {
    out.join("points").join(format!("{:04}", point.index))
}

/// The reason why a point has no results.
#[derive(Debug, thiserror::Error)]
pub enum Missing {
    /// The point's folder has no run.
    #[error("it was not run")]
    NotRun,
    /// The point's run has the first of these numbers of generations. The second is that of a finished one.
    #[error("it has {0} of {1} generations")]
    Unfinished(usize, usize),
    /// The point's files cannot be used.
    #[error("{0}")]
    Damaged(String),
}

/// Writes `results.csv` and `points.csv` of the finished points to a disk in the sweep's folder. The points are read
/// in `place`. Returns the results of every point.
pub fn write(
    sweep: &Sweep,
    place: Place<'_>,
    options: &ResultOptions,
    disk: &Disk,
) -> Result<Vec<Result<PointResults, Missing>>, RecordError> {
    let out = place.path();
    let mut outcomes = Vec::new();
    let path = out.join(RESULTS);
    let rows = |output: &mut dyn Write| {
        let mut table = csv::Writer::from_writer(output);
        let tested = is_tested(sweep);
        let columns = ["point", "trial", "generation", "best_g", "mean_g", "champion_g"].into_iter();
        let columns = columns.chain(tested.then_some("test_g"));
        table.write_record(sweep.axes.iter().map(|axis| &*axis.key).chain(columns))?;
        for point in &sweep.points {
            outcomes.push(match read(point, place, options) {
                Ok((rows, outcome)) => {
                    for row in rows {
                        let Row { trial, generation, best_g, mean_g, champion_g, test_g, .. } = row;
                        let counts = [point.index, trial, generation].map(|count| count.to_string());
                        let shares = [best_g, mean_g, champion_g].map(|share| share.to_string());
                        let test_g = tested.then(|| test_g.map_or(String::new(), |share| share.to_string()));
                        let shares = shares.into_iter().chain(test_g);
                        table.write_record(labels(sweep, point).into_iter().chain(counts).chain(shares))?;
                    }
                    Ok(outcome)
                }
                Err(missing) => Err(missing),
            });
        }
        table.flush()
    };
    ownership::publish(disk, &path, rows)?;

    let path = out.join(POINTS);
    let summary = |output: &mut dyn Write| summary(sweep, &outcomes, options, output);
    ownership::publish(disk, &path, summary)?;
    Ok(outcomes)
}

/// Reports whether any point has test episodes.
fn is_tested(sweep: &Sweep) -> bool {
    sweep.points.iter().any(|point| point.config.learning.test_episodes > 0)
}

fn labels(sweep: &Sweep, point: &Point) -> Vec<String> {
    let label = |(axis, &value): (&Axis, &usize)| escape::csv_cell(&axis.label(value)).into_owned();
    sweep.axes.iter().zip(&point.values).map(label).collect()
}

/// Writes `points.csv`, one row per point.
fn summary(
    sweep: &Sweep,
    outcomes: &[Result<PointResults, Missing>],
    options: &ResultOptions,
    output: &mut dyn Write,
) -> io::Result<()> {
    let mut table = csv::Writer::from_writer(output);
    let columns =
        "point,trials,generations,champion_g,champion_g_low,champion_g_high,best_g,reach,reached,median".split(',');
    let tested = is_tested(sweep);
    let columns = columns.chain(["test_g"].into_iter().filter(|_| tested));
    table.write_record(sweep.axes.iter().map(|axis| &*axis.key).chain(columns))?;
    for (point, outcome) in sweep.points.iter().zip(outcomes) {
        let Ok(outcome) = outcome else { continue };
        // A single trial has no interval.
        let interval = statistics::bounded(&outcome.champion, [0.0, 1.0]);
        let ends = interval.map(|interval| [interval.low, interval.high].map(|end| end.to_string()));
        let [low, high] = ends.unwrap_or_default();
        let fields = [
            point.index.to_string(),
            outcome.reached.len().to_string(),
            point.config.learning.generations.to_string(),
            outcome.champion.mean().to_string(),
            low,
            high,
            outcome.best.mean().to_string(),
            options.reach.to_string(),
            outcome.reached.iter().flatten().count().to_string(),
            outcome.median_reached().map_or(String::new(), |median| median.to_string()),
        ];
        let test_g = tested.then(|| outcome.test.map_or(String::new(), |test| test.mean().to_string()));
        table.write_record(labels(sweep, point).into_iter().chain(fields).chain(test_g))?;
    }
    table.flush()
}

/// Reads the rows of a finished point for `results.csv`, by trial and generation, and its results.
fn read(point: &Point, place: Place<'_>, options: &ResultOptions) -> Result<(Vec<Row>, PointResults), Missing> {
    let folder = point_folder(place.path(), point);
    let damaged = |error: &dyn std::fmt::Display| Missing::Damaged(error.to_string());
    let path = folder.join(METRICS);
    let exists = place.at(&path).exists();
    if !exists.map_err(|error| damaged(&format!("{}: cannot be read: {error}", path.escaped())))? {
        return Err(Missing::NotRun);
    }
    let digests =
        Digests::read(place.at(&folder), Verification::unless(options.unverified)).map_err(|error| damaged(&error))?;
    let config = load_config(place.at(&folder.join(CONFIG))).map_err(|error| damaged(&error))?;
    if let Some(missing) = options.measure.missing(&point.config) {
        return Err(Missing::Damaged(missing));
    }
    if without_checkpoint(&config) != without_checkpoint(&point.config) {
        return Err(Missing::Damaged(format!("{}: it is of another config", folder.escaped())));
    }
    digests.compare_config(&folder.join(CONFIG), &config).map_err(|error| damaged(&error))?;
    let (trials, last) = (config.learning.trials, config.learning.generations);
    let mut rows: Vec<Vec<Row>> = vec![Vec::new(); trials];
    let mut reached = vec![None; trials];
    let found = metrics::visit(place.at(&path), &config, |row| {
        let &Row { trial, generation, .. } = row;
        // G of an easier stage is not comparable.
        let measured = options.measure.of(row).unwrap_or(0.0);
        if measured >= options.reach && reached[trial].is_none() && generation >= config.last_from() {
            reached[trial] = Some(generation);
        }
        if generation % options.every == 0 || generation == last {
            rows[trial].push(*row);
        }
    });
    let found = found.map_err(|error| damaged(&error))?;
    digests.compare_metrics(&path, found.digest).map_err(|error| damaged(&error))?;
    if found.rows < trials * (last + 1) {
        return Err(Missing::Unfinished(found.rows / trials, last + 1));
    }
    let ends = || rows.iter().filter_map(|rows| rows.last());
    let curve = (0..rows[0].len()).map(|at| {
        let mut average = Average::default();
        rows.iter().filter_map(|rows| options.measure.of(&rows[at])).for_each(|g| average.add(g));
        (rows[0][at].generation, average)
    });
    let outcome = PointResults {
        best: ends().map(|row| &row.best_g).collect(),
        champion: ends().map(|row| &row.champion_g).collect(),
        test: ends().map(|row| row.test_g).collect::<Option<Vec<f64>>>().map(|test| test.iter().collect()),
        reached,
        curve: curve.collect(),
    };
    Ok((rows.concat(), outcome))
}
