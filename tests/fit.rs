//! Fits the polynomials of the exact core again, and compares them with the constants in `src/kernels/math.rs`.
//!
//! Each constant in use is rounded to f32, and must be nearly as good as the best coefficients of the same form.
//! Constants that follow from a definition must be exact. `tests/math.rs` measures the errors of results over every
//! float.
//!
//! `cargo test fit:: -- --nocapture` prints the best coefficients next to those in use. Last digits differ: the
//! best are best in exact arithmetic, and rounding to f32 causes errors as large as those of the fit.

use std::f64::consts::{LN_2, PI, SQRT_2, TAU};

const RUST: &str = include_str!("../src/kernels/math.rs");

/// Returns the decimal numbers in a function's body, in order.
fn numbers(function: &str) -> Vec<f32> {
    let start = RUST.find(&format!("fn {function}<")).unwrap_or_else(|| panic!("no {function}"));
    let body = &RUST[start..];
    let body = &body[body.find('{').unwrap()..body.find("\n}").unwrap()];
    let code: String = body.lines().map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n");
    // Attach a minus sign to its number.
    let code = code.replace("e-", "e~").replace("- ", "-");
    let tokens = code.split(|c: char| !(c.is_ascii_alphanumeric() || ".~-".contains(c)));
    let decimal = tokens.filter(|token| token.contains('.') && token.contains(|c: char| c.is_ascii_digit()));
    decimal.filter_map(|token| token.replace("e~", "e-").parse().ok()).collect()
}

/// Solves a square system by elimination with partial pivoting.
fn solve(mut rows: Vec<Vec<f64>>) -> Vec<f64> {
    let n = rows.len();
    for column in 0..n {
        let largest = |&a: &usize, &b: &usize| rows[a][column].abs().total_cmp(&rows[b][column].abs());
        let pivot = (column..n).max_by(largest).unwrap();
        rows.swap(column, pivot);
        let row = rows[column].clone();
        for other in (0..n).filter(|&other| other != column) {
            let factor = rows[other][column] / row[column];
            rows[other].iter_mut().zip(&row).for_each(|(to, from)| *to -= factor * from);
        }
    }
    (0..n).map(|i| rows[i][n] / rows[i][i]).collect()
}

/// Returns the coefficients with the smallest maximum of |Σ cₖ·basis(k, x) − f(x)| / weight(x) over a range, and that
/// maximum (Remez algorithm).
fn best_fit(
    terms: usize,
    basis: impl Fn(usize, f64) -> f64,
    f: impl Fn(f64) -> f64,
    weight: impl Fn(f64) -> f64,
    [low, high]: [f64; 2],
) -> (Vec<f64>, f64) {
    const GRID: usize = 20_000;
    let chebyshev = |i: usize| (1.0 - (PI * (2 * i + 1) as f64 / (2 * (terms + 1)) as f64).cos()) / 2.0;
    let mut nodes: Vec<f64> = (0..=terms).map(|i| low + (high - low) * chebyshev(i)).collect();
    let mut optimum = (vec![], f64::INFINITY);
    for _ in 0..20 {
        let row = |(i, &x): (usize, &f64)| {
            let sign = if i % 2 == 0 { weight(x) } else { -weight(x) };
            (0..terms).map(|k| basis(k, x)).chain([sign, f(x)]).collect()
        };
        let mut coefficients = solve(nodes.iter().enumerate().map(row).collect());
        coefficients.truncate(terms);
        let error =
            |x: f64| (coefficients.iter().enumerate().map(|(k, c)| c * basis(k, x)).sum::<f64>() - f(x)) / weight(x);
        let mut peaks: Vec<(f64, f64)> = Vec::new();
        for x in (0..=GRID).map(|i| low + (high - low) * i as f64 / GRID as f64) {
            let error = error(x);
            match peaks.last_mut() {
                Some(last) if (last.1 > 0.0) == (error > 0.0) => {
                    *last = if error.abs() > last.1.abs() { (x, error) } else { *last };
                }
                _ => peaks.push((x, error)),
            }
        }
        while peaks.len() > terms + 1 {
            let drop = if peaks[0].1.abs() < peaks[peaks.len() - 1].1.abs() { 0 } else { peaks.len() - 1 };
            peaks.remove(drop);
        }
        let largest = peaks.iter().fold(0.0, |largest: f64, peak| largest.max(peak.1.abs()));
        if largest < optimum.1 {
            optimum = (coefficients, largest);
        }
        if peaks.len() <= terms {
            break;
        }
        nodes = peaks.into_iter().map(|peak| peak.0).collect();
    }
    optimum
}

