//! Evolution strategies: a population is sampled around a mean policy, which then moves towards its better samples.
//!
//! Sums are in 64 bits and in an order that no number of threads or lanes changes. Only operations that every processor
//! rounds alike are used.

use fearless_simd::{Level, Simd, dispatch, prelude::*};

use super::random::Key;
use super::selection::top_indices;
use super::weights::{MAX_WEIGHT, MIN_WEIGHT, within_limits};
use crate::config::{Learning, Method};
use crate::kernels::{math, splat};
use crate::parallel::*;

/// The evolution strategy of one config.
///
/// A population is `[policies + 2][parameters]`: its policies, the mean that they were sampled around, and the standard
/// deviation of each weight.
#[derive(Clone, Debug)]
pub struct Strategy {
    method: Method,
    /// The utility of each rank, best first. They add up to 0.
    utilities: Vec<f64>,
    /// α of [`Method::OpenAiEs`].
    step: f64,
    /// The rate at which [`Method::Snes`] adapts standard deviations.
    rate: f64,
    /// The standard deviation at the start.
    sigma: f32,
}

impl Strategy {
    /// Returns the strategy that a config asks for. `None` stands for tournaments.
    pub fn of(level: Level, learning: &Learning, parameters: usize) -> Option<Strategy> {
        let policies = learning.population;
        let (utilities, rate) = match learning.method {
            Method::Tournament => return None,
            Method::OpenAiEs => (centred_ranks(policies), 0.0),
            Method::Snes => log_ranks(level, policies, parameters),
        };
        let (step, sigma) = (learning.search_step, learning.search_sigma as f32);
        Some(Strategy { method: learning.method, utilities, step, rate, sigma })
    }

    /// Returns the utility of each policy's rank, `[policies]`, for scores `[policies]`. Policies with equal scores get
    /// the mean over their ranks.
    pub fn utilities(&self, scores: &[f32]) -> Vec<f64> {
        let order = top_indices(scores, scores.len());
        let (mut utilities, mut rank) = (vec![0.0; scores.len()], 0);
        for tied in order.chunk_by(|&a, &b| scores[a] == scores[b]) {
            let ranks = &self.utilities[rank..rank + tied.len()];
            let mean = ranks.iter().sum::<f64>() / tied.len() as f64;
            tied.iter().for_each(|&policy| utilities[policy] = mean);
            rank += tied.len();
        }
        utilities
    }

    /// Moves the mean of a population that has played, and adapts the standard deviations.
    ///
    /// `scores` is `[policies]`. `population` is `[policies + 2][parameters]`, with the mean and the standard deviations
    /// last. Generation 0 is random, and the mean starts at its best policy.
    pub fn update(&self, level: Level, generation: usize, scores: &[f32], population: &mut [f32]) {
        let parameters = population.len() / (scores.len() + 2);
        let (policies, search) = population.split_at_mut(scores.len() * parameters);
        let (mean, sigmas) = search.split_at_mut(parameters);
        if generation == 0 {
            let first = top_indices(scores, 1)[0] * parameters;
            mean.copy_from_slice(&policies[first..first + parameters]);
            sigmas.fill(self.sigma);
            return;
        }
        let utilities = self.utilities(scores);
        let total: f64 = utilities.iter().sum();
        let moments = moments(level, policies, &utilities, mean);
        for ((mean, sigma), [first, second]) in mean.iter_mut().zip(sigmas).zip(moments) {
            let variance = f64::from(*sigma) * f64::from(*sigma);
            let step = match self.method {
                Method::Snes => first,
                _ => self.step * first / (scores.len() as f64 * variance),
            };
            *mean = weight(f64::from(*mean) + step);
            if self.method == Method::Snes {
                let change = self.rate / 2.0 * (second / variance - total);
                let adapted = f64::from(*sigma) * exp(change.clamp(-1.0, 1.0));
                *sigma = (adapted as f32).clamp(MIN_SIGMA, MAX_SIGMA);
            }
        }
    }

