//! Text as outlines of an embedded font, a subset of DejaVu Sans. Every machine and viewer therefore shows the same
//! letters at the same widths.

use std::sync::LazyLock;

use tiny_skia::{PathBuilder, PathSegment};
use ttf_parser::{Face, OutlineBuilder};

/// The font file.
pub(crate) const FILE: &[u8] = include_bytes!("font/dejavu-sans.ttf");

pub(crate) static FONT: LazyLock<Face<'static>> =
    LazyLock::new(|| Face::parse(FILE, 0).expect("the embedded font is whole"));

/// Returns the number of font units per em.
pub(crate) fn units_per_em() -> f64 {
    f64::from(FONT.units_per_em())
}

/// Returns a text's glyphs, each with its x offset and character, and the text's length. Lengths are in font units.
pub fn set(text: &str) -> (Vec<(ttf_parser::GlyphId, u32, char)>, u32) {
    let mut x = 0;
    let glyphs = text.chars().map(|c| {
        // Control characters become spaces. Characters that the font lacks become its empty box.
        let c = if c.is_control() { ' ' } else { c };
        let glyph = FONT.glyph_index(c).unwrap_or_default();
        let place = x;
        x += u32::from(FONT.glyph_hor_advance(glyph).unwrap_or(0));
        (glyph, place, c)
    });
    (glyphs.collect(), x)
}

/// Returns the width of a text in millimetres at a font size (millimetres per em).
pub fn text_width(text: &str, size: f64) -> f64 {
    f64::from(set(text).1) * size / units_per_em()
}

/// Collects the outlines of glyphs, with y downwards.
struct Letters {
    builder: PathBuilder,
    scale: f32,
    /// Where the next glyph starts.
    x: f32,
}

impl Letters {
    fn at(&self, x: f32, y: f32) -> (f32, f32) {
        (self.x + x * self.scale, -y * self.scale)
    }
}

impl OutlineBuilder for Letters {
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

/// Returns a glyph's outline as SVG path data in font units, with y downwards. A space has none.
pub fn outline(glyph: ttf_parser::GlyphId) -> Option<String> {
    let mut outline = Letters { builder: PathBuilder::new(), scale: 1.0, x: 0.0 };
    FONT.outline_glyph(glyph, &mut outline)?;
    let (mut text, mut at, mut start) = (String::new(), [0, 0], [0, 0]);
    for segment in outline.builder.finish()?.segments() {
        let (command, points) = match segment {
            PathSegment::MoveTo(end) => ('m', vec![end]),
            PathSegment::LineTo(end) => ('l', vec![end]),
            PathSegment::QuadTo(control, end) => ('q', vec![control, end]),
            PathSegment::CubicTo(first, second, end) => ('c', vec![first, second, end]),
            PathSegment::Close => {
                text.push('z');
                at = start;
                continue;
            }
        };
        text.push(command);
        // Each point is relative to the previous end, which takes fewer digits.
        let ends: Vec<[i32; 2]> = points.iter().map(|end| [end.x, end.y].map(|at| at.round() as i32)).collect();
        for (index, number) in ends.iter().flat_map(|end| [end[0] - at[0], end[1] - at[1]]).enumerate() {
            // A minus sign separates numbers as well as a space does.
            if index > 0 && number >= 0 {
                text.push(' ');
            }
            text += &number.to_string();
        }
        at = *ends.last()?;
        start = if command == 'm' { at } else { start };
    }
    Some(text)
}

/// Returns the outlines of a text whose baseline starts at `(start, 0)`, in millimetres. None if it has no visible
/// glyph.
pub fn letters(text: &str, size: f64, start: f64) -> Option<tiny_skia::Path> {
    let scale = size / units_per_em();
    let mut outline = Letters { builder: PathBuilder::new(), scale: scale as f32, x: 0.0 };
    for (glyph, place, _) in set(text).0 {
        outline.x = (start + f64::from(place) * scale) as f32;
        FONT.outline_glyph(glyph, &mut outline);
    }
    outline.builder.finish()
}
