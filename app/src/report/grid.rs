//! Figures of a sweep: heat maps over two axes, curves by the values of an axis, and dots for keys that are varied one
//! at a time.

use super::curves::{
    Axes, Band, Curve, Look, NORMAL, SMALL, band_caption, distinct, draw_caption, generation_label, needs_bars,
};
use super::scene::{Anchor, BLACK, Color, Fill, GREY, LIGHT, Pen, Scene, WHITE, colors, text_width};

/// Maximum width of a figure in millimetres. Further panels go to the next row.
const WIDEST: f64 = 180.0;
const GAP: f64 = 5.0;
/// Room for labels below a panel.
const BELOW: f64 = 15.0;

/// A sequential palette of decreasing lightness (ColorBrewer's YlGnBu). It keeps its order for colour-blind readers and
/// in greyscale.
const PALETTE: [Color; 9] =
    colors([0xffffd9, 0xedf8b1, 0xc7e9b4, 0x7fcdbb, 0x41b6c4, 0x1d91c0, 0x225ea8, 0x253494, 0x081d58]);

/// Returns the colour of a value in 0..1.
pub(crate) fn shade(value: f64) -> Color {
    let place = value.clamp(0.0, 1.0) * (PALETTE.len() - 1) as f64;
    let low = (place as usize).min(PALETTE.len() - 2);
    let part = place - low as f64;
    let mix = |a: u8, b: u8| (f64::from(a) + part * (f64::from(b) - f64::from(a))).round() as u8;
    std::array::from_fn(|channel| mix(PALETTE[low][channel], PALETTE[low + 1][channel]))
}

/// Returns white or black, whichever is more legible on a colour. The weights are those of luma (ITU-R BT.601).
fn ink(on: Color) -> Color {
    let [r, g, b] = on.map(f64::from);
    if 0.299 * r + 0.587 * g + 0.114 * b > 140.0 { BLACK } else { WHITE }
}

/// One axis of a sweep.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Scale {
    /// The axis's key.
    pub label: String,
    /// The axis's values, as text.
    pub values: Vec<String>,
}

/// Content of one cell of a heat map.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) enum Cell {
    /// Nothing ran here.
    #[default]
    Empty,
    /// A shade in 0..1, the text on it, and smaller text below that, such as its interval.
    Value(f64, String, String),
    /// No value, and the reason.
    Word(String),
}

/// A heat map over two axes, with one panel per combination of the other axes' values.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct HeatMap {
    /// Title above all panels.
    pub title: String,
    /// The horizontal axis.
    pub x: Scale,
    /// The vertical axis. Without values there is a single row.
    pub y: Scale,
    /// Title and cells `[y][x]` of each panel.
    pub panels: Vec<(String, Vec<Cell>)>,
    /// Labels of the colour bar, each with its position in 0..1.
    pub key: Vec<(f64, String)>,
    /// Text to the right of the colour bar: the meaning of the colours, and of the cells' second line.
    pub key_label: [String; 2],
}

