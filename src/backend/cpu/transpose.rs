//! Transposes between rows per team and columns of lanes.

use fearless_simd::{Simd, f32x4, prelude::*};

/// Transposes four rows of equal length: calls `put` with the index and the four numbers of each column.
#[inline(always)]
pub(crate) fn transpose_rows<S: Simd>(simd: S, rows: [&[f32]; 4], mut put: impl FnMut(usize, &[f32])) {
    let [a, b, c, d] = rows;
    let columns = a.len();
    let whole = columns / 4 * 4;
    for at in (0..whole).step_by(4) {
        // Written out, because a closure that is not inlined would be compiled without wide instructions.
        let fours = [
            f32x4::from_slice(simd, &a[at..at + 4]),
            f32x4::from_slice(simd, &b[at..at + 4]),
            f32x4::from_slice(simd, &c[at..at + 4]),
            f32x4::from_slice(simd, &d[at..at + 4]),
        ];
        for (column, four) in (at..).zip(&transpose4(fours)) {
            put(column, four.as_slice());
        }
    }
    for column in whole..columns {
        put(column, &[a[column], b[column], c[column], d[column]]);
    }
}

/// Transposes `count` columns, one team per lane, into row `row` of each team's `rows` rows, `[teams][rows][count]`.
/// Unused lanes have no rows. Does nothing without an array.
#[inline(always)]
pub(crate) fn to_rows<'a, S: Simd>(
    simd: S,
    count: usize,
    (row, rows): (usize, usize),
    array: &mut [f32],
    column: impl Fn(usize) -> &'a [f32],
) {
    if array.is_empty() {
        return;
    }
    let size = count * rows;
    let whole = count / 4 * 4;
    for (first, teams) in (0..).step_by(4).zip(array.chunks_mut(size * 4)) {
        let mut start = 0;
        if teams.len() == size * 4 {
            let (ab, cd) = teams.split_at_mut(size * 2);
            let ((a, b), (c, d)) = (ab.split_at_mut(size), cd.split_at_mut(size));
            let [a, b, c, d] = [a, b, c, d].map(|team| &mut team[row * count..(row + 1) * count]);
            for at in (0..whole).step_by(4) {
                let fours = [
                    f32x4::from_slice(simd, &column(at)[first..first + 4]),
                    f32x4::from_slice(simd, &column(at + 1)[first..first + 4]),
                    f32x4::from_slice(simd, &column(at + 2)[first..first + 4]),
                    f32x4::from_slice(simd, &column(at + 3)[first..first + 4]),
                ];
                let turned = transpose4(fours);
                turned[0].store_slice(&mut a[at..at + 4]);
                turned[1].store_slice(&mut b[at..at + 4]);
                turned[2].store_slice(&mut c[at..at + 4]);
                turned[3].store_slice(&mut d[at..at + 4]);
            }
            start = whole;
        }
        for at in start..count {
            let lanes = &column(at)[first..];
            teams.chunks_exact_mut(size).zip(lanes).for_each(|(team, &number)| team[row * count + at] = number);
        }
    }
}

/// Transposes a 4 x 4 matrix.
#[inline(always)]
pub(super) fn transpose4<S: Simd>([a, b, c, d]: [f32x4<S>; 4]) -> [f32x4<S>; 4] {
    let (low, high) = (a.zip_low(c), a.zip_high(c));
    let (other_low, other_high) = (b.zip_low(d), b.zip_high(d));
    [low.zip_low(other_low), low.zip_high(other_low), high.zip_low(other_high), high.zip_high(other_high)]
}
