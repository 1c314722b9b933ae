//! Learning curves: means over trials by generation, and the figure that compares them.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::scene::{Anchor, BLACK, COLORS, Color, Fill, GREY, LIGHT, Pen, Scene, WHITE, rounded, text_width};
use flotilla::statistics::{self, Average, CONFIDENCE};

/// Width of a column of a two-column paper, in millimetres.
pub(crate) const COLUMN: f64 = 85.0;
/// Maximum number of points of a drawn curve.
const MAX_POINTS: usize = 300;
/// Font size of 7 points, in millimetres. The next one is 8 points.
pub(crate) const SMALL: f64 = 2.47;
pub(super) const NORMAL: f64 = 2.82;
/// Maximum number of bands in one panel. More than these cannot be told apart.
const MAX_BANDS: usize = 3;
const REFERENCES: [&[f64]; 2] = [&[2.6, 1.0], &[0.7, 0.7]];
const DASHES: [&[f64]; 5] = [&[], &[1.6, 0.7], &[1.8, 0.6, 0.4, 0.6], &[0.5, 0.5], &[3.0, 0.8]];

/// The meaning of the band around a mean.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Band {
    /// The 95 % interval of the mean, see [`statistics::bounded`].
    #[default]
    Interval,
    /// One standard error on both sides.
    Error,
    None,
}

named_by_serde!(Band, "interval, error or none");

impl Band {
    /// Describes the band, for captions: "mean and 95 % interval".
    pub fn describe(self) -> &'static str {
        match self {
            Band::Interval => "mean and 95 % interval",
            Band::Error => "mean ± standard error",
            Band::None => "mean",
        }
    }
}

/// Mean and standard error over trials by generation.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Curve {
    /// Generations, from 0: the x values.
    pub generation: Vec<f64>,
    /// Mean over trials, `[points]`.
    pub mean: Vec<f64>,
    /// Standard error of the mean, `[points]`.
    pub error: Vec<f64>,
    /// Lower and upper end of the 95 % interval of the mean, `[points]`. A single trial has no interval: both are the
    /// mean.
    #[serde(skip)]
    pub interval: Vec<[f64; 2]>,
    /// The largest number of trials of a point.
    #[serde(skip)]
    pub trials: u32,
}

impl Curve {
    /// Makes a curve of values in `0..=most` from one average per generation, from generation 0. Generations without
    /// values are left out.
    pub fn new(tallies: &[Average], most: f64) -> Curve {
        Curve::at(tallies.iter().enumerate(), most)
    }

    /// Makes a curve like [`Curve::new`] from generations, each with its average.
    pub fn at<'a>(averages: impl IntoIterator<Item = (usize, &'a Average)>, most: f64) -> Curve {
        let mut curve = Curve::default();
        // The factor takes time and rarely changes.
        let (mut count, mut factor) = (0, 0.0);
        for (generation, average) in averages.into_iter().filter(|(_, average)| average.count() > 0) {
            if average.count() != count {
                (count, factor) = (average.count(), statistics::bounded_factor(CONFIDENCE, average.count() as usize));
            }
            let mean = average.mean();
            let interval = statistics::bounded_by(factor, average, [0.0, most]);
            curve.generation.push(generation as f64);
            curve.mean.push(mean);
            curve.error.push(average.error());
            curve.interval.push(interval.map_or([mean; 2], |interval| [interval.low, interval.high]));
            curve.trials = curve.trials.max(average.count());
        }
        curve
    }

    /// Returns the ends of the band at a point, clamped to `0..=most`.
    pub fn ends(&self, band: Band, point: usize, most: f64) -> [f64; 2] {
        let (mean, error) = (self.mean[point], self.error[point]);
        let ends = match band {
            Band::Interval => self.interval[point],
            Band::Error => [mean - error, mean + error],
            Band::None => [mean; 2],
        };
        ends.map(|end| end.clamp(0.0, most))
    }

    /// Describes the band at a point: " ± 0.03" or " [0.86, 0.97]". Empty if it has no width.
    pub(super) fn describe(&self, band: Band, point: usize) -> String {
        match (band, self.ends(band, point, f64::INFINITY)) {
            (_, [low, high]) if low >= high => String::new(),
            (Band::Interval, ends) => format!(" [{}]", ends.map(number).join(", ")),
            _ => format!(" ± {}", number(self.error[point])),
        }
    }

    /// Returns the outline of a band around the mean, clamped to `0..=most`: the upper side by generation, then the
    /// lower side backwards. None if the band has no width.
    pub fn outline(&self, band: Band, most: f64) -> Option<Vec<(f64, f64)>> {
        let ends: Vec<[f64; 2]> = (0..self.mean.len()).map(|point| self.ends(band, point, most)).collect();
        ends.iter().any(|[low, high]| low < high).then_some(())?;
        let side = |end: usize| self.generation.iter().copied().zip(ends.iter().map(move |ends| ends[end]));
        Some(side(1).chain(side(0).rev()).collect())
    }

    /// Returns a curve with few enough points to draw, and the number of generations that each point averages.
    pub fn thinned(&self) -> (Curve, usize) {
        let each = self.mean.len().div_ceil(MAX_POINTS).max(1);
        let average = |values: &[f64]| -> Vec<f64> {
            values.chunks(each).map(|values| values.iter().sum::<f64>() / values.len() as f64).collect()
        };
        let [generation, mean, error] = [&self.generation, &self.mean, &self.error].map(|values| average(values));
        let [low, high] = [0, 1].map(|end| average(&self.interval.iter().map(|ends| ends[end]).collect::<Vec<_>>()));
        let interval = low.into_iter().zip(high).map(|(low, high)| [low, high]).collect();
        (Curve { generation, mean, error, interval, trials: self.trials }, each)
    }
}