impl HeatMap {
    pub fn scene(&self) -> Scene {
        const HIGH: f64 = 9.0;
        const NOTE: f64 = 2.0;
        const KEY: f64 = 50.0;
        let longest = |labels: &[String]| labels.iter().map(|label| text_width(label, SMALL)).fold(0.0, f64::max);
        let titles = self.panels.iter().map(|(title, _)| text_width(title, NORMAL)).fold(0.0, f64::max);
        let columns = self.x.values.len();
        let notes = self.panels.iter().flat_map(|(_, cells)| cells).filter_map(|cell| match cell {
            Cell::Value(_, _, note) => Some(text_width(note, NOTE) + 2.0),
            _ => None,
        });
        let notes = notes.fold(0.0, f64::max);
        let wide = (longest(&self.x.values) + 3.0).clamp(11.0, 40.0).max((titles + 2.0) / columns as f64).max(notes);
        let rows = self.y.values.len().max(1);
        let left = if self.y.values.is_empty() { 3.0 } else { 8.0 + longest(&self.y.values) };
        let key_label = self.key_label.iter().map(|label| text_width(label, SMALL)).fold(0.0, f64::max);
        let least = (text_width(&self.title, 3.2) * 1.1 + 6.0).max(left + KEY + 4.0 + key_label + 3.0);
        let mut panels = Panels::new(self.panels.len(), wide * columns as f64, HIGH * rows as f64, left);
        panels.fill(least);
        panels.above -= if titles > 0.0 { 0.0 } else { 4.0 };
        let (width, height, wide) = (panels.width, panels.height, panels.width / columns as f64);
        let (key_width, key_above) = (KEY, panels.above + panels.height() + 3.0);
        // Without values there are no colours to explain.
        let coloured = self.panels.iter().flat_map(|(_, cells)| cells).any(|cell| matches!(cell, Cell::Value(..)));
        let mut scene = Scene::new(panels.width().max(least), key_above + if coloured { 9.5 } else { -1.5 });
        scene.bold([3.0, 5.0], &*self.title, 3.2, Anchor::Start, BLACK);
        (scene.title, scene.description) = (self.title.clone(), self.description());

        for (index, (title, cells)) in self.panels.iter().enumerate() {
            let [x, y] = panels.place(index);
            scene.text([x + width / 2.0, y - 1.6], &**title, NORMAL, Anchor::Middle, BLACK);
            for (at, cell) in cells.iter().enumerate() {
                let area = [x + wide * (at % columns) as f64, y + HIGH * (at / columns) as f64, wide, HIGH];
                let (fill, text, note, color) = match cell {
                    Cell::Empty => (WHITE, "", "", GREY),
                    Cell::Value(value, text, note) => (shade(*value), &**text, &**note, ink(shade(*value))),
                    Cell::Word(text) => (LIGHT, &**text, "", BLACK),
                };
                scene.rectangle(area, Some(fill.into()), Some(Pen::new(WHITE, 0.3)));
                let lift = if note.is_empty() { 0.0 } else { 1.5 };
                let middle = [area[0] + wide / 2.0, area[1] + HIGH / 2.0 + 0.9 - lift];
                if *cell == Cell::Empty {
                    // An impossible combination is crossed out, so that it is not taken for a low value.
                    let [x, y] = [area[0], area[1]];
                    scene.line(vec![[x + 1.0, y + HIGH - 1.0], [x + wide - 1.0, y + 1.0]], Pen::new(LIGHT, 0.3));
                }
                scene.text(middle, text, SMALL, Anchor::Middle, color);
                scene.text([middle[0], middle[1] + 3.0], note, NOTE, Anchor::Middle, color);
            }
            scene.rectangle([x, y, width, height], None, Some(Pen::new(GREY, 0.2)));
            for (at, label) in self.x.values.iter().enumerate() {
                let place = [x + wide * (at as f64 + 0.5), y + height + 3.4];
                scene.text(place, &**label, SMALL, Anchor::Middle, BLACK);
            }
            scene.text([x + width / 2.0, y + height + 7.4], &*self.x.label, NORMAL, Anchor::Middle, BLACK);
            if panels.is_first(index) {
                for (at, label) in self.y.values.iter().enumerate() {
                    let place = [x - 1.3, y + HIGH * (at as f64 + 0.5) + 0.9];
                    scene.text(place, &**label, SMALL, Anchor::End, BLACK);
                }
                if !self.y.values.is_empty() {
                    scene.upright([3.8, y + height / 2.0], &*self.y.label, NORMAL, BLACK);
                }
            }
        }
        if !coloured {
            return scene;
        }
        let steps = 64;
        for step in 0..steps {
            let part = key_width / f64::from(steps);
            let color = shade((f64::from(step) + 0.5) / f64::from(steps));
            // Each step extends to the end of the bar, below the next one. Adjacent rectangles would show seams.
            let start = part * f64::from(step);
            let area = [left + start, key_above, key_width - start, 2.6];
            scene.rectangle(area, Some(color.into()), None);
        }
        scene.rectangle([left, key_above, key_width, 2.6], None, Some(Pen::new(GREY, 0.2)));
        for (place, label) in &self.key {
            let x = left + place * key_width;
            scene.line(vec![[x, key_above + 2.6], [x, key_above + 3.4]], Pen::new(BLACK, 0.2));
            scene.text([x, key_above + 6.3], &**label, SMALL, Anchor::Middle, BLACK);
        }
        for (row, label) in self.key_label.iter().enumerate() {
            let place = [left + key_width + 4.0, key_above + 2.2 + 4.0 * row as f64];
            scene.text(place, &**label, SMALL, Anchor::Start, BLACK);
        }
        scene
    }

