//! Compares the exact math functions with f64, over the floats of each range, and with their twins in WGSL.
//!
//! Also compares instruction sets with each other, and tests the quality of random words and normal deviates. One of 64
//! blocks of neighbouring floats is tested, and the last block. With `FLOTILLA_LONG=1`, all blocks are.

use fearless_simd::{Level, dispatch, prelude::*};
use flotilla::kernels::math;
use rayon::prelude::*;

fn is_long() -> bool {
    std::env::var("FLOTILLA_LONG").is_ok_and(|long| long == "1")
}

/// A function to test.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Function {
    Rsqrt,
    Root,
    Recip,
    Tanh,
    Sin,
    Cos,
    Ln,
    ExpNegative,
}
use Function::*;

#[inline(always)]
fn apply<S: Simd>(simd: S, function: Function, input: &[f32], output: &mut [f32]) {
    simd.vectorize(
        #[inline(always)]
        || {
            for (input, output) in input.chunks_exact(S::f32s::LEN).zip(output.chunks_exact_mut(S::f32s::LEN)) {
                let x = S::f32s::from_slice(simd, input);
                match function {
                    Rsqrt => math::rsqrt::<S>(x),
                    Root => math::exact_sqrt::<S>(x),
                    Recip => math::recip::<S>(x),
                    Tanh => math::whole_tanh::<S>(math::half_tanh::<S>(math::limit_tanh::<S>(x))),
                    Sin => math::sin_cos::<S>(x).0,
                    Cos => math::sin_cos::<S>(x).1,
                    Ln => math::ln::<S>(x),
                    ExpNegative => math::exp_negative::<S>(x),
                }
                .store_slice(output);
            }
        },
    );
}

fn run(level: Level, function: Function, input: &[f32]) -> Vec<f32> {
    let mut output = vec![0.0; input.len()];
    dispatch!(level, simd => apply(simd, function, input, &mut output));
    output
}

/// The largest errors over a range: absolute, relative, and in ULP of the exact value. `largest` is the largest output.
#[derive(Clone, Copy, Debug, Default)]
struct Errors {
    absolute: f64,
    relative: f64,
    ulp: f64,
    largest: f64,
}

impl Errors {
    fn join(self, other: Errors) -> Errors {
        Errors {
            absolute: self.absolute.max(other.absolute),
            relative: self.relative.max(other.relative),
            ulp: self.ulp.max(other.ulp),
            largest: self.largest.max(other.largest),
        }
    }
}

/// Returns the errors over the floats from `low` to `high`, both positive.
fn sweep(function: Function, low: f32, high: f32, exact: impl Fn(f64) -> f64 + Sync) -> Errors {
    const BLOCK: usize = 1 << 14;
    let level = Level::new();
    let patterns = low.to_bits()..high.to_bits() + 1;
    let step = if is_long() { 1 } else { 64 };
    let blocks = patterns.len().div_ceil(BLOCK);
    let errors = (0..blocks)
        .into_par_iter()
        .filter(|block| block % step == 0 || block + 1 == blocks)
        .map(|block| {
            // The last block exceeds the range, so its inputs are clamped.
            let first = patterns.start + (block * BLOCK) as u32;
            let input: Vec<f32> =
                (0..BLOCK as u32).map(|i| f32::from_bits((first + i).min(patterns.end - 1))).collect();
            let output = run(level, function, &input);
            let mut errors = Errors::default();
            for (&x, &y) in input.iter().zip(&output) {
                let (y, exact) = (y as f64, exact(x as f64));
                let exponent = f64::from_bits(exact.to_bits() & 0x7ff0_0000_0000_0000);
                let error = (y - exact).abs();
                let step = Errors {
                    absolute: error,
                    relative: error / exact.abs(),
                    ulp: error / exponent * (1 << 23) as f64,
                    largest: y.abs(),
                };
                assert!(y.is_finite(), "{function:?} of {x:e} is {y}");
                errors = errors.join(step);
            }
            errors
        })
        .reduce(Errors::default, Errors::join);
    println!("{function:?} over {low:e}..{high:e}: {errors:?}");
    errors
}

fn power(exponent: i32) -> f32 {
    2f32.powi(exponent)
}

