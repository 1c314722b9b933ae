//! A picture described once, in millimetres, and written as SVG, as pixels or as PNG.
//!
//! Pixels need letters: the font is embedded, so that a bare machine draws the same picture. An SVG names the generic
//! family and leaves the letters to whoever shows it.

use std::fmt::Write;
use std::sync::LazyLock;

use tiny_skia::{
    FillRule, LineCap, LineJoin, Mask, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, StrokeDash, Transform,
};
use ttf_parser::{Face, OutlineBuilder};

/// Units of an SVG in a millimetre: letters one unit high would be less than browsers can draw.
const SVG_UNITS: f64 = 10.0;
/// Pixels of the longest side of a picture.
const MAX_PIXELS: f64 = 8192.0;

static FONT: LazyLock<Face<'static>> =
    LazyLock::new(|| Face::parse(include_bytes!("font/dejavu-sans.ttf"), 0).expect("the embedded font is whole"));

/// Red, green, blue.
pub type Color = [u8; 3];

pub const BLACK: Color = [0, 0, 0];
pub const WHITE: Color = [255, 255, 255];
pub const GREY: Color = [120, 120, 120];
pub const LIGHT: Color = [222, 222, 222];

/// Colours that the colour-blind tell apart, by Okabe and Ito, those first that stay apart in grey as well.
pub const COLORS: [Color; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [140, 109, 0], [0, 0, 0]];

/// How a line is drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct Pen {
    pub color: Color,
    /// Millimetres.
    pub width: f64,
    /// Lengths of dashes and gaps in turn, in millimetres; none for a solid line.
    pub dash: &'static [f64],
    pub opacity: f64,
}

impl Pen {
    pub fn new(color: Color, width: f64) -> Pen {
        Pen { color, width, dash: &[], opacity: 1.0 }
    }
}

/// What an area is filled with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fill {
    pub color: Color,
    pub opacity: f64,
}

impl From<Color> for Fill {
    fn from(color: Color) -> Fill {
        Fill { color, opacity: 1.0 }
    }
}

/// Which part of a text stands at its place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    Start,
    Middle,
    End,
}

#[derive(Clone, Debug)]
enum Mark {
    Shape {
        points: Vec<[f64; 2]>,
        closed: bool,
        fill: Option<Fill>,
        pen: Option<Pen>,
    },
    Circle {
        center: [f64; 2],
        radius: f64,
        fill: Option<Fill>,
        pen: Option<Pen>,
    },
    /// `place` is on the baseline.
    Text {
        place: [f64; 2],
        text: String,
        size: f64,
        anchor: Anchor,
        color: Color,
        upright: bool,
        bold: bool,
    },
    /// What follows is seen within `[x, y, width, height]` only, or everywhere again.
    Clip(Option<[f64; 4]>),
}

/// A picture; places are millimetres from its left and upper edge.
#[derive(Clone, Debug)]
pub struct Scene {
    pub width: f64,
    pub height: f64,
    marks: Vec<Mark>,
}

impl Scene {
    pub fn new(width: f64, height: f64) -> Scene {
        Scene { width, height, marks: Vec::new() }
    }

    pub fn line(&mut self, points: Vec<[f64; 2]>, pen: Pen) {
        self.marks.push(Mark::Shape { points, closed: false, fill: None, pen: Some(pen) });
    }

    pub fn polygon(&mut self, points: Vec<[f64; 2]>, fill: Option<Fill>, pen: Option<Pen>) {
        self.marks.push(Mark::Shape { points, closed: true, fill, pen });
    }

    pub fn rectangle(&mut self, [x, y, width, height]: [f64; 4], fill: Option<Fill>, pen: Option<Pen>) {
        self.polygon(vec![[x, y], [x + width, y], [x + width, y + height], [x, y + height]], fill, pen);
    }

    pub fn circle(&mut self, center: [f64; 2], radius: f64, fill: Option<Fill>, pen: Option<Pen>) {
        self.marks.push(Mark::Circle { center, radius, fill, pen });
    }