/// Returns the label of an axis of generations, for curves whose points are the means of so many.
pub(super) fn generation_label(each: usize) -> String {
    match each {
        1 => "Generation".into(),
        each => format!("Generation (means of {each})"),
    }
}

/// One set of axes.
#[derive(Clone, Debug, Default)]
pub struct Panel {
    /// Title above the axes.
    pub title: String,
    /// The curves, each with its index in the legend, which determines its style.
    pub curves: Vec<(usize, Curve)>,
    /// The first generation of each stage, from the second stage on.
    pub stages: Vec<usize>,
}

/// Panels side by side that share a legend and the y axis.
#[derive(Clone, Debug, Default)]
pub struct Figure {
    /// From left to right.
    pub panels: Vec<Panel>,
    /// Labels of the curves, by index.
    pub legend: Vec<String>,
    /// Labels of the references, whose indices follow those of the curves. References are grey, without bands or marks.
    pub references: Vec<String>,
    /// Label of the shared y axis.
    pub y_label: String,
    /// The upper end of the y axis, which starts at 0.
    pub y_max: f64,
    /// Whether values are shares of the POIs instead of numbers of POIs.
    pub shares: bool,
    pub band: Band,
    /// The digest of the run, if the figure shows a single finished run.
    pub source: Option<String>,
    /// A warning to print below the figure.
    pub warning: Option<String>,
}

