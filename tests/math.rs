//! The exact core against f64, over every float of each range; its levels against each other; its random words.

use fearless_simd::{Level, dispatch, prelude::*};
use flotilla::kernels::math;
use rayon::prelude::*;

/// What a test runs over slices.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Function {
    Rsqrt,
    Root,
    Recip,
    Tanh,
    Sin,
    Cos,
    Ln,
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
                    Root => math::root::<S>(x),
                    Recip => math::recip::<S>(x),
                    Tanh => math::hyperbolic_tangent::<S>(x),
                    Sin => math::sin_cos::<S>(x).0,
                    Cos => math::sin_cos::<S>(x).1,
                    Ln => math::ln::<S>(x),
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

/// The largest errors over a range: absolute, relative, and in ULP of the exact value.
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

/// Every float from `low` to `high`, both positive, in blocks.
fn sweep(function: Function, low: f32, high: f32, exact: impl Fn(f64) -> f64 + Sync) -> Errors {
    const BLOCK: usize = 1 << 14;
    let level = Level::new();
    let patterns = low.to_bits()..high.to_bits() + 1;
    let errors = (0..patterns.len().div_ceil(BLOCK))
        .into_par_iter()
        .map(|block| {
            // The last block runs past the range, and is cut to it.
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
    assert!(sweep(Rsqrt, power(-80), power(40), |x| 1.0 / x.sqrt()).ulp < 2.1);
}

#[test]
fn root_is_within_2_ulp() {
    assert!(sweep(Root, power(-80), power(40), f64::sqrt).ulp < 2.1);
}

#[test]
fn recip_is_within_2_ulp() {
    assert!(sweep(Recip, power(-40), power(40), |x| 1.0 / x).ulp < 2.1);
}

#[test]
fn tanh() {
    let small = |x: f64| x - x * x * x * (1.0 / 3.0 - x * x * (2.0 / 15.0 - x * x * (17.0 / 315.0)));
    let a = sweep(Tanh, power(-40), power(-6), small);
    let b = sweep(Tanh, power(-6), 8.0, f64::tanh);
    assert!(a.join(b).largest <= 1.0);
}

#[test]
fn sin_cos() {
    let p = std::f32::consts::PI;
    sweep(Sin, power(-40), power(-4), |x| x - x * x * x * (1.0 / 6.0 - x * x * (1.0 / 120.0 - x * x * (1.0 / 5040.0))));
    sweep(Sin, power(-4), p, f64::sin);
    sweep(Cos, power(-40), power(-4), |x| 1.0 - x * x * (0.5 - x * x * (1.0 / 24.0 - x * x * (1.0 / 720.0))));
    sweep(Cos, power(-4), p, f64::cos);
}

#[test]
fn ln() {
    sweep(Ln, power(-24), 0.99999994, f64::ln);
}
