//! Tests evolution strategies against their papers' equations, written here in float64, on every instruction set.

use crate::support;
use fearless_simd::Level;
use flotilla::backend::cpu::{Cpu, level_name};
use flotilla::config::{Config, Learning, MAX_POPULATION, Method};
use flotilla::evolve::{self, Key, MAX_WEIGHT, Purpose, Samples, Strategy, is_weight};

fn learning(method: Method, population: usize, sigma: f64, step: f64) -> Learning {
    let mut config: Config = support::layout("generally_forward");
    let Learning { method: m, population: p, search_sigma, search_step, .. } = &mut config.learning;
    (*m, *p, *search_sigma, *search_step) = (method, population, sigma, step);
    config.with(&[]).unwrap().learning
}

fn strategy(method: Method, population: usize, parameters: usize) -> Strategy {
    Strategy::of(Level::new(), &learning(method, population, 0.3, 0.7), parameters).unwrap()
}

fn key(generation: usize) -> Key {
    Key::new(7, 1, Purpose::Weights).at(generation, 2, 3)
}

/// Returns random numbers from a roughly normal distribution.
fn random_numbers(count: usize, generation: usize) -> Vec<f32> {
    let mut numbers = vec![0.0; count];
    evolve::random_policy(Level::baseline(), key(generation), &mut numbers);
    numbers
}

#[track_caller]
fn assert_near(what: &str, actual: f64, expected: f64, tolerance: f64) {
    assert!((actual - expected).abs() <= tolerance, "{what}: {actual}, expected {expected}");
}

/// The utility of a rank, counted from 0, by the papers' formulas.
fn utility(method: Method, rank: usize, policies: usize) -> f64 {
    let count = policies as f64;
    match method {
        Method::OpenAiEs => (policies - 1 - rank) as f64 / (count - 1.0) - 0.5,
        _ => {
            let raw = |rank: usize| ((count / 2.0 + 1.0).ln() - (rank as f64 + 1.0).ln()).max(0.0);
            raw(rank) / (0..policies).map(raw).sum::<f64>() - 1.0 / count
        }
    }
}

#[test]
fn utilities_equal_the_papers_and_ties_share_the_mean() {
    for method in [Method::OpenAiEs, Method::Snes] {
        for policies in [2, 3, 4, 7, 50, 5000] {
            let strategy = strategy(method, policies, 112);
            let rising: Vec<f32> = (0..policies).map(|policy| policy as f32 - 1.5).collect();
            let actual = strategy.utilities(&rising);
            for (policy, &actual) in actual.iter().enumerate() {
                let expected = utility(method, policies - 1 - policy, policies);
                assert_near(&format!("{method}, {policy} of {policies}"), actual, expected, 1e-6);
            }
            assert_near("the sum", actual.iter().sum(), 0.0, 1e-12);
            // With equal scores, no direction is better than another.
            assert!(strategy.utilities(&vec![0.25; policies]).iter().all(|utility| utility.abs() < 1e-15));
        }
        // Sorted: three scores of 3 share ranks 0 to 2, 1 has rank 3, and two zeros share ranks 4 and 5.
        let actual = strategy(method, 6, 112).utilities(&[0.0, 3.0, 1.0, 3.0, -0.0, 3.0]);
        let mean = |ranks: std::ops::Range<usize>| {
            let count = ranks.len() as f64;
            ranks.map(|rank| utility(method, rank, 6)).sum::<f64>() / count
        };
        for (actual, expected) in
            actual.iter().zip([mean(4..6), mean(0..3), mean(3..4), mean(0..3), mean(4..6), mean(0..3)])
        {
            assert_near(&method.to_string(), *actual, expected, 1e-6);
        }
    }
}

