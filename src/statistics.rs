//! Estimates from trials with their confidence intervals, and tests of differences.
//!
//! Trials of two arms with the same seed are pairs. They share their starts and, if sizes agree, their first
//! populations. The differences of pairs are one sample: [`mean`] gives its interval.
//!
//! [`Average`] gives mean, deviation and standard error of any other values.
//!
//! Some functions make fewer assumptions about the distribution. [`bootstrap`] gives the interval of a mean or a
//! difference, [`rank_sum`] tests two samples, and [`signed_rank`] tests pairs. [`holm`] corrects for multiple tests. G
//! takes few values, so ranks have many ties, and both rank tests compute exact p-values for ties here.
//!
//! The special functions are those of `special`, which calls `libm` only: a table has the same digits on every system.
//! Other crates of statistics call the system's functions as soon as any dependency asks for that.

use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use serde::Serialize;
use special::{Beta, Error};

/// Confidence level of all intervals.
pub const CONFIDENCE: f64 = 0.95;
/// Number of samples that [`bootstrap`] draws.
pub const RESAMPLES: usize = 9999;
/// Maximum number of values, counting both samples, for exact p-values. Larger samples use the normal distribution.
pub(crate) const EXACT: usize = 100;

/// A number with its 95 % interval. Both ends are included.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The number.
    pub value: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

impl Estimate {
    /// Returns an estimate without uncertainty.
    pub fn exact(value: f64) -> Estimate {
        Estimate { value, low: value, high: value }
    }

    /// Returns the estimate with its interval clamped to `least..=most`.
    pub fn within(self, least: f64, most: f64) -> Estimate {
        Estimate { low: self.low.max(least), high: self.high.min(most), ..self }
    }
}

/// Mean, standard deviation and standard error of values that are added one by one.
///
/// If all values are equal, the mean is exactly that value and the error is 0. Otherwise the mean does not depend on
/// the order if the sum is exact, as for halves and quarters.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Average {
    count: u32,
    sum: f64,
    /// The running mean and the sum of squared distances from it, by Welford's recurrence.
    mean: f64,
    squares: f64,
}

impl Average {
    /// Adds a value.
    pub fn add(&mut self, value: f64) {
        self.count += 1;
        self.sum += value;
        let before = value - self.mean;
        self.mean += before / f64::from(self.count);
        self.squares += before * (value - self.mean);
    }

    /// Returns the number of values.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// Returns the mean, or 0 without values.
    pub fn mean(&self) -> f64 {
        if self.squares == 0.0 { self.mean } else { self.sum / f64::from(self.count) }
    }

    /// Returns the sample standard deviation, or 0 for fewer than two values.
    pub fn deviation(&self) -> f64 {
        if self.count < 2 { 0.0 } else { (self.squares / f64::from(self.count - 1)).sqrt() }
    }

    /// Returns the standard error of the mean, or 0 for fewer than two values.
    pub fn error(&self) -> f64 {
        if self.count < 2 { 0.0 } else { self.deviation() / f64::from(self.count).sqrt() }
    }
}

impl<'a> FromIterator<&'a f64> for Average {
    fn from_iter<I: IntoIterator<Item = &'a f64>>(values: I) -> Average {
        let mut average = Average::default();
        values.into_iter().for_each(|&value| average.add(value));
        average
    }
}

/// Returns the mean of a sample with its Student's t interval. None for fewer than two values.
///
/// A sample of equal values has no measurable spread. The half-width of its interval is then `step` times the upper
/// bound of [`share`] for 0 of n. `step` is the smallest possible difference between two values.
pub fn mean(values: &[f64], step: f64) -> Option<Estimate> {
    mean_at(CONFIDENCE, values, step)
}

/// Returns the same as [`mean`], with an interval of any confidence level.
pub fn mean_at(confidence: f64, values: &[f64], step: f64) -> Option<Estimate> {
    let (value, error) = moments(values)?;
    Some(interval_at(confidence, value, error, values.len(), step))
}

/// Returns the interval of [`mean`] from the mean, its standard error and the number of values, at least 2.
pub fn interval(value: f64, error: f64, count: usize, step: f64) -> Estimate {
    interval_at(CONFIDENCE, value, error, count, step)
}

fn interval_at(confidence: f64, value: f64, error: f64, count: usize, step: f64) -> Estimate {
    let room = match error {
        0.0 => step * share_at(confidence, 0, count).map_or(0.0, |share| share.high),
        error => error * half_width_at(confidence, count),
    };
    Estimate { value, low: value - room, high: value + room }
}