#[test]
fn rsqrt_is_within_2_ulp() {
    assert!(sweep(Rsqrt, power(-80), power(48), |x| 1.0 / x.sqrt()).ulp < 2.0);
    assert_eq!(0.0 * run(Level::new(), Rsqrt, &[0.0; 16])[0], 0.0);
}

#[test]
fn exact_sqrt_is_within_2_1_ulp() {
    assert!(sweep(Root, power(-80), power(48), f64::sqrt).ulp < 2.1);
    assert_eq!(run(Level::new(), Root, &[0.0; 16])[0].to_bits(), 0);
}

#[test]
fn recip_is_within_2_ulp() {
    assert!(sweep(Recip, power(-40), power(40), |x| 1.0 / x).ulp < 2.0);
}

#[test]
fn exp_negative_has_its_documented_error() {
    assert!(sweep(ExpNegative, power(-40), 60.0, |x| (-x).exp()).relative < 2.6e-7);
    let ends = run(Level::new(), ExpNegative, &[0.0, 60.0, 61.0, 1e30].repeat(4));
    assert!(ends[0] == 1.0 && ends[1] == ends[2] && ends[2] == ends[3], "{ends:?}");
}

#[test]
fn tanh_has_its_documented_error_and_range() {
    let series = |x: f64| x - x * x * x * (1.0 / 3.0 - x * x * (2.0 / 15.0 - x * x * (17.0 / 315.0)));
    let low = sweep(Tanh, power(-40), power(-6), series);
    let high = sweep(Tanh, power(-6), 8.0, f64::tanh);
    let errors = low.join(high);
    assert!(errors.absolute < 4.5e-7 && errors.relative < 1.1e-6 && errors.largest <= 1.0, "{errors:?}");
    let wide: Vec<f32> = (0..128).map(|exponent| power(exponent) * 1.9).collect();
    let wide = run(Level::new(), Tanh, &wide);
    assert!(wide[3..].iter().all(|&y| y <= 1.0 && 1.0 - y < 4.5e-7));
}

#[test]
fn sin_and_cos_have_their_documented_errors() {
    let turn = std::f32::consts::PI;
    let sin = |x: f64| x - x * x * x * (1.0 / 6.0 - x * x * (1.0 / 120.0 - x * x * (1.0 / 5040.0)));
    let cos = |x: f64| 1.0 - x * x * (0.5 - x * x * (1.0 / 24.0 - x * x * (1.0 / 720.0)));
    let low = sweep(Sin, power(-40), power(-4), sin);
    assert!(low.relative < 2.5e-7, "{low:?}");
    for errors in [
        sweep(Sin, power(-4), turn, f64::sin),
        sweep(Cos, power(-40), power(-4), cos),
        sweep(Cos, power(-4), turn, f64::cos),
    ] {
        assert!(errors.absolute < 1.9e-7, "{errors:?}");
    }
}

#[test]
fn odd_and_even_functions_are_symmetric_and_exact_at_zero() {
    let positive: Vec<f32> = (0..1 << 16).map(|i| power(-40) + i as f32 * 4.7e-5).collect();
    let negative: Vec<f32> = positive.iter().map(|x| -x).collect();
    for (function, sign) in [(Tanh, -1.0), (Sin, -1.0), (Cos, 1.0)] {
        let (a, b) = (run(Level::new(), function, &positive), run(Level::new(), function, &negative));
        assert!(a.iter().zip(&b).all(|(&a, &b)| a == sign * b), "{function:?}");
    }
    for (function, at_zero) in [(Tanh, 0f32), (Sin, 0.0), (Cos, 1.0)] {
        assert_eq!(run(Level::new(), function, &[0.0; 16])[0].to_bits(), at_zero.to_bits(), "{function:?}");
    }
}

#[test]
fn ln_has_its_documented_error() {
    let errors = sweep(Ln, power(-24), 1.0 - power(-24), f64::ln);
    assert!(errors.relative < 3.2e-7, "{errors:?}");
    assert_eq!(run(Level::new(), Ln, &[1.0; 16])[0], 0.0);
}