/// Computes each weight by the Box-Muller formula in f64 from the draws of its counters.
#[test]
fn samples_equal_box_muller_of_their_counters() {
    let parameters = 150;
    let (mean, mut sigmas) = (random_numbers(parameters, 0), random_numbers(parameters, 1));
    sigmas.iter_mut().for_each(|sigma| *sigma = sigma.abs() + 0.01);
    let key = Key::new(8, 3, Purpose::Search);
    for (method, policies) in [(Method::OpenAiEs, 9), (Method::OpenAiEs, 8), (Method::Snes, 9)] {
        let samples = Samples { key, generation: 5, population: 1, policies, first: 2, mean: &mean, sigmas: &sigmas };
        let mut children = vec![f32::NAN; (policies - 2) * parameters];
        strategy(method, policies, parameters).sample(Level::new(), samples, &mut children, &mut vec![9.0; 3]);
        for (slot, child) in (2..).zip(children.chunks(parameters)) {
            let (number, sign) = match method {
                Method::OpenAiEs if slot == 8 => (0, 0.0),
                Method::OpenAiEs => (slot / 2, if slot % 2 == 0 { 1.0 } else { -1.0 }),
                _ => (slot, 1.0),
            };
            let key = key.at(5, 1, number);
            for (index, &weight) in child.iter().enumerate() {
                // One draw gives four deviates, 16 weights apart: a cosine and a sine for each pair of words.
                let words = key.draw((index / 64 * 16 + index % 16) as u32);
                let part = index / 16 % 4;
                let [a, b] = [words[part / 2 * 2], words[part / 2 * 2 + 1]];
                let unit = (f64::from(a >> 8) + 1.0) / (1u32 << 24) as f64;
                let angle = (f64::from(b >> 8) / (1u32 << 23) as f64 - 1.0) * std::f64::consts::PI;
                let deviate = (-2.0 * unit.ln()).sqrt() * if part % 2 == 0 { angle.cos() } else { angle.sin() };
                let expected = f64::from(mean[index]) + sign * f64::from(sigmas[index]) * deviate;
                assert_near(&format!("{method}, slot {slot}, weight {index}"), f64::from(weight), expected, 1e-5);
            }
        }
    }
}

/// Returns a population, `[policies + 2][parameters]`, and its scores. The last two rows are the mean and the standard
/// deviations.
fn population(policies: usize, parameters: usize) -> (Vec<f32>, Vec<f32>) {
    let mut population = random_numbers((policies + 2) * parameters, 2);
    let sigmas = (policies + 1) * parameters;
    population[sigmas..].iter_mut().for_each(|sigma| *sigma = sigma.abs() / 2.0 + 0.1);
    // Few distinct scores, as in real tasks.
    let scores = random_numbers(policies, 3).into_iter().map(|score| (score * 4.0).round() / 4.0).collect();
    (population, scores)
}

