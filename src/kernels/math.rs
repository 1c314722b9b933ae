//! The exact core: the functions beyond `+ - *` that an episode and a mutation need, built from operations that every
//! processor rounds alike.
//!
//! Twin of `shaders/lib/math.wgsl`: same names, same statements, same order. Only f32 `+ - *`, comparison, select, abs,
//! 32-bit integer operations, bit casts and conversions of integers occur. Integers above 2^24 become the nearest f32.
//! Within the stated ranges every intermediate value is 0 or of size 2^-120 to 2^120. So flushed denormals change
//! nothing, and no result depends on the sign of an intermediate zero.
//!
//! Stated errors are maxima over every float of the range (`tests/math.rs`). One ULP is the spacing of floats at the
//! exact value. `tests/fit.rs` fits the polynomials. Operations are lane operations, constants not counted.

#![allow(clippy::approx_constant, reason = "the twin has the same literals")]

use fearless_simd::prelude::*;

use super::{larger, smaller, zero_if};

/// 1/√x for x in 2^-80..2^48 within 2 ULP; some finite value for 0. 12 operations.
///
/// No force of a valid config has a larger square, see the test of [`follow`](crate::model::follow).
///
/// The seed, with its exponent halved and negated, approximates 2^(-1/3)/√x within 4 %. A quadratic in x·y² reduces the
/// error to 3e-5. A Newton step, whose factor of x·y² is 1 at this scale, reduces it to rounding.
#[inline(always)]
pub fn rsqrt<S: Simd>(x: S::f32s) -> S::f32s {
    let y = rough_rsqrt::<S>(x);
    y * (S::f32s::splat(x.token(), 1.8898816) - x * y * y)
}

/// √x for 0 and x in 2^-80..2^48 within 2.1 ULP. 12 operations: one fewer than `x * rsqrt(x)`.
#[inline(always)]
pub fn exact_sqrt<S: Simd>(x: S::f32s) -> S::f32s {
    let y = rough_rsqrt::<S>(x);
    let g = x * y;
    g * (S::f32s::splat(x.token(), 1.8898816) - g * y)
}

/// 2^(-1/3)/√x within 2e-4. 8 operations.
#[inline(always)]
fn rough_rsqrt<S: Simd>(x: S::f32s) -> S::f32s {
    let bits: S::u32s = x.bitcast();
    let y: S::f32s = (S::u32s::splat(x.token(), 0x5f096417) - (bits >> 1)).bitcast();
    let r = x * y * y;
    y * ((r - 2.0547535) * r + 1.8974205)
}

/// 1/x for x in 2^-40..2^40 within 2 ULP. 8 operations.
#[inline(always)]
pub fn recip<S: Simd>(x: S::f32s) -> S::f32s {
    let y = rough_twice_recip::<S>(x);
    y * (S::f32s::splat(x.token(), 1.0) - x * 0.25 * y)
}

/// 2/x within 2e-4. 4 operations.
///
/// A negated exponent approximates √2/x within 1.4 %, but 1/x only within 5 %. The Newton step that squares the error
/// turns √2/x into 2/x.
#[inline(always)]
fn rough_twice_recip<S: Simd>(x: S::f32s) -> S::f32s {
    let bits: S::u32s = x.bitcast();
    let y: S::f32s = (S::u32s::splat(x.token(), 0x7f32428e) - bits).bitcast();
    y * (S::f32s::splat(x.token(), 2.8286855) - x * y)
}

/// Clamps x to the range outside of which tanh is ±1 in f32. 2 operations.
#[inline(always)]
pub fn limit_tanh<S: Simd>(x: S::f32s) -> S::f32s {
    let limit = S::f32s::splat(x.token(), 7.5501223);
    // Equal to the shader's pair of selects for numbers, in half the operations.
    larger::<S>(smaller::<S>(x, limit), -limit)
}