impl Figure {
    /// Draws the figure at the width of a column.
    pub fn scene(&self) -> Scene {
        const RIGHT: f64 = 3.0;
        const GAP: f64 = 5.5;
        const BELOW: f64 = 9.0;
        // Labels of shares are wider than whole numbers.
        let edge = if self.shares { 12.5 } else { 10.0 };
        let labels = distinct(&[&self.legend[..], &self.references].concat(), COLUMN - 20.0, SMALL);
        let rows = legend_rows(&labels);
        let titles = if self.panels.iter().any(|panel| !panel.title.is_empty()) { 4.5 } else { 1.5 };
        let above = 1.0 + rows.len() as f64 * 3.8 + titles;
        let columns = self.panels.len().max(1) as f64;
        let height = if columns > 1.0 { 36.0 } else { 46.0 };
        let width = (COLUMN - edge - RIGHT - GAP * (columns - 1.0)) / columns;
        let of_panels =
            || self.panels.iter().map(|panel| panel.curves.iter().filter(|(at, _)| *at < self.legend.len()));
        let bars = needs_bars(of_panels().map(Iterator::count));
        let banded = band_caption(self.band, bars, of_panels().flatten().map(|(_, curve)| curve));
        let caption = if banded.is_some() { 4.0 } else { 0.0 };
        let mut scene = Scene::new(COLUMN, above + height + BELOW + caption);
        (scene.title, scene.description) = (self.title(), self.description());
        scene.source.clone_from(&self.source);

        for (row, entries) in rows.iter().enumerate() {
            let y = 1.0 + 3.8 * row as f64 + 2.0;
            for &(index, x) in entries {
                scene.line(vec![[x, y], [x + 8.0, y]], self.pen(index));
                if index < self.legend.len() {
                    Look::of(index).mark(&mut scene, [x + 4.0, y]);
                }
                scene.text([x + 9.0, y + 0.9], &*labels[index], SMALL, Anchor::Start, BLACK);
            }
        }
        scene.upright([2.6, above + height / 2.0], &*self.y_label, NORMAL, BLACK);

        let thinned: Vec<Vec<_>> = self
            .panels
            .iter()
            .map(|panel| panel.curves.iter().map(|(index, curve)| (*index, curve.thinned())).collect())
            .collect();
        let each = thinned.iter().flatten().map(|(_, (_, each))| *each).max().unwrap_or(1);
        let last =
            |panel: &Panel| panel.curves.iter().filter_map(|(_, c)| c.generation.last().copied()).fold(1.0, f64::max);
        let x_max = self.panels.iter().map(last).fold(1.0, f64::max);
        for (column, (panel, curves)) in self.panels.iter().zip(&thinned).enumerate() {
            let left = edge + (width + GAP) * column as f64;
            let axes = Axes { left, above, width, height, x_max, most: self.y_max };
            scene.bold([left + width / 2.0, above - 1.3], &*panel.title, NORMAL, Anchor::Middle, BLACK);
            axes.draw(&mut scene, column == 0, self.shares, COLUMN);
            axes.stages(&mut scene, &panel.stages);
            if column == 0 {
                let middle = edge + (COLUMN - edge - RIGHT) / 2.0;
                scene.text([middle, above + height + 7.4], generation_label(each), NORMAL, Anchor::Middle, BLACK);
            }
            if let Some(caption) = banded.as_ref().filter(|_| column == 0) {
                draw_caption(&mut scene, [edge, above + height + 11.4], caption, bars);
            }
            scene.clipped([left - 0.8, above - 0.8, width + 1.6, height + 1.6], |scene| {
                let (curves, references): (Vec<_>, Vec<_>) =
                    curves.iter().partition(|(index, _)| *index < self.legend.len());
                let curves: Vec<_> = curves.into_iter().map(|(index, (curve, _))| (*index, curve)).collect();
                axes.bands(scene, &curves, self.band, bars);
                for (index, (curve, _)) in references {
                    scene.line(axes.points(curve), self.pen(*index));
                }
                axes.curves(scene, &curves, self.band, bars, self.legend.len());
            });
        }
        self.warning.iter().for_each(|warning| scene.warn(warning));
        scene
    }

    fn title(&self) -> String {
        let titles: Vec<_> = self.panels.iter().map(|panel| &*panel.title).filter(|title| !title.is_empty()).collect();
        let of = if titles.is_empty() { String::new() } else { format!(": {}", titles.join(", ")) };
        format!("{} by generation{of}", self.y_label)
    }

    /// Returns the pen for an index in the legend.
    fn pen(&self, index: usize) -> Pen {
        match index.checked_sub(self.legend.len()) {
            None => Look::of(index).pen(),
            Some(reference) => Pen { dash: REFERENCES[reference % REFERENCES.len()], ..Pen::new(GREY, 0.5) },
        }
    }

    /// Describes the first and last point of each curve.
    fn description(&self) -> String {
        let mut text = format!("Learning curves, on an axis from 0 to {}.", number(self.y_max));
        for panel in &self.panels {
            let summary = |(index, curve): &(usize, Curve)| {
                let label = self.legend.iter().chain(&self.references).nth(*index)?;
                let last = curve.mean.len().checked_sub(1)?;
                let [from, to] = [0, last].map(|at| (curve.generation[at], number(curve.mean[at])));
                let room = curve.describe(self.band, last);
                Some(format!(
                    "{label} from {} at generation {} to {}{room} at generation {}",
                    from.1, from.0, to.1, to.0
                ))
            };
            let summaries: Vec<_> = panel.curves.iter().filter_map(summary).collect();
            let title = if panel.title.is_empty() { String::new() } else { format!("{}: ", panel.title) };
            text += &format!(" {title}{}.", summaries.join("; "));
            let stages = panel.stages.iter().enumerate();
            text.extend(stages.map(|(index, from)| format!(" Stage {} begins at generation {from}.", index + 1)));
        }
        let curves = self.panels.iter().flat_map(|panel| &panel.curves).map(|(_, curve)| curve);
        if let Some(caption) = band_caption(self.band, false, curves) {
            text += &format!(" Band: {caption}.");
        }
        text
    }
}