#[test]
fn updates_equal_the_papers_equations() {
    // The largest case has more policies than one block of the sum.
    for (policies, parameters) in [(8, 112), (37, 70), (2600, 5)] {
        let (before, scores) = population(policies, parameters);
        for method in [Method::OpenAiEs, Method::Snes] {
            let strategy = strategy(method, policies, parameters);
            let mut after = before.clone();
            strategy.update(Level::new(), 1, &scores, &mut after);
            let weights = policies * parameters;
            assert_eq!(after[..weights], before[..weights], "policies are unchanged");
            let mut ranked: Vec<f32> = scores.clone();
            ranked.sort_by(|a, b| b.partial_cmp(a).unwrap());
            let utility = |policy: usize| {
                let ranks = (0..policies).filter(|&rank| ranked[rank] == scores[policy]);
                let (mut sum, mut count) = (0.0, 0.0);
                ranks.for_each(|rank| (sum, count) = (sum + utility(method, rank, policies), count + 1.0));
                sum / count
            };
            let utilities: Vec<f64> = (0..policies).map(utility).collect();
            for index in 0..parameters {
                let [mean, sigma] = [0, 1].map(|slot| f64::from(before[weights + slot * parameters + index]));
                let deviate = |policy: usize| (f64::from(before[policy * parameters + index]) - mean) / sigma;
                let sum = |each: &dyn Fn(f64) -> f64| -> f64 {
                    (0..policies).map(|policy| utilities[policy] * each(deviate(policy))).sum()
                };
                let dimensions = parameters as f64;
                let rate = (3.0 + dimensions.ln()) / (5.0 * dimensions.sqrt());
                let (expected_mean, expected_sigma) = match method {
                    // Salimans et al. (2017), Algorithm 1.
                    Method::OpenAiEs => (mean + 0.7 / (policies as f64 * sigma) * sum(&|s| s), sigma),
                    // Wierstra et al. (2014), Algorithm 6. A step changes sigma by at most a factor of e.
                    _ => {
                        let change = rate / 2.0 * sum(&|s| s * s - 1.0);
                        (mean + sigma * sum(&|s| s), sigma * change.clamp(-1.0, 1.0).exp())
                    }
                };
                let actual = [0, 1].map(|slot| f64::from(after[weights + slot * parameters + index]));
                assert_near(
                    &format!("{method}, {policies}, mean {index}"),
                    actual[0],
                    expected_mean,
                    2e-6 * (1.0 + expected_mean.abs()),
                );
                assert_near(
                    &format!("{method}, {policies}, sigma {index}"),
                    actual[1],
                    expected_sigma,
                    2e-6 * (1.0 + expected_sigma),
                );
            }
        }
    }
}

/// Generation 0 is random for every method. The search starts from its best policy, or the first of equally good ones.
#[test]
fn a_search_starts_at_the_best_random_policy() {
    let (before, mut scores) = population(10, 6);
    scores.fill(1.0);
    (scores[3], scores[7]) = (2.0, 2.0);
    for method in [Method::OpenAiEs, Method::Snes] {
        let mut after = before.clone();
        strategy(method, 10, 6).update(Level::new(), 0, &scores, &mut after);
        assert_eq!(after[..60], before[..60]);
        assert_eq!(after[60..66], before[18..24]);
        assert_eq!(after[66..], [0.3; 6]);
    }
}

/// Repeated updates must find the optimum of a sphere, which checks the signs and sizes of steps.
#[test]
fn searches_find_the_optimum_of_a_sphere() {
    let (policies, parameters) = (60, 10);
    for method in [Method::OpenAiEs, Method::Snes] {
        let strategy = strategy(method, policies, parameters);
        let key = Key::new(3, 0, Purpose::Search);
        let mut search: Vec<f32> = [vec![2.0; parameters], vec![0.3; parameters]].concat();
        for generation in 0..150 {
            let (mean, sigmas) = search.split_at(parameters);
            let samples = Samples { key, generation, population: 0, policies, first: 0, mean, sigmas };
            let mut children = vec![0.0; policies * parameters];
            strategy.sample(Level::new(), samples, &mut children, &mut vec![]);
            let score = |policy: &[f32]| -policy.iter().map(|weight| (weight - 0.5).powi(2)).sum::<f32>();
            let scores: Vec<f32> = children.chunks(parameters).map(score).collect();
            children.extend_from_slice(&search);
            strategy.update(Level::new(), 1, &scores, &mut children);
            search = children.split_off(policies * parameters);
        }
        let worst = search[..parameters].iter().map(|weight| (weight - 0.5).abs()).fold(0.0, f32::max);
        assert!(worst < 0.2, "{method}: {worst}");
        let sigma = search[parameters..].iter().copied().fold(0.0, f32::max);
        assert!(if method == Method::Snes { sigma < 0.01 } else { sigma == 0.3 }, "{method}: {sigma}");
    }
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|number| number.to_bits()).collect()
}