/// Returns the maximum error of a function over a range, computed in f64 instead of exact arithmetic.
fn error(
    approximation: impl Fn(f64) -> f64,
    f: impl Fn(f64) -> f64,
    weight: impl Fn(f64) -> f64,
    range: [f64; 2],
) -> f64 {
    const GRID: usize = 200_000;
    let [low, high] = range;
    let point = |i: usize| low + (high - low) * i as f64 / GRID as f64;
    (0..=GRID).map(point).map(|x| ((approximation(x) - f(x)) / weight(x)).abs()).fold(0.0, f64::max)
}

/// Evaluates a polynomial by Horner's rule. The highest power comes first.
fn horner(coefficients: &[f32], z: f64) -> f64 {
    coefficients.iter().fold(0.0, |sum, &c| sum * z + f64::from(c))
}

/// Prints the coefficients in use and the best ones, lowest power first, and their maximum errors.
fn report(name: &str, used: &[f32], best: &[f64], errors: [f64; 2]) {
    println!("{name}: largest error {:.3e} in use, {:.3e} at best", errors[0], errors[1]);
    for (k, (used, best)) in used.iter().rev().zip(best).enumerate() {
        println!("  c{k} = {used:e} in use, {best:.9e} at best");
    }
}

/// Half the spacing of f32 below 1, and so the maximum rounding error of a result in 0.5..1.
const HALF_ULP: f64 = 1.0 / (1 << 25) as f64;

#[test]
fn sine_and_cosine_coefficients_are_nearly_optimal() {
    let constants = numbers("sin_cos");
    let (pi2, quarter) = (f64::from(constants[0]), f64::from(constants[1]));
    let (sine, cosine) = (&constants[2..8], &constants[8..14]);
    let range = [1e-3, PI];
    let basis = |k: usize, x: f64| x * (PI * PI - x * x) * (x * x).powi(k as i32);
    let (coefficients, best_error) = best_fit(6, basis, f64::sin, |_| 1.0, range);
    let used = |x: f64| x * (pi2 - x * x) * horner(sine, x * x);
    let used_error = error(used, f64::sin, |_| 1.0, range);
    report("sin", sine, &coefficients, [used_error, best_error]);
    assert!(best_error < 1e-8 && used_error < best_error + 4.0 * HALF_ULP, "{used_error:e} against {best_error:e}");

    let basis = |k: usize, x: f64| (PI * PI / 4.0 - x * x).powi(k as i32 + 1);
    let (coefficients, best_error) = best_fit(6, basis, f64::cos, |_| 1.0, [0.0, PI]);
    let used = |x: f64| (quarter - x * x) * horner(cosine, quarter - x * x);
    let used_error = error(used, f64::cos, |_| 1.0, [0.0, PI]);
    report("cos", cosine, &coefficients, [used_error, best_error]);
    assert!(best_error < 5e-8 && used_error < best_error + 4.0 * HALF_ULP, "{used_error:e} against {best_error:e}");
}

#[test]
fn logarithm_coefficients_are_nearly_optimal() {
    let constants = numbers("ln");
    let used = &constants[1..8];
    let range = [1.0 / SQRT_2 - 1.0, SQRT_2 - 1.0];
    // At f = 0 both are 0, and their ratio is 1.
    let size = |f: f64| f.ln_1p().abs().max(1e-4);
    let (coefficients, best_error) = best_fit(7, |k, f| f.powi(k as i32 + 2), |f| f.ln_1p() - f, size, range);
    let used_error = error(|f| f + f * f * horner(used, f), f64::ln_1p, size, range);
    report("ln", used, &coefficients, [used_error, best_error]);
    assert!(
        best_error < 4e-7 && used_error < 1.5 * best_error + 4.0 * HALF_ULP,
        "{used_error:e} against {best_error:e}"
    );
}