/// Returns the instruction sets of this processor, the best first.
fn levels() -> Vec<Level> {
    let best = Level::new();
    #[cfg(target_arch = "x86_64")]
    let others =
        [best.as_avx2().map(Level::Avx2), best.as_sse4_2().map(Level::Sse4_2), best.as_sse2().map(Level::Sse2)];
    #[cfg(not(target_arch = "x86_64"))]
    let others = [Some(Level::baseline())];
    [Some(best)].into_iter().chain(others).flatten().collect()
}

/// Returns random floats within the function's range.
fn samples(function: Function, count: u32) -> Vec<f32> {
    let (low, high) = match function {
        Rsqrt | Root => (power(-80), power(48)),
        Recip => (power(-40), power(40)),
        Tanh => (power(-40), power(10)),
        Sin | Cos => (power(-40), std::f32::consts::PI),
        Ln => (power(-24), 1.0),
        ExpNegative => (power(-40), 100.0),
    };
    let span = (high.to_bits() - low.to_bits()) as u64;
    (0..count)
        .map(|i| {
            let [word, sign, ..] = math::pcg4d_scalar([i, 0, 0, function as u32]);
            let x = f32::from_bits(low.to_bits() + ((word as u64 * span) >> 32) as u32);
            if matches!(function, Tanh | Sin | Cos) && sign >> 31 == 1 { -x } else { x }
        })
        .collect()
}

#[test]
fn levels_give_the_same_bits() {
    let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
    for function in [Rsqrt, Root, Recip, Tanh, Sin, Cos, Ln, ExpNegative] {
        let input = samples(function, 1 << 20);
        let expected = bits(run(Level::new(), function, &input));
        for level in levels() {
            assert!(bits(run(level, function, &input)) == expected, "{function:?} on {level:?}");
        }
    }
    let expected = normals(Level::new(), 1 << 20);
    for level in levels() {
        assert!(bits(normals(level, 1 << 20)) == bits(expected.clone()), "normal on {level:?}");
    }
}

/// Returns the random words for the counters 0, 1, and so on at index `place`. The other three counters are 7.
fn draws(level: Level, place: usize, count: usize) -> Vec<[u32; 4]> {
    #[inline(always)]
    fn kernel<S: Simd>(simd: S, place: usize, draws: &mut [[u32; 4]]) {
        simd.vectorize(
            #[inline(always)]
            || {
                let mut counter = 0;
                for chunk in draws.chunks_exact_mut(S::u32s::LEN) {
                    let mut counters = [S::u32s::splat(simd, 7); 4];
                    counters[place] = S::u32s::from_fn(simd, |lane| counter + lane as u32);
                    counter += S::u32s::LEN as u32;
                    let [x, y, z, w] = counters;
                    let words = math::pcg4d::<S>(x, y, z, w);
                    for (lane, draw) in chunk.iter_mut().enumerate() {
                        *draw = [words[0][lane], words[1][lane], words[2][lane], words[3][lane]];
                    }
                }
            },
        );
    }
    let mut draws = vec![[0; 4]; count];
    dispatch!(level, simd => kernel(simd, place, &mut draws));
    draws
}

#[test]
fn pcg4d_scalar_equals_each_lane_of_pcg4d() {
    for level in levels() {
        for place in 0..4 {
            for (i, lane) in draws(level, place, 1 << 16).into_iter().enumerate() {
                let mut counter = [7; 4];
                counter[place] = i as u32;
                assert_eq!(lane, math::pcg4d_scalar(counter), "{level:?}, counter {counter:?}");
            }
        }
    }
}

/// Returns how many standard deviations a count of heads among `n` fair coins is away from its mean.
fn deviations(count: usize, n: usize) -> f64 {
    (count as f64 - n as f64 / 2.0).abs() / (n as f64 / 4.0).sqrt()
}