/// Returns the half-width of the 95 % interval of a mean of `count` values, in standard errors. 0 for fewer than two.
pub fn half_width(count: usize) -> f64 {
    half_width_at(CONFIDENCE, count)
}

fn half_width_at(confidence: f64, count: usize) -> f64 {
    if count < 2 { 0.0 } else { student((1.0 - confidence) / 2.0, (count - 1) as f64) }
}

/// Returns a share with the exact interval of Clopper and Pearson. None if `of` is 0.
pub fn share(count: usize, of: usize) -> Option<Estimate> {
    share_at(CONFIDENCE, count, of)
}

/// Returns the same as [`share`], with an interval of any confidence level.
pub fn share_at(confidence: f64, count: usize, of: usize) -> Option<Estimate> {
    let (some, others) = (count as f64, of.checked_sub(count)? as f64);
    let bound = |a: f64, b: f64, at: f64| at.inv_inc_beta(a, b, a.ln_beta(b));
    let tail = (1.0 - confidence) / 2.0;
    Some(Estimate {
        value: (of > 0).then_some(some / of as f64)?,
        low: if count == 0 { 0.0 } else { bound(some, others + 1.0, tail) },
        high: if count == of { 1.0 } else { bound(some + 1.0, others, 1.0 - tail) },
    })
}

/// Returns the smallest alpha, from 1e-12 to 1, at which a condition holds for the interval of confidence 1 - alpha.
///
/// This is the p-value of the test that the interval inverts. The condition must hold for narrower intervals, too. None
/// if it does not hold for the narrowest.
pub fn smallest_alpha(holds: impl Fn(f64) -> bool) -> Option<f64> {
    let alpha = |exponent: f64| libm::pow(10.0, exponent);
    let (mut fails, mut meets) = (-12.0, -1e-9);
    if !holds(1.0 - alpha(meets)) {
        return None;
    }
    if holds(1.0 - alpha(fails)) {
        return Some(alpha(fails));
    }
    for _ in 0..50 {
        let middle = (fails + meets) / 2.0;
        *if holds(1.0 - alpha(middle)) { &mut meets } else { &mut fails } = middle;
    }
    Some(alpha(meets))
}

/// Returns the distance of each value from the median of all values.
///
/// The mean of the distances measures spread. Testing the paired differences of two arms' distances is the
/// Brown-Forsythe test for pairs.
pub fn distances(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let (low, high) = (values.len().saturating_sub(1) / 2, values.len() / 2);
    let median = sorted.get(low).zip(sorted.get(high)).map_or(0.0, |(low, high)| (low + high) / 2.0);
    values.iter().map(|value| (value - median).abs()).collect()
}

/// Returns mean and standard error. None for fewer than two values.
fn moments(values: &[f64]) -> Option<(f64, f64)> {
    let average: Average = values.iter().collect();
    (average.count > 1).then(|| (average.mean(), average.error()))
}

/// Returns the value that Student's distribution exceeds with probability `tail`, at most 0.5.
fn student(tail: f64, freedom: f64) -> f64 {
    // With one degree of freedom it is Cauchy's, and the general formula loses digits.
    if freedom == 1.0 {
        return 1.0 / libm::tan(std::f64::consts::PI * tail);
    }
    let half = freedom / 2.0;
    let share = (2.0 * tail).inv_inc_beta(half, 0.5, half.ln_beta(0.5));
    (freedom * (1.0 - share) / share).sqrt()
}

/// Returns the probability that a normal variable exceeds `z`.
fn normal_above(z: f64) -> f64 {
    (z * std::f64::consts::FRAC_1_SQRT_2).compl_error() / 2.0
}

/// Returns the value that a normal variable is below with probability `p`.
fn normal_quantile(p: f64) -> f64 {
    std::f64::consts::SQRT_2 * (2.0 * p - 1.0).inv_error()
}