    /// Describes every cell, row by row.
    fn description(&self) -> String {
        let (columns, [x, y]) = (self.x.values.len(), [&self.x.label, &self.y.label]);
        let mut text = format!("A heat map by {x}{}{y}.", if y.is_empty() { "" } else { " and " });
        let labels: Vec<_> = self.key_label.iter().filter(|label| !label.is_empty()).map(String::as_str).collect();
        if !labels.is_empty() {
            text += &format!(" {}.", labels.join("; "));
        }
        for (title, cells) in &self.panels {
            for (row, cells) in cells.chunks(columns.max(1)).enumerate() {
                let row = self.y.values.get(row).map(|value| format!("{y} {value}"));
                let place: Vec<_> = [title.clone()].into_iter().filter(|title| !title.is_empty()).chain(row).collect();
                let described = |(value, cell): (&String, &Cell)| match cell {
                    Cell::Empty => format!("{value}: none"),
                    Cell::Value(_, word, note) if !note.is_empty() => format!("{value}: {word} ({note})"),
                    Cell::Value(_, word, _) | Cell::Word(word) => format!("{value}: {word}"),
                };
                let described: Vec<_> = self.x.values.iter().zip(cells).map(described).collect();
                text += &format!(
                    " {}{}{}.",
                    place.join(", "),
                    if place.is_empty() { "" } else { ": " },
                    described.join(", ")
                );
            }
        }
        text
    }
}

/// Curves of G in 0..1 by generation: one curve per value of an axis, one panel per combination of the others.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Curves {
    /// Title above all panels.
    pub title: String,
    /// Label of the y axis: whose G is shown.
    pub y_label: String,
    /// The axis whose values distinguish the curves.
    pub by: Scale,
    /// Number of panels per row; 0 for as many as fit.
    pub columns: usize,
    pub band: Band,
    /// Title of each panel, and its curves, each with the index of its value.
    pub panels: Vec<(String, Vec<(usize, Curve)>)>,
}

impl Curves {
    pub fn scene(&self) -> Scene {
        const HEIGHT: f64 = 26.0;
        const LEFT: f64 = 14.0;
        let titles = self.panels.iter().map(|(title, _)| text_width(title, SMALL)).fold(0.0, f64::max);
        let least = titles.max(38.0) + 1.0;
        let labels = distinct(&self.by.values, WIDEST / 3.0, SMALL);
        let entries: Vec<f64> = labels.iter().map(|value| 9.0 + text_width(value, SMALL)).collect();
        let legend = text_width(&self.by.label, NORMAL) + 6.0;
        let mut panels = Panels::new(self.panels.len(), least, HEIGHT, LEFT);
        if self.columns > 0 {
            panels.columns = panels.columns.min(self.columns);
        }
        let whole = panels
            .width()
            .max(text_width(&self.title, 3.2) * 1.1 + 6.0)
            .max(legend + entries.iter().fold(0.0, |a, &b| f64::max(a, b)));
        panels.fill(whole);
        let width = panels.width;
        let mut places = Vec::new();
        let (mut x, mut y) = (legend, 10.0);
        for entry in entries {
            if x + entry > whole && x > legend {
                (x, y) = (legend, y + 4.2);
            }
            places.push([x, y]);
            x += entry + 1.5;
        }
        panels.above = y + if titles > 0.0 { 9.0 } else { 5.0 };
        let bars = needs_bars(self.panels.iter().map(|(_, curves)| curves.len()));
        let all = self.panels.iter().flat_map(|(_, curves)| curves).map(|(_, curve)| curve);
        let banded = band_caption(self.band, bars, all);
        let caption = if banded.is_some() { 4.5 } else { 0.0 };
        let mut scene = Scene::new(whole, panels.above + panels.height() + caption);
        (scene.title, scene.description) = (self.title.clone(), self.description());
        if let Some(caption) = banded {
            let place = [3.0, scene.height - 2.0];
            draw_caption(&mut scene, place, &caption, bars);
        }
        scene.bold([3.0, 5.0], &*self.title, 3.2, Anchor::Start, BLACK);
        scene.text([3.0, 10.9], &*self.by.label, NORMAL, Anchor::Start, BLACK);
        for (at, (label, [x, y])) in labels.iter().zip(places).enumerate() {
            scene.line(vec![[x, y], [x + 6.0, y]], Look::of(at).pen());
            Look::of(at).mark(&mut scene, [x + 3.0, y]);
            scene.text([x + 7.0, y + 0.9], &**label, SMALL, Anchor::Start, BLACK);
        }
        let generations = self.panels.iter().flat_map(|(_, curves)| curves).filter_map(|(_, c)| c.generation.last());
        let last = generations.fold(1.0, |a: f64, &b| a.max(b));
        for (index, (title, curves)) in self.panels.iter().enumerate() {
            let [left, above] = panels.place(index);
            let axes = Axes { left, above, width, height: HEIGHT, x_max: last, most: 1.0 };
            axes.draw(&mut scene, panels.is_first(index), true, whole);
            let thinned: Vec<_> = curves.iter().map(|(value, curve)| (*value, curve.thinned())).collect();
            let each = thinned.iter().map(|(_, (_, each))| *each).max().unwrap_or(1);
            let below = [left + width / 2.0, above + HEIGHT + 7.4];
            scene.text(below, generation_label(each), SMALL, Anchor::Middle, BLACK);
            scene.text([left + width / 2.0, above - 1.6], &**title, SMALL, Anchor::Middle, BLACK);
            if panels.is_first(index) {
                scene.upright([4.0, above + HEIGHT / 2.0], &*self.y_label, SMALL, BLACK);
            }
            scene.clipped([left - 0.4, above - 0.4, width + 0.8, HEIGHT + 0.8], |scene| {
                let curves: Vec<_> = thinned.iter().map(|(value, (curve, _))| (*value, curve)).collect();
                axes.bands(scene, &curves, self.band, bars);
                axes.curves(scene, &curves, self.band, bars, labels.len());
            });
        }
        scene
    }

