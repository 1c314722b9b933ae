//! The figures of a sweep: `final`, `reach` and `curves`, or only `final` for varied keys. Each is written as SVG, PNG
//! and PDF.

use std::path::Path;

use super::results::{Missing, PointResults, ResultOptions};
use super::{Axis, Point, Sweep};
use crate::record::RecordError;
use crate::record::digests::UNVERIFIED;
use crate::record::disk::Disk;
use crate::report::curves::{Band, SMALL, distinct};
use crate::report::grid::{Cell, Curves, Dots, HeatMap, Scale};
use crate::report::scene::Format;

/// Maximum number of values of an axis, and of panels, in a figure.
const MAX_VALUES: usize = 40;
const MAX_PANELS: usize = 48;
/// Maximum number of values of all varied keys together.
const MAX_ROWS: usize = 100;
/// Maximum length of a label, in millimetres.
const MAX_LABEL_WIDTH: f64 = 36.0;

/// A finished point with its results, or none.
type PointResult<'a> = Option<(&'a Point, &'a PointResults)>;

/// The points by the values of two axes, with one panel for each combination of the other axes.
struct PanelGrid<'a> {
    x: &'a Axis,
    y: Option<&'a Axis>,
    /// The title, and the points `[y][x]` with their results.
    panels: Vec<(String, Vec<PointResult<'a>>)>,
}

/// The names of the figures. `final` shows the final G. For grids, `reach` shows the generations to reach a G, and
/// `curves` the learning curves.
const FIGURES: [&str; 3] = ["final", "reach", "curves"];

/// Returns the names of all files.
pub fn names() -> impl Iterator<Item = String> {
    FIGURES.into_iter().flat_map(Format::names)
}

/// Draws the figures of the finished points over one or two axes. Returns the names of the files, or the reason why
/// there are none.
pub fn draw(
    sweep: &Sweep,
    outcomes: &[Result<PointResults, Missing>],
    options: &ResultOptions,
    axes: &[usize],
    out: &Path,
    disk: &Disk,
) -> Result<(Vec<String>, Option<String>), RecordError> {
    let scenes = if sweep.axes.iter().any(|axis| axis.varied) {
        dots(sweep, outcomes, options).map(|dots| vec![(FIGURES[0], dots.scene())])
    } else {
        let of_grid = |grid: PanelGrid<'_>| {
            let (last, reach) = (grid.last(options).scene(), grid.reach(options).scene());
            FIGURES.into_iter().zip([last, reach, grid.curves(sweep, options).scene()]).collect()
        };
        PanelGrid::new(sweep, outcomes, axes).map(of_grid)
    };
    let scenes = match scenes {
        Ok(scenes) => scenes,
        Err(reason) => return Ok((vec![], Some(reason))),
    };
    let mut names = Vec::new();
    for (name, mut scene) in scenes {
        if options.unverified {
            scene.warn(UNVERIFIED);
        }
        scene.publish(disk, out, name)?;
        names.extend(Format::names(name));
    }
    Ok((names, None))
}

/// Draws G in the last generation for every value of every varied key, with one panel for each
/// combination of the grid.
fn dots(sweep: &Sweep, outcomes: &[Result<PointResults, Missing>], options: &ResultOptions) -> Result<Dots, String> {
    let (varied, grid): (Vec<usize>, Vec<usize>) = (0..sweep.axes.len()).partition(|&axis| sweep.axes[axis].varied);
    let rows: usize = varied.iter().map(|&axis| sweep.axes[axis].values.len() - 1).sum();
    let count = grid.iter().fold(1_usize, |count, &axis| count.saturating_mul(sweep.axes[axis].values.len()));
    if count > MAX_PANELS || rows > MAX_ROWS {
        return Err(format!(
            "no picture: it would have {count} panels of {rows} rows, there is room for {MAX_PANELS} of {MAX_ROWS}"
        ));
    }
    let mut dots = Dots {
        title: format!("{}, last generation: {} over trials", options.measure.label(), options.band.describe()),
        x_label: "G (dashed line and grey band: the file's own values)".into(),
        groups: varied.iter().map(|&axis| group(&sweep.axes[axis])).collect(),
        panels: vec![(String::new(), None, vec![None; rows]); count],
    };
    for (point, outcome) in sweep.points.iter().zip(outcomes) {
        let panel = grid.iter().fold(0, |panel, &axis| panel * sweep.axes[axis].values.len() + point.values[axis]);
        let (title, base, found) = &mut dots.panels[panel];
        if title.is_empty() {
            let several = grid.iter().filter(|&&axis| sweep.axes[axis].values.len() > 1);
            let words = several.map(|&axis| sweep.axes[axis].label(point.values[axis]));
            *title = words.collect::<Vec<_>>().join(", ");
        }
        let Ok(outcome) = outcome else { continue };
        let spread = outcome.interval(options);
        let mut row = 0;
        let changed = varied.iter().find_map(|&axis| {
            let value = point.values[axis];
            let found = (value > 0).then(|| row + value - 1);
            row += sweep.axes[axis].values.len() - 1;
            found
        });
        *changed.map_or(base, |row| &mut found[row]) = Some(spread);
    }
    Ok(dots)
}

