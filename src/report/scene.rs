//! A picture described once, in millimetres, and written as SVG, as PDF, as pixels or as PNG.
//!
//! All of them draw the same letters, by the outlines of one embedded font: how long a text is does not depend on who
//! shows it. What is to be seen stands in the files in words, too, for those who cannot see it.

use std::collections::BTreeSet;
use std::fmt::Write;

use tiny_skia::{
    FillRule, LineCap, LineJoin, Mask, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, StrokeDash, Transform,
};

use super::letters;
pub use super::letters::text_width;

/// Units of an SVG in a millimetre: letters one unit high would be less than browsers can draw.
const SVG_UNITS: f64 = 10.0;
/// How thick the outline of bold letters is, in ems.
pub(super) const BOLD: f64 = 0.04;
/// Pixels of the longest side of a picture.
const MAX_PIXELS: f64 = 8192.0;

/// Red, green, blue.
pub type Color = [u8; 3];

/// Of text.
pub const BLACK: Color = [0, 0, 0];
/// Of paper.
pub const WHITE: Color = [255, 255, 255];
/// Of what matters less.
pub const GREY: Color = [120, 120, 120];
/// Of grids.
pub const LIGHT: Color = [222, 222, 222];

/// Colours that the colour-blind tell apart, by Okabe and Ito, those first that stay apart in grey as well.
pub const COLORS: [Color; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [140, 109, 0], [0, 0, 0]];

/// How a line is drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct Pen {
    /// Of the line.
    pub color: Color,
    /// Millimetres.
    pub width: f64,
    /// Lengths of dashes and gaps in turn, in millimetres; none for a solid line.
    pub dash: &'static [f64],
    /// From 0, nothing, to 1.
    pub opacity: f64,
}

impl Pen {
    /// A line of this colour and width, whole.
    pub fn new(color: Color, width: f64) -> Pen {
        Pen { color, width, dash: &[], opacity: 1.0 }
    }
}

/// What an area is filled with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fill {
    /// Of the area.
    pub color: Color,
    /// From 0, nothing, to 1.
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
    /// Its left end.
    Start,
    /// The middle of its width.
    Middle,
    /// Its right end.
    End,
}

#[derive(Clone, Debug)]
pub(super) enum Mark {
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
    /// Millimetres.
    pub width: f64,
    /// Millimetres.
    pub height: f64,
    /// What the picture is, in a few words.
    pub title: String,
    /// What is to be seen in it, in sentences with figures, for those who cannot see it.
    pub description: String,
    /// The digest of the run that it shows, which an SVG carries.
    pub source: Option<String>,
    pub(super) marks: Vec<Mark>,
}

/// What a picture is written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Vectors, for the web.
    Svg,
    /// Pixels.
    Png,
    /// Vectors, for print.
    Pdf,
}

impl Format {
    /// Every kind.
    pub const ALL: [Format; 3] = [Format::Svg, Format::Png, Format::Pdf];

    /// By the end of a file's name.
    pub fn of(path: &std::path::Path) -> Option<Format> {
        let extension = path.extension()?.to_ascii_lowercase();
        Format::ALL.into_iter().find(|kind| extension == kind.extension())
    }

    /// A file's ending, without its dot.
    pub fn extension(self) -> &'static str {
        match self {
            Format::Svg => "svg",
            Format::Png => "png",
            Format::Pdf => "pdf",
        }
    }
}

impl Scene {
    /// An empty picture of this size, in points.
    pub fn new(width: f64, height: f64) -> Scene {
        let (title, description, marks) = (String::new(), String::new(), Vec::new());
        Scene { width, height, title, description, source: None, marks }
    }

    /// Adds a line below all of it.
    pub fn warn(&mut self, text: &str) {
        const SIZE: f64 = 2.47;
        self.height += 4.0;
        self.text([1.0, self.height - 1.4], text, SIZE, Anchor::Start, BLACK);
        self.description += &format!(" {text}.");
    }

    /// The element by which an SVG says which run it shows.
    fn metadata(source: &str) -> String {
        format!("<metadata>run {source}</metadata>\n")
    }

    /// Whether the text of an SVG shows the run with this digest.
    pub fn shows(svg: &str, source: &str) -> bool {
        svg.contains(&Scene::metadata(source))
    }

    /// A line through places.
    pub fn line(&mut self, points: Vec<[f64; 2]>, pen: Pen) {
        self.marks.push(Mark::Shape { points, closed: false, fill: None, pen: Some(pen) });
    }