    /// Describes the last point of each curve.
    fn description(&self) -> String {
        let mut text = format!("Learning curves by {}, with the mean of the last generation.", self.by.label);
        for (title, curves) in &self.panels {
            let end = |(value, curve): &(usize, Curve)| {
                let (mean, value) = (curve.mean.last()?, self.by.values.get(*value)?);
                Some(format!("{value}: {mean:.2}{}", curve.describe(self.band, curve.mean.len() - 1)))
            };
            let ends: Vec<_> = curves.iter().filter_map(end).collect();
            text += &format!(" {title}{}{}.", if title.is_empty() { "" } else { ": " }, ends.join(", "));
        }
        text
    }
}

/// Mean, lower end and upper end of an interval, in 0..1.
pub type Interval = [f64; 3];

/// A figure of means with intervals for keys that are varied one at a time, next to the unvaried result. Each panel
/// shows one setting.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dots {
    /// Title above all panels.
    pub title: String,
    pub x_label: String,
    /// The varied keys, from top to bottom: a label with the key's unvaried value, and its other values.
    pub groups: Vec<(String, Vec<String>)>,
    /// Title of each panel, the unvaried result, and the results of all rows of all groups.
    pub panels: Vec<(String, Option<Interval>, Vec<Option<Interval>>)>,
}

impl Dots {
    /// Describes each panel, row by row.
    fn description(&self) -> String {
        let described = |spread: &Option<Interval>| spread.map_or("missing".into(), |[mean, ..]| format!("{mean:.2}"));
        let headed = |name: &str| if name.is_empty() { String::new() } else { format!("{name}: ") };
        let panel = |(title, base, found): &(String, Option<Interval>, Vec<Option<Interval>>)| {
            let mut found = found.iter();
            let group = |(name, values): &(String, Vec<String>)| {
                let values: Vec<_> = values
                    .iter()
                    .zip(&mut found)
                    .map(|(value, spread)| format!("{value} {}", described(spread)))
                    .collect();
                format!("{}{}", headed(name), values.join(", "))
            };
            let groups: Vec<_> = self.groups.iter().map(group).collect();
            let base = base.map_or(String::new(), |[mean, ..]| format!("{mean:.2} as in the file; "));
            format!("{}{base}{}.", headed(title), groups.join("; "))
        };
        self.panels.iter().map(panel).collect::<Vec<_>>().join(" ")
    }