/// Returns the mean of the first sample, minus that of the second if given, with its bootstrap interval. None if a
/// sample has fewer than two values.
///
/// The interval is bias-corrected and accelerated (BCa) over [`RESAMPLES`] samples. The seed is fixed, so equal values
/// always have equal intervals. If all values of each sample are equal, the interval has no width.
pub fn bootstrap(samples: &[&[f64]]) -> Option<Estimate> {
    if samples.is_empty()
        || samples.iter().any(|sample| sample.len() < 2 || !sample.iter().all(|value| value.is_finite()))
    {
        return None;
    }
    // Sums a function over the first sample with sign 1 and the second with sign -1.
    let total = |of: &mut dyn FnMut(&[f64], f64) -> f64| -> f64 {
        samples.iter().zip([1.0, -1.0]).map(|(sample, sign)| of(sample, sign)).sum()
    };
    let mean = |sample: &[f64]| moments(sample).map_or(f64::NAN, |(mean, _)| mean);
    let value = total(&mut |sample, sign| sign * mean(sample));
    let moment = |power: usize| {
        total(&mut |sample, sign| {
            let (mean, count) = (mean(sample), sample.len() as f64);
            sample.iter().map(|value| power_of(sign * (value - mean) / count, power)).sum()
        })
    };
    let spread = moment(2);
    if spread == 0.0 {
        return Some(Estimate::exact(value));
    }
    let acceleration = moment(3) / (spread * spread.sqrt()) / 6.0;

    let mut random = ChaCha8Rng::seed_from_u64(0);
    let mut draw = |sample: &[f64], sign: f64| {
        let count = sample.len();
        sign * (0..count).map(|_| sample[random.random_range(0..count)]).sum::<f64>() / count as f64
    };
    let mut drawn: Vec<f64> = (0..RESAMPLES).map(|_| total(&mut draw)).collect();
    drawn.sort_by(f64::total_cmp);
    // Means that differ only by rounding count as equal.
    let grain = 1e-9 * spread.sqrt();
    let [below, most] = [value - grain, value + grain].map(|at| drawn.partition_point(|&drawn| drawn < at));
    let bias = normal_quantile((below + most) as f64 / 2.0 / RESAMPLES as f64);
    let end = |tail: f64| {
        let shifted = bias + normal_quantile(tail);
        let place = normal_above(-bias - shifted / (1.0 - acceleration * shifted)) * (RESAMPLES - 1) as f64;
        let (left, right) = (drawn[place.floor() as usize], drawn[place.ceil() as usize]);
        left + (right - left) * place.fract()
    };
    let tail = (1.0 - CONFIDENCE) / 2.0;
    Some(Estimate { value, low: end(tail), high: end(1.0 - tail) })
}

/// The result of a test of two samples or of pairs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Tested {
    /// Vargha and Delaney's A: the share of pairings in which the first sample has the larger value, plus half of the
    /// ties. 0.5 means that neither is ahead.
    pub a: f64,
    /// The two-sided p-value.
    pub p: f64,
}

/// Returns the Mann-Whitney test over all pairings of two samples. None if one is empty.
///
/// The p-value is exact up to [`EXACT`] values: twice the smaller tail over all assignments of the values, with their
/// ties. For more values it uses the normal distribution, corrected for ties and continuity.
pub fn rank_sum(one: &[f64], other: &[f64]) -> Option<Tested> {
    if one.is_empty() || other.is_empty() || !one.iter().chain(other).all(|value| value.is_finite()) {
        return None;
    }
    let ranks = twice_ranks(&[one, other].concat());
    let (count, all) = (one.len(), ranks.len());
    let sum: usize = ranks[..count].iter().sum();
    let pairings = (count * other.len()) as f64;
    let a = (sum - count * (count + 1)) as f64 / 2.0 / pairings;
    let p = if all <= EXACT {
        // The smaller sample has fewer sums to enumerate.
        let (size, sum) = if 2 * count <= all { (count, sum) } else { (other.len(), ranks[count..].iter().sum()) };
        two_sided(&sums_of(&ranks, size), sum)
    } else {
        let middle = (all + 1) as f64;
        let squares: f64 = ranks.iter().map(|&rank| power_of(rank as f64 - middle, 2)).sum();
        normal(sum as f64 - count as f64 * middle, pairings * squares / (all * (all - 1)) as f64)
    };
    Some(Tested { a, p })
}

/// Returns a power by multiplication. The precision of `powi` is not specified, so it could differ between systems.
pub fn power_of(base: f64, exponent: usize) -> f64 {
    (0..exponent).fold(1.0, |power, _| power * base)
}

