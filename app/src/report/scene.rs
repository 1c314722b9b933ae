//! Pictures described once, in millimetres, and written as SVG, PDF, PNG or pixels.
//!
//! All formats draw text with the outlines of one embedded font, so its width does not depend on the viewer. Files also
//! contain a title and a description for readers who cannot see the picture. A PDF also contains the text itself.

use std::collections::BTreeSet;
use std::fmt::Write;

use tiny_skia::{
    FillRule, LineCap, LineJoin, Mask, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, StrokeDash, Transform,
};

use super::letters;
pub use super::letters::text_width;
use crate::record::disk::Disk;
use crate::record::{RecordError, ownership};

/// Pixels per millimetre of a PNG: 300 pixels per inch.
pub const PRINT: f64 = 300.0 / 25.4;

/// SVG units per millimetre. At 1 unit per millimetre, letters would be too small for browsers to draw.
const SVG_UNITS: f64 = 10.0;
/// Width of the outline that makes letters bold, in ems.
pub(super) const BOLD: f64 = 0.04;
/// Maximum number of pixels of a picture's longer side.
const MAX_PIXELS: f64 = 8192.0;

/// Red, green and blue.
pub type Color = [u8; 3];

/// Returns colours from their codes, such as 0xff8800.
pub(crate) const fn colors<const N: usize>(codes: [u32; N]) -> [Color; N] {
    let (mut colors, mut at) = ([[0; 3]; N], 0);
    while at < N {
        let [_, red, green, blue] = codes[at].to_be_bytes();
        colors[at] = [red, green, blue];
        at += 1;
    }
    colors
}

/// Text.
pub(crate) const BLACK: Color = [0, 0, 0];
/// Background.
pub(crate) const WHITE: Color = [255, 255, 255];
/// Secondary elements.
pub(crate) const GREY: Color = [120, 120, 120];
/// Grid lines.
pub(crate) const LIGHT: Color = [222, 222, 222];

/// Colours that colour-blind readers can distinguish, after Okabe and Ito. The first ones are also distinct in
/// greyscale.
pub(crate) const COLORS: [Color; 7] = colors([0x0072b2, 0xd55e00, 0x009e73, 0xcc79a7, 0x56b4e9, 0x8c6d00, 0x000000]);

/// The style of a line.
#[derive(Clone, Debug, PartialEq)]
pub struct Pen {
    pub color: Color,
    /// Width in millimetres.
    pub width: f64,
    /// Alternating lengths of dashes and gaps, in millimetres. Empty for a solid line.
    pub dash: &'static [f64],
    /// Opacity from 0 (invisible) to 1.
    pub opacity: f64,
}

impl Pen {
    /// Returns a solid, opaque pen.
    pub fn new(color: Color, width: f64) -> Pen {
        Pen { color, width, dash: &[], opacity: 1.0 }
    }
}

/// The fill of an area.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fill {
    pub color: Color,
    /// Opacity from 0 (invisible) to 1.
    pub opacity: f64,
}

impl From<Color> for Fill {
    fn from(color: Color) -> Fill {
        Fill { color, opacity: 1.0 }
    }
}

/// The part of a text that is placed at the given position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// The left end.
    Start,
    /// The middle of the text's width.
    Middle,
    /// The right end.
    End,
}

impl Anchor {
    /// Returns the share of the text's width that is left of the given position.
    pub(super) fn share(self) -> f64 {
        match self {
            Anchor::Start => 0.0,
            Anchor::Middle => 0.5,
            Anchor::End => 1.0,
        }
    }
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
    /// Text; `place` is on the baseline.
    Text {
        place: [f64; 2],
        text: String,
        size: f64,
        anchor: Anchor,
        color: Color,
        upright: bool,
        bold: bool,
    },
    /// Clips the following marks to `[x, y, width, height]`. None ends clipping.
    Clip(Option<[f64; 4]>),
}

/// A picture. Positions are in millimetres from its left and upper edges.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Width in millimetres.
    pub width: f64,
    /// Height in millimetres.
    pub height: f64,
    pub title: String,
    /// A description in sentences, with numbers, for readers who cannot see the picture.
    pub description: String,
    /// The digest of the run that the picture shows. SVG files contain it.
    pub source: Option<String>,
    pub(super) marks: Vec<Mark>,
}

/// A file format of pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Vector graphics for the web.
    Svg,
    /// A pixel image.
    Png,
    /// Vector graphics for print.
    Pdf,
}

impl Format {
    pub const ALL: [Format; 3] = [Format::Svg, Format::Png, Format::Pdf];

    /// Returns the names of a picture's files, one per format.
    pub fn names(name: &str) -> [String; Format::ALL.len()] {
        Format::ALL.map(|kind| format!("{name}.{}", kind.extension()))
    }

    /// Returns the format that a file name's extension selects.
    pub fn of(path: &std::path::Path) -> Option<Format> {
        let extension = path.extension()?.to_ascii_lowercase();
        Format::ALL.into_iter().find(|kind| extension == kind.extension())
    }

    /// Returns the file name extension, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Format::Svg => "svg",
            Format::Png => "png",
            Format::Pdf => "pdf",
        }
    }
}

impl Scene {
    /// Returns an empty picture of this size, in millimetres.
    pub fn new(width: f64, height: f64) -> Scene {
        let (title, description, marks) = (String::new(), String::new(), Vec::new());
        Scene { width, height, title, description, source: None, marks }
    }

    /// Adds a line of text below the picture and extends its description by it.
    pub fn warn(&mut self, text: &str) {
        const SIZE: f64 = 2.47;
        self.height += 4.0;
        self.text([1.0, self.height - 1.4], text, SIZE, Anchor::Start, BLACK);
        self.description += &format!(" {text}.");
    }

