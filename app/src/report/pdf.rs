//! Writes a picture as a PDF document of one page. It embeds the font, so that text can be searched and copied.

use std::collections::{BTreeMap, BTreeSet};

use pdf_writer::types::{CidFontType, FontFlags, LineJoinStyle, SystemInfo, TextRenderingMode, UnicodeCmap};
use pdf_writer::{Content, Filter, Finish, Name, Pdf, Rect, Ref, Str, TextStr};

use super::letters;
use super::scene::{BOLD, Color, Fill, Mark, Pen, Scene};

/// Points per millimetre.
const POINTS: f64 = 72.0 / 25.4;
const FONT: Name<'static> = Name(b"DejaVuSans");
const INFO: SystemInfo<'static> = SystemInfo { registry: Str(b"Adobe"), ordering: Str(b"Identity"), supplement: 0 };

impl Scene {
    /// Returns the picture as a PDF file.
    pub fn pdf(&self) -> Vec<u8> {
        let [catalog, pages, page, contents, font, cid, descriptor, file, unicode, info] =
            std::array::from_fn(|index| Ref::new(index as i32 + 1));
        let mut page_of = Page::default();
        let content = page_of.content(self);

        let mut pdf = Pdf::new();
        pdf.document_info(info)
            .title(TextStr(&self.title))
            .subject(TextStr(&self.description))
            .creator(TextStr(concat!("flotilla ", env!("CARGO_PKG_VERSION"))));
        let mut root = pdf.catalog(catalog);
        root.pages(pages).lang(TextStr("en"));
        root.viewer_preferences().display_doc_title(true);
        root.finish();
        pdf.pages(pages).kids([page]).count(1);
        let mut sheet = pdf.page(page);
        let [width, height] = [self.width, self.height].map(|side| (side * POINTS) as f32);
        sheet.parent(pages).media_box(Rect::new(0.0, 0.0, width, height)).contents(contents);
        let mut resources = sheet.resources();
        resources.fonts().pair(FONT, font);
        let mut states = resources.ext_g_states();
        for &percent in &page_of.opacities {
            let mut state =
                states.insert(Name(state(percent).as_bytes())).start::<pdf_writer::writers::ExtGraphicsState>();
            state.non_stroking_alpha(f32::from(percent) / 100.0).stroking_alpha(f32::from(percent) / 100.0);
        }
        states.finish();
        resources.finish();
        sheet.finish();
        pdf.stream(contents, &packed(&content)).filter(Filter::FlateDecode);

        let face = &letters::FONT;
        let per_mille = |units: f64| (units * 1000.0 / letters::units_per_em()) as f32;
        pdf.type0_font(font)
            .base_font(FONT)
            .encoding_predefined(Name(b"Identity-H"))
            .descendant_font(cid)
            .to_unicode(unicode);
        let mut cid_font = pdf.cid_font(cid);
        cid_font.subtype(CidFontType::Type2).base_font(FONT).system_info(INFO).font_descriptor(descriptor);
        cid_font.cid_to_gid_map_predefined(Name(b"Identity")).default_width(0.0);
        let mut widths = cid_font.widths();
        for &glyph in page_of.glyphs.keys() {
            let advance = face.glyph_hor_advance(ttf_parser::GlyphId(glyph)).unwrap_or(0);
            widths.consecutive(glyph, [per_mille(f64::from(advance))]);
        }
        widths.finish();
        cid_font.finish();
        let bounds = face.global_bounding_box();
        let [x0, y0, x1, y1] =
            [bounds.x_min, bounds.y_min, bounds.x_max, bounds.y_max].map(|at| per_mille(f64::from(at)));
        pdf.font_descriptor(descriptor)
            .name(FONT)
            .flags(FontFlags::SYMBOLIC)
            .bbox(Rect::new(x0, y0, x1, y1))
            .italic_angle(0.0)
            .ascent(per_mille(f64::from(face.ascender())))
            .descent(per_mille(f64::from(face.descender())))
            .cap_height(729.0)
            .stem_v(90.0)
            .font_file2(file);
        let packed_font = packed(letters::FILE);
        let mut stream = pdf.stream(file, &packed_font);
        stream.filter(Filter::FlateDecode).pair(Name(b"Length1"), letters::FILE.len() as i32);
        stream.finish();
        let mut map = UnicodeCmap::new(Name(b"Custom"), INFO);
        page_of.glyphs.iter().for_each(|(&glyph, &c)| map.pair(glyph, c));
        pdf.cmap(unicode, &map.finish());
        pdf.finish()
    }
}

fn packed(bytes: &[u8]) -> Vec<u8> {
    miniz_oxide::deflate::compress_to_vec_zlib(bytes, 9)
}

/// Returns the name of the graphics state with an opacity in percent.
fn state(percent: u8) -> String {
    format!("O{percent}")
}

/// Resources that the page's content uses.
#[derive(Default)]
struct Page {
    /// Opacities in percent.
    opacities: BTreeSet<u8>,
    /// The character of each glyph.
    glyphs: BTreeMap<u16, char>,
}

