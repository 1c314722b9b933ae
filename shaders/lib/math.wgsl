// The exact core. Twin of src/kernels/math.rs, which documents ranges and errors: same names, statements and order.

// 1/√x; some finite value for 0.
fn rsqrt(x: f32) -> f32 {
    let y = rough_rsqrt(x);
    return y * (1.8898816 - x * y * y);
}

// √x.
fn exact_sqrt(x: f32) -> f32 {
    let y = rough_rsqrt(x);
    let g = x * y;
    return g * (1.8898816 - g * y);
}

// 2^(-1/3)/√x.
fn rough_rsqrt(x: f32) -> f32 {
    let bits = bitcast<u32>(x);
    let y = bitcast<f32>(0x5f096417u - (bits >> 1u));
    let r = x * y * y;
    return y * ((r - 2.0547535) * r + 1.8974205);
}

// 1/x for positive x.
fn recip(x: f32) -> f32 {
    let y = rough_twice_recip(x);
    return y * (1.0 - x * 0.25 * y);
}

// 2/x.
fn rough_twice_recip(x: f32) -> f32 {
    let bits = bitcast<u32>(x);
    let y = bitcast<f32>(0x7f32428eu - bits);
    return y * (2.8286855 - x * y);
}

// Clamps x to the range outside of which tanh is ±1.
fn limit_tanh(x: f32) -> f32 {
    let limit = 7.5501223;
    let low = select(limit, x, x < limit);
    return select(-limit, low, low > -limit);
}

// n and d with tanh(x/2) = n/d, for x from limit_tanh.
fn half_tanh(x: f32) -> vec2<f32> {
    let z = x * x;
    let n = x * ((z * 0.02999907 + 14.7163315) * z + 544.93274);
    let d = (z + 120.25281) * z + 1089.8662;
    return vec2<f32>(n, d);
}

// tanh x, from its half_tanh.
fn whole_tanh(half: vec2<f32>) -> f32 {
    let n = half.x;
    let d = half.y;
    let s = n * n + d * d;
    let y = rough_twice_recip(s);
    return n * d * (y * (2.0 - s * 0.5 * y));
}

// (sin x, cos x) for |x| up to π.
fn sin_cos(x: f32) -> vec2<f32> {
    let z = x * x;
    let u = 9.869605 - z;
    let v = 2.467401 - z;
    let p = ((((z * -1.3433592e-10 + 2.3344368e-8) * z - 2.5224585e-6) * z + 1.7350527e-4) * z - 6.6208793e-3) * z
        + 0.101321176;
    let q = ((((v * 1.7268913e-9 + 2.452929e-7) * v + 2.1586762e-5) * v + 1.1602798e-3) * v + 3.2251544e-2) * v
        + 0.31830987;
    return vec2<f32>(x * u * p, v * q);
}

// ln x for x in 2^-24..1.
fn ln(x: f32) -> f32 {
    let bits = bitcast<u32>(x);
    // x = 2^(k - 32) · m with m from √½ to √2.
    let i = bits - 0x2f3504f3u;
    let k = f32(i >> 23u);
    let m = bitcast<f32>((i & 0x7fffffu) + 0x3f3504f3u);
    let f = m - 1.0;
    let p = (((((f * -0.10347979 + 0.16278985) * f - 0.17201562) * f + 0.19893996) * f - 0.24973385) * f + 0.3333509)
        * f
        - 0.50000286;
    return (k - 32.0) * 0.6931472 + f * (f * p + 1.0);
}

// exp(-x) for x from 0.
fn exp_negative(x: f32) -> f32 {
    let most = 60.0;
    let limited = select(most, x, x < most);
    let whole = 12582912.0;
    let raised = limited * 1.442695 + whole;
    let k = raised - whole;
    let r = (limited - k * 0.6933594) + k * 2.1219444e-4;
    let p = (((((r * 1.3888889e-3 - 8.333333e-3) * r + 4.1666668e-2) * r - 0.16666667) * r + 0.5) * r - 1.0) * r + 1.0;
    return bitcast<f32>(bitcast<i32>(p) - (less_base(raised, whole) << 23u));
}

// A standard normal deviate from two uniform words.
fn normal(a: u32, b: u32) -> f32 {
    let u = f32((a >> 8u) + 1u) * 5.9604645e-8;
    let angle = (f32(b >> 8u) - 8388608.0) * 3.7450704e-7;
    let radius = exact_sqrt(ln(u) * -2.0);
    let cosine = sin_cos(angle).y;
    return flush(radius * cosine, 9.094947e-13);
}

// `x` clamped to `low..=high`.
fn clamp_to(x: f32, low: f32, high: f32) -> f32 {
    let raised = select(x, low, x < low);
    return select(raised, high, raised > high);
}

// Whether the length of an offset is at most a radius, given squared. Compares bits, which are in the order of the
// numbers because none is negative; so no guard is needed in between.
fn within(dx: f32, dy: f32, radius2: f32) -> bool {
    let d2 = dx * dx + dy * dy;
    return bitcast<i32>(d2) <= bitcast<i32>(radius2);
}

// A number as a multiple of a lattice's distance, see `lattice` in src/kernels/mod.rs.
fn on_lattice(x: f32, base: f32) -> i32 {
    return less_base(x + base, base);
}

// on_lattice of a number that the base was added to.
fn less_base(raised: f32, base: f32) -> i32 {
    return bitcast<i32>(raised) - bitcast<i32>(base);
}

// The f32 nearest to an integer. Drivers may convert large ones otherwise, but both of these parts are exact.
fn nearest_f32(x: i32) -> f32 {
    return f32(x & ~0xfff) + f32(x & 0xfff);
}

// +0 where |x| < limit, else x.
fn flush(x: f32, limit: f32) -> f32 {
    return select(x, 0.0, abs(x) < limit);
}

// Four random words for a counter: pcg4d with one more round.
fn pcg4d(counter: vec4<u32>) -> vec4<u32> {
    return pcg4d_round(pcg4d_round(counter * 1664525u + 1013904223u));
}

// One round of pcg4d.
fn pcg4d_round(counter: vec4<u32>) -> vec4<u32> {
    var v = counter;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    return v ^ (v >> vec4<u32>(16u));
}
