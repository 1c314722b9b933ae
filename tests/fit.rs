//! The polynomials of the exact core, fitted anew: what is the best that polynomials of their form can do, and how near to
//! that are the constants in `src/kernels/math.rs`, each rounded to f32?
//!
//! `cargo test --test fit -- --nocapture` prints the best coefficients beside those in use. They differ in their last digits:
//! the best are best in exact arithmetic, and in f32 rounding errs as much as what is left of the fit (`tests/math.rs` has
//! the errors of the results, over every float). What follows from a definition is held to the bit.

use std::f64::consts::{LN_2, PI, SQRT_2, TAU};

const RUST: &str = include_str!("../src/kernels/math.rs");

/// The decimal numbers in a function's body, in order.
fn numbers(function: &str) -> Vec<f32> {
    let start = RUST.find(&format!("fn {function}<")).unwrap_or_else(|| panic!("no {function}"));
    let body = &RUST[start..];
    let body = &body[body.find('{').unwrap()..body.find("\n}").unwrap()];
    let code: String = body.lines().map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n");
    // A number takes the sign before it along.
    let code = code.replace("e-", "e~").replace("- ", "-");
    let tokens = code.split(|c: char| !(c.is_ascii_alphanumeric() || ".~-".contains(c)));
    let decimal = tokens.filter(|token| token.contains('.') && token.contains(|c: char| c.is_ascii_digit()));
    decimal.filter_map(|token| token.replace("e~", "e-").parse().ok()).collect()
}

/// Solves a square system by elimination, the largest pivot first.
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

/// The coefficients with the least largest error |Σ cₖ·basis(k, x) − f(x)| / weight(x) over a range, and that error (Remez).
fn best(
    terms: usize,
    basis: impl Fn(usize, f64) -> f64,
    f: impl Fn(f64) -> f64,
    weight: impl Fn(f64) -> f64,
    [low, high]: [f64; 2],
) -> (Vec<f64>, f64) {
    const GRID: usize = 20_000;
    let chebyshev = |i: usize| (1.0 - (PI * (2 * i + 1) as f64 / (2 * (terms + 1)) as f64).cos()) / 2.0;
    let mut nodes: Vec<f64> = (0..=terms).map(|i| low + (high - low) * chebyshev(i)).collect();
    let mut found = (vec![], f64::INFINITY);
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
        if largest < found.1 {
            found = (coefficients, largest);
        }
        if peaks.len() <= terms {
            break;
        }
        nodes = peaks.into_iter().map(|peak| peak.0).collect();
    }
    found
}

/// The largest error of a function in exact arithmetic, or nearly: in f64.
fn error(
    approximation: impl Fn(f64) -> f64,
    f: impl Fn(f64) -> f64,
    weight: impl Fn(f64) -> f64,
    range: [f64; 2],
) -> f64 {
    const GRID: usize = 200_000;
    let [low, high] = range;
    let at = |i: usize| low + (high - low) * i as f64 / GRID as f64;
    (0..=GRID).map(at).map(|x| ((approximation(x) - f(x)) / weight(x)).abs()).fold(0.0, f64::max)
}

/// Horner's rule, the highest power first.
fn horner(coefficients: &[f32], z: f64) -> f64 {
    coefficients.iter().fold(0.0, |sum, &c| sum * z + f64::from(c))
}

/// Prints both, lowest power first, and their errors.
fn report(name: &str, used: &[f32], best: &[f64], errors: [f64; 2]) {
    println!("{name}: largest error {:.3e} in use, {:.3e} at best", errors[0], errors[1]);
    for (k, (used, best)) in used.iter().rev().zip(best).enumerate() {
        println!("  c{k} = {used:e} in use, {best:.9e} at best");
    }
}

/// Half of f32's spacing below 1: no result in 0.5..1 is nearer than that to what is exact.
const HALF: f64 = 1.0 / (1 << 25) as f64;

#[test]
fn sine_and_cosine_are_as_good_as_their_form_and_f32_allow() {
    let all = numbers("sin_cos");
    let (pi2, quarter) = (f64::from(all[0]), f64::from(all[1]));
    let (sine, cosine) = (&all[2..8], &all[8..14]);
    let range = [1e-3, PI];
    let basis = |k: usize, x: f64| x * (PI * PI - x * x) * (x * x).powi(k as i32);
    let (coefficients, least) = best(6, basis, f64::sin, |_| 1.0, range);
    let used = |x: f64| x * (pi2 - x * x) * horner(sine, x * x);
    let found = error(used, f64::sin, |_| 1.0, range);
    report("sin", sine, &coefficients, [found, least]);
    assert!(least < 1e-8 && found < least + 4.0 * HALF, "{found:e} against {least:e}");

    let basis = |k: usize, x: f64| (PI * PI / 4.0 - x * x).powi(k as i32 + 1);
    let (coefficients, least) = best(6, basis, f64::cos, |_| 1.0, [0.0, PI]);
    let used = |x: f64| (quarter - x * x) * horner(cosine, quarter - x * x);
    let found = error(used, f64::cos, |_| 1.0, [0.0, PI]);
    report("cos", cosine, &coefficients, [found, least]);
    assert!(least < 5e-8 && found < least + 4.0 * HALF, "{found:e} against {least:e}");
}