/// Returns Wilcoxon's signed-rank test of the differences of pairs. None without differences.
///
/// Pairs with a difference of 0 do not affect p. For up to [`EXACT`] others p is exact, over all their signs. For more
/// it uses the normal distribution, as in [`rank_sum`]. A is over the pairs themselves, including those with a
/// difference of 0.
pub fn signed_rank(differences: &[f64]) -> Option<Tested> {
    if !differences.iter().all(|difference| difference.is_finite()) {
        return None;
    }
    let differences: Vec<f64> = differences.iter().map(|&difference| grained(difference)).collect();
    let (up, down) = (|value: &&f64| **value > 0.0, |value: &&f64| **value < 0.0);
    let [up_count, down_count] =
        [differences.iter().filter(up).count(), differences.iter().filter(down).count()].map(|count| count as f64);
    let some: Vec<f64> = differences.iter().copied().filter(|&difference| difference != 0.0).collect();
    let ranks = twice_ranks(&some.iter().map(|difference| difference.abs()).collect::<Vec<_>>());
    let sum: usize = ranks.iter().zip(&some).filter(|(_, difference)| **difference > 0.0).map(|(rank, _)| rank).sum();
    let p = if some.len() <= EXACT {
        two_sided(&sums_of_any(&ranks), sum)
    } else {
        let [all, squares] = [1, 2].map(|power| ranks.iter().map(|&rank| power_of(rank as f64, power)).sum::<f64>());
        normal(sum as f64 - all / 2.0, squares / 4.0)
    };
    let count = (!differences.is_empty()).then_some(differences.len() as f64)?;
    Some(Tested { a: (1.0 + (up_count - down_count) / count) / 2.0, p })
}

/// Returns p-values with Holm's correction for multiple tests, in the given order, each at most 1.
pub fn holm(p: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p.len()).collect();
    order.sort_by(|&a, &b| p[a].total_cmp(&p[b]));
    let (mut corrected, mut most) = (vec![0.0; p.len()], 0.0f64);
    for (at, place) in order.into_iter().enumerate() {
        most = most.max(p[place] * (p.len() - at) as f64).min(1.0);
        corrected[place] = most;
    }
    corrected
}

/// Rounds a value to 12 decimal places, so that rounding errors do not break ties.
fn grained(value: f64) -> f64 {
    (value * 1e12).round() / 1e12
}

/// Returns twice the rank of every value, from 1. Ties share their mean rank; doubling makes it a whole number.
fn twice_ranks(values: &[f64]) -> Vec<usize> {
    let values: Vec<f64> = values.iter().map(|&value| grained(value)).collect();
    let mut sorted = values.clone();
    sorted.sort_by(f64::total_cmp);
    let up_to = |value: f64| sorted.partition_point(|&other| other <= value);
    values.iter().map(|&value| sorted.partition_point(|&other| other < value) + up_to(value) + 1).collect()
}

/// Returns the number of ways to choose `size` ranks for each sum.
fn sums_of(ranks: &[usize], size: usize) -> Vec<f64> {
    let most = ranks.iter().sum::<usize>();
    let mut ways = vec![vec![0.0; most + 1]; size + 1];
    ways[0][0] = 1.0;
    for (seen, &rank) in ranks.iter().enumerate() {
        for chosen in (1..=size.min(seen + 1)).rev() {
            let (fewer, with) = ways.split_at_mut(chosen);
            with[0][rank..].iter_mut().zip(&fewer[chosen - 1]).for_each(|(with, without)| *with += without);
        }
    }
    ways.swap_remove(size)
}

/// Returns the probability of each sum if every rank is chosen with probability 1/2.
fn sums_of_any(ranks: &[usize]) -> Vec<f64> {
    let mut ways = vec![0.0; ranks.iter().sum::<usize>() + 1];
    ways[0] = 1.0;
    for &rank in ranks {
        for sum in (0..ways.len()).rev() {
            ways[sum] = 0.5 * (ways[sum] + if sum < rank { 0.0 } else { ways[sum - rank] });
        }
    }
    ways
}

/// Returns the two-sided p-value of a sum: twice the smaller tail of the distribution, at most 1.
fn two_sided(ways: &[f64], sum: usize) -> f64 {
    let [low, high, all] = [&ways[..=sum], &ways[sum..], ways].map(|ways| ways.iter().sum::<f64>());
    (2.0 * low.min(high) / all).min(1.0)
}

/// Returns the two-sided p-value of a sum of doubled ranks by the normal distribution. `off` is its distance from the
/// mean.
fn normal(off: f64, variance: f64) -> f64 {
    // Continuity correction: half a rank is 1 after doubling.
    let z = (off.abs() - 1.0) / variance.sqrt();
    if variance > 0.0 { (2.0 * normal_above(z)).min(1.0) } else { 1.0 }
}