/// n and d with tanh(x/2) = n/d, for x from [`limit_tanh`]. 9 operations. See [`whole_tanh`].
///
/// A rational approximation whose two parts are equal at the limits.
#[inline(always)]
pub fn half_tanh<S: Simd>(x: S::f32s) -> (S::f32s, S::f32s) {
    let z = x * x;
    let n = x * ((z * 0.02999907 + 14.7163315) * z + 544.93274);
    let d = (z + 120.25281) * z + 1089.8662;
    (n, d)
}

/// tanh x, from the [`half_tanh`] of its [`limit_tanh`], for 0 and any finite |x| from 2^-40. In [-1, 1], within 4.5e-7
/// and a relative error of 1.1e-6; odd. 13 operations.
///
/// tanh x = 2nd/(n² + d²), which cannot exceed 1.
#[inline(always)]
pub fn whole_tanh<S: Simd>((n, d): (S::f32s, S::f32s)) -> S::f32s {
    let s = n * n + d * d;
    let y = rough_twice_recip::<S>(s);
    n * d * (y * (S::f32s::splat(n.token(), 2.0) - s * 0.5 * y))
}

/// (sin x, cos x) for 0 and |x| from 2^-40 to π, within 1.9e-7; exact for 0. 26 operations.
///
/// Each is a polynomial in x², times the factor that has the function's zeros.
#[inline(always)]
pub fn sin_cos<S: Simd>(x: S::f32s) -> (S::f32s, S::f32s) {
    let simd = x.token();
    let z = x * x;
    let u = S::f32s::splat(simd, 9.869605) - z;
    let v = S::f32s::splat(simd, 2.467401) - z;
    let p = ((((z * -1.3433592e-10 + 2.3344368e-8) * z - 2.5224585e-6) * z + 1.7350527e-4) * z - 6.6208793e-3) * z
        + 0.101321176;
    let q = ((((v * 1.7268913e-9 + 2.452929e-7) * v + 2.1586762e-5) * v + 1.1602798e-3) * v + 3.2251544e-2) * v
        + 0.31830987;
    (x * u * p, v * q)
}

/// ln x for x in 2^-24..1 within a relative error of 3.2e-7; 0 for 1. 24 operations.
#[inline(always)]
pub fn ln<S: Simd>(x: S::f32s) -> S::f32s {
    let bits: S::u32s = x.bitcast();
    // x = 2^(k - 32) · m with m from √½ to √2.
    let i = bits - 0x2f3504f3;
    let k: S::f32s = (i >> 23).to_float();
    let m: S::f32s = ((i & 0x7fffff) + 0x3f3504f3).bitcast();
    let f = m - 1.0;
    let p = (((((f * -0.10347979 + 0.16278985) * f - 0.17201562) * f + 0.19893996) * f - 0.24973385) * f + 0.3333509)
        * f
        - 0.50000286;
    (k - 32.0) * 0.6931472 + f * (f * p + 1.0)
}

/// exp(-x) for x from 0 within a relative error of 2.6e-7; exp(-60) for x above 60. 25 operations.
///
/// x = k · ln 2 + r with |r| up to 0.35. A polynomial in r gives exp(-r), and its exponent is reduced by k. Adding 1.5 · 2^23
/// rounds to a whole number, whose bits then are consecutive.
#[inline(always)]
pub fn exp_negative<S: Simd>(x: S::f32s) -> S::f32s {
    let simd = x.token();
    let x = smaller::<S>(x, S::f32s::splat(simd, 60.0));
    let whole = S::f32s::splat(simd, 12582912.0);
    let raised = x * 1.442695 + whole;
    let k = raised - whole;
    let r = (x - k * 0.6933594) + k * 2.1219444e-4;
    let p = (((((r * 1.3888889e-3 - 8.333333e-3) * r + 4.1666668e-2) * r - 0.16666667) * r + 0.5) * r - 1.0) * r + 1.0;
    let (p, exponent): (S::i32s, S::i32s) = (p.bitcast(), less_base::<S>(raised, whole));
    (p - (exponent << 23)).bitcast()
}