#[test]
fn draws_look_uniform_and_uncorrelated() {
    const COUNT: usize = 1 << 20;
    // At most 4.4 · 10^5 counts are tested below. For a fair generator, one of 3 · 10^4 such tests would exceed 6.5.
    const LIMIT: f64 = 6.5;
    let lags = if is_long() { &[0, 1, 2, 16, 256, 1 << 16, 1 << 19][..] } else { &[0, 1, 1 << 16] };
    (0..16).into_par_iter().for_each(|case| {
        let (place, word) = (case / 4, case % 4);
        let stream = draws(Level::new(), place, COUNT);
        let words: Vec<u32> = stream.iter().map(|draw| draw[word]).collect();
        for shift in [0, 8, 16, 24] {
            let mut bins = [0f64; 256];
            words.iter().for_each(|word| bins[(word >> shift) as usize & 255] += 1.0);
            let mean = (COUNT / 256) as f64;
            let chi2: f64 = bins.iter().map(|bin| (bin - mean) * (bin - mean) / mean).sum();
            assert!((chi2 - 255.0).abs() < LIMIT * 510f64.sqrt(), "counter {place}, word {word}: chi-square {chi2}");
        }
        // Compares each bit with each bit of later draws, and of the other words of the same draw.
        for &lag in lags {
            for other in (0..4).filter(|&other| lag > 0 || other != word) {
                let (pairs, later) = (1 << 15, &stream[lag..]);
                for rotation in 0..32 {
                    let mut ones = [0usize; 32];
                    for i in 0..pairs {
                        let differing = words[i] ^ later[i][other].rotate_left(rotation);
                        ones.iter_mut().enumerate().for_each(|(bit, ones)| *ones += (differing >> bit & 1) as usize);
                    }
                    for (bit, &ones) in ones.iter().enumerate() {
                        let off = deviations(ones, pairs);
                        assert!(off < LIMIT, "counter {place}, word {word}, bit {bit}, lag {lag}, {other}: {off}");
                    }
                }
            }
        }
    });
}

#[test]
fn every_counter_bit_affects_every_random_bit() {
    const COUNT: usize = 1 << 14;
    (0..128usize).into_par_iter().for_each(|flipped| {
        let mut ones = [[0usize; 32]; 4];
        for i in 0..COUNT as u32 {
            let counter = math::pcg4d_scalar([i, 1, 2, 3]);
            let mut neighbour = counter;
            neighbour[flipped / 32] ^= 1 << (flipped % 32);
            let (a, b) = (math::pcg4d_scalar(counter), math::pcg4d_scalar(neighbour));
            for (word, ones) in ones.iter_mut().enumerate() {
                ones.iter_mut().enumerate().for_each(|(bit, ones)| *ones += ((a[word] ^ b[word]) >> bit & 1) as usize);
            }
        }
        for (word, bits) in ones.iter().enumerate() {
            for (bit, &ones) in bits.iter().enumerate() {
                let share = ones as f64 / COUNT as f64;
                assert!((0.2..0.8).contains(&share), "counter bit {flipped}, word {word}, bit {bit}: {share}");
            }
        }
    });
}

/// Returns normal deviates for the counters 0, 1, and so on.
fn normals(level: Level, count: usize) -> Vec<f32> {
    #[inline(always)]
    fn kernel<S: Simd>(simd: S, words: &[[u32; 4]], output: &mut [f32]) {
        simd.vectorize(
            #[inline(always)]
            || {
                for (words, output) in words.chunks_exact(S::f32s::LEN).zip(output.chunks_exact_mut(S::f32s::LEN)) {
                    let a = S::u32s::from_fn(simd, |lane| words[lane][0]);
                    let b = S::u32s::from_fn(simd, |lane| words[lane][1]);
                    math::normal::<S>(a, b).store_slice(output);
                }
            },
        );
    }
    let words = draws(level, 0, count);
    let mut output = vec![0.0; count];
    dispatch!(level, simd => kernel(simd, &words, &mut output));
    output
}

