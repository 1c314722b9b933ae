//! The exact core (stand-in until the tuned one lands).
use fearless_simd::Simd;
use fearless_simd::prelude::*;

#[inline(always)]
pub fn rsqrt<S: Simd>(x: S::f32s) -> S::f32s {
    let bits: S::u32s = x.bitcast();
    let s = x.token();
    let seed: S::u32s = S::u32s::simd_from(s, 0x5f3759df) - (bits >> 1);
    let mut y: S::f32s = seed.bitcast();
    let half = x * 0.5;
    y = y * (S::f32s::simd_from(s, 1.5) - half * y * y);
    y = y * (S::f32s::simd_from(s, 1.5) - half * y * y);
    y
}
#[inline(always)]
pub fn recip<S: Simd>(x: S::f32s) -> S::f32s {
    let bits: S::u32s = x.bitcast();
    let s = x.token();
    let seed: S::u32s = S::u32s::simd_from(s, 0x7EF311C7) - bits;
    let mut y: S::f32s = seed.bitcast();
    y = y * (S::f32s::simd_from(s, 2.0) - x * y);
    y = y * (S::f32s::simd_from(s, 2.0) - x * y);
    y = y * (S::f32s::simd_from(s, 2.0) - x * y);
    y
}
#[inline(always)]
pub fn tanh<S: Simd>(x: S::f32s) -> S::f32s {
    let s = x.token();
    let x = super::bound::<S>(x, S::f32s::simd_from(s, -4.97), S::f32s::simd_from(s, 4.97));
    let z = x * x;
    let p = x * (((z + 378.0) * z + 17325.0) * z + 135135.0);
    let q = ((z * 28.0 + 3150.0) * z + 62370.0) * z + 135135.0;
    p * recip::<S>(q)
}
#[inline(always)]
pub fn sin_cos<S: Simd>(x: S::f32s) -> (S::f32s, S::f32s) {
    let z = x * x;
    let sin = x * ((((z * 2.7557319e-6 - 1.984127e-4) * z + 8.3333333e-3) * z - 0.16666667) * z + 1.0);
    let cos = (((z * 2.4801587e-5 - 1.3888889e-3) * z + 4.1666667e-2) * z - 0.5) * z + 1.0;
    (sin, cos)
}
#[inline(always)]
pub fn flush<S: Simd>(x: S::f32s, limit: f32) -> S::f32s {
    let s = x.token();
    x.abs().simd_lt(limit).select(S::f32s::simd_from(s, 0.0), x)
}
pub fn draw_scalar(v: [u32; 4]) -> [u32; 4] {
    let mut v = v.map(|x| x.wrapping_mul(1664525).wrapping_add(1013904223));
    let mix = |v: &mut [u32; 4]| {
        v[0] = v[0].wrapping_add(v[1].wrapping_mul(v[3]));
        v[1] = v[1].wrapping_add(v[2].wrapping_mul(v[0]));
        v[2] = v[2].wrapping_add(v[0].wrapping_mul(v[1]));
        v[3] = v[3].wrapping_add(v[1].wrapping_mul(v[2]));
    };
    mix(&mut v);
    v = v.map(|x| x ^ (x >> 16));
    mix(&mut v);
    v
}
#[inline(always)]
pub fn draw<S: Simd>(mut x: S::u32s, mut y: S::u32s, mut z: S::u32s, mut w: S::u32s) -> [S::u32s; 4] {
    x = x * 1664525 + 1013904223;
    y = y * 1664525 + 1013904223;
    z = z * 1664525 + 1013904223;
    w = w * 1664525 + 1013904223;
    x += y * w;
    y += z * x;
    z += x * y;
    w += y * z;
    x ^= x >> 16;
    y ^= y >> 16;
    z ^= z >> 16;
    w ^= w >> 16;
    x += y * w;
    y += z * x;
    z += x * y;
    w += y * z;
    [x, y, z, w]
}
#[inline(always)]
pub fn normal<S: Simd>(a: S::u32s, b: S::u32s) -> S::f32s {
    let s = a.token();
    let mut out = S::f32s::simd_from(s, 0.0);
    for i in 0..S::f32s::LEN {
        let u = ((a[i] >> 8) + 1) as f32 / 16777216.0;
        let v = (b[i] >> 8) as f32 / 16777216.0;
        out[i] = (-2.0 * u.ln()).sqrt() * (v * 6.2831855).cos();
    }
    out
}