/// Reports whether bars at the last generation replace bands, given the number of curves of each panel.
pub(super) fn needs_bars(mut curves: impl Iterator<Item = usize>) -> bool {
    curves.any(|count| count > MAX_BANDS)
}

/// Returns the caption of the bands or bars, if any curve has one.
pub(super) fn band_caption<'a>(band: Band, bars: bool, curves: impl Iterator<Item = &'a Curve>) -> Option<String> {
    let curves: Vec<&Curve> = curves.collect();
    curves.iter().any(|curve| curve.outline(band, f64::INFINITY).is_some()).then_some(())?;
    let trials: BTreeSet<u32> = curves.iter().map(|curve| curve.trials).collect();
    let (least, most) = (trials.first()?, trials.last()?);
    let trials = if least == most { most.to_string() } else { format!("{least} to {most}") };
    let place = if bars { " at the end" } else { "" };
    Some(format!("{} over {trials} trials{place}", band.describe()))
}

/// Draws the caption of the bands or bars from a place on the baseline.
pub(super) fn draw_caption(scene: &mut Scene, [x, y]: [f64; 2], caption: &str, bars: bool) {
    if bars {
        scene.line(vec![[x + 3.0, y - 2.1], [x + 3.0, y + 0.5]], Pen::new(GREY, 0.4));
        scene.circle([x + 3.0, y - 0.8], 0.7, Some(GREY.into()), None);
    } else {
        scene.rectangle([x, y - 1.9, 6.0, 2.2], Some(Fill { color: GREY, opacity: 0.3 }), None);
        scene.line(vec![[x, y - 0.8], [x + 6.0, y - 0.8]], Pen::new(GREY, 0.4));
    }
    scene.text([x + 7.0, y], caption, SMALL, Anchor::Start, BLACK);
}

/// Returns the entries of each row of the legend, each with its x coordinate.
fn legend_rows(labels: &[String]) -> Vec<Vec<(usize, f64)>> {
    const START: f64 = 10.0;
    let mut rows: Vec<Vec<(usize, f64)>> = Vec::new();
    let mut x = f64::INFINITY;
    for (index, label) in labels.iter().enumerate() {
        let width = 9.0 + text_width(label, SMALL) + 4.0;
        if x + width > COLUMN + 3.0 {
            rows.push(Vec::new());
            x = START;
        }
        rows.last_mut().expect("the first entry starts a row").push((index, x));
        x += width;
    }
    rows
}

/// Position and ranges of one panel, in millimetres and data units.
pub(super) struct Axes {
    pub left: f64,
    pub above: f64,
    pub width: f64,
    pub height: f64,
    /// The last generation.
    pub x_max: f64,
    /// The largest value.
    pub most: f64,
}

impl Axes {
    pub fn at(&self, generation: f64, value: f64) -> [f64; 2] {
        // Curves at the largest value stay below the edge.
        let y = (value / (self.most * 1.04)).clamp(0.0, 1.0);
        [self.left + self.width * generation / self.x_max, self.above + self.height * (1.0 - y)]
    }

    /// Draws the axes. The y axis has numbers if it is `numbered`: shares, or numbers of POIs. The picture ends at `edge`.
    pub fn draw(&self, scene: &mut Scene, numbered: bool, shares: bool, edge: f64) {
        let Axes { left, above, width, height, .. } = *self;
        let (right, below) = (left + width, above + height);
        let ticks = match shares {
            true => [0.0, 0.25, 0.5, 0.75, 1.0].to_vec(),
            false => poi_ticks(self.most as usize).into_iter().map(|tick| tick as f64).collect(),
        };
        for tick in ticks {
            let [_, y] = self.at(0.0, tick);
            scene.line(vec![[left, y], [right, y]], Pen::new(LIGHT, 0.15));
            scene.line(vec![[left - 0.9, y], [left, y]], Pen::new(BLACK, 0.2));
            if numbered {
                scene.text([left - 1.5, y + 0.9], number(tick), SMALL, Anchor::End, BLACK);
            }
        }
        for tick in whole_ticks(self.x_max, if width > 50.0 { 8 } else { 4 }) {
            let [x, _] = self.at(tick, 0.0);
            scene.line(vec![[x, below], [x, below + 0.9]], Pen::new(BLACK, 0.2));
            let label = number(tick);
            let inside = edge - 0.3 - text_width(&label, SMALL) / 2.0;
            scene.text([x.min(inside), below + 3.5], label, SMALL, Anchor::Middle, BLACK);
        }
        scene.line(vec![[left, above], [left, below], [right, below]], Pen::new(BLACK, 0.2));
    }

