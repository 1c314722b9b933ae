//! Evolution strategies follow their equations, which this file states again in float64, on every instruction set.

mod support;

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

/// Random numbers that are roughly normal.
fn numbers(count: usize, generation: usize) -> Vec<f32> {
    let mut numbers = vec![0.0; count];
    evolve::random_policy(Level::baseline(), key(generation), &mut numbers);
    numbers
}

#[track_caller]
fn near(what: &str, found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() <= tolerance, "{what}: {found}, expected {expected}");
}

/// The utility of a rank, from 0, as the papers have it.
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
fn utilities_are_those_of_the_papers_and_ties_share_theirs() {
    for method in [Method::OpenAiEs, Method::Snes] {
        for policies in [2, 3, 4, 7, 50, 5000] {
            let strategy = strategy(method, policies, 112);
            let rising: Vec<f32> = (0..policies).map(|policy| policy as f32 - 1.5).collect();
            let found = strategy.utilities(&rising);
            for (policy, &found) in found.iter().enumerate() {
                let expected = utility(method, policies - 1 - policy, policies);
                near(&format!("{method}, {policy} of {policies}"), found, expected, 1e-6);
            }
            near("the sum", found.iter().sum(), 0.0, 1e-12);
            // No score differs, so no direction is better.
            assert!(strategy.utilities(&vec![0.25; policies]).iter().all(|utility| utility.abs() < 1e-15));
        }
        // Ranks 0, 1 and 2 are tied at 3, rank 3 has 1, and ranks 4 and 5 are tied at two zeros.
        let found = strategy(method, 6, 112).utilities(&[0.0, 3.0, 1.0, 3.0, -0.0, 3.0]);
        let mean = |ranks: std::ops::Range<usize>| {
            let count = ranks.len() as f64;
            ranks.map(|rank| utility(method, rank, 6)).sum::<f64>() / count
        };
        for (found, expected) in
            found.iter().zip([mean(4..6), mean(0..3), mean(3..4), mean(0..3), mean(4..6), mean(0..3)])
        {
            near(&method.to_string(), *found, expected, 1e-6);
        }
    }
}

/// Weight by weight: Box and Muller's formula in f64, from the draws that the counters give.
#[test]
fn samples_follow_from_their_own_counters() {
    let parameters = 150;
    let (mean, mut sigmas) = (numbers(parameters, 0), numbers(parameters, 1));
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
                // One draw makes four deviates, 16 weights apart: a cosine and a sine of each pair of words.
                let words = key.draw((index / 64 * 16 + index % 16) as u32);
                let which = index / 16 % 4;
                let [a, b] = [words[which / 2 * 2], words[which / 2 * 2 + 1]];
                let unit = (f64::from(a >> 8) + 1.0) / (1u32 << 24) as f64;
                let angle = (f64::from(b >> 8) / (1u32 << 23) as f64 - 1.0) * std::f64::consts::PI;
                let deviate = (-2.0 * unit.ln()).sqrt() * if which % 2 == 0 { angle.cos() } else { angle.sin() };
                let expected = f64::from(mean[index]) + sign * f64::from(sigmas[index]) * deviate;
                near(&format!("{method}, slot {slot}, weight {index}"), f64::from(weight), expected, 1e-5);
            }
        }
    }
}

/// A population with scores: `[policies + 2][parameters]`.
fn population(policies: usize, parameters: usize) -> (Vec<f32>, Vec<f32>) {
    let mut population = numbers((policies + 2) * parameters, 2);
    let sigmas = (policies + 1) * parameters;
    population[sigmas..].iter_mut().for_each(|sigma| *sigma = sigma.abs() / 2.0 + 0.1);
    // Few distinct scores, as tasks have them.
    let scores = numbers(policies, 3).into_iter().map(|score| (score * 4.0).round() / 4.0).collect();
    (population, scores)
}