    /// A polygon, filled, outlined or both.
    pub fn polygon(&mut self, points: Vec<[f64; 2]>, fill: Option<Fill>, pen: Option<Pen>) {
        self.marks.push(Mark::Shape { points, closed: true, fill, pen });
    }

    /// An upright rectangle, by its corner and sides.
    pub fn rectangle(&mut self, [x, y, width, height]: [f64; 4], fill: Option<Fill>, pen: Option<Pen>) {
        self.polygon(vec![[x, y], [x + width, y], [x + width, y + height], [x, y + height]], fill, pen);
    }

    /// A circle.
    pub fn circle(&mut self, center: [f64; 2], radius: f64, fill: Option<Fill>, pen: Option<Pen>) {
        self.marks.push(Mark::Circle { center, radius, fill, pen });
    }

    /// Text of a size (millimetres an em) from a place on its baseline.
    pub fn text(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, anchor: Anchor, color: Color) {
        self.write(Mark::Text { place, text: text.into(), size, anchor, color, upright: false, bold: false });
    }

    /// Bold text at a place.
    pub fn bold(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, anchor: Anchor, color: Color) {
        self.write(Mark::Text { place, text: text.into(), size, anchor, color, upright: false, bold: true });
    }

    /// Text that reads upwards, centred at a place.
    pub fn upright(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, color: Color) {
        let text = text.into();
        self.write(Mark::Text { place, text, size, anchor: Anchor::Middle, color, upright: true, bold: false });
    }