#[test]
fn the_logarithm_is_as_good_as_its_form_and_f32_allow() {
    let all = numbers("ln");
    let used = &all[1..8];
    let range = [1.0 / SQRT_2 - 1.0, SQRT_2 - 1.0];
    // Where f is 0 so are both, and their ratio is 1.
    let size = |f: f64| f.ln_1p().abs().max(1e-4);
    let (coefficients, least) = best(7, |k, f| f.powi(k as i32 + 2), |f| f.ln_1p() - f, size, range);
    let found = error(|f| f + f * f * horner(used, f), f64::ln_1p, size, range);
    report("ln", used, &coefficients, [found, least]);
    assert!(least < 4e-7 && found < 1.5 * least + 4.0 * HALF, "{found:e} against {least:e}");
}

/// Both parts of tanh(x/2) = n/d: with the limit and d's coefficients as they are, n is the best it can be for tanh x.
#[test]
fn the_tangent_ends_at_1_and_errs_both_ways_alike() {
    let (limit, all) = (f64::from(numbers("limit_tanh")[0]), numbers("half_tanh"));
    let [a, b, c, d, e] = all[..5] else { panic!("five coefficients: {all:?}") };
    let [a, b, c, d, e] = [a, b, c, d, e].map(f64::from);
    let tanh = |x: f64| {
        let z = x * x;
        let (n, d) = (x * ((z * a + b) * z + c), (z + d) * z + e);
        2.0 * n * d / (n * n + d * d)
    };
    let range = [1e-3, limit];
    let found = error(tanh, f64::tanh, |_| 1.0, range);
    let signs = (1..20_000).map(|i| limit * f64::from(i) / 20_000.0).map(|x| tanh(x) > x.tanh());
    let turns = signs.clone().zip(signs.skip(1)).filter(|(a, b)| a != b).count();
    println!(
        "tanh: largest error {found:.3e}, which changes its sign {turns} times; 1 - tanh(limit) = {:e}",
        1.0 - limit.tanh()
    );
    // Five coefficients of an odd function: the best errs to either side six times.
    assert!(found < 2e-7 && turns == 5);
    assert!((tanh(limit) - 1.0).abs() < 1e-6);
}

#[test]
fn reciprocals_are_as_good_as_their_seeds_allow() {
    // The product of x and the seed's power, over a period of the seed.
    let seed = |from: u32, shift: u32, x: f32| f64::from(f32::from_bits(from - (x.to_bits() >> shift)));
    let floats = || (0..1u32 << 24).step_by(61).map(|i| f32::from_bits(0x3f80_0000 + i));
    let ends = |values: &mut dyn Iterator<Item = f64>| values.fold([f64::MAX, 0.0], |[a, b], v| [v.min(a), v.max(b)]);

    let [a, b] = numbers("rough_rsqrt")[..] else { panic!("two coefficients") };
    let range = ends(&mut floats().map(|x| f64::from(x) * seed(0x5f09_6417, 1, x).powi(2)));
    // √r·(r² + a·r + b) is best a constant, 2^(-1/3).
    let scale = 2f64.powf(-1.0 / 3.0);
    let basis = |k: usize, r: f64| r.sqrt() * r.powi(k as i32);
    let (coefficients, least) = best(2, basis, |r| scale - r.sqrt() * r * r, |_| scale, range);
    let found = error(|r| r.sqrt() * ((r + f64::from(a)) * r + f64::from(b)), |_| scale, |_| scale, range);
    report("rough rsqrt", &[a, b], &coefficients, [found, least]);
    // One Newton step more than squares it: 1.5 of its square is left.
    assert!(1.5 * found * found < 2.0 * HALF, "{found:e} against {least:e}");

    let [c] = numbers("rough_twice_recip")[..] else { panic!("one coefficient") };
    let range = ends(&mut floats().filter(|x| *x < 2.0).map(|x| f64::from(x) * seed(0x7f32_428e, 0, x)));
    let (coefficients, least) = best(1, |_, r| r, |r| 2.0 + r * r, |_| 2.0, range);
    let found = error(|r| r * (f64::from(c) - r), |_| 2.0, |_| 2.0, range);
    report("rough 2/x", &[c], &coefficients, [found, least]);
    assert!(found * found < 2.0 * HALF, "{found:e} against {least:e}");
}

#[test]
fn constants_of_a_definition_are_that_to_the_bit() {
    let third = 2f64.powf(1.0 / 3.0);
    for (function, place, exact) in [
        ("rsqrt", 0, 1.5 * third),
        ("exact_sqrt", 0, 1.5 * third),
        ("ln", 9, LN_2),
        ("normal_angle", 1, TAU / f64::from(1 << 24)),
        ("normal_radius", 0, 1.0 / f64::from(1 << 24)),
        ("normal_of", 0, 1.0 / f64::from(1 << 20) / f64::from(1 << 20)),
    ] {
        let found = numbers(function);
        assert_eq!(found.get(place).copied(), Some(exact as f32), "{function}: {found:?}");
    }
    // The sine's factor vanishes at f32's π, the cosine's at π/2.
    let pi = PI as f32;
    assert_eq!(numbers("sin_cos")[..2], [pi * pi, (PI * PI / 4.0) as f32]);
}