/// A standard normal deviate from two uniform words (Box and Muller 1958), 0 or of size 2^-40 to 5.8.
/// 62 operations.
#[inline(always)]
pub fn normal<S: Simd>(a: S::u32s, b: S::u32s) -> S::f32s {
    normal_of::<S>(normal_radius::<S>(a), normal_cosine::<S>(b))
}

/// [`normal`], from its radius and cosine.
#[inline(always)]
pub(crate) fn normal_of<S: Simd>(radius: S::f32s, cosine: S::f32s) -> S::f32s {
    flush::<S>(radius * cosine, 9.094947e-13)
}

/// The radius of [`normal`]: the top 24 bits of `a` are a uniform number in (0, 1].
#[inline(always)]
pub(crate) fn normal_radius<S: Simd>(a: S::u32s) -> S::f32s {
    let u = ((a >> 8) + 1).to_float::<S::f32s>() * 5.9604645e-8;
    exact_sqrt::<S>(ln::<S>(u) * -2.0)
}

/// The cosine of [`normal`]: the top 24 bits of `b` are an angle in [-π, π).
#[inline(always)]
pub(crate) fn normal_cosine<S: Simd>(b: S::u32s) -> S::f32s {
    let (_, cosine) = sin_cos::<S>(normal_angle::<S>(b));
    cosine
}

/// Two independent standard normal deviates from two uniform words, the first as by [`normal`]. 65 operations.
#[inline(always)]
pub(crate) fn normal_pair<S: Simd>(a: S::u32s, b: S::u32s) -> [S::f32s; 2] {
    let radius = normal_radius::<S>(a);
    let (sine, cosine) = sin_cos::<S>(normal_angle::<S>(b));
    [normal_of::<S>(radius, cosine), normal_of::<S>(radius, sine)]
}

/// The angle of [`normal_cosine`].
#[inline(always)]
fn normal_angle<S: Simd>(b: S::u32s) -> S::f32s {
    ((b >> 8).to_float::<S::f32s>() - 8388608.0) * 3.7450704e-7
}

/// Whether the length of an offset is at most a radius, given squared. 4 operations.
#[inline(always)]
pub fn within<S: Simd>(dx: S::f32s, dy: S::f32s, radius2: S::f32s) -> S::mask32s {
    let d2 = dx * dx + dy * dy;
    // Equal to the shader's comparison of bits, because no number is negative.
    d2.simd_le(radius2)
}

/// A number as a whole multiple of a [`lattice`]'s distance, rounded to the nearest, ties to even. Sums of these do not
/// depend on the order. The number's size is at most a third of the base. 2 operations.
#[inline(always)]
pub(crate) fn on_lattice<S: Simd>(x: S::f32s, base: S::f32s) -> S::i32s {
    less_base::<S>(x + base, base)
}

/// [`on_lattice`] of a number that the base was added to.
#[inline(always)]
pub(crate) fn less_base<S: Simd>(raised: S::f32s, base: S::f32s) -> S::i32s {
    let (raised, base): (S::i32s, S::i32s) = (raised.bitcast(), base.bitcast());
    raised - base
}

/// The f32 nearest to an integer, ties to even. 1 operation.
#[inline(always)]
pub(crate) fn nearest_f32<S: Simd>(x: S::i32s) -> S::f32s {
    x.to_float()
}

/// The base of the finest lattice on which `count` numbers of at most `size` can be added as i32, and the distance of
/// its points, a power of two and at least `finest`.
///
/// Between `base - base/3` and `base + base/3`, neighbouring f32 are one such distance apart, and their bits are
/// consecutive integers. So adding the base rounds a number to the lattice, and the bits are the multiple.
pub(crate) fn lattice(count: usize, size: f64, finest: f64) -> [f32; 2] {
    let mut distance = finest;
    // The largest multiples of one number, and of a sum.
    let (of_number, of_sum) = (f64::from(1 << 22), f64::from(1 << 30));
    while size > of_number * distance || count as f64 * size > of_sum * distance {
        distance *= 2.0;
    }
    [3.0 * of_number * distance, distance].map(|number| number as f32)
}