    fn write(&mut self, mark: Mark) {
        if !matches!(&mark, Mark::Text { text, .. } if text.is_empty()) {
            self.marks.push(mark);
        }
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
        let [width, height] = [self.width, self.height].map(|side| Rounded(side * SVG_UNITS));
        writeln!(
            svg,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{}mm\" height=\"{}mm\" viewBox=\"0 0 {width} {height}\" \
             xmlns:xlink=\"http://www.w3.org/1999/xlink\" stroke-linejoin=\"round\" role=\"img\" \
             aria-labelledby=\"title description\">\n<title id=\"title\">{}</title>\n<desc id=\"description\">{}</desc>",
            Rounded(self.width),
            Rounded(self.height),
            Escaped(&self.title),
            Escaped(&self.description),
        )?;
        self.source.iter().for_each(|source| svg.push_str(&Scene::metadata(source)));
        // Each letter that occurs is drawn once, and used from there.
        let texts =
            self.marks.iter().filter_map(|mark| if let Mark::Text { text, .. } = mark { Some(text) } else { None });
        let glyphs: BTreeSet<_> = texts.flat_map(|text| letters::set(text).0).map(|(glyph, _, _)| glyph).collect();
        svg.push_str("<defs>\n");
        for (glyph, path) in glyphs.iter().filter_map(|&glyph| Some((glyph, letters::outline(glyph)?))) {
            writeln!(svg, "<path id=\"g{}\" d=\"{path}\"/>", glyph.0)?;
        }
        writeln!(svg, "</defs>\n<rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>")?;
        let mut clips = 0;
        let mut clipped = false;
        for mark in &self.marks {
            match mark {
                Mark::Shape { points, closed, fill, pen } => {
                    write!(svg, "<{} points=\"", if *closed { "polygon" } else { "polyline" })?;
                    for (index, point) in points.iter().enumerate() {
                        let [x, y] = point.map(|at| Rounded((at * SVG_UNITS * 10.0).round() / 10.0));
                        write!(svg, "{}{x},{y}", if index == 0 { "" } else { " " })?;
                    }
                    svg.push('"');
                    paint_svg(svg, fill.as_ref(), pen.as_ref())?;
                    svg.push_str("/>\n");
                }
                Mark::Circle { center, radius, fill, pen } => {
                    let [x, y, radius] = [center[0], center[1], *radius].map(|at| Rounded(at * SVG_UNITS));
                    write!(svg, "<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"")?;
                    paint_svg(svg, fill.as_ref(), pen.as_ref())?;
                    svg.push_str("/>\n");
                }
                Mark::Text { place, text, size, anchor, color, upright, bold } => {
                    let (glyphs, length) = letters::set(text);
                    let [x, y] = place.map(|at| Rounded(at * SVG_UNITS));
                    let start = match anchor {
                        Anchor::Start => 0,
                        Anchor::Middle => -i64::from(length / 2),
                        Anchor::End => -i64::from(length),
                    };
                    write!(svg, "<g aria-label=\"{}\" fill=\"{}\"", Escaped(text), hex(*color))?;
                    if *bold {
                        // The font has one weight; an outline makes it the other.
                        let width = Rounded(letters::units_per_em() * BOLD);
                        write!(svg, " stroke=\"{}\" stroke-width=\"{width}\"", hex(*color))?;
                    }
                    let turn = if *upright { " rotate(-90)" } else { "" };
                    let scale = size * SVG_UNITS / letters::units_per_em();
                    write!(svg, " transform=\"translate({x} {y}){turn} scale({scale:.6})\">")?;
                    for (glyph, place, _) in glyphs.into_iter().filter(|(_, _, c)| *c != ' ') {
                        write!(svg, "<use xlink:href=\"#g{}\" x=\"{}\"/>", glyph.0, start + i64::from(place))?;
                    }
                    svg.push_str("</g>\n");
                }
                Mark::Clip(area) => {
                    if std::mem::replace(&mut clipped, area.is_some()) {
                        svg.push_str("</g>\n");
                    }
                    if let Some([x, y, width, height]) = area.map(|area| area.map(|at| Rounded(at * SVG_UNITS))) {
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
                    let pen = bold.then(|| Pen::new(*color, size * BOLD));
                    let pens = (Some(&Fill::from(*color)), pen.as_ref());
                    let path = letters::letters(text, *size, start);
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

    /// The picture as a PNG file, so many pixels a millimetre, which the file says, too: it prints at the scene's size.
    ///
    /// # Errors
    /// The encoder refused, which it does for want of memory alone.
    pub fn png(&self, per_mm: f64) -> std::io::Result<Vec<u8>> {
        let pixmap = self.pixels(per_mm);
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, pixmap.width(), pixmap.height());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let per_meter = (f64::from(pixmap.width()) / self.width * 1000.0).round() as u32;
        let unit = png::Unit::Meter;
        encoder.set_pixel_dims(Some(png::PixelDimensions { xppu: per_meter, yppu: per_meter, unit }));
        encoder.add_text_chunk("Software".into(), "flotilla".into()).map_err(std::io::Error::other)?;
        for (key, text) in [("Title", &self.title), ("Description", &self.description)] {
            encoder.add_itxt_chunk(key.into(), text.clone()).map_err(std::io::Error::other)?;
        }
        // Nothing shows through a picture's white ground.
        let rgb: Vec<u8> = pixmap.data().chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
        let mut writer = encoder.write_header().map_err(std::io::Error::other)?;
        writer.write_image_data(&rgb).map_err(std::io::Error::other)?;
        writer.finish().map_err(std::io::Error::other)?;
        Ok(file)
    }

    /// The picture as a file; a PNG of so many pixels a millimetre.
    ///
    /// # Errors
    /// An encoder refused, which it does for want of memory alone.
    pub fn file(&self, kind: Format, per_mm: f64) -> std::io::Result<Vec<u8>> {
        match kind {
            Format::Svg => Ok(self.svg().into_bytes()),
            Format::Png => self.png(per_mm),
            Format::Pdf => Ok(self.pdf()),
        }
    }
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
                write!(svg, " fill-opacity=\"{}\"", Rounded(*opacity))?;
            }
        }
    }
    if let Some(Pen { color, width, dash, opacity }) = pen {
        write!(svg, " stroke=\"{}\" stroke-width=\"{}\"", hex(*color), Rounded(width * SVG_UNITS))?;
        if !dash.is_empty() {
            let dashes: Vec<_> = dash.iter().map(|length| Rounded(length * SVG_UNITS).to_string()).collect();
            write!(svg, " stroke-dasharray=\"{}\"", dashes.join(" "))?;
        }
        if *opacity < 1.0 {
            write!(svg, " stroke-opacity=\"{}\"", Rounded(*opacity))?;
        }
    }
    Ok(())
}

fn hex([r, g, b]: Color) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Printed with two digits after the point at most, and none that say nothing. (A tenth of a unit is 0.01 mm.)
struct Rounded(f64);

impl std::fmt::Display for Rounded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let text = format!("{:.2}", self.0);
        f.write_str(text.trim_end_matches('0').trim_end_matches('.'))
    }
}

/// As text or an attribute of XML.
struct Escaped<'a>(&'a str);

impl std::fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.chars().try_for_each(|c| match c {
            '<' => f.write_str("&lt;"),
            '>' => f.write_str("&gt;"),
            '&' => f.write_str("&amp;"),
            '"' => f.write_str("&quot;"),
            // XML cannot hold most of these, and a picture has no use for any.
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => f.write_char(' '),
            c => f.write_char(c),
        })
    }
}