    pub fn scene(&self) -> Scene {
        const HIGH: f64 = 4.0;
        const RADIUS: f64 = 0.75;
        // Width of the text beside each row.
        const WRITTEN: f64 = 8.5;
        let values = self.groups.iter().flat_map(|(_, values)| values).map(|value| text_width(value, SMALL) + 4.0);
        let names = self.groups.iter().map(|(name, _)| text_width(name, SMALL) * 1.1);
        let left = 5.0 + values.chain(names).fold(0.0, f64::max);
        let titles = self.panels.iter().map(|(title, ..)| text_width(title, SMALL)).fold(0.0, f64::max);
        let rows: f64 = self.groups.iter().map(|(_, values)| 1.25 + values.len() as f64).sum();
        // The label below a panel may also use the width of the text beside the rows.
        let (plot, height) = (titles.max(34.0).max(text_width(&self.x_label, SMALL) - WRITTEN), HIGH * rows);
        let mut panels = Panels::new(self.panels.len(), plot + WRITTEN, height, left);
        let whole = panels.width().max(text_width(&self.title, 3.2) * 1.1 + 6.0);
        panels.fill(whole);
        panels.above -= if titles > 0.0 { 0.0 } else { 4.0 };
        let plot = panels.width - WRITTEN;
        let mut scene = Scene::new(whole, panels.above + panels.height());
        (scene.title, scene.description) = (self.title.clone(), self.description());
        scene.bold([3.0, 5.0], &*self.title, 3.2, Anchor::Start, BLACK);

        let (accent, own) = (shade(0.7), Pen { dash: &[1.2, 0.8], ..Pen::new(BLACK, 0.25) });
        for (index, (title, base, found)) in self.panels.iter().enumerate() {
            let [x, y] = panels.place(index);
            let at = |g: f64| x + plot * g.clamp(0.0, 1.0);
            scene.text([x + plot / 2.0, y - 1.6], &**title, SMALL, Anchor::Middle, BLACK);
            if let Some([mean, low, high]) = *base {
                let fill = Fill { color: GREY, opacity: 0.25 };
                scene.rectangle([at(low), y, (at(high) - at(low)).max(0.3), height], Some(fill), None);
                scene.line(vec![[at(mean), y], [at(mean), y + height]], own.clone());
            }
            for (tick, label) in [(0.0, "0"), (0.5, "0.5"), (1.0, "1")] {
                scene.line(vec![[at(tick), y], [at(tick), y + height]], Pen::new(LIGHT, 0.15));
                scene.text([at(tick), y + height + 3.4], label, SMALL, Anchor::Middle, BLACK);
            }
            scene.rectangle([x, y, plot, height], None, Some(Pen::new(GREY, 0.2)));
            scene.text([x + plot / 2.0, y + height + 7.4], &*self.x_label, SMALL, Anchor::Middle, BLACK);
            let (mut row, mut found) = (0.0, found.iter());
            for (name, values) in &self.groups {
                let line = |row: f64| y + HIGH * row + HIGH / 2.0;
                if panels.is_first(index) {
                    scene.bold([3.0, line(row) + 1.3], &**name, SMALL, Anchor::Start, BLACK);
                }
                row += 1.25;
                for value in values {
                    if panels.is_first(index) {
                        scene.text([x - 1.5, line(row) + 0.9], &**value, SMALL, Anchor::End, BLACK);
                    }
                    if let Some([mean, low, high]) = found.next().copied().flatten() {
                        scene.line(vec![[at(low), line(row)], [at(high), line(row)]], Pen::new(accent, 0.5));
                        scene.circle([at(mean), line(row)], RADIUS, Some(accent.into()), None);
                        let place = [x + plot + 1.2, line(row) + 0.9];
                        scene.text(place, format!("{mean:.2}"), SMALL, Anchor::Start, BLACK);
                    }
                    row += 1.0;
                }
            }
        }
        scene
    }
}

/// Layout of panels of equal size in rows. The first panel of each row has labels on its left.
struct Panels {
    count: usize,
    columns: usize,
    width: f64,
    height: f64,
    left: f64,
    above: f64,
}

impl Panels {
    fn new(count: usize, width: f64, height: f64, left: f64) -> Panels {
        let fit = ((WIDEST - left) / (width + GAP)) as usize;
        // As few rows as fit, with panels spread evenly over them.
        let rows = count.div_ceil(fit.clamp(1, count.max(1))).max(1);
        Panels { count, columns: count.div_ceil(rows).max(1), width, height, left, above: 12.0 }
    }

    fn place(&self, index: usize) -> [f64; 2] {
        let (row, column) = (index / self.columns, index % self.columns);
        [self.left + (self.width + GAP) * column as f64, self.above + (self.height + BELOW) * row as f64]
    }

    /// Widens the panels so that a row of them is at least as wide as the picture.
    fn fill(&mut self, whole: f64) {
        let wide = (whole - self.left) / self.columns as f64 - GAP;
        self.width = self.width.max(wide);
    }

    fn is_first(&self, index: usize) -> bool {
        index.is_multiple_of(self.columns)
    }

    fn width(&self) -> f64 {
        self.left + (self.width + GAP) * self.columns as f64
    }

    fn height(&self) -> f64 {
        (self.height + BELOW) * self.count.div_ceil(self.columns) as f64 - BELOW + 9.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_without_values_has_no_colour_bar() {
        let [some, none] =
            [Cell::Value(1.0, "1.00".into(), String::new()), Cell::Word("not reached".into())].map(|cell| {
                let x = Scale { label: "coupling".into(), values: vec!["1".into()] };
                let key = vec![(0.0, "first".to_string()), (1.0, "last".into())];
                HeatMap { x, panels: vec![(String::new(), vec![cell])], key, ..HeatMap::default() }.scene().svg()
            });
        let labelled = |svg: &str| ["first", "last"].map(|label| svg.contains(&format!("aria-label=\"{label}\"")));
        assert_eq!((labelled(&some), labelled(&none)), ([true; 2], [false; 2]));
    }
}