/// Returns a varied key with its value in the file, and its other values.
fn group(axis: &Axis) -> (String, Vec<String>) {
    let Scale { label, values } = scale(axis);
    (format!("{label} ({})", values[0]), values[1..].to_vec())
}

impl<'a> PanelGrid<'a> {
    /// Arranges the points by the requested axes, or by the first two with more than one value.
    fn new(
        sweep: &'a Sweep,
        outcomes: &'a [Result<PointResults, Missing>],
        asked: &[usize],
    ) -> Result<PanelGrid<'a>, String> {
        let varied = (0..sweep.axes.len()).filter(|&axis| sweep.axes[axis].values.len() > 1 && !asked.contains(&axis));
        let wanted = if asked.is_empty() { 2 } else { asked.len() };
        let mut axes: Vec<usize> = asked.iter().copied().chain(varied).take(wanted).collect();
        if axes.is_empty() {
            axes.push(0);
        }
        let (x, y) = (axes[0], axes.get(1).copied());
        let counts = |axis: usize| sweep.axes[axis].values.len();
        for axis in axes {
            if counts(axis) > MAX_VALUES {
                let key = &sweep.axes[axis].key;
                return Err(format!("no pictures: {key} has {} values, they have room for {MAX_VALUES}", counts(axis)));
            }
        }
        let others: Vec<usize> = (0..sweep.axes.len()).filter(|&axis| axis != x && Some(axis) != y).collect();
        let count = others.iter().fold(1_usize, |product, &axis| product.saturating_mul(counts(axis)));
        if count > MAX_PANELS {
            return Err(format!("no pictures: they would have {count} panels, there is room for {MAX_PANELS}"));
        }
        let title = |mut panel: usize| {
            let mut parts = Vec::new();
            for &axis in others.iter().rev() {
                let (value, axis) = (panel % counts(axis), &sweep.axes[axis]);
                panel /= axis.values.len();
                // A value that all panels share does not distinguish them.
                if axis.values.len() > 1 {
                    parts.push(format!("{} = {}", axis.leaf(), axis.label(value)));
                }
            }
            parts.reverse();
            parts.join(", ")
        };
        let mut panels: Vec<_> =
            (0..count).map(|panel| (title(panel), vec![None; counts(x) * y.map_or(1, counts)])).collect();
        for (point, outcome) in sweep.points.iter().zip(outcomes) {
            let Ok(outcome) = outcome else { continue };
            let panel = others.iter().fold(0, |panel, &axis| panel * counts(axis) + point.values[axis]);
            panels[panel].1[y.map_or(0, |y| point.values[y]) * counts(x) + point.values[x]] = Some((point, outcome));
        }
        Ok(PanelGrid { x: &sweep.axes[x], y: y.map(|y| &sweep.axes[y]), panels })
    }

    fn heat_map(
        &self,
        title: String,
        (key, key_label): (Vec<(f64, String)>, [String; 2]),
        cell: impl Fn(&Point, &PointResults) -> Cell,
    ) -> HeatMap {
        let cells = |points: &Vec<PointResult<'_>>| {
            points.iter().map(|at| at.map_or(Cell::Empty, |(point, outcome)| cell(point, outcome))).collect()
        };
        HeatMap {
            title,
            x: scale(self.x),
            y: self.y.map(scale).unwrap_or_default(),
            panels: self.panels.iter().map(|(title, points)| (title.clone(), cells(points))).collect(),
            key,
            key_label,
        }
    }

    /// Draws G in the last generation.
    fn last(&self, options: &ResultOptions) -> HeatMap {
        let key = [0.0, 0.25, 0.5, 0.75, 1.0].map(|g| (g, g.to_string())).to_vec();
        let what = options.measure.label();
        let cells = match options.band {
            Band::Interval => "mean over trials; below: 95 % interval",
            Band::Error => "mean over trials; below: ± standard error",
            Band::None => "mean over trials",
        };
        let title = format!("{what}, last generation, {} over trials", options.band.describe());
        self.heat_map(title, (key, [what, cells.into()]), |_, outcome| {
            let [mean, low, high] = outcome.interval(options);
            let note = match options.band {
                // A single trial has no interval.
                _ if outcome.reached.len() < 2 => String::new(),
                Band::Interval => format!("{low:.2}–{high:.2}"),
                Band::Error => format!("±{:.2}", outcome.measured().error()),
                Band::None => String::new(),
            };
            Cell::Value(mean, format!("{mean:.2}"), note)
        })
    }

    /// Draws the generations to reach a G, shaded by their logarithm. As for G, dark is good: early.
    fn reach(&self, options: &ResultOptions) -> HeatMap {
        let all = self.panels.iter().flat_map(|(_, points)| points).flatten();
        let last = all.map(|(point, _)| point.config.learning.generations).max().unwrap_or(0).max(1) as f64;
        let place = |generation: f64| 1.0 - libm::log1p(generation) / libm::log1p(last);
        let mut ticks = vec![0.0];
        ticks.extend([1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e5].into_iter().filter(|&tick| tick < last * 0.75));
        ticks.push(last);
        let key = ticks.into_iter().map(|tick| (place(tick), tick.to_string())).collect();
        let title =
            format!("Generations until G of the {} is {}, median over trials", options.measure.name(), options.reach);
        let label = [
            format!("Median generation that reaches G {}", options.reach),
            "dark: early; below: trials that reach it".into(),
        ];
        self.heat_map(title, (key, label), |_, outcome| {
            let reached = outcome.reached.iter().flatten().count();
            let note = format!("{reached} of {}", outcome.reached.len());
            match outcome.median_reached() {
                Some(median) => Cell::Value(place(median), median.to_string(), note),
                None if reached == 0 => Cell::Word("never".into()),
                None => Cell::Word(format!("{reached} of {}", outcome.reached.len())),
            }
        })
    }

    /// Draws learning curves, one for each value of the x axis.
    fn curves(&self, sweep: &Sweep, options: &ResultOptions) -> Curves {
        let width = self.x.values.len();
        let mut panels = Vec::new();
        for row in 0..self.y.map_or(1, |y| y.values.len()) {
            for (title, points) in &self.panels {
                let curve = |(value, at): (usize, &PointResult<'_>)| {
                    let outcome = (*at)?.1;
                    Some((value, outcome.curve()))
                };
                let curves = points[row * width..(row + 1) * width].iter().enumerate().filter_map(curve).collect();
                let row = self.y.map(|y| format!("{} = {}", y.leaf(), y.label(row)));
                let title: Vec<_> = row.into_iter().chain((!title.is_empty()).then(|| title.clone())).collect();
                panels.push((title.join(", "), curves));
            }
        }
        Curves {
            title: format!("{}: {}, {} over trials", sweep.name, options.measure.label(), options.band.describe()),
            y_label: options.measure.label(),
            by: scale(self.x),
            band: options.band,
            columns: if self.panels.len() > 1 { self.panels.len() } else { 0 },
            panels,
        }
    }
}

fn scale(axis: &Axis) -> Scale {
    let values: Vec<String> = (0..axis.values.len()).map(|value| axis.label(value)).collect();
    Scale { label: axis.leaf().replace('_', " "), values: distinct(&values, MAX_LABEL_WIDTH, SMALL) }
}