    /// Draws a line at the start of each stage, labelled with its number if there is room.
    fn stages(&self, scene: &mut Scene, stages: &[usize]) {
        for (index, &from) in stages.iter().enumerate() {
            let [x, below] = self.at(from as f64, 0.0);
            scene.line(vec![[x, self.above], [x, below]], Pen { dash: &[0.5, 0.5], ..Pen::new(GREY, 0.2) });
            let label = format!("stage {}", index + 1);
            let end = stages.get(index + 1).map_or(self.left + self.width, |&next| self.at(next as f64, 0.0)[0]);
            if x + 0.8 + text_width(&label, SMALL) < end {
                scene.text([x + 0.8, below - 1.0], label, SMALL, Anchor::Start, GREY);
            }
        }
    }

    /// Draws the bands of curves, unless bars replace them.
    pub fn bands(&self, scene: &mut Scene, curves: &[(usize, &Curve)], band: Band, bars: bool) {
        for (index, curve) in curves.iter().filter(|_| !bars) {
            if let Some(outline) = curve.outline(band, self.most) {
                let outline = outline.into_iter().map(|(generation, value)| self.at(generation, value)).collect();
                scene.polygon(outline, Some(Fill { color: Look::of(*index).color, opacity: 0.2 }), None);
            }
        }
    }

    /// Draws curves, each with its index in the legend of `of` curves, and the bars of their last generation, side by
    /// side.
    pub fn curves(&self, scene: &mut Scene, curves: &[(usize, &Curve)], band: Band, bars: bool, of: usize) {
        for (index, curve) in curves {
            self.curve(scene, curve, *index, of);
        }
        for (place, (index, curve)) in curves.iter().rev().enumerate().filter(|_| bars) {
            let Some(last) = curve.mean.len().checked_sub(1) else { continue };
            let ends = curve.ends(band, last, self.most);
            let [x, y] = self.at(curve.generation[last], curve.mean[last]);
            let (x, look) = (x - 0.8 - 2.0 * place as f64, Look::of(*index));
            if ends[0] < ends[1] {
                let [low, high] = ends.map(|end| [x, self.at(0.0, end)[1]]);
                scene.line(vec![low, high], Pen::new(look.color, 0.4));
                look.mark(scene, [x, y]);
            }
        }
    }

    fn points(&self, curve: &Curve) -> Vec<[f64; 2]> {
        curve.generation.iter().zip(&curve.mean).map(|(&x, &y)| self.at(x, y)).collect()
    }

    /// Draws the mean with a few marks. Marks of different curves are shifted, because curves may overlap.
    fn curve(&self, scene: &mut Scene, curve: &Curve, index: usize, of: usize) {
        const MARKS: usize = 5;
        let look = Look::of(index);
        let points = self.points(curve);
        scene.line(points.clone(), look.pen());
        let last = points.len().saturating_sub(1) as f64;
        let shift = (index as f64 + 0.5) / of.max(1) as f64;
        for mark in 0..MARKS {
            let place = (last * (mark as f64 + shift) / MARKS as f64).round() as usize;
            if let Some(&point) = points.get(place) {
                look.mark(scene, point);
            }
        }
    }
}

/// Style of a curve: colour, dashes and mark. The first five curves differ in both colour and dashes.
#[derive(Clone, Copy)]
pub(super) struct Look {
    color: Color,
    dash: &'static [f64],
    shape: usize,
}

impl Look {
    pub fn of(index: usize) -> Look {
        Look { color: COLORS[index % COLORS.len()], dash: DASHES[index % DASHES.len()], shape: index % 4 }
    }

    pub fn pen(&self) -> Pen {
        Pen { dash: self.dash, ..Pen::new(self.color, 0.4) }
    }

    pub fn mark(&self, scene: &mut Scene, [x, y]: [f64; 2]) {
        let (fill, pen) = (Some(Fill::from(self.color)), Some(Pen::new(WHITE, 0.15)));
        let corners = |offsets: &[[f64; 2]]| offsets.iter().map(|[dx, dy]| [x + dx, y + dy]).collect::<Vec<_>>();
        match self.shape {
            0 => scene.circle([x, y], 0.8, fill, pen),
            1 => scene.rectangle([x - 0.7, y - 0.7, 1.4, 1.4], fill, pen),
            2 => scene.polygon(corners(&[[0.0, -1.0], [0.95, 0.7], [-0.95, 0.7]]), fill, pen),
            _ => scene.polygon(corners(&[[0.0, -1.05], [1.05, 0.0], [0.0, 1.05], [-1.05, 0.0]]), fill, pen),
        }
    }
}