    /// Text of a size (millimetres an em) from a place on its baseline.
    pub fn text(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, anchor: Anchor, color: Color) {
        self.marks.push(Mark::Text { place, text: text.into(), size, anchor, color, upright: false, bold: false });
    }

    pub fn bold(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, anchor: Anchor, color: Color) {
        self.marks.push(Mark::Text { place, text: text.into(), size, anchor, color, upright: false, bold: true });
    }

    /// Text that reads upwards, centred at a place.
    pub fn upright(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, color: Color) {
        let text = text.into();
        self.marks.push(Mark::Text { place, text, size, anchor: Anchor::Middle, color, upright: true, bold: false });
    }

    /// Shows what `draw` draws within `[x, y, width, height]` only.
    pub fn clipped(&mut self, area: [f64; 4], draw: impl FnOnce(&mut Scene)) {
        self.marks.push(Mark::Clip(Some(area)));
        draw(self);
        self.marks.push(Mark::Clip(None));
    }

    /// The picture as an SVG document.
    pub fn svg(&self) -> String {
        let mut svg = String::new();
        // Writing to a string cannot fail.
        let _ = self.write_svg(&mut svg);
        svg
    }

    fn write_svg(&self, svg: &mut String) -> std::fmt::Result {
        let [width, height] = [self.width, self.height].map(|side| Number(side * SVG_UNITS));
        writeln!(
            svg,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{}mm\" height=\"{}mm\" viewBox=\"0 0 {width} {height}\" \
             font-family=\"Helvetica, Arial, sans-serif\" stroke-linejoin=\"round\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>",
            Number(self.width),
            Number(self.height),
        )?;
        let mut clips = 0;
        let mut clipped = false;
        for mark in &self.marks {
            match mark {
                Mark::Shape { points, closed, fill, pen } => {
                    write!(svg, "<{} points=\"", if *closed { "polygon" } else { "polyline" })?;
                    for (index, point) in points.iter().enumerate() {
                        let [x, y] = point.map(|at| Number((at * SVG_UNITS * 10.0).round() / 10.0));
                        write!(svg, "{}{x},{y}", if index == 0 { "" } else { " " })?;
                    }
                    svg.push('"');
                    paint_svg(svg, fill.as_ref(), pen.as_ref())?;
                    svg.push_str("/>\n");
                }
                Mark::Circle { center, radius, fill, pen } => {
                    let [x, y, radius] = [center[0], center[1], *radius].map(|at| Number(at * SVG_UNITS));
                    write!(svg, "<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"")?;
                    paint_svg(svg, fill.as_ref(), pen.as_ref())?;
                    svg.push_str("/>\n");
                }
                Mark::Text { place, text, size, anchor, color, upright, bold } => {
                    let [x, y, size] = [place[0], place[1], *size].map(|at| Number(at * SVG_UNITS));
                    write!(svg, "<text x=\"{x}\" y=\"{y}\" font-size=\"{size}\" fill=\"{}\"", hex(*color))?;
                    match anchor {
                        Anchor::Start => {}
                        Anchor::Middle => svg.push_str(" text-anchor=\"middle\""),
                        Anchor::End => svg.push_str(" text-anchor=\"end\""),
                    }
                    if *bold {
                        svg.push_str(" font-weight=\"bold\"");
                    }
                    if *upright {
                        write!(svg, " transform=\"rotate(-90 {x} {y})\"")?;
                    }
                    svg.push('>');
                    for c in text.chars() {
                        match c {
                            '<' => svg.push_str("&lt;"),
                            '>' => svg.push_str("&gt;"),
                            '&' => svg.push_str("&amp;"),
                            // XML cannot hold most of these, and a picture has no use for any.
                            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => svg.push(' '),
                            c => svg.push(c),
                        }
                    }
                    svg.push_str("</text>\n");
                }
                Mark::Clip(area) => {
                    if std::mem::replace(&mut clipped, area.is_some()) {
                        svg.push_str("</g>\n");
                    }
                    if let Some([x, y, width, height]) = area.map(|area| area.map(|at| Number(at * SVG_UNITS))) {
                        clips += 1;
                        writeln!(
                            svg,
                            "<clipPath id=\"c{clips}\"><rect x=\"{x}\" y=\"{y}\" width=\"{width}\" \
                             height=\"{height}\"/></clipPath>\n<g clip-path=\"url(#c{clips})\">"
                        )?;
                    }
                }
            }
        }
        svg.push_str("</svg>\n");
        Ok(())
    }

    /// The picture in pixels, so many a millimetre (fewer where the longest side would take over 8192).
    pub fn pixels(&self, per_mm: f64) -> Pixmap {
        let scale = per_mm.min(MAX_PIXELS / self.width.max(self.height));
        let side = |length: f64| ((length * scale).round() as u32).max(1);
        let (width, height) = (side(self.width), side(self.height));
        let mut pixmap = Pixmap::new(width, height).expect("sides of 1 to 8192 pixels");
        pixmap.fill(tiny_skia::Color::WHITE);
        let transform = Transform::from_scale(scale as f32, scale as f32);
        let mut mask = None;
        for mark in &self.marks {
            match mark {
                Mark::Shape { points, closed, fill, pen } => {
                    let mut builder = PathBuilder::new();
                    for (index, [x, y]) in points.iter().enumerate() {
                        match index {
                            0 => builder.move_to(*x as f32, *y as f32),
                            _ => builder.line_to(*x as f32, *y as f32),
                        }
                    }
                    if *closed {
                        builder.close();
                    }
                    let pens = (fill.as_ref(), pen.as_ref());
                    paint_pixels(&mut pixmap, builder.finish(), pens, transform, mask.as_ref());
                }
                Mark::Circle { center: [x, y], radius, fill, pen } => {
                    let path = PathBuilder::from_circle(*x as f32, *y as f32, *radius as f32);
                    paint_pixels(&mut pixmap, path, (fill.as_ref(), pen.as_ref()), transform, mask.as_ref());
                }
                Mark::Text { place: [x, y], text, size, anchor, color, upright, bold } => {
                    let width = text_width(text, *size);
                    let start = match anchor {
                        Anchor::Start => 0.0,
                        Anchor::Middle => -width / 2.0,
                        Anchor::End => -width,
                    };
                    let turn = if *upright { -90.0 } else { 0.0 };
                    let place = transform.pre_translate(*x as f32, *y as f32).pre_concat(Transform::from_rotate(turn));
                    // The embedded font has one weight; an outline makes it the other.
                    let pen = bold.then(|| Pen::new(*color, size * 0.04));
                    let pens = (Some(&Fill::from(*color)), pen.as_ref());
                    let path = letters(text, *size, start);
                    paint_pixels(&mut pixmap, path, pens, place, mask.as_ref());
                }
                Mark::Clip(area) => {
                    mask = area.and_then(|[x, y, w, h]| {
                        let mut mask = Mask::new(width, height)?;
                        let area = PathBuilder::from_rect(Rect::from_xywh(x as f32, y as f32, w as f32, h as f32)?);
                        mask.fill_path(&area, FillRule::Winding, true, transform);
                        Some(mask)
                    });
                }
            }
        }
        pixmap
    }

    /// The picture as a PNG file, so many pixels a millimetre.
    ///
    /// # Errors
    /// The encoder refused, which it does for want of memory alone.
    pub fn png(&self, per_mm: f64) -> std::io::Result<Vec<u8>> {
        self.pixels(per_mm).encode_png().map_err(std::io::Error::other)
    }
}

/// How long a text is, in millimetres, if it is drawn in the embedded font.
pub fn text_width(text: &str, size: f64) -> f64 {
    text.chars().map(|c| advance(c) * size).sum()
}

/// How far a letter moves the next one, in ems.
fn advance(c: char) -> f64 {
    let glyph = FONT.glyph_index(c).unwrap_or_default();
    f64::from(FONT.glyph_hor_advance(glyph).unwrap_or(0)) / f64::from(FONT.units_per_em())
}

/// The outlines of a text whose baseline starts at `(start, 0)`.
fn letters(text: &str, size: f64, start: f64) -> Option<Path> {
    struct Outline {
        builder: PathBuilder,
        scale: f32,
        x: f32,
    }
    impl Outline {
        fn at(&self, x: f32, y: f32) -> (f32, f32) {
            (self.x + x * self.scale, -y * self.scale)
        }
    }
    impl OutlineBuilder for Outline {
        fn move_to(&mut self, x: f32, y: f32) {
            let (x, y) = self.at(x, y);
            self.builder.move_to(x, y);
        }
        fn line_to(&mut self, x: f32, y: f32) {
            let (x, y) = self.at(x, y);
            self.builder.line_to(x, y);
        }
        fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
            let ((x1, y1), (x, y)) = (self.at(x1, y1), self.at(x, y));
            self.builder.quad_to(x1, y1, x, y);
        }
        fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
            let ((x1, y1), (x2, y2), (x, y)) = (self.at(x1, y1), self.at(x2, y2), self.at(x, y));
            self.builder.cubic_to(x1, y1, x2, y2, x, y);
        }
        fn close(&mut self) {
            self.builder.close();
        }
    }
    let scale = (size / f64::from(FONT.units_per_em())) as f32;
    let mut outline = Outline { builder: PathBuilder::new(), scale, x: start as f32 };
    for c in text.chars() {
        FONT.outline_glyph(FONT.glyph_index(c).unwrap_or_default(), &mut outline);
        outline.x += (advance(c) * size) as f32;
    }
    outline.builder.finish()
}