    /// Returns the SVG element that names the run.
    fn metadata(source: &str) -> String {
        format!("<metadata>run {source}</metadata>\n")
    }

    /// Reports whether an SVG names the run with this digest.
    pub fn shows(svg: &str, source: &str) -> bool {
        svg.contains(&Scene::metadata(source))
    }

    pub fn line(&mut self, points: Vec<[f64; 2]>, pen: Pen) {
        self.marks.push(Mark::Shape { points, closed: false, fill: None, pen: Some(pen) });
    }

    /// Draws a polygon that is filled, outlined or both.
    pub(crate) fn polygon(&mut self, points: Vec<[f64; 2]>, fill: Option<Fill>, pen: Option<Pen>) {
        self.marks.push(Mark::Shape { points, closed: true, fill, pen });
    }

    /// Draws an upright rectangle, given by its corner and sides.
    pub(crate) fn rectangle(&mut self, [x, y, width, height]: [f64; 4], fill: Option<Fill>, pen: Option<Pen>) {
        self.polygon(vec![[x, y], [x + width, y], [x + width, y + height], [x, y + height]], fill, pen);
    }

    pub fn circle(&mut self, center: [f64; 2], radius: f64, fill: Option<Fill>, pen: Option<Pen>) {
        self.marks.push(Mark::Circle { center, radius, fill, pen });
    }

    /// Writes text of a size in millimetres per em. `place` is on its baseline.
    pub fn text(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, anchor: Anchor, color: Color) {
        self.write(Mark::Text { place, text: text.into(), size, anchor, color, upright: false, bold: false });
    }

    /// Writes bold text. `place` is on its baseline.
    pub(crate) fn bold(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, anchor: Anchor, color: Color) {
        self.write(Mark::Text { place, text: text.into(), size, anchor, color, upright: false, bold: true });
    }

    /// Writes text that reads upwards, centred on `place`.
    pub(crate) fn upright(&mut self, place: [f64; 2], text: impl Into<String>, size: f64, color: Color) {
        let text = text.into();
        self.write(Mark::Text { place, text, size, anchor: Anchor::Middle, color, upright: true, bold: false });
    }

    fn write(&mut self, mark: Mark) {
        if !matches!(&mark, Mark::Text { text, .. } if text.is_empty()) {
            self.marks.push(mark);
        }
    }

    /// Clips everything that `draw` draws to `[x, y, width, height]`.
    pub(crate) fn clipped(&mut self, area: [f64; 4], draw: impl FnOnce(&mut Scene)) {
        self.marks.push(Mark::Clip(Some(area)));
        draw(self);
        self.marks.push(Mark::Clip(None));
    }

    /// Returns the picture as an SVG document.
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
        // Each glyph that occurs is defined once and then referenced.
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
                    let start = -((f64::from(length) * anchor.share()) as i64);
                    write!(svg, "<g aria-label=\"{}\" fill=\"{}\"", Escaped(text), hex(*color))?;
                    if *bold {
                        // The font has a single weight, so an outline makes letters bold.
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

    /// Renders the picture with the given number of pixels per millimetre, or fewer if a side would exceed 8192 pixels.
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
                    let start = -text_width(text, *size) * anchor.share();
                    let turn = if *upright { -90.0 } else { 0.0 };
                    let place = transform.pre_translate(*x as f32, *y as f32).pre_concat(Transform::from_rotate(turn));
                    // The font has a single weight, so an outline makes letters bold.
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

    /// Returns the picture as a PNG file with the given number of pixels per millimetre. The file states its
    /// resolution, so that it prints at the scene's size.
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
        // The background is opaque, so no alpha channel is needed.
        let rgb: Vec<u8> = pixmap.data().chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
        let mut writer = encoder.write_header().map_err(std::io::Error::other)?;
        writer.write_image_data(&rgb).map_err(std::io::Error::other)?;
        writer.finish().map_err(std::io::Error::other)?;
        Ok(file)
    }

    /// Returns the picture as a file. `per_mm` is the number of pixels per millimetre of a PNG.
    pub fn file(&self, kind: Format, per_mm: f64) -> std::io::Result<Vec<u8>> {
        match kind {
            Format::Svg => Ok(self.svg().into_bytes()),
            Format::Png => self.png(per_mm),
            Format::Pdf => Ok(self.pdf()),
        }
    }

    /// Writes the picture to a folder in every format, as files made from runs.
    pub fn publish(&self, disk: &Disk, folder: &std::path::Path, name: &str) -> Result<(), RecordError> {
        for (kind, name) in Format::ALL.into_iter().zip(Format::names(name)) {
            let path = folder.join(name);
            let content = self.file(kind, PRINT).map_err(RecordError::write(&path))?;
            ownership::publish_bytes(disk, &path, &content)?;
        }
        Ok(())
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

/// Returns a colour as "#rrggbb".
pub(super) fn hex([r, g, b]: Color) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Returns a number with at most this many decimals, and without trailing zeros.
pub(super) fn rounded(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}

/// A number printed with at most two decimals.
struct Rounded(f64);

impl std::fmt::Display for Rounded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&rounded(self.0, 2))
    }
}

/// Text escaped for XML content and attributes.
struct Escaped<'a>(&'a str);

impl std::fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.chars().try_for_each(|c| match c {
            '<' => f.write_str("&lt;"),
            '>' => f.write_str("&gt;"),
            '&' => f.write_str("&amp;"),
            '"' => f.write_str("&quot;"),
            // XML forbids most of these characters, and pictures need none of them.
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => f.write_char(' '),
            c => f.write_char(c),
        })
    }
}