#[test]
fn an_update_is_its_equation() {
    // More policies than are added up at a time, too.
    for (policies, parameters) in [(8, 112), (37, 70), (2600, 5)] {
        let (before, scores) = population(policies, parameters);
        for method in [Method::OpenAiEs, Method::Snes] {
            let strategy = strategy(method, policies, parameters);
            let mut after = before.clone();
            strategy.update(Level::new(), 1, &scores, &mut after);
            let whole = policies * parameters;
            assert_eq!(after[..whole], before[..whole], "policies stay");
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
                let [mean, sigma] = [0, 1].map(|slot| f64::from(before[whole + slot * parameters + index]));
                let deviate = |policy: usize| (f64::from(before[policy * parameters + index]) - mean) / sigma;
                let sum = |each: &dyn Fn(f64) -> f64| -> f64 {
                    (0..policies).map(|policy| utilities[policy] * each(deviate(policy))).sum()
                };
                let dimensions = parameters as f64;
                let rate = (3.0 + dimensions.ln()) / (5.0 * dimensions.sqrt());
                let (moved, adapted) = match method {
                    // Salimans et al. (2017), Algorithm 1.
                    Method::OpenAiEs => (mean + 0.7 / (policies as f64 * sigma) * sum(&|s| s), sigma),
                    // Wierstra et al. (2014), Algorithm 6; a change is at most by a factor of e.
                    _ => {
                        let change = rate / 2.0 * sum(&|s| s * s - 1.0);
                        (mean + sigma * sum(&|s| s), sigma * change.clamp(-1.0, 1.0).exp())
                    }
                };
                let found = [0, 1].map(|slot| f64::from(after[whole + slot * parameters + index]));
                near(&format!("{method}, {policies}, mean {index}"), found[0], moved, 2e-6 * (1.0 + moved.abs()));
                near(&format!("{method}, {policies}, sigma {index}"), found[1], adapted, 2e-6 * (1.0 + adapted));
            }
        }
    }
}

/// Generation 0 is random whatever the method: the search starts from its best policy, and the first of those that tie.
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

/// A population of few policies that repeat finds the optimum of a sphere: signs and sizes of steps are right.
#[test]
fn a_sphere_is_solved() {
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

/// The same bits on every instruction set, from any slot on, and on any number of threads.
#[test]
fn a_search_depends_on_no_instruction_set() {
    for method in [Method::OpenAiEs, Method::Snes] {
        for (policies, parameters) in [(2, 1), (5, 15), (9, 112), (64, 65), (2500, 3)] {
            let (before, scores) = population(policies, parameters);
            let all = |level: Level, first: usize| {
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
            let expected = all(Level::baseline(), 0);
            for level in Cpu::levels() {
                assert_eq!(all(level, 0), expected, "{method}, {policies}, {parameters}, {}", level_name(level));
            }
            let first = policies / 4 * 2;
            assert_eq!(all(Level::new(), first), expected[first * parameters..], "{method} from {first} on");
            #[cfg(feature = "parallel")]
            for count in [1, 2, 8] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap();
                assert_eq!(pool.install(|| all(Level::new(), 0)), expected, "{method}, {count} threads");
            }
        }
    }
}

/// Whatever the scores, weights are such as the kernels can take, and standard deviations stay positive.
#[test]
fn a_search_stays_in_bounds() {
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
                // What grows is better, then what shrinks.
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

/// The logarithms of the utilities are of numbers up to half of the largest population.
#[test]
fn the_largest_population_has_utilities() {
    let scores: Vec<f32> = (0..MAX_POPULATION).map(|policy| -(policy as f32)).collect();
    let found = strategy(Method::Snes, MAX_POPULATION, 112).utilities(&scores);
    let count = MAX_POPULATION as f64;
    for rank in [0, 1, 1000, MAX_POPULATION / 2 - 1, MAX_POPULATION / 2, MAX_POPULATION - 1] {
        near("utility", found[rank] * count, utility(Method::Snes, rank, MAX_POPULATION) * count, 2e-5);
    }
}