fn paint_pixels(
    pixmap: &mut Pixmap,
    path: Option<Path>,
    (fill, pen): (Option<&Fill>, Option<&Pen>),
    transform: Transform,
    mask: Option<&Mask>,
) {
    let paint = |[r, g, b]: Color, opacity: f64| {
        let mut paint = Paint { anti_alias: true, ..Paint::default() };
        paint.set_color_rgba8(r, g, b, (opacity * 255.0).round() as u8);
        paint
    };
    let Some(path) = path else { return };
    if let Some(Fill { color, opacity }) = fill {
        pixmap.fill_path(&path, &paint(*color, *opacity), FillRule::Winding, transform, mask);
    }
    if let Some(Pen { color, width, dash, opacity }) = pen {
        let dash = dash.iter().map(|&length| length as f32).collect();
        let stroke = Stroke {
            width: *width as f32,
            line_cap: LineCap::Butt,
            line_join: LineJoin::Round,
            dash: StrokeDash::new(dash, 0.0),
            ..Stroke::default()
        };
        pixmap.stroke_path(&path, &paint(*color, *opacity), &stroke, transform, mask);
    }
}

fn paint_svg(svg: &mut String, fill: Option<&Fill>, pen: Option<&Pen>) -> std::fmt::Result {
    match fill {
        None => svg.push_str(" fill=\"none\""),
        Some(Fill { color, opacity }) => {
            write!(svg, " fill=\"{}\"", hex(*color))?;
            if *opacity < 1.0 {
                write!(svg, " fill-opacity=\"{}\"", Number(*opacity))?;
            }
        }
    }
    if let Some(Pen { color, width, dash, opacity }) = pen {
        write!(svg, " stroke=\"{}\" stroke-width=\"{}\"", hex(*color), Number(width * SVG_UNITS))?;
        if !dash.is_empty() {
            let dashes: Vec<_> = dash.iter().map(|length| Number(length * SVG_UNITS).to_string()).collect();
            write!(svg, " stroke-dasharray=\"{}\"", dashes.join(" "))?;
        }
        if *opacity < 1.0 {
            write!(svg, " stroke-opacity=\"{}\"", Number(*opacity))?;
        }
    }
    Ok(())
}

fn hex([r, g, b]: Color) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Printed with two digits after the point at most, and none that say nothing. (A tenth of a unit is 0.01 mm.)
struct Number(f64);

impl std::fmt::Display for Number {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let text = format!("{:.2}", self.0);
        f.write_str(text.trim_end_matches('0').trim_end_matches('.'))
    }
}