#[test]
fn normal_deviates_have_a_normal_distribution() {
    const COUNT: usize = 1 << 24;
    let deviates = normals(Level::new(), COUNT);
    let n = COUNT as f64;
    let moment = |power: i32| deviates.iter().map(|&x| (x as f64).powi(power)).sum::<f64>() / n;
    // The standard deviation of a sample moment of order k is sqrt((m_2k - m_k²) / n).
    for (power, expected, scatter) in [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0), (6, 15.0, 10170.0)]
    {
        let off = (moment(power) - expected) / (scatter / n).sqrt();
        assert!(off.abs() < 5.0, "moment {power}: {off} deviations off");
    }
    // Compares 200 bins from -4 to 4, and the tails, with the integral of the density (Simpson's rule).
    const BINS: usize = 200;
    let width = 8.0 / BINS as f64;
    let mut counts = [0f64; BINS];
    let (mut tail_4, mut tail_5) = (0f64, 0f64);
    for &x in &deviates {
        let bin = ((x as f64 + 4.0) / width).floor();
        if (0.0..BINS as f64).contains(&bin) {
            counts[bin as usize] += 1.0;
        }
        tail_4 += (x.abs() >= 4.0) as u32 as f64;
        tail_5 += (x.abs() >= 5.0) as u32 as f64;
    }
    let density = |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
    let chi2: f64 = (0..BINS)
        .map(|bin| {
            let low = bin as f64 * width - 4.0;
            let mass = width / 6.0 * (density(low) + 4.0 * density(low + width / 2.0) + density(low + width));
            (counts[bin] - n * mass).powi(2) / (n * mass)
        })
        .sum();
    assert!((chi2 - BINS as f64).abs() < 5.0 * (2.0 * BINS as f64).sqrt(), "chi-square {chi2} for {BINS} bins");
    for (tail, mass) in [(tail_4, 6.334e-5), (tail_5, 5.733e-7)] {
        assert!((tail - n * mass).abs() < 5.0 * (n * mass).sqrt(), "{tail} in a tail of {}", n * mass);
    }
    let extreme = deviates.iter().fold(0f32, |largest, x| largest.max(x.abs()));
    assert!((5.0..5.8).contains(&extreme), "{extreme}");
}

#[test]
fn flush_makes_small_values_positive_zero() {
    fn kernel<S: Simd>(simd: S, x: f32) -> f32 {
        math::flush::<S>(S::f32s::splat(simd, x), 0.5)[0]
    }
    for (x, flushed) in [(0.49, 0.0), (-0.49, 0.0), (-0.0, 0.0), (0.0, 0.0), (0.5, 0.5), (-0.5, -0.5), (3.0, 3.0f32)] {
        let y: f32 = dispatch!(Level::new(), simd => kernel(simd, x));
        assert_eq!(y.to_bits(), flushed.to_bits(), "{x}");
    }
}

const RUST: &str = include_str!("../src/kernels/math.rs");
const WGSL: &str = include_str!("../shaders/lib/math.wgsl");

#[cfg(feature = "gpu")]
#[test]
fn the_math_shader_is_valid() {
    let module = naga::front::wgsl::parse_str(WGSL).unwrap_or_else(|error| panic!("{}", error.emit_to_string(WGSL)));
    naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty())
        .validate(&module)
        .unwrap();
}

/// Returns the numbers in the body of a function, in order.
fn numbers(source: &str, function: &str) -> Vec<f64> {
    let start = source.find(&format!("fn {function}")).unwrap_or_else(|| panic!("no {function}"));
    let body = &source[start..];
    let body = &body[body.find('{').unwrap()..body.find("\n}").unwrap()];
    let code: String = body.lines().map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n");
    // A minus sign in an exponent does not separate numbers.
    let code = code.replace("e-", "e~");
    code.split(|c: char| !(c.is_ascii_alphanumeric() || "._~".contains(c)))
        .filter(|token| token.starts_with(|c: char| c.is_ascii_digit()))
        .map(|token| {
            let token = token.replace('~', "-").replace('_', "");
            match token.strip_prefix("0x") {
                Some(hex) => u32::from_str_radix(hex.trim_end_matches('u'), 16).unwrap() as f64,
                None => token.trim_end_matches('u').parse().unwrap_or_else(|_| panic!("{function}: {token}")),
            }
        })
        .collect()
}

#[test]
fn twins_have_the_same_numbers() {
    for function in [
        "rsqrt",
        "exact_sqrt",
        "rough_rsqrt",
        "recip",
        "rough_twice_recip",
        "limit_tanh",
        "half_tanh",
        "whole_tanh",
        "sin_cos",
        "ln",
        "exp_negative",
    ] {
        let twin = numbers(WGSL, &format!("{function}("));
        assert!(!twin.is_empty(), "{function}");
        assert_eq!(numbers(RUST, &format!("{function}<")), twin, "{function}");
    }
}