    /// Fills slots of the next generation, `[slots][parameters]`. `scratch` may hold anything.
    ///
    /// With mirrored sampling, slots 2i and 2i + 1 are the mean plus and minus the same noise. If the number of
    /// policies is odd, the last one is the mean.
    pub fn sample(&self, level: Level, samples: Samples<'_>, children: &mut [f32], scratch: &mut Vec<f32>) {
        let mirrored = self.method == Method::OpenAiEs;
        dispatch!(level, simd => sample_lanes(simd, mirrored, samples, children, scratch));
    }
}

/// Limits of a standard deviation that adapts.
const MIN_SIGMA: f32 = 1.0 / 1_048_576.0;
const MAX_SIGMA: f32 = 1024.0;

/// Some slots of one population, to be sampled.
#[derive(Clone, Copy, Debug)]
pub struct Samples<'a> {
    /// The trial's key of [`Purpose::Search`](super::Purpose::Search).
    pub key: Key,
    /// The generation that ends.
    pub generation: usize,
    /// The index of the population in its trial.
    pub population: usize,
    /// The number of policies in the population.
    pub policies: usize,
    /// The index of the first slot, an even number.
    pub first: usize,
    /// The mean and the standard deviation of each weight.
    pub mean: &'a [f32],
    /// See `mean`.
    pub sigmas: &'a [f32],
}

/// Returns centred ranks: from 1/2 for the best to -1/2 for the worst, evenly spaced.
fn centred_ranks(policies: usize) -> Vec<f64> {
    (0..policies).map(|rank| 0.5 - rank as f64 / (policies - 1) as f64).collect()
}

/// Returns the utilities of natural evolution strategies, max(0, ln(k/2 + 1) − ln i) for rank i, scaled to a sum of 1
/// and less their mean; and the rate (3 + ln d)/(5 √d) for d parameters.
fn log_ranks(level: Level, policies: usize, parameters: usize) -> (Vec<f64>, f64) {
    // The exact logarithm takes numbers up to 1. A common factor drops out of differences.
    let scaled = |number: f32| number / (1 << 21) as f32;
    let positive = policies.div_ceil(2);
    let mut logarithms: Vec<f32> = (1..=positive).map(|rank| scaled(rank as f32)).collect();
    logarithms.extend([scaled((policies + 2) as f32 / 2.0), 1.0 / parameters as f32]);
    dispatch!(level, simd => take_logarithms(simd, &mut logarithms));
    let (limit, of_parameters) = (logarithms[positive], -f64::from(logarithms[positive + 1]));
    let raw: Vec<f64> = logarithms[..positive].iter().map(|&of_rank| f64::from((limit - of_rank).max(0.0))).collect();
    let total: f64 = raw.iter().sum();
    let utility = |rank: usize| raw.get(rank).unwrap_or(&0.0) / total - 1.0 / policies as f64;
    ((0..policies).map(utility).collect(), (3.0 + of_parameters) / (5.0 * (parameters as f64).sqrt()))
}

#[inline(always)]
fn take_logarithms<S: Simd>(simd: S, numbers: &mut [f32]) {
    for chunk in numbers.chunks_mut(S::f32s::LEN) {
        let numbers = S::f32s::from_fn(simd, |lane| chunk.get(lane).copied().unwrap_or(1.0));
        chunk.copy_from_slice(&math::ln::<S>(numbers).as_slice()[..chunk.len()]);
    }
}

/// Policies whose sums are added first. A constant, so that the order of additions is always the same.
const SUMMED_TOGETHER: usize = 1024;

/// Returns Σ u·(w − mean) and Σ u·(w − mean)² of each weight w, over the policies with their utilities u.
fn moments(level: Level, policies: &[f32], utilities: &[f64], mean: &[f32]) -> Vec<[f64; 2]> {
    let blocks = policies.par_chunks(SUMMED_TOGETHER * mean.len()).zip(utilities.par_chunks(SUMMED_TOGETHER));
    let of_block = |(policies, utilities): (&[f32], &[f64])| {
        let mut sums = [vec![0.0; mean.len()], vec![0.0; mean.len()]];
        let [first, second] = &mut sums;
        dispatch!(level, simd => add_moments(simd, policies, utilities, mean, first, second));
        sums
    };
    let blocks: Vec<[Vec<f64>; 2]> = blocks.map(of_block).collect();
    let sum = |place: usize, which: usize| blocks.iter().map(|block| block[which][place]).sum();
    (0..mean.len()).map(|place| [sum(place, 0), sum(place, 1)]).collect()
}