/// Returns the smallest round number (1, 2 or 5 times a power of ten) that is at least `least`.
pub(crate) fn round_step(least: f64) -> f64 {
    let power = libm::pow(10.0, libm::log10(least).floor());
    [1.0, 2.0, 5.0].into_iter().map(|step| step * power).find(|&step| step >= least * 0.999).unwrap_or(10.0 * power)
}

/// Returns round whole numbers from 0 to an end, in about the given number of steps.
fn whole_ticks(end: f64, steps: usize) -> Vec<f64> {
    let step = round_step((end / steps as f64).max(1.0));
    (0..).map(|index| f64::from(index) * step).take_while(|&tick| tick <= end * 1.0001).collect()
}

/// Returns axis ticks for numbers of POIs, from 0 to all of them inclusive.
pub fn poi_ticks(pois: usize) -> Vec<usize> {
    // Prefer a step that divides the number of POIs, round steps first. Otherwise use a round step, and drop ticks too
    // close to the last.
    let fits = |step: &usize| pois.is_multiple_of(*step) && (3..=6).contains(&(pois / step));
    let even = [1, 2, 5, 10, 20, 25, 50].into_iter().find(fits).or_else(|| (1..=pois).find(fits));
    let step = if pois <= 8 { 1 } else { even.unwrap_or(round_step(pois as f64 / 6.0) as usize) };
    let ticks = (0..pois).step_by(step).filter(|tick| *tick == 0 || 12 * (pois - tick) >= pois);
    ticks.chain([pois]).collect()
}

fn number(value: f64) -> String {
    rounded(value, 3)
}

/// Shortens labels to a width but keeps them distinct.
pub fn distinct(labels: &[String], width: f64, size: f64) -> Vec<String> {
    let fits = |label: &String| text_width(label, size) <= width;
    if labels.iter().all(fits) {
        return labels.to_vec();
    }
    // A prefix or suffix that all labels share does not distinguish them.
    let letters: Vec<Vec<char>> = labels.iter().map(|label| label.chars().collect()).collect();
    let least = letters.iter().map(Vec::len).min().unwrap_or(0);
    let alike = |at: &dyn Fn(&[char]) -> char| letters.windows(2).all(|pair| at(&pair[0]) == at(&pair[1]));
    let head = if labels.len() > 1 { (0..least).take_while(|&i| alike(&|label| label[i])).count() } else { 0 };
    let room = if labels.len() > 1 { least - head } else { 0 };
    let tail = (0..room).take_while(|&i| alike(&|label| label[label.len() - 1 - i])).count();
    // Replacing fewer than four letters with an ellipsis saves no room.
    let (head, tail) = (if head < 4 { 0 } else { head }, if tail < 4 { 0 } else { tail });
    let cut = |label: &Vec<char>| {
        let middle: String = label[head..label.len() - tail].iter().collect();
        let [before, after] = [head, tail].map(|length| if length > 0 { "…" } else { "" });
        middle_out(&format!("{before}{middle}{after}"), width, size)
    };
    let short: Vec<String> = letters.iter().map(cut).collect();
    let twice = |label: &String| short.iter().filter(|other| *other == label).count() > 1;
    // Labels that differ only in their middle are numbered, in the given order.
    let numbered = |(index, label): (usize, &String)| match twice(label) {
        true => middle_out(&format!("{} {label}", index + 1), width, size),
        false => label.clone(),
    };
    short.iter().enumerate().map(numbered).collect()
}

/// Removes the middle of a text that is wider than `width`.
fn middle_out(text: &str, width: f64, size: f64) -> String {
    let letters: Vec<char> = text.chars().collect();
    let without = |left: usize| {
        let (head, tail) = (left.div_ceil(2), left / 2);
        let [head, tail]: [String; 2] =
            [letters[..head].iter().collect(), letters[letters.len() - tail..].iter().collect()];
        format!("{head}…{tail}")
    };
    if text_width(text, size) <= width {
        return text.to_string();
    }
    (0..letters.len()).rev().map(without).find(|short| text_width(short, size) <= width).unwrap_or_else(|| "…".into())
}
