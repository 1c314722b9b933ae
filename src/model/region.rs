//! Regions of the map from which places are drawn, the key `in` of `[[agents]]` and `[[pois]]`.

use std::f64::consts::TAU;

use serde::Serialize;

use super::LEAST;
use crate::kernels::math;
use crate::reader::{Allowed, Reader, between};

/// A region of the map. Lengths are in units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Region {
    /// A rectangle: the corner with the smaller coordinates, then the other, `[x0, y0, x1, y1]`.
    Box([f64; 4]),
    /// The area of a circle: its centre and its radius, `[x, y, r]`.
    Disc([f64; 3]),
    /// The line of a circle, `[x, y, r]`.
    Circle([f64; 3]),
}

impl Region {
    /// Reads the table on a map with these sides. Returns `None` if it is wrong.
    pub(crate) fn read(r: &mut Reader<'_>, sides: [Allowed<f64>; 2]) -> Option<Region> {
        let errors = r.error_count();
        let [width, height] = sides;
        let corners = r.key("in.box", "units", "rectangle with the corners (x0, y0) and (x1, y1)", "");
        let corners = corners.optional_tuple("x0, y0, x1, y1", [width, height, width, height]);
        let round = [width, height, between(LEAST, width.high.max(height.high)).because("the map")];
        let disc = r.key("in.disc", "units", "area of the circle around (x, y) with radius r, within the map", "");
        let disc = disc.optional_tuple("x, y, r", round);
        let circle = r.key("in.circle", "units", "line of that circle", "").optional_tuple("x, y, r", round);
        let found = [corners.map(Region::Box), disc.map(Region::Disc), circle.map(Region::Circle)];
        let found: Vec<Region> = found.into_iter().flatten().collect();
        if r.error_count() > errors {
            return None;
        }
        let &[region] = &found[..] else {
            let found = if found.is_empty() { "found none of its keys" } else { "found several of its keys" };
            r.report_table(format!("{found}, allowed one of box, disc and circle"));
            return None;
        };
        let [[x0, y0], [x1, y1]] = region.corners();
        if let Region::Box(_) = region
            && (x0 > x1 || y0 > y1)
        {
            r.report_key("in.box", format!("found [{x0}, {y0}, {x1}, {y1}], allowed x0 <= x1 and y0 <= y1"));
        } else if x0 < 0.0 || y0 < 0.0 || x1 > width.high || y1 > height.high {
            let key = if let Region::Disc(_) = region { "in.disc" } else { "in.circle" };
            let (width, height) = (width.high, height.high);
            r.report_key(
                key,
                format!("found a circle from ({x0}, {y0}) to ({x1}, {y1}), allowed within the map, (0, 0) to ({width}, {height})"),
            );
        }
        (r.error_count() == errors).then_some(region)
    }

    /// Returns the place that two uniform random words select: uniform in an area, or on a line.
    ///
    /// Functions beyond the basic operations are from [`libm`], because the platform's may differ in the last bit.
    pub fn place(self, words: [u32; 2]) -> [f64; 2] {
        let [u, v] = words.map(|word| f64::from(word) / (1u64 << 32) as f64);
        let around = |x: f64, y: f64, radius: f64| {
            let (sin, cos) = (libm::sin(TAU * v), libm::cos(TAU * v));
            [x + radius * cos, y + radius * sin]
        };
        match self {
            Region::Box([x0, y0, x1, y1]) => [x0 + u * (x1 - x0), y0 + v * (y1 - y0)],
            Region::Disc([x, y, radius]) => around(x, y, radius * libm::sqrt(u)),
            Region::Circle([x, y, radius]) => around(x, y, radius),
        }
    }

    /// Returns the example that stands for a place of an agent or POI where there is no episode.
    pub fn example(self, index: usize) -> [f64; 2] {
        let [x, y, ..] = math::pcg4d_scalar([index as u32, 0, 0, 0]);
        self.place([x, y])
    }

    /// Returns the corners of the smallest rectangle around it, the one with the smaller coordinates first.
    pub fn corners(self) -> [[f64; 2]; 2] {
        match self {
            Region::Box([x0, y0, x1, y1]) => [[x0, y0], [x1, y1]],
            Region::Disc([x, y, radius]) | Region::Circle([x, y, radius]) => {
                [[x - radius, y - radius], [x + radius, y + radius]]
            }
        }
    }

    /// Returns the middle, and the largest distance of a place from it.
    pub fn extent(self) -> ([f64; 2], f64) {
        match self {
            Region::Box([x0, y0, x1, y1]) => {
                ([(x0 + x1) / 2.0, (y0 + y1) / 2.0], ((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0)).sqrt() / 2.0)
            }
            Region::Disc([x, y, radius]) | Region::Circle([x, y, radius]) => ([x, y], radius),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_uniform_in_areas_and_on_lines() {
        let words = |index: u32| {
            let [x, y, ..] = math::pcg4d_scalar([index, 1, 2, 3]);
            [x, y]
        };
        let regions =
            [Region::Box([1.0, 2.0, 4.0, 3.0]), Region::Disc([5.0, 6.0, 2.0]), Region::Circle([5.0, 6.0, 2.0])];
        for region in regions {
            let ([x, y], most) = region.extent();
            let [[x0, y0], [x1, y1]] = region.corners();
            let (mut counts, mut inner) = ([0; 4], 0);
            for index in 0..20_000 {
                let [px, py] = region.place(words(index));
                let far = ((px - x) * (px - x) + (py - y) * (py - y)).sqrt();
                assert!(far <= most + 1e-9 && (x0..=x1).contains(&px) && (y0..=y1).contains(&py), "{px} {py}");
                counts[usize::from(px > x) + 2 * usize::from(py > y)] += 1;
                // Half of a disc's area, a quarter of a box's.
                inner += usize::from(match region {
                    Region::Box(_) => (px - x).abs() < 0.75 && (py - y).abs() < 0.25,
                    _ => far < most / 2f64.sqrt(),
                });
            }
            assert!(counts.iter().all(|count| (4_700..5_300).contains(count)), "{region:?}: {counts:?}");
            let expected = [5_000, 10_000, 0][regions.iter().position(|other| *other == region).unwrap()];
            assert!((inner as i64 - expected).abs() < 300, "{region:?}: {inner}");
        }
    }
}