/// Results must not depend on the instruction set, the first slot sampled, or the number of threads.
#[test]
fn searches_give_the_same_bits_on_any_instruction_set_and_threads() {
    for method in [Method::OpenAiEs, Method::Snes] {
        for (policies, parameters) in [(2, 1), (5, 15), (9, 112), (64, 65), (2500, 3)] {
            let (before, scores) = population(policies, parameters);
            let bits_from = |level: Level, first: usize| {
                let learning = learning(method, policies, 0.4, 1.3);
                let strategy = Strategy::of(level, &learning, parameters).unwrap();
                let mut population = before.clone();
                strategy.update(level, 2, &scores, &mut population);
                let search = population.split_off(policies * parameters);
                let (mean, sigmas) = search.split_at(parameters);
                let key = Key::new(1 << 40, 2, Purpose::Search);
                let samples = Samples { key, generation: 2, population: 5, policies, first, mean, sigmas };
                strategy.sample(level, samples, &mut population[first * parameters..], &mut vec![]);
                population.extend(&search);
                bits(&population[first * parameters..])
            };
            let expected = bits_from(Level::baseline(), 0);
            for level in Cpu::levels() {
                assert_eq!(bits_from(level, 0), expected, "{method}, {policies}, {parameters}, {}", level_name(level));
            }
            let first = policies / 4 * 2;
            assert_eq!(bits_from(Level::new(), first), expected[first * parameters..], "{method} from {first} on");
            for count in [1, 2, 8] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap();
                assert_eq!(pool.install(|| bits_from(Level::new(), 0)), expected, "{method}, {count} threads");
            }
        }
    }
}

/// For any scores, weights must be valid for the kernels, and standard deviations must stay positive.
#[test]
fn weights_and_sigmas_stay_in_bounds() {
    let (policies, parameters) = (20, 40);
    for method in [Method::OpenAiEs, Method::Snes] {
        for (sigma, step) in [(1e-6, 100.0), (100.0, 100.0), (100.0, 1e-6)] {
            let strategy = Strategy::of(Level::new(), &learning(method, policies, sigma, step), parameters).unwrap();
            let mut search: Vec<f32> =
                [[MAX_WEIGHT, -MAX_WEIGHT, 0.0, 1e-9].repeat(10), vec![sigma as f32; 40]].concat();
            for generation in 0..200 {
                let (mean, sigmas) = search.split_at(parameters);
                let key = Key::new(3, 0, Purpose::Search);
                let samples = Samples { key, generation, population: 0, policies, first: 0, mean, sigmas };
                let mut children = vec![0.0; policies * parameters];
                strategy.sample(Level::new(), samples, &mut children, &mut vec![]);
                // Larger weights score better in the first 100 generations, and smaller ones afterwards.
                let size = |policy: &[f32]| policy.iter().map(|weight| weight.abs() / MAX_WEIGHT).sum::<f32>();
                let sign = if generation < 100 { 1.0 } else { -1.0 };
                let scores: Vec<f32> = children.chunks(parameters).map(|policy| sign * size(policy)).collect();
                children.extend_from_slice(&search);
                strategy.update(Level::new(), 1, &scores, &mut children);
                assert!(children.iter().all(|&weight| is_weight(weight)), "{method}, {sigma}, {step}");
                search = children.split_off(policies * parameters);
                assert!(search[parameters..].iter().all(|&sigma| sigma > 0.0), "{method}, {sigma}, {step}");
            }
        }
    }
}

/// Utilities use logarithms of numbers up to half of the largest population, and must stay accurate there.
#[test]
fn utilities_are_accurate_for_the_largest_population() {
    let scores: Vec<f32> = (0..MAX_POPULATION).map(|policy| -(policy as f32)).collect();
    let actual = strategy(Method::Snes, MAX_POPULATION, 112).utilities(&scores);
    let count = MAX_POPULATION as f64;
    for rank in [0, 1, 1000, MAX_POPULATION / 2 - 1, MAX_POPULATION / 2, MAX_POPULATION - 1] {
        assert_near("utility", actual[rank] * count, utility(Method::Snes, rank, MAX_POPULATION) * count, 2e-5);
    }
}
