//! Text as outlines of an embedded font, a subset of DejaVu Sans. Every machine and viewer therefore shows the same
//! letters at the same widths.

use std::sync::LazyLock;

use tiny_skia::PathBuilder;
use ttf_parser::{Face, OutlineBuilder};

/// The font file.
pub(crate) const FILE: &[u8] = include_bytes!("font/dejavu-sans.ttf");

static FONT: LazyLock<Face<'static>> = LazyLock::new(|| Face::parse(FILE, 0).expect("the embedded font is whole"));

/// Returns the parsed font.
pub(crate) fn font() -> &'static Face<'static> {
    &FONT
}

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

/// Returns a glyph's outline as SVG path data in font units, with y downwards. A space has none.
pub fn outline(glyph: ttf_parser::GlyphId) -> Option<String> {
    /// Writes each point relative to the previous one, which takes fewer digits.
    struct Strokes {
        path: String,
        at: [i32; 2],
        start: [i32; 2],
    }
    impl Strokes {
        fn put(&mut self, command: char, points: &[[f32; 2]]) {
            self.path.push(command);
            let ends = points.iter().map(|&[x, y]| [x.round() as i32, -(y.round() as i32)]);
            let mut numbers = Vec::new();
            for end in ends {
                numbers.extend([end[0] - self.at[0], end[1] - self.at[1]]);
                if numbers.len() == 2 * points.len() {
                    self.at = end;
                }
            }
            for (index, number) in numbers.iter().enumerate() {
                // A minus sign separates numbers as well as a space does.
                if index > 0 && *number >= 0 {
                    self.path.push(' ');
                }
                self.path += &number.to_string();
            }
        }
    }
    impl OutlineBuilder for Strokes {
        fn move_to(&mut self, x: f32, y: f32) {
            self.put('m', &[[x, y]]);
            self.start = self.at;
        }
        fn line_to(&mut self, x: f32, y: f32) {
            self.put('l', &[[x, y]]);
        }
        fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
            self.put('q', &[[x1, y1], [x, y]]);
        }
        fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
            self.put('c', &[[x1, y1], [x2, y2], [x, y]]);
        }
        fn close(&mut self) {
            self.path.push('z');
            self.at = self.start;
        }
    }
    let mut outline = Strokes { path: String::new(), at: [0, 0], start: [0, 0] };
    FONT.outline_glyph(glyph, &mut outline)?;
    Some(outline.path)
}

/// Returns the outlines of a text whose baseline starts at `(start, 0)`, in millimetres. None if it has no visible
/// glyph.
pub fn letters(text: &str, size: f64, start: f64) -> Option<tiny_skia::Path> {
    struct Letters {
        builder: PathBuilder,
        scale: f32,
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
    let scale = size / units_per_em();
    let mut outline = Letters { builder: PathBuilder::new(), scale: scale as f32, x: 0.0 };
    for (glyph, place, _) in set(text).0 {
        outline.x = (start + f64::from(place) * scale) as f32;
        FONT.outline_glyph(glyph, &mut outline);
    }
    outline.builder.finish()
}