/// The numerator n of tanh(x/2) = n/d must be optimal for the given limit and denominator. An optimal error alternates.
#[test]
fn tanh_reaches_1_and_its_error_alternates() {
    let (limit, constants) = (f64::from(numbers("limit_tanh")[0]), numbers("half_tanh"));
    let [a, b, c, d, e] = constants[..5] else { panic!("five coefficients: {constants:?}") };
    let [a, b, c, d, e] = [a, b, c, d, e].map(f64::from);
    let tanh = |x: f64| {
        let z = x * x;
        let (n, d) = (x * ((z * a + b) * z + c), (z + d) * z + e);
        2.0 * n * d / (n * n + d * d)
    };
    let range = [1e-3, limit];
    let used_error = error(tanh, f64::tanh, |_| 1.0, range);
    let signs = (1..20_000).map(|i| limit * f64::from(i) / 20_000.0).map(|x| tanh(x) > x.tanh());
    let turns = signs.clone().zip(signs.skip(1)).filter(|(a, b)| a != b).count();
    println!(
        "tanh: largest error {used_error:.3e}, which changes its sign {turns} times; 1 - tanh(limit) = {:e}",
        1.0 - limit.tanh()
    );
    // An optimal approximation with five coefficients has six alternating extrema, so its sign changes five times.
    assert!(used_error < 2e-7 && turns == 5);
    assert!((tanh(limit) - 1.0).abs() < 1e-6);
}

#[test]
fn reciprocal_approximations_are_accurate_enough() {
    // The range of x times a power of its seed, over one period of the seed.
    let seed = |bits: u32, shift: u32, x: f32| f64::from(f32::from_bits(bits - (x.to_bits() >> shift)));
    let floats = || (0..1u32 << 24).step_by(61).map(|i| f32::from_bits(0x3f80_0000 + i));
    let bounds = |values: &mut dyn Iterator<Item = f64>| values.fold([f64::MAX, 0.0], |[a, b], v| [v.min(a), v.max(b)]);

    let [a, b] = numbers("rough_rsqrt")[..] else { panic!("two coefficients") };
    let range = bounds(&mut floats().map(|x| f64::from(x) * seed(0x5f09_6417, 1, x).powi(2)));
    // √r·(r² + a·r + b) should be constant, 2^(-1/3).
    let scale = 2f64.powf(-1.0 / 3.0);
    let basis = |k: usize, r: f64| r.sqrt() * r.powi(k as i32);
    let (coefficients, best_error) = best_fit(2, basis, |r| scale - r.sqrt() * r * r, |_| scale, range);
    let used_error = error(|r| r.sqrt() * ((r + f64::from(a)) * r + f64::from(b)), |_| scale, |_| scale, range);
    report("rough rsqrt", &[a, b], &coefficients, [used_error, best_error]);
    // The Newton step that follows leaves 1.5 times the square of the error.
    assert!(1.5 * used_error * used_error < 2.0 * HALF_ULP, "{used_error:e} against {best_error:e}");

    let [c] = numbers("rough_twice_recip")[..] else { panic!("one coefficient") };
    let range = bounds(&mut floats().filter(|x| *x < 2.0).map(|x| f64::from(x) * seed(0x7f32_428e, 0, x)));
    let (coefficients, best_error) = best_fit(1, |_, r| r, |r| 2.0 + r * r, |_| 2.0, range);
    let used_error = error(|r| r * (f64::from(c) - r), |_| 2.0, |_| 2.0, range);
    report("rough 2/x", &[c], &coefficients, [used_error, best_error]);
    assert!(used_error * used_error < 2.0 * HALF_ULP, "{used_error:e} against {best_error:e}");
}

#[test]
fn defined_constants_are_exact() {
    let cube_root = 2f64.powf(1.0 / 3.0);
    for (function, place, exact) in [
        ("rsqrt", 0, 1.5 * cube_root),
        ("exact_sqrt", 0, 1.5 * cube_root),
        ("ln", 9, LN_2),
        ("normal_angle", 1, TAU / f64::from(1 << 24)),
        ("normal_radius", 0, 1.0 / f64::from(1 << 24)),
        ("normal_of", 0, 1.0 / f64::from(1 << 20) / f64::from(1 << 20)),
    ] {
        let constants = numbers(function);
        assert_eq!(constants.get(place).copied(), Some(exact as f32), "{function}: {constants:?}");
    }
    // The factor of the sine is 0 at f32's π, and that of the cosine at π/2.
    let pi = PI as f32;
    assert_eq!(numbers("sin_cos")[..2], [pi * pi, (PI * PI / 4.0) as f32]);
}