/// Adds policy by policy. The compiler turns this into vectors over weights, whose sums are separate.
#[inline(always)]
fn add_moments<S: Simd>(
    _: S,
    policies: &[f32],
    utilities: &[f64],
    mean: &[f32],
    first: &mut [f64],
    second: &mut [f64],
) {
    for (policy, &utility) in policies.chunks_exact(mean.len()).zip(utilities) {
        let sums = first.iter_mut().zip(second.iter_mut());
        for ((&weight, &mean), (first, second)) in policy.iter().zip(mean).zip(sums) {
            let offset = f64::from(weight) - f64::from(mean);
            let weighted = utility * offset;
            *first += weighted;
            *second += weighted * offset;
        }
    }
}

/// Rounds a number to an allowed weight.
fn weight(number: f64) -> f32 {
    let weight = (number as f32).clamp(-MAX_WEIGHT, MAX_WEIGHT);
    if weight.abs() < MIN_WEIGHT { 0.0 } else { weight }
}

/// e^x for x in -1..1 within 1e-14, from operations that round alike everywhere.
fn exp(x: f64) -> f64 {
    (1..=17).rev().fold(1.0, |sum, term| 1.0 + x / f64::from(term) * sum)
}

#[inline(always)]
fn sample_lanes<S: Simd>(simd: S, mirrored: bool, samples: Samples<'_>, children: &mut [f32], scratch: &mut Vec<f32>) {
    let Samples { key, generation, population, policies, first, mean, sigmas } = samples;
    let parameters = mean.len();
    let whole = parameters / S::f32s::LEN * S::f32s::LEN;
    scratch.resize(parameters.next_multiple_of(64), 0.0);
    for (slot, child) in (first..).zip(children.chunks_exact_mut(parameters)) {
        if mirrored && slot + 1 == policies && slot % 2 == 0 {
            child.copy_from_slice(mean);
            continue;
        }
        let is_mirror = mirrored && slot % 2 == 1;
        if !is_mirror {
            let number = if mirrored { slot / 2 } else { slot };
            draw_noise(simd, key.at(generation, population, number), scratch);
        }
        let sign = splat(simd, if is_mirror { -1.0 } else { 1.0 });
        for at in (0..whole).step_by(S::f32s::LEN) {
            let load = |from: &[f32]| S::f32s::from_slice(simd, &from[at..at + S::f32s::LEN]);
            let weights = within_limits(simd, load(mean) + load(scratch) * load(sigmas) * sign);
            weights.store_slice(&mut child[at..at + S::f32s::LEN]);
        }
        if whole < parameters {
            let load = |from: &[f32]| S::f32s::from_fn(simd, |lane| from.get(whole + lane).copied().unwrap_or(0.0));
            let last = within_limits(simd, load(mean) + load(scratch) * load(sigmas) * sign);
            child[whole..].copy_from_slice(&last.as_slice()[..parameters - whole]);
        }
    }
}

/// Fills blocks of 64 numbers with standard normal deviates. A draw makes four.
///
/// Number `64·block + 16·word + place` is deviate `word` of counter `16·block + place`, whatever the number of lanes.
#[inline(always)]
fn draw_noise<S: Simd>(simd: S, key: Key, noise: &mut [f32]) {
    let lanes = S::u32s::from_fn(simd, |lane| lane as u32);
    for (block, noise) in noise.as_chunks_mut::<64>().0.iter_mut().enumerate() {
        for place in (0..16).step_by(S::f32s::LEN) {
            let [a, b, c, d] = key.draw_lanes::<S>(lanes + (16 * block + place) as u32);
            let [first, second] = math::normal_pair::<S>(a, b);
            let [third, fourth] = math::normal_pair::<S>(c, d);
            for (word, deviates) in [first, second, third, fourth].into_iter().enumerate() {
                deviates.store_slice(&mut noise[16 * word + place..][..S::f32s::LEN]);
            }
        }
    }
}