/// +0 where |x| < `limit`, else x. 3 operations.
#[inline(always)]
pub fn flush<S: Simd>(x: S::f32s, limit: f32) -> S::f32s {
    zero_if::<S>(x, x.abs().simd_lt(limit))
}

/// Four random words for each counter (x, y, z, w): pcg4d (Jarzynski and Olano 2020) with one more round. 40
/// operations.
///
/// Without that round the low half of a word would not depend on the high bits of the counter.
#[inline(always)]
pub fn pcg4d<S: Simd>(x: S::u32s, y: S::u32s, z: S::u32s, w: S::u32s) -> [S::u32s; 4] {
    let (x, y, z, w) =
        (x * 1664525 + 1013904223, y * 1664525 + 1013904223, z * 1664525 + 1013904223, w * 1664525 + 1013904223);
    let [x, y, z, w] = pcg4d_round::<S>(x, y, z, w);
    pcg4d_round::<S>(x, y, z, w)
}

/// One round of [`pcg4d`].
#[inline(always)]
fn pcg4d_round<S: Simd>(x: S::u32s, y: S::u32s, z: S::u32s, w: S::u32s) -> [S::u32s; 4] {
    let x = x + y * w;
    let y = y + z * x;
    let z = z + x * y;
    let w = w + y * z;
    [x ^ (x >> 16), y ^ (y >> 16), z ^ (z >> 16), w ^ (w >> 16)]
}

/// One lane of [`pcg4d`].
pub fn pcg4d_scalar(counter: [u32; 4]) -> [u32; 4] {
    let [mut x, mut y, mut z, mut w] = counter.map(|word| word.wrapping_mul(1664525).wrapping_add(1013904223));
    for _ in 0..2 {
        x = x.wrapping_add(y.wrapping_mul(w));
        y = y.wrapping_add(z.wrapping_mul(x));
        z = z.wrapping_add(x.wrapping_mul(y));
        w = w.wrapping_add(y.wrapping_mul(z));
        [x, y, z, w] = [x, y, z, w].map(|word| word ^ (word >> 16));
    }
    [x, y, z, w]
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;
    use crate::kernels::splat;

    #[inline(always)]
    fn rounded<S: Simd>(simd: S, x: f32, base: f32) -> i32 {
        on_lattice::<S>(splat(simd, x), splat(simd, base))[0]
    }

    /// Numbers up to the stated size become the nearest multiples, and as many of them as stated can be added.
    #[test]
    fn numbers_are_rounded_to_a_lattice_on_which_they_can_be_added() {
        let finest = 1.0 / 262_144.0;
        for (count, size) in [(1, 0.01), (12, 5.0), (13, 5.0), (1000, 15.9), (1000, 16.1), (1024, 1e4), (1 << 20, 5.0)]
        {
            let [base, distance] = lattice(count, size, finest);
            let next = (base * 4.0 / 3.0).next_down();
            assert_eq!([base.next_up() - base, next - next.next_down()], [distance; 2], "{count} of {size}");
            assert_eq!(distance == finest as f32, size < 16.0 && count as f64 * size <= 4096.0, "{count} of {size}");
            for part in -1000..=1000 {
                let x = (size * f64::from(part) / 1000.0) as f32;
                let multiple = dispatch!(Level::new(), simd => rounded(simd, x, base));
                let expected = (f64::from(x) / f64::from(distance)).round_ties_even();
                assert_eq!(f64::from(multiple), expected, "{x} of {size}");
                assert!(i64::from(multiple).abs() * count as i64 <= 1 << 30, "{count} of {x}");
            }
        }
    }
}