impl Page {
    fn content(&mut self, scene: &Scene) -> Vec<u8> {
        let mut content = Content::new();
        // The scene measures millimetres from the upper edge. PDF measures points from the lower edge.
        let scale = POINTS as f32;
        content.transform([scale, 0.0, 0.0, -scale, 0.0, (scene.height * POINTS) as f32]);
        content.set_line_join(LineJoinStyle::RoundJoin);
        let mut clipped = false;
        for mark in &scene.marks {
            match mark {
                Mark::Shape { points, closed, fill, pen } => {
                    let path = |content: &mut Content| {
                        for (index, [x, y]) in points.iter().enumerate() {
                            match index {
                                0 => content.move_to(round(*x), round(*y)),
                                _ => content.line_to(round(*x), round(*y)),
                            };
                        }
                        if *closed {
                            content.close_path();
                        }
                    };
                    self.paint(&mut content, path, fill.as_ref(), pen.as_ref());
                }
                Mark::Circle { center: [x, y], radius, fill, pen } => {
                    // Four cubic curves approximate the circle to within a thousandth of its radius.
                    const REACH: f64 = 0.552_284_75;
                    let path = |content: &mut Content| {
                        let at = |dx: f64, dy: f64| (round(x + radius * dx), round(y + radius * dy));
                        let (start_x, start_y) = at(1.0, 0.0);
                        content.move_to(start_x, start_y);
                        let quarters = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 0.0)];
                        for pair in quarters.windows(2) {
                            let ((ax, ay), (bx, by)) = (pair[0], pair[1]);
                            let (x1, y1) = at(ax + REACH * bx, ay + REACH * by);
                            let (x2, y2) = at(bx + REACH * ax, by + REACH * ay);
                            let (x3, y3) = at(bx, by);
                            content.cubic_to(x1, y1, x2, y2, x3, y3);
                        }
                        content.close_path();
                    };
                    self.paint(&mut content, path, fill.as_ref(), pen.as_ref());
                }
                Mark::Text { place: [x, y], text, size, anchor, color, upright, bold } => {
                    let (glyphs, length) = letters::set(text);
                    let start = f64::from(length) * size / letters::units_per_em() * anchor.share();
                    self.opacity(&mut content, 1.0);
                    let [r, g, b] = rgb(*color);
                    content.set_fill_rgb(r, g, b);
                    if *bold {
                        content.set_stroke_rgb(r, g, b).set_line_width((size * BOLD) as f32);
                        content.set_dash_pattern([], 0.0);
                    }
                    content.begin_text().set_font(FONT, *size as f32);
                    let mode = if *bold { TextRenderingMode::FillStroke } else { TextRenderingMode::Fill };
                    content.set_text_rendering_mode(mode);
                    content.set_text_matrix(match upright {
                        false => [1.0, 0.0, 0.0, -1.0, round(x - start), round(*y)],
                        true => [0.0, -1.0, -1.0, 0.0, round(*x), round(y + start)],
                    });
                    let bytes: Vec<u8> = glyphs.iter().flat_map(|(glyph, _, _)| glyph.0.to_be_bytes()).collect();
                    content.show(Str(&bytes)).end_text();
                    self.glyphs.extend(glyphs.into_iter().map(|(glyph, _, c)| (glyph.0, c)));
                }
                Mark::Clip(area) => {
                    if std::mem::replace(&mut clipped, area.is_some()) {
                        content.restore_state();
                    }
                    if let Some([x, y, width, height]) = area.map(|area| area.map(|at| at as f32)) {
                        content.save_state().rect(x, y, width, height).clip_nonzero().end_path();
                    }
                }
            }
        }
        content.finish().into_vec()
    }

    fn paint(&mut self, content: &mut Content, path: impl Fn(&mut Content), fill: Option<&Fill>, pen: Option<&Pen>) {
        if let Some(Fill { color, opacity }) = fill {
            self.opacity(content, *opacity);
            let [r, g, b] = rgb(*color);
            content.set_fill_rgb(r, g, b);
            path(content);
            content.fill_nonzero();
        }
        if let Some(Pen { color, width, dash, opacity }) = pen {
            self.opacity(content, *opacity);
            let [r, g, b] = rgb(*color);
            content.set_stroke_rgb(r, g, b).set_line_width(*width as f32);
            content.set_dash_pattern(dash.iter().map(|&length| length as f32), 0.0);
            path(content);
            content.stroke();
        }
    }

    /// Sets the opacity of the following marks.
    fn opacity(&mut self, content: &mut Content, opacity: f64) {
        let percent = (opacity * 100.0).round() as u8;
        self.opacities.insert(percent);
        content.set_parameters(Name(state(percent).as_bytes()));
    }
}

fn rgb(color: Color) -> [f32; 3] {
    color.map(|channel| (f32::from(channel) / 255.0 * 1000.0).round() / 1000.0)
}

/// Rounds to a thousandth of a millimetre, which keeps the file small.
fn round(at: f64) -> f32 {
    ((at * 1000.0).round() / 1000.0) as f32
}
