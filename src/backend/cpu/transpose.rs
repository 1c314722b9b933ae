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

/// Transposes a 4 x 4 matrix.
#[inline(always)]
pub(crate) fn transpose4<S: Simd>([a, b, c, d]: [f32x4<S>; 4]) -> [f32x4<S>; 4] {
    let (low, high) = (a.zip_low(c), a.zip_high(c));
    let (other_low, other_high) = (b.zip_low(d), b.zip_high(d));
    [low.zip_low(other_low), low.zip_high(other_low), high.zip_low(other_high), high.zip_high(other_high)]
}
